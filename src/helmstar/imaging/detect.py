"""Stars of a real image: places above the noise, each looked at as a star would look, then fitted.

A place is no star if its light is one pixel's (hot pixel) or one row's or column's, if its surroundings are as rough as itself
(roofs, trees, JPEG blocks), or if it is broader than any star. `detect` has one setting for all cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..native import kernels
from .background import between, mesh_of
from .centroid import Fit, fit, gain_of
from .frame import Centroids, Image
from .pyramid import TILES, Peaks, find_peaks, halve
from .windows import TYPES, Windows, address, around, windows
from .windows import declared as declared_windows

HALF = (3, 5, 9)
"""Half the side of a star's window at each level, px."""
_BRIGHT = 15.0
_MISFIT = 1.5  # chi-square per pixel above which the model, not noise, is what is wrong
_COARSE = 1.8  # px; optics broader than this need the coarsest level
_FEW = 6  # stars; fewer do not confirm what is believed of the optics
_FILLS, _WELL = 0.85, 0.8  # widest sigma, over half the window, of a star that explains so much of it
_FULL = 9  # px
_SAME = 0.2  # of the logarithm of the width
_FOR_WIDTH = 24  # stars whose widths tell the optics
_WEIGHTS = np.pad(np.outer([1, 2, 1], [1, 2, 1]), 1).astype(np.float32).ravel()
_WIDTH = (0.8, 1.5, 3.0)  # sigma expected of a star found at each level, px


@dataclass(frozen=True)
class DetectionSettings:
    """threshold: sigma of the filtered image. max_stars: kept, the brightest. levels: 1 to 3 scales, each twice the one before.

    optics_px: least sigma of a centroid, for what no noise explains (optics are no Gaussians). gain: image counts per
    photo-electron; None estimates it from the stars' residuals.
    """

    threshold: float = 5.0
    max_stars: int = 100
    levels: int = 3
    optics_px: float = 0.05
    gain: float | None = None

    def __post_init__(self) -> None:
        if not 2.0 <= self.threshold <= 100.0:
            raise ValueError(f"threshold {self.threshold}: must be 2 to 100 sigma")
        if not 1 <= self.levels <= 3:
            raise ValueError(f"levels {self.levels}: must be 1, 2 or 3")
        if not 1 <= self.max_stars <= 10_000:
            raise ValueError(f"max_stars {self.max_stars}: must be 1 to 10000")


