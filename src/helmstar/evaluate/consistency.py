"""Is a filter as good as it says? NEES and NIS against chi-square bands.

NEES of a run at a time is xi^T P^-1 xi with the filter's own error and covariance: both must live on the same side and in
the same frame (an error on the left with a covariance of the right is silently wrong). Averaged over runs, N times the
mean is chi-square with N n degrees of freedom when the filter is consistent. Source: Bar-Shalom, Li and Kirubarajan,
"Estimation with Applications to Tracking and Navigation" (2001), section 5.4.
"""

from __future__ import annotations

import numpy as np


def chi_square_band(dof: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean over independent runs of a chi-square variable with `dof` degrees of freedom.

    Raises ValueError for dof or runs below 1 or a probability outside (0, 1).
    """
    from scipy.stats import chi2

    if dof < 1 or runs < 1 or not 0.0 < probability < 1.0:
        raise ValueError(
            f"dof {dof}, runs {runs}, probability {probability}: dof and runs from 1, probability in (0, 1)"
        )
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], dof * runs) / runs
    return float(low), float(high)


def quadratic_form(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """error^T cov^-1 error over the last axes; NaN where the covariance is singular or an entry is not finite."""
    error, cov = np.asarray(error, float), np.asarray(cov, float)
    ok = np.asarray(np.isfinite(error).all(-1) & np.isfinite(cov).all((-2, -1)))
    safe = np.where(ok[..., None, None], cov, np.eye(cov.shape[-1]))
    ok &= np.linalg.slogdet(safe).sign != 0  # a determinant itself would underflow
    safe = np.where(ok[..., None, None], safe, np.eye(cov.shape[-1]))
    x = np.linalg.solve(safe, np.where(ok[..., None], error, 0.0)[..., None])[..., 0]
    return np.where(ok, np.sum(np.where(ok[..., None], error, 0.0) * x, axis=-1), np.nan)


def correlation_factor(values: np.ndarray) -> float:
    """By how much the correlation in time widens the band of a mean over runs (axis 0) and times (axis 1).

    The variance of the runs' time means over what independent samples would give: a pooled NEES over updates is not
    a mean of independent numbers. At least 1. With a single run 1 is returned.
    """
    values = np.asarray(values, float)
    if values.shape[0] < 2:
        return 1.0
    within = np.nanvar(values)
    if not within > 0:
        return 1.0
    return float(max(np.nanvar(np.nanmean(values, axis=1), ddof=1) * values.shape[1] / within, 1.0))
