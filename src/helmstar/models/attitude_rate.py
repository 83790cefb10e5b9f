"""The body's rate as a state, with the gyro as one of the sensors: what is left when the gyro fails is the stars.

    omega(k+1) = omega(k) + w_omega,  R_BN(k+1) = exp(-[omega(k+1) dt x]) R_BN(k),  b(k+1) = b(k) + w_b

omega(k) is the mean rate over the step that ends at k, so that the gyro's mean rate over that step is a measurement of the
state: z = omega + b + eta, eta of covariance sigma_v^2 / dt I.

| symbol | meaning | shape, unit, frame |
|---|---|---|
| q_BN | attitude quaternion, scalar last | (4,) |
| omega | rate of B relative to N, mean over the last step | (3,) rad/s in B |
| b | gyro drift | (3,) rad/s in B |
"""

from __future__ import annotations

from typing import Any

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree
from ..geometry import quaternion, small, so3
from ..geometry.retraction import Retraction, euclidean, product, so3_left

Array = jax.Array


@pytree
class AttitudeRateDrift:
    """State: attitude q_BN (4,), rate omega (3,) in rad/s in B and gyro drift b (3,) in rad/s in B."""

    q_BN: Array
    omega: Array
    b: Array


@pytree
class RateNoise:
    """sigma_omega: random walk of the rate, rad/s/sqrt(s). sigma_u: that of the drift, rad/s/sqrt(s)."""

    sigma_omega: Array
    sigma_u: Array


def _step(params: RateNoise, x: AttitudeRateDrift, u: Any, dt: Array, w: Array) -> AttitudeRateDrift:
    omega = x.omega + w[:3]
    q = quaternion.multiply(quaternion.exp(-omega * dt), x.q_BN)
    return AttitudeRateDrift(quaternion.normalise(q), omega, x.b + w[3:])


def _noise(params: RateNoise, x: AttitudeRateDrift, u: Any, dt: Array) -> Array:
    each = jnp.stack([params.sigma_omega**2, params.sigma_u**2]) * dt
    return jnp.diag(jnp.repeat(each, 3))


def _jacobian(params: RateNoise, x: AttitudeRateDrift, u: Any, dt: Array) -> tuple[Array, Array]:
    """For the error on the left: a rate that is larger by d turns R by -J_l(-omega dt) d dt."""
    phi = -x.omega * dt
    o, eye = jnp.zeros((3, 3), phi.dtype), jnp.eye(3, dtype=phi.dtype)
    turned = -so3.left_jacobian(phi) * dt
    F = small.blocks([[so3.exp(phi), turned, o], [o, eye, o], [o, o, eye]])
    return F, small.blocks([[turned, o], [eye, o], [o, eye]])


def attitude_rate_model(noise: RateNoise, retraction: Retraction = so3_left, sensors: tuple[Sensor, ...] = ()) -> Model:
    """Attitude, rate and gyro drift (9 states, the state is `AttitudeRateDrift`)."""
    whole = product(AttitudeRateDrift, retraction, euclidean(3), euclidean(3))
    jacobian = _jacobian if retraction is so3_left else None
    return Model(whole, Process(_step, Noise(_noise, 6), noise, jacobian), sensors)


def _gyro_predict(params: None, x: AttitudeRateDrift, a: Array) -> Array:
    return x.omega + x.b


def _gyro_minus(z: Array, z_hat: Array) -> Array:
    return z - z_hat


def _gyro_cov(params: None, x: AttitudeRateDrift, a: Array) -> Array:
    return a


def _gyro_jacobian(params: None, x: AttitudeRateDrift, a: Array) -> Array:
    o, eye = jnp.zeros((3, 3), a.dtype), jnp.eye(3, dtype=a.dtype)
    return jnp.concatenate([o, eye, eye], axis=1)


def gyro_rate() -> Sensor:
    """The gyro's mean rate over the step, (3,) rad/s in B. Context: its covariance (3, 3), (rad/s)^2."""
    return Sensor(_gyro_predict, _gyro_minus, _gyro_cov, None, _gyro_jacobian)
