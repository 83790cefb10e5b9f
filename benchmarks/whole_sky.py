"""Identification over the whole sky against false stars, noise, missing stars and field. See identification.py --sky."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from helmstar.progress import Progress
from helmstar.report import style
from helmstar.report.page import Column, Page
from helmstar.stars import Pinhole, default_sky, identify
from helmstar.stars.synthetic import scene

FIELDS = (5.0, 12.0, 20.0)
SWEEPS: dict[str, tuple[str, str, tuple[float, ...]]] = {
    "false": ("False stars among 30 true", "", (0, 10, 20, 40, 60, 80, 100)),
    "noise_px": ("Noise of positions", "px", (0.1, 0.2, 0.5, 1.0, 1.5, 2.0)),
    "dropped": ("Missing share of the 30 stars", "", (0.0, 0.2, 0.4, 0.6, 0.7, 0.8)),
    "fov_deg": ("Field of view", "deg", (5.0, 7.0, 10.0, 14.0, 19.0, 25.0)),
}
SIZE = (1024, 1024)
COLOURS = {5.0: (style.BLUE, "circle"), 12.0: (style.ORANGE, "square"), 20.0: (style.GREEN, "diamond")}


def cell(fov_deg: float, magnitudes: bool, runs: int, seed: int, **kinds: Any) -> dict[str, float]:
    """Rate, its binomial standard error and Wilson's interval (1 sigma), wrong ones, and milliseconds of `runs` scenes."""
    camera = Pinhole.of_field(math.radians(fov_deg), SIZE)
    right, wrong, ms = 0, 0, []
    for k in range(runs):
        s = scene(default_sky(), camera, np.random.default_rng([seed, k]), **kinds)
        begin = time.perf_counter()
        found = identify(
            s.xy_px, camera, flux=s.flux if magnitudes else None, sigma_px=max(0.3, kinds.get("noise_px", 0.3))
        )
        ms.append(1e3 * (time.perf_counter() - begin))
        if found.solved:
            good = bool((s.star[found.detections] == found.stars).mean() > 0.5)
            right, wrong = right + good, wrong + (not good)
    p = right / runs
    middle, half = (
        (p + 0.5 / runs) / (1.0 + 1.0 / runs),
        math.sqrt(p * (1.0 - p) / runs + 0.25 / runs**2) / (1.0 + 1.0 / runs),
    )
    return {
        "runs": runs, "rate": p, "standard_error": math.sqrt(p * (1.0 - p) / runs), "low": middle - half, "high": middle + half,
        "false": wrong, "ms_median": float(np.median(ms)), "ms_95": float(np.percentile(ms, 95)),
    }  # fmt: skip


def run(runs: int, seed: int) -> list[dict[str, Any]]:
    """All cells: sweep, value, field, with magnitudes or without."""
    jobs = []
    for sweep, (_, _, values) in SWEEPS.items():
        for magnitudes in (True, False):
            for value in values:
                if sweep == "fov_deg":
                    jobs.append((sweep, value, value, magnitudes, {}))
                else:
                    kinds = {sweep: int(value) if sweep == "false" else value}
                    jobs += [(sweep, value, fov, magnitudes, kinds) for fov in FIELDS]
    out = []
    with Progress(True) as progress:
        task = progress.add("skies", len(jobs))
        for sweep, value, fov, magnitudes, kinds in jobs:
            found = cell(fov, magnitudes, runs, seed, **kinds)
            out.append({"sweep": sweep, "value": value, "fov_deg": fov, "magnitudes": magnitudes, **found})
            progress.advance(task)
    return out


