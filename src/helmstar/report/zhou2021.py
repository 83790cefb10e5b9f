"""What the report of zhou2021 shows beside what every campaign shows: Figs. 3-6, the table of readings and gyros, what became
of losses, wrong starts and upsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import style
from .campaign_data import Campaign
from .numbers import chi_square_ratio_band
from .page import Chip, Column, Figure, Page, number
from .style import axis, band, layout, line, log_axis

if TYPE_CHECKING:
    import xarray

DEG_H = 3600.0 * np.degrees(1.0)
"""1 rad/s in deg/h."""
POLICY_TEXT = {
    "none": "no loss",
    "zeros": "zeros taken as data",
    "hold_last": "last sample held",
    "hold_mean": "30 s mean held",
    "hold_mean_raised": "mean held, Q raised",
    "commanded": "commanded rate",
    "rate_state": "rate as a state",
    "no_gyro": "never a gyro",
    "both_lost": "stars lost too, mean held",
}
AXES = "xyz"


def headline(summary: dict[str, Any]) -> tuple[str, ...]:
    """The result in one sentence, then what to know besides."""
    est, runs = summary["estimators"], summary["runs"]
    tie = [n for n in ("quest_ekf", "mekf", "iekf", "usque", "mekf_reset") if n in est]
    first = f"Over {runs} run{'s' if runs != 1 else ''}"
    if not tie:
        return (f"{first} of {', '.join(f'`{n}`' for n in est)}.",)
    worst = [_worst(est[n]["attitude_rms_deg"]) for n in tie]
    drift = [_worst(est[n]["drift_rms_deg_h"]) for n in tie]
    if all(v is not None for v in (*worst, *drift)):
        span = f"{number(min(worst))}" + (f" to {number(max(worst))}" if max(worst) > 1.02 * min(worst) else "")
        first += f" the attitude is known to {span} deg and the drift to {number(max(drift))} deg/h (RMS, worst axis)"
    honest = [n for n in tie if est[n]["nees_in_band"]]
    first += f"; {len(honest)} of {len(tie)} filters with the right R are honest about it."
    case = "start_179deg_1000deg_h"
    found = {n: est[n]["recovery_s"].get(case) for n in est}
    good = [n for n, c in found.items() if c and c["converged"] == c["runs"]]
    if not any(found.values()):
        return (first,)
    text = ", ".join(f"`{n}`" for n in good) or "none"
    return first, f"From 179 deg and 1000 deg/h off, every run of these recovers within 300 s: {text}."


def _worst(values: Sequence[float | None]) -> Any:
    return max((v for v in values if v is not None), default=None)


def add_summary(page: Page, summary: dict[str, Any]) -> None:
    """One row for each estimator."""
    runs = summary["runs"]
    low, high = (6.0 * float(v) for v in chi_square_ratio_band(6 * runs))
    columns = [
        Column("Estimator", align="left"),
        Column("Attitude RMS", "deg; x, y, z"),
        Column("over bound", "worst axis"),
        Column("Drift RMS", "deg/h; x, y, z"),
        Column("NEES", "6 is right"),
        Column("Wrong signs", "total"),
        Column("Time", "µs per step"),
    ]
    rows = []
    for name, m in summary["estimators"].items():
        nees = m["nees_mean"]
        chip = None
        if nees is not None:
            chip = Chip("good", "honest") if low <= nees <= high else Chip("bad", "over-confident")
            chip = Chip("part", "too cautious") if nees < low else chip
        rows.append(
            [
                name,
                (_worst(m["attitude_rms_deg"]), _triple(m["attitude_rms_deg"])),
                _worst(m["rms_over_bound"]),
                (_worst(m["drift_rms_deg_h"]), _triple(m["drift_rms_deg_h"])),
                None if nees is None else (nees, chip),
                m["sign_errors"],
                m["us_per_step"],
            ]
        )
    page.section("Summary of all estimators", short="Summary")
    page.prose(
        f"Over the last 1000 s and all runs, in body axes. With {runs} runs a consistent filter's mean NEES lies in {low:.3g} to "
        f"{high:.3g} (95%). `smoother` knows what comes after, so it may lie below the bound of a filter; `predictive` keeps "
        "no covariance and knows no gyro."
    )
    page.table(columns, rows, caption="RMS errors of the main pass; the largest axis large, all three below it.")


def _triple(values: Sequence[float | None]) -> str:
    return ", ".join("-" if v is None else number(v, 2) for v in values)


def add_designs(page: Page, dataset: xarray.Dataset) -> None:
    """Which reading and which gyro grade meet 0.003 deg and 0.03 deg/h."""
    if "design_reading" not in dataset:
        return
    columns_of = {
        k.removeprefix("design_"): dataset[k].values for k in map(str, dataset.data_vars) if k.startswith("design_")
    }
    page.section(
        "Which star sensor and which gyro meet the claim",
        'The paper says "error covariance 0.002 I" without a unit and leaves out the gyro\'s values. A: covariance in rad² '
        "(2.56 deg), B: sigma in rad (0.115 deg), C: covariance in deg² (0.0447 deg), D: sigma in deg. The bound is what the best "
        "filter reaches over the last 1000 s on this scenario's orbit and stars (Cramér-Rao, worst axis); Farrenkopf's formula is "
        "its steady state, which slow drifts have not reached after one orbit.",
        short="Designs",
    )
    columns = [
        Column("Reading", align="left"),
        Column("ARW", "deg/√h"),
        Column("RRW", "deg/h/√h"),
        Column("Attitude", "deg, bound"),
        Column("Farrenkopf", "deg"),
        Column("Drift", "deg/h, bound"),
        Column("Farrenkopf", "deg/h"),
        Column("0.003 deg and 0.03 deg/h", align="left"),
    ]
    table = []
    for i in range(dataset.sizes["design"]):
        r = {k: v[i] for k, v in columns_of.items()}
        a, d = r["meets_attitude"], r["meets_drift"]
        text = "met" if a and d else "attitude only" if a else "drift only" if d else "neither"
        kind = "good" if a and d else "part" if a or d else "bad"
        if r.get("borderline"):
            kind, text = "part", f"{text}, borderline"
        table.append(
            [
                str(r["reading"]), r["arw"], r["rrw"], r["attitude_deg"], r["farrenkopf_deg"], r["drift_deg_h"],
                r["farrenkopf_deg_h"], Chip(kind, text),
            ]
        )  # fmt: skip
    page.table(
        columns,
        table,
        caption="One sigma against the claim, for star readings A to D and five gyros. Borderline: the bound is within 5% of a "
        "claim, so that a filter may be on the other side of it.",
    )


def add_figures_3_and_4(page: Page, dataset: xarray.Dataset) -> None:
    """QUEST's quaternion with the sign rule, and without it."""
    time = dataset["time"].values
    truth = dataset["truth_q_bn"].values
    charts = []
    for key, title, text in (
        (
            "quest_continuous",
            "Fig. 3",
            "With (13) every component goes on through zero: the estimate lies on the truth.",
        ),
        ("quest_plain", "Fig. 4", "Plain QUEST with q4 ≥ 0: where the true q4 changes its sign all components jump."),
    ):
        q = dataset[key].values
        names = ("q1", "q2", "q3", "q4")
        traces = [
            line(time, truth[:, i], "truth", style.GREY, width=4.0, opacity=0.35, showlegend=i == 0) for i in range(4)
        ]
        colours = (*style.AXIS_COLOURS, style.PINK)
        traces += [line(time, q[:, i], names[i], colours[i], width=1.4, hover="%{x} s<br>%{y:.5f}") for i in range(4)]
        figure = {
            "data": traces,
            "layout": layout(xaxis=axis("Time (s)"), yaxis=axis("Component of q_BN", range=[-1.05, 1.05])),
        }
        charts.append(
            Figure(figure, f"{title}. {text}", alt=f"{title}: quaternion components against time.", height=340)
        )
    page.section("Figs. 3 and 4: the sign of the quaternion", short="Figs. 3, 4")
    page.figures(charts)


