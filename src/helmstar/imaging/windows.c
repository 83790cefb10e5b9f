/* What is around places of an image: the twin of `windows` of windows.py, and of the small windows that detect.py looks at before.
   Images are uint8 (type 0), uint16 (1) or float32 (2); beyond an edge it is repeated, so no place is ever read outside. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "../native.h"

#define LANES 8
#define BORDER 2
#define MOST_HALF 17
#define MOST (2 * (MOST_HALF + BORDER) + 1)
#define MOST_RING (MOST * MOST - (MOST - 2 * BORDER) * (MOST - 2 * BORDER))
#define SECTORS 8

void helmstar_sort_lanes(float *v, int n);

INLINE int64_t inside(int64_t at, int64_t size) { return at < 0 ? 0 : at >= size ? size - 1 : at; }

/* The window (2 half + 1)^2 around a place, edges repeated. */
INLINE void around(const void *data, int type, int64_t h, int64_t w, int64_t x, int64_t y, int64_t half, float *out) {
    const int64_t m = 2 * half + 1;
    const int whole = x >= half && x < w - half;
    for (int64_t i = 0; i < m; i++, out += m) {
        const int64_t row = inside(y - half + i, h) * w;
        if (type == 0) {
            const uint8_t *a = (const uint8_t *)data + row;
            if (whole) for (int64_t j = 0; j < m; j++) out[j] = (float)a[x - half + j];
            else for (int64_t j = 0; j < m; j++) out[j] = (float)a[inside(x - half + j, w)];
        } else if (type == 1) {
            const uint16_t *a = (const uint16_t *)data + row;
            if (whole) for (int64_t j = 0; j < m; j++) out[j] = (float)a[x - half + j];
            else for (int64_t j = 0; j < m; j++) out[j] = (float)a[inside(x - half + j, w)];
        } else {
            const float *a = (const float *)data + row;
            if (whole) for (int64_t j = 0; j < m; j++) out[j] = a[x - half + j];
            else for (int64_t j = 0; j < m; j++) out[j] = a[inside(x - half + j, w)];
        }
    }
}

/* Pixels of the ring in the order of rows, and the steps along its outermost rows and columns. */
typedef struct {
    int ring[MOST_RING], n, from[4 * MOST], to[4 * MOST], steps;
} Ring;

static void ring_of(Ring *r, int half) {
    const int m = 2 * (half + BORDER) + 1;
    r->n = r->steps = 0;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++)
            if (i < BORDER || j < BORDER || i >= m - BORDER || j >= m - BORDER) r->ring[r->n++] = i * m + j;
    for (int k = 0; k < m - 1; k++) {
        const int from[4] = {k, (m - 1) * m + k, k * m, k * m + m - 1};
        const int to[4] = {k + 1, (m - 1) * m + k + 1, (k + 1) * m, (k + 1) * m + m - 1};
        for (int e = 0; e < 4; e++, r->steps++) r->from[r->steps] = from[e], r->to[r->steps] = to[e];
    }
}

/* Whether a place lies on a ridge or at the edge of something large: in_structure of windows.py. */
INLINE int in_structure(
    const float *ring, const int *sector, int n, const float *above, int half, float sky, float grain) {
    const int m = 2 * half + 1;
    float peak = 0.0f, most[SECTORS];
    double sum[SECTORS] = {0};
    int count[SECTORS] = {0}, large = 0;
    for (int i = half - 1; i <= half + 1; i++)
        for (int j = half - 1; j <= half + 1; j++)
            if (above[i * m + j] > peak) peak = above[i * m + j];
    for (int k = 0; k < SECTORS; k++) most[k] = -INFINITY;
    for (int i = 0; i < n; i++) {
        const int k = sector[i] & (SECTORS - 1);
        const float v = ring[i] - sky;
        if (v > most[k]) most[k] = v;
        sum[k] += (double)v, count[k]++;
    }
    for (int k = 0; k < SECTORS / 2; k++) {
        const float both = most[k] < most[k + 4] ? most[k] : most[k + 4];
        if (both > 0.3f * peak + 3.5f * grain) return 1;
    }
    for (int k = 0; k < SECTORS; k++)
        if (count[k] && fabs(sum[k] / count[k]) > (double)(0.2f * peak + grain)) large++;
    return large >= 3;
}

/* Windows of half a side `half` (2 to 17) around places x, y (n,) that are in the image (h, w); floor (n,) least noise; full: value
   from which a pixel holds no more; sector: direction 0 to 7 of each of `ring` pixels of the ring; at: places among the ring's
   sorted pixels where the sky's mean begins and ends and of the noise's low and high, and among the sorted steps that of the grain.
   Out: inner, above (n, m, m), full and filled (n, m, m) bytes, sky, noise, grain, x0, y0 (n,), structure (n,) bytes.
   Returns 0; 1 for what it does not take. */
