"""Laws of SO(3): group, exp and log, Jacobians, derivatives - in float64 and float32, at 0, near pi and at pi.

Tolerances are in ulps: eps of the dtype, times the size of what is compared (1 unless a scale is given). The factors:

- an entry of exp(phi) is a sum of three products, and its angle carries the rounding of phi . phi, of which one ulp
  moves R by up to pi eps: 6 for one R;
- a product of two rotations adds a dot product of three terms (3) to both factors' errors: 16, of three factors 24;
- log undoes exp: the errors of R, of the normalised quaternion and of an arc tangent: 8. Relative to the angle, at
  every angle down to 1e-300: the skew part of R is kept to its last bit, so that nothing is lost near the identity;
- a derivative by automatic differentiation passes through the same operations about twice: twice the factor of its map.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.backend import COMPILER_OPTIONS, jax, jnp
from helmstar.geometry import so3

DTYPES = [np.float64, np.float32]
N = 16  # every batch has this length, so that each program compiles once for each dtype
program = partial(jax.jit, compiler_options=COMPILER_OPTIONS)
LAW = settings(deadline=None, derandomize=True, max_examples=30)

TINY = [0.0, 1e-300, 1e-160, 1e-37, 1e-30, 1e-19]
SMALL = [1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3]
GENERIC = [0.1, 0.4999999, 0.5000001, 0.9999999, 1.0000001, 1.5, 2.0, 2.5, 3.0]  # series end at 0.5 and 1
NEAR_PI = [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi - 1e-12, np.pi - 1e-15, np.pi]
ANGLES = [*TINY, *SMALL, *GENERIC, *NEAR_PI]
# Along axes, in diagonals (two or three equal components of the quaternion: ties), anywhere, almost along an axis.
AXES = [[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, -1], [1, 1, 1], [0.7, -1e-5, 0.7], [-0.3, 0.8, 0.52], [1e-9, 1, 0]]
AXES = np.array(AXES)
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


def vectors(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Angles about axes of any length but zero."""
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True) * angles[..., None]


