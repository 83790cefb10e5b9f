"""Attitude and gyro drift of a whole record: start, filter forward, smooth backward, in chunks of one compiled size.

Memory is bounded: the forward pass keeps the belief at the start of each chunk and the numbers that are reported; the
backward pass filters each chunk again from there and smooths it. A padded step has no length and no measurement, which
leaves the belief as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..attitude import continuous
from ..backend import jax, jnp
from ..core import Gate, Gaussian, Measurement, Model
from ..filters import ErrorStateKalmanFilter, run, smooth
from ..geometry import so3_left
from ..geometry.retraction import euclidean, product
from ..models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model, whole_attitude
from ..models.sensors import unit_star_directions
from .noise import NoiseLevels
from .timeline import Epochs, Timeline

Array = jax.Array
CHUNK = 1024
"""Steps of one compiled call."""
RETRACTION = product(AttitudeDrift, so3_left, euclidean(3))
FILTER = ErrorStateKalmanFilter(RETRACTION)


@dataclass(frozen=True)
class Start:
    """Belief at the timeline's first instant: q_BN (4,), attitude covariance (3, 3), drift (3,) rad/s, its sigma (3,)."""

    q_BN: np.ndarray
    attitude_cov: np.ndarray
    drift: np.ndarray
    drift_sigma: np.ndarray


@dataclass(frozen=True)
class Estimates:
    """At each instant of the timeline: q_BN (n, 4), drift (n, 3) rad/s, cov (n, 6, 6) in rad and rad/s, axes of B."""

    q_BN: np.ndarray
    drift: np.ndarray
    cov: np.ndarray


@dataclass(frozen=True)
class Updates:
    """Of each epoch of the timeline after the first: index (k,) into the timeline, nis, dof, status, residual (k, 3) in rad
    in B (NaN for a single star direction), its sigma (k, 3)."""

    index: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    status: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray


def model_of(levels: NoiseLevels, directions: bool) -> Model:
    """The 6-state model with whole attitudes and, where an epoch has nothing else, single star directions."""
    sensors = (whole_attitude(), unit_star_directions(levels.sigma)) if directions else (whole_attitude(),)
    return attitude_drift_model(GyroNoise(jnp.asarray(levels.sigma_v), jnp.asarray(levels.sigma_u)), sensors=sensors)


@jax.jit
def _forward(
    model: Model, belief: Gaussian, refused: Array, u: GyroInput, dt: Array, m: tuple[Measurement, ...], gate: Gate
) -> Any:
    return run(FILTER, model, belief, u, dt, m, gate, refused)


@jax.jit
def _backward(begin: Gaussian, track: Any, later: Gaussian) -> Gaussian:
    """Smoothed beliefs at the begin of a chunk and after each of its steps; `later` is the one at its end."""
    front = lambda a, b: jnp.concatenate([a[None], b])  # noqa: E731
    filtered = Gaussian(jax.tree.map(front, begin.mean, track.belief.mean), front(begin.cov, track.belief.cov))
    predicted = jax.tree.map(lambda a: front(a[0], a), track.predicted)  # the first one is not looked at
    return smooth(RETRACTION, filtered, predicted, later)