FAST int helmstar_windows(
    const void *data, int type, int64_t h, int64_t w, const int64_t *x, const int64_t *y, const float *floor, int64_t n, int half,
    float saturated, const int *sector, int ring, const int *at, float *inner, float *above, uint8_t *full, uint8_t *filled,
    float *sky, float *noise, float *grain, float *x0, float *y0, uint8_t *structure) {
    if (type < 0 || type > 2 || half < 2 || half > MOST_HALF) return 1;
    Ring r;
    ring_of(&r, half);
    const int reach = half + BORDER, side = 2 * reach + 1, m = 2 * half + 1, pixels = m * m;
    if (ring != r.n || at[0] < 0 || at[1] > r.n || at[0] >= at[1] || at[4] < 0 || at[4] >= r.steps) return 1;
    if (at[2] < 0 || at[2] >= r.n || at[3] < 0 || at[3] >= r.n) return 1;
    float window[LANES][MOST * MOST], v[MOST_RING][LANES], steps[4 * MOST][LANES];
    for (int64_t first = 0; first < n; first += LANES) {
        const int some = n - first < LANES ? (int)(n - first) : LANES;
        for (int l = 0; l < LANES; l++) {
            float *a = window[l];
            if (l < some)
                around(data, type, h, w, x[first + l], y[first + l], reach, a);
            else
                memcpy(a, window[0], (size_t)(side * side) * sizeof *a);
            for (int i = 0; i < r.n; i++) v[i][l] = a[r.ring[i]];
            for (int i = 0; i < r.steps; i++) steps[i][l] = fabsf(a[r.to[i]] - a[r.from[i]]);
        }
        helmstar_sort_lanes(&v[0][0], r.n);
        helmstar_sort_lanes(&steps[0][0], r.steps);
        for (int l = 0; l < some; l++) {
            const int64_t s = first + l, cx = x[s], cy = y[s];
            const float *a = window[l];
            double sum = 0.0;
            for (int i = at[0]; i < at[1]; i++) sum += (double)v[i][l];
            const float dark = (float)(sum / (at[1] - at[0]));
            float rough = (v[at[3]][l] - v[at[2]][l]) / 2.0f, fine = steps[at[4]][l] / 1.41421356f;
            if (!(rough > floor[s])) rough = floor[s];
            if (!(fine > floor[s])) fine = floor[s];
            if (!(fine < rough)) fine = rough;
            sky[s] = dark, noise[s] = rough, grain[s] = fine;
            const int edge = cx < reach || cy < reach || cx >= w - reach || cy >= h - reach;
            float *in = inner + s * pixels, *up = above + s * pixels;
            uint8_t *f = full + s * pixels, *g = filled + s * pixels;
            for (int i = 0; i < m; i++)
                for (int j = 0; j < m; j++) {
                    const int64_t px = cx - half + j, py = cy - half + i;
                    const int off = edge && (px < 0 || py < 0 || px >= w || py >= h), k = i * m + j;
                    const float value = a[(i + BORDER) * side + j + BORDER], rise = value - dark;
                    in[k] = value;
                    up[k] = rise > 0.0f && !off ? rise : 0.0f;
                    f[k] = value >= saturated;
                    g[k] = f[k] | off;
                }
            double total = 0.0, along_x = 0.0, along_y = 0.0;
            for (int i = -2; i <= 2; i++)
                for (int j = -2; j <= 2; j++) {
                    const double light = (double)up[(half + i) * m + half + j] + 1e-9;
                    total += light, along_x += j * light, along_y += i * light;
                }
            x0[s] = (float)(along_x / total), y0[s] = (float)(along_y / total);
            float around_it[MOST_RING];
            for (int i = 0; i < r.n; i++) {
                const int64_t px = cx - reach + r.ring[i] % side, py = cy - reach + r.ring[i] / side;
                const int off = edge && (px < 0 || py < 0 || px >= w || py >= h);
                around_it[i] = off ? dark : a[r.ring[i]]; /* what an edge repeats is no structure */
            }
            structure[s] = (uint8_t)in_structure(around_it, sector, r.n, up, half, dark, fine);
        }
    }
    return 0;
}

/* Which peaks (n,) of an image have light beside their brightest pixel, both ways: _wider_than_a_pixel of detect.py.
   Out: bytes. Returns 0; 1 for no known type. */
