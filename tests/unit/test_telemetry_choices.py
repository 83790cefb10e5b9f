"""`helmstar attitude` with choices: gyro loss policies, restart, and the gyro's calibration; on records of known truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from telemetry_simulator import ARCSEC, Setup, constant, cruise, slews
from telemetry_solving import solve_setup

from helmstar.core import RESET
from helmstar.errors import ConfigurationError
from helmstar.sensors.configuration import load_sensors

BASE = Setup(duration_s=400.0, gyro_hz=5.0, star_every_s=2.0)
LOSS = (200.0, 260.0)


def lossy(policy: str, tmp_path, rate=cruise, more: str = "", **changes):
    setup = replace(BASE, gyro_gaps=(LOSS,), rate=rate, **changes)
    return solve_setup(setup, tmp_path, gyro=f'loss_policy = "{policy}"\n{more}')


def in_loss(run, kind="filtered"):
    """Attitude errors (arcsec) and NEES per degree of freedom at the stars within the loss."""
    here = (run.time > LOSS[0] + 1) & (run.time < LOSS[1])
    angle = np.linalg.norm(run.attitude_error(kind), axis=1)[here] / ARCSEC
    return angle, run.attitude_nees(kind)[here].mean() / 3.0


@pytest.mark.parametrize("policy", ["interpolate", "hold_last", "hold_mean", "hold_mean_raised", "rate_state"])
def test_a_bridged_loss_keeps_the_attitude_within_its_covariance(tmp_path, policy):
    run = lossy(policy, tmp_path)
    angle, nees = in_loss(run)
    assert run.result["rows_rejected"] == 0
    assert angle.max() < 40.0  # stars of 3 arcsec every 2 s, a rate that changes by some arcsec/s a minute
    assert nees < 3.0
    assert [gap["what"] for gap in run.result["gaps"]] == ["gyro"]
    error = np.array(run.result["drift_arcsec_s"]) * ARCSEC - run.record.drift(run.time[-1:])[0]
    assert (error / ARCSEC / run.result["drift_sigma_arcsec_s"]) @ (
        error / ARCSEC / run.result["drift_sigma_arcsec_s"]
    ) < chi2.isf(1e-5, 3)


def test_zeros_as_data_are_the_mistake_they_are(tmp_path):
    """The stars no longer agree with what is taken for a gyro: they are refused, and the attitude is off by what was turned."""
    run = lossy("zeros", tmp_path, rate=constant((0.2, 0.0, 0.0)))
    angle, _ = in_loss(run)
    assert run.result["rows_rejected"] > 3
    assert angle.max() > 1000.0
    good = lossy("hold_mean", tmp_path, rate=constant((0.2, 0.0, 0.0)))
    assert in_loss(good)[0].max() < 20.0
    assert good.result["rows_rejected"] == 0


def test_a_commanded_rate_has_no_drift(tmp_path):
    rate = (0.2, -0.1, 0.05)
    more = f"commanded_rate_deg_s = {list(rate)}\ncommand_error = 0.0001"
    drift = (500.0, -300.0, 200.0)  # held rates have it, commanded ones do not
    run = lossy("commanded", tmp_path, constant(rate), more, drift_arcsec_s=drift)
    assert run.result["rows_rejected"] == 0
    assert in_loss(run)[0].max() < 10.0
    assert run.drift_nees("filtered")[-1] < chi2.isf(1e-5, 3)


def test_the_rate_as_a_state_ties_with_the_gyro_as_input_where_there_is_one(tmp_path):
    """Of 9 states as of 6, as long as nothing is lost: the gyro tells the rate far better than its random walk."""
    setup = replace(BASE, rate=slews())
    plain, rated = solve_setup(setup, tmp_path), solve_setup(setup, tmp_path, gyro='loss_policy = "rate_state"')
    for kind in ("filtered", "smoothed"):
        a, b = getattr(plain.solution, kind), getattr(rated.solution, kind)
        off = plain.record.attitude_error(plain.time, a.q_BN) - rated.record.attitude_error(rated.time, b.q_BN)
        sigma = np.sqrt(np.diagonal(a.cov[:, :3, :3], axis1=1, axis2=2))
        assert np.max(np.abs(off) / sigma) < 0.1


def test_a_restart_follows_an_upset_at_once(tmp_path):
    setup = replace(BASE, upset_s=201.0)
    run = solve_setup(setup, tmp_path, filter="restart = true\nreopen_after = 3")
    assert run.result["restarts"] == 1
    status = run.solution.updates.status
    at = run.time[run.solution.updates.index[np.flatnonzero(status == RESET)[0]]]
    assert at == pytest.approx(206.0, abs=0.1)  # the third refusal: 202, 204, 206 s
    angle = np.linalg.norm(run.attitude_error("filtered"), axis=1) / ARCSEC
    assert angle[run.time > at].max() < 20.0
    assert angle[run.time < 201.0][20:].max() < 20.0
    smooth = np.linalg.norm(run.attitude_error("smoothed"), axis=1) / ARCSEC
    # What is known after the restart says nothing of the time before it, and the other way round.
    assert smooth[run.time < 200.9].max() < 20.0
    assert smooth[run.time > at].max() < 20.0
    assert "restarted" in run.result["problems"][-1]["action"]
    without = solve_setup(setup, tmp_path)
    assert without.result["restarts"] == 0


MU, SCALE = (600.0, -900.0, 300.0), (2000.0, -1500.0, 3000.0)
CALIBRATE = "\n[calibrate]\nmisalignment = true\nscale_factor = true"


def test_misalignment_and_scale_factors_come_back_in_slews(tmp_path):
    setup = replace(BASE, rate=slews(80.0, 40.0, 1.0), misalignment_arcsec=MU, scale_ppm=SCALE)
    merit = []
    for seed in range(4):
        run = solve_setup(replace(setup, seed=seed), tmp_path, filter=CALIBRATE)
        found = run.result["calibration"]
        for name, truth in (("misalignment_arcsec", MU), ("scale_factor_ppm", SCALE)):
            c = found[name]
            assert c["observable"] == [True] * 3
            merit += list((np.array(c["value"]) - truth) / c["sigma"])
            assert np.max(np.abs(np.array(c["value"]) - truth) / np.abs(truth)) < 0.15
        assert run.result["rows_rejected"] == 0
        assert 2.5 < run.result["nis_mean"] < 3.5
        error = run.record.drift(run.time[-1:])[0] - run.solution.filtered.drift[-1]
        cov = run.solution.filtered.cov[-1, 3:, 3:]
        assert error @ np.linalg.solve(cov, error) < chi2.isf(1e-5, 3)
    # 24 errors in units of their sigma, six of them a run and correlated.
    assert 0.3 < np.mean(np.square(merit)) < 2.2


@pytest.mark.parametrize("rate", [slews(80.0, 40.0, 1.0), slews(80.0, 40.0, 1.0, constant((0.0, 0.0, 0.5)))])
def test_calibrations_are_off_by_as_much_as_they_say(tmp_path, rate):
    setup = Setup(duration_s=600.0, gyro_hz=2.0, star_every_s=5.0, rate=rate, misalignment_arcsec=MU, scale_ppm=SCALE)
    squares, drift = [], []
    for seed in range(6):
        run = solve_setup(replace(setup, seed=10 + seed), tmp_path, filter=CALIBRATE)
        for name, truth in (("misalignment_arcsec", MU), ("scale_factor_ppm", SCALE)):
            c = run.result["calibration"][name]
            squares.append((np.subtract(c["value"], truth) / c["sigma"]) ** 2)
        drift.append(run.drift_nees("filtered")[-1])
    # The six numbers of a run are hardly correlated; the band of 36 is that of 1e-4 on each side, with some for that.
    low, high = chi2.ppf(1e-4, 36) / 36, chi2.isf(1e-4, 36) / 36
    assert 0.8 * low < np.mean(squares) < 1.2 * high
    assert chi2.ppf(1e-4, 18) / 6 < np.mean(drift) < chi2.isf(1e-4, 18) / 6


@pytest.mark.parametrize("rate_deg_s", [(0.0, 0.0, 1.0), (1.0, 2.0, 5.5)])
def test_a_constant_spin_shows_nothing_of_a_calibration(tmp_path, rate_deg_s):
    """Misalignment and scale factors look like drift there, whatever the rate; what is not known of them counts in drift."""
    setup = Setup(
        duration_s=600.0, gyro_hz=2.0, star_every_s=5.0, rate=constant(rate_deg_s), misalignment_arcsec=MU,
        scale_ppm=SCALE,
    )  # fmt: skip
    for seed, more in ((0, ""), (1, ""), (2, "initial_drift_sigma_arcsec_s = 1000")):
        run = solve_setup(replace(setup, seed=seed), tmp_path, gyro=more, filter=CALIBRATE)
        for c in run.result["calibration"].values():
            assert c["observable"] == [False] * 3
        assert run.result["rows_rejected"] == 0
        assert run.drift_nees("filtered")[-1] < chi2.isf(1e-4, 3)
        # 1% of the rate, which is the scale factors' sigma, is far more than what is known of the drift itself.
        assert np.max(run.result["drift_sigma_arcsec_s"]) > 0.002 * max(rate_deg_s) * 3600


def test_an_upset_is_followed_with_a_calibration_too(tmp_path):
    setup = Setup(
        duration_s=600.0, gyro_hz=2.0, star_every_s=5.0, rate=slews(80.0, 40.0, 1.0), misalignment_arcsec=MU,
        scale_ppm=SCALE, upset_s=301.0,
    )  # fmt: skip
    run = solve_setup(setup, tmp_path, filter=CALIBRATE)
    late = run.time > 400.0
    assert np.linalg.norm(run.attitude_error("filtered"), axis=1)[late].max() < 60.0 * ARCSEC
    for name, truth in (("misalignment_arcsec", MU), ("scale_factor_ppm", SCALE)):
        c = run.result["calibration"][name]
        assert np.all(np.abs(np.subtract(c["value"], truth)) < 5 * np.array(c["sigma"]))


def test_what_lies_between_an_upset_and_a_restart_is_doubted(tmp_path):
    run = solve_setup(replace(BASE, upset_s=201.0), tmp_path, filter="restart = true\nreopen_after = 3")
    for kind in ("filtered", "smoothed"):
        nees = run.attitude_nees(kind) / 3.0
        assert nees[(run.time > 201.5) & (run.time < 206.0)].max() < 3.0
        assert nees[(run.time > 30.0) & (run.time < 199.0)].mean() < 2.0


def test_a_random_walk_too_small_for_the_record_is_refused(tmp_path):
    setup = replace(BASE, rate=slews())
    with pytest.raises(ConfigurationError, match=r"rate_sigma_deg_s = 0\.0001: the record's rate changes by up to"):
        solve_setup(setup, tmp_path, gyro='loss_policy = "rate_state"\nrate_sigma_deg_s = 0.0001')


def test_exported_rates_are_those_of_the_attitude(tmp_path):
    """Commanded over a gap, the rate as a state, and calibrated: the rate that goes into a CK is that of the body."""
    from helmstar.telemetry.export import body_rate

    rate = (0.2, -0.1, 0.05)
    more = f'loss_policy = "commanded"\ncommanded_rate_deg_s = {list(rate)}\ncommand_error = 0.0001'
    cases = [
        (replace(BASE, gyro_gaps=(LOSS,), rate=constant(rate), drift_arcsec_s=(500.0, -300.0, 200.0)), {"gyro": more}),
        (replace(BASE, gyro_gaps=(LOSS,)), {"gyro": 'loss_policy = "rate_state"'}),
        (replace(BASE, rate=slews(80.0, 40.0, 1.0), misalignment_arcsec=MU, scale_ppm=SCALE), {"filter": CALIBRATE}),
    ]
    for setup, extra in cases:
        run = solve_setup(setup, tmp_path, **extra)
        found = body_rate(run.time, run.solution.smoothed.q_BN)
        inside = slice(5, -5)
        # A step of 0.2 s holds arcseconds of star noise in a loss, and gyro noise elsewhere.
        off = np.linalg.norm(found - setup.rate(run.time), axis=1)[inside]
        assert np.median(off) < 3.0 * ARCSEC
        assert off.max() < 150.0 * ARCSEC


def test_without_calibration_the_same_record_is_inconsistent(tmp_path):
    setup = replace(BASE, rate=slews(80.0, 40.0, 1.0), misalignment_arcsec=MU, scale_ppm=SCALE)
    plain = solve_setup(setup, tmp_path)
    assert plain.result["rows_rejected"] > 5
    assert "calibration" not in plain.result


def test_what_a_record_does_not_show_is_not_estimated(tmp_path):
    """A turn about x alone: it shows the scale factor of x and misalignments about y and z, and nothing about x, y, z else."""
    rate = lambda t: constant((1.0, 0.0, 0.0))(t) * np.clip(np.asarray(t) / 100.0 - 1.0, -1.0, 1.0)[..., None]
    setup = replace(BASE, rate=rate, misalignment_arcsec=MU, scale_ppm=SCALE)
    run = solve_setup(setup, tmp_path, filter=CALIBRATE)
    c = run.result["calibration"]
    assert c["misalignment_arcsec"]["observable"] == [False, True, True]
    assert c["scale_factor_ppm"]["observable"] == [True, False, False]
    assert c["misalignment_arcsec"]["value"][0] is None
    for name, i, truth in (
        ("misalignment_arcsec", 1, MU[1]),
        ("misalignment_arcsec", 2, MU[2]),
        ("scale_factor_ppm", 0, SCALE[0]),
    ):
        assert abs(c[name]["value"][i] - truth) < 5 * c[name]["sigma"][i] + 0.02 * abs(truth)
    assert 2.3 < run.result["nis_mean"] < 3.7


def test_a_still_body_shows_nothing_and_nothing_is_lost(tmp_path):
    setup = replace(BASE, rate=constant((0.0, 0.0, 0.0)))
    plain = solve_setup(setup, tmp_path)
    run = solve_setup(setup, tmp_path, filter=CALIBRATE)
    for c in run.result["calibration"].values():
        assert c["observable"] == [False] * 3
        assert c["value"] == [None] * 3
    # What is not known of scale factors is a percent of the rates, which are noise and drift here.
    np.testing.assert_allclose(run.result["drift_arcsec_s"], plain.result["drift_arcsec_s"], rtol=1e-3)
    np.testing.assert_allclose(run.result["drift_sigma_arcsec_s"], plain.result["drift_sigma_arcsec_s"], rtol=0.1)


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ('[gyro]\nloss_policy = "commanded"', ["commanded_rate_deg_s"]),
        ('[gyro]\nloss_policy = "hope"', ["gyro.loss_policy", "hold_mean"]),
        ('[gyro]\nloss_policy = "rate_state"\n[calibrate]\nscale_factor = true', ["rate_state", "calibrate"]),
        ("[calibrate]\nmisalignment_sigma_deg = 50", ["calibrate.misalignment_sigma_deg", "<= 10"]),
        ("[filter]\nrestart = 1", ["filter.restart"]),
    ],
)
def test_wrong_choices_are_named(tmp_path, toml, words):
    (tmp_path / "sensors.toml").write_text(toml)
    with pytest.raises(ConfigurationError) as e:
        load_sensors(tmp_path / "sensors.toml")
    for word in words:
        assert word in str(e.value)
