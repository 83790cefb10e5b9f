"""Attitude driven by a gyro, without and with drift as a state: the toolkit's own kinematics.

    R_BN(k+1) = exp(-[(u - b - eta_v) dt x]) R_BN(k)         u: gyro rate, mean over the step, in B
    b(k+1)    = b(k) + eta_u                                  drift in B

Error on the left (axes of B), R_BN = exp([theta x]) R_hat, drift error db = b - b_hat:

    theta' = exp(-[phi x]) theta + J_l(-phi) dt db + w_theta,  phi = (u - b_hat) dt
    db'    = db + w_b

Noise of one step (Farrenkopf 1978; Markley and Crassidis 2014, eq. (6.93)), sigma_v the angle random walk in
rad/sqrt(s), sigma_u the rate random walk in rad/s/sqrt(s):

    E w_theta w_theta^T = (sigma_v^2 dt + sigma_u^2 dt^3 / 3) I + Q_extra,  E w_theta w_b^T = (sigma_u^2 dt^2 / 2) I,
    E w_b w_b^T = sigma_u^2 dt I

| symbol | meaning | shape, unit, frame |
|---|---|---|
| q_BN | attitude quaternion, scalar last | (4,) |
| b | gyro drift | (3,) rad/s in B |
| u.rate | gyro rate, mean over the step | (3,) rad/s in B |
| u.extra | additional attitude covariance of the step (a gap, an unmodelled turn) | (3, 3) rad^2 in B |
"""

from __future__ import annotations

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree
from ..geometry import quaternion, small, so3
from ..geometry.retraction import Retraction, euclidean, product, so3_left, so3_right
from .sensors import star_directions, whole_attitude

Array = jax.Array


@pytree
class AttitudeDrift:
    """State: attitude q_BN (4,) and gyro drift b (3,) in rad/s in B."""

    q_BN: Array
    b: Array


@pytree
class GyroInput:
    """Gyro over one step: mean rate (3,) in rad/s in B, and additional attitude covariance (3, 3) in rad^2 in B.

    `drifts`: 1 where the rate is the gyro's and has its drift, 0 where it comes from elsewhere (a command); None: 1.
    """

    rate: Array
    extra: Array
    drifts: Array | None = None


def _drift_in(u: GyroInput, b: Array) -> Array:
    return b if u.drifts is None else u.drifts * b


@pytree
class GyroNoise:
    """sigma_v: angle random walk, rad/sqrt(s). sigma_u: rate random walk, rad/s/sqrt(s) (0 without a drift state)."""

    sigma_v: Array
    sigma_u: Array


def _attitude_step(params: GyroNoise, q: Array, u: GyroInput, dt: Array, w: Array) -> Array:
    turned = quaternion.multiply(quaternion.exp(-u.rate * dt), q)
    return quaternion.normalise(quaternion.multiply(quaternion.exp(w), turned))


def _attitude_noise(params: GyroNoise, q: Array, u: GyroInput, dt: Array) -> Array:
    return params.sigma_v**2 * dt * jnp.eye(3, dtype=q.dtype) + u.extra


def _attitude_jacobian(params: GyroNoise, q: Array, u: GyroInput, dt: Array) -> tuple[Array, None]:
    return so3.exp(-u.rate * dt), None


def _drift_step(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array, w: Array) -> AttitudeDrift:
    turned = quaternion.multiply(quaternion.exp(-(u.rate - _drift_in(u, x.b)) * dt), x.q_BN)
    return AttitudeDrift(quaternion.normalise(quaternion.multiply(quaternion.exp(w[:3]), turned)), x.b + w[3:])


def _drift_noise(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array) -> Array:
    v2, u2, eye = params.sigma_v**2, params.sigma_u**2, jnp.eye(3, dtype=x.b.dtype)
    aa, ab, bb = (v2 * dt + u2 * dt**3 / 3.0) * eye + u.extra, (0.5 * u2 * dt**2) * eye, (u2 * dt) * eye
    return small.blocks([[aa, ab], [ab, bb]])


def _drift_jacobian(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array) -> tuple[Array, None]:
    phi = -(u.rate - _drift_in(u, x.b)) * dt
    o, eye = jnp.zeros((3, 3), phi.dtype), jnp.eye(3, dtype=phi.dtype)
    return small.blocks([[so3.exp(phi), _drift_in(u, so3.left_jacobian(phi)) * dt], [o, eye]]), None


def _drift_jacobian_right(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array) -> tuple[Array, Array]:
    """For the error on the right, in N, which the turn of the body leaves as it is; what happens in B comes in by R_NB."""
    phi = -(u.rate - _drift_in(u, x.b)) * dt
    R_NB = small.transpose(small.matmul(so3.exp(phi), quaternion.to_matrix(x.q_BN)))
    o, eye = jnp.zeros((3, 3), phi.dtype), jnp.eye(3, dtype=phi.dtype)
    turned = small.matmul(R_NB, _drift_in(u, so3.left_jacobian(phi)) * dt)
    return small.blocks([[eye, turned], [o, eye]]), small.blocks([[R_NB, o], [o, eye]])


def attitude_model(noise: GyroNoise, retraction: Retraction = so3_left, sensors: tuple[Sensor, ...] = ()) -> Model:
    """Attitude alone (3 states, the state is q_BN). The analytic Jacobian holds for `so3_left` and is used with it."""
    jacobian = _attitude_jacobian if retraction is so3_left else None
    return Model(retraction, Process(_attitude_step, Noise(_attitude_noise, 3), noise, jacobian), sensors)


def attitude_drift_model(
    noise: GyroNoise, retraction: Retraction = so3_left, sensors: tuple[Sensor, ...] = ()
) -> Model:
    """Attitude and gyro drift (6 states, the state is `AttitudeDrift`); `retraction` is that of the attitude."""
    jacobian = {so3_left: _drift_jacobian, so3_right: _drift_jacobian_right}.get(retraction)
    whole = product(AttitudeDrift, retraction, euclidean(3))
    return Model(whole, Process(_drift_step, Noise(_drift_noise, 6), noise, jacobian), sensors)


__all__ = [
    "AttitudeDrift",
    "GyroInput",
    "GyroNoise",
    "attitude_drift_model",
    "attitude_model",
    "star_directions",
    "whole_attitude",
]
