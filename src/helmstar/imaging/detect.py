"""Stars of a real image: places above the noise, each looked at as a star would look, then fitted.

A place is no star if its light is one pixel's (hot pixel) or one row's or column's, if its surroundings are as rough as itself
(roofs, trees, JPEG blocks), or if it is broader than any star. `detect` has one setting for all cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_int64, c_void_p
from functools import cache
from typing import Any

import numpy as np

from ..native import address, kernels
from .background import between, mesh_of
from .frame import Centroids, Image
from .measure import BRIGHT, broad_width_of, measure, nothing, width_of
from .pyramid import TILES, Peaks, find_peaks, halve
from .settings import HALF, DetectionSettings, Optics
from .windows import TYPES, around
from .windows import declared as declared_windows

_COARSE = 1.8  # px; optics broader than this need the coarser levels
_FEW = 6  # stars; fewer do not confirm what is believed of the optics
_FULL = 9  # pixels at the limit that the fit fills in a window as wide as the optics need
_SAME = 0.2  # of the logarithm of the width
_WEIGHTS = np.pad(np.outer([1, 2, 1], [1, 2, 1]), 1).astype(np.float32).ravel()


def detect(image: Image, settings: DetectionSettings | None = None, dark: np.ndarray | None = None) -> Centroids:
    """Stars of an image, the largest flux first, at most `max_stars`. dark: (height, width) subtracted before.

    An image smaller than 16 pixels a side, or of one value, has none. Raises ValueError for a dark of another shape.
    """
    return detect_next(image, settings, dark)[0]


def detect_next(
    image: Image,
    settings: DetectionSettings | None = None,
    dark: np.ndarray | None = None,
    optics: Optics | None = None,
) -> tuple[Centroids, Optics | None]:
    """As `detect`, with what the frame before told, and what this one tells.

    With optics no coarser scale than theirs is searched. Where stars are few or of another width, the frame is searched as
    the first was.
    """
    s = settings or DetectionSettings()
    array, quantum = _prepared(image, dark)
    if min(array.shape) < 16:
        return nothing(), None
    if optics is not None and optics.level < s.levels and min(array.shape) >> optics.level >= 40:
        found = _at_scale(array, image, optics, s, quantum)
        if found is not None:
            return found, optics
    return _at_all_scales(array, image, s, quantum)


def detect_near(
    image: Image, xy_px: np.ndarray, reach_px: float, optics: Optics, settings: DetectionSettings | None = None,
    dark: np.ndarray | None = None,
) -> Centroids:  # fmt: skip
    """Stars within `reach_px` of expected places (n, 2), the brightest one of each, and nothing of the rest of the image."""
    s = settings or DetectionSettings()
    if dark is not None and dark.shape != image.array.shape:
        raise ValueError(f"dark of shape {dark.shape}: the image has {image.array.shape}")
    height, width = image.array.shape
    inside = (xy_px >= 0).all(axis=1) & (xy_px[:, 0] < width) & (xy_px[:, 1] < height)
    at = np.rint(xy_px[inside]).astype(int)
    if not len(at) or min(height, width) < 16:
        return nothing()
    level = optics.level
    reach, quantum = int(np.ceil(reach_px)), _quantum(image)
    side = reach + 2 + (3 << level)
    x, y, excess, noise = _lights(image.array, at, reach, side, level, quantum, dark)
    filtered = noise * (0.375, 0.273, 0.196, 0.14)[level]  # sigma of the mean under those weights
    good = (excess > s.threshold * filtered) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    _, first = np.unique(y[good] * width + x[good], return_index=True)
    keep = np.flatnonzero(good)[first]
    if not keep.size:
        return nothing()
    array = image.array
    if dark is not None:  # only the windows matter, but they are read from one array
        array = array.astype(np.float32) - dark
    snr = excess[keep] / filtered[keep]
    order = np.argsort(-snr, kind="stable")
    keep, snr = keep[order], snr[order]
    return _sorted(
        [measure(array, image, x[keep], y[keep], snr, noise[keep], level, np.array(optics.width), s, quantum)], s
    )


def _lights(
    array: np.ndarray, at: np.ndarray, reach: int, side: int, level: int, quantum: float, dark: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """The brightest filtered place x, y (n,) near each place (n, 2), its excess over the median of the window, a pixel's noise.

    side: half the window's. excess is NaN where a pixel of the window has no value.
    """
    library, times, floor = kernels(), 1 << level, quantum / np.sqrt(12.0)
    if library is not None and array.dtype in TYPES:
        array = np.ascontiguousarray(array)
        dark = None if dark is None else np.ascontiguousarray(dark, np.float32)
        n, pixels = len(at), (2 * side + 1) ** 2
        count = -(-pixels // 3)
        order = np.array([count // 2, int(0.8413 * count)])
        work = np.empty(8 * (pixels + count) + pixels, np.float32)
        xy, light = np.ascontiguousarray(at.T, np.int64), np.empty((2, n), np.float32)
        places = np.empty((2, n), np.int64)
        if not declared_windows(library).helmstar_near(
            address(array), TYPES[array.dtype], None if dark is None else address(dark), *array.shape,
            *(address(a) for a in xy), n, reach, side, times, address(order), floor, address(work), work.size,
            *(address(a) for a in (*places, *light)),
        ):  # fmt: skip
            return *places, *light
    w = around(array, at[:, 0], at[:, 1], side)
    if dark is not None:
        w -= around(dark, at[:, 0], at[:, 1], side)
    ordered = np.sort(w.reshape(len(w), -1)[:, ::3], axis=1)
    count = ordered.shape[1]
    sky = ordered[:, count // 2]
    noise = np.maximum(ordered[:, int(0.8413 * count)] - sky, floor)
    f = w
    for _ in range(times):  # [1 2 1] both ways, wider for wider optics
        f = f[:, :-2] + 2 * f[:, 1:-1] + f[:, 2:]
        f = (f[:, :, :-2] + 2 * f[:, :, 1:-1] + f[:, :, 2:]) / 16.0
    edge = (f.shape[1] - (2 * reach + 1)) // 2
    f = f[:, edge : edge + 2 * reach + 1, edge : edge + 2 * reach + 1]
    j, i = np.divmod(f.reshape(len(f), -1).argmax(axis=1), 2 * reach + 1)
    excess = np.where(np.isfinite(w).all(axis=(1, 2)), f[np.arange(len(f)), j, i] - sky, np.nan)
    return at[:, 0] + i - reach, at[:, 1] + j - reach, excess, noise


def _quantum(image: Image) -> float:
    return 1.0 if image.array.dtype.kind == "u" else 1e-12


def _prepared(image: Image, dark: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Pixels, finite and without the dark, and the step of their numbers. Raises ValueError for a dark of another shape."""
    array = image.array
    if dark is not None:
        if dark.shape != array.shape:
            raise ValueError(f"dark of shape {dark.shape}: the image has {array.shape}")
        array = array.astype(np.float32) - dark.astype(np.float32)
    if array.dtype not in (np.uint8, np.uint16):
        array = array.astype(np.float32, copy=False)
        with np.errstate(invalid="ignore", over="ignore"):
            total = array.sum()
        if not np.isfinite(total):  # numbers without value shine nowhere
            finite = np.isfinite(array)
            array = np.where(finite, array, np.median(array[finite]) if finite.any() else 0.0).astype(np.float32)
    return np.ascontiguousarray(array), _quantum(image)


