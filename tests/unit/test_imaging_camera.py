"""The camera: both ways through the lens, the frame S, cam.toml, and refusals that say why."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helmstar.errors import ConfigurationError
from helmstar.imaging import Camera, read_camera, write_camera

BARREL = (-0.25, 0.08, 1e-3, -5e-4, -0.01)


def grid(camera: Camera, n: int = 15) -> np.ndarray:
    x, y = np.linspace(-0.5, camera.width - 0.5, n), np.linspace(-0.5, camera.height - 0.5, n)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def test_axes_of_s_and_the_pixel_grid():
    camera = Camera.from_fov(20.0, 1000, 800, aspect=2.0)
    assert camera.centre_px == (499.5, 399.5) == camera.geometric_centre_px
    assert np.allclose(camera.directions(np.array([499.5, 399.5])), [0, 0, 1])
    right, down = camera.directions(np.array([[600.0, 399.5], [499.5, 500.0]]))
    assert right[0] > 0
    assert down[1] > 0
    assert max(abs(right[1]), abs(down[0])) < 1e-15
    # a row is twice as tall as a column is wide
    assert down[1] / down[2] == pytest.approx(2.0 * 100.5 / camera.focal_px)
    assert right[0] / right[2] == pytest.approx(100.5 / camera.focal_px)


def test_the_field_goes_from_edge_to_edge():
    camera = Camera.from_fov(11.4227, 1024, 768)
    assert np.degrees(camera.fov) == pytest.approx(11.4227, abs=1e-10)
    left, right = camera.directions(np.array([[-0.5, 383.5], [1023.5, 383.5]]))
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(11.4227, abs=1e-6)


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0, 0), BARREL, (0.3, 0.1, -2e-3, 1e-3, 0.05)])
@pytest.mark.parametrize("fov_deg", [4.0, 27.0, 70.0])
def test_through_the_lens_and_back(distortion, fov_deg):
    camera = Camera(1280, 960, Camera.from_fov(fov_deg, 1280, 960).focal_px, (630.0, 490.0), 1.1, distortion)
    xy = grid(camera)
    d = camera.directions(xy)
    assert np.abs(np.linalg.norm(d, axis=1) - 1).max() < 1e-14
    assert np.abs(camera.pixels(d) - xy).max() < 1e-8


@given(
    distortion=st.tuples(*(st.floats(-b, b) for b in (0.6, 0.3, 0.01, 0.01, 0.1))), kept=st.tuples(*[st.booleans()] * 5),
    focal=st.floats(600.0, 3000.0), u=st.floats(-0.5, 999.5), v=st.floats(-0.5, 799.5),
)  # fmt: skip
def test_one_pixel_in_plain_numbers_is_as_in_arrays(distortion, kept, focal, u, v):
    camera = object.__new__(Camera)  # also one that would be refused
    told: dict[str, Any] = {"width": 1000, "height": 800, "focal_px": focal, "centre_px": (480.0, 410.0), "aspect": 1.2}
    told["distortion"] = tuple(d if k else 0.0 for d, k in zip(distortion, kept))
    for name, value in told.items():
        object.__setattr__(camera, name, value)
    d = camera.directions(np.array([u, v]))
    x, y = camera.plane(u, v)
    assert np.isnan(x) == np.isnan(d[0])
    if not np.isnan(x):
        # Newton's last step is below 1e-15; near a fold the inverse carries that a thousandfold.
        assert [x, y] == pytest.approx(d[:2] / d[2], abs=1e-12)
    corners = np.array([[-0.5, -0.5], [999.5, -0.5], [-0.5, 799.5], [999.5, 799.5]])
    if np.isfinite(camera.directions(corners)).all():
        assert Camera(**told).plane(u, v) == (x, y)
    elif any(told["distortion"][2:4]):  # a radial fold is known beforehand, where Newton's method tires
        with pytest.raises(ValueError, match="folds"):
            Camera(**told)


def test_the_lens_is_opencv_s_formula():
    """Written out for one point, independently of the class: k1, k2, p1, p2, k3 in this order."""
    k1, k2, p1, p2, k3 = BARREL
    f, cx, cy, a = 900.0, 500.0, 410.0, 1.25
    x, y = 0.3, -0.2
    r2 = 0.13
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = f * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx
    v = f / a * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy
    camera = Camera(1000, 800, f, (cx, cy), a, BARREL)
    assert camera.pixels(np.array([0.6, -0.4, 2.0])) == pytest.approx([u, v], abs=1e-10)


def test_what_no_lens_sees_is_nan():
    camera = Camera(1280, 960, 1200.0, distortion=(-0.25, 0.0, 0.0, 0.0, 0.0))
    behind = camera.pixels(np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0]]))
    assert np.isnan(behind).all()
    # 1 + 3 k1 r^2 = 0 at r = 1.15: farther out the image of the sky would come back into the frame
    assert np.isnan(camera.pixels(np.array([1.3, 0.0, 1.0]))).all()
    assert np.isfinite(camera.pixels(np.array([1.1, 0.0, 1.0]))).all()


def test_covariance_on_the_tangent_plane():
    camera = Camera(1280, 960, 1500.0, (600.0, 470.0), 1.3, BARREL)
    at = np.array([[100.0, 800.0], [640.0, 480.0]])
    covariance = np.array([[[0.04, 0.01], [0.01, 0.09]]] * 2)
    h = 1e-4
    for k in range(2):
        J = []
        for step in np.eye(2) * h:
            d = camera.directions(np.stack([at[k] + step, at[k] - step]))
            plane = d[:, :2] / d[:, 2:]
            J.append((plane[0] - plane[1]) / (2 * h))
        J = np.array(J).T
        assert camera.pixel_covariance(at, covariance)[k] == pytest.approx(J @ covariance[k] @ J.T, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "width"),
        ({"height": 10.5}, "height"),
        ({"focal_px": -1.0}, "focal_px"),
        ({"focal_px": np.nan}, "focal_px"),
        ({"aspect": 0.0}, "aspect"),
        ({"centre_px": (1.0, np.inf)}, "centre_px"),
        ({"distortion": (0.1, 0.0)}, "distortion"),
        ({"distortion": (-30.0, 0.0, 0.0, 0.0, 0.0)}, "folds"),
    ],
)
def test_what_is_no_camera(change, words):
    with pytest.raises(ValueError, match=words):
        Camera(**{"width": 1000, "height": 800, "focal_px": 2000.0} | change)


@pytest.mark.parametrize("fov", [0.0, 180.0, np.nan, -3.0])
def test_what_is_no_field(fov):
    with pytest.raises(ValueError, match="field of view"):
        Camera.from_fov(fov, 100, 100)


finite = st.floats(-1e-3, 1e-3)


@given(st.floats(100, 1e5), finite, finite, finite)
def test_toml_gives_every_bit_back(tmp_path_factory, focal, k1, p1, p2):
    path = tmp_path_factory.mktemp("cam") / "cam.toml"
    camera = Camera(640, 480, focal, (300.1, 240.7), 1.93, (k1, 0.0, p1, p2, 0.0))
    write_camera(path, camera)
    assert read_camera(path) == camera


def test_toml_by_field_of_view(tmp_path):
    path = tmp_path / "cam.toml"
    path.write_text("[camera]\nwidth = 1024\nheight = 768\nfov_deg = 11.4\n")
    assert read_camera(path) == Camera.from_fov(11.4, 1024, 768)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no table"),
        ("camera = 3", "no table"),
        ("[camera", "not a TOML"),
        ("[camera]\nheight = 5\nfov_deg = 3", "lacks width"),
        ("[camera]\nwidth = 5\nheight = 5\nfov = 3", "unknown key 'fov'"),
        ("[camera]\nwidth = 5\nheight = 5", "focal_px or fov_deg"),
        ("[camera]\nwidth = 5\nheight = 5\nfov_deg = 3\nfocal_px = 3", "one of the two"),
        ("[camera]\nwidth = 'a'\nheight = 5\nfov_deg = 3", "width must hold numbers"),
        ("[camera]\nwidth = 5\nheight = 5\nfov_deg = 300", "field of view"),
        ("[camera]\nwidth = 5\nheight = 5\nfov_deg = 3\ndistortion = [1]", "distortion must be 5"),
        ("[camera]\nwidth = 5\nheight = 5\nfov_deg = 3\ncentre_px = [true, 1]", "centre_px must hold numbers"),
        ("[camera]\nwidth = inf\nheight = 5\nfov_deg = 3", "camera"),
        ("[camera]\nwidth = nan\nheight = 5\nfocal_px = 3", "camera"),
    ],
)
def test_toml_that_is_no_camera(tmp_path, text, words):
    path = tmp_path / "cam.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=words) as e:
        read_camera(path)
    assert "cam.toml" in str(e.value)


def test_toml_that_is_not_there(tmp_path):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigurationError, match="give a camera file"):
            read_camera(path)
    (tmp_path / "cam.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match="not a TOML"):
        read_camera(tmp_path / "cam.toml")
