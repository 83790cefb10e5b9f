"""How probable it is that an attitude explains a list of detections: Bayes' rule with false, missing and misjudged stars.

The hypothesis "attitude R, focal length f" is weighed against "every detection is false". With k of the S catalogue stars
expected in the image matched, residuals r_j (px), detections of density lam (1/px^2) and magnitudes m_j,

    odds = prod_j [ N(r_j; s^2 C_j) p(m_j | star) / (lam p(m_j)) ]  B(a + k, 1 + S - k) / B(a, 1)
           x sqrt(det 2 pi P) / V.

- lam is the detections' own density, smoothed, so that a clump of false ones is no wonder. With k matches the others are fewer
  than lam says: (n + 1)^k (n - k)! / n! with the rate of false detections integrated out.
- The middle factor is the chance of k detections among S stars with the detection probability integrated out (uniform prior,
  a = 1), so a field that misses its bright stars pays for it and one that misses 60% evenly still passes. S is unknown too: how
  deep the image is. The odds are averaged over all S, with 1/S as prior. Where the zero point is known the detections tell how
  deep the image is, and a camera that misses most of the brighter stars is odd: the prior is twice the detection probability
  then, a = 2.
- The last factor is the price of having fitted the attitude (and focal length): the volume that the fit leaves over the volume V
  that it was chosen from, 8 pi^2 for SO(3). It takes the place of a count of tested hypotheses, and with it the odds are
  posterior odds whatever the search did. The zero point of the magnitudes and the scale s pay likewise.
- p(m | star) is a Gaussian around the catalogue's V and zero point, with a broad share for other bands and variable stars. Where
  the zero point is known, how well the magnitudes fit the catalogue's is not taken on trust: the odds are averaged over sigmas
  from an eighth of the one told to four times it.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

import numpy as np

from ..native import address, kernels
from .magnitudes import (
    BROAD_FACTOR,
    BROAD_SHARE,
    BROAD_SIGMA,
    ZERO_POINT_RANGE,
    faintest_sought,
    magnitude_gain,
    magnitude_scales,
    zero_point,
    zero_point_price,
)
from .patterns import Sky, Window
from .problem import Detections, Fit, Freedom, middle

LOG_FACTORIAL = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1.0, 400.0)))])
HARMONIC = np.concatenate([[1.0], np.cumsum(1.0 / np.arange(1.0, 400.0))])
_TABLES = address(LOG_FACTORIAL), address(HARMONIC)
SO3_VOLUME = 8.0 * np.pi**2
LEAST_PROBABILITY = 1e-99
"""Below this a probability is a figure of the model, not of the world."""
HOPELESS = -14.0
"""Log odds after the first step below which a hypothesis is dropped."""
SCALES = (1.0, 1.8, 3.2)
"""Factors on the detections' sigmas; all but the first are tried where the residuals ask for it."""
GATE = 3.6
"""Residuals of matches, over sigma."""
MOST_IN_C, DEEPEST_IN_C = 512, 398
"""Detections and stars that verify.c has room for."""


def jacobian(u: np.ndarray, f: float) -> np.ndarray:
    """Derivative (k, 2, 4) of ideal pixels by (theta, ln f) at u (k, 2) = (X/Z, Y/Z), R = exp([theta x]) R_hat."""
    x, y = u[:, 0], u[:, 1]
    xy, one = x * y, np.ones_like(x)
    rows = (-xy, one + x * x, -y, x, -one - y * y, xy, x, y)
    return (f * np.array(rows)).T.reshape(-1, 2, 4)


def turn(theta: np.ndarray, R: np.ndarray) -> np.ndarray:
    """exp([theta x]) R."""
    t = float(np.sqrt(theta @ theta))
    K = np.array([[0.0, -theta[2], theta[1]], [theta[2], 0.0, -theta[0]], [-theta[1], theta[0], 0.0]])
    a = np.sin(t) / t if t > 1e-12 else 1.0
    b = (1.0 - np.cos(t)) / t**2 if t > 1e-6 else 0.5
    return R + (a * K + b * (K @ K)) @ R


