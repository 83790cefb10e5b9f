"""Wahba's problem by LAPACK: Davenport's q-method and the singular value decomposition.

- Davenport (Shuster and Oh 1981; Markley and Crassidis 2014, eqs. (5.16)-(5.19)): q_BN is the eigenvector of the largest
  eigenvalue of K = [[S - s I, z], [z^T, s]], S = B + B^T, s = tr B. In Hamilton's convention, scalar last, with
  to_matrix(q_BN) = R_BN, z = sum a_i r_i x b_i.
- SVD (Markley 1988): B = U diag(s) V^T, R = U diag(1, 1, det U det V) V^T.

Both are backward stable for any number of directions, and the slowest of the room: one LAPACK call for each problem.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from .wahba import WahbaSolution, finish, namespace, prepare, quaternion_of_matrix


def _share(a: Any, xp: ModuleType) -> Any:
    """Weights over the largest: their scale does not change the attitude. All zero (nothing present) stay zero."""
    largest = xp.max(a, axis=-1, keepdims=True)
    return a / xp.where(largest > 0, largest, xp.ones_like(largest))


def _sum(share: Any, xp: ModuleType) -> Any:
    """Sum of the shares, 1 where nothing is present."""
    total = xp.sum(share, axis=-1)
    return xp.where(total > 0, total, xp.ones_like(total))


@np.errstate(all="ignore")
def davenport(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """Davenport's q-method.

    b (..., n, 3) directions in B, r (..., n, 3) the same in N (normalised here), sigma (n,), (..., n) or scalar in rad per
    component (1 when left out), mask (n,) or (..., n) True where a direction is present, weights instead of sigma: the
    a_i = 1/sigma_i^2, rad^-2. Raises ValueError for shapes that do not fit.
    """
    xp = namespace(b, r, sigma, mask, weights)
    b, r, a = prepare(b, r, sigma, mask, weights, xp)
    share = _share(a, xp)
    Bm = xp.einsum("...n,...ni,...nj->...ij", share, b, r)
    s = xp.trace(Bm, axis1=-2, axis2=-1)
    z = xp.sum(share[..., None] * xp.cross(r, b), axis=-2)
    S = Bm + xp.swapaxes(Bm, -1, -2) - s[..., None, None] * xp.eye(3, dtype=b.dtype)
    top = xp.concatenate([S, z[..., :, None]], axis=-1)
    bottom = xp.concatenate([z, s[..., None]], axis=-1)[..., None, :]
    K = xp.concatenate([top, bottom], axis=-2)
    ok = xp.all(xp.isfinite(K), axis=(-2, -1))
    values, vectors = xp.linalg.eigh(xp.where(ok[..., None, None], K, xp.zeros_like(K)))
    q = xp.where(ok[..., None], vectors[..., :, -1], xp.asarray(xp.nan, dtype=b.dtype))
    return finish(q, b, r, a, (values[..., -1] - values[..., -2]) / _sum(share, xp), xp)


@np.errstate(all="ignore")
def svd(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> WahbaSolution:
    """Markley's SVD method; arguments as for `davenport`."""
    xp = namespace(b, r, sigma, mask, weights)
    b, r, a = prepare(b, r, sigma, mask, weights, xp)
    share = _share(a, xp)
    Bm = xp.einsum("...n,...ni,...nj->...ij", share, b, r)
    ok = xp.all(xp.isfinite(Bm), axis=(-2, -1))
    U, values, Vt = xp.linalg.svd(xp.where(ok[..., None, None], Bm, xp.zeros_like(Bm)))
    sign = xp.sign(xp.linalg.det(U) * xp.linalg.det(Vt))
    R = xp.concatenate([U[..., :, :2], U[..., :, 2:] * sign[..., None, None]], axis=-1) @ Vt
    q = xp.where(ok[..., None], quaternion_of_matrix(R), xp.asarray(xp.nan, dtype=b.dtype))
    return finish(q, b, r, a, 2.0 * (values[..., 1] + sign * values[..., 2]) / _sum(share, xp), xp)
