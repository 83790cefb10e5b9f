"""Retractions: how an error vector moves a state. Filter variants are retractions, not filters.

| name | state | error (truth [-] estimate) | frame of the error |
|---|---|---|---|
| so3_right | q_BN | R_BN = R_hat exp([xi x]) | N (the domain of R_BN) |
| so3_left | q_BN | R_BN = exp([xi x]) R_hat | B |
| gibbs_left | q_BN | q_BN = [xi/2, 1] / norm (x) q_hat, xi twice the Gibbs vector | B |
| mrp_left | q_BN | as gibbs_left, xi four times the modified Rodrigues parameters: no singularity up to a whole turn | B |
| vector_part_left | q_BN | q_BN = [xi, sqrt(1 - xi^2)] (x) q_hat, xi the vector part, half an angle | B |
| quaternion_additive | q_BN | q_BN - q_hat; the sum is normalised | none (four numbers) |
| euclidean(n) | (n,) | x - x_hat | that of x |
| product(cls, ...) | dataclass | the parts' errors, one after the other | those of the parts |

Why transport: after an update the mean moves from x to x [+] d and the covariance, which lives in the tangent space at
the mean, must follow. For the error on the right the axes of N do not move with the estimate, so nothing changes; on
the left the axes of B do, and P becomes Exp(d) P Exp(d)^T. With it both sides are the same filter.
Source: Barrau and Bonnabel, "Intrinsic filtering on SO(3) with discrete-time observations", CDC 2013; Markley,
"Attitude error representations for Kalman filtering", JGCD 26(2), 2003 (Gibbs vector, modified Rodrigues parameters).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

from ..backend import jax, jnp
from . import quaternion, so3

Array = jax.Array


@dataclass(frozen=True)
class Retraction:
    """How an error vector moves a state, and on which side and in which frame its numbers live.

    boxplus(x, d) is x [+] d; boxminus(y, x) is the d with x [+] d = y; they are inverses of each other.
    transport(d) is the matrix D that carries a covariance from x to x [+] d as D P D^T; None where it is the identity.
    `dim` is the dimension of d.
    """

    boxplus: Callable[[Any, Array], Any]
    boxminus: Callable[[Any, Any], Array]
    transport: Callable[[Array], Array] | None
    dim: int
    name: str = ""


def _right_plus(q: Array, d: Array) -> Array:
    return quaternion.normalise(quaternion.multiply(q, quaternion.exp(d)))


def _right_minus(p: Array, q: Array) -> Array:
    return quaternion.log(quaternion.multiply(quaternion.conjugate(q), p))


def _left_plus(q: Array, d: Array) -> Array:
    return quaternion.normalise(quaternion.multiply(quaternion.exp(d), q))


def _left_minus(p: Array, q: Array) -> Array:
    return quaternion.log(quaternion.multiply(p, quaternion.conjugate(q)))


def _gibbs_plus(q: Array, d: Array) -> Array:
    one = jnp.ones_like(d[..., :1])
    return quaternion.normalise(quaternion.multiply(jnp.concatenate([0.5 * d, one], axis=-1), q))


def _gibbs_minus(p: Array, q: Array) -> Array:
    e = quaternion.multiply(p, quaternion.conjugate(q))
    return 2.0 * e[..., :3] / e[..., 3:]


def _gibbs_transport(d: Array) -> Array:
    """Rotation by twice the angle's half-tangent, the exact turn of the body axes that `_gibbs_plus` makes."""
    one = jnp.ones_like(d[..., :1])
    return quaternion.to_matrix(quaternion.normalise(jnp.concatenate([0.5 * d, one], axis=-1)))


def _mrp_error(d: Array) -> Array:
    """Unit quaternion of 4 times the modified Rodrigues parameters."""
    p = 0.25 * d
    s = jnp.sum(p * p, axis=-1, keepdims=True)
    return jnp.concatenate([2.0 * p, 1.0 - s], axis=-1) / (1.0 + s)


def _mrp_plus(q: Array, d: Array) -> Array:
    return quaternion.normalise(quaternion.multiply(_mrp_error(d), q))


def _mrp_minus(p: Array, q: Array) -> Array:
    e = quaternion.multiply(p, quaternion.conjugate(q))
    e = jnp.where(e[..., 3:] < 0.0, -e, e)
    return 4.0 * e[..., :3] / (1.0 + e[..., 3:])


def _mrp_transport(d: Array) -> Array:
    return quaternion.to_matrix(_mrp_error(d))


