"""Wahba's problem by Davenport's q-method and by the singular value decomposition, each with its covariance.

Minimise L(R) = 1/2 sum a_i |b_i - R r_i|^2 over rotations, a_i = 1 / sigma_i^2, with b_i measured in B and r_i known in N.
With B = sum a_i b_i r_i^T the loss is sum a_i - tr(R B^T).

- Davenport (Shuster and Oh 1981; Markley and Crassidis 2014, eqs. (5.16)-(5.19)): q_BN is the eigenvector of the largest
  eigenvalue of K = [[S - s I, z], [z^T, s]], S = B + B^T, s = tr B. In Hamilton's convention, scalar last, with
  to_matrix(q_BN) = R_BN, z = sum a_i r_i x b_i.
- SVD (Markley 1988): B = U diag(s) V^T, R = U diag(1, 1, det U det V) V^T.

Covariance, for the error on the left (R_BN = exp([theta x]) R_hat, theta in B; Shuster and Oh 1981, eq. (97)):
P = [sum a_i (I - b_i b_i^T)]^-1.

One source for NumPy and JAX arrays: arrays in, arrays of the same kind out; with NumPy, JAX is never imported. Leading
axes are batch axes.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

OBSERVABLE_SINE = 1e-6
"""Directions within this angle (rad) of one line leave the turn about it unknown, in float64."""


class WahbaSolution(NamedTuple):
    """q_BN (..., 4) scalar last; covariance (..., 3, 3) of the error on the left, rad^2 in B; loss (...,), half a
    chi-square with 2 n - 3 degrees of freedom when sigma is right; observable (...,) False where fewer than two
    directions differ: then attitude, covariance and loss are NaN."""

    q_BN: Any
    covariance: Any
    loss: Any
    observable: Any


def _namespace(*arrays: Any) -> ModuleType:
    """jax.numpy if any argument is a JAX array (then JAX is imported already), numpy otherwise."""
    if "jax" in sys.modules:
        import jax

        if any(isinstance(a, jax.Array) for a in arrays):
            from ..backend import jnp

            return jnp
    return np


def _prepare(b: Any, r: Any, sigma: Any, mask: Any, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Unit directions and weights 1/sigma^2 with the masked entries replaced before any arithmetic."""
    b, r = xp.asarray(b), xp.asarray(r)
    if b.ndim < 2 or r.ndim < 2 or b.shape[-1] != 3 or r.shape[-1] != 3 or b.shape[-2] != r.shape[-2]:
        raise ValueError(f"b {b.shape} and r {r.shape}: must be (..., n, 3) with the same n")
    n = b.shape[-2]
    mask = xp.ones(n, dtype=bool) if mask is None else xp.asarray(mask)
    for name, shape in (("mask", mask.shape), ("sigma", np.shape(sigma) or (n,))):
        if shape[-1:] != (n,):
            raise ValueError(f"{name} {shape}: must have one entry for each of the {n} directions")
    axis = xp.asarray([1.0, 0.0, 0.0], dtype=b.dtype)
    b, r = (xp.where(mask[..., None], v, axis) for v in (b, r))
    b, r = (v / xp.sqrt(xp.sum(v * v, axis=-1, keepdims=True)) for v in (b, r))
    weight = xp.broadcast_to(1.0 / xp.asarray(sigma, dtype=b.dtype) ** 2, mask.shape)
    return b, r, xp.where(mask, weight, xp.zeros_like(weight))


def quaternion_of_matrix(R: Any) -> Any:
    """q_BN (..., 4) of R_BN (..., 3, 3): the column of 4 q q^T with the largest diagonal, normalised."""
    xp = _namespace(R)
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    rows = [
        [1 + d0 - d1 - d2, xy, xz, x],
        [xy, 1 - d0 + d1 - d2, yz, y],
        [xz, yz, 1 - d0 - d1 + d2, z],
        [x, y, z, 1 + d0 + d1 + d2],
    ]
    K = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    best = xp.argmax(xp.stack([K[..., i, i] for i in range(4)], axis=-1), axis=-1)
    q = xp.take_along_axis(K, best[..., None, None], axis=-2)[..., 0, :]
    return q / xp.sqrt(xp.sum(q * q, axis=-1, keepdims=True))


def _share(a: Any, xp: ModuleType) -> Any:
    """Weights over the largest: their scale does not change the attitude. All zero (nothing present) stay zero."""
    largest = xp.max(a, axis=-1, keepdims=True)
    return a / xp.where(largest > 0, largest, xp.ones_like(largest))


