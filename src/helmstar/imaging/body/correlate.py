"""Centre of figure by comparing a frame with rendered templates: correlation finds the body, least squares its centre.

The correlation is the light that a template at each place explains, (sum I T)^2 / sum T^2, over the pixels that are there and not
full: a body cut by the edge has its best place too. The fit's parameters are centre, size (prior: radius and distance), figure
(prior: five stretches where shape_sigma is given), width of the optics, sky, and the pattern of light: the amount of the target's
law and, unless the law is known, amounts of a family of patterns (photometry.family) whose priors let each be half as strong.
Derivatives by place, size and optics are those of the template as an image; by stretches, differences of templates. The
covariance is that of all parameters together, so that what is not known of radius, figure and law is in it, times what the
residuals show beyond the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from ..camera import Camera
from ..frame import Image
from .moment import Centroid, offsets, preprocess, windowed_centroid
from .photometry import Lambert, Law, McEwen
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

COARSE_PX = 24.0
"""Diameter to which a large body is binned for the first fit."""
FLOOR_PX, LAW_FLOOR_PX, LAW_FLOOR = 0.002, 0.006, 3e-5
"""1 sigma of what templates leave: of rendering, px, and of laws that the family comes near, px and per px of diameter."""
LAW_FREEDOM = 0.5
"""Prior sigma of each pattern of the family, over the flux of the law."""
_STEPS = (np.diag([1.0, -1.0, 0.0]), np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 0]]), np.array([[0, 0, 1.0], [0, 0, 0], [1, 0, 0]]),
          np.array([[0, 0, 0], [0, 0, 1.0], [0, 1, 0]]), np.diag([-0.5, -0.5, 1.0]))  # fmt: skip
_FINITE = 0.01


@dataclass(frozen=True)
class Fit:
    """trial: the best place, size and stretch. covariance: (p, p) of (x, y, log size, log psf variance, stretches..) in px of the
    data. chi2: weighted squares per degree of freedom. amounts: of the patterns. snr: of the whole. shot: variance per count.
    psf_scale: of the optics' variance."""

    trial: Trial
    covariance: np.ndarray
    chi2: float
    amounts: np.ndarray
    snr: float
    converged: bool
    shot: float
    psf_scale: float


