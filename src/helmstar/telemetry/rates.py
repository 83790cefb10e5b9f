"""The gyro as a function of time: its integral between any two instants, and how far to trust it across a gap.

A rate known at instants is taken as linear between them; the trapezoid rule's next term, -dt/12 times the change of the
slope, is added, which matters in slews and costs nothing elsewhere. A mean over an interval is a line through it whose
slope comes from its neighbours and whose mean is the measured one. So an attitude between two gyro rows is reached by
interpolated rates. What no row covers is bridged, see `bridge`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ..io.screening import GAP_FACTOR
from .bridge import Clean, bridge

MISSING = 1.5
"""A step longer than this many median steps has lost rows, where increments and means are concerned."""
USUAL = 0.2
"""Share of such steps above which they are the nature of the record and no loss."""


@dataclass(frozen=True)
class RateSignal:
    """Piecewise linear rate on pieces [start, end] (n,): value at the start and at the end, (n, 3) rad/s in B.

    Pieces touch. `gap` (n,) marks those that bridge missing rows, `sigma` (n, 3) is how well their mean rate is known
    (1 sigma in rad/s; 0 elsewhere).
    """

    start: np.ndarray
    end: np.ndarray
    first: np.ndarray
    last: np.ndarray
    gap: np.ndarray
    sigma: np.ndarray
    period: float

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant that the rate is known at; half a median step beyond is still answered."""
        return float(self.start[0]), float(self.end[-1])

    @cached_property
    def _whole(self) -> np.ndarray:
        steps = 0.5 * (self.end - self.start)[:, None] * (self.first + self.last)
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def piece(self, t: np.ndarray) -> np.ndarray:
        """Number of the piece that holds t."""
        return np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)

    def integral(self, t: np.ndarray) -> np.ndarray:
        """Integral of the rate from the signal's start to t, rad (..., 3)."""
        i = self.piece(t)
        tau = (t - self.start[i])[:, None]
        slope = (self.last[i] - self.first[i]) / (self.end[i] - self.start[i])[:, None]
        return self._whole[i] + tau * self.first[i] + 0.5 * tau**2 * slope

    def mean_rates(self, grid: np.ndarray) -> np.ndarray:
        """Mean rate (n-1, 3) over the steps of a grid that holds every piece's ends, with the coning term: R_BN turns by
        exp(-[mean dt x]) over a step in which the rate goes linearly from w0 to w1, mean = (w0 + w1)/2 + dt/12 w0 x w1."""
        a, b = grid[:-1], grid[1:]
        i = self.piece(0.5 * (a + b))
        dt = (b - a)[:, None]
        slope = (self.last[i] - self.first[i]) / (self.end[i] - self.start[i])[:, None]
        w0 = self.first[i] + slope * (a - self.start[i])[:, None]
        w1 = self.first[i] + slope * (b - self.start[i])[:, None]
        return 0.5 * (w0 + w1) + dt / 12.0 * np.cross(w0, w1)

    def gap_variance(self, grid: np.ndarray) -> np.ndarray:
        """Additional attitude variance (n-1, 3) in rad^2 of each step of the grid; zero outside gaps.

        The error at a gap's end is its length times `sigma`; a step within takes its share of the variance.
        """
        i = self.piece(0.5 * (grid[:-1] + grid[1:]))
        return self.sigma[i] ** 2 * ((self.end - self.start)[i] * np.diff(grid))[:, None]


def rate_signal(
    time: np.ndarray,
    rate: np.ndarray,
    step: np.ndarray,
    reading: Literal["instant", "mean_since_previous"],
    increments: bool = False,
) -> RateSignal:
    """From increasing times (n,) and rates (n, 3); `step` (n,) is the time since the row before (NaN: not known).

    `increments`: the rates of a mean are increments over `step`. Raises ValueError for fewer than two rows.
    """
    if len(time) < 2:
        raise ValueError("a rate signal needs at least two rows")
    raw = _instants(time, rate) if reading == "instant" else _means(time, rate, step, increments)
    if not raw.gap.any():
        return raw
    tips = (raw.first, raw.last) if reading == "instant" else (0.5 * (raw.first + raw.last),) * 2
    clean = Clean(raw.start, raw.end, raw.gap, raw.period, raw.integral, *tips)
    first, last, sigma = bridge(clean, raw.first, raw.last)
    return replace(raw, first=first, last=last, sigma=sigma)


def _instants(time: np.ndarray, rate: np.ndarray) -> RateSignal:
    dt = np.diff(time)
    period = float(np.median(dt))
    gap = dt > GAP_FACTOR * period
    first, last = rate[:-1].copy(), rate[1:].copy()
    if len(time) > 2:
        slope = (rate[2:] - rate[:-2]) / (time[2:] - time[:-2])[:, None]
        known = ~(gap[1:] | gap[:-1])
        inner = known[1:] & known[:-1]
        change = np.where(inner[:, None], slope[1:] - slope[:-1], 0.0)
        first[1:-1] -= dt[1:-1, None] / 12.0 * change
        last[1:-1] -= dt[1:-1, None] / 12.0 * change
    return RateSignal(time[:-1], time[1:], first, last, gap, np.zeros_like(first), period)


def _means(time: np.ndarray, rate: np.ndarray, step: np.ndarray, increments: bool) -> RateSignal:
    dt = np.diff(time)
    period = float(np.median(dt))
    step = np.where(np.isfinite(step), step, np.concatenate([[period], dt]))
    rate, covered = _coverage(rate, step, period, increments)
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
    bridged = np.concatenate([np.zeros(len(time), dtype=bool), np.ones(len(open_), dtype=bool)])
    order = np.argsort(starts, kind="stable")
    starts, ends, firsts, lasts, bridged = (x[order] for x in (starts, ends, firsts, lasts, bridged))
    starts = np.concatenate([starts[:1], ends[:-1]])  # pieces touch to the bit
    return RateSignal(starts, ends, firsts, lasts, bridged, np.zeros_like(firsts), period)


def _coverage(rate: np.ndarray, step: np.ndarray, period: float, increments: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rates, and the time that each covers, where a step is longer than usual because rows before it are lost.

    A row after a loss may cover the whole time since the row that is left (an accumulating counter) or the usual period
    only (the lost rows took their part with them). Increments tell, by the rates on either side; when they do not, and
    for means, it is the usual period, and what is open is a gap.
    """
    long = step > MISSING * period
    if not long.any() or long.mean() > USUAL:
        return rate, step
    short = np.where(long, period, step)
    if not increments:
        return rate, short
    shorter = rate * (step / short)[:, None]
    rows = np.flatnonzero(long)
    rows = rows[(rows > 0) & (rows < len(rate) - 1)]
    beside = 0.5 * (rate[rows - 1] + rate[np.minimum(rows + 1, len(rate) - 1)])
    off_whole = np.median(np.linalg.norm(rate[rows] - beside, axis=1)) if len(rows) else np.inf
    off_short = np.median(np.linalg.norm(shorter[rows] - beside, axis=1)) if len(rows) else 0.0
    if off_whole < 0.5 * off_short:
        return rate, step
    return shorter, short
