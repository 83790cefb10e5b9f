/* Which stars lie where: the search that screen.c and sky.c share. */
#ifndef HELMSTAR_SKY_H
#define HELMSTAR_SKY_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>

/* Stars by declination, with their directions (count, 3). The caller sees to it that each is one of the catalogue's `stars`. */
typedef struct {
    int64_t count, stars;
    const int64_t *member;
    const double *directions;
} Members;

/* What a pinhole at R sees with X/Z and Y/Z from low to high. */
typedef struct {
    double R[9], low[2], high[2];
} Window;

/* Words of marks for a search: a bit for each star of the catalogue. */
static inline int64_t words(int64_t stars) { return stars / 64 + 1; }

/* First of the members whose z is not less. */
static inline int64_t first_above(const Members *s, double z)
{
    int64_t low = 0, high = s->count;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (s->directions[3 * middle + 2] < z)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static inline int shows(const Window *w, const double *v)
{
    const double *R = w->R;
    double z = R[6] * v[0] + R[7] * v[1] + R[8] * v[2];
    if (!(z > 1e-3))
        return 0;
    double x = (R[0] * v[0] + R[1] * v[1] + R[2] * v[2]) / z, y = (R[3] * v[0] + R[4] * v[1] + R[5] * v[2]) / z;
    return x >= w->low[0] && x <= w->high[0] && y >= w->low[1] && y <= w->high[1];
}

/* Catalogue indices, ascending, of the members within `radius` of a unit direction, of those in the window where there is one. The
   marks, clear before and after, sort them. */
static inline int64_t in_circle(
    const Members *s, const double *centre, double radius, const Window *window, uint64_t *marks, int64_t *found)
{
    double z = centre[2] < -1.0 ? -1.0 : centre[2] > 1.0 ? 1.0 : centre[2], quarter = 0.5 * 3.14159265358979323846;
    double south = asin(z) - radius, north = asin(z) + radius, least = cos(radius);
    int64_t begin = first_above(s, sin(south < -quarter ? -quarter : south) - 1e-12);
    int64_t end = first_above(s, sin(north > quarter ? quarter : north) + 1e-12), count = 0;
    for (int64_t k = begin; k < end; k++) {
        const double *v = s->directions + 3 * k;
        if (v[0] * centre[0] + v[1] * centre[1] + v[2] * centre[2] > least && (window == NULL || shows(window, v)))
            marks[s->member[k] >> 6] |= (uint64_t)1 << (s->member[k] & 63);
    }
    for (int64_t word = 0; word < words(s->stars); word++)
        for (; marks[word]; marks[word] &= marks[word] - 1)
            found[count++] = 64 * word + __builtin_ctzll(marks[word]);
    return count;
}

#endif
