"""Laws of SO(3): group, exp and log, Jacobians, derivatives - in float64 and float32, at 0, near pi and at pi.

Tolerances are in ulps: eps of the dtype, times the size of what is compared. Reasoned factors:
- an entry of exp(phi) is a sum of three terms, each of a few rounded factors, and the angle itself carries the rounding
  of phi . phi (an ulp of an angle of up to pi moves R by up to pi eps): 8 for one R;
- a product of two rotations adds a dot product of three terms (3) and both factors' errors: 16, for three factors 24;
- log undoes exp: the errors of R, of the normalised quaternion and of an arc tangent, all relative to the angle: 16.
  Relative, at every angle down to 1e-300: the small parts of R are kept, so nothing is lost near the identity;
- a derivative by automatic differentiation of such a chain passes through the same operations about twice: 48.
"""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.backend import jax, jnp
from helmstar.geometry import so3

DTYPES = [np.float64, np.float32]
N = 16  # every batch has this length, so that each function compiles once for each dtype
LAW = settings(deadline=None, derandomize=True, max_examples=40)

SMALL = [0.0, 1e-300, 1e-160, 1e-37, 1e-30, 1e-19, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3]
GENERIC = [0.1, 0.4999999, 0.5000001, 0.9999999, 1.0000001, 1.5, 2.0, 2.5, 3.0]  # series thresholds: 0.5 and 1
NEAR_PI = [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi - 1e-12, np.pi - 1e-15, np.pi]
ANGLES = [*SMALL, *GENERIC, *NEAR_PI]
AXES = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [1, 1, 1], [-0.3, 0.8, 0.52], [1e-9, 1, 0], [0.7, -1e-5, 0.7]])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


