"""A pinhole camera with Brown and Conrady's distortion: pixels to directions in the sensor frame S and back.

S: z along the boresight, x to the right in the image (columns increase), y down (rows increase). The direction of an ideal
pixel (x, y) is [(x - cx) / f, (y - cy) aspect / f, 1], normalised. Pixel edges lie at 0 and the width, so the middle of the
first pixel is 0.5. Anything with these field names serves as a camera (`Camera`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..distortion import distort, reach, undistort


class Camera(Protocol):
    """What identification needs of a camera.

    focal_px: focal length in pixel widths. centre_px: principal point (x, y). aspect: pixel height over width.
    distortion: k1, k2, p1, p2, k3 in OpenCV's order and sense (ideal to distorted). size_px: width and height of the image.
    """

    @property
    def focal_px(self) -> float: ...
    @property
    def centre_px(self) -> tuple[float, float]: ...
    @property
    def aspect(self) -> float: ...
    @property
    def distortion(self) -> tuple[float, float, float, float, float]: ...
    @property
    def size_px(self) -> tuple[int, int]: ...


@dataclass(frozen=True)
class Pinhole:
    """See `Camera`."""

    focal_px: float
    centre_px: tuple[float, float]
    size_px: tuple[int, int]
    aspect: float = 1.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def of_field(cls, fov: float, size_px: tuple[int, int], aspect: float = 1.0) -> Pinhole:
        """A camera without distortion of a horizontal full field of view (rad). Raises ValueError for no such field."""
        if not 0.0 < fov < np.pi:
            raise ValueError(f"fov {fov} rad: must be between 0 and pi")
        width, height = size_px
        return cls(0.5 * width / float(np.tan(0.5 * fov)), (0.5 * width, 0.5 * height), (width, height), aspect)


def ideal_pixels(camera: Camera, xy_px: np.ndarray) -> np.ndarray:
    """(n, 2) pixels without distortion, from the principal point, y in pixel widths: focal_px times (X/Z, Y/Z); NaN where the
    lens sends no direction (`undistort`)."""
    xy = np.asarray(xy_px, dtype=float) - np.asarray(camera.centre_px, dtype=float)
    xy = xy * np.array([1.0, camera.aspect])
    if not any(camera.distortion):
        return xy
    x, y = (xy / camera.focal_px).T
    return np.stack(undistort(x, y, camera.distortion), axis=1) * camera.focal_px


def image_pixels(camera: Camera, v_S: np.ndarray) -> np.ndarray:
    """Image pixels (n, 2) of directions (n, 3) in S; NaN for those not in front of the camera, or where the lens folds over."""
    z = np.where(v_S[:, 2] > 1e-3, v_S[:, 2], np.nan)
    u = v_S[:, :2] / z[:, None]
    if any(camera.distortion):
        u = np.where((u**2).sum(axis=1, keepdims=True) <= reach(camera.distortion) ** 2, u, np.nan)
        u = np.stack(distort(u[:, 0], u[:, 1], camera.distortion)[:2], axis=1)
    return u * camera.focal_px / np.array([1.0, camera.aspect]) + np.asarray(camera.centre_px)


__all__ = ["Camera", "Pinhole", "ideal_pixels", "image_pixels"]
