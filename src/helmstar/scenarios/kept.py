"""Arrays that take minutes to make, such as what thousands of rendered frames show: made side by side, and kept in the user's
cache folder under a hash of all that they depend on, so that other processes and a resumed campaign find them."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..files import replacing

HELP_PAYS = 300
"""Fewer frames than this are made in this process: another one takes two seconds to start."""


def kept(
    facts: Any, arrays: Sequence[np.ndarray], rooms: Sequence[str], make: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """What `make` gives, from the cache where it was made before. facts: JSON; with the arrays and the sources of these rooms
    of helmstar all that it depends on."""
    path = _path(facts, arrays, rooms)
    found = _read(path)
    if found is None:
        found = dict(make())
        _keep(path, found)
    return found


def side_by_side(function: Callable[[Any], Any], tasks: Sequence[Any], workers: int, frames: int) -> Iterator[Any]:
    """Results in order, by several processes where that pays (a script then needs the usual guard of `__main__`)."""
    return _in_processes(function, tasks, workers) if workers > 1 and frames > HELP_PAYS else map(function, tasks)


def _in_processes(function: Callable[[Any], Any], tasks: Iterable[Any], workers: int) -> Iterator[Any]:
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_leave_interrupts) as pool:
        yield from pool.map(function, tasks)


def _leave_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _path(facts: Any, arrays: Sequence[np.ndarray], rooms: Sequence[str]) -> Path | None:
    """Where the arrays are kept; None where the cache is switched off."""
    from ..stars.patterns import cache_folder

    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.sha256(json.dumps([facts, _sources(tuple(rooms))], sort_keys=True).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return folder.parent / "frames" / f"{digest.hexdigest()[:32]}.npz"


@cache
def _sources(rooms: tuple[str, ...]) -> str:
    """Hash of the rooms' sources: other sources give other numbers."""
    root = Path(__file__).parent.parent
    digest = hashlib.sha256(np.__version__.encode())
    for f in (f for room in rooms for f in sorted((root / room).rglob("*.py"))):
        digest.update(f.read_bytes())
    return digest.hexdigest()


def _read(path: Path | None) -> dict[str, np.ndarray] | None:
    try:
        if path is not None and path.exists():
            with np.load(path, allow_pickle=False) as f:
                return {name: f[name] for name in f.files}
    except Exception:  # a damaged file: made again
        pass
    return None


def _keep(path: Path | None, arrays: Mapping[str, np.ndarray]) -> None:
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, open(part, "wb") as stream:
            np.savez(stream, allow_pickle=False, **{name: np.asarray(a) for name, a in arrays.items()})
    except OSError:  # a full or read-only home only means that they are made again
        pass


__all__ = ["HELP_PAYS", "kept", "side_by_side"]
