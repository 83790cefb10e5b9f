"""`helmstar attitude` on simulated records whose truth is known: consistency, signs, units, gaps, outliers."""

from __future__ import annotations

import io
import json
import math
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from telemetry_solving import solve_files

from helmstar.cli import main
from helmstar.errors import ConfigurationError

ARCSEC = np.pi / 180 / 3600
DRIFT = np.array([300.0, -120.0, 40.0])
ARW, SIGMA = 1.0, 5.0  # arcsec/sqrt(s), arcsec


def simulate(folder: Path, seed: int, *, reading="instant", dt=0.5, every=4, seconds=300, gap=None, mounting=None):
    """Gyro and star tables; truth at every instant. Stars lie between the gyro's instants."""
    rng = np.random.default_rng(seed)
    fine = 10
    n = int(seconds / dt)
    h = dt / fine
    grid = (np.arange(n * fine) + 0.5) * h
    rate = np.deg2rad(0.4) * np.stack([np.sin(0.03 * grid), np.cos(0.02 * grid), 0.3 + 0 * grid], axis=1)
    R = [Rotation.identity()]
    for w in rate:
        R.append(Rotation.from_rotvec(-w * h) * R[-1])
    t = np.arange(n + 1) * dt
    instant = np.deg2rad(0.4) * np.stack([np.sin(0.03 * t), np.cos(0.02 * t), 0.3 + 0 * t], axis=1)
    mean = rate.reshape(n, fine, 3).mean(axis=1)
    value = instant if reading == "instant" else np.concatenate([instant[:1], mean])
    value = value + DRIFT * ARCSEC + rng.normal(size=(n + 1, 3)) * ARW * ARCSEC / np.sqrt(dt)
    if reading == "increment_rad":
        value = value * dt
    keep = np.ones(n + 1, dtype=bool)
    if gap:
        keep = ~((t > gap[0]) & (t < gap[1]))
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
    np.savetxt(folder / "gyro.csv", np.column_stack([t, value])[keep], "%.12g", ",", header=header, comments="")
    at = np.arange(3, n * fine + 1, every * fine)
    sigma = np.full(3, SIGMA) if mounting is None else np.array([SIGMA, SIGMA, 10 * SIGMA])
    noise = rng.normal(size=(len(at), 3)) * sigma * ARCSEC
    if mounting is not None:
        noise = mounting.inv().apply(noise)
    q = np.array([(Rotation.from_rotvec(e) * R[k]).as_quat() for e, k in zip(noise, at, strict=True)])
    header = "time_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w"
    np.savetxt(folder / "stars.csv", np.column_stack([at * h, q]), "%.12g", ",", header=header, comments="")
    return at * h, R, h


def attitude(capsys, folder: Path, toml: str, *more: str) -> tuple[int, dict, str]:
    (folder / "sensors.toml").write_text(toml)
    argv = ["attitude", str(folder / "gyro.csv"), str(folder / "stars.csv"), "--config", str(folder / "sensors.toml")]
    code = main([*argv, "--out", str(folder / "out"), "--json", "--csv", *more])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else {}, out.err


GIVEN = f"[gyro]\narw_arcsec_sqrt_s = {ARW}\nrrw_arcsec_s_sqrt_s = 0.0\n[star]\nsigma_arcsec = {SIGMA}\n"


def consistent(result: dict) -> None:
    error = np.array(result["drift_arcsec_s"]) - DRIFT
    sigma = np.array(result["drift_sigma_arcsec_s"])
    assert np.sum((error / sigma) ** 2) < 21.1  # chi-square of 3 at 1e-4
    assert 2.2 < result["nis_mean"] < 3.8  # 150 updates of 3: 3 +- 0.2


@pytest.mark.parametrize("reading", ["instant", "mean_since_previous", "increment_rad"])
def test_every_reading_gives_the_drift_back(capsys, tmp_path, reading):
    simulate(tmp_path, 1, reading=reading)
    code, result, _ = attitude(capsys, tmp_path, GIVEN.replace("[gyro]", f'[gyro]\nreading = "{reading}"'))
    assert code == 0
    consistent(result)
    assert result["rows_rejected"] == 0
    assert result["gaps"] == []
    text = json.dumps(result)
    assert not any(word in text for word in ("NaN", "Infinity"))


