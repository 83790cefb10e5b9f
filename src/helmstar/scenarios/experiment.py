"""What a campaign needs of a scenario: calls to compile, coordinates, and how results are summed up and judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Call:
    """A jitted module-level function with its static keywords and data arguments. Calls whose function, statics and
    argument shapes are equal share one compiled program, whatever their data (tunings) are."""

    function: Any
    arguments: tuple
    static: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Variable:
    """A recorded quantity: dims after run, dtype on disk and attributes (long_name, units, frame)."""

    dims: tuple[str, ...]
    dtype: str
    attrs: Mapping[str, str]


class Experiment(Protocol):
    """A scenario ready to run. `simulate` is called as function(*arguments, run_ids) for `width` run numbers and returns
    the data of these runs; an estimator is called as function(*arguments, data) and returns arrays (width, ...) of the
    variables. time, update (time,): s and number of the measurements that are recorded; steps: how many a run computes;
    coordinates: of the variables' dims beside time and axis."""

    name: str
    title: str
    spec: Any
    width: int
    time: np.ndarray
    update: np.ndarray
    steps: int
    coordinates: Mapping[str, Any]
    simulate: Call
    estimators: Mapping[str, Call]
    variables: Mapping[str, Variable]

    def fixed(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
        """Variables that do not depend on run and estimator (truth, bound): name -> (dims, values, attrs)."""
        ...

    def attributes(self) -> dict[str, Any]:
        """Of the dataset, for the report: `experiment`, `nees_dof` (degrees of freedom of `nees`), `pooled_text` (over what
        the metrics are pooled). For a paired comparison also `pooled_updates` (first and last, of a run's score) and
        `references` (JSON, estimator -> the one it is compared with)."""
        ...

    def summarise(self, dataset: Any) -> dict[str, dict]:
        """Metrics of each estimator, of finite numbers and None."""
        ...

    def claims(self, dataset: Any, summary: dict) -> list:
        """The paper's claims with what was found, for the report."""
        ...


Builder = Callable[[Any], Experiment]
