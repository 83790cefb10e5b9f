"""Laws of retractions: [+] and [-] undo each other, sides and frames of the errors, transport, products.

Tolerances are in ulps: eps of the dtype, times the size of what is compared (1 unless a scale is given). One [+] is an
exponential, a product and a normalisation, one [-] a product and a logarithm, of unit quaternions: 4 eps or so each,
and an angle is twice a quaternion's: 16 for a round trip. What is amplified on the way is said in each law.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from helmstar.backend import COMPILER_OPTIONS, jax, jnp
from helmstar.core import pytree
from helmstar.geometry import euclidean, gibbs_left, product, quaternion_additive, so3_left, so3_right
from helmstar.geometry.retraction import block_diagonal

DTYPES = [np.float64, np.float32]
N = 16  # every batch has this length, so that each program compiles once for each dtype
LAW = settings(deadline=None, derandomize=True, max_examples=30)
AXES = [[1.0, 0, 0], [0, -1, 0], [1, 0, -1], [1, 1, 1], [1e-9, 1, 0]]
ANGLES = [0.0, 1e-30, 1e-12, 1e-8, 1e-4, 0.1, 1.0, 2.0, 3.0, np.pi - 1e-3]


@pytree
class AttitudeAndVector:
    """A state of two parts for `product`: an attitude q_BN and a vector r (m)."""

    q: jax.Array
    r: jax.Array


R3 = euclidean(3)
PAIR = product(AttitudeAndVector, so3_left, R3)
PAIR_RIGHT = product(AttitudeAndVector, so3_right, R3)
ATTITUDES = {r.name: r for r in (so3_right, so3_left, gibbs_left)}
LEFT = [so3_left, gibbs_left]
ALL = {**ATTITUDES, "quaternion_additive": quaternion_additive, "euclidean(4)": euclidean(4), "product": PAIR}


def _states(q, r) -> dict:
    """A state for each of ALL, made of a quaternion and a vector of three."""
    return dict.fromkeys(ALL, q) | {"product": AttitudeAndVector(q, r)}


def _errors(d, e) -> dict:
    """An error for each of ALL, made of a vector of three and one of four."""
    four = {"quaternion_additive": e, "euclidean(4)": e, "product": jnp.concatenate([d, e[..., :3]], axis=-1)}
    return dict.fromkeys(ALL, d) | four


def _of(q, r, d, e):
    """All of ALL at once, in one program: x [+] d, and D where there is one."""
    x, errors = _states(q, r), _errors(d, e)
    plus = {name: retraction.boxplus(x[name], errors[name]) for name, retraction in ALL.items()}
    return plus, {name: a.transport(errors[name]) for name, a in ALL.items() if a.transport is not None}


def _difference(p, s, q, r):
    y, x = _states(p, s), _states(q, r)
    return {name: retraction.boxminus(y[name], x[name]) for name, retraction in ALL.items()}


of, difference = (jax.jit(f, compiler_options=COMPILER_OPTIONS) for f in (_of, _difference))


def boxplus(name: str, x, d):
    """x [+] d by the common program, whatever the retraction does not take left at zero."""
    q, r = (x.q, x.r) if name == "product" else (x, np.zeros((N, 3), x.dtype))
    d = np.asarray(d)
    if name in ATTITUDES:
        three, four = d, np.zeros((N, 4), d.dtype)
    elif name == "product":
        three, four = d[:, :3], np.pad(d[:, 3:], ((0, 0), (0, 1)))
    else:
        three, four = np.zeros((N, 3), d.dtype), d
    return of(q, r, three, four)[0][name]


def boxminus(name: str, y, x):
    zero = np.zeros((N, 3), np.float32)
    (p, s), (q, r) = ((a.q, a.r) if name == "product" else (a, zero.astype(a.dtype)) for a in (y, x))
    return difference(p, s, q, r)[name]


def transport(name: str, d):
    q = np.broadcast_to(np.array([0, 0, 0, 1], d.dtype), (N, 4))
    return np.asarray(of(q, np.zeros((N, 3), d.dtype), d[:, :3], np.zeros((N, 4), d.dtype))[1][name])


# Compiled without optimisation: what is tested is not arithmetic to the bit, and it takes a third of the time.
plain_jit = partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
)


def vectors(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Angles about axes of any length but zero."""
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True) * angles[..., None]


def seeded(draw):
    """What `draw` makes of a random generator. (Hypothesis drives its seed: drawing each number would take far longer.)"""
    return st.integers(0, 2**32 - 1).map(lambda seed: draw(np.random.default_rng(seed)))


