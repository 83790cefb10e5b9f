"""GRACE-FO Level-1 files: read by name, in the documented sense, bad rows named, and through `helmstar attitude`."""

import json

import gracefo_files as files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from telemetry_simulator import ARCSEC

from helmstar.cli import main
from helmstar.errors import ConfigurationError, DataError, HelmstarError
from helmstar.io.settings import FormatSettings, GraceFoConfiguration
from helmstar.io.telemetry import read_telemetry
from helmstar.sensors.configuration import load_sensors

relaxed = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

# Four rows of SCA1B, satellite C, 2022-01-01, release 04 (NASA/JPL), as delivered.
FLIGHT = """\
694267200 C 23 0.4808017050541642 -0.2620552641913284 -0.1627298892823009 -0.8207775228342311 8.773424053941323e-07 00000000
694267201 C 23 0.4808916770459788 -0.261600538986203 -0.1624636205713502 -0.8209226059770532 8.773424053941323e-07 00000000
694267202 C 23 0.4809815362327415 -0.2611458377574534 -0.1621972689526377 -0.8210673901758849 8.773424054650244e-07 00000000
694267203 C 23 0.4810714452303146 -0.2606910513742197 -0.1619308900264623 -0.8212118041251759 8.773424054650244e-07 00000000
"""


def gracefo(**keys):
    return FormatSettings(gracefo=GraceFoConfiguration(**{"imu_axes": files.AXES.tolist(), **keys}))


def read(*paths, needs=(), **keys):
    return read_telemetry(paths, needs=needs, settings=gracefo(**keys))


def pointing_to(name, error):
    assert name in str(error)


def survive(path):
    """Read; a traceback here is what the tests with damaged files are about."""
    try:
        telemetry = read(path)
    except HelmstarError as error:
        return pointing_to(path.name, error)
    assert (np.diff(telemetry.gyro.time) > 0).all()
    assert np.isfinite(telemetry.gyro.value).all()
    np.testing.assert_allclose(np.linalg.norm(telemetry.attitude.q_BN, axis=1), 1.0, atol=1e-12)


def test_flight_rows_turn_about_the_pitch_axis_once_per_orbit(tmp_path):
    path = files.write(tmp_path / "SCA1B_2022-01-01_C_04.txt", "SCA1B", FLIGHT.splitlines())
    attitude = read(path).attitude
    turn = Rotation.from_quat(attitude.q_BN)
    rate = -(turn[1:] * turn[:-1].inv()).as_rotvec()  # R(k+1) = exp(-[w dt x]) R(k)
    np.testing.assert_allclose(rate, np.broadcast_to([0.0, 1.1077e-3, 0.0], (3, 3)), atol=5e-7)
    wrong = Rotation.from_quat(read(path, quaternion_sense="bn").attitude.q_BN)
    assert np.abs((wrong[1:] * wrong[:-1].inv()).as_rotvec()[:, 0]).min() > 5e-4  # the other sense has no axis


def test_time_is_gps_seconds_since_noon_2000(tmp_path):
    path = files.write(tmp_path / "SCA1B_2022-01-01_C_04.txt", "SCA1B", FLIGHT.splitlines())
    telemetry = read(path)
    assert telemetry.origin.utc([0.0])[0] == "2021-12-31T23:59:42.000000"  # GPS is 18 s ahead
    np.testing.assert_array_equal(telemetry.attitude.time, [0.0, 1.0, 2.0, 3.0])


def test_gyro_increments_are_the_turn_about_the_axes_of_the_frame(tmp_path):
    drift = np.array([3.0, -2.0, 1.0]) * ARCSEC
    path = files.write(tmp_path / "IMU1B_2022-01-01_C_04.txt", "IMU1B", files.imu_rows(20.0, drift))
    gyro = read(path).gyro
    assert gyro.quantity == "increment"
    assert len(gyro) == 159
    k = np.arange(1, 161) / 8.0
    expected = np.diff(files.nodded(k) + drift * k[:, None], axis=0)
    np.testing.assert_allclose(gyro.value, expected, atol=2e-11)
    np.testing.assert_allclose(gyro.step, 0.125, atol=1e-9)


