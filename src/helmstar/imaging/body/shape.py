"""The figure of a target: ellipsoid (a sphere is one) or triangle mesh, in the body's frame T, lengths in m.

A view of an ellipsoid is an exact quadratic. With D = diag(1/a, 1/b, 1/c), a ray along d = d0 + e (d0 to the body's centre, both on
the plane z = 1 of the camera, e small), u = D R_TC d and u0 likewise, the ray's nearest point to the centre lies in the scaled
space, where the body is a unit sphere, at p = rho (w - (w.u)/(u.u) u), w = D R_TC e, rho = the centre's depth along the boresight.
Written in e, nothing cancels however far the body is. It is hit where |p| <= 1, at q = p - sqrt(1 - p.p) u/|u|, and then
mu = sqrt(1 - p.p) |u| / (|D q| |d|) and mu0 = q . (D R_TC s) / |D q|.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Ellipsoid:
    """semi_axes: a, b, c along x, y, z of T, m. Raises ValueError unless all are positive."""

    semi_axes: tuple[float, float, float]

    def __post_init__(self) -> None:
        axes = tuple(float(a) for a in self.semi_axes)
        if len(axes) != 3 or not all(np.isfinite(a) and a > 0.0 for a in axes):
            raise ValueError(f"semi_axes {self.semi_axes}: must be three positive lengths, m")
        object.__setattr__(self, "semi_axes", axes)

    @property
    def reach(self) -> float:
        """Radius of the sphere around the centre that holds all of it, m."""
        return max(self.semi_axes)

    @property
    def mean_radius(self) -> float:
        """Radius of the sphere of equal volume, m."""
        return float(np.prod(self.semi_axes) ** (1 / 3))

    def scaled(self, factor: float) -> Ellipsoid:
        """The same figure, larger."""
        a, b, c = self.semi_axes
        return Ellipsoid((factor * a, factor * b, factor * c))


def sphere(radius: float) -> Ellipsoid:
    """A sphere of that radius, m."""
    return Ellipsoid((radius, radius, radius))


@dataclass(frozen=True)
class Mesh:
    """vertices: (n, 3) m, in T. faces: (k, 3) indices, counter-clockwise seen from outside.

    Raises ValueError for what is no mesh.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        v, f = np.ascontiguousarray(self.vertices, float), np.ascontiguousarray(self.faces, np.int64)
        if v.ndim != 2 or v.shape[1] != 3 or f.ndim != 2 or f.shape[1] != 3 or len(f) < 4:
            raise ValueError(f"vertices {v.shape} and faces {f.shape}: must be (n, 3) and (k, 3) with k of at least 4")
        if not np.isfinite(v).all():
            raise ValueError("vertices: must be finite numbers")
        if f.min() < 0 or f.max() >= len(v):
            raise ValueError(f"faces name vertices {f.min()} to {f.max()}, but there are 0 to {len(v) - 1}")
        object.__setattr__(self, "vertices", v)
        object.__setattr__(self, "faces", f)

    @cached_property
    def corners(self) -> np.ndarray:
        """(k, 3, 3): three corners of each face, m."""
        return self.vertices[self.faces]

    @cached_property
    def normals(self) -> np.ndarray:
        """(k, 3) unit normals outwards; 0 for a face without area."""
        a, b, c = self.corners[:, 0], self.corners[:, 1], self.corners[:, 2]
        n = np.cross(b - a, c - a)
        return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)

    @cached_property
    def volume(self) -> float:
        """m^3; negative where the faces turn inwards."""
        a, b, c = self.corners[:, 0], self.corners[:, 1], self.corners[:, 2]
        return float(np.sum(a * np.cross(b, c)) / 6.0)

    @cached_property
    def reach(self) -> float:
        """Radius of the sphere around the origin of T that holds all of it, m."""
        return float(np.sqrt(np.max(np.sum(self.vertices**2, axis=1))))

    @property
    def mean_radius(self) -> float:
        """Radius of the sphere of equal volume, m."""
        return float((3.0 * abs(self.volume) / (4.0 * np.pi)) ** (1 / 3))

    def scaled(self, factor: float) -> Mesh:
        """The same figure, larger."""
        return Mesh(factor * self.vertices, self.faces)


