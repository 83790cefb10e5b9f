"""Sensors of an attitude: star directions (any number, varying) and a whole attitude with a 3x3 covariance.

| sensor | z | context a | residual | H for the error on the left (axes of B) |
|---|---|---|---|---|
| star directions | (n, 3) in B | r_N (n, 3) | z_i - R_BN r_i | -[b_i x], b_i = R_hat r_i |
| whole attitude | q_BN (4,) | covariance (3, 3), rad^2 in B | log(q_z (x) q_hat^-1) | I (to first order) |

For the error on the right (axes of N): -R_hat [r_i x] and R_hat. The state may be q_BN itself or have a field q_BN.
"""

from __future__ import annotations

from typing import Any

from ..backend import jax, jnp
from ..core import Sensor, pytree
from ..geometry import quaternion, so3
from ..geometry.retraction import Retraction, gibbs_left, so3_left, so3_right

Array = jax.Array


@pytree
class StarNoise:
    """sigma: standard deviation of each component of a star's direction, rad."""

    sigma: Array


def attitude_of(x: Any) -> Array:
    """q_BN of a state that is q_BN or has a field of that name."""
    return getattr(x, "q_BN", x)


def _stars_predict(params: StarNoise, x: Any, r_N: Array) -> Array:
    return r_N @ quaternion.to_matrix(attitude_of(x)).T


def _stars_minus(z: Array, z_hat: Array) -> Array:
    return (z - z_hat).reshape(-1)


def _stars_cov(params: StarNoise, x: Any, r_N: Array) -> Array:
    return params.sigma**2 * jnp.eye(r_N.shape[0] * 3, dtype=r_N.dtype)


def _pad(H: Array, x: Any) -> Array:
    """Columns of zeros for the states beside the attitude."""
    beside = sum(leaf.shape[-1] for leaf in jax.tree.leaves(x)) - 4
    return H if not beside else jnp.concatenate([H, jnp.zeros((H.shape[0], beside), H.dtype)], axis=1)


def _stars_left(params: StarNoise, x: Any, r_N: Array) -> Array:
    return _pad(-so3.hat(_stars_predict(params, x, r_N)).reshape(-1, 3), x)


def _stars_right(params: StarNoise, x: Any, r_N: Array) -> Array:
    return _pad((-quaternion.to_matrix(attitude_of(x)) @ so3.hat(r_N)).reshape(-1, 3), x)


def star_directions(sigma: Array | float, retraction: Retraction = so3_left) -> Sensor:
    """Directions of n stars in B, each component with noise `sigma` (rad). Context: their directions r_N (n, 3)."""
    jacobian = {so3_left: _stars_left, gibbs_left: _stars_left, so3_right: _stars_right}.get(retraction)
    return Sensor(_stars_predict, _stars_minus, _stars_cov, StarNoise(jnp.asarray(sigma)), jacobian)


def _whole_predict(params: None, x: Any, a: Array) -> Array:
    return attitude_of(x)


def _whole_minus(z: Array, z_hat: Array) -> Array:
    return quaternion.log(quaternion.multiply(z, quaternion.conjugate(z_hat)))


def _whole_cov(params: None, x: Any, a: Array) -> Array:
    return a


def _whole_left(params: None, x: Any, a: Array) -> Array:
    return _pad(jnp.eye(3, dtype=a.dtype), x)


def whole_attitude(retraction: Retraction = so3_left) -> Sensor:
    """A measured q_BN whose error, on the left in B, has the covariance given as context (3, 3), rad^2."""
    return Sensor(_whole_predict, _whole_minus, _whole_cov, None, _whole_left if retraction is so3_left else None)


def tangent_basis(b: Array) -> Array:
    """Two unit vectors (..., 3, 2) across each unit vector b (..., 3)."""
    x, y, z = b[..., 0], b[..., 1], b[..., 2]
    s = jnp.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (s + z)
    c = x * y * a
    first = jnp.stack([1.0 + s * x * x * a, s * c, -s * x], axis=-1)
    second = jnp.stack([c, s + y * y * a, -y], axis=-1)
    return jnp.stack([first, second], axis=-1)


def _unit_minus(z: Array, z_hat: Array) -> Array:
    return jnp.einsum("nij,ni->nj", tangent_basis(z_hat), z - z_hat).reshape(-1)


def _unit_cov(params: StarNoise, x: Any, r_N: Array) -> Array:
    return params.sigma**2 * jnp.eye(r_N.shape[0] * 2, dtype=r_N.dtype)


def _unit_left(params: StarNoise, x: Any, r_N: Array) -> Array:
    b = _stars_predict(params, x, r_N)
    H = -jnp.einsum("nij,nik->njk", tangent_basis(b), so3.hat(b))
    return _pad(H.reshape(-1, 3), x)


def _unit_right(params: StarNoise, x: Any, r_N: Array) -> Array:
    b = _stars_predict(params, x, r_N)
    R = quaternion.to_matrix(attitude_of(x))
    H = -jnp.einsum("nij,nik->njk", tangent_basis(b), so3.hat(b)) @ R
    return _pad(H.reshape(-1, 3), x)


def unit_star_directions(sigma: Array | float, retraction: Retraction = so3_left) -> Sensor:
    """As `star_directions`, for measured directions of unit length: two residuals for each star, across its direction."""
    jacobian = {so3_left: _unit_left, gibbs_left: _unit_left, so3_right: _unit_right}.get(retraction)
    return Sensor(_stars_predict, _unit_minus, _unit_cov, StarNoise(jnp.asarray(sigma)), jacobian)
