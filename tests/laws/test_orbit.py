"""Orbits: conserved quantities, Kepler's equation, J2's secular rates, the local frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helmstar.astro import EARTH, Elements, cartesian, lvlh, propagate
from helmstar.astro.orbit import _eccentric_anomaly, acceleration

ZHOU = Elements(7178.2e3, 0.005, *np.radians([28.5, 45.0, 10.0, 200.0]))


@given(M=st.floats(-20, 20), e=st.floats(0, 0.999))
def test_keplers_equation(M, e):
    E = _eccentric_anomaly(M, e)
    # Rounding of M, of e sin E, and of adding the turns.
    assert abs(E - e * np.sin(E) - M) < 4e-15 * (1 + abs(M)) * 2


@given(
    a=st.floats(6.6e6, 5e7), e=st.floats(0, 0.9), i=st.floats(0, np.pi), raan=st.floats(0, 6.28), w=st.floats(0, 6.28),
    M=st.floats(0, 6.28),
)  # fmt: skip
def test_energy_momentum_and_inclination_are_those_of_the_elements(a, e, i, raan, w, M):
    r, v = cartesian(Elements(a, e, i, raan, w, M))
    h = np.cross(r, v)
    assert 0.5 * v @ v - EARTH.mu / np.linalg.norm(r) == pytest.approx(-EARTH.mu / (2 * a), rel=1e-11)
    assert np.linalg.norm(h) == pytest.approx(np.sqrt(EARTH.mu * a * (1 - e * e)), rel=1e-11)
    assert h[2] / np.linalg.norm(h) == pytest.approx(np.cos(i), abs=1e-12)


def test_without_oblateness_the_orbit_closes_and_the_elements_carry_it():
    kepler = EARTH._replace(j2=0.0)
    period = 2 * np.pi * np.sqrt(ZHOU.semi_major_axis**3 / EARTH.mu)
    r, v = propagate(ZHOU, np.array([0.0, 0.25 * period, period]), kepler)
    r_quarter, v_quarter = cartesian(ZHOU._replace(mean_anomaly=ZHOU.mean_anomaly + 0.5 * np.pi), kepler)
    # The integrator keeps 1e-11 of 7e6 m per step, over some hundred steps.
    np.testing.assert_allclose(r[1], r_quarter, atol=1e-2)
    np.testing.assert_allclose(v[1], v_quarter, atol=1e-5)
    np.testing.assert_allclose(r[2], r[0], atol=1e-2)


def test_the_acceleration_is_the_gradient_of_the_potential():
    r = np.array([4.1e6, -3.3e6, 5.2e6])

    def potential(x):
        d = np.linalg.norm(x)
        return EARTH.mu / d * (1 - EARTH.j2 * (EARTH.radius / d) ** 2 * (1.5 * (x[2] / d) ** 2 - 0.5))

    h = 100.0
    gradient = [(potential(r + h * e) - potential(r - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(acceleration(r), gradient, rtol=1e-8)  # (h / r)^2 of a central difference


def test_the_node_moves_at_the_secular_rate():
    period = 2 * np.pi * np.sqrt(ZHOU.semi_major_axis**3 / EARTH.mu)
    time = np.linspace(0, 20 * period, 20 * 60 + 1)
    r, v = propagate(ZHOU, time)
    h = np.cross(r, v)
    node = np.unwrap(np.arctan2(h[:, 0], -h[:, 1]))
    slope = np.polyfit(time, node, 1)[0]
    n = 2 * np.pi / period
    p = ZHOU.semi_major_axis * (1 - ZHOU.eccentricity**2)
    expected = -1.5 * n * EARTH.j2 * (EARTH.radius / p) ** 2 * np.cos(ZHOU.inclination)
    assert slope == pytest.approx(expected, rel=0.01)  # the osculating semi-major axis is not the mean one: J2 relative


def test_the_local_frame():
    r, v = propagate(ZHOU, np.arange(0.0, 6000.0, 500.0))
    R = lvlh(r, v)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, r)[:, 2], -np.linalg.norm(r, axis=1), rtol=1e-14)
    forward = np.einsum("nij,nj->ni", R, v)
    assert np.all(forward[:, 0] > 0.99 * np.linalg.norm(v, axis=1))
    np.testing.assert_allclose(forward[:, 1], 0.0, atol=1e-8)


@pytest.mark.parametrize("bad", [np.array([]), np.array([-1.0, 0.0]), np.array([0.0, 0.0])])
def test_times_that_do_not_increase_are_refused(bad):
    with pytest.raises(ValueError, match="increasing"):
        propagate(ZHOU, bad)


def test_an_open_orbit_is_refused():
    with pytest.raises(ValueError, match="ellipse"):
        cartesian(ZHOU._replace(eccentricity=1.0))
