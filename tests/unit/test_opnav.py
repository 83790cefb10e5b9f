"""`helmstar opnav`: an approach in rendered frames to centres and a trajectory; the estimator against formulas; OEM; bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from opnav_frames import MOUNTING, body_toml, write_approach
from PIL import Image as Picture

from helmstar.cli import main
from helmstar.errors import DataError
from helmstar.imaging import Camera
from helmstar.imaging.body import LommelSeeliger, sphere
from helmstar.io.clock import from_texts
from helmstar.io.oem import read_oem, write_oem
from helmstar.opnav.trajectory import Observation, Prior, predict_px, solve, states

START, VELOCITY = np.array([-3000.0, 20.0, 60.0]), np.array([6.0, 0.0, 0.0])
UTC = "2026-01-01T00:00:00"


def call(capsys, *argv: str) -> tuple[int, dict, str]:
    code = main(["opnav", *map(str, argv), "--json"])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else {}, out.err


@pytest.fixture(scope="module")
def approach(tmp_path_factory) -> Path:
    """Eight frames of an approach; the body is 5% smaller than said, dark where the model is Lambert, and expected km away."""
    folder = tmp_path_factory.mktemp("approach")
    times = np.array([0.0, 100.0, 200.0, 300.0, 350.0, 400.0, 430.0, 450.0])
    write_approach(
        folder,
        sphere(2e3),
        LommelSeeliger(),
        times=times,
        start_km=START,
        velocity_km_s=VELOCITY,
        seed=3,
        side=200,
        utc=UTC,
    )
    with open(folder / "cam.toml", "a") as file:
        file.write(MOUNTING)
    rng = np.random.default_rng(8)
    expected = START + rng.normal(0.0, [50.0, 8.0, 8.0])
    extra = 'law = "lambert"\nradius_sigma = 0.1'
    text = body_toml("radius_km = 2.1", expected, VELOCITY + rng.normal(0.0, 1e-3, 3), extra, f'time_utc = "{UTC}"')
    (folder / "body.toml").write_text(text)
    return folder


def arguments(folder: Path) -> list[str]:
    names = {"--camera": "cam.toml", "--attitude": "attitude.csv", "--body": "body.toml"}
    return [str(w) for k, v in names.items() for w in (k, folder / v)]


def test_an_approach_becomes_a_trajectory_with_an_honest_covariance(capsys, tmp_path, approach):
    code, result, err = call(capsys, approach / "frames.csv", *arguments(approach), "--out", tmp_path / "nav")
    assert code == 0, err
    frames, t = result["frames"], result["trajectory"]
    assert [Path(f["file"]).name for f in frames] == [f"{k:03d}.png" for k in range(8)]
    assert all(f["status"] == "found" and f["used"] for f in frames)
    assert t["frames_used"] == 8
    error = np.array([*t["position_km"], *t["velocity_km_s"]]) - np.array([*START, *VELOCITY])
    sigma = np.array([*t["position_sigma_km"], *t["velocity_sigma_km_s"]])
    assert np.abs(error / sigma).max() < 4.0
    assert (sigma[1:3] < 2.0).all()  # 8 km before; 0.01 deg of pointing at 3000 km is 0.5 km
    files = {k: Path(v) for k, v in t["files"].items()}
    table = pd.read_parquet(files["trajectory"])
    assert len(table) == 8
    (segment,) = read_oem(files["oem"])
    assert segment.meta["CENTER_NAME"] == "ROCK"
    assert segment.state[:, 0] / 1e3 == pytest.approx(table["x_km"], abs=1e-6)
    assert np.sqrt(segment.covariance[:, 1, 1]) / 1e3 == pytest.approx(table["sigma_y_km"], rel=1e-9)
    assert segment.covariance[:, 1, 0] / 1e6 == pytest.approx(table["cov_y_x"], rel=1e-6, abs=1e-9)
    assert len(pd.read_parquet(files["centres"])) == 8
    for f in frames:
        assert Picture.open(f["plot"]).size[0] >= 800


def test_frames_that_cannot_be_used_are_reported_and_the_rest_is_solved(capsys, tmp_path, approach):
    (tmp_path / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    Picture.fromarray(np.zeros((50, 60), np.uint16)).save(tmp_path / "small.png")
    Picture.fromarray(np.full((200, 200), 100, np.uint16)).save(tmp_path / "dark.png")
    Picture.fromarray(np.full((200, 200), 100, np.uint16)).save(tmp_path / "late.png")
    Picture.fromarray(np.full((200, 200), 100, np.uint16)).save(tmp_path / "timeless.png")
    times = {"torn": "00:10", "small": "00:20", "dark": "00:00", "late": "50:00"}
    rows = "".join(f"{k}.png,2026-01-01T00:{v}\n" for k, v in times.items())
    (tmp_path / "times.csv").write_text("file,time_utc\n" + rows)
    names = ["torn.png", "small.png", "dark.png", "late.png", "timeless.png"]
    files = [tmp_path / n for n in names] + [approach / "007.png", tmp_path / "times.csv", approach / "frames.csv"]
    code, result, _ = call(capsys, *files, *arguments(approach), "--out", tmp_path / "nav", "--no-plots")
    assert code == 2
    status = {Path(f["file"]).name: f["status"] for f in result["frames"]}
    assert status == {
        "torn.png": "unreadable", "small.png": "wrong size", "dark.png": "no body", "late.png": "no attitude",
        "timeless.png": "no time", "007.png": "found",
    }  # fmt: skip
    assert all(f["message"] for f in result["frames"] if f["status"] != "found")
    assert result["trajectory"]["frames_used"] == 1


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("body.toml", "radius_km = 2.1", "", "give one of radius_km, semi_axes_km and mesh"),
        ("body.toml", "radius_km", "radius_kn", "radius_kn"),
        ("body.toml", '"lambert"', '"lamber"', "must be one of lambert"),
        ("body.toml", "position_km = ", "position = ", "position"),
        ("cam.toml", "q_cb", "q_bc", "q_bc"),
        ("cam.toml", "[detector]", "[sensor]", "unknown table [sensor]"),
        ("attitude.csv", "q_bn_w", "q_bn_u", "has no column 'q_bn_w'"),
        ("frames.csv", "file,", "name,", "has no column 'file'"),
        ("frames.csv", "2026-01-01 00:00:00", "soon", "no UTC time"),
    ],
)
def test_bad_input_is_an_error_with_file_and_key(capsys, tmp_path, approach, file, old, new, message):
    for name in ("body.toml", "cam.toml", "attitude.csv", "frames.csv"):
        text = (approach / name).read_text().replace("2026-01-01T00:00:00", "2026-01-01 00:00:00")
        (tmp_path / name).write_text(text.replace(old, new) if name == file else text)
    code, _, err = call(capsys, tmp_path / "frames.csv", *arguments(tmp_path), "--out", tmp_path / "nav")
    assert code == 1
    assert message in err
    assert file in err
    assert "Traceback" not in err


CAMERA = Camera(1024, 1024, 16760.0)


def observations(n: int, noise_px: float, rng, state=None, sizes: float = np.nan) -> list[Observation]:
    """Frames that look along x of N at a body, from a straight approach."""
    state = np.array([-7200e3, 3e3, 150e3, 6e3, 0.0, 0.0]) if state is None else state
    out = []
    R_CN = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    for t in np.linspace(0.0, 1100.0, n):
        x = states(state, np.array([t]), 0.0)
        pixel = predict_px(CAMERA, np.zeros(12), x[:, :3], R_CN[None], np.array([[1.0, 0.0]]), np.zeros(1))[0]
        rho = float(np.linalg.norm(x[0, :3]))
        z = pixel + noise_px * rng.standard_normal(2)
        size = rng.normal(0.0, sizes) if np.isfinite(sizes) else np.nan
        out.append(Observation(t, R_CN, z, noise_px**2 * np.eye(2), np.array([1.0, 0.0]), 5.0, rho, size, sizes))
    return out


def sigmas(position: float = 1e4, velocity: float = 1.0) -> np.ndarray:
    return np.array([position] * 3 + [velocity] * 3 + [1e-6] * 3 + [1e-6] + [1e-6] * 2)


def test_one_frame_is_the_conjugate_update():
    """With one frame at the epoch the estimate across the line of sight is the weighted mean of prior and pixel."""
    rng = np.random.default_rng(0)
    (o,) = observations(1, 0.3, rng, np.array([-7200e3, 0.0, 0.0, 6e3, 0.0, 0.0]))
    prior = Prior(0.0, np.array([-7200e3, 2e3, -1e3, 6e3, 0.0, 0.0, *[0.0] * 6]), sigmas())
    found = solve(CAMERA, prior, [o])
    scale = 7200e3 / CAMERA.focal_px
    # column u = cx + f (y_probe)/rho, row likewise: r_C = -R_CN x
    measured = np.array([o.centre_px[0] - CAMERA.cx, o.centre_px[1] - CAMERA.cy]) * scale
    w = 1.0 / (1.0 / 1e4**2 + 1.0 / (0.3 * scale) ** 2)
    expected = w * (np.array([2e3, -1e3]) / 1e4**2 + measured / (0.3 * scale) ** 2)
    assert found.unknowns[1:3] == pytest.approx(expected, abs=1.0)  # m: pointing and shift of 1e-6 take their share
    assert np.sqrt(np.diagonal(found.covariance)[1:3]) == pytest.approx(np.sqrt(w), rel=3e-3)


def test_errors_are_as_large_as_the_covariance_says():
    rng = np.random.default_rng(1)
    truth = np.array([-7200e3, 3e3, 150e3, 6e3, 0.0, 0.0])
    values = []
    for _ in range(12):
        mean = np.concatenate([truth + sigmas(2e4, 1.0)[:6] * rng.standard_normal(6), np.zeros(6)])
        found = solve(CAMERA, Prior(0.0, mean, sigmas(2e4, 1.0)), observations(12, 0.3, rng, truth, sizes=0.02))
        e = truth - found.unknowns[:6]
        values.append(e @ np.linalg.solve(found.covariance[:6, :6], e) / 6.0)
    assert 0.6 < np.mean(values) < 1.5  # 72 degrees of freedom: 3 sigma are +-0.5


def test_a_wrong_frame_is_left_out_and_said_so():
    rng = np.random.default_rng(2)
    frames = observations(10, 0.3, rng)
    frames[4] = Observation(**{**vars(frames[4]), "centre_px": frames[4].centre_px + np.array([0.0, 40.0])})
    truth = np.array([-7200e3, 3e3, 150e3, 6e3, 0.0, 0.0])
    found = solve(CAMERA, Prior(0.0, np.concatenate([truth, np.zeros(6)]), sigmas()), frames)
    assert found.used.tolist() == [k != 4 for k in range(10)]
    assert found.residual_sigma[4] > 20.0


def test_two_body_motion_closes_its_circle():
    gm, radius = 5.0e5, 1e4
    speed = np.sqrt(gm / radius)
    period = 2.0 * np.pi * radius / speed
    out = states(np.array([radius, 0.0, 0.0, 0.0, speed, 0.0]), np.array([0.0, period / 4, period, -period]), gm)
    assert out[1, :3] == pytest.approx([0.0, radius, 0.0], abs=0.01)
    assert out[2] == pytest.approx(out[0], abs=0.01)
    assert out[3] == pytest.approx(out[0], abs=0.01)


def test_oem_comes_back_as_written(tmp_path):
    import pyarrow as pa

    origin = from_texts(pa.array(["2026-06-30T23:59:00.5"]), "utc")[0].earliest()
    rng = np.random.default_rng(3)
    time, state = np.array([0.0, 10.25, 100.0]), rng.normal(0.0, 1e6, (3, 6))
    A = rng.normal(0.0, 1e3, (3, 6, 6))
    covariance = A @ np.swapaxes(A, 1, 2)
    path = tmp_path / "a.oem"
    write_oem(path, origin, time, state, covariance, object_name="PROBE 1", comments=["x"])
    (back,) = read_oem(path)
    assert back.instants.since(origin) == pytest.approx(time, abs=1e-9)
    assert back.state == pytest.approx(state, rel=1e-12)
    assert back.covariance == pytest.approx(covariance, rel=1e-11)
    (tmp_path / "b.oem").write_text(path.read_text().replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = TDB"))
    with pytest.raises(DataError, match="TDB"):
        read_oem(tmp_path / "b.oem")
    (tmp_path / "c.oem").write_text("hello\n")
    with pytest.raises(DataError, match="is no OEM"):
        read_oem(tmp_path / "c.oem")