def _finish(q: Any, b: Any, r: Any, a: Any, xp: ModuleType) -> WahbaSolution:
    """Covariance, loss and observability of a solution, by closed forms that need no further decomposition."""
    u, w = q[..., None, :3], q[..., None, 3:]
    t = 2.0 * xp.cross(xp.broadcast_to(u, r.shape), r)
    fitted = r + w * t + xp.cross(xp.broadcast_to(u, r.shape), t)
    loss = 0.5 * xp.sum(a * xp.sum((b - fitted) ** 2, axis=-1), axis=-1)
    total = xp.sum(a, axis=-1)
    eye = xp.eye(3, dtype=b.dtype)
    M = total[..., None, None] * eye - xp.einsum("...n,...ni,...nj->...ij", a, fitted, fitted)
    # Cofactors: M is 3x3, symmetric and semidefinite. Its middle eigenvalue is at least half its trace's excess, so the
    # smallest one, which says whether the turn about the common line is known, is det / (product of the other two).
    c = xp.stack([xp.cross(M[..., (i + 1) % 3, :], M[..., (i + 2) % 3, :]) for i in range(3)], axis=-2)
    det = xp.sum(M[..., 0, :] * c[..., 0, :], axis=-1)
    second = xp.trace(c, axis1=-2, axis2=-1)  # sum of products of two eigenvalues
    smallest = det / xp.where(second > 0, second, xp.ones_like(second))
    eps = xp.finfo(b.dtype).eps
    threshold = xp.maximum(xp.asarray(OBSERVABLE_SINE**2, dtype=b.dtype), xp.asarray(32 * eps, dtype=b.dtype))
    finite = xp.isfinite(loss) & xp.isfinite(det)
    observable = finite & (second > 0) & (smallest > threshold * total)
    safe = xp.where(observable, det, xp.ones_like(det))
    nan = xp.asarray(xp.nan, dtype=b.dtype)
    covariance = xp.where(observable[..., None, None], c / safe[..., None, None], nan)
    return WahbaSolution(
        xp.where(observable[..., None], q, nan), covariance, xp.where(observable, loss, nan), observable
    )


def davenport(b: Any, r: Any, sigma: Any = 1.0, mask: Any = None) -> WahbaSolution:
    """Davenport's q-method.

    b (..., n, 3) directions in B, r (..., n, 3) the same in N (normalised here), sigma (n,) or scalar in rad per
    component, mask (..., n) True where a direction is present. Raises ValueError for shapes that do not fit.
    """
    xp = _namespace(b, r, sigma, mask)
    b, r, a = _prepare(b, r, sigma, mask, xp)
    share = _share(a, xp)
    Bm = xp.einsum("...n,...ni,...nj->...ij", share, b, r)
    s = xp.trace(Bm, axis1=-2, axis2=-1)
    z = xp.sum(share[..., None] * xp.cross(r, b), axis=-2)
    S = Bm + xp.swapaxes(Bm, -1, -2) - s[..., None, None] * xp.eye(3, dtype=b.dtype)
    top = xp.concatenate([S, z[..., :, None]], axis=-1)
    bottom = xp.concatenate([z, s[..., None]], axis=-1)[..., None, :]
    K = xp.concatenate([top, bottom], axis=-2)
    ok = xp.all(xp.isfinite(K), axis=(-2, -1))
    _, vectors = xp.linalg.eigh(xp.where(ok[..., None, None], K, xp.zeros_like(K)))
    q = xp.where(ok[..., None], vectors[..., :, -1], xp.asarray(xp.nan, dtype=b.dtype))
    return _finish(q, b, r, a, xp)


def svd(b: Any, r: Any, sigma: Any = 1.0, mask: Any = None) -> WahbaSolution:
    """Markley's SVD method; arguments as for `davenport`."""
    xp = _namespace(b, r, sigma, mask)
    b, r, a = _prepare(b, r, sigma, mask, xp)
    share = _share(a, xp)
    Bm = xp.einsum("...n,...ni,...nj->...ij", share, b, r)
    ok = xp.all(xp.isfinite(Bm), axis=(-2, -1))
    U, _, Vt = xp.linalg.svd(xp.where(ok[..., None, None], Bm, xp.zeros_like(Bm)))
    sign = xp.sign(xp.linalg.det(U) * xp.linalg.det(Vt))
    R = xp.concatenate([U[..., :, :2], U[..., :, 2:] * sign[..., None, None]], axis=-1) @ Vt
    q = xp.where(ok[..., None], quaternion_of_matrix(R), xp.asarray(xp.nan, dtype=b.dtype))
    return _finish(q, b, r, a, xp)
