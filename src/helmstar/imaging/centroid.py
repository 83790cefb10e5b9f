"""Where a star is: least squares of a Gaussian, integrated over each pixel, in a small window of every star at once.

A centre of mass, weighted or not, is pulled towards pixel centres when optics are sharper than a pixel; a fit of what the pixels
really integrate is not. Weights are equal, so every sum over a window is a product of sums along rows and columns, and
the covariance is that of equal weights under the true noise (the sandwich A^-1 (J^T V J) A^-1):

    V of a pixel = noise^2 + gain * light,

with the light's share (counts of image per photo-electron, and whatever the model misses) estimated from the residuals of all the
stars of the image. Pixels that are saturated or outside of the image are filled by the model, again and again.
"""

from __future__ import annotations

from ctypes import c_double, c_int, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..native import address, kernels

ITERATIONS = 6
MIN_SIGMA = 0.3
_LOOSE = 0.35  # relative spread of widths that the first guess allows
_ERF = (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429)
_PARAMETERS = 5.5  # of six, what the prior on sky and widths leaves free
_STILL = 0.02  # px; what is left after so small a step is its square
_ALONG_Y, _ALONG_X = (
    np.array([0, 1, 0, 2, 0, 3]),
    np.array([0, 1, 2, 0, 3, 0]),
)  # rows of the factors for each parameter
_BY_Y, _BY_X = ((4 * k[:, None] + k).ravel() for k in (_ALONG_Y, _ALONG_X))
_BY_BOTH = 4 * _ALONG_Y + _ALONG_X


@dataclass(frozen=True)
class Fit:
    """p: (n, 6) float64 flux, sky, x, y, sigma_x, sigma_y: centre relative to the window's middle pixel, widths in px.

    bread: (n, 6, 6) inverse of J^T J; light: (n, 6, 6) J^T diag(share of the light) J. J is over the flux, for flux over flux, sky
    over flux, x, y, sigma_x, sigma_y. residual: (n, m, m) window minus model, 0 where filled. model: (n, m, m) without the sky.
    sums: (n, 4) over the window of model, its square and the residual's, and of the light that the fit took (see `gain_of`).
    """

    p: np.ndarray
    bread: np.ndarray
    light: np.ndarray
    residual: np.ndarray
    model: np.ndarray
    sums: np.ndarray

    @property
    def flux(self) -> np.ndarray:
        """(n,) sum of the light."""
        return self.p[:, 0]

    @property
    def sky(self) -> np.ndarray:
        """(n,) of a pixel."""
        return self.p[:, 1]

    @property
    def x(self) -> np.ndarray:
        """(n,) columns from the middle pixel."""
        return self.p[:, 2]

    @property
    def y(self) -> np.ndarray:
        """(n,) rows from the middle pixel."""
        return self.p[:, 3]

    @property
    def sigma(self) -> np.ndarray:
        """(n, 2) width along x and y, px."""
        return self.p[:, 4:]

    def place_covariance(self, noise: np.ndarray, gain: float) -> np.ndarray:
        """(n, 2, 2) of x, y for a noise (n,) of each pixel without light and `gain` of variance for each unit of light."""
        rows = self.bread[:, 2:4]
        out = ((noise / self.flux) ** 2)[:, None, None] * rows[:, :, 2:4]
        return out + (gain / self.flux)[:, None, None] * (rows @ self.light @ rows.transpose(0, 2, 1))


def _factors(p: np.ndarray, half: int) -> np.ndarray:
    """F (2, n, 4, m) along x and along y: the share of a Gaussian in each pixel, one, the share's derivatives by centre and by
    width, for parameters p (n, 6) as in `fit`.

    A column of the Jacobian over the flux is the outer product of a row along y and one along x (`_ALONG_Y`, `_ALONG_X`).
    """
    n, m = len(p), 2 * half + 1
    # Pixels lead while the work is done: one long line for each.
    inverse = 1.0 / p[:, 4:].T.ravel()
    t = np.arange(-half - 0.5, half + 1.0, dtype=np.float32)[:, None] - p[:, 2:4].T.ravel()
    t *= inverse
    bell = t * t
    bell *= np.float32(-0.5)
    np.exp(bell, out=bell)
    # Abramowitz and Stegun 7.1.26 (error below 1.5e-7): the exponential is at hand, and scipy.special takes 0.3 s to import.
    k = np.abs(t)
    k *= np.float32(0.3275911 * np.sqrt(0.5))
    k += np.float32(1.0)
    np.reciprocal(k, out=k)
    tail = k * np.float32(_ERF[4])
    for c in _ERF[3::-1]:
        tail += np.float32(c)
        tail *= k
    tail *= bell
    np.subtract(np.float32(1.0), tail, out=tail)
    np.copysign(tail, t, out=tail)
    tail *= np.float32(0.5)
    bell *= inverse * np.float32(1.0 / np.sqrt(2.0 * np.pi))
    F = np.empty((2, n, 4, m), np.float32)
    flat = F.reshape(2 * n, 4, m)
    flat[:, 0] = (tail[1:] - tail[:-1]).T
    flat[:, 1] = 1.0
    flat[:, 2] = (bell[:-1] - bell[1:]).T
    bell *= t
    flat[:, 3] = (bell[:-1] - bell[1:]).T
    return F


