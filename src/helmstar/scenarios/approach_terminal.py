"""The last minutes of the approach, by li2007's experiment: its camera, noise and attitude reference, from the hand-over's truth
and with the hand-over's estimate as prior.

Frames are even from the last frame of the approach to the estimated closest approach. The state is relative position, velocity
and pointing: the hand-over's covariance has position and velocity, which li2007 takes as known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ..backend import jax, jnp
from ..core import Gaussian, pytree
from ..filters import ErrorStateKalmanFilter, MixtureFilter
from ..models.approach import Approach
from ..models.relative import Motion, PositionVelocityPointing, position_velocity_pointing, relative_model
from .li2007 import Prior, estimate
from .li2007_data import Setting, simulate

Array = jax.Array
SHORTEST_S = 0.1
"""Of a step, where the estimate says that closest approach is over."""


@pytree
class TerminalData:
    """li2007's setting, prior and motion; sigma_q: random walk of the pointing, rad/sqrt(s)."""

    setting: Setting
    prior: Prior
    motion: Motion


@dataclass(frozen=True)
class Terminal:
    """What is compiled: the filter, its kind in li2007, its components, and frames."""

    filter: Any
    kind: str
    n: int
    frames: int

    @classmethod
    def of(cls, name: str, seed: int) -> tuple[Terminal, TerminalData]:
        """The filter `name` ("ekf", "gsf") of li2007's library scenario, and its data."""
        from .li2007 import Experiment
        from .specification import load

        spec = load("li2007", {"seed": seed})[1]
        experiment = Experiment(spec)
        call = experiment.estimators[name]
        model, prior, _ = call.arguments
        ekf = ErrorStateKalmanFilter(position_velocity_pointing)
        filter = MixtureFilter(ekf) if name == "gsf" else ekf
        data = TerminalData(experiment.simulate.arguments[0], prior, model.process.params)
        return cls(filter, call.static["kind"], call.static["n"], spec.updates), data


def terminal_tracking(
    end: Terminal, data: TerminalData, truth: Approach, belief: Gaussian, left: Array, run: Array
) -> dict[str, Array]:
    """Errors of one run; left: seconds to the estimated closest approach."""
    dt = jnp.maximum(left / end.frames, SHORTEST_S)
    zero = jnp.zeros(3)
    setting = replace(
        data.setting, r0=truth.r, v=truth.v, sigma_v=jnp.zeros(()), dt=dt, sigma_q=data.motion.sigma_q * jnp.sqrt(dt),
        offset=zero, sigma_0=zero,
    )  # fmt: skip
    data_of_run = replace(simulate(setting, run[None]), start=belief.mean.r[None])
    pointing = jnp.diag(data.prior.P0[3:6, 3:6])
    o = jnp.zeros((6, 3))
    P0 = jnp.block([[belief.cov[:6, :6], o], [o.T, jnp.diag(pointing)]])
    direction = belief.mean.v / jnp.sqrt(jnp.sum(belief.mean.v**2))
    along = jnp.concatenate([direction, jnp.zeros(6)])
    prior = replace(data.prior, P0=P0, velocity=belief.mean.v, along=along)
    model = relative_model(replace(data.motion, velocity=belief.mean.v), setting.camera, PositionVelocityPointing)
    static = {"filter": end.filter, "kind": end.kind, "n": end.n, "state": PositionVelocityPointing}
    found = jax.tree.map(lambda a: a[0], estimate(model, prior, dt, data_of_run, **static))
    return {
        "terminal_error_km": found["position_error_km"],
        "terminal_sigma_km": found["position_sigma_km"],
        "terminal_nees_per_state": found["nees_per_state"],
        "terminal_step_s": dt,
    }
