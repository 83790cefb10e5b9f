"""Gyro, attitude and star rows from tables: bad rows named and dropped, units, frames and clocks made helmstar's.

What comes out: rates in rad/s (or increments in rad) of the body relative to inertial axes, in body axes; unit
quaternions q_BN, scalar last; unit star directions; times in s since the first of them all, increasing.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from ..errors import DataError
from .clock import Instants, Origin, from_numbers, from_texts
from .columns import UNIT_TO_SI, ColumnsConfiguration, Layout, map_for, resolve
from .problems import Problem, ProblemLog, refuse
from .table import Table, read_table

__all__ = ["AttitudeRows", "DirectionRows", "GyroRows", "Problem", "Rows", "Telemetry", "read_telemetry"]

NORM_TOLERANCE = 1e-3  # a quaternion or direction farther from length 1 is damaged, not rounded
ROUNDING = 1e-6  # a norm this close to 1 is the rounding of printed digits, not worth a word


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

    "rate" is what the column's name or unit says; only sensors.toml's `reading` can say that its numbers are increments.
    """

    value: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    quantity: Literal["rate", "increment"] = "rate"


@dataclass(frozen=True)
class AttitudeRows(Rows):
    """`q_BN` (n, 4), unit, scalar last; its sign is the file's."""

    q_BN: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))


@dataclass(frozen=True)
class DirectionRows(Rows):
    """One star per row: unit directions `star_B` and `star_N` (n, 3). Equal times are one epoch."""

    star_B: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    star_N: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True)
class Telemetry:
    """All rows of all files. `clock` says in words what the times are; `origin` turns them back into dates."""

    gyro: GyroRows
    attitude: AttitudeRows
    directions: DirectionRows | None
    problems: tuple[Problem, ...]
    clock: str
    origin: Origin


@dataclass(frozen=True)
class _Group:
    """The usable rows of one kind in one table; `index` points into the table's rows."""

    index: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class _Part:
    """One table, understood."""

    table: Table
    layout: Layout
    instants: Instants
    gyro: _Group | None
    quaternion: _Group | None
    stars: _Group | None

    def groups(self) -> list[_Group]:
        return [group for group in (self.gyro, self.quaternion, self.stars) if group is not None]


def read_telemetry(
    files: Sequence[Path | str],
    columns: ColumnsConfiguration | Sequence[ColumnsConfiguration] | None = None,
    *,
    strict: bool = False,
    needs: Sequence[Literal["gyro", "star"]] = ("gyro", "star"),
    max_problems: int = 1000,
) -> Telemetry:
    """Read CSV or Parquet tables into one telemetry.

    `columns`: one map for all files, or several with a `file` pattern each. `needs`: what must be there, "star" being
    attitudes or star directions. With `strict` any bad row is a DataError; otherwise bad rows are listed in `problems`,
    per file and kind the first `max_problems` by row.
    """
    maps = [] if columns is None else [columns] if isinstance(columns, ColumnsConfiguration) else list(columns)
    names = [str(file) for file in files]
    if not names:
        raise DataError("no file given; name at least one CSV or Parquet file")
    for name in names:
        if names.count(name) > 1:
            raise DataError(f"{name}: the file is given twice; name each file once")
    log = ProblemLog(max_problems)
    parts = [_understand(read_table(Path(name), max_problems), maps, log) for name in names]
    origin = _common_origin(parts)

    gyro = _gyro_rows(parts, origin, log)
    attitude = AttitudeRows(**_gather(parts, origin, "quaternion", log, ("q_BN", 4)))
    stars = _gather(parts, origin, "stars", log, ("both", 6))
    both = stars.pop("both")
    directions = DirectionRows(**stars, star_B=both[:, :3], star_N=both[:, 3:]) if len(both) else None
    gyro = _turn_into_body(gyro, [part.layout.gyro_frame == "base" for part in parts], attitude, log)

    problems = _in_order((*(problem for part in parts for problem in part.table.problems), *log.problems()), names)
    if strict:
        refuse(problems)
    if "gyro" in needs and not len(gyro):
        raise DataError(f"{', '.join(names)}: no usable gyro row; give gyro_x_rad_s, _y_, _z_ or map them in [columns]")
    if "star" in needs and not len(attitude) and directions is None:
        raise DataError(
            f"{', '.join(names)}: no usable attitude or star row; give q_bn_x, _y, _z, _w (or star_b_x ... with "
            "star_n_x ...), in the same table or as a further file, or map them in [columns]"
        )
    return Telemetry(gyro, attitude, directions, problems, _clock_in_words(parts, origin), origin)


