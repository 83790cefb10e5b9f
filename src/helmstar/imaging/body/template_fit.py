"""Centre of figure by comparing a frame with rendered templates: `correlate` finds the body, least squares its centre.

The fit's parameters are centre, size (prior: radius and distance), figure
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
from scipy.ndimage import correlate1d, uniform_filter

from ..camera import Camera
from ..frame import Image
from .correlate import place
from .moment import Centroid, offsets, preprocess, windowed_centroid
from .photometry import Law, McEwen
from .shape import Ellipsoid
from .target import (
    AMBIGUOUS,
    CUT,
    DARK,
    FAILED,
    FOUND,
    NO_BODY,
    SATURATED,
    SPOT,
    Detector,
    FigureCentre,
    Pose,
    Target,
    nothing,
)
from .template import Data, Scene, Trial, data_of

COARSE_PX, COARSE_PSF = 32.0, 0.6
"""Diameter to which a large body is binned for the first fit, and sigma to which it is smoothed, in those pixels."""
FLOOR_PX, LAW_FLOOR_PX, LAW_FLOOR = 0.002, 0.006, 3e-5
"""1 sigma of what templates leave: of rendering, px, and of laws that the family comes near, px and per px of diameter."""
HOPELESS, EXPLAINED = 10.0, 0.8
"""Squares per degree of freedom from which a fit that does not settle, or that explains less of the light's squares, is none."""
TEMPLATE, FIGURE = 3e-4, 2.0
"""Error of templates over the light; variance of a free figure's fit over that of a linear one: its valleys bend."""
STILL, LINEAR = 0.02, 0.06
"""A step is the last that lowers the sum of squares by less, in units of the noise, or that moves edges by less, in sigma of the
optics: what the second order would add to it is a few per cent of it. It is taken without another template."""
LAW_FREEDOM = 0.5
"""Prior sigma of each pattern of the family, over the flux of the law."""
_STEPS = (np.diag([1.0, -1.0, 0.0]), np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 0]]), np.array([[0, 0, 1.0], [0, 0, 0], [1, 0, 0]]),
          np.array([[0, 0, 0], [0, 0, 1.0], [0, 1, 0]]), np.diag([-0.5, -0.5, 1.0]))  # fmt: skip
_FINITE, _FINITE_PX = 0.01, 0.1  # of a stretch, and what it may move edges by
# Of sixth order: the optics leave little light in what these get wrong, and much in what simple differences do.
_SLOPE = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
_BEND = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / 180.0
_MORE = 3  # pixels around the window that they need


@dataclass(frozen=True)
class Fit:
    """trial: the best place, size and stretch. covariance: (p, p) of (x, y, log size, log psf variance, stretches..) in px of the
    data. chi2: weighted squares per degree of freedom. amounts: of the patterns. snr: of the whole. shot: variance per count.
    psf_scale: of the optics' variance. explained: share
    of the light's squares."""

    trial: Trial
    covariance: np.ndarray
    chi2: float
    amounts: np.ndarray
    snr: float
    converged: bool
    shot: float
    psf_scale: float
    explained: float


