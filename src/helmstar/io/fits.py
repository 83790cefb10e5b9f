"""The first image of a FITS file (standard 4.0): uncompressed, 2-D, or three planes of colour.

A reader of its own, because a header of 80-character cards and one block of big-endian numbers is all that cameras write;
astropy and fitsio bring far more than that. Tile compressed images are refused with a remedy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

BLOCK = 2880
_MAX_HEADER_BLOCKS = 200
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}


class FitsError(Exception):
    """What is wrong with the file, without its name."""


@dataclass(frozen=True)
class FitsImage:
    """array: (height, width) or (planes, height, width), scaled by BSCALE and BZERO; header: text by keyword."""

    array: np.ndarray
    header: dict[str, str]
    bits: int


def read_fits(data: bytes, max_pixels: int) -> FitsImage:
    """The first HDU that holds an image. Raises FitsError."""
    start = 0
    for _ in range(100):
        header, body = _header(data, start)
        bitpix, axes = (
            _whole(header, "BITPIX"),
            [_whole(header, f"NAXIS{k + 1}") for k in range(_whole(header, "NAXIS", 0, 999))],
        )
        if bitpix not in _TYPES:
            raise FitsError(f"BITPIX is {bitpix}; must be one of {', '.join(map(str, _TYPES))}")
        if any(n < 0 for n in axes):
            raise FitsError("an axis has a negative length")
        pixels = math.prod(axes) if axes else 0
        kind = header.get("XTENSION", "IMAGE").strip()
        if header.get("ZIMAGE", "").strip() == "T":
            raise FitsError("the image is tile compressed; unpack it first (funpack)")
        if kind == "IMAGE" and pixels and len(axes) >= 2:
            return _image(data, body, header, bitpix, axes, max_pixels)
        groups = _whole(header, "PCOUNT", 0) if "PCOUNT" in header else 0
        size = abs(bitpix) // 8 * (pixels + max(groups, 0))
        start = body + -(-size // BLOCK) * BLOCK
        if start >= len(data):
            raise FitsError("it holds no image")
    raise FitsError("no image in its first 100 parts")


def fits_header(data: bytes) -> dict[str, str]:
    """Cards of the first header of a file that begins with these bytes. Raises FitsError."""
    return _header(data, 0)[0]


def _image(data: bytes, at: int, header: dict[str, str], bitpix: int, axes: list[int], max_pixels: int) -> FitsImage:
    shape = list(reversed(axes))
    while len(shape) > 2 and shape[0] == 1:
        shape = shape[1:]
    if len(shape) > 3 or (len(shape) == 3 and shape[0] not in (3, 4)):
        raise FitsError(f"it is no picture but a cube of {' x '.join(map(str, axes))}; save one plane of it")
    height, width = shape[-2:]
    if height * width > max_pixels:
        raise FitsError(f"{width} x {height} pixels are more than {max_pixels}; cut or bin it")
    count, kind = math.prod(shape), np.dtype(_TYPES[bitpix])
    if at + count * kind.itemsize > len(data):
        raise FitsError(f"it ends before its {axes[0]} x {axes[1]} pixels do; copy it again")
    raw = np.frombuffer(data, kind, count, at).reshape(shape)
    scale, zero = _number(header, "BSCALE", 1.0), _number(header, "BZERO", 0.0)
    if bitpix == 16 and scale == 1.0 and zero == 32768.0:
        return FitsImage((raw.astype(np.int32) + 32768).astype(np.uint16), header, 16)
    if bitpix == 8 and scale == 1.0 and zero == 0.0:
        return FitsImage(raw, header, 8)
    with np.errstate(over="ignore", invalid="ignore"):
        values = (raw.astype(np.float64) * scale + zero).astype(np.float32)
    if bitpix > 0 and "BLANK" in header:
        values[raw == _whole(header, "BLANK")] = np.nan
    return FitsImage(values, header, abs(bitpix))


def _header(data: bytes, start: int) -> tuple[dict[str, str], int]:
    """Cards by keyword, text as it stands without comment, and where the data begin."""
    cards: dict[str, str] = {}
    for block in range(_MAX_HEADER_BLOCKS):
        text = data[start + block * BLOCK : start + (block + 1) * BLOCK]
        if len(text) < BLOCK:
            raise FitsError("it ends within its header; copy it again")
        for k in range(0, BLOCK, 80):
            card = text[k : k + 80].decode("latin-1")
            key = card[:8].strip()
            if key == "END":
                return cards, start + (block + 1) * BLOCK
            if card[8:10] == "= ":
                cards.setdefault(key, _value(card[10:]))
    raise FitsError("its header has no end")


def _value(text: str) -> str:
    text = text.strip()
    if text.startswith("'"):
        end = text.find("'", 1)
        return text[1 : end if end > 0 else None].rstrip()
    return text.split("/")[0].strip()


def _whole(header: dict[str, str], key: str, low: int = -(2**62), high: int = 2**62) -> int:
    try:
        value = int(header[key])
    except KeyError:
        raise FitsError(f"its header lacks {key}") from None
    except ValueError:
        raise FitsError(f"{key} is {header[key]!r}, no whole number") from None
    if not low <= value <= high:
        raise FitsError(f"{key} is {value}")
    return value


def _number(header: dict[str, str], key: str, default: float) -> float:
    try:
        value = float(header.get(key, default))
    except ValueError:
        raise FitsError(f"{key} is {header[key]!r}, no number") from None
    if not math.isfinite(value):
        raise FitsError(f"{key} is {header[key]!r}")
    return value


__all__ = ["FitsError", "FitsImage", "fits_header", "read_fits"]
