"""Made-up centroid lists with their truth: noise, false and missing stars, magnitude errors. For tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .patterns import Sky, spiral
from .pinhole import Camera, image_pixels


@dataclass(frozen=True)
class Scene:
    """xy_px (n, 2), magnitude (n,), star (n,) catalogue index or -1 for a false one, in random order; R_SN (3, 3)."""

    xy_px: np.ndarray
    magnitude: np.ndarray
    star: np.ndarray
    R_SN: np.ndarray

    @property
    def flux(self) -> np.ndarray:
        return 10.0 ** (-0.4 * (self.magnitude - 10.0))


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """R (3, 3), uniform over SO(3)."""
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    u, w = q[:3], q[3]
    K = np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
    return np.eye(3) + 2.0 * (w * K + K @ K)


def scene(
    sky: Sky,
    camera: Camera,
    rng: np.random.Generator,
    *,
    stars: int = 30,
    noise_px: float = 0.3,
    false: int = 0,
    dropped: float = 0.0,
    magnitude_noise: float = 0.3,
    R_SN: np.ndarray | None = None,
) -> Scene:
    """A field with its `stars` brightest stars, of which a share `dropped` is missing, and `false` even detections.

    False ones have the magnitudes of true ones, drawn anew. noise_px is Gaussian, per axis.
    """
    R = random_rotation(rng) if R_SN is None else R_SN
    width, height = camera.size_px
    diagonal = np.hypot(width, height * camera.aspect)
    near = np.flatnonzero(sky.directions @ R[2] > np.cos(np.arctan(0.75 * diagonal / camera.focal_px)))
    p = image_pixels(camera, sky.directions[near] @ R.T)
    with np.errstate(invalid="ignore"):
        inside = ((p > 0.0) & (p < [width, height])).all(axis=1)
    index, p = near[inside][:stars], p[inside][:stars]
    magnitude = sky.magnitude[index] + rng.normal(scale=magnitude_noise, size=len(index))
    made_up = rng.choice(magnitude, false) if len(magnitude) else rng.uniform(4.0, 7.0, false)
    kept = np.sort(rng.permutation(len(index))[: len(index) - round(dropped * len(index))])
    index, p, magnitude = index[kept], p[kept] + rng.normal(scale=noise_px, size=(len(kept), 2)), magnitude[kept]
    made_up = made_up + rng.normal(scale=max(magnitude_noise, 0.05), size=false)
    xy = np.concatenate([p, rng.uniform([0.0, 0.0], [width, height], (false, 2))])
    order = rng.permutation(len(xy))
    star = np.concatenate([index, np.full(false, -1)])
    return Scene(xy[order], np.concatenate([magnitude, made_up])[order], star[order], R)


def random_scene(camera: Camera, rng: np.random.Generator, n: int) -> Scene:
    """Nothing but false detections."""
    width, height = camera.size_px
    xy = rng.uniform([0.0, 0.0], [width, height], (n, 2))
    return Scene(xy, 6.0 - rng.exponential(0.9, n), np.full(n, -1), np.full((3, 3), np.nan))


__all__ = ["Scene", "random_rotation", "random_scene", "scene", "spiral"]
