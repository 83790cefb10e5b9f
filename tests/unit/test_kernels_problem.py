"""The compiled preparation of a list, and the compiled search for the stars of an image, give what their NumPy twins give."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.native import kernels
from helmstar.stars import Pinhole, default_sky
from helmstar.stars.patterns import Sky, Window
from helmstar.stars.problem import MOST_DETECTIONS, Detections, prepare

MODULES = [importlib.import_module(f"helmstar.stars.{m}") for m in ("patterns", "problem")]
NONE, BARREL = (0.0, 0.0, 0.0, 0.0, 0.0), (-0.2, 0.05, 1e-3, -5e-4, 0.01)
PINCUSHION, FOLDS = (0.9, 0.2, 1e-3, -5e-4, 0.1), (-0.6, 0.0, 0.0, 0.0, 0.0)
pytestmark = pytest.mark.skipif(
    kernels() is None, reason="installed without compiled kernels, or their sources changed since"
)


def in_numpy(call, *args):
    """What `call` gives without the compiled kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for module in MODULES:
            patch.setattr(module, "kernels", lambda: None)
        return call(*args)


def assert_alike(a: tuple[Detections, np.ndarray], b: tuple[Detections, np.ndarray]):
    (d, ours), (e, theirs) = a, b
    assert np.array_equal(d.order, e.order)
    if d.magnitude is None or e.magnitude is None:
        assert d.magnitude is e.magnitude
    else:
        assert np.array_equal(d.magnitude, e.magnitude)
    # One rounding of a product here and there; Newton's last step feels it no more than that.
    assert d.xy == pytest.approx(e.xy, rel=1e-13, abs=1e-10)
    assert ours == pytest.approx(theirs, rel=1e-14)
    assert d.sigma == pytest.approx(e.sigma, rel=1e-14)
    # Sums of at most 120 terms of at most one, whose logs are about -13 and 0.
    for name in ("log_density", "log_magnitude_density"):
        assert getattr(d, name) == pytest.approx(getattr(e, name), abs=1e-12, nan_ok=True)
    assert d.in_c == pytest.approx(e.in_c, abs=1e-10, nan_ok=True)
    assert d.vacancy == pytest.approx(d.in_c[5 * len(d) : 6 * len(d) + 1], abs=1e-13)
    assert replace(d).in_c == pytest.approx(d.in_c, abs=1e-13, nan_ok=True)
    assert np.array_equal(d.low, e.low)
    assert np.array_equal(d.high, e.high)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), n=st.sampled_from([0, 1, 2, 3, 16, 119, 120, 121, 400]), told=st.integers(0, 2),
    sigmas=st.integers(0, 2), aspect=st.sampled_from([1.0, 1.7]),
    lens=st.sampled_from([NONE, BARREL, PINCUSHION]), spoiled=st.booleans(), close=st.booleans(),
)  # fmt: skip
def test_a_list_is_made_ready_as_by_numpy(seed, n, told, sigmas, aspect, lens, spoiled, close):
    rng = np.random.default_rng(seed)
    c = Pinhole(1500.0, (500.0, 420.0), (1024, 768), aspect, lens)
    # Close together many crowd each other; whole magnitudes are often equal.
    xy = rng.uniform(0, 12.0 if close else 768.0, (n, 2))
    m = np.round(rng.uniform(3, 9, n), int(rng.integers(0, 3)))
    A = rng.normal(size=(n, 2, 2))
    sigma = (0.3, rng.uniform(0.05, 1.0, n), A @ A.transpose(0, 2, 1) + 0.01 * np.eye(2))[sigmas]
    if spoiled and n:
        xy[rng.random(n) < 0.1, rng.integers(0, 2)] = rng.choice([np.nan, np.inf])
        m[rng.random(n) < 0.1] = rng.choice([np.nan, -np.inf])
        if sigmas:
            assert isinstance(sigma, np.ndarray)
            sigma[rng.random(n) < 0.1] = rng.choice([np.nan, 0.0])
    with np.errstate(over="ignore"):
        flux, magnitude = (10.0 ** (-0.4 * m) if told == 1 else None), (m if told == 2 else None)
    args = (xy, c, flux, magnitude, sigma, 0.4, None)
    a = prepare(*args)
    assert_alike(a, in_numpy(prepare, *args))
    d = a[0]
    assert len(d) <= MOST_DETECTIONS
    assert np.isfinite(xy[d.order]).all()
    if d.magnitude is not None:
        assert (np.diff(d.magnitude) >= 0.0).all()
    for k in range(1, len(d)):
        assert np.abs(d.xy[:k] - d.xy[k]).max(axis=1).min() >= 1.0


