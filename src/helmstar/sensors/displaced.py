"""Attitude by a lens that displaces stars as no model of a lens says: what neighbours share is a smooth field, and is estimated.

The residuals of a fit of attitude and lens (`refine`) are taken as noise, of the centroids and of w beyond, and a smooth random
field on each axis of the image, with Matern's covariance of order 5/2, A^2 (1 + a + a^2/3) exp(-a), a = sqrt(5) d/L, at a distance
d (universal kriging: Cressie, Statistics for Spatial Data, 1993, section 3.4; the trend is the linearised fit, with its priors).
A and w are averaged over, by their likelihood and a prior that expects A at `EXPECTED` of the width. The direction of S's z axis is
what is seen at the stated centre, so the field there belongs to the attitude; roll is that of the fit to the whole image.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..imaging import Camera, Centroids
from ..stars.identify import Identification, matrix_of_quaternion
from ..stars.patterns import Sky
from ..stars.verify import turn
from .lens import PARAMETERS, Lens, LensPrior, turn_to
from .refine import ASTRAY, BENT_PX, HUBER, Refined, turned

EXPECTED = 0.0015
"""Of the image's width: the field's amplitude A above which it is less and less expected."""
AMPLITUDES = np.geomspace(0.0001, 0.0128, 8)
NOISES = np.geomspace(0.00002, 0.00256, 8)
"""A and w that are tried, over the image's width."""
REACH = 0.35
"""L, over the image's width."""
MOST = 150
"""Stars, the brightest: the cost goes with their cube."""
BELIEF = 2.0
"""Coordinates that what is believed of a displacement is worth."""
STEPS = 8
"""At most, of Gauss and Newton."""


def displaced(fit: Refined, centroids: Centroids, camera: Camera, sky: Sky, prior: LensPrior) -> Refined:
    """The fit with attitude, lens and covariance that a smooth displacement leaves. prior: of the lens, as the fit had it.

    Fits of fewer than three stars, and those that run away, come back with what is expected of a displacement in the covariance.
    """
    i = fit.identification
    stars, detections = i.stars[:MOST], i.detections[:MOST]
    doubted = replace(fit, identification=smoothly(i, EXPECTED * camera.width, fit.camera))
    if len(stars) < 3:
        return doubted
    xy, C, d_N = centroids.xy_px[detections], centroids.covariance_px[detections], sky.directions[stars]
    variance = 0.5 * (C[:, 0, 0] + C[:, 1, 1] * camera.aspect**2)
    R, p, lens = matrix_of_quaternion(i.q_SN), fit.lens, Lens.of(camera, prior)
    for _ in range(STEPS):
        mean, P = _step(lens, R, p, d_N, xy, variance)
        if not (np.isfinite(mean).all() and abs(p[0] + mean[3] - fit.lens[0]) < math.log(ASTRAY)):
            return doubted
        R, p = turn(mean[:3], R), p + mean[3:9]
        if lens.second_order(mean[:9]) < BENT_PX:
            break
    fitted, seen = lens.fitted(p), lens.seen_at_centre(p)
    # z is turned to what the lens sees at the centre, and to what the field displaces to there.
    lean = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
    sizes = 1e-3 / np.sqrt(np.maximum(lens.known[3:], 1.0))
    slopes = np.stack([(lens.seen_at_centre(p + step) - seen) / step.sum() for step in np.diag(sizes)], axis=1)
    T = np.concatenate([np.eye(3), lean @ slopes, -lean / fitted.focal_px], axis=1)
    R_SN = turn(T[:, 9:] @ mean[9:], turn_to(*seen).T @ R)
    residual = centroids.xy_px[i.detections] - lens.predict(R, p, sky.directions[i.stars])[0]
    residual[:, 1] *= camera.aspect
    found = replace(
        turned(i, R_SN, T @ P @ T.T), residuals_px=residual, focal_px=fitted.focal_px,
        residual_rms=math.sqrt(float(np.square(residual).mean())) / fitted.focal_px,
    )  # fmt: skip
    return replace(fit, identification=found, camera=fitted, lens=p)


