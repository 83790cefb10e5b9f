"""A rate-integrating gyro: its noise in the units of data sheets, and its readings in a simulation.

Reading of one step: the integral of the rate over the step, plus that of the drift, plus angle random walk. Drift and
integral share the random walk of the step (Farrenkopf 1978; Markley and Crassidis 2014, section 4.7.1):

    b(k+1) = b(k) + sigma_u sqrt(dt) n2
    reading = int omega dt + b(k) dt + sigma_u dt^(3/2) (n2 / 2 + n3 / sqrt(12)) + sigma_v sqrt(dt) n1
"""

from __future__ import annotations

import numpy as np

from ..backend import jax, jnp

Array = jax.Array
DEG_SQRT_H = np.pi / 180.0 / 60.0
"""1 deg/sqrt(h) in rad/sqrt(s)."""
DEG_H = np.pi / 180.0 / 3600.0
"""1 deg/h in rad/s."""
DEG_H_SQRT_H = DEG_H / 60.0
"""1 deg/h/sqrt(h) in rad/s/sqrt(s)."""


def gyro_readings(
    turned: Array, dt: Array, drift0: Array, sigma_v: Array, sigma_u: Array, normal: Array
) -> tuple[Array, Array]:
    """Readings (n, 3) rad in B of steps of dt s, and the drift (n, 3) rad/s at their ends.

    turned (n, 3): integral of the true rate over each step, rad; drift0 (3,) rad/s at the start; sigma_v rad/sqrt(s),
    sigma_u rad/s/sqrt(s); normal (n, 3, 3): independent standard normal numbers, three vectors for each step.
    """
    n1, n2, n3 = normal[:, 0], normal[:, 1], normal[:, 2]
    steps = sigma_u * jnp.sqrt(dt) * n2
    drift = drift0 + jnp.cumsum(steps, axis=0)
    walk = sigma_u * dt**1.5 * (0.5 * n2 + n3 / np.sqrt(12.0))
    return turned + (drift - steps) * dt + walk + sigma_v * jnp.sqrt(dt) * n1, drift