def special_batches(angles=ANGLES) -> np.ndarray:
    """Each of the angles about each of AXES, in batches (k, N, 3), the last one filled up."""
    phi = vectors(np.repeat(AXES, len(angles), axis=0), np.tile(angles, len(AXES)))
    return np.resize(phi, (-(-len(phi) // N), N, 3))


def seeded(draw):
    """What `draw` makes of a random generator. (Hypothesis drives its seed: drawing each number would take far longer.)"""
    return st.integers(0, 2**32 - 1).map(lambda seed: draw(np.random.default_rng(seed)))


def rotation_vectors(largest: float = np.pi):
    """(N, 3): about AXES and others, by ANGLES and others up to `largest`."""

    def draw(rng):
        axes = np.where(rng.random((N, 1)) < 0.4, rng.choice(AXES, N), rng.normal(size=(N, 3)))
        return vectors(axes, np.where(rng.random(N) < 0.4, rng.choice(ANGLES, N), largest * rng.random(N)))

    return seeded(draw)


def plain(n: int):
    """(N, n) of numbers up to 2, every fifth one zero."""
    return seeded(lambda rng: np.where(rng.random((N, n)) < 0.2, 0.0, rng.uniform(-2, 2, (N, n))))


def error_in_ulps(actual, expected, scale=1.0) -> float:
    """Largest |actual - expected| over eps of actual's dtype times scale. A NaN is infinitely wrong; of the size of
    the smallest normal number a difference is none (XLA flushes to zero what is below, the half of an angle say)."""
    actual = np.asarray(actual)
    info = np.finfo(actual.dtype)
    e = np.abs(actual.astype(np.float64) - np.asarray(expected, np.float64))
    e = np.where(e <= 4 * info.tiny, 0.0, e) / (info.eps * np.maximum(scale, info.tiny))
    return float(np.max(np.where(np.isnan(e), np.inf, e)))


def close(actual, expected, ulps: float, scale=1.0) -> None:
    e = error_in_ulps(actual, expected, scale)
    assert e <= ulps, f"{e:.2f} ulps, {ulps} allowed"


def transposed(A) -> np.ndarray:
    return np.swapaxes(np.asarray(A), -1, -2)


def length(v) -> np.ndarray:
    """|v|, shape (..., 1), in float64 and without underflow."""
    v = np.asarray(v, np.float64)
    largest = np.max(np.abs(v), axis=-1, keepdims=True)
    return largest * np.linalg.norm(v / np.where(largest == 0.0, 1.0, largest), axis=-1, keepdims=True)


def nearest_form(actual, phi) -> np.ndarray:
    """phi; where its angle is pi to within rounding, and `actual` is the other vector of that rotation, that one."""
    phi, t = np.asarray(phi, np.float64), length(phi)
    other = phi - 2 * np.pi * phi / np.where(t == 0.0, 1.0, t)
    chose_other = np.linalg.norm(actual - other, axis=-1) < np.linalg.norm(actual - phi, axis=-1)
    at_pi = np.abs(t[..., 0] - np.pi) < 8 * np.finfo(np.asarray(actual).dtype).eps
    return np.where((chose_other & at_pi)[..., None], other, phi)


def true_matrix(phi) -> np.ndarray:
    return Rotation.from_rotvec(np.asarray(phi, np.float64).reshape(-1, 3)).as_matrix().reshape(*phi.shape, 3)


def true_left_jacobian(phi) -> np.ndarray:
    """J_l(phi) = sum of [phi x]^k / (k + 1)!, taken at phi / 16 and doubled: J_l(2 p) = J_l(p) (I + exp(p)) / 2."""
    x, y, z = np.moveaxis(np.asarray(phi, np.longdouble), -1, 0) / 16
    o = np.zeros_like(x)
    G = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*x.shape, 3, 3)
    eye = np.eye(3, dtype=np.longdouble)
    J = np.broadcast_to(eye, G.shape)
    for k in reversed(range(2, 20)):
        J = eye + G @ J / k
    R = eye + G @ J
    for _ in range(4):
        J, R = J @ (eye + R) / 2, R @ R
    return J.astype(np.float64)


@program
def of(phi):
    """All of so3 that is a function of one rotation vector."""
    R, G = so3.exp(phi), so3.hat(phi)
    return {
        "exp": R,
        "log": so3.log(R),
        "J_l": so3.left_jacobian(phi),
        "J_r": so3.right_jacobian(phi),
        "J_l_inv": so3.left_jacobian_inverse(phi),
        "J_r_inv": so3.right_jacobian_inverse(phi),
        "hat": G,
        "vee": so3.vee(G),
    }


def exp(phi) -> np.ndarray:
    return np.asarray(of(phi)["exp"])


EYE = np.broadcast_to(np.eye(3), (N, 3, 3))


@program
def of_two(R, S):
    return so3.log(R), so3.angle_between(R, S)


def log(R) -> np.ndarray:
    return np.asarray(of_two(R, R)[0])


def angle_between(R, S) -> np.ndarray:
    return np.asarray(of_two(R, S)[1])


# Group axioms ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0), rotation_vectors())
def test_closure_a_product_of_rotations_is_a_rotation(dtype, a, b):
    R = exp(a.astype(dtype)) @ exp(b.astype(dtype))
    gram = transposed(R).astype(np.float64) @ R
    close(gram.astype(dtype), EYE, 24)
    close(np.linalg.det(R.astype(np.float64)).astype(dtype), 1.0, 24)
    close(exp(log(R)), R, 16)  # it has a logarithm


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0))
def test_identity_and_inverse(dtype, a):
    a = a.astype(dtype)
    A = exp(a)
    np.testing.assert_array_equal(exp(np.zeros((N, 3), dtype)), EYE)
    np.testing.assert_array_equal(log(EYE.astype(dtype)), np.zeros((N, 3)))
    np.testing.assert_array_equal(exp(-a), transposed(A))
    close(A @ exp(-a), EYE, 16)
    close(exp(-a) @ A, EYE, 16)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors(), rotation_vectors())
def test_associativity(dtype, a, b, c):
    """The two sides differ by the roundings of two three-term dot products each; against scipy, by those of exp too."""
    A, B, C = (exp(v.astype(dtype)) for v in (a, b, c))
    close((A @ B) @ C, A @ (B @ C), 8)
    close((A @ B) @ C, true_matrix(a.astype(dtype)) @ true_matrix(b.astype(dtype)) @ true_matrix(c.astype(dtype)), 24)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), st.floats(-1, 1))
def test_rotations_about_one_axis_add(dtype, a, s):
    """exp(s a) exp((1 - s) a) = exp(a); the parts are vectors of the dtype whose sum is `a` to half an ulp of pi."""
    a = a.astype(dtype)
    part = dtype(s) * a
    close(exp(part) @ exp(a - part), exp(a), 24)


