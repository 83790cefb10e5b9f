"""sensors.toml: what is known of a gyro and a star tracker, in a data sheet's units, and in SI as properties.

    [gyro]
    arw_deg_sqrt_h = 0.003        # angle random walk; or arw_arcsec_sqrt_s, arw_rad_sqrt_s
    rrw_deg_h_sqrt_h = 0.01       # rate random walk; or rrw_arcsec_s_sqrt_s, rrw_rad_s_sqrt_s
    [star]
    sigma_cross_arcsec = 5.0      # with sigma_roll_arcsec about the boresight; or sigma_arcsec for all axes
    sigma_roll_arcsec = 40.0
    q_sb = [0.0, 0.7071068, 0.0, 0.7071068]   # R_SB, scalar last: v_S = R_SB v_B, boresight +z of S
    [filter]
    gate_probability = 1e-6
    [columns]                     # foreign column names, see helmstar.io.columns

1 deg/sqrt(h) = (pi/180) / 60 rad/sqrt(s); 1 deg/h/sqrt(h) = (pi/180) / 3600 / 60 rad/s/sqrt(s).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ..configuration import explain, read_toml
from ..errors import ConfigurationError
from ..io.clock import TimeOffsets
from ..io.columns import ColumnsConfiguration
from ..io.settings import AemConfiguration, FormatSettings, GraceFoConfiguration, SpiceConfiguration
from ..units import ARCSEC, DEG, HOUR_S

ARW_UNITS = {"arw_arcsec_sqrt_s": ARCSEC, "arw_deg_sqrt_h": DEG / math.sqrt(HOUR_S), "arw_rad_sqrt_s": 1.0}
RRW_UNITS = {
    "rrw_arcsec_s_sqrt_s": ARCSEC,
    "rrw_deg_h_sqrt_h": DEG / HOUR_S / math.sqrt(HOUR_S),
    "rrw_rad_s_sqrt_s": 1.0,
}
BIAS_INSTABILITY_UNITS = {"bias_instability_arcsec_s": ARCSEC, "bias_instability_deg_h": DEG / HOUR_S}

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Offset = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]

# Far beyond any sensor on either side, and near enough to 1 that squares and covariances keep their digits.
ARW_LIMITS = (1e-15, 10.0)  # rad/sqrt(s)
RRW_LIMITS = (1e-15, 10.0)  # rad/s/sqrt(s)
DRIFT_LIMITS_ARCSEC_S = (1e-9, 2e8)
STAR_LIMITS_ARCSEC = (1e-6, 648000.0)
LARGEST_SIGMA_RATIO = 1e6


def _refuse_extremes(name: str, value: float | None, low: float, high: float) -> None:
    """Raise a ValueError for a positive value outside its limits."""
    if value and not low <= value <= high:
        raise ValueError(
            f"{name} = {value:g} is out of range: values from {low:.3g} to {high:.3g} are of a real sensor"
        )


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def _one_of(self, units: dict[str, float]) -> float | None:
        """The SI value of the one key of `units` that is given."""
        given = [key for key in units if getattr(self, key) is not None]
        return getattr(self, given[0]) * units[given[0]] if given else None

    def _refuse_two(self, units: dict[str, float]) -> None:
        given = [key for key in units if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} say the same thing in different units; keep one of them")


class GyroConfiguration(_Table):
    """`[gyro]`. What is absent is None: the noise then has to come from the data (`helmstar allan`)."""

    arw_arcsec_sqrt_s: NotNegative | None = None
    arw_deg_sqrt_h: NotNegative | None = None
    arw_rad_sqrt_s: NotNegative | None = None
    rrw_arcsec_s_sqrt_s: NotNegative | None = None
    rrw_deg_h_sqrt_h: NotNegative | None = None
    rrw_rad_s_sqrt_s: NotNegative | None = None
    bias_instability_arcsec_s: NotNegative | None = Field(default=None, description="informative; no filter uses it")
    bias_instability_deg_h: NotNegative | None = Field(default=None, description="informative; no filter uses it")
    initial_drift_sigma_arcsec_s: Positive | None = None
    reading: Literal["instant", "mean_since_previous", "increment_rad"] = "instant"
    time_offset_s: Offset = Field(default=0.0, description="time of a sample = its stamp + this")
    loss_policy: Literal[
        "interpolate", "hold_last", "hold_mean", "hold_mean_raised", "zeros", "commanded", "rate_state"
    ] = Field(default="interpolate", description="what stands for lost gyro data")
    hold_s: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] = Field(
        default=30.0, description="what hold_mean averages"
    )
    raised_deg_s: Annotated[float, Field(ge=1e-6, le=1e3, allow_inf_nan=False)] = Field(
        default=0.5, description="1 sigma of a rate held with hold_mean_raised"
    )
    commanded_rate_deg_s: (
        Annotated[
            list[Annotated[float, Field(ge=-5e4, le=5e4, allow_inf_nan=False)]], Field(min_length=3, max_length=3)
        ]
        | None
    ) = None
    command_error: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = Field(
        default=0.01, description="1 sigma of the commanded rate, relative to its length"
    )
    rate_sigma_deg_s: Annotated[float, Field(ge=1e-9, le=1e4, allow_inf_nan=False)] | None = Field(
        default=None, description="rate_state: random walk of the rate, deg/s/sqrt(s); None: what the record shows"
    )

    @model_validator(mode="after")
    def _commanded_needs_a_rate(self) -> GyroConfiguration:
        if self.loss_policy == "commanded" and self.commanded_rate_deg_s is None:
            raise ValueError('loss_policy = "commanded" needs commanded_rate_deg_s = [x, y, z], the rate in body axes')
        return self

    @model_validator(mode="after")
    def _one_unit_each(self) -> GyroConfiguration:
        for units in (ARW_UNITS, RRW_UNITS, BIAS_INSTABILITY_UNITS):
            self._refuse_two(units)
        for units, (low, high) in ((ARW_UNITS, ARW_LIMITS), (RRW_UNITS, RRW_LIMITS)):
            for key, unit in units.items():
                _refuse_extremes(key, getattr(self, key), low / unit, high / unit)
        _refuse_extremes("initial_drift_sigma_arcsec_s", self.initial_drift_sigma_arcsec_s, *DRIFT_LIMITS_ARCSEC_S)
        return self

    @property
    def arw(self) -> float | None:
        """Angle random walk in rad/sqrt(s): sigma of the angle after 1 s."""
        return self._one_of(ARW_UNITS)

    @property
    def rrw(self) -> float | None:
        """Rate random walk in rad/s/sqrt(s): sigma of the drift's change after 1 s."""
        return self._one_of(RRW_UNITS)

    @property
    def bias_instability(self) -> float | None:
        """Bias instability in rad/s."""
        return self._one_of(BIAS_INSTABILITY_UNITS)

    @property
    def initial_drift_sigma(self) -> float | None:
        """1 sigma of the drift at the start, rad/s per axis; None: from the first attitudes."""
        sigma = self.initial_drift_sigma_arcsec_s
        return None if sigma is None else sigma * ARCSEC


