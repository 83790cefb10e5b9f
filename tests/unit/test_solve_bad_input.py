"""What is no image of stars: `helmstar solve` and `calibrate` say why, exit as documented, and never invent an attitude.

docs/solve.md has this table for readers.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture
from PIL import ImageDraw, PngImagePlugin

from helmstar.cli import main

Make = Callable[[Path], None]
RNG = np.random.default_rng(4)
UNSOLVED = ("too few stars", "no match", "uncertain")


def stars(size: tuple[int, int] = (300, 400)) -> np.ndarray:
    """Dots on noise, which is what a damaged file would have held."""
    a = RNG.poisson(20, size).astype(float)
    for y, x in RNG.integers(5, min(size) - 5, (40, 2)):
        a[y - 1 : y + 2, x - 1 : x + 2] += np.outer([60, 120, 60], [0.5, 1, 0.5])
    return a.clip(0, 255).astype(np.uint8)


def saved(array: np.ndarray, kind: str, **more) -> bytes:
    out = io.BytesIO()
    Picture.fromarray(array).save(out, kind, **more)
    return out.getvalue()


def cut(kind: str, **more) -> Make:
    """The first half of a good file."""

    def make(path: Path) -> None:
        data = saved(stars(), kind, **more)
        path.write_bytes(data[: len(data) // 2])

    return make


def content(data: bytes) -> Make:
    def make(path: Path) -> None:
        path.write_bytes(data)

    return make


def image(array: np.ndarray) -> Make:
    return lambda path: Picture.fromarray(array).save(path)


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int, data: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def card(text: str) -> bytes:
    return text.ljust(80).encode()


def fits(*cards: str, data: bytes = b"", end: bool = True) -> bytes:
    head = b"".join(card(c) for c in ("SIMPLE  =                    T", *cards, *(("END",) if end else ())))
    return head.ljust(-(-len(head) // 2880) * 2880) + data


def room() -> np.ndarray:
    """A photograph of a room: walls, furniture, a window, lamps, a shelf of books, grain."""
    rng = np.random.default_rng(11)
    picture = Picture.new("L", (800, 600), 90)
    pen = ImageDraw.Draw(picture)
    pen.polygon([(0, 600), (250, 380), (800, 420), (800, 600)], fill=60)
    pen.rectangle((420, 60, 640, 300), fill=230, outline=30, width=8)
    pen.line((530, 60, 530, 300), fill=30, width=6)
    for x in range(40, 380, 14):
        pen.rectangle((x, 120, x + int(rng.integers(6, 13)), 220), fill=int(rng.integers(20, 220)))
    for x, y in rng.integers(30, 570, (25, 2)):
        r = int(rng.integers(1, 9))
        pen.ellipse((x - r, y - r, x + r, y + r), fill=int(rng.integers(120, 256)))
    return (np.asarray(picture) + rng.normal(0, 4, (600, 800))).clip(0, 255).astype(np.uint8)


def text_bomb(path: Path) -> None:
    info = PngImagePlugin.PngInfo()
    info.add_text("Comment", "a" * 90_000_000, zip=True)
    Picture.fromarray(stars()).save(path, pnginfo=info)


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        z.writestr("frame.png", bytes(50_000_000))


def huge_fits(path: Path) -> None:
    axes = ("BITPIX  =                    8", "NAXIS   =                    2")
    path.write_bytes(fits(*axes, "NAXIS1  =              9999999", "NAXIS2  =              9999999"))


NOISE = RNG.normal(100, 10, (400, 500)).clip(0, 255).astype(np.uint8)
HOT = np.where(RNG.random((400, 500)) < 0.01, 255, 20).astype(np.uint8)
WAVES = (127 + 120 * np.sin(np.arange(600) / 7.0)[:, None] * np.sin(np.arange(800) / 5.0)).astype(np.uint8)
LARGE = np.zeros((10_000, 10_000), np.uint8)
CASES: dict[str, tuple[str, Make, str]] = {
    "black": ("a.png", image(np.zeros((300, 400), np.uint8)), "unsolved"),
    "white": ("a.png", image(np.full((300, 400), 255, np.uint8)), "unsolved"),
    "one pixel": ("a.png", image(np.zeros((1, 1), np.uint8)), "unsolved"),
    "one row": ("a.png", image(np.zeros((1, 4000), np.uint8)), "unsolved"),
    "noise": ("a.png", image(NOISE), "unsolved"),
    "hot pixels": ("a.png", image(HOT), "unsolved"),
    "waves": ("a.png", image(WAVES), "unsolved"),
    "a room": ("a.jpg", image(room()), "unsolved"),
    "100 Mpx, black": ("a.bmp", image(LARGE), "unsolved"),
    "cut PNG": ("a.png", cut("PNG"), "unreadable"),
    "cut JPEG": ("a.jpg", cut("JPEG"), "unreadable"),
    "cut TIFF": ("a.tif", cut("TIFF", compression="tiff_lzw"), "unreadable"),
    "cut BMP": ("a.bmp", cut("BMP"), "unreadable"),
    "cut FITS": ("a.fits", content(fits("BITPIX  =                    8", "NAXIS   =                    2",
        "NAXIS1  =                  400", "NAXIS2  =                  300", data=b"\x05" * 5000)), "unreadable"),
    "empty": ("a.png", content(b""), "unreadable"),
    "text": ("a.png", content(b"these are no stars\n" * 50), "unreadable"),
    "random bytes": ("a.jpg", content(RNG.bytes(5000)), "unreadable"),
    "GIF": ("a.gif", content(saved(stars(), "GIF")), "unreadable"),
    "a pickle": ("a.npy", content(b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94\x93\x94."), "unreadable"),
    "PNG of 60000 x 60000 in its header": ("a.png", content(png(60000, 60000, bytes(1000))), "unreadable"),
    "PNG with a text of 90 MB": ("a.png", text_bomb, "unreadable"),
    "zip of 50 MB": ("a.zip", zipped, "unreadable"),
    "gzip of 50 MB": ("a.fits.gz", content(gzip.compress(bytes(50_000_000))), "unreadable"),
    "FITS of 10^14 pixels": ("a.fits", huge_fits, "unreadable"),
    "FITS with a header of 4 MB": ("a.fits", content(fits(*["COMMENT x"] * 50_000, end=False)), "unreadable"),
    "FITS of negative size": ("a.fits", content(fits("BITPIX  =                    8",
        "NAXIS   =                    2", "NAXIS1  =                   -5", "NAXIS2  =                    9")), "unreadable"),
    "FITS of no numbers": ("a.fits", content(fits("BITPIX  =                  -32",
        "NAXIS   =                    2", "NAXIS1  =                   20", "NAXIS2  =                   36",
        data=b"\x7f\xc0\x00\x00" * 720)), "unreadable"),
    "a folder": ("a.png", lambda path: path.mkdir(), "unreadable"),
    "a pipe": ("a.png", lambda path: os.mkfifo(path), "unreadable"),
    "nothing": ("a.png", lambda path: None, "unreadable"),
    "a name of odd bytes": (os.fsdecode(b"\xff\xfe \n'.png"), content(b"no image"), "unreadable"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_status_says_why_and_there_is_no_attitude(capsys, tmp_path, case):
    name, make, expected = CASES[case]
    path = tmp_path / name
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing may leak to the user's terminal
        make(path)
        code = main(["solve", str(path), "--fov", "12", "--json"])
    out = capsys.readouterr()
    assert code == 2
    assert "Traceback" not in out.err
    (entry,) = json.loads(out.out)["images"]
    assert entry["status"] in (UNSOLVED if expected == "unsolved" else (expected,))
    assert entry["message"]
    assert entry["ra_deg"] is None
    assert entry["q_sn"] is None
    if expected == "unreadable":
        assert Path(entry["file"]).name in entry["message"] or "odd" in case


def test_bad_files_among_many_are_counted_by_calibrate_and_none_is_fatal_for_solve(capsys, tmp_path):
    files = []
    for k, case in enumerate(("black", "cut PNG", "text", "a folder", "nothing")):
        path = tmp_path / f"{k}.png"
        CASES[case][1](path)
        files.append(str(path))
    assert main(["solve", *files, "--json"]) == 2
    assert len(json.loads(capsys.readouterr().out)["images"]) == len(files)
    assert main(["calibrate", *files, "--out", str(tmp_path / "cam.toml")]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: none of 5 images was solved")
    assert "4 unreadable" in last
    assert "1 too few stars" in last


@pytest.mark.shared_data
def test_the_real_room(capsys, shared_data):
    code = main(["solve", str(shared_data / "stars" / "negative" / "bayered_room.bmp"), "--json"])
    assert code == 2
    assert json.loads(capsys.readouterr().out)["images"][0]["status"] in UNSOLVED
