/* A list of detections made ready: what `prepare` of problem.py does with NumPy. Formulas and ties are those of the twin; only the order
   of sums differs. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static const double TURN = 2.0 * 3.14159265358979323846;

/* The camera, the area of its image, the constants of problem.py, and what distortion.py takes for the inverse. */
typedef struct {
    double centre[2], aspect, focal, distortion[5], area, magnitude_width, crowded, reach, steps, agrees;
} Eye;

typedef struct {
    double magnitude;
    int64_t index;
} Entry;

/* By magnitude, of equals the first first. */
static int brighter(const void *a, const void *b)
{
    const Entry *x = a, *y = b;
    return x->magnitude != y->magnitude ? (x->magnitude > y->magnitude) - (x->magnitude < y->magnitude)
                                        : (x->index > y->index) - (x->index < y->index);
}

/* As `distortion.distort`: x', y' and their derivatives. */
static void distort(const double *k, double x, double y, double *out)
{
    double r2 = x * x + y * y, g = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])), h = 2.0 * (k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]));
    out[0] = x * g + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x);
    out[1] = y * g + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y;
    out[2] = g + h * x * x + 2.0 * k[2] * y + 6.0 * k[3] * x;
    out[3] = out[4] = h * x * y + 2.0 * k[2] * x + 2.0 * k[3] * y;
    out[5] = g + h * y * y + 6.0 * k[2] * y + 2.0 * k[3] * x;
}

/* As `pinhole.ideal_pixels`; 0 where the lens sends no direction. */
static int ideal(const Eye *e, const double *xy, double *p)
{
    double x = xy[0] - e->centre[0], y = (xy[1] - e->centre[1]) * e->aspect, bent = 0.0, to[6];
    for (int k = 0; k < 5; k++)
        bent += fabs(e->distortion[k]);
    p[0] = x, p[1] = y;
    if (bent == 0.0)
        return 1;
    double u = x / e->focal, v = y / e->focal, mu = u, mv = v;
    for (int k = 0; k < (int)e->steps; k++) {
        distort(e->distortion, u, v, to);
        double ex = to[0] - mu, ey = to[1] - mv, det = to[2] * to[5] - to[3] * to[4];
        double du = (to[5] * ex - to[3] * ey) / det, dv = (to[2] * ey - to[4] * ex) / det;
        u -= du, v -= dv;
        double far = hypot(u, v), back = far > e->reach ? e->reach / far : 1.0;
        u *= back, v *= back;
        if (!(fabs(du) + fabs(dv) > 1e-15))
            break;
    }
    distort(e->distortion, u, v, to);
    p[0] = u * e->focal, p[1] = v * e->focal;
    return hypot(to[0] - mu, to[1] - mv) < e->agrees;
}

/* As `_log_density` and `_log_place_density`. */
static void densities(const Eye *e, int64_t n, const double *p, const double *m, double *of_magnitude, double *of_place)
{
    double low = INFINITY, high = -INFINITY, width = 0.5 * sqrt(e->area / (double)n), bright = e->magnitude_width;
    for (int64_t i = 0; i < n; i++)
        of_magnitude[i] = 1.0, of_place[i] = 0.0;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j < i; j++) {
            double dx = p[2 * i] - p[2 * j], dy = p[2 * i + 1] - p[2 * j + 1], far = 0.5 / (width * width) * (dx * dx + dy * dy);
            if (!(far > 50.0)) { /* less is nothing beside one, and far where it is no number */
                double near = exp(-far);
                of_place[i] += near, of_place[j] += near;
            }
            if (m != NULL) {
                double z = (m[i] - m[j]) / bright, alike = exp(-0.5 * z * z);
                of_magnitude[i] += alike, of_magnitude[j] += alike;
            }
        }
        if (m != NULL)
            low = m[i] < low ? m[i] : low, high = m[i] > high ? m[i] : high;
    }
    for (int64_t i = 0; i < n; i++) {
        double smooth = of_magnitude[i] / (double)n / (bright * sqrt(TURN)), even = 1.0 / (high - low + 2.0 * bright);
        of_magnitude[i] = m == NULL ? 0.0 : log(0.5 * smooth + 0.5 * even);
        double others = n < 2 ? 1.0 / e->area : 0.5 / e->area + 0.5 * of_place[i] / ((double)n - 1.0) / (TURN * width * width);
        of_place[i] = log(others) + log((double)n + 1.0);
    }
}

/* Number k of the detections that count, at most `most`: their places in the list, order (k,), and one after the other in `out` xy
   (k, 2), sigma, log density of places and of magnitudes (k,), vacancy (k + 1,), magnitude (k,), which is how verify.c reads them, and
   covariance (k, 2, 2). xy (n, 2), C (n, 2, 2) and m (n,), NULL where brightness is unknown. -1 where there is no memory. */
int64_t helmstar_prepare(
    int64_t n, const double *xy, const double *C, const double *m, const Eye *e, int64_t most, int64_t *order, double *out)
{
    int64_t listed = 0, count = 0;
    Entry *entry = malloc(sizeof(Entry) * (size_t)(n + 1));
    double *p = malloc(sizeof(double) * (size_t)(2 * most + 1));
    if (entry == NULL || p == NULL) {
        free(entry);
        free(p);
        return -1;
    }
    for (int64_t k = 0; k < n; k++) {
        const double *c = C + 4 * k;
        double a = c[0], b = c[1] * e->aspect, d = c[3] * e->aspect * e->aspect;
        int good = isfinite(xy[2 * k]) && isfinite(xy[2 * k + 1]) && isfinite(a) && isfinite(b) && isfinite(d)
            && isfinite(c[2] * e->aspect) && a > 0.0 && a * d > b * b && (m == NULL || isfinite(m[k]));
        if (good)
            entry[listed++] = (Entry){m == NULL ? 0.0 : m[k], k};
    }
    qsort(entry, (size_t)listed, sizeof(Entry), brighter);
    for (int64_t k = 0; k < listed && count < most; k++) {
        double *at = p + 2 * count;
        int alone = ideal(e, xy + 2 * entry[k].index, at);
        for (int64_t j = 0; j < count && alone; j++)
            alone = !(fabs(p[2 * j] - at[0]) < e->crowded && fabs(p[2 * j + 1] - at[1]) < e->crowded);
        if (alone)
            order[count++] = entry[k].index;
    }
    double *sigma = out + 2 * count, *places = sigma + count, *vacancy = places + 2 * count, *magnitude = vacancy + count + 1;
    double *cov = magnitude + count;
    vacancy[0] = 0.0;
    for (int64_t k = 0; k < count; k++)
        vacancy[k + 1] = vacancy[k] + log(((double)count + 1.0) / (double)(count - k));
    memcpy(out, p, sizeof(double) * (size_t)(2 * count));
    for (int64_t k = 0; k < count; k++) {
        const double *c = C + 4 * order[k];
        cov[4 * k] = c[0], cov[4 * k + 1] = c[1] * e->aspect;
        cov[4 * k + 2] = c[2] * e->aspect, cov[4 * k + 3] = c[3] * e->aspect * e->aspect;
        sigma[k] = sqrt(0.5 * (cov[4 * k] + cov[4 * k + 3]));
        magnitude[k] = m == NULL ? 0.0 : m[order[k]];
    }
    densities(e, count, out, m == NULL ? NULL : magnitude, places + count, places);
    free(entry);
    free(p);
    return count;
}