def _understand(table: Table, maps: Sequence[ColumnsConfiguration], log: ProblemLog) -> _Part:
    layout = resolve(table.file, list(table.columns), map_for(table.file, maps))
    instants, timed = _times(table, layout, log)
    wanted = [names for names in (layout.gyro, layout.quaternion, layout.star_b + layout.star_n) if names]
    cells = [_cells(table, names, timed, log, combined=len(wanted) > 1) for names in wanted]
    blank = timed & np.logical_and.reduce([empty for _, _, empty in cells])
    log.add(table.file, table.row[blank], "nan", "the row holds a time and no values", "dropped")

    groups: dict[tuple[str, ...], _Group] = {}
    repeats = bool(layout.star_b)  # one row per star: the gyro and attitude beside it stand there once per star
    for names, (values, good, _) in zip(wanted, cells):
        stars = names == layout.star_b + layout.star_n
        if names == layout.quaternion:
            good, values = _unit_length(table, "the quaternion", values, good, log)
            if layout.quaternion_sense == "nb":
                values = values * np.array([-1.0, -1.0, -1.0, 1.0])
        elif stars:
            for part, what in ((slice(0, 3), "star_b"), (slice(3, 6), "star_n")):
                good, values[:, part] = _unit_length(table, f"the direction {what}", values[:, part], good, log)
        else:
            values = values * UNIT_TO_SI[layout.gyro_unit]
        index = np.flatnonzero(good)
        if repeats and not stars:
            index = _without_copies(index, instants, values)
        groups[names] = _Group(*_in_time_order(table, instants, index, values, stars, log))
    part = _Part(
        table,
        layout,
        instants,
        gyro=groups.get(layout.gyro),
        quaternion=groups.get(layout.quaternion),
        stars=groups.get(layout.star_b + layout.star_n),
    )
    if not any(len(group.index) for group in part.groups()):
        first = next(iter(_in_order((*table.problems, *log.problems()), [table.file])), None)
        raise DataError(f"{table.file}: none of its {len(table)} rows is usable; the first: {first}")
    return part


def _times(table: Table, layout: Layout, log: ProblemLog) -> tuple[Instants, np.ndarray]:
    """The time of each row, and which rows have one."""
    texts = table.texts(layout.time) if layout.scale in ("utc", "tai", "gps") else None
    numbers = table.numbers(layout.time)
    numeric = np.isfinite(numbers.value).sum() * 2 > len(table)
    if layout.scale == "utc" and numeric:
        raise DataError(
            f'{table.file}: the time {layout.time!r} is to be UTC, but holds numbers; set clock_scale = "unix" in '
            '[columns] if they are POSIX seconds, "gps", "tai" or "s" if they count otherwise'
        )
    if texts is not None and not numeric:
        instants, good = from_texts(texts, layout.scale)
        absent = np.array([text == "" for text in texts.to_pylist()]) & ~good
    else:
        instants, good = from_numbers(numbers.value * layout.clock_unit_s, layout.scale)
        absent = ~numbers.bad & ~np.isfinite(numbers.value)
    if not good.any():
        sample = next((text for text in table.texts(layout.time).to_pylist() if text), "nothing")
        raise DataError(
            f"{table.file}: no cell of the time {layout.time!r} is a time of scale {layout.scale!r}; one holds "
            f'{sample[:40]!r}. Set clock_scale in [columns]: "utc", "tai" or "gps" for text such as 2015-06-15T12:00:00.5 '
            '(only UTC may end in Z), "s", "unix", "gps" or "tai" for numbers'
        )
    log.add(table.file, table.row[absent], "nan", f"the time {layout.time} is empty or not finite", "dropped")
    unreadable = ~good & ~absent
    cells = table.texts(layout.time).take(np.flatnonzero(unreadable)[:10_000]).to_pylist() if unreadable.any() else []

    def message(i: int) -> str:
        cell = f"{cells[i][:40]!r}" if i < len(cells) else "a cell"
        return f"the time {layout.time} holds {cell}, no time of scale {layout.scale!r}"

    log.add(table.file, table.row[unreadable], "time_unreadable", message, "dropped")
    return instants, good


