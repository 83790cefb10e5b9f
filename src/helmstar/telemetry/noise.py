"""Noise that a configuration does not state, from the data themselves: maximum likelihood over innovations.

The gyro is integrated from epoch to epoch of the stars, and the same 6-state filter runs over epochs for many candidates
at once; the likelihood of its innovations chooses. First with a Student likelihood that a few outliers cannot move, then,
with the epochs that the gate refuses left out, with the Gaussian one: so what the gate accepts is consistent.

Two stretches are looked at where a record is long: its first epochs, which tell the star tracker from the gyro, and
epochs far apart over all of it, which tell the walk of the drift.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..core import ABSENT, ACCEPTED, Gate, Gaussian, Measurement
from ..errors import DataError
from ..filters import ErrorStateKalmanFilter, run
from ..geometry import quaternion, so3
from ..models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model, whole_attitude

Array = jax.Array
EPOCHS = 512
"""Intervals of one stretch, the padded length of the one compiled program."""
BATCH = 64
STUDENT = 4.0
ENOUGH = 8
"""Intervals from which on the likelihood is asked."""
NAMES = ("sigma_v", "sigma_u", "sigma")
SMALLEST = 1e-10
"""Scatter in rad below which data are as exact as their digits."""


@dataclass(frozen=True)
class Intervals:
    """From epoch to epoch: q_BN (m + 1, 4) measured; shape (m + 1, 3, 3) of their covariance per sigma^2; turn (m, 3): rotation
    vector phi with R_BN(k+1) = exp(-[phi x]) R_BN(k) by the gyro less a drift; duration (m,) s; extra (m, 3) rad^2; good
    (m + 1,): which epochs to use, the first among them."""

    q_BN: np.ndarray
    shape: np.ndarray
    turn: np.ndarray
    duration: np.ndarray
    extra: np.ndarray
    good: np.ndarray

    def __len__(self) -> int:
        return len(self.duration)


@dataclass(frozen=True)
class NoiseLevels:
    """sigma_v in rad/sqrt(s), sigma_u in rad/s/sqrt(s), and sigma, the factor of the stars' covariance shape (rad, or 1 when
    the shape is in rad^2 already). `uncertainty`: relative 1 sigma of those that were estimated, NaN where the data do not
    tell it."""

    sigma_v: float
    sigma_u: float
    sigma: float
    uncertainty: dict[str, float]


@jax.jit
def _innovations(levels: Array, data: dict[str, Array], gate: Gate) -> tuple[Array, Array, Array]:
    """For levels (batch, 3): NIS, log det S and status (batch, m) of each epoch after the first."""

    def one(level: Array) -> tuple[Array, Array, Array]:
        v, u, s = level
        model = attitude_drift_model(GyroNoise(v, u), sensors=(whole_attitude(),))
        duration = data["duration"]
        rate = data["turn"] / jnp.where(duration > 0, duration, 1.0)[:, None]
        R = data["shape"] * s**2
        m = Measurement(data["q_BN"][1:], R[1:], data["mask"][:, None])
        P0 = jnp.zeros((6, 6)).at[:3, :3].set(R[0]).at[3:, 3:].set(data["drift_var"] * jnp.eye(3))
        belief = Gaussian(AttitudeDrift(data["q_BN"][0], jnp.zeros(3)), P0)
        inputs = GyroInput(rate, data["extra"][:, :, None] * jnp.eye(3))
        filter = ErrorStateKalmanFilter(model.retraction)
        return run(filter, model, belief, inputs, duration, (m,), gate, keep=_keep)[2]

    return jax.vmap(one)(levels)


def _keep(belief: Any, predicted: Any, infos: Any) -> tuple[Array, Array, Array]:
    i = infos[0]
    return i.nis, -2.0 * (i.loglik + 0.5 * i.nis + 0.5 * i.dof * jnp.log(2.0 * jnp.pi)), i.status


def _gaussian(nis: np.ndarray, log_det: np.ndarray, variance: float | np.ndarray = 1.0) -> np.ndarray:
    """Log likelihood (..., m) of three-dimensional innovations whose covariances are S times `variance`."""
    return -0.5 * (log_det + 3.0 * np.log(variance) + nis / variance)


def _student(nis: np.ndarray, log_det: np.ndarray, variance: float | np.ndarray = 1.0) -> np.ndarray:
    """The same by Student's distribution."""
    return -0.5 * (log_det + 3.0 * np.log(variance) + (STUDENT + 3.0) * np.log1p(nis / variance / STUDENT))


