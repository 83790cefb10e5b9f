"""A star tracker: from an image to an attitude with covariance. No JAX: the first solution comes quickly.

    tracker = StarTracker(camera)                        # or StarTracker(fov_deg=(5, 25)) where it is not known
    found = tracker.solve(image)
    found.identification.q_SN, found.ra_deg, found.status

Frames: S is the camera's (z boresight, x right, y down; see imaging.camera), B the body's: v_S = R_SB v_B. Without a time the
catalogue stands at J2000 and nothing is aberrated; with one, stars have moved to it, and directions are those that an
observer on Earth sees.
"""

from __future__ import annotations

import math
import time
from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ..imaging import Camera, Centroids, DetectionSettings, Image
from ..imaging.calibrated import Calibrated
from ..imaging.coarser import showing_more
from ..imaging.detect import Optics, detect_near, detect_next
from ..stars.catalog import Catalog, load_catalog
from ..stars.doubt import (
    ODDS,
    ROUGH_WIDTHS,
    ROUGH_WORK,
    Doubt,
    against,
    identify_uncalibrated,
    magnitude_of_order,
    roughened,
)
from ..stars.glance import follow, glance
from ..stars.identify import LIMIT, WORK, Identification, identify, matrix_of_quaternion, unit_quaternion
from ..stars.patterns import Sky
from ..stars.pinhole import Pinhole
from ..stars.track import WIDEST_PX, track
from .displaced import displaced, displaced_px, smoothly
from .lens import LensPrior
from .refine import EPOCH_SPREAD_YEARS, Refined, refine

FOCAL_SIGMA = 0.005
"""1 sigma, relative, of a focal length that stands for a stated field of view."""
CALIBRATED_SIGMA = 0.0005
"""The same of a calibrated camera."""
ROUGH_SCALE = 1.5
"""Factor on the centroids' sigmas from which a fit says that the lens displaces stars, not noise."""
ROUGH_STRAIN = 2.5
"""Sigmas of the usual lens's prior from which its centre, k1, p1 or p2 is not that of a usual lens."""
BRIGHTEST, BRIGHT_SHARE = 12, 0.75
"""Of so many detections, the brightest, a fit that is beyond doubt explains this share."""
COARSER_TRIED = 2
"""Means of pixels that are tried where an image is not solved."""
TRAILED = 2.0
"""Median of the stars' elongation from which an attitude may be that of ends of trails: means are tried then too."""
TRACKED = 50
"""Stars whose windows are looked at in tracking."""


@dataclass(frozen=True)
class StarSolution:
    """What became of an image. camera: with the focal length, k1, p1 and p2 found; ms: milliseconds by stage; ra_deg, dec_deg: the
    direction at the image's geometric centre, roll_deg: north's angle from image up there, counter-clockwise; NaN
    where it is not solved. sigma_arcsec (3,): about x, y and z of S. scale: factor on the centroids' sigmas that the residuals
    show and that the covariance holds. doubt: what had to be doubted for it (`stars.doubt`). averaged_px: side of the squares of
    pixels whose means showed the stars, 1 where the pixels did."""

    identification: Identification
    centroids: Centroids
    camera: Camera
    ra_deg: float
    dec_deg: float
    roll_deg: float
    sigma_arcsec: np.ndarray
    ms: dict[str, float]
    scale: float = 1.0
    doubt: Doubt = ""
    averaged_px: int = 1

    @property
    def status(self) -> str:
        """That of the identification."""
        return self.identification.status

    @property
    def solved(self) -> bool:
        """Whether there is an attitude."""
        return self.identification.solved


@dataclass(frozen=True)
class Memory:
    """What a frame tells of the next: its size (width, height), the optics, and the camera as fitted, where it was solved."""

    size: tuple[int, int]
    optics: Optics | None
    camera: Camera | None


