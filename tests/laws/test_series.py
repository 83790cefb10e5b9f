"""Each function of geometry/series.py against mpmath with 60 digits: value and first derivative, in ulps.

Tolerances. The argument is t^2, so a rounding of the square root inside moves it by one ulp: an error of
eps (|f| + |t^2 f'|) is the best that can be asked ("backward stable"), and it is finite at the zeros of sin and cos.
Where a closed form subtracts nearly equal numbers just above its threshold, the loss is the ratio of the two:
1 / (1 - sin 1) = 6 for the wedge coefficient, 1 / (1 - cot(1/2) / 2) = 12 for the inverse Jacobian's.
The derivative of a closed form divides that loss by t^2 once more; what enters a Jacobian is t^2 f' beside f, so above
the threshold its error is measured against |f'| + |t^2 f''| + |f| / t^2, below it (series) against |f'| alone.
"""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from helmstar.backend import jax
from helmstar.geometry import series

DTYPES = [np.float64, np.float32]


def _wedge(u):
    t = mpmath.sqrt(u)
    return (t - mpmath.sin(t)) / t**3


def _jacobian_inverse(u):
    t = mpmath.sqrt(u)
    return (1 - t / 2 * mpmath.cot(t / 2)) / u


# name: (exact function of t^2, threshold below which the code takes its series, ulps of the value, of the derivative)
CASES = {
    "cos_of_square": (lambda u: mpmath.cos(mpmath.sqrt(u)), 0.25, 2, 4),
    "sinc_of_square": (lambda u: mpmath.sin(mpmath.sqrt(u)) / mpmath.sqrt(u), 0.25, 2, 4),
    "versine_coefficient": (lambda u: (1 - mpmath.cos(mpmath.sqrt(u))) / u, 1.0, 4, 4),
    "wedge_coefficient": (_wedge, 1.0, 6, 12),
    "jacobian_inverse_coefficient": (_jacobian_inverse, 1.0, 12, 24),
}
COMPILED = {n: (jax.jit(getattr(series, n)), jax.jit(jax.vmap(jax.grad(getattr(series, n))))) for n in CASES}
SECOND = {n: jax.jit(jax.vmap(jax.hessian(getattr(series, n)))) for n in CASES}
ATAN = jax.jit(series.atan_ratio)
ATAN_GRADIENT = jax.jit(jax.vmap(jax.grad(series.atan_ratio, argnums=(0, 1))))


def error_in_ulps(actual, expected, scale=1.0) -> float:
    """Largest |actual - expected| over eps of actual's dtype times scale; a NaN is infinitely wrong."""
    actual = np.asarray(actual)
    e = np.abs(actual.astype(np.float64) - expected) / (np.finfo(actual.dtype).eps * np.asarray(scale, np.float64))
    return float(np.max(np.where(np.isnan(e), np.inf, e), initial=0.0))


def close(actual, expected, ulps: float, scale=1.0) -> None:
    e = error_in_ulps(actual, expected, scale)
    assert e <= ulps, f"{e:.2f} ulps, {ulps} allowed"


def arguments(dtype) -> np.ndarray:
    """t^2 of the dtype: 0, every decade, both sides of every threshold, up to t = 6 (the pole is at 2 pi)."""
    edges = np.array([0.25, 1.0, np.pi**2 / 4, np.pi**2], dtype)
    near = np.concatenate([edges, np.nextafter(edges, dtype(0)), np.nextafter(edges, dtype(100)), edges * dtype(0.99)])
    tiny = 10.0 ** np.arange(-36, 0, 2.0)
    extreme = [0.0, 1e-300 if dtype == np.float64 else 1e-37]
    above = np.linspace(1.0, 1.25, 40)  # where the closed forms lose most
    return np.concatenate([extreme, tiny, near, above, np.linspace(0.02, 36.0, 150)]).astype(dtype)


def exact(f, t2: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """f, f', f'' at t2 (at 1e-30 instead of below: the functions are entire or analytic to 2 pi) by differences in
    200 digits, with steps so small that what is left of them is far below float64."""
    with mpmath.workdps(200):
        rows = []
        for u in t2:
            x = mpmath.mpf(max(float(u), 1e-30))
            h = x * mpmath.mpf(10) ** -30
            low, mid, high = f(x - h), f(x), f(x + h)
            rows.append((float(mid), float((high - low) / (2 * h)), float((high - 2 * mid + low) / h**2)))
    return tuple(np.array(c) for c in zip(*rows, strict=True))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CASES)
