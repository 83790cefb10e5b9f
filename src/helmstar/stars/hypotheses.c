/* Attitude hypotheses: what hypotheses.py does with NumPy (`_chunk`, `_rank` and what they call), without arrays of hypotheses times detections.

   Arithmetic is that of the NumPy twin, operation by operation; only sums over detections and of three products may be rounded
   otherwise, which moves a direction that lies on the edge of a cell of the sky map into the next. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "../native.h"

#define BLOCK 128
#define MOST 128 /* detections */
#define TESTS 16 /* of every hypothesis, at most */

/* A catalogue pair in its two orders is laid on detections i, j. Returns the number of hypotheses written, at most `room`;
   -1 where an index is out of range.

   stars: (n_stars, 4) x, y, z, V. pairs: (m, 2); row, count: (m,) of the table. m: magnitudes (n,) or NULL; zero_point: NaN where
   unknown. f_known: px, 0 where f is free between f_low and f_high. All hypotheses of the first order come first. */
int64_t helmstar_candidates(
    int64_t n_stars, const float *stars, int64_t n_table, const int32_t *first, const int32_t *second, int64_t n,
    const double *xy, const float *magnitude, int64_t n_pairs, const int64_t *pairs, const int64_t *row, const int64_t *count,
    float gate, float zero_point, float zero_gate, double f_known, double f_low, double f_high, int64_t room, int32_t *ij,
    int32_t *ab, double *f_out, float *zero_out)
{
    int64_t h = 0;
    for (int order = 0; order < 2; order++)
        for (int64_t p = 0; p < n_pairs; p++) {
            int64_t i = pairs[2 * p + order], j = pairs[2 * p + 1 - order];
            if (i < 0 || j < 0 || i >= n || j >= n || row[p] < 0 || count[p] < 0 || row[p] + count[p] > n_table)
                return -1;
            double xi = xy[2 * i], yi = xy[2 * i + 1], xj = xy[2 * j], yj = xy[2 * j + 1];
            double dot = xi * xj + yi * yj, qi = xi * xi + yi * yi, qj = xj * xj + yj * yj;
            float mi = 0.0f, mj = 0.0f, step = 0.0f;
            if (magnitude != NULL)
                mi = magnitude[i], mj = magnitude[j], step = mi - mj;
            for (int64_t k = row[p]; k < row[p] + count[p]; k++) {
                int32_t a = first[k], b = second[k];
                if (a < 0 || b < 0 || a >= n_stars || b >= n_stars)
                    return -1;
                const float *va = stars + 4 * (int64_t)a, *vb = stars + 4 * (int64_t)b;
                float zero = zero_point;
                if (magnitude != NULL) {
                    if (!(fabsf(step - (va[3] - vb[3])) < gate))
                        continue;
                    if (isnan(zero_point))
                        zero = 0.5f * (va[3] - mi + vb[3] - mj);
                    else if (!(fabsf(va[3] - mi - zero) < zero_gate && fabsf(vb[3] - mj - zero) < zero_gate))
                        continue;
                }
                double f = f_known;
                if (!(f_known > 0.0)) {
                    double x = va[0] - vb[0], y = va[1] - vb[1], z = va[2] - vb[2];
                    double cosine = 1.0 - 0.5 * (x * x + y * y + z * z), c2 = cosine * cosine;
                    double A = 1.0 - c2, B = 2.0 * dot - c2 * (qi + qj), C = dot * dot - c2 * qi * qj;
                    f = sqrt((-B + sqrt(B * B - 4.0 * A * C)) / (2.0 * A));
                    if (!(f >= f_low && f <= f_high))
                        continue;
                }
                if (h >= room)
                    return -1;
                ij[2 * h] = (int32_t)i, ij[2 * h + 1] = (int32_t)j;
                ab[2 * h] = a, ab[2 * h + 1] = b;
                f_out[h] = f, zero_out[h] = zero;
                h++;
            }
        }
    return h;
}

/* What a direction meets: a coarse map of bits, which stays in the processor's nearest caches, before the map of magnitudes. */
typedef struct {
    int32_t side;
    const uint8_t *coarse;
    const uint8_t *cells;
    const float *magnitudes;
    float sharpness;
} Map;

