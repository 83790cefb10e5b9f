"""A probe on its way to a small body, both about the Sun: motion, camera, target plane and manoeuvres.

| symbol | meaning | shape, unit, frame |
|---|---|---|
| r, v | from the body T to the probe P, and its rate | (3,) m, m/s, N |
| R, V | of the body, from the Sun | (3,) m, m/s, N |
| s | solar radiation pressure on the probe, relative to what is told, less one | (1,) |
| c | centre of light from the centre of figure, towards the Sun | (1,) m |
| B | from the body to where the probe passes it, across the velocity | (3,) m, N |
| T, R of the target plane | T = S x pole / norm, R = S x T, S along the nominal velocity | (3,), N |

    R'' = -mu R / R^3                         the body: no mass of its own counts (2 km of rock: 1e-6 m/s^2 at 2000 km)
    r'' = g(R + r) - g(R) + (1 + s) a AU^2 (R + r) / |R + r|^3,   g(x) = -mu x / x^3,   a: of radiation pressure at 1 AU

Two Kepler orbits are integrated, not one relative one: an error of the ephemeris changes the Sun's gravity difference, over 100
days by hundreds of km. Target plane: Kizner, "A method of describing miss distances for lunar and interplanetary trajectories",
JPL External Publication 674 (1959); with no gravity of the body its asymptote is the velocity itself.
"""

from __future__ import annotations

from typing import Any

from ..backend import jax, jnp
from ..core import Model, Noise, Process, Sensor, pytree, pytree_with
from ..geometry import small
from ..geometry.retraction import euclidean, product
from .relative import Camera, PositionVelocity, Sight, pixel_line

Array = jax.Array
MU_SUN = 1.32712440018e20
"""m^3/s^2, IAU 2015 nominal solar mass parameter with DE405's digits."""
AU = 149597870700.0
SOLAR_PRESSURE = 1361.0 / 299792458.0
"""N/m^2 at 1 AU: total solar irradiance (Kopp and Lean 2011) over the speed of light."""


@pytree
class Approach:
    """Relative orbit r, v; the body's orbit R, V; scale s of radiation pressure; offset c of the centre of light."""

    r: Array
    v: Array
    R: Array
    V: Array
    s: Array
    c: Array


approach = product(Approach, euclidean(3), euclidean(3), euclidean(3), euclidean(3), euclidean(1), euclidean(1))
SIZE = approach.dim


@pytree_with(static=("substeps",))
class Forces:
    """mu m^3/s^2; pressure: acceleration by radiation at 1 AU, m/s^2; walk: of the velocity, m/s per sqrt(s), the accelerations
    that nobody models; substeps: Runge-Kutta steps in one step of the process."""

    mu: Array
    pressure: Array
    walk: Array
    substeps: int


def _rate(f: Forces, s: Array, y: Array) -> Array:
    """d/dt of y = [r, v, R, V] (12,)."""
    r, v, R, V = y[:3], y[3:6], y[6:9], y[9:]
    P = R + r
    d2, p2 = jnp.sum(R * R), jnp.sum(P * P)
    body, probe = R / (d2 * jnp.sqrt(d2)), P / (p2 * jnp.sqrt(p2))
    sun = -f.mu * body
    return jnp.concatenate([v, (f.pressure * (1.0 + s[0]) * AU**2 - f.mu) * probe - sun, V, sun])


