"""What zhou2021 is made of: gyro, heads, catalogue, profiles, timeline, models, and filters that restart and adapt."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helmstar.backend import COMPILER_OPTIONS
from helmstar.core import ACCEPTED, GATED, RESET, Gaussian, Measurement, chi_square_gate, no_gate
from helmstar.errors import ConfigurationError
from helmstar.evaluate import farrenkopf
from helmstar.filters import (
    AdaptiveBelief,
    AdaptiveFilter,
    ErrorStateKalmanFilter,
    PredictiveBelief,
    PredictiveFilter,
    ResettableBelief,
    ResettingFilter,
    RestartFromAttitude,
    RestartFromStars,
    run,
)
from helmstar.filters.reset import SOON
from helmstar.geometry import so3_left, so3_right
from helmstar.models import zhou2021 as paper
from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model
from helmstar.models.attitude_rate import AttitudeRateDrift, RateNoise, attitude_rate_model, gyro_rate
from helmstar.models.sensors import unit_star_directions, whole_attitude
from helmstar.scenarios.specification import load
from helmstar.scenarios.zhou2021_timeline import FROM_SAVED, FROM_WRONG, build_timeline
from helmstar.scenarios.zhou2021_truth import truth_of
from helmstar.sensors.gyro import gyro_readings
from helmstar.sensors.star_heads import Head, directions_S, image_points, mounted, through_heads, visible_stars
from helmstar.stars import load_catalog

jit = partial(jax.jit, compiler_options=COMPILER_OPTIONS)

# --- gyro ------------------------------------------------------------------------------------------------------------


def test_gyro_errors_have_farrenkopfs_covariance():
    """Of one step the error of the reading and the change of the drift: [[v^2 dt + u^2 dt^3 / 3, u^2 dt^2 / 2], [.., u^2 dt]]."""
    dt, v, u, n = 0.5, 0.3, 0.7, 200_000
    normal = np.random.default_rng(1).normal(size=(n, 3, 3))
    drift0 = np.array([1.0, -2.0, 0.5])
    one = jax.vmap(lambda w: gyro_readings(jnp.zeros((1, 3)), jnp.asarray(dt), drift0, v, u, w[None]))
    readings, drift = (np.asarray(a)[:, 0] for a in one(normal))
    e = np.stack([readings - drift0 * dt, drift - drift0], axis=-1).reshape(-1, 2)
    expected = np.array([[v**2 * dt + u**2 * dt**3 / 3, u**2 * dt**2 / 2], [u**2 * dt**2 / 2, u**2 * dt]])
    found = e.T @ e / len(e)
    sigma = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / len(e))  # Wishart
    assert np.all(np.abs(found - expected) < 5 * sigma)


def test_without_noise_the_gyro_integrates_rate_and_drift():
    turned = np.random.default_rng(2).normal(size=(50, 3))
    readings, drift = gyro_readings(turned, jnp.asarray(2.0), np.ones(3) * 0.1, 0.0, 0.0, np.ones((50, 3, 3)))
    np.testing.assert_allclose(readings, turned + 0.2, atol=1e-15)
    np.testing.assert_allclose(drift, 0.1, atol=1e-16)


@pytest.mark.parametrize(
    ("n", "v", "u", "dt"), [(1e-3, 1e-5, 1e-8, 1.0), (1e-5, 1e-4, 1e-6, 10.0), (2e-3, 9e-7, 2e-10, 1.0)]
)
def test_farrenkopf_solves_the_riccati_equation(n, v, u, dt):
    s = np.array([n, n / dt])  # the solver needs numbers near 1
    F = np.array([[1, dt], [0, 1]]) * s[None] / s[:, None]
    Q = np.array([[v**2 * dt + u**2 * dt**3 / 3, u**2 * dt**2 / 2], [u**2 * dt**2 / 2, u**2 * dt]]) / np.outer(s, s)
    H = np.array([[s[0], 0.0]])
    P = solve_discrete_are(F.T, H.T, Q, np.array([[n * n]]))
    after = P - P @ H.T @ H @ P / (H @ P @ H.T + n * n)
    expected = np.sqrt([after[0, 0], after[1, 1], P[0, 0], P[1, 1]]) * np.tile(s, 2)
    np.testing.assert_allclose(farrenkopf(n, v, u, dt), expected, rtol=1e-9)


# --- heads and catalogue ---------------------------------------------------------------------------------------------


def test_the_pinhole_and_its_inverse():
    m = np.array([[0.1, -0.05, 1.0], [0.0, 0.0, 2.0]])
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    p = image_points(m, 50.0)
    np.testing.assert_allclose(p[0], [-5.0, 2.5], rtol=1e-14)  # (3): m = [-p_x, -p_y, f]
    np.testing.assert_allclose(directions_S(p, 50.0), m, atol=1e-16)
    assert np.isnan(image_points(np.array([0.0, 0.0, -1.0]), 1.0)).all()


def test_heads_see_what_is_in_their_fields():
    stars = load_catalog(5.5).directions()
    R = Rotation.random(300, rng=np.random.default_rng(3)).as_matrix()
    field = np.deg2rad(20.0)
    heads = (Head(mounted([1, 2, 3]), field), Head(mounted([0, 0, 1]), field, "widest_pair"))
    r, seen = visible_stars(R, heads, stars)
    assert r.shape == (300, 3, 3)
    b = through_heads(R, heads, r)
    for i in range(300):
        for k, head in enumerate((heads[0], heads[1], heads[1])):
            cosine = stars @ R[i].T @ head.R_BS[:, 2]
            if not seen[i, k]:
                assert (cosine >= np.cos(field / 2)).sum() < head.stars
                continue
            np.testing.assert_allclose(b[i, k], R[i] @ r[i, k], atol=4e-16)
            if k == 0:
                assert (R[i] @ r[i, k]) @ head.R_BS[:, 2] == pytest.approx(cosine.max(), abs=1e-15)
        if seen[i, 1]:
            near = stars[stars @ R[i].T @ heads[1].R_BS[:, 2] >= np.cos(field / 2)]
            assert r[i, 1] @ r[i, 2] == pytest.approx((near @ near.T).min(), abs=1e-15)


@pytest.mark.parametrize(
    ("hip", "name", "ra_deg", "dec_deg", "magnitude"),
    [
        # J2000 places of the Bright Star Catalogue, to its last digit (0.1 s of time, 1 arcsec).
        (32349, "Sirius", 101.28713, -16.71611, -1.46),
        (91262, "Vega", 279.23458, 38.78361, 0.03),
        (11767, "Polaris", 37.95292, 89.26417, 2.02),
        (71683, "alpha Cen A", 219.90208, -60.83417, -0.01),
    ],
)
def test_well_known_stars_are_where_they_should_be(hip, name, ra_deg, dec_deg, magnitude):
    catalog = load_catalog()
    i = int(np.flatnonzero(catalog.hip == hip)[0])
    d = catalog.directions(2000.0)[i]
    a, b = np.radians([ra_deg, dec_deg])
    expected = np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    # alpha Cen A's catalogue place is that of the pair's orbit: some arcsec.
    assert np.degrees(np.linalg.norm(d - expected)) * 3600 < (5.0 if hip == 71683 else 1.5)
    assert catalog.magnitude[i] == pytest.approx(magnitude, abs=0.06)


def test_61_cygni_moves_by_its_proper_motion():
    catalog = load_catalog()
    i = int(np.flatnonzero(catalog.hip == 104214)[0])
    moved = np.degrees(np.linalg.norm(catalog.directions(2010.0)[i] - catalog.directions(2000.0)[i])) * 3600
    assert moved == pytest.approx(52.8, abs=0.1)  # 5.28 arcsec a year


def test_the_catalogue_is_sorted_and_limited():
    assert len(load_catalog(6.0)) == 5041
    assert np.all(np.diff(load_catalog().magnitude) >= 0)
    assert np.allclose(np.linalg.norm(load_catalog(5.0).directions(), axis=1), 1.0, atol=1e-15)
    with pytest.raises(ValueError, match="ends at V = 9"):
        load_catalog(9.5)


# --- truth and timeline ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["lvlh", "yaw", "slew"])
def test_what_the_gyro_integrates_turns_the_body(profile):
    _, spec = load("zhou2021", {"attitude.profile": profile, "duration_s": 700})
    T = truth_of(spec)
    turn = Rotation.from_rotvec(-T.turned) * Rotation.from_quat(T.q[:-1])
    # The integral of the rate is not the rotation vector: they differ by coning, a twelfth of rate x acceleration x dt^3.
    error = (turn * Rotation.from_quat(T.q[1:]).inv()).magnitude()
    assert error.max() < (1e-6 if profile == "slew" else 1e-9)
    assert np.all(np.sum(T.q[1:] * T.q[:-1], axis=1) > 0)
    np.testing.assert_allclose(np.linalg.norm(T.b_B, axis=2), 1.0, atol=1e-15)
    R = Rotation.from_quat(T.q).as_matrix()
    np.testing.assert_allclose(np.einsum("nij,nkj->nki", R, T.r_N), T.b_B, atol=1e-15)


def test_profiles_point_where_they_say():
    from helmstar.astro import Elements, propagate

    _, spec = load("zhou2021", {"duration_s": 500, "attitude.profile": "yaw"})
    o = spec.orbit
    angles = np.radians([o.inclination_deg, o.raan_deg, o.argument_of_perigee_deg, o.mean_anomaly_deg])
    r, _ = propagate(Elements(o.semi_major_axis_km * 1e3, o.eccentricity, *angles), np.arange(501.0))
    nadir = -r / np.linalg.norm(r, axis=1, keepdims=True)
    T = truth_of(spec)
    R = Rotation.from_quat(T.q).as_matrix()
    np.testing.assert_allclose(R[:, 2], nadir, atol=1e-9)
    sun = R @ np.array(spec.attitude.sun)
    np.testing.assert_allclose(sun[:, 1], 0.0, atol=1e-9)
    assert np.all(sun[:, 0] > 0)


def test_an_attitude_file_is_a_profile(tmp_path):
    from helmstar.io.aem import write_aem
    from helmstar.io.clock import Origin

    _, spec = load("zhou2021", {"duration_s": 120})
    T = truth_of(spec)
    write_aem(tmp_path / "p.aem", Origin(8035, 37.0, absolute=True), [(T.time, T.q)])
    _, spec = load(
        "zhou2021", {"duration_s": 120, "attitude.profile": "file", "attitude.file": str(tmp_path / "p.aem")}
    )
    again = truth_of(spec)
    np.testing.assert_allclose(np.abs(np.sum(again.q * T.q, axis=1)), 1.0, atol=1e-13)
    _, long = load(
        "zhou2021", {"duration_s": 121, "attitude.profile": "file", "attitude.file": str(tmp_path / "p.aem")}
    )
    with pytest.raises(ConfigurationError, match=r"covers 120 s, but duration_s is 121"):
        truth_of(long)


def profile_file(path, **keys):
    return load("zhou2021", {"attitude.profile": "file", "attitude.file": str(path), **keys})[1]


def test_an_attitude_file_is_identified_by_its_content(tmp_path):
    """Else a resume would mix runs of two truths under one name."""
    from helmstar.campaign.store import fingerprint

    def mark(spec):
        return fingerprint({"specification": spec.model_dump(mode="json"), "estimators": [], "helmstar_version": "0"})

    path = tmp_path / "p.aem"
    path.write_text("one")
    one = profile_file(path)
    again = profile_file(path)
    path.write_text("two")
    two = profile_file(path)
    assert mark(one) == mark(again) != mark(two)
    assert one.attitude.file_sha256 != two.attitude.file_sha256
    with pytest.raises(ConfigurationError, match=r"attitude: file = .*another content than file_sha256 says"):
        load("zhou2021", one.model_dump())  # as a worker elsewhere gets it, and another file under the name
    assert load("zhou2021", two.model_dump())[1] == two
    with pytest.raises(ConfigurationError, match=r"attitude: file = .*none\.aem' cannot be read: No such file"):
        profile_file(tmp_path / "none.aem")
    assert load("zhou2021", {"attitude.file": "none.aem"})[1].attitude.file_sha256 is None  # not used, not read


def test_a_changed_attitude_file_is_no_resume(tmp_path):
    from helmstar.campaign.store import Store
    from helmstar.errors import CampaignError

    path = tmp_path / "p.aem"
    manifest = {"runs": 2, "estimators": [], "helmstar_version": "0"}
    path.write_text("one")
    Store(tmp_path / "out", manifest | {"specification": profile_file(path).model_dump(mode="json")}, resume=False)
    path.write_text("two")
    with pytest.raises(CampaignError, match=r"different in attitude\.file_sha256"):
        Store(tmp_path / "out", manifest | {"specification": profile_file(path).model_dump(mode="json")}, resume=True)


@pytest.mark.parametrize("degrees", [89.0, 91.0])
def test_steps_of_more_than_90_deg_are_not_interpolated(tmp_path, degrees):
    from helmstar.io.aem import write_aem
    from helmstar.io.clock import Origin

    q = Rotation.from_rotvec(np.radians(degrees) * np.array([[0.0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 1, 0]])).as_quat()
    write_aem(tmp_path / "p.aem", Origin(8035, 37.0, absolute=True), [(np.array([0.0, 40, 70, 100]), q)])
    if degrees < 90.0:
        assert len(truth_of(profile_file(tmp_path / "p.aem", duration_s=100)).q) == 101
        return
    with pytest.raises(ConfigurationError, match=r"attitude 2 at 40 s to attitude 3 at 70 s the body turns by 91 deg"):
        truth_of(profile_file(tmp_path / "p.aem", duration_s=100))


def test_segments_of_an_aem_are_not_interpolated_over(tmp_path):
    from helmstar.io.aem import write_aem
    from helmstar.io.clock import Origin

    q = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    segments = [(np.array([0.0, 40, 80]) + begin, q) for begin in (0.0, 90.0, 180.0)]
    write_aem(tmp_path / "p.aem", Origin(8035, 37.0, absolute=True), segments)
    with pytest.raises(ConfigurationError, match=r"p\.aem: nothing is known from 80 to 90 s, between two segments"):
        truth_of(profile_file(tmp_path / "p.aem", duration_s=100))
    assert len(truth_of(profile_file(tmp_path / "p.aem", duration_s=80)).q) == 81  # what is used has no gap


def test_the_timeline_has_every_pass_in_its_place():
    _, spec = load("zhou2021", {})
    t = build_timeline(spec)
    assert t.main == 6052
    np.testing.assert_array_equal(t.index[: t.main], np.arange(6052))
    assert t.save.sum() == 1
    assert t.save[3999]
    assert not t.policy[: t.main].any()
    names = [b.name for b in t.branches]
    assert len(names) == len(set(names)) == 14
    start = t.main
    for b in t.branches:
        assert b.start == start
        begin = t.begin[b.start : b.start + b.count]
        assert begin[0] == (FROM_WRONG if b.name.startswith("start") else FROM_SAVED)
        assert not begin[1:].any()
        assert t.index[b.start] == (0 if b.name.startswith("start") else 4000)
        start += b.count
    assert start == t.steps
    _, short = load("zhou2021", {"duration_s": 100})
    assert build_timeline(short).branches == ()
    _, lossy = load("zhou2021", {"gyro.loss_policy": "zeros", "star.loss_s": 20})
    t = build_timeline(lossy)
    assert np.flatnonzero(t.policy[: t.main]).tolist() == list(range(4000, 4060))
    assert np.flatnonzero(t.dark[: t.main]).tolist() == list(range(4000, 4020))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("star.reading", "E", ["star.reading", "'A', 'B', 'C'"]),
        ("attitude.profile", "file", ["attitude.file"]),
        ("gyro.loss_policy", "pray", ["gyro.loss_policy", "hold_mean"]),
        ("orbit.semi_major_axis_km", 6400.0 * 0.9, ["orbit.semi_major_axis_km"]),
        ("orbit.eccentricity", 0.5, ["perigee"]),
        ("attitude.sun", [0.0, 0.0, 0.0], ["attitude.sun", "zero"]),
        ("gyro.loss_start_s", 0, ["gyro.loss_start_s", ">= 1"]),  # hold_last would hold the lost sample
        ("gyro.loss_start_s", 4000.5, ["gyro.loss_start_s", "integer"]),
        ("gyro.loss_s", 60.5, ["gyro.loss_s", "integer"]),
        ("star.loss_start_s", 0.5, ["star.loss_start_s", "integer"]),
        ("star.loss_s", 20.5, ["star.loss_s", "integer"]),
        ("star.loss_s", 2053, ["star.loss_start_s = 4000 and star.loss_s = 2053 end at 6053 s", "duration_s = 6052"]),
    ],
)
def test_wrong_keys_are_named(key, value, words):
    with pytest.raises(ConfigurationError) as e:
        load("zhou2021", {key: value})
    for word in words:
        assert word in str(e.value)


def test_a_loss_in_the_main_pass_fits_into_it():
    keys = {"gyro.loss_start_s": 5993, "gyro.loss_s": 60}
    load("zhou2021", keys)  # no loss in the main pass, so nothing that has to fit
    load("zhou2021", keys | {"gyro.loss_policy": "zeros", "duration_s": 6053})
    with pytest.raises(
        ConfigurationError, match=r"gyro\.loss_start_s = 5993 and gyro\.loss_s = 60 end at 6053 s.*6052"
    ):
        load("zhou2021", keys | {"gyro.loss_policy": "zeros"})
    assert load("zhou2021", {"star.loss_s": 2052})[1].star.loss_s == 2052


def test_the_limit_of_recovery_is_not_below_what_a_perfect_filter_reaches():
    from helmstar.scenarios.specification import build
    from helmstar.scenarios.zhou2021_results import scenario_bound

    def limit(**keys):
        experiment = build("zhou2021", load("zhou2021", {"duration_s": 1500, **keys})[1])
        return experiment, experiment.attributes()["recovered_deg"]

    assert limit()[1] == pytest.approx(0.1, rel=1e-12)
    experiment, coarse = limit(**{"star.reading": "A"})
    total = np.sqrt(np.mean(np.trace(scenario_bound(experiment)[-1000:, :3, :3], axis1=1, axis2=2)))
    assert coarse == pytest.approx(5.0 * np.degrees(total), rel=1e-12)
    assert coarse > 0.3
    assert float(experiment.estimators["mekf"].arguments[1].recovered) == pytest.approx(np.radians(coarse), rel=1e-12)
    # A star loss in the main pass is none in the passes in which something recovers.
    assert limit(**{"star.reading": "A", "star.loss_start_s": 1000, "star.loss_s": 500})[1] == coarse


def test_cells_close_to_the_claim_are_borderline():
    from helmstar.scenarios.specification import build
    from helmstar.scenarios.zhou2021_results import design_table

    table = design_table(build("zhou2021", load("zhou2021")[1]))
    near = [
        min(abs(a / 0.003 - 1.0), abs(d / 0.03 - 1.0))
        for a, d in zip(table["attitude_deg"], table["drift_deg_h"], strict=True)
    ]
    np.testing.assert_array_equal(table["borderline"], np.array(near) <= 0.05)
    cells = {(str(r), float(a), float(u)) for r, a, u, b in zip(
        table["reading"], table["arw"], table["rrw"], table["borderline"], strict=True) if b}  # fmt: skip
    assert ("B", 0.003, 0.003) in cells
    assert ("D", 0.01, 0.03) not in cells


def test_heads_that_see_nothing_at_the_start_are_an_error():
    from helmstar.scenarios.specification import build

    _, spec = load("zhou2021", {"duration_s": 100, "star.field_deg": 0.5})
    with pytest.raises(ConfigurationError, match=r"star.field_deg = 0.5.* 0 stars at the start"):
        build("zhou2021", spec)


def test_stars_that_come_and_go_are_part_of_the_scenario():
    """With a narrow field an epoch may have one star or none; bound and designs go on."""
    from helmstar.scenarios.specification import build
    from helmstar.scenarios.zhou2021_results import design_table, scenario_bound

    _, spec = load("zhou2021", {"duration_s": 1500, "star.field_deg": 8.0, "star.faintest": 5.0})
    experiment = build("zhou2021", spec)
    counts = experiment.truth.seen.sum(axis=1)
    assert set(counts) > {1, 2}
    assert np.isfinite(scenario_bound(experiment)).all()
    assert all(np.isfinite(v).all() for k, v in design_table(experiment).items() if k != "reading")


# --- models ----------------------------------------------------------------------------------------------------------


def test_analytic_jacobians_of_the_rate_model():
    model = attitude_rate_model(RateNoise(jnp.asarray(1e-3), jnp.asarray(1e-6)))
    p, r = model.process, model.retraction
    rng = np.random.default_rng(4)
    x = AttitudeRateDrift(
        *(jnp.asarray(v) for v in (Rotation.random(rng=rng).as_quat(), rng.normal(size=3), rng.normal(size=3)))
    )
    dt, w0 = jnp.asarray(0.7), jnp.zeros(6)
    mean = p.step(p.params, x, None, dt, w0)
    F, G = jax.jacfwd(lambda xi, w: r.boxminus(p.step(p.params, r.boxplus(x, xi), None, dt, w), mean), (0, 1))(
        jnp.zeros(9), w0
    )
    found = p.jacobian(p.params, x, None, dt)
    np.testing.assert_allclose(found[0], F, atol=1e-14)
    np.testing.assert_allclose(found[1], G, atol=1e-14)
    s = gyro_rate()
    H = jax.jacfwd(lambda xi: s.predict(None, r.boxplus(x, xi), None))(jnp.zeros(9))
    np.testing.assert_allclose(s.jacobian(None, x, jnp.eye(3)), H, atol=1e-15)


@pytest.mark.parametrize("size", [1e-2, 1e-3])
def test_the_printed_filter_is_right_to_first_order(size):
    """Phi = I + F T (17) against the exact derivative: it misses the second order of the turn of one step, and no more."""
    model = paper.printed_model(GyroNoise(jnp.asarray(1e-3), jnp.asarray(1e-6)))
    p, r = model.process, model.retraction
    x = AttitudeDrift(
        jnp.asarray(Rotation.random(rng=np.random.default_rng(5)).as_quat()), jnp.asarray([1e-3, 2e-3, -1e-3])
    )
    u = GyroInput(jnp.asarray([1.0, -0.5, 0.7]) * size, jnp.zeros((3, 3)))
    dt, w0 = jnp.asarray(1.0), jnp.zeros(6)
    mean = p.step(p.params, x, u, dt, w0)
    exact = jax.jacfwd(lambda xi: r.boxminus(p.step(p.params, r.boxplus(x, xi), u, dt, w0), mean))(jnp.zeros(6))
    F, G = p.jacobian(p.params, x, u, dt)
    assert G is None
    turn = float(jnp.linalg.norm(u.rate - x.b))
    assert np.abs(np.asarray(F[:3, :3] - exact[:3, :3])).max() < 0.6 * turn**2
    assert np.abs(np.asarray(F[:3, 3:] - exact[:3, 3:])).max() < 0.3 * turn
    np.testing.assert_allclose(F[3:], exact[3:], atol=1e-15)


# --- filters ---------------------------------------------------------------------------------------------------------

SIGMA, SIGMA_V = 1e-3, 1e-5
STEPS = 300


def record(seed: int, sigma: float = SIGMA, upset: int | None = None):
    """A slow turn with two stars at each second: rates (n, 3), z and r (n, 2, 3), truth q (n + 1, 4)."""
    rng = np.random.default_rng(seed)
    rate = np.array([1e-3, -5e-4, 8e-4]) + np.zeros((STEPS, 3))
    R = [Rotation.random(rng=rng)]
    for k in range(STEPS):
        jump = Rotation.from_rotvec([0, np.pi / 2, 0]) if k == upset else Rotation.identity()
        R.append(jump * Rotation.from_rotvec(-rate[k]) * R[-1])
    r = rng.normal(size=(STEPS, 2, 3))
    r /= np.linalg.norm(r, axis=2, keepdims=True)
    z = np.stack([R[k + 1].apply(r[k]) for k in range(STEPS)]) + sigma * rng.normal(size=(STEPS, 2, 3))
    z /= np.linalg.norm(z, axis=2, keepdims=True)
    return rate + SIGMA_V * rng.normal(size=rate.shape), z, r, np.array([x.as_quat() for x in R])


def angles(q, truth):
    return (Rotation.from_quat(np.asarray(q)) * Rotation.from_quat(truth).inv()).magnitude()


MODEL = attitude_drift_model(
    GyroNoise(jnp.asarray(SIGMA_V), jnp.asarray(1e-9)), so3_left, (unit_star_directions(jnp.asarray(SIGMA)),)
)
P_START = np.diag(np.repeat([1e-6, 1e-10], 3))
EKF = ErrorStateKalmanFilter(MODEL.retraction)
GATE = chi_square_gate(1e-6, reopen_after=5)


@partial(jax.jit, static_argnames=("filter",))
def go(filter, model, belief, rate, z, r, mask, gate):
    u = GyroInput(rate, jnp.zeros((STEPS, 3, 3)))
    return run(filter, model, belief, u, jnp.ones(STEPS), (Measurement(z, r, mask),), gate)[2]


ALL = np.ones((STEPS, 2), bool)


def test_a_restart_follows_an_upset_and_keeps_the_drift_known():
    rate, z, r, q = record(6, upset=150)
    belief = ResettableBelief(
        AttitudeDrift(jnp.asarray(q[0]), jnp.zeros(3)), jnp.asarray(P_START), 1e-4 * jnp.eye(3), jnp.asarray(0)
    )
    t = go(ResettingFilter(EKF, RestartFromStars(so3_left)), MODEL, belief, rate, z, r, ALL, GATE)
    status = np.asarray(t.infos[0].status)
    assert status[150:155].tolist() == [GATED] * 4 + [RESET]
    assert np.all(np.delete(status, range(150, 155)) == ACCEPTED)
    error = angles(t.belief.mean.q_BN, q[1:])
    assert error[153] > 1.5
    assert error[160:].max() < 5 * SIGMA
    assert np.asarray(t.belief.cov)[155, 3, 3] < 1e-9


def test_a_restart_soon_after_the_start_doubts_the_drift():
    rate, z, r, q = record(7)
    off = (Rotation.from_rotvec([0, 2.5, 0]) * Rotation.from_quat(q[0])).as_quat()
    drift = np.array([5e-3, -5e-3, 3e-3])  # 1000 deg/h, which the filter is not told
    belief = ResettableBelief(
        AttitudeDrift(jnp.asarray(off), jnp.zeros(3)), jnp.asarray(P_START), 1e-4 * jnp.eye(3), jnp.asarray(0)
    )
    assert SOON > 20
    t = go(ResettingFilter(EKF, RestartFromStars(so3_left)), MODEL, belief, rate + drift, z, r, ALL, GATE)
    assert np.sum(np.asarray(t.infos[0].status) == RESET) >= 1
    assert angles(t.belief.mean.q_BN, q[1:])[-100:].max() < 3 * SIGMA
    e = np.asarray(t.belief.mean.b)[-1] - drift
    assert e @ np.linalg.solve(np.asarray(t.belief.cov)[-1, 3:, 3:], e) < chi2.isf(1e-4, 3)
    plain = go(EKF, MODEL, Gaussian(belief.mean, belief.cov), rate + drift, z, r, ALL, no_gate())
    assert angles(plain.belief.mean.q_BN, q[1:])[-1] > 10 * SIGMA  # else there would be nothing to restart for


def test_a_restart_needs_two_stars():
    rate, z, r, q = record(8, upset=100)
    mask = ALL.copy()
    mask[100:200, 1] = False
    belief = ResettableBelief(
        AttitudeDrift(jnp.asarray(q[0]), jnp.zeros(3)), jnp.asarray(P_START), 1e-4 * jnp.eye(3), jnp.asarray(0)
    )
    t = go(ResettingFilter(EKF, RestartFromStars(so3_left)), MODEL, belief, rate, z, r, mask, GATE)
    status = np.asarray(t.infos[0].status)
    assert not np.any(status[:200] == RESET)
    assert status[200] == RESET
    assert np.isfinite(np.asarray(t.belief.cov)).all()


@pytest.mark.parametrize("retraction", [so3_left, so3_right], ids=lambda r: r.name)
def test_a_restart_from_a_whole_attitude_has_its_covariance(retraction):
    model = attitude_drift_model(
        GyroNoise(jnp.asarray(SIGMA_V), jnp.asarray(1e-9)), retraction, (whole_attitude(retraction),)
    )
    *_, q = record(9)
    cov = np.diag([1e-6, 4e-6, 9e-6])
    filter = ResettingFilter(ErrorStateKalmanFilter(model.retraction), RestartFromAttitude(retraction))
    belief = ResettableBelief(
        AttitudeDrift(jnp.asarray(q[0]), jnp.zeros(3)), jnp.asarray(P_START), jnp.eye(3), jnp.asarray(0)
    )
    far = (Rotation.from_rotvec([1.0, 0, 0]) * Rotation.from_quat(q[1])).as_quat()
    m = Measurement(jnp.asarray(far), jnp.asarray(cov), jnp.asarray([True]))
    b, info = filter.update(belief, model.sensors[0], m, chi_square_gate(1e-6, reopen_after=1), jnp.asarray(0))
    assert int(info.status) == RESET
    np.testing.assert_allclose(b.mean.q_BN, far, atol=1e-15)
    R = Rotation.from_quat(far).as_matrix()
    expected = cov if retraction is so3_left else R.T @ cov @ R
    np.testing.assert_allclose(b.cov[:3, :3], expected, atol=1e-18)
    np.testing.assert_allclose(b.cov[3:, 3:], np.eye(3))


@pytest.mark.parametrize("truth", [0.3, 1.0, 4.0])
def test_the_adaptive_filter_finds_the_factor_of_its_noise(truth):
    """R is SIGMA^2; the stars have truth times that. s forgets over some 1 / rho = 50 measurements of four residuals."""
    rate, z, r, q = record(10, sigma=SIGMA * np.sqrt(truth))
    rho = 0.02
    belief = AdaptiveBelief(
        AttitudeDrift(jnp.asarray(q[0]), jnp.zeros(3)), jnp.asarray(P_START), jnp.asarray(1.0), jnp.asarray(rho)
    )
    t = go(AdaptiveFilter(EKF), MODEL, belief, rate, z, r, ALL, no_gate())
    factor = np.asarray(t.belief.factor)
    # Variance of an exponential mean of chi-square / 4: rho / (2 - rho) * 2 / 4; what remains of the start is below 1%.
    assert abs(factor[-1] / truth - 1.0) < 4 * np.sqrt(0.5 * rho / (2 - rho)) + 0.03
    assert np.mean(factor[100:]) == pytest.approx(truth, rel=0.15)


def test_the_predictive_filter_is_the_minimum_of_its_cost():
    """d minimises e^T R^-1 e + d^T W d (Crassidis and Markley 1997) over the linearised measurement, by least squares."""
    model = attitude_rate_model(
        RateNoise(jnp.asarray(1e-3), jnp.asarray(1e-6)), so3_left, (unit_star_directions(jnp.asarray(SIGMA)),)
    )
    _, z, r, q = record(11)
    weight = np.repeat([1e5, 1e30], 3)
    x = AttitudeRateDrift(jnp.asarray(q[0]), jnp.asarray([2e-3, 0.0, 0.0]), jnp.zeros(3))
    filter = PredictiveFilter(model.retraction)
    belief = PredictiveBelief(x, jnp.eye(9), jnp.asarray(weight))
    b, _ = filter.predict(belief, model.process, None, jnp.asarray(1.0))
    m = Measurement(jnp.asarray(z[0]), jnp.asarray(r[0]), jnp.asarray([True, True]))
    found, info = filter.update(b, model.sensors[0], m, no_gate(), jnp.asarray(0))
    _, G = model.process.jacobian(model.process.params, x, None, jnp.asarray(1.0))
    s = model.sensors[0]
    H = np.asarray(s.jacobian(s.params, b.mean, m.a))
    A = np.concatenate([H @ np.asarray(G) / SIGMA, np.diag(np.sqrt(weight))])
    d = np.linalg.lstsq(A, np.concatenate([np.asarray(info.residual) / SIGMA, np.zeros(6)]), rcond=None)[0]
    moved = np.asarray(model.retraction.boxminus(found.mean, b.mean))
    np.testing.assert_allclose(moved, np.asarray(G) @ d, atol=1e-9 * np.abs(d).max() + 1e-18)
    assert np.linalg.norm(moved[:3]) > 1e-4


# --- the command -----------------------------------------------------------------------------------------------------


def test_the_command_prints_one_object_of_the_stated_shape(capsys, tmp_path):
    import json

    from helmstar.cli import main

    keys = ["--set", "duration_s=600", "--set", "width=2", "--set", "gyro.loss_start_s=200"]
    code = main(
        ["run", "zhou2021", "--runs", "2", "--estimators", "quest_ekf", *keys, "--out", str(tmp_path), "--json"]
    )
    out = capsys.readouterr().out
    assert code == 0

    def no_constant(name):
        raise AssertionError(name)

    result = json.loads(out, parse_constant=no_constant)
    assert (result["scenario"], result["runs"]) == ("zhou2021", 2)
    m = result["estimators"]["quest_ekf"]
    assert m.keys() == {
        "attitude_rms_deg", "drift_rms_deg_h", "nees_mean", "nees_in_band", "sign_errors", "resets", "rms_over_bound",
        "drift_rms_over_bound", "outage_peak_deg", "star_loss_deg", "recovery_s", "us_per_step",
    }  # fmt: skip
    assert set(m["outage_peak_deg"]) == {
        "none", "zeros", "hold_last", "hold_mean", "hold_mean_raised", "commanded", "both_lost", "rate_state",
    }  # fmt: skip
    assert m["outage_peak_deg"]["rate_state"] is None  # mekf_rate_state did not run
    assert "deg for good within 300 s" in (tmp_path / "report.html").read_text()
    assert m["recovery_s"]["start_179deg"]["runs"] == 2
    assert m["star_loss_deg"] == {}  # 450 s after 200 s have no room in 600 s
    assert (tmp_path / "report.html").stat().st_size > 1e6
    code = main(["run", "zhou2021", "--runs", "2", "--estimators", "quest_ekf", *keys, "--out", str(tmp_path / "two")])
    text = capsys.readouterr().out
    assert code == 0
    assert "quest_ekf" in text
    assert max(map(len, text.splitlines()[:-1])) <= 100