class _Problem:
    """The squares to be least: pixels of a window against patterns of light on a trial geometry, with priors.

    geometry: (q,) x, y, log size, log psf variance and, where the figure is free, five stretches. Linear unknowns, the amounts of
    patterns and the sky, are solved for at each geometry.
    """

    def __init__(self, data: Data, scene: Scene, start: Trial, detector: Detector, freedom: float, margin_px: float):
        target = scene.target
        self.scene, self.detector = scene, detector
        self.law: Law = target.law or McEwen(weight=0.5)
        self.with_family, self.freedom = not target.law_known, freedom
        self.free = 5 if target.shape_sigma > 0.0 and isinstance(target.shape, Ellipsoid) else 0
        self.sigma_size = max(scene.pose.scale_sigma(target), 1e-4)
        grey, good, self.at = data.cut(scene.window(start, margin_px))
        left, top, width, height = self.at
        self.wide = (left - _MORE, top - _MORE, width + 2 * _MORE, height + 2 * _MORE)
        self.ok = good.ravel().astype(float)
        self.y = np.where(good, grey, 0.0).ravel().astype(float)
        self.noise = data.noise
        self.shot = 1.0 / detector.gain_e if detector.gain_e else 0.0
        # Weights by light that is itself noisy pull down; of 3 x 3 pixels and once only, by less than noise leaves.
        light = np.maximum(uniform_filter(np.asarray(grey, float), 3), 0.0).ravel()
        self.w = self.ok / (data.noise**2 + self.shot * light)
        spread = [self.sigma_size, 2.0 * detector.psf_spread, *[max(target.shape_sigma, 1e-6)] * self.free]
        self.prior = np.concatenate([[0.0, 0.0], 1.0 / np.square(spread)])
        stretches = [] if not self.free else [0.0] * 5 if start.stretch is None else list(_components(start.stretch))
        self.scales: np.ndarray | None = None
        self.level: float | None = None
        self.drawn: tuple[np.ndarray, list[np.ndarray]] | None = None
        self.radius_px = 0.5 * scene.diameter_px()
        self.start = np.array([*start.centre_px, math.log(start.size), 0.0, *stretches])

    def trial(self, p: np.ndarray) -> Trial:
        stretch = np.einsum("k,kij->ij", p[4:], np.array(_STEPS)) if self.free else None
        return Trial(p[:2], math.exp(p[2]), stretch)

    def _scene(self, p: np.ndarray) -> Scene:
        return replace(self.scene, psf_sigma_px=self.scene.psf_sigma_px * math.exp(0.5 * p[3]))

    def solve(self, p: np.ndarray) -> _State:
        """The best linear unknowns at a geometry, and the cost."""
        height, width = self.at[3], self.at[2]
        if self.drawn is None or not np.array_equal(self.drawn[0], p):
            here = self._scene(p)
            self.drawn = p, here.draw(self.trial(p), self.wide, law=self.law, with_family=self.with_family)
        images = self.drawn[1]
        if self.scales is None:  # of equal flux at the start; if they changed by geometry, so would the prior
            size = max(float(images[0].sum()), 1e-12)
            self.scales = np.array([size / max(float(i.sum()), 1e-12) for i in images])
        scales = self.scales
        D = np.empty((height * width, len(images) + 1))
        for k, (i, s) in enumerate(zip(images, scales)):
            D[:, k] = (s * i[_MORE:-_MORE, _MORE:-_MORE]).ravel() * self.ok
        D[:, -1] = self.ok
        if self.level is None:
            self.level = max(float(D[:, 0] @ self.y) / max(float(D[:, 0] @ D[:, 0]), 1e-12), self.noise * 1e-3)
        # Sky is known from the whole frame; here it may be a little off, as stray light has it.
        loose = np.full(len(images) - 1, 1.0 / (self.freedom * self.level) ** 2)
        prior = np.concatenate([[0.0], loose, [1.0 / self.noise**2]])
        Dw = D * self.w[:, None]
        found = np.linalg.solve(Dw.T @ D + np.diag(prior + 1e-15), Dw.T @ self.y)
        rest = self.y - D @ found
        cost = float(self.w @ rest**2 + prior @ found**2 + self.prior[2:] @ p[2:] ** 2)
        model = np.einsum("k,kij->ij", found[:-1] * scales, np.array(images))
        return _State(p, D, Dw, found, prior, rest, cost, model, scales)

    def weigh(self, s: _State) -> None:
        """Weights by the light of a state; how noisy light is comes from its residuals where the detector does not say."""
        light = np.maximum(s.D[:, :-1] @ s.found[:-1], 0.0)
        if self.detector.gain_e is None:
            excess = (s.rest**2 - self.noise**2 * self.ok) @ light / max(float(light @ light), 1e-300)
            self.shot = max(float(excess), 0.0)
        self.w = self.ok / (self.noise**2 + self.shot * light)

    def jacobian(self, s: _State) -> np.ndarray:
        """(pixels, q): change of the model by geometry."""
        left, top, width, height = self.at
        m, p = s.model, s.p
        inner = (slice(_MORE, -_MORE), slice(_MORE, -_MORE))
        gx, gy = (correlate1d(m, _SLOPE, axis=k)[inner] for k in (1, 0))
        dx, dy = np.arange(left, left + width) - p[0], np.arange(top, top + height) - p[1]
        around = (correlate1d(m, _BEND, axis=0) + correlate1d(m, _BEND, axis=1))[inner]
        here = self._scene(p)
        columns = [-gx, -gy, -(dx[None, :] * gx + dy[:, None] * gy), 0.5 * around * here.psf_sigma_px**2]
        if self.free:
            weights = s.found[:-1] * s.scales
            draw = lambda p: here.draw(
                self.trial(p), self.at, law=self.law, with_family=self.with_family, weights=weights
            )[0]
            base = draw(p)
            h = min(_FINITE, _FINITE_PX / self.radius_px)
            columns += [(draw(p + h * e) - base) / h for e in np.eye(len(p))[4:]]
        return np.stack([c.ravel() for c in columns], axis=1) * self.ok[:, None]

    def small(self, move: np.ndarray) -> bool:
        """Whether the image is linear over a step of the geometry."""
        limit = LINEAR * self.scene.psf_sigma_px
        edges = [float(np.hypot(*move[:2])), self.radius_px * float(np.abs(move[[2, *range(4, len(move))]]).max())]
        return max(edges) < limit and abs(float(move[3])) < 3.0 * LINEAR


