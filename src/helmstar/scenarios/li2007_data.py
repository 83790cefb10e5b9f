"""Truth and measurements of li2007: straight motion with Gamma noise, a camera that follows the body, an attitude reference
that is off."""

from __future__ import annotations

from functools import partial

from ..backend import jax, jnp
from ..core import pytree, pytree_with
from ..geometry import quaternion
from ..geometry.retraction import so3_right
from ..models.relative import SHAPE, Camera, PositionPointing, Sight, pixel_line

Array = jax.Array
# Purposes of the random streams; a key is folded with run, then step, then purpose. Filters draw from FILTER on.
MOTION, PIXELS, START, REFERENCE, FILTER = 0, 1, 2, 3, 1000


@pytree_with(static=("steps", "gamma"))
class Setting:
    """Data of the simulation, SI. r0, v (3,): at the start; sigma_r: of a step's noise; sigma_q: of its random walk of the
    pointing; q_ref (4,): what the attitude reference says; offset (3,): of the fixed start, zero for a random one; sigma_0 (3,):
    of the random start, zero for a fixed one; half: half the image, px; seed."""

    r0: Array
    v: Array
    sigma_v: Array
    sigma_r: Array
    sigma_q: Array
    dt: Array
    q_ref: Array
    error_q: Array
    offset: Array
    sigma_0: Array
    camera: Camera
    half: Array
    seed: Array
    steps: int
    gamma: bool


@pytree
class Data:
    """Of one run. r, q (steps, ...), v (3,): truth; R_CB (steps, 3, 3): how the camera is turned, known; z (steps, 2) px and
    whether the body is in the field, seen (steps,); start (3,): position that filters start from; offset, cov: of `Sight`; walk
    (steps,): 1 sigma of the steps of the offset's relative error; run: number."""

    r: Array
    q: Array
    v: Array
    R_CB: Array
    z: Array
    seen: Array
    start: Array
    offset: Array
    cov: Array
    walk: Array
    run: Array


def look_at(u: Array) -> Array:
    """R (3, 3) whose z axis is along u (3,), its y axis as near to the given frame's y axis as that lets it."""
    z = u / jnp.sqrt(jnp.sum(u * u))
    # Straight along y there is no x axis to choose by it; another reference is taken in time.
    reference = jnp.where(jnp.abs(z[1]) < 0.99, jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0]))
    x = jnp.cross(reference, z)
    x = x / jnp.sqrt(jnp.sum(x * x))
    return jnp.stack([x, jnp.cross(z, x), z])


def key_of(seed: Array, run_id: Array, step: Array | int, purpose: int) -> Array:
    """The key of one purpose at one step of one run."""
    key = jax.random.fold_in(jax.random.key(seed), run_id)
    return jax.random.fold_in(jax.random.fold_in(key, step), purpose)


def _simulate_run(s: Setting, run_id: Array) -> Data:
    def normal(step: Array | int, purpose: int, n: int) -> Array:
        return jax.random.normal(key_of(s.seed, run_id, step, purpose), (n,))

    q0 = so3_right.boxplus(s.q_ref, s.error_q * normal(0, REFERENCE, 3))
    v = s.v + s.sigma_v * normal(1, REFERENCE, 3)
    start = s.r0 + s.offset + s.sigma_0 * normal(0, START, 3)

    def step(x: PositionPointing, k: Array) -> tuple[PositionPointing, tuple]:
        position, walk = jnp.split(normal(k, MOTION, 6), 2)
        position = s.sigma_r * position
        if s.gamma:
            u = jax.random.uniform(jax.random.fold_in(key_of(s.seed, run_id, k, MOTION), 1), (3, 3))
            position = s.sigma_r / jnp.sqrt(SHAPE) * -jnp.sum(jnp.log1p(-u), axis=0)
        x = PositionPointing(x.r + v * s.dt + position, so3_right.boxplus(x.q, s.sigma_q * walk))
        # A closed loop keeps the image in the middle; what the mount's encoders read is known.
        R_CB = look_at(quaternion.rotate(x.q, -x.r))
        sight = Sight(R_CB, jnp.zeros(2), jnp.zeros((2, 2)))
        z = pixel_line(s.camera, x, sight) + s.camera.sigma * normal(k, PIXELS, 2)
        seen = jnp.all(jnp.abs(z - s.camera.p0) < s.half)
        return x, (x.r, x.q, R_CB, z, seen)

    _, (r, q, R_CB, z, seen) = jax.lax.scan(step, PositionPointing(s.r0, q0), jnp.arange(1, s.steps + 1))
    zero = jnp.zeros((s.steps, 2))
    return Data(r, q, v, R_CB, z, seen, start, zero, jnp.zeros((s.steps, 2, 2)), jnp.zeros(s.steps), run_id)


@jax.jit
def simulate(setting: Setting, run_ids: Array) -> Data:
    """Data of the runs with these numbers."""
    return jax.vmap(partial(_simulate_run, setting))(run_ids)


@pytree
class Pictures:
    """What frames show, of all runs: as `li2007_frames.Lights`, with `walk` from the change of phase."""

    z: Array
    cov: Array
    offset: Array
    walk: Array
    seen: Array


@jax.jit
def simulate_from_images(setting: Setting, pictures: Pictures, run_ids: Array) -> Data:
    """As `simulate`, with the centres of light that the frames show: truth and starts are the same to the bit."""

    def one(run_id: Array) -> Data:
        d, p = _simulate_run(setting, run_id), jax.tree.map(lambda a: a[run_id], pictures)
        return Data(d.r, d.q, d.v, d.R_CB, p.z, p.seen, d.start, p.offset, p.cov, p.walk, run_id)

    return jax.vmap(one)(run_ids)
