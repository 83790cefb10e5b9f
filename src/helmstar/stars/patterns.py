"""Tables for the identification: pairs of catalogue stars by separation, and a map of the sky that says which star is where.

A camera sees the brightest stars of its field, so what belongs into a table is decided by brightness rank within a field, not
by one magnitude for the whole sky: a level of the ladder holds for one field of view the n brightest stars of every
field-sized patch. Tables are built on demand and kept under the user's cache folder (`HELMSTAR_CACHE_DIR` moves it, an empty
string switches it off), with a version and a checksum; a file that is stale or damaged is built again.
"""

from __future__ import annotations

import ctypes
import math
import os
import tempfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..native import address, kernels
from .catalog import Catalog

VERSION = 1
LADDER = tuple(float(np.radians(4.0 * 2.0 ** (0.5 * i))) for i in range(8))
"""Fields of view (rad) that have tables, a factor sqrt(2) apart: 4 to 45 deg."""
RUNG = 2.0**0.25
"""A field within this factor of a level's is served by it."""
SHORTEST, LONGEST = 0.10, 0.85
"""Separations of a level's pairs, over its field."""
BRIGHTEST, BRIGHT, FAINT = 6, 15, 45
"""Stars per field in the pair tables, tried in this order."""
DEEP = 160
"""Stars per field that verification sees."""
EMPTY = 255


@dataclass(frozen=True)
class Pairs:
    """first, second: (m,) catalogue indices, the brighter star first; angle: (m,) rad, increasing, float32."""

    first: np.ndarray
    second: np.ndarray
    angle: np.ndarray


