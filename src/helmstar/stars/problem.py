"""What identification is about: the detections of an image, what is known of the focal length, and an attitude fitted to them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np


def middle(x: np.ndarray) -> float:
    """Median, the upper one of an even number; np.median takes ten times as long for a few numbers."""
    return float(np.partition(x, len(x) // 2)[len(x) // 2])


@dataclass(frozen=True)
class Detections:
    """What identification knows of an image; every array has its brightest entry first where brightness is known.

    xy: (n, 2) ideal pixels from the principal point. sigma: (n,) px, per axis. magnitude: (n,) or None, of unknown zero point
    unless `zero_point` (V minus magnitude) is given. log_magnitude_density: (n,) log of the detections' own magnitude density,
    log_density: (n,) log of their own density in the image (1/px^2), one more counted.
    low, high: (2,) corners of the image in ideal pixels. order: (n,) index in the caller's list.
    """

    xy: np.ndarray
    sigma: np.ndarray
    magnitude: np.ndarray | None
    magnitude_sigma: float
    zero_point: float | None
    log_magnitude_density: np.ndarray
    log_density: np.ndarray
    low: np.ndarray
    high: np.ndarray
    order: np.ndarray

    @cached_property
    def area(self) -> float:
        return float(np.prod(self.high - self.low))

    @cached_property
    def vacancy(self) -> np.ndarray:
        """(n + 1,) log of what k = 0 ... n matches gain by leaving fewer detections to be false: (n + 1)^k (n - k)! / n!.

        The rate of false detections is unknown, with an even prior; `log_density` counts all n and one more as false.
        """
        n = len(self.xy)
        return np.concatenate([[0.0], np.cumsum(np.log((n + 1.0) / np.arange(n, 0, -1)))])

    @cached_property
    def faintest(self) -> float:
        """V of the faintest star that may be among them: where the zero point is known, infinity elsewhere."""
        if self.zero_point is None or self.magnitude is None or len(self.xy) == 0:
            return math.inf
        return float(self.magnitude[-1]) + self.zero_point + 3.0 * self.magnitude_sigma

    @cached_property
    def in_c(self) -> np.ndarray:
        """The arrays as verify.c reads them, one after the other. Raises ValueError for shapes that do not belong together."""
        n, given = len(self.xy), [self.xy, self.sigma, self.log_density, self.log_magnitude_density, self.vacancy]
        given += [self.magnitude if self.magnitude is not None else np.zeros(n)]
        shapes = [(n, 2), (n,), (n,), (n,), (n + 1,), (n,), (2,), (2,)]
        got = [x.shape for x in (*given, self.low, self.high)]
        if got != shapes:
            raise ValueError(f"detections have the shapes {got}, not {shapes}")
        return np.concatenate([x.ravel() for x in given], dtype=float)

    @cached_property
    def typical_sigma(self) -> float:
        return middle(self.sigma)

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True)
class Fit:
    """An attitude with its matches: R (3, 3) = R_SN, f in px, stars and detections (k,) by index, log_odds against "all
    false", sigma_scale the factor on the detections' sigma, information (4, 4) of (theta in S, ln f) with that factor."""

    R: np.ndarray
    f: float
    stars: np.ndarray
    detections: np.ndarray
    residuals: np.ndarray
    log_odds: float
    sigma_scale: float
    zero_point: float
    information: np.ndarray


@dataclass(frozen=True)
class Freedom:
    """The focal length's prior: uniform in ln f between the logs of f_low and f_high, or Gaussian of relative sigma around
    f_known; sigma 0 keeps it fixed."""

    f_low: float
    f_high: float
    f_known: float = 0.0
    sigma: float = 0.0

    @property
    def free(self) -> bool:
        return self.f_known <= 0.0


__all__ = ["Detections", "Fit", "Freedom", "middle"]
