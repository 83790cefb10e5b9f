"""The camera of li2007 from pixels: every frame of the body is rendered, and its light is measured by the paper's chain.

A frame shows the body where the pixel level would have it, jitter of the pointing included; the image adds its own noise. The
window around the body is rendered (what lies beyond is dark sky), thresholded at P_min and centroided (1)(2). What lies between
the centre of light and the centre of figure (3) is computed for the radius and the law that the filters are *told*, and handed on
as a length: filters divide it by their own distance, and may doubt it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..progress import Progress
from .kept import kept, side_by_side

BLOCK = 60


@dataclass(frozen=True)
class Lights:
    """Of all runs and frames: z (runs, steps, 2) centre of light, px; cov (.., 2, 2) of its noise, px^2; offset (.., 2) from the
    centre of figure to it, px times m of distance, for the radius and law that are assumed; phase (..,) rad; seen (..,) bool."""

    z: np.ndarray
    cov: np.ndarray
    offset: np.ndarray
    phase: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class _Task:
    """Frames of one run. body, camera: tables of the specification. z (n, 2): where the centre is seen; distance (n,) m; sun_C
    (n, 3): true, and as the attitude reference has it."""

    body: dict[str, Any]
    camera: dict[str, Any]
    seed: int
    run: int
    first: int
    z: np.ndarray
    distance: np.ndarray
    sun_C: np.ndarray
    sun_known_C: np.ndarray


def take_frames(
    spec: Any, z: np.ndarray, distance: np.ndarray, sun_C: np.ndarray, sun_known_C: np.ndarray, workers: int = 1
) -> Lights:
    """Lights of all runs. z (runs, steps, 2) px, distance (runs, steps) m, sun_C and sun_known_C (runs, steps, 3): from body to
    Sun in C, truly and by the attitude reference."""
    facts = [spec.body.model_dump(), spec.camera.model_dump(), spec.seed, BLOCK]
    arrays = (z, distance, sun_C, sun_known_C)
    made = kept(facts, arrays, ("imaging", "scenarios"), lambda: _take(spec, *arrays, workers))
    return Lights(**made)


def _take(
    spec: Any, z: np.ndarray, distance: np.ndarray, sun_C: np.ndarray, sun_known_C: np.ndarray, workers: int
) -> dict[str, np.ndarray]:
    runs, steps = distance.shape
    body, camera = spec.body.model_dump(), spec.camera.model_dump()
    tasks = [
        _Task(body, camera, spec.seed, run, a, *(x[run, a : a + BLOCK] for x in (z, distance, sun_C, sun_known_C)))
        for run in range(runs)
        for a in range(0, steps, BLOCK)
    ]
    out = {
        "z": np.zeros((runs, steps, 2)), "cov": np.zeros((runs, steps, 2, 2)), "offset": np.zeros((runs, steps, 2)),
        "phase": np.zeros((runs, steps)), "seen": np.zeros((runs, steps), dtype=bool),
    }  # fmt: skip
    with Progress(True) as bar:
        job = bar.add(f"{runs * steps} frames", len(tasks))
        for task, found in zip(tasks, side_by_side(measure_block, tasks, workers, runs * steps), strict=True):
            part = (task.run, slice(task.first, task.first + len(task.z)))
            for name, values in found.items():
                out[name][part] = values
            bar.advance(job)
    return out


def measure_block(task: _Task) -> dict[str, np.ndarray]:
    """Lights of a block of frames."""
    from ..imaging import Camera
    from ..imaging.body import Detector, law_of, render_window, sphere, windowed_centroid
    from ..imaging.body.moment import offsets
    from ..imaging.body.target import FOUND, Pose, Target
    from ..imaging.render import Exposure

    c, b = task.camera, task.body
    size, focal = c["size_px"], c["focal_mm"] * c["px_per_mm"]
    camera = Camera(size, size, focal, (0.5 * size, 0.5 * size))
    exposure = Exposure()
    detector = Detector(gain_e=exposure.gain_e, psf_sigma_px=exposure.psf_sigma_px)
    radius = b["radius_km"] * 1e3
    shape, law = sphere(radius), law_of(b["law"])
    told = Target(sphere(radius * (1.0 + b["radius_error"])), law_of(b["assumed_law"]), law_known=True)
    n = len(task.z)
    out = {
        "z": np.zeros((n, 2)), "cov": np.zeros((n, 2, 2)), "offset": np.zeros((n, 2)), "phase": np.zeros(n),
        "seen": np.zeros(n, dtype=bool),
    }  # fmt: skip
    for k in range(n):
        if not np.all(np.abs(task.z[k] - 0.5 * size) < 0.5 * size):
            continue
        r = task.distance[k] * camera.directions(task.z[k])
        rng = np.random.default_rng([task.seed, task.run, task.first + k])
        image, truth = render_window(camera, shape, r, task.sun_C[k], law=law, exposure=exposure, seed=rng)
        light = windowed_centroid(image, detector, corner=truth.window[:2])
        if light.status != FOUND:
            continue
        pose = Pose(float(task.distance[k]), task.sun_known_C[k])
        # The offset is a length over a distance: computed for this one, and scaled by each filter to its own.
        offset, _ = offsets(camera, told, pose, light.xy_px)
        if not np.isfinite(offset).all():
            continue
        out["z"][k], out["cov"][k] = light.xy_px, light.covariance_px
        out["offset"][k] = offset * task.distance[k]
        out["phase"][k], out["seen"][k] = pose.phase(camera, light.xy_px), True
    return out


__all__ = ["Lights", "take_frames"]