def _vector_part_error(d: Array) -> Array:
    """Unit quaternion of a vector part; one longer than 1, which no rotation has, is shortened to it."""
    square = jnp.sum(d * d, axis=-1, keepdims=True)
    d = d / jnp.sqrt(jnp.maximum(square, 1.0))
    # The double where keeps the derivative finite at half a turn.
    rest = 1.0 - jnp.sum(d * d, axis=-1, keepdims=True)
    w = jnp.where(rest > 0.0, jnp.sqrt(jnp.where(rest > 0.0, rest, 1.0)), 0.0)
    return jnp.concatenate([d, w], axis=-1)


def _vector_part_plus(q: Array, d: Array) -> Array:
    return quaternion.normalise(quaternion.multiply(_vector_part_error(d), q))


def _vector_part_minus(p: Array, q: Array) -> Array:
    e = quaternion.multiply(p, quaternion.conjugate(q))
    return jnp.where(e[..., 3:] < 0.0, -e[..., :3], e[..., :3])


def _vector_part_transport(d: Array) -> Array:
    return quaternion.to_matrix(_vector_part_error(d))


def _additive_plus(q: Array, d: Array) -> Array:
    return quaternion.normalise(q + d)


def _additive_minus(p: Array, q: Array) -> Array:
    return quaternion.align_sign(p, q) - q


so3_right = Retraction(_right_plus, _right_minus, None, 3, "so3_right")
so3_left = Retraction(_left_plus, _left_minus, so3.exp, 3, "so3_left")
gibbs_left = Retraction(_gibbs_plus, _gibbs_minus, _gibbs_transport, 3, "gibbs_left")
mrp_left = Retraction(_mrp_plus, _mrp_minus, _mrp_transport, 3, "mrp_left")
vector_part_left = Retraction(_vector_part_plus, _vector_part_minus, _vector_part_transport, 3, "vector_part_left")
quaternion_additive = Retraction(_additive_plus, _additive_minus, None, 4, "quaternion_additive")


def _plus(x: Array, d: Array) -> Array:
    return x + d


def _minus(y: Array, x: Array) -> Array:
    return y - x


@cache
def euclidean(n: int) -> Retraction:
    """R^n with its ordinary sum and difference."""
    return Retraction(_plus, _minus, None, n, f"euclidean({n})")


def block_diagonal(blocks: list[Array]) -> Array:
    """Square blocks along the diagonal, zeros elsewhere; leading axes are batch axes."""
    sizes = [b.shape[-1] for b in blocks]
    n = sum(sizes)
    rows, start = [], 0
    for b, m in zip(blocks, sizes, strict=True):
        lead = b.shape[:-1]
        left, right = jnp.zeros((*lead, start), b.dtype), jnp.zeros((*lead, n - start - m), b.dtype)
        rows.append(jnp.concatenate([left, b, right], axis=-1))
        start += m
    return jnp.concatenate(rows, axis=-2)


@cache
def product(cls: type, *parts: Retraction) -> Retraction:
    """Retraction of a frozen dataclass, one part for each of its fields in order.

    Raises TypeError when the number of parts is not the number of fields.
    """
    names = [f.name for f in fields(cls)]
    if len(names) != len(parts):
        raise TypeError(f"{cls.__name__} has {len(names)} fields {names}, but {len(parts)} retractions were given")
    bounds, start = [], 0
    for part in parts:
        bounds.append((start, start + part.dim))
        start += part.dim
    dim = start

    def boxplus(x, d: Array):
        return cls(*(r.boxplus(getattr(x, n), d[..., i:j]) for n, r, (i, j) in zip(names, parts, bounds, strict=True)))

    def boxminus(y, x) -> Array:
        return jnp.concatenate(
            [r.boxminus(getattr(y, n), getattr(x, n)) for n, r in zip(names, parts, strict=True)], axis=-1
        )

    def transport(d: Array) -> Array:
        blocks = []
        for r, (i, j) in zip(parts, bounds, strict=True):
            eye = jnp.broadcast_to(jnp.eye(r.dim, dtype=d.dtype), (*d.shape[:-1], r.dim, r.dim))
            blocks.append(eye if r.transport is None else r.transport(d[..., i:j]))
        return block_diagonal(blocks)

    moves = any(r.transport is not None for r in parts)
    name = f"{cls.__name__}({', '.join(r.name for r in parts)})"
    return Retraction(boxplus, boxminus, transport if moves else None, dim, name)
