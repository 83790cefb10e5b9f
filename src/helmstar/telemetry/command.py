"""`helmstar attitude`: from files to filtered and smoothed attitude, drift, tables and a report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..core import ACCEPTED, FORCED, GATED, REOPENED, RESET
from ..errors import ConfigurationError, DataError
from ..files import replacing, write_atomically
from ..io.clock import Instants, Origin
from ..io.screening import find_gaps
from ..io.telemetry import AttitudeRows, GyroRows, Telemetry, read_telemetry
from ..sensors.configuration import SensorsConfiguration, load_sensors
from ..units import ARCSEC
from ..versions import versions
from .calibration import NAMES as CALIBRATED_NAMES
from .estimate import Estimates
from .export import check_export, write_exports
from .solve import FROM_ATTITUDES, Solution, solve

STATUS = {ACCEPTED: "accepted", GATED: "gated", REOPENED: "reopened", FORCED: "forced", RESET: "restarted"}


def _times(t: np.ndarray, origin: Origin) -> np.ndarray:
    """Times of the output: s since the origin for absolute clocks, else the files' own."""
    return t if origin.absolute else t + origin.second


def estimates_table(solution: Solution, estimates: Estimates, origin: Origin) -> pd.DataFrame:
    """One row for each instant: time, attitude, drift, sigmas, and the covariance's upper triangle (rad, rad/s)."""
    t = solution.timeline.time
    columns: dict[str, Any] = {"time_s": _times(t, origin)}
    if origin.absolute:
        columns["time_utc"] = origin.utc(t)
    columns |= {f"q_bn_{a}": estimates.q_BN[:, i] for i, a in enumerate("xyzw")}
    sigma = np.sqrt(np.maximum(np.diagonal(estimates.cov, axis1=1, axis2=2), 0.0)) / ARCSEC
    columns |= {f"sigma_attitude_{a}_arcsec": sigma[:, i] for i, a in enumerate("xyz")}
    if estimates.rate is not None and estimates.rate_sigma is not None:
        columns |= {f"rate_{a}_deg_s": np.degrees(estimates.rate[:, i]) for i, a in enumerate("xyz")}
        columns |= {f"sigma_rate_{a}_deg_s": np.degrees(estimates.rate_sigma[:, i]) for i, a in enumerate("xyz")}
    known = 6 if len(solution.gyro) else 3  # without a gyro there is no drift
    if known == 6:
        columns |= {f"drift_{a}_arcsec_s": estimates.drift[:, i] / ARCSEC for i, a in enumerate("xyz")}
        columns |= {f"sigma_drift_{a}_arcsec_s": sigma[:, 3 + i] for i, a in enumerate("xyz")}
    if estimates.calibration is not None and estimates.calibration_sigma is not None:
        for i, name in enumerate(CALIBRATED_NAMES):
            unit, column = (ARCSEC, f"{name}_arcsec") if i < 3 else (1e-6, f"{name}_ppm")
            columns[column] = estimates.calibration[:, i] / unit
            columns[f"sigma_{column}"] = estimates.calibration_sigma[:, i] / unit
    names = ["theta_x", "theta_y", "theta_z", "b_x", "b_y", "b_z"]
    columns |= {f"cov_{names[i]}_{names[j]}": estimates.cov[:, i, j] for i in range(known) for j in range(i, known)}
    return pd.DataFrame(columns)


def updates_table(solution: Solution, origin: Origin) -> pd.DataFrame:
    """One row for each star epoch after the first."""
    u = solution.updates
    t = solution.timeline.time[u.index]
    columns: dict[str, Any] = {"time_s": _times(t, origin), "nis": u.nis, "nis_dof": u.dof}
    columns["status"] = [STATUS[int(s)] for s in u.status]
    columns |= {f"residual_{a}_arcsec": u.residual[:, i] / ARCSEC for i, a in enumerate("xyz")}
    columns |= {f"residual_sigma_{a}_arcsec": u.sigma[:, i] / ARCSEC for i, a in enumerate("xyz")}
    return pd.DataFrame(columns)


