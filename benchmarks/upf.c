/* The scalar reference: the unscented particle filter of li2007 with kernels, one run after the other. The same equations as
 * helmstar's MixtureFilter over an UnscentedKalmanFilter with linear prediction and importance weights at two opposite draws,
 * but kernels are never drawn anew: state r (3), attitude q (4) with its error on the right; kappa form by `scale` = alpha^2 (6 + kappa), weights as given.
 *
 * run(runs, steps, n, ...): z (runs, steps, 2); R_CB (runs, steps, 3, 3); start (runs, 3); mean_out (runs, steps, 3).
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define D 6

typedef struct { double r[3], q[4], P[D][D]; } Kernel;
typedef struct { double f, p0, sigma, scale, wc, wc0, wm0; } Sensor;

static uint64_t state;

static double uniform(void) {  /* xorshift64*, in (0, 1) */
    state ^= state >> 12; state ^= state << 25; state ^= state >> 27;
    return ((double)((state * 2685821657736338717ULL) >> 11) + 0.5) / 9007199254740992.0;
}

static double normal(void) {
    return sqrt(-2.0 * log(uniform())) * cos(6.283185307179586 * uniform());
}

static void turn_right(const double *q, const double *v, double *out) {  /* q (x) exp(v) */
    double t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], t = sqrt(t2);
    double s = t < 1e-8 ? 0.5 - t2 / 48.0 : sin(0.5 * t) / t, w = cos(0.5 * t);
    double x = s * v[0], y = s * v[1], z = s * v[2];
    double a = q[3] * x + q[0] * w + q[1] * z - q[2] * y, b = q[3] * y - q[0] * z + q[1] * w + q[2] * x;
    double c = q[3] * z + q[0] * y - q[1] * x + q[2] * w, d = q[3] * w - q[0] * x - q[1] * y - q[2] * z;
    double n = 1.0 / sqrt(a * a + b * b + c * c + d * d);
    out[0] = a * n; out[1] = b * n; out[2] = c * n; out[3] = d * n;
}

static void pixel(const Sensor *s, const double R_CB[9], const double *r, const double *q, double *z) {
    double x = q[0], y = q[1], w = q[2], c = q[3], v[3] = {-r[0], -r[1], -r[2]};
    double t[3] = {2 * (y * v[2] - w * v[1]), 2 * (w * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])};
    double b[3] = {v[0] + c * t[0] + y * t[2] - w * t[1], v[1] + c * t[1] + w * t[0] - x * t[2],
                   v[2] + c * t[2] + x * t[1] - y * t[0]};
    double u[3];
    for (int i = 0; i < 3; i++) u[i] = R_CB[3 * i] * b[0] + R_CB[3 * i + 1] * b[1] + R_CB[3 * i + 2] * b[2];
    z[0] = s->f * u[0] / u[2] + s->p0;
    z[1] = s->f * u[1] / u[2] + s->p0;
}

static double cholesky(const double A[D][D], double L[D][D]) {  /* returns the log determinant of L */
    double log_det = 0.0;
    memset(L, 0, sizeof(double) * D * D);
    for (int i = 0; i < D; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = A[i][j];
            for (int k = 0; k < j; k++) sum -= L[i][k] * L[j][k];
            L[i][j] = i == j ? sqrt(sum) : sum / L[j][j];
        }
        log_det += log(L[i][i]);
    }
    return log_det;
}

static void move(const Kernel *k, const double *d, double *r, double *q) {
    for (int i = 0; i < 3; i++) r[i] = k->r[i] + d[i];
    turn_right(k->q, d + 3, q);
}

