"""The sections of a campaign's report that hold figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import figures, style
from .campaign_data import SINGLE_POINTS, Campaign
from .encode import extremes
from .numbers import (
    chi_square_ratio_band,
    euler_difference_deg,
    mean_over_runs,
    tait_bryan_deg,
    total_quantile,
)
from .page import Figure, Page, number

GROUP = "estimator"
WITHIN = 0.9973  # probability of 3 sigma
PREFERRED = ("lie_tuned", "lie", "quest_ekf")


def add_paper_figures(page: Page, campaign: Campaign) -> None:
    """Figs. 3 and 4 of xu2020: one run's rotation-vector error, and its Euler-angle view beside it."""
    from scipy.spatial.transform import Rotation

    rows = [
        ("Fig. 3, the filter on SO(3)", "lie"),
        ("Fig. 4, the quaternion EKF with both stars", "quaternion_ekf"),
        ("Fig. 4, the quaternion EKF with one star", "quaternion_ekf_one_star"),
        ("The printed equations", "lie_printed"),
    ]
    rows = [row for row in rows if row[1] in campaign.errors]
    if not rows or campaign.truth is None:
        return
    pitch = tait_bryan_deg(Rotation.from_quat(campaign.truth).as_matrix())[:, 1]
    locked = (
        f"The true pitch is at {pitch[0]:.0f} deg, where roll and yaw are not defined separately: the Euler view shows "
        "degrees of error that do not exist. "
    )
    page.section(
        "Figs. 3 and 4 of the paper" if "xu2020" in campaign.scenario else "One run, two views of its error",
        f"Errors of run {campaign.run_ids[0]}. First the rotation vector, which is what the attitude is really wrong "
        "by, then the same run as roll, pitch and yaw of the estimate minus those of the truth (R = Rz Ry Rx). "
        f"{locked if np.min(np.abs(pitch)) > 80 else ''}Both plots of a pair start with the same scale.",
        short="Figs. 3, 4" if "xu2020" in campaign.scenario else "One run",
    )
    for title, name in rows:
        error = campaign.errors[name][0]
        difference = euler_difference_deg(campaign.truth, np.radians(error))
        index = extremes(np.concatenate([error, difference], axis=1).T, 2 * SINGLE_POINTS)
        late = figures.late_part(campaign.update)
        lower = np.abs(np.concatenate([error[late], difference[late]]))
        lower = lower[np.isfinite(lower)]
        both = style.nice_limit(np.quantile(lower, 0.95)) if lower.size else None  # a spike shall not set the scale
        update = campaign.update[index]
        page.heading(f"{title}: {name}" if "xu2020" in campaign.scenario else name)
        page.figures(
            [
                Figure(
                    figures.rotation_error(update, error[index], both),
                    f"Rotation vector: the run {_fate(campaign, name)}; it ends at {_vector(error[-1])} deg (x, y, z).",
                    f"Line plot of the rotation-vector error of {name} in degrees on x, y and z against the update.",
                    height=330,
                ),
                Figure(
                    figures.euler_view(update, difference[index], both),
                    "The same run as Euler angles: what exceeds the rotation vector is gimbal lock, not error.",
                    f"Line plot of the differences of roll, pitch and yaw of {name} in degrees against the update.",
                    height=330,
                ),
            ]
        )


def add_convergence(page: Page, campaign: Campaign) -> None:
    """Median total error of all estimators, those of the paper's tuning and the tuned ones side by side."""
    page.section("Convergence of all estimators", short="Convergence")
    bound = total_quantile(campaign.bound[campaign.shown], 0.5)
    update = campaign.update[campaign.shown]
    groups = {
        "the paper's tuning": [name for name in campaign.names if not name.endswith(style.TUNED)],
        "consistent tuning, started from a Wahba fix": [n for n in campaign.names if n.endswith(style.TUNED)],
    }
    page.figures(
        [
            Figure(
                figures.convergence(update, {name: campaign.medians[name] for name in names}, bound),
                f"Estimators with {title}: lines that lie on one another are estimators that agree (markers tell them "
                "apart; tap a name to hide it).",
                f"Median total error in degrees on a logarithmic axis against the update for {', '.join(names)}.",
                height=430,
            )
            for title, names in groups.items()
            if names
        ]
    )


def add_error(page: Page, campaign: Campaign) -> None:
    """Error with bands, linear per axis and logarithmic in total, of the estimator that the reader chooses."""
    page.section("Error with its bands", short="Error")
    by_axis, total = {}, {}
    update = campaign.update[campaign.shown]
    bound = campaign.bound[campaign.shown]
    for name in campaign.names:
        low, median, high = campaign.quantiles_by_axis(name)
        low_total, median_total, high_total = campaign.quantiles_total(name)
        sigma = campaign.sigma(name)
        chosen = campaign.single_runs(name)
        singles = {
            run: (campaign.update[index], campaign.errors[name][i, index]) for i, (run, index) in enumerate(chosen)
        }
        totals = {
            run: (campaign.update[index], _finite(campaign.totals[name][i, index]))
            for i, (run, index) in enumerate(chosen)
        }
        within = total_quantile(sigma, WITHIN), total_quantile(bound, WITHIN)
        by_axis[name] = figures.error_by_axis(update, low, median, high, sigma, bound, name, singles)
        total[name] = figures.error_total(update, low_total, median_total, high_total, *within, name, totals)
    options: dict[str, Any] = {"select": "Estimator", "selected": _preferred(campaign), "group": GROUP}
    page.figure(
        by_axis,
        "A filter is honest where nearly all runs stay inside its 3σ band, and efficient where that band lies on the "
        "3σ Cramér-Rao bound.",
        alt="Error per axis in degrees against the update, with 3 sigma band, quantiles over runs, single runs, bound.",
        height=620,
        **options,
    )
    page.figure(
        total,
        "Total error angle: how fast the start-up fades, and where it settles. The 99.7% lines are what Gaussian "
        "errors of the filter's own sigma, and of the bound, stay below.",
        alt="Total error angle in degrees on a logarithmic axis against the update, with quantiles, band and bound.",
        height=400,
        **options,
    )


