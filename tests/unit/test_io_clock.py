"""Time scales against erfa (by another route than the code's) and leap seconds known from the bulletins."""

import datetime

import erfa
import numpy as np
import pyarrow as pa
import pytest

from helmstar.io.clock import Instants, Origin, from_numbers, from_texts, tai_minus_utc

TAI_2000 = Origin(0, 0.0, True)


def seconds(texts, scale):
    instants, good = from_texts(pa.array(texts), scale)
    assert good.all()
    return instants.since(TAI_2000)


@pytest.mark.parametrize(
    ("utc", "expected"),
    [
        ("1972-01-01T00:00:00", 10),
        ("2016-12-31T23:59:59", 36),
        ("2017-01-01T00:00:00", 37),
        ("2012-06-30T12:00:00", 34),
    ],
)
def test_tai_minus_utc_is_that_of_the_bulletins(utc, expected):
    assert seconds([utc], "utc")[0] - seconds([utc], "tai")[0] == expected


def test_utc_agrees_with_erfa():
    rng = np.random.default_rng(3)
    days = np.datetime64("1973-01-01") + rng.integers(0, 19000, 300)
    clock = rng.integers(0, 86400, 300)
    texts = [f"{d}T{s // 3600:02d}:{s // 60 % 60:02d}:{s % 60:02d}.25Z" for d, s in zip(days, clock)]
    ymd = np.array([[int(part) for part in str(day).split("-")] for day in days])
    utc = erfa.dtf2d("UTC", *ymd.T, clock // 3600, clock // 60 % 60, clock % 60 + 0.25)
    tai = erfa.utctai(*utc)
    expected = (tai[0] - 2451544.5) * 86400.0 + tai[1] * 86400.0
    np.testing.assert_allclose(seconds(texts, "utc"), expected, rtol=0, atol=2e-6)  # 1 ulp of erfa's day fraction


def test_a_leap_second_lasts_one_second():
    times = seconds(
        ["2016-12-31T23:59:59.5", "2016-12-31T23:59:60.5Z", "2017-01-01T00:00:00.5", "2017-01-01 08:59:60.5+09:00"],
        "utc",
    )
    np.testing.assert_array_equal(times - times[0], [0, 1, 2, 1])


@pytest.mark.parametrize(
    "text",
    [
        "2015-12-31T23:59:60", "2016-12-31T23:58:60", "2016-12-31T23:59:61", "2015-02-29T00:00:00",
        "2015-13-01T00:00:00",
        "2015-366T00:00:00", "2015-000T00:00:00", "2015-01-01T24:00:00", "2015-01-01T00:60:00", "1971-06-01T00:00:00",
        "2015-01-01T00:00:00+99:99", "2015-01-01T00:00:00-00:75", "2015-01-01T00:00:00+2400", "2015-01-01T00:00:00+1260",
        "0000-01-01T00:00:00", "junk", "", "2015-01-01", "2015-01-01T00:00:00 UTC", "NaT",
    ],
)  # fmt: skip
def test_what_is_no_utc_time_is_refused(text):
    assert from_texts(pa.array([text, "2015-01-01T00:00:00"]), "utc")[1].tolist() == [False, True]


def test_z_belongs_to_utc_only():
    assert not from_texts(pa.array(["2015-01-01T00:00:00Z"]), "tai")[1].any()


def test_day_of_year_and_precision():
    times = seconds(["2016-060T00:00:00.000000000", "2016-02-29T00:00:00.123456789"], "tai")
    instants, _ = from_texts(pa.array(["2016-060T00:00:00.0", "2016-02-29T00:00:00.123456789"]), "tai")
    assert abs(times[1] - times[0] - 0.123456789) < 1e-7
    assert abs(np.diff(instants.since(instants.earliest()))[0] - 0.123456789) < 1e-15


def test_utc_tai_gps_and_unix_mean_the_same_instant():
    posix = datetime.datetime(
        2015, 6, 15, 12, 0, 0, tzinfo=datetime.UTC
    ).timestamp()  # TAI - UTC = 35 s, GPS - UTC = 16 s
    gps_s = (datetime.datetime(2015, 6, 15, 12) - datetime.datetime(1980, 1, 6)).total_seconds() + 16.0
    same = [
        seconds(["2015-06-15T12:00:00Z"], "utc")[0],
        seconds(["2015-06-15T12:00:35"], "tai")[0],
        seconds(["2015-06-15T12:00:16"], "gps")[0],
        *(from_numbers(np.array([value]), scale)[0].since(TAI_2000)[0]
          for value, scale in ((posix, "unix"), (gps_s, "gps"), (posix + 35.0, "tai"))),
    ]  # fmt: skip
    assert same == [same[0]] * 6


def test_numbers_that_are_no_times():
    value = np.array([np.nan, np.inf, 1e300, -1e9, 1.4e9])
    assert from_numbers(value, "unix")[1].tolist() == [False, False, False, False, True]  # -1e9 is 1938
    assert from_numbers(value, "s")[1].tolist() == [False, False, False, True, True]


def test_tai_minus_utc_before_1972_is_nan():
    assert np.isnan(tai_minus_utc(np.array([-10228]))[0])  # 1971-12-31
    assert tai_minus_utc(np.array([-10227]))[0] == 10.0


def test_origin_prints_utc_again():
    instants, _ = from_texts(pa.array(["2016-12-31T23:59:60.250000Z"]), "utc")
    assert str(instants.earliest()) == "2016-12-31T23:59:60.250000 UTC"
    assert instants.earliest().tai([0.75]) == ["2017-01-01T00:00:37.000000"]
    relative = Instants(np.zeros(1, dtype=int), np.array([5.0]), absolute=False).earliest()
    with pytest.raises(ValueError, match="no calendar"):
        relative.utc([0.0])
