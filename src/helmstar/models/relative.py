"""A probe passing a small body, and the camera that sees it: relative position, pointing, and pixel and line.

| symbol | meaning | shape, unit, frame |
|---|---|---|
| r_PT_N | from the body's centre T to the probe P | (3,) m, N (body-centred J2000) |
| v_PT_N | its rate | (3,) m/s, N |
| q_BN | attitude of the probe (with the camera's mount) | (4,), N to B |
| R_CB | how the camera is turned to follow the body, known | (3, 3), B to C, z the boresight |
| K | focal length in pixels, with cross terms | (2, 3) px |
| p0 | pixel and line of the boresight | (2,) px |

    (8)      r' = r + v dt + w,   the mean of w known and in the step;   s' = s + u w_s
    (4)(5)   u_C = R_CB R_BN (-r),   x = u_x / u_z, y = u_y / u_z
    (6)      [p; l] = K [x; y; x y] + p0,   to which (3) adds (1 + s) offset / |r|

Pointing errors are on the right, in N: a constant error of the attitude reference stays constant there while the camera turns.
Source: Li, Cui and Cui (2007), with their equation numbers.
"""

from __future__ import annotations

from typing import Any

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree
from ..geometry import quaternion
from ..geometry.retraction import euclidean, product, so3_right

Array = jax.Array
SHAPE = 3.0
"""Shape of the Gamma noise; its mean is 3 scales, its variance 3 scales^2."""


@pytree
class PositionVelocity:
    """Relative position and velocity, with the attitude taken as known: q_BN is data of the sensor."""

    r: Array
    v: Array


@pytree
class PositionPointing:
    """Relative position and pointing: the paper's P0 has these six."""

    r: Array
    q: Array


@pytree
class PositionVelocityPointing:
    """Relative position, velocity and pointing."""

    r: Array
    v: Array
    q: Array


@pytree
class PositionPointingOffset:
    """Relative position, pointing, and `s`, (1,), the relative error of the offset from centre of figure to centre of light: a
    radius or a law of reflection that is not what it was taken for."""

    r: Array
    q: Array
    s: Array


position_velocity = product(PositionVelocity, euclidean(3), euclidean(3))
position_pointing = product(PositionPointing, euclidean(3), so3_right)
position_velocity_pointing = product(PositionVelocityPointing, euclidean(3), euclidean(3), so3_right)
position_pointing_offset = product(PositionPointingOffset, euclidean(3), so3_right, euclidean(1))


@pytree
class Motion:
    """velocity (3,) m/s, where it is no state. sigma_r: of the noise of a step, per axis, m; mean_r: its mean, which the step
    adds (0 where a filter does not know it). sigma_q: random walk of the pointing, rad/sqrt(s)."""

    velocity: Array
    sigma_r: Array
    mean_r: Array
    sigma_q: Array


@pytree
class Camera:
    """K (2, 3) px, p0 (2,) px; sigma: of pixel and line, px; q_BN (4,): attitude, where it is no state."""

    K: Array
    p0: Array
    sigma: Array
    q_BN: Array


@pytree
class Sight:
    """Context of a frame: R_CB (3, 3); offset (2,) px m, from the centre of figure to the centre of light that is measured, times
    the distance; cov (2, 2) px^2 added to the camera's."""

    R_CB: Array
    offset: Array
    cov: Array


def _velocity(p: Motion, x: Any) -> Array:
    return x.v if hasattr(x, "v") else p.velocity


def _step(p: Motion, x: Any, u: Any, dt: Array, w: Array) -> Any:
    """(8), and the pointing's random walk."""
    values = {"r": x.r + _velocity(p, x) * dt + p.mean_r + w[:3]}
    if hasattr(x, "v"):
        values["v"] = x.v
    if hasattr(x, "q"):
        values["q"] = so3_right.boxplus(x.q, w[3:6])
    if hasattr(x, "s"):
        values["s"] = x.s + w[6:]
    return type(x)(**values)


def _noise_cov(p: Motion, x: Any, u: Any, dt: Array) -> Array:
    position = jnp.full(3, p.sigma_r**2)
    if not hasattr(x, "q"):
        return jnp.diag(position)
    variances = [position, jnp.full(3, p.sigma_q**2 * dt)]
    if hasattr(x, "s"):
        variances.append(jnp.reshape(u**2, (1,)))
    return jnp.diag(jnp.concatenate(variances))


