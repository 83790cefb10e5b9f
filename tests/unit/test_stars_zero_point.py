"""Where the zero point of the magnitudes is known: how well they fit the catalogue is found out, not believed."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import beta

from helmstar.stars import Pinhole, calibrate_photometry, default_sky, identify
from helmstar.stars.hypotheses import levels_for
from helmstar.stars.identify import LIMIT_KNOWN, focal_freedom
from helmstar.stars.magnitudes import LOG_MAGNITUDE_PRIORS, MAGNITUDE_SCALES, magnitude_scales
from helmstar.stars.patterns import LADDER
from helmstar.stars.problem import prepare
from helmstar.stars.synthetic import Scene, scene

# The package's `verify` is the function.
weighing = importlib.import_module("helmstar.stars.verify")
CAMERA = Pinhole.of_field(np.radians(10.0), (1024, 1024))


def crowded(seed: int, true: int, false: int, magnitude_noise: float, noise_px: float = 0.2) -> Scene:
    """The brightest stars of a 10 deg field among false ones of their brightness."""
    rng = np.random.default_rng([53, seed])
    return scene(
        default_sky(), CAMERA, rng, stars=true, false=false, noise_px=noise_px, magnitude_noise=magnitude_noise
    )


def weighed(s: Scene, sigma: float, factors: tuple[np.ndarray, np.ndarray] | None = None) -> float:
    """Log odds of the true attitude with magnitudes told to this sigma; factors on it and log priors instead of the usual."""
    d, _ = prepare(s.xy_px, CAMERA, None, s.magnitude, 0.2, sigma, 0.0)
    freedom, sky = focal_freedom(CAMERA, None, 1e-4), default_sky()
    level = levels_for(d, freedom, LADDER)[0][0]
    with pytest.MonkeyPatch.context() as patch:
        if factors is not None:
            patch.setattr(weighing, "magnitude_scales", lambda _: factors)
        fit = weighing.verify(sky, level, d, s.R_SN, CAMERA.focal_px, freedom)
    return -np.inf if fit is None else fit.log_odds


def test_the_odds_are_those_of_each_sigma_weighed_by_its_prior():
    factors, priors = MAGNITUDE_SCALES, LOG_MAGNITUDE_PRIORS
    assert np.exp(priors).sum() == pytest.approx(1.0, abs=1e-12)
    for seed in range(6):
        s = crowded(seed, 5, 20, 0.1)
        each = [weighed(s, 0.1, (factors[k : k + 1].copy(), priors[k : k + 1].copy())) for k in range(len(factors))]
        assert weighed(s, 0.1) == pytest.approx(np.logaddexp.reduce(each), abs=1e-9)


def test_missing_stars_are_weighed_with_a_prior_that_grows_with_the_detection_probability():
    gain, rank, expected = np.array([3.0, 2.0, 4.0]), np.array([0, 2, 5]), 9
    vacancy = np.zeros(4)
    depth = np.arange(1, expected + 1)
    k = (rank[:, None] < depth).sum(axis=0)
    likelihood = np.exp(np.concatenate([[0.0], np.cumsum(gain)])[k])
    for complete, prior in ((False, 1), (True, 2)):
        # The integral of prior p^(prior - 1) p^k (1 - p)^(S - k), averaged over S with weights 1/S.
        chance = prior * beta(prior + k, 1 + depth - k)
        mean = (likelihood * chance / depth).sum() / (1.0 / depth).sum()
        assert weighing.log_odds(gain, rank, expected, vacancy, complete) == pytest.approx(np.log(mean), abs=1e-12)


def test_that_prior_is_for_a_known_zero_point():
    # Five of thirty are detected: 2 p costs where the magnitudes are the catalogue's own, and no price is paid for a zero point.
    rng = np.random.default_rng(61)
    s = scene(default_sky(), CAMERA, rng, stars=30, dropped=25 / 30, noise_px=0.2, magnitude_noise=0.05)
    with pytest.MonkeyPatch.context() as patch:
        told = []
        usual = weighing.log_odds
        patch.setattr(weighing, "kernels", lambda: None)
        patch.setattr(weighing, "log_odds", lambda *args: told.append(args[4]) or usual(*args))
        d, _ = prepare(s.xy_px, CAMERA, None, s.magnitude, 0.2, 0.05, 0.0)
        freedom = focal_freedom(CAMERA, None, 1e-4)
        level = levels_for(d, freedom, LADDER)[0][0]
        for zero_point in (0.0, None):
            weighing.verify(default_sky(), level, replace(d, zero_point=zero_point), s.R_SN, CAMERA.focal_px, freedom)
            assert set(told) == {zero_point is not None}
            told.clear()


def test_a_sigma_told_four_times_wrong_costs_little():
    # The prior of two factors of two, a quarter: 1.4. The broad share and the depth of the image are told by sigma too: 2 more.
    for seed in range(12):
        s = crowded(seed, 6, 20, 0.1)
        best = weighed(s, 0.1)
        for told in (0.025, 0.05, 0.2, 0.4):
            assert weighed(s, told) > best - 3.5, (seed, told)


def test_without_a_known_zero_point_sigma_is_believed():
    s = crowded(1, 6, 20, 0.1)
    d, _ = prepare(s.xy_px, CAMERA, None, s.magnitude, 0.2, 0.1, None)
    factors, priors = magnitude_scales(d)
    assert (factors.tolist(), priors.tolist()) == ([1.0], [0.0])
    assert magnitude_scales(replace(d, magnitude=None, zero_point=0.0))[0].tolist() == [1.0]


@pytest.mark.parametrize(("told", "noise"), [(0.4, 0.03), (0.05, 0.15)])
def test_few_true_stars_among_many_false_are_found_with_a_sigma_told_wrong(told, noise):
    solved = 0
    for seed in range(12):
        s = crowded(100 + seed, 4, 80, noise)
        found = identify(
            s.xy_px, CAMERA, magnitude=s.magnitude, zero_point=0.0, sigma_px=0.2, focal_sigma=1e-4, magnitude_sigma=told
        )
        if found.solved:
            assert found.probability_false < LIMIT_KNOWN
            assert (found.stars == s.star[found.detections]).all()
        solved += found.solved
    # Of seeds 100 to 123, 21 and 23; where the sigma told is believed, 5 and 15.
    assert solved >= 9


def test_lists_without_a_sky_stay_refused():
    for seed in range(12):
        rng = np.random.default_rng([59, seed])
        xy, magnitude = rng.uniform(0.0, 1024.0, (60, 2)), 6.0 - rng.exponential(0.9, 60)
        found = identify(
            xy, CAMERA, magnitude=magnitude, zero_point=0.0, sigma_px=0.2, focal_sigma=1e-4, magnitude_sigma=0.1
        )
        assert not found.solved
        # Of 2857 even lists the largest was 2.5 (identification.py --false 20000 --known).
        assert found.log_odds < 3.0


def test_a_camera_s_own_solutions_tell_zero_point_and_scatter():
    scenes = [crowded(200 + k, 30, 0, 0.1) for k in range(12)]
    fluxes = [10.0 ** (-0.4 * (s.magnitude + 3.0)) for s in scenes]
    found = [identify(s.xy_px, CAMERA, flux=f, sigma_px=0.2) for s, f in zip(scenes, fluxes)]
    own = calibrate_photometry(found, [-2.5 * np.log10(f) for f in fluxes])
    assert own.matches > 300
    # The median of 300 scatters by 1.25 of 0.1 / sqrt(300) = 0.007, the median deviation by 1.17 of that.
    assert own.zero_point == pytest.approx(-3.0, abs=0.03)
    assert own.magnitude_sigma == pytest.approx(0.1, abs=0.03)


def test_photometry_is_not_made_up():
    s = crowded(3, 6, 0, 0.1)
    one = identify(s.xy_px, CAMERA, flux=s.flux, sigma_px=0.2)
    assert one.solved
    with pytest.raises(ValueError, match="matches: 10 are needed"):
        calibrate_photometry([one], [s.magnitude])
    with pytest.raises(ValueError, match="not the list that scene"):
        calibrate_photometry([one, one], [s.magnitude, s.magnitude[:2]])
    with pytest.raises(ValueError, match="shorter"):
        calibrate_photometry([one], [])
