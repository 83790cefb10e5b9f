"""A realistic frame of a star tracker with its truth: what the optics and the sensor do to known stars.

Light is counted in photo-electrons: each star spreads over a Gaussian, integrated over pixels, drawn out along its path when the
camera turns; sky, glow and dark current are added; then Poisson noise, hot pixels, the full well, read noise, and the converter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from .camera import Camera
from .frame import Image

_REACH = 5.0  # sigma of the point spread that are drawn
_CHUNK = 2_000_000  # numbers in the windows of stars that are drawn together
_MAX_STEPS = 400


@dataclass(frozen=True)
class Glow:
    """Stray light like that of the moon or of a lit horizon: x_px, y_px its middle (also outside), peak_e electrons, sigma_px."""

    x_px: float
    y_px: float
    peak_e: float
    sigma_px: float


@dataclass(frozen=True)
class Exposure:
    """How a frame is taken.

    duration: s. zero_point_e_s: electrons per second of a star of magnitude 0. psf_sigma_px: sigma of the optics.
    omega_SN_S: rate of the camera, rad/s, in S, constant over the exposure. sky_e_s, dark_e_s: electrons per second and pixel.
    gradient_e_px: sky's rise per pixel along (x, y), electrons. glow: stray lights. read_noise_e: sigma, electrons.
    hot_fraction: share of pixels with an extra dark current, exponentially distributed with mean hot_e_s. full_well_e: electrons.
    gain_e: electrons per count. offset: counts at no light. bits: of the converter, 8 to 16. poisson: whether light is noisy.
    """

    duration: float = 0.2
    zero_point_e_s: float = 2.0e6
    psf_sigma_px: float = 0.8
    omega_SN_S: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sky_e_s: float = 20.0
    gradient_e_px: tuple[float, float] = (0.0, 0.0)
    glow: tuple[Glow, ...] = ()
    dark_e_s: float = 5.0
    hot_fraction: float = 0.0
    hot_e_s: float = 2000.0
    read_noise_e: float = 5.0
    full_well_e: float = 20_000.0
    gain_e: float = 5.0
    offset: float = 50.0
    bits: int = 12
    poisson: bool = True

    def __post_init__(self) -> None:
        for name in ("duration", "zero_point_e_s", "psf_sigma_px", "full_well_e", "gain_e"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} {value}: must be positive")
        for name in ("sky_e_s", "dark_e_s", "hot_fraction", "hot_e_s", "read_noise_e", "offset"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} {value}: must not be negative")
        if not 0.1 <= self.psf_sigma_px <= 50.0:
            raise ValueError(f"psf_sigma_px {self.psf_sigma_px}: must be 0.1 to 50")
        if self.hot_fraction > 1.0:
            raise ValueError(f"hot_fraction {self.hot_fraction}: must be 0 to 1")
        if self.bits not in range(8, 17):
            raise ValueError(f"bits {self.bits}: must be 8 to 16")


@dataclass(frozen=True)
class Truth:
    """Stars on a rendered frame, arrays of n: index into the stars that were given, place at mid-exposure, electrons."""

    index: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    electrons: np.ndarray


def render(
    camera: Camera,
    q_SN: np.ndarray,
    directions_N: np.ndarray,
    magnitude: np.ndarray,
    exposure: Exposure | None = None,
    seed: int = 0,
) -> tuple[Image, Truth]:
    """A frame and its truth.

    q_SN: (4,) attitude at mid-exposure, scalar last. directions_N: (n, 3) unit vectors. magnitude: (n,). The image is uint8 for 8
    bits, uint16 otherwise; equal seeds give equal frames. Raises ValueError for shapes that do not fit.
    """
    from scipy.spatial.transform import Rotation

    e = exposure or Exposure()
    directions, magnitude = np.asarray(directions_N, float), np.asarray(magnitude, float)
    if directions.ndim != 2 or directions.shape[1] != 3 or magnitude.shape != directions.shape[:1]:
        raise ValueError(f"directions_N {directions.shape} and magnitude {magnitude.shape}: must be (n, 3) and (n,)")
    d_S = directions @ Rotation.from_quat(q_SN).as_matrix().T
    margin = _REACH * e.psf_sigma_px + _travel(camera, e)
    place = camera.pixels(d_S)
    seen = np.flatnonzero(camera.inside(place, -margin))
    electrons = e.zero_point_e_s * e.duration * 10.0 ** (-0.4 * magnitude[seen])
    light = _background(camera, e)
    _add_stars(light, camera, d_S[seen], electrons, e)
    image = sensor_counts(light, e, np.random.default_rng(seed))
    on = camera.inside(place[seen])
    return image, Truth(seen[on], place[seen][on, 0], place[seen][on, 1], electrons[on])


def pointed(camera: Camera, ra: float, dec: float, roll: float) -> np.ndarray:
    """Attitude q_SN (4,) with which the image's geometric centre looks at right ascension and declination (rad, ICRS) and north
    there is seen at `roll` (rad) from image up (-y), counter-clockwise; the inverse of sensors.star_tracker.centre_angles.

    At a pole north is the way along the meridian of `ra`. Raises ValueError for angles that are not finite.
    """
    from scipy.spatial.transform import Rotation

    if not all(map(math.isfinite, (ra, dec, roll))):
        raise ValueError(f"ra {ra}, dec {dec}, roll {roll}: must be finite angles")
    centre = np.array(camera.geometric_centre_px)
    z_S = camera.directions(centre)
    step = camera.directions(centre + 1e-3 * np.array([-math.sin(roll), -math.cos(roll) / camera.aspect])) - z_S
    north_S = step - (step @ z_S) * z_S
    north_S /= np.linalg.norm(north_S)
    sa, ca, sd, cd = math.sin(ra), math.cos(ra), math.sin(dec), math.cos(dec)
    z_N, north_N = np.array([ca * cd, sa * cd, sd]), np.array([-ca * sd, -sa * sd, cd])
    in_S, in_N = (np.stack([a, b, np.cross(a, b)], axis=1) for a, b in ((z_S, north_S), (z_N, north_N)))
    return Rotation.from_matrix(in_S @ in_N.T).as_quat()


def turned(q_SN: np.ndarray, omega_SN_S: np.ndarray, time: float) -> np.ndarray:
    """Attitude (4,) after a time (s) of a constant rate (3,) rad/s, in S: R(t) = exp(-[omega t x]) R(0)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_rotvec(-time * np.asarray(omega_SN_S, float)) * Rotation.from_quat(q_SN)).as_quat()


