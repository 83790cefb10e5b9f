"""The compiled weighing of a hypothesis gives what its NumPy twin gives: matches, attitude, odds, or nothing."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from helmstar.native import kernels
from helmstar.stars import Pinhole, default_sky
from helmstar.stars.hypotheses import levels_for
from helmstar.stars.identify import focal_freedom
from helmstar.stars.patterns import LADDER
from helmstar.stars.problem import prepare
from helmstar.stars.synthetic import random_scene, scene

# The package's `verify` is the function.
weighing = importlib.import_module("helmstar.stars.verify")
pytestmark = pytest.mark.skipif(
    kernels() is None, reason="installed without compiled kernels, or their sources changed since"
)


SCALES = ((1.0,), (1.8,), (1.0, 1.8, 3.2))


def in_numpy(call, *args, **kinds):
    """What `call` gives without the compiled kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weighing, "kernels", lambda: None)
        return call(*args, **kinds)


def field_of(d, freedom, level: int, R: np.ndarray, f: float, volume: float):
    """What `verify` weighs a hypothesis against."""
    sky, limit = default_sky(), weighing.deepest(d)
    stars = weighing.expected_stars(sky, level, R, f, d, limit)
    return weighing._Field(d, freedom, stars, sky.directions[stars], sky.magnitude[stars], limit, volume)


