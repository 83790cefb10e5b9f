"""The error-state extended Kalman filter, once for every model. MEKF, invariant and SO(3) filters are its retractions.

    predict   x' = f(x, u, 0)                F = d(f(x [+] xi) [-] x')/d xi, G likewise for the noise
              P' = F P F^T + G Q G^T
    update    e = z [-] h(x)                 H = d(h(x [+] xi))/d xi
              S = H P H^T + R                K = P H^T S^-1
              x+ = x [+] K e                 P+ = (I - K H) P (I - K H)^T + K R K^T    (Joseph)
              P+ <- D P+ D^T                 covariance carried to the new mean, see `carry`

Iterated update (Bell and Cathey 1993): Gauss-Newton on the posterior with the prior kept at the predicted mean, so that
the measurement enters once however many iterations are made: with d_i = x_i [-] x', K_i at x_i,
d_{i+1} = K_i (e_i + H_i d_i). H_i is the derivative by d at d_i, so P+ lives in the coordinates of d and goes to the tangent
space at the new mean by their Jacobian, not by transport.

Masked measurement entries: their residuals are replaced before any arithmetic, their rows of H are zero and they have a
unit diagonal in S, so that they add nothing to NIS, gain or likelihood.

P is never symmetrised: every step is a congruence plus a symmetric term, which contracts the asymmetry of rounding, and
the Cholesky factor reads one triangle only (symmetrising doubled the time of a step: XLA computes its argument twice).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ..backend import jax, jnp
from ..core import (
    ABSENT,
    ACCEPTED,
    FORCED,
    GATED,
    REOPENED,
    Gate,
    Gaussian,
    Info,
    Measurement,
    Predicted,
    Process,
    Sensor,
)
from ..geometry import small
from ..geometry.retraction import Retraction

Array = jax.Array
Carry = Literal["transport", "jacobian", "none"]


def carry_covariance(retraction: Retraction, how: Carry, x: Any, d: Array, P: Array) -> Array:
    """Covariance at x carried to x [+] d.

    transport: by the retraction's transport (right error: unchanged; left: Exp(d)), which makes left and right agree.
    jacobian: by J = d((x [+] (d + e)) [-] (x [+] d))/d e, the first-order reset. none: left as it is.
    """
    if how == "transport":
        if retraction.transport is None:
            return P
        D = retraction.transport(d)
    elif how == "jacobian":
        y = retraction.boxplus(x, d)
        D = jax.jacfwd(lambda e: retraction.boxminus(retraction.boxplus(x, d + e), y))(jnp.zeros_like(d))
    else:
        return P
    return small.congruence(D, P)


def prepare(sensor: Sensor, x: Any, m: Measurement) -> tuple[Array, Array, Array]:
    """Residual, rows present (bool) and R of a measurement at x, with the masked entries neutralised."""
    e = sensor.minus(m.z, sensor.predict(sensor.params, x, m.a))
    rows = jnp.repeat(m.mask, e.shape[0] // m.mask.shape[0], total_repeat_length=e.shape[0])
    e = jnp.where(rows, e, jnp.zeros_like(e))
    R = sensor.cov(sensor.params, x, m.a)
    both = rows[:, None] & rows[None, :]
    R = jnp.where(both, R, jnp.eye(e.shape[0], dtype=e.dtype))
    return e, rows, R


def judge(e: Array, S: Array, rows: Array, gate: Gate, refused: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Of a residual e with covariance S: whitening V (lower, V S V^T = I), NIS, degrees of freedom, status and whether
    the update is made. A NIS that is not finite (S singular, a residual of NaN) is refused and reopens nothing.

    Raises ValueError (when traced) for more residuals than the gate has limits for.
    """
    if e.shape[-1] >= gate.limits.shape[-1]:
        raise ValueError(
            f"{e.shape[-1]} residuals, but the gate has limits for {gate.limits.shape[-1] - 1}: build it with "
            f"max_dof={e.shape[-1]} or more"
        )
    V = small.invert_lower(small.cholesky(S))
    white = small.matvec(V, e)
    nis = jnp.sum(white * white)
    dof = jnp.sum(rows)
    often = jnp.where(refused >= gate.reopen_after, FORCED, REOPENED)
    status = jnp.where((refused + 1 >= gate.reopen_after) & jnp.isfinite(nis), often, GATED)
    status = jnp.where(nis <= gate.limits[dof], ACCEPTED, status)
    status = jnp.where(dof > 0, status, ABSENT)
    return V, nis, dof, status, (status == ACCEPTED) | (status == FORCED)


def grow(cov: Array, nis: Array, R: Array, S: Array, status: Array, constant: tuple[int, ...] = ()) -> Array:
    """A belief whose measurements were refused again and again was too sure of itself: its covariance grows by NIS over
    the degrees of freedom that it explains, sum(1 - R_ii / S_ii), so that the gate opens for the measurements that follow.
    `constant` states, which no upset changes, keep their variance."""
    explained = jnp.sum(1.0 - jnp.diagonal(R) / jnp.diagonal(S))
    factor = jnp.maximum(nis / jnp.maximum(explained, jnp.finfo(cov.dtype).eps), 1.0)
    grown = cov * factor
    if constant:
        root = jnp.sqrt(factor) * jnp.ones(cov.shape[0], cov.dtype)
        root = root.at[jnp.asarray(constant)].set(1.0)
        grown = cov * root[:, None] * root[None, :]
    return jnp.where(status == REOPENED, grown, cov)


