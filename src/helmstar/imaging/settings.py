"""What detection is told: the scales it looks at, its settings, and the optics that a frame before showed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

HALF = (3, 5, 9, 17)
"""Half the side of a star's window at each level, px."""
WIDTH = (0.8, 1.5, 3.0, 6.0)
"""Sigma expected of a star found at each level, px."""


@dataclass(frozen=True)
class DetectionSettings:
    """threshold: sigma of the filtered image. max_stars: kept, the brightest. levels: 1 to 4 scales, each twice the one before.

    optics_px: least sigma of a centroid, for what no noise explains (optics are no Gaussians). gain: image counts per
    photo-electron; None estimates it from the stars' residuals.
    """

    threshold: float = 5.0
    max_stars: int = 100
    levels: int = 4
    optics_px: float = 0.05
    gain: float | None = None

    def __post_init__(self) -> None:
        if not 2.0 <= self.threshold <= 100.0:
            raise ValueError(f"threshold {self.threshold}: must be 2 to 100 sigma")
        if not 1 <= self.levels <= 4:
            raise ValueError(f"levels {self.levels}: must be 1 to 4")
        if not 1 <= self.max_stars <= 10_000:
            raise ValueError(f"max_stars {self.max_stars}: must be 1 to 10000")


@dataclass(frozen=True)
class Optics:
    """What one frame tells of the next by the same camera: sigma of the stars along x and y, px."""

    width: tuple[float, float]

    @property
    def level(self) -> int:
        """The scale at which such stars show best."""
        if max(self.width) > 0.6 * HALF[2]:  # however narrow the other way: a finer window would cut its ends off
            return 3
        return int(np.argmin(np.abs(np.log(np.array(WIDTH[:3]) ** 2 / np.prod(self.width)))))


__all__ = ["HALF", "WIDTH", "DetectionSettings", "Optics"]
