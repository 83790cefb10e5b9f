"""Gyro data that cannot be true: a wrong unit and single spikes, found without a model and without false alarms.

Everything here is conservative: what is doubtful stays, because a filter's gate judges better than a rule about rows.
Attitudes, where there are any, are the arbiter: a row that they confirm is kept, however odd it looks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from .problems import Kind, Problem, ProblemLog
from .telemetry import AttitudeRows, GyroRows, Reading, to_rates

DEG = 180.0 / math.pi  # 57.2958, the factor between numbers in degrees and in radians
SPIKE_SIGMAS = 12.0  # a spike's distance from the line between its neighbours, in robust sigmas of that distance
SPIKE_STEPS = 5.0  # and in steps between the samples around it
SPIKES_ARE_RARE = 0.02  # more of them are the nature of the data
UNIT_TOLERANCE = 0.2  # relative, between a row and 57.3 times its neighbour
UNIT_SIGMAS = 10.0  # the smaller of the two must stand out of the noise, or its 57.3-fold says nothing
GAP_FACTOR = 3.0
FASTEST_RAD_S = 1e3  # 57 000 deg/s, several times what any gyro measures


@dataclass(frozen=True)
class Gap:
    """An interval without rows, s."""

    start: float
    end: float
    duration: float


def find_gaps(time: np.ndarray, factor: float = GAP_FACTOR) -> list[Gap]:
    """Intervals longer than `factor` median steps of increasing times (s)."""
    step = np.diff(time)
    if not len(step):
        return []
    longer = np.flatnonzero(step > factor * np.median(step))
    return [Gap(float(time[i]), float(time[i + 1]), float(step[i])) for i in longer]


def screen_gyro(gyro: GyroRows, attitude: AttitudeRows, reading: Reading) -> tuple[GyroRows, list[Problem]]:
    """Drop rates that no body has, convert a file that is in degrees where radians are said (or the reverse), drop rows
    that are, drop spikes.

    `reading` says what a value is: the rate at its time, the mean rate since the row before, or the increment since.
    """
    rates, mean = to_rates(gyro, reading)
    fast = np.linalg.norm(rates.value, axis=1) > FASTEST_RAD_S
    problems = _too_fast(rates.select(fast))
    gyro, rates = gyro.select(~fast), rates.select(~fast)
    for i in np.unique(gyro.file):
        mine = gyro.file == i
        factor = _unit_factor(rates.select(mine), attitude, mean)
        if factor != 1.0:
            problems.append(_wrong_file(gyro.select(mine), factor))
            scale = np.where(mine, factor, 1.0)[:, None]
            gyro, rates = replace(gyro, value=gyro.value * scale), replace(rates, value=rates.value * scale)
    for find in (_rows_in_wrong_unit, _spikes):
        bad, kind, message = find(rates, attitude, mean)
        for j in np.flatnonzero(bad):
            problems.append(Problem(gyro.files[gyro.file[j]], int(gyro.row[j]), kind, message, "dropped"))
        gyro, rates = gyro.select(~bad), rates.select(~bad)
    return gyro, problems


def _too_fast(rates: GyroRows) -> list[Problem]:
    """One entry for each row, the many of a file summed up."""
    log = ProblemLog()
    for i in np.unique(rates.file):
        mine = rates.file == i
        size = np.linalg.norm(rates.value[mine], axis=1)
        log.add(
            rates.files[i], rates.row[mine], "too_fast",
            lambda k, size=size: f"a rate of {size[k]:.4g} rad/s, which is no body's; are unit and `reading` right?",
            "dropped",
        )  # fmt: skip
    return list(log.problems())


# ----------------------------------------------------------------------------- a whole file in the wrong unit


def _wrong_file(gyro: GyroRows, factor: float) -> Problem:
    """What to say of a file whose values had to be multiplied by `factor`."""
    first, last = int(gyro.row.min()), int(gyro.row.max())
    times, wrong, unit = ("57.3", "degrees", "deg") if factor < 1.0 else ("1/57.3", "radians", "rad")
    unit += "" if gyro.quantity == "increment" else "/s"
    message = (
        f"ALL GYRO VALUES, rows {first} to {last}, are {times} times what the attitudes say: they are in {wrong}, but "
        f'their column or its map says otherwise. Say so in sensors.toml: [columns] gyro_unit = "{unit}"'
    )
    return Problem(gyro.files[gyro.file[0]], first, "unit", message, "converted", len(gyro))


def _unit_factor(gyro: GyroRows, attitude: AttitudeRows, reading: Reading) -> float:
    """1, or the factor (1/57.3 or 57.3) that makes gyro and attitudes agree, if there is no doubt about it.

    The mean rates between attitudes, by gyro and by attitude, are compared without their medians, so that a drift does
    not count; where the rate does not vary, they are compared as they are.
    """
    by_attitude, by_gyro = _mean_rates(gyro, attitude, reading)
    if len(by_attitude) < 5:
        return 1.0
    variation, motion = _misfit(by_attitude - np.median(by_attitude, axis=0)), _misfit(by_attitude)
    varying, as_is = {}, {}
    for factor in (1.0, 1.0 / DEG, DEG):
        difference = by_attitude - factor * by_gyro
        varying[factor] = _misfit(difference - np.median(difference, axis=0))
        as_is[factor] = _misfit(difference)
    for factor in (1.0 / DEG, DEG):
        if varying[factor] < 0.2 * variation and varying[1.0] > 5.0 * varying[factor]:
            return factor
        steady = varying[1.0] > 0.5 * variation  # variations do not speak for the unit as it is
        if steady and as_is[factor] < 0.2 * motion and as_is[1.0] > 5.0 * as_is[factor]:
            return factor
    return 1.0


def _misfit(vectors: np.ndarray) -> float:
    """Root mean square length, without the largest 2% (a few wild attitudes shall not decide)."""
    squares = np.sort(np.sum(vectors**2, axis=1))
    return float(np.sqrt(np.mean(squares[: max(len(squares) - 2 - len(squares) // 50, 1)])))


def _mean_rates(gyro: GyroRows, attitude: AttitudeRows, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
    """Mean rate (m, 3) in rad/s over intervals between attitudes, by attitude and by gyro, where both know it."""
    if len(gyro) < 2 or len(attitude) < 2:
        return np.empty((0, 3)), np.empty((0, 3))
    start, end = attitude.time[:-1], attitude.time[1:]
    turn = _turn(attitude.q_BN[:-1], attitude.q_BN[1:])
    known = (start >= gyro.time[0]) & (end <= gyro.time[-1]) & (np.linalg.norm(turn, axis=1) < 1.0)
    gaps = find_gaps(gyro.time)
    gap_starts, gap_ends = np.array([gap.start for gap in gaps]), np.array([gap.end for gap in gaps])
    known &= np.searchsorted(gap_starts, end, side="left") == np.searchsorted(gap_ends, start, side="right")
    start, end = start[known], end[known]
    duration = (end - start)[:, None]
    return turn[known] / duration, _integral(gyro.time, gyro.value, reading, start, end) / duration


def _turn(q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """Rotation vectors (m, 3) in rad, body axes, of the body's turn between attitudes: R_to = Exp(-turn) R_from."""
    from scipy.spatial.transform import Rotation

    return -(Rotation.from_quat(q_to) * Rotation.from_quat(q_from).inv()).as_rotvec()


