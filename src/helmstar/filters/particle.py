"""The bootstrap particle filter, plain and regularised, over any retraction.

    predict   x_i' = f(x_i, u, w_i),  w_i drawn from the process noise
    update    w_i <- w_i p(z | x_i), normalised; drawn anew where the effective number falls below `threshold` n

Regularised (Musso, Oudjane and Le Gland 2001): points drawn anew are moved by h D e, with D D^T the particles' covariance,
e standard normal and h = (4 / (n (d + 2)))^(1 / (d + 4)) the best width for a Gaussian density of d dimensions.

Degenerate weights are a status, not an error: DEGENERATE says that no particle explains the measurement (the belief stays as
it was) or that hardly more than one does (`least`). Source of the plain filter: Gordon, Salmond and Smith 1993.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..backend import jax, jnp
from ..core import (
    ABSENT,
    ACCEPTED,
    DEGENERATE,
    FORCED,
    GATED,
    Gate,
    Gaussian,
    Info,
    Measurement,
    Particles,
    Process,
    Sensor,
)
from ..geometry import small
from ..geometry.retraction import Retraction
from .ekf import prepare
from .resampling import Scheme, draw, effective_number, normalised, take

Array = jax.Array


def mean_of(retraction: Retraction, points: Any, log_weights: Array) -> tuple[Any, Array]:
    """Weighted mean of points on the manifold (two steps of the intrinsic mean from the heaviest), and the deviations (n, dim)
    point [-] mean."""
    w = jnp.exp(log_weights)
    mean = take(points, jnp.argmax(log_weights))
    for _ in range(2):
        mean = retraction.boxplus(mean, w @ _deviations(retraction, points, mean, w))
    return mean, _deviations(retraction, points, mean, w)


def _deviations(retraction: Retraction, points: Any, mean: Any, w: Array) -> Array:
    """(n, dim), zero where a point has no weight: what is not finite there spoils nothing."""
    d = jax.vmap(lambda x: retraction.boxminus(x, mean))(points)
    return jnp.where(w[:, None] > 0.0, d, 0.0)


def moments(retraction: Retraction, belief: Particles) -> Gaussian:
    """Mean and covariance of particles."""
    mean, d = mean_of(retraction, belief.points, belief.log_weights)
    return Gaussian(mean, spread_of(d, belief.log_weights))


def spread_of(d: Array, log_weights: Array) -> Array:
    """Covariance (dim, dim) of weighted deviations (n, dim)."""
    return (d * jnp.exp(log_weights)[:, None]).T @ d


def root_of(P: Array) -> Array:
    """Lower triangular L with L L^T = P for a covariance that may be singular: what has (almost) no variance left after the
    variables before it gets none."""
    n = P.shape[-1]
    L = jnp.zeros_like(P)
    for j in range(n):
        column = P[:, j] - L @ L[j]
        pivot = column[j]
        good = pivot > 1e-13 * P[j, j]
        column = jnp.where(jnp.arange(n) >= j, column, 0.0) / jnp.sqrt(jnp.where(good, pivot, 1.0))
        L = L.at[:, j].set(jnp.where(good, column, 0.0))
    return L


def sample_noise(process: Process, x: Any, u: Any, dt: Array, key: Array) -> Array:
    """A draw of the process noise w (dim,)."""
    noise = process.noise
    if noise.sample is not None:
        return noise.sample(process.params, x, u, dt, key)
    return root_of(noise.cov(process.params, x, u, dt)) @ jax.random.normal(key, (noise.dim,))


def log_normal(white: Array, log_det_root: Array, dof: Array | int) -> Array:
    """Log density of a Gaussian from the whitened residual and the log determinant of the covariance's root."""
    return -0.5 * jnp.sum(white * white) - log_det_root - 0.5 * dof * jnp.log(2.0 * jnp.pi)


def log_likelihood(sensor: Sensor, x: Any, m: Measurement) -> tuple[Array, Array, Array, Array]:
    """Log p(z | x) over the entries present, the residual, the rows present and R."""
    e, rows, R = prepare(sensor, x, m)
    L = small.cholesky(R)
    white = small.solve_lower(L, e[:, None])[:, 0]
    log_det = jnp.sum(jnp.where(rows, jnp.log(jnp.diagonal(L)), 0.0))
    return log_normal(white, log_det, jnp.sum(rows)), e, rows, R


