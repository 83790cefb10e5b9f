"""`helmstar calibrate` on rendered frames: the camera comes back within its sigmas, and what cannot be used is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from helmstar.cli import main
from helmstar.errors import ConfigurationError
from helmstar.imaging import Camera, detect
from helmstar.imaging.calibrated import read_calibrated, read_dark
from helmstar.imaging.render import Exposure, render
from helmstar.io.images import read_image
from helmstar.sensors.star_tracker import centre_angles
from helmstar.stars import load_catalog

TRUE = Camera(640, 480, 2450.0, (331.0, 233.0), 1.0, (-0.25, 0.0, 0.0, 0.0, 0.0))
HOT = np.random.default_rng(8).integers(20, 460, (30, 2))


def write(folder: Path, name: str, seed: int, camera: Camera = TRUE, hot: bool = False) -> Rotation:
    """A 16-bit frame at a random attitude. Hot pixels stand in groups of 2 x 2, so that they look like stars."""
    R = Rotation.random(rng=np.random.default_rng(seed))
    catalog = load_catalog(8.0)
    image, _ = render(camera, R.as_quat(), catalog.directions(), catalog.magnitude, Exposure(gain_e=1.0, bits=16), seed)
    array = image.array.copy()
    if hot:
        for y, x in HOT:
            array[y : y + 2, x : x + 2] += 400
    Picture.fromarray(array).save(folder / name)
    return R


def run(capsys, *argv: str) -> tuple[int, dict, str]:
    code = main([*argv, "--json"])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else {}, out.err


def names(folder: Path, *files: str) -> list[str]:
    return [str(folder / f) for f in files]


def test_a_camera_comes_back_and_solves_with_honest_sigmas(capsys, tmp_path):
    truths = [write(tmp_path, f"{k}.png", k) for k in range(8)]
    write(tmp_path, "other.png", 20, Camera.from_fov(14.9, 600, 480))
    noise = np.random.default_rng(1).normal(100, 10, (480, 640)).clip(0, 255).astype(np.uint8)
    Picture.fromarray(noise).save(tmp_path / "noise.png")
    (tmp_path / "text.png").write_text("no image")
    good = [f"{k}.png" for k in range(6)]
    files = names(tmp_path, *good, "other.png", "noise.png", "text.png")
    cam = tmp_path / "new" / "cam.toml"
    code, result, err = run(capsys, "calibrate", *files, "--fov", "14.9", "--out", str(cam), "--plot", str(tmp_path))
    assert code == 2
    assert "Traceback" not in err
    status = [e["status"] for e in result["images"]]
    assert [e["file"] for e in result["images"]] == files
    assert status[:6] == ["used"] * 6
    assert status[6] == "other size"
    assert status[7] in ("too few stars", "no match", "uncertain")
    assert status[8] == "unreadable"
    assert all(e["message"] for e in result["images"][6:])
    assert all(e["residual_rms_arcsec"] < 15.0 for e in result["images"][:6])  # 0.18 px
    known = read_calibrated(cam)
    assert abs(known.camera.focal_px - TRUE.focal_px) < 5 * result["sigma"]["focal"]
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), axis=-1).reshape(-1, 2)
    a, b = known.camera.directions(grid), TRUE.directions(grid)
    turn = Rotation.align_vectors(a, b)[0]  # a turn of the whole field belongs to the attitude
    assert np.degrees(np.max(np.linalg.norm(a - turn.apply(b), axis=1))) * 3600 < 8.0  # 0.1 px of 84 arcsec
    # The sky is at J2000 without proper motion and the noise is what the fit found: chi-square is one by construction.
    assert 0.8 < result["chi2"] / result["degrees"] < 1.2
    assert 0.3 <= result["centroid_scale"] < 2.0
    assert Picture.open(result["plot"]).size[0] > 1000
    # Frames that the calibration has not seen.
    code, solved, _ = run(capsys, "solve", *names(tmp_path, "6.png", "7.png"), "--camera", str(cam))
    assert code == 0
    for R, e in zip(truths[6:], solved["images"]):
        ra, dec, roll = centre_angles(TRUE, R.as_matrix())
        off = np.array([(e["ra_deg"] - ra) * np.cos(np.radians(dec)), e["dec_deg"] - dec]) * 3600
        assert np.linalg.norm(off) < 5.0 * e["sigma_arcsec"][0] + 1.0  # and the calibration's own error
        assert (e["roll_deg"] - roll + 180) % 360 - 180 == pytest.approx(0.0, abs=5 * e["sigma_arcsec"][2] / 3600)


def test_what_always_shines_is_found_and_used(capsys, tmp_path):
    for k in range(4):
        write(tmp_path, f"{k}.png", k, hot=True)
    files = names(tmp_path, *(f"{k}.png" for k in range(4)))
    cam = tmp_path / "cam.toml"
    code, result, _ = run(capsys, "calibrate", *files, "--fov", "14.9", "--out", str(cam), "--dark")
    assert code == 0
    dark = read_calibrated(cam).dark
    assert dark is not None
    marked = np.zeros_like(dark, bool)
    for y, x in HOT:
        marked[y : y + 2, x : x + 2] = True
    assert (dark[marked] > 250).mean() > 0.98
    assert (dark[~marked] > 0).mean() < 1e-3
    assert result["dark_pixels"] == np.count_nonzero(dark)
    image = read_image(Path(files[0]))
    false = [
        int(marked[np.rint(c.y_px).astype(int), np.rint(c.x_px).astype(int)].sum())
        for c in (detect(image), detect(image, dark=dark))
    ]
    assert false[0] > 20  # most of the 30 groups were taken for stars
    assert false[1] <= 1
    assert run(capsys, "solve", files[0], "--camera", str(cam))[0] == 0


def test_a_sky_that_stands_still_makes_no_dark(capsys, tmp_path):
    R = write(tmp_path, "0.png", 3)
    assert R is not None
    for k in (1, 2):
        (tmp_path / f"{k}.png").write_bytes((tmp_path / "0.png").read_bytes())
    files = names(tmp_path, "0.png", "1.png", "2.png")
    code, _, err = run(capsys, "calibrate", *files, "--fov", "14.9", "--out", str(tmp_path / "c.toml"), "--dark")
    assert code == 1
    assert "same place" in err.splitlines()[-1]
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--fov", "wide"], "--fov wide"),
        (["--pixel-aspect", "0"], "--pixel-aspect 0"),
        (["--camera", "none.toml"], "none.toml"),
        ([], "none of 2 images was solved"),
    ],
)
def test_misuse_and_nothing_solved_are_exit_code_1(capsys, tmp_path, argv, words):
    Picture.fromarray(np.zeros((60, 60), np.uint8)).save(tmp_path / "black.png")
    files = names(tmp_path, "black.png", "missing.png")
    code = main(["calibrate", *files, *argv, "--out", str(tmp_path / "cam.toml")])
    last = capsys.readouterr().err.splitlines()[-1]
    assert code == 1
    assert last.startswith("error: ")
    assert words in last
    assert not (tmp_path / "cam.toml").exists()


def test_the_aspect_is_fitted_when_asked(capsys, tmp_path):
    camera = Camera.from_fov(14.9, 640, 400, aspect=1.2)
    for k in range(2):
        write(tmp_path, f"{k}.png", k + 40, camera)
    files = names(tmp_path, "0.png", "1.png")
    out = str(tmp_path / "c.toml")
    code, result, _ = run(capsys, "calibrate", *files, "--fov", "14.9", "--pixel-aspect", "1.19", "--out", out)
    assert code == 0
    assert result["camera"]["aspect"] == pytest.approx(1.2, abs=5 * result["sigma"]["aspect"])
    assert result["sigma"]["aspect"] < 1e-3


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no dark frame"),
        (b"PK\x03\x04 cut short", "no dark frame"),
        (b"\x80\x04K\x01.", "no dark frame"),  # a pickle
        ({"dark": np.zeros((4, 4), np.float32)}, "shape"),
        ({"light": np.zeros((48, 64), np.float32)}, "no dark frame"),
        ({"dark": np.full((48, 64), np.nan, np.float32)}, "no number"),
        ({"dark": np.zeros((4000, 4000), np.float32)}, "larger"),
        ({"dark": np.array([[{}]], dtype=object)}, "no dark frame"),
    ],
)
def test_a_dark_that_is_none_is_refused(tmp_path, content, words):
    path = tmp_path / "cam.dark.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez_compressed(path, **content)
    with pytest.raises(ConfigurationError, match=words) as e:
        read_dark(path, (48, 64))
    assert "cam.dark.npz" in str(e.value)


def test_keys_of_a_calibration_are_checked(tmp_path):
    path = tmp_path / "cam.toml"
    for line, word in (
        ('centroid_scale = "big"', "centroid_scale"), ("focal_sigma_px = -1", "focal_sigma_px"), ("dark = 3", "dark"),
        ("centroid_scale = 0", "centroid_scale"), ("focal_sigma = 1", "unknown key"),
        ('dark = "none.npz"', "none.npz"),
    ):  # fmt: skip
        path.write_text(TRUE.to_toml() + f"[calibration]\n{line}\n")
        with pytest.raises(ConfigurationError, match=word):
            read_calibrated(path)
    path.write_text(TRUE.to_toml())
    assert read_calibrated(path).camera == TRUE
