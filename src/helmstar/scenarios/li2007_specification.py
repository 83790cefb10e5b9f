"""Every key of an li2007 scenario and what is allowed. No JAX here: a wrong key is refused at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from .specification import ScenarioSpecification

# Far wider than any use: only so that squares and quotients of the numbers keep their digits.
Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Truth(_Table):
    position_km: Vector3
    velocity_km_s: Vector3
    noise_km: Positive
    noise: Literal["gamma", "gaussian"]
    mean_known: bool
    velocity_sigma_km_s: NonNegative

    @field_validator("position_km", "velocity_km_s")
    @classmethod
    def _is_not_zero(cls, v: list[float]) -> list[float]:
        if np.linalg.norm(v) < 1e-6:
            raise ValueError("must not be zero: the probe is away from the body and moves past it")
        return v


class Attitude(_Table):
    angles_rad: Vector3
    error_deg: Annotated[float, Field(ge=0, le=10)]
    random_walk_deg_sqrt_h: Annotated[float, Field(ge=1e-6, le=100)]


class Prior(_Table):
    position_km: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    velocity_km_s: Positive
    pointing_deg: Annotated[float, Field(ge=1e-6, le=10)]


class Camera(_Table):
    level: Literal["pixel", "image"]
    focal_mm: Annotated[float, Field(ge=1, le=1e5)]
    px_per_mm: Annotated[float, Field(ge=1, le=1e5)]
    cross_px: Annotated[list[Finite], Field(min_length=2, max_length=2)]
    size_px: Annotated[int, Field(ge=32, le=65536)]
    sigma_px: Annotated[float, Field(ge=1e-4, le=1e3)]

    @property
    def focal_px(self) -> float:
        """Pixels for a unit tangent."""
        return self.focal_mm * self.px_per_mm

    @property
    def field_deg(self) -> float:
        """Full field."""
        return float(2.0 * np.degrees(np.arctan(0.5 * self.size_px / self.focal_px)))


class Sun(_Table):
    direction: Vector3

    @field_validator("direction")
    @classmethod
    def _is_direction(cls, v: list[float]) -> list[float]:
        norm = float(np.linalg.norm(v))
        if norm < 1e-9:
            raise ValueError("must be a direction, not zero")
        return [x / norm for x in v]


class Body(_Table):
    radius_km: Annotated[float, Field(ge=1e-3, le=1e5)]
    law: Literal["lambert", "lommel_seeliger", "mcewen", "minnaert", "hapke"]
    radius_error: Annotated[float, Field(gt=-0.9, le=10)]
    assumed_law: Literal["lambert", "lommel_seeliger", "mcewen", "minnaert", "hapke"]
    offset_sigma: Annotated[float, Field(ge=1e-4, le=10)]
    offset_walk_rad: Annotated[float, Field(ge=0, le=10)]


class TuningTable(_Table):
    particles: Annotated[int, Field(ge=2, le=1_000_000)]
    unscented_particles: Annotated[int, Field(ge=2, le=100_000)]
    components: Annotated[int, Field(ge=3, le=10_000)]
    kernel: Annotated[float, Field(gt=0, le=1)]
    ukf_alpha: Annotated[float, Field(ge=1e-4, le=10)]
    ukf_beta: Annotated[float, Field(ge=0, le=100)]
    ukf_kappa: Annotated[float, Field(gt=-6, le=1000)]
    batch_iterations: Annotated[int, Field(ge=1, le=20)]


OF_IMAGES = {"runs": 20}
"""What stands for these keys at level "image" where nobody says otherwise: a frame takes some 10 ms."""


class Specification(ScenarioSpecification):
    """Every key of an li2007 scenario."""

    experiment: Literal["li2007"]
    start: Literal["fixed", "random"]
    updates: Annotated[int, Field(ge=2, le=100_000)]
    step_s: Annotated[float, Field(ge=1e-3, le=1e5, allow_inf_nan=False)]
    truth: Truth
    attitude: Attitude
    prior: Prior
    camera: Camera
    sun: Sun
    body: Body
    tuning: TuningTable

    @classmethod
    def adapted(cls, content: Mapping[str, Any], stated: Mapping[str, Any]) -> Mapping[str, Any]:
        """Fewer runs at level "image", unless they are stated."""
        camera = content.get("camera")
        if not (isinstance(camera, Mapping) and camera.get("level") == "image"):
            return content
        return {**content, **{k: v for k, v in OF_IMAGES.items() if k not in stated}}

    @property
    def note(self) -> str:
        """What the user should know before it starts."""
        if self.camera.level != "image":
            return ""
        blocks = -(-self.runs // self.width)
        return (
            f"camera.level = image: {blocks * self.width * self.updates} frames are rendered and measured first; unless stated "
            f"there are {OF_IMAGES['runs']} runs (--runs)"
        )

    @model_validator(mode="after")
    def _frames_have_no_cross_terms(self) -> Specification:
        if self.camera.level == "image" and any(self.camera.cross_px):
            raise ValueError(
                "camera.cross_px: frames are rendered without cross terms; use [0, 0] or camera.level = pixel"
            )
        return self

    @model_validator(mode="after")
    def _does_not_hit(self) -> Specification:
        r, v = np.array(self.truth.position_km), np.array(self.truth.velocity_km_s)
        t = np.clip(-(r @ v) / (v @ v), 0.0, self.updates * self.step_s)
        nearest = float(np.linalg.norm(r + t * v))
        if nearest < 2.0 * self.body.radius_km:
            raise ValueError(
                f"the probe comes within {nearest:.3g} km of the body's centre: must stay outside two of its radii "
                f"(body.radius_km = {self.body.radius_km:g})"
            )
        return self
