"""`helmstar allan`: from gyro rows, at rest or in flight, to Allan deviation, noise parameters and a [gyro] table.

A rate in flight holds motion. Where the telemetry has attitudes, what is analysed is the gyro's turn between attitudes
minus theirs, whose noise then shows as white noise of the angle (quantisation); else the rates themselves, with a
warning where they clearly move. Missing single rows are filled; longer gaps split the record into stretches, which
are pooled.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..evaluate.allan import LEAST_SAMPLES, AllanCurve, AllanFit, allan_deviation, fit_allan
from ..io.problems import Problem, refuse
from ..io.screening import GAP_FACTOR, find_gaps, screen_gyro
from ..io.telemetry import AttitudeRows, GyroRows, Telemetry, read_telemetry, to_rates
from ..sensors.configuration import (
    ARCSEC,
    ARW_UNITS,
    BIAS_INSTABILITY_UNITS,
    RRW_UNITS,
    SensorsConfiguration,
    load_sensors,
)
from ..versions import versions
from .rates import rate_signal

JITTER = 0.2  # of a period; within it samples count as regular
ODD_STEPS = 0.01  # so few steps that fit no period split the record; with more of them it has no period
MUCH_FILLED = 0.02
COARSER = (
    8  # an irregular series is resampled at so many median steps, where interpolating smooths 1/16 of the variance
)
ATTITUDE_JUMP = 12.0  # robust sigmas, to and fro, of an attitude that is wrong by itself
JUMPS_ARE_RARE = 0.02  # more of them are the nature of the data
MOTION_SPREAD = 3.0


@dataclass(frozen=True)
class Series:
    """Rates at a constant period: stretches (n_i, 3) in rad/s. `how` says in words how they came from the rows."""

    stretches: list[np.ndarray]
    period: float
    instant: bool
    how: list[str]
    warnings: list[str]

    @property
    def samples(self) -> int:
        """Of all stretches."""
        return sum(len(s) for s in self.stretches)


@dataclass(frozen=True)
class Axis:
    """One axis; `fit` is None where the rates do not vary."""

    curve: AllanCurve
    fit: AllanFit | None


# ----------------------------------------------------------------------------- a constant period


def regular_series(
    time: np.ndarray, rate: np.ndarray, covered: np.ndarray | None, file: str, least: int = LEAST_SAMPLES
) -> Series:
    """Rates (n, 3) at increasing times (n,) at a constant period.

    `covered` (n,) s: what each mean rate covers up to its time (NaN: since the row before); None if the rates are
    values at instants. Raises DataError where no stretch between gaps has `least` samples.
    """
    step = np.diff(time)
    if len(time) < least:
        raise DataError(
            f"{file}: {len(time)} usable samples; an Allan deviation needs at least {least} in a row, and for a rate "
            "random walk thousands. Give a longer record"
        )
    period = float(np.median(step))
    count = np.maximum(np.rint(step / period), 1.0)
    gap = step > GAP_FACTOR * period
    odd = ~gap & (np.abs(step / period - count) > JITTER)
    regular = odd.sum() <= ODD_STEPS * len(step)
    pieces = np.split(np.arange(len(time)), np.flatnonzero(gap | odd if regular else gap) + 1)
    pieces = [p for p in pieces if len(p) >= 2]
    how, warnings, filled = [], [], 0
    if regular:
        places = [count[p[:-1]] for p in pieces]
        span = sum(time[p[-1]] - time[p[0]] for p in pieces)
        period = float(span / sum(c.sum() for c in places))
        stretches = []
        for piece, counts in zip(pieces, places):
            at = np.concatenate([[0], np.cumsum(counts)]).astype(int)
            whole = np.arange(at[-1] + 1)
            values = np.stack([np.interp(whole, at, rate[piece, i]) for i in range(3)], axis=1)
            if covered is not None:  # a mean over several periods is the mean in each of them
                after = np.searchsorted(at, whole)
                long = ~(covered[piece] < 1.5 * period)
                long[0] = False
                values = np.where(long[after][:, None], rate[piece][after], values)
            filled += len(whole) - len(piece)
            stretches.append(values)
        jitter = max(float(np.abs(np.diff(time[p]) / period - c).max()) for p, c in zip(pieces, places))
        how.append(f"regular: steps within {100 * jitter:.2g}% of the period")
        if odd.any():
            how.append(f"split at {int(odd.sum())} steps that are no multiple of the period, as at gaps")
        if filled:
            total = sum(len(s) for s in stretches)
            how.append(f"{filled} missing rows filled")
            if filled > MUCH_FILLED * total:
                warnings.append(
                    f"{filled} of {total} samples were missing and filled from others: the shortest tau come out low"
                )
    else:
        period *= COARSER
        stretches = [_resample(time[p], rate[p], covered is None, period) for p in pieces]
        message = (
            f"the rows are not at a constant period: resampled to {period:.6g} s by linear interpolation of the "
            "integrated rate, which makes the shortest tau, and the angle random walk with it, up to 3% low"
        )
        how.append(message)
        warnings.append(message)
    used = [s for s in stretches if len(s) >= 2]
    longest = max((len(s) for s in used), default=0)
    if longest < least:
        raise DataError(
            f"{file}: the longest stretch without a gap has {longest} samples at a period of {period:.6g} s; at least "
            f"{least} are needed. Give a longer record, or one with fewer gaps (a gap is longer than 3 median steps)"
        )
    if len(stretches) > 1:
        how.append(f"{len(used)} uninterrupted stretches pooled by squares, {longest} samples in the longest")
    return Series(used, period, covered is None and regular, how, warnings)


def _resample(time: np.ndarray, rate: np.ndarray, instant: bool, period: float) -> np.ndarray:
    """Mean rates (k, 3) over periods from the first row on, from the linearly interpolated integral."""
    mean = 0.5 * (rate[1:] + rate[:-1]) if instant else rate[1:]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(mean * np.diff(time)[:, None], axis=0)])
    grid = time[0] + period * np.arange(int((time[-1] - time[0]) / period) + 1)
    on_grid = np.stack([np.interp(grid, time, angle[:, i]) for i in range(3)], axis=1)
    return (on_grid[1:] - on_grid[:-1]) / period


# ----------------------------------------------------------------------------- gyro minus attitude


def minus_attitude(
    gyro: GyroRows, reading: str, attitude: AttitudeRows
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Problem]]:
    """Gyro minus attitude: times (m,) at the end of each interval between attitudes, rates (m, 3), durations (m,).

    Intervals beyond the gyro rows or across a gap of either are left out; so is an attitude that jumps to and fro.
    """
    problems: list[Problem] = []
    for _ in range(3):
        start, rate, duration = _difference(gyro, reading, attitude)
        jump = _jumps(start, rate * duration[:, None], len(attitude))
        if not jump.any():
            break
        for i in np.flatnonzero(jump):
            message = "this attitude agrees with the gyro neither before nor after it"
            problems.append(Problem(attitude.files[attitude.file[i]], int(attitude.row[i]), "jump", message, "dropped"))
        attitude = attitude.select(~jump)
    else:
        start, rate, duration = _difference(gyro, reading, attitude)
    return attitude.time[start + 1], rate, duration, problems


def _difference(gyro: GyroRows, reading: str, attitude: AttitudeRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the attitude that begins each interval (m,), rates (m, 3), durations (m,)."""
    from scipy.spatial.transform import Rotation

    signal = rate_signal(gyro.time, gyro.value, gyro.step, "instant" if reading == "instant" else "mean_since_previous")
    t = attitude.time
    low, high = signal.start[0], signal.end[-1]
    gaps_from, gaps_to = signal.start[signal.gap], signal.end[signal.gap]
    duration = np.diff(t)
    usable = (t[:-1] >= low) & (t[1:] <= high) & (duration <= GAP_FACTOR * np.median(duration))
    usable &= np.searchsorted(gaps_from, t[1:], side="left") == np.searchsorted(gaps_to, t[:-1], side="right")
    start = np.flatnonzero(usable)
    if not len(start):
        return start, np.empty((0, 3)), np.empty(0)
    inside = t[(t >= low) & (t <= high)]
    grid = np.union1d(np.append(signal.start, high), inside)
    turn = Rotation.from_rotvec(-signal.mean_rates(grid) * np.diff(grid)[:, None]).as_quat()
    first, last = np.searchsorted(grid, t[start]), np.searchsorted(grid, t[start + 1])
    # Products of as many turns as lie in each interval, later ones on the left: pairs of pairs, padded by no turn.
    steps = int((last - first).max())
    at = first[:, None] + np.arange(steps)
    product = np.where((at < last[:, None])[..., None], turn[np.minimum(at, len(turn) - 1)], [0.0, 0.0, 0.0, 1.0])
    while product.shape[1] > 1:
        if product.shape[1] % 2:
            product = np.concatenate([product, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(start), 1, 4))], axis=1)
        later, earlier = product[:, 1::2], product[:, 0::2]
        both = Rotation.from_quat(later.reshape(-1, 4)) * Rotation.from_quat(earlier.reshape(-1, 4))
        product = both.as_quat().reshape(len(start), -1, 4)
    by_gyro = Rotation.from_quat(product[:, 0]) * Rotation.from_quat(attitude.q_BN[start])
    difference = (Rotation.from_quat(attitude.q_BN[start + 1]) * by_gyro.inv()).as_rotvec()
    return start, difference / duration[start][:, None], duration[start]


