"""Attitude, gyro drift, and what a calibration finds: the gyro's misalignment to the star tracker, and its scale factors.

The gyro's axes G are turned from B (the star tracker's idea of the body) by a small rotation vector mu, and each reading is
too large by a factor 1 + s:

    u = (I + diag(s)) exp([mu x]) omega + b + eta,     omega = exp(-[mu x]) (u - b) / (1 + s)

    R_BN(k+1) = exp(-[omega dt x]) R_BN(k);  b as in `attitude`; mu and s are constant

Error on the left for the attitude, sums for the rest. mu and s show only where the rate changes: at a constant rate they look
like drift, and about an axis that the body never turns about its scale factor is not observable at all.

| symbol | meaning | shape, unit, frame |
|---|---|---|
| q_BN | attitude quaternion, scalar last | (4,) |
| b | gyro drift | (3,) rad/s in G |
| misalignment | mu: R_GB = exp([mu x]) | (3,) rad |
| scale | s | (3,) of the gyro's axes |
"""

from __future__ import annotations

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree
from ..geometry import quaternion, small, so3
from ..geometry.retraction import euclidean, product, so3_left
from .attitude import GyroInput, GyroNoise

Array = jax.Array


@pytree
class AttitudeCalibration:
    """State: attitude q_BN (4,), drift b (3,) rad/s, misalignment (3,) rad, scale (3,)."""

    q_BN: Array
    b: Array
    misalignment: Array
    scale: Array


RETRACTION = product(AttitudeCalibration, so3_left, euclidean(3), euclidean(3), euclidean(3))


def body_rate(u: GyroInput, b: Array, misalignment: Array, scale: Array) -> Array:
    """omega (3,) in B of a reading; a rate that is not the gyro's (`drifts` 0) is taken as it is."""
    own = so3.exp(-misalignment) @ ((u.rate - b) / (1.0 + scale))
    return own if u.drifts is None else jnp.where(u.drifts > 0.0, own, u.rate)


def _step(params: GyroNoise, x: AttitudeCalibration, u: GyroInput, dt: Array, w: Array) -> AttitudeCalibration:
    omega = body_rate(u, x.b, x.misalignment, x.scale)
    turned = quaternion.multiply(quaternion.exp(-omega * dt), x.q_BN)
    q = quaternion.normalise(quaternion.multiply(quaternion.exp(w[:3]), turned))
    return AttitudeCalibration(q, x.b + w[3:], x.misalignment, x.scale)


def _noise(params: GyroNoise, x: AttitudeCalibration, u: GyroInput, dt: Array) -> Array:
    v2, u2, eye = params.sigma_v**2, params.sigma_u**2, jnp.eye(3, dtype=x.b.dtype)
    aa, ab, bb = (v2 * dt + u2 * dt**3 / 3.0) * eye + u.extra, (0.5 * u2 * dt**2) * eye, (u2 * dt) * eye
    return small.blocks([[aa, ab], [ab, bb]])


def _jacobian(params: GyroNoise, x: AttitudeCalibration, u: GyroInput, dt: Array) -> tuple[Array, Array]:
    """d theta' = exp(phi) d theta + J_l(phi) d phi with phi = -omega dt, and omega's derivatives by b, mu and s."""
    omega = body_rate(u, x.b, x.misalignment, x.scale)
    phi = -omega * dt
    has = jnp.ones(()) if u.drifts is None else jnp.where(u.drifts > 0.0, 1.0, 0.0)
    back = so3.exp(-x.misalignment)
    reading = (u.rate - x.b) / (1.0 + x.scale)
    by_b = -back / (1.0 + x.scale)
    # exp(-[(mu + d) x]) = exp(-[J_r(mu) d x]) exp(-[mu x]) up to second order in d, on the left: J_l(-mu) = J_r(mu).
    by_mu = so3.hat(omega) @ so3.left_jacobian(-x.misalignment)
    by_s = -back * (reading / (1.0 + x.scale))
    J = -has * dt * so3.left_jacobian(phi)
    o, eye = jnp.zeros((3, 3), phi.dtype), jnp.eye(3, dtype=phi.dtype)
    F = small.blocks(
        [
            [so3.exp(phi), small.matmul(J, by_b), small.matmul(J, by_mu), small.matmul(J, by_s)],
            [o, eye, o, o],
            [o, o, eye, o],
            [o, o, o, eye],
        ]
    )
    return F, jnp.concatenate([jnp.eye(6, dtype=phi.dtype), jnp.zeros((6, 6), phi.dtype)])


def calibration_model(noise: GyroNoise, sensors: tuple[Sensor, ...] = ()) -> Model:
    """Attitude, drift, misalignment and scale factors (12 states, the state is `AttitudeCalibration`)."""
    return Model(RETRACTION, Process(_step, Noise(_noise, 6), noise, _jacobian), sensors)
