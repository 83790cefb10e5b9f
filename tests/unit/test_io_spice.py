"""SPICE CK: what is written, SPICE's own library reads back to 1e-12; what that library writes is read."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from telemetry_simulator import ARCSEC, Setup, simulate, slews

from helmstar.cli import main
from helmstar.errors import DataError, HelmstarError
from helmstar.io.clock import Instants, Origin
from helmstar.io.settings import FormatSettings, SpiceConfiguration
from helmstar.io.spice_ck import CkSegment, write_ck
from helmstar.io.spice_kernels import instants_from_tdb, leap_second_kernel, loaded
from helmstar.io.telemetry import read_telemetry
from helmstar.telemetry.export import check_export

relaxed = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
ORIGIN = Origin(8035, 37.25, absolute=True)  # 2021-12-31T00:00:00.25 UTC
BODY = -999000


@pytest.fixture(scope="module")
def spice():
    return pytest.importorskip("spiceypy", reason='spiceypy is not installed (pip install "helmstar[spice]")')


def segment(rng, start, n):
    time = start + np.cumsum(rng.uniform(0.01, 0.5, n))
    return CkSegment(time, Rotation.from_quat(rng.normal(size=(n, 4))).as_quat(), rng.normal(size=(n, 3)) * 1e-2)


@pytest.fixture(scope="module")
def written(spice, tmp_path_factory):
    """Two segments with a gap, and the files."""
    rng = np.random.default_rng(4)
    segments = [segment(rng, 0.0, 250), segment(rng, 500.0, 120)]
    path = tmp_path_factory.mktemp("ck") / "attitude.bc"
    return segments, write_ck(path, ORIGIN, segments, comments=["estimated", "with = äöü"])


@pytest.fixture
def furnished(spice, written):
    """SPICE with the three files loaded as docs/telemetry.md says."""
    _, files = written
    for file in files:
        spice.furnsh(str(file))
    yield spice
    for file in files:
        spice.unload(str(file))


def joined(segments):
    return tuple(np.concatenate([getattr(s, name) for s in segments]) for name in ("time", "q_BN", "rate"))


def test_spice_reads_attitude_and_rate_back_to_1e_12(furnished, written):
    spice = furnished
    time, q_BN, rate = joined(written[0])
    R_BN = Rotation.from_quat(q_BN).as_matrix()
    ticks = (time + 0.25) * 1e6
    for i, tick in enumerate(ticks):
        C, rate_N, out = spice.ckgpav(BODY, tick, 0.0, "J2000")
        assert out == tick
        np.testing.assert_allclose(C, R_BN[i], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(R_BN[i] @ rate_N, rate[i], rtol=0.0, atol=1e-12)


def test_spice_finds_it_by_date_and_frame(furnished, written):
    """Through leap seconds, TDB and the clock; SPICE's seconds past J2000 hold 1.2e-7 s, so a rate times that is left."""
    spice = furnished
    time, q_BN, _ = joined(written[0])
    for i in (0, 100, 249, 250, 369):
        et = spice.str2et(ORIGIN.utc(time[i : i + 1], 9)[0])
        ticks = spice.sce2c(-999, et)
        assert ticks == pytest.approx((time[i] + 0.25) * 1e6, abs=0.5)
    middle = Rotation.from_matrix(spice.ckgp(BODY, 0.25e6 + 1e6 * 0.5 * (time[5] + time[6]), 0, "J2000")[0])
    whole = (Rotation.from_quat(q_BN[6]) * Rotation.from_quat(q_BN[5]).inv()).magnitude()
    half = (middle * Rotation.from_quat(q_BN[5]).inv()).magnitude()
    assert half == pytest.approx(0.5 * whole, abs=1e-9)  # linear between two instants
    assert spice.pxform("J2000", "HELMSTAR_BODY", spice.sct2e(-999, 0.25e6 + 1e6 * time[5])).shape == (3, 3)


def test_spice_does_not_interpolate_over_the_gap(furnished, written):
    from spiceypy.utils.exceptions import NotFoundError

    with pytest.raises(NotFoundError):
        furnished.ckgp(BODY, 300e6, 0, "J2000")
    cover = furnished.ckcov(str(written[1][0]), BODY, False, "INTERVAL", 0.0, "SCLK")
    assert furnished.wncard(cover) == 2


