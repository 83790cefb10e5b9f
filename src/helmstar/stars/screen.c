/* A first weighing of hypotheses: what screen.py does with NumPy, one hypothesis after the other. */
#include "sky.h"

#include <stdlib.h>
#include <string.h>

#define MOST 128 /* detections */

/* What all hypotheses are weighed against; as in verify.Detections, verify.Freedom and screen.Raster. */
typedef struct {
    int64_t n, rows, columns, most, members, stars;
    double low[2], high[2], corner[2], cell, magnitude_sigma, zero_point, faintest;
    double f_low, f_high, f_known, f_sigma, gate, first_gate, second_gate, volume, zero_point_range;
    double broad_share, broad_sigma;
    const double *xy, *sigma, *magnitude, *log_magnitude_density, *log_density, *vacancy, *log_factorial, *harmonic;
    const double *directions, *V;        /* of the catalogue: (stars, 3), (stars,) */
    const int64_t *member;               /* of the level, by declination: (members,) and their directions (members, 3) */
    const double *member_directions;
    const int32_t *cells;                /* (rows columns + 1,) */
} Screen;

typedef struct {
    int64_t star, rank, j;
    double x, y, dx, dy, square;
} Match;

static int rising(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static int by_rank(const void *a, const void *b)
{
    int64_t x = ((const Match *)a)->rank, y = ((const Match *)b)->rank;
    return (x > y) - (x < y);
}

static double within(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

/* Catalogue stars in a circle around the image, the brightest first: as `stars_near`. */
static int64_t stars_near(const Screen *s, const double *R, double f, uint64_t *marks, int64_t *found)
{
    Members all = {s->members, s->stars, s->member, s->member_directions};
    double mx = 0.5 * (s->low[0] + s->high[0]), my = 0.5 * (s->low[1] + s->high[1]), axis[3], norm = 0.0;
    for (int c = 0; c < 3; c++) {
        axis[c] = R[c] * mx + R[3 + c] * my + R[6 + c] * f;
        norm += axis[c] * axis[c];
    }
    for (int c = 0; c < 3; c++)
        axis[c] /= sqrt(norm);
    double hx = 0.5 * (s->high[0] - s->low[0]), hy = 0.5 * (s->high[1] - s->low[1]);
    return in_circle(&all, axis, 1.03 * atan(sqrt(hx * hx + hy * hy) / f), NULL, marks, found);
}

/* Matches under one attitude, each detection with the nearest of the stars that find it; *expected: stars seen. */
static int64_t match(
    const Screen *s, const double *R, double f, double gate, const int64_t *star, int64_t stars, Match *out, int64_t *expected)
{
    int64_t owner[MOST], rank = 0, count = 0;
    double far = gate * s->gate * gate * s->gate;
    for (int64_t j = 0; j < s->n; j++)
        owner[j] = -1;
    for (int64_t k = 0; k < stars && rank < s->most; k++) {
        const double *r = s->directions + 3 * star[k];
        double z = R[6] * r[0] + R[7] * r[1] + R[8] * r[2], scale = f / (z > 1e-3 ? z : 1e-3);
        double x = (R[0] * r[0] + R[1] * r[1] + R[2] * r[2]) * scale, y = (R[3] * r[0] + R[4] * r[1] + R[5] * r[2]) * scale;
        if (!(z > 1e-3 && x >= s->low[0] && x <= s->high[0] && y >= s->low[1] && y <= s->high[1] && s->faintest >= s->V[star[k]]))
            continue;
        int64_t own = rank++;
        double column = floor((x - s->corner[0]) / s->cell), row = floor((y - s->corner[1]) / s->cell);
        if (!(column >= 0 && column < (double)s->columns && row >= 0 && row < (double)s->rows))
            continue;
        int64_t j = s->cells[(int64_t)row * s->columns + (int64_t)column];
        if (j < 0 || j >= s->n)
            continue;
        double dx = s->xy[2 * j] - x, dy = s->xy[2 * j + 1] - y;
        double square = (dx * dx + dy * dy) / (s->sigma[j] * s->sigma[j]);
        if (!(square <= far) || (owner[j] >= 0 && !(square < out[owner[j]].square)))
            continue;
        int64_t at = owner[j] >= 0 ? owner[j] : count++;
        owner[j] = at;
        out[at] = (Match){star[k], own, j, x, y, dx, dy, square};
    }
    *expected = rank;
    /* A detection that a nearer star took over stands where it was first found. */
    qsort(out, (size_t)count, sizeof(Match), by_rank);
    return count;
}

/* Adds one match to the information (4, 4), lower half, and the right side (4,) of (theta, ln f). */
static void add(double x, double y, double f, double sigma, double dx, double dy, double A[4][4], double g[4])
{
    double w = f / sigma, J[2][4] = {{-x * y * w, (1.0 + x * x) * w, -y * w, x * w}, {-(1.0 + y * y) * w, x * y * w, x * w, y * w}};
    dx /= sigma, dy /= sigma;
    for (int r = 0; r < 4; r++) {
        g[r] += J[0][r] * dx + J[1][r] * dy;
        for (int c = 0; c <= r; c++)
            A[r][c] += J[0][r] * J[0][c] + J[1][r] * J[1][c];
    }
}

/* Cholesky's factor in place of the lower half; the log of the determinant, NaN where it is not positive. */
static double factor(double A[4][4])
{
    double logarithm = 0.0;
    for (int c = 0; c < 4; c++) {
        for (int k = 0; k < c; k++)
            A[c][c] -= A[c][k] * A[c][k];
        if (!(A[c][c] > 0.0))
            return NAN;
        A[c][c] = sqrt(A[c][c]);
        logarithm += 2.0 * log(A[c][c]);
        for (int r = c + 1; r < 4; r++) {
            for (int k = 0; k < c; k++)
                A[r][c] -= A[r][k] * A[c][k];
            A[r][c] /= A[c][c];
        }
    }
    return logarithm;
}

static int free_focal(const Screen *s) { return !(s->f_known > 0.0); }

static double focal_weight(const Screen *s)
{
    double sigma = s->f_sigma > 1e-6 ? s->f_sigma : 1e-6;
    return 1.0 / (sigma * sigma);
}

/* Gauss and Newton's step of R and f from the matches. */
static void step(const Screen *s, const Match *m, int64_t count, double *R, double *f)
{
    double A[4][4] = {{0.0}}, g[4] = {0.0}, trace = 0.0;
    for (int64_t k = 0; k < count; k++) {
        double pull = m[k].square / (4.0 * s->first_gate * s->first_gate);
        add(m[k].x / *f, m[k].y / *f, *f, s->sigma[m[k].j] * sqrt(1.0 + pull), m[k].dx, m[k].dy, A, g);
    }
    if (!free_focal(s)) {
        A[3][3] += focal_weight(s);
        g[3] += log(s->f_known / *f) * focal_weight(s);
    }
    for (int r = 0; r < 4; r++)
        trace += A[r][r];
    for (int r = 0; r < 4; r++)
        A[r][r] += 1e-12 * trace + 1e-9;
    if (count < 2 || isnan(factor(A)))
        memset(g, 0, sizeof g);
    else {
        for (int r = 0; r < 4; r++) {
            for (int k = 0; k < r; k++)
                g[r] -= A[r][k] * g[k];
            g[r] /= A[r][r];
        }
        for (int r = 3; r >= 0; r--) {
            for (int k = r + 1; k < 4; k++)
                g[r] -= A[k][r] * g[k];
            g[r] /= A[r][r];
        }
    }
    double t = sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]), a = t > 1e-12 ? sin(t) / t : 1.0;
    double half = t > 1e-12 ? sin(0.5 * t) / (0.5 * t) : 1.0, b = 0.5 * half * half;
    double K[3][3] = {{0.0, -g[2], g[1]}, {g[2], 0.0, -g[0]}, {-g[1], g[0], 0.0}}, T[3][3], out[9];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            T[r][c] = (r == c) + a * K[r][c] + b * (K[r][0] * K[0][c] + K[r][1] * K[1][c] + K[r][2] * K[2][c]);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            out[3 * r + c] = T[r][0] * R[c] + T[r][1] * R[3 + c] + T[r][2] * R[6 + c];
    memcpy(R, out, sizeof out);
    *f = within(*f * exp(within(g[3], -0.1, 0.1)), 0.97 * s->f_low, 1.03 * s->f_high);
}

