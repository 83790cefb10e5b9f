"""The compiled kernels of detection say what NumPy says, on frames, on their parts, and on what no camera gives."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helmstar.imaging import Camera, Centroids, Image
from helmstar.imaging.background import grid, mesh_from
from helmstar.imaging.centroid import Fit, fit
from helmstar.imaging.detect import Optics, detect_near, detect_next
from helmstar.imaging.pyramid import find_peaks, halve
from helmstar.imaging.render import Exposure, render
from helmstar.imaging.windows import windows
from helmstar.native import kernels

UP = np.array([0.0, 0.0, 0.0, 1.0])
MODULES = [
    import_module(f"helmstar.imaging.{m}")
    for m in ("background", "centroid", "detect", "measure", "pyramid", "windows")
]
TYPES = (np.uint8, np.uint16, np.float32)
# Both work in single precision, in another order of sums: a centre in a window of some pixels is then known to some 1e-6 px, and
# the least sigma is about 1e-3 px.
OF_SIGMA = 1e-3

pytestmark = pytest.mark.skipif(
    kernels() is None, reason="installed without compiled kernels, or their sources changed since"
)


def by_numpy(call: Callable[[], Any]) -> Any:
    """What `call` gives without the compiled kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for module in MODULES:
            patch.setattr(module, "kernels", lambda: None)
        return call()


def frame(shape: tuple[int, int], seed: int, of_type: type, stars: int = 40, **exposure: Any) -> Image:
    """A rendered frame of height, width with stars anywhere, also at its edges, some of them full."""
    rng = np.random.default_rng(seed)
    camera = Camera.from_fov(12.0, shape[1], shape[0])
    at = rng.uniform([-1, -1], [shape[1], shape[0]], (stars, 2))
    bits = 8 if of_type is np.uint8 else 12 if seed % 2 else 16
    e = Exposure(bits=bits, gain_e=60.0 if bits == 8 else 2.0, offset=12.0, full_well_e=15_000.0, **exposure)
    image, _ = render(camera, UP, camera.directions(at), rng.uniform(2.0, 7.0, stars), e, seed)
    if of_type is np.float32:
        return Image(image.array.astype(np.float32) / 3, image.saturation / 3, image.bits)
    assert image.array.dtype == of_type
    return image


def agree(a: Centroids, b: Centroids) -> None:
    """The same stars in the same order, places to a part of their sigma, the rest to single precision of sums."""
    assert len(a) == len(b)
    if not len(a):
        return
    sigma = np.sqrt(b.covariance_px[:, [0, 1], [0, 1]])
    assert np.abs((a.xy_px - b.xy_px) / sigma).max() < OF_SIGMA
    for name in ("flux", "peak", "snr", "elongation"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=2e-3, err_msg=name)
    np.testing.assert_allclose(a.covariance_px, b.covariance_px, rtol=2e-3, atol=2e-3 * (sigma**2).min())
    assert (a.saturated == b.saturated).all()


