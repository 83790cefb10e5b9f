"""Every key of an xu2020 scenario and what is allowed. No JAX here: a wrong key is refused at once."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from .specification import ScenarioSpecification

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Truth(_Table):
    attitude: Annotated[list[Vector3], Field(min_length=3, max_length=3)]
    rate_amplitude_rad_s: Annotated[float, Field(allow_inf_nan=False)]
    rate_frequency_rad_s: Vector3
    rate: Literal["prescribed", "euler"]
    inertia_kg_m2: Annotated[list[Positive], Field(min_length=3, max_length=3)]

    @field_validator("attitude")
    @classmethod
    def _is_rotation(cls, rows: list[list[float]]) -> list[list[float]]:
        X = np.array(rows)
        if not (np.allclose(X @ X.T, np.eye(3), atol=1e-9) and np.linalg.det(X) > 0):
            raise ValueError("must be a rotation matrix: rows orthonormal, determinant +1")
        return rows


class Star(_Table):
    directions: Annotated[list[Vector3], Field(min_length=2, max_length=2)]
    sigma_arcsec: NonNegative

    @field_validator("directions")
    @classmethod
    def _differ(cls, rows: list[list[float]]) -> list[list[float]]:
        r = np.array(rows)
        norms = np.linalg.norm(r, axis=1)
        if not np.all(np.isfinite(norms)) or np.any(norms < 1e-9) or np.linalg.norm(np.cross(*r)) < 1e-3 * norms.prod():
            raise ValueError("must be two directions that differ by more than 0.06 deg and are not opposite")
        return (r / norms[:, None]).tolist()


class Gyro(_Table):
    sigma_rad_step: NonNegative


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
    ukf_kappa: Annotated[float, Field(gt=-3, allow_inf_nan=False)]


class Specification(ScenarioSpecification):
    """Every key of an xu2020 scenario."""

    experiment: Literal["xu2020"]
    updates: Annotated[int, Field(ge=1, le=1_000_000)]
    step_s: Positive
    truth: Truth
    star: Star
    gyro: Gyro
    start: Start = Start()
    tuning: TuningTable
