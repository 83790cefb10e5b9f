"""Every key of an xu2020 scenario and what is allowed. No JAX here: a wrong key is refused at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from .specification import ScenarioSpecification

# Far wider than any use: only so that squares, products and quotients of the numbers stay finite.
Finite = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=1e-30, le=1e12, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
LEAST_STAR_ARCSEC = 1e-6
OF_IMAGES = {"runs": 4, "width": 4, "updates": 240}
"""What stands for these keys at level "image" where nobody says otherwise: each update takes two frames of some 30 ms."""
LONGEST_SMEAR_PX = 30.0
LARGEST_INERTIA_RATIO = 1e6  # above it Euler's equations are so stiff that the integrator hardly moves


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Truth(_Table):
    attitude: Annotated[list[Vector3], Field(min_length=3, max_length=3)]
    rate_amplitude_rad_s: Finite
    rate_frequency_rad_s: Vector3
    rate: Literal["prescribed", "euler"]
    inertia_kg_m2: Annotated[
        list[Annotated[float, Field(ge=1e-6, le=1e9, allow_inf_nan=False)]], Field(min_length=3, max_length=3)
    ]

    @field_validator("inertia_kg_m2")
    @classmethod
    def _is_of_a_body(cls, J: list[float]) -> list[float]:
        if 2.0 * max(J) > sum(J) * (1.0 + 1e-9):
            raise ValueError(
                f"{J} is not allowed: of no body is a moment of inertia larger than the other two together"
            )
        if max(J) > LARGEST_INERTIA_RATIO * min(J):
            raise ValueError(
                f"{J} is not allowed: the largest must be at most {LARGEST_INERTIA_RATIO:g} times the smallest"
            )
        return J

    @field_validator("attitude")
    @classmethod
    def _is_rotation(cls, rows: list[list[float]]) -> list[list[float]]:
        X = np.array(rows)
        if not (np.allclose(X @ X.T, np.eye(3), atol=1e-9) and np.linalg.det(X) > 0):
            raise ValueError("must be a rotation matrix: rows orthonormal, determinant +1")
        return rows


class StarImage(_Table):
    """Camera and exposure of a star sensor whose measurements come from pixels."""

    fov_deg: Annotated[float, Field(ge=4, le=30, allow_inf_nan=False)]
    pixels: Annotated[int, Field(ge=64, le=4096)]
    exposure_s: Annotated[float, Field(ge=1e-4, le=100, allow_inf_nan=False)]
    limit_magnitude: Annotated[float, Field(ge=3, le=9, allow_inf_nan=False)]
    zero_point_e_s: Annotated[float, Field(ge=1e3, le=1e10, allow_inf_nan=False)]
    psf_sigma_px: Annotated[float, Field(ge=0.3, le=5, allow_inf_nan=False)]
    hot_pixels: Annotated[int, Field(ge=0, le=10_000)]


class Star(_Table):
    directions: Annotated[list[Vector3], Field(min_length=2, max_length=2)]
    sigma_arcsec: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
    level: Literal["direction", "image"]
    image: StarImage

    @field_validator("sigma_arcsec")
    @classmethod
    def _is_none_or_some(cls, sigma: float) -> float:
        if 0 < sigma < LEAST_STAR_ARCSEC:
            raise ValueError(f"{sigma} is not allowed: must be 0 (no noise) or >= {LEAST_STAR_ARCSEC}")
        return sigma

    @field_validator("directions")
    @classmethod
    def _differ(cls, rows: list[list[float]]) -> list[list[float]]:
        r = np.array(rows)
        norms = np.linalg.norm(r, axis=1)
        if not np.all(np.isfinite(norms)) or np.any(norms < 1e-9) or np.linalg.norm(np.cross(*r)) < 1e-3 * norms.prod():
            raise ValueError("must be two directions that differ by more than 0.06 deg and are not opposite")
        return (r / norms[:, None]).tolist()


class Gyro(_Table):
    sigma_rad_step: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]


class Start(_Table):
    error_deg: Annotated[float, Field(ge=0, le=180)] | None = None


class TuningTable(_Table):
    p0: Positive
    q_w: NonNegative
    sigma_v: Positive
    quaternion_p0: Positive
    quaternion_q: NonNegative
    quaternion_sigma_v: Positive
    ukf_alpha: Positive
    ukf_beta: NonNegative
    ukf_kappa: Annotated[float, Field(gt=-3, le=1e12, allow_inf_nan=False)]


class Specification(ScenarioSpecification):
    """Every key of an xu2020 scenario."""

    experiment: Literal["xu2020"]
    updates: Annotated[int, Field(ge=1, le=1_000_000)]
    step_s: Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
    truth: Truth
    star: Star
    gyro: Gyro
    start: Start = Start()
    tuning: TuningTable

    @classmethod
    def adapted(cls, content: Mapping[str, Any], stated: Mapping[str, Any]) -> Mapping[str, Any]:
        """Fewer and shorter runs at level "image", unless they are stated."""
        star = content.get("star")
        if not (isinstance(star, Mapping) and star.get("level") == "image"):
            return content
        return {**content, **{k: v for k, v in OF_IMAGES.items() if k not in stated}}

    @property
    def note(self) -> str:
        """What the user should know before it starts."""
        if self.star.level != "image":
            return ""
        blocks = -(-self.runs // self.width)
        frames = 2 * blocks * self.width * (self.updates + 1)
        return (
            f"star.level = image: {frames} frames are rendered and solved first; unless stated there are "
            f"{OF_IMAGES['runs']} runs of {OF_IMAGES['updates']} updates (--runs, --set updates=, --set width=)"
        )

    @model_validator(mode="after")
    def _smear_is_bounded(self) -> Specification:
        image = self.star.image
        focal = 0.5 * image.pixels / np.tan(0.5 * np.radians(image.fov_deg))
        smear = np.sqrt(3.0) * abs(self.truth.rate_amplitude_rad_s) * image.exposure_s * focal
        if self.star.level == "image" and smear > LONGEST_SMEAR_PX:
            raise ValueError(
                f"truth.rate_amplitude_rad_s = {self.truth.rate_amplitude_rad_s} with star.image.exposure_s = "
                f"{image.exposure_s}: stars would be drawn out over {smear:.3g} px; at most {LONGEST_SMEAR_PX:g} are solved"
            )
        return self

    @model_validator(mode="after")
    def _steps_resolve_the_rate(self) -> Specification:
        t = self.truth
        turn = np.sqrt(3.0) * abs(t.rate_amplitude_rad_s) * self.step_s
        if turn > np.pi:
            raise ValueError(
                f"truth.rate_amplitude_rad_s = {t.rate_amplitude_rad_s} with step_s = {self.step_s}: up to {turn:.3g} rad "
                "in a step; must be at most half a turn, pi rad"
            )
        phase = max(map(abs, t.rate_frequency_rad_s)) * self.step_s
        if phase > np.pi:
            raise ValueError(
                f"truth.rate_frequency_rad_s = {t.rate_frequency_rad_s} with step_s = {self.step_s}: {phase:.3g} rad in a "
                "step; must be at most pi rad, two steps for each period"
            )
        return self
