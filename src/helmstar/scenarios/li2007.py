"""The experiment of Li, Cui and Cui (2007), assembled: truth, camera, and every filter of the family by name.

Frame k = 1.. is taken at t = k step_s, after the k-th step of the motion. Estimators start from the same position of the run and
from the attitude reference; those with particles draw from the run's own key, so that no run depends on its neighbours.
"""

from __future__ import annotations

import json
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from ..backend import jax, jnp
from ..core import Gaussian, Measurement, Model, no_gate, pytree
from ..errors import ConfigurationError
from ..evaluate import recursive_bound
from ..filters import (
    BootstrapFilter,
    ErrorStateKalmanFilter,
    MixtureFilter,
    Spread,
    UnscentedBelief,
    UnscentedKalmanFilter,
    UnscentedParticleFilter,
    grid_split,
    kappa_form,
    kernel_split,
    map_estimates,
    mixture_moments,
    moments,
    particle_moments,
    run,
    scaled,
    start_particles,
    start_unscented_particles,
)
from ..geometry import small
from ..models.relative import (
    SHAPE,
    Camera,
    Motion,
    PositionPointing,
    PositionPointingOffset,
    PositionVelocity,
    PositionVelocityPointing,
    Sight,
    relative_model,
)
from .experiment import Call, Variable
from .li2007_data import FILTER, Data, Pictures, Setting, key_of, simulate, simulate_from_images
from .li2007_specification import Specification

Array = jax.Array
KM = 1e3
COLLAPSED = 1e-6
"""Share of the prior's sigma that NEES takes as the least: particles that are all one point have no covariance, and a NEES
without a value would hide what a huge one shows."""


@pytree
class Prior:
    """P0 of the estimator's state, its attitude reference and velocity, the seed, spread (of a UKF), kernel (of upf)."""

    P0: Array
    q_ref: Array
    velocity: Array
    along: Array
    seed: Array
    spread: Spread
    kernel: Array


def _start_state(state: type, prior: Prior, position: Array) -> Any:
    values = {"r": position, "v": prior.velocity, "q": prior.q_ref, "s": jnp.zeros(1)}
    return state(**{name: values[name] for name in state.__dataclass_fields__})


def _true_states(state: type, data: Data) -> Any:
    steps = data.r.shape[0]
    values = {"r": data.r, "v": jnp.broadcast_to(data.v, (steps, 3)), "q": data.q, "s": jnp.zeros((steps, 1))}
    return state(**{name: values[name] for name in state.__dataclass_fields__})


def _begin(kind: str, n: int, filter: Any, model: Model, prior: Prior, mean: Any, key: Array) -> Any:
    """The belief that a kind of filter starts from."""
    r = model.retraction
    start = Gaussian(mean, prior.P0)
    if kind == "gaussian":
        return start
    if kind == "particles":
        return start_particles(r, start, n, key)
    unscented = UnscentedBelief(mean, prior.P0, prior.spread)
    if kind == "unscented":
        return unscented
    if kind == "literal":
        return start_unscented_particles(r, unscented, n, key, model.process, jnp.zeros(()))
    along = prior.along[:, None]
    if kind == "grid":
        return grid_split(r, start, n, key, prior.along)
    if kind == "points":
        return kernel_split(r, start, n, key, along, 0.0)
    return kernel_split(r, unscented, n, key, along, prior.kernel)


def _moments(kind: str, retraction: Any, belief: Any) -> Gaussian:
    if kind in ("gaussian", "unscented"):
        return belief
    if kind == "particles":
        return moments(retraction, belief)
    return particle_moments(retraction, belief) if kind == "literal" else mixture_moments(retraction, belief)


