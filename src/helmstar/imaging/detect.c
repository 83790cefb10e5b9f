/* What detect.py decides pair by pair: the twin of _merged and _alone. */
#include <math.h>
#include <stdint.h>

/* Places (n,), the strongest first, each with the reach of its window: out, bytes, is 0 where a stronger one's window holds it. */
void helmstar_apart(const float *x, const float *y, const float *reach, int64_t n, uint8_t *out) {
    for (int64_t i = 0; i < n; i++) {
        int near = 0;
        for (int64_t j = 0; j < i; j++) near |= (fabsf(x[i] - x[j]) <= reach[j]) & (fabsf(y[i] - y[j]) <= reach[j]);
        out[i] = (uint8_t)!near;
    }
}

/* Stars (n,), the brightest first: out, bytes, is 0 where one is a brighter one's second finding or artefact. */
void helmstar_alone(const float *x, const float *y, const double *flux, int64_t n, uint8_t *out) {
    for (int64_t i = 0; i < n; i++) {
        int same = 0;
        for (int64_t j = 0; j < i; j++) {
            const float dx = x[i] - x[j], dy = y[i] - y[j], d2 = dx * dx + dy * dy;
            if (fabsf(dx) < 14.0f && fabsf(dy) < 14.0f) same |= d2 < 4.0f || (d2 < 196.0f && flux[i] < 0.01 * flux[j]);
        }
        out[i] = (uint8_t)!same;
    }
}
