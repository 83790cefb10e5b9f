/* The star fit of centroid.py for many windows in one call, eight stars side by side: the twin of `fit`, with the same model, prior,
   steps and stop rule, in single precision as there. What NumPy does array by array stays in registers here. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "../native.h"
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic ignored "-Wpsabi" /* vectors are passed only between functions of this file that are inlined */
#endif

#define LANES 8
#define MOST 35 /* widest window */
#define STILL 0.02f
#define MIN_SIGMA 0.3f

typedef float lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t marks __attribute__((vector_size(4 * LANES)));

INLINE lanes all(float a) { return (lanes){a, a, a, a, a, a, a, a}; }
INLINE lanes where(marks m, lanes a, lanes b) { return (lanes)((m & (marks)a) | (~m & (marks)b)); }
INLINE lanes most(lanes a, lanes b) { return where(a > b, a, b); }
INLINE lanes least(lanes a, lanes b) { return where(a < b, a, b); }
INLINE lanes clipped(lanes a, float low, float high) { return least(most(a, all(low)), all(high)); }
INLINE lanes magnitude(lanes a) { return (lanes)((marks)a & 0x7fffffff); }
INLINE lanes root(lanes a) {
    for (int l = 0; l < LANES; l++) a[l] = sqrtf(a[l]);
    return a;
}

/* e^x for x <= 0, to two units of the last place: a polynomial between powers of two. */
INLINE lanes exponential(lanes x) {
    x = most(x, all(-87.0f));
    lanes shifted = x * 1.44269504f + 12582912.0f, n = shifted - 12582912.0f; /* 1.5 x 2^23 rounds to whole numbers */
    lanes r = x - n * 0.693359375f + n * 2.12194440e-4f;
    lanes p = r * 1.9875691500e-4f + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 0.5f;
    p = p * r * r + r + 1.0f;
    return p * (lanes)((((marks)shifted - 0x4b400000) + 127) << 23);
}

/* Along one axis: the share of a Gaussian in each pixel and its derivatives by centre and by width. */
typedef struct {
    lanes share[MOST], centre[MOST], width[MOST];
} Factors;

INLINE void factors(Factors *f, lanes centre, lanes width, int m) {
    lanes inverse = all(1.0f) / width, scale = inverse * 0.398942280f;
    lanes tail_before = all(0), bell_before = all(0), by_before = all(0);
    for (int i = 0; i <= m; i++) {
        lanes t = (all((float)i - 0.5f * (float)m) - centre) * inverse;
        lanes bell = exponential(t * t * -0.5f);
        /* Abramowitz and Stegun 7.1.26 */
        lanes k = all(1.0f) / (magnitude(t) * 0.231641889f + 1.0f);
        lanes tail = k * 1.061405429f;
        tail = (tail + -1.453152027f) * k;
        tail = (tail + 1.421413741f) * k;
        tail = (tail + -0.284496736f) * k;
        tail = (tail + 0.254829592f) * k;
        tail = 1.0f - tail * bell;
        tail = (lanes)((marks)tail | ((marks)t & (int32_t)0x80000000)) * 0.5f;
        bell *= scale;
        lanes by = bell * t;
        if (i) {
            f->share[i - 1] = tail - tail_before;
            f->centre[i - 1] = bell_before - bell;
            f->width[i - 1] = by_before - by;
        }
        tail_before = tail, bell_before = bell, by_before = by;
    }
}

/* Sums over pixels of products of two rows (share, one, centre, width) with a weight: (4, 4). */
INLINE void products(lanes G[4][4], const Factors *f, int m, int by_share) {
    for (int a = 0; a < 4; a++)
        for (int b = 0; b < 4; b++) G[a][b] = all(0);
    for (int i = 0; i < m; i++) {
        lanes row[4] = {f->share[i], all(1.0f), f->centre[i], f->width[i]};
        lanes weight = by_share ? f->share[i] : all(1.0f);
        for (int a = 0; a < 4; a++)
            for (int b = a; b < 4; b++) G[a][b] += weight * row[a] * row[b];
    }
    for (int a = 0; a < 4; a++)
        for (int b = 0; b < a; b++) G[a][b] = G[b][a];
}

/* Which rows make a column of the Jacobian: flux, sky, x, y, width along x, width along y. */
static const int ALONG_Y[6] = {0, 1, 0, 2, 0, 3}, ALONG_X[6] = {0, 1, 2, 0, 3, 0};