def rotation_vectors(largest: float = np.pi - 1e-3):
    """(N, 3): about AXES and others, by ANGLES and others up to `largest`."""

    def draw(rng):
        axes = np.where(rng.random((N, 1)) < 0.4, rng.choice(AXES, N), rng.normal(size=(N, 3)))
        return vectors(axes, np.where(rng.random(N) < 0.4, rng.choice(ANGLES, N), largest * rng.random(N)))

    return seeded(draw)


def plain(n: int):
    """(N, n) of numbers up to 2, every fifth one zero."""
    return seeded(lambda rng: np.where(rng.random((N, n)) < 0.2, 0.0, rng.uniform(-2, 2, (N, n))))


def unit_quaternions():
    """(N, 4), both signs."""

    def draw(rng):
        return rng.choice([-1.0, 1.0], (N, 1)) * Rotation.random(N, rng=rng).as_quat()

    return seeded(draw)


def error_in_ulps(actual, expected, scale=1.0) -> float:
    """Largest |actual - expected| over eps of actual's dtype times scale; a NaN is infinitely wrong."""
    actual = np.asarray(actual)
    info = np.finfo(actual.dtype)
    e = np.abs(actual.astype(np.float64) - np.asarray(expected, np.float64))
    e = e / (info.eps * np.maximum(scale, info.tiny))
    return float(np.max(np.where(np.isnan(e), np.inf, e)))


def close(actual, expected, ulps: float, scale=1.0) -> None:
    e = error_in_ulps(actual, expected, scale)
    assert e <= ulps, f"{e:.2f} ulps, {ulps} allowed"


def same_rotation(actual, expected: Rotation, ulps: float) -> None:
    """As rotations, whatever the sign: q = +-p."""
    actual = np.asarray(actual)
    p = expected.as_quat()
    sign = np.where(np.sum(actual * p, axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    close(actual, sign * p, ulps)


def rotation(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q, np.float64))


def norm(v) -> np.ndarray:
    return np.linalg.norm(np.asarray(v, np.float64), axis=-1, keepdims=True)


# [+] and [-] undo each other ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["so3_right", "so3_left"])
@LAW
@given(unit_quaternions(), unit_quaternions(), rotation_vectors())
def test_rotation_vectors_undo(name, dtype, x, y, d):
    """(x [+] d) [-] x = d for angles below pi; x [+] (y [-] x) = y as a rotation, for all y; x [+] 0 = x."""
    x, y, d = x.astype(dtype), y.astype(dtype), d.astype(dtype)
    plus, minus = partial(boxplus, name), partial(boxminus, name)
    moved = plus(x, d)
    assert moved.dtype == minus(moved, x).dtype == dtype
    close(norm(moved).astype(dtype), 1.0, 2)
    close(minus(moved, x), d, 16)
    same_rotation(plus(x, minus(y, x)), rotation(y), 16)
    close(plus(x, np.zeros_like(d)), x, 2)
    close(minus(x, x), 0.0, 4)
    close(minus(-x, x), 0.0, 4)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), unit_quaternions(), plain(3))
def test_gibbs_vectors_undo(dtype, x, y, d):
    """The same for every d, however large, and every y but a half turn away. xi = 2 tan(t / 2) n: one ulp of the unit
    quaternion in between is (1 + xi^2 / 4) of xi."""
    x, y, d = x.astype(dtype), y.astype(dtype), (8 * d).astype(dtype)
    plus, minus = partial(boxplus, "gibbs_left"), partial(boxminus, "gibbs_left")
    moved = plus(x, d)
    assert moved.dtype == minus(moved, x).dtype == dtype
    close(minus(moved, x), d, 16, 1 + 0.25 * norm(d) ** 2)
    scalar = np.abs((rotation(y) * rotation(x).inv()).as_quat()[:, 3])
    y = np.where(scalar[:, None] < 1e-5, x, y)
    same_rotation(plus(x, minus(y, x)), rotation(y), 16)
    close(plus(x, np.zeros_like(d)), x, 2)
    close(minus(-x, x), 0.0, 4)