@partial(jax.jit, static_argnames=("filter", "kind", "n", "state", "corrected"))
def estimate(
    model: Model,
    prior: Prior,
    dt: Array,
    data: Data,
    *,
    filter: Any,
    kind: str,
    n: int,
    state: type,
    corrected: bool = True,
) -> dict[str, Array]:
    """Track of one estimator over all runs of `data`. kind: what its belief is; n: particles or components, or for "batch"
    iterations; corrected: whether the centre of light is known not to be the centre of figure."""
    r = model.retraction
    steps = data.z.shape[1]

    def one(data: Data) -> dict[str, Array]:
        mean = _start_state(state, prior, data.start)
        sight = Sight(data.R_CB, data.offset if corrected else jnp.zeros_like(data.offset), data.cov)
        m = (Measurement(data.z, sight, data.seen[:, None]),)
        u, dts = data.walk, jnp.full(steps, dt)
        if kind == "batch":
            found = map_estimates(model, Gaussian(mean, prior.P0), u, dts, m, n)
            nan = jnp.full(steps, jnp.nan)
            nis, dof, status, effective = nan, jnp.zeros(steps, int), jnp.ones(steps, int), nan
        else:
            belief = _begin(kind, n, filter, model, prior, mean, key_of(prior.seed, data.run, 0, FILTER))

            def keep(belief: Any, predicted: Any, infos: Any) -> tuple:
                effective = getattr(belief, "effective", jnp.asarray(jnp.nan))
                i = infos[0]
                return _moments(kind, r, belief), i.nis, i.dof, i.status, effective

            _, _, (found, nis, dof, status, effective) = run(filter, model, belief, u, dts, m, no_gate(8), keep=keep)
        truth = _true_states(state, data)
        # The offset's error has no true value where the law is not the one assumed: what is scored is what has one.
        scored = r.dim - 1 if state is PositionPointingOffset else r.dim
        e = jax.vmap(r.boxminus)(truth, found.mean)[:, :scored]
        cov = found.cov[:, :scored, :scored]
        floor = jnp.diag(jnp.diagonal(prior.P0)[:scored] * COLLAPSED**2)
        white = jax.vmap(lambda P, e: small.matvec(small.invert_lower(small.cholesky(P + floor)), e))(cov, e)
        sigma = jnp.sqrt(jnp.diagonal(cov, axis1=1, axis2=2))
        return {
            "position_error_km": e[:, :3] / KM,
            "position_sigma_km": sigma[:, :3] / KM,
            "nees_per_state": jnp.sum(white**2, axis=1) / scored,
            "nis": nis,
            "nis_dof": dof,
            "status": status,
            "effective": effective,
        }

    return jax.vmap(one)(data)


TIME = ("time",)
VARIABLES = {
    "position_error_km": Variable(
        ("time", "axis"), "f8", {"long_name": "relative position, truth less estimate", "units": "km", "frame": "N"}
    ),
    "position_sigma_km": Variable(
        ("time", "axis"), "f4", {"long_name": "1 sigma of it by the filter", "units": "km", "frame": "N"}
    ),
    "nees_per_state": Variable(
        TIME,
        "f8",
        {"long_name": "normalised error squared of the filter's whole state, over its dimension", "units": "1"},
    ),
    "nis": Variable(TIME, "f4", {"long_name": "normalised innovation squared", "units": "1"}),
    "nis_dof": Variable(TIME, "i2", {"long_name": "degrees of freedom of nis", "units": "1"}),
    "status": Variable(TIME, "i1", {"long_name": "status of the update, codes of helmstar.core", "units": "1"}),
    "effective": Variable(TIME, "f4", {"long_name": "effective number of particles after the update", "units": "1"}),
}
"""What is recorded of every run, update and estimator."""


