"""What a lens moves beyond its model is told from noise, and what it does to attitudes is of the size that is said."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from helmstar.attitude import svd
from helmstar.imaging import Camera
from helmstar.imaging.calibrate import Matches, calibrate
from helmstar.imaging.calibrated import Calibrated, read_calibrated, write_calibrated
from helmstar.imaging.unexplained import shared_px

CAMERA = Camera(1280, 960, 2400.0, (655.0, 468.0), 1.0, (-0.12, 0.06, 8e-4, -6e-4, 0.0))
NOISE = 0.1


def bent(xy: np.ndarray, px: float) -> np.ndarray:
    """A displacement (n, 2) that no lens makes: of 1.3 waves over the width, `px` root mean square per axis."""
    u, v = (xy / [CAMERA.width, CAMERA.height]).T
    return px * np.sqrt(2.0) * np.stack([np.sin(8.2 * v + 0.4), np.cos(8.2 * u)], axis=1)


def frames(seed: int, px: float, count: int = 8, stars: int = 40) -> list[Matches]:
    rng = np.random.default_rng(seed)
    out = []
    for q in Rotation.random(count, rng=rng):
        xy = rng.uniform([0, 0], [CAMERA.width - 1, CAMERA.height - 1], (stars, 2))
        d_N = q.inv().apply(CAMERA.directions(xy))
        out.append(Matches(xy + bent(xy, px) + rng.normal(0, NOISE, xy.shape), d_N, np.full(stars, NOISE)))
    return out


def test_noise_alone_is_no_displacement():
    found = [shared_px(data, calibrate(data, CAMERA)) for data in (frames(seed, 0.0) for seed in range(16))]
    # 26 terms of 640 coordinates scatter the sum of squares by sqrt(2 26) noise^2, so the root by 0.011 px; a third is beyond.
    assert np.median(found) < 0.012
    assert max(found) < 0.03


def test_a_displacement_is_found_beside_noise():
    for seed in range(4):
        data = frames(seed, 0.1)
        # Lens and attitudes take some of the field; a polynomial of fourth order gets most of the rest.
        assert 0.07 < shared_px(data, calibrate(data, CAMERA)) < 0.11


def test_outliers_do_not_count():
    data = frames(3, 0.0)
    for m in data:
        m.xy_px[0] += 30.0
    assert shared_px(data, calibrate(data, CAMERA)) < 0.03


def test_too_few_stars_tell_nothing():
    data = frames(1, 0.1, count=1, stars=12)
    assert shared_px(data, calibrate(data, CAMERA, ("focal",))) == 0.0


def test_attitudes_are_off_by_what_is_said():
    """The direction at the image's centre, by 60 frames of 60 stars: the noise of 60 stars alone promises eight times less."""
    px, squares, said = 0.1, [], []
    middle = np.array([CAMERA.geometric_centre_px])
    for seed in range(6):
        data = frames(seed, px)
        fit = calibrate(data, CAMERA)
        said.append(shared_px(data, fit))
        for m, q in zip(
            new := frames(100 + seed, px, 10, 60), Rotation.random(10, rng=np.random.default_rng(100 + seed))
        ):
            R = Rotation.from_quat(svd(fit.camera.directions(m.xy_px), m.directions_N).q_BN)
            # What is truly seen at the pixel in the middle, and what the fitted camera and attitude say.
            at = middle.copy()
            for _ in range(20):
                at = middle - bent(at, px)
            true_N = q.inv().apply(CAMERA.directions(at))
            error = fit.camera.pixels(R.apply(true_N)) - middle
            squares.append(float(np.square(error).mean()))
        assert len(new) == 10
    off = float(np.sqrt(np.mean(squares)))
    noise = NOISE / np.sqrt(60.0)
    assert off > 3.0 * noise
    # One place in the image, one field: within a factor of two of its root mean square.
    assert 0.5 < off / float(np.hypot(np.mean(said), noise)) < 2.0


def test_it_is_kept_in_the_camera_file(tmp_path):
    write_calibrated(tmp_path / "cam.toml", CAMERA, ["smooth_px = 0.07"])
    assert read_calibrated(tmp_path / "cam.toml") == Calibrated(CAMERA, smooth_px=0.07)
