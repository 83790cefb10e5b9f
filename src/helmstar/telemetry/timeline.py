"""One timeline from rows of different rates: the steps a filter takes, and which measurement belongs to which."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..io.telemetry import AttitudeRows
from .rates import RateSignal


@dataclass(frozen=True)
class Epochs:
    """Star measurements by epoch: time (m,); q_BN (m, 4) measured or solved, NaN where an epoch cannot be solved alone;
    shape (m, 3, 3): covariance in B in units of sigma^2 (the identity, or Wahba's for directions, or rad^2 when the
    configuration gives it); file and row of the epoch's (first) row.

    Of star directions also: star_B, star_N (m, 3), the one star of an epoch that cannot be solved; misfit (m,), the sum of
    squares in rad^2 by which the stars of an epoch miss its solution, and its degrees of freedom misfit_dof (m,)."""

    time: np.ndarray
    q_BN: np.ndarray
    shape: np.ndarray
    file: np.ndarray
    row: np.ndarray
    files: tuple[str, ...]
    star_B: np.ndarray | None = None
    star_N: np.ndarray | None = None
    misfit: np.ndarray | None = None
    misfit_dof: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def solved(self) -> np.ndarray:
        """Which epochs (m,) have an attitude of their own."""
        return np.isfinite(self.q_BN[:, 0])

    @property
    def directions(self) -> bool:
        """Whether these are solved from star directions."""
        return self.star_B is not None

    def select(self, index: np.ndarray) -> Epochs:
        """Those at an index or mask."""
        names = ("time", "q_BN", "shape", "file", "row", "star_B", "star_N", "misfit", "misfit_dof")
        given = {name: getattr(self, name) for name in names}
        return replace(self, **{name: array[index] for name, array in given.items() if array is not None})


def attitude_epochs(rows: AttitudeRows, shape: np.ndarray) -> Epochs:
    """Of whole attitudes, each with the same covariance shape (3, 3)."""
    n = len(rows)
    return Epochs(rows.time, rows.q_BN, np.broadcast_to(shape, (n, 3, 3)).copy(), rows.file, rows.row, rows.files)


@dataclass(frozen=True)
class Timeline:
    """time (n + 1,): the start and the end of each of n steps. rate (n, 3): mean rate in B over a step; extra (n, 3): added
    attitude variance of a step, rad^2 about each axis. epoch (n + 1,): number of the star epoch at each time, -1 for
    none; time[0] is that of the first epoch. lost (n,): steps within a gap of the gyro."""

    time: np.ndarray
    rate: np.ndarray
    extra: np.ndarray
    epoch: np.ndarray
    lost: np.ndarray


SAME_INSTANT_S = 1e-9


def reachable(signal: RateSignal, epochs: Epochs) -> np.ndarray:
    """Mask (m,) of the epochs that the gyro data reach: not more than half a median step before or after them."""
    low, high = signal.span
    margin = 0.5 * signal.period
    return (epochs.time >= low - margin) & (epochs.time <= high + margin)


def build_timeline(signal: RateSignal, epochs: Epochs) -> Timeline:
    """Timeline from the first epoch to the end of the gyro data; every epoch must be `reachable`."""
    times = epochs.time
    ends = np.append(signal.start, signal.end[-1])
    grid = np.union1d(ends[ends > times[0]], times)
    # Instants that differ by rounding alone would make steps of no length; star times win.
    is_star = np.isin(grid, times)
    close = np.flatnonzero(np.diff(grid) < SAME_INSTANT_S)
    drop = np.where(is_star[close], close + 1, close)
    grid = np.delete(grid, drop[~is_star[drop]])
    epoch = np.full(len(grid), -1)
    epoch[np.searchsorted(grid, times)] = np.arange(len(times))
    lost = signal.gap[signal.piece(0.5 * (grid[:-1] + grid[1:]))]
    return Timeline(grid, signal.mean_rates(grid), signal.gap_variance(grid), epoch, lost)
