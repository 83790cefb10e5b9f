"""Rotations as 3x3 matrices and rotation vectors: exp, log and the Jacobians of SO(3).

Accurate to a few ulps and differentiable (forward and reverse) at 0, near pi and at pi, in float64 and float32.
All functions take any number of leading batch axes.

| symbol | meaning | shape |
|---|---|---|
| phi | rotation vector, angle in rad times unit axis | (..., 3) |
| R | rotation matrix, R = exp([phi x]) | (..., 3, 3) |
| J_l, J_r | left and right Jacobian: exp(phi + d) = exp(J_l d) exp(phi) = exp(phi) exp(J_r d) to first order | (..., 3, 3) |

Source: Chirikjian, "Stochastic Models, Information Theory, and Lie Groups" vol. 2 (2012), section 10.8; Sola, Deray and
Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. (132)-(147).
"""

from __future__ import annotations

from ..backend import jax, jnp
from . import quaternion
from .series import cos_of_square, jacobian_inverse_coefficient, sinc_of_square, versine_coefficient, wedge_coefficient

Array = jax.Array


@jax.jit
def hat(v: Array) -> Array:
    """Cross-product matrix: `hat(v) @ u == cross(v, u)`. Shape (..., 3) -> (..., 3, 3)."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape[:-1], 3, 3)


def vee(M: Array) -> Array:
    """Vector of the skew part of M, the inverse of `hat`. Shape (..., 3, 3) -> (..., 3)."""
    return 0.5 * jnp.stack(
        [M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], axis=-1
    )


def _polynomial(phi: Array, a: Array | float, b: Array | float, c: Array | float) -> Array:
    """a I + b [phi x] + c phi phi^T, the form that all functions of [phi x] take."""
    outer = phi[..., :, None] * phi[..., None, :]
    a, b, c = (jnp.asarray(s, phi.dtype)[..., None, None] for s in (a, b, c))
    return a * jnp.eye(3, dtype=phi.dtype) + b * hat(phi) + c * outer


@jax.jit
def exp(phi: Array) -> Array:
    """R = exp([phi x]), Rodrigues' formula: cos t I + (sin t / t) [phi x] + ((1 - cos t) / t^2) phi phi^T."""
    t2 = jnp.sum(phi * phi, axis=-1)
    return _polynomial(phi, cos_of_square(t2), sinc_of_square(t2), versine_coefficient(t2))


def log(R: Array) -> Array:
    """Rotation vector of R with angle in [0, pi]; at pi one of the two valid vectors, with a finite gradient."""
    return quaternion.log(quaternion.from_matrix(R))


@jax.jit
def left_jacobian(phi: Array) -> Array:
    """J_l(phi) = (sin t / t) I + ((1 - cos t) / t^2) [phi x] + ((t - sin t) / t^3) phi phi^T."""
    t2 = jnp.sum(phi * phi, axis=-1)
    return _polynomial(phi, sinc_of_square(t2), versine_coefficient(t2), wedge_coefficient(t2))


def right_jacobian(phi: Array) -> Array:
    """J_r(phi) = J_l(-phi)."""
    return left_jacobian(-phi)


@jax.jit
def left_jacobian_inverse(phi: Array) -> Array:
    """J_l(phi)^-1 = (1 - t^2 c) I - [phi x] / 2 + c phi phi^T, c = (1 - (t/2) cot(t/2)) / t^2; singular at 2 pi only."""
    t2 = jnp.sum(phi * phi, axis=-1)
    c = jacobian_inverse_coefficient(t2)
    return _polynomial(phi, 1.0 - t2 * c, -0.5 * jnp.ones_like(t2), c)


def right_jacobian_inverse(phi: Array) -> Array:
    """J_r(phi)^-1 = J_l(-phi)^-1."""
    return left_jacobian_inverse(-phi)


def angle_between(R1: Array, R2: Array) -> Array:
    """Angle in rad of R1 R2^T, in [0, pi]."""
    return quaternion.angle_between(quaternion.from_matrix(R1), quaternion.from_matrix(R2))
