"""Laws of the evaluation: bands against simulation, bounds against another form of the recursion, counts by hand.

Bands and frequencies of simulations are held to five standard errors of the number of samples at a fixed seed; algebra to
1e-10 relative.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from helmstar.evaluate import (
    arrival,
    chi_square_band,
    correlation_factor,
    diverged,
    paired_difference,
    quadratic_form,
    recursive_bound,
    steady_state_variance,
)

# --- consistency -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dof", "runs", "probability"), [(1, 1, 0.95), (3, 100, 0.95), (6, 10, 0.5), (3, 20, 0.999)])
def test_chi_square_band_holds_the_mean_as_often_as_it_says(dof, runs, probability):
    r = np.random.default_rng(dof * runs)
    samples = 20000
    means = np.sum(r.normal(size=(samples, runs * dof)) ** 2, axis=1) / runs
    low, high = chi_square_band(dof, runs, probability)
    tail = 0.5 * (1 - probability)
    error = 5 * np.sqrt(tail * (1 - tail) / samples)
    assert np.mean(means < low) == pytest.approx(tail, abs=error)
    assert np.mean(means > high) == pytest.approx(tail, abs=error)


def test_chi_square_band_narrows_about_the_degrees_of_freedom():
    previous = (0.0, np.inf)
    for runs in (1, 10, 1000, 10**6):
        low, high = chi_square_band(3, runs)
        assert previous[0] < low < 3.0 < high < previous[1]
        previous = low, high
    # For many runs the mean is normal: 3 +- 1.96 sqrt(6 / N).
    assert high - low == pytest.approx(2 * 1.959964 * np.sqrt(6e-6), rel=1e-5)


@pytest.mark.parametrize("bad", [(0, 10, 0.95), (3, 0, 0.95), (3, 10, 0.0), (3, 10, 1.0), (3, 10, np.nan)])
def test_chi_square_band_refuses_what_makes_no_sense(bad):
    with pytest.raises(ValueError, match="dof and runs from 1"):
        chi_square_band(*bad)


def test_quadratic_form():
    r = np.random.default_rng(1)
    A = r.normal(size=(4, 5, 6, 8))
    P, x = A @ np.swapaxes(A, -1, -2), r.normal(size=(4, 5, 6))
    q = quadratic_form(x, P)
    assert q.shape == (4, 5)
    np.testing.assert_allclose(q, np.einsum("abi,abij,abj->ab", x, np.linalg.inv(P), x), rtol=1e-9)
    # Invariant under any change of axes and units, however small the numbers become: 1e-30 rad of 15 states.
    T = r.normal(size=(6, 6))
    np.testing.assert_allclose(quadratic_form(x @ T.T, T @ P @ T.T), q, rtol=1e-8)
    np.testing.assert_allclose(quadratic_form(1e-30 * x, 1e-60 * P), q, rtol=1e-9)
    np.testing.assert_allclose(quadratic_form(1e-30 * np.ones(15), 1e-60 * np.eye(15)), 15.0, rtol=1e-12)
    # One covariance for all errors.
    np.testing.assert_allclose(quadratic_form(x, np.broadcast_to(P[0, 0], P.shape))[0, 0], q[0, 0], rtol=1e-12)


def test_quadratic_form_of_consistent_errors_has_its_degrees_of_freedom():
    r = np.random.default_rng(2)
    A = r.normal(size=(3, 3))
    P, n = A @ A.T, 20000
    q = quadratic_form(r.multivariate_normal(np.zeros(3), P, size=n), np.broadcast_to(P, (n, 3, 3)))
    assert np.mean(q) == pytest.approx(3.0, abs=5 * np.sqrt(6 / n))
    low, high = chi_square_band(3, n, 0.999999)
    assert low < np.mean(q) < high


def test_quadratic_form_is_nan_where_it_does_not_exist_and_only_there():
    eye, singular = np.eye(2), np.array([[1.0, 1.0], [1.0, 1.0]])
    bad = np.array([[np.nan, 0.0], [0.0, 1.0]])
    x = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [np.nan, 2.0], [np.inf, 2.0], [3.0, 0.0]])
    q = quadratic_form(x, np.array([eye, singular, bad, eye, eye, 4.0 * eye]))
    np.testing.assert_array_equal(q, [5.0, np.nan, np.nan, np.nan, np.nan, 2.25])


def autoregressive(r, runs: int, times: int, rho: float) -> np.ndarray:
    x = np.empty((runs, times))
    x[:, 0] = r.normal(size=runs)
    for k in range(1, times):
        x[:, k] = rho * x[:, k - 1] + np.sqrt(1 - rho**2) * r.normal(size=runs)
    return x


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlation_factor_is_that_of_an_autoregression(rho):
    """Variance of a mean of T correlated numbers: (1 + 2 sum (1 - k/T) rho^k) / T; the variance of 2000 runs' means is
    known to sqrt(2 / 2000)."""
    runs, times = 2000, 100
    x = autoregressive(np.random.default_rng(3), runs, times, rho)
    k = np.arange(1, times)
    expected = 1 + 2 * np.sum((1 - k / times) * rho**k)
    factor = correlation_factor(5.0 + 3.0 * x)
    assert factor >= 1.0
    assert factor == pytest.approx(expected, rel=5 * np.sqrt(2 / runs))
    # It is what makes the band of a pooled mean honest: as many independent runs and times divided by it.
    means = x.reshape(100, 20, times).mean((1, 2))
    assert np.var(means) * 20 * times == pytest.approx(factor, rel=5 * np.sqrt(2 / 100))


def test_correlation_factor_at_its_ends():
    constant = np.arange(10.0)[:, None] * np.ones((10, 7))
    assert correlation_factor(constant) == pytest.approx(7 * 10 / 9)  # each run is one number
    assert correlation_factor(np.tile([1.0, -1.0], (10, 4))) == 1.0  # alternating: better than independent, so 1
    assert correlation_factor(np.ones((10, 7))) == 1.0
    assert correlation_factor(np.arange(7.0)[None]) == 1.0
    x = autoregressive(np.random.default_rng(4), 200, 50, 0.8)
    gaps = np.where(np.random.default_rng(5).random(x.shape) < 0.02, np.nan, x)
    assert correlation_factor(gaps) == pytest.approx(correlation_factor(x), rel=0.05)


# --- bounds ----------------------------------------------------------------------------------------------------------


def spd(r, *shape) -> np.ndarray:
    A = r.normal(size=(*shape, shape[-1] + 2))
    return A @ np.swapaxes(A, -1, -2)


def information_recursion(F, Q, J, P0) -> np.ndarray:
    """Tichavsky, Muravchik and Nehorai (1998), eq. (21): D22 - D21 (I + D11)^-1 D12, which never forms P-."""
    out, I = [], np.linalg.inv(P0)
    for Fk, Qk, Jk in zip(F, Q, J, strict=True):
        W = np.linalg.inv(Qk)
        I = W + Jk - W @ Fk @ np.linalg.inv(I + Fk.T @ W @ Fk) @ Fk.T @ W
        out.append(np.linalg.inv(I))
    return np.array(out)


def test_recursive_bound_is_the_information_form():
    r = np.random.default_rng(6)
    steps, n = 30, 4
    F = np.eye(n) + 0.3 * r.normal(size=(steps, n, n))
    Q, J, P0 = 0.1 * spd(r, steps, n), spd(r, steps, n), spd(r, n)
    J[::3] = 0.0  # no measurement
    bound = recursive_bound(F, Q, J, P0)
    np.testing.assert_allclose(bound, information_recursion(F, Q, J, P0), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(bound, np.swapaxes(bound, 1, 2))
    np.testing.assert_array_equal(recursive_bound(F, Q, J[0], P0), recursive_bound(F, Q, np.zeros_like(J), P0))
    # One matrix for all steps.
    np.testing.assert_array_equal(
        recursive_bound(F, Q[1], J[1], P0),
        recursive_bound(F, np.tile(Q[1], (steps, 1, 1)), np.tile(J[1], (steps, 1, 1)), P0),
    )
    assert recursive_bound(F[0], Q[0], J[0], P0).shape == (1, n, n)


def test_recursive_bound_bears_what_the_information_form_does_not():
    """No process noise, a perfect start, a sensor of rank one."""
    n = 3
    J = np.zeros((n, n))
    J[0, 0] = 4.0
    np.testing.assert_array_equal(
        recursive_bound(np.eye(n), np.zeros((n, n)), np.tile(J, (5, 1, 1)), np.zeros((n, n))), 0.0
    )
    bound = recursive_bound(np.eye(n), np.zeros((n, n)), np.tile(J, (5, 1, 1)), np.eye(n))
    for k in range(5):
        np.testing.assert_allclose(bound[k], np.diag([1 / (1 + 4.0 * (k + 1)), 1.0, 1.0]), rtol=1e-13)
    with pytest.raises(ValueError, match="infinite"):
        recursive_bound(np.eye(n), np.eye(n), np.diag([np.inf, 0.0, 0.0]), np.eye(n))


def test_recursive_bound_does_not_depend_on_the_axes():
    r = np.random.default_rng(7)
    steps, n = 10, 3
    F, Q, J, P0 = r.normal(size=(steps, n, n)), spd(r, steps, n), spd(r, steps, n), spd(r, n)
    T = r.normal(size=(n, n))
    U = np.linalg.inv(T)
    turned = recursive_bound(T @ F @ U, T @ Q @ T.T, U.T @ J @ U, T @ P0 @ T.T)
    np.testing.assert_allclose(turned, T @ recursive_bound(F, Q, J, P0) @ T.T, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("q", [1e-12, 1e-10, 1e-8, 1e-4])
@pytest.mark.parametrize("turning", [0.0, 0.3])
def test_recursive_bound_converges_to_the_closed_steady_state(q, turning):
    """xu2020's two stars: m = (1, 1, 2), the number of stars across which each axis lies. Turning about the third axis
    leaves its variance, and swaps nothing else when the first two have the same."""
    sigma2 = 1e-8
    m = np.array([1.0, 1.0, 2.0])
    c, s = np.cos(turning), np.sin(turning)
    F = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    p = steady_state_variance(q, sigma2, m)
    steps = (
        int(40 * np.sqrt(sigma2 / q)) + 60
    )  # the recursion forgets by 1 - sqrt(q / r) per step, and the rest doubles
    bound = recursive_bound(np.tile(F, (steps, 1, 1)), q * np.eye(3), np.diag(m) / sigma2, np.eye(3))[-1]
    np.testing.assert_allclose(bound, np.diag(p), rtol=1e-10, atol=1e-10 * p.max())


@pytest.mark.parametrize("ratio", [1e-12, 1e-4, 1.0, 1e4, 1e12, 1e20])
def test_steady_state_solves_the_riccati_equation(ratio):
    r, m = 1e-8, np.array([1.0, 2.0, 7.0])
    q = ratio * r
    p = steady_state_variance(q, r, m)
    np.testing.assert_allclose(p, (p + q) * (r / m) / (p + q + r / m), rtol=1e-13)
    assert np.all(p < r / m) if ratio < 1e12 else np.all(p <= r / m)
    if 1e-4 <= ratio <= 1e4:
        for variance, k in zip(p, m, strict=True):
            P = solve_discrete_are(np.eye(1), np.eye(1), [[ratio]], [[1 / k]])[0, 0]  # of the prediction, in units of r
            assert variance == pytest.approx(r * (P - ratio), rel=1e-6)


def test_steady_state_without_noise_is_zero():
    np.testing.assert_array_equal(steady_state_variance(0.0, 1.0, [1.0, 2.0]), 0.0)
    np.testing.assert_array_equal(steady_state_variance(1.0, 0.0, [1.0, 2.0]), 0.0)
    np.testing.assert_array_equal(steady_state_variance(0.0, 0.0, 1.0), 0.0)


# --- arrival and divergence --------------------------------------------------------------------------------------------

NAN, INF = np.nan, np.inf
ARRIVALS = [
    ([5, 4, 3, 0.5, 0.4], 4),
    ([0.5, 0.4, 0.3, 0.2, 0.1], 1),  # always below
    ([5, 0.5, 5, 0.5, 0.5], 4),  # leaves and comes back
    ([5, 5, 5, 5, 0.5], 5),  # at the last moment
    ([0.5, 0.5, 0.5, 0.5, 5], 0),  # leaves at the end
    ([5, 5, 5, 5, 5], 0),  # never
    ([0.5, 0.5, NAN, 0.5, 0.5], 4),
    ([0.5, 0.5, 0.5, 0.5, NAN], 0),
    ([INF, 0.5, 0.5, 0.5, 0.5], 2),
    ([5, 1.0, 1.0, 0.999, 0.5], 4),  # the limit itself is not below it
]


@pytest.mark.parametrize(("angle", "update"), ARRIVALS)
def test_arrival_of_one_run(angle, update):
    a = arrival(np.array([angle]), 1.0)
    assert (a.runs, a.by) == ((1, update) if update else (0, None))
    np.testing.assert_array_equal(a.updates, [update])


def test_arrival_of_many_runs_counts_each_and_waits_for_the_last():
    angles, updates = np.array([a for a, _ in ARRIVALS]), np.array([u for _, u in ARRIVALS])
    a = arrival(angles, 1.0)
    np.testing.assert_array_equal(a.updates, updates)
    assert (a.runs, a.by) == (7, None)  # one that never does: no update by which all have
    a = arrival(angles[updates > 0], 1.0)
    assert (a.runs, a.by) == (7, 5)


def test_arrival_agrees_with_a_search():
    r = np.random.default_rng(8)
    angle = np.abs(r.normal(size=(200, 12))) * 2.0 ** -np.arange(12)
    angle[r.random(angle.shape) < 0.05] = np.nan
    a = arrival(angle, 0.3)
    for run, update in zip(angle, a.updates, strict=True):
        stays = [k for k in range(12) if np.all(run[k:] < 0.3)]
        assert update == (stays[0] + 1 if stays else 0)
    assert 0 < a.runs < 200


def test_diverged():
    assert diverged(np.array([9.9, 10.0, 10.1, NAN, INF, 0.0]), 10.0) == 3
    assert diverged(np.array([1.0, 2.0]), 10.0) == 0
    assert diverged(np.array([NAN]), 10.0) == 1


# --- paired comparison -------------------------------------------------------------------------------------------------


def test_paired_difference_by_hand():
    d = paired_difference([1.0, 2.0, 3.0, 4.0], [2.0, 2.0, 5.0, 3.0])
    assert d.mean == -0.5
    assert d.standard_error == pytest.approx(np.sqrt(5 / 3) / 2)
    assert d.sigmas == pytest.approx(-1.0 / np.sqrt(5 / 3))
    assert (d.wins, d.runs) == (2, 4)


def test_paired_difference_sees_what_the_draws_hide():
    """A gain of 1 in draws that differ by 100: invisible in the means, 10 sigma in the pairs."""
    r = np.random.default_rng(9)
    shared = 100.0 * r.normal(size=400)
    a, b = shared + r.normal(size=400), shared + 1.0 + r.normal(size=400)
    d = paired_difference(a, b)
    assert d.mean == pytest.approx(-1.0, abs=5 * np.sqrt(2 / 400))
    assert d.standard_error == pytest.approx(np.sqrt(2 / 400), rel=5 / np.sqrt(800))
    assert d.sigmas < -9
    swapped = paired_difference(b, a)
    assert swapped.mean == -d.mean
    assert swapped.sigmas == -d.sigmas
    assert swapped.wins == 400 - d.wins


def test_paired_difference_leaves_out_lost_runs_and_says_so():
    d = paired_difference([1.0, NAN, 3.0, 4.0, INF], [2.0, 2.0, NAN, 5.0, 1.0])
    assert (d.mean, d.sigmas, d.wins, d.runs) == (-1.0, -INF, 2, 2)
    same = paired_difference([1.0, 2.0], [1.0, 2.0])
    assert (same.mean, same.sigmas, same.wins) == (0.0, 0.0, 0)


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ([1.0, 2.0], [1.0, 2.0, 3.0], "same runs"),
        ([[1.0, 2.0]], [[1.0, 2.0]], "same runs"),
        ([1.0, NAN], [1.0, 2.0], "at least 2"),
        ([], [], "at least 2"),
    ],
)
def test_paired_difference_refuses_what_it_cannot_compare(a, b, message):
    with pytest.raises(ValueError, match=message):
        paired_difference(np.array(a), np.array(b))
