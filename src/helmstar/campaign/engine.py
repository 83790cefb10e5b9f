"""Compile an experiment's programs once, side by side, and compute blocks of runs with them.

A block is `width` runs with consecutive numbers, always the same ones: block i holds runs i * width up to (i + 1) * width.
So a run sits in the same lane of the same compiled program whatever the number of runs, the batch, the worker or the
resume, and its bits are the same. The tail is padded with the runs that would come next.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..backend import compile_program, jax, jnp
from ..scenarios.experiment import Call, Experiment

_PROGRAMS: dict[Any, Any] = {}
"""Compiled programs of this process: a second campaign with other data compiles nothing."""


@dataclass(frozen=True)
class Block:
    """Results of one block: runs (width,) their numbers, arrays[estimator][variable] (width, time, ...), and seconds of
    computation for each estimator."""

    index: int
    runs: np.ndarray
    arrays: Mapping[str, Mapping[str, np.ndarray]]
    seconds: Mapping[str, float]


def _shapes(tree: Any) -> tuple:
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((jnp.shape(a), jnp.result_type(a)) for a in leaves)


class Engine:
    """Programs of an experiment for the named estimators."""

    def __init__(self, experiment: Experiment, names: Iterable[str]):
        self.experiment = experiment
        self.names = tuple(names)
        ids = jnp.arange(experiment.width)
        sim = experiment.simulate
        self._data_shape = jax.eval_shape(sim.function, *sim.arguments, ids)
        self._jobs = {self._key(sim, ids): (sim, ids)}
        for name in self.names:
            call = experiment.estimators[name]
            self._jobs.setdefault(self._key(call, self._data_shape), (call, self._data_shape))

    @staticmethod
    def _key(call: Call, data: Any) -> Any:
        return call.function, tuple(sorted(call.static.items())), _shapes((call.arguments, data))

    @property
    def programs(self) -> int:
        """How many programs there are still to compile."""
        return len(self._missing())

    def compile(self, workers: int, done: Callable[[], None] = lambda: None) -> None:
        """Compile all programs, `workers` at a time; `done` is called after each."""

        def job(key: Any) -> tuple[Any, Any]:
            call, data = self._jobs[key]
            return key, compile_program(call.function.lower(*call.arguments, data, **call.static))

        with ThreadPoolExecutor(workers) as pool:
            for future in as_completed([pool.submit(job, key) for key in self._missing()]):
                key, program = future.result()
                _PROGRAMS[key] = program
                done()

    def _missing(self) -> list[Any]:
        return [key for key in self._jobs if key not in _PROGRAMS]

    def compute(self, index: int, done: Callable[[], None] = lambda: None) -> Block:
        """One block; `done` is called after each estimator."""
        e = self.experiment
        runs = np.arange(index * e.width, (index + 1) * e.width)
        ids = jnp.asarray(runs)
        data = jax.block_until_ready(_PROGRAMS[self._key(e.simulate, ids)](*e.simulate.arguments, ids))
        arrays, seconds = {}, {}
        for name in self.names:
            call = e.estimators[name]
            program = _PROGRAMS[self._key(call, self._data_shape)]
            start = time.perf_counter()
            result = jax.block_until_ready(program(*call.arguments, data))
            seconds[name] = time.perf_counter() - start
            arrays[name] = {k: np.asarray(v).astype(e.variables[k].dtype) for k, v in result.items()}
            done()
        return Block(index, runs, arrays, seconds)


def compute_block(name: str, specification: Mapping[str, Any], names: tuple[str, ...], index: int) -> Block:
    """One block from nothing but data: what a worker elsewhere is asked for. Programs stay in its process."""
    from ..scenarios.specification import build, specification_of, validate

    spec = validate(specification_of(specification["experiment"]), specification, "campaign")
    engine = Engine(build(name, spec), names)
    engine.compile(1)
    return engine.compute(index)
