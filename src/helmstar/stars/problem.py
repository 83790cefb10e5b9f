"""What identification is about: the detections of an image, what is known of the focal length, and an attitude fitted to them.

`prepare` makes a list ready, with problem.c where it is compiled.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ..distortion import AGREES, NEWTON_STEPS, reach
from ..native import address, kernels
from .pinhole import Camera, ideal_pixels

MOST_DETECTIONS = 120
"""The brightest of a longer list are used."""
CROWDED_PX = 1.0
"""One star counts once: of detections closer than this, along both axes, the brightest stays."""
MAGNITUDE_WIDTH = 0.5
"""Of the smoothing of the detections' magnitudes, mag."""


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
        return _vacancy(len(self.xy))

    @property
    def knows_zero(self) -> bool:
        """Whether the magnitudes are given in the catalogue's own."""
        return self.magnitude is not None and self.zero_point is not None

    @cached_property
    def faintest(self) -> float:
        """V of the faintest star that may be among them: where the zero point is known, infinity elsewhere."""
        return self.faintest_at(1.0)

    def faintest_at(self, factor: float) -> float:
        """The same if the magnitudes' sigma is `factor` times what was told."""
        if self.zero_point is None or self.magnitude is None or len(self.xy) == 0:
            return math.inf
        return float(self.magnitude[-1]) + self.zero_point + 3.0 * factor * self.magnitude_sigma

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
    false", sigma_scale the factor on the detections' sigma, covariance (4, 4) of (theta in S, ln f) with that factor."""

    R: np.ndarray
    f: float
    stars: np.ndarray
    detections: np.ndarray
    residuals: np.ndarray
    log_odds: float
    sigma_scale: float
    zero_point: float
    covariance: np.ndarray


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


@cache
def _vacancy(n: int) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.log((n + 1.0) / np.arange(n, 0, -1)))])


def prepare(
    xy_px: np.ndarray,
    camera: Camera,
    flux: np.ndarray | None,
    magnitude: np.ndarray | None,
    sigma_px: float | np.ndarray,
    magnitude_sigma: float,
    zero_point: float | None,
) -> tuple[Detections, np.ndarray]:
    """Detections in ideal pixels, brightest first, and their covariances (n, 2, 2). Raises ValueError for what means nothing."""
    if not np.isfinite(camera.distortion).all():
        raise ValueError(f"distortion {camera.distortion}: must be five numbers, k1, k2, p1, p2, k3")
    if zero_point is not None and not math.isfinite(zero_point):
        raise ValueError(f"zero_point {zero_point}: must be a number, or None where it is unknown")
    xy = np.asarray(xy_px, dtype=float)
    if xy.size == 0:
        xy = xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"xy_px {xy.shape}: must be (n, 2)")
    n = len(xy)
    if flux is not None and magnitude is not None:
        raise ValueError("flux and magnitude: must be one or the other")
    if not magnitude_sigma > 0.0:
        raise ValueError(f"magnitude_sigma {magnitude_sigma}: must be positive")
    m = None
    if flux is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            m = -2.5 * np.log10(np.asarray(flux, dtype=float))
    elif magnitude is not None:
        m = np.asarray(magnitude, dtype=float)
    if m is not None and m.shape != (n,):
        raise ValueError(f"brightness {m.shape}: must have one entry for each of the {n} positions")
    C = np.asarray(sigma_px, dtype=float)
    if C.shape not in ((), (n,), (n, 2, 2)):
        raise ValueError(f"sigma_px {C.shape}: must be a number, ({n},) or ({n}, 2, 2)")
    if C.ndim < 3:
        C = np.broadcast_to(C**2, (n,))[:, None, None] * np.eye(2)
    (x, y), (width, height), a = camera.centre_px, camera.size_px, camera.aspect
    low, high = np.array([[-x, -y * a], [width - x, (height - y) * a]])
    library = kernels()
    if library is None:
        order, p, C, sigma, m, density, places = _listed(xy, C, m, camera, width * height * a)
        return Detections(p, sigma, m, magnitude_sigma, zero_point, density, places, low, high, order), C
    order, listed, C = _compiled(library, xy, C, m, camera, width * height * a)
    k = len(order)
    sigma, places, density = listed[2 * k : 5 * k].reshape(3, k)
    p, m = listed[: 2 * k].reshape(k, 2), None if m is None else listed[6 * k + 1 :]
    d = Detections(p, sigma, m, magnitude_sigma, zero_point, density, places, low, high, order)
    d.__dict__["in_c"] = listed  # where the cached property would put the same
    return d, C