@pytest.mark.parametrize(("said", "unit"), [("degrees", "deg"), ("radians", "rad")])
def test_unit_of_the_angle_is_that_of_the_header(tmp_path, said, unit):
    rows = files.imu_rows(2.0, np.zeros(3))
    path = files.write(tmp_path / "IMU1B_2022-01-01_C_04.txt", "IMU1B", rows, units=said)
    as_said = read(path).gyro.value
    np.testing.assert_array_equal(as_said, read(path, angle_unit=unit).gyro.value)
    other = read(path, angle_unit="rad" if unit == "deg" else "deg").gyro.value
    factor = files.DEG if unit == "deg" else 1.0 / files.DEG
    np.testing.assert_allclose(other * factor, as_said, rtol=0.0, atol=1e-14)


def test_three_gyros_suffice_and_two_do_not(tmp_path):
    rows = files.imu_rows(5.0, np.zeros(3))
    name = tmp_path / "IMU1B_2022-01-01_C_04.txt"
    whole = read(files.write(name, "IMU1B", rows)).gyro
    three = read(files.write(name, "IMU1B", [r for r in rows if r.split()[4] != "2"])).gyro
    np.testing.assert_allclose(three.value, whole.value, atol=1e-10)
    files.write(name, "IMU1B", [r for r in rows if r.split()[4] in "14"])
    with pytest.raises(DataError, match=r"IMU1B.*gyros with enough readings: 1, 4; three"):
        read(name)


def test_a_lost_reading_leaves_one_epoch_out_and_no_angle(tmp_path):
    rows = files.imu_rows(10.0, np.zeros(3))
    del rows[40 * 4 + 2]
    telemetry = read(files.write(tmp_path / "IMU1B_x_C_04.txt", "IMU1B", rows))
    gyro = telemetry.gyro
    np.testing.assert_allclose(gyro.value.sum(axis=0), files.nodded(10.0) - files.nodded(0.125), atol=1e-10)
    assert gyro.step.max() == pytest.approx(0.375)  # gyro 3 cannot be interpolated to the epochs on both sides
    assert {p.kind for p in telemetry.problems} == {"nan"}


def test_wraps_are_undone_where_they_are_known_and_lost_increments_elsewhere(tmp_path):
    rows = files.imu_rows(30.0, np.zeros(3))
    jumped = [r.split() for r in rows]
    for cells in jumped:  # counters that start again 400 degrees lower
        cells[5] = f"{float(cells[5]) - (400.0 if int(cells[0]) - files.GPS_START >= 13 else 0.0):.13f}"
    path = files.write(tmp_path / "IMU1B_x_C_04.txt", "IMU1B", [" ".join(c) for c in jumped])
    whole = read(path, angle_wrap_deg=400.0).gyro
    np.testing.assert_allclose(whole.value.sum(axis=0), files.nodded(30.0) - files.nodded(0.125), atol=1e-10)
    telemetry = read(path)
    lost = telemetry.gyro
    assert [p.kind for p in telemetry.problems] == ["jump"] * 4
    assert len(whole) - 2 <= len(lost) < len(whole)
    shared = np.isin(np.round(whole.time, 6), np.round(lost.time, 6))
    np.testing.assert_allclose(lost.value, whole.value[shared], atol=1e-10)


def test_nothing_but_jumps_is_a_data_error(tmp_path):
    rows = files.imu_rows(0.375, np.zeros(3))
    jumping = [" ".join([*r.split()[:5], str(1e4 * i), "0"]) for i, r in enumerate(rows)]
    with pytest.raises(DataError, match=r"no increment is left; for one, .*FiltAng jumps"):
        read(files.write(tmp_path / "IMU1B_x_C_04.txt", "IMU1B", jumping))


