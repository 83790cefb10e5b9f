"""The paper's pixel and line of a body, (4)-(7) of Li, Cui and Cui (2007), for NumPy and for JAX arrays alike.

    T_IC = T_IB T_BC                                     (4)   axes of I, B, C; here R_CI = R_CB R_BI, v_C = R_CI v_I
    x = f X_C / Z_C,  y = f Y_C / Z_C                    (5)   focal plane, in the unit of f
    [p; l] = K [x; y; x y] + [p_0; l_0]                  (6)   K (2, 3): K_x, K_xy, K_xxy; K_yx, K_y, K_yxy, px per unit of f
    lambda = atan2(T_12, T_11),  delta = asin(T_13),  phi = atan2(T_23, T_33)          (7)

with T = R_BI: lambda and delta are right ascension and declination of B's x axis, phi is the turn about it. The order of (7) is
this module's reading: at zero angles B is I, which the printed start values of a few milliradians ask for. Every function is
made of elementary operations on the arrays that it is given, so that JAX differentiates it; nothing here imports JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import Camera


def _space(*arrays: Any) -> Any:
    """jax.numpy where one of the arrays is JAX's, else numpy."""
    for a in arrays:
        space = getattr(a, "__array_namespace__", None)
        if space is not None and not isinstance(a, np.ndarray | np.generic):
            return space()
    return np


@dataclass(frozen=True)
class PixelMap:
    """focal: f, mm or any unit. K: (2, 3), px per that unit, times x, y and x y. origin_px: (p_0, l_0)."""

    focal: float
    K: Any
    origin_px: Any

    def pixel_line(self, r_TC_C: Any) -> Any:
        """(..., 2) of positions (..., 3) in C, in front of the camera: (5) and (6)."""
        xp = _space(r_TC_C, self.K)
        x = self.focal * r_TC_C[..., 0] / r_TC_C[..., 2]
        y = self.focal * r_TC_C[..., 1] / r_TC_C[..., 2]
        return xp.stack([x, y, x * y], -1) @ xp.asarray(self.K).T + xp.asarray(self.origin_px)

    def plane(self, pixel_line: Any, iterations: int = 20) -> np.ndarray:
        """x, y (..., 2) on the focal plane of pixels (..., 2): the inverse of (6), by Newton's method where K has terms in x y."""
        p = np.asarray(pixel_line, float) - np.asarray(self.origin_px, float)
        K = np.asarray(self.K, float)
        xy = p @ np.linalg.inv(K[:, :2]).T
        for _ in range(iterations):
            x, y = xy[..., 0], xy[..., 1]
            rest = np.stack([x, y, x * y], -1) @ K.T - p
            J = K[:, :2] + K[:, 2, None] * np.stack([y, x], -1)[..., None, :]
            step = np.linalg.solve(J, rest[..., None])[..., 0]
            xy = xy - step
            if np.abs(step).max(initial=0.0) < 1e-15 * max(1.0, float(np.abs(xy).max(initial=0.0))):
                break
        return xy

    def camera(self, width: int, height: int) -> Camera:
        """The pinhole camera of a K without cross terms, f in pixels. Raises ValueError where K has some."""
        K = np.asarray(self.K, float)
        if np.any(K[[0, 0, 1, 1], [1, 2, 0, 2]] != 0.0) or not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
            raise ValueError(f"K {K.tolist()}: a pinhole camera has K_x and K_y, both positive, and no cross terms")
        origin = (float(self.origin_px[0]), float(self.origin_px[1]))
        return Camera(width, height, float(self.focal * K[0, 0]), origin, aspect=float(K[0, 0] / K[1, 1]))


def paper_map(focal_mm: float = 200.0, per_mm: float = 83.8, side: int = 1024) -> PixelMap:
    """The paper's camera: f = 200 mm, K_x = K_y = 83.8 px/mm, no cross terms, the boresight in the middle."""
    middle = (side - 1) / 2
    return PixelMap(focal_mm, np.array([[per_mm, 0.0, 0.0], [0.0, per_mm, 0.0]]), np.array([middle, middle]))


def camera_rotation(R_BI: Any, R_CB: Any) -> Any:
    """R_CI (..., 3, 3): (4), which the paper writes as the transpose, T_IC = T_IB T_BC."""
    return R_CB @ R_BI


def rotation_of_angles(angles: Any) -> Any:
    """R_BI (..., 3, 3) of (lambda, delta, phi) (..., 3), rad: R_x(phi) R_y(-delta) R_z(lambda)."""
    xp = _space(angles)
    a, d, p = angles[..., 0], angles[..., 1], angles[..., 2]
    ca, sa, cd, sd, cp, sp = xp.cos(a), xp.sin(a), xp.cos(d), xp.sin(d), xp.cos(p), xp.sin(p)
    rows = [
        [cd * ca, cd * sa, sd],
        [-cp * sa - sp * sd * ca, cp * ca - sp * sd * sa, sp * cd],
        [sp * sa - cp * sd * ca, -sp * ca - cp * sd * sa, cp * cd],
    ]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def attitude_angles(R_BI: Any) -> Any:
    """(lambda, delta, phi) (..., 3), rad, of R_BI (..., 3, 3): (7). At delta = +-90 deg only lambda -+ phi has a meaning."""
    xp = _space(R_BI)
    delta = xp.arctan2(R_BI[..., 0, 2], xp.hypot(R_BI[..., 0, 0], R_BI[..., 0, 1]))
    return xp.stack(
        [xp.arctan2(R_BI[..., 0, 1], R_BI[..., 0, 0]), delta, xp.arctan2(R_BI[..., 1, 2], R_BI[..., 2, 2])], -1
    )


def pixel_line_of(pixel_map: PixelMap, r_CT_I: Any, R_BI: Any, R_CB: Any) -> Any:
    """Pixel and line (..., 2) of the body for the probe at r_CT_I (..., 3), from body to probe in I: (4)-(6) in one."""
    r_C = -(camera_rotation(R_BI, R_CB) @ r_CT_I[..., None])[..., 0]
    return pixel_map.pixel_line(r_C)


__all__ = [
    "PixelMap", "attitude_angles", "camera_rotation", "paper_map", "pixel_line_of", "rotation_of_angles",
]  # fmt: skip
