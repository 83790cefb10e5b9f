"""The models: rigid-body truth against closed forms and scipy, the attitude's step and noise, the star sensors' statistics.

Tolerances: the integrator is told 1e-13 relative; over some hundred steps and a hundred rad its attitudes agree within
1e-10 rad. Statistics are held to bands of probability 1e-6 for their number of samples, at a fixed seed.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helmstar.backend import jax, jnp
from helmstar.core import Gaussian, Measurement, no_gate
from helmstar.filters import ErrorStateKalmanFilter
from helmstar.filters.static import turn_covariance
from helmstar.geometry import so3_left
from helmstar.geometry.retraction import gibbs_left, quaternion_additive, so3_right
from helmstar.models import rigid_body, xu2020
from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model, attitude_model
from helmstar.models.sensors import star_directions, tangent_basis, unit_star_directions, whole_attitude

J = np.diag([200.0, 300.0, 100.0])
Q0 = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_quat()
TURNED = Rotation.from_rotvec([0.4, 0.1, -0.7]).as_matrix()


def angle(q, p) -> np.ndarray:
    return (Rotation.from_quat(np.asarray(q)) * Rotation.from_quat(np.asarray(p)).inv()).magnitude()


def nothing(t: float) -> np.ndarray:
    return np.zeros(3)


def rate(t: float) -> np.ndarray:
    return np.array([0.3 * np.cos(0.7 * t), -0.2 * np.sin(0.5 * t), 0.1 + 0.1 * np.cos(1.1 * t)])


def acceleration(t: float) -> np.ndarray:
    return np.array([-0.21 * np.sin(0.7 * t), -0.1 * np.cos(0.5 * t), -0.11 * np.sin(1.1 * t)])


# --- rigid body --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inertia", [J, TURNED @ J @ TURNED.T], ids=["principal", "full"])
@pytest.mark.parametrize("rate0", [[0.1, 0.2, -0.3], [0.3, 1e-6, 0.0]], ids=["any", "next to the unstable axis"])
def test_without_torque_energy_and_angular_momentum_are_conserved(inertia, rate0):
    s = rigid_body.simulate(np.linspace(0, 300, 151), Q0, "body", inertia=inertia, torque=nothing, rate0=rate0)
    L = s.rate @ inertia
    energy = 0.5 * np.sum(s.rate * L, axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(L, axis=1), np.linalg.norm(L[0]), rtol=1e-11)
    # With the physical law its direction in N is conserved too: dR_BN/dt = -[w x] R_BN.
    L_N = Rotation.from_quat(s.q).inv().apply(L)
    assert np.max(np.abs(L_N - L_N[0])) < 1e-10 * np.linalg.norm(L_N[0])
    assert np.max(np.abs(s.rate - s.rate[0])) > 0.01  # and it does move


def test_a_symmetric_top_precesses_as_in_closed_form():
    A, C, w0 = 2.0, 3.0, np.array([0.1, 0.0, 0.5])
    t = np.linspace(0, 100, 201)
    s = rigid_body.simulate(t, Q0, "body", inertia=np.diag([A, A, C]), torque=nothing, rate0=w0)
    k = (C - A) / A * w0[2]
    expected = np.stack([0.1 * np.cos(k * t), 0.1 * np.sin(k * t), np.full_like(t, 0.5)], axis=1)
    assert np.max(np.abs(s.rate - expected)) < 1e-11
    # Attitude: R_BN = exp(k t z) [turn about L by -|L| t / A in N] up to the start: in B the top spins by k about z.
    R0, L = Rotation.from_quat(Q0), np.array([A * w0[0], 0.0, C * w0[2]])
    about_L = Rotation.from_rotvec(-t[:, None] * R0.inv().apply(L) / A)
    spin = Rotation.from_rotvec(np.stack([0 * t, 0 * t, k * t], axis=1))
    assert np.max(angle(s.q, (spin * R0 * about_L).as_quat())) < 1e-10


@pytest.mark.parametrize("law", ["body", "printed"])
def test_a_constant_rate_turns_as_scipy_composes(law):
    w, t = np.array([0.2, -0.5, 0.3]), np.linspace(0, 50, 26)
    s = rigid_body.simulate(t, Q0, law, rate=lambda _: w)
    turn, R0 = Rotation.from_rotvec(t[:, None] * w), Rotation.from_quat(Q0)
    expected = turn.inv() * R0 if law == "body" else R0 * turn
    assert np.max(angle(s.q, expected.as_quat())) < 1e-11
    np.testing.assert_allclose(s.increment, np.tile(2.0 * w, (25, 1)), atol=1e-12)
    np.testing.assert_array_equal(s.rate, np.tile(w, (26, 1)))


@pytest.mark.parametrize("law", ["body", "printed"])
def test_a_varying_rate_turns_as_small_turns_composed(law):
    """Magnus' expansion of fourth order over 5 ms (two Gauss points and their commutator): 1e-12 per rad."""
    t, n = np.linspace(0, 10, 11), 200
    s = rigid_body.simulate(t, Q0, law, rate=rate)
    h, R = 1.0 / n, Rotation.from_quat(Q0)
    sign = -1.0 if law == "body" else 1.0
    for k in range(10):
        for i in range(n):
            middle = k + (i + 0.5) * h
            first, second = rate(middle - h * np.sqrt(3) / 6), rate(middle + h * np.sqrt(3) / 6)
            # dR/dt = -[w x] R puts later turns on the left, dX/dt = X [w x] on the right; both commutators follow.
            half = np.sqrt(3) / 12 * h**2 * np.cross(first, second)
            turn = Rotation.from_rotvec(sign * 0.5 * h * (first + second) - (half if law == "body" else -half))
            R = turn * R if law == "body" else R * turn
        assert angle(s.q[k + 1], R.as_quat()) < 1e-11