@pytest.mark.parametrize("of_type", TYPES)
@pytest.mark.parametrize("psf", [0.5, 0.9, 1.6, 3.0])
def test_frames_have_the_same_stars(of_type: type, psf: float) -> None:
    for seed in (1, 2):
        image = frame((240, 321), seed, of_type, psf_sigma_px=psf, hot_fraction=1e-3, gradient_e_px=(0.5, 0.2))
        (found, optics), (expected, same) = detect_next(image), by_numpy(lambda image=image: detect_next(image))
        agree(found, expected)
        assert len(found) > 10
        assert optics is not None
        assert same is not None
        assert optics.width == pytest.approx(same.width, rel=1e-4)
        agree(detect_next(image, optics=optics)[0], by_numpy(lambda i=image, o=optics: detect_next(i, optics=o))[0])
        near = found.xy_px[: len(found) // 2] + 0.4
        for reach in (2.0, 7.5):
            agree(
                detect_near(image, near, reach, optics),
                by_numpy(lambda i=image, n=near, r=reach, o=optics: detect_near(i, n, r, o)),
            )
        dark = np.random.default_rng(seed).uniform(0.0, 2.0, image.array.shape).astype(np.float32)
        agree(
            detect_near(image, near, 3.0, optics, dark=dark),
            by_numpy(lambda i=image, n=near, o=optics, d=dark: detect_near(i, n, 3.0, o, dark=d)),
        )


@pytest.mark.parametrize("shape", [(16, 16), (17, 200), (39, 64), (64, 39), (40, 40), (41, 53), (127, 81), (83, 259)])
def test_small_and_odd_frames(shape: tuple[int, int]) -> None:
    stars = 3 + shape[0] * shape[1] // 900
    for seed, of_type in enumerate(TYPES):
        image = frame(shape, seed, of_type, stars)
        agree(detect_next(image)[0], by_numpy(lambda i=image: detect_next(i))[0])
        optics = Optics((0.8, 0.8))
        agree(detect_next(image, optics=optics)[0], by_numpy(lambda i=image, o=optics: detect_next(i, optics=o))[0])
        corners = np.array([[0, 0], [shape[1] - 1, shape[0] - 1], [shape[1] / 2, 0], [3, shape[0] / 2]])
        for width in (0.8, 1.6, 3.2):
            optics = Optics((width, width))
            agree(
                detect_near(image, corners, 5.0, optics),
                by_numpy(lambda i=image, c=corners, o=optics: detect_near(i, c, 5.0, o)),
            )


@pytest.mark.parametrize("of_type", TYPES)
def test_broad_stars_are_the_same(of_type: type) -> None:
    """Badly focused and smeared: the fourth scale."""
    for seed, exposure in enumerate(({"psf_sigma_px": 6.5}, {"psf_sigma_px": 3.0, "omega_SN_S": (0.0, 0.04, 0.0)})):
        image = frame((480, 640), seed, of_type, stars=15, zero_point_e_s=6e7, **exposure)
        (found, optics), (expected, same) = detect_next(image), by_numpy(lambda image=image: detect_next(image))
        assert optics is not None
        assert same is not None
        assert optics.level == 3
        assert len(found) > 6
        assert optics.width == pytest.approx(same.width, rel=1e-3)
        agree(found, expected)
        agree(detect_next(image, optics=optics)[0], by_numpy(lambda i=image, o=optics: detect_next(i, optics=o))[0])
        agree(
            detect_near(image, found.xy_px, 4.0, optics),
            by_numpy(lambda i=image, n=found.xy_px, o=optics: detect_near(i, n, 4.0, o)),
        )


def test_a_view_of_every_second_pixel_is_read_as_what_it_is() -> None:
    image = frame((300, 400), 3, np.uint16, psf_sigma_px=1.4)
    view = Image(image.array[::2, ::2], image.saturation, image.bits)
    whole = Image(view.array.copy(), image.saturation, image.bits)
    found, optics = detect_next(view)
    assert optics is not None
    assert len(found) > 10
    agree(found, detect_next(whole)[0])
    agree(detect_near(view, found.xy_px, 4.0, optics), detect_near(whole, found.xy_px, 4.0, optics))


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(3, 90), width=st.integers(3, 90), kind=st.sampled_from(TYPES), steps=st.sampled_from([2, 5, 200]),
    level=st.integers(0, 3), threshold=st.floats(2.0, 8.0), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_peaks_are_equal(
    height: int, width: int, kind: type, steps: int, level: int, threshold: float, seed: int
) -> None:
    """To the last bit, plateaus and all: sums and comparisons are the same ones."""
    height, width = height + 2, width + 2
    rng = np.random.default_rng(seed)
    a = rng.integers(0, steps, (height, width)).astype(kind)
    a[rng.random(a.shape) < 0.02] = 255
    if level and kind is np.uint16:
        a = np.minimum(a, 4080)
    if kind is np.float32:
        a = (a / 7 - 3).astype(np.float32)
    mine, theirs = (f(lambda: find_peaks(a, level, threshold, 1.0)) for f in (lambda call: call(), by_numpy))
    for name in ("x", "y", "excess", "noise"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
    np.testing.assert_array_equal(halve(a), by_numpy(lambda: halve(a)))


def test_more_peaks_than_are_made_room_for() -> None:
    a = np.zeros((700, 900), np.uint8)
    a[5::9, 5::9] = 255
    many, same = find_peaks(a, 0, 2.0, 1.0), by_numpy(lambda: find_peaks(a, 0, 2.0, 1.0))
    np.testing.assert_array_equal(many.x, same.x)
    np.testing.assert_array_equal(many.noise, same.noise)
    assert len(many.x) > 4096


@settings(max_examples=20, deadline=None)
@given(
    height=st.integers(1, 300),
    width=st.integers(1, 300),
    seed=st.integers(0, 2**32 - 1),
    steps=st.sampled_from([3, 10**6]),
)
def test_meshes_are_equal(height: int, width: int, seed: int, steps: int) -> None:
    g = grid((height, width), (height, width), 64)
    values = np.random.default_rng(seed).integers(-steps, steps, (len(g.rows), len(g.columns))).astype(np.float32)
    mine, theirs = mesh_from(values.copy(), g, 1.0), by_numpy(lambda: mesh_from(values.copy(), g, 1.0))
    np.testing.assert_array_equal(mine.sky, theirs.sky)
    np.testing.assert_array_equal(mine.noise, theirs.noise)


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(0, 20),
    half=st.sampled_from([3, 5, 9, 17]),
    kind=st.sampled_from(TYPES),
    seed=st.integers(0, 2**32 - 1),
)
def test_windows_are_equal(n: int, half: int, kind: type, seed: int) -> None:
    """Pixels, marks and quantiles to the last bit; the sky's mean and the middle of light to single precision of their sums."""
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(16, 60, 2))
    a = rng.integers(0, 200, shape).astype(kind)
    x, y = rng.integers(0, shape[1], n), rng.integers(0, shape[0], n)
    a[y, x] = 250
    image, floor = Image(a, 250.0, 8), rng.uniform(0, 50, n).astype(np.float32)
    mine, theirs = windows(a, image, x, y, half, floor), by_numpy(lambda: windows(a, image, x, y, half, floor))
    for name in ("inner", "full", "filled", "noise", "structure"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
    for name in ("sky", "above", "grain", "x0", "y0"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-5, atol=1e-4, err_msg=name)


def stars_in_windows(rng: np.random.Generator, n: int, half: int) -> tuple[np.ndarray, ...]:
    """Windows (n, m, m) with a star of 20 to 2000 sigma each, filled (n, m, m) where pixels say nothing, widths (n,)."""
    d = np.arange(-half, half + 1)
    width = rng.uniform(0.5, half / 3, n)
    flux = 10.0 ** rng.uniform(2.5, 4.5, n)
    at = rng.uniform(-0.7, 0.7, (2, n))
    bells = np.exp(-0.5 * ((d[:, None] - at[:, None]) / width) ** 2)
    light = bells[1].T[:, :, None] * bells[0].T[:, None, :]
    light *= (flux / light.sum(axis=(1, 2)))[:, None, None]
    data = (100.0 + light + rng.normal(0.0, 1.0, light.shape)).astype(np.float32)
    filled = light > np.quantile(light, 0.995)
    filled[rng.random(n) < 0.3, :, : half - 1] = True  # the edge of an image
    data[filled] = 4e3
    return data, filled, width


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 20), half=st.sampled_from([2, 3, 5, 9, 10, 17, 18]), seed=st.integers(0, 2**32 - 1))
def test_fits_agree(n: int, half: int, seed: int) -> None:
    """Also of windows wider than the kernel takes, half 18, which NumPy fits."""
    rng = np.random.default_rng(seed)
    data, filled, _ = stars_in_windows(rng, n, half)
    zero, one = np.zeros(n, np.float32), np.ones(n, np.float32)
    wide = np.array([half / 6 + 0.3, half / 6 + 0.4])

    def found() -> Fit:
        return fit(data, zero, zero, 100.0 * one, one, wide, filled)

    mine, theirs = found(), by_numpy(found)
    sigma = np.sqrt(theirs.place_covariance(one, 0.5)[:, [0, 1], [0, 1]])
    for a in (mine.x, mine.y, mine.flux, mine.sky, mine.sigma, mine.bread, mine.light, mine.residual, mine.sums):
        assert np.isfinite(a).all()
    # A stop rule met by one of them and missed by the other leaves a step of at most the rule's tenth of a sigma or 0.02 px. It
    # has to be met to seven digits for that; a star whose filled pixels leave its place open may also step back and forth.
    known = sigma.max(axis=1) < 0.2
    off = np.abs(np.stack([mine.x - theirs.x, mine.y - theirs.y], axis=1))[known]
    assert (off < np.maximum(10 * OF_SIGMA * sigma[known], 1e-4)).all()
    np.testing.assert_allclose(mine.flux[known], theirs.flux[known], rtol=1e-3)


