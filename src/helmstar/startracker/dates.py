"""Dates of images: from UTC text, and as the Julian dates at which the Earth's place and velocity are looked up."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ..errors import ConfigurationError, DataError
from ..io.clock import TT_MINUS_TAI_S, Instants, from_texts

JD_2000 = 2451544.5
"""Julian date of 2000-01-01T00:00, where the days of `Instants` begin."""
LAST_JD = 2488069.5
"""2100-01-01: so far erfa's epv00 is good for the Earth's place."""


def instant_of(text: str) -> Instants:
    """The one instant of --time. Raises ConfigurationError."""
    instants, good = from_texts(pa.array([text]), "utc")
    if not bool(np.all(good)) or julian_date_tt(int(instants.day[0]), float(instants.second[0])) >= LAST_JD:
        raise ConfigurationError(f"--time {text}: must be a UTC time of 1972 to 2099 such as 2019-07-29T20:47:26")
    return instants


def julian_date_tt(day: int, second: float) -> float:
    """Julian date in TT of TAI days since 2000-01-01 and seconds."""
    return JD_2000 + day + (second + TT_MINUS_TAI_S) / 86400.0


def check_date(date_tt: float, said: str) -> None:
    """Raise DataError for a date at which the Earth's place is not known; `said`: where it comes from."""
    if not date_tt < LAST_JD:
        raise DataError(f"{said}: has dates after 2099, where the Earth's place is not known; correct them")


__all__ = ["check_date", "instant_of", "julian_date_tt"]