# exp and log ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0))
def test_exp_is_scipys(dtype, a):
    """One ulp of an angle beyond pi moves R by more: the scale grows with it."""
    a = a.astype(dtype)
    close(exp(a), true_matrix(a), 6, np.maximum(1.0, length(a) / np.pi)[..., None])


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_of_exp_at_special_angles(dtype):
    for phi in special_batches().astype(dtype):
        back = of(phi)["log"]
        close(exp(phi), true_matrix(phi), 6)
        close(back, nearest_form(back, phi), 8, length(phi))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors())
def test_log_of_exp(dtype, a):
    a = a.astype(dtype)
    back = of(a)["log"]
    close(back, nearest_form(back, a), 8, length(a))
    assert np.all(length(back) <= np.pi * (1 + 2 * np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(30.0))
def test_exp_of_log(dtype, a):
    """An R rounded to the dtype is a rotation only to an ulp or two."""
    R = true_matrix(a).astype(dtype)
    close(exp(log(R)), R, 8)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_at_exactly_pi_is_either_valid_vector(dtype):
    """R = 2 n n^T - I is symmetric: pi n and -pi n are both right."""
    axes = np.resize(AXES, (N, 3))
    R = (2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)).astype(dtype)
    phi = log(R)
    sign = np.sign(np.sum(phi * axes, axis=-1, keepdims=True))
    close(phi, sign * np.pi * axes, 4, np.pi)
    close(exp(phi), R, 8)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors())
def test_angle_between_is_the_length_of_the_relative_rotation(dtype, a, b):
    a = a.astype(dtype)
    A, B = exp(a), exp(b.astype(dtype))
    relative = A.astype(np.float64) @ transposed(B)
    close(angle_between(A, B), Rotation.from_matrix(relative).magnitude(), 8)
    close(angle_between(A, A), 0.0, 2)  # each component of q (x) q^-1 is a cancelling sum of four products
    t = length(a)[..., 0]
    t = np.minimum(t, 2 * np.pi - t)  # the float32 number nearest to pi is larger than pi
    angle = angle_between(A, EYE.astype(dtype))
    underflows = t < 1e3 * np.sqrt(np.finfo(dtype).tiny)  # the square of an angle below 1e-150, in float32 below 1e-16
    close(angle, np.where(underflows, angle, t), 8, t)
    assert np.all(angle[underflows] <= 2 * t[underflows])


# hat, vee, adjoint ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(plain(3), plain(3))
def test_hat_is_the_cross_product_and_vee_its_inverse(dtype, v, u):
    """hat only copies, and vee halves a doubled number: both exact."""
    v = v.astype(dtype)
    G = np.asarray(of(v)["hat"])
    np.testing.assert_array_equal(G, -transposed(G))
    np.testing.assert_array_equal(transposed(G), np.cross(v[:, None, :], np.eye(3, dtype=dtype)))
    close(G @ u[..., None].astype(dtype), np.cross(v, u.astype(dtype))[..., None], 2, length(v)[..., None] * 2)
    np.testing.assert_array_equal(of(v)["vee"], v)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors())
def test_adjoint(dtype, a, v):
    """R exp(v) R^T = exp(R v). On the left a product of three, on the right R v with the errors of R times pi."""
    a, v = a.astype(dtype), v.astype(dtype)
    R = exp(a)
    close(R @ exp(v) @ transposed(R), exp((R @ v[..., None])[..., 0]), 24 + 16)


# Jacobians ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(5.0))
def test_jacobians_are_their_power_series(dtype, a):
    """Also past pi, up to 5 (the pole of the inverse is at 2 pi, where its own condition grows as the inverse does)."""
    a = a.astype(dtype)
    J = true_left_jacobian(a)
    inverse = np.linalg.inv(J)
    size = np.linalg.norm(inverse, ord=2, axis=(-2, -1))[..., None, None] ** 2
    close(of(a)["J_l"], J, 6)
    close(of(a)["J_l_inv"], inverse, 6, size)
    np.testing.assert_array_equal(of(a)["J_r"], of(-a)["J_l"])
    np.testing.assert_array_equal(of(a)["J_r_inv"], of(-a)["J_l_inv"])


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(5.0))
def test_jacobians_left_right_and_inverse(dtype, a):
    """J_r = J_l^T; exp(a) J_r = J_l; J_l a = a; J J^-1 = I, in three-term products of entries of the inverse's size."""
    a = a.astype(dtype)
    J = {k: np.asarray(v) for k, v in of(a).items()}
    np.testing.assert_array_equal(J["J_r"], transposed(J["J_l"]))
    close(J["exp"] @ J["J_r"], J["J_l"], 16)
    close((J["J_l"] @ a[..., None])[..., 0], a, 8, length(a))
    size = np.linalg.norm(J["J_l_inv"].astype(np.float64), ord=2, axis=(-2, -1))[..., None, None] ** 2
    close(J["J_l"] @ J["J_l_inv"], EYE, 12, size)
    close(J["J_r_inv"] @ J["J_r"], EYE, 12, size)


