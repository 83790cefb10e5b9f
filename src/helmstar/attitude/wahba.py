"""Wahba's problem: what a solution is, and what all solvers of this room share.

Minimise L(R) = 1/2 sum a_i |b_i - R r_i|^2 over rotations, a_i = 1 / sigma_i^2, with b_i measured in B and r_i known in N.
With B = sum a_i b_i r_i^T the loss is sum a_i - tr(R B^T).

Covariance, for the error on the left (R_BN = exp([theta x]) R_hat, theta in B; Shuster and Oh 1981, eq. (97)):
P = [sum a_i (I - b_i b_i^T)]^-1, with the fitted directions R r_i for b_i.

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

AMBIGUITY = 1e-3
"""Least curvature of the loss at its minimum over what the covariance says it is. They are equal for directions that agree;
where b and r contradict each other, as in a mirror image, the curvature vanishes, and many attitudes fit equally well."""


class WahbaSolution(NamedTuple):
    """q_BN (..., 4) scalar last; covariance (..., 3, 3) of the error on the left, rad^2 in B; loss (...,), half a
    chi-square with 2 n - 3 degrees of freedom when sigma is right; observable (...,) False where the data do not fix the
    attitude (`why_unobservable` says why): then attitude, covariance and loss are NaN."""

    q_BN: Any
    covariance: Any
    loss: Any
    observable: Any


def namespace(*arrays: Any) -> ModuleType:
    """jax.numpy if any argument is a JAX array (then JAX is imported already), numpy otherwise."""
    if "jax" in sys.modules:
        import jax

        if any(isinstance(a, jax.Array) for a in arrays):
            from ..backend import jnp

            return jnp
    return np


def real_type(b: Any, r: Any) -> np.dtype:
    """The floating type that a solver computes in: that of b and r, or float64 for whole numbers."""
    dtype = np.result_type(b.dtype, r.dtype)
    return dtype if np.issubdtype(dtype, np.floating) else np.dtype(float)


def accept(b: Any, r: Any, sigma: Any, mask: Any, weights: Any, xp: ModuleType) -> tuple[Any, Any, Any, Any]:
    """b, r (..., n, 3) as they came, weights a_i (..., n) with NaN for a sigma or weight that means nothing and 0 where the
    mask is False, and the mask (..., n). Raises ValueError for shapes that do not fit, and for sigma and weights at once."""
    b, r = xp.asarray(b), xp.asarray(r)
    if b.ndim < 2 or r.ndim < 2 or b.shape[-1] != 3 or r.shape[-1] != 3 or b.shape[-2] != r.shape[-2]:
        raise ValueError(f"b {b.shape} and r {r.shape}: must be (..., n, 3) with the same n")
    n = b.shape[-2]
    if sigma is not None and weights is not None:
        raise ValueError("sigma and weights: must be one or the other, a weight is 1/sigma^2")
    mask = xp.ones(n, dtype=bool) if mask is None else xp.asarray(mask)
    per_vector = (("sigma", sigma), ("weights", weights))
    shapes = [("mask", mask.shape or (0,))] + [(name, np.shape(v) or (n,)) for name, v in per_vector if v is not None]
    for name, shape in shapes:
        if shape[-1] != n:
            raise ValueError(f"{name} {shape}: must have one entry for each of the {n} directions")
    dtype = real_type(b, r)
    nan = xp.asarray(np.nan, dtype=dtype)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if weights is None:
            sigma = xp.asarray(1.0 if sigma is None else sigma, dtype=dtype)
            a = xp.where(sigma > 0, 1.0 / sigma**2, nan)
        else:
            a = xp.asarray(weights, dtype=dtype)
            a = xp.where(a >= 0, a, nan)
    shape = np.broadcast_shapes(a.shape, mask.shape)
    return b, r, xp.where(mask, xp.broadcast_to(a, shape), xp.zeros_like(a)), mask


def prepare(b: Any, r: Any, sigma: Any, mask: Any, weights: Any, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Unit directions and weights 1/sigma^2 with the masked entries replaced before any arithmetic."""
    b, r, a, mask = accept(b, r, sigma, mask, weights, xp)
    if b.shape != r.shape:
        b, r = xp.broadcast_arrays(b, r)
    axis = xp.asarray([1.0, 0.0, 0.0], dtype=b.dtype)
    b, r = (xp.where(mask[..., None], v, axis) for v in (b, r))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        b, r = (v / xp.sqrt(xp.sum(v * v, axis=-1, keepdims=True)) for v in (b, r))
    return b, r, a


def quaternion_of_matrix(R: Any) -> Any:
    """q_BN (..., 4) of R_BN (..., 3, 3): the column of 4 q q^T with the largest diagonal, normalised."""
    xp = namespace(R)
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


def threshold(dtype: Any) -> float:
    """Least share of the total weight, by which the turn about the worst axis must be known to count as observable."""
    return max(OBSERVABLE_SINE**2, 32 * float(np.finfo(dtype).eps))


def finish(q: Any, b: Any, r: Any, a: Any, gap: Any, xp: ModuleType) -> WahbaSolution:
    """Covariance, loss and observability of a solution, by closed forms that need no further decomposition.

    gap (...,): distance of K's two largest eigenvalues over the sum of weights. It vanishes when more than one attitude
    minimises the loss.
    """
    u, w = q[..., None, :3], q[..., None, 3:]
    t = 2.0 * xp.cross(xp.broadcast_to(u, r.shape), r)
    fitted = r + w * t + xp.cross(xp.broadcast_to(u, r.shape), t)
    loss = 0.5 * xp.sum(a * xp.sum((b - fitted) ** 2, axis=-1), axis=-1)
    total = xp.sum(a, axis=-1)
    c, det, second = _cofactors(a, fitted, total, xp)
    limit = xp.asarray(threshold(b.dtype), dtype=b.dtype)
    # The fitted directions have the angles of r; b must have two that differ as well.
    _, det_b, second_b = _cofactors(a, b, total, xp)
    observable = xp.isfinite(loss) & xp.isfinite(det)
    for d, s in ((det, second), (det_b, second_b)):
        # M's middle eigenvalue is at least half its trace's excess, so its smallest one, which says whether the turn about
        # the common line is known, is det / (sum of products of two).
        smallest = d / xp.where(s > 0, s, xp.ones_like(s))
        observable = observable & (s > 0) & (smallest > limit * total) & (gap * total > 2.0 * AMBIGUITY * smallest)
    safe = xp.where(observable, det, xp.ones_like(det))
    nan = xp.asarray(xp.nan, dtype=b.dtype)
    covariance = xp.where(observable[..., None, None], c / safe[..., None, None], nan)
    return WahbaSolution(
        xp.where(observable[..., None], q, nan), covariance, xp.where(observable, loss, nan), observable
    )


def _cofactors(a: Any, v: Any, total: Any, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Cofactors of M = sum a (I - v v^T), its determinant and its sum of products of two eigenvalues."""
    M = total[..., None, None] * xp.eye(3, dtype=v.dtype) - xp.einsum("...n,...ni,...nj->...ij", a, v, v)
    c = xp.stack([xp.cross(M[..., (i + 1) % 3, :], M[..., (i + 2) % 3, :]) for i in range(3)], axis=-2)
    return c, xp.sum(M[..., 0, :] * c[..., 0, :], axis=-1), xp.trace(c, axis1=-2, axis2=-1)
