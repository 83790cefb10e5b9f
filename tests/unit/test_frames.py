"""A folder of star images into `helmstar attitude`: rendered sequences of known truth, with a gyro and without."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image as Picture
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helmstar.cli import main
from helmstar.errors import ConfigurationError, DataError
from helmstar.io.clock import Origin
from helmstar.io.telemetry import AttitudeRows, GyroRows, Telemetry, read_telemetry
from helmstar.sensors.configuration import SensorsConfiguration
from helmstar.startracker.command import SolveOptions
from helmstar.startracker.frames import find_frames, solve_frames
from helmstar.telemetry.solve import solve

OPTICS = SolveOptions(fov="14")
MOUNTING = [0.1, -0.2, 0.3, 0.9273618495495703]
FRAMES = 14


def render(folder: Path, *more: str) -> list[dict]:
    argv = ["--fov", "14", "--size", "320x240", "--out", str(folder), "--exposure", "0.1", *more]
    assert main(["render", "--ra", "120", "--dec", "-30", "--roll", "200", *argv]) == 0
    return json.loads((folder / "truth.json").read_text())["frames"]


@pytest.fixture(scope="module")
def night(tmp_path_factory) -> tuple[Path, list[dict]]:
    """Two of its frames show no stars."""
    folder = tmp_path_factory.mktemp("frames") / "night"
    truth = render(
        folder,
        "--rate-deg-s",
        "0.01,0.03,-0.05",
        "--count",
        str(FRAMES),
        "--step",
        "2",
        "--time",
        "2024-03-01T20:00:00",
    )
    (folder / "frame_0007.png").write_text("no image")
    Picture.fromarray(np.zeros((240, 320), np.uint8)).save(folder / "frame_0011.png")
    return folder, truth


def nees(table: pd.DataFrame, truth: list[dict], q_SB: list[float]) -> np.ndarray:
    """Normalised error squared (n,) at the truth's times that the table has; error on the left in B."""
    R_SB = Rotation.from_quat(q_SB)
    at = {round(f["time_s"], 6): f for f in truth}
    rows = [(i, at[round(t, 6)]) for i, t in enumerate(table["time_s"]) if round(t, 6) in at]
    index = np.array([i for i, _ in rows])
    q_true = R_SB.inv() * Rotation.from_quat([f["q_sn"] for _, f in rows])
    q = Rotation.from_quat(table[[f"q_bn_{a}" for a in "xyzw"]].to_numpy()[index])
    error = (q_true * q.inv()).as_rotvec()
    P = np.empty((len(index), 3, 3))
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            name = f"cov_theta_{a}_theta_{b}" if i <= j else f"cov_theta_{b}_theta_{a}"
            P[:, i, j] = table[name].to_numpy()[index]
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)


