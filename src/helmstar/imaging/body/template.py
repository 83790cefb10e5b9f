"""What a fit compares a frame with: images of patterns of light on a target at a trial centre, size and figure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ..camera import Camera
from ..frame import Image
from .photometry import Law, family
from .raycast import Grid, average
from .render_body import box
from .shape import Ellipsoid, EllipsoidView
from .target import Pose, Target

_REACH = 4.0
MESH_RAYS = 300.0
"""Rays across a mesh in a template."""


@dataclass(frozen=True)
class Trial:
    """centre_px: (2,). size: apparent over expected. stretch: (3, 3) symmetric S without trace, in C: drawn out by I + S."""

    centre_px: np.ndarray
    size: float = 1.0
    stretch: np.ndarray | None = None


@dataclass(frozen=True)
class Scene:
    """A frame's camera, the target and its pose, and the optics' sigma, px."""

    camera: Camera
    target: Target
    pose: Pose
    psf_sigma_px: float

    def binned(self, n: int) -> Scene:
        """The same scene on pixels n times as large, whose (0, 0) covers the first n x n."""
        if n == 1:
            return self
        c = self.camera
        middle = ((c.cx - (n - 1) / 2) / n, (c.cy - (n - 1) / 2) / n)
        camera = Camera(max(c.width // n, 1), max(c.height // n, 1), c.focal_px / n, middle, c.aspect, c.distortion)
        return Scene(camera, self.target, self.pose, self.psf_sigma_px / n)

    def diameter_px(self, size: float = 1.0) -> float:
        """Across the sphere of equal volume."""
        return 2.0 * self.target.shape.mean_radius * self.camera.focal_px / self.pose.distance * size

    def position(self, trial: Trial) -> np.ndarray:
        """r_TC_C, m: a larger image is drawn as a nearer body."""
        return self.pose.position(self.camera, trial.centre_px) / trial.size

    def window(self, trial: Trial, margin_px: float = 0.0) -> tuple[int, int, int, int]:
        """(left, top, width, height) around the body and its blur, in the frame or not."""
        stretch = 0.0 if trial.stretch is None else float(np.abs(trial.stretch).max())
        more = 0.5 * self.diameter_px(trial.size) * stretch
        return box(
            self.camera, self.target.shape, self.position(trial), more + margin_px + _REACH * self.psf_sigma_px + 1.0
        )

    def draw(
        self, trial: Trial, window: tuple[int, int, int, int], *, law: Law | None, with_family: bool,
        weights: np.ndarray | None = None,
    ) -> list[np.ndarray]:  # fmt: skip
        """Images (height, width) of the law and of each of the family, after the optics; their sum by `weights` if given."""
        left, top, width, height = window
        small = self.diameter_px(trial.size)
        # The rim's quadrature is right at any size of cells: these only have to sample optics and shading. A free figure is told
        # from another by so little that the optics must be sampled twice a pixel at any size.
        per_px = math.ceil(max(1.2 / max(self.psf_sigma_px, 0.3), 30.0 / small))
        per_px = min(per_px, 8) if small < 40 else 2 if small < 100 or trial.stretch is not None else 1
        blur = math.ceil(_REACH * self.psf_sigma_px) + 1

        def shade(mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> list[np.ndarray]:
            out = [law(mu0, mu, alpha)] if law is not None else []
            if with_family:
                out += family(mu0, mu)
            return out if weights is None else [sum((w * o for w, o in zip(weights, out)), np.zeros_like(mu0))]

        grid = Grid(
            left - blur - 0.5, top - blur - 0.5, (width + 2 * blur) * per_px, (height + 2 * blur) * per_px, per_px
        )
        r = self.position(trial)
        sun, R = self.pose.sun_C, self.pose.R_TC
        if isinstance(self.target.shape, Ellipsoid):
            view = EllipsoidView.of(self.target.shape, r, R, sun, trial.stretch)
            by_phase = law is not None and bool(law.by_phase)
            channels, _ = average(self.camera, view, sun, grid, shade, by_phase, refine=True)
        else:
            from .raster import mesh_average

            channels, _ = mesh_average(self.camera, self.target.shape, r, R, sun, grid, shade, MESH_RAYS)
        return [self._spread(c, blur, per_px) for c in channels]

    def _spread(self, cells: np.ndarray, blur: int, per_px: int) -> np.ndarray:
        smooth = np.asarray(gaussian_filter(cells, self.psf_sigma_px * per_px, mode="constant", truncate=_REACH))
        if per_px > 1:
            h, w = smooth.shape[0] // per_px, smooth.shape[1] // per_px
            smooth = smooth.reshape(h, per_px, w, per_px).mean(axis=(1, 3))
        return smooth[blur:-blur, blur:-blur]


@dataclass(frozen=True)
class Data:
    """Pixels to compare with. grey: (height, width), counts above the sky. good: bool. noise: of a pixel without light, counts.
    corner: the frame's pixel, of the size that pixels have here, that (0, 0) is."""

    grey: np.ndarray
    good: np.ndarray
    noise: float
    corner: tuple[float, float]

    def cut(self, window: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int, int]]:
        """Grey, good and the window's part on the image, in the frame's pixels; at least 1 x 1."""
        left, top, width, height = window
        x0, y0 = int(max(left - self.corner[0], 0)), int(max(top - self.corner[1], 0))
        x1 = int(min(left + width - self.corner[0], self.grey.shape[1]))
        y1 = int(min(top + height - self.corner[1], self.grey.shape[0]))
        x1, y1 = max(x1, min(x0 + 1, self.grey.shape[1])), max(y1, min(y0 + 1, self.grey.shape[0]))
        x0, y0 = min(x0, x1 - 1), min(y0, y1 - 1)
        at = (x0 + int(self.corner[0]), y0 + int(self.corner[1]), x1 - x0, y1 - y0)
        return self.grey[y0:y1, x0:x1], self.good[y0:y1, x0:x1], at

    def smoothed(self, sigma_px: float) -> Data:
        """After a Gaussian of that sigma; what it takes from pixels that are bad or beyond the edge is bad."""
        if sigma_px <= 0.0:
            return self
        here = gaussian_filter(self.good.astype(np.float32), sigma_px, mode="constant", truncate=3.0)
        grey = gaussian_filter(np.where(self.good, self.grey, 0.0), sigma_px, mode="constant", truncate=3.0)
        return Data(grey / np.maximum(here, 1e-6), np.asarray(here > 0.98), self.noise, self.corner)

    def binned(self, n: int) -> Data:
        """Means over n x n pixels whose boundaries are the frame's multiples of n."""
        if n == 1:
            return self
        x0, y0 = -int(self.corner[0]) % n, -int(self.corner[1]) % n
        h, w = (self.grey.shape[0] - y0) // n, (self.grey.shape[1] - x0) // n
        part = (slice(y0, y0 + h * n), slice(x0, x0 + w * n))
        grey = self.grey[part].reshape(h, n, w, n).mean(axis=(1, 3))
        good = np.asarray(self.good[part].reshape(h, n, w, n).all(axis=(1, 3)))
        return Data(grey, good, self.noise / n, ((self.corner[0] + x0) / n, (self.corner[1] + y0) / n))


def data_of(image: Image, grey: np.ndarray, noise: float, corner: tuple[int, int]) -> Data:
    """Of a frame or a window of it: pixels that are full say nothing."""
    return Data(grey, image.array < image.saturation, noise, corner)


__all__ = ["Data", "Scene", "Trial", "data_of"]
