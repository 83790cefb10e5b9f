"""A folder of frames with times, solved one after the other: lost in space first, tracking after.

Times come from frames.csv in the folder (columns file and time_s, time_utc or another of the native times), or else from the frames
themselves: FITS DATE-AVG, or DATE-OBS plus half of EXPTIME; EXIF DateTimeOriginal. They are those of mid-exposure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ..errors import DataError
from ..files import readable
from ..io.clock import Instants, Scale, from_numbers, from_texts
from ..io.columns import NATIVE_TIME
from ..io.images import read_image
from ..io.problems import Problem
from ..io.table import read_table
from ..progress import Progress
from ..sensors.star_tracker import StarTracker
from .command import REASON, SolveOptions, entry_of, tracker_of
from .dates import check_date, julian_date_tt

TABLE = "frames.csv"
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".fits", ".fit")
_EXIF, _ORIGINAL, _SUBSECOND, _OFFSET = 0x8769, 0x9003, 0x9291, 0x9011
PREDICTED = 0.1
"""1 sigma of a predicted turn, relative to the turn since the last solved frame: a rate that changes."""
STALE_S = 43200.0
"""The Earth's velocity turns by half a degree in this time, which moves stars by 0.2 arcsec."""


@dataclass(frozen=True)
class Frames:
    """Image files (n) with the instants of mid-exposure, in order of time; row (n,) in the table `source`, or the place
    among the folder's images. problems: files that are left out."""

    source: str
    files: tuple[Path, ...]
    instants: Instants
    row: np.ndarray
    problems: tuple[Problem, ...]


@dataclass(frozen=True)
class SolvedFrames:
    """Attitudes of frames: instants and row (n,) of those that are solved, q_SN (n, 4), covariance_S (n, 3, 3) in rad^2, error on
    the left in S. entries: of every frame, as `helmstar solve --json` says it, with time_s after the first. problems:
    frames that are not solved, and why."""

    source: str
    instants: Instants
    row: np.ndarray
    q_SN: np.ndarray
    covariance_S: np.ndarray
    entries: tuple[dict[str, Any], ...]
    problems: tuple[Problem, ...]


def find_frames(folder: Path) -> Frames:
    """The frames of a folder and their times. Raises DataError where there is none, or none has a time."""
    table = folder / TABLE
    frames = _listed(table) if table.exists() else _dated(folder)
    if not frames.files:
        why = f"; for one, {frames.problems[0]}" if frames.problems else ""
        raise DataError(
            f"{folder}: no image with a time; add a {TABLE} with the columns file and time_s (or time_utc), one row for each "
            f"frame{why}"
        )
    order = np.argsort(frames.instants.seconds(), kind="stable")
    frames = replace(
        frames,
        files=tuple(frames.files[i] for i in order),
        instants=frames.instants.select(order),
        row=frames.row[order],
    )
    again = np.concatenate([[False], np.diff(frames.instants.seconds()) <= 0.0])
    problems = list(frames.problems)
    for i in np.flatnonzero(again):
        message = f"{frames.files[i].name}: another frame has this time"
        problems.append(Problem(frames.source, int(frames.row[i]), "time_repeated", message, "dropped"))
    keep = np.flatnonzero(~again)
    return replace(
        frames, files=tuple(frames.files[i] for i in keep), instants=frames.instants.select(keep), row=frames.row[keep],
        problems=tuple(problems),
    )  # fmt: skip


def _listed(path: Path) -> Frames:
    """Of the folder's table."""
    table = read_table(path)
    # A date, where there is one beside plain seconds: it tells where the Earth was.
    dated = sorted(NATIVE_TIME, key=lambda name: NATIVE_TIME[name] == "s")
    time = next((name for name in dated if name in table.columns), None)
    if "file" not in table.columns or time is None:
        names = ", ".join(table.columns)
        raise DataError(f"{path}: must have the columns file and time_s or time_utc; it has {names}")
    instants, good = _times(table, time, NATIVE_TIME[time])
    names = table.texts("file").to_pylist()
    problems = list(table.problems)
    for i in np.flatnonzero(~good):
        problems.append(Problem(str(path), int(table.row[i]), "time_unreadable", f"{time} is no time", "dropped"))
    named = np.array([bool(name) for name in names], dtype=bool)
    for i in np.flatnonzero(good & ~named):
        problems.append(Problem(str(path), int(table.row[i]), "unsolved", "names no file", "dropped"))
    keep = np.flatnonzero(good & named)
    files = tuple(path.parent / names[i] for i in keep)
    return Frames(str(path), files, instants.select(keep), table.row[keep], tuple(problems))


def _times(table: Any, name: str, scale: Scale) -> tuple[Instants, np.ndarray]:
    if scale in ("utc", "tai", "gps"):
        return from_texts(table.texts(name), scale)
    return from_numbers(table.numbers(name).value, scale)


