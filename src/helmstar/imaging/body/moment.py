"""The paper's chain from a frame to the centre of a body: preprocessing, brightness centroid, centre of figure; and a better one.

Li, Cui and Cui (2007), (1)-(3), with pixels p (columns) and l (rows) and grey levels P:

    p_cb = sum P p / sum P,  l_cb likewise,          (1)
    over pixels with P_min <= P <= P_max,            (2)
    p_0 = p_cb - g R_c cos phi,  l_0 = l_cb - g R_c sin phi,  R_c = R K_x f / rho,     (3)

g the phase factor (phase.py), phi the Sun's direction in the image. `windowed_centroid` sums all light of the body in an aperture
instead of what is above a threshold, and `centre_from_moment` subtracts what the model's own centroid says for its true distance,
figure and law; its covariance holds what is not known of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label

from ..camera import Camera
from ..frame import Image
from .phase import Nodes, nodes
from .photometry import Hapke, Lambert, Law, LommelSeeliger, McEwen, Minnaert
from .shape import Ellipsoid, Shape
from .target import AMBIGUOUS, CUT, DARK, FOUND, NO_BODY, SATURATED, SPOT, Detector, FigureCentre, Pose, Target, nothing

LAWS_TRIED: tuple[Law, ...] = (
    Lambert(),
    LommelSeeliger(),
    McEwen(weight=0.5),
    Minnaert(k=0.6),
    Minnaert(k=0.8),
    Hapke(),
)
"""What a body of unknown law may be like: their spread is the covariance's part for the law."""
FULL_FRAME_SIGMAS = 6.0
"""P_min above the sky, in sigma of the noise, for a whole frame: 10^6 pixels of pure noise then give nothing."""
_SAMPLE = 40_000
_LEAST_SNR = 8.0
_SHAPE_GAIN = 0.9  # centroid's error over offset times relative error of the axes, from ellipsoids taken for spheres


@dataclass(frozen=True)
class Grey:
    """A preprocessed frame: grey (height, width) float32 above the sky, isolated hot pixels removed; sky and noise (1 sigma of a
    pixel without light), counts; p_min, p_max: (2), above the sky."""

    grey: np.ndarray
    sky: float
    noise: float
    p_min: float
    p_max: float


