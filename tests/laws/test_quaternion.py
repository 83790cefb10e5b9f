"""Laws of unit quaternions: the order and action of scipy's Rotation, double cover, signs, angles, rates.

Tolerances are in ulps: eps of the dtype, times the size of what is compared (1 unless a scale is given). Inputs are of
unit length to half an ulp a component only, which by itself moves an angle by 2 eps. The factors:

- a component of a product is a sum of four products of numbers of size 1: 4;
- a matrix entry is a sum of products doubled, of a vector's one as well: 8; the same for rotate, times |v|;
- from_matrix undoes to_matrix and normalises: 6;
- exp and log: one function of the angle, relative to the angle at every size of it: 6.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.backend import COMPILER_OPTIONS, jax, jnp
from helmstar.geometry import quaternion

DTYPES = [np.float64, np.float32]
N = 16  # every batch has this length, so that each program compiles once for each dtype
program = partial(jax.jit, compiler_options=COMPILER_OPTIONS)
LAW = settings(deadline=None, derandomize=True, max_examples=30)

ANGLES = [0.0, 1e-300, 1e-160, 1e-37, 1e-30, 1e-19, 1e-12, 1e-8, 1e-5, 1e-3]
ANGLES += [0.1993, 0.3, 0.9999999, 1.0000001, 2.0, 3.0]  # the series end at 0.1993 and at 1
ANGLES += [np.pi - 1e-3, np.pi - 1e-9, np.pi - 1e-15, np.pi]
AXES = [[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, -1], [1, 1, 1], [0.7, -1e-5, 0.7], [-0.3, 0.8, 0.52], [1e-9, 1, 0]]
AXES = np.array(AXES) / np.linalg.norm(AXES, axis=1, keepdims=True)


def vectors(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Angles about axes of any length but zero."""
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True) * angles[..., None]


def special_batches() -> np.ndarray:
    """Each of ANGLES about each of AXES, in batches (k, N, 3), the last one filled up."""
    phi = vectors(np.repeat(AXES, len(ANGLES), axis=0), np.tile(ANGLES, len(AXES)))
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


def unit_quaternions():
    """(N, 4), both signs: rotations by up to 2 pi."""
    return rotation_vectors(2 * np.pi).map(lambda phi: true_exp(phi) / length(true_exp(phi)))


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


def length(v) -> np.ndarray:
    """|v|, shape (..., 1), in float64 and without underflow."""
    v = np.asarray(v, np.float64)
    largest = np.max(np.abs(v), axis=-1, keepdims=True)
    return largest * np.linalg.norm(v / np.where(largest == 0.0, 1.0, largest), axis=-1, keepdims=True)


def true_exp(phi) -> np.ndarray:
    """[sin(t/2) n, cos(t/2)] in float64, relative in its vector part at every angle."""
    phi = np.asarray(phi, np.float64)
    t = length(phi)
    return np.concatenate([phi * 0.5 * np.sinc(0.5 * t / np.pi), np.cos(0.5 * t)], axis=-1)


def scipy(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q, np.float64))


def up_to_sign(actual, expected) -> np.ndarray:
    """`expected` or its negative, whichever is on the side of `actual`."""
    dot = np.sum(np.asarray(actual, np.float64) * expected, axis=-1, keepdims=True)
    return np.where(dot < 0.0, -expected, expected)


@program
def of_one(q, v):
    return {
        "exp": quaternion.exp(v),
        "log": quaternion.log(q),
        "normalise": quaternion.normalise(q),
        "conjugate": quaternion.conjugate(q),
        "matrix": quaternion.to_matrix(q),
        "from_matrix": quaternion.from_matrix(quaternion.to_matrix(q)),
        "rotate": quaternion.rotate(q, v),
        "rate": quaternion.rate_matrix(q),
    }


@program
def of_two(p, q):
    return {
        "product": quaternion.multiply(p, q),
        "aligned": quaternion.align_sign(p, q),
        "angle": quaternion.angle_between(p, q),
    }


from_matrix = program(quaternion.from_matrix)


def exp(phi):
    return of_one(np.ones((N, 4), phi.dtype), phi)["exp"]


def log(q):
    return of_one(q, q[..., :3])["log"]


def normalise(q):
    return of_one(q, q[..., :3])["normalise"]


def multiply(p, q):
    return of_two(p, q)["product"]


# Compiled without optimisation: what is tested is not arithmetic to the bit, and it takes a third of the time.
plain_jit = partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
)