def test_header_says_the_order_of_columns(tmp_path):
    order = ["gps_time", "qualflg", "quatkcoeff", "quatjcoeff", "quaticoeff", "quatangle", "qual_rss", "GRACEFO_id"]
    cells = [line.split() for line in FLIGHT.splitlines()]
    rows = [" ".join([c[0], c[8], c[6], c[5], c[4], c[3], c[7], c[1]]) for c in cells]
    moved = read(files.write(tmp_path / "SCA1B_a_C_04.txt", "SCA1B", rows, variables=order))
    plain = read(files.write(tmp_path / "SCA1B_b_C_04.txt", "SCA1B", FLIGHT.splitlines()))
    np.testing.assert_array_equal(moved.attitude.q_BN, plain.attitude.q_BN)


def test_without_a_list_of_variables_the_documented_layout_holds(tmp_path):
    path = tmp_path / "SCA1B_2022-01-01_C_04.txt"
    path.write_text("header:\n  global_attributes:\n    title: GRACE-FO\n# End of YAML header\n" + FLIGHT)
    assert len(read(path).attitude) == 4
    imu = tmp_path / "IMU1B_2022-01-01_C_04.txt"
    rows = [r.split() for r in files.imu_rows(2.0, np.zeros(3))]
    long = "\n".join(" ".join(r) for r in rows)
    short = "\n".join(f"{int(r[0]) + 1e-6 * int(r[1]):.6f} C {r[4]} {r[5]} {r[6]}" for r in rows)
    imu.write_text(f"header:\n# End of YAML header\n{long}\n")
    by_parts = read(imu).gyro
    imu.write_text(f"header:\n# End of YAML header\n{short}\n")
    np.testing.assert_allclose(read(imu).gyro.value, by_parts.value, atol=1e-9)  # seconds of 9 digits hold 1e-7 s
    without = [name for name in files.VARIABLES["SCA1B"] if name != "quatjcoeff"]
    rows = [" ".join(np.delete(line.split(), 5)) for line in FLIGHT.splitlines()]
    with pytest.raises(DataError, match=r"without quatjcoeff"):
        read(files.write(tmp_path / "SCA1B_y_C_04.txt", "SCA1B", rows, variables=without))
    nameless = path.rename(tmp_path / "x.txt")
    with pytest.raises(DataError, match=r"x\.txt: the header has no list of variables"):
        read(nameless)


def test_bad_rows_are_named_by_their_line(tmp_path):
    rows = files.sca_rows(np.arange(12.0), np.tile([0.0, 0.0, 0.6, 0.8], (12, 1)))
    rows[2] = rows[2].replace(" 0.8 ", " abc ")
    rows[3] = rows[3].rsplit(" ", 1)[0]
    rows[5] = rows[5].replace(" 0.8 ", " 0.9 ")
    rows[7] = "x" + rows[7]
    rows[0] = "0 C 1 1.0 00000000"  # as wide as another layout
    rows[9] = rows[9].replace(f"{files.GPS_START + 9:.0f}", f"{files.GPS_START - 99:.0f}")
    path = files.write(tmp_path / "SCA1B_x_C_04.txt", "SCA1B", rows)
    first = path.read_text().splitlines().index("# End of YAML header") + 2
    telemetry = read(path)
    found = {p.row - first: p.kind for p in telemetry.problems}
    expected = {0: "ragged", 2: "not_a_number", 3: "ragged", 5: "non_unit", 7: "time_unreadable", 9: "time_backwards"}
    assert found == expected
    assert all(p.file == str(path) and p.action == "dropped" for p in telemetry.problems)
    assert telemetry.attitude.row.tolist() == [first + i for i in range(12) if i not in expected]


