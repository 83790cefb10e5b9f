"""Estimators compared run by run on the same draws, so that what the draws share drops out of the difference."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from .campaign_data import Campaign
from .page import Chip, Column, Page

SURE = 3.0  # standard errors
ROUNDING = 1e-6  # of the reference's error: a smaller difference is one of rounding, however sure


def add_paired(page: Page, campaign: Campaign) -> None:
    """A table of every estimator against its reference; nothing where there is nothing to compare.

    The dataset's attributes say what is compared: `references`, JSON of estimator -> reference, and `pooled_updates`, the
    first and last update of a run's score.
    """
    rows = [row for name in campaign.names if (row := _row(campaign, name))]
    if not rows:
        return
    first, last = campaign.attrs["pooled_updates"]
    page.heading("Paired comparison")
    page.table(
        [
            Column("Estimator", align="left"),
            Column("Reference", align="left"),
            Column("RMS difference", "arcsec"),
            Column("Standard error", "arcsec"),
            Column("Closer to the truth", "runs"),
            Column("Verdict", align="left"),
        ],
        rows,
        caption=(
            f"RMS of a run's total error over updates {first} to {last}, minus that of the reference in the same run, which "
            f"has the same noise and the same tuning: mean over runs. A difference counts from {SURE:g} standard errors on."
        ),
    )


def scores(campaign: Campaign, name: str) -> np.ndarray:
    """RMS of the total error of each run (run,) over the pooled updates, in arcsec; NaN for a lost run."""
    first, last = campaign.attrs["pooled_updates"]
    window = (campaign.update >= first) & (campaign.update <= last)
    return 3600.0 * np.sqrt(np.mean(np.sum(campaign.errors[name][:, window] ** 2, axis=-1), axis=1))


def _row(campaign: Campaign, name: str) -> list[Any] | None:
    from ..evaluate.paired import paired_difference

    reference = json.loads(campaign.attrs.get("references") or "{}").get(name)
    if reference == name or reference not in campaign.names:
        return None
    if campaign.runs < 2 or campaign.update[-1] < campaign.attrs["pooled_updates"][1]:
        return None
    score, other = scores(campaign, name), scores(campaign, reference)
    if np.sum(np.isfinite(score) & np.isfinite(other)) < 2:
        return [name, reference, None, None, "lost", Chip("bad", "lost")]
    d = paired_difference(score, other)
    if abs(d.mean) <= ROUNDING * np.nanmean(other):
        verdict = Chip("plain", "same to rounding")
    elif abs(d.sigmas) < SURE:
        verdict = Chip("plain", "no difference")
    else:
        verdict = Chip("good", "better") if d.mean < 0 else Chip("part", "worse")
    return [name, reference, d.mean, d.standard_error, f"{d.wins}/{d.runs}", verdict]