def rough_levels(intervals: Intervals, known: dict[str, float]) -> NoiseLevels:
    """Levels by the scatter of the intervals: all of it given to the stars and to the gyro alike, no walk of the drift.

    Raises DataError where nothing is redundant.
    """
    unknown = [n for n in ("sigma_v", "sigma") if n not in known]
    if unknown and len(intervals) < 2:
        raise DataError(
            "two attitudes alone do not tell how noisy they are; state the noise in sensors.toml: [gyro] "
            "arw_arcsec_sqrt_s and [star] sigma_arcsec"
        )
    scatter, T = _scatter(intervals), float(np.median(intervals.duration))
    mean_shape = float(np.mean(np.trace(intervals.shape, axis1=1, axis2=2)) / 3.0)
    guess = {"sigma_v": scatter / np.sqrt(T), "sigma_u": 0.0, "sigma": scatter / np.sqrt(mean_shape)}
    levels = guess | known
    return NoiseLevels(levels["sigma_v"], levels["sigma_u"], levels["sigma"], dict.fromkeys(unknown, np.nan))


def _scatter(x: Intervals) -> float:
    """Robust standard deviation (rad) of gyro against stars over one interval, about the common drift."""
    e = _differences(x)
    e = e - np.median(e / x.duration[:, None], axis=0) * x.duration[:, None]
    if len(e) >= ENOUGH:
        return max(1.4826 * float(np.median(np.abs(e))), SMALLEST)
    return max(float(np.sqrt(np.sum(e**2) / (3.0 * max(len(e) - 1, 1)))), SMALLEST)


def _differences(x: Intervals) -> np.ndarray:
    """Measured minus predicted attitude (m, 3) at the end of each interval, rad in B."""
    predicted = quaternion.multiply(quaternion.exp(-jnp.asarray(x.turn)), jnp.asarray(x.q_BN[:-1]))
    return np.asarray(quaternion.log(quaternion.multiply(jnp.asarray(x.q_BN[1:]), quaternion.conjugate(predicted))))


def estimate_noise(
    stretches: Sequence[Intervals], known: dict[str, float], gate: Gate, misfit: tuple[float, float] = (0.0, 0.0)
) -> NoiseLevels:
    """Levels of maximum likelihood; those in `known` ("sigma_v", "sigma_u", "sigma") are kept as they are.

    Of each stretch the first EPOCHS intervals are used. `misfit`: sum of squares by which star directions miss their
    epochs' solutions, and its degrees of freedom. With too few intervals to tell, the levels are `rough_levels`.
    """
    names = [n for n in NAMES if n not in known]
    if not names:
        return NoiseLevels(known["sigma_v"], known["sigma_u"], known["sigma"], {})
    first = stretches[0]
    rough = rough_levels(first, known)
    if len(first) < ENOUGH:
        return rough
    likelihood = _Likelihood([_padded(x) for x in stretches], known, names, misfit)
    scatter, T = _scatter(first), float(np.median(first.duration))
    total = max(float(x.duration.sum()) for x in stretches)
    mean_shape = float(np.mean(np.trace(first.shape, axis1=1, axis2=2)) / 3.0)
    box = {
        "sigma_v": scatter / np.sqrt(T) * np.array([1e-4, 3.0]),
        "sigma_u": scatter * np.array([0.03 / total**1.5, 3.0 / T**1.5]),
        "sigma": scatter / np.sqrt(mean_shape) * np.array([1e-4, 3.0]),
    }
    bounds = np.log(np.array([box[n] for n in names]))
    if len(names) == 3:  # the scale follows from the innovations, so that two ratios are left to search
        at = _search(likelihood.best_scale, bounds[:2] - bounds[2].mean(), 16)
        at = likelihood.with_scale(at)
    else:
        at = _search(lambda p: likelihood(p, _student), bounds, 64 if len(names) == 1 else 16)
    at, _ = _parabola(lambda p: likelihood(p, _student), at, 0.4, bounds)
    likelihood.leave_out(at, gate)
    hessian = np.empty((0, 0))
    for size in (0.6, 0.3, 0.15):
        at, hessian = _parabola(lambda p: likelihood(p, _gaussian), at, size, bounds)
    found = dict(zip(names, np.exp(at), strict=True)) | known
    uncertainty = {n: float(v) for n, v in zip(names, _uncertainty(hessian), strict=True)}
    return NoiseLevels(*(float(found[n]) for n in NAMES), uncertainty)