def _cells(
    table: Table, names: tuple[str, ...], timed: np.ndarray, log: ProblemLog, combined: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values (n, k) of a group of columns, which rows are good, and in which it is absent, for all rows of a table."""
    columns = [table.numbers(name) for name in names]
    values = np.stack([column.value for column in columns], axis=1)
    bad = np.stack([column.bad for column in columns], axis=1)
    empty = np.stack([column.empty for column in columns], axis=1)
    nothing = np.isnan(values) & ~bad
    absent = empty.all(axis=1)
    if combined and (nothing.all(axis=1) & timed).mean() > 0.1:
        absent = nothing.all(axis=1)  # so many are no accident: the writer's way of saying "no measurement here"

    def first(mask: np.ndarray, rows: np.ndarray) -> list[str]:
        return [names[i] for i in np.argmax(mask[rows], axis=1)]

    not_numbers = timed & bad.any(axis=1)
    blamed = first(bad, not_numbers)
    text = "{} holds something that is no number".format
    log.add(table.file, table.row[not_numbers], "not_a_number", lambda i: text(blamed[i]), "dropped")

    not_finite = ~np.isfinite(values)
    undefined = timed & ~absent & ~not_numbers & not_finite.any(axis=1)
    blamed_undefined = first(not_finite, undefined)
    what = np.where(empty[undefined].any(axis=1), "empty", "NaN or infinite")
    log.add(table.file, table.row[undefined], "nan", lambda i: f"{blamed_undefined[i]} is {what[i]}", "dropped")
    return values, timed & ~absent & ~not_numbers & ~undefined, absent


def _unit_length(
    table: Table, what: str, values: np.ndarray, good: np.ndarray, log: ProblemLog
) -> tuple[np.ndarray, np.ndarray]:
    """Which rows stay, and the values made unit vectors."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(values, axis=1)
        off = np.abs(norm - 1.0)
        damaged = good & ~(off <= NORM_TOLERANCE)
        rounded = good & (off > ROUNDING) & ~damaged
        unit = np.where((good & ~damaged)[:, None], values / norm[:, None], values)
    lengths, near = norm[damaged], norm[rounded]
    log.add(
        table.file, table.row[damaged], "non_unit", lambda i: f"{what} has length {lengths[i]:.6g}, not 1", "dropped"
    )
    log.add(table.file, table.row[rounded], "non_unit", lambda i: f"{what} has length {near[i]:.9g}", "normalised")
    return good & ~damaged, unit


def _without_copies(index: np.ndarray, instants: Instants, values: np.ndarray) -> np.ndarray:
    """Of consecutive rows with the same time and values the first."""
    here, before = index[1:], index[:-1]
    same = (instants.day[here] == instants.day[before]) & (instants.second[here] == instants.second[before])
    same &= (values[here] == values[before]).all(axis=1)
    return index[np.concatenate([[True] * (len(index) > 0), ~same]).astype(bool)]


def _in_time_order(
    table: Table, instants: Instants, index: np.ndarray, values: np.ndarray, ties: bool, log: ProblemLog
) -> tuple[np.ndarray, np.ndarray]:
    """Drop the fewest rows that leave time increasing (with `ties`: not decreasing), later ones rather than earlier."""
    if not len(index):
        return index, values[index]
    chosen = instants.select(index)
    time = chosen.since(Origin(int(chosen.day[0]), float(chosen.second[0]), chosen.absolute))
    keep = _longest_increasing(time, ties)
    last_kept = np.maximum.accumulate(np.where(keep, np.arange(len(keep)), -1))
    previous = np.where(last_kept >= 0, time[np.maximum(last_kept, 0)], -np.inf)
    repeated = ~keep & (time == previous)
    backwards = ~keep & ~repeated
    message = "the time is that of the row before"
    log.add(table.file, table.row[index[repeated]], "time_repeated", message, "dropped")
    step = (time - previous)[backwards]

    def out_of_order(i: int) -> str:
        if step[i] > 0.0:
            return "the time jumps ahead of the rows that follow"
        return f"the time goes back by {-step[i]:.6g} s"

    log.add(table.file, table.row[index[backwards]], "time_backwards", out_of_order, "dropped")
    return index[keep], values[index[keep]]


def _longest_increasing(time: np.ndarray, ties: bool) -> np.ndarray:
    """Mask of a longest increasing subsequence (patience sorting from the end, so that earlier rows win ties)."""
    steps = np.diff(time)
    if (steps >= 0.0).all() if ties else (steps > 0.0).all():
        return np.ones(len(time), dtype=bool)
    place = bisect_right if ties else bisect_left
    tails: list[float] = []  # of the subsequences of each length, in -time and from the end, the smallest last element
    at: list[int] = []  # and its index
    before = np.full(len(time), -1)
    for i in range(len(time) - 1, -1, -1):
        length = place(tails, -time[i])
        before[i] = at[length - 1] if length else -1
        if length == len(tails):
            tails.append(-time[i])
            at.append(i)
        else:
            tails[length], at[length] = -time[i], i
    keep = np.zeros(len(time), dtype=bool)
    i = at[-1]
    while i >= 0:
        keep[i] = True
        i = before[i]
    return keep


def _common_origin(parts: Sequence[_Part]) -> Origin:
    """The first time of all usable rows; plain seconds and absolute times do not mix."""
    relative = [part for part in parts if not part.instants.absolute]
    absolute = [part for part in parts if part.instants.absolute]
    if relative and absolute:
        raise DataError(
            f"{relative[0].table.file} counts plain seconds in {relative[0].layout.time!r}, but "
            f"{absolute[0].table.file} has dates or absolute times in {absolute[0].layout.time!r}: how they fit together "
            'is not known. Say in [columns] what the seconds count (clock_scale = "unix", "gps" or "tai"), or choose '
            "a time column that both files have (time = ...)"
        )
    firsts = [
        part.instants.select(group.index).earliest() for part in parts for group in part.groups() if len(group.index)
    ]
    together = Instants(np.array([o.day for o in firsts]), np.array([o.second for o in firsts]), not relative)
    return together.earliest()


def _gather(parts: Sequence[_Part], origin: Origin, kind: str, log: ProblemLog, name: tuple[str, int]) -> dict:
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
        name[0]: np.concatenate([np.empty((0, name[1])), *(group.values for _, _, group in groups)])[order],
    }
    if kind != "stars":  # two files may overlap; the one named first on the command line is believed
        repeated = np.concatenate([[False], np.diff(rows["time"]) == 0.0]).astype(bool)[: len(time)]
        for i in np.unique(rows["file"][repeated]):
            row = rows["row"][repeated & (rows["file"] == i)]
            log.add(files[i], row, "time_repeated", "another file has a row at the same time", "dropped")
        rows = {key: column[~repeated] for key, column in rows.items()}
    return {**rows, "files": files}


def _gyro_rows(parts: Sequence[_Part], origin: Origin, log: ProblemLog) -> GyroRows:
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


def _clock_in_words(parts: Sequence[_Part], origin: Origin) -> str:
    columns = dict.fromkeys(f"{part.layout.time} ({part.layout.scale})" for part in parts)
    return f"seconds since {origin}, from {', '.join(columns)}"