def _step(
    lens: Lens, R: np.ndarray, p: np.ndarray, d_N: np.ndarray, xy: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (11,) and covariance (11, 11) of a step of the nine parameters from R, p, and of the field in the middle, x and y in
    pixel widths, averaged over A and w. variance: (n,) of the centroids."""
    camera, square = lens.camera, np.array([1.0, lens.camera.aspect])
    predicted, J = lens.predict(R, p, d_N)
    y, J = (xy - predicted) * square, J * square[:, None]
    place = (xy - [camera.cx, camera.cy]) * square
    size = np.hypot(*y.T)
    weight = np.minimum(1.0, HUBER * np.median(size) / np.maximum(size, 1e-12))
    known, pull = lens.prior(p)
    # In units in which the information is about one: priors span many orders.
    unit = 1.0 / np.sqrt(np.square(J).sum(axis=(0, 1)) / np.median(variance) + known)
    far = np.sqrt(np.square(place[:, None] - place).sum(axis=2))
    shape, middle = _matern(far, REACH * camera.width), _matern(np.hypot(*place.T), REACH * camera.width)
    logs, means, covariances = [], [], []
    for amplitude in AMPLITUDES * camera.width:
        expected = -math.log1p((amplitude / (EXPECTED * camera.width)) ** 2)
        for noise in NOISES * camera.width:
            V = amplitude**2 * shape + np.diag((variance + noise**2) / weight)
            log, mean, P = _kriged(V, amplitude**2 * middle, amplitude, y, J * unit, known * unit**2, pull * unit)
            logs.append(log + expected)
            means.append(mean)
            covariances.append(P)
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    mean = share @ np.array(means)
    off = np.array(means) - mean
    P = np.einsum("k,kij->ij", share, np.array(covariances)) + (off * share[:, None]).T @ off
    units = np.concatenate([unit, np.ones(2)])
    return mean * units, P * units * units[:, None]


def _matern(far: np.ndarray, reach: float) -> np.ndarray:
    a = math.sqrt(5.0) / reach * far
    return (1.0 + a + a * a / 3.0) * np.exp(-a)


def _kriged(
    V: np.ndarray, middle: np.ndarray, amplitude: float, y: np.ndarray, J: np.ndarray, known: np.ndarray, pull: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:  # fmt: skip
    """Log likelihood, and mean (11,) and covariance (11, 11) of the nine parameters and the field in the middle, x and y.

    V (n, n): of the residuals y (n, 2) of either axis; middle (n,): of the field there with them; J (n, 2, 9)."""
    from scipy.linalg import cho_factor, cho_solve, solve_triangular

    L = np.linalg.cholesky(V)
    white = solve_triangular(L, np.column_stack([J[:, 0], J[:, 1], y, middle]), lower=True)
    Jx, Jy, rx, ry, m = white[:, :9], white[:, 9:18], white[:, 18], white[:, 19], white[:, 20]
    S = Jx.T @ Jx + Jy.T @ Jy + np.diag(known)
    factor = cho_factor(S + 1e-12 * np.eye(9))
    g = Jx.T @ rx + Jy.T @ ry + pull
    delta, P = cho_solve(factor, g), cho_solve(factor, np.eye(9))
    log = (
        -0.5 * (rx @ rx + ry @ ry - g @ delta)
        - 2.0 * np.log(np.diagonal(L)).sum()
        - np.log(np.diagonal(factor[0])).sum()
    )
    B = np.stack([m @ Jx, m @ Jy])  # what the field takes of a step of the parameters
    field = np.array([m @ rx, m @ ry]) - B @ delta
    left = max(amplitude**2 - float(m @ m), 0.0)
    T = np.concatenate([np.eye(9), -B])
    covariance = T @ P @ T.T
    covariance[[9, 10], [9, 10]] += left
    return float(log), np.concatenate([delta, field]), covariance


def displaced_px(fit: Refined, believed_px: float) -> float:
    """By how much, 1 sigma per axis, a fit's stars are displaced: its residuals, of the freedom that the parameters left, and
    what was believed before, as worth as `BELIEF` coordinates; no more than that."""
    i = fit.identification
    chi2 = 2.0 * len(i.stars) * (i.residual_rms * fit.camera.focal_px) ** 2
    free = max(2.0 * len(i.stars) - PARAMETERS, 0.0)
    return min(believed_px, math.sqrt((BELIEF * believed_px**2 + chi2) / (BELIEF + free)))


def smoothly(found: Identification, sigma_px: float, camera: Camera) -> Identification:
    """With what moves all stars alike, and more of them do not average, in the covariance: 1 sigma per axis."""
    sigma = sigma_px / camera.focal_px
    spread = math.hypot(camera.width, camera.height * camera.aspect) / math.sqrt(12.0) / camera.focal_px
    return replace(found, covariance=found.covariance + sigma**2 * np.diag([1.0, 1.0, spread**-2]))


__all__ = ["displaced", "displaced_px", "smoothly"]
