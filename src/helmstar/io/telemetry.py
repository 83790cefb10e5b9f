"""Gyro, attitude and star rows from tables: bad rows named and dropped, units, frames and clocks made helmstar's.

What comes out: rates in rad/s (or increments in rad) of the body relative to inertial axes, in body axes; unit
quaternions q_BN, scalar last; unit star directions; times in s since the first of them all, increasing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from ..errors import DataError
from .cleaning import SAME_TIME_S, Part
from .clock import NO_OFFSETS, Instants, Origin, TimeOffsets
from .columns import ColumnsConfiguration, refuse_unknown
from .formats import read_part
from .problems import Problem, ProblemLog, refuse
from .settings import FormatSettings

__all__ = [
    "AttitudeRows",
    "DirectionRows",
    "GyroRows",
    "Problem",
    "Reading",
    "Rows",
    "Telemetry",
    "read_telemetry",
    "to_rates",
]


@dataclass(frozen=True)
class Rows:
    """Rows of one kind in time order: `time` (n,) s since the origin, row number `row` of `files[file]`."""

    time: np.ndarray
    file: np.ndarray
    row: np.ndarray
    files: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: np.ndarray) -> Self:
        """Those at an index or mask."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)}
        return replace(self, **{name: array[index] for name, array in arrays.items()})


@dataclass(frozen=True)
class GyroRows(Rows):
    """`value` (n, 3): rad/s, or rad since the row before if `quantity` is "increment", in body axes.

    "rate" is what the column's name or unit says; sensors.toml's `reading` may still say that they are increments.
    `step` (n,) is the time in s that an increment or a mean covers: since the row before in its file, be that row good
    or bad; NaN for the first row.
    """

    value: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    step: np.ndarray = field(default_factory=lambda: np.empty(0))
    quantity: Literal["rate", "increment"] = "rate"


Reading = Literal["instant", "mean_since_previous", "increment_rad"]


def to_rates(gyro: GyroRows, reading: Reading) -> tuple[GyroRows, Literal["instant", "mean_since_previous"]]:
    """Gyro rows in rad/s, and how these are to be read; increments become mean rates over the `step` they cover.

    The first increment of a file covers an unknown time; the median step is taken.
    """
    if reading != "increment_rad" and gyro.quantity == "rate":
        return gyro, reading
    known = gyro.step[np.isfinite(gyro.step)]
    usual = float(np.median(known)) if len(known) else 1.0
    step = np.where(np.isfinite(gyro.step), gyro.step, usual)
    return replace(gyro, value=gyro.value / step[:, None], quantity="rate"), "mean_since_previous"


@dataclass(frozen=True)
class AttitudeRows(Rows):
    """`q_BN` (n, 4), unit, scalar last; its sign is the file's. `covariance` (n, 3, 3): of each, rad^2, error on the left in B;
    None where the rows do not say it."""

    q_BN: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))
    covariance: np.ndarray | None = None


@dataclass(frozen=True)
class DirectionRows(Rows):
    """One star per row: unit directions `star_B` and `star_N` (n, 3). Equal times are one epoch."""

    star_B: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    star_N: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True)
class Telemetry:
    """All rows of all files. `clock` says in words what the times are; `origin` turns them back into dates.

    The rows' times have `offsets` in them already.
    """

    gyro: GyroRows
    attitude: AttitudeRows
    directions: DirectionRows | None
    problems: tuple[Problem, ...]
    clock: str
    origin: Origin
    offsets: TimeOffsets = NO_OFFSETS


