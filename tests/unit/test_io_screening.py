"""Screening: what is put into clean data is found, in clean data of every kind nothing is."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.io.columns import ColumnsConfiguration
from helmstar.io.screening import find_gaps, screen_gyro
from helmstar.io.telemetry import AttitudeRows, GyroRows, read_telemetry

FLIGHT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "telemetry"
DEG = 180.0 / np.pi
ARCSEC = np.pi / 648000.0
DT = 0.1


def gyro_rows(value, dt=DT):
    n = len(value)
    step = np.concatenate([[np.nan], np.full(n - 1, dt)])
    return GyroRows(dt * np.arange(n), np.zeros(n, int), np.arange(n) + 2, ("g.csv",), value=value, step=step)


def attitude_rows(value, every=20, sigma=1 * ARCSEC, dt=DT):
    """Attitudes of a body with these rates (mean since the row before) and noise of 1 arcsec."""
    rng = np.random.default_rng(9)
    R_BN, out = Rotation.random(rng=rng), []
    for i, w in enumerate(value):
        R_BN = Rotation.from_rotvec(-w * dt) * R_BN
        if i % every == 0:
            out.append((Rotation.from_rotvec(sigma * rng.normal(size=3)) * R_BN).as_quat())
    n = len(out)
    return AttitudeRows(dt * every * np.arange(n), np.zeros(n, int), np.arange(n) + 2, ("a.csv",), q_BN=np.array(out))


NO_ATTITUDE = AttitudeRows(np.empty(0), np.empty(0, int), np.empty(0, int))


def smooth(n=1000):
    t = DT * np.arange(n)
    return 5e-3 * np.stack([np.sin(0.1 * t), np.cos(0.2 * t), 0.5 + 0.1 * np.sin(0.05 * t)], axis=1)


def noisy(n=1000, seed=0, sigma=2e-5):
    return smooth(n) + sigma * np.random.default_rng(seed).normal(size=(n, 3))


def manoeuvres(n=1000):
    value = np.zeros((n, 3)) + 1e-5
    value[200:400, 0], value[500:503, 1], value[700:, 2] = 0.02, 0.01, 1e-5 * DEG
    return value


def triangle(n=1000):
    value = np.zeros((n, 3))
    value[490:511, 0] = 1e-3 * (10 - np.abs(np.arange(-10, 11)))
    return value


CLEAN = {
    "zeros": np.zeros((1000, 3)),
    "constant": np.full((1000, 3), 1e-3),
    "noiseless": smooth(),
    "noisy": noisy(),
    "noise only": noisy() - smooth(),
    "heavy tails": smooth() + 1e-5 * np.random.default_rng(2).standard_t(4, size=(1000, 3)),
    "quantised": np.round(noisy() / 2e-4) * 2e-4,
    "hardly ever off zero": np.round(3e-5 * np.random.default_rng(3).normal(size=(1000, 3)) / 1e-4) * 1e-4,
    "manoeuvres": manoeuvres(),
    "noisy manoeuvres": manoeuvres() + 1e-6 * np.random.default_rng(4).normal(size=(1000, 3)),
    "triangle": triangle(),
    "drift far above the rate": noisy() * 1e-3 + np.array([100, -50, 25]) * ARCSEC,
    "few rows": smooth(3),
}


@pytest.mark.parametrize("name", CLEAN)
@pytest.mark.parametrize("with_attitude", [True, False])
def test_clean_data_raise_no_alarm(name, with_attitude):
    value = CLEAN[name]
    drift = np.array([100, -50, 25]) * ARCSEC if name.startswith("drift") else 0.0
    attitude = attitude_rows(value - drift) if with_attitude else NO_ATTITUDE
    screened, problems = screen_gyro(gyro_rows(value), attitude, "instant")
    assert problems == []
    np.testing.assert_array_equal(screened.value, value)


@pytest.mark.parametrize("base", ["constant", "noiseless", "noisy", "quantised", "noisy manoeuvres"])
@pytest.mark.parametrize("with_attitude", [True, False])
def test_spikes_are_dropped_and_named(base, with_attitude):
    value = CLEAN[base].copy()
    attitude = attitude_rows(value) if with_attitude else NO_ATTITUDE
    value[100, 0] += 0.05
    value[620] -= 0.3
    screened, problems = screen_gyro(gyro_rows(value), attitude, "instant")
    assert [(p.file, p.row, p.kind, p.action) for p in problems] == [
        ("g.csv", 102, "jump", "dropped"),
        ("g.csv", 622, "jump", "dropped"),
    ]
    np.testing.assert_array_equal(screened.value, np.delete(value, [100, 620], axis=0))


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_a_jerk_that_the_attitudes_confirm_is_kept(drift):
    value = noisy()
    value[500, 1] += 0.05
    drifting = value + drift * np.array([1000, -500, 250]) * ARCSEC
    _, problems = screen_gyro(gyro_rows(drifting), attitude_rows(value), "mean_since_previous")
    assert problems == []


@pytest.mark.parametrize("factor", [DEG, 1 / DEG])
@pytest.mark.parametrize("rows", [slice(300, 301), slice(300, 312)])
@pytest.mark.parametrize("with_attitude", [True, False])
def test_rows_in_the_wrong_unit_are_dropped(factor, rows, with_attitude):
    value = smooth() + 1e-6 * np.random.default_rng(5).normal(size=(1000, 3))
    attitude = attitude_rows(value) if with_attitude else NO_ATTITUDE
    value[rows] *= factor
    screened, problems = screen_gyro(gyro_rows(value), attitude, "instant")
    assert [p.row for p in problems] == list(range(rows.start + 2, rows.stop + 2))
    assert {(p.kind, p.action) for p in problems} == {("unit", "dropped")}
    np.testing.assert_array_equal(screened.value, np.delete(value, np.arange(1000)[rows], axis=0))


def test_a_unit_that_changes_for_good_is_judged_by_the_attitudes():
    value = noisy(sigma=1e-6)
    attitude = attitude_rows(value)
    value[400:] *= DEG  # the greater part of the rows
    screened, problems = screen_gyro(gyro_rows(value), attitude, "instant")
    assert (problems[0].row, len(screened)) == (402, 400)
    assert screen_gyro(gyro_rows(value), NO_ATTITUDE, "instant")[1] == []


def test_a_slew_that_is_57_times_as_fast_is_kept_if_attitudes_confirm_it():
    value = np.full((1000, 3), 1e-4)
    value[400:600] *= DEG
    assert screen_gyro(gyro_rows(value), attitude_rows(value), "instant")[1] == []


@pytest.mark.parametrize("factor", [DEG, 1 / DEG])
@pytest.mark.parametrize("reading", ["instant", "mean_since_previous", "increment_rad"])
@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_a_whole_file_in_the_wrong_unit_is_converted_loudly(factor, reading, drift):
    value = noisy() + drift * np.array([100, -50, 25]) * ARCSEC
    scale = DT if reading == "increment_rad" else 1.0
    screened, problems = screen_gyro(gyro_rows(value * factor * scale), attitude_rows(noisy()), reading)
    assert [(p.kind, p.action, p.row, p.rows) for p in problems] == [("unit", "converted", 2, 1000)]
    assert ('gyro_unit = "deg/s"' if factor > 1 else 'gyro_unit = "rad/s"') in problems[0].message
    assert "rows 2 to 1001" in problems[0].message
    np.testing.assert_allclose(screened.value, value * scale, rtol=1e-12)


def test_a_constant_rate_in_the_wrong_unit():
    value = np.full((1000, 3), 1e-3)
    _, problems = screen_gyro(gyro_rows(value * DEG), attitude_rows(value), "instant")
    assert [p.action for p in problems] == ["converted"]


def test_motion_below_the_noise_is_not_judged():
    value = 1e-7 * smooth()
    assert screen_gyro(gyro_rows(value * DEG), attitude_rows(value), "instant")[1] == []


def test_rates_that_no_body_has_are_dropped_and_counted():
    value = noisy()
    value[:1] *= 1e9
    value[10:20, 1] = 1.1e3
    kept, problems = screen_gyro(gyro_rows(value), NO_ATTITUDE, "instant")
    assert (len(kept), sum(p.rows for p in problems)) == (989, 11)
    assert {(p.kind, p.action) for p in problems} == {("too_fast", "dropped")}
    assert "1100 rad/s" in problems[1].message
    kept, problems = screen_gyro(gyro_rows(np.full((5000, 3), 1e11)), NO_ATTITUDE, "increment_rad")
    assert (len(kept), sum(p.rows for p in problems)) == (0, 5000)
    assert len(problems) < 1100  # the many are summed up


def test_gaps():
    time = np.concatenate([np.arange(10), np.arange(12.5, 20), np.arange(30, 35)])
    assert [(gap.start, gap.end, gap.duration) for gap in find_gaps(time)] == [(9, 12.5, 3.5), (19.5, 30, 10.5)]
    assert find_gaps(np.array([0.0, 3.0, 6.0])) == []
    assert find_gaps(np.array([])) == find_gaps(np.array([1.0])) == find_gaps(np.array([1.0, 9.0])) == []


@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["mro_psp001446.csv", "dawn_fc_150615.csv"])
def test_flight_data_raise_no_alarm_and_wrong_units_are_found(name):
    if not (FLIGHT / name).exists():
        pytest.skip(f"{FLIGHT / name} is not here; it is not part of the repository")
    columns = ColumnsConfiguration(
        time="sclk_s",
        gyro=["wx_base", "wy_base", "wz_base"],
        gyro_frame="base",
        quaternion=["q0", "q1", "q2", "q3"],
        quaternion_order="wxyz",
    )
    telemetry = read_telemetry([FLIGHT / name], columns)
    gyro, attitude = telemetry.gyro, telemetry.attitude
    every_10_s = attitude.select(np.unique(np.searchsorted(attitude.time, np.arange(0.0, attitude.time[-1], 10.0))))
    drifting = gyro.value + np.array([100, -50, 25]) * ARCSEC
    for value in (gyro.value, drifting):
        for known in (every_10_s, NO_ATTITUDE):
            assert screen_gyro(with_value(gyro, value), known, "instant")[1] == []
        for factor in (DEG, 1 / DEG):
            _, problems = screen_gyro(with_value(gyro, value * factor), every_10_s, "instant")
            assert [(p.kind, p.action) for p in problems] == [("unit", "converted")]
        spoilt = value.copy()
        spoilt[-300:-295] *= DEG  # both spacecraft turn there
        _, problems = screen_gyro(with_value(gyro, spoilt), every_10_s, "instant")
        assert [(p.row, p.kind) for p in problems] == [(row, "unit") for row in gyro.row[-300:-295]]


def with_value(gyro, value):
    return GyroRows(gyro.time, gyro.file, gyro.row, gyro.files, value=value, step=gyro.step)
