"""One step at a time, for live data: a filter compiled ahead of time, called on two flat arrays.

Inside a loop the price of a step is mostly that of handing a tree of many small arrays to the compiled program. So state and
input are packed into one flat array each; `Stream` does the packing, and `Stream.step_flat` is the bare call for who packs
by himself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..backend import compile_program, jax, jnp
from ..core import Filter, Gate, Measurement, Model
from .run import step

Array = jax.Array


class StepInfo(NamedTuple):
    """Of one sensor's update: NIS, degrees of freedom, log likelihood, status (see core)."""

    nis: float
    dof: int
    loglik: float
    status: int


class _Packing:
    """A tree of arrays as one flat float array: shapes and types fixed by a template."""

    def __init__(self, template: Any, what: str):
        leaves, self.structure = jax.tree.flatten(template)
        self.what = what
        self.shapes = [np.shape(leaf) for leaf in leaves]
        self.types = [np.asarray(leaf).dtype for leaf in leaves]
        sizes = [int(np.prod(shape)) for shape in self.shapes]
        self.bounds = np.concatenate([[0], np.cumsum(sizes)])
        self.size = int(self.bounds[-1])

    def pack(self, tree: Any, out: np.ndarray) -> np.ndarray:
        """Fill `out` (size,) with the numbers of a tree like the template. Raises ValueError for another shape."""
        leaves, structure = jax.tree.flatten(tree)
        if structure != self.structure:
            raise ValueError(f"{self.what}: {structure} given where the stream was built for {self.structure}")
        for leaf, shape, i, j in zip(leaves, self.shapes, self.bounds[:-1], self.bounds[1:], strict=True):
            a = np.asarray(leaf)
            if a.shape != shape:
                raise ValueError(
                    f"{self.what}: an array of shape {a.shape} given where the stream was built for {shape}"
                )
            out[i:j] = a.reshape(-1)
        return out

    def unpack(self, flat: Any) -> Any:
        """The tree of a flat array, NumPy's or JAX's."""
        xp = jnp if isinstance(flat, jax.Array) else np
        leaves = [
            xp.asarray(flat[i:j].reshape(shape), dtype=dtype)
            for i, j, shape, dtype in zip(self.bounds[:-1], self.bounds[1:], self.shapes, self.types, strict=True)
        ]
        return jax.tree.unflatten(self.structure, leaves)


class Stream:
    """A filter, model and gate compiled for one step.

    belief, u, dt and measurements are templates and give shapes and types; the belief is also the start. Every call
    predicts over dt under u and updates with the measurements, as `run` does. Raises ValueError for other shapes.
    """

    def __init__(
        self, filter: Filter, model: Model, belief: Any, u: Any, measurements: tuple[Measurement, ...], gate: Gate
    ):
        refused = np.zeros(len(model.sensors), dtype=int)
        self._state = _Packing((belief, refused), "belief")
        self._input = _Packing((u, np.zeros(()), measurements), "input")
        state, inputs, sensors = self._state, self._input, len(model.sensors)

        def flat_step(s: Array, i: Array) -> tuple[Array, Array]:
            belief, refused = state.unpack(s)
            u, dt, ms = inputs.unpack(i)
            belief, refused, _, infos = step(filter, model, belief, refused, u, dt, ms, gate)
            leaves = [jnp.ravel(leaf).astype(s.dtype) for leaf in jax.tree.leaves((belief, refused))]
            numbers = [jnp.stack([f.nis, f.dof.astype(s.dtype), f.loglik, f.status.astype(s.dtype)]) for f in infos]
            return jnp.concatenate(leaves), jnp.stack(numbers) if sensors else jnp.zeros((0, 4))

        self.state = state.pack((belief, refused), np.empty(state.size))
        self.buffer = np.zeros(self._input.size)
        lowered = jax.jit(flat_step).lower(self.state, self.buffer)
        self.step_flat: Callable[[Any, Any], tuple[Any, Any]] = compile_program(lowered)
        """(state, input) -> (state, numbers (sensors, 4)): the compiled call on flat arrays, nothing else."""

    def pack(self, u: Any, dt: float, measurements: tuple[Measurement, ...]) -> np.ndarray:
        """The flat input of a step, in the stream's own buffer."""
        return self._input.pack((u, np.asarray(dt), measurements), self.buffer)

    def step(self, u: Any, dt: float, measurements: tuple[Measurement, ...]) -> tuple[Any, tuple[StepInfo, ...]]:
        """Belief after the step, and what became of each sensor's measurement."""
        state, numbers = self.step_flat(self.state, self.pack(u, dt, measurements))
        self.state = np.asarray(state)
        infos = tuple(StepInfo(float(n), int(d), float(g), int(s)) for n, d, g, s in np.asarray(numbers).tolist())
        return self.belief, infos

    @property
    def belief(self) -> Any:
        """The belief now, of NumPy arrays."""
        return self._state.unpack(self.state)[0]
