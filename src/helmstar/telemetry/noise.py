"""Noise that a configuration does not state, from the data themselves: maximum likelihood over innovations.

On attitudes brought back to one instant by the gyro (`series`) a filter of attitude and drift is linear; it runs for many
candidates at once, and the likelihood of its innovations chooses. First with a Student likelihood that a few outliers
cannot move, then, without the epochs that the gate refuses, with the Gaussian one: so what the gate accepts is consistent.

Of a long record two selections are looked at: blocks of neighbouring epochs all over it, which tell the star tracker from
the gyro, and epochs at equal distances, which tell the walk of the drift.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..backend import jax, jnp
from ..core import Gate
from ..errors import DataError
from ..geometry import small
from .outliers import stand_out
from .series import Series

Array = jax.Array
EPOCHS = 512
"""Intervals of one selection, the padded length of the one compiled program."""
BLOCKS = 8
"""Blocks of neighbours that a long record is sampled in."""
BATCH = 64
STUDENT = 4.0
ENOUGH = 8
"""Intervals from which on the likelihood is asked."""
NAMES = ("sigma_v", "sigma_u", "sigma")
FLAT = 1.0
"""Curvature of a log likelihood by the logarithm of a level, below which the data do not tell the level."""
SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
SMALLEST = 1e-9
"""Scatter in rad (0.0002 arcsec) below which data are as exact as their digits."""


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
    """For levels (n, 3): NIS and log det S (m, n) of each epoch after the first, and whether the gate refuses it.

    State: attitude error theta and drift b, theta' = theta + B b + w, measured y = theta + noise; P = [[Paa, Pab], [Pab^T, Pbb]].
    """
    v2, u2, s2 = (levels[:, i, None, None] ** 2 for i in range(3))
    n, eye = levels.shape[0], jnp.eye(3)

    def body(carry, inputs):
        theta, b, Paa, Pab, Pbb, refused = carry
        y, B, shape, extra, T, present = inputs
        Bt = B.T
        PbbBt = Pbb @ Bt
        cross = Pab @ Bt
        Paa = Paa + cross + small.transpose(cross) + B @ PbbBt + (v2 * T + u2 * T**3 / 3.0) * eye + jnp.diag(extra)
        Pab = Pab + small.transpose(PbbBt) + 0.5 * u2 * T * B
        Pbb = Pbb + u2 * T * eye
        theta = theta + b @ Bt
        R = s2 * shape
        S = Paa + R
        V = small.invert_lower(small.cholesky(S))
        e = jnp.where(present, y - theta, 0.0)
        white = small.matvec(V, e)
        nis = jnp.sum(white**2, axis=-1)
        log_det = -2.0 * jnp.sum(jnp.log(jnp.diagonal(V, axis1=-2, axis2=-1)), axis=-1)
        # As the filter does (filters.ekf judge, grow, doubt): the reopen_after-th refusal in a row makes P grow, those that
        # follow it are used with R times nis / 3.
        over = present & ~(nis <= gate.limits[3])
        forced = over & jnp.isfinite(nis) & (refused >= gate.reopen_after)
        explained = jnp.sum(1.0 - jnp.diagonal(R, axis1=-2, axis2=-1) / jnp.diagonal(S, axis1=-2, axis2=-1), axis=-1)
        larger = jnp.maximum(nis / jnp.maximum(explained, jnp.finfo(nis.dtype).eps), 1.0)
        grow = jnp.where(over & jnp.isfinite(nis) & (refused + 1 == gate.reopen_after), larger, 1.0)[:, None, None]
        refused = jnp.where(present, jnp.where(over, refused + 1, 0), refused)
        W = jnp.where((present & (~over | forced))[:, None, None], V, 0.0)
        Ga, Gb = W @ Paa, W @ Pab  # K = [Ga Gb]^T W
        Gat, Gbt, white = small.transpose(Ga), small.transpose(Gb), small.matvec(W, e)
        doubt = jnp.where(forced, nis / 3.0 - 1.0, 0.0)[:, None, None] * (W @ R @ small.transpose(W)) - eye
        Ka, Kb = doubt @ Ga, doubt @ Gb
        carry = (
            theta + small.matvec(Gat, white),
            b + small.matvec(Gbt, white),
            (Paa + Gat @ Ka) * grow,
            (Pab + Gat @ Kb) * grow,
            (Pbb + Gbt @ Kb) * grow,
            refused,
        )
        return carry, (nis, log_det, over)

    o = jnp.zeros((n, 3, 3))
    zero = jnp.zeros((n, 3))
    start = (zero, zero, s2 * data["first"], o, o + data["drift_var"] * eye, jnp.zeros(n, dtype=int))
    inputs = tuple(data[name] for name in ("y", "B", "shape", "extra", "duration", "mask"))
    return jax.lax.scan(body, start, inputs)[1]


def _gaussian(nis: np.ndarray, log_det: np.ndarray, variance: float | np.ndarray = 1.0) -> np.ndarray:
    """Log likelihood (..., m) of three-dimensional innovations whose covariances are S times `variance`."""
    return -0.5 * (log_det + 3.0 * np.log(variance) + nis / variance)


def _student(nis: np.ndarray, log_det: np.ndarray, variance: float | np.ndarray = 1.0) -> np.ndarray:
    """The same by Student's distribution."""
    return -0.5 * (log_det + 3.0 * np.log(variance) + (STUDENT + 3.0) * np.log1p(nis / variance / STUDENT))


