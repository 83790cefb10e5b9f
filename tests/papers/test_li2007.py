"""Bars of the digest on Li, Cui and Cui (2007): configuration R, the default seed, and what does not depend on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray

from helmstar.campaign.engine import Engine
from helmstar.core import DEGENERATE
from helmstar.errors import ConfigurationError
from helmstar.evaluate.paired import paired_difference
from helmstar.imaging.body.phase import lambert_factor
from helmstar.scenarios.li2007 import phase_changes
from helmstar.scenarios.li2007_results import _better
from helmstar.scenarios.specification import build, load, parse_set

LAST = slice(114, 120)  # t = 1150..1200 s


def _experiment(*keys: str) -> Any:
    return build(*load("li2007", parse_set(keys)))


def _run(experiment: Any, names: list[str], runs: int) -> dict[str, dict[str, np.ndarray]]:
    engine = Engine(experiment, names)
    engine.compile(2)
    blocks = [engine.compute(i) for i in range(runs // experiment.width)]
    return {n: {v: np.concatenate([b.arrays[n][v] for b in blocks]) for v in experiment.variables} for n in names}


def _mean(found: dict[str, np.ndarray], when: slice = slice(None)) -> np.ndarray:
    return np.abs(found["position_error_km"][:, when]).mean(axis=(0, 1))


@pytest.fixture(scope="module")
def fixed() -> dict[str, dict[str, np.ndarray]]:
    return _run(_experiment("width=50"), ["ekf", "ukf", "gsf", "pf", "ekf_position_velocity"], 100)


def test_the_printed_constants_mean_what_the_digest_says():
    spec = load("li2007")[1]
    assert np.deg2rad(spec.prior.pointing_deg) ** 2 == pytest.approx(3.046e-6, rel=1e-3)  # P0's last three entries
    assert spec.camera.focal_px == pytest.approx(16760.0)
    assert spec.camera.field_deg == pytest.approx(3.5, abs=0.005)
    assert float(lambert_factor(np.deg2rad(72.0))) == pytest.approx(0.478, abs=5e-4)
    phase = np.degrees(np.arccos(-np.array(spec.sun.direction)[0]))
    assert phase == pytest.approx(72.0, abs=0.1)  # the probe comes along x


def test_the_bound_at_five_epochs():
    e = _experiment()
    sigma = np.sqrt(np.diagonal(e.bound, axis1=1, axis2=2))[:, :3] / 1e3
    table = {
        300: (109, 2.57, 5.36), 600: (69.2, 1.22, 4.64), 900: (13.3, 0.485, 1.71), 1170: (0.067, 0.265, 0.084),
        1200: (0.015, 0.264, 0.027),
    }  # fmt: skip
    for t, expected in table.items():
        np.testing.assert_allclose(sigma[int(t / 10) - 1], expected, rtol=0.02)  # the digest's bar, and its rounding


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_kalman_filters_from_the_fixed_start(fixed, name):
    x, y, z = _mean(fixed[name])
    assert 40 <= x <= 52
    assert 1.3 <= y <= 1.75
    assert 1.9 <= z <= 2.8
    x, y, z = _mean(fixed[name], LAST)
    assert 0.048 <= x <= 0.068
    assert 0.16 <= y <= 0.28
    assert 0.052 <= z <= 0.074


def test_a_gaussian_sum_is_better_in_x_on_the_same_draws(fixed):
    assert 28 <= _mean(fixed["gsf"])[0] <= 33
    runs = {n: np.abs(fixed[n]["position_error_km"][:, :, 0]).mean(axis=1) for n in ("gsf", "ukf")}
    assert paired_difference(runs["gsf"], runs["ukf"]).sigmas < -3.0


def test_controls_fail_and_say_so(fixed):
    assert fixed["ekf_position_velocity"]["nees_per_state"].mean() > 1e3
    off = np.linalg.norm(fixed["pf"]["position_error_km"][:, LAST], axis=-1).mean(axis=1)
    assert np.mean(off > 5.0) >= 0.9
    assert np.mean(fixed["pf"]["status"] == DEGENERATE) > 0.3


def test_from_a_random_start_the_filters_are_consistent():
    found = _run(_experiment("width=50", "start=random"), ["ekf", "ukf", "gsf"], 100)
    for name, low, high in (("ekf", 1.0, 1.6), ("ukf", 1.0, 1.6), ("gsf", 0.85, 1.2)):
        assert low <= found[name]["nees_per_state"].mean() <= high
        assert np.linalg.norm(found[name]["position_error_km"][:, LAST], axis=-1).max() < 5.0
    runs = {n: np.abs(found[n]["position_error_km"][:, :, 0]).mean(axis=1) for n in ("gsf", "ukf")}
    assert runs["gsf"].mean() < runs["ukf"].mean()


def test_the_unscented_particle_filter_is_the_gaussian_sums_equal():
    found = _run(_experiment("width=20"), ["upf", "gsf"], 20)
    upf, gsf = (np.abs(found[n]["position_error_km"]).mean(axis=1) for n in ("upf", "gsf"))
    for i in range(3):
        d = paired_difference(upf[:, i], gsf[:, i])
        # No worse than by 3 standard errors, and those are small: 2% of the error.
        assert d.sigmas < 3.0
        assert d.standard_error < 0.02 * gsf[:, i].mean()
    assert np.linalg.norm(found["upf"]["position_error_km"][:, LAST], axis=-1).max() < 5.0
    assert 0.6 < found["upf"]["nees_per_state"].mean() < 1.4  # 20 runs, correlated in time
    assert found["upf"]["effective"].min() > 2.0


def test_filters_know_what_kind_of_noise_there_is():
    densities = [
        _experiment(f"truth.noise={kind}").estimators["upf_printed"].arguments[0].process.noise.logpdf
        for kind in ("gamma", "gaussian")
    ]
    assert densities[0] is not None
    assert densities[1] is None


def test_better_is_surely_better_in_pairs():
    """Not by a mean that the draws explain, and not by leaving out the runs that end in no number."""
    rng = np.random.default_rng(0)
    base = np.abs(rng.normal(40.0, 10.0, (30, 5, 3)))
    errors = {"b": base, "better": base - 2.0 + 0.1 * rng.standard_normal(base.shape), "chance": base[::-1] - 0.1}
    errors["broken"] = np.where(np.arange(30)[:, None, None] == 3, np.nan, errors["better"])
    stacked = np.stack(list(errors.values()))
    dataset = xarray.Dataset(
        {"position_error_km": (("estimator", "run", "time", "axis"), stacked)}, {"estimator": list(errors)}
    )
    assert {n: _better(dataset, n, "b") for n in errors} == {
        "b": False, "better": True, "chance": False, "broken": False,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        (("truth.noise_km=1e9", "camera.sigma_px=1e-4"), "sigma_px"),
        (("camera.level=image", "camera.cross_px=[5.0,0.0]"), "cross terms"),
    ],
)
def test_what_cannot_be_computed_is_refused_before_it_runs(keys, text):
    with pytest.raises(ConfigurationError, match=text):
        _experiment(*keys)


def test_a_change_of_phase_counts_from_the_last_frame_that_was_seen():
    phase = np.array([[1.0, 0.0, 0.0, 0.5, 0.4]])
    seen = np.array([[True, False, False, True, True]])
    np.testing.assert_allclose(phase_changes(phase, seen), [[0.0, 0.0, 0.0, 0.5, 0.1]], atol=1e-15)
    np.testing.assert_array_equal(phase_changes(phase, ~np.ones_like(seen)), np.zeros((1, 5)))


def test_pixels_in_the_loop_and_what_an_uncorrected_centroid_costs(tmp_path, monkeypatch):
    """Radius 20% wrong and another law: the filter that doubts the offset stays honest, the uncorrected one is 5 times worse."""
    monkeypatch.setenv("HELMSTAR_CACHE_DIR", str(tmp_path))
    keys = ("camera.level=image", "runs=2", "width=2", "body.radius_error=-0.2", "body.law=lommel_seeliger")
    found = _run(_experiment(*keys), ["ekf", "ekf_uncorrected"], 2)
    assert _mean(found["ekf_uncorrected"], LAST)[2] > 5.0 * _mean(found["ekf"], LAST)[2]
    assert 0.4 < np.median(found["ekf"]["nees_per_state"]) < 1.6  # 2 runs
    assert found["ekf_uncorrected"]["nees_per_state"].mean() > 30.0
