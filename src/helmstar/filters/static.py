"""The static solver as a filter: each epoch's attitude from that epoch's stars alone, the baseline without memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..attitude import quest, svd
from ..backend import jax, jnp
from ..core import ABSENT, ACCEPTED, Gate, Gaussian, Info, Measurement, Predicted, Process, Sensor
from ..geometry import quaternion, small
from ..geometry.retraction import Retraction, quaternion_additive, so3_left, so3_right, vector_part_left

Array = jax.Array


@dataclass(frozen=True)
class StaticSolver:
    """Wahba's problem by SVD at every measurement of star directions; the belief before it is not used.

    Its error is on the left, in B. NIS is the fit's chi-square, 2 L, with 2 n - 3 degrees of freedom. An epoch that
    cannot be solved leaves the last attitude, with status ABSENT.
    """

    retraction: Retraction = so3_left

    def predict(self, belief: Gaussian, process: Process, u: Any, dt: Array) -> tuple[Gaussian, Predicted]:
        """Nothing is predicted."""
        return belief, Predicted(belief.mean, belief.cov, jnp.eye(3, dtype=belief.cov.dtype))

    def update(
        self, belief: Gaussian, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[Gaussian, Info]:
        """The attitude of this epoch."""
        s = svd(m.z, m.a, sensor.params.sigma, m.mask)
        q = jnp.where(s.observable, s.q_BN, belief.mean)
        P = jnp.where(s.observable, s.covariance, belief.cov)
        e = (m.z - jax.vmap(lambda v: quaternion.rotate(q, v))(m.a)).reshape(-1)
        e = jnp.where(jnp.repeat(m.mask, 3), e, jnp.zeros_like(e))
        dof = jnp.where(s.observable, 2 * jnp.sum(m.mask) - 3, 0)
        nis = jnp.where(s.observable, 2.0 * s.loss, 0.0)
        status = jnp.where(s.observable, ACCEPTED, ABSENT)
        loglik = jnp.where(s.observable, -s.loss - dof * jnp.log(sensor.params.sigma * jnp.sqrt(2.0 * jnp.pi)), 0.0)
        S = sensor.cov(sensor.params, q, m.a)
        return Gaussian(q, P), Info(e, S, nis, dof, loglik, status)


def turn_covariance(q_BN: Array, cov_B: Array, retraction: Retraction) -> Array:
    """Covariance of an attitude error on the left in B, turned to the error of an attitude retraction.

    so3_left, gibbs_left and mrp_left: B; vector_part_left: half angles in B; so3_right: N; quaternion_additive: the four
    components, rank 3.
    """
    if retraction is vector_part_left:
        return 0.25 * cov_B
    if retraction is so3_right:
        return small.congruence(small.transpose(quaternion.to_matrix(q_BN)), cov_B)
    if retraction is quaternion_additive:
        G = 0.5 * small.matmul(quaternion.rate_matrix(q_BN), small.transpose(quaternion.to_matrix(q_BN)))
        return small.congruence(G, cov_B)
    return cov_B


def wahba_start(b: Array, r: Array, sigma: Array, retraction: Retraction, mask: Array | None = None) -> Gaussian:
    """Belief of an attitude from one epoch of star directions; arguments as for `attitude.quest`."""
    s = quest(b, r, sigma, mask)
    return Gaussian(s.q_BN, turn_covariance(s.q_BN, s.covariance, retraction))
