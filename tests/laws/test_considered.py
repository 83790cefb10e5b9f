"""States that are considered but not estimated (Schmidt), that a gate does not doubt, and a smoother that stops."""

import jax.numpy as jnp
import numpy as np
import pytest

from helmstar.core import REOPENED, Gate, Gaussian, Measurement, Model, Noise, Process, Sensor, no_gate
from helmstar.filters import ErrorStateKalmanFilter, run, smooth
from helmstar.geometry.retraction import euclidean

F, Q, R = np.array([[1.0, 0.3], [0.0, 1.0]]), np.diag([0.04, 0.0]), 0.25
H = np.array([[1.0, 0.5]])


def _step(params, x, u, dt, w):
    return F @ x + jnp.concatenate([w, jnp.zeros(1)])


def _noise(params, x, u, dt):
    return jnp.full((1, 1), Q[0, 0])


def _predict(params, x, a):
    return H @ x


def _minus(z, z_hat):
    return z - z_hat


def _cov(params, x, a):
    return jnp.full((1, 1), R)


MODEL = Model(euclidean(2), Process(_step, Noise(_noise, 1), None), (Sensor(_predict, _minus, _cov, None),))
START = Gaussian(jnp.zeros(2), jnp.diag(jnp.array([1.0, 4.0])))


def go(filter, z, gate=None):
    n = len(z)
    m = Measurement(jnp.asarray(z)[:, None], jnp.zeros((n, 1)), jnp.ones((n, 1), bool))
    return run(filter, MODEL, START, jnp.zeros(n), jnp.ones(n), (m,), gate or no_gate())[2]


def test_a_considered_state_is_schmidts():
    """By its own formulas: gain of the estimated state alone, covariance of both."""
    z = np.random.default_rng(1).normal(size=12)
    t = go(ErrorStateKalmanFilter(euclidean(2), considered=(1,)), z)
    x, P = np.zeros(2), np.diag([1.0, 4.0])
    for k in range(len(z)):
        x, P = F @ x, F @ P @ F.T + Q
        K = P @ H.T / (H @ P @ H.T + R)
        K[1] = 0.0
        x = x + K[:, 0] * (z[k] - H @ x)
        A = np.eye(2) - K @ H
        P = A @ P @ A.T + R * K @ K.T
        np.testing.assert_allclose(t.belief.mean[k], x, atol=1e-14)
        np.testing.assert_allclose(t.belief.cov[k], P, atol=1e-13)
    assert float(t.belief.mean[-1, 1]) == 0.0
    assert float(t.belief.cov[-1, 1, 1]) == pytest.approx(4.0)


def test_its_covariance_is_that_of_the_errors():
    """Over draws of the considered state, the process and the noise; the filter's covariance is exact for its gains."""
    rng = np.random.default_rng(2)
    errors = []
    filter = ErrorStateKalmanFilter(euclidean(2), considered=(1,))
    import jax

    many = jax.jit(jax.vmap(lambda z: go(filter, z).belief.mean[-1]))
    x = rng.normal(size=(4000, 2)) * [1.0, 2.0]
    z = np.empty((4000, 12))
    for k in range(12):
        x = x @ F.T
        x[:, 0] += rng.normal(size=4000) * np.sqrt(Q[0, 0])
        z[:, k] = x @ H[0] + rng.normal(size=4000) * np.sqrt(R)
    errors = x - np.asarray(many(jnp.asarray(z)))
    P = np.asarray(go(filter, np.zeros(12)).belief.cov[-1])
    found = errors.T @ errors / 4000
    sigma = np.sqrt((P**2 + np.outer(np.diag(P), np.diag(P))) / 4000)  # Wishart
    assert np.all(np.abs(found - P) < 5 * sigma)


def test_a_reopening_gate_does_not_doubt_constant_states():
    z = np.array([0.0, 0.0, 100.0, 100.0])
    gate = Gate(limits=jnp.asarray([0.0, 9.0]), reopen_after=jnp.asarray(1))
    plain = go(ErrorStateKalmanFilter(euclidean(2)), z, gate)
    kept = go(ErrorStateKalmanFilter(euclidean(2), constant=(1,)), z, gate)
    assert int(kept.infos[0].status[2]) == REOPENED
    before = np.asarray(kept.predicted.cov[2])
    after = np.asarray(kept.belief.cov[2])
    assert after[1, 1] == pytest.approx(before[1, 1])
    assert after[0, 0] > 100 * before[0, 0]
    assert float(plain.belief.cov[2, 1, 1]) > 100 * before[1, 1]
    # A correlation stays what it was.
    r = [P[0, 1] / np.sqrt(P[0, 0] * P[1, 1]) for P in (before, after)]
    assert r[0] == pytest.approx(r[1])


def test_a_break_parts_the_smoothing_in_two():
    """What is filtered after a break is smoothed as a track of its own, and what was before as if that were the end."""
    z = np.random.default_rng(3).normal(size=10)
    t = go(ErrorStateKalmanFilter(euclidean(2)), z)
    cut = 6
    breaks = jnp.arange(10) == cut
    both = smooth(euclidean(2), t.belief, t.predicted, breaks=breaks)
    import jax

    first, second = (
        jax.tree.map(lambda a, s=s: a[s], (t.belief, t.predicted)) for s in (slice(0, cut), slice(cut, 10))
    )
    for part, s in ((first, slice(0, cut)), (second, slice(cut, 10))):
        alone = smooth(euclidean(2), *part)
        np.testing.assert_allclose(both.mean[s], alone.mean, atol=1e-14)
        np.testing.assert_allclose(both.cov[s], alone.cov, atol=1e-14)
    whole = smooth(euclidean(2), t.belief, t.predicted)
    assert np.abs(np.asarray(whole.mean - both.mean))[:cut].max() > 1e-3
