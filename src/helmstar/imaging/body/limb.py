"""Centre of figure from the limb: edge points along scans from the Sun's side, and the known figure's outline through them.

Near the limb every law is a series in mu, and mu goes like the root of the depth d inside of the edge: brightness is
a + b sqrt(d) + c d. A scan's edge is where that profile, spread by the optics, over a sky of its own leaves the least residual;
a, b, c are fitted for each scan, so that no law is assumed. The outline is that of the ellipsoid in perspective; its size, and
two stretches in the image where shape_sigma is given, have priors.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates

from ..camera import Camera
from ..frame import Image
from .moment import Centroid, offsets, preprocess, windowed_centroid
from .shape import Ellipsoid, EllipsoidView
from .target import (
    AMBIGUOUS,
    CUT,
    DARK,
    FAILED,
    FOUND,
    NO_BODY,
    SATURATED,
    Detector,
    FigureCentre,
    Pose,
    Target,
    nothing,
)
from .template import Data, Scene, Trial, data_of

LEAST_PX = 20.0
"""Apparent diameter below which a limb bends too much over the optics' width for straight scans."""
LEAST_CRESCENT_PX = 10.0
STEP_PX = 0.25
SCANS = 240
_HALF = math.radians(82.0)  # of the lit side, around the Sun's direction
FLOOR_PX = 0.04
"""1 sigma that scans have in common: of bilinear sampling and of profiles cut after the linear term."""


def outline_distance(scene: Scene, trial: Trial, xy_px: np.ndarray) -> np.ndarray:
    """Distance (n,), px, of points (n, 2) outside of the body's outline (negative inside), to first order."""
    shape = scene.target.shape
    assert isinstance(shape, Ellipsoid)
    view = EllipsoidView.of(shape, scene.position(trial), scene.pose.R_TC, scene.pose.sun_C, trial.stretch)

    def radius(xy: np.ndarray) -> np.ndarray:
        d = scene.camera.directions(xy)
        return np.sqrt(view.outline(d[:, 0] / d[:, 2] - view.centre[0], d[:, 1] / d[:, 2] - view.centre[1]))

    h = 0.05
    along_x, along_y = np.array([h, 0.0]), np.array([0.0, h])
    r = radius(xy_px)
    gx = (radius(xy_px + along_x) - radius(xy_px - along_x)) / (2.0 * h)
    gy = (radius(xy_px + along_y) - radius(xy_px - along_y)) / (2.0 * h)
    return (r - 1.0) / np.maximum(np.hypot(gx, gy), 1e-12)


def outline_px(scene: Scene, trial: Trial, angles: np.ndarray) -> np.ndarray:
    """Points (n, 2), px, of the outline at angles (n,), rad, from columns to rows, around the centre."""
    way = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    r = np.full(len(angles), 0.5 * scene.diameter_px(trial.size))
    for _ in range(12):
        r = np.maximum(r - outline_distance(scene, trial, trial.centre_px + r[:, None] * way), 1e-3)
    return trial.centre_px + r[:, None] * way


