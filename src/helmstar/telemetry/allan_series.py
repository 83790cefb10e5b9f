"""Gyro rows as a regular series: what an Allan deviation needs, with motion taken off where attitudes show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from ..evaluate.allan import LEAST_SAMPLES
from ..io.problems import Problem
from ..io.screening import GAP_FACTOR
from ..io.telemetry import AttitudeRows, GyroRows
from .rates import rate_signal

JITTER = 0.2  # of a period; within it samples count as regular
ODD_STEPS = 0.01  # so few steps that fit no period split the record; with more of them it has no period
MUCH_FILLED = 0.02
COARSER = (
    8  # an irregular series is resampled at so many median steps, where interpolating smooths 1/16 of the variance
)
ATTITUDE_JUMP = 12.0  # robust sigmas, to and fro, of an attitude that is wrong by itself
JUMPS_ARE_RARE = 0.02  # more of them are the nature of the data


@dataclass(frozen=True)
class Series:
    """Rates at a constant period: stretches (n_i, 3) in rad/s. `how` says in words how they came from the rows."""

    stretches: list[np.ndarray]
    period: float
    instant: bool
    how: list[str]
    warnings: list[str]

    @property
    def samples(self) -> int:
        """Of all stretches."""
        return sum(len(s) for s in self.stretches)


def regular_series(
    time: np.ndarray, rate: np.ndarray, covered: np.ndarray | None, file: str, least: int = LEAST_SAMPLES
) -> Series:
    """Rates (n, 3) at increasing times (n,) at a constant period.

    `covered` (n,) s: what each mean rate covers up to its time (NaN: since the row before); None if the rates are
    values at instants. Raises DataError where no stretch between gaps has `least` samples.
    """
    step = np.diff(time)
    if len(time) < least:
        raise DataError(
            f"{file}: {len(time)} usable samples; an Allan deviation needs at least {least} in a row, and for a rate "
            "random walk thousands. Give a longer record"
        )
    period = float(np.median(step))
    count = np.maximum(np.rint(step / period), 1.0)
    gap = step > GAP_FACTOR * period
    odd = ~gap & (np.abs(step / period - count) > JITTER)
    regular = odd.sum() <= ODD_STEPS * len(step)
    pieces = np.split(np.arange(len(time)), np.flatnonzero(gap | odd if regular else gap) + 1)
    pieces = [p for p in pieces if len(p) >= 2]
    how, warnings, filled = [], [], 0
    if regular:
        places = [count[p[:-1]] for p in pieces]
        span = sum(time[p[-1]] - time[p[0]] for p in pieces)
        period = float(span / sum(c.sum() for c in places))
        stretches = []
        for piece, counts in zip(pieces, places):
            at = np.concatenate([[0], np.cumsum(counts)]).astype(int)
            whole = np.arange(at[-1] + 1)
            values = np.stack([np.interp(whole, at, rate[piece, i]) for i in range(3)], axis=1)
            if covered is not None:  # a mean over several periods is the mean in each of them
                after = np.searchsorted(at, whole)
                long = ~(covered[piece] < 1.5 * period)
                long[0] = False
                values = np.where(long[after][:, None], rate[piece][after], values)
            filled += len(whole) - len(piece)
            stretches.append(values)
        jitter = max(float(np.abs(np.diff(time[p]) / period - c).max()) for p, c in zip(pieces, places))
        how.append(f"regular: steps within {100 * jitter:.2g}% of the period")
        if odd.any():
            how.append(f"split at {int(odd.sum())} steps that are no multiple of the period, as at gaps")
        if filled:
            total = sum(len(s) for s in stretches)
            how.append(f"{filled} missing rows filled")
            if filled > MUCH_FILLED * total:
                warnings.append(
                    f"{filled} of {total} samples were missing and filled from others: the shortest tau come out low"
                )
    else:
        period *= COARSER
        stretches = [_resample(time[p], rate[p], covered is None, period) for p in pieces]
        message = (
            f"the rows are not at a constant period: resampled to {period:.6g} s by linear interpolation of the "
            "integrated rate, which makes the shortest tau, and the angle random walk with it, up to 3% low"
        )
        how.append(message)
        warnings.append(message)
    used = [s for s in stretches if len(s) >= 2]
    longest = max((len(s) for s in used), default=0)
    if longest < least:
        raise DataError(
            f"{file}: the longest stretch without a gap has {longest} samples at a period of {period:.6g} s; at least "
            f"{least} are needed. Give a longer record, or one with fewer gaps (a gap is longer than 3 median steps)"
        )
    if len(stretches) > 1:
        how.append(f"{len(used)} uninterrupted stretches pooled by squares, {longest} samples in the longest")
    return Series(used, period, covered is None and regular, how, warnings)


def _resample(time: np.ndarray, rate: np.ndarray, instant: bool, period: float) -> np.ndarray:
    """Mean rates (k, 3) over periods from the first row on, from the linearly interpolated integral."""
    mean = 0.5 * (rate[1:] + rate[:-1]) if instant else rate[1:]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(mean * np.diff(time)[:, None], axis=0)])
    grid = time[0] + period * np.arange(int((time[-1] - time[0]) / period) + 1)
    on_grid = np.stack([np.interp(grid, time, angle[:, i]) for i in range(3)], axis=1)
    return (on_grid[1:] - on_grid[:-1]) / period


# ----------------------------------------------------------------------------- gyro minus attitude


def minus_attitude(
    gyro: GyroRows, reading: str, attitude: AttitudeRows
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Problem]]:
    """Gyro minus attitude: times (m,) at the end of each interval between attitudes, rates (m, 3), durations (m,).

    Intervals beyond the gyro rows or across a gap of either are left out; so is an attitude that jumps to and fro.
    """
    problems: list[Problem] = []
    for _ in range(3):
        start, rate, duration = _difference(gyro, reading, attitude)
        jump = _jumps(start, rate * duration[:, None], len(attitude))
        if not jump.any():
            break
        for i in np.flatnonzero(jump):
            message = "this attitude agrees with the gyro neither before nor after it"
            problems.append(Problem(attitude.files[attitude.file[i]], int(attitude.row[i]), "jump", message, "dropped"))
        attitude = attitude.select(~jump)
    else:
        start, rate, duration = _difference(gyro, reading, attitude)
    return attitude.time[start + 1], rate, duration, problems


def _difference(gyro: GyroRows, reading: str, attitude: AttitudeRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the attitude that begins each interval (m,), rates (m, 3), durations (m,)."""
    from scipy.spatial.transform import Rotation

    signal = rate_signal(gyro.time, gyro.value, gyro.step, "instant" if reading == "instant" else "mean_since_previous")
    t = attitude.time
    low, high = signal.start[0], signal.end[-1]
    gaps_from, gaps_to = signal.start[signal.gap], signal.end[signal.gap]
    duration = np.diff(t)
    usable = (t[:-1] >= low) & (t[1:] <= high) & (duration <= GAP_FACTOR * np.median(duration))
    usable &= np.searchsorted(gaps_from, t[1:], side="left") == np.searchsorted(gaps_to, t[:-1], side="right")
    start = np.flatnonzero(usable)
    if not len(start):
        return start, np.empty((0, 3)), np.empty(0)
    inside = t[(t >= low) & (t <= high)]
    grid = np.union1d(np.append(signal.start, high), inside)
    turn = Rotation.from_rotvec(-signal.mean_rates(grid) * np.diff(grid)[:, None]).as_quat()
    first, last = np.searchsorted(grid, t[start]), np.searchsorted(grid, t[start + 1])
    # Products of as many turns as lie in each interval, later ones on the left: pairs of pairs, padded by no turn.
    steps = int((last - first).max())
    at = first[:, None] + np.arange(steps)
    product = np.where((at < last[:, None])[..., None], turn[np.minimum(at, len(turn) - 1)], [0.0, 0.0, 0.0, 1.0])
    while product.shape[1] > 1:
        if product.shape[1] % 2:
            product = np.concatenate([product, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(start), 1, 4))], axis=1)
        later, earlier = product[:, 1::2], product[:, 0::2]
        both = Rotation.from_quat(later.reshape(-1, 4)) * Rotation.from_quat(earlier.reshape(-1, 4))
        product = both.as_quat().reshape(len(start), -1, 4)
    by_gyro = Rotation.from_quat(product[:, 0]) * Rotation.from_quat(attitude.q_BN[start])
    difference = (Rotation.from_quat(attitude.q_BN[start + 1]) * by_gyro.inv()).as_rotvec()
    return start, difference / duration[start][:, None], duration[start]


def _jumps(start: np.ndarray, angle: np.ndarray, count: int) -> np.ndarray:
    """Attitudes (count,) with a difference far out before them and the opposite after them."""
    jump = np.zeros(count, dtype=bool)
    if len(start) < 7:
        return jump
    off = angle - np.median(angle, axis=0)
    size = np.abs(off)
    sigma = np.maximum(np.median(size, axis=0) / 0.6745, np.quantile(size, 0.9, axis=0) / 1.6449)
    limit = ATTITUDE_JUMP * np.maximum(sigma, 1e-15)
    neighbours = np.diff(start) == 1
    before, after = off[:-1], off[1:]
    to_and_fro = (np.abs(before) > limit) & (np.abs(after) > limit) & (before * after < 0.0)
    to_and_fro &= np.abs(before + after) < 0.5 * np.abs(before)
    calm = np.abs(off) < 0.5 * limit  # before and after it; else it is the data's nature here
    to_and_fro[1:-1] &= calm[:-3] & calm[3:]
    jump[start[1:][to_and_fro.any(axis=1) & neighbours]] = True
    return jump if jump.mean() <= JUMPS_ARE_RARE else np.zeros(count, dtype=bool)
