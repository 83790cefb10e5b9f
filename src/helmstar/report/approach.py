"""What the report of the approach shows: what is known over time, where the probe passes, what it costs, the schedule."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import style
from .campaign_data import Campaign
from .numbers import chi_square_ratio_band
from .page import Chip, Column, Figure, Page, number
from .style import AXIS_COLOURS, axis, band, estimator_style, layout, line, log_axis

if TYPE_CHECKING:
    import xarray

BEFORE = "Hours before closest approach"
HOVER = "%{x:.4g} h before<br>%{y:.4g}"


def headline(summary: dict[str, Any]) -> tuple[str, ...]:
    """The result in one sentence, then what to know besides."""
    est, runs = summary["estimators"], summary["runs"]
    name = "ekf" if "ekf" in est else next(iter(est))
    m = est[name]
    d, dv, end = m["delivery_error_km"], m["delta_v_m_s"], m["handover_error_km"]
    if d["rms"] is None:
        return (f"Over {runs} runs of `{name}` not every passage is a number.",)
    first = (
        f"Over {runs} runs `{name}` brings the probe to within {number(d['rms'])} km of its aim (RMS; 99%: {number(d['q99'])} km) "
        f"for {number(dv['mean'])} m/s ({number(dv['q99'])} m/s in 99% of runs)."
    )
    second = (
        f"At the hand-over the relative position is known to {_triple(end['sigma'])} km in x, y, z (errors "
        f"{_triple(end['rms'])} km RMS), with NEES per state {number(m['handover_nees_per_state'])} (1 is right)."
    )
    controls = [
        f"`{n}` misses by {number(est[n]['delivery_error_km']['rms'])} km"
        for n in ("no_manoeuvres", "no_frames")
        if n in est and est[n]["delivery_error_km"]["rms"] is not None
    ]
    return first, second + (f" For comparison: {', '.join(controls)}." if controls else "")


def _triple(values: Sequence[float | None]) -> str:
    return ", ".join("-" if v is None else number(v, 3) for v in values)


def add_table(page: Page, summary: dict[str, Any]) -> None:
    """Every estimator in one row."""
    page.section(
        "All estimators",
        "Miss: distance in the target plane from the aim to where the probe truly passes. Hand-over: relative position at the last "
        "frame, x along the track. All estimators fly the same errors and the same noise.",
        short="Summary",
    )
    terminal = any("terminal_last60_error_km" in m for m in summary["estimators"].values())
    columns = [
        Column("Estimator", align="left"),
        Column("Miss, RMS", "km; 50%, 90%, 99%"),
        Column("Delta-v, mean", "m/s; 99%"),
        Column("Hand-over, RMS", "km; x, y, z; sigma"),
        Column("NEES per state", "all epochs; 1 is right"),
        Column("Last 60 s", "km; x, y, z") if terminal else Column("NIS", "per degree of freedom"),
    ]
    rows = []
    for name, m in summary["estimators"].items():
        d, dv, nees = m["delivery_error_km"], m["delta_v_m_s"], m["nees_per_state"]
        last: Any = m["nis_per_dof"]
        if terminal:
            last = (_triple(m["terminal_last60_error_km"]),)
            if m["terminal_diverged"]:
                last += (Chip("bad", f"{m['terminal_diverged']} diverged"),)
        rows.append(
            [
                name,
                (d["rms"], _triple([d["q50"], d["q90"], d["q99"]])),
                (dv["mean"], _triple([dv["q99"]])),
                (_triple(m["handover_error_km"]["rms"]), f"σ {_triple(m['handover_error_km']['sigma'])}"),
                None if nees is None else (nees, _nees_chip(nees)),
                last,
            ]
        )
    page.table(columns, rows)


def _nees_chip(nees: float) -> Chip:
    if nees > 1.3:
        return Chip("bad", "over-confident")
    return Chip("part", "too cautious") if nees < 0.75 else Chip("good", "honest")


def _marks(hours: np.ndarray) -> list[dict[str, Any]]:
    """Dotted lines at the manoeuvres."""
    return [
        {"type": "line", "x0": h, "x1": h, "yref": "paper", "y0": 0, "y1": 1, "layer": "below",
         "line": {"color": style.GREY, "width": 1, "dash": "dot"}}
        for h in map(float, hours)
    ]  # fmt: skip


def _time_axis(before: np.ndarray) -> dict[str, Any]:
    ends = [np.log10(before[0] * 1.1), np.log10(before[-1] / 1.1)]
    return axis(BEFORE, type="log", range=ends, dtick=1, exponentformat="none")


def add_knowledge(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """RMS errors, the filter's sigma and the bound over time."""
    before, bound = dataset["before_h"].values, dataset["bound_km"].values
    charts = {}
    shapes = _marks(dataset["manoeuvre"].values)
    for name in campaign.names:
        d = dataset.sel(estimator=name)
        traces, all_y = [], []
        for i, a in enumerate("xyz"):
            rms = np.sqrt(np.mean(d["position_error_km"].values[:, :, i] ** 2, axis=0))
            sigma = np.sqrt(np.mean(d["position_sigma_km"].values[:, :, i] ** 2, axis=0))
            c = AXIS_COLOURS[i]
            traces += [
                line(before, rms, f"{a}: RMS error", c, width=2.2, hover=HOVER + " km"),
                line(before, sigma, f"{a}: sigma of the filter", c, width=1.2, dash="dash", hover=HOVER + " km"),
                line(before, bound[:, i], f"{a}: bound", c, width=1.2, dash="dot", opacity=0.8, hover=HOVER + " km"),
            ]
            all_y += [rms, sigma, bound[:, i]]
        charts[name] = {
            "data": traces,
            "layout": layout(xaxis=_time_axis(before), yaxis=log_axis("Relative position (km)", *all_y), shapes=shapes),
        }
    page.section(
        "What is known, over time",
        "Across the line of sight (y, z) a frame is as good as its distance times a third of a pixel. Along it (x) nothing is seen "
        "until the aim's 150 km turn the direction, in the last hours. Dotted lines: manoeuvres.",
        short="Knowledge",
    )
    page.figure(
        charts, "RMS over the runs, the filter's 1 sigma, and the Cramér-Rao bound along the orbit to the aim without manoeuvres.",
        alt="Relative position error against time before closest approach, logarithmic, per axis.", height=520,
        select="Estimator", selected="ekf", group="estimator",
    )  # fmt: skip
    rows = []
    first = next(iter(campaign.summary["estimators"].values()))
    for k, values in first["bound_km"].items():
        rows.append([k, _triple(values), *(_triple(campaign.figures(n)["error_km"][k]["rms"]) for n in campaign.names)])
    columns = [
        Column("Before", align="left"),
        Column("Bound", "km; x, y, z"),
        *(Column(n, "RMS, km") for n in campaign.names),
    ]
    with page.details("The same in numbers"):
        page.table(columns, rows, caption="One sigma of the bound and RMS of each estimator.")