def _at_scale(
    array: np.ndarray, image: Image, optics: Optics, s: DetectionSettings, quantum: float
) -> Centroids | None:
    """Stars at the scales of known optics; None where they do not look like it."""
    level, binned = optics.level, array
    places = [_candidates(array, binned, 0, s, quantum)]
    for k in range(1, level + 1):
        binned = halve(binned)
        places.append(_candidates(array, binned, k, s, quantum))
    x, y, _, snr, floor = _merged(places, s)
    if len(x) < _FEW:
        return None
    width, full = np.array(optics.width), array[y, x] >= 0.98 * image.saturation
    if full.any():  # a few full pixels are filled by the fit; many need a window as wide as the light reaches
        light = around(array, x[full], y[full], HALF[level]) >= 0.98 * image.saturation
        full[full] = light.sum(axis=(1, 2)) > _FULL
    parts, widths = [], []
    for k, mine in ((level, ~full), (max(level, min(level + 1, 2)), full)):
        if mine.any():
            parts.append(measure(array, image, x[mine], y[mine], snr[mine], floor[mine], k, width, s, quantum, widths))
    if not len(parts[0]) or sum(map(len, parts)) < _FEW:
        return None
    bright = parts[0].snr > BRIGHT
    if bright.any() and not (np.abs(np.log(np.median(widths[0][bright], axis=0) / width)) < _SAME).all():
        return None
    return _sorted(parts, s)


def _sorted(parts: list[Centroids], s: DetectionSettings) -> Centroids:
    """All parts, the largest flux first, each star once."""
    whole = parts[0]
    if len(parts) > 1:
        whole = Centroids(**{f: np.concatenate([getattr(p, f) for p in parts]) for f in vars(parts[0])})
    order = np.argsort(-whole.flux, kind="stable")
    first = _alone(whole.x_px[order], whole.y_px[order], whole.flux[order])
    return whole.take(order[first[: s.max_stars]])