INLINE void outer(lanes A[6][6], lanes Gx[4][4], lanes Gy[4][4]) {
    for (int a = 0; a < 6; a++)
        for (int b = 0; b < 6; b++) A[a][b] = Gy[ALONG_Y[a]][ALONG_Y[b]] * Gx[ALONG_X[a]][ALONG_X[b]];
}

INLINE void normal(lanes A[6][6], const Factors *fx, const Factors *fy, lanes prior[6], int m) {
    lanes Gx[4][4], Gy[4][4];
    products(Gx, fx, m, 0), products(Gy, fy, m, 0);
    outer(A, Gx, Gy);
    for (int a = 0; a < 6; a++) A[a][a] = (A[a][a] + prior[a]) * (1.0f + 1e-6f);
}

/* A = L D L^T; D is kept above rounding, so nothing is ever divided by zero. */
INLINE void decompose(lanes A[6][6], lanes L[6][6], lanes inverse[6]) {
    lanes D[6];
    for (int j = 0; j < 6; j++) {
        lanes d = A[j][j];
        for (int k = 0; k < j; k++) d -= L[j][k] * L[j][k] * D[k];
        D[j] = most(d, A[j][j] * 1e-7f + 1e-30f);
        inverse[j] = all(1.0f) / D[j];
        for (int i = j + 1; i < 6; i++) {
            lanes v = A[i][j];
            for (int k = 0; k < j; k++) v -= L[i][k] * L[j][k] * D[k];
            L[i][j] = v * inverse[j];
        }
    }
}

INLINE void substitute(lanes L[6][6], lanes inverse[6], lanes b[6]) {
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < i; k++) b[i] -= L[i][k] * b[k];
    for (int i = 0; i < 6; i++) b[i] *= inverse[i];
    for (int i = 5; i >= 0; i--)
        for (int k = i + 1; k < 6; k++) b[i] -= L[k][i] * b[k];
}

/* windows (n, m, m), x, y, sky, noise (n,), filled (n, m, m) bytes; width (2,).
   Out: p (n, 6) flux, sky above the first guess, x, y, sigma_x, sigma_y; bread, light (n, 6, 6); residual, model (n, m, m); sums (n, 4)
   of the model, its square, the residual's square, and of the light that the fit took. Returns 0; 1 for windows of a side that it does not take. */
