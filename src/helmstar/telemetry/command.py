"""`helmstar attitude`: from files to filtered and smoothed attitude, drift, tables and a report."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..core import ACCEPTED, GATED, REOPENED, Gate, chi_square_gate, no_gate
from ..errors import DataError
from ..evaluate import chi_square_band
from ..io.problems import Problem, refuse
from ..io.screening import find_gaps, screen_gyro
from ..io.telemetry import AttitudeRows, GyroRows, Telemetry, read_telemetry, to_rates
from ..progress import Progress
from ..sensors.configuration import SensorsConfiguration, load_sensors
from ..versions import versions
from .estimate import Estimates, Record, Start, Updates, filter_and_smooth
from .noise import NoiseLevels, estimate_noise
from .rates import RateSignal, rate_signal
from .start import DIFFUSE, agreeing_pair, drifts, integrate_between, intervals, pair_sigma
from .timeline import Epochs, Timeline, attitude_epochs, build_timeline, direction_epochs

ARCSEC = np.pi / 180.0 / 3600.0
STATUS = {ACCEPTED: "accepted", GATED: "gated", REOPENED: "reopened"}


@dataclass(frozen=True)
class Solution:
    """All that was estimated of one record."""

    timeline: Timeline
    epochs: Epochs
    filtered: Estimates
    smoothed: Estimates
    updates: Updates
    levels: NoiseLevels
    sources: dict[str, str]
    start: Start
    start_source: str
    problems: tuple[Problem, ...]
    gate: Gate


def solve(
    telemetry: Telemetry, sensors: SensorsConfiguration, strict: bool = False, progress: bool = False
) -> Solution:
    """Filter and smooth a record.

    Raises DataError when the rows do not suffice, or, with `strict`, when one of them is bad.
    """
    problems = list(telemetry.problems)
    with Progress(progress) as bar:
        task = bar.add("reading", 1)
        signal, epochs = _inputs(telemetry, sensors, problems)
        if strict:
            refuse(problems)
        bar.finish(task)
        task = bar.add("start and noise", 2)
        timeline, epochs, between, first = _begin(signal, epochs, problems)
        bar.advance(task)
        gate = _gate(sensors)
        levels, sources = _levels(sensors, epochs, between, gate)
        drift = drifts(between, epochs)
        sigma = pair_sigma(between, epochs, levels)
        start, start_source = _start(sensors, epochs, between, levels, drift[0], sigma[0])
        bar.finish(task)
        record = Record(timeline, epochs, levels, np.ones(len(epochs), dtype=bool))
        task = bar.add("filter and smoother", 2 * record.chunks)
        filtered, smoothed, updates = filter_and_smooth(record, start, gate, lambda: bar.advance(task))
        bar.finish(task)
    if not np.all(np.isfinite(filtered.cov[-1])):
        raise DataError("the filter did not stay finite; check the noise in sensors.toml against the data's units")
    problems += _refused(timeline, epochs, updates, gate)
    if strict:
        refuse(problems)
    return Solution(
        timeline, epochs, filtered, smoothed, updates, levels, sources, start, start_source, tuple(problems), gate
    )


def _inputs(telemetry: Telemetry, sensors: SensorsConfiguration, problems: list[Problem]) -> tuple[RateSignal, Epochs]:
    """Rate signal and star epochs on one clock, with bad gyro rows screened out."""
    gyro, attitude, directions = telemetry.gyro, telemetry.attitude, telemetry.directions
    gyro = replace(gyro, time=gyro.time + sensors.gyro.time_offset_s)
    attitude = replace(attitude, time=attitude.time + sensors.star.time_offset_s)
    if directions is not None:
        directions = replace(directions, time=directions.time + sensors.star.time_offset_s)
    if len(attitude):
        shape = sensors.star.covariance_B()
        epochs = attitude_epochs(attitude, np.eye(3) if shape is None else shape)
        arbiter = attitude
        if directions is not None:
            message = "star directions are not used beside whole attitudes"
            problems.append(
                Problem(directions.files[0], int(directions.row[0]), "unused", message, "not used", len(directions))
            )
    elif directions is not None:
        epochs = direction_epochs(directions)
        solved = np.isfinite(epochs.q_BN[:, 0])
        arbiter = AttitudeRows(
            epochs.time[solved], epochs.file[solved], epochs.row[solved], epochs.files, epochs.q_BN[solved]
        )
    else:
        raise DataError("no usable attitude or star row; give q_bn_x, _y, _z, _w or star_b_x ... with star_n_x ...")
    gyro, found = screen_gyro(gyro, arbiter, sensors.gyro.reading)
    problems += found
    if len(gyro) < 2:
        raise DataError(f"{_name(gyro)}: {len(gyro)} usable gyro rows; at least 2 are needed")
    rates, reading = to_rates(gyro, sensors.gyro.reading)
    if reading == "increment_rad":  # to_rates has turned them into means
        raise AssertionError
    return rate_signal(rates.time, rates.value, rates.step, reading), epochs


def _name(rows: GyroRows) -> str:
    return ", ".join(rows.files) or "telemetry"


def _begin(signal: RateSignal, epochs: Epochs, problems: list[Problem]):
    """Timeline from the first attitude that agrees with the gyro, what lies between epochs, and that epoch's number."""
    timeline, usable = build_timeline(signal, epochs)
    for i in np.flatnonzero(~usable):
        message = "no gyro row reaches this star measurement"
        problems.append(Problem(epochs.files[epochs.file[i]], int(epochs.row[i]), "no_gyro", message, "dropped"))
    solved = usable & np.isfinite(epochs.q_BN[:, 0])
    if solved.sum() < 2:
        low, high = signal.span
        raise DataError(
            f"{', '.join(epochs.files)}: {int(solved.sum())} attitudes within the gyro data ({low:.3f} to {high:.3f} s after "
            "the first row); at least 2 are needed. Do both tables use the same clock? See time_offset_s"
        )
    # A filter starts from a whole attitude.
    begin = int(np.flatnonzero(solved)[0])
    epochs, usable = epochs.select(np.arange(begin, len(epochs))), usable[begin:]
    timeline, _ = build_timeline(signal, epochs)
    between = integrate_between(timeline, epochs)
    drift = drifts(between, epochs)
    rough = np.zeros((len(drift), 3))
    pair = agreeing_pair(drift, rough) if len(drift) > 2 else 0
    if pair:
        first = int(between.epochs[pair])
        for i in range(first):
            message = "this attitude does not agree with the gyro and the attitudes that follow"
            problems.append(Problem(epochs.files[epochs.file[i]], int(epochs.row[i]), "jump", message, "dropped"))
        epochs = epochs.select(np.arange(first, len(epochs)))
        timeline, _ = build_timeline(signal, epochs)
        between = integrate_between(timeline, epochs)
    return timeline, epochs, between, begin


