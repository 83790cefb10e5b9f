"""sensors.toml: units against hand conversions, mounting against scipy, and every mistake named by its key."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.errors import ConfigurationError
from helmstar.sensors.configuration import load_sensors

ARCSEC = np.deg2rad(1.0) / 3600.0


def load(tmp_path, text):
    file = tmp_path / "sensors.toml"
    file.write_text(text)
    return load_sensors(file)


def test_defaults():
    sensors = load_sensors(None)
    assert (sensors.gyro.arw, sensors.gyro.rrw, sensors.gyro.initial_drift_sigma) == (None, None, None)
    assert (sensors.star.sigma_S, sensors.star.covariance_B()) == (None, None)
    assert (sensors.gyro.reading, sensors.filter.gate_probability, sensors.filter.reopen_after) == ("instant", 1e-6, 5)
    np.testing.assert_array_equal(sensors.star.R_SB, np.eye(3))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        # after an hour an ARW of 0.6 deg/sqrt(h) makes 0.6 deg, and sigma = arw sqrt(3600 s)
        ("arw_deg_sqrt_h", 0.6, np.deg2rad(0.6) / 60.0),
        ("arw_arcsec_sqrt_s", 36.0, np.deg2rad(0.01)),
        ("arw_rad_sqrt_s", 2, 2.0),
        # after an hour an RRW of 1 deg/h/sqrt(h) makes a drift of 1 deg/h
        ("rrw_deg_h_sqrt_h", 1.0, np.deg2rad(1.0) / 3600.0 / np.sqrt(3600.0)),
        ("rrw_arcsec_s_sqrt_s", 3600.0, np.deg2rad(1.0)),
        ("rrw_rad_s_sqrt_s", 0.0, 0.0),
    ],
)
def test_units_of_the_gyro(tmp_path, key, value, expected):
    gyro = load(tmp_path, f"[gyro]\n{key} = {value}\ninitial_drift_sigma_arcsec_s = 10").gyro
    assert (gyro.arw if key.startswith("arw") else gyro.rrw) == pytest.approx(expected, rel=1e-14)
    assert gyro.initial_drift_sigma == pytest.approx(10.0 * ARCSEC, rel=1e-14)


def test_covariance_of_a_mounted_tracker(tmp_path):
    mounting = Rotation.from_rotvec([0.3, -1.1, 0.7])
    text = f"[star]\nsigma_cross_arcsec = 5\nsigma_roll_arcsec = 40\nq_sb = {mounting.as_quat().tolist()}"
    star = load(tmp_path, text).star
    np.testing.assert_allclose(star.R_SB, mounting.as_matrix(), atol=1e-15)
    P = star.covariance_B()
    boresight_B = mounting.inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(P @ boresight_B, (40 * ARCSEC) ** 2 * boresight_B, atol=1e-22)
    assert np.trace(P) == pytest.approx((25 + 25 + 1600) * ARCSEC**2)


def test_columns_as_one_table_or_several(tmp_path):
    assert [c.time for c in load(tmp_path, '[columns]\ntime = "t"').columns] == ["t"]
    several = load(tmp_path, '[[columns]]\nfile = "a*"\n[[columns]]\ntime = "u"').columns
    assert [(c.file, c.time) for c in several] == [("a*", None), (None, "u")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[gyro]\narw_arcsec_sqrts = 1", ["gyro.arw_arcsec_sqrts", "did you mean 'arw_arcsec_sqrt_s'"]),
        ("[gyros]\n", ["gyros", "did you mean 'gyro'"]),
        ("[gyro]\narw_arcsec_sqrt_s = 1\narw_deg_sqrt_h = 1", ["arw_arcsec_sqrt_s and arw_deg_sqrt_h"]),
        ("[gyro]\nrrw_rad_s_sqrt_s = 1\nrrw_deg_h_sqrt_h = 1", ["rrw_deg_h_sqrt_h and rrw_rad_s_sqrt_s"]),
        ("[gyro]\narw_rad_sqrt_s = -1", ["gyro.arw_rad_sqrt_s", "-1", ">= 0"]),
        ("[gyro]\narw_rad_sqrt_s = nan", ["gyro.arw_rad_sqrt_s", "NaN"]),
        ("[gyro]\ntime_offset_s = inf", ["gyro.time_offset_s", "finite"]),
        ('[gyro]\narw_rad_sqrt_s = "1"', ["gyro.arw_rad_sqrt_s", '"1"', "number"]),
        ("[gyro]\narw_rad_sqrt_s = true", ["gyro.arw_rad_sqrt_s", "true"]),
        ('[gyro]\nreading = "instent"', ["gyro.reading", '"instent"', "mean_since_previous", "did you mean 'instant'"]),
        ("[star]\nq_sb = [0, 0, 0, 2]", ["star.q_sb", "length 2"]),
        ("[star]\nq_sb = [0, 0, 1]", ["star.q_sb", "4"]),
        ("[star]\nsigma_arcsec = 0", ["star.sigma_arcsec", "> 0"]),
        ("[star]\nsigma_roll_arcsec = 1", ["sigma_cross_arcsec"]),
        ("[star]\nsigma_arcsec = 1\nsigma_cross_arcsec = 1\nsigma_roll_arcsec = 1", ["either"]),
        ("[filter]\ngate_probability = 1.0", ["filter.gate_probability", "< 1"]),
        ("[filter]\nreopen_after = 0", ["filter.reopen_after", ">= 1"]),
        ("[filter]\nreopen_after = 1.5", ["filter.reopen_after", "1.5", "integer"]),
        ('[columns]\ngyro = ["a", "b"]', ["columns.gyro", "3"]),
        ('[columns]\nquaternion_order = "wxyz"', ["quaternion_order", "quaternion = ["]),
        ("[gyro]\narw_arcsec_sqrt_s = 1e300", ["arw_arcsec_sqrt_s = 1e+300", "2.06e-10 to 2.06e+06"]),
        ("[gyro]\nrrw_rad_s_sqrt_s = 1e-200", ["rrw_rad_s_sqrt_s = 1e-200", "1e-15 to 10"]),
        ("[gyro]\ninitial_drift_sigma_arcsec_s = 1e-12", ["initial_drift_sigma_arcsec_s", "1e-09 to 2e+08"]),
        ("[gyro]\ntime_offset_s = 1e300", ["gyro.time_offset_s", "<= 1000000000.0"]),
        ("[star]\nsigma_arcsec = 1e-300", ["sigma_arcsec = 1e-300", "1e-06 to 6.48e+05"]),
        ("[star]\nsigma_cross_arcsec = 1e-5\nsigma_roll_arcsec = 1e3", ["1e+08 times sigma_cross_arcsec"]),
        ("[filter]\nreopen_after = 99999999999999999999", ["filter.reopen_after", "<= 1000000"]),
        ("[columns]\nclock_unit_s = 1e-300", ["columns.clock_unit_s", ">= 1e-12"]),
        ("gyro = 3", ["gyro", "table"]),
        ("[gyro\n", ["line 1"]),
        ("a = 1\na = 2\n", ["line 2"]),
    ],
)
def test_mistakes_are_named(tmp_path, text, words):
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, text)
    for word in [*words, "sensors.toml"]:
        assert word in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigurationError, match="no such file"):
        load_sensors(tmp_path / "nope.toml")
    with pytest.raises(ConfigurationError, match="folder"):
        load_sensors(tmp_path)
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match="UTF-8"):
        load_sensors(tmp_path / "b.toml")
