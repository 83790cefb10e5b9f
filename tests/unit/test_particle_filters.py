"""Particles and mixtures: laws of resampling, and that a linear Gaussian problem has Kalman's answer in every filter."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from helmstar.backend import jax, jnp
from helmstar.core import (
    ABSENT,
    ACCEPTED,
    DEGENERATE,
    GATED,
    Gaussian,
    Measurement,
    Mixture,
    Model,
    Noise,
    Process,
    Sensor,
    chi_square_gate,
    no_gate,
)
from helmstar.filters import (
    BootstrapFilter,
    ErrorStateKalmanFilter,
    MixtureFilter,
    UnscentedBelief,
    UnscentedKalmanFilter,
    UnscentedParticleFilter,
    batch_map,
    draw,
    effective_number,
    grid_split,
    kernel_split,
    map_estimates,
    mixture_moments,
    moments,
    particle_moments,
    run,
    scaled,
    start_particles,
    start_unscented_particles,
)
from helmstar.filters.mixture import directions_part
from helmstar.filters.particle import root_of
from helmstar.filters.resampling import SCHEMES, normalised
from helmstar.filters.unscented import log_transition
from helmstar.geometry.retraction import euclidean
from helmstar.models.relative import Camera, Motion, PositionPointing, Sight, relative_model

R2 = euclidean(2)
STEPS = 12
Q = np.diag([0.02, 0.05])
P0 = np.array([[1.0, 0.3], [0.3, 0.8]])
SIGMA = 0.7
KEY = jax.random.key(3)


def _step(params, x, u, dt, w):
    return jnp.array([[1.0, 0.5], [-0.2, 0.9]]) @ x + w


def _cov(params, x, u, dt):
    return jnp.asarray(Q)


def _predict(params, x, a):
    return x[:1] + 0.5 * x[1:]


def _minus(z, z_hat):
    return z - z_hat


def _R(params, x, a):
    return jnp.full((1, 1), SIGMA**2)


MODEL = Model(R2, Process(_step, Noise(_cov, 2), None), (Sensor(_predict, _minus, _R, None),))
EKF, UKF = ErrorStateKalmanFilter(R2), UnscentedKalmanFilter(R2)


@partial(jax.jit, static_argnames=("filter",))
def _update(filter, belief, m, gate):
    return filter.update(belief, MODEL.sensors[0], m, gate, jnp.zeros((), int))


def _data() -> Measurement:
    rng = np.random.default_rng(5)
    x = np.linalg.cholesky(P0) @ rng.standard_normal(2)
    z = []
    for _ in range(STEPS):
        x = np.array([[1.0, 0.5], [-0.2, 0.9]]) @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(2)
        z.append([x[0] + 0.5 * x[1] + SIGMA * rng.standard_normal()])
    mask = np.ones((STEPS, 1), bool)
    mask[4] = False
    return Measurement(jnp.array(z), jnp.zeros(STEPS), jnp.array(mask))


DATA = _data()
START = Gaussian(jnp.zeros(2), jnp.array(P0))
UNSCENTED = UnscentedBelief(START.mean, START.cov, scaled(1.0, 2.0, 0.0))


def _track(filter, belief, out, model=MODEL):
    def keep(belief, predicted, infos):
        return out(belief), infos[0]

    zeros, ones = jnp.zeros(STEPS), jnp.ones(STEPS)
    _, _, (found, infos) = run(filter, model, belief, zeros, ones, (DATA,), no_gate(4), keep=keep)
    return found, infos


KALMAN, KALMAN_INFO = _track(EKF, START, lambda b: b)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_draws_each_particle_as_often_as_it_weighs(scheme):
    log_weights, _ = normalised(jnp.log(jnp.array([0.02, 0.4, 0.08, 0.2, 0.3])))
    n, draws = 5, 4000
    indices = np.asarray(jax.vmap(lambda k: draw(k, log_weights, scheme))(jax.random.split(KEY, draws)))
    counts = np.stack([(indices == i).sum(axis=1) for i in range(n)])
    # Multinomial counts have the largest variance, n w (1 - w): 5 standard errors of 4000 draws.
    w = np.exp(np.asarray(log_weights))
    tolerance = 5.0 * np.sqrt(n * w * (1.0 - w) / draws)
    assert np.all(np.abs(counts.mean(axis=1) - n * w) <= tolerance)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-30, 0), min_size=7, max_size=7), st.integers(0, 2**31 - 1))
def test_copies_differ_from_their_share_by_less_than_each_scheme_promises(logs, seed):
    log_weights, _ = normalised(jnp.array(logs))
    share = 7.0 * np.exp(np.asarray(log_weights))
    key = jax.random.key(seed)
    counts = {s: np.bincount(np.asarray(draw(key, log_weights, s)), minlength=7) for s in SCHEMES}
    assert all(c.sum() == 7 for c in counts.values())
    assert np.all(np.abs(counts["systematic"] - share) < 1.0 + 1e-6)
    assert np.all(np.abs(counts["stratified"] - share) < 2.0 + 1e-6)
    assert np.all(counts["residual"] >= np.floor(share + 1e-9))


def test_an_unknown_scheme_is_refused():
    with pytest.raises(ValueError, match="systematic"):
        draw(KEY, jnp.zeros(3), "roulette")  # type: ignore[arg-type]


def test_weights_survive_what_is_no_number():
    log_weights, total = normalised(jnp.array([-1e5, -1e5 - 1.0, jnp.nan, -jnp.inf]))
    # Far below the range of exp, and still the ratio e: no underflow.
    np.testing.assert_allclose(np.exp(np.asarray(log_weights)), [0.7310585786, 0.2689414214, 0, 0], atol=1e-10)
    np.testing.assert_allclose(total, -1e5 + np.log1p(np.exp(-1.0)), rtol=1e-12)
    even, nothing = normalised(jnp.full(4, -jnp.inf))
    assert nothing == -jnp.inf
    np.testing.assert_allclose(effective_number(even), 4.0, rtol=1e-12)


def test_a_root_of_a_singular_covariance():
    A = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    L = np.asarray(root_of(jnp.array(A)))
    np.testing.assert_allclose(L @ L.T, A, atol=1e-12)


# The same problem, many filters. The tolerance is 5 standard errors of a mean of n points, with some more for resampling.


@pytest.mark.parametrize(
    ("filter", "n", "tolerance"),
    [
        (BootstrapFilter(R2), 20_000, 0.05),
        # Each time points are drawn anew its kernels widen the cloud's variance by 4%.
        (BootstrapFilter(R2, "residual", regularised=True), 20_000, 0.1),
    ],
)
def test_a_bootstrap_filter_has_kalmans_answer(filter, n, tolerance):
    found, infos = _track(filter, start_particles(R2, START, n, KEY), partial(moments, R2))
    sigma = np.sqrt(np.diagonal(KALMAN.cov, axis1=1, axis2=2))
    assert np.max(np.abs(found.mean - KALMAN.mean) / sigma) < tolerance
    np.testing.assert_allclose(found.cov, KALMAN.cov, atol=0.08)
    np.testing.assert_allclose(infos.loglik.sum(), KALMAN_INFO.loglik.sum(), atol=0.15)
    assert infos.status.tolist() == [ABSENT if k == 4 else ACCEPTED for k in range(STEPS)]


@pytest.mark.parametrize(
    ("filter", "sampled_kernel", "n", "tolerance"),
    [
        (MixtureFilter(UKF, sampled=(0, 1), threshold=0.5), 0.0, 20_000, 0.06),
        (MixtureFilter(EKF, sampled=(1,), threshold=0.5), 0.0, 20_000, 0.06),
        (MixtureFilter(UKF, importance=True, threshold=0.5, split=(0,), kernel=0.6), 0.3, 2000, 0.06),
    ],
)
def test_mixtures_have_kalmans_answer_however_much_is_drawn(filter, sampled_kernel, n, tolerance):
    base = UNSCENTED if isinstance(filter.base, UnscentedKalmanFilter) else START
    along = jnp.eye(2) if len(filter.sampled) == 2 else jnp.eye(2)[:, list(filter.sampled or (0,))]
    belief = kernel_split(R2, base, n, KEY, along, sampled_kernel)
    found, infos = _track(filter, belief, partial(mixture_moments, R2))
    sigma = np.sqrt(np.diagonal(KALMAN.cov, axis1=1, axis2=2))
    assert np.max(np.abs(found.mean - KALMAN.mean) / sigma) < tolerance
    np.testing.assert_allclose(found.cov, KALMAN.cov, atol=0.06)
    np.testing.assert_allclose(infos.loglik.sum(), KALMAN_INFO.loglik.sum(), atol=0.15)


def test_a_grid_of_gaussians_has_kalmans_answer_almost_exactly():
    """Deterministic: what differs is the prior beyond 3.5 sigma, 5e-4 of it, and the ripple between kernels, below 1e-6."""
    found, infos = _track(
        MixtureFilter(EKF), grid_split(R2, START, 31, KEY, jnp.array([1.0, 0.0])), partial(mixture_moments, R2)
    )
    np.testing.assert_allclose(found.mean, KALMAN.mean, atol=2e-3)
    np.testing.assert_allclose(found.cov, KALMAN.cov, atol=2e-3)
    np.testing.assert_allclose(infos.loglik, KALMAN_INFO.loglik, atol=3e-3)


def test_with_nothing_drawn_one_component_is_the_base_filter():
    one = Mixture(jax.tree.map(lambda a: a[None], START), jnp.zeros(1), KEY, jnp.ones(()))
    found, infos = _track(MixtureFilter(EKF), one, partial(mixture_moments, R2))
    np.testing.assert_allclose(found.mean, KALMAN.mean, atol=1e-13)  # rounding of the weighted mean
    np.testing.assert_allclose(found.cov, KALMAN.cov, atol=1e-13)
    np.testing.assert_allclose(infos.nis, KALMAN_INFO.nis, atol=1e-12)


def test_the_literal_unscented_particle_filter_works_where_the_process_noise_is_wide():
    """Proposals N(m, P) of a UKF are near the transition's width only with wide process noise; then it is importance sampling."""
    model = Model(R2, Process(_step, Noise(_wide, 2), None), MODEL.sensors)
    exact, _ = _track(EKF, START, lambda b: b, model)
    belief = start_unscented_particles(R2, UNSCENTED, 20_000, KEY, model.process, jnp.zeros(()))
    found, _ = _track(UnscentedParticleFilter(R2, threshold=0.5), belief, partial(particle_moments, R2), model)
    sigma = np.sqrt(np.diagonal(exact.cov, axis1=1, axis2=2))
    # The first point of each particle is drawn from the prior and moved as a point; 0.15 sigma is what 20 000 leave.
    assert np.max(np.abs(found.mean - exact.mean) / sigma) < 0.15