def _gate(sensors: SensorsConfiguration) -> Gate:
    f = sensors.filter
    return chi_square_gate(f.gate_probability, 256, f.reopen_after) if f.gate_probability > 0 else no_gate(256)


def _levels(
    sensors: SensorsConfiguration, epochs: Epochs, between: Any, gate: Gate
) -> tuple[NoiseLevels, dict[str, str]]:
    """Noise levels, and for each where it comes from."""
    known: dict[str, float] = {}
    if sensors.gyro.arw is not None:
        known["sigma_v"] = sensors.gyro.arw
    if sensors.gyro.rrw is not None:
        known["sigma_u"] = sensors.gyro.rrw
    sigma_S = sensors.star.sigma_S
    if sigma_S is not None:
        known["sigma"] = float(sigma_S[0]) if epochs.star_B is not None else 1.0
    drift = np.median(drifts(between, epochs), axis=0)
    levels = estimate_noise(intervals(between, epochs, drift), known, gate)
    return levels, {
        n: "sensors.toml" if n in known else "estimated from the data" for n in ("sigma_v", "sigma_u", "sigma")
    }


def _start(
    sensors: SensorsConfiguration,
    epochs: Epochs,
    between: Any,
    levels: NoiseLevels,
    drift: np.ndarray,
    sigma: np.ndarray,
) -> tuple[Start, str]:
    first = int(between.epochs[0])
    cov = epochs.shape[first] * levels.sigma**2
    given = sensors.gyro.initial_drift_sigma
    if given is not None:
        return Start(epochs.q_BN[first], cov, np.zeros(3), np.full(3, given)), "sensors.toml"
    return Start(epochs.q_BN[first], cov, drift, DIFFUSE * sigma), "first two attitudes minus the gyro"


