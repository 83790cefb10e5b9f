"""What is at a place: windows are fitted, and a fit is a star or is none, with a covariance of what noise, light and model explain.

No star is what is off the middle of its window, a plane, broader than any star, or surrounded by as much as itself.
"""

from __future__ import annotations

from ctypes import c_double, c_int, c_int64, c_void_p
from functools import cache
from typing import Any

import numpy as np

from ..native import address, kernels
from .centroid import ITERATIONS, Fit, fit, gain_of
from .frame import Centroids, Image
from .settings import HALF, WIDTH, DetectionSettings
from .windows import Windows, windows

BRIGHT = 15.0
"""Signal over noise from which a star tells of the optics."""
_MISFIT = 1.5  # chi-square per pixel above which the model, not noise, is what is wrong
_FILLS, _WELL = 0.85, 0.8  # widest sigma, over half the window, of a star that explains so much of it
_ALIKE = 0.3  # of the logarithm of the widths of one frame's stars
_MOSTLY = 0.6  # of their light, explained; a Gaussian along rows and columns explains less of a diagonal trail than of another
_FOR_WIDTH = 24  # stars whose widths tell the optics


def nothing() -> Centroids:
    """No star."""
    n = np.zeros(0)
    return Centroids(n, n, n, np.zeros((0, 2, 2)), n, n.astype(bool), n, n)


def width_of(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, level: np.ndarray, snr: np.ndarray
) -> np.ndarray | None:
    """Sigma (2,) of the optics along x and y, px, from the brightest places that are not saturated; None where too few say."""
    some = np.flatnonzero((snr > BRIGHT) & (level < 2))[:_FOR_WIDTH]
    if some.size < 3:
        return None
    w = windows(array, image, x[some], y[some], HALF[1], 1e-9)
    clear = ~w.filled.any(axis=(1, 2)) & ~w.structure
    if clear.sum() < 3:
        return None
    f = fit(w.inner[clear], w.x0[clear], w.y0[clear], w.sky[clear], w.noise[clear], np.ones(2), w.filled[clear], 0.5, 4)
    return np.median(f.sigma, axis=0)


def broad_width_of(array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, snr: np.ndarray) -> np.ndarray | None:
    """Sigma (2,) of stars that the finer windows cannot hold, px; None where most bright places are nothing of the kind."""
    some = np.flatnonzero(snr > BRIGHT)[:_FOR_WIDTH]
    if some.size < 3:
        return None
    w = windows(array, image, x[some], y[some], HALF[3], 1e-9)
    clear = ~w.filled.any(axis=(1, 2)) & ~w.structure
    if clear.sum() < 3:
        return None
    expected = np.full(2, WIDTH[3])
    w = Windows(**{k: v[clear] for k, v in vars(w).items()})
    f = fit(w.inner, w.x0, w.y0, w.sky, w.noise, expected, w.filled, 0.5, 2 * ITERATIONS)
    width, light = np.median(f.sigma, axis=0), f.sums[:, 1]
    alike = (np.abs(np.log(f.sigma / width)) < _ALIKE).all(axis=1) & (light > _MOSTLY * (light + f.sums[:, 2]))
    return width if alike.sum() >= max(3, clear.sum() / 2) else None


def measure(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, snr: np.ndarray, floor: np.ndarray, level: int,
    width: np.ndarray | None, s: DetectionSettings, quantum: float, widths: list[np.ndarray] | None = None,
) -> Centroids:  # fmt: skip
    """Fit the places of one level and keep those that are stars. widths: gets the fitted sigmas (n, 2) of these."""
    half = HALF[level]
    if level == 3:
        x, y = _middles(array, image, x, y, half, width)
    rounding = quantum / np.sqrt(12.0)
    w = windows(array, image, x, y, half, np.minimum(floor, rounding))
    calm = np.flatnonzero(~w.structure)
    if not calm.size:
        return nothing()
    if calm.size < len(x):
        x, y, snr, floor = x[calm], y[calm], snr[calm], floor[calm]
        w = Windows(**{k: v[calm] for k, v in vars(w).items()})
    expected = np.full(2, WIDTH[level]) if width is None else width
    tight, iterations = 0.25 if width is not None else 0.35, 2 * ITERATIONS if level == 3 else ITERATIONS
    f = fit(w.inner, w.x0, w.y0, w.sky, w.noise, expected, w.filled, tight, iterations)
    clear = (snr > BRIGHT) & ~w.filled.any(axis=(1, 2))
    gain = s.gain if s.gain is not None else gain_of(f, w.noise, clear)
    # Noise with a pattern (mosaics, JPEG) is larger in sums of pixels than its pixels say; the filtered image shows it.
    real = np.maximum(w.noise, floor)
    position, misfit, elongation, peak, saturated, star = _judged(f, w, real, gain, half, s)
    position *= np.where(misfit > _MISFIT, misfit, 1.0)[:, None, None]
    position[:, [0, 1], [0, 1]] += (s.optics_px**2 + 0.1**2 * saturated)[:, None]
    if widths is not None:
        widths.append(f.sigma[star])
    everything = Centroids(
        x_px=x + f.x, y_px=y + f.y, flux=f.flux, covariance_px=position, peak=peak, saturated=saturated,
        elongation=elongation, snr=snr,
    )  # fmt: skip
    return everything.take(star)