def _wide(params, x, u, dt):
    return jnp.diag(jnp.array([1.0, 0.8]))


def test_a_points_proposal_is_its_exact_conditional():
    """p(x_k | x_k-1, z_k) of a linear model: N(f + K (z - h f), (I - K H) Q) with K = Q H^T (H Q H^T + R)^-1."""
    x, z = jnp.array([0.4, -1.1]), 0.9
    point = UnscentedBelief(x, jnp.zeros((2, 2)), scaled(1.0, 2.0, 0.0))
    predicted, _ = UKF.predict(point, MODEL.process, jnp.zeros(()), jnp.ones(()))
    m = Measurement(jnp.array([z]), jnp.zeros(()), jnp.array([True]))
    proposal, info = _update(UKF, predicted, m, no_gate(4))
    f = np.array([[1.0, 0.5], [-0.2, 0.9]]) @ np.asarray(x)
    H = np.array([[1.0, 0.5]])
    S = H @ Q @ H.T + SIGMA**2
    K = Q @ H.T / S
    np.testing.assert_allclose(proposal.mean, f + K[:, 0] * (z - H @ f), atol=1e-12)
    np.testing.assert_allclose(proposal.cov, (np.eye(2) - K @ H) @ Q, atol=1e-12)
    # And its weight, p(z | x_k-1), does not depend on what is drawn.
    np.testing.assert_allclose(info.loglik, stats.norm.logpdf(z, (H @ f)[0], np.sqrt(S[0, 0])), atol=1e-12)