@dataclass(frozen=True)
class Optics:
    """What one frame tells of the next by the same camera: sigma of the stars along x and y, px."""

    width: tuple[float, float]

    @property
    def level(self) -> int:
        """The scale at which such stars show best."""
        return int(np.argmin(np.abs(np.log(np.array(_WIDTH) ** 2 / np.prod(self.width)))))


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
        return _nothing(), None
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
        return _nothing()
    level = optics.level
    reach, quantum = int(np.ceil(reach_px)), _quantum(image)
    side = reach + 2 + (3 << level)
    x, y, excess, noise = _lights(image.array, at, reach, side, level, quantum, dark)
    filtered = noise * (0.375, 0.2, 0.13)[level]  # sigma of the mean under those weights
    good = (excess > s.threshold * filtered) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    _, first = np.unique(y[good] * width + x[good], return_index=True)
    keep = np.flatnonzero(good)[first]
    if not keep.size:
        return _nothing()
    array = image.array
    if dark is not None:  # only the windows matter, but they are read from one array
        array = array.astype(np.float32) - dark
    snr = excess[keep] / filtered[keep]
    order = np.argsort(-snr, kind="stable")
    keep, snr = keep[order], snr[order]
    return _sorted(
        [_measure(array, image, x[keep], y[keep], snr, noise[keep], level, np.array(optics.width), s, quantum)], s
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
    for k, mine in ((level, ~full), (min(level + 1, 2), full)):
        if mine.any():
            parts.append(_measure(array, image, x[mine], y[mine], snr[mine], floor[mine], k, width, s, quantum, widths))
    if not len(parts[0]) or sum(map(len, parts)) < _FEW:
        return None
    bright = parts[0].snr > _BRIGHT
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
    for k in range(s.levels):
        if min(binned.shape) < 40:
            break
        found.append(_candidates(array, binned, k, s, quantum))
        if k == 0 and s.levels > 1:
            binned = halve(binned)
            continue
        places = _merged(found, s)
        width = _optics(array, image, *places[:4])
        if width is not None and width.max() < _COARSE:  # sharp stars: the coarsest level would show only structure
            break
        if k + 1 < s.levels:
            binned = halve(binned)
    if not found:
        return _nothing(), None
    x, y, level, snr, floor = places or _merged(found, s)
    if not len(x):
        return _nothing(), None
    optics = None if width is None else Optics((float(width[0]), float(width[1])))
    if optics is not None:
        # A faint star shows best at the scale of the optics: what only a coarser one sees is structure, unless it is bright.
        best = optics.level
        keep = (level <= best) | (snr > _BRIGHT)
        x, y, level, snr, floor = (c[keep] for c in (x, y, level, snr, floor))
        # A window as wide as the optics need; a wider one only for what is full, whose light reaches farther.
        full = array[y, x] >= 0.98 * image.saturation
        level = np.where(full, np.maximum(level, best), best)
    parts = []
    for k in range(s.levels):
        mine = np.flatnonzero(level == k)
        if mine.size:
            parts.append(_measure(array, image, x[mine], y[mine], snr[mine], floor[mine], k, width, s, quantum))
    return (_sorted(parts, s) if parts else _nothing()), optics


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


def _nothing() -> Centroids:
    n = np.zeros(0)
    return Centroids(n, n, n, np.zeros((0, 2, 2)), n, n.astype(bool), n, n)


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


def _optics(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, level: np.ndarray, snr: np.ndarray
) -> np.ndarray | None:
    """Sigma (2,) of the optics along x and y, px, from the brightest places that are not saturated; None where too few say."""
    some = np.flatnonzero((snr > _BRIGHT) & (level < 2))[:_FOR_WIDTH]
    if some.size < 3:
        return None
    w = windows(array, image, x[some], y[some], HALF[1], 1e-9)
    clear = ~w.filled.any(axis=(1, 2)) & ~w.structure
    if clear.sum() < 3:
        return None
    f = fit(w.inner[clear], w.x0[clear], w.y0[clear], w.sky[clear], w.noise[clear], np.ones(2), w.filled[clear], 0.5, 4)
    return np.median(f.sigma, axis=0)


def _measure(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, snr: np.ndarray, floor: np.ndarray, level: int,
    width: np.ndarray | None, s: DetectionSettings, quantum: float, widths: list[np.ndarray] | None = None,
) -> Centroids:  # fmt: skip
    """Fit the places of one level and keep those that are stars. widths: gets the fitted sigmas (n, 2) of these."""
    half = HALF[level]
    rounding = quantum / np.sqrt(12.0)
    w = windows(array, image, x, y, half, np.minimum(floor, rounding))
    calm = np.flatnonzero(~w.structure)
    if not calm.size:
        return _nothing()
    if calm.size < len(x):
        x, y, snr, floor = x[calm], y[calm], snr[calm], floor[calm]
        w = Windows(**{k: v[calm] for k, v in vars(w).items()})
    expected = np.full(2, _WIDTH[level]) if width is None else width
    f = fit(w.inner, w.x0, w.y0, w.sky, w.noise, expected, w.filled, 0.25 if width is not None else 0.35)
    clear = (snr > _BRIGHT) & ~w.filled.any(axis=(1, 2))
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
    """The same by detect.c."""
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
    """The library with the types of what is called here."""
    library.helmstar_judge.argtypes = [c_void_p] * 10 + [c_int64, c_int, c_double, c_double] + [c_void_p] * 6
    for f in (library.helmstar_apart, library.helmstar_alone):
        f.argtypes, f.restype = [c_void_p] * 3 + [c_int64, c_void_p], None
    return library


def _is_star(f: Fit, noise: np.ndarray, half: int, s: DetectionSettings) -> np.ndarray:
    """Which fits look like a star: centred, neither a pixel nor a plane, and more light than the roughness around them."""
    wide, narrow = f.sigma.max(axis=1), f.sigma.min(axis=1)
    light = f.sums[:, 1]
    explained = light / (light + f.sums[:, 2])
    # At the coarsest level nothing wider is tried: a smeared or badly focused star may fill the window if little else does.
    wider = (wide < _FILLS * half) & (explained > _WELL) if half == HALF[-1] else False
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


__all__ = ["HALF", "DetectionSettings", "Optics", "dark_of", "detect", "detect_near", "detect_next"]
