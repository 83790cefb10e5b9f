/* Eight sorts at a time, for the quantiles of tiles and of rings around stars: the twin of np.sort along an axis. */
#include <stdint.h>
#include <string.h>

#include "../native.h"

#define LANES 8
typedef float lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t marks __attribute__((vector_size(4 * LANES)));

/* Batcher's merge exchange (Knuth, The Art of Computer Programming 3, algorithm 5.2.2M) of rows v[n][8], each lane for itself: which
   rows are compared does not depend on the numbers, so no branch is ever mispredicted. A NaN stays among them, somewhere. */
FAST void helmstar_sort_lanes(float *v, int n) {
    int top = 1;
    while (2 * top < n) top *= 2;
    for (int p = n > 1 ? top : 0; p > 0; p /= 2) {
        int q = top, r = 0, d = p;
        for (;;) {
            for (int run = r; run < n - d; run += 2 * p)
                for (int i = run; i < run + p && i < n - d; i++) {
                    lanes a, b;
                    memcpy(&a, v + (long)LANES * i, sizeof a), memcpy(&b, v + (long)LANES * (i + d), sizeof b);
                    marks swap = b < a;
                    lanes lo = (lanes)((swap & (marks)b) | (~swap & (marks)a));
                    lanes hi = (lanes)((swap & (marks)a) | (~swap & (marks)b));
                    memcpy(v + (long)LANES * i, &lo, sizeof lo), memcpy(v + (long)LANES * (i + d), &hi, sizeof hi);
                }
            if (q == p) break;
            d = q - p, q /= 2, r = p;
        }
    }
}
