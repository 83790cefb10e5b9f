"""Tracking: identification with a prior attitude, which falls back to the whole sky when the prior proves wrong."""

from __future__ import annotations

import numpy as np

from .hypotheses import levels_for
from .identify import (
    FEWEST,
    LIMIT,
    Identification,
    conclude,
    default_sky,
    focal_freedom,
    identify,
    matrix_of_quaternion,
    unit_quaternion,
    unsolved,
)
from .patterns import LADDER, Sky
from .pinhole import Camera
from .problem import prepare
from .verify import SO3_VOLUME, verify

WIDEST_PX = 40.0
"""Windows wider than this hold too many stars to take the nearest: the whole sky is searched instead."""


def track(
    xy_px: np.ndarray,
    camera: Camera,
    prior_q_SN: np.ndarray,
    prior_sigma: float,
    *,
    flux: np.ndarray | None = None,
    magnitude: np.ndarray | None = None,
    sigma_px: float | np.ndarray = 0.5,
    focal_sigma: float = 0.001,
    magnitude_sigma: float = 0.4,
    zero_point: float | None = None,
    q_SB: np.ndarray | None = None,
    sky: Sky | None = None,
    limit: float = LIMIT,
    fall_back: bool = True,
) -> Identification:
    """Identify the stars of an image near a predicted attitude; other arguments as for `identify`.

    prior_q_SN: (4,) scalar last. prior_sigma: rad, 1 sigma per axis. Stars are sought in windows of both sigmas; the solution
    does not use the prior otherwise, so a filter may. Where that finds nothing convincing and fall_back is set, the whole sky
    is searched.

    Raises ValueError for a prior that is no attitude and for what `identify` refuses.
    """
    q = unit_quaternion("prior_q_SN", prior_q_SN)
    if q_SB is not None:
        q_SB = unit_quaternion("q_SB", q_SB)
    if not 0.0 < prior_sigma < np.pi:
        raise ValueError(f"prior_sigma {prior_sigma} rad: must be between 0 and pi")
    d, covariances = prepare(xy_px, camera, flux, magnitude, sigma_px, magnitude_sigma, zero_point)
    freedom = focal_freedom(camera, None, focal_sigma)
    sky = default_sky() if sky is None else sky
    if len(d) < FEWEST:
        return unsolved("too few stars", 0)
    sigma = d.typical_sigma
    window = float(np.hypot(sigma, prior_sigma * camera.focal_px) / sigma)
    if window * sigma * 3.6 <= WIDEST_PX:
        level = levels_for(d, freedom, LADDER)[0][0]
        volume = min(SO3_VOLUME, (np.sqrt(2.0 * np.pi) * 2.0 * prior_sigma) ** 3)
        R = matrix_of_quaternion(q)
        # One step is enough for most; a second one is there for windows in which many false matches pull.
        for rounds in (1, 2):
            fit = verify(sky, level, d, R, camera.focal_px, freedom, first_gate=window, rounds=rounds, volume=volume)
            if fit is not None:
                found = conclude(sky, d, covariances, freedom, [fit], 0, FEWEST, limit, q_SB)
                if found.solved:
                    return found
    if not fall_back:
        return unsolved("no match", 0)
    return identify(
        xy_px, camera, flux=flux, magnitude=magnitude, sigma_px=sigma_px, focal_sigma=focal_sigma, sky=sky, limit=limit,
        magnitude_sigma=magnitude_sigma, zero_point=zero_point, q_SB=q_SB,
    )  # fmt: skip


__all__ = ["track"]
