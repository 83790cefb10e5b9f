"""What the report of li2007 shows: Table 1 with the paper's columns beside ours, Figs. 3 to 5, errors against the bound, and which
differences are real."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import style
from .campaign_data import Campaign
from .page import Chip, Column, Figure, Page, number
from .style import axis, band, estimator_style, layout, line, log_axis

if TYPE_CHECKING:
    import xarray

AXES = "xyz"
SURE = 3.0
PAPER = {
    "ukf_printed": ("UKF", (43.87, 1.058, 2.620), (0.2717, 0.2157, 0.4292)),
    "pf": ("PF 400", (40.45, 0.912, 2.191), (0.1613, 0.2406, 0.3970)),
    "upf_printed": ("UPF 200", (37.02, 0.764, 1.761), (0.0510, 0.1923, 0.0529)),
}
"""Table 1: the paper's name, mean error and converged error, km."""


def headline(summary: dict[str, Any]) -> tuple[str, ...]:
    """The result in one sentence, then what to know besides."""
    est, runs = summary["estimators"], summary["runs"]
    whole = {n: m for n, m in est.items() if m["mean_error_km"][0] is not None and m["diverged"] == 0}
    if not whole:
        return (f"Over {runs} runs of {', '.join(f'`{n}`' for n in est)}: none keeps the body in every run.",)
    best = min(whole, key=lambda n: sum(v or 0.0 for v in whole[n]["mean_error_km"]))
    m = whole[best]
    first = (
        f"Over {runs} runs `{best}` has the smallest mean error, {_triple(m['mean_error_km'])} km in x, y, z; it ends at "
        f"{_triple(m['last60_error_km'])} km"
    )
    first += (
        "." if m["nees_per_state"] is None else f", with NEES per state {number(m['nees_per_state'])} (1 is right)."
    )
    lost = [f"`{n}` ({e['diverged']})" for n, e in est.items() if e["diverged"]]
    more = f"Runs that end more than 5 km off: {', '.join(lost)}." if lost else "No run of any estimator diverges."
    absent = m.get("absent_share") or 0.0
    if absent:
        more += f" In {100 * absent:.2g}% of the frames there is nothing to measure: dark, outside the field or cut by its edge."
    return first, more


def _triple(values: Sequence[float | None]) -> str:
    return ", ".join("-" if v is None else number(v, 3) for v in values)


def add_table_1(page: Page, summary: dict[str, Any]) -> None:
    """The paper's columns, then ours for every estimator."""
    page.section(
        "Table 1: the paper's columns and ours",
        "Mean error: mean over runs and frames of |truth - estimate|. Converged: the same over the last 60 s. All in km, x along "
        "the track, z across it, y out of the plane of motion. Standard errors are over runs.",
        short="Table 1",
    )
    columns = [
        Column("Estimator", align="left"),
        Column("Mean error", "km; x, y, z"),
        Column("Converged", "km; x, y, z"),
        Column("NEES per state", "1 is right"),
        Column("Diverged", "runs"),
        Column("Time", "µs per update"),
    ]
    rows = []
    for name, m in summary["estimators"].items():
        paper = PAPER.get(name)
        nees = m["nees_per_state"]
        mean: list[Any] = [_triple(m["mean_error_km"]), f"± {_triple(m['mean_error_standard_error_km'])}"]
        last: list[Any] = [_triple(m["last60_error_km"])]
        if paper:
            mean.append(f"paper: {_triple(paper[1])}")
            last.append(f"paper: {_triple(paper[2])}")
        rows.append(
            [
                (name, f"the paper's {paper[0]}") if paper else name,
                tuple(mean),
                tuple(last),
                None if nees is None else (nees, _nees_chip(nees)),
                Chip("bad", str(m["diverged"])) if m["diverged"] else m["diverged"],
                m["us_per_update"],
            ]
        )
    page.table(columns, rows, caption="Diverged: more than 5 km off over the last 60 s. The paper used its own draws.")


