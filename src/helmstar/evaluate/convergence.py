"""When does a run arrive, and does it stay? Counts over runs, never averages that hide a lost one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Arrival(NamedTuple):
    """runs: how many go below the limit and stay to the end. by: the update (1 is the first) at which the last run
    goes below and stays, None if one never does. updates: that update of each run, 0 where it never does."""

    runs: int
    by: int | None
    updates: np.ndarray


def arrival(angle: np.ndarray, limit: float) -> Arrival:
    """Of angles (runs, updates) against a limit in the same unit. A value that is not finite is above every limit."""
    above = ~(np.asarray(angle) < limit)
    last_above = above.shape[1] - np.argmax(above[:, ::-1], axis=1)  # 1-based update of the last one above
    last_above = np.where(above.any(axis=1), last_above, 0)
    arrives = last_above < above.shape[1]
    updates = np.where(arrives, last_above + 1, 0)
    return Arrival(int(arrives.sum()), int(updates.max()) if arrives.all() else None, updates)


def diverged(final_angle: np.ndarray, limit: float) -> int:
    """Runs whose final angle is above the limit or not finite."""
    return int(np.sum(~(np.asarray(final_angle) <= limit)))
