"""One table from a CSV or Parquet file, every row known by its number in the file.

A CSV may be separated by comma, semicolon, tab or blanks, have `#` comments, blank lines, a byte order mark and quoted
cells; lines with a wrong number of cells become problems. The header is the first line that is no comment, or the last
comment before it if that line holds numbers (as numpy.savetxt writes). A cell is text until `numbers` asks for it.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from pyarrow import csv as arrow_csv
from pyarrow import parquet

from ..errors import DataError
from .problems import Problem, ProblemLog

pc: Any = pyarrow.compute  # makes its functions when imported, which no type checker sees

_PARQUET_MAGIC = b"PAR1"
_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # in a second, of a duration's unit
_BLANKS = " "  # stands for any run of blanks


@dataclass(frozen=True)
class Numbers:
    """A column as numbers: `value` is NaN where the cell is empty (absent) or bad (not a number)."""

    value: np.ndarray
    empty: np.ndarray
    bad: np.ndarray


@dataclass(frozen=True)
class Table:
    """Columns by name, in file order; `row` (n,) the line number in a CSV, the data row number in Parquet, from 1."""

    file: str
    columns: dict[str, pa.ChunkedArray]
    row: np.ndarray
    problems: tuple[Problem, ...] = ()
    repeated_names: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.row)

    def column(self, name: str) -> pa.ChunkedArray:
        """The cells of a column; a name that the header has twice is refused."""
        if name in self.repeated_names:
            raise DataError(f"{self.file}: the header has the column {name!r} more than once; rename one of them")
        return self.columns[name]

    def texts(self, name: str) -> pa.ChunkedArray:
        """The cells of a column as trimmed strings, "" where absent. Parquet timestamps become ISO 8601."""
        cells = self.column(name)
        try:
            cells = pc.cast(cells, pa.string())
        except pa.ArrowException as error:
            raise DataError(f"{self.file}: column {name!r} holds {cells.type}, neither text nor times") from error
        return pc.fill_null(pc.utf8_trim_whitespace(cells), "")

    def is_duration(self, name: str) -> bool:
        """Whether a Parquet column holds durations, which `numbers` gives in s."""
        return pa.types.is_duration(self.column(name).type)

    def numbers(self, name: str) -> Numbers:
        """The cells of a column as float64; durations in s."""
        cells = self.column(name)
        if self.is_duration(name):
            ticks = pc.cast(cells, pa.int64())
            value = _to_numpy(pc.cast(ticks, pa.float64(), safe=False)) / _TICKS[cells.type.unit]
            return Numbers(value, _to_numpy(pc.is_null(cells)), np.zeros(len(self), bool))
        if pa.types.is_floating(cells.type) or pa.types.is_integer(cells.type) or pa.types.is_decimal(cells.type):
            value = pc.cast(cells, pa.float64(), safe=False)
            return Numbers(_to_numpy(value), _to_numpy(pc.is_null(value)), np.zeros(len(self), bool))
        texts = self.texts(name)
        empty = pc.equal(texts, "")
        try:
            value = _to_numpy(pc.cast(pc.if_else(empty, pa.scalar(None, pa.string()), texts), pa.float64()))
            return Numbers(value, _to_numpy(empty), np.zeros(len(self), bool))
        except pa.ArrowInvalid:  # at least one cell is no plain number: find out which
            parsed = [_number(text) for text in texts.to_pylist()]
        value = np.array([np.nan if x is None else x for x in parsed], dtype=float)
        absent = _to_numpy(empty)
        return Numbers(value, absent, np.array([x is None for x in parsed], dtype=bool) & ~absent)


def read_table(file: Path, max_problems: int = 1000) -> Table:
    """Read a CSV or Parquet file, whichever its content says it is. Anything unusable raises a DataError."""
    try:
        with open(file, "rb") as stream:
            is_parquet = stream.read(4) == _PARQUET_MAGIC
        if is_parquet or Path(file).suffix.lower() in (".parquet", ".pq"):
            return _read_parquet(Path(file))
        content = Path(file).read_bytes()
    except FileNotFoundError:
        raise DataError(f"{file}: there is no such file") from None
    except IsADirectoryError:
        raise DataError(f"{file}: this is a folder; give the CSV or Parquet files in it") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    return _read_csv(str(file), content, max_problems)


def _read_parquet(file: Path) -> Table:
    try:
        with open(file, "rb") as stream:  # the library opens no name that is not UTF-8
            content = parquet.ParquetFile(stream).read()
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        reason = str(error).split("\n")[0]
        raise DataError(f"{file}: this Parquet file is empty or damaged ({reason}); write it again") from error
    if content.num_rows == 0:
        raise DataError(f"{file}: the table has no rows")
    names = [str(name) for name in content.column_names]
    return Table(
        file=str(file),
        columns=dict(zip(names, content.columns)),
        row=np.arange(1, content.num_rows + 1),
        repeated_names=frozenset(name for name in names if names.count(name) > 1),
    )


def _read_csv(file: str, content: bytes, max_problems: int) -> Table:
    lines = text_lines(content)
    first = next((i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if first is None:
        empty = "the file is empty" if not content.strip() else "the file has nothing but comments and blank lines"
        raise DataError(f"{file}: {empty}; a header line with the column names and one line per sample are needed")
    header, first_row = _header(file, lines, first)
    separator = max(",;\t", key=header.count) if any(s in header for s in ",;\t") else _BLANKS
    names = _names(_cells(header, separator) or [""])
    kept, row, ragged = _rows(lines, first_row, separator, len(names))

    log = ProblemLog(max_problems)
    message = f"the line does not have the {len(names)} cells of the header"
    log.add(file, np.array(ragged, dtype=int), "ragged", message, "dropped")
    if not kept:
        what = "no line has the number of cells of the header" if ragged else "there is a header, but no row below it"
        raise DataError(f"{file}: {what}")
    return Table(
        file=file,
        columns=_parse(file, kept, separator, len(names), names),
        row=np.array(row, dtype=int),
        problems=log.problems(),
        repeated_names=frozenset(name for name in names if names.count(name) > 1),
    )


def text_lines(content: bytes) -> list[str]:
    """Text lines, so that index + 1 is the line number an editor shows. Undecodable bytes become U+FFFD."""
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = content.decode(encoding, errors="replace").replace("\r\n", "\n")
    return text.replace("\r", " " if "\n" in text else "\n").split("\n")


def _header(file: str, lines: list[str], first: int) -> tuple[str, int]:
    """The header line and the index of the first line after it."""
    header = lines[first]
    if not header.replace("\t", " ").isprintable() or "\ufffd" in header:
        raise DataError(f"{file}: this is neither a text table nor Parquet; give CSV (not compressed) or Parquet")
    if all(_number(cell) is not None for cell in header.replace(",", " ").replace(";", " ").split()):
        comments = [line.lstrip().lstrip("#").strip() for line in lines[:first] if line.lstrip().startswith("#")]
        if not comments:
            raise DataError(
                f"{file}: line {first + 1} holds numbers where the column names should be; "
                "write a header line above it, such as time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
            )
        return comments[-1], first
    return header, first + 1


def _rows(lines: list[str], start: int, separator: str, width: int) -> tuple[list[str], list[int], list[int]]:
    """The usable lines, their line numbers, and the line numbers of ragged ones."""
    kept, row, ragged = [], [], []
    for number, line in enumerate(lines[start:], start + 1):
        if line.count(separator) != width - 1 or '"' in line or separator == _BLANKS or "#" in line or width == 1:
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = _cells(line, separator) or []
            if len(cells) == width + 1 and not cells[-1]:
                del cells[-1]  # one separator too many at the end is a habit of some writers, not damage
            if len(cells) != width:
                ragged.append(number)
                continue
            line = separator.join(cells)
        kept.append(line)
        row.append(number)
    return kept, row, ragged


def _cells(line: str, separator: str) -> list[str] | None:
    """The cells of a line, free of quotes and separators; None if its quotes do not match."""
    if separator == _BLANKS:
        return line.replace('"', "").split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    if line.count('"') % 2:
        return None
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return None
    return [cell.replace(separator, " ").replace('"', "'").strip() for cell in cells]


def _names(cells: list[str]) -> list[str]:
    """Column names; an empty one is named by its position, and a line's last empty one is no column."""
    if len(cells) > 1 and not cells[-1]:
        cells = cells[:-1]
    return [cell or f"column {i}" for i, cell in enumerate(cells, 1)]


def _parse(file: str, lines: list[str], separator: str, width: int, names: list[str]) -> dict[str, pa.ChunkedArray]:
    positions = [str(i) for i in range(width)]
    try:
        content = arrow_csv.read_csv(
            io.BytesIO("\n".join(lines).encode()),
            read_options=arrow_csv.ReadOptions(column_names=positions, block_size=1 << 26),
            parse_options=arrow_csv.ParseOptions(delimiter=separator, quote_char=False, ignore_empty_lines=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(positions, pa.string()), strings_can_be_null=False
            ),
        )
    except (pa.ArrowException, ValueError) as error:
        raise DataError(f"{file}: the table cannot be read: {error}") from error
    return {name: content.column(i) for i, name in enumerate(names)}


def _number(text: str) -> float | None:
    """The number a cell holds, Fortran's 1.0D-3 included; None if it holds none."""
    try:
        return None if "_" in text else float(text.replace("D", "e").replace("d", "e"))
    except ValueError:
        return None


def _to_numpy(cells: pa.ChunkedArray | pa.Array) -> np.ndarray:
    return np.array(cells.to_numpy(zero_copy_only=False) if isinstance(cells, pa.Array) else cells.to_numpy())
