"""Measurement noise from the innovations: an EKF that finds out by which factor its R is wrong.

With innovation e, S = H P H^T + s R and the assumed R, E e^T R^-1 e = tr R^-1 H P H^T + s m for m residuals, so that

    s_hat = (e^T R^-1 e - tr R^-1 (S - s R)) / m,      s <- s + rho (s_hat - s)

(Mehra 1970, innovation correlation; the scalar, exponentially forgetting form). s_hat is limited to ten times s, so that an
outlier is no noise level, and s kept above 1e-4. Measurements that the gate refuses count too: a too small R shuts the
gate, and would stay shut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..backend import jax, jnp
from ..core import ABSENT, Filter, Gate, Gaussian, Info, Measurement, Predicted, Process, Sensor, pytree
from ..geometry import small
from ..geometry.retraction import Retraction
from .ekf import prepare

Array = jax.Array
LEAST = 1e-4
MOST_AT_ONCE = 10.0


@pytree
class AdaptiveBelief(Gaussian):
    """A Gaussian belief with the factor s of R, and rho, the share of each new measurement in it."""

    factor: Array
    rho: Array


@dataclass(frozen=True)
class AdaptiveFilter:
    """`inner` (an EKF) with R scaled by what the innovations say. One factor for all sensors."""

    inner: Filter

    @property
    def retraction(self) -> Retraction:
        """The inner filter's."""
        return self.inner.retraction

    def predict(self, belief: Any, process: Process, u: Any, dt: Array) -> tuple[Any, Predicted]:
        """The inner filter's prediction."""
        b, predicted = self.inner.predict(Gaussian(belief.mean, belief.cov), process, u, dt)
        return AdaptiveBelief(b.mean, b.cov, belief.factor, belief.rho), predicted

    def update(self, belief: Any, sensor: Sensor, m: Measurement, gate: Gate, refused: Array) -> tuple[Any, Info]:
        """The inner filter's update with s R, then s."""
        s = belief.factor
        grown = Sensor(
            sensor.predict, sensor.minus, lambda p, x, a: s * sensor.cov(p, x, a), sensor.params, sensor.jacobian
        )
        b, info = self.inner.update(Gaussian(belief.mean, belief.cov), grown, m, gate, refused)
        _, rows, R = prepare(sensor, belief.mean, m)
        V = small.invert_lower(small.cholesky(R))
        white = small.matvec(V, info.residual)
        both = rows[:, None] & rows[None, :]
        spread = small.congruence(V, jnp.where(both, info.S - s * R, 0.0))
        count = jnp.maximum(info.dof, 1)
        found = (jnp.sum(white**2) - jnp.trace(spread)) / count
        found = jnp.clip(found, LEAST, MOST_AT_ONCE * s)
        usable = (info.status != ABSENT) & jnp.isfinite(found)
        factor = jnp.where(usable, s + belief.rho * (found - s), s)
        return AdaptiveBelief(b.mean, b.cov, jnp.maximum(factor, LEAST), belief.rho), info
