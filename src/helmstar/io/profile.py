"""An attitude profile from a file, for a simulation: CCSDS AEM, STK .a, SPICE CK, SCA1B, CSV or Parquet."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import DataError
from .aem import is_aem, segment_gaps
from .attitude_file import read_bytes
from .settings import FormatSettings
from .telemetry import read_telemetry


def read_attitude_profile(path: Path | str, settings: FormatSettings | None = None) -> tuple[np.ndarray, np.ndarray]:
    """time (n,) in s from the first row on, increasing from 0, and q_BN (n, 4), unit, scalar last, continuous in sign.

    Bad rows are not dropped in silence: any is a DataError, as is a file with fewer than two attitudes.
    """
    attitude = read_telemetry([path], strict=True, needs=["star"], settings=settings).attitude
    if len(attitude) < 2:
        raise DataError(f"{path}: {len(attitude)} attitudes; a profile needs at least 2")
    turned = np.sum(attitude.q_BN[1:] * attitude.q_BN[:-1], axis=1) < 0.0
    sign = np.where(np.cumsum(np.concatenate([[0], turned])) % 2 == 1, -1.0, 1.0)
    return attitude.time - attitude.time[0], attitude.q_BN * sign[:, None]


def profile_gaps(path: Path | str) -> list[tuple[float, float]]:
    """Stretches (begin, end) in s since the first attitude over which a file says not to interpolate: between the segments
    of an AEM. Other formats know none."""
    return segment_gaps(Path(path)) if is_aem(read_bytes(Path(path), 4096)) else []
