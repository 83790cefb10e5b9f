"""Grey images written to PNG, TIFF and FITS, whole or not at all, with the time of the exposure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..files import replacing
from .fits import BLOCK

SUFFIXES = {".png": "png", ".tif": "tiff", ".tiff": "tiff", ".fits": "fits", ".fit": "fits"}
_EXIF, _ORIGINAL, _SUBSECOND, _OFFSET, _EXPOSURE = 0x8769, 0x9003, 0x9291, 0x9011, 0x829A


def write_image(
    path: Path, array: np.ndarray, form: str, *, begun: str | None = None, taken: str | None = None,
    exposure_s: float | None = None, header: Mapping[str, float | str] | None = None,
) -> None:  # fmt: skip
    """Write a grey image.

    array: (height, width), uint8 or uint16. form: "png", "tiff" or "fits". begun, taken: UTC of the exposure's begin and
    middle, ISO 8601 with six digits of a second; FITS gets them as DATE-OBS and DATE-AVG, the others the middle as EXIF's
    DateTimeOriginal, which says nothing of which it is. header: more cards for FITS. Raises OSError, and ValueError for
    other arrays and formats.
    """
    if array.ndim != 2 or array.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"array {array.shape} of {array.dtype}: must be (height, width) of uint8 or uint16")
    with replacing(Path(path)) as part:
        if form == "fits":
            cards = {"EXPTIME": exposure_s, "DATE-OBS": begun, "DATE-AVG": taken, "TIMESYS": "UTC" if taken else None}
            part.write_bytes(_fits(array, {k: v for k, v in {**cards, **(header or {})}.items() if v is not None}))
        elif form in ("png", "tiff"):
            _pillow(part, array, form, taken, exposure_s)
        else:
            raise ValueError(f"format {form!r}: must be one of png, tiff, fits")


def _pillow(path: Path, array: np.ndarray, form: str, taken: str | None, exposure_s: float | None) -> None:
    from PIL import Image as Picture
    from PIL import TiffImagePlugin

    more: dict[str, Any] = {}
    if taken is not None:
        whole, _, fraction = taken.partition(".")
        own: dict[int, Any] = {
            _ORIGINAL: whole.replace("-", ":").replace("T", " "), _SUBSECOND: fraction or "0", _OFFSET: "+00:00",
        }  # fmt: skip
        if exposure_s is not None:
            own[_EXPOSURE] = exposure_s
        if form == "tiff":  # whose writer takes no Exif object's inner directory
            more["tiffinfo"] = TiffImagePlugin.ImageFileDirectory_v2()
            more["tiffinfo"][_EXIF] = own
        else:
            more["exif"] = Picture.Exif()
            more["exif"][_EXIF] = own
    Picture.fromarray(array).save(path, format=form.upper(), **more)


def _fits(array: np.ndarray, more: Mapping[str, float | str]) -> bytes:
    wide = array.dtype == np.uint16
    cards: dict[str, object] = {
        "SIMPLE": True, "BITPIX": 16 if wide else 8, "NAXIS": 2, "NAXIS1": array.shape[1], "NAXIS2": array.shape[0],
    }  # fmt: skip
    if wide:
        cards |= {"BSCALE": 1, "BZERO": 32768}
    text = "".join(_card(key, value) for key, value in {**cards, **more}.items()) + "END".ljust(80)
    body = (array ^ np.uint16(0x8000)).astype(">u2").tobytes() if wide else array.tobytes()
    return _padded(text.encode("ascii"), b" ") + _padded(body, b"\0")


def _card(key: str, value: object) -> str:
    if isinstance(value, str):
        text = f"'{value:<8}'".ljust(20)
    elif isinstance(value, bool):
        text = ("T" if value else "F").rjust(20)
    else:
        text = f"{value!r:>20}".upper()
    return f"{key:<8}= {text}".ljust(80)


def _padded(data: bytes, fill: bytes) -> bytes:
    return data + fill * (-len(data) % BLOCK)


__all__ = ["SUFFIXES", "write_image"]
