"""Windows around places of an image: their light, the ring around them, its sky and noise, and what stands about."""

from __future__ import annotations

from ctypes import c_float, c_int, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..native import address, kernels
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
    """Windows of n places at one level: inner (n, m, m) pixels, above (n, m, m) what of them is above the sky, full (n, m, m)
    what is saturated, filled (n, m, m) what says nothing.

    sky: (n,) of the ring around, noise: (n,) its spread; grain: (n,) the same without what is smooth. x0, y0: (n,) middle of the
    light, from the window's middle pixel. structure: (n,) bool, on a ridge or at the edge of something large.
    """

    inner: np.ndarray
    above: np.ndarray
    full: np.ndarray
    filled: np.ndarray
    sky: np.ndarray
    noise: np.ndarray
    grain: np.ndarray
    x0: np.ndarray
    y0: np.ndarray
    structure: np.ndarray


def windows(
    array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, half: int, floor: np.ndarray | float
) -> Windows:
    """Windows of places x, y (n,) int, half the side in px. floor: least noise, counts."""
    library = kernels()
    if library is not None and array.dtype in TYPES and array.flags.c_contiguous:
        found = _windows_compiled(library, array, image, x, y, half, floor)
        if found is not None:
            return found
    reach, n = half + BORDER, len(x)
    w = around(array, x, y, reach)
    border, steps_from, steps_to = _ring(half)
    pixels = w.reshape(n, (2 * reach + 1) ** 2)
    ring = pixels.take(border, axis=1)
    ordered = np.sort(ring, axis=1)
    begin, end, low, high, step = _quantiles(half)
    sky = ordered[:, begin:end].mean(axis=1)
    noise = np.maximum((ordered[:, high] - ordered[:, low]) / 2, floor)
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
    grain = np.minimum(noise, np.maximum(steps[:, step] / np.sqrt(2.0), floor))
    x0, y0 = columns @ d / total, rows @ d / total
    structure = _in_structure(above, ring, sky, grain, half)
    return Windows(inner, above, full, full | outside, sky, noise, grain, x0, y0, structure)


TYPES = {np.dtype(np.uint8): 0, np.dtype(np.uint16): 1, np.dtype(np.float32): 2}
"""Numbers by which the C sources know an image's type."""


def _windows_compiled(
    library: Any, array: np.ndarray, image: Image, x: np.ndarray, y: np.ndarray, half: int, floor: np.ndarray | float
) -> Windows | None:
    """The same by windows.c; None for windows that it does not take."""
    n, m, ring, sectors, at = len(x), 2 * half + 1, len(_ring(half)[0]), _numbers(half), _quantiles(half)
    x, y = np.ascontiguousarray(x, np.int64), np.ascontiguousarray(y, np.int64)
    least = np.empty(n, np.float32)
    least[:] = floor
    inner, above = np.empty((2, n, m, m), np.float32)
    full, filled = np.empty((2, n, m, m), bool)
    sky, noise, grain, x0, y0 = np.empty((5, n), np.float32)
    structure = np.empty(n, bool)
    out = (inner, above, full, filled, sky, noise, grain, x0, y0, structure)
    if declared(library).helmstar_windows(
        address(array), TYPES[array.dtype], *array.shape, address(x), address(y), address(least), n, half,
        0.98 * image.saturation, address(sectors), ring, address(at), *(address(a) for a in out),
    ):  # fmt: skip
        return None
    return Windows(inner, above, full, filled, sky, noise, grain, x0, y0, structure)


@cache
def declared(library: Any) -> Any:
    """The library with the types of what windows.c has."""
    image = [c_void_p, c_int, c_int64, c_int64]
    places = [c_void_p, c_void_p, c_void_p, c_int64]
    library.helmstar_windows.argtypes = [*image, *places, c_int, c_float, c_void_p, c_int] + [c_void_p] * 11
    library.helmstar_wider.argtypes = [*image, c_void_p, *places, c_float, c_void_p]
    library.helmstar_near.argtypes = (
        [
            c_void_p,
            c_int,
            c_void_p,
            c_int64,
            c_int64,
            c_void_p,
            c_void_p,
            c_int64,
            c_int,
            c_int,
            c_int,
            c_void_p,
            c_float,
        ]
        + [c_void_p, c_int64]
        + [c_void_p] * 4
    )
    return library


@cache
def _quantiles(half: int) -> np.ndarray:
    """Places among the sorted pixels of the ring where the sky's mean begins and ends, of low and high, and of the grain's step."""
    ring, steps = len(_ring(half)[0]), len(_ring(half)[1])
    return np.array([int(q * ring) for q in (0.2, 0.8, 0.1587, 0.8413)] + [int(0.6827 * steps)], np.int32)


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
def _numbers(half: int) -> np.ndarray:
    """Which of eight directions, 0 to 7, each pixel of the ring lies in."""
    d = np.arange(-half - BORDER, half + BORDER + 1)
    angle = np.arctan2(d[:, None], d[None, :]).ravel()[_ring(half)[0]]
    return (np.rint(angle / (np.pi / 4)).astype(np.int32) % 8).astype(np.int32)


@cache
def _sectors(half: int) -> tuple[np.ndarray, np.ndarray]:
    """Ring pixels in the order of the eight directions they lie in, and where each direction starts."""
    number = _numbers(half)
    order = np.argsort(number, kind="stable")
    return order, np.searchsorted(number[order], np.arange(8))


def _in_structure(above: np.ndarray, ring: np.ndarray, sky: np.ndarray, grain: np.ndarray, half: int) -> np.ndarray:
    """Which places lie on a ridge (both sides of the ring bright along one line) or at the edge of something large."""
    peak = np.max(above[:, half - 1 : half + 2, half - 1 : half + 2], axis=(1, 2))
    order, starts = _sectors(half)
    ring = ring.take(order, axis=1)
    ring -= sky[:, None]
    most = np.maximum.reduceat(ring, starts, axis=1)
    mean = np.add.reduceat(ring, starts, axis=1) / np.diff(np.append(starts, ring.shape[1]))
    ridge = (np.minimum(most[:, :4], most[:, 4:]) > (0.3 * peak + 3.5 * grain)[:, None]).any(axis=1)
    return ridge | ((np.abs(mean) > (0.2 * peak + grain)[:, None]).sum(axis=1) >= 3)


__all__ = ["BORDER", "TYPES", "Windows", "around", "declared", "windows"]