class StarTracker:
    """Camera, catalogue and limits, ready for images.

    camera: a Camera, or Calibrated with what its calibration says; or fov_deg: the horizontal full field, a number or a range
    (low, high), with `aspect`, pixel height over width. julian_year: of the stars' places; None is 2000 for images of an
    unknown time, whose stars have moved: their proper motion then counts as uncertainty. velocity_c (3,): the
    observer's barycentric velocity in N over that of light, for aberration; position_au (3,): its barycentric position in
    N, for parallax. q_SB (4,): mounting. limit: largest probability that a solution is false. catalog: other stars than
    Hipparcos's.
    """

    def __init__(
        self,
        camera: Camera | Calibrated | None = None,
        *,
        fov_deg: float | tuple[float, float] | None = None,
        aspect: float = 1.0,
        julian_year: float | None = None,
        velocity_c: np.ndarray | None = None,
        position_au: np.ndarray | None = None,
        catalog: Catalog | None = None,
        q_SB: np.ndarray | None = None,
        limit: float = LIMIT,
        detection: DetectionSettings | None = None,
    ):
        if (camera is None) == (fov_deg is None):
            raise ValueError("give either a camera or a field of view")
        self.known = Calibrated(camera) if isinstance(camera, Camera) else camera
        self.camera = None if self.known is None else self.known.camera
        self.fov_deg, self.aspect = fov_deg, aspect
        self.epoch_years = EPOCH_SPREAD_YEARS if julian_year is None else 0.0
        julian_year = 2000.0 if julian_year is None else julian_year
        self.q_SB, self.limit = q_SB, limit
        self.memory: Memory | None = None
        self.detection = detection or DetectionSettings()
        if catalog is None:
            self.sky = _sky(julian_year, _plain(velocity_c), _plain(position_au))
        else:
            self.sky = Sky(catalog, julian_year, velocity_c, position_au)

    def with_camera(self, known: Calibrated) -> StarTracker:
        """The same with another camera."""
        other = copy(self)
        other.known, other.camera, other.fov_deg, other.memory = known, known.camera, None, None
        return other

    def solve(
        self, image: Image, *, prior_q_SN: np.ndarray | None = None, prior_sigma: float | None = None
    ) -> StarSolution:
        """Detect, identify and solve for the attitude: without a prior, or tracking from prior_q_SN (4,), good to prior_sigma
        (rad, per axis), with the whole sky as what remains where that fails. The solution does not contain the prior.

        Of the frame before, `memory` keeps the width of the stars and the camera that was found: detection then searches no
        coarser scale than needed and, with a prior, only where the brightest stars are expected. Set it to None to forget.

        Raises ValueError for an image of another size than the camera's, and for a prior that means nothing.
        """
        begin = time.perf_counter()
        size, dark = (image.width, image.height), None if self.known is None else self.known.dark
        last = self.memory if self.memory is not None and self.memory.size == size else None
        if prior_q_SN is not None and prior_sigma is not None and last is not None and last.optics is not None:
            centroids = self._in_windows(image, prior_q_SN, prior_sigma, last, dark)
            if centroids is not None:
                ms = {"detect": 1e3 * (time.perf_counter() - begin)}
                found = self.identified(centroids, *size, prior_q_SN, prior_sigma, ms, fall_back=False)
                if found.solved:
                    self.memory = replace(last, camera=found.camera)
                    return found
        known = None if last is None else last.optics
        centroids, optics = detect_next(image, self.detection, dark, known)
        ms = {"detect": 1e3 * (time.perf_counter() - begin)}
        found = self.identified(centroids, *size, prior_q_SN, prior_sigma, ms)
        if not found.solved and known is not None:  # what was remembered may be what was wrong
            again = time.perf_counter()
            centroids, optics = detect_next(image, self.detection, dark)
            if len(centroids) != len(found.centroids) or optics != known:
                ms = {"detect": ms["detect"] + 1e3 * (time.perf_counter() - again)}
                found = self.identified(centroids, *size, prior_q_SN, prior_sigma, ms)
        self.memory = Memory(size, optics, found.camera if found.solved else None)
        trailed = len(centroids) > 0 and float(np.median(centroids.elongation)) > TRAILED
        return self._coarser(image, found, dark) if trailed or not found.solved else found

    def _coarser(self, image: Image, found: StarSolution, dark: np.ndarray | None) -> StarSolution:
        """From means of pixels, where they show more stars than the pixels did: smeared and badly focused ones; the means of most
        stars first, at odds against each and with little work. The covariance holds half a streak or more, by its elongation.
        Otherwise what was found, with the work and the time."""
        sceptic, begin, work = copy(self), time.perf_counter(), found.identification.work
        likely = showing_more(image, len(found.centroids), self.detection, dark)[:COARSER_TRIED]
        answer = found
        for tried, (step, centroids) in enumerate(likely, start=1):
            sceptic.limit /= ODDS
            other = sceptic.identified(centroids, image.width, image.height, work=ROUGH_WORK)
            i = against(other.identification, tried, work)
            work = i.work
            if other.solved:
                long_px = step * float(np.median(centroids.elongation[i.detections]))
                i = smoothly(i, long_px, other.camera)
                answer = _solution(i, centroids, other.camera, {}, other.scale, other.doubt, step)
                break
        spent = 1e3 * (time.perf_counter() - begin)
        ms = {**found.ms, "coarser": spent, "total": found.ms["total"] + spent}
        return replace(answer, identification=replace(answer.identification, work=work), ms=ms)

    def _in_windows(
        self, image: Image, prior_q_SN: np.ndarray, prior_sigma: float, last: Memory, dark: np.ndarray | None
    ) -> Centroids | None:
        """What is seen where the prior has the brightest stars; None where the windows would be too wide or too few."""
        camera = last.camera or self.camera
        if camera is None or last.optics is None:
            return None
        q = unit_quaternion("prior_q_SN", prior_q_SN)
        reach = 3.6 * prior_sigma * camera.focal_px + 2.0
        if not reach <= WIDEST_PX:
            return None
        R = matrix_of_quaternion(q)
        radius = 0.5 * math.hypot(camera.width, camera.height * camera.aspect) / camera.focal_px
        near = self.sky.around(R[2], math.atan(radius))
        xy = camera.pixels(self.sky.directions[near[: 2 * TRACKED]] @ R.T)
        xy = xy[camera.inside(xy)][:TRACKED]
        return detect_near(image, xy, reach, last.optics, self.detection, dark) if len(xy) >= 4 else None

    def identified(
        self, centroids: Centroids, width: int, height: int, prior_q_SN: np.ndarray | None = None,
        prior_sigma: float | None = None, ms: dict[str, float] | None = None, fall_back: bool = True, work: int = WORK,
    ) -> StarSolution:  # fmt: skip
        """As `solve`, from the stars that were detected. ms: milliseconds of what went before; fall_back: whether the whole sky is
        searched where tracking fails; work: as for `identify`."""
        begin = time.perf_counter()
        centroids = self._honest(centroids)
        camera, fov_range, focal_sigma = self._optics(width, height)
        # Identification counts pixels from their edges, images from their centres.
        eye = Pinhole(
            focal_px=camera.focal_px, centre_px=(camera.cx + 0.5, camera.cy + 0.5), aspect=camera.aspect,
            distortion=camera.distortion, size_px=(camera.width, camera.height),
        )  # fmt: skip
        prior = (
            None if prior_q_SN is None or prior_sigma is None or fov_range is not None else (prior_q_SN, prior_sigma)
        )
        seen = (centroids.xy_px + 0.5, centroids.flux, centroids.covariance_px, eye, self.sky, focal_sigma, self.limit)
        found, doubt = None, ""
        if prior is not None:
            found = follow(*seen, *prior, self.q_SB)
        elif fov_range is None:
            found = glance(*seen, self.q_SB)
        stars = {
            "flux": centroids.flux, "sigma_px": centroids.covariance_px, "focal_sigma": focal_sigma, "q_SB": self.q_SB,
            "sky": self.sky, "limit": self.limit,
        }  # fmt: skip
        if found is None and prior is not None:
            calibrated = self.camera is not None
            found = track(centroids.xy_px + 0.5, eye, *prior, fall_back=fall_back and calibrated, **stars)
            if not found.solved and fall_back and not calibrated:
                found = None
        if found is None and self.camera is not None:
            found = identify(centroids.xy_px + 0.5, eye, work=work, **stars)
        elif found is None:
            found, doubt = identify_uncalibrated(centroids.xy_px + 0.5, eye, fov_range=fov_range, work=work, **stars)
        done = time.perf_counter()
        scale = 1.0
        if found.solved:
            refined, doubt = self._refined(
                found, centroids, camera, focal_sigma if fov_range is None else math.inf, doubt
            )
            found, camera, scale = refined.identification, refined.camera, refined.scale
            if isinstance(self.fov_deg, float | int) and self.camera is None:
                off = math.log(camera.focal_px / eye.focal_px)
                if abs(off) > 5.0 * focal_sigma and "field" not in doubt:
                    doubt = "rough, field" if doubt == "rough" else "field"
        end = time.perf_counter()
        ms = {**(ms or {}), "identify": 1e3 * (done - begin), "refine": 1e3 * (end - done)}
        ms["total"] = sum(ms.values())
        return _solution(found, centroids, camera, ms, scale, doubt)

    def _refined(
        self, found: Identification, centroids: Centroids, camera: Camera, focal_sigma: float, doubt: Doubt
    ) -> tuple[Refined, Doubt]:
        """The last fit, within what is known of the lens, and what had to be doubted for it."""
        if self.known is not None:
            lens = LensPrior.calibrated(self.known)
            fit = refine(found, centroids, camera, self.sky, lens, self.epoch_years)
            i = smoothly(fit.identification, self.known.smooth_px, fit.camera)
            return replace(fit, identification=i), doubt
        near = replace(camera, focal_px=found.focal_px)  # what a lens may be is told at the corner of its field
        if "field" in doubt:  # the fit must not lean on a statement that was wrong
            focal_sigma = math.inf
        first, floor = None, ROUGH_WIDTHS * camera.width
        if doubt != "rough":
            lens = LensPrior.uncalibrated(near, focal_sigma)
            first = refine(found, centroids, camera, self.sky, lens, self.epoch_years)
            plain = _bright_share(first, centroids) >= BRIGHT_SHARE
            if first.scale < ROUGH_SCALE and first.strain < ROUGH_STRAIN and plain:
                return first, doubt
            if plain:
                floor = displaced_px(first, floor)
        lens, magnitude = LensPrior.rough(near, focal_sigma), magnitude_of_order(centroids.flux)
        rough = None
        for _ in range(2):  # the second time with what the stars are displaced by indeed
            C = roughened(centroids.covariance_px, len(centroids), floor)
            places = replace(centroids, covariance_px=C)
            rough = refine(found, places, camera, self.sky, lens, self.epoch_years, magnitude)
            floor = displaced_px(rough, floor)
        assert rough is not None
        if first is not None:
            told, more = len(first.identification.stars), len(rough.identification.stars)
            # False stars are no reason to doubt a camera, nor is a fit that came to nothing.
            few = first.scale < ROUGH_SCALE and first.strain < ROUGH_STRAIN and more < 1.4 * told + 1
            if few or rough.identification is found:
                return first, doubt
        return displaced(rough, centroids, camera, self.sky, lens), "rough" if doubt != "field" else "rough, field"

    def _honest(self, centroids: Centroids) -> Centroids:
        """With the covariances that the calibration found."""
        known = self.known
        if known is None or (known.centroid_scale == 1.0 and known.centroid_floor_px == 0.0):
            return centroids
        C = known.centroid_scale**2 * centroids.covariance_px + known.centroid_floor_px**2 * np.eye(2)
        return replace(centroids, covariance_px=C)

    def _optics(self, width: int, height: int) -> tuple[Camera, tuple[float, float] | None, float]:
        """Camera of an image, range of its field (rad) or None, relative sigma of its focal length."""
        if self.camera is not None:
            if (self.camera.width, self.camera.height) != (width, height):
                raise ValueError(
                    f"image of {width} x {height} pixels, but the camera has {self.camera.width} x {self.camera.height}"
                )
            return self.camera, None, CALIBRATED_SIGMA
        if isinstance(self.fov_deg, tuple):
            low, high = self.fov_deg
            camera = _of_field(math.sqrt(low * high), width, height, self.aspect)
            return camera, (math.radians(low), math.radians(high)), FOCAL_SIGMA
        assert self.fov_deg is not None
        return _of_field(self.fov_deg, width, height, self.aspect), None, FOCAL_SIGMA