/* As `magnitude_gain`. */
static double magnitude_gain(const Screen *s, double V, int64_t j, double zero)
{
    double d = V - s->magnitude[j] - zero, square = d * d, sigma = s->magnitude_sigma;
    double density = (1.0 - s->broad_share) / sigma * exp(-0.5 / (sigma * sigma) * square)
        + s->broad_share / s->broad_sigma * exp(-0.5 / (s->broad_sigma * s->broad_sigma) * square);
    return log(density / sqrt(2.0 * 3.14159265358979323846) + 1e-6) - s->log_magnitude_density[j];
}

/* As `verify.log_odds`. */
static double log_odds(const Screen *s, const double *gain, const int64_t *rank, int64_t count, int64_t expected)
{
    double total[512], sum = 0.0, top = -INFINITY, all = 0.0;
    int64_t k = 0;
    for (int64_t depth = 1; depth <= expected; depth++) {
        while (k < count && rank[k] < depth)
            sum += gain[k++];
        total[depth] = sum + s->vacancy[k] + s->log_factorial[k] + s->log_factorial[depth - k] - s->log_factorial[depth + 1];
        top = total[depth] > top ? total[depth] : top;
    }
    for (int64_t depth = 1; depth <= expected; depth++)
        all += exp(total[depth] - top) / (double)depth;
    return top + log(all / s->harmonic[expected]);
}

