"""How every plot looks: one palette that colour-blind readers can tell apart, axes with units, lines, bands, views.

Colours are the light palette (contrast of at least 3 to 1 on white); page.js maps each to its counterpart in the dark.
Estimators differ in colour and marker; dashes mark the consistently tuned ones, so no plot rests on colour alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

BLUE, ORANGE, GREEN, PINK = "#0067a8", "#c4500a", "#00805c", "#b0548f"
AMBER, SKY, GREY, VIOLET, RED = "#8f6a00", "#2a7fa3", "#5c6470", "#5b3fa8", "#b3203a"
INK = "#1b2027"
AXIS_COLOURS = (BLUE, ORANGE, GREEN)
AXIS_SYMBOLS = ("circle", "square", "diamond")

_ESTIMATORS = {
    "lie": (BLUE, "circle-open"),
    "lie_left": (ORANGE, "square-open"),
    "mekf": (GREEN, "diamond-open"),
    "quaternion_ekf": (PINK, "triangle-up-open"),
    "quaternion_ekf_one_star": (RED, "triangle-down-open"),
    "ukf": (VIOLET, "cross-open"),
    "static_svd": (GREY, "x"),
    "lie_printed": (AMBER, "pentagon-open"),
    "quest_ekf": (BLUE, "circle-open"),
    "quest_ekf_isotropic": (RED, "triangle-down-open"),
    "quest_ekf_unsigned": (AMBER, "x"),
    "mekf_reset": (SKY, "star-open"),
    "iekf": (ORANGE, "square-open"),
    "usque": (VIOLET, "cross-open"),
    "mekf_adaptive": (PINK, "triangle-up-open"),
    "mekf_rate_state": (GREY, "hexagon-open"),
    "predictive": (AMBER, "pentagon-open"),
    "smoother": (GREEN, "star"),
    "ekf": (BLUE, "circle-open"),
    "ukf_printed": (AMBER, "pentagon-open"),
    "pf": (PINK, "triangle-up-open"),
    "rpf": (PINK, "hexagon-open"),
    "upf_printed": (RED, "triangle-down-open"),
    "upf": (GREEN, "diamond-open"),
    "rbpf": (SKY, "star-open"),
    "gsf": (ORANGE, "square-open"),
    "batch": (GREY, "x"),
    "ekf_position_velocity": (RED, "cross"),
    "ekf_position_velocity_pointing": (SKY, "circle"),
    "ekf_srp_ignored": (ORANGE, "square-open"),
    "ekf_execution_ignored": (PINK, "triangle-up-open"),
    "no_manoeuvres": (GREEN, "diamond-open"),
    "no_frames": (RED, "triangle-down-open"),
}
_OTHERS = [(SKY, "circle"), (ORANGE, "square"), (GREEN, "diamond"), (PINK, "triangle-up"), (VIOLET, "triangle-down")]
TUNED = "_tuned"


def estimator_style(name: str) -> tuple[str, str, str]:
    """(colour, dash, marker symbol) of an estimator, the same in every plot."""
    base = name.removesuffix(TUNED)
    colour, symbol = _ESTIMATORS.get(base) or _OTHERS[sum(base.encode()) % len(_OTHERS)]
    return colour, "dash" if name.endswith(TUNED) else "solid", symbol


def faded(colour: str, opacity: float) -> str:
    """The colour as rgba with this opacity."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its title (which carries the unit)."""
    return {
        "title": {"text": title, "standoff": 6},
        "automargin": True,
        "ticks": "outside",
        "ticklen": 4,
        "zeroline": False,
        **more,
    }


def log_axis(title: str, *series: Any, **more: Any) -> dict[str, Any]:
    """A logarithmic axis, labels written out (0.001, 0.01, ...): as many per decade as the series' range asks."""
    values = np.concatenate([np.zeros(0), *[np.ravel(np.asarray(one, dtype=float)) for one in series]])
    values = values[np.isfinite(values) & (values > 0.0)]
    decades = float(np.log10(values.max() / values.min())) if values.size else 9.0
    dtick = "D1" if decades < 0.7 else "D2" if decades < 2.5 else 1
    return axis(title, type="log", dtick=dtick, **{"exponentformat": "none", **more})


