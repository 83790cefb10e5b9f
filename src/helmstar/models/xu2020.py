"""The models of Xu, Pei and Jiang (2020): the paper's kinematics X A, its printed Jacobians beside the consistent ones.

The paper's X is R_BN (l = X r, (2)) and is stored as the quaternion q with to_matrix(q) = X. The paper integrates
dX/dt = X [w x] (8), that is X(k+1) = X(k) A(k), A = exp([u x]) (24); truth and filters here do the same.

| symbol | meaning | shape, unit, frame |
|---|---|---|
| X, q | attitude, l = X r | (4,) as quaternion |
| u | gyro increment of the step, A = exp([u x]) | (3,) rad |
| xi | error on the right, X = X_hat exp([xi x]) | (3,) rad in N |
| r1, r2 | star directions (33) | (2, 3) in N |
| l1, l2 | measured stars (2) | (2, 3) in B |
| Q_w, Q_v | process and measurement noise (41)(42) | q_w in rad^2 per step, sigma_v in rad |

**Consistent**, for xi: P- = A^T P A + Q_w, H = -X_hat [r x] for the residual l - X_hat r in B.
**Printed**: (25) P- = A P A^T + Q_w, (26) residual l - X_hat r, (27) H = -[r x]: the residual is in B, H belongs to one
in N. Both are the same error-state filter; only the declared Jacobians differ.
"""

from __future__ import annotations

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree
from ..geometry import quaternion, small, so3
from ..geometry.retraction import Retraction, gibbs_left, quaternion_additive, so3_left, so3_right
from .sensors import star_directions

Array = jax.Array


@pytree
class Tuning:
    """q_w: variance of the process noise per step (rad^2; for the additive quaternion filter per component)."""

    q_w: Array


def _step(params: Tuning, q: Array, u: Array, dt: Array, w: Array) -> Array:
    """(24): X A, with the noise w behind it on the right."""
    return quaternion.normalise(quaternion.multiply(quaternion.multiply(q, quaternion.exp(u)), quaternion.exp(w)))


def _noise(params: Tuning, q: Array, u: Array, dt: Array) -> Array:
    return params.q_w * jnp.eye(3, dtype=q.dtype)


def _jacobian_right(params: Tuning, q: Array, u: Array, dt: Array) -> tuple[Array, None]:
    return so3.exp(-u), None


def _jacobian_printed(params: Tuning, q: Array, u: Array, dt: Array) -> tuple[Array, None]:
    """(25) as printed: A where the error on the right needs A^T."""
    return so3.exp(u), None


def _jacobian_left(params: Tuning, q: Array, u: Array, dt: Array) -> tuple[Array, Array]:
    return jnp.eye(3, dtype=u.dtype), quaternion.to_matrix(_step(params, q, u, dt, jnp.zeros(3, u.dtype)))


def _step_additive(params: Tuning, q: Array, u: Array, dt: Array, w: Array) -> Array:
    return quaternion.normalise(quaternion.multiply(q, quaternion.exp(u)) + w)


def _noise_additive(params: Tuning, q: Array, u: Array, dt: Array) -> Array:
    return params.q_w * jnp.eye(4, dtype=q.dtype)


def _jacobian_additive(params: Tuning, q: Array, u: Array, dt: Array) -> tuple[Array, None]:
    """Matrix of the right multiplication by exp(u): the quaternion is propagated linearly, its norm is not a constraint."""
    a = quaternion.exp(u)
    return small.transpose(quaternion.multiply(jnp.eye(4, dtype=u.dtype), a)), None


def _sensor_jacobian_additive(params, q: Array, r_N: Array) -> Array:
    """d(R(q) r)/d q of the homogeneous form R(q) r = (w^2 - u.u) r + 2 (u.r) u + 2 w u x r, u and w free."""

    def stars(p: Array) -> Array:
        u, w = p[:3], p[3]
        cross = jnp.cross(jnp.broadcast_to(u, r_N.shape), r_N)
        return ((w * w - u @ u) * r_N + 2.0 * (r_N @ u)[:, None] * u + 2.0 * w * cross).reshape(-1)

    return jax.jacfwd(stars)(q)


def _sensor_jacobian_printed(params, q: Array, r_N: Array) -> Array:
    """(27) as printed."""
    return -so3.hat(r_N).reshape(-1, 3)


def lie_model(q_w: Array | float, sigma_v: Array | float, retraction: Retraction = so3_right) -> Model:
    """The consistent form; the error lives where the retraction says."""
    jacobian = {so3_right: _jacobian_right, so3_left: _jacobian_left, gibbs_left: _jacobian_left}.get(retraction)
    process = Process(_step, Noise(_noise, 3), Tuning(jnp.asarray(q_w)), jacobian)
    return Model(retraction, process, (star_directions(sigma_v, retraction),))


def printed_model(q_w: Array | float, sigma_v: Array | float) -> Model:
    """Equations (24)-(31) to the letter, (29) with K Q_v K^T, which is what conforms."""
    sensor = star_directions(sigma_v, so3_right)
    sensor = Sensor(sensor.predict, sensor.minus, sensor.cov, sensor.params, _sensor_jacobian_printed)
    process = Process(_step, Noise(_noise, 3), Tuning(jnp.asarray(q_w)), _jacobian_printed)
    return Model(so3_right, process, (sensor,))


def quaternion_model(q_w: Array | float, sigma_v: Array | float) -> Model:
    """The additive quaternion EKF of the paper's comparison: four free numbers, normalised after each step."""
    sensor = star_directions(sigma_v, quaternion_additive)
    sensor = Sensor(sensor.predict, sensor.minus, sensor.cov, sensor.params, _sensor_jacobian_additive)
    process = Process(_step_additive, Noise(_noise_additive, 4), Tuning(jnp.asarray(q_w)), _jacobian_additive)
    return Model(quaternion_additive, process, (sensor,))
