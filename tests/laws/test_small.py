"""Small unrolled matrices against numpy.linalg, sizes 1 to 9, two batch axes, and no LAPACK call in the program.

Tolerances are the componentwise backward error bounds of Higham, "Accuracy and Stability of Numerical Algorithms" (2nd
ed., theorems 8.5, 10.3, 10.4 and section 3.5), in ulps: a sum of n products in any order is right to n eps |a| |b|; a
triangular solve leaves a residual of n eps |L| |X|; a Cholesky factor one of (n + 1) eps |L| |L^T|; a solution by it one
of (3 n + 1) eps |L| |L^T| |X|. They hold for every condition number. A forward error has no such bound: it is compared
with numpy's only where the condition number multiplies it. Residuals are taken in twice the precision.
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
SIZES = range(1, 10)
COLUMNS = 3
LEAD = (2, 4)
LAW = settings(deadline=None, derandomize=True, max_examples=8)
SEEDS = st.integers(0, 2**32 - 1)

# The arithmetic of one operation is the same at every optimisation level; at this one, 18 programs compile in a third
# of the time.
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


def exact(*factors) -> np.ndarray:
    """Product of matrices in more precision than float64."""
    product = np.asarray(factors[0], np.longdouble)
    for f in factors[1:]:
        product = product @ np.asarray(f, np.longdouble)
    return product


def residual(dtype, expected, *factors) -> np.ndarray:
    """`expected` minus the product of the factors, as an array of the dtype whose ulps are to be counted."""
    return (np.asarray(expected, np.longdouble) - exact(*factors)).astype(dtype)


def sizes_of(*factors) -> np.ndarray:
    """|A| |B| ..., what the rounding errors of a product or a solve are proportional to."""
    return exact(*(np.abs(f) for f in factors)).astype(np.float64)


def _everything(A, L, B, M, v):
    return {
        "cholesky": small.cholesky(A),
        "solve_lower": small.solve_lower(L, B),
        "solve_upper_of_lower": small.solve_upper_of_lower(L, B),
        "invert_lower": small.invert_lower(L),
        "solve_spd": small.solve_spd(A, B),
        "inverse_spd": small.inverse_spd(A),
        "matmul": small.matmul(M, B),
        "matvec": small.matvec(M, v),
        "congruence": small.congruence(M, A),
        "transpose": small.transpose(B),
        "symmetrise": small.symmetrise(M),
        "blocks": small.blocks([[A, B], [transposed_jax(B), L[..., :COLUMNS, :COLUMNS] * 0 if False else _corner(B)]]),
    }


def problem(seed: int, n: int, dtype, largest_condition: float) -> dict[str, np.ndarray]:
    """A symmetric positive definite, L its factor, and B, M, v; rows and columns scaled apart by up to a thousand."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(*LEAD, n, n)))[0]
    A = (Q * largest_condition ** -rng.random((*LEAD, 1, n))) @ transposed(Q)
    scale = 10.0 ** rng.uniform(-1.5, 1.5, (*LEAD, n))
    A = (0.5 * (A + transposed(A)) * scale[..., :, None] * scale[..., None, :]).astype(dtype)
    L = np.linalg.cholesky(A.astype(np.float64)).astype(dtype)
    B, M, v = (rng.normal(size=(*LEAD, *shape)).astype(dtype) for shape in ((n, COLUMNS), (n, n), (n,)))
    return {"A": A, "L": L, "B": B, "M": M, "v": v}