@dataclass(frozen=True)
class _State:
    """A geometry p with its design D (pixels, patterns and sky) and Dw weighted, linear unknowns found, their prior, residuals,
    cost, model image with _MORE pixels more on each side, and the scales of the patterns."""

    p: np.ndarray
    D: np.ndarray
    Dw: np.ndarray
    found: np.ndarray
    prior: np.ndarray
    rest: np.ndarray
    cost: float
    model: np.ndarray
    scales: np.ndarray


def fit(
    data: Data, scene: Scene, start: Trial, detector: Detector, *, iterations: int = 50, freedom: float = LAW_FREEDOM,
    margin_px: float = 2.0,
) -> Fit:  # fmt: skip
    """Levenberg and Marquardt's least squares from a start, which should lie within about half of the body's radius.

    freedom: prior sigma of the family's patterns. margin_px: by how much the window is wider than the body at the start.
    """
    problem = _Problem(data, scene, start, detector, freedom, margin_px)
    state = problem.solve(problem.start)
    weighed = detector.gain_e is not None
    if not weighed:
        problem.weigh(state)
        state = problem.solve(problem.start)
    damping, fresh = 1e-3, True
    A, J, g, inner, cross = np.eye(1), np.zeros((1, 1)), np.zeros(1), np.eye(1), np.zeros((1, 1))
    newton, gain = np.zeros(len(problem.start)), math.inf
    diameter = scene.diameter_px()
    most = np.array([0.25 * diameter + 0.5] * 2 + [0.2, 0.5] + [0.1] * problem.free)
    for _ in range(iterations):
        unit = max(1.0, state.cost / max(float(problem.ok.sum()), 1.0))
        if fresh:
            J = problem.jacobian(state)
            Jw = J * problem.w[:, None]
            cross = Jw.T @ state.D
            # The linear unknowns follow the geometry: what they take up of its columns is no information on it.
            inner = np.linalg.inv(state.Dw.T @ state.D + np.diag(state.prior + 1e-15))
            A = Jw.T @ J + np.diag(problem.prior) - cross @ inner @ cross.T
            g = Jw.T @ state.rest - problem.prior * state.p
            newton = np.linalg.solve(A + np.diag(1e-12 * np.diagonal(A) + 1e-15), g)
            gain = float(g @ newton)
            fresh = False
        settled = gain < STILL * unit or problem.small(newton)
        if not settled and damping <= 1e3:
            move = np.linalg.solve(A + np.diag(damping * np.diagonal(A) + 1e-12), g)
            move /= max(1.0, float(np.max(np.abs(move) / most)))
            p = state.p + move
            p[2:4] = np.clip(p[2:4], -1.5, 1.5)
            p[4:] = np.clip(p[4:], -0.6, 0.6)
            tried = problem.solve(p)
            if tried.cost <= state.cost:
                state, fresh, damping = tried, True, max(damping / 10.0, 1e-7)
            else:
                damping = max(10.0 * damping, 1e-2)
            continue
        # What a step of Newton's length would gain is below what noise leaves, or steps that small gain nothing.
        if not weighed:
            problem.weigh(state)
            state, weighed, fresh, damping = problem.solve(state.p), True, True, 1e-3
            continue
        if settled:
            state = _moved(state, newton, J, -inner @ cross.T @ newton)
        return _outcome(problem, state, J, settled or gain < 9.0 * unit)
    return _outcome(problem, state, J if not fresh else problem.jacobian(state), gain < 9.0)


