"""Star directions made attitudes: each epoch with at least two different directions is solved by Davenport's q-method.

Solution and covariance hold all that the directions say of the attitude, so the filter's work does not grow with the
number of stars. What is left, by how much the stars of an epoch miss its solution, tells the noise of a direction, and
which star does not belong. An epoch with one direction goes to the filter as that direction.
"""

from __future__ import annotations

import numpy as np

from ..attitude import davenport
from ..io.problems import Problem
from ..io.telemetry import DirectionRows
from .timeline import SAME_INSTANT_S, Epochs

NARROWEST = 1e5
"""Largest variance of the turn about a common line, over the directions' own, that still is a solution: stars 0.3 deg apart."""
TOO_MANY = 0.2
"""If more epochs than this have a star that does not belong, it is the stated noise that is too small."""


def direction_epochs(rows: DirectionRows, sigma: float | None, probability: float) -> tuple[Epochs, list[Problem]]:
    """Epochs of rows of equal time, and the stars that were left out, each named.

    `sigma` is the noise of a direction's component in rad, if known; a star is refused wrongly with `probability`.
    """
    starts = np.concatenate([[True], np.diff(rows.time) > SAME_INSTANT_S])
    which = np.cumsum(starts) - 1
    first = np.flatnonzero(starts)
    slot = np.arange(len(rows)) - first[which]
    shape = (len(first), int(slot.max()) + 1)
    star_B, star_N = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    star_B[..., 0] = star_N[..., 0] = 1.0
    mask = np.zeros(shape, dtype=bool)
    star_B[which, slot], star_N[which, slot], mask[which, slot] = rows.star_B, rows.star_N, True

    solution = _solve(star_B, star_N, mask)
    problems: list[Problem] = []
    if probability > 0.0:
        bad = _strangers(star_B, star_N, mask, solution, sigma, probability)
        for e, k in zip(*np.nonzero(bad), strict=True):
            i = int(first[e] + k)
            message = "a star whose direction does not fit the other stars of its time"
            problems.append(Problem(rows.files[rows.file[i]], int(rows.row[i]), "jump", message, "dropped"))
        mask &= ~bad
        left = mask.any(axis=1)
        first, star_B, star_N, mask = first[left], star_B[left], star_N[left], mask[left]
        solution = _solve(star_B, star_N, mask) if bad.any() else solution
    one = np.argmax(mask, axis=1)
    here = np.arange(len(first))
    q, cov, misfit, dof = solution
    epochs = Epochs(
        rows.time[first], q, cov, rows.file[first], rows.row[first], rows.files,
        star_B[here, one], star_N[here, one], misfit, dof,
    )  # fmt: skip
    return epochs, problems


def _solve(star_B: np.ndarray, star_N: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, ...]:
    """q_BN (m, 4) or NaN, covariance over sigma^2 (m, 3, 3), misfit (m,) in rad^2 and its degrees of freedom (m,)."""
    s = davenport(star_B, star_N, 1.0, mask)
    good = np.asarray(s.observable) & (np.trace(np.nan_to_num(s.covariance), axis1=1, axis2=2) < NARROWEST)
    q = np.where(good[:, None], s.q_BN, np.nan)
    cov = np.where(good[:, None, None], s.covariance, np.eye(3))
    dof = np.where(good, 2 * mask.sum(axis=1) - 3, 0)
    return q, cov, np.where(good, 2.0 * np.maximum(np.nan_to_num(s.loss), 0.0), 0.0), dof


def robust_sigma(misfit: np.ndarray, dof: np.ndarray) -> float | None:
    """Noise of a direction's component by the median misfit, rad; None without any redundancy."""
    from scipy.special import gammaincinv

    some = dof > 0
    if not some.any():
        return None
    return float(np.sqrt(np.median(misfit[some] / (2.0 * gammaincinv(0.5 * dof[some], 0.5)))))


def _strangers(
    star_B: np.ndarray, star_N: np.ndarray, mask: np.ndarray, solution: tuple[np.ndarray, ...], sigma: float | None,
    probability: float,
) -> np.ndarray:  # fmt: skip
    """Mask (m, k) of stars that do not belong to their epoch: all of its stars where it cannot be said which."""
    from scipy.special import gammainccinv

    _, _, misfit, dof = solution
    typical = robust_sigma(misfit, dof)
    bad = np.zeros_like(mask)
    if typical is None:
        return bad
    # Equal digits on both sides leave no misfit at all; a rounding of 1e-9 is no stranger.
    variance = max(typical, sigma or 0.0, 1e-9) ** 2

    def fails(misfit: np.ndarray, dof: np.ndarray) -> np.ndarray:
        limit = 2.0 * gammainccinv(0.5 * np.maximum(dof, 1), probability)
        return (dof > 0) & (misfit > limit * variance)

    failed = fails(misfit, dof)
    if failed.mean() > TOO_MANY:
        return bad
    for e in np.flatnonzero(failed):
        left = mask[e].copy()
        while True:
            stars = np.flatnonzero(left)
            if len(stars) < 3:
                left[:] = False  # two stars that disagree: either may be wrong
                break
            trial = np.repeat(left[None], len(stars), axis=0)
            trial[np.arange(len(stars)), stars] = False
            n = len(stars)
            _, _, without, without_dof = _solve(
                np.repeat(star_B[e][None], n, axis=0), np.repeat(star_N[e][None], n, axis=0), trial
            )
            score = np.where(without_dof > 0, without, np.inf)
            best = int(np.argmin(score))
            left[stars[best]] = False
            if np.isfinite(score[best]) and not fails(without[best : best + 1], without_dof[best : best + 1])[0]:
                break
        bad[e] = mask[e] & ~left
    return bad