@pytest.mark.parametrize("dtype", DTYPES)
def test_jacobians_at_special_angles(dtype):
    for phi in special_batches().astype(dtype):
        J = true_left_jacobian(phi)
        computed = of(phi)
        assert {v.dtype for v in computed.values()} == {np.dtype(dtype)}
        close(computed["J_l"], J, 6)
        close(computed["J_r"], transposed(J), 6)
        close(computed["J_l_inv"], np.linalg.inv(J), 6)
        close(computed["J_r_inv"], transposed(np.linalg.inv(J)), 6)


# Derivatives ----------------------------------------------------------------------------------------------------------


def _moved(A, phi, B, d):
    """The functions of so3 at phi + d, and a map whose derivatives at d = 0 are the Jacobians, each by its A and B."""
    p = phi + d
    R = so3.exp(p)
    return {"log": so3.log(A @ R @ B), "exp": R, "J_l": so3.left_jacobian(p), "J_l_inv": so3.left_jacobian_inverse(p)}


# Derivatives are checked compiled without optimisation: that takes a third of the time, and is the harder test, because
# comparisons are then evaluated more than once and rounded differently (from_matrix must not mix two columns).
plain_jit = partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
)


@plain_jit
def forward(A, phi, B, direction):
    """Derivatives at d = 0 in one direction."""
    return jax.jvp(lambda d: _moved(A, phi, B, d), (jnp.zeros_like(phi),), (direction,))[1]


@plain_jit
def reverse(A, phi, B, weights):
    """Gradient at d = 0 of the weighted sum of all outputs."""
    return jax.vjp(lambda d: _moved(A, phi, B, d), jnp.zeros_like(phi))[1](weights)[0]


@plain_jit
def second(phi, weights, direction):
    """Derivative, in one direction, of the gradient of the weighted sum of log(exp(phi))."""

    def gradient(p):
        return jax.vjp(lambda x: so3.log(so3.exp(x)), p)[1](weights)[0]

    return jax.jvp(gradient, (phi,), (direction,))[1]


def unit(k: int, dtype) -> np.ndarray:
    return np.broadcast_to(np.eye(3, dtype=dtype)[k], (N, 3))


def jacobians(A, phi, B) -> dict[str, np.ndarray]:
    """Forward derivatives of all outputs, the direction on the last axis."""
    columns = [forward(A, phi, B, unit(k, phi.dtype)) for k in range(3)]
    return {name: np.stack([c[name] for c in columns], axis=-1) for name in columns[0]}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angles", [TINY, SMALL, GENERIC, NEAR_PI], ids=["tiny", "small", "generic", "near pi"])
def test_jacobians_are_the_derivatives_of_exp_and_log(angles, dtype):
    """d log(exp(phi + d) exp(phi)^-1) = J_l(phi) d, and the like; forward and reverse. At pi log has two branches, and
    its derivative is the inverse Jacobian at the vector that it returned."""
    eye, zero = EYE.astype(dtype), np.zeros((N, 3), dtype)
    for phi in special_batches(angles).astype(dtype):
        at = {k: np.asarray(v) for k, v in of(phi).items()}
        taken = {k: np.asarray(v) for k, v in of(at["log"]).items()}
        R, R_inv = at["exp"], transposed(at["exp"])
        laws = [
            (eye, phi, R_inv, at["J_l"]),  # log(exp(phi + d) exp(phi)^-1)
            (R_inv, phi, eye, at["J_r"]),  # log(exp(phi)^-1 exp(phi + d))
            (eye, zero, R, taken["J_l_inv"]),  # log(exp(d) exp(phi))
            (R, zero, eye, taken["J_r_inv"]),  # log(exp(phi) exp(d))
            (eye, phi, eye, taken["J_l_inv"] @ at["J_l"]),  # log(exp(phi + d)): I where log returned phi
        ]
        for A, p, B, law in laws:
            rows = [reverse(A, p, B, only("log", unit(k, dtype))) for k in range(3)]
            close(jacobians(A, p, B)["log"], law, 24)
            close(np.stack(rows, axis=-2), law, 24)


