"""One timeline from rows of different rates: the steps a filter takes, and which measurement belongs to which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..attitude import davenport
from ..io.telemetry import AttitudeRows, DirectionRows
from .rates import RateSignal


@dataclass(frozen=True)
class Epochs:
    """Star measurements by epoch: time (m,); q_BN (m, 4) measured or solved, NaN where an epoch cannot be solved alone;
    shape (m, 3, 3): covariance in B in units of sigma^2 (the identity, or Wahba's for directions, or rad^2 when `scaled`
    is False); file and row of the epoch's (first) row. For directions star_B, star_N (m, k, 3) and mask (m, k) too."""

    time: np.ndarray
    q_BN: np.ndarray
    shape: np.ndarray
    file: np.ndarray
    row: np.ndarray
    files: tuple[str, ...]
    star_B: np.ndarray | None = None
    star_N: np.ndarray | None = None
    mask: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: np.ndarray) -> Epochs:
        """Those at an index or mask."""
        pick = lambda a: None if a is None else a[index]  # noqa: E731  (one expression for nine fields)
        return Epochs(
            self.time[index], self.q_BN[index], self.shape[index], self.file[index], self.row[index], self.files,
            pick(self.star_B), pick(self.star_N), pick(self.mask),
        )  # fmt: skip


def attitude_epochs(rows: AttitudeRows, shape: np.ndarray) -> Epochs:
    """Of whole attitudes, each with the same covariance shape (3, 3)."""
    n = len(rows)
    return Epochs(rows.time, rows.q_BN, np.broadcast_to(shape, (n, 3, 3)).copy(), rows.file, rows.row, rows.files)


def direction_epochs(rows: DirectionRows) -> Epochs:
    """Of star directions: rows of equal time are one epoch, padded to the largest number of stars."""
    time, first, which, count = np.unique(rows.time, return_index=True, return_inverse=True, return_counts=True)
    k = int(count.max())
    place = np.arange(len(rows)) - np.repeat(np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    order = np.argsort(which, kind="stable")
    slot = np.empty(len(rows), dtype=int)
    slot[order] = place
    shape = (len(time), k)
    star_B, star_N = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    star_B[..., 0] = star_N[..., 0] = 1.0
    mask = np.zeros(shape, dtype=bool)
    star_B[which, slot], star_N[which, slot], mask[which, slot] = rows.star_B, rows.star_N, True
    s = davenport(star_B, star_N, 1.0, mask)
    return Epochs(time, s.q_BN, s.covariance, rows.file[first], rows.row[first], rows.files, star_B, star_N, mask)


@dataclass(frozen=True)
class Timeline:
    """time (n + 1,): the start and the end of each of n steps. rate (n, 3): mean rate in B over a step; extra (n,): added
    attitude variance of a step, rad^2 per axis; gyro_row (n,): whether a gyro row ends the step. epoch (n + 1,): number
    of the star epoch at each time, -1 for none; time[0] is that of the first epoch."""

    time: np.ndarray
    rate: np.ndarray
    extra: np.ndarray
    epoch: np.ndarray


SAME_INSTANT_S = 1e-9


def build_timeline(signal: RateSignal, epochs: Epochs) -> tuple[Timeline, np.ndarray]:
    """Timeline from the first usable epoch to the end of the gyro data, and a mask (m,) of the epochs on it.

    Epochs before the first or after the last gyro instant, by more than half a median step, cannot be reached.
    """
    low, high = signal.span
    margin = 0.5 * signal.period
    usable = (epochs.time >= low - margin) & (epochs.time <= high + margin)
    if not usable.any():
        empty = np.empty(0)
        return Timeline(empty, np.empty((0, 3)), empty, np.empty(0, dtype=int)), usable
    times = epochs.time[usable]
    start = times[0]
    ends = np.append(signal.start, signal.end[-1])
    grid = np.union1d(np.concatenate([ends[ends > start], [start]]), times)
    # Instants that differ by rounding alone would make steps of no length; star times win.
    close = np.flatnonzero(np.diff(grid) < SAME_INSTANT_S)
    is_star = np.isin(grid, times)
    drop = np.where(is_star[close] & ~is_star[close + 1], close + 1, close)
    grid = np.delete(grid, drop)
    epoch = np.full(len(grid), -1)
    numbers = np.flatnonzero(usable)
    epoch[np.searchsorted(grid, times)] = numbers
    return Timeline(grid, signal.mean_rates(grid), signal.gap_variance(grid), epoch), usable
