"""Small unrolled matrices against numpy.linalg: sizes 1 to 9, two batch axes, no LAPACK call in the program.

Tolerances are the backward error bounds of Higham, "Accuracy and Stability of Numerical Algorithms" (2nd ed., section
3.5, theorems 8.5, 10.3 and 10.4), entry by entry, in ulps: a sum of n products in any order is right to n eps |a| |b|;
a triangular solve leaves a residual of n eps |L| |X|; a Cholesky factor one of (n + 1) eps |L| |L^T|; a solution by
that factor one of (3 n + 1) eps |L| |L^T| |X|. They hold for every condition number. A forward error has no such
bound; it is compared with numpy's where the condition number multiplies it. Residuals are taken in more precision than float64.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helmstar.backend import jax
from helmstar.geometry import small

DTYPES = [np.float64, np.float32]
SIZES = list(range(1, 10))
LEAD, COLUMNS = (2, 4), 3
LAW = settings(deadline=None, derandomize=True, max_examples=6)
SEEDS = st.integers(0, 2**32 - 1)
OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def error_in_ulps(actual, expected, scale=1.0) -> float:
    """Largest |actual - expected| over eps of actual's dtype times scale; a NaN is infinitely wrong."""
    actual = np.asarray(actual)
    info = np.finfo(actual.dtype)
    e = np.abs(actual.astype(np.longdouble) - expected) / (info.eps * np.maximum(scale, info.tiny))
    return float(np.max(np.where(np.isnan(e), np.inf, e)))


def close(actual, expected, ulps: float, scale=1.0) -> None:
    e = error_in_ulps(actual, expected, scale)
    assert e <= ulps, f"{e:.2f} ulps, {ulps} allowed"


def transposed(A) -> np.ndarray:
    return np.swapaxes(np.asarray(A), -1, -2)


def times(*factors) -> np.ndarray:
    """Product of matrices in more precision than float64."""
    product = np.asarray(factors[0], np.longdouble)
    for f in factors[1:]:
        product = product @ np.asarray(f, np.longdouble)
    return product


def size(*factors) -> np.ndarray:
    """|A| |B| ..: what the rounding errors of a product or a solve are in proportion to."""
    return times(*(np.abs(f) for f in factors))


def satisfies(factors, right, ulps: float, scale) -> None:
    """The product of the factors is `right`, to so many ulps of scale."""
    dtype = np.asarray(factors[-1]).dtype
    close((times(*factors) - right).astype(dtype), 0.0, ulps, scale)


@jax.jit
def of(A, L, B, C, M, v):
    return {
        "cholesky": small.cholesky(A),
        "solve_lower": small.solve_lower(L, B),
        "solve_upper": small.solve_upper_of_lower(L, B),
        "invert_lower": small.invert_lower(L),
        "solve_spd": small.solve_spd(A, B),
        "inverse_spd": small.inverse_spd(A),
        "matmul": small.matmul(M, B),
        "matvec": small.matvec(M, v),
        "congruence": small.congruence(M, A),
        "transpose": small.transpose(B),
        "symmetrise": small.symmetrise(M),
        "blocks": small.blocks([[A, B], [small.transpose(B), C]]),
    }


@cache
def program(n: int, dtype):
    """`of`, compiled for one size. Each operation rounds alike at every level of optimisation but for contracted
    products; at this one the eighteen programs compile five times faster."""
    shapes = [(n, n), (n, n), (n, COLUMNS), (COLUMNS, COLUMNS), (n, n), (n,)]
    arguments = [jax.ShapeDtypeStruct((*LEAD, *s), dtype) for s in shapes]
    return of.lower(*arguments).compile(OPTIONS)


def problem(seed: int, n: int, dtype, decades: float = 3.0) -> list[np.ndarray]:
    """A symmetric positive definite, of condition up to 1e6 (float32: 1e3), its rows and columns scaled apart by up to
    so many decades; L its factor; B, C, M, v any."""
    rng = np.random.default_rng(seed)
    condition = 1e6 if dtype == np.float64 else 1e3
    Q = np.linalg.qr(rng.normal(size=(*LEAD, n, n)))[0]
    A = (Q * condition ** -rng.random((*LEAD, 1, n))) @ transposed(Q)
    scale = 10.0 ** (decades * rng.uniform(-0.5, 0.5, (*LEAD, n)))
    A = (A * scale[..., :, None] * scale[..., None, :]).astype(dtype)
    A = np.tril(A) + transposed(np.tril(A, -1))
    L = np.linalg.cholesky(A.astype(np.float64)).astype(dtype)
    rest = [rng.normal(size=(*LEAD, *s)).astype(dtype) for s in ((n, COLUMNS), (COLUMNS, COLUMNS), (n, n), (n,))]
    return [A, L, *rest]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", SIZES)