def selections(count: int) -> list[np.ndarray]:
    """Selections of at most EPOCHS + 1 of `count` epochs, each from the first on."""
    if count <= EPOCHS + 1:
        return [np.arange(count)]
    length = EPOCHS // BLOCKS
    begins = np.linspace(0, count - length, BLOCKS).astype(int)
    return [np.unique((begins[:, None] + np.arange(length)).ravel()), np.linspace(0, count - 1, EPOCHS + 1).astype(int)]


def rough_levels(series: Series, known: dict[str, float]) -> NoiseLevels:
    """Levels by the scatter from epoch to epoch: all of it given to the stars and to the gyro alike, no walk of the drift.

    Raises DataError where nothing is redundant.
    """
    unknown = [n for n in ("sigma_v", "sigma") if n not in known]
    if unknown and len(series) < 3:
        raise DataError(
            "two attitudes alone do not tell how noisy they are; state the noise in sensors.toml: [gyro] "
            "arw_arcsec_sqrt_s and [star] sigma_arcsec"
        )
    (gyro, star), T = _scatter(series), float(np.median(np.diff(series.time)))
    guess = {"sigma_v": gyro / np.sqrt(T), "sigma_u": 0.0, "sigma": star}
    levels = guess | known
    return NoiseLevels(levels["sigma_v"], levels["sigma_u"], levels["sigma"], dict.fromkeys(unknown, np.nan))


def _scatter(series: Series) -> tuple[float, float]:
    """Robust standard deviation from epoch to epoch about the common drift: in rad, and in units of the stars' shapes."""
    e, T = series.steps(), np.diff(series.time)[:, None]
    e = e - np.median(e / T, axis=0) * T
    white = np.linalg.solve(np.linalg.cholesky(series.shape[1:] + series.shape[:-1]), e[..., None])[..., 0]
    if len(e) >= ENOUGH:
        gyro, star = (1.4826 * float(np.median(np.abs(x))) for x in (e, white))
    else:
        gyro, star = (float(np.sqrt(np.sum(x**2) / (3.0 * max(len(e) - 1, 1)))) for x in (e, white))
    return max(gyro, SMALLEST), max(star * np.sqrt(2.0), SMALLEST)