def _finite(x: Any) -> float | None:
    return float(x) if np.isfinite(x) else None


def _consistency(solution: Solution) -> dict[str, Any]:
    """Mean NIS of the measurements that were used, its degrees of freedom, and the band that it should lie in."""
    from scipy.special import gammaincinv

    u = solution.updates
    used = u.status == ACCEPTED
    if solution.sources.get("drift", FROM_ATTITUDES) == FROM_ATTITUDES and len(used):
        used = used & (np.arange(len(used)) > 0)  # the first one's residual went into the start
    nis, dof = u.nis[used], u.dof[used]
    if not len(nis):
        return {"nis_mean": None, "nis_dof_mean": None, "nis_band": [None, None]}
    band = 2.0 * gammaincinv(0.5 * float(dof.sum()), [0.025, 0.975]) / len(nis)
    return {
        "nis_mean": _finite(nis.mean()),
        "nis_dof_mean": _finite(dof.mean()),
        "nis_band": [_finite(b) for b in band],
    }


def _noise(solution: Solution) -> dict[str, Any]:
    """What the filter assumed, where it comes from, and how well the data tell what they had to tell."""
    s, levels = solution, solution.levels
    if s.epochs.directions:
        star_sigma = np.full(3, levels.sigma)
    else:
        variance = np.diagonal(s.epochs.shape, axis1=1, axis2=2)
        star_sigma = np.sqrt(np.median(variance, axis=0)) * levels.sigma

    def entry(value: Any, name: str) -> dict[str, Any]:
        out = {"value": value, "source": s.sources[name]}
        if name in levels.uncertainty:
            out["relative_sigma"] = _finite(levels.uncertainty[name])
        return out

    star = {"star_sigma_arcsec": entry([float(v) for v in star_sigma / ARCSEC], "sigma")}
    if s.rate_sigma is not None:
        return {"rate_sigma_deg_s_sqrt_s": entry(float(np.degrees(s.rate_sigma)), "rate_sigma"), **star}
    return {
        "arw_arcsec_sqrt_s": entry(levels.sigma_v / ARCSEC, "sigma_v"),
        "rrw_arcsec_s_sqrt_s": entry(levels.sigma_u / ARCSEC, "sigma_u"),
        **star,
        "initial_drift_arcsec_s": entry([float(v) for v in s.start.drift / ARCSEC], "drift"),
        "initial_drift_sigma_arcsec_s": entry([float(v) for v in s.start.drift_sigma / ARCSEC], "drift_sigma"),
    }


def _calibration(solution: Solution) -> dict[str, Any]:
    """Misalignment and scale factors at the end, their sigma, what the record allows, and which of them it shows."""
    c, e = solution.calibration, solution.filtered
    if c is None or e.calibration is None or e.calibration_sigma is None:
        return {}

    def three(values: Any, part: slice, unit: float) -> list[float | None]:
        return [
            _finite(v) if asked > 0.0 else None for v, asked in zip(values[part] / unit, c.prior[part], strict=True)
        ]

    out: dict[str, Any] = {}
    for name, part, unit in (("misalignment_arcsec", slice(0, 3), ARCSEC), ("scale_factor_ppm", slice(3, 6), 1e-6)):
        if not c.prior[part].any():
            continue
        shown = c.observable[part]
        out[name] = {
            "value": [v if ok else None for v, ok in zip(three(e.calibration[-1], part, unit), shown, strict=True)],
            "sigma": [
                v if ok else None for v, ok in zip(three(e.calibration_sigma[-1], part, unit), shown, strict=True)
            ],
            "sigma_before": three(c.prior, part, unit),
            "bound": three(c.bound, part, unit),
            "observable": [bool(v) for v in shown],
        }
    return {"calibration": out}


def _rate(solution: Solution) -> dict[str, Any]:
    """The body's rate at the end, where it is a state."""
    e = solution.filtered
    if e.rate is None or e.rate_sigma is None:
        return {}
    value, sigma = np.degrees(e.rate[-1]), np.degrees(e.rate_sigma[-1])
    return {"rate_deg_s": [float(v) for v in value], "rate_sigma_deg_s": [float(v) for v in sigma]}


