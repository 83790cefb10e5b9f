"""Answers of other solvers are judged rightly: frames, errors, covariances and verdicts. No other solver is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
MODULES = ("problem", "real_frames", "rivals_worker", "rivals")


@pytest.fixture(scope="module")
def rivals():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        import rivals

        yield rivals
        for name in MODULES:
            sys.modules.pop(name, None)


def parameters(R: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """By definition: angle of x of S from east to north, and the boresight's offsets, for R near the attitude of the axes."""
    return np.array([np.arctan2(R[0] @ north, R[0] @ east), R[2] @ east, R[2] @ north])


@given(seed=st.integers(0, 10**6))
def test_covariance_goes_from_the_tangent_plane_into_the_camera(rivals, seed):
    rng = np.random.default_rng(seed)
    R_true = Rotation.random(rng=rng).as_matrix()
    z = R_true[2]
    east = np.array([-z[1], z[0], 0.0]) / np.hypot(z[0], z[1])
    north = np.cross(z, east)
    step = 1e-6  # differences are good to the step, relative to 1
    J = np.empty((3, 3))
    for k in range(3):
        moved = Rotation.from_rotvec(step * np.eye(3)[k]).as_matrix() @ R_true
        d = parameters(moved, east, north) - parameters(R_true, east, north)
        d[0] = (d[0] + np.pi) % (2.0 * np.pi) - np.pi
        J[:, k] = d / step
    A = rng.normal(size=(3, 3))
    C = A @ A.T
    assert rivals.in_camera(R_true, J @ C @ J.T) == pytest.approx(C, abs=1e-4 * np.abs(C).max())


@given(seed=st.integers(0, 10**6), angle=st.floats(0.0, 3.1))
def test_error_is_the_rotation_vector(rivals, seed, angle):
    rng = np.random.default_rng(seed)
    R_true = Rotation.random(rng=rng).as_matrix()
    axis = rng.normal(size=3)
    e = angle * axis / np.linalg.norm(axis)
    R = Rotation.from_rotvec(e).as_matrix() @ R_true
    # The angle of a rotation by nearly pi hangs on a sine that is nearly 0: 1e-16 over 0.04.
    assert rivals.error_S(R, R_true) == pytest.approx(e, abs=1e-12)


def test_verdicts(rivals):
    R_true = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    arcsec = np.pi / 180.0 / 3600.0

    def of(e_arcsec: tuple[float, float, float]) -> dict:
        R = Rotation.from_rotvec(arcsec * np.array(e_arcsec)).as_matrix() @ R_true
        answer = {"solved": True, "ms": 1.0, "R": R, "covariance_S": np.diag([3.0, 5.0, 60.0]) ** 2 * arcsec**2}
        return rivals.judged(answer, R_true, np.diag([4.0, 12.0, 80.0]) ** 2 * arcsec**2)

    good = of((10.0, 26.0, 200.0))
    assert good["verdict"] == "right"
    assert good["arcsec"] == pytest.approx(np.hypot(10.0, 26.0), rel=1e-6)
    assert good["nees"] == pytest.approx(4.0 + 4.0 + 4.0, rel=1e-6)  # each axis at 2 sigma of both
    assert of((299.0, 0.0, 0.0))["verdict"] == "right"
    assert of((301.0, 0.0, 0.0))["verdict"] == "false"
    assert of((0.0, 0.0, 1801.0))["verdict"] == "false"
    assert of((180.0 * 3600.0, 0.0, 0.0))["verdict"] == "false"
    assert rivals.judged({"solved": False, "ms": 2.0}, R_true)["verdict"] == "unsolved"
    assert rivals.judged({"solved": True, "ms": 2.0, "R": R_true}, None)["verdict"] == "false"
    rows = [good, of((301.0, 0.0, 0.0)), rivals.judged({"solved": False, "ms": 9.0}, R_true)]
    s = rivals.summary(rows)
    assert (s["of"], s["right"], s["false"], s["ms_max"]) == (3, 1, 1, 9.0)
    assert s["arcsec_max"] == pytest.approx(np.hypot(10.0, 26.0), rel=1e-6)  # of the right ones only
    assert rivals.summary(rows[2:])["arcsec_median"] is None


def test_spots_lie_where_they_are_said(rivals):
    """A centroid over a spot's own window gives its place; pixel edges are whole numbers."""
    import rivals_worker

    stars = np.array([[20.3, 30.7, 100.0], [50.0, 12.5, 1.0]])
    picture = rivals_worker.spots(stars, (80, 60)).astype(float)
    assert picture.shape == (60, 80)
    for x, y, _ in stars:
        rows, columns = np.mgrid[int(y) - 4 : int(y) + 5, int(x) - 4 : int(x) + 5]
        light = picture[rows, columns]
        # Rounding to counts of a peak of 40 moves the centre by about 0.02 px.
        assert (columns * light).sum() / light.sum() + 0.5 == pytest.approx(x, abs=0.05)
        assert (rows * light).sum() / light.sum() + 0.5 == pytest.approx(y, abs=0.05)


def test_helmstar_answers_as_the_others_do(rivals):
    """One list and one empty list through helmstar: right, and refused."""
    helmstar = rivals.Helmstar()
    s = rivals.scenes_of(20.0, 1, {})[0]
    row = rivals.judged(helmstar.listed(s), s["R"])
    assert row["verdict"] == "right"
    assert row["arcsec"] < 60.0  # 0.3 px of 70 arcsec over 30 stars: 4 arcsec a sigma
    table = rivals.markdown({"a part": {"helmstar": rivals.summary([row])}})
    assert "| helmstar | 1 | 0 |" in table
    few = s | {"xy": s["xy"][:3], "flux": s["flux"][:3], "R": None}
    assert rivals.judged(helmstar.listed(few), None)["verdict"] == "unsolved"
