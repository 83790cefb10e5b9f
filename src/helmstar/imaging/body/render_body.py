"""A frame of a target body: its surface under a law, stars behind it, optics and sensor, with the truth.

The body's light is averaged over cells finer than a pixel (raycast, raster), spread by the optics on those cells, and summed over
pixels; a small or thinly lit ellipsoid is a sum of points at the quadrature nodes of its surface, exact for any size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from ..camera import Camera
from ..frame import Image
from ..render import Exposure, sensor_counts
from .phase import nodes
from .photometry import Lambert, Law
from .raycast import Grid, average
from .shape import Ellipsoid, EllipsoidView, Mesh, Shape

MOST_NODES = 2500
"""An ellipsoid that needs no more quadrature nodes is drawn from them."""
FINE = 240.0
"""Least number of cells across a body that rays are cast at, up to 8 to a pixel."""
_REACH = 5.0  # sigma of the optics that are drawn


@dataclass(frozen=True)
class Stars:
    """Stars that may be in a frame. directions_C: (n, 3) in C. electrons: (n,) each brings in the exposure."""

    directions_C: np.ndarray
    electrons: np.ndarray


@dataclass(frozen=True)
class BodyTruth:
    """What a rendered frame holds. centre_px: (2,) where the body's centre is seen. centroid_px: (2,) brightness centroid
    of its light without noise and threshold, NaN without light. diameter_px: across a sphere of equal volume. electrons: its light.
    phase: rad. window: (left, top, width, height) of what was drawn, px. stars: indices of the stars that were drawn."""

    centre_px: np.ndarray
    centroid_px: np.ndarray
    diameter_px: float
    electrons: float
    phase: float
    window: tuple[int, int, int, int]
    stars: np.ndarray


def render_body(
    camera: Camera, shape: Shape, r_TC_C: np.ndarray, sun_C: np.ndarray, *, R_TC: np.ndarray | None = None, law: Law | None = None,
    signal_e: float = 8000.0, exposure: Exposure | None = None, stars: Stars | None = None, seed: int = 0,
) -> tuple[Image, BodyTruth]:  # fmt: skip
    """A whole frame and its truth.

    r_TC_C: (3,) from camera to body, m, in C (z boresight, x right, y down). sun_C: (3,) from body to Sun, in C. R_TC: (3, 3),
    turns components in C into those in the body's frame; None is I. signal_e: electrons of a pixel that is filled by I/F = 1.
    law: Lambert if None. Equal seeds give equal frames.

    Raises ValueError for shapes of arrays that do not fit and a camera within the body.
    """
    return render_window(
        camera, shape, r_TC_C, sun_C, (0, 0, camera.width, camera.height),
        R_TC=R_TC, law=law, signal_e=signal_e, exposure=exposure, stars=stars, seed=seed,
    )  # fmt: skip


def render_window(
    camera: Camera, shape: Shape, r_TC_C: np.ndarray, sun_C: np.ndarray, window: tuple[int, int, int, int] | None = None, *,
    R_TC: np.ndarray | None = None, law: Law | None = None, signal_e: float = 8000.0, exposure: Exposure | None = None,
    stars: Stars | None = None, seed: int | np.random.Generator = 0, margin_px: int = 12,
) -> tuple[Image, BodyTruth]:  # fmt: skip
    """A window (left, top, width, height) of the frame, px; None is the body's box with a margin, within the frame.

    Its pixel (0, 0) is the frame's (left, top); the truth is in the frame's pixels. Where the body is out of the frame and no
    window is given, the frame's nearest part is drawn. Otherwise as `render_body`.
    """
    e, law = exposure or Exposure(), law or Lambert()
    r, sun, R = checked(shape, r_TC_C, sun_C, R_TC)
    if window is None:
        window = within(box(camera, shape, r, margin_px + _REACH * e.psf_sigma_px), camera)
    light = body_light(camera, shape, r, R, sun, law, window, e.psf_sigma_px)
    light *= signal_e
    truth = _truth(camera, shape, r, sun, light, window)
    if stars is not None:
        truth = _with_stars(light, camera, shape, r, R, stars, window, e, truth)
    light += (e.sky_e_s + e.dark_e_s) * e.duration
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    return sensor_counts(np.maximum(light, 0.0).astype(np.float32), e, rng), truth


def checked(shape: Shape, r_TC_C: Any, sun_C: Any, R_TC: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """r, unit Sun and R as arrays. Raises ValueError."""
    r, sun = np.asarray(r_TC_C, float), np.asarray(sun_C, float)
    R = np.eye(3) if R_TC is None else np.asarray(R_TC, float)
    if r.shape != (3,) or sun.shape != (3,) or R.shape != (3, 3):
        raise ValueError(f"r_TC_C {r.shape}, sun_C {sun.shape}, R_TC {R.shape}: must be (3,), (3,) and (3, 3)")
    if not (np.isfinite(r).all() and np.isfinite(sun).all() and np.linalg.norm(sun) > 0.0):
        raise ValueError("r_TC_C and sun_C: must be finite, and the Sun's direction not zero")
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0:
        raise ValueError("R_TC: must be a rotation")
    if not r[2] > shape.reach:
        raise ValueError(f"r_TC_C[2] {r[2]:g} m: the body must be in front of the camera, its nearest point too")
    return r, sun / np.linalg.norm(sun), R


def box(camera: Camera, shape: Shape, r_TC_C: np.ndarray, margin_px: float) -> tuple[int, int, int, int]:
    """(left, top, width, height) around the sphere that holds the body, inside the frame or not."""
    x, y = r_TC_C[:2] / r_TC_C[2]
    half = shape.reach / math.sqrt(r_TC_C[2] ** 2 - shape.reach**2) * (1.0 + x * x + y * y)
    t = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rim = np.stack([x + 1.03 * half * np.cos(t), y + 1.03 * half * np.sin(t), np.ones(16)], -1)
    p = camera.pixels(np.concatenate([rim, [[x, y, 1.0]]]))
    p = p[np.isfinite(p).all(axis=1)]
    if not len(p):
        return 0, 0, camera.width, camera.height
    low, high = np.floor(p.min(axis=0) - margin_px), np.ceil(p.max(axis=0) + margin_px)
    low, high = np.clip(low, -1e7, 1e7), np.clip(high, -1e7, 1e7)
    return int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1


def within(window: tuple[int, int, int, int], camera: Camera) -> tuple[int, int, int, int]:
    """The part of a window on the frame, at least 1 x 1 px."""
    left, top, width, height = window
    x0, y0 = min(max(left, 0), camera.width - 1), min(max(top, 0), camera.height - 1)
    x1, y1 = max(min(left + width, camera.width), x0 + 1), max(min(top + height, camera.height), y0 + 1)
    return x0, y0, x1 - x0, y1 - y0


def body_light(
    camera: Camera, shape: Shape, r: np.ndarray, R: np.ndarray, sun: np.ndarray, law: Law,
    window: tuple[int, int, int, int], psf_sigma_px: float,
) -> np.ndarray:  # fmt: skip
    """I/F of each pixel of a window after the optics, without noise: (height, width) float64. Arguments as `checked` gives them."""
    left, top, width, height = window
    light = np.zeros((height, width))
    diameter = apparent_diameter(camera, shape, r)
    n = _enough(shape, diameter, r, sun, psf_sigma_px)
    if isinstance(shape, Ellipsoid) and n[0] * n[1] <= MOST_NODES:
        points = nodes(camera, shape, r, R, sun, n)
        add_points(light, points.xy_px - [left, top], points.light(law), psf_sigma_px)
        return light
    blur = math.ceil(_REACH * psf_sigma_px) + 1
    bx, by, bw, bh = box(camera, shape, r, 1.0)
    x0, y0 = max(bx, left - blur), max(by, top - blur)
    x1, y1 = min(bx + bw, left + width + blur), min(by + bh, top + height + blur)
    if x1 <= x0 or y1 <= y0:
        return light
    per_px = max(cells_per_px(psf_sigma_px), min(8, math.ceil(FINE / diameter)))
    grid = Grid(x0 - 0.5, y0 - 0.5, (x1 - x0) * per_px, (y1 - y0) * per_px, per_px)
    if isinstance(shape, Mesh):
        from .raster import mesh_light

        cells = mesh_light(camera, shape, r, R, sun, law, grid)
    else:
        view = EllipsoidView.of(shape, r, R, sun)
        channels, _ = average(
            camera, view, sun, grid, lambda mu0, mu, a: [law(mu0, mu, a)], by_phase=bool(law.by_phase)
        )
        cells = channels[0]
    pixels = spread(cells, blur, per_px, psf_sigma_px)
    paste(light, pixels, x0 - blur - left, y0 - blur - top)
    return light


def _enough(shape: Shape, diameter_px: float, r: np.ndarray, sun: np.ndarray, sigma_px: float) -> tuple[int, int]:
    """Nodes along longitude and latitude of the lune; the largest spacing is then a sigma of what spreads them, pixels included.

    Gaussians at that spacing add up to a constant within 1e-8.
    """
    length = 2.0 * diameter_px * shape.reach / shape.mean_radius / math.hypot(sigma_px, 0.29)
    lit = 0.5 * (1.0 + float(-(r @ sun) / np.linalg.norm(r)))  # share of the disc's width
    return int(12 + length * min(1.0, 1.2 * lit + 0.1)), int(8 + length)


def cells_per_px(psf_sigma_px: float) -> int:
    """Cells along a pixel's side on which a Gaussian of that sigma is sampled well enough."""
    return int(np.clip(math.ceil(1.5 / psf_sigma_px), 1, 8))


