"""SPICE CK, binary: attitudes read through SPICE's own library, and written as type 3 (CK Required Reading, "Data Type 3").

SPICE's C-matrix takes components from the reference frame to the instrument's, v_B = C v_N, and its quaternion is scalar
first with Hamilton's product: [w, x, y, z] of our q_BN. Angular velocity is that of B relative to N, in N. Reading takes the
instants that types 1 and 3 store; other types, which hold polynomials, are sampled. Both need the extra `spice`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..files import replacing, write_atomically
from .attitude_file import AttitudeSamples, attitude_part
from .cleaning import Part
from .clock import Origin
from .daf import CkFile, CkSegmentSummary, read_daf
from .problems import ProblemLog
from .settings import FormatSettings, SpiceConfiguration
from .spice_kernels import (
    TICKS_PER_S,
    clock_kernel,
    clock_zero,
    first_line,
    instants_from_tdb,
    leap_second_kernel,
    loaded,
    spice,
)

_STORED, _POLYNOMIALS = (1, 3), (2, 4, 5, 6)
_MOST_SAMPLES = 20_000_000


def is_ck(path: Path, head: bytes) -> bool:
    """Whether a file that is called and begins so is meant as a CK."""
    return head.startswith((b"DAF/", b"NAIF/DAF", b"DAFETF", b"'DAFETF")) or path.suffix.lower() == ".bc"


def read_ck(path: Path, settings: FormatSettings, log: ProblemLog) -> Part:
    """Attitudes of one object of a CK. Raises DataError (also where spiceypy is missing), OSError."""
    file, wanted = str(path), settings.spice
    spice()
    content = read_daf(path)
    with loaded([settings.path(name) for name in wanted.kernels]) as library:
        from spiceypy.utils.exceptions import NotFoundError, SpiceyError

        try:
            ticks, q_BN, clock = _instances(library, path, content, wanted)
            et = _seconds(library, clock, ticks)
        except (SpiceyError, NotFoundError) as error:
            raise DataError(
                f"{file}: SPICE says: {first_line(error)}. Does [spice] kernels name the clock (SCLK) and frame kernels?"
            ) from error
    order = np.argsort(et, kind="stable")  # a CK may hold its segments in any order; the later one is believed
    last = np.concatenate([np.diff(et[order]) > 0.0, [True]])[: len(order)]
    order = order[last]
    good = np.isfinite(et[order]) & (np.abs(et[order]) < 1e11)
    instants = instants_from_tdb(np.where(good, et[order], 0.0))
    samples = AttitudeSamples(order + 1, instants, good, q_BN[order])
    return attitude_part(file, samples, "spacecraft clock", "tdb", log)


def _seconds(library: Any, clock: int, ticks: np.ndarray) -> np.ndarray:
    """TDB seconds past J2000 of encoded clock times."""
    return np.array([library.sct2e(clock, tick) for tick in ticks.tolist()], dtype=float)


def _instances(
    library: Any, path: Path, content: CkFile, wanted: SpiceConfiguration
) -> tuple[np.ndarray, np.ndarray, int]:
    """Encoded clock times (n,), q_BN (n, 4) and the clock's id, of the one object that is wanted."""
    objects = sorted({segment.instrument for segment in content.segments})
    listed = ", ".join(map(str, objects[:20])) or "none"
    if wanted.instrument_id is None and len(objects) != 1:
        raise DataError(f"{path}: objects in this CK: {listed}; choose one with [spice] instrument_id")
    chosen = objects[0] if wanted.instrument_id is None else wanted.instrument_id
    if chosen not in objects:
        raise DataError(f"{path}: no object {chosen} in this CK; there are: {listed}")
    clock = wanted.spacecraft_clock_id
    clock = library.ckmeta(chosen, "SCLK") if clock is None else clock
    ticks, quaternions = [], []
    for segment in content.segments:
        if segment.instrument != chosen:
            continue
        if segment.kind in _STORED:
            tick, q = _stored(content, segment)
            q = _to_reference(library, segment, clock, tick, q, wanted.reference)
        elif segment.kind in _POLYNOMIALS:
            tick, q = _sampled(library, path, segment, clock, wanted)
        else:
            raise DataError(f"{path}: a segment of type {segment.kind}; CK types are 1 to 6")
        ticks.append(tick)
        quaternions.append(q)
    return np.concatenate(ticks), np.concatenate(quaternions), clock


def _stored(content: CkFile, segment: CkSegmentSummary) -> tuple[np.ndarray, np.ndarray]:
    """Times and quaternions, scalar last, of a segment of type 1 or 3: the instances, then their times, then indices."""
    data = content.data(segment)
    count, width = data[-1], 7 if segment.rates else 4
    if not (1 <= count <= len(data) / (width + 1)):
        raise DataError(
            f"{content.file}: a segment of this CK has {count:g} instances, but not the room; it is damaged"
        )
    n = int(count)
    q = data[: n * width].reshape(n, width)[:, [1, 2, 3, 0]]
    return data[n * width : n * (width + 1)], q


