"""Light of an ellipsoid averaged over the cells of a grid: one ray inside the outline, quadrature on the rim.

Inside of the disc brightness is smooth and the middle of a cell stands for it; cells in which it bends, as at the terminator, are
divided. On the outline it jumps, and just inside it falls like the root of the distance: there each cell has lines across the
outline with nodes of quadrature on what of them is hit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..camera import Camera
from .shape import EllipsoidView

Shade = Callable[[np.ndarray, np.ndarray, np.ndarray | float], list[np.ndarray]]
"""mu0, mu, alpha (n,) to channels, each (n,)."""
_BAND = 2.0  # cells on both sides of the outline that are divided
BENT, SPLIT = 1e-4, 4
LINES, NODES = 4, 4
"""Lines through a cell of the rim, and nodes on each."""
_x, _w = np.polynomial.legendre.leggauss(NODES)
_NODES = (0.5 * (_x + 1.0), 0.5 * _w)
_CACHED = 48_000  # numbers in an array that are worked on together


@dataclass(frozen=True)
class Grid:
    """Cells of an image: per_px of them along a pixel's side, rows x columns, the first cell's edge at (left, top), px."""

    left: float
    top: float
    columns: int
    rows: int
    per_px: int

    @property
    def middles(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns' x and rows' y of cell middles, px."""
        k = self.per_px
        return self.left + (np.arange(self.columns) + 0.5) / k, self.top + (np.arange(self.rows) + 0.5) / k


