"""Which column of a table is what: the native names, and the `[columns]` map of sensors.toml for foreign ones.

Native names: a time (`time_s`, `time_gps_s`, `time_tai_s`, `time_unix_s`, `time_utc`, `time_tai`, `time_gps`; the
first of these that is there), `gyro_x_rad_s` (y, z; also deg_s, arcsec_s, deg_h, and rad, deg, arcsec for increments),
`q_bn_x` (y, z, w), and for one star per row `star_b_x` (y, z) in body axes with `star_n_x` (y, z) in inertial axes.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import PurePath
from textwrap import indent
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..errors import DataError
from ..units import ARCSEC, DEG, HOUR_S
from .clock import Scale

GyroUnit = Literal["rad/s", "deg/s", "arcsec/s", "deg/h", "rad", "deg", "arcsec"]
Triple = Annotated[list[str], Field(min_length=3, max_length=3)]
Quadruple = Annotated[list[str], Field(min_length=4, max_length=4)]

UNIT_TO_SI: dict[str, float] = {
    "rad/s": 1.0, "deg/s": DEG, "arcsec/s": ARCSEC, "deg/h": DEG / HOUR_S,
    "rad": 1.0, "deg": DEG, "arcsec": ARCSEC,
}  # fmt: skip
NATIVE_TIME: dict[str, Scale] = {
    "time_s": "s", "time_gps_s": "gps", "time_tai_s": "tai", "time_unix_s": "unix",
    "time_utc": "utc", "time_tai": "tai", "time_gps": "gps",
}  # fmt: skip
_NATIVE_GYRO_UNIT: dict[str, GyroUnit] = {
    "rad_s": "rad/s", "deg_s": "deg/s", "arcsec_s": "arcsec/s", "deg_h": "deg/h",
    "rad": "rad", "deg": "deg", "arcsec": "arcsec",
}  # fmt: skip

_REMEDY = """\
A table needs a time (time_s, time_utc, time_tai, time_gps, time_gps_s, time_tai_s or time_unix_s) and at least one of
  gyro_x_rad_s, gyro_y_rad_s, gyro_z_rad_s   (or _deg_s, _arcsec_s, _deg_h; increments: gyro_x_rad)
  q_bn_x, q_bn_y, q_bn_z, q_bn_w             (attitude, inertial to body)
  star_b_x, _y, _z with star_n_x, _y, _z     (star directions in body and inertial axes)
Other names are mapped in sensors.toml, for example:
  [columns]
  time = "sclk"
  gyro = ["wx", "wy", "wz"]
  gyro_unit = "deg/s"
  quaternion = ["q0", "q1", "q2", "q3"]
  quaternion_order = "wxyz\""""


