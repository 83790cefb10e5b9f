"""The centre of a body in a frame by the method that suits it: moment for a few pixels, fit for most, limb for the largest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..camera import Camera
from ..frame import Image
from .limb import centre_from_limb
from .moment import centre_of_centroid, windowed_centroid
from .shape import Ellipsoid
from .target import FOUND, Detector, FigureCentre, Pose, Target
from .template_fit import centre_from_fit

MOMENT_BELOW_PX = 5.0
LIMB_ABOVE_PX = 400.0
METHODS = ("auto", "moment", "fit", "limb")


def find_centre(
    image: Image, camera: Camera, target: Target, pose: Pose, detector: Detector | None = None, *, method: str = "auto",
    corner: tuple[int, int] = (0, 0),
) -> FigureCentre:  # fmt: skip
    """Centre of figure with covariance, or why there is none.

    corner: the frame's pixel that the image's (0, 0) is. method: one of METHODS; auto is by apparent diameter, the fit below
    LIMB_ABOVE_PX, and a fit where a limb fails. Raises ValueError for another method.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r}: must be one of {', '.join(METHODS)}")
    diameter = 2.0 * target.shape.mean_radius * camera.focal_px / pose.distance
    centroid = windowed_centroid(
        image, detector, corner=corner, near_px=pose.near_px, near_sigma_px=pose.near_sigma_px + 0.5 * diameter,
        reach_px=0.6 * diameter * target.shape.reach / target.shape.mean_radius,
    )  # fmt: skip
    first = method
    if method == "auto":
        large = diameter > LIMB_ABOVE_PX and isinstance(target.shape, Ellipsoid)
        first = "moment" if diameter < MOMENT_BELOW_PX else "limb" if large else "fit"
    if first == "moment":
        return centre_of_centroid(centroid, camera, target, pose)
    find = centre_from_limb if first == "limb" else centre_from_fit
    found = find(image, camera, target, pose, detector, corner=corner, centroid=centroid)
    if method == "auto" and first == "limb" and not found.usable:
        found = centre_from_fit(image, camera, target, pose, detector, corner=corner, centroid=centroid)
    # Not a moment in place of a fit: what no template fits is not what the moment's model takes it for.
    return _checked(found, diameter)


def _checked(found: FigureCentre, diameter_px: float) -> FigureCentre:
    """A centre whose light lies farther from it than the body reaches is no centre of that light."""
    away = float(np.hypot(*(found.centre_px - found.centroid_px)))
    if found.usable and found.status == FOUND and away > 1.5 * diameter_px + 5.0:
        nan = np.full((2, 2), np.nan)
        return replace(
            found, status="no fit", centre_px=nan[0], covariance_px=nan,
            message=f"the fit went {away:.0f} px from the light; are distance and radius right?",
        )  # fmt: skip
    return found


__all__ = ["LIMB_ABOVE_PX", "METHODS", "MOMENT_BELOW_PX", "find_centre"]
