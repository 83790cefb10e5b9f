"""Where a record's filter starts: the first attitude that agrees with the gyro and its neighbours, and their drift.

Attitudes are brought back to one instant by the gyro alone, D_k = P_k^-1 R_k. Without errors all are equal; with a
drift b they differ by y_k = log(D_k D_i^-1) = (A_k - A_i) b, A_k = P_k^-1 J_k (see `noise.integrate_gyro`). In a window of the
first attitudes each pair is taken as a guess of start and drift, and the guess that most others agree with decides which
of them are right. The filter starts at the first right one with the drift from it to the second, and a sigma ten times
as wide: so the second attitude counts twice by a hundredth only, and after it the filter has the difference's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..backend import jnp
from ..geometry import quaternion
from .noise import Intervals, NoiseLevels, integrate_gyro
from .timeline import Epochs, Timeline

WINDOW = 12
"""Attitudes that are looked at together."""
AGREE = 0.6
"""Share of a window that must agree, or the next one is looked at."""
WINDOWS = 50
"""Windows that are tried at most."""
DIFFUSE = 10.0
STEPS = 4096
"""Steps of one compiled call of the integration."""


@dataclass(frozen=True)
class Between:
    """From each solved epoch to the next: numbers (m + 1,) of the epochs and their times (m + 1,); turn q (m, 4) by the
    gyro with `drift` (3,) taken off; J (m, 3, 3), through which a further drift acts; extra variance (m, 3)."""

    epochs: np.ndarray
    time: np.ndarray
    turn: np.ndarray
    J: np.ndarray
    extra: np.ndarray
    drift: np.ndarray

    @property
    def duration(self) -> np.ndarray:
        """Length (m,) in s."""
        return np.diff(self.time)


def integrate_between(timeline: Timeline, epochs: Epochs, take: np.ndarray, drift: np.ndarray) -> Between:
    """The gyro less `drift` (3,) integrated between the epochs that the mask `take` (m,) names, all of them solved."""
    number = timeline.epoch
    known = (number >= 0) & take[np.maximum(number, 0)]
    places = np.flatnonzero(known)
    n = len(timeline.rate)
    dt = np.diff(timeline.time)
    rate = timeline.rate - drift
    qs, Js = [np.empty((0, 4))], [np.empty((0, 3, 3))]
    q0, J0 = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((3, 3))
    for a in range(0, n, STEPS):
        b = min(a + STEPS, n)
        pad = STEPS - (b - a)
        q, J = integrate_gyro(
            jnp.asarray(np.pad(rate[a:b], ((0, pad), (0, 0)))),
            jnp.asarray(np.pad(dt[a:b], (0, pad))),
            jnp.asarray(np.pad(known[a:b], (0, pad))),
            jnp.asarray(q0),
            jnp.asarray(J0),
        )
        q, J = np.asarray(q), np.asarray(J)
        qs.append(q[: b - a])
        Js.append(J[: b - a])
        q0, J0 = q[-1], J[-1]
    ends = places[1:] - 1
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(timeline.extra, axis=0)])
    return Between(
        number[places],
        timeline.time[places],
        np.concatenate(qs)[ends],
        np.concatenate(Js)[ends],
        total[places[1:]] - total[places[:-1]],
        drift,
    )


def drifts(between: Between, epochs: Epochs) -> np.ndarray:
    """Drift (m, 3) in rad/s that each pair of neighbours implies."""
    q = jnp.asarray(epochs.q_BN[between.epochs])
    predicted = quaternion.multiply(jnp.asarray(between.turn), q[:-1])
    e = np.asarray(quaternion.log(quaternion.multiply(q[1:], quaternion.conjugate(predicted))))
    return between.drift + np.linalg.solve(between.J, e[..., None])[..., 0]


def intervals(between: Between, epochs: Epochs, drift: np.ndarray, good: np.ndarray) -> Intervals:
    """What the noise estimate needs: turns with a drift (3,) taken off; `good` (number of epochs,) says which to use."""
    corrected = np.einsum("mij,j->mi", between.J, drift - between.drift)
    q = quaternion.multiply(quaternion.exp(jnp.asarray(corrected)), jnp.asarray(between.turn))
    turn = -np.asarray(quaternion.log(q))
    e = between.epochs
    return Intervals(epochs.q_BN[e], epochs.shape[e], turn, between.duration, between.extra, good[e])


@dataclass(frozen=True)
class Beginning:
    """Number of the epoch to start at; the wrong ones (numbers) before and shortly after it; drift (3,) rad/s from it to the
    next right one, and its sigma (3,)."""

    epoch: int
    wrong: np.ndarray
    drift: np.ndarray
    sigma: np.ndarray


def find_beginning(between: Between, epochs: Epochs, levels: NoiseLevels, limit: float) -> Beginning:
    """The first attitude that agrees with those that follow; `limit` is the largest chi-square of three degrees of freedom."""
    count = len(between.epochs)
    found: list[tuple[float, _Window, np.ndarray]] = []
    for begin in list(range(0, max(count - 1, 1), WINDOW // 2))[:WINDOWS]:
        window = _Window.of(between, epochs, levels, begin, min(begin + WINDOW, count))
        agreeing = window.agreeing(limit)
        found.append((float(agreeing.mean()), window, agreeing))
        if found[-1][0] >= AGREE:
            break
    _, window, agreeing = max(found, key=lambda entry: entry[0])
    right = np.flatnonzero(agreeing)
    drift, sigma = window.drift(int(right[0]), int(right[1]))
    # What lies before the window was found to agree with nothing.
    places = np.concatenate([np.arange(window.begin), window.begin + np.flatnonzero(~agreeing)])
    return Beginning(int(between.epochs[window.begin + right[0]]), between.epochs[places], between.drift + drift, sigma)


@dataclass(frozen=True)
class _Window:
    """n attitudes brought back to the first one's instant: y (n, n, 3), y[i, k] = log(D_k D_i^-1); A (n, 3, 3); covariance S (n, 3, 3)
    of each; variance c (n, 3) of the gyro's walk since the first; time t (n,)."""

    begin: int
    y: np.ndarray
    A: np.ndarray
    S: np.ndarray
    c: np.ndarray
    t: np.ndarray
    sigma_u: float

    @classmethod
    def of(cls, between: Between, epochs: Epochs, levels: NoiseLevels, begin: int, end: int) -> _Window:
        n = end - begin
        e = between.epochs[begin:end]
        P, J = [Rotation.identity()], [np.zeros((3, 3))]
        for k in range(begin, end - 1):
            turn = Rotation.from_quat(between.turn[k])
            P.append(turn * P[-1])
            J.append(turn.as_matrix() @ J[-1] + between.J[k])
        back = np.stack([p.inv().as_matrix() for p in P])
        D = [p.inv() * Rotation.from_quat(q) for p, q in zip(P, epochs.q_BN[e], strict=True)]
        y = np.array([[(D[k] * D[i].inv()).as_rotvec() for k in range(n)] for i in range(n)])
        walk = levels.sigma_v**2 * between.duration[begin : end - 1, None] + between.extra[begin : end - 1]
        S = back @ (epochs.shape[e] * levels.sigma**2) @ np.swapaxes(back, 1, 2)
        c = np.concatenate([np.zeros((1, 3)), np.cumsum(walk, axis=0)])
        t = between.time[begin:end] - between.time[begin]
        return cls(begin, y, back @ np.stack(J), S, c, t, levels.sigma_u)

    def drift(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Drift (3,) from attitude i to j, and its sigma (3,)."""
        inverse = np.linalg.inv(self.A[j] - self.A[i])
        T = abs(self.t[j] - self.t[i])
        cov = self.S[i] + self.S[j] + np.diag(np.abs(self.c[j] - self.c[i]) + self.sigma_u**2 * T**3 / 3.0)
        return inverse @ self.y[i, j], np.sqrt(np.diagonal(inverse @ cov @ inverse.T))

    def agreeing(self, limit: float) -> np.ndarray:
        """Which attitudes (n,) agree with the best guess: the one of largest likelihood, with distances cut at `limit`; when
        none agrees with a third attitude, nothing but the drift tells them apart, and the smallest is taken."""
        n = len(self.t)
        best, agreeing = (np.inf, np.inf), np.ones(n, dtype=bool)
        for i in range(n):
            for j in range(i + 1, n):
                b, _ = self.drift(i, j)
                distance, log_det = self._distances(i, j, b)
                right = distance <= limit
                right[[i, j]] = True
                others = np.setdiff1d(np.arange(n), [i, j])
                cost = float(np.sum(np.minimum(distance, limit)[others] + log_det[others]))
                merit = (cost, 0.0) if right.sum() > 2 else (1e300, float(np.linalg.norm(b)))
                if merit < best:
                    best, agreeing = merit, right
        return agreeing

    def _distances(self, i: int, j: int, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chi-square (n,) of each attitude against the guess from i and j with the drift b, and its covariance's log det."""
        s, tau = self.t[j] - self.t[i], self.t - self.t[i]
        m = (tau / s)[:, None]
        c1, c2 = np.abs(self.c - self.c[i]), np.abs(self.c[j] - self.c[i])
        same = (m > 0.0).astype(float)
        walk = c1 + m**2 * c2 - 2.0 * m * same * np.minimum(c1, c2)
        walk = np.maximum(walk, 0.0) + (self.sigma_u**2 * tau**2 * np.maximum(np.abs(tau), s) / 3.0)[:, None]
        M = (self.A - self.A[i]) @ np.linalg.inv(self.A[j] - self.A[i])
        rest = np.eye(3) - M
        cov = self.S + rest @ self.S[i] @ np.swapaxes(rest, 1, 2) + M @ self.S[j] @ np.swapaxes(M, 1, 2)
        cov = cov + walk[:, :, None] * np.eye(3)
        d = self.y[i] - np.einsum("kab,b->ka", self.A - self.A[i], b)
        distance = np.einsum("ka,ka->k", d, np.linalg.solve(cov, d[..., None])[..., 0])
        return distance, np.linalg.slogdet(cov)[1]
