"""The unscented particle filter of van der Merwe, Doucet, de Freitas and Wan (2000), to the letter.

Every particle carries a point and a covariance. With its own UKF step from there it makes a proposal N(m_i, P_i), draws its
next point x_i from it, and is weighted with the true likelihood and the true transition from the *point* before:

    w_i *= p(z | x_i) p(x_i | x_i before) / N(x_i; m_i, P_i)

(their equation for w, and (11)(12) of Li, Cui and Cui 2007.) The process noise must enter the state's error one to one: the
transition's density is that of the noise, w = x_i [-] f(x_i before, u, 0).

Where the prior is wide and the process noise is narrow, proposals as wide as the prior meet a transition as narrow as the noise
and no weight survives: `mixture.py` has the form that works. DEGENERATE is the status when it happens.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..backend import jax, jnp
from ..core import GATED, Gate, Gaussian, Info, Measurement, Process, Sensor, no_gate, pytree
from ..geometry import small
from ..geometry.retraction import Retraction
from .particle import judged, log_likelihood, log_normal, mean_of, pooled, root_of, spread_of
from .resampling import Scheme, draw, effective_number, normalised, take
from .ukf import Spread, UnscentedBelief, UnscentedKalmanFilter

Array = jax.Array


@pytree
class UnscentedParticles:
    """Belief: points and covs (n, dim, dim) of the particles, log_weights (n,), key and effective number as in
    `core.Particles`; before, process, u, dt: whence and by what the points were predicted, for the transition's density."""

    points: Any
    covs: Array
    log_weights: Array
    key: Array
    effective: Array
    spread: Spread
    before: Any
    process: Process
    u: Any
    dt: Array


def start_unscented_particles(
    retraction: Retraction, start: UnscentedBelief, n: int, key: Array, process: Process, u: Any
) -> UnscentedParticles:
    """n points drawn from a Gaussian, each with its covariance. u: any input, for its shape."""
    ours, rest = jax.random.split(key)
    d = jax.random.normal(ours, (n, retraction.dim)) @ root_of(start.cov).T
    points = jax.vmap(lambda d: retraction.boxplus(start.mean, d))(d)
    covs = jnp.broadcast_to(start.cov, (n, *start.cov.shape))
    even = jnp.full(n, -jnp.log(n))
    u = jax.tree.map(lambda a: jnp.zeros_like(jnp.asarray(a)), u)
    return UnscentedParticles(
        points, covs, even, rest, jnp.asarray(float(n)), start.spread, points, process, u, jnp.asarray(0.0)
    )


def particle_moments(retraction: Retraction, belief: UnscentedParticles) -> Gaussian:
    """Mean and covariance of the points: their own covariances describe proposals, not the belief."""
    mean, d = mean_of(retraction, belief.points, belief.log_weights)
    return Gaussian(mean, spread_of(d, belief.log_weights))


@dataclass(frozen=True)
class UnscentedParticleFilter:
    """resampling, threshold, least: as in `BootstrapFilter`; 1 draws anew at every update, as the paper does."""

    retraction: Retraction
    resampling: Scheme = "residual"
    threshold: float = 1.0
    least: float = 2.0

    def predict(
        self, belief: UnscentedParticles, process: Process, u: Any, dt: Array
    ) -> tuple[UnscentedParticles, None]:
        """Every particle's UKF one step on; where nothing is measured the prediction is the proposal."""
        base = UnscentedKalmanFilter(self.retraction)

        def one(x: Any, P: Array) -> tuple[Any, Array]:
            b, _ = base.predict(UnscentedBelief(x, P, belief.spread), process, u, dt)
            return b.mean, b.cov

        means, covs = jax.vmap(one)(belief.points, belief.covs)
        return UnscentedParticles(
            means, covs, belief.log_weights, belief.key, belief.effective, belief.spread, belief.points, process, u,
            jnp.asarray(dt),
        ), None  # fmt: skip

    def update(
        self, belief: UnscentedParticles, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[UnscentedParticles, Info]:
        """Proposal by each particle's UKF update, a draw, its weight, and resampling. For one sensor at a step."""
        r, n = self.retraction, belief.log_weights.shape[0]
        base = UnscentedKalmanFilter(r)
        ours, again_key, rest = jax.random.split(belief.key, 3)
        open_gate, zero = no_gate(gate.limits.shape[0] - 1), jnp.zeros((), dtype=int)
        normals = jax.random.normal(ours, (n, r.dim))

        def own(x: Any, P: Array) -> tuple[UnscentedBelief, Info]:
            return base.update(UnscentedBelief(x, P, belief.spread), sensor, m, open_gate, zero)

        updated, infos = jax.vmap(own)(belief.points, belief.covs)
        centre, S, rows = pooled(infos, belief.log_weights, m.mask)
        # Whether the gate lets the measurement pass does not depend on the draw that follows.
        passed, _ = judged(jnp.zeros(()), jnp.asarray(jnp.inf), self.least, centre, S, rows, gate, refused)
        taken = passed.status != GATED
        means, covs = jax.tree.map(
            lambda new, old: jnp.where(taken, new, old), (updated.mean, updated.cov), (belief.points, belief.covs)
        )

        def one(mean: Any, P: Array, before: Any, normal: Array) -> tuple[Any, Array]:
            root = small.cholesky(P)
            point = r.boxplus(mean, small.matvec(root, normal))
            proposal = log_normal(normal, jnp.sum(jnp.log(jnp.diagonal(root))), r.dim)
            transition = log_transition(r, belief.process, before, belief.u, belief.dt, point)
            return point, jnp.where(taken, log_likelihood(sensor, point, m)[0], 0.0) + transition - proposal

        # The points are moved whatever happens: where nothing is measured, or the gate refuses it, the draw is from the
        # prediction and its weight the transition's over the prediction's.
        points, logs = jax.vmap(one)(means, covs, belief.before, normals)
        log_weights, evidence = normalised(belief.log_weights + logs)
        effective = effective_number(log_weights)
        info, _ = judged(evidence, effective, self.least, centre, S, rows, gate, refused)
        anew = effective <= self.threshold * n
        indices = jnp.where(anew, draw(again_key, log_weights, self.resampling), jnp.arange(n))
        log_weights = jnp.where(anew, -jnp.log(n), log_weights)
        return UnscentedParticles(
            take(points, indices), covs[indices], log_weights, rest, effective, belief.spread, belief.before,
            belief.process, belief.u, belief.dt,
        ), info  # fmt: skip


def log_transition(retraction: Retraction, process: Process, x: Any, u: Any, dt: Array, y: Any) -> Array:
    """Log density of y after one step from x, by the noise's own density or a Gaussian's."""
    noise = process.noise
    w = retraction.boxminus(y, process.step(process.params, x, u, dt, jnp.zeros(noise.dim)))
    if noise.logpdf is not None:
        return noise.logpdf(process.params, x, u, dt, w)
    root = small.cholesky(noise.cov(process.params, x, u, dt))
    white = small.solve_lower(root, w[:, None])[:, 0]
    return log_normal(white, jnp.sum(jnp.log(jnp.diagonal(root))), noise.dim)


__all__ = [
    "UnscentedParticleFilter",
    "UnscentedParticles",
    "log_transition",
    "particle_moments",
    "start_unscented_particles",
]