def _sampled(
    library: Any, path: Path, segment: CkSegmentSummary, clock: int, wanted: SpiceConfiguration
) -> tuple[np.ndarray, np.ndarray]:
    """Times `step_s` apart and quaternions, scalar last, relative to the reference, within a segment of another type."""
    from spiceypy.utils.exceptions import NotFoundError

    start, stop = library.sct2e(clock, segment.start), library.sct2e(clock, segment.stop)
    if not 0.0 <= stop - start <= _MOST_SAMPLES * wanted.step_s:
        raise DataError(
            f"{path}: a segment from {start:.3f} to {stop:.3f} s past J2000; damaged, or step_s is too small"
        )
    ticks, quaternions = [], []
    library.furnsh(str(path))
    try:
        for et in np.arange(start, stop, wanted.step_s).tolist():
            tick = library.sce2c(clock, et)
            try:
                found = library.ckgp(segment.instrument, tick, 0, wanted.reference)
            except NotFoundError:
                continue  # between two intervals
            ticks.append(float(found[1]))
            quaternions.append(library.m2q(found[0]))
    finally:
        library.unload(str(path))
    return np.array(ticks), np.array(quaternions, dtype=float).reshape(-1, 4)[:, [1, 2, 3, 0]]


def _to_reference(
    library: Any, segment: CkSegmentSummary, clock: int, ticks: np.ndarray, q: np.ndarray, reference: str
) -> np.ndarray:
    """Quaternions relative to `reference` from those relative to the segment's own frame."""
    own = library.frmnam(segment.frame)
    if own == reference:
        return q
    turned = np.empty_like(q)
    for i, et in enumerate(_seconds(library, clock, ticks).tolist()):
        between = library.m2q(library.pxform(reference, own, et))
        turned[i] = np.asarray(library.qxq(q[i, [3, 0, 1, 2]], between))[[1, 2, 3, 0]]
    return turned


@dataclass(frozen=True)
class CkSegment:
    """What one interpolation interval holds: time (n,) s since the origin, increasing; q_BN (n, 4); rate (n, 3) of B
    relative to N in B, rad/s."""

    time: np.ndarray
    q_BN: np.ndarray
    rate: np.ndarray


def write_ck(
    path: Path,
    origin: Origin,
    segments: Sequence[CkSegment],
    settings: SpiceConfiguration | None = None,
    comments: Sequence[str] = (),
) -> list[Path]:
    """Write a CK of one type 3 segment, its clock and frame beside it (.tsc), and leap seconds (.tls).

    SPICE interpolates within each of `segments` and not between them. Returns the files, the CK first; furnsh loads them
    in any order. Raises DataError if the origin is not absolute, spiceypy is missing or SPICE refuses.
    """
    settings = settings or SpiceConfiguration()
    if not origin.absolute:
        raise DataError(f"{path}: a CK needs absolute times, and these are seconds of a clock; give time_utc")
    library = spice()
    from spiceypy.utils.exceptions import SpiceyError

    zero = clock_zero(origin)
    since = origin.second - zero.second
    ticks = [(segment.time + since) * TICKS_PER_S for segment in segments]
    q_BN = np.vstack([segment.q_BN for segment in segments])
    rate_N = np.vstack([_in_N(segment.rate, segment.q_BN) for segment in segments])
    all_ticks = np.concatenate(ticks)
    with replacing(path) as part:
        part.unlink()  # SPICE writes to new files only
        handle = None
        try:
            handle = library.ckopn(str(part), "helmstar attitude", 0)
            if comments:
                library.dafac(handle, [_ascii(comment) for comment in comments])
            library.ckw03(
                handle, all_ticks[0], all_ticks[-1], 1000 * settings.spacecraft_id, settings.reference, True,
                "helmstar smoothed attitude", len(all_ticks), all_ticks,
                np.ascontiguousarray(q_BN[:, [3, 0, 1, 2]]), rate_N,
                len(ticks), np.array([t[0] for t in ticks]),
            )  # fmt: skip
            library.ckcls(handle)
        except SpiceyError as error:
            if handle is not None:
                library.dafcls(handle)
            raise DataError(f"{path}: SPICE cannot write this CK: {first_line(error)}") from error
    clock = write_atomically(path.with_suffix(".tsc"), clock_kernel(zero, settings.spacecraft_id, settings.frame))
    return [path, clock, write_atomically(path.with_suffix(".tls"), leap_second_kernel())]


def _ascii(text: str) -> str:
    return " ".join(text.split()).encode("ascii", "replace").decode()[:200]


def _in_N(vector_B: np.ndarray, q_BN: np.ndarray) -> np.ndarray:
    """Components in N of vectors (n, 3) given in B."""
    v, w = -q_BN[:, :3], q_BN[:, 3:]
    twice = 2.0 * np.cross(v, vector_B)
    return vector_B + w * twice + np.cross(v, twice)
