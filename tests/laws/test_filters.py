"""Laws of the filters: agreement with independent recursions, equivalence of error sides, masks, gate, rates, precision.

Oracles, none of which shares code with the package: a Kalman filter and an RTS smoother in plain NumPy that drop the
absent rows, the batch least-squares solution of a whole trajectory, a multiplicative EKF with scipy's Rotation and the
matrix exponential, the posterior's minimum by scipy.optimize.

Every sequence has the same shapes, so that each filter compiles once and the cases differ by data alone. Tolerances:

- LINEAR: 30 steps with condition numbers of some 10 cost 1e-12. The scaled transform takes differences over alpha sigma
  and weighs their products by 1 / alpha^2: rounding of some eps / alpha^2 more, 1e-8 for the usual alpha = 1e-3;
- SIDES = 1e-9: the error sides are equal in exact arithmetic. Rounding in a gain is amplified by the condition of S = H P
  H^T + R, 1e4 where the filter starts 100 deg off; the cases in AMPLIFIED have 1e8;
- a belief that must not change is compared to the bit where the state is a vector. A unit quaternion is normalised
  again at each step, which may move its last bit: 4 eps.
"""

from __future__ import annotations

from functools import cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, multivariate_normal

from helmstar.backend import jax, jnp
from helmstar.core import (
    ABSENT,
    ACCEPTED,
    FORCED,
    GATED,
    REOPENED,
    Gate,
    Gaussian,
    Measurement,
    Model,
    Noise,
    Process,
    Sensor,
    chi_square_gate,
    no_gate,
    pytree,
)
from helmstar.evaluate import quadratic_form
from helmstar.filters import (
    ErrorStateKalmanFilter,
    UnscentedBelief,
    UnscentedKalmanFilter,
    kappa_form,
    run,
    scaled,
    smooth,
    smooth_step,
    step,
)
from helmstar.filters.ekf import carry_covariance
from helmstar.geometry import quaternion, so3
from helmstar.geometry.retraction import (
    euclidean,
    gibbs_left,
    product,
    quaternion_additive,
    so3_left,
    so3_right,
)
from helmstar.models import xu2020
from helmstar.models.attitude import (
    AttitudeDrift,
    GyroInput,
    GyroNoise,
    attitude_drift_model,
    attitude_model,
    star_directions,
    whole_attitude,
)
from helmstar.models.sensors import unit_star_directions

LINEAR = 1e-12
SIDES = 1e-9
EPS = np.finfo(float).eps
# Laws hold at every level of optimisation; at the lowest a program compiles in a third of the time.
FAST = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
compiled = partial(jax.jit, compiler_options=FAST)


def numpy_of(tree):
    return jax.tree.map(np.asarray, tree)


def worst(actual, expected) -> float:
    """Largest difference relative to the largest entry; a NaN is infinitely wrong."""
    a, b = np.asarray(actual, float), np.asarray(expected, float)
    assert a.shape == b.shape
    scale = np.max(np.abs(b), initial=1e-300)
    d = np.abs(a - b) / scale
    return float(np.max(np.where(np.isnan(d), np.inf, d), initial=0.0))


def worst_covariance(P, expected) -> float:
    """Largest difference in units of the expected sigmas: sigma_i sigma_j for the entry i, j."""
    P, expected = np.asarray(P), np.asarray(expected)
    s = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    d = np.abs(P - expected) / (s[..., :, None] * s[..., None, :])
    return float(np.max(np.where(np.isnan(d), np.inf, d)))


# --- a linear Gaussian problem -------------------------------------------------------------------------------------

T = 30
LINEAR_CASES = 3  # everything present; masks with NaN behind them and entries that are partly absent; with padding


@pytree
class Drive:
    B: jax.Array
    q: jax.Array


@pytree
class Line:
    C: jax.Array
    R: jax.Array


def _step(p: Drive, x, u, dt, w):
    return jnp.stack([x[0] + dt * x[1], x[1]]) + dt * u + p.B @ w


def _noise(p: Drive, x, u, dt):
    return jnp.diag(p.q * dt)


def _predict(p: Line, x, a):
    return p.C @ x + a


def _minus(z, z_hat):
    return z - z_hat


def _cov(p: Line, x, a):
    return p.R


B_W = np.array([[1.0, 0.3], [-0.2, 1.0]])
Q_W = np.array([0.02, 0.05])
C1, R1 = np.array([[1.0, 0.0], [1.0, 0.3]]), np.array([[0.5, 0.2], [0.2, 0.4]])
C2, R2 = np.array([[0.0, 1.0]]), np.array([[0.1]])
X0, P0 = np.array([1.0, -0.5]), np.array([[2.0, 0.3], [0.3, 1.0]])


LINES = [Line(jnp.asarray(C), jnp.asarray(R)) for C, R in ((C1, R1), (C2, R2))]
LINEAR_MODEL = Model(
    euclidean(2),
    Process(_step, Noise(_noise, 2), Drive(jnp.asarray(B_W), jnp.asarray(Q_W))),
    tuple(Sensor(_predict, _minus, _cov, p) for p in LINES),
)


class LinearData(NamedTuple):
    u: np.ndarray
    dt: np.ndarray
    z: tuple[np.ndarray, np.ndarray]
    a: tuple[np.ndarray, np.ndarray]
    mask: tuple[np.ndarray, np.ndarray]


@cache
def linear_data() -> LinearData:
    r = np.random.default_rng(1)
    shape = (LINEAR_CASES, T)
    u, dt = r.normal(size=(*shape, 2)), r.uniform(0.3, 2.0, size=shape)
    a = (r.normal(size=(*shape, 2)), r.normal(size=(*shape, 1)))
    mask = (np.ones((*shape, 2), bool), np.ones((*shape, 1), bool))
    mask[0][1], mask[1][1] = r.random((T, 2)) < 0.5, (np.arange(T) % 4 == 0)[:, None]
    dt[2, 10:14] = dt[2, 25:] = 0.0
    for m in mask:
        m[2, 10:14] = m[2, 25:] = False
    z = (np.empty((*shape, 2)), np.empty((*shape, 1)))
    for c in range(LINEAR_CASES):
        x = r.multivariate_normal(X0, P0)
        for k in range(T):
            F = np.array([[1.0, dt[c, k]], [0.0, 1.0]])
            x = F @ x + dt[c, k] * u[c, k] + B_W @ (np.sqrt(Q_W * dt[c, k]) * r.normal(size=2))
            for i, (C, R) in enumerate(((C1, R1), (C2, R2))):
                z[i][c, k] = C @ x + a[i][c, k] + np.linalg.cholesky(R) @ r.normal(size=len(C))
    for i in range(2):
        z[i][~mask[i]] = np.nan
    return LinearData(u, dt, z, a, mask)


class NumpyTrack(NamedTuple):
    x_pred: np.ndarray
    P_pred: np.ndarray
    F: np.ndarray
    x: np.ndarray
    P: np.ndarray
    nis: np.ndarray
    loglik: np.ndarray
    dof: np.ndarray


def numpy_kalman(d: LinearData, c: int) -> NumpyTrack:
    """The textbook's Kalman filter in the standard form, absent rows dropped."""
    x, P, out = X0, P0, []
    for k in range(T):
        F = np.array([[1.0, d.dt[c, k]], [0.0, 1.0]])
        x, P = F @ x + d.dt[c, k] * d.u[c, k], F @ P @ F.T + B_W @ np.diag(Q_W * d.dt[c, k]) @ B_W.T
        row = [x, P, F]
        nis, loglik, dof = np.zeros(2), np.zeros(2), np.zeros(2, int)
        for i, (C, R) in enumerate(((C1, R1), (C2, R2))):
            m = d.mask[i][c, k]
            dof[i] = m.sum()
            if not dof[i]:
                continue
            H, Rm = C[m], R[np.ix_(m, m)]
            e = (d.z[i][c, k] - d.a[i][c, k])[m] - H @ x
            S = H @ P @ H.T + Rm
            K = P @ H.T @ np.linalg.inv(S)
            nis[i] = e @ np.linalg.solve(S, e)
            loglik[i] = multivariate_normal.logpdf(e, np.zeros(len(e)), S)
            x, P = x + K @ e, P - K @ S @ K.T
        out.append((*row, x, P, nis, loglik, dof))
    return NumpyTrack(*(np.array(v) for v in zip(*out, strict=True)))


@cache
def numpy_tracks() -> NumpyTrack:
    tracks = [numpy_kalman(linear_data(), c) for c in range(LINEAR_CASES)]
    return NumpyTrack(*(np.stack(v) for v in zip(*tracks, strict=True)))


@partial(compiled, static_argnames=("filter",))
def _run_linear(filter, spreads, u, dt, ms, gate):
    """(spreads, cases, steps) for a UKF, (cases, steps) for the others."""

    def one(spread, u, dt, ms):
        x, P = jnp.asarray(X0), jnp.asarray(P0)
        belief = Gaussian(x, P) if spread is None else UnscentedBelief(x, P, spread)
        return run(filter, LINEAR_MODEL, belief, u, dt, ms, gate)[2]

    over_cases = jax.vmap(one, in_axes=(None, 0, 0, 0))
    return (
        over_cases(None, u, dt, ms)
        if spreads is None
        else jax.vmap(over_cases, in_axes=(0, None, None, None))(spreads, u, dt, ms)
    )


SPREADS = (scaled(1e-3), scaled(1e-2), scaled(0.3, 2.0, 1.0), kappa_form(1.0), kappa_form(-1.0))
SPREAD_TOLERANCES = (1e-8, 1e-9, LINEAR, LINEAR, LINEAR)


