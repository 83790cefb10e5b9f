/* The last fit of a star tracker: what refine.py does with NumPy (`_fit` and what it calls), from the first matches to the last.

   Formulas are those of the NumPy twin; sums are taken in the order of the matches, and the information is inverted by
   Cholesky's factor. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "../native.h"

#define TINY 1e-13 /* information, in units in which it is about one, that everything has */
#define PARAMETERS 9
#define ROW 12     /* the parameters and zeros, so that rows are whole vectors */

/* How many stars (n) and detections (m), the camera, what is known of the lens before, and the constants of refine.py. */
typedef struct {
    int64_t n, m, least, steps, matchings;
    double aspect, focal, cx, cy, distortion[5], known[PARAMETERS];
    double zero, magnitude_gate, density, gate, huber, degrees, still, bent;
    const double *directions, *V, *drift;      /* (n, 3), (n,), (n,): these and the next are not the caller's to say */
    const double *xy, *covariance, *magnitude; /* (m, 2), (m, 2, 2), (m,) */
} Problem;

/* As in refine.py: R (3, 3), p of ln f, e_x, e_y, k1, p1, p2, and the last step with its covariance and scale. */
typedef struct {
    double R[9], p[6], delta[PARAMETERS], covariance[PARAMETERS * PARAMETERS], scale;
} Fit;

/* A detection's place in the order of x, its variance and what it is compared by. */
typedef struct {
    double x, y, magnitude, sigma2;
    int64_t j;
} Seen;

/* Of stars: predicted (n, 2), J (n, 2, ROW), apart (n,) from the nearest detection, gain, and nearest. Of detections: by_x, sigma2,
   closest, and its star. factorial: (n + 2,) logs. i, j: (n,) the matches of one look. */
typedef struct {
    double *predicted, *J, *apart, *gain, *factorial, *sigma2, *closest;
    int64_t *nearest, *star, *i, *j;
    Seen *by_x;
} Room;

static int rising(const void *a, const void *b)
{
    const Seen *p = a, *q = b;
    return p->x != q->x ? (p->x > q->x) - (p->x < q->x) : (p->j > q->j) - (p->j < q->j);
}

static void sort_by_x(const Problem *q, Room *room)
{
    for (int64_t j = 0; j < q->m; j++) {
        double x = q->xy[2 * j]; /* what is no number has no place in an order */
        room->by_x[j] = (Seen){isnan(x) ? INFINITY : x, q->xy[2 * j + 1], q->magnitude[j], 0.0, j};
    }
    qsort(room->by_x, (size_t)q->m, sizeof(Seen), rising);
}

