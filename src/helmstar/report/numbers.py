"""The few numbers that a report works out for itself, in NumPy: quantiles over runs, settling, bands, Euler angles."""

from __future__ import annotations

import numpy as np


def quantiles(values: np.ndarray, probabilities: tuple[float, ...]) -> np.ndarray:
    """Quantiles over the first axis, NaN left out; shape (len(probabilities), ...). NaN where nothing is finite."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.sum(~np.isnan(values), axis=0)
    result = np.empty((len(probabilities), *values.shape[1:]))
    for i, probability in enumerate(probabilities):
        position = probability * np.maximum(count - 1, 0)
        low = np.floor(position).astype(int)
        high = np.minimum(low + 1, np.maximum(count - 1, 0))
        lower = np.take_along_axis(ordered, low[None], axis=0)[0]
        upper = np.take_along_axis(ordered, high[None], axis=0)[0]
        with np.errstate(invalid="ignore"):
            result[i] = np.where(upper == lower, lower, lower + (position - low) * (upper - lower))
    return result


def total_angle(error: np.ndarray) -> np.ndarray:
    """Norm of rotation vectors (..., 3). A lost run (NaN) counts as infinitely wrong: no quantile may forget it."""
    angle = np.sqrt(np.sum(error * error, axis=-1))
    return np.where(np.isnan(angle), np.inf, angle)


def total_quantile(sigma: np.ndarray, probability: float) -> np.ndarray:
    """Quantile of |e| for e ~ N(0, diag(sigma^2)), sigma (..., 3), by a gamma law of |e|^2's mean and variance."""
    from scipy.special import gammaincinv

    squares = sigma * sigma
    mean, variance = squares.sum(axis=-1), 2.0 * (squares * squares).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(gammaincinv(mean * mean / variance, probability) * variance / mean)


def settled_at(angle: np.ndarray, update: np.ndarray, threshold: float) -> np.ndarray:
    """The number in `update` (time,) at which each run of `angle` (run, time) goes below the threshold and stays; NaN if it
    never does."""
    from ..evaluate.convergence import arrival

    place = arrival(angle, threshold).updates  # from 1, whatever `update` counts; 0 for never
    return np.where(place > 0, update[np.maximum(place, 1) - 1].astype(float), np.nan)


def chi_square_ratio_band(degrees: np.ndarray | float, probability: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided band of a chi-square variable with so many degrees of freedom, divided by them (its mean is 1)."""
    from scipy.special import gammaincinv  # scipy.stats takes a second to import, and this is its own formula

    dof = np.asarray(degrees, dtype=float)
    tail = 0.5 * (1.0 - probability)
    safe = np.where(dof > 0.0, dof, np.nan)
    return 2.0 * gammaincinv(0.5 * safe, tail) / safe, 2.0 * gammaincinv(0.5 * safe, 1.0 - tail) / safe


def mean_over_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the first axis of what is finite, and how many that were."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count


def tait_bryan_deg(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (..., 3) in degrees of R = Rz(yaw) Ry(pitch) Rx(roll); singular at a pitch of +-90 deg."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))


def euler_difference_deg(truth_q: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Euler angles of the estimate minus those of the truth, in (-180, 180]: X_hat = X exp(-[error x]).

    truth_q (..., 4) scalar last, error (..., 3) in rad; (..., 3) roll, pitch, yaw in degrees; NaN for an
    error that is not finite.
    """
    from scipy.spatial.transform import Rotation

    truth, finite = Rotation.from_quat(truth_q), np.isfinite(error).all(axis=-1, keepdims=True)
    estimate = truth * Rotation.from_rotvec(np.where(finite, -error, 0.0))  # scipy refuses a NaN
    difference = tait_bryan_deg(estimate.as_matrix()) - tait_bryan_deg(truth.as_matrix())
    return np.where(finite, -((-difference + 180.0) % 360.0 - 180.0), np.nan)