def edge_points(data: Data, scene: Scene, trial: Trial, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges on scans across the trial's outline on the Sun's side: points (n, 2), outward normals (n, 2), 1 sigma along them (n,).

    reach_px: how far to both sides of the trial's outline an edge is looked for.
    """
    sun = scene.pose.sun_C
    r = scene.position(trial)
    toward = scene.camera.pixels(r + 1e-3 * np.linalg.norm(r) * sun) - scene.camera.pixels(r)
    middle = math.atan2(toward[1], toward[0])
    # At small phase all of the limb is lit, and the direction of the Sun means nothing.
    half = math.pi * (1 - 1 / SCANS) if scene.pose.phase(scene.camera, trial.centre_px) < 0.09 else _HALF
    angles = middle + np.linspace(-half, half, SCANS)
    points = outline_px(scene, trial, angles)
    ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    ahead[[0, -1]] = [points[1] - points[0], points[-1] - points[-2]]
    normals = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    normals *= np.sign(np.sum(normals * (points - trial.centre_px), axis=1, keepdims=True))
    depth = min(6.0 + 4.0 * scene.psf_sigma_px, 0.3 * scene.diameter_px(trial.size))
    sky = 2.0 + 3.0 * scene.psf_sigma_px
    t = np.arange(-(reach_px + depth), reach_px + sky, STEP_PX)
    at = points[:, None] + t[:, None] * normals[:, None]
    x, y = at[..., 0] - data.corner[0], at[..., 1] - data.corner[1]
    h, w = data.grey.shape
    inside = ((x >= 0) & (y >= 0) & (x <= w - 1) & (y <= h - 1)).all(axis=1)
    profile = map_coordinates(data.grey, [y, x], order=1, mode="nearest")
    usable = map_coordinates(data.good.astype(np.float32), [y, x], order=1, mode="nearest") > 0.999
    good = inside & usable.all(axis=1)
    points, normals, profile = points[good], normals[good], profile[good].astype(float)
    if len(points) < 8:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    place, sigma = _edges(profile, t, scene.psf_sigma_px, reach_px)
    found = np.isfinite(place) & (sigma < 0.5)
    return points[found] + place[found, None] * normals[found], normals[found], sigma[found]


def _edges(profile: np.ndarray, t: np.ndarray, psf: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Place of the edge on each scan (n,) along t, px, and its 1 sigma; NaN where there is no step down outwards."""
    # Bilinear sampling widens by about the width of a triangle of one pixel's half side, the pixel by its own.
    width = math.hypot(psf, 0.29, 0.35)
    fine = STEP_PX / 4.0
    u = np.arange(-t[-1] + t[0] - 6.0, t[-1] - t[0] + 6.0, fine)
    inside = np.maximum(-u, 0.0)
    shapes = [(u < 0.0).astype(float) + 0.5 * (u == 0.0), np.sqrt(inside), inside]
    shapes = [gaussian_filter1d(s, width / fine, mode="nearest") for s in shapes]
    trials = np.arange(-reach, reach + 1e-9, STEP_PX)
    left = np.empty((len(trials), len(profile)))
    total = np.sum(profile**2, axis=1)
    for k, e in enumerate(trials):
        B = np.stack([np.ones_like(t), *(np.interp(t - e, u, s) for s in shapes)], axis=1)
        Q = np.linalg.qr(B)[0]
        left[k] = total - np.sum((profile @ Q) ** 2, axis=1)
    best = np.argmin(left, axis=0)
    k = np.clip(best, 1, len(trials) - 2)
    i = np.arange(len(profile))
    a, b, c = left[k - 1, i], left[k, i], left[k + 1, i]
    bend = a - 2.0 * b + c
    with np.errstate(divide="ignore", invalid="ignore"):
        place = trials[k] + 0.5 * STEP_PX * (a - c) / bend
        # Samples closer than a pixel share their noise: one in 1/STEP_PX counts.
        variance = np.maximum(b, 0.0) / max(len(t) * STEP_PX - 5.0, 2.0) / STEP_PX
        sigma = np.sqrt(2.0 * variance * STEP_PX**2 / bend)
    n = max(4, round(2.0 / STEP_PX))
    down = profile[:, :n].mean(axis=1) > profile[:, -n:].mean(axis=1)
    ok = (best > 0) & (best < len(trials) - 1) & (bend > 0.0) & down
    return np.where(ok, place, np.nan), np.where(ok, sigma, np.inf)


def centre_from_limb(
    image: Image, camera: Camera, target: Target, pose: Pose, detector: Detector | None = None, *,
    corner: tuple[int, int] = (0, 0), centroid: Centroid | None = None,
) -> FigureCentre:  # fmt: skip
    """Centre of figure from the limb of an ellipsoid of at least LEAST_PX; arguments, statuses as `centre_from_fit`."""
    detector = detector or Detector()
    scene = Scene(camera, target, pose, detector.psf_sigma_px)
    diameter = scene.diameter_px()
    if not isinstance(target.shape, Ellipsoid):
        return nothing(FAILED, "limb", "a limb fit needs an ellipsoid; fit a mesh by templates", diameter)
    if diameter < LEAST_PX:
        return nothing(FAILED, "limb", f"{diameter:.1f} px are too few for a limb; {LEAST_PX:g} are needed", diameter)
    crescent = 0.5 * diameter * (1.0 + math.cos(pose.phase(camera, np.array(camera.geometric_centre_px))))
    if crescent < LEAST_CRESCENT_PX:
        return nothing(FAILED, "limb", f"a crescent {crescent:.1f} px wide is too thin for scans", diameter)
    if centroid is None:
        centroid = windowed_centroid(
            image, detector, corner=corner, near_px=pose.near_px, near_sigma_px=pose.near_sigma_px + 0.5 * diameter,
            reach_px=0.6 * diameter * target.shape.reach / target.shape.mean_radius,
        )  # fmt: skip
    if centroid.status in (NO_BODY, AMBIGUOUS):
        return nothing(centroid.status, "limb", centroid.message, diameter)
    offset, _ = offsets(camera, target, pose, centroid.xy_px)
    if not np.isfinite(offset).all():
        return nothing(
            DARK, "limb", "the side that faces the camera is not lit: is the Sun's direction right?", diameter
        )
    g = preprocess(image)
    data = data_of(image, g.grey, g.noise, corner)
    from .template_fit import coarse

    search = diameter if centroid.status in (CUT, SATURATED) else None
    trial = coarse(data, scene, Trial(centroid.xy_px - offset), detector, search)
    C, chi2, points = np.full((2, 2), np.nan), float("nan"), np.zeros((0, 2))
    size_sigma = float("nan")
    for reach in (0.03 * diameter + 3.0, 2.5):
        for _ in range(2):
            points, _, sigma = edge_points(data, scene, trial, reach)
            if len(points) < 12:
                return nothing(FAILED, "limb", f"only {len(points)} edge points were found", diameter)
            trial, C, chi2, kept, size_sigma = _fit(scene, trial, points, sigma)
            points = points[kept]
    if not np.isfinite(C).all():
        return nothing(FAILED, "limb", "the outline's fit ran away", diameter)
    status, message = (centroid.status, centroid.message) if centroid.status in (CUT, SATURATED) else (FOUND, "")
    return FigureCentre(
        status, "limb", trial.centre_px, C + FLOOR_PX**2 * np.eye(2), centroid.xy_px, diameter, trial.size, size_sigma,
        points, chi2, message,
    )  # fmt: skip


_STRETCH = (np.diag([1.0, -1.0, 0.0]), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 0]]))


