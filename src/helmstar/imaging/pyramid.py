"""Places that may be stars: local maxima above the noise in an image filtered at several scales.

Each level is the one before, summed over 2 x 2 pixels, and is filtered by [1 2 1] both ways: a Gaussian of sigma 0.8, 1.5 and 3
pixels for levels 0, 1 and 2. That is sharp optics, soft optics, and smeared or badly focused stars. The work is done in bands
of rows that stay in the processor's cache, in whole numbers where these are 8 bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .background import PER_TILE, mesh_of

TILES = (64, 48, 32)
"""Side of a tile of the sky's mesh at each level, in its own pixels."""
_BAND = 128
_ROWS = 8  # share one threshold
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
    """The type in which sums over levels and filters of 8 bit images do not overflow; float32 for others."""
    return np.dtype(np.uint16 if array.dtype == np.uint8 else np.float32)


def halve(array: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 pixels; an odd last row or column is left out."""
    h, w = array.shape[0] // 2 * 2, array.shape[1] // 2 * 2
    out = np.empty((h // 2, w // 2), wide(array) if array.dtype == np.uint8 else array.dtype)
    for i in range(0, h, 2 * _BAND):
        a = array[i : min(i + 2 * _BAND, h), :w]
        rows = np.add(a[::2], a[1::2], dtype=out.dtype)
        np.add(rows[:, ::2], rows[:, 1::2], out=out[i // 2 : i // 2 + len(rows)])
    return out


def filtered(array: np.ndarray, out: np.dtype) -> np.ndarray:
    """[1 2 1] x [1 2 1] of an array (h, w): (h - 2, w - 2), the sum of weights is 16."""
    a = array if array.dtype == out else array.astype(out)
    a = a[:-1] + a[1:]
    a = a[:-1] + a[1:]
    a = a[:, :-1] + a[:, 1:]
    return a[:, :-1] + a[:, 1:]


def _sampled(array: np.ndarray, stride: int, out: np.dtype) -> np.ndarray:
    """The filtered image at every stride-th pixel both ways, without filtering the others."""
    total: np.ndarray | None = None
    h, w = array.shape
    for dy, wy in ((0, 1), (1, 2), (2, 1)):
        rows = array[dy : h - 2 + dy : stride]
        line = rows[:, 0 : w - 2 : stride].astype(out) + rows[:, 2:w:stride]
        line += 2 * rows[:, 1 : w - 1 : stride].astype(out)
        total = line * out.type(wy) if total is None else total + line * out.type(wy)
    assert total is not None
    return total


def find_peaks(array: np.ndarray, level: int, threshold: float, quantum: float) -> Peaks:
    """Local maxima that stand more than `threshold` sigma above the sky, in one level of the pyramid.

    quantum: step of the numbers in a pixel of level 0, below which no noise is believed.
    """
    h, w = array.shape
    out = np.dtype(np.uint16 if array.dtype in (np.uint8, np.uint16) else np.float32)
    tile = TILES[level]
    stride = max(1, tile // PER_TILE)
    floor = quantum / np.sqrt(12.0) * 2**level * _NOISE
    mesh = mesh_of(_sampled(array, stride, out), (h - 2, w - 2), tile, floor)
    limits = mesh.limit(threshold, _ROWS)
    if out == np.uint16:  # one type on both sides is compared many pixels at a time
        limits = np.clip(np.floor(limits), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for top in range(0, h - 2, _BAND):  # rows of the filtered image, with one more on each side for their neighbours
        bottom = min(top + _BAND, h - 2)
        f = filtered(array[max(top - 1, 0) : min(bottom + 3, h)], out)
        first = top - max(top - 1, 0)
        inner = f[first : first + bottom - top]
        high = np.empty(inner.shape, bool)
        whole = len(inner) // _ROWS * _ROWS
        blocks = limits[top // _ROWS :]
        np.greater(
            inner[:whole].reshape(-1, _ROWS, w - 2),
            blocks[: whole // _ROWS, None],
            out=high[:whole].reshape(-1, _ROWS, w - 2),
        )
        if whole < len(inner):
            np.greater(inner[whole:], blocks[whole // _ROWS], out=high[whole:])
        high[:, 0] = high[:, -1] = False
        high[: 1 - first], high[len(high) - (bottom == h - 2) :] = False, False
        at = np.flatnonzero(high)
        if not at.size:
            continue
        y, x = np.divmod(at, w - 2)
        place = at + first * (w - 2)
        flat = f.ravel()
        value = flat[place]
        keep = np.ones(len(place), bool)
        for step in (1, w - 3, w - 2, w - 1):  # a plateau has one maximum: its last pixel
            keep &= (value >= flat[place - step]) & (value > flat[place + step])
        found.append((x[keep], y[keep] + top, value[keep].astype(np.float32)))
    if not found:
        nothing = np.zeros(0)
        return Peaks(nothing.astype(int), nothing.astype(int), nothing, nothing)
    x, y, value = (np.concatenate(c) for c in zip(*found))
    sky, noise = mesh.at(y, x)
    return Peaks(x + 1, y + 1, value - sky, noise)


__all__ = ["TILES", "WEIGHT", "Peaks", "filtered", "find_peaks", "halve", "wide"]
