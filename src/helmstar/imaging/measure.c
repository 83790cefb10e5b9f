/* What measure.py decides star by star, after the fit: the twin of _judged with _is_star and _elongation. */
#include <math.h>
#include <stdint.h>

#define MOST 35 /* widest window */
#define COARSE 9 /* half the side from which measure.py takes wider stars, and two bounds of its _is_star */
#define FILLS 0.85
#define WELL 0.8f

/* Windows (n, m, m): model, residual, above; full (n, m, m) bytes. bread, light (n, 6, 6) and p (n, 6) of the fit, sums (n, 4) of the fit; real, noise
   (n,) of a pixel; threshold in sigma.
   Out: place (n, 2, 2) covariance, of noise and light alone; misfit (n,) chi-square of a pixel; elongation, peak (n,); saturated,
   star (n,) bytes. Returns 0; 1 for windows of a side that it does not take. */
int helmstar_judge(
    const float *model, const float *residual, const float *above, const uint8_t *full, const float *bread, const float *light,
    const double *p, const float *sums,
    const float *real, const float *noisy, int64_t n, int m, double gain, double threshold, double *place, float *misfit, float *elongation, float *peak,
    uint8_t *saturated, uint8_t *star) {
    if (m < 1 || m > MOST || m % 2 == 0) return 1;
    const int pixels = m * m, half = m / 2;
    const float g = (float)gain;
    const float share = pixels > 361 ? (float)(361.0 / pixels) : 1.0f; /* of the noise, as in a window of level 2 */
    for (int64_t s = 0; s < n; s++) {
        const float *w = model + s * pixels, *r = residual + s * pixels, *a = above + s * pixels;
        const float *B = bread + s * 36, *L = light + s * 36;
        const double flux = p[6 * s], x = p[6 * s + 2], y = p[6 * s + 3], noise = (double)real[s];
        const float variance = (float)(noise * noise);
        float ratio[MOST * MOST], top = a[0];
        for (int i = 0; i < pixels; i++) ratio[i] = r[i] * r[i] / (variance + g * w[i]);
        double sum = 0.0;
        int any = 0;
        for (int i = 0; i < pixels; i++) {
            sum += (double)ratio[i];
            top = a[i] > top ? a[i] : top;
            any |= full[s * pixels + i];
        }
        misfit[s] = (float)(sum / pixels), peak[s] = top, saturated[s] = any != 0;
        for (int i = 0; i < 2; i++)
            for (int j = 0; j < 2; j++) {
                double between = 0.0;
                for (int k = 0; k < 6; k++) {
                    double along = 0.0;
                    for (int l = 0; l < 6; l++) along += (double)L[6 * k + l] * (double)B[6 * (2 + j) + l];
                    between += (double)B[6 * (2 + i) + k] * along;
                }
                place[4 * s + 2 * i + j] =
                    noise / flux * (noise / flux) * (double)B[6 * (2 + i) + 2 + j] + gain / flux * between;
            }
        /* Second moments under a Gaussian window of twice the star's width. */
        const double wide = p[6 * s + 4] > p[6 * s + 5] ? p[6 * s + 4] : p[6 * s + 5];
        const float reach = (float)(2.0 * wide + 0.5);
        float across[3][MOST], weight[MOST];
        for (int i = 0; i < m; i++) {
            const float dx = (float)(i - half) - (float)x, dy = (float)(i - half) - (float)y;
            across[0][i] = expf(-0.5f * (dx / reach) * (dx / reach));
            across[1][i] = across[0][i] * dx, across[2][i] = across[1][i] * dx;
            weight[i] = expf(-0.5f * (dy / reach) * (dy / reach));
        }
        double total = 1e-12, xx = 0.0, yy = 0.0, xy = 0.0;
        for (int i = 0; i < m; i++) {
            const float dy = (float)(i - half) - (float)y;
            float one = 0.0f, first = 0.0f, second = 0.0f;
            for (int j = 0; j < m; j++) {
                const float v = a[i * m + j];
                one += v * across[0][j], first += v * across[1][j], second += v * across[2][j];
            }
            total += (double)(weight[i] * one), xx += (double)(weight[i] * second);
            xy += (double)(weight[i] * dy * first), yy += (double)(weight[i] * dy * dy * one);
        }
        xx /= total, yy /= total, xy /= total;
        const double middle = (xx + yy) / 2, swing = hypot((xx - yy) / 2, xy);
        double shorter = middle - swing;
        if (!(shorter > 0.02 * middle + 1e-12)) shorter = 0.02 * middle + 1e-12;
        elongation[s] = (float)sqrt((middle + swing) / shorter);
        const double narrow = p[6 * s + 4] > p[6 * s + 5] ? p[6 * s + 5] : p[6 * s + 4];
        const float explained = sums[4 * s + 1] / (sums[4 * s + 1] + sums[4 * s + 2] * share);
        const int wider = half >= COARSE && wide < FILLS * half && explained > WELL;
        star[s] = flux > 0.6 * threshold * (double)noisy[s] * sqrt(12.566370614359172 * wide * narrow) && fabs(x) < 0.6 * half &&
                  fabs(y) < 0.6 * half && (wide < 0.6 * half || wider) && explained > 0.4f;
    }
    return 0;
}
