"""What the optimal solvers share: K, the root of its characteristic polynomial, and the last digits of an attitude."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from . import components as c


def davenport_matrix(B: c.Matrix) -> tuple[Any, ...]:
    """Upper triangle of K, rows first: xx, xy, xz, xw, yy, yz, yw, zz, zw, ww; trace 0; z = sum w r x b (Hamilton)."""
    x, y, z = B[0][0], B[1][1], B[2][2]
    return (
        x - y - z, B[0][1] + B[1][0], B[0][2] + B[2][0], B[2][1] - B[1][2],
        y - x - z, B[1][2] + B[2][1], B[0][2] - B[2][0],
        z - x - y, B[1][0] - B[0][1],
        x + y + z,
    )  # fmt: skip


def squares(K: tuple[Any, ...], lam: Any, slope: Any) -> tuple[Any, Any, Any, Any]:
    """x^2, y^2, z^2, w^2 of K's eigenvector of the eigenvalue lam: the diagonal of adj(lam I - K) over its trace.

    The last minor is gamma = det[(lam + s) I - S] of QUEST, the others those of the turned frames."""
    xx, xy, xz, xw, yy, yz, yw, zz, zw, ww = K
    a, b, c, e = lam - xx, lam - yy, lam - zz, lam - ww

    def det(p: Any, q: Any, s: Any, u: Any, v: Any, t: Any) -> Any:
        """Of [[p, -u, -v], [-u, q, -t], [-v, -t, s]]."""
        return p * (q * s - t * t) - u * (u * s + t * v) - v * (u * t + q * v)

    x2, y2 = det(b, c, e, yz, yw, zw), det(a, c, e, xz, xw, zw)
    z2, w2 = det(a, b, e, xy, xw, yw), det(a, b, c, xy, xz, yz)
    return x2 / slope, y2 / slope, z2 / slope, w2 / slope


def repeat(steps: int, step: Callable[[Any], Any], value: Any, xp: ModuleType) -> Any:
    """step applied so many times. A loop in XLA too, whose ends it does not fuse across: unrolled, it would compute what the
    steps share again for every output (measured: five times the arithmetic)."""
    if xp is np:
        for _ in range(steps):
            value = step(value)
        return value
    from ..backend import jax

    return jax.lax.fori_loop(0, steps, lambda _, v: step(v), value)


NEWTON_STEPS = 23
"""Three suffice for noise up to some degrees. The rest is for directions that contradict each other: towards a threefold root
an error shrinks by a third only, and 24 steps take it well below AMBIGUITY."""


class Characteristic(NamedTuple):
    """K's characteristic polynomial (lam^2 - |B|^2)^2 - 8 lam det B - 4 |adj B|^2, weights of sum 1 (Markley 1993, eq. (22))."""

    size: Any
    det: Any
    adjoint: Any
    dtype: np.dtype
    xp: ModuleType

    def newton(self, lam: Any, steps: int) -> Any:
        """lam after so many steps towards the largest root from above.

        The polynomial is known to some 8 eps. Newton stops there: a further step would divide rounding by a slope that
        vanishes with the square of the directions' spread, where the starting value 1 is the better answer.
        """
        noise = 16.0 * float(np.finfo(self.dtype).eps)
        xp = self.xp

        def step(lam: Any) -> Any:
            h = lam * lam - self.size
            p = h * h - 8.0 * lam * self.det - 4.0 * self.adjoint
            slope = 4.0 * lam * h - 8.0 * self.det
            return lam - xp.where((p > noise) & (slope > 0), p / slope, xp.zeros_like(p))

        return step(lam) if steps == 1 else repeat(steps, step, lam, xp)

    def slope(self, lam: Any) -> Any:
        """Derivative at the root lam: the product of its distances from the three others, and the trace of adj(lam I - K)."""
        return 4.0 * lam * (lam * lam - self.size) - 8.0 * self.det

    def gap(self, lam: Any) -> Any:
        """Distance of the next root from the root lam, if that is much nearer than the others: the slope over the sum of the
        products of two of the distances."""
        return self.slope(lam) / (6.0 * lam * lam - 2.0 * self.size)


def characteristic(B: c.Matrix, d: c.Directions) -> Characteristic:
    """The polynomial's coefficients."""
    C = c.cofactors(B)
    size, adjoint = (c.total([c.dot(row, row) for row in A]) for A in (B, C))
    return Characteristic(size, c.dot(B[0], C[0]), adjoint, d.dtype, d.xp)


POLISHING_STEPS = 2
"""Each squares the error; one leaves up to a microradian for directions within 0.01 deg."""


def polish(d: c.Directions, B: c.Matrix, q: c.Quaternion, frame: c.Turn | None = None) -> c.Quaternion:
    """Newton on Wahba's loss from q, an eigenvector of K found to some digits, in the turned frame if one is given.

    A polynomial's root and the vectors built on it lose digits with the square of the directions' spread. The gradient
    sum w f x (b - f) about the fitted directions f = R r does not: b - f is exact, so what is left is the rounding of the
    directions over their spread, the least possible.

    Hessian: tr(B R^T) I - sym(B R^T). The step is taken where it is not positive, too: with weights far apart that is so beside
    the valley's floor, and it leads back there.
    """
    xp = d.xp

    def step(q: c.Quaternion) -> c.Quaternion:
        q = c.unit(q, xp)
        R = c.matrix_of_quaternion(q)
        R = R if frame is None else frame.columns(R)
        terms = []
        for w, b, r in zip(d.w, d.b, d.r, strict=True):
            f = c.apply(R, r)
            terms.append(c.scale(w, c.cross(f, c.subtract(b, f))))
        g = (c.total([t[0] for t in terms]), c.total([t[1] for t in terms]), c.total([t[2] for t in terms]))
        A = (c.apply(R, B[0]), c.apply(R, B[1]), c.apply(R, B[2]))  # B R^T
        xy, xz, yz = -0.5 * (A[0][1] + A[1][0]), -0.5 * (A[0][2] + A[2][0]), -0.5 * (A[1][2] + A[2][1])
        H = ((A[1][1] + A[2][2], xy, xz), (xy, A[0][0] + A[2][2], yz), (xz, yz, A[0][0] + A[1][1]))
        adj = c.cofactors(H)
        twice = 2.0 * c.dot(H[0], adj[0])
        u = (c.dot(adj[0], g) / twice, c.dot(adj[1], g) / twice, c.dot(adj[2], g) / twice)
        x, y, z, w = q
        v = c.cross(u, (x, y, z))
        return x + w * u[0] + v[0], y + w * u[1] + v[1], z + w * u[2] + v[2], w - c.dot(u, (x, y, z))

    return repeat(POLISHING_STEPS, step, q, xp)