# Order and action -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), plain(3))
def test_action_of_one_is_scipys(dtype, q, v):
    q, v = q.astype(dtype), v.astype(dtype)
    R = scipy(q)
    computed = of_one(q, v)
    assert {c.dtype for c in computed.values()} == {np.dtype(dtype)}
    close(computed["matrix"], R.as_matrix(), 8)
    close(computed["rotate"], R.apply(v.astype(np.float64)), 8, length(v))
    close(computed["from_matrix"], up_to_sign(computed["from_matrix"], scipy(q).as_quat()), 6)
    close(scipy(computed["conjugate"]).as_matrix().astype(dtype), R.inv().as_matrix(), 1)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), unit_quaternions())
def test_product_is_scipys_in_value_and_sign(dtype, p, q):
    """scipy's own product keeps the sign, so the components agree, and not only the rotations."""
    p, q = p.astype(dtype), q.astype(dtype)
    product = multiply(p, q)
    assert product.dtype == dtype
    close(product, (scipy(p) * scipy(q)).as_quat(), 4)
    close(scipy(product).as_matrix().astype(dtype), scipy(p).as_matrix() @ scipy(q).as_matrix(), 12)


def test_basis_products_are_hamiltons_with_the_scalar_last():
    """i j = k, j k = i, k i = j, i i = -1: exactly, in every position of the array."""
    i, j, k, one = np.eye(4)
    left = np.resize([i, j, k, i, j, k, i, one], (N, 4))
    right = np.resize([j, k, i, i, j, k, one, k], (N, 4))
    expected = np.resize([k, i, j, -one, -one, -one, i, k], (N, 4))
    np.testing.assert_array_equal(multiply(left, right), expected)
    np.testing.assert_array_equal(quaternion.identity(), one)
    assert quaternion.identity(jnp.float32).dtype == jnp.float32
    v = np.resize([0.0, 1.0, 0.0], (N, 3))
    quarter_turn_about_z = np.resize([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], (N, 4))
    close(of_one(quarter_turn_about_z, v)["rotate"], np.resize([-1.0, 0.0, 0.0], (N, 3)), 2)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), unit_quaternions(), unit_quaternions())
def test_group_axioms(dtype, p, q, r):
    p, q, r = p.astype(dtype), q.astype(dtype), r.astype(dtype)
    one = np.resize(np.array([0, 0, 0, 1], dtype), (N, 4))
    close(multiply(q, one), q, 0)
    close(multiply(one, q), q, 0)
    close(multiply(q, of_one(q, q[:, :3])["conjugate"]), one, 4)
    close(multiply(multiply(p, q), r), multiply(p, multiply(q, r)), 12)
    close(length(multiply(p, q)).astype(dtype), 1.0, 6)


# Matrices -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(2 * np.pi))
def test_from_matrix_is_scipys(dtype, phi):
    R = Rotation.from_rotvec(phi)
    q = from_matrix(R.as_matrix().astype(dtype))
    assert q.dtype == dtype
    close(q, up_to_sign(q, R.as_quat()), 6)
    close(length(q).astype(dtype), 1.0, 2)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(1.0).map(lambda v: v + 1e-6))
def test_from_matrix_of_half_turns(dtype, axes):
    """R = 2 n n^T - I about random axes; and about the special ones, exact where n is along an axis."""
    for n in (vectors(axes, np.ones(N)), np.resize(AXES, (N, 3))):
        R = (2 * n[:, :, None] * n[:, None, :] - np.eye(3)).astype(dtype)
        q = from_matrix(R)
        expected = np.concatenate([n, np.zeros((N, 1))], axis=-1)
        close(q, up_to_sign(q, expected), 6)
    np.testing.assert_array_equal(np.abs(np.asarray(q))[:3], np.abs(expected)[:3])


# exp and log ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(6.0))
def test_exp_is_scipys(dtype, phi):
    """Components to 6 ulps of 1, the vector part to 6 of the angle; beyond 2 the angle's own ulps count."""
    phi = phi.astype(dtype)
    q = exp(phi)
    assert q.dtype == dtype
    close(q, Rotation.from_rotvec(phi.astype(np.float64)).as_quat(), 6)
    close(q[:, :3], true_exp(phi)[:, :3], 6, length(phi))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions())