def attitude(capsys, *argv: str) -> dict:
    assert main(["attitude", *argv, "--csv", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_without_a_gyro_attitude_and_rate_are_within_their_sigma(capsys, tmp_path, night):
    folder, truth = night
    config = tmp_path / "sensors.toml"
    config.write_text(f"[star]\nq_sb = {MOUNTING}\n")
    result = attitude(capsys, str(folder), "--fov", "14", "--config", str(config), "--out", str(tmp_path / "out"))
    assert result["frames"]["status"] == {"solved": FRAMES - 2, "unreadable": 1, "too few stars": 1}
    lost = [p for p in result["problems"] if p["kind"] == "unsolved"]
    assert [p["row"] for p in lost] == [9, 13]  # lines of frames.csv
    assert "frame_0007.png" in lost[0]["message"]
    assert "too few stars" in lost[1]["message"]
    assert result["drift_arcsec_s"] is None
    smoothed = pd.read_csv(result["tables"]["smoothed"])
    filtered = pd.read_csv(result["tables"]["filtered"])
    assert len(filtered) == FRAMES - 2
    # Filtered errors of different times share what is not forgotten, so the mean is judged as if a third of them were
    # independent; the frames' covariance holds a floor for imperfect optics, so the lower end is left wide.
    some = (FRAMES - 2) // 3
    for table in (filtered, smoothed):
        mean = nees(table, truth, MOUNTING).mean()
        assert 0.3 < mean < chi2.ppf(0.999, 3 * some) / some
    # The rate in B is that of S, turned: omega_B = R_BS omega_S, within 5 sigma on each axis.
    rate = Rotation.from_quat(MOUNTING).inv().apply([0.01, 0.03, -0.05])
    assert np.all(np.abs(np.array(result["rate_deg_s"]) - rate) < 5.0 * np.array(result["rate_sigma_deg_s"]))
    assert max(result["rate_sigma_deg_s"]) < 1e-3
    assert result["noise"]["star_sigma_arcsec"]["source"] == "of each frame by its stars"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Body rate" in page
    assert "Star images" in page
    assert "Gyro drift" not in page


def test_with_a_gyro_its_drift_is_found(capsys, tmp_path, night):
    """A gyro of 1 arcsec/sqrt(s) with a drift of 20 arcsec/s; S is B here."""
    folder, truth = night
    rng = np.random.default_rng(8)
    time = np.arange(0.0, 2.0 * FRAMES, 0.25)
    drift = np.radians(20.0 / 3600.0) * np.array([1.0, -0.5, 0.3])
    noise = np.radians(1.0 / 3600.0) / np.sqrt(0.25) * rng.standard_normal((len(time), 3))
    rates = np.radians([0.01, 0.03, -0.05]) + drift + noise
    stamps = (np.datetime64("2024-03-01T20:00:00") + (time * 1e6).astype("timedelta64[us]")).astype(str)
    gyro = tmp_path / "gyro.csv"
    pd.DataFrame({"time_utc": stamps, **{f"gyro_{a}_rad_s": rates[:, i] for i, a in enumerate("xyz")}}).to_csv(
        gyro, index=False
    )
    config = tmp_path / "sensors.toml"
    config.write_text('[gyro]\narw_arcsec_sqrt_s = 1.0\nrrw_arcsec_s_sqrt_s = 1e-3\nreading = "mean_since_previous"\n')
    result = attitude(
        capsys, str(folder), str(gyro), "--fov", "14", "--config", str(config), "--out", str(tmp_path / "out")
    )
    found, sigma = np.array(result["drift_arcsec_s"]), np.array(result["drift_sigma_arcsec_s"])
    assert np.all(np.abs(found - np.degrees(drift) * 3600.0) < 5.0 * sigma)
    assert sigma.max() < 3.0
    smoothed = pd.read_csv(result["tables"]["smoothed"])
    assert 0.3 < nees(smoothed, truth, [0, 0, 0, 1]).mean() < 3.0 * 2.5
    assert result["rows"]["star_epochs"] == FRAMES - 2


def test_later_frames_are_looked_for_where_the_rate_leads(night, monkeypatch):
    """From the third frame on there is a prediction; it is right within its sigma, and the same stars are found without it."""
    from helmstar.startracker import frames

    folder, truth = night
    predicted = {}
    real = frames._prediction

    def remember(found, time, k):
        predicted[k] = real(found, time, k)
        return predicted[k]

    monkeypatch.setattr(frames, "_prediction", remember)
    tracked = solve_frames(folder, OPTICS, progress=False)
    assert [k for k, p in predicted.items() if p is None] == [0, 1]
    for k, p in predicted.items():
        if p is not None:
            off = Rotation.from_quat(p[0]) * Rotation.from_quat(truth[k]["q_sn"]).inv()
            assert np.all(np.abs(off.as_rotvec()) < 3.0 * p[1])
            assert p[1] < 1e-2
    monkeypatch.setattr(frames, "_prediction", lambda *a: None)
    searched = solve_frames(folder, OPTICS, progress=False)
    assert np.array_equal(tracked.row, searched.row)
    off = (Rotation.from_quat(tracked.q_SN) * Rotation.from_quat(searched.q_SN).inv()).as_rotvec()
    sigma = np.sqrt(np.diagonal(searched.covariance_S, axis1=1, axis2=2))
    assert np.all(np.abs(off) < 3.0 * sigma)  # not the same to the bit: windows hold the bright stars only


@pytest.mark.parametrize("form", ["fits", "tiff"])
def test_times_come_from_the_images_themselves(tmp_path, form):
    folder = tmp_path / form
    render(folder, "--count", "3", "--step", "1.5", "--time", "2024-03-01T20:00:00", "--format", form)
    (folder / "frames.csv").unlink()
    Picture.fromarray(np.zeros((9, 9), np.uint8)).save(folder / "undated.png")
    (folder / "note.txt").write_text("not an image")
    frames = find_frames(folder)
    assert frames.instants.absolute
    assert frames.instants.seconds() == pytest.approx([0.0, 1.5, 3.0], abs=2e-6)  # FITS: begin plus half an exposure
    assert frames.instants.earliest().utc([0.0])[0].startswith("2024-03-01T20:00:00.00000")
    assert [p.kind for p in frames.problems] == ["time_unreadable"]
    assert "undated.png" in frames.problems[0].message


def test_fits_of_others_say_the_begin_of_the_exposure(tmp_path):
    from helmstar.io.image_files import write_image

    for k in range(2):
        write_image(
            tmp_path / f"{k}.fits",
            np.zeros((5, 6), np.uint16),
            "fits",
            begun=f"2024-03-01T20:00:0{k}.000000",
            exposure_s=0.5,
        )
    assert find_frames(tmp_path).instants.earliest().utc([0.0])[0] == "2024-03-01T20:00:00.250000"


def test_tables_of_frames_that_cannot_be_used(tmp_path):
    with pytest.raises(DataError, match=r"frames\.csv with the columns file"):
        find_frames(tmp_path)
    table = tmp_path / "frames.csv"
    table.write_text("name,time_s\na.png,1\n")
    with pytest.raises(DataError, match="must have the columns file"):
        find_frames(tmp_path)
    table.write_text("file,time_s\nb.png,2\na.png,1\nc.png,soon\nd.png,2\n")
    frames = find_frames(tmp_path)
    assert [f.name for f in frames.files] == ["a.png", "b.png"]
    assert [(p.row, p.kind) for p in frames.problems] == [(4, "time_unreadable"), (5, "time_repeated")]
    solved = solve_frames(tmp_path, OPTICS, progress=False)
    assert not len(solved.row)
    assert [e["status"] for e in solved.entries] == ["unreadable", "unreadable"]
    table.write_text("file,time_s,time_utc\na.png,5,2024-03-01T20:00:00\n,6,2024-03-01T20:00:01\n")
    frames = find_frames(tmp_path)
    assert frames.instants.absolute  # the date is worth more than plain seconds
    assert [(p.row, p.kind, p.message) for p in frames.problems] == [(3, "unsolved", "names no file")]
    table.write_text("file,time_utc\na.png,2150-03-01T20:00:00\n")
    with pytest.raises(DataError, match="after 2099"):
        solve_frames(tmp_path, OPTICS, progress=False)


def test_misuse_of_the_command_is_explained(capsys, tmp_path, night):
    folder, _ = night
    seconds = tmp_path / "gyro.csv"
    seconds.write_text("time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n0,0,0,0\n1,0,0,0\n2,0,0,0\n")
    both = tmp_path / "both.csv"
    both.write_text(
        "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w\n0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n"
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    for argv, word in (
        ([str(seconds), "--fov", "14"], "no folder of frames"),
        ([str(empty)], "no image with a time"),
        ([str(folder), str(empty)], "one folder"),
        ([str(folder), str(both), "--fov", "14"], "beside the frames"),
    ):
        assert main(["attitude", *argv, "--out", str(tmp_path / "o")]) == 1
        assert word in capsys.readouterr().err.splitlines()[-1]


def test_attitudes_alone_are_honest_about_attitude_and_rate():
    """A rate that walks at random by 0.003 deg/s/sqrt(s), 5 arcsec attitudes each second, a gap of 20 s: the walk is found within a
    third; NEES of attitude and of the mean rate since the attitude before lie within what 60 independent triples give, of 240
    that are correlated over some 4 s."""
    rng = np.random.default_rng(2)
    n, sub, walk, sigma = 260, 20, np.radians(0.003), np.radians(5.0 / 3600.0)
    rate = walk * np.cumsum(rng.standard_normal((n * sub, 3)), axis=0) / np.sqrt(sub)
    q = [Rotation.random(rng=rng)]
    for w in rate[:-1]:
        q.append(Rotation.from_rotvec(-w / sub) * q[-1])
    keep = np.ones(n, dtype=bool)
    keep[120:140] = False
    truth, time = Rotation.concatenate(q)[::sub][keep], np.arange(n, dtype=float)[keep]
    measured = Rotation.from_rotvec(sigma * rng.standard_normal((len(time), 3))) * truth
    none, count = np.empty(0, dtype=int), np.arange(len(time))
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (len(time), 3, 3)).copy()
    rows = AttitudeRows(time, 0 * count, count, ("x",), measured.as_quat(), covariance)
    gyro = GyroRows(np.empty(0), none, none)
    solution = solve(Telemetry(gyro, rows, None, (), "s", Origin(0, 0.0, False)), SensorsConfiguration())
    assert solution.rate_sigma == pytest.approx(walk, rel=0.33)
    mean_rate = -(truth[1:] * truth[:-1].inv()).as_rotvec() / np.diff(time)[:, None]
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 180) / 60.0
    for e in (solution.filtered, solution.smoothed):
        error = (truth * Rotation.from_quat(e.q_BN).inv()).as_rotvec()
        squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(e.cov[:, :3, :3]), error)
        assert low < squares.mean() < high
        assert e.rate is not None
        assert e.rate_sigma is not None
        assert 0.5 * low < (((e.rate[1:] - mean_rate) / e.rate_sigma[1:]) ** 2).sum(axis=1).mean() < high
        assert np.sqrt(np.mean(error**2)) < sigma  # better than the measurements


def test_attitudes_without_noise_and_gyro_are_refused(tmp_path):
    table = tmp_path / "q.csv"
    table.write_text("time_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w\n" + "".join(f"{k},0,0,0,1\n" for k in range(5)))
    telemetry = read_telemetry([table], needs=("star",))
    with pytest.raises(DataError, match="sigma_arcsec"):
        solve(telemetry, SensorsConfiguration())
    calibrated = SensorsConfiguration.model_validate(
        {"star": {"sigma_arcsec": 5.0}, "calibrate": {"scale_factor": True}}
    )
    with pytest.raises(ConfigurationError, match="calibrate"):
        solve(telemetry, calibrated)
