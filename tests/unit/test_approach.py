"""The approach: laws of its motion, target plane and burns against independent ones, then 60 flown runs."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from helmstar.backend import jax, jnp
from helmstar.campaign.engine import Engine
from helmstar.core import Gaussian
from helmstar.errors import ConfigurationError
from helmstar.evaluate.consistency import chi_square_band
from helmstar.models.approach import (
    AU,
    MU_SUN,
    Approach,
    Execution,
    Forces,
    Target,
    approach,
    correction,
    executed,
    execution_cov,
    flow,
    passage,
    predicted_passage,
)
from helmstar.scenarios import load
from helmstar.scenarios.approach import TERMINAL_VARIABLES, Experiment, target_axes
from helmstar.scenarios.approach_data import nominal_start, start_factor, timeline
from helmstar.scenarios.approach_terminal import Terminal, terminal_tracking

DAY = 86400.0
QUIET = {
    "terminal.filter": "none",
    "ephemeris.position_km": [1e-9] * 3,
    "ephemeris.velocity_m_s": [1e-9] * 3,
    "probe.position_km": [1e-9] * 3,
    "probe.velocity_m_s": [1e-9] * 3,
    "probe.radiation_error": 0.0,
    "probe.velocity_walk_mm_s_sqrt_day": 0.0,
    "manoeuvres.least_m_s": 0.0,
    "manoeuvres.magnitude_share": 0.0,
    "manoeuvres.magnitude_m_s": 0.0,
    "manoeuvres.pointing_deg": 0.0,
    "manoeuvres.pointing_m_s": 0.0,
}
"""An approach without errors, but off course."""


def experiment(**more) -> Experiment:
    name, spec = load("approach", {"terminal.filter": "none", **more})
    return Experiment(spec, name)


def compute(e: Experiment, names: list[str], blocks: int = 1) -> dict[str, dict[str, np.ndarray]]:
    """Arrays of whole blocks of 20 runs by estimator; all experiments here share one compiled program."""
    engine = Engine(e, names)
    engine.compile(1)
    found = [engine.compute(i).arrays for i in range(blocks)]
    return {n: {k: np.concatenate([b[n][k] for b in found]) for k in found[0][n]} for n in names}


@pytest.fixture(scope="module")
def library() -> Experiment:
    return experiment()


@pytest.fixture(scope="module")
def flown(library) -> dict[str, dict[str, np.ndarray]]:
    return compute(library, list(library.estimators), 3)


def state(s: float = 0.0) -> Approach:
    """At the start of the library's scenario."""
    y = nominal_start(load("approach")[1])
    return Approach(*map(jnp.asarray, np.split(y, 4)), jnp.array([s]), jnp.zeros(1))


FORCES = Forces(jnp.asarray(MU_SUN), jnp.asarray(1.18e-7), jnp.asarray(0.0), 2)
flowed = jax.jit(flow, static_argnums=3)


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(x), axis=0))


# Laws


def test_two_orbits_are_those_of_scipy():
    x, days = state(0.3), 60.0
    y = np.concatenate([x.R + x.r, x.V + x.v, x.R, x.V])
    a = 1.3 * 1.18e-7 * AU**2

    def rate(_, y):
        P, T = y[:3], y[6:9]
        probe, body = (a - MU_SUN) * P / np.linalg.norm(P) ** 3, -MU_SUN * T / np.linalg.norm(T) ** 3
        return np.concatenate([y[3:6], probe, y[9:], body])

    P, vP, T, vT = np.split(solve_ivp(rate, (0, days * DAY), y, "DOP853", rtol=1e-13, atol=1e-4).y[:, -1], 4)
    end = flowed(FORCES, x, jnp.asarray(days * DAY), 120)
    # Half-day steps of order four leave some metres of 1e11; the relative orbit is what counts, and no burn sees 20 m.
    assert np.abs(end.r - (P - T)).max() < 20.0
    assert np.abs(end.R - T).max() < 20.0
    assert np.abs(end.v - (vP - vT)).max() < 1e-5


