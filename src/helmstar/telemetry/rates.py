"""The gyro as a function of time: its integral between any two instants, and how far to trust it across a gap.

A rate known at instants is taken as linear between them (the trapezoid rule); a mean over an interval as a line through
it whose slope comes from its neighbours and whose mean is the measured one. So an attitude between two gyro rows is
reached by interpolated rates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..io.screening import GAP_FACTOR


@dataclass(frozen=True)
class RateSignal:
    """Piecewise linear rate on pieces [start, end] (n,): value at the start and at the end, (n, 3) rad/s in B.

    Pieces touch. `gap` (n,) marks those that bridge missing rows.
    """

    start: np.ndarray
    end: np.ndarray
    first: np.ndarray
    last: np.ndarray
    gap: np.ndarray
    period: float

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant that the rate is known at; half a median step beyond is still answered."""
        return float(self.start[0]), float(self.end[-1])

    def _piece(self, t: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)

    def integral(self, t: np.ndarray) -> np.ndarray:
        """Integral of the rate from the signal's start to t, rad (..., 3)."""
        width = (self.end - self.start)[:, None]
        whole = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * width * (self.first + self.last), axis=0)])
        i = self._piece(t)
        tau = (t - self.start[i])[:, None]
        slope = (self.last[i] - self.first[i]) / width[i]
        return whole[i] + tau * self.first[i] + 0.5 * tau**2 * slope

    def mean_rates(self, grid: np.ndarray) -> np.ndarray:
        """Mean rate (n-1, 3) over the steps of a grid that holds every piece's ends, with the coning term: R_BN turns by
        exp(-[mean dt x]) over a step in which the rate goes linearly from w0 to w1, mean = (w0 + w1)/2 + dt/12 w0 x w1."""
        a, b = grid[:-1], grid[1:]
        i = self._piece(0.5 * (a + b))
        dt = (b - a)[:, None]
        slope = (self.last[i] - self.first[i]) / (self.end[i] - self.start[i])[:, None]
        w0 = self.first[i] + slope * (a - self.start[i])[:, None]
        w1 = self.first[i] + slope * (b - self.start[i])[:, None]
        return 0.5 * (w0 + w1) + dt / 12.0 * np.cross(w0, w1)

    def gap_variance(self, grid: np.ndarray) -> np.ndarray:
        """Additional attitude variance (n-1,) in rad^2 per axis of each step of the grid; zero outside gaps.

        Judged on the data themselves: over clean stretches as long as the gap, how far is the true mean rate from the
        mean of the two end rates? That rms times the gap's length is the error at its end; a step takes its share.
        """
        extra = np.zeros(len(grid) - 1)
        inside = self._piece(0.5 * (grid[:-1] + grid[1:]))
        for g in np.flatnonzero(self.gap):
            length = self.end[g] - self.start[g]
            sigma = self._bridging_error(length, float(np.max(np.abs(self.last[g] - self.first[g]))))
            steps = inside == g
            extra[steps] = sigma**2 * length * np.diff(grid)[steps]
        return extra

    def _bridging_error(self, length: float, jump: float) -> float:
        """1 sigma (rad/s) of a mean rate over `length` that is interpolated from its ends."""
        clean = np.flatnonzero(~self.gap)
        centre = 0.5 * (self.start + self.end)
        a = self.start[clean]
        a = a[a + length <= self.end[-1]]
        if len(a) > 2000:
            a = a[:: len(a) // 2000]
        gaps_before = np.concatenate([[0], np.cumsum(self.gap)])
        i, j = self._piece(a), self._piece(a + length)
        whole = gaps_before[j + 1] == gaps_before[i]
        a, i, j = a[whole], i[whole], j[whole]
        if len(a) < 5:  # too few stretches as long as that: nothing is known but the spread of the rates
            spread = np.sqrt(np.mean(np.var(0.5 * (self.first + self.last), axis=0))) if len(centre) > 1 else 0.0
            return float(np.hypot(0.5 * jump, spread))
        mean = (self.integral(a + length) - self.integral(a)) / length
        ends = 0.5 * (self.first[i] + self.last[j])
        return float(np.sqrt(np.mean((mean - ends) ** 2)))


def rate_signal(
    time: np.ndarray, rate: np.ndarray, step: np.ndarray, reading: Literal["instant", "mean_since_previous"]
) -> RateSignal:
    """From increasing times (n,) and rates (n, 3); `step` (n,) is what a mean covers (NaN: since the row before).

    Raises ValueError for fewer than two rows.
    """
    if len(time) < 2:
        raise ValueError("a rate signal needs at least two rows")
    dt = np.diff(time)
    period = float(np.median(dt))
    if reading == "instant":
        return RateSignal(time[:-1], time[1:], rate[:-1], rate[1:], dt > GAP_FACTOR * period, period)

    covered = np.where(np.isfinite(step), step, np.concatenate([[period], dt]))
    covered = np.minimum(covered, np.concatenate([[np.inf], dt]))
    start = time - covered
    # Slope from the neighbouring means, none where a neighbour is missing or far.
    centre = time - 0.5 * covered
    slope = np.zeros_like(rate)
    if len(time) > 2:
        slope[1:-1] = (rate[2:] - rate[:-2]) / (centre[2:] - centre[:-2])[:, None]
        near = (centre[2:] - centre[:-2]) <= 2.0 * GAP_FACTOR * period
        slope[1:-1] *= near[:, None]
    half = 0.5 * slope * covered[:, None]
    first, last = rate - half, rate + half
    # What no row covers is bridged from the mean before to the mean after.
    open_ = np.flatnonzero(start[1:] - time[:-1] > 1e-9 * max(1.0, period) + 1e-6 * period)
    starts = np.concatenate([start, time[open_]])
    ends = np.concatenate([time, start[open_ + 1]])
    firsts = np.concatenate([first, rate[open_]])
    lasts = np.concatenate([last, rate[open_ + 1]])
    bridged = np.concatenate([covered > GAP_FACTOR * period, np.ones(len(open_), dtype=bool)])
    order = np.argsort(starts, kind="stable")
    starts, ends, firsts, lasts, bridged = (x[order] for x in (starts, ends, firsts, lasts, bridged))
    starts = np.concatenate([starts[:1], ends[:-1]])  # pieces touch to the bit
    return RateSignal(starts, ends, firsts, lasts, bridged, period)
