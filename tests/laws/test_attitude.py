"""Laws of Wahba's problem: both solvers agree with each other and with scipy, are exact without noise, and know their error.

Tolerances: an attitude from exact directions carries the rounding of its directions and of a 4x4 or 3x3 decomposition,
amplified by the spread of the directions: 1e-14 rad for two at right angles. Monte Carlo figures are held to bands of
probability 1e-6 for the number of samples, at a fixed seed.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from helmstar.attitude import WahbaSolution, davenport, svd

SOLVERS = [davenport, svd]
TAIL = 1e-6


def directions(r, *shape) -> np.ndarray:
    v = r.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turned(R: Rotation, r_N: np.ndarray) -> np.ndarray:
    """R_BN r of one rotation or a batch of them."""
    return np.einsum("...ij,...nj->...ni", R.as_matrix(), r_N)


def angle(q, R: Rotation) -> np.ndarray:
    return (Rotation.from_quat(np.asarray(q, float)) * R.inv()).magnitude()


def special_rotations() -> Rotation:
    """Identity, turns of pi, next to pi and next to 0 about axes and diagonals, and random ones."""
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [1, 1, 1], [-0.3, 0.8, 0.52]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = [a * axes for a in (0.0, np.pi, np.pi - 1e-9, np.pi + 1e-6, 1e-9, 0.5 * np.pi)]
    vectors.append(Rotation.random(100, rng=np.random.default_rng(1)).as_rotvec())
    return Rotation.from_rotvec(np.concatenate(vectors))


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("n", [2, 3, 10])
def test_exact_without_noise(solver, n):
    R = special_rotations()
    r_N = directions(np.random.default_rng(n), len(R), n)
    r_N[:, :2] = np.eye(3)[:2]
    sigma = 1e-4
    s = solver(turned(R, r_N), r_N, sigma)
    assert isinstance(s, WahbaSolution)
    assert np.all(s.observable)
    assert np.max(angle(s.q_BN, R)) < 1e-14
    assert np.max(np.abs(np.linalg.norm(s.q_BN, axis=1) - 1.0)) < 1e-15
    assert np.max(s.loss) < n * (1e-14 / sigma) ** 2


@pytest.mark.parametrize("n", [2, 3, 8])
@pytest.mark.parametrize("scale", [1e-5, 1e-2, 0.3])
def test_solvers_agree_with_each_other_and_with_scipy(n, scale):
    """scipy's sensitivity times the harmonic mean of the variances is the covariance (its documentation). It is built
    from B, which has the noise in it, where this one is from the fitted directions: they differ by that noise."""
    r = np.random.default_rng(n)
    for _ in range(5):
        R, r_N = Rotation.random(rng=r), directions(r, n)
        sigma = scale * r.uniform(0.5, 2.0, n)
        b = turned(R, r_N) + sigma[:, None] * r.normal(size=(n, 3))
        b /= np.linalg.norm(b, axis=1, keepdims=True)
        C, _, sensitivity = Rotation.align_vectors(b, r_N, weights=sigma**-2, return_sensitivity=True)
        covariance = sensitivity / np.mean(sigma**-2)
        eigenvalues = np.linalg.eigvalsh(covariance)
        spread = np.sqrt(eigenvalues[-1] / eigenvalues[0])  # how much worse than at right angles
        solutions = [solver(b, r_N, sigma) for solver in SOLVERS]
        for s in solutions:
            assert angle(s.q_BN, C) < 1e-13 * spread**2
            loss = 0.5 * np.sum(sigma**-2 * np.sum((b - C.apply(r_N)) ** 2, axis=1))  # rssd cancels: 1e-6 at 1e-5
            assert s.loss == pytest.approx(loss, rel=1e-8)
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            relative = np.linalg.eigvalsh(root @ s.covariance @ root.T)
            assert np.all(np.abs(relative - 1.0) < 10 * scale * spread)
        first, second = solutions
        np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-9, atol=1e-9 * np.max(eigenvalues))


@pytest.mark.parametrize("solver", SOLVERS)
def test_weights_lengths_and_signs(solver):
    r = np.random.default_rng(5)
    n = 4
    R, r_N = Rotation.random(rng=r), directions(r, n)
    sigma = np.array([1e-3, 2e-3, 5e-4, 1e-2])
    b = turned(R, r_N) + sigma[:, None] * r.normal(size=(n, 3))
    s = solver(b, r_N, sigma)
    # Only directions count; only ratios of the sigmas decide the attitude, their scale the covariance and the loss.
    lengths = r.uniform(0.1, 1e6, size=(2, n, 1))
    t = solver(b * lengths[0], r_N * lengths[1], sigma)
    assert angle(t.q_BN, Rotation.from_quat(s.q_BN)) < 1e-14
    t = solver(b, r_N, 1e-6 * sigma)
    assert angle(t.q_BN, Rotation.from_quat(s.q_BN)) < 1e-14
    np.testing.assert_allclose(t.covariance, 1e-12 * s.covariance, rtol=1e-12)
    assert t.loss == pytest.approx(1e12 * s.loss, rel=1e-9)
    # A direction twice is the direction once with twice the weight; one of no weight is not there.
    twice = [0, 0, 1, 2, 3]
    t = solver(b[twice], r_N[twice], np.array([1e-3 * np.sqrt(2), 1e-3 * np.sqrt(2), 2e-3, 5e-4, 1e-2]))
    assert angle(t.q_BN, Rotation.from_quat(s.q_BN)) < 1e-13
    np.testing.assert_allclose(t.covariance, s.covariance, rtol=1e-11, atol=1e-18)
    # The better star decides: with one at 1e-3 of the other's sigma its own misfit vanishes.
    b = turned(R, r_N[:2]) + 1e-2 * r.normal(size=(2, 3))
    t = solver(b, r_N[:2], [1e-5, 1e-2])
    first = b[0] / np.linalg.norm(b[0])
    assert np.linalg.norm(Rotation.from_quat(t.q_BN).apply(r_N[0]) - first) < 1e-7
    # Whole numbers are numbers.
    t = solver([[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(Rotation.from_quat(t.q_BN).as_matrix(), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_mask_is_a_shorter_list(solver):
    r = np.random.default_rng(6)
    R, r_N = Rotation.random(20, rng=r), directions(r, 20, 5)
    b = turned(R, r_N) + 1e-3 * r.normal(size=(20, 5, 3))
    mask = r.random((20, 5)) < 0.6
    mask[:, :2] = True
    sigma = 1e-3 * r.uniform(0.5, 2.0, 5)
    whole = solver(np.where(mask[..., None], b, np.nan), np.where(mask[..., None], r_N, np.inf), sigma, mask)
    for k in range(20):
        m = mask[k]
        s = solver(b[k, m], r_N[k, m], sigma[m])
        assert angle(whole.q_BN[k], Rotation.from_quat(s.q_BN)) < 1e-12
        np.testing.assert_allclose(whole.covariance[k], s.covariance, rtol=1e-9)
        assert whole.loss[k] == pytest.approx(s.loss, rel=1e-9, abs=1e-12)


# --- statistics ------------------------------------------------------------------------------------------------------

SAMPLES = 20000


@pytest.mark.parametrize("solver", SOLVERS)
def test_covariance_and_loss_are_those_of_monte_carlo(solver):
    """Noise across the directions with unequal sigmas; theta on the left, R_true = exp(theta) R_hat."""
    r = np.random.default_rng(8)
    n = 4
    R, r_N = Rotation.random(rng=r), directions(r, n)
    sigma = 1e-4 * np.array([1.0, 3.0, 0.5, 2.0])
    b = turned(R, r_N)
    noise = sigma[:, None] * r.normal(size=(SAMPLES, n, 3))
    noise -= np.sum(noise * b, axis=-1, keepdims=True) * b
    s = solver(b + noise, np.broadcast_to(r_N, (SAMPLES, n, 3)), sigma)
    theta = (R * Rotation.from_quat(s.q_BN).inv()).as_rotvec()
    nees = np.einsum("ki,kij,kj->k", theta, np.linalg.inv(s.covariance), theta)
    # Second order: theta^2 / theta = 1e-4, far below the statistical 1 percent.
    low, high = chi2.ppf([TAIL, 1 - TAIL], 3 * SAMPLES)
    assert low < nees.sum() < high
    assert kstest(nees, chi2(3).cdf).pvalue > TAIL
    # Each element: a sample covariance whitened by the analytic one is I within 5 sigma of its sampling error.
    W = np.linalg.inv(np.linalg.cholesky(s.covariance[0]))
    sample = W @ (theta.T @ theta / SAMPLES) @ W.T
    assert np.max(np.abs(sample - np.eye(3)) / np.sqrt(1 + np.eye(3))) < 5 / np.sqrt(SAMPLES)
    # The loss is half a chi-square of what the fit leaves: two for each direction less the three of the attitude.
    dof = 2 * n - 3
    low, high = chi2.ppf([TAIL, 1 - TAIL], dof * SAMPLES)
    assert low < 2 * s.loss.sum() < high
    assert kstest(2 * s.loss, chi2(dof).cdf).pvalue > TAIL


# --- what cannot be observed -----------------------------------------------------------------------------------------

X, Y = np.array([1.0, 0, 0]), np.array([0.0, 1, 0])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("r_N", "mask"),
    [
        ([X], [True]),
        ([X, X], [True, True]),
        ([X, -X], [True, True]),
        ([X, -X, X], [True, True, True]),
        ([X, X + 1e-8 * Y], [True, True]),
        ([X, Y], [True, False]),
        ([X, Y], [False, False]),
    ],
)
def test_the_turn_about_a_single_line_is_not_observable(solver, r_N, mask):
    R = Rotation.from_rotvec([0.3, -1.0, 2.0])
    for b in (R.apply(r_N), np.full_like(r_N, np.nan)):
        s = solver(b, r_N, 1e-4, mask)
        assert not s.observable
        assert np.all(np.isnan(s.q_BN))
        assert np.all(np.isnan(s.covariance))
        assert np.isnan(s.loss)


@pytest.mark.parametrize("solver", SOLVERS)
def test_two_directions_1e_5_rad_apart_are_observable(solver):
    """And the covariance says how badly: the turn about them is known to sigma / sin(half the angle) / sqrt(2)."""
    r_N = np.array([[1.0, 5e-6, 0], [1.0, -5e-6, 0]])
    R = Rotation.from_rotvec([0.3, -1.0, 2.0])
    s = solver(R.apply(r_N), r_N, 1e-9)
    assert s.observable
    worst = np.sqrt(np.linalg.eigvalsh(s.covariance)[-1])
    assert worst == pytest.approx(1e-9 / 5e-6 / np.sqrt(2), rel=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_nan_is_not_observable_and_stays_with_its_epoch(solver):
    R, r_N = Rotation.random(3, rng=np.random.default_rng(0)), np.broadcast_to(np.eye(3), (3, 3, 3))
    b = turned(R, r_N)
    b[1, 0, 0] = np.nan
    s = solver(b, r_N, 1e-4)
    np.testing.assert_array_equal(s.observable, [True, False, True])
    assert np.max(angle(s.q_BN[::2], R[::2])) < 1e-14


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("b", "r_N", "keywords"),
    [
        (np.eye(3)[0], np.eye(3)[0], {}),
        (np.eye(3)[:, :2], np.eye(3)[:, :2], {}),
        (np.eye(3), np.eye(3)[:2], {}),
        (np.eye(4), np.eye(4), {}),
        (np.eye(3), np.eye(3), {"mask": [True]}),
        (np.eye(3), np.eye(3), {"mask": [True] * 4}),
        (np.eye(3), np.eye(3), {"sigma": [1e-3, 1e-3]}),
    ],
)
def test_shapes_that_do_not_fit_are_errors(solver, b, r_N, keywords):
    with pytest.raises(ValueError, match=r"must (be|have)"):
        solver(b, r_N, **keywords)


# --- NumPy and JAX ---------------------------------------------------------------------------------------------------


def test_numpy_in_numpy_out_and_no_jax():
    code = (
        "import sys, numpy as np\n"
        "from helmstar.attitude import davenport, svd\n"
        "for f in (davenport, svd):\n"
        "    s = f(np.eye(3), np.eye(3), 1e-3)\n"
        "    assert all(type(v) in (np.ndarray, np.bool_, np.float64) for v in s), s\n"
        "assert 'jax' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("solver", SOLVERS)
def test_jax_in_jax_out_under_jit_and_vmap(solver):
    from helmstar.backend import jax, jnp

    r = np.random.default_rng(9)
    R, r_N = special_rotations(), None
    n, k = 4, len(R)
    r_N = directions(r, k, n)
    sigma = 1e-3 * r.uniform(0.5, 2.0, n)
    b = turned(R, r_N) + sigma[:, None] * r.normal(size=(k, n, 3))
    mask = r.random((k, n)) < 0.7
    mask[:5] = True
    mask[5] = [True, False, False, False]
    b[~mask] = np.nan
    expected = solver(b, r_N, sigma, mask)
    assert all(not isinstance(v, jax.Array) for v in expected)
    fast = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    one = jax.jit(jax.vmap(solver, in_axes=(0, 0, None, 0)), compiler_options=fast)
    s = one(jnp.asarray(b), jnp.asarray(r_N), jnp.asarray(sigma), jnp.asarray(mask))
    assert all(isinstance(v, jax.Array) for v in s)
    ok = expected.observable
    np.testing.assert_array_equal(s.observable, ok)
    assert 0 < np.sum(~ok) < k // 2
    assert np.all(np.isnan(np.asarray(s.q_BN)[~ok]))
    q, P, loss = (np.asarray(v)[ok] for v in s[:3])
    scale = np.max(np.abs(expected.covariance[ok]), axis=(1, 2))
    amplified = scale / np.min(sigma) ** 2  # directions close together
    assert np.max(angle(q, Rotation.from_quat(expected.q_BN[ok])) / amplified) < 1e-13
    assert np.max(np.abs(P - expected.covariance[ok]) / (scale * amplified)[:, None, None]) < 1e-12
    np.testing.assert_allclose(loss, expected.loss[ok], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
def test_float32_stays_float32(solver):
    r = np.random.default_rng(10)
    R = Rotation.random(50, rng=r)
    r_N = np.broadcast_to(np.eye(3), (50, 3, 3))
    s = solver(turned(R, r_N).astype(np.float32), r_N.astype(np.float32), np.float32(1e-3))
    assert s.q_BN.dtype == s.covariance.dtype == s.loss.dtype == np.float32
    assert np.max(angle(s.q_BN, R)) < 10 * np.finfo(np.float32).eps
    np.testing.assert_allclose(s.covariance, np.broadcast_to(0.5e-6 * np.eye(3), (50, 3, 3)), atol=1e-11)