def fit(
    data: Data, scene: Scene, start: Trial, detector: Detector, *, iterations: int = 8, still: float = 2e-3,
    psf_scale: float = 1.0,
) -> Fit:  # fmt: skip
    """Gauss-Newton from a start, which should lie within about half of the body's radius."""
    target = scene.target
    law: Law = target.law or McEwen(weight=0.5)
    with_family = not target.law_known
    sigma_size = max(scene.pose.scale_sigma(target), 1e-4)
    n_stretch = 5 if target.shape_sigma > 0.0 and hasattr(target.shape, "semi_axes") else 0
    trial = replace(start, stretch=np.zeros((3, 3))) if n_stretch and start.stretch is None else start
    stretches = np.zeros(5) if start.stretch is None or not n_stretch else _components(start.stretch)
    log_size, log_psf = math.log(trial.size), math.log(psf_scale)
    shot = 1.0 / detector.gain_e if detector.gain_e else 0.0
    shot_known = detector.gain_e is not None
    base_psf = scene.psf_sigma_px
    converged, amounts = False, np.zeros(1)
    A = np.eye(4)
    chi2, snr, S = 1.0, 0.0, np.zeros((4, 4))
    for step in range(iterations):
        here = replace(scene, psf_sigma_px=base_psf * math.exp(0.5 * log_psf))
        window = here.window(trial, 1.0)
        grey, good, at = data.cut(window)
        left, top, width, height = at
        wide = (left - 1, top - 1, width + 2, height + 2)
        images = here.draw(trial, wide, law=law, with_family=with_family)
        size = max(float(images[0].sum()), 1e-12)
        scales = np.array([size / max(float(i.sum()), 1e-12) for i in images])
        patterns = [i * s for i, s in zip(images, scales)]
        inner = [p[1:-1, 1:-1] for p in patterns]
        y = np.where(good, grey, 0.0).ravel().astype(float)
        ok = good.ravel().astype(float)
        D = np.stack([p.ravel() for p in inner] + [np.ones(width * height)], axis=1) * ok[:, None]
        level = max(float(D[:, 0] @ y) / max(float(D[:, 0] @ D[:, 0]), 1e-12), data.noise * 1e-3)
        # Sky is known from the whole frame; here it may be a little off, as stray light has it.
        linear = np.concatenate(
            [[0.0], np.full(len(patterns) - 1, 1.0 / (LAW_FREEDOM * level) ** 2), [1.0 / data.noise**2]]
        )
        variance = data.noise**2
        if step and shot > 0.0:
            variance = data.noise**2 + shot * np.maximum(D[:, :-1] @ amounts, 0.0)
        w = ok / variance
        Dw = D * np.asarray(w)[:, None] if np.ndim(w) else D * w
        found = np.linalg.solve(Dw.T @ D + np.diag(linear + 1e-15), Dw.T @ y)
        amounts = found[:-1]
        model = sum(a * p for a, p in zip(amounts, patterns))
        rest = y - (D @ found)
        m = model[1:-1, 1:-1]
        gx = 0.5 * (model[1:-1, 2:] - model[1:-1, :-2])
        gy = 0.5 * (model[2:, 1:-1] - model[:-2, 1:-1])
        dx = np.arange(left, left + width) - trial.centre_px[0]
        dy = np.arange(top, top + height) - trial.centre_px[1]
        around = model[2:, 1:-1] + model[:-2, 1:-1] + model[1:-1, 2:] + model[1:-1, :-2] - 4.0 * m
        columns = [-gx, -gy, -(dx[None, :] * gx + dy[:, None] * gy), 0.5 * around * here.psf_sigma_px**2]
        if n_stretch:
            weights = amounts * scales
            base = here.draw(trial, at, law=law, with_family=with_family, weights=weights)[0]
            for E in _STEPS:
                moved = replace(trial, stretch=np.asarray(trial.stretch) + _FINITE * E)
                columns.append(
                    (here.draw(moved, at, law=law, with_family=with_family, weights=weights)[0] - base) / _FINITE
                )
        J = np.concatenate([np.stack([c.ravel() for c in columns], axis=1) * ok[:, None], D], axis=1)
        q = 4 + n_stretch
        if not shot_known and step:
            light = np.maximum(m.ravel(), 0.0) * ok
            shot = max(float(((rest**2 - data.noise**2) * light).sum() / max(float(light @ light), 1e-12)), 0.0)
        prior = np.concatenate([
            [0.0, 0.0, 1.0 / sigma_size**2, 1.0 / (2.0 * detector.psf_spread) ** 2],
            np.full(n_stretch, 1.0 / max(target.shape_sigma, 1e-6) ** 2), linear,
        ])  # fmt: skip
        state = np.concatenate([[0.0, 0.0, log_size, log_psf], stretches[:n_stretch], found])
        expected = np.zeros(len(state))
        Jw = J * np.asarray(w)[:, None]
        A = Jw.T @ J + np.diag(prior + 1e-15)
        g = Jw.T @ rest + prior * (expected - state)
        move = np.linalg.solve(A, g)
        degrees = max(float(ok.sum()) - q - len(found), 1.0)
        chi2 = float((w * rest**2).sum()) / degrees
        snr = float(amounts @ (D[:, :-1].T @ (w * y))) / math.sqrt(
            max(float(((D[:, :-1] @ amounts) ** 2 * w).sum()), 1e-300)
        )
        S = _misfit(Jw * rest[:, None], height, width, max(4, round(0.12 * scene.diameter_px())))
        limit = 0.25 * scene.diameter_px(trial.size) + 0.5
        length = float(np.hypot(*move[:2]))
        if length > limit:
            move *= limit / length
        move[2] = np.clip(move[2], -0.25, 0.25)
        move[3] = np.clip(move[3], -0.5, 0.5)
        log_size = float(np.clip(log_size + move[2], -1.5, 1.5))
        log_psf = float(np.clip(log_psf + move[3], -1.5, 1.5))
        if n_stretch:
            stretches = np.clip(stretches + np.clip(move[4:q], -0.1, 0.1), -0.6, 0.6)
        stretch = sum(s * E for s, E in zip(stretches, _STEPS)) if n_stretch else None
        trial = Trial(trial.centre_px + move[:2], math.exp(log_size), None if stretch is None else np.asarray(stretch))
        if not np.isfinite(trial.centre_px).all():
            break
        sigma = math.sqrt(max(np.linalg.inv(A)[0, 0], 0.0))
        if length < max(still, 0.05 * sigma) and abs(move[2]) < 1e-3 + 0.05 * sigma_size and (step or iterations == 1):
            converged = True
            break
    C = np.linalg.inv(A)
    # Residuals that go together over patches are no noise: the sandwich of what each patch pulls says how much they move the fit.
    more = C @ S @ C
    excess = _positive(more - C)
    q = 4 + n_stretch
    C = C[:q, :q] * max(1.0, chi2) + excess[:q, :q]
    return Fit(trial, C, chi2, amounts, snr, converged, shot, math.exp(log_psf))


