"""Allan deviation of gyro rates, and the noise parameters that it supports, with errors that account for overlap.

    sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + B^2 2 ln2 / pi + K^2 tau / 3            (IEEE Std 952-1997, annex C)

| symbol | name here | unit | what |
|---|---|---|---|
| Q | quantisation | rad | white noise of the angle: quantised increments, a star tracker's noise |
| N | arw | rad/sqrt(s) | angle random walk, white noise of the rate |
| B | bias_instability | rad/s | flicker noise of the rate; the flat floor is 0.664 B |
| K | rrw | rad/s/sqrt(s) | rate random walk, the drift's own walk |

The deviation (overlapping) and its degrees of freedom are allantools'. The fit minimises the deviance of chi-square
distributed variances, which is least squares in relative terms, weighted by degrees of freedom, whose weights come from
the model and not from the scattered values; and of all sets of terms the one with the least deviance plus PENALTY per
term is taken, so a term that the data do not support is None. Errors come from the covariance of the estimates at all
tau under the fitted model, which share the same samples.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

TERMS = ("quantisation", "arw", "bias_instability", "rrw")
PENALTY = (8.0, 8.0, 11.0, 8.0)
"""Deviance that each of TERMS has to earn: about 2.8 sigma. On white noise some 3% of the series are then given a
second term. The flat floor, hardly different from where white noise meets a walk and used by no filter, earns more."""
LEAST_SAMPLES = 50
FEWEST_PER_TAU = 3
"""The longest tau fits so often into the longest stretch."""
FLICKER = 2.0 * math.log(2.0) / math.pi


@dataclass(frozen=True)
class AllanCurve:
    """Overlapping Allan deviation of rates: all arrays (t,).

    tau_s; adev in the rates' unit (rad/s), its 1 sigma `error`, `n` squares that were averaged, `edf` equivalent
    degrees of freedom, `m` samples per tau. `lengths`: samples of each uninterrupted stretch; `period` s. `instant`:
    samples are values at instants, not means over a period.
    """

    tau_s: np.ndarray
    adev: np.ndarray
    error: np.ndarray
    n: np.ndarray
    edf: np.ndarray
    m: np.ndarray
    lengths: tuple[int, ...]
    period: float
    instant: bool = False


@dataclass(frozen=True)
class AllanFit:
    """Parameters in SI, None where the data do not support the term; `_error` is 1 sigma (None likewise).

    arw rad/sqrt(s), rrw rad/s/sqrt(s), bias_instability rad/s, quantisation rad. `model` (t,): the fitted deviation.
    `arw_limit` and `rrw_limit`: what they can be at most (about 2 sigma), whether or not they are in the model.
    `misfit`: deviance per degree of freedom, near 1 where the model holds; `chance`: how often noise alone gives so
    much. Where that is below 1e-3 the model is not the whole truth, and the errors are widened by sqrt(misfit).
    """

    arw: float | None
    rrw: float | None
    bias_instability: float | None
    quantisation: float | None
    model: np.ndarray
    arw_error: float | None
    rrw_error: float | None
    bias_instability_error: float | None
    quantisation_error: float | None
    arw_limit: float
    rrw_limit: float
    misfit: float
    chance: float


def allan_deviation(rate: np.ndarray | Sequence[np.ndarray], period: float, *, instant: bool = False) -> AllanCurve:
    """Overlapping Allan deviation at tau = period times 1, 2, 4, ... of one series (n,) or of several stretches of one.

    Stretches are pooled by squares, so none reaches over a gap. Raises ValueError for fewer than LEAST_SAMPLES samples
    in the longest stretch, a period that is not positive, or samples that are not finite.
    """
    single = isinstance(rate, np.ndarray) and rate.ndim == 1
    stretches = [np.asarray(r, dtype=float) for r in ([rate] if single else rate)]
    longest = max((len(r) for r in stretches), default=0)
    if longest < LEAST_SAMPLES:
        raise ValueError(f"{longest} samples in a row: an Allan deviation needs at least {LEAST_SAMPLES}")
    if not (period > 0.0 and math.isfinite(period)):
        raise ValueError(f"period {period}: must be positive")
    if not all(r.ndim == 1 and np.isfinite(r).all() for r in stretches):
        raise ValueError("rates must be one-dimensional and finite")
    import allantools

    count = int(math.log2(longest // FEWEST_PER_TAU)) + 1
    m = 2 ** np.arange(count)
    squares, n = np.zeros(count), np.zeros(count)
    for r in (r for r in stretches if len(r) >= 3):
        # The mean says nothing to a second difference, but costs digits in the sum that makes angles of rates. Time is
        # counted in samples, so that no rounding touches tau; allantools wants two squares at least.
        phase = np.concatenate([[0.0], np.cumsum(r - r.mean())])
        used = int(np.sum(2 * m < len(r)))
        _, deviation, _, terms = allantools.oadev(phase, rate=1.0, data_type="phase", taus=m[:used].astype(float))
        squares[:used] += terms * deviation**2
        n[:used] += terms
    adev = np.sqrt(squares / n)
    lengths = tuple(len(r) for r in stretches)
    edf = _degrees_of_freedom(m, adev, lengths)
    return AllanCurve(m * period, adev, adev / np.sqrt(2.0 * edf), n.astype(int), edf, m, lengths, period, instant)


def _degrees_of_freedom(m: np.ndarray, adev: np.ndarray, lengths: tuple[int, ...]) -> np.ndarray:
    """Equivalent degrees of freedom (t,) by Greenhall's formula, for the kind of noise that the local slope shows."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.gradient(np.log(adev), np.log(m))
    bounds = np.array([-0.75, -0.25, 0.25])
    alpha = np.array([2, 0, -1, -2])[np.searchsorted(bounds, np.nan_to_num(slope))]
    alpha = np.minimum.accumulate(alpha)  # long tau scatter too much to have a kind of their own; it only gets redder
    unique, times = np.unique(lengths, return_counts=True)
    edf = np.empty(len(m))
    for i, (points, kind) in enumerate(zip(m.tolist(), alpha.tolist())):
        spread, total = 0.0, 0.0
        for length, many in zip(unique.tolist(), times.tolist()):
            terms = length + 1 - 2 * points
            if terms < 2:
                continue
            spread += many * terms**2 / _single_degrees_of_freedom(kind, points, length + 1)
            total += many * terms
        edf[i] = total**2 / spread
    return edf


