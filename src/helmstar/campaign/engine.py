"""Compile an experiment's programs once, side by side, and compute blocks of runs with them.

A block is `width` runs with consecutive numbers, always the same ones: block i holds runs i * width up to (i + 1) * width.
So a run sits in the same lane of the same compiled program whatever the number of runs, the batch, the worker or the
resume, and its bits are the same. The tail is padded with the runs that would come next.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..scenarios.experiment import Call, Experiment
from .programs import compiled, exported, signature

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


class Engine:
    """Programs of an experiment for the named estimators."""

    def __init__(self, experiment: Experiment, names: Iterable[str]):
        self.experiment = experiment
        self.names = tuple(names)
        # Estimators that differ in data alone share one program.
        self._jobs: dict[Any, Call] = {self._key(experiment.simulate): experiment.simulate}
        for name in self.names:
            call = experiment.estimators[name]
            self._jobs.setdefault(self._key(call), call)

    def _key(self, call: Call) -> Any:
        """Of a program within this process. The width stands for the data: they follow from it and the simulation's shapes."""
        simulation = self.experiment.simulate
        return (
            call.function, tuple(sorted(call.static.items())), signature(call.arguments), self.experiment.width,
            simulation.function, signature(simulation.arguments),
        )  # fmt: skip

    @property
    def programs(self) -> int:
        """How many programs there are still to compile."""
        return len(self._missing())

    def _missing(self) -> list[Any]:
        return [key for key in self._jobs if key not in _PROGRAMS]

    def compile(self, workers: int, done: Callable[[], None] = lambda: None) -> None:
        """Compile all programs, `workers` at a time; `done` is called after each."""
        missing = self._missing()
        if not missing:
            return
        simulation = self.experiment.simulate
        ids = jax.ShapeDtypeStruct((self.experiment.width,), jnp.arange(0).dtype)
        lock, known = Lock(), []

        def data() -> Any:
            """Shapes of what the simulation gives, traced once and only if some program is not kept."""
            with lock:
                if not known:
                    known.append(jax.eval_shape(simulation.function, *simulation.arguments, ids))
                return known[0]

        def job(key: Any) -> tuple[Any, Any]:
            call = self._jobs[key]
            if call is simulation:
                return key, compiled(exported(call, ids))
            return key, compiled(exported(call, data, (simulation, ids)))

        with ThreadPoolExecutor(workers) as pool:
            for future in as_completed([pool.submit(job, key) for key in missing]):
                key, program = future.result()
                _PROGRAMS[key] = program
                done()

    def compute(self, index: int, done: Callable[[], None] = lambda: None) -> Block:
        """One block; `done` is called after each estimator."""
        e = self.experiment
        runs = np.arange(index * e.width, (index + 1) * e.width)
        simulation = _PROGRAMS[self._key(e.simulate)]
        data = jax.block_until_ready(simulation(*jax.tree.leaves(e.simulate.arguments), jnp.asarray(runs)))
        arrays, seconds = {}, {}
        for name in self.names:
            call = e.estimators[name]
            program = _PROGRAMS[self._key(call)]
            start = time.perf_counter()
            result = jax.block_until_ready(program(*jax.tree.leaves(call.arguments), *data))
            seconds[name] = time.perf_counter() - start
            # The leaves of a dictionary come in the order of its sorted keys.
            pairs = zip(sorted(e.variables), result, strict=True)
            arrays[name] = {k: np.asarray(v).astype(e.variables[k].dtype) for k, v in pairs}
            done()
        return Block(index, runs, arrays, seconds)


_ENGINES: dict[str, Engine] = {}
"""Of a worker's process: a scenario is built once."""


def compute_block(name: str, specification: Mapping[str, Any], names: tuple[str, ...], index: int) -> Block:
    """One block from nothing but data: what a worker elsewhere is asked for. Programs stay in its process."""
    from ..scenarios.specification import build, specification_of, validate

    key = json.dumps([name, specification, names], sort_keys=True)
    if key not in _ENGINES:
        spec = validate(specification_of(specification["experiment"]), specification, "campaign")
        engine = Engine(build(name, spec), names)
        engine.compile(1)
        _ENGINES.clear()
        _ENGINES[key] = engine
    return _ENGINES[key].compute(index)


def compute_blocks(
    name: str, specification: Mapping[str, Any], names: tuple[str, ...], indices: list[int]
) -> list[Block]:
    """Several of `compute_block`."""
    return [compute_block(name, specification, names, index) for index in indices]
