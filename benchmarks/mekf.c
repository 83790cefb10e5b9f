/* The scalar reference: a 6-state MEKF (attitude error in B, gyro drift), two star directions per step, one run after
 * the other. The same equations as helmstar's ErrorStateKalmanFilter with so3_left: Farrenkopf noise, dense F and H,
 * 6x6 Cholesky, Joseph update, covariance carried to the new mean. Fixed sizes, so that gcc -O3 unrolls and vectorises
 * the inner loops as it likes.
 *
 * run(runs, steps, u, z, q_out, nis_out): u (runs, steps, 3) rad/s; z (runs, steps, 2, 3); q_out (runs, steps, 4).
 */
#include <math.h>
#include <string.h>

typedef double M6[6][6];

static void quat_mul(const double *p, const double *q, double *r) {
    double x = p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1];
    double y = p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0];
    double z = p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3];
    double w = p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2];
    r[0] = x; r[1] = y; r[2] = z; r[3] = w;
}

static void quat_exp(const double *v, double *q) {
    double t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], t = sqrt(t2);
    double s = t < 1e-8 ? 0.5 - t2 / 48.0 : sin(0.5 * t) / t;
    q[0] = s * v[0]; q[1] = s * v[1]; q[2] = s * v[2]; q[3] = cos(0.5 * t);
}

static void normalise(double *q) {
    double n = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) q[i] *= n;
}

static void quat_matrix(const double *q, double R[3][3]) {
    double x = q[0], y = q[1], z = q[2], w = q[3];
    R[0][0] = 1 - 2 * (y * y + z * z); R[0][1] = 2 * (x * y - z * w); R[0][2] = 2 * (x * z + y * w);
    R[1][0] = 2 * (x * y + z * w); R[1][1] = 1 - 2 * (x * x + z * z); R[1][2] = 2 * (y * z - x * w);
    R[2][0] = 2 * (x * z - y * w); R[2][1] = 2 * (y * z + x * w); R[2][2] = 1 - 2 * (x * x + y * y);
}

/* exp([v x]) and J_l(v) for small and large v */
static void exp_and_jacobian(const double *v, double E[3][3], double J[3][3]) {
    double t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], t = sqrt(t2);
    double a, b, c;
    if (t < 1e-4) { a = 1 - t2 / 6; b = 0.5 - t2 / 24; c = 1.0 / 6 - t2 / 120; }
    else { a = sin(t) / t; b = (1 - cos(t)) / t2; c = (1 - a) / t2; }
    double hat[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double o = v[i] * v[j];
            E[i][j] = (i == j ? 1 - b * t2 : 0) + a * hat[i][j] + b * o;
            J[i][j] = (i == j ? a : 0) + b * hat[i][j] + c * o;
        }
}

static inline void mul(const double A[6][6], const double B[6][6], double C[6][6]) {
    for (int i = 0; i < 6; i++) {
        double row[6] = {0};
        for (int k = 0; k < 6; k++)
            for (int j = 0; j < 6; j++) row[j] += A[i][k] * B[k][j];
        memcpy(C[i], row, sizeof row);
    }
}

static inline void mul_t(const double A[6][6], const double B[6][6], double C[6][6]) {
    M6 Bt;
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) Bt[i][j] = B[j][i];
    mul(A, Bt, C);
}