def doubt(R: Array, nis: Array, dof: Array, status: Array) -> Array:
    """R of a measurement that is used although the gate would refuse it: NIS / dof times larger, where P+ is computed.

    Far outside the linear range of h a residual has parts that no covariance of the state explains (stars off by 90 deg
    do not look like any small turn): waiting for a grown covariance to open the gate would be waiting for ever. The gain is
    the one of R itself, a Gauss-Newton step towards the measurement.
    """
    return R * jnp.where(status == FORCED, nis / jnp.maximum(dof, 1), jnp.ones_like(nis))


def gain(V: Array, HP: Array) -> Array:
    """K = P H^T S^-1 = (V H P)^T V from the whitening V of S."""
    return small.matmul(small.transpose(small.matmul(V, HP)), V)


def information(e: Array, S: Array, V: Array, rows: Array, nis: Array, dof: Array, status: Array) -> Info:
    """Info of an update; the log likelihood counts the rows present only."""
    log_det = -2.0 * jnp.sum(jnp.where(rows, jnp.log(jnp.diagonal(V)), 0.0))
    loglik = -0.5 * (nis + log_det + dof * jnp.log(2.0 * jnp.pi))
    return Info(residual=e, S=S, nis=nis, dof=dof, loglik=loglik, status=status)


@dataclass(frozen=True)
class ErrorStateKalmanFilter:
    """EKF over any retraction. `iterations` > 1 iterates the update without using the measurement again.

    carry: see `carry_covariance`; an iterated update with "transport" carries by the Jacobian, as its covariance asks for.
    constant: indices of error states that a reopening gate does not doubt (a calibration). considered: indices of states that
    are not estimated but whose uncertainty counts (Schmidt-Kalman: their gain is zero); for one iteration.
    """

    retraction: Retraction
    carry: Carry = "transport"
    iterations: int = 1
    constant: tuple[int, ...] = ()
    considered: tuple[int, ...] = ()

    def predict(self, belief: Gaussian, process: Process, u: Any, dt: Array) -> tuple[Gaussian, Predicted]:
        """Belief after one step of dt seconds under the input u, and what a smoother needs of it."""
        r, x = self.retraction, belief.mean
        w0 = jnp.zeros(process.noise.dim, belief.cov.dtype)
        mean = process.step(process.params, x, u, dt, w0)
        if process.jacobian is not None:
            F, G = process.jacobian(process.params, x, u, dt)
        else:
            F, G = jax.jacfwd(
                lambda xi, w: r.boxminus(process.step(process.params, r.boxplus(x, xi), u, dt, w), mean),
                argnums=(0, 1),
            )(jnp.zeros(r.dim, belief.cov.dtype), w0)
        Q = process.noise.cov(process.params, x, u, dt)
        GQGt = Q if G is None else small.congruence(G, Q)
        cov = small.congruence(F, belief.cov) + GQGt
        return Gaussian(mean, cov), Predicted(mean, cov, F)

    def update(
        self, belief: Gaussian, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[Gaussian, Info]:
        """Belief after the measurement. `refused` counts this sensor's refusals in a row before it."""
        r, x, P = self.retraction, belief.mean, belief.cov
        e, rows, R = prepare(sensor, x, m)
        d = jnp.zeros(r.dim, P.dtype)
        H = self._sensor_jacobian(sensor, x, m, rows, d)
        HP = small.matmul(H, P)
        S = small.matmul(HP, small.transpose(H)) + R
        V, nis, dof, status, used = judge(e, S, rows, gate, refused)
        P_grown = grow(P, nis, R, S, status, self.constant)
        info = information(e, S, V, rows, nis, dof, status)
        K = gain(V, HP)
        if self.considered:
            K = K.at[jnp.asarray(self.considered)].set(0.0)
        d = small.matvec(K, e)
        for _ in range(self.iterations - 1):
            y = r.boxplus(x, d)
            e_i, _, R = prepare(sensor, y, m)
            H = self._sensor_jacobian(sensor, x, m, rows, d)
            HP = small.matmul(H, P)
            V = small.invert_lower(small.cholesky(small.matmul(HP, small.transpose(H)) + R))
            K = gain(V, HP)
            d = small.matvec(K, e_i + small.matvec(H, d))

        d = jnp.where(used, d, jnp.zeros_like(d))
        K = jnp.where(used, K, jnp.zeros_like(K))
        A = jnp.eye(r.dim, dtype=P.dtype) - small.matmul(K, H)
        cov = small.congruence(A, P_grown) + small.congruence(K, doubt(R, nis, dof, status))
        how = "jacobian" if self.carry == "transport" and self.iterations > 1 else self.carry
        return Gaussian(r.boxplus(x, d), carry_covariance(r, how, x, d, cov)), info

    def _sensor_jacobian(self, sensor: Sensor, x: Any, m: Measurement, rows: Array, d: Array) -> Array:
        """H = d h(x [+] d)/d d with the rows of absent entries zero."""
        r = self.retraction
        if sensor.jacobian is not None and self.iterations == 1:
            H = sensor.jacobian(sensor.params, x, m.a)
        else:
            z0 = sensor.predict(sensor.params, r.boxplus(x, d), m.a)
            H = jax.jacfwd(lambda xi: sensor.minus(sensor.predict(sensor.params, r.boxplus(x, xi), m.a), z0))(d)
        return jnp.where(rows[:, None], H, jnp.zeros_like(H))
