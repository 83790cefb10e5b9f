"""A first look: most images show their stars plainly, and the brightest of them are enough to know where it points.

The brightest detections are tried on a few hundred catalogue pairs, and the best hypothesis of these is verified. What is not
overwhelming is left to the whole search of `identify`, which has all the detections, or to `track`. Attitude and covariance are
those of the fit: the last fit of a sensor follows.
"""

from __future__ import annotations

import math

import numpy as np

from .hypotheses import hypotheses, levels_for
from .identify import FEWEST, Identification, focal_freedom, matrix_of_quaternion, unit_quaternion
from .patterns import BRIGHT, LADDER, Sky
from .pinhole import Camera
from .problem import Fit, prepare
from .stage import detection_pairs
from .track import WIDEST_PX
from .verify import GATE, SO3_VOLUME, probability_false, verify

SHARE = 0.1
"""Of the limit on the probability that a solution is false: so much more may be false for having looked twice."""
LOOKED_AT = 16
"""Detections, the brightest."""
PAIRS, CHUNKS = 300, 3
"""Catalogue pairs in the first chunk, and chunks; each has twice as many as the one before."""
LEAST_SCORE = 5.0
"""Of a hypothesis that is worth verifying: its two stars and three more."""


def glance(
    xy_px: np.ndarray, flux: np.ndarray, covariance_px: np.ndarray, camera: Camera, sky: Sky, focal_sigma: float, limit: float,
    q_SB: np.ndarray | None = None, magnitude_sigma: float = 0.4,
) -> Identification | None:  # fmt: skip
    """An identification from the brightest detections, or None where it is not plain. Arguments as for `identify`, the list with
    its brightest first; indices of detections are the caller's."""
    n = LOOKED_AT
    d, _ = prepare(xy_px[:n], camera, flux[:n], None, covariance_px[:n], magnitude_sigma, None)
    if len(d) < 2 * FEWEST:
        return None
    freedom = focal_freedom(camera, None, focal_sigma)
    pairs = detection_pairs(d)
    for level, part in levels_for(d, freedom, LADDER):
        chunks = hypotheses(sky.level(level), BRIGHT, d, pairs[: 8 * CHUNKS], part, 1, PAIRS)
        for _, (_, found) in zip(range(CHUNKS), chunks):
            if found is None or found.score[0] < LEAST_SCORE:
                continue
            # One step is enough for most; a second one is there for hypotheses of a short pair.
            for rounds in (1, 2):
                fit = verify(sky, level, d, found.R[0], float(found.f[0]), freedom, first_gate=2.5, rounds=rounds)
                if fit is not None and len(fit.stars) >= FEWEST and probability_false([fit]) < SHARE * limit:
                    return plain(sky, fit, d.order[fit.detections], q_SB)
    return None


def follow(
    xy_px: np.ndarray, flux: np.ndarray, covariance_px: np.ndarray, camera: Camera, sky: Sky, focal_sigma: float, limit: float,
    prior_q_SN: np.ndarray, prior_sigma: float, q_SB: np.ndarray | None = None, magnitude_sigma: float = 0.4,
) -> Identification | None:  # fmt: skip
    """As `glance`, near a predicted attitude; arguments as for `track`, which is for what is not plain."""
    n = LOOKED_AT
    d, _ = prepare(xy_px[:n], camera, flux[:n], None, covariance_px[:n], magnitude_sigma, None)
    if len(d) < 2 * FEWEST:
        return None
    freedom = focal_freedom(camera, None, focal_sigma)
    window = math.hypot(1.0, prior_sigma * camera.focal_px / d.typical_sigma)
    if not window * d.typical_sigma * GATE <= WIDEST_PX:
        return None
    volume = min(SO3_VOLUME, (math.sqrt(2.0 * math.pi) * 2.0 * prior_sigma) ** 3)
    R = matrix_of_quaternion(unit_quaternion("prior_q_SN", prior_q_SN))
    level = levels_for(d, freedom, LADDER)[0][0]
    fit = verify(sky, level, d, R, camera.focal_px, freedom, first_gate=window, rounds=1, volume=volume)
    if fit is None or len(fit.stars) < 2 * FEWEST or probability_false([fit]) >= SHARE * limit:
        return None
    return plain(sky, fit, d.order[fit.detections], q_SB)


def plain(sky: Sky, fit: Fit, detections: np.ndarray, q_SB: np.ndarray | None) -> Identification:
    """A fit as an identification that is solved. detections: (k,) in the caller's list."""
    R, residuals = fit.R, fit.residuals.ravel()
    x, y, z = R[2].tolist()
    q_SN = quaternion_of(R)
    q_BN = q_SN if q_SB is None else quaternion_of(matrix_of_quaternion(q_SB).T @ R)
    return Identification(
        "solved", q_SN, q_BN, fit.covariance[:3, :3], math.atan2(y, x) % (2.0 * math.pi), math.asin(max(-1.0, min(1.0, z))),
        math.atan2(-R[0, 2], -R[1, 2]) % (2.0 * math.pi), detections, fit.stars, sky.catalog.hip[fit.stars],
        fit.residuals, math.sqrt(residuals @ residuals / residuals.size) / fit.f, fit.f, fit.zero_point,
        probability_false([fit]), fit.log_odds, 0,
    )  # fmt: skip


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """q (4,), scalar last, of one R (3, 3): as `attitude.quaternion_of_matrix`, in plain numbers."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    rows = (
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
        (h - f, c - g, d - b, 1.0 + a + e + i),
    )
    diagonal = [rows[k][k] for k in range(4)]
    x, y, z, w = rows[diagonal.index(max(diagonal))]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return np.array([x / norm, y / norm, z / norm, w / norm])


__all__ = ["follow", "glance", "plain", "quaternion_of"]
