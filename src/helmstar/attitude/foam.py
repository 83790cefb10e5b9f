"""FOAM, the fast optimal attitude matrix (Markley 1993): R_BN without a decomposition.

With B = sum a_i b_i r_i^T, lam as in QUEST, kappa = (lam^2 - |B|^2) / 2 and zeta = kappa lam - det B (eqs. (12)-(15)),

    R = [(kappa + |B|^2) B + lam adj(B^T) - B B^T B] / zeta.

No frame is singular, because a matrix needs none. An error of lam scales R along the singular vectors of B: R = U diag(f) V^T
with f off 1. The rotation U V^T in it is right; iterating R (3 I - R^T R) / 2 finds it.
"""

from __future__ import annotations

from typing import Any

from . import components as c
from . import optimum as o
from .blocks import run
from .wahba import WahbaSolution

ORTHOGONAL_STEPS = 3


def foam(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """FOAM, polished by Newton on the loss. Arguments as for `davenport`."""
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
    R = o.repeat(ORTHOGONAL_STEPS, _orthogonalise, (rows[0], rows[1], rows[2]), d.xp)
    q = c.only(c.observable(d, polynomial.gap(lam)), c.quaternion_of_rows(R, d.xp), d.xp)
    return c.conclude(d, o.polish(d, B, q))


def _orthogonalise(R: c.Matrix) -> c.Matrix:
    """R (3 I - R^T R) / 2 of R with a norm made that of a rotation."""
    size = c.total([c.dot(row, row) for row in R])
    columns = [(R[0][j], R[1][j], R[2][j]) for j in range(3)]
    half = 1.5 / size  # R^T R is to have the trace 3
    xx, xy, xz, yy, yz, zz = (
        half * c.dot(columns[j], columns[k]) for j, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    )
    M = ((1.5 - xx, -xy, -xz), (-xy, 1.5 - yy, -yz), (-xz, -yz, 1.5 - zz))
    return c.apply(M, R[0]), c.apply(M, R[1]), c.apply(M, R[2])