def estimate_noise(
    series: Series, known: dict[str, float], gate: Gate, misfit: tuple[float, float] = (0.0, 0.0)
) -> NoiseLevels:
    """Levels of maximum likelihood; those in `known` ("sigma_v", "sigma_u", "sigma") are kept as they are.

    What the `gate` refuses does not count. `misfit`: sum of squares by which star directions miss their
    epochs' solutions, and its degrees of freedom. With too few epochs to tell, the levels are `rough_levels`.
    """
    names = [n for n in NAMES if n not in known]
    if not names:
        return NoiseLevels(known["sigma_v"], known["sigma_u"], known["sigma"], {})
    rough = rough_levels(series, known)
    if len(series) <= ENOUGH:
        return rough
    parts = [series.select(index) for index in selections(len(series))]
    likelihood = _Likelihood([_padded(part) for part in parts], known, names, misfit, gate)
    gyro, star = _scatter(series)
    T, total = float(np.median(np.diff(series.time))), float(series.time[-1] - series.time[0])
    box = {
        "sigma_v": gyro / np.sqrt(T) * np.array([1e-4, 3.0]),
        "sigma_u": gyro * np.array([0.03 / total**1.5, 3.0 / T**1.5]),
        "sigma": star * np.array([1e-4, 3.0]),
    }
    bounds = np.log(np.array([box[n] for n in names]))
    if len(names) == 3:  # the scale follows from the innovations, so that two ratios are left to search
        at = _search(likelihood.best_scale, bounds[:2] - bounds[2].mean(), 16)
        at = likelihood.with_scale(at)
    else:
        at = _search(lambda p: likelihood(p, _student), bounds, 64 if len(names) == 1 else 16)
    at, _ = _climb(lambda p: likelihood(p, _student), at, (0.3,), bounds)
    likelihood.leave_out(at, gate)
    at, hessian = _climb(lambda p: likelihood(p, _gaussian), at, (0.3, 0.2, 0.1, 0.1, 0.1), bounds)
    found = dict(zip(names, np.exp(at), strict=True)) | known
    shared = np.sqrt(len(parts))  # they look at the same data
    uncertainty = {n: float(v) for n, v in zip(names, shared * _uncertainty(hessian), strict=True)}
    return NoiseLevels(float(found["sigma_v"]), float(found["sigma_u"]), float(found["sigma"]), uncertainty)


