"""OLAE, the optimal linear attitude estimator (Mortari, Markley and Singla 2007), with sequential rotations.

By Cayley's transform b = R r is linear in the Gibbs vector g = q_xyz / q_w: b - r = g x (b + r). With d = b - r, s = b + r the
weighted least squares are (eqs. (15)-(18), in Hamilton's convention)

    [sum a_i (s_i^2 I - s_i s_i^T)] g = sum a_i s_i x d_i.

g is infinite at 180 deg. The reference is turned by 180 deg about the axis, or not, that leaves q_w largest; then |g|^2 <= 3.

Its criterion is not Wahba's: noise e of b enters as (I - [g x]) e, larger across g than along it, so directions of equal sigma
do not count equally. The covariance is that of this estimator: with N the matrix above, J = 2 (I + [g x]) N^-1 / (1 + g^2),

    P = J sum a_i [(1 + g^2)(s_i^2 I - s_i s_i^T) - (s_i x g)(s_i x g)^T - v_i v_i^T] J^T,  v_i = s_i x (b_i - g x b_i),

never below Wahba's to first order, and some percent above it where the sigmas differ. For the same reason the attitude
depends, within its noise, on the axes that B and N are written in.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from . import optimum as o
from .blocks import run
from .wahba import WahbaSolution


def olae(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """OLAE, with its own covariance. Arguments as for `davenport`."""
    return run(_olae, b, r, sigma, mask, weights)


def _olae(d: c.Directions) -> WahbaSolution:
    xp = d.xp
    B = c.profile(d)
    polynomial = o.characteristic(B, d)
    lam = polynomial.newton(xp.ones_like(polynomial.size), 1 + o.NEWTON_STEPS)
    k = c.largest(o.squares(o.davenport_matrix(B), lam, polynomial.slope(lam)), xp)
    frame = c.turn(k, d.dtype, xp)
    turned = [(frame.signs[0] * r[0], frame.signs[1] * r[1], frame.signs[2] * r[2]) for r in d.r]
    sums = [c.add(b, r) for b, r in zip(d.b, turned, strict=True)]
    N = _normal(d.w, sums)
    terms = [c.scale(w, c.cross(s, c.subtract(b, r))) for w, b, r, s in zip(d.w, d.b, turned, sums, strict=True)]
    y = (c.total([t[0] for t in terms]), c.total([t[1] for t in terms]), c.total([t[2] for t in terms]))
    C = c.cofactors(N)
    det = c.dot(N[0], C[0])
    inverse_N = tuple((row[0] / det, row[1] / det, row[2] / det) for row in C)
    g = (c.dot(C[0], y) / det, c.dot(C[1], y) / det, c.dot(C[2], y) / det)
    # P = J Q J^T; rows of J: 2 / (1 + g^2) (I + [g x]) N^-1, whose columns are those of N^-1 (symmetric) plus g x them.
    one = 1.0 + c.dot(g, g)
    columns = [c.scale(2.0 / one, c.add(v, c.cross(g, v))) for v in inverse_N]
    J = [(columns[0][j], columns[1][j], columns[2][j]) for j in range(3)]
    Q = [[one * N[j][k] for k in range(3)] for j in range(3)]
    for w, b, s in zip(d.w, d.b, sums, strict=True):
        u, v = c.cross(s, g), c.cross(s, c.subtract(b, c.cross(g, b)))
        for j in range(3):
            for m in range(j, 3):
                Q[j][m] = Q[j][m] - w * (u[j] * u[m] + v[j] * v[m])
    xx, xy, xz, yy, yz, zz = (Q[j][m] / d.total for j, m in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    Q = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    P = []
    for j in range(3):
        row = c.apply(Q, J[j])
        P.append((c.dot(J[0], row), c.dot(J[1], row), c.dot(J[2], row)))
    q = c.only(c.observable(d, polynomial.gap(lam)), (*g, xp.ones_like(g[0])), xp)
    return c.conclude(d, q, frame, covariance=(P[0], P[1], P[2]))


def _normal(w: list[Any], v: list[c.Vector]) -> c.Matrix:
    """sum w (v^2 I - v v^T)."""
    xx, xy, xz, yy, yz, zz = c.outer_sum(w, v)
    return (yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy)