def flow(f: Forces, x: Approach, dt: Array, steps: int) -> Approach:
    """The state dt seconds later (earlier, where negative) by `steps` steps of the classical Runge-Kutta method."""
    h = dt / steps
    # The stages are a loop too: a quarter of the program to compile.
    reach, weight = jnp.array([0.5, 0.5, 1.0, 0.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0

    def advance(y: Array, _: None) -> tuple[Array, None]:
        def stage(carry: tuple[Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
            at, total = carry
            k = _rate(f, x.s, at)
            return (y + now[0] * h * k, total + now[1] * h * k), None

        return jax.lax.scan(stage, (y, y), (reach, weight))[0][1], None

    y, _ = jax.lax.scan(advance, jnp.concatenate([x.r, x.v, x.R, x.V]), None, length=steps)
    return Approach(y[:3], y[3:6], y[6:9], y[9:], x.s, x.c)


def _step(f: Forces, x: Approach, u: Any, dt: Array, w: Array) -> Approach:
    y = flow(f, x, dt, f.substeps)
    return Approach(y.r + w[:3], y.v + w[3:], y.R, y.V, y.s, y.c)


def _noise_cov(f: Forces, x: Any, u: Any, dt: Array) -> Array:
    """Of a velocity that walks at random, exactly over dt: [[dt^3/3, dt^2/2], [dt^2/2, dt]] walk^2 per axis."""
    block = jnp.stack([jnp.stack([dt**3 / 3.0, dt**2 / 2.0]), jnp.stack([dt**2 / 2.0, dt])])
    return f.walk**2 * jnp.kron(block, jnp.eye(3))


def walk_of(f: Forces, dt: Array, normal: Array) -> Array:
    """The noise of a step from six standard normal numbers."""
    velocity, position = normal[:3], normal[3:]
    drift = 0.5 * velocity + position / jnp.sqrt(12.0)
    return f.walk * jnp.sqrt(dt) * jnp.concatenate([dt * drift, velocity])


def _jacobian(f: Forces, x: Approach, u: Any, dt: Array) -> tuple[Array, Array]:
    """F by automatic differentiation through the steps; the noise enters position and velocity as it is."""
    w = jnp.zeros(6)
    F = jax.jacfwd(lambda d: _flat(_step(f, approach.boxplus(x, d), u, dt, w)))(jnp.zeros(SIZE))
    return F, jnp.eye(SIZE, 6)


def _flat(x: Approach) -> Array:
    return jnp.concatenate([x.r, x.v, x.R, x.V, x.s, x.c])


def body_pixel(p: Camera, x: Approach, a: Sight) -> Array:
    """Pixel and line (2,) of the body's centre of light."""
    sun = -x.R / jnp.sqrt(jnp.sum(x.R * x.R))
    return pixel_line(p, PositionVelocity(x.r - x.c[0] * sun, x.v), a)


def _minus(z: Array, z_hat: Array) -> Array:
    return z - z_hat


def _pixel_cov(p: Camera, x: Any, a: Sight) -> Array:
    return p.sigma**2 * jnp.eye(2) + a.cov


def approach_model(forces: Forces, camera: Camera) -> Model:
    """Model of the approach; `camera.q_BN` is the identity, and a frame's `Sight.R_CB` its whole attitude."""
    process = Process(_step, Noise(_noise_cov, 6), forces, _jacobian)
    return Model(approach, process, (Sensor(body_pixel, _minus, _pixel_cov, camera),))


@pytree_with(static=("steps",))
class Target:
    """axes (2, 3): T and R of the target plane in N; aim (2,): B.T and B.R wanted, m; steps: of the integration up to it."""

    axes: Array
    aim: Array
    steps: int


def passage(t: Target, x: Approach) -> Array:
    """[B.T, B.R, t] (3,) m, m, s: where the straight line of the relative motion passes the body, and when from now."""
    time = -jnp.sum(x.r * x.v) / jnp.sum(x.v * x.v)
    return jnp.concatenate([t.axes @ (x.r + x.v * time), time[None]])


def predicted_passage(f: Forces, t: Target, x: Approach, left: Array) -> tuple[Array, Array]:
    """Passage [B.T, B.R, t] (3,) with t from the nominal closest approach, `left` seconds from now, and its derivative
    (3, 14) by the state now: through the whole integration, by automatic differentiation."""

    def map(d: Array) -> tuple[Array, Array]:
        b = passage(t, flow(f, approach.boxplus(x, d), left, t.steps))
        return b, b

    J, b = jax.jacfwd(map, has_aux=True)(jnp.zeros(SIZE))
    return b, J


def correction(t: Target, b: Array, J: Array) -> Array:
    """The smallest delta-v (3,) m/s that takes the passage b to the aim in the linear map J; when it passes is left free."""
    A = J[:2, 3:6]
    return A.T @ small.solve_spd(A @ A.T, (t.aim - b[:2])[:, None])[:, 0]


@pytree
class Execution:
    """Errors of a burn, 1 sigma: of its size, `magnitude` m/s and `magnitude_share` of it; across it, for each of two axes,
    `pointing` m/s and `pointing_share` (rad). Gates, "A simplified model of midcourse maneuver execution errors", JPL Technical
    Report 32-504 (1963)."""

    magnitude: Array
    magnitude_share: Array
    pointing: Array
    pointing_share: Array


def _execution(e: Execution, dv: Array) -> tuple[Array, Array, Array]:
    """Direction (3,) of a burn (zero for none), and variances along and across it."""
    size2 = jnp.sum(dv * dv)
    there = size2 > 0.0
    u = jnp.where(there, dv / jnp.sqrt(jnp.where(there, size2, 1.0)), 0.0)
    along = e.magnitude**2 + e.magnitude_share**2 * size2
    across = e.pointing**2 + e.pointing_share**2 * size2
    return u, jnp.where(there, along, 0.0), jnp.where(there, across, 0.0)


def execution_cov(e: Execution, dv: Array) -> Array:
    """Covariance (3, 3) of what a burn does more than dv; zero for no burn."""
    u, along, across = _execution(e, dv)
    return across * jnp.eye(3) + (along - across) * u[:, None] * u[None, :]


def executed(e: Execution, dv: Array, normal: Array) -> Array:
    """What a burn of dv does, with three standard normal numbers."""
    u, along, across = _execution(e, dv)
    part = u * jnp.sum(u * normal)
    return dv + jnp.sqrt(along) * part + jnp.sqrt(across) * (normal - part)
