"""The approach to a small body, assembled: what is flown (approach_flight.py), every estimator by name, the bound, and the
hand-over to li2007's terminal tracking. Estimators differ in data alone, so that all share one program."""

from __future__ import annotations

import json
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..core import Model
from ..evaluate import recursive_bound
from ..models.approach import (
    MU_SUN,
    Approach,
    Execution,
    Forces,
    Target,
    approach_model,
    flow,
    passage,
)
from ..models.relative import Camera
from ..units import ARCSEC
from .approach_data import DAY, KM, Draws, Setting, nominal_start, pressure, simulate, start_factor, timeline
from .approach_flight import Choice, Epochs, Flight, attitude_cov, fly, linearised
from .approach_specification import Specification
from .approach_terminal import Terminal, terminal_tracking
from .experiment import Call, Variable

Array = jax.Array
LONGEST_STEP = 0.5 * DAY
"""Of the integration: over 100 days it leaves metres (tests/unit/test_approach.py)."""


@partial(jax.jit, static_argnames=("end",))
def estimate(
    model: Model, flight: Flight, choice: Choice, epochs: Epochs, terminal: Any, draws: Draws, *, end: Terminal | None
) -> dict[str, Array]:
    """Tracks of one estimator over all runs of `draws`; end: the terminal tracking, or None for none."""

    def one(draws: Draws) -> dict[str, Array]:
        truth, belief, record = fly(model, flight, choice, epochs, draws)
        forces, target, left = model.process.params, flight.target, epochs.before[-1]
        true_b = passage(target, flow(forces, truth, left, target.steps))
        plans = {k: record.pop(k) for k in ("b", "b_sigma", "dv", "done")}
        burnt = {k: v[epochs.burns] for k, v in plans.items()}
        b, b_sigma = plans["b"][-1], plans["b_sigma"][-1]
        out = {
            **record,
            "delta_v_m_s": jnp.sqrt(jnp.sum(burnt["dv"] ** 2, axis=1)),
            "executed_m_s": burnt["done"],
            "aimed_from_km": burnt["b"][:, :2] / KM,
            "aimed_sigma_km": burnt["b_sigma"][:, :2] / KM,
            "delivery_km": (true_b[:2] - target.aim) / KM,
            "delivery_time_s": true_b[2],
            "passage_error_km": (true_b - b)[:2] / KM,
            "passage_sigma_km": b_sigma[:2] / KM,
            "passage_time_error_s": true_b[2] - b[2],
        }
        if end is not None:
            out |= terminal_tracking(end, terminal, truth, belief, b[2] + left, draws.run)
        return out

    return jax.vmap(one)(draws)


TIME, AXES, PLANE = ("time",), ("time", "axis"), ("target",)
N = {"frame": "N"}


def _v(dims: tuple[str, ...], text: str, units: str, dtype: str = "f8", **more: str) -> Variable:
    return Variable(dims, dtype, {"long_name": text, "units": units, **more})


VARIABLES = {
    "position_error_km": _v(AXES, "relative position, truth less estimate", "km", **N),
    "position_sigma_km": _v(AXES, "1 sigma of it by the filter", "km", "f4", **N),
    "velocity_error_m_s": _v(AXES, "relative velocity, truth less estimate", "m/s", **N),
    "velocity_sigma_m_s": _v(AXES, "1 sigma of it by the filter", "m/s", "f4", **N),
    "ephemeris_error_km": _v(AXES, "body from the Sun, truth less estimate", "km", **N),
    "ephemeris_sigma_km": _v(AXES, "1 sigma of it by the filter", "km", "f4", **N),
    "radiation_error": _v(TIME, "scale of radiation pressure, truth less estimate", "1", "f4"),
    "radiation_sigma": _v(TIME, "1 sigma of it by the filter", "1", "f4"),
    "nees_per_state": _v(TIME, "normalised error squared of relative position and velocity, over 6", "1"),
    "nis": _v(TIME, "normalised innovation squared, 2 degrees of freedom where seen", "1", "f4"),
    "seen": _v(TIME, "whether a frame shows the body and is used", "1", "i1"),
    "delta_v_m_s": _v(("manoeuvre",), "size of the burn that was asked for, 0 for none", "m/s"),
    "executed_m_s": _v(("manoeuvre", "axis"), "what the burn did", "m/s", **N),
    "aimed_from_km": _v(("manoeuvre", "target"), "target plane, estimated before the burn", "km"),
    "aimed_sigma_km": _v(("manoeuvre", "target"), "1 sigma of it by the filter", "km", "f4"),
    "delivery_km": _v(PLANE, "true passage less the aim, target plane", "km"),
    "delivery_time_s": _v((), "true closest approach less the nominal one", "s"),
    "passage_error_km": _v(PLANE, "true passage less the one estimated at the last frame", "km"),
    "passage_sigma_km": _v(PLANE, "1 sigma of it by the filter", "km", "f4"),
    "passage_time_error_s": _v((), "true time of closest approach less the one estimated at the last frame", "s"),
}
"""What is recorded of every run and estimator."""
TERMINAL_VARIABLES = {
    "terminal_error_km": _v(
        ("frame", "axis"), "relative position in the terminal tracking, truth less estimate", "km", **N
    ),
    "terminal_sigma_km": _v(("frame", "axis"), "1 sigma of it by the filter", "km", "f4", **N),
    "terminal_nees_per_state": _v(("frame",), "normalised error squared of the terminal filter's state", "1", "f4"),
    "terminal_step_s": _v((), "between its frames", "s"),
}


