"""Light of a triangle mesh: what a fine grid of rays sees nearest (z-buffer), lit where the Sun sees it too (shadow map).

One over the depth is linear over the image of a plane face, so each ray's nearest face is exact. A visible point lies in shadow
where the Sun's own z-buffer holds a face nearer to the Sun; whether that face lies above the point is then computed for the point
itself, so that the map's resolution moves a shadow's edge by a texel and does not speckle what is lit. Faces are flat: mu0 and mu
are those of their middles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..camera import Camera
from .phase import Nodes
from .photometry import Law
from .raycast import Grid, Shade
from .shape import Mesh

_CHUNK = 1_500_000
ACROSS = 900.0
"""Rays across the body in one direction, about, within 2 and 32 to a pixel."""
_NODES_ACROSS = 400.0
_MOST_TEXELS = 2000
_SMALL_FACE = 8.0  # texels: a face across fewer of them is lit or dark as four of its points are


def nearest(corners: np.ndarray, depth: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Index of the triangle with the least depth over the middle of each cell, -1 where there is none: (rows, columns).

    corners: (k, 3, 2) x, y in cells, cell (i, j) covering j..j+1, i..i+1. depth: (k, 3) at them, linear between.
    """
    best = np.full(rows * columns, np.inf)
    index = np.full(rows * columns, -1, np.int64)
    for face, row, first, number, z, dz in _spans(corners, depth, rows, columns):
        total = np.cumsum(number)
        start = 0
        while start < len(face):
            done = total[start - 1] if start else 0
            stop = max(int(np.searchsorted(total, done + _CHUNK)), start + 1)
            part = slice(start, stop)
            start = stop
            n = number[part]
            along = np.arange(int(n.sum())) - np.repeat(np.cumsum(n) - n, n)
            cell = along + np.repeat(row[part] * columns + first[part], n)
            at = np.repeat(z[part], n) + along * np.repeat(dz[part], n)
            np.minimum.at(best, cell, at)
            wins = at <= best[cell]
            index[cell[wins]] = np.repeat(face[part], n)[wins]
    return index.reshape(rows, columns)


