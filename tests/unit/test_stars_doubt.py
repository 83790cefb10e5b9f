"""A camera that nobody calibrated: wrong fields, displaced places and bent brightness are found out, and no sky stays no sky."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Centroids
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars import Pinhole, default_sky, identify, identify_uncalibrated
from helmstar.stars.doubt import COUNTS, magnitude_of_order
from helmstar.stars.synthetic import random_scene, scene


def camera(fov_deg: float) -> Pinhole:
    return Pinhole.of_field(np.radians(fov_deg), (1024, 1024))


def bent(flux: np.ndarray) -> np.ndarray:
    """A camera's answer to light that keeps the order and little else: steep, and cut off where the sky is clipped."""
    light = flux / flux.max()
    return np.maximum(light**2.5 - 0.2 * light.min() ** 2.5, 0.0) * 1e4


def displaced(xy: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """By a decentred lens: up to some 4 px in the corners of 1024 x 1024, and 1 px of smear."""
    u = (xy - [700.0, 350.0]) / 1024.0
    r2 = (u**2).sum(axis=1, keepdims=True)
    return (
        xy
        + 6.0 * u * r2
        + 3.0 * np.stack([r2[:, 0] + 2 * u[:, 0] ** 2, 2 * u[:, 0] * u[:, 1]], axis=1)
        + rng.normal(0, 1.0, xy.shape)
    )


@pytest.mark.parametrize("wrong", [-0.05, 0.03])
def test_a_field_stated_wrongly_is_found(wrong):
    """A calibrated camera's prior excludes it; a statement of a field does not."""
    true, stated = camera(14), camera(14 * (1.0 + wrong))
    s = scene(default_sky(), true, np.random.default_rng(14), false=5)
    assert not identify(s.xy_px, stated, flux=s.flux, sigma_px=0.3, work=100_000).solved
    found, doubt = identify_uncalibrated(s.xy_px, stated, flux=s.flux, sigma_px=0.3, focal_sigma=0.005)
    assert found.solved
    assert doubt == "field"
    assert found.focal_px == pytest.approx(true.focal_px, rel=2e-3)
    assert (found.stars == s.star[found.detections]).all()


@pytest.mark.parametrize("fov_deg", [10.0, 20.0])
@pytest.mark.parametrize("ranged", [False, True])
def test_displaced_stars_of_bent_brightness_are_found(fov_deg, ranged):
    """All of three skies each; what was told of noise and light is wrong by an order. Some are found as told all the same."""
    c, rough = camera(fov_deg), 0
    fov_range = (np.radians(0.7 * fov_deg), np.radians(1.4 * fov_deg)) if ranged else None
    for k in range(3):
        rng = np.random.default_rng([41, int(fov_deg), k])
        s = scene(default_sky(), c, rng, stars=40, false=10, noise_px=0.0, dropped=0.1)
        found, doubt = identify_uncalibrated(
            displaced(s.xy_px, rng), c, flux=bent(s.flux), sigma_px=0.1, fov_range=fov_range
        )
        assert found.solved, k
        rough += doubt == "rough"
        error = (Rotation.from_matrix(s.R_SN) * Rotation.from_quat(found.q_SN).inv()).as_rotvec()
        assert np.linalg.norm(error) < np.radians(6.0 * fov_deg / 1024.0) * 3.0, (
            k
        )  # a few pixels, and their lever in roll
        assert (found.stars == s.star[found.detections]).mean() > 0.8
    assert rough >= 1


def test_what_is_told_rightly_is_believed():
    c = camera(14)
    s = scene(default_sky(), c, np.random.default_rng(3), false=20)
    told = identify(s.xy_px, c, flux=s.flux, sigma_px=0.3, focal_sigma=0.005)
    found, doubt = identify_uncalibrated(s.xy_px, c, flux=s.flux, sigma_px=0.3, focal_sigma=0.005)
    assert doubt == ""
    assert np.array_equal(found.q_SN, told.q_SN)
    assert found.probability_false == told.probability_false


def test_no_sky_stays_no_sky_under_every_doubt():
    c = camera(12)
    for n, flux in ((8, True), (40, True), (40, False)):
        s = random_scene(c, np.random.default_rng([15, n]), n)
        found, _ = identify_uncalibrated(s.xy_px, c, flux=s.flux if flux else None, sigma_px=0.3)
        assert not found.solved
        assert found.log_odds < 2.3, "three looks at odds of ten to one should not come near 11.5"


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(1e-3, 1e6), min_size=1, max_size=60, unique=True), st.floats(0.2, 5.0))
def test_order_is_all_that_counts(light, gamma):
    """Any growing response gives the same magnitudes; the k-th brightest has log10(k)/COUNTS."""
    light = np.array(light)
    m = magnitude_of_order(light)
    response = np.argsort(np.argsort(light)) * gamma + 1.0
    assert np.array_equal(magnitude_of_order(response), m)
    assert np.allclose(np.sort(m), np.log10(np.arange(1, len(light) + 1)) / COUNTS)
    assert m[np.argmax(light)] == 0.0


def test_counts_grow_as_the_catalogue_says():
    """The slope behind magnitude_of_order: decades of stars per magnitude, from V = 2 to 7."""
    V = default_sky().magnitude
    slope = np.log10(np.searchsorted(V, 7.0) / np.searchsorted(V, 2.0)) / 5.0
    assert slope == pytest.approx(COUNTS, abs=0.03)


def test_a_rough_camera_gives_an_honest_attitude():
    """A decentred lens displaces stars by pixels that their covariances (0.1 px) do not know: errors stay within what sigma says.

    Ten skies; across the boresight, normalised by the attitude at the image's centre, 2 is honest for two axes.
    """
    true = Camera.from_fov(16.0, 1024, 768)
    lens = Camera(1024, 768, true.focal_px, (600.0, 330.0), 1.0, (0.08, 0.0, 0.0, 0.0, 0.0))
    squares, rough = [], 0
    sky = StarTracker(fov_deg=16.0).sky
    for k in range(10):
        rng = np.random.default_rng([77, k])
        R = Rotation.random(rng=rng).as_matrix()
        ahead = sky.directions @ R[2] > 0.9
        xy = lens.pixels(sky.directions[ahead] @ R.T)
        inside = np.flatnonzero(lens.inside(xy))[:35]
        n, one = len(inside), np.ones(len(inside))
        stars = Centroids(
            *(xy[inside] + rng.normal(0, 1.0, (n, 2))).T, bent(10 ** (-0.4 * sky.magnitude[ahead][inside])),
            np.tile(0.1**2 * np.eye(2), (n, 1, 1)), one, one < 0, one, 50 * one,
        )  # fmt: skip
        found = StarTracker(fov_deg=16.0).identified(stars, 1024, 768)
        assert found.solved, k
        rough += found.doubt == "rough"
        z = lens.directions(np.array(lens.geometric_centre_px)) @ R
        a, d = np.radians([found.ra_deg, found.dec_deg])
        east, north = (
            np.array([-np.sin(a), np.cos(a), 0]),
            np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)]),
        )
        error = np.degrees([z @ east, z @ north]) * 3600.0
        squares.append(float(error @ error) / float(np.mean(found.sigma_arcsec[:2] ** 2)))
    assert rough >= 8
    assert np.mean(squares) < 5.0  # 2 is honest; ten skies, and a prior that this lens is drawn from the rim of
