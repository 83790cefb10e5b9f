"""The report of a Monte Carlo campaign: one page from its dataset, its summary and what became of a paper's claims.

`dataset`: dims run, time, estimator, axis; `error_rad` and `sigma_rad` (estimator, run, time, axis) with error = truth
[-] estimate in N, X = X_hat exp([xi x]); `nees`, `nis`, `nis_dof` (estimator, run, time); `truth_q_bn` (time or run,
time, quaternion); `bound_rad` (time, axis) 1 sigma; `us_per_step` (estimator). `summary` is the object that
`helmstar run --json` prints. Whatever is missing or NaN is left out of the page or shown as a dash.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import approach, li2007, zhou2021
from . import campaign_figures as parts
from .campaign_data import Campaign
from .campaign_table import add_summary_table, headline
from .claims import Claim, add_claims
from .page import Column, Page
from .paired import add_paired

if TYPE_CHECKING:
    import xarray


def write_monte_carlo_report(
    dataset: xarray.Dataset, summary: dict[str, Any], claims: Sequence[Claim], path: Path
) -> Path:
    """Write the page of a campaign to `path` and return it."""
    return monte_carlo_page(dataset, summary, claims).write(path)


def monte_carlo_page(dataset: xarray.Dataset, summary: dict[str, Any], claims: Sequence[Claim]) -> Page:
    """The page of a campaign, not yet written."""
    campaign = Campaign.from_dataset(dataset, summary)
    runs = f"{campaign.runs} run{'s' if campaign.runs != 1 else ''}"
    page = Page(
        str(campaign.attrs.get("title") or campaign.scenario),
        subtitle=f"Scenario `{campaign.scenario}`, {runs} of {int(campaign.update[-1])} updates, seed {campaign.seed}",
    )
    page.section("Result")
    own: Any = {"zhou2021": zhou2021, "li2007": li2007, "approach": approach}.get(str(campaign.attrs.get("experiment")))
    page.headline(*(own.headline(summary) if own else headline(campaign)))
    if campaign.runs < campaign.requested:
        page.notice(
            f"The campaign was interrupted: {campaign.runs} of {campaign.requested} runs are finished. Every figure "
            "on this page is about the finished runs; the same command with `--resume` does the others."
        )
    lost = campaign.lost_runs() if "error_rad" in dataset else {}
    if lost:
        names = ", ".join(f"`{name}` ({count})" for name, count in lost.items())
        page.notice(f"Runs whose estimate was no longer a number at the end: {names}. They count as not converged.")
    if claims:
        page.section("The paper's claims", short="Claims")
        add_claims(page, claims)
    if own:
        own.add_sections(page, dataset, campaign)
        if campaign.runs and own is zhou2021:
            parts.add_consistency(page, campaign)
            parts.add_bound_and_time(page, campaign)
        _add_origin(page, campaign)
        return page
    page.section("Summary of all estimators", short="Summary")
    add_summary_table(page, campaign)
    add_paired(page, campaign)
    if campaign.runs:
        parts.add_paper_figures(page, campaign)
        parts.add_convergence(page, campaign)
        parts.add_error(page, campaign)
        parts.add_consistency(page, campaign)
        parts.add_settling(page, campaign)
        parts.add_bound_and_time(page, campaign)
    _add_origin(page, campaign)
    return page


def _add_origin(page: Page, campaign: Campaign) -> None:
    attrs = campaign.attrs
    page.section("How to reproduce this", short="Reproduce")
    if attrs.get("command"):
        page.code(str(attrs["command"]), "Command")
    facts: list[tuple[str, Any]] = [
        ("Scenario", campaign.scenario),
        ("Seed", campaign.seed),
        ("Runs finished", campaign.runs),
        ("Runs asked for", campaign.requested),
        ("Wall time (s)", attrs.get("wall_s", campaign.summary.get("wall_s"))),
        *_versions(attrs),
    ]
    with page.details("Versions and facts of this campaign"):
        rows = [[name, str(value) if isinstance(value, (int, np.integer)) else value] for name, value in facts]
        page.table([Column("What", align="left"), Column("Value", align="left", digits=4)], rows)
    if attrs.get("configuration"):
        with page.details("Configuration of the scenario"):
            page.code(str(attrs["configuration"]), "Configuration (TOML)")


def _versions(attrs: dict[str, Any]) -> list[tuple[str, Any]]:
    versions: dict[str, Any] = {}
    if attrs.get("helmstar_version"):
        versions["helmstar"] = attrs["helmstar_version"]
    raw = attrs.get("versions")
    try:
        found = json.loads(raw) if isinstance(raw, str) else raw
        versions |= found if isinstance(found, dict) else {"versions": str(raw)} if raw else {}
    except json.JSONDecodeError:
        versions["versions"] = str(raw)
    return [(name, str(value)) for name, value in versions.items()]
