"""What is known of a target before a frame of it is looked at, and what is known of its centre after."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..camera import Camera
from .photometry import Law
from .shape import Shape

FOUND = "found"
NO_BODY = "no body"
CUT = "cut by the edge"
SATURATED = "saturated"
DARK = "too dark"
AMBIGUOUS = "ambiguous"
FAILED = "no fit"
SPOT = 0.3
"""Size of spots over the diameter: large ones move centres most, and a few make up a body."""
STATUSES = (FOUND, NO_BODY, CUT, SATURATED, DARK, AMBIGUOUS, FAILED)


@dataclass(frozen=True)
class Target:
    """shape: the figure. law: how it reflects, None where nothing is known. law_known: whether that law is the truth; if not,
    the covariance allows for others. radius_sigma, shape_sigma: relative 1 sigma of its size, and of its axes each for itself.
    albedo_sigma: relative 1 sigma of the light of spots SPOT of the diameter across, about what the law says."""

    shape: Shape
    law: Law | None = None
    law_known: bool = False
    radius_sigma: float = 0.0
    shape_sigma: float = 0.0
    albedo_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius_sigma", "shape_sigma", "albedo_sigma"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} {getattr(self, name)}: must be from 0 to below 1")
        if self.law_known and self.law is None:
            raise ValueError("law_known: needs a law")


@dataclass(frozen=True)
class Pose:
    """How the target is expected to be seen. distance: m, camera to body's centre; distance_sigma: m. sun_C: (3,) from body to Sun,
    in C. R_TC: (3, 3), turns components in C into T. near_px: (2,) where its centre is expected in the frame, or None;
    near_sigma_px: 1 sigma of that."""

    distance: float
    sun_C: np.ndarray
    R_TC: np.ndarray = field(default_factory=lambda: np.eye(3))
    distance_sigma: float = 0.0
    near_px: np.ndarray | None = None
    near_sigma_px: float = 50.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.distance) and self.distance > 0.0 and self.distance_sigma >= 0.0):
            raise ValueError(f"distance {self.distance}, sigma {self.distance_sigma}: must be positive, m")
        sun = np.asarray(self.sun_C, float)
        object.__setattr__(self, "sun_C", sun / np.linalg.norm(sun))
        object.__setattr__(self, "R_TC", np.asarray(self.R_TC, float))

    def position(self, camera: Camera, centre_px: np.ndarray) -> np.ndarray:
        """r_TC_C (3,), m, of a body whose centre is seen there."""
        return self.distance * camera.directions(np.asarray(centre_px, float))

    def phase(self, camera: Camera, centre_px: np.ndarray) -> float:
        """Sun - body - camera, rad."""
        return float(np.arccos(np.clip(-camera.directions(np.asarray(centre_px, float)) @ self.sun_C, -1.0, 1.0)))

    def scale_sigma(self, target: Target) -> float:
        """Relative 1 sigma of the apparent size, from radius and distance."""
        return float(np.hypot(target.radius_sigma, self.distance_sigma / self.distance))


@dataclass(frozen=True)
class Detector:
    """gain_e: electrons per count, None where not known: then a count is taken for an electron by sums, and fits estimate it.
    psf_sigma_px: of the optics, with its relative 1 sigma psf_spread."""

    gain_e: float | None = None
    psf_sigma_px: float = 0.8
    psf_spread: float = 0.15


@dataclass(frozen=True)
class FigureCentre:
    """status: one of STATUSES; where it is not `found` the centre is NaN, unless a fit could do without what is missing.

    centre_px: (2,) where the body's centre is seen, px of the frame. covariance_px: (2, 2), px^2, with what is not known of radius,
    law and shape. centroid_px: (2,) brightness centroid. size: apparent over expected diameter, with size_sigma. limb_px: (n, 2)
    edge points that were used. chi2: of the fit's residuals per degree of freedom. message: why the status is what it
    is. common_px: (2, 2), the part of the covariance that frames of the same body share, px^2.
    """

    status: str
    method: str
    centre_px: np.ndarray
    covariance_px: np.ndarray
    centroid_px: np.ndarray
    diameter_px: float
    size: float = 1.0
    size_sigma: float = float("nan")
    limb_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    chi2: float = float("nan")
    message: str = ""
    common_px: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def usable(self) -> bool:
        """Whether there is a centre."""
        return bool(np.isfinite(self.centre_px).all() and np.isfinite(self.covariance_px).all())

    @property
    def sigma_px(self) -> np.ndarray:
        """(2,) 1 sigma along columns and rows."""
        return np.sqrt(np.diagonal(self.covariance_px))


def nothing(status: str, method: str, message: str, diameter_px: float = float("nan")) -> FigureCentre:
    """No centre, and why."""
    return FigureCentre(
        status, method, np.full(2, np.nan), np.full((2, 2), np.nan), np.full(2, np.nan), diameter_px, message=message
    )


__all__ = [
    "AMBIGUOUS", "CUT", "DARK", "FAILED", "FOUND", "NO_BODY", "SATURATED", "SPOT", "STATUSES", "Detector", "FigureCentre",
    "Pose", "Target", "nothing",
]  # fmt: skip
