"""STK attitude files: the documented formats in their sense, and errors that name the line."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.errors import DataError, HelmstarError
from helmstar.io.profile import read_attitude_profile
from helmstar.io.telemetry import read_telemetry

relaxed = settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
HALF = "0.70710678118654752"

FILE = """\
stk.v.11.0

# WrittenBy    somebody

BEGIN Attitude

NumberOfAttitudePoints 3
ScenarioEpoch          {epoch}
BlockingFactor         20
InterpolationOrder     1
CentralBody            Earth
CoordinateAxes         {axes}
{more}
{kind}

0.0  {q}
1.5e0 {q}
60.25 {q}

END Attitude
"""


def write(path, **keys):
    given = {"epoch": "1 Jan 2025 16:00:00.250", "axes": "J2000", "more": "", "kind": "AttitudeTimeQuaternions"}
    path.write_text(FILE.format(**given | {"q": f"0 0 {HALF} {HALF}"} | keys))
    return path


def read(path):
    return read_telemetry([path], needs=[])


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"axes": "ICRF", "kind": "AttitudeTimeQuatScalarFirst", "q": f"{HALF} 0 0 {HALF}"},
        {"kind": "attitudetimequatangvels", "q": f"0 0 {HALF} {HALF} 0.1 0.2 0.3"},
        {"axes": "icrf", "more": "TimeFormat EpSec"},
    ],
)
def test_axes_of_the_body_are_the_turned_axes_of_the_frame(tmp_path, keys):
    """Body axes turned by +90 degrees about z: x of the frame is -y of the body."""
    telemetry = read(write(tmp_path / "s.a", **keys))
    assert len(telemetry.attitude) == 3
    x_of_N_in_B = Rotation.from_quat(telemetry.attitude.q_BN).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(x_of_N_in_B, np.tile([0.0, -1.0, 0.0], (3, 1)), atol=1e-15)
    np.testing.assert_allclose(telemetry.attitude.time, [0.0, 1.5, 60.25], atol=1e-9)
    assert telemetry.origin.utc([0.0]) == ["2025-01-01T16:00:00.250000"]


def test_seconds_since_the_epoch_count_leap_seconds(tmp_path):
    path = write(tmp_path / "s.a", epoch="31 December 2016 23:59:59.0")
    assert read(path).origin.utc([0.0, 1.5, 60.25]) == [
        "2016-12-31T23:59:59.000000", "2016-12-31T23:59:60.500000", "2017-01-01T00:00:58.250000",
    ]  # fmt: skip


def test_without_an_end_the_records_go_on_to_the_end_of_the_file(tmp_path):
    path = write(tmp_path / "s.a")
    path.write_text(path.read_text().replace("END Attitude\n", ""))
    time, q_BN = read_attitude_profile(path)
    np.testing.assert_allclose(time, [0.0, 1.5, 60.25], atol=1e-9)
    assert q_BN.shape == (3, 4)


def test_known_by_content_not_by_name(tmp_path):
    assert len(read(write(tmp_path / "attitude.txt")).attitude) == 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"kind": "AttitudeTimeEulerAngles"}, "line 14: the format AttitudeTimeEulerAngles is not read"),
        ({"kind": "Sequence 313"}, "no line such as AttitudeTimeQuaternions"),
        ({"axes": "Fixed"}, "CoordinateAxes = Fixed; only inertial axes"),
        ({"epoch": "2460000.5"}, "ScenarioEpoch = 2460000.5 is no UTC date such as"),
        ({"epoch": "30 Feb 2025 00:00:00"}, "is no UTC date"),
        ({"more": "TimeFormat UTCG"}, "TimeFormat = UTCG; only EpSec"),
        ({"q": "0 0 1"}, "no attitude in it; for one, .*row 16: the record has not 5 numbers"),
        ({"q": "0 0 0 zero"}, "no attitude in it; for one, .*row 16: .*no number"),
        ({"q": "0 0 0 nan"}, "none of its 3 rows is usable"),
        ({"q": "0 0 0 0"}, "none of its 3 rows is usable.*length 0, not 1"),
    ],
)
def test_what_cannot_be_read_is_said(tmp_path, keys, message):
    with pytest.raises(DataError, match=message) as caught:
        read(write(tmp_path / "s.a", **keys))
    assert "s.a" in str(caught.value)


def test_bad_records_are_dropped_by_line(tmp_path):
    path = write(tmp_path / "s.a")
    lines = path.read_text().splitlines()
    lines[16:16] = ["0.5 0 0 0 2", "nan 0 0 0 1", "-5 0 0 0 1"]
    path.write_text("\n".join(lines))
    telemetry = read(path)
    assert {p.row: p.kind for p in telemetry.problems} == {17: "non_unit", 18: "time_unreadable", 19: "time_backwards"}
    assert telemetry.attitude.row.tolist() == [16, 20, 21]


def pointing_to(name, error):
    assert name in str(error)


@relaxed
@given(data=st.data())
def test_damaged_files_never_give_a_traceback(tmp_path, data):
    content = bytearray(write(tmp_path / "s.a").read_bytes())
    for _ in range(data.draw(st.integers(1, 10))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place : place + data.draw(st.integers(0, 20))] = data.draw(st.binary(max_size=4))
    (tmp_path / "s.a").write_bytes(content)
    try:
        read(tmp_path / "s.a")
    except HelmstarError as error:
        pointing_to("s.a", error)


@relaxed
@given(content=st.binary(max_size=200))
def test_any_bytes_after_the_start(tmp_path, content):
    (tmp_path / "s.a").write_bytes(b"stk.v.12.0\nBEGIN Attitude\n" + content)
    with pytest.raises(HelmstarError, match=r"s\.a"):
        read(tmp_path / "s.a")
