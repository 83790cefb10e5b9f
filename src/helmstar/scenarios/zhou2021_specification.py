"""Every key of a zhou2021 scenario and what is allowed. No JAX here: a wrong key is refused at once."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from ..units import ARCSEC
from .specification import ScenarioSpecification

# Far wider than any use: only so that squares and quotients of the numbers keep their digits.
Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Seconds = Annotated[int, Field(ge=0, le=200_000)]
READINGS = {"A": np.sqrt(0.002), "B": 0.002, "C": np.deg2rad(np.sqrt(0.002)), "D": np.deg2rad(0.002)}
"""Sigma in rad per component of a direction, for each reading of "error covariance 0.002 I"."""
POLICIES = ("zeros", "hold_last", "hold_mean", "hold_mean_raised", "commanded", "rate_state")


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Orbit(_Table):
    semi_major_axis_km: Annotated[float, Field(gt=6378.2, le=1e6, allow_inf_nan=False)]
    eccentricity: Annotated[float, Field(ge=0, le=0.99)]
    inclination_deg: Annotated[float, Field(ge=0, le=180)]
    raan_deg: Finite
    argument_of_perigee_deg: Finite
    mean_anomaly_deg: Finite

    @model_validator(mode="after")
    def _stays_above(self) -> Orbit:
        perigee = self.semi_major_axis_km * (1.0 - self.eccentricity)
        if perigee < 6378.2:
            raise ValueError(f"perigee {perigee:.1f} km from the Earth's centre: must be above its radius, 6378.2 km")
        return self


class Attitude(_Table):
    profile: Literal["lvlh", "yaw", "slew", "file"]
    slew_deg: Annotated[float, Field(ge=0, le=360)]
    slew_s: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
    slew_every_s: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
    sun: Annotated[list[Finite], Field(min_length=3, max_length=3)]
    file: str | None = None
    file_sha256: str | None = None  # filled in; one that is given must be that of the file

    @field_validator("sun")
    @classmethod
    def _is_direction(cls, v: list[float]) -> list[float]:
        norm = float(np.linalg.norm(v))
        if norm < 1e-9:
            raise ValueError("must be a direction, not zero")
        return [x / norm for x in v]

    @model_validator(mode="after")
    def _complete(self) -> Attitude:
        if self.profile == "file" and self.file is None:
            raise ValueError('profile "file" needs the key attitude.file: a CCSDS AEM or an STK .a file')
        if self.slew_every_s < self.slew_s:
            raise ValueError(f"slew_every_s = {self.slew_every_s}: must not be shorter than slew_s = {self.slew_s}")
        return self

    @model_validator(mode="after")
    def _file_by_content(self) -> Attitude:
        """The content is part of what identifies a campaign: the same name with other attitudes is another truth."""
        if self.profile != "file" or self.file is None:
            self.file_sha256 = None
            return self
        try:
            found = hashlib.sha256(Path(self.file).read_bytes()).hexdigest()
        except OSError as error:
            raise ValueError(f"file = {self.file!r} cannot be read: {error.strerror or error}") from None
        if self.file_sha256 not in (None, found):
            raise ValueError(
                f"file = {self.file!r} has another content than file_sha256 says ({found[:12]}.., not "
                f"{self.file_sha256[:12]}..); leave file_sha256 out, it is filled in"
            )
        self.file_sha256 = found
        return self


class Star(_Table):
    geometry: Literal["wide", "fov"]
    field_deg: Annotated[float, Field(gt=0, le=120)]
    faintest: Annotated[float, Field(ge=2, le=9)]
    reading: Literal["A", "B", "C", "D"]
    sigma_arcsec: Annotated[float, Field(ge=1e-3, le=1e5, allow_inf_nan=False)] | None = None
    loss_start_s: Seconds
    loss_s: Seconds

    @property
    def sigma(self) -> float:
        """Sigma in rad per component of a direction."""
        return READINGS[self.reading] if self.sigma_arcsec is None else self.sigma_arcsec * ARCSEC


class Gyro(_Table):
    arw_deg_sqrt_h: Positive
    rrw_deg_h_sqrt_h: NonNegative
    initial_drift_sigma_deg_h: Positive
    loss_start_s: Annotated[int, Field(ge=1, le=200_000)]  # what is held needs a sample before it
    loss_s: Annotated[int, Field(ge=1, le=100_000)]
    loss_policy: Literal["none", "zeros", "hold_last", "hold_mean", "hold_mean_raised", "commanded", "rate_state"]
    hold_s: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
    raised_deg_s: Positive
    command_error: Annotated[float, Field(gt=-1, lt=1)]


class Tuning(_Table):
    wrong_start_sigma_deg: Positive
    reset_probability: Annotated[float, Field(ge=1e-15, le=0.5)]
    reset_after: Annotated[int, Field(ge=1, le=1_000_000)]
    reset_drift_sigma_deg_h: Positive
    adaptive_share: Annotated[float, Field(ge=1e-6, le=0.9)]
    rate_sigma_deg_s: Positive
    recovered_deg: Positive


class Specification(ScenarioSpecification):
    """Every key of a zhou2021 scenario."""

    experiment: Literal["zhou2021"]
    duration_s: Annotated[int, Field(ge=60, le=200_000)]  # memory is some 10 kB for each second and 25 runs
    orbit: Orbit
    attitude: Attitude
    star: Star
    gyro: Gyro
    tuning: Tuning

    @model_validator(mode="after")
    def _losses_fit(self) -> Specification:
        """A loss that the main pass is asked for lies within it."""
        for name, table, asked in (
            ("gyro", self.gyro, self.gyro.loss_policy != "none"),
            ("star", self.star, self.star.loss_s > 0),
        ):
            end = table.loss_start_s + table.loss_s
            if asked and end > self.duration_s:
                raise ValueError(
                    f"{name}.loss_start_s = {table.loss_start_s} and {name}.loss_s = {table.loss_s} end at {end} s, after "
                    f"duration_s = {self.duration_s}; begin earlier, shorten the loss or lengthen the duration"
                )
        return self
