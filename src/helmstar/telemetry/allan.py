"""`helmstar allan`: from gyro rows, at rest or in flight, to Allan deviation, noise parameters and a [gyro] table.

A rate in flight holds motion. Where the telemetry has attitudes, what is analysed is the gyro's turn between attitudes
minus theirs, whose noise then shows as white noise of the angle (quantisation); else the rates themselves, with a
warning where they clearly move. Missing single rows are filled; longer gaps split the record into stretches, which
are pooled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..evaluate.allan import AllanCurve, AllanFit, allan_deviation, fit_allan
from ..files import readable, write_atomically
from ..io.problems import refuse
from ..io.screening import find_gaps, screen_gyro
from ..io.telemetry import Telemetry, read_telemetry, to_rates
from ..sensors.configuration import (
    ARW_UNITS,
    BIAS_INSTABILITY_UNITS,
    RRW_UNITS,
    SensorsConfiguration,
    load_sensors,
)
from ..units import ARCSEC
from ..versions import versions
from .allan_series import Series, minus_attitude, regular_series

MOTION_SPREAD = 3.0


@dataclass(frozen=True)
class Axis:
    """One axis; `fit` is None where the rates do not vary."""

    curve: AllanCurve
    fit: AllanFit | None


# ----------------------------------------------------------------------------- a constant period


def analyse(series: Series, file: str) -> dict[str, Axis]:
    """Curve and fit of each axis. Raises DataError if no axis varies."""
    axes = {}
    for i, name in enumerate("xyz"):
        curve = allan_deviation([s[:, i] for s in series.stretches], series.period, instant=series.instant)
        size = max(float(np.abs(s[:, i]).max()) for s in series.stretches)
        varies = bool((curve.adev > max(1e-13 * size, 1e-100)).all())
        axes[name] = Axis(curve, fit_allan(curve) if varies else None)
    if all(axis.fit is None for axis in axes.values()):
        raise DataError(
            f"{file}: the gyro rates do not vary at all, so there is no noise to see; give raw rates, neither "
            "simulated without noise nor rounded"
        )
    return axes


def signs_of_motion(series: Series, axes: dict[str, Axis]) -> list[str]:
    """What in the rates is no gyro noise, in words."""
    found = []
    longest = max(series.stretches, key=len)
    for i, (name, axis) in enumerate(axes.items()):
        fit = axis.fit
        if fit is None:
            continue
        T, dt = len(longest) * series.period, series.period
        expected = (fit.arw or 0.0) ** 2 / dt + (fit.rrw or 0.0) ** 2 * T / 6.0
        expected += 2.0 * ((fit.quantisation or 0.0) / dt) ** 2
        expected += (fit.bias_instability or 0.0) ** 2 * math.log(max(len(longest), 2)) / math.pi
        spread = float(np.std(longest[:, i])) / math.sqrt(expected)
        red = (fit.rrw or 0.0) ** 2 * dt / 3.0 + 0.44 * (fit.bias_instability or 0.0) ** 2
        if fit.chance < 1e-3:
            found.append(
                f"axis {name}: the curve is not that of gyro noise (misfit {fit.misfit:.3g}, chance {fit.chance:.1g})"
            )
        if spread > MOTION_SPREAD:
            found.append(f"axis {name}: the rate spreads {spread:.3g} times as far as the fitted noise")
        if red > 0.5 * float(axis.curve.adev[0]) ** 2:
            found.append(f"axis {name}: even from sample to sample slow changes rule, not white noise")
    return found


# ----------------------------------------------------------------------------- the command


def run_allan(
    files: Sequence[Path], *, config: Path | None, folder: Path, strict: bool, command: str
) -> tuple[dict[str, Any], Path]:
    """The whole command: returns the object of `--json` and the report's path. Raises HelmstarError."""
    sensors = load_sensors(config)
    telemetry = read_telemetry(
        files, sensors.columns or None, strict=strict, needs=("gyro",), offsets=sensors.time_offsets,
        settings=sensors.formats(None if config is None else Path(config).parent),
    )  # fmt: skip
    file = ", ".join(str(f) for f in files)
    series, axes, basis, problems, gaps = _best_basis(telemetry, sensors, file, strict)
    if strict:
        refuse(problems)
    warnings = list(series.warnings)
    warnings += [f"axis {n}: the rates do not vary; it is left out" for n, axis in axes.items() if axis.fit is None]
    motion = signs_of_motion(series, axes)
    if motion and basis == "gyro":
        motion.append(
            "the rates hold motion of the body, or more than the modelled noise: the parameters are at most right at "
            "the shortest tau; use a record at rest, or give attitudes beside the gyro"
        )
    elif motion:
        motion.append("gyro and attitudes differ by more than the modelled noise (scale, timing, correlated noise)")
    result = _result(series, axes, basis, warnings + motion)
    zero = 0.0 if telemetry.origin.absolute else telemetry.origin.second
    result |= {
        "file": file,
        "files": [str(f) for f in files],
        "clock": telemetry.clock,
        "origin": str(telemetry.origin),
        "rows": {"gyro": len(telemetry.gyro), "attitude": len(telemetry.attitude)},
        "rows_rejected": int(sum(p.rows for p in problems if p.action == "dropped")),
        "problems": [asdict(p) for p in problems],
        "gaps": [
            {"what": "gyro", "start_s": g.start + zero, "end_s": g.end + zero, "duration_s": g.duration} for g in gaps
        ],
        "command": command,
        "versions": versions(),
    }
    result["sensors_toml"] = _sensors_toml(result, sensors)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "sensors.toml", result["sensors_toml"])
    write_atomically(folder / "allan.csv", _csv(axes))
    from ..report.allan import write_allan_report

    return result, Path(write_allan_report(result, folder / "report.html"))