/* First in the order whose x is not less. */
static int64_t first_right(const Seen *by_x, int64_t m, double x)
{
    int64_t low = 0, high = m;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (by_x[middle].x < x)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* The least turn (3, 3) that takes z to the direction of [x, y, 1]. */
static void turn_to(double x, double y, double *T)
{
    double length = sqrt(x * x + y * y + 1.0), a = x / length, b = y / length, c = 1.0 / length, k = 1.0 / (1.0 + c);
    double turn[9] = {1.0 - k * a * a, -k * a * b, a, -k * a * b, 1.0 - k * b * b, b, -a, -b, c};
    memcpy(T, turn, sizeof turn);
}

static void product(const double *A, const double *B, double *out)
{
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            out[3 * r + c] = A[3 * r] * B[c] + A[3 * r + 1] * B[3 + c] + A[3 * r + 2] * B[6 + c];
}

/* As `Lens.predict` (lens.py), of all stars. */
FAST static void predict(const Problem *q, const Fit *fit, Room *room)
{
    double a = q->aspect, f = q->focal * exp(fit->p[0]), fa = f / a, ex = fit->p[1], ey = fit->p[2];
    double k1 = q->distortion[0] + fit->p[3], k2 = q->distortion[1];
    double p1 = q->distortion[2] + fit->p[4], p2 = q->distortion[3] + fit->p[5];
    double k3 = q->distortion[4], sx = -ex / f, sy = -a * ey / f, square = sx * sx + sy * sy, T[9], M[9];
    sx = sx / (1.0 + k1 * square), sy = sy / (1.0 + k1 * square);
    turn_to(sx, sy, T);
    product(T, fit->R, M);
    for (int64_t i = 0; i < q->n; i++) {
        const double *d = q->directions + 3 * i;
        double z = M[6] * d[0] + M[7] * d[1] + M[8] * d[2];
        double x = (M[0] * d[0] + M[1] * d[1] + M[2] * d[2]) / z, y = (M[3] * d[0] + M[4] * d[1] + M[5] * d[2]) / z;
        double xy = x * y, xx = 1.0 + x * x, yy = 1.0 + y * y, r2 = x * x + y * y;
        double shift_x = -sx * xx - sy * xy, shift_y = -sy * yy - sx * xy;
        double g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), h = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3));
        double xd = x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        double yd = y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        double cross = h * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
        double dxx = g + h * x * x + 2.0 * p1 * y + 6.0 * p2 * x, dyy = g + h * y * y + 6.0 * p1 * y + 2.0 * p2 * x;
        double u[3] = {f * (dxx * -xy + cross * -yy), f * (dxx * xx + cross * xy), f * (dxx * -y + cross * x)};
        double v[3] = {fa * (cross * -xy + dyy * -yy), fa * (cross * xx + dyy * xy), fa * (cross * -y + dyy * x)};
        double *Ju = room->J + 2 * ROW * i, *Jv = Ju + ROW;
        for (int c = 0; c < 3; c++) {
            Ju[c] = u[0] * T[c] + u[1] * T[3 + c] + u[2] * T[6 + c];
            Jv[c] = v[0] * T[c] + v[1] * T[3 + c] + v[2] * T[6 + c];
        }
        Ju[3] = f * (xd + dxx * shift_x + cross * shift_y), Jv[3] = fa * (yd + cross * shift_x + dyy * shift_y);
        Ju[4] = 1.0 - u[1] / f, Jv[4] = -v[1] / f;
        Ju[5] = a * u[0] / f, Jv[5] = 1.0 + a * v[0] / f;
        Ju[6] = f * x * r2, Jv[6] = fa * y * r2;
        Ju[7] = 2.0 * f * xy, Jv[7] = fa * (r2 + 2.0 * y * y);
        Ju[8] = f * (r2 + 2.0 * x * x), Jv[8] = 2.0 * fa * xy;
        for (int c = PARAMETERS; c < ROW; c++)
            Ju[c] = Jv[c] = 0.0;
        room->predicted[2 * i] = q->cx + ex + f * xd, room->predicted[2 * i + 1] = q->cy + ey + fa * yd;
    }
}

/* By how much a row of J (ROW,) moves with the step. */
static inline __attribute__((always_inline)) double moved(const double *J, const Fit *fit)
{
    double sum = 0.0;
    for (int c = 0; c < PARAMETERS; c++)
        sum += J[c] * fit->delta[c];
    return sum;
}

/* Inverse of the symmetric A (9, 9) of which the lower half is given, by Cholesky's factor. A pivot below TINY, which only rounding
   leaves, is TINY: what nothing fixes is uncertain by that much, and the inverse has no negative variance. */
static void invert(double A[PARAMETERS][PARAMETERS], double *out)
{
    double B[PARAMETERS][PARAMETERS] = {{0.0}}; /* of the factor, by rows */
    for (int c = 0; c < PARAMETERS; c++) {
        for (int k = 0; k < c; k++)
            A[c][c] -= A[c][k] * A[c][k];
        A[c][c] = sqrt(A[c][c] < TINY ? TINY : A[c][c]);
        for (int r = c + 1; r < PARAMETERS; r++) {
            for (int k = 0; k < c; k++)
                A[r][c] -= A[r][k] * A[c][k];
            A[r][c] /= A[c][c];
        }
    }
    for (int c = 0; c < PARAMETERS; c++)
        for (int r = c; r < PARAMETERS; r++) {
            double sum = r == c;
            for (int k = c; k < r; k++)
                sum -= A[r][k] * B[k][c];
            B[r][c] = sum / A[r][r];
        }
    for (int r = 0; r < PARAMETERS; r++)
        for (int c = 0; c <= r; c++) {
            double sum = 0.0;
            for (int k = r; k < PARAMETERS; k++)
                sum += B[k][r] * B[k][c];
            out[PARAMETERS * r + c] = out[PARAMETERS * c + r] = sum;
        }
}

