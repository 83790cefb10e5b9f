"""The renderer puts stars where the camera sees them, with the light, the noise and the smear that it was told."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera
from helmstar.imaging.render import Exposure, Glow, render

CAMERA = Camera(320, 240, 1500.0, (150.0, 130.0), 1.2, (-0.1, 0.05, 1e-3, -1e-3, 0.0))
STILL = Exposure(
    poisson=False, read_noise_e=0.0, sky_e_s=0.0, dark_e_s=0.0, gain_e=1.0, offset=0.0, full_well_e=6e4, bits=16
)
UP = np.array([0.0, 0.0, 0.0, 1.0])


def moments(a: np.ndarray) -> tuple[float, float, float, float]:
    a = a.astype(float)
    y, x = np.mgrid[: a.shape[0], : a.shape[1]]
    mx, my = (a * x).sum() / a.sum(), (a * y).sum() / a.sum()
    return mx, my, (a * (x - mx) ** 2).sum() / a.sum(), (a * (y - my) ** 2).sum() / a.sum()


def test_a_star_is_where_and_as_bright_as_the_truth_says():
    q = Rotation.from_euler("xyz", [20, -30, 70], degrees=True)
    place = np.array([[203.3, 88.7]])
    d_N = q.inv().apply(CAMERA.directions(place))
    e = Exposure(**(vars(STILL) | {"zero_point_e_s": 1e7, "psf_sigma_px": 1.5}))
    image, truth = render(CAMERA, q.as_quat(), d_N, np.array([4.0]), e)
    assert (truth.x_px[0], truth.y_px[0]) == pytest.approx((203.3, 88.7), abs=1e-9)
    assert truth.electrons[0] == pytest.approx(1e7 * 0.2 * 10**-1.6)
    mx, my, sx, sy = moments(image.array)
    assert (mx, my) == pytest.approx((203.3, 88.7), abs=0.01)
    assert (sx, sy) == pytest.approx((1.5**2 + 1 / 12,) * 2, rel=0.02)
    assert image.array.sum() == pytest.approx(truth.electrons[0], rel=0.01)


def test_smear_follows_the_rate():
    """A turn about +y of S moves stars towards -x: dd/dt = -omega x d. Its length is rate times exposure."""
    e = Exposure(**(vars(STILL) | {"omega_SN_S": (0.0, 0.05, 0.0), "duration": 0.2, "zero_point_e_s": 2e7}))
    camera = Camera(320, 240, 1500.0)
    image, truth = render(camera, UP, np.array([[0.0, 0.0, 1.0]]), np.array([3.0]), e)
    mx, my, sx, sy = moments(image.array)
    path = 0.05 * 0.2 * 1500.0
    assert (mx, my) == pytest.approx((truth.x_px[0], truth.y_px[0]), abs=0.02)
    assert sx == pytest.approx(path**2 / 12 + 0.8**2 + 1 / 12, rel=0.03)
    assert sy == pytest.approx(0.8**2 + 1 / 12, rel=0.05)
    roll = Exposure(**(vars(e) | {"omega_SN_S": (0.0, 0.0, 0.5)}))
    image, _ = render(camera, UP, camera.directions(np.array([[300.0, 119.5]])), np.array([3.0]), roll)
    _, _, sx, sy = moments(image.array)
    assert sy > 10 * sx


def test_noise_is_poisson_and_read_noise():
    e = Exposure(
        sky_e_s=400.0,
        dark_e_s=100.0,
        duration=1.0,
        read_noise_e=15.0,
        gain_e=0.5,
        offset=100.0,
        bits=16,
        full_well_e=3e4,
    )
    image, truth = render(Camera(400, 300, 1000.0), UP, np.zeros((0, 3)), np.zeros(0), e)
    assert len(truth.index) == 0
    a = image.array.astype(float)
    assert a.mean() == pytest.approx(500 / 0.5 + 100, rel=1e-3)
    assert a.var() == pytest.approx((500 + 15**2) / 0.25, rel=0.02)


def test_full_wells_hot_pixels_glow_and_gradient():
    e = Exposure(hot_fraction=0.01, full_well_e=2e4, gain_e=10.0, offset=20.0, hot_e_s=5e4, zero_point_e_s=1e9)
    image, _ = render(CAMERA, UP, np.array([[0.0, 0.0, 1.0]]), np.array([1.0]), e)
    assert image.array.max() <= image.saturation + 5
    assert image.array[129:132, 149:152].min() > 0.9 * image.saturation
    assert 0.008 < (image.array > 60).mean() < 0.03
    glow = Exposure(
        **(vars(STILL) | {"glow": (Glow(0.0, 0.0, 1000.0, 50.0),), "gradient_e_px": (1.0, 0.0), "sky_e_s": 1e4})
    )
    image, _ = render(CAMERA, UP, np.zeros((0, 3)), np.zeros(0), glow)
    a = image.array.astype(float)
    assert a[0, 0] - a[-1, 0] == pytest.approx(1000.0, abs=3)
    assert a[-1, -1] - a[-1, 0] == pytest.approx(319.0, abs=3)


def test_seeds_and_stars_that_are_not_seen():
    d = CAMERA.directions(np.array([[100.0, 100.0], [-1.0, 50.0], [5000.0, 100.0]]))
    d = np.concatenate([d, [[0.0, 0.0, -1.0]]])
    one, truth = render(CAMERA, UP, d, np.full(4, 3.0), seed=1)
    assert truth.index.tolist() == [0]
    assert one.array[50, 0] > 5 * np.median(one.array)  # the star beyond the edge still shines into the frame
    assert np.array_equal(one.array, render(CAMERA, UP, d, np.full(4, 3.0), seed=1)[0].array)
    assert not np.array_equal(one.array, render(CAMERA, UP, d, np.full(4, 3.0), seed=2)[0].array)
    assert render(CAMERA, UP, d, np.full(4, 3.0), Exposure(bits=8))[0].array.dtype == np.uint8


def test_a_megapixel_is_quick():
    rng = np.random.default_rng(0)
    camera = Camera.from_fov(15.0, 1024, 1024)
    d = camera.directions(rng.uniform(0, 1023, (300, 2)))
    start = time.process_time()
    render(camera, UP, d, rng.uniform(2, 8, 300), Exposure(omega_SN_S=(0.0, 0.002, 0.0)))
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"duration": 0.0},
        {"gain_e": np.nan},
        {"bits": 17},
        {"hot_fraction": 2.0},
        {"sky_e_s": -1.0},
        {"psf_sigma_px": 0.01},
    ],
)
def test_exposures_that_mean_nothing(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Exposure(**wrong)


def test_shapes_that_do_not_fit():
    with pytest.raises(ValueError, match="directions_N"):
        render(CAMERA, UP, np.zeros((3, 2)), np.zeros(3))
