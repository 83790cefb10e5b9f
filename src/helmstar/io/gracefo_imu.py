"""Gyro increments from GRACE-FO IMU1A and IMU1B: four single-axis gyros whose filtered angles are counted up.

FiltAng is the angle in degrees that one gyro (gyro_id 1..4) has turned about its input axis since some zero; the gyros are
read one after the other, some ms apart, 8 times a second. The difference of a gyro's angles is its increment. Three input
axes lie 120 degrees apart, 19 degrees off a plane, the fourth is normal to it. An epoch is a time of the first gyro; the
others' angles are interpolated to it, and the increments about x, y, z of the science reference frame are the least squares
solution of axes @ increment = differences. An epoch at which a gyro is missing is left out; the angles being counted up, the
next increment covers it.

The axes of both satellites below are those that Yang, Liang, Wang and Luo used (Attitude Determination for GRACE-FO, Remote
Sensing 14, 126, 2022): per gyro in the IMU's frame, and the IMU's frame in the satellite's. They have not been checked here
against flight data; `imu_axes` replaces them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import DataError
from .attitude_file import attitude_layout
from .cleaning import Group, Part, longest_without_decrease
from .gracefo import Product, times, unflagged
from .problems import ProblemLog, for_one
from .settings import GraceFoConfiguration
from .table import Table

DEG = np.pi / 180.0
UNITS = {"deg": DEG, "rad": 1.0, "arcsec": DEG / 3600.0}
_HEADER_UNITS = {"degree": "deg", "degrees": "deg", "deg": "deg", "radian": "rad", "radians": "rad", "rad": "rad"}
JUMP_DEG = 180.0  # nothing turns so far between two readings
NEAR = 1.5  # of the gyro's median step: readings farther apart have lost one between them
_MISSING = 0.5  # a gyro with fewer readings than this share of the fullest one's is left out

_AXES_IMU = {
    "C": [[0.942826211, 0.001810853, 0.33327985], [-0.472597539, 0.815825089, 0.333288147],
          [-0.470092696, -0.817231401, 0.333385204], [-0.000592072, -0.000382796, -0.999999751]],
    "D": [[0.942687237, 0.000111944, 0.33367763], [-0.471344745, 0.816437037, 0.333563632],
          [-0.471100307, -0.816914065, 0.332740005], [0.000753399, 0.000461058, -0.99999961]],
}  # fmt: skip
_IMU_IN_SRF = {
    "C": [[-0.501252164183920, 0.865301254687325, -0.000080854668175],
          [0.865300283426991, 0.501251737450002, 0.001454374272271],
          [0.001299000425484, 0.000659044684221, -0.999998939128437]],
    "D": [[-0.501005885615109, 0.865443870184570, 0.000100692470726],
          [0.865443802410115, 0.501005791604386, 0.000470795904316],
          [0.000356999918493, 0.000323015193725, -0.999999884106115]],
}  # fmt: skip


def input_axes(satellite: str, settings: GraceFoConfiguration) -> np.ndarray:
    """Unit input axes (m, 3) of gyro 1, 2, .. in the science reference frame. Raises DataError if nobody says them."""
    if settings.imu_axes is not None:
        axes = np.array(settings.imu_axes, dtype=float)
    elif satellite in _AXES_IMU:
        axes = np.array(_AXES_IMU[satellite]) @ np.array(_IMU_IN_SRF[satellite]).T
    else:
        raise DataError(
            f"the input axes of the gyros of satellite {satellite[:20]!r} are not known; give [gracefo] imu_axes"
        )
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def imu_part(product: Product, settings: GraceFoConfiguration, log: ProblemLog) -> Part:
    """Increments in rad about the axes of the SRF, one row per epoch from the second on. Raises DataError."""
    table = product.table
    file = table.file
    try:
        axes = input_axes(product.satellite, settings)
    except DataError as error:
        raise DataError(f"{file}: {error}") from None
    instants, stays = times(product, log)
    stays &= unflagged(product, settings, log)
    angle, gyro, stays = _angles(product, len(axes), settings, stays, log)
    origin = instants.select(stays).earliest() if stays.any() else None
    if origin is None:
        raise DataError(f"{file}: none of its {len(table)} rows is usable{for_one(log.problems())}")
    time = instants.since(origin)

    counts = np.bincount(gyro[stays], minlength=len(axes) + 1)[1:]
    used = [i + 1 for i in range(len(axes)) if counts[i] >= max(2, _MISSING * counts.max())]
    chosen = axes[[i - 1 for i in used]]
    if len(used) < 3 or np.linalg.svd(chosen, compute_uv=False)[-1] < 1e-3:
        listed = ", ".join(map(str, used)) or "none"
        raise DataError(f"{file}: gyros with enough readings: {listed}; three with independent axes are needed")

    series = [_counted_up(table, np.flatnonzero(stays & (gyro == i)), time, angle, settings, log) for i in used]
    index, at = series[0].index, series[0].time
    known = np.ones(len(at), dtype=bool)
    counted = np.empty((len(at), len(used)))
    lost = np.zeros(len(at), dtype=bool)
    for column, one in enumerate(series):
        counted[:, column] = np.interp(at, one.time, one.angle)
        known &= one.near(at)
        lost |= one.lost_before(at)
    kept = np.flatnonzero(known)
    if len(kept) < 2:
        raise DataError(
            f"{file}: {len(kept)} times at which all of gyros {', '.join(map(str, used))} are known; 2 are needed"
        )
    began, ended = max(one.time[0] for one in series), min(one.time[-1] for one in series)
    missed = table.row[index[~known & (at >= began) & (at <= ended)]]  # at the ends it is no fault
    log.add(file, missed, "nan", "another gyro has no reading near this one; the next increment covers it", "dropped")
    value = np.diff(counted[kept], axis=0) @ np.linalg.pinv(chosen).T
    losses = np.cumsum(lost)[kept]
    whole = np.flatnonzero(losses[1:] == losses[:-1])
    if not len(whole):
        raise DataError(f"{file}: no increment is left{for_one(log.problems())}")
    rows = index[kept[1:]]
    layout = replace(attitude_layout("rcvtime", "gps"), gyro=("FiltAng",) * 3, gyro_unit="rad", quaternion=())
    group = Group(whole, value[whole], np.diff(at[kept])[whole])
    return Part(Table(file, {}, table.row[rows]), layout, instants.select(rows), group, None, None)


def _angles(
    product: Product, gyros: int, settings: GraceFoConfiguration, stays: np.ndarray, log: ProblemLog
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """FiltAng in rad (n,), gyro_id (n,) (0: none), and which rows are still good."""
    table = product.table
    if "gyro_id" not in table.columns:
        raise DataError(f"{table.file}: the header names no gyro_id beside FiltAng")
    said = _HEADER_UNITS.get(product.units.get("FiltAng", "").lower(), "deg")
    cells, ids = table.numbers("FiltAng"), table.numbers("gyro_id").value
    not_numbers = stays & cells.bad
    log.add(table.file, table.row[not_numbers], "not_a_number", "FiltAng holds something that is no number", "dropped")
    nothing = stays & ~cells.bad & ~(np.abs(cells.value) < 1e12)
    log.add(table.file, table.row[nothing], "nan", "FiltAng is empty, NaN or infinite", "dropped")
    known = np.isfinite(ids) & (ids == np.floor(ids)) & (ids >= 1) & (ids <= gyros)
    strange = stays & ~known
    log.add(table.file, table.row[strange], "not_a_number", f"gyro_id is none of 1 to {gyros}", "dropped")
    gyro = np.where(known, ids, 0.0).astype(int)
    angle = np.where(np.isfinite(cells.value), cells.value, 0.0) * UNITS[settings.angle_unit or said]
    return angle, gyro, stays & ~not_numbers & ~nothing & known


class _Series:
    """One gyro's readings: `index` of rows, increasing `time` (n,) s, `angle` (n,) rad without wraps, `jump` (n,)."""

    def __init__(self, index: np.ndarray, time: np.ndarray, angle: np.ndarray, jump: np.ndarray) -> None:
        self.index, self.time, self.angle = index, time, angle
        self._jumps = np.flatnonzero(jump)
        self._period = float(np.median(np.diff(time)))

    def near(self, at: np.ndarray) -> np.ndarray:
        """Which times lie on a reading or between two that follow each other without a loss."""
        after = np.clip(np.searchsorted(self.time, at, side="left"), 1, len(self.time) - 1)
        span = self.time[after] - self.time[after - 1]
        inside = (at >= self.time[0]) & (at <= self.time[-1]) & (span <= NEAR * self._period)
        on_one = np.minimum(np.abs(at - self.time[after]), np.abs(at - self.time[after - 1])) < 1e-9
        return inside | on_one

    def lost_before(self, at: np.ndarray) -> np.ndarray:
        """Whether the step to each of the times, from the one before it, holds a jump."""
        lost = np.zeros(len(at), dtype=bool)
        for j in self._jumps:
            first = np.searchsorted(at, self.time[j - 1], side="right")
            last = np.searchsorted(at, self.time[j], side="left")
            lost[first : last + 1] = True
        return lost


