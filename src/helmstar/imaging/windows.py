"""Windows around places of an image: their light, the ring around them, its sky and noise, and what stands about."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from .frame import Image

BORDER = 2
"""Width of the ring, px."""


def around(array: np.ndarray, x: np.ndarray, y: np.ndarray, half: int) -> np.ndarray:
    """Windows (n, m, m), float32, edges repeated."""
    d = np.arange(-half, half + 1)
    height, width = array.shape
    rows, columns = y[:, None] + d, x[:, None] + d
    if x.size and not (x.min() >= half and y.min() >= half and x.max() < width - half and y.max() < height - half):
        np.clip(rows, 0, height - 1, out=rows)
        np.clip(columns, 0, width - 1, out=columns)
    return array.reshape(-1).take((rows * width)[:, :, None] + columns[:, None, :]).astype(np.float32)


@dataclass(frozen=True)
class Windows:
    """Windows of n places at one level: inner (n, m, m) pixels, ring (n, k) pixels around, filled (n, m, m) what says nothing.

    noise: (n,) spread of the ring; grain: (n,) the same without what is smooth.
    """

    inner: np.ndarray
    ring: np.ndarray
    full: np.ndarray
    filled: np.ndarray
    outside: np.ndarray
    sky: np.ndarray
    noise: np.ndarray
    grain: np.ndarray
    above: np.ndarray
    x0: np.ndarray
    y0: np.ndarray


def windows(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, half: int, floor: np.ndarray | float
) -> Windows:
    """Windows of places x, y (n,) int, half the side in px. floor: least noise, counts."""
    reach, n = half + BORDER, len(x)
    w = around(array, x, y, reach)
    border, steps_from, steps_to = _ring(half)
    pixels = w.reshape(n, -1)
    ring = pixels.take(border, axis=1)
    ordered = np.sort(ring, axis=1)
    count = ring.shape[1]
    sky = ordered[:, int(0.2 * count) : int(0.8 * count)].mean(axis=1)
    noise = np.maximum((ordered[:, int(0.8413 * count)] - ordered[:, int(0.1587 * count)]) / 2, floor)
    inner = w[:, BORDER:-BORDER, BORDER:-BORDER]
    above = np.maximum(inner - sky[:, None, None], np.float32(0.0))
    full = inner >= 0.98 * image.saturation
    outside = np.zeros(inner.shape, bool)
    at_edge = np.flatnonzero((x < reach) | (y < reach) | (x >= array.shape[1] - reach) | (y >= array.shape[0] - reach))
    if at_edge.size:
        whole = np.arange(-reach, reach + 1)
        off_y, off_x = y[at_edge, None] + whole, x[at_edge, None] + whole
        off_y, off_x = (off_y < 0) | (off_y >= array.shape[0]), (off_x < 0) | (off_x >= array.shape[1])
        off = off_y[:, :, None] | off_x[:, None, :]
        # What an edge repeats is no structure.
        beyond = off.reshape(len(off), -1).take(border, axis=1)
        ring[at_edge] = np.where(beyond, sky[at_edge, None], ring[at_edge])
        outside[at_edge] = off[:, BORDER:-BORDER, BORDER:-BORDER]
        above *= ~outside
    core = above[:, half - 2 : half + 3, half - 2 : half + 3] + np.float32(1e-9)
    d, rows, columns = np.arange(-2, 3, dtype=np.float32), core.sum(axis=2), core.sum(axis=1)
    total = rows.sum(axis=1)
    # From pixel to pixel along the border's rows and columns: structure that is smooth does not count as noise here.
    steps = np.sort(np.abs(pixels.take(steps_to, axis=1) - pixels.take(steps_from, axis=1)), axis=1)
    grain = np.minimum(noise, np.maximum(steps[:, int(0.6827 * steps.shape[1])] / np.sqrt(2.0), floor))
    x0, y0 = columns @ d / total, rows @ d / total
    return Windows(inner, ring, full, full | outside, outside, sky, noise, grain, above, x0, y0)


@cache
def _ring(half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat indices into a window (m, m) of the border around it, and of neighbours along its outermost rows and columns."""
    m = 2 * (half + BORDER) + 1
    mask = np.ones((m, m), bool)
    mask[BORDER:-BORDER, BORDER:-BORDER] = False
    at = np.arange(m * m).reshape(m, m)
    rows, columns = at[[0, -1]], at[:, [0, -1]]
    before = np.concatenate([rows[:, :-1].ravel(), columns[:-1].ravel()])
    after = np.concatenate([rows[:, 1:].ravel(), columns[1:].ravel()])
    return np.flatnonzero(mask), before, after


@cache
def _sectors(half: int) -> tuple[np.ndarray, np.ndarray]:
    """Ring pixels in the order of the eight directions they lie in, and where each direction starts."""
    d = np.arange(-half - BORDER, half + BORDER + 1)
    angle = np.arctan2(d[:, None], d[None, :]).ravel()[_ring(half)[0]]
    number = np.rint(angle / (np.pi / 4)).astype(int) % 8
    order = np.argsort(number, kind="stable")
    return order, np.searchsorted(number[order], np.arange(8))


def in_structure(w: Windows, half: int) -> np.ndarray:
    """Which places lie on a ridge (both sides of the ring bright along one line) or at the edge of something large."""
    peak = np.max(w.above[:, half - 1 : half + 2, half - 1 : half + 2], axis=(1, 2))
    order, starts = _sectors(half)
    ring = w.ring.take(order, axis=1)
    ring -= w.sky[:, None]
    most = np.maximum.reduceat(ring, starts, axis=1)
    mean = np.add.reduceat(ring, starts, axis=1) / np.diff(np.append(starts, ring.shape[1]))
    ridge = (np.minimum(most[:, :4], most[:, 4:]) > (0.3 * peak + 3.5 * w.grain)[:, None]).any(axis=1)
    return ridge | ((np.abs(mean) > (0.2 * peak + w.grain)[:, None]).sum(axis=1) >= 3)


__all__ = ["BORDER", "Windows", "around", "in_structure", "windows"]