@cache
def _single_degrees_of_freedom(alpha: int, m: int, points: int) -> float:
    """Of one stretch with so many points of the angle."""
    from allantools.ci import edf_greenhall

    try:
        return max(float(edf_greenhall(alpha, 2, m, points, overlapping=True)), 1.0)
    except NotImplementedError:  # white angle noise at tau longer than a third of the record
        return max(float(edf_greenhall(0, 2, m, points, overlapping=True)), 1.0)


# ----------------------------------------------------------------------------- the fit


def _basis(curve: AllanCurve) -> np.ndarray:
    """Variance (t, 4) of Q^2, N^2, B^2, K^2 = 1. A walk that is sampled, not averaged, has a bit more at short tau."""
    tau, m = curve.tau_s, curve.m.astype(float)
    walk = tau * (2.0 * m**2 + 1.0) / (6.0 * m**2) if curve.instant else tau / 3.0
    return np.stack([3.0 / tau**2, 1.0 / tau, np.full(len(tau), FLICKER), walk], axis=1)


def fit_allan(curve: AllanCurve) -> AllanFit:
    """Fit the terms that the curve supports. Raises ValueError where the deviation is zero: the rates do not vary."""
    if not (curve.adev > 0.0).all():
        raise ValueError("the Allan deviation is zero: the rates do not vary")
    scale = float(curve.adev[0]) ** 2
    variance = curve.adev**2 / scale
    basis = _basis(curve)
    best: tuple[float, float, np.ndarray] | None = None
    for size in range(1, len(TERMS) + 1):
        for chosen in itertools.combinations(range(len(TERMS)), size):
            p, deviance = _fit_terms(basis, variance, curve.edf, chosen)
            criterion = deviance + sum(PENALTY[i] for i in chosen)
            if (p[list(chosen)] > 0.0).all() and (best is None or criterion < best[0]):
                best = (criterion, deviance, p)
    assert best is not None  # one term alone always fits with a positive value
    _, deviance, p = best
    present = np.flatnonzero(p > 0.0)
    degrees = max(len(variance) - len(present), 1)
    misfit = deviance / degrees
    from scipy.special import gammaincc, gammaincinv

    chance = float(gammaincc(0.5 * degrees, 0.5 * deviance))
    error = scale * _errors(curve, basis, p, present) * (math.sqrt(misfit) if chance < 1e-3 else 1.0)
    value = np.sqrt(p * scale)
    sigma = error / (2.0 * np.where(value > 0.0, value, 1.0))  # of a root, from that of its square

    def one(name: str) -> tuple[float | None, float | None]:
        i = TERMS.index(name)
        return (float(value[i]), float(sigma[i])) if i in present else (None, None)

    (arw, arw_error), (rrw, rrw_error) = one("arw"), one("rrw")
    (floor, floor_error), (angle, angle_error) = one("bias_instability"), one("quantisation")
    most = curve.adev * np.sqrt(0.5 * curve.edf / gammaincinv(0.5 * curve.edf, 0.02275))
    return AllanFit(
        arw=arw,
        rrw=rrw,
        bias_instability=floor,
        quantisation=angle,
        model=np.sqrt(basis @ p * scale),
        arw_error=arw_error,
        rrw_error=rrw_error,
        bias_instability_error=floor_error,
        quantisation_error=angle_error,
        arw_limit=float(np.min(most / np.sqrt(basis[:, 1]))),
        rrw_limit=float(np.min(most / np.sqrt(basis[:, 3]))),
        misfit=misfit,
        chance=chance,
    )


