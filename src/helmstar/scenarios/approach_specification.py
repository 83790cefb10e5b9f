"""Every key of an approach scenario and what is allowed. No JAX here: a wrong key is refused at once."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from .specification import ScenarioSpecification

Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Sigma = Annotated[float, Field(ge=1e-9, le=1e6, allow_inf_nan=False)]
Sigmas3 = Annotated[list[Sigma], Field(min_length=3, max_length=3)]
MOST_EPOCHS = 20_000


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Encounter(_Table):
    velocity_km_s: Vector3
    aim_km: Vector3
    pole: Vector3
    sun_direction: Vector3
    sun_distance_au: Annotated[float, Field(ge=0.05, le=50)]
    body_velocity_km_s: Vector3

    @field_validator("velocity_km_s", "pole", "sun_direction")
    @classmethod
    def _is_not_zero(cls, v: list[float]) -> list[float]:
        if np.linalg.norm(v) < 1e-6:
            raise ValueError("must not be zero")
        return v

    @model_validator(mode="after")
    def _has_a_plane(self) -> Encounter:
        v, aim = np.array(self.velocity_km_s), np.array(self.aim_km)
        u = v / np.linalg.norm(v)
        if abs(u @ aim) > 1e-6 * max(np.linalg.norm(aim), 1.0):
            raise ValueError(f"aim_km = {self.aim_km} has a part along velocity_km_s: must be across it")
        pole = np.array(self.pole) / np.linalg.norm(self.pole)
        if np.linalg.norm(np.cross(u, pole)) < 1e-3:
            raise ValueError("pole is along velocity_km_s: must be away from it, for T = velocity x pole")
        return self


class Ephemeris(_Table):
    position_km: Sigmas3
    velocity_m_s: Sigmas3


class Probe(_Table):
    position_km: Sigmas3
    velocity_m_s: Sigmas3
    off_course_m_s: NonNegative
    area_to_mass_m2_kg: Annotated[float, Field(ge=0, le=100)]
    reflectivity: Annotated[float, Field(ge=0, le=3)]
    radiation_error: Annotated[float, Field(ge=0, le=10)]
    velocity_walk_mm_s_sqrt_day: NonNegative


class Camera(_Table):
    focal_mm: Annotated[float, Field(ge=1, le=1e5)]
    px_per_mm: Annotated[float, Field(ge=1, le=1e5)]
    size_px: Annotated[int, Field(ge=32, le=65536)]
    sigma_px: Annotated[float, Field(ge=1e-4, le=1e3)]
    attitude_arcsec: Annotated[list[NonNegative], Field(min_length=3, max_length=3)]
    centre_error_km: NonNegative


class Frames(_Table):
    from_h: Annotated[list[Positive], Field(min_length=1, max_length=100)]
    every_min: Annotated[list[Positive], Field(min_length=1, max_length=100)]
    until_min: Positive

    @model_validator(mode="after")
    def _goes_down(self) -> Frames:
        if len(self.from_h) != len(self.every_min):
            raise ValueError(
                f"from_h has {len(self.from_h)} entries and every_min {len(self.every_min)}: must be as many"
            )
        ends = [60.0 * h for h in self.from_h] + [self.until_min]
        if any(a <= b for a, b in pairwise(ends)):
            raise ValueError("from_h must go down, and end before until_min")
        if max(self.every_min) > 5 * 1440:
            raise ValueError("every_min: must be at most five days, 7200 min")
        count = sum((a - b) / every for a, b, every in zip(ends, ends[1:], self.every_min, strict=False))
        if count > MOST_EPOCHS:
            raise ValueError(f"{count:.0f} frames: must be at most {MOST_EPOCHS}")
        return self


class Manoeuvres(_Table):
    before_h: Annotated[list[Positive], Field(min_length=1, max_length=50)]
    least_m_s: NonNegative
    magnitude_share: Annotated[float, Field(ge=0, le=1)]
    magnitude_m_s: NonNegative
    pointing_deg: Annotated[float, Field(ge=0, le=45)]
    pointing_m_s: NonNegative

    @field_validator("before_h")
    @classmethod
    def _goes_down(cls, v: list[float]) -> list[float]:
        if any(a <= b for a, b in pairwise(v)):
            raise ValueError("must go down: the earliest manoeuvre first")
        return v


class Terminal(_Table):
    filter: Literal["ekf", "gsf", "none"]


class Specification(ScenarioSpecification):
    """Every key of an approach scenario."""

    experiment: Literal["approach"]
    encounter: Encounter
    ephemeris: Ephemeris
    probe: Probe
    camera: Camera
    frames: Frames
    manoeuvres: Manoeuvres
    terminal: Terminal

    @model_validator(mode="after")
    def _is_in_time(self) -> Specification:
        first, last = self.frames.from_h[0], self.frames.until_min / 60.0
        if not all(last < h < first for h in self.manoeuvres.before_h):
            raise ValueError(
                f"manoeuvres.before_h = {self.manoeuvres.before_h}: must lie between the start, {first:g} h, and the last frame, "
                f"{last:.3g} h before closest approach"
            )
        return self