def test_attitudes_are_as_good_as_they_say(capsys, tmp_path):
    _, R, h = simulate(tmp_path, 2)
    attitude(capsys, tmp_path, GIVEN)
    nees = {}
    for name in ("filtered", "smoothed"):
        d = np.genfromtxt(tmp_path / "out" / f"{name}.csv", delimiter=",", names=True)
        k = np.rint(d["time_s"] / h).astype(int)
        q = np.stack([d[f"q_bn_{a}"] for a in "xyzw"], axis=1)
        truth = Rotation.from_quat(np.array([R[i].as_quat() for i in k]))
        error = (truth * Rotation.from_quat(q).inv()).as_rotvec() / ARCSEC
        sigma = np.stack([d[f"sigma_attitude_{a}_arcsec"] for a in "xyz"], axis=1)
        late = d["time_s"] > 60
        nees[name] = np.sum((error / sigma)[late] ** 2, axis=1).mean()
        nees[name + " rms"] = np.sqrt(np.mean(error[late] ** 2))
    # One record of some ten correlation times: the mean of 3 scatters by about 0.6.
    assert 1.2 < nees["filtered"] < 5.5
    assert 1.2 < nees["smoothed"] < 5.5
    assert nees["smoothed rms"] < nees["filtered rms"]


def test_noise_is_estimated_where_it_is_not_stated(capsys, tmp_path):
    simulate(tmp_path, 3, seconds=600)
    _, result, _ = attitude(capsys, tmp_path, "")
    noise = result["noise"]
    assert noise["arw_arcsec_sqrt_s"]["source"] == "estimated from the data"
    assert noise["arw_arcsec_sqrt_s"]["value"] == pytest.approx(ARW, rel=0.4)
    assert noise["star_sigma_arcsec"]["value"][0] == pytest.approx(SIGMA, rel=0.15)  # 300 epochs of 3 axes
    consistent(result)


def test_units_of_one_kind_are_equal_and_two_are_refused(capsys, tmp_path):
    simulate(tmp_path, 4)
    arcsec = attitude(capsys, tmp_path, GIVEN)[1]
    deg = GIVEN.replace(f"arw_arcsec_sqrt_s = {ARW}", f"arw_deg_sqrt_h = {ARW / 60}")
    assert attitude(capsys, tmp_path, deg)[1]["drift_arcsec_s"] == pytest.approx(arcsec["drift_arcsec_s"], abs=1e-6)
    both = GIVEN.replace("[gyro]", "[gyro]\narw_rad_sqrt_s = 1e-6")
    code, _, err = attitude(capsys, tmp_path, both)
    assert code == 1
    assert "arw_rad_sqrt_s" in err.splitlines()[-1]
    assert "arw_arcsec_sqrt_s" in err.splitlines()[-1]


def test_the_mounting_places_the_large_error(capsys, tmp_path):
    mounting = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # boresight z of S is x of B
    simulate(tmp_path, 5, mounting=mounting)
    q = ", ".join(f"{v:.12g}" for v in mounting.as_quat())
    star = f"sigma_cross_arcsec = {SIGMA}\nsigma_roll_arcsec = {10 * SIGMA}\nq_sb = [{q}]\n"
    toml = GIVEN.replace(f"sigma_arcsec = {SIGMA}\n", star)
    _, result, _ = attitude(capsys, tmp_path, toml)
    consistent(result)
    s = result["attitude_sigma_arcsec"]
    assert s[0] > 2.0 * max(s[1:])
    wrong = toml.replace(f"q_sb = [{q}]\n", "")
    _, result, _ = attitude(capsys, tmp_path, wrong)
    assert not 2.2 < result["nis_mean"] < 3.8


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("sigma_cross_arcsec = 3.0\nsigma_roll_arcsec = 30.0", ["sigma_roll_arcsec", "give sigma_arcsec"]),
        ("q_sb = [0.6, 0.0, 0.8, 0.0]", ["q_sb", "body axes"]),
    ],
)
def test_axes_of_a_tracker_are_refused_where_star_directions_are_measured(tmp_path, line, words):
    rows = [f"{t},0,0,0,{b},{b}" for t in range(4) for b in ("1,0,0", "0,1,0", "0,0,1")]
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s," + ",".join(f"star_{f}_{a}" for f in "bn" for a in "xyz")
    (tmp_path / "t.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(ConfigurationError) as caught:
        solve_files([tmp_path / "t.csv"], f"[star]\n{line}\n")
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("sigma", "source", "value"), [(30.0, "taken as 0", 0.0), (1e6, "first two attitudes minus the gyro", None)]
)
def test_a_stated_drift_sigma_starts_at_0_unless_it_says_next_to_nothing(capsys, tmp_path, sigma, source, value):
    simulate(tmp_path, 10, seconds=60)
    toml = GIVEN.replace("[star]", f"initial_drift_sigma_arcsec_s = {sigma}\n[star]")
    _, result, _ = attitude(capsys, tmp_path, toml)
    noise = result["noise"]
    assert noise["initial_drift_sigma_arcsec_s"] == {"value": [pytest.approx(sigma)] * 3, "source": "sensors.toml"}
    assert noise["initial_drift_arcsec_s"]["source"] == source
    if value is not None:
        assert noise["initial_drift_arcsec_s"]["value"] == [value] * 3