#define COARSE 2 /* a coarse cell is 2^COARSE cells wide */
#define EMPTY 255

/* Cell of a direction, and its coarse cell. NaN and what lies beyond an edge come to an edge. */
static inline __attribute__((always_inline)) int32_t cell(
    float x, float y, float z, float half, float almost, int32_t side, int32_t wide, int32_t *coarse)
{
    float scale = almost / (fabsf(x) + fabsf(y) + fabsf(z)), last = (float)(side - 1);
    float u = x * scale + half, v = y * scale + half;
    u = u > 0.0f ? u : 0.0f, v = v > 0.0f ? v : 0.0f;
    u = u < last ? u : last, v = v < last ? v : last;
    int32_t row = (int32_t)u, column = (int32_t)v, south = z < 0.0f;
    *coarse = (row >> COARSE) * wide + (column >> COARSE) + (south ? wide * wide : 0);
    return row * side + column + (south ? side * side : 0);
}

static inline __attribute__((always_inline)) int full(const Map *map, int32_t coarse)
{
    return (map->coarse[coarse >> 3] >> (coarse & 7)) & 1;
}

/* A test that met a full coarse cell. They are listed before anything is looked up: no branch that nobody can predict, and all of a
   block wait for the memory together. */
typedef struct {
    int32_t at, hypothesis, test;
} Hit;

/* Keeps those whose cell holds a star, its value in place of the cell. */
static inline __attribute__((always_inline)) int32_t taken(const Map *map, Hit *hit, int32_t hits)
{
    int32_t kept = 0;
    for (int32_t k = 0; k < hits; k++)
        __builtin_prefetch(map->cells + hit[k].at);
    for (int32_t k = 0; k < hits; k++) {
        int32_t value = map->cells[hit[k].at];
        hit[kept] = (Hit){value, hit[k].hypothesis, hit[k].test};
        kept += value != EMPTY;
    }
    return kept;
}

static inline __attribute__((always_inline)) float weight(const Map *map, int32_t value, float m, float zero)
{
    float z = (map->magnitudes[value] - m - zero) * map->sharpness;
    z *= z;
    z *= z;
    return 1.0f / (z + 1.0f);
}

/* One pair of detections: the order in which the others test its hypotheses, and their a, 1 - a and e (see `_laid`). */
typedef struct {
    int32_t i, j, count;
    float xi, yi, xj, yj, length, wd, si, sj, cross;
    int32_t who[MOST];
    float a[MOST], b[MOST], e[MOST];
} Run;

static void begin_run(Run *run, int32_t n, const double *xy, const int32_t *mixed, int32_t i, int32_t j, int32_t from, int32_t to)
{
    double xi = xy[2 * i], yi = xy[2 * i + 1], xj = xy[2 * j], yj = xy[2 * j + 1];
    double ux = xi - xj, uy = yi - yj, uu = ux * ux + uy * uy, cross = xi * yj - xj * yi;
    int64_t start = (31 * (int64_t)i + 17 * (int64_t)j) % n;
    run->i = i, run->j = j, run->count = 0;
    for (int32_t k = from; k < to; k++) {
        int32_t t = mixed[(start + k) % n];
        if (t == i || t == j)
            continue;
        double x = xy[2 * t], y = xy[2 * t + 1], a = ((x - xj) * ux + (y - yj) * uy) / uu;
        int32_t c = run->count++;
        run->who[c] = t, run->a[c] = (float)a, run->b[c] = (float)(1.0 - a), run->e[c] = (float)(x * uy - y * ux + cross);
    }
    run->xi = (float)xi, run->yi = (float)yi, run->xj = (float)xj, run->yj = (float)yj;
    float dx = run->xi - run->xj, dy = run->yi - run->yj;
    run->length = dx * dx + dy * dy;
    run->wd = (dx * run->xj + dy * run->yj) / run->length;
    run->si = run->xi * run->xi + run->yi * run->yi, run->sj = run->xj * run->xj + run->yj * run->yj;
    run->cross = run->xi * run->yj - run->xj * run->yi;
}

