"""The structure of SPICE's Double Precision Array Files (DAF Required Reading): their segments, checked.

A DAF is a sequence of records of 128 doubles. The first one names the format and points to a doubly linked list of summary
records; a summary of a CK has 2 doubles and 6 integers, the last two being the first and last address of the segment's data
in doubles from 1 on. CSPICE trusts all of this, down to a crash where a file is damaged, so it is looked at here first.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DataError

RECORD = 1024  # bytes
_ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}
_CK_ID_WORDS = (b"DAF/CK", b"NAIF/DAF")


@dataclass(frozen=True)
class CkSegmentSummary:
    """One segment: object, reference frame's id, type, whether it has rates, span in ticks, addresses of its data."""

    instrument: int
    frame: int
    kind: int
    rates: bool
    start: float
    stop: float
    first: int
    last: int


@dataclass(frozen=True)
class CkFile:
    """A binary CK in memory: its doubles (address a is `words[a - 1]`) and its segments."""

    file: str
    words: np.ndarray
    segments: tuple[CkSegmentSummary, ...]

    def data(self, segment: CkSegmentSummary) -> np.ndarray:
        """The doubles of a segment."""
        return self.words[segment.first - 1 : segment.last]


def read_daf(path: Path) -> CkFile:
    """Structure and content of a binary CK. Raises DataError where it is none or damaged, OSError."""
    content = path.read_bytes()
    file = str(path)
    if content.startswith((b"DAFETF", b"'DAFETF")):
        raise DataError(f"{file}: a SPICE transfer file; make it binary with NAIF's tobin")
    if content[:8].rstrip(b" \x00") not in _CK_ID_WORDS or len(content) < RECORD:
        raise DataError(f"{file}: not a binary SPICE CK, which begins with DAF/CK")
    order = _ORDERS.get(content[88:96])
    if order is None:
        raise DataError(
            f"{file}: the numbers of this CK are in the format {content[88:96]!r}; make it anew with NAIF's tools"
        )
    doubles, integers, forward = (
        *struct.unpack(f"{order}2i", content[8:16]),
        *struct.unpack(f"{order}i", content[76:80]),
    )
    if (doubles, integers) != (2, 6):
        raise DataError(f"{file}: a DAF whose summaries are not those of a CK")
    words = np.frombuffer(content[: len(content) // 8 * 8], dtype=f"{order}f8").astype(float)
    return CkFile(file, words, tuple(_summaries(file, content, words, forward, order)))


def _summaries(file: str, content: bytes, words: np.ndarray, record: int, order: str) -> Iterator[CkSegmentSummary]:
    damaged = DataError(f"{file}: this CK points outside of itself; it is damaged or cut off, copy it again")
    visited: set[int] = set()
    while record:
        begin = 128 * (record - 1)
        if record in visited or record < 2 or begin + 128 > len(words):
            raise damaged
        visited.add(record)
        following, count = words[begin], words[begin + 2]
        if not (0 <= count <= 25 and 0 <= following <= len(words)):
            raise damaged
        for i in range(int(count)):
            place = begin + 3 + 5 * i
            integers = struct.unpack(f"{order}6i", content[8 * (place + 2) : 8 * (place + 5)])
            instrument, frame, kind, rates, first, last = integers
            if not (0 < first <= last <= len(words)):
                raise damaged
            yield CkSegmentSummary(
                instrument, frame, kind, bool(rates), float(words[place]), float(words[place + 1]), first, last
            )
        record = int(following)
