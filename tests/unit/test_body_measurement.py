"""The paper's chain by its numbers: K with cross terms, rotations and angles, Jacobians by automatic differentiation."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.backend import jnp
from helmstar.imaging.body.measurement import (
    PixelMap,
    attitude_angles,
    camera_rotation,
    paper_map,
    pixel_line_of,
    rotation_of_angles,
)

CROSSED = PixelMap(200.0, np.array([[83.8, 0.4, 0.02], [-0.3, 83.1, -0.05]]), np.array([511.5, 500.0]))
R_CB = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def test_the_papers_camera():
    # 200 mm times 83.8 px/mm is 16760 px per unit tangent; 1024 px are then 3.5 deg.
    camera = paper_map().camera(1024, 1024)
    assert camera.focal_px == pytest.approx(16760.0)
    assert np.degrees(camera.fov) == pytest.approx(3.5, abs=0.01)
    directions = np.array([[0.01, -0.02, 1.0], [0.0, 0.0, 3.0]])
    assert paper_map().pixel_line(directions) == pytest.approx(camera.pixels(directions))
    with pytest.raises(ValueError, match="no cross terms"):
        CROSSED.camera(1024, 1024)


@given(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0))
def test_the_inverse_of_K_undoes_its_cross_terms(x, y):
    r = np.array([x, y, 200.0])
    assert CROSSED.plane(CROSSED.pixel_line(r)) == pytest.approx([x, y], abs=1e-12)


def test_the_cross_term_is_in_line_and_pixel():
    r = np.array([2.0, 3.0, 200.0])
    assert CROSSED.pixel_line(r) == pytest.approx(
        [83.8 * 2 + 0.4 * 3 + 0.02 * 6 + 511.5, -0.3 * 2 + 83.1 * 3 - 0.05 * 6 + 500.0]
    )


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_angles_and_rotation_undo_each_other(a, d, p):
    R = rotation_of_angles(np.array([a, d, p]))
    assert pytest.approx(np.eye(3), abs=1e-14) == R @ R.T
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert pytest.approx(Rotation.from_euler("ZYX", [a, -d, p]).as_matrix().T, abs=1e-12) == R
    assert attitude_angles(R) == pytest.approx([a, d, p], abs=1e-12)


def test_T_IC_is_T_IB_T_BC():
    R_BI = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    T_IB, T_BC = R_BI.T, R_CB.T
    assert pytest.approx(T_IB @ T_BC) == camera_rotation(R_BI, R_CB).T


@pytest.mark.parametrize("pixel_map", [paper_map(), CROSSED])
def test_jacobians_by_automatic_differentiation_are_the_numerical_ones(pixel_map):
    position = np.array([-7200.0, 3.0, 150.0])
    angles = np.array([0.001, 0.003, -0.001])

    def measure(v):
        return pixel_line_of(pixel_map, v[:3] * 1e3, rotation_of_angles(v[3:]), jnp.asarray(R_CB))

    v = np.concatenate([position, angles])
    exact = np.asarray(jax.jacfwd(measure)(jnp.asarray(v)))
    h = np.array([1e-2] * 3 + [1e-5] * 3)
    plus = [
        pixel_line_of(pixel_map, (v + e)[:3] * 1e3, rotation_of_angles((v + e)[3:]), R_CB)
        - pixel_line_of(pixel_map, (v - e)[:3] * 1e3, rotation_of_angles((v - e)[3:]), R_CB)
        for e in np.diag(h)
    ]
    numerical = np.stack(plus, axis=1) / (2.0 * h)
    # Within 1e-6 of the largest of each column, the bar of the paper's digest.
    scale = np.abs(exact).max(axis=0)
    assert np.abs(exact - numerical).max(axis=0) / scale == pytest.approx(np.zeros(6), abs=1e-6)
