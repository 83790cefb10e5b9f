"""Attitudes brought back to one instant by the gyro alone: what start and noise are found from.

With P(t) the turn since the first instant by the gyro less a drift b0, R_BN(t) = P(t) R_BN(0), an attitude measured at t_k is
brought back as D_k = P(t_k)^-1 R_k. Without errors all D_k are equal; a further drift b makes them differ by

    log(D_k D_i^-1) = (A_k - A_i) b,   A(t) = integral of P^-1 dt  (3 x 3, s)

in the axes that B has at the first instant, and so do noise and walk, whose covariances are brought back alike.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .timeline import Epochs, Timeline


@dataclass(frozen=True)
class Series:
    """Of m solved epochs: numbers (m,), times (m,) in s, D (m, 4), A (m, 3, 3), covariance shape brought back (m, 3, 3), and
    variance (m, 3) in rad^2 that gaps have added since the first instant. `drift` (3,) rad/s was taken off the gyro."""

    epochs: np.ndarray
    time: np.ndarray
    D: np.ndarray
    A: np.ndarray
    shape: np.ndarray
    extra: np.ndarray
    drift: np.ndarray

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: np.ndarray) -> Series:
        """Those at an index or mask."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "drift"})

    def since(self, i: int) -> np.ndarray:
        """Rotation vectors (m, 3) from the i-th to each: log(D_k D_i^-1)."""
        return (Rotation.from_quat(self.D) * Rotation.from_quat(self.D[i]).inv()).as_rotvec()

    def steps(self) -> np.ndarray:
        """Rotation vectors (m - 1, 3) from each to the next."""
        return (Rotation.from_quat(self.D[1:]) * Rotation.from_quat(self.D[:-1]).inv()).as_rotvec()

    def drifts(self) -> np.ndarray:
        """Drift (m - 1, 3) in rad/s that each pair of neighbours implies, as far as it shows in them."""
        return self.drift + np.einsum("mab,mb->ma", pseudo_inverse(np.diff(self.A, axis=0)), self.steps())


UNSEEN = 1e-3
"""A body that turns fully round between two attitudes hides its drift across the axis: A then is singular. What A shrinks
by more than this, relative to the axis it shrinks least, counts as not seen."""


def pseudo_inverse(A: np.ndarray, unseen: float = 0.0) -> np.ndarray:
    """Inverse (..., 3, 3) of finite A, with directions that are `UNSEEN` given this share of the largest they may have
    (0: no drift is concluded in them; 1: its variance is still as large as can be told)."""
    U, s, Vt = np.linalg.svd(A)
    floor = np.maximum(UNSEEN * s[..., :1], np.finfo(float).tiny)
    inverse = np.where(s > floor, 1.0, unseen) / np.maximum(s, floor)
    return np.swapaxes(Vt, -1, -2) * inverse[..., None, :] @ np.swapaxes(U, -1, -2)


def bring_back(timeline: Timeline, epochs: Epochs, drift: np.ndarray) -> Series:
    """The solved epochs of a timeline, by its gyro rates less `drift` (3,) in rad/s."""
    dt = np.diff(timeline.time)[:, None]
    phi = (timeline.rate - drift) * dt
    P = cumulative(-phi)
    # d A = P^-1 dt over a step that turns by -phi to its end: dt J(-phi) there, J being the left Jacobian of SO(3)
    hat = np.zeros((len(phi), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        hat[:, i, j], hat[:, j, i] = -phi[:, k], phi[:, k]
    angle = np.linalg.norm(phi, axis=1)[:, None, None]
    first, second = 0.5 * np.sinc(0.5 / np.pi * angle) ** 2, _third_order(angle)
    local = (np.eye(3) - first * hat + second * hat @ hat) * dt[..., None]
    back = Rotation.from_quat(P).inv().as_matrix()
    A = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(back[1:] @ local, axis=0)])
    extra = np.concatenate([np.zeros((1, 3)), np.cumsum(timeline.extra, axis=0)])

    number = timeline.epoch
    at = np.flatnonzero((number >= 0) & epochs.solved[np.maximum(number, 0)])
    e = number[at]
    M = back[at]
    D = (Rotation.from_quat(P[at]).inv() * Rotation.from_quat(epochs.q_BN[e])).as_quat()
    shape = M @ epochs.shape[e] @ np.swapaxes(M, 1, 2)
    return Series(e, timeline.time[at], D, A[at], shape, extra[at], drift)


def _third_order(angle: np.ndarray) -> np.ndarray:
    """(x - sin x) / x^3, by its series where the difference would lose digits."""
    x = np.maximum(angle, 0.1)
    series = 1.0 / 6.0 - angle**2 / 120.0 + angle**4 / 5040.0 - angle**6 / 362880.0
    return np.where(angle < 0.1, series, (x - np.sin(x)) / x**3)


def cumulative(turns: np.ndarray) -> np.ndarray:
    """Quaternions (n + 1, 4): the identity and the products of n rotation vectors, later ones on the left, by doubling."""
    q = Rotation.from_rotvec(turns).as_quat()
    reach = 1
    while reach < len(q):
        later = Rotation.from_quat(q[reach:]) * Rotation.from_quat(q[:-reach])
        q = np.concatenate([q[:reach], later.as_quat()])
        reach *= 2
    return np.concatenate([[[0.0, 0.0, 0.0, 1.0]], q])
