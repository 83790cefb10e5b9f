"""What the arithmetic solvers share: everything written out in components, so that no small matrix is ever stored.

A vector is a tuple of three arrays of the batch's shape, a matrix three rows of three. With components first, NumPy works
on long rows and XLA fuses; LAPACK, `einsum` and the strides of (..., 3, 3) would each cost more than the arithmetic.

XLA on a CPU computes a shared value again in every kernel that uses it, unless it ends in a division or a root. So what many
outputs share is divided by its determinant here and there, where multiplying with an inverse would look cheaper; and NaN for
what is not observable enters once, before the last steps, instead of being chosen for every output.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from .wahba import AMBIGUITY, WahbaSolution, accept, threshold

Vector = tuple[Any, Any, Any]
Matrix = tuple[Vector, Vector, Vector]
Quaternion = tuple[Any, Any, Any, Any]


def dot(u: Vector, v: Vector) -> Any:
    """u . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u: Vector, v: Vector) -> Vector:
    """u x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def add(u: Vector, v: Vector) -> Vector:
    """u + v."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


def subtract(u: Vector, v: Vector) -> Vector:
    """u - v."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


def scale(a: Any, v: Vector) -> Vector:
    """a v."""
    return a * v[0], a * v[1], a * v[2]


def apply(R: Matrix, v: Vector) -> Vector:
    """R v."""
    return dot(R[0], v), dot(R[1], v), dot(R[2], v)


def cofactors(M: Matrix) -> Matrix:
    """Cofactors of M: its inverse is their transpose over the determinant."""
    return cross(M[1], M[2]), cross(M[2], M[0]), cross(M[0], M[1])


def total(terms: list[Any]) -> Any:
    """Sum of a list of arrays."""
    s = terms[0]
    for t in terms[1:]:
        s = s + t
    return s


def choose(k: Any, values: tuple[Any, Any, Any, Any], xp: ModuleType) -> Any:
    """values[k], element by element."""
    return xp.where(k == 0, values[0], xp.where(k == 1, values[1], xp.where(k == 2, values[2], values[3])))


def largest(values: tuple[Any, Any, Any, Any], xp: ModuleType) -> Any:
    """Index 0..3 of the largest of four arrays, element by element."""
    k, best = xp.zeros_like(values[0], dtype=int), values[0]
    for i in (1, 2, 3):
        k, best = xp.where(values[i] > best, i, k), xp.maximum(best, values[i])
    return k


class Directions(NamedTuple):
    """Unit directions b in B and r in N, n of each; w their shares of the total weight, with sum 1; total = sum a_i in
    rad^-2; anything a problem lacks or that is not finite is NaN in every share of it."""

    b: list[Vector]
    r: list[Vector]
    w: list[Any]
    total: Any
    dtype: np.dtype
    xp: ModuleType


def directions(xp: ModuleType, b: Any, r: Any, sigma: Any, mask: Any, weights: Any) -> Directions:
    """Normalised components of (..., n, 3) arrays; masked entries become the same direction twice, without weight."""
    b, r, a, mask = accept(b, r, sigma, mask, weights, xp)
    n, dtype = b.shape[-2], a.dtype
    masked = mask.ndim > 1 or xp is not np or not np.all(mask)

    def units(v: Any) -> list[Vector]:
        out = []
        for i in range(n):
            x, y, z = (xp.asarray(v[..., i, j], dtype=dtype) for j in range(3))
            if masked:
                m = mask[..., i]
                x, y, z = xp.where(m, x, xp.ones_like(x)), xp.where(m, y, dtype.type(0)), xp.where(m, z, dtype.type(0))
            out.append(scale(1.0 / xp.sqrt(x * x + y * y + z * z), (x, y, z)))
        return out

    shares = [a[..., i] for i in range(n)]
    whole = total(shares)
    inverse = 1.0 / xp.where(whole > 0, whole, xp.asarray(np.nan, dtype=dtype))
    return Directions(units(b), units(r), [s * inverse for s in shares], whole, dtype, xp)


def profile(d: Directions) -> Matrix:
    """B = sum w_i b_i r_i^T, attitude profile matrix with weights of sum 1."""
    rows = []
    for j in range(3):
        wb = [w * b[j] for w, b in zip(d.w, d.b, strict=True)]
        rows.append(tuple(total([x * r[k] for x, r in zip(wb, d.r, strict=True)]) for k in range(3)))
    return rows[0], rows[1], rows[2]


class Turn(NamedTuple):
    """The reference frame turned by pi about axis k = 0, 1, 2 of N, or not, k = 3: signs of the components of r (method of
    sequential rotations; Shuster and Oh 1981)."""

    k: Any
    signs: Vector

    def columns(self, B: Matrix) -> Matrix:
        """B diag(signs): the matrix in the turned frame, or back from it."""
        rows = [tuple(s * x for s, x in zip(self.signs, row, strict=True)) for row in B]
        return rows[0], rows[1], rows[2]

    def back(self, q: Quaternion, xp: ModuleType) -> Quaternion:
        """q_BN of a quaternion in the turned frame: q (x) unit quaternion of axis k."""
        x, y, z, w = q
        rows = ((w, -z, y, x), (z, w, -x, y), (-y, x, w, z), (-x, -y, -z, w))  # each column is q times i, j, k, 1
        a, b, c, d = (choose(self.k, row, xp) for row in rows)
        return a, b, c, d


def turn(k: Any, dtype: np.dtype, xp: ModuleType) -> Turn:
    """The turn of each problem's k."""
    plus, minus = xp.asarray(1.0, dtype=dtype), xp.asarray(-1.0, dtype=dtype)
    x, y, z = (xp.where((k == j) | (k == 3), plus, minus) for j in range(3))
    return Turn(k, (x, y, z))


