"""CCSDS Attitude Ephemeris Message in keyword = value notation: CCSDS 504.0-B-2 (2024), section 4 and annex F.

The quaternion "from frame A to frame B" turns the axes of A into those of B (annex F2): Q = e sin(phi/2), and
X_B = M_BA X_A with M_BA the transpose of the matrix that scipy makes of [Q1, Q2, Q3, QC]. So with A = N and B = B the file
holds the conjugate of helmstar's q_BN. Version 1.0 (504.0-B-1, 2008) has the same quaternion, and says with ATTITUDE_DIR
(A2B or B2A) and QUATERNION_TYPE (FIRST or LAST: where the scalar stands) what version 2.0 fixes; they are honoured wherever
they stand. Numbers are written with 16 digits, the most that section 6.8.4 allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..errors import DataError
from ..files import write_atomically
from .attitude_file import AttitudeSamples, attitude_part, conjugate, read_lines
from .cleaning import Part
from .clock import TT_MINUS_TAI_S, Instants, Origin, Scale, from_texts
from .problems import ProblemLog
from .settings import INERTIAL, AemConfiguration

VERSION_KEY = "CCSDS_AEM_VERS"
TIME_SYSTEMS: dict[str, Scale] = {"UTC": "utc", "TAI": "tai", "GPS": "gps", "TT": "tai"}
_TYPES = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/ANGVEL": 7, "QUATERNION/RATE": 7}
_EPOCH_DIGITS = 9


def is_aem(head: bytes) -> bool:
    """Whether a file that begins so is an AEM, in keyword or in XML notation."""
    return VERSION_KEY.encode() in head[:4096]


@dataclass
class _Segment:
    """One pair of metadata and data: keywords, and per record its line number, epoch and numbers."""

    line: int
    meta: dict[str, str] = field(default_factory=dict)
    row: list[int] = field(default_factory=list)
    epoch: list[str] = field(default_factory=list)
    q: list[list[float]] = field(default_factory=list)


def read_aem(path: Path, log: ProblemLog) -> Part:
    """Attitudes of all segments of a message. Raises DataError that names the line, OSError."""
    file = str(path)
    lines = read_lines(path)
    if any(line.lstrip().startswith("<") for line in lines[:5]):
        raise DataError(f"{file}: an AEM in XML; give it in keyword = value notation (KVN)")
    segments = list(_segments(file, lines, log))
    if not segments:
        raise DataError(f"{file}: no META_START in it: an AEM needs metadata and data")
    samples = [_samples(file, segment, log) for segment in segments]
    instants = Instants(
        np.concatenate([s.instants.day for s in samples]), np.concatenate([s.instants.second for s in samples]), True
    )
    whole = AttitudeSamples(
        row=np.concatenate([s.row for s in samples]),
        instants=instants,
        timed=np.concatenate([s.timed for s in samples]),
        q_BN=np.concatenate([s.q_BN for s in samples]),
    )
    return attitude_part(file, whole, "EPOCH", segments[0].meta.get("TIME_SYSTEM", "utc").lower(), log)


def segment_gaps(path: Path) -> list[tuple[float, float]]:
    """Begin and end, in s since the first attitude, of what lies between one segment's last attitude and the next one's
    first: nothing is known of the attitude there."""
    log = ProblemLog()
    lines = read_lines(path)
    samples = [_samples(str(path), segment, log) for segment in _segments(str(path), lines, log)]
    times = [s.instants.select(s.timed) for s in samples if s.timed.any()]
    if not times:
        return []
    zero = times[0].select(np.array([0])).earliest()
    ends = [(t.since(zero).min(), t.since(zero).max()) for t in times]
    return [(float(a[1]), float(b[0])) for a, b in pairwise(ends) if b[0] > a[1]]


def _segments(file: str, lines: Sequence[str], log: ProblemLog) -> Iterator[_Segment]:
    """Parse the lines; checks the header and yields each segment when it ends."""
    segment: _Segment | None = None
    in_meta, version = False, None
    width, scalar_first = 0, False
    ragged: list[int] = []
    bad: list[int] = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("COMMENT") or text in ("DATA_START", "DATA_STOP"):
            continue
        if text == "META_START":
            if segment is not None:
                yield segment
            if version is None:
                raise DataError(f"{file}, line {number}: {VERSION_KEY} = 2.0 must stand first")
            segment, in_meta = _Segment(number), True
        elif text == "META_STOP":
            if segment is None or not in_meta:
                raise DataError(f"{file}, line {number}: META_STOP without META_START")
            width, scalar_first = _kind(file, segment)
            in_meta = False
        elif in_meta or segment is None:
            key, equals, value = text.partition("=")
            if not equals:
                where = "metadata" if in_meta else "header"
                raise DataError(f"{file}, line {number}: {text[:60]!r} in the {where} is not KEYWORD = value")
            if in_meta and segment is not None:
                segment.meta[key.strip()] = " ".join(value.split()).upper()
            elif key.strip() == VERSION_KEY:
                version = _version(file, number, value.strip())
        else:
            _record(text, number, width, scalar_first, segment, ragged, bad)
    if in_meta:
        raise DataError(f"{file}: the file ends in metadata, no META_STOP; was it cut off?")
    if segment is not None:
        yield segment
    log.add(file, np.array(ragged, dtype=int), "ragged", "the record has not as many numbers as its type", "dropped")
    log.add(file, np.array(bad, dtype=int), "not_a_number", "the record holds something that is no number", "dropped")


def _version(file: str, line: int, text: str) -> str:
    if text not in ("1.0", "2.0"):
        raise DataError(f"{file}, line {line}: {VERSION_KEY} = {text[:20]} is not read here; 1.0 and 2.0 are")
    return text


def _record(
    text: str, line: int, width: int, scalar_first: bool, segment: _Segment, ragged: list[int], bad: list[int]
) -> None:
    cells = text.split()
    if len(cells) != width + 1:
        ragged.append(line)
        return
    try:
        q = [float(cell) for cell in cells[1:5]]
    except ValueError:
        bad.append(line)
        return
    segment.row.append(line)
    segment.epoch.append(cells[0])
    segment.q.append(q[1:] + q[:1] if scalar_first else q)


def _kind(file: str, segment: _Segment) -> tuple[int, bool]:
    """Number of values in a record, and whether the scalar comes first. Other types than quaternions are refused."""
    kind = segment.meta.get("ATTITUDE_TYPE", "")
    where = f"{file}, metadata from line {segment.line}"
    if kind not in _TYPES:
        raise DataError(
            f"{where}: ATTITUDE_TYPE = {kind[:40] or 'nothing'} is not read; write QUATERNION (of {', '.join(_TYPES)} "
            "the quaternion is used)"
        )
    order = segment.meta.get("QUATERNION_TYPE", "LAST")
    if order not in ("FIRST", "LAST"):
        raise DataError(f"{where}: QUATERNION_TYPE = {order[:20]} must be FIRST or LAST")
    return _TYPES[kind], order == "FIRST"


def _samples(file: str, segment: _Segment, log: ProblemLog) -> AttitudeSamples:
    meta, where = segment.meta, f"{file}, metadata from line {segment.line}"
    system = meta.get("TIME_SYSTEM", "")
    if system not in TIME_SYSTEMS:
        raise DataError(f"{where}: TIME_SYSTEM = {system[:20] or 'nothing'} is not read; {', '.join(TIME_SYSTEMS)} are")
    instants, good = from_texts(pa.array(segment.epoch, type=pa.string()), TIME_SYSTEMS[system])
    if system == "TT":
        instants = Instants(instants.day, instants.second - np.where(good, TT_MINUS_TAI_S, 0.0), True)
    row = np.array(segment.row, dtype=int)
    unreadable = np.flatnonzero(~good)

    def message(i: int) -> str:
        return f"EPOCH holds {segment.epoch[unreadable[i]][:40]!r}, no time of {system}"

    log.add(file, row[unreadable], "time_unreadable", message, "dropped")
    q = np.array(segment.q, dtype=float).reshape(-1, 4)
    return AttitudeSamples(row, instants, good, conjugate(q) if _is_from_N_to_B(where, meta) else q)


def _is_from_N_to_B(where: str, meta: dict[str, str]) -> bool:
    """Whether the quaternions are from the inertial frame to the other one."""
    a, b = meta.get("REF_FRAME_A", ""), meta.get("REF_FRAME_B", "")
    inertial_a, inertial_b = bool(INERTIAL.match(a)), bool(INERTIAL.match(b))
    if inertial_a == inertial_b:
        raise DataError(
            f"{where}: REF_FRAME_A = {a[:30] or 'nothing'}, REF_FRAME_B = {b[:30] or 'nothing'}; one of them has to be "
            "inertial (ICRF, EME2000, J2000 or GCRF) and the other the body"
        )
    direction = meta.get("ATTITUDE_DIR", "A2B")
    if direction not in ("A2B", "B2A"):
        raise DataError(f"{where}: ATTITUDE_DIR = {direction[:20]} must be A2B or B2A")
    return inertial_a == (direction == "A2B")


def write_aem(
    path: Path,
    origin: Origin,
    segments: Sequence[tuple[np.ndarray, np.ndarray]],
    settings: AemConfiguration | None = None,
    comments: Sequence[str] = (),
    created: datetime | None = None,
) -> None:
    """Write version 2.0. `segments`: time (n,) in s since the origin, increasing, and q_BN (n, 4); no reader interpolates
    from one to the next. `comments` go into the header, ASCII. Raises DataError if the origin is not absolute.
    """
    settings = settings or AemConfiguration()
    if not origin.absolute:
        raise DataError(f"{path}: an AEM needs absolute times, and these are seconds of a clock; give time_utc")
    now = (created or datetime.now(UTC)).strftime("%Y-%m-%dT%H:%M:%S")
    lines = [f"{VERSION_KEY} = 2.0", *(f"COMMENT {_ascii(c)}" for c in comments)]
    lines += [f"CREATION_DATE = {now}", f"ORIGINATOR = {settings.originator}", ""]
    for time, q_BN in segments:
        epoch = origin.utc(time, _EPOCH_DIGITS)
        lines += [
            "META_START",
            f"OBJECT_NAME = {settings.object_name}",
            f"OBJECT_ID = {settings.object_id}",
            f"REF_FRAME_A = {settings.ref_frame_a}",
            f"REF_FRAME_B = {settings.ref_frame_b}",
            "TIME_SYSTEM = UTC",
            f"START_TIME = {epoch[0]}",
            f"STOP_TIME = {epoch[-1]}",
            "ATTITUDE_TYPE = QUATERNION",
            "META_STOP",
            "",
            "DATA_START",
        ]
        q = conjugate(q_BN) + 0.0  # the standard knows no -0
        lines += [f"{t} {a:.15e} {b:.15e} {c:.15e} {d:.15e}" for t, (a, b, c, d) in zip(epoch, q.tolist())]
        lines += ["DATA_STOP", ""]
    write_atomically(path, "\n".join(lines))


def _ascii(text: str) -> str:
    return " ".join(text.split()).encode("ascii", "replace").decode()[:240]