def test_our_leap_seconds_are_spices(spice, tmp_path):
    (tmp_path / "own.tls").write_text(leap_second_kernel())
    with loaded([tmp_path / "own.tls"]) as library:
        for date, offset in [("1972-07-01", 11), ("1999-06-01", 32), ("2016-12-31", 36), ("2017-01-02", 37)]:
            utc = library.str2et(f"{date}T12:00:00")
            tai = library.unitim(utc, "ET", "TAI")
            calendar = (np.datetime64(date) - np.datetime64("2000-01-01")) / np.timedelta64(1, "s")
            assert tai - calendar == pytest.approx(offset, abs=1e-6)


def test_tdb_is_spices(spice, tmp_path):
    et = np.linspace(-9e8, 9e8, 41)
    with loaded([]) as library:
        tai = np.array([library.unitim(float(x), "ET", "TAI") for x in et])
    mine: Instants = instants_from_tdb(et)
    np.testing.assert_allclose(mine.day * 86400.0 + mine.second - 43200.0, tai, rtol=0.0, atol=3e-7)


def test_nothing_stays_loaded(spice):
    before = spice.ktotal("ALL")
    with (
        pytest.raises(DataError, match="no such SPICE kernel"),
        loaded([Path("/nowhere/x.tsc")]),
    ):
        pass
    assert spice.ktotal("ALL") == before


def read(path, **keys):
    settings = FormatSettings(spice=SpiceConfiguration(**keys), folder=path.parent)
    return read_telemetry([path], needs=[], settings=settings)


def test_what_is_written_is_read_back(written):
    segments, files = written
    time, q_BN, _ = joined(segments)
    telemetry = read(files[0], kernels=["attitude.tsc"])
    assert telemetry.problems == ()
    np.testing.assert_allclose(telemetry.attitude.time, time - time[0], atol=3e-7)
    np.testing.assert_allclose(telemetry.attitude.q_BN, q_BN, atol=1e-15)
    assert telemetry.origin.utc([0.0])[0][:23] == ORIGIN.utc(time[:1])[0][:23]


def test_other_types_are_sampled_and_other_frames_turned(spice, written, tmp_path):
    """Type 2, constant rates, relative to the ecliptic: read relative to J2000 at step_s."""
    path = tmp_path / "two.bc"
    handle = spice.ckopn(str(path), "two", 0)
    starts, stops = np.array([1e6, 20e6]), np.array([11e6, 25e6])
    q = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    spice.ckw02(
        handle, 1e6, 25e6, BODY, "ECLIPJ2000", "s", 2, starts, stops, q, np.array([[0.0, 0.0, 0.01]] * 2), [1e-6] * 2
    )
    spice.ckcls(handle)
    telemetry = read(path, kernels=[str(written[1][1])], step_s=0.5)
    assert 28 <= len(telemetry.attitude) <= 32
    ecliptic = Rotation.from_matrix(spice.pxform("J2000", "ECLIPJ2000", 0.0))
    after = telemetry.attitude.time[:10]
    expected = Rotation.from_rotvec(-0.01 * after[:, None] * [0.0, 0.0, 1.0]) * ecliptic
    error = (Rotation.from_quat(telemetry.attitude.q_BN[:10]) * expected.inv()).magnitude()
    np.testing.assert_allclose(error, 0.0, atol=1e-8)


def test_stored_instants_of_another_frame_are_turned(spice, written, tmp_path):
    segments, files = written
    ecliptic = write_ck(tmp_path / "e.bc", ORIGIN, segments, SpiceConfiguration(reference="ECLIPJ2000"))
    plain, turned = read(files[0], kernels=["attitude.tsc"]), read(ecliptic[0], kernels=["e.tsc"])
    R = Rotation.from_matrix(spice.pxform("J2000", "ECLIPJ2000", 0.0))
    expected = Rotation.from_quat(plain.attitude.q_BN) * R
    error = (Rotation.from_quat(turned.attitude.q_BN) * expected.inv()).magnitude()
    np.testing.assert_allclose(error, 0.0, atol=1e-12)


def test_a_kernel_of_the_other_byte_order_is_read(written, tmp_path):
    content = written[1][0].read_bytes()
    record = 1024 * (int.from_bytes(content[76:80], "little") - 1)
    swapped = bytearray(np.frombuffer(content, "<f8").astype(">f8").tobytes())
    swapped[:1024] = content[:1024]
    for place in (8, 12, 76, 80, 84, *range(record + 40, record + 64, 4)):
        swapped[place : place + 4] = content[place : place + 4][::-1]
    swapped[88:96] = b"BIG-IEEE"
    (tmp_path / "big.bc").write_bytes(swapped)
    other = read(tmp_path / "big.bc", kernels=[str(written[1][1])])
    np.testing.assert_array_equal(other.attitude.q_BN, read(written[1][0], kernels=["attitude.tsc"]).attitude.q_BN)


