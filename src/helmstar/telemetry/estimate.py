"""Attitude and gyro drift of a whole record: start, filter forward, smooth backward, in chunks of one compiled size.

Memory is bounded: the forward pass keeps the belief at the start of each chunk and the numbers that are reported; the
backward pass filters each chunk again from there and smooths it. A padded step has no length and no measurement, which
leaves the belief as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from ..attitude import continuous
from ..backend import jax, jnp
from ..core import GATED, REOPENED, RESET, Gate, Gaussian, Measurement, Model, no_gate
from ..filters import ErrorStateKalmanFilter, ResettableBelief, ResettingFilter, RestartFromAttitude, run, smooth
from ..geometry import so3_left
from ..geometry.retraction import euclidean, product
from ..models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model, whole_attitude
from ..models.attitude_rate import AttitudeRateDrift, RateNoise, attitude_rate_model, gyro_rate
from ..models.calibration import AttitudeCalibration, calibration_model
from ..models.sensors import unit_star_directions
from .noise import NoiseLevels
from .timeline import Epochs, Timeline

Array = jax.Array
CHUNK = 1024
"""Steps of one compiled call."""
SIX = np.arange(6)
RATED_SIX = np.array([0, 1, 2, 6, 7, 8])
LEAST_SIGMA = 1e-12
"""Of a state that is held fixed (rad, or a ratio): no variance at all would make its covariance singular."""
States = Literal["drift", "calibration", "rate"]


@dataclass(frozen=True)
class Design:
    """Which states are estimated and how: attitude and drift; with them misalignment and scale factors, of prior sigma
    `calibration` (6,), of which those `considered` are not estimated but count as uncertainty; or with them the rate, of
    random walk `rate_sigma` rad/s/sqrt(s), the gyro being a sensor. `restart`: sigma of the drift (rad/s) after a second
    restart, None for a gate that opens instead. `commanded`: rates of gaps have no drift."""

    states: States = "drift"
    calibration: np.ndarray | None = None
    considered: tuple[int, ...] = ()
    rate_sigma: float = 0.0
    restart: float | None = None
    commanded: bool = False

    @property
    def filter(self) -> Any:
        """Of its kind; equal designs have equal ones."""
        cls = {"drift": AttitudeDrift, "calibration": AttitudeCalibration, "rate": AttitudeRateDrift}[self.states]
        beside = {"drift": 1, "calibration": 3, "rate": 2}[self.states]
        constant = tuple(range(6, 12)) if self.states == "calibration" else ()
        inner = ErrorStateKalmanFilter(
            product(cls, so3_left, *[euclidean(3)] * beside), constant=constant, considered=self._considered
        )
        return inner if self.restart is None else ResettingFilter(inner, RestartFromAttitude())

    @property
    def _considered(self) -> tuple[int, ...]:
        return tuple(6 + i for i in self.considered)

    @property
    def six(self) -> np.ndarray:
        """Where attitude and drift are among the errors."""
        return RATED_SIX if self.states == "rate" else SIX


@dataclass(frozen=True)
class Start:
    """Belief at the timeline's first instant: q_BN (4,), attitude covariance (3, 3), drift (3,) rad/s, its sigma (3,).

    measured_at: rate (3,) rad/s in B at which the drift was told by attitudes minus gyro, which takes what misalignment and
    scale factors do at that rate for drift; None for a drift that is known from elsewhere."""

    q_BN: np.ndarray
    attitude_cov: np.ndarray
    drift: np.ndarray
    drift_sigma: np.ndarray
    measured_at: np.ndarray | None = None


@dataclass(frozen=True)
class Estimates:
    """At each instant of the timeline: q_BN (n, 4), drift (n, 3) rad/s, cov (n, 6, 6) in rad and rad/s, axes of B; where they
    are estimated, misalignment (rad) and scale factors (n, 6), and their sigma (n, 6); where the rate is a state, that rate
    (n, 3) rad/s in B and its sigma (n, 3)."""

    q_BN: np.ndarray
    drift: np.ndarray
    cov: np.ndarray
    calibration: np.ndarray | None = None
    calibration_sigma: np.ndarray | None = None
    rate: np.ndarray | None = None
    rate_sigma: np.ndarray | None = None


@dataclass(frozen=True)
class Updates:
    """Of each epoch of the timeline after the first: index (k,) into the timeline, nis, dof, status, residual (k, 3) in rad
    in B (NaN for a single star direction), its sigma (k, 3). gyro_refused: steps whose gyro reading the gate refused, where
    the gyro is a sensor."""

    index: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    status: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray
    gyro_refused: int = 0


def model_of(levels: NoiseLevels, directions: bool, design: Design) -> Model:
    """The design's model with whole attitudes and, where an epoch has nothing else, single star directions."""
    sensors = (whole_attitude(), unit_star_directions(levels.sigma)) if directions else (whole_attitude(),)
    noise = GyroNoise(jnp.asarray(levels.sigma_v), jnp.asarray(levels.sigma_u))
    if design.states == "calibration":
        return calibration_model(noise, sensors)
    if design.states == "rate":
        rates = RateNoise(jnp.asarray(design.rate_sigma), jnp.asarray(levels.sigma_u))
        return attitude_rate_model(rates, sensors=(gyro_rate(), *sensors))
    return attitude_drift_model(noise, sensors=sensors)


