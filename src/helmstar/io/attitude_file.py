"""What the readers of attitude files (AEM, STK, CK, SCA1A, SCA1B) have in common: bytes in, rows q_BN out."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..errors import DataError
from .cleaning import Part, clean_timed
from .clock import Instants
from .columns import Layout
from .problems import ProblemLog, for_one
from .table import Table, text_lines

_GZIP_MAGIC = b"\x1f\x8b"
Q_BN_COLUMNS = ("q_bn_x", "q_bn_y", "q_bn_z", "q_bn_w")


def read_bytes(path: Path, most: int = -1) -> bytes:
    """Content of a file, or its first `most` bytes, unpacked if it is gzip. Raises OSError, or DataError for bad gzip."""
    with open(path, "rb") as stream:
        if stream.read(2) != _GZIP_MAGIC:
            stream.seek(0)
            return stream.read(most)
    try:
        with gzip.open(path, "rb") as packed:
            return packed.read(most)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: this gzip file is damaged ({error}); copy it again") from error


def read_lines(path: Path) -> list[str]:
    """Lines of a text file, gzip or not; index + 1 is the line number. Raises OSError or DataError."""
    return text_lines(read_bytes(path))


@dataclass(frozen=True)
class AttitudeSamples:
    """Attitudes of one file: row number (n,), times, which rows have a time (n,), q_BN (n, 4) not yet normalised."""

    row: np.ndarray
    instants: Instants
    timed: np.ndarray
    q_BN: np.ndarray


def conjugate(q: np.ndarray) -> np.ndarray:
    """Of quaternions (..., 4), scalar last: q_NB from q_BN."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def attitude_layout(time: str, scale: str) -> Layout:
    """Layout of a table that holds attitudes in native columns; `time` and `scale` are for messages."""
    return Layout(time, scale, 1.0, (), "rad/s", "body", Q_BN_COLUMNS, "bn", (), ())  # names as text, checked there  # type: ignore[arg-type]


def attitude_part(file: str, samples: AttitudeSamples, time: str, scale: str, log: ProblemLog) -> Part:
    """The rows as `clean` gives them: checked for unit length and order of time like those of any table.

    Raises DataError if there is no row, or none that is usable.
    """
    if not len(samples.row):
        because = for_one([problem for problem in log.problems() if problem.file == file])
        raise DataError(f"{file}: there is no attitude in it{because}")
    columns = {name: pa.chunked_array([samples.q_BN[:, i]]) for i, name in enumerate(Q_BN_COLUMNS)}
    table = Table(file=file, columns=columns, row=samples.row)
    return clean_timed(table, attitude_layout(time, scale), samples.instants, samples.timed, log)
