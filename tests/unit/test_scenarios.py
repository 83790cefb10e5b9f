"""Scenarios: files, overrides, and messages that name key, value and what is allowed."""

from __future__ import annotations

import pytest

from helmstar.errors import ConfigurationError
from helmstar.scenarios import library, load, parse_set


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
    with pytest.raises(ConfigurationError, match="there are xu2020"):
        load("xu2021")
