"""The experiment of Zhou, Li and Wu (2021), assembled: orbit, heads, gyro, QUEST in front, and every estimator by name."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from ..core import Gate, Model, chi_square_gate, no_gate
from ..errors import ConfigurationError
from ..filters import (
    AdaptiveFilter,
    ErrorStateKalmanFilter,
    PredictiveFilter,
    ResettingFilter,
    RestartFromStars,
    UnscentedKalmanFilter,
    kappa_form,
)
from ..geometry import mrp_left, so3_left, so3_right
from ..models import zhou2021 as paper
from ..models.attitude import GyroNoise, attitude_drift_model
from ..models.attitude_rate import RateNoise, attitude_rate_model, gyro_rate
from ..models.sensors import unit_star_directions
from ..sensors.gyro import DEG_H, DEG_H_SQRT_H, DEG_SQRT_H
from .experiment import Call, Variable
from .zhou2021_data import Setting, simulate
from .zhou2021_passes import EVERY, WINDOW_S, Bridging, Prior, Shared, estimate, smoothed
from .zhou2021_specification import Specification
from .zhou2021_timeline import build_timeline
from .zhou2021_truth import truth_of


def _number(x: Any) -> Any:
    """As NumPy data: nothing is compiled for it."""
    return np.asarray(x)


RECOVERED_BOUNDS = 5.0
"""A run has not recovered while its error is above what a perfect filter nearly never shows: so many of its sigmas."""
B = "left: truth (x) estimate^-1"
VARIABLES = {
    "error_rad": Variable(
        ("time", "axis"), "f8", {"long_name": "attitude error", "units": "rad", "frame": "B", "side": B}
    ),
    "sigma_rad": Variable(
        ("time", "axis"), "f4", {"long_name": "1 sigma of it by the filter", "units": "rad", "frame": "B"}
    ),
    "drift_error_rad_s": Variable(("time", "axis"), "f8", {"long_name": "drift error", "units": "rad/s", "frame": "B"}),
    "drift_sigma_rad_s": Variable(
        ("time", "axis"), "f4", {"long_name": "1 sigma of it by the filter", "units": "rad/s", "frame": "B"}
    ),
    "nees": Variable(
        ("time",), "f4", {"long_name": "normalised estimation error squared, 6 degrees of freedom", "units": "1"}
    ),
    "nis": Variable(("time",), "f4", {"long_name": "normalised innovation squared", "units": "1"}),
    "nis_dof": Variable(("time",), "i2", {"long_name": "degrees of freedom of nis", "units": "1"}),
    "attitude_mean_square_rad2": Variable(
        ("axis",), "f8", {"long_name": f"mean square attitude error, last {WINDOW_S} s", "units": "rad2", "frame": "B"}
    ),
    "drift_mean_square_rad2_s2": Variable(
        ("axis",), "f8", {"long_name": f"mean square drift error, last {WINDOW_S} s", "units": "rad2/s2", "frame": "B"}
    ),
    "nees_mean": Variable((), "f8", {"long_name": f"mean NEES, last {WINDOW_S} s", "units": "1"}),
    "sign_errors": Variable(
        (), "i4", {"long_name": "updates at which the quaternion's sign is not the truth's", "units": "1"}
    ),
    "resets": Variable((), "i4", {"long_name": "restarts in the main pass", "units": "1"}),
    "outage_peak_rad": Variable(
        ("policy",), "f8", {"long_name": "largest error during and after a gyro loss", "units": "rad"}
    ),
    "outage_angle_rad": Variable(
        ("policy", "second"), "f4", {"long_name": "error from the gyro loss on", "units": "rad"}
    ),
    "star_loss_rad": Variable(
        ("moment",), "f8", {"long_name": "error at begin and end of a star loss, and later", "units": "rad"}
    ),
    "recovery_s": Variable(
        ("case",), "f8", {"long_name": "time until the error is below the limit for good", "units": "s"}
    ),
}
"""What is recorded of every run and estimator."""


class Experiment:
    """The scenario ready to run; see `helmstar.scenarios.experiment.Experiment`."""

    variables = VARIABLES

    def __init__(self, spec: Specification, name: str = "zhou2021"):
        self.spec = spec
        self.name = name
        self.title = spec.title
        self.width = spec.width
        self.truth = truth_of(spec)
        if self.truth.seen[0].sum() < 2:
            raise ConfigurationError(
                f"star.field_deg = {spec.star.field_deg:g}, star.faintest = {spec.star.faintest:g}: the heads see "
                f"{int(self.truth.seen[0].sum())} stars at the start, which needs two; widen the field or take fainter stars"
            )
        self.timeline = build_timeline(spec)
        self.update = np.arange(EVERY, spec.duration_s + 1, EVERY)
        self.time = self.update.astype(float)
        self.steps = self.timeline.steps
        self.star_sigma = spec.star.sigma
        self.sigma_v = spec.gyro.arw_deg_sqrt_h * DEG_SQRT_H
        self.sigma_u = spec.gyro.rrw_deg_h_sqrt_h * DEG_H_SQRT_H
        self.drift_sigma = spec.gyro.initial_drift_sigma_deg_h * DEG_H
        data: dict[str, Any] = {
            "turned": self.truth.turned,
            "b_B": self.truth.b_B,
            "r_N": self.truth.r_N,
            "seen": self.truth.seen,
            "sigma": np.asarray(self.star_sigma),
            "sigma_v": np.asarray(self.sigma_v),
            "sigma_u": np.asarray(self.sigma_u),
            "drift_sigma": np.asarray(self.drift_sigma),
            "seed": np.asarray(spec.seed),
        }
        self.simulate = Call(simulate, (Setting(**data),))
        self.recovered = self._recovery_limit()
        self.estimators = self._estimators()

    @cached_property
    def bound(self) -> np.ndarray:
        """Cramer-Rao covariances (n, 6, 6) of the main pass, with its star loss if it has one."""
        from .zhou2021_results import scenario_bound

        return scenario_bound(self)

    def _recovery_limit(self) -> float:
        """Error angle in rad below which a run has recovered: tuning.recovered_deg, or where a perfect filter is hardly
        better than that RECOVERED_BOUNDS times its steady sigma, of three axes together and without losses."""
        from .zhou2021_results import scenario_bound

        bound = scenario_bound(self, losses=False) if self.timeline.dark[: self.timeline.main].any() else self.bound
        steady = np.sqrt(np.mean(np.trace(bound[-WINDOW_S:, :3, :3], axis1=1, axis2=2)))
        return max(np.deg2rad(self.spec.tuning.recovered_deg), RECOVERED_BOUNDS * float(steady))

    @property
    def coordinates(self) -> dict[str, Any]:
        """Of the dimensions beside run, time, estimator and axis."""
        policies = self.timeline.of("policy")
        return {
            "policy": [b.name for b in policies],
            "second": np.arange(1, (policies[0].count if policies else 0) + 1),
            "moment": ["begin", "end", "later"],
            "case": [b.name for b in self.timeline.of("recovery")],
        }

    def _estimators(self) -> dict[str, Call]:
        t, g, tl = self.spec.tuning, self.spec.gyro, self.timeline
        arrays: dict[str, Any] = {
            k: getattr(tl, k) for k in ("index", "policy", "dark", "begin", "turn", "offset", "save")
        }
        T = self.truth
        shared = Shared(*(_number(v) for v in (T.q, T.turned, T.r_N, T.seen)), **arrays)
        values = (round(g.hold_s), np.deg2rad(g.raised_deg_s), g.command_error, g.loss_start_s)
        bridging = Bridging(*(_number(v) for v in values))
        branches = tuple((b.kind, b.start, b.count) for b in tl.branches)
        rate_sigma = np.deg2rad(t.rate_sigma_deg_s)

        def prior(
            gate: Gate | None = None, isotropic: bool = False, random_sign: bool = False, has_gyro: bool = True
        ) -> Prior:
            values: dict[str, Any] = {
                "drift_sigma": self.drift_sigma,
                "rate_sigma": rate_sigma,
                "gyro_sigma": self.sigma_v,
                "star_sigma": self.star_sigma,
                "wrong": np.deg2rad(t.wrong_start_sigma_deg),
                "isotropic": isotropic,
                "random_sign": random_sign,
                "has_gyro": has_gyro,
                "fresh": (t.reset_drift_sigma_deg_h * DEG_H) ** 2 * np.eye(3),
                "rho": t.adaptive_share,
                "weight": np.repeat([rate_sigma**-2, 1e30], 3),
                "recovered": self.recovered,
            }
            arrays: dict[str, Any] = {k: np.asarray(v) for k, v in values.items()}
            return Prior(gate=gate or no_gate(), spread=kappa_form(1.0), **arrays)

        noise = GyroNoise(*(_number(v) for v in (self.sigma_v, self.sigma_u)))
        rates = RateNoise(*(_number(v) for v in (rate_sigma, self.sigma_u)))
        stars = lambda r: (unit_star_directions(_number(self.star_sigma), r),)
        left, right, mrp = (attitude_drift_model(noise, r, stars(r)) for r in (so3_left, so3_right, mrp_left))
        rated = attitude_rate_model(rates, so3_left, (gyro_rate(), *stars(so3_left)))
        printed = paper.printed_model(noise)
        mekf = ErrorStateKalmanFilter(left.retraction)
        resetting = ResettingFilter(mekf, RestartFromStars(so3_left))
        gate = chi_square_gate(t.reset_probability, reopen_after=t.reset_after)

        def call(model: Model, filter: Any, front: str, p: Prior) -> Call:
            static = {"filter": filter, "front": front, "branches": branches, "main": tl.main}
            return Call(estimate, (model, p, bridging, shared), static)

        quest_ekf = ErrorStateKalmanFilter(printed.retraction, carry="none")
        return {
            "quest_ekf": call(printed, quest_ekf, "quest", prior()),
            "quest_ekf_isotropic": call(printed, quest_ekf, "quest", prior(isotropic=True)),
            "quest_ekf_unsigned": call(printed, quest_ekf, "quest", prior(random_sign=True)),
            "mekf": call(left, mekf, "stars", prior()),
            "mekf_reset": call(left, resetting, "stars", prior(gate)),
            "iekf": call(right, ErrorStateKalmanFilter(right.retraction), "stars", prior()),
            "usque": call(mrp, UnscentedKalmanFilter(mrp.retraction), "stars", prior()),
            "mekf_adaptive": call(left, AdaptiveFilter(mekf), "stars", prior()),
            "mekf_rate_state": call(rated, ErrorStateKalmanFilter(rated.retraction), "rate", prior()),
            "predictive": call(rated, PredictiveFilter(rated.retraction), "rate", prior(has_gyro=False)),
            "smoother": Call(
                smoothed, (left, prior(), bridging, shared), {"filter": mekf, "branches": branches, "main": tl.main}
            ),
        }

    def attributes(self) -> dict[str, Any]:
        """Of the dataset: what the report must know."""
        return {
            "nees_dof": 6,
            "pooled_text": f"the last {WINDOW_S} s",
            "experiment": "zhou2021",
            "recovered_deg": float(np.degrees(self.recovered)),
        }

    def fixed(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
        """Truth, bound, and QUEST's quaternions of one example with and without (13)."""
        from .zhou2021_results import design_table, example_quaternions

        at = self.update
        bound = self.bound
        sigma = np.sqrt(np.diagonal(bound, axis1=1, axis2=2))
        plain, continuous = example_quaternions(self)
        quaternion, axis = ("time", "quaternion"), ("time", "axis")
        return {
            "truth_q_bn": (quaternion, self.truth.q[at], {"long_name": "true attitude", "units": "1"}),
            "quest_plain": (quaternion, plain[at], {"long_name": "QUEST's attitude as it comes", "units": "1"}),
            "quest_continuous": (quaternion, continuous[at], {"long_name": "the same with (13)", "units": "1"}),
            "bound_rad": (
                axis, sigma[at - 1, :3], {"long_name": "Cramer-Rao bound, 1 sigma", "units": "rad", "frame": "B"},
            ),
            "bound_drift_rad_s": (
                axis, sigma[at - 1, 3:], {"long_name": "Cramer-Rao bound, 1 sigma", "units": "rad/s", "frame": "B"},
            ),
            "bound_window": (
                ("state",),
                np.sqrt(np.mean(np.diagonal(bound[-WINDOW_S:], axis1=1, axis2=2), axis=0)),
                {"long_name": f"root mean square of the bound over the last {WINDOW_S} s", "units": "rad, rad/s"},
            ),
            **{f"design_{k}": (("design",), v, {}) for k, v in design_table(self).items()},
        }  # fmt: skip

    def summarise(self, dataset: Any) -> dict[str, dict]:
        """The metrics of `helmstar run zhou2021 --json`."""
        from .zhou2021_results import summarise

        return summarise(dataset)

    def claims(self, dataset: Any, summary: dict) -> list:
        """The paper's claims, judged."""
        from .zhou2021_results import claims

        return claims(self, dataset, summary)
