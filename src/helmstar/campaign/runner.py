"""Run a campaign: blocks over workers, progress with the time left, what is finished kept whatever happens."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from .. import __version__
from ..errors import CampaignError, ConfigurationError
from ..files import replacing
from ..progress import Progress
from ..scenarios.experiment import Experiment
from ..versions import versions
from .engine import Block, Engine, compute_block, compute_blocks
from .programs import has_cache
from .store import Store


@dataclass(frozen=True)
class Outcome:
    """dataset: all finished runs; summary: the object of `--json`; interrupted: Ctrl-C came before the last run."""

    dataset: xr.Dataset
    summary: dict[str, Any]
    interrupted: bool


def default_workers() -> int:
    """One for each core this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:  # not on every system
        return max(1, os.cpu_count() or 1)


def choose(experiment: Experiment, wanted: Iterable[str] | None) -> list[str]:
    """The wanted estimators in the experiment's order, all by default; ConfigurationError names an unknown one."""
    known = list(experiment.estimators)
    if wanted is None:
        return known
    wanted = list(dict.fromkeys(w.strip() for w in wanted if w.strip()))
    unknown = [w for w in wanted if w not in known]
    if unknown or not wanted:
        what = ", ".join(map(repr, unknown)) or "none given"
        raise ConfigurationError(f"--estimators: {what} is not allowed: must be of {', '.join(known)}")
    return [k for k in known if k in wanted]