def _best_basis(telemetry: Telemetry, sensors: SensorsConfiguration, file: str, strict: bool):
    """Series, axes, what they are of ("gyro" or "gyro minus attitude"), all problems, gaps of the gyro."""
    attitude = telemetry.attitude
    gyro, found = screen_gyro(telemetry.gyro, attitude, sensors.gyro.reading)
    problems = [*telemetry.problems, *found]
    if strict:
        refuse(problems)
    gaps = find_gaps(gyro.time)
    rates, reading = to_rates(gyro, sensors.gyro.reading)
    notes = []
    if telemetry.directions is not None and not len(attitude):
        notes.append("star directions are not used here; only whole attitudes take the motion out of the rates")
    if len(attitude) > 1 and len(rates) > 1:
        time, difference, duration, jumps = minus_attitude(rates, reading, attitude)
        try:
            series = regular_series(time, difference, duration, file)
        except DataError:
            notes.append(f"too few attitudes in a row ({len(attitude)} in all) to take the motion out of the rates")
        else:
            axes = analyse(series, file)
            problems += jumps
            if all(axis.fit is None or axis.fit.arw is not None for axis in axes.values()):
                return series, axes, "gyro minus attitude", problems, gaps
            alone = regular_series(rates.time, rates.value, None if reading == "instant" else rates.step, file)
            axes_alone = analyse(alone, file)
            seen = all(axis.fit is None or axis.fit.arw is not None for axis in axes_alone.values())
            if not seen or signs_of_motion(alone, axes_alone):
                return series, axes, "gyro minus attitude", problems, gaps
            series, axes = alone, axes_alone
            series.how.append("attitudes not used: their noise hides the gyro's, and the rates show no motion")
            return series, axes, "gyro", problems, gaps
    series = regular_series(rates.time, rates.value, None if reading == "instant" else rates.step, file)
    series.warnings.extend(notes)
    return series, analyse(series, file), "gyro", problems, gaps


def _in(value: float | None, unit: float) -> float | None:
    return None if value is None else value / unit


def _pooled(axes: dict[str, Axis], name: str) -> float | None:
    """Root mean square over the axes that show it."""
    values = [getattr(axis.fit, name) for axis in axes.values() if axis.fit is not None]
    shown = [v for v in values if v is not None]
    return math.sqrt(sum(v * v for v in shown) / len(shown)) if shown else None