def add_figures_5_and_6(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """Attitude and drift errors of the main pass, and the error through a gyro loss."""
    page.section("Figs. 5 and 6: attitude and drift", short="Figs. 5, 6")
    names = campaign.names
    time = dataset["time"].values
    attitude, drift = {}, {}
    for name in names:
        d = dataset.sel(estimator=name)
        attitude[name] = _errors(
            time, np.degrees(d["error_rad"].values), np.degrees(d["sigma_rad"].values),
            np.degrees(dataset["bound_rad"].values), "Attitude error {} (deg)",
        )  # fmt: skip
        drift[name] = _errors(
            time, DEG_H * d["drift_error_rad_s"].values, DEG_H * d["drift_sigma_rad_s"].values,
            DEG_H * dataset["bound_drift_rad_s"].values, "Drift error {} (deg/h)",
        )  # fmt: skip
    options: dict[str, Any] = {
        "select": "Estimator", "selected": "quest_ekf" if "quest_ekf" in names else names[0], "group": "estimator",
    }  # fmt: skip
    page.figure(
        attitude, "Fig. 5, attitude: 5% to 95% of the runs and single runs inside the filter's own 3σ band and that of the bound.",
        alt="Attitude error per axis against time with bands.", height=560, **options,
    )  # fmt: skip
    page.figure(
        drift, "Fig. 5, rate: the error of the gyro's estimated drift, which is the error of the rate but for the gyro's noise.",
        alt="Drift error per axis against time with bands.", height=560, **options,
    )  # fmt: skip
    tracks = dataset["outage_angle_rad"].values
    if not tracks.size:
        return
    second = dataset["second"].values
    policies = [str(p) for p in dataset["policy"].values]
    colours = (style.GREEN, style.RED, style.ORANGE, style.BLUE, style.VIOLET, style.AMBER, style.PINK, style.GREY)
    charts = {}
    for i, name in enumerate(names):
        peaks = campaign.figures(name).get("outage_peak_deg") or {}
        own = {"rate_state": "rate_state", "no_gyro": "rate_state"}
        traces = []
        for j, policy in enumerate(p for p in peaks if not (p == "rate_state" and name not in ("mekf_rate_state",))):
            values = np.degrees(np.median(tracks[i][:, policies.index(own.get(policy, policy))], axis=0))
            dash = "dash" if policy == "none" else "solid"
            text = POLICY_TEXT[policy]
            traces.append(line(second, values, text, colours[j % 8], dash=dash, hover="%{x} s<br>%{y:.4g} deg"))
        if traces:
            y = log_axis("Median error angle (deg)", *[t["y"] for t in traces])
            charts[name] = {"data": traces, "layout": layout(xaxis=axis("Seconds after the loss begins"), yaxis=y)}
    if charts:
        options["selected"] = options["selected"] if options["selected"] in charts else next(iter(charts))
        page.figure(
            charts, "Fig. 6: the gyro is lost for a minute. What is put in its place decides.",
            alt="Median error against the time since the gyro loss, one line for each policy.", height=420, **options,
        )  # fmt: skip


def _errors(time: np.ndarray, error: np.ndarray, sigma: np.ndarray, bound: np.ndarray, title: str) -> dict[str, Any]:
    low, high = (np.quantile(error, p, axis=0) for p in (0.05, 0.95))
    spread = np.median(sigma, axis=0)
    traces: list[dict[str, Any]] = []
    for i in range(3):
        place = {**style.on(i), **({} if i == 0 else {"showlegend": False})}
        if np.isfinite(spread).any():
            traces += band(time, -3 * spread[:, i], 3 * spread[:, i], "3σ of the filter", style.AMBER, 0.18, **place)
        traces += band(time, low[:, i], high[:, i], "5% to 95% of runs", style.BLUE, 0.28, **place)
        for j in range(min(2, len(error))):
            more = {**place, **({"showlegend": False} if j else {})}
            traces.append(line(time, error[j, :, i], "single runs", style.GREY, width=0.8, opacity=0.8, **more))
        for sign in (1.0, -1.0):
            more = {**place, **({} if sign > 0 else {"showlegend": False})}
            traces.append(
                line(time, sign * 3 * bound[:, i], "3σ Cramér-Rao bound", style.RED, width=1.3, dash="dash", **more)
            )
    late = time > time[-1] - 0.5 * np.ptp(time)
    most = style.nice_limit(low[late], high[late], 3 * bound[late], error[:2, late])
    axes = style.stacked(3, [title.format(a) for a in AXES], "Time (s)", gap=0.04)
    keys = ("yaxis", "yaxis2", "yaxis3")
    views = {"Steady state": {f"{k}.range": [-most, most] for k in keys}} if most else {}
    return {"data": traces, "layout": layout({"views": {**views, "Whole": {}}}, **axes)}


def add_losses(page: Page, campaign: Campaign) -> None:
    """Tables of gyro losses, star losses, wrong starts and upsets."""
    found = {n: campaign.figures(n) for n in campaign.names}
    peaks = {n: f["outage_peak_deg"] for n, f in found.items() if f.get("outage_peak_deg")}
    if peaks:
        used = [p for p in POLICY_TEXT if any(v.get(p) is not None for v in peaks.values())]
        page.section(
            "Losses, wrong starts and upsets",
            "Each is a pass of its own that begins with the filter's state of that moment.",
            short="Losses, starts",
        )
        columns = [Column("Estimator", align="left"), *(Column(POLICY_TEXT[p], "deg") for p in used)]
        rows = [[n, *(v.get(p) for p in used)] for n, v in peaks.items()]
        page.table(
            columns,
            rows,
            caption="Gyro lost for a minute: median over the runs of the largest error, by what replaces it.",
        )
    star = {n: f["star_loss_deg"] for n, f in found.items() if f.get("star_loss_deg")}
    if star:
        columns = [
            Column("Estimator", align="left"),
            *(Column(t, "deg") for t in ("First second", "After 300 s", "150 s later")),
        ]
        rows = [[n, v["begin"], v["end"], v["later"]] for n, v in star.items()]
        page.table(columns, rows, caption="Stars lost for 300 s: median error.")
    recovery = {n: f["recovery_s"] for n, f in found.items() if f.get("recovery_s")}
    cases = list(dict.fromkeys(c for v in recovery.values() for c in v))
    if not cases:
        return

    def cell(entry: dict[str, Any]) -> Any:
        done, runs = entry["converged"], entry["runs"]
        kind = "good" if done == runs else "part" if done else "bad"
        return (Chip(kind, f"{done}/{runs}"), "" if entry["median"] is None else f"median {entry['median']:.0f} s")

    columns = [Column("Estimator", align="left"), *(Column(_case(c), "runs, time") for c in cases)]
    page.table(
        columns, [[n, *(cell(v[c]) for c in cases)] for n, v in recovery.items()],
        caption=f"Runs whose error is below {number(campaign.attrs.get('recovered_deg'))} deg for good within 300 s, and how soon.",
    )  # fmt: skip


def _case(name: str) -> str:
    kind, *parts = name.replace("deg_h", " deg/h").split("_")
    return f"{kind} {', '.join(parts)}".replace("deg", " deg").replace("  deg", " deg")


def add_sections(page: Page, dataset: xarray.Dataset, campaign: Campaign) -> None:
    """All of the above, in the order of the paper."""
    add_summary(page, campaign.summary)
    add_designs(page, dataset)
    if campaign.runs:
        add_figures_3_and_4(page, dataset)
        add_figures_5_and_6(page, dataset, campaign)
        add_losses(page, campaign)