class StarConfiguration(_Table):
    """`[star]`: 1 sigma of a measured attitude, or of each direction where directions are measured."""

    sigma_arcsec: Positive | None = None
    sigma_cross_arcsec: Positive | None = Field(default=None, description="about x and y of S, across the boresight")
    sigma_roll_arcsec: Positive | None = Field(default=None, description="about z of S, the boresight")
    q_sb: Annotated[list[Finite], Field(min_length=4, max_length=4)] | None = None
    time_offset_s: Offset = Field(default=0.0, description="time of a sample = its stamp + this")

    @field_validator("q_sb")
    @classmethod
    def _unit(cls, q: list[float] | None) -> list[float] | None:
        if q is not None and not abs(math.hypot(*q) - 1.0) <= 1e-3:
            raise ValueError(f"{q} has length {math.hypot(*q):.6g}, but a rotation needs 1 (x, y, z, w; scalar last)")
        return q

    @model_validator(mode="after")
    def _one_description(self) -> StarConfiguration:
        across, roll = self.sigma_cross_arcsec is not None, self.sigma_roll_arcsec is not None
        if across != roll:
            given, lacking = ("cross", "roll") if across else ("roll", "cross")
            raise ValueError(f"sigma_{given}_arcsec needs sigma_{lacking}_arcsec beside it")
        if across and self.sigma_arcsec is not None:
            raise ValueError("give either sigma_arcsec or sigma_cross_arcsec with sigma_roll_arcsec, not all of them")
        for key in ("sigma_arcsec", "sigma_cross_arcsec", "sigma_roll_arcsec"):
            _refuse_extremes(key, getattr(self, key), *STAR_LIMITS_ARCSEC)
        if self.sigma_cross_arcsec is not None and self.sigma_roll_arcsec is not None:
            ratio = self.sigma_roll_arcsec / self.sigma_cross_arcsec
            if not 1.0 / LARGEST_SIGMA_RATIO <= ratio <= LARGEST_SIGMA_RATIO:
                raise ValueError(
                    f"sigma_roll_arcsec is {ratio:.3g} times sigma_cross_arcsec; up to {LARGEST_SIGMA_RATIO:.0e} times "
                    "can be computed with"
                )
        return self

    @property
    def sigma_S(self) -> np.ndarray | None:
        """1 sigma (3,) in rad about the axes of S: [cross, cross, roll]; None if not given."""
        if self.sigma_arcsec is not None:
            return np.full(3, self.sigma_arcsec * ARCSEC)
        if self.sigma_cross_arcsec is None or self.sigma_roll_arcsec is None:
            return None
        return np.array([self.sigma_cross_arcsec, self.sigma_cross_arcsec, self.sigma_roll_arcsec]) * ARCSEC

    @property
    def R_SB(self) -> np.ndarray:
        """Mounting (3, 3): v_S = R_SB v_B; identity if `q_sb` is not given."""
        if self.q_sb is None:
            return np.eye(3)
        x, y, z, w = np.array(self.q_sb) / math.hypot(*self.q_sb)
        return np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
                [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
                [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )

    def covariance_B(self) -> np.ndarray | None:
        """Covariance (3, 3) in rad^2 of a measured attitude's small rotation, in body axes; None if not given."""
        sigma = self.sigma_S
        return None if sigma is None else self.R_SB.T @ np.diag(sigma**2) @ self.R_SB


class FilterConfiguration(_Table):
    """`[filter]`."""

    gate_probability: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = Field(
        default=1e-6, description="a good measurement is refused this often; 0 refuses none"
    )
    reopen_after: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        default=5, description="refusals in a row after which one is accepted"
    )
    restart: bool = Field(
        default=False, description="after so many refusals start anew from the attitude instead of opening the gate"
    )
    restart_drift_sigma_deg_h: Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)] = Field(
        default=1000.0, description="1 sigma of the drift after a restart that follows soon after another"
    )

    @model_validator(mode="after")
    def _restart_needs_a_gate(self) -> FilterConfiguration:
        if self.restart and self.gate_probability == 0.0:
            raise ValueError("restart = true needs a gate: with gate_probability = 0 nothing is ever refused")
        return self


