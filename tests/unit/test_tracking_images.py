"""A star tracker that remembers: the same stars as at first sight, windows where a prior has them, and the way back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Image, detect
from helmstar.imaging.detect import Optics, detect_near, detect_next
from helmstar.imaging.render import Exposure, render
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars import load_catalog

CAMERA = Camera.from_fov(12.0, 800, 600)


def frame(R: Rotation, seed: int = 0, psf: float = 0.8, zero: float = 2e6) -> tuple[Image, np.ndarray]:
    """An image and the places (n, 2) of its stars."""
    catalog = load_catalog(8.0)
    e = Exposure(bits=8, gain_e=10.0, offset=5.0, psf_sigma_px=psf, zero_point_e_s=zero)
    image, truth = render(CAMERA, R.as_quat(), catalog.directions(), catalog.magnitude, e, seed)
    return image, np.stack([truth.x_px, truth.y_px], axis=1)


@pytest.mark.parametrize("psf", [0.6, 1.4, 2.6])
def test_the_second_look_sees_what_the_first_saw(psf):
    R = Rotation.random(rng=np.random.default_rng(1))
    image, _ = frame(R, psf=psf, zero=8e6)
    first, optics = detect_next(image)
    assert optics is not None
    assert optics.width == pytest.approx((psf, psf), rel=0.25)
    again, same = detect_next(image, optics=optics)
    assert same == optics
    n = len(first) // 2  # the brighter half: at the threshold they may differ
    apart = np.min(np.linalg.norm(first.xy_px[:n, None] - again.xy_px, axis=2), axis=1)
    assert np.mean(apart < 0.1) > 0.9


def test_what_is_remembered_wrongly_is_seen_again():
    R = Rotation.random(rng=np.random.default_rng(2))
    sharp, _ = frame(R, psf=0.7, zero=8e6)
    smeared, _ = frame(R, psf=2.4, zero=3e7)
    _, optics = detect_next(sharp)
    found, now = detect_next(smeared, optics=optics)
    fresh = detect(smeared)
    assert now is not None
    assert now.width[0] > 1.8
    assert len(found) == len(fresh)
    black = Image(np.zeros((300, 400), np.uint8), 255.0, 8)
    assert len(detect_next(black, optics=optics)[0]) == 0


def test_windows_find_the_stars_that_are_there_and_no_others():
    R = Rotation.random(rng=np.random.default_rng(3))
    image, places = frame(R)
    rng = np.random.default_rng(0)
    shifted = places[:30] + rng.uniform(-5, 5, (30, 2))
    found = detect_near(image, shifted, 8.0, Optics((0.8, 0.8)))
    apart = np.min(np.linalg.norm(found.xy_px[:, None] - places, axis=2), axis=1)
    assert len(found) >= 25
    assert np.mean(apart < 0.5) > 0.95
    assert np.mean((apart / np.sqrt(found.covariance_px[:, 0, 0])) ** 2) < 2 * 2.5  # two coordinates; honest is 2
    empty = Image(np.random.default_rng(1).poisson(40, (600, 800)).astype(np.uint8), 255.0, 8)
    assert len(detect_near(empty, shifted, 8.0, Optics((0.8, 0.8)))) <= 1
    assert len(detect_near(image, np.array([[-50.0, 3.0], [np.nan, 2.0], [9e9, 5.0]]), 8.0, Optics((0.8, 0.8)))) == 0


def test_tracking_follows_and_a_wrong_prior_falls_back_to_the_whole_sky():
    rng = np.random.default_rng(5)
    tracker = StarTracker(CAMERA)
    R = Rotation.random(rng=rng)
    assert tracker.solve(frame(R)[0]).solved
    squares = []
    for k in range(10):
        R = Rotation.from_rotvec(rng.normal(0, 2e-4, 3)) * R
        prior = Rotation.from_rotvec(rng.normal(0, 3e-4, 3)) * R
        found = tracker.solve(frame(R, k)[0], prior_q_SN=prior.as_quat(), prior_sigma=3e-4)
        assert found.solved
        assert len(found.centroids) <= 50
        e = (Rotation.from_quat(found.identification.q_SN) * R.inv()).as_rotvec()
        squares.append(e @ np.linalg.solve(found.identification.covariance, e))
    assert np.mean(squares) < 6.0  # chi-square of 3, ten times: 3 +- 0.8; a bias of the prior would be far above
    lost = tracker.solve(frame(R)[0], prior_q_SN=Rotation.random(rng=rng).as_quat(), prior_sigma=1e-4)
    assert lost.solved
    assert (Rotation.from_quat(lost.identification.q_SN) * R.inv()).magnitude() < 1e-4


def test_a_prior_that_is_no_attitude_is_refused():
    tracker = StarTracker(CAMERA)
    image = frame(Rotation.random(rng=np.random.default_rng(7)))[0]
    tracker.solve(image)
    with pytest.raises(ValueError, match="prior_q_SN"):
        tracker.solve(image, prior_q_SN=np.zeros(4), prior_sigma=1e-4)
