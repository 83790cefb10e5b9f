"""What a lens may be: priors on where it differs from the camera that was told, and the pixels it makes of directions.

The attitude belongs to the frame S whose z axis is seen at the camera's stated centre (`refine`): a principal point elsewhere
shows by the perspective's second order only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..imaging import Camera
from ..imaging.calibrate import Calibration, derivative
from ..imaging.calibrated import Calibrated

PARAMETERS = 9
"""Of the fit: a turn theta, ln f, e_x, e_y, and what k1, p1 and p2 differ from the camera's."""


@dataclass(frozen=True)
class LensPrior:
    """1 sigma of what the lens may differ from the camera: focal (relative; infinite: unknown), centre_px, k1, and p1 and p2."""

    focal: float
    centre_px: float
    k1: float
    tangential: float = 0.0

    @classmethod
    def uncalibrated(cls, camera: Camera, focal: float) -> LensPrior:
        """Of an unknown lens: centred within 2% of the image's width, 1% of distortion in the corner, and 0.03% of tangential
        distortion there."""
        corner = _corner(camera)
        return cls(focal, 0.02 * camera.width, 0.01 / corner**2, 0.0003 / (3.0 * corner))

    @classmethod
    def rough(cls, camera: Camera, focal: float) -> LensPrior:
        """Of a lens that displaces stars by pixels: centred within 10%, 3% of distortion in the corner, and 0.3% of tangential
        distortion. What else it does is a smooth field (`displaced`)."""
        corner = _corner(camera)
        return cls(focal, 0.1 * camera.width, 0.03 / corner**2, 0.003 / (3.0 * corner))

    @classmethod
    def calibrated(cls, known: Calibrated) -> LensPrior:
        """As the calibration says; a camera written by hand is believed to 0.05% of its focal length, 0.2% of its width, and 0.1%
        of distortion and 0.01% of tangential distortion in the corner. A focal length follows the temperature: never better than
        0.01%."""
        camera = known.camera
        focal = 5e-4 if known.focal_sigma_px is None else math.hypot(known.focal_sigma_px / camera.focal_px, 1e-4)
        centre = 0.002 * camera.width if known.centre_sigma_px is None else known.centre_sigma_px
        if known.k1_sigma is None:
            return cls(focal, centre, 0.001 / _corner(camera) ** 2, 0.0001 / (3.0 * _corner(camera)))
        return cls(focal, centre, known.k1_sigma)


def _corner(camera: Camera) -> float:
    """Tangent of the corner's angle from the middle."""
    return 0.5 * math.hypot(camera.width, camera.height * camera.aspect) / camera.focal_px


_PROJECTED = 7
"""Of these, those that a calibration's covariance is told by: the turn, ln f, e_x, e_y and k1."""


def lens_sigmas(fit: Calibration) -> tuple[float, float, float, float]:
    """1 sigma of focal length (relative), centre (px) and k1 that move pixels as a calibration's whole covariance does, and of
    the rest (px per axis).

    A calibration's parameters are correlated, and more than `LensPrior` has: what they leave open of the image, over a grid, is
    projected on turns (which belong to the attitude), focal length, centre and k1.
    """
    camera, names = fit.camera, fit.names
    grid = np.stack(np.meshgrid(np.linspace(0.05, 0.95, 8), np.linspace(0.05, 0.95, 8)), axis=-1).reshape(-1, 2)
    d = camera.directions(grid * [camera.width, camera.height])
    d = d[np.isfinite(d).all(axis=1)]
    _, J = Lens.of(camera, LensPrior.uncalibrated(camera, 1.0)).predict(np.eye(3), np.zeros(6), d)
    J = J[:, :, :_PROJECTED].reshape(-1, _PROJECTED)
    open_ = derivative(camera, names, d).reshape(-1, len(names))
    scale = np.linalg.norm(J, axis=0)
    A = np.linalg.lstsq(J / scale, open_, rcond=1e-6)[0] / scale[:, None]
    sigma = np.sqrt(np.maximum(np.diagonal(A @ fit.covariance @ A.T), 0.0))
    B = open_ - J @ A
    rest = float(np.sqrt(max(np.trace(B @ fit.covariance @ B.T) / len(B), 0.0)))
    return float(sigma[3]), float(max(sigma[4], sigma[5] * camera.aspect)), float(sigma[6]), rest