def judged(
    evidence: Array, effective: Array, least: float, e: Array, S: Array, rows: Array, gate: Gate, refused: Array
) -> tuple[Info, Array]:
    """Info of a weighted set, and whether the measurement is used. e, S: of its moments; evidence: log p(z)."""
    V = small.invert_lower(small.cholesky(S))
    white = small.matvec(V, e)
    nis, dof = jnp.sum(white * white), jnp.sum(rows)
    passes = nis <= gate.limits[dof]
    # Refused too often: taken as it is. A set of points has no covariance to open a gate with.
    status = jnp.where(passes, ACCEPTED, jnp.where(refused + 1 > gate.reopen_after, FORCED, GATED))
    explained = jnp.isfinite(evidence)
    status = jnp.where((status != GATED) & (~explained | (effective < least)), DEGENERATE, status)
    status = jnp.where(dof > 0, status, ABSENT)
    used = explained & (status != GATED) & (status != ABSENT)
    return Info(residual=e, S=S, nis=nis, dof=dof, loglik=evidence, status=status), used


def pooled(infos: Info, log_weights: Array, mask: Array) -> tuple[Array, Array, Array]:
    """Residual (m,), its covariance (m, m) and the rows present, of filters (leading axis of `infos`) weighted before they saw
    the measurement."""
    live = jnp.exp(log_weights) > 0.0
    w, m = jnp.exp(log_weights), infos.residual.shape[1]
    residuals = jnp.where(live[:, None], infos.residual, 0.0)
    centre = w @ residuals
    covs = jnp.where(live[:, None, None], infos.S, 0.0)
    S = jnp.tensordot(w, covs, 1) + spread_of(residuals - centre, log_weights)
    rows = jnp.repeat(mask, m // mask.shape[0], total_repeat_length=m)
    return centre, jnp.where(rows[:, None] & rows[None, :], S, jnp.eye(m)), rows


def start_particles(retraction: Retraction, start: Gaussian, n: int, key: Array) -> Particles:
    """n points drawn from a Gaussian, of even weights."""
    ours, rest = jax.random.split(key)
    d = jax.random.normal(ours, (n, retraction.dim)) @ root_of(start.cov).T
    points = jax.vmap(lambda d: retraction.boxplus(start.mean, d))(d)
    return Particles(points, jnp.full(n, -jnp.log(n)), rest, jnp.asarray(float(n)))


@dataclass(frozen=True)
class BootstrapFilter:
    """resampling: scheme; threshold: share of n below which points are drawn anew; least: effective number below which an
    update is called DEGENERATE."""

    retraction: Retraction
    resampling: Scheme = "systematic"
    threshold: float = 0.5
    regularised: bool = False
    least: float = 2.0

    def predict(self, belief: Particles, process: Process, u: Any, dt: Array) -> tuple[Particles, None]:
        """Every point moved with its own noise. There is nothing for a smoother."""
        ours, rest = jax.random.split(belief.key)

        def move(x: Any, key: Array) -> Any:
            w = sample_noise(process, x, u, dt, key)
            return process.step(process.params, x, u, dt, w)

        points = jax.vmap(move)(belief.points, jax.random.split(ours, belief.log_weights.shape[0]))
        return Particles(points, belief.log_weights, rest, belief.effective), None

    def update(
        self, belief: Particles, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[Particles, Info]:
        """Weights by the likelihood, and points drawn anew where few count."""
        n = belief.log_weights.shape[0]
        logs, e, rows, R = jax.vmap(lambda x: log_likelihood(sensor, x, m))(belief.points)
        log_weights, evidence = normalised(belief.log_weights + logs)
        w = jnp.exp(belief.log_weights)
        centre = w @ e
        S = spread_of(e - centre, belief.log_weights) + jnp.tensordot(w, R, 1)
        effective = effective_number(log_weights)
        info, used = judged(evidence, effective, self.least, centre, S, rows[0], gate, refused)
        log_weights = jnp.where(used, log_weights, belief.log_weights)
        effective = jnp.where(used, effective, belief.effective)
        ours, jitter, rest = jax.random.split(belief.key, 3)
        again = used & (effective < self.threshold * n)
        indices = jnp.where(again, draw(ours, log_weights, self.resampling), jnp.arange(n))
        points = take(belief.points, indices)
        if self.regularised:
            d = self.retraction.dim
            width = (4.0 / (n * (d + 2.0))) ** (1.0 / (d + 4.0))
            root = root_of(moments(self.retraction, Particles(belief.points, log_weights, rest, effective)).cov)
            move = width * jax.random.normal(jitter, (n, d)) @ root.T
            points = jax.vmap(self.retraction.boxplus)(points, jnp.where(again, move, 0.0))
        log_weights = jnp.where(again, -jnp.log(n), log_weights)
        return Particles(points, log_weights, rest, effective), info