@pytest.mark.parametrize("law", ["body", "printed"])
@pytest.mark.parametrize("step", [1.0, 6.0])
def test_increments_reproduce_the_attitudes(law, step):
    """Steps of 6 s turn by more than pi at times."""
    s = rigid_body.simulate(np.arange(0, 20 * step, step), Q0, law, rate=lambda t: 2.0 * rate(t))
    A, R = Rotation.from_rotvec(s.increment), Rotation.from_quat(s.q)
    following = A.inv() * R[:-1] if law == "body" else R[:-1] * A
    assert s.increment.shape == (19, 3)
    assert np.max((following * R[1:].inv()).magnitude()) < 1e-14
    assert np.max(np.linalg.norm(s.increment, axis=1)) <= np.pi
    np.testing.assert_allclose(np.linalg.norm(s.q, axis=1), 1.0, atol=1e-15)
    still = rigid_body.simulate(np.arange(3.0), Q0, law, rate=nothing)
    np.testing.assert_array_equal(still.increment, 0.0)


@pytest.mark.parametrize("law", ["body", "printed"])
def test_a_prescribed_rate_and_the_torque_it_needs_agree(law):
    t = np.linspace(0, 100, 101)
    inertia = TURNED @ J @ TURNED.T
    prescribed = rigid_body.simulate(t, Q0, law, rate=rate)
    torque = rigid_body.torque_of(rate, acceleration, inertia)
    euler = rigid_body.simulate(t, Q0, law, inertia=inertia, torque=torque, rate0=rate(0.0))
    assert np.max(np.abs(euler.rate - prescribed.rate)) < 1e-10
    assert np.max(angle(euler.q, prescribed.q)) < 1e-9
    np.testing.assert_allclose(euler.increment, prescribed.increment, atol=1e-10)


def test_torque_is_the_change_of_angular_momentum():
    """In N, by differences of R_NB J w along a trajectory."""
    inertia, t, h = TURNED @ J @ TURNED.T, 3.0, 1e-3
    s = rigid_body.simulate(np.array([0.0, t - h, t, t + h]), Q0, "body", rate=rate)
    L = Rotation.from_quat(s.q).inv().apply(s.rate @ inertia)
    expected = Rotation.from_quat(s.q[2]).apply(L[3] - L[1]) / (2 * h)
    torque = rigid_body.torque_of(rate, acceleration, inertia)(t)
    np.testing.assert_allclose(torque, expected, atol=1e-4 * np.linalg.norm(expected))  # the difference errs by h^2


def test_the_start_may_be_any_time_and_any_length_of_quaternion():
    s = rigid_body.simulate(np.array([5.0, 6.0]), 3.0 * Q0, "body", rate=lambda t: rate(t - 5.0))
    np.testing.assert_allclose(s.q[0], Q0, atol=1e-15)
    np.testing.assert_allclose(
        s.q[1], rigid_body.simulate(np.array([0.0, 1.0]), Q0, "body", rate=rate).q[1], atol=1e-12
    )


