"""Where a star is: least squares of a Gaussian, integrated over each pixel, in a small window of every star at once.

A centre of mass, weighted or not, is pulled towards pixel centres when optics are sharper than a pixel; a fit of what the pixels
really integrate is not. Weights are equal, so every sum over a window is a product of sums along rows and columns, and
the covariance is that of equal weights under the true noise (the sandwich A^-1 (J^T V J) A^-1):

    V of a pixel = noise^2 + gain * light,

with the light's share (counts of image per photo-electron, and whatever the model misses) estimated from the residuals of all the
stars of the image. Pixels that are saturated or outside of the image are filled by the model, again and again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

ITERATIONS = 8
MIN_SIGMA = 0.3
_LOOSE = 0.35  # relative spread of widths that the first guess allows
_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True)
class Fit:
    """x, y: (n,) centre relative to the window's middle pixel. flux, sky: (n,). sigma: (n, 2) width along x and y, px.

    bread: (n, 6, 6) inverse of J^T J; light: (n, 6, 6) J^T diag(model above the sky) J. Parameters: flux, sky, x, y, sigma_x,
    sigma_y. residual: (n, m, m) window minus model, 0 where filled. model: (n, m, m) without the sky.
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    sky: np.ndarray
    sigma: np.ndarray
    bread: np.ndarray
    light: np.ndarray
    residual: np.ndarray
    model: np.ndarray

    def covariance(self, noise: np.ndarray, gain: float) -> np.ndarray:
        """(n, 6, 6) for a noise (n,) of each pixel without light and `gain` of variance for each unit of light."""
        return noise[:, None, None] ** 2 * self.bread + gain * (self.bread @ self.light @ self.bread)


def _profile(centre: np.ndarray, sigma: np.ndarray, half: int) -> np.ndarray:
    """(n, 3, m): share of a Gaussian in each pixel along one axis, its derivatives by centre and by width."""
    edges = np.arange(-half, half + 2) - 0.5
    t = (edges - centre[:, None]) / sigma[:, None]
    whole = 0.5 * erf(t / _ROOT2)
    slope = np.exp(-0.5 * t * t) * (1.0 / np.sqrt(2.0 * np.pi) / sigma[:, None])
    return np.stack([np.diff(whole), -np.diff(slope), -np.diff(t * slope)], axis=1)


def _factors(x: np.ndarray, y: np.ndarray, flux: np.ndarray, sigma: np.ndarray, half: int) -> tuple[np.ndarray, ...]:
    """U (n, 6, m) along y and V (n, 6, m) along x: column k of the Jacobian is the outer product of row k of both."""
    px, py = _profile(x, sigma[:, 0], half), _profile(y, sigma[:, 1], half)
    f = flux[:, None]
    one = np.ones_like(px[:, 0])
    U = np.stack([py[:, 0], one, f * py[:, 0], f * py[:, 1], f * py[:, 0], f * py[:, 2]], axis=1)
    V = np.stack([px[:, 0], one, px[:, 1], px[:, 0], px[:, 2], px[:, 0]], axis=1)
    return U, V


def fit(
    windows: np.ndarray, x: np.ndarray, y: np.ndarray, sky: np.ndarray, noise: np.ndarray, width: float, filled: np.ndarray,
    tight: float = _LOOSE,
) -> Fit:  # fmt: skip
    """Fit every window (n, m, m), m odd, from starts x, y (n,) relative to the middle pixel.

    sky, noise: (n,) from around the window; the sky is known as well as the noise of 2 m pixels allows. width: expected sigma
    of the stars, px, relative spread `tight`. filled: (n, m, m) bool, pixels that say nothing.
    """
    n, m, _ = windows.shape
    half = m // 2
    data = windows.astype(float)
    masked = filled.any(axis=(1, 2))
    sigma = np.full((n, 2), float(width))
    sky0, sky = sky, sky.astype(float)
    x, y = x.astype(float), y.astype(float)
    flux = np.maximum(np.where(filled, 0.0, data - sky[:, None, None]).sum(axis=(1, 2)), noise)
    variance = np.maximum(noise, 1e-9) ** 2
    prior = np.zeros((n, 6))
    prior[:, 1] = 2.0 * m
    prior[:, 4:] = (variance / (tight * width) ** 2)[:, None]
    A = np.empty((n, 6, 6))
    U, V = _factors(x, y, flux, sigma, half)
    rest = data
    eye = np.arange(6)
    for k in range(ITERATIONS):
        model = flux[:, None, None] * U[:, 0, :, None] * V[:, 0, None, :]
        rest = data - model - sky[:, None, None]
        if masked.any():
            rest[filled] = 0.0
        A = (U @ U.transpose(0, 2, 1)) * (V @ V.transpose(0, 2, 1))
        g = np.sum((U @ rest) * V, axis=2)
        A[:, eye, eye] += prior
        g[:, 1] += prior[:, 1] * (sky0 - sky)
        g[:, 4:] += prior[:, 4:] * (width - sigma)
        A[:, eye, eye] *= 1.0 + 1e-9
        step = np.linalg.solve(A, g[..., None])[..., 0]
        # What a saturated star lacks is filled from the model, so its flux has far to go: a larger step, still a safe one.
        limit = 0.5 * np.minimum(1.0, np.abs(flux) + 1e-9)
        step[:, 2:] = np.clip(step[:, 2:], -0.5, 0.5)
        x, y = np.clip(x + step[:, 2], -half, half), np.clip(y + step[:, 3], -half, half)
        flux = np.maximum(flux + step[:, 0], 1e-3 * np.maximum(limit, 1e-9))
        sky = sky + step[:, 1]
        sigma = np.clip(sigma + step[:, 4:], MIN_SIGMA, half)
        U, V = _factors(x, y, flux, sigma, half)
        if k > 1 and not np.abs(step[:, 2:4]).max() > 2e-3:
            break
    model = flux[:, None, None] * U[:, 0, :, None] * V[:, 0, None, :]
    rest = data - model - sky[:, None, None]
    rest[filled] = 0.0
    light = ((U * U[:, :1]) @ U.transpose(0, 2, 1)) * ((V * V[:, :1]) @ V.transpose(0, 2, 1)) * flux[:, None, None]
    return Fit(x, y, flux, sky, sigma, np.linalg.inv(A), light, rest, model)


def gain_of(residual: np.ndarray, model: np.ndarray, noise: np.ndarray, use: np.ndarray) -> float:
    """Variance for each unit of light that the residuals of the stars `use` (n,) show beyond the noise (n,); at least 0.

    One ratio for each star from the pixels in which it is bright, then the median: one double star or one hot pixel does not
    decide. The fit's own parameters take their share of the degrees of freedom.
    """
    if not use.any():
        return 0.0
    r, light = residual[use], np.maximum(model[use], 0.0)
    bright = light > 0.05 * light.max(axis=(1, 2), keepdims=True)
    count = bright.sum(axis=(1, 2))
    excess = np.sum(np.where(bright, r**2, 0.0), axis=(1, 2)) - count * noise[use] ** 2
    share = np.sum(np.where(bright, light, 0.0), axis=(1, 2)) * np.clip((count - 5.0) / count, 0.2, 1.0)
    return float(max(np.median(excess / share), 0.0))


__all__ = ["ITERATIONS", "MIN_SIGMA", "Fit", "fit", "gain_of"]