def vectors(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Angles about axes of any length, a zero one standing for x."""
    largest = np.max(np.abs(axes), axis=-1, keepdims=True)
    axes = np.where(largest < 1e-3, [1.0, 0.0, 0.0], axes)
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True) * angles[..., None]


def special_batches(angles=ANGLES) -> np.ndarray:
    """Each of the angles about each of AXES, in batches (k, N, 3), the last one filled up."""
    phi = vectors(np.repeat(AXES, len(angles), axis=0), np.tile(angles, len(AXES)))
    return np.resize(phi, (-(-len(phi) // N), N, 3))


def rotation_vectors(largest: float = np.pi):
    """(N, 3): directions anywhere, angles from the special ones and from [0, largest]."""
    axes = hnp.arrays(np.float64, (N, 3), elements=st.floats(-1, 1), fill=st.nothing())
    one = st.one_of(st.sampled_from(ANGLES), st.floats(0, largest))
    return st.builds(vectors, axes, hnp.arrays(np.float64, (N,), elements=one, fill=st.nothing()))


PLAIN_VECTORS = hnp.arrays(np.float64, (N, 3), elements=st.floats(-2, 2), fill=st.nothing())


def error_in_ulps(actual, expected, scale=1.0) -> float:
    """Largest |actual - expected| over eps of actual's dtype times scale; a NaN is infinitely wrong."""
    actual = np.asarray(actual)
    e = np.abs(actual.astype(np.float64) - np.asarray(expected, np.float64))
    e = e / (np.finfo(actual.dtype).eps * np.asarray(scale, np.float64))
    return float(np.max(np.where(np.isnan(e), np.inf, e), initial=0.0))


def close(actual, expected, ulps: float, scale=1.0) -> None:
    e = error_in_ulps(actual, expected, scale)
    assert e <= ulps, f"{e:.2f} ulps, {ulps} allowed"


def transposed(A):
    return np.swapaxes(np.asarray(A), -1, -2)


def length(v) -> np.ndarray:
    """|v| in float64, without underflow, and 1 where v = 0, to divide by."""
    v = np.asarray(v, np.float64)
    m = np.max(np.abs(v), axis=-1, keepdims=True)
    m = np.where(m == 0, 1.0, m)
    n = m * np.linalg.norm(v / m, axis=-1, keepdims=True)
    return np.where(n == 0, 1.0, n)


def other_vector(phi) -> np.ndarray:
    """The rotation vector of the same rotation, turned the other way round."""
    n = length(phi)
    return phi - 2 * np.pi * np.asarray(phi, np.float64) / n


def nearest_form(actual, phi):
    """phi, or near pi the other vector of the same rotation where `actual` chose that one."""
    phi = np.asarray(phi, np.float64)
    other = other_vector(phi)
    chose_other = np.linalg.norm(actual - other, axis=-1) < np.linalg.norm(actual - phi, axis=-1)
    near_pi = np.abs(length(phi)[..., 0] - np.pi) < 8 * np.finfo(np.asarray(actual).dtype).eps
    return np.where((chose_other & near_pi)[..., None], other, phi)


def true_matrix(phi) -> np.ndarray:
    return Rotation.from_rotvec(np.asarray(phi, np.float64).reshape(-1, 3)).as_matrix().reshape(*phi.shape[:-1], 3, 3)


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


def true_left_jacobian(phi) -> np.ndarray:
    """J_l(phi) = integral over s from 0 to 1 of exp(s phi), by 20 Gauss points (exact to 1e-20 up to an angle of 6)."""
    s = 0.5 * (_NODES + 1.0)
    R = true_matrix(s[:, None, None] * np.asarray(phi, np.float64))
    return np.einsum("k,k...->...", 0.5 * _WEIGHTS, R)


exp = jax.jit(so3.exp)
log = jax.jit(so3.log)
log_exp = jax.jit(lambda phi: so3.log(so3.exp(phi)))
product = jax.jit(lambda A, B: A @ B)
J_l, J_r = jax.jit(so3.left_jacobian), jax.jit(so3.right_jacobian)
J_l_inv, J_r_inv = jax.jit(so3.left_jacobian_inverse), jax.jit(so3.right_jacobian_inverse)


# Group axioms ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0), rotation_vectors())
def test_closure_a_product_of_rotations_is_a_rotation(dtype, a, b):
    R = np.asarray(product(exp(a.astype(dtype)), exp(b.astype(dtype))))
    assert R.dtype == dtype
    close(R, R.astype(np.float64), 0)  # finite
    gram = transposed(R).astype(np.float64) @ R
    close(gram.astype(dtype), np.eye(3), 24)
    close(np.linalg.det(R.astype(np.float64)).astype(dtype), 1.0, 36)
    close(exp(log(R)), R, 24)  # and has a logarithm


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors())
def test_identity(dtype, a):
    zero = np.zeros((N, 3), dtype)
    eye = np.broadcast_to(np.eye(3, dtype=dtype), (N, 3, 3))
    np.testing.assert_array_equal(exp(zero), eye)
    np.testing.assert_array_equal(log(eye), zero)
    A = exp(a.astype(dtype))
    np.testing.assert_array_equal(product(A, eye), A)
    np.testing.assert_array_equal(product(eye, A), A)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0))
def test_inverse_is_transpose_is_exp_of_minus(dtype, a):
    a = a.astype(dtype)
    A = exp(a)
    np.testing.assert_array_equal(exp(-a), transposed(A))
    close(product(A, exp(-a)), np.eye(3), 16)
    close(product(exp(-a), A), np.eye(3), 16)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors(), rotation_vectors())
def test_associativity(dtype, a, b, c):
    A, B, C = (exp(v.astype(dtype)) for v in (a, b, c))
    left = product(product(A, B), C)
    close(left, product(A, product(B, C)), 8)  # two dot products of three terms on each side
    close(left, true_matrix(a.astype(dtype)) @ true_matrix(b.astype(dtype)) @ true_matrix(c.astype(dtype)), 24)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), st.floats(-1, 1))
def test_rotations_about_one_axis_add(dtype, a, s):
    """exp(s a) exp((1 - s) a) = exp(a), where the sum of the parts is rounded once: pi eps / 2."""
    a = a.astype(dtype)
    part = (dtype(s) * a).astype(dtype)
    close(product(exp(part), exp(a - part)), exp(a), 24)


# exp and log ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(10.0))
def test_exp_is_scipys(dtype, a):
    """One ulp of an angle of 10 moves R by 10 eps: the factor grows with the angle beyond 1."""
    a = a.astype(dtype)
    close(exp(a), true_matrix(a), 8, np.maximum(1.0, length(a) / np.pi)[..., None])


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_of_exp_at_special_angles(dtype):
    for phi in special_batches().astype(dtype):
        back = log_exp(phi)
        assert back.dtype == dtype
        close(exp(phi), true_matrix(phi), 8)
        close(back, nearest_form(back, phi), 16, length(phi))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors())
