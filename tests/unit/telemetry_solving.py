"""A simulated record through the pipeline, within one process, and how its errors compare with its covariances."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from telemetry_simulator import ARCSEC, Setup, Simulated, sensors_toml, simulate, write

from helmstar.io.telemetry import Telemetry, read_telemetry
from helmstar.sensors.configuration import load_sensors
from helmstar.telemetry.command import result_of
from helmstar.telemetry.solve import Solution, solve


@dataclass(frozen=True)
class Solved:
    """A record with its truth, solved."""

    record: Simulated
    telemetry: Telemetry
    solution: Solution
    result: dict[str, Any]

    @property
    def time(self) -> np.ndarray:
        """True times (n,) of the estimates."""
        return self.solution.timeline.time + self.telemetry.origin.second

    def attitude_error(self, kind: str) -> np.ndarray:
        """(n, 3) rad in B of the "filtered" or "smoothed" estimates."""
        return self.record.attitude_error(self.time, getattr(self.solution, kind).q_BN)

    def attitude_nees(self, kind: str) -> np.ndarray:
        """(n,), three degrees of freedom."""
        return quadratic(self.attitude_error(kind), getattr(self.solution, kind).cov[:, :3, :3])

    def drift_nees(self, kind: str) -> np.ndarray:
        """(n,), three degrees of freedom."""
        e = getattr(self.solution, kind)
        return quadratic(self.record.drift(self.time) - e.drift, e.cov[:, 3:, 3:])

    def rms_arcsec(self, kind: str, after_s: float = 60.0) -> float:
        """Of the attitude error's length."""
        error = self.attitude_error(kind)[self.time > after_s]
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))) / ARCSEC)


def quadratic(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])


def solve_files(files: list[Path], toml: str | None = None, strict: bool = False) -> tuple[Telemetry, Solution, dict]:
    """As the command does, without writing anything; the result is checked to be JSON of finite numbers."""
    config = None
    if toml is not None:
        config = files[0].parent / "sensors.toml"
        config.write_text(toml)
    sensors = load_sensors(config)
    telemetry = read_telemetry(files, sensors.columns or None, strict=strict, offsets=sensors.time_offsets)
    solution = solve(telemetry, sensors, strict)
    result = result_of(solution, telemetry, files, "helmstar attitude")
    json.dumps(result, allow_nan=False)
    return telemetry, solution, result


def solve_record(
    record: Simulated,
    folder: Path,
    toml: str | None = None,
    *,
    kind: str = "csv",
    one: bool = False,
    strict: bool = False,
) -> Solved:
    """Written as tables, read and solved; `toml` None is no configuration at all."""
    files = [write(record.one_table(), folder / f"all.{kind}")] if one else record.write(folder, kind)
    return Solved(record, *solve_files(files, toml, strict))


def solve_setup(setup: Setup, folder: Path, **extra: str) -> Solved:
    """Simulated, and solved with the true noise and conventions in sensors.toml."""
    return solve_record(simulate(setup), folder, sensors_toml(setup, **extra))