/* As `_settle`, from the fit's step, covariance and scale. i, j: (count,) the matches. */
FAST static void settle(
    const Problem *q, const Room *room, Fit *fit, const int64_t *i, const int64_t *j, int64_t count, int rounds)
{
    double size[PARAMETERS], *P = fit->covariance, *delta = fit->delta, other = 1.0 / (q->aspect * q->aspect);
    for (int c = 0; c < PARAMETERS; c++)
        size[c] = q->known[c];
    for (int64_t k = 0; k < count; k++) {
        const double *Ju = room->J + 2 * ROW * i[k], *Jv = Ju + ROW;
        for (int c = 0; c < PARAMETERS; c++)
            size[c] += Ju[c] * Ju[c] + Jv[c] * Jv[c];
    }
    for (int c = 0; c < PARAMETERS; c++)
        size[c] = 1.0 / sqrt(size[c]);
    for (int round = 0; round < rounds; round++) {
        double N[PARAMETERS][ROW] = {{0.0}}, g[ROW] = {0.0}, S[PARAMETERS][PARAMETERS], weights = 0.0, squares = 0.0, seen = PARAMETERS;
        for (int64_t k = 0; k < count; k++) {
            const double *Ju = room->J + 2 * ROW * i[k], *Jv = Ju + ROW, *C = q->covariance + 4 * j[k];
            double drift = q->drift[i[k]] * q->drift[i[k]], c00 = C[0] + drift, c11 = C[3] + drift * other;
            double det = c00 * c11 - C[1] * C[1], w00 = c11 / det, w01 = -C[1] / det, w11 = c00 / det;
            double tx = q->xy[2 * j[k]] - room->predicted[2 * i[k]], ty = q->xy[2 * j[k] + 1] - room->predicted[2 * i[k] + 1];
            double rx = tx - moved(Ju, fit), ry = ty - moved(Jv, fit);
            double square = w00 * rx * rx + 2.0 * w01 * rx * ry + w11 * ry * ry, weight, a[ROW], b[ROW];
            square = square < 1e-12 ? 1e-12 : square;
            weight = q->huber * fit->scale / sqrt(square);
            weight = weight > 1.0 ? 1.0 : weight;
            weights += weight, squares += weight * square;
            for (int c = 0; c < ROW; c++) {
                a[c] = weight * (w00 * Ju[c] + w01 * Jv[c]), b[c] = weight * (w01 * Ju[c] + w11 * Jv[c]);
                g[c] += a[c] * tx + b[c] * ty;
            }
            for (int r = 0; r < PARAMETERS; r++)
                for (int c = 0; c < ROW; c++)
                    N[r][c] += Ju[r] * a[c] + Jv[r] * b[c];
        }
        for (int c = 0; c < PARAMETERS; c++)
            seen -= P[(PARAMETERS + 1) * c] * q->known[c]; /* parameters that the stars fix, not the priors */
        double freedom = 2.0 * weights - seen;
        fit->scale = sqrt((q->degrees + squares) / (q->degrees + (freedom > 0.0 ? freedom : 0.0)));
        double share = 1.0 / (fit->scale * fit->scale);
        for (int r = 0; r < PARAMETERS; r++)
            for (int c = 0; c <= r; c++)
                S[r][c] = (N[r][c] * share + (r == c ? q->known[c] : 0.0)) * (size[r] * size[c]) + (r == c ? TINY : 0.0);
        invert(S, P);
        for (int r = 0; r < PARAMETERS; r++)
            for (int c = 0; c < PARAMETERS; c++)
                P[PARAMETERS * r + c] *= size[r] * size[c];
        for (int c = 0; c < PARAMETERS; c++)
            g[c] = g[c] * share - (c < 3 ? 0.0 : q->known[c] * fit->p[c - 3]);
        for (int r = 0; r < PARAMETERS; r++) {
            delta[r] = 0.0;
            for (int c = 0; c < PARAMETERS; c++)
                delta[r] += P[PARAMETERS * r + c] * g[c];
        }
    }
}

/* As `_depth`, of the matches' gains and the stars i (count,). */
static int64_t depth(const Problem *q, const Room *room, int64_t count)
{
    double sum = 0.0, vacancy = 0.0, best = -INFINITY, m = (double)q->m + 1.0;
    const double *factorial = room->factorial;
    int64_t at = 0;
    for (int64_t k = 1; k <= count; k++) {
        int64_t S = room->i[k - 1] + 1;
        sum += room->gain[k - 1], vacancy += log(m / (m - (double)k));
        double total = sum + vacancy + factorial[k] + factorial[S - k] - factorial[S + 1] - log((double)S);
        if (k == 1 || total > best)
            best = total, at = k;
    }
    return at;
}