Shape = Ellipsoid | Mesh


@dataclass(frozen=True)
class EllipsoidView:
    """An ellipsoid as a camera sees it, ready for many rays.

    depth: z of the centre in C, m. centre: (x0, y0) of the centre on the plane z = 1. u0: (3,), A: (3, 2): u = u0 + A [ex, ey].
    sun: (3,) B s with B = D R_TC, or D R_TC stretched. across: (3, 3) B^T, whose product with q is normal to the surface, or the
    one number that all |B^T q| are.
    """

    depth: float
    centre: tuple[float, float]
    u0: np.ndarray
    A: np.ndarray
    sun: np.ndarray
    across: np.ndarray | float

    @classmethod
    def of(
        cls,
        shape: Ellipsoid,
        r_TC_C: np.ndarray,
        R_TC: np.ndarray,
        sun_C: np.ndarray,
        stretch: np.ndarray | None = None,
    ) -> EllipsoidView:
        """r_TC_C: (3,) from camera to body, m, in C, in front of it. R_TC: (3, 3), from C to T. sun_C: (3,) unit, body to Sun.

        stretch: (3, 3) symmetric S in C; the body is drawn out by I + S.
        """
        axes = np.array(shape.semi_axes)
        x0, y0 = r_TC_C[0] / r_TC_C[2], r_TC_C[1] / r_TC_C[2]
        B = R_TC / axes[:, None]
        if stretch is not None:
            B = B @ np.linalg.inv(np.eye(3) + stretch)
        even = stretch is None and bool(np.ptp(axes) == 0.0)
        across = 1.0 / float(axes[0]) if even else B.T.copy()
        return cls(float(r_TC_C[2]), (x0, y0), B @ np.array([x0, y0, 1.0]), B[:, :2], B @ sun_C, across)

    def outline(self, ex: np.ndarray, ey: np.ndarray) -> np.ndarray:
        """p.p of rays at offsets (ex, ey) on the plane z = 1 from the centre: 1 on the outline."""
        w = [a * ex + b * ey for a, b in self.A]
        u = [w_ + c for w_, c in zip(w, self.u0)]
        wu = w[0] * u[0] + w[1] * u[1] + w[2] * u[2]
        uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
        ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        return self.depth**2 * (ww - wu * wu / uu)

    def shade(self, ex: np.ndarray, ey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """p.p, mu0 (0 in the dark) and mu at offsets (ex, ey) (n,); mu0 and mu mean nothing where p.p > 1."""
        w = [a * ex + b * ey for a, b in self.A]
        u = [w_ + c for w_, c in zip(w, self.u0)]
        uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
        k = (w[0] * u[0] + w[1] * u[1] + w[2] * u[2]) / uu
        p = [self.depth * (w_ - k * u_) for w_, u_ in zip(w, u)]
        pp = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
        root = np.sqrt(np.maximum(1.0 - pp, 0.0))
        back = root / np.sqrt(uu)
        q = [p_ - back * u_ for p_, u_ in zip(p, u)]
        if not isinstance(self.across, np.ndarray):
            size: np.ndarray | float = self.across
        else:
            normal = [a * q[0] + b * q[1] + c * q[2] for a, b, c in self.across]
            size = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
        x, y = ex + self.centre[0], ey + self.centre[1]
        mu = root * np.sqrt(uu / (1.0 + x * x + y * y)) / size
        mu0 = np.maximum(q[0] * self.sun[0] + q[1] * self.sun[1] + q[2] * self.sun[2], 0.0) / size
        return pp, mu0, mu


__all__ = ["Ellipsoid", "EllipsoidView", "Mesh", "Shape", "sphere"]
