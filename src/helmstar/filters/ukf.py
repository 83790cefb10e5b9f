"""The unscented Kalman filter on manifolds: sigma points live in the tangent space, the retraction brings them back.

Scaled transform (Julier 2002; Wan and van der Merwe 2000), n the dimension of the points:
    lambda = alpha^2 (n + kappa) - n,   spread sqrt(n + lambda),
    w0_mean = lambda / (n + lambda),    w0_cov = w0_mean + 1 - alpha^2 + beta,    wi = 1 / (2 (n + lambda))
The kappa form (Julier and Uhlmann 1997) is alpha = 1, beta = 0: `kappa_form(kappa)`.

Prediction uses points of error and process noise together. The mean on the manifold is the base point f(x, 0) moved by
the weighted mean of the deviations; deviations are then taken about that mean (as Hauberg, Lauze and Pedersen 2013 and
Brossard, Barrau and Bonnabel 2020, one step of the intrinsic mean's iteration).
Update as in the EKF: covariance carried to the new mean, gate, masks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ..backend import jax, jnp
from ..core import Gate, Gaussian, Info, Measurement, Predicted, Process, Sensor, pytree
from ..geometry import small
from ..geometry.retraction import Retraction
from .ekf import Carry, ErrorStateKalmanFilter, carry_covariance, doubt, gain, grow, information, judge, prepare

Array = jax.Array


@pytree
class Spread:
    """Parameters of the unscented transform, as data: another spread compiles nothing."""

    alpha: Array
    beta: Array
    kappa: Array

    def weights(self, n: int) -> tuple[Array, Array, Array, Array]:
        """Distance of the points in sigmas, weight of the centre for mean and covariance, weight of the others."""
        scale = self.alpha**2 * (n + self.kappa)
        centre = (scale - n) / scale
        return jnp.sqrt(scale), centre, centre + 1.0 - self.alpha**2 + self.beta, 0.5 / scale


def scaled(alpha: float = 1e-3, beta: float = 2.0, kappa: float = 0.0) -> Spread:
    """The scaled transform; beta = 2 is right to fourth order for Gaussian errors. Raises ValueError for alpha <= 0."""
    if not alpha > 0:
        raise ValueError(f"alpha = {alpha!r}: must be positive, such as 1e-3")
    return Spread(jnp.asarray(alpha), jnp.asarray(beta), jnp.asarray(kappa))


def kappa_form(kappa: float) -> Spread:
    """Julier and Uhlmann's first form: centre weight kappa / (n + kappa), negative for a negative kappa."""
    return Spread(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(kappa))


@pytree
class UnscentedBelief(Gaussian):
    """A Gaussian belief that carries the spread of its sigma points."""

    spread: Spread


def _points(root: Array, distance: Array) -> Array:
    """Deviations of the 2 n outer points, (2 n, n): plus and minus the columns of the root."""
    columns = distance * small.transpose(root)
    return jnp.concatenate([columns, -columns])


def _weighted_outer(w: Array, a: Array, b: Array) -> Array:
    """w sum_i a_i b_i^T."""
    return w * jnp.sum(a[:, :, None] * b[:, None, :], axis=0)


