"""One table of telemetry made usable: good rows in SI units, unit length and time order; the others noted."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import DataError
from .clock import Instants, from_numbers, from_texts
from .columns import UNIT_TO_SI, ColumnsConfiguration, Layout, map_for, resolve
from .problems import ProblemLog
from .table import Table

NORM_TOLERANCE = 1e-3  # a quaternion or direction farther from length 1 is damaged, not rounded
ROUNDING = 1e-6  # a norm this close to 1 is the rounding of printed digits, not worth a word
LARGEST = 1e12  # no rate, quaternion or direction is larger in any unit; sums of squares stay finite
SAME_TIME_S = 1e-9
NAN_IS_ABSENT = 0.1  # a table with more rows than this without one of its measurements writes NaN for "none"


@dataclass(frozen=True)
class Group:
    """The good rows of one kind, in time order: `index` into the table's rows, `values` (n, k) as `Part` says.

    `step` (n,) is the time in s since the row before that was to hold such values, good or bad; NaN for the first.
    """

    index: np.ndarray
    values: np.ndarray
    step: np.ndarray


@dataclass(frozen=True)
class Part:
    """One table, understood. Values: gyro (n, 3) rad/s or rad in the table's axes, quaternion (n, 4) unit q_BN,
    stars (n, 6) unit direction in body and in inertial axes; None where the table has no such columns. `map` is the one of
    [columns] that named them.
    """

    table: Table
    layout: Layout
    instants: Instants
    gyro: Group | None
    quaternion: Group | None
    stars: Group | None
    map: ColumnsConfiguration | None = None

    def groups(self) -> list[Group]:
        """Those it has."""
        return [group for group in (self.gyro, self.quaternion, self.stars) if group is not None]


def clean(table: Table, maps: Sequence[ColumnsConfiguration], log: ProblemLog) -> Part:
    """Understand a table's columns by `maps` or native names, and note every bad row in `log`."""
    given = map_for(table.file, maps)
    layout = resolve(table.file, list(table.columns), given)
    instants, timed = _times(table, layout, log)
    return replace(clean_timed(table, layout, instants, timed, log), map=given)


def clean_timed(table: Table, layout: Layout, instants: Instants, timed: np.ndarray, log: ProblemLog) -> Part:
    """A table whose columns and times are known, with the rows (a mask) that have a time; notes bad rows in `log`."""
    timed = _in_time_order(table, instants, timed, log)
    star = layout.star_b + layout.star_n
    wanted = [names for names in (layout.gyro, layout.quaternion, star) if names]
    cells = {names: _cells(table, names, timed, log, combined=len(wanted) > 1) for names in wanted}
    blank = timed & np.logical_and.reduce([absent for _, _, absent in cells.values()])
    log.add(table.file, table.row[blank], "nan", "the row holds a time and no values", "dropped")

    def group(names: tuple[str, ...]) -> Group | None:
        if not names:
            return None
        values, good, absent = cells[names]
        if names == layout.gyro:
            values = values * UNIT_TO_SI[layout.gyro_unit]
        elif names == layout.quaternion:
            values, good = _unit_length(table, "the quaternion", values, good, log)
            values = values if layout.quaternion_sense == "bn" else values * np.array([-1.0, -1.0, -1.0, 1.0])
        else:
            star_b, good = _unit_length(table, "the star's direction in body axes", values[:, :3], good, log)
            star_n, good = _unit_length(table, "the star's direction in inertial axes", values[:, 3:], good, log)
            values = np.hstack([star_b, star_n])
        index = np.flatnonzero(good)
        if names != star:
            index = _once_per_time(table, instants, index, values, bool(star), log)
        written = np.flatnonzero(timed & ~absent)
        step = np.full(len(table), np.nan)
        step[written[1:]] = np.diff(instants.select(written).seconds())
        return Group(index, values[index], step[index])

    part = Part(table, layout, instants, group(layout.gyro), group(layout.quaternion), group(star))
    if not any(len(group.index) for group in part.groups()):
        problems = [problem for problem in (*table.problems, *log.problems()) if problem.file == table.file]
        raise DataError(f"{table.file}: none of its {len(table)} rows is usable; for one, {problems[0]}")
    return part


