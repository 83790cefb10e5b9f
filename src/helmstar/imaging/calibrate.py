"""A camera from stars that were identified in many frames: one lens for all, an attitude for each.

Least squares of pixel residuals over their sigma with a robust loss (scipy, trust region, analytic Jacobian). Attitudes are left
perturbations R_SN = exp([d x]) R_0, and R_0 is renewed between rounds. Lens parameters have wide priors, so that a
distortion that the stars do not show stays zero instead of running away against focal length and attitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..attitude import svd
from ..errors import DataError
from .camera import Camera

PARAMETERS = ("focal", "cx", "cy", "aspect", "k1", "k2", "p1", "p2", "k3")
DEFAULT = ("focal", "cx", "cy", "k1", "k2", "p1", "p2")
_ROUNDS = 12
_OUTLIER = 5.0
_OPEN = 0.3
"""A parameter whose sigma is more than this share of its prior's was not seen by the stars."""


@dataclass(frozen=True)
class Matches:
    """Identified stars of one frame: xy_px (n, 2), directions_N (n, 3) unit, sigma_px (n,) of each coordinate, or None for 0.1."""

    xy_px: np.ndarray
    directions_N: np.ndarray
    sigma_px: np.ndarray | None = None


@dataclass(frozen=True)
class Calibration:
    """camera; names (p,) of what was fitted and covariance (p, p), in px for focal, cx, cy; q_SN (frames, 4) scalar last.

    rms_px: root mean square of a residual's length over the stars kept, in pixel widths; rms_arcsec the same as an angle. kept:
    list of (n,) bool, False for outliers. chi2, degrees: of the stars kept; chi2/degrees is 1 when their sigma is right, and
    the covariance is scaled by it when it is larger.
    """

    camera: Camera
    names: tuple[str, ...]
    covariance: np.ndarray
    q_SN: np.ndarray
    rms_px: float
    rms_arcsec: float
    kept: tuple[np.ndarray, ...]
    chi2: float
    degrees: int

    def sigma(self, name: str) -> float:
        """One sigma of a fitted parameter, by name."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))


def calibrate(frames: Sequence[Matches], start: Camera, fit: Sequence[str] = DEFAULT) -> Calibration:
    """Fit the camera to the frames' stars, from a camera that is right to some percent.

    fit: which of PARAMETERS; the others stay as in `start`. Raises DataError if the stars are too few for what is asked, or do
    not fix the focal length; ValueError for unknown parameters and arrays that do not fit.
    """
    names = tuple(fit)
    unknown = [n for n in names if n not in PARAMETERS]
    if unknown or len(set(names)) != len(names):
        raise ValueError(f"fit {list(names)}: must be different ones of {', '.join(PARAMETERS)}")
    problem = _problem(frames, start, names)
    p, R = np.array([_get(start, n) for n in names]), problem.attitudes(start)
    for _ in range(_ROUNDS):
        p, R, moved = problem.solve(p, R)
        if moved < 1e-9:
            break
    return problem.result(p, R, len(frames))


@dataclass
class _Problem:
    """All stars in one table: xy (n, 2), d_N (n, 3), sigma (n,), frame (n,) number; start camera, names, priors (p,)."""

    xy: np.ndarray
    d_N: np.ndarray
    sigma: np.ndarray
    frame: np.ndarray
    count: int
    start: Camera
    names: tuple[str, ...]
    prior: np.ndarray

    def attitudes(self, camera: Camera) -> np.ndarray:
        """R_SN (frames, 3, 3) of each frame alone."""
        from scipy.spatial.transform import Rotation

        d_S = camera.directions(self.xy)
        R = []
        for k in range(self.count):
            mine = self.frame == k
            q = svd(d_S[mine], self.d_N[mine]).q_BN
            if not np.isfinite(q).all():
                raise DataError(f"frame {k + 1}: its stars do not fix an attitude; they are all in one place")
            R.append(Rotation.from_quat(q).as_matrix())
        return np.stack(R)

    def camera(self, p: np.ndarray) -> Camera:
        """The start camera with parameters p."""
        return _with(self.start, self.names, p)

    def residual(self, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel minus prediction over sigma (n, 2); the prediction's Jacobian over sigma (n, 2, p + 3), own frame's turn last."""
        values = dict(zip(PARAMETERS, _all(self.start))) | dict(zip(self.names, p))
        f, a = values["focal"], values["aspect"]
        k1, k2, k3, p1, p2 = (values[n] for n in ("k1", "k2", "k3", "p1", "p2"))
        d = np.einsum("nij,nj->ni", R[self.frame], self.d_N)
        X, Y, Z = d.T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        h = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
        xd = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        zero, one = np.zeros_like(x), np.ones_like(x)
        columns = {
            "focal": (xd, yd / a), "cx": (one, zero), "cy": (zero, one), "aspect": (zero, -f * yd / a**2),
            "k1": (f * x * r2, f / a * y * r2), "k2": (f * x * r2**2, f / a * y * r2**2), "k3": (f * x * r2**3, f / a * y * r2**3),
            "p1": (2 * f * x * y, f / a * (r2 + 2 * y * y)), "p2": (f * (r2 + 2 * x * x), 2 * f / a * x * y),
        }  # fmt: skip
        cross = h * x * y + 2 * p1 * x + 2 * p2 * y
        dxx, dyy = g + h * x * x + 2 * p1 * y + 6 * p2 * x, g + h * y * y + 6 * p1 * y + 2 * p2 * x
        # d(x, y) of a turn e: d' = d + e x d
        turn_x = np.stack([-x * y, 1 + x * x, -y], axis=1)
        turn_y = np.stack([-(1 + y * y), x * y, x], axis=1)
        turned = np.stack(
            [
                f * (dxx[:, None] * turn_x + cross[:, None] * turn_y),
                f / a * (cross[:, None] * turn_x + dyy[:, None] * turn_y),
            ],
            axis=1,
        )
        lens = (
            np.stack([np.stack(columns[n], axis=-1) for n in self.names], axis=-1)
            if self.names
            else np.zeros((len(x), 2, 0))
        )
        predicted = np.stack([values["cx"] + f * xd, values["cy"] + f / a * yd], axis=-1)
        s = self.sigma[:, None]
        return (self.xy - predicted) / s, np.concatenate([lens, turned], axis=2) / s[..., None]

    def jacobian(self, blocks: np.ndarray) -> np.ndarray:
        """(2 n + p, p + 3 frames) of all residuals, those of the priors last."""
        n, p = len(self.xy), len(self.names)
        J = np.zeros((2 * n + p, p + 3 * self.count))
        rows = np.arange(2 * n).reshape(n, 2)
        J[: 2 * n, :p] = -blocks[..., :p].reshape(2 * n, p)
        for k in range(3):
            J[rows, (p + 3 * self.frame + k)[:, None]] = -blocks[..., p + k]
        J[2 * n :, :p] = np.diag(1.0 / self.prior)
        return J

    def solve(self, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """One round from lens p and attitudes R; the last number is how far it moved, over the start's sigma scale."""
        from scipy.optimize import least_squares
        from scipy.spatial.transform import Rotation

        first = np.array([_get(self.start, n) for n in self.names])
        size = len(p)

        def at(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            turns = Rotation.from_rotvec(v[size:].reshape(-1, 3)).as_matrix()
            return self.residual(v[:size], turns @ R)

        def fun(v: np.ndarray) -> np.ndarray:
            r = at(v)[0]
            return np.concatenate([np.nan_to_num(r, nan=1e6).ravel(), (v[:size] - first) / self.prior])

        def jac(v: np.ndarray) -> np.ndarray:
            return self.jacobian(np.nan_to_num(at(v)[1]))

        start = np.concatenate([p, np.zeros(3 * self.count)])
        scale = np.concatenate([self.prior, np.full(3 * self.count, 0.01)])
        # From a wrong camera every star is an outlier: the loss is as wide as the residuals are, round by round.
        wide = max(2.0, 2.0 * float(np.nanmedian(np.abs(at(start)[0]))))
        options: dict[str, Any] = {"jac": jac, "loss": "soft_l1", "f_scale": wide, "x_scale": scale, "max_nfev": 100}
        found = least_squares(fun, start, xtol=1e-14, ftol=1e-14, gtol=1e-12, **options)
        turns = Rotation.from_rotvec(found.x[size:].reshape(-1, 3)).as_matrix()
        return found.x[:size], turns @ R, float(np.max(np.abs((found.x - start) / scale)))

    def result(self, p: np.ndarray, R: np.ndarray, frames: int) -> Calibration:
        """Outliers out, then covariance and residuals."""
        from scipy.spatial.transform import Rotation

        r, blocks = self.residual(p, R)
        length = np.linalg.norm(r, axis=1)
        spread = max(1.0, float(np.median(length)) / 1.1774)  # median of a Rayleigh distribution
        kept = length < _OUTLIER * spread
        if np.any(np.bincount(self.frame[kept], minlength=self.count) < 2):
            kept[:] = True
        size = len(p)
        J = self.jacobian(blocks)
        J[: 2 * len(kept)] *= np.repeat(kept, 2)[:, None]
        chi2, degrees = float(np.sum(r[kept] ** 2)), 2 * int(kept.sum()) - 3 * self.count - size
        if degrees < 1:
            raise DataError(
                f"{int(kept.sum())} stars agree: too few for {size} lens parameters and {self.count} attitudes"
            )
        covariance = np.linalg.inv(J.T @ J)[:size, :size] * max(1.0, chi2 / degrees)
        if "focal" in self.names:
            k = self.names.index("focal")
            if np.sqrt(covariance[k, k]) > _OPEN * self.prior[k]:
                raise DataError("the stars do not fix the focal length: give more stars, spread over the frames")
        try:
            camera = self.camera(p)
        except ValueError as e:
            raise DataError(f"no lens fits these stars ({e}); check the matches, or fit fewer parameters") from None
        error = r * self.sigma[:, None] * np.array([1.0, camera.aspect])
        rms = float(np.sqrt(np.mean(np.sum(error[kept] ** 2, axis=1))))
        angle = np.linalg.norm(
            np.cross(camera.directions(self.xy), np.einsum("nij,nj->ni", R[self.frame], self.d_N)), axis=1
        )
        arcsec = float(np.degrees(np.sqrt(np.mean(angle[kept] ** 2))) * 3600)
        return Calibration(
            camera, self.names, covariance, Rotation.from_matrix(R).as_quat(), rms, arcsec,
            tuple(kept[self.frame == k] for k in range(frames)), chi2, degrees,
        )  # fmt: skip


def _problem(frames: Sequence[Matches], start: Camera, names: tuple[str, ...]) -> _Problem:
    """The table of all stars. Raises DataError and ValueError as `calibrate`."""
    if not frames:
        raise DataError("no frames to calibrate from; give images whose stars were identified")
    parts = []
    for k, m in enumerate(frames):
        xy, d = np.asarray(m.xy_px, float), np.asarray(m.directions_N, float)
        sigma = np.full(len(xy), 0.1) if m.sigma_px is None else np.asarray(m.sigma_px, float)
        if xy.shape != (len(xy), 2) or d.shape != (len(xy), 3) or sigma.shape != (len(xy),):
            raise ValueError(
                f"frame {k + 1}: xy_px {xy.shape}, directions_N {d.shape}, sigma_px {sigma.shape} do not fit"
            )
        if not (np.isfinite(xy).all() and np.isfinite(d).all() and (sigma > 0).all()):
            raise ValueError(f"frame {k + 1}: positions must be numbers and sigma_px positive")
        if len(xy) < 3:
            raise DataError(f"frame {k + 1}: {len(xy)} stars; at least 3 of each frame must be identified")
        parts.append((xy, d, sigma, np.full(len(xy), k)))
    xy, d, sigma, frame = (np.concatenate(c) for c in zip(*parts))
    if 2 * len(xy) < 3 * len(frames) + len(names) + 4:
        raise DataError(
            f"{len(xy)} stars in {len(frames)} frames are too few for {len(names)} lens parameters; add frames"
        )
    corner = np.hypot(start.width, start.height * start.aspect) / 2 / start.focal_px
    prior = {
        "focal": 0.2 * start.focal_px, "cx": 0.1 * start.width, "cy": 0.1 * start.height, "aspect": 0.1,
        "k1": 0.1 / corner**2, "k2": 0.1 / corner**4, "k3": 0.1 / corner**6, "p1": 0.02 / corner, "p2": 0.02 / corner,
    }  # fmt: skip
    return _Problem(xy, d, sigma, frame, len(frames), start, names, np.array([prior[n] for n in names]))


def _all(camera: Camera) -> tuple[float, ...]:
    k1, k2, p1, p2, k3 = camera.distortion
    return camera.focal_px, camera.cx, camera.cy, camera.aspect, k1, k2, p1, p2, k3


def _get(camera: Camera, name: str) -> float:
    return _all(camera)[PARAMETERS.index(name)]


def _with(camera: Camera, names: tuple[str, ...], p: np.ndarray) -> Camera:
    v = dict(zip(PARAMETERS, _all(camera))) | {n: float(x) for n, x in zip(names, p)}
    return replace(
        camera, focal_px=v["focal"], centre_px=(v["cx"], v["cy"]), aspect=v["aspect"],
        distortion=(v["k1"], v["k2"], v["p1"], v["p2"], v["k3"]),
    )  # fmt: skip


__all__ = ["DEFAULT", "PARAMETERS", "Calibration", "Matches", "calibrate"]