def figure(cells: list[dict[str, Any]], sweep: str) -> dict[str, Any]:
    """Rate against the swept value, a line for each field, dashed without magnitudes."""
    title, unit, values = SWEEPS[sweep]
    some = [c for c in cells if c["sweep"] == sweep]
    traces = []
    for fov in (None,) if sweep == "fov_deg" else FIELDS:
        colour, symbol = COLOURS.get(fov or 0.0, (style.BLUE, "circle"))
        for magnitudes in (True, False):
            row = [c for c in some if c["magnitudes"] == magnitudes and fov in (None, c["fov_deg"])]
            # Lines that lie on each other would hide each other: moved apart a little.
            apart = (
                0.004 * (values[-1] - values[0]) * ((0 if fov is None else 2 * FIELDS.index(fov)) + (not magnitudes))
            )
            x, rate = [c["value"] + apart for c in row], np.array([c["rate"] for c in row])
            name = ("" if fov is None else f"{fov:g} deg, ") + ("magnitudes" if magnitudes else "no magnitudes")
            traces.append(
                {
                    **style.line(x, rate, name, colour, hover="%{x}<br>%{y:.3f}"),
                    "mode": "lines+markers",
                    "line": {"color": colour, "width": 2, "dash": "solid" if magnitudes else "dash"},
                    "marker": {"symbol": symbol if magnitudes else symbol + "-open", "size": 8, "color": colour},
                    "error_y": {
                        "type": "data", "symmetric": False, "array": [c["high"] - c["rate"] for c in row],
                        "arrayminus": [c["rate"] - c["low"] for c in row], "color": colour, "thickness": 1, "width": 3,
                    },
                }
            )  # fmt: skip
    low = min(c["low"] for c in some)
    x_axis = style.axis(f"{title} ({unit})" if unit else title, tickvals=list(values))
    y_axis = style.axis("Identified right", range=[min(0.9, low - 0.02), 1.01])
    return {"data": traces, "layout": style.layout(xaxis=x_axis, yaxis=y_axis)}


def write_report(cells: list[dict[str, Any]], path: Path, command: str) -> Path:
    """The page with a plot and a table for each sweep."""
    runs, wrong = cells[0]["runs"], sum(c["false"] for c in cells)
    total = sum(c["runs"] for c in cells)
    page = Page("Identification over the whole sky", subtitle=f"{total} scenes, {runs} for each point")
    page.section(
        "What was done",
        "Attitudes are drawn evenly over all rotations. A scene holds the 30 brightest stars of its field on 1024 x 1024 pixels, "
        "with 0.3 px noise and magnitudes good to 0.3 mag; one thing at a time is made worse. No prior attitude is used; the "
        "field is known to 0.1%.",
    )
    page.headline(f"{wrong} of {total} scenes were given a false solution.")
    for sweep, (title, unit, values) in SWEEPS.items():
        page.section(title)
        page.figure(
            figure(cells, sweep),
            "Share identified right; bars are Wilson's 1 sigma interval. Dashed: the list has no magnitudes and no order. "
            "Points of one value stand a little apart.",
            alt=f"Identification rate against {title.lower()}.",
            height=420,
        )
        kinds = [(fov, m) for fov in ((None,) if sweep == "fov_deg" else FIELDS) for m in (True, False)]
        columns = [Column(title, unit)]
        for fov, m in kinds:
            what = ("" if fov is None else f"{fov:g} deg, ") + ("with m." if m else "without")
            columns += [Column(what), Column("", "ms", digits=2)]
        rows = []
        for value in values:
            row: list[Any] = [value]
            for fov, m in kinds:
                at = (sweep, value, m)
                c = next(
                    c for c in cells if (c["sweep"], c["value"], c["magnitudes"]) == at and fov in (None, c["fov_deg"])
                )
                row.append(f"{c['rate']:.3f} ± {c['standard_error']:.3f}")
                row.append(c["ms_median"])
            rows.append(row)
        page.table(
            columns,
            rows,
            caption="With magnitudes (m.) or without: rate with its binomial standard error, and the median time on one core.",
        )
    page.section("How to reproduce this", short="Reproduce")
    page.code(command, "Command")
    return page.write(path)
