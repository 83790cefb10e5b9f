"""Weights of particles, and drawing particles anew by them.

All weights are logarithms, so that a hundred sigma neither underflow nor divide by zero. `draw` returns indices (n,); each scheme
gives particle i on average n w_i copies (Douc, Cappe and Moulines 2005 compare their variances):

| scheme | uniform numbers |
|---|---|
| multinomial | n independent ones (Gordon, Salmond and Smith 1993) |
| stratified | one in each of n equal strata |
| systematic | one, the same in each stratum (Kitagawa 1996) |
| residual | floor(n w_i) copies for sure, the rest multinomial (Liu and Chen 1998) |
"""

from __future__ import annotations

from typing import Literal

from ..backend import jax, jnp

Array = jax.Array
Scheme = Literal["multinomial", "stratified", "systematic", "residual"]
SCHEMES: tuple[Scheme, ...] = ("multinomial", "stratified", "systematic", "residual")


def normalised(log_weights: Array) -> tuple[Array, Array]:
    """Log weights (n,) that sum to one, and the log of their sum before. NaN counts as zero weight; where nothing is left the
    weights are even and the sum's log is -inf."""
    clean = jnp.where(jnp.isnan(log_weights) | (log_weights == jnp.inf), -jnp.inf, log_weights)
    top = jnp.max(clean)
    some = jnp.isfinite(top)
    top = jnp.where(some, top, 0.0)
    total = top + jnp.log(jnp.maximum(jnp.sum(jnp.exp(clean - top)), jnp.finfo(clean.dtype).tiny))
    even = jnp.full_like(clean, -jnp.log(clean.shape[0]))
    return jnp.where(some, clean - total, even), jnp.where(some, total, -jnp.inf)


def effective_number(log_weights: Array) -> Array:
    """1 / sum w^2 of normalised log weights: n for even ones, 1 where one particle has it all (Kong, Liu and Wong 1994)."""
    return jnp.exp(-jax.scipy.special.logsumexp(2.0 * log_weights))


def draw(key: Array, log_weights: Array, scheme: Scheme = "systematic") -> Array:
    """Indices (n,) of the particles that go on, in rising order but for "multinomial" and the tail of "residual".

    Raises ValueError for an unknown scheme.
    """
    n = log_weights.shape[0]
    w = jnp.exp(log_weights)
    if scheme == "multinomial":
        return _at(w, jax.random.uniform(key, (n,)))
    if scheme == "stratified":
        return _at(w, (jnp.arange(n) + jax.random.uniform(key, (n,))) / n)
    if scheme == "systematic":
        return _at(w, (jnp.arange(n) + jax.random.uniform(key)) / n)
    if scheme == "residual":
        # A weight that is k / n up to rounding is worth k copies.
        copies = jnp.floor(n * w + 1e-9)
        sure = jnp.sum(copies)
        rest = jnp.maximum(n * w - copies, 0.0)
        certain = jnp.searchsorted(jnp.cumsum(copies), jnp.arange(n), side="right")
        return jnp.where(jnp.arange(n) < sure, certain, _at(rest, jax.random.uniform(key, (n,)))).clip(0, n - 1)
    raise ValueError(f"resampling {scheme!r}: must be one of {', '.join(SCHEMES)}")


def _at(w: Array, u: Array) -> Array:
    """Where numbers u in [0, 1) fall in the cumulated weights."""
    edges = jnp.cumsum(w)
    # Scaled by the last edge, which rounding leaves beside one: the end is never passed.
    return jnp.searchsorted(edges, u * edges[-1], side="right").clip(0, w.shape[0] - 1)


def take(tree, indices: Array):
    """The particles of these indices."""
    return jax.tree.map(lambda a: a[indices], tree)