def read_telemetry(
    files: Sequence[Path | str],
    columns: ColumnsConfiguration | Sequence[ColumnsConfiguration] | None = None,
    *,
    strict: bool = False,
    needs: Sequence[Literal["gyro", "star"]] = ("gyro", "star"),
    max_problems: int = 1000,
    settings: FormatSettings | None = None,
    offsets: TimeOffsets = NO_OFFSETS,
) -> Telemetry:
    """Read tables (CSV, Parquet) and files of the formats that `formats` knows into one telemetry.

    `columns`: one map for all tables, or several with a `file` pattern each; `settings` are for the formats. `offsets`
    are added to the stamps. `needs`: what must be there, "star" being attitudes or star directions. With `strict` any bad
    row is a DataError; otherwise bad rows are listed in `problems`, per file and kind the first `max_problems` by row.
    """
    maps = [] if columns is None else [columns] if isinstance(columns, ColumnsConfiguration) else list(columns)
    names = [str(file) for file in files]
    if not names:
        raise DataError("no file given; name at least one CSV or Parquet file")
    for name in names:
        if names.count(name) > 1:
            raise DataError(f"{name}: the file is given twice; name each file once")
    log = ProblemLog(max_problems)
    parts = [read_part(Path(name), maps, log, settings, max_problems) for name in names]
    for entry in maps:
        tables = [(list(part.table.columns), part.layout) for part in parts if part.map is entry]
        refuse_unknown(entry, tables, needs)
    origin = _common_origin(parts)

    gyro = _gyro_rows(parts, origin, log)
    attitude = AttitudeRows(**_gather(parts, origin, "quaternion", log, ("q_BN", 4)))
    stars = _gather(parts, origin, "stars", log, ("both", 6))
    both = stars.pop("both")
    directions = DirectionRows(**stars, star_B=both[:, :3], star_N=both[:, 3:]) if len(both) else None
    # Before anything looks from one kind of rows to the other: base rates are turned by the attitude of their instant.
    gyro = replace(gyro, time=gyro.time + offsets.gyro)
    attitude = replace(attitude, time=attitude.time + offsets.star)
    if directions is not None:
        directions = replace(directions, time=directions.time + offsets.star)
    gyro = _turn_into_body(gyro, [part.layout.gyro_frame == "base" for part in parts], attitude, log)

    problems = _in_order((*(problem for part in parts for problem in part.table.problems), *log.problems()), names)
    if strict:
        refuse(problems)
    if "gyro" in needs and not len(gyro):
        raise DataError(_why_none(parts, problems, "gyro", ("gyro",), "give gyro_x_rad_s, _y_, _z_"))
    if "star" in needs and not len(attitude) and directions is None:
        remedy = "give q_bn_x, _y, _z, _w (or star_b_x ... with star_n_x ...), in the same table or as a further file,"
        raise DataError(_why_none(parts, problems, "attitude or star", ("quaternion", "star_b", "star_n"), remedy))
    return Telemetry(gyro, attitude, directions, problems, _clock_in_words(parts, origin), origin, offsets)


def _why_none(parts: Sequence[Part], problems: Sequence[Problem], what: str, kinds: Sequence[str], remedy: str) -> str:
    """What to say where no row of a kind is usable: that the columns are not there, or what is wrong with their rows."""
    files = ", ".join(part.table.file for part in parts)
    columns = {part.table.file: [n for kind in kinds for n in getattr(part.layout, kind)] for part in parts}
    names = list(dict.fromkeys(name for group in columns.values() for name in group))
    if not names:
        return f"{files}: no usable {what} row; {remedy} or map them in [columns]"
    words = (*names, *(("rates",) if "gyro" in kinds else ("quaternion", "direction")))  # of messages about such rows
    bad = [p for p in problems if p.action == "dropped" and columns.get(p.file)]
    bad = [p for p in bad if any(word in p.message for word in words)] or bad
    reason = f"for one, {bad[0]}" if bad else f"the columns {', '.join(names)} are empty in every row that has a time"
    return f"{files}: no usable {what} row, though there are columns; {reason}"


def _common_origin(parts: Sequence[Part]) -> Origin:
    """The first time of all usable rows; plain seconds and absolute times do not mix."""
    relative = [part for part in parts if not part.instants.absolute]
    absolute = [part for part in parts if part.instants.absolute]
    if relative and absolute:
        raise DataError(
            f"{relative[0].table.file} counts plain seconds in {relative[0].layout.time!r}, but "
            f"{absolute[0].table.file} has dates or absolute times in {absolute[0].layout.time!r}: how they fit "
            'together is not known. Say in [columns] what the seconds count (clock_scale = "unix", "gps" or "tai"), or '
            "choose a time column that both files have (time = ...)"
        )
    firsts = [
        part.instants.select(group.index).earliest() for part in parts for group in part.groups() if len(group.index)
    ]
    together = Instants(np.array([o.day for o in firsts]), np.array([o.second for o in firsts]), not relative)
    return together.earliest()


