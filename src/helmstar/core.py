"""The whole vocabulary: what a state, a process, a sensor, a measurement, a belief and a filter are.

Everything composes from the types below. Functions in them live at module level and are static (they are part of what
is compiled); parameters are data (a new tuning never compiles again). Any model meets any filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar, dataclass_transform

from .backend import jax, jnp
from .geometry.retraction import Retraction

Array = jax.Array
State = Any  # any pytree: an array, or a frozen dataclass registered with `pytree`


T = TypeVar("T")


def _register(cls: type[T], static: tuple[str, ...]) -> type[T]:
    made: Any = dataclass(frozen=True)(cls)
    names = [f for f in made.__dataclass_fields__ if f not in static]
    return jax.tree_util.register_dataclass(made, data_fields=names, meta_fields=list(static))


@dataclass_transform(frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass whose fields are JAX data."""
    return _register(cls, ())


@dataclass_transform(frozen_default=True)
def pytree_with(static: tuple[str, ...]) -> Callable[[type[T]], type[T]]:
    """Class decorator: a frozen dataclass whose fields are JAX data, but for those named in `static`, which are part of
    what is compiled."""
    return partial(_register, static=static)


@dataclass(frozen=True)
class Noise:
    """Driving noise w of a process, of zero mean: `cov(params, x, u, dt)` is its covariance (dim, dim) over one step.

    sample(params, x, u, dt, key) draws w (dim,), logpdf(params, x, u, dt, w) is its log density: None stands for a Gaussian.
    Kalman filters use the covariance alone. A known mean belongs to the step.
    """

    cov: Callable[[Any, State, Any, Array], Array]
    dim: int
    sample: Callable[[Any, State, Any, Array, Array], Array] | None = None
    logpdf: Callable[[Any, State, Any, Array, Array], Array] | None = None


@pytree_with(static=("step", "noise", "jacobian"))
class Process:
    """x' = step(params, x, u, dt, w). `jacobian(params, x, u, dt)` returns (F, G) for the model's retraction, or is None:
    then both come from automatic differentiation at the retraction's zero. F = d(x' [-] x0')/d xi, G = d(x' [-] x0')/d w,
    where a G of None stands for the identity."""

    step: Callable[[Any, State, Any, Array, Array], State]
    noise: Noise
    params: Any
    jacobian: Callable[[Any, State, Any, Array], tuple[Array, Array | None]] | None = None


@pytree_with(static=("predict", "minus", "cov", "jacobian"))
class Sensor:
    """z = predict(params, x, a) (+) noise of covariance cov(params, x, a); minus(z, z_hat) is the residual vector (m,).

    `a` is the step's context (which stars, their weights). `jacobian(params, x, a)` is d(residual)/d xi, (m, dim), for
    the model's retraction, or None: then it comes from automatic differentiation.
    """

    predict: Callable[[Any, State, Any], Any]
    minus: Callable[[Any, Any], Array]
    cov: Callable[[Any, State, Any], Array]
    params: Any
    jacobian: Callable[[Any, State, Any], Array] | None = None


@pytree
class Measurement:
    """One slot of one sensor at one step: value z, context a, mask (k,) of bool; m residuals belong to k entries in order.

    All False is an absent measurement. Values under a False mask may be anything, NaN included.
    """

    z: Any
    a: Any
    mask: Array


@pytree
class Gaussian:
    """Belief: mean, and covariance in the tangent space at the mean, in the retraction's error (truth [-] mean)."""

    mean: State
    cov: Array


@pytree
class Particles:
    """Belief: points (a State with leading axis n), log_weights (n,) that sum to one, the key of what is drawn next, and the
    effective number of points after the last update, before they were drawn anew."""

    points: State
    log_weights: Array
    key: Array
    effective: Array


@pytree
class Mixture:
    """Belief: Gaussian components (leading axis n), log_weights (n,) that sum to one, key and effective number as in
    `Particles`."""

    components: Any
    log_weights: Array
    key: Array
    effective: Array


@pytree
class Predicted:
    """What a smoother needs of a prediction: the predicted belief and F = d(predicted error)/d(previous error)."""

    mean: State
    cov: Array
    F: Array


ABSENT, ACCEPTED, GATED, REOPENED, FORCED, RESET, DEGENERATE = range(7)
"""Status of an update: no measurement; used; refused by the gate; refused once too often, so that the covariance was
grown to open the gate again, without use of the measurement; used although the gate, opened again, still refused it (see
`Gate`); belief started anew; no particle explains the measurement, or hardly more than one does."""


@pytree
class Info:
    """Of one update: residual (m,) with masked entries zero, its covariance S (m, m), NIS = r^T S^-1 r, degrees of
    freedom, log likelihood, status (one of the codes above)."""

    residual: Array
    S: Array
    nis: Array
    dof: Array
    loglik: Array
    status: Array


@pytree
class Gate:
    """Chi-square gate. limits[m] is the largest NIS taken for m degrees of freedom (inf: no gate).

    The `reopen_after`-th refusal of a sensor in a row makes the belief's covariance grow until it explains the
    residual (status REOPENED), so that the gate opens for the measurements that follow. Of those, the ones still
    refused are used all the same (FORCED), with their own covariance grown likewise: a nonlinear sensor has
    residuals that no covariance of the state explains, and would never come back from an upset.
    """

    limits: Array
    reopen_after: Array


class Filter(Protocol):
    """Pure functions over a belief. A filter is hashable, so that equal filters share one compiled program."""

    @property
    def retraction(self) -> Retraction: ...

    def predict(self, belief: Any, process: Process, u: Any, dt: Array) -> tuple[Any, Predicted]: ...

    def update(self, belief: Any, sensor: Sensor, m: Measurement, gate: Gate, refused: Array) -> tuple[Any, Info]: ...


@pytree_with(static=("retraction",))
class Model:
    """A retraction, a process and the sensors that belong together (their analytic Jacobians share the retraction)."""

    retraction: Retraction
    process: Process
    sensors: tuple[Sensor, ...] = ()


def no_gate(max_dof: int = 64) -> Gate:
    """The gate that takes everything."""
    return Gate(limits=jnp.full((max_dof + 1,), jnp.inf), reopen_after=jnp.asarray(0))


def chi_square_gate(probability: float, max_dof: int = 64, reopen_after: int = 5) -> Gate:
    """Gate that refuses a consistent measurement with the given probability.

    Raises ValueError for a probability outside (0, 1).
    """
    from scipy.special import gammainccinv  # scipy.stats takes longer to load than an hour of data to filter

    if not 0.0 < probability < 1.0:
        raise ValueError(f"gate probability {probability!r}: must lie between 0 and 1, such as 1e-6")
    limits = 2.0 * gammainccinv([0.5 * m for m in range(1, max_dof + 1)], probability)
    return Gate(limits=jnp.concatenate([jnp.zeros(1), jnp.asarray(limits)]), reopen_after=jnp.asarray(reopen_after))