@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(1, 20), half=st.sampled_from([3, 5, 9, 17]), seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["noise", "zero", "full", "one pixel", "slope", "blank"]),
)  # fmt: skip
def test_whatever_a_window_holds_is_fitted_with_numbers(n: int, half: int, seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    m = 2 * half + 1
    data, filled = np.zeros((n, m, m), np.float32), np.zeros((n, m, m), bool)
    if kind == "noise":
        data[:] = rng.normal(0.0, 1.0, data.shape)
    elif kind == "full":
        data[:], filled[:] = 65535.0, True
    elif kind == "one pixel":
        data[np.arange(n), rng.integers(0, m, n), rng.integers(0, m, n)] = 65535.0
    elif kind == "slope":
        data += np.arange(m, dtype=np.float32) * 3000
    elif kind == "blank":
        data[:], filled[:] = rng.uniform(0.0, 65535.0, data.shape), rng.random(data.shape) < 0.9
    zero, noise = np.zeros(n, np.float32), rng.choice([0.0, 1.0, 1e4], n).astype(np.float32)
    f = fit(data, zero, zero, zero, noise, np.array([0.8, 1.2]), filled)
    for value in (f.x, f.y, f.flux, f.sigma, f.bread, f.light, f.residual, f.model, f.sums):
        assert np.isfinite(value).all()
    assert (np.abs(f.x) <= half).all()
    assert (f.flux > 0).all()
    assert (f.sigma >= 0.29).all()
    assert (f.sigma <= half).all()


def test_pixels_without_a_value_give_no_star_and_no_crash() -> None:
    image = frame((200, 300), 5, np.float32)
    found, optics = detect_next(image)
    assert optics is not None
    assert len(found) > 10
    holes = image.array.copy()
    for k, value in enumerate((np.nan, np.inf, -np.inf)):
        x, y = np.rint(found.xy_px[k]).astype(int)
        holes[y, x] = value
    broken = Image(holes, image.saturation, image.bits)
    seen = detect_near(broken, found.xy_px, 3.0, optics)
    agree(seen, by_numpy(lambda: detect_near(broken, found.xy_px, 3.0, optics)))
    assert 3 <= len(seen) < len(found)
    assert np.isfinite(seen.xy_px).all()
    assert np.isfinite(seen.covariance_px).all()
    whole = detect_next(broken)[0]
    agree(whole, by_numpy(lambda: detect_next(broken))[0])
    assert np.isfinite(whole.xy_px).all()


def test_a_thousand_stars_in_a_crowd() -> None:
    """More than a window apart or not: whose window holds whom, and what is a brighter one's second finding, is the same."""
    image = frame((300, 400), 7, np.uint16, stars=1500, psf_sigma_px=1.2)
    agree(detect_next(image)[0], by_numpy(lambda: detect_next(image))[0])