def _gather(parts: Sequence[Part], origin: Origin, kind: str, log: ProblemLog, name: tuple[str, int]) -> dict:
    """Fields of a `Rows` from the groups of one kind of all tables, merged in time order."""
    groups = [(i, part, getattr(part, kind)) for i, part in enumerate(parts) if getattr(part, kind) is not None]
    files = tuple(part.table.file for part in parts)
    empty = np.empty(0, dtype=np.int64)
    time = np.concatenate(
        [np.empty(0), *(part.instants.select(group.index).since(origin) for _, part, group in groups)]
    )
    order = np.argsort(time, kind="stable")
    rows = {
        "time": time[order],
        "file": np.concatenate([empty, *(np.full(len(group.index), i) for i, _, group in groups)])[order],
        "row": np.concatenate([empty, *(part.table.row[group.index] for _, part, group in groups)])[order],
        "step": np.concatenate([np.empty(0), *(group.step for _, _, group in groups)])[order],
        name[0]: np.concatenate([np.empty((0, name[1])), *(group.values for _, _, group in groups)])[order],
    }
    if kind != "stars":  # two files may overlap; the one named first on the command line is believed
        repeated = np.concatenate([[False], np.diff(rows["time"]) < SAME_TIME_S]).astype(bool)[: len(time)]
        for i in np.unique(rows["file"][repeated]):
            row = rows["row"][repeated & (rows["file"] == i)]
            log.add(files[i], row, "time_repeated", "another file has a row at the same time", "dropped")
        rows = {key: column[~repeated] for key, column in rows.items()}
    if kind != "gyro":
        del rows["step"]
    return {**rows, "files": files}


def _gyro_rows(parts: Sequence[Part], origin: Origin, log: ProblemLog) -> GyroRows:
    kinds = {part.layout.gyro_is_increment: part.table.file for part in parts if part.gyro is not None}
    if len(kinds) > 1:
        raise DataError(f"{kinds[True]} has gyro increments, {kinds[False]} gyro rates; give files of one kind")
    quantity = "increment" if True in kinds else "rate"
    return GyroRows(**_gather(parts, origin, "gyro", log, ("value", 3)), quantity=quantity)


def _turn_into_body(gyro: GyroRows, base: Sequence[bool], attitude: AttitudeRows, log: ProblemLog) -> GyroRows:
    """Rates of the files flagged in `base` from inertial into body axes, by the attitude at their time.

    That is the attitude of the same row or else the one between its neighbours (slerp); before the first and after the
    last attitude there is none, and the rows are dropped.
    """
    in_base = np.array(base, dtype=bool)[gyro.file] if len(gyro) else np.zeros(0, dtype=bool)
    if not in_base.any():
        return gyro
    if not len(attitude):
        raise DataError('gyro_frame = "base" needs attitudes to turn the rates into body axes, and no row has one')
    from scipy.spatial.transform import Rotation, Slerp

    inside = (gyro.time >= attitude.time[0]) & (gyro.time <= attitude.time[-1])
    for i in np.unique(gyro.file[in_base & ~inside]):
        row = gyro.row[in_base & ~inside & (gyro.file == i)]
        message = "rates in base axes before the first or after the last attitude, which would turn them into body axes"
        log.add(gyro.files[i], row, "frame", message, "dropped")
    turned = in_base & inside
    value = gyro.value.copy()
    if turned.any():
        knots, q = attitude.time, attitude.q_BN
        if len(attitude) == 1:
            knots, q = np.array([knots[0], knots[0] + 1.0]), np.repeat(q, 2, axis=0)
        value[turned] = Slerp(knots, Rotation.from_quat(q))(gyro.time[turned]).apply(value[turned])
    return replace(gyro, value=value).select(~in_base | inside)


def _in_order(problems: Sequence[Problem], files: Sequence[str]) -> tuple[Problem, ...]:
    order = {file: i for i, file in enumerate(files)}
    return tuple(sorted(problems, key=lambda problem: (order.get(problem.file, len(order)), problem.row)))


def _clock_in_words(parts: Sequence[Part], origin: Origin) -> str:
    columns = dict.fromkeys(f"{part.layout.time} ({part.layout.scale})" for part in parts)
    return f"seconds since {origin}, from {', '.join(columns)}"