def _at_all_scales(
    array: np.ndarray, image: Image, s: DetectionSettings, quantum: float
) -> tuple[Centroids, Optics | None]:
    """Stars, and the optics where enough of them tell."""
    found: list[tuple[np.ndarray, ...]] = []
    width: np.ndarray | None = None
    binned = array
    places: tuple[np.ndarray, ...] = ()
    for k in range(min(s.levels, 3)):
        if min(binned.shape) < 40:
            break
        found.append(_candidates(array, binned, k, s, quantum))
        if k == 0 and s.levels > 1:
            binned = halve(binned)
            continue
        places = _merged(found, s)
        width = width_of(array, image, *places[:4])
        if width is not None and width.max() < _COARSE:  # sharp stars: a coarser level would show only structure
            break
        if k + 1 < min(s.levels, 3):
            binned = halve(binned)
    # What is broader than the finer windows is searched for only where they do not tell sharp optics.
    if s.levels > 3 and len(found) == 3 and min(binned.shape) >= 80 and (width is None or width.max() >= _COARSE):
        wider = _merged([*found, _candidates(array, halve(binned), 3, s, quantum)], s)
        broad = broad_width_of(array, image, wider[0], wider[1], wider[3])
        if broad is not None and broad.max() > HALF[1] / 2:  # else what is large here is structure
            width = broad
            places = wider if Optics((float(broad[0]), float(broad[1]))).level == 3 else places
    if not found:
        return nothing(), None
    x, y, level, snr, floor = places or _merged(found, s)
    if not len(x):
        return nothing(), None
    optics = None if width is None else Optics((float(width[0]), float(width[1])))
    if optics is not None:
        # A faint star shows best at the scale of the optics: what only a coarser one sees is structure, unless it is bright.
        best = optics.level
        keep = (level <= best) | (snr > BRIGHT)
        x, y, level, snr, floor = (c[keep] for c in (x, y, level, snr, floor))
        # A window as wide as the optics need; a wider one only for what is full, whose light reaches farther.
        full = array[y, x] >= 0.98 * image.saturation
        level = np.where(full, np.maximum(level, best), best)
    parts = []
    for k in range(s.levels):
        mine = np.flatnonzero(level == k)
        if mine.size:
            parts.append(measure(array, image, x[mine], y[mine], snr[mine], floor[mine], k, width, s, quantum))
    return (_sorted(parts, s) if parts else nothing()), optics


def dark_of(images: Sequence[Image]) -> np.ndarray:
    """A dark frame (height, width), float32, for `detect`, from three or more frames of one camera and setting on moving skies.

    Their median pixel by pixel, less its own sky, where that stands out: what shines in the same place in most of them is no
    star. Elsewhere zero, so that no noise is added. Raises ValueError for fewer frames or different shapes.
    """
    shapes = {i.array.shape for i in images}
    if len(images) < 3 or len(shapes) != 1:
        raise ValueError(f"{len(images)} images of shapes {sorted(shapes)}: a dark needs at least 3 of one shape")
    shape = images[0].array.shape
    middle = np.median(np.stack([i.array for i in images]), axis=0).astype(np.float32)
    mesh = mesh_of(middle[::4, ::4], shape, TILES[0], 0.3 if images[0].array.dtype.kind == "u" else 0.0)
    grid = np.arange(shape[0]), np.arange(shape[1])
    rise = middle - between(mesh.sky, shape, *grid)
    return np.where(rise > 6.0 * between(mesh.noise, shape, *grid), rise, np.float32(0.0))


def _candidates(
    array: np.ndarray, binned: np.ndarray, level: int, s: DetectionSettings, quantum: float
) -> tuple[np.ndarray, ...]:
    """Places x, y (n,) int in the image, level, signal over noise and noise of a pixel, of one level of the pyramid."""
    peaks = find_peaks(binned, level, s.threshold, quantum)
    if level == 0:
        x, y, keep = peaks.x, peaks.y, _wider_than_a_pixel(array, peaks, quantum)
    else:
        x, y, keep = _brightest_of(array, peaks, level, s.threshold)
    snr = peaks.excess[keep] / peaks.noise[keep]
    order = _strongest(snr, 2 * s.max_stars)
    floor = peaks.noise[keep] / (6 << level)
    return x[keep][order], y[keep][order], np.full(order.size, level), snr[order], floor[order]


