"""Text kernels that SPICE needs beside a CK - leap seconds, a spacecraft clock, a frame - and loading kernels for a while.

The clock written here counts microseconds of Terrestrial Time (TT) from a whole second of TAI, so that a time in s since an
origin becomes ticks without passing through SPICE's seconds past J2000, which a float64 holds to 1e-7 s only. TDB is TT + K
sin E with the constants of every leap second kernel (SPICE's Time Required Reading, "Computing the difference TDB - TDT").
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from .clock import DAY_S, TT_MINUS_TAI_S, Instants, Origin, leap_seconds

TICKS_PER_S = 1e6
_NOON = 0.5 * DAY_S
_K, _EB, _M0, _M1 = 1.657e-3, 1.671e-2, 6.239996, 1.99096871e-7
_MONTHS = {1: "JAN", 7: "JUL"}
INSTALL = 'pip install "helmstar[spice]"'


def spice() -> Any:
    """The module spiceypy; a DataError with the remedy where it is not installed."""
    try:
        import spiceypy
    except ImportError as error:
        raise DataError(f"SPICE kernels need the package spiceypy; install it with: {INSTALL}") from error
    return spiceypy


def first_line(error: Exception) -> str:
    """What a SPICE error says, in one line."""
    said = [str(getattr(error, name, "") or "") for name in ("short", "long")]
    text = " ".join(" ".join(said).split()) or " ".join(str(error).split())
    return text[:300] or type(error).__name__


def leap_second_kernel() -> str:
    """Text of a leap second kernel (LSK) with the leap seconds of pyerfa."""
    table = ",\n".join(
        f"        {offset:g}, @{year}-{_MONTHS.get(month, month)}-1" for year, month, offset in leap_seconds()
    )
    return f"""KPL/LSK

Leap seconds as helmstar knows them (pyerfa). Any official leap second kernel of NAIF may be loaded instead.

\\begindata

DELTET/DELTA_T_A = {TT_MINUS_TAI_S}
DELTET/K         = 1.657D-3
DELTET/EB        = 1.671D-2
DELTET/M         = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT  = (
{table}
    )

\\begintext
"""


def clock_zero(origin: Origin) -> Origin:
    """The whole second of TAI at or before the origin from which the clock counts."""
    return Origin(origin.day, math.floor(origin.second), absolute=True)


def clock_kernel(zero: Origin, spacecraft_id: int, frame: str) -> str:
    """Text of a kernel with the clock (SCLK) of `spacecraft_id` < 0 that counts microseconds of TT from `zero`, and with
    the frame `frame` of class CK whose id is 1000 times the spacecraft's."""
    tt = zero.day * DAY_S + zero.second + TT_MINUS_TAI_S - _NOON
    number, body = -spacecraft_id, 1000 * spacecraft_id
    return f"""KPL/SCLK

Clock and body frame of an attitude that helmstar estimated. The clock is no flight clock: it counts microseconds of
Terrestrial Time from {zero.tai([0.0])[0]} TAI.

\\begindata

SCLK_KERNEL_ID            = ( @2000-01-01/12:00 )
SCLK_DATA_TYPE_{number}       = ( 1 )
SCLK01_TIME_SYSTEM_{number}   = ( 2 )
SCLK01_N_FIELDS_{number}      = ( 2 )
SCLK01_MODULI_{number}        = ( 4294967296 1000000 )
SCLK01_OFFSETS_{number}       = ( 0 0 )
SCLK01_OUTPUT_DELIM_{number}  = ( 1 )
SCLK_PARTITION_START_{number} = ( 0.0 )
SCLK_PARTITION_END_{number}   = ( 4.294967296E15 )
SCLK01_COEFFICIENTS_{number}  = ( 0.0 {tt!r} 1.0 )

FRAME_{frame}  = {body}
FRAME_{body}_NAME     = '{frame}'
FRAME_{body}_CLASS    = 3
FRAME_{body}_CLASS_ID = {body}
FRAME_{body}_CENTER   = {spacecraft_id}
CK_{body}_SCLK        = {spacecraft_id}
CK_{body}_SPK         = {spacecraft_id}

\\begintext
"""


def instants_from_tdb(et: np.ndarray) -> Instants:
    """Times from SPICE's seconds of TDB past J2000."""
    tt = et - _tdb_minus_tt(et - _tdb_minus_tt(et))
    tai = tt - TT_MINUS_TAI_S + _NOON
    day = np.floor(tai / DAY_S)
    return Instants(day.astype(np.int64), tai - day * DAY_S, absolute=True)


def _tdb_minus_tt(tt: np.ndarray) -> np.ndarray:
    anomaly = _M0 + _M1 * tt
    return _K * np.sin(anomaly + _EB * np.sin(anomaly))


@contextmanager
def loaded(kernels: Sequence[Path]) -> Iterator[Any]:
    """spiceypy with our leap seconds and then `kernels` loaded; what was loaded before stays. Errors become DataErrors."""
    library = spice()
    from spiceypy.utils.exceptions import NotFoundError, SpiceyError

    done: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "helmstar.tls"
        own.write_text(leap_second_kernel(), encoding="ascii")
        try:
            for kernel in (own, *kernels):
                if not kernel.is_file():
                    raise DataError(f"{kernel}: there is no such SPICE kernel; [spice] kernels names it")
                try:
                    library.furnsh(str(kernel))
                except (SpiceyError, NotFoundError) as error:
                    raise DataError(f"{kernel}: SPICE cannot load this kernel: {first_line(error)}") from error
                done.append(str(kernel))
            yield library
        finally:
            for name in reversed(done):
                library.unload(name)
