"""Image files of every kind become one grey array; what is damaged, too large or no image is a DataError that names the file."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow
from PIL import TiffImagePlugin

from helmstar.errors import DataError
from helmstar.io import images
from helmstar.io.images import read_image

RNG = np.random.default_rng(0)
EIGHT = RNG.integers(0, 255, (20, 30)).astype(np.uint8)
SIXTEEN = RNG.integers(0, 65535, (20, 30)).astype(np.uint16)


def fits(array: np.ndarray, bitpix: int, cards: tuple[str, ...] = (), first: bytes = b"") -> bytes:
    """A minimal FITS file; `first` stands before, as a part of its own."""
    axes = array.shape[::-1]
    head = ["XTENSION= 'IMAGE   '" if first else "SIMPLE  =                    T", f"BITPIX  = {bitpix:20d}"]
    head += [f"NAXIS   = {len(axes):20d}"] + [f"NAXIS{k + 1}  = {n:20d}" for k, n in enumerate(axes)] + [*cards, "END"]
    text = "".join(c.ljust(80) for c in head).encode()
    kind = {8: "u1", 16: ">i2", 32: ">i4", -32: ">f4", -64: ">f8"}[bitpix]
    body = array.astype(kind).tobytes()
    return first + text.ljust(-(-len(text) // 2880) * 2880) + body.ljust(-(-len(body) // 2880) * 2880, b"\0")


def saved(kind: str, array: np.ndarray = EIGHT, **options) -> bytes:
    out = io.BytesIO()
    Pillow.fromarray(array).save(out, kind, **options)
    return out.getvalue()


def write(tmp_path, data: bytes, name: str = "frame.img"):
    path = tmp_path / name
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP"])
def test_eight_bits(tmp_path, kind):
    image = read_image(write(tmp_path, saved(kind)))
    assert np.array_equal(image.array, EIGHT)
    assert (image.array.dtype, image.saturation, image.bits) == (np.uint8, 255.0, 8)
    assert (image.width, image.height) == (30, 20)
    assert image.metadata["format"] == kind


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_sixteen_bits(tmp_path, kind):
    image = read_image(write(tmp_path, saved(kind, SIXTEEN)))
    assert np.array_equal(image.array, SIXTEEN)
    assert (image.array.dtype, image.saturation) == (np.uint16, 65535.0)
    twelve = SIXTEEN >> 4
    twelve[twelve == 4095] = 4094
    twelve[3, :2] = 4095
    assert read_image(write(tmp_path, saved(kind, twelve))).saturation == 65535.0  # two pixels may be chance
    twelve[4, 5] = 4095
    assert read_image(write(tmp_path, saved(kind, twelve))).saturation == 4095.0


def test_jpeg_is_near(tmp_path):
    smooth = np.broadcast_to(np.arange(0, 240, 8, dtype=np.uint8), (20, 30))
    image = read_image(write(tmp_path, saved("JPEG", np.ascontiguousarray(smooth), quality=95)))
    assert np.abs(image.array.astype(int) - smooth).max() < 8


def test_colour_is_summed_and_grey_in_colour_is_not(tmp_path):
    colour = RNG.integers(0, 250, (20, 30, 3)).astype(np.uint8)
    colour[3, 4, 1] = 255
    image = read_image(write(tmp_path, saved("PNG", colour)))
    expected = colour.sum(axis=2)
    expected[3, 4] = 765  # a full channel makes a full pixel
    assert np.array_equal(image.array, expected)
    assert image.saturation == 765.0
    alpha = np.dstack([EIGHT, EIGHT, EIGHT, RNG.integers(0, 255, (20, 30)).astype(np.uint8)])
    assert np.array_equal(read_image(write(tmp_path, saved("PNG", alpha))).array, EIGHT)
    palette = io.BytesIO()
    Pillow.fromarray(EIGHT).convert("P").save(palette, "PNG")
    assert read_image(write(tmp_path, palette.getvalue())).array.shape == (20, 30)
    bilevel = io.BytesIO()
    Pillow.fromarray(EIGHT > 100).save(bilevel, "PNG")
    assert np.array_equal(read_image(write(tmp_path, bilevel.getvalue())).array, 255 * (EIGHT > 100))


def test_fits_of_every_kind(tmp_path):
    unsigned = ("BSCALE  =                  1.0", "BZERO   =              32768.0 / unsigned", "EXPTIME = '0.5'")
    image = read_image(write(tmp_path, fits(SIXTEEN.astype(int) - 32768, 16, unsigned)))
    assert np.array_equal(image.array, SIXTEEN)
    assert image.array.dtype == np.uint16
    assert image.metadata["EXPTIME"] == "0.5"
    assert np.array_equal(read_image(write(tmp_path, fits(EIGHT, 8))).array, EIGHT)
    for bitpix in (16, 32, -32, -64):
        image = read_image(write(tmp_path, fits(EIGHT.astype(float), bitpix, ("BSCALE  = 2.0", "BZERO   = 5"))))
        assert np.array_equal(image.array, EIGHT * 2.0 + 5)
        assert image.array.dtype == np.float32
        assert image.saturation == np.inf
    stated = fits(EIGHT.astype(float), -32, ("SATURATE= 200.5",))
    assert read_image(write(tmp_path, stated)).saturation == 200.5
    holes = EIGHT.astype(float)
    holes[0, 0] = np.nan
    assert np.isfinite(read_image(write(tmp_path, fits(holes, -32))).array).all()
    empty = fits(np.zeros((0,)), 8)
    assert np.array_equal(read_image(write(tmp_path, fits(EIGHT, 8, first=empty))).array, EIGHT)
    cube = np.stack([EIGHT, EIGHT // 2, EIGHT // 3])
    assert np.array_equal(read_image(write(tmp_path, fits(cube, 8))).array[EIGHT < 255], cube.sum(axis=0)[EIGHT < 255])


def test_a_mosaic_of_colours_becomes_flat(tmp_path):
    grey = np.full((20, 30), 100.0)
    grey[::2, ::2], grey[1::2, 1::2] = 40.0, 160.0  # red and blue see a grey sky differently
    for data in (saved("BMP", grey.astype(np.uint8)), saved("PNG", (grey * 10).astype(np.uint16))):
        image = read_image(write(tmp_path, data), bayer=True)
        assert image.array.shape == (20, 30)
        assert np.ptp(image.array.astype(float)) == 0
        assert image.saturation in (16 * 255.0, 16 * 65535.0)
    said = fits(grey, 16, ("BAYERPAT= 'RGGB    '",))
    assert np.ptp(read_image(write(tmp_path, said)).array) == 0
    assert np.ptp(read_image(write(tmp_path, said), bayer=False).array) == 120
    info = TiffImagePlugin.ImageFileDirectory_v2()
    info[33422] = b"\0\1\1\2"
    assert np.ptp(read_image(write(tmp_path, saved("TIFF", grey.astype(np.uint8), tiffinfo=info))).array) == 0


def test_what_is_no_image(tmp_path):
    cases = {
        "empty.png": (b"", "empty"),
        "text.png": (b"right ascension, declination\n" * 100, "none of the known formats"),
        "pickle.png": (
            b"\x80\x04\x95\x1e\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x94\x8c\x06system\x94\x93\x94.",
            "known formats",
        ),
        "script.eps": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n(x) run\n", "known formats"),
        "still.gif": (saved("GIF"), "known formats"),
        "nothing.fits": (fits(np.zeros((0,)), 8), "holds no image"),
        "short.fits": (fits(EIGHT, 16)[:3000], "ends before"),
        "header.fits": (fits(EIGHT, 16)[:500], "within its header"),
        "endless.fits": (b"SIMPLE  =                    T".ljust(80) * 36 * 300, "no end"),
        "cube.fits": (fits(np.zeros((7, 20, 30)), 8), "cube"),
        "odd.fits": (fits(EIGHT, 16).replace(b"                  16", b"                  13"), "BITPIX"),
        "packed.fits": (fits(EIGHT, 8, ("ZIMAGE  =                    T",)), "funpack"),
        "nan.fits": (fits(np.full((5, 5), np.nan), -32), "no number"),
    }
    for name, (data, words) in cases.items():
        with pytest.raises(DataError, match=words) as e:
            read_image(write(tmp_path, data, name))
        assert name in str(e.value)
    with pytest.raises(DataError, match="no such file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(DataError, match="is a folder"):
        read_image(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(DataError, match="no regular file"):
        read_image(tmp_path / "pipe.png")


def png_claiming(width: int, height: int, body: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")


def test_sizes_that_nobody_can_bear(tmp_path, monkeypatch):
    huge = {
        "bomb.png": png_claiming(100_000, 100_000),
        "wide.png": png_claiming(12_001, 10_000),
        "bomb.fits": fits(EIGHT, 8).replace(b"NAXIS1  =                   30", b"NAXIS1  =          30000000"),
        "overflow.fits": fits(EIGHT, 8).replace(b"NAXIS1  =                   30", b"NAXIS1  = 99999999999999999999"),
        "bomb.bmp": saved("BMP")[:18] + struct.pack("<ii", 60_000, 60_000) + saved("BMP")[26:],
    }
    for name, data in huge.items():
        with pytest.raises(DataError, match=name):
            read_image(write(tmp_path, data, name))
    monkeypatch.setattr(images, "MAX_BYTES", 100)
    with pytest.raises(DataError, match="MiB"):
        read_image(write(tmp_path, saved("BMP")))


def test_many_pixels_are_read_up_to_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 600)
    assert read_image(write(tmp_path, saved("PNG"))).array.size == 600
    monkeypatch.setattr(images, "MAX_PIXELS", 599)
    for data in (saved("PNG"), saved("TIFF"), fits(EIGHT, 8)):
        with pytest.raises(DataError, match="more than 599"):
            read_image(write(tmp_path, data))


WHOLE = [
    saved("PNG"), saved("PNG", SIXTEEN), saved("JPEG"), saved("BMP"), saved("TIFF"), saved("TIFF", SIXTEEN, compression="tiff_lzw"),
    saved("TIFF", compression="tiff_adobe_deflate"), fits(EIGHT, 8), fits(EIGHT, 16, ("BZERO   = 32768", "BLANK   = 3")),
]  # fmt: skip


@settings(max_examples=250)
@given(st.data())
def test_damaged_files_are_data_errors_or_images(tmp_path_factory, data):
    """Cut, overwritten, filled in: whatever comes, an Image or a DataError, and nothing else."""
    raw = bytearray(data.draw(st.sampled_from(WHOLE)))
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        raw[at : at + data.draw(st.integers(1, 4))] = data.draw(st.binary(max_size=6))
    raw = raw[: data.draw(st.integers(0, len(raw)))] if data.draw(st.booleans()) else raw
    path = write(tmp_path_factory.getbasetemp(), bytes(raw), "damaged.img")
    try:
        image = read_image(path)
    except DataError as e:
        said = str(e)
    else:
        said = path.name
        assert image.array.ndim == 2
        assert image.array.size <= images.MAX_PIXELS
    assert path.name in said


@settings(max_examples=60)
@given(
    st.binary(max_size=400),
    st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*", b"\xff\xd8\xff", b"SIMPLE  ="]),
)
def test_any_bytes_are_data_errors(tmp_path_factory, tail, magic):
    path = write(tmp_path_factory.getbasetemp(), magic + tail, "bytes.img")
    with pytest.raises(DataError, match="bytes"):
        read_image(path)


def test_reading_and_detecting_load_nothing_heavy():
    heavy = ("jax", "pydantic", "pandas", "scipy")
    code = f"import helmstar.io.images, helmstar.imaging, sys; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