/* One update; returns what is added to the log weight. */
static double update(const Sensor *s, const double R_CB[9], const double *z, Kernel *k) {
    double L[D][D], h0[2], dz[2 * D][2], mean[2] = {0, 0}, r[3], q[4];
    double before_det = cholesky(k->P, L), spread = sqrt(s->scale);
    pixel(s, R_CB, k->r, k->q, h0);
    for (int j = 0; j < D; j++)
        for (int sign = 0; sign < 2; sign++) {
            double d[D];
            for (int i = 0; i < D; i++) d[i] = (sign ? -spread : spread) * L[i][j];
            move(k, d, r, q);
            double h[2];
            pixel(s, R_CB, r, q, h);
            for (int m = 0; m < 2; m++) { dz[2 * j + sign][m] = h[m] - h0[m]; mean[m] += s->wc * dz[2 * j + sign][m]; }
        }
    double S[2][2] = {{s->sigma * s->sigma, 0}, {0, s->sigma * s->sigma}}, C[2][D] = {{0}};
    for (int m = 0; m < 2; m++)
        for (int n = 0; n < 2; n++) {
            S[m][n] += s->wc0 * mean[m] * mean[n];
            for (int p = 0; p < 2 * D; p++) S[m][n] += s->wc * (dz[p][m] - mean[m]) * (dz[p][n] - mean[n]);
        }
    for (int m = 0; m < 2; m++)
        for (int j = 0; j < D; j++) {
            double a = s->wc * spread * (dz[2 * j][m] - dz[2 * j + 1][m]);
            for (int i = 0; i < D; i++) C[m][i] += a * L[i][j];
        }
    double det = S[0][0] * S[1][1] - S[0][1] * S[1][0];
    double I[2][2] = {{S[1][1] / det, -S[0][1] / det}, {-S[1][0] / det, S[0][0] / det}}, K[D][2], d[D];
    double e[2] = {z[0] - h0[0] - mean[0], z[1] - h0[1] - mean[1]};
    for (int i = 0; i < D; i++) {
        for (int m = 0; m < 2; m++) K[i][m] = C[0][i] * I[0][m] + C[1][i] * I[1][m];
        d[i] = K[i][0] * e[0] + K[i][1] * e[1];
    }
    double after[D][D], root[D][D], noise[D], logs[2];
    for (int i = 0; i < D; i++)
        for (int j = 0; j < D; j++) after[i][j] = k->P[i][j] - K[i][0] * C[0][j] - K[i][1] * C[1][j];
    double after_det = cholesky(after, root), own = 0.0;
    for (int i = 0; i < D; i++) { noise[i] = normal(); own += noise[i] * noise[i]; }
    for (int sign = 0; sign < 2; sign++) {
        double x[D], white[D], h[2], prior = 0.0, far = 0.0;
        for (int i = 0; i < D; i++) {
            x[i] = d[i];
            for (int j = 0; j <= i; j++) x[i] += (sign ? -root[i][j] : root[i][j]) * noise[j];
        }
        for (int i = 0; i < D; i++) {
            white[i] = x[i];
            for (int j = 0; j < i; j++) white[i] -= L[i][j] * white[j];
            white[i] /= L[i][i];
            prior += white[i] * white[i];
        }
        move(k, x, r, q);
        pixel(s, R_CB, r, q, h);
        for (int m = 0; m < 2; m++) far += (z[m] - h[m]) * (z[m] - h[m]) / (s->sigma * s->sigma);
        logs[sign] = -0.5 * (far + prior - own) - before_det + after_det;
    }
    double high = logs[0] > logs[1] ? logs[0] : logs[1];
    double log_weight = high + log(0.5 * (exp(logs[0] - high) + exp(logs[1] - high)));
    move(k, d, r, q);
    memcpy(k->r, r, sizeof r);
    memcpy(k->q, q, sizeof q);
    memcpy(k->P, after, sizeof after);
    return log_weight;
}

void run(int runs, int steps, int n, double dt, double f, double p0, double sigma, double scale, double wm0, double wc0,
         double wc, const double *v, double mean_r, double q_r, double q_q, const double *q_ref, const double *P0, double kernel,
         const double *z, const double *R_CB, const double *start, double *mean_out) {
    Sensor s = {f, p0, sigma, scale, wc, wc0, wm0};
    Kernel *k = malloc(sizeof(Kernel) * n);
    double *log_weight = malloc(sizeof(double) * n);
    state = 88172645463325252ULL;
    for (int run = 0; run < runs; run++) {
        for (int i = 0; i < n; i++) {
            memset(&k[i], 0, sizeof(Kernel));
            for (int j = 0; j < D; j++) k[i].P[j][j] = P0[j] * (j == 0 ? kernel * kernel : 1.0);
            memcpy(k[i].r, start + 3 * run, sizeof(double) * 3);
            k[i].r[0] += sqrt(P0[0] * (1.0 - kernel * kernel)) * normal();
            memcpy(k[i].q, q_ref, sizeof(double) * 4);
            log_weight[i] = 0.0;
        }
        for (int t = 0; t < steps; t++) {
            const double *zt = z + 2 * (run * steps + t), *R = R_CB + 9 * (run * steps + t);
            double top = -INFINITY, total = 0.0, mean[3] = {0, 0, 0};
            for (int i = 0; i < n; i++) {
                for (int j = 0; j < 3; j++) {
                    k[i].r[j] += v[j] * dt + mean_r;
                    k[i].P[j][j] += q_r;
                    k[i].P[j + 3][j + 3] += q_q;
                }
                log_weight[i] += update(&s, R, zt, &k[i]);
                if (log_weight[i] > top) top = log_weight[i];
            }
            for (int i = 0; i < n; i++) {
                log_weight[i] -= top;
                double w = exp(log_weight[i]);
                total += w;
                for (int j = 0; j < 3; j++) mean[j] += w * k[i].r[j];
            }
            for (int j = 0; j < 3; j++) mean_out[3 * (run * steps + t) + j] = mean[j] / total;
        }
    }
    free(k);
    free(log_weight);
}
