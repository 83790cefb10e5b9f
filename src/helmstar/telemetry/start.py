"""Where a record's filter starts: the first attitude that agrees with the gyro and its neighbours, and their drift.

In a window of the first attitudes, brought back to one instant (`series`), each pair is taken as a guess of start and drift, and
the guess that most others agree with decides which of them are right. The filter starts at the first right one with the
drift from it to the second, and a sigma ten times as wide: so the second attitude counts twice by a hundredth only, and
after it the filter has the difference's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .noise import NoiseLevels
from .series import Series, pseudo_inverse

WINDOW = 12
"""Attitudes that are looked at together."""
AGREE = 0.6
"""Share of a window that must agree, or the next one is looked at."""
WINDOWS = 50
"""Windows that are tried at most."""
DIFFUSE = 10.0


@dataclass(frozen=True)
class Beginning:
    """Number of the epoch to start at; the wrong ones (numbers) before and shortly after it; drift (3,) rad/s from it to the
    next right one, and its sigma (3,)."""

    epoch: int
    wrong: np.ndarray
    drift: np.ndarray
    sigma: np.ndarray


def find_beginning(series: Series, levels: NoiseLevels, limit: float) -> Beginning:
    """The first attitude that agrees with those that follow; `limit` is the largest chi-square of three degrees of freedom."""
    found: list[tuple[float, int, _Window, np.ndarray]] = []
    for begin in list(range(0, max(len(series) - 1, 1), WINDOW // 2))[:WINDOWS]:
        window = _Window.of(series.select(np.arange(begin, min(begin + WINDOW, len(series)))), levels)
        agreeing = window.agreeing(limit)
        found.append((float(agreeing.mean()), begin, window, agreeing))
        if found[-1][0] >= AGREE:
            break
    _, begin, window, agreeing = max(found, key=lambda entry: entry[0])
    right = np.flatnonzero(agreeing)
    drift, sigma = window.drift(int(right[0]), int(right[1]))
    # What lies before the window was found to agree with nothing.
    wrong = np.concatenate([np.arange(begin), begin + np.flatnonzero(~agreeing)])
    return Beginning(int(series.epochs[begin + right[0]]), series.epochs[wrong], series.drift + drift, sigma)


@dataclass(frozen=True)
class _Window:
    """n attitudes brought back: y (n, n, 3), y[i, k] = log(D_k D_i^-1); A (n, 3, 3); covariance S (n, 3, 3) of each; variance
    c (n, 3) of the gyro's walk since the first; time t (n,)."""

    y: np.ndarray
    A: np.ndarray
    S: np.ndarray
    c: np.ndarray
    t: np.ndarray
    sigma_u: float

    @classmethod
    def of(cls, series: Series, levels: NoiseLevels) -> _Window:
        y = np.stack([series.since(i) for i in range(len(series))])
        t = series.time - series.time[0]
        c = levels.sigma_v**2 * t[:, None] + series.extra - series.extra[0]
        return cls(y, series.A, series.shape * levels.sigma**2, c, t, levels.sigma_u)

    def drift(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Drift (3,) from attitude i to j, and its sigma (3,)."""
        between = self.A[j] - self.A[i]
        inverse = pseudo_inverse(between, 1.0)
        T = abs(self.t[j] - self.t[i])
        cov = self.S[i] + self.S[j] + np.diag(np.abs(self.c[j] - self.c[i]) + self.sigma_u**2 * T**3 / 3.0)
        return pseudo_inverse(between) @ self.y[i, j], np.sqrt(np.diagonal(inverse @ cov @ inverse.T))

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
        return self._without_strangers(agreeing, limit)

    def _without_strangers(self, agreeing: np.ndarray, limit: float) -> np.ndarray:
        """Those (n,) of the agreeing that all the others together agree with, by least squares over them."""
        agreeing = agreeing.copy()
        while agreeing.sum() > 3:
            k = np.flatnonzero(agreeing)
            n, t = len(k), self.t[k]
            low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
            walk = (
                np.minimum(self.c[k][:, None], self.c[k][None])
                + (self.sigma_u**2 * low**2 * (3.0 * high - low) / 6.0)[:, :, None]
            )
            V = np.einsum("kla,ab->kalb", walk, np.eye(3))
            V[np.arange(n), :, np.arange(n), :] += self.S[k]
            W = np.linalg.inv(V.reshape(3 * n, 3 * n))
            H = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), self.A[k] - self.A[k[0]]], axis=2).reshape(
                3 * n, 6
            )
            WH = W @ H
            M = W - WH @ np.linalg.solve(H.T @ WH, WH.T)
            r = (M @ self.y[k[0], k].reshape(-1)).reshape(n, 3)
            own = M.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
            distance = np.einsum("ka,ka->k", r, np.linalg.solve(own, r[..., None])[..., 0])
            worst = int(np.argmax(distance))
            if not distance[worst] > limit:
                break
            agreeing[k[worst]] = False
        return agreeing

    def _distances(self, i: int, j: int, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chi-square (n,) of each attitude against the guess from i and j with the drift b, and its covariance's log det."""
        s, tau = self.t[j] - self.t[i], self.t - self.t[i]
        m = (tau / s)[:, None]
        c1, c2 = np.abs(self.c - self.c[i]), np.abs(self.c[j] - self.c[i])
        same = (m > 0.0).astype(float)
        walk = c1 + m**2 * c2 - 2.0 * m * same * np.minimum(c1, c2)
        walk = np.maximum(walk, 0.0) + (self.sigma_u**2 * tau**2 * np.maximum(np.abs(tau), s) / 3.0)[:, None]
        M = (self.A - self.A[i]) @ pseudo_inverse(self.A[j] - self.A[i])
        rest = np.eye(3) - M
        cov = self.S + rest @ self.S[i] @ np.swapaxes(rest, 1, 2) + M @ self.S[j] @ np.swapaxes(M, 1, 2)
        cov = cov + walk[:, :, None] * np.eye(3)
        d = self.y[i] - np.einsum("kab,b->ka", self.A - self.A[i], b)
        distance = np.einsum("ka,ka->k", d, np.linalg.solve(cov, d[..., None])[..., 0])
        return distance, np.linalg.slogdet(cov)[1]
