"""Whatever bytes a file holds, reading and screening it gives a result or a HelmstarError."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helmstar.errors import HelmstarError
from helmstar.io.clock import from_numbers, from_texts
from helmstar.io.screening import find_gaps, screen_gyro
from helmstar.io.telemetry import read_telemetry
from helmstar.sensors.configuration import load_sensors

relaxed = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
HEADERS = [
    "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w",
    "time_utc;gyro_x_deg_s;gyro_y_deg_s;gyro_z_deg_s;q_bn_x;q_bn_y;q_bn_z;q_bn_w",
    "time_gps_s gyro_x_rad gyro_y_rad gyro_z_rad q_bn_x q_bn_y q_bn_z q_bn_w",
    "time_s\tstar_b_x\tstar_b_y\tstar_b_z\tstar_n_x\tstar_n_y\tstar_n_z\tmode",
]
CELLS = st.one_of(
    st.sampled_from(
        ["", " ", "0", "1", "-1", "0.5", "1e-3", "nan", "inf", "-inf", "1e308", "1e999", "1e-320", "9" * 20]
    ),
    st.sampled_from(["x", '"', '"1"', "#", "1,5", "\x00", "\ufffd", "é"]),
    st.sampled_from(["2016-12-31T23:59:60Z", "2016-02-30T00:00:00", "9999-12-31T23:59:59"]),
)


def pointing_to(name, error):
    assert name in str(error)


def survive(file):
    """Read and screen; a traceback here is the failure that this module is about."""
    try:
        telemetry = read_telemetry([file], needs=[])
    except HelmstarError as error:
        return pointing_to(file.name, error)
    for reading in ("instant", "mean_since_previous", "increment_rad"):
        screen_gyro(telemetry.gyro, telemetry.attitude, reading)
    find_gaps(telemetry.gyro.time)
    for rows in (telemetry.gyro, telemetry.attitude):
        assert (np.diff(rows.time) > 0).all()
    assert np.isfinite(telemetry.gyro.value).all()
    np.testing.assert_allclose(np.linalg.norm(telemetry.attitude.q_BN, axis=1), 1.0, atol=1e-12)
    return telemetry


@relaxed
@given(content=st.binary(max_size=300))
def test_arbitrary_bytes(tmp_path, content):
    for name in ("t.csv", "t.parquet"):
        (tmp_path / name).write_bytes(content)
        survive(tmp_path / name)


@relaxed
@given(header=st.sampled_from(HEADERS), cells=st.lists(st.lists(CELLS, min_size=1, max_size=9), max_size=12))
def test_tables_of_odd_cells(tmp_path, header, cells):
    separator = next(s for s in ",;\t " if s in header)
    content = "\n".join([header, *(separator.join(row) for row in cells)])
    (tmp_path / "t.csv").write_bytes(content.encode())
    survive(tmp_path / "t.csv")


def good_table(header):
    separator = next(s for s in ",;\t " if s in header)
    rows = [
        [
            f"2016-12-31T23:59:{i:02d}" if "utc" in header else str(i),
            "1e-3",
            "2e-3",
            str(1e-3 * i),
            "0.6",
            "0",
            "0",
            "0.8",
        ]
        for i in range(40)
    ]
    return "\n".join([header, *(separator.join(row) for row in rows)]).encode()


def test_the_undamaged_tables_are_read(tmp_path):
    for header in HEADERS[:3]:
        (tmp_path / "t.csv").write_bytes(good_table(header))
        telemetry = survive(tmp_path / "t.csv")
        assert telemetry is not None
        assert (len(telemetry.gyro), len(telemetry.attitude), telemetry.problems) == (40, 40, ())


@relaxed
@given(
    header=st.sampled_from(HEADERS[:3]),
    damage=st.lists(st.tuples(st.integers(0, 1800), st.integers(0, 4), st.binary(max_size=4)), min_size=1, max_size=12),
)
def test_damaged_tables(tmp_path, header, damage):
    content = bytearray(good_table(header))
    for position, length, replacement in damage:
        content[position : position + length] = replacement
    (tmp_path / "t.csv").write_bytes(content)
    survive(tmp_path / "t.csv")


@relaxed
@given(damage=st.lists(st.tuples(st.integers(0, 6000), st.binary(min_size=1, max_size=3)), min_size=1, max_size=5))
def test_damaged_parquet(tmp_path, damage):
    import pandas as pd

    rows = np.arange(40.0)
    names = HEADERS[0].split(",")
    pd.DataFrame(np.outer(rows, np.ones(8)), columns=names).assign(
        q_bn_x=1.0, q_bn_y=0.0, q_bn_z=0.0, q_bn_w=0.0
    ).to_parquet(tmp_path / "good.parquet")
    content = bytearray((tmp_path / "good.parquet").read_bytes())
    for position, replacement in damage:
        content[position % len(content)] = replacement[0]
    (tmp_path / "t.parquet").write_bytes(content)
    survive(tmp_path / "t.parquet")


@relaxed
@given(texts=st.lists(st.text(alphabet="0123456789-:T.Z+ ", max_size=24), min_size=1, max_size=5))
def test_arbitrary_dates(texts):
    import pyarrow as pa

    for scale in ("utc", "tai", "gps"):
        instants, _ = from_texts(pa.array(texts), scale)
        assert np.isfinite(instants.seconds()).all()


@relaxed
@given(values=st.lists(st.floats(), min_size=1, max_size=5))
def test_arbitrary_numbers_as_times(values):
    for scale in ("s", "unix", "gps", "tai"):
        instants, good = from_numbers(np.array(values), scale)
        assert np.isfinite(instants.second[good]).all()


@relaxed
@given(
    content=st.one_of(st.binary(max_size=100), st.text(max_size=100).map(lambda text: text.encode("utf-8", "replace")))
)
def test_arbitrary_configuration(tmp_path, content):
    (tmp_path / "sensors.toml").write_bytes(content)
    try:
        load_sensors(tmp_path / "sensors.toml")
    except HelmstarError as error:
        pointing_to("sensors.toml", error)