def _listed(xy: np.ndarray, C: np.ndarray, m: np.ndarray | None, camera: Camera, area: float) -> tuple:
    """Of those that count, brightest first: index in the list, ideal pixels, covariance, sigma, magnitude, log densities."""
    stretch = np.array([1.0, camera.aspect])
    C = C * stretch[:, None] * stretch
    good = np.isfinite(xy).all(axis=1) & (C[:, 0, 0] > 0) & (C[:, 0, 0] * C[:, 1, 1] > C[:, 0, 1] ** 2)
    good &= np.isfinite(C).all(axis=(1, 2))
    if m is not None:
        good &= np.isfinite(m)
    order = np.flatnonzero(good)
    if m is not None:
        order = order[np.argsort(m[order], kind="stable")]
    p = ideal_pixels(camera, xy[order])
    there = np.isfinite(p).all(axis=1)
    order, p = order[there], p[there]
    keep = np.ones(len(order), dtype=bool)
    for k in np.flatnonzero(_crowded(p)):
        before = keep[:k] & (np.abs(p[:k] - p[k]).max(axis=1) < CROWDED_PX)
        keep[k] = not before.any()
    order, p = order[keep][:MOST_DETECTIONS], p[keep][:MOST_DETECTIONS]
    C = C[order]
    sigma = np.sqrt(0.5 * (C[:, 0, 0] + C[:, 1, 1]))
    m = None if m is None else m[order]
    density = _log_density(m) if m is not None and len(order) else np.zeros(len(order))
    return order, p, C, sigma, m, density, _log_place_density(p, area)


def _compiled(
    library: ctypes.CDLL, xy: np.ndarray, C: np.ndarray, m: np.ndarray | None, camera: Camera, area: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_listed`, by problem.c: order, what is `in_c` of the detections, and covariance."""
    xy, C = np.ascontiguousarray(xy), np.ascontiguousarray(C)
    m = None if m is None else np.ascontiguousarray(m)
    (x, y), (k1, k2, p1, p2, k3) = camera.centre_px, camera.distortion
    far = reach(camera.distortion) if any(camera.distortion) else math.inf
    lens = (camera.focal_px, k1, k2, p1, p2, k3)
    eye = (ctypes.c_double * 15)(
        x, y, camera.aspect, *lens, area, MAGNITUDE_WIDTH, CROWDED_PX, far, NEWTON_STEPS, AGREES
    )
    room = min(len(xy), MOST_DETECTIONS)
    order, out = np.empty(room, dtype=np.int64), np.empty(11 * room + 1)
    k = library.helmstar_prepare(
        ctypes.c_int64(len(xy)), ctypes.c_void_p(address(xy)), ctypes.c_void_p(address(C)),
        ctypes.c_void_p(None if m is None else address(m)), eye, ctypes.c_int64(room),
        ctypes.c_void_p(address(order)), ctypes.c_void_p(address(out)),
    )  # fmt: skip
    if k < 0:
        raise MemoryError("no room for the detections")
    return order[:k], out[: 7 * k + 1], out[7 * k + 1 : 11 * k + 1].reshape(k, 2, 2)


def _crowded(p: np.ndarray) -> np.ndarray:
    """(n,) whether anything else may be too close; cheap for the usual list, where nothing is."""
    if len(p) < 2:
        return np.zeros(len(p), dtype=bool)
    order = np.argsort(p[:, 0], kind="stable")
    x = p[order, 0]
    close = np.flatnonzero(x[1:] - x[:-1] < CROWDED_PX)
    out = np.zeros(len(p), dtype=bool)
    out[order[close]] = out[order[close + 1]] = True
    return out


def _log_density(m: np.ndarray) -> np.ndarray:
    """Log density (n,) 1/mag of the detections' own magnitudes: half a smoothed count, half even over their range."""
    width = MAGNITUDE_WIDTH
    z = (m[:, None] - m[None, :]) / width
    smooth = np.exp(-0.5 * z * z).sum(axis=1) / len(m) / (width * np.sqrt(2.0 * np.pi))
    even = 1.0 / (m.max() - m.min() + 2.0 * width)
    return np.log(0.5 * smooth + 0.5 * even)


def _log_place_density(p: np.ndarray, area: float) -> np.ndarray:
    """Log density (n,) 1/px^2 of the detections, one more counted: half even over the image, half smoothed from the others."""
    n = len(p)
    if n < 2:
        return np.full(n, np.log((n + 1.0) / area))
    width = 0.5 * np.sqrt(area / n)
    dx, dy = p[:, :1] - p[:, 0], p[:, 1:] - p[:, 1]
    square = dx * dx + dy * dy
    others = np.exp(-0.5 / width**2 * square).sum(axis=1) - 1.0
    return np.log(0.5 / area + 0.5 * others / (n - 1.0) / (2.0 * np.pi * width**2)) + np.log(n + 1.0)


__all__ = ["MOST_DETECTIONS", "Detections", "Fit", "Freedom", "middle", "prepare"]
