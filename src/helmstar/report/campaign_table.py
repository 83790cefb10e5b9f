"""The summary of a campaign in words: one headline, one table with a verdict on every estimator."""

from __future__ import annotations

from typing import Any

import numpy as np

from .campaign_data import Campaign
from .numbers import chi_square_ratio_band
from .page import Chip, Column, Page, number

NEES_DEGREES = 3  # three attitude errors are scored for every estimator, whatever else it estimates


def headline(campaign: Campaign) -> tuple[str, ...]:
    """The result in one sentence, then what to know besides."""
    if not campaign.runs:
        return ("No run is finished yet.",)
    names, runs = campaign.names, campaign.runs
    settled = campaign.settled["1 deg"]
    full = [name for name in names if np.isfinite(settled[name]).all()]
    first = f"{_runs(runs)} of `{names[0]}`" if len(names) == 1 else f"Over {_runs(runs)}"
    if len(names) == 1:
        count = int(np.isfinite(settled[names[0]]).sum())
        first += f": {count} settle{'s' if count == 1 else ''} below 1 deg"
    else:
        first += f", {len(full)} of {len(names)} estimators settle below 1 deg in every run"
    best = _best(campaign)
    if best:
        name, ratio, nees = best
        subject = "it stays at" if len(names) == 1 else f"`{name}` comes closest to the Cramér-Rao bound,"
        first += f"; {subject} {ratio:.3g} times {'the bound' if len(names) == 1 else 'it'} on its worst axis"
        if nees is not None:
            kind = {"good": "honest", "bad": "over-confident", "part": "too cautious"}[nees_chip(nees, runs).kind]
            first += f", with {'an' if kind[0] in 'oh' else 'a'} {kind} covariance (NEES {nees:.3g}, right is 3)"
    failed = [f"`{name}`" for name in names if not np.isfinite(settled[name]).any()]
    more = f"No run of {', '.join(failed)} settles below 1 deg." if failed and len(failed) < len(names) else ""
    return first + ".", more


def add_summary_table(page: Page, campaign: Campaign) -> None:
    """One row per estimator: convergence, error, bound, NEES, time."""
    runs = max(campaign.runs, 1)
    low, high = (float(edge) * NEES_DEGREES for edge in chi_square_ratio_band(NEES_DEGREES * runs))
    at = f"deg, update {_last_key(campaign)}"
    columns = [
        Column("Estimator", align="left"),
        Column("Below 1 deg", "runs, last by"),
        Column("Below 0.1 deg", "runs, last by"),
        Column("RMS / bound", "worst axis"),
        Column("NEES", "3 is right"),
        Column("Median error", f"{at}; RMS x, y, z"),
        Column("Above 10 deg", "runs at the end"),
        Column("Time", "µs per step"),
    ]
    page.prose(
        f"NEES is the squared error in units of the filter's own covariance. For {_runs(runs)} its mean at one update "
        f"lies in {low:.3g} to {high:.3g} with 95% probability if the covariance is right: above, the filter is "
        "over-confident; below, it is too cautious."
    )
    page.table(columns, [_row(campaign, name) for name in campaign.names], caption=_window(campaign))


def nees_chip(nees: float, runs: int) -> Chip:
    """Is the covariance honest, judged by the band of one update for this number of runs?"""
    low, high = (float(edge) * NEES_DEGREES for edge in chi_square_ratio_band(NEES_DEGREES * max(runs, 1)))
    if nees > high:
        return Chip("bad", "over-confident")
    return Chip("part", "too cautious") if nees < low else Chip("good", "honest")


def bound_chip(ratio: float, runs: int) -> Chip:
    """Is RMS over bound 1 within the scatter of this number of runs?"""
    low, high = (float(edge) ** 0.5 for edge in chi_square_ratio_band(max(runs, 1)))
    if ratio > high:
        return Chip("plain", "above the bound")
    return Chip("plain", "below the bound") if ratio < low else Chip("good", "at the bound")


def _row(campaign: Campaign, name: str) -> list[Any]:
    found, runs = campaign.figures(name), campaign.runs
    key = _last_key(campaign)
    rms = (found.get("rms_deg") or {}).get(key)
    ratio, nees = _worst(found.get("rms_over_bound")), found.get("nees_mean")
    diverged = found.get("diverged")
    counts = [_settled(campaign, name, text) for text in ("1 deg", "0.1 deg")]
    converges = counts[0][2] > 0
    median = (found.get("median_error_deg") or {}).get(key) if isinstance(found.get("median_error_deg"), dict) else None
    time = found.get("us_per_step", campaign.us_per_step.get(name))
    return [
        name,
        *[(Chip("good" if done == runs else "part" if done else "bad", text), by) for text, by, done in counts],
        None if ratio is None else (ratio, bound_chip(ratio, runs) if converges else None),
        None if nees is None else (nees, nees_chip(nees, runs) if converges else None),
        (median, ", ".join(number(value, 2) for value in rms) if rms else ""),
        None if diverged is None else int(diverged),
        time,
    ]


def _settled(campaign: Campaign, name: str, threshold: str) -> tuple[str, str, int]:
    said = (campaign.figures(name).get("converged") or {}).get(threshold.replace(" ", ""))
    values = campaign.settled[threshold][name]
    done = int(said["runs"]) if said and said.get("runs") is not None else int(np.isfinite(values).sum())
    by = said.get("by") if said else (float(values.max()) if done and done == len(values) else None)
    return f"{done}/{campaign.runs}", f"by {by:.0f}" if by is not None and done else "", done


def _best(campaign: Campaign) -> tuple[str, float, float | None] | None:
    settled = campaign.settled["1 deg"]
    ratios = {
        name: ratio
        for name in campaign.names
        if np.isfinite(settled[name]).all() and (ratio := _worst(campaign.figures(name).get("rms_over_bound")))
    }
    if not ratios:
        return None
    name = min(ratios, key=lambda one: round(abs(float(np.log(ratios[one]))), 2))  # of equals the first
    return name, ratios[name], campaign.figures(name).get("nees_mean")


def _worst(ratios: Any) -> float | None:
    values = [value for value in ratios or [] if value is not None and np.isfinite(value)]
    return max(values) if values else None


def _last_key(campaign: Campaign) -> str:
    keys = {key for name in campaign.names for key in campaign.figures(name).get("rms_deg") or {}}
    return max(keys, key=lambda key: float(key)) if keys else str(int(campaign.update[-1]))


def _window(campaign: Campaign) -> str:
    over = campaign.attrs.get("pooled_text", "steady-state updates")
    return (
        f"RMS / bound and NEES are pooled over runs and {over}. A run counts as below a limit "
        "from the update on after which it never exceeds it again."
    )


def _runs(count: int) -> str:
    return f"{count} run{'' if count == 1 else 's'}"
