"""CCSDS Orbit Ephemeris Message in keyword = value notation: CCSDS 502.0-B-3 (2023), section 5.

Positions km, velocities km/s, covariances (lower triangle of x, y, z, vx, vy, vz) in km^2, km^2/s and km^2/s^2, one for each
state. Times are UTC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..errors import DataError
from ..files import write_atomically
from .clock import Instants, Origin, from_texts

VERSION_KEY = "CCSDS_OEM_VERS"
_EPOCH_DIGITS = 9


@dataclass(frozen=True)
class Ephemeris:
    """meta: keywords of the segment. instants: of n states. state: (n, 6), m and m/s. covariance: (n, 6, 6), NaN where absent."""

    meta: dict[str, str]
    instants: Instants
    state: np.ndarray
    covariance: np.ndarray


def write_oem(
    path: Path, origin: Origin, time: np.ndarray, state: np.ndarray, covariance: np.ndarray | None = None, *,
    object_name: str = "PROBE", object_id: str = "UNKNOWN", center_name: str = "TARGET", ref_frame: str = "ICRF",
    comments: Sequence[str] = (), created: datetime | None = None,
) -> None:  # fmt: skip
    """Write version 2.0. time: (n,) s since the origin, increasing. state: (n, 6), m and m/s, relative to center_name.

    covariance: (n, 6, 6), m and m/s. Raises DataError if the origin is not absolute or there is no state.
    """
    if not origin.absolute:
        raise DataError(f"{path}: an OEM needs absolute times, and these are seconds of a clock; give time_utc")
    if not len(time):
        raise DataError(f"{path}: there is no state to write")
    epoch = origin.utc(time, _EPOCH_DIGITS)
    now = (created or datetime.now(UTC)).strftime("%Y-%m-%dT%H:%M:%S")
    lines = [f"{VERSION_KEY} = 2.0", *(f"COMMENT {_ascii(c)}" for c in comments)]
    lines += [f"CREATION_DATE = {now}", "ORIGINATOR = HELMSTAR", "", "META_START"]
    lines += [
        f"OBJECT_NAME = {_ascii(object_name)}",
        f"OBJECT_ID = {_ascii(object_id)}",
        f"CENTER_NAME = {_ascii(center_name)}",
    ]
    lines += [
        f"REF_FRAME = {ref_frame}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {epoch[0]}",
        f"STOP_TIME = {epoch[-1]}",
        "META_STOP",
        "",
    ]
    km = 1e-3 * np.asarray(state, float) + 0.0
    lines += [f"{t} " + " ".join(f"{v:.12e}" for v in row) for t, row in zip(epoch, km)]
    if covariance is not None:
        lines += ["", "COVARIANCE_START"]
        for t, C in zip(epoch, 1e-6 * np.asarray(covariance, float) + 0.0):
            lines += [f"EPOCH = {t}", f"COV_REF_FRAME = {ref_frame}"]
            lines += [" ".join(f"{v:.12e}" for v in C[i, : i + 1]) for i in range(6)]
        lines += ["COVARIANCE_STOP"]
    write_atomically(Path(path), "\n".join(lines) + "\n")


def read_oem(path: Path) -> list[Ephemeris]:
    """The segments of a message. Raises DataError that names the line, OSError."""
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    segments: list[tuple[int, dict[str, str], list[tuple[int, list[str]]], list[tuple[int, list[str]]]]] = []
    where, seen = "header", False
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("COMMENT"):
            continue
        if text.startswith("<"):
            raise DataError(f"{path}: an OEM in XML; give it in keyword = value notation (KVN)")
        if text in ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"):
            if text == "META_START":
                segments.append((number, {}, [], []))
            elif not segments:
                raise DataError(f"{path}, line {number}: {text} without META_START")
            where = {"META_START": "meta", "COVARIANCE_START": "covariance"}.get(text, "data")
            continue
        if where == "header":
            seen = seen or text.startswith(VERSION_KEY)
        elif where == "meta":
            key, equals, value = text.partition("=")
            if not equals:
                raise DataError(f"{path}, line {number}: {text[:60]!r} in the metadata is not KEYWORD = value")
            segments[-1][1][key.strip()] = " ".join(value.split()).upper()
        elif where == "covariance":
            segments[-1][3].append((number, text.replace("=", " = ").split()))
        else:
            segments[-1][2].append((number, text.split()))
    if not seen or not segments:
        raise DataError(f"{path}: is no OEM: {VERSION_KEY} and META_START are needed")
    return [_segment(path, *s) for s in segments]


def _segment(
    path: Path, line: int, meta: dict[str, str], rows: list[tuple[int, list[str]]], cov: list[tuple[int, list[str]]]
) -> Ephemeris:
    if meta.get("TIME_SYSTEM") != "UTC":
        raise DataError(
            f"{path}, metadata from line {line}: TIME_SYSTEM = {meta.get('TIME_SYSTEM')} is not read; UTC is"
        )
    state = np.full((len(rows), 6), np.nan)
    for k, (number, cells) in enumerate(rows):
        if len(cells) not in (7, 10):
            raise DataError(f"{path}, line {number}: a state has an epoch and 6 numbers (or 9), not {len(cells) - 1}")
        state[k] = [_number(path, number, c) for c in cells[1:7]]
    instants = _epochs(path, rows, [cells[0] for _, cells in rows])
    covariance = np.full((len(rows), 6, 6), np.nan)
    at: dict[str, int] = {cells[0]: k for k, (_, cells) in enumerate(rows)}
    now, done = None, 0
    for number, cells in cov:
        if cells[:2] == ["EPOCH", "="]:
            now, done = at.get(cells[2]) if len(cells) > 2 else None, 0
        elif "=" not in cells and now is not None:
            if len(cells) != done + 1 or done > 5:
                raise DataError(f"{path}, line {number}: row {done + 1} of a covariance must have {done + 1} numbers")
            values = [1e6 * _number(path, number, c) for c in cells]
            covariance[now, done, : done + 1] = values
            covariance[now, : done + 1, done] = values
            done += 1
    return Ephemeris(meta, instants, 1e3 * state, covariance)


def _epochs(path: Path, rows: list[tuple[int, list[str]]], texts: list[str]) -> Instants:
    instants, good = from_texts(pa.array(texts, pa.string()), "utc")
    if not bool(np.all(good)):
        k = int(np.flatnonzero(~good)[0])
        raise DataError(f"{path}, line {rows[k][0]}: {texts[k][:40]!r} is no UTC time")
    return instants


def _number(path: Path, line: int, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise DataError(f"{path}, line {line}: {text[:30]!r} is no number") from None


def _ascii(text: str) -> str:
    return " ".join(text.split()).encode("ascii", "replace").decode()[:240]


__all__ = ["Ephemeris", "read_oem", "write_oem"]