/* Log odds of what matches after the step; -inf where fewer than two speak for it. */
static double weigh(const Screen *s, const Match *m, int64_t count, double f, int64_t expected)
{
    double dm[MOST], gain[MOST], A[4][4] = {{0.0}}, g[4] = {0.0}, zero = isnan(s->zero_point) ? 0.0 : s->zero_point, price = 0.0;
    int64_t rank[MOST], good = 0;
    if (s->magnitude != NULL && isnan(s->zero_point) && count > 0) {
        for (int64_t k = 0; k < count; k++)
            dm[k] = s->V[m[k].star] - s->magnitude[m[k].j];
        qsort(dm, (size_t)count, sizeof(double), rising);
        zero = dm[count / 2];
    }
    for (int64_t k = 0; k < count; k++) {
        int64_t j = m[k].j;
        double sigma = s->sigma[j];
        double value = -0.5 * m[k].square - log(2.0 * 3.14159265358979323846 * sigma * sigma) - s->log_density[j];
        if (s->magnitude != NULL)
            value += magnitude_gain(s, s->V[m[k].star], j, zero);
        if (!(value > 0.0))
            continue;
        gain[good] = value, rank[good] = m[k].rank;
        good++;
        add(m[k].x / f, m[k].y / f, f, sigma, 0.0, 0.0, A, g);
    }
    if (good < 2)
        return -INFINITY;
    if (!free_focal(s))
        A[3][3] += focal_weight(s);
    double determinant = factor(A);
    if (isnan(determinant))
        return -INFINITY;
    double left = 0.5 * (4.0 * log(2.0 * 3.14159265358979323846) - determinant) - log(s->volume);
    if (s->magnitude != NULL && isnan(s->zero_point)) {
        double share = sqrt(2.0 * 3.14159265358979323846) * 1.25 * s->magnitude_sigma / sqrt((double)good) / s->zero_point_range;
        price = log(share < 1.0 ? share : 1.0);
    }
    return log_odds(s, gain, rank, good, expected) + price + (left < 0.0 ? left : 0.0);
}

/* Log odds (h,) of hypotheses R (h, 3, 3), f (h,) after one step, which is written over R and f. 0, or -1 where sizes are out of
   range or there is no memory. The caller sees to it that members are stars. */
int64_t helmstar_screen(const Screen *s, int64_t h, double *R, double *f, double *odds)
{
    Match m[MOST];
    if (s->n < 1 || s->n > MOST || s->most > 390 || s->members < 0)
        return -1;
    int64_t *star = malloc(sizeof(int64_t) * (size_t)(s->members + 1));
    uint64_t *marks = calloc((size_t)words(s->stars), sizeof(uint64_t));
    if (star == NULL || marks == NULL) {
        free(star);
        free(marks);
        return -1;
    }
    for (int64_t k = 0; k < h; k++) {
        int64_t expected, stars = stars_near(s, R + 9 * k, f[k], marks, star);
        int64_t count = match(s, R + 9 * k, f[k], s->first_gate, star, stars, m, &expected);
        step(s, m, count, R + 9 * k, f + k);
        count = match(s, R + 9 * k, f[k], s->second_gate, star, stars, m, &expected);
        odds[k] = weigh(s, m, count, f[k], expected);
    }
    free(star);
    free(marks);
    return 0;
}
