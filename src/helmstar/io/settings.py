"""What sensors.toml may say about files in other formats: `[gracefo]`, `[aem]`, `[spice]` (docs/telemetry.md)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Axis = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[Finite], Field(min_length=4, max_length=4)]

INERTIAL = re.compile(r"^(ICRF\d*|EME2000|J2000|GCRF\d*)$")
"""Names of inertial frames in a CCSDS message, in capitals."""
LOWEST_SPACECRAFT_ID = -(2**31 // 1000)
"""1000 times it, the number of the frame and of the CK's object, is still a 32-bit integer."""


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class GraceFoConfiguration(_Settings):
    """`[gracefo]`: GRACE-FO Level-1 files. What is absent is as in docs/telemetry.md."""

    quaternion_sense: Literal["nb", "bn"] = Field(default="nb", description="nb: v_N = R(q) v_B, as the files have it")
    sca_id: int | None = Field(default=None, description="star camera of SCA1A that is used; the first if absent")
    mounting: dict[str, Quaternion] = Field(
        default={}, description="per sca_id the four numbers of QSA1B (scalar first): v_camera = R(q) v_SRF"
    )
    confidence_below: int = Field(default=6, description="SCA1A rows whose sca_confid is not below this are dropped")
    imu_axes: list[Axis] | None = Field(
        default=None, description="input axes of gyro 1, 2, .. in the science reference frame"
    )
    angle_unit: Literal["deg", "rad", "arcsec"] | None = Field(
        default=None, description="unit of FiltAng; the header's, else deg"
    )
    angle_wrap_deg: Positive | None = Field(
        default=None, description="FiltAng starts again after this many degrees; without it a jump is a lost increment"
    )
    reject_bits: list[int] | None = Field(
        default=None, description="bits of qualflg (0: rightmost) that drop a row; [] drops none"
    )

    @field_validator("mounting")
    @classmethod
    def _unit(cls, mounting: dict[str, list[float]]) -> dict[str, list[float]]:
        for name, q in mounting.items():
            if not name.isdigit():
                raise ValueError(f"{name!r} is no sca_id; write the camera's number, as in mounting.1 = [..]")
            if not abs(math.hypot(*q) - 1.0) <= 1e-3:
                raise ValueError(f"{q} has length {math.hypot(*q):.6g}, but a rotation needs 1 (cos, i, j, k)")
        return mounting

    @field_validator("imu_axes")
    @classmethod
    def _directions(cls, axes: list[list[float]] | None) -> list[list[float]] | None:
        for axis in axes or []:
            if not abs(math.hypot(*axis) - 1.0) <= 1e-2:
                raise ValueError(f"{axis} has length {math.hypot(*axis):.6g}, but an axis needs 1")
        return axes

    @field_validator("reject_bits")
    @classmethod
    def _bits(cls, bits: list[int] | None) -> list[int] | None:
        for bit in bits or []:
            if not 0 <= bit <= 63:
                raise ValueError(f"{bit} is no bit of qualflg; bits count from 0, the rightmost")
        return bits


class AemConfiguration(_Settings):
    """`[aem]`: what the attitude ephemeris message that `--aem` writes says about its object."""

    object_name: str = "UNKNOWN"
    object_id: str = "UNKNOWN"
    originator: str = "HELMSTAR"
    ref_frame_a: str = Field(default="ICRF", description="name of N: ICRF, EME2000, J2000 or GCRF")
    ref_frame_b: str = Field(default="SC_BODY_1", description="name of B")

    @field_validator("*")
    @classmethod
    def _one_line(cls, text: str) -> str:
        if not text.strip() or not text.isascii() or not text.isprintable() or len(text) > 200:
            raise ValueError(f"{text!r} is no value of a message: one line of printable ASCII is needed")
        return text.strip()

    @field_validator("ref_frame_a")
    @classmethod
    def _inertial(cls, name: str) -> str:
        if not INERTIAL.match(name.upper()):
            raise ValueError(f"{name!r} must be inertial: ICRF, EME2000, J2000 or GCRF (the quaternion is from N to B)")
        return name

    @field_validator("ref_frame_b")
    @classmethod
    def _of_the_body(cls, name: str) -> str:
        if INERTIAL.match(name.upper()):
            raise ValueError(f"{name!r} is inertial, but must be the body's, such as SC_BODY_1")
        return name


class SpiceConfiguration(_Settings):
    """`[spice]`: how a CK is read, and what the one that `--ck` writes is called."""

    kernels: list[str] = Field(default=[], description="clock (SCLK), leap second (LSK) and frame kernels for reading")
    instrument_id: int | None = Field(default=None, description="object in the CK; needed if it has several")
    spacecraft_clock_id: int | None = Field(default=None, description="its clock; SPICE's rule if absent")
    reference: str = Field(default="J2000", description="SPICE name of N")
    step_s: Positive = Field(default=1.0, description="sampling of CK types that hold polynomials, not instants")
    spacecraft_id: Annotated[int, Field(lt=0)] = Field(default=-999, description="NAIF code that --ck writes")
    frame: str = Field(default="HELMSTAR_BODY", description="name of B that --ck defines")

    @field_validator("frame", "reference")
    @classmethod
    def _name(cls, name: str) -> str:
        if not 0 < len(name) <= 26 or not name.isascii() or not name.replace("_", "").isalnum():
            raise ValueError(f"{name!r} is no name of a SPICE frame: up to 26 letters, digits and underscores")
        return name.upper()

    @field_validator("spacecraft_id")
    @classmethod
    def _fits(cls, number: int) -> int:
        if number < LOWEST_SPACECRAFT_ID:
            raise ValueError(
                f"{number} is not allowed: must be >= {LOWEST_SPACECRAFT_ID}, since 1000 times it has to be a 32-bit integer"
            )
        return number


@dataclass(frozen=True)
class FormatSettings:
    """All of them. `folder`: relative file names in them are looked up here if not found as they stand."""

    gracefo: GraceFoConfiguration = field(default_factory=GraceFoConfiguration)
    spice: SpiceConfiguration = field(default_factory=SpiceConfiguration)
    folder: Path | None = None

    def path(self, name: str) -> Path:
        """The file that a setting names."""
        path = Path(name)
        return path if path.exists() or self.folder is None else self.folder / name