def _counted_up(
    table: Table, rows: np.ndarray, time: np.ndarray, angle: np.ndarray, settings: GraceFoConfiguration, log: ProblemLog
) -> _Series:
    """The readings of one gyro in order of time, wraps undone or jumps noted."""
    keep = longest_without_decrease(time[rows])
    log.add(table.file, table.row[rows[~keep]], "time_backwards", "the time of this gyro goes back", "dropped")
    rows = rows[keep]
    repeated = np.concatenate([[False], np.diff(time[rows]) < 1e-9])
    log.add(
        table.file, table.row[rows[repeated]], "time_repeated", "the time is that of the gyro's row before", "dropped"
    )
    rows = rows[~repeated]
    if len(rows) < 2:
        raise DataError(f"{table.file}: a gyro has {len(rows)} usable readings in order of time; 2 are needed")
    step = np.diff(angle[rows])
    if settings.angle_wrap_deg is not None:
        wrap = settings.angle_wrap_deg * DEG
        step -= wrap * np.round(step / wrap)
    jump = np.concatenate([[False], np.abs(step) > JUMP_DEG * DEG])
    message = "FiltAng jumps; the increment is lost ([gracefo] angle_wrap_deg says where it starts again)"
    log.add(table.file, table.row[rows[jump]], "jump", message, "dropped")
    step[jump[1:]] = 0.0
    return _Series(rows, time[rows], np.concatenate([[0.0], np.cumsum(step)]), jump)