def _dated(folder: Path) -> Frames:
    """Of the images' own dates."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.is_file())
    dates = [_date(f) for f in files]
    instants, good = from_texts(pa.array([d or "" for d, _ in dates], pa.string()), "utc")
    late = np.array([half for _, half in dates], dtype=float)
    instants = replace(instants, second=instants.second + late)
    message = "{}: has no date (FITS DATE-OBS, EXIF DateTimeOriginal)"
    problems = tuple(
        Problem(str(folder), i + 1, "time_unreadable", message.format(files[i].name), "dropped")
        for i in np.flatnonzero(~good).tolist()
    )
    keep = np.flatnonzero(good)
    return Frames(str(folder), tuple(files[i] for i in keep), instants.select(keep), keep + 1, problems)


def _date(file: Path) -> tuple[str | None, float]:
    """UTC of an image as text, and seconds to add to it; None where it has none."""
    try:
        with file.open("rb") as stream:
            start = stream.read(1 << 16)
        if start.startswith(b"SIMPLE  ="):
            from ..io.fits import fits_header

            return _fits_date(fits_header(start))
        from PIL import Image as Picture

        with Picture.open(file, formats=("PNG", "JPEG", "TIFF", "BMP")) as picture:
            return _exif_date(picture.getexif().get_ifd(_EXIF)), 0.0
    except Exception:  # whatever is wrong with the file, reading its pixels says it better
        return None, 0.0


def _fits_date(header: Mapping[str, str]) -> tuple[str | None, float]:
    if header.get("TIMESYS", "UTC") not in ("UTC", ""):
        return None, 0.0
    if "DATE-AVG" in header:
        return header["DATE-AVG"], 0.0
    try:
        half = 0.5 * float(header.get("EXPTIME", header.get("EXPOSURE", "0")))
    except ValueError:
        half = 0.0
    return header.get("DATE-OBS"), half if math.isfinite(half) else 0.0


def _exif_date(tags: Mapping[int, Any]) -> str | None:
    """DateTimeOriginal with its fraction and zone; UTC where no zone is said."""
    text = tags.get(_ORIGINAL)
    if not isinstance(text, str) or len(text.strip()) != 19:
        return None
    date, _, clock = text.strip().partition(" ")
    fraction = str(tags.get(_SUBSECOND, "")).strip()
    zone = str(tags.get(_OFFSET, "")).strip() or "Z"
    return f"{date.replace(':', '-')}T{clock}{'.' + fraction if fraction.isdecimal() else ''}{zone}"


def solve_frames(folder: Path, options: SolveOptions, progress: bool = True) -> SolvedFrames:
    """Solve all frames of a folder. Raises HelmstarError where there is nothing to solve; what is not solved is a problem."""
    frames = find_frames(folder)
    if frames.instants.absolute:
        last = int(np.argmax(frames.instants.seconds()))
        check_date(julian_date_tt(int(frames.instants.day[last]), float(frames.instants.second[last])), frames.source)
    time = frames.instants.seconds()
    entries: list[dict[str, Any]] = []
    trackers = _Trackers(options, frames.instants)
    problems = list(frames.problems)
    found: list[tuple[int, np.ndarray, np.ndarray]] = []
    with Progress(progress) as bar:
        task = bar.add("frames", len(frames.files))
        for k, file in enumerate(frames.files):
            entry, solution = _solve(trackers.at(k), file, _prediction(found, time, k))
            entry["time_s"] = float(time[k])
            entries.append(entry)
            if solution is None:
                message = f"{file.name}: {entry['status']}: {entry['message']}"
                problems.append(Problem(frames.source, int(frames.row[k]), "unsolved", message, "dropped"))
            else:
                found.append((k, *solution))
            bar.advance(task)
    at = np.array([k for k, _, _ in found], dtype=int)
    return SolvedFrames(
        frames.source, frames.instants.select(at), frames.row[at], np.array([q for _, q, _ in found]).reshape(-1, 4),
        np.array([P for _, _, P in found]).reshape(-1, 3, 3), tuple(entries), tuple(problems),
    )  # fmt: skip


class _Trackers:
    """The star tracker with the stars where they are at each frame's time; without dates they stand at J2000."""

    def __init__(self, options: SolveOptions, instants: Instants):
        self._options, self._instants = options, instants
        self._second = instants.seconds()
        self._made = 0
        self._tracker = self._new(0)

    def at(self, k: int) -> StarTracker:
        if self._instants.absolute and abs(self._second[k] - self._second[self._made]) > STALE_S:
            self._made, self._tracker = k, self._new(k)
        return self._tracker

    def _new(self, k: int) -> StarTracker:
        if not self._instants.absolute:
            return tracker_of(self._options)
        return tracker_of(self._options, julian_date_tt(int(self._instants.day[k]), float(self._instants.second[k])))


def _prediction(
    found: Sequence[tuple[int, np.ndarray, np.ndarray]], time: np.ndarray, k: int
) -> tuple[np.ndarray, float] | None:
    """q_SN and its sigma (rad) at frame k by the rate between the last two solved frames; None without them."""
    if len(found) < 2:
        return None
    from scipy.spatial.transform import Rotation

    (i, qi, _), (j, qj, P) = found[-2:]
    turn = (Rotation.from_quat(qj) * Rotation.from_quat(qi).inv()).as_rotvec()
    ahead = turn * (time[k] - time[j]) / (time[j] - time[i])
    sigma = math.hypot(PREDICTED * float(np.linalg.norm(ahead)), 3.0 * math.sqrt(float(np.trace(P))))
    return (Rotation.from_rotvec(ahead) * Rotation.from_quat(qj)).as_quat(), min(sigma, 3.0)


def _solve(
    tracker: StarTracker, file: Path, prior: tuple[np.ndarray, float] | None
) -> tuple[dict[str, Any], tuple[np.ndarray, np.ndarray] | None]:
    """The frame's entry, and q_SN with its covariance where it is solved."""
    try:
        image = read_image(file)
        q, sigma = prior or (None, None)
        found = tracker.solve(image, prior_q_SN=q, prior_sigma=sigma)
    except (DataError, ValueError) as error:
        status = "unreadable" if isinstance(error, DataError) else "wrong size"
        return {"file": readable(str(file)), "status": status, "message": str(error)}, None
    entry = entry_of(file, found)
    entry["ms"] = {k: round(v, 3) for k, v in found.ms.items()}
    if not found.solved:
        return entry | {"message": REASON[found.status]}, None
    return entry, (found.identification.q_SN, found.identification.covariance)


__all__ = ["Frames", "SolvedFrames", "find_frames", "solve_frames"]