def _moved(s: _State, move: np.ndarray, J: np.ndarray, follow: np.ndarray) -> _State:
    """A state after a step over which it is linear; `follow` is that of the linear unknowns."""
    return replace(s, p=s.p + move, found=s.found + follow, rest=s.rest - J @ move - s.D @ follow)


def _outcome(problem: _Problem, s: _State, J: np.ndarray, converged: bool) -> Fit:
    q = len(s.p)
    K = np.concatenate([J, s.D], axis=1)
    Kw = K * problem.w[:, None]
    C = np.linalg.inv(Kw.T @ K + np.diag(np.concatenate([problem.prior, s.prior]) + 1e-15))
    chi2 = float(problem.w @ s.rest**2) / max(float(problem.ok.sum()) - K.shape[1], 1.0)
    side = max(4, round(0.12 * problem.scene.diameter_px()))
    # Residuals that go together over patches are no noise: the sandwich of what each patch pulls says how much they move the fit.
    more = C @ _misfit(Kw * s.rest[:, None], problem.at[3], problem.at[2], side) @ C
    light = s.D[:, :-1] @ s.found[:-1]
    # Templates are wrong too, by shares of the light over patches: little beside noise, except where many pixels make noise small.
    wrong = C @ _misfit(Kw * (TEMPLATE * light)[:, None], problem.at[3], problem.at[2], side) @ C
    albedo = problem.scene.target.albedo_sigma
    if albedo > 0.0:
        spot = max(2, round(SPOT * problem.scene.diameter_px()))
        spotted = C @ _misfit(Kw * (albedo * light)[:, None], problem.at[3], problem.at[2], spot) @ C
        more = more + _positive(spotted - more)  # residuals are of the same spots
    C = (C * max(1.0, chi2) * (FIGURE if problem.free else 1.0) + _positive(more - C) + wrong)[:q, :q]
    snr = float(light @ (problem.w * (s.rest + light))) / math.sqrt(max(float(problem.w @ light**2), 1e-300))
    explained = 1.0 - float(problem.w @ s.rest**2) / max(float(problem.w @ problem.y**2), 1e-300)
    return Fit(problem.trial(s.p), C, chi2, s.found[:-1], snr, converged, problem.shot, math.exp(s.p[3]), explained)


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


