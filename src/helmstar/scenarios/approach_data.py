"""Of the approach: when frames and manoeuvres are, the orbit to the aim, errors at the start, and the random numbers of a run.

Truth depends on the manoeuvres, and these on the estimator. So a run's data are its random numbers alone: every estimator flies
the same errors and the same noise.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from ..backend import jax
from ..core import pytree
from ..models.approach import AU, MU_SUN, SOLAR_PRESSURE
from .approach_specification import Specification
from .li2007_data import key_of

Array = jax.Array
KM = 1e3
DAY = 86400.0
# Purposes of the random streams, after run and step.
NOISE, START = 0, 1


class Timeline(NamedTuple):
    """Of every epoch (n,): before, seconds to the nominal closest approach; dt from the epoch before it (the first: from the
    start); whether there is a frame, and whether a manoeuvre follows it. burns: which epochs have a manoeuvre."""

    before: np.ndarray
    dt: np.ndarray
    frame: np.ndarray
    burn: np.ndarray

    @property
    def burns(self) -> np.ndarray:
        return np.flatnonzero(self.burn)


def timeline(spec: Specification) -> Timeline:
    """Epochs of the frames and manoeuvres; the last is the last frame, `until_min` before closest approach."""
    f = spec.frames
    ends = [60.0 * h for h in f.from_h] + [f.until_min]
    frames = [f.until_min]
    for a, b, every in zip(ends, ends[1:], f.every_min, strict=False):
        frames += list(np.arange(a, b, -every))
    start = ends[0]
    # To a millisecond: sums of minutes that mean the same epoch shall be one.
    seen = {round(60e3 * m) for m in frames if m < start}
    burns = {round(3600e3 * h) for h in spec.manoeuvres.before_h}
    before = np.array(sorted(seen | burns, reverse=True))
    dt = -np.diff(np.concatenate([[round(60e3 * start)], before])) / 1e3
    return Timeline(before / 1e3, dt, np.isin(before, list(seen)), np.isin(before, list(burns)))


def pressure(spec: Specification) -> float:
    """Acceleration by solar radiation at 1 AU, m/s^2, as it is told."""
    return SOLAR_PRESSURE * spec.probe.reflectivity * spec.probe.area_to_mass_m2_kg


def nominal_start(spec: Specification) -> np.ndarray:
    """[r, v, R, V] (12,) at the start, of the orbits that meet at the aim: integrated backward from there by scipy's DOP853,
    which is not the method of truth and filters.

    Raises ValueError where the integration fails.
    """
    from scipy.integrate import solve_ivp

    e = spec.encounter
    sun = np.array(e.sun_direction) / np.linalg.norm(e.sun_direction)
    T, V = -sun * e.sun_distance_au * AU, np.array(e.body_velocity_km_s) * KM
    a = pressure(spec) * AU**2 - MU_SUN

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        P, T = y[:3], y[6:9]
        return np.concatenate([y[3:6], a * P / np.linalg.norm(P) ** 3, y[9:], -MU_SUN * T / np.linalg.norm(T) ** 3])

    y = np.concatenate([T + np.array(e.aim_km) * KM, V + np.array(e.velocity_km_s) * KM, T, V])
    found = solve_ivp(rate, (0.0, -3600.0 * spec.frames.from_h[0]), y, "DOP853", rtol=1e-13, atol=1e-4)
    if not found.success:
        raise ValueError(f"the orbits before the encounter could not be integrated: {found.message}")
    P, vP, T, vT = np.split(found.y[:, -1], 4)
    return np.concatenate([P - T, vP - vT, T, vT])


def start_factor(spec: Specification) -> np.ndarray:
    """L (14, 14): errors of the state at the start are L z with z standard normal, P0 = L L^T.

    What is independent is the body's orbit and the probe's; the relative orbit is their difference.
    """
    body = np.concatenate([np.array(spec.ephemeris.position_km) * KM, spec.ephemeris.velocity_m_s])
    probe = np.concatenate([np.array(spec.probe.position_km) * KM, spec.probe.velocity_m_s])
    L = np.zeros((14, 14))
    L[:6, :6], L[:6, 6:12] = -np.diag(body), np.diag(probe)
    L[6:12, :6] = np.diag(body)
    L[12, 12], L[13, 13] = spec.probe.radiation_error, spec.camera.centre_error_km * KM
    return L


@pytree
class Draws:
    """Standard normal numbers of one run: start (14,), course (3,), noise (epochs, 14) (motion 6, pixel and line 2, attitude 3,
    burn 3); run: its number."""

    start: Array
    course: Array
    noise: Array
    run: Array


@pytree
class Setting:
    """seed; epochs (n,): 1, 2, .. n."""

    seed: Array
    epochs: Array


def _draw(s: Setting, run: Array) -> Draws:
    noise = jax.vmap(lambda k: jax.random.normal(key_of(s.seed, run, k, NOISE), (14,)))(s.epochs)
    start = jax.random.normal(key_of(s.seed, run, 0, START), (17,))
    return Draws(start[:14], start[14:], noise, run)


@jax.jit
def simulate(setting: Setting, run_ids: Array) -> Draws:
    """Random numbers of the runs with these numbers."""
    return jax.vmap(partial(_draw, setting))(run_ids)