@pytest.mark.parametrize("time", [[], [5.0], [0.0, 1.0, 1.0], [1.0, 0.0], [0.0, np.nan]])
def test_times_that_do_not_increase_are_an_error(time):
    with pytest.raises(ValueError, match="two or more increasing"):
        rigid_body.simulate(np.array(time), Q0, "body", rate=rate)


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"rate": rate, "inertia": J, "torque": nothing, "rate0": np.zeros(3)},
        {"rate": rate, "torque": nothing},
        {"inertia": J, "torque": nothing},
    ],
)
def test_neither_or_both_ways_are_an_error(keywords):
    with pytest.raises(ValueError, match="give either rate, or inertia, torque and rate0"):
        rigid_body.simulate(np.arange(3.0), Q0, "body", **keywords)


def test_another_law_is_an_error():
    with pytest.raises(ValueError, match="'inertial': must be one of 'body', 'printed'"):
        rigid_body.simulate(np.arange(3.0), Q0, "inertial", rate=rate)  # type: ignore[arg-type]


@pytest.mark.parametrize("rate", [np.full(3, np.nan), np.array([np.inf, 0.0, 0.0])])
def test_a_rate_that_is_not_finite_is_refused(rate):
    """The integrator would look for its first step for ever."""
    with pytest.raises(ValueError, match=r"not finite at t = 0.0 s"):
        rigid_body.simulate(np.arange(3.0), Q0, "body", rate=lambda _: rate)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # scipy's own arithmetic overflows
def test_a_rate_too_fast_to_integrate_is_an_error_that_says_where():
    with pytest.raises(ValueError, match=r"the integrator stopped at t = |not finite at t = "):
        rigid_body.simulate(np.arange(3.0), Q0, "body", rate=lambda _: np.full(3, 1e300))


def test_a_rate_that_ends_is_an_error():
    with pytest.raises(ValueError, match=r"the integrator stopped at t = 1.0 s: "):
        rigid_body.simulate(np.arange(4.0), Q0, "body", rate=lambda t: rate(t) if t < 1.7 else np.full(3, np.nan))


# --- the attitude's process ----------------------------------------------------------------------------------------------

GYRO = GyroNoise(jnp.asarray(1e-3), jnp.asarray(1e-4))


def test_attitude_steps_follow_the_truth():
    """With the increment as the mean rate of the step, to rounding; and a drift that the gyro adds is taken off."""
    dt = 2.0
    s = rigid_body.simulate(np.arange(0, 41, dt), Q0, "body", rate=rate)
    q, u = jnp.asarray(s.q[:-1]), jnp.asarray(s.increment / dt)
    b = jnp.asarray([0.02, -0.01, 0.03])
    extra, w = jnp.zeros((3, 3)), jnp.zeros(6)

    def alone(q, u):
        p = attitude_model(GYRO).process
        return p.step(p.params, q, GyroInput(u, extra), dt, w[:3])

    def with_drift(q, u):
        p = attitude_drift_model(GYRO).process
        return p.step(p.params, AttitudeDrift(q, b), GyroInput(u + b, extra), dt, w)

    assert np.max(angle(jax.vmap(alone)(q, u), s.q[1:])) < 1e-14
    moved = jax.vmap(with_drift)(q, u)
    assert np.max(angle(moved.q_BN, s.q[1:])) < 1e-14
    np.testing.assert_array_equal(moved.b, np.tile(b, (20, 1)))


def test_steps_of_xu2020_follow_the_printed_law():
    s = rigid_body.simulate(np.arange(21.0), Q0, "printed", rate=rate)

    def step(p, w, q, u):
        return p.step(p.params, q, u, 1.0, jnp.zeros(w))

    for model, w in ((xu2020.lie_model(1e-4, 1e-3), 3), (xu2020.quaternion_model(1e-4, 1e-3), 4)):
        moved = jax.vmap(partial(step, model.process, w))(jnp.asarray(s.q[:-1]), jnp.asarray(s.increment))
        assert np.max(angle(moved, s.q[1:])) < 1e-14


def test_process_noise_acts_on_the_left_in_b():
    w = jnp.asarray([1e-3, -2e-3, 3e-3, 1e-4, 2e-4, -3e-4])
    p, x = attitude_drift_model(GYRO).process, AttitudeDrift(jnp.asarray(Q0), jnp.asarray([0.1, 0.0, -0.2]))
    u = GyroInput(jnp.asarray([0.3, 0.2, 0.1]), jnp.zeros((3, 3)))
    quiet, noisy = (p.step(p.params, x, u, 2.0, v) for v in (jnp.zeros(6), w))
    turn = Rotation.from_quat(noisy.q_BN) * Rotation.from_quat(quiet.q_BN).inv()
    np.testing.assert_allclose(turn.as_rotvec(), w[:3], atol=1e-15)
    np.testing.assert_allclose(noisy.b - quiet.b, w[3:], atol=1e-16)