class Experiment:
    """The scenario ready to run; see `helmstar.scenarios.experiment.Experiment`."""

    variables = VARIABLES
    coordinates: ClassVar[dict[str, Any]] = {}

    def __init__(self, spec: Specification, name: str = "li2007", workers: int = 1):
        self.spec = spec
        self.name = name
        self.title = spec.title
        self.width = spec.width
        self.update = np.arange(1, spec.updates + 1)
        self.time = self.update * spec.step_s
        self.steps = spec.updates
        t, c, p = spec.truth, spec.camera, spec.prior
        self.r0, self.v = np.array(t.position_km) * KM, np.array(t.velocity_km_s) * KM
        self.sigma_r = t.noise_km * KM
        self.mean_r = np.sqrt(SHAPE) * self.sigma_r if t.noise == "gamma" else 0.0
        self.sigma_q = np.deg2rad(spec.attitude.random_walk_deg_sqrt_h) / 60.0
        self.P0 = np.concatenate([np.array(p.position_km) * KM, np.full(3, np.deg2rad(p.pointing_deg))]) ** 2
        self.velocity_variance = np.full(3, (p.velocity_km_s * KM) ** 2)
        self.q_ref = reference_attitude(spec.attitude.angles_rad)
        K = np.array([[c.focal_px, 0.0, c.cross_px[0]], [0.0, c.focal_px, c.cross_px[1]]])
        middle = np.full(2, 0.5 * c.size_px)
        self.camera = Camera(*_numbers(K, middle, c.sigma_px, self.q_ref))
        fixed = spec.start == "fixed"
        sigma_0 = np.array(p.position_km) * KM
        values = {
            "r0": self.r0,
            "v": self.v,
            "sigma_v": t.velocity_sigma_km_s * KM,
            "sigma_r": self.sigma_r,
            "sigma_q": self.sigma_q * np.sqrt(spec.step_s),
            "dt": spec.step_s,
            "q_ref": self.q_ref,
            "error_q": np.deg2rad(spec.attitude.error_deg),
            "offset": sigma_0 if fixed else 0.0 * sigma_0,
            "sigma_0": 0.0 * sigma_0 if fixed else sigma_0,
            "half": 0.5 * c.size_px,
            "seed": spec.seed,
        }
        arrays: dict[str, Any] = {k: np.asarray(v) for k, v in values.items()}
        setting = Setting(camera=self.camera, steps=spec.updates, gamma=t.noise == "gamma", **arrays)
        self.simulate = Call(simulate, (setting,))
        self.from_images = spec.camera.level == "image"
        if self.from_images:
            self.simulate = Call(simulate_from_images, (setting, self._pictures(setting, workers)))
        _ = self.bound  # so that numbers without an answer are refused before anything runs
        self.estimators = self._estimators()

    def _pictures(self, setting: Setting, workers: int) -> Pictures:
        """What the frames of all runs show; the runs that pad the last block have theirs too."""
        from scipy.spatial.transform import Rotation

        from .li2007_frames import take_frames

        runs = -(-self.spec.runs // self.width) * self.width
        data = simulate(setting, jnp.arange(runs))
        r, q, R_CB = (np.asarray(a) for a in (data.r, data.q, data.R_CB))
        sun = np.asarray(self.spec.sun.direction)
        true = np.einsum("...ij,...j->...i", R_CB, Rotation.from_quat(q.reshape(-1, 4)).apply(sun).reshape(r.shape))
        known = R_CB @ Rotation.from_quat(self.q_ref).apply(sun)
        lights = take_frames(self.spec, np.asarray(data.z), np.linalg.norm(r, axis=-1), true, known, workers)
        change = phase_changes(lights.phase, lights.seen)
        values: Any = (lights.z, lights.cov, lights.offset, self.spec.body.offset_walk_rad * change, lights.seen)
        return Pictures(*values)

    def _estimators(self) -> dict[str, Call]:
        t = self.spec.tuning
        along = self.v / np.linalg.norm(self.v)
        mean = self.mean_r if self.spec.truth.mean_known else 0.0
        motion = Motion(*_numbers(self.v, self.sigma_r, mean, self.sigma_q))

        usual_state: type = PositionPointingOffset if self.from_images else PositionPointing

        def call(
            kind: str, filter: Any, n: int, spread: Spread, state: type = usual_state, corrected: bool = True
        ) -> Call:
            doubt = np.array([self.spec.body.offset_sigma**2])
            variances = {"r": self.P0[:3], "v": self.velocity_variance, "q": self.P0[3:], "s": doubt}
            P0 = np.diag(np.concatenate([variances[name] for name in state.__dataclass_fields__]))
            direction = np.concatenate([along, np.zeros(len(P0) - 3)])
            values = _numbers(P0, self.q_ref, self.v, direction, self.spec.seed)
            prior = Prior(*values, spread=spread, kernel=_numbers(t.kernel)[0])
            model = relative_model(motion, self.camera, state, self.spec.truth.noise == "gamma")
            static = {"filter": filter, "kind": kind, "n": n, "state": state, "corrected": corrected}
            return Call(estimate, (model, prior, _numbers(self.spec.step_s)[0]), static)

        def ekf(state: type = usual_state) -> Any:
            return ErrorStateKalmanFilter(relative_model(motion, self.camera, state).retraction)

        r = ekf().retraction
        usual, printed = scaled(t.ukf_alpha, t.ukf_beta, t.ukf_kappa), kappa_form(-3.0)
        narrow = UnscentedKalmanFilter(r, prediction="linear")
        points, kernels = t.particles, t.unscented_particles
        main = int(np.argmax(np.abs(self.v)))  # the axis that is nearest to the track: the one that is not linear
        out = {
            "ekf": call("gaussian", ekf(), 0, usual),
            "ukf": call("unscented", UnscentedKalmanFilter(r), 0, usual),
            "ukf_printed": call("unscented", UnscentedKalmanFilter(r), 0, printed),
            "pf": call("particles", BootstrapFilter(r), points, usual),
            "rpf": call("particles", BootstrapFilter(r, regularised=True), points, usual),
            "upf_printed": call("literal", UnscentedParticleFilter(r), kernels, printed),
            "upf": call("kernels", MixtureFilter(narrow, importance=True, threshold=0.1, least=2.0), kernels, usual),
            "rbpf": call("points", MixtureFilter(ekf(), sampled=(main,), threshold=0.5, least=2.0), kernels, usual),
            "gsf": call("grid", MixtureFilter(ekf()), t.components, usual),
            "batch": call("batch", None, t.batch_iterations, usual),
            "ekf_position_velocity": call("gaussian", ekf(PositionVelocity), 0, usual, PositionVelocity),
            "ekf_position_velocity_pointing": call(
                "gaussian", ekf(PositionVelocityPointing), 0, usual, PositionVelocityPointing
            ),
        }
        if self.from_images:
            plain = ekf(PositionPointing)
            out["ekf_trusting"] = call("gaussian", plain, 0, usual, PositionPointing)
            out["ekf_uncorrected"] = call("gaussian", plain, 0, usual, PositionPointing, corrected=False)
            # The transition of the literal filter has a density that the offset's walk does not always have.
            del out["upf_printed"]
        return out

    @cached_property
    def bound(self) -> np.ndarray:
        """Cramer-Rao covariances (updates, 6, 6) of position (m) and pointing (rad) along the straight line r0 + v t.

        The runs' own lines end some 2 km beside it, by the noise's mean, which moves the bound by 4% at most, in x at the end."""
        dt = self.spec.step_s
        r = self._line()
        rho = np.linalg.norm(r, axis=1)[:, None, None]
        u = -r / rho[:, :, 0]
        across = np.eye(3) - u[:, :, None] * u[:, None, :]
        # A round pixel noise makes the camera's turn about its axis irrelevant: directions, not pixels, are enough.
        turn = np.cross(u[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)  # u x theta
        H = np.concatenate([-across / rho, -turn], axis=2)
        weight = (self.spec.camera.focal_px / self.spec.camera.sigma_px) ** 2
        Q = np.diag(np.repeat([self.sigma_r**2, self.sigma_q**2 * dt], 3))
        try:
            return recursive_bound(np.eye(6), Q, weight * H.transpose(0, 2, 1) @ H, np.diag(self.P0))
        except np.linalg.LinAlgError:
            raise ConfigurationError(
                "truth.noise_km, prior or camera: what the frames tell and what is known before differ by more than numbers "
                "have digits; bring truth.noise_km, prior.position_km, camera.focal_mm or camera.sigma_px nearer to their defaults"
            ) from None

    def _line(self) -> np.ndarray:
        """r0 + v t (updates, 3), m."""
        return self.r0 + self.update[:, None] * self.v * self.spec.step_s

    def fixed(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
        """The bound, and the line it is taken along."""
        sigma = np.sqrt(np.diagonal(self.bound, axis1=1, axis2=2))
        return {
            "bound_km": (
                ("time", "axis"), sigma[:, :3] / KM, {"long_name": "Cramer-Rao bound, 1 sigma", "units": "km", "frame": "N"},
            ),
            "bound_pointing_deg": (
                ("time", "axis"), np.degrees(sigma[:, 3:]),
                {"long_name": "Cramer-Rao bound, 1 sigma", "units": "deg", "frame": "N"},
            ),
            "line_km": (("time", "axis"), self._line() / KM, {"long_name": "r0 + v t", "units": "km", "frame": "N"}),
        }  # fmt: skip

    def attributes(self) -> dict[str, Any]:
        """Of the dataset: what the report must know."""
        return {
            "experiment": "li2007",
            "pooled_text": "all runs and updates",
            "start": self.spec.start,
            "references": json.dumps({n: "ekf" if n == "gsf" else "gsf" for n in self.estimators}),
        }

    def summarise(self, dataset: Any) -> dict[str, dict]:
        """The metrics of `helmstar run li2007 --json`."""
        from .li2007_results import summarise

        return summarise(dataset)

    def claims(self, dataset: Any, summary: dict) -> list:
        """The paper's claims, judged where this is the paper's experiment."""
        from .li2007_results import claims

        return claims(self.spec, dataset, summary)


def phase_changes(phase: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Change of phase (runs, steps), rad, of each frame since the last that was seen; 0 for the first and for those not seen."""
    last = np.maximum.accumulate(np.where(seen, np.arange(phase.shape[1]), -1), axis=1)
    before = np.concatenate([np.full((len(phase), 1), -1), last[:, :-1]], axis=1)
    change = np.abs(phase - np.take_along_axis(phase, np.maximum(before, 0), axis=1))
    return np.where(seen & (before >= 0), change, 0.0)


def _numbers(*values: Any) -> tuple[Any, ...]:
    """As NumPy data: nothing is compiled for them."""
    return tuple(np.asarray(v, float) if not isinstance(v, int) else np.asarray(v) for v in values)


def reference_attitude(angles_rad: list[float]) -> np.ndarray:
    """q_BN (4,) of (7): R_BN = R_z(phi) R_y(delta) R_x(lambda), passive turns about the body's axes in that order."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("XYZ", angles_rad).inv().as_quat()
