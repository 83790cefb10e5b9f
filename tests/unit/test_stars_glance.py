"""The first look: what it says is what the whole search says, and on lists without a sky it says nothing."""

import numpy as np
import pytest

from helmstar.attitude import quaternion_of_matrix
from helmstar.stars import Pinhole, default_sky, identify
from helmstar.stars.glance import follow, glance, quaternion_of
from helmstar.stars.identify import matrix_of_quaternion
from helmstar.stars.pinhole import image_pixels
from helmstar.stars.verify import turn

CAMERA = Pinhole.of_field(np.radians(12.0), (1024, 768))
SIGMA = 0.1


def _random_attitude(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def _seen(rng: np.random.Generator, q: np.ndarray, false: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, fluxes and covariances of a sky's 30 brightest stars and of false ones of like brightness, brightest first."""
    sky = default_sky()
    v = sky.directions @ matrix_of_quaternion(q).T
    xy = image_pixels(CAMERA, v)
    on = np.flatnonzero((xy > 0).all(axis=1) & (xy[:, 0] < 1024) & (xy[:, 1] < 768))[:30]
    places = np.concatenate([xy[on] + SIGMA * rng.normal(size=(len(on), 2)), rng.uniform(0, [1024, 768], (false, 2))])
    V = sky.magnitude[on] + 0.1 * rng.normal(size=len(on))
    V = np.concatenate([V, rng.uniform(V.min(), V.max(), false)])
    order = np.argsort(V)
    n = len(order)
    return places[order], 10.0 ** (-0.4 * V[order]), np.broadcast_to(SIGMA**2 * np.eye(2), (n, 2, 2))


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return 2.0 * float(np.linalg.norm(a - np.sign(a @ b) * b))


def test_plain_skies_are_solved_and_as_the_whole_search_solves_them() -> None:
    rng = np.random.default_rng(1)
    solved = 0
    for _ in range(30):
        q = _random_attitude(rng)
        xy, flux, C = _seen(rng, q)
        found = glance(xy, flux, C, CAMERA, default_sky(), 0.0005, 1e-6)
        if found is None:
            continue
        solved += 1
        # 16 stars of 0.1 px: 1e-5 rad about x and y, ten times that about the boresight; four sigma.
        assert _angle(found.q_SN, q) < 4e-4
        whole = identify(xy, CAMERA, flux=flux, sigma_px=C, focal_sigma=0.0005)
        assert set(found.hip) <= set(whole.hip)
        assert found.probability_false < 1e-7
    assert solved >= 27


def test_what_is_false_is_left_to_the_whole_search() -> None:
    """Lists without a sky, as bright and as many."""
    rng = np.random.default_rng(2)
    for _ in range(150):
        xy = rng.uniform(0, [1024, 768], (30, 2))
        flux = np.sort(10.0 ** rng.uniform(0, 2, 30))[::-1]
        C = np.broadcast_to(SIGMA**2 * np.eye(2), (30, 2, 2))
        assert glance(xy, flux, C, CAMERA, default_sky(), 0.0005, 1e-6) is None


def test_a_prior_is_followed_when_right_and_not_when_wrong() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = _random_attitude(rng)
        xy, flux, C = _seen(rng, q, false=5)
        for off, right in ((1e-4 * rng.normal(size=3), True), (np.array([0.05, -0.04, 0.2]), False)):
            prior = quaternion_of(turn(off, matrix_of_quaternion(q)))
            found = follow(xy, flux, C, CAMERA, default_sky(), 0.0005, 1e-6, prior, 1e-4)
            assert (found is not None) == right
            if found is not None:
                assert _angle(found.q_SN, q) < 4e-4


@pytest.mark.parametrize("seed", range(5))
def test_quaternion_in_plain_numbers(seed: int) -> None:
    R = matrix_of_quaternion(_random_attitude(np.random.default_rng(seed)))
    np.testing.assert_allclose(quaternion_of(R), quaternion_of_matrix(R), atol=1e-14)