def test_log_of_exp(dtype, a):
    a = a.astype(dtype)
    back = log(exp(a))
    close(back, nearest_form(back, a), 16, length(a))
    assert np.all(length(np.asarray(back))[..., 0] <= np.pi * (1 + 4 * np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(30.0))
def test_exp_of_log(dtype, a):
    """R rounded to the dtype need not be a rotation to better than an ulp or two an entry: 16."""
    R = true_matrix(a).astype(dtype)
    close(exp(log(R)), R, 16)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_at_exactly_pi_is_either_valid_vector(dtype):
    """R = 2 n n^T - I is symmetric: pi n and -pi n are both right."""
    axes = np.resize(AXES, (N, 3))
    R = (2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)).astype(dtype)
    phi = np.asarray(log(R))
    sign = np.sign(np.sum(phi * axes, axis=-1, keepdims=True))
    close(phi, sign * np.pi * axes, 8, np.pi)
    close(exp(phi), R, 16)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors())
def test_angle_between_is_the_length_of_the_relative_log(dtype, a, b):
    A, B = exp(a.astype(dtype)), exp(b.astype(dtype))
    angle = angle_between(A, B)
    assert angle.dtype == dtype
    R = np.asarray(A, np.float64) @ transposed(B).astype(np.float64)
    close(angle, Rotation.from_matrix(R).magnitude(), 16)
    close(angle_between(A, A), 0.0, 0)
    close(angle_between(A, np.broadcast_to(np.eye(3, dtype=dtype), (N, 3, 3))), Rotation.from_matrix(A).magnitude(), 16)


angle_between = jax.jit(so3.angle_between)


# hat, vee, adjoint ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(PLAIN_VECTORS, PLAIN_VECTORS)
def test_hat_is_the_cross_product_and_vee_its_inverse(dtype, v, u):
    v, u = v.astype(dtype), u.astype(dtype)
    H = np.asarray(hat(v))
    assert H.dtype == dtype
    np.testing.assert_array_equal(H, -transposed(H))
    np.testing.assert_array_equal(vee(H), v)
    cross = np.cross(v.astype(np.float64), u.astype(np.float64))
    close(np.einsum("nij,nj->ni", H, u), cross, 2, length(v) * length(u))


hat, vee = jax.jit(so3.hat), jax.jit(so3.vee)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), rotation_vectors())
def test_adjoint(dtype, a, v):
    """R exp(v) R^T = exp(R v); R v carries the rounding of R times |v| <= pi."""
    a, v = a.astype(dtype), v.astype(dtype)
    R = exp(a)
    turned = product(R, v[..., None])[..., 0]
    close(product(product(R, exp(v)), transposed(R)), exp(turned), 40)


# Jacobians ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(5.0))
def test_left_jacobian_is_the_mean_of_exp_along_the_path(dtype, a):
    a = a.astype(dtype)
    close(J_l(a), true_left_jacobian(a), 8)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(5.0))
def test_jacobians_of_both_sides(dtype, a):
    a = a.astype(dtype)
    np.testing.assert_array_equal(J_r(a), J_l(-a))
    np.testing.assert_array_equal(J_r(a), transposed(J_l(a)))
    np.testing.assert_array_equal(J_r_inv(a), J_l_inv(-a))
    close(product(exp(a), J_r(a)), J_l(a), 24)
    close(product(J_l(a), a[..., None])[..., 0], a, 12, length(a))  # phi is its own eigenvector


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(5.0))
def test_jacobian_times_its_inverse(dtype, a):
    """The inverse grows as 1 / (2 pi - t); up to t = 5 its size (4) and its own condition (the argument's ulp moves it
    by t / (2 pi - t)) make a factor of 16 on three-term products. Up to pi none is needed."""
    a = a.astype(dtype)
    t = length(a)[..., None]
    scale = np.where(t > np.pi, (2 * np.pi / (2 * np.pi - t)) ** 2, 1.0)
    close(product(J_l(a), J_l_inv(a)), np.eye(3), 20, scale)
    close(product(J_r_inv(a), J_r(a)), np.eye(3), 20, scale)