def only(name: str, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Weights for `reverse`, zero for every output but one."""
    dtype = weights.dtype
    rest = {n: np.zeros((N, 3, 3), dtype) for n in ("exp", "J_l", "J_l_inv")} | {"log": np.zeros((N, 3), dtype)}
    return rest | {name: weights}


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_exp_and_of_the_jacobians_forward_and_reverse(dtype):
    """d exp = [J_l d x] exp; and <W, J e_k> = (J^T W)_k for exp, J_l, J_l^-1, with weights of up to 1 on 9 entries."""
    eye = EYE.astype(dtype)
    weights = np.broadcast_to(np.cos(np.arange(9.0)).reshape(3, 3), (N, 3, 3)).astype(dtype)
    for phi in special_batches().astype(dtype):
        at, D = of(phi), jacobians(eye, phi, eye)
        for k in range(3):
            turn = np.cross(np.asarray(at["J_l"])[:, None, :, k], transposed(at["exp"]))
            close(D["exp"][..., k], transposed(turn), 24)
        for name in ("exp", "J_l", "J_l_inv"):
            gradient = reverse(eye, phi, eye, only(name, weights))
            assert D[name].dtype == gradient.dtype == dtype
            close(gradient, np.einsum("nij,nijk->nk", weights.astype(np.float64), D[name]), 24)


@pytest.mark.parametrize("dtype", DTYPES)
def test_first_derivatives_at_zero_are_those_of_the_power_series(dtype):
    """exp = I + G + .., J_l = I + G / 2 + .., J_l^-1 = I - G / 2 + .., G = [phi x]; log(exp(phi)) = phi: to the bit."""
    eye = EYE.astype(dtype)
    G = -np.cross(np.eye(3)[:, None, :], np.eye(3)[None, :, :])  # G[i, j, k] = -epsilon_ijk, so that G e_k = hat(e_k)
    for phi in special_batches(TINY[:-1]).astype(dtype):
        D = jacobians(eye, phi, eye)
        for name, expected in {"exp": G, "J_l": G / 2, "J_l_inv": -G / 2, "log": np.eye(3)}.items():
            close(D[name], np.broadcast_to(expected, D[name].shape), 0.25)


@pytest.mark.parametrize("dtype", DTYPES)
def test_second_derivative_of_log_of_exp_vanishes(dtype):
    """log(exp(phi)) = phi, so its Hessian is 0, at 0 and near pi too; at pi, whichever vector log returns, finite."""
    for phi in special_batches().astype(dtype):
        at_pi = np.abs(length(phi) - np.pi) < 8 * np.finfo(dtype).eps
        for i, j in np.ndindex(3, 3):
            H = second(phi, unit(i, dtype), unit(j, dtype))
            assert H.dtype == dtype
            assert np.all(np.isfinite(H))
            close(np.where(at_pi, dtype(0), H), 0.0, 24)


# Batches and transformations ------------------------------------------------------------------------------------------

GRID = special_batches([1e-8, 0.3, 2.0, np.pi - 1e-3])[0, :10].reshape(2, 5, 3)


def test_batch_axes_agree_with_a_loop():
    """The compiler may contract or vectorise each program differently: a few ulps, not bits."""
    run = plain_jit(of.__wrapped__)
    batched = run(GRID)
    for i, j in np.ndindex(2, 5):
        for name, one in run(GRID[i, j]).items():
            assert batched[name].shape == (2, 5, *one.shape)
            close(batched[name][i, j], one, 4)


def test_vmap_and_grad_agree_with_batches():
    phi, eye, weights = special_batches(GENERIC)[0], EYE.astype(float), unit(1, np.float64)
    single = jax.value_and_grad(lambda p: so3.log(so3.exp(p))[1])
    value, gradient = plain_jit(jax.vmap(single))(phi)
    close(value, of(phi)["log"][:, 1], 4, length(phi)[:, 0])
    close(gradient, reverse(eye, phi, eye, only("log", weights)), 24)
    close(gradient, weights, 24)


def test_without_jit_too():
    phi = special_batches(GENERIC)[0]
    R = so3.exp(jnp.asarray(phi))
    close(R, exp(phi), 4)
    close(so3.log(R), of(phi)["log"], 4)
