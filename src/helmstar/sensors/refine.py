"""The last fit of a star tracker: attitude with the lens, within what is known of the lens, on all stars that can be matched.

A camera that nobody calibrated has a field of view, and no more: where its boresight meets the sensor and how its lens bends
straight lines are unknown to some percent. An attitude fitted as if they were known is off by more than its covariance says. Here
they are parameters with priors (`LensPrior`): what the stars show of them is corrected, what they do not show widens
the covariance. A calibrated camera has the same parameters with the sigmas of its calibration.

The attitude belongs to the frame S whose z axis is seen at the camera's stated centre (the geometric one without calibration). A
principal point elsewhere, at an offset e, then shows only by the perspective's second order; to the first order in e and with
x, y = X/Z, Y/Z of S, D the distortion and a the aspect,

    (x, y)' = (x, y) - (e_x (1 + x^2) + a e_y x y, a e_y (1 + y^2) + e_x x y)/f,   u = c + e + f diag(1, 1/a) D((x, y)').

Huber's loss keeps wrong matches and double stars from pulling. The scale of the residuals is fitted from them, together with what
is believed before (`SCALE_DEGREES`): a frame of few stars cannot say that its sigmas are wrong, one of many can. A
catalogue place of unknown epoch is uncertain by its proper motion.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, field, replace

import numpy as np

from ..imaging import Camera, Centroids
from ..native import address, kernels
from ..stars.glance import quaternion_of
from ..stars.identify import Identification, matrix_of_quaternion
from ..stars.patterns import Sky, Window
from ..stars.problem import middle
from ..stars.verify import turn
from .lens import PARAMETERS, Lens, LensPrior

EPOCH_SPREAD_YEARS = 25.0
"""Proper motion counts as this many years of uncertainty where the time of an image is not told."""
SCALE_DEGREES = 8.0
"""Degrees of freedom that the belief in the centroids' sigmas is worth against the residuals."""
HUBER = 2.5
"""Residuals (of two coordinates, over sigma) beyond which a star pulls no more."""
GATE = 4.0
"""Residuals of matches over sigma, what the fit does not know yet included."""
MAGNITUDE_GATE = 2.0
"""Difference of magnitudes beyond which a star and a detection do not match."""
STILL_PX = 0.03
"""Steps that move no star farther are the last: what the linear problem leaves is of their second order."""
BENT_PX = 0.01
"""Bound on what the linear problem leaves, a third of it at most in truth, below which a step is the last as well."""
ASTRAY = 2.0
"""Factor between focal lengths, before and after, from which a fit of wrong matches has run away."""
_STEPS = 4
_MATCHINGS = 2
_LEAST = 3
_FIT = 106
_ADJUGATE = np.array([[1.0, -1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Refined:
    """identification: with the attitude, covariance, matches and residuals of the fit. camera: with the fit's focal length, k1,
    p1 and p2. scale: factor on the sigmas of the matched stars that their residuals show; the covariance holds it. strain:
    the largest of what the fit found of centre, k1, p1 and p2, over the prior's sigma. lens: (6,) p of `Lens.predict`."""

    identification: Identification
    camera: Camera
    scale: float
    strain: float = 0.0
    lens: np.ndarray = field(default_factory=lambda: np.zeros(PARAMETERS - 3))


def refine(
    found: Identification, centroids: Centroids, camera: Camera, sky: Sky, prior: LensPrior, epoch_years: float = 0.0,
    magnitude: np.ndarray | None = None, magnitude_gate: float = MAGNITUDE_GATE,
) -> Refined:  # fmt: skip
    """Fit attitude and lens to all stars that match, from a solved identification.

    camera: as the identification took it. epoch_years: 1 sigma of the time from the sky's year to the image. magnitude: (n,)
    of the centroids, that of their flux by default. Where fewer than three stars match, or the fit runs away, the
    identification stays as it is.
    """
    R, library = matrix_of_quaternion(found.q_SN), kernels()
    p = np.array([math.log(found.focal_px / camera.focal_px), 0.0, 0.0, 0.0, 0.0, 0.0])
    as_it_is = Refined(found, replace(camera, focal_px=found.focal_px), 1.0, lens=p)
    if magnitude is None:
        magnitude = -2.5 * np.log10(np.maximum(centroids.flux, 1e-12))
    zero = middle(sky.magnitude[found.stars] - magnitude[found.detections])
    near, d_N, V = _in_view(sky, R, camera, found.focal_px, zero + float(magnitude.max()) + magnitude_gate)
    at = np.minimum(near.searchsorted(found.stars), len(near) - 1)
    good = near[at] == found.stars if len(near) else np.zeros(len(at), bool)
    i, j = at[good], found.detections[good]
    if len(i) < _LEAST:
        return as_it_is
    drift = epoch_years * found.focal_px * np.hypot(sky.catalog.pm_ra[near], sky.catalog.pm_dec[near])
    density = len(centroids) / (camera.width * camera.height)
    problem = _Problem(
        Lens.of(camera, prior), d_N, V, drift, centroids.xy_px, centroids.covariance_px, magnitude, zero, magnitude_gate,
        density,
    )  # fmt: skip
    fit = _fit(problem, R, p, i, j) if library is None else _compiled(library, problem, R, p, i, j)
    if not abs(fit.p[0] - p[0]) < math.log(ASTRAY):  # nor where it is no number
        return as_it_is
    order = np.argsort(fit.j, kind="stable")
    i, j, residual = near[fit.i[order]], fit.j[order], fit.residual[order] * [1.0, camera.aspect]
    focal, flat = camera.focal_px * math.exp(fit.p[0]), residual.ravel()
    better = replace(
        turned(found, fit.R, fit.covariance[:3, :3]), stars=i, detections=j, hip=sky.catalog.hip[i], residuals_px=residual,
        focal_px=focal, residual_rms=math.sqrt(flat @ flat / flat.size) / focal,
    )  # fmt: skip
    strain = math.sqrt((fit.p[1:] ** 2 * problem.lens.known[4:]).max())
    return Refined(better, problem.lens.fitted(fit.p), fit.scale, strain, fit.p)


def turned(found: Identification, R_SN: np.ndarray, covariance: np.ndarray) -> Identification:
    """With another attitude R_SN (3, 3) of the sensor, and its covariance (3, 3)."""
    q_SN, z = quaternion_of(R_SN), R_SN[2]
    q_BN = q_SN
    if found.q_BN is not found.q_SN:
        R_BS = matrix_of_quaternion(found.q_BN) @ matrix_of_quaternion(found.q_SN).T
        q_BN = quaternion_of(R_BS @ R_SN)
    return replace(
        found, q_SN=q_SN, q_BN=q_BN, covariance=covariance, ra=math.atan2(z[1], z[0]) % (2.0 * math.pi),
        dec=math.asin(max(-1.0, min(1.0, z[2]))), roll=math.atan2(-R_SN[0, 2], -R_SN[1, 2]) % (2.0 * math.pi),
    )  # fmt: skip


def _in_view(
    sky: Sky, R: np.ndarray, camera: Camera, focal_px: float, faintest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (n,) of the stars brighter than `faintest` that a pinhole at R sees on the image and a margin of 4% around it, their
    directions (n, 3) and their V."""
    half_x, half_y = 0.54 * camera.width / focal_px, 0.54 * camera.height * camera.aspect / focal_px
    off_x = (0.5 * (camera.width - 1) - camera.cx) / focal_px
    off_y = (0.5 * (camera.height - 1) - camera.cy) * camera.aspect / focal_px
    window = Window(R, (off_x - half_x, off_y - half_y), (off_x + half_x, off_y + half_y))
    axis = R.T @ np.array([off_x, off_y, 1.0])
    near = sky.around(axis / math.sqrt(axis @ axis), math.atan(math.hypot(half_x, half_y)), window)
    near = near[: near.searchsorted(sky.magnitude.searchsorted(faintest))]
    return near, sky.directions.take(near, axis=0), sky.magnitude.take(near)


@dataclass(frozen=True)
class _Problem:
    """Stars: directions (n, 3), V (n,), and drift (n,), px, by which they may have moved, the brightest first. Detections: xy
    (m, 2) and covariance (m, 2, 2), px, magnitude (m,), which with `zero` is V to `magnitude_gate`, and density, 1/px^2."""

    lens: Lens
    directions: np.ndarray
    V: np.ndarray
    drift: np.ndarray
    xy: np.ndarray
    covariance: np.ndarray
    magnitude: np.ndarray
    zero: float
    magnitude_gate: float
    density: float


@dataclass(frozen=True)
class _Fit:
    """R (3, 3) and p (6,), the covariance (9, 9) of both, the scale, and the matches i, j (k,) with their residuals (k, 2), px."""

    R: np.ndarray
    p: np.ndarray
    covariance: np.ndarray
    scale: float
    i: np.ndarray
    j: np.ndarray
    residual: np.ndarray


def _fit(q: _Problem, R: np.ndarray, p: np.ndarray, i: np.ndarray, j: np.ndarray) -> _Fit:
    """Gauss and Newton's steps from R, p and the matches i, j, which are looked for again at each."""
    lens, xy, C, drift, best = q.lens, q.xy, q.covariance, q.drift, None
    spread = lambda i, j: C[j] + drift[i, None, None] ** 2 * lens.round
    agree = np.abs(q.V[:, None] - q.magnitude - q.zero) < q.magnitude_gate
    residual = np.zeros((0, 2))
    for _ in range(_STEPS):
        predicted, J = lens.predict(R, p, q.directions)
        best = None if best is None else replace(best, delta=np.zeros(PARAMETERS))
        best = _settle(J[i], xy[j] - predicted[i], spread(i, j), lens.prior(p), 2 if best is None else 1, best)
        for _ in range(_MATCHINGS):
            k, m, gain = _matched(predicted + best.moved(J), J, best, xy, C, drift, agree, q.density)
            few = len(k) < max(_LEAST, len(i) // 2)
            depth = _depth(gain, k, len(xy))
            k, m = k[:depth], m[:depth]
            same = len(k) == len(i) and bool((k == i).all() and (m == j).all())
            if same or few or len(k) < _LEAST:
                break
            i, j = k, m
            best = _settle(J[i], xy[j] - predicted[i], spread(i, j), lens.prior(p), 2, best)
        R, p = turn(best.delta[:3], R), p + best.delta[3:]
        moved = best.moved(J[i])
        residual = xy[j] - predicted[i] - moved
        if lens.second_order(best.delta) < BENT_PX or float(np.abs(moved).max()) < STILL_PX:
            break
    assert best is not None
    return _Fit(R, p, best.covariance, best.scale, i, j, residual)


class _InC(ctypes.Structure):
    """Problem of refine.c."""

    _fields_ = (
        [(k, ctypes.c_int64) for k in ("n", "m", "least", "steps", "matchings")]
        + [(k, ctypes.c_double) for k in ("aspect", "focal", "cx", "cy")]
        + [("distortion", ctypes.c_double * 5), ("known", ctypes.c_double * PARAMETERS)]
        + [(k, ctypes.c_double) for k in ("zero", "magnitude_gate", "density", "gate", "huber", "degrees", "still", "bent")]
        + [(k, ctypes.c_void_p) for k in ("directions", "V", "drift", "xy", "covariance", "magnitude")]
    )  # fmt: skip


def _compiled(library: ctypes.CDLL, q: _Problem, R: np.ndarray, p: np.ndarray, i: np.ndarray, j: np.ndarray) -> _Fit:
    """As `_fit`, by refine.c."""
    n, m, c = len(q.directions), len(q.xy), q.lens.camera
    arrays = (q.directions, q.V, q.drift, q.xy, q.covariance, q.magnitude)
    shapes = ((n, 3), (n,), (n,), (m, 2), (m, 2, 2), (m,))
    if tuple(x.shape for x in arrays) != shapes:
        raise ValueError(f"stars and detections have the shapes {[x.shape for x in arrays]}, not {list(shapes)}")
    s = _InC(
        n, m, _LEAST, _STEPS, _MATCHINGS, c.aspect, c.focal_px, c.cx, c.cy, c.distortion, tuple(q.lens.known.tolist()), q.zero,
        q.magnitude_gate, q.density, GATE, HUBER, SCALE_DEGREES, STILL_PX, BENT_PX,
    )  # fmt: skip
    # One array in and two out, which refine.c divides as here: an array's address takes Python as long as ten stars take C.
    given, room = np.concatenate([x.ravel() for x in arrays], dtype=float), max(n, len(i))
    matches, fit = np.empty((2, room), dtype=np.int64), np.empty(_FIT + 2 * room)
    matches[0, : len(i)], matches[1, : len(i)] = i, j
    fit[:9], fit[9:15] = R.ravel(), p
    call = library.helmstar_refine
    call.restype = ctypes.c_int64
    pointers = [ctypes.c_void_p(address(x)) for x in (given, fit, matches)]
    count = call(ctypes.byref(s), *pointers, ctypes.c_int64(room), ctypes.c_int64(len(i)))
    if count == -2:
        raise MemoryError("no room for the last fit")
    if count < 0:
        raise IndexError("a match is of a detection that is not in the list")
    return _Fit(
        fit[:9].reshape(3, 3), fit[9:15], fit[24:105].reshape(9, 9), float(fit[105]), matches[0, :count], matches[1, :count],
        fit[_FIT : _FIT + 2 * count].reshape(-1, 2),
    )  # fmt: skip


@dataclass(frozen=True)
class _Settled:
    """Step (9,) of the parameters, their covariance (9, 9), and the scale of the residuals."""

    delta: np.ndarray
    covariance: np.ndarray
    scale: float

    def moved(self, J: np.ndarray) -> np.ndarray:
        """By how much pixels of that derivative (n, 2, 9) move, (n, 2)."""
        return (J.reshape(-1, PARAMETERS) @ self.delta).reshape(-1, 2)


def _settle(
    J: np.ndarray, residual: np.ndarray, covariance: np.ndarray, prior: tuple[np.ndarray, np.ndarray], rounds: int,
    start: _Settled | None = None,
) -> _Settled:  # fmt: skip
    """The linear problem J delta = residual (n, 2) with Huber's weights and the scale, `rounds` times, from what is
    settled already."""
    known, pull = prior
    det = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] ** 2
    W = covariance[:, ::-1, ::-1] * _ADJUGATE / det[:, None, None]
    A = J.reshape(-1, PARAMETERS)
    # Inverted in units in which the information is about one: priors span many orders.
    size = 1.0 / np.sqrt((A * A).sum(axis=0) + known)
    WJ = W[:, :, :1] * J[:, None, 0] + W[:, :, 1:] * J[:, None, 1]
    k, target = np.arange(PARAMETERS), residual.ravel()
    if start is None:
        start = _Settled(
            np.zeros(PARAMETERS), np.diag(np.where(known > 0.0, 1.0 / np.maximum(known, 1e-300), 0.0)), 1.0
        )
    delta, P, scale = start.delta, start.covariance, start.scale
    units, tiny = size * size[:, None], 1e-13 * np.eye(PARAMETERS)
    for _ in range(rounds):
        rx, ry = (target - A @ delta).reshape(-1, 2).T
        square = np.maximum(W[:, 0, 0] * rx * rx + 2.0 * W[:, 0, 1] * rx * ry + W[:, 1, 1] * ry * ry, 1e-12)
        weight = np.minimum(1.0, HUBER * scale / np.sqrt(square))
        seen = PARAMETERS - float(P[k, k] @ known)  # parameters that the stars fix, not the priors
        free = max(2.0 * float(weight.sum()) - seen, 0.0)
        scale = float(np.sqrt((SCALE_DEGREES + weight @ square) / (SCALE_DEGREES + free)))
        weighted = (WJ * (weight / scale**2)[:, None, None]).reshape(-1, PARAMETERS)
        N = A.T @ weighted
        N[k, k] += known
        P = np.linalg.inv(N * units + tiny) * units
        delta = P @ (weighted.T @ target + pull)
    return _Settled(delta, P, scale)


def _matched(
    predicted: np.ndarray,
    J: np.ndarray,
    fit: _Settled,
    xy: np.ndarray,
    C: np.ndarray,
    drift: np.ndarray,
    agree: np.ndarray,
    density: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stars and detections (k,), (k,) that are each other's nearest within the gate and agree (stars, detections), brightest
    star first, and the log (k,) of how much likelier each is so than by chance. density: 1/px^2, of detections."""
    A = J.reshape(-1, PARAMETERS)
    sigma2 = fit.scale**2 * 0.5 * (C[:, 0, 0] + C[:, 1, 1])
    doubt2 = 0.5 * ((A @ fit.covariance) * A).sum(axis=1).reshape(-1, 2).sum(axis=1) + drift**2
    apart = (predicted[:, :1] - xy[:, 0]) ** 2 + (predicted[:, 1:] - xy[:, 1]) ** 2
    apart[~agree | (apart > GATE**2 * (sigma2 + doubt2[:, None]))] = np.inf
    j = apart.argmin(axis=1)
    rows = np.arange(len(apart))
    good = np.flatnonzero(np.isfinite(apart[rows, j]) & (apart.argmin(axis=0)[j] == rows))
    j = j[good]
    variance = sigma2[j] + doubt2[good]
    gain = -0.5 * apart[good, j] / variance - np.log(2.0 * np.pi * variance * density)
    return good, j, gain


def _depth(gain: np.ndarray, rank: np.ndarray, count: int) -> int:
    """How many of the matches, brightest first, belong to the depth that an image of `count` detections most probably has.

    Of the S brightest stars k are matched, at any share: k! (S - k)!/(S + 1)! of it, and 1/S of S (`stars.verify`). Beyond, where
    few of many stars have a match, the matches are those that chance gives. gain: (m,); rank: (m,) of the star.
    """
    if len(gain) == 0:
        return 0
    k, S = np.arange(1, len(gain) + 1), rank + 1
    factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1.0, S[-1] + 2.0)))])
    vacancy = np.cumsum(np.log((count + 1.0) / (count + 1.0 - k)))
    total = np.cumsum(gain) + vacancy + factorial[k] + factorial[S - k] - factorial[S + 1] - np.log(S)
    return int(total.argmax()) + 1


__all__ = ["EPOCH_SPREAD_YEARS", "Refined", "refine", "turned"]
