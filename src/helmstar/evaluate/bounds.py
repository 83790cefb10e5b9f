"""Cramer-Rao bounds: the recursive one along a true trajectory, and the closed steady state of two fixed stars.

With Gaussian noise and the linearisation at the truth the recursive posterior bound is the covariance recursion of the
Kalman filter that knows the truth (Taylor 1979; Tichavsky, Muravchik and Nehorai 1998):

    P-(k) = F P(k-1) F^T + Q,   P(k)^-1 = P-(k)^-1 + H^T R^-1 H
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


def recursive_bound(F: np.ndarray, Q: np.ndarray, information: np.ndarray, P0: np.ndarray) -> np.ndarray:
    """Bound (steps, ..., n, n) after each update.

    F, Q, information = H^T R^-1 H: (steps, ..., n, n) or (n, n), at the truth; P0 (..., n, n) before the first step,
    singular allowed. Axes between are batch axes.
    Raises ValueError for infinite information: a noiseless sensor has no bound but zero where it sees.
    """
    if np.any(np.isinf(information)):
        raise ValueError("infinite information: a noiseless sensor has no bound but zero where it sees")
    P = np.asarray(P0, float)
    n = P.shape[-1]
    steps = max((a.shape[0] for a in (F, Q, information) if np.ndim(a) >= 3), default=1)
    F, Q, information = (np.broadcast_to(a, (steps, n, n)) if np.ndim(a) == 2 else a for a in (F, Q, information))
    out = np.empty((steps, *np.broadcast_shapes(F.shape[1:], Q.shape[1:], information.shape[1:], P.shape)))
    eye = np.eye(n)
    for k in range(steps):
        P = F[k] @ P @ np.swapaxes(F[k], -1, -2) + Q[k]
        # (I + P J)^-1 P is (P^-1 + J)^-1 without inverting P, which may be singular.
        P = np.linalg.solve(eye + P @ information[k], P)
        P = out[k] = 0.5 * (P + np.swapaxes(P, -1, -2))
    return out


def steady_state_variance(q: float, r: float, m: np.ndarray | float) -> np.ndarray:
    """Steady-state variance after the update of a random walk with variance q per step, seen m times per step with
    variance r: p = (-q + sqrt(q^2 + 4 q r / m)) / 2, computed without the cancellation of a q that is large."""
    s = r / np.asarray(m, float)
    root = q + np.sqrt(q * q + 4.0 * q * s)
    return 2.0 * q * s / np.where(root > 0.0, root, 1.0)


class Farrenkopf(NamedTuple):
    """Steady-state sigmas after an update and before the next one: attitude in rad, drift in rad/s."""

    attitude: np.ndarray
    drift: np.ndarray
    attitude_before: np.ndarray
    drift_before: np.ndarray


def farrenkopf(sigma_n: Any, sigma_v: Any, sigma_u: Any, dt: Any) -> Farrenkopf:
    """Steady state of one axis with a gyro: attitude measured every dt s with sigma_n rad, gyro of sigma_v rad/sqrt(s) and
    sigma_u rad/s/sqrt(s). Arrays broadcast.

    Source: Farrenkopf 1978; Markley and Crassidis 2014, section 6.2.4, without readout noise: with S_u = sigma_u dt^(3/2) /
    sigma_n, S_v = sigma_v dt^(1/2) / sigma_n, gamma^2 = 1 + S_v^2 / 4 + S_u^2 / 48 and zeta = gamma + S_u / 4 + (2 gamma S_u
    + S_v^2 + S_u^2 / 3)^(1/2) / 2 the attitude has sigma_n (1 - zeta^-2)^(1/2) after and sigma_n (zeta^2 - 1)^(1/2) before
    the update. The drift follows from the balance of the covariance with the attitude over one step.
    """
    n, v, u, dt = (np.asarray(a, float) for a in (sigma_n, sigma_v, sigma_u, dt))
    S_u, S_v = u * dt**1.5 / n, v * np.sqrt(dt) / n
    gamma = np.sqrt(1.0 + 0.25 * S_v**2 + S_u**2 / 48.0)
    zeta = gamma + 0.25 * S_u + 0.5 * np.sqrt(2.0 * gamma * S_u + S_v**2 + S_u**2 / 3.0)
    # zeta^2 - 1 without the cancellation at small noise: zeta - 1 from gamma - 1.
    less = (0.25 * S_v**2 + S_u**2 / 48.0) / (gamma + 1.0)
    less = less + 0.25 * S_u + 0.5 * np.sqrt(2.0 * gamma * S_u + S_v**2 + S_u**2 / 3.0)
    excess = less * (zeta + 1.0)
    drift = np.sqrt(np.maximum(u * n * excess / (zeta * np.sqrt(dt)) - 0.5 * u**2 * dt, 0.0))
    return Farrenkopf(n * np.sqrt(excess) / zeta, drift, n * np.sqrt(excess), np.sqrt(drift**2 + u**2 * dt))
