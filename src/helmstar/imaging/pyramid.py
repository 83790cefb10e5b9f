"""Places that may be stars: local maxima above the noise in an image filtered at several scales.

Each level is the one before, summed over 2 x 2 pixels, and is filtered by [1 2 1] both ways: a Gaussian of sigma 0.8, 1.5 and 3
pixels for levels 0, 1 and 2, and 6 for level 3. That is sharp optics, soft optics, and smeared or badly focused stars twice. The
work is done in bands of rows that stay in the processor's cache, in whole numbers where these are 8 bit.
"""

from __future__ import annotations

from ctypes import c_float, c_int, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..native import address, kernels
from .background import PER_TILE, grid, mesh_from, mesh_of
from .windows import TYPES

TILES = (64, 48, 32, 24)
"""Side of a tile of the sky's mesh at each level, in its own pixels."""
_BAND = 128
_ROOM = 1024  # places that are made room for at first
WEIGHT = 16.0
"""Sum of the filter's weights."""
_NOISE = 6.0  # root of the sum of their squares: from a pixel's noise to the filtered noise


@dataclass(frozen=True)
class Peaks:
    """x, y: (n,) int places in the level's own pixels; excess, noise: (n,) filtered value above the sky, and its sigma."""

    x: np.ndarray
    y: np.ndarray
    excess: np.ndarray
    noise: np.ndarray


def wide(array: np.ndarray) -> np.dtype:
    """The type in which sums over 2 x 2 pixels do not overflow: uint16 for 8 bit images, float32 for others."""
    return np.dtype(np.uint16 if array.dtype == np.uint8 else np.float32)


def halve(array: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 pixels; an odd last row or column is left out."""
    h, w = array.shape[0] // 2 * 2, array.shape[1] // 2 * 2
    out = np.empty((h // 2, w // 2), wide(array))
    library = kernels()
    if library is not None and array.dtype in TYPES and array.flags.c_contiguous:
        _declared(library).helmstar_halve(address(array), TYPES[array.dtype], *array.shape, address(out))
        return out
    for i in range(0, h, 2 * _BAND):
        a = array[i : min(i + 2 * _BAND, h), :w]
        rows = np.add(a[::2], a[1::2], dtype=out.dtype)
        np.add(rows[:, ::2], rows[:, 1::2], out=out[i // 2 : i // 2 + len(rows)])
    return out


def filtered(array: np.ndarray, out: np.dtype) -> np.ndarray:
    """[1 2 1] x [1 2 1] of an array (h, w): (h - 2, w), the sum of weights is 16. The last two columns mean nothing.

    Rows run on into each other: sums along one long line take half the time of sums along each row.
    """
    h, w = array.shape
    result = np.empty((h - 2, w), out)
    one, two = np.empty((min(_BAND, h) + 2, w), out), np.empty((min(_BAND, h) + 2, w), out)
    for top in range(0, h - 2, _BAND):
        n = min(_BAND, h - 2 - top)
        one[: n + 2] = array[top : top + n + 2]
        np.add(one[: n + 1], one[1 : n + 2], out=two[: n + 1])
        np.add(two[:n], two[1 : n + 1], out=one[:n])
        line, other, into = one[:n].reshape(-1), two[:n].reshape(-1), result[top : top + n].reshape(-1)
        np.add(line[:-1], line[1:], out=other[:-1])
        np.add(other[:-2], other[1:-1], out=into[:-2])
    result[-1, -2:] = 0
    return result


def find_peaks(array: np.ndarray, level: int, threshold: float, quantum: float) -> Peaks:
    """Local maxima that stand more than `threshold` sigma above the sky, in one level of the pyramid.

    quantum: step of the numbers in a pixel of level 0, below which no noise is believed.
    """
    h, w = array.shape
    tile = TILES[level]
    stride = max(1, tile // PER_TILE)
    floor = quantum / np.sqrt(12.0) * 2**level * _NOISE
    library = kernels()
    if library is not None and array.dtype in TYPES and array.flags.c_contiguous:
        found = _find_compiled(_declared(library), array, tile, stride, threshold, floor)
        if found is not None:
            return found
    # Pixels of 16 bit overflow it; sums over 2 x 2 pixels of 8 bit do not.
    out = np.dtype(np.uint16 if array.dtype == np.uint8 or (level and array.dtype == np.uint16) else np.float32)
    f = filtered(array, out)
    mesh = mesh_of(f[::stride, : w - 2 : stride], (h - 2, w - 2), tile, floor)
    lower, rows = mesh.least(threshold)
    if out == np.uint16:  # one type on both sides is compared many pixels at a time
        lower = np.clip(np.floor(lower), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    high = np.empty((h - 2, w), bool)
    high[:, 0], high[:, w - 3 :], high[0], high[h - 3] = False, False, False, False
    for k in range(len(lower)):
        band = slice(max(int(rows[k]), 1), min(int(rows[k + 1]), h - 3))
        np.greater(f[band, 1 : w - 3], lower[k, 1:-1], out=high[band, 1 : w - 3])
    place, flat = np.flatnonzero(high), f.reshape(-1)
    value = flat.take(place)
    for step in (1, w - 1, w, w + 1):  # a plateau has one maximum: its last pixel
        keep = np.flatnonzero((value >= flat.take(place - step)) & (value > flat.take(place + step)))
        place, value = place.take(keep), value.take(keep)
    y, x = np.divmod(place, w)
    sky, noise = mesh.at(y, x)
    excess = value.astype(np.float32) - sky
    keep = np.flatnonzero(excess > np.float32(threshold) * noise)
    return Peaks(x[keep] + 1, y[keep] + 1, excess[keep], noise[keep])


def _find_compiled(
    library: Any, array: np.ndarray, tile: int, stride: int, threshold: float, floor: float
) -> Peaks | None:
    """The same by pyramid.c; None for what it does not take."""
    h, w = array.shape
    g = grid((h - 2, w - 2), (-(-(h - 2) // stride), -(-(w - 2) // stride)), tile)
    rows, columns = np.multiply(g.rows, stride), np.multiply(g.columns, stride)
    values = np.empty((len(rows), len(columns)), np.float32)
    image = address(array), TYPES[array.dtype], h, w
    if library.helmstar_filtered_at(*image, address(rows), len(rows), address(columns), len(columns), address(values)):
        return None
    mesh = mesh_from(values, g, floor)
    bands, work, room = mesh.bands, np.empty((9, w), np.float32), _ROOM
    while True:
        places, light = np.empty((2, room), int), np.empty((2, room), np.float32)
        found = library.helmstar_peaks(
            *image, address(mesh.sky), address(mesh.noise), *mesh.sky.shape, address(bands), threshold,
            address(work), room, *(address(a) for a in (*places, *light)),
        )  # fmt: skip
        if found <= room:
            return Peaks(places[0, :found], places[1, :found], light[0, :found], light[1, :found])
        room = found


@cache
def _declared(library: Any) -> Any:
    """The library with the types of what is called here."""
    image = [c_void_p, c_int, c_int64, c_int64]
    library.helmstar_halve.argtypes = [*image, c_void_p]
    library.helmstar_filtered_at.argtypes = [*image, c_void_p, c_int64, c_void_p, c_int64, c_void_p]
    library.helmstar_peaks.argtypes = [
        *image,
        c_void_p,
        c_void_p,
        c_int64,
        c_int64,
        c_void_p,
        c_float,
        c_void_p,
        c_int64,
    ] + [c_void_p] * 4
    library.helmstar_peaks.restype = c_int64
    return library


__all__ = ["TILES", "WEIGHT", "Peaks", "filtered", "find_peaks", "halve", "wide"]
