"""The few numbers that a report works out for itself, in NumPy: quantiles over runs, settling, bands, Euler angles."""

from __future__ import annotations

import math

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
    """The update at which each series (..., time) goes below the threshold and stays; NaN if it never does."""
    above = ~(angle < threshold)
    count = angle.shape[-1]
    first = np.where(above.any(axis=-1), count - np.argmax(above[..., ::-1], axis=-1), 0)
    return np.where(first < count, update[np.minimum(first, count - 1)].astype(float), np.nan)


def chi_square_band(degrees: np.ndarray | float, probability: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
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


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """exp([v x]) for rotation vectors (..., 3), Rodrigues' formula; exact to rounding for every angle, 0 included."""
    x, y, z = np.moveaxis(vector, -1, 0)
    angle = np.sqrt(x * x + y * y + z * z)
    a = np.sinc(angle / math.pi)
    b = 0.5 * np.sinc(angle / (2.0 * math.pi)) ** 2
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)
    return np.eye(3) + a[..., None, None] * cross + b[..., None, None] * (cross @ cross)


def rotation_from_quaternion(q: np.ndarray) -> np.ndarray:
    """R of unit quaternions (..., 4), scalar last."""
    u, w = q[..., :3], q[..., 3]
    x, y, z = np.moveaxis(u, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*q.shape[:-1], 3, 3)
    return np.eye(3) + 2.0 * w[..., None, None] * cross + 2.0 * cross @ cross


def tait_bryan_deg(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (..., 3) in degrees of R = Rz(yaw) Ry(pitch) Rx(roll); singular at a pitch of +-90 deg."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))


def euler_difference_deg(truth_q: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Euler angles of the estimate minus those of the truth, in (-180, 180]: X_hat = X exp(-[error x])."""
    truth = rotation_from_quaternion(truth_q)
    estimate = truth @ rotation_from_vector(-error)
    difference = tait_bryan_deg(estimate) - tait_bryan_deg(truth)
    return -((-difference + 180.0) % 360.0 - 180.0)