def test_flags_are_honoured_by_what_the_header_says_of_them(tmp_path):
    marks = {1: "00000001", 4: "00001000", 6: "01000000", 8: "0000x000"}
    rows = files.sca_rows(np.arange(10.0), np.tile([0.0, 0.0, 0.6, 0.8], (10, 1)), marks)
    path = files.write(tmp_path / "SCA1B_x_C_04.txt", "SCA1B", rows)
    telemetry = read(path)
    assert len(telemetry.attitude) == 7
    action = [
        (p.kind, p.action, p.message.split(": ", 1)[-1].removesuffix("; [gracefo] reject_bits chooses"))
        for p in telemetry.problems
    ]
    assert action == [
        ("flagged", "dropped", "Data was interpolated)"),
        ("flagged", "used", "Only one star camera)"),
        ("flagged", "dropped", "not explained in the header)"),
        ("flagged", "dropped", "qualflg '0000x000' (no row of bits)"),
    ]
    assert len(read(path, reject_bits=[]).attitude) == 9
    assert len(read(path, reject_bits=[3]).attitude) == 8
    one_camera = files.sca_rows(np.arange(3.0), np.tile([0.0, 0.0, 0.6, 0.8], (3, 1)), {1: "00001000"})
    files.write(path, "SCA1B", one_camera)
    read_telemetry([path], needs=[], strict=True)  # a row that is used is no fault
    with pytest.raises(DataError, match="strict"):
        read_telemetry([path], needs=[], strict=True, settings=gracefo(reject_bits=[3]))


def test_star_cameras_of_sca1a_are_turned_into_the_science_frame(tmp_path):
    rng = np.random.default_rng(3)
    R_BN = Rotation.from_quat(rng.normal(size=(6, 4)))
    R_camera_B = Rotation.from_quat(rng.normal(size=4))
    stored = (R_camera_B * R_BN).inv().as_quat()  # v_N = R(q) v_camera
    rows = []
    for k, (x, y, z, w) in enumerate(stored):
        for camera in (1, 2):
            confid = 7 if k == 3 else 0
            rows.append(
                f"{files.GPS_START + k:.0f} 250000 C {camera} P {w} {x} {y} {z} 9 20 {confid} 0 0 00000000 00000000"
            )
    path = files.write(tmp_path / "SCA1A_2022-01-01_C_04.txt", "SCA1A", rows)
    with pytest.raises(DataError, match=r"SCA1A.*sca_id 1, 2.*mounting\.1"):
        read(path)
    x, y, z, w = R_camera_B.as_quat()  # v_camera = R(q) v_SRF
    telemetry = read(path, mounting={"2": [w, x, y, z]})
    kept = [0, 1, 2, 4, 5]
    difference = (Rotation.from_quat(telemetry.attitude.q_BN) * R_BN[kept].inv()).magnitude()
    np.testing.assert_allclose(difference, 0.0, atol=1e-12)
    assert telemetry.origin.utc([0.0])[0].endswith("23:59:42.250000")
    assert {(p.kind, p.action) for p in telemetry.problems} == {("unused", "not used"), ("flagged", "dropped")}
    own = read(path, sca_id=1)
    camera = Rotation.from_quat(own.attitude.q_BN) * (R_camera_B * R_BN[kept]).inv()
    np.testing.assert_allclose(camera.magnitude(), 0.0, atol=1e-12)
    assert ("frame", "used") in {(p.kind, p.action) for p in own.problems}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "nothing in it|is empty"),
        (b"header:\n  GRACE\n", "no line '# End of YAML header'"),
        (b"header:\n# End of YAML header\n", "no row below the header"),
        (b"header:\n# End of YAML header\n1 2 3\n", "no row has the 9 cells"),
        (b"\x1f\x8b\x08\x00garbage", "gzip|neither a text table"),
        (b"\x00\xff\x00\xff" * 100, "End of YAML header"),
    ],
)
def test_garbage_is_a_data_error_with_its_file(tmp_path, content, message):
    path = tmp_path / "SCA1B_2022-01-01_C_04.txt"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        read(path)
    assert path.name in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("[gracefo]\nimu_axes = [[1, 0, 0], [0, 2, 0]]", r"gracefo\.imu_axes: .*length 2, but an axis needs 1"),
        ("[gracefo]\nmounting.one = [1, 0, 0, 0]", r"gracefo\.mounting: 'one' is no sca_id"),
        ("[gracefo]\nmounting.1 = [1, 1, 0, 0]", r"length 1\.41421, but a rotation needs 1"),
        ("[gracefo]\nreject_bits = [-1]", r"-1 is no bit of qualflg"),
        ("[gracefo]\nquaternion_sens = 'bn'", r"unknown key 'gracefo\.quaternion_sens'.*quaternion_sense"),
        ("[spice]\nframe = 'MY BODY'", r"spice\.frame: 'MY BODY' is no name of a SPICE frame"),
        ("[spice]\nspacecraft_id = 5", r"spice\.spacecraft_id = 5 is not allowed"),
        ("[spice]\nspacecraft_id = -2147484", r"spice\.spacecraft_id: -2147484 is not allowed: must be >= -2147483"),
        ("[aem]\nref_frame_a = 'SC_BODY_1'", r"aem\.ref_frame_a: 'SC_BODY_1' must be inertial: ICRF, EME2000"),
        ("[aem]\nref_frame_b = 'eme2000'", r"aem\.ref_frame_b: 'eme2000' is inertial, but must be the body's"),
        ("[aem]\nobject_name = ''", r"aem\.object_name: '' is no value of a message"),
    ],
)
def test_settings_are_checked_with_their_keys(tmp_path, toml, message):
    (tmp_path / "s.toml").write_text(toml)
    with pytest.raises(ConfigurationError, match=message):
        load_sensors(tmp_path / "s.toml")