def test_errors_say_what_to_give(written, tmp_path):
    _, files = written
    with pytest.raises(DataError, match=r"attitude\.bc: SPICE says.*\[spice\] kernels"):
        read(files[0])
    with pytest.raises(DataError, match="no object -82000 in this CK; there are: -999000"):
        read(files[0], instrument_id=-82000, kernels=["attitude.tsc"])
    with pytest.raises(DataError, match=r"nope\.tsc: there is no such SPICE kernel"):
        read(files[0], kernels=["nope.tsc"])
    (tmp_path / "x.bc").write_bytes(b"not a kernel")
    with pytest.raises(DataError, match=r"x\.bc: not a binary SPICE CK"):
        read(tmp_path / "x.bc")
    (tmp_path / "t.xc").write_bytes(b"DAFETF NAIF DAF ENCODED TRANSFER FILE\n")
    with pytest.raises(DataError, match="tobin"):
        read(tmp_path / "t.xc")


def test_without_spiceypy_the_remedy_is_said(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    (tmp_path / "x.bc").write_bytes(b"DAF/CK  " + bytes(1016))
    with pytest.raises(DataError, match=r'pip install "helmstar\[spice\]"'):
        read(tmp_path / "x.bc")
    with pytest.raises(DataError, match=r'pip install "helmstar\[spice\]"'):
        write_ck(tmp_path / "y.bc", ORIGIN, [])
    with pytest.raises(DataError, match=r'pip install "helmstar\[spice\]"'):  # --ck says so before the work
        check_export(ORIGIN, aem=False, ck=True)


def pointing_to(name, error):
    assert name in str(error)


@relaxed
@given(data=st.data())
def test_damaged_kernels_never_give_a_traceback(written, tmp_path, data):
    content = bytearray(written[1][0].read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.one_of(st.integers(0, 3200), st.integers(0, len(content) - 1)))
        content[place : place + 4] = data.draw(st.binary(min_size=4, max_size=4))
    content = content[: data.draw(st.integers(1, len(content)))] if data.draw(st.booleans()) else content
    path = tmp_path / "d.bc"
    path.write_bytes(content)
    try:
        telemetry = read(path, kernels=[str(written[1][1])])
    except HelmstarError as error:
        return pointing_to("d.bc", error)
    assert (np.diff(telemetry.attitude.time) > 0.0).all()


def test_helmstar_attitude_writes_one_that_spice_reads(spice, tmp_path, capsys):
    record = simulate(Setup(duration_s=240.0, rate=slews(), gyro_gaps=((100.05, 109.95),), star_gaps=((99.0, 111.0),)))
    for table, name in ((record.gyro, "gyro"), (record.star, "star")):
        table.assign(time_gps_s=table.pop("time_s") + 1.3e9).to_csv(tmp_path / f"{name}.csv", index=False)
    files = [str(tmp_path / f"{name}.csv") for name in ("gyro", "star")]
    out = tmp_path / "out"
    assert main(["attitude", *files, "--ck", "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["exports"] == {
        "ck": str(out / "attitude.bc"), "sclk": str(out / "attitude.tsc"), "lsk": str(out / "attitude.tls"),
    }  # fmt: skip
    with loaded([out / "attitude.tls", out / "attitude.tsc", out / "attitude.bc"]) as library:
        assert library.wncard(library.ckcov(str(out / "attitude.bc"), BODY, True, "INTERVAL", 0.0, "SCLK")) == 2
        import pandas as pd

        smoothed = pd.read_parquet(out / "smoothed.parquet")
        zero = float("0." + result["origin"].removesuffix(" UTC").split(".")[1])  # the clock counts from a whole second
        attitude_error, rate_error = [], []
        for t, q in zip(smoothed["time_s"][::37], smoothed[[f"q_bn_{a}" for a in "xyzw"]].to_numpy()[::37]):
            C, rate_N, _ = library.ckgpav(BODY, (t + zero) * 1e6, 0.5, "J2000")
            attitude_error.append((Rotation.from_matrix(C) * Rotation.from_quat(q).inv()).magnitude())
            rate_error.append(C @ rate_N - record.setup.rate(np.array([t]))[0])
    np.testing.assert_allclose(attitude_error, 0.0, atol=1e-9)
    assert np.sqrt(np.mean(np.square(rate_error))) < 2.0 * ARCSEC  # white noise of the gyro: 0.3 arcsec/s


def _origin(result):
    import pyarrow as pa

    from helmstar.io.clock import from_texts

    instants, _ = from_texts(pa.array([result["origin"].removesuffix(" UTC")]), "utc")
    return int(instants.day[0]), float(instants.second[0]), True