_of_field = cache(Camera.from_fov)


def _bright_share(fit: Refined, centroids: Centroids) -> float:
    """Share of the brightest detections that a fit explains: the flux comes sorted."""
    count = min(len(centroids), BRIGHTEST)
    return np.count_nonzero(fit.identification.detections < count) / max(count, 1)


def _plain(vector: np.ndarray | None) -> tuple[float, ...] | None:
    return None if vector is None else tuple(float(v) for v in vector)


@cache
def _sky(year: float, velocity_c: tuple[float, ...] | None, position_au: tuple[float, ...] | None) -> Sky:
    velocity, position = (None if v is None else np.array(v) for v in (velocity_c, position_au))
    return Sky(load_catalog(), year, velocity, position)


def _solution(
    found: Identification, centroids: Centroids, camera: Camera, ms: dict[str, float], scale: float,
    doubt: Doubt, averaged_px: int = 1,
) -> StarSolution:  # fmt: skip
    nan = float("nan")
    if not found.solved:
        return StarSolution(found, centroids, camera, nan, nan, nan, np.full(3, nan), ms, doubt=doubt)
    ra, dec, roll = centre_angles(camera, matrix_of_quaternion(found.q_SN))
    sigma = np.degrees(np.sqrt(np.diagonal(found.covariance))) * 3600.0
    return StarSolution(found, centroids, camera, ra, dec, roll, sigma, ms, scale, doubt, averaged_px)