def _numbers(**values: Any) -> dict[str, Any]:
    """As NumPy data: nothing is compiled for them."""
    return {k: np.asarray(v, float) for k, v in values.items()}


class Experiment:
    """The scenario ready to run; see `helmstar.scenarios.experiment.Experiment`."""

    def __init__(self, spec: Specification, name: str = "approach"):
        self.spec, self.name, self.title, self.width = spec, name, spec.title, spec.width
        self.timeline = t = timeline(spec)
        self.start_s = 3600.0 * spec.frames.from_h[0]
        self.time = self.start_s - t.before
        self.steps = len(t.dt)
        self.update = np.arange(1, self.steps + 1)
        self.coordinates: dict[str, Any] = {
            "manoeuvre": ("manoeuvre", np.array(spec.manoeuvres.before_h), {"units": "h", "long_name": "before closest approach"}),
            "target": ["B.T", "B.R"],
        }  # fmt: skip
        self.model, self.flight = self._model(), self._flight()
        self.epochs = Epochs(t.dt, t.before, t.frame, t.burn, t.burns)  # NumPy for JAX  # type: ignore[arg-type]
        self.end, self.terminal = None, None
        self.variables = dict(VARIABLES)
        if spec.terminal.filter != "none":
            self.end, self.terminal = Terminal.of(spec.terminal.filter, spec.seed)
            self.variables |= TERMINAL_VARIABLES
            self.coordinates["frame"] = np.arange(1, self.end.frames + 1)
        self.simulate = Call(simulate, (Setting(np.asarray(spec.seed), np.asarray(self.update)),))  # NumPy for JAX  # type: ignore[arg-type]
        self.estimators = {n: self._call(c) for n, c in self._choices().items()}

    def _model(self) -> Model:
        c, p = self.spec.camera, self.spec.probe
        substeps = max(1, int(np.ceil(self.timeline.dt.max() / LONGEST_STEP)))
        walk = p.velocity_walk_mm_s_sqrt_day * 1e-3 / np.sqrt(DAY)
        forces = Forces(**_numbers(mu=MU_SUN, pressure=pressure(self.spec), walk=walk), substeps=substeps)
        f, middle = c.focal_mm * c.px_per_mm, 0.5 * c.size_px
        K = [[f, 0.0, 0.0], [0.0, f, 0.0]]
        return approach_model(forces, Camera(**_numbers(K=K, p0=[middle, middle], sigma=c.sigma_px, q_BN=[0, 0, 0, 1])))

    def _flight(self) -> Flight:
        e, c, m, spec = self.spec.encounter, self.spec.camera, self.spec.manoeuvres, self.spec
        axes = target_axes(np.array(e.velocity_km_s), np.array(e.pole))
        steps = int(np.ceil(max(3600.0 * m.before_h[0], 60.0 * spec.frames.until_min) / LONGEST_STEP))
        y = nominal_start(spec)
        start = Approach(**_numbers(r=y[:3], v=y[3:6], R=y[6:9], V=y[9:], s=[0.0], c=[0.0]))
        execution = Execution(
            **_numbers(
                magnitude=m.magnitude_m_s,
                magnitude_share=m.magnitude_share,
                pointing=m.pointing_m_s,
                pointing_share=np.deg2rad(m.pointing_deg),
            )
        )
        target = Target(**_numbers(axes=axes, aim=axes @ np.array(e.aim_km) * KM), steps=max(1, steps))
        values = _numbers(
            L=start_factor(spec),
            course=spec.probe.off_course_m_s,
            attitude=np.array(c.attitude_arcsec) * ARCSEC,
            least=m.least_m_s,
            half=0.5 * c.size_px,
        )
        return Flight(start=start, target=target, execution=execution, **values)

    def _choices(self) -> dict[str, Choice]:
        def choice(
            frames: bool = True, manoeuvres: bool = True, told: bool = True, ignored: int | None = None
        ) -> Choice:
            known = np.ones(14)
            if ignored is not None:
                known[ignored] = 0.0
            values: Any = (np.asarray(frames), np.asarray(manoeuvres), np.asarray(told, float), known)
            return Choice(*values)

        return {
            "ekf": choice(),
            "ekf_srp_ignored": choice(ignored=12),
            "ekf_execution_ignored": choice(told=False),
            "no_manoeuvres": choice(manoeuvres=False),
            "no_frames": choice(frames=False),
        }

    def _call(self, choice: Choice) -> Call:
        return Call(estimate, (self.model, self.flight, choice, self.epochs, self.terminal), {"end": self.end})

    @cached_property
    def bound(self) -> np.ndarray:
        """Cramer-Rao covariances (epochs, 14, 14) along the orbit to the aim, where no manoeuvre is needed and none errs."""
        F, H, _ = linearised(self.model, self.flight, self.epochs)
        forces = self.model.process.params
        Q = np.zeros((self.steps, 14, 14))
        Q[:, :6, :6] = np.asarray(
            jax.vmap(lambda dt: self.model.process.noise.cov(forces, None, None, dt))(self.timeline.dt)
        )
        camera = self.model.sensors[0].params
        R = camera.sigma**2 * np.eye(2) + np.asarray(attitude_cov(camera, jnp.asarray(self.flight.attitude)))
        information = np.swapaxes(H, 1, 2) @ np.linalg.inv(R) @ H * self.timeline.frame[:, None, None]
        # In units of the prior, where the numbers are of one size.
        L = np.asarray(self.flight.L)
        d = np.sqrt(np.sum(L**2, axis=1))
        d = np.where(d > 0.0, d, 1.0)
        F, Q, information = F * d / d[:, None], Q / np.outer(d, d), information * np.outer(d, d)
        return recursive_bound(F, Q, information, L @ L.T / np.outer(d, d)) * np.outer(d, d)

    def fixed(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
        """The bound, and how long before closest approach."""
        sigma = np.sqrt(np.diagonal(self.bound, axis1=1, axis2=2))
        text = {"long_name": "Cramer-Rao bound, 1 sigma", "frame": "N"}
        t = self.timeline
        return {
            "before_h": (TIME, t.before / 3600.0, {"long_name": "before the nominal closest approach", "units": "h"}),
            "has_frame": (TIME, t.frame.astype("i1"), {"long_name": "whether there is a frame", "units": "1"}),
            "bound_km": (AXES, sigma[:, :3] / KM, {**text, "units": "km"}),
            "bound_m_s": (AXES, sigma[:, 3:6], {**text, "units": "m/s"}),
        }

    def attributes(self) -> dict[str, Any]:
        """Of the dataset: what the report must know."""
        target = np.asarray(self.flight.target.aim) / KM
        return {
            "experiment": "approach",
            "pooled_text": "all runs",
            "aim_km": json.dumps([float(v) for v in target]),
            "ephemeris_km": json.dumps(self.spec.ephemeris.position_km),
            "terminal_filter": self.spec.terminal.filter,
            "frames": json.dumps(self.spec.frames.model_dump()),
        }

    def summarise(self, dataset: Any) -> dict[str, dict]:
        """The metrics of `helmstar run approach --json`."""
        from .approach_results import summarise

        return summarise(dataset)

    def claims(self, dataset: Any, summary: dict) -> list:
        """What the paper says of the approach, judged by what is found here."""
        from .approach_results import claims

        return claims(self.spec, dataset, summary)


def target_axes(velocity: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """T and R (2, 3) of the target plane across `velocity` (3,)."""
    S = velocity / np.linalg.norm(velocity)
    T = np.cross(S, pole)
    T = T / np.linalg.norm(T)
    return np.stack([T, np.cross(S, T)])