@pytest.mark.parametrize("dtype", DTYPES)
def test_jacobians_at_special_angles(dtype):
    for phi in special_batches().astype(dtype):
        J = true_left_jacobian(phi)
        assert J_l(phi).dtype == J_r(phi).dtype == J_l_inv(phi).dtype == J_r_inv(phi).dtype == dtype
        close(J_l(phi), J, 8)
        close(J_r(phi), transposed(J), 8)
        close(J_l_inv(phi), np.linalg.inv(J), 12)
        close(J_r_inv(phi), transposed(np.linalg.inv(J)), 12)


def _moved_left(phi):
    """d -> log(exp(phi + d) exp(phi)^-1), whose derivative at 0 is J_l(phi)."""
    return lambda d: so3.log(so3.exp(phi + d) @ so3.exp(phi).T)


def _moved_right(phi):
    return lambda d: so3.log(so3.exp(phi).T @ so3.exp(phi + d))


def _log_left(phi):
    """d -> log(exp(d) exp(phi)), whose derivative at 0 is J_l(phi)^-1."""
    return lambda d: so3.log(so3.exp(d) @ so3.exp(phi))


def _log_right(phi):
    return lambda d: so3.log(so3.exp(phi) @ so3.exp(d))


@jax.jit
@jax.vmap
def derivatives(phi):
    """Each of the four maps above, its derivative at 0 forward and reverse."""
    zero = jnp.zeros_like(phi)
    maps = [f(phi) for f in (_moved_left, _moved_right, _log_left, _log_right)]
    return [(jax.jacfwd(f)(zero), jax.jacrev(f)(zero)) for f in maps]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angles", [SMALL, GENERIC, NEAR_PI], ids=["small", "generic", "near pi"])
def test_jacobians_are_the_derivatives_of_exp_and_log(angles, dtype):
    """At pi, log has two branches: its derivative is the inverse Jacobian at the vector that log returned."""
    for phi in special_batches(angles).astype(dtype):
        taken = log_exp(phi)
        laws = [J_l(phi), J_r(phi), J_l_inv(taken), J_r_inv(taken)]
        for (forward, reverse), J in zip(derivatives(phi), laws, strict=True):
            assert forward.dtype == reverse.dtype == dtype
            close(forward, J, 48)
            close(reverse, J, 48)


# Derivatives at 0 and at pi -------------------------------------------------------------------------------------------


def _along(phi):
    """Value and gradient of everything in so3 that is a function of a rotation vector, log of exp included."""
    return so3.log(so3.exp(phi)), so3.exp(phi), so3.left_jacobian(phi), so3.left_jacobian_inverse(phi)


along = jax.jit(_along)
along_forward = jax.jit(jax.vmap(jax.jacfwd(_along)))
along_reverse = jax.jit(jax.vmap(jax.jacrev(_along)))
along_second = jax.jit(jax.vmap(jax.hessian(_along)))


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_finite_and_agree_forward_and_reverse(dtype):
    for phi in special_batches().astype(dtype):
        for forward, reverse in zip(along_forward(phi), along_reverse(phi), strict=True):
            assert forward.dtype == reverse.dtype == dtype
            close(forward, reverse, 48)
        close(along_forward(phi)[0], np.eye(3), 48)  # d log(exp(phi)) / d phi, at pi too


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_at_zero_are_those_of_the_power_series(dtype):
    """exp = I + G + G^2 / 2, J_l = I + G / 2 + G^2 / 6, J_l^-1 = I - G / 2 + G^2 / 12, G = [phi x]; log(exp) = phi."""
    G = np.stack([np.asarray(so3.hat(e)) for e in np.eye(3)])
    first = np.moveaxis(G, 0, -1)
    second = np.moveaxis(np.einsum("aij,bjk->abik", G, G) + np.einsum("bij,ajk->abik", G, G), (0, 1), (-2, -1))
    expected = [
        (np.eye(3), np.zeros((3, 3, 3))),
        (first, second / 2),
        (first / 2, second / 6),
        (-first / 2, second / 12),
    ]
    tiny = [0.0, 1e-300, 1e-160, 1e-37, 1e-30, 1e-19]
    for phi in special_batches(tiny).astype(dtype):
        for forward, reverse, hessian, (d1, d2) in zip(
            along_forward(phi), along_reverse(phi), along_second(phi), expected, strict=True
        ):
            close(forward, d1, 1)
            close(reverse, d1, 1)
            close(hessian, d2, 1)