/* M (3, 3) of `_laid` in columns X, Y, Z. */
static inline __attribute__((always_inline)) void lay(const Run *run, const float *va, const float *vb, float f, float *M)
{
    float square = f * f, li = sqrtf(run->si + square), lj = sqrtf(run->sj + square);
    float X0 = va[0] * li, X1 = va[1] * li, X2 = va[2] * li, Y0 = vb[0] * lj, Y1 = vb[1] * lj, Y2 = vb[2] * lj;
    float scale = 1.0f / (square * run->length + run->cross * run->cross);
    float D = run->cross * scale, Dw = D * run->wd, Dv = D * (1.0f + run->wd);
    scale *= f;
    M[0] = X0, M[1] = X1, M[2] = X2, M[3] = Y0, M[4] = Y1, M[5] = Y2;
    M[6] = (X1 * Y2 - X2 * Y1) * scale + (Dw * X0 - Dv * Y0);
    M[7] = (X2 * Y0 - X0 * Y2) * scale + (Dw * X1 - Dv * Y1);
    M[8] = (X0 * Y1 - X1 * Y0) * scale + (Dw * X2 - Dv * Y2);
}

/* Score (count,) of a block of hypotheses of one run. */
FAST static void score_block(
    const Map *map, const Run *run, const float *stars, const float *magnitude, int32_t count, const int32_t *ab,
    const double *f, const float *zero, float *score)
{
    float M[9][BLOCK], v[9];
    int32_t at[BLOCK], coarse[BLOCK], hits = 0;
    Hit hit[BLOCK * TESTS];
    float half = 0.5f * (float)map->side, almost = (float)(0.5 * map->side * (1.0 - 1e-6));
    int32_t side = map->side, wide = (side + (1 << COARSE) - 1) >> COARSE;
    for (int32_t h = 0; h < count; h++) {
        lay(run, stars + 4 * (int64_t)ab[2 * h], stars + 4 * (int64_t)ab[2 * h + 1], (float)f[h], v);
        for (int r = 0; r < 9; r++)
            M[r][h] = v[r];
        score[h] = 2.0f;
    }
    for (int32_t t = 0; t < run->count; t++) {
        float a = run->a[t], b = run->b[t], e = run->e[t];
        for (int32_t h = 0; h < count; h++)
            at[h] = cell(
                M[0][h] * a + M[3][h] * b + M[6][h] * e, M[1][h] * a + M[4][h] * b + M[7][h] * e,
                M[2][h] * a + M[5][h] * b + M[8][h] * e, half, almost, side, wide, coarse + h);
        for (int32_t h = 0; h < count; h++) {
            hit[hits] = (Hit){at[h], h, t};
            hits += full(map, coarse[h]);
        }
    }
    hits = taken(map, hit, hits);
    for (int32_t k = 0; k < hits; k++) {
        int32_t h = hit[k].hypothesis;
        score[h] += magnitude == NULL ? 1.0f : weight(map, hit[k].at, magnitude[run->who[hit[k].test]], zero[h]);
    }
}

/* Of one hypothesis, by all tests of its run. */
FAST static float score_one(
    const Map *map, const Run *run, const float *va, const float *vb, const float *magnitude, double f, float zero)
{
    float M[9], half = 0.5f * (float)map->side, almost = (float)(0.5 * map->side * (1.0 - 1e-6)), sum = 0.0f;
    int32_t at[MOST], coarse[MOST], hits = 0, count = run->count;
    Hit hit[MOST + 1];
    int32_t side = map->side, wide = (side + (1 << COARSE) - 1) >> COARSE;
    lay(run, va, vb, (float)f, M);
    for (int32_t t = 0; t < count; t++) {
        float a = run->a[t], b = run->b[t], e = run->e[t];
        at[t] = cell(
            M[0] * a + M[3] * b + M[6] * e, M[1] * a + M[4] * b + M[7] * e, M[2] * a + M[5] * b + M[8] * e, half, almost,
            side, wide, coarse + t);
    }
    for (int32_t t = 0; t < count; t++) {
        hit[hits] = (Hit){at[t], 0, t};
        hits += full(map, coarse[t]);
    }
    hits = taken(map, hit, hits);
    for (int32_t k = 0; k < hits; k++)
        sum += magnitude == NULL ? 1.0f : weight(map, hit[k].at, magnitude[run->who[hit[k].test]], zero);
    return sum;
}

