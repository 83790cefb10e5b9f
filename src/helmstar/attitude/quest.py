"""QUEST: Newton on the characteristic equation, the vector from the best of four rotated frames; closed form for two.

QUEST (Shuster and Oh 1981). K's largest eigenvalue lam is the root of its characteristic polynomial next below the sum of
weights, where Newton starts. With weights of sum 1, lam = 1 - loss, and the polynomial is, with fewer cancellations than
in QUEST's coefficients (Markley 1993, FOAM, eq. (22)),

    (lam^2 - |B|^2)^2 - 8 lam det B - 4 |adj B|^2 = 0.

The vector (eqs. (68)-(70)): with S = B + B^T, s = tr B, z = sum a_i r_i x b_i (Hamilton),

    alpha = lam^2 - s^2 + tr adj S,  beta = lam - s,  gamma = (lam + s) alpha - det S,
    q = [(alpha I + beta S + S S) z, gamma] / norm.

gamma is proportional to the square of q's last element and vanishes at 180 deg. Turning the reference by 180 deg about one
of its axes exchanges the elements; the frame of the largest gamma of all four is taken.

Two directions (Shuster and Oh 1981, eqs. (72)-(75); Markley 2002): the plane of r is turned into the plane of b, and in it
an angle from tan = a_2 sin(d) / (a_1 + a_2 cos(d)), d the difference of the two separations.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from . import optimum as o
from .blocks import run
from .wahba import WahbaSolution


def quest(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """QUEST with sequential rotations, polished by Newton on the loss; the closed form where n is two.

    Arguments as for `davenport`.
    """
    return run(_quest, b, r, sigma, mask, weights)


def _quest(d: c.Directions) -> WahbaSolution:
    if len(d.b) == 2:
        return _two(d)
    xp, B = d.xp, c.profile(d)
    polynomial = o.characteristic(B, d)
    lam = polynomial.newton(d.xp.ones_like(polynomial.size), 1)
    k = c.largest(o.squares(o.davenport_matrix(B), lam, polynomial.slope(lam)), xp)
    lam = polynomial.newton(lam, o.NEWTON_STEPS)
    frame = c.turn(k, d.dtype, xp)
    A = frame.columns(B)
    s = A[0][0] + A[1][1] + A[2][2]
    z = (A[2][1] - A[1][2], A[0][2] - A[2][0], A[1][0] - A[0][1])
    xy, xz, yz = A[0][1] + A[1][0], A[0][2] + A[2][0], A[1][2] + A[2][1]
    S = ((2.0 * A[0][0], xy, xz), (xy, 2.0 * A[1][1], yz), (xz, yz, 2.0 * A[2][2]))
    adj = c.cofactors(S)
    alpha = lam * lam - s * s + adj[0][0] + adj[1][1] + adj[2][2]
    beta = lam - s
    gamma = (lam + s) * alpha - c.dot(S[0], adj[0])
    Sz = c.apply(S, z)
    x = c.add(c.scale(alpha, z), c.add(c.scale(beta, Sz), c.apply(S, Sz)))
    q = c.only(c.observable(d, polynomial.gap(lam)), (*x, gamma), xp)
    return c.conclude(d, o.polish(d, B, q, frame), frame)


def quest_two(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """The closed form for two directions, which keeps its digits however close they are.

    Arguments as for `davenport`, n = 2. Raises ValueError for another n.
    """
    return run(_two, b, r, sigma, mask, weights)


def _two(d: c.Directions) -> WahbaSolution:
    if len(d.b) != 2:
        raise ValueError(f"n {len(d.b)}: must be 2 for quest_two; quest takes any number")
    xp = d.xp
    q = optimum_of_two(d)
    return c.conclude(d, c.only(c.observable(d), q, xp))


def optimum_of_two(d: c.Directions) -> c.Quaternion:
    """q_BN of Wahba's optimum for two directions."""
    xp = d.xp
    normal_b, cos_b, sin_b = plane(d.b, xp)
    normal_r, cos_r, sin_r = plane(d.r, xp)
    y = d.w[1] * (sin_b * cos_r - cos_b * sin_r)
    x = d.w[0] + d.w[1] * (cos_b * cos_r + sin_b * sin_r)
    lam = xp.sqrt(x * x + y * y)
    x, y = x / lam, y / lam
    first = c.add(c.scale(x, d.b[0]), c.scale(y, c.cross(normal_b, d.b[0])))
    return c.quaternion_of_rows(c.triads(normal_b, first, normal_r, d.r[0]), xp)


def plane(v: list[c.Vector], xp: Any) -> tuple[c.Vector, Any, Any]:
    """Unit normal of two directions, cosine and sine of their separation."""
    n = c.cross(v[0], v[1])
    sine = xp.sqrt(c.dot(n, n))
    return c.scale(1.0 / sine, n), c.dot(v[0], v[1]), sine