@cache
def linear_track(kind: str):
    d = linear_data()
    ms = tuple(Measurement(*(jnp.asarray(v) for v in zam)) for zam in zip(d.z, d.a, d.mask, strict=True))
    args = (jnp.asarray(d.u), jnp.asarray(d.dt), ms, no_gate())
    if kind == "ukf":
        spreads = jax.tree.map(lambda *a: jnp.stack(a), *SPREADS)
        return numpy_of(_run_linear(UnscentedKalmanFilter(euclidean(2)), spreads, *args))
    iterations = {"ekf": 1, "iterated": 5}[kind]
    return numpy_of(_run_linear(ErrorStateKalmanFilter(euclidean(2), iterations=iterations), None, *args))


def linear_views(kind: str):
    """Tracks over cases with their tolerance, one for each spread."""
    track = linear_track(kind)
    if kind != "ukf":
        return [(track, LINEAR)]
    return [(jax.tree.map(lambda a, i=i: a[i], track), tolerance) for i, tolerance in enumerate(SPREAD_TOLERANCES)]


@pytest.mark.parametrize("kind", ["ekf", "iterated", "ukf"])
def test_every_filter_is_the_kalman_filter_on_a_linear_problem(kind):
    o = numpy_tracks()
    for t, tolerance in linear_views(kind):
        assert worst(t.predicted.mean, o.x_pred) < tolerance
        assert worst_covariance(t.predicted.cov, o.P_pred) < tolerance
        assert worst(t.predicted.F, o.F) < tolerance
        assert worst(t.belief.mean, o.x) < tolerance
        assert worst_covariance(t.belief.cov, o.P) < tolerance
        for i, info in enumerate(t.infos):
            assert worst(info.nis, o.nis[..., i]) < tolerance
            assert worst(info.loglik, o.loglik[..., i]) < tolerance
            np.testing.assert_array_equal(info.dof, o.dof[..., i])
            np.testing.assert_array_equal(info.status, np.where(o.dof[..., i] > 0, ACCEPTED, ABSENT))


def test_iterating_a_linear_update_changes_nothing():
    once, five = linear_track("ekf"), linear_track("iterated")
    # A second use of the measurement would move the mean by a part of a sigma; K (e - H d + H d) costs rounding alone.
    assert worst(five.belief.mean, once.belief.mean) < 20 * EPS
    assert worst_covariance(five.belief.cov, once.belief.cov) < 4 * EPS


@pytest.mark.parametrize("kind", ["ekf", "iterated", "ukf"])
def test_absent_measurements_and_padding_leave_a_vector_belief_to_the_bit(kind):
    """The values behind the masks are NaN, so this also says that none of them gets through."""
    d = linear_data()
    absent = ~(d.mask[0].any(-1) | d.mask[1].any(-1))
    padded = absent & (d.dt == 0.0)
    assert absent[1].sum() >= 3
    assert padded[2].sum() == 9
    for t, tolerance in linear_views(kind):
        np.testing.assert_array_equal(t.belief.mean[absent], t.predicted.mean[absent])
        change = np.abs(t.belief.cov - t.predicted.cov)[absent]
        # The UKF symmetrises, which may move the last bit of an entry.
        assert change.max() <= (EPS * np.abs(t.predicted.cov).max() if kind == "ukf" else 0.0)
        assert np.all(np.isfinite(t.belief.cov))
        k = np.flatnonzero(padded[2])
        before, after = t.belief.mean[2][k - 1], t.belief.mean[2][k]
        if kind == "ukf":  # predicted through sigma points, not copied
            assert np.abs(after - before).max() < tolerance
            assert worst_covariance(t.belief.cov[2][k], t.belief.cov[2][k - 1]) < tolerance
        else:
            np.testing.assert_array_equal(after, before)
            np.testing.assert_array_equal(t.belief.cov[2][k], t.belief.cov[2][k - 1])


def test_a_model_without_sensors_predicts():
    d, o = linear_data(), LINEAR_MODEL
    model = Model(o.retraction, o.process, ())
    start = Gaussian(jnp.asarray(X0), jnp.asarray(P0))
    last, refused, _ = run(
        ErrorStateKalmanFilter(euclidean(2)), model, start, jnp.asarray(d.u[0]), jnp.asarray(d.dt[0]), (), no_gate()
    )
    x, P = X0, P0
    for u, dt in zip(d.u[0], d.dt[0], strict=True):
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x, P = F @ x + dt * u, F @ P @ F.T + B_W @ np.diag(Q_W * dt) @ B_W.T
    assert refused.shape == (0,)
    assert worst(last.mean, x) < LINEAR
    assert worst_covariance(last.cov, P) < LINEAR


# --- the unscented transform on a curved problem -----------------------------------------------------------------------


def _curved_step(p: Drive, x, u, dt, w):
    return jnp.stack(
        [x[0] + dt * x[1] + 0.1 * dt * x[0] * x[1] + w[0] * (1 + 0.3 * x[1]), x[1] - 0.2 * dt * x[0] ** 2 + w[1]]
    )


def _curved_predict(p: Line, x, a):
    return jnp.stack([x[0] * x[1] + a[0], x[0] ** 2 + x[1] + a[1]])


CURVED_MODEL = Model(
    euclidean(2),
    Process(_curved_step, Noise(_noise, 2), LINEAR_MODEL.process.params),
    (Sensor(_curved_predict, _minus, _cov, LINES[0]),),
)


@compiled
def _run_curved(spreads, dt, m):
    def one(spread):
        belief = UnscentedBelief(jnp.asarray(X0), jnp.asarray(P0), spread)
        return run(UnscentedKalmanFilter(euclidean(2)), CURVED_MODEL, belief, jnp.zeros((T, 2)), dt, (m,), no_gate())[2]

    return jax.vmap(one)(spreads)


def textbook_ukf(spread, d: LinearData, c: int) -> tuple[np.ndarray, np.ndarray]:
    """Wan and van der Merwe (2000), state augmented with the noise, every point with its two weights."""
    alpha, beta, kappa = (float(v) for v in (spread.alpha, spread.beta, spread.kappa))

    def points(x, P):
        n = len(x)
        lam = alpha**2 * (n + kappa) - n
        root = np.linalg.cholesky((n + lam) * P)
        wm = np.full(2 * n + 1, 0.5 / (n + lam))
        wm[0] = lam / (n + lam)
        wc = wm.copy()
        wc[0] += 1 - alpha**2 + beta
        return np.concatenate([x[None], x + root.T, x - root.T]), wm, wc

    x, P, out = X0, P0, []
    for k in range(T):
        t = d.dt[c, k]
        X, wm, wc = points(
            np.append(x, [0.0, 0.0]), np.block([[P, np.zeros((2, 2))], [np.zeros((2, 2)), np.diag(Q_W * t)]])
        )
        Y = np.stack(
            [X[:, 0] + t * X[:, 1] + 0.1 * t * X[:, 0] * X[:, 1] + X[:, 2] * (1 + 0.3 * X[:, 1]),
             X[:, 1] - 0.2 * t * X[:, 0] ** 2 + X[:, 3]], axis=1,
        )  # fmt: skip
        x = wm @ Y
        P = (wc[:, None] * (Y - x)).T @ (Y - x)
        X, wm, wc = points(x, P)
        a = d.a[0][c, k]
        Z = np.stack([X[:, 0] * X[:, 1] + a[0], X[:, 0] ** 2 + X[:, 1] + a[1]], axis=1)
        z = wm @ Z
        S = (wc[:, None] * (Z - z)).T @ (Z - z) + R1
        K = (wc[:, None] * (X - x)).T @ (Z - z) @ np.linalg.inv(S)
        x, P = x + K @ (d.z[0][c, k] - z), P - K @ S @ K.T
        out.append((x, P))
    x, P = zip(*out, strict=True)
    return np.array(x), np.array(P)


def test_unscented_transform_is_the_textbook_s_on_a_curved_problem():
    """The weights of the centre, which a linear problem does not see; short steps, so that the state stays in order 1."""
    d = linear_data()
    d = d._replace(dt=0.1 * d.dt)
    m = Measurement(*(jnp.asarray(v[0][0]) for v in (d.z, d.a, d.mask)))
    spreads = SPREADS[1:-1]  # with kappa = -1 the centre's weight is negative, and P may be
    t = numpy_of(_run_curved(jax.tree.map(lambda *a: jnp.stack(a), *spreads), jnp.asarray(d.dt[0]), m))
    means = []
    for i, spread in enumerate(spreads):
        x, P = textbook_ukf(spread, d, 0)
        assert worst(t.belief.mean[i], x) < SPREAD_TOLERANCES[1]
        assert worst_covariance(t.belief.cov[i], P) < SPREAD_TOLERANCES[1]
        means.append(x)
    assert min(worst(a, b) for a, b in pairwise(means)) > 1e-3  # the spreads differ here


# --- the smoother --------------------------------------------------------------------------------------------------


def numpy_rts(o: NumpyTrack, c: int) -> tuple[np.ndarray, np.ndarray]:
    x, P = o.x[c].copy(), o.P[c].copy()
    for k in range(T - 2, -1, -1):
        C = o.P[c, k] @ o.F[c, k + 1].T @ np.linalg.inv(o.P_pred[c, k + 1])
        x[k] = o.x[c, k] + C @ (x[k + 1] - o.x_pred[c, k + 1])
        P[k] = o.P[c, k] + C @ (P[k + 1] - o.P_pred[c, k + 1]) @ C.T
    return x, P