def _fit(
    scene: Scene, start: Trial, points: np.ndarray, sigma: np.ndarray
) -> tuple[Trial, np.ndarray, float, np.ndarray, float]:
    """Robust Gauss-Newton of centre, size and stretches through edge points: trial, covariance (2, 2), chi2, points kept, and
    sigma of size."""
    target = scene.target
    free = 2 if target.shape_sigma > 0.0 else 0
    spread = np.array([max(scene.pose.scale_sigma(target), 1e-5), *[max(target.shape_sigma, 1e-5)] * free])
    S = np.zeros((3, 3)) if start.stretch is None else start.stretch
    p = np.array([*start.centre_px, math.log(start.size), *([0.5 * (S[0, 0] - S[1, 1]), S[0, 1]][:free])])
    expected = np.concatenate([[0.0, 0.0], np.zeros(1 + free)])
    prior = np.concatenate([[0.0, 0.0], 1.0 / spread**2])
    h = np.array([0.05, 0.05, 1e-3, *[1e-3] * free])

    def trial_of(p: np.ndarray) -> Trial:
        stretch = sum(a * E for a, E in zip(p[3:], _STRETCH)) if free else None
        return Trial(p[:2], math.exp(p[2]), None if stretch is None else np.asarray(stretch))

    distance = lambda p: outline_distance(scene, trial_of(p), points)
    sigma = np.hypot(sigma, 0.02)
    A, chi2, kept = np.eye(len(p)), 1.0, np.ones(len(points), bool)
    for _ in range(8):
        d = distance(p)
        J = np.stack([(distance(p + e) - distance(p - e)) / (2.0 * e.max()) for e in np.diag(h)], axis=1)
        scale = max(1.0, 1.4826 * float(np.median(np.abs(d / sigma))))
        z = d / (sigma * scale)
        kept = np.abs(z) < 4.0
        w = np.where(kept, np.minimum(1.0, 2.0 / np.maximum(np.abs(z), 1e-9)), 0.0) / (sigma * scale) ** 2
        A = (J * w[:, None]).T @ J + np.diag(prior + 1e-12)
        step = np.linalg.solve(A, -(J.T @ (w * d)) + prior * (expected - p))
        p = p + np.clip(step, -0.2 * scene.diameter_px(), 0.2 * scene.diameter_px())
        p[2:] = np.clip(p[2:], -1.0, 1.0)
        chi2 = float(np.sum(w * d**2)) * scale**2 / max(kept.sum() - len(p), 1)
        if np.abs(step[:2]).max() < 1e-4:
            break
    C = np.linalg.inv(A)
    # Neighbouring scans share pixels: about as many are independent as the limb has pixels.
    shared = max(1.0, len(points) / max(0.5 * math.pi * 0.5 * scene.diameter_px(), 8.0)) + 1.0
    C = C * shared
    return trial_of(p), C[:2, :2], chi2, kept, float(math.sqrt(C[2, 2]) * math.exp(p[2]))


__all__ = ["FLOOR_PX", "LEAST_PX", "SCANS", "centre_from_limb", "edge_points", "outline_distance", "outline_px"]