def coarse(data: Data, scene: Scene, start: Trial, detector: Detector, search_px: float | None) -> Trial:
    """A place right within hundredths of a pixel, from a frame smoothed and binned to a body of COARSE_PX. search_px: how far
    around the start to look for the body first; None where the start is near it."""
    n = max(1, round(scene.diameter_px() / COARSE_PX))
    blur = math.sqrt(max((COARSE_PSF * n) ** 2 - scene.psf_sigma_px**2, 0.0)) if n > 1 else 0.0
    small, wide = (
        data.smoothed(blur).binned(n),
        replace(scene, psf_sigma_px=math.hypot(scene.psf_sigma_px, blur)).binned(n),
    )
    there = Trial((start.centre_px - (n - 1) / 2) / n, start.size, start.stretch)
    if search_px is not None:
        found = place(small, wide, there.centre_px, search_px / n + 3.0)
        there = there if found is None else Trial(found[0])
    if n > 1:
        # Of a width of which smoothing is most, less is unknown; light's noise is less by the pixels put together.
        spread = detector.psf_spread * (scene.psf_sigma_px / n / wide.psf_sigma_px) ** 2
        gain = None if detector.gain_e is None else detector.gain_e * n * n
        margin = 2.0 + 0.5 * wide.diameter_px() * min(3.0 * scene.pose.scale_sigma(scene.target), 0.6)
        there = fit(
            small, wide, there, replace(detector, gain_e=gain, psf_spread=max(spread, 1e-3)), margin_px=margin
        ).trial
    return Trial(there.centre_px * n + (n - 1) / 2, there.size, there.stretch)


def centre_from_fit(
    image: Image, camera: Camera, target: Target, pose: Pose, detector: Detector | None = None, *,
    corner: tuple[int, int] = (0, 0), centroid: Centroid | None = None,
) -> FigureCentre:  # fmt: skip
    """Centre of figure by correlation and fit. corner: the frame's pixel that the image's (0, 0) is. centroid: of the same
    image, if it was measured already. A body cut by the edge or with full pixels is fitted by what is there, and its status
    says so."""
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
    offset, unsure = offsets(camera, target, pose, centroid.xy_px)
    if not np.isfinite(offset).all():
        return nothing(
            DARK, "fit", "the side that faces the camera is not lit: is the Sun's direction right?", diameter
        )
    start = Trial(centroid.xy_px - offset)
    partial = centroid.status in (CUT, SATURATED)
    # A moment right within the optics' width is a start good enough, unless the figure is free.
    near = centroid.status == FOUND and float(np.trace(unsure)) < 0.1 and target.shape_sigma == 0.0
    large = diameter > 1.5 * COARSE_PX and not near
    if large or partial:
        start = coarse(data, scene, start, detector, diameter if partial else None)
    margin = 2.0 + (0.0 if large else min(diameter * pose.scale_sigma(target), 0.25 * diameter))
    result = fit(data, scene, start, detector, margin_px=margin)
    xy, C = result.trial.centre_px, result.covariance[:2, :2]
    C = C + np.eye(2) * (FLOOR_PX**2 + (0.0 if target.law_known else LAW_FLOOR_PX**2 + (LAW_FLOOR * diameter) ** 2))
    status, message = FOUND, ""
    if centroid.status in (CUT, SATURATED):
        status, message = centroid.status, centroid.message
    if not (np.isfinite(xy).all() and np.isfinite(C).all()):
        return nothing(FAILED, "fit", "the template's fit ran away", diameter)
    if result.snr < 8.0:
        return nothing(DARK, "fit", f"its light is only {result.snr:.1f} times the noise", diameter)
    lost = math.sqrt(max(float(np.trace(C)), 0.0)) > 0.5 * diameter + 2.0
    poor = result.chi2 > HOPELESS and (not result.converged or result.explained < EXPLAINED)
    if lost or poor:
        text = "no template fits: are law, figure, distance and the Sun's direction right?"
        return nothing(FAILED, "fit", text, diameter)
    if not result.converged:
        # It crept along a valley of its parameters: the place is that of a template that fits, not yet of the best.
        C = C + np.eye(2) * (0.02 * diameter) ** 2
        message = message or "the fit did not settle; its covariance is enlarged"
    return FigureCentre(
        status, "fit", xy, C, centroid.xy_px, diameter, result.trial.size,
        math.sqrt(max(result.covariance[2, 2], 0.0)) * result.trial.size, chi2=result.chi2, message=message,
    )  # fmt: skip


__all__ = ["COARSE_PX", "LAW_FREEDOM", "Fit", "centre_from_fit", "coarse", "fit"]