def case(seed: int):
    """Of a seed: the field, and R, f, scales and first gate for `settle`; one hypothesis of five is false."""
    rng = np.random.default_rng([29, seed])
    fov_deg, sigma = (6.0, 12.0, 22.0)[seed % 3], (0.2, 1.0)[seed // 3 % 2]
    c = Pinhole.of_field(np.radians(fov_deg), (1024, 1024))
    s = scene(default_sky(), c, rng, noise_px=sigma, false=int(rng.integers(0, 60)), dropped=0.3 * rng.random())
    told = ("flux", "nothing", "zero point", "wrong zero point")[seed % 4]
    magnitude = None if told == "nothing" else s.magnitude
    # Sigmas told too small leave fewer matches; those of magnitudes make more of a difference.
    zero = {"zero point": 0.0, "wrong zero point": 0.7}.get(told)
    d, _ = prepare(s.xy_px, c, None, magnitude, sigma * rng.choice([0.4, 1.0]), float(rng.choice([0.05, 0.4])), zero)
    wide = (np.radians(0.9 * fov_deg), np.radians(1.1 * fov_deg)) if seed % 5 in (1, 2) else None
    freedom = focal_freedom(c, wide, (0.0, 1e-4, 0.01)[seed % 3])
    R = s.R_SN
    if seed % 5 == 4:
        R = weighing.turn(rng.normal(size=3), R)
    off, gate = ((0.0, 1.0), (4.0, 2.5), (12.0, 4.0), (40.0, 15.0))[seed // 2 % 4]
    R = weighing.turn(rng.normal(size=3) * off * sigma / c.focal_px, R)
    f = c.focal_px * float(np.exp(rng.normal() * (0.002 if wide else 0.0)))
    # The last is less than a fit leaves over: no price.
    volume = (weighing.SO3_VOLUME, 1e-6, 1e-20)[seed // 2 % 3]
    level = levels_for(d, freedom, LADDER)[0][0]
    return field_of(d, freedom, level, R, f, volume), (R, f, SCALES[seed % 3], gate)


def assert_alike(a, b, seed: int):
    assert (a is None) == (b is None), seed
    if a is None:
        return
    assert np.array_equal(a.stars, b.stars), seed
    assert np.array_equal(a.detections, b.detections), seed
    # Only the order of sums differs: 1e-16 of pixels, carried by the condition of the information.
    assert np.abs(a.R - b.R).max() < 1e-12, seed
    assert a.f == pytest.approx(b.f, rel=1e-11), seed
    assert np.abs(a.residuals - b.residuals).max() < 1e-7, seed
    size = np.sqrt(np.abs(np.diagonal(b.covariance)))
    unit = size * size[:, None]
    assert a.covariance / unit == pytest.approx(b.covariance / unit, abs=1e-7, nan_ok=True), seed
    assert a.log_odds == pytest.approx(b.log_odds, abs=1e-8), seed
    assert (a.sigma_scale, a.zero_point) == (b.sigma_scale, pytest.approx(b.zero_point, abs=1e-12)), seed


def test_a_hypothesis_is_weighed_as_by_numpy():
    settled, hopeless, believed = 0, 0, 0
    for seed in range(200):
        field, start = case(seed)
        before = start[0].copy()
        for rounds in range(4):
            a, b = field.settle(*start, rounds), in_numpy(field.settle, *start, rounds)
            assert_alike(a, b, seed)
            settled, hopeless = settled + (a is not None), hopeless + (a is None)
            believed += a is not None and a.log_odds > 10.0
        assert np.array_equal(start[0], before)
    # The seeds reach every kind of end.
    assert settled > 300
    assert hopeless > 200
    assert believed > 200


def test_the_whole_verification_is_that_of_numpy():
    c, sky, wider = Pinhole.of_field(np.radians(14.0), (1024, 1024)), default_sky(), 0
    for seed in range(30):
        s = scene(sky, c, np.random.default_rng([31, seed]), noise_px=1.0, false=20)
        # Sigmas told too small are tried wider: a second and third call on one field.
        d, _ = prepare(s.xy_px, c, s.flux, None, (0.35, 0.6, 1.0)[seed % 3], 0.4, None)
        freedom = focal_freedom(c, None, 0.001)
        level = levels_for(d, freedom, LADDER)[0][0]
        args = (sky, level, d, s.R_SN, c.focal_px, freedom)
        a, b = weighing.verify(*args), in_numpy(weighing.verify, *args)
        assert_alike(a, b, seed)
        wider += a is not None and a.sigma_scale > 1.0
    assert wider >= 5


def test_false_attitudes_are_dropped_alike():
    c, dropped = Pinhole.of_field(np.radians(20.0), (1024, 1024)), 0
    for seed in range(40):
        rng = np.random.default_rng([37, seed])
        s = random_scene(c, rng, 40)
        d, _ = prepare(s.xy_px, c, s.flux, None, (0.3, 2.0)[seed % 2], 0.4, None)
        freedom = focal_freedom(c, None, 0.01)
        R = weighing.turn(rng.normal(size=3) * 2.0, np.eye(3))
        field = field_of(d, freedom, levels_for(d, freedom, LADDER)[0][0], R, c.focal_px, weighing.SO3_VOLUME)
        for rounds in (0, 1, 3):
            a, b = (call(field.settle, R, c.focal_px, (1.0,), 6.0, rounds) for call in (lambda f, *x: f(*x), in_numpy))
            assert_alike(a, b, seed)
            dropped += a is None
    assert dropped > 20


def test_of_equally_near_stars_and_detections_the_first_matches():
    field, start = case(0)
    args = (*start, 2)
    d, n = field.d, len(field.d)
    # Every star and every detection twice, each at the place of the other.
    twice = np.arange(2 * n) // 2
    listed = replace(
        d, xy=d.xy[twice], sigma=d.sigma[twice], magnitude=None, log_magnitude_density=d.log_magnitude_density[twice],
        log_density=d.log_density[twice], order=np.arange(2 * n),
    )  # fmt: skip
    star = np.arange(2 * len(field.candidates)) // 2
    double = replace(
        field,
        d=listed,
        candidates=np.arange(len(star)),
        r=field.r[star],
        V=field.V[star],
        limit=min(2 * field.limit, 390),
    )
    a, b = double.settle(*args), in_numpy(double.settle, *args)
    assert_alike(a, b, 0)
    assert a is not None
    assert not (a.stars % 2).any()
    assert not (a.detections % 2).any()


def test_stars_behind_the_camera_match_nothing():
    field, start = case(0)
    # The antipodes first: through the pinhole they would fall on the same pixels.
    both = replace(
        field, candidates=np.tile(field.candidates, 2), r=np.concatenate([-field.r, field.r]), V=np.tile(field.V, 2)
    )
    a, b, plain = both.settle(*start, 2), in_numpy(both.settle, *start, 2), field.settle(*start, 2)
    assert_alike(a, b, 0)
    assert_alike(a, plain, 0)
    assert a is not None


def test_an_empty_list_or_sky_is_nothing():
    field, start = case(0)
    args = (*start, 2)
    none = replace(field, candidates=field.candidates[:0], r=field.r[:0], V=field.V[:0])
    c = Pinhole.of_field(np.radians(6.0), (1024, 1024))
    empty, _ = prepare(np.zeros((0, 2)), c, None, None, 1.0, 0.4, None)
    for case_ in (none, replace(field, d=empty)):
        assert case_.settle(*args) is None
        assert in_numpy(case_.settle, *args) is None
    lost = (np.full((3, 3), np.nan), *args[1:])
    assert field.settle(*lost) is None
    assert in_numpy(field.settle, *lost) is None


def test_arrays_that_do_not_belong_together_are_refused():
    field, start = case(0)
    args = (*start, 2)
    with pytest.raises(ValueError, match="stars have the shapes"):
        replace(field, V=field.V[:-1]).settle(*args)
    for wrong in ({"sigma": field.d.sigma[:-1]}, {"low": np.zeros(3)}):
        with pytest.raises(ValueError, match="detections have the shapes"):
            replace(field, d=replace(field.d, **wrong)).settle(*args)
