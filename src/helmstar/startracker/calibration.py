"""One camera from many solved frames: fit, match more stars with what was fitted, fit again; and the centroids' true errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..imaging import Camera, Centroids
from ..imaging.calibrate import DEFAULT, Calibration, Matches, calibrate
from ..imaging.calibrated import Calibrated
from ..imaging.unexplained import shared_px
from ..sensors.lens import LensPrior, lens_sigmas
from ..sensors.refine import refine
from ..sensors.star_tracker import StarSolution, StarTracker
from ..stars.doubt import magnitude_of_order
from ..stars.identify import matrix_of_quaternion

SIMPLER = (DEFAULT, ("focal", "cx", "cy", "k1"), ("focal", "k1"), ("focal",))
"""What is fitted, from the most to the least: the first for which the stars suffice."""
_ROUNDS = 3
_SCALES = np.geomspace(0.3, 5.0, 57)
_FLOORS = np.concatenate([[0.0], np.geomspace(0.01, 2.0, 40)])


@dataclass
class Frame:
    """One image and what became of it; centroids and found are None where it could not be read or used."""

    file: Path
    status: str
    message: str = ""
    size: tuple[int, int] = (0, 0)
    centroids: Centroids | None = None
    found: StarSolution | None = None

    @property
    def solved(self) -> bool:
        return self.found is not None and self.found.solved


@dataclass(frozen=True)
class Fitted:
    """calibration; known: its camera with the sigmas for `solve --camera`; frames: those in it, in its order; stars, before,
    after: per frame (n, 2) places of its stars and their residuals with the start's camera and with the fitted one, px."""

    calibration: Calibration
    known: Calibrated
    frames: list[Frame]
    stars: list[np.ndarray]
    before: list[np.ndarray]
    after: list[np.ndarray]


def fit_camera(tracker: StarTracker, frames: Sequence[Frame], aspect: bool) -> Fitted:
    """Fit the camera of frames of one size, some of them solved; their `found` is renewed. aspect: whether to fit it too.

    With the fitted camera more stars match, and frames that were not solved may be, so it is fitted three times. Raises
    DataError where the stars do not suffice even for a focal length.
    """
    solutions = [f.found for f in frames if f.found is not None and f.found.solved]
    width, height = frames[0].size
    focal = float(np.median([s.camera.focal_px for s in solutions]))
    start = tracker.camera or Camera(width, height, focal, aspect=tracker.aspect)
    noise, camera = (1.0, 0.0), start
    for k in range(_ROUNDS):
        mine = [f for f in frames if f.solved]
        data = [_matches(tracker, f, noise) for f in mine]
        fitted = _calibrated(data, camera, aspect)
        noise = _noise(tracker, mine, data, fitted)
        camera = fitted.camera
        if k < _ROUNDS - 1:
            _match_again(tracker, frames, mine, fitted, _known(fitted, data, noise), noise)
    mine = [f for f in frames if f.solved]
    data = [_matches(tracker, f, noise) for f in mine]
    fitted = _calibrated(data, camera, aspect)
    first = calibrate(data, start, ())
    return Fitted(
        fitted, _known(fitted, data, noise), mine, [m.xy_px for m in data], residuals(data, start, first.q_SN),
        residuals(data, fitted.camera, fitted.q_SN),
    )  # fmt: skip


def residuals(data: Sequence[Matches], camera: Camera, q_SN: np.ndarray) -> list[np.ndarray]:
    """Measured minus predicted pixels (n, 2) of each frame."""
    return [m.xy_px - camera.pixels(m.directions_N @ matrix_of_quaternion(q).T) for m, q in zip(data, q_SN)]


