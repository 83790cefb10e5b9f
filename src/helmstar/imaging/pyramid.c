/* Filter, threshold and local maxima of an image in one pass over its rows: the twin of `halve` and `find_peaks` of pyramid.py. Sums
   are taken in the order of NumPy's, and whole numbers stay exact in single precision, so both find the same places. */
#include <stdint.h>

#include "../native.h"

#define CHUNK 32 /* pixels that are compared before one is looked at */

/* 0 uint8, 1 uint16, 2 float32, and a type that holds sixteen times as much */
#define OF_TYPE(type, expression, otherwise)                                                                                        \
    switch (type) {                                                                                                                 \
    case 0: { typedef uint8_t pixel; typedef uint16_t wide; expression; break; }                                                                           \
    case 1: { typedef uint16_t pixel; typedef int32_t wide; expression; break; }                                                                          \
    case 2: { typedef float pixel; typedef float wide; expression; break; }                                                                             \
    default: otherwise;                                                                                                             \
    }

/* Sums over 2 x 2 pixels of an image (h, w): (h / 2, w / 2), uint16 from uint8, else float32. Returns 0; 1 for no known type. */
FAST int helmstar_halve(const void *data, int type, int64_t h, int64_t w, void *out) {
    const int64_t rows = h / 2, columns = w / 2;
    for (int64_t y = 0; y < rows; y++) {
        if (type == 0) {
            const uint8_t *restrict a = (const uint8_t *)data + 2 * y * w, *restrict b = a + w;
            uint16_t *restrict o = (uint16_t *)out + y * columns;
            for (int64_t x = 0; x < columns; x++) o[x] = (uint16_t)(a[2 * x] + b[2 * x] + a[2 * x + 1] + b[2 * x + 1]);
        } else if (type == 1) {
            const uint16_t *restrict a = (const uint16_t *)data + 2 * y * w, *restrict b = a + w;
            float *restrict o = (float *)out + y * columns;
            for (int64_t x = 0; x < columns; x++) o[x] = (float)(a[2 * x] + b[2 * x] + a[2 * x + 1] + b[2 * x + 1]);
        } else if (type == 2) {
            const float *restrict a = (const float *)data + 2 * y * w, *restrict b = a + w;
            float *restrict o = (float *)out + y * columns;
            for (int64_t x = 0; x < columns; x++) o[x] = (a[2 * x] + b[2 * x]) + (a[2 * x + 1] + b[2 * x + 1]);
        } else
            return 1;
    }
    return 0;
}

/* [1 2 1] x [1 2 1] at chosen rows and columns of the filtered image (h - 2, w - 2): (n_rows, n_columns).
   Returns 0; 1 for no known type or a place that is not inside. */
int helmstar_filtered_at(
    const void *data, int type, int64_t h, int64_t w, const int64_t *rows, int64_t n_rows, const int64_t *columns,
    int64_t n_columns, float *out) {
    if (type < 0 || type > 2) return 1;
    for (int64_t i = 0; i < n_rows; i++)
        if (rows[i] < 0 || rows[i] > h - 3) return 1;
    for (int64_t j = 0; j < n_columns; j++)
        if (columns[j] < 0 || columns[j] > w - 3) return 1;
    for (int64_t i = 0; i < n_rows; i++, out += n_columns)
        OF_TYPE(type,
            const pixel *a = (const pixel *)data + rows[i] * w;
            for (int64_t j = 0; j < n_columns; j++) {
                wide c[3];
                for (int k = 0; k < 3; k++) {
                    const pixel *p = a + columns[j] + k;
                    c[k] = (wide)((p[0] + (wide)p[w]) + ((wide)p[w] + p[2 * w]));
                }
                out[j] = (float)((c[0] + c[1]) + (c[1] + c[2]));
            },
            return 1)
    return 0;
}

/* One row of the filtered image: out (w - 2). down: w floats of work. */
INLINE void filtered(const void *data, int type, int64_t w, int64_t row, void *work, float *restrict out) {
    OF_TYPE(type,
        const pixel *restrict a = (const pixel *)data + row * w; const pixel *restrict b = a + w;
        const pixel *restrict c = b + w; wide *restrict down = (wide *)work;
        for (int64_t x = 0; x < w; x++) down[x] = (wide)((a[x] + (wide)b[x]) + ((wide)b[x] + c[x]));
        for (int64_t x = 0; x < w - 2; x++) out[x] = (float)(wide)((down[x] + down[x + 1]) + (down[x + 1] + down[x + 2])),
        return)
}

