"""STK attitude file (.a): the quaternion formats of the help's "Attitude File Format".

Keywords are not case sensitive and stand between BEGIN Attitude and END Attitude (which STK itself leaves out at times); the
records follow the format's name, each with seconds since ScenarioEpoch, which is UTC. STK's quaternion is "from the
reference axes to the body frame; if n and A are the axis and angle of rotation", q_i = n_i sin(A/2), q_4 = cos(A/2): the
rotation of the axes, so the conjugate of helmstar's q_BN, as in a CCSDS AEM.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..errors import DataError
from .attitude_file import AttitudeSamples, attitude_part, conjugate, read_lines
from .cleaning import Part
from .clock import Instants, from_texts
from .problems import ProblemLog

_FORMATS = {"attitudetimequaternions": 4, "attitudetimequatscalarfirst": 4, "attitudetimequatangvels": 7}
_AXES = ("icrf", "j2000")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_EPOCH = re.compile(r"^(\d{1,2})\s+([A-Za-z]{3})[a-z]*\s+(\d{4})\s+(\d{1,2}):(\d\d:\d\d(?:\.\d*)?)$")


def is_stk(head: bytes) -> bool:
    """Whether a file that begins so is an STK attitude file."""
    start = head[:65536].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    return start.startswith(b"stk.v.") and re.search(rb"begin\s+attitude", start) is not None


def read_stk(path: Path, log: ProblemLog) -> Part:
    """Attitudes of an STK attitude file. Raises DataError that names the line, OSError."""
    file = str(path)
    lines = read_lines(path)
    keywords, kind, start = _head(file, lines)
    axes = keywords.get("coordinateaxes", "nothing")
    if axes.lower() not in _AXES:
        raise DataError(f"{file}: CoordinateAxes = {axes[:40]}; only inertial axes are read, ICRF or J2000")
    if (given := keywords.get("timeformat", "EpSec")).lower() != "epsec":
        raise DataError(f"{file}: TimeFormat = {given[:20]}; only EpSec, seconds since ScenarioEpoch, is read")
    epoch = _scenario_epoch(file, keywords.get("scenarioepoch", ""))

    width = _FORMATS[kind]
    row, numbers, ragged, bad = [], [], [], []
    for number, line in enumerate(lines[start:], start + 1):
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        if cells[0].lower() == "end":
            break
        if len(cells) != width + 1:
            ragged.append(number)
            continue
        try:
            numbers.append([float(cell) for cell in cells[:5]])
            row.append(number)
        except ValueError:
            bad.append(number)
    log.add(file, np.array(ragged, dtype=int), "ragged", f"the record has not {width + 1} numbers", "dropped")
    log.add(file, np.array(bad, dtype=int), "not_a_number", "the record holds something that is no number", "dropped")
    content = np.array(numbers, dtype=float).reshape(-1, 5)
    timed = np.abs(content[:, 0]) < 1e11
    log.add(file, np.array(row, dtype=int)[~timed], "time_unreadable", "the time is not finite or absurd", "dropped")
    q = content[:, 1:]
    if kind == "attitudetimequatscalarfirst":
        q = q[:, [1, 2, 3, 0]]
    instants = Instants(
        np.full(len(row), epoch.day[0]), epoch.second[0] + np.where(timed, content[:, 0], 0.0), absolute=True
    )
    samples = AttitudeSamples(np.array(row, dtype=int), instants, timed, conjugate(q))
    return attitude_part(file, samples, "time since ScenarioEpoch", "utc", log)


def _head(file: str, lines: list[str]) -> tuple[dict[str, str], str, int]:
    """Keywords in lower case with their values, the format, and the index of the first line after its name."""
    keywords: dict[str, str] = {}
    begun = False
    for index, line in enumerate(lines):
        words = line.strip().split(None, 1)
        if not words or words[0].startswith("#"):
            continue
        key, value = words[0].lower(), words[1].strip() if len(words) > 1 else ""
        if key == "begin":
            begun = begun or value.lower() == "attitude"
        elif key in _FORMATS and begun:
            return keywords, key, index + 1
        elif key.startswith("attitudetime"):
            raise DataError(
                f"{file}, line {index + 1}: the format {words[0][:40]} is not read; AttitudeTimeQuaternions, "
                "AttitudeTimeQuatScalarFirst and AttitudeTimeQuatAngVels are"
            )
        else:
            keywords[key] = value
    what = "no line such as AttitudeTimeQuaternions" if begun else "no BEGIN Attitude"
    raise DataError(f"{file}: {what} in it; an STK attitude file (.a) with quaternions is needed")


def _scenario_epoch(file: str, text: str) -> Instants:
    """The instant of a date such as 1 Jan 2025 16:00:00.000, UTC."""
    found = _EPOCH.match(text)
    if found and found[2].lower() in _MONTHS:
        day, month, year = int(found[1]), _MONTHS.index(found[2].lower()) + 1, int(found[3])
        iso = f"{year:04d}-{month:02d}-{day:02d}T{int(found[4]):02d}:{found[5]}"
        instants, good = from_texts(pa.array([iso]), "utc")
        if good[0]:
            return instants
    raise DataError(f"{file}: ScenarioEpoch = {text[:40] or 'nothing'} is no UTC date such as 1 Jan 2025 16:00:00.000")