def _merged(found: list[tuple[np.ndarray, ...]], s: DetectionSettings) -> tuple[np.ndarray, ...]:
    """The places of all levels, the strongest of each neighbourhood, the strongest first."""
    merged = [np.concatenate(c) for c in zip(*found)]
    order = _strongest(merged[3], 3 * s.max_stars)
    x, y, level = (c[order].astype(np.float32) for c in merged[:3])
    reach = np.array(HALF, np.float32)[level.astype(int)]
    library = kernels()
    if library is not None:
        apart = np.empty(len(order), bool)
        _declared(library).helmstar_apart(*(address(a) for a in (x, y, reach)), len(order), address(apart))
        first = order[apart][: 5 * s.max_stars // 4]
        return tuple(c[first] for c in merged)
    near = np.abs(x[:, None] - x) <= reach  # of the stronger one, in the columns
    near &= np.abs(y[:, None] - y) <= reach
    i, j = np.divmod(np.flatnonzero(near), len(order))
    near_stronger = np.zeros(len(order), bool)
    near_stronger[i[j < i]] = True
    first = order[~near_stronger][: 5 * s.max_stars // 4]
    return tuple(c[first] for c in merged)


def _strongest(values: np.ndarray, count: int) -> np.ndarray:
    """Indices of the largest values, the largest first."""
    return np.argsort(-values, kind="stable")[:count]


def _wider_than_a_pixel(array: np.ndarray, peaks: Peaks, quantum: float) -> np.ndarray:
    """Which places of level 0 have light beside their brightest pixel, in both directions, as even the sharpest optics give."""
    library = kernels()
    if library is not None and array.dtype in TYPES and array.flags.c_contiguous:
        out = np.empty(len(peaks.x), bool)
        given = [np.ascontiguousarray(a) for a in (peaks.x, peaks.y, peaks.excess, peaks.noise)]
        declared_windows(library).helmstar_wider(
            address(array), TYPES[array.dtype], *array.shape, *map(address, given), len(out), quantum, address(out)
        )
        return out
    w = around(array, peaks.x, peaks.y, 2)
    # The filter is 16 times the local mean of light: sky in a pixel from the filtered value's.
    f = w.reshape(len(w), 25) @ _WEIGHTS
    sky = (f - peaks.excess) / np.float32(16.0)
    noise = peaks.noise / np.float32(6.0)
    w -= sky[:, None, None]
    n = np.arange(len(w))
    j, i = np.divmod(np.argmax(w[:, 1:4, 1:4].reshape(len(w), 9), axis=1), 3)
    j, i = j + 1, i + 1
    top = w[n, j, i]
    along_x, along_y = w[n, j, i - 1] + w[n, j, i + 1], w[n, j - 1, i] + w[n, j + 1, i]
    corners = w[n, j - 1, i - 1] + w[n, j - 1, i + 1] + w[n, j + 1, i - 1] + w[n, j + 1, i + 1]
    beside = 2 * (along_x + along_y) + corners
    allowed = 2.0 * np.sqrt(2.0) * noise + quantum  # two pixels may have lost half a count each by rounding
    return (
        (beside > np.maximum(2.5 * np.sqrt(20.0) * noise, 0.7 * top) - 3.0 * quantum)
        & (along_x > 0.16 * top - allowed)
        & (along_y > 0.16 * top - allowed)
    )


def _brightest_of(array: np.ndarray, peaks: Peaks, level: int, threshold: float) -> tuple[np.ndarray, ...]:
    """Places of a coarse level in the image's pixels, and which of them stay above the noise without their brightest pixel."""
    size = 1 << level
    x, y = peaks.x * size + size // 2, peaks.y * size + size // 2
    w = around(array, x, y, size)
    flat = np.sort(w.reshape(len(w), w.shape[1] ** 2), axis=1)
    # Without one pixel: it counts at most with the filter's middle weight.
    without = peaks.excess - 4.0 * (flat[:, -1] - flat[:, -3])
    return x, y, without > 0.7 * threshold * peaks.noise


@cache
def _declared(library: Any) -> Any:
    """The library with the types of what is called here."""
    for f in (library.helmstar_apart, library.helmstar_alone):
        f.argtypes, f.restype = [c_void_p] * 3 + [c_int64, c_void_p], None
    return library


def _alone(x: np.ndarray, y: np.ndarray, flux: np.ndarray) -> np.ndarray:
    """Indices of stars that are not a second finding, or an artefact, of a brighter one close by; brightest first."""
    x, y = x.astype(np.float32), y.astype(np.float32)
    library = kernels()
    if library is not None:
        alone, flux = np.empty(len(x), bool), np.ascontiguousarray(flux, float)
        _declared(library).helmstar_alone(*(address(a) for a in (x, y, flux)), len(x), address(alone))
        return np.flatnonzero(alone)
    i, j = np.divmod(np.flatnonzero(np.abs(x[:, None] - x) < 14.0), max(len(x), 1))
    later = np.flatnonzero((j < i) & (np.abs(y[i] - y[j]) < 14.0))
    i, j = i[later], j[later]
    d2 = (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2
    same = (d2 < 4.0) | ((d2 < 14.0**2) & (flux[i] < 0.01 * flux[j]))
    keep = np.ones(len(x), bool)
    keep[i[same]] = False
    return np.flatnonzero(keep)


__all__ = ["DetectionSettings", "Optics", "dark_of", "detect", "detect_near", "detect_next"]