/* The k-th largest (k >= 1) of x (n,), which is left in another order: Hoare's selection. */
static float largest(float *x, int64_t n, int64_t k)
{
    int64_t low = 0, high = n - 1, goal = k - 1;
    while (low < high) {
        float pivot = x[low + (high - low) / 2];
        int64_t p = low, q = high;
        while (p <= q) {
            while (x[p] > pivot)
                p++;
            while (x[q] < pivot)
                q--;
            if (p <= q) {
                float kept = x[p];
                x[p++] = x[q];
                x[q--] = kept;
            }
        }
        if (goal <= q)
            high = q;
        else if (goal >= p)
            low = p;
        else
            break;
    }
    return x[goal];
}

/* The `keep` best of h hypotheses of helmstar_candidates, the best first, earlier ones first among equals: indices to `best`, all scores
   to the first half of `score` (2 h,), the other is used on the way. The first `few` tests of each choose `more` of them, which the other tests are tried on.
   Returns how many there are; -1 for what is out of range. map: cells (2 side side,), coarse (side side / 64 + 1,). */
int64_t helmstar_best(
    int64_t n_stars, const float *stars, int32_t n, const double *xy, const float *magnitude, const int32_t *mixed, int32_t few,
    int64_t h, const int32_t *ij, const int32_t *ab, const double *f, const float *zero, int32_t side, const uint8_t *coarse,
    const uint8_t *cells, const float *magnitudes, float sharpness, int64_t more, int64_t keep, float *score, int64_t *best)
{
    Map map = {side, coarse, cells, magnitudes, sharpness};
    Run run;
    if (n < 2 || n > MOST || few < 0 || few > n || few > TESTS || side < 1 || side > 30000 || h < 1 || keep < 1)
        return -1;
    for (int32_t k = 0; k < n; k++)
        if (mixed[k] < 0 || mixed[k] >= n)
            return -1;
    for (int64_t k = 0; k < 2 * h; k++)
        if (ij[k] < 0 || ij[k] >= n || ab[k] < 0 || ab[k] >= n_stars)
            return -1;
    for (int64_t k = 0; k < h;) {
        int32_t i = ij[2 * k], j = ij[2 * k + 1];
        begin_run(&run, n, xy, mixed, i, j, 0, few);
        while (k < h && ij[2 * k] == i && ij[2 * k + 1] == j) {
            int64_t end = k;
            while (end < h && end < k + BLOCK && ij[2 * end] == i && ij[2 * end + 1] == j)
                end++;
            score_block(&map, &run, stars, magnitude, (int32_t)(end - k), ab + 2 * k, f + k, zero + k, score + k);
            k = end;
        }
    }
    if (more > h)
        more = h;
    if (keep > more)
        keep = more;
    float *value = score + h;
    memcpy(value, score, sizeof(float) * (size_t)h);
    float limit = largest(value, h, more);
    int64_t above = 0, found = 0;
    for (int64_t k = 0; k < h; k++)
        above += score[k] > limit;
    int64_t equal = more - above; /* how many of those at the limit may stay */
    run.i = run.j = -1;
    for (int64_t k = 0; k < h; k++) {
        if (!(score[k] > limit) && !(score[k] == limit && equal-- > 0))
            continue;
        if (few < n) {
            if (ij[2 * k] != run.i || ij[2 * k + 1] != run.j)
                begin_run(&run, n, xy, mixed, ij[2 * k], ij[2 * k + 1], few, n);
            const float *va = stars + 4 * (int64_t)ab[2 * k], *vb = stars + 4 * (int64_t)ab[2 * k + 1];
            score[k] += score_one(&map, &run, va, vb, magnitude, f[k], zero[k]);
        }
        int64_t at = found;
        while (at > 0 && score[k] > score[best[at - 1]])
            at--;
        if (at >= keep)
            continue;
        int64_t last = found < keep ? found++ : keep - 1;
        memmove(best + at + 1, best + at, sizeof(int64_t) * (size_t)(last - at));
        best[at] = k;
    }
    return found;
}
