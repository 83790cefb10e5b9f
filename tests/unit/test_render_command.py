"""`helmstar render`: what it writes is what it was told, and `helmstar solve` finds it again within its own sigma."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Picture
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helmstar.cli import main
from helmstar.imaging import Camera, write_camera
from helmstar.imaging.render import pointed, turned
from helmstar.io.images import read_image
from helmstar.sensors.star_tracker import centre_angles

LENS = Camera(640, 480, 2400.0, (300.0, 250.0), 1.3, (-0.2, 0.1, 1e-3, -2e-3, 0.0))


def call(capsys, *argv: str) -> dict:
    assert main([*argv, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@settings(max_examples=60, deadline=None)
@given(ra=st.floats(0, 359.99), dec=st.floats(-89.9, 89.9), roll=st.floats(0, 359.99))
def test_pointing_is_the_inverse_of_what_solve_says(ra, dec, roll):
    """Of a lens off its centre, distorted, with pixels that are not square. 1e-3 px steps on both sides leave 2e-6 deg of roll;
    near a pole right ascension and roll grow by 1/cos(dec)."""
    q = pointed(LENS, *np.radians([ra, dec, roll]))
    found = centre_angles(LENS, Rotation.from_quat(q).as_matrix())
    off = (np.array(found) - [ra, dec, roll] + 180.0) % 360.0 - 180.0
    assert np.abs(off * [np.cos(np.radians(dec)), 1.0, 1.0]).max() < 2e-5


def test_at_the_pole_the_meridian_says_where_north_is():
    q = Rotation.from_quat(pointed(LENS, *np.radians([40.0, 90.0, 0.0])))
    near = Rotation.from_quat(pointed(LENS, *np.radians([40.0, 90.0 - 1e-6, 0.0])))
    assert (q * near.inv()).magnitude() == pytest.approx(np.radians(1e-6), rel=1e-3)


def test_a_turn_follows_the_rate():
    q, w = Rotation.random(rng=np.random.default_rng(1)).as_quat(), np.array([0.01, -0.02, 0.03])
    small = (Rotation.from_quat(turned(q, w, 1e-3)) * Rotation.from_quat(q).inv()).as_rotvec() / 1e-3
    assert small == pytest.approx(-w, rel=1e-9)  # v_S turns against the camera


def test_what_is_rendered_is_solved_within_its_sigma(capsys, tmp_path):
    """Six frames of 8 and 16 bits, smeared, with hot pixels, at a date: NEES of 18 numbers within 99.9%."""
    rng = np.random.default_rng(5)
    files, truths = [], []
    for i in range(6):
        v = rng.standard_normal(3)
        ra, dec = np.degrees([np.arctan2(v[1], v[0]), np.arcsin(v[2] / np.linalg.norm(v))])
        form = ("png", "tiff", "fits")[i % 3]
        files.append(str(tmp_path / f"{i}.{form}"))
        result = call(
            capsys, "render", "--ra", str(ra), "--dec", str(dec), "--roll", str(rng.uniform(0, 360)), "--fov", "14",
            "--size", "512x384", "--seed", str(i), "--out", files[-1], "--bits", "8" if i % 2 else "16", "--hot-pixels", "50",
            "--rate-deg-s", "0.02,-0.1,0.3", "--time", "2031-05-06T07:08:09", "--truth", str(tmp_path / f"{i}.json"),
        )  # fmt: skip
        truths.append(result["frames"][0])
        assert json.loads((tmp_path / f"{i}.json").read_text())["frames"][0] == result["frames"][0]
    solved = call(capsys, "solve", *files, "--fov", "14", "--time", "2031-05-06T07:08:09")["images"]
    total = 0.0
    for truth, found in zip(truths, solved, strict=True):
        error = (Rotation.from_quat(truth["q_sn"]) * Rotation.from_quat(found["q_sn"]).inv()).as_rotvec()
        total += float(np.sum((np.degrees(error) * 3600.0 / found["sigma_arcsec"]) ** 2))
        assert (
            abs((found["roll_deg"] - truth["roll_deg"] + 180.0) % 360.0 - 180.0) < 6.0 / 3600 * found["sigma_arcsec"][2]
        )
        assert set(found["hip"]) <= {s["hip"] for s in truth["stars"]}
    # The covariance holds a floor for imperfect optics, which these have not: the lower end is half as far.
    assert 0.5 * chi2.ppf(5e-4, 18) < total < chi2.ppf(1 - 5e-4, 18)


@pytest.mark.parametrize("form", ["png", "tiff", "fits"])
@pytest.mark.parametrize("bits", ["8", "16"])
def test_files_hold_the_same_pixels_and_the_time(capsys, tmp_path, form, bits):
    path = tmp_path / f"f.{form}"
    argv = ["render", "--ra", "10", "--dec", "41", "--fov", "10", "--size", "321x123", "--bits", bits, "--seed", "3"]
    call(capsys, *argv, "--out", str(path), "--time", "2024-02-29T23:59:59.75", "--exposure", "0.5")
    call(capsys, *argv, "--out", str(tmp_path / "same.png"), "--time", "2024-02-29T23:59:59.75", "--exposure", "0.5")
    image, same = read_image(path), read_image(tmp_path / "same.png")
    assert image.array.dtype == (np.uint8 if bits == "8" else np.uint16)
    assert np.array_equal(image.array, same.array)
    if form == "fits":
        assert image.metadata["DATE-AVG"].startswith("2024-02-29T23:59:59.75")
        assert image.metadata["DATE-OBS"].startswith("2024-02-29T23:59:59.50")
        assert path.stat().st_size % 2880 == 0
    else:
        with Picture.open(path) as p:
            exif = p.getexif().get_ifd(0x8769)
        assert (exif[0x9003], exif[0x9291].rstrip("0"), exif[0x9011]) == ("2024:02:29 23:59:59", "75", "+00:00")


def test_a_sequence_has_times_and_truth(capsys, tmp_path):
    camera = tmp_path / "cam.toml"
    write_camera(camera, LENS)
    out = tmp_path / "night"
    result = call(
        capsys, "render", "--ra", "200", "--dec", "-40", "--roll", "77", "--camera", str(camera), "--count", "5", "--step",
        "2.5", "--rate-deg-s", "0,0,1", "--limit-magnitude", "5", "--out", str(out),
    )  # fmt: skip
    rows = (out / "frames.csv").read_text().splitlines()
    assert rows == ["file,time_s", *(f"frame_{k:04d}.png,{2.5 * k}" for k in range(5))]
    assert sorted(p.name for p in out.glob("*.png")) == [r.split(",")[0] for r in rows[1:]]
    frames = json.loads((out / "truth.json").read_text())["frames"]
    assert frames == result["frames"]
    q = Rotation.from_quat([f["q_sn"] for f in frames])
    # S turns about its own z by +1 deg/s.
    steps = np.degrees((q[1:] * q[:-1].inv()).as_rotvec())
    assert steps == pytest.approx(np.tile([0.0, 0.0, -2.5], (4, 1)), abs=1e-9)
    assert max(s["magnitude"] for f in frames for s in f["stars"]) <= 5.0
    noise = [np.asarray(Picture.open(out / f"frame_{k:04d}.png")) for k in (0, 1)]
    assert not np.array_equal(*noise)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--fov", "12", "--size", "big"], ["--size big", "1024x768"]),
        (["--fov", "0"], ["--fov", "between 0 and 180"]),
        ([], ["--camera, --fov"]),
        (["--fov", "12", "--camera", "c.toml"], ["--camera, --fov"]),
        (["--fov", "12", "--rate-deg-s", "1,2"], ["--rate-deg-s 1,2", "3 numbers"]),
        (["--fov", "12", "--rate-deg-s", "0,5000,0"], ["--rate-deg-s", "drawn out"]),
        (["--fov", "12", "--size", "20000x20000"], ["more than"]),
        (["--fov", "12", "--exposure", "0"], ["duration"]),
        (["--fov", "12", "--glow", "1,2,3,0"], ["--glow"]),
        (["--fov", "12", "--hot-pixels", "-1"], ["--hot-pixels"]),
        (["--fov", "12", "--limit-magnitude", "12"], ["--limit-magnitude 12", "9"]),
        (["--fov", "12", "--out", "f.gif"], ["f.gif", ".fits"]),
        (["--fov", "12", "--count", "0"], ["--count 0"]),
        (["--fov", "12", "--count", "2", "--out", "f.png"], ["f.png", "folder"]),
        (["--fov", "12", "--time", "soon"], ["--time soon"]),
    ],
)
def test_misuse_is_explained(capsys, tmp_path, monkeypatch, argv, words):
    monkeypatch.chdir(tmp_path)
    assert main(["render", "--ra", "1", "--dec", "2", *argv]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    for word in words:
        assert word in last
    assert list(Path(tmp_path).iterdir()) == []
