"""The Rauch-Tung-Striebel smoother on manifolds, for every filter that returns `Predicted`.

    C_k = P_k F^T (P'_{k+1})^-1
    d_k = C_k (x^s_{k+1} [-] x'_{k+1})                     x^s_k = x_k [+] d_k
    P^s_k = P_k + C_k (P^s_{k+1} - P'_{k+1}) C_k^T         each covariance in the tangent space where it is used:
P^s_{k+1} is carried from x^s_{k+1} to x'_{k+1}, and the result from x_k to x^s_k, by the retraction's transport.

P is updated in a form that stays positive: P^s = (I - C F) P (I - C F)^T + C (P^s_{k+1} + N) C^T with N = P' - F P F^T, the
process noise.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from ..backend import jax, jnp
from ..core import Gaussian, Predicted
from ..geometry import small
from ..geometry.retraction import Retraction

Array = jax.Array


def _carry(retraction: Retraction, d: Array, P: Array) -> Array:
    return P if retraction.transport is None else small.congruence(retraction.transport(d), P)


def smooth_step(
    retraction: Retraction, filtered: Gaussian, predicted: Predicted, later: Gaussian, considered: tuple[int, ...] = ()
) -> Gaussian:
    """Smoothed belief at k from the filtered one at k, the prediction of k + 1 from it, and the smoothed one at k + 1.

    considered: states whose gain is zero (see `ErrorStateKalmanFilter`)."""
    P, F = filtered.cov, predicted.F
    e = retraction.boxminus(later.mean, predicted.mean)
    P_later = _carry(retraction, -e, later.cov)
    FP = small.matmul(F, P)
    V = small.invert_lower(small.cholesky(predicted.cov))
    C = small.matmul(small.transpose(small.matmul(V, FP)), V)
    if considered:
        C = C.at[jnp.asarray(considered)].set(0.0)
    N = predicted.cov - small.matmul(FP, small.transpose(F))
    A = jnp.eye(retraction.dim, dtype=P.dtype) - small.matmul(C, F)
    cov = small.congruence(A, P) + small.congruence(C, P_later + N)
    d = small.matvec(C, e)
    return Gaussian(retraction.boxplus(filtered.mean, d), small.symmetrise(_carry(retraction, d, cov)))


@partial(jax.jit, static_argnames=("retraction", "considered"))
def smooth(
    retraction: Retraction, filtered: Any, predicted: Predicted, last: Any | None = None, breaks: Array | None = None,
    considered: tuple[int, ...] = (),
) -> Gaussian:  # fmt: skip
    """Smoothed beliefs of a whole track.

    filtered: beliefs after the updates, leading axis the step k = 0..N-1; predicted: predicted[k] leads to filtered[k]
    (as `run` records them). last: smoothed belief at N-1 when the track is part of a longer one, with predicted[0] of
    the later part unused; default the filtered one. breaks (N,): True where filtered[k] was started anew and owes nothing
    to predicted[k], so that what is known later says nothing of what was before. considered: as in
    `smooth_step`. Returns smoothed beliefs, same leading axis.
    """
    means, covs = filtered.mean, filtered.cov
    end = Gaussian(jax.tree.map(lambda a: a[-1], means), covs[-1]) if last is None else Gaussian(last.mean, last.cov)

    def body(later: Gaussian, inputs):
        mean, cov, predicted, broken = inputs
        own = Gaussian(mean, cov)
        now = smooth_step(retraction, own, predicted, later, considered)
        if broken is not None:
            now = jax.tree.map(lambda a, b: jnp.where(broken, a, b), own, now)
        return now, now

    head = jax.tree.map(lambda a: a[:-1], (means, covs))
    following = jax.tree.map(lambda a: a[1:], (predicted, breaks))
    _, track = jax.lax.scan(body, end, (*head, *following), reverse=True)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), track, end)