class Record:
    """A timeline with its measurements, cut into padded chunks; `used` (m,) says which epochs enter."""

    def __init__(self, timeline: Timeline, epochs: Epochs, levels: NoiseLevels, used: np.ndarray):
        self.timeline, self.epochs, self.levels = timeline, epochs, levels
        self.steps = len(timeline.time) - 1
        self.chunks = max(1, -(-self.steps // CHUNK))
        self.used = used
        self.single = bool(np.any(~epochs.solved & used))

    def chunk(self, i: int) -> tuple[GyroInput, Array, tuple[Measurement, ...]]:
        """Inputs, step lengths and measurements of chunk i."""
        a, b = i * CHUNK, min((i + 1) * CHUNK, self.steps)
        t = self.timeline
        pad = CHUNK - (b - a)
        dt = np.pad(np.diff(t.time[a : b + 1]), (0, pad))
        rate = np.pad(t.rate[a:b], ((0, pad), (0, 0)))
        extra = np.pad(t.extra[a:b], ((0, pad), (0, 0)))[:, :, None] * np.eye(3)
        number = np.pad(t.epoch[a + 1 : b + 1], (0, pad), constant_values=-1)
        e, j = self.epochs, np.maximum(number, 0)
        present = (number >= 0) & self.used[j]
        solved = e.solved[j]
        R = e.shape[j] * self.levels.sigma**2
        m = (Measurement(jnp.asarray(e.q_BN[j]), jnp.asarray(R), jnp.asarray((present & solved)[:, None])),)
        if self.single and e.star_B is not None and e.star_N is not None:
            star_B, star_N = jnp.asarray(e.star_B[j][:, None]), jnp.asarray(e.star_N[j][:, None])
            m = (*m, Measurement(star_B, star_N, jnp.asarray((present & ~solved)[:, None])))
        return GyroInput(jnp.asarray(rate), jnp.asarray(extra)), jnp.asarray(dt), m

    def length(self, i: int) -> int:
        """Real steps of chunk i."""
        return min(CHUNK, self.steps - i * CHUNK)


def initial_belief(start: Start) -> Gaussian:
    """The filter's belief at the first instant."""
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = start.attitude_cov, np.diag(start.drift_sigma**2)
    return Gaussian(AttitudeDrift(jnp.asarray(start.q_BN), jnp.asarray(start.drift)), jnp.asarray(P))


def filter_and_smooth(
    record: Record, start: Start, gate: Gate, advance: Callable[[], None] = lambda: None
) -> tuple[Estimates, Estimates, Updates]:
    """Filtered and smoothed estimates at every instant of the timeline, and what became of every epoch.

    `advance` is called after each chunk of both passes (2 * record.chunks times).
    """
    model = model_of(record.levels, record.single)
    belief, refused = initial_belief(start), jnp.zeros(len(model.sensors), dtype=int)
    begins, kept, infos = [], [_first(belief)], []
    for i in range(record.chunks):
        begins.append((belief, refused))
        u, dt, m = record.chunk(i)
        belief, refused, track = _forward(model, belief, refused, u, dt, m, gate)
        n = record.length(i)
        kept.append(_numbers(track.belief, n))
        infos.append(_info(track.infos, n))
        advance()
    filtered = _joined(kept)
    smoothed = _smooth(record, model, begins, belief, gate, advance)
    return filtered, smoothed, _updates(record, infos)


def _smooth(
    record: Record, model: Model, begins: list, end: Gaussian, gate: Gate, advance: Callable[[], None]
) -> Estimates:
    later, parts = end, []
    for i in reversed(range(record.chunks)):
        belief, refused = begins[i]
        u, dt, m = record.chunk(i)
        _, _, track = _forward(model, belief, refused, u, dt, m, gate)
        smoothed = _backward(belief, track, later)
        q, b, P = _numbers(smoothed, record.length(i) + 1)
        parts.append((q[1:], b[1:], P[1:]))
        later = Gaussian(jax.tree.map(lambda a: a[0], smoothed.mean), smoothed.cov[0])
        advance()
    parts.append(_first(later))
    return _joined(parts[::-1])


def _numbers(belief: Any, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(belief.mean.q_BN)[:n], np.asarray(belief.mean.b)[:n], np.asarray(belief.cov)[:n]


def _first(belief: Gaussian) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(belief.mean.q_BN)[None], np.asarray(belief.mean.b)[None], np.asarray(belief.cov)[None]


def _joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Estimates:
    q, b, P = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Estimates(continuous(q), b, P)


def _info(infos: tuple[Any, ...], n: int) -> tuple[np.ndarray, ...]:
    """nis, dof, status, residual and its sigma of each step by the sensor that has a measurement there."""
    whole = infos[0]
    S = np.asarray(whole.S)[:n]
    sigma = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), 0.0))
    out = [np.asarray(a)[:n] for a in (whole.nis, whole.dof, whole.status, whole.residual)] + [sigma]
    for single in infos[1:]:
        here = np.asarray(single.dof)[:n] > 0
        for k, name in enumerate(("nis", "dof", "status")):
            out[k] = np.where(here, np.asarray(getattr(single, name))[:n], out[k])
        out[3], out[4] = (np.where(here[:, None], np.nan, a) for a in out[3:])
    return tuple(out)


def _updates(record: Record, infos: list[tuple[np.ndarray, ...]]) -> Updates:
    nis, dof, status, residual, sigma = (np.concatenate(x) for x in zip(*infos, strict=True))
    at = np.flatnonzero(dof > 0)
    return Updates(at + 1, nis[at], dof[at], status[at], residual[at], sigma[at])