def _noise_sample(p: Motion, x: Any, u: Any, dt: Array, key: Array) -> Array:
    """Gamma of shape 3 less its mean for the position, Gaussian for the pointing."""
    first, second = jax.random.split(key)
    scale = p.sigma_r / jnp.sqrt(SHAPE)
    # The sum of three exponentials, which compiles to far less than a general Gamma generator.
    gamma = -jnp.sum(jnp.log1p(-jax.random.uniform(first, (3, 3))), axis=0)
    position = scale * (gamma - SHAPE)
    if not hasattr(x, "q"):
        return position
    normal = jax.random.normal(second, (4,))
    parts = [position, p.sigma_q * jnp.sqrt(dt) * normal[:3]]
    return jnp.concatenate([*parts, u * normal[3:]] if hasattr(x, "s") else parts)


def _noise_logpdf(p: Motion, x: Any, u: Any, dt: Array, w: Array) -> Array:
    """-inf below the Gamma's support. Not for states with `s`, whose walk may be of zero width."""
    scale = p.sigma_r / jnp.sqrt(SHAPE)
    g = w[:3] / scale + SHAPE
    inside = jnp.all(g > 0.0)
    g = jnp.where(g > 0.0, g, 1.0)
    logs = jnp.sum((SHAPE - 1.0) * jnp.log(g) - g - jnp.log(2.0) - jnp.log(scale))
    if hasattr(x, "q"):
        sigma = p.sigma_q * jnp.sqrt(dt)
        z = w[3:6] / sigma
        logs = logs - 0.5 * jnp.sum(z * z) - 3.0 * jnp.log(sigma * jnp.sqrt(2.0 * jnp.pi))
    return jnp.where(inside, logs, -jnp.inf)


def _jacobian_six(p: Motion, x: Any, u: Any, dt: Array) -> tuple[Array, None]:
    """Position and pointing keep their errors; the noise enters each as it is."""
    return jnp.eye(6), None


def pixel_line(p: Camera, x: Any, a: Sight) -> Array:
    """(3)-(6): pixel and line (2,) of the centre of light, `offset` over the distance away from the body's centre."""
    q = x.q if hasattr(x, "q") else p.q_BN
    u = a.R_CB @ quaternion.rotate(q, -x.r)
    # Behind the camera there is no image; a tiny depth keeps the numbers finite and the residual huge.
    depth = jnp.where(u[2] > 1e-9 * jnp.sqrt(jnp.sum(u * u)), u[2], 1e-9 * jnp.sqrt(jnp.sum(u * u)))
    t, s = u[0] / depth, u[1] / depth
    z = p.K @ jnp.stack([t, s, t * s]) + p.p0
    share = 1.0 + x.s[0] if hasattr(x, "s") else 1.0
    return z + share * a.offset / jnp.sqrt(jnp.sum(x.r * x.r))


def _minus(z: Array, z_hat: Array) -> Array:
    return z - z_hat


def _pixel_cov(p: Camera, x: Any, a: Sight) -> Array:
    return p.sigma**2 * jnp.eye(2) + a.cov


_SIX = Noise(_noise_cov, 6, _noise_sample, _noise_logpdf)
_SEVEN = Noise(_noise_cov, 7, _noise_sample)
_THREE = Noise(_noise_cov, 3, _noise_sample, _noise_logpdf)
_GAUSSIAN = {n: Noise(_noise_cov, n) for n in (3, 6, 7)}


def body_camera(camera: Camera) -> Sensor:
    """The camera as a sensor of any of the states above. Jacobians are automatic."""
    return Sensor(pixel_line, _minus, _pixel_cov, camera)


def relative_model(motion: Motion, camera: Camera, state: type = PositionPointing, gamma: bool = True) -> Model:
    """Model of one of the four states. gamma: whether the position's noise is Gamma less its mean; else it is Gaussian. Raises
    KeyError for another state."""
    retraction = {
        PositionVelocity: position_velocity,
        PositionPointing: position_pointing,
        PositionVelocityPointing: position_velocity_pointing,
        PositionPointingOffset: position_pointing_offset,
    }[state]
    noise = {PositionVelocity: _THREE, PositionPointingOffset: _SEVEN}.get(state, _SIX)
    if not gamma:
        noise = _GAUSSIAN[noise.dim]
    jacobian = _jacobian_six if state is PositionPointing else None
    return Model(retraction, Process(_step, noise, motion, jacobian), (body_camera(camera),))