def test_log_is_scipys_and_the_same_for_both_signs(dtype, q):
    """At pi either vector is right; there the two signs may give the two."""
    q = q.astype(dtype)
    phi = log(q)
    assert phi.dtype == dtype
    expected = scipy(q).as_rotvec()
    at_pi = np.abs(q[:, 3:]) < 4 * np.finfo(dtype).eps
    close(phi, np.where(at_pi, up_to_sign(phi, expected), expected), 6, np.pi)
    close(np.where(at_pi, dtype(0), log(-q)), np.where(at_pi, 0.0, phi), 0)
    assert np.all(length(phi) <= np.pi * (1 + 2 * np.finfo(dtype).eps))
    back = exp(phi)
    close(back, up_to_sign(back, scipy(q).as_quat()), 8)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_of_exp_at_special_angles(dtype):
    for phi in special_batches().astype(dtype):
        back, t = log(exp(phi)), length(phi)
        at_pi = np.abs(t - np.pi) < 4 * np.finfo(dtype).eps
        expected = phi.astype(np.float64)
        close(back, np.where(at_pi, up_to_sign(back, expected), expected), 6, t)


@plain_jit
def derivatives(phi, d):
    """Of log(exp(phi)) = phi forward in direction d, and of d . log(exp(phi)) reverse."""

    def f(p):
        return quaternion.log(quaternion.exp(p))

    return jax.jvp(f, (phi,), (d,))[1], jax.vjp(f, phi)[1](d)[0]


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_of_exp_has_the_identity_as_derivative(dtype):
    """Finite and equal to I at 0 and beside pi; where log returns the other vector, phi - 2 pi n, the derivative is
    I - (2 pi / t) (I - n n^T). Forward and reverse, since it is symmetric."""
    for phi in special_batches().astype(dtype):
        t = length(phi)
        n = phi / np.where(t == 0.0, 1.0, t)
        other = np.sum(np.asarray(log(exp(phi))) * n, axis=-1, keepdims=True) < 0.0
        at_pi = np.abs(t - np.pi) < 4 * np.finfo(dtype).eps
        for d in np.eye(3):
            expected = d - np.where(other, 2.0 * (d - n * (n @ d)[:, None]), 0.0)
            for computed in derivatives(phi, np.broadcast_to(d, (N, 3)).astype(dtype)):
                assert computed.dtype == dtype
                assert np.all(np.isfinite(computed))
                alternative = d - np.where(other, 0.0, 2.0 * (d - n * (n @ d)[:, None]))
                either = np.abs(computed - alternative).max(-1) < np.abs(computed - expected).max(-1)
                close(computed, np.where(at_pi & either[:, None], alternative, expected), 16)


# Signs and lengths ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), plain(3))
def test_double_cover(dtype, q, v):
    q, v = q.astype(dtype), v.astype(dtype)
    one, other = of_one(q, v), of_one(-q, v)
    np.testing.assert_array_equal(one["matrix"], other["matrix"])
    np.testing.assert_array_equal(one["rotate"], other["rotate"])
    np.testing.assert_array_equal(one["rate"], -np.asarray(other["rate"]))
    close(of_two(q, -q)["angle"], 0.0, 8)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), st.sampled_from([1e-15, 1e-3, 1.0, 1e3, 1e15]))
def test_normalise_keeps_direction(dtype, q, factor):
    """A sum of four squares, a root, a division: 4. The result is again unchanged, but for its last bit."""
    q = (q * factor).astype(dtype)
    unit = normalise(q)
    assert unit.dtype == dtype
    close(unit, q / length(q), 4)
    close(normalise(unit), unit, 2)


def test_normalise_of_zero_is_nan():
    assert np.all(np.isnan(normalise(np.zeros((N, 4)))))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(plain(4), plain(4))
def test_align_sign(dtype, q, reference):
    """The result is q or -q to the bit, and never on the other side; where q . reference is plainly 0, it is q."""
    q, reference = q.astype(dtype), reference.astype(dtype)
    aligned = np.asarray(of_two(q, reference)["aligned"])
    assert aligned.dtype == dtype
    products = q.astype(np.float64) * reference
    dot, noise = products.sum(-1), 4 * np.finfo(dtype).eps * np.abs(products).sum(-1)
    np.testing.assert_array_equal(aligned[dot >= noise], q[dot >= noise])
    np.testing.assert_array_equal(aligned[dot < -noise], -q[dot < -noise])
    assert np.all(np.all(aligned == q, axis=-1) | np.all(aligned == -q, axis=-1))


