"""`helmstar calibrate`: one camera from many images of stars, solved without a prior, with what it is uncertain of."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..files import readable
from ..imaging import DetectionSettings, dark_of, detect
from ..imaging.calibrated import NUMBERS, write_calibrated, write_dark
from ..progress import Progress
from ..sensors.star_tracker import StarTracker
from ..stars.identify import matrix_of_quaternion
from .calibration import Fitted, Frame, fit_camera
from .command import REASON, SolveOptions, check_plot, tracker_of

_STARS = 250
_DARK_FRAMES, _DARK_PIXELS = 25, 400_000_000
_STILL_PX = 8.0


@dataclass(frozen=True)
class CalibrateOptions:
    """solve: how the images are solved first. aspect: pixel height over width to start from, fitted too; None keeps the start's.
    out: cam.toml. dark: whether to estimate the pixels that always shine. plot: folder for residuals.png."""

    solve: SolveOptions
    aspect: float | None = None
    out: Path = Path("cam.toml")
    dark: bool = False
    plot: Path | None = None


def run_calibrate(files: Sequence[Path], options: CalibrateOptions) -> dict[str, Any]:
    """The object of `--json`, with cam.toml (and the dark beside it) written.

    Raises HelmstarError for options that mean nothing and for stars that do not suffice.
    """
    check_plot(options.plot)
    tracker = tracker_of(replace(options.solve, aspect=1.0 if options.aspect is None else options.aspect))
    frames: list[Frame] = []
    with Progress(len(files) > 1) as bar:
        task = bar.add("solve", len(files))
        for file in files:
            frames.append(_solved(tracker, file))
            bar.advance(task)
    used = _of_one_size(frames)
    dark = None
    if options.dark:
        dark = _dark(used)
        with Progress(len(used) > 1) as bar:
            task = bar.add("solve without dark", len(used))
            for frame in used:
                again = _solved(tracker, frame.file, dark)
                if again.solved or not frame.solved:
                    vars(frame).update(vars(again))
                bar.advance(task)
    fitted = fit_camera(tracker, used, options.aspect is not None)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    dark_file = None
    if dark is not None:
        dark_file = options.out.with_suffix(".dark.npz")
        write_dark(dark_file, dark)
    result = _result(frames, fitted)
    result["dark"] = None if dark_file is None else readable(str(dark_file))
    result["dark_pixels"] = None if dark is None else int(np.count_nonzero(dark))
    result |= {"out": readable(str(options.out)), "replaced": options.out.exists(), "plot": None}
    write_calibrated(options.out, fitted.calibration.camera, _lines(result, dark_file))
    if options.plot is not None:
        from .plot import draw_residuals

        camera = fitted.calibration.camera
        vectors = [(np.concatenate(fitted.stars), np.concatenate(r)) for r in (fitted.before, fitted.after)]
        path = draw_residuals(options.plot / "residuals.png", (camera.width, camera.height), *vectors)
        result["plot"] = readable(str(path))
    return result


def _solved(tracker: StarTracker, file: Path, dark: np.ndarray | None = None) -> Frame:
    """Read, detect deeply, and identify one image."""
    from ..io.images import read_image

    try:
        image = read_image(file)
        centroids = detect(image, DetectionSettings(max_stars=_STARS), dark if dark is not None else _dark_of(tracker))
        found = tracker.identified(centroids, image.width, image.height)
    except DataError as error:
        return Frame(file, "unreadable", str(error))
    except ValueError as error:
        return Frame(file, "wrong size", str(error))
    return Frame(file, found.status, REASON[found.status], (image.width, image.height), centroids, found)


def _dark_of(tracker: StarTracker) -> np.ndarray | None:
    return None if tracker.known is None else tracker.known.dark


def _of_one_size(frames: list[Frame]) -> list[Frame]:
    """The frames of the size that most solved ones have; the others are marked."""
    sizes = Counter(f.size for f in frames if f.solved)
    if not sizes:
        why = Counter(f.status for f in frames)
        said = ", ".join(f"{n} {status}" for status, n in why.most_common())
        raise DataError(
            f"none of {len(frames)} images was solved ({said}); state the field with --fov, or give sharper images"
        )
    size = sizes.most_common(1)[0][0]
    for f in frames:
        if f.centroids is not None and f.size != size:
            f.status, f.found = "other size", None
            f.message = f"{f.size[0]} x {f.size[1]} pixels, but the camera fitted has {size[0]} x {size[1]}"
    return [f for f in frames if f.centroids is not None and f.size == size]


def _dark(used: list[Frame]) -> np.ndarray:
    """The pixels that shine in the same place on moving skies. Raises DataError where the sky does not move."""
    from ..io.images import read_image

    solved = [f for f in used if f.solved]
    most = max(3, min(_DARK_FRAMES, _DARK_PIXELS // (used[0].size[0] * used[0].size[1])))
    chosen = [solved[k] for k in np.unique(np.linspace(0, len(solved) - 1, min(len(solved), most)).astype(int))]
    if len(chosen) < 3:
        raise DataError(f"--dark: {len(chosen)} solved images; at least 3 on moving skies are needed")
    R = np.array([matrix_of_quaternion(f.found.identification.q_SN) for f in chosen if f.found is not None])
    # Angle between two frames, over that of a few pixels: what stands still in half of the frames would go into the dark.
    focal = chosen[0].found.camera.focal_px  # type: ignore[union-attr]
    trace = np.einsum("aij,bij->ab", R, R)
    still = (np.arccos(np.clip((trace - 1) / 2, -1, 1)) * focal < _STILL_PX).sum(axis=1)
    if 2 * still.max() >= len(chosen):
        raise DataError(
            f"--dark: {still.max()} of {len(chosen)} images look at the same place, so stars and pixels cannot be "
            "told apart; give images of different places"
        )
    return dark_of([read_image(f.file) for f in chosen])


def _result(frames: list[Frame], fitted: Fitted) -> dict[str, Any]:
    """The object of `--json`."""
    c, known = fitted.calibration, fitted.known
    camera, degrees = c.camera, 3600.0 * 180.0 / np.pi
    in_it = {id(f): k for k, f in enumerate(fitted.frames)}
    images = []
    for f in frames:
        entry: dict[str, Any] = {"file": readable(str(f.file)), "status": f.status, "message": f.message}
        k = in_it.get(id(f))
        entry |= {"stars": None, "outliers": None, "rms_before_arcsec": None, "residual_rms_arcsec": None}
        if k is not None:
            kept = c.kept[k]
            entry |= {"status": "used", "message": "", "stars": int(kept.sum()), "outliers": int((~kept).sum())}
            for name, r in (("rms_before_arcsec", fitted.before[k]), ("residual_rms_arcsec", fitted.after[k])):
                entry[name] = _rms(r[kept] * [1.0, camera.aspect]) / camera.focal_px * degrees
        images.append(entry)
    everything = [
        np.concatenate([r[k] for r, k in zip(part, c.kept)]) * [1.0, camera.aspect]
        for part in (fitted.before, fitted.after)
    ]
    return {
        "camera": {
            "width": camera.width, "height": camera.height, "focal_px": camera.focal_px,
            "fov_deg": float(np.degrees(camera.fov)), "centre_px": [camera.cx, camera.cy], "aspect": camera.aspect,
            "distortion": list(camera.distortion),
        },
        "fitted": list(c.names),
        "sigma": {n: c.sigma(n) for n in c.names},
        "focal_sigma_px": known.focal_sigma_px, "centre_sigma_px": known.centre_sigma_px, "k1_sigma": known.k1_sigma,
        "centroid_scale": known.centroid_scale, "centroid_floor_px": known.centroid_floor_px,
        "smooth_px": known.smooth_px,
        "frames": len(fitted.frames), "stars": int(sum(k.sum() for k in c.kept)),
        "outliers": int(sum((~k).sum() for k in c.kept)), "chi2": c.chi2, "degrees": c.degrees,
        "rms_before_arcsec": _rms(everything[0]) / camera.focal_px * degrees,
        "residual_rms_arcsec": _rms(everything[1]) / camera.focal_px * degrees, "residual_rms_px": _rms(everything[1]),
        "images": images,
    }  # fmt: skip


def _rms(residual: np.ndarray) -> float:
    """Of one axis."""
    return float(np.sqrt(np.mean(residual**2)))


def _lines(result: dict[str, Any], dark: Path | None) -> list[str]:
    """Of the table [calibration]."""
    lines = [
        "# 1 sigma of what the calibration leaves open, seen as three numbers; of what centroids promise; and by which the lens",
        "# moves neighbouring stars alike beyond what was fitted:",
    ]
    lines += [f"{key} = {float(result[key])!r}" for key in NUMBERS]
    if dark is not None:
        lines.append(
            f"dark = {json.dumps(readable(dark.name), ensure_ascii=False)}  # what shines in {result['dark_pixels']} pixels"
        )
    sigma = ", ".join(f"{name} {value:.3g}" for name, value in result["sigma"].items())
    return [
        *lines,
        f"# 1 sigma of each parameter fitted, the others free: {sigma}",
        f"# {result['stars']} stars in {result['frames']} frames, {result['outliers']} outliers; residual "
        f"{result['residual_rms_arcsec']:.3g} arcsec = {result['residual_rms_px']:.3g} px rms per axis",
        f"# chi2 {result['chi2']:.1f} for {result['degrees']} degrees of freedom",
    ]


def print_calibrated(result: dict[str, Any]) -> None:
    """A line for each image, then the camera."""
    for e in result["images"]:
        if e["status"] != "used":
            print(f"{e['file']}: {e['status']}: {e['message']}")
            continue
        print(
            f"{e['file']}: {e['stars']} stars, residual {e['rms_before_arcsec']:.3g} -> "
            f"{e['residual_rms_arcsec']:.3g} arcsec, {e['outliers']} outliers"
        )
    c, s = result["camera"], result["sigma"]
    pm = lambda name: f" +- {s[name]:.2g}" if name in s else ""
    print(
        f"focal length {c['focal_px']:.2f}{pm('focal')} px (field {c['fov_deg']:.4f} deg), centre "
        f"{c['centre_px'][0]:.1f}{pm('cx')}, {c['centre_px'][1]:.1f}{pm('cy')} px, aspect {c['aspect']:.5f}{pm('aspect')}"
    )
    names = ("k1", "k2", "p1", "p2", "k3")
    print("distortion " + ", ".join(f"{n} {v:.4g}{pm(n)}" for n, v in zip(names, c["distortion"]) if n in s))
    print(
        f"{result['stars']} stars in {result['frames']} of {len(result['images'])} images, {result['outliers']} outliers, "
        f"residual {result['rms_before_arcsec']:.3g} -> {result['residual_rms_arcsec']:.3g} arcsec, chi2/dof "
        f"{result['chi2'] / result['degrees']:.2f} with sigma {result['centroid_scale']:.2f} times what centroids promise and "
        f"{result['centroid_floor_px']:.3f} px; the lens moves neighbours alike by another {result['smooth_px']:.3f} px"
    )
    if result["dark"]:
        print(f"dark: {result['dark_pixels']} pixels, {result['dark']}")
    print(f"camera: {result['out']}{' (replaced)' if result['replaced'] else ''}")


__all__ = ["CalibrateOptions", "print_calibrated", "run_calibrate"]