@partial(jax.jit, static_argnames=("filter",))
def _forward(
    filter: Any, model: Model, belief: Any, refused: Array, u: GyroInput, dt: Array, m: tuple[Measurement, ...],
    gate: Gate,
) -> Any:  # fmt: skip
    return run(filter, model, belief, u, dt, m, gate, refused)


@partial(jax.jit, static_argnames=("filter",))
def _backward(filter: Any, begin: Any, track: Any, later: Gaussian) -> Gaussian:
    """Smoothed beliefs at the begin of a chunk and after each of its steps; `later` is the one at its end."""
    front = lambda a, b: jnp.concatenate([a[None], b])
    filtered = Gaussian(jax.tree.map(front, begin.mean, track.belief.mean), front(begin.cov, track.belief.cov))
    predicted = jax.tree.map(lambda a: front(a[0], a), track.predicted)  # the first one is not looked at
    breaks = None
    if isinstance(filter, ResettingFilter):
        anew = [info.status == RESET for info in track.infos]
        breaks = front(jnp.asarray(False), jnp.any(jnp.stack(anew), axis=0))
    inner: Any = filter.inner if isinstance(filter, ResettingFilter) else filter
    return smooth(filter.retraction, filtered, predicted, later, breaks, inner.considered)


class Record:
    """A timeline with its measurements, cut into padded chunks; `used` (m,) says which epochs enter."""

    def __init__(
        self, timeline: Timeline, epochs: Epochs, levels: NoiseLevels, used: np.ndarray, design: Design | None = None
    ):
        self.timeline, self.epochs, self.levels = timeline, epochs, levels
        self.design = design or Design()
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
        lost = np.pad(t.lost[a:b], (0, pad))
        if self.design.states == "rate":
            # Of a step that is no length at all there is no rate.
            cov = self.levels.sigma_v**2 / np.maximum(dt, 1e-9)[:, None, None] * np.eye(3)
            there = (~lost & (dt > 0.0))[:, None]
            m = (Measurement(jnp.asarray(rate), jnp.asarray(cov), jnp.asarray(there)), *m)
        drifts = jnp.asarray(np.where(lost, 0.0, 1.0)) if self.design.commanded else None
        return GyroInput(jnp.asarray(rate), jnp.asarray(extra), drifts), jnp.asarray(dt), m

    def length(self, i: int) -> int:
        """Real steps of chunk i."""
        return min(CHUNK, self.steps - i * CHUNK)