def test_a_time_offset_is_added_to_the_stamp(capsys, tmp_path):
    simulate(tmp_path, 6)
    stars = tmp_path / "stars.csv"
    d = np.loadtxt(stars, delimiter=",", skiprows=1)
    d[:, 0] -= 2.0  # stamps 2 s early
    np.savetxt(stars, d, "%.12g", ",", header="time_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w", comments="")
    _, result, _ = attitude(capsys, tmp_path, GIVEN + "time_offset_s = 2.0\n")
    consistent(result)


@pytest.mark.parametrize("command", ["attitude", "allan"])
def test_names_of_files_and_folders_that_are_not_utf_8(capsys, tmp_path, command):
    rows = [f"{t},{1e-5 * math.sin(7.0 * t * t)},{1e-5 * math.cos(5.0 * t * t)},1e-6,0,0,0,1" for t in range(60)]
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w"
    table, out = (tmp_path / os.fsdecode(name) for name in (b"t\xff.csv", b"out\xff"))
    try:
        table.write_text("\n".join([header, *rows]))
    except OSError:
        pytest.skip("this file system has no such names")
    assert main([command, str(table), "--out", str(out)]) == 0
    assert "report: " in capsys.readouterr().out
    assert "t\ufffd.csv" in (out / "report.html").read_text(encoding="utf-8")
    if command == "attitude":
        assert len(pd.read_parquet(io.BytesIO((out / "smoothed.parquet").read_bytes()))) == 60
        again = tmp_path / os.fsdecode(b"\xfe.parquet")
        again.write_bytes((out / "smoothed.parquet").read_bytes())
        assert main([command, str(table), str(again), "--out", str(out)]) == 0
        assert "another file has a row at the same time" in capsys.readouterr().out  # so it was read


def test_gaps_are_listed_and_bridged(capsys, tmp_path):
    simulate(tmp_path, 7, gap=(100, 110))
    _, result, _ = attitude(capsys, tmp_path, GIVEN)
    consistent(result)
    assert [g["what"] for g in result["gaps"]] == ["gyro"]
    assert result["gaps"][0]["duration_s"] == pytest.approx(10.0)


def test_bad_rows_are_named_and_strict_refuses_them(capsys, tmp_path):
    simulate(tmp_path, 8)
    stars = (tmp_path / "stars.csv").read_text().splitlines()
    q = (
        Rotation.from_rotvec([0, 0.01, 0]) * Rotation.from_quat([float(v) for v in stars[31].split(",")[1:]])
    ).as_quat()
    stars[31] = ",".join([stars[31].split(",")[0], *(f"{v:.12g}" for v in q)])  # a jump, line 32
    stars[50] = ",".join([stars[50].split(",")[0], "nan", "0", "0", "1"])  # line 51
    stars[60] = ",".join([stars[60].split(",")[0], "0.5", "0.5", "0.5", "0.9"])  # not unit, line 61
    stars.insert(71, stars[70])  # repeated, line 72
    (tmp_path / "stars.csv").write_text("\n".join(stars) + "\n")
    gyro = (tmp_path / "gyro.csv").read_text().splitlines()
    cells = gyro[200].split(",")
    gyro[200] = ",".join([cells[0], *(f"{math.degrees(float(v)):.12g}" for v in cells[1:])])  # degrees, line 201
    (tmp_path / "gyro.csv").write_text("\n".join(gyro) + "\n")
    code, result, _ = attitude(capsys, tmp_path, GIVEN)
    assert code == 0
    consistent(result)
    found = {(Path(p["file"]).name, p["row"]) for p in result["problems"]}
    assert {("stars.csv", 32), ("stars.csv", 51), ("stars.csv", 61), ("stars.csv", 72), ("gyro.csv", 201)} <= found
    assert result["rows_rejected"] == 5
    code, _, err = attitude(capsys, tmp_path, GIVEN, "--strict")
    assert code == 1
    assert err.splitlines()[-1].startswith("error: ")


def test_a_whole_file_in_degrees_is_said_and_converted(capsys, tmp_path):
    simulate(tmp_path, 9)
    d = np.loadtxt(tmp_path / "gyro.csv", delimiter=",", skiprows=1)
    d[:, 1:] = np.degrees(d[:, 1:])
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
    np.savetxt(tmp_path / "gyro.csv", d, "%.12g", ",", header=header, comments="")
    _, result, _ = attitude(capsys, tmp_path, GIVEN)
    consistent(result)
    assert any(p["kind"] == "unit" and p["action"] == "converted" for p in result["problems"])
