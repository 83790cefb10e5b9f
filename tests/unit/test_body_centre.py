"""Centres of bodies: methods against the truth of rendered frames, covariances against errors, what must not fail silently."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull

from helmstar.imaging import Camera, Image
from helmstar.imaging.body import (
    Detector,
    Ellipsoid,
    Hapke,
    Lambert,
    LommelSeeliger,
    Mesh,
    Minnaert,
    Pose,
    Target,
    brightness_centroid,
    centre_from_moment,
    centre_of_figure,
    preprocess,
    render_body,
    render_window,
    sphere,
    windowed_centroid,
)
from helmstar.imaging.body.centre import find_centre
from helmstar.imaging.body.limb import centre_from_limb
from helmstar.imaging.body.moment import sky_of
from helmstar.imaging.body.phase import lambert_factor
from helmstar.imaging.body.render_body import body_light
from helmstar.imaging.body.template_fit import centre_from_fit
from helmstar.imaging.render import Exposure, sensor_counts

CAMERA = Camera.from_fov(3.5, 1024, 1024)
RADIUS = 2e3
EXPOSURE = Exposure(full_well_e=1e6, bits=16, gain_e=2.0)
DETECTOR = Detector(2.0)


def scene(diameter, degrees, seed, shape=None, law=None, signal_e=3e4, at=None):
    """A window of a frame, its truth, and the pose."""
    rng = np.random.default_rng([seed, int(10 * diameter), int(degrees)])
    a, turn = np.radians(degrees), rng.uniform(0.0, 6.28)
    sun = np.array([np.sin(a) * np.cos(turn), np.sin(a) * np.sin(turn), -np.cos(a)])
    distance = 2.0 * RADIUS * CAMERA.focal_px / diameter
    r = distance * CAMERA.directions(rng.uniform(300.0, 700.0, 2) if at is None else np.asarray(at))
    image, truth = render_window(
        CAMERA, shape or sphere(RADIUS), r, sun, law=law or Lambert(), signal_e=signal_e, exposure=EXPOSURE, seed=rng
    )
    return image, truth, Pose(float(np.linalg.norm(r)), sun)


def nees(found, truth):
    error = found.centre_px - truth.centre_px
    return float(error @ np.linalg.solve(found.covariance_px, error)) / 2.0


KNOWN = Target(sphere(RADIUS), Lambert(), law_known=True)


@pytest.mark.parametrize(("diameter", "bar"), [(12.0, 0.02), (50.0, 0.02), (200.0, 0.02)])
@pytest.mark.parametrize("find", [centre_from_moment, centre_from_fit])
def test_a_known_law_gives_hundredths_of_a_pixel(find, diameter, bar):
    ratios = []
    for seed, degrees in enumerate((10.0, 60.0, 100.0)):
        image, truth, pose = scene(diameter, degrees, seed)
        found = find(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
        assert found.status == "found"
        assert np.abs(found.centre_px - truth.centre_px).max() < bar
        ratios.append(nees(found, truth))
    assert np.mean(ratios) < 3.5  # chi2 of 6 degrees over 6: above 3.5 once in 500


@pytest.mark.parametrize("law", [LommelSeeliger(), Minnaert(k=0.6), Hapke()], ids=lambda law: type(law).__name__)
@pytest.mark.parametrize(("diameter", "bar"), [(12.0, 0.1), (50.0, 0.1), (200.0, 0.15)])
def test_another_law_than_the_assumed_one_is_within_the_bars(law, diameter, bar):
    image, truth, pose = scene(diameter, 60.0, 3, law=law)
    found = centre_from_fit(image, CAMERA, Target(sphere(RADIUS), Lambert()), pose, DETECTOR, corner=truth.window[:2])
    assert found.status == "found"
    assert np.abs(found.centre_px - truth.centre_px).max() < bar
    assert nees(found, truth) < 7.0  # chi2 of 2 degrees: above 14 once in 1000


def test_the_moments_covariance_holds_wrong_law_and_radius():
    """The plain moment is wrong by parts of the radius then, and says so: NEES near 1 over laws and radii."""
    rng = np.random.default_rng(5)
    ratios = []
    for seed, law in enumerate([LommelSeeliger(), Minnaert(k=0.6), Hapke(), Minnaert(k=0.8)] * 4):
        image, truth, pose = scene(12.0, 60.0 + 20.0 * (seed % 3), seed, law=law)
        target = Target(sphere(RADIUS * rng.normal(1.0, 0.1)), Lambert(), radius_sigma=0.1)
        found = centre_from_moment(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2])
        ratios.append(nees(found, truth))
    # The error lies along the Sun's direction: nearly all of it in one of two dimensions; 16 frames, +-3 sigma of chi2/2.
    assert 0.15 < np.mean(ratios) < 2.0


def test_a_fit_finds_size_and_centre_when_the_radius_is_wrong():
    image, truth, pose = scene(50.0, 60.0, 1)
    target = Target(sphere(0.9 * RADIUS), Lambert(), law_known=True, radius_sigma=0.1)
    found = centre_from_fit(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2])
    assert found.size == pytest.approx(1.0 / 0.9, abs=5.0 * found.size_sigma + 1e-3)
    assert np.abs(found.centre_px - truth.centre_px).max() < 0.05
    assert nees(found, truth) < 7.0


def test_an_ellipsoid_taken_for_a_sphere_is_fitted_with_stretches():
    shape = Ellipsoid((1.15 * RADIUS, 0.95 * RADIUS, RADIUS))
    image, truth, pose = scene(50.0, 60.0, 2, shape=shape)
    target = Target(sphere(RADIUS), Lambert(), law_known=True, radius_sigma=0.1, shape_sigma=0.1)
    found = centre_from_fit(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2])
    rigid = centre_from_fit(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
    assert np.linalg.norm(found.centre_px - truth.centre_px) < 0.1
    assert np.linalg.norm(rigid.centre_px - truth.centre_px) > 0.3  # what the stretches are for


@pytest.mark.parametrize("degrees", [10.0, 60.0, 100.0])
def test_the_limb_needs_no_law(degrees):
    for law in (LommelSeeliger(),) if degrees == 60.0 else (Hapke(),):
        image, truth, pose = scene(200.0, degrees, 4, law=law)
        target = Target(sphere(1.03 * RADIUS), None, radius_sigma=0.1)
        found = centre_from_limb(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2])
        assert found.status == "found"
        assert np.linalg.norm(found.centre_px - truth.centre_px) < 0.15
        assert found.size == pytest.approx(1.0 / 1.03, abs=3e-3)
        assert len(found.limb_px) > 100
        assert np.linalg.norm(found.limb_px - truth.centre_px, axis=1) == pytest.approx(100.0, abs=0.8)


def test_crescents_at_150_deg_are_found_or_refused():
    for diameter, bar in ((12.0, 0.15), (50.0, 0.1), (200.0, 0.1)):
        image, truth, pose = scene(diameter, 150.0, 6, signal_e=1e5)
        found = find_centre(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
        assert found.status == "found"
        assert np.abs(found.centre_px - truth.centre_px).max() < bar
        thin = centre_from_limb(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
        assert diameter > 100.0 or (thin.status == "no fit" and not thin.usable)


def test_the_papers_chain_over_a_full_frame():
    """(1)-(3) literally: centroid over P_min, phase factor, the Sun's direction in the image; P_min at 6 sigma."""
    a, turn = np.radians(72.0), 0.6
    sun = np.array([np.sin(a) * np.cos(turn), np.sin(a) * np.sin(turn), -np.cos(a)])
    distance = 2.0 * RADIUS * CAMERA.focal_px / 40.0
    r = distance * CAMERA.directions(np.array([400.3, 600.6]))
    image, truth = render_body(CAMERA, sphere(RADIUS), r, sun, signal_e=3e4, exposure=EXPOSURE, seed=2)
    grey = preprocess(image)
    centroid = brightness_centroid(grey.grey, grey.p_min, grey.p_max)
    toward = CAMERA.pixels(r + 1e3 * sun) - CAMERA.pixels(r)
    found = centre_of_figure(centroid, float(lambert_factor(a)), 20.0, np.arctan2(toward[1], toward[0]))
    # 0.15 px of it is the light that a threshold leaves out at the terminator, the rest is perspective.
    assert found == pytest.approx(truth.centre_px, abs=0.25)
    low = preprocess(image, sigmas=3.0)  # a thousand pixels of noise drag the centroid towards the frame's middle
    off = [np.linalg.norm(brightness_centroid(g.grey, g.p_min) - truth.centroid_px) for g in (low, grey)]
    assert off[0] > 3.0 * off[1]
    windowed = windowed_centroid(image, DETECTOR)
    assert windowed.xy_px == pytest.approx(truth.centroid_px, abs=0.05)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_the_sky_is_found_beside_a_large_body(share):
    rng = np.random.default_rng(1)
    array = rng.normal(100.0, 4.0, (200, 200))
    array[:, : int(200 * share)] += 800.0 + 50.0 * rng.standard_normal((200, int(200 * share)))
    sky, noise = sky_of(np.rint(array).astype(np.uint16))
    assert sky == pytest.approx(100.0, abs=0.5)
    assert noise == pytest.approx(4.0, rel=0.15)