def _nees_chip(nees: float) -> Chip:
    if nees > 1.6:
        return Chip("bad", "over-confident")
    return Chip("part", "too cautious") if nees < 0.6 else Chip("good", "honest")


def add_paired(page: Page, summary: dict[str, Any]) -> None:
    """Differences to the Gaussian sum on the same draws."""
    rows = []
    for name, m in summary["estimators"].items():
        pair = m.get("paired_with_gsf")
        if not pair:
            continue
        cells: list[Any] = [name]
        for d, e, s in zip(pair["difference_km"], pair["standard_error_km"], pair["sigmas"], strict=True):
            if d is None or e is None:
                cells.append(None)
                continue
            sure = s is None or abs(s) >= SURE
            chip = (
                Chip("plain", "no difference")
                if not sure
                else Chip("good" if d < 0 else "part", "better" if d < 0 else "worse")
            )
            cells.append((f"{number(d, 2)} ± {number(e, 2)}", chip))
        rows.append(cells)
    if not rows:
        return
    page.heading("Paired comparison with the Gaussian sum")
    page.table(
        [Column("Estimator", align="left"), *(Column(f"Mean error {a}", "km") for a in AXES)],
        rows,
        caption="Mean error less that of `gsf` in the same run, with the same noise: mean over runs and its standard error. A "
        f"difference counts from {SURE:g} standard errors on.",
    )


