"""The sky and its noise on a mesh of tiles, in units of a filtered image, from a sample of its pixels.

Median and upper quantiles of each tile, smoothed by the median of 3 x 3 tiles so that no star or planet lifts its own
threshold, and interpolated bilinearly. The noise is what the upper side of the distribution shows: a sensor with
thousands of hot pixels, or one whose zero hides the lower half, then has the noise that makes false stars.
"""

from __future__ import annotations

from ctypes import c_int, c_void_p
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np

from ..native import address, kernels

PER_TILE = 12
"""Samples along the side of a tile."""
_TAIL = 24  # samples of a tile that may count among the rarest
_QUANTILES = ((0.8413, 1.0), (0.9332, 1.5))  # of a normal distribution, and how many sigma they lie above the median


@dataclass(frozen=True)
class Mesh:
    """sky, noise: (tile rows, tile columns), the median and one sigma, of an image of that shape (height, width)."""

    sky: np.ndarray
    noise: np.ndarray
    shape: tuple[int, int]

    def least(self, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds (bands, width) of sky plus so many sigma in bands of rows, and where these begin and end (bands + 1,)."""
        width = self.shape[1]
        lines = between_columns(self.sky + np.float32(sigmas) * self.noise, width, np.arange(width))
        lower = np.concatenate([lines[:1], np.minimum(lines[1:], lines[:-1]), lines[-1:]])
        return lower, self.bands

    @property
    def bands(self) -> np.ndarray:
        """Rows (tile rows + 2,) where bands begin and end: at the middles of the tiles, between which nothing lies below both."""
        height, n = self.shape[0], len(self.sky)
        rows = np.ceil((np.arange(n) + 0.5) * (height / n) - 0.5).astype(int)
        return np.concatenate([[0], rows, [height]])

    def at(self, y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sky and noise (n,) at rows and columns (n,)."""
        (i, a), (j, b) = (_place(p, size, n) for p, size, n in zip((y, x), self.shape, self.sky.shape))
        below, beside = np.minimum(i + 1, self.sky.shape[0] - 1), np.minimum(j + 1, self.sky.shape[1] - 1)
        both = []
        for m in (self.sky, self.noise):
            left, right = m[i, j] + a * (m[below, j] - m[i, j]), m[i, beside] + a * (m[below, beside] - m[i, beside])
            both.append(left + b * (right - left))
        return both[0], both[1]


def _place(at: np.ndarray, size: int, tiles: int) -> tuple[np.ndarray, np.ndarray]:
    """The tile before each position and the fraction of the way to the next one's middle; flat beyond the outer middles."""
    place = np.clip((at + 0.5) * (tiles / size) - 0.5, 0.0, tiles - 1.0)
    tile = place.astype(np.intp)
    return tile, (place - tile).astype(np.float32)


def between(mesh: np.ndarray, shape: tuple[int, int], y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A mesh interpolated bilinearly on the grid of rows y and columns x: (rows, columns), float32.

    Not by matrix products, whose threads cost more than the work when a processor is shared.
    """
    return between_columns(between_columns(mesh.T, shape[0], y).T, shape[1], x)


def between_columns(mesh: np.ndarray, width: int, x: np.ndarray) -> np.ndarray:
    """Rows of a mesh interpolated linearly at columns x of an image of that width: (rows, columns), float32."""
    return _along(mesh, *_place(x, width, mesh.shape[1]))


def _along(mesh: np.ndarray, tile: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Rows of a mesh between columns `tile` and the next ones, that part of the way."""
    steps = np.diff(mesh, axis=1, append=mesh[:, -1:])
    out = steps.take(tile, axis=1)
    out *= part
    out += mesh.take(tile, axis=1)
    return out


def mesh_of(sample: np.ndarray, shape: tuple[int, int], tile: int, floor: float) -> Mesh:
    """The mesh of an image of that shape from a regular sample of it (any strides), tiles of about `tile` pixels.

    floor: the noise of rounding to whole numbers. An image of nearly nothing but zeros shows less, and then a third of it holds.
    """
    g = grid(shape, sample.shape, tile)
    return mesh_from(sample.take(g.rows, axis=0).take(g.columns, axis=1).astype(np.float32), g, floor)


@dataclass(frozen=True)
class Grid:
    """Where an image of that shape is sampled: rows and columns of its regular sample, and where these are in the image's mesh."""

    shape: tuple[int, int]
    tiles: tuple[int, int]
    rows: np.ndarray
    columns: np.ndarray
    places: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@lru_cache(16)
def grid(shape: tuple[int, int], sample: tuple[int, int], tile: int) -> Grid:
    """The grid of an image of that shape by a sample of that shape, tiles of about `tile` pixels."""
    tiles = (max(1, round(shape[0] / tile)), max(1, round(shape[1] / tile)))
    picks, places = [], []
    for n, s, size in zip(tiles, sample, shape):
        p = np.minimum((np.arange(n * PER_TILE) + 0.5) * (s / (n * PER_TILE)), s - 1).astype(int)
        picks.append(p)
        places.append(_place((p + 0.5) * (size / s) - 0.5, size, n))
    return Grid(shape, tiles, picks[0], picks[1], (places[0], places[1]))


def mesh_from(values: np.ndarray, g: Grid, floor: float) -> Mesh:
    """The mesh of a grid's samples (rows, columns), float32 and contiguous; they are overwritten."""
    library = kernels()
    sky, spread, tail = _quantiles(values, g) if library is None else _quantiles_compiled(_declared(library), values, g)
    # Where sky and noise round to zero, one count in a thousand pixels is rare and tells: the spread cannot see that.
    # A tile has its largest few in it; no tile decides alone.
    above = values.size - int(0.999 * values.size)
    tail = tail.ravel()
    rare = np.partition(tail, tail.size - above)[tail.size - above] / 3.09
    noise = np.maximum(spread, np.clip(rare, 0.35 * floor, floor))
    return Mesh(sky=sky, noise=noise.astype(np.float32), shape=g.shape)


def _quantiles(values: np.ndarray, g: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sky and spread of each tile, smoothed, and the largest samples of each above the smooth sky."""
    count = PER_TILE**2
    sky = _over_neighbours(np.sort(_by_tile(values, g.tiles), axis=-1)[..., count // 2])
    (i, a), (j, b) = g.places
    smooth = _along(_along(sky.T, i, a).T, j, b)
    rest = np.sort(_by_tile(values - smooth, g.tiles), axis=-1)
    middle = rest[..., count // 2]
    spread = [(rest[..., int(q * count)] - middle) / k for q, k in _QUANTILES]
    return sky, _over_neighbours(np.maximum(*spread)), rest[..., -_TAIL:]


def _quantiles_compiled(library: Any, values: np.ndarray, g: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same by background.c."""
    rows, columns = g.tiles
    (i, a), (j, b) = g.places
    sky, spread = np.empty((2, rows, columns), np.float32)
    tail, work = np.empty((rows, columns, _TAIL), np.float32), np.empty((2 * rows + 1) * columns, np.float32)
    arrays = (values, i, a, j, b, _AT, _SIGMAS, work, sky, spread, tail)
    at = [address(v) for v in arrays]
    library.helmstar_mesh(at[0], rows, columns, *at[1:])
    return sky, spread, tail


_AT = np.array([PER_TILE**2 // 2, *(int(q * PER_TILE**2) for q, _ in _QUANTILES)], np.int32)
_SIGMAS = np.array([k for _, k in _QUANTILES], np.float32)


@cache
def _declared(library: Any) -> Any:
    """The library with the types of what is called here."""
    library.helmstar_mesh.argtypes = [c_void_p, c_int, c_int] + [c_void_p] * 10
    library.helmstar_mesh.restype = None
    return library


def _by_tile(values: np.ndarray, tiles: tuple[int, int]) -> np.ndarray:
    """(tile rows, tile columns, samples of the tile)."""
    v = values.reshape(tiles[0], PER_TILE, tiles[1], PER_TILE)
    return v.transpose(0, 2, 1, 3).reshape(tiles[0], tiles[1], PER_TILE**2)


def _over_neighbours(mesh: np.ndarray) -> np.ndarray:
    """Median of 3 x 3 tiles, edges repeated."""
    h, w = mesh.shape
    p = mesh[np.clip(np.arange(-1, h + 1), 0, h - 1)][:, np.clip(np.arange(-1, w + 1), 0, w - 1)]
    nine = np.stack([p[i : i + h, j : j + w] for i in range(3) for j in range(3)])
    nine.sort(axis=0)
    return nine[4]


__all__ = ["PER_TILE", "Grid", "Mesh", "between", "between_columns", "grid", "mesh_from", "mesh_of"]
