"""Stars of an image averaged over squares of pixels: smeared, trailed and badly focused ones are compact there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .detect import detect
from .frame import Centroids, Image
from .settings import DetectionSettings

STEPS = (2, 4, 8)
"""Pixels, along a side, whose means are looked at."""
MORE, FEWEST_MORE = 1.5, 8
"""Factor and number of detections from which means of pixels show more than the pixels did."""
LEAST_SIDE = 100
"""Pixels that the shorter side must keep."""


def detect_coarser(
    image: Image, step: int, settings: DetectionSettings | None = None, dark: np.ndarray | None = None
) -> Centroids | None:
    """As `detect`, on means of step x step pixels; places, px, and covariances are those of the image given. None where it has too
    few pixels for that. Raises ValueError for a dark of another size."""
    rows, columns = image.height // step, image.width // step
    if min(rows, columns) < LEAST_SIDE:
        return None
    if dark is not None and dark.shape != image.array.shape:
        raise ValueError(f"dark of shape {dark.shape}: the image has {image.array.shape}")
    array = np.zeros((rows, columns), dtype=np.float32)
    for y in range(step):
        for x in range(step):
            part = np.s_[y : y + rows * step : step, x : x + columns * step : step]
            with np.errstate(invalid="ignore"):  # infinities of both signs: no number, which is no star
                array += image.array[part]
                if dark is not None:
                    array -= dark[part]
    found = detect(replace(image, array=array / np.float32(step * step)), settings)
    return replace(
        found, x_px=(found.x_px + 0.5) * step - 0.5, y_px=(found.y_px + 0.5) * step - 0.5,
        covariance_px=step**2 * found.covariance_px, flux=step**2 * found.flux,
    )  # fmt: skip


def showing_more(
    image: Image, count: int, settings: DetectionSettings | None = None, dark: np.ndarray | None = None
) -> list[tuple[int, Centroids]]:
    """Steps, and what their means show, where that is more than the `count` detections of the pixels; the most first."""
    seen = [(step, found) for step in STEPS if (found := detect_coarser(image, step, settings, dark)) is not None]
    return sorted((s for s in seen if len(s[1]) >= max(MORE * count, FEWEST_MORE)), key=lambda s: -len(s[1]))


__all__ = ["detect_coarser", "showing_more"]
