"""A camera comes back from synthetic stars in many frames, with sigmas that hold, and what cannot be fitted is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.errors import DataError
from helmstar.imaging import Camera
from helmstar.imaging.calibrate import DEFAULT, Matches, calibrate

TRUE = Camera(1280, 960, 2400.0, (655.0, 468.0), 1.0, (-0.12, 0.06, 8e-4, -6e-4, 0.0))
START = Camera.from_fov(30.0, 1280, 960)


def frames(
    seed: int, count: int = 6, stars: int = 25, sigma: float = 0.1, camera: Camera = TRUE
) -> tuple[list[Matches], np.ndarray]:
    rng = np.random.default_rng(seed)
    out, q = [], Rotation.random(count, rng=rng)
    for k in range(count):
        xy = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (stars, 2))
        d_N = q[k].inv().apply(camera.directions(xy))
        out.append(Matches(xy + rng.normal(0, sigma, xy.shape), d_N, np.full(stars, sigma)))
    return out, q.as_quat()


def test_without_noise_the_camera_comes_back():
    exact, q = frames(0, sigma=1e-6)
    found = calibrate(exact, START)
    assert found.camera.focal_px == pytest.approx(2400.0, abs=1e-3)
    assert found.camera.centre_px == pytest.approx((655.0, 468.0), abs=1e-2)
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 959, 9)), axis=-1).reshape(-1, 2)
    turn = found.camera.directions(grid) @ TRUE.directions(grid).T
    assert np.diag(turn).min() > 1 - 1e-13
    assert found.rms_px < 1e-5
    back = Rotation.from_quat(found.q_SN) * Rotation.from_quat(q).inv()
    assert back.magnitude().max() < 1e-6


def test_sigmas_hold():
    z = []
    for seed in range(20):
        found = calibrate(frames(seed, count=5)[0], START)
        truth = [2400.0, 655.0, 468.0, -0.12, 0.06, 8e-4, -6e-4]
        got = [found.camera.focal_px, *found.camera.centre_px, *found.camera.distortion[:4]]
        assert found.names == DEFAULT
        z.append([(a - b) / found.sigma(n) for a, b, n in zip(got, truth, found.names)])
        assert found.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    assert 0.6 < np.mean(np.square(z)) < 1.5


def test_wrong_matches_do_not_pull():
    data, _ = frames(3)
    rng = np.random.default_rng(1)
    for m in data:
        m.xy_px[:2] += rng.uniform(5, 40, (2, 2))
    found = calibrate(data, START)
    assert found.camera.focal_px == pytest.approx(2400.0, abs=5 * found.sigma("focal"))
    assert sum((~k[:2]).sum() for k in found.kept) == 12
    assert sum((~k[2:]).sum() for k in found.kept) <= 1


def test_aspect_and_k3():
    camera = Camera(1280, 960, 2400.0, (640.0, 480.0), 1.93, (-0.2, 0.05, 0.0, 0.0, 0.3))
    data, _ = frames(5, count=8, stars=60, sigma=0.02, camera=camera)
    start = Camera.from_fov(30.0, 1280, 960, aspect=1.9)
    found = calibrate(data, start, fit=("focal", "cx", "cy", "aspect", "k1", "k2", "k3"))
    assert found.camera.aspect == pytest.approx(1.93, abs=5 * found.sigma("aspect"))
    assert found.sigma("aspect") < 1e-3
    assert found.chi2 / found.degrees < 1.3


def test_what_the_stars_do_not_show_stays_near_the_start():
    """A field of 4 deg in one frame: no distortion can be seen, and none is invented."""
    camera = Camera.from_fov(4.0, 1024, 1024)
    data, _ = frames(7, count=1, stars=12, sigma=0.3, camera=camera)
    found = calibrate(data, camera)
    assert found.camera.focal_px == pytest.approx(camera.focal_px, rel=3e-3)
    corner = camera.directions(np.array([0.0, 0.0]))
    away = found.camera.pixels(corner) - camera.pixels(corner)
    assert np.hypot(*away) < 150


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "no frames"),
        ([Matches(np.zeros((2, 2)), np.eye(3)[:2])], "2 stars"),
        ([Matches(np.random.default_rng(0).uniform(0, 900, (4, 2)), np.eye(3)[[0, 1, 2, 0]])], "too few"),
        ([Matches(np.full((30, 2), 5.0), np.tile([[0.0, 0.0, 1.0]], (30, 1)))], "do not fix an attitude"),
    ],
)
def test_too_little_is_refused(data, words):
    with pytest.raises(DataError, match=words):
        calibrate(data, START)


def test_misuse_is_an_error():
    data, _ = frames(0, count=1)
    with pytest.raises(ValueError, match="fit"):
        calibrate(data, START, fit=("focal", "zoom"))
    with pytest.raises(ValueError, match="frame 1"):
        calibrate([Matches(data[0].xy_px, data[0].directions_N[:5])], START)
    with pytest.raises(ValueError, match="sigma_px"):
        calibrate([Matches(data[0].xy_px, data[0].directions_N, np.zeros(25))], START)