@LAW
@given(SEEDS)
def test_factors_solves_and_products(n, dtype, seed):
    A, L, B, C, M, v = problem(seed, n, dtype)
    x = {k: np.asarray(y) for k, y in program(n, dtype)(A, L, B, C, M, v).items()}
    assert {y.dtype for y in x.values()} == {np.dtype(dtype)}

    G = x["cholesky"]
    assert np.all(np.triu(G, 1) == 0.0)
    assert np.all(np.diagonal(G, axis1=-2, axis2=-1) > 0.0)
    satisfies((G, transposed(G)), A, n + 1, size(G, transposed(G)))
    satisfies((L, x["solve_lower"]), B, n, size(L, x["solve_lower"]))
    satisfies((transposed(L), x["solve_upper"]), B, n, size(transposed(L), x["solve_upper"]))
    satisfies((L, x["invert_lower"]), np.eye(n), n, size(L, x["invert_lower"]))
    assert np.all(np.triu(x["invert_lower"], 1) == 0.0)
    satisfies((A, x["solve_spd"]), B, 3 * n + 1, size(G, transposed(G), x["solve_spd"]))

    close(x["matmul"], times(M, B), n, size(M, B))
    close(x["matvec"], times(M, v[..., None])[..., 0], n, size(M, v[..., None])[..., 0])
    close(x["congruence"], times(M, A, transposed(M)), 2 * n, size(M, A, transposed(M)))
    np.testing.assert_array_equal(x["transpose"], transposed(B))
    np.testing.assert_array_equal(x["symmetrise"], dtype(0.5) * (M + transposed(M)))
    np.testing.assert_array_equal(x["blocks"], np.block([[A, B], [transposed(B), C]]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", SIZES)
@LAW
@given(SEEDS)
def test_against_numpy_linalg(n, dtype, seed):
    """Forward errors, in the norm: a few n eps times the condition number; 4 n."""
    A, L, B, C, M, v = problem(seed, n, dtype, decades=0.0)
    x = program(n, dtype)(A, L, B, C, M, v)
    A, L, B = (y.astype(np.float64) for y in (A, L, B))
    condition = np.linalg.cond(A)[..., None, None]
    expected = {
        "cholesky": np.linalg.cholesky(A),
        "inverse_spd": np.linalg.inv(A),
        "solve_spd": np.linalg.solve(A, B),
        "invert_lower": np.linalg.inv(L),
        "solve_lower": np.linalg.solve(L, B),
        "solve_upper": np.linalg.solve(transposed(L), B),
    }
    for name, y in expected.items():
        close(x[name], y, 4 * n, condition * np.linalg.norm(y, axis=(-2, -1), keepdims=True))


def test_cholesky_reads_the_lower_triangle_only():
    A, *rest = problem(1, 6, np.float64)
    above = np.triu_indices(6, 1)
    broken = A.copy()
    broken[..., above[0], above[1]] = np.nan
    run = program(6, np.float64)
    for name in ("cholesky", "solve_spd", "inverse_spd"):
        np.testing.assert_array_equal(run(broken, *rest)[name], run(A, *rest)[name])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", SIZES)
def test_a_matrix_that_is_not_positive_definite_gives_nan_and_harms_no_other(n, dtype):
    """Where the k-th pivot is negative, entry k of the diagonal is NaN, and so is all that is solved with the factor.
    Its neighbours in the batch keep their bits."""
    A, *rest = problem(2, n, dtype)
    good = program(n, dtype)(A, *rest)
    for k in range(n):
        broken = A.copy()
        broken[1, 2, k, k] = -broken[1, 2, k, k]
        x = program(n, dtype)(broken, *rest)
        assert np.isnan(x["cholesky"][1, 2, k, k])
        assert np.all(np.isnan(x["solve_spd"][1, 2]))
        assert np.all(np.isnan(x["inverse_spd"][1, 2]))
        others = np.ones(LEAD, bool)
        others[1, 2] = False
        for name in ("cholesky", "solve_spd", "inverse_spd"):
            np.testing.assert_array_equal(np.asarray(x[name])[others], np.asarray(good[name])[others])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", SIZES)
def test_a_singular_matrix_gives_no_finite_inverse(n, dtype):
    """A pivot of exactly zero is a zero on the diagonal where it is the last one, and NaN below it otherwise. Nothing
    that is solved with such a factor is finite."""
    A, *rest = problem(3, n, dtype)
    A[...] = np.diag(np.r_[np.ones(n - 1), 0.0])
    A[1] = 1.0 if n > 1 else 0.0
    x = program(n, dtype)(A, *rest)
    assert np.all(np.asarray(x["cholesky"])[0, :, -1, -1] == 0.0)
    for name in ("solve_spd", "inverse_spd"):
        assert not np.any(np.all(np.isfinite(x[name]), axis=(-2, -1)))


@pytest.mark.parametrize(("n", "dtype"), [(6, np.float64), (9, np.float32)])
def test_the_inverse_is_symmetric_to_the_bit_and_calls_no_library(n, dtype):
    """As compiled by default (a product in blocks, such as `@`, would not be, at 9). LAPACK would be a custom call."""
    A = problem(5, n, dtype)[0]
    compiled = jax.jit(small.inverse_spd).lower(A).compile()
    inverse = compiled(A)
    np.testing.assert_array_equal(inverse, transposed(inverse))
    for text in (compiled.as_text().lower(), program(n, dtype).as_text().lower()):
        assert "custom-call" not in text
        assert "lapack" not in text


def test_without_batch_axes_and_under_vmap():
    """A few ulps of the largest entry (A has a condition of 10 or so): programs may contract products differently."""
    _, _, B, C, M, v = problem(4, 4, np.float64)
    A = M @ transposed(M) + 4 * np.eye(4)
    L = np.linalg.cholesky(A)
    batched = program(4, np.float64)(A, L, B, C, M, v)
    mapped = jax.jit(jax.vmap(jax.vmap(small.solve_spd)), compiler_options=OPTIONS)(A, B)
    close(mapped, np.asarray(batched["solve_spd"]), 16, np.max(np.abs(batched["solve_spd"])))
    single = jax.jit(of, compiler_options=OPTIONS)(*(y[1, 3] for y in (A, L, B, C, M, v)))
    for name, one in single.items():
        close(one, np.asarray(batched[name])[1, 3], 16, np.max(np.abs(one)))