/* As `_matched`, with the matches in the room; the number of them. A place that is no number matches nothing. */
FAST static int64_t match(const Problem *q, const Fit *fit, Room *room)
{
    double P[PARAMETERS][ROW] = {{0.0}}, most = 0.0, far = q->gate * q->gate;
    int64_t count = 0;
    for (int r = 0; r < PARAMETERS; r++)
        memcpy(P[r], fit->covariance + PARAMETERS * r, PARAMETERS * sizeof(double));
    for (int64_t j = 0; j < q->m; j++) {
        room->sigma2[j] = fit->scale * fit->scale * 0.5 * (q->covariance[4 * j] + q->covariance[4 * j + 3]);
        most = room->sigma2[j] > most ? room->sigma2[j] : most;
        room->closest[j] = INFINITY, room->star[j] = -1;
    }
    for (int64_t k = 0; k < q->m; k++)
        room->by_x[k].sigma2 = room->sigma2[room->by_x[k].j];
    for (int64_t i = 0; i < q->n; i++) {
        const double *Ju = room->J + 2 * ROW * i, *Jv = Ju + ROW;
        double u[ROW] = {0.0}, v[ROW] = {0.0}, sum = 0.0;
        for (int r = 0; r < PARAMETERS; r++)
            for (int c = 0; c < ROW; c++)
                u[c] += Ju[r] * P[r][c], v[c] += Jv[r] * P[r][c];
        for (int c = 0; c < PARAMETERS; c++)
            sum += u[c] * Ju[c] + v[c] * Jv[c];
        double doubt2 = 0.5 * sum + q->drift[i] * q->drift[i], reach = sqrt(far * (most + doubt2)) * (1.0 + 1e-12);
        double x = room->predicted[2 * i] + moved(Ju, fit), y = room->predicted[2 * i + 1] + moved(Jv, fit);
        room->nearest[i] = -1, room->apart[i] = INFINITY, room->gain[i] = doubt2;
        for (int64_t k = first_right(room->by_x, q->m, x - reach); k < q->m; k++) {
            const Seen *d = room->by_x + k;
            double dx = x - d->x, dy = y - d->y, apart = dx * dx + dy * dy;
            if (!(dx >= -reach))
                break;
            if (!(apart <= far * (d->sigma2 + doubt2)) || !(fabs(q->V[i] - d->magnitude - q->zero) < q->magnitude_gate))
                continue;
            if (apart < room->apart[i] || (apart == room->apart[i] && d->j < room->nearest[i]))
                room->apart[i] = apart, room->nearest[i] = d->j;
            if (apart < room->closest[d->j])
                room->closest[d->j] = apart, room->star[d->j] = i;
        }
    }
    for (int64_t i = 0; i < q->n; i++) {
        int64_t j = room->nearest[i];
        if (j < 0 || room->star[j] != i)
            continue;
        double variance = room->sigma2[j] + room->gain[i];
        room->i[count] = i, room->j[count] = j;
        /* Place `count` is at or before i, whose doubt is read. */
        room->gain[count++] = -0.5 * room->apart[i] / variance - log(2.0 * 3.14159265358979323846 * variance * q->density);
    }
    return count;
}

/* R becomes exp([theta x]) R, as `verify.turn`. */
static void turn(const double *theta, double *R)
{
    double t = sqrt(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]);
    double a = t > 1e-12 ? sin(t) / t : 1.0, b = t > 1e-6 ? (1.0 - cos(t)) / (t * t) : 0.5, KK[9], out[9];
    double K[9] = {0.0, -theta[2], theta[1], theta[2], 0.0, -theta[0], -theta[1], theta[0], 0.0};
    product(K, K, KK);
    for (int k = 0; k < 9; k++)
        K[k] = a * K[k] + b * KK[k];
    product(K, R, out);
    for (int k = 0; k < 9; k++)
        R[k] += out[k];
}

/* As `Lens.second_order`. */
static double second_order(const Problem *q, const double *delta)
{
    double turned = fabs(delta[0]) + fabs(delta[1]) + fabs(delta[2]), centre = fabs(delta[4]) + fabs(delta[5]);
    double sum = turned + fabs(delta[3]) + centre / q->focal;
    return q->focal * sum * sum;
}