def test_gibbs_vector_of_a_half_turn_is_not_finite():
    x, y = np.resize([0.0, 0, 0, 1], (N, 4)), np.resize([1.0, 0, 0, 0], (N, 4))
    assert np.all(~np.isfinite(boxminus("gibbs_left", y, x)[:, 0]))


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), unit_quaternions(), plain(4))
def test_what_holds_of_the_additive_quaternion(dtype, x, y, d):
    """The sum is normalised, so four numbers move three degrees of freedom and (x [+] d) [-] x is not d. What holds:
    - x [+] (y [-] x) = y, or -y where that is nearer to x: exactly the rotation of y;
    - (x [+] d) [-] x = (x + d) / |x + d| - x while x . (x + d) >= 0;
    - to first order that is the part of d across x: its derivative at 0 is I - x x^T;
    - x [+] 0 = x; (-x) [-] x = 0."""
    x, y, d = x.astype(dtype), y.astype(dtype), (0.3 * d).astype(dtype)
    plus, minus = partial(boxplus, "quaternion_additive"), partial(boxminus, "quaternion_additive")
    assert plus(x, d).dtype == minus(y, x).dtype == dtype
    same_rotation(plus(x, minus(y, x)), rotation(y), 4)
    total = x.astype(np.float64) + d
    total = np.where(norm(total) < 0.1, x, total)
    d = (total - x).astype(dtype)
    unit = (x.astype(np.float64) + d) / norm(x.astype(np.float64) + d)
    close(plus(x, d), unit, 16)  # x + d rounds to an ulp of 1 and may be as short as 0.1
    stays = np.sum(unit * x, axis=-1, keepdims=True) > 1e-3
    close(np.where(stays, minus(plus(x, d), x), dtype(0)), np.where(stays, unit - x, 0.0), 16)
    close(plus(x, np.zeros_like(d)), x, 2)
    np.testing.assert_array_equal(minus(-x, x), np.zeros((N, 4)))
    across = d - x * np.sum(d.astype(np.float64) * x, axis=-1, keepdims=True)
    close(additive_derivative(x, d), across, 8)


@plain_jit
def additive_derivative(x, d):
    def there_and_back(e):
        return quaternion_additive.boxminus(quaternion_additive.boxplus(x, e), x)

    return jax.jvp(there_and_back, (jnp.zeros_like(d),), (d,))[1]


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(plain(4), plain(4))
def test_euclidean_is_sum_and_difference(dtype, x, d):
    x, d = x.astype(dtype), d.astype(dtype)
    plus, minus = partial(boxplus, "euclidean(4)"), partial(boxminus, "euclidean(4)")
    np.testing.assert_array_equal(plus(x, d), x + d)
    close(minus(plus(x, d), x), d, 1, 4.0)  # the sum, of up to 4, rounds
    np.testing.assert_array_equal(plus(x, np.zeros_like(d)), x)
    assert plus(x, d).dtype == minus(x, d).dtype == dtype


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), rotation_vectors(), plain(3), plain(3))
def test_product_moves_each_part_by_its_own_slice(dtype, q, d, r, s):
    q, d, r, s = (a.astype(dtype) for a in (q, d, r, s))
    x = AttitudeAndVector(q=q, r=r)
    y = boxplus("product", x, np.concatenate([d, s], axis=-1))
    assert isinstance(y, AttitudeAndVector)
    close(y.q, np.asarray(boxplus("so3_left", q, d)), 2)
    np.testing.assert_array_equal(y.r, r + s)
    back = boxminus("product", y, x)
    assert back.dtype == dtype
    assert back.shape == (N, 6)
    close(back[:, :3], d, 16)
    close(back[:, 3:], s, 1, 4.0)


# Sides and frames -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), rotation_vectors(), plain(3))
def test_side_and_frame_of_the_error(dtype, q_hat, xi, v_N):
    """Right: R_BN = R_hat exp(xi), xi turns vectors of N before R_hat does. Left: R_BN = exp(xi) R_hat, xi turns
    vectors of B after it. Gibbs: as left, by the quaternion [xi / 2, 1] normalised. And so xi_left = R_hat xi_right."""
    q_hat, xi = q_hat.astype(dtype), xi.astype(dtype)
    R_hat, turn = rotation(q_hat), Rotation.from_rotvec(xi.astype(np.float64))
    right, left, gibbs = (rotation(boxplus(n, q_hat, xi)) for n in ("so3_right", "so3_left", "gibbs_left"))
    half = Rotation.from_quat(np.concatenate([0.5 * xi.astype(np.float64), np.ones((N, 1))], axis=-1))
    for actual, expected in ((right, R_hat * turn), (left, turn * R_hat), (gibbs, half * R_hat)):
        close(actual.as_matrix().astype(dtype), expected.as_matrix(), 16)
    close(right.apply(v_N).astype(dtype), R_hat.apply(turn.apply(v_N)), 16, norm(v_N))
    close(left.apply(v_N).astype(dtype), turn.apply(R_hat.apply(v_N)), 16, norm(v_N))
    # The same truth, seen from both sides.
    truth = np.asarray(boxplus("so3_right", q_hat, xi))
    close(boxminus("so3_left", truth, q_hat), R_hat.apply(np.asarray(xi, np.float64)), 24)


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(unit_quaternions(), rotation_vectors(0.02))
def test_gibbs_error_is_the_rotation_vector_to_second_order(dtype, q, xi):
    """2 tan(t / 2) = t + t^3 / 12 + ..: the exact relation, and the bound on the difference."""
    q = q.astype(dtype)
    xi = np.where(norm(xi) > 0.02, 0.01 * xi, xi).astype(dtype)
    t = np.maximum(norm(xi), 1e-30)
    gibbs = np.asarray(boxminus("gibbs_left", boxplus("so3_left", q, xi), q))
    close(gibbs, xi * 2 * np.tan(0.5 * t) / t, 8)
    assert np.all(norm(gibbs - xi) <= t**3 / 11 + 16 * np.finfo(dtype).eps)


