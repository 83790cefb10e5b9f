"""The report of `helmstar allan`: Allan deviation of a gyro with the fitted noise coefficients.

`result`: `file` (str); `axes` {"x": {...}, ...}, each with `tau_s`, `adev_arcsec_s`, `adev_error_arcsec_s`,
`fit_arcsec_s` (lists of one length) and `arw_arcsec_sqrt_s`, `rrw_arcsec_s_sqrt_s`, `bias_instability_arcsec_s` (float,
or None where the data do not show it); `sensors_toml` (text to copy); optionally `command` and `versions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import style
from .page import Column, Page, number
from .style import band, layout, line, log_axis

MINIMUM = 0.664  # Allan deviation over bias instability where flicker noise rules, sqrt(2 ln 2 / pi)
NAMES = {
    "arw_arcsec_sqrt_s": ("Angle random walk", "arcsec/√s"),
    "bias_instability_arcsec_s": ("Bias instability", "arcsec/s"),
    "rrw_arcsec_s_sqrt_s": ("Rate random walk", "arcsec/s/√s"),
}


def write_allan_report(result: dict[str, Any], path: Path) -> Path:
    """Write the page of an Allan analysis to `path` and return it."""
    return allan_page(result).write(path)


def allan_page(result: dict[str, Any]) -> Page:
    """The page of an Allan analysis, not yet written."""
    axes: Mapping[str, Mapping[str, Any]] = result.get("axes") or {}
    page = Page("Allan deviation of a gyro", subtitle=f"`{Path(str(result.get('file', ''))).name}`")
    page.section("Result")
    values = [axis.get("arw_arcsec_sqrt_s") for axis in axes.values()]
    page.headline(
        f"Angle random walk of {', '.join(axes)}: {', '.join(number(value) for value in values)} arcsec/√s."
        if axes
        else "The file has no gyro axis with enough data."
    )
    columns = [Column("Axis", align="left"), *[Column(title, unit) for title, unit in NAMES.values()]]
    rows = [[name, *[axis.get(key) for key in NAMES]] for name, axis in axes.items()]
    if rows:
        page.table(columns, rows, caption="Fitted noise coefficients; a dash where the data are too short to show it.")
        page.section("Allan deviation")
        page.figure(
            allan_figure(axes),
            "A slope of -1/2 is angle random walk (white rate noise), a flat floor bias instability, a slope of +1/2 "
            "rate random walk; shaded is the 1σ uncertainty, which grows to the right where few averages are left.",
            alt="Allan deviation in arcseconds per second against averaging time, log-log, with the fit per axis.",
            height=480,
        )
    if result.get("sensors_toml"):
        page.section("For sensors.toml", "Copy this into the file that `helmstar attitude --config` reads.")
        page.code(str(result["sensors_toml"]), "sensors.toml")
    if result.get("command"):
        page.section("How to reproduce this", short="Reproduce")
        page.code(str(result["command"]), "Command")
    versions = result.get("versions") or {}
    if versions:
        with page.details("Versions"):
            rows = [[str(name), str(version)] for name, version in versions.items()]
            page.table([Column("What", align="left"), Column("Version", align="left")], rows)
    return page


def allan_figure(axes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Allan deviation per axis with its 1 sigma, the fit, and the slopes of its three parts; log-log."""
    traces: list[dict[str, Any]] = []
    for i, (name, found) in enumerate(axes.items()):
        colour = style.AXIS_COLOURS[i % 3]
        tau, adev, error, fit = (
            np.array([np.nan if value is None else value for value in found.get(key) or []], dtype=float)
            for key in ("tau_s", "adev_arcsec_s", "adev_error_arcsec_s", "fit_arcsec_s")
        )
        if len(error) == len(adev):
            low = np.where(adev > error, adev - error, adev * 0.1)
            traces += band(tau, low, adev + error, f"{name} 1σ", colour, 0.2, showlegend=False)
        hover = "τ %{x:.4g} s<br>%{y:.4g} arcsec/s"
        marker = {"symbol": style.AXIS_SYMBOLS[i % 3], "size": 6, "color": colour}
        traces.append({**line(tau, adev, f"{name} data", colour, hover=hover), "mode": "markers", "marker": marker})
        if len(fit) == len(tau):
            traces.append(line(tau, fit, f"{name} fit", colour, width=2))
        traces += _slopes(name, found, tau, colour)
    views: dict[str, Any] = {}
    limits = [_limits(axes, key) for key in ("tau_s", "adev_arcsec_s")]
    if all(limits):
        views = {"views": {"Data": {"xaxis.range": limits[0], "yaxis.range": limits[1]}}}
    axes_layout = {"xaxis": log_axis("Averaging time τ (s)"), "yaxis": log_axis("Allan deviation (arcsec/s)")}
    return {"data": traces, "layout": layout(views, **axes_layout)}


def _slopes(name: str, found: Mapping[str, Any], tau: np.ndarray, colour: str) -> list[dict[str, Any]]:
    if not len(tau):
        return []
    ends = np.array([np.nanmin(tau), np.nanmax(tau)])
    arw, rrw, floor = (
        found.get(key) for key in ("arw_arcsec_sqrt_s", "rrw_arcsec_s_sqrt_s", "bias_instability_arcsec_s")
    )
    parts = []
    if arw:
        parts.append(arw / np.sqrt(ends))
    if rrw:
        parts.append(rrw * np.sqrt(ends / 3.0))
    if floor:
        parts.append(np.full(2, MINIMUM * floor))
    label = f"{name} slopes"
    return [line(ends, values, label, colour, width=1, dash="dot", showlegend=j == 0) for j, values in enumerate(parts)]


def _limits(axes: Mapping[str, Mapping[str, Any]], key: str) -> list[float] | None:
    values = [value for found in axes.values() for value in found.get(key) or [] if value is not None and value > 0]
    finite = [value for value in values if np.isfinite(value)]
    return [float(np.log10(min(finite))) - 0.15, float(np.log10(max(finite))) + 0.15] if finite else None
