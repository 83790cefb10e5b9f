/* Quantiles of the tiles of a sampled image: the twin of what mesh_of of background.py sorts and smooths, to the last bit. */
#include <stdint.h>

#define LANES 8
#define SIDE 12 /* PER_TILE */
#define COUNT (SIDE * SIDE)
#define TAIL 24

void helmstar_sort_lanes(float *v, int n);

/* The samples of up to eight tiles, side by side: values (rows SIDE, columns SIDE), tiles numbered along rows. */
static void gather(const float *values, int columns, int first, int some, float v[COUNT][LANES]) {
    for (int l = 0; l < LANES; l++) {
        const int t = first + (l < some ? l : some - 1);
        const float *from = values + ((int64_t)(t / columns) * SIDE * columns + t % columns) * SIDE;
        for (int i = 0; i < SIDE; i++)
            for (int j = 0; j < SIDE; j++) v[i * SIDE + j][l] = from[(int64_t)i * columns * SIDE + j];
    }
}

/* Median of 3 x 3 tiles, edges repeated. */
static void over_neighbours(const float *mesh, int rows, int columns, float *out) {
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) {
            float nine[9];
            int n = 0;
            for (int a = i - 1; a <= i + 1; a++)
                for (int b = j - 1; b <= j + 1; b++, n++) {
                    const int y = a < 0 ? 0 : a >= rows ? rows - 1 : a, x = b < 0 ? 0 : b >= columns ? columns - 1 : b;
                    const float v = mesh[y * columns + x];
                    int k = n;
                    for (; k > 0 && nine[k - 1] > v; k--) nine[k] = nine[k - 1];
                    nine[k] = v;
                }
            out[i * columns + j] = nine[4];
        }
}

/* values (rows SIDE, columns SIDE), which become what is above the smooth sky; for each of their rows and columns the tile before it
   and the part of the way to the next. at: for the median and two upper quantiles the place among sorted samples; sigmas of these two.
   Out: sky, spread (rows, columns), tail (rows columns, TAIL) the largest samples. work: 2 rows columns + columns floats. */
void helmstar_mesh(
    float *values, int rows, int columns, const int64_t *tile_y, const float *part_y, const int64_t *tile_x, const float *part_x,
    const int *at, const float *sigmas, float *work, float *sky, float *spread, float *tail) {
    const int tiles = rows * columns;
    float v[COUNT][LANES];
    float *raw = work, *line = work + tiles;
    for (int k = 0; k < 3; k++)
        if (at[k] < 0 || at[k] >= COUNT) return;
    for (int first = 0; first < tiles; first += LANES) {
        const int some = tiles - first < LANES ? tiles - first : LANES;
        gather(values, columns, first, some, v);
        helmstar_sort_lanes(&v[0][0], COUNT);
        for (int l = 0; l < some; l++) raw[first + l] = v[at[0]][l];
    }
    over_neighbours(raw, rows, columns, sky);
    for (int y = 0; y < rows * SIDE; y++) {
        const int64_t i = tile_y[y] < 0 ? 0 : tile_y[y] >= rows ? rows - 1 : tile_y[y];
        const float *here = sky + i * columns, *below = sky + (i + 1 < rows ? i + 1 : i) * columns;
        for (int j = 0; j < columns; j++) line[j] = (below[j] - here[j]) * part_y[y] + here[j];
        float *row = values + (int64_t)y * columns * SIDE;
        for (int x = 0; x < columns * SIDE; x++) {
            const int64_t j = tile_x[x] < 0 ? 0 : tile_x[x] >= columns ? columns - 1 : tile_x[x];
            const float step = j + 1 < columns ? line[j + 1] - line[j] : 0.0f;
            row[x] -= step * part_x[x] + line[j];
        }
    }
    for (int first = 0; first < tiles; first += LANES) {
        const int some = tiles - first < LANES ? tiles - first : LANES;
        gather(values, columns, first, some, v);
        helmstar_sort_lanes(&v[0][0], COUNT);
        for (int l = 0; l < some; l++) {
            const float a = (v[at[1]][l] - v[at[0]][l]) / sigmas[0], b = (v[at[2]][l] - v[at[0]][l]) / sigmas[1];
            raw[first + l] = a > b ? a : b;
            for (int k = 0; k < TAIL; k++) tail[(int64_t)(first + l) * TAIL + k] = v[COUNT - TAIL + k][l];
        }
    }
    over_neighbours(raw, rows, columns, spread);
}
