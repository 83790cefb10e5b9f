"""How far the light of a partly lit body lies from its centre.

The brightness centroid of a sphere of radius R far away lies g(alpha) R from its centre, towards the Sun, across the line of sight.
With luminance longitude L (0 below the camera, towards the Sun) and latitude b, mu = cos b cos L, mu0 = cos b cos(L - alpha),

    g = int r mu sin L cos b dS / int r mu dS,   dS = cos b dL db,   alpha - pi/2 <= L <= pi/2,

for any law r(mu0, mu, alpha). Lambert and Lommel-Seeliger have closed forms. `nodes` does the same for an ellipsoid from near by:
scaled to a unit sphere, what is lit and seen is again such a lune, cut where the finite distance hides the rim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..camera import Camera
from .photometry import Lambert, Law, LommelSeeliger
from .shape import Ellipsoid, EllipsoidView

NODES = 32


def lambert_factor(alpha: np.ndarray | float) -> np.ndarray:
    """g of a Lambert sphere at phase alpha (...), rad, 0 to pi: (3 pi/16) sin a (1 + cos a) / (sin a + (pi - a) cos a)."""
    a = np.asarray(alpha, float)
    below = np.sin(a) + (np.pi - a) * np.cos(a)
    with np.errstate(divide="ignore", invalid="ignore"):
        g = 3.0 * np.pi / 16.0 * np.sin(a) * (1.0 + np.cos(a)) / below
    # Near pi both vanish like (pi - a)^3; g -> 9 pi/32 keeps the digits that the quotient loses.
    x = np.pi - a
    return np.where(x < 0.02, 9.0 * np.pi / 32.0 * (1.0 - 0.15 * x * x), g)


def lommel_seeliger_factor(alpha: np.ndarray | float) -> np.ndarray:
    """g of a Lommel-Seeliger sphere at phase alpha (...), rad, 0 to below pi.

    With s, c = sin, cos(a/2): g = (2 / 3 pi) s ((pi - a) cos a + sin a) / (c - s^2 ln cot(a/4)).
    """
    a = np.asarray(alpha, float)
    s, c = np.sin(0.5 * a), np.cos(0.5 * a)
    quarter = np.maximum(np.tan(0.25 * a), 1e-300)
    return 2.0 / (3.0 * np.pi) * s * ((np.pi - a) * np.cos(a) + np.sin(a)) / (c + s * s * np.log(quarter))


def phase_factor(law: Law, alpha: float, nodes: int = 96) -> float:
    """g of a sphere far away under any law at phase alpha, rad, 0 to below pi; closed form where there is one.

    Raises ValueError for another phase.
    """
    if not 0.0 <= alpha < math.pi:
        raise ValueError(f"phase {alpha} rad: must be from 0 to below pi")
    if isinstance(law, Lambert):
        return float(lambert_factor(alpha))
    if isinstance(law, LommelSeeliger):
        return float(lommel_seeliger_factor(alpha))
    return integrated_factor(law, alpha, nodes)


def integrated_factor(law: Law, alpha: float, nodes: int = 96) -> float:
    """g by Gauss-Legendre quadrature of the integral above."""
    x, w = _gauss(nodes)
    L = 0.5 * (np.pi - alpha) * x + 0.5 * alpha
    b = 0.5 * np.pi * x
    cos_b, cos_L = np.cos(b)[:, None], np.cos(L)[None, :]
    mu, mu0 = cos_b * cos_L, cos_b * np.maximum(np.cos(L - alpha), 0.0)[None, :]
    light = law(mu0, mu, alpha) * mu * cos_b * w[:, None] * w[None, :]
    return float(np.sum(light * cos_b * np.sin(L)[None, :]) / np.sum(light))


@cache
def _gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(n)


@dataclass(frozen=True)
class Nodes:
    """Points of the lit and seen surface. xy_px: (n, 2). area_px: (n,) weight of each, px^2 of the image. mu0, mu, alpha: (n,)."""

    xy_px: np.ndarray
    area_px: np.ndarray
    mu0: np.ndarray
    mu: np.ndarray
    alpha: np.ndarray

    def light(self, law: Law) -> np.ndarray:
        """(n,) I/F times px^2."""
        return law(self.mu0, self.mu, self.alpha) * self.area_px

    def moment(self, law: Law) -> tuple[float, np.ndarray]:
        """Flux, I/F times px^2, and brightness centroid (2,), px; NaN where nothing is lit."""
        light = self.light(law)
        flux = float(light.sum())
        if not flux > 0.0:
            return 0.0, np.full(2, np.nan)
        return flux, light @ self.xy_px / flux


def nodes(
    camera: Camera, shape: Ellipsoid, r_TC_C: np.ndarray, R_TC: np.ndarray, sun_C: np.ndarray,
    n: int | tuple[int, int] = NODES,
) -> Nodes:  # fmt: skip
    """n x n Gauss nodes, or (along longitude, along latitude), on what is lit and seen.

    Arguments as `EllipsoidView.of`. Raises ValueError where the camera is not outside of the body.

    The image area of an element is that of the pinhole: distortion moves the nodes and is taken to keep their areas.
    """
    view = EllipsoidView.of(shape, r_TC_C, R_TC, sun_C)
    size = float(np.linalg.norm(view.u0))
    rho = view.depth * size
    if rho <= 1.0:
        raise ValueError("the camera is inside of the body")
    ev = -view.u0 / size
    sun = view.sun / np.linalg.norm(view.sun)
    across = sun - (sun @ ev) * ev
    sine = float(np.linalg.norm(across))
    if sine < 1e-12:
        across = np.cross(ev, np.eye(3)[int(np.argmin(np.abs(ev)))])
    ex = across / np.linalg.norm(across)
    ey = np.cross(ev, ex)
    alpha = math.atan2(sine, float(sun @ ev))
    least = 1.0 / rho if alpha <= 0.5 * math.pi else 1.0 / (rho * max(math.sin(alpha), 1e-300))
    if least >= 1.0:  # a new moon
        empty = np.zeros(0)
        return Nodes(np.zeros((0, 2)), empty, empty, empty, empty)
    n_L, n_b = (n, n) if isinstance(n, int) else n
    (x, w), (x_b, w_b) = _gauss(n_L), _gauss(n_b)
    top = math.acos(least)
    b = top * x_b[:, None]
    high = np.arccos(np.clip(1.0 / (rho * np.cos(b)), -1.0, 1.0))
    low = np.maximum(alpha - 0.5 * np.pi, -high)
    half = np.maximum(0.5 * (high - low), 0.0)
    L = half * x[None, :] + 0.5 * (high + low)
    weight = (top * w_b[:, None] * half * w[None, :] * np.cos(b)).ravel()
    cos_b = np.cos(b)
    q = np.stack([cos_b * np.cos(L), cos_b * np.sin(L), np.broadcast_to(np.sin(b), L.shape)], -1).reshape(-1, 3)
    q = q @ np.stack([ev, ex, ey])
    axes = np.array(shape.semi_axes)
    normal = q / axes
    length = np.linalg.norm(normal, axis=1)
    point = r_TC_C + (q * axes) @ R_TC
    distance = np.linalg.norm(point, axis=1)
    v = -point / distance[:, None]
    normal_C = (normal / length[:, None]) @ R_TC
    mu, mu0 = np.sum(normal_C * v, axis=1), normal_C @ sun_C
    seen = (mu > 0.0) & (mu0 > 0.0)
    area = np.prod(axes) * length * weight * mu / distance**2 / (point[:, 2] / distance) ** 3
    area = np.where(seen, area * camera.focal_px**2 / camera.aspect, 0.0)
    phase = np.arccos(np.clip(v @ sun_C, -1.0, 1.0))
    return Nodes(camera.pixels(point), area, np.maximum(mu0, 0.0), np.maximum(mu, 0.0), phase)


__all__ = [
    "NODES", "Nodes", "integrated_factor", "lambert_factor", "lommel_seeliger_factor", "nodes", "phase_factor",
]  # fmt: skip