class _Likelihood:
    """Log likelihoods of points (n, k) in the logarithms of the unknown levels, over all stretches."""

    def __init__(
        self, data: list[dict[str, Array]], known: dict[str, float], names: list[str], misfit: tuple[float, float]
    ):
        self._data, self._known, self._names, self._misfit = data, known, names, misfit
        self._open = Gate(limits=jnp.full((9,), jnp.inf), reopen_after=jnp.asarray(0))

    def __call__(self, points: np.ndarray, kind: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Log likelihood (n,) by `_gaussian` or `_student`; -inf where it is not finite."""
        levels = self._levels(points)
        total, dof = self._misfit
        value = -dof * np.log(levels[:, 2]) - 0.5 * total / levels[:, 2] ** 2
        for nis, log_det, used in self._runs(levels):
            value += np.sum(np.where(used, kind(nis, log_det), 0.0), axis=1)
        return np.where(np.isfinite(value), value, -np.inf)

    def best_scale(self, ratios: np.ndarray) -> np.ndarray:
        """Student log likelihood (n,) of ratios to sigma (n, 2), in logarithms, at the best scale each. The little that
        does not scale (the variance in gaps) is left to what follows."""
        return self._scaled(ratios)[1]

    def with_scale(self, ratios: np.ndarray) -> np.ndarray:
        """The point (3,) of two ratios, with its scale."""
        return np.append(ratios, 0.0) + 0.5 * np.log(self._scaled(ratios[None])[0][0])

    def _scaled(self, ratios: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        runs = list(self._runs(np.exp(np.column_stack([ratios, np.zeros(len(ratios))]))))
        nis, log_det, used = (np.concatenate(x, axis=1) for x in zip(*runs, strict=True))
        count = np.maximum(used.sum(axis=1, keepdims=True), 1)
        variance = np.nanmedian(np.where(used, nis, np.nan), axis=1, keepdims=True) / 2.366
        for _ in range(12):
            weight = (STUDENT + 3.0) / (STUDENT + nis / variance)
            variance = np.sum(np.where(used, weight * nis, 0.0), axis=1, keepdims=True) / (3.0 * count)
        value = np.sum(np.where(used, _student(nis, log_det, variance), 0.0), axis=1)
        return variance[:, 0], np.where(np.isfinite(value), value, -np.inf)

    def _runs(self, levels: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """NIS, log det S and which were used (n, m), for each stretch."""
        n = len(levels)
        levels = np.concatenate([levels, np.repeat(levels[-1:], -n % BATCH, axis=0)])
        for data in self._data:
            parts = [
                _innovations(jnp.asarray(levels[i : i + BATCH]), data, self._open) for i in range(0, len(levels), BATCH)
            ]
            nis, log_det, status = (np.concatenate([np.asarray(a) for a in x])[:n] for x in zip(*parts, strict=True))
            yield nis, log_det, status != ABSENT

    def _levels(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) in the order of NAMES."""
        return np.stack(
            [
                np.exp(points[:, self._names.index(n)]) if n in self._names else np.full(len(points), self._known[n])
                for n in NAMES
            ],
            axis=1,
        )

    def leave_out(self, at: np.ndarray, gate: Gate) -> None:
        """From here on without the epochs that the gate refuses at this point, unless they are too many to be outliers."""
        levels = jnp.asarray(self._levels(np.repeat(at[None], BATCH, axis=0)))
        for i, data in enumerate(self._data):
            refused = np.asarray(_innovations(levels, data, gate)[2])[0] > ACCEPTED
            if refused.mean() < 0.2:
                self._data[i] = data | {"mask": data["mask"] & ~jnp.asarray(refused)}


def _padded(x: Intervals) -> dict[str, Array]:
    """Arrays of EPOCHS intervals."""
    m = min(len(x), EPOCHS)

    def pad(a: np.ndarray, n: int) -> Array:
        return jnp.asarray(np.concatenate([a, np.repeat(a[-1:], n - len(a), axis=0)]))

    e = np.abs(_differences(x)[:m])
    T = x.duration[:m]
    mask = np.zeros(EPOCHS, dtype=bool)
    mask[:m] = x.good[1 : m + 1]
    duration = np.zeros(EPOCHS)
    duration[:m] = T
    drift_sigma = 10.0 * max(float(np.quantile(e / T[:, None], 0.9)), SMALLEST / float(np.median(T)))
    return {
        "q_BN": pad(x.q_BN[: m + 1], EPOCHS + 1),
        "shape": pad(x.shape[: m + 1], EPOCHS + 1),
        "turn": pad(x.turn[:m], EPOCHS),
        "duration": jnp.asarray(duration),
        "extra": pad(x.extra[:m], EPOCHS),
        "mask": jnp.asarray(mask),
        "drift_var": jnp.asarray(drift_sigma**2),
    }


def _search(value: Callable[[np.ndarray], np.ndarray], bounds: np.ndarray, count: int) -> np.ndarray:
    """Point (k,) of about the largest value in a box: a grid of `count` for each unknown, then finer ones around the best."""
    k = len(bounds)
    at, half = bounds.mean(axis=1), 0.5 * np.ptp(bounds, axis=1)
    while np.max(half) > 0.5:
        axes = [np.clip(np.linspace(c - h, c + h, count), *b) for c, h, b in zip(at, half, bounds, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, k)
        at = points[int(np.argmax(value(points)))]
        half, count = half * 3.0 / (count - 1), 64 if k == 1 else 8
    return at


def _parabola(
    value: Callable[[np.ndarray], np.ndarray], at: np.ndarray, size: float, bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The top of a parabola fitted to values within `size` of `at`, or the best of these points if it has no top near; its
    Hessian (k, k)."""
    k, (low, high) = len(at), bounds.T
    offsets = np.random.default_rng(0).uniform(-size, size, size=(BATCH - 1, k))
    points = np.clip(at + np.concatenate([np.zeros((1, k)), offsets]), low, high)
    values = value(points)
    d = (points - at) / size
    pairs = [(i, j) for i in range(k) for j in range(i, k)]
    design = np.column_stack([np.ones(len(d)), d, *(d[:, i] * d[:, j] for i, j in pairs)])
    good = np.isfinite(values)
    if good.sum() < 2 * design.shape[1]:
        return at, np.full((k, k), np.nan)
    fit = np.linalg.lstsq(design[good], values[good], rcond=None)[0]
    hessian = np.zeros((k, k))
    for (i, j), c in zip(pairs, fit[1 + k :], strict=True):
        hessian[i, j] += c
        hessian[j, i] += c
    best = points[int(np.argmax(np.where(good, values, -np.inf)))]
    curvature, axes = np.linalg.eigh(hessian)
    if (curvature < 0.0).all():
        step = -axes @ ((axes.T @ fit[1 : 1 + k]) / curvature)
        if np.max(np.abs(step)) <= 2.0:
            best = np.clip(at + size * step, low, high)
    return best, hessian / size**2


def _uncertainty(hessian: np.ndarray) -> np.ndarray:
    """Relative 1 sigma (k,) of each level by the likelihood's curvature; NaN where it has next to none."""
    out = np.full(len(hessian), np.nan)
    told = np.flatnonzero(np.diagonal(hessian) < -1.0)
    if len(told):
        variance = np.diagonal(np.linalg.pinv(-hessian[np.ix_(told, told)]))
        out[told] = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    return out


@jax.jit
def integrate_gyro(rate: Array, dt: Array, restart: Array, q: Array, J: Array) -> tuple[Array, Array]:
    """Rotation accumulated since the last restart, after each step: q (n, 4) with R_BN = R(q) R_BN(then), and J (n, 3, 3) in s
    through which a constant drift b acts: R_BN = exp([J b x]) R(q) R_BN(then). restart[k] resets before step k; q (4,)
    and J (3, 3) are what was accumulated before."""

    def body(carry, inputs):
        q, J = carry
        w, dt, again = inputs
        q = jnp.where(again, quaternion.identity(), q)
        J = jnp.where(again, jnp.zeros((3, 3)), J)
        phi = -w * dt
        q = quaternion.normalise(quaternion.multiply(quaternion.exp(phi), q))
        J = so3.exp(phi) @ J + so3.left_jacobian(phi) * dt
        return (q, J), (q, J)

    return jax.lax.scan(body, (q, J), (rate, dt, restart))[1]
