"""Telemetry from tables: native and foreign layouts mean the same, and every bad row is named with what was done."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from helmstar.errors import DataError
from helmstar.io.clock import TimeOffsets
from helmstar.io.columns import ColumnsConfiguration
from helmstar.io.problems import KINDS
from helmstar.io.telemetry import read_telemetry, to_rates

FLIGHT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "telemetry"
GYRO = ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]
QUATERNION = ["q_bn_x", "q_bn_y", "q_bn_z", "q_bn_w"]


def motion(n=50, dt=0.5, seed=0):
    """A table of a body turning at a varying rate: time_s, body rates, attitude."""
    rng = np.random.default_rng(seed)
    time = 100.0 + dt * np.arange(n)
    rates = 1e-2 * np.stack([np.sin(0.1 * time), np.cos(0.07 * time), 0.3 + 0 * time], axis=1)
    q = Rotation.random(rng=rng).as_quat()
    quaternions = [q]
    for w in rates[:-1]:
        q = (Rotation.from_rotvec(-w * dt) * Rotation.from_quat(q)).as_quat()  # R_BN' = Exp(-w dt) R_BN
        quaternions.append(q)
    return pd.DataFrame({"time_s": time}).assign(
        **dict(zip(GYRO, rates.T)), **dict(zip(QUATERNION, np.array(quaternions).T))
    )


def read(tmp_path, *tables, columns=None, **options):
    files = []
    for i, content in enumerate(tables):
        file = tmp_path / f"table{i}.csv"
        file.write_text(content if isinstance(content, str) else content.to_csv(index=False))
        files.append(file)
    return read_telemetry(files, columns, **options)


def named(telemetry):
    return [(p.row, p.kind, p.action) for p in telemetry.problems]


def test_one_table_two_tables_and_parquet_are_the_same(tmp_path):
    data = motion()
    one = read(tmp_path, data)
    assert one.problems == ()
    np.testing.assert_array_equal(one.gyro.value, data[GYRO])
    np.testing.assert_allclose(one.attitude.q_BN, data[QUATERNION], atol=1e-15)
    np.testing.assert_array_equal(one.gyro.time, data["time_s"] - 100.0)
    assert one.gyro.row.tolist() == list(range(2, 52))
    two = read(tmp_path, data[["time_s", *QUATERNION]], data[["time_s", *GYRO]])
    data.to_parquet(tmp_path / "t.parquet")
    parquet = read_telemetry([tmp_path / "t.parquet"])
    for other in (two, parquet):
        np.testing.assert_array_equal(other.gyro.value, one.gyro.value)
        np.testing.assert_array_equal(other.attitude.q_BN, one.attitude.q_BN)
    assert parquet.gyro.row[0] == 1
    assert two.gyro.files[two.gyro.file[0]].endswith("table1.csv")


def test_empty_cells_are_absent_not_bad(tmp_path):
    data = motion()
    data.loc[data.index % 10 != 0, QUATERNION] = np.nan
    for content in (data, data.to_csv(index=False, na_rep="nan")):
        telemetry = read(tmp_path, content)
        assert (len(telemetry.gyro), len(telemetry.attitude), telemetry.problems) == (50, 5, ())
    assert telemetry.attitude.time.tolist() == [0, 5, 10, 15, 20]


def test_a_stacked_table_of_gyro_rows_and_attitude_rows_at_the_same_times(tmp_path):
    data = motion(10)
    gyro, attitude = data.copy(), data.copy()
    gyro[QUATERNION], attitude[GYRO] = np.nan, np.nan
    telemetry = read(tmp_path, pd.concat([gyro, attitude]).sort_values("time_s", kind="stable"))
    assert (len(telemetry.gyro), len(telemetry.attitude), telemetry.problems) == (10, 10, ())


def test_several_files_of_a_kind_are_merged_in_time_order_and_overlaps_named(tmp_path):
    data = motion()
    attitude = data[["time_s", *QUATERNION]]
    telemetry = read(tmp_path, attitude, data[["time_s", *GYRO]][24:], data[["time_s", *GYRO]][:25])
    np.testing.assert_array_equal(telemetry.gyro.value, data[GYRO])
    assert [(Path(p.file).name, p.row, p.kind) for p in telemetry.problems] == [("table2.csv", 26, "time_repeated")]


def test_every_bad_row_is_named(tmp_path):
    data = motion().astype(object)
    data.loc[3, GYRO[1]] = "nan"
    data.loc[5, GYRO[0]] = "oops"
    data.loc[7, QUATERNION] = [0, 0, 0, 0]
    data.loc[9, QUATERNION] = [0.6, 0.0, 0.0, 0.81]
    data.loc[11, QUATERNION] = (data.loc[11, QUATERNION].astype(float) * 1.0001).to_list()
    data.loc[13, "time_s"] = data.loc[12, "time_s"]
    data.loc[15, "time_s"] = data.loc[10, "time_s"]
    data.loc[17, "time_s"] = 1e9
    data.loc[19, "time_s"] = "inf"
    data.loc[21, "time_s"] = "noon"
    data.loc[23, GYRO[2]] = None
    data.loc[25, QUATERNION[0]] = np.inf
    lines = data.to_csv(index=False).splitlines()
    lines[28] += ",7"
    telemetry = read(tmp_path, "\n".join(lines))
    assert named(telemetry) == [
        (5, "nan", "dropped"),
        (7, "not_a_number", "dropped"),
        (9, "non_unit", "dropped"),
        (11, "non_unit", "dropped"),
        (13, "non_unit", "normalised"),
        (15, "time_repeated", "dropped"),
        (17, "time_backwards", "dropped"),
        (19, "time_backwards", "dropped"),
        (21, "nan", "dropped"),
        (23, "time_unreadable", "dropped"),
        (25, "nan", "dropped"),
        (27, "nan", "dropped"),
        (29, "ragged", "dropped"),
    ]
    clock_faults, gyro_faults, attitude_faults = {13, 15, 17, 19, 21, 27}, {3, 5, 23}, {7, 9, 25}
    assert set(range(2, 52)) - set(telemetry.gyro.row) == {i + 2 for i in clock_faults | gyro_faults}
    assert set(range(2, 52)) - set(telemetry.attitude.row) == {i + 2 for i in clock_faults | attitude_faults}
    np.testing.assert_allclose(np.linalg.norm(telemetry.attitude.q_BN, axis=1), 1.0, atol=1e-15)
    with pytest.raises(DataError, match=r"table0\.csv, row 5: gyro_y_rad_s is NaN"):
        read(tmp_path, "\n".join(lines), strict=True)


def test_two_swapped_rows_cost_the_one_that_goes_back(tmp_path):
    data = motion()
    data.iloc[[20, 21]] = data.iloc[[21, 20]].to_numpy()
    assert named(read(tmp_path, data)) == [(23, "time_backwards", "dropped")]


def test_a_row_without_values_is_named_in_a_table_of_one_kind(tmp_path):
    data = motion()
    data.loc[4, GYRO] = np.nan
    telemetry = read(tmp_path, data[["time_s", *GYRO]], data[["time_s", *QUATERNION]])
    assert named(telemetry) == [(6, "nan", "dropped")]


def test_sign_flips_are_no_problem(tmp_path):
    data = motion()
    data.loc[::2, QUATERNION] *= -1.0
    assert read(tmp_path, data, strict=True).problems == ()


@pytest.mark.parametrize(
    ("suffix", "per_si", "quantity"),
    [
        ("deg_s", 180 / np.pi, "rate"),
        ("arcsec_s", 648000 / np.pi, "rate"),
        ("deg_h", 180 / np.pi * 3600, "rate"),
        ("rad", 0.5, "increment"),
    ],
)
def test_units_in_native_names(tmp_path, suffix, per_si, quantity):
    data = motion()
    native = data.rename(columns={f"gyro_{axis}_rad_s": f"gyro_{axis}_{suffix}" for axis in "xyz"})
    native.iloc[:, 1:4] *= per_si
    telemetry = read(tmp_path, native)
    assert telemetry.gyro.quantity == quantity
    rates, reading = to_rates(telemetry.gyro, "instant")
    np.testing.assert_allclose(rates.value, data[GYRO], rtol=1e-12)
    assert reading == ("instant" if quantity == "rate" else "mean_since_previous")


def test_an_increment_covers_its_own_step_even_after_a_bad_row(tmp_path):
    data = motion()
    data[GYRO] *= 0.5
    data.loc[10, GYRO[0]] = np.nan
    rates, _ = to_rates(read(tmp_path, data).gyro, "increment_rad")
    np.testing.assert_allclose(rates.value, motion()[GYRO].drop(10), rtol=1e-12)


def test_foreign_layouts_mean_the_same(tmp_path):
    data = motion()
    native = read(tmp_path, data)
    R_BN = Rotation.from_quat(data[QUATERNION].to_numpy())
    foreign = pd.DataFrame({"ticks": (data["time_s"] * 256).astype(int)})
    foreign[["q0", "q1", "q2", "q3"]] = np.roll(R_BN.inv().as_quat(), 1, axis=1)
    foreign[["wx", "wy", "wz"]] = np.rad2deg(R_BN.inv().apply(data[GYRO].to_numpy()))
    columns = ColumnsConfiguration(
        time="ticks",
        clock_unit_s=1 / 256,
        gyro=["wx", "wy", "wz"],
        gyro_unit="deg/s",
        gyro_frame="base",
        quaternion=["q0", "q1", "q2", "q3"],
        quaternion_order="wxyz",
        quaternion_sense="nb",
    )
    telemetry = read(tmp_path, foreign.to_csv(index=False, sep=";"), columns=columns)
    np.testing.assert_allclose(telemetry.gyro.value, native.gyro.value, atol=1e-15)
    np.testing.assert_allclose(telemetry.attitude.q_BN, native.attitude.q_BN, atol=1e-15)
    np.testing.assert_array_equal(telemetry.gyro.time, native.gyro.time)


def test_base_rates_are_turned_by_interpolated_attitudes_and_never_extrapolated(tmp_path):
    data = motion(201, dt=0.05)
    R_BN = Rotation.from_quat(data[QUATERNION].to_numpy())
    data[GYRO] = R_BN.inv().apply(data[GYRO].to_numpy())
    attitude = data[["time_s", *QUATERNION]].iloc[10:191:20]
    telemetry = read(tmp_path, data[["time_s", *GYRO]], attitude, columns=ColumnsConfiguration(gyro_frame="base"))
    body = motion(201, dt=0.05)[GYRO].to_numpy()[10:191]
    np.testing.assert_allclose(telemetry.gyro.value, body, atol=2e-6)  # the rate changes within the second between
    np.testing.assert_allclose(telemetry.gyro.value[::20], body[::20], atol=1e-15)
    assert {(p.kind, p.action) for p in telemetry.problems} == {("frame", "dropped")}
    assert [p.row for p in telemetry.problems] == [*range(2, 12), *range(193, 203)]


def test_base_rates_are_turned_by_the_attitude_at_their_time_not_at_their_stamp(tmp_path):
    data = motion(201, dt=0.05)
    body = data[GYRO].to_numpy()
    rates = data[["time_s", *GYRO]].assign(
        **dict(zip(GYRO, Rotation.from_quat(data[QUATERNION].to_numpy()).inv().apply(body).T))
    )
    attitude = data[["time_s", *QUATERNION]].assign(time_s=data["time_s"] - 1.0)
    base = ColumnsConfiguration(gyro_frame="base")
    early = read(
        tmp_path, rates.assign(time_s=rates["time_s"] + 3.0), attitude, columns=base, offsets=TimeOffsets(-3.0, 1.0)
    )
    np.testing.assert_allclose(early.gyro.value, body, atol=1e-12)
    np.testing.assert_allclose(early.gyro.time, early.attitude.time, atol=1e-12)
    assert early.problems == ()


def test_maps_by_file(tmp_path):
    data = motion()
    star = data[["time_s", *QUATERNION]].set_axis(["t", "a", "b", "c", "d"], axis=1)
    columns = [ColumnsConfiguration(file="table1*", time="t", quaternion=["a", "b", "c", "d"]), ColumnsConfiguration()]
    telemetry = read(tmp_path, data[["time_s", *GYRO]], star, columns=columns)
    assert (len(telemetry.gyro), len(telemetry.attitude)) == (50, 50)


def test_star_directions_one_row_per_star(tmp_path):
    time = np.repeat([1.0, 2.0], 3)
    star_n = Rotation.random(6, rng=np.random.default_rng(1)).apply([1.0, 0.0, 0.0])
    R_BN = Rotation.from_rotvec([0.1, 0.2, 0.3])
    stars = pd.DataFrame(np.column_stack([time, R_BN.apply(star_n), star_n]))
    stars.columns = ["time_s", *(f"star_{frame}_{axis}" for frame in "bn" for axis in "xyz")]
    telemetry = read(tmp_path, motion()[["time_s", *GYRO]], stars)
    assert telemetry.problems == ()
    assert telemetry.directions is not None
    np.testing.assert_allclose(telemetry.directions.star_B, R_BN.apply(telemetry.directions.star_N), atol=1e-12)
    assert telemetry.directions.time.tolist() == [0, 0, 0, 1, 1, 1]
    with pytest.raises(DataError, match="star_b columns need star_n"):
        read(tmp_path, stars.iloc[:, :4])


def test_utc_and_gps_tables_fit_together(tmp_path):
    data = motion(4, dt=1.0)
    gyro, attitude = data[["time_s", *GYRO]].copy(), data[["time_s", *QUATERNION]].copy()
    gyro["time_s"] = [f"2016-12-31T23:59:{s}Z" for s in ("58", "59", "60", "60.5")]
    attitude["time_s"] = 1167264015.0 + np.arange(4)  # GPS seconds of 2016-12-31T23:59:58 UTC, GPS - UTC = 17 s
    gyro, attitude = gyro.rename(columns={"time_s": "time_utc"}), attitude.rename(columns={"time_s": "time_gps_s"})
    telemetry = read(tmp_path, gyro, attitude)
    assert telemetry.gyro.time.tolist() == [0, 1, 2, 2.5]
    assert telemetry.attitude.time.tolist() == [0, 1, 2, 3]
    assert "2016-12-31T23:59:58" in telemetry.clock


def test_relative_and_absolute_times_do_not_mix(tmp_path):
    data = motion(4)
    unix = data[["time_s", *QUATERNION]].rename(columns={"time_s": "time_unix_s"})
    unix["time_unix_s"] += 1.4e9
    with pytest.raises(DataError, match=r"(?s)plain seconds .*not known.*clock_scale"):
        read(tmp_path, data[["time_s", *GYRO]], unix)


@pytest.mark.parametrize(
    ("content", "columns", "words"),
    [
        ("a,b\n1,2\n", None, ["Columns found: a, b", "gyro_x_rad_s", "q_bn_w", "[columns]"]),
        ("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_zz_rad_s\n1,2,3,4\n", None, ["gyro_z_rad_s", "'gyro_zz_rad_s'"]),
        ("t,w_x,w_y,w_z\n1,2,3,4\n", {"time": "t", "gyro": ["w_x", "w_y", "v_z"]}, ["v_z", "did you mean 'w_z'"]),
        ("t,wx,wy,wz\n1,2,3,4\n", {"time": "tt", "gyro": ["wx", "wy", "wz"]}, ["no time", "tt"]),
        ("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\nx,2,3,4\n", None, ["'x'", "clock_scale"]),
        ("time_utc,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n1e9,2,3,4\n", None, ["POSIX", 'clock_scale = "unix"']),
        ("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n1,nan,3,4\n", None, ["none of its 1 rows is usable", "row 2"]),
        ("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n1,2,3,4\n", None, ["no usable attitude"]),
        ("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n1,2,3,4\n", {"gyro_frame": "base"}, ["needs attitudes"]),
    ],
)
def test_tables_that_cannot_be_understood_say_why(tmp_path, content, columns, words):
    with pytest.raises(DataError) as caught:
        read(tmp_path, content, columns=columns and ColumnsConfiguration(**columns))
    for word in words:
        assert word in str(caught.value)


def test_gyro_alone_is_enough_where_only_it_is_needed(tmp_path):
    assert len(read(tmp_path, motion()[["time_s", *GYRO]], needs=["gyro"]).gyro) == 50


def test_the_documentation_has_every_kind_of_problem():
    table = (Path(__file__).parents[2] / "docs" / "telemetry.md").read_text(encoding="utf-8").split("## Bad rows")[1]
    first_cells = "".join(line.split("|")[1] for line in table.split("\n## ")[0].splitlines() if line.startswith("|"))
    assert not [kind for kind in KINDS if f"`{kind}`" not in first_cells]


def test_a_file_twice_and_no_file(tmp_path):
    with pytest.raises(DataError, match="given twice"):
        read_telemetry([tmp_path / "a.csv", tmp_path / "a.csv"])
    with pytest.raises(DataError, match="no file"):
        read_telemetry([])


def test_the_map_is_checked():
    with pytest.raises(ValidationError, match="quaternion = "):
        ColumnsConfiguration(quaternion_sense="nb")
    with pytest.raises(ValidationError, match="'wx' is named 2 times"):
        ColumnsConfiguration(gyro=["wx", "wy", "wx"])
    with pytest.raises(ValidationError, match="'t' is named 2 times"):
        ColumnsConfiguration(time="t", star_b=["t", "u", "v"])


def test_a_time_of_durations_counts_seconds(tmp_path):
    data = motion()
    data.assign(time_s=pd.to_timedelta(data["time_s"], unit="s")).to_parquet(tmp_path / "t.parquet")
    telemetry = read_telemetry([tmp_path / "t.parquet"])
    np.testing.assert_array_equal(telemetry.gyro.time, data["time_s"] - 100.0)
    with pytest.raises(DataError, match="leave out clock_unit_s"):
        read_telemetry([tmp_path / "t.parquet"], ColumnsConfiguration(clock_unit_s=1e-9))


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"gyro": ["gyro_x", "gyro_y", "gyro_z"]}, ["gyro: there is no column gyro_x", "mean 'gyro_x_rad_s'"]),
        ({"time": "time_ms"}, ["time: there is no column time_ms", "did you mean 'time_s'"]),
        ({"quaternion": ["q0", "q1", "q2", "q3"]}, ["quaternion: there is no column q0"]),
    ],
)
def test_a_name_that_no_table_has_is_refused_though_there_are_native_columns(tmp_path, columns, words):
    data, given = motion(), ColumnsConfiguration(**columns)
    for tables in ([data], [data[["time_s", *GYRO]], data[["time_s", *QUATERNION]]]):
        with pytest.raises(DataError) as caught:
            read(tmp_path, *tables, columns=given)
        assert all(word in str(caught.value) for word in words)
    # Another map's files and a kind that is not asked for are no reason to complain.
    read(tmp_path, data, columns=[given.model_copy(update={"file": "other*"})])
    if "quaternion" in columns:
        read(tmp_path, data[["time_s", *GYRO]], columns=given, needs=["gyro"])


def test_a_map_may_name_what_only_one_of_two_tables_has(tmp_path):
    data = motion()
    gyro = data[["time_s", *GYRO]].set_axis(["t", "wx", "wy", "wz"], axis=1)
    star = data[["time_s", *QUATERNION]]
    telemetry = read(tmp_path, gyro, star, columns=ColumnsConfiguration(time="t", gyro=["wx", "wy", "wz"]))
    assert (len(telemetry.gyro), len(telemetry.attitude)) == (50, 50)


def test_where_all_rows_of_a_kind_are_bad_the_first_is_named(tmp_path):
    data = motion()
    with pytest.raises(DataError, match=r"no usable gyro row, .* row 2: gyro_y_rad_s is NaN"):
        read(tmp_path, data.assign(gyro_y_rad_s="inf"))
    with pytest.raises(DataError, match=r"no usable attitude or star row, .* row 2: the quaternion has length"):
        read(tmp_path, data.assign(q_bn_w=9.0, gyro_x_rad_s=["x", *data["gyro_x_rad_s"][1:]]))
    with pytest.raises(DataError, match=r"the columns gyro_x_rad_s, .* are empty in every row"):
        read(tmp_path, data.assign(**dict.fromkeys(GYRO)))


@pytest.mark.shared_data
@pytest.mark.parametrize(("name", "rows"), [("mro_psp001446.csv", 13298), ("dawn_fc_150615.csv", 3346)])
def test_flight_series_rates_agree_with_quaternions(name, rows):
    if not (FLIGHT / name).exists():
        pytest.skip(f"{FLIGHT / name} is not here; it is not part of the repository")
    columns = ColumnsConfiguration(
        time="sclk_s",
        gyro=["wx_base", "wy_base", "wz_base"],
        gyro_frame="base",
        quaternion=["q0", "q1", "q2", "q3"],
        quaternion_order="wxyz",
    )
    telemetry = read_telemetry([FLIGHT / name], columns, strict=True)
    assert (len(telemetry.gyro), len(telemetry.attitude), telemetry.problems) == (rows, rows, ())
    R_BN = Rotation.from_quat(telemetry.attitude.q_BN)
    turn = -(R_BN[1:] * R_BN[:-1].inv()).as_rotvec()
    integral = 0.5 * np.diff(telemetry.gyro.time)[:, None] * (telemetry.gyro.value[1:] + telemetry.gyro.value[:-1])
    assert np.sqrt(np.mean((turn - integral) ** 2)) < 4.0 * np.pi / 648000  # README: 1.8 and 2.7 arcsec in 2 s
    assert np.sqrt(np.mean((turn + integral) ** 2)) > 10 * np.sqrt(np.mean((turn - integral) ** 2))  # the wrong sense