@dataclass(frozen=True)
class UnscentedKalmanFilter:
    """UKF over any retraction. The spread travels with the belief's type, `UnscentedBelief`, as data.

    prediction: "unscented" points, or "linear" by the process's Jacobians as in the EKF, which is the same for a process that is
    linear in its error and costs a tenth.
    """

    retraction: Retraction
    carry: Carry = "transport"
    prediction: Literal["unscented", "linear"] = "unscented"

    def predict(
        self, belief: UnscentedBelief, process: Process, u: Any, dt: Array
    ) -> tuple[UnscentedBelief, Predicted]:
        """Belief after one step of dt seconds; F is the statistical linearisation P_xx' (P)^-1 that a smoother uses."""
        if self.prediction == "linear":
            b, predicted = ErrorStateKalmanFilter(self.retraction).predict(belief, process, u, dt)
            return UnscentedBelief(b.mean, b.cov, belief.spread), predicted
        r, x, P = self.retraction, belief.mean, belief.cov
        n, q = r.dim, process.noise.dim
        distance, _, centre_cov, w = belief.spread.weights(n + q)
        root = root_with_zeros(P)  # states that were drawn (see mixture.py) have no variance
        xi = _points(root, distance)
        noise = _points(root_with_zeros(process.noise.cov(process.params, x, u, dt)), distance)
        zero_w, zero_x = jnp.zeros(q, P.dtype), jnp.zeros(n, P.dtype)
        base = process.step(process.params, x, u, dt, zero_w)

        def deviations(about: Any) -> tuple[Array, Array, Array]:
            def of(xi: Array, noise: Array) -> Array:
                return r.boxminus(process.step(process.params, r.boxplus(x, xi), u, dt, noise), about)

            return (
                jax.vmap(lambda a: of(a, zero_w))(xi),
                jax.vmap(lambda a: of(zero_x, a))(noise),
                r.boxminus(base, about),
            )

        d_x, d_w, d_0 = deviations(base)
        mean = r.boxplus(base, w * (jnp.sum(d_x, axis=0) + jnp.sum(d_w, axis=0)))
        d_x, d_w, d_0 = deviations(mean)
        cov = _weighted_outer(w, d_x, d_x) + _weighted_outer(w, d_w, d_w) + centre_cov * d_0[:, None] * d_0[None, :]
        cross = _weighted_outer(w, d_x, xi)
        V = small.invert_lower(without_zeros(root))
        F = small.matmul(small.matmul(cross, small.transpose(V)), V)
        return UnscentedBelief(mean, cov, belief.spread), Predicted(mean, cov, F)

    def update(
        self, belief: UnscentedBelief, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[UnscentedBelief, Info]:
        """Belief after the measurement. `refused` counts this sensor's refusals in a row before it."""
        r, x, P = self.retraction, belief.mean, belief.cov
        distance, _, centre_cov, w = belief.spread.weights(r.dim)
        e, rows, R = prepare(sensor, x, m)
        z_0 = sensor.predict(sensor.params, x, m.a)
        xi = _points(root_with_zeros(P), distance)
        dz = jax.vmap(lambda d: sensor.minus(sensor.predict(sensor.params, r.boxplus(x, d), m.a), z_0))(xi)
        dz = jnp.where(rows[None, :], dz, jnp.zeros_like(dz))
        dz_mean = w * jnp.sum(dz, axis=0)
        dev, dev_0 = dz - dz_mean, -dz_mean
        S = _weighted_outer(w, dev, dev) + centre_cov * dev_0[:, None] * dev_0[None, :] + R
        Pzx = _weighted_outer(w, dev, xi)
        e = e - dz_mean
        V, nis, dof, status, used = judge(e, S, rows, gate, refused)
        info = information(e, S, V, rows, nis, dof, status)
        K = gain(V, Pzx)
        K = jnp.where(used, K, jnp.zeros_like(K))
        d = jnp.where(used, small.matvec(K, e), jnp.zeros(r.dim, P.dtype))
        cov = grow(P, nis, R, S, status) - small.congruence(K, S + R - doubt(R, nis, dof, status))
        cov = small.symmetrise(carry_covariance(r, self.carry, x, d, cov))
        return UnscentedBelief(r.boxplus(x, d), cov, belief.spread), info


def without_zeros(L: Array) -> Array:
    """A root with a unit diagonal where it has none, so that it can be inverted."""
    eye = jnp.eye(L.shape[0], dtype=L.dtype)
    return jnp.where((jnp.diagonal(L) == 0.0)[:, None], eye, L)


def root_with_zeros(Q: Array) -> Array:
    """Cholesky factor of a covariance that may have zero variances (a noise that is switched off, a state that was drawn)."""
    off = jnp.diagonal(Q) <= 0.0
    eye = jnp.eye(Q.shape[0], dtype=Q.dtype)
    L = small.cholesky(jnp.where(off[:, None] | off[None, :], eye, Q))
    return jnp.where(off[:, None] | off[None, :], jnp.zeros_like(L), L)