static int64_t fitted(const Problem *q, Fit *fit, Room *room, int64_t count, int64_t *i, int64_t *j, double *residual)
{
    room->factorial[0] = 0.0;
    for (int64_t k = 1; k < q->n + 2; k++)
        room->factorial[k] = room->factorial[k - 1] + log((double)k);
    sort_by_x(q, room);
    memset(fit->covariance, 0, sizeof fit->covariance);
    for (int c = 0; c < PARAMETERS; c++)
        fit->covariance[(PARAMETERS + 1) * c] = q->known[c] > 0.0 ? 1.0 / (q->known[c] > 1e-300 ? q->known[c] : 1e-300) : 0.0;
    fit->scale = 1.0;
    for (int64_t step = 0; step < q->steps; step++) {
        predict(q, fit, room);
        memset(fit->delta, 0, sizeof fit->delta);
        settle(q, room, fit, i, j, count, step == 0 ? 2 : 1);
        for (int64_t look = 0; look < q->matchings; look++) {
            int64_t found = match(q, fit, room), half = count / 2;
            int few = found < (half > q->least ? half : q->least);
            found = depth(q, room, found);
            size_t bytes = sizeof(int64_t) * (size_t)found;
            int same = found == count && memcmp(i, room->i, bytes) == 0 && memcmp(j, room->j, bytes) == 0;
            if (same || few || found < q->least)
                break;
            count = found;
            memcpy(i, room->i, bytes);
            memcpy(j, room->j, bytes);
            settle(q, room, fit, i, j, count, 2);
        }
        turn(fit->delta, fit->R);
        for (int c = 0; c < 6; c++)
            fit->p[c] += fit->delta[3 + c];
        int still = 1;
        for (int64_t k = 0; k < 2 * count; k++) {
            int64_t star = 2 * i[k / 2] + k % 2;
            double by = moved(room->J + ROW * star, fit);
            residual[k] = q->xy[2 * j[k / 2] + k % 2] - room->predicted[star] - by;
            still &= fabs(by) < q->still;
        }
        if (still || second_order(q, fit->delta) < q->bent)
            break;
    }
    return count;
}

/* The fit from R, p and the first matches, of which there are `count`; over all of these it writes.

   given: the arrays of Problem, one after the other. out: Fit and, behind it, residuals (space, 2). matches: (2, space) of stars and
   detections; space is at least n and count. Returns the number of matches; -1 where sizes or indices are out of range, -2 where
   there is no memory. */
int64_t helmstar_refine(const Problem *told, const double *given, double *out, int64_t *matches, int64_t space, int64_t count)
{
    int64_t n = told->n, m = told->m, found = -2, *i = matches, *j = matches + space;
    if (n < 1 || m < 1 || n > 1 << 26 || m > 1 << 26 || count < 1 || space < count || space < n)
        return -1;
    for (int64_t k = 0; k < count; k++)
        if (i[k] < 0 || i[k] >= n || j[k] < 0 || j[k] >= m)
            return -1;
    Problem q = *told;
    q.directions = given, q.V = given + 3 * n, q.drift = q.V + n, q.xy = q.drift + n, q.covariance = q.xy + 2 * m;
    q.magnitude = q.covariance + 4 * m;
    Fit fit;
    memcpy(fit.R, out, sizeof fit.R);
    memcpy(fit.p, out + 9, sizeof fit.p);
    double *real = malloc(sizeof(double) * (size_t)((2 + 2 * ROW + 3) * n + 2 + 2 * m));
    int64_t *whole = malloc(sizeof(int64_t) * (size_t)(3 * n + m));
    Seen *by_x = malloc(sizeof(Seen) * (size_t)m);
    if (real != NULL && whole != NULL && by_x != NULL) {
        Room room;
        room.J = real, room.predicted = room.J + 2 * ROW * n, room.apart = room.predicted + 2 * n;
        room.gain = room.apart + n, room.factorial = room.gain + n, room.sigma2 = room.factorial + n + 2;
        room.closest = room.sigma2 + m, room.by_x = by_x;
        room.nearest = whole, room.i = whole + n, room.j = whole + 2 * n, room.star = whole + 3 * n;
        found = fitted(&q, &fit, &room, count, i, j, out + sizeof(Fit) / sizeof(double));
        memcpy(out, &fit, sizeof fit);
    }
    free(real);
    free(whole);
    free(by_x);
    return found;
}