def centre_angles(camera: Camera, R_SN: np.ndarray) -> tuple[float, float, float]:
    """Right ascension, declination and roll in deg of the image's geometric centre: roll is north's direction there, from
    image up (-y), counter-clockwise as seen in the image."""
    x, y = camera.plane(*camera.geometric_centre_px)
    length, R = math.sqrt(x * x + y * y + 1.0), R_SN.tolist()
    z = [(x * a + y * b + c) / length for a, b, c in zip(*R)]
    # A step north on the sky, seen in the image through the derivative of x/z, y/z and of the distortion. At a pole north is
    # everywhere; the limit along the step is taken.
    v = [R[k][2] - z[2] * u / length for k, u in enumerate((x, y, 1.0))]
    px, py = v[0] - x * v[2], v[1] - y * v[2]
    _, _, xx, xy, yx, yy = camera.distort(x, y)
    dx, dy = xx * px + xy * py, yx * px + yy * py
    roll = _turn(math.degrees(math.atan2(-dx, -dy)))
    return _turn(math.degrees(math.atan2(z[1], z[0]))), math.degrees(math.asin(max(-1.0, min(1.0, z[2])))), roll


def _turn(angle: float) -> float:
    """In [0, 360) deg: a remainder of a tiny negative number is 360 itself."""
    angle %= 360.0
    return angle if angle < 360.0 else 0.0