def unit(q: Quaternion, xp: ModuleType) -> Quaternion:
    """q over its norm; NaN for zero."""
    x, y, z, w = q
    inverse = 1.0 / xp.sqrt(x * x + y * y + z * z + w * w)
    return x * inverse, y * inverse, z * inverse, w * inverse


def matrix_of_quaternion(q: Quaternion) -> Matrix:
    """R_BN of a unit q_BN."""
    x, y, z, w = q
    tx, ty, tz = x + x, y + y, z + z
    xx, yy, zz, xy, xz, yz = x * tx, y * ty, z * tz, x * ty, x * tz, y * tz
    wx, wy, wz = w * tx, w * ty, w * tz
    return (1.0 - (yy + zz), xy - wz, xz + wy), (xy + wz, 1.0 - (xx + zz), yz - wx), (xz - wy, yz + wx, 1.0 - (xx + yy))


def quaternion_of_rows(R: Matrix, xp: ModuleType) -> Quaternion:
    """q_BN of R_BN by the best of four forms; R may be off a rotation by a factor or by rounding."""
    (a, b, c), (d, e, f), (g, h, i) = R
    s = xp.sqrt(a * a + b * b + c * c)
    K = (s + a - e - i, s - a + e - i, s - a - e + i, s + a + e + i)
    k = largest(K, xp)
    x, y, z, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    rows = ((K[0], xy, xz, x), (xy, K[1], yz, y), (xz, yz, K[2], z), (x, y, z, K[3]))
    a, b, c, d = (choose(k, row, xp) for row in rows)
    return unit((a, b, c, d), xp)


def triads(normal_b: Vector, first_b: Vector, normal_r: Vector, first_r: Vector) -> Matrix:
    """R_BN that turns the right-handed triad of two perpendicular unit vectors in N into the one in B."""
    third_b, third_r = cross(normal_b, first_b), cross(normal_r, first_r)
    rows = []
    for j in range(3):
        row = (first_b[j] * first_r[k] + third_b[j] * third_r[k] + normal_b[j] * normal_r[k] for k in range(3))
        rows.append(tuple(row))
    return rows[0], rows[1], rows[2]


def outer_sum(w: list[Any], v: list[Vector]) -> list[Any]:
    """Upper triangle, rows first, of sum w v v^T."""
    return [total([(a * u[j]) * u[k] for a, u in zip(w, v, strict=True)]) for j, k in UPPER]


def information(w: list[Any], v: list[Vector]) -> tuple[Matrix, Any, Any]:
    """Cofactors of M = sum w (I - v v^T), its determinant, and its sum of products of two eigenvalues."""
    xx, xy, xz, yy, yz, zz = outer_sum(w, v)
    M = ((yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy))
    c = cofactors(M)
    return c, dot(M[0], c[0]), c[0][0] + c[1][1] + c[2][2]


UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def observable(d: Directions, gap: Any = None) -> Any:
    """True where two directions differ in B and in N, both with weight, and no second attitude fits as well.

    gap: distance of K's two largest eigenvalues, for the solvers that need it.
    """
    limit = threshold(d.dtype)
    seen = None
    for v in (d.b, d.r):
        # NaN compares as False. M's smallest eigenvalue is det over the sum of products of two, within a factor of two.
        _, det, second = information(d.w, v)
        here = (det > limit * second) & (second > 0)
        if gap is not None:
            here = here & (gap * second > 2.0 * AMBIGUITY * det)
        seen = here if seen is None else seen & here
    return seen


def only(seen: Any, q: Quaternion, xp: ModuleType) -> Quaternion:
    """q with NaN for its last element where nothing is observable; normalising spreads it."""
    return (*q[:3], xp.where(seen, q[3], xp.asarray(np.nan, dtype=q[3].dtype)))


def conclude(
    d: Directions,
    q: Quaternion,
    frame: Turn | None = None,
    covariance: Matrix | None = None,
    used: Directions | None = None,
) -> WahbaSolution:
    """Loss and covariance of q (of any length, in the turned frame if one is given; NaN where nothing is observable), packed
    with batch axes first.

    covariance: the solver's own instead of Wahba's, rad^2; used: the directions the solver looked at instead of all.
    """
    xp = d.xp
    q = unit(q, xp)
    R = matrix_of_quaternion(q)
    R = R if frame is None else frame.columns(R)
    misfit = []
    for w, b, r in zip(d.w, d.b, d.r, strict=True):
        e = subtract(b, apply(R, r))
        misfit.append(w * dot(e, e))
    loss = 0.5 * d.total * total(misfit)
    if covariance is None:
        u = d if used is None else used
        C, det, _ = information(u.w, u.r)
        det = det * u.total
        xx, xy, xz, yy, yz, zz = (C[j][k] / det for j, k in UPPER)
        C = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        A = [apply(C, row) for row in R]  # the fitted directions' own is R C R^T
        xx, xy, xz, yy, yz, zz = (dot(A[j], R[k]) for j, k in UPPER)
    else:
        nan = 0.0 * q[3]
        xx, xy, xz, yy, yz, zz = (covariance[j][k] + nan for j, k in UPPER)
    P = pack([xx, xy, xz, xy, yy, yz, xz, yz, zz], xp)
    q = q if frame is None else frame.back(q, xp)
    return WahbaSolution(pack(list(q), xp), P.reshape(*P.shape[:-1], 3, 3), loss, loss < np.inf)


def pack(values: list[Any], xp: ModuleType) -> Any:
    """Components to the last axis."""
    shape = np.broadcast_shapes(*(np.shape(v) for v in values))
    return xp.stack([xp.broadcast_to(v, shape) for v in values], axis=-1)
