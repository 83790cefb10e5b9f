"""Cramer-Rao bounds: the recursive one along a true trajectory, and the closed steady state of two fixed stars.

With Gaussian noise and the linearisation at the truth the recursive posterior bound is the covariance recursion of the
Kalman filter that knows the truth (Taylor 1979; Tichavsky, Muravchik and Nehorai 1998):

    P-(k) = F P(k-1) F^T + Q,   P(k)^-1 = P-(k)^-1 + H^T R^-1 H
"""

from __future__ import annotations

import numpy as np


def recursive_bound(F: np.ndarray, Q: np.ndarray, information: np.ndarray, P0: np.ndarray) -> np.ndarray:
    """Bound (steps, n, n) after each update.

    F, Q, information = H^T R^-1 H: (steps, n, n) or (n, n), at the truth; P0 (n, n) before the first step, singular
    allowed. Raises ValueError for infinite information: a noiseless sensor has no bound but zero where it sees.
    """
    if np.any(np.isinf(information)):
        raise ValueError("infinite information: a noiseless sensor has no bound but zero where it sees")
    P = np.asarray(P0, float)
    n = P.shape[0]
    steps = max((a.shape[0] for a in (F, Q, information) if np.ndim(a) == 3), default=1)
    F, Q, information = (np.broadcast_to(a, (steps, n, n)) for a in (F, Q, information))
    out = np.empty((steps, n, n))
    eye = np.eye(n)
    for k in range(steps):
        P = F[k] @ P @ F[k].T + Q[k]
        # (I + P J)^-1 P is (P^-1 + J)^-1 without inverting P, which may be singular.
        P = np.linalg.solve(eye + P @ information[k], P)
        P = out[k] = 0.5 * (P + P.T)
    return out


def steady_state_variance(q: float, r: float, m: np.ndarray | float) -> np.ndarray:
    """Steady-state variance after the update of a random walk with variance q per step, seen m times per step with
    variance r: p = (-q + sqrt(q^2 + 4 q r / m)) / 2, computed without the cancellation of a q that is large."""
    s = r / np.asarray(m, float)
    root = q + np.sqrt(q * q + 4.0 * q * s)
    return 2.0 * q * s / np.where(root > 0.0, root, 1.0)
