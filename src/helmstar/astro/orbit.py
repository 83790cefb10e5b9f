"""Orbits about a planet: Kepler's elements, motion under its mass and oblateness (J2), and the local frame H.

    d2r/dt2 = -mu r / r^3 + 3/2 J2 mu R^2 / r^5 [ (5 z^2 / r^2 - 1) [x, y, 0] + (5 z^2 / r^2 - 3) [0, 0, z] ]

with z along the planet's axis, taken as the z axis of N. Source: Vallado, "Fundamentals of Astrodynamics and Applications",
4th ed., sections 2.2, 2.6 and 8.6.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Body(NamedTuple):
    """mu: gravitational parameter, m^3/s^2; radius: equatorial, m; j2: oblateness."""

    mu: float
    radius: float
    j2: float


EARTH = Body(3.986004418e14, 6378137.0, 1.08262668e-3)


class Elements(NamedTuple):
    """Osculating elements: semi-major axis m, eccentricity in [0, 1), and angles in rad."""

    semi_major_axis: float
    eccentricity: float
    inclination: float
    raan: float
    argument_of_perigee: float
    mean_anomaly: float


def _eccentric_anomaly(M: float, e: float) -> float:
    """Solution E of Kepler's equation M = E - e sin E, to rounding."""
    from scipy.optimize import brentq

    turns, M = divmod(M + np.pi, 2.0 * np.pi)
    M -= np.pi
    # The root lies within e of M, and rounding must not shut it out.
    E: Any = brentq(lambda x: x - e * np.sin(x) - M, M - e - 1e-9, M + e + 1e-9, xtol=1e-15)
    return E + 2.0 * np.pi * turns


def cartesian(elements: Elements, body: Body = EARTH) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) m and velocity (3,) m/s in N. Raises ValueError for an orbit that is no ellipse."""
    a, e, i, raan, argp, M = elements
    if not (a > 0 and 0 <= e < 1):
        raise ValueError(f"semi-major axis {a} m, eccentricity {e}: must be an ellipse, a > 0 and 0 <= e < 1")
    E = _eccentric_anomaly(M, e)
    b = np.sqrt(1.0 - e * e)
    n = np.sqrt(body.mu / a**3)
    r = a * np.array([np.cos(E) - e, b * np.sin(E), 0.0])
    v = a * n / (1.0 - e * np.cos(E)) * np.array([-np.sin(E), b * np.cos(E), 0.0])
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("ZXZ", [raan, i, argp])
    return turn.apply(r), turn.apply(v)


def acceleration(r: np.ndarray, body: Body = EARTH) -> np.ndarray:
    """Acceleration (..., 3) m/s^2 in N at positions (..., 3) m."""
    d = np.linalg.norm(r, axis=-1, keepdims=True)
    s = 5.0 * (r[..., 2:] / d) ** 2
    c = 1.5 * body.j2 * body.mu * body.radius**2 / d**5
    return -body.mu * r / d**3 + c * r * (s - np.array([1.0, 1.0, 3.0]))


def propagate(elements: Elements, time: np.ndarray, body: Body = EARTH) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (n, 3) in N at increasing times (n,) s after the elements' epoch, with J2 (0 in `body`: Kepler).

    Integrated with scipy's DOP853 to 1e-11 relative. Raises ValueError for times that do not increase or lie before 0.
    """
    from scipy.integrate import solve_ivp

    time = np.asarray(time, float)
    if time.size == 0 or time[0] < 0 or np.any(np.diff(time) <= 0):
        raise ValueError("time: must be increasing times in s, from 0 on")
    y0 = np.concatenate(cartesian(elements, body))
    if time[-1] == 0.0:
        return y0[None, :3], y0[None, 3:]
    found = solve_ivp(
        lambda _, y: np.concatenate([y[3:], acceleration(y[:3], body)]),
        (0.0, time[-1]), y0, "DOP853", time, rtol=1e-11, atol=1e-6,
    )  # fmt: skip
    if not found.success:
        raise ValueError(f"the orbit could not be integrated: {found.message}")
    return found.y[:3].T, found.y[3:].T


def lvlh(r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R_HN (..., 3, 3) of the local frame H: z to the planet's centre, y against the orbit's normal, x forward."""
    z = -r / np.linalg.norm(r, axis=-1, keepdims=True)
    h = np.cross(r, v)
    y = -h / np.linalg.norm(h, axis=-1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=-2)