class Plane:
    """Offsets on the plane z = 1 from a body's centre, for pixel positions of a camera."""

    def __init__(self, camera: Camera, centre: tuple[float, float]):
        self.camera, self.centre = camera, centre
        self.bent = any(camera.distortion)

    def __call__(self, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(ex, ey) of positions, both of one shape."""
        c = self.camera
        if self.bent:
            d = c.directions(np.stack([x_px, y_px], -1))
            return d[..., 0] / d[..., 2] - self.centre[0], d[..., 1] / d[..., 2] - self.centre[1]
        f = c.focal_px
        return (x_px - c.cx) / f - self.centre[0], (y_px - c.cy) * (c.aspect / f) - self.centre[1]


def average(
    camera: Camera, view: EllipsoidView, sun_C: np.ndarray, grid: Grid, shade: Shade, by_phase: bool = False,
    refine: bool = True,
) -> tuple[list[np.ndarray], np.ndarray]:  # fmt: skip
    """Channels averaged over each cell, [(rows, columns)], and the share of each cell that the body covers.

    by_phase: whether `shade` wants alpha for each ray, else 0 is given.
    refine: whether cells in which brightness bends, at the terminator, are divided too.
    """
    plane = Plane(camera, view.centre)
    x, y = grid.middles
    # |p| grows by one over the radius, in cells, of the ellipse: so far from 1 no cell touches the outline.
    scale = camera.focal_px * min(1.0, 1.0 / camera.aspect) * grid.per_px
    margin = max(_BAND * view.depth * np.linalg.norm(view.A, axis=0).max() / scale, 1e-300)
    size = grid.rows * grid.columns
    cover = np.zeros(size)
    channels: list[np.ndarray] = []
    rims = []

    def put(index: np.ndarray, values: list[np.ndarray]) -> None:
        while len(channels) < len(values):
            channels.append(np.zeros(size))
        for c, v in zip(channels, values):
            c[index] = v

    def shaded(ex: np.ndarray, ey: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        q, mu0, mu = view.shade(ex, ey)
        return q, shade(mu0, mu, _phase(view, sun_C, ex, ey) if by_phase else 0.0)

    put(np.zeros(0, int), shaded(np.zeros(0), np.zeros(0))[1])
    # Some rows at a time: arrays that stay in the cache are several times faster.
    at_once = max(1, _CACHED // grid.columns)
    for i in range(0, grid.rows, at_once):
        ex, ey = plane(*np.broadcast_arrays(x[None, :], y[i : i + at_once, None]))
        pp = view.outline(ex, ey)
        rim = np.flatnonzero((pp > max(1.0 - margin, 0.0) ** 2) & (pp < (1.0 + margin) ** 2))
        inside = np.flatnonzero(pp <= (1.0 - margin) ** 2) if margin < 1.0 else np.zeros(0, int)
        if margin >= 1.0:  # also the very middle, which the first comparison leaves out
            rim = np.flatnonzero(pp < (1.0 + margin) ** 2)
        rims.append(rim + i * grid.columns)
        if inside.size:
            put(inside + i * grid.columns, shaded(ex.ravel()[inside], ey.ravel()[inside])[1])
            cover[inside + i * grid.columns] = 1.0
    shape = (grid.rows, grid.columns)
    if refine:
        bent = np.flatnonzero(_bent(channels, cover.reshape(shape) > 0.0))
        d = ((np.arange(SPLIT) + 0.5) / SPLIT - 0.5) / grid.per_px
        dx, dy = np.tile(d, SPLIT), np.repeat(d, SPLIT)
        for i in range(0, len(bent), _CACHED // SPLIT**2):
            k = bent[i : i + _CACHED // SPLIT**2]
            values = shaded(*plane(x[k % grid.columns, None] + dx, y[k // grid.columns, None] + dy))[1]
            put(k, [v.mean(axis=1) for v in values])
    rim = np.concatenate(rims)
    # Lines across the outline, so that none touches it: along x where it runs rather along y, and the other way round.
    across_x = _runs_along_y(view, *plane(x[rim % grid.columns], y[rim // grid.columns]), camera.aspect)
    part = _CACHED // (LINES * NODES)
    for along_x in (True, False):
        some = rim[across_x == along_x]
        for i in range(0, len(some), part):
            k = some[i : i + part]
            middle = x[k % grid.columns], y[k // grid.columns]
            x_px, y_px, weight = _lines(view, plane, *middle, 0.5 / grid.per_px, along_x)
            cover[k] = weight.sum(axis=(1, 2))
            q, values = shaded(*plane(x_px, y_px))
            put(k, [(weight * np.where(q < 1.0, v, 0.0)).sum(axis=(1, 2)) for v in values])
    return [c.reshape(shape) for c in channels], cover.reshape(shape)


def _bent(channels: list[np.ndarray], inner: np.ndarray) -> np.ndarray:
    """Cells whose middle differs from their mean by more than BENT of the brightest: a 24th of both second differences."""
    bad = np.zeros(inner.shape, bool)
    for c in channels:
        a = c.reshape(inner.shape)
        limit = 24.0 * BENT * max(float(a.max(initial=0.0)), 1e-300)
        bad[1:-1] |= np.abs(a[2:] - 2.0 * a[1:-1] + a[:-2]) > limit
        bad[:, 1:-1] |= np.abs(a[:, 2:] - 2.0 * a[:, 1:-1] + a[:, :-2]) > limit
    return bad & inner


def _runs_along_y(view: EllipsoidView, ex: np.ndarray, ey: np.ndarray, aspect: float) -> np.ndarray:
    """Whether |p| changes faster along columns' x than along y, at offsets (n,)."""
    B = view.A.T @ view.A
    return np.abs(B[0, 0] * ex + B[0, 1] * ey) >= np.abs(B[1, 0] * ex + B[1, 1] * ey) * aspect


def _lines(
    view: EllipsoidView, plane: Plane, x: np.ndarray, y: np.ndarray, half: float, along_x: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of quadrature in cells (n,) of that half side, px: x, y and weight, each (n, LINES, NODES); weights of a cell sum
    to the share of it within the outline.

    Along a line p.p is a parabola but for perspective too small to matter here; its roots bound what is hit. Nodes crowd at both
    ends, where brightness goes like the root of the distance.
    """
    side = ((np.arange(LINES) + 0.5) / LINES - 0.5) * 2.0 * half
    base, run = (y, x) if along_x else (x, y)
    base = base[:, None] + side  # (n, LINES)

    def at(t: np.ndarray, b: np.ndarray) -> np.ndarray:
        return view.outline(*(plane(t, b) if along_x else plane(b, t))) - 1.0

    run = np.broadcast_to(run[:, None], base.shape)
    low, middle, high = at(run - half, base), at(run, base), at(run + half, base)
    a, b = 0.5 * (high + low) - middle, 0.5 * (high - low)
    root = np.sqrt(np.maximum(b * b - 4.0 * a * middle, 0.0))
    # The form of the roots that does not cancel; a > 0, for what is hit is convex.
    far = -0.5 * (b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        r1, r2 = far / a, middle / far
    t0 = np.clip(np.nan_to_num(np.fmin(r1, r2), nan=-1.0), -1.0, 1.0)
    t1 = np.clip(np.nan_to_num(np.fmax(r1, r2), nan=1.0), -1.0, 1.0)
    miss = b * b - 4.0 * a * middle <= 0.0
    t1 = np.where(miss, t0, t1)
    v, w = _NODES
    t = t0[..., None] + (t1 - t0)[..., None] * (v * v * (3.0 - 2.0 * v))
    weight = (0.5 / LINES) * (t1 - t0)[..., None] * (w * 6.0 * v * (1.0 - v))
    t = run[..., None] + half * t
    base = np.broadcast_to(base[..., None], t.shape)
    return (t, base, weight) if along_x else (base, t, weight)


def _phase(view: EllipsoidView, sun_C: np.ndarray, ex: np.ndarray, ey: np.ndarray) -> np.ndarray:
    """Angle between the Sun and the way back to the camera, rad."""
    x, y = ex + view.centre[0], ey + view.centre[1]
    cos = -(sun_C[0] * x + sun_C[1] * y + sun_C[2]) / np.sqrt(1.0 + x * x + y * y)
    return np.arccos(np.clip(cos, -1.0, 1.0))


__all__ = ["Grid", "Plane", "Shade", "average"]
