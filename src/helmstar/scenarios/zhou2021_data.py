"""Data of zhou2021's runs: gyro readings, star directions and QUEST's attitudes, for many runs at once.

One keyed stream for each run: the key is folded with run, then second, then purpose.
"""

from __future__ import annotations

from functools import partial

from ..attitude import quest
from ..backend import jax, jnp
from ..core import pytree
from ..sensors.gyro import gyro_readings

Array = jax.Array
GYRO, STARS, START = range(3)
"""Purposes of the random streams."""


@pytree
class Setting:
    """Data of the simulation: turned (n, 3) rad, b_B and r_N (n + 1, k, 3), seen (n + 1, k), star sigma rad, gyro's sigma_v,
    sigma_u and initial drift sigma in SI, seed."""

    turned: Array
    b_B: Array
    r_N: Array
    seen: Array
    sigma: Array
    sigma_v: Array
    sigma_u: Array
    drift_sigma: Array
    seed: Array


@pytree
class Data:
    """Of one run: mean gyro rate (n, 3) rad/s and true drift (n, 3) rad/s over and at the end of each second; star
    directions z (n + 1, k, 3); QUEST's q_star (n + 1, 4) with a sign drawn at random, and its covariance (n + 1, 3, 3); a
    unit vector `axis` for wrong starts."""

    rate: Array
    drift: Array
    z: Array
    q_star: Array
    q_cov: Array
    axis: Array


def _simulate_run(s: Setting, run_id: Array) -> Data:
    key = jax.random.fold_in(jax.random.key(s.seed), run_id)
    n, k = s.turned.shape[0], s.r_N.shape[1]

    def draw(step: Array, purpose: Array) -> Array:
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, step), purpose), (9,))

    purposes = jnp.array([GYRO, STARS, START])
    w = jax.vmap(lambda i: jax.vmap(lambda p: draw(i, p))(purposes))(jnp.arange(n + 1))
    drift0 = s.drift_sigma * w[0, START, :3]
    axis = w[0, START, 3:6]
    readings, drift = gyro_readings(
        s.turned, jnp.asarray(1.0), drift0, s.sigma_v, s.sigma_u, w[1:, GYRO].reshape(n, 3, 3)
    )
    z = s.b_B + s.sigma * w[:, STARS, : 3 * k].reshape(n + 1, k, 3)
    z = z / jnp.sqrt(jnp.sum(z * z, axis=-1, keepdims=True))
    q, cov, _, observable = quest(z, s.r_N, s.sigma, s.seen)
    sign = jnp.where(w[:, START, 6:7] < 0.0, -1.0, 1.0)
    fallback = jnp.asarray([0.0, 0.0, 0.0, 1.0])
    q = jnp.where(observable[:, None], sign * q, fallback)
    cov = jnp.where(observable[:, None, None], cov, jnp.eye(3))
    return Data(readings, drift, z, q, cov, axis / jnp.sqrt(jnp.sum(axis**2)))


@jax.jit
def simulate(setting: Setting, run_ids: Array) -> Data:
    """Data of the runs with these numbers."""
    return jax.vmap(partial(_simulate_run, setting))(run_ids)
