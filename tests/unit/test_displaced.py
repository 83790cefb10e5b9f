"""A smooth displacement is told from noise and from the lens: attitudes come nearer, and covariances hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from helmstar.imaging import Camera, Centroids
from helmstar.sensors.displaced import _kriged, displaced
from helmstar.sensors.lens import Lens, LensPrior
from helmstar.sensors.refine import Refined, refine
from helmstar.stars.doubt import roughened
from helmstar.stars.identify import Identification, default_sky

CAMERA = Camera.from_fov(16.0, 1024, 768)
NOISE = 0.1


def wave(xy: np.ndarray, px: float, phase: float, camera: Camera = CAMERA) -> np.ndarray:
    """Of about one period over the image, `px` pixel widths root mean square per axis."""
    square = np.array([1.0, camera.aspect])
    u, v = ((xy - [camera.cx, camera.cy]) * square / camera.width).T
    return (
        px
        * np.sqrt(2.0)
        * np.stack([np.sin(6.0 * v + 2.0 * u + phase), np.cos(5.0 * u + 2.0 * phase)], axis=1)
        / square
    )


def frame(seed: int, px: float, stars: int = 60, camera: Camera = CAMERA) -> tuple[Refined, Centroids, np.ndarray]:
    """A rough fit, the centroids it is of, and R (3, 3) whose z axis is what the middle of the image truly sees."""
    rng = np.random.default_rng(seed)
    sky, R, phase = default_sky(), Rotation.random(rng=rng).as_matrix(), rng.uniform(0.0, 6.0)
    ahead = np.flatnonzero(sky.directions @ R[2] > 0.95)
    xy = camera.pixels(sky.directions[ahead] @ R.T)
    inside = np.flatnonzero(camera.inside(xy))[:stars]
    at, xy = ahead[inside], xy[inside]
    seen = xy + wave(xy, px, phase, camera) + rng.normal(0.0, NOISE, xy.shape) / [1.0, camera.aspect]
    n, one = len(at), np.ones(len(at))
    C = np.tile(NOISE**2 * np.diag([1.0, camera.aspect**-2]), (n, 1, 1))
    centroids = Centroids(seen[:, 0], seen[:, 1], 10 ** (-0.4 * sky.magnitude[at]), C, one, one < 0, one, 50 * one)
    q = Rotation.from_matrix(R).as_quat()
    found = Identification(
        "solved", q, q, np.eye(3), 0.0, 0.0, 0.0, np.arange(n), at, sky.catalog.hip[at], np.zeros((n, 2)), 0.0,
        camera.focal_px, 0.0, 0.0, 0.0, 0,
    )  # fmt: skip
    lens = LensPrior.rough(camera, 0.005)
    rough = refine(found, replace(centroids, covariance_px=roughened(C, n, max(px, 0.1))), camera, sky, lens)
    # The middle sees what lies where the wave brings it there.
    middle = np.array([[camera.cx, camera.cy]])
    place = middle
    for _ in range(50):
        place = middle - wave(place, px, phase, camera)
    d = camera.directions(place)[0]
    turn = Rotation.from_rotvec(np.cross(d, [0.0, 0.0, 1.0]))  # a small angle: its sine is the angle to 1e-8
    return rough, centroids, turn.as_matrix() @ R


def off(fit: Refined, R: np.ndarray) -> np.ndarray:
    """Error of the direction (2,), about x and y of S, rad."""
    return (Rotation.from_quat(fit.identification.q_SN) * Rotation.from_matrix(R).inv()).as_rotvec()[:2]


def solved(fit: Refined, centroids: Centroids, camera: Camera = CAMERA) -> Refined:
    return displaced(fit, centroids, camera, default_sky(), LensPrior.rough(camera, 0.005))


TALL = Camera(1024, 450, CAMERA.focal_px, (590.0, 190.0), 1.7)


@pytest.mark.parametrize(("px", "camera"), [(0.5, CAMERA), (3.0, CAMERA), (3.0, TALL)], ids=["0.5", "3", "tall pixels"])
def test_attitudes_come_nearer_and_covariances_hold(px, camera):
    before, after, squares = [], [], []
    for seed in range(24):
        rough, centroids, R = frame(seed, px, camera=camera)
        better = solved(rough, centroids, camera)
        e = off(better, R)
        before.append(float(off(rough, R) @ off(rough, R)))
        after.append(float(e @ e))
        squares.append(float(e @ np.linalg.solve(better.identification.covariance[:2, :2], e)))
    assert np.median(after) < 0.06 * np.median(before)
    # Chi-square of 2, 24 times: 2 +- 0.4. The wave is smoother than the field that is believed, so less is let pass.
    assert 0.3 < np.mean(squares) < 3.2


def test_without_a_displacement_nothing_is_lost():
    """Noise alone: the error stays that of the centroids, though the covariance keeps some doubt."""
    before, after, squares = [], [], []
    for seed in range(16):
        rough, centroids, R = frame(seed, 0.0)
        better = solved(rough, centroids)
        e = off(better, R)
        before.append(float(off(rough, R) @ off(rough, R)))
        after.append(float(e @ e))
        squares.append(float(e @ np.linalg.solve(better.identification.covariance[:2, :2], e)))
    assert np.mean(after) < 2.0 * np.mean(before) + (0.02 / CAMERA.focal_px) ** 2
    assert np.mean(squares) < 3.0  # chi-square of 2, 16 times: 2 +- 0.5


def test_few_stars_keep_the_doubt():
    rough, centroids, _ = frame(3, 3.0, stars=6)
    many = solved(*frame(3, 3.0)[:2]).identification.covariance
    few = solved(rough, centroids).identification.covariance
    assert few[0, 0] > 4.0 * many[0, 0]
    two = replace(rough, identification=replace(rough.identification, stars=rough.identification.stars[:2]))
    kept = solved(two, centroids).identification
    assert np.array_equal(kept.q_SN, two.identification.q_SN)
    assert kept.covariance[0, 0] > two.identification.covariance[0, 0] + (1.0 / CAMERA.focal_px) ** 2


def test_a_mounting_is_kept():
    rough, centroids, _ = frame(5, 1.0)
    i, mounting = rough.identification, Rotation.random(rng=np.random.default_rng(1))
    q_BN = (mounting * Rotation.from_quat(i.q_SN)).as_quat()
    better = solved(replace(rough, identification=replace(i, q_BN=q_BN)), centroids).identification
    back = Rotation.from_quat(better.q_BN) * Rotation.from_quat(better.q_SN).inv() * mounting.inv()
    assert back.magnitude() < 1e-12


@pytest.mark.parametrize("camera", [CAMERA, TALL], ids=["square", "tall pixels"])
def test_what_is_seen_at_the_centre_is_so_for_lenses_far_out(camera):
    lens = Lens.of(camera, LensPrior.rough(camera, 0.005))
    rng = np.random.default_rng(4)
    for _ in range(10):
        p = rng.normal(size=6) * [0.1, *1.5 / np.sqrt(lens.known[4:])]
        x, y = lens.seen_at_centre(p)
        seen = lens.predict(np.eye(3), p, np.array([[x, y, 1.0]]))[0][0]
        # Newton's method to 1e-13, times a focal length of some thousand pixels.
        assert np.allclose(seen, [camera.cx, camera.cy], atol=1e-8)


def test_kriging_is_the_conditional_of_a_joint_gaussian():
    """An independent way: residuals, parameters and the field in the middle as one Gaussian vector, conditioned."""
    rng = np.random.default_rng(2)
    n, amplitude = 12, 0.7
    place = rng.uniform(-400.0, 400.0, (n, 2))
    shape = np.exp(-0.5 * np.square(place[:, None] - place).sum(axis=2) / 300.0**2)
    middle = amplitude**2 * np.exp(-0.5 * np.square(place).sum(axis=1) / 300.0**2)
    V = amplitude**2 * shape + np.diag(rng.uniform(0.05, 0.2, n))
    J, known, y = rng.normal(size=(n, 2, 9)), rng.uniform(0.3, 3.0, 9), rng.normal(size=(n, 2))
    start = rng.normal(size=9)  # where the priors' mean lies
    log, mean, covariance = _kriged(V, middle, amplitude, y, J, known, known * start)
    A = np.concatenate([J[:, 0], J[:, 1]])
    P0, zero = np.diag(1.0 / known), np.zeros((n, n))
    W = np.block([[V, zero], [zero, V]]) + A @ P0 @ A.T
    m = np.zeros(n)
    cross = np.concatenate([P0 @ A.T, [np.concatenate([middle, m]), np.concatenate([m, middle])]])
    whole = np.zeros((11, 11))
    whole[:9, :9], whole[9, 9], whole[10, 10] = P0, amplitude**2, amplitude**2
    r = y.T.ravel() - A @ start
    expected = np.concatenate([start, [0.0, 0.0]]) + cross @ np.linalg.solve(W, r)
    # Double precision and condition numbers below 1e4.
    assert np.allclose(mean, expected, atol=1e-9)
    assert np.allclose(covariance, whole - cross @ np.linalg.solve(W, cross.T), atol=1e-9)
    # The same likelihood up to what does not depend on V: differences are compared.
    other = 2.0 * V
    log2, _, _ = _kriged(other, 2.0 * middle, np.sqrt(2.0) * amplitude, y, J, known, known * start)
    W2 = np.block([[other, zero], [zero, other]]) + A @ P0 @ A.T
    exact = [
        multivariate_normal(A @ start, w).logpdf(y.T.ravel())  # pyright: ignore[reportArgumentType]  # scipy's stub knows numbers only
        for w in (W, W2)
    ]
    assert log - log2 == pytest.approx(exact[0] - exact[1], abs=1e-8)