def add_consistency(page: Page, campaign: Campaign) -> None:
    """NEES and NIS over time with their bands."""
    charts = {}
    for name in campaign.names:
        nees, nees_count = mean_over_runs(campaign.nees[name])
        dof, _ = mean_over_runs(campaign.nis_dof[name])
        counted = np.where(np.isfinite(campaign.nis[name]), campaign.nis_dof[name], np.nan)
        dof_sum = np.nansum(counted, axis=0)
        nis, nis_count = mean_over_runs(campaign.nis[name])
        if not nees_count.any() and not nis_count.any():
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            nis = np.where(dof > 0, nis / dof, np.nan)
        nees = nees / campaign.nees_dof
        limits = _inside(nees, nees_count * campaign.nees_dof)
        index = extremes(np.stack([nees, nis]), SINGLE_POINTS)
        figure = figures.consistency(
            campaign.update[index],
            nees[index],
            chi_square_ratio_band(nees_count[index] * campaign.nees_dof),
            nis[index],
            chi_square_ratio_band(dof_sum[index]),
            name,
            campaign.nees_dof,
        )
        shares = [("NEES", limits), ("NIS", _inside(nis, dof_sum))]
        said = [f"{what} lies inside its band at {share:.0%} of the updates" for what, share in shares if share >= 0]
        figure["layout"]["meta"]["note"] = "; ".join(said) + " (95% is right)." if said else ""
        charts[name] = figure
    if not charts:
        return
    page.section("Consistency: NEES and NIS", short="NEES, NIS")
    page.figure(
        charts,
        "Both are divided by their degrees of freedom, so 1 is right: above the band the filter trusts itself too "
        "much, below it too little.",
        alt="NEES and NIS averaged over runs against the update, each with its 95 percent chi-square band.",
        height=480,
        select="Estimator",
        selected=_preferred(campaign),
        group=GROUP,
    )


def add_settling(page: Page, campaign: Campaign) -> None:
    """When the runs settle: all estimators as step lines, one as a histogram."""
    page.section("When the runs settle", short="Settling")
    page.figure(
        figures.settling(campaign.settled),
        "Each bar reaches from the first to the last run that settles, with its median marked: the further left the "
        "sooner, the shorter the more alike the runs.",
        alt="For each estimator the range of updates at which its runs settle below 1 deg and below 0.1 deg.",
        height=120 + 34 * len(campaign.names),
    )
    last = float(campaign.update[-1])
    charts = {
        name: figures.settling_histogram({text: found[name] for text, found in campaign.settled.items()}, last, name)
        for name in campaign.names
    }
    page.figure(
        charts,
        "A narrow pile means that the start-up is decided by the filter, a wide one that it depends on the noise.",
        alt="Histogram of the update at which each run settles below 1 deg and below 0.1 deg.",
        height=320,
        select="Estimator",
        selected=_preferred(campaign),
        group=GROUP,
    )


def add_bound_and_time(page: Page, campaign: Campaign) -> None:
    """RMS over the bound, and time per step."""
    ratios = {}
    for name in campaign.names:
        found = campaign.figures(name).get("rms_over_bound") or []
        if len(found) == 3 and any(value is not None for value in found):
            ratios[name] = found
    times = {}
    for name in campaign.names:
        time = campaign.figures(name).get("us_per_step", campaign.us_per_step.get(name))
        if time is not None and np.isfinite(time):
            times[name] = float(time)
    charts = []
    if ratios:
        charts.append(
            Figure(
                figures.bound_ratio(ratios),
                "Marks on the red line reach the Cramér-Rao bound; a mark left of it is scatter of few runs or a "
                "biased estimator.",
                "RMS error over the Cramér-Rao bound on x, y and z, one row per estimator, logarithmic.",
                height=110 + 34 * len(ratios),
            )
        )
    if times:
        charts.append(
            Figure(
                figures.step_time(times),
                "Time per run and step as this campaign ran it, batches of runs included.",
                "Bars of microseconds per run and step, one per estimator.",
                height=110 + 34 * len(times),
            )
        )
    if charts:
        page.section("Bound and time", short="Bound, time")
        page.figures(charts)


def _preferred(campaign: Campaign) -> str:
    return next((name for name in PREFERRED if name in campaign.names), campaign.names[0])


def _inside(values: np.ndarray, degrees: np.ndarray) -> float:
    """Share of the finite values inside their 95% band; negative where there is none."""
    finite = np.isfinite(values) & (degrees > 0)
    if not finite.any():
        return -1.0
    low, high = chi_square_ratio_band(degrees[finite])
    return float(np.mean((values[finite] >= low) & (values[finite] <= high)))


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, np.nan)


def _fate(campaign: Campaign, name: str) -> str:
    for text, settled in reversed(campaign.settled.items()):
        if np.isfinite(settled[name][0]):
            return f"is below {text} for good from update {settled[name][0]:.0f} on"
    return "does not settle below 1 deg"


def _vector(values: np.ndarray) -> str:
    return ", ".join(number(value, 2) for value in values)