def sky_of(array: np.ndarray) -> tuple[float, float]:
    """Sky and its noise (1 sigma of a pixel), counts: the densest level of the pixels and the spread below it.

    The half-sample mode finds the sky while it is the level with most pixels near it, also where the body fills half of the frame;
    the spread is that of what is darker, where no star or body can be.
    """
    step = max(1, math.ceil(math.sqrt(array.size / _SAMPLE)))
    v = array[step // 2 :: step, step // 2 :: step].astype(float).ravel()
    whole = array.dtype.kind in "iu"
    if whole:  # whole numbers stand for intervals; spread evenly in theirs, repeatable
        v = v + np.modf(np.arange(v.size) * 0.6180339887498949)[0] - 0.5
    v.sort()
    sky = _mode(v)
    # A body that fills the image may be the commonest level: the sky is then a narrow level far below it.
    for _ in range(4):
        dark = float(v[v.size // 100])
        if np.searchsorted(v, dark + 0.2 * (sky - dark)) < 0.08 * v.size:
            break
        sky = _mode(v[: max(int(np.searchsorted(v, dark + 0.5 * (sky - dark))), 8)])
    noise = 0.0
    for _ in range(4):
        below = v[v < sky]
        spread = math.sqrt(float(np.mean((below - sky) ** 2))) if below.size else 0.0
        noise = max(spread, 1e-9)
        near = v[np.abs(v - sky) < 2.0 * noise]
        if near.size < 8:
            break
        sky = float(near.mean())
    floor = 0.29 if whole else 1e-6 * max(float(v[-1] - v[0]), 1e-30)
    return sky, max(noise, floor)


def _mode(v: np.ndarray) -> float:
    """The half-sample mode of sorted numbers."""
    while v.size > 3:
        half = (v.size + 1) // 2
        i = int(np.argmin(v[half - 1 :] - v[: v.size - half + 1]))
        v = v[i : i + half]
    return float(v.mean())


def preprocess(image: Image, sigmas: float = FULL_FRAME_SIGMAS) -> Grey:
    """Sky, noise and hot pixels of a frame; P_min = so many sigma above the sky, P_max = the saturation."""
    sky, noise = sky_of(image.array)
    grey = image.array.astype(np.float32) - np.float32(sky)
    p_min = sigmas * noise
    _despike(grey, p_min, noise)
    return Grey(grey, sky, noise, p_min, float(image.saturation) - sky)


def _despike(grey: np.ndarray, p_min: float, noise: float) -> None:
    """Pixels far above all four neighbours are hot, not light that came through optics: they take the neighbours' mean."""
    y, x = np.nonzero(grey > p_min)
    inside = (y > 0) & (x > 0) & (y < grey.shape[0] - 1) & (x < grey.shape[1] - 1)
    y, x = y[inside], x[inside]
    around = 0.25 * (grey[y - 1, x] + grey[y + 1, x] + grey[y, x - 1] + grey[y, x + 1])
    hot = around < 0.03 * grey[y, x] + np.float32(2.0 * noise)
    hot &= grey[y, x] > 10.0 * noise
    grey[y[hot], x[hot]] = around[hot]


def brightness_centroid(grey: np.ndarray, p_min: float, p_max: float = math.inf) -> np.ndarray:
    """(1) over the pixels of (2), (p_cb, l_cb), px; NaN where no pixel is within the limits. grey: (height, width)."""
    y, x = np.nonzero((grey >= p_min) & (grey <= p_max))
    P = grey[y, x].astype(float)
    total = P.sum()
    return np.array([P @ x, P @ y]) / total if total > 0.0 else np.full(2, np.nan)


def centre_of_figure(centroid_px: np.ndarray, factor: float, radius_px: float, sun_angle: float) -> np.ndarray:
    """(3). factor: g. radius_px: R_c. sun_angle: phi, rad, of the Sun's direction in the image from columns to rows."""
    return centroid_px - factor * radius_px * np.array([math.cos(sun_angle), math.sin(sun_angle)])


@dataclass(frozen=True)
class Centroid:
    """status: FOUND or why there is none. xy_px: (2,) in the frame. covariance_px: (2, 2) of noise alone. flux: counts. sky, noise:
    counts. box: (left, top, width, height) of the light in the image. peak: brightest pixel above the sky. full: share of the
    light's pixels that are saturated. others: flux of the next brightest thing over this one's."""

    status: str
    xy_px: np.ndarray
    covariance_px: np.ndarray
    flux: float
    sky: float
    noise: float
    box: tuple[int, int, int, int]
    peak: float
    full: float
    others: float
    message: str = ""


def windowed_centroid(
    image: Image, detector: Detector | None = None, *, corner: tuple[int, int] = (0, 0), near_px: np.ndarray | None = None,
    near_sigma_px: float = math.inf, reach_px: float = 0.0,
) -> Centroid:  # fmt: skip
    """Brightness centroid of the body's light: all pixels within a few px of what is above the noise.

    corner: the frame's pixel that the image's (0, 0) is. near_px: (2,) where it is expected, in the frame, with near_sigma_px.
    reach_px: how far around the brightest spot light belongs to the same body though dark lies between.
    """
    detector = detector or Detector()
    g = preprocess(image)
    expected = None if near_px is None else np.asarray(near_px, float) - corner
    mask, others = _body_mask(g, expected, near_sigma_px, reach_px)
    if mask is None:
        bad, none = np.full(2, np.nan), np.full((2, 2), np.nan)
        text = f"nothing is brighter than {FULL_FRAME_SIGMAS:g} sigma of the noise"
        return Centroid(NO_BODY, bad, none, 0.0, g.sky, g.noise, (0, 0, 0, 0), 0.0, 0.0, 0.0, text)
    (top, left), part = mask
    grow = math.ceil(3.0 * detector.psf_sigma_px) + 2
    y0, x0 = max(top - grow, 0), max(left - grow, 0)
    y1, x1 = min(top + part.shape[0] + grow, image.height), min(left + part.shape[1] + grow, image.width)
    aperture = np.zeros((y1 - y0, x1 - x0), bool)
    aperture[top - y0 : top - y0 + part.shape[0], left - x0 : left - x0 + part.shape[1]] = part
    full = float(np.mean(image.array[top : top + part.shape[0], left : left + part.shape[1]][part] >= image.saturation))
    aperture = binary_dilation(aperture, _disc(grow))
    grey = np.where(aperture, g.grey[y0:y1, x0:x1], 0.0).astype(float)
    cols, rows = grey.sum(axis=0), grey.sum(axis=1)
    flux = float(cols.sum())
    x, y = np.arange(x0, x1), np.arange(y0, y1)
    if not flux > 0.0:
        none = np.full((2, 2), np.nan)
        return Centroid(NO_BODY, np.full(2, np.nan), none, flux, g.sky, g.noise, (0, 0, 0, 0), 0.0, full, others)
    xy = np.array([cols @ x, rows @ y]) / flux
    shot = 1.0 / (detector.gain_e or 1.0)
    variance = np.where(aperture, g.noise**2 + shot * np.maximum(grey, 0.0), 0.0)
    dx, dy = x - xy[0], y - xy[1]
    V = np.array([[variance.sum(0) @ dx**2, dy @ variance @ dx], [0.0, variance.sum(1) @ dy**2]])
    V[1, 0] = V[0, 1]
    # The sky itself is known as well as its sample: it pulls the centroid towards the middle of the aperture.
    pull = np.array([aperture.sum(0) @ dx, aperture.sum(1) @ dy]) * g.noise / math.sqrt(min(image.array.size, _SAMPLE))
    covariance = (V + np.outer(pull, pull)) / flux**2
    snr = flux / math.sqrt(float(variance.sum()))
    peak = float(grey.max())
    box = (int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    status, message = FOUND, ""
    # What is beyond the edge would have been dilated into: light that touches the edge goes on there.
    touches = left <= 0 or top <= 0 or left + part.shape[1] >= image.width or top + part.shape[0] >= image.height
    if touches:
        status, message = CUT, "its light reaches the edge of the image"
    elif full > 0.01:
        status, message = SATURATED, f"{100 * full:.0f}% of its pixels are full"
    elif snr < _LEAST_SNR:
        status, message = DARK, f"its light is only {snr:.1f} times the noise"
    elif others > 0.5 and near_px is None:
        status, message = (
            AMBIGUOUS,
            f"another light in the image is {others:.2f} times as bright; say where it is expected",
        )
    return Centroid(status, xy + corner, covariance, flux, g.sky, g.noise, box, peak, full, others, message)


def _disc(radius: int) -> np.ndarray:
    d = np.arange(-radius, radius + 1)
    return d[:, None] ** 2 + d[None, :] ** 2 <= radius**2


def _body_mask(
    g: Grey, expected: np.ndarray | None, sigma: float, reach: float
) -> tuple[tuple[tuple[int, int], np.ndarray] | None, float]:
    """The body's pixels above P_min as ((top, left), bool array), and the flux of the next brightest thing over its own."""
    above = g.grey > g.p_min
    labelled: Any = label(above, np.ones((3, 3), int))
    names, count = labelled
    if not count:
        return None, 0.0
    at = np.flatnonzero(above)
    which = names.ravel()[at]
    P = g.grey.ravel()[at].astype(float)
    flux = np.bincount(which, P, count + 1)[1:]
    y, x = np.divmod(at, g.grey.shape[1])
    cx, cy = np.bincount(which, P * x, count + 1)[1:] / flux, np.bincount(which, P * y, count + 1)[1:] / flux
    rank = np.log(flux)
    if expected is not None and math.isfinite(sigma):
        away = np.maximum(np.hypot(cx - expected[0], cy - expected[1]) - reach, 0.0) / max(sigma, 1.0)
        rank = np.where(away < 5.0, rank - 0.5 * away**2, -np.inf)
        if not np.isfinite(rank).any():
            return None, 0.0
    best = int(np.argmax(rank))
    # Craters and shadows part the light of one body: what lies within its reach belongs to it.
    mine = np.hypot(cx - cx[best], cy - cy[best]) <= reach
    mine[best] = True
    other = float(flux[~mine].max() / flux[mine].sum()) if (~mine).any() else 0.0
    slices = [s for s, m in zip(find_objects(names), mine) if m and s is not None]
    top, left = min(s[0].start for s in slices), min(s[1].start for s in slices)
    bottom, right = max(s[0].stop for s in slices), max(s[1].stop for s in slices)
    chosen = np.concatenate([[False], mine])[names[top:bottom, left:right]]
    return ((top, left), chosen), other


def model_nodes(camera: Camera, shape: Shape, r_TC_C: np.ndarray, pose: Pose) -> Nodes:
    """Points of the lit and seen surface, of whatever figure."""
    if isinstance(shape, Ellipsoid):
        return nodes(camera, shape, r_TC_C, pose.R_TC, pose.sun_C)
    from .raster import mesh_nodes

    return mesh_nodes(camera, shape, r_TC_C, pose.R_TC, pose.sun_C)


def offsets(camera: Camera, target: Target, pose: Pose, centre_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the brightness centroid lies off the centre, (2,) px, for the target's law (without one, the mean of LAWS_TRIED), and
    its covariance (2, 2), px^2, from what is not known of law, size and shape. NaN where nothing of it is lit."""
    points = model_nodes(camera, target.shape, pose.position(camera, centre_px), pose)
    tried = np.array([points.moment(law)[1] for law in LAWS_TRIED]) - centre_px
    if target.law is None:
        offset = tried.mean(axis=0)
    else:
        offset = points.moment(target.law)[1] - centre_px
    C = np.zeros((2, 2))
    if not target.law_known:
        C += (tried - offset).T @ (tried - offset) / len(tried)
    C += np.outer(offset, offset) * pose.scale_sigma(target) ** 2
    C += np.eye(2) * (_SHAPE_GAIN * target.shape_sigma) ** 2 * float(offset @ offset)
    if target.albedo_sigma > 0.0:
        C += target.albedo_sigma**2 * _spots(points, target.law or LAWS_TRIED[0], camera, target, pose)
    return offset, C


def _spots(points: Nodes, law: Law, camera: Camera, target: Target, pose: Pose) -> np.ndarray:
    """Covariance (2, 2), px^2, of the centroid where spots SPOT of the diameter across are brighter by 1, each for itself."""
    light = points.light(law)
    total = float(light.sum())
    if not total > 0.0:
        return np.zeros((2, 2))
    side = SPOT * 2.0 * target.shape.mean_radius * camera.focal_px / pose.distance
    place = np.floor((points.xy_px - points.xy_px.min(axis=0)) / side).astype(int)
    spot = place[:, 0] + (place[:, 0].max() + 1) * place[:, 1]
    pull = light[:, None] * (points.xy_px - light @ points.xy_px / total) / total
    of_each = np.stack([np.bincount(spot, p) for p in pull.T], axis=1)
    return of_each.T @ of_each


def centre_from_moment(
    image: Image, camera: Camera, target: Target, pose: Pose, detector: Detector | None = None, *,
    corner: tuple[int, int] = (0, 0),
) -> FigureCentre:  # fmt: skip
    """Centre of figure from the windowed centroid and the model's offset. corner: the frame's pixel that the image's (0, 0) is."""
    diameter = 2.0 * target.shape.mean_radius * camera.focal_px / pose.distance
    c = windowed_centroid(
        image, detector, corner=corner, near_px=pose.near_px, near_sigma_px=pose.near_sigma_px + 0.5 * diameter,
        reach_px=0.6 * diameter * target.shape.reach / target.shape.mean_radius,
    )  # fmt: skip
    return centre_of_centroid(c, camera, target, pose)


def centre_of_centroid(c: Centroid, camera: Camera, target: Target, pose: Pose) -> FigureCentre:
    """Centre of figure of a centroid that was measured."""
    diameter = 2.0 * target.shape.mean_radius * camera.focal_px / pose.distance
    if c.status != FOUND:
        return FigureCentre(
            c.status, "moment", np.full(2, np.nan), np.full((2, 2), np.nan), c.xy_px, diameter, message=c.message
        )
    centre, C = c.xy_px, np.zeros((2, 2))
    for _ in range(2):
        offset, C = offsets(camera, target, pose, centre)
        if not np.isfinite(offset).all():
            return nothing(
                DARK, "moment", "the side that faces the camera is not lit: is the Sun's direction right?", diameter
            )
        centre = c.xy_px - offset
    sigma = pose.scale_sigma(target)
    return FigureCentre(
        FOUND, "moment", centre, c.covariance_px + C, c.xy_px, diameter, 1.0, sigma, message=c.message, common_px=C
    )


__all__ = [
    "FULL_FRAME_SIGMAS", "LAWS_TRIED", "Centroid", "Grey", "brightness_centroid", "centre_from_moment", "centre_of_centroid",
    "centre_of_figure", "model_nodes", "offsets", "preprocess", "sky_of", "windowed_centroid",
]  # fmt: skip