def result_of(solution: Solution, telemetry: Telemetry, files: Sequence[Path], command: str) -> dict[str, Any]:
    """The object of `--json`: finite numbers, nulls, strings."""
    s = solution
    origin = telemetry.origin
    zero = 0.0 if origin.absolute else origin.second
    sigma = np.sqrt(np.maximum(np.diagonal(s.filtered.cov[-1]), 0.0))
    gaps = [
        {"what": what, "start_s": g.start + zero, "end_s": g.end + zero, "duration_s": g.duration}
        for what, time in (("gyro", s.gyro.time), ("star", s.epochs.time[s.used]))
        for g in find_gaps(time)
    ]
    return {
        "files": [str(f) for f in files],
        "clock": telemetry.clock,
        "origin": str(origin),
        "duration_s": float(s.timeline.time[-1] - s.timeline.time[0]),
        "rows": {
            "gyro": len(telemetry.gyro),
            "star_epochs": len(s.epochs),
            "estimates": len(s.timeline.time),
            "gyro_before_start": int(np.sum(s.gyro.time < s.timeline.time[0])),
        },
        "updates": len(s.updates.nis),
        "drift_arcsec_s": [float(v) for v in s.filtered.drift[-1] / ARCSEC] if len(s.gyro) else None,
        "drift_sigma_arcsec_s": [float(v) for v in sigma[3:] / ARCSEC] if len(s.gyro) else None,
        **_rate(s),
        "attitude_sigma_arcsec": [float(v) for v in sigma[:3] / ARCSEC],
        "q_bn": [float(v) for v in s.filtered.q_BN[-1]],
        **_calibration(s),
        **_consistency(s),
        "restarts": int(np.sum(s.updates.status == RESET)),
        "gate_limit": _finite(np.asarray(s.gate.limits)[3]),
        "rows_rejected": sum(p.rows for p in s.problems if p.action == "dropped"),
        "gaps": gaps,
        "problems": [asdict(p) for p in s.problems],
        "noise": _noise(s),
        "command": command,
        "versions": versions(),
    }


def _read(
    files: Sequence[Path], sensors: SensorsConfiguration, config: Path | None, strict: bool, optics: Any
) -> tuple[Telemetry, dict[str, Any]]:
    """The rows of all files, and what the result says of frames, if there is a folder of them."""
    folders = [f for f in files if f.is_dir()]
    if len(folders) > 1:
        raise ConfigurationError(f"{', '.join(map(str, folders))}: give one folder of frames")
    if optics is not None and (optics.fov is not None or optics.camera is not None) and not folders:
        raise ConfigurationError("--fov, --camera: these are of star images, but no folder of frames is given")
    tables = [f for f in files if not f.is_dir()]
    telemetry = None
    if tables:
        telemetry = read_telemetry(
            tables, sensors.columns or None, strict=strict, offsets=sensors.time_offsets,
            settings=sensors.formats(None if config is None else Path(config).parent),
            needs=("gyro",) if folders else ("gyro", "star"),
        )  # fmt: skip
        if not folders:
            return telemetry, {}
        if len(telemetry.attitude) or telemetry.directions is not None:
            raise DataError(
                f"{', '.join(map(str, tables))}: has attitudes or stars beside the frames of {folders[0]}; give one of them"
            )
    return _with_frames(folders[0], telemetry, sensors, optics)