def test_in_a_linear_model_the_true_weight_of_a_draw_is_the_evidence():
    belief = kernel_split(R2, UNSCENTED, 50, KEY, jnp.eye(2)[:, :1], 0.4)
    m = jax.tree.map(lambda a: a[0], DATA)
    made = [_update(MixtureFilter(UKF, importance=flag), belief, m, no_gate(4)) for flag in (False, True)]
    np.testing.assert_allclose(made[0][0].log_weights, made[1][0].log_weights, atol=1e-9)
    np.testing.assert_allclose(made[0][1].loglik, made[1][1].loglik, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1), st.floats(0.0, 1.0), st.integers(1, 4))
def test_splitting_takes_a_share_of_the_variance_and_leaves_a_covariance(seed, share, k):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    P, along = A @ A.T + 0.1 * np.eye(4), rng.standard_normal((4, k))
    part = np.asarray(directions_part(jnp.array(P), jnp.array(along), jnp.asarray(share)))
    scale = np.abs(along.T @ P @ along).max()
    np.testing.assert_allclose(along.T @ part @ along, share * along.T @ P @ along, atol=1e-8 * scale)
    assert np.linalg.eigvalsh(P - part).min() > -1e-8 * np.linalg.eigvalsh(P).max()


def test_a_split_belief_has_the_moments_of_the_whole():
    start = Gaussian(jnp.array([3.0, -1.0]), jnp.array(P0))
    grid = mixture_moments(R2, grid_split(R2, start, 31, KEY, jnp.array([0.0, 1.0])))
    np.testing.assert_allclose(grid.mean, start.mean, atol=1e-12)
    np.testing.assert_allclose(grid.cov, P0, atol=1e-12)
    drawn = mixture_moments(R2, kernel_split(R2, start, 4000, KEY, jnp.eye(2)[:, :1], 0.2))
    np.testing.assert_allclose(drawn.mean, start.mean, atol=2e-3)  # stratified: far below 1 / sqrt(n)
    np.testing.assert_allclose(drawn.cov, P0, atol=5e-3)