/* The tile before a position and the part of the way to the next one's middle, as _place of background.py. */
INLINE int64_t place(double at, int64_t size, int64_t tiles, float *part) {
    double p = (at + 0.5) * ((double)tiles / (double)size) - 0.5;
    p = p < 0.0 ? 0.0 : p > (double)(tiles - 1) ? (double)(tiles - 1) : p;
    const int64_t tile = (int64_t)p;
    *part = (float)(p - (double)tile);
    return tile;
}

/* Places of an image (h, w), w and h at least 3, in the order of its rows: x, y of the image, excess above the sky and noise, for a
   mesh of sky and noise (tile rows, tile columns). rows: (tile rows + 2,) where bands begin and end, as Mesh.least has them.
   work: 9 w floats. Writes at most `room` places and returns how many there are; -1 for no known type. */
FAST int64_t helmstar_peaks(
    const void *data, int type, int64_t h, int64_t w, const float *sky, const float *noise, int64_t tile_rows, int64_t tile_columns,
    const int64_t *rows, float threshold, float *work, int64_t room, int64_t *x_out, int64_t *y_out, float *excess, float *noise_out) {
    if (type < 0 || type > 2) return -1;
    const int64_t width = w - 2, height = h - 2;
    float *down = work, *f[3] = {work + w, work + 2 * w, work + 3 * w}, *low = work + 4 * w, *part = work + 5 * w;
    float *before = work + 6 * w, *after = work + 7 * w;
    int32_t *tile = (int32_t *)(work + 8 * w);
    int64_t found = 0, band = -1;
    if (height < 3 || width < 3) return 0;
    for (int64_t x = 0; x < width; x++) tile[x] = (int32_t)place((double)x, width, tile_columns, part + x);
    filtered(data, type, w, 0, down, f[0]);
    filtered(data, type, w, 1, down, f[1]);
    for (int64_t y = 1; y < height - 1; y++) {
        float *above = f[(y - 1) % 3], *here = f[y % 3], *below = f[(y + 1) % 3];
        filtered(data, type, w, y + 1, down, below);
        while (band < tile_rows && (band < 0 || y >= rows[band + 1])) { /* the lower bound of the next band */
            float *swap = before;
            before = after, after = swap, band++;
            if (band < tile_rows) {
                const float *s = sky + band * tile_columns, *n = noise + band * tile_columns;
                for (int64_t x = 0; x < width; x++) {
                    const int64_t j = tile[x];
                    const float left = s[j] + threshold * n[j];
                    const float step = j + 1 < tile_columns ? (s[j + 1] + threshold * n[j + 1]) - left : 0.0f;
                    after[x] = step * part[x] + left;
                }
            }
            const float *one = band == 0 ? after : before, *two = band < tile_rows ? after : before;
            for (int64_t x = 0; x < width; x++) low[x] = one[x] < two[x] ? one[x] : two[x];
        }
        for (int64_t start = 1; start < width - 1; start += CHUNK) {
            const int some = (int)(width - 1 - start < CHUNK ? width - 1 - start : CHUNK);
            const float *v = here + start, *l = low + start, *u = above + start, *d = below + start;
            int any = 0, top[CHUNK];
            if (some == CHUNK)
                for (int k = 0; k < CHUNK; k++) any |= v[k] > l[k];
            else
                any = 1;
            if (!any) continue;
            any = 0;
            for (int k = 0; k < some; k++) { /* a plateau has one maximum: its last pixel */
                top[k] = (v[k] > l[k]) & (v[k] >= v[k - 1]) & (v[k] >= u[k + 1]) & (v[k] >= u[k]) & (v[k] >= u[k - 1]) &
                         (v[k] > v[k + 1]) & (v[k] > d[k - 1]) & (v[k] > d[k]) & (v[k] > d[k + 1]);
                any |= top[k];
            }
            if (!any) continue;
            for (int k = 0; k < some; k++) {
                if (!top[k]) continue;
                const int64_t x = start + k;
                const float v = here[x];
                float a, b, both[2];
                const int64_t i = place((double)y, height, tile_rows, &a), j = place((double)x, width, tile_columns, &b);
                const int64_t down_by = i + 1 < tile_rows ? tile_columns : 0, right = j + 1 < tile_columns ? 1 : 0;
                for (int k = 0; k < 2; k++) {
                    const float *m = (k ? noise : sky) + i * tile_columns + j;
                    const float l = m[0] + a * (m[down_by] - m[0]);
                    const float r = m[right] + a * (m[down_by + right] - m[right]);
                    both[k] = l + b * (r - l);
                }
                if (!(v - both[0] > threshold * both[1])) continue;
                if (found < room) {
                    x_out[found] = x + 1, y_out[found] = y + 1;
                    excess[found] = v - both[0], noise_out[found] = both[1];
                }
                found++;
            }
        }
    }
    return found;
}