def van_loan(omega, sigma_v, sigma_u, dt) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of d theta/dt = -w x theta + db + sigma_v n, d db/dt = sigma_u n' (Van Loan 1978)."""
    w = np.array([[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]])
    A = np.block([[-w, np.eye(3)], [np.zeros((3, 6))]])
    Qc = np.diag([sigma_v**2] * 3 + [sigma_u**2] * 3)
    M = expm(np.block([[-A, Qc], [np.zeros((6, 6)), A.T]]) * dt)
    F = M[6:, 6:].T
    return F, F @ M[:6, 6:]


@pytest.mark.parametrize("dt", [0.0, 0.01, 1.0, 30.0])
def test_drift_noise_is_van_loan_s_without_rotation_and_near_it_with(dt):
    sigma_v, sigma_u = 1e-3, 1e-4
    p = attitude_drift_model(GyroNoise(jnp.asarray(sigma_v), jnp.asarray(sigma_u))).process
    x = AttitudeDrift(jnp.asarray(Q0), jnp.asarray([0.1, 0.0, -0.2]))

    def of(omega):
        u = GyroInput(x.b + omega, jnp.zeros((3, 3)))
        return np.asarray(p.jacobian(p.params, x, u, dt)[0]), np.asarray(p.noise.cov(p.params, x, u, dt))

    (F, Q), (F_exact, Q_exact) = of(np.zeros(3)), van_loan(np.zeros(3), sigma_v, sigma_u, dt)
    np.testing.assert_allclose(F, F_exact, atol=1e-14 * (1 + dt))
    np.testing.assert_allclose(Q, Q_exact, rtol=1e-12, atol=1e-20)
    # With a rotation of 0.1 rad over the step F stays exact; Q is exact in the angle random walk, which is isotropic, and
    # Farrenkopf's neglect of the rotation is below 0.1 of the rate random walk's part.
    omega = np.array([0.06, -0.08, 0.0]) / max(dt, 1e-9)
    (F, Q), (F_exact, Q_exact) = of(omega), van_loan(omega, sigma_v, sigma_u, dt)
    np.testing.assert_allclose(F, F_exact, atol=1e-14 * (1 + dt))
    walk = np.sqrt(np.array([dt**3 / 3] * 3 + [dt] * 3)) * sigma_u
    assert np.all(np.abs(Q - Q_exact) <= 0.1 * np.outer(walk, walk) + 1e-20)


def test_additional_covariance_of_a_gap_is_the_attitude_s():
    extra = jnp.asarray([[3.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0]])
    x = AttitudeDrift(jnp.asarray(Q0), jnp.zeros(3))
    for model, state in ((attitude_model(GYRO), x.q_BN), (attitude_drift_model(GYRO), x)):
        p = model.process
        with_gap, without = (p.noise.cov(p.params, state, GyroInput(jnp.zeros(3), e), 2.0) for e in (extra, 0 * extra))
        difference = np.array(with_gap - without)
        np.testing.assert_allclose(difference[:3, :3], extra, rtol=1e-12)
        difference[:3, :3] = 0.0
        np.testing.assert_array_equal(difference, 0.0)


# --- sensors -----------------------------------------------------------------------------------------------------------


def test_tangent_basis_is_orthonormal_and_across():
    r = np.random.default_rng(1)
    b = r.normal(size=(200, 3))
    b[:8] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [0, 1e-9, 1], [1, 0, -0.0], [1, 1, 0]]
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    both = np.concatenate([np.asarray(tangent_basis(jnp.asarray(b))), b[..., None]], axis=-1)
    np.testing.assert_allclose(np.swapaxes(both, 1, 2) @ both, np.tile(np.eye(3), (200, 1, 1)), atol=1e-15)


SAMPLES, STARS, SIGMA = 4000, 3, 1e-4


