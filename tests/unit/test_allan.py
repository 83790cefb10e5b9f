"""Allan deviation of gyro data: allantools, theory and simulated noise agree; tables at rest and in flight are read."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import helmstar.report.allan as report_allan
from helmstar.errors import ConfigurationError, DataError
from helmstar.evaluate.allan import AllanCurve, allan_deviation, fit_allan, variance_covariance
from helmstar.sensors.configuration import load_sensors
from helmstar.telemetry.allan import run_allan

ARCSEC = math.pi / 648000.0
GYRO = ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]
Q_BN = ["q_bn_x", "q_bn_y", "q_bn_z", "q_bn_w"]


def noise(rng, n, dt, arw=0.0, rrw=0.0, angle=0.0):
    """Mean rates (n,) over steps of dt: white noise, the exact means of a random walk, differences of a white angle."""
    step = rrw * math.sqrt(dt) * rng.standard_normal(n)
    walk = np.cumsum(step) - 0.5 * step + rrw * math.sqrt(dt / 12.0) * rng.standard_normal(n)
    return arw / math.sqrt(dt) * rng.standard_normal(n) + walk + np.diff(angle * rng.standard_normal(n + 1)) / dt


# ----------------------------------------------------------------------------- the curve


def test_the_curve_is_allantools_own():
    import allantools

    rate = noise(np.random.default_rng(1), 3000, 0.25, 1.0, 0.05) + 7.0
    curve = allan_deviation(rate, 0.25)
    tau, adev, _, n = allantools.oadev(rate, rate=4.0, data_type="freq", taus=curve.tau_s)
    np.testing.assert_allclose(curve.tau_s, tau, rtol=1e-14)
    np.testing.assert_allclose(curve.adev, adev, rtol=1e-9)  # allantools keeps the mean, 7, in its sums
    np.testing.assert_array_equal(curve.n, n)


def test_stretches_are_pooled_by_their_squares():
    rate = noise(np.random.default_rng(2), 900, 1.0, 1.0)
    parts = [rate[:400], rate[400:700], rate[700:900]]
    both = allan_deviation(parts, 1.0)
    m = 16
    squares = np.concatenate(
        [(x[2 * m :] - 2 * x[m:-m] + x[: -2 * m]) ** 2 for x in (np.cumsum([0, *part]) for part in parts)]
    )
    at = both.m.tolist().index(m)
    assert both.n[at] == len(squares)
    assert both.adev[at] == pytest.approx(math.sqrt(squares.mean() / 2.0) / m, rel=1e-10)
    np.testing.assert_array_equal(allan_deviation([*parts, rate[:2], rate[:0]], 1.0).adev, both.adev)  # say nothing
    whole = allan_deviation(rate, 1.0)
    assert 0.6 * whole.edf[at] < both.edf[at] < whole.edf[at]


@pytest.mark.parametrize(("kind", "slope"), [("angle", -1.0), ("arw", -0.5), ("rrw", 0.5)])
def test_slopes(kind, slope):
    curve = allan_deviation(noise(np.random.default_rng(3), 200_000, 1.0, **{kind: 1.0}), 1.0)
    few = slice(0, 9)  # up to 256 s; there the variance has 1000 degrees of freedom, so 2% of the deviation
    assert np.polyfit(np.log(curve.tau_s[few]), np.log(curve.adev[few]), 1)[0] == pytest.approx(slope, abs=0.02)
    constant = {"angle": math.sqrt(3.0), "arw": 1.0, "rrw": math.sqrt(1.0 / 3.0)}[kind]
    off = curve.adev / (constant * curve.tau_s**slope) - 1.0
    assert np.all(np.abs(off) < 4.0 / np.sqrt(2.0 * curve.edf))


@pytest.mark.parametrize(("squares", "alpha"), [((0, 1, 0, 0), 0), ((0, 0, 1, 0), -1), ((0, 0, 0, 1), -2)])
def test_the_covariance_has_the_known_degrees_of_freedom(squares, alpha):
    """By hand at the shortest tau; NIST SP 1065's formula for white noise, Greenhall's for flicker and walk."""
    from allantools.ci import edf_greenhall, edf_simple

    m, n = 2 ** np.arange(9), 2000
    tau, terms = m * 0.5, n + 1 - 2 * m
    curve = AllanCurve(tau, np.ones(9), np.ones(9), terms, np.ones(9), m, (n,), 0.5)
    variance = squares[1] / tau + squares[2] * 2 * math.log(2) / math.pi + squares[3] * tau / 3
    edf = 2.0 * variance**2 / np.diag(variance_covariance(curve, np.array(squares, dtype=float)))
    if alpha == 0:
        np.testing.assert_allclose(edf[:8], [edf_simple(n + 1, int(k), 0) for k in m[:8]], rtol=0.02)
    else:  # approximations, rough at short tau
        expected = [float(edf_greenhall(alpha, 2, int(k), n + 1, overlapping=True)) for k in m[3:]]
        np.testing.assert_allclose(edf[3:], expected, rtol=0.02)
    if alpha != -1:  # neighbouring differences have correlation -1/2 (white) and 1/4 (means of a walk)
        assert edf[0] == pytest.approx(n / (1.0 + 2.0 * {0: 0.5, -2: 0.25}[alpha] ** 2), rel=2e-3)


# ----------------------------------------------------------------------------- the fit


def test_noise_comes_back_with_honest_errors():
    """25 series of N and K together: mean within 3.5 sigma of the mean, spread as claimed (known to 14%; 4 sigma)."""
    rng = np.random.default_rng(4)
    truth = {"arw": 2e-6, "rrw": 2e-7}
    fits = [fit_allan(allan_deviation(noise(rng, 8000, 0.5, **truth), 0.5)) for _ in range(25)]
    for name, true in truth.items():
        value = np.array([getattr(fit, name) for fit in fits])
        error = np.array([getattr(fit, name + "_error") for fit in fits])
        z = (value - true) / error
        assert abs(z.mean()) < 3.5 / 5.0
        assert 0.44 < z.std() < 1.56
        assert error.max() < 0.2 * true
    assert sum(fit.bias_instability is not None or fit.quantisation is not None for fit in fits) <= 3
    assert all(fit.chance > 1e-4 for fit in fits)


def test_what_is_not_there_is_none():
    """White noise alone: of 30 series at most 4 get a walk or a floor (3% expected: more have a chance of 1e-3)."""
    rng = np.random.default_rng(5)
    fits = [fit_allan(allan_deviation(noise(rng, 4000, 0.1, arw=1e-5), 0.1)) for _ in range(30)]
    false = [f for f in fits if (f.rrw, f.bias_instability, f.quantisation) != (None, None, None)]
    assert len(false) <= 4
    assert all(f.arw is not None and abs(f.arw / 1e-5 - 1.0) < 0.06 for f in fits)  # 4.5 sigma of 1.2%
    assert all(f.rrw_limit > 0.0 and f.rrw_error is None for f in fits if f.rrw is None)


def test_each_term_alone_and_angle_noise_beside_white_noise():
    rng = np.random.default_rng(6)
    walk = fit_allan(allan_deviation(noise(rng, 8000, 1.0, rrw=3.0), 1.0))
    assert (walk.arw, walk.quantisation) == (None, None)
    assert walk.rrw == pytest.approx(3.0, abs=4.5 * walk.rrw_error)
    both = fit_allan(allan_deviation(noise(rng, 8000, 0.1, arw=1.0, angle=1.0), 0.1))
    assert both.quantisation == pytest.approx(1.0, abs=4.5 * both.quantisation_error)
    assert both.arw == pytest.approx(1.0, abs=4.5 * both.arw_error)


def test_a_walk_sampled_at_instants_is_not_taken_for_white_noise():
    rate = np.cumsum(np.random.default_rng(7).standard_normal(20_000))
    fit = fit_allan(allan_deviation(rate, 1.0, instant=True))
    assert fit.arw is None
    assert fit.rrw == pytest.approx(1.0, abs=4.5 * fit.rrw_error)


def test_misuse():
    with pytest.raises(ValueError, match="at least 50"):
        allan_deviation(np.zeros(49), 1.0)
    with pytest.raises(ValueError, match="positive"):
        allan_deviation(np.zeros(99), 0.0)
    with pytest.raises(ValueError, match="finite"):
        allan_deviation(np.full(99, np.nan), 1.0)
    with pytest.raises(ValueError, match="do not vary"):
        fit_allan(allan_deviation(np.ones(99), 1.0))


# ----------------------------------------------------------------------------- the command


def at_rest(n=4000, dt=0.1, seed=10, arw=0.5 * ARCSEC, rrw=0.0, columns=GYRO):
    rng = np.random.default_rng(seed)
    rates = {name: 1e-4 + noise(rng, n, dt, arw, rrw) for name in columns}
    return pd.DataFrame({"time_s": 50.0 + dt * np.arange(n), **rates})


def command(tmp_path, table, config="", strict=False):
    file = tmp_path / "gyro.csv"
    file.write_text(table.to_csv(index=False))
    (tmp_path / "config.toml").write_text(config)
    result, report = run_allan(
        [file], config=tmp_path / "config.toml", folder=tmp_path / "out", strict=strict, command="helmstar allan"
    )
    json.dumps(result, allow_nan=False)
    assert report == tmp_path / "out" / "report.html"
    return result


@pytest.fixture(autouse=True)
def quick_report(monkeypatch, request):
    """The page has tests of its own; one test here writes it."""
    if "whole" not in request.node.name:
        monkeypatch.setattr(report_allan, "write_allan_report", lambda result, path: path)


def test_the_whole_command_and_its_file_for_the_filter(tmp_path):
    result = command(tmp_path, at_rest(20_000, rrw=0.02 * ARCSEC))
    assert (tmp_path / "out" / "report.html").stat().st_size > 1000
    # One axis has N to 0.6% and K to 15%; the rms of three to 0.35% and 9%; 4.5 sigma are allowed.
    assert result["arw_arcsec_sqrt_s"] == pytest.approx(0.5, rel=0.016)
    assert result["rrw_arcsec_s_sqrt_s"] == pytest.approx(0.02, rel=0.4)
    assert result["warnings"] == []
    assert result["basis"] == "gyro"
    assert (result["samples"], result["rows_rejected"], result["problems"], result["gaps"]) == (20_000, 0, [], [])
    assert result["period_s"] == pytest.approx(0.1, rel=1e-9)
    sensors = load_sensors(tmp_path / "out" / "sensors.toml")
    assert sensors.gyro.arw == pytest.approx(result["arw_arcsec_sqrt_s"] * ARCSEC, rel=1e-6)
    assert sensors.gyro.rrw == pytest.approx(result["rrw_arcsec_s_sqrt_s"] * ARCSEC, rel=1e-6)
    assert (tmp_path / "out" / "sensors.toml").read_text() == result["sensors_toml"]
    table = pd.read_csv(tmp_path / "out" / "allan.csv")
    np.testing.assert_allclose(table["tau_s"], result["axes"]["y"]["tau_s"], rtol=1e-8)
    np.testing.assert_allclose(table["adev_y_arcsec_s"], result["axes"]["y"]["adev_arcsec_s"], rtol=1e-8)


def test_units_by_hand(tmp_path):
    """1 arcsec/sqrt(s) = 60/3600 deg/sqrt(h); 1 arcsec/s/sqrt(s) = 1 deg/h per sqrt(s) = 60 deg/h/sqrt(h)."""
    result = command(tmp_path, at_rest(rrw=0.3 * ARCSEC))
    assert result["arw_deg_sqrt_h"] == pytest.approx(result["arw_arcsec_sqrt_s"] / 60.0, rel=1e-12)
    assert result["rrw_deg_h_sqrt_h"] == pytest.approx(result["rrw_arcsec_s_sqrt_s"] * 60.0, rel=1e-12)
    table = at_rest(rrw=0.3 * ARCSEC, columns=["gyro_x_deg_h", "gyro_y_deg_h", "gyro_z_deg_h"])
    table.iloc[:, 1:] *= 180.0 / math.pi * 3600.0
    assert command(tmp_path, table)["arw_arcsec_sqrt_s"] == pytest.approx(result["arw_arcsec_sqrt_s"], rel=1e-9)


def test_increments_and_rates_and_means_agree(tmp_path):
    table = at_rest(3000)
    config = '[gyro]\nreading = "{}"\n'
    mean = command(tmp_path, table, config.format("mean_since_previous"))
    increments = table.copy()
    increments[GYRO] *= 0.1
    by_reading = command(tmp_path, increments, config.format("increment_rad"))
    by_name = command(tmp_path, increments.rename(columns=lambda name: name.replace("_rad_s", "_rad")))
    for other in (by_reading, by_name):
        for axis in "xyz":
            np.testing.assert_allclose(
                other["axes"][axis]["adev_arcsec_s"], mean["axes"][axis]["adev_arcsec_s"], rtol=1e-7
            )
    assert load_sensors(tmp_path / "out" / "sensors.toml").gyro.arw is not None
    assert 'reading = "mean_since_previous"' in mean["sensors_toml"]
    assert command(tmp_path, table)["arw_arcsec_sqrt_s"] == pytest.approx(mean["arw_arcsec_sqrt_s"], rel=1e-6)


def test_gaps_split_and_single_missing_rows_are_filled(tmp_path):
    table = at_rest(6000)
    holes = [700, 1900, 4001]
    kept = table.drop(index=[*range(2000, 2500), *holes])
    result = command(tmp_path, kept)
    assert result["stretches"] == [2000, 3500]
    assert [round(g["duration_s"], 6) for g in result["gaps"]] == [50.1]
    assert result["gaps"][0]["start_s"] == pytest.approx(249.9)
    assert any("3 missing rows filled" in text for text in result["sampling"])
    assert result["arw_arcsec_sqrt_s"] == pytest.approx(0.5, rel=0.03)  # 0.6% per 4.5 sigma, rms of three axes
    longer = table.copy()
    longer.loc[longer.index >= 2500, "time_s"] += 1e4  # a gap must not add time, nor squares across it
    assert command(tmp_path, longer.drop(index=range(2000, 2500)))["stretches"] == [2000, 3500]


def test_an_irregular_period_is_resampled_and_said(tmp_path):
    table = at_rest(20_000)
    rng = np.random.default_rng(11)
    step = rng.uniform(0.05, 0.15, len(table))
    table["time_s"] = np.cumsum(step)
    rate = 0.5 * ARCSEC / np.sqrt(step)[:, None] * rng.standard_normal((len(table), 3))
    table[GYRO] = rate
    result = command(tmp_path, table, '[gyro]\nreading = "mean_since_previous"\n')
    assert "constant period" in result["warnings"][0]
    assert result["period_s"] == pytest.approx(0.8, rel=0.02)
    # Up to 3% low by interpolation; 1.3% is 1 sigma of the rms of three axes with 2500 samples each.
    assert 0.5 * 0.92 < result["arw_arcsec_sqrt_s"] < 0.5 * 1.05
    little = at_rest(4000)
    little["time_s"] += rng.uniform(-0.005, 0.005, 4000)
    assert command(tmp_path, little)["warnings"] == []


def test_motion_is_taken_out_by_attitudes_and_warned_of_without(tmp_path):
    """Slews of 0.3 deg/s, 0.5 arcsec/sqrt(s): gyro alone cannot know; with exact attitudes N comes back."""
    n, dt = 6000, 0.1
    rng = np.random.default_rng(12)
    t = dt * np.arange(n)
    w = 5e-3 * np.stack([np.sin(0.02 * t), np.cos(0.05 * t), np.sin(0.013 * t + 1.0)], axis=1)
    q, turn = [Rotation.random(rng=rng)], Rotation.from_rotvec(-0.5 * dt * (w[1:] + w[:-1]))
    for k in range(n - 1):
        q.append(turn[k] * q[-1])
    q_BN = np.array([one.as_quat() for one in q])
    gyro = w + 3e-4 + 0.5 * ARCSEC / math.sqrt(dt) * rng.standard_normal((n, 3))
    table = pd.DataFrame({"time_s": t, **dict(zip(GYRO, gyro.T))})
    moving = command(tmp_path, table)
    assert any("motion" in text for text in moving["warnings"])
    table = table.assign(**dict(zip(Q_BN, q_BN.T)))
    table.loc[3000, Q_BN] = Rotation.random(rng=rng).as_quat()
    table.loc[table.index % 10 != 0, Q_BN] = np.nan
    result = command(tmp_path, table)
    assert result["basis"] == "gyro minus attitude"
    assert [(p["row"], p["kind"]) for p in result["problems"]] == [(3002, "jump")]
    assert result["period_s"] == pytest.approx(1.0)
    # Trapezoids of instants: white noise of the mean over 10 rows; 599 intervals, 3 axes: 2.4% of N, 4 sigma.
    assert result["arw_arcsec_sqrt_s"] == pytest.approx(0.5, rel=0.1)
    assert result["warnings"] == []


def test_an_axis_that_does_not_vary_is_left_out(tmp_path):
    table = at_rest(1000)
    table[GYRO[1]] = 2e-5
    result = command(tmp_path, table)
    assert result["axes"]["y"]["arw_arcsec_sqrt_s"] is None
    assert result["arw_arcsec_sqrt_s"] == pytest.approx(0.5, rel=0.12)
    assert any(text.startswith("axis y") for text in result["warnings"])
    table[GYRO] = 1e-5
    with pytest.raises(DataError, match="do not vary"):
        command(tmp_path, table)


def test_bad_rows_are_counted_and_strict_refuses_them(tmp_path):
    table = at_rest(1000)
    table.loc[[100, 500], GYRO[0]] = np.nan
    result = command(tmp_path, table)
    assert result["rows_rejected"] == 2
    assert [p["row"] for p in result["problems"]] == [102, 502]
    assert result["samples"] == 1000
    with pytest.raises(DataError, match="row 102"):
        command(tmp_path, table, strict=True)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (at_rest(30), "30 usable samples"),
        (at_rest(1000).iloc[[i for i in range(1000) if i % 50 < 30]], "longest stretch"),
        (at_rest(100).rename(columns=lambda name: name.replace("gyro", "foo")), "column"),
    ],
)
def test_what_does_not_suffice_is_said_with_file_and_remedy(tmp_path, table, message):
    with pytest.raises(DataError, match=message) as error:
        command(tmp_path, table)
    assert "gyro.csv" in str(error.value)
    assert not (tmp_path / "out").exists()


def test_a_wrong_key_in_the_configuration(tmp_path):
    with pytest.raises(ConfigurationError):
        command(tmp_path, at_rest(100), "[gyro]\narw = 3\n")
