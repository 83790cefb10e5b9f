"""Triangle meshes from files: Wavefront OBJ, and the plain tables in which PDS holds shape models (PLT, TAB).

Three forms of table are read. Lines that begin with v and f, as OBJ. Counts and numbered rows: the number of vertices (and, on the
same line or before the faces, that of faces), rows `i x y z`, rows `i a b c` with vertices counted from 1 (plate models). Rows
of latitude, longitude (deg) and radius on a regular grid.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import DataError
from .shape import Mesh

_REMEDY = "give an OBJ file, or a PLT or TAB table of vertices and plates"
MAX_BYTES = 1 << 29


def read_mesh(path: Path | str, unit_m: float = 1000.0) -> Mesh:
    """A mesh; unit_m: the file's unit of length (km, as PDS has it, is 1000). Faces are turned so that they look outwards.

    Raises DataError, naming file, line and remedy, for what holds no closed body.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"{path}: has more than {MAX_BYTES >> 20} MiB; give a coarser model")
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({e.strerror or e}); {_REMEDY}") from None
    rows = [(i, t.split()) for i, t in enumerate(lines, 1) if t.strip() and not t.lstrip().startswith(("#", "//"))]
    if not rows:
        raise DataError(f"{path}: is empty; {_REMEDY}")
    words = {cells[0] for _, cells in rows[:2000]}
    if words & {"v", "V"}:
        vertices, faces = _obj(path, rows)
    else:
        vertices, faces = _table(path, rows)
    try:
        mesh = Mesh(np.array(vertices) * unit_m, np.array(faces))
    except ValueError as e:
        raise DataError(f"{path}: {e}; {_REMEDY}") from None
    if abs(mesh.volume) <= 1e-9 * mesh.reach**3:
        raise DataError(f"{path}: its faces enclose no volume; {_REMEDY}")
    return mesh if mesh.volume > 0.0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


Rows = list[tuple[int, list[str]]]


def _number(path: Path, line: int, text: str) -> float:
    try:
        return float(text.replace("D", "E").replace("d", "e").rstrip(","))
    except ValueError:
        raise DataError(f"{path}, line {line}: {text[:30]!r} is no number; {_REMEDY}") from None


def _whole(path: Path, line: int, text: str) -> int:
    value = _number(path, line, text)
    if value != int(value):
        raise DataError(f"{path}, line {line}: {text[:30]!r} is no whole number; {_REMEDY}")
    return int(value)


def _obj(path: Path, rows: Rows) -> tuple[list[list[float]], list[list[int]]]:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for line, cells in rows:
        kind = cells[0].lower()
        if kind == "v":
            if len(cells) < 4:
                raise DataError(f"{path}, line {line}: a vertex needs three numbers; {_REMEDY}")
            vertices.append([_number(path, line, c) for c in cells[1:4]])
        elif kind == "f":
            names = [_whole(path, line, c.split("/")[0]) for c in cells[1:]]
            corner = [n - 1 if n > 0 else len(vertices) + n for n in names]
            if len(corner) < 3 or min(corner) < 0:
                raise DataError(f"{path}, line {line}: a face needs three vertices counted from 1; {_REMEDY}")
            faces += [[corner[0], b, c] for b, c in pairwise(corner[1:])]
    if not faces:
        raise DataError(f"{path}: has vertices but no faces; {_REMEDY}")
    return vertices, faces


def _table(path: Path, rows: Rows) -> tuple[list[list[float]], list[list[int]]]:
    line, first = rows[0]
    if len(first) == 3 and all(len(cells) == 3 for _, cells in rows[:50]):
        return _grid(path, rows)
    if len(first) > 2:
        raise DataError(f"{path}, line {line}: begins neither with a number of vertices nor with v; {_REMEDY}")
    count = _whole(path, line, first[0])
    plates = _whole(path, line, first[1]) if len(first) == 2 else None
    body = rows[1:]
    if count < 4 or len(body) < count:
        raise DataError(f"{path}, line {line}: says {count} vertices, but {len(body)} lines follow; is it cut off?")
    vertices = [_last_three(path, *row) for row in body[:count]]
    rest = body[count:]
    if plates is None:
        if not rest or len(rest[0][1]) != 1:
            raise DataError(f"{path}: no number of faces stands after its {count} vertices; {_REMEDY}")
        plates, rest = _whole(path, rest[0][0], rest[0][1][0]), rest[1:]
    if len(rest) < plates:
        raise DataError(f"{path}: says {plates} faces, but {len(rest)} lines follow; is it cut off?")
    faces = []
    for row in rest[:plates]:
        names = _last_three(path, *row)
        if any(n != int(n) or n < 1 or n > count for n in names):
            raise DataError(f"{path}, line {row[0]}: a face names vertices 1 to {count}, not {names}; {_REMEDY}")
        faces.append([int(n) - 1 for n in names])
    return vertices, faces


def _last_three(path: Path, line: int, cells: list[str]) -> list[float]:
    if len(cells) not in (3, 4):
        raise DataError(
            f"{path}, line {line}: has {len(cells)} numbers, must have 3, or 4 with its own first; {_REMEDY}"
        )
    return [_number(path, line, c) for c in cells[-3:]]


def _grid(path: Path, rows: Rows) -> tuple[list[list[float]], list[list[int]]]:
    """Latitude, longitude, radius on a regular grid to vertices and faces; the poles are one vertex each."""
    values = np.array([[_number(path, line, c) for c in cells[:3]] for line, cells in rows])
    a, b = values[:, 0], values[:, 1]
    if np.abs(a).max() > 90.001:  # longitude stands first
        a, b = b, a
    if np.abs(a).max() > 90.001 or (values[:, 2] <= 0.0).any():
        raise DataError(f"{path}: its rows are no latitude, longitude (deg) and radius; {_REMEDY}")
    east = np.round(np.mod(b, 360.0), 6)
    latitudes, longitudes = np.unique(np.round(a, 6)), np.unique(east)
    n, m = len(latitudes), len(longitudes)
    radius = np.full((n, m), np.nan)
    radius[np.searchsorted(latitudes, np.round(a, 6)), np.searchsorted(longitudes, east)] = values[:, 2]
    poles = latitudes[0] <= -89.999, latitudes[-1] >= 89.999
    if n < 3 or m < 3 or not all(poles):
        raise DataError(f"{path}: its grid of latitude and longitude must reach both poles; {_REMEDY}")
    radius[0], radius[-1] = np.nanmean(radius[0]), np.nanmean(radius[-1])
    if not np.isfinite(radius).all():
        raise DataError(f"{path}: its grid of {n} latitudes and {m} longitudes has holes; {_REMEDY}")
    lat, lon = np.radians(latitudes[1:-1])[:, None], np.radians(longitudes)[None, :]
    inner = radius[1:-1]
    xyz = np.stack([inner * np.cos(lat) * np.cos(lon), inner * np.cos(lat) * np.sin(lon), inner * np.sin(lat)], -1)
    vertices = np.concatenate([xyz.reshape(-1, 3), [[0, 0, -radius[0, 0]], [0, 0, radius[-1, 0]]]])
    at = np.arange((n - 2) * m).reshape(n - 2, m)
    right = np.roll(at, -1, axis=1)
    south, north = len(vertices) - 2, len(vertices) - 1
    quads = np.stack([at[:-1], right[:-1], right[1:], at[1:]], -1).reshape(-1, 4)
    faces = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    faces += [np.stack([right[0], at[0], np.full(m, south)], -1), np.stack([at[-1], right[-1], np.full(m, north)], -1)]
    return vertices.tolist(), np.concatenate(faces).tolist()


__all__ = ["read_mesh"]
