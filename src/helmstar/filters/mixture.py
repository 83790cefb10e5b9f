"""Weighted Gaussians, each with a Kalman filter of its own: Gaussian sum, marginalised particles, the unscented particle filter.

One filter, of any base (EKF or UKF) that stands in `filters`:

    predict   every component by the base
    update    every component by the base; log w_i += log p(z | component i), normalised
    draw      part of a component's covariance may become a draw: N(m, P) is the mean over d ~ N(0, P_d) of N(m + d, P - P_d)

What is drawn makes the filter:

- Nothing: a Gaussian sum (Alspach and Sorenson 1972).
- The `sampled` states, after each update: marginalised, or Rao-Blackwellised, particles (Schoen, Gustafsson and Nordlund 2005)
  with the proposal that knows the measurement. With no state sampled and one component it is the base filter itself.
- Every state, after each update: the particle filter whose proposal is each particle's own Kalman update from a point,
  p(x_k | x_k-1, z_k) exactly where the model is linear (Doucet, Godsill and Andrieu 2000).
- All but a share kernel^2 along some directions, at the start: the unscented particle filter of `kernel_split`, with the UKF as
  base and `importance`.

Why the last deserves the name of a UPF. In van der Merwe's (`unscented.py`) a particle's proposal is as wide as its UKF's
covariance, but its weight has the transition from a *point*, which is as narrow as the process noise: where the prior is wide
and the process noise is not, no weight survives. Here a particle stands for a kernel N(m_i, P_i), and its transition density
is that kernel's prediction: proposal and transition match. The weight with the true likelihood, at a draw x of the proposal,

    w_i *= p(z | x) N(x; m_i', P_i') / N(x; m_i, P_i),

(the mean over two opposite draws) is N(z; z_i, S_i) whatever x is where the measurement is linear within the kernel
(`importance`); its mean over x is the evidence in any case. Kernels are narrow only along the directions in which the problem is
not linear: what is linear stays marginalised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..backend import jax, jnp
from ..core import Gate, Gaussian, Info, Measurement, Mixture, Process, Sensor, no_gate
from ..geometry import small
from ..geometry.retraction import Retraction
from .ekf import carry_covariance
from .particle import judged, log_likelihood, mean_of, pooled, root_of, spread_of
from .resampling import Scheme, draw, effective_number, normalised, take
from .ukf import root_with_zeros, without_zeros

Array = jax.Array


def mixture_moments(retraction: Retraction, belief: Mixture) -> Gaussian:
    """Mean and covariance of the whole mixture; components' covariances are carried to the common mean."""
    w, c = jnp.exp(belief.log_weights), belief.components
    mean, d = mean_of(retraction, c.mean, belief.log_weights)
    covs = jax.vmap(lambda x, d, P: carry_covariance(retraction, "transport", x, -d, P))(c.mean, d, c.cov)
    covs = jnp.where(w[:, None, None] > 0.0, covs, 0.0)
    return Gaussian(mean, jnp.tensordot(w, covs, 1) + spread_of(d, belief.log_weights))


def directions_part(P: Array, along: Array, share: Array) -> Array:
    """The part (dim, dim) of a covariance P that is `share` of the variance of the directions `along` (dim, k), with all that
    is correlated with them: share (P A) (A^T P A)^-1 (P A)^T. What is left is a covariance, in which these directions keep
    1 - share of their variance."""
    B = _columns(P, along, share)
    return B @ B.T


def kernel_split(
    retraction: Retraction, start: Any, n: int, key: Array, along: Array, kernel: Array | float
) -> Mixture:
    """n components drawn from one Gaussian belief: along `along` (dim, k) their means are spread and each keeps `kernel`^2 of
    the variance. The means are stratified (Latin hypercube), so that every part of the prior has its kernels."""
    ours, order, rest = jax.random.split(key, 3)
    k = along.shape[1]
    ranks = jax.vmap(lambda key: jax.random.permutation(key, n))(jax.random.split(order, k)).T
    normal = jax.scipy.special.ndtri((ranks + jax.random.uniform(ours, (n, k))) / n)
    # Columns that carry the drawn part, in terms of the k directions' own standard normals.
    B = _columns(start.cov, along, 1.0 - jnp.asarray(kernel) ** 2)
    means = jax.vmap(lambda d: retraction.boxplus(start.mean, d))(normal @ B.T)
    return _components(start, means, start.cov - B @ B.T, n, rest)