def batch_least_squares(d: LinearData, o: NumpyTrack, c: int) -> tuple[np.ndarray, np.ndarray]:
    """All states at once: prior of the first, motion between neighbours, measurements, each whitened."""
    rows, rhs = [], []

    def add(blocks: dict[int, np.ndarray], value: np.ndarray, cov: np.ndarray) -> None:
        W = np.linalg.inv(np.linalg.cholesky(cov))
        row = np.zeros((len(value), 2 * T))
        for k, M in blocks.items():
            row[:, 2 * k : 2 * k + 2] = W @ M
        rows.append(row)
        rhs.append(W @ value)

    add({0: np.eye(2)}, o.x_pred[c, 0], o.P_pred[c, 0])
    for k in range(1, T):
        dt = d.dt[c, k]
        add({k: np.eye(2), k - 1: -o.F[c, k]}, dt * d.u[c, k], B_W @ np.diag(Q_W * dt) @ B_W.T)
    for k in range(T):
        for i, (C, R) in enumerate(((C1, R1), (C2, R2))):
            m = d.mask[i][c, k]
            if m.any():
                add({k: C[m]}, (d.z[i][c, k] - d.a[i][c, k])[m], R[np.ix_(m, m)])
    A, b = np.concatenate(rows), np.concatenate(rhs)
    x = np.linalg.lstsq(A, b)[0]
    cov = np.linalg.inv(A.T @ A).reshape(T, 2, T, 2)
    return x.reshape(T, 2), np.stack([cov[k, :, k, :] for k in range(T)])


@compiled
def _smooth_linear(filtered, predicted, last):
    return jax.vmap(partial(smooth, euclidean(2)))(filtered, predicted, last)


@compiled
def _smooth_one_step(filtered, predicted, later):
    return jax.vmap(partial(smooth_step, euclidean(2)))(filtered, predicted, later)


def at(tree, k):
    return jax.tree.map(lambda a: a[:, k], tree)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_smoother_is_rts_and_the_batch_least_squares_solution(kind):
    d, o = linear_data(), numpy_tracks()
    t, _ = linear_views(kind)[-1]
    filtered = Gaussian(t.belief.mean, t.belief.cov)
    s = numpy_of(_smooth_linear(filtered, t.predicted, at(filtered, -1)))
    for c in range(LINEAR_CASES):
        x, P = numpy_rts(o, c)
        assert worst(s.mean[c], x) < LINEAR
        assert worst_covariance(s.cov[c], P) < LINEAR
    for c in (0, 1):  # case 2 has steps of no length, whose motion has no inverse covariance
        x, P = batch_least_squares(d, o, c)
        assert worst(s.mean[c], x) < LINEAR
        assert worst_covariance(s.cov[c], P) < LINEAR


def test_smoothing_in_chunks_is_smoothing_at_once():
    t, half = linear_track("ekf"), T // 2
    filtered = Gaussian(t.belief.mean, t.belief.cov)
    whole = _smooth_linear(filtered, t.predicted, at(filtered, -1))
    first, second = slice(None, half), slice(half, None)
    later = _smooth_linear(at(filtered, second), at(t.predicted, second), at(filtered, -1))
    last = _smooth_one_step(at(filtered, half - 1), at(t.predicted, half), at(later, 0))
    earlier = _smooth_linear(at(filtered, first), at(t.predicted, first), last)
    for part, where in ((later, second), (earlier, first)):
        assert worst(part.mean, at(whole.mean, where)) < 10 * EPS
        assert worst(part.cov, at(whole.cov, where)) < 10 * EPS


# --- attitude and drift, two sensors ---------------------------------------------------------------------------------

STEPS, STARS = 40, 2
CASES = ("consistent", "rates", "large", "outliers", "upset", "padding", "gap", "noiseless")
CONSISTENT, RATES, LARGE, OUTLIERS, UPSET, PADDING, GAP, NOISELESS = range(len(CASES))
REOPEN_AFTER = 5
GATE_PROBABILITY = 1e-6


@pytree
class Specification:
    """sigma_v, sigma_u of the gyro and sigma of the stars, as data."""

    sigma_v: jax.Array
    sigma_u: jax.Array
    sigma: jax.Array


class AttitudeData(NamedTuple):
    """Leading axes: case, step. P0 is that of an error on the left."""

    spec: Specification
    q0: np.ndarray
    b0: np.ndarray
    P0: np.ndarray
    rate: np.ndarray
    extra: np.ndarray
    dt: np.ndarray
    star_z: np.ndarray
    star_r: np.ndarray
    star_mask: np.ndarray
    whole_z: np.ndarray
    whole_cov: np.ndarray
    whole_mask: np.ndarray
    limits: np.ndarray
    reopen: np.ndarray
    true_q: np.ndarray
    true_b: np.ndarray


def random_covariance(r, sigmas) -> np.ndarray:
    """Well-conditioned correlations with the given sigmas."""
    n = len(sigmas)
    A = r.normal(size=(n, 3 * n))
    C = A @ A.T
    s = sigmas / np.sqrt(np.diagonal(C))
    return C * s[:, None] * s[None, :]


@cache
def attitude_data() -> AttitudeData:
    r = np.random.default_rng(7)
    n, shape = len(CASES), (len(CASES), STEPS)
    sigma = np.full(n, 1e-3)
    sigma[[OUTLIERS, UPSET]] = 1e-4
    sigma[LARGE], sigma[NOISELESS] = 1e-2, 1e-8
    sigma_v, sigma_u = np.full(n, 1e-4), np.full(n, 1e-6)
    dt = r.uniform(0.5, 2.0, size=shape)
    dt[GAP, 20] = 50.0
    attitude_sigma = np.full(n, 2e-3)
    attitude_sigma[LARGE], attitude_sigma[UPSET], attitude_sigma[NOISELESS] = 1.0, 3e-5, 1e-5
    whole_sigma = np.full(n, 2e-3)
    whole_sigma[[OUTLIERS, UPSET]] = 2e-4
    extra = np.zeros((*shape, 3, 3))
    extra[GAP, 20] = random_covariance(r, np.array([0.1, 0.2, 0.05]))
    star_mask, whole_mask = np.ones((*shape, STARS), bool), np.ones((*shape, 1), bool)
    star_mask[RATES] = r.random((STEPS, STARS)) < 0.4
    whole_mask[RATES] = (np.arange(STEPS) % 7 == 3)[:, None]
    whole_mask[[LARGE, UPSET]] = (np.arange(STEPS) % 4 == 3)[:, None]
    whole_mask[NOISELESS] = False
    whole_mask[GAP] = False
    star_mask[GAP, :, 1:] = False  # one star at a time: the turn about it is known through the gyro alone
    padding = (np.arange(STEPS) % 9 >= 7) | (np.arange(STEPS) >= 35)
    dt[PADDING, padding], star_mask[PADDING, padding], whole_mask[PADDING, padding] = 0.0, False, False

    limits = np.full((n, 65), np.inf)
    for c in (OUTLIERS, UPSET):
        limits[c] = chi_square_gate(GATE_PROBABILITY).limits
    out = {k: np.empty((*shape, *s)) for k, s in (
        ("rate", (3,)), ("star_z", (STARS, 3)), ("star_r", (STARS, 3)), ("whole_z", (4,)), ("whole_cov", (3, 3)),
        ("true_q", (4,)), ("true_b", (3,)))}  # fmt: skip
    q0, b0, P0 = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 6, 6))
    for c in range(n):
        R, b = Rotation.random(rng=r), 1e-4 * r.normal(size=3)
        P0[c] = random_covariance(r, np.repeat([attitude_sigma[c], 1e-5], 3))
        if c == UPSET:
            P0[c] = np.diag(np.repeat([attitude_sigma[c], 1e-6], 3) ** 2)
        error = np.linalg.cholesky(P0[c]) @ r.normal(size=6)
        if c in (LARGE, UPSET):
            axis = r.normal(size=3)
            error[:3] = np.deg2rad(100.0 if c == LARGE else 90.0) * axis / np.linalg.norm(axis)
        q0[c], b0[c] = (Rotation.from_rotvec(-error[:3]) * R).as_quat(), b - error[3:]
        for k in range(STEPS):
            w = 0.05 * np.array([np.cos(0.2 * k), np.sin(0.3 * k), 0.5])
            t = dt[c, k]
            out["rate"][c, k] = w + b + (sigma_v[c] / np.sqrt(t) * r.normal(size=3) if t > 0 else 0.0)
            R = Rotation.from_rotvec(-w * t) * R
            if c == GAP and k == 20:
                R = Rotation.from_rotvec(np.linalg.cholesky(extra[c, k]) @ r.normal(size=3)) * R
            b = b + sigma_u[c] * np.sqrt(t) * r.normal(size=3)
            stars = r.normal(size=(STARS, 3))
            stars /= np.linalg.norm(stars, axis=1, keepdims=True)
            cov = random_covariance(r, whole_sigma[c] * np.array([1.0, 1.0, 5.0]))
            turn = Rotation.from_rotvec(np.linalg.cholesky(cov) @ r.normal(size=3))
            out["star_r"][c, k] = stars
            out["star_z"][c, k] = R.apply(stars) + (c != NOISELESS) * sigma[c] * r.normal(size=(STARS, 3))
            out["whole_cov"][c, k], out["whole_z"][c, k] = cov, (turn * R).as_quat()
            out["true_q"][c, k], out["true_b"][c, k] = R.as_quat(), b
    out["star_z"][OUTLIERS, 10, 1] += [0.0, 0.1, 0.0]
    out["whole_z"][OUTLIERS, 20] *= [1.0, -1.0, 1.0, 1.0]
    out["star_z"][~star_mask] = np.nan
    out["star_r"][~star_mask] = np.nan
    out["whole_z"][~whole_mask[..., 0]] = np.nan
    out["whole_cov"][~whole_mask[..., 0]] = np.nan
    return AttitudeData(
        Specification(sigma_v, sigma_u, sigma), q0, b0, P0, dt=dt, extra=extra, star_mask=star_mask,
        whole_mask=whole_mask, limits=limits, reopen=np.full(n, REOPEN_AFTER), **out,
    )  # fmt: skip


