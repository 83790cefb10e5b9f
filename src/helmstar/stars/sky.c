/* The stars of a circle or of an image: what `Sky.near` and `Sky.around` of patterns.py do with NumPy. */
#include "sky.h"

#include <stdlib.h>

/* Number of the stars found, at most all members: see sky.h. centre (3,) and radius; window: NULL for the whole circle. -1 where there
   is no memory. */
int64_t helmstar_in_circle(
    int64_t count, int64_t stars, const int64_t *member, const double *directions, const double *centre, double radius,
    const Window *window, int64_t *found)
{
    Members s = {count, stars, member, directions};
    uint64_t *marks = calloc((size_t)words(stars), sizeof(uint64_t));
    if (marks == NULL)
        return -1;
    int64_t number = in_circle(&s, centre, radius, window, marks, found);
    free(marks);
    return number;
}