def _spans(corners: np.ndarray, depth: np.ndarray, rows: int, columns: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows of cells that triangles cover, some triangles at a time: triangle, row, first column, number of columns (at least 1),
    depth over the first column and its change per column."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    low = np.ceil(np.clip(corners[..., 1].min(axis=1) - 0.5, 0, 1e6))
    high = np.floor(np.clip(corners[..., 1].max(axis=1) - 0.5, -1, rows - 1))
    det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    sound = (np.abs(det) > 1e-14) & np.isfinite(corners).all(axis=(1, 2))
    sound &= (corners[..., 0].max(axis=1) > 0.0) & (corners[..., 0].min(axis=1) < columns)
    height = np.where(sound, np.maximum(high - low + 1, 0), 0).astype(np.int64)
    use = np.flatnonzero(height)
    total = np.cumsum(height[use])
    start = 0
    while start < len(use):
        done = total[start - 1] if start else 0
        stop = max(int(np.searchsorted(total, done + _CHUNK)), start + 1)
        t = use[start:stop]
        start = stop
        n = height[t]
        k = np.repeat(t, n)
        row = np.arange(len(k)) - np.repeat(np.cumsum(n) - n - low[t].astype(np.int64), n)
        # Barycentric coordinates v of b and w of c: linear along the row; inside where v, w and 1 - v - w are not negative.
        A, B, C, inverse = a[k], b[k], c[k], 1.0 / det[k]
        y = row + 0.5 - A[:, 1]
        v_x, w_x = (C[:, 1] - A[:, 1]) * inverse, (A[:, 1] - B[:, 1]) * inverse
        v_0 = (-A[:, 0] * (C[:, 1] - A[:, 1]) - (C[:, 0] - A[:, 0]) * y) * inverse
        w_0 = ((B[:, 0] - A[:, 0]) * y + A[:, 0] * (B[:, 1] - A[:, 1])) * inverse
        left, right = np.full(len(k), 0.0), np.full(len(k), float(columns))
        for slope, value in ((v_x, v_0), (w_x, w_0), (-v_x - w_x, 1.0 - v_0 - w_0)):
            with np.errstate(divide="ignore", invalid="ignore"):
                x = -value / slope
            left = np.where(slope > 0.0, np.fmax(left, x), left)
            right = np.where(slope < 0.0, np.fmin(right, x), right)
            right = np.where((slope == 0.0) & (value < 0.0), -1.0, right)
        # A ray on the edge of two faces must meet one of them: rounding may not open a gap.
        first = np.maximum(np.ceil(left - 0.5 - 1e-9), 0.0).astype(np.int64)
        number = np.minimum(np.floor(right - 0.5 + 1e-9), columns - 1).astype(np.int64) - first + 1
        some = number > 0
        k, row, first, number = k[some], row[some], first[some], number[some]
        db, dc = depth[k, 1] - depth[k, 0], depth[k, 2] - depth[k, 0]
        dz = v_x[some] * db + w_x[some] * dc
        z = depth[k, 0] + v_0[some] * db + w_0[some] * dc + dz * (first + 0.5)
        yield k, row, first, number, z, dz


@dataclass(frozen=True)
class Seen:
    """What rays meet, arrays of n: cell of the grid of rays (flat index), mu0 (0 in shadow), mu, alpha."""

    cell: np.ndarray
    mu0: np.ndarray
    mu: np.ndarray
    alpha: np.ndarray


def see(camera: Camera, mesh: Mesh, r: np.ndarray, R: np.ndarray, sun: np.ndarray, grid: Grid) -> Seen:
    """One ray through the middle of each cell of the grid. Arguments as `render_body.checked` gives them."""
    points = r + mesh.vertices @ R
    k = grid.per_px
    px = (camera.pixels(points) - [grid.left, grid.top]) * k
    corners_C = points[mesh.faces]
    middle = corners_C.mean(axis=1)
    distance = np.linalg.norm(middle, axis=1)
    normal = mesh.normals @ R
    toward = -np.sum(normal * middle, axis=1) / distance
    front = np.flatnonzero(toward > 0.0)
    index = nearest(px[mesh.faces[front]], -1.0 / corners_C[front][..., 2], grid.rows, grid.columns)
    cell = np.flatnonzero(index >= 0)
    face = front[index.ravel()[cell]]
    mu0 = np.maximum(normal @ sun, 0.0)
    alpha = np.arccos(np.clip(-(middle @ sun) / distance, -1.0, 1.0))
    light = mu0[face]
    lit = np.flatnonzero(light > 0.0)
    if lit.size:
        texel = float(r[2]) / (camera.focal_px * k)
        shadows = SunMap(mesh, R @ sun, texel)
        shown = np.flatnonzero(np.bincount(face[lit], minlength=len(mesh.faces)))
        state = np.zeros(len(mesh.faces), np.int8)
        state[shown] = shadows.by_face(shown)
        light[state[face] == 1] = 0.0
        lit = lit[state[face[lit]] == -1]
        i, j = np.divmod(cell[lit], grid.columns)
        d = camera.directions(np.stack([grid.left + (j + 0.5) / k, grid.top + (i + 0.5) / k], -1))
        n = normal[face[lit]]
        hit = d * (np.sum(n * corners_C[face[lit], 0], axis=1) / np.minimum(np.sum(n * d, axis=1), -1e-12))[:, None]
        light[lit[shadows.shadowed((hit - r) @ R.T, face[lit])]] = 0.0
    return Seen(cell, light, np.maximum(toward[face], 0.0), alpha[face])


class SunMap:
    """What the Sun sees of a mesh: a z-buffer of texels of that size, m, along the Sun."""

    def __init__(self, mesh: Mesh, sun_T: np.ndarray, texel: float):
        self.mesh, self.sun = mesh, sun_T
        self.texel = max(texel, 2.0 * mesh.reach / _MOST_TEXELS)
        e1 = np.cross(sun_T, np.eye(3)[int(np.argmin(np.abs(sun_T)))])
        e1 /= np.linalg.norm(e1)
        self.E = np.stack([e1, np.cross(sun_T, e1)])
        self.side = int(2.0 * mesh.reach / self.texel) + 4
        self.cosine = mesh.normals @ sun_T
        facing = np.flatnonzero(self.cosine > 0.0)
        place = self._place(mesh.vertices)
        index = nearest(place[mesh.faces[facing]], -(mesh.vertices @ sun_T)[mesh.faces[facing]], self.side, self.side)
        self.index = np.where(index >= 0, facing[index], -1)
        self.place = place

    def _place(self, points_T: np.ndarray) -> np.ndarray:
        return (points_T @ self.E.T) / self.texel + 0.5 * self.side

    def shadowed(self, points_T: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Which points (n, 3) of faces (n,) another face hides from the Sun."""
        place = self._place(points_T)
        at = np.clip(place, 0, self.side - 1).astype(np.int64)
        other = self.index[at[:, 1], at[:, 0]]
        hides = np.flatnonzero((other >= 0) & (other != face))
        j, mesh = other[hides], self.mesh
        # Along the Sun from the point to the other face's plane: positive where that face is nearer to the Sun.
        gap = np.sum(mesh.normals[j] * (mesh.vertices[mesh.faces[j, 0]] - points_T[hides]), axis=1)
        above = gap / np.maximum(self.cosine[j], 1e-6)
        corners = self.place[mesh.faces[j]]
        p = place[hides]
        edge = np.roll(corners, -1, axis=1) - corners
        to = p[:, None] - corners
        side = edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0]
        inside = (side >= 0.0).all(axis=1) | (side <= 0.0).all(axis=1)
        # Beside the other face the Sun sees some neighbour of it here, whose depth is not known better than slope times texel.
        slopes = 1.0 / np.maximum(self.cosine[j], 1e-3) + 1.0 / np.maximum(self.cosine[face[hides]], 1e-3)
        least = np.where(inside, 1e-7 * mesh.reach, self.texel * (1.0 + slopes))
        out = np.zeros(len(face), bool)
        out[hides[above > least]] = True
        return out

    def by_face(self, faces: np.ndarray) -> np.ndarray:
        """For faces (n,): 1 all in the dark, 0 all lit, -1 to be seen point by point; from four points of each small face."""
        corners = self.mesh.vertices[self.mesh.faces[faces]]
        middle = corners.mean(axis=1, keepdims=True)
        points = np.concatenate([middle, middle + 0.9 * (corners - middle)], axis=1)
        dark = self.shadowed(points.reshape(-1, 3), np.repeat(faces, 4)).reshape(-1, 4).sum(axis=1)
        small = np.ptp(self.place[self.mesh.faces[faces]], axis=1).max(axis=1) < _SMALL_FACE
        return np.where(small & (dark == 4), 1, np.where(small & (dark == 0), 0, -1))


def mesh_average(
    camera: Camera, mesh: Mesh, r: np.ndarray, R: np.ndarray, sun: np.ndarray, grid: Grid, shade: Shade,
    across: float = ACROSS,
) -> tuple[list[np.ndarray], np.ndarray]:  # fmt: skip
    """Channels averaged over each cell of the grid, and the share of each cell that the body covers, as `raycast.average`.

    across: rays across the body, about.
    """
    diameter = 2.0 * mesh.reach * camera.focal_px / float(r[2])
    m = int(np.clip(np.ceil(across / (diameter * grid.per_px)), 1, 32))
    fine = Grid(grid.left, grid.top, grid.columns * m, grid.rows * m, grid.per_px * m)
    seen = see(camera, mesh, r, R, sun, fine)
    i, j = np.divmod(seen.cell, fine.columns)
    cell = (i // m) * grid.columns + j // m
    shape = (grid.rows, grid.columns)

    def mean(values: np.ndarray | None) -> np.ndarray:
        return np.bincount(cell, values, grid.rows * grid.columns).reshape(shape) / (m * m)

    return [mean(v) for v in shade(seen.mu0, seen.mu, seen.alpha)], mean(None)


def mesh_light(
    camera: Camera, mesh: Mesh, r: np.ndarray, R: np.ndarray, sun: np.ndarray, law: Law, grid: Grid
) -> np.ndarray:
    """I/F averaged over each cell."""
    return mesh_average(camera, mesh, r, R, sun, grid, lambda mu0, mu, alpha: [law(mu0, mu, alpha)])[0][0]


def mesh_nodes(camera: Camera, mesh: Mesh, r: np.ndarray, R: np.ndarray, sun: np.ndarray) -> Nodes:
    """Points of the visible surface with their area in the image, shadows with mu0 = 0."""
    x, y = camera.pixels(r)
    half = 1.05 * mesh.reach * camera.focal_px / float(r[2] - mesh.reach)
    # A pixel of this grid may be a fraction of the camera's: a finer camera that looks at the same place.
    per_px = max(1, round(_NODES_ACROSS / (2.0 * half)))
    every = max(1.0, 2.0 * half / _NODES_ACROSS)
    side = int(np.ceil(2.0 * half * per_px / every)) + 2
    coarse = Camera(
        camera.width, camera.height, camera.focal_px / every, (camera.cx / every, camera.cy / every), camera.aspect,
        camera.distortion,
    )  # fmt: skip
    half_side = 0.5 * side / per_px
    grid = Grid(x / every - half_side, y / every - half_side, side, side, per_px)
    seen = see(coarse, mesh, r, R, sun, grid)
    i, j = np.divmod(seen.cell, grid.columns)
    xy = np.stack([grid.left + (j + 0.5) / per_px, grid.top + (i + 0.5) / per_px], -1) * every
    return Nodes(xy, np.full(len(i), (every / per_px) ** 2), seen.mu0, seen.mu, seen.alpha)


def hit(mesh: Mesh, r: np.ndarray, R: np.ndarray, directions_C: np.ndarray) -> np.ndarray:
    """Which rays along directions (n, 3) from the camera meet the mesh, (n,) bool."""
    d = directions_C / np.linalg.norm(directions_C, axis=1, keepdims=True)
    along = d @ r
    near = (along > 0.0) & (np.sum((r - along[:, None] * d) ** 2, axis=1) <= mesh.reach**2)
    corners = r + mesh.corners @ R
    out = np.zeros(len(d), bool)
    for k in np.flatnonzero(near):
        # The ray lies on one side of all three edges of a face that it meets.
        sides = np.stack([np.cross(corners[:, i], corners[:, (i + 1) % 3]) @ d[k] for i in range(3)], -1)
        out[k] = bool(np.any((sides >= 0.0).all(axis=1) | (sides <= 0.0).all(axis=1)))
    return out


__all__ = ["ACROSS", "Seen", "hit", "mesh_average", "mesh_light", "mesh_nodes", "nearest", "see"]