class Outcome(NamedTuple):
    """Per step: attitude, drift, covariance (left), prediction, and of each sensor NIS, log likelihood, dof, status."""

    R: list
    b: np.ndarray
    P: np.ndarray
    P_pred: np.ndarray
    nis: np.ndarray
    loglik: np.ndarray
    dof: np.ndarray
    status: np.ndarray


def hat(v) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def numpy_gate(gated: bool, refused: int, nis: float, dof: int) -> tuple[int, bool]:
    """Status, and whether the measurement is used."""
    if not gated or nis <= chi2.isf(GATE_PROBABILITY, dof):
        return ACCEPTED, True
    if refused >= REOPEN_AFTER:
        return FORCED, True
    return (GATED if refused + 1 < REOPEN_AFTER else REOPENED), False


def numpy_mekf(d: AttitudeData, c: int) -> Outcome:
    """A multiplicative EKF of attitude and drift, error on the left, absent rows dropped, with the gate."""
    R, b, P = Rotation.from_quat(d.q0[c]), d.b0[c], d.P0[c]
    s, refused, out = d.spec, [0, 0], []
    gated = np.isfinite(d.limits[c, 1])
    for k in range(STEPS):
        t, phi = d.dt[c, k], (d.rate[c, k] - b) * d.dt[c, k]
        F = np.eye(6)
        both = expm(np.block([[-hat(phi), np.eye(3)], [np.zeros((3, 6))]]))  # exp and its integral
        F[:3] = np.hstack([both[:3, :3], both[:3, 3:] * t])
        v2, u2, eye = s.sigma_v[c] ** 2, s.sigma_u[c] ** 2, np.eye(3)
        Q = np.block(
            [[(v2 * t + u2 * t**3 / 3) * eye + d.extra[c, k], u2 * t**2 / 2 * eye], [u2 * t**2 / 2 * eye, u2 * t * eye]]
        )
        R, P = Rotation.from_rotvec(-phi) * R, F @ P @ F.T + Q
        P_pred, infos = P, []
        for i in range(2):
            if i == 0:
                m = d.star_mask[c, k]
                predicted = R.apply(d.star_r[c, k][m]) if m.any() else np.zeros((0, 3))
                e = (d.star_z[c, k][m] - predicted).ravel()
                H = np.concatenate([np.zeros((0, 3)), *(-hat(v) for v in predicted)])
                noise = s.sigma[c] ** 2 * np.eye(len(e))
            elif d.whole_mask[c, k, 0]:
                e = (Rotation.from_quat(d.whole_z[c, k]) * R.inv()).as_rotvec()
                H, noise = np.eye(3), d.whole_cov[c, k]
            else:
                e, H = np.zeros(0), np.zeros((0, 3))
            if not len(e):
                infos.append((0.0, 0.0, 0, ABSENT))
                continue
            H = np.hstack([H, np.zeros_like(H)])
            S = H @ P @ H.T + noise
            nis = e @ np.linalg.solve(S, e)
            K = np.linalg.solve(S, H @ P).T
            status, use = numpy_gate(gated, refused[i], nis, len(e))
            refused[i] = 0 if status == ACCEPTED else refused[i] + 1
            if status == FORCED:
                noise = noise * nis / len(e)
            elif status == REOPENED:
                P = P * nis / np.sum(1 - np.diag(noise) / np.diag(S))
            infos.append((nis, multivariate_normal.logpdf(e, np.zeros(len(e)), S), len(e), status))
            if use:
                A, delta = np.eye(6) - K @ H, K @ e
                P = A @ P @ A.T + K @ noise @ K.T
                turn = Rotation.from_rotvec(delta[:3])
                D = np.block([[turn.as_matrix(), np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
                R, b, P = turn * R, b + delta[3:], D @ P @ D.T
        out.append((R, b, P, P_pred, *zip(*infos, strict=True)))
    R, *rest = zip(*out, strict=True)
    return Outcome(list(R), *(np.array(v) for v in rest))


@cache
def oracle(c: int) -> Outcome:
    return numpy_mekf(attitude_data(), c)


SIDE = {"left": so3_left, "right": so3_right}


def state_retraction(side: str):
    return product(AttitudeDrift, SIDE[side], euclidean(3))


def jax_model(spec: Specification, side: str) -> Model:
    r = SIDE[side]
    sensors = (star_directions(spec.sigma, r), whole_attitude(r))
    return attitude_drift_model(GyroNoise(spec.sigma_v, spec.sigma_u), r, sensors)


def _run_one(side: str, spec, belief, refused, u, dt, ms, gate):
    return run(ErrorStateKalmanFilter(state_retraction(side)), jax_model(spec, side), belief, u, dt, ms, gate, refused)


@partial(compiled, static_argnames=("side",))
def _run_cases(side, *args):
    return jax.vmap(partial(_run_one, side))(*args)


def arguments(d: AttitudeData, side: str, dtype=np.float64):
    """Inputs of `_run_cases`: P0 turned to the side of the error."""
    P = d.P0
    if side == "right":
        turn = np.broadcast_to(np.eye(6), (len(CASES), 6, 6)).copy()
        turn[:, :3, :3] = Rotation.from_quat(d.q0).inv().as_matrix()
        P = turn @ P @ np.swapaxes(turn, 1, 2)
    cast = partial(jnp.asarray, dtype=dtype)
    mean = AttitudeDrift(cast(d.q0), cast(d.b0))
    belief = Gaussian(mean, cast(P))
    ms = (
        Measurement(cast(d.star_z), cast(d.star_r), jnp.asarray(d.star_mask)),
        Measurement(cast(d.whole_z), cast(d.whole_cov), jnp.asarray(d.whole_mask)),
    )
    refused = jnp.zeros((len(CASES), 2), int)
    gate = Gate(cast(d.limits), jnp.asarray(d.reopen))
    return jax.tree.map(cast, d.spec), belief, refused, GyroInput(cast(d.rate), cast(d.extra)), cast(d.dt), ms, gate


@cache
def tracks(side: str):
    return numpy_of(_run_cases(side, *arguments(attitude_data(), side)))


def to_left(q, P) -> np.ndarray:
    """Covariance of an error on the right at attitudes q, turned to the left."""
    turn = np.broadcast_to(np.eye(6), P.shape).copy()
    turn[..., :3, :3] = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*P.shape[:-2], 3, 3)
    return turn @ P @ np.swapaxes(turn, -1, -2)


def angles(q, p) -> np.ndarray:
    """Angle (rad) between the attitudes of two arrays of quaternions, accurate near 0."""
    a, b = (Rotation.from_quat(np.asarray(v, float).reshape(-1, 4)) for v in (q, p))
    return (a * b.inv()).magnitude().reshape(np.shape(q)[:-1])


AMPLIFIED = {"noiseless": 1e3, "upset": 1e3}
"""Cases whose S = H P H^T + R has a condition of 1e8 and more, by which rounding in the gain is amplified."""


@pytest.mark.parametrize("case", CASES)
def test_attitude_filter_is_the_numpy_filter(case):
    """Masks, partial masks with NaN behind them, two sensors at different rates, gate and reopening, all in one."""
    c = CASES.index(case)
    o, (_, _, t) = oracle(c), tracks("left")
    b, q, P = t.belief.mean.b[c], t.belief.mean.q_BN[c], t.belief.cov[c]
    tolerance = AMPLIFIED.get(case, 1.0) * SIDES
    assert np.max(angles(q, np.array([R.as_quat() for R in o.R]))) < tolerance
    assert np.max(np.abs(b - o.b)) < tolerance
    assert worst_covariance(t.predicted.cov[c], o.P_pred) < tolerance
    assert worst_covariance(P, o.P) < tolerance
    for i, info in enumerate(t.infos):
        np.testing.assert_array_equal(info.status[c], o.status[:, i])
        np.testing.assert_array_equal(info.dof[c], o.dof[:, i])
        assert np.max(np.abs(info.nis[c] - o.nis[:, i]) / (1 + o.nis[:, i])) < tolerance
        assert np.max(np.abs(info.loglik[c] - o.loglik[:, i]) / (1 + np.abs(o.loglik[:, i]))) < tolerance


def nees(side: str, d: AttitudeData, t) -> np.ndarray:
    """NEES of each case and step in the filter's own error."""
    truth = Rotation.from_quat(d.true_q.reshape(-1, 4))
    mean = Rotation.from_quat(t.belief.mean.q_BN.reshape(-1, 4))
    xi = (truth * mean.inv() if side == "left" else mean.inv() * truth).as_rotvec().reshape(*d.dt.shape, 3)
    return quadratic_form(np.concatenate([xi, d.true_b - t.belief.mean.b], axis=-1), t.belief.cov)


@pytest.mark.parametrize("case", CASES)
def test_left_with_transport_is_right(case):
    c, d = CASES.index(case), attitude_data()
    (_, _, left), (_, _, right) = tracks("left"), tracks("right")
    tolerance = AMPLIFIED.get(case, 1.0) * SIDES
    assert np.max(angles(left.belief.mean.q_BN[c], right.belief.mean.q_BN[c])) < tolerance
    assert np.max(np.abs(left.belief.mean.b[c] - right.belief.mean.b[c])) < tolerance
    turned = to_left(right.belief.mean.q_BN[c], right.belief.cov[c])
    assert worst_covariance(turned, left.belief.cov[c]) < tolerance
    for a, b in zip(left.infos, right.infos, strict=True):
        np.testing.assert_array_equal(a.status[c], b.status[c])
        assert np.max(np.abs(a.nis[c] - b.nis[c]) / (1 + np.abs(a.nis[c]))) < tolerance
    a, b = nees("left", d, left)[c], nees("right", d, right)[c]
    if case != "noiseless":  # scipy's angles have 1e-16 rad of rounding, which is 1e-8 sigma there
        assert np.max(np.abs(a - b) / (1 + a)) < tolerance


def test_the_large_case_makes_large_updates():
    """Else the equality of sides above would say nothing about transport."""
    _, _, left = tracks("left")
    assert angles(left.belief.mean.q_BN[LARGE, 0], attitude_data().q0[LARGE]) > 0.8


def test_consistent_cases_have_the_nees_of_their_covariance():
    """Six states, 40 steps of one run: a single mean over correlated steps, so a wide band, but a factor 4 in P shows."""
    for c in (CONSISTENT, RATES, GAP):
        assert 1.5 < np.mean(nees("left", attitude_data(), tracks("left")[2])[c]) < 15.0


# --- the unscented filter on attitudes ------------------------------------------------------------------------------


def numpy_ukf(d: AttitudeData, c: int) -> Outcome:
    """Attitude alone from the stars alone, kappa form with kappa = 1, error on the left, absent rows dropped."""
    R, P = Rotation.from_quat(d.q0[c]), d.P0[c, :3, :3]
    refused, out = 0, []
    gated = np.isfinite(d.limits[c, 1])

    def root(C):
        return np.linalg.cholesky(C) if C.any() else C

    for k in range(STEPS):
        t = d.dt[c, k]
        A = Rotation.from_rotvec(-(d.rate[c, k] - d.true_b[c, k]) * t)
        Q = d.spec.sigma_v[c] ** 2 * t * np.eye(3) + d.extra[c, k]
        base, w = A * R, 0.5 / 7
        columns = np.sqrt(7) * np.concatenate([root(P).T, -root(P).T])
        noises = np.sqrt(7) * np.concatenate([root(Q).T, -root(Q).T])
        points = [A * Rotation.from_rotvec(v) * R for v in columns] + [Rotation.from_rotvec(v) * base for v in noises]
        R = Rotation.from_rotvec(w * sum((x * base.inv()).as_rotvec() for x in points)) * base
        d0 = (base * R.inv()).as_rotvec()
        P = w * sum(np.outer(v, v) for v in ((x * R.inv()).as_rotvec() for x in points)) + np.outer(d0, d0) / 7
        P_pred, m = P, d.star_mask[c, k]
        info = (0.0, 0.0, 0, ABSENT)
        if m.any():
            stars = d.star_r[c, k][m]
            columns = 2.0 * np.concatenate([root(P).T, -root(P).T])
            z = np.array([(Rotation.from_rotvec(v) * R).apply(stars).ravel() for v in columns])
            z0 = R.apply(stars).ravel()
            z_mean = 0.25 * z0 + 0.125 * z.sum(0)
            noise = d.spec.sigma[c] ** 2 * np.eye(len(z0))
            S = 0.125 * (z - z_mean).T @ (z - z_mean) + 0.25 * np.outer(z0 - z_mean, z0 - z_mean) + noise
            K = 0.125 * columns.T @ (z - z_mean) @ np.linalg.inv(S)
            e = d.star_z[c, k][m].ravel() - z_mean
            nis = e @ np.linalg.solve(S, e)
            status, use = numpy_gate(gated, refused, nis, len(e))
            refused = 0 if status == ACCEPTED else refused + 1
            info = (nis, multivariate_normal.logpdf(e, np.zeros(len(e)), S), len(e), status)
            if use:
                turn, P = Rotation.from_rotvec(K @ e), P - K @ S @ K.T
                if status == FORCED:
                    P = P + (nis / len(e) - 1) * K @ noise @ K.T
                R, P = turn * R, turn.as_matrix() @ P @ turn.as_matrix().T
            elif status == REOPENED:
                P = P * nis / np.sum(1 - np.diag(noise) / np.diag(S))
        out.append((R, np.zeros(3), P, P_pred, *info))
    R, *rest = zip(*out, strict=True)
    return Outcome(list(R), *(np.array(v) for v in rest))


@compiled
def _run_unscented(spec, belief, u, dt, m, gate):
    def one(spec, belief, u, dt, m, gate):
        model = attitude_model(GyroNoise(spec.sigma_v, spec.sigma_u), so3_left, (star_directions(spec.sigma),))
        return run(UnscentedKalmanFilter(so3_left), model, belief, u, dt, (m,), gate)

    return jax.vmap(one)(spec, belief, u, dt, m, gate)


@cache
def unscented_data() -> AttitudeData:
    """A large error whose points stay within pi of each other, and a sensor with some noise: P - K S K^T, unlike the form
    of Joseph, loses the digits of P- / R."""
    d = attitude_data()
    P0, sigma = d.P0.copy(), d.spec.sigma.copy()
    P0[LARGE, :3, :3] *= 0.25
    sigma[NOISELESS] = 1e-6
    return d._replace(P0=P0, spec=Specification(d.spec.sigma_v, d.spec.sigma_u, sigma))


@cache
def unscented_track():
    d = unscented_data()
    spec, belief, _, u, dt, (m, _), gate = arguments(d, "left")
    spread = jax.tree.map(lambda a: jnp.broadcast_to(a, len(CASES)), kappa_form(1.0))
    belief = UnscentedBelief(belief.mean.q_BN, belief.cov[:, :3, :3], spread)
    u = GyroInput(u.rate - jnp.asarray(d.true_b), u.extra)
    return numpy_of(_run_unscented(spec, belief, u, dt, m, gate))


@pytest.mark.parametrize("case", CASES)
def test_unscented_attitude_filter_is_the_numpy_filter(case):
    c = CASES.index(case)
    o, (_, _, t) = numpy_ukf(unscented_data(), c), unscented_track()
    info = t.infos[0]
    np.testing.assert_array_equal(info.status[c], o.status)
    np.testing.assert_array_equal(info.dof[c], o.dof)
    amplified = AMPLIFIED.get(case, 1.0)
    assert np.max(angles(t.belief.mean[c], np.array([R.as_quat() for R in o.R]))) < amplified * SIDES
    assert worst_covariance(t.predicted.cov[c], o.P_pred) < amplified * SIDES
    assert worst_covariance(t.belief.cov[c], o.P) < amplified * SIDES
    assert np.max(np.abs(info.nis[c] - o.nis) / (1 + o.nis)) < amplified * SIDES
    assert np.max(np.abs(info.loglik[c] - o.loglik) / (1 + np.abs(o.loglik))) < amplified * SIDES


# --- masks and padding -----------------------------------------------------------------------------------------------


def present(d: AttitudeData) -> np.ndarray:
    return d.star_mask.any(-1) | d.whole_mask.any(-1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_absent_measurements_leave_the_attitude_as_predicted(side):
    _, _, t = tracks(side)
    absent = ~present(attitude_data())
    assert absent.sum() > 15
    assert np.max(np.abs(t.belief.mean.q_BN - t.predicted.mean.q_BN)[absent]) <= 4 * EPS
    np.testing.assert_array_equal(t.belief.mean.b[absent], t.predicted.mean.b[absent])
    np.testing.assert_array_equal(t.belief.cov[absent], t.predicted.cov[absent])
    for leaf in jax.tree.leaves(t):  # though everything behind a mask is NaN
        assert np.all(np.isfinite(leaf))


def test_absent_measurements_leave_the_unscented_attitude_as_predicted():
    _, _, t = unscented_track()
    absent = ~attitude_data().star_mask.any(-1)
    assert absent.sum() > 15
    assert np.max(np.abs(t.belief.mean - t.predicted.mean)[absent]) <= 4 * EPS
    assert worst_covariance(t.belief.cov[absent], t.predicted.cov[absent]) <= 4 * EPS
    for leaf in jax.tree.leaves(t):
        assert np.all(np.isfinite(leaf))


@pytest.mark.parametrize("side", ["left", "right"])
def test_padding_steps_leave_the_belief(side):
    _, _, t = tracks(side)
    d = attitude_data()
    k = np.flatnonzero(d.dt[PADDING] == 0.0)
    assert len(k) >= 10
    q, b, P = t.belief.mean.q_BN[PADDING], t.belief.mean.b[PADDING], t.belief.cov[PADDING]
    assert np.max(np.abs(q[k] - q[k - 1])) <= 4 * EPS
    np.testing.assert_array_equal(b[k], b[k - 1])
    if side == "left":
        np.testing.assert_array_equal(P[k], P[k - 1])
    else:  # F by automatic differentiation is I to the last bit or two
        assert worst_covariance(P[k], P[k - 1]) < 1e-15


def test_the_order_of_slots_and_what_lies_behind_a_mask_do_not_matter():
    """So a run with a star absent is the run without this star."""
    d = attitude_data()
    r = np.random.default_rng(3)
    order = np.argsort(r.random(d.star_mask.shape), axis=-1)

    def reorder(a):
        return np.take_along_axis(a, order if a.ndim == 3 else order[..., None], axis=2)

    z, stars, mask = reorder(d.star_z).copy(), reorder(d.star_r).copy(), reorder(d.star_mask)
    z[~mask], stars[~mask] = 1e300, np.inf
    whole_z = np.where(d.whole_mask, d.whole_z, 0.0)
    whole_cov = np.where(d.whole_mask[..., None], d.whole_cov, -1.0)
    other = d._replace(star_z=z, star_r=stars, star_mask=mask, whole_z=whole_z, whole_cov=whole_cov)
    _, _, a = tracks("left")
    _, _, b = numpy_of(_run_cases("left", *arguments(other, "left")))
    keep = [c for c, case in enumerate(CASES) if case not in AMPLIFIED]
    assert np.max(angles(a.belief.mean.q_BN, b.belief.mean.q_BN)[keep]) < 1e-12
    assert worst_covariance(b.belief.cov[keep], a.belief.cov[keep]) < 1e-10
    assert worst(b.infos[0].nis[RATES], a.infos[0].nis[RATES]) < 1e-10


def test_several_sensors_at_a_step_are_updates_one_after_the_other():
    """Each step split in two, the second of no length with the second sensor."""
    d, half = attitude_data(), STEPS // 2

    def spread(a, first, second):
        out = np.repeat(a[:, :half], 2, axis=1).copy()
        out[:, 0::2] = first(out[:, 0::2])
        out[:, 1::2] = second(out[:, 1::2])
        return out

    def same(a):
        return a

    def none(a):
        return np.zeros_like(a)

    split = d._replace(
        dt=spread(d.dt, same, none), extra=spread(d.extra, same, none), star_mask=spread(d.star_mask, same, none),
        whole_mask=spread(d.whole_mask, none, same),
        **{k: spread(getattr(d, k), same, same) for k in ("rate", "star_z", "star_r", "whole_z", "whole_cov")},
    )  # fmt: skip
    _, _, a = tracks("left")
    _, _, b = numpy_of(_run_cases("left", *arguments(split, "left")))
    for c in (CONSISTENT, RATES, LARGE, OUTLIERS, UPSET):
        exact = 1e-12 * AMPLIFIED.get(CASES[c], 1.0) ** 2
        assert np.max(angles(a.belief.mean.q_BN[c, :half], b.belief.mean.q_BN[c, 1::2])) < exact
        assert worst_covariance(b.belief.cov[c, 1::2], a.belief.cov[c, :half]) < 100 * exact
        np.testing.assert_array_equal(a.infos[0].status[c, :half], b.infos[0].status[c, 0::2])
        np.testing.assert_array_equal(a.infos[1].status[c, :half], b.infos[1].status[c, 1::2])


# --- the gate --------------------------------------------------------------------------------------------------------


def test_an_outlier_is_refused_and_leaves_the_belief():
    """Of two sensors: the one with the outlier is not used, the other is; the NumPy filter agrees above."""
    _, refused, t = tracks("left")
    star, whole = (info.status[OUTLIERS] for info in t.infos)
    assert star[10] == whole[20] == GATED
    assert np.sum(star != ACCEPTED) == np.sum(whole != ACCEPTED) == 1
    np.testing.assert_array_equal(refused[OUTLIERS], [0, 0])
    limit = chi2.isf(GATE_PROBABILITY, t.infos[0].dof[OUTLIERS])
    np.testing.assert_array_equal(t.infos[0].nis[OUTLIERS] > limit, star == GATED)
    _, refused, t = unscented_track()
    status = t.infos[0].status[OUTLIERS]
    assert status[10] == GATED
    assert np.sum(status != ACCEPTED) == 1
    assert np.max(np.abs(t.belief.mean - t.predicted.mean)[OUTLIERS, 10]) <= 4 * EPS
    assert worst_covariance(t.belief.cov[OUTLIERS, 10], t.predicted.cov[OUTLIERS, 10]) <= 4 * EPS


@pytest.mark.parametrize("filter", ["left", "right", "unscented"])
def test_the_gate_reopens_and_the_filter_recovers_from_an_upset_of_90_deg(filter):
    d = attitude_data()
    _, _, t = unscented_track() if filter == "unscented" else tracks(filter)
    q = t.belief.mean if filter == "unscented" else t.belief.mean.q_BN
    status, P = t.infos[0].status[UPSET], t.belief.cov[UPSET]
    error = angles(q, d.true_q)[UPSET]
    first = REOPEN_AFTER - 1
    np.testing.assert_array_equal(status[:first], GATED)
    assert status[first] == REOPENED
    assert np.min(error[:first]) > np.deg2rad(80)
    trace = np.trace(P[:, :3, :3], axis1=1, axis2=2)
    assert trace[first] > 1e4 * trace[first - 1]
    assert np.all(status[-10:] == ACCEPTED)
    assert np.all(error[-10:] < 1e-3)
    if filter != "unscented":
        assert np.mean(nees(filter, d, t)[UPSET, -10:]) < 30.0


def test_a_belief_stays_finite_whatever_a_sensor_says():
    """Residuals of NaN, a noiseless sensor (its S is singular) and one that contradicts itself for ever."""
    d = attitude_data()
    z, sigma = d.star_z.copy(), d.spec.sigma.copy()
    z[CONSISTENT, 5:10] = np.nan  # unmasked
    sigma[RATES] = 0.0
    z[GAP] *= 1.5  # never of unit length; one star at a time
    z[UPSET] *= 1.5
    sigma[GAP] = 1e-4
    limits = np.array(d.limits)
    limits[[CONSISTENT, RATES, GAP]] = limits[UPSET]
    bad = d._replace(star_z=z, spec=Specification(d.spec.sigma_v, d.spec.sigma_u, sigma), limits=limits)
    for other in (bad, bad._replace(limits=np.full_like(limits, np.inf), reopen=np.zeros(len(CASES), int))):
        _, _, t = numpy_of(_run_cases("left", *arguments(other, "left")))
        for leaf in jax.tree.leaves(t.belief):
            assert np.all(np.isfinite(leaf))
        np.testing.assert_array_equal(t.infos[0].status[CONSISTENT, 5:10], GATED)
        assert np.all(t.infos[0].status[CONSISTENT, 12:] == ACCEPTED)


def test_the_noise_floor_is_finite_and_accurate():
    """sigma = 1e-10 rad, the floor that scenarios tell a filter of noiseless stars, with a gyro a million times worse: from
    a start that is good to 1e-5 rad or not as good as that."""
    d = attitude_data()
    spec = Specification(np.full(len(CASES), 1e-4), np.full(len(CASES), 1e-9), np.full(len(CASES), 1e-10))
    stars = np.random.default_rng(13).normal(size=d.star_r.shape)
    stars[..., 1, :] = np.cross(stars[..., 0, :], stars[..., 1, :])
    stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
    R = Rotation.from_quat(d.true_q.reshape(-1, 4)).as_matrix().reshape(*d.dt.shape, 3, 3)
    P0 = np.broadcast_to(np.diag([1e-10] * 3 + [1e-14] * 3), d.P0.shape)
    exact = d._replace(
        spec=spec, P0=P0, star_z=np.einsum("ckij,cknj->ckni", R, stars), star_r=stars, limits=np.full_like(d.limits, np.inf),
        star_mask=np.ones_like(d.star_mask), whole_mask=np.zeros_like(d.whole_mask), extra=np.zeros_like(d.extra),
        dt=np.minimum(d.dt, 2.0),
    )  # fmt: skip
    _, _, t = numpy_of(_run_cases("left", *arguments(exact, "left")))
    for leaf in jax.tree.leaves(t):
        assert np.all(np.isfinite(leaf))
    # The condition of S, some 1e12, times eps, is the relative error of a gain that takes away 1e-4 rad of gyro noise.
    near = [CONSISTENT, RATES, OUTLIERS, NOISELESS]
    assert np.max(angles(t.belief.mean.q_BN, d.true_q)[near, 5:]) < 1e-7


def test_a_gate_with_too_few_limits_is_an_error():
    d = linear_data()
    ms = tuple(Measurement(*(jnp.asarray(v[0]) for v in zam)) for zam in zip(d.z, d.a, d.mask, strict=True))
    start = Gaussian(jnp.asarray(X0), jnp.asarray(P0))
    with pytest.raises(ValueError, match="2 residuals, but the gate has limits for 1"):
        run(
            ErrorStateKalmanFilter(euclidean(2)), LINEAR_MODEL, start, jnp.asarray(d.u[0]), jnp.asarray(d.dt[0]), ms,
            no_gate(1),
        )  # fmt: skip


@pytest.mark.parametrize("probability", [0.0, 1.0, -0.1, np.nan])
def test_a_gate_probability_outside_0_1_is_an_error(probability):
    with pytest.raises(ValueError, match="between 0 and 1"):
        chi_square_gate(probability)


# --- precision -------------------------------------------------------------------------------------------------------


def test_covariance_stays_symmetric_and_positive_over_2000_steps_of_tiny_noise():
    """Rounding adds an asymmetry of some eps P to each step, and every update contracts it; the smallest eigenvalue of the
    correlations would fall below zero within a few updates of the short form (I - K H) P."""
    d = attitude_data()
    r = np.random.default_rng(11)
    sigma = 10.0 ** -np.linspace(5, 8, len(CASES))
    d = d._replace(
        spec=Specification(np.full(len(CASES), 1e-7), np.full(len(CASES), 1e-10), sigma),
        P0=np.broadcast_to(np.diag([1e-4] * 3 + [1e-8] * 3), (len(CASES), 6, 6)),
        dt=np.ones_like(d.dt), extra=np.zeros_like(d.extra), star_mask=np.ones_like(d.star_mask),
        whole_mask=np.zeros_like(d.whole_mask), limits=np.full_like(d.limits, np.inf),
    )  # fmt: skip
    truth = Rotation.from_quat(d.q0)
    carried = None
    asymmetry, smallest = 0.0, np.inf
    for _ in range(2000 // STEPS):
        stars = r.normal(size=d.star_r.shape)
        stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
        stars[..., 1:, :] = stars[..., :1, :] + 0.02 * stars[..., 1:, :]  # close together: the turn about them is weak
        stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
        R = truth.as_matrix()
        z = np.einsum("cij,cknj->ckni", R, stars) + sigma[:, None, None, None] * r.normal(size=stars.shape)
        rate = d.spec.sigma_v[:, None, None] * r.normal(size=d.rate.shape)
        spec, *start, u, dt, ms, gate = arguments(d._replace(star_r=stars, star_z=z, rate=rate), "left")
        last, refused, t = _run_cases("left", spec, *(carried or start), u, dt, ms, gate)
        carried = (last, refused)
        P = np.asarray(t.belief.cov)
        s = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        C = P / (s[..., :, None] * s[..., None, :])
        asymmetry = max(asymmetry, np.max(np.abs(C - np.swapaxes(C, -1, -2))))
        smallest = min(smallest, np.min(np.linalg.eigvalsh(C)))
    assert asymmetry < 1e-7
    assert smallest > 0.0
    assert np.max(angles(last.mean.q_BN, d.q0) / sigma) < 300.0  # the weak turn is 50 sigma wide


def test_a_run_does_not_depend_on_vmap():
    """The same operations, contracted differently by the compiler: rounding alone."""
    d, batch = linear_data(), linear_track("ekf")
    start, filter = Gaussian(jnp.asarray(X0), jnp.asarray(P0)), ErrorStateKalmanFilter(euclidean(2))
    for c in range(LINEAR_CASES):
        ms = tuple(Measurement(*(jnp.asarray(v[c]) for v in zam)) for zam in zip(d.z, d.a, d.mask, strict=True))
        _, _, one = run(filter, LINEAR_MODEL, start, jnp.asarray(d.u[c]), jnp.asarray(d.dt[c]), ms, no_gate())
        assert worst(one.belief.mean, batch.belief.mean[c]) < 1e-13
        assert worst_covariance(one.belief.cov, batch.belief.cov[c]) < 1e-13


def dtypes(tree) -> set:
    return {np.dtype(a.dtype) for a in jax.tree.leaves(tree) if np.issubdtype(a.dtype, np.floating)}


@pytest.mark.parametrize("side", ["left", "right"])
def test_float32_in_gives_float32_out(side):
    """Every number of a run; traced, not computed: a scan refuses a belief whose type changes."""
    args = arguments(attitude_data(), side, np.float32)
    assert dtypes(jax.eval_shape(jax.vmap(partial(_run_one, side)), *args)) == {np.dtype(np.float32)}
    spec, belief, _, u, dt, (m, _), gate = args
    spread = jax.tree.map(lambda a: jnp.full(len(CASES), a, jnp.float32), kappa_form(1.0))
    belief = UnscentedBelief(belief.mean.q_BN, belief.cov[:, :3, :3], spread)
    assert dtypes(jax.eval_shape(_run_unscented, spec, belief, u, dt, m, gate)) == {np.dtype(np.float32)}


def test_the_models_of_xu2020_and_unit_directions_keep_float32():
    q, u, stars = jnp.zeros(4, np.float32), jnp.zeros(3, np.float32), jnp.zeros((2, 3), np.float32)
    one, P = jnp.float32(1.0), jnp.eye(3, dtype=jnp.float32)
    m, gate = Measurement(stars, stars, jnp.ones(2, bool)), no_gate()
    lie = [xu2020.lie_model(one, one, r) for r in (so3_right, so3_left, gibbs_left)]
    unit = attitude_model(GyroNoise(one, one), so3_left, (unit_star_directions(one),))
    for model, drive, cov in (
        *((x, u, P) for x in (*lie, xu2020.printed_model(one, one))),
        (xu2020.quaternion_model(one, one), u, jnp.eye(4, dtype=jnp.float32)),
        (unit, GyroInput(u, P), P),
    ):
        filter = ErrorStateKalmanFilter(model.retraction)
        out = jax.eval_shape(partial(step, filter), model, Gaussian(q, cov), jnp.zeros(1, int), drive, one, (m,), gate)
        assert dtypes(out) == {np.dtype(np.float32)}


@compiled
def _run_whole(spec, belief, u, dt, m, gate):
    def one(spec, belief, u, dt, m, gate):
        model = attitude_model(GyroNoise(spec.sigma_v, spec.sigma_u), so3_left, (whole_attitude(),))
        return run(ErrorStateKalmanFilter(so3_left), model, belief, u, dt, (m,), gate)

    return jax.vmap(one)(spec, belief, u, dt, m, gate)


def test_float32_is_accurate():
    d = attitude_data()
    spec, belief, _, u, dt, (_, m), gate = arguments(d, "left", np.float32)
    u = GyroInput(u.rate - jnp.asarray(d.true_b, np.float32), u.extra)
    belief = Gaussian(belief.mean.q_BN, belief.cov[:, :3, :3])
    _, _, t = numpy_of(_run_whole(spec, belief, u, dt, m, gate))
    assert dtypes(t) == {np.dtype(np.float32)}
    eps = float(np.finfo(np.float32).eps)
    for c in (CONSISTENT, RATES, PADDING):
        R, P = Rotation.from_quat(d.q0[c]), d.P0[c, :3, :3]
        q, cov = [], []
        for k in range(STEPS):
            A = Rotation.from_rotvec(-(d.rate[c, k] - d.true_b[c, k]) * d.dt[c, k])
            R, P = A * R, A.as_matrix() @ P @ A.as_matrix().T + d.spec.sigma_v[c] ** 2 * d.dt[c, k] * np.eye(3)
            if d.whole_mask[c, k, 0]:
                K = P @ np.linalg.inv(P + d.whole_cov[c, k])
                turn = Rotation.from_rotvec(K @ (Rotation.from_quat(d.whole_z[c, k]) * R.inv()).as_rotvec())
                D = turn.as_matrix()
                R, P = turn * R, D @ (P - K @ P) @ D.T
            q.append(R.as_quat())
            cov.append(P)
        # Each step rounds the attitude by an eps or two, and an update takes only part of that away.
        assert np.max(angles(t.belief.mean[c], np.array(q))) < 40 * eps
        assert worst_covariance(t.belief.cov[c], np.array(cov)) < 100 * eps


# --- smoothing on the manifold ---------------------------------------------------------------------------------------


@partial(compiled, static_argnames=("side",))
def _smooth_cases(side, filtered, predicted):
    return jax.vmap(lambda f, p: smooth(state_retraction(side), f, p))(filtered, predicted)


@cache
def smoothed(side: str):
    _, _, t = tracks(side)
    return numpy_of(_smooth_cases(side, t.belief, t.predicted))


def test_smoothing_left_with_transport_is_smoothing_right():
    left, right = smoothed("left"), smoothed("right")
    for c in (CONSISTENT, RATES, LARGE, OUTLIERS, GAP):
        assert np.max(angles(left.mean.q_BN[c], right.mean.q_BN[c])) < SIDES
        assert np.max(np.abs(left.mean.b[c] - right.mean.b[c])) < SIDES
        assert worst_covariance(to_left(right.mean.q_BN[c], right.cov[c]), left.cov[c]) < 1e3 * SIDES


def test_smoothing_sharpens_and_ends_where_the_filter_ends():
    d, s = attitude_data(), smoothed("left")
    _, _, t = tracks("left")
    np.testing.assert_array_equal(s.cov[:, -1], t.belief.cov[:, -1])
    np.testing.assert_array_equal(s.mean.q_BN[:, -1], t.belief.mean.q_BN[:, -1])
    for c in (CONSISTENT, RATES, GAP):
        now, later = (np.diagonal(P[c], axis1=1, axis2=2) for P in (t.belief.cov, s.cov))
        assert np.all(later <= now * (1 + 1e-6))
        assert np.mean(later[: STEPS // 2, :3]) < 0.7 * np.mean(now[: STEPS // 2, :3])
        truth, mean = (Rotation.from_quat(q[c]) for q in (d.true_q, s.mean.q_BN))
        xi = np.concatenate([(truth * mean.inv()).as_rotvec(), d.true_b[c] - s.mean.b[c]], axis=1)
        assert 1.5 < np.mean(quadratic_form(xi, s.cov[c])) < 15.0


# --- the iterated update ---------------------------------------------------------------------------------------------

ITERATED = 8  # cases
SIGMA_I = 0.02


@cache
def iterated_data():
    r = np.random.default_rng(5)
    truth = Rotation.random(ITERATED, rng=r)
    P = np.stack([random_covariance(r, np.array([0.4, 0.5, 0.3])) for _ in range(ITERATED)])
    xi = np.einsum("cij,cj->ci", np.linalg.cholesky(P), r.normal(size=(ITERATED, 3)))
    xi *= 0.6 / np.linalg.norm(xi, axis=1, keepdims=True)
    stars = r.normal(size=(ITERATED, STARS, 3))
    stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
    z = np.stack([truth[c].apply(stars[c]) for c in range(ITERATED)]) + SIGMA_I * r.normal(size=stars.shape)
    mask = np.ones((ITERATED, STARS), bool)
    mask[::2, 1] = False
    q = (Rotation.from_rotvec(-xi) * truth).as_quat()
    return q, P, z, stars, mask


@partial(compiled, static_argnames=("side",))
def _iterate(q, P, z, stars, mask, side):
    """With the default carry. `side`: a retraction of the attitude alone, or "product" of the left one and a drift."""
    whole = side == "product"
    filter = ErrorStateKalmanFilter(product(AttitudeDrift, so3_left, euclidean(3)) if whole else side, iterations=12)

    def one(q, P, z, stars, mask):
        m = Measurement(z, stars, mask)
        mean = AttitudeDrift(q, jnp.zeros(3)) if whole else q
        return filter.update(Gaussian(mean, P), star_directions(SIGMA_I), m, no_gate(), jnp.asarray(0))

    return jax.vmap(one)(q, P, z, stars, mask)


def map_estimate(q, P, z, stars, mask) -> tuple[np.ndarray, np.ndarray]:
    """Minimum over xi of xi^T P^-1 xi + sum |z - exp(xi) R r|^2 / sigma^2, and its Gauss-Newton information there."""
    W, R = np.linalg.inv(np.linalg.cholesky(P)), Rotation.from_quat(q)

    def residual(xi):
        e = z[mask] - (Rotation.from_rotvec(xi) * R).apply(stars[mask])
        return np.concatenate([W @ xi, e.ravel() / SIGMA_I])

    def jacobian(xi):
        H = np.concatenate(
            [-hat(v) @ numpy_left_jacobian(xi) for v in (Rotation.from_rotvec(xi) * R).apply(stars[mask])]
        )
        return np.concatenate([W, -H / SIGMA_I])

    xi = least_squares(residual, np.zeros(3), jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    J = jacobian(xi)
    return xi, J.T @ J


def numpy_left_jacobian(xi) -> np.ndarray:
    """The integral of exp(s [xi x]) over s from 0 to 1."""
    return expm(np.block([[hat(xi), np.eye(3)], [np.zeros((3, 6))]]))[:3, 3:]


DRIFT_OF_TURN = np.array([[0.3, -0.1, 0.0], [0.2, 0.4, -0.3], [0.0, 0.1, 0.2]])
DRIFT_ALONE = np.diag([0.01, 0.02, 0.03])


def with_drift(C) -> np.ndarray:
    """Covariance (6, 6) of an attitude error with covariance C (3, 3) and a drift that follows it linearly."""
    M = DRIFT_OF_TURN
    return np.block([[C, C @ M.T], [M @ C, M @ C @ M.T + DRIFT_ALONE]])


@pytest.mark.parametrize("side", [so3_left, so3_right, "product"], ids=["left", "right", "product"])
def test_iterated_update_finds_the_posterior_and_uses_the_measurement_once(side):
    data = iterated_data()
    q, P, *rest = data
    R = Rotation.from_quat(q).as_matrix()
    if side is so3_right:  # the same prior in axes of N
        P = R.transpose(0, 2, 1) @ P @ R
    elif side == "product":
        P = np.stack([with_drift(p) for p in P])
    belief, info = numpy_of(_iterate(*(jnp.asarray(a) for a in (q, P, *rest)), side=side))
    assert np.all(info.status == ACCEPTED)
    for c in range(ITERATED):
        xi, J = map_estimate(*(a[c] for a in data))
        expected = Rotation.from_rotvec(xi) * Rotation.from_quat(q[c])
        q_c = belief.mean.q_BN[c] if side == "product" else belief.mean[c]
        assert (Rotation.from_quat(q_c) * expected.inv()).magnitude() < 1e-7
        # Its covariance is the inverse Fisher information of prior and ONE measurement, carried to the new mean by J_l.
        J_l, found = numpy_left_jacobian(xi), belief.cov[c]
        bound = np.linalg.inv(J)
        if side == "product":
            assert worst(belief.mean.b[c], DRIFT_OF_TURN @ xi) < 1e-6
            bound, J_l = with_drift(bound), np.block([[J_l, np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
        elif side is so3_right:
            R_new = Rotation.from_quat(q_c).as_matrix()
            found = R_new @ found @ R_new.T
        assert worst_covariance(found, J_l @ bound @ J_l.T) < 1e-6


def test_one_plain_step_is_not_the_posterior_there():
    """Else the test above would pass without iterating: the first step misses by more than a hundredth of a radian."""
    q, P, z, stars, mask = iterated_data()
    off = []
    for c in range(ITERATED):
        R, m = Rotation.from_quat(q[c]), mask[c]
        predicted = R.apply(stars[c][m])
        H = np.concatenate([-hat(v) for v in predicted])
        S = H @ P[c] @ H.T + SIGMA_I**2 * np.eye(len(H))
        d = P[c] @ H.T @ np.linalg.solve(S, (z[c][m] - predicted).ravel())
        xi, _ = map_estimate(q[c], P[c], z[c], stars[c], m)
        off.append(np.linalg.norm(d - xi))
    assert np.median(off) > 1e-2


# --- analytic Jacobians ----------------------------------------------------------------------------------------------

N = 16
N_GYRO = GyroNoise(jnp.asarray(1e-3), jnp.asarray(1e-5))
PRINTED = xu2020.printed_model(1e-4, 1e-3)
ADDITIVE = xu2020.quaternion_model(1e-4, 1e-3)


def attitude_input(v):
    return GyroInput(v, jnp.zeros((3, 3)))


def commanded_input(v):
    """A rate that is not the gyro's: the drift has no part in it."""
    return GyroInput(v, jnp.zeros((3, 3)), jnp.asarray(0.0))


PROCESSES = {
    "attitude so3_left": (attitude_model(N_GYRO, so3_left), attitude_input, False),
    "drift so3_left": (attitude_drift_model(N_GYRO, so3_left), attitude_input, True),
    "drift so3_right": (attitude_drift_model(N_GYRO, so3_right), attitude_input, True),
    "commanded so3_left": (attitude_drift_model(N_GYRO, so3_left), commanded_input, True),
    "commanded so3_right": (attitude_drift_model(N_GYRO, so3_right), commanded_input, True),
    **{
        f"xu2020 {r.name}": (xu2020.lie_model(1e-4, 1e-3, r), lambda v: v, False)
        for r in (so3_right, so3_left, gibbs_left)
    },
}
SENSORS = {
    **{f"stars {r.name}": (star_directions(1e-3, r), r) for r in (so3_left, gibbs_left, so3_right)},
    **{f"unit {r.name}": (unit_star_directions(1e-3, r), r) for r in (so3_left, gibbs_left, so3_right)},
    "whole so3_left": (whole_attitude(so3_left), so3_left),
}


@compiled
def _jacobians(q, b, v, dt, stars, d):
    """Differences of analytic and automatic derivatives, by name, each (N, ...)."""

    def of_process(model, u, x):
        r, p = model.retraction, model.process
        w0 = jnp.zeros(p.noise.dim)
        mean = p.step(p.params, x, u, dt_, w0)
        F, G = jax.jacfwd(lambda xi, w: r.boxminus(p.step(p.params, r.boxplus(x, xi), u, dt_, w), mean), (0, 1))(
            jnp.zeros(r.dim), w0
        )
        F_a, G_a = p.jacobian(p.params, x, u, dt_)
        return F_a - F, (jnp.eye(r.dim) if G_a is None else G_a) - G

    def of_sensor(sensor, r, x, a):
        z = sensor.predict(sensor.params, x, a)
        H = jax.jacfwd(lambda xi: sensor.minus(sensor.predict(sensor.params, r.boxplus(x, xi), a), z))(jnp.zeros(r.dim))
        return sensor.jacobian(sensor.params, x, a) - H

    def one(q, b, v, dt, stars, d):
        nonlocal dt_
        dt_ = dt
        x = AttitudeDrift(q, b)
        out = {k: of_process(m, u(v), x if drift else q) for k, (m, u, drift) in PROCESSES.items()}
        for k, (sensor, r) in SENSORS.items():
            a = jnp.eye(3) if k.startswith("whole") else stars
            out[k] = of_sensor(sensor, r, q, a)
            if r is so3_left:
                out[k + " with drift"] = of_sensor(sensor, product(AttitudeDrift, r, euclidean(3)), x, a)
        p = PRINTED.process
        consistent, _ = PROCESSES["xu2020 so3_right"][0].process.jacobian(p.params, q, v, dt)
        out["printed (25)"] = p.jacobian(p.params, q, v, dt)[0] - consistent.T
        p, s = ADDITIVE.process, ADDITIVE.sensors[0]
        linear = jax.jacfwd(lambda p: quaternion.multiply(p, quaternion.exp(v)))(q)
        out["additive process"] = p.jacobian(p.params, q, v, dt)[0] - linear
        tangent = quaternion.rate_matrix(q)
        H = jax.jacfwd(lambda dq: s.predict(s.params, quaternion_additive.boxplus(q, dq), stars).reshape(-1))(
            jnp.zeros(4)
        )
        out["additive sensor"] = (s.jacobian(s.params, q, stars) - H) @ tangent
        P = jnp.diag(jnp.array([1.0, 2.0, 3.0]))
        for side, J in (("right", so3.right_jacobian(d)), ("left", so3.left_jacobian(d))):
            out["carry " + side] = carry_covariance(SIDE[side], "jacobian", q, d, P) - J @ P @ J.T
        return out

    dt_ = None
    return jax.vmap(one)(q, b, v, dt, stars, d)


@cache
def jacobian_differences():
    r = np.random.default_rng(2)
    stars = r.normal(size=(N, STARS, 3))
    stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
    d = r.normal(size=(N, 3))
    d *= r.uniform(0, 3.0, size=(N, 1)) / np.linalg.norm(d, axis=1, keepdims=True)
    d[0] = 0.0
    q = Rotation.random(N, rng=r).as_quat()
    v = r.normal(size=(N, 3))
    v[0] = 0.0
    args = (q, 0.1 * r.normal(size=(N, 3)), v, r.uniform(0.1, 2.0, N), stars, d)
    return numpy_of(_jacobians(*(jnp.asarray(a) for a in args)))


NAMES = [
    *PROCESSES,
    *SENSORS,
    *(k + " with drift" for k, (_, r) in SENSORS.items() if r is so3_left),
    "printed (25)", "additive process", "additive sensor", "carry right", "carry left",
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_analytic_jacobian_is_the_automatic_one(name):
    """At the retraction's zero, for random states, rates up to 3 rad/s and steps up to 2 s: rounding alone."""
    for leaf in jax.tree.leaves(jacobian_differences()[name]):
        assert np.max(np.abs(leaf)) < 1e-12


def test_every_analytic_jacobian_is_tested():
    assert set(jacobian_differences()) == set(NAMES)
    for model, *_ in PROCESSES.values():
        assert model.process.jacobian is not None
    for sensor, _ in SENSORS.values():
        assert sensor.jacobian is not None
    # Where no analytic one is claimed the filter differentiates.
    assert attitude_model(N_GYRO, so3_right).process.jacobian is None
    assert whole_attitude(so3_right).jacobian is None