def _pieces(tracker: StarTracker, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Variances (n,) of a frame's matched stars, px^2: as detected, and by proper motion since the catalogue's year."""
    assert frame.found is not None
    assert frame.centroids is not None
    i, catalog = frame.found.identification, tracker.sky.catalog
    C = frame.centroids.covariance_px[i.detections]
    drift = tracker.epoch_years * i.focal_px * np.hypot(catalog.pm_ra[i.stars], catalog.pm_dec[i.stars])
    return 0.5 * (C[:, 0, 0] + C[:, 1, 1]), drift**2


def _matches(tracker: StarTracker, frame: Frame, noise: tuple[float, float]) -> Matches:
    """The identified stars of a frame, with a scale and a floor (px) on their sigmas."""
    assert frame.found is not None
    assert frame.centroids is not None
    i = frame.found.identification
    detected, drift = _pieces(tracker, frame)
    sigma = np.sqrt(noise[0] ** 2 * detected + noise[1] ** 2 + drift)
    return Matches(frame.centroids.xy_px[i.detections], tracker.sky.directions[i.stars], sigma)


def _calibrated(data: list[Matches], start: Camera, aspect: bool) -> Calibration:
    """With as many parameters as the stars allow. Raises DataError where not even the focal length can be fitted."""
    for names in SIMPLER[:-1]:
        try:
            return calibrate(data, start, (*names, "aspect") if aspect else names)
        except DataError:
            continue
    return calibrate(data, start, SIMPLER[-1])


def _known(fitted: Calibration, data: Sequence[Matches], noise: tuple[float, float]) -> Calibrated:
    """The camera with what the calibration leaves open."""
    focal, centre, k1, rest = lens_sigmas(fitted)
    smooth = float(np.hypot(rest, shared_px(data, fitted)))
    return Calibrated(fitted.camera, focal * fitted.camera.focal_px, centre, k1, *noise, smooth)


def _noise(
    tracker: StarTracker, frames: Sequence[Frame], data: Sequence[Matches], fitted: Calibration
) -> tuple[float, float]:
    """Scale and floor (px) of the centroids' sigmas: the most probable ones, with a belief in the scale 1 (a factor of 2 is one
    sigma of it). A star's variance is scale^2 detected + floor^2 + drift^2; outliers are left out."""
    r2, detected, drift = [], [], []
    for f, r, kept in zip(frames, residuals(data, fitted.camera, fitted.q_SN), fitted.kept):
        c, d = _pieces(tracker, f)
        r2.append(np.sum((r * [1.0, fitted.camera.aspect])[kept] ** 2, axis=1))
        detected.append(c[kept])
        drift.append(d[kept])
    r2, detected, drift = (np.concatenate(v) for v in (r2, detected, drift))
    # The fit took part of the residuals with it.
    r2 = r2 * (2 * len(r2) / max(fitted.degrees, 1))
    variance = (
        _SCALES[:, None, None] ** 2 * detected + _FLOORS[None, :, None] ** 2 + drift
    )  # (scales, floors, stars), a few MB
    loss = np.sum(np.log(variance) + 0.5 * r2 / variance, axis=2) + 0.5 * (np.log(_SCALES) / np.log(2.0))[:, None] ** 2
    a, b = np.unravel_index(np.argmin(loss), loss.shape)
    return float(_SCALES[a]), float(_FLOORS[b])


def _match_again(
    tracker: StarTracker, frames: Sequence[Frame], mine: Sequence[Frame], fitted: Calibration, known: Calibrated,
    noise: tuple[float, float],
) -> None:  # fmt: skip
    """Renew the matches of frames with the fitted camera, and solve what was not solved."""
    camera, prior = fitted.camera, LensPrior.calibrated(known)
    for f, q in zip(mine, fitted.q_SN):
        assert f.found is not None
        assert f.centroids is not None
        C = noise[0] ** 2 * f.centroids.covariance_px + noise[1] ** 2 * np.eye(2)
        i = replace(f.found.identification, q_SN=q, q_BN=q, focal_px=camera.focal_px)
        stars = replace(f.centroids, covariance_px=C)
        # The brightness of a frame is read as it was when the frame was solved.
        magnitude = magnitude_of_order(stars.flux) if f.found.doubt == "rough" else None
        better = refine(i, stars, camera, tracker.sky, prior, tracker.epoch_years, magnitude).identification
        if len(better.stars) >= 3:
            f.found = replace(f.found, identification=better, camera=camera)
    again = tracker.with_camera(known)
    for f in frames:
        if not f.solved and f.centroids is not None:
            found = again.identified(f.centroids, *f.size)
            if found.solved:
                f.found, f.status, f.message = found, found.status, ""


__all__ = ["Fitted", "Frame", "fit_camera", "residuals"]
