"""Time scales of telemetry: every absolute time becomes TAI as (day, second), so that no digit of a stamp is lost.

    s      seconds of any clock (spacecraft clock, simulation), known only relative to each other
    utc    ISO 8601 text, leap second 23:59:60 included
    tai    ISO 8601 text in TAI, or seconds since 1970-01-01T00:00:00 TAI
    gps    ISO 8601 text in GPS time, or seconds since 1980-01-06T00:00:00 GPS; TAI = GPS + 19 s
    unix   POSIX seconds since 1970-01-01T00:00:00 UTC, leap seconds not counted

ISO 8601 means 2015-06-15T12:00:00.25 or, by day of the year, 2015-166T12:00:00.25; a blank may stand for the T, and
UTC may end in Z or +hh:mm. Leap seconds are those of pyerfa; UTC is read from 1972 on, when it began to have them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple

import erfa
import numpy as np
import pyarrow as pa
import pyarrow.compute

pc: Any = pyarrow.compute  # makes its functions when imported, which no type checker sees

Scale = Literal["s", "utc", "tai", "gps", "unix"]

DAY_S = 86400.0
TAI_MINUS_GPS_S = 19.0
TT_MINUS_TAI_S = 32.184
_JD_2000 = 2451544.5  # Julian date of 2000-01-01T00:00, where the days of `Instants` begin
_EPOCH_2000 = np.datetime64("2000-01-01", "D")
_FARTHEST_DATE_S = 1e11  # 3000 years: beyond it a number is no time of telemetry

_ISO = (
    r"^(?P<year>\d{4})-(?:(?P<month>\d\d)-(?P<day>\d\d)|(?P<doy>\d{3}))[T ]"
    r"(?P<hour>\d\d):(?P<minute>\d\d)(?::(?P<second>\d\d(?:\.\d*)?))?"
    r" ?(?P<zone>Z|[+-](?:[01]\d|2[0-3]):?[0-5]\d)?$"
)


class TimeOffsets(NamedTuple):
    """What is added to the stamps of gyro and of star rows, s, to make them the times of their samples."""

    gyro: float = 0.0
    star: float = 0.0


NO_OFFSETS = TimeOffsets()


@dataclass(frozen=True)
class Origin:
    """The instant from which seconds are counted: TAI days since 2000-01-01 and seconds, or seconds of some clock."""

    day: int
    second: float
    absolute: bool

    def __str__(self) -> str:
        return f"{self.utc([0.0])[0]} UTC" if self.absolute else f"{self.second:.6f} s of the files' clock"

    def tai(self, time: np.ndarray | list[float], digits: int = 6) -> list[str]:
        """`time`, s since the origin, as ISO 8601 TAI with up to 9 digits of a second. Only where `absolute`."""
        return self._iso("TAI", time, digits)

    def utc(self, time: np.ndarray | list[float], digits: int = 6) -> list[str]:
        """`time`, s since the origin, as ISO 8601 UTC with up to 9 digits of a second. Only where `absolute`."""
        return self._iso("UTC", time, digits)

    def _iso(self, scale: str, time: np.ndarray | list[float], digits: int) -> list[str]:
        if not self.absolute:
            raise ValueError("a clock of plain seconds has no calendar")
        jd, fraction = np.full(len(time), _JD_2000 + self.day), (np.asarray(time, dtype=float) + self.second) / DAY_S
        if scale == "UTC":
            jd, fraction = erfa.taiutc(jd, fraction)
        year, month, day, clock = erfa.d2dtf(scale, digits, jd, fraction)
        return [
            f"{y:04d}-{m:02d}-{d:02d}T{c['h']:02d}:{c['m']:02d}:{c['s']:02d}.{c['f']:0{digits}d}"
            for y, m, d, c in zip(year, month, day, clock)
        ]


@dataclass(frozen=True)
class Instants:
    """Times (n,): `day` + `second` after 2000-01-01 TAI if `absolute`, else `second` of some clock with day 0."""

    day: np.ndarray
    second: np.ndarray
    absolute: bool

    def __len__(self) -> int:
        return len(self.day)

    def since(self, origin: Origin) -> np.ndarray:
        """Seconds since `origin`."""
        return (self.day - origin.day) * DAY_S + (self.second - origin.second)

    def select(self, index: np.ndarray) -> Instants:
        """Those at an index or mask."""
        return Instants(self.day[index], self.second[index], self.absolute)

    def seconds(self) -> np.ndarray:
        """Seconds since the first of them in storage order."""
        return (self.day - self.day[:1]) * DAY_S + (self.second - self.second[:1])

    def earliest(self) -> Origin:
        """The first in time, of at least one."""
        first = int(np.argmin(self.seconds()))
        return Origin(int(self.day[first]), float(self.second[first]), self.absolute)


def from_numbers(value: np.ndarray, scale: Scale) -> tuple[Instants, np.ndarray]:
    """Times from seconds in a scale other than utc, and which of them are times at all (the rest are set to 0)."""
    good = np.isfinite(value) & (np.abs(value) < (1e15 if scale == "s" else _FARTHEST_DATE_S))
    value = np.where(good, value, 0.0)
    if scale == "s":
        return Instants(np.zeros(len(value), dtype=np.int64), value, absolute=False), good
    whole = np.floor(value / DAY_S)
    day, second = whole.astype(np.int64), value - whole * DAY_S
    if scale == "gps":
        day, second = day + _day(1980, 1, 6), second + TAI_MINUS_GPS_S
    elif scale == "tai":
        day = day + _day(1970, 1, 1)
    else:
        day = day + _day(1970, 1, 1)
        second = second + tai_minus_utc(day)
        good &= np.isfinite(second)
    return Instants(day, np.where(good, second, 0.0), absolute=True), good


def from_texts(text: pa.ChunkedArray | pa.Array, scale: Scale) -> tuple[Instants, np.ndarray]:
    """Times from ISO 8601 text in utc, tai or gps, and which of them are times at all (the rest are set to 0)."""
    if isinstance(text, pa.ChunkedArray):
        text = text.combine_chunks()
    parts = pc.extract_regex(text, pattern=_ISO)
    good = np.array(pc.is_valid(parts).to_numpy(zero_copy_only=False))

    def part(name: str) -> np.ndarray:
        cells = pc.struct_field(parts, name)
        cells = pc.if_else(pc.equal(cells, ""), pa.scalar(None, pa.string()), cells)
        return np.nan_to_num(np.array(pc.cast(cells, pa.float64()).to_numpy(zero_copy_only=False), dtype=float))

    day, valid = _calendar(part("year"), part("month"), part("day"), part("doy"))
    hour, minute, second = part("hour"), part("minute"), part("second")
    good &= valid & (hour < 24) & (minute < 60)

    zone = np.array(pc.struct_field(parts, "zone").fill_null("").to_pylist(), dtype=str)
    if scale != "utc":
        good &= zone == ""  # Z and offsets belong to UTC: such a text is not in the scale the column claims
    of_day = 60.0 * hour + minute - _zone_minutes(zone)  # min
    day, of_day = day + np.floor(of_day / 1440.0).astype(np.int64), np.mod(of_day, 1440.0)
    if scale == "utc":
        offset = tai_minus_utc(day)
        has_leap_second = (of_day == 1439.0) & (tai_minus_utc(day + 1) - offset == 1.0)
        good &= np.isfinite(offset) & (second < np.where(has_leap_second, 61.0, 60.0))
    else:
        offset = np.full(len(day), TAI_MINUS_GPS_S if scale == "gps" else 0.0)
        good &= second < 60.0
    total = np.where(good, 60.0 * of_day + second + offset, 0.0)
    return Instants(np.where(good, day, 0), total, absolute=True), good


def leap_seconds() -> list[tuple[int, int, float]]:
    """Year, month and TAI - UTC in s from the first day of that month on, since 1972."""
    table = erfa.leap_seconds.get()
    return [(int(row["year"]), int(row["month"]), float(row["tai_utc"])) for row in table if row["year"] >= 1972]


def tai_minus_utc(day: np.ndarray) -> np.ndarray:
    """TAI - UTC in s during UTC days (counted from 2000-01-01); NaN before 1972."""
    start, offset = _leap_seconds()
    index = np.searchsorted(start, day, side="right")
    return np.concatenate([[np.nan], offset])[index]


@cache
def _leap_seconds() -> tuple[np.ndarray, np.ndarray]:
    table = leap_seconds()
    return np.array([_day(year, month, 1) for year, month, _ in table]), np.array([offset for *_, offset in table])


def _day(year: int, month: int, day: int) -> int:
    return int((np.datetime64(f"{year:04d}-{month:02d}-{day:02d}", "D") - _EPOCH_2000).astype(int))


def _calendar(year: np.ndarray, month: np.ndarray, day: np.ndarray, doy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Days since 2000-01-01 of dates by month and day or by day of the year (the other 0), and which dates exist."""
    by_year = doy > 0
    months = ((year - 1970) * 12 + np.where(by_year, 0, month - 1)).astype(np.int64)
    start = months.astype("datetime64[M]").astype("datetime64[D]")
    after = (months + np.where(by_year, 12, 1)).astype("datetime64[M]").astype("datetime64[D]")
    number = np.where(by_year, doy, day).astype(np.int64)
    exists = (number >= 1) & (number <= (after - start).astype(np.int64))
    exists &= by_year | ((month >= 1) & (month <= 12))
    return (start - _EPOCH_2000).astype(np.int64) + number - 1, exists


def _zone_minutes(zone: np.ndarray) -> np.ndarray:
    """Minutes that a zone is ahead of UTC."""
    names, index = np.unique(zone, return_inverse=True)

    def minutes(name: str) -> float:
        if name in ("", "Z"):
            return 0.0
        digits = name[1:].replace(":", "")
        return (60.0 * int(digits[:2]) + int(digits[2:])) * (-1.0 if name[0] == "-" else 1.0)

    return np.array([minutes(str(name)) for name in names])[index]