def normalised_innovations(sensor, z, a, q) -> np.ndarray:
    """NIS of one update each, from starts off by draws from P."""
    P = np.diag([1e-4, 2e-4, 3e-4]) ** 2
    off = np.random.default_rng(3).normal(size=(SAMPLES, 3)) @ np.sqrt(P)
    start = (Rotation.from_rotvec(-off) * Rotation.from_quat(q)).as_quat()
    filter = ErrorStateKalmanFilter(so3_left)

    def one(q, z, a):
        m = Measurement(z, a, jnp.ones(len(z) if z.ndim == 2 else 1, bool))
        return filter.update(Gaussian(q, jnp.asarray(P)), sensor, m, no_gate(), jnp.asarray(0))[1]

    fast = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    info = jax.jit(jax.vmap(one), compiler_options=fast)(jnp.asarray(start), jnp.asarray(z), jnp.asarray(a))
    assert len(set(np.asarray(info.dof))) == 1
    return np.asarray(info.nis), int(info.dof[0])


def mean_is_chi_square(nis: np.ndarray, dof: int) -> bool:
    low, high = chi2.ppf([1e-6, 1 - 1e-6], dof * len(nis)) / len(nis)
    return low < np.mean(nis) < high


def test_nis_is_three_per_star_for_free_components_two_for_unit_directions_and_three_for_an_attitude():
    """A direction of unit length has no noise along itself: whoever counts three components of it expects 3 and finds 2."""
    r = np.random.default_rng(2)
    q = Rotation.random(SAMPLES, rng=r).as_quat()
    stars = r.normal(size=(SAMPLES, STARS, 3))
    stars /= np.linalg.norm(stars, axis=-1, keepdims=True)
    free = np.einsum("kij,knj->kni", Rotation.from_quat(q).as_matrix(), stars) + SIGMA * r.normal(size=stars.shape)
    unit = free / np.linalg.norm(free, axis=-1, keepdims=True)

    nis, dof = normalised_innovations(star_directions(SIGMA), free, stars, q)
    assert dof == 3 * STARS
    assert mean_is_chi_square(nis, dof)
    nis, dof = normalised_innovations(unit_star_directions(SIGMA), unit, stars, q)
    assert dof == 2 * STARS
    assert mean_is_chi_square(nis, dof)
    assert np.mean(nis) / STARS == pytest.approx(2.0, abs=0.05)

    # unit directions given to the sensor of free components
    e = (unit - np.einsum("kij,knj->kni", Rotation.from_quat(q).as_matrix(), stars)) / SIGMA
    assert np.mean(np.sum(e**2, axis=(1, 2))) / STARS == pytest.approx(2.0, abs=0.05)

    cov = np.diag([1e-4, 1e-4, 5e-4]) ** 2
    measured = (Rotation.from_rotvec(r.normal(size=(SAMPLES, 3)) @ np.sqrt(cov)) * Rotation.from_quat(q)).as_quat()
    nis, dof = normalised_innovations(whole_attitude(), measured, np.tile(cov, (SAMPLES, 1, 1)), q)
    assert dof == 3
    assert mean_is_chi_square(nis, dof)


def test_the_sign_of_a_measured_quaternion_does_not_matter():
    s, q = whole_attitude(), jnp.asarray(Q0)
    z = jnp.asarray((Rotation.from_rotvec([1e-3, 2e-3, -1e-3]) * Rotation.from_quat(Q0)).as_quat())
    np.testing.assert_allclose(s.minus(z, q), [1e-3, 2e-3, -1e-3], atol=1e-15)
    np.testing.assert_array_equal(s.minus(-z, q), s.minus(z, q))


def test_a_covariance_turned_to_another_retraction_describes_the_same_errors():
    r = np.random.default_rng(4)
    A = 1e-4 * r.normal(size=(3, 3))
    P, q = A @ A.T, jnp.asarray(Q0)
    errors = r.multivariate_normal(np.zeros(3), P, size=20000)
    truths = jnp.asarray((Rotation.from_rotvec(errors) * Rotation.from_quat(Q0)).as_quat())
    for retraction in (so3_left, so3_right, gibbs_left, quaternion_additive):
        xi = np.asarray(jax.vmap(retraction.boxminus, in_axes=(0, None))(truths, q))
        turned = np.asarray(turn_covariance(q, jnp.asarray(P), retraction))
        # The same draws in both: only the second order of 1e-4 rad is left.
        G = np.linalg.lstsq(errors, xi)[0].T
        np.testing.assert_allclose(turned, G @ P @ G.T, atol=1e-3 * np.max(np.abs(turned)))
        assert np.linalg.matrix_rank(turned, tol=1e-12) == 3