# Transport ------------------------------------------------------------------------------------------------------------


def covariances(rng) -> np.ndarray:
    A = rng.normal(size=(N, 3, 3))
    return A @ np.swapaxes(A, -1, -2)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("left", LEFT, ids=lambda r: r.name)
@LAW
@given(unit_quaternions(), rotation_vectors(), st.integers(0, 2**32 - 1))
def test_transport_is_the_turn_of_the_body_axes(left, dtype, x, d, seed):
    """By the other side: the covariance of the right error lives in N, which no estimate moves. P_left = R P_right R^T
    before and after the same physical move R -> R', so D P_left D^T = R' P_right R'^T. And D is a rotation, R' R^T."""
    x, d = x.astype(dtype), d.astype(dtype)
    D = transport(left.name, d)
    assert D.dtype == dtype
    before, after = rotation(x).as_matrix(), rotation(boxplus(left.name, x, d)).as_matrix()
    close(D, after @ np.swapaxes(before, -1, -2), 16)
    P_right = covariances(np.random.default_rng(seed))
    P_left = before @ P_right @ np.swapaxes(before, -1, -2)
    carried = D @ P_left @ np.swapaxes(D, -1, -2)
    size = np.trace(P_right, axis1=-2, axis2=-1)[:, None, None]
    close(carried.astype(dtype), after @ P_right @ np.swapaxes(after, -1, -2), 40, size)
    np.testing.assert_array_equal(transport(left.name, np.zeros_like(d)), np.broadcast_to(np.eye(3), (N, 3, 3)))


@pytest.mark.parametrize("left", LEFT, ids=lambda r: r.name)
def test_transport_carries_the_covariance_of_samples(left):
    """A cloud of truths about the estimate, made of errors in N, which an update does not touch. The second moment of
    its left errors about x, carried by D, is that of the same cloud about x [+] d. Exact for the rotation vector; of
    the Gibbs vector the errors, 1e-4, leave their cube: 1e-8 relative."""
    rng = np.random.default_rng(7)
    errors_N = rng.multivariate_normal(np.zeros(3), 1e-8 * covariances(rng)[0], size=N)
    x = Rotation.random(rng=rng).as_quat()
    d = np.array([0.4, -0.9, 0.7])
    moved = np.asarray(boxplus(left.name, np.broadcast_to(x, (N, 4)), np.broadcast_to(d, (N, 3))))[0]

    def second_moment(mean: np.ndarray) -> np.ndarray:
        mean = np.broadcast_to(mean, (N, 4))
        errors = np.asarray(boxminus(left.name, boxplus("so3_right", mean, errors_N), mean))
        return errors.T @ errors / N

    D = np.asarray(transport(left.name, np.broadcast_to(d, (N, 3))))[0]
    before, after = second_moment(x), second_moment(moved)
    tolerance = 1e-11 if left is so3_left else 1e-7  # eps / 1e-4 an error
    assert np.max(np.abs(D @ before @ D.T - after)) < tolerance * np.trace(after)
    assert np.max(np.abs(before - after)) > 1e-2 * np.trace(after)  # without transport the law does not hold


def test_transport_is_absent_where_it_is_the_identity():
    assert [r.transport for r in (so3_right, quaternion_additive, R3, PAIR_RIGHT)] == [None] * 4
    assert so3_left.transport is not None
    assert gibbs_left.transport is not None


@pytest.mark.parametrize("dtype", DTYPES)
@LAW
@given(rotation_vectors(), plain(3))
def test_transport_of_a_product_is_block_diagonal(dtype, d, s):
    d, s = d.astype(dtype), s.astype(dtype)
    D = transport("product", np.concatenate([d, s], axis=-1))
    assert D.dtype == dtype
    parts = transport("so3_left", d)
    close(D, np.stack([block_diag(part, np.eye(3)) for part in parts]), 4)


# Products and blocks --------------------------------------------------------------------------------------------------


