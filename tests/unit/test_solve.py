"""`helmstar solve`: rendered frames of known truth, options, exit codes, and what is no image of stars."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from helmstar.cli import main
from helmstar.imaging import Camera
from helmstar.imaging.render import render
from helmstar.io.images import read_image
from helmstar.sensors.observer import observer
from helmstar.sensors.star_tracker import centre_angles
from helmstar.stars import load_catalog
from helmstar.startracker.command import SolveOptions, tracker_of

CAMERA = Camera.from_fov(12.0, 800, 600)


def frame(path: Path, seed: int, camera: Camera = CAMERA) -> Rotation:
    """A rendered 8-bit frame of a random attitude, and R_SN."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng)
    catalog = load_catalog(8.0)
    picture = render(camera, R.as_quat(), catalog.directions(), catalog.magnitude, seed=seed)
    array = picture[0] if isinstance(picture, tuple) else picture.image
    array = np.asarray(getattr(array, "array", array), float)
    scale = 255.0 / max(float(array.max()), 1.0)
    Picture.fromarray((array * scale).clip(0, 255).astype(np.uint8)).save(path)
    return R


def solve(capsys, *argv: str) -> tuple[int, dict, str]:
    code = main(["solve", *argv, "--json"])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else {}, out.err


def test_rendered_frames_are_solved_with_an_honest_sigma(capsys, tmp_path):
    truths = [frame(tmp_path / f"{i}.png", i) for i in range(4)]
    files = [str(tmp_path / f"{i}.png") for i in range(4)]
    code, result, _ = solve(capsys, *files, "--fov", "12", "--plot", str(tmp_path / "drawn"))
    assert code == 0
    squares = []
    for i, (R, entry) in enumerate(zip(truths, result["images"], strict=True)):
        assert entry["file"] == files[i]
        assert entry["status"] == "solved"
        error = (R * Rotation.from_quat(entry["q_sn"]).inv()).as_rotvec() * 206264.8
        squares.append((error / entry["sigma_arcsec"]) ** 2)
        ra, dec, roll = centre_angles(CAMERA, R.as_matrix())
        assert entry["ra_deg"] == pytest.approx(ra, abs=0.01)
        assert entry["dec_deg"] == pytest.approx(dec, abs=0.003)
        assert (entry["roll_deg"] - roll + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.05)
        assert entry["fov_deg"] == pytest.approx(12.0, abs=0.01)
        assert entry["probability_false"] < 1e-6
        assert Picture.open(entry["plot"]).size == (1600, 1200)
    assert np.mean(squares) < 12.0  # 12 numbers, right is 1: a sigma that is far too small fails


def test_an_unknown_field_is_found(capsys, tmp_path):
    frame(tmp_path / "f.png", 11)
    code, result, _ = solve(capsys, str(tmp_path / "f.png"), "--fov", "8..20")
    assert code == 0
    assert result["images"][0]["fov_deg"] == pytest.approx(12.0, abs=0.02)


def test_what_shows_no_stars_is_refused_in_its_place(capsys, tmp_path):
    frame(tmp_path / "good.png", 3)
    Picture.fromarray(np.zeros((200, 300), np.uint8)).save(tmp_path / "black.png")
    Picture.fromarray(np.full((200, 300), 255, np.uint8)).save(tmp_path / "white.png")
    noise = np.random.default_rng(1).normal(100, 10, (400, 500)).clip(0, 255).astype(np.uint8)
    Picture.fromarray(noise).save(tmp_path / "noise.png")
    (tmp_path / "text.png").write_text("this is no image")
    names = ["black.png", "good.png", "missing.png", "noise.png", "text.png", "white.png"]
    code, result, err = solve(capsys, *(str(tmp_path / n) for n in names), "--fov", "12")
    assert code == 2
    status = {Path(e["file"]).name: e["status"] for e in result["images"]}
    assert list(status) == names
    assert status["good.png"] == "solved"
    assert status["black.png"] == status["white.png"] == "too few stars"
    assert status["text.png"] == status["missing.png"] == "unreadable"
    assert status["noise.png"] in ("too few stars", "no match", "uncertain")
    assert "Traceback" not in err
    assert all(e["message"] for e in result["images"] if e["status"] != "solved")
    assert all(set(e) == set(result["images"][0]) for e in result["images"])


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--fov", "wide"], ["--fov wide", "11.4"]),
        (["--fov", "25..5"], ["--fov 25..5"]),
        (["--fov", "500"], ["--fov 500"]),
        (["--pixel-aspect", "0"], ["--pixel-aspect 0"]),
        (["--max-false", "2"], ["--max-false 2"]),
        (["--camera", "none.toml"], ["none.toml"]),
        (["--camera", "c.toml", "--fov", "3"], ["--fov and --camera"]),
        (["--time", "yesterday"], ["--time yesterday"]),
        (["--time", "2500-01-01T00:00:00"], ["--time 2500", "2099"]),
    ],
)
def test_misuse_is_exit_code_1(capsys, tmp_path, argv, words):
    code = main(["solve", str(tmp_path / "f.png"), *argv])
    err = capsys.readouterr().err
    assert code == 1
    last = err.splitlines()[-1]
    assert last.startswith("error: ")
    for word in words:
        assert word in last