class _Likelihood:
    """Log likelihoods of points (n, k) in the logarithms of the unknown levels, over all selections."""

    def __init__(
        self,
        data: list[dict[str, Array]],
        known: dict[str, float],
        names: list[str],
        misfit: tuple[float, float],
        gate: Gate,
    ):
        self._data, self._known, self._names, self._misfit = data, known, names, misfit
        self._open = Gate(limits=jnp.asarray(np.full(len(gate.limits), np.inf)), reopen_after=gate.reopen_after)

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
        smallest = SMALLEST**2
        variance = np.maximum(np.nanmedian(np.where(used, nis, np.nan), axis=1, keepdims=True) / 2.366, smallest)
        for _ in range(12):
            weight = (STUDENT + 3.0) / (STUDENT + nis / variance)
            variance = np.sum(np.where(used, weight * nis, 0.0), axis=1, keepdims=True) / (3.0 * count)
            variance = np.maximum(variance, smallest)
        value = np.sum(np.where(used, _student(nis, log_det, variance), 0.0), axis=1)
        return variance[:, 0], np.where(np.isfinite(value), value, -np.inf)

    def _runs(self, levels: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """NIS, log det S and which were used (n, m), for each selection."""
        n = len(levels)
        levels = np.concatenate([levels, np.repeat(levels[-1:], -n % BATCH, axis=0)])
        for data in self._data:
            parts = [
                _innovations(jnp.asarray(levels[i : i + BATCH]), data, self._open)[:2]
                for i in range(0, len(levels), BATCH)
            ]
            nis, log_det = (np.concatenate([np.asarray(a) for a in x], axis=1).T[:n] for x in zip(*parts, strict=True))
            yield nis, log_det, np.broadcast_to(np.asarray(data["mask"]), nis.shape)

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
        """From here on without the epochs that a gate refuses at this point, unless they are too many to be outliers."""
        levels = jnp.asarray(self._levels(np.repeat(at[None], BATCH, axis=0)))
        for i, data in enumerate(self._data):
            over = np.asarray(_innovations(levels, data, gate)[2])[:, 0]
            if over.sum() < 0.2 * np.asarray(data["mask"]).sum():
                self._data[i] = data | {"mask": data["mask"] & ~jnp.asarray(over)}


def _padded(series: Series) -> dict[str, Array]:
    """Arrays of EPOCHS intervals; what is added at the end has no length and is absent."""
    m = len(series) - 1
    y, T = series.since(0), np.diff(series.time)
    size = np.sqrt(np.trace(series.shape, axis1=1, axis2=2) / 3.0)
    odd = stand_out(y, series.time, size / np.median(size), series.extra.mean(axis=1))

    def pad(a: np.ndarray) -> Array:
        return jnp.asarray(np.concatenate([a, np.zeros((EPOCHS - m, *a.shape[1:]), dtype=a.dtype)]))

    shape = np.concatenate([series.shape[1:], np.broadcast_to(np.eye(3), (EPOCHS - m, 3, 3))])
    e = np.abs(series.steps()) / T[:, None]
    drift_sigma = 10.0 * max(float(np.quantile(e, 0.9)), SMALLEST / float(np.median(T)))
    return {
        "first": jnp.asarray(series.shape[0]),
        "y": pad(y[1:]),
        "B": pad(np.diff(series.A, axis=0)),
        "shape": jnp.asarray(shape),
        "extra": pad(np.diff(series.extra, axis=0)),
        "duration": pad(T),
        "mask": pad(~odd[1:]),
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


def _climb(
    value: Callable[[np.ndarray], np.ndarray], at: np.ndarray, sizes: Sequence[float], bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Newton's method by differences of the given sizes; returns the best point seen and the last Hessian (k, k)."""
    k = len(at)
    eye = np.eye(k)
    pairs = [(i, j) for i in range(k) for j in range(i)]
    stencil = [0.0 * eye[:1], eye, -eye, *(np.array([a * eye[i] + b * eye[j]]) for i, j in pairs for a, b in SIGNS)]
    offsets = np.concatenate(stencil)
    best, hessian = (-np.inf, at), np.full((k, k), np.nan)
    for size in sizes:
        points = at + size * offsets
        v = value(points)
        if np.nanmax(v) > best[0]:
            best = (float(np.nanmax(v)), np.clip(points[int(np.nanargmax(v))], *bounds.T))
        if not np.isfinite(v).all():
            at = best[1]
            continue
        gradient = (v[1 : 1 + k] - v[1 + k : 1 + 2 * k]) / (2.0 * size)
        hessian = np.diag((v[1 : 1 + k] - 2.0 * v[0] + v[1 + k : 1 + 2 * k]) / size**2)
        for n, (i, j) in enumerate(pairs):
            pp, pm, mp, mm = v[1 + 2 * k + 4 * n : 5 + 2 * k + 4 * n]
            hessian[i, j] = hessian[j, i] = (pp - pm - mp + mm) / (4.0 * size**2)
        curvature, axes = np.linalg.eigh(hessian)
        along = axes.T @ gradient
        newton = along / np.where(curvature < -FLAT, -curvature, 1.0)
        uphill = np.where(np.abs(along) * size > 0.5 * FLAT, np.sign(along) * size, 0.0)
        step = axes @ np.clip(np.where(curvature < -FLAT, newton, uphill), -2.0 * size, 2.0 * size)
        at = np.clip(at + step, *bounds.T)
    return best[1], hessian


def _uncertainty(hessian: np.ndarray) -> np.ndarray:
    """Relative 1 sigma (k,) of each level by the likelihood's curvature; NaN where it has next to none."""
    out = np.full(len(hessian), np.nan)
    told = np.flatnonzero(np.diagonal(hessian) < -FLAT)
    if len(told):
        variance = np.diagonal(np.linalg.pinv(-hessian[np.ix_(told, told)]))
        out[told] = np.sqrt(np.where((variance > 0.0) & (variance < 1.0), variance, np.nan))
    return out