def spread(cells: np.ndarray, blur: int, per_px: int, sigma_px: float) -> np.ndarray:
    """Pixels, with `blur` more of them on each side, of cells after a Gaussian of that sigma."""
    padded = np.pad(cells, blur * per_px)
    smooth = np.asarray(gaussian_filter(padded, sigma_px * per_px, mode="constant", truncate=_REACH))
    h, w = smooth.shape[0] // per_px, smooth.shape[1] // per_px
    return smooth.reshape(h, per_px, w, per_px).mean(axis=(1, 3)) if per_px > 1 else smooth


def paste(light: np.ndarray, patch: np.ndarray, left: int, top: int) -> None:
    """Add a patch whose pixel (0, 0) is (left, top) of the light; what lies outside is left out."""
    h, w = light.shape
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + patch.shape[1], w), min(top + patch.shape[0], h)
    if x1 > x0 and y1 > y0:
        light[y0:y1, x0:x1] += patch[y0 - top : y1 - top, x0 - left : x1 - left]


def add_points(light: np.ndarray, xy_px: np.ndarray, amount: np.ndarray, sigma_px: float) -> None:
    """Add point sources (n) spread by the optics, integrated over pixels; all of them near each other or few."""
    h, w = light.shape
    reach = _REACH * sigma_px + 1.0
    x, y = xy_px[:, 0], xy_px[:, 1]
    on = (x > -reach) & (y > -reach) & (x < w - 1 + reach) & (y < h - 1 + reach)
    if not on.any():
        return
    x, y, amount = x[on], y[on], amount[on]
    x0, x1 = max(int(x.min() - reach), 0), min(int(x.max() + reach) + 2, w)
    y0, y1 = max(int(y.min() - reach), 0), min(int(y.max() + reach) + 2, h)
    if x1 <= x0 or y1 <= y0:
        return

    def share(at: np.ndarray, low: int, high: int) -> np.ndarray:
        edges = (np.arange(low, high + 1) - 0.5 - at[:, None]) / (math.sqrt(2.0) * sigma_px)
        return 0.5 * np.diff(erf(edges), axis=1)

    # Not a matrix product, whose threads cost more than the work where processors are shared.
    light[y0:y1, x0:x1] += np.einsum("ny,nx->yx", share(y, y0, y1), share(x, x0, x1) * amount[:, None])