def fit(
    windows: np.ndarray, x: np.ndarray, y: np.ndarray, sky: np.ndarray, noise: np.ndarray, width: np.ndarray, filled: np.ndarray,
    tight: float = _LOOSE, iterations: int = ITERATIONS,
) -> Fit:  # fmt: skip
    """Fit every window (n, m, m), m odd, from starts x, y (n,) relative to the middle pixel.

    sky, noise: (n,) from around the window; the sky is known as well as the noise of 2 m pixels allows. width: (2,) expected
    sigma of the stars along x and y, px, relative spread `tight`. filled: (n, m, m) bool, pixels that say nothing.

    Single precision: with everything over the flux the numbers are about one, and pixels have no more digits.
    """
    library = kernels()
    if library is not None and len(windows):
        found = _fit_compiled(library, windows, x, y, sky, noise, width, filled, tight, iterations)
        if found is not None:
            return found
    n, m, _ = windows.shape
    half = m // 2
    data = np.subtract(windows, sky[:, None, None], dtype=np.float32)
    some = bool(filled.any())
    noise = noise.astype(np.float32)
    # flux, sky above the first guess, x, y, sigma_x, sigma_y
    p = np.empty((n, 6), np.float32)
    light = np.where(filled, np.float32(0.0), data) if some else data
    p[:, 0] = np.maximum(light.sum(axis=(1, 2)), np.maximum(noise, 1e-6))
    p[:, 1], p[:, 2], p[:, 3], p[:, 4:] = 0.0, x, y, width
    expected = np.array([0.0, 0.0, 0.0, 0.0, width[0], width[1]], np.float32)
    spread = (np.maximum(noise, 1e-9)[:, None] / (tight * width)).astype(np.float32)
    low, high = np.array([-np.inf, -half, -half, MIN_SIGMA, MIN_SIGMA]), np.array([np.inf, half, half, half, half])
    low, high = low.astype(np.float32), high.astype(np.float32)
    furthest = max(0.5, half / 18)
    going = None
    for k in range(iterations):
        q, d, blank = (p, data, filled) if going is None else (p[going], data[going], filled[going])
        flux = q[:, :1]
        F = _factors(q, half)
        rest = d - _model(F, flux)
        rest -= q[:, 1, None, None]
        if some:
            rest[blank] = 0.0
        prior = _prior(spread if going is None else spread[going], flux, m)
        A = _normal(F, prior)
        g = (F[1] @ rest @ F[0].transpose(0, 2, 1)).reshape(-1, 16).take(_BY_BOTH, axis=1)
        g /= flux
        away = expected - q
        away[:, 1:2] /= flux
        g += prior * away
        step = np.linalg.solve(A, g[:, :, None])[:, :, 0]
        step[:, :2] *= flux
        np.clip(step[:, 2:], -furthest, furthest, out=step[:, 2:])
        new = q + step
        np.maximum(new[:, :1], np.float32(0.1) * flux, out=new[:, :1])
        np.clip(new[:, 1:], low, high, out=new[:, 1:])
        if going is None:
            p = new
        else:
            p[going] = new
        if k:
            # A tenth of what noise leaves, or the absolute bound.
            least = np.minimum(A[:, 2, 2], A[:, 3, 3])
            bound = np.float32(0.1) * (noise if going is None else noise[going]) / (flux[:, 0] * np.sqrt(least))
            on = np.flatnonzero(np.abs(step[:, 2:4]).max(axis=1) > np.maximum(bound, _STILL))
            if not on.size:
                break
            going = on if going is None else going[on]
    F, flux = _factors(p, half), p[:, :1]
    model = _model(F, flux)
    rest = data - model
    rest -= p[:, 1, None, None]
    if some:
        rest[filled] = 0.0
    by_light = ((F * F[:, :, :1]) @ F.transpose(0, 1, 3, 2)).reshape(2, n, 16)
    light = (by_light[1].take(_BY_Y, axis=1) * by_light[0].take(_BY_X, axis=1)).reshape(n, 6, 6)
    bread = np.linalg.inv(_normal(F, _prior(spread, flux, m)))
    p = p.astype(float)
    p[:, 1] += sky
    square, left = np.einsum("nij,nij->n", model, model), np.einsum("nij,nij->n", rest, rest)
    sums = np.stack([model.sum(axis=(1, 2)), square, left, p[:, 0] * (bread * light).sum(axis=(1, 2))], axis=1)
    return Fit(p, bread, light, rest, model, sums)