def initial_belief(start: Start, design: Design, rate: np.ndarray) -> Any:
    """The filter's belief at the first instant; `rate` (3,) is the body's then, for designs that have it as a state."""
    q, b = jnp.asarray(start.q_BN), jnp.asarray(start.drift)
    variances = [start.drift_sigma**2]
    mean: Any = AttitudeDrift(q, b)
    if design.states == "calibration":
        mean = AttitudeCalibration(q, b, jnp.zeros(3), jnp.zeros(3))
        sigma = np.zeros(6) if design.calibration is None else design.calibration
        variances.append(np.maximum(sigma, LEAST_SIGMA) ** 2)
    elif design.states == "rate":
        mean = AttitudeRateDrift(q, jnp.asarray(rate - start.drift), b)
        variances.insert(0, start.drift_sigma**2 + design.rate_sigma**2)
    beside = np.concatenate(variances)
    P = np.zeros((3 + len(beside),) * 2)
    P[:3, :3], P[3:, 3:] = start.attitude_cov, np.diag(beside)
    if design.states == "calibration" and start.measured_at is not None:
        # What the two attitudes told is b + A x, with x misalignment and scale factors.
        A, X = confused_with_drift(start.measured_at), P[6:, 6:]
        P[3:6, 3:6] += A @ X @ A.T
        P[3:6, 6:], P[6:, 3:6] = -A @ X, -(A @ X).T
    if design.restart is None:
        return Gaussian(mean, jnp.asarray(P))
    fresh = beside.copy()
    fresh[(3 if design.states == "rate" else 0) :][:3] = design.restart**2
    return ResettableBelief(mean, jnp.asarray(P), jnp.asarray(np.diag(fresh)), jnp.asarray(0))


def confused_with_drift(rate: np.ndarray) -> np.ndarray:
    """A (3, 6): at a constant rate (3,) in B misalignment and scale factors x look like the drift A x, A = [-[w x], diag w]."""
    x, y, z = rate
    return np.concatenate([-np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), np.diag(rate)], axis=1)


@dataclass(frozen=True)
class _FixedMean:
    """A filter that learns how well it could know, and nothing else: covariances along the prediction alone. An estimate
    that moves would move the linearisation, and seem to know what it does not."""

    inner: ErrorStateKalmanFilter

    @property
    def retraction(self) -> Any:
        """The inner filter's."""
        return self.inner.retraction

    def predict(self, belief: Any, process: Any, u: Any, dt: Array) -> Any:
        """The inner filter's."""
        return self.inner.predict(belief, process, u, dt)

    def update(self, belief: Any, sensor: Any, m: Measurement, gate: Gate, refused: Array) -> Any:
        """The inner filter's covariance, at the mean that was predicted."""
        b, info = self.inner.update(belief, sensor, m, gate, refused)
        return Gaussian(belief.mean, b.cov), info


def final_sigma(record: Record, start: Start) -> np.ndarray:
    """1 sigma (dim,) of every state at the record's end that the record allows: the bound, at the rates that were measured
    and at the start's attitude, drift and calibration throughout."""
    gate = no_gate()
    model = model_of(record.levels, record.single, record.design)
    filter = _FixedMean(ErrorStateKalmanFilter(model.retraction, carry="none"))
    belief = initial_belief(start, replace(record.design, restart=None), record.timeline.rate[0])
    refused = jnp.zeros(len(model.sensors), dtype=int)
    for i in range(record.chunks):
        u, dt, m = record.chunk(i)
        belief, refused, _ = _forward(filter, model, belief, refused, u, dt, m, gate)
    return np.sqrt(np.maximum(np.diagonal(np.asarray(belief.cov)), 0.0))


