"""What passes between image files, detection and identification: a grey image, and the stars found in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Image:
    """A grey image. array: (height, width), uint8, uint16 or float32, in the file's own units, rows downwards.

    saturation: value at which a pixel holds no more light. bits: depth of the file's samples. metadata: text by name.
    """

    array: np.ndarray
    saturation: float
    bits: int
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """Columns."""
        return self.array.shape[1]

    @property
    def height(self) -> int:
        """Rows."""
        return self.array.shape[0]


@dataclass(frozen=True)
class Centroids:
    """Stars found in an image, the largest flux first; arrays of n stars.

    x_px, y_px: (n,) float64 column and row of the centre; pixel centres are integers. flux: (n,) sum of what is above the
    background, in units of the image. covariance_px: (n, 2, 2) of (x, y), px^2. peak: (n,) brightest pixel above the background.
    saturated: (n,) bool, some pixel at the image's limit. elongation: (n,) longer over shorter axis of the light, 1 is round.
    snr: (n,) flux of the matched filter over its noise.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    flux: np.ndarray
    covariance_px: np.ndarray
    peak: np.ndarray
    saturated: np.ndarray
    elongation: np.ndarray
    snr: np.ndarray

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def xy_px(self) -> np.ndarray:
        """(n, 2) column and row."""
        return np.stack([self.x_px, self.y_px], axis=1)

    def take(self, index: np.ndarray) -> Centroids:
        """Those stars, in the order of the index (integers or bool)."""
        return Centroids(**{k: v[index] for k, v in vars(self).items()})


__all__ = ["Centroids", "Image"]
