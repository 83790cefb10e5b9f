"""TRIAD and the optimized TRIAD: attitude from two of the directions.

TRIAD (Black 1964; Shuster and Oh 1981, eqs. (21)-(27)): the first direction is met exactly, the second in the plane of both.
Its covariance is its own (Shuster and Oh 1981, eq. (92)), with W the unit directions in B, 1 the one that is met:

    P = s1^2 I + [(s2^2 - s1^2) W1 W1^T + s1^2 (W1 . W2) (W1 W2^T + W2 W1^T)] / |W1 x W2|^2.

Optimized TRIAD (Bar-Itzhack and Harman 1997): the mean of the two TRIADs, weighted with 1/s1^2 and 1/s2^2, orthogonalised.
Both TRIADs share the normal of the plane, so the projection onto the rotations is a normalisation within the plane. Done
exactly, instead of by the paper's one iteration, it is Wahba's optimum of the two directions, with its covariance.

Of more than two directions the most accurate is the first, and the second is the one that leaves the least variance
(s1^2 + s2^2) / sin^2; in a tie the one that comes first. The loss counts all directions.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from .blocks import run
from .quest import optimum_of_two, plane
from .wahba import WahbaSolution


def triad(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """TRIAD, with its own covariance. Arguments as for `davenport`."""
    return run(_triad, b, r, sigma, mask, weights)


def triad_optimised(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """The optimized TRIAD, with the covariance of Wahba's optimum for its two directions. Arguments as for `davenport`."""
    return run(_triad_optimised, b, r, sigma, mask, weights)


def _triad(d: c.Directions) -> WahbaSolution:
    xp, u = d.xp, _best_two(d)
    normal_b, normal_r = plane(u.b, xp)[0], plane(u.r, xp)[0]
    q = c.quaternion_of_rows(c.triads(normal_b, u.b[0], normal_r, u.r[0]), xp)
    W1, W2 = u.b
    n = c.cross(W1, W2)
    inverse = 1.0 / c.dot(n, n)
    s1, s2 = 1.0 / (u.w[0] * u.total), 1.0 / (u.w[1] * u.total)
    along, across = (s2 - s1) * inverse, s1 * c.dot(W1, W2) * inverse
    P = [[along * W1[j] * W1[k] + across * (W1[j] * W2[k] + W2[j] * W1[k]) for k in range(3)] for j in range(3)]
    for j in range(3):
        P[j][j] = P[j][j] + s1
    q = c.only(_seen(d, u), q, xp)
    return c.conclude(d, q, covariance=(tuple(P[0]), tuple(P[1]), tuple(P[2])))  # rows of three, built in loops  # type: ignore[arg-type]


def _triad_optimised(d: c.Directions) -> WahbaSolution:
    u = _best_two(d)
    return c.conclude(d, c.only(_seen(d, u), optimum_of_two(u), d.xp), used=u)


def _seen(d: c.Directions, u: c.Directions) -> Any:
    """Whether the two directions fix the attitude; a NaN among the others counts, as for every solver."""
    squares = c.total([c.dot(b, b) + c.dot(r, r) for b, r in zip(d.b, d.r, strict=True)])
    return c.observable(u) & (squares > 0)


def _best_two(d: c.Directions) -> c.Directions:
    """The most accurate direction and the one that leaves the least variance beside it."""
    xp = d.xp
    b1, r1, w1 = d.b[0], d.r[0], d.w[0]
    for b, r, w in zip(d.b[1:], d.r[1:], d.w[1:], strict=True):
        better = w > w1
        b1, r1 = _either(better, b, b1, xp), _either(better, r, r1, xp)
        w1 = xp.where(better, w, w1)
    best = -xp.ones_like(w1)
    b2, r2, w2 = d.b[-1], d.r[-1], d.w[-1]
    for b, r, w in zip(d.b, d.r, d.w, strict=True):
        n, m = c.cross(b1, b), c.cross(r1, r)
        merit = c.dot(n, n) * c.dot(m, m) * w / (w + w1)  # the first itself has none
        better = merit > best
        best = xp.where(better, merit, best)
        b2, r2 = _either(better, b, b2, xp), _either(better, r, r2, xp)
        w2 = xp.where(better, w, w2)
    share = 1.0 / (w1 + w2)
    return d._replace(b=[b1, b2], r=[r1, r2], w=[w1 * share, w2 * share], total=d.total * (w1 + w2))


def _either(condition: Any, u: c.Vector, v: c.Vector, xp: Any) -> c.Vector:
    """u where the condition holds, v elsewhere."""
    return xp.where(condition, u[0], v[0]), xp.where(condition, u[1], v[1]), xp.where(condition, u[2], v[2])
