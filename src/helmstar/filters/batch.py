"""Batch least squares with process noise: the most probable trajectory of a whole arc, and its covariance.

Gauss and Newton's method on the negative log posterior of all states,

    |x_0 [-] x0|^2_P0 + sum_k |x_k [-] f(x_k-1)|^2_Q + sum_k |z_k [-] h(x_k)|^2_R,

where one step is a Kalman smoother on the problem linearised at the last trajectory (Bell 1994, "The iterated Kalman smoother
as a Gauss-Newton method"). Nothing is linearised at an estimate that later data do not know, which is what an EKF does and
where its inconsistency comes from.

`map_estimates` gives the estimate of every step from the data up to it: `iterations` steps each, from the trajectory of the step
before.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from ..backend import jax, jnp
from ..core import Gaussian, Measurement, Model
from ..geometry import small
from .ekf import prepare

Array = jax.Array


def _linearised(model: Model, x0: Any, xs: Any, u: Any, dt: Array, m: tuple[Measurement, ...]) -> tuple:
    """At the trajectory x0, xs (steps): F, Q and defect f(x_k-1) [-] x_k of every step; information and its vector of the
    measurements."""
    r, process = model.retraction, model.process
    before = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), x0, xs)

    def one(x: Any, y: Any, u: Any, dt: Array, ms: tuple[Measurement, ...]) -> tuple:
        w0 = jnp.zeros(process.noise.dim)
        F, G = jax.jacfwd(
            lambda xi, w: r.boxminus(process.step(process.params, r.boxplus(x, xi), u, dt, w), y), argnums=(0, 1)
        )(jnp.zeros(r.dim), w0)
        defect = r.boxminus(process.step(process.params, x, u, dt, w0), y)
        Q = small.congruence(G, process.noise.cov(process.params, x, u, dt))
        J, g = jnp.zeros((r.dim, r.dim)), jnp.zeros(r.dim)
        for sensor, one_m in zip(model.sensors, ms, strict=True):
            e, rows, R = prepare(sensor, y, one_m)
            z0 = sensor.predict(sensor.params, y, one_m.a)
            H = jax.jacfwd(lambda xi, s=sensor, a=one_m.a, z=z0: s.minus(s.predict(s.params, r.boxplus(y, xi), a), z))(
                jnp.zeros(r.dim)
            )
            H = jnp.where(rows[:, None], H, 0.0)
            V = small.solve_lower(small.cholesky(R), jnp.concatenate([H, e[:, None]], axis=1))
            J, g = J + V[:, :-1].T @ V[:, :-1], g + V[:, :-1].T @ V[:, -1]
        return F, Q, defect, J, g

    return jax.vmap(one)(before, xs, u, dt, m)


def _smooth(P0: Array, d0: Array, F: Array, Q: Array, defect: Array, J: Array, g: Array) -> tuple[Array, Array, Array]:
    """Deviations of x0 and of every state from the trajectory that minimise the linearised cost, and the covariance of every
    state from the data up to it. d0: x0's prior mean less its place on the trajectory.

    An information filter forwards, Rauch, Tung and Striebel's smoother backwards.
    """

    def forward(carry: tuple, inputs: tuple) -> tuple:
        d, P = carry
        F, Q, defect, J, g = inputs
        prior, P_prior = F @ d + defect, small.congruence(F, P) + Q
        inverse = small.inverse_spd(P_prior)
        after_P = small.inverse_spd(inverse + J)
        after = prior + after_P @ (g - J @ prior)
        C = P @ F.T @ inverse
        return (after, after_P), (d, C, prior, after_P)

    (last, _), (ds, Cs, priors, covs) = jax.lax.scan(forward, (d0, P0), (F, Q, defect, J, g))

    def backward(later: Array, inputs: tuple) -> tuple:
        d, C, prior = inputs
        return d + C @ (later - prior), later

    first, smoothed = jax.lax.scan(backward, last, (ds, Cs, priors), reverse=True)
    return first, smoothed, covs


def _step(model: Model, start: Gaussian, x0: Any, xs: Any, u: Any, dt: Array, m: tuple[Measurement, ...]) -> tuple:
    """One step of Gauss and Newton: the new trajectory, and each state's covariance from the data up to it."""
    r = model.retraction
    F, Q, defect, J, g = _linearised(model, x0, xs, u, dt, m)
    d0, d, covs = _smooth(start.cov, r.boxminus(start.mean, x0), F, Q, defect, J, g)
    return r.boxplus(x0, d0), jax.vmap(r.boxplus)(xs, d), covs


def _propagated(model: Model, x0: Any, u: Any, dt: Array) -> Any:
    """States of every step without noise."""
    process = model.process

    def step(x: Any, inputs: tuple) -> tuple[Any, Any]:
        u, dt = inputs
        y = process.step(process.params, x, u, dt, jnp.zeros(process.noise.dim))
        return y, y

    return jax.lax.scan(step, x0, (u, dt))[1]


@partial(jax.jit, static_argnames=("iterations",))
def batch_map(
    model: Model, start: Gaussian, u: Any, dt: Array, m: tuple[Measurement, ...], iterations: int = 4
) -> tuple[Any, Any, Array]:
    """Most probable x0, states of every step (leading axis), and the covariance (dim, dim) of the last one.

    start: belief before the first step; u, dt, m: as for `run`.
    """
    x0, xs = start.mean, _propagated(model, start.mean, u, dt)
    covs = start.cov[None]
    for _ in range(iterations):
        x0, xs, covs = _step(model, start, x0, xs, u, dt, m)
    return x0, xs, covs[-1]


@partial(jax.jit, static_argnames=("iterations",))
def map_estimates(
    model: Model, start: Gaussian, u: Any, dt: Array, m: tuple[Measurement, ...], iterations: int = 2
) -> Gaussian:
    """Mean and covariance of every step (leading axis) from the data up to that step alone.

    Later states follow without data, so that one program of full length serves every step; it costs the square of the
    arc's length.
    """
    steps = dt.shape[0]

    def at(carry: tuple, k: Array) -> tuple:
        x0, xs = carry
        known = jnp.arange(steps) <= k
        masked = tuple(Measurement(one.z, one.a, one.mask & known[:, None]) for one in m)

        def iterate(_: int, x: tuple) -> tuple:
            return _step(model, start, x[0], x[1], u, dt, masked)

        covs = jnp.zeros((steps, *start.cov.shape))
        x0, xs, covs = jax.lax.fori_loop(0, iterations, iterate, (x0, xs, covs))
        return (x0, xs), (jax.tree.map(lambda a: a[k], xs), covs[k])

    first = (start.mean, _propagated(model, start.mean, u, dt))
    _, (means, covs) = jax.lax.scan(at, first, jnp.arange(steps))
    return Gaussian(means, covs)


__all__ = ["batch_map", "map_estimates"]
