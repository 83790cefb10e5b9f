"""The bars of zhou2021, at 20 runs of one seed; the full campaign is `helmstar run zhou2021`.

Errors of one run are correlated over hundreds of seconds, so the last 1000 s of 20 runs hold at least 40 independent samples
of an axis: its RMS scatters by 1 / sqrt(80) = 11%. The bars leave 25% and more. NEES: 20 runs times 6.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import xarray as xr
from scipy.stats import chi2

from helmstar.campaign.engine import Engine
from helmstar.campaign.store import _dataset
from helmstar.scenarios.specification import build, load

RUNS = 20
TIE = ("quest_ekf", "mekf", "mekf_reset", "iekf", "usque", "mekf_rate_state")
D = (("star.reading", "D"), ("gyro.arw_deg_sqrt_h", 0.01), ("gyro.rrw_deg_h_sqrt_h", 0.03))
FOV = (("star.geometry", "fov"),)


@cache
def campaign(names: tuple[str, ...], keys: tuple = ()) -> tuple[dict, xr.Dataset]:
    """Metrics and data of 20 runs."""
    _, spec = load("zhou2021", {"width": RUNS, "runs": RUNS, **dict(keys)})
    experiment = build("zhou2021", spec)
    engine = Engine(experiment, names)
    engine.compile(2)
    data = _dataset(engine.compute(0), experiment)
    data["us_per_step"] = ("estimator", np.full(len(names), np.nan))
    for key, (dims, values, attrs) in experiment.fixed().items():
        data[key] = (dims, values, attrs)
    return experiment.summarise(data), data


@cache
def default() -> tuple[dict, xr.Dataset]:
    _, spec = load("zhou2021")
    return campaign(tuple(build("zhou2021", spec).estimators))


def band(runs: int = RUNS, probability: float = 1e-3) -> tuple[float, float]:
    return chi2.ppf(probability, 6 * runs) / runs, chi2.isf(probability, 6 * runs) / runs


@pytest.mark.parametrize("name", [*TIE, "mekf_adaptive"])
def test_reading_b_meets_the_bars(name):
    m = default()[0][name]
    assert max(m["attitude_rms_deg"]) <= 0.0042
    assert max(m["drift_rms_deg_h"]) <= 0.010
    assert band()[0] < m["nees_mean"] < band()[1]
    assert m["sign_errors"] == 0
    assert max(m["rms_over_bound"]) < 1.35
    assert m["resets"] == 0


def test_reading_d_meets_the_bars():
    for m in campaign(("quest_ekf", "mekf", "mekf_reset"), D)[0].values():
        assert max(m["attitude_rms_deg"]) <= 0.0008
        assert max(m["drift_rms_deg_h"]) <= 0.024
        assert band()[0] < m["nees_mean"] < band()[1]
        assert m["outage_peak_deg"]["hold_mean"] <= 0.0025
        assert m["outage_peak_deg"]["zeros"] > 0.2  # negative control
    assert campaign(("quest_ekf", "mekf", "mekf_reset"), D)[0]["mekf"]["outage_peak_deg"]["zeros"] > 0.3


def test_with_the_right_covariance_all_filters_tie():
    metrics = default()[0]
    reference = np.array(metrics["mekf"]["attitude_rms_deg"])
    for name in TIE:
        np.testing.assert_allclose(metrics[name]["attitude_rms_deg"], reference, rtol=0.01)


def test_left_and_right_error_are_one_filter():
    """iekf and mekf differ in the side of the error alone; what is left is the attitude's part in the drift's errors."""
    _, data = default()
    left, right = (data["error_rad"].sel(estimator=n).values for n in ("mekf", "iekf"))
    sigma = data["sigma_rad"].sel(estimator="mekf").values
    assert np.max(np.abs(left - right) / sigma) < 1e-3


def test_quest_with_signs_left_to_chance_fails():
    m = default()[0]["quest_ekf_unsigned"]
    assert max(m["attitude_rms_deg"]) > 1.0
    assert m["sign_errors"] > 0.4 * RUNS * 6052
    assert not m["nees_in_band"]


@pytest.mark.parametrize("profile", ["slew", "yaw"])
def test_the_sign_rule_makes_no_error_in_other_profiles(profile):
    m = campaign(("quest_ekf",), (("attitude.profile", profile),))[0]["quest_ekf"]
    assert m["sign_errors"] == 0
    assert band()[0] < m["nees_mean"] < band()[1]


def test_a_narrow_field_needs_the_solvers_covariance():
    metrics = campaign(("quest_ekf", "quest_ekf_isotropic"), FOV)[0]
    assert band()[0] < metrics["quest_ekf"]["nees_mean"] < band()[1]
    assert metrics["quest_ekf_isotropic"]["nees_mean"] > 10.0
    assert metrics["quest_ekf_isotropic"]["attitude_rms_deg"][0] > 1.3 * metrics["quest_ekf"]["attitude_rms_deg"][0]


def test_gyro_loss_by_policy():
    peak = default()[0]["mekf"]["outage_peak_deg"]
    assert peak["hold_mean"] <= 0.009
    assert peak["hold_last"] <= 0.013
    assert 2.5 < peak["zeros"] < 4.5  # the orbit's rate for a minute, 3.6 deg
    assert 0.2 < peak["hold_mean_raised"] < 0.5
    assert 0.015 < peak["commanded"] < 0.06
    assert 0.1 < peak["rate_state"] < 0.3
    slewing = campaign(("mekf",), (("attitude.profile", "slew"),))[0]["mekf"]["outage_peak_deg"]
    assert slewing["hold_mean"] > 5.0
    assert slewing["zeros"] > 20.0
    assert slewing["hold_mean_raised"] < 0.5


def test_star_loss_grows_and_recovers():
    m = campaign(("quest_ekf", "mekf", "mekf_reset"), D)[0]["mekf"]["star_loss_deg"]
    assert 0.002 < m["end"] < 0.010
    assert m["later"] < 1.6 * m["begin"]


def test_restarts_recover_from_everything():
    for case, found in default()[0]["mekf_reset"]["recovery_s"].items():
        assert found["converged"] == found["runs"] == RUNS, case
        assert found["median"] <= 40.0
    quest = default()[0]["quest_ekf"]["recovery_s"]
    assert all(quest[f"start_{a}deg"]["converged"] == RUNS for a in (90, 150, 179))
    for name in ("mekf", "iekf", "usque"):
        assert default()[0][name]["recovery_s"]["start_179deg"]["converged"] <= 2


def test_the_smoother_knows_more():
    metrics = default()[0]
    assert np.mean(metrics["smoother"]["attitude_rms_deg"]) < 0.95 * np.mean(metrics["mekf"]["attitude_rms_deg"])
    assert band()[0] < metrics["smoother"]["nees_mean"] < band()[1]


def test_the_predictive_filter_needs_no_gyro():
    m = default()[0]["predictive"]
    assert 0.01 < max(m["attitude_rms_deg"]) < 0.115  # better than one epoch's stars, worse than with a gyro
    assert m["drift_rms_deg_h"] == [None] * 3
    assert m["nees_mean"] is None


def test_which_design_meets_the_claim():
    """A with every gyro not; C and D with an ARW up to 0.01."""
    _, data = default()
    rows = [
        (str(r), float(a), bool(m and n))
        for r, a, m, n in zip(
            data["design_reading"].values, data["design_arw"].values, data["design_meets_attitude"].values,
            data["design_meets_drift"].values, strict=True,
        )
    ]  # fmt: skip
    assert not any(met for reading, _, met in rows if reading == "A")
    assert all(met == (arw <= 0.01) for reading, arw, met in rows if reading in "CD")


def test_the_report_says_what_was_found(tmp_path):
    from helmstar.report.monte_carlo import write_monte_carlo_report

    metrics, data = default()
    _, spec = load("zhou2021", {"width": RUNS})
    experiment = build("zhou2021", spec)
    data = data.assign_attrs(scenario="zhou2021", seed=0, **experiment.attributes())
    summary = {"scenario": "zhou2021", "seed": 0, "runs": RUNS, "wall_s": 1.0, "estimators": metrics}
    claims = experiment.claims(data, summary)
    assert len(claims) == 5
    assert {c.verdict for c in claims} <= {"holds", "holds in part", "does not hold", "measured"}
    text = write_monte_carlo_report(data, summary, claims, tmp_path / "report.html").read_text()
    for words in (
        "Figs. 3 and 4",
        "Figs. 5 and 6",
        "Which star sensor and which gyro",
        "Farrenkopf",
        "Losses, wrong starts",
    ):
        assert words in text
