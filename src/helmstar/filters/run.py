"""Run any filter over a sequence: `lax.scan` over steps, `vmap` over runs outside.

At each step the belief is predicted to the step's end and then updated by every sensor that has a measurement there.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from ..backend import jax, jnp
from ..core import ABSENT, ACCEPTED, RESET, Filter, Gate, Info, Measurement, Model, Predicted, pytree

Array = jax.Array


@pytree
class Track:
    """Of every step: belief after the updates, its prediction (for a smoother), and one Info for each sensor."""

    belief: Any
    predicted: Predicted
    infos: tuple[Info, ...]


def step(
    filter: Filter, model: Model, belief: Any, refused: Array, u: Any, dt: Array,
    measurements: tuple[Measurement, ...], gate: Gate,
) -> tuple[Any, Array, Predicted, tuple[Info, ...]]:  # fmt: skip
    """One prediction and one update for each sensor. `refused` (n_sensors,) counts refusals in a row."""
    belief, predicted = filter.predict(belief, model.process, u, dt)
    infos, counts = [], []
    for i, (sensor, m) in enumerate(zip(model.sensors, measurements, strict=True)):
        belief, info = filter.update(belief, sensor, m, gate, refused[i])
        kept = jnp.where(info.status == ABSENT, refused[i], refused[i] + 1)
        counts.append(jnp.where((info.status == ACCEPTED) | (info.status == RESET), 0, kept))
        infos.append(info)
    return belief, jnp.stack(counts) if counts else refused, predicted, tuple(infos)


@partial(jax.jit, static_argnames=("filter", "keep"))
def run(
    filter: Filter, model: Model, belief: Any, u: Any, dt: Array, measurements: tuple[Measurement, ...], gate: Gate,
    refused: Array | None = None, keep: Any = Track,
) -> tuple[Any, Array, Any]:  # fmt: skip
    """Filter a whole sequence.

    belief: at the start, before the first step. u, dt and measurements: leading axis is the step; u[k], dt[k] lead to
    the time of measurements[.][k]. keep(belief, predicted, infos) says what is recorded of a step (a static function;
    default everything, as `Track`). Returns (last belief, refusals in a row (n_sensors,), record).
    """
    start = jnp.zeros(len(model.sensors), dtype=int) if refused is None else refused

    def body(carry, inputs):
        belief, refused = carry
        u, dt, ms = inputs
        belief, refused, predicted, infos = step(filter, model, belief, refused, u, dt, ms, gate)
        return (belief, refused), keep(belief, predicted, infos)

    (belief, refused), record = jax.lax.scan(body, (belief, start), (u, dt, measurements))
    return belief, refused, record