def _middles(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, half: int, width: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Places x, y (n,) of level 3, which are known to 8 px, moved into the middle of their light: a window that cuts one end of a
    trail off more than the other would pull its centre.
    """
    for _ in range(2):
        w = windows(array, image, x, y, half, 1e-9)
        expected = np.full(2, WIDTH[3]) if width is None else width
        f = fit(w.inner, w.x0, w.y0, w.sky, w.noise, expected, w.filled, 0.25, 2 * ITERATIONS)
        x = np.clip(x + np.rint(f.x).astype(int), 0, array.shape[1] - 1)
        y = np.clip(y + np.rint(f.y).astype(int), 0, array.shape[0] - 1)
    return x, y


def _judged(
    f: Fit, w: Windows, real: np.ndarray, gain: float, half: int, s: DetectionSettings
) -> tuple[np.ndarray, ...]:
    """Of each fit: covariance (n, 2, 2) of its place from noise and light, chi-square of a pixel, elongation, peak, whether it is
    saturated, whether it is a star.
    """
    library = kernels()
    if library is not None and half <= HALF[-1]:
        return _judged_compiled(_declared(library), f, w, real, gain, s.threshold)
    expected = (real**2).astype(np.float32)[:, None, None] + np.float32(gain) * f.model
    misfit = (np.square(f.residual) / expected).mean(axis=(1, 2))
    peak, saturated = w.above.max(axis=(1, 2)), np.asarray(w.full.any(axis=(1, 2)))
    return (
        f.place_covariance(real, gain),
        misfit,
        _elongation(w.above, f, half),
        peak,
        saturated,
        _is_star(f, w.noise, half, s),
    )


def _judged_compiled(
    library: Any, f: Fit, w: Windows, real: np.ndarray, gain: float, threshold: float
) -> tuple[np.ndarray, ...]:
    """The same by measure.c."""
    n, m, _ = f.model.shape
    given = [np.ascontiguousarray(a, np.float32) for a in (f.model, f.residual, w.above, f.bread, f.light, f.sums)]
    given += [np.ascontiguousarray(a, np.float32) for a in (real, w.noise)]
    given += [np.ascontiguousarray(w.full, bool), np.ascontiguousarray(f.p, float)]
    model, residual, above, bread, light, sums, real_at, noise, full, p = (address(a) for a in given)
    place, told, (saturated, star) = np.empty((n, 2, 2)), np.empty((3, n), np.float32), np.empty((2, n), bool)
    out = [address(a) for a in (place, *told, saturated, star)]
    library.helmstar_judge(
        model, residual, above, full, bread, light, p, sums, real_at, noise, n, m, gain, threshold, *out
    )
    return place, *told, saturated, star


@cache
def _declared(library: Any) -> Any:
    """The library with the types of what measure.c has."""
    library.helmstar_judge.argtypes = [c_void_p] * 10 + [c_int64, c_int, c_double, c_double] + [c_void_p] * 6
    return library


def _is_star(f: Fit, noise: np.ndarray, half: int, s: DetectionSettings) -> np.ndarray:
    """Which fits look like a star: centred, neither a pixel nor a plane, and more light than the roughness around them."""
    wide, narrow = f.sigma.max(axis=1), f.sigma.min(axis=1)
    light = f.sums[:, 1]
    # Of the light and of as much noise as a window of level 2 holds: a larger one would have none but the brightest stars.
    explained = light / (light + f.sums[:, 2] * np.float32(min(1.0, ((2 * HALF[2] + 1) / (2 * half + 1)) ** 2)))
    # Nothing much wider is tried than the coarse levels: a smeared or badly focused star may fill the window if little else does.
    wider = (wide < _FILLS * half) & (explained > _WELL) if half >= HALF[2] else False
    return (
        (f.flux > 0.6 * s.threshold * noise * np.sqrt(4 * np.pi * wide * narrow))
        & (np.maximum(np.abs(f.x), np.abs(f.y)) < 0.6 * half)
        & ((wide < 0.6 * half) | wider)
        & (explained > 0.4)
    )


def _elongation(above: np.ndarray, f: Fit, half: int) -> np.ndarray:
    """Longer over shorter axis (n,) of the light's second moments under a window of twice its width."""
    d = np.arange(-half, half + 1, dtype=np.float32)
    away = d - np.stack([f.x, f.y])[:, :, None].astype(np.float32)
    reach = (2.0 * f.sigma.max(axis=1) + 0.5).astype(np.float32)
    basis = np.empty((2, len(f.x), 3, d.size), np.float32)  # the window's weight along x and y, times 1, d, d^2
    basis[:, :, 0] = np.exp(np.float32(-0.5) * np.square(away / reach[:, None]))
    np.multiply(basis[:, :, 0], away, out=basis[:, :, 1])
    np.multiply(basis[:, :, 1], away, out=basis[:, :, 2])
    moments = basis[1] @ above @ basis[0].transpose(0, 2, 1)
    total = moments[:, 0, 0] + 1e-12
    xx, yy, xy = moments[:, 0, 2] / total, moments[:, 2, 0] / total, moments[:, 1, 1] / total
    middle, swing = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.sqrt((middle + swing) / np.maximum(middle - swing, 0.02 * middle + 1e-12))


__all__ = ["BRIGHT", "broad_width_of", "measure", "nothing", "width_of"]
