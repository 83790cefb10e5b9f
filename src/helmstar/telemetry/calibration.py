"""Misalignment and scale factors of a gyro: first roughly, by least squares over the record, then which of them show.

Brought back to one instant (see `series`), neighbouring attitudes differ by what the gyro's integral misses,

    log(D_k+1 D_k^-1) = integral of P^-1 (b - [omega x] mu + diag(omega) s) dt,

which is linear in drift b, misalignment mu and scale factors s. The filter starts from the rates so corrected, so that its
linearisation and its gate have little left to do. Whether the record shows a number at all is told by the bound, covariances
along the measured rates: where its sigma at the end has not fallen to SHOWN of that before, it is not estimated, but its
uncertainty goes on to count (a considered state). At a constant rate all six look like drift, and nothing is shown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .estimate import Estimates
from .rates import RateSignal
from .series import cumulative
from .timeline import Epochs, build_timeline

SHOWN = 0.3
ROUNDS = 8
NAMES = ("misalignment_x", "misalignment_y", "misalignment_z", "scale_x", "scale_y", "scale_z")
"""Of the six numbers, in order."""


@dataclass(frozen=True)
class Calibration:
    """What was found: prior sigma (6,) of misalignment (rad) and scale factors, 0 of what was not asked for; `rough` (6,) was
    taken off the rates before the filter; `bound` (6,) is the sigma that the record allows; `observable` (6,)."""

    prior: np.ndarray
    rough: np.ndarray
    bound: np.ndarray
    observable: np.ndarray


def corrected(signal: RateSignal, rough: np.ndarray) -> RateSignal:
    """The signal with a misalignment and scale factors (6,) taken off: omega = exp(-[mu x]) u / (1 + s)."""
    if not rough.any():
        return signal
    back = Rotation.from_rotvec(-rough[:3]).as_matrix()

    def turn(rate: np.ndarray) -> np.ndarray:
        return (rate / (1.0 + rough[3:])) @ back.T

    return replace(signal, first=turn(signal.first), last=turn(signal.last))


def rough_calibration(signal: RateSignal, epochs: Epochs, prior: np.ndarray) -> np.ndarray:
    """Misalignment (rad) and scale factors (6,) by robust least squares over neighbouring attitudes; 0 where the prior is."""
    asked = prior > 0.0
    found = np.zeros(6)
    for _ in range(2):  # once more about the first answer, for the second order
        y, A = _differences(corrected(signal, found), epochs)
        if len(y) < 4:
            return np.zeros(6)
        columns = np.concatenate([np.ones(3, bool), asked])
        H = A[:, :, columns]
        # In units of the prior; the drift's own is wide.
        unit = np.concatenate([np.full(3, 1e-2), prior[asked]])
        weight = np.ones(len(y))
        x = np.zeros(H.shape[2])
        for _ in range(ROUNDS):
            scaled = (weight[:, None, None] * H * unit).reshape(-1, H.shape[2])
            noise = _scale(y - np.einsum("kij,j->ki", H, x * unit))
            rows = np.concatenate([scaled / noise, np.eye(H.shape[2])])
            target = np.concatenate([(weight[:, None] * y).reshape(-1) / noise, np.zeros(H.shape[2])])
            x = np.linalg.lstsq(rows, target, rcond=None)[0]
            miss = np.linalg.norm(y - np.einsum("kij,j->ki", H, x * unit), axis=1)
            # Cauchy weights: a wrong attitude makes two large differences, which then count for little.
            weight = 1.0 / np.sqrt(1.0 + (miss / (3.0 * _scale(miss) + 1e-30)) ** 2)
        step = np.zeros(6)
        step[asked] = (x * unit)[3:]
        found = np.where(asked, found + step, 0.0)
    return found


def _scale(values: np.ndarray) -> float:
    """Robust size of residuals."""
    return float(1.4826 * np.median(np.abs(values)) + 1e-12)


def _differences(signal: RateSignal, epochs: Epochs) -> tuple[np.ndarray, np.ndarray]:
    """y (k, 3) = log(D_k+1 D_k^-1) and its derivatives (k, 3, 9) by drift, misalignment and scale factors."""
    t = build_timeline(signal, epochs)
    dt = np.diff(t.time)
    P = cumulative(-t.rate * dt[:, None])
    back = Rotation.from_quat(P).inv().as_matrix()
    middle = 0.5 * (back[1:] + back[:-1])
    hat = np.zeros((len(dt), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        hat[:, i, j], hat[:, j, i] = -t.rate[:, k], t.rate[:, k]
    local = np.concatenate([np.broadcast_to(np.eye(3), hat.shape), -hat, t.rate[:, :, None] * np.eye(3)], axis=2)
    lost = np.where(t.lost, 0.0, 1.0)
    A = np.concatenate([np.zeros((1, 3, 9)), np.cumsum(middle @ local * (dt * lost)[:, None, None], axis=0)])
    at = np.flatnonzero((t.epoch >= 0) & epochs.solved[np.maximum(t.epoch, 0)])
    D = Rotation.from_quat(P[at]).inv() * Rotation.from_quat(epochs.q_BN[t.epoch[at]])
    y = (D[1:] * D[:-1].inv()).as_rotvec()
    # A pair with a gap between says nothing of the gyro.
    count = np.concatenate([[0], np.cumsum(t.lost)])[at]
    whole = count[1:] == count[:-1]
    return y[whole], np.diff(A[at], axis=0)[whole]


def in_gyro_axes(e: Estimates, rough: np.ndarray) -> Estimates:
    """Estimates from rates that `rough` was taken off: drift and its covariance in the gyro's own axes and scale, and the
    whole misalignment and scale factors."""
    if e.calibration is None:
        return e
    turn = Rotation.from_rotvec(rough[:3])
    M = (1.0 + rough[3:])[:, None] * turn.as_matrix()
    T = np.zeros((6, 6))
    T[:3, :3], T[3:, 3:] = np.eye(3), M
    misalignment = (turn * Rotation.from_rotvec(e.calibration[:, :3])).as_rotvec()
    scale = (1.0 + rough[3:]) * (1.0 + e.calibration[:, 3:]) - 1.0
    return replace(
        e, drift=e.drift @ M.T, cov=T @ e.cov @ T.T, calibration=np.concatenate([misalignment, scale], axis=1)
    )


def observed(prior: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Which of the numbers (6,) the record shows."""
    return (prior > 0.0) & (bound < SHOWN * prior)