def test_energy_of_the_body_is_kept_and_motion_goes_back():
    x = state()

    def energy(x):
        return 0.5 * np.sum(np.square(x.V)) - MU_SUN / np.linalg.norm(x.R)

    end = flowed(FORCES, x, jnp.asarray(60 * DAY), 120)
    assert energy(end) == pytest.approx(energy(x), rel=1e-9)
    back = flowed(FORCES, end, jnp.asarray(-60 * DAY), 120)
    np.testing.assert_allclose(back.r, x.r, atol=20.0)


def test_radiation_pressure_pushes_by_its_square_law():
    near, far = flowed(FORCES, state(0.0), jnp.asarray(DAY), 2), flowed(FORCES, state(1.0), jnp.asarray(DAY), 2)
    d = np.linalg.norm(state().R + state().r)
    # Over a day the push is constant to its relative change, v t / d, 2%.
    expected = 0.5 * 1.18e-7 * (AU / d) ** 2 * DAY**2
    assert np.linalg.norm(far.r - near.r) == pytest.approx(expected, rel=0.02)


def test_nominal_orbit_meets_the_aim(library):
    start, target = library.flight.start, library.flight.target
    end = flowed(library.model.process.params, start, jnp.asarray(library.start_s), 400)
    b = passage(target, end)
    np.testing.assert_allclose(b[:2], target.aim, atol=20.0)
    assert abs(b[2]) < 0.01


