"""ESOQ and ESOQ2 (Mortari 1997, 2000): the eigenvector of K from its adjugate, or as a principal axis and angle.

ESOQ: each column of adj(lam I - K) is q times one of its elements; the column with the largest diagonal is taken (the
four-dimensional cross product of the other three rows).

ESOQ2: with S = B + B^T, s = tr B, z = sum a_i r_i x b_i the axis e is the null vector of
M = (lam - s) [(lam + s) I - S] - z z^T (Mortari 2000; Markley and Mortari 2000, eq. (59)), the longest cross product of two of its
rows, and q = [(lam - s) e, z . e] / norm. It loses the axis of small turns, lam - s -> 0; the reference is turned by 180 deg
about the axis that makes s least.

Where the worst axis has less than 1e-11 of the weight, ESOQ's minors lose it, and its attitude can be off by its own sigma.

lam is QUEST's: Newton from the sum of the weights. A start at anything else, such as 1 with weights of another sum, descends
to another root.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from . import optimum as o
from .blocks import run
from .wahba import WahbaSolution


def esoq(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """ESOQ, polished by Newton on the loss. Arguments as for `davenport`."""
    return run(_esoq, b, r, sigma, mask, weights)


def _esoq(d: c.Directions) -> WahbaSolution:
    xp, B = d.xp, c.profile(d)
    polynomial = o.characteristic(B, d)
    lam = polynomial.newton(d.xp.ones_like(polynomial.size), 1 + o.NEWTON_STEPS)
    xx, xy, xz, xw, yy, yz, yw, zz, zw, ww = o.davenport_matrix(B)
    xx, yy, zz, ww = xx - lam, yy - lam, zz - lam, ww - lam
    # Two by two minors of the first and of the last two rows.
    s0, s1, s2 = xx * yy - xy * xy, xx * yz - xy * xz, xx * yw - xy * xw
    s3, s4, s5 = xy * yz - yy * xz, xy * yw - yy * xw, xz * yw - yz * xw
    c5, c4, c3 = zz * ww - zw * zw, yz * ww - yw * zw, yz * zw - yw * zz
    c2, c1 = xz * ww - xw * zw, xz * zw - xw * zz
    a00 = yy * c5 - yz * c4 + yw * c3
    a01 = xz * c4 - xy * c5 - xw * c3
    a02 = yw * s5 - zw * s4 + ww * s3
    a03 = zz * s4 - yz * s5 - zw * s3
    a11 = xx * c5 - xz * c2 + xw * c1
    a12 = zw * s2 - xw * s5 - ww * s1
    a13 = xz * s5 - zz * s2 + zw * s1
    a22 = xw * s4 - yw * s2 + ww * s0
    a23 = yz * s2 - xz * s4 - zw * s0
    a33 = xz * s3 - yz * s1 + zz * s0
    slope = -polynomial.slope(lam)  # adj(K - lam I) is of odd degree
    k = c.largest((a00 / slope, a11 / slope, a22 / slope, a33 / slope), xp)
    rows = ((a00, a01, a02, a03), (a01, a11, a12, a13), (a02, a12, a22, a23), (a03, a13, a23, a33))
    x, y, z, w = (c.choose(k, row, xp) for row in rows)
    q = c.only(c.observable(d, polynomial.gap(lam)), (x, y, z, w), xp)
    return c.conclude(d, o.polish(d, B, q))


def esoq2(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """ESOQ2 with a turned reference, polished by Newton on the loss. Arguments as for `davenport`."""
    return run(_esoq2, b, r, sigma, mask, weights)


def _esoq2(d: c.Directions) -> WahbaSolution:
    xp, B = d.xp, c.profile(d)
    polynomial = o.characteristic(B, d)
    lam = polynomial.newton(d.xp.ones_like(polynomial.size), 1 + o.NEWTON_STEPS)
    K = o.davenport_matrix(B)
    frame = c.turn(c.largest((-K[0], -K[4], -K[7], -K[9]), xp), d.dtype, xp)
    A = frame.columns(B)
    s = A[0][0] + A[1][1] + A[2][2]
    z = (A[2][1] - A[1][2], A[0][2] - A[2][0], A[1][0] - A[0][1])
    f, p = lam - s, lam + s
    xx, yy, zz = (f * (p - 2.0 * A[i][i]) - z[i] * z[i] for i in range(3))
    xy = -f * (A[0][1] + A[1][0]) - z[0] * z[1]
    xz = -f * (A[0][2] + A[2][0]) - z[0] * z[2]
    yz = -f * (A[1][2] + A[2][1]) - z[1] * z[2]
    C = c.cofactors(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    y_best, z_best = C[1][1] > C[0][0], C[2][2] > xp.maximum(C[0][0], C[1][1])
    x, y, w = (xp.where(z_best, C[2][j], xp.where(y_best, C[1][j], C[0][j])) for j in range(3))
    q = c.only(c.observable(d, polynomial.gap(lam)), (f * x, f * y, f * w, c.dot(z, (x, y, w))), xp)
    return c.conclude(d, o.polish(d, B, q, frame), frame)