def add_bounds(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """RMS errors of every estimator against the bound over time."""
    time, bound = dataset["time"].values, dataset["bound_km"].values
    charts = {}
    for i, a in enumerate(AXES):
        traces = []
        for name in campaign.names:
            e = dataset["position_error_km"].sel(estimator=name).values[:, :, i]
            with np.errstate(over="ignore", invalid="ignore"):
                rms = np.sqrt(np.mean(e**2, axis=0))
            colour, dash, _ = estimator_style(name)
            if np.isfinite(rms).any():
                traces.append(line(time, rms, name, colour, width=1.6, dash=dash, hover="%{x} s<br>%{y:.3g} km"))
        traces.append(
            line(
                time, bound[:, i], "Cramér-Rao bound", style.INK, width=2.2, dash="dash", hover="%{x} s<br>%{y:.3g} km"
            )
        )
        y = log_axis(f"RMS error {a} (km)", *[t["y"] for t in traces])
        charts[a] = {"data": traces, "layout": layout(xaxis=axis("Time (s)"), yaxis=y)}
    page.section(
        "Errors and the bound",
        "x becomes observable only as the direction to the body turns; y keeps a floor of 150 km times the roll of 0.1 deg about "
        "the line of sight.",
        short="Bound",
    )
    page.figure(
        charts, "RMS over the runs, and the Cramér-Rao bound of position with unknown pointing, for centres seen directly.",
        alt="RMS position error against time, one line for each estimator, with the bound.", height=460, select="Axis",
        selected="x", group="axis",
    )  # fmt: skip
    rows = []
    epochs = next(iter(campaign.summary["estimators"].values()))["bound_km"]
    for t, values in epochs.items():
        rows.append(
            [f"{t} s", _triple(values), *(_triple(campaign.figures(n)["rms_error_km"][t]) for n in campaign.names)]
        )
    columns = [
        Column("Time", align="left"),
        Column("Bound", "km; x, y, z"),
        *(Column(n, "RMS, km") for n in campaign.names),
    ]
    with page.details("The same in numbers"):
        page.table(columns, rows, caption="One sigma of the bound and RMS of each estimator.")


def add_figures_3_to_5(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """The paper's figures: error per axis of one estimator, here with its own sigma and the bound."""
    time, bound = dataset["time"].values, dataset["bound_km"].values
    figures = []
    first = next((n for n in ("upf", "gsf", "ekf") if n in campaign.names), campaign.names[0])
    for i, (a, title) in enumerate(zip(AXES, ("Fig. 3", "Fig. 4", "Fig. 5"), strict=True)):
        charts = {}
        for name in campaign.names:
            e = dataset["position_error_km"].sel(estimator=name).values[:, :, i]
            e = np.where(np.isfinite(e), e, np.nan)
            low, high = np.nanquantile(e, [0.05, 0.95], axis=0)
            sigma = np.nanmedian(dataset["position_sigma_km"].sel(estimator=name).values[:, :, i], axis=0)
            traces = band(time, -3 * sigma, 3 * sigma, "3σ of the filter", style.AMBER, 0.18)
            traces += band(time, low, high, "5% to 95% of runs", style.BLUE, 0.28)
            for j in range(min(2, len(e))):
                more: dict[str, Any] = {"showlegend": False} if j else {}
                traces.append(line(time, e[j], "single runs", style.GREY, width=0.9, opacity=0.8, **more))
            for sign in (1.0, -1.0):
                more = {} if sign > 0 else {"showlegend": False}
                traces.append(line(time, 3 * sign * bound[:, i], "3σ bound", style.RED, width=1.3, dash="dash", **more))
            end = time >= time[-1] - 120.0
            most = style.nice_limit(low[end], high[end], 3 * bound[end, i]) or 1.0
            last = {"xaxis.range": [time[-1] - 120.0, time[-1]], "yaxis.range": [-most, most]}
            view = {"views": {"Whole": {}, "Last 120 s": last}}
            charts[name] = {
                "data": traces,
                "layout": layout(view, xaxis=axis("Time (s)"), yaxis=axis(f"Error {a} (km)")),
            }
        figures.append(
            Figure(
                charts,
                f"{title}: error in {a}.",
                alt=f"Error in {a} against time with bands.",
                height=380,
                select="Estimator",
                selected=first,
                group="estimator",
            )
        )
    page.section(
        "Figs. 3 to 5: errors per axis",
        "The paper shows one run of its UPF. Here: 5% to 95% of all runs, two single runs, the filter's own 3σ and the bound's.",
        short="Figs. 3-5",
    )
    page.figures(figures)


def add_consistency(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """NEES per state over time, and the effective number of particles."""
    time = dataset["time"].values
    nees, effective = [], []
    for name in campaign.names:
        d = dataset.sel(estimator=name)
        colour, dash, _ = estimator_style(name)
        values = np.mean(d["nees_per_state"].values, axis=0)
        if np.isfinite(values).any():
            nees.append(line(time, values, name, colour, width=1.4, dash=dash, hover="%{x} s<br>%{y:.3g}"))
        count = np.median(d["effective"].values, axis=0)
        if np.isfinite(count).any():
            effective.append(
                line(time, np.maximum(count, 1.0), name, colour, width=1.4, dash=dash, hover="%{x} s<br>%{y:.3g}")
            )
    page.section("Are they honest?", short="Consistency")
    shown = []
    if nees:
        y = log_axis("NEES per state", *[t["y"] for t in nees], exponentformat="power")
        shown.append(
            Figure(
                {"data": nees, "layout": layout(xaxis=axis("Time (s)"), yaxis=y)},
                "Mean NEES of the whole state over its dimension: 1 is right, above is over-confident.",
                alt="NEES against time.",
                height=400,
            )
        )
    if effective:
        y = log_axis("Effective number", *[t["y"] for t in effective])
        shown.append(
            Figure(
                {"data": effective, "layout": layout(xaxis=axis("Time (s)"), yaxis=y)},
                "Effective number of particles or components after each update, median of the runs. Near 1 one carries it all.",
                alt="Effective number of particles against time.",
                height=400,
            )
        )
    page.figures(shown)


def add_sections(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """All of the above, in the order of the paper."""
    add_table_1(page, campaign.summary)
    add_paired(page, campaign.summary)
    if campaign.runs:
        add_figures_3_to_5(page, dataset, campaign)
        add_bounds(page, dataset, campaign)
        add_consistency(page, dataset, campaign)
