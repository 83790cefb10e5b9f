"""Even functions of an angle t as smooth functions of t^2, so that no square root is differentiated at 0.

Each takes t2 = t^2 >= 0 (any shape) and is accurate to a few ulps with finite derivatives everywhere it is defined.
Below a threshold a Taylor series in t^2 is used; above it the closed form, whose argument is replaced by a harmless one
where the series is taken, so that no infinite derivative is multiplied by zero.
"""

from __future__ import annotations

from math import factorial

from ..backend import jax, jnp

Array = jax.Array


def _horner(x: Array, coefficients: tuple[float, ...]) -> Array:
    y = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        y = y * x + c
    return y


def _piecewise(t2: Array, threshold: float, coefficients: tuple[float, ...], closed) -> Array:
    small = t2 < threshold
    safe = jnp.where(small, jnp.ones_like(t2), t2)
    return jnp.where(
        small, _horner(jnp.where(small, t2, jnp.zeros_like(t2)), coefficients), closed(safe, jnp.sqrt(safe))
    )


# Truncation below 1e-16 relative at the threshold, first and second derivative included (of the arc tangent the first:
# the second is right to 1e-13 there, and enters a Hessian times s2^2 < 1e-4).
_COS = tuple((-1.0) ** k / factorial(2 * k) for k in range(9))
_SINC = tuple((-1.0) ** k / factorial(2 * k + 1) for k in range(9))
_WEDGE = tuple((-1.0) ** k / factorial(2 * k + 3) for k in range(12))
# (1 - (t/2) cot(t/2)) / t^2 = sum |B_2k| t^(2k-2) / (2k)!, k = 1..
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330)
_BERNOULLI += (854513 / 138, 236364091 / 2730, 8553103 / 6, 23749461029 / 870, 8615841276005 / 14322)
_COT = tuple(b / factorial(2 * k + 2) for k, b in enumerate(_BERNOULLI))
_ATAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(9))


def cos_of_square(t2: Array) -> Array:
    """cos t."""
    return _piecewise(t2, 0.25, _COS, lambda _, t: jnp.cos(t))


def sinc_of_square(t2: Array) -> Array:
    """sin t / t."""
    return _piecewise(t2, 0.25, _SINC, lambda _, t: jnp.sin(t) / t)


def versine_coefficient(t2: Array) -> Array:
    """(1 - cos t) / t^2 = (sin(t/2) / (t/2))^2 / 2, without cancellation."""
    return 0.5 * sinc_of_square(0.25 * t2) ** 2


def wedge_coefficient(t2: Array) -> Array:
    """(t - sin t) / t^3."""
    return _piecewise(t2, 1.0, _WEDGE, lambda u, t: (1.0 - jnp.sin(t) / t) / u)


def jacobian_inverse_coefficient(t2: Array) -> Array:
    """(1 - (t/2) cot(t/2)) / t^2; regular at pi, infinite at 2 pi."""
    return _piecewise(t2, 1.0, _COT, lambda u, t: (1.0 - 0.5 * t * jnp.cos(0.5 * t) / jnp.sin(0.5 * t)) / u)


def atan_ratio(s2: Array, c: Array) -> Array:
    """atan2(s, c) / s for s = sqrt(s2) and c >= 0, smooth at s = 0 (where it is 1 / c)."""
    small = s2 < 0.01 * c * c
    s_safe = jnp.sqrt(jnp.where(small, jnp.ones_like(s2), s2))
    c_safe = jnp.where(small, c, jnp.ones_like(c))
    x = jnp.where(small, s2, jnp.zeros_like(s2)) / (c_safe * c_safe)
    return jnp.where(small, _horner(x, _ATAN) / c_safe, jnp.arctan2(s_safe, c) / s_safe)