def _integral(time: np.ndarray, value: np.ndarray, reading: Reading, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Integrated rate (m, 3) in rad from `start` to `end`, linear between rows."""
    mean = value[1:] if reading == "mean_since_previous" else 0.5 * (value[1:] + value[:-1])
    total = np.vstack([np.zeros(3), np.cumsum(mean * np.diff(time)[:, None], axis=0)])
    return np.stack([np.interp(end, time, total[:, i]) - np.interp(start, time, total[:, i]) for i in range(3)], axis=1)


# ----------------------------------------------------------------------------- rows in the wrong unit


def _rows_in_wrong_unit(gyro: GyroRows, attitude: AttitudeRows, reading: Reading) -> tuple[np.ndarray, Kind, str]:
    """Runs of rows entered and left by a step of 57.3: the rows on the one side of these steps are wrong.

    Which side: the one whose correction the attitudes confirm; without attitudes there, the one with fewer rows. A
    series that changes its level only once, without attitudes, is left alone.
    """
    bad = np.zeros(len(gyro), dtype=bool)
    up, down = _unit_steps(gyro.time, gyro.value)
    level = np.cumsum(np.concatenate([[0], up.astype(int) - down.astype(int)]))[: len(gyro)]
    message = "the rates are {} times those of the rows before and after, degrees for radians"
    if level.size == 0 or level.max() - level.min() != 1:
        return bad, "unit", message  # no such step, or no two levels: then it is something else
    high = level == level.max()
    fewer, more = sorted(((high, 1.0 / DEG, "57.3"), (~high, DEG, "1/57.3")), key=lambda side: side[0].sum())
    mended = [np.where(rows[:, None], gyro.value * factor, gyro.value) for rows, factor, _ in (fewer, more)]
    for i, (rows, _, times) in enumerate((fewer, more)):
        misfits = _misfits(gyro, attitude, reading, rows, [gyro.value, *mended])
        as_is, as_mended = _known_median(misfits[0]), _known_median(misfits[1 + i])
        inside = i == 0 and not rows[0] and not rows[-1]
        if as_mended < 0.5 * as_is or (inside and not as_is < 0.5 * as_mended):
            return rows, "unit", message.format(times)
    return bad, "unit", message


def _known_median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _unit_steps(time: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n - 1,) after which the rate vector is 57.3 times (up) or 1/57.3 times (down) what it was."""
    if len(rate) < 3:
        none = np.zeros(max(len(rate) - 1, 0), dtype=bool)
        return none, none
    noise = np.linalg.norm(_sigma(_off_line(time, rate))) / math.sqrt(1.5)  # of a row, not of a second difference
    size = np.linalg.norm(rate, axis=1)
    floor = UNIT_SIGMAS * noise

    def steps(small: np.ndarray, large: np.ndarray, small_size: np.ndarray, large_size: np.ndarray) -> np.ndarray:
        near = np.linalg.norm(large - DEG * small, axis=1) <= UNIT_TOLERANCE * large_size
        return near & (small_size > floor) & (large_size > 0.0)

    return steps(rate[:-1], rate[1:], size[:-1], size[1:]), steps(rate[1:], rate[:-1], size[1:], size[:-1])


# ----------------------------------------------------------------------------- spikes


def _spikes(gyro: GyroRows, attitude: AttitudeRows, reading: Reading) -> tuple[np.ndarray, Kind, str]:
    """Single rows far from the line between their neighbours, in a place where the rate hardly changes otherwise."""
    message = "a single gyro row far from both its neighbours, which agree with each other"
    bad = np.zeros(len(gyro), dtype=bool)
    if len(gyro) < 7:
        return bad, "jump", message
    rate = gyro.value
    off = np.abs(_off_line(gyro.time, rate))
    step = np.linalg.norm(np.diff(rate, axis=0), axis=1)  # over all axes: what shakes one shakes the others
    step = np.concatenate([step[:2][::-1], step, step[-2:][::-1]])  # step[i + 2] leads from row i to i + 1
    across = np.linalg.norm(rate[2:] - rate[:-2], axis=1)
    around = np.maximum.reduce([across, *(step[j : j + len(across)] for j in (0, 1, 4, 5))])
    spike = (off > SPIKE_SIGMAS * _sigma(_off_line(gyro.time, rate))) & (off > SPIKE_STEPS * around[:, None])
    spike &= off > SPIKE_SIGMAS * _resolution(rate)
    near = (gyro.time[2:] - gyro.time[:-2]) <= 2.0 * GAP_FACTOR * np.median(np.diff(gyro.time))
    bad[1:-1] = spike.any(axis=1) & near
    if bad.mean() > SPIKES_ARE_RARE:
        return np.zeros(len(gyro), dtype=bool), "jump", message
    mended = gyro.value.copy()
    for axis in range(3):
        mended[bad, axis] = np.interp(gyro.time[bad], gyro.time[~bad], gyro.value[~bad, axis])
    as_is, as_mended = _misfits(gyro, attitude, reading, bad, [rate, mended])
    bad[np.flatnonzero(bad)[as_is < 0.5 * as_mended]] = False
    return bad, "jump", message


def _off_line(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Distance (n - 2, 3) of each row from the line between its neighbours."""
    weight = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2]))[:, None]
    return rate[1:-1] - (rate[:-2] + weight * (rate[2:] - rate[:-2]))


def _sigma(off: np.ndarray) -> np.ndarray:
    """Robust standard deviation per axis: by the median, or by the 90th percentile where most values are equal."""
    size = np.abs(off)
    return np.maximum(np.median(size, axis=0) / 0.6745, np.quantile(size, 0.9, axis=0) / 1.6449)


def _resolution(rate: np.ndarray) -> np.ndarray:
    """The smallest difference between values that recur, per axis: the quantum of quantised data, else 0 or near it."""
    smallest = []
    for axis in range(3):
        values, count = np.unique(rate[:, axis], return_counts=True)
        smallest.append(np.min(np.diff(values[count > 1]), initial=np.inf))
    return np.where(np.isfinite(smallest), smallest, 0.0)


# ----------------------------------------------------------------------------- what the attitudes say


def _misfits(
    gyro: GyroRows, attitude: AttitudeRows, reading: Reading, rows: np.ndarray, candidates: list[np.ndarray]
) -> list[np.ndarray]:
    """For each of the suspected `rows` (a mask), rad: how far the integral of each candidate for all rates (n, 3) is
    from the turn between the attitudes around the row; NaN where there are none. Drift is that of the best candidate.
    """
    after = np.searchsorted(attitude.time, gyro.time[rows], side="right")
    around = np.flatnonzero((after > 0) & (after < len(attitude)))
    # A rate acts on the steps before and after its row, so one attitude more on either side is taken.
    first, last = np.maximum(after[around] - 2, 0), np.minimum(after[around] + 1, len(attitude) - 1)
    start, end = attitude.time[first], attitude.time[last]
    turn = _turn(attitude.q_BN[first], attitude.q_BN[last])
    known = (start >= gyro.time[0]) & (end <= gyro.time[-1]) & (np.linalg.norm(turn, axis=1) < 1.0)

    drifts = []
    for value in candidates:
        by_attitude, by_gyro = _mean_rates(replace(gyro, value=value), attitude, reading)
        drift = np.median(by_attitude - by_gyro, axis=0) if len(by_gyro) else np.zeros(3)
        left = np.median(np.linalg.norm(by_attitude - by_gyro - drift, axis=1)) if len(by_gyro) else 0.0
        drifts.append((left, drift))
    drift = min(drifts, key=lambda pair: pair[0])[1]
    misfits = []
    for value in candidates:
        integral = _integral(gyro.time, value + drift, reading, start[known], end[known])
        misfit = np.full(len(after), np.nan)
        misfit[around[known]] = np.linalg.norm(turn[known] - integral, axis=1)
        misfits.append(misfit)
    return misfits