@dataclass(frozen=True)
class Lens:
    """The camera, the information (9,) of the priors on theta (none), ln f, e_x, e_y, k1, p1, p2, and round (2, 2): a round
    uncertainty of the sky in the image's pixels."""

    camera: Camera
    known: np.ndarray
    round: np.ndarray

    @classmethod
    def of(cls, camera: Camera, prior: LensPrior) -> Lens:
        tangential = prior.tangential, prior.tangential
        sigma = (prior.focal, prior.centre_px, prior.centre_px / camera.aspect, prior.k1, *tangential)
        known = np.array([0.0, 0.0, 0.0, *(1.0 / max(s, 1e-9) ** 2 for s in sigma)])
        return cls(camera, known, np.array([[1.0, 0.0], [0.0, camera.aspect**-2]]))

    def predict(self, R: np.ndarray, p: np.ndarray, d_N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) of directions, and their derivative (n, 2, 9) by theta and p (6,) = ln f, e_x, e_y, k1, p1, p2."""
        c = self.camera
        a, f, (ex, ey) = c.aspect, c.focal_px * np.exp(p[0]), p[1:3]
        k1, k2, p1, p2, k3 = c.distortion
        k1, p1, p2 = k1 + p[3], p1 + p[4], p2 + p[5]
        # Where the lens itself sees the stated centre: a turn takes z of S there.
        sx, sy = -ex / f, -a * ey / f
        r2 = sx * sx + sy * sy
        sx, sy = sx / (1.0 + k1 * r2), sy / (1.0 + k1 * r2)
        T = turn_to(sx, sy)
        v = d_N @ (T @ R).T
        x, y = v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]
        xy = x * y
        xx, yy = 1.0 + x * x, 1.0 + y * y
        turn_x, turn_y = (-xy, xx, -y), (-yy, xy, x)
        shift_x, shift_y = -sx * xx - sy * xy, -sy * yy - sx * xy
        r2 = x * x + y * y
        g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        h = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        xd = x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        cross = h * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        dxx = g + h * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        dyy = g + h * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        J = np.empty((len(x), 2, PARAMETERS))
        for k in range(3):
            J[:, 0, k] = f * (dxx * turn_x[k] + cross * turn_y[k])
            J[:, 1, k] = f / a * (cross * turn_x[k] + dyy * turn_y[k])
        J[:, 0, 3] = f * (xd + dxx * shift_x + cross * shift_y)
        J[:, 1, 3] = f / a * (yd + cross * shift_x + dyy * shift_y)
        J[:, :, 4] = [1.0, 0.0] - J[:, :, 1] / f
        J[:, :, 5] = [0.0, 1.0] + a * J[:, :, 0] / f
        J[:, :, :3] = (J[:, :, :3].reshape(-1, 3) @ T).reshape(-1, 2, 3)
        J[:, 0, 6], J[:, 1, 6] = f * x * r2, f / a * y * r2
        J[:, 0, 7], J[:, 1, 7] = 2.0 * f * xy, f / a * (r2 + 2.0 * y * y)
        J[:, 0, 8], J[:, 1, 8] = f * (r2 + 2.0 * x * x), 2.0 * f / a * xy
        return np.stack([c.cx + ex + f * xd, c.cy + ey + f / a * yd], axis=1), J

    def seen_at_centre(self, p: np.ndarray) -> np.ndarray:
        """X/Z and Y/Z (2,) in S of what is seen at the stated centre: zero but for what `predict` leaves of third order."""
        at = np.zeros(2)
        for _ in range(8):
            off = self.predict(np.eye(3), p, np.array([[*at, 1.0]]))[0][0] - [self.camera.cx, self.camera.cy]
            step = off * [1.0, self.camera.aspect] / (self.camera.focal_px * math.exp(p[0]))
            at = at - step
            if abs(step).max() < 1e-13:
                break
        return at

    def fitted(self, p: np.ndarray) -> Camera:
        """The camera of p's focal length, and k1, p1, p2 added to its own: what of it folds no corner over, where no star was
        seen."""
        focal_px, own = self.camera.focal_px * math.exp(p[0]), self.camera.distortion
        bent = (own[0] + float(p[3]), own[1], own[2] + float(p[4]), own[3] + float(p[5]), own[4])
        for distortion in (bent, own):
            try:
                return replace(self.camera, focal_px=focal_px, distortion=distortion)
            except ValueError:
                continue
        return self.camera

    def second_order(self, delta: np.ndarray) -> float:
        """Bound, px, on what a step (9,) leaves: products of turns, of the focal length's and of the centre's share."""
        f = self.camera.focal_px
        turned, centre = float(np.abs(delta[:3]).sum()), float(np.abs(delta[4:6]).sum())
        return f * (turned + abs(float(delta[3])) + centre / f) ** 2

    def prior(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Information (9,) of what is known before, and its gradient (9,) at p."""
        return self.known, -self.known * np.concatenate([np.zeros(3), p])


def turn_to(x: float, y: float) -> np.ndarray:
    """The least turn (3, 3) that takes z to the direction of [x, y, 1]."""
    length = np.sqrt(x * x + y * y + 1.0)
    a, b, c = x / length, y / length, 1.0 / length
    k = 1.0 / (1.0 + c)
    return np.array([[1.0 - k * a * a, -k * a * b, a], [-k * a * b, 1.0 - k * b * b, b], [-a, -b, c]])


__all__ = ["PARAMETERS", "Lens", "LensPrior", "lens_sigmas", "turn_to"]