def filter_and_smooth(
    record: Record, start: Start, gate: Gate, advance: Callable[[], None] = lambda: None
) -> tuple[Estimates, Estimates, Updates]:
    """Filtered and smoothed estimates at every instant of the timeline, and what became of every epoch.

    `advance` is called after each chunk of both passes (2 * record.chunks times).
    """
    design = record.design
    model, filter = model_of(record.levels, record.single, design), design.filter
    belief = initial_belief(start, design, record.timeline.rate[0])
    refused = jnp.zeros(len(model.sensors), dtype=int)
    begins, kept, infos, gyro_refused = [], [_first(belief, design)], [], 0
    for i in range(record.chunks):
        begins.append((belief, refused))
        u, dt, m = record.chunk(i)
        belief, refused, track = _forward(filter, model, belief, refused, u, dt, m, gate)
        n = record.length(i)
        kept.append(_numbers(track.belief, n, design))
        if design.states == "rate":
            status = np.asarray(track.infos[0].status)[:n]
            gyro_refused += int(np.sum((status == GATED) | (status == REOPENED)))
        infos.append(_info(track.infos[1 if design.states == "rate" else 0 :], n))
        advance()
    filtered = _joined(kept, design)
    smoothed = _smooth(record, model, begins, belief, gate, advance)
    return filtered, smoothed, replace(_updates(record, infos), gyro_refused=gyro_refused)


def _smooth(
    record: Record, model: Model, begins: list, end: Gaussian, gate: Gate, advance: Callable[[], None]
) -> Estimates:
    design, filter = record.design, record.design.filter
    later, parts = Gaussian(end.mean, end.cov), []
    for i in reversed(range(record.chunks)):
        belief, refused = begins[i]
        u, dt, m = record.chunk(i)
        _, _, track = _forward(filter, model, belief, refused, u, dt, m, gate)
        smoothed = _backward(filter, belief, track, later)
        parts.append(tuple(a[1:] for a in _numbers(smoothed, record.length(i) + 1, design)))
        later = Gaussian(jax.tree.map(lambda a: a[0], smoothed.mean), smoothed.cov[0])
        advance()
    parts.append(_first(later, design))
    return _joined(parts[::-1], design)


Numbers = tuple[np.ndarray, ...]
"""Attitude, drift, the covariance of these, and of a calibration its six numbers or of a rate its three, and their sigma."""


def _numbers(belief: Any, n: int, design: Design) -> Numbers:
    P = np.asarray(belief.cov)[:n]
    out = (np.asarray(belief.mean.q_BN)[:n], np.asarray(belief.mean.b)[:n], P[:, design.six][:, :, design.six])
    if design.states == "drift":
        return out
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    if design.states == "rate":
        return (*out, np.asarray(belief.mean.omega)[:n], sigma[:, 3:6])
    found = np.concatenate([np.asarray(belief.mean.misalignment)[:n], np.asarray(belief.mean.scale)[:n]], axis=1)
    return (*out, found, sigma[:, 6:])


def _first(belief: Any, design: Design) -> Numbers:
    return _numbers(jax.tree.map(lambda a: jnp.asarray(a)[None], belief), 1, design)


def _joined(parts: list[Numbers], design: Design) -> Estimates:
    q, drift, cov, *beside = (np.concatenate(x) for x in zip(*parts, strict=True))
    names = {"drift": (), "calibration": ("calibration", "calibration_sigma"), "rate": ("rate", "rate_sigma")}
    return Estimates(continuous(q), drift, cov, **dict(zip(names[design.states], beside, strict=True)))


def log_likelihood(record: Record, start: Start, limit: float) -> float:
    """Log likelihood of the whole attitudes by the filter's innovations, each NIS cut at `limit`, so that an outlier counts no more
    than the gate would take it for."""
    model, filter = model_of(record.levels, record.single, record.design), record.design.filter
    belief = initial_belief(start, record.design, record.timeline.rate[0])
    refused, gate, total = jnp.zeros(len(model.sensors), dtype=int), no_gate(), 0.0
    for i in range(record.chunks):
        u, dt, m = record.chunk(i)
        belief, refused, track = _forward(filter, model, belief, refused, u, dt, m, gate)
        info = track.infos[1 if record.design.states == "rate" else 0]
        used = np.asarray(info.dof)[: record.length(i)] > 0
        log_det = np.linalg.slogdet(np.asarray(info.S)[: record.length(i)])[1]
        nis = np.asarray(info.nis)[: record.length(i)]
        total -= 0.5 * float(np.sum(np.where(used, np.minimum(nis, limit) + log_det, 0.0)))
    return total


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