def _ellipse(mean: np.ndarray, cov: np.ndarray, sigmas: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = np.linalg.eigh(cov)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    points = (vectors * np.sqrt(np.maximum(values, 0.0))) @ np.stack([np.cos(angle), np.sin(angle)]) * sigmas
    return mean[0] + points[0], mean[1] + points[1]


def _plane(dataset: xarray.Dataset, name: str) -> dict[str, Any]:
    d = dataset.sel(estimator=name)
    x = d["delivery_km"].values
    colour, _, symbol = estimator_style(name)
    traces: list[dict[str, Any]] = []
    if len(x) > 2 and np.isfinite(x).all():
        ex, ey = _ellipse(x.mean(axis=0), np.cov(x.T))
        traces.append(line(ex, ey, "3σ of the passages", colour, width=1.6))
    sigma = np.sqrt(np.mean(d["passage_sigma_km"].values ** 2, axis=0))
    kx, ky = _ellipse(np.zeros(2), np.diag(sigma**2))
    traces.append(line(kx, ky, "3σ known at the hand-over", style.AMBER, width=1.4, dash="dash"))
    text = [f"run {r}" for r in d["run"].values]
    traces.append({
        "type": "scatter", "mode": "markers", "x": x[:, 0], "y": x[:, 1], "name": "true passages", "text": text,
        "marker": {"color": colour, "symbol": symbol, "size": 7},
        "hovertemplate": "%{text}<br>%{x:.4g}, %{y:.4g} km<extra></extra>",
    })  # fmt: skip
    traces.append({
        "type": "scatter", "mode": "markers", "x": [0.0], "y": [0.0], "name": "aim", "hoverinfo": "skip",
        "marker": {"color": style.INK, "symbol": "cross-thin-open", "size": 16, "line": {"width": 2}},
    })  # fmt: skip
    most = style.nice_limit(x, kx, ky) or 1.0
    return {
        "data": traces,
        "layout": layout(
            xaxis=axis("B·T less the aim (km)", range=[-most, most], zeroline=True),
            # Down is positive, as target planes are drawn.
            yaxis=axis("B·R less the aim (km)", range=[most, -most], zeroline=True, scaleanchor="x"),
        ),
    }


def _histogram(dataset: xarray.Dataset, name: str) -> dict[str, Any]:
    total = dataset["delta_v_m_s"].sel(estimator=name).values.sum(axis=1)
    counts, edges = np.histogram(total, bins=min(30, max(5, len(total) // 4)))
    colour = estimator_style(name)[0]
    bars = {
        "type": "bar", "x": 0.5 * (edges[1:] + edges[:-1]), "y": counts, "width": np.diff(edges) * 0.95, "name": name,
        "marker": {"color": style.faded(colour, 0.75), "line": {"width": 0}},
        "hovertemplate": "%{x:.3g} m/s: %{y} runs<extra></extra>",
    }  # fmt: skip
    shapes, notes = [], []
    for q, text in ((0.5, "median"), (0.99, "99%")):
        v = float(np.quantile(total, q))
        shapes.append({"type": "line", "x0": v, "x1": v, "yref": "paper", "y0": 0, "y1": 1,
                       "line": {"color": style.INK, "width": 1.2, "dash": "dash"}})  # fmt: skip
        notes.append(
            {"x": v, "xref": "x", "y": 1.0, "yref": "paper", "yanchor": "bottom", "text": text, "showarrow": False}
        )
    return {
        "data": [bars],
        "layout": layout(
            xaxis=axis("Delta-v of a run (m/s)", rangemode="tozero"), yaxis=axis("Runs"), shapes=shapes, annotations=notes,
            showlegend=False,
        ),
    }  # fmt: skip


def add_delivery(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """Target plane, delta-v, and the manoeuvres one by one."""
    aim = json.loads(campaign.attrs["aim_km"])
    page.section(
        "Where it passes, and what it costs",
        f"The target plane lies across the velocity; its origin here is the aim, B·T = {number(aim[0])} km and "
        f"B·R = {number(aim[1])} km from the body. Solid ellipse: 3σ of the runs' passages. Dashed: 3σ of what the filter knows of "
        "the passage at the hand-over, drawn about the aim: with manoeuvres it is smaller, for what is learnt after the last one "
        "cannot be used.",
        short="Delivery",
    )
    burning = [n for n in campaign.names if campaign.figures(n)["delta_v_m_s"]["largest"]]
    figures = [
        Figure(
            {n: _plane(dataset, n) for n in campaign.names}, "True passages in the target plane.",
            alt="Scatter of passages in the target plane.", height=520, select="Estimator", selected="ekf", group="estimator",
        )
    ]  # fmt: skip
    if burning:
        figures.append(
            Figure(
                {n: _histogram(dataset, n) for n in burning}, "Sum of all burns of a run, as asked for.",
                alt="Histogram of delta-v.", height=520, select="Estimator", selected="ekf", group="estimator",
            )
        )  # fmt: skip
    page.figures(figures)
    name = "ekf" if "ekf" in campaign.names else campaign.names[0]
    rows = []
    for k, m in campaign.figures(name)["manoeuvres"].items():
        rows.append(
            [
                k,
                m["burnt"],
                m["median_m_s"],
                m["q99_m_s"],
                _triple(m["aimed_from_rms_km"]),
                _triple(m["aimed_sigma_km"]),
            ]
        )
    page.table(
        [
            Column("Before", align="left"),
            Column("Burnt", "runs"),
            Column("Median", "m/s"),
            Column("99%", "m/s"),
            Column("Passage before it, RMS from the body", "km; B·T, B·R"),
            Column("Its sigma", "km; B·T, B·R"),
        ],
        rows,
        caption=f"The manoeuvres of `{name}`.",
    )


def add_consistency(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """NEES over time, with its band."""
    before = dataset["before_h"].values
    low, high = chi_square_ratio_band(6.0 * campaign.runs)
    ones = np.ones(len(before))
    traces = band(before, low * ones, high * ones, "95% band", style.GREEN, 0.25)
    series = []
    for name in campaign.names:
        values = np.mean(dataset["nees_per_state"].sel(estimator=name).values, axis=0)
        colour, dash, _ = estimator_style(name)
        series.append(values)
        traces.append(line(before, values, name, colour, width=1.6, dash=dash, hover=HOVER))
    most = style.nice_limit(*series) or 2.0
    # Near 1 a logarithm has no round numbers.
    y = axis("NEES per state", range=[0, most]) if most < 6.0 else log_axis("NEES per state", *series)
    page.section(
        "Are they honest?",
        "NEES of relative position and velocity over 6, mean over the runs: 1 is right, above is over-confident.",
        short="Consistency",
    )
    page.figure(
        {"data": traces, "layout": layout(xaxis=_time_axis(before), yaxis=y,
                                          shapes=_marks(dataset["manoeuvre"].values))},
        "Dotted lines: manoeuvres.", alt="NEES against time before closest approach.", height=400,
    )  # fmt: skip


def add_terminal(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """The last minutes, from the hand-over's estimate."""
    if "terminal_error_km" not in dataset:
        return
    frame = dataset["frame"].values
    charts = {}
    for i, a in enumerate("xyz"):
        traces, series = [], []
        for name in campaign.names:
            d = dataset.sel(estimator=name)
            with np.errstate(over="ignore", invalid="ignore"):
                rms = np.sqrt(np.mean(d["terminal_error_km"].values[:, :, i] ** 2, axis=0))
            if not np.isfinite(rms).any():
                continue
            colour, dash, _ = estimator_style(name)
            traces.append(line(frame, rms, name, colour, width=1.7, dash=dash, hover="frame %{x}<br>%{y:.3g} km"))
            series.append(rms)
            if name == "ekf":
                sigma = np.sqrt(np.mean(d["terminal_sigma_km"].values[:, :, i] ** 2, axis=0))
                traces.append(line(frame, sigma, "ekf: sigma of the filter", style.INK, width=1.3, dash="dash"))
                series.append(sigma)
        y = log_axis(f"RMS error {a} (km)", *series)
        charts[a] = {"data": traces, "layout": layout(xaxis=axis("Frame of the terminal tracking"), yaxis=y)}
    page.section(
        "The last minutes",
        f"From the hand-over on li2007's experiment: its camera, its noise of motion and its attitude reference, 0.1 deg off, with "
        f"the filter `{campaign.attrs['terminal_filter']}` and position, velocity and pointing as state. Frames are even up to the "
        "estimated closest approach. The name is of the estimator that handed over.",
        short="Terminal",
    )
    page.figure(
        charts, "RMS over the runs.", alt="RMS error in the terminal tracking.", height=420, select="Axis", selected="x",
        group="axis",
    )  # fmt: skip


def add_schedule(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """When frames and manoeuvres are, and what is known then."""
    before, frames = dataset["before_h"].values, dataset["has_frame"].values > 0
    f = json.loads(campaign.attrs["frames"])
    name = "ekf" if "ekf" in campaign.names else campaign.names[0]
    sigma = np.sqrt(np.mean(dataset["position_sigma_km"].sel(estimator=name).values ** 2, axis=0))
    ends = [*f["from_h"][1:], f["until_min"] / 60.0]
    rows = []
    for i, (a, b, every) in enumerate(zip(f["from_h"], ends, f["every_min"], strict=True)):
        last = i == len(ends) - 1
        inside = (before <= a + 1e-9) & ((before >= b - 1e-9) if last else (before > b + 1e-9))
        burns = [f"{h:g} h" for h in dataset["manoeuvre"].values if b < h <= a]
        end = int(np.flatnonzero(before >= b - 1e-9)[-1]) if np.any(before >= b - 1e-9) else 0
        rows.append(
            [f"{a:g} h", f"{every:g} min", int(np.sum(frames & inside)), ", ".join(burns) or "-", _triple(sigma[end])]
        )
    page.section("Schedule")
    page.table(
        [
            Column("From", "before closest approach", align="left"),
            Column("A frame every"),
            Column("Frames"),
            Column("Manoeuvres"),
            Column("Known at its end", "km; x, y, z, 1 sigma"),
        ],
        rows,
        caption=f"Frames, manoeuvres and the sigma of `{name}`.",
    )


def add_sections(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """All of the above."""
    add_table(page, campaign.summary)
    if campaign.runs:
        add_knowledge(page, dataset, campaign)
        add_delivery(page, dataset, campaign)
        add_consistency(page, dataset, campaign)
        add_terminal(page, dataset, campaign)
        add_schedule(page, dataset, campaign)
