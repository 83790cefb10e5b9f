"""Scenarios: files, overrides, and messages that name key, value and what is allowed."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from helmstar.errors import ConfigurationError
from helmstar.report.claims import Claim
from helmstar.scenarios import library, load, parse_set
from helmstar.scenarios.xu2020_results import claims, departures


def test_the_library_is_valid():
    assert "xu2020" in library()
    for name in library():
        assert load(name)[0] == name


def test_defaults_are_the_papers():
    _, s = load("xu2020")
    assert (s.runs, s.seed, s.updates, s.step_s) == (100, 0, 1000, 1.0)
    assert (s.star.sigma_arcsec, s.gyro.sigma_rad_step) == (20.0, 1e-5)
    assert (s.tuning.p0, s.tuning.q_w, s.tuning.sigma_v) == (5.0, 5e-5, 0.125)


@pytest.mark.parametrize(
    ("text", "value"),
    [("a.b=20", 20), ("a.b=1e-5", 1e-5), ("a.b = true", True), ("a.b=euler", "euler"), ("a.b=[1, 2]", [1, 2])],
)
def test_set_takes_toml_values_and_bare_words(text, value):
    assert parse_set([text]) == {"a.b": value}


@pytest.mark.parametrize(("key", "value"), [("gyro.loss_s", "60"), ("star.loss_s", True), ("tuning.reset_after", 2.0)])
def test_every_scenarios_tables_take_numbers_of_their_type_only(key, value):
    with pytest.raises(ConfigurationError, match=key):
        load("zhou2021", {key: value})


def test_a_whole_number_is_a_number():
    assert load("xu2020", {"star.sigma_arcsec": 5})[1].star.sigma_arcsec == 5.0


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["star.sigma_arcsec=5\nfoo=7"], "must be one KEY=VALUE"),
        (["a=1\n[b]"], "must be one KEY=VALUE"),
        (["runs=3", "seed=1", "runs=4"], "runs is given twice"),
        (["star={sigma_arcsec=3}", "star.sigma_arcsec=4"], "star and star.sigma_arcsec set the same thing"),
        (["star.sigma_arcsec=4", "star={sigma_arcsec=3}"], "set the same thing"),
        (["runs=" + "1" * 5000], "cannot be read"),
        (["runs=" + "[" * 3000], "cannot be read"),
        (["a" + ".a" * 2000 + "=3"], "no key has that many dots"),
    ],
)
def test_a_set_that_would_be_half_heard_is_refused(texts, words):
    with pytest.raises(ConfigurationError, match=words) as e:
        parse_set(texts)
    assert str(e.value).isprintable()
    assert len(str(e.value)) < 250


def test_set_keys_that_share_a_beginning_are_different():
    assert parse_set(["star.sigma=1", "star.sigma_b=2"]) == {"star.sigma": 1, "star.sigma_b": 2}


@pytest.mark.parametrize("text", ["star.sigma_arcsec", "=3", ""])
def test_set_needs_key_and_value(text):
    with pytest.raises(ConfigurationError, match="must be KEY=VALUE"):
        parse_set([text])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"star.sigma_arcsec": -1}, ["star.sigma_arcsec", "-1", ">= 0"]),
        ({"star.sigma_arcsec": "wide"}, ["star.sigma_arcsec", "wide", "number"]),
        ({"star.sigma_arcsec": float("nan")}, ["star.sigma_arcsec", "NaN", "finite"]),
        ({"star.sigma_arcsecs": 3}, ["star.sigma_arcsecs", "sigma_arcsec"]),
        ({"truth.rate": "eular"}, ["truth.rate", "eular", "euler"]),
        ({"truth.attitude": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, ["truth.attitude", "rotation"]),
        ({"star.directions": [[1, 0, 0], [-1, 0, 0]]}, ["star.directions", "differ"]),
        ({"runs": 0}, ["runs", "0", ">= 1"]),
        ({"runs": 1.5}, ["runs", "1.5"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"width": 1}, ["width", ">= 2"]),
        ({"start.error_deg": 181}, ["start.error_deg", "180"]),
        ({"star": 3}, ["star", "table"]),
        ({"truth.rate_frequency_rad_s": [float("nan"), 0, 0]}, ["truth.rate_frequency_rad_s[0]", "finite"]),
        ({"truth.rate_frequency_rad_s": [4, 0, 0]}, ["truth.rate_frequency_rad_s", "step_s = 1.0", "pi rad"]),
        ({"truth.rate_amplitude_rad_s": 1e300}, ["truth.rate_amplitude_rad_s", "1e+300"]),
        ({"truth.rate_amplitude_rad_s": 2}, ["truth.rate_amplitude_rad_s", "step_s", "half a turn"]),
        ({"truth.inertia_kg_m2": [1e9, 1e9, 1e-6]}, ["truth.inertia_kg_m2", "times the smallest"]),
        ({"truth.inertia_kg_m2": [9, 1, 1]}, ["truth.inertia_kg_m2", "other two"]),
        ({"step_s": 1e-300}, ["step_s", ">= 1e-06"]),
        ({"star.sigma_arcsec": 1e300}, ["star.sigma_arcsec", "<= "]),
        ({"star.sigma_arcsec": 1e-300}, ["star.sigma_arcsec", "0 (no noise)"]),
        ({"gyro.sigma_rad_step": 1e200}, ["gyro.sigma_rad_step", "<= "]),
        ({"tuning.p0": 1e-300}, ["tuning.p0", ">= "]),
        ({"star.sigma_arcsec": "20"}, ["star.sigma_arcsec", '"20"', "number"]),
        ({"star.sigma_arcsec": True}, ["star.sigma_arcsec", "true", "number"]),
        ({"runs": 2.0}, ["runs", "2.0", "integer"]),
        ({"runs": "2"}, ["runs", "integer"]),
        ({"runs": int("f" * 5000, 16)}, ["runs", "too long to show"]),
        ({"truth.rate": int("f" * 5000, 16)}, ["truth.rate", "too long to show"]),
    ],
)
def test_a_wrong_value_is_named(overrides, words):
    with pytest.raises(ConfigurationError) as e:
        load("xu2020", overrides)
    for word in words:
        assert word in str(e.value)


def test_a_users_own_file_overrides_single_keys(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('experiment = "xu2020"\nruns = 7\n[star]\nsigma_arcsec = 3\n')
    name, s = load(str(path), {"star.sigma_arcsec": 4})
    assert (name, s.runs, s.star.sigma_arcsec, s.gyro.sigma_rad_step) == ("mine", 7, 4.0, 1e-5)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("runs = 3", ["experiment", "xu2020"]),
        ('experiment = "xu2021"', ["xu2021", "xu2020"]),
        ('experiment = ["xu2020"]', ["mine.toml", "experiment", "xu2020"]),
        ("experiment = {a = 1}", ["mine.toml", "experiment", "xu2020"]),
        ("a" + ".a" * 2000 + ' = 1\nexperiment = "xu2020"', ["mine.toml", "unknown key 'a'"]),
        ('experiment = "xu2020"\n[star]\nsigma = 3', ["mine.toml", "sigma"]),
        ("experiment = ", ["mine.toml", "TOML"]),
    ],
)
def test_a_wrong_file_is_explained(tmp_path, content, words):
    path = tmp_path / "mine.toml"
    path.write_text(content)
    with pytest.raises(ConfigurationError) as e:
        load(str(path))
    for word in words:
        assert word in str(e.value)


def test_an_unknown_scenario_lists_those_there_are():
    with pytest.raises(ConfigurationError, match=f"there are {', '.join(library())}"):
        load("xu2021")


# --- the claims of xu2020 --------------------------------------------------------------------------------------------


def figures(good: bool, runs: int = 4, ratio: float | None = 1.0, mark: str = "150") -> dict:
    """Metrics of an estimator of which all runs, or none, converge."""
    by = {"runs": runs if good else 0, "by": 40 if good else None}
    return {
        "rms_deg": {mark: [0.002 if good else 30.0] * 3},
        "median_error_deg": {mark: 0.002},
        "converged": {"1deg": by, "0.1deg": by},
        "diverged": 0 if good else runs,
        "nees_mean": 3.0 if good else 1e-6,
        "rms_over_bound": [ratio] * 3,
        "us_per_step": 1.0,
    }


def judged(estimators: dict, updates: int = 150, **overrides) -> dict[str, Claim]:
    spec = load("xu2020", {k.replace("__", "."): v for k, v in overrides.items()})[1]
    dataset = xr.Dataset({"bound_rad": (("time", "axis"), np.full((updates, 3), 1e-5))})
    found = claims(spec, dataset, {"runs": 4, "estimators": estimators})
    return dict(zip(("accuracy", "convergence", "quaternion", "static", "noise"), found, strict=True))


def every_claim(lie=True, printed=False, **more) -> dict:
    names = {"lie_printed": figures(printed), "lie": figures(lie), "quaternion_ekf": figures(True)}
    return names | {"static_svd": figures(True, ratio=3.0)} | more


def test_claims_are_judged_by_the_figures():
    usual = judged(every_claim())
    assert [c.verdict for c in usual.values()] == [
        "holds in part",
        "holds in part",
        "does not hold",
        "holds",
        "measured",
    ]
    assert (
        "none of 4 runs with the printed equations; every run with the consistent form" in usual["accuracy"].explanation
    )
    other = judged(
        every_claim(lie=False, printed=True, quaternion_ekf=figures(False), static_svd=figures(True, ratio=0.5))
    )
    expected = ["holds in part", "holds in part", "holds", "does not hold", "does not hold"]
    assert [c.verdict for c in other.values()] == expected
    assert (
        "every run with the printed equations; none of 4 runs with the consistent form" in other["accuracy"].explanation
    )
    assert "every run diverged" in other["quaternion"].explanation
    assert "carries information" not in other["static"].explanation
    assert judged(every_claim(printed=True))["accuracy"].verdict == "holds"
    assert judged(every_claim(lie=False))["convergence"].verdict == "does not hold"


@pytest.mark.parametrize(
    ("changed", "spared"),
    [
        ({"start__error_deg": 10}, set()),
        ({"star__directions": [[0, 0, 1], [0, 1, 0]]}, set()),
        ({"truth__rate_amplitude_rad_s": 1e-3}, set()),
        ({"tuning__q_w": 1e-3}, {"quaternion"}),
        ({"tuning__quaternion_p0": 2}, {"accuracy", "convergence", "static", "noise"}),
    ],
)
def test_another_experiment_than_the_papers_is_measured_only(changed, spared):
    (key,) = changed
    for name, claim in judged(every_claim(lie=False), **changed).items():
        assert (key.replace("__", ".") in claim.explanation) == (name not in spared)
        assert name in spared or claim.verdict == "measured"


def test_what_the_paper_does_not_state_may_change():
    assert departures(load("xu2020", {"star.sigma_arcsec": 5, "gyro.sigma_rad_step": 1e-6, "runs": 2})[1]) == []
    same = {"star.directions": [[3, 0, 0], [0, 2, 0]], "truth.rate": "euler"}
    assert departures(load("xu2020", same)[1]) == []


def test_a_short_campaign_judges_nothing_and_a_missing_figure_does_not_stop_it():
    short = {n: m | {"rms_deg": {"20": [None] * 3}} for n, m in every_claim(lie=False).items()}
    assert {c.verdict for c in judged(short, updates=20).values()} == {"measured"}
    gone = figures(True) | {"rms_over_bound": [3.0, None, 3.0], "nees_mean": None}
    assert judged(every_claim(static_svd=gone))["static"].verdict == "holds"
