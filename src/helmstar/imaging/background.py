"""The sky and its noise on a mesh of tiles, in units of a filtered image, from a sample of its pixels.

Median and upper quantiles of each tile, smoothed by the median of 3 x 3 tiles so that no star or planet lifts its own
threshold, and interpolated bilinearly. The noise is what the upper side of the distribution shows: a sensor with
thousands of hot pixels, or one whose zero hides the lower half, then has the noise that makes false stars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        height, width = self.shape
        lines = between_columns(self.sky + np.float32(sigmas) * self.noise, width, np.arange(width))
        # Between the middles of two rows of tiles nothing lies below both of them.
        n = len(lines)
        rows = np.ceil((np.arange(n) + 0.5) * (height / n) - 0.5).astype(int)
        lower = np.concatenate([lines[:1], np.minimum(lines[1:], lines[:-1]), lines[-1:]])
        return lower, np.concatenate([[0], rows, [height]])

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
    tile, part = _place(x, width, mesh.shape[1])
    steps = np.diff(mesh, axis=1, append=mesh[:, -1:])
    out = steps.take(tile, axis=1)
    out *= part
    out += mesh.take(tile, axis=1)
    return out


def mesh_of(sample: np.ndarray, shape: tuple[int, int], tile: int, floor: float) -> Mesh:
    """The mesh of an image of that shape from a regular sample of it (any strides), tiles of about `tile` pixels.

    floor: the noise of rounding to whole numbers. An image of nearly nothing but zeros shows less, and then a third of it holds.
    """
    tiles = [max(1, round(n / tile)) for n in shape]
    picks = []
    for n, s in zip(tiles, sample.shape):
        picks.append(np.minimum((np.arange(n * PER_TILE) + 0.5) * (s / (n * PER_TILE)), s - 1).astype(int))
    values = sample.take(picks[0], axis=0).take(picks[1], axis=1).astype(np.float32)
    count = PER_TILE**2
    sky = _over_neighbours(np.sort(_by_tile(values, tiles), axis=-1)[..., count // 2])
    at = [(p + 0.5) * (size / s) - 0.5 for p, size, s in zip(picks, shape, sample.shape)]
    smooth = between(sky, shape, *at)
    rest = np.sort(_by_tile(values - smooth, tiles), axis=-1)
    middle = rest[..., count // 2]
    spread = [(rest[..., int(q * count)] - middle) / k for q, k in _QUANTILES]
    # Where sky and noise round to zero, one count in a thousand pixels is rare and tells: the spread cannot see that.
    # A tile has its largest few in it; no tile decides alone.
    above = rest.size - int(0.999 * rest.size)
    tail = rest[..., -_TAIL:].ravel()
    rare = np.partition(tail, tail.size - above)[tail.size - above] / 3.09
    noise = np.maximum(_over_neighbours(np.maximum(*spread)), np.clip(rare, 0.35 * floor, floor))
    return Mesh(sky=sky, noise=noise.astype(np.float32), shape=shape)


def _by_tile(values: np.ndarray, tiles: list[int]) -> np.ndarray:
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


__all__ = ["PER_TILE", "Mesh", "between", "between_columns", "mesh_of"]
