"""What was wrong in a data file, where, and what was done about it: one `Problem` per bad row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..errors import DataError

Kind = Literal[
    "nan", "not_a_number", "ragged", "non_unit", "time_unreadable", "time_backwards", "time_repeated", "frame", "too_fast",
    "jump", "unit", "flagged", "unused", "early", "no_gyro", "unsolved",
]  # fmt: skip
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Problem:
    """One bad row of a file. `row` is the line number in a CSV (1-based), the data row (1-based) in Parquet.

    kind: one of `KINDS`; docs/telemetry.md says what each means. action: "dropped", "normalised", "converted" or "used, its
    sigma enlarged" (an attitude that the gate refused too often); "used" and "not used" are of good rows. `rows` is how
    many rows it stands for: 1, or more where a file has so many of a kind that the rest are summed up, or where a whole
    range is concerned.
    """

    file: str
    row: int
    kind: Kind
    message: str
    action: str
    rows: int = 1

    def __str__(self) -> str:
        return f"{self.file}, row {self.row}: {self.message} ({self.action})"


class ProblemLog:
    """Collects problems, each row of a file once per kind; of a file, kind and action the first `limit` are named."""

    def __init__(self, limit: int = 1000) -> None:
        self._limit = limit
        self._named: list[Problem] = []
        self._rows: dict[tuple[str, Kind, str], np.ndarray] = {}

    def add(self, file: str, row: np.ndarray, kind: Kind, message: str | Callable[[int], str], action: str) -> None:
        """Note the rows with these numbers; `message` may be a function of the index into `row`."""
        key = (file, kind, action)
        known = self._rows.get(key, np.empty(0, dtype=np.int64))
        new = np.flatnonzero(~np.isin(row, known))
        self._rows[key] = np.concatenate([known, row[new]])
        for i in new[: max(self._limit - len(known), 0)].tolist():
            text = message if isinstance(message, str) else message(i)
            self._named.append(Problem(file, int(row[i]), kind, text, action))

    def problems(self) -> tuple[Problem, ...]:
        """All of them, by file in the order of first appearance, then by row."""
        everything = list(self._named)
        for (file, kind, action), rows in self._rows.items():
            if len(rest := rows[self._limit :]):
                message = f"{len(rest)} more rows like this ({kind}) up to row {rest.max()}"
                everything.append(Problem(file, int(rest.min()), kind, message, action, len(rest)))
        order = {file: i for i, file in enumerate(dict.fromkeys(problem.file for problem in everything))}
        return tuple(sorted(everything, key=lambda problem: (order[problem.file], problem.row)))


NO_FAULT = ("used", "not used")
"""Actions on rows that are worth a word and still good, so that strict reading lets them pass."""


def for_one(problems: Sequence[Problem]) -> str:
    """The first problem with a dropped row as the end of a message, or nothing."""
    bad = [problem for problem in problems if problem.action == "dropped"]
    return f"; for one, {bad[0]}" if bad else ""


def refuse(problems: Sequence[Problem], show: int = 5) -> None:
    """Raise a DataError that lists the first few problems with bad rows, if there are any: what `--strict` does."""
    problems = [problem for problem in problems if problem.action not in NO_FAULT]
    if problems:
        total = sum(problem.rows for problem in problems)
        lines = [f"  {problem}" for problem in problems[:show]]
        more = [f"  ... and {len(problems) - show} more"] if len(problems) > show else []
        what = f"{total} bad row{'s' if total > 1 else ''}, and strict reading allows none"
        remedy = "mend the file, or read it without --strict: bad rows are then handled as said in brackets"
        raise DataError("\n".join([*lines, *more, f"{what}; {remedy}"]))