def layout(meta: dict[str, Any] | None = None, **parts: Any) -> dict[str, Any]:
    """A layout with the common margins and hover; `meta` holds "views" and "note" for the page."""
    return {
        "margin": {"l": 62, "r": 16, "t": 26, "b": 44},
        "hovermode": "closest",
        "legend": {"orientation": "h", "y": -0.2},
        **({"meta": meta} if meta else {}),
        **parts,
    }


def line(
    x: Any, y: Any, name: str, colour: str, *, width: float = 2.0, dash: str = "solid", hover: str = "", **more: Any
) -> dict[str, Any]:
    """A line; `hover` is the text of a point, as plotly's hovertemplate."""
    return {
        "type": "scatter",
        "mode": "lines",
        "x": x,
        "y": y,
        "name": name,
        "legendgroup": name,
        "line": {"color": colour, "width": width, "dash": dash},
        **({"hovertemplate": hover + f"<extra>{name}</extra>"} if hover else {"hoverinfo": "skip"}),
        **more,
    }


def band(x: Any, low: Any, high: Any, name: str, colour: str, opacity: float, **more: Any) -> list[dict[str, Any]]:
    """A filled band between two series, without outline: two traces with one entry in the legend."""
    edge = {"color": faded(colour, 0.0), "width": 0}
    base: dict[str, Any] = {
        "type": "scatter",
        "mode": "lines",
        "x": x,
        "legendgroup": name,
        "name": name,
        "line": edge,
        "hoverinfo": "skip",
    }
    filled = {"y": high, "fill": "tonexty", "fillcolor": faded(colour, opacity)}
    return [{**base, "y": low, **more, "showlegend": False}, {**base, **filled, **more}]


def stacked(count: int, titles: Sequence[str], x_title: str, gap: float = 0.06, **x_more: Any) -> dict[str, Any]:
    """Axes of `count` plots above one another that share x: keys xaxis, yaxis, xaxis2, ..., the first on top."""
    height = (1.0 - gap * (count - 1)) / count
    axes: dict[str, Any] = {}
    for i in range(count):
        suffix = "" if i == 0 else str(i + 1)
        top = 1.0 - i * (height + gap)
        last = i == count - 1
        axes[f"yaxis{suffix}"] = axis(titles[i], domain=[max(top - height, 0.0), top], anchor=f"x{suffix}")
        axes[f"xaxis{suffix}"] = axis(x_title if last else "", anchor=f"y{suffix}", showticklabels=last, **x_more)
        if i:
            axes[f"xaxis{suffix}"]["matches"] = "x"
    return axes


def on(row: int) -> dict[str, str]:
    """The axes of the row-th (from 0) of `stacked` plots, for a trace."""
    return {} if row == 0 else {"xaxis": f"x{row + 1}", "yaxis": f"y{row + 1}"}


def wrapped(name: str, width: int = 18) -> str:
    """A long name in lines, broken behind underscores: it shall not take half a phone's screen."""
    lines = [""]
    for part in name.replace("_", "_\n").split("\n"):
        if len(lines[-1]) + len(part) > width and lines[-1]:
            lines.append("")
        lines[-1] += part
    return "<br>".join(lines)


def nice_limit(*series: Any, factor: float = 1.2) -> float | None:
    """A little more than the largest finite magnitude in these series; None if there is none."""
    most = 0.0
    for values in series:
        magnitude = np.abs(np.asarray(values, dtype=float))
        finite = magnitude[np.isfinite(magnitude)]
        most = max(most, float(finite.max()) if finite.size else 0.0)
    return factor * most if most > 0.0 else None


def horizontal(value: float, text: str, colour: str, **more: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """(shape, annotation) of a dotted line across the plot at y = `value`; on a log axis the label needs log10."""
    shape = {
        "type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": value, "y1": value,
        "line": {"color": colour, "width": 1, "dash": "dot"}, "layer": "below",
    }  # fmt: skip
    label = {
        "xref": "paper", "x": 1, "xanchor": "right", "yref": "y", "y": value, "yanchor": "bottom", "text": text,
        "showarrow": False, "font": {"color": colour, "size": 11}, **more,
    }  # fmt: skip
    return shape, label
