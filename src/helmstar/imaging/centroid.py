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

ITERATIONS = 6
MIN_SIGMA = 0.3
_LOOSE = 0.35  # relative spread of widths that the first guess allows
_ERF = (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429)
_PARAMETERS = 5.5  # of six, what the prior on sky and widths leaves free
_STILL = 4e-3  # px; smaller steps change nothing that noise leaves


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


def _factors(
    x: np.ndarray, y: np.ndarray, flux: np.ndarray, sigma: np.ndarray, half: int
) -> tuple[np.ndarray, np.ndarray]:
    """U (n, 6, m) along y and V (n, 6, m) along x: column k of the Jacobian is the outer product of row k of both.

    Along each axis: the share of a Gaussian in each pixel, its derivatives by centre and by width.
    """
    n, m = len(x), 2 * half + 1
    inverse = 1.0 / sigma.T[:, :, None]
    t = (np.arange(-half, half + 2) - 0.5 - np.stack([x, y])[:, :, None]) * inverse
    bell = np.exp(-0.5 * t * t)
    # Abramowitz and Stegun 7.1.26 (error below 1.5e-7): the exponential is at hand, and scipy.special takes 0.3 s to import.
    k = 1.0 / (1.0 + 0.3275911 * np.sqrt(0.5) * np.abs(t))
    tail = k * (_ERF[0] + k * (_ERF[1] + k * (_ERF[2] + k * (_ERF[3] + k * _ERF[4])))) * bell
    whole = np.copysign(1.0 - tail, t)
    slope = bell * (inverse / np.sqrt(2.0 * np.pi))
    share = 0.5 * (whole[..., 1:] - whole[..., :-1])
    by_centre = slope[..., :-1] - slope[..., 1:]
    slope *= t
    by_width = slope[..., :-1] - slope[..., 1:]
    U, V = np.empty((n, 6, m)), np.empty((n, 6, m))
    f = flux[:, None]
    U[:, 0], U[:, 1] = share[1], 1.0
    U[:, 2] = U[:, 4] = f * share[1]
    U[:, 3], U[:, 5] = f * by_centre[1], f * by_width[1]
    V[:, 0] = V[:, 3] = V[:, 5] = share[0]
    V[:, 1], V[:, 2], V[:, 4] = 1.0, by_centre[0], by_width[0]
    return U, V


def fit(
    windows: np.ndarray, x: np.ndarray, y: np.ndarray, sky: np.ndarray, noise: np.ndarray, width: np.ndarray, filled: np.ndarray,
    tight: float = _LOOSE, iterations: int = ITERATIONS,
) -> Fit:  # fmt: skip
    """Fit every window (n, m, m), m odd, from starts x, y (n,) relative to the middle pixel.

    sky, noise: (n,) from around the window; the sky is known as well as the noise of 2 m pixels allows. width: (2,) expected
    sigma of the stars along x and y, px, relative spread `tight`. filled: (n, m, m) bool, pixels that say nothing.
    """
    n, m, _ = windows.shape
    half = m // 2
    data = windows.astype(float)
    # x, y, flux and so on by column, as the parameters of `Fit`
    p = np.empty((n, 6))
    p[:, 0] = np.maximum(np.where(filled, 0.0, data - sky[:, None, None]).sum(axis=(1, 2)), noise)
    p[:, 1], p[:, 2], p[:, 3], p[:, 4:] = sky, x, y, width
    expected = np.concatenate([np.zeros((n, 1)), sky[:, None], np.zeros((n, 2)), np.tile(width, (n, 1))], axis=1)
    prior = np.zeros((n, 6))
    prior[:, 1] = 2.0 * m
    prior[:, 4:] = np.maximum(noise, 1e-9)[:, None] ** 2 / (tight * width) ** 2
    low, high = np.array([-np.inf, -half, -half, MIN_SIGMA, MIN_SIGMA]), np.array([np.inf, half, half, half, half])
    going = np.arange(n)
    for k in range(iterations):
        q = p[going]
        U, V = _factors(q[:, 2], q[:, 3], q[:, 0], q[:, 4:], half)
        rest = data[going] - (q[:, 0, None] * U[:, 0])[:, :, None] * V[:, 0, None, :] - q[:, 1, None, None]
        rest[filled[going]] = 0.0
        A = _normal(U, V, prior[going])
        g = np.sum((U @ rest) * V, axis=2) + prior[going] * (expected[going] - q)
        step = np.linalg.solve(A, g[..., None])[..., 0]
        np.clip(step[:, 2:], -0.5, 0.5, out=step[:, 2:])
        p[going, 0] = np.maximum(q[:, 0] + step[:, 0], 0.1 * q[:, 0])
        p[going, 1:] = np.clip(q[:, 1:] + step[:, 1:], low, high)
        if k:
            least = np.minimum(A[:, 2, 2], A[:, 3, 3])  # a tenth of what noise leaves, or the absolute bound
            going = going[np.abs(step[:, 2:4]).max(axis=1) > np.maximum(_STILL, 0.1 * noise[going] / np.sqrt(least))]
            if not going.size:
                break
    U, V = _factors(p[:, 2], p[:, 3], p[:, 0], p[:, 4:], half)
    model = (p[:, 0, None] * U[:, 0])[:, :, None] * V[:, 0, None, :]
    rest = data - model - p[:, 1, None, None]
    rest[filled] = 0.0
    light = ((U * U[:, :1]) @ U.transpose(0, 2, 1)) * ((V * V[:, :1]) @ V.transpose(0, 2, 1)) * p[:, 0, None, None]
    bread = np.linalg.inv(_normal(U, V, prior))
    return Fit(p[:, 2], p[:, 3], p[:, 0], p[:, 1], p[:, 4:], bread, light, rest, model)


def _normal(U: np.ndarray, V: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """J^T J with the prior and a trace of damping, (n, 6, 6)."""
    A = (U @ U.transpose(0, 2, 1)) * (V @ V.transpose(0, 2, 1))
    k = np.arange(6)
    A[:, k, k] = (A[:, k, k] + prior) * (1.0 + 1e-9)
    return A


def gain_of(f: Fit, noise: np.ndarray, use: np.ndarray) -> float:
    """Variance for each unit of light that the residuals of the stars `use` (n,) show beyond the noise (n,); at least 0.

    A fit takes part of the variance with it: with the projection H = J bread J^T on its parameters the squared residuals sum to
    noise^2 (pixels - parameters) + gain (sum of light - trace(bread light)). For sharp optics that last bracket is a small part
    of the light. The median over stars: one double star or one hot pixel does not decide.
    """
    if not use.any():
        return 0.0
    r = f.residual[use]
    total = f.model[use].sum(axis=(1, 2))
    left = np.maximum(total - np.einsum("nij,nji->n", f.bread[use], f.light[use]), 0.02 * total)
    excess = np.sum(r**2, axis=(1, 2)) - noise[use] ** 2 * (r[0].size - _PARAMETERS)
    return float(max(np.median(excess / left), 0.0))


__all__ = ["ITERATIONS", "MIN_SIGMA", "Fit", "fit", "gain_of"]
