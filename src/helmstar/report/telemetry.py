"""The report of `helmstar attitude`: one page from its JSON object and its tables.

`result` is the object of --json; whatever is missing is left out of the page:

| key | holds |
|---|---|
| files, command, versions, rows | list of str, str, {name: version}, {what: count} |
| drift_arcsec_s, drift_sigma_arcsec_s | [x, y, z] at the end; None without a gyro |
| rate_deg_s, rate_sigma_deg_s | the same of the body's rate, where it is a state |
| frames | star images: {total, status: {word: count}, each: list of {file, time_s, status, message, ra_deg, ..}} |
| nis_mean, nis_band | mean over the accepted updates, [low, high] of it |
| rows_rejected, gaps | count, list of {start_s, end_s, duration_s, what} |
| problems | list of {file, row, kind, message, action}, and `rows` if one stands for several |
| noise | {name with unit: {value, source}}, source "sensors.toml" or "estimated from the data" |
| calibration | {misalignment_arcsec, scale_factor_ppm: {value, sigma, sigma_before, bound, observable}}, each [x, y, z] |
| gate_limit, sensors_toml, title, headline | limit of NIS at 3 degrees of freedom; texts |

`frames`: "filtered" and "smoothed" (time_s, q_bn_x .. q_bn_w, sigma_attitude_x_arcsec .., and of drift and rate what there is:
drift_x_arcsec_s .., sigma_drift_x_arcsec_s .., rate_x_deg_s .., sigma_rate_x_deg_s ..) and "updates" (time_s, nis, nis_dof,
status "accepted", "gated", "reopened", "forced" or "restarted", residual_x_arcsec .. in B, and optionally
residual_sigma_x_arcsec ..). `gaps` and frames share one clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import telemetry_figures as figures
from .page import Chip, Column, Figure, Page, number

if TYPE_CHECKING:
    import pandas

SHOWN_ROWS = 200  # of a table; the rest is in the files


def write_telemetry_report(result: dict[str, Any], frames: Mapping[str, pandas.DataFrame], path: Path) -> Path:
    """Write the page of a processed telemetry series to `path` and return it."""
    return telemetry_page(result, frames).write(path)


def telemetry_page(result: dict[str, Any], frames: Mapping[str, pandas.DataFrame]) -> Page:
    """The page of a processed telemetry series, not yet written."""
    files = [str(file) for file in result.get("files") or []]
    names = ", ".join(f"`{Path(file).name}`" for file in files)
    title = (
        "Attitude and gyro drift from telemetry"
        if result.get("drift_arcsec_s")
        else "Attitude and rate from stars alone"
    )
    page = Page(str(result.get("title") or title), subtitle=names)
    page.section("Result")
    page.headline(*_headline(result))
    _add_drift_table(page, result)
    _add_rate_table(page, result)
    _add_calibration(page, result)
    _add_figures(page, result, frames)
    _add_images(page, result)
    page.section("Data quality: problems, gaps, refused rows", short="Data quality")
    _add_quality(page, result)
    page.section("Noise parameters and their source", short="Parameters")
    rows = [
        [name, _value(item.get("value")), item.get("source", "")] for name, item in (result.get("noise") or {}).items()
    ]
    if rows:
        columns = [
            Column("Parameter", align="left"),
            Column("Value", "in the unit of its name", digits=5),
            Column("Source", align="left"),
        ]
        page.table(columns, rows, caption="What the filter assumed about the sensors.", cards=True)
    else:
        page.prose("The result names none.")
    if result.get("sensors_toml"):
        page.code(str(result["sensors_toml"]), "sensors.toml")
    _add_origin(page, result, files)
    return page


def _headline(result: dict[str, Any]) -> tuple[str, ...]:
    if result.get("headline"):
        return (str(result["headline"]),)
    parts = []
    drift, sigma = result.get("drift_arcsec_s"), result.get("drift_sigma_arcsec_s")
    if drift:
        uncertainty = f" ± {', '.join(number(value, 2) for value in sigma)}" if sigma else ""
        parts.append(f"Gyro drift at the end: {', '.join(_fixed(value) for value in drift)}{uncertainty} arcsec/s (1σ)")
    images = result.get("frames")
    if images:
        parts.append(f"{images['status'].get('solved', 0)} of {_count(images['total'], 'frame')} solved")
    mean, limits = result.get("nis_mean"), result.get("nis_band")
    if mean is not None:
        word = ""
        if limits:
            inside = limits[0] <= mean <= limits[1]
            state = "inside" if inside else "above" if mean > limits[1] else "below"
            word = f", {state} its band {number(limits[0])} to {number(limits[1])}"
        parts.append(f"mean NIS {number(mean)}{word}")
    counts = [
        _count(result.get("rows_rejected") or 0, "row") + " rejected",
        _count(len(result.get("gaps") or []), "gap"),
        _count(_problem_rows(result), "bad row") + " found in the files",
    ]
    more = ", ".join(counts) + "."
    return ("; ".join(parts) + "." if parts else "The series was processed."), more


def _add_drift_table(page: Page, result: dict[str, Any]) -> None:
    drift, sigma = result.get("drift_arcsec_s"), result.get("drift_sigma_arcsec_s") or [None] * 3
    mean, limits = result.get("nis_mean"), result.get("nis_band")
    if drift:
        rows = [[name, _fixed(drift[i]), sigma[i]] for i, name in enumerate("xyz")]
        columns = [Column("Axis of B", align="left"), Column("Drift", "arcsec/s")]
        page.table([*columns, Column("1σ", "arcsec/s", digits=2)], rows, caption="Gyro drift at the end of the series.")
    if mean is not None and limits:
        if mean > limits[1]:
            chip, text = Chip("bad", "over-confident"), "Residuals are larger than the noise parameters say."
        elif mean < limits[0]:
            chip, text = Chip("part", "too cautious"), "Residuals are smaller than the noise parameters say."
        else:
            chip, text = Chip("good", "consistent"), "Residuals are as large as the noise parameters say."
        columns = [Column("Mean NIS", align="left"), Column("Band"), Column("Verdict", align="left")]
        row = [mean, f"{number(limits[0])} to {number(limits[1])}", (chip, text)]
        page.table([*columns], [row])


def _add_rate_table(page: Page, result: dict[str, Any]) -> None:
    rate, sigma = result.get("rate_deg_s"), result.get("rate_sigma_deg_s") or [None] * 3
    if rate:
        columns = [
            Column("Axis of B", align="left"),
            Column("Rate", "deg/s", digits=6),
            Column("1σ", "deg/s", digits=2),
        ]
        rows = [[name, rate[i], sigma[i]] for i, name in enumerate("xyz")]
        page.table(columns, rows, caption="Rate of the body at the end of the series.")


def _add_images(page: Page, result: dict[str, Any]) -> None:
    """The star images that stand for attitudes, each with what became of it."""
    images = result.get("frames")
    if not images:
        return
    page.section("Star images", short="Images")
    rows = []
    for e in images["each"][:SHOWN_ROWS]:
        good = e["status"] == "solved"
        sigma = e.get("sigma_arcsec")
        rows.append(
            [
                Path(e["file"]).name,
                e["time_s"],
                (Chip("good" if good else "bad", e["status"]), e["message"] or ""),
                e.get("ra_deg"),
                e.get("dec_deg"),
                e.get("roll_deg"),
                max(sigma[:2]) if sigma else None,
                sigma[2] if sigma else None,
                e.get("stars"),
                e.get("residual_rms_arcsec"),
            ]
        )
    columns = [
        Column("File", align="left"),
        Column("Time", "s", digits=9),
        Column("Status", align="left"),
        Column("RA", "deg", digits=8),
        Column("Dec", "deg", digits=7),
        Column("Roll", "deg", digits=7),
        Column("1σ across", "arcsec", digits=2),
        Column("1σ roll", "arcsec", digits=2),
        Column("Stars"),
        Column("Residual", "arcsec", digits=3),
    ]
    caption = "Each image, solved on its own or near where the ones before lead to; those that are not solved are gaps."
    page.table(columns, rows, caption=_caption("Star images", images["total"]) + " " + caption)


def _add_calibration(page: Page, result: dict[str, Any]) -> None:
    """Misalignment and scale factors, with what the record allows to be known of them."""
    rows = []
    for name, c in (result.get("calibration") or {}).items():
        what, unit = name.rsplit("_", 1)
        for i, axis in enumerate("xyz"):
            shown = c["observable"][i]
            chip = Chip("good", "shown") if shown else Chip("part", "not shown")
            rows.append(
                [
                    f"{what.replace('_', ' ')} {axis}",
                    unit,
                    c["value"][i],
                    c["sigma"][i],
                    c["sigma_before"][i],
                    c["bound"][i],
                    chip,
                ]
            )
    if not rows:
        return
    columns = [
        Column("Calibration", align="left"),
        Column("Unit", align="left"),
        Column("Value", digits=5),
        Column("1 sigma"),
        Column("before"),
        Column("bound"),
        Column("In this record"),
    ]
    page.table(
        columns, rows,
        caption="Misalignment of the gyro to the star tracker and scale factors. What the bound leaves at more than half of "
        "what was known before is not estimated.",
    )  # fmt: skip


def _add_figures(page: Page, result: dict[str, Any], frames: Mapping[str, pandas.DataFrame]) -> None:
    states = {kind: frames[kind] for kind in ("filtered", "smoothed") if kind in frames and len(frames[kind])}
    updates = frames.get("updates")
    times = [np.asarray(table["time_s"], dtype=float) for table in frames.values() if len(table)]
    if not times:
        return
    clock = figures.Clock.of(np.concatenate(times))
    gaps = figures.gap_shapes(result.get("gaps") or [], clock)
    grey = " Grey stripes are gaps." if gaps else ""
    some = next(iter(states.values()), None)
    if some is not None and "rate_x_deg_s" in some:
        page.section("Body rate", short="Rate")
        page.figure(
            figures.vector(states, clock, gaps, "rate", "deg/s"),
            f"The body's rate as a state, filtered and smoothed, with 3σ bands.{grey}",
            alt="Rate of the body per axis in degrees per second over time, filtered and smoothed, with 3 sigma bands.",
            height=600,
        )
    if some is not None and "drift_x_arcsec_s" in some:
        page.section("Gyro drift", short="Drift")
        page.figure(
            figures.vector(states, clock, gaps),
            f"Both estimates should agree within their 3σ bands; the smoothed one knows the whole series.{grey}",
            alt="Gyro drift per axis in arcseconds per second over time, filtered and smoothed, with 3 sigma bands.",
            height=600,
        )
    if states:
        page.section("Attitude and its uncertainty", short="Attitude")
        page.figures(
            [
                Figure(
                    figures.attitude_sigma(states, clock, gaps),
                    f"How well the filter says it knows the attitude; shaded: its swing between measurements.{grey}",
                    "One sigma of the attitude per axis in arcseconds over time, filtered and smoothed, logarithmic.",
                ),
                Figure(
                    figures.attitude(states, clock, gaps),
                    "The attitude as a quaternion (scalar last), signs chosen so that it does not jump.",
                    "The four components of the attitude quaternion over time.",
                ),
            ]
        )
    if updates is not None and len(updates):
        page.section("Residuals and NIS")
        page.figure(
            figures.residuals(updates, clock, gaps),
            "Measured minus predicted attitude in B: noise without trend means that the model fits; crosses are rows "
            "that the gate refused.",
            alt="Attitude residuals per axis in arcseconds over time, refused rows marked.",
            height=560,
        )
        page.figure(
            figures.nis(updates, clock, gaps, _gate(result, updates)),
            "NIS over its degrees of freedom: the running mean belongs into the green band; points above the gate are "
            "refused.",
            alt="Normalised innovation squared over its degrees of freedom over time, with band, gate, refused rows.",
            height=420,
        )


def _gate(result: dict[str, Any], updates: pandas.DataFrame) -> np.ndarray | None:
    """The gate over its degrees of freedom for each update, from the limit at 3 degrees of freedom."""
    limit = result.get("gate_limit")
    if not limit or "nis_dof" not in updates:
        return None
    from scipy.special import gammaincc, gammainccinv

    probability = gammaincc(1.5, 0.5 * limit)
    dof = np.asarray(updates["nis_dof"], dtype=float)
    found = {value: 2.0 * float(gammainccinv(0.5 * value, probability)) / value for value in np.unique(dof[dof > 0])}
    return np.array([found.get(value, np.nan) for value in dof])


def _add_quality(page: Page, result: dict[str, Any]) -> None:
    problems, gaps = result.get("problems") or [], result.get("gaps") or []
    if problems:
        rows = [
            [
                (Path(str(item.get("file", ""))).name, f"row {item.get('row')}"),
                item.get("kind"),
                item.get("message"),
                item.get("action"),
            ]
            for item in problems[:SHOWN_ROWS]
        ]
        columns = [Column(name, align="left") for name in ("Where", "Kind", "What is wrong", "What was done")]
        page.table(columns, rows, caption=_caption("Bad rows of the files", len(problems)), cards=True)
    else:
        page.prose("No bad rows were found in the files.")
    if gaps:
        rows = [[item.get("what"), item.get("start_s"), item.get("end_s"), item.get("duration_s")] for item in gaps]
        columns = [
            Column("Missing", align="left"),
            Column("From", "s", digits=12),
            Column("To", "s", digits=12),
            Column("Duration", "s", digits=5),
        ]
        page.table(columns, rows[:SHOWN_ROWS], caption=_caption("Gaps", len(gaps)))
    else:
        page.prose("No gaps: no step is longer than three median steps.")


def _add_origin(page: Page, result: dict[str, Any], files: list[str]) -> None:
    page.section("How to reproduce this", short="Reproduce")
    if result.get("command"):
        page.code(str(result["command"]), "Command")
    facts = [("File", file) for file in files]
    facts += [(f"Rows, {what}", number(count)) for what, count in (result.get("rows") or {}).items()]
    facts += [(str(name), str(version)) for name, version in (result.get("versions") or {}).items()]
    if facts:
        with page.details("Files, row counts and versions"):
            page.table([Column("What", align="left"), Column("Value", align="left")], facts)


def _caption(what: str, count: int) -> str:
    return f"{what} ({count})." if count <= SHOWN_ROWS else f"{what}: the first {SHOWN_ROWS} of {count}."


def _problem_rows(result: dict[str, Any]) -> int:
    return sum(int(item.get("rows", 1)) for item in result.get("problems") or [])


def _count(count: int, noun: str) -> str:
    return f"{number(count)} {noun}{'' if count == 1 else 's'}"


def _fixed(value: float | None) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.3f}".replace("-", "−")


def _value(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return ", ".join(number(item, 4) if isinstance(item, (int, float)) else str(item) for item in value)
    return value