@dataclass(frozen=True)
class SkyMap:
    """Magnitudes of the stars near each cell of two diamonds, z >= 0 and z < 0 (u = x / s, v = y / s, s the 1-norm).

    cells: (2 side side,) uint8, EMPTY or (V + 2) * 20, the brightest of several.
    """

    side: int
    cells: np.ndarray

    @cached_property
    def coarse(self) -> np.ndarray:
        """(bytes,) uint8: whether there is a star in each square of 4 x 4 cells, the first in the lowest bit: what fits a cache."""
        wide = -(-self.side // 4)
        full = np.zeros((2, 4 * wide, 4 * wide), dtype=bool)
        full[:, : self.side, : self.side] = self.cells.reshape(2, self.side, self.side) != EMPTY
        full = full[:, 0::4] | full[:, 1::4] | full[:, 2::4] | full[:, 3::4]
        full = full[:, :, 0::4] | full[:, :, 1::4] | full[:, :, 2::4] | full[:, :, 3::4]
        return np.append(np.packbits(full, bitorder="little"), np.uint8(0))

    def index(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Cell of directions of any length."""
        half = 0.5 * self.side
        scale = np.abs(x)
        scale += np.abs(y)
        scale += np.abs(z)
        np.divide(half * (1.0 - 1e-6), scale, out=scale)
        row = (x * scale + half).astype(np.int32)
        row *= self.side
        row += (y * scale + half).astype(np.int32)
        row += (z < 0.0).astype(np.int32) * (self.side * self.side)
        return row


def build_sky_map(directions: np.ndarray, magnitude: np.ndarray, tolerance: float, side: int) -> SkyMap:
    """Paint every star, the brightest last, as a disc of radius `tolerance` (rad) and half a cell."""
    cell = 2.0 / side
    radius = tolerance + 0.5 * cell
    n = int(np.ceil(radius / (0.9 * cell)))
    g = np.arange(-n, n + 1) * (radius / n)
    dx, dy = (a.ravel() for a in np.meshgrid(g, g))
    keep = dx * dx + dy * dy <= radius * radius * 1.0001
    offsets = np.stack([dx[keep], dy[keep]])
    axis = np.where(np.abs(directions[:, 2:]) < 0.7, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    e1 = np.cross(axis, directions)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(directions, e1)
    m = SkyMap(side, np.full(2 * side * side, EMPTY, dtype=np.uint8))
    value = np.clip(np.round((magnitude + 2.0) * 20.0), 0, EMPTY - 1).astype(np.uint8)
    step = 20000
    for end in range(len(directions), 0, -step):
        s = slice(max(0, end - step), end)
        v = [directions[s, i, None] + e1[s, i, None] * offsets[0] + e2[s, i, None] * offsets[1] for i in range(3)]
        index = m.index(v[0], v[1], v[2])[::-1]
        m.cells[index.ravel()] = np.repeat(value[s][::-1], offsets.shape[1])
    return m


def spiral(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the sphere."""
    i = np.arange(count) + 0.5
    z, a = 1.0 - 2.0 * i / count, np.pi * (1.0 + 5.0**0.5) * i
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)


def brightest_per_field(directions: np.ndarray, n: int, fov: float) -> np.ndarray:
    """Indices of the stars (sorted by brightness) that are among about the n brightest of a circle of area fov^2."""
    from scipy.spatial import cKDTree  # scipy has no stub for it  # pyright: ignore[reportAttributeAccessIssue]

    # Deep enough for the emptiest fields, which have a third of the mean density.
    top = min(len(directions), int(3.5 * n * 4.0 * np.pi / fov**2) + 200)
    tree = cKDTree(directions[:top])
    centres = spiral(int(4.0 * np.pi / (0.5 * fov) ** 2) + 12)
    reach = 2.0 * np.sin(0.5 * min(fov / np.sqrt(np.pi), np.pi))
    limit = np.full(len(centres), top)
    for i, ball in enumerate(tree.query_ball_point(centres, reach)):
        if len(ball) > n:
            limit[i] = np.partition(np.asarray(ball), n - 1)[n - 1]
    _, near = cKDTree(centres).query(directions[:top], k=3)
    return np.flatnonzero(np.arange(top) <= limit[near].max(axis=1))


def build_pairs(directions: np.ndarray, members: np.ndarray, fov: float) -> Pairs:
    """All pairs of `members` (catalogue indices) between SHORTEST and LONGEST of the field, by separation."""
    from scipy.spatial import cKDTree  # scipy has no stub for it  # pyright: ignore[reportAttributeAccessIssue]

    v = directions[members]
    pairs = cKDTree(v).query_pairs(2.0 * np.sin(0.5 * min(LONGEST * fov, 0.9 * np.pi)), output_type="ndarray")
    chord = np.linalg.norm(v[pairs[:, 0]] - v[pairs[:, 1]], axis=1)
    angle = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    keep = np.flatnonzero(angle >= SHORTEST * fov)
    keep = keep[np.argsort(angle[keep], kind="stable")]
    both = np.sort(members[pairs[keep]], axis=1).astype(np.int32)
    return Pairs(np.ascontiguousarray(both[:, 0]), np.ascontiguousarray(both[:, 1]), angle[keep].astype(np.float32))


def cache_folder() -> Path | None:
    """Where tables are kept, None where the cache is switched off."""
    folder = os.environ.get("HELMSTAR_CACHE_DIR")
    if folder is None:
        from platformdirs import user_cache_dir

        return Path(user_cache_dir("helmstar")) / "stars"
    return Path(folder) / "stars" if folder else None


def checksum(arrays: dict[str, np.ndarray]) -> int:
    """CRC-32 of the arrays' bytes, in the order of their names."""
    crc = 0
    for name in sorted(arrays):
        crc = zlib.crc32(np.ascontiguousarray(arrays[name]).tobytes(), zlib.crc32(name.encode(), crc))
    return crc


def kept(name: str, identity: int, build) -> dict[str, np.ndarray]:
    """Arrays from the cache, or built and put there. identity: what they were made from; another one makes them stale."""
    folder = cache_folder()
    path = None if folder is None else folder / f"{name}.npz"
    if path is not None:
        try:
            with np.load(path, allow_pickle=False) as f:
                arrays = {k: f[k] for k in f.files}
            label = arrays.pop("label")
            if list(label) == [VERSION, identity, checksum(arrays)]:
                return arrays
        except Exception:  # absent, cut short, of another program: any of these is built again
            pass
    arrays = build()
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as f:
                label = np.array([VERSION, identity, checksum(arrays)], dtype=np.int64)
                np.savez(f, label=label, **arrays)  # its stub knows no names of arrays  # pyright: ignore[reportArgumentType]
            os.replace(f.name, path)
        except OSError:  # a read-only or full home must not stop a solution
            pass
    return arrays


class Level:
    """Tables for one field of view (rad). Pairs and maps are at J2000: what moves since is far below their tolerances."""

    def __init__(self, catalog: Catalog, directions: np.ndarray, fov: float, identity: int):
        self.catalog, self.directions, self.fov, self.identity = catalog, directions, fov, identity
        self.single = np.ascontiguousarray(directions.T, dtype=np.float32)
        self.brightness = catalog.magnitude.astype(np.float32)
        self.rows = np.ascontiguousarray(np.concatenate([self.single, self.brightness[None]]).T)
        self._pairs: dict[int, Pairs] = {}
        self._members: dict[int, np.ndarray] = {}
        self._maps: dict[tuple[int, int], SkyMap] = {}

    def members(self, n: int) -> np.ndarray:
        """Catalogue indices of the n brightest stars per field."""
        if n not in self._members:

            def build() -> dict[str, np.ndarray]:
                return {"members": brightest_per_field(self.directions, n, self.fov)}

            self._members[n] = kept(f"stars-{np.degrees(self.fov):.2f}-{n}", self.identity, build)["members"]
        return self._members[n]

    def pairs(self, n: int) -> Pairs:
        """Pairs of `members(n)`."""
        if n not in self._pairs:

            def build() -> dict[str, np.ndarray]:
                return vars(build_pairs(self.directions, self.members(n), self.fov))

            name = f"pairs-{np.degrees(self.fov):.2f}-{n}"
            self._pairs[n] = Pairs(**kept(name, self.identity, build))
        return self._pairs[n]

    def sky_map(self, n: int, tolerance: float) -> SkyMap:
        """A map of `members(n)` that finds stars within at least `tolerance` (rad), rounded up to a step of 1.4."""
        side = 3072 if self.fov > 0.13 else 4096
        step = max(0, int(np.ceil(np.log(tolerance * side) / np.log(1.4))))
        key = (n, step)
        if key not in self._maps:
            stars = self.members(n)
            reach = 1.4**step / side
            self._maps[key] = build_sky_map(self.directions[stars], self.catalog.magnitude[stars], reach, side)
        return self._maps[key]


class Window(NamedTuple):
    """What a pinhole at R (3, 3) sees with (X/Z, Y/Z) from low (2,) to high (2,)."""

    R: np.ndarray
    low: tuple[float, float]
    high: tuple[float, float]

    def shows(self, directions: np.ndarray) -> np.ndarray:
        """Which directions (n, 3) in N; bool (n,)."""
        v = directions @ self.R.T
        z = v[:, 2]
        u = v[:, :2] / np.maximum(z, 1e-3)[:, None]
        return (z > 1e-3) & (u >= self.low).all(axis=1) & (u <= self.high).all(axis=1)


class Sky:
    """The catalogue as one camera sees it: directions at a year and for an observer's velocity, and the tables.

    year: Julian year of the directions used for verification and attitude. velocity_c: (3,) barycentric velocity of the
    observer in N over the speed of light, for aberration; position_au: (3,) its barycentric position, for parallax; None for
    none.
    """

    def __init__(
        self,
        catalog: Catalog,
        year: float = 2000.0,
        velocity_c: np.ndarray | None = None,
        position_au: np.ndarray | None = None,
    ):
        self.catalog = catalog
        self.directions = aberrated(catalog.directions(year, position_au), velocity_c)
        self.magnitude = catalog.magnitude
        self._shared = _shared_tables(catalog)
        self._deep: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._whole: tuple[np.ndarray, np.ndarray] | None = None

    def level(self, i: int) -> Level:
        """Tables of LADDER[i]."""
        return self._shared.level(i)

    def near(self, i: int, centre: np.ndarray, radius: float, window: Window | None = None) -> np.ndarray:
        """Catalogue indices, brightest first, of level i's deep stars within `radius` (rad) of a direction (3,) and in a window."""
        return self._in_circle(*self.deep(i), centre, radius, window)

    def deep(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Catalogue indices (m,) of level i's deep stars by declination, and their directions (m, 3)."""
        if i not in self._deep:
            self._deep[i] = self._banded(self.level(i).members(DEEP))
        return self._deep[i]

    def around(self, centre: np.ndarray, radius: float, window: Window | None = None) -> np.ndarray:
        """As `near`, of all the catalogue's stars."""
        if self._whole is None:
            self._whole = self._banded(np.arange(len(self.directions)))
        return self._in_circle(*self._whole, centre, radius, window)

    def _banded(self, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Members by declination, and their directions. Importing scipy's trees would take the first solution 0.5 s."""
        if len(members) and not 0 <= members.min() <= members.max() < len(self.directions):
            raise ValueError("a table names stars that are not in the catalogue: it was made from another one")
        members = members[np.argsort(self.directions[members, 2], kind="stable")]
        return np.ascontiguousarray(members, dtype=np.int64), np.ascontiguousarray(
            self.directions[members], dtype=float
        )

    def _in_circle(
        self, members: np.ndarray, directions: np.ndarray, centre: np.ndarray, radius: float, window: Window | None
    ) -> np.ndarray:
        """Of the members, sorted by declination as their directions, by sky.c where it is compiled."""
        library = kernels()
        if library is not None:
            found = np.empty(len(members), dtype=np.int64)
            count = library.helmstar_in_circle(
                ctypes.c_int64(len(members)), ctypes.c_int64(len(self.directions)), ctypes.c_void_p(address(members)),
                ctypes.c_void_p(address(directions)), (ctypes.c_double * 3)(*centre), ctypes.c_double(radius),
                None if window is None else (ctypes.c_double * 13)(*window.R.ravel().tolist(), *window.low, *window.high),
                ctypes.c_void_p(address(found)),
            )  # fmt: skip
            if count < 0:
                raise MemoryError("no room for the stars of an image")
            return found[:count].copy()
        dec = math.asin(max(-1.0, min(1.0, float(centre[2]))))
        low, high = (math.sin(max(-0.5 * math.pi, min(0.5 * math.pi, dec + r))) for r in (-radius, radius))
        begin, end = directions[:, 2].searchsorted([low - 1e-12, high + 1e-12])
        members, directions = members[begin:end], directions[begin:end]
        inside = directions @ centre > math.cos(radius)
        if window is not None:
            inside &= window.shows(directions)
        return np.sort(members[inside])


def aberrated(directions: np.ndarray, velocity_c: np.ndarray | None) -> np.ndarray:
    """Apparent unit directions (n, 3) for an observer moving with velocity_c (3,) over the speed of light, exact."""
    if velocity_c is None:
        return directions
    beta = np.asarray(velocity_c, dtype=float)
    inverse_gamma = np.sqrt(1.0 - beta @ beta)
    along = directions @ beta
    moved = inverse_gamma * directions + (1.0 + along / (1.0 + inverse_gamma))[:, None] * beta
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


class _Shared:
    def __init__(self, catalog: Catalog):
        self.catalog = catalog

    @cached_property
    def directions(self) -> np.ndarray:
        return self.catalog.directions(2000.0)

    @cached_property
    def identity(self) -> int:
        return checksum(vars(self.catalog))

    @cached_property
    def levels(self) -> dict[int, Level]:
        return {}

    def level(self, i: int) -> Level:
        if i not in self.levels:
            self.levels[i] = Level(self.catalog, self.directions, LADDER[i], self.identity)
        return self.levels[i]


_tables: dict[int, _Shared] = {}


def _shared_tables(catalog: Catalog) -> _Shared:
    """One set of tables for each catalogue's content, however many cameras and epochs look at it."""
    key = checksum({"hip": catalog.hip, "magnitude": catalog.magnitude})
    if key not in _tables:
        _tables[key] = _Shared(catalog)
    return _tables[key]


__all__ = ["LADDER", "RUNG", "Level", "Pairs", "Sky", "SkyMap", "Window", "aberrated", "build_pairs", "build_sky_map"]
