"""The 6-state filter of Zhou, Li and Wu (2021) as printed: (14)-(20), delta q_13 and drift, QUEST's attitude as measurement.

    F = [[-[w x], I/2], [0, 0]], G = diag(-I/2, I)   (15);   Phi = I + F T   (17);   Z = vec(q_star (x) q_pre^-1), H = [I 0]

in the sense of this package: Hamilton's quaternions with matrix R_BN, so that the drift enters with the other sign than in the
paper's Shuster convention. Noise of one step: diag(sigma_v^2 T / 4 I, sigma_u^2 T I).

| symbol | here | shape, unit, frame |
|---|---|---|
| delta q_13 | error by the retraction `vector_part_left` | (3,) half an angle, B |
| d | AttitudeDrift.b | (3,) rad/s in B |
| q_star | measurement z | (4,) |
| R | context: a quarter of the solver's covariance | (3, 3) |
"""

from __future__ import annotations

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor
from ..geometry import quaternion, small, so3
from ..geometry.retraction import euclidean, product, vector_part_left
from .attitude import AttitudeDrift, GyroInput, GyroNoise

Array = jax.Array
RETRACTION = product(AttitudeDrift, vector_part_left, euclidean(3))


def _step(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array, w: Array) -> AttitudeDrift:
    drift = x.b if u.drifts is None else u.drifts * x.b
    turned = quaternion.multiply(quaternion.exp(-(u.rate - drift) * dt), x.q_BN)
    return AttitudeDrift(vector_part_left.boxplus(turned, w[:3]), x.b + w[3:])


def _noise(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array) -> Array:
    o, eye = jnp.zeros((3, 3), x.b.dtype), jnp.eye(3, dtype=x.b.dtype)
    attitude = 0.25 * (params.sigma_v**2 * dt * eye + u.extra)
    return small.blocks([[attitude, o], [o, params.sigma_u**2 * dt * eye]])


def _jacobian(params: GyroNoise, x: AttitudeDrift, u: GyroInput, dt: Array) -> tuple[Array, None]:
    has = 1.0 if u.drifts is None else u.drifts
    w = u.rate - has * x.b
    o, eye = jnp.zeros((3, 3), w.dtype), jnp.eye(3, dtype=w.dtype)
    return small.blocks([[eye - so3.hat(w) * dt, 0.5 * dt * has * eye], [o, eye]]), None


def _predict(params: None, x: AttitudeDrift, a: Array) -> Array:
    return x.q_BN


def _minus(z: Array, z_hat: Array) -> Array:
    """vec(q_star (x) q_pre^-1) as it stands: a q_star of the wrong sign gives the wrong sign, which is what (13) is for."""
    return quaternion.multiply(z, quaternion.conjugate(z_hat))[:3]


def _cov(params: None, x: AttitudeDrift, a: Array) -> Array:
    return a


def _sensor_jacobian(params: None, x: AttitudeDrift, a: Array) -> Array:
    return jnp.concatenate([jnp.eye(3, dtype=a.dtype), jnp.zeros((3, 3), a.dtype)], axis=1)


def printed_model(noise: GyroNoise) -> Model:
    """The paper's filter; measurement z = q_star (4,), context its covariance (3, 3) of delta q_13."""
    sensor = Sensor(_predict, _minus, _cov, None, _sensor_jacobian)
    return Model(RETRACTION, Process(_step, Noise(_noise, 6), noise, _jacobian), (sensor,))