def _with_frames(
    folder: Path, telemetry: Telemetry | None, sensors: SensorsConfiguration, optics: Any
) -> tuple[Telemetry, dict[str, Any]]:
    """Telemetry with the attitudes that the frames of a folder show, turned into the body by the mounting."""
    from scipy.spatial.transform import Rotation

    from ..startracker.command import SolveOptions
    from ..startracker.frames import solve_frames

    solved = solve_frames(folder, optics or SolveOptions())
    if not len(solved.row):
        why = next((p for p in solved.problems), None)
        raise DataError(
            f"{folder}: none of {len(solved.entries)} frames is solved" + (f"; for one, {why}" if why else "")
        )
    if telemetry is not None and telemetry.origin.absolute != solved.instants.absolute:
        kinds = ("plain seconds", "dates")
        raise DataError(
            f"{solved.source} has {kinds[solved.instants.absolute]}, but the gyro {kinds[telemetry.origin.absolute]}: how they "
            "fit together is not known; give both a clock of the same kind"
        )
    origin = solved.instants.earliest() if telemetry is None else telemetry.origin
    R_BS = sensors.star.R_SB.T
    q_BN = (Rotation.from_matrix(R_BS) * Rotation.from_quat(solved.q_SN)).as_quat()
    n = len(solved.row)
    rows = AttitudeRows(
        solved.instants.since(origin) + sensors.time_offsets.star, np.zeros(n, dtype=np.int64), solved.row,
        (solved.source,), q_BN, R_BS @ solved.covariance_S @ R_BS.T,
    )  # fmt: skip
    gyro = (
        GyroRows(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
        if telemetry is None
        else telemetry.gyro
    )
    clock = f"seconds since {origin}, from {solved.source}" if telemetry is None else telemetry.clock
    problems = (*(() if telemetry is None else telemetry.problems), *solved.problems)
    whole = Telemetry(gyro, rows, None, problems, clock, origin, sensors.time_offsets)
    return whole, {"frames": _frames(solved.entries, solved.instants)}


def _frames(entries: Sequence[dict[str, Any]], instants: Instants) -> dict[str, Any]:
    """What became of the frames: counts by status, and each one's figures."""
    counts: dict[str, int] = {}
    for e in entries:
        counts[e["status"]] = counts.get(e["status"], 0) + 1
    keys = (
        "file",
        "time_s",
        "status",
        "message",
        "ra_deg",
        "dec_deg",
        "roll_deg",
        "sigma_arcsec",
        "stars",
        "residual_rms_arcsec",
    )
    each = [{k: e.get(k) for k in keys} | {"ms": (e.get("ms") or {}).get("total")} for e in entries]
    return {"total": len(entries), "status": counts, "each": each}


def run_attitude(
    files: Sequence[Path],
    *,
    config: Path | None,
    folder: Path,
    strict: bool,
    as_csv: bool,
    command: str,
    aem: bool = False,
    ck: bool = False,
    optics: Any = None,
) -> tuple[dict[str, Any], Path]:
    """The whole command: returns the object of `--json` and the report's path. `files` may hold one folder of star images, which
    `optics` (startracker.command.SolveOptions) says how to solve. Raises HelmstarError."""
    sensors = load_sensors(config)
    telemetry, images = _read(files, sensors, config, strict, optics)
    check_export(telemetry.origin, aem=aem, ck=ck, folder=folder)
    solution = solve(telemetry, sensors, strict, progress=True)
    result = result_of(solution, telemetry, files, command) | images
    if config is not None:
        result["sensors_toml"] = Path(config).read_text(encoding="utf-8", errors="replace")
    frames = {
        "filtered": estimates_table(solution, solution.filtered, telemetry.origin),
        "smoothed": estimates_table(solution, solution.smoothed, telemetry.origin),
        "updates": updates_table(solution, telemetry.origin),
    }
    folder.mkdir(parents=True, exist_ok=True)
    tables = {}
    for name, frame in frames.items():
        path = folder / f"{name}.{'csv' if as_csv else 'parquet'}"
        with replacing(path) as part, open(part, "wb") as stream:  # the library opens no name that is not UTF-8
            if as_csv:
                frame.to_csv(stream, index=False)
            else:
                frame.to_parquet(stream, index=False)
        tables[name] = str(path)
    result["tables"] = tables
    if aem or ck:
        result["exports"] = write_exports(solution, telemetry.origin, sensors, folder, aem=aem, ck=ck, command=command)
    from ..report.telemetry import write_telemetry_report

    report = write_telemetry_report(result, frames, folder / "report.html")
    write_atomically(folder / "summary.json", json.dumps(result, indent=2, allow_nan=False))
    return result, report
