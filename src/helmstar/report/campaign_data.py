"""A campaign's dataset as the arrays that its report needs, in degrees, robust against whatever is missing."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from . import numbers
from .encode import extremes, spread

if TYPE_CHECKING:
    import xarray

SHOWN_POINTS = 400  # of smooth series (quantiles, bands)
SINGLE_POINTS = 1000  # of noisy series (single runs, averages)
SINGLE_RUNS = 3
THRESHOLDS = {"1 deg": 1.0, "0.1 deg": 0.1}


@dataclass(frozen=True)
class Campaign:
    """Arrays by estimator; errors (run, time, axis) in degrees, `update` (time,) the number of the measurement."""

    names: list[str]
    update: np.ndarray
    run_ids: np.ndarray
    errors: dict[str, np.ndarray]
    sigmas: dict[str, np.ndarray]
    nees: dict[str, np.ndarray]
    nis: dict[str, np.ndarray]
    nis_dof: dict[str, np.ndarray]
    bound: np.ndarray
    truth: np.ndarray | None
    us_per_step: dict[str, float]
    attrs: dict[str, Any]
    summary: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def from_dataset(cls, dataset: xarray.Dataset, summary: dict[str, Any]) -> Campaign:
        """Read each variable once. A missing variable becomes NaN."""
        names = [str(name) for name in np.atleast_1d(dataset["estimator"].values)]
        runs, times = dataset.sizes["run"], dataset.sizes["time"]
        update = dataset["update"].values if "update" in dataset.variables else np.arange(1, times + 1)

        def by_estimator(name: str, *more: str) -> dict[str, np.ndarray]:
            if name not in dataset:
                return {one: np.full((runs, times, *[3] * len(more)), np.nan) for one in names}
            values = dataset[name].transpose("estimator", "run", "time", *more).values
            return {one: values[i] for i, one in enumerate(names)}

        bound = np.full((times, 3), np.nan)
        if "bound_rad" in dataset:
            bound = np.degrees(dataset["bound_rad"].transpose("time", "axis").values)
        truth = None
        if "truth_q_bn" in dataset:
            turned = dataset["truth_q_bn"].transpose(..., "time", "quaternion").values
            truth = turned[0] if turned.ndim == 3 else turned
        speed = np.full(len(names), np.nan)
        if "us_per_step" in dataset:
            speed = np.atleast_1d(dataset["us_per_step"].values)
        return cls(
            names=names,
            update=np.asarray(update, dtype=float),
            run_ids=np.asarray(dataset["run"].values) if "run" in dataset.coords else np.arange(runs),
            errors={name: np.degrees(_finite(value)) for name, value in by_estimator("error_rad", "axis").items()},
            sigmas={name: np.degrees(value) for name, value in by_estimator("sigma_rad", "axis").items()},
            nees=by_estimator("nees"),
            nis=by_estimator("nis"),
            nis_dof=by_estimator("nis_dof"),
            bound=bound,
            truth=truth,
            us_per_step={name: float(speed[i]) for i, name in enumerate(names)},
            attrs=dict(dataset.attrs),
            summary=summary,
        )

    @property
    def scenario(self) -> str:
        """The scenario's name."""
        return str(self.attrs.get("scenario") or self.summary.get("scenario") or "campaign")

    @property
    def seed(self) -> str:
        """The seed, as text."""
        return str(self.attrs.get("seed", self.summary.get("seed", "unknown")))

    @property
    def runs(self) -> int:
        """Runs that are finished."""
        return len(self.run_ids)

    @property
    def requested(self) -> int:
        """Runs that were asked for."""
        return int(self.attrs.get("requested_runs", self.runs))

    @property
    def nees_dof(self) -> int:
        """Degrees of freedom of NEES."""
        return int(self.attrs.get("nees_dof", 3))

    @property
    def times(self) -> int:
        """Updates per run."""
        return len(self.update)

    def figures(self, name: str) -> dict[str, Any]:
        """What the summary says about one estimator."""
        return (self.summary.get("estimators") or {}).get(name) or {}

    @cached_property
    def totals(self) -> dict[str, np.ndarray]:
        """Total error angle (run, time) in degrees; infinite where a run has no number any more."""
        return {name: numbers.total_angle(error) for name, error in self.errors.items()}

    @cached_property
    def shown(self) -> np.ndarray:
        """Indices along time at which smooth series are drawn."""
        return spread(self.times, SHOWN_POINTS)

    @cached_property
    def settled(self) -> dict[str, dict[str, np.ndarray]]:
        """By threshold, by estimator: the update at which each run settles below it, NaN for never."""
        return {
            text: {name: numbers.settled_at(total, self.update, limit) for name, total in self.totals.items()}
            for text, limit in THRESHOLDS.items()
        }

    @cached_property
    def medians(self) -> dict[str, np.ndarray]:
        """Median total angle at the shown updates, by estimator."""
        shown = self.shown
        return {name: _finite(numbers.quantiles(total[:, shown], (0.5,))[0]) for name, total in self.totals.items()}

    def lost_runs(self) -> dict[str, int]:
        """How many runs of which estimator end without a finite error; only those that have any."""
        ends = {name: int(np.sum(~np.isfinite(total[:, -1]))) for name, total in self.totals.items()}
        return {name: count for name, count in ends.items() if count}

    def quantiles_by_axis(self, name: str) -> np.ndarray:
        """5%, 50% and 95% of the signed error, (3, shown, axis)."""
        return numbers.quantiles(self.errors[name][:, self.shown], (0.05, 0.5, 0.95))

    def quantiles_total(self, name: str) -> np.ndarray:
        """5%, 50% and 95% of the total angle, (3, shown)."""
        return _finite(numbers.quantiles(self.totals[name][:, self.shown], (0.05, 0.5, 0.95)))

    def sigma(self, name: str) -> np.ndarray:
        """Median over runs of the filter's own 1 sigma, (shown, axis)."""
        return numbers.quantiles(self.sigmas[name][:, self.shown], (0.5,))[0]

    def single_runs(self, name: str) -> list[tuple[str, np.ndarray]]:
        """(name, indices along time at which to draw it) of the first runs."""
        first = self.errors[name][:SINGLE_RUNS]
        return [(f"run {self.run_ids[i]}", extremes(error.T, SINGLE_POINTS)) for i, error in enumerate(first)]


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, np.nan)
