"""What a calibration says beside the camera: how well it is known, how honest its centroids are, which pixels always shine.

In cam.toml it is the table [calibration]; a cam.toml written by hand may lack it, or any of its keys.
"""

from __future__ import annotations

import io
import math
import tomllib
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError
from ..files import replacing, write_atomically
from .camera import Camera, read_camera

TABLE = "calibration"
NUMBERS = ("focal_sigma_px", "centre_sigma_px", "k1_sigma", "centroid_scale", "centroid_floor_px", "smooth_px")


@dataclass(frozen=True)
class Calibrated:
    """camera, with 1 sigma of its focal length and of its centre (px, the larger coordinate's) and of k1; what no calibration told
    is None.

    centroid_scale, centroid_floor_px: the covariance of a centroid is scale^2 times the detection's, plus floor^2 on each axis.
    smooth_px: 1 sigma per axis by which the lens moves neighbouring stars alike beyond the fit, which more stars do not average.
    dark: (height, width) float32 to subtract, or None.
    """

    camera: Camera
    focal_sigma_px: float | None = None
    centre_sigma_px: float | None = None
    k1_sigma: float | None = None
    centroid_scale: float = 1.0
    centroid_floor_px: float = 0.0
    smooth_px: float = 0.0
    dark: np.ndarray | None = None


def read_calibrated(path: Path) -> Calibrated:
    """Read cam.toml with its [calibration], and the dark beside it. Raises ConfigurationError, naming file and key."""
    path = Path(path)
    camera = read_camera(path)
    table = tomllib.loads(path.read_text(encoding="utf-8")).get(TABLE, {})
    if not isinstance(table, dict):
        raise ConfigurationError(f"{path}: {TABLE} must be a table")
    unknown = sorted(set(table) - {*NUMBERS, "dark"})
    if unknown:
        known = ", ".join((*NUMBERS, "dark"))
        raise ConfigurationError(f"{path}: [{TABLE}] has the unknown key {unknown[0]!r}; known: {known}")
    numbers: dict[str, float] = {}
    for key in NUMBERS:
        value = table.get(key)
        if value is None:
            continue
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0.0
        if not good or (key == "centroid_scale" and value == 0.0):
            least = "more than 0" if key == "centroid_scale" else "0 or more"
            raise ConfigurationError(f"{path}: [{TABLE}] {key} must be a number, {least}, is {value!r}")
        numbers[key] = float(value)
    name = table.get("dark")
    if name is not None and not isinstance(name, str):
        raise ConfigurationError(f"{path}: [{TABLE}] dark must be the name of a file, is {name!r}")
    dark = None if name is None else read_dark(path.parent / name, (camera.height, camera.width))
    return Calibrated(camera, **numbers, dark=dark)


def write_dark(path: Path, dark: np.ndarray) -> None:
    """Write a dark frame as .npz, whole or not at all. Raises OSError."""
    with replacing(Path(path)) as part, part.open("wb") as file:
        np.savez_compressed(file, dark=dark.astype(np.float32))


def read_dark(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """A dark frame of that shape, float32. Nothing in the file is run, and nothing larger than the shape is unpacked.

    Raises ConfigurationError for what is none.
    """
    remedy = "make one with helmstar calibrate --dark, or take the key `dark` out"
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo("dark.npy")
            if member.file_size > 8 * shape[0] * shape[1] + 4096:
                raise ConfigurationError(
                    f"{path}: is larger than the camera's {shape[1]} x {shape[0]} pixels; {remedy}"
                )
            with archive.open(member) as file:
                data = file.read(8 * shape[0] * shape[1] + 4097)
        dark = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except OSError as e:
        raise ConfigurationError(f"{path}: {e.strerror or e}; {remedy}") from None
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, NotImplementedError, RuntimeError, zlib.error) as e:
        raise ConfigurationError(f"{path}: no dark frame ({str(e)[:80]}); {remedy}") from None
    if dark.shape != shape or dark.dtype.kind not in "uif":
        raise ConfigurationError(
            f"{path}: a dark of shape {dark.shape}, but the camera has {shape[1]} x {shape[0]} pixels; {remedy}"
        )
    dark = dark.astype(np.float32)
    if not np.isfinite(dark).all():
        raise ConfigurationError(f"{path}: holds what is no number; {remedy}")
    return dark


def write_calibrated(path: Path, camera: Camera, lines: list[str]) -> None:
    """Write cam.toml with the lines of its [calibration], whole or not at all. Raises OSError."""
    write_atomically(Path(path), camera.to_toml() + f"\n[{TABLE}]\n" + "\n".join(lines) + "\n")


__all__ = ["NUMBERS", "Calibrated", "read_calibrated", "read_dark", "write_calibrated", "write_dark"]