def _components(S: np.ndarray) -> np.ndarray:
    """The amounts of _STEPS in a symmetric matrix without trace."""
    return np.array([0.5 * (S[0, 0] - S[1, 1]), S[0, 1], S[0, 2], S[1, 2], S[2, 2]])


def _misfit(scores: np.ndarray, height: int, width: int, side: int) -> np.ndarray:
    """Sum over patches of side x side pixels of the outer products of their summed scores (pixels, p)."""
    rows, columns = np.arange(height) // side, np.arange(width) // side
    patch = (rows[:, None] * (columns[-1] + 1) + columns[None, :]).ravel()
    total = np.stack([np.bincount(patch, s) for s in scores.T], axis=1)
    return total.T @ total


def _positive(M: np.ndarray) -> np.ndarray:
    """The part of a symmetric matrix with positive eigenvalues, in units of its diagonal's roots."""
    d = np.sqrt(np.maximum(np.abs(np.diagonal(M)), 1e-300))
    value, vector = np.linalg.eigh(0.5 * (M + M.T) / np.outer(d, d))
    return (vector * np.maximum(value, 0.0)) @ vector.T * np.outer(d, d)


def place(data: Data, scene: Scene, around: np.ndarray | None, reach_px: float) -> tuple[np.ndarray, float] | None:
    """Where a template of the expected size explains most light, (2,) px of the data's frame, and the next best place's share of
    that; None where no pixel is bright. around: (2,) centre of the search, within reach_px; None searches all."""
    middle = np.array([data.grey.shape[1] - 1, data.grey.shape[0] - 1]) / 2 + data.corner
    at = middle if around is None else np.asarray(around, float)
    law = scene.target.law or Lambert()
    trial = Trial(at)
    left, top, width, height = scene.window(trial)
    T = scene.draw(trial, (left, top, width, height), law=law, with_family=False)[0]
    I = np.where(data.good, data.grey, 0.0)
    shape = tuple(next_fast_len(a + b) for a, b in zip(I.shape, T.shape))
    F = rfft2(T, shape)
    light = irfft2(rfft2(I, shape) * np.conj(F), shape)
    power = irfft2(rfft2(data.good.astype(float), shape) * np.conj(rfft2(T * T, shape)), shape)
    whole = float((T * T).sum())
    if whole <= 0.0:
        return None
    score = np.where(power > 0.15 * whole, np.maximum(light, 0.0) ** 2 / np.maximum(power, 1e-9 * whole), 0.0)
    # Entry (i, j) is the template's corner at (j, i) of the data; beyond the middle it wraps to negative ones.
    oy, ox = (np.where(np.arange(n) < m, np.arange(n), np.arange(n) - n) for n, m in zip(shape, I.shape))
    cx = ox + data.corner[0] + (at[0] - left)
    cy = oy + data.corner[1] + (at[1] - top)
    if around is not None:
        score = np.where((cx[None, :] - at[0]) ** 2 + (cy[:, None] - at[1]) ** 2 <= reach_px**2, score, 0.0)
    best = np.unravel_index(int(np.argmax(score)), score.shape)
    top_score = float(score[best])
    if top_score <= 0.0:
        return None
    xy = np.array([cx[best[1]], cy[best[0]]])
    clear = max(scene.diameter_px(), 4.0)
    far = (cx[None, :] - xy[0]) ** 2 + (cy[:, None] - xy[1]) ** 2 > clear**2
    return xy, float(np.where(far, score, 0.0).max()) / top_score


