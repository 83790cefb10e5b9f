"""FOAM, the fast optimal attitude matrix (Markley 1993): R_BN without a decomposition.

With B = sum a_i b_i r_i^T, lam as in QUEST, kappa = (lam^2 - |B|^2) / 2 and zeta = kappa lam - det B (eqs. (12)-(15)),

    R = [(kappa + |B|^2) B + lam adj(B^T) - B B^T B] / zeta.

No frame is singular, because a matrix needs none.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from . import optimum as o
from .blocks import run
from .wahba import WahbaSolution


def foam(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """FOAM, polished by one Newton step on the loss. Arguments as for `davenport`."""
    return run(_foam, b, r, sigma, mask, weights)


def _foam(d: c.Directions) -> WahbaSolution:
    B = c.profile(d)
    polynomial = o.characteristic(B, d)
    lam = polynomial.newton(d.xp.ones_like(polynomial.size), 1 + o.NEWTON_STEPS)
    first = 0.5 * (lam * lam + polynomial.size)
    C = c.cofactors(B)
    G = tuple(tuple(c.dot(B[i], B[j]) for j in range(3)) for i in range(3))  # B B^T
    zeta = 0.5 * lam * (lam * lam - polynomial.size) - polynomial.det
    rows = []
    for i in range(3):
        row = []
        for j in range(3):
            product = G[i][0] * B[0][j] + G[i][1] * B[1][j] + G[i][2] * B[2][j]
            row.append((first * B[i][j] + lam * C[i][j] - product) / zeta)
        rows.append(tuple(row))
    q = c.quaternion_of_rows((rows[0], rows[1], rows[2]), d.xp)
    q = c.only(c.observable(d, polynomial.gap(lam)), q, d.xp)
    return c.conclude(d, o.polish(d, B, q))