def test_the_frames_and_numbers_that_fit_are_taken(tmp_path):
    (tmp_path / "s.toml").write_text(
        "[spice]\nspacecraft_id = -2147483\n[aem]\nref_frame_a = 'EME2000'\nref_frame_b = 'STAR_1'"
    )
    load_sensors(tmp_path / "s.toml")


@relaxed
@given(data=st.data())
def test_damaged_files_never_give_a_traceback(tmp_path, data):
    if data.draw(st.booleans()):
        rows, product = files.sca_rows(np.arange(9.0), np.tile([0.0, 0.0, 0.6, 0.8], (9, 1))), "SCA1B"
    else:
        rows, product = files.imu_rows(1.0, np.zeros(3)), "IMU1B"
    content = bytearray((files.header(product) + "\n".join(rows)).encode())
    for _ in range(data.draw(st.integers(1, 12))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    content = content[: data.draw(st.integers(1, len(content)))]
    path = tmp_path / f"{product}_2022-01-01_C_04.txt"
    path.write_bytes(content)
    survive(path)


@relaxed
@given(content=st.binary(max_size=200))
def test_any_bytes_below_a_header(tmp_path, content):
    for product in ("SCA1A", "IMU1A"):
        path = tmp_path / f"{product}_2022-01-01_D_04.txt"
        path.write_bytes(b"header:\n# End of YAML header\n" + content)
        survive(path)


def test_helmstar_attitude_finds_the_truth_of_these_files(tmp_path, capsys):
    record = files.write_record(tmp_path)
    config = files.settings_toml(tmp_path)
    given = ["--config", str(config), "--out", str(tmp_path), "--strict", "--json"]
    assert main(["attitude", str(record.sca), str(record.imu), *given]) == 0
    result = json.loads(capsys.readouterr().out)
    drift, sigma = np.array(result["drift_arcsec_s"]), np.array(result["drift_sigma_arcsec_s"])
    assert (np.abs(drift - record.drift / ARCSEC) < 5.0 * sigma).all()
    assert (sigma < 0.1).all()
    assert {(p["kind"], p["action"]) for p in result["problems"]} == {("no_gyro", "not used")}  # the first attitude
    import pandas as pd

    smoothed = pd.read_parquet(tmp_path / "smoothed.parquet")
    error = record.truth.attitude_error(
        smoothed["time_s"].to_numpy(), smoothed[[f"q_bn_{a}" for a in "xyzw"]].to_numpy()
    )
    assert np.sqrt(np.mean(error**2)) < 2.0 * ARCSEC  # 5 arcsec a reading
