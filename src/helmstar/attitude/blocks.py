"""How the arithmetic solvers run: NumPy directly, JAX as one program; large batches in blocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from . import components as c
from .wahba import WahbaSolution, namespace

BLOCK = {"numpy": 4096, "cpu": 256}
"""Problems in a block: with a hundred intermediate arrays, a block stays in the processor's cache where a batch does not."""


def run(kernel: Callable[[c.Directions], WahbaSolution], *arguments: Any) -> WahbaSolution:
    """kernel on the arguments b, r, sigma, mask, weights of a solver, in blocks if there are many problems."""
    xp = namespace(*arguments)
    arguments = tuple(None if a is None else xp.asarray(a) for a in arguments)
    if xp is np:
        with np.errstate(all="ignore"):  # what is not finite comes back as not observable
            return _run(kernel, arguments, BLOCK["numpy"], np)
    return _compiled(kernel)(arguments)


@cache
def _compiled(kernel: Callable[[c.Directions], WahbaSolution]) -> Any:
    """One program for each kernel and shape; a thousand small ones where JAX runs operation by operation."""
    from ..backend import jax, jnp

    block = BLOCK.get(jax.default_backend(), 0)
    return jax.jit(lambda arguments: _run(kernel, arguments, block, jnp))


def _run(
    kernel: Callable[[c.Directions], WahbaSolution], arguments: tuple, block: int, xp: ModuleType
) -> WahbaSolution:
    """kernel in blocks of so many problems, or in one for 0."""
    own = (2, 2, 1, 1, 1)  # axes of one problem
    leading = [() if a is None else a.shape[: max(a.ndim - k, 0)] for a, k in zip(arguments, own, strict=True)]
    try:
        batch = np.broadcast_shapes(*leading)
    except ValueError:
        shapes = ", ".join(str(a.shape) for a in arguments if a is not None)
        raise ValueError(f"shapes {shapes}: leading axes must be the same or broadcast") from None
    count = math.prod(batch)
    if not block or count < 2 * block:
        return kernel(c.directions(xp, *arguments))
    # Arguments with batch axes get all of them as one; those of a single problem are shared by all blocks.
    flat = [
        xp.broadcast_to(a, batch + a.shape[a.ndim - k :]).reshape(count, *a.shape[a.ndim - k :]) if axes else a
        for a, axes, k in zip(arguments, leading, own, strict=True)
    ]

    def part(cut: Callable[[Any], Any]) -> WahbaSolution:
        pieces = [cut(a) if axes else a for a, axes in zip(flat, leading, strict=True)]
        return kernel(c.directions(xp, *pieces))

    out = (_numpy_blocks if xp is np else _jax_blocks)(part, count, block)
    return WahbaSolution(*(x.reshape(*batch, *x.shape[1:]) for x in out))


def _numpy_blocks(part: Callable[..., WahbaSolution], count: int, block: int) -> list:
    """Solutions (count, ...) block by block."""
    parts = [part(lambda a, i=i: a[i : i + block]) for i in range(0, count, block)]
    return [np.concatenate(p) for p in zip(*parts, strict=True)]


def _jax_blocks(part: Callable[..., WahbaSolution], count: int, block: int) -> list:
    """The same as a loop in the compiled program. The last block starts early enough to be full."""
    from ..backend import jax, jnp

    def at(start: Any) -> WahbaSolution:
        return part(lambda a: jax.lax.dynamic_slice_in_dim(a, start, block))

    def step(i: Any, out: list) -> list:
        start = jnp.minimum(i * block, count - block)
        return [jax.lax.dynamic_update_slice_in_dim(o, x, start, 0) for o, x in zip(out, at(start), strict=True)]

    empty = [jnp.zeros((count, *s.shape[1:]), s.dtype) for s in jax.eval_shape(at, 0)]
    return jax.lax.fori_loop(0, -(-count // block), step, empty)