def _fit_terms(
    basis: np.ndarray, variance: np.ndarray, edf: np.ndarray, chosen: tuple[int, ...]
) -> tuple[np.ndarray, float]:
    """Squares (4,) of the chosen terms, not negative, and the deviance: repeated weighted least squares."""
    from scipy.optimize import nnls

    A = basis[:, list(chosen)]
    size = A.max(axis=0)
    mu = variance
    best, least = np.zeros(A.shape[1]), np.inf
    for _ in range(100):
        weight = np.sqrt(0.5 * edf) / mu
        p, _ = nnls(A / size * weight[:, None], variance * weight)
        mu = A / size @ p
        ratio = variance / mu
        deviance = float(np.sum(edf * (ratio - 1.0 - np.log(ratio))))
        if not deviance < least - 1e-9:
            break
        best, least = p / size, deviance
    whole = np.zeros(basis.shape[1])
    whole[list(chosen)] = best
    return whole, least


def _errors(curve: AllanCurve, basis: np.ndarray, p: np.ndarray, present: np.ndarray) -> np.ndarray:
    """1 sigma (4,) of the squares of the terms that are present: of least squares whose data are correlated."""
    A = basis[:, present]
    mu = basis @ p
    weight = 0.5 * curve.edf / mu**2
    size = A.max(axis=0)
    normal = (A / size * weight[:, None]).T
    gain = np.linalg.solve(normal @ (A / size), normal) / size[:, None]
    sigma = np.zeros(basis.shape[1])
    sigma[present] = np.sqrt(np.maximum(np.diag(gain @ variance_covariance(curve, p) @ gain.T), 0.0))
    return sigma


def variance_covariance(curve: AllanCurve, squares: np.ndarray) -> np.ndarray:
    """Covariance (t, t) of the Allan variances of Gaussian noise with these squares (Q^2, N^2, B^2, K^2).

    z_a(i) = x(i+2a) - 2x(i+a) + x(i) of the angle x has cross covariance R_ab(k), k = i - j, which is a second
    difference (twice) of x's generalised autocovariance, Q^2 delta, -N^2 |t|/2, B^2 t^2 ln|t| / (2 pi), K^2 |t|^3 / 12
    (Greenhall and Riley 2003); then cov(mean z_a^2, mean z_b^2) = 2 sum_ij R_ab(i-j)^2 / (n_a n_b). Beyond a factor of
    32 in tau it is below 1% of the variances' geometric mean and left out.
    """
    dt, lengths = curve.period, np.unique(curve.lengths, return_counts=True)
    m, count = curve.m.tolist(), curve.n
    result = np.zeros((len(m), len(m)))
    for i, a in enumerate(m):
        for j in range(i, min(i + 6, len(m))):
            b = m[j]
            total = _sum_of_squares(a, b, squares, dt, lengths)
            scale = 4.0 * (a * b * dt**2) ** 2 * float(count[i]) * float(count[j])
            result[i, j] = result[j, i] = 2.0 * total / scale
    return result


def _sum_of_squares(a: int, b: int, squares: np.ndarray, dt: float, lengths: tuple[np.ndarray, np.ndarray]) -> float:
    """sum_ij R_ab(i - j)^2 over all squares of all stretches; a <= b."""
    jumps = [(i * a - j * b, c * d) for i, c in enumerate((1, -2, 1)) for j, d in enumerate((1, -2, 1))]
    q, n, flicker, k = squares

    def smooth(lag: np.ndarray) -> np.ndarray:
        total = np.zeros(len(lag))
        for jump, sign in jumps:
            t = np.abs(lag + jump) * dt
            total += sign * (k * t**3 / 12.0 - n * t / 2.0)
            if flicker > 0.0:
                total += sign * flicker * t**2 * np.log(np.where(t > 0.0, t, 1.0)) / (2.0 * math.pi)
        return total

    def pairs(lag: np.ndarray) -> np.ndarray:
        total = np.zeros(len(lag))
        for length, many in zip(*lengths):
            n_a, n_b = length + 1 - 2 * a, length + 1 - 2 * b
            if n_a >= 2 and n_b >= 2:
                total += many * np.maximum(np.minimum(n_a, n_b + lag) - np.maximum(lag, 0), 0)
        return total

    stride = max(1, a // 16)
    reach = (a + b) * (4 if flicker > 0.0 else 1)
    lag = (b - a) + np.arange(-(reach // stride), reach // stride + 1) * stride
    total = stride * float(np.sum(pairs(lag) * smooth(lag) ** 2))
    if q > 0.0:
        at = np.array(sorted({-jump for jump, _ in jumps}))
        spike = q * np.array([sum(sign for jump, sign in jumps if jump == -lag) for lag in at.tolist()])
        total += float(np.sum(pairs(at) * (2.0 * smooth(at) * spike + spike**2)))
    return total
