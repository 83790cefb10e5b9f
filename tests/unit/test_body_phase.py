"""Where the light of a lit body lies: closed forms and quadrature against integration by scipy, the light of a known sphere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad

from helmstar.imaging import Camera
from helmstar.imaging.body import Ellipsoid, Hapke, Lambert, LommelSeeliger, McEwen, Minnaert, law_of, sphere
from helmstar.imaging.body.phase import integrated_factor, lambert_factor, lommel_seeliger_factor, nodes, phase_factor

LAWS = [Lambert(), LommelSeeliger(), McEwen(), McEwen(weight=0.5), Minnaert(k=0.8), Hapke()]
CAMERA = Camera.from_fov(3.5, 1024, 1024)


def on_the_disc(law, alpha: float, rows: int = 1200) -> float:
    """g by summing the pixels of a disc: nothing of the module's longitudes and latitudes is used."""
    axis = (np.arange(rows) + 0.5) / rows * 2.0 - 1.0
    x, y = np.meshgrid(axis, axis)
    z = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
    mu0 = np.where(z > 0.0, np.maximum(x * np.sin(alpha) + z * np.cos(alpha), 0.0), 0.0)
    light = np.where(z > 0.0, law(mu0, z, alpha), 0.0)
    return float((light * x).sum() / light.sum())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("degrees", [0.0, 10.0, 60.0, 100.0, 130.0, 150.0])
def test_the_factor_of_every_law_is_that_of_a_disc_of_pixels(law, degrees):
    alpha = np.radians(degrees)
    # 1e-3 is the bar; pixels of a disc of 1200 rows are 1.7e-3 R wide, and their sums right within a tenth of that.
    assert phase_factor(law, alpha) == pytest.approx(on_the_disc(law, alpha), abs=1e-3)


@pytest.mark.parametrize("degrees", [5.0, 72.0, 140.0])
def test_lambert_against_adaptive_quadrature(degrees):
    a = np.radians(degrees)
    f = lambda b, L, k: np.cos(b) ** (3 + k) * np.cos(L) * np.cos(L - a) * np.sin(L) ** k
    sums = [dblquad(f, a - np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, args=(k,))[0] for k in (1, 0)]
    assert float(lambert_factor(a)) == pytest.approx(sums[0] / sums[1], abs=1e-9)


def test_the_papers_numbers():
    # The digest of Li 2007: .199 at 30, .478 at 72, .589 at 90 deg, to its three digits.
    assert lambert_factor(np.radians([30.0, 72.0, 90.0])) == pytest.approx([0.199, 0.478, 0.589], abs=5e-4)


@given(st.floats(0.0, 3.12))
def test_closed_forms_are_the_quadrature(alpha):
    for factor, law in ((lambert_factor, Lambert()), (lommel_seeliger_factor, LommelSeeliger())):
        # The closed forms lose digits like eps / (pi - alpha)^3 near new phase.
        assert float(factor(alpha)) == pytest.approx(integrated_factor(law, alpha), abs=2e-6)


def test_the_factor_near_new_phase_is_finite_and_continuous():
    a = np.pi - np.array([0.0199, 0.0201, 1e-6, 0.0])
    g = lambert_factor(a)
    assert np.isfinite(g).all()
    assert g[0] == pytest.approx(g[1], abs=2e-6)  # its slope over 2e-4 rad is 1e-6
    assert g[3] == pytest.approx(9.0 * np.pi / 32.0)
    with pytest.raises(ValueError, match="below pi"):
        phase_factor(Lambert(), np.pi)


@pytest.mark.parametrize("degrees", [10.0, 72.0, 150.0])
def test_nodes_give_flux_and_centroid_of_a_far_sphere(degrees):
    a = np.radians(degrees)
    sun = np.array([np.sin(a), 0.0, -np.cos(a)])
    r, radius = np.array([0.0, 0.0, 1e9]), 2e3
    flux, centroid = nodes(CAMERA, sphere(radius), r, np.eye(3), sun).moment(Lambert())
    px = radius * CAMERA.focal_px / r[2]
    # Lambert's phase function: 2/3 of a full disc at phase 0.
    phase = 2.0 / 3.0 * (np.sin(a) + (np.pi - a) * np.cos(a)) / np.pi
    # At 500 000 radii what is seen differs from far away by some 2e-6, ten times that for a thin crescent.
    assert flux == pytest.approx(np.pi * px**2 * phase, rel=3e-5)
    assert centroid - CAMERA.centre_px == pytest.approx([float(lambert_factor(a)) * px, 0.0], abs=1e-5 * px)


@given(st.tuples(*[st.floats(0.5, 2.0)] * 3), st.floats(0.1, 2.4), st.integers(0, 10**6))
def test_nodes_turn_with_body_and_sun(axes, alpha, seed):
    """The light of a body does not depend on the axes that describe it: a permuted ellipsoid, turned to fit, is the same body."""
    rng = np.random.default_rng(seed)
    sun = np.array([np.sin(alpha), 0.0, -np.cos(alpha)])
    r = np.array([rng.uniform(-2.0, 2.0), rng.uniform(-2.0, 2.0), 60.0])
    P = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    one = nodes(CAMERA, Ellipsoid(axes), r, np.eye(3), sun).moment(LommelSeeliger())
    two = nodes(CAMERA, Ellipsoid((axes[1], axes[2], axes[0])), r, P, sun).moment(LommelSeeliger())
    assert one[0] == pytest.approx(two[0], rel=1e-9)
    assert one[1] == pytest.approx(two[1], abs=1e-6)


def test_a_new_moon_has_no_light():
    points = nodes(CAMERA, sphere(1.0), np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert points.moment(Lambert())[0] == 0.0
    with pytest.raises(ValueError, match="inside"):
        nodes(CAMERA, sphere(4.0), np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.0, 0.0, -1.0]))


def test_laws_by_name_say_what_is_wrong():
    assert law_of("minnaert", k=0.5) == Minnaert(k=0.5)
    with pytest.raises(ValueError, match="must be one of lambert"):
        law_of("lamber")
    with pytest.raises(ValueError, match="does not have"):
        law_of("lambert", k=0.5)


@given(st.floats(0.0, 1.0), st.floats(1e-3, 1.0), st.floats(0.0, 3.1))
def test_laws_are_finite_and_dark_in_the_dark(mu0, mu, alpha):
    for law in LAWS:
        value = float(law(np.array(mu0), np.array(mu), alpha))
        assert np.isfinite(value)
        assert value >= 0.0
        assert float(law(np.array(0.0), np.array(mu), alpha)) == 0.0