def apparent_diameter(camera: Camera, shape: Shape, r_TC_C: np.ndarray) -> float:
    """px: across the sphere of equal volume at the body's place."""
    return 2.0 * shape.mean_radius * camera.focal_px / float(r_TC_C[2])


def _truth(
    camera: Camera, shape: Shape, r: np.ndarray, sun: np.ndarray, light: np.ndarray, window: tuple[int, int, int, int]
) -> BodyTruth:
    total = float(light.sum())
    centroid = np.full(2, np.nan)
    if total > 0.0:
        centroid = (
            np.array([light.sum(axis=0) @ np.arange(window[2]), light.sum(axis=1) @ np.arange(window[3])]) / total
        )
        centroid = centroid + np.array(window[:2])
    phase = math.acos(float(np.clip(-(r @ sun) / np.linalg.norm(r), -1.0, 1.0)))
    size = apparent_diameter(camera, shape, r)
    return BodyTruth(camera.pixels(r), centroid, size, total, phase, window, np.zeros(0, int))


def _with_stars(
    light: np.ndarray, camera: Camera, shape: Shape, r: np.ndarray, R: np.ndarray, stars: Stars,
    window: tuple[int, int, int, int], e: Exposure, truth: BodyTruth,
) -> BodyTruth:  # fmt: skip
    """Add the stars that the body does not hide."""
    d = np.asarray(stars.directions_C, float)
    electrons = np.asarray(stars.electrons, float)
    if d.ndim != 2 or d.shape[1] != 3 or electrons.shape != d.shape[:1]:
        raise ValueError(f"stars: directions {d.shape} and electrons {electrons.shape} must be (n, 3) and (n,)")
    place = camera.pixels(d)
    left, top, width, height = window
    local = place - [left, top]
    reach = _REACH * e.psf_sigma_px + 1.0
    index = np.flatnonzero(np.all((local > -reach) & (local < [width + reach, height + reach]), axis=1))
    index = index[~hidden(shape, r, R, d[index])]
    for k in index:
        add_points(light, local[k : k + 1], electrons[k : k + 1], e.psf_sigma_px)
    return BodyTruth(**{**vars(truth), "stars": index})


def hidden(shape: Shape, r: np.ndarray, R: np.ndarray, directions_C: np.ndarray) -> np.ndarray:
    """Which directions (n, 3) in C the body hides, (n,) bool."""
    d = np.asarray(directions_C, float)
    if isinstance(shape, Mesh):
        from .raster import hit

        return hit(shape, r, R, d)
    view = EllipsoidView.of(shape, r, R, np.array([0.0, 0.0, -1.0]))
    ahead = d[:, 2] > 0.0
    z = np.where(ahead, d[:, 2], 1.0)
    ex, ey = d[:, 0] / z - view.centre[0], d[:, 1] / z - view.centre[1]
    return np.logical_and(ahead, view.outline(ex, ey) <= 1.0)


__all__ = [
    "BodyTruth", "Stars", "add_points", "apparent_diameter", "body_light", "box", "hidden", "render_body", "render_window",
    "within",
]  # fmt: skip
