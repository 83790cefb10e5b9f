"""One continuous sign for quaternions over time: q and -q are the same rotation, and a solver returns either.

- `continue_sign`, Zhou, Li and Wu (2021), eq. (13): q_k = sign(q^T q_(k-1)) q, with sign(0) = +1. It fails when the body turns
  by 180 deg or more between samples: a gap of 180 s at 1 deg/s.
- `nearest_sign`, the safe form: the same against the quaternion that the gyro predicts, `propagate`. It fails only where the
  prediction is 180 deg wrong.

NumPy or JAX arrays, leading axes are batch axes, quaternions (..., 4) with the scalar last, of any length.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .wahba import namespace


def continue_sign(q_BN: Any, q_previous: Any) -> Any:
    """q_BN or -q_BN, on the side of the previous quaternion; q_BN itself where they are orthogonal or one is NaN."""
    xp = namespace(q_BN, q_previous)
    q_BN, q_previous = xp.asarray(q_BN), xp.asarray(q_previous)
    return xp.where(xp.sum(q_BN * q_previous, axis=-1, keepdims=True) < 0, -q_BN, q_BN)


def nearest_sign(q_BN: Any, q_predicted: Any) -> Any:
    """q_BN or -q_BN, on the side of the quaternion that the gyro predicts (`propagate`)."""
    return continue_sign(q_BN, q_predicted)


def propagate(q_BN: Any, turn_B: Any) -> Any:
    """The quaternion after the body has turned by turn_B (..., 3), rad in B, the integral of omega_BN_B.

    q(t + dt) = q(-turn) (x) q(t), continuous for turns of any size: a whole turn changes the sign.
    """
    xp = namespace(q_BN, turn_B)
    return _multiply(_gyro(xp.asarray(turn_B), xp), xp.asarray(q_BN), xp)


def continuous(q_series: Any, turn_B: Any = None) -> Any:
    """q_series (..., T, 4) with signs that continue each other from the first one on.

    turn_B (..., T - 1, 3): the gyro's turn between samples, rad in B; with it the safe form, otherwise eq. (13). Rows with NaN
    stay, and the next one continues the last before them. Raises ValueError for shapes that do not fit.
    """
    xp = namespace(q_series, turn_B)
    q = xp.asarray(q_series)
    if q.ndim < 2 or q.shape[-1] != 4:
        raise ValueError(f"q_series {q.shape}: must be (..., T, 4)")
    count, frozen = q.shape[-2], q
    if turn_B is not None:
        turn = xp.asarray(turn_B)
        if turn.shape[-2:] != (count - 1, 3):
            raise ValueError(f"turn_B {turn.shape}: must be (..., {count - 1}, 3), one turn between two samples")
        # With the gyro's own motion taken out of it, a quaternion stands still.
        moved = _accumulate(_gyro(turn, xp), xp)
        frozen = xp.concatenate([q[..., :1, :], _multiply(_conjugate(moved, xp), q[..., 1:, :], xp)], axis=-2)
    valid = xp.all(xp.isfinite(q), axis=-1)
    rows = xp.where(valid, xp.arange(count), -1)
    last = xp.maximum.accumulate(rows, axis=-1)
    before = xp.concatenate([xp.full_like(last[..., :1], -1), last[..., :-1]], axis=-1)
    previous = xp.take_along_axis(frozen, xp.maximum(before, 0)[..., None], axis=-2)
    turned = xp.sum(frozen * previous, axis=-1) < 0  # NaN is False, and so is the first row with itself
    sign = xp.cumprod(xp.where(turned & (before >= 0), -1, 1), axis=-1)
    return q * sign[..., None].astype(q.dtype)


def _gyro(turn: Any, xp: Any) -> Any:
    """Quaternion of exp(-[turn x])."""
    half = 0.5 * xp.sqrt(xp.sum(turn * turn, axis=-1, keepdims=True))
    small = half < 1e-8  # there sin(x) / x is 1 to the last digit
    ratio = xp.where(small, xp.ones_like(half), xp.sin(half) / xp.where(small, xp.ones_like(half), half))
    return xp.concatenate([-0.5 * ratio * turn, xp.cos(half)], axis=-1)


def _conjugate(q: Any, xp: Any) -> Any:
    return q * xp.asarray([-1.0, -1.0, -1.0, 1.0], dtype=q.dtype)


def _multiply(p: Any, q: Any, xp: Any) -> Any:
    """Hamilton product p (x) q, scalar last."""
    px, py, pz, pw = (p[..., i] for i in range(4))
    qx, qy, qz, qw = (q[..., i] for i in range(4))
    product = [
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    ]
    return xp.stack(product, axis=-1)


def _accumulate(q: Any, xp: Any) -> Any:
    """q_k (x) ... (x) q_0 along the axis before the last."""
    if xp is not np:
        from ..backend import jax

        def step(before: Any, one: Any) -> Any:
            after = _multiply(one, before, xp)
            return after, after

        start = xp.zeros_like(q[..., 0, :]).at[..., 3].set(1.0)
        _, rows = jax.lax.scan(step, start, xp.moveaxis(q, -2, 0))
        return xp.moveaxis(rows, 0, -2)
    out = np.array(q, copy=True)
    for k in range(1, q.shape[-2]):
        out[..., k, :] = _multiply(q[..., k, :], out[..., k - 1, :], xp)
    return out