def test_passage_and_its_derivative():
    axes = target_axes(np.array([6.0, 0, 0]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(axes, [[0, -1, 0], [0, 0, -1]], atol=1e-15)
    target = Target(jnp.asarray(axes), jnp.array([0.0, -150e3]), 60)
    x, left = flowed(FORCES, state(), jnp.asarray(60 * DAY), 120), jnp.asarray(40 * DAY)
    value = jax.jit(lambda d: passage(target, flow(FORCES, approach.boxplus(x, d), left, 60)))
    b, J = jax.jit(predicted_passage)(FORCES, target, x, left)
    # Coordinates about the Sun are rounded to 1e-5 m.
    np.testing.assert_allclose(b, value(jnp.zeros(14)), atol=1e-4)
    # Steps by which the passage moves some km: far above rounding (1e-4 m), and curvature cancels between the two sides.
    size = np.array([1e4] * 3 + [1e-3] * 3 + [1e6] * 3 + [0.1] * 3 + [1e-2, 1.0])
    for i, h in enumerate(size):
        d = jnp.zeros(14).at[i].set(h)
        numeric = (value(d) - value(-d)) / (2 * h)
        np.testing.assert_allclose(J[:, i], numeric, rtol=1e-5, atol=1e-6 * np.abs(J[:, i]).max() + 1e-9 / h)
    dv = correction(target, b, J)
    np.testing.assert_allclose(b[:2] + J[:2, 3:6] @ dv, target.aim, atol=1e-3)
    # The smallest: no part of it leaves the passage as it is.
    free = np.linalg.svd(np.asarray(J[:2, 3:6]))[2][2]
    assert abs(free @ np.asarray(dv)) < 1e-9 * np.linalg.norm(dv)


def test_burns_err_as_their_covariance_says():
    e = Execution(*map(jnp.asarray, (0.01, 0.02, 0.005, 0.03)))
    dv = jnp.array([0.3, -0.4, 1.2])
    normal = np.random.default_rng(4).standard_normal((20000, 3))
    many, cov = jax.jit(jax.vmap(executed, (None, None, 0))), jax.jit(execution_cov)
    sample = np.cov((np.asarray(many(e, dv, normal)) - np.asarray(dv)).T)
    expected = np.asarray(cov(e, dv))
    # 20000 samples: entries within 5 standard errors of 1% of the largest.
    np.testing.assert_allclose(sample, expected, atol=0.05 * expected.max())
    u = np.asarray(dv) / 1.3
    assert u @ expected @ u == pytest.approx(0.01**2 + (0.02 * 1.3) ** 2)
    assert np.trace(expected) - u @ expected @ u == pytest.approx(2 * (0.005**2 + (0.03 * 1.3) ** 2))
    assert not np.any(cov(e, jnp.zeros(3)))
    assert not np.any(many(e, jnp.zeros(3), normal))


def test_errors_at_the_start_are_those_of_two_orbits():
    spec = load("approach")[1]
    L = start_factor(spec)
    P = L @ L.T
    body, probe = 1500e3, 20e3
    assert P[0, 0] == pytest.approx(body**2 + probe**2)
    assert P[0, 6] == pytest.approx(-(body**2))
    to_probe = np.hstack([np.eye(3), np.zeros((3, 3)), np.eye(3), np.zeros((3, 5))])
    np.testing.assert_allclose(to_probe @ P @ to_probe.T, probe**2 * np.eye(3), atol=1e-3 * probe**2)


def test_timeline_has_every_frame_and_manoeuvre_once():
    spec = load("approach")[1]
    t = timeline(spec)
    assert np.all(t.dt > 0)
    assert t.dt.sum() == pytest.approx(2400 * 3600 - 20 * 60)
    assert t.before[-1] == 20 * 60
    assert t.frame[-1]
    np.testing.assert_allclose(t.before[t.burns] / 3600, spec.manoeuvres.before_h)
    # 59 a day apart (none at the start itself), 60 by 12 h, then 28, 24, 36, 24 and every 2 min down to 20 min.
    assert t.frame.sum() == 59 + 60 + 28 + 24 + 36 + 24 + 51
    between = timeline(load("approach", {"manoeuvres.before_h": [100.5]})[1])
    assert len(between.dt) == len(t.dt) + 1
    assert not between.frame[between.burns[0]]


# Flown


def test_without_errors_the_aim_is_met():
    found = compute(experiment(**QUIET), ["ekf"])["ekf"]
    # The first burn, from some 1700 km off, is linear to a few km; the later ones take what it leaves.
    assert found["delta_v_m_s"][:, 0].min() > 0.01
    # 1e-9 m/s of error for 100 days, and rounding: centimetres.
    assert np.abs(found["delivery_km"]).max() < 1e-3
    assert found["delta_v_m_s"][:, -1].max() < 1e-3


def test_filter_is_consistent_from_the_first_frame_to_the_last(flown):
    nees = 6.0 * flown["ekf"]["nees_per_state"]
    low, high = chi_square_band(6, len(nees), 1 - 1e-5)
    at = nees[:, ::20].mean(axis=0)  # 15 epochs at 1e-5
    assert low < at.min()
    assert at.max() < high
    seen = flown["ekf"]["seen"] > 0
    # 34 000 independent pairs: standard error 0.5%, curvature aside.
    assert np.mean(flown["ekf"]["nis"][seen]) / 2 == pytest.approx(1.0, abs=0.03)


def test_knowledge_reaches_the_bound(library, flown):
    bound = np.sqrt(np.diagonal(library.bound, axis1=1, axis2=2))[:, :3] / 1e3
    error = rms(flown["ekf"]["position_error_km"])
    for hours in (240, 24, 2, 1 / 3):
        k = int(np.argmin(np.abs(library.timeline.before / 3600 - hours)))
        # RMS of 60 runs: standard error 9%; burns the bound does not know add up to a fifth.
        assert np.all(error[k] > 0.65 * bound[k])
        assert np.all(error[k] < 1.6 * bound[k])


def test_frames_and_manoeuvres_are_what_delivers(flown):
    miss = {n: rms(np.hypot(*d["delivery_km"].T)) for n, d in flown.items()}
    assert miss["ekf"] < 3.0
    for control in ("no_manoeuvres", "no_frames"):
        assert miss[control] > 300.0
    assert np.all(flown["no_manoeuvres"]["delta_v_m_s"] == 0)
    assert not np.any(flown["no_frames"]["seen"])
    burns = flown["ekf"]["delta_v_m_s"]
    assert np.all((burns == 0) | (burns >= 0.01))
    assert 0.5 < np.median(burns.sum(axis=1)) < 5.0
    # What misses is what was not known at the last burn, and its errors: as its own sigma says, within sampling.
    sigma = flown["ekf"]["aimed_sigma_km"][:, -1].mean(axis=0)
    np.testing.assert_allclose(rms(flown["ekf"]["delivery_km"]), sigma, rtol=0.4)


def test_ignored_radiation_pressure_shows(flown):
    ignored = flown["ekf_srp_ignored"]["nees_per_state"].mean()
    assert ignored > flown["ekf"]["nees_per_state"].mean() + 0.3


def test_ignored_burn_errors_show_where_burns_are_rough():
    rough = experiment(**{"manoeuvres.magnitude_share": 0.1, "manoeuvres.pointing_deg": 5.0})
    found = compute(rough, ["ekf", "ekf_execution_ignored"])
    k = rough.timeline.burns[0] + 1
    honest, ignorant = (found[n]["nees_per_state"][:, k:].mean() for n in ("ekf", "ekf_execution_ignored"))
    low, high = chi_square_band(6, 20, 1 - 1e-5)
    assert low / 6 < honest < high / 6
    assert ignorant > 2 * honest


def test_terminal_tracking_gives_what_is_recorded(library):
    """Traced only: compiling it takes as long as all of the above. `helmstar run approach` is where it is seen to work."""
    end, data = Terminal.of("ekf", 1)
    belief = Gaussian(library.flight.start, jnp.eye(14))
    track = partial(terminal_tracking, end)
    found = jax.eval_shape(track, data, library.flight.start, belief, jnp.asarray(1200.0), jnp.asarray(0))
    assert set(found) == set(TERMINAL_VARIABLES)
    assert found["terminal_error_km"].shape == (120, 3)
    assert not set(TERMINAL_VARIABLES) & set(library.variables)


def test_campaign_report_and_metrics(tmp_path, library):
    from helmstar.campaign import run_campaign
    from helmstar.report.monte_carlo import write_monte_carlo_report
    from helmstar.report.terminal import print_campaign

    spec = library.spec.model_dump(mode="json")
    outcome = run_campaign(
        library, runs=20, seed=1, folder=tmp_path, specification=spec, configuration="", command="", progress=False,
        estimators=["ekf", "no_frames"],
    )  # fmt: skip
    m = outcome.summary["estimators"]["ekf"]
    d = outcome.dataset.sel(estimator="ekf")
    miss = np.hypot(*d["delivery_km"].values.T)
    assert m["delivery_error_km"]["rms"] == pytest.approx(rms(miss))
    assert m["delivery_error_km"]["q50"] <= m["delivery_error_km"]["q90"] <= m["delivery_error_km"]["q99"]
    assert m["delta_v_m_s"]["mean"] == pytest.approx(d["delta_v_m_s"].values.sum(axis=1).mean())
    claims = library.claims(outcome.dataset, outcome.summary)
    assert [c.verdict for c in claims] == ["holds", "holds", "holds in part"]
    page = write_monte_carlo_report(outcome.dataset, outcome.summary, claims, tmp_path / "r.html").read_text()
    assert "Where it passes" in page
    print_campaign(outcome.summary)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"encounter.aim_km": [1, 0, 150]}, "across"),
        ({"encounter.pole": [1, 0, 0]}, "pole"),
        ({"frames.from_h": [2400, 960]}, "as many"),
        ({"frames.from_h": [2400, 960, 240, 72, 24, 6, 0.1]}, "go down"),
        ({"manoeuvres.before_h": [24, 240]}, "go down"),
        ({"manoeuvres.before_h": [3000]}, "between the start"),
        ({"terminal.filter": "pf"}, "gsf"),
    ],
)
def test_wrong_keys_are_refused(overrides, says):
    with pytest.raises(ConfigurationError, match=says):
        load("approach", overrides)
