"""Which frames, when, and how the camera was turned: tables of times, FITS headers, interpolated attitudes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation, Slerp

from ..errors import DataError
from ..io.clock import Instants, Origin, from_texts
from ..io.table import Table, read_table

TABLES = (".csv", ".parquet", ".pq")
MAX_GAP_S = 60.0
"""Attitudes farther apart are not interpolated between."""


@dataclass(frozen=True)
class Clock:
    """Seconds since the first attitude: of UTC where it has time_utc (origin), else of the attitude's own time_s (zero, s)."""

    origin: Origin | None
    zero: float

    def of_utc(self, texts: Sequence[str], where: str) -> np.ndarray:
        """Seconds (n,) of UTC texts. Raises DataError."""
        if self.origin is None:
            raise DataError(
                f"{where}: has UTC, but the attitude has only time_s; give an attitude with time_utc, or time_s"
            )
        instants, good = from_texts(pa.array(list(texts), pa.string()), "utc")
        if not bool(np.all(good)):
            bad = texts[int(np.flatnonzero(~good)[0])]
            raise DataError(f"{where}: {bad[:40]!r} is no UTC time such as 2019-07-29T20:47:26.5")
        return instants.since(self.origin)

    def of_seconds(self, value: np.ndarray) -> np.ndarray:
        """Seconds of the clock of the attitude's time_s."""
        return np.asarray(value, float) - self.zero


@dataclass(frozen=True)
class Attitude:
    """time: (n,) s of the clock, increasing. q_BN: (n, 4), scalar last."""

    clock: Clock
    time: np.ndarray
    q_BN: np.ndarray

    def at(self, t: float) -> np.ndarray | None:
        """R_BN (3, 3) at a time, None outside of the attitudes or in a gap of more than MAX_GAP_S."""
        if t < self.time[0] - 1e-6 or t > self.time[-1] + 1e-6:
            return None
        k = int(np.clip(np.searchsorted(self.time, t), 1, len(self.time) - 1)) if len(self.time) > 1 else 0
        if k == 0:
            return Rotation.from_quat(self.q_BN[0]).as_matrix()
        t0, t1 = self.time[k - 1], self.time[k]
        if t1 - t0 > MAX_GAP_S and min(t - t0, t1 - t) > 1e-6:
            return None
        return Slerp([t0, t1], Rotation.from_quat(self.q_BN[k - 1 : k + 1]))(np.clip(t, t0, t1)).as_matrix()


def read_attitude(path: Path) -> Attitude:
    """attitude.parquet or .csv as `helmstar attitude` writes it: time_s, perhaps time_utc, q_bn_x .. q_bn_w. Raises DataError."""
    table = read_table(path)
    names = [f"q_bn_{a}" for a in "xyzw"]
    missing = [n for n in [*names, "time_s"] if n not in table.columns]
    if missing:
        raise DataError(f"{path}: has no column {missing[0]!r}; give the table that `helmstar attitude` writes")
    q = np.stack([table.numbers(n).value for n in names], axis=1)
    seconds = table.numbers("time_s").value
    size = np.linalg.norm(q, axis=1)
    good = np.isfinite(seconds) & (np.abs(size - 1.0) < 1e-3)
    if not good.any():
        raise DataError(f"{path}: no row has a time and a quaternion of length 1")
    origin, time = None, seconds
    if "time_utc" in table.columns:
        texts = table.texts("time_utc")
        instants, read = from_texts(texts, "utc")
        good &= read
        if good.any():
            origin = instants.select(good).earliest()
            time = instants.since(origin)
    zero = float(seconds[good].min())
    if origin is None:
        time = seconds - zero
    time, q = time[good], q[good] / size[good, None]
    order = np.argsort(time, kind="stable")
    time, q = time[order], q[order]
    once = np.concatenate([[True], np.diff(time) > 0.0])
    return Attitude(Clock(origin, zero), time[once], q[once])


@dataclass(frozen=True)
class FrameFile:
    """A file of a frame and its time, s of the clock, NaN where none is known; `why` then says so."""

    path: Path
    time: float
    why: str = ""


def list_frames(files: Sequence[Path], clock: Clock) -> list[FrameFile]:
    """Frames in the order of time. Tables (CSV, Parquet: file, time_utc or time_s) give times of images by name; without images,
    all files that they name, beside the table, are meant. What no table names has the time of its FITS header (DATE-OBS and half
    of EXPTIME). Raises DataError where there is no frame."""
    tables = [f for f in files if f.suffix.lower() in TABLES]
    images = [f for f in files if f.suffix.lower() not in TABLES]
    named: list[Path] = []
    known: dict[str, float] = {}
    for path in tables:
        for name, time in zip(*_times(path, read_table(path), clock)):
            known[name] = time
            named.append(path.parent / name)
    if not images:
        images = named
        known |= (
            {str(path): time for path, time in zip(named, list(known.values()))} if len(known) == len(named) else {}
        )
    if not images:
        raise DataError("no frame was given; give images, or a table with the columns file and time_utc or time_s")
    out = []
    for image in images:
        time = known.get(str(image), known.get(image.name))
        out.append(FrameFile(image, time) if time is not None else _by_header(image, clock))
    return sorted(out, key=lambda f: (np.isnan(f.time), f.time))


def _times(path: Path, table: Table, clock: Clock) -> tuple[list[str], list[float]]:
    if "file" not in table.columns:
        raise DataError(f"{path}: has no column 'file'; its columns must be file and time_utc or time_s")
    names = [str(t) for t in table.texts("file").to_pylist()]
    if "time_utc" in table.columns:
        return names, list(clock.of_utc([str(t) for t in table.texts("time_utc").to_pylist()], str(path)))
    if "time_s" not in table.columns:
        raise DataError(f"{path}: has neither a column 'time_utc' nor 'time_s'")
    value = table.numbers("time_s")
    if not np.isfinite(value.value).all():
        row = int(table.row[int(np.flatnonzero(~np.isfinite(value.value))[0])])
        raise DataError(f"{path}, row {row}: time_s is no number")
    return names, list(clock.of_seconds(value.value))


def _by_header(path: Path, clock: Clock) -> FrameFile:
    from ..io.images import read_image

    try:
        meta = read_image(path).metadata
    except DataError as error:
        return FrameFile(path, float("nan"), str(error))
    text = meta.get("DATE-OBS", "").strip()
    if "T" not in text and meta.get("TIME-OBS"):
        text = f"{text}T{meta['TIME-OBS'].strip()}"
    if not text:
        return FrameFile(
            path, float("nan"), f"{path}: has no time; name it in a table with file and time_utc or time_s"
        )
    try:
        half = 0.5 * float(meta.get("EXPTIME", meta.get("EXPOSURE", "0")))
    except ValueError:
        half = 0.0
    try:
        return FrameFile(path, float(clock.of_utc([text], f"{path}: DATE-OBS")[0]) + half)
    except DataError as error:
        return FrameFile(path, float("nan"), str(error))


__all__ = ["Attitude", "Clock", "FrameFile", "Instants", "list_frames", "read_attitude"]