def _jumps(start: np.ndarray, angle: np.ndarray, count: int) -> np.ndarray:
    """Attitudes (count,) with a difference far out before them and the opposite after them."""
    jump = np.zeros(count, dtype=bool)
    if len(start) < 7:
        return jump
    off = angle - np.median(angle, axis=0)
    size = np.abs(off)
    sigma = np.maximum(np.median(size, axis=0) / 0.6745, np.quantile(size, 0.9, axis=0) / 1.6449)
    limit = ATTITUDE_JUMP * np.maximum(sigma, 1e-15)
    neighbours = np.diff(start) == 1
    before, after = off[:-1], off[1:]
    to_and_fro = (np.abs(before) > limit) & (np.abs(after) > limit) & (before * after < 0.0)
    to_and_fro &= np.abs(before + after) < 0.5 * np.abs(before)
    calm = np.abs(off) < 0.5 * limit  # before and after it; else it is the data's nature here
    to_and_fro[1:-1] &= calm[:-3] & calm[3:]
    jump[start[1:][to_and_fro.any(axis=1) & neighbours]] = True
    return jump if jump.mean() <= JUMPS_ARE_RARE else np.zeros(count, dtype=bool)


# ----------------------------------------------------------------------------- from series to parameters


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
    telemetry = read_telemetry(files, sensors.columns or None, strict=strict, needs=("gyro",))
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
    _replace(folder / "sensors.toml", result["sensors_toml"])
    _replace(folder / "allan.csv", _csv(axes))
    from ..report.allan import write_allan_report

    return result, Path(write_allan_report(result, folder / "report.html"))


def _best_basis(telemetry: Telemetry, sensors: SensorsConfiguration, file: str, strict: bool):
    """Series, axes, what they are of ("gyro" or "gyro minus attitude"), all problems, gaps of the gyro."""
    gyro = replace(telemetry.gyro, time=telemetry.gyro.time + sensors.gyro.time_offset_s)
    attitude = replace(telemetry.attitude, time=telemetry.attitude.time + sensors.star.time_offset_s)
    gyro, found = screen_gyro(gyro, attitude, sensors.gyro.reading)
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
        return "".join(c if c.isprintable() else "?" for c in str(words))

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


def _replace(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