int helmstar_wider(
    const void *data, int type, int64_t h, int64_t w, const int64_t *x, const int64_t *y, const float *excess, const float *noise,
    int64_t n, float quantum, uint8_t *out) {
    static const float weights[3] = {1.0f, 2.0f, 1.0f};
    if (type < 0 || type > 2) return 1;
    for (int64_t s = 0; s < n; s++) {
        float a[25], f = 0.0f;
        around(data, type, h, w, x[s], y[s], 2, a);
        int brightest = 6;
        for (int i = 1; i < 4; i++)
            for (int j = 1; j < 4; j++) {
                f += weights[i - 1] * weights[j - 1] * a[5 * i + j];
                if (a[5 * i + j] > a[brightest]) brightest = 5 * i + j;
            }
        const float sky = (f - excess[s]) / 16.0f, rough = noise[s] / 6.0f;
        for (int i = 0; i < 25; i++) a[i] -= sky;
        const float *p = a + brightest; /* one of the inner 3 x 3: its neighbours are in the window */
        const float top = p[0], along_x = p[-1] + p[1], along_y = p[-5] + p[5], corners = p[-6] + p[-4] + p[4] + p[6];
        const float beside = 2.0f * (along_x + along_y) + corners;
        const float allowed = 2.0f * 1.41421356f * rough + quantum; /* two pixels may have lost half a count each by rounding */
        const float least = 2.5f * 4.47213595f * rough > 0.7f * top ? 2.5f * 4.47213595f * rough : 0.7f * top;
        out[s] = beside > least - 3.0f * quantum && along_x > 0.16f * top - allowed && along_y > 0.16f * top - allowed;
    }
    return 0;
}

/* The brightest filtered place within `reach` of each place x, y (n,), as detect_near of detect.py looks for it: windows of half a
   side `side`, filtered by [1 2 1] both ways `times` times. dark: an image of float32 to subtract, or null. at: places of median
   and upper quantile among every third pixel, sorted. work: `room` floats, for every pixel and every third of eight windows and for one more window.
   Out: x_out, y_out (n,), excess above the median, noise; excess is NaN where a pixel has no value.
   Returns 0; 1 for what it does not take. */
FAST int helmstar_near(
    const void *data, int type, const float *dark, int64_t h, int64_t w, const int64_t *x, const int64_t *y, int64_t n, int reach,
    int side, int times, const int64_t *at, float floor, float *work, int64_t room, int64_t *x_out, int64_t *y_out, float *excess,
    float *noise) {
    const int64_t m = 2 * (int64_t)side + 1, pixels = m * m, count = (pixels + 2) / 3;
    if (type < 0 || type > 2 || reach < 0 || times < 0 || side < reach + 2 * times || side > 1000) return 1;
    if (room < (pixels + count) * LANES + pixels || at[0] < 0 || at[0] >= count || at[1] < 0 || at[1] >= count) return 1;
    float *const samples = work, *const windows = work + count * LANES, *const spare = windows + pixels * LANES;
    for (int64_t first = 0; first < n; first += LANES) {
        const int some = n - first < LANES ? (int)(n - first) : LANES;
        for (int l = 0; l < LANES; l++) {
            const int64_t s = first + (l < some ? l : some - 1);
            float *a = windows + l * pixels;
            around(data, type, h, w, x[s], y[s], side, a);
            if (dark) {
                around(dark, 2, h, w, x[s], y[s], side, spare);
                for (int64_t i = 0; i < pixels; i++) a[i] -= spare[i];
            }
            for (int64_t i = 0; i < count; i++) samples[i * LANES + l] = a[3 * i];
        }
        helmstar_sort_lanes(samples, (int)count);
        for (int l = 0; l < some; l++) {
            const int64_t s = first + l;
            float *a = windows + l * pixels;
            const float sky = samples[at[0] * LANES + l], spread = samples[at[1] * LANES + l] - sky;
            int finite = 1;
            for (int64_t i = 0; i < pixels; i++) finite &= a[i] - a[i] == 0.0f;
            int64_t size = m;
            for (int k = 0; k < times; k++, size -= 2) { /* in place: a row is read before it is overwritten */
                for (int64_t i = 0; i < size - 2; i++)
                    for (int64_t j = 0; j < size; j++)
                        spare[i * size + j] = (a[i * size + j] + 2.0f * a[(i + 1) * size + j]) + a[(i + 2) * size + j];
                for (int64_t i = 0; i < size - 2; i++)
                    for (int64_t j = 0; j < size - 2; j++)
                        a[i * (size - 2) + j] =
                            ((spare[i * size + j] + 2.0f * spare[i * size + j + 1]) + spare[i * size + j + 2]) / 16.0f;
            }
            const int64_t edge = (size - (2 * reach + 1)) / 2;
            float best = -INFINITY;
            int64_t bi = 0, bj = 0;
            for (int64_t i = 0; i <= 2 * reach; i++)
                for (int64_t j = 0; j <= 2 * reach; j++)
                    if (a[(edge + i) * size + edge + j] > best) best = a[(edge + i) * size + edge + j], bi = i, bj = j;
            x_out[s] = x[s] + bj - reach, y_out[s] = y[s] + bi - reach;
            excess[s] = finite ? best - sky : NAN;
            noise[s] = spread > floor ? spread : floor;
        }
    }
    return 0;
}
