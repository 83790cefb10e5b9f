"""The experiment of Xu, Pei and Jiang (2020), assembled: truth, sensors and every estimator by name.

Update k = 1.. is the k-th star measurement; errors are taken after it. One more star measurement at t = 0 is used by the
`_tuned` estimators alone, for the Wahba fix they start from; the bound knows it too.
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ..attitude import quaternion_of_matrix, svd
from ..backend import jax, jnp
from ..core import Gaussian, Measurement, Model, Sensor, no_gate, pytree
from ..evaluate import recursive_bound
from ..filters import (
    ErrorStateKalmanFilter,
    Spread,
    StaticSolver,
    UnscentedBelief,
    UnscentedKalmanFilter,
    run,
    scaled,
)
from ..filters.static import turn_covariance
from ..geometry import quaternion, small, so3, so3_left, so3_right
from ..geometry.retraction import Retraction, gibbs_left, quaternion_additive
from ..models import rigid_body, xu2020
from ..models.sensors import tangent_basis, unit_star_directions
from ..units import ARCSEC
from .experiment import Call, Variable
from .xu2020_results import WINDOW
from .xu2020_specification import Specification

Array = jax.Array
SIGMA_FLOOR = 1e-10
"""Smallest sigma (rad) that a tuned filter is told: a noiseless sensor would make its covariance singular."""


@pytree
class Setting:
    """Data of the simulation: truth attitudes (steps + 1, 4), increments (steps, 3) rad, star directions (2, 3) in N,
    sigmas in rad, start error in rad (negative: X0 = I), seed."""

    q: Array
    increment: Array
    r_N: Array
    star_sigma: Array
    gyro_sigma: Array
    start_error: Array
    seed: Array


@pytree
class Data:
    """Of one run: increments u (steps, 3), stars z (steps, 2, 3), start attitude, Wahba fix at t = 0 and its covariance in
    B, and the truth q (steps, 4) and r_N that every run shares. Of stars from images also their covariance (steps, 2, 3, 3) and
    whether they are seen (steps, 2)."""

    u: Array
    z: Array
    start: Array
    fix: Array
    fix_cov: Array
    q: Array
    r_N: Array
    z_cov: Array | None = None
    seen: Array | None = None


# Purposes of the random streams. A key is folded with run, then step, then purpose; a filter that draws numbers takes its
# own purpose from FILTER on, so that adding one leaves the truth as it is.
GYRO, STARS, START, FILTER = 0, 1, 2, 1000


def _simulate_run(s: Setting, run_id: Array) -> Data:
    key = jax.random.fold_in(jax.random.key(s.seed), run_id)
    steps = s.increment.shape[0]

    def draw(step: Array, purpose: Array) -> Array:
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, step), purpose), (6,))

    # One traced draw for all purposes: a random generator is slow to compile.
    purposes = jnp.array([GYRO, STARS, START])
    w = jax.vmap(lambda k: jax.vmap(lambda p: draw(k, p))(purposes))(jnp.arange(steps + 1))
    gyro, stars, axis = w[:, 0, :3], w[:, 1].reshape(-1, 2, 3), w[0, 2, :3]
    true_z = jax.vmap(lambda q: s.r_N @ quaternion.to_matrix(q).T)(s.q)
    z = true_z + s.star_sigma * stars
    axis = axis / jnp.sqrt(jnp.sum(axis**2))
    off = quaternion.multiply(s.q[0], quaternion.exp(s.start_error * axis))
    start = jnp.where(s.start_error >= 0, off, quaternion.identity())
    fix = svd(z[0], s.r_N, jnp.maximum(s.star_sigma, SIGMA_FLOOR))
    return Data(s.increment + s.gyro_sigma * gyro[1:], z[1:], start, fix.q_BN, fix.covariance, s.q[1:], s.r_N)


_SHARED = Data(0, 0, 0, 0, 0, None, None, 0, 0)  # which fields of Data have a run axis  # type: ignore[arg-type]


@jax.jit
def simulate(setting: Setting, run_ids: Array) -> Data:
    """Data of the runs with these numbers; truth is the same for all and has no run axis."""
    return jax.vmap(partial(_simulate_run, setting), out_axes=_SHARED)(run_ids)


def _told_predict(params: Any, x: Any, a: tuple[Array, Array]) -> Array:
    return a[0] @ quaternion.to_matrix(x).T


def _told_minus(z: Array, z_hat: Array) -> Array:
    return jnp.einsum("nij,ni->nj", tangent_basis(z_hat), z - z_hat).reshape(-1)


def _told_cov(params: Any, x: Any, a: tuple[Array, Array]) -> Array:
    T = tangent_basis(_told_predict(params, x, a))
    C = jnp.einsum("nij,nik,nkl->njl", T, a[1], T) + SIGMA_FLOOR**2 * jnp.eye(2, dtype=T.dtype)
    o = jnp.zeros((2, 2), T.dtype)
    return small.blocks([[C[0], o], [o, C[1]]])


def measured_directions(retraction: Retraction) -> Sensor:
    """Two measured directions of unit length, each with a covariance of its own as context (r_N (2, 3), C (2, 3, 3) in B): two
    residuals for each, across it."""

    def jacobian(params: Any, x: Any, a: tuple[Array, Array]) -> Array:
        return unit_star_directions(1.0, retraction).jacobian(params, x, a[0])  # not called without  # type: ignore[misc]

    known = unit_star_directions(1.0, retraction).jacobian is not None
    return Sensor(_told_predict, _told_minus, _told_cov, None, jacobian if known else None)


@pytree
class Pictures:
    """What frames of stars say, of all runs: z (runs, steps + 1, 2, 3), cov (.., 2, 3, 3) rad^2, seen (.., 2)."""

    z: Array
    cov: Array
    seen: Array


@jax.jit
def simulate_from_images(setting: Setting, pictures: Pictures, run_ids: Array) -> Data:
    """As `simulate`, with the stars that the frames show: the gyro and the start are the same to the bit."""

    def one(run_id: Array) -> Data:
        d = _simulate_run(setting, run_id)
        z, cov, seen = pictures.z[run_id], pictures.cov[run_id], pictures.seen[run_id]
        sigma = jnp.sqrt(0.5 * jnp.trace(cov[0], axis1=-2, axis2=-1))
        fix = svd(z[0], setting.r_N, jnp.maximum(sigma, SIGMA_FLOOR))
        return Data(d.u, z[1:], d.start, fix.q_BN, fix.covariance, d.q, d.r_N, cov[1:], seen[1:])

    return jax.vmap(one, out_axes=_SHARED)(run_ids)


@pytree
class Prior:
    """Covariance P0 at the start attitude, or (from_fix) the Wahba fix with its own covariance; `spread` for a UKF."""

    P0: Array
    from_fix: Array
    spread: Spread | None = None


def error_in_N(retraction: Retraction, truth: Array, belief: Any) -> tuple[Array, Array, Array]:
    """Error xi of X = X_hat exp(xi) (rad in N), its sigma per axis, and NEES by the filter's own retraction.

    The additive quaternion's four numbers are projected to three: xi = 2 Xi(q)^T dq.
    """
    q, P = belief.mean, belief.cov
    xi = so3_right.boxminus(truth, q)
    if retraction is quaternion_additive:
        G = 2.0 * quaternion.rate_matrix(q).T
        P = G @ P @ G.T
        own, P_N = xi, P
    else:
        own = retraction.boxminus(truth, q)
        R = quaternion.to_matrix(q)
        P_N = P if retraction is so3_right else R.T @ P @ R
    # Solved without a LAPACK call; a covariance that is not positive gives NaN, which is what is recorded.
    white = small.matvec(small.invert_lower(small.cholesky(P)), own)
    return xi, jnp.sqrt(jnp.diagonal(P_N)), jnp.sum(white**2)


@partial(jax.jit, static_argnames=("filter", "measured"))
def estimate(
    model: Model, prior: Prior, stars: Array, data: Data, *, filter: Any, measured: bool = False
) -> dict[str, Array]:
    """Track of one estimator over all runs of `data`. `stars` (2,) of bool says which stars it sees; `measured`: whether it is
    told the covariance that came with each."""
    retraction = filter.retraction
    steps = data.q.shape[0]

    def one(data: Data) -> dict[str, Array]:
        fix_cov = turn_covariance(data.fix, data.fix_cov, retraction)
        mean = jnp.where(prior.from_fix, data.fix, data.start)
        cov = jnp.where(prior.from_fix, fix_cov, prior.P0)
        belief: Any = Gaussian(mean, cov)
        if prior.spread is not None:
            belief = UnscentedBelief(mean, cov, prior.spread)
        context: Any = jnp.broadcast_to(data.r_N, (steps, 2, 3))
        if measured:
            context = (context, data.z_cov)
        there = jnp.broadcast_to(stars, (steps, 2))
        m = Measurement(data.z, context, there if data.seen is None else there & data.seen)

        def keep(belief, predicted, infos):
            return belief, infos[0].nis, infos[0].dof

        _, _, (beliefs, nis, dof) = run(filter, model, belief, data.u, jnp.ones(steps), (m,), no_gate(8), keep=keep)
        xi, sigma, nees = jax.vmap(partial(error_in_N, retraction))(data.q, beliefs)
        return {"error_rad": xi, "sigma_rad": sigma, "nees": nees, "nis": nis, "nis_dof": dof}

    return jax.vmap(one, in_axes=(_SHARED,))(data)


VARIABLES = {
    "error_rad": Variable(
        ("time", "axis"),
        "f8",
        {"long_name": "error xi, X = X_hat exp([xi x])", "units": "rad", "frame": "N", "side": "right"},
    ),
    "sigma_rad": Variable(
        ("time", "axis"), "f4", {"long_name": "1 sigma of the error by the filter", "units": "rad", "frame": "N"}
    ),
    "nees": Variable(
        ("time",), "f4", {"long_name": "normalised estimation error squared, 3 degrees of freedom", "units": "1"}
    ),
    "nis": Variable(("time",), "f4", {"long_name": "normalised innovation squared", "units": "1"}),
    "nis_dof": Variable(("time",), "i2", {"long_name": "degrees of freedom of nis", "units": "1"}),
}
"""What is recorded of every run, update and estimator."""


class Experiment:
    """The scenario ready to run; see `helmstar.scenarios.experiment.Experiment`."""

    variables = VARIABLES
    coordinates: ClassVar[dict[str, Any]] = {}

    def __init__(self, spec: Specification, name: str = "xu2020", workers: int = 1):
        self.spec = spec
        self.name = name
        self.title = spec.title
        self.width = spec.width
        self.update = np.arange(1, spec.updates + 1)
        self.time = self.update * spec.step_s
        self.steps = spec.updates
        self.star_sigma = spec.star.sigma_arcsec * ARCSEC
        self.gyro_sigma = spec.gyro.sigma_rad_step
        self.truth = truth_of(spec)
        error = spec.start.error_deg
        data: dict[str, Any] = {
            "q": self.truth.q,
            "increment": self.truth.increment,
            "r_N": np.asarray(spec.star.directions, dtype=float),
            "star_sigma": np.asarray(self.star_sigma),
            "gyro_sigma": np.asarray(self.gyro_sigma),
            "start_error": np.asarray(-1.0 if error is None else np.deg2rad(error)),
            "seed": np.asarray(spec.seed),
        }
        self.simulate = Call(simulate, (Setting(**data),))
        self.pictures = self._pictures(workers) if spec.star.level == "image" else None
        if self.pictures is not None:
            self.star_sigma = self.pictures.sigma
            arrays = Pictures(self.pictures.z, self.pictures.cov, self.pictures.seen)  # NumPy for JAX  # type: ignore[arg-type]
            self.simulate = Call(simulate_from_images, (Setting(**data), arrays))
        self.estimators = self._estimators()

    def _pictures(self, workers: int) -> Any:
        """Frames of every run that will be computed, solved."""
        from .xu2020_images import take_frames

        s = self.spec
        runs = -(-s.runs // s.width) * s.width
        return take_frames(s.star.image, s.seed, runs, s.step_s, self.truth.q, np.array(s.star.directions), workers)

    def _estimators(self) -> dict[str, Call]:
        t = self.spec.tuning
        both, one = np.array([True, True]), np.array([True, False])  # NumPy: nothing is compiled for them
        sigma = max(self.star_sigma, SIGMA_FLOOR)
        q = self.gyro_sigma**2
        spread = scaled(t.ukf_alpha, t.ukf_beta, t.ukf_kappa)
        from_images = self.pictures is not None

        def call(filter: Any, model: Model, stars: Any, P0: Any, spread: Spread | None = None, fix: bool = False):
            from_fix: Any = np.asarray(fix)
            prior = Prior(P0, from_fix, spread)
            static = {"filter": filter}
            if from_images and fix and not isinstance(filter, StaticSolver):
                told = measured_directions(model.retraction)
                model = Model(model.retraction, model.process, (told,))
                static["measured"] = True
            return Call(estimate, (model, prior, stars), static)

        right, left = ErrorStateKalmanFilter(so3_right), ErrorStateKalmanFilter(so3_left)
        gibbs, additive = ErrorStateKalmanFilter(gibbs_left), ErrorStateKalmanFilter(quaternion_additive)
        P3, P4 = t.p0 * np.eye(3), t.quaternion_p0 * np.eye(4)

        def lie(retraction: Retraction, tuned: bool) -> Model:
            return xu2020.lie_model(*((q, sigma) if tuned else (t.q_w, t.sigma_v)), retraction)

        def quat(tuned: bool) -> Model:
            return xu2020.quaternion_model(*((0.25 * q, sigma) if tuned else (t.quaternion_q, t.quaternion_sigma_v)))

        out = {"lie_printed": call(right, xu2020.printed_model(t.q_w, t.sigma_v), both, P3)}
        for tuned in (False, True):
            end = "_tuned" if tuned else ""
            out["lie" + end] = call(right, lie(so3_right, tuned), both, P3, fix=tuned)
            out["lie_left" + end] = call(left, lie(so3_left, tuned), both, P3, fix=tuned)
            out["mekf" + end] = call(gibbs, lie(gibbs_left, tuned), both, P3, fix=tuned)
            out["quaternion_ekf" + end] = call(additive, quat(tuned), both, P4, fix=tuned)
            out["quaternion_ekf_one_star" + end] = call(additive, quat(tuned), one, P4, fix=tuned)
            out["ukf" + end] = call(
                UnscentedKalmanFilter(so3_right), lie(so3_right, tuned), both, P3, spread=spread, fix=tuned
            )
            out["static_svd" + end] = call(StaticSolver(), lie(so3_left, tuned), both, P3, fix=tuned)
        return out

    def bound(self) -> np.ndarray:
        """Cramer-Rao covariance (updates, 3, 3) of xi in N, rad^2, from the fix at t = 0 on; NaN without star noise."""
        if self.star_sigma == 0.0:
            return np.full((len(self.time), 3, 3), np.nan)
        if self.pictures is not None:
            J = self._information()
            first, J = J[0], J[1:]
        else:
            r = np.array(self.spec.star.directions)
            first = J = (2.0 * np.eye(3) - r.T @ r) / self.star_sigma**2
        A = np.asarray(so3.exp(-self.truth.increment))
        return recursive_bound(A, self.gyro_sigma**2 * np.eye(3), J, np.linalg.inv(first))

    def _information(self) -> np.ndarray:
        """Of the frames at each instant from 0 (steps + 1, 3, 3), on xi in N: the mean over the runs of what each head's
        covariance across its direction leaves, [r x] C_N^+ [r x]^T."""
        assert self.pictures is not None
        R = np.asarray(quaternion.to_matrix(self.truth.q))
        out = np.zeros((len(R), 3, 3))
        for head, r in enumerate(np.array(self.spec.star.directions)):
            C = np.einsum("kji,rkjl,klm->rkim", R, self.pictures.cov[:, :, head], R)
            across = np.linalg.pinv(C, rcond=1e-6, hermitian=True)
            seen = self.pictures.seen[:, :, head, None, None]
            K = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
            out += np.mean(np.where(seen, K @ across @ K.T, 0.0), axis=0)
        return out

    def fixed(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
        """Truth and bound."""
        sigma = np.sqrt(np.diagonal(self.bound(), axis1=1, axis2=2))
        return {
            "truth_q_bn": (
                ("time", "quaternion"),
                self.truth.q[1:],
                {"long_name": "true attitude, l = X r", "units": "1"},
            ),
            "bound_rad": (
                ("time", "axis"),
                sigma,
                {"long_name": "Cramer-Rao bound, 1 sigma", "units": "rad", "frame": "N"},
            ),
        }

    def attributes(self) -> dict[str, Any]:
        """Of the dataset: what the report must know."""
        references = {n: "lie_tuned" if n.endswith("_tuned") else "lie" for n in self.estimators}
        return {
            "experiment": "xu2020",
            "nees_dof": 3,
            "pooled_text": f"updates {WINDOW[0]} to {WINDOW[1]}",
            "pooled_updates": list(WINDOW),
            "references": json.dumps(references),
        }

    def summarise(self, dataset: Any) -> dict[str, dict]:
        """The metrics of `helmstar run xu2020 --json`."""
        from .xu2020_results import summarise

        return summarise(dataset)

    def claims(self, dataset: Any, summary: dict) -> list:
        """The paper's claims, judged where this is the paper's experiment."""
        from .xu2020_results import claims

        return claims(self.spec, dataset, summary)


def truth_of(spec: Specification) -> rigid_body.RigidBodyTruth:
    """True attitudes at t = 0, step, ... by the printed law (8), with the rate of (36) or its solution of (9)."""
    t = spec.truth
    f = np.array(t.rate_frequency_rad_s)
    a = t.rate_amplitude_rad_s

    def rate(s: float) -> np.ndarray:
        return a * np.cos(f * s)

    time = np.arange(spec.updates + 1) * spec.step_s
    q0 = quaternion_of_matrix(np.array(t.attitude, dtype=float))
    if t.rate == "prescribed":
        return rigid_body.simulate(time, q0, "printed", rate=rate)
    J = np.diag(t.inertia_kg_m2)
    torque = rigid_body.torque_of(rate, lambda s: -a * f * np.sin(f * s), J)
    return rigid_body.simulate(time, q0, "printed", inertia=J, torque=torque, rate0=rate(0.0))
