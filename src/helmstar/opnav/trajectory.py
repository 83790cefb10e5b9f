"""Relative trajectory from centres and sizes of a body: batch least squares with a prior, and its covariance.

Unknowns: x (3,) and v (3,), the probe relative to the body in N at the epoch, m and m/s; b (3,), an error of the camera's
pointing that all frames share, rotation vector in C, rad; k, the logarithm of the body's size over the expected one; c (2,), a
shift of centres that frames share, towards the Sun and across, in apparent radii (law and figure). All have priors. Motion is
straight, or two-body where GM is given. A frame measures the pixel of the body's centre, r_TC_C = -(I - [b x]) R_CN x(t), plus
the shift, and where its size is resolved ln(R/rho). Solved by least squares of whitened residuals; frames that stay farther than
GATE sigma from the rest are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from ..imaging.camera import Camera

GATE = 5.0
NAMES = ("x", "y", "z", "vx", "vy", "vz", "bx", "by", "bz", "k", "c_sun", "c_across")


@dataclass(frozen=True)
class Observation:
    """One frame. time: s. R_CN: (3, 3). centre_px: (2,), noise_px: (2, 2) of its own. sun_px: (2,) unit, the Sun's direction in the
    image. log_size: ln of apparent over expected size at expected_distance, m, with log_size_sigma; NaN where not resolved."""

    time: float
    R_CN: np.ndarray
    centre_px: np.ndarray
    noise_px: np.ndarray
    sun_px: np.ndarray
    radius_px: float
    expected_distance: float
    log_size: float = float("nan")
    log_size_sigma: float = float("nan")


@dataclass(frozen=True)
class Prior:
    """epoch: s. mean: (12,) and sigma: (12,) of the unknowns, in the order of NAMES. gm: m^3/s^2."""

    epoch: float
    mean: np.ndarray
    sigma: np.ndarray
    gm: float = 0.0


@dataclass(frozen=True)
class Trajectory:
    """unknowns: (12,) with covariance (12, 12). used: (n,) bool, which observations. residual_sigma: (n,) root mean square of each
    observation's pixel residuals over their sigma. chi2: per degree of freedom. gm, epoch: as the prior's."""

    epoch: float
    unknowns: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    residual_sigma: np.ndarray
    chi2: float
    gm: float

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (n, 6), m and m/s, at times (n,), s, and covariance (n, 6, 6)."""
        time = np.asarray(time, float)
        state = states(self.unknowns[:6], time - self.epoch, self.gm)
        h = np.maximum(1e-3 * np.sqrt(np.maximum(np.diagonal(self.covariance)[:6], 0.0)), 1e-6)
        after = lambda e: states(self.unknowns[:6] + e, time - self.epoch, self.gm)
        F = np.stack([(after(e) - after(-e)) / (2.0 * e.max()) for e in np.diag(h)], axis=-1)
        return state, F @ self.covariance[:6, :6] @ np.swapaxes(F, -1, -2)


def states(start: np.ndarray, dt: np.ndarray, gm: float) -> np.ndarray:
    """Position and velocity (n, 6) after dt (n,), s, from a start (6,): straight, or about a point mass of gm m^3/s^2."""
    dt = np.asarray(dt, float)
    if gm <= 0.0:
        return np.concatenate([start[:3] + dt[:, None] * start[3:], np.broadcast_to(start[3:], (len(dt), 3))], axis=1)
    out = np.empty((len(dt), 6))
    for sign in (-1.0, 1.0):
        part = np.flatnonzero(dt * sign > 0.0)
        if part.size:
            order = part[np.argsort(np.abs(dt[part]))]
            run = solve_ivp(
                lambda _, s: np.concatenate([s[3:], -gm * s[:3] / np.linalg.norm(s[:3]) ** 3]),
                (0.0, float(dt[order[-1]])), start, method="DOP853", t_eval=dt[order], rtol=1e-11, atol=1e-6,
            )  # fmt: skip
            out[order] = run.y.T
    out[dt == 0.0] = start
    return out


def predict_px(
    camera: Camera,
    unknowns: np.ndarray,
    position: np.ndarray,
    R_CN: np.ndarray,
    sun_px: np.ndarray,
    radius_px: np.ndarray,
) -> np.ndarray:
    """Pixels (n, 2) of the measured centre for positions (n, 3) and attitudes (n, 3, 3)."""
    r_C = -np.einsum("nij,nj->ni", R_CN, position)
    r_C = r_C - np.cross(unknowns[6:9], r_C)
    across = np.stack([-sun_px[:, 1], sun_px[:, 0]], axis=1)
    shift = unknowns[10] * sun_px + unknowns[11] * across
    return camera.pixels(r_C) + radius_px[:, None] * shift


def solve(camera: Camera, prior: Prior, observations: list[Observation]) -> Trajectory:
    """The trajectory of most probability. With no observation, the prior's."""
    n = len(observations)
    if not n:
        return Trajectory(
            prior.epoch, prior.mean, np.diag(prior.sigma**2), np.zeros(0, bool), np.zeros(0), np.nan, prior.gm
        )
    time = np.array([o.time for o in observations])
    R = np.stack([o.R_CN for o in observations])
    z = np.stack([o.centre_px for o in observations])
    W = np.linalg.inv(np.linalg.cholesky(np.stack([o.noise_px for o in observations])))
    sun, radius = np.stack([o.sun_px for o in observations]), np.array([o.radius_px for o in observations])
    expected = np.array([o.expected_distance for o in observations])
    log_size = np.array([o.log_size for o in observations])
    size_sigma = np.array([o.log_size_sigma for o in observations])
    sized = np.isfinite(log_size) & np.isfinite(size_sigma)
    used = np.ones(n, bool)

    def pixels(p: np.ndarray) -> np.ndarray:
        position = states(p[:6], time - prior.epoch, prior.gm)[:, :3]
        ahead = predict_px(camera, p, position, R, sun, radius)
        return np.nan_to_num(np.einsum("nij,nj->ni", W, z - ahead), nan=1e6)

    def residuals(p: np.ndarray) -> np.ndarray:
        position = states(p[:6], time - prior.epoch, prior.gm)[:, :3]
        distance = np.linalg.norm(position, axis=1)
        size = np.where(sized, (log_size - p[9] + np.log(distance / expected)) / np.where(sized, size_sigma, 1.0), 0.0)
        return np.concatenate([(pixels(p) * used[:, None]).ravel(), size * used, (prior.mean - p) / prior.sigma])

    p, out = prior.mean.copy(), None
    for _ in range(5):
        out = least_squares(residuals, p, x_scale=prior.sigma, method="trf", jac="3-point", max_nfev=60)
        p = out.x
        each = np.sqrt(np.mean(pixels(p) ** 2, axis=1))
        # The worst go first, and only while most agree: with few frames there is nobody to ask.
        bad = each > GATE
        if n < 4 or bad.sum() == (~used).sum() or not used.any():
            break
        worst = np.argsort(-each)[: max(1, n // 5)]
        now = ~(bad & np.isin(np.arange(n), worst))
        if (now == used).all() or now.sum() < max(3, n // 2):
            break
        used = now
    assert out is not None
    C = np.linalg.inv(out.jac.T @ out.jac)
    degrees = max(2 * int(used.sum()) + int((sized & used).sum()), 1)
    return Trajectory(
        prior.epoch, p, C, used, np.sqrt(np.mean(pixels(p) ** 2, axis=1)), 2.0 * out.cost / degrees, prior.gm
    )


__all__ = ["GATE", "NAMES", "Observation", "Prior", "Trajectory", "predict_px", "solve", "states"]
