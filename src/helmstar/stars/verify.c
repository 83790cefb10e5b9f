/* One hypothesis matched, stepped and weighed: what `_Field.settle` of verify.py does with NumPy, from the start to the best fit.

   Formulas, gates and ties are those of the NumPy twin; only the order of sums differs. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define MOST 512  /* detections */
#define DEEP 398  /* stars, for which the table of factorials has one more */
#define HEAD 29   /* numbers of a fit before its residuals: R (3, 3), f, log odds, zero point, covariance (4, 4), scale */

static const double TURN = 2.0 * 3.14159265358979323846;

/* As in verify.py: Detections, the stars that may be seen, Freedom, and the constants of the model. */
typedef struct {
    int64_t n, stars, limit, has_magnitude, knows_zero, is_free;
    double low[2], high[2], faintest, magnitude_sigma, zero_point, zero_point_range, broad_share, broad_most, broad_factor;
    double f_low, f_high, f_known, f_weight, log_volume, gate, hopeless;
    /* (n, 2), (n,), (n,), (n,), (n + 1,), (n,): the last is not read without magnitudes */
    const double *xy, *sigma, *log_density, *log_magnitude_density, *vacancy, *magnitude;
    const double *r, *V; /* (stars, 3), (stars,) */
    const double *log_factorial, *harmonic;
    int64_t magnitude_scales; /* factors on the magnitudes' sigma, and the logs of their priors */
    const double *magnitude_scale, *log_prior;
} Field;

/* A star that is seen, by its index, and what it was matched with. */
typedef struct {
    int64_t star, j;
    double x, y, cost;
} Seen;

typedef struct {
    int64_t rank, j;
    double x, y, dx, dy, sigma, square, gain;
} Match;