def test_batch_least_squares_is_kalmans_last_estimate_and_his_smoother():
    zeros, ones = jnp.zeros(STEPS), jnp.ones(STEPS)
    _, xs, P = batch_map(MODEL, START, zeros, ones, (DATA,), iterations=1)
    np.testing.assert_allclose(xs[-1], KALMAN.mean[-1], atol=1e-10)
    np.testing.assert_allclose(P, KALMAN.cov[-1], atol=1e-10)
    every = map_estimates(MODEL, START, zeros, ones, (DATA,), iterations=1)
    np.testing.assert_allclose(every.mean, KALMAN.mean, atol=1e-10)
    np.testing.assert_allclose(every.cov, KALMAN.cov, atol=1e-10)


# What is not as it should be.


def _far(filter, belief, z, gate=None):
    m = Measurement(jnp.array([z]), jnp.zeros(()), jnp.array([True]))
    return _update(filter, belief, m, gate or no_gate(4))


def test_weights_that_no_particle_deserves_are_reported():
    belief = start_particles(R2, START, 200, KEY)
    after, info = _far(BootstrapFilter(R2), belief, 1e4)
    assert info.status == DEGENERATE
    assert np.isfinite(after.log_weights).all()
    assert np.isfinite(after.points).all()
    unmoved, info = _far(BootstrapFilter(R2), belief, np.nan)
    assert info.status in (DEGENERATE, GATED)
    np.testing.assert_array_equal(unmoved.points, belief.points)


def test_a_gate_refuses_and_gives_way_in_the_end():
    gate = chi_square_gate(1e-6, max_dof=4, reopen_after=2)
    for filter, belief in (
        (BootstrapFilter(R2, least=0.0), start_particles(R2, START, 200, KEY)),
        (MixtureFilter(EKF, least=0.0), grid_split(R2, START, 5, KEY, jnp.array([1.0, 0.0]))),
    ):
        after, info = _far(filter, belief, 50.0, gate)
        assert info.status == GATED
        np.testing.assert_array_equal(after.log_weights, belief.log_weights)