def test_places_that_no_direction_reaches_are_left_out():
    c = Pinhole(1000.0, (512.0, 384.0), (1024, 768), 1.0, FOLDS)
    xy = np.random.default_rng(8).uniform([0.0, 0.0], [1024.0, 768.0], (100, 2))
    # x - 0.6 x^3 grows up to x = 0.745 (FOLD of slope stays), where it is 0.497.
    there = np.hypot(*(xy - c.centre_px).T) < 0.4969 * 1000.0
    d, e = prepare(xy, c, None, None, 0.3, 0.4, None)[0], in_numpy(prepare, xy, c, None, None, 0.3, 0.4, None)[0]
    assert there.sum() < 95
    assert np.array_equal(d.order, np.flatnonzero(there))
    assert np.array_equal(d.order, e.order)
    # Near the fold the slope is thousandths: so much more of the last step is left.
    assert d.xy == pytest.approx(e.xy, abs=1e-7)


def test_parts_of_arrays_are_read_as_such():
    rng = np.random.default_rng(4)
    c, xy, m = Pinhole(1500.0, (512.0, 384.0), (1024, 768)), rng.uniform(0, 768, (40, 3)), rng.uniform(3, 9, 80)
    C = np.broadcast_to(0.04 * np.eye(2), (40, 2, 2))
    for places in (xy[:, ::2], np.asfortranarray(xy[:, :2]), np.round(xy[:, :2]).astype(np.int32)):
        args = (places, c, None, m[::2], C, 0.4, 0.1)
        assert_alike(prepare(*args), in_numpy(prepare, *args))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6), pole=st.sampled_from([None, 0.0, 1e-9, 0.02]), south=st.booleans(),
    half=st.floats(0.01, 0.8), level=st.sampled_from([None, 0, 3, 7]),
)  # fmt: skip
def test_the_stars_of_an_image_are_those_of_numpy(seed, pole, south, half, level):
    rng, sky = np.random.default_rng(seed), default_sky()
    R = Rotation.random(rng=rng).as_matrix()
    if pole is not None:  # z to within `pole` rad of one
        R = Rotation.from_euler("zx", [rng.uniform(0, 6), pole + (np.pi if south else 0.0)]).as_matrix()
    window = Window(R, (-half, -0.6 * half), (0.9 * half, 0.7 * half))
    radius = float(np.arctan(np.hypot(half, 0.7 * half)))

    def search(seen: Window | None) -> np.ndarray:
        return sky.around(R[2], radius, seen) if level is None else sky.near(level, R[2], radius, seen)

    members = np.arange(len(sky.directions)) if level is None else np.sort(sky.deep(level)[0])
    v = sky.directions[members] @ R.T
    with np.errstate(divide="ignore"):
        x, y = v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]
    circle = v[:, 2] > np.cos(radius)
    sees = (v[:, 2] > 0) & (x >= -half) & (x <= 0.9 * half) & (y >= -0.6 * half) & (y <= 0.7 * half)
    for seen, there in ((None, circle), (window, circle & sees)):
        found = search(seen)
        assert np.array_equal(found, in_numpy(search, seen))
        assert np.array_equal(found, members[there])


def test_a_table_of_other_stars_is_refused(monkeypatch):
    sky = Sky(default_sky().catalog)
    for wrong in (np.array([-1, 3]), np.array([2, 10**9])):
        monkeypatch.setattr(type(sky.level(0)), "members", lambda self, n, wrong=wrong: wrong)
        with pytest.raises(ValueError, match="not in the catalogue"):
            sky.near(2, np.array([0.0, 0.0, 1.0]), 0.1)
