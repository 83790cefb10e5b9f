"""Detection and centroids on rendered frames: honest sigmas, and what is no star is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from helmstar.imaging import Camera, DetectionSettings, Image, dark_of, detect
from helmstar.imaging.detect import detect_near, detect_next
from helmstar.imaging.render import Exposure, Glow, Truth, render

CAMERA = Camera.from_fov(12.0, 640, 512)
UP = np.array([0.0, 0.0, 0.0, 1.0])
PURE = DetectionSettings(optics_px=0.0)


def scene(n: int, seed: int, exposure: Exposure, faint: float = 6.5, camera: Camera = CAMERA) -> tuple[Image, Truth]:
    """Stars scattered over the frame, none nearer to another than 25 px, V from 3 to `faint`."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < n:
        p = rng.uniform([8, 8], [camera.width - 9, camera.height - 9])
        if all(np.hypot(*(p - q)) > 25 for q in places):
            places.append(p)
    return render(camera, UP, camera.directions(np.array(places)), rng.uniform(3.0, faint, n), exposure, seed)


def matched(found, truth: Truth, within: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (index found, index truth)."""
    at = np.stack([truth.x_px, truth.y_px], axis=1)
    d, k = cKDTree(at).query(found.xy_px, distance_upper_bound=within)
    hit = np.isfinite(d)
    return np.flatnonzero(hit), k[hit]


@pytest.mark.parametrize("psf", [0.5, 0.8, 1.5, 2.5])
@pytest.mark.parametrize("read_noise", [5.0, 40.0])
def test_residuals_over_sigma_have_unit_variance(psf, read_noise):
    """Poisson and read noise, gain not told. Sharp optics at full pixel phase are the hard case for a bias."""
    e = Exposure(psf_sigma_px=psf, read_noise_e=read_noise, full_well_e=2e5, gain_e=2.0, bits=16)
    z, faint = [], []
    for seed in range(6):
        image, truth = scene(40, seed, e, faint=8.0)
        found = detect(image, PURE)
        i, k = matched(found, truth)
        error = found.xy_px[i] - np.stack([truth.x_px, truth.y_px], axis=1)[k]
        inverse = np.linalg.inv(found.covariance_px[i])
        z.append(np.einsum("ni,nij,nj->n", error, inverse, error) / 2)
        faint.append(found.snr[i] < 20)
    z, faint = np.concatenate(z), np.concatenate(faint)
    assert len(z) > 60
    for part in (z, z[faint], z[~faint]):
        if len(part) > 40:
            assert 0.6 < np.mean(np.minimum(part, 10)) < 1.45


def test_a_known_gain_is_used():
    e = Exposure(psf_sigma_px=0.9, full_well_e=2e5, gain_e=2.0, bits=16)
    image, _ = scene(30, 1, e)
    with_gain = detect(image, replace(PURE, gain=0.5))  # half a count of variance for each count of light
    estimated = detect(image, PURE)
    ratio = np.sqrt(with_gain.covariance_px[:10, 0, 0] / estimated.covariance_px[:10, 0, 0])
    assert np.all((ratio > 0.8) & (ratio < 1.25))


def test_no_pull_towards_pixel_centres():
    """Without noise, optics of half a pixel: the fit integrates over pixels as they do."""
    e = Exposure(
        psf_sigma_px=0.5, poisson=False, read_noise_e=0.0, full_well_e=1e7, gain_e=0.5, bits=16, zero_point_e_s=5e5
    )
    image, truth = scene(40, 3, e, faint=5.0)
    found = detect(image, PURE)
    i, k = matched(found, truth)
    assert len(i) == 40
    assert np.abs(found.x_px[i] - truth.x_px[k]).max() < 0.01
    assert found.flux[i] * e.gain_e == pytest.approx(truth.electrons[k], rel=0.02)


def test_order_and_arrays():
    image, truth = scene(30, 5, Exposure())
    found = detect(image)
    assert np.all(np.diff(found.flux) <= 0)
    assert found.covariance_px.shape == (len(found), 2, 2)
    assert np.all(np.linalg.eigvalsh(found.covariance_px) > 0)
    i, k = matched(found, truth)
    assert len(i) >= 28
    assert np.array_equal(np.argsort(-truth.electrons[k])[:3], np.argsort(-found.flux[i])[:3])
    few = detect(image, DetectionSettings(max_stars=5))
    assert len(few) == 5
    assert set(np.rint(few.x_px)) <= set(np.rint(found.x_px[:8]))


def test_hot_pixels_and_a_hot_column_are_no_stars():
    image, truth = scene(25, 7, Exposure(hot_fraction=0.01, psf_sigma_px=0.7), faint=5.5)
    array = image.array.copy()
    array[:, 333] = np.minimum(array[:, 333] + 600, 4095)
    found = detect(Image(array, image.saturation, image.bits))
    i, _ = matched(found, truth)
    assert len(i) >= 23
    assert len(found) - len(i) <= 9  # of 3300 hot pixels, some of which stand in groups as stars do
    assert not np.any(np.abs(found.x_px - 333) < 1) or np.any(np.abs(truth.x_px - 333) < 2)


def test_glow_gradient_and_a_roof():
    glow = (Glow(700.0, 0.0, 8000.0, 200.0),)
    image, truth = scene(
        25, 9, Exposure(glow=glow, gradient_e_px=(1.0, 2.0), sky_e_s=2000.0, full_well_e=6e4, gain_e=15.0), 5.5
    )
    array = image.array.astype(np.float32)
    y, x = np.mgrid[: image.height, : image.width]
    roof = (x > 400) & (y - 150 > 0.7 * (500 - x))
    array[roof] = 150.0 + 300.0 * (np.sin(x[roof] / 9) > 0) + np.random.default_rng(0).normal(0, 5, roof.sum())
    found = detect(Image(np.rint(array).astype(np.uint16), image.saturation, 12))
    i, _ = matched(found, truth)
    free = ~roof[np.rint(truth.y_px).astype(int), np.rint(truth.x_px).astype(int)]
    assert len(i) >= free.sum() - 3
    assert len(found) - len(i) <= 4


def test_saturated_and_smeared_stars():
    image, truth = scene(25, 11, Exposure(zero_point_e_s=4e7, psf_sigma_px=1.0), faint=6.0)
    found = detect(image)
    i, k = matched(found, truth)
    assert found.saturated[i].sum() > 5
    full = found.saturated[i]
    assert np.hypot(found.x_px[i] - truth.x_px[k], found.y_px[i] - truth.y_px[k])[full].max() < 0.5
    # 6 px along x in the exposure
    rate = 6.0 / CAMERA.focal_px / 0.2
    image, truth = scene(25, 12, Exposure(omega_SN_S=(0.0, rate, 0.0), psf_sigma_px=0.8), faint=5.0)
    found = detect(image)
    i, k = matched(found, truth)
    assert len(i) >= 22
    assert 1.6 < np.median(found.elongation[i]) < 4.0
    assert np.median(np.hypot(found.x_px[i] - truth.x_px[k], found.y_px[i] - truth.y_px[k])) < 0.1


@pytest.mark.parametrize(("psf", "smear_px"), [(7.0, 0.0), (4.0, 16.0)])
def test_stars_that_fill_the_coarsest_window(psf, smear_px):
    """Badly focused or smeared, twenty pixels across: the brightest stars are still seen."""
    e = Exposure(zero_point_e_s=4e7, psf_sigma_px=psf, omega_SN_S=(0.0, smear_px / CAMERA.focal_px / 0.2, 0.0))
    hits, there = 0, 0
    for seed in range(3):
        image, truth = scene(10, seed, e, faint=4.0)
        found = detect(image)
        _, k = matched(found, truth, within=3.0)
        hits, there = hits + len(set(k)), there + len(truth.x_px)
    assert hits >= 0.9 * there


@pytest.mark.parametrize(
    ("psf", "smear_px", "roll"),
    [(5.0, 0.0, 0.0), (8.0, 0.0, 0.0), (3.0, 22.0, 0.0), (3.0, 22.0, 0.7), (2.0, 26.0, 1.4)],
)
def test_stars_broader_than_the_third_scale(psf, smear_px, roll):
    """One star each, at the middle of its trail, as exact as it claims; also by a frame that knows the optics, and near places."""
    rate = smear_px / CAMERA.focal_px / 0.2
    e = Exposure(zero_point_e_s=4e7, psf_sigma_px=psf, omega_SN_S=(rate * np.sin(roll), rate * np.cos(roll), 0.0))
    hits, there, z = 0, 0, []
    for seed in range(40, 43):
        image, truth = scene(12, seed, e, faint=5.0)
        whole, optics = detect_next(image)
        assert optics is not None
        at = np.stack([truth.x_px, truth.y_px], axis=1)
        for found in (whole, detect_next(image, optics=optics)[0], detect_near(image, at, 3.0, optics)):
            i, k = matched(found, truth, within=3.0)
            assert len(found) - len(i) <= 1
            assert len(set(k)) == len(k)
            hits, there = hits + len(k), there + len(at)
            error = found.xy_px[i] - at[k]
            z.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px[i]), error) / 2)
    assert hits >= 0.9 * there
    # The median: stars whose trail the frame's edge cuts are off by more than they can know.
    assert np.median(np.concatenate(z)) < 1.0


def test_three_scales_are_the_same_where_the_fourth_is_not_needed():
    for psf in (0.8, 1.5, 2.2):
        image, _ = scene(30, 3, Exposure(psf_sigma_px=psf))
        assert np.array_equal(detect(image).xy_px, detect(image, DetectionSettings(levels=3)).xy_px)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_an_empty_sky_has_no_stars(value):
    assert len(detect(Image(np.full((300, 400), value, np.uint8), 255.0, 8))) == 0


@pytest.mark.parametrize("kind", ["normal", "uniform", "salt"])
def test_noise_has_next_to_no_stars(kind):
    rng = np.random.default_rng(0)
    noise = {
        "normal": rng.normal(100, 10, (800, 1000)),
        "uniform": rng.uniform(0, 255, (800, 1000)),
        "salt": 255.0 * (rng.random((800, 1000)) < 1e-3),
    }[kind]
    found = detect(Image(np.clip(np.rint(noise), 0, 255).astype(np.uint8), 256.0, 8))
    assert len(found) <= {"normal": 2, "uniform": 2, "salt": 8}[kind]


@pytest.mark.parametrize("shape", [(1, 1), (10, 500), (16, 16), (41, 41), (67, 1001), (500, 17)])
def test_images_of_any_size(shape):
    rng = np.random.default_rng(1)
    for kind in (np.uint8, np.uint16, np.float32):
        detect(Image(rng.integers(0, 200, shape).astype(kind), 255.0, 8))


def test_a_dark_takes_fixed_patterns_away():
    image, truth = scene(20, 13, Exposure(), faint=5.0)
    pattern = np.zeros(image.array.shape, np.float32)
    pattern[100:140:4, 100:140:4] = 900.0  # false stars of 2 x 2 pixels
    pattern[101:141:4, 100:140:4] = pattern[100:140:4, 101:141:4] = pattern[101:141:4, 101:141:4] = 800.0
    spoiled = Image((image.array + pattern).astype(np.uint16), 4095.0, 12)
    found = detect(spoiled, dark=pattern)
    i, _ = matched(found, truth)
    assert len(i) >= 18
    assert len(found) - len(i) <= 2
    with pytest.raises(ValueError, match="dark of shape"):
        detect(image, dark=pattern[:10])


def test_a_dark_from_frames_on_moving_skies():
    pattern = np.zeros((CAMERA.height, CAMERA.width))
    pattern[40:480:60, 50:600:70] = 900.0
    pattern[41:481:60, 50:600:70] = pattern[40:480:60, 51:601:70] = 500.0  # groups of hot pixels that look like stars
    skies = [scene(20, 30 + k, Exposure(), faint=5.0) for k in range(4)]
    frames = [Image(np.minimum(i.array + pattern, 4095).astype(np.uint16), i.saturation, 12) for i, _ in skies]
    assert len(detect(frames[0])) > 60
    dark = dark_of(frames)
    assert 0.5 * (pattern > 0).sum() < (dark > 0).sum() < 1.5 * (pattern > 0).sum()
    found = detect(frames[0], dark=dark)
    i, _ = matched(found, skies[0][1])
    assert len(i) >= 18
    assert len(found) - len(i) <= 4
    with pytest.raises(ValueError, match="at least 3"):
        dark_of(frames[:2])


@pytest.mark.parametrize("radius", [15, 40, 150])
def test_the_moon_is_no_star(radius):
    y, x = np.mgrid[:600, :800]
    r = np.hypot(x - 400, y - 300)
    sky = np.random.default_rng(0).normal(20, 3, r.shape) + 250 * (r < radius) + 60 * np.exp(-r / 120)
    assert len(detect(Image(np.clip(sky, 0, 255).astype(np.uint8), 255.0, 8))) <= 1


def test_values_that_are_none_are_dark():
    image, truth = scene(15, 17, Exposure(), faint=5.0)
    array = image.array.astype(np.float32)
    array[200:230, 100:160] = np.nan
    array[0, 0] = np.inf
    i, _ = matched(detect(Image(array, image.saturation, 12)), truth)
    assert len(i) >= 12
    assert len(detect(Image(np.full((50, 50), np.nan, np.float32), 1.0, 16))) == 0


def test_one_image_gives_the_same_stars_whatever_its_type():
    image, _ = scene(25, 15, Exposure(bits=8, gain_e=60.0, offset=5.0, zero_point_e_s=1e7))
    small = detect(image)
    large = detect(Image(image.array.astype(np.uint16), image.saturation, 8))
    assert len(small) == len(large)
    assert small.x_px == pytest.approx(large.x_px, abs=1e-3)


@pytest.mark.parametrize("wrong", [{"threshold": 1.0}, {"levels": 5}, {"max_stars": 0}])
def test_settings_that_mean_nothing(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DetectionSettings(**wrong)