@pytest.mark.parametrize("dtype", DTYPES)
def test_align_sign_of_orthogonal_quaternions_is_plus(dtype):
    q = np.resize(np.array([[0, 0, 0, 1], [0, 0, 0, -1], [0.6, 0.8, 0, 0], [1, 1, 1, 1]], dtype), (N, 4))
    reference = np.resize(np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0.8, -0.6, 0, 0], [1, -1, 1, -1]], dtype), (N, 4))
    aligned = np.asarray(of_two(q, reference)["aligned"])
    keep = [0, 1, 3]
    np.testing.assert_array_equal(aligned[keep], q[keep])
    np.testing.assert_array_equal(np.abs(aligned), np.abs(q))  # 0.6 * 0.8 - 0.8 * 0.6 may round to either side


# Angles and rates -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), rotation_vectors())
def test_angle_between(dtype, p, phi):
    """Absolute to 8 ulps of 1 (components of p and q are rounded), pi included; symmetric; blind to signs."""
    p, step = p.astype(dtype), phi.astype(dtype)
    q = multiply(exp(step), p)
    angle = of_two(p, q)["angle"]
    assert angle.dtype == dtype
    close(angle, (scipy(p) * scipy(q).inv()).magnitude(), 8)
    close(angle, np.minimum(length(step), 2 * np.pi - length(step))[:, 0], 12)
    close(of_two(q, p)["angle"], angle, 4)
    close(of_two(-p, q)["angle"], angle, 0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_angle_between_has_no_dead_zone_at_either_end(dtype):
    """From the identity the angle is relative to 6 ulps, 1e-12 and smaller included (an arc cosine of the scalar part
    would be 0 below 1e-8); at pi it is pi to the last bit or two. Only its square underflows, at 1e-150 (1e-16)."""
    floor = 1e3 * np.sqrt(np.finfo(dtype).tiny)
    one = np.resize(np.array([0, 0, 0, 1], dtype), (N, 4))
    for phi in special_batches().astype(dtype):
        t = length(phi)[:, 0]
        angle = np.asarray(of_two(exp(phi), one)["angle"])
        expected = np.minimum(t, 2 * np.pi - t)
        close(np.where(t < floor, 0, angle).astype(dtype), np.where(t < floor, 0.0, expected), 6, expected)
        assert np.all(angle[t < floor] <= 2 * t[t < floor])
        assert np.all(angle <= np.pi * (1 + np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), plain(3))
def test_rate_matrix(dtype, q, v):
    """q (x) [v, 0] = Xi(q) v; the columns of Xi are orthonormal and orthogonal to q; and Xi(q) v / 2 is the derivative
    of q (x) exp(v), the motion of q by a right error."""
    q, v = q.astype(dtype), v.astype(dtype)
    Xi = np.asarray(of_one(q, v)["rate"])
    assert Xi.dtype == dtype
    assert Xi.shape == (N, 4, 3)
    pure = np.concatenate([v, np.zeros((N, 1), dtype)], axis=-1)
    close(Xi @ v[..., None], multiply(q, pure)[..., None], 4, np.maximum(length(v), 1e-30)[..., None])
    close(np.swapaxes(Xi, -1, -2) @ q[..., None], 0.0, 4)
    close(np.swapaxes(Xi, -1, -2) @ Xi, np.broadcast_to(np.eye(3), (N, 3, 3)), 8)
    close(moved(q, v), 0.5 * (Xi.astype(np.float64) @ v[..., None])[..., 0], 4, np.maximum(length(v), 1e-30))


@plain_jit
def moved(q, v):
    return jax.jvp(lambda d: quaternion.multiply(q, quaternion.exp(d)), (jnp.zeros_like(v),), (v,))[1]


# Batches --------------------------------------------------------------------------------------------------------------


def test_batch_axes_vmap_and_loop_agree():
    """A few ulps, not bits: the compiler may contract each program differently."""
    phi = special_batches()[4:, :10].reshape(-1, 2, 5, 3)[0]
    q, p = true_exp(phi), true_exp(phi[::-1] + 0.1)

    def everything(p, q, v):
        return of_two.__wrapped__(p, q) | of_one.__wrapped__(q, v)

    single = plain_jit(everything)
    batched, mapped = single(p, q, phi), plain_jit(jax.vmap(jax.vmap(everything)))(p, q, phi)
    for i, j in np.ndindex(2, 5):
        for name, one in single(p[i, j], q[i, j], phi[i, j]).items():
            assert batched[name].shape == mapped[name].shape == (2, 5, *one.shape)
            close(batched[name][i, j], one, 4)
            close(mapped[name][i, j], one, 4)