static double within(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

/* The stars in the image, the brightest first: at most `limit`. */
static int64_t look(const Field *q, const double *R, double f, Seen *seen)
{
    int64_t count = 0;
    for (int64_t k = 0; k < q->stars && count < q->limit; k++) {
        const double *r = q->r + 3 * k;
        double z = R[6] * r[0] + R[7] * r[1] + R[8] * r[2], scale = f / (z > 1e-3 ? z : 1e-3);
        double x = (R[0] * r[0] + R[1] * r[1] + R[2] * r[2]) * scale, y = (R[3] * r[0] + R[4] * r[1] + R[5] * r[2]) * scale;
        if (x >= q->low[0] && x <= q->high[0] && y >= q->low[1] && y <= q->high[1] && q->faintest >= q->V[k])
            seen[count++] = (Seen){k, -1, x, y, INFINITY};
    }
    return count;
}

/* Stars and detections that are each other's nearest within the gate, by star: as `nearest_pairs`. zero: NULL where magnitudes
   have no say. */
static int64_t pairs(const Field *q, Seen *seen, int64_t count, double gate, double scale, const double *zero, Match *out)
{
    double far[MOST], weight[MOST], closest[MOST];
    int64_t star[MOST], found = 0;
    for (int64_t j = 0; j < q->n; j++) {
        double sigma = q->sigma[j];
        far[j] = gate * sigma * (gate * sigma), weight[j] = 1.0 / (sigma * sigma), closest[j] = INFINITY, star[j] = -1;
    }
    for (int64_t i = 0; i < count; i++) {
        Seen *s = seen + i;
        for (int64_t j = 0; j < q->n; j++) {
            double dx = s->x - q->xy[2 * j], dy = s->y - q->xy[2 * j + 1], square = dx * dx + dy * dy;
            if (!(square <= far[j]))
                continue;
            double cost = square * weight[j];
            if (zero != NULL) {
                double z = (q->V[s->star] - q->magnitude[j] - *zero) / q->magnitude_sigma;
                cost += z * z > 12.0 ? 12.0 : z * z;
            }
            /* Of equals the first is the nearest, either way. */
            if (cost < s->cost)
                s->cost = cost, s->j = j;
            if (cost < closest[j])
                closest[j] = cost, star[j] = i;
        }
    }
    for (int64_t i = 0; i < count; i++) {
        int64_t j = seen[i].j;
        if (j < 0 || star[j] != i)
            continue;
        double dx = q->xy[2 * j] - seen[i].x, dy = q->xy[2 * j + 1] - seen[i].y, sigma = scale * q->sigma[j];
        out[found++] = (Match){i, j, seen[i].x, seen[i].y, dx, dy, sigma, (dx * dx + dy * dy) / (sigma * sigma), 0.0};
    }
    return found;
}

/* The upper median, as `middle`: x (count,) is left in another order. */
static double middle(double *x, int64_t count)
{
    int64_t low = 0, high = count - 1, k = count / 2;
    while (low < high) {
        double pivot = x[low + (high - low) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (x[i] < pivot)
                i++;
            while (x[j] > pivot)
                j--;
            if (i <= j) {
                double t = x[i];
                x[i++] = x[j], x[j--] = t;
            }
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            break;
    }
    return x[k];
}

/* As `zero_point`. */
static double zero_point(const Field *q, const Seen *seen, const Match *m, int64_t count)
{
    double dm[DEEP];
    if (!q->has_magnitude)
        return 0.0;
    if (q->knows_zero)
        return q->zero_point;
    for (int64_t k = 0; k < count; k++)
        dm[k] = q->V[seen[m[k].rank].star] - q->magnitude[m[k].j];
    return middle(dm, count);
}

/* As `magnitude_gain`, of one match. */
static double magnitude_gain(const Field *q, double V, int64_t j, double zero, double factor)
{
    if (!q->has_magnitude)
        return 0.0;
    double d = V - q->magnitude[j] - zero, square = d * d, s = factor * q->magnitude_sigma;
    double broad = q->broad_factor * s < q->broad_most ? q->broad_factor * s : q->broad_most;
    double density = (1.0 - q->broad_share) / s * exp(-0.5 / (s * s) * square)
        + q->broad_share / broad * exp(-0.5 / (broad * broad) * square);
    return log(density / sqrt(TURN) + 1e-6) - q->log_magnitude_density[j];
}

/* Information (4, 4) of (theta, ln f) and the right side (4,) of matches with these sigmas. */
static void normal(const Field *q, const Match *m, int64_t count, const double *sigma, double f, double A[4][4], double g[4])
{
    memset(A, 0, 16 * sizeof(double));
    memset(g, 0, 4 * sizeof(double));
    for (int64_t k = 0; k < count; k++) {
        double x = m[k].x / f, y = m[k].y / f, w = f / sigma[k], dx = m[k].dx / sigma[k], dy = m[k].dy / sigma[k];
        double a[4] = {-x * y * w, (1.0 + x * x) * w, -y * w, x * w}, b[4] = {(-1.0 - y * y) * w, x * y * w, x * w, y * w};
        for (int r = 0; r < 4; r++) {
            g[r] += a[r] * dx + b[r] * dy;
            for (int c = 0; c <= r; c++)
                A[r][c] += a[r] * a[c] + b[r] * b[c];
        }
    }
    for (int r = 0; r < 4; r++)
        for (int c = r + 1; c < 4; c++)
            A[r][c] = A[c][r];
    if (!q->is_free) {
        A[3][3] += q->f_weight;
        g[3] += q->f_weight * log(q->f_known / f);
    }
}

/* Gauss's elimination with the largest pivot first, in place, of A and the right side with it. Sign of the determinant, and the log
   of its size. */
static double eliminate(double A[4][4], double g[4], double *logarithm)
{
    double sign = 1.0;
    *logarithm = 0.0;
    for (int c = 0; c < 4; c++) {
        int best = c;
        for (int r = c + 1; r < 4; r++)
            if (fabs(A[r][c]) > fabs(A[best][c]))
                best = r;
        if (best != c) {
            double row[4], value = g[c];
            memcpy(row, A[c], sizeof row);
            memcpy(A[c], A[best], sizeof row);
            memcpy(A[best], row, sizeof row);
            g[c] = g[best], g[best] = value;
            sign = -sign;
        }
        double pivot = A[c][c];
        if (pivot == 0.0)
            return 0.0;
        sign = pivot < 0.0 ? -sign : sign;
        *logarithm += log(fabs(pivot));
        for (int r = c + 1; r < 4; r++) {
            double share = A[r][c] / pivot;
            for (int k = c + 1; k < 4; k++)
                A[r][k] -= share * A[c][k];
            g[r] -= share * g[c];
        }
    }
    return sign;
}

/* A x = g, in place: x is left in g. The determinant's sign, 0 where there is no solution. */
static double solve(double A[4][4], double g[4])
{
    double logarithm, sign = eliminate(A, g, &logarithm);
    for (int r = 3; r >= 0 && sign != 0.0; r--) {
        for (int k = r + 1; k < 4; k++)
            g[r] -= A[r][k] * g[k];
        g[r] /= A[r][r];
    }
    return sign;
}

/* As `covariance_of`. */
static void invert(double information[4][4], double *covariance)
{
    for (int c = 0; c < 4; c++) {
        double A[4][4], g[4] = {0.0};
        memcpy(A, information, sizeof A);
        g[c] = 1.0;
        double sign = solve(A, g);
        for (int r = 0; r < 4; r++)
            covariance[4 * r + c] = sign != 0.0 ? g[r] : NAN;
    }
}

/* As `turn`: R becomes exp([theta x]) R. */
static void turn(const double *theta, double *R)
{
    double t = sqrt(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]), out[9];
    double a = t > 1e-12 ? sin(t) / t : 1.0, b = t > 1e-6 ? (1.0 - cos(t)) / (t * t) : 0.5;
    double K[3][3] = {{0.0, -theta[2], theta[1]}, {theta[2], 0.0, -theta[0]}, {-theta[1], theta[0], 0.0}}, T[3][3];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            T[r][c] = a * K[r][c] + b * (K[r][0] * K[0][c] + K[r][1] * K[1][c] + K[r][2] * K[2][c]);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            out[3 * r + c] = R[3 * r + c] + (T[r][0] * R[c] + T[r][1] * R[3 + c] + T[r][2] * R[6 + c]);
    memcpy(R, out, sizeof out);
}

/* Gauss and Newton's step of R and f; far residuals of a wide gate pull less. 0 where it has no solution. */
static int step(const Field *q, const Match *m, int64_t count, double widen, double *R, double *f)
{
    double A[4][4], g[4], soft[DEEP], damp = 0.0;
    for (int64_t k = 0; k < count; k++)
        soft[k] = m[k].sigma * sqrt(1.0 + m[k].square / (2.0 * widen * (2.0 * widen)));
    normal(q, m, count, soft, *f, A, g);
    for (int r = 0; r < 4; r++)
        damp += A[r][r];
    for (int r = 0; r < 4; r++)
        A[r][r] += 1e-12 * damp + 1e-9;
    if (solve(A, g) == 0.0)
        return 0;
    turn(g, R);
    *f = within(*f * exp(within(g[3], -0.1, 0.1)), 0.97 * q->f_low, 1.03 * q->f_high);
    return 1;
}

/* As `verify.log_odds`; the matches come by rank. */
static double log_odds(const Field *q, const Match *m, int64_t count, int64_t expected)
{
    double total[DEEP + 1], sum = 0.0, top = -INFINITY, all = 0.0;
    const double *factorial = q->log_factorial;
    int64_t k = 0;
    for (int64_t depth = 1; depth <= expected; depth++) {
        while (k < count && m[k].rank < depth)
            sum += m[k++].gain;
        total[depth] = sum + q->vacancy[k] + (factorial[k] + factorial[depth - k] - factorial[depth + 1]);
        if (q->has_magnitude && q->knows_zero)
            total[depth] += log(2.0 * (double)(k + 1) / (double)(depth + 2));
        top = total[depth] > top ? total[depth] : top;
    }
    for (int64_t depth = 1; depth <= expected; depth++)
        all += exp(total[depth] - top) / (double)depth;
    return top + log(all / q->harmonic[expected]);
}

/* Log odds of what matches at one sigma of the magnitudes, without its prior. Only those stay that speak for the hypothesis: *count is
   theirs, and the information. Not to be read where fewer than two stay. */
static double weigh_at(
    const Field *q, const Seen *seen, Match *m, int64_t *count, int64_t expected, double f, double scale, double zero,
    double factor, double information[4][4])
{
    double A[4][4], g[4], sigma[DEEP], logarithm, price = 0.0;
    int64_t all = *count, good = 0;
    for (int64_t k = 0; k < all; k++) {
        double gain = magnitude_gain(q, q->V[seen[m[k].rank].star], m[k].j, zero, factor) - 0.5 * m[k].square
            - log(TURN * (m[k].sigma * m[k].sigma)) - q->log_density[m[k].j];
        if (!(gain > 0.0))
            continue;
        m[good] = m[k];
        m[good].gain = gain, sigma[good] = m[good].sigma;
        good++;
    }
    *count = good;
    if (good < 2)
        return 0.0;
    normal(q, m, good, sigma, f, information, g);
    memcpy(A, information, sizeof A);
    if (q->has_magnitude && !q->knows_zero) {
        double share = sqrt(TURN) * (1.25 * q->magnitude_sigma / sqrt((double)all)) / q->zero_point_range;
        price = log(share < 1.0 ? share : 1.0);
    }
    double sign = eliminate(A, g, &logarithm), left = 0.5 * (4.0 * log(TURN) - logarithm) - q->log_volume;
    left = !(sign > 0.0) ? -INFINITY : left > 0.0 ? 0.0 : left;
    return log_odds(q, m, good, expected) + price - log(scale) + left;
}

/* As `_Field._weigh`: the matches m (*count,) become those that stay at the likeliest sigma. */
static double weigh(
    const Field *q, const Seen *seen, Match *m, int64_t *count, int64_t expected, double f, double scale, double zero,
    double information[4][4])
{
    Match some[DEEP], best[DEEP];
    int64_t all = *count, stay = 0;
    double top = -INFINITY, total = -INFINITY, own[4][4];
    for (int64_t h = 0; h < q->magnitude_scales; h++) {
        int64_t good = all;
        memcpy(some, m, sizeof(Match) * (size_t)all);
        int64_t deep = expected;
        if (q->has_magnitude && q->knows_zero) {
            double faintest = q->magnitude[q->n - 1] + q->zero_point + 3.0 * q->magnitude_scale[h] * q->magnitude_sigma;
            while (deep > 0 && q->V[seen[deep - 1].star] > faintest)
                deep--;
            while (good > 0 && some[good - 1].rank >= deep)
                good--;
        }
        double odds = weigh_at(q, seen, some, &good, deep, f, scale, zero, q->magnitude_scale[h], own) + q->log_prior[h];
        if (good < 2)
            continue;
        double larger = odds > total ? odds : total, smaller = odds > total ? total : odds;
        total = smaller == -INFINITY ? larger : larger + log1p(exp(smaller - larger));
        if (stay == 0 || odds > top) {
            top = odds, stay = good;
            memcpy(best, some, sizeof(Match) * (size_t)good);
            memcpy(information, own, sizeof own);
        }
    }
    *count = stay;
    memcpy(m, best, sizeof(Match) * (size_t)stay);
    return total;
}

/* As `_Field._at_scale`, from R and f, the head of `fit`. */
static int64_t at_scale(
    const Field *q, double scale, double first_gate, int64_t rounds, double *fit, int64_t *star, int64_t *detection)
{
    Seen seen[DEEP];
    Match m[DEEP];
    double *R = fit, *f = fit + 9, zero = q->zero_point, information[4][4];
    int knows = (int)q->knows_zero;
    for (int64_t round = 0; round <= rounds; round++) {
        double widen = round == rounds || round > 1 ? 1.0 : round == 0 ? first_gate : 0.5 * (1.0 + first_gate);
        int64_t expected = look(q, R, *f, seen);
        const double *told = q->has_magnitude && knows && round > 0 ? &zero : NULL;
        int64_t count = pairs(q, seen, expected, widen * q->gate * scale, scale, told, m), good = count;
        if (count < 2)
            return 0;
        zero = zero_point(q, seen, m, count), knows = 1;
        if (round == rounds || (round == 1 && rounds > 2)) {
            Match weighed[DEEP];
            memcpy(weighed, m, sizeof(Match) * (size_t)count);
            double odds = weigh(q, seen, weighed, &good, expected, *f, scale, zero, information);
            if (good < 2)
                return 0;
            if (round == rounds) {
                fit[10] = odds, fit[11] = zero, fit[28] = scale;
                invert(information, fit + 12);
                for (int64_t k = 0; k < good; k++) {
                    star[k] = seen[weighed[k].rank].star, detection[k] = weighed[k].j;
                    fit[HEAD + 2 * k] = weighed[k].dx, fit[HEAD + 2 * k + 1] = weighed[k].dy;
                }
                return good;
            }
            if (odds < q->hopeless)
                return 0;
        }
        if (!step(q, m, count, widen, R, f))
            return -2;
    }
    return 0;
}

/* As `_typical`. */
static double typical(const Field *q, const double *residual, const int64_t *detection, int64_t count)
{
    double x[DEEP];
    for (int64_t k = 0; k < count; k++)
        x[k] = hypot(residual[2 * k], residual[2 * k + 1]) / q->sigma[detection[k]];
    return middle(x, count) / 1.18;
}

/* Matches and steps `rounds` times from R and f, the head of `fit`, then matches and weighs, at one scale of sigmas and from there at
   the next ones as long as that is asked for and helps. Number of matches: star and j (limit,) are theirs, and the residuals (2 limit,)
   after the fit's head. 0 where fewer than two stars fit or nothing speaks for it, -1 where sizes are out of range, -2 where a step has
   no solution. */
int64_t helmstar_settle(
    const Field *q, int64_t scales, const double *scale, double first_gate, int64_t rounds, double *fit, int64_t *star,
    int64_t *detection)
{
    double wider[HEAD + 2 * DEEP];
    int64_t stars[DEEP], detections[DEEP];
    if (q->n < 0 || q->n > MOST || q->limit < 0 || q->limit > DEEP || q->stars < 0 || scales < 1)
        return -1;
    int64_t count = at_scale(q, scale[0], first_gate, rounds, fit, star, detection);
    for (int64_t k = 1; k < scales && count > 0; k++) {
        if (fit[10] < 0.0 || typical(q, fit + HEAD, detection, count) < 1.25 * fit[28])
            break;
        memcpy(wider, fit, 10 * sizeof(double));
        int64_t more = at_scale(q, scale[k], 1.0, 2, wider, stars, detections);
        if (more < 0)
            return more;
        if (more == 0 || wider[10] <= fit[10])
            break;
        count = more;
        memcpy(fit, wider, sizeof(double) * (size_t)(HEAD + 2 * count));
        memcpy(star, stars, sizeof(int64_t) * (size_t)count);
        memcpy(detection, detections, sizeof(int64_t) * (size_t)count);
    }
    return count;
}
