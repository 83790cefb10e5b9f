"""The smoothed attitude of a record in the formats of other programs: CCSDS AEM and SPICE CK."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core import RESET
from ..errors import DataError
from ..files import readable
from ..io.clock import Origin
from ..io.screening import find_gaps
from ..sensors.configuration import SensorsConfiguration
from .solve import Solution


def _segments(time: np.ndarray, restarts: np.ndarray) -> list[slice]:
    """Stretches of increasing times without a gap or a restart in them; `restarts`: indices of the first times after one."""
    starts = {0, *(int(np.searchsorted(time, gap.end)) for gap in find_gaps(time)), *restarts.tolist()}
    order = sorted(starts)
    return [slice(a, b) for a, b in zip(order, [*order[1:], len(time)])]


def body_rate(time: np.ndarray, q_BN: np.ndarray) -> np.ndarray:
    """Rate of B relative to N in B (m, 3), rad/s, at times (m,) with attitudes (m, 4): the mean of the steps before and after.

    From the attitudes themselves, whatever they were estimated with: R(t + dt) = exp(-[omega dt x]) R(t).
    """
    if len(time) < 2:
        return np.zeros((len(time), 3))
    R = Rotation.from_quat(q_BN)
    steps = -(R[1:] * R[:-1].inv()).as_rotvec() / np.diff(time)[:, None]
    return 0.5 * (np.concatenate([steps[:1], steps]) + np.concatenate([steps, steps[-1:]]))


def write_exports(
    solution: Solution,
    origin: Origin,
    sensors: SensorsConfiguration,
    folder: Path,
    *,
    aem: bool,
    ck: bool,
    command: str,
) -> dict[str, str]:
    """Smoothed attitude as CCSDS AEM and SPICE CK where asked for; names of the files by what they are."""
    out: dict[str, str] = {}
    time, q_BN = solution.timeline.time, solution.smoothed.q_BN
    restarts = solution.updates.index[solution.updates.status == RESET]
    parts = _segments(time, restarts)
    source = "gyro and star tracker telemetry" if len(solution.gyro) else "star tracker telemetry"
    comments = [f"Attitude estimated by helmstar from {source}, smoothed.", command]
    if aem:
        from ..io.aem import write_aem

        path = folder / "attitude.aem"
        write_aem(path, origin, [(time[p], q_BN[p]) for p in parts], sensors.aem, comments)
        out["aem"] = str(path)
    if ck:
        from ..io.spice_ck import CkSegment, write_ck

        segments = [CkSegment(time[p], q_BN[p], body_rate(time[p], q_BN[p])) for p in parts]
        files = write_ck(folder / "attitude.bc", origin, segments, sensors.spice, comments)
        out |= dict(zip(("ck", "sclk", "lsk"), map(str, files)))
    return out


def check_export(origin: Origin, *, aem: bool, ck: bool, folder: Path | None = None) -> None:
    """Raise the DataErrors of an export before the work, not after it."""
    if (aem or ck) and not origin.absolute:
        raise DataError(
            f"{'--aem' if aem else '--ck'} needs absolute times, and the files count plain seconds; give time_utc, or say "
            'what the seconds count: [columns] clock_scale = "unix", "gps" or "tai"'
        )
    if ck:
        from ..io.spice_kernels import spice

        spice()
        if readable(str(folder)) != str(folder):
            raise DataError(f"--out {folder}: SPICE's library writes to no name that is not UTF-8; give another folder")
