"""The last fit of a star tracker on synthetic stars: its covariance holds for lenses that nobody calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Centroids
from helmstar.imaging.calibrated import Calibrated
from helmstar.sensors.lens import Lens, LensPrior
from helmstar.sensors.refine import refine
from helmstar.sensors.star_tracker import StarTracker

NOMINAL = Camera.from_fov(12.0, 1024, 768)


def sky():
    return StarTracker(fov_deg=12.0).sky


def seen(camera: Camera, R: np.ndarray, rng: np.random.Generator, sigma: float, count: int = 40) -> Centroids:
    """The `count` brightest catalogue stars in view, with noise; nothing false."""
    s = sky()
    ahead = s.directions @ R[2] > 0.9
    xy = camera.pixels(s.directions[ahead] @ R.T)
    V = s.magnitude[ahead]
    inside = np.flatnonzero(camera.inside(xy))[:count]  # the catalogue has the brightest first
    n, one = len(inside), np.ones(len(inside))
    return Centroids(
        xy[inside, 0] + rng.normal(0, sigma, n), xy[inside, 1] + rng.normal(0, sigma, n), 10 ** (-0.4 * V[inside]),
        np.tile(0.1**2 * np.eye(2), (n, 1, 1)), one, one < 0, one, 50 * one,
    )  # fmt: skip


def lens(rng: np.random.Generator) -> Camera:
    """As the prior believes lenses to be."""
    prior = LensPrior.uncalibrated(NOMINAL, 0.002)
    dx, dy = rng.normal(0, prior.centre_px, 2)
    f = NOMINAL.focal_px * (1 + rng.normal(0, prior.focal))
    k1 = rng.normal(0, prior.k1)
    return Camera(1024, 768, f, (NOMINAL.cx + dx, NOMINAL.cy + dy), 1.0, (k1, 0, 0, 0, 0))


def anchored(camera: Camera, R: np.ndarray) -> np.ndarray:
    """R_SN whose z axis is seen at the nominal centre: the least turn from the camera's own boresight."""
    z = camera.directions(np.array([NOMINAL.cx, NOMINAL.cy]))
    axis = np.cross(z, [0.0, 0.0, 1.0])
    angle = np.arcsin(np.linalg.norm(axis))
    return Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-15) * angle).as_matrix() @ R


def normalised(seed: int, sigma: float) -> tuple[float, float]:
    """Squared error of the solution over its covariance (3 axes), and its error across the boresight over a known camera's."""
    rng = np.random.default_rng(seed)
    camera, R = lens(rng), Rotation.random(rng=rng).as_matrix()
    found = StarTracker(fov_deg=12.0).identified(seen(camera, R, rng, sigma), 1024, 768)
    assert found.solved
    i = found.identification
    e = (Rotation.from_quat(i.q_SN) * Rotation.from_matrix(anchored(camera, R)).inv()).as_rotvec()
    return float(e @ np.linalg.solve(i.covariance, e)), found.scale


@pytest.mark.parametrize("sigma", [0.1, 0.25])
def test_the_covariance_holds_for_unknown_lenses_and_for_sigmas_that_were_told_too_small(sigma):
    squares, scales = np.array([normalised(seed, sigma) for seed in range(50)]).T
    # 50 times chi-square of 3: mean 3, one sigma sqrt(6/50) = 0.35. The scale's own error adds a twentieth; the belief in sigmas
    # that were told wrongly and Huber's cut a tenth each where they are 2.5 times too small.
    # Of a rough camera's displacement a quarter counts as common to all stars, which it is not here: sigma is wider by a half.
    low, high = (2.0, 4.6) if sigma == 0.1 else (1.2, 5.5)
    assert low < squares.mean() < high
    # Sigmas that were told 2.5 times too small make the camera a rough one, whose displacement of stars then explains the
    # residuals: 40 stars (some 75 degrees of freedom) against the belief in the sigmas (8), and Huber's cut.
    assert np.median(scales) == pytest.approx(1.0, rel=0.2)