def turns(theta: np.ndarray) -> np.ndarray:
    """exp([theta x]) (h, 3, 3) of theta (h, 3)."""
    t = np.sqrt((theta**2).sum(axis=1))
    K = np.zeros((len(t), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -theta[:, 2], theta[:, 1], -theta[:, 0]
    K -= K.transpose(0, 2, 1)
    a, b = np.sinc(t / np.pi), 0.5 * np.sinc(0.5 * t / np.pi) ** 2
    return np.eye(3) + a[:, None, None] * K + b[:, None, None] * np.matmul(K, K)


def deepest(d: Detections) -> int:
    """Most stars that a list of detections is compared with."""
    return int(min(220, max(60, 3 * len(d))))


def stars_near(sky: Sky, level: int, R: np.ndarray, f: float, d: Detections) -> np.ndarray:
    """Catalogue indices, brightest first, of a circle around the image, at one attitude."""
    return sky.near(level, *_circle(R, f, d))


def _circle(R: np.ndarray, f: float, d: Detections) -> tuple[np.ndarray, float]:
    """Middle (3,) and radius (rad) of a circle around the image."""
    (left, top), (right, bottom) = d.low.tolist(), d.high.tolist()
    x, y = 0.5 * (left + right), 0.5 * (top + bottom)
    half = 0.5 * math.hypot(right - left, bottom - top)
    return np.array([x, y, f]) @ R / math.hypot(x, y, f), 1.03 * math.atan(half / f)


def expected_stars(sky: Sky, level: int, R: np.ndarray, f: float, d: Detections, limit: int) -> np.ndarray:
    """Catalogue indices, brightest first, of what may be in the image or just beyond its edge: about `limit` at most."""
    (left, top), (right, bottom) = d.low.tolist(), d.high.tolist()
    x, y = 0.05 * (right - left), 0.05 * (bottom - top)
    window = Window(R, ((left - x) / f, (top - y) / f), ((right + x) / f, (bottom + y) / f))
    return sky.near(level, *_circle(R, f, d), window)[: limit + limit // 2]


def project(r: np.ndarray, R: np.ndarray, f: float) -> tuple[np.ndarray, np.ndarray]:
    """Ideal pixels (S, 2) of directions r (S, 3) in N, and which of them are in front (S,)."""
    v = r @ R.T
    z = v[:, 2]
    return v[:, :2] * (f / np.maximum(z, 1e-3))[:, None], z > 1e-3


def inside(p: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which pixels (S, 2) lie between two corners."""
    x, y = p[:, 0], p[:, 1]
    return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])


def nearest_pairs(p: np.ndarray, d: Detections, gate_px: np.ndarray, excess: np.ndarray | None):
    """Stars and detections (k,), (k,) that are each other's nearest within the gate (n,), ordered by star.

    excess: (S, n) added to the squared distance over sigma, for magnitudes that disagree.
    """
    if len(p) == 0 or len(d) == 0:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    square = p[:, :1] - d.xy[:, 0]
    square *= square
    dy = p[:, 1:] - d.xy[:, 1]
    dy *= dy
    square += dy
    cost = np.multiply(square, d.sigma**-2.0, out=dy)
    if excess is not None:
        cost += excess
    np.copyto(cost, np.inf, where=square > gate_px**2)
    j = cost.argmin(axis=1)
    rows = np.arange(len(p))
    good = np.isfinite(cost[rows, j]) & (cost.argmin(axis=0)[j] == rows)
    return rows[good], j[good]


def step(u, residual, sigma, f, freedom: Freedom) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton step (4,) for (theta, ln f) and the information (4, 4) of weighted residuals (k, 2)."""
    J = jacobian(u, f) / sigma[:, None, None]
    A = J.reshape(-1, 4)
    information = A.T @ A
    g = A.T @ (residual / sigma[:, None]).ravel()
    if not freedom.free:
        weight = 1.0 / max(freedom.sigma, 1e-6) ** 2
        information[3, 3] += weight
        g[3] += weight * np.log(freedom.f_known / f)
    # A whisper of a prior keeps two coincident stars from a singular matrix; no real geometry notices.
    damped = information + np.diag(np.full(4, 1e-12 * information.trace() + 1e-9))
    return np.linalg.solve(damped, g), information


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Inverse (4, 4) of a fit's information; NaN where it has none."""
    try:
        return np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)


def log_odds(gain: np.ndarray, rank: np.ndarray, expected: int, vacancy: np.ndarray, complete: bool = False) -> float:
    """Of the matches, without the price of the fit: gain (k,) in the order of rank (k,) among the expected stars.

    The depth S has a prior of 1/S, which favours no scale. complete: the detection probability p has the prior 2 p, not 1.
    """
    depth = np.arange(1, expected + 1)
    k = np.searchsorted(rank, depth, side="left")
    # B(1 + k, 1 + S - k) = k! (S - k)! / (S + 1)!
    beta = LOG_FACTORIAL[k] + LOG_FACTORIAL[depth - k] - LOG_FACTORIAL[depth + 1]
    if complete:  # 2 B(2 + k, 1 + S - k)
        beta = beta + np.log(2.0 * (k + 1) / (depth + 2))
    total = (np.concatenate([[0.0], np.cumsum(gain)]) + vacancy[: len(gain) + 1])[k] + beta
    top = total.max()
    return float(top + np.log((np.exp(total - top) / depth).sum() / HARMONIC[expected]))


def verify(
    sky: Sky,
    level: int,
    d: Detections,
    R: np.ndarray,
    f: float,
    freedom: Freedom,
    *,
    first_gate: float = 4.0,
    rounds: int = 3,
    volume: float = SO3_VOLUME,
) -> Fit | None:
    """Match, fit and weigh, starting at R (3, 3) and f; None where fewer than two stars fit or nothing speaks for it.

    first_gate: of the first round, over GATE sigma, for what the start does not know yet. volume: rad^3, of attitudes that were
    possible before.
    """
    limit = deepest(d)
    candidates = expected_stars(sky, level, R, f, d, limit)
    r, V = sky.directions.take(candidates, axis=0), sky.magnitude.take(candidates)
    return _Field(d, freedom, candidates, r, V, limit, volume).settle(R, f, SCALES, first_gate, rounds)


def _typical(fit: Fit, d: Detections) -> float:
    """Median residual of a fit over what the detections' sigmas promise."""
    x, y = fit.residuals.T
    return middle(np.hypot(x, y) / d.sigma[fit.detections]) / 1.18


class _InC(ctypes.Structure):
    """As Field in verify.c."""

    _fields_ = (
        [(k, ctypes.c_int64) for k in ("n", "stars", "limit", "has_magnitude", "knows_zero", "is_free")]
        + [(k, ctypes.c_double) for k in ("low_x", "low_y", "high_x", "high_y", "faintest", "magnitude_sigma", "zero_point")]
        + [(k, ctypes.c_double) for k in ("zero_point_range", "broad_share", "broad_most", "broad_factor")]
        + [(k, ctypes.c_double) for k in ("f_low", "f_high", "f_known")]
        + [(k, ctypes.c_double) for k in ("f_weight", "log_volume", "gate", "hopeless")]
        + [(k, ctypes.c_void_p) for k in ("xy", "sigma", "log_density", "log_magnitude_density", "vacancy", "magnitude")]
        + [(k, ctypes.c_void_p) for k in ("r", "V", "log_factorial", "harmonic")]
        + [("magnitude_scales", ctypes.c_int64), ("magnitude_scale", ctypes.c_void_p), ("log_prior", ctypes.c_void_p)]
    )  # fmt: skip


@dataclass(frozen=True)
class _Field:
    """What a hypothesis is weighed against: detections, and the stars that may be seen (r (S, 3) in N, V (S,))."""

    d: Detections
    freedom: Freedom
    candidates: np.ndarray
    r: np.ndarray
    V: np.ndarray
    limit: int
    volume: float

    def settle(self, R: np.ndarray, f: float, scales: tuple[float, ...], first_gate: float, rounds: int) -> Fit | None:
        """Match and step `rounds` times, then match and weigh, at the first scale of sigmas; from there at the next ones.

        Sigmas that were told too small show in the residuals. Wider ones are tried, and kept only if they explain more: estimated
        from the residuals they would grow with every false match that the wider gate lets in.
        """
        library = kernels()
        if library is not None and len(self.d) <= MOST_IN_C and self.limit <= DEEPEST_IN_C:
            return self._compiled(library, R, f, scales, first_gate, rounds)
        best = self._at_scale(R, f, scales[0], first_gate, rounds)
        for scale in scales[1:]:
            if best is None or best.log_odds < 0.0 or _typical(best, self.d) < 1.25 * best.sigma_scale:
                break
            wider = self._at_scale(best.R, best.f, scale, 1.0, 2)
            if wider is None or wider.log_odds <= best.log_odds:
                break
            best = wider
        return best

    def _at_scale(self, R: np.ndarray, f: float, scale: float, first_gate: float, rounds: int) -> Fit | None:
        d, freedom, zero = self.d, self.freedom, self.d.zero_point
        for turn_number in range(rounds + 1):
            p, _ = project(self.r, R, f)
            seen = np.flatnonzero(inside(p, d.low, d.high) & (faintest_sought(d) >= self.V))[: self.limit]
            p = p[seen]
            widen = 1.0 if turn_number == rounds else (first_gate, 0.5 * (1.0 + first_gate), 1.0)[min(turn_number, 2)]
            excess = None
            if d.magnitude is not None and zero is not None and turn_number > 0:
                z = (self.V[seen][:, None] - d.magnitude[None, :] - zero) / d.magnitude_sigma
                excess = np.minimum(z * z, 12.0)
            i, j = nearest_pairs(p, d, widen * GATE * scale * d.sigma, excess)
            if len(i) < 2:
                return None
            residual = d.xy[j] - p[i]
            sigma = scale * d.sigma[j]
            square = (residual**2).sum(axis=1) / sigma**2
            if turn_number == rounds or (turn_number == 1 and rounds > 2):
                zero = zero_point(d, self.V[seen[i]], j)
                weighed = self._weigh(p, seen, i, j, residual, square, sigma, f, scale, zero)
                if weighed is None:
                    return None
                total, good, information = weighed
                if turn_number == rounds:
                    stars = self.candidates[seen[i[good]]]
                    return Fit(R, f, stars, j[good], residual[good], total, scale, zero, covariance_of(information))
                if total < HOPELESS:
                    return None
            else:
                zero = zero_point(d, self.V[seen[i]], j)
            # Far residuals of a wide gate are mostly false matches: they pull less.
            soft = sigma * np.sqrt(1.0 + square / (2.0 * widen) ** 2)
            delta, _ = step(p[i] / f, residual, soft, f, freedom)
            R = turn(delta[:3], R)
            f = f * math.exp(min(max(float(delta[3]), -0.1), 0.1))
            f = min(max(f, 0.97 * freedom.f_low), 1.03 * freedom.f_high)
        return None

    def _weigh(
        self, p: np.ndarray, seen: np.ndarray, i: np.ndarray, j: np.ndarray, residual: np.ndarray, square: np.ndarray,
        sigma: np.ndarray, f: float, scale: float, zero: float,
    ) -> tuple[float, np.ndarray, np.ndarray] | None:  # fmt: skip
        """Log odds averaged over the magnitudes' sigma, and of the likeliest one the matches that stay and the information;
        None where fewer than two stay."""
        d, V = self.d, self.V[seen[i]]
        place = -0.5 * square - np.log(2.0 * np.pi * sigma**2) - d.log_density[j]
        odds, best = [], None
        for factor, prior in zip(*magnitude_scales(d)):
            expected = int((self.V[seen] <= d.faintest_at(factor)).sum())
            gain = magnitude_gain(d, V, j, zero, factor) + place
            # A match that speaks against the hypothesis is none: the star is missing and the detection false.
            good = np.flatnonzero((gain > 0.0) & (i < expected))
            if len(good) < 2:
                continue
            _, information = step(p[i[good]] / f, residual[good], sigma[good], f, self.freedom)
            total = (
                log_odds(gain[good], i[good], expected, d.vacancy, d.knows_zero)
                + zero_point_price(d, len(i))
                - np.log(scale)
            )
            total += float(fit_volumes(information[None], self.freedom, self.volume)[0]) + prior
            if best is None or total > max(odds):
                best = good, information
            odds.append(total)
        return None if best is None else (float(np.logaddexp.reduce(odds)), *best)

    def _in_c(self) -> tuple[_InC, list[np.ndarray]]:
        """For verify.c, and the arrays that it points to."""
        d, freedom, n, stars = self.d, self.freedom, len(self.d), len(self.candidates)
        if self.r.shape != (stars, 3) or self.V.shape != (stars,):
            raise ValueError(
                f"stars have the shapes {self.r.shape} and {self.V.shape}, not {(stars, 3)} and {(stars,)}"
            )
        arrays = [np.ascontiguousarray(x, dtype=float) for x in (d.in_c, self.r, self.V)]
        listed, r, V = (address(x) for x in arrays)
        factors, priors = magnitude_scales(d)
        return _InC(
            n, stars, self.limit, d.magnitude is not None, d.zero_point is not None, freedom.free,
            *d.low.tolist(), *d.high.tolist(), faintest_sought(d), d.magnitude_sigma, d.zero_point or 0.0, ZERO_POINT_RANGE,
            BROAD_SHARE, BROAD_SIGMA, BROAD_FACTOR, freedom.f_low, freedom.f_high, freedom.f_known,
            1.0 / max(freedom.sigma, 1e-6) ** 2, math.log(self.volume * focal_volume(freedom)), GATE, HOPELESS,
            *(listed + 8 * k for k in (0, 2 * n, 3 * n, 4 * n, 5 * n, 6 * n + 1)), r, V, *_TABLES,
            len(factors), address(factors), address(priors),
        ), arrays  # fmt: skip

    def _compiled(
        self, library: ctypes.CDLL, R: np.ndarray, f: float, scales: tuple[float, ...], first_gate: float, rounds: int
    ) -> Fit | None:
        """As `settle`, by verify.c."""
        s, _kept = self._in_c()
        fit, matches = np.empty(29 + 2 * self.limit), np.empty((2, self.limit), dtype=np.int64)
        fit[:9], fit[9], at = R.ravel(), f, address(matches)
        call = library.helmstar_settle
        call.restype = ctypes.c_int64
        count = call(
            ctypes.byref(s), ctypes.c_int64(len(scales)), (ctypes.c_double * len(scales))(*scales), ctypes.c_double(first_gate),
            ctypes.c_int64(rounds), ctypes.c_void_p(address(fit)), ctypes.c_void_p(at), ctypes.c_void_p(at + 8 * self.limit),
        )  # fmt: skip
        if count == -2:
            raise np.linalg.LinAlgError("a step of the fit has no solution")
        if count < 0:
            raise ValueError(f"{len(self.d)} detections and {self.limit} stars: more than verify.c has room for")
        if count == 0:
            return None
        stars, detections = matches[:, :count]
        return Fit(
            fit[:9].reshape(3, 3), float(fit[9]), self.candidates[stars], detections, fit[29 : 29 + 2 * count].reshape(-1, 2),
            float(fit[10]), float(fit[28]), float(fit[11]), fit[12:28].reshape(4, 4),
        )  # fmt: skip


def focal_volume(freedom: Freedom) -> float:
    """Of ln f before the fit."""
    if freedom.free:
        return max(math.log(freedom.f_high / freedom.f_low), 1e-3)
    # The Gaussian prior of ln f stands in the information; this is its norm.
    return math.sqrt(2.0 * math.pi) * max(freedom.sigma, 1e-6)


def fit_volumes(information: np.ndarray, freedom: Freedom, volume: float = SO3_VOLUME) -> np.ndarray:
    """Logs (h,) of the volumes that fits of information (h, 4, 4) leave over the one they were chosen from."""
    volume *= focal_volume(freedom)
    sign, logdet = np.linalg.slogdet(information)
    price = np.minimum(0.0, 0.5 * (4.0 * math.log(2.0 * math.pi) - logdet) - math.log(volume))
    return np.where(sign > 0, price, -np.inf)


def probability_false(fits: list[Fit]) -> float:
    """Posterior probability that the best of the fits is not the true one: all false, or another fit; never quite zero."""
    *others, top = sorted(fit.log_odds for fit in fits)
    most = max(top, 0.0)
    false = sum(math.exp(odds - most) for odds in (0.0, *others))
    return max(false / (false + math.exp(top - most)), LEAST_PROBABILITY)


__all__ = ["probability_false", "verify"]
