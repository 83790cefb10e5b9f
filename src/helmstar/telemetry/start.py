"""Where a record's filter starts: the first attitudes that agree with the gyro, and the drift that they imply.

From one attitude to the next the gyro alone predicts q-; what is measured differs by e = log(q (x) q-^-1) = J b, the drift
b acting through J = integral of the turn (see `noise.integrate_gyro`), so b = J^-1 e with the covariance of two attitudes
and of the walk between them. The filter starts at the first attitude with that drift as its mean and a sigma ten times
as wide: so the second attitude counts twice by a hundredth only, and after it the filter has the difference's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..backend import jnp
from ..geometry import quaternion
from .noise import Intervals, NoiseLevels, integrate_gyro
from .timeline import Epochs, Timeline

LOOK = 11
"""Attitudes that are looked at to find a first pair that agrees with the rest."""
DIFFUSE = 10.0
STEPS = 4096
"""Steps of one compiled call of the integration."""


@dataclass(frozen=True)
class Between:
    """From each solvable epoch to the next: numbers (m + 1,) of the epochs and their places (m + 1,) on the timeline; turn q
    (m, 4) by the gyro; J (m, 3, 3); duration (m,); extra variance (m,)."""

    epochs: np.ndarray
    places: np.ndarray
    turn: np.ndarray
    J: np.ndarray
    duration: np.ndarray
    extra: np.ndarray


def integrate_between(timeline: Timeline, epochs: Epochs) -> Between:
    """The gyro integrated from epoch to epoch, drift not taken off."""
    known = np.where(timeline.epoch >= 0, np.isfinite(epochs.q_BN[np.maximum(timeline.epoch, 0), 0]), False)
    places = np.flatnonzero(known)
    restart = known[:-1]
    n = len(timeline.rate)
    dt = np.diff(timeline.time)
    qs, Js = [], []
    q0, J0 = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((3, 3))
    for a in range(0, n, STEPS):
        b = min(a + STEPS, n)
        pad = STEPS - (b - a)
        q, J = integrate_gyro(
            jnp.asarray(np.pad(timeline.rate[a:b], ((0, pad), (0, 0)))),
            jnp.asarray(np.pad(dt[a:b], (0, pad))),
            jnp.asarray(np.pad(restart[a:b], (0, pad))),
            jnp.asarray(q0),
            jnp.asarray(J0),
        )
        q, J = np.asarray(q), np.asarray(J)
        qs.append(q[: b - a])
        Js.append(J[: b - a])
        q0, J0 = q[-1], J[-1]
    q, J = np.concatenate(qs), np.concatenate(Js)
    ends = places[1:] - 1
    total = np.concatenate([[0.0], np.cumsum(timeline.extra)])
    return Between(
        timeline.epoch[places],
        places,
        q[ends],
        J[ends],
        np.diff(timeline.time[places]),
        total[places[1:]] - total[places[:-1]],
    )


def drifts(between: Between, epochs: Epochs) -> np.ndarray:
    """Drift (m, 3) in rad/s that each pair of attitudes implies."""
    q = jnp.asarray(epochs.q_BN[between.epochs])
    predicted = quaternion.multiply(jnp.asarray(between.turn), q[:-1])
    e = np.asarray(quaternion.log(quaternion.multiply(q[1:], quaternion.conjugate(predicted))))
    return np.linalg.solve(between.J, e[..., None])[..., 0]


def intervals(between: Between, epochs: Epochs, drift: np.ndarray) -> Intervals:
    """What the noise estimate needs: turns with a drift taken off."""
    corrected = np.einsum("mij,j->mi", between.J, drift)
    q = quaternion.multiply(quaternion.exp(jnp.asarray(corrected)), jnp.asarray(between.turn))
    turn = -np.asarray(quaternion.log(q))
    return Intervals(epochs.q_BN[between.epochs], epochs.shape[between.epochs], turn, between.duration, between.extra)


def pair_sigma(between: Between, epochs: Epochs, levels: NoiseLevels) -> np.ndarray:
    """1 sigma (m, 3) of `drifts`, rad/s."""
    P = epochs.shape[between.epochs] * levels.sigma**2
    T = between.duration
    variance = (
        np.diagonal(P[1:] + P[:-1], axis1=1, axis2=2)
        + (levels.sigma_v**2 * T + levels.sigma_u**2 * T**3 / 3.0 + between.extra)[:, None]
    )
    return np.sqrt(variance) / T[:, None]


def agreeing_pair(drift: np.ndarray, sigma: np.ndarray) -> int:
    """Number of the first pair whose drift agrees with the median of the first pairs, within 8 of its sigmas and of their
    scatter; the pair nearest to the median when none does."""
    first = drift[:LOOK]
    median = np.median(first, axis=0)
    scatter = 1.4826 * np.median(np.abs(first - median), axis=0)
    off = np.max(np.abs(first - median) / (8.0 * np.maximum(sigma[:LOOK], scatter)), axis=1)
    good = np.flatnonzero(off <= 1.0)
    return int(good[0]) if len(good) else int(np.argmin(off))
