"""What the brightness of a match says: for a star of the catalogue, against a detection that is false.

The zero point of the magnitudes is fitted, and paid for, or known. Where it is known, how well the magnitudes fit the catalogue's
is not taken on trust: several sigmas are averaged over.
"""

from __future__ import annotations

import math

import numpy as np

from .problem import Detections, middle

BROAD_SHARE, BROAD_SIGMA, BROAD_FACTOR = 0.15, 1.5, 6.0
"""Share of matches whose magnitude is not what the catalogue says, and their 1 sigma: in mag, at most so many times the usual."""
ZERO_POINT_RANGE = 10.0
"""Where an unknown zero point may lie (mag, full width): sets the price of fitting it."""
MAGNITUDE_SCALES = np.array([1.0, 0.5, 2.0, 0.25, 4.0, 0.125])
"""Factors on the magnitudes' sigma that a known zero point is averaged over."""
_weights = np.exp2(-np.abs(np.log2(MAGNITUDE_SCALES)))
LOG_MAGNITUDE_PRIORS = np.log(_weights / _weights.sum())
"""Of these: what was told is the likeliest, each factor of two half as likely as the one before."""
ODD_MAGNITUDES = 0.1
"""1 sigma, mag, that how faint a star may be is always uncertain by where the zero point is known: variables, doubles, bands."""
_AS_TOLD = np.ones(1), np.zeros(1)


def zero_point_price(d: Detections, count: int) -> float:
    """Log of what fitting the zero point to `count` matches costs."""
    if d.magnitude is None or d.zero_point is not None:
        return 0.0
    sigma = 1.25 * d.magnitude_sigma / math.sqrt(count)
    return math.log(min(1.0, math.sqrt(2.0 * math.pi) * sigma / ZERO_POINT_RANGE))


def magnitude_scales(d: Detections) -> tuple[np.ndarray, np.ndarray]:
    """Factors (h,) on the magnitudes' sigma that are to be averaged over, and the logs of their priors.

    A zero point that is fitted takes up most of what three or four stars tell of sigma.
    """
    return (MAGNITUDE_SCALES, LOG_MAGNITUDE_PRIORS) if d.knows_zero else _AS_TOLD


def faintest_sought(d: Detections) -> float:
    """V of the faintest star that is looked for: one that is a little fainter than sigma allows may match with a wider sigma."""
    return d.faintest_at(math.hypot(1.0, ODD_MAGNITUDES / d.magnitude_sigma))


def broad_sigma(sigma: float) -> float:
    """Of magnitudes that are not what the catalogue says, where those that are have this sigma."""
    return min(BROAD_SIGMA, BROAD_FACTOR * sigma)


def magnitude_gain(
    d: Detections, V: np.ndarray, j: np.ndarray, zero: float | np.ndarray, scale: float = 1.0
) -> np.ndarray:
    """Log likelihood ratio (k,) of the magnitudes of stars V (k,) matched with detections j (k,), at a zero point and `scale`
    times the sigma told."""
    if d.magnitude is None:
        return np.zeros(len(j))
    s = scale * d.magnitude_sigma
    square = (V - d.magnitude[j] - zero) ** 2
    broad = broad_sigma(s)
    density = (1.0 - BROAD_SHARE) / s * np.exp(-0.5 / s**2 * square) + BROAD_SHARE / broad * np.exp(
        -0.5 / broad**2 * square
    )
    return np.log(density / np.sqrt(2.0 * np.pi) + 1e-6) - d.log_magnitude_density[j]


def zero_point(d: Detections, V: np.ndarray, j: np.ndarray) -> float:
    """Median of the matches, or what is known."""
    if d.magnitude is None or len(j) == 0:
        return 0.0
    return middle(V - d.magnitude[j]) if d.zero_point is None else d.zero_point


__all__ = ["faintest_sought", "magnitude_gain", "magnitude_scales", "zero_point", "zero_point_price"]