def test_value_and_derivative_match_exact_arithmetic(name, dtype):
    f, threshold, value_ulps, derivative_ulps = CASES[name]
    value, derivative = COMPILED[name]
    t2 = arguments(dtype)
    f0, f1, f2 = exact(f, t2)
    assert value(t2).dtype == derivative(t2).dtype == dtype
    close(value(t2), f0, value_ulps, np.abs(f0) + np.abs(t2 * f1))
    small = t2 < threshold
    beside = np.where(small, 0.0, np.abs(f0) / np.where(small, 1.0, t2))
    close(derivative(t2), f1, derivative_ulps, np.abs(f1) + np.abs(t2 * f2) + beside)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CASES)
def test_second_derivative_is_exact_in_the_series_and_finite_outside(name, dtype):
    """Hessians at 0 need it. 8: two derivatives of a polynomial, whose coefficients grow by the square of their number."""
    f, threshold, *_ = CASES[name]
    t2 = arguments(dtype)
    second = np.asarray(SECOND[name](t2))
    assert second.dtype == dtype
    assert np.all(np.isfinite(second))
    t2, second = t2[t2 < threshold], second[t2 < threshold]
    expected = exact(f, t2)[2]
    close(second, expected, 8, np.abs(expected))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("length", [1.0, 0.5, 3.0])
def test_atan_ratio_matches_exact_arithmetic(length, dtype):
    """f(s2, c) = atan2(s, c) / s for 0 <= angle <= pi / 2, both sides of the threshold s2 = c^2 / 100, on the circle of
    unit quaternions and off it. Partial derivatives: 1 / (s^2 + c^2) - f taken over 2 s2, which loses what the
    threshold lets it lose (a factor 150 against f', but 1 against f / s2, which is how it enters a Jacobian).
    """
    edge = np.arctan(0.1)
    angles = [0.0, 1e-300, 1e-30, 1e-8, 1e-3, edge * (1 - 1e-7), edge, edge * (1 + 1e-7), np.pi / 2 - 1e-9, np.pi / 2]
    angles = np.concatenate([angles, np.linspace(0.01, 1.57, 60)])
    s2 = (length**2 * np.sin(angles) ** 2).astype(dtype)
    c = (length * np.cos(angles)).astype(dtype)
    c[9] = 0.0
    with mpmath.workdps(100):
        rows = []
        for u, w in zip(s2, c, strict=True):
            u, w = mpmath.mpf(float(u)), mpmath.mpf(float(w))
            if u < 1e-60:  # 1 / c and its derivatives, the limits of what follows
                rows.append((1 / w, -1 / (3 * w**3), -1 / w**2))
                continue
            s = mpmath.sqrt(u)
            value = mpmath.atan2(s, w) / s
            rows.append((value, (w / (u + w * w) - value) / (2 * u), -1 / (u + w * w)))
    f, by_s2, by_c = np.array(rows, dtype=float).T
    value, (g_s2, g_c) = ATAN(s2, c), ATAN_GRADIENT(s2, c)
    assert value.dtype == g_s2.dtype == g_c.dtype == dtype
    small = s2 < 0.01 * c * c
    beside = np.where(small, 0.0, f / np.where(small, 1.0, s2))
    close(value, f, 4, f)
    close(g_s2, by_s2, 8, np.abs(by_s2) + beside)
    close(g_c, by_c, 4, np.abs(by_c))


@pytest.mark.parametrize("dtype", DTYPES)
def test_values_at_zero_are_the_limits_to_the_bit(dtype):
    zero = np.zeros_like(arguments(dtype))
    limits = {
        "cos_of_square": (1.0, -1 / 2),
        "sinc_of_square": (1.0, -1 / 6),
        "versine_coefficient": (1 / 2, -1 / 24),
        "wedge_coefficient": (1 / 6, -1 / 120),
        "jacobian_inverse_coefficient": (1 / 12, 1 / 720),
    }
    for name, (value, slope) in limits.items():
        f, df = COMPILED[name]
        assert np.all(np.asarray(f(zero)) == dtype(value))
        close(df(zero), slope, 1, abs(slope))
