"""CCSDS AEM: what is written is the standard's and read back to the bit it has room for; what is read, in its sense."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from telemetry_simulator import ARCSEC, Setup, simulate

from helmstar.cli import main
from helmstar.errors import DataError, HelmstarError
from helmstar.io.aem import write_aem
from helmstar.io.clock import Origin
from helmstar.io.profile import read_attitude_profile
from helmstar.io.settings import AemConfiguration
from helmstar.io.telemetry import read_telemetry

relaxed = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
ORIGIN = Origin(8035, 37.25, absolute=True)  # 2021-12-31T00:00:00.25 UTC

# Annex F2.2: B is A turned by +90 degrees about Z, so that x = [1, 0, 0] of A is [0, -1, 0] in B.
ANNEX = """\
CCSDS_AEM_VERS = {version}
CREATION_DATE = 2002-11-04T17:22:31
ORIGINATOR = NASA/JPL

META_START
COMMENT the example of annex F2.2
OBJECT_NAME = MARS GLOBAL SURVEYOR
OBJECT_ID = 1996-062A
REF_FRAME_A = {a}
REF_FRAME_B = {b}
{more}TIME_SYSTEM = {system}
START_TIME = 1996-11-28T21:29:07.2555
STOP_TIME = 1996-333T21:29:08.2555
ATTITUDE_TYPE = {kind}
META_STOP

