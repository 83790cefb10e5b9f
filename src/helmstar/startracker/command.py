"""`helmstar solve`: images of stars to attitudes, without a prior."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigurationError, DataError
from ..files import readable
from ..imaging.calibrated import Calibrated, read_calibrated
from ..progress import Progress
from ..sensors.observer import observer, observer_place
from ..sensors.star_tracker import StarSolution, StarTracker
from ..stars.catalog import Catalog, load_gaia
from ..stars.identify import LIMIT
from .dates import instant_of, julian_date_tt

UNKNOWN_FIELD = (4.0, 30.0)
"""deg: what is tried where neither camera nor field is given."""
CATALOGS = ("hipparcos", "gaia")
ARCSEC_RAD = 180.0 * 3600.0 / np.pi


@dataclass(frozen=True)
class SolveOptions:
    """fov: text of --fov, a number or LOW..HIGH in deg; camera: cam.toml; time: UTC, ISO 8601; plot: folder for PNGs;
    catalog: of CATALOGS."""

    fov: str | None = None
    camera: Path | None = None
    aspect: float = 1.0
    time: str | None = None
    plot: Path | None = None
    limit: float = LIMIT
    catalog: str = "hipparcos"


def field_of(text: str) -> float | tuple[float, float]:
    """A horizontal field in deg, or a range. Raises ConfigurationError for anything else."""
    message = f"--fov {text}: must be a field in deg such as 11.4, or a range such as 5..25, between 0.5 and 120"
    low, dots, high = text.partition("..")
    try:
        values = [float(low), float(high)] if dots else [float(low)]
    except ValueError:
        raise ConfigurationError(message) from None
    if not all(0.5 <= v <= 120.0 for v in values) or values != sorted(set(values)):
        raise ConfigurationError(message)
    return (values[0], values[1]) if dots else values[0]


def tracker_of(options: SolveOptions, date_tt: float | None = None) -> StarTracker:
    """The star tracker that the options describe, at their time or else at a Julian date in TT. Raises HelmstarError."""
    if options.fov is not None and options.camera is not None:
        raise ConfigurationError("--fov and --camera: give one of them, the camera has its field")
    if not 0.1 <= options.aspect <= 10.0:
        raise ConfigurationError(f"--pixel-aspect {options.aspect:g}: pixel height over width must be 0.1 to 10")
    if not 1e-15 <= options.limit <= 0.5:
        raise ConfigurationError(f"--max-false {options.limit:g}: must be between 1e-15 and 0.5")
    camera: Calibrated | None = None
    field: float | tuple[float, float] | None = None
    if options.camera is not None:
        if options.aspect != 1.0:
            raise ConfigurationError("--pixel-aspect and --camera: the camera has its own aspect")
        camera = read_calibrated(options.camera)
    else:
        field = UNKNOWN_FIELD if options.fov is None else field_of(options.fov)
    year, velocity, position = None, None, None
    date = date_tt
    if options.time is not None:
        instant = instant_of(options.time)
        date = julian_date_tt(int(instant.day[0]), float(instant.second[0]))
    if date is not None:
        (year, velocity), position = observer(date), observer_place(date)
    return StarTracker(
        camera, fov_deg=field, aspect=options.aspect, julian_year=year, velocity_c=velocity, position_au=position,
        catalog=_catalog(options.catalog), limit=options.limit,
    )  # fmt: skip


def _catalog(name: str) -> Catalog | None:
    """None is Hipparcos, whose tables are kept ready."""
    if name not in CATALOGS:
        raise ConfigurationError(f"--catalog {name}: must be one of {', '.join(CATALOGS)}")
    return load_gaia() if name == "gaia" else None


def check_plot(folder: Path | None) -> None:
    """Raise ConfigurationError for a --plot that no folder can be: before the work, not after it."""
    if folder is not None and folder.exists() and not folder.is_dir():
        raise ConfigurationError(f"--plot {folder}: is a file; give a folder")


def _drawings(files: Sequence[Path], folder: Path) -> list[Path]:
    """A drawing for each file, of its name; where several have the name, with the number of the argument."""
    count = Counter(f.stem for f in files)
    return [folder / (f"{f.stem}.png" if count[f.stem] == 1 else f"{f.stem}-{k + 1}.png") for k, f in enumerate(files)]


def run_solve(files: Sequence[Path], options: SolveOptions) -> dict[str, Any]:
    """The object of `--json`: one entry for each file, in order, whatever became of it. Raises HelmstarError for options that
    mean nothing."""
    check_plot(options.plot)
    tracker = tracker_of(options)
    drawings = [None] * len(files) if options.plot is None else _drawings(files, options.plot)
    entries = []
    with Progress(len(files) > 1) as bar:
        task = bar.add("images", len(files))
        for file, drawing in zip(files, drawings, strict=True):
            entries.append(_entry(tracker, file, drawing))
            bar.advance(task)
    return {"images": entries}


def _entry(tracker: StarTracker, file: Path, drawing: Path | None) -> dict[str, Any]:
    from ..io.images import read_image

    begin = time.perf_counter()
    try:
        image = read_image(file)
        read = time.perf_counter()
        found = tracker.solve(image)
    except (DataError, ValueError) as error:
        return _empty(file, "unreadable" if isinstance(error, DataError) else "wrong size", str(error), begin)
    entry = entry_of(file, found)
    ms = {"read": 1e3 * (read - begin), **{k: v for k, v in found.ms.items() if k != "total"}}
    entry["ms"] = {k: round(v, 3) for k, v in ms.items()}
    entry["ms_total"] = round(1e3 * (time.perf_counter() - begin), 3)
    if drawing is not None:
        from .plot import draw

        entry["plot"] = readable(str(draw(image, found, tracker.sky.catalog, drawing)))
    return entry


KEYS = (
    "ra_deg", "dec_deg", "roll_deg", "q_sn", "sigma_arcsec", "fov_deg", "stars", "detections", "residual_rms_arcsec",
    "probability_false", "hip",
)  # fmt: skip


def _empty(file: Path, status: str, message: str, begin: float) -> dict[str, Any]:
    total = round(1e3 * (time.perf_counter() - begin), 3)
    return {
        "file": readable(str(file)),
        "status": status,
        "message": message,
        **dict.fromkeys(KEYS),
        "ms": {},
        "ms_total": total,
    }


def entry_of(file: Path, found: StarSolution) -> dict[str, Any]:
    """What is said of one image. Angles in deg at the geometric image centre; q_sn turns N into S, scalar last."""
    i = found.identification
    out: dict[str, Any] = {"file": readable(str(file)), "status": found.status, "message": REASON[found.status]}
    out |= dict.fromkeys(KEYS)
    out["detections"] = len(found.centroids)
    p = float(i.probability_false)
    out["probability_false"] = p if np.isfinite(p) else None
    if not found.solved:
        return out
    return out | {
        "ra_deg": found.ra_deg,
        "dec_deg": found.dec_deg,
        "roll_deg": found.roll_deg,
        "q_sn": [float(v) for v in i.q_SN],
        "sigma_arcsec": [float(v) for v in found.sigma_arcsec],
        "fov_deg": float(np.degrees(found.camera.fov)),
        "stars": len(i.stars),
        "residual_rms_arcsec": float(i.residual_rms * ARCSEC_RAD),
        "hip": [int(v) for v in i.hip],
        "message": _doubted(found),
    }


def _doubted(found: StarSolution) -> str:
    side = found.averaged_px
    smeared = f"solved on means of {side} x {side} pixels: the stars are smeared or badly focused" if side > 1 else ""
    return "; ".join(text for text in (DOUBTED[found.doubt], smeared) if text)


DOUBTED = {
    "": "",
    "rough": "solved with a lens that displaces stars by pixels, brightness by its order alone: calibrate the camera",
    "field": "solved with another field than --fov says",
    "rough, field": "solved with another field than --fov says, and a lens that displaces stars by pixels: calibrate the camera",
}
REASON = {
    "solved": "",
    "too few stars": "fewer than three stars were detected; expose longer, or focus",
    "no match": "no attitude explains the detections better than chance; give a range as --fov, --pixel-aspect "
    "where pixels are not square, and no mirrored image",
    "uncertain": "the best attitude is more probably false than --max-false allows; give an image of more stars",
}


def print_solved(result: dict[str, Any]) -> None:
    """One line for each image."""
    for e in result["images"]:
        if e["status"] != "solved":
            print(f"{e['file']}: {e['status']}: {e['message']}")
            continue
        cross, roll = max(e["sigma_arcsec"][:2]), e["sigma_arcsec"][2]
        print(
            f"{e['file']}: RA {e['ra_deg']:.5f} Dec {e['dec_deg']:+.5f} roll {e['roll_deg']:.4f} deg "
            f"(+- {cross:.2g}, roll {roll:.2g} arcsec), field {e['fov_deg']:.4f} deg, {e['stars']} stars, "
            f"residual {e['residual_rms_arcsec']:.3g} arcsec, false {e['probability_false']:.1g}, {e['ms_total']:.0f} ms"
            + (f"; {e['message']}" if e["message"] else "")
        )


__all__ = ["SolveOptions", "print_solved", "run_solve"]
