"""Figures of a campaign, each a plain dict of plotly's figure JSON (numpy arrays allowed), angles in degrees.

| function | shows |
|---|---|
| error_by_axis | error x, y, z of one estimator: band, quantiles, single runs, Cramer-Rao bound |
| error_total | its total angle, logarithmic |
| convergence | total angle, median over runs, of several estimators |
| consistency | NEES and NIS averaged over runs, with their chi-square bands |
| settling, settling_histogram | when the runs settle below each threshold |
| rotation_error, euler_view | one run as a paper plots it: rotation vector, and differences of Euler angles |
| bound_ratio, step_time | one mark per estimator |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import style
from .style import axis, band, estimator_style, layout, line, log_axis, on, stacked

FigureDict = dict[str, Any]
AXES = ("x", "y", "z")
UPDATE = "Update"
Singles = Mapping[str, tuple[np.ndarray, np.ndarray]]  # single runs by name: (update, values)


def late_part(update: np.ndarray) -> np.ndarray:
    """True from three tenths of the series on: what the view of the steady state is scaled by."""
    return update >= update[0] + 0.3 * np.ptp(update)


def error_by_axis(
    update: np.ndarray,
    low: np.ndarray,
    median: np.ndarray,
    high: np.ndarray,
    sigma: np.ndarray,
    bound: np.ndarray,
    name: str,
    singles: Singles,
) -> FigureDict:
    """Signed error per axis in degrees: low (5%), median, high (95%), sigma, bound and the singles are (time, 3)."""
    colour = estimator_style(name)[0]
    several = len(singles) != 1 or bool(np.any(low != high))
    traces: list[FigureDict] = []
    for i in range(3):
        place = {**on(i), **({} if i == 0 else {"showlegend": False})}
        hover = f"update %{{x}}<br>{AXES[i]} %{{y:.4g}} deg"
        traces += band(update, -3 * sigma[:, i], 3 * sigma[:, i], "3σ of the filter", style.AMBER, 0.18, **place)
        if several:
            traces += band(update, low[:, i], high[:, i], "5% to 95% of runs", colour, 0.28, **place)
        for j, (run, (at, values)) in enumerate(singles.items()):
            label = "single runs" if several else run
            more = {**place, **({"showlegend": False} if j else {})}
            traces.append(line(at, values[:, i], label, style.GREY, width=0.8, opacity=0.75, **more))
        if several:
            traces.append(line(update, median[:, i], "median", colour, width=2.2, hover=hover, **place))
        for sign in (1.0, -1.0):
            more = {**place, **({} if sign > 0 else {"showlegend": False})}
            edge = sign * 3 * bound[:, i]
            traces.append(line(update, edge, "3σ Cramér-Rao bound", style.RED, width=1.4, dash="dash", **more))
    late = late_part(update)
    runs = [values[at >= update[late][0]] for at, values in singles.values()]
    errors = style.nice_limit(low[late], high[late], 3 * bound[late], *runs)
    widest = style.nice_limit(3 * sigma[late])
    views: dict[str, Any] = {}
    note = ""
    if errors:
        views["Steady state"] = {f"{key}.range": [-errors, errors] for key in ("yaxis", "yaxis2", "yaxis3")}
        if widest and widest > 1.3 * errors:
            views["3σ band"] = {f"{key}.range": [-widest, widest] for key in ("yaxis", "yaxis2", "yaxis3")}
            note = f"The filter's own 3σ band is {widest / errors:.3g} times wider than the first view."
    views["Whole"] = {}
    axes = stacked(3, [f"{name_} (deg)" for name_ in AXES], UPDATE, gap=0.04)
    return {"data": traces, "layout": layout({"views": views, "note": note}, **axes)}


def error_total(
    update: np.ndarray,
    low: np.ndarray,
    median: np.ndarray,
    high: np.ndarray,
    sigma: np.ndarray,
    bound: np.ndarray,
    name: str,
    singles: Singles,
) -> FigureDict:
    """Total error angle (time,) in degrees; sigma and bound: what 99.7% of Gaussian errors of their size stay below."""
    colour = estimator_style(name)[0]
    several = len(singles) != 1 or bool(np.any(low != high))
    hover = "update %{x}<br>%{y:.4g} deg"
    traces = band(update, low, high, "5% to 95% of runs", colour, 0.28) if several else []
    for j, (run, (at, values)) in enumerate(singles.items()):
        label = "single runs" if several else run
        traces.append(line(at, values, label, style.GREY, width=0.8, opacity=0.75, showlegend=j == 0))
    if several:
        traces.append(line(update, median, "median", colour, width=2.2, hover=hover))
    traces.append(line(update, sigma, "99.7% by the filter", style.AMBER, dash="dot", hover=hover))
    traces.append(line(update, bound, "99.7% at the bound", style.RED, width=1.6, dash="dash", hover=hover))
    views = {
        "Logarithmic": {"yaxis.type": "log"},
        "Linear": {"yaxis.type": "linear", "yaxis.dtick": None, "yaxis.rangemode": "tozero"},
    }
    return {
        "data": traces,
        "layout": layout({"views": views}, xaxis=axis(UPDATE), yaxis=log_axis("Total error (deg)", low, high, bound)),
    }


def convergence(update: np.ndarray, medians: Mapping[str, np.ndarray], bound: np.ndarray) -> FigureDict:
    """Median total angle (deg) by estimator, and at the bound; staggered markers tell equal lines apart."""
    traces = []
    count, start = len(medians), min(150, int(update[-1]))
    marked_x = np.linspace(0, update[-1], 8)[1:]
    near = np.linspace(0, start, 7)[1:] if update[-1] > 2 * start else np.array([])
    for j, (name, median) in enumerate(medians.items()):
        colour, dash, symbol = estimator_style(name)
        shift = (j / max(count, 1) - 0.5) * (marked_x[0] if len(marked_x) else 0.0)
        near_shift = (j / max(count, 1) - 0.5) * (near[0] if len(near) else 0.0)
        points = np.concatenate([near + near_shift, marked_x[marked_x > 1.2 * start] + shift])
        if not len(near):
            points = marked_x + shift
        size = np.zeros(len(update))
        size[np.clip(np.searchsorted(update, points), 0, len(update) - 1)] = 8.0
        trace = line(update, median, name, colour, width=1.8, dash=dash, hover="update %{x}<br>%{y:.4g} deg")
        trace |= {"mode": "lines+markers", "marker": {"symbol": symbol, "size": size, "color": colour, "opacity": 1}}
        traces.append(trace)
    traces.append(line(update, bound, "median at the bound", style.INK, width=1.4, dash="dot", hover="%{y:.4g} deg"))
    views: dict[str, Any] = {"Whole": {"xaxis.autorange": True}}
    if update[-1] > 2 * start:
        views = {f"First {start} updates": {"xaxis.range": [0, start]}, **views}
    return {
        "data": traces,
        "layout": layout(
            {"views": views}, xaxis=axis(UPDATE), yaxis=log_axis("Median total error (deg)", bound, *medians.values())
        ),
    }


def consistency(
    update: np.ndarray,
    nees: np.ndarray,
    nees_band: tuple[np.ndarray, np.ndarray],
    nis: np.ndarray,
    nis_band: tuple[np.ndarray, np.ndarray],
    name: str,
    nees_dof: int = 3,
) -> FigureDict:
    """NEES and NIS averaged over runs, both divided by their degrees of freedom, so that 1 is right."""
    colour = estimator_style(name)[0]
    traces: list[FigureDict] = []
    for i, (values, limits) in enumerate(((nees, nees_band), (nis, nis_band))):
        place = {**on(i), **({} if i == 0 else {"showlegend": False})}
        traces += band(update, *limits, "95% band for this number of runs", style.GREEN, 0.3, **place)
        positive = np.where(values > 0.0, values, np.nan)
        hover = "update %{x}<br>%{y:.4g}"
        traces.append(line(update, positive, "mean over runs", colour, width=1.3, hover=hover, **place))
    axes = stacked(2, [f"NEES / {nees_dof}", "NIS / dof"], UPDATE, gap=0.08)
    linear, log = {}, {}
    for key, values, limits in (("yaxis", nees, nees_band), ("yaxis2", nis, nis_band)):
        most = style.nice_limit(limits[1], factor=1.8) or 2.0
        linear |= {f"{key}.range": [0, most]}
        log |= {f"{key}.type": "log", f"{key}.exponentformat": "e", f"{key}.nticks": 6}
        if not np.isfinite(values).any():
            axes[key] |= {"range": [0, most]}
    views = {"Near the band": linear, "Whole (log)": log}
    finite = nees[np.isfinite(nees)]
    middle = float(np.median(finite)) if finite.size else 1.0
    if not 0.3 < middle < 1.7:
        views = {"Whole (log)": log, "Near the band": linear}
    return {"data": traces, "layout": layout({"views": views}, **axes)}


def settling(settled: Mapping[str, Mapping[str, np.ndarray]]) -> FigureDict:
    """When the runs settle, by threshold, by estimator (updates, NaN for never): first to last run, and the median."""
    names = list(next(iter(settled.values())))
    traces: list[FigureDict] = []
    never = []
    for i, (threshold, by_name) in enumerate(settled.items()):
        ends: tuple[list, list, list, list, list] = ([], [], [], [], [])
        for row, name in enumerate(names):
            done = by_name[name][np.isfinite(by_name[name])]
            if not done.size:
                never.append(f"{name} ({threshold})")
                continue
            middle = float(np.median(done))
            y = row + (i - 0.5 * (len(settled) - 1)) * 0.36
            text = f"{done.size} of {len(by_name[name])} runs, {done.min():g} to {done.max():g}"
            for values, value in zip(ends, (middle, y, float(done.max()) - middle, middle - float(done.min()), text)):
                values.append(value)
        colour = (style.BLUE, style.ORANGE)[i % 2]
        traces.append({
            "type": "scatter",
            "mode": "markers",
            "name": f"below {threshold}",
            "x": ends[0],
            "y": ends[1],
            "error_x": {"type": "data", "symmetric": False, "array": ends[2], "arrayminus": ends[3], "width": 5,
                        "thickness": 2.5, "color": colour},
            "marker": {"color": colour, "symbol": style.AXIS_SYMBOLS[i % 2], "size": 9},
            "text": ends[4],
            "hovertemplate": f"below {threshold}: median %{{x}}<br>%{{text}}<extra></extra>",
        })  # fmt: skip
    note = f"No run settles: {', '.join(never)}." if never else ""
    labels = {"tickvals": list(range(len(names))), "ticktext": [style.wrapped(name) for name in names]}
    y_axis = axis("", range=[len(names) - 0.4, -0.6], **labels)
    x_axis = log_axis("Update at which a run settles", *[trace["x"] for trace in traces])
    return {"data": traces, "layout": layout({"note": note}, xaxis=x_axis, yaxis=y_axis)}


def settling_histogram(settled: Mapping[str, np.ndarray], last: float, name: str) -> FigureDict:
    """How many runs of one estimator settle when; `settled` by threshold ("1 deg"), in updates, NaN for never."""
    colours = (estimator_style(name)[0], style.AMBER)
    traces, notes = [], []
    everything = np.concatenate([values[np.isfinite(values)] for values in settled.values()] or [np.ones(0)])
    low, high = (float(everything.min()), float(everything.max())) if everything.size else (0.0, last)
    step = max(1.0, np.ceil((high - low + 1.0) / 40.0))
    edges = np.arange(low - 0.5, high + step + 0.5, step)
    for i, (threshold, values) in enumerate(settled.items()):
        finite = values[np.isfinite(values)]
        counts, _ = np.histogram(finite, edges)
        kept = np.flatnonzero(counts)
        traces.append(
            {
                "type": "bar",
                "x": edges[kept] + 0.5 * step,
                "y": counts[kept],
                "width": 0.45 * step,
                "offset": (-0.46 if i == 0 else 0.01) * step,
                "name": f"below {threshold}",
                "marker": {"color": style.faded(colours[i % 2], 0.75), "line": {"width": 0}},
                "hovertemplate": "update %{x}: %{y} runs<extra></extra>",
            }
        )
        notes.append(f"{finite.size} of {len(values)} runs settle below {threshold}")
    span = max(0.15 * (high - low), 8.0 * step)
    return {
        "data": traces,
        "layout": layout(
            {"note": "; ".join(notes) + "."},
            barmode="overlay",
            xaxis=axis("Update at which a run settles", range=[max(0.0, low - span), high + span]),
            yaxis=axis("Runs", rangemode="tozero"),
        ),
    }


def rotation_error(update: np.ndarray, error: np.ndarray, limit: float | None) -> FigureDict:
    """Rotation-vector error (time, 3) of one run in degrees, x, y and z in one plot; `limit` is the zoomed range."""
    return _three_lines(update, error, "Rotation-vector error (deg)", AXES, limit)


def euler_view(update: np.ndarray, difference: np.ndarray, limit: float | None) -> FigureDict:
    """The same run as differences of roll, pitch and yaw (time, 3) in degrees."""
    return _three_lines(update, difference, "Euler-angle difference (deg)", ("roll", "pitch", "yaw"), limit)


def _three_lines(
    update: np.ndarray, values: np.ndarray, title: str, names: Sequence[str], limit: float | None
) -> FigureDict:
    traces = [
        line(update, values[:, i], names[i], style.AXIS_COLOURS[i], width=1.5, hover="update %{x}<br>%{y:.4g} deg")
        for i in range(3)
    ]
    zoomed = {"yaxis.range": [-limit, limit]} if limit else {}
    own = style.nice_limit(values[late_part(update)])
    views = {"Same scale": zoomed, "Own scale": {"yaxis.range": [-own, own]} if own else {}, "Start-up": {}}
    return {"data": traces, "layout": layout({"views": views}, xaxis=axis(UPDATE), yaxis=axis(title))}


def bound_ratio(ratios: Mapping[str, Sequence[float | None]]) -> FigureDict:
    """RMS error over the Cramer-Rao bound per axis, one row of marks per estimator, 1 marked."""
    names = list(ratios)
    traces: list[FigureDict] = []
    for i in range(3):
        values = [ratios[name][i] for name in names]
        traces.append({
            "type": "scatter",
            "mode": "markers",
            "x": [value if value and value > 0 else None for value in values],
            "y": [style.wrapped(name) for name in names],
            "name": AXES[i],
            "marker": {"color": style.AXIS_COLOURS[i], "symbol": style.AXIS_SYMBOLS[i] + "-open", "size": 10,
                       "line": {"width": 2}},
            "hovertemplate": f"{AXES[i]}: %{{x:.4g}} times the bound<extra>%{{y}}</extra>",
        })  # fmt: skip
    red = {"color": style.RED, "width": 1.5}
    one = {"type": "line", "x0": 1, "x1": 1, "yref": "paper", "y0": 0, "y1": 1, "line": red}
    marks = [value for found in ratios.values() for value in found if value]
    x_axis = log_axis("RMS error / Cramér-Rao bound", marks, exponentformat="power")
    return {
        "data": traces,
        "layout": layout(xaxis=x_axis, yaxis=axis("", autorange="reversed", type="category"), shapes=[one]),
    }


def step_time(times: Mapping[str, float]) -> FigureDict:
    """Microseconds per run and step, one bar per estimator."""
    names = list(times)
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [times[name] for name in names],
        "y": [style.wrapped(name) for name in names],
        "name": "us per step",
        "text": [f"{times[name]:.3g}" for name in names],
        "textposition": "auto",
        "marker": {"color": [estimator_style(name)[0] for name in names]},
        "hovertemplate": "%{x:.4g} µs<extra>%{y}</extra>",
    }
    y_axis = axis("", autorange="reversed", type="category")
    return {"data": [bars], "layout": layout(xaxis=axis("Time per run and step (µs)"), yaxis=y_axis, bargap=0.35)}