def test_what_a_gate_refuses_does_not_move_the_literal_filter():
    """Refused or absent: the draw is the same, from the prediction, and so are its weights."""
    filter = UnscentedParticleFilter(R2, threshold=0.0, least=0.0)
    model = Model(R2, Process(_step, Noise(_wide, 2), None), MODEL.sensors)
    belief = start_unscented_particles(R2, UNSCENTED, 20, KEY, model.process, jnp.zeros(()))
    belief, _ = filter.predict(belief, model.process, jnp.zeros(()), jnp.ones(()))
    refused, info = _far(filter, belief, 50.0, chi_square_gate(1e-6, max_dof=4, reopen_after=2))
    assert info.status == GATED
    absent, info = _update(
        filter, belief, Measurement(jnp.array([np.nan]), jnp.zeros(()), jnp.array([False])), no_gate(4)
    )
    assert info.status == ABSENT
    np.testing.assert_allclose(refused.points, absent.points, rtol=1e-12)
    np.testing.assert_allclose(refused.log_weights, absent.log_weights, atol=1e-9)


def test_a_component_that_is_no_number_spoils_nothing():
    belief = grid_split(R2, START, 5, KEY, jnp.array([1.0, 0.0]))
    c = belief.components
    spoilt = Mixture(Gaussian(c.mean.at[0].set(jnp.nan), c.cov), belief.log_weights, KEY, belief.effective)
    _, log = normalised(belief.log_weights.at[0].set(-jnp.inf))
    rest = Mixture(c, belief.log_weights.at[0].set(-jnp.inf) - log, KEY, belief.effective)
    found, expected = (mixture_moments(R2, _far(MixtureFilter(EKF), b, 0.5)[0]) for b in (spoilt, rest))
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov, expected.cov, rtol=1e-12)


@pytest.mark.parametrize("base", [EKF, UKF])
@pytest.mark.parametrize("importance", [False, True])
def test_a_drawn_state_without_process_noise_keeps_kalmans_answer(base, importance):
    """Its variance stays zero, so that covariances are singular: first in order, where a Cholesky factor divides by it."""
    model = Model(R2, Process(_still, Noise(_one_noise, 2), None), MODEL.sensors)
    start = START if base is EKF else UNSCENTED
    exact, _ = _track(EKF, START, lambda b: b, model)
    belief = kernel_split(R2, start, 4000, KEY, jnp.eye(2)[:, :1], 0.0)
    found, infos = _track(
        MixtureFilter(base, sampled=(0,), importance=importance), belief, partial(mixture_moments, R2), model
    )
    assert DEGENERATE not in infos.status
    sigma = np.sqrt(np.diagonal(exact.cov, axis1=1, axis2=2))
    assert np.max(np.abs(found.mean - exact.mean) / sigma) < 0.06
    np.testing.assert_allclose(found.cov, exact.cov, atol=0.06)


def _still(params, x, u, dt, w):
    return jnp.array([[1.0, 0.0], [-0.2, 0.9]]) @ x + w


def _one_noise(params, x, u, dt):
    return jnp.diag(jnp.array([0.0, 0.05]))


def test_an_absent_measurement_leaves_everything():
    belief = grid_split(R2, START, 5, KEY, jnp.array([1.0, 0.0]))
    m = Measurement(jnp.array([jnp.nan]), jnp.zeros(()), jnp.array([False]))
    after, info = _update(MixtureFilter(EKF), belief, m, no_gate(4))
    assert info.status == ABSENT
    np.testing.assert_array_equal(after.components.mean, belief.components.mean)
    np.testing.assert_array_equal(after.log_weights, belief.log_weights)


# The model of the camera and the body.

MOTION = Motion(jnp.array([6e3, 0.0, 0.0]), jnp.asarray(10.0), jnp.asarray(17.3), jnp.asarray(7e-6))
CAMERA = Camera(
    jnp.array([[16760.0, 3.0, 200.0], [-2.0, 16750.0, 150.0]]),
    jnp.full(2, 512.0),
    jnp.asarray(0.3),
    jnp.array([0.0, 0, 0, 1]),
)


def _state(seed: int) -> tuple[PositionPointing, Sight]:
    rng = np.random.default_rng(seed)
    q = rng.standard_normal(4)
    q /= np.linalg.norm(q)
    x = PositionPointing(jnp.array(rng.standard_normal(3) * [4e6, 5e4, 1e5]), jnp.array(q))
    from helmstar.geometry import quaternion
    from helmstar.scenarios.li2007_data import look_at

    R = look_at(quaternion.rotate(x.q, -x.r) + 1e-3 * rng.standard_normal(3) * jnp.sqrt(jnp.sum(x.r**2)))
    return x, Sight(R, jnp.zeros(2), jnp.zeros((2, 2)))