def _refused(timeline: Timeline, epochs: Epochs, updates: Updates, gate: Gate) -> list[Problem]:
    """Measurements that the gate did not take."""
    limits = np.asarray(gate.limits)
    out = []
    for k in np.flatnonzero(updates.status != ACCEPTED):
        e = int(timeline.epoch[updates.index[k]])
        off = np.linalg.norm(updates.residual[k]) / ARCSEC
        where = f"{off:.4g} arcsec from what the gyro leads to, " if np.isfinite(off) else ""
        limit = limits[updates.dof[k]]
        message = f"a jump: {where}NIS {updates.nis[k]:.4g} over the gate's {limit:.4g}"
        out.append(Problem(epochs.files[epochs.file[e]], int(epochs.row[e]), "jump", message, "dropped"))
    return out


def estimates_table(solution: Solution, estimates: Estimates, origin: Any) -> pd.DataFrame:
    """One row for each instant: time, attitude, drift, sigmas, and the covariance's upper triangle (rad, rad/s)."""
    t = solution.timeline.time
    columns: dict[str, Any] = {"time_s": t if origin.absolute else t + origin.second}
    if origin.absolute:
        columns["time_utc"] = origin.utc(t)
    columns |= {f"q_bn_{a}": estimates.q_BN[:, i] for i, a in enumerate("xyzw")}
    sigma = np.sqrt(np.maximum(np.diagonal(estimates.cov, axis1=1, axis2=2), 0.0)) / ARCSEC
    columns |= {f"drift_{a}_arcsec_s": estimates.drift[:, i] / ARCSEC for i, a in enumerate("xyz")}
    columns |= {f"sigma_attitude_{a}_arcsec": sigma[:, i] for i, a in enumerate("xyz")}
    columns |= {f"sigma_drift_{a}_arcsec_s": sigma[:, 3 + i] for i, a in enumerate("xyz")}
    names = ["theta_x", "theta_y", "theta_z", "b_x", "b_y", "b_z"]
    columns |= {f"cov_{names[i]}_{names[j]}": estimates.cov[:, i, j] for i in range(6) for j in range(i, 6)}
    return pd.DataFrame(columns)


def updates_table(solution: Solution, origin: Any) -> pd.DataFrame:
    """One row for each star epoch after the first."""
    u = solution.updates
    t = solution.timeline.time[u.index]
    columns: dict[str, Any] = {"time_s": t if origin.absolute else t + origin.second, "nis": u.nis, "nis_dof": u.dof}
    columns["status"] = [STATUS[int(s)] for s in u.status]
    columns |= {f"residual_{a}_arcsec": u.residual[:, i] / ARCSEC for i, a in enumerate("xyz")}
    columns |= {f"residual_sigma_{a}_arcsec": u.sigma[:, i] / ARCSEC for i, a in enumerate("xyz")}
    return pd.DataFrame(columns)


def _finite(x: Any) -> float | None:
    return float(x) if np.isfinite(x) else None