def longest_smear(camera: Camera, exposure: Exposure) -> float:
    """Bound of the length of a star's path over the exposure, px."""
    return 2.0 * _travel(camera, exposure)


def _travel(camera: Camera, e: Exposure) -> float:
    """Bound of half a star's path, px, over the exposure."""
    corner = math.hypot(camera.width, camera.height / min(camera.aspect, 1.0)) / 2
    wx, wy, wz = e.omega_SN_S
    across = math.hypot(wx, wy) * camera.focal_px * (1 + (corner / camera.focal_px) ** 2) / min(camera.aspect, 1.0)
    return 0.5 * e.duration * (across + abs(wz) * corner)


def _background(camera: Camera, e: Exposure) -> np.ndarray:
    """Mean electrons without stars, (height, width) float32."""
    x, y = np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)
    cx, cy = camera.geometric_centre_px
    gx, gy = e.gradient_e_px
    flat = (e.sky_e_s + e.dark_e_s) * e.duration
    light = (flat + gy * (y - cy))[:, None] + (gx * (x - cx))[None, :]
    for g in e.glow:
        s = 2.0 * g.sigma_px**2
        light += g.peak_e * np.exp(-((y - g.y_px) ** 2) / s)[:, None] * np.exp(-((x - g.x_px) ** 2) / s)[None, :]
    return np.maximum(light, 0.0).astype(np.float32)


def _add_stars(light: np.ndarray, camera: Camera, d_S: np.ndarray, electrons: np.ndarray, e: Exposure) -> None:
    """Add stars (n) to the light, in windows that hold their whole path."""
    from scipy.spatial.transform import Rotation

    if not len(d_S):
        return
    travel, sigma = _travel(camera, e), e.psf_sigma_px
    steps = min(_MAX_STEPS, 1 + 2 * math.ceil(2.0 * travel / sigma))
    # The middle of each part of the exposure, from -1/2 to 1/2; a direction in S turns against the camera.
    times = ((np.arange(steps) + 0.5) / steps - 0.5) * e.duration
    paths = np.stack(
        [camera.pixels(Rotation.from_rotvec(-t * np.array(e.omega_SN_S)).apply(d_S)) for t in times], axis=1
    )
    half = math.ceil(_REACH * sigma + travel) + 1
    d = np.arange(-half, half + 2) - 0.5
    chunk = max(1, _CHUNK // (steps * (2 * half + 2) + (2 * half + 1) ** 2))
    for i in range(0, len(d_S), chunk):
        path = paths[i : i + chunk]
        middle = np.rint(np.nanmean(path, axis=1)).astype(int)
        t = (d - (path - middle[:, None])[..., None]) / (np.sqrt(2.0) * sigma)
        share = 0.5 * np.diff(erf(t), axis=-1)  # (stars, steps, 2, m)
        np.nan_to_num(share, copy=False)  # a star that leaves the lens's reach on its way
        window = np.einsum("nky,nkx->nyx", share[:, :, 1], share[:, :, 0], optimize=True)
        window *= (electrons[i : i + chunk] / steps)[:, None, None]
        rows, columns = middle[:, 1, None] + d[:-1] + 0.5, middle[:, 0, None] + d[:-1] + 0.5
        rows, columns = rows.astype(int)[:, :, None], columns.astype(int)[:, None, :]
        on = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
        np.add.at(light.reshape(-1), (rows * camera.width + columns)[on], window[on].astype(np.float32))


def sensor_counts(light: np.ndarray, e: Exposure, rng: np.random.Generator) -> Image:
    """A frame from the mean electrons of its pixels: hot pixels, shot noise, full well, read noise, gain, offset, whole counts.

    light: (height, width) float32, electrons, at least 0; hot pixels are added to it in place. rng: in this order hot pixels, shot
    noise, read noise. The frame's saturation is the well's or the converter's, in counts, whichever is lower.
    """
    hot = round(e.hot_fraction * light.size)
    if hot:
        at = rng.choice(light.size, hot, replace=False)
        light.reshape(-1)[at] += (rng.exponential(e.hot_e_s, hot) * e.duration).astype(np.float32)
    signal = rng.poisson(light).astype(np.float32) if e.poisson else light
    signal = np.minimum(signal, np.float32(e.full_well_e))
    if e.read_noise_e:
        signal = signal + np.float32(e.read_noise_e) * rng.standard_normal(light.shape, dtype=np.float32)
    top = (1 << e.bits) - 1
    counts = np.clip(np.rint(signal * np.float32(1.0 / e.gain_e) + np.float32(e.offset)), 0, top)
    kind = np.uint8 if e.bits == 8 else np.uint16
    saturation = min(float(top), e.full_well_e / e.gain_e + e.offset)
    return Image(counts.astype(kind), saturation, e.bits, {"format": "rendered"})


__all__ = ["Exposure", "Glow", "Truth", "longest_smear", "pointed", "render", "sensor_counts", "turned"]
