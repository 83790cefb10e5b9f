"""A filter that starts anew when its innovations stay implausible: robust against wrong starts and upsets.

The gate's `reopen_after`-th refusal in a row restarts the belief from the measurement itself, if that suffices to solve for
the attitude; until then the measurement is refused. The first restart after a good while blames the attitude alone (an
upset): the other states keep what is known of them. One that follows soon after another, or after the start, blames them
too: they get the covariance `fresh`. Everything else is the inner filter's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from ..backend import jax, jnp
from ..core import ABSENT, GATED, RESET, Filter, Gate, Gaussian, Info, Measurement, Predicted, Process, Sensor, pytree
from ..geometry import small
from ..geometry.retraction import Retraction, so3_left
from .static import turn_covariance, wahba_start

Array = jax.Array


class Restart(Protocol):
    """A hashable rule that makes a new belief of a measurement."""

    def serves(self, sensor: Sensor, m: Measurement) -> bool:
        """Whether measurements of this kind can restart."""
        ...

    def __call__(self, belief: Any, sensor: Sensor, m: Measurement) -> tuple[Any, Array]:
        """The new belief, and whether it is usable."""
        ...


@pytree
class ResettableBelief(Gaussian):
    """A Gaussian belief with the covariance `fresh` (k, k) that its states beside the attitude get at a restart, and the
    number of updates since its (re)start."""

    fresh: Array
    age: Array


SOON = 100
"""Updates within which a second restart blames the states beside the attitude."""


def _joined(belief: ResettableBelief, q_BN: Array, cov: Array) -> ResettableBelief:
    n, k = cov.shape[0], belief.fresh.shape[0]
    beside = jnp.where(belief.age < SOON, belief.fresh, belief.cov[n:, n:])
    P = small.blocks([[cov, jnp.zeros((n, k), cov.dtype)], [jnp.zeros((k, n), cov.dtype), beside]])
    mean = belief.mean.__class__(**{**vars(belief.mean), "q_BN": q_BN})
    return ResettableBelief(mean, P, belief.fresh, jnp.zeros_like(belief.age))


@dataclass(frozen=True)
class RestartFromStars:
    """From star directions by Wahba's problem; the states beside the attitude keep their means.

    For a state that begins with a field q_BN and whose attitude error is that of `retraction`.
    """

    retraction: Retraction = so3_left

    def serves(self, sensor: Sensor, m: Measurement) -> bool:
        """Two directions or more."""
        return jnp.ndim(m.z) == 2 and jnp.shape(m.z)[0] > 1

    def __call__(self, belief: ResettableBelief, sensor: Sensor, m: Measurement) -> tuple[ResettableBelief, Array]:
        start = wahba_start(m.z, m.a, sensor.params.sigma, self.retraction, m.mask)
        ok = jnp.isfinite(start.cov).all()
        q = jnp.where(ok, start.mean, belief.mean.q_BN)
        return _joined(belief, q, jnp.where(ok, start.cov, jnp.eye(3, dtype=q.dtype))), ok


@dataclass(frozen=True)
class RestartFromAttitude:
    """As `RestartFromStars`, from a measured attitude z with the covariance that is its context; other sensors restart
    nothing."""

    retraction: Retraction = so3_left

    def serves(self, sensor: Sensor, m: Measurement) -> bool:
        """A quaternion."""
        return jnp.shape(m.z) == (4,)

    def __call__(self, belief: ResettableBelief, sensor: Sensor, m: Measurement) -> tuple[ResettableBelief, Array]:
        if not self.serves(sensor, m):
            return belief, jnp.asarray(False)
        ok = jnp.all(m.mask) & jnp.isfinite(m.z).all() & jnp.isfinite(m.a).all()
        q = jnp.where(ok, m.z, belief.mean.q_BN)
        cov = jnp.where(ok, m.a, jnp.eye(3, dtype=m.a.dtype))
        return _joined(belief, q, turn_covariance(q, cov, self.retraction)), ok


@dataclass(frozen=True)
class ResettingFilter:
    """`inner` with restarts. Its belief is a `ResettableBelief`; a restart's Info has status RESET."""

    inner: Filter
    restart: Restart

    @property
    def retraction(self) -> Retraction:
        """The inner filter's."""
        return self.inner.retraction

    def predict(self, belief: Any, process: Process, u: Any, dt: Array) -> tuple[Any, Predicted]:
        """The inner filter's prediction."""
        b, predicted = self.inner.predict(Gaussian(belief.mean, belief.cov), process, u, dt)
        return ResettableBelief(b.mean, b.cov, belief.fresh, belief.age), predicted

    def update(self, belief: Any, sensor: Sensor, m: Measurement, gate: Gate, refused: Array) -> tuple[Any, Info]:
        """The inner filter's update, or a restart."""
        fresh, ok = self.restart(belief, sensor, m)
        # A sensor that restarts nothing reopens its gate as without restarts.
        never = jnp.full_like(gate.reopen_after, jnp.iinfo(gate.reopen_after.dtype).max)
        own = Gate(gate.limits, never if self.restart.serves(sensor, m) else gate.reopen_after)
        b, info = self.inner.update(Gaussian(belief.mean, belief.cov), sensor, m, own, refused)
        age = belief.age + jnp.where(info.status == ABSENT, 0, 1)
        kept = ResettableBelief(b.mean, b.cov, belief.fresh, age)
        due = (info.status == GATED) & (refused + 1 >= gate.reopen_after) & ok
        chosen = jax.tree.map(lambda a, b: jnp.where(due, a, b), fresh, kept)
        status = jnp.where(due, RESET, info.status)
        return chosen, Info(info.residual, info.S, info.nis, info.dof, info.loglik, status)