def test_dimensions_and_names():
    assert [r.dim for r in (so3_right, so3_left, gibbs_left, quaternion_additive, euclidean(4), PAIR)] == [
        3,
        3,
        3,
        4,
        4,
        6,
    ]
    assert PAIR.name == "AttitudeAndVector(so3_left, euclidean(3))"


def test_equal_retractions_are_one_object():
    """They are part of what is compiled: a second one would compile everything again."""
    assert euclidean(3) is R3
    assert product(AttitudeAndVector, so3_left, R3) is PAIR
    assert PAIR is not PAIR_RIGHT
    assert hash(PAIR) == hash(product(AttitudeAndVector, so3_left, R3))


def test_product_of_products():
    """The attitude inside the inner product, which is not the first part: every slice starts where the last one ended."""

    @pytree
    class Two:
        a: jax.Array
        b: AttitudeAndVector

    both = product(Two, euclidean(1), PAIR)
    assert both.dim == 7

    @plain_jit
    def move(x, d):
        y = both.boxplus(x, d)
        return y, both.boxminus(y, x), both.transport(d), so3_left.boxplus(x.b.q, d[1:4]), so3_left.transport(d[1:4])

    x = Two(np.zeros(1), AttitudeAndVector(np.array([0.0, 0, 0, 1]), np.zeros(3)))
    d = np.array([9, 0.1, 0.2, 0.3, 1, 2, 3])
    y, back, D, q, turn = move(x, d)
    np.testing.assert_array_equal(y.a, [9])
    close(y.b.q, np.asarray(q), 2)
    np.testing.assert_array_equal(y.b.r, [1, 2, 3])
    close(back, d, 4)
    close(D, block_diag(1.0, turn, np.eye(3)), 2)


@pytest.mark.parametrize("parts", [(so3_left,), (so3_left, R3, R3), ()])
def test_a_wrong_number_of_parts_is_named(parts):
    with pytest.raises(TypeError, match=rf"AttitudeAndVector has 2 fields \['q', 'r'\], but {len(parts)} retractions"):
        product(AttitudeAndVector, *parts)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("lead", [(), (2, 3)])
def test_block_diagonal_is_scipys(lead, dtype):
    rng = np.random.default_rng(3)
    blocks = [rng.normal(size=(*lead, n, n)).astype(dtype) for n in (1, 3, 2)]
    actual = np.asarray(plain_jit(block_diagonal)(blocks))
    assert actual.dtype == dtype
    for index in np.ndindex(lead):
        np.testing.assert_array_equal(actual[index], block_diag(*(b[index] for b in blocks)))


# Derivatives and batches ----------------------------------------------------------------------------------------------


def test_derivative_at_zero_is_what_filters_assume():
    """d((x [+] d) [-] x) at d = 0 is I, forward and reverse; of the additive quaternion it is I - x x^T."""
    q, r = Rotation.from_rotvec([0.5, -1.2, 0.3]).as_quat(), np.arange(3.0)
    x = _states(q, r)

    def there_and_back(errors):
        return {name: a.boxminus(a.boxplus(x[name], errors[name]), x[name]) for name, a in ALL.items()}

    @plain_jit
    def derivatives(direction, weights):
        zero = jax.tree.map(jnp.zeros_like, direction)
        return jax.jvp(there_and_back, (zero,), (direction,))[1], jax.vjp(there_and_back, zero)[1](weights)[0]

    for k in range(6):
        unit = {name: np.eye(a.dim)[k % a.dim] for name, a in ALL.items()}
        for computed in derivatives(unit, unit):
            for name, column in computed.items():
                lost = q * (q @ unit[name]) if name == "quaternion_additive" else 0.0
                close(column, unit[name] - lost, 4)


def test_batch_axes_agree_with_a_loop():
    rng = np.random.default_rng(5)
    q, p = (Rotation.random(10, rng=rng).as_quat().reshape(2, 5, 4) for _ in range(2))
    r, s, d, e = (0.3 * rng.normal(size=(2, 5, n)) for n in (3, 3, 3, 4))
    both = plain_jit(lambda q, p, r, s, d, e: (_of(q, r, d, e), _difference(p, s, q, r)))
    batched = both(q, p, r, s, d, e)
    for i, j in np.ndindex(2, 5):
        single = both(*(a[i, j] for a in (q, p, r, s, d, e)))
        for one, all_of_them in zip(jax.tree.leaves(single), jax.tree.leaves(batched), strict=True):
            assert all_of_them.shape == (2, 5, *one.shape)
            close(all_of_them[i, j], np.asarray(one), 8, np.maximum(1.0, np.max(np.abs(one))))
