"""Small matrices, unrolled: no LAPACK call per run, everything fuses under `vmap` and `scan`.

For sizes up to some 12; the loops below run at trace time. Leading axes are batch axes.
"""

from __future__ import annotations

from ..backend import jax, jnp

Array = jax.Array


def transpose(A: Array) -> Array:
    """Swap the last two axes."""
    return jnp.swapaxes(A, -1, -2)


def symmetrise(P: Array) -> Array:
    """(P + P^T) / 2."""
    return 0.5 * (P + transpose(P))


@jax.jit
def cholesky(A: Array) -> Array:
    """Lower L with L L^T = A for symmetric positive definite A (..., n, n); NaN where a pivot is negative.

    Only the lower triangle of A is read. A last pivot of exactly zero is a zero in L: solving with it is not finite.
    """
    n = A.shape[-1]
    rows: list[list[Array]] = []
    zero = jnp.zeros_like(A[..., 0, 0])
    for i in range(n):
        row: list[Array] = []
        for j in range(i):
            s = A[..., i, j]
            for k in range(j):
                s = s - row[k] * rows[j][k]
            row.append(s / rows[j][j])
        s = A[..., i, i]
        for k in range(i):
            s = s - row[k] * row[k]
        row.append(jnp.sqrt(s))
        rows.append(row)
    full = [rows[i][j] if j <= i else zero for i in range(n) for j in range(n)]
    return jnp.stack(full, axis=-1).reshape(A.shape)


@jax.jit
def solve_lower(L: Array, B: Array) -> Array:
    """L^-1 B for lower triangular L (..., n, n) and B (..., n, m)."""
    n = L.shape[-1]
    rows: list[Array] = []
    for i in range(n):
        s = B[..., i, :]
        for k in range(i):
            s = s - L[..., i, k, None] * rows[k]
        rows.append(s / L[..., i, i, None])
    return jnp.stack(rows, axis=-2)


@jax.jit
def solve_upper_of_lower(L: Array, B: Array) -> Array:
    """L^-T B for lower triangular L (..., n, n) and B (..., n, m)."""
    n = L.shape[-1]
    rows: list[Array] = [B[..., 0, :]] * n
    for i in reversed(range(n)):
        s = B[..., i, :]
        for k in range(i + 1, n):
            s = s - L[..., k, i, None] * rows[k]
        rows[i] = s / L[..., i, i, None]
    return jnp.stack(rows, axis=-2)


@jax.jit
def invert_lower(L: Array) -> Array:
    """L^-1 for lower triangular L (..., n, n)."""
    n = L.shape[-1]
    zero = jnp.zeros_like(L[..., 0, 0])
    inverse: list[list[Array]] = []
    for i in range(n):
        d = 1.0 / L[..., i, i]
        row = []
        for j in range(i):
            s = L[..., i, j] * inverse[j][j]
            for k in range(j + 1, i):
                s = s + L[..., i, k] * inverse[k][j]
            row.append(-d * s)
        inverse.append([*row, d])
    full = [inverse[i][j] if j <= i else zero for i in range(n) for j in range(n)]
    return jnp.stack(full, axis=-1).reshape(L.shape)


def solve_spd(A: Array, B: Array) -> Array:
    """A^-1 B for symmetric positive definite A (..., n, n) and B (..., n, m)."""
    L = cholesky(A)
    return solve_upper_of_lower(L, solve_lower(L, B))


def inverse_spd(A: Array) -> Array:
    """A^-1 for symmetric positive definite A (..., n, n), symmetric to the bit."""
    n = A.shape[-1]
    V = solve_lower(cholesky(A), jnp.broadcast_to(jnp.eye(n, dtype=A.dtype), A.shape))
    return matmul(transpose(V), V)  # not `@`, which blocks the sums and is symmetric only up to size 8


@jax.jit
def matmul(A: Array, B: Array) -> Array:
    """A B as a sum of outer products: on a CPU several times faster than a batched `@` for sizes up to some 12."""
    return sum(
        (A[..., :, k, None] * B[..., k, None, :] for k in range(1, A.shape[-1])),
        A[..., :, 0, None] * B[..., 0, None, :],
    )


@jax.jit
def matvec(A: Array, v: Array) -> Array:
    """A v."""
    return jnp.sum(A * v[..., None, :], axis=-1)


@jax.jit
def congruence(A: Array, P: Array) -> Array:
    """A P A^T."""
    return matmul(matmul(A, P), transpose(A))


def blocks(rows: list[list[Array]]) -> Array:
    """Matrix of blocks, like numpy.block, for any leading axes."""
    return jnp.concatenate([jnp.concatenate(row, axis=-1) for row in rows], axis=-2)