class ColumnsConfiguration(BaseModel):
    """One `[columns]` table: names for what a file calls otherwise, and how its numbers are meant."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    file: str | None = Field(
        default=None, description="files this map is for, as a pattern such as 'gyro_*.csv'; all if absent"
    )
    time: str | None = Field(default=None, description="column with the time")
    clock_scale: Scale | None = Field(
        default=None, description="what the time counts; 's' is any clock of plain seconds"
    )
    clock_unit_s: float | None = Field(
        default=None, gt=0, ge=1e-12, le=1e8, allow_inf_nan=False, description="seconds per unit of a numeric time"
    )
    gyro: Triple | None = Field(default=None, description="columns with the rates about x, y, z")
    gyro_unit: GyroUnit | None = Field(
        default=None, description="unit of the gyro columns; rad, deg, arcsec are increments"
    )
    gyro_frame: Literal["body", "base"] = Field(
        default="body", description="axes of the rates: body, or inertial (base)"
    )
    quaternion: Quadruple | None = Field(default=None, description="columns with the quaternion, in the order below")
    quaternion_order: Literal["xyzw", "wxyz"] = Field(
        default="xyzw", description="where the scalar w stands in `quaternion`"
    )
    quaternion_sense: Literal["bn", "nb"] = Field(default="bn", description="bn: v_B = R(q) v_N; nb: v_N = R(q) v_B")
    star_b: Triple | None = Field(default=None, description="columns with the star's direction in body axes")
    star_n: Triple | None = Field(default=None, description="columns with the star's direction in inertial axes")

    @model_validator(mode="after")
    def _order_needs_names(self) -> ColumnsConfiguration:
        for key in ("quaternion_order", "quaternion_sense"):
            if key in self.model_fields_set and self.quaternion is None:
                raise ValueError(
                    f'{key} is for foreign columns: name them too, as quaternion = ["q0", "q1", "q2", "q3"]'
                )
        return self

    @model_validator(mode="after")
    def _each_column_once(self) -> ColumnsConfiguration:
        names = [name for group in self.names().values() for name in group]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"the column {twice[0]!r} is named {names.count(twice[0])} times; a column is one thing")
        return self

    def names(self) -> dict[str, list[str]]:
        """The columns that are named, by key."""
        groups = {"gyro": self.gyro, "quaternion": self.quaternion, "star_b": self.star_b, "star_n": self.star_n}
        return {"time": [self.time] if self.time else [], **{key: list(group or []) for key, group in groups.items()}}


@dataclass(frozen=True)
class Layout:
    """The columns of one table: names in the order x, y, z(, w), empty where the table has none."""

    time: str
    scale: Scale
    clock_unit_s: float
    gyro: tuple[str, ...]
    gyro_unit: str
    gyro_frame: str
    quaternion: tuple[str, ...]
    quaternion_sense: str
    star_b: tuple[str, ...]
    star_n: tuple[str, ...]

    @property
    def gyro_is_increment(self) -> bool:
        """True if the unit is one of angle, not of angular rate."""
        return "/" not in self.gyro_unit


def map_for(file: str, maps: Sequence[ColumnsConfiguration]) -> ColumnsConfiguration:
    """The first map whose `file` pattern fits the name or path of the file, or that has none; else an empty map."""
    name = PurePath(file).name
    for entry in maps:
        if entry.file is None or fnmatch(name, entry.file) or fnmatch(file, entry.file):
            return entry
    return ColumnsConfiguration()


def resolve(file: str, found: Sequence[str], given: ColumnsConfiguration) -> Layout:
    """Find the columns of a table by map and native name; a table without a time or any measurement is refused."""

    def group(mapped: list[str] | None, native: list[str]) -> tuple[str, ...]:
        for names in (mapped or [], native):
            missing = [name for name in names if name not in found]
            if names and not missing:
                return tuple(names)
            if names and len(missing) < len(names):
                raise DataError(
                    f"{file}: {_absent(missing, found)}, though {_listed(set(names) - set(missing))} is there"
                )
        return ()

    gyro, gyro_unit = group(given.gyro, []), given.gyro_unit or "rad/s"
    for suffix, unit in _NATIVE_GYRO_UNIT.items():
        if not gyro:
            gyro, gyro_unit = group(None, [f"gyro_{axis}_{suffix}" for axis in "xyz"]), given.gyro_unit or unit
    quaternion = group(given.quaternion, [])
    if quaternion and given.quaternion_order == "wxyz":
        quaternion = (*quaternion[1:], quaternion[0])
    quaternion_sense = given.quaternion_sense if quaternion else "bn"
    quaternion = quaternion or group(None, [f"q_bn_{axis}" for axis in "xyzw"])
    star_b = group(given.star_b, [f"star_b_{axis}" for axis in "xyz"])
    star_n = group(given.star_n, [f"star_n_{axis}" for axis in "xyz"])

    time = next((name for name in (given.time, *NATIVE_TIME) if name in found), None)
    if not (gyro or quaternion or star_b) or time is None:
        what = "no time" if time is None else "no gyro, attitude or star"
        absent = [name for names in given.names().values() for name in names if name not in found]
        hint = f"\n[columns] names what is not there: {_absent(absent, found)}." if absent else ""
        details = indent(f"Columns found: {_listed(found)}{hint}\n{_REMEDY}", "  ")
        raise DataError(f"{details}\n{file}: {what} column is known; what a table needs stands above")
    if bool(star_b) != bool(star_n):
        there, lacking = ("star_b", "star_n") if star_b else ("star_n", "star_b")
        raise DataError(
            f"{file}: {there} columns need {lacking} columns beside them: each star's direction in both frames"
        )
    return Layout(
        time=time,
        scale=given.clock_scale or NATIVE_TIME.get(time, "s"),
        clock_unit_s=given.clock_unit_s or 1.0,
        gyro=gyro,
        gyro_unit=gyro_unit,
        gyro_frame=given.gyro_frame,
        quaternion=quaternion,
        quaternion_sense=quaternion_sense,
        star_b=star_b,
        star_n=star_n,
    )


def refuse_unknown(
    given: ColumnsConfiguration, tables: Sequence[tuple[Sequence[str], Layout]], needs: Sequence[str]
) -> None:
    """Raise a DataError for a map with a name that none of the tables it is used for has (columns and layout of each).

    One table may lack what another has. What is not among `needs` ("gyro", "star") may lie in a table that is not
    given, unless a native column is taken in its place.
    """
    found = list(dict.fromkeys(name for columns, _ in tables for name in columns))
    for key, names in given.names().items():
        absent = [name for name in names if name not in found]
        needed = key == "time" or ("gyro" if key == "gyro" else "star") in needs
        if absent and tables and (needed or any(getattr(layout, key) for _, layout in tables)):
            raise DataError(
                f"  Columns found: {_listed(found)}\n[columns] {key}: {_absent(absent, found)} in any table that this map "
                "is for; correct the name, leave it out, or give the map a file pattern ([[columns]] with file = ...)"
            )


def _absent(missing: Sequence[str], found: Sequence[str]) -> str:
    close = difflib.get_close_matches(missing[0], list(found), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"there is no column {_listed(missing)}{hint}"


def _listed(names: Sequence[str] | set[str], most: int = 40) -> str:
    names = sorted(names) if isinstance(names, set) else list(names)
    more = f", ... ({len(names) - most} more)" if len(names) > most else ""
    return ", ".join(str(name)[:60] for name in names[:most]) + more