@pytest.mark.parametrize("dtype", DTYPES)
def test_second_derivatives_are_finite_everywhere(dtype):
    for phi in special_batches().astype(dtype):
        for hessian in along_second(phi):
            assert hessian.dtype == dtype
            assert np.all(np.isfinite(hessian))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", [0.0, 1.0, np.pi - 1e-9, np.pi])
def test_log_of_a_product_to_second_order(angle, dtype):
    """Baker, Campbell and Hausdorff about R: log(R^T exp(a) R exp(b)) has a mixed second derivative R^T e_i x e_j / 2."""
    R = so3.exp(jnp.asarray(angle * AXES[4], dtype))
    mixed = np.asarray(mixed_second(R))
    assert mixed.dtype == dtype
    turned = np.asarray(R, np.float64)  # row i is R^T e_i
    expected = 0.5 * np.cross(turned[:, None, :], np.eye(3)[None, :, :])
    close(mixed, np.moveaxis(expected, -1, 0), 48)


@jax.jit
def mixed_second(R):
    zero = jnp.zeros(3, R.dtype)
    f = lambda a, b: so3.log(R.T @ so3.exp(a) @ R @ so3.exp(b))
    return jax.jacfwd(jax.jacrev(f, argnums=0), argnums=1)(zero, zero)


# Batches and transformations ------------------------------------------------------------------------------------------


def _everything(phi):
    R = so3.exp(phi)
    return {
        "exp": R,
        "log": so3.log(R),
        "angle": so3.angle_between(R, jnp.eye(3, dtype=phi.dtype)),
        "J_l": so3.left_jacobian(phi),
        "J_r": so3.right_jacobian(phi),
        "J_l_inv": so3.left_jacobian_inverse(phi),
        "J_r_inv": so3.right_jacobian_inverse(phi),
        "vee": so3.vee(so3.hat(phi)),
    }


def _loss(phi):
    """A number that depends on everything, for gradients."""
    return sum(jnp.sum(jnp.sin(v + 0.3)) for v in _everything(phi).values())


everything = jax.jit(_everything)
mapped = jax.jit(jax.vmap(jax.vmap(_everything)))
gradient = jax.jit(jax.grad(_loss))
mapped_gradient = jax.jit(jax.vmap(jax.vmap(jax.grad(_loss))))

SHAPES = {"exp": (3, 3), "log": (3,), "angle": (), "vee": (3,)}


@pytest.mark.parametrize("dtype", DTYPES)
def test_batch_axes_jit_and_vmap_agree_with_a_loop(dtype):
    """The compiler may contract or vectorise each program differently: a few ulps, not bits."""
    phi = special_batches([1e-8, 0.3, 2.0, np.pi - 1e-3])[0, :10].reshape(2, 5, 3).astype(dtype)
    loop = [[everything(phi[i, j]) for j in range(5)] for i in range(2)]
    grads = np.array([[gradient(phi[i, j]) for j in range(5)] for i in range(2)])
    batched, vmapped = everything(phi), mapped(phi)
    for name, value in batched.items():
        assert value.dtype == vmapped[name].dtype == dtype
        assert value.shape == (2, 5, *SHAPES.get(name, (3, 3)))
        one_by_one = np.array([[loop[i][j][name] for j in range(5)] for i in range(2)])
        close(value, one_by_one, 8)
        close(vmapped[name], one_by_one, 8)
    close(gradient(phi), grads, 96, 10.0)  # sums of some fifty terms of size 1
    close(mapped_gradient(phi), grads, 96, 10.0)


def test_without_jit_too():
    phi = special_batches([1e-8, 0.3, 2.0, np.pi - 1e-3])[0, :10].reshape(2, 5, 3)
    for name, value in _everything(jnp.asarray(phi)).items():
        close(value, everything(phi)[name], 8)
