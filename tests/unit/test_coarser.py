"""Stars that trail over twenty pixels are seen on means of pixels, and what their length hides is in the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Image, detect
from helmstar.imaging.coarser import LEAST_SIDE, detect_coarser
from helmstar.imaging.render import Exposure, render
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars import load_catalog

CAMERA = Camera.from_fov(14.0, 1280, 960)


def frame(seed: int, smear_px: float, psf: float = 1.2, zero: float = 2e7) -> tuple[Image, Rotation]:
    """An image, and its attitude in the middle of the exposure."""
    rng = np.random.default_rng(seed)
    R, catalog = Rotation.random(rng=rng), load_catalog(7.5)
    angle, seconds = rng.uniform(0.0, np.pi), 0.2
    omega = smear_px / CAMERA.focal_px / seconds * np.array([np.cos(angle), np.sin(angle), 0.0])
    e = Exposure(
        bits=12,
        gain_e=5.0,
        offset=30.0,
        psf_sigma_px=psf,
        zero_point_e_s=zero,
        omega_SN_S=(omega[0], omega[1], 0.0),
        duration=seconds,
    )
    image, _ = render(CAMERA, R.as_quat(), catalog.directions(), catalog.magnitude, e, seed)
    return image, R


def test_places_are_those_of_the_image():
    image, _ = frame(1, 0.0, psf=2.5)
    fine = detect(image)
    for step in (2, 3):
        coarse = detect_coarser(image, step)
        assert coarse is not None
        n = len(coarse) // 2
        apart = np.linalg.norm(coarse.xy_px[:n, None] - fine.xy_px, axis=2).min(axis=1)
        # An edge taken for a centre would shift all by (step - 1)/2 px.
        assert np.median(apart) < 0.15
        near = np.linalg.norm(coarse.xy_px[:n, None] - fine.xy_px, axis=2).argmin(axis=1)
        assert np.median(coarse.flux[:n] / fine.flux[near]) == pytest.approx(
            1.0, abs=0.02
        )  # neighbours merge now and then


def test_a_dark_is_taken_off_and_small_images_have_no_means():
    image, _ = frame(2, 0.0)
    dark = np.zeros(image.array.shape, np.float32)
    bright = Image(image.array + np.uint16(200), image.saturation, image.bits)
    plain, taken = detect_coarser(image, 2), detect_coarser(bright, 2, dark=dark + 200.0)
    assert plain is not None
    assert taken is not None
    assert np.allclose(plain.xy_px, taken.xy_px)
    with pytest.raises(ValueError, match="dark of shape"):
        detect_coarser(image, 2, dark=dark[1:])
    side = 2 * LEAST_SIDE
    assert detect_coarser(Image(np.zeros((side, side - 1), np.uint8), 255.0, 8), 2) is None
    assert detect_coarser(Image(np.zeros((side, side), np.uint8), 255.0, 8), 2) is not None


@pytest.mark.parametrize("smear_px", [20.0, 28.0])
def test_trails_are_solved_within_their_sigma(smear_px):
    averaged, right = 0, 0
    for seed in range(4):
        image, R = frame(seed, smear_px, zero=4e6 * smear_px)
        found = StarTracker(fov_deg=14.0).solve(image)
        if not found.solved:
            continue
        right += 1
        averaged += found.averaged_px > 1
        # The attitude told is the middle of the exposure, and a streak's light is even: far nearer than its length.
        error = (Rotation.from_quat(found.identification.q_SN) * R.inv()).as_rotvec()
        sigma = np.sqrt(np.diagonal(found.identification.covariance))
        assert np.all(np.abs(error) < 2.0 * sigma)
        assert 0.2 * smear_px < sigma[:2].max() * CAMERA.focal_px < smear_px
        assert found.ms["coarser"] > 0.0
        assert float(np.hypot(*error[:2])) * CAMERA.focal_px < 0.1 * smear_px
    assert right >= 3
    assert averaged >= 3


def test_what_shows_no_more_on_means_is_not_looked_at_again(monkeypatch):
    """Noise, and a mirrored sky, whose stars are as many on pixels."""
    calls = []
    real = StarTracker.identified

    def counted(self, *args, **kinds):
        calls.append(1)
        return real(self, *args, **kinds)

    monkeypatch.setattr(StarTracker, "identified", counted)
    rng = np.random.default_rng(3)
    noise = Image(rng.normal(100.0, 8.0, (600, 800)).astype(np.float32), 65535.0, 16)
    sky, _ = frame(4, 0.0)
    mirrored = Image(np.ascontiguousarray(sky.array[:, ::-1]), sky.saturation, sky.bits)
    for image in (noise, mirrored):
        calls.clear()
        found = StarTracker(fov_deg=14.0).solve(image)
        assert not found.solved
        assert found.averaged_px == 1
        assert len(calls) == 1
        assert found.ms["total"] == pytest.approx(sum(v for k, v in found.ms.items() if k != "total"))