def run_campaign(
    experiment: Experiment,
    *,
    runs: int,
    seed: int,
    folder: Path,
    specification: dict[str, Any],
    configuration: str,
    command: str,
    estimators: Sequence[str] | None = None,
    resume: bool = False,
    workers: int | None = None,
    batch: int | None = None,
    dask: str | None = None,
    progress: bool = True,
    processes: bool = False,
) -> Outcome:
    """All runs of a campaign, in `folder`.

    specification: the validated keys (for the manifest); configuration: the same as TOML or JSON text for the report;
    command: what reproduces it; batch: runs that a worker takes at a time, rounded up to whole blocks; dask: address of a
    scheduler that computes the blocks instead. Raises CampaignError or ConfigurationError; on Ctrl-C the outcome holds what is
    finished, and KeyboardInterrupt is raised only when nothing is. Without `resume` an earlier campaign's blocks in `folder` are
    discarded, which `progress` says on stderr. processes: other processes may help where the work is long enough (a script
    that sets this needs the usual guard of `__main__`).
    """
    begin = time.perf_counter()
    names = choose(experiment, estimators)
    workers = default_workers() if workers is None else workers
    relevant = {k: v for k, v in specification.items() if k not in ("runs", "title")}
    manifest = {
        "scenario": experiment.name,
        "runs": runs,
        "estimators": names,
        "helmstar_version": __version__,
        "specification": relevant,
        "command": command,
    }
    store = Store(folder, manifest, resume)
    if progress and store.discarded:
        print(f"discarded {store.discarded} of an earlier campaign in {folder}", file=sys.stderr)
    needed = range(-(-runs // experiment.width))
    done = set(store.finished())
    todo = [i for i in needed if i not in done]
    interrupted = False
    with Progress(progress) as bar:
        try:
            if todo and dask is not None:
                interrupted = _compute_on_dask(experiment, names, dask, store, todo, bar, runs)
            elif todo:
                engine = Engine(experiment, names)
                if engine.programs:
                    task = bar.add(f"compiling {engine.programs} programs", engine.programs)
                    engine.compile(workers, lambda: bar.advance(task))
                    bar.finish(task)
                interrupted = _compute(engine, store, todo, workers, batch or 1, bar, runs, processes)
        except KeyboardInterrupt:
            interrupted = True
    finished = [i for i in store.finished() if i in needed]
    dataset = store.load(finished, runs)
    if dataset is None:
        raise KeyboardInterrupt if interrupted else CampaignError(f"{folder}: no block could be kept")
    if not interrupted and dataset.sizes["run"] < runs:
        raise CampaignError(f"{folder}: a finished block could not be read; --resume computes it again")
    for key, (dims, values, attrs) in experiment.fixed().items():
        dataset[key] = (dims, values, attrs)
    dataset.attrs = {
        "scenario": experiment.name,
        "title": experiment.title,
        "seed": seed,
        "runs": dataset.sizes["run"],
        "requested_runs": runs,
        "command": command,
        "configuration": configuration,
        "versions": json.dumps(versions()),
        "helmstar_version": __version__,
        **experiment.attributes(),
    }
    metrics = experiment.summarise(dataset)
    wall = time.perf_counter() - begin
    dataset.attrs["wall_s"] = wall
    with replacing(folder / "results.nc") as part:
        dataset.to_netcdf(part, engine="h5netcdf")
    summary = {
        "scenario": experiment.name,
        "seed": seed,
        "runs": dataset.sizes["run"],
        "wall_s": round(wall, 3),
        "estimators": metrics,
    }
    return Outcome(dataset, summary, interrupted)


HELP_PAYS_S = 12.0
"""A process of its own costs some seconds to start: with less work than this left there is none."""


def _compute(
    engine: Engine, store: Store, todo: list[int], workers: int, batch: int, bar: Progress, runs: int, processes: bool
) -> bool:
    """Compute and keep the blocks; True when Ctrl-C cut it short (blocks under way are still kept).

    XLA's CPU runs one program at a time in a process, so threads alone leave cores idle (docs/performance.md). With
    `processes` the first blocks tell how long the rest takes, and where that pays other processes help, with the same
    programs from the cache, and so with the same bits.
    """
    task = bar.add(f"{runs} runs", len(todo) * len(engine.names))
    stop = False

    def job(indices: list[int]) -> None:
        for index in indices:
            if stop:
                return
            store.save(engine.compute(index, lambda: bar.advance(task)), engine.experiment)

    def keep(blocks: list[Block] | None) -> None:
        for block in blocks or []:  # None: computed here, and kept already
            store.save(block, engine.experiment)
            for _ in engine.names:
                bar.advance(task)

    def halt() -> None:
        nonlocal stop
        stop = True

    each = max(1, -(-batch // engine.experiment.width))
    queue = [todo[i : i + each] for i in range(0, len(todo), each)]
    helped = processes and workers > 1 and len(queue) > 2 and has_cache()
    with ThreadPoolExecutor(1 if helped else workers) as own:
        if not helped:
            interrupted, failure = _drain(queue, lambda piece: own.submit(job, piece), workers, keep, halt)
            return _settled(store, engine.experiment.width, failure, interrupted, bar, task)
        begin = time.perf_counter()
        interrupted, failure = _drain([queue.pop(0)], lambda piece: own.submit(job, piece), 1, keep, halt)
        left = (time.perf_counter() - begin) * len(queue)
        if not interrupted and failure is None:
            helpers = min(workers - 1, len(queue) - 1) if left > HELP_PAYS_S else 0
            with _helpers(helpers) as others:
                mine: set[Future] = set()
                spec = engine.experiment.spec.model_dump(mode="json")

                def submit(piece: list[int]) -> Future:
                    nonlocal mine
                    mine = {f for f in mine if not f.done()}
                    if others is None or not mine:
                        mine.add(future := own.submit(job, piece))
                        return future
                    return others.submit(compute_blocks, engine.experiment.name, spec, engine.names, piece)

                interrupted, failure = _drain(queue, submit, 1 + helpers, keep, halt)
    return _settled(store, engine.experiment.width, failure, interrupted, bar, task)


@contextmanager
def _helpers(count: int) -> Iterator[ProcessPoolExecutor | None]:
    """Processes that leave Ctrl-C to this one; None for none."""
    if not count:
        yield None
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_ignore_interrupts) as pool:
        yield pool


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _compute_on_dask(
    experiment: Experiment, names: list[str], address: str, store: Store, todo: list[int], bar: Progress, runs: int
) -> bool:
    """As `_compute`, with the blocks computed by the workers of a Dask cluster and kept here."""
    try:
        from distributed import Client
    except ImportError as error:
        raise CampaignError('--dask needs the extra: pip install "helmstar[dask]"') from error
    task = bar.add(f"{runs} runs on {address}", len(todo))
    try:
        # Not the process's default: xarray would ask a default one for a lock of every file, also when it is just closing.
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise CampaignError(f"--dask {address}: no scheduler answers there ({error})") from error
    with client, client.get_executor(pure=False) as pool:
        spec = experiment.spec.model_dump(mode="json")

        def keep(block: Block) -> None:
            store.save(block, experiment)
            bar.advance(task)

        def submit(piece: list[int]) -> Future:
            return pool.submit(compute_block, experiment.name, spec, tuple(names), piece[0])

        threads: Any = client.nthreads()
        ahead = 2 * max(1, sum(threads.values()))
        interrupted, failure = _drain([[i] for i in todo], submit, ahead, keep, lambda: None)
    return _settled(store, experiment.width, failure, interrupted, bar, task)


def _drain(
    queue: list[list[int]],
    submit: Callable[[list[int]], Future],
    ahead: int,
    keep: Callable[[Any], None],
    halt: Callable[[], None],
) -> tuple[bool, BaseException | None]:
    """Work the queue with `ahead` pieces under way; whether Ctrl-C came, and the first failure. Nothing new is begun after
    either, and what is under way is waited for and kept."""
    pending: set[Future] = set()
    interrupted, failure = False, None
    while queue or pending:
        try:
            while queue and len(pending) < ahead and failure is None:
                pending.add(submit(queue.pop(0)))
            if not pending:
                break
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                error = future.exception()
                if error is None:
                    keep(future.result())
                failure = failure or error
        except KeyboardInterrupt:
            interrupted = True
            queue.clear()
            halt()
    return interrupted, failure


def _settled(
    store: Store, width: int, failure: BaseException | None, interrupted: bool, bar: Progress, task: Any
) -> bool:
    if failure is not None:
        kept = len(store.finished()) * width
        raise CampaignError(f"a block failed: {failure}; {kept} runs are kept in {store.folder}") from failure
    if not interrupted:
        bar.finish(task)
    return interrupted
