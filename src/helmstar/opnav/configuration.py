"""body.toml, and what cam.toml says beyond the camera: validated, in SI."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..configuration import explain, read_toml
from ..errors import ConfigurationError
from ..imaging.body import Detector, Ellipsoid, Mesh, Target, law_of, sphere
from ..imaging.body.photometry import LAWS

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[Finite], Field(min_length=4, max_length=4)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BodyTable(_Table):
    """`[body]`: figure, light and place of the Sun."""

    name: Annotated[str, Field(min_length=1, max_length=60)] = "TARGET"
    radius_km: Positive | None = None
    semi_axes_km: Annotated[list[Positive], Field(min_length=3, max_length=3)] | None = None
    mesh: str | None = Field(default=None, description="OBJ, PLT or TAB file, beside body.toml")
    mesh_unit_km: Positive = 1.0
    law: str | None = Field(default=None, description="law of reflection; absent: unknown")
    law_parameters: dict[str, Finite] = {}
    law_known: bool = Field(
        default=False, description="true only where the law is measured: then no other is allowed for"
    )
    radius_sigma: Share = Field(default=0.05, description="relative 1 sigma of its size")
    shape_sigma: Share = Field(default=0.0, description="relative 1 sigma of each of its axes")
    albedo_sigma: Share = Field(
        default=0.05, description="relative 1 sigma of bright and dark spots a third of it across"
    )
    q_tn: Quaternion = Field(
        default=[0.0, 0.0, 0.0, 1.0], description="x, y, z, w: N to the body's axes at [initial] time"
    )
    spin_deg_s: Finite = Field(default=0.0, description="rate about the body's z axis")
    sun_n: Vector = Field(description="direction from body to Sun in N")
    gm_km3_s2: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0

    @model_validator(mode="after")
    def _one_figure(self) -> BodyTable:
        given = [k for k in ("radius_km", "semi_axes_km", "mesh") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError("give one of radius_km, semi_axes_km and mesh")
        if self.law is not None and self.law not in LAWS:
            raise ValueError(f"law = {self.law!r} must be one of {', '.join(LAWS)}")
        if self.law is None and (self.law_known or self.law_parameters):
            raise ValueError("law_known and law_parameters need a law")
        if not np.linalg.norm(self.sun_n) > 0.0:
            raise ValueError("sun_n has no length; give the direction from body to Sun")
        if not abs(np.linalg.norm(self.q_tn) - 1.0) < 1e-3:
            raise ValueError("q_tn has not length 1; give x, y, z, w")
        return self


class InitialTable(_Table):
    """`[initial]`: where the probe is expected relative to the body, in N, at a time."""

    time_s: Finite | None = None
    time_utc: str | None = None
    position_km: Vector
    velocity_km_s: Vector
    position_sigma_km: Positive | list[Positive] = 100.0
    velocity_sigma_km_s: Positive | list[Positive] = 1e-3

    @model_validator(mode="after")
    def _checks(self) -> InitialTable:
        if (self.time_s is None) == (self.time_utc is None):
            raise ValueError("give time_s or time_utc, one of the two")
        for name in ("position_sigma_km", "velocity_sigma_km_s"):
            value = getattr(self, name)
            if isinstance(value, list) and len(value) != 3:
                raise ValueError(f"{name} must be one number or three")
        if not np.linalg.norm(self.position_km) > 0.0:
            raise ValueError("position_km is the body's centre")
        return self


class _BodyFile(_Table):
    body: BodyTable
    initial: InitialTable


class MountingTable(_Table):
    """`[mounting]` of cam.toml: how the camera sits on B, and how well that and the attitude are known."""

    q_cb: Quaternion = [0.0, 0.0, 0.0, 1.0]
    pointing_sigma_deg: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        default=0.01, description="1 sigma per axis of an error that is the same in all frames; it is estimated"
    )
    attitude_sigma_arcsec: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        default=2.0, description="1 sigma per axis of each frame's own error"
    )

    @model_validator(mode="after")
    def _unit(self) -> MountingTable:
        if not abs(np.linalg.norm(self.q_cb) - 1.0) < 1e-3:
            raise ValueError("q_cb has not length 1; give x, y, z, w of the rotation from B to C")
        return self


class DetectorTable(_Table):
    """`[detector]` of cam.toml."""

    gain_e: Positive | None = Field(default=None, description="electrons per count")
    psf_sigma_px: Annotated[float, Field(gt=0.1, lt=20)] = 0.8
    psf_spread: Annotated[float, Field(ge=0, lt=1)] = 0.15


@dataclass(frozen=True)
class BodyFile:
    """body.toml read: the target, and the tables as they are written."""

    target: Target
    body: BodyTable
    initial: InitialTable

    @property
    def position_sigma(self) -> np.ndarray:
        """(3,) m."""
        return 1e3 * np.broadcast_to(np.asarray(self.initial.position_sigma_km, float), 3)

    @property
    def velocity_sigma(self) -> np.ndarray:
        """(3,) m/s."""
        return 1e3 * np.broadcast_to(np.asarray(self.initial.velocity_sigma_km_s, float), 3)


def read_body(path: Path) -> BodyFile:
    """Raises ConfigurationError, naming file and key, DataError for the mesh's file."""
    content = read_toml(path)
    try:
        tables = _BodyFile.model_validate(content)
    except ValidationError as error:
        raise explain(error, str(path), _BodyFile) from None
    b = tables.body
    if b.mesh is not None:
        from ..imaging.body.mesh_files import read_mesh

        shape: Ellipsoid | Mesh = read_mesh(Path(path).parent / b.mesh, 1e3 * b.mesh_unit_km)
    elif b.semi_axes_km is not None:
        shape = Ellipsoid((1e3 * b.semi_axes_km[0], 1e3 * b.semi_axes_km[1], 1e3 * b.semi_axes_km[2]))
    else:
        shape = sphere(1e3 * (b.radius_km or 0.0))
    try:
        law = None if b.law is None else law_of(b.law, **b.law_parameters)
        target = Target(shape, law, b.law_known, b.radius_sigma, b.shape_sigma, b.albedo_sigma)
    except ValueError as error:
        raise ConfigurationError(f"{path}: body: {error}") from None
    return BodyFile(target, b, tables.initial)


def read_mounting(path: Path) -> tuple[MountingTable, Detector]:
    """What cam.toml says beside [camera]. Raises ConfigurationError."""
    content: dict[str, Any] = read_toml(path)
    unknown = sorted(set(content) - {"camera", "mounting", "detector"})
    if unknown:
        raise ConfigurationError(f"{path}: unknown table [{unknown[0]}]; known: [camera], [mounting], [detector]")
    try:
        mounting = MountingTable.model_validate(content.get("mounting", {}))
    except ValidationError as error:
        raise explain(error, f"{path}: mounting", MountingTable) from None
    try:
        detector = DetectorTable.model_validate(content.get("detector", {}))
    except ValidationError as error:
        raise explain(error, f"{path}: detector", DetectorTable) from None
    return mounting, Detector(detector.gain_e, detector.psf_sigma_px, detector.psf_spread)


__all__ = ["BodyFile", "read_body", "read_mounting"]