def grid_split(retraction: Retraction, start: Any, n: int, key: Array, direction: Array, reach: float = 3.5) -> Mixture:
    """n components at even steps over +- reach sigma of one direction (dim,), weighted by the prior, as wide as their steps:
    a deterministic Gaussian sum with the mean and covariance of the belief."""
    z = jnp.linspace(-reach, reach, n)
    log_weights, _ = normalised(-0.5 * z * z)
    between = jnp.exp(log_weights) @ (z * z)
    # Means shrunk so that their variance and the kernels' add to one, the kernels as wide as the shrunk steps.
    step = z[1] - z[0]
    shrink2 = 1.0 / (between + step * step)
    column = _columns(start.cov, direction[:, None], 1.0)[:, 0]
    means = jax.vmap(lambda z: retraction.boxplus(start.mean, z * jnp.sqrt(shrink2) * column))(z)
    cov = start.cov - between * shrink2 * column[:, None] * column[None, :]
    return _components(start, means, cov, n, key, log_weights)


def _columns(P: Array, along: Array, share: Array | float) -> Array:
    """B (dim, k) with B B^T = directions_part(P, along, share)."""
    PA = P @ along
    root = root_of(along.T @ PA)
    # The pseudo-inverse of a triangular root: directions without variance take nothing.
    live = jnp.diagonal(root) > 0.0
    safe = jnp.where(live[:, None] & live[None, :], root, jnp.eye(root.shape[0]))
    return jnp.sqrt(share) * small.solve_lower(safe, jnp.where(live[:, None], PA.T, 0.0)).T


def _components(start: Any, means: Any, cov: Array, n: int, key: Array, log_weights: Array | None = None) -> Mixture:
    """Copies of a belief (with whatever else it carries) at these means, with this covariance."""
    many = jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *jnp.shape(a))), start)
    components = _replaced(many, means, jnp.broadcast_to(cov, (n, *cov.shape)))
    weights = jnp.full(n, -jnp.log(n)) if log_weights is None else log_weights
    return Mixture(components, weights, key, effective_number(weights))


def _replaced(belief: Any, mean: Any, cov: Array) -> Any:
    """The belief, of whatever type, with another mean and covariance."""
    values = {name: getattr(belief, name) for name in belief.__dataclass_fields__}
    return type(belief)(**(values | {"mean": mean, "cov": cov}))