FAST int helmstar_fit(
    const float *windows, const float *x, const float *y, const float *sky, const float *noise, const uint8_t *filled,
    int64_t n, int m, const double *width, double tight, int iterations, double *p_out, float *bread, float *light,
    float *residual, float *model, float *sums) {
    if (m < 1 || m > MOST || m % 2 == 0) return 1;
    const int pixels = m * m;
    const float half = (float)(m / 2);
    const float furthest = half > 9.0f ? half / 18.0f : 0.5f;
    const float wx = (float)width[0], wy = (float)width[1];
    for (int64_t first = 0; first < n; first += LANES) {
        const int some = n - first < LANES ? (int)(n - first) : LANES;
        lanes data[MOST * MOST], p[6], noisy;
        marks open[MOST * MOST];
        for (int l = 0; l < LANES; l++) { /* the last star fills what lanes are left */
            const int64_t s = first + (l < some ? l : some - 1);
            for (int i = 0; i < pixels; i++) {
                data[i][l] = windows[s * pixels + i] - sky[s];
                open[i][l] = filled[s * pixels + i] ? 0 : -1;
            }
            p[2][l] = x[s], p[3][l] = y[s], noisy[l] = noise[s];
        }
        lanes total = all(0);
        for (int i = 0; i < pixels; i++) total += (lanes)((marks)data[i] & open[i]);
        p[0] = most(total, most(noisy, all(1e-6f)));
        p[1] = all(0), p[4] = all(wx), p[5] = all(wy);
        const lanes expected[6] = {all(0), all(0), all(0), all(0), all(wx), all(wy)};
        const lanes spread[2] = {
            most(noisy, all(1e-9f)) / (float)(tight * width[0]), most(noisy, all(1e-9f)) / (float)(tight * width[1])};
        Factors fx, fy;
        lanes A[6][6], L[6][6], inverse[6], prior[6];
        marks going = {-1, -1, -1, -1, -1, -1, -1, -1};
        for (int k = 0; k < iterations; k++) {
            const lanes flux = p[0];
            factors(&fx, p[2], p[4], m), factors(&fy, p[3], p[5], m);
            prior[0] = prior[2] = prior[3] = all(0), prior[1] = all(2.0f * (float)m);
            for (int a = 0; a < 2; a++) prior[4 + a] = (spread[a] / flux) * (spread[a] / flux);
            normal(A, &fx, &fy, prior, m);
            lanes g[6] = {all(0), all(0), all(0), all(0), all(0), all(0)};
            for (int i = 0; i < m; i++) {
                const lanes bright = flux * fy.share[i];
                lanes by_share = all(0), by_one = all(0), by_centre = all(0), by_width = all(0);
                for (int j = 0; j < m; j++) {
                    lanes rest = data[i * m + j] - bright * fx.share[j] - p[1];
                    rest = (lanes)((marks)rest & open[i * m + j]);
                    by_share += rest * fx.share[j], by_one += rest;
                    by_centre += rest * fx.centre[j], by_width += rest * fx.width[j];
                }
                g[0] += fy.share[i] * by_share, g[1] += by_one, g[2] += fy.share[i] * by_centre;
                g[3] += fy.centre[i] * by_share, g[4] += fy.share[i] * by_width, g[5] += fy.width[i] * by_share;
            }
            for (int a = 0; a < 6; a++) {
                lanes away = expected[a] - p[a];
                if (a == 1) away /= flux;
                g[a] = g[a] / flux + prior[a] * away;
            }
            decompose(A, L, inverse);
            substitute(L, inverse, g);
            for (int a = 0; a < 6; a++) {
                lanes next = p[a] + (a < 2 ? g[a] * flux : clipped(g[a], -furthest, furthest));
                if (a == 0) next = most(next, flux * 0.1f);
                if (a == 2 || a == 3) next = clipped(next, -half, half);
                if (a > 3) next = clipped(next, MIN_SIGMA, half);
                p[a] = where(going, next, p[a]);
            }
            if (k) {
                const lanes bound = noisy * 0.1f / (flux * root(least(A[2][2], A[3][3])));
                const lanes step = least(most(magnitude(g[2]), magnitude(g[3])), all(furthest));
                going &= step > most(bound, all(STILL));
                int any = 0;
                for (int l = 0; l < LANES; l++) any |= going[l];
                if (!any) break;
            }
        }
        factors(&fx, p[2], p[4], m), factors(&fy, p[3], p[5], m);
        prior[0] = prior[2] = prior[3] = all(0), prior[1] = all(2.0f * (float)m);
        for (int a = 0; a < 2; a++) prior[4 + a] = (spread[a] / p[0]) * (spread[a] / p[0]);
        normal(A, &fx, &fy, prior, m);
        decompose(A, L, inverse);
        lanes B[6][6];
        for (int a = 0; a < 6; a++) {
            lanes column[6];
            for (int b = 0; b < 6; b++) column[b] = all(a == b ? 1.0f : 0.0f);
            substitute(L, inverse, column);
            for (int b = 0; b < 6; b++)
                for (int l = 0; l < some; l++) bread[(first + l) * 36 + 6 * b + a] = column[b][l];
            for (int b = 0; b < 6; b++) B[b][a] = column[b];
        }
        lanes Gx[4][4], Gy[4][4], taken = all(0), sum = all(0), square = all(0), left = all(0);
        products(Gx, &fx, m, 1), products(Gy, &fy, m, 1);
        outer(A, Gx, Gy);
        for (int a = 0; a < 36; a++) taken += B[a / 6][a % 6] * A[a / 6][a % 6];
        for (int l = 0; l < some; l++)
            for (int a = 0; a < 36; a++) light[(first + l) * 36 + a] = A[a / 6][a % 6][l];
        for (int i = 0; i < m; i++) {
            const lanes bright = p[0] * fy.share[i];
            for (int j = 0; j < m; j++) {
                const int at = i * m + j;
                const lanes shine = bright * fx.share[j];
                const lanes rest = (lanes)((marks)(data[at] - shine - p[1]) & open[at]);
                sum += shine, square += shine * shine, left += rest * rest;
                for (int l = 0; l < some; l++) {
                    model[(first + l) * pixels + at] = shine[l];
                    residual[(first + l) * pixels + at] = rest[l];
                }
            }
        }
        const lanes told[4] = {sum, square, left, taken * p[0]};
        for (int l = 0; l < some; l++) {
            for (int a = 0; a < 6; a++) p_out[(first + l) * 6 + a] = (double)p[a][l];
            for (int a = 0; a < 4; a++) sums[(first + l) * 4 + a] = told[a][l];
        }
    }
    return 0;
}
