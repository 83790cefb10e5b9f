"""Gyro gaps bridged by a straight line, and how wrong that is, judged on the record itself.

Over clean stretches as long as the gap the same line is drawn, and its mean compared with the mean that was measured
there. Stretches count that are as lively as the gap's surroundings (by the change of rate across it and the slopes at
its ends), so that a gap in a slew is not judged by quiet cruise nor the reverse. Each end of the line is a mean over
some rows, as many as work best on those stretches: many where the gyro is noisy, one where the rate changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STRETCHES = 1000
"""Stretches looked at for one length of gap."""
FEW = 5
"""With fewer similar stretches than this the liveliness itself bounds the error."""
ROWS = (0, 4, 16, 64, 256)
"""Rows that an end may be averaged over; 0 takes the line's own end."""


@dataclass(frozen=True)
class Clean:
    """A rate signal: pieces (n,) with `gap`, the median step, and `integral(t)` of the rate, rad (m, 3).

    `tip_start`, `tip_end` (n, 3): the rate at a piece's ends from which a line over a gap beside it would begin.
    """

    start: np.ndarray
    end: np.ndarray
    gap: np.ndarray
    period: float
    integral: Callable[[np.ndarray], np.ndarray]
    tip_start: np.ndarray
    tip_end: np.ndarray

    def mean(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Mean rate (m, 3) from a to b."""
        return (self.integral(b) - self.integral(a)) / (b - a)[:, None]

    def is_clean(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Which intervals [a, b] (m,) lie in the record and touch no gap."""
        before = np.concatenate([[0], np.cumsum(self.gap)])
        i = np.clip(np.searchsorted(self.start, a, side="right") - 1, 0, None)
        j = np.clip(np.searchsorted(self.end, b, side="left"), None, len(self.end) - 1)
        return (a >= self.start[0]) & (b <= self.end[-1]) & (before[j + 1] == before[i])


@dataclass(frozen=True)
class _Stretches:
    """Clean stretches of one length: for each way to take the ends, errors (m, 3) of the line's mean; liveliness (m, 3);
    how much a stretch has for itself, as they overlap."""

    errors: dict[float, np.ndarray]
    lively: np.ndarray
    share: float


def bridge(signal: Clean, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pieces' rates at start and end with those of gaps renewed, and 1 sigma (n, 3) of the gaps' mean rate, rad/s."""
    first, last, sigma = first.copy(), last.copy(), np.zeros_like(first)
    clean = ~signal.gap
    spread = np.std(signal.mean(signal.start[clean], signal.end[clean]), axis=0) if clean.any() else np.zeros(3)
    known: dict[float, _Stretches] = {}
    for g in np.flatnonzero(signal.gap):
        a, b = signal.start[g : g + 1], signal.end[g : g + 1]
        length = _coarse(float((b - a)[0]), signal.period)
        if length not in known:
            known[length] = _stretches(signal, length)
        lively = _liveliness(signal, a, b, (last[g] - first[g])[None])[0]
        possible = [
            w
            for w in known[length].errors
            if (signal.is_clean(a - w, a)[0] and signal.is_clean(b, b + w)[0]) or w == 0.0
        ]
        window, sigma[g] = _judge(known[length], possible, lively, spread)
        if window > 0.0:
            first[g], last[g] = signal.mean(a - window, a)[0], signal.mean(b, b + window)[0]
    return first, last, sigma


def _coarse(length: float, period: float) -> float:
    """Lengths within 10 % of each other are judged alike (the longer one counts)."""
    return float(period * 1.1 ** np.ceil(np.log(max(length / period, 1.0)) / np.log(1.1) - 1e-9))


def _stretches(signal: Clean, length: float) -> _Stretches:
    """Clean stretches from a piece's start to a piece's end."""
    i = np.flatnonzero(~signal.gap)
    j = np.clip(np.searchsorted(signal.end, signal.start[i] + length, side="left"), None, len(signal.end) - 1)
    whole = signal.is_clean(signal.start[i], signal.end[j]) & (signal.end[j] - signal.start[i] >= 0.9 * length)
    i, j = i[whole], j[whole]
    windows = [n * signal.period for n in ROWS if n * signal.period <= length]
    margin = max(windows[-1], _slope_window(signal, length))
    roomy = signal.is_clean(signal.start[i] - margin, signal.end[j] + margin)
    if roomy.sum() < FEW:
        windows = windows[:1]
    else:
        i, j = i[roomy], j[roomy]
    every = max(len(i) // STRETCHES, 1)
    i, j = i[::every], j[::every]
    a, b = signal.start[i], signal.end[j]
    tip_a, tip_b = signal.tip_start[i], signal.tip_end[j]
    mean = signal.mean(a, b)
    errors = {0.0: mean - 0.5 * (tip_a + tip_b)}
    for w in windows[1:]:
        errors[w] = mean - 0.5 * (signal.mean(a - w, a) + signal.mean(b, b + w))
    return _Stretches(errors, _liveliness(signal, a, b, tip_b - tip_a), min(every * signal.period / length, 1.0))


def _slope_window(signal: Clean, length: float) -> float:
    return max(0.5 * length, 4.0 * signal.period)


def _liveliness(signal: Clean, a: np.ndarray, b: np.ndarray, jump: np.ndarray) -> np.ndarray:
    """Per axis (m, 3), rad/s: the largest of the change of rate from a to b and of what the slopes at a and at b make of it.

    Only what lies outside [a, b] is looked at. `jump` (m, 3) is the change where nothing clean lies beside.
    """
    if not len(a):
        return np.empty((0, 3))
    length = float((b - a)[0])
    w = _slope_window(signal, length)
    ok_a, ok_b = signal.is_clean(a - w, a)[:, None], signal.is_clean(b, b + w)[:, None]
    near_a, near_b = signal.mean(a - 0.5 * w, a), signal.mean(b, b + 0.5 * w)
    far_a, far_b = signal.mean(a - w, a - 0.5 * w), signal.mean(b + 0.5 * w, b + w)
    change = np.where(ok_a & ok_b, np.abs(near_b - near_a), np.abs(jump))
    slope_a = np.where(ok_a, np.abs(near_a - far_a) / (0.5 * w) * length, 0.0)
    slope_b = np.where(ok_b, np.abs(near_b - far_b) / (0.5 * w) * length, 0.0)
    return np.maximum.reduce([change, slope_a, slope_b])


def _judge(
    stretches: _Stretches, possible: list[float], lively: np.ndarray, spread: np.ndarray
) -> tuple[float, np.ndarray]:
    """Of the possible windows (s) the best to average each end over, and 1 sigma (3,) of the mean rate across the gap."""
    if len(stretches.lively) < FEW:  # nothing is known but the rates' spread and what the ends show
        return 0.0, np.hypot(0.5 * lively, spread)
    size, own = np.linalg.norm(stretches.lively, axis=1), float(np.linalg.norm(lively))
    mine = max(own, float(np.median(size)))
    alike = (size >= 0.5 * mine) & (size <= 2.0 * mine)
    if alike.sum() < FEW:
        alike = size >= 0.5 * mine
    best, sigma = 0.0, np.full(3, np.inf)
    for window in possible:
        errors = stretches.errors[window]
        if alike.sum() >= FEW:
            rms = np.sqrt(np.mean(errors[alike] ** 2, axis=0))
            here = np.maximum(rms, np.sqrt(np.sum(rms**2)) * lively / max(own, 1e-300))  # all of it on the lively axis
        else:
            here = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), 0.5 * lively)
        if np.sum(here**2) < 0.9 * np.sum(sigma**2):
            best, sigma = window, here
    return best, sigma * np.sqrt(1.0 + 2.0 / max(alike.sum() * stretches.share, 1.0))