def centre_from_fit(
    image: Image, camera: Camera, target: Target, pose: Pose, detector: Detector | None = None, *,
    corner: tuple[int, int] = (0, 0), centroid: Centroid | None = None,
) -> FigureCentre:  # fmt: skip
    """Centre of figure by correlation and fit. corner: the frame's pixel that the image's (0, 0) is. centroid: of the same
    image, if it was measured already. A body cut by the edge or with full pixels is fitted by what is there, and its status says so."""
    detector = detector or Detector()
    scene = Scene(camera, target, pose, detector.psf_sigma_px)
    diameter = scene.diameter_px()
    if centroid is None:
        centroid = windowed_centroid(
            image, detector, corner=corner, near_px=pose.near_px, near_sigma_px=pose.near_sigma_px + 0.5 * diameter,
            reach_px=0.6 * diameter * target.shape.reach / target.shape.mean_radius,
        )  # fmt: skip
    if centroid.status in (NO_BODY, AMBIGUOUS):
        return nothing(centroid.status, "fit", centroid.message, diameter)
    g = preprocess(image)
    data = data_of(image, g.grey, g.noise, corner)
    offset, _ = offsets(camera, target, pose, centroid.xy_px)
    if not np.isfinite(offset).all():
        return nothing(
            DARK, "fit", "the side that faces the camera is not lit: is the Sun's direction right?", diameter
        )
    start = Trial(centroid.xy_px - offset)
    n = max(1, round(diameter / COARSE_PX))
    psf_scale = 1.0
    if n > 1 or centroid.status in (CUT, SATURATED):
        coarse, small = data.binned(n), scene.binned(n)
        to = lambda xy: (xy - (n - 1) / 2) / n  # noqa: E731
        there = Trial(to(start.centre_px))
        if centroid.status in (CUT, SATURATED):
            found = place(coarse, small, there.centre_px, diameter / n + 3.0)
            if found is not None:
                there = Trial(found[0])
        if n > 1:
            first = fit(coarse, small, there, replace(detector, gain_e=None), still=0.02)
            there = first.trial
        start = Trial(there.centre_px * n + (n - 1) / 2, there.size, there.stretch)
    result = fit(data, scene, start, detector, psf_scale=psf_scale)
    xy, C = result.trial.centre_px, result.covariance[:2, :2]
    C = C + np.eye(2) * (FLOOR_PX**2 + (0.0 if target.law_known else LAW_FLOOR_PX**2 + (LAW_FLOOR * diameter) ** 2))
    status, message = FOUND, ""
    if centroid.status in (CUT, SATURATED):
        status, message = centroid.status, centroid.message
    if not (np.isfinite(xy).all() and np.isfinite(C).all()):
        return nothing(FAILED, "fit", "the template's fit ran away", diameter)
    if result.snr < 8.0:
        return nothing(DARK, "fit", f"its light is only {result.snr:.1f} times the noise", diameter)
    if not result.converged:
        status, message = (FAILED, "the template's fit did not settle") if status == FOUND else (status, message)
        C = C + np.eye(2) * (0.02 * diameter) ** 2
    return FigureCentre(
        status, "fit", xy, C, centroid.xy_px, diameter, result.trial.size,
        math.sqrt(max(result.covariance[2, 2], 0.0)) * result.trial.size, chi2=result.chi2, message=message,
    )  # fmt: skip


__all__ = ["COARSE_PX", "LAW_FREEDOM", "Fit", "centre_from_fit", "fit", "place"]