DATA_START
1996-11-28T21:29:07.2555 {q}
COMMENT by day of the year
1996-333T21:29:08.2555Z {q}
DATA_STOP
"""
Z90 = "0 0 0.70710678118654752 0.70710678118654752"


def pointing_to(name, error):
    assert name in str(error)


def annex(path, **keys):
    given = {
        "version": "2.0",
        "a": "ICRF",
        "b": "SC_BODY_1",
        "more": "",
        "system": "UTC",
        "kind": "QUATERNION",
        "q": Z90,
    }
    path.write_text(ANNEX.format(**given | keys))
    return path


def attitudes(path):
    return read_telemetry([path], needs=[]).attitude


def x_of_N_in_B(path):
    return Rotation.from_quat(attitudes(path).q_BN).apply([1.0, 0.0, 0.0])[0]


def test_quaternion_has_the_sense_of_annex_f(tmp_path):
    np.testing.assert_allclose(x_of_N_in_B(annex(tmp_path / "a.aem")), [0.0, -1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"version": "1.0", "more": "ATTITUDE_DIR = A2B\nQUATERNION_TYPE = LAST\n"}, -1.0),
        ({"version": "1.0", "more": "ATTITUDE_DIR = B2A\nQUATERNION_TYPE = LAST\n"}, 1.0),
        ({"a": "SC_BODY_1", "b": "EME2000"}, 1.0),
        ({"a": "sc_body_1", "b": "gcrf", "more": "ATTITUDE_DIR = B2A\n"}, -1.0),
        (
            {"version": "1.0", "more": "QUATERNION_TYPE = FIRST\n", "q": "0.70710678118654752 0 0 0.70710678118654752"},
            -1.0,
        ),
        ({"kind": "QUATERNION/ANGVEL", "q": f"{Z90} 1 2 3"}, -1.0),
    ],
)
def test_direction_and_order_are_honoured(tmp_path, keys, expected):
    np.testing.assert_allclose(x_of_N_in_B(annex(tmp_path / "a.aem", **keys)), [0.0, expected, 0.0], atol=1e-15)


@pytest.mark.parametrize(("system", "tai_ahead"), [("UTC", 30.0), ("TAI", 0.0), ("GPS", 19.0), ("TT", -32.184)])
def test_time_systems(tmp_path, system, tai_ahead):
    path = annex(tmp_path / "a.aem", system=system)
    if system != "UTC":
        path.write_text(path.read_text().replace("2555Z", "2555"))  # Z is UTC's
    telemetry = read_telemetry([path], needs=[])
    np.testing.assert_allclose(telemetry.attitude.time, [0.0, 1.0], atol=1e-9)
    tai = np.datetime64(telemetry.origin.tai([0.0])[0])
    assert (tai - np.datetime64("1996-11-28T21:29:07.255500")) / np.timedelta64(1, "s") == pytest.approx(tai_ahead)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"version": "3.0"}, "line 1: CCSDS_AEM_VERS = 3.0"),
        ({"kind": "EULER_ANGLE"}, "ATTITUDE_TYPE = EULER_ANGLE is not read"),
        ({"system": "SCLK"}, "TIME_SYSTEM = SCLK is not read; UTC, TAI, GPS, TT are"),
        ({"a": "LVLH"}, "one of them has to be inertial"),
        ({"b": "J2000"}, "one of them has to be inertial"),
        ({"more": "ATTITUDE_DIR = UP\n"}, "must be A2B or B2A"),
        ({"more": "QUATERNION_TYPE = MIDDLE\n"}, "must be FIRST or LAST"),
        ({"more": "just words\n"}, "line 11: 'just words' in the metadata is not KEYWORD = value"),
        ({"q": "0 0 x 1"}, "there is no attitude in it; for one, .*row 18: .*no number"),
        ({"q": "0 0 1"}, "there is no attitude in it; for one, .*row 18: .*as many numbers"),
        ({"q": "0 0 0.5 0.5"}, "none of its 2 rows is usable.*length 0.707"),
    ],
)
def test_what_cannot_be_read_is_said_with_its_place(tmp_path, keys, message):
    with pytest.raises(DataError, match=message) as caught:
        attitudes(annex(tmp_path / "a.aem", **keys))
    assert "a.aem" in str(caught.value)


def test_bad_records_are_dropped_by_line(tmp_path):
    path = annex(tmp_path / "a.aem")
    lines = path.read_text().splitlines()
    lines[18:18] = [
        "1996-02-30T00:00:00 0 0 0 1",
        "< intervening data records omitted here >",
        "1996-11-28T21:29:07.5 0 0 0 nan",
    ]
    path.write_text("\n".join(lines))
    telemetry = read_telemetry([path], needs=[])
    assert {p.row: p.kind for p in telemetry.problems} == {19: "time_unreadable", 20: "ragged", 21: "nan"}
    assert telemetry.attitude.row.tolist() == [18, 23]


def random_segments(rng, sizes=(5, 1, 3)):
    out, start = [], 0.0
    for n in sizes:
        time = start + np.cumsum(rng.uniform(1e-3, 1.0, n))
        out.append((time, Rotation.from_quat(rng.normal(size=(n, 4))).as_quat()))
        start = time[-1] + 100.0
    return out


def test_what_is_written_is_read_back(tmp_path):
    segments = random_segments(np.random.default_rng(5))
    path = tmp_path / "a.aem"
    write_aem(path, ORIGIN, segments, AemConfiguration(object_name="EUTELSAT W1"), ["one", "two\nlines"])
    telemetry = read_telemetry([path], needs=[], strict=True)
    time, q = np.concatenate([t for t, _ in segments]), np.vstack([q for _, q in segments])
    np.testing.assert_allclose(telemetry.attitude.time, time - time[0], rtol=0.0, atol=2e-9)
    np.testing.assert_allclose(telemetry.attitude.q_BN, q, rtol=0.0, atol=4e-16)
    assert telemetry.origin.utc([0.0])[0] == ORIGIN.utc(time[:1])[0]


def test_the_message_is_what_the_standard_asks_for(tmp_path):
    path = tmp_path / "a.aem"
    segments = [(np.array([0.0, 0.5]), np.array([[0.0, 0.6, 0.0, 0.8], [1.0, 0.0, 0.0, 0.0]]))]
    write_aem(path, ORIGIN, segments, comments=["said"], created=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC))
    assert path.read_bytes().decode("ascii") == (
        "CCSDS_AEM_VERS = 2.0\nCOMMENT said\nCREATION_DATE = 2026-01-02T03:04:05\nORIGINATOR = HELMSTAR\n\n"
        "META_START\nOBJECT_NAME = UNKNOWN\nOBJECT_ID = UNKNOWN\nREF_FRAME_A = ICRF\nREF_FRAME_B = SC_BODY_1\n"
        "TIME_SYSTEM = UTC\nSTART_TIME = 2021-12-31T00:00:00.250000000\nSTOP_TIME = 2021-12-31T00:00:00.750000000\n"
        "ATTITUDE_TYPE = QUATERNION\nMETA_STOP\n\nDATA_START\n"
        "2021-12-31T00:00:00.250000000 0.000000000000000e+00 -6.000000000000000e-01 0.000000000000000e+00 "
        "8.000000000000000e-01\n"
        "2021-12-31T00:00:00.750000000 -1.000000000000000e+00 0.000000000000000e+00 0.000000000000000e+00 "
        "0.000000000000000e+00\nDATA_STOP\n"
    )


def test_a_leap_second_survives(tmp_path):
    eve = Origin(6209, 36.0 + 86398.5, absolute=True)  # 2016-12-31T23:59:58.5 UTC
    time = np.arange(4) * 1.0
    write_aem(tmp_path / "a.aem", eve, [(time, np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)))])
    assert "T23:59:60.500000000 " in (tmp_path / "a.aem").read_text()
    np.testing.assert_allclose(attitudes(tmp_path / "a.aem").time, time, atol=1e-9)


def test_plain_seconds_make_no_message(tmp_path):
    with pytest.raises(DataError, match="absolute times"):
        write_aem(tmp_path / "a.aem", Origin(0, 0.0, absolute=False), [])


def test_profile_is_continuous_and_complete(tmp_path):
    segments = random_segments(np.random.default_rng(6), (6, 6))
    flipped = [(t, q * np.resize([[1.0], [-1.0]], (len(t), 1))) for t, q in segments]
    write_aem(tmp_path / "a.aem", ORIGIN, flipped)
    time, q_BN = read_attitude_profile(tmp_path / "a.aem")
    assert time.dtype == q_BN.dtype == np.float64
    assert time[0] == 0.0
    assert (np.sum(q_BN[1:] * q_BN[:-1], axis=1) > 0.0).all()
    same = np.abs(np.sum(q_BN * np.vstack([q for _, q in segments]), axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-15)
    (tmp_path / "a.aem").write_text((tmp_path / "a.aem").read_text().replace("e-01\n", "e-01x\n", 1))
    with pytest.raises(DataError, match="strict"):
        read_attitude_profile(tmp_path / "a.aem")


@relaxed
@given(data=st.data())
def test_damaged_messages_never_give_a_traceback(tmp_path, data):
    content = bytearray(annex(tmp_path / "a.aem").read_bytes())
    for _ in range(data.draw(st.integers(1, 10))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place : place + data.draw(st.integers(0, 20))] = data.draw(st.binary(max_size=4))
    (tmp_path / "a.aem").write_bytes(content)
    try:
        attitudes(tmp_path / "a.aem")
    except HelmstarError as error:
        pointing_to("a.aem", error)


@relaxed
@given(content=st.binary(max_size=200))
def test_any_bytes_after_the_version(tmp_path, content):
    (tmp_path / "a.aem").write_bytes(b"CCSDS_AEM_VERS = 2.0\nMETA_START\n" + content)
    with pytest.raises(HelmstarError, match=r"a\.aem"):
        attitudes(tmp_path / "a.aem")


def test_helmstar_attitude_writes_one_and_takes_one_beside_a_gyro_table(tmp_path, capsys):
    record = simulate(Setup(duration_s=60.0, star_arcsec=(3.0, 3.0, 3.0)))
    gyro = record.gyro.rename(columns={"time_s": "time_gps_s"})
    gyro["time_gps_s"] += 1.3e9
    gyro.to_csv(tmp_path / "gyro.csv", index=False)
    first = read_telemetry([tmp_path / "gyro.csv"], needs=[]).origin
    q = record.star[[f"q_bn_{a}" for a in "xyzw"]].to_numpy()
    write_aem(tmp_path / "stars.aem", first, [(record.star["time_s"].to_numpy(), q)])
    files = [str(tmp_path / "gyro.csv"), str(tmp_path / "stars.aem")]
    assert main(["attitude", *files, "--aem", "--out", str(tmp_path / "out"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["exports"] == {"aem": str(tmp_path / "out" / "attitude.aem")}
    time, q_BN = read_attitude_profile(tmp_path / "out" / "attitude.aem")
    assert len(time) == result["rows"]["estimates"]
    error = record.attitude_error(time, q_BN)
    assert np.sqrt(np.mean(error**2)) < 3.0 * ARCSEC


def test_plain_seconds_are_refused_before_the_work(tmp_path, capsys):
    record = simulate(Setup(duration_s=20.0))
    files = [str(path) for path in record.write(tmp_path)]
    assert main(["attitude", *files, "--aem", "--out", str(tmp_path / "out")]) == 1
    assert "--aem needs absolute times" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