static void step(double *q, double *b, double P[6][6], const double *u, double dt, double sv, double su,
                 const double *z, const double r[2][3], double sigma, double *nis) {
    double phi[3], dq[4], E[3][3], J[3][3], t[4];
    M6 F = {{0}}, A, B;
    for (int i = 0; i < 3; i++) phi[i] = -(u[i] - b[i]) * dt;
    quat_exp(phi, dq);
    quat_mul(dq, q, t);
    memcpy(q, t, sizeof t);
    normalise(q);
    exp_and_jacobian(phi, E, J);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) { F[i][j] = E[i][j]; F[i][j + 3] = J[i][j] * dt; }
        F[i + 3][i + 3] = 1;
    }
    mul(F, P, A);
    mul_t(A, F, P);
    for (int i = 0; i < 3; i++) {
        P[i][i] += sv * sv * dt + su * su * dt * dt * dt / 3;
        P[i][i + 3] += 0.5 * su * su * dt * dt;
        P[i + 3][i] += 0.5 * su * su * dt * dt;
        P[i + 3][i + 3] += su * su * dt;
    }

    double R[3][3], e[6], y[6];
    M6 H = {{0}}, HP, S, L = {{0}}, Kt;
    quat_matrix(q, R);
    for (int s = 0; s < 2; s++) {
        double m[3];
        for (int i = 0; i < 3; i++) {
            m[i] = R[i][0] * r[s][0] + R[i][1] * r[s][1] + R[i][2] * r[s][2];
            e[3 * s + i] = z[3 * s + i] - m[i];
        }
        double (*h)[6] = &H[3 * s];
        h[0][1] = m[2]; h[0][2] = -m[1];
        h[1][0] = -m[2]; h[1][2] = m[0];
        h[2][0] = m[1]; h[2][1] = -m[0];
    }
    mul(H, P, HP);
    mul_t(HP, H, S);
    for (int i = 0; i < 6; i++) S[i][i] += sigma * sigma;
    for (int j = 0; j < 6; j++) {
        double d = S[j][j];
        for (int k = 0; k < j; k++) d -= L[j][k] * L[j][k];
        L[j][j] = sqrt(d);
        double inv = 1 / L[j][j];
        for (int i = j + 1; i < 6; i++) {
            double s = S[i][j];
            for (int k = 0; k < j; k++) s -= L[i][k] * L[j][k];
            L[i][j] = s * inv;
        }
    }
    *nis = 0;
    for (int i = 0; i < 6; i++) {
        double s = e[i];
        for (int k = 0; k < i; k++) s -= L[i][k] * y[k];
        y[i] = s / L[i][i];
        *nis += y[i] * y[i];
    }
    memcpy(Kt, HP, sizeof Kt); /* K^T = S^-1 H P */
    for (int i = 0; i < 6; i++) {
        for (int k = 0; k < i; k++)
            for (int j = 0; j < 6; j++) Kt[i][j] -= L[i][k] * Kt[k][j];
        double inv = 1 / L[i][i];
        for (int j = 0; j < 6; j++) Kt[i][j] *= inv;
    }
    for (int i = 5; i >= 0; i--) {
        for (int k = i + 1; k < 6; k++)
            for (int j = 0; j < 6; j++) Kt[i][j] -= L[k][i] * Kt[k][j];
        double inv = 1 / L[i][i];
        for (int j = 0; j < 6; j++) Kt[i][j] *= inv;
    }
    M6 K, I_KH;
    double d[6] = {0};
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) { K[i][j] = Kt[j][i]; d[i] += K[i][j] * e[j]; }
    mul(K, H, I_KH);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) I_KH[i][j] = (i == j) - I_KH[i][j];
    mul(I_KH, P, A);
    mul_t(A, I_KH, B);
    M6 KR;
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) KR[i][j] = K[i][j] * sigma * sigma;
    mul_t(KR, K, A);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) B[i][j] += A[i][j];
    M6 D = {{0}};
    exp_and_jacobian(d, E, J);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) D[i][j] = E[i][j];
        D[i + 3][i + 3] = 1;
    }
    mul(D, B, A);
    mul_t(A, D, B);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) P[i][j] = 0.5 * (B[i][j] + B[j][i]);
    quat_exp(d, dq);
    quat_mul(dq, q, t);
    memcpy(q, t, sizeof t);
    normalise(q);
    for (int i = 0; i < 3; i++) b[i] += d[3 + i];
}

void run(int runs, int steps, double dt, double sv, double su, double sigma, double p0, const double *u,
         const double *z, double *q_out, double *nis_out) {
    const double r[2][3] = {{1, 0, 0}, {0, 1, 0}};
    for (int n = 0; n < runs; n++) {
        double q[4] = {0, 0, 0, 1}, b[3] = {0, 0, 0};
        M6 P = {{0}};
        for (int i = 0; i < 6; i++) P[i][i] = p0;
        for (int k = 0; k < steps; k++) {
            long o = (long)n * steps + k;
            step(q, b, P, u + 3 * o, dt, sv, su, z + 6 * o, r, sigma, nis_out + o);
            memcpy(q_out + 4 * o, q, sizeof q);
        }
    }
}

/* Steps of one run from and into the caller's state, for a caller that streams: q (4), b (3), P (6, 6). */
void stream_loop(int steps, double dt, double sv, double su, double sigma, double *q, double *b, double *P,
                 const double *u, const double *z, double *nis) {
    const double r[2][3] = {{1, 0, 0}, {0, 1, 0}};
    for (int k = 0; k < steps; k++) step(q, b, (double (*)[6])P, u + 3 * k, dt, sv, su, z + 6 * k, r, sigma, nis + k);
}