def _result(series: Series, axes: dict[str, Axis], basis: str, warnings: list[str]) -> dict[str, Any]:
    """What the analysis found, in units of data sheets: finite numbers, None, text."""
    arw, rrw = ARW_UNITS["arw_arcsec_sqrt_s"], RRW_UNITS["rrw_arcsec_s_sqrt_s"]
    shown = {}
    for name, axis in axes.items():
        c, f = axis.curve, axis.fit
        one: dict[str, Any] = {
            "tau_s": c.tau_s.tolist(),
            "adev_arcsec_s": (c.adev / ARCSEC).tolist(),
            "adev_error_arcsec_s": (c.error / ARCSEC).tolist(),
            "fit_arcsec_s": [0.0] * len(c.tau_s) if f is None else (f.model / ARCSEC).tolist(),
            "degrees_of_freedom": c.edf.tolist(),
        }
        for key, attribute, unit in (
            ("arw{}_arcsec_sqrt_s", "arw{}", arw),
            ("rrw{}_arcsec_s_sqrt_s", "rrw{}", rrw),
            ("bias_instability{}_arcsec_s", "bias_instability{}", ARCSEC),
            ("quantisation{}_arcsec", "quantisation{}", ARCSEC),
        ):
            for suffix in ("", "_error"):
                one[key.format(suffix)] = _in(getattr(f, attribute.format(suffix), None), unit)
        one["arw_limit_arcsec_sqrt_s"] = _in(getattr(f, "arw_limit", None), arw)
        one["rrw_limit_arcsec_s_sqrt_s"] = _in(getattr(f, "rrw_limit", None), rrw)
        one["misfit"] = None if f is None else f.misfit
        shown[name] = one
    pooled = {name: _pooled(axes, name) for name in ("arw", "rrw", "bias_instability", "quantisation")}
    if pooled["arw"] is None:
        other = "noise of the attitudes or slow changes" if basis != "gyro" else "quantisation or slow changes"
        warnings = [*warnings, f"no angle random walk is seen: {other} cover it; only its upper limit is known"]
    return {
        "axes": shown,
        "arw_arcsec_sqrt_s": _in(pooled["arw"], arw),
        "arw_deg_sqrt_h": _in(pooled["arw"], ARW_UNITS["arw_deg_sqrt_h"]),
        "rrw_arcsec_s_sqrt_s": _in(pooled["rrw"], rrw),
        "rrw_deg_h_sqrt_h": _in(pooled["rrw"], RRW_UNITS["rrw_deg_h_sqrt_h"]),
        "bias_instability_arcsec_s": _in(pooled["bias_instability"], ARCSEC),
        "bias_instability_deg_h": _in(pooled["bias_instability"], BIAS_INSTABILITY_UNITS["bias_instability_deg_h"]),
        "quantisation_arcsec": _in(pooled["quantisation"], ARCSEC),
        "basis": basis,
        "sampling": series.how,
        "samples": series.samples,
        "stretches": [len(s) for s in series.stretches],
        "period_s": series.period,
        "warnings": warnings,
    }


def _sensors_toml(result: dict[str, Any], sensors: SensorsConfiguration) -> str:
    """A [gyro] table; what the data do not show stays a comment."""

    def text(value: float | None, error: float | None, limit: float | None = None) -> str:
        if value is None:
            return "not seen" + ("" if limit is None else f", below {limit:.3g}")
        return f"{value:.5g}" + ("" if error is None else f" +- {error:.2g}")

    def plain(words: object) -> str:  # a file name may hold anything, and a comment ends with its line
        return "".join(c if c.isprintable() else "?" for c in readable(str(words)))

    lines = [
        f"# helmstar allan, from {plain(result['file'])}: {result['samples']} samples of {result['basis']}, every "
        f"{result['period_s']:.6g} s",
    ]
    lines += [f"# warning: {plain(w)}" for w in result["warnings"]]
    for name, axis in result["axes"].items():
        arw = text(axis["arw_arcsec_sqrt_s"], axis["arw_error_arcsec_sqrt_s"], axis["arw_limit_arcsec_sqrt_s"])
        rrw = text(axis["rrw_arcsec_s_sqrt_s"], axis["rrw_error_arcsec_s_sqrt_s"], axis["rrw_limit_arcsec_s_sqrt_s"])
        floor = text(axis["bias_instability_arcsec_s"], axis["bias_instability_error_arcsec_s"])
        lines.append(f"# {name}: arw {arw} arcsec/sqrt(s); rrw {rrw} arcsec/s/sqrt(s)")
        lines.append(f"#    bias instability {floor}{'' if floor == 'not seen' else ' arcsec/s'}")
    lines.append("# below: root mean square over the axes that show it")
    lines.append("[gyro]")
    if sensors.gyro.reading != "instant":
        lines.append(f'reading = "{sensors.gyro.reading}"')
    for key in ("arw_arcsec_sqrt_s", "rrw_arcsec_s_sqrt_s", "bias_instability_arcsec_s"):
        value = result[key]
        lines.append(f"# {key}: not seen in these data" if value is None else f"{key} = {value:.6e}")
    return "\n".join(lines) + "\n"


def _csv(axes: dict[str, Axis]) -> str:
    names = list(axes)
    columns = [f"{what}_{n}_arcsec_s" for n in names for what in ("adev", "adev_error", "fit")]
    lines = [",".join(["tau_s", "squares", *columns])]
    first = axes[names[0]].curve
    for k, tau in enumerate(first.tau_s):
        cells = [f"{tau:.9g}", str(int(first.n[k]))]
        for axis in axes.values():
            fit = "" if axis.fit is None else f"{axis.fit.model[k] / ARCSEC:.9g}"
            cells += [f"{axis.curve.adev[k] / ARCSEC:.9g}", f"{axis.curve.error[k] / ARCSEC:.9g}", fit]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"