def test_what_is_no_body_says_so():
    image, truth, pose = scene(12.0, 60.0, 1, signal_e=1e-6)
    found = find_centre(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
    assert (found.status, found.usable) == ("no body", False)
    assert found.message
    image, truth, pose = scene(30.0, 60.0, 1)
    dark = Pose(pose.distance, np.array([0.0, 0.0, 1.0]))
    wrong = find_centre(image, CAMERA, KNOWN, dark, DETECTOR, corner=truth.window[:2])
    assert wrong.status in ("too dark", "no fit")
    assert not wrong.usable


def test_a_body_cut_by_the_edge_has_no_moment_but_a_fit():
    image, truth, pose = scene(60.0, 60.0, 1, at=(-8.0, 500.0))
    moment = centre_from_moment(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
    assert moment.status == "cut by the edge"
    assert not moment.usable
    fitted = find_centre(image, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2])
    assert fitted.status == "cut by the edge"
    assert np.abs(fitted.centre_px - truth.centre_px).max() < 0.1


def test_saturation_and_rivals_are_named():
    image, truth, pose = scene(30.0, 60.0, 1)
    full = Image(image.array, float(np.percentile(image.array[image.array > 500], 70)), 16)
    assert centre_from_moment(full, CAMERA, KNOWN, pose, DETECTOR, corner=truth.window[:2]).status == "saturated"
    array = np.zeros((200, 200), np.uint16) + 100
    array[40:50, 40:50], array[140:150, 150:160] = 900, 950
    found = windowed_centroid(Image(array, 65535.0, 16), DETECTOR)
    assert found.status == "ambiguous"
    near = windowed_centroid(Image(array, 65535.0, 16), DETECTOR, near_px=np.array([45.0, 45.0]), near_sigma_px=10.0)
    assert near.status == "found"
    assert near.xy_px == pytest.approx([44.5, 44.5], abs=0.05)
    with pytest.raises(ValueError, match="must be one of"):
        find_centre(image, CAMERA, KNOWN, pose, method="guess")


@pytest.mark.parametrize("find", [centre_from_moment, centre_from_fit])
def test_spots_of_albedo_are_in_the_covariance(find):
    """A smooth random map of 10% over the light moves every method; told of it, NEES of twelve frames is in its band."""
    ratios, told = [], Target(sphere(RADIUS), Lambert(), albedo_sigma=0.1)
    for seed in range(12):
        image, truth, pose = scene(16.0, 10.0 + 50.0 * (seed % 2), seed)
        law, rng = LommelSeeliger(), np.random.default_rng(seed)
        r = pose.position(CAMERA, truth.centre_px)
        light = body_light(CAMERA, told.shape, r, np.eye(3), pose.sun_C, law, truth.window, EXPOSURE.psf_sigma_px)
        spots = gaussian_filter(rng.standard_normal(light.shape), 16.0 / 12.0)
        light = 3e4 * light * np.maximum(1.0 + 0.1 * spots / spots.std(), 0.0)
        light += (EXPOSURE.sky_e_s + EXPOSURE.dark_e_s) * EXPOSURE.duration
        image = sensor_counts(light.astype(np.float32), EXPOSURE, rng)
        found = find(image, CAMERA, told, pose, DETECTOR, corner=truth.window[:2])
        assert found.status == "found"
        ratios.append(nees(found, truth))
    assert 0.2 < np.mean(ratios) < 3.0


def test_free_figures_and_limbs_have_honest_covariances():
    """Mean NEES in its band: a figure with free stretches at 12 px, limbs over phases and laws."""
    stretched, limbs = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        shape = Ellipsoid(tuple(RADIUS * np.exp(rng.normal(0.0, 0.1, 3))))
        image, truth, pose = scene(12.0, (10.0, 60.0, 100.0)[seed % 3], seed, shape=shape)
        target = Target(sphere(RADIUS), Lambert(), law_known=True, radius_sigma=0.1, shape_sigma=0.1)
        stretched.append(nees(centre_from_fit(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2]), truth))
        law = (LommelSeeliger(), Hapke(), Lambert(), Minnaert(k=0.7))[seed // 2]
        image, truth, pose = scene(40.0, (10.0, 60.0)[seed % 2], seed, law=law)
        target = Target(sphere(1.03 * RADIUS), None, radius_sigma=0.1)
        limbs.append(nees(centre_from_limb(image, CAMERA, target, pose, DETECTOR, corner=truth.window[:2]), truth))
    assert 0.2 < np.mean(stretched) < 3.0
    assert 0.2 < np.mean(limbs) < 3.0


def test_a_mesh_is_found_by_fit_and_moment():
    """Hills of 5% on a hull of 600 points, told as they are: a known law's bar, and errors as the covariance says."""
    k = np.arange(600) + 0.5
    polar, east = np.arccos(1.0 - k / 300.0), np.pi * (1.0 + 5.0**0.5) * k
    u = np.stack([np.cos(east) * np.sin(polar), np.sin(east) * np.sin(polar), np.cos(polar)], axis=1)
    faces = ConvexHull(u).simplices
    inwards = np.linalg.det(u[faces]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    hills = 1.0 + 0.05 * np.sin(5.0 * u[:, :1]) * np.cos(4.0 * u[:, 1:2])
    mesh = Mesh(RADIUS * u * hills * [1.2, 1.0, 0.9], faces)
    for find in (centre_from_fit, centre_from_moment):
        ratios = []
        for seed in range(3):
            image, truth, pose = scene(12.0, 60.0, seed, shape=mesh)
            found = find(image, CAMERA, Target(mesh, Lambert(), True), pose, DETECTOR, corner=truth.window[:2])
            assert np.abs(found.centre_px - truth.centre_px).max() < 0.02
            ratios.append(nees(found, truth))
        assert np.mean(ratios) < 3.0  # chi2 of 6 degrees over 6: above once in 170
