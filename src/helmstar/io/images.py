"""Star images from files: PNG, JPEG, TIFF and BMP by Pillow, FITS by `io.fits`, as one grey array.

Colour is the sum of its channels (every photon counts); a mosaic of colour filters is smoothed by [1 2 1] both ways, in which each
colour has the same weight everywhere, and keeps its size. What a file says about itself is not believed before the
number of its pixels is known to be bearable, and nothing in a file is ever run: four formats, no others, are decoded.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..imaging.frame import Image
from .fits import FitsError, read_fits

MAX_PIXELS = 120_000_000
MAX_BYTES = 1 << 30
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP")
_REMEDY = "give a PNG, JPEG, TIFF, BMP or FITS image"
_DEPTHS = (10, 12, 14, 16)
_SHARED = 3
_CFA_PATTERN = 33422  # TIFF/EP tag


def read_image(path: Path | str, *, bayer: bool | None = None) -> Image:
    """Read one image.

    bayer: whether its pixels lie behind a mosaic of colour filters; None believes the file (FITS BAYERPAT, TIFF CFAPattern).
    Raises DataError, with the file's name and a remedy, for everything that is no whole image of at most MAX_PIXELS.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise DataError(f"{path}: is a folder; {_REMEDY}")
        if not path.exists():
            raise DataError(f"{path}: no such file; {_REMEDY}")
        if not path.is_file():
            raise DataError(f"{path}: is no regular file; {_REMEDY}")
        size = path.stat().st_size
        if size == 0:
            raise DataError(f"{path}: is empty; {_REMEDY}")
        if size > MAX_BYTES:
            raise DataError(f"{path}: has {size >> 20} MiB, more than {MAX_BYTES >> 20}; cut or bin it")
        with path.open("rb") as file:
            start = file.read(16)
        read = _fits if start.startswith(b"SIMPLE  =") else _pillow
        array, bits, metadata, mosaic = read(path)
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: cannot be read ({_reason(e)}); {_REMEDY}") from None
    except MemoryError:
        raise DataError(f"{path}: needs more memory than there is; cut or bin it") from None
    if min(array.shape[:2]) < 1:
        raise DataError(f"{path}: has no pixels; {_REMEDY}")
    grey, saturation = _grey(path, array, bits, _stated(metadata))
    if mosaic if bayer is None else bayer:
        grey, saturation = _smoothed(grey), 16.0 * saturation
    return Image(grey, saturation, bits, metadata)


def _pillow(path: Path) -> tuple[np.ndarray, int, dict[str, str], bool]:
    """Array (h, w) or (h, w, channels), bits of a sample, metadata, whether it says that it is a mosaic."""
    from PIL import Image as Pillow

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own warnings about size and metadata: the limit here is ours
        try:
            with Pillow.open(path, formats=_FORMATS) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise DataError(f"{path}: {width} x {height} pixels are more than {MAX_PIXELS}; cut or bin it")
                metadata = {"format": str(image.format), "mode": image.mode}
                mosaic = image.format == "TIFF" and _CFA_PATTERN in getattr(image, "tag_v2", {})
                image.load()
                if image.mode in ("1", "P", "PA", "CMYK", "YCbCr", "LAB", "HSV"):
                    image = image.convert("L" if image.mode == "1" else "RGB")
                array = np.asarray(image)
        except DataError:
            raise
        except Pillow.DecompressionBombError:
            raise DataError(f"{path}: says that it has more than {MAX_PIXELS} pixels; cut or bin it") from None
        except Pillow.UnidentifiedImageError:
            raise DataError(f"{path}: is none of the known formats; {_REMEDY}") from None
        except MemoryError:
            raise
        except Exception as e:  # decoders raise whatever a damaged file makes them stumble over
            raise DataError(f"{path}: is damaged ({_reason(e)}); copy or save it again") from None
    if array.ndim == 3:
        array = array[..., :1] if array.shape[2] == 2 else array[..., :3]  # without transparency
    return array, 8 * array.dtype.itemsize, metadata, mosaic


def _fits(path: Path) -> tuple[np.ndarray, int, dict[str, str], bool]:
    try:
        image = read_fits(path.read_bytes(), MAX_PIXELS)
    except FitsError as e:
        raise DataError(f"{path}: as FITS, {e}") from None
    array = image.array
    if array.ndim == 3:
        array = np.moveaxis(array[:3], 0, -1)
    return array, image.bits, {"format": "FITS", **image.header}, "BAYERPAT" in image.header


def _grey(path: Path, array: np.ndarray, bits: int, full: float) -> tuple[np.ndarray, float]:
    """One plane, uint8, uint16 or float32, and the value at which its pixels are full: `full` for numbers of other kinds."""
    if array.dtype.kind not in "uif" or array.dtype.itemsize > 8:
        raise DataError(f"{path}: has pixels of type {array.dtype}; save it with 8 or 16 bits")
    if array.ndim == 3 and (array.shape[2] == 1 or all((array[..., 0] == array[..., k]).all() for k in (1, 2))):
        array = array[..., 0]
    if array.dtype.kind == "u" and array.dtype.itemsize <= 2:
        limit = _full(array, bits)
        if array.ndim == 2:
            return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="), copy=False)), limit
        grey = array.sum(axis=2, dtype=np.uint16 if bits == 8 else np.float32)
        grey[array.max(axis=2) >= limit] = 3 * limit  # one full channel spoils the pixel
        return grey, 3 * limit
    values = array.astype(np.float32)
    if values.ndim == 3:
        values = values.sum(axis=2)
    finite = np.isfinite(values)
    if not finite.any():
        raise DataError(f"{path}: holds no number in any pixel; save it again")
    if not finite.all():
        values[~finite] = np.median(values[finite])
    return np.ascontiguousarray(values), full


def _stated(metadata: dict[str, str]) -> float:
    """FITS SATURATE, or infinity: numbers that are no counts have no natural limit."""
    try:
        return float(metadata["SATURATE"])
    except (KeyError, ValueError):
        return float("inf")


def _full(array: np.ndarray, bits: int) -> float:
    """255; for 16 bits the largest value, where several pixels share it and a sensor of 10 to 16 bits ends near it."""
    if bits == 8:
        return 255.0
    most = int(array.max())
    ends = any(0.9 * (1 << d) <= most < 1 << d for d in _DEPTHS)
    return float(most) if ends and np.count_nonzero(array == most) >= _SHARED else 65535.0


def _smoothed(grey: np.ndarray) -> np.ndarray:
    """Sum over 3 x 3 with weights [1 2 1] both ways, edges mirrored so that colours keep their turn; 16 times the mean."""
    a = np.pad(grey, 1, mode="reflect").astype(np.uint16 if grey.dtype == np.uint8 else np.float32)
    a = a[:-2] + 2 * a[1:-1] + a[2:]
    return a[:, :-2] + 2 * a[:, 1:-1] + a[:, 2:]


def _reason(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())[:120]


__all__ = ["MAX_PIXELS", "read_image"]
