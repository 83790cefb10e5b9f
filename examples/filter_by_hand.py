"""Attitude and gyro drift by hand: build a model, simulate it, filter it, smooth it, and ask whether it is consistent.

A body turns at half a degree per second with a gyro that drifts; two stars are seen once a second.
"""

import numpy as np

from helmstar.backend import jax, jnp
from helmstar.core import Gaussian, Measurement, chi_square_gate
from helmstar.evaluate import chi_square_band
from helmstar.filters import ErrorStateKalmanFilter, run, smooth
from helmstar.geometry import quaternion
from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model
from helmstar.models.sensors import star_directions

ARCSEC = np.pi / 180 / 3600
STEPS, DT = 600, 1.0
SIGMA_STAR, SIGMA_V, SIGMA_U = 20 * ARCSEC, 1 * ARCSEC, 0.01 * ARCSEC  # rad, rad/sqrt(s), rad/s/sqrt(s)


def simulate(key):
    """Truth (AttitudeDrift over time), gyro rates (STEPS, 3) in B, stars (STEPS, 2, 3) in B and their directions in N."""
    k = jax.random.split(key, 4)
    t = jnp.arange(STEPS) * DT
    omega = jnp.deg2rad(0.5) * jnp.stack([jnp.cos(0.01 * t), jnp.sin(0.01 * t), jnp.ones(STEPS)], axis=1)
    walk = SIGMA_U * np.sqrt(DT) * jax.random.normal(k[0], (STEPS, 3))
    b = 50 * ARCSEC + jnp.cumsum(walk, axis=0)  # at the end of each step

    def turn(q, w):
        q = quaternion.multiply(quaternion.exp(-w * DT), q)  # R_BN(k+1) = exp(-[w dt x]) R_BN(k)
        return q, q

    q_BN = jax.lax.scan(turn, quaternion.identity(), omega)[1]
    rate = omega + (b - walk) + SIGMA_V / np.sqrt(DT) * jax.random.normal(k[1], (STEPS, 3))
    r_N = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    stars = jax.vmap(lambda q: r_N @ quaternion.to_matrix(q).T)(q_BN)
    return AttitudeDrift(q_BN, b), rate, stars + SIGMA_STAR * jax.random.normal(k[2], stars.shape), r_N


def main(seed=0):
    truth, rate, stars, r_N = simulate(jax.random.key(seed))
    noise = GyroNoise(jnp.asarray(SIGMA_V), jnp.asarray(SIGMA_U))
    model = attitude_drift_model(noise, sensors=(star_directions(SIGMA_STAR),))
    filter = ErrorStateKalmanFilter(model.retraction)  # the error lives on the left, in body axes: a MEKF

    start = Gaussian(
        AttitudeDrift(quaternion.exp(jnp.array([0.02, -0.01, 0.01])), jnp.zeros(3)),
        jnp.diag(jnp.array([0.02**2] * 3 + [(100 * ARCSEC) ** 2] * 3)),
    )
    measurement = Measurement(stars, jnp.broadcast_to(r_N, stars.shape), jnp.ones((STEPS, 2), dtype=bool))
    u = GyroInput(rate, jnp.zeros((STEPS, 3, 3)))
    _, _, track = run(filter, model, start, u, jnp.full(STEPS, DT), (measurement,), chi_square_gate(1e-6))
    smoothed = smooth(filter.retraction, track.belief, track.predicted)

    def errors(beliefs):
        """Errors (STEPS, 6) by the filter's own retraction, and NEES of 6 states."""
        e = jax.vmap(model.retraction.boxminus)(truth, beliefs.mean)
        return np.asarray(e), np.einsum("ni,ni->n", e, np.linalg.solve(beliefs.cov, e[..., None])[..., 0])

    result = {}
    for name, beliefs in (("filtered", track.belief), ("smoothed", smoothed)):
        e, nees = errors(beliefs)
        half = slice(STEPS // 4, None)
        result[name] = {
            "attitude_arcsec": float(np.sqrt(np.mean(e[half, :3] ** 2)) / ARCSEC),
            "drift_arcsec_s": float(np.sqrt(np.mean(e[half, 3:] ** 2)) / ARCSEC),
            "nees": float(nees[half].mean()),
        }
        print(
            f"{name}: attitude {result[name]['attitude_arcsec']:.2f} arcsec, drift {result[name]['drift_arcsec_s']:.3f} "
            f"arcsec/s rms per axis, NEES {result[name]['nees']:.2f} of 6"
        )
    nis = float(np.mean(track.infos[0].nis))
    low, high = chi_square_band(6, STEPS)
    result["nis"] = nis
    result["nis_band"] = (low, high)
    print(f"mean NIS {nis:.2f}, 95 percent band {low:.2f} to {high:.2f}")
    return result


if __name__ == "__main__":
    main()
