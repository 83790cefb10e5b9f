"""One approach, flown: truth, frames, filter and manoeuvres in one scan over the epochs.

Truth and estimate are propagated, a frame (where there is one) updates the estimate, and a manoeuvre (where there is one) is
computed from the estimate and executed on the truth, with an error that the filter is told the covariance of.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..core import Gaussian, Measurement, Model, no_gate, pytree
from ..filters import ErrorStateKalmanFilter
from ..geometry import small, so3
from ..models.approach import (
    Approach,
    Execution,
    Target,
    approach,
    body_pixel,
    correction,
    executed,
    execution_cov,
    predicted_passage,
    walk_of,
)
from ..models.relative import Camera, Sight
from .approach_data import KM, Draws
from .li2007_data import look_at

Array = jax.Array


@pytree
class Epochs:
    """Timeline as data: dt, before (n,) s; frame, burn (n,) of bool; burns (m,): which epochs have a manoeuvre."""

    dt: Array
    before: Array
    frame: Array
    burn: Array
    burns: Array


@pytree
class Flight:
    """What every estimator shares. start: `Approach` of the orbit to the aim; L (14, 14) of `start_factor`; course: m/s;
    attitude (3,) rad; least: smallest burn, m/s; half: half the image, px."""

    start: Approach
    L: Array
    course: Array
    attitude: Array
    target: Target
    execution: Execution
    least: Array
    half: Array


@pytree
class Choice:
    """What an estimator is. frames, manoeuvres: whether it uses them; told: 1 where its covariance takes the burns' errors;
    known (14,): 0 for a state that it takes as known (with no variance at the start), else 1."""

    frames: Array
    manoeuvres: Array
    told: Array
    known: Array


_FILTER = ErrorStateKalmanFilter(approach)


def attitude_cov(camera: Camera, sigma: Array) -> Array:
    """What the attitude's errors about the camera's x and y do to a body near the boresight, px^2 (2, 2): about x moves y."""
    f = camera.K[:, :2]
    return f @ jnp.diag(jnp.stack([sigma[1], sigma[0]]) ** 2) @ f.T


def _look(model: Model, flight: Flight, truth: Approach, seen_from: Array, noise: Array) -> tuple[Array, Array, Sight]:
    """Pixel and line of a frame that is turned to where the body is thought to be, whether it is in the field, and what is known
    of the frame."""
    camera = model.sensors[0].params
    R_CN = look_at(-seen_from)
    sight = Sight(R_CN, jnp.zeros(2), attitude_cov(camera, flight.attitude))
    turned = so3.exp(flight.attitude * noise[2:]) @ R_CN
    z = body_pixel(camera, truth, Sight(turned, jnp.zeros(2), sight.cov)) + camera.sigma * noise[:2]
    return z, jnp.all(jnp.abs(z - camera.p0) < flight.half), sight


def _plan(
    model: Model,
    flight: Flight,
    burn: Array,
    told: Array,
    truth: Approach,
    belief: Gaussian,
    left: Array,
    normal: Array,
) -> tuple[Approach, Gaussian, dict[str, Array]]:
    """Where the estimate passes, and (burn) the manoeuvre that makes it pass at the aim, executed."""
    forces = model.process.params
    b, J = predicted_passage(forces, flight.target, belief.mean, left)
    dv = correction(flight.target, b, J)
    dv = jnp.where(burn & (jnp.sum(dv * dv) >= flight.least**2), dv, 0.0)
    done = executed(flight.execution, dv, normal)
    sigma = jnp.sqrt(jnp.diagonal(small.congruence(J, belief.cov)))
    grown = belief.cov.at[3:6, 3:6].add(told * execution_cov(flight.execution, dv))
    moved = replace(belief.mean, v=belief.mean.v + dv)
    record = {"b": b, "b_sigma": sigma, "dv": dv, "done": done}
    return replace(truth, v=truth.v + done), Gaussian(moved, grown), record


def _no_plan(truth: Approach, belief: Gaussian) -> tuple[Approach, Gaussian, dict[str, Array]]:
    zero = jnp.zeros(3)
    return truth, belief, {"b": zero, "b_sigma": zero, "dv": zero, "done": zero}


def fly(model: Model, flight: Flight, choice: Choice, epochs: Epochs, draws: Draws) -> tuple[Approach, Gaussian, Any]:
    """One run: truth and belief at the last frame, and the record of every epoch."""
    forces = model.process.params
    course = replace(flight.start, v=flight.start.v + flight.course * draws.course)
    truth = approach.boxplus(course, flight.L @ draws.start)
    L = flight.L * choice.known[:, None]
    belief = Gaussian(course, L @ L.T)
    gate = no_gate(2)

    def body(carry: tuple[Approach, Gaussian], now: Any) -> tuple[tuple[Approach, Gaussian], dict[str, Array]]:
        truth, belief = carry
        dt, before, frame, burn, plan, noise = now
        truth = model.process.step(forces, truth, None, dt, walk_of(forces, dt, noise[:6]))
        belief, _ = _FILTER.predict(belief, model.process, None, dt)
        z, inside, sight = _look(model, flight, truth, belief.mean.r, noise[6:11])
        seen = frame & choice.frames & inside
        belief, info = _FILTER.update(belief, model.sensors[0], Measurement(z, sight, seen[None]), gate, jnp.asarray(0))
        truth, belief, record = jax.lax.cond(
            plan,
            lambda truth, belief: _plan(
                model, flight, burn & choice.manoeuvres, choice.told, truth, belief, before, noise[11:]
            ),
            _no_plan,
            truth,
            belief,
        )
        error = approach.boxminus(truth, belief.mean)
        P = belief.cov
        white = small.matvec(small.invert_lower(small.cholesky(P[:6, :6])), error[:6])
        sigma = jnp.sqrt(jnp.diagonal(P))
        record |= {
            "position_error_km": error[:3] / KM,
            "position_sigma_km": sigma[:3] / KM,
            "velocity_error_m_s": error[3:6],
            "velocity_sigma_m_s": sigma[3:6],
            "ephemeris_error_km": error[6:9] / KM,
            "ephemeris_sigma_km": sigma[6:9] / KM,
            "radiation_error": error[12],
            "radiation_sigma": sigma[12],
            "nees_per_state": jnp.sum(white**2) / 6.0,
            "nis": info.nis,
            "seen": seen,
        }
        return (truth, belief), record

    # Where the probe passes is predicted at manoeuvres and at the hand-over: it costs an integration each time.
    plan = epochs.burn.at[-1].set(True)
    inputs = (epochs.dt, epochs.before, epochs.frame, epochs.burn, plan, draws.noise)
    (truth, belief), record = jax.lax.scan(body, (truth, belief), inputs)
    return truth, belief, record


@jax.jit
def _linearised(model: Model, flight: Flight, epochs: Epochs) -> tuple[Array, Array, Approach]:
    forces = model.process.params

    def body(x: Approach, dt: Array) -> tuple[Approach, tuple]:
        F, _ = model.process.jacobian(forces, x, None, dt)  # this process has one  # type: ignore[misc]
        x = model.process.step(forces, x, None, dt, jnp.zeros(6))
        sight = Sight(look_at(-x.r), jnp.zeros(2), jnp.zeros((2, 2)))
        H = jax.jacfwd(lambda d: body_pixel(model.sensors[0].params, approach.boxplus(x, d), sight))(jnp.zeros(14))
        return x, (F, H, x)

    return jax.lax.scan(body, flight.start, epochs.dt)[1]


def linearised(model: Model, flight: Flight, epochs: Epochs) -> tuple[np.ndarray, np.ndarray, Any]:
    """F (n, 14, 14), H (n, 2, 14) and the states along the orbit to the aim."""
    F, H, x = _linearised(model, flight, epochs)
    return np.asarray(F), np.asarray(H), x
