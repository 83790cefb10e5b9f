"""What a lens does to the plane Z = 1: Brown and Conrady's distortion, forth and back.

    r^2 = x^2 + y^2, g = 1 + k1 r^2 + k2 r^4 + k3 r^6
    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),    y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y

Coefficients are (k1, k2, p1, p2, k3), OpenCV's order and sense.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

Coefficients = tuple[float, float, float, float, float]

NEWTON_STEPS = 12
FOLD = 1e-3
"""The least slope of the distorted radius over the true one: below it the lens folds over."""
AGREES = 1e-9
"""How closely the distorted inverse must be what was given, on the plane Z = 1."""


def distort(x: Any, y: Any, coefficients: Coefficients) -> tuple[Any, ...]:
    """Of arrays or numbers x, y: x', y' and the derivatives dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    h = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # dg/dx = h x
    xd = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    cross = h * x * y + 2 * p1 * x + 2 * p2 * y
    return xd, yd, g + h * x * x + 2 * p1 * y + 6 * p2 * x, cross, cross, g + h * y * y + 6 * p1 * y + 2 * p2 * x


@lru_cache(maxsize=64)
def reach(coefficients: Coefficients) -> float:
    """The radius sqrt(x^2 + y^2) up to which the radial distortion grows; infinite for most lenses."""
    k1, k2, _, _, k3 = coefficients
    # Tiny terms fold beyond 88 deg, and spoil the roots.
    a, b, c = (0.0 if abs(k) < 1e-9 else k for k in (3 * k1, 5 * k2, 7 * k3))
    if not c:
        square = a * a - 4 * b * (1 - FOLD)
        inverse = 0.5 * (math.sqrt(square) - a) / (1 - FOLD) if square >= 0.0 else 0.0  # of r^2
        return inverse**-0.5 if inverse > 0.0 else math.inf
    slope = np.array([c, b, a, 1 - FOLD])
    roots = np.roots(slope)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else math.inf


def undistort(xd: np.ndarray, yd: np.ndarray, coefficients: Coefficients) -> tuple[np.ndarray, np.ndarray]:
    """x, y of distorted places, arrays of one shape: Newton's method, started there.

    NaN where there is no inverse; and at some places far out of lenses that bend by more than a third and back (k1 > 0.4 with
    k3 < -0.2, say), where Newton's method finds none.
    """
    x, y, far = np.array(xd, dtype=float), np.array(yd, dtype=float), reach(coefficients)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            fx, fy, a, b, c, d = distort(x, y, coefficients)
            ex, ey = fx - xd, fy - yd
            det = a * d - b * c
            dx, dy = (d * ex - b * ey) / det, (a * ey - c * ex) / det
            x, y = x - dx, y - dy
            if math.isfinite(far):  # never past the fold, from where Newton would run to another branch
                back = np.minimum(1.0, far / np.maximum(np.hypot(x, y), 1e-300))
                x, y = x * back, y * back
            if not np.nanmax(np.abs(dx) + np.abs(dy), initial=0.0) > 1e-15:
                break
        fx, fy = distort(x, y, coefficients)[:2]
        good = np.hypot(fx - xd, fy - yd) < AGREES
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


def undistort_one(xd: float, yd: float, coefficients: Coefficients, far: float) -> tuple[float, float]:
    """As `undistort`, of one place in plain numbers, which takes a thirtieth of the time; far: `reach`."""
    x, y = xd, yd
    try:
        for _ in range(NEWTON_STEPS):
            fx, fy, a, b, c, d = distort(x, y, coefficients)
            ex, ey, det = fx - xd, fy - yd, a * d - b * c
            dx, dy = (d * ex - b * ey) / det, (a * ey - c * ex) / det
            x, y = x - dx, y - dy
            back = min(1.0, far / max(math.hypot(x, y), 1e-300))  # see `undistort`
            x, y = x * back, y * back
            if not abs(dx) + abs(dy) > 1e-15:
                break
        fx, fy = distort(x, y, coefficients)[:2]
    except (OverflowError, ZeroDivisionError):
        return math.nan, math.nan
    return (x, y) if math.hypot(fx - xd, fy - yd) < AGREES else (math.nan, math.nan)


__all__ = ["Coefficients", "distort", "reach", "undistort", "undistort_one"]