class CalibrateConfiguration(_Table):
    """`[calibrate]`: what is estimated of the gyro beside its drift, where the record shows it."""

    misalignment: bool = Field(default=False, description="small turn of the gyro's axes from the star tracker's body")
    scale_factor: bool = Field(default=False, description="by which share each gyro axis reads too much")
    misalignment_sigma_deg: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] = 1.0
    scale_factor_sigma_ppm: Annotated[float, Field(gt=0, le=2e5, allow_inf_nan=False)] = 10000.0

    @property
    def sigma(self) -> np.ndarray:
        """1 sigma (6,) before the record is looked at: misalignment in rad, scale factors; 0 of what is not asked for."""
        misalignment = math.radians(self.misalignment_sigma_deg) if self.misalignment else 0.0
        scale = 1e-6 * self.scale_factor_sigma_ppm if self.scale_factor else 0.0
        return np.repeat([misalignment, scale], 3)


class SensorsConfiguration(_Table):
    """All of sensors.toml. `columns` holds one map, or several with a `file` pattern each (`[[columns]]`)."""

    columns: list[ColumnsConfiguration] = []
    gyro: GyroConfiguration = GyroConfiguration()
    star: StarConfiguration = StarConfiguration()
    filter: FilterConfiguration = FilterConfiguration()
    calibrate: CalibrateConfiguration = CalibrateConfiguration()
    gracefo: GraceFoConfiguration = GraceFoConfiguration()
    aem: AemConfiguration = AemConfiguration()
    spice: SpiceConfiguration = SpiceConfiguration()

    @model_validator(mode="after")
    def _one_model(self) -> SensorsConfiguration:
        if self.gyro.loss_policy == "rate_state" and self.calibrate.sigma.any():
            raise ValueError(
                'calibrate and gyro.loss_policy = "rate_state" do not go together: with the rate as a state there is no '
                "gyro to calibrate in a loss; choose another loss_policy"
            )
        return self

    @property
    def time_offsets(self) -> TimeOffsets:
        """What reading a telemetry has to add to its stamps."""
        return TimeOffsets(self.gyro.time_offset_s, self.star.time_offset_s)

    def formats(self, folder: Path | None = None) -> FormatSettings:
        """What the readers of other formats need; relative file names may be meant from `folder`."""
        return FormatSettings(self.gracefo, self.spice, folder)

    @field_validator("columns", mode="before")
    @classmethod
    def _one_or_several(cls, value: Any) -> Any:
        return [value] if isinstance(value, dict) else value


def load_sensors(path: Path | str | None) -> SensorsConfiguration:
    """Read and check a sensors.toml; without one everything has its default."""
    if path is None:
        return SensorsConfiguration()
    content = read_toml(path)
    try:
        return SensorsConfiguration.model_validate(content)
    except ValidationError as error:
        explained = explain(error, str(path), SensorsConfiguration)
        if isinstance(content.get("columns"), dict):  # written as one table, so name its keys so
            explained = ConfigurationError(str(explained).replace("columns[0]", "columns"))
        raise explained from None
