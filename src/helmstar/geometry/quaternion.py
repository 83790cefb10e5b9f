"""Unit quaternions, Hamilton's product, scalar last: q = [x, y, z, w], the order and action of scipy's Rotation.

`to_matrix(q_BN)` is R_BN, v_B = R_BN v_N, and `multiply(q_CB, q_BN)` is q_CN. q and -q are the same rotation.
All functions take any number of leading batch axes. Source: Sola, "Quaternion kinematics for the error-state Kalman
filter" (2017), sections 1 and 2 (there scalar first).
"""

from __future__ import annotations

from ..backend import jax, jnp
from .series import atan_ratio, cos_of_square, sinc_of_square

Array = jax.Array


def identity(dtype=None) -> Array:
    """[0, 0, 0, 1]."""
    return jnp.array([0.0, 0.0, 0.0, 1.0], dtype=dtype)


@jax.jit
def normalise(q: Array) -> Array:
    """q / |q|. A zero quaternion gives NaN; callers that read data refuse it before."""
    return q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))


def conjugate(q: Array) -> Array:
    """The inverse of a unit quaternion."""
    return q * jnp.array([-1.0, -1.0, -1.0, 1.0], dtype=q.dtype)


@jax.jit
def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p (x) q: `to_matrix(multiply(p, q)) == to_matrix(p) @ to_matrix(q)`."""
    px, py, pz, pw = (p[..., i] for i in range(4))
    qx, qy, qz, qw = (q[..., i] for i in range(4))
    return jnp.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


@jax.jit
def rotate(q: Array, v: Array) -> Array:
    """`to_matrix(q) @ v` for a unit quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
    u, w = q[..., :3], q[..., 3:]
    t = 2.0 * jnp.cross(u, v)
    return v + w * t + jnp.cross(u, t)


@jax.jit
def to_matrix(q: Array) -> Array:
    """R of a unit quaternion. Shape (..., 4) -> (..., 3, 3)."""
    x, y, z, w = (q[..., i] for i in range(4))
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, xw, yw, zw = x * y, x * z, y * z, x * w, y * w, z * w
    return jnp.stack(
        [
            1.0 - 2.0 * (yy + zz), 2.0 * (xy - zw), 2.0 * (xz + yw),
            2.0 * (xy + zw), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - xw),
            2.0 * (xz - yw), 2.0 * (yz + xw), 1.0 - 2.0 * (xx + yy),
        ],
        axis=-1,
    ).reshape(*q.shape[:-1], 3, 3)  # fmt: skip


@jax.jit
def from_matrix(R: Array) -> Array:
    """Unit quaternion of R. 4 q q^T is linear in R; a column with a large diagonal is taken and normalised.

    No square root of a difference is taken, so the result and its gradient are accurate at every angle, pi included.
    """
    r = {(i, j): R[..., i, j] for i in range(3) for j in range(3)}
    x = jnp.stack([1.0 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]], axis=-1)
    y = jnp.stack([r[0, 1] + r[1, 0], 1.0 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]], axis=-1)
    z = jnp.stack([r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1.0 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]], axis=-1)
    w = jnp.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + r[0, 0] + r[1, 1] + r[2, 2]], axis=-1)
    # A compiler may evaluate a comparison again for each of its uses, with products and sums contracted differently. At
    # a tie (q_x = q_z, as for symmetric axes) derivatives then mix two columns and are wrong by as much as they are
    # large: seen in XLA at optimisation level 0. The weights move the ties to where no one goes.
    dx, dy, dz, dw = x[..., 0], 1.13 * y[..., 1], 1.29 * z[..., 2], 1.47 * w[..., 3]
    xy = jnp.where((dx >= dy)[..., None], x, y)
    zw = jnp.where((dz > dw)[..., None], z, w)
    return normalise(jnp.where((jnp.maximum(dx, dy) > jnp.maximum(dz, dw))[..., None], xy, zw))


@jax.jit
def exp(phi: Array) -> Array:
    """Unit quaternion of the rotation vector phi (rad): [sin(t/2) phi / t, cos(t/2)]."""
    h2 = 0.25 * jnp.sum(phi * phi, axis=-1, keepdims=True)
    return jnp.concatenate([0.5 * sinc_of_square(h2) * phi, cos_of_square(h2)], axis=-1)


@jax.jit
def log(q: Array) -> Array:
    """Rotation vector (rad) of a unit quaternion, angle in [0, pi], the same for q and -q (at pi: one of the two)."""
    q = jnp.where(q[..., 3:] < 0.0, -q, q)
    u, w = q[..., :3], q[..., 3]
    return (2.0 * atan_ratio(jnp.sum(u * u, axis=-1), w))[..., None] * u


def align_sign(q: Array, reference: Array) -> Array:
    """The one of q and -q on the side of `reference`: sign(q . reference) q with sign(0) = +1."""
    dot = jnp.sum(q * reference, axis=-1, keepdims=True)
    return jnp.where(dot < 0.0, -q, q)


def angle_between(p: Array, q: Array) -> Array:
    """Angle in rad of the rotation p (x) q^-1, in [0, pi], accurate at both ends."""
    d = multiply(p, conjugate(q))
    return 2.0 * jnp.arctan2(jnp.sqrt(jnp.sum(d[..., :3] ** 2, axis=-1)), jnp.abs(d[..., 3]))


def rate_matrix(q: Array) -> Array:
    """Xi(q), 4x3, with q (x) [v, 0] = Xi(q) v; q^T Xi(q) = 0. A right error xi moves q by Xi(q) xi / 2."""
    x, y, z, w = (q[..., i] for i in range(4))
    return jnp.stack([w, -z, y, z, w, -x, -y, x, w, -x, -y, -z], axis=-1).reshape(*q.shape[:-1], 4, 3)