@pytest.mark.parametrize("seed", range(4))
def test_jacobians_of_pixel_and_line_are_those_of_differences(seed):
    """Automatic against central differences, with K's cross terms, within 1e-6 of the largest entry of each block."""
    x, sight = _state(seed)
    model = relative_model(MOTION, CAMERA)
    sensor, r = model.sensors[0], model.retraction

    def z(xi):
        return sensor.predict(sensor.params, r.boxplus(x, xi), sight)

    H = np.asarray(jax.jacfwd(z)(jnp.zeros(6)))
    for block, step in ((slice(0, 3), 10.0), (slice(3, 6), 1e-6)):
        for j in range(block.start, block.stop):
            d = np.zeros(6)
            d[j] = step
            numerical = (np.asarray(z(jnp.array(d))) - np.asarray(z(jnp.array(-d)))) / (2.0 * step)
            np.testing.assert_allclose(H[:, j], numerical, atol=1e-6 * np.abs(H[:, block]).max())


def test_gamma_noise_is_what_its_density_says():
    model = relative_model(MOTION, CAMERA)
    x, _ = _state(0)
    n, noise, p = 40_000, model.process.noise, model.process.params
    assert noise.sample is not None
    assert noise.logpdf is not None
    dt = jnp.asarray(10.0)
    w = np.asarray(jax.vmap(lambda k: noise.sample(p, x, None, dt, k))(jax.random.split(KEY, n)))
    scale = 10.0 / np.sqrt(3.0)
    # 5 standard errors of the mean; variance and skewness of a Gamma of shape 3 have known errors too, here some 2 and 5%.
    assert np.all(np.abs(w[:, :3].mean(axis=0)) < 5 * 10.0 / np.sqrt(n))
    np.testing.assert_allclose(w[:, :3].std(axis=0), 10.0, rtol=0.02)
    np.testing.assert_allclose(stats.skew(w[:, :3]), 2.0 / np.sqrt(3.0), rtol=0.08)
    np.testing.assert_allclose(w[:, 3:].std(axis=0), 7e-6 * np.sqrt(10.0), rtol=0.02)
    assert stats.kstest(w[:, 0] + 3 * scale, stats.gamma(3.0, scale=scale).cdf).pvalue > 1e-3
    log = stats.gamma(3.0, scale=scale).logpdf(w[:5, :3] + 3 * scale).sum(axis=1)
    log += stats.norm(0.0, 7e-6 * np.sqrt(10.0)).logpdf(w[:5, 3:]).sum(axis=1)
    ours = [float(noise.logpdf(p, x, None, dt, jnp.array(one))) for one in w[:5]]
    np.testing.assert_allclose(ours, log, rtol=1e-9)
    # Below its support there is nothing; and the transition's density is that of the noise about the moved state.
    assert noise.logpdf(p, x, None, dt, jnp.array([-3.01 * scale, 0, 0, 0, 0, 0])) == -jnp.inf
    moved = model.process.step(p, x, None, dt, jnp.array(w[0]))
    np.testing.assert_allclose(log_transition(model.retraction, model.process, x, None, dt, moved), log[0], rtol=1e-4)


def test_gaussian_noise_where_the_truth_is_gaussian():
    model = relative_model(MOTION, CAMERA, gamma=False)
    x, _ = _state(0)
    noise, p, dt = model.process.noise, model.process.params, jnp.asarray(10.0)
    w = jnp.array([-25.0, 4.0, 30.0, 1e-5, -2e-5, 0.0])  # -25 m: below the Gamma's support
    expected = stats.norm(0.0, 10.0).logpdf(w[:3]).sum() + stats.norm(0.0, 7e-6 * np.sqrt(10.0)).logpdf(w[3:]).sum()
    moved = model.process.step(p, x, None, dt, w)
    np.testing.assert_allclose(log_transition(model.retraction, model.process, x, None, dt, moved), expected, rtol=1e-4)
    assert noise.sample is None  # then drawn by the covariance