def _times(table: Table, layout: Layout, log: ProblemLog) -> tuple[Instants, np.ndarray]:
    """The time of each row, and which rows have one."""
    if table.is_duration(layout.time) and layout.clock_unit_s != 1.0:
        raise DataError(
            f"{table.file}: the time {layout.time!r} is of a type that knows its unit (durations); leave out clock_unit_s"
        )
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
            f'{sample[:40]!r}. Set clock_scale in [columns]: "utc", "tai" or "gps" for text such as '
            '2015-06-15T12:00:00.5 (only UTC may end in Z), "s", "unix", "gps" or "tai" for numbers'
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
    absent = np.asarray(empty.all(axis=1))
    if combined and (nothing.all(axis=1) & timed).mean() > NAN_IS_ABSENT:
        absent = np.asarray(
            nothing.all(axis=1)
        )  # so many are no accident: the writer's way of saying "no measurement here"

    def first(mask: np.ndarray, rows: np.ndarray) -> list[str]:
        return [names[i] for i in np.argmax(mask[rows], axis=1)]

    not_numbers = timed & bad.any(axis=1)
    blamed = first(bad, not_numbers)
    text = "{} holds something that is no number".format
    log.add(table.file, table.row[not_numbers], "not_a_number", lambda i: text(blamed[i]), "dropped")

    not_finite = ~(np.abs(values) <= LARGEST)
    undefined = timed & ~absent & ~not_numbers & not_finite.any(axis=1)
    blamed_undefined = first(not_finite, undefined)
    what = np.where(empty[undefined].any(axis=1), "empty", "NaN, infinite or beyond 1e12")
    log.add(table.file, table.row[undefined], "nan", lambda i: f"{blamed_undefined[i]} is {what[i]}", "dropped")
    return values, timed & ~absent & ~not_numbers & ~undefined, absent


def _unit_length(
    table: Table, what: str, values: np.ndarray, good: np.ndarray, log: ProblemLog
) -> tuple[np.ndarray, np.ndarray]:
    """The values made unit vectors, and which rows stay."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
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
    return unit, good & ~damaged


def _in_time_order(table: Table, instants: Instants, timed: np.ndarray, log: ProblemLog) -> np.ndarray:
    """Of the rows with a time drop the fewest that leave it never going back; later ones rather than earlier."""
    index = np.flatnonzero(timed)
    time = instants.select(index).seconds()
    keep = longest_without_decrease(time)
    kept_so_far = np.maximum.accumulate(np.where(keep, np.arange(len(keep)), -1))
    step = np.where(kept_so_far >= 0, time - time[kept_so_far], np.inf)[~keep]

    def message(i: int) -> str:
        ahead = "the time jumps ahead of the rows that follow"
        return ahead if step[i] > 0.0 else f"the time goes back by {-step[i]:.6g} s"

    log.add(table.file, table.row[index[~keep]], "time_backwards", message, "dropped")
    stays = timed.copy()
    stays[index[~keep]] = False
    return stays


def longest_without_decrease(time: np.ndarray) -> np.ndarray:
    """Mask of a longest non-decreasing subsequence (patience sorting from the end, so that earlier rows win ties)."""
    if (np.diff(time) >= 0.0).all():
        return np.ones(len(time), dtype=bool)
    tails: list[float] = []  # of the subsequences of each length, in -time and from the end, the smallest last element
    at: list[int] = []  # and its index
    before = np.full(len(time), -1)
    for i in range(len(time) - 1, -1, -1):
        length = bisect_right(tails, -time[i])
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


def _once_per_time(
    table: Table, instants: Instants, index: np.ndarray, values: np.ndarray, stars: bool, log: ProblemLog
) -> np.ndarray:
    """Of rows with equal time the first. Beside `stars`, one per row, copies of the same values are no fault."""
    here, before = index[1:], index[:-1]
    repeated = np.diff(instants.select(index).seconds()) < SAME_TIME_S
    faults = repeated & ~(values[here] == values[before]).all(axis=1) if stars else repeated
    message = "the time is that of the row before"
    log.add(table.file, table.row[here[faults]], "time_repeated", message, "dropped")
    return np.concatenate([index[:1], here[~repeated]])
