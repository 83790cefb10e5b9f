"""Figures of filtered telemetry, each a plain dict of plotly's figure JSON: drift, rate, attitude, residuals, NIS.

`Clock` turns seconds into the axis: time since the first sample, in a unit that keeps the numbers short. Gaps are grey
stripes. Noisy series are thinned to their extremes, and refused rows are always drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import style
from .encode import envelope, extremes, sample, spread
from .style import axis, band, layout, line, on, stacked

AXES = ("x", "y", "z")
SMOOTH, NOISY, MARKS, SWINGS = 1500, 3000, 4000, 100
REFUSED = 2000  # at most so many refused rows are marked
GAPS = 200  # and so many gaps, the longest


@dataclass(frozen=True)
class Clock:
    """Time since `start` (s) in units of `scale` seconds."""

    start: float
    scale: float
    unit: str

    @classmethod
    def of(cls, time_s: np.ndarray) -> Clock:
        """A clock for these times."""
        finite = time_s[np.isfinite(time_s)]
        start, span = (float(finite.min()), float(np.ptp(finite))) if finite.size else (0.0, 0.0)
        for limit, scale, unit in ((600.0, 1.0, "s"), (7200.0, 60.0, "min"), (4 * 86400.0, 3600.0, "h")):
            if span <= limit:
                return cls(start, scale, unit)
        return cls(start, 86400.0, "days")

    def __call__(self, time_s: Any) -> np.ndarray:
        return (np.asarray(time_s, dtype=float) - self.start) / self.scale

    @property
    def title(self) -> str:
        """Title of the time axis."""
        return f"Time since start ({self.unit})"


def gap_shapes(gaps: Sequence[Mapping[str, Any]], clock: Clock) -> list[dict[str, Any]]:
    """A grey stripe for each gap, the longest first."""
    longest = sorted(gaps, key=lambda gap: -float(gap.get("duration_s") or 0.0))[:GAPS]
    return [
        {
            "type": "rect", "xref": "x", "x0": float(clock(gap["start_s"])), "x1": float(clock(gap["end_s"])),
            "yref": "paper", "y0": 0, "y1": 1, "fillcolor": style.faded(style.GREY, 0.2), "line": {"width": 0},
            "layer": "below",
        }
        for gap in longest
    ]  # fmt: skip


def vector(
    frames: Mapping[str, Any], clock: Clock, shapes: list[dict[str, Any]], name: str = "drift", unit: str = "arcsec/s"
) -> dict[str, Any]:
    """A vector per axis, filtered and smoothed, with 3 sigma bands: the gyro's drift, or the body's rate."""
    suffix = unit.replace("/", "_")
    traces: list[dict[str, Any]] = []
    views: dict[str, Any] = {"Settled": {}}
    for i, a in enumerate(AXES):
        place = {**on(i), **({} if i == 0 else {"showlegend": False})}
        settled: list[np.ndarray] = []
        for kind, colour, opacity in (("filtered", style.AMBER, 0.25), ("smoothed", style.BLUE, 0.35)):
            if kind not in frames:
                continue
            table = frames[kind]
            value, sigma = _column(table, f"{name}_{a}_{suffix}"), _column(table, f"sigma_{name}_{a}_{suffix}")
            index = extremes(value, SMOOTH)
            time, value, sigma = clock(_column(table, "time_s"))[index], value[index], sigma[index]
            traces += band(time, value - 3 * sigma, value + 3 * sigma, f"{kind}, 3σ", colour, opacity, **place)
            hover = f"%{{x:.5g}} {clock.unit}<br>{a} %{{y:.6g}} {unit}"
            traces.append(line(time, value, kind, colour, width=1.6, hover=hover, **place))
            late = slice(len(value) // 5, None)
            settled += [value[late] - 3 * sigma[late], value[late] + 3 * sigma[late]]
        finite = np.concatenate(settled) if settled else np.zeros(0)
        finite = finite[np.isfinite(finite)]
        if finite.size:
            low, high = float(finite.min()), float(finite.max())
            room = 0.08 * (high - low) or 1e-3
            views["Settled"]["yaxis" + ("" if i == 0 else str(i + 1)) + ".range"] = [low - room, high + room]
    axes = stacked(3, [f"{a} ({unit})" for a in AXES], clock.title, gap=0.04)
    return {"data": traces, "layout": layout({"views": {**views, "Whole": {}}}, shapes=shapes, **axes)}


def attitude_sigma(frames: Mapping[str, Any], clock: Clock, shapes: list[dict[str, Any]]) -> dict[str, Any]:
    """1 sigma of the attitude per axis over time, logarithmic: the line is the largest of a stretch, shaded the rest.

    Sigma grows between two star measurements and falls at each, thousands of times in a series.
    """
    traces: list[dict[str, Any]] = []
    shown = []
    for kind, dash in (("filtered", "dot"), ("smoothed", "solid")):
        if kind not in frames:
            continue
        time = clock(_column(frames[kind], "time_s"))
        for i, name in enumerate(AXES):
            index, low, high = envelope(_column(frames[kind], f"sigma_attitude_{name}_arcsec"), SWINGS)
            shown += [low, high]
            label, colour = f"{name} {kind}", style.AXIS_COLOURS[i]
            hover = f"%{{x:.5g}} {clock.unit}<br>up to %{{y:.4g}} arcsec"
            traces += band(time[index], low, high, label, colour, 0.15, showlegend=False)
            traces.append(line(time[index], high, label, colour, width=1.5, dash=dash, hover=hover))
    y_axis = style.log_axis("Attitude sigma (arcsec)", *shown)
    return {"data": traces, "layout": layout(shapes=shapes, xaxis=axis(clock.title), yaxis=y_axis)}


def residuals(updates: Any, clock: Clock, shapes: list[dict[str, Any]]) -> dict[str, Any]:
    """Attitude residuals per axis in B; with their predicted 3 sigma if `residual_sigma_x_arcsec`, ... are there."""
    traces: list[dict[str, Any]] = []
    time, status = clock(_column(updates, "time_s")), _status(updates)
    used, views = status != "gated", {"Used rows": {}}
    for i, name in enumerate(AXES):
        place = {**on(i), **({} if i == 0 else {"showlegend": False})}
        value = _column(updates, f"residual_{name}_arcsec")
        sigma = _column(updates, f"residual_sigma_{name}_arcsec")
        if np.isfinite(sigma).any():
            index = spread(len(sigma), SMOOTH, 0)
            limit = 3 * sigma[index]
            traces += band(time[index], -limit, limit, "3σ predicted", style.AMBER, 0.25, **place)
        rows = np.flatnonzero(used)
        rows = rows[sample(value[rows], MARKS)] if rows.size else rows
        unit = "arcsec"
        traces.append(_marks(time[rows], value[rows], "accepted", style.BLUE, "circle", 3, unit, clock, place))
        traces += _refused(time, value, status, unit, clock, place)
        usual = sigma[used & np.isfinite(sigma)]
        limits = style.nice_limit(value[used], 3 * np.median(usual) if usual.size else 0.0)
        if limits:
            views["Used rows"]["yaxis" + ("" if i == 0 else str(i + 1)) + ".range"] = [-limits, limits]
    axes = stacked(3, [f"{name} (arcsec)" for name in AXES], clock.title, gap=0.04)
    return {"data": traces, "layout": layout({"views": {**views, "Whole": {}}}, shapes=shapes, **axes)}


def nis(updates: Any, clock: Clock, shapes: list[dict[str, Any]], gate: np.ndarray | None) -> dict[str, Any]:
    """NIS over its degrees of freedom per update, its running mean with a 95% band, and the gate; logarithmic."""
    from .numbers import chi_square_ratio_band

    time, status = clock(_column(updates, "time_s")), _status(updates)
    dof = _column(updates, "nis_dof")
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.where(dof > 0, _column(updates, "nis") / dof, np.nan)
    value = np.where(value > 0, value, np.nan)
    used = np.flatnonzero((status != "gated") & np.isfinite(value))
    window = int(min(100, max(1, len(used) // 10)))
    traces: list[dict[str, Any]] = []
    rows = used[sample(value[used], MARKS)] if used.size else used
    traces.append(_marks(time[rows], value[rows], "accepted", style.SKY, "circle", 3, "NIS / dof", clock, {}))
    if used.size >= 2 * window and window > 1:
        sums = np.cumsum(np.concatenate([[0.0], value[used] * dof[used]]))
        weights = np.cumsum(np.concatenate([[0.0], dof[used]]))
        count = weights[window:] - weights[:-window]
        mean = (sums[window:] - sums[:-window]) / count
        middle = time[used][window // 2 : window // 2 + len(mean)]
        index = extremes(mean, NOISY)
        low, high = chi_square_ratio_band(count[index])
        traces += band(middle[index], low, high, f"95% band of {window} updates", style.GREEN, 0.35)
        hover = f"%{{x:.5g}} {clock.unit}<br>mean %{{y:.4g}}"
        traces.append(line(middle[index], mean[index], f"mean of {window}", style.INK, width=1.8, hover=hover))
    traces += _refused(time, value, status, "NIS / dof", clock, {})
    if gate is not None and len(time):
        index = spread(len(time), SMOOTH, 0)
        traces.append(line(time[index], gate[index], "gate", style.RED, width=1.5, dash="dash", hover="gate %{y:.4g}"))
    top = style.nice_limit(value, [10.0] if gate is None else 3 * gate, factor=1.5) or 10.0
    limits = [-2.0, float(np.log10(top))]  # far below 1 there is nothing to see
    y_axis = axis("NIS / dof (1 is right)", type="log", exponentformat="none", dtick=1, range=limits)
    return {"data": traces, "layout": layout(shapes=shapes, xaxis=axis(clock.title), yaxis=y_axis)}


def attitude(frames: Mapping[str, Any], clock: Clock, shapes: list[dict[str, Any]]) -> dict[str, Any]:
    """The attitude as a quaternion whose signs are continuous; q and -q are the same attitude."""
    from ..attitude import continuous

    kind = "smoothed" if "smoothed" in frames else "filtered"
    table = frames[kind]
    q = continuous(np.stack([_column(table, f"q_bn_{name}") for name in "xyzw"], axis=1))
    index = extremes(q.T, 2 * SMOOTH)
    time = clock(_column(table, "time_s"))[index]
    colours = (*style.AXIS_COLOURS, style.GREY)
    hover = f"%{{x:.5g}} {clock.unit}<br>%{{y:.6f}}"
    traces = [line(time, q[index, i], f"q {name}", colours[i], width=1.6, hover=hover) for i, name in enumerate("xyzw")]
    y_axis = axis(f"q_BN, {kind}", range=[-1.05, 1.05])
    return {"data": traces, "layout": layout(shapes=shapes, xaxis=axis(clock.title), yaxis=y_axis)}


def _refused(
    time: np.ndarray, value: np.ndarray, status: np.ndarray, unit: str, clock: Clock, place: Mapping[str, Any]
) -> list[dict[str, Any]]:
    traces = []
    for kind, name, colour, symbol in (
        ("gated", "refused by the gate", style.RED, "x"),
        ("reopened", "refused, gate reopened", style.VIOLET, "diamond"),
        ("forced", "used against the gate", style.VIOLET, "diamond-open"),
        ("restarted", "restarted from it", style.GREEN, "star"),
    ):
        rows = np.flatnonzero(status == kind)[:REFUSED]
        if rows.size:
            traces.append(_marks(time[rows], value[rows], name, colour, symbol, 8, unit, clock, place))
    return traces


def _marks(
    time: np.ndarray,
    value: np.ndarray,
    name: str,
    colour: str,
    symbol: str,
    size: int,
    unit: str,
    clock: Clock,
    place: Mapping[str, Any],
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "x": time,
        "y": value,
        "name": name,
        "legendgroup": name,
        "marker": {"color": colour, "symbol": symbol, "size": size, "opacity": 0.7 if size < 5 else 1.0},
        "hovertemplate": f"%{{x:.5g}} {clock.unit}<br>%{{y:.4g}} {unit}<extra>{name}</extra>",
        **place,
    }


def _column(table: Any, name: str) -> np.ndarray:
    if name not in table:
        return np.full(len(table), np.nan)
    value = np.asarray(table[name], dtype=float)
    return np.where(np.isfinite(value), value, np.nan)


def _status(updates: Any) -> np.ndarray:
    return np.asarray(updates["status"] if "status" in updates else ["accepted"] * len(updates), dtype=object)