def _fit_compiled(
    library: Any, windows: np.ndarray, x: np.ndarray, y: np.ndarray, sky: np.ndarray, noise: np.ndarray, width: np.ndarray,
    filled: np.ndarray, tight: float, iterations: int,
) -> Fit | None:  # fmt: skip
    """The same by centroid.c; None for windows that it does not take."""
    n, m, _ = windows.shape
    given = [np.ascontiguousarray(a, np.float32) for a in (windows, x, y, sky, noise)]
    given += [np.ascontiguousarray(filled, bool), np.ascontiguousarray(width, float)]
    p, sums = np.empty((n, 6)), np.empty((n, 4), np.float32)
    bread, light = np.empty((2, n, 6, 6), np.float32)
    residual, model = np.empty((2, n, m, m), np.float32)
    out = [address(a) for a in (p, bread, light, residual, model, sums)]
    given_at = [address(a) for a in given]
    if _declared(library).helmstar_fit(*given_at[:6], n, m, given_at[6], tight, iterations, *out):
        return None
    p[:, 1] += sky
    return Fit(p, bread, light, residual, model, sums)


@cache
def _declared(library: Any) -> Any:
    """The library with the types of what is called here."""
    library.helmstar_fit.argtypes = [c_void_p] * 6 + [c_int64, c_int, c_void_p, c_double, c_int] + [c_void_p] * 6
    return library


def _model(F: np.ndarray, flux: np.ndarray) -> np.ndarray:
    """Light (n, m, m) of each pixel for factors F and flux (n, 1)."""
    return (flux * F[1, :, 0])[:, :, None] * F[0, :, 0, None, :]


def _prior(spread: np.ndarray, flux: np.ndarray, m: int) -> np.ndarray:
    """(n, 6) information on sky and widths over flux^2."""
    prior = np.zeros((len(flux), 6), np.float32)
    prior[:, 1] = 2.0 * m
    np.square(spread / flux, out=prior[:, 4:])
    return prior


def _normal(F: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """J^T J over flux^2 with the prior and a trace of damping, (n, 6, 6)."""
    n = len(prior)
    gram = (F @ F.transpose(0, 1, 3, 2)).reshape(2, n, 16)
    A = gram[1].take(_BY_Y, axis=1)
    A *= gram[0].take(_BY_X, axis=1)
    diagonal = A[:, ::7]
    diagonal += prior
    diagonal *= np.float32(1.0 + 1e-6)
    return A.reshape(n, 6, 6)


def gain_of(f: Fit, noise: np.ndarray, use: np.ndarray) -> float:
    """Variance for each unit of light that the residuals of the stars `use` (n,) show beyond the noise (n,); at least 0.

    A fit takes part of the variance with it: with the projection H = J bread J^T on its parameters the squared residuals sum to
    noise^2 (pixels - parameters) + gain (sum of light - trace(bread light)). For sharp optics that last bracket is a small part
    of the light. The median over stars: one double star or one hot pixel does not decide.
    """
    some = np.flatnonzero(use)
    if not some.size:
        return 0.0
    total, _, left, taken = f.sums[some].T
    excess = left - noise[some] ** 2 * (f.residual[0].size - _PARAMETERS)
    bare = np.maximum(total - taken, 0.02 * total)
    ratio = np.sort(excess / bare)
    return float(max(0.5 * (ratio[(len(ratio) - 1) // 2] + ratio[len(ratio) // 2]), 0.0))


__all__ = ["ITERATIONS", "MIN_SIGMA", "Fit", "fit", "gain_of"]