def test_no_image_at_all_is_misuse_too(capsys):
    with pytest.raises(SystemExit) as e:
        main(["solve"])
    assert e.value.code == 1


def test_a_drawing_for_each_image_of_one_name_and_none_over_a_file(capsys, tmp_path):
    files = [tmp_path / d / "black.png" for d in "ab"]
    for file in files:
        file.parent.mkdir()
        Picture.fromarray(np.zeros((40, 60), np.uint8)).save(file)
    drawn = tmp_path / "drawn"
    entries = solve(capsys, *map(str, files), "--fov", "12", "--plot", str(drawn))[1]["images"]
    assert [e["plot"] for e in entries] == [str(drawn / "black-1.png"), str(drawn / "black-2.png")]
    code, _, err = solve(capsys, str(files[0]), "--fov", "12", "--plot", str(files[1]))
    assert (code, err) == (1, f"error: --plot {files[1]}: is a file; give a folder\n")


def test_drawn_magnitudes_are_those_of_the_catalogue_that_was_used(tmp_path, monkeypatch):
    """Another catalogue's indices are not Hipparcos's: here its stars stand in another order."""
    from PIL import ImageDraw

    from helmstar.sensors.star_tracker import StarTracker
    from helmstar.startracker.plot import draw

    whole = load_catalog(8.0)
    order = np.random.default_rng(1).permutation(len(whole))
    other = replace(whole, **{k: v[order] for k, v in vars(whole).items() if isinstance(v, np.ndarray)})
    frame(tmp_path / "sky.png", 0)
    image = read_image(tmp_path / "sky.png")
    found = StarTracker(CAMERA).solve(image)
    magnitude = dict(zip(whole.hip.tolist(), whole.magnitude, strict=True))
    place = {int(h): i for i, h in enumerate(other.hip)}
    known = [k for k, h in enumerate(found.identification.hip) if int(h) in place]
    assert len(known) > 5
    i = found.identification
    mine = replace(
        i, detections=i.detections[known], hip=i.hip[known], residuals_px=i.residuals_px[known],
        stars=np.array([place[int(h)] for h in i.hip[known]]),
    )  # fmt: skip
    said = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda self, xy, text, **_: said.append(text))
    draw(image, replace(found, identification=mine), other, tmp_path / "drawn.png")
    assert said[:-1] == [f"HIP {h}  {magnitude[int(h)]:.1f}" for h in mine.hip]


def test_the_observer_moves_with_the_earth():
    year, velocity = observer(2451545.0)
    assert year == 2000.0
    assert np.linalg.norm(velocity) * 299792.458 == pytest.approx(30.3, abs=0.3)  # km/s, near perihelion
    _, half = observer(2451545.0 + 182.6)
    assert velocity @ half < -0.99 * np.linalg.norm(velocity) * np.linalg.norm(half)


def test_a_stated_time_moves_the_stars():
    """61 Cygni goes 5.28 arcsec a year; aberration turns all stars by up to 20.5 arcsec on top."""
    catalog = load_catalog()
    k = int(np.flatnonzero(catalog.hip == 104214)[0])
    sky = tracker_of(SolveOptions(fov="10", time="2019-07-29T20:47:26")).sky
    moved = np.degrees(np.linalg.norm(sky.directions[k] - catalog.directions(2000.0)[k])) * 3600.0
    assert moved == pytest.approx(19.575 * 5.28, abs=22.0)


@pytest.mark.shared_data
def test_real_frames_of_four_cameras(capsys, shared_data):
    """Two of each: solved within 30 arcsec of truth, and the photo of a room refused."""
    stars = shared_data / "stars"
    rows = list(csv.DictReader((stars / "truth.csv").open()))
    sky = [r for r in rows if r["kind"] == "sky"]
    chosen = [
        r
        for group in ("tetra3", "cedar", "oresat", "openstartracker")
        for r in [x for x in sky if x["file"].startswith(group)][:2]
    ]
    for r in chosen:
        code, result, _ = solve(capsys, str(stars / r["file"]), "--fov", f"{float(r['hfov_deg']):.1f}")
        e = result["images"][0]
        assert code == 0, r["file"]
        a, b = (
            Rotation.from_euler("zy", [float(v["ra_deg"]), -float(v["dec_deg"])], degrees=True).apply([1, 0, 0])
            for v in (r, e)
        )
        assert np.degrees(np.linalg.norm(a - b)) * 3600 < 30.0, r["file"]
    code, result, _ = solve(capsys, str(stars / "negative" / "bayered_room.bmp"))
    assert code == 2
    assert result["images"][0]["status"] != "solved"
