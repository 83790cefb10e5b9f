"""Results of xu2020: the metrics of `--json`, and the paper's claims judged by them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..evaluate import arrival, diverged

CHECKPOINTS = (150, 600, 1000)
WINDOW = (200, 600)
"""Updates, both included, over which RMS, NEES and the ratio to the bound are pooled."""
LIMITS_DEG = {"1deg": 1.0, "0.1deg": 0.1}
DIVERGED_DEG = 10.0


def finite(x: Any) -> float | None:
    """A number for JSON: None where it is not finite."""
    x = float(x)
    return x if np.isfinite(x) else None


def rms(x: np.ndarray, axis: Any) -> np.ndarray:
    """Root mean square over the axes."""
    return np.sqrt(np.mean(np.square(x), axis=axis))


def summarise(dataset: Any) -> dict[str, dict]:
    """Metrics of each estimator; see README for the keys. A metric that the campaign is too short for is None or absent."""
    updates = dataset["update"].values
    marks = [k for k in CHECKPOINTS if k <= updates[-1]] or [int(updates[-1])]
    window = (updates >= WINDOW[0]) & (updates <= WINDOW[1])
    bound = rms(dataset["bound_rad"].values[window], 0) if window.any() else np.full(3, np.nan)
    out: dict[str, dict] = {}
    for name in map(str, dataset["estimator"].values):
        e = dataset["error_rad"].sel(estimator=name).values
        angle = np.degrees(np.linalg.norm(e, axis=-1))
        at = {str(k): int(k) - 1 for k in marks}
        pooled = rms(e[:, window], (0, 1)) if window.any() else np.full(3, np.nan)
        nees = dataset["nees"].sel(estimator=name).values[:, window].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = pooled / bound
        out[name] = {
            "rms_deg": {k: [finite(v) for v in np.degrees(rms(e[:, i], 0))] for k, i in at.items()},
            "median_error_deg": {k: finite(np.median(angle[:, i])) for k, i in at.items()},
            "converged": {
                key: {"runs": a.runs, "by": a.by}
                for key, a in ((key, arrival(angle, limit)) for key, limit in LIMITS_DEG.items())
            },
            "diverged": diverged(angle[:, -1], DIVERGED_DEG),
            "nees_mean": finite(nees.mean()) if nees.size else None,
            "rms_over_bound": [finite(v) for v in ratio],
            "us_per_step": finite(dataset["us_per_step"].sel(estimator=name).values),
        }
    return out
