"""Rendered bodies: moments against quadrature, meshes against ellipsoids, shadows by geometry, stars, noise, and bad arguments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from helmstar.errors import DataError
from helmstar.imaging import Camera
from helmstar.imaging.body import (
    Ellipsoid,
    Hapke,
    Lambert,
    LommelSeeliger,
    Mesh,
    Stars,
    render_body,
    render_window,
    sphere,
)
from helmstar.imaging.body.mesh_files import read_mesh
from helmstar.imaging.body.phase import nodes
from helmstar.imaging.body.raster import see
from helmstar.imaging.body.raycast import Grid
from helmstar.imaging.render import Exposure

CAMERA = Camera.from_fov(3.5, 512, 512)
RADIUS = 2e3


def distance(diameter_px: float) -> float:
    return 2.0 * RADIUS * CAMERA.focal_px / diameter_px


def sun(alpha: float, turn: float = 0.0) -> np.ndarray:
    return np.array([np.sin(alpha) * np.cos(turn), np.sin(alpha) * np.sin(turn), -np.cos(alpha)])


def round_mesh(axes: tuple[float, float, float], n: int = 4000) -> Mesh:
    """Points of a spiral on an ellipsoid with the faces of their hull, outwards."""
    k = np.arange(n) + 0.5
    polar, east = np.arccos(1.0 - 2.0 * k / n), np.pi * (1.0 + 5.0**0.5) * k
    p = np.stack([np.cos(east) * np.sin(polar), np.sin(east) * np.sin(polar), np.cos(polar)], axis=1)
    f = ConvexHull(p).simplices
    inwards = np.sum(np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]) * p[f[:, 0]], axis=1) < 0.0
    f[inwards] = f[inwards][:, ::-1]
    return Mesh(p * axes, f)


@pytest.mark.parametrize("diameter", [0.3, 1.0, 3.0, 12.0, 50.0, 200.0])
@pytest.mark.parametrize("degrees", [10.0, 60.0, 100.0])
def test_moments_without_noise_are_those_of_the_surface(diameter, degrees):
    rng = np.random.default_rng(int(diameter * 10 + degrees))
    shape = Ellipsoid((1.2 * RADIUS, RADIUS, 0.85 * RADIUS))
    R_TC, s = Rotation.random(rng=rng).as_matrix(), sun(np.radians(degrees), rng.uniform(0.0, 6.0))
    r = distance(diameter) * CAMERA.directions(rng.uniform(200.0, 300.0, 2))
    for law in (Lambert(), LommelSeeliger(), Hapke()):
        _, truth = render_window(CAMERA, shape, r, s, R_TC=R_TC, law=law, signal_e=1.0)
        flux, centroid = nodes(CAMERA, shape, r, R_TC, s, 96).moment(law)
        assert truth.centroid_px == pytest.approx(centroid, abs=1e-3)  # the bar: moments right to 1e-3 px
        assert truth.electrons == pytest.approx(flux, rel=5e-4)  # light cut at 5 sigma, and midpoints at the terminator
        assert truth.centre_px == pytest.approx(CAMERA.pixels(r))


def test_crescents_are_drawn_too():
    for diameter in (12.0, 50.0, 200.0):
        r = np.array([0.0, 0.0, distance(diameter)])
        _, truth = render_window(CAMERA, sphere(RADIUS), r, sun(np.radians(150.0)), signal_e=1.0)
        flux, centroid = nodes(CAMERA, sphere(RADIUS), r, np.eye(3), sun(np.radians(150.0)), 96).moment(Lambert())
        assert truth.centroid_px == pytest.approx(
            centroid, abs=2e-3
        )  # a crescent 0.07 diameters wide: half a pixel to 13
        assert truth.electrons == pytest.approx(flux, rel=1e-3)


def test_a_mesh_of_an_ellipsoid_is_that_ellipsoid():
    axes = (1.2 * RADIUS, RADIUS, 0.85 * RADIUS)
    mesh, shape = round_mesh(axes), Ellipsoid(axes)
    R_TC = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    for diameter in (3.0, 80.0):
        r = np.array([0.0, 0.0, distance(diameter)])
        images = [
            render_window(CAMERA, body, r, sun(1.0, 0.4), (150, 150, 212, 212), R_TC=R_TC, signal_e=1.0)[1]
            for body in (mesh, shape)
        ]
        # The hull's faces lie inside by (edge/radius)^2/8 = 4e-4 of the radius and its volume lacks 1.5e-3.
        assert images[0].electrons == pytest.approx(images[1].electrons, rel=3e-3)
        assert images[0].centroid_px == pytest.approx(images[1].centroid_px, abs=3e-4 * diameter + 1e-3)


def box_mesh(low: list[float], high: list[float]) -> tuple[np.ndarray, np.ndarray]:
    v = np.array([[(high if (i >> k) & 1 else low)[k] for k in range(3)] for i in range(8)], float)
    f = [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ]
    return v, np.array(f)


def test_a_wall_throws_its_shadow_as_far_as_geometry_says():
    """A plate seen from above, with a wall of height h: at 45 deg the shadow is h long."""
    a, fa = box_mesh([-50.0, -50.0, 0.0], [50.0, 50.0, 1.0])
    b, fb = box_mesh([-30.0, -50.0, 1.0], [-28.0, 50.0, 21.0])
    mesh = Mesh(np.concatenate([a, b]), np.concatenate([fa, fb + 8]))
    R_TC = np.diag([1.0, -1.0, -1.0])  # the camera looks down -z of the body
    camera = Camera(256, 256, 1e7)
    r = np.array([0.0, 0.0, 1e7])
    grid = Grid(camera.cx - 60.0, camera.cy - 60.0, 480, 480, 4)
    seen = see(camera, mesh, r, R_TC, np.array([-1.0, 0.0, -1.0]) / np.sqrt(2.0), grid)
    i, j = np.divmod(seen.cell, grid.columns)
    middle = np.abs(i - 240) < 4
    x = (j[middle] + 0.5) / 4.0 - 60.0
    dark = x[seen.mu0[middle] == 0.0]
    assert dark.min() == pytest.approx(-28.0, abs=0.6)  # two texels of a quarter
    assert dark.max() == pytest.approx(-8.0, abs=0.6)
    assert len(dark) == pytest.approx(20.0 * 4 * 7, rel=0.05)


def test_light_and_dark_of_a_convex_mesh_need_no_shadow_map():
    """Where the Sun shines on a convex body nothing else can be in the way: not one ray may be darkened."""
    mesh = round_mesh((RADIUS, RADIUS, RADIUS), 2000)
    r = np.array([0.0, 0.0, distance(100.0)])
    grid = Grid(CAMERA.cx - 60.0, CAMERA.cy - 60.0, 480, 480, 4)
    s = sun(1.2)
    seen = see(CAMERA, mesh, r, np.eye(3), s, grid)
    facing = mesh.normals @ s > 0.02
    assert np.mean(seen.mu0 > 0.0) == pytest.approx(0.5 * (1.0 + np.cos(1.2)), abs=0.01)
    assert facing.any()


def test_stars_behind_are_hidden():
    r = np.array([0.0, 0.0, distance(100.0)])
    at = np.array(CAMERA.geometric_centre_px)
    place = np.array([at, [at[0] + 45.0, at[1]], [at[0] + 60.0, at[1]], [10.0, 10.0], [900.0, 10.0]])
    stars = Stars(CAMERA.directions(place), np.full(5, 1e5))
    quiet = Exposure(poisson=False, read_noise_e=0.0, sky_e_s=0.0, dark_e_s=0.0, full_well_e=1e9, bits=16)
    image, truth = render_body(CAMERA, sphere(RADIUS), r, sun(2.0), stars=stars, exposure=quiet)
    assert truth.stars.tolist() == [2, 3]
    assert int(image.array[10, 10]) > 1000
    mesh = round_mesh((RADIUS, RADIUS, RADIUS), 500)
    assert render_body(CAMERA, mesh, r, sun(2.0), stars=stars, exposure=quiet)[1].stars.tolist() == [2, 3]


def test_noise_is_that_of_the_exposure_and_seeds_repeat():
    r = np.array([0.0, 0.0, distance(20.0)])
    e = Exposure(read_noise_e=6.0, gain_e=2.0, sky_e_s=100.0, duration=1.0, dark_e_s=0.0)
    one, _ = render_body(CAMERA, sphere(RADIUS), r, sun(1.0), exposure=e, seed=3)
    two, _ = render_body(CAMERA, sphere(RADIUS), r, sun(1.0), exposure=e, seed=3)
    assert (one.array == two.array).all()
    dark = one.array[:150].astype(float)
    # 76800 pixels: the deviation is known within 0.3%, the mean within 0.02 counts; rounding adds 1/12.
    assert dark.mean() == pytest.approx(50.0 + 100.0 / 2.0, abs=0.1)
    assert dark.std() == pytest.approx(np.sqrt((100.0 + 36.0) / 4.0 + 1.0 / 12.0), rel=0.015)


def test_a_window_is_the_same_light_as_the_frame():
    r = distance(30.0) * CAMERA.directions(np.array([100.2, 50.7]))
    quiet = Exposure(poisson=False, read_noise_e=0.0)
    whole, _ = render_body(CAMERA, sphere(RADIUS), r, sun(1.0), exposure=quiet)
    part, truth = render_window(CAMERA, sphere(RADIUS), r, sun(1.0), exposure=quiet)
    left, top, width, height = truth.window
    assert (part.array == whole.array[top : top + height, left : left + width]).all()
    outside, truth = render_window(
        CAMERA, sphere(RADIUS), distance(30.0) * CAMERA.directions(np.array([-99.0, 50.0])), sun(1.0)
    )
    assert outside.array.size >= 1
    assert truth.centre_px[0] == pytest.approx(-99.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r_TC_C": np.array([0.0, 0.0, 1e3])}, "in front of the camera"),
        ({"r_TC_C": np.zeros(2)}, "must be"),
        ({"sun_C": np.zeros(3)}, "not zero"),
        ({"R_TC": 2.0 * np.eye(3)}, "rotation"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = {"r_TC_C": np.array([0.0, 0.0, 1e6]), "sun_C": np.array([0.0, 0.0, -1.0])} | change
    r, s = arguments.pop("r_TC_C"), arguments.pop("sun_C")
    with pytest.raises(ValueError, match=message):
        render_body(CAMERA, sphere(RADIUS), r, s, **arguments)


TETRAHEDRON = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = [[1, 3, 2], [1, 2, 4], [1, 4, 3], [2, 3, 4]]


@pytest.mark.parametrize("inverted", [False, True])
def test_obj_and_plate_models_are_read(tmp_path, inverted):
    vertices = TETRAHEDRON.splitlines()
    faces = [f[::-1] for f in FACES] if inverted else FACES
    obj = "# comment\n" + "".join(f"v {v}\n" for v in vertices) + "".join(f"f {a}/1 {b}//2 {c}\n" for a, b, c in faces)
    plt = "4\n" + "".join(f"{i} {v}\n" for i, v in enumerate(vertices, 1))
    plt += "4\n" + "".join(f"{i} {a} {b} {c}\n" for i, (a, b, c) in enumerate(faces, 1))
    tab = "4 4\n" + "".join(f"{v}\n" for v in vertices) + "".join(f"{a} {b} {c}\n" for a, b, c in faces)
    for name, text in (("a.obj", obj), ("a.plt", plt), ("a.tab", tab)):
        (tmp_path / name).write_text(text)
        mesh = read_mesh(tmp_path / name)
        assert mesh.volume == pytest.approx(1e9 / 6.0)  # km, and outwards whatever the file's turn
        assert len(mesh.faces) == 4


def test_a_grid_of_radii_is_read(tmp_path):
    rows = [f"{lat} {lon} 2.0" for lat in range(-90, 91, 10) for lon in range(0, 360, 10)]
    (tmp_path / "grid.tab").write_text("\n".join(rows))
    mesh = read_mesh(tmp_path / "grid.tab")
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * 8e9, rel=0.02)  # facets of 10 deg lack 1.3%
    assert mesh.reach == pytest.approx(2e3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("v 0 0 0\nv 1 0\n", "line 2: a vertex needs three numbers"),
        ("v 0 0 0\nv 1 0 x\n", "line 2: 'x' is no number"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        ("9\n1 0 0 0\n", "says 9 vertices, but 1 lines follow"),
        ("4\n" + "1 0 0 0\n" * 4 + "1\n1 1 2 7\n", "names vertices 1 to 4"),
        ("4\n1 0 0 0\n2 1 0 0\n3 2 0 0\n4 3 0 0\n4\n" + "1 1 2 3\n" * 4, "no volume"),
        ("a b c d e\n", "begins neither"),
    ],
)
def test_bad_meshes_are_refused_with_the_line(tmp_path, text, message):
    (tmp_path / "bad.plt").write_text(text)
    with pytest.raises(DataError, match=message):
        read_mesh(tmp_path / "bad.plt")
    with pytest.raises(DataError, match="cannot be read"):
        read_mesh(tmp_path / "absent.plt")
