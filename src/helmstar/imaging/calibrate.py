"""A camera from stars that were identified in many frames: one lens for all, an attitude for each.

Least squares of pixel residuals over their sigma with a robust loss (the soft absolute value, by damped Gauss and Newton's
steps with an analytic Jacobian). Attitudes are left perturbations R_SN = exp([d x]) R and are eliminated frame by frame, so
that hundreds of frames cost little. Lens parameters have wide priors, so that a distortion that the stars do not show
stays zero instead of running away against focal length and attitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..attitude import svd
from ..errors import DataError
from .camera import Camera

PARAMETERS = ("focal", "cx", "cy", "aspect", "k1", "k2", "p1", "p2", "k3")
DEFAULT = ("focal", "cx", "cy", "k1", "k2", "p1", "p2")
_ROUNDS, _STEPS = 12, 40
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


def derivative(camera: Camera, names: Sequence[str], directions_S: np.ndarray, turns: bool = False) -> np.ndarray:
    """Derivative (n, 2, p) of the pixels of directions in S (n, 3) by parameters of the camera; with turns (n, 2, p + 3), by a
    turn of S's axes last."""
    n = len(directions_S)
    one = _Problem(
        np.zeros((n, 2)), directions_S, np.ones(n), np.zeros(n, int), 1, camera, tuple(names), np.ones(len(names))
    )
    p = np.array([_get(camera, name) for name in names])
    J = one.residual(p, np.eye(3)[None])[1]
    return J if turns else J[:, :, : len(names)]


@dataclass(frozen=True)
class _Reduced:
    """information (p, p) and gradient (p,) of the lens alone; turns: for each frame its turn (3,) without a step of the lens, and
    what it loses (3, p) with one."""

    information: np.ndarray
    gradient: np.ndarray
    turns: list[tuple[np.ndarray, np.ndarray]]


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

    def reduced(self, blocks: np.ndarray, r: np.ndarray, w: np.ndarray, p: np.ndarray) -> _Reduced:
        """The normal equations for residuals r (n, 2) of weights w (n, 2), each frame's turn eliminated."""
        size = len(p)
        J = blocks * np.sqrt(w)[..., None]
        y = r * np.sqrt(w)
        information = np.diag(self.prior**-2.0)
        gradient = (np.array([_get(self.start, n) for n in self.names]) - p) / self.prior**2
        turns = []
        for k in range(self.count):
            mine = slice(*np.searchsorted(self.frame, [k, k + 1]))
            B, z = J[mine].reshape(-1, size + 3), y[mine].ravel()
            N, g = B.T @ B, B.T @ z
            both, own = N[:size, size:], N[size:, size:] + 1e-12 * np.trace(N[size:, size:]) * np.eye(3)
            X = np.linalg.solve(own, np.column_stack([both.T, g[size:]]))
            information += N[:size, :size] - both @ X[:, :size]
            gradient += g[:size] - both @ X[:, size]
            turns.append((X[:, size], X[:, :size]))
        return _Reduced(information, gradient, turns)

    def solve(self, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """One round from lens p and attitudes R; the last number is how far it moved, over the priors' sigma."""
        from scipy.spatial.transform import Rotation

        r, blocks = self.residual(p, R)
        # From a wrong camera every star is an outlier: the loss is as wide as the residuals are, round by round.
        wide = max(2.0, 2.0 * float(np.nanmedian(np.abs(r))))
        first, damping, moved = np.array([_get(self.start, n) for n in self.names]), 0.0, 0.0

        def cost(r: np.ndarray, p: np.ndarray) -> float:
            # The soft absolute value: rho(z) = 2 (sqrt(1 + z) - 1)
            return float(
                2 * wide**2 * np.sum(np.sqrt(1 + (r / wide) ** 2) - 1) + np.sum(((p - first) / self.prior) ** 2)
            )

        now = cost(np.nan_to_num(r, nan=1e6), p)
        for _ in range(_STEPS):
            bad = ~np.isfinite(r)
            weight = np.where(bad, 0.0, 1.0 / np.sqrt(1 + (np.where(bad, 0.0, r) / wide) ** 2))
            it = self.reduced(np.nan_to_num(blocks), np.where(bad, 0.0, r), weight, p)
            step = np.zeros(len(p))
            if len(p):
                scaled = it.information * self.prior * self.prior[:, None]
                scaled += damping * np.diag(np.diagonal(scaled))
                step = np.linalg.solve(scaled, it.gradient * self.prior) * self.prior
            turns = np.array([own - both @ step for own, both in it.turns])
            p2, R2 = p + step, Rotation.from_rotvec(turns).as_matrix() @ R
            r2, blocks2 = self.residual(p2, R2)
            after = cost(np.nan_to_num(r2, nan=1e6), p2)
            if not after <= now * (1 + 1e-12) + 1e-18:
                damping = max(10.0 * damping, 1e-3)
                if damping > 1e6:
                    break
                continue
            size = max(float(np.max(np.abs(step / self.prior), initial=0.0)), float(np.abs(turns).max()) / 0.01)
            moved, damping = max(moved, size), 0.1 * damping if damping > 1e-6 else 0.0
            p, R, r, blocks, now = p2, R2, r2, blocks2, after
            if size < 1e-10:
                break
        return p, R, moved

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
        chi2, degrees = float(np.sum(r[kept] ** 2)), 2 * int(kept.sum()) - 3 * self.count - size
        if degrees < 1:
            raise DataError(
                f"{int(kept.sum())} stars agree: too few for {size} lens parameters and {self.count} attitudes"
            )
        information = self.reduced(blocks, r, np.repeat(kept[:, None], 2, axis=1).astype(float), p).information
        covariance = np.linalg.inv(information) * max(1.0, chi2 / degrees)
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