@dataclass(frozen=True)
class MixtureFilter:
    """base: the Gaussian filter of every component. sampled: states drawn after each update. importance: weights with the true
    likelihood at a draw of the proposal. threshold: share of n below which components are drawn anew (0: never), when
    `split` (dim, k) and `kernel` say what of their covariance becomes spread of their means again (None: nothing)."""

    base: Any
    sampled: tuple[int, ...] = ()
    importance: bool = False
    threshold: float = 0.0
    resampling: Scheme = "systematic"
    split: tuple[int, ...] = ()
    kernel: float = 0.5
    least: float = 1.0

    @property
    def retraction(self) -> Retraction:
        return self.base.retraction

    def predict(self, belief: Mixture, process: Process, u: Any, dt: Array) -> tuple[Mixture, None]:
        """Every component by the base filter. There is nothing for a smoother."""
        components = jax.vmap(lambda c: self.base.predict(c, process, u, dt)[0])(belief.components)
        return Mixture(components, belief.log_weights, belief.key, belief.effective), None

    def update(
        self, belief: Mixture, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[Mixture, Info]:
        """Components by the base filter, weights by what each said of the measurement before it."""
        n = belief.log_weights.shape[0]
        key_x, key_d, key_r, key_s, rest = jax.random.split(belief.key, 5)
        before = belief.components
        open_gate = no_gate(gate.limits.shape[0] - 1)
        zero = jnp.zeros((), dtype=int)
        after, infos = jax.vmap(lambda c: self.base.update(c, sensor, m, open_gate, zero))(before)
        logs = infos.loglik
        if self.importance:
            logs = jax.vmap(lambda b, a, key: self._true_weight(b, a, sensor, m, key))(
                before, after, jax.random.split(key_x, n)
            )
        log_weights, evidence = normalised(belief.log_weights + logs)
        effective = effective_number(log_weights)
        centre, S, rows = pooled(infos, belief.log_weights, m.mask)
        info, used = judged(evidence, effective, self.least, centre, S, rows, gate, refused)

        def choose(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(used, a, b), new, old)

        components = choose(after, before)
        log_weights = jnp.where(used, log_weights, belief.log_weights)
        effective = jnp.where(used, effective, belief.effective)
        if self.sampled:
            components = self._drawn(components, self.sampled, 1.0, key_d, n)
        if self.threshold > 0.0:
            again = used & (effective < self.threshold * n)
            indices = jnp.where(again, draw(key_r, log_weights, self.resampling), jnp.arange(n))
            components = take(components, indices)
            log_weights = jnp.where(again, -jnp.log(n), log_weights)
            if self.split:
                share = jnp.where(again, 1.0 - self.kernel**2, 0.0)
                components = self._drawn(components, self.split, share, key_s, n)
        return Mixture(components, log_weights, rest, effective), info

    def _true_weight(self, before: Any, after: Any, sensor: Sensor, m: Measurement, key: Array) -> Array:
        """Log mean of p(z | x) N(x; before) / N(x; after) over two x drawn from `after`, opposite to each other: what is odd in
        the sensor's curvature drops out of it, and the mean over draws is the evidence all the same."""
        r = self.retraction
        # States without variance (drawn, and without noise since) stay where they are, and count in neither density.
        # Only where states are drawn: the guards cost a tenth of the filter's time.
        factor = root_with_zeros if self.sampled else small.cholesky
        root, wide = factor(after.cov), factor(before.cov)
        live = jnp.diagonal(root) > 0.0
        if self.sampled:
            wide = without_zeros(wide)
        log_dets = jnp.log(jnp.diagonal(root)) - jnp.log(jnp.diagonal(wide))
        log_det = jnp.sum(jnp.where(live, log_dets, 0.0))
        normal = jax.random.normal(key, (r.dim,))

        def weight(normal: Array) -> Array:
            x = r.boxplus(after.mean, small.matvec(root, normal))
            white = small.solve_lower(wide, r.boxminus(x, before.mean)[:, None])[:, 0]
            return (
                log_likelihood(sensor, x, m)[0]
                - 0.5 * jnp.sum(white * white)
                + 0.5 * jnp.sum(jnp.where(live, normal * normal, 0.0))
                + log_det
            )

        both = jax.vmap(weight)(jnp.stack([normal, -normal]))
        return jax.scipy.special.logsumexp(both) - jnp.log(2.0)

    def _drawn(self, components: Any, states: tuple[int, ...], share: Array | float, key: Array, n: int) -> Any:
        """Components whose `states` have given `share` of their variance to a draw of their means."""
        r = self.retraction
        at = jnp.asarray(states)
        A = jnp.zeros((r.dim, len(states))).at[at, jnp.arange(len(states))].set(1.0)

        def one(c: Any, normal: Array) -> Any:
            B = _columns(c.cov, A, share)
            d = B @ normal
            P = c.cov - B @ B.T
            # All of it drawn: zero to the bit, so that it stays so.
            gone = jnp.zeros(r.dim, bool).at[at].set(jnp.asarray(share) >= 1.0)
            P = jnp.where(gone[:, None] | gone[None, :], 0.0, P)
            return _replaced(c, r.boxplus(c.mean, d), carry_covariance(r, "transport", c.mean, d, P))

        return jax.vmap(one)(components, jax.random.normal(key, (n, len(states))))
