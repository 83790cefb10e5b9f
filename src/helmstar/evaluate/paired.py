"""Compare two estimators on the same draws: the difference of each run, so that what the draws share drops out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class PairedDifference(NamedTuple):
    """Mean of a - b over runs, its standard error, mean over standard error (sigmas), and runs with a < b."""

    mean: float
    standard_error: float
    sigmas: float
    wins: int
    runs: int


def paired_difference(a: np.ndarray, b: np.ndarray) -> PairedDifference:
    """Of one score per run (smaller is better), run k of both from the same draw.

    Runs where either is not finite are left out and so lower `runs`. Raises ValueError when the lengths differ or
    fewer than two runs remain.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"scores of shape {a.shape} and {b.shape}: must be one score for each of the same runs")
    d = (a - b)[np.isfinite(a) & np.isfinite(b)]
    if d.size < 2:
        raise ValueError(f"{d.size} runs with both scores finite: at least 2 are needed")
    mean, error = float(d.mean()), float(d.std(ddof=1) / np.sqrt(d.size))
    sigmas = mean / error if error > 0 else (0.0 if mean == 0 else float(np.copysign(np.inf, mean)))
    return PairedDifference(mean, error, sigmas, int(np.sum(d < 0)), int(d.size))