def result_of(solution: Solution, telemetry: Telemetry, files: Sequence[Path], command: str) -> dict[str, Any]:
    """The object of `--json`: finite numbers, nulls, strings."""
    s, u = solution, solution.updates
    origin = telemetry.origin
    zero = 0.0 if origin.absolute else origin.second
    used = u.status == ACCEPTED
    if s.start_source != "sensors.toml" and len(used):
        used = used.copy()
        used[0] = False  # its residual went into the start
    nis = u.nis[used]
    dof = u.dof[used]
    sigma = np.sqrt(np.maximum(np.diagonal(s.filtered.cov[-1]), 0.0))
    gaps = [
        {"what": what, "start_s": g.start + zero, "end_s": g.end + zero, "duration_s": g.duration}
        for what, time in (("gyro", telemetry.gyro.time), ("star", s.epochs.time))
        for g in find_gaps(time)
    ]
    rejected = sum(p.rows for p in s.problems if p.action == "dropped")
    levels = s.levels
    star_sigma = (
        np.sqrt(np.diagonal(s.epochs.shape[0])) * levels.sigma if s.epochs.star_B is None else np.full(3, levels.sigma)
    )
    band = list(chi_square_band(int(round(dof.mean())), len(nis))) if len(nis) else [None, None]
    return {
        "files": [str(f) for f in files],
        "clock": telemetry.clock,
        "origin": str(origin),
        "duration_s": float(s.timeline.time[-1] - s.timeline.time[0]),
        "rows": {
            "gyro": len(telemetry.gyro),
            "star_epochs": len(s.epochs),
            "estimates": len(s.timeline.time),
            "gyro_before_start": int(np.sum(telemetry.gyro.time < s.timeline.time[0])),
        },
        "updates": len(u.nis),
        "drift_arcsec_s": [float(v) for v in s.filtered.drift[-1] / ARCSEC],
        "drift_sigma_arcsec_s": [float(v) for v in sigma[3:] / ARCSEC],
        "attitude_sigma_arcsec": [float(v) for v in sigma[:3] / ARCSEC],
        "q_bn": [float(v) for v in s.filtered.q_BN[-1]],
        "nis_mean": _finite(nis.mean()) if len(nis) else None,
        "nis_dof_mean": _finite(dof.mean()) if len(nis) else None,
        "nis_band": band,
        "gate_limit": _finite(np.asarray(s.gate.limits)[3]),
        "rows_rejected": int(rejected),
        "gaps": gaps,
        "problems": [asdict(p) for p in s.problems],
        "noise": {
            "arw_arcsec_sqrt_s": {"value": levels.sigma_v / ARCSEC, "source": s.sources["sigma_v"]},
            "rrw_arcsec_s_sqrt_s": {"value": levels.sigma_u / ARCSEC, "source": s.sources["sigma_u"]},
            "star_sigma_arcsec": {"value": [float(v) for v in star_sigma / ARCSEC], "source": s.sources["sigma"]},
            "initial_drift_arcsec_s": {"value": [float(v) for v in s.start.drift / ARCSEC], "source": s.start_source},
        },
        "command": command,
        "versions": versions(),
    }


def run_attitude(
    files: Sequence[Path], *, config: Path | None, folder: Path, strict: bool, as_csv: bool, command: str
) -> tuple[dict[str, Any], Path]:
    """The whole command: returns the object of `--json` and the report's path. Raises HelmstarError."""
    sensors = load_sensors(config)
    telemetry = read_telemetry(files, sensors.columns or None, strict=strict)
    solution = solve(telemetry, sensors, strict, progress=True)
    result = result_of(solution, telemetry, files, command)
    frames = {
        "filtered": estimates_table(solution, solution.filtered, telemetry.origin),
        "smoothed": estimates_table(solution, solution.smoothed, telemetry.origin),
        "updates": updates_table(solution, telemetry.origin),
    }
    folder.mkdir(parents=True, exist_ok=True)
    tables = {}
    for name, frame in frames.items():
        path = folder / f"{name}.{'csv' if as_csv else 'parquet'}"
        part = path.with_name(path.name + ".part")
        if as_csv:
            frame.to_csv(part, index=False)
        else:
            frame.to_parquet(part, index=False)
        os.replace(part, path)
        tables[name] = str(path)
    result["tables"] = tables
    from ..report.telemetry import write_telemetry_report

    report = write_telemetry_report(result, frames, folder / "report.html")
    (folder / "summary.json").write_text(json.dumps(result, indent=2, allow_nan=False), encoding="utf-8")
    return result, report