def test_a_lens_that_the_fit_does_not_know_is_what_makes_the_error():
    """Without the lens's parameters the same stars give an attitude several times worse."""
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(10):
        camera, R = lens(rng), Rotation.random(rng=rng).as_matrix()
        stars = seen(camera, R, rng, 0.02)
        free = StarTracker(fov_deg=12.0).identified(stars, 1024, 768).identification
        rigid = refine(free, stars, NOMINAL, sky(), LensPrior(0.002, 1e-6, 1e-9)).identification
        truth = Rotation.from_matrix(anchored(camera, R)).inv()
        errors.append([np.linalg.norm((Rotation.from_quat(i.q_SN) * truth).as_rotvec()) for i in (free, rigid)])
    free, rigid = np.median(errors, axis=0)
    assert rigid > 3.0 * free


def test_wrong_stars_do_not_pull_and_missing_ones_are_found():
    rng = np.random.default_rng(2)
    R = Rotation.random(rng=rng).as_matrix()
    stars = seen(NOMINAL, R, rng, 0.02, 60)
    first = StarTracker(fov_deg=12.0).identified(stars, 1024, 768)
    few = first.identification
    keep = np.arange(0, len(few.stars), 3)
    wrong = few.stars[keep].copy()
    wrong[0] = few.stars[keep[1] + 1]  # another star's place: tens of pixels off
    start = replace(few, stars=wrong, hip=few.hip[keep], detections=few.detections[keep])
    again = refine(start, stars, NOMINAL, sky(), LensPrior.uncalibrated(NOMINAL, 0.002)).identification
    assert len(again.stars) >= len(few.stars) - 1
    e = (Rotation.from_quat(again.q_SN) * Rotation.from_matrix(R).inv()).as_rotvec()
    assert np.linalg.norm(e[:2]) * 206265 < 3.0


def test_a_calibrated_camera_keeps_its_centre_and_its_smaller_sigma():
    rng = np.random.default_rng(9)
    camera = Camera(1024, 768, NOMINAL.focal_px, (530.0, 370.0), 1.0, (0.3, 0, 0, 0, 0))
    squares, tighter = [], []
    for _ in range(30):
        R = Rotation.random(rng=rng).as_matrix()
        stars = seen(camera, R, rng, 0.1, 12)
        found = StarTracker(Calibrated(camera, 0.05, 0.2, 1e-4)).identified(stars, 1024, 768)
        i = found.identification
        e = (Rotation.from_quat(i.q_SN) * Rotation.from_matrix(R).inv()).as_rotvec()
        squares.append(e @ np.linalg.solve(i.covariance, e))
        open_ = refine(i, stars, camera, sky(), LensPrior.uncalibrated(camera, 0.002)).identification
        tighter.append(np.trace(i.covariance) / np.trace(open_.covariance))
    assert 1.7 < np.mean(squares) < 4.5  # chi-square of 3, 30 times: 3 +- 0.45
    assert np.median(tighter) < 1.0


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-0.02, 0.02), st.floats(-30, 30), st.floats(-30, 30), st.floats(-0.5, 0.5), st.floats(-0.01, 0.01),
    st.floats(0.5, 2.0), st.integers(0, 99),
)  # fmt: skip
def test_the_derivatives_are_those_of_the_prediction(ln_f, ex, ey, k1, p1, aspect, seed):
    rng = np.random.default_rng(seed)
    camera = Camera(800, 600, 2000.0, (410.0, 290.0), aspect, (-0.1, 0.05, 1e-3, -2e-3, 0.0))
    it = Lens.of(camera, LensPrior.uncalibrated(camera, 0.01))
    R = Rotation.random(rng=rng).as_matrix()
    d = camera.directions(rng.uniform(0, 600, (5, 2))) @ R
    p = np.array([ln_f, ex, ey, k1, p1, -0.7 * p1])
    _, J = it.predict(R, p, d)
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-6
        both = [
            it.predict(Rotation.from_rotvec(s * step[:3]).as_matrix() @ R, p + s * step[3:], d)[0] for s in (1.0, -1.0)
        ]
        numeric = (both[0] - both[1]) / 2e-6
        # Left out is what is of second order in the centre's offset over the focal length, a percent.
        assert np.allclose(J[:, :, k], numeric, rtol=0.03, atol=0.02 * np.abs(J[:, :, k]).max() + 0.01)
