"""`helmstar render`: frames of a star tracker as a sensor would take them, with their truth."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigurationError
from ..files import readable, write_atomically
from ..imaging import Camera, read_camera
from ..progress import Progress

MOST_PIXELS = 120_000_000
"""What `helmstar solve` reads."""
LONGEST_SMEAR_PX = 1000.0
FORMATS = ("png", "fits", "tiff")


@dataclass(frozen=True)
class RenderOptions:
    """ra_deg, dec_deg, roll_deg: of the (first) image's geometric centre at mid-exposure. fov_deg with size "WxH", or camera:
    cam.toml. time: UTC of the first frame. rate_deg_s: of S, constant. exposure_s, psf_sigma_px, sky_e_s, glow (x, y, peak, sigma):
    see imaging.render. hot_pixels: how many. count, step_s: a sequence. out: file, or folder of a sequence."""

    ra_deg: float
    dec_deg: float
    roll_deg: float = 0.0
    fov_deg: float | None = None
    size: str | None = None
    camera: Path | None = None
    time: str | None = None
    exposure_s: float = 0.2
    psf_sigma_px: float = 0.8
    sky_e_s: float = 20.0
    glow: tuple[str, ...] = ()
    rate_deg_s: str = "0,0,0"
    hot_pixels: int = 0
    limit_magnitude: float | None = None
    catalog: str = "hipparcos"
    seed: int = 0
    bits: int = 8
    format: str | None = None
    count: int | None = None
    step_s: float = 1.0
    out: Path | None = None
    truth: Path | None = None


# Electrons per count and counts at no light: of 8 bits read noise shows in the last one; of 16 bits the converter ends at the
# full well, so that full pixels are 65535.
_CONVERTER = {8: (8.0, 8.0), 16: (0.3, 200.0)}


def numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    """Numbers separated by commas. Raises ConfigurationError."""
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ConfigurationError(f"{name} {text}: must be {count} numbers separated by commas")
    return values


def camera_of(options: RenderOptions) -> Camera:
    """The camera that the options describe. Raises ConfigurationError."""
    if (options.camera is None) == (options.fov_deg is None):
        raise ConfigurationError("--camera, --fov: give one of them; --fov needs --size WxH too")
    if options.camera is not None:
        if options.size is not None:
            raise ConfigurationError("--size and --camera: the camera has its own size")
        camera = read_camera(options.camera)
    else:
        width, cross, height = (options.size or "1024x768").lower().partition("x")
        if not (cross and width.isdecimal() and height.isdecimal()):
            raise ConfigurationError(f"--size {options.size}: must be width and height in pixels, such as 1024x768")
        try:
            camera = Camera.from_fov(float(options.fov_deg or 0.0), int(width), int(height))
        except ValueError as error:
            raise ConfigurationError(f"--fov, --size: {error}") from None
    if camera.width * camera.height > MOST_PIXELS:
        raise ConfigurationError(f"{camera.width} x {camera.height} pixels are more than {MOST_PIXELS}: take fewer")
    return camera


def exposure_of(options: RenderOptions, camera: Camera) -> Any:
    """imaging.render.Exposure of the options. Raises ConfigurationError."""
    from ..imaging.render import Exposure, Glow, longest_smear

    if options.bits not in _CONVERTER:
        raise ConfigurationError(f"--bits {options.bits}: must be 8 or 16")
    if not 0 <= options.hot_pixels <= camera.width * camera.height:
        raise ConfigurationError(f"--hot-pixels {options.hot_pixels}: must be 0 to the number of pixels")
    gain, offset = _CONVERTER[options.bits]
    x, y, z = map(math.radians, numbers("--rate-deg-s", options.rate_deg_s, 3))
    glow = tuple(Glow(*numbers("--glow", text, 4)) for text in options.glow)
    if any(g.sigma_px <= 0.0 or g.peak_e < 0.0 for g in glow):
        raise ConfigurationError("--glow X,Y,PEAK,SIGMA: peak (electrons) must not be negative, sigma (px) be positive")
    try:
        exposure = Exposure(
            duration=options.exposure_s, psf_sigma_px=options.psf_sigma_px, omega_SN_S=(x, y, z),
            sky_e_s=options.sky_e_s, glow=glow, hot_fraction=options.hot_pixels / (camera.width * camera.height),
            gain_e=gain, offset=offset, bits=options.bits,
        )  # fmt: skip
    except ValueError as error:
        raise ConfigurationError(f"--exposure, --psf, --sky: {error}") from None
    smear = longest_smear(camera, exposure)
    if smear > LONGEST_SMEAR_PX:
        raise ConfigurationError(
            f"--rate-deg-s {options.rate_deg_s}: stars would be drawn out over up to {smear:.0f} px; at most "
            f"{LONGEST_SMEAR_PX:.0f} are drawn: take a slower rate or a shorter --exposure"
        )
    return exposure


def run_render(options: RenderOptions) -> dict[str, Any]:
    """Write the frames and their truth; returns the object of `--json`. Raises HelmstarError and OSError."""
    from ..imaging.render import pointed, turned

    camera = camera_of(options)
    exposure = exposure_of(options, camera)
    if not -90.0 <= options.dec_deg <= 90.0 or not all(map(math.isfinite, (options.ra_deg, options.roll_deg))):
        raise ConfigurationError("--ra, --dec, --roll: must be angles in deg, --dec between -90 and 90")
    if options.count is not None and not 1 <= options.count <= 100_000:
        raise ConfigurationError(f"--count {options.count}: must be 1 to 100000 frames")
    if not (math.isfinite(options.step_s) and options.step_s > 0.0):
        raise ConfigurationError(f"--step {options.step_s:g}: must be a positive number of seconds")
    if options.seed < 0:
        raise ConfigurationError(f"--seed {options.seed}: must not be negative")
    single = options.count is None
    names, form = _names(options)
    folder = names[0].parent
    folder.mkdir(parents=True, exist_ok=True)
    angles = np.radians([options.ra_deg, options.dec_deg, options.roll_deg])
    first = pointed(camera, *map(float, angles))
    times = np.arange(len(names)) * options.step_s
    clock = None if options.time is None else _clock(options.time)
    sky = _Sky(options)
    frames = []
    with Progress(not single) as bar:
        task = bar.add("frames", len(names))
        for k, name in enumerate(names):
            q = turned(first, np.array(exposure.omega_SN_S), float(times[k]))
            stars = sky.at(None if clock is None else clock.tt(times[k]))
            frames.append(_frame(name, form, camera, q, stars, exposure, options.seed + k, float(times[k]), clock))
            bar.advance(task)
    result = {
        "camera": {**asdict(camera), "fov_deg": math.degrees(camera.fov)},
        "exposure": asdict(exposure),
        "frames": frames,
    }
    if not single:
        column = "time_utc" if clock is not None else "time_s"
        lines = [f"file,{column}", *(f"{f['file_name']},{f[column]!r}".replace("'", "") for f in frames)]
        result["table"] = readable(str(write_atomically(folder / "frames.csv", "\n".join(lines) + "\n")))
    for f in frames:
        del f["file_name"]
    truth = options.truth or (None if single else folder / "truth.json")
    if truth is not None:
        truth.parent.mkdir(parents=True, exist_ok=True)
        result["truth"] = readable(str(truth))
        write_atomically(truth, json.dumps(result, allow_nan=False, indent=1))
    return result


def _names(options: RenderOptions) -> tuple[list[Path], str]:
    """Files to write, and their format."""
    from ..io.image_files import SUFFIXES

    if options.format is not None and options.format not in FORMATS:
        raise ConfigurationError(f"--format {options.format}: must be one of {', '.join(FORMATS)}")
    suffix = "" if options.out is None else options.out.suffix.lower()
    if options.count is not None:
        if suffix in SUFFIXES:
            raise ConfigurationError(f"--out {options.out}: a sequence (--count) goes into a folder; give its name")
        form = options.format or "png"
        folder = options.out or Path("helmstar-out/frames")
        digits = max(4, len(str(options.count - 1)))
        return [folder / f"frame_{k:0{digits}d}.{_ending(form)}" for k in range(options.count)], form
    if options.out is None:
        form = options.format or "png"
        return [Path(f"frame.{_ending(form)}")], form
    if suffix not in SUFFIXES and options.format is None:
        raise ConfigurationError(f"--out {options.out}: must end in {', '.join(SUFFIXES)}, or --format say what it is")
    return [options.out], options.format or SUFFIXES[suffix]


def _ending(form: str) -> str:
    return {"tiff": "tif"}.get(form, form)


class _Clock:
    """Dates of a sequence: UTC text and Julian date in TT of seconds after its begin."""

    def __init__(self, origin: Any):
        self._origin = origin

    def utc(self, seconds: float) -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that leap seconds of the years to come are not known
            return self._origin.utc([seconds])[0]

    def tt(self, seconds: float) -> float:
        from .dates import julian_date_tt

        return julian_date_tt(self._origin.day, self._origin.second + seconds)


def _clock(text: str) -> _Clock:
    from .dates import instant_of

    return _Clock(instant_of(text).earliest())


class _Sky:
    """Stars to a magnitude where an observer on Earth sees them, computed again when a day has passed."""

    def __init__(self, options: RenderOptions):
        from ..stars.catalog import load_catalog, load_gaia

        load, deepest = (load_gaia, 10.0) if options.catalog == "gaia" else (load_catalog, 9.0)
        limit = deepest if options.limit_magnitude is None else options.limit_magnitude
        try:
            self.catalog = load(limit)
        except ValueError as error:
            raise ConfigurationError(f"--limit-magnitude {limit:g}: {error}") from None
        self._date: float | None = None
        self._directions: np.ndarray | None = None

    def at(self, date_tt: float | None) -> tuple[Any, np.ndarray]:
        """The catalogue, and directions (n, 3) at a Julian date in TT; None: J2000, seen from the barycentre at rest."""
        from ..sensors.observer import observer, observer_place
        from ..stars.patterns import aberrated

        stale = self._directions is None or (date_tt is not None and abs(date_tt - (self._date or 0.0)) > 1.0 / 24.0)
        if stale and date_tt is None:
            self._directions = self.catalog.directions()
        elif stale and date_tt is not None:
            year, velocity = observer(date_tt)
            self._directions = aberrated(self.catalog.directions(year, observer_place(date_tt)), velocity)
            self._date = date_tt
        assert self._directions is not None
        return self.catalog, self._directions


def _frame(
    name: Path, form: str, camera: Camera, q: np.ndarray, stars: tuple[Any, np.ndarray], exposure: Any, seed: int,
    time: float, clock: _Clock | None,
) -> dict[str, Any]:  # fmt: skip
    """Render and write one frame; its truth."""
    from scipy.spatial.transform import Rotation

    from ..imaging.render import render
    from ..io.image_files import write_image
    from ..sensors.star_tracker import centre_angles

    catalog, directions = stars
    image, truth = render(camera, q, directions, catalog.magnitude, exposure, seed)
    taken, begun = (None, None) if clock is None else (clock.utc(time), clock.utc(time - 0.5 * exposure.duration))
    write_image(
        name, image.array, form, begun=begun, taken=taken, exposure_s=exposure.duration,
        header={"SATURATE": float(math.floor(image.saturation))},
    )  # fmt: skip
    ra, dec, roll = centre_angles(camera, Rotation.from_quat(q).as_matrix())
    columns = zip(truth.index, truth.x_px, truth.y_px, truth.electrons, strict=True)
    return {
        "file": readable(str(name)),
        "file_name": readable(name.name),
        "time_s": time,
        "time_utc": taken,
        "q_sn": [float(v) for v in q],
        "ra_deg": ra,
        "dec_deg": dec,
        "roll_deg": roll,
        "stars": [
            {
                "hip": int(catalog.hip[i]),
                "magnitude": round(float(catalog.magnitude[i]), 3),
                "x_px": round(float(x), 4),
                "y_px": round(float(y), 4),
                "electrons": round(float(e), 1),
            }
            for i, x, y, e in columns
        ],
    }


def print_rendered(result: dict[str, Any], most: int = 10) -> None:
    """One line for each of the first frames, and where the rest and the truth are."""
    frames: Sequence[dict[str, Any]] = result["frames"]
    for f in frames[:most]:
        print(
            f"{f['file']}: RA {f['ra_deg']:.5f} Dec {f['dec_deg']:+.5f} roll {f['roll_deg']:.4f} deg, "
            f"{len(f['stars'])} stars"
        )
    if len(frames) > most:
        print(f"and {len(frames) - most} more, with their times in {result['table']}")
    if "truth" in result:
        print(f"truth: {result['truth']}")


__all__ = ["RenderOptions", "print_rendered", "run_render"]
