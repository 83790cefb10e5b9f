"""The star sensor of xu2020 from pixels: every measurement is a frame that is rendered, detected, identified and solved.

Two heads, each mounted so that its boresight looks along one of the two star directions at the start. At each update both take a
frame at the true attitude; a head's solved attitude says where its star direction lies in the body, l_i = R_BN,i r_i, and its
covariance how well: C_i = [l_i x] P_i [l_i x]^T. A head's roll about its boresight, known ten times less well, drops out of that
nearly, so these are the paper's two measured directions with their noise from pixels instead of from a random generator.

NumPy only, outside compiled programs: frames are solved first, blocks of them side by side in processes, and kept in the user's
cache folder under a hash of all that they depend on. A block of BLOCK frames begins lost in space and tracks from then on, so
that the numbers do not depend on how the work is shared out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import DataError
from ..imaging import Camera, DetectionSettings
from ..progress import Progress
from .kept import kept, side_by_side
from .xu2020_specification import StarImage

BLOCK = 40
SOURCES = ("imaging", "stars", "sensors", "attitude", "scenarios")
"""Rooms whose code the frames depend on."""


@dataclass(frozen=True)
class Frames:
    """What the frames of all runs say, time from 0: z (runs, steps + 1, 2, 3) directions in B, cov (.., 2, 3, 3) rad^2, seen
    (.., 2) bool. Where a frame is not solved z and cov are zero."""

    z: np.ndarray
    cov: np.ndarray
    seen: np.ndarray

    @property
    def sigma(self) -> float:
        """RMS of the directions' sigma across themselves, rad."""
        variance = 0.5 * np.trace(self.cov, axis1=-2, axis2=-1)
        return float(np.sqrt(variance[self.seen].mean())) if self.seen.any() else float("nan")


@dataclass(frozen=True)
class _Task:
    """Frames first .. first + len(q) - 1 of one head in one run. q (n, 4): true q_BN; omega (n, 3): true rate in B; r_N (3,);
    R_SB (3, 3)."""

    image: dict[str, Any]
    seed: int
    run: int
    head: int
    first: int
    q: np.ndarray
    omega: np.ndarray
    r_N: np.ndarray
    R_SB: np.ndarray
    step_s: float


def take_frames(
    image: StarImage, seed: int, runs: int, step_s: float, q: np.ndarray, r_N: np.ndarray, workers: int = 1
) -> Frames:
    """Frames of all runs at the true attitudes q (steps + 1, 4), step_s apart; r_N (2, 3).

    workers: processes (more than one needs a script with the usual guard of `__main__`). Raises DataError where a run's first frame
    shows nothing, from which no filter can start.
    """
    facts = [image.model_dump(), seed, runs, step_s, BLOCK]
    made = kept(facts, (q, r_N), SOURCES, lambda: vars(_take(image, seed, runs, step_s, q, r_N, workers)))
    frames = Frames(**made)
    lost = np.argwhere(~frames.seen[:, 0])
    if len(lost):
        run, head = lost[0]
        raise DataError(
            f"star.level = image: run {run}, head {head + 1}: the first frame is not solved; give star.image a longer "
            "exposure_s, a wider fov_deg or more pixels"
        )
    return frames


def _take(
    image: StarImage, seed: int, runs: int, step_s: float, q: np.ndarray, r_N: np.ndarray, workers: int
) -> Frames:
    steps = len(q)
    omega = _rates(q, step_s)
    # Each head looks along its star direction at the start.
    mountings = [_looking_along(_matrix(q[0]) @ r) for r in r_N]
    tasks = [
        _Task(
            image.model_dump(),
            seed,
            run,
            head,
            a,
            q[a : a + BLOCK],
            omega[a : a + BLOCK],
            np.asarray(r_N[head]),
            mountings[head],
            step_s,
        )
        for run in range(runs)
        for head in range(2)
        for a in range(0, steps, BLOCK)
    ]
    z, cov = np.zeros((runs, steps, 2, 3)), np.zeros((runs, steps, 2, 3, 3))
    seen = np.zeros((runs, steps, 2), dtype=bool)
    count = 2 * runs * steps
    with Progress(True) as bar:
        job = bar.add(f"{count} frames", len(tasks))
        results = side_by_side(solve_block, tasks, workers, count)
        for task, (a, b, c) in zip(tasks, results, strict=True):
            part = (task.run, slice(task.first, task.first + len(a)), task.head)
            z[part], cov[part], seen[part] = a, b, c
            bar.advance(job)
    return Frames(z, cov, seen)


def solve_block(task: _Task) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (n, 3), covariances (n, 3, 3) and whether solved (n,) of a block of frames."""
    from scipy.spatial.transform import Rotation

    from ..imaging.render import Exposure, render

    image = StarImage.model_validate(task.image)
    tracker, directions, magnitude = _head(json.dumps(task.image))
    tracker.memory = None  # of another block
    n = len(task.q)
    z, cov, seen = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n, dtype=bool)
    reach = np.cos(_half_diagonal(tracker.camera))
    fastest = float(np.max(np.linalg.norm(task.omega, axis=1)))
    prior, sigma = None, None
    for k in range(n):
        R_BN = _matrix(task.q[k])
        R_SN = task.R_SB @ R_BN
        near = np.flatnonzero(directions @ R_SN[2] > reach)
        x, y, w = map(float, task.R_SB @ task.omega[k])
        exposure = Exposure(
            duration=image.exposure_s, zero_point_e_s=image.zero_point_e_s, psf_sigma_px=image.psf_sigma_px,
            omega_SN_S=(x, y, w), hot_fraction=image.hot_pixels / image.pixels**2, gain_e=8.0, offset=8.0, bits=8,
        )  # fmt: skip
        stream = np.random.SeedSequence([task.seed, task.run, task.first + k, task.head])
        noise = int(stream.generate_state(1, np.uint64)[0])
        q_SN = Rotation.from_matrix(R_SN).as_quat()
        picture, _ = render(tracker.camera, q_SN, directions[near], magnitude[near], exposure, noise)
        found = tracker.solve(picture, prior_q_SN=prior, prior_sigma=sigma)
        if not found.solved:
            continue
        q, P = found.identification.q_SN, found.identification.covariance
        direction = task.R_SB.T @ _matrix(q) @ task.r_N
        turn = _cross(direction) @ task.R_SB.T
        z[k], cov[k], seen[k] = direction, turn @ P @ turn.T, True
        # Where the next frame looks: here, as well as this one knows and as far as the body may turn.
        prior, sigma = q, min(1.0, 3.0 * float(np.sqrt(np.trace(P))) + fastest * task.step_s)
    return z, cov, seen


@lru_cache(maxsize=4)
def _head(image: str) -> tuple[Any, np.ndarray, np.ndarray]:
    """Star tracker, directions (n, 3) and magnitudes (n,) of the stars that are rendered."""
    from ..sensors.star_tracker import StarTracker
    from ..stars.catalog import load_catalog

    spec = StarImage.model_validate_json(image)
    camera = Camera.from_fov(spec.fov_deg, spec.pixels, spec.pixels)
    catalog = load_catalog(spec.limit_magnitude)
    # What is rendered is a Gaussian to the last digit: nothing but noise makes its centroids wrong.
    tracker = StarTracker(camera, julian_year=2000.0, detection=DetectionSettings(optics_px=0.0))
    return tracker, catalog.directions(), catalog.magnitude


def _rates(q: np.ndarray, step_s: float) -> np.ndarray:
    """Rates (n, 3) rad/s in B at each of the attitudes (n, 4): R(k + 1) = exp(-[omega step x]) R(k)."""
    from scipy.spatial.transform import Rotation

    if len(q) < 2:
        return np.zeros((len(q), 3))
    between = -(Rotation.from_quat(q[1:]) * Rotation.from_quat(q[:-1]).inv()).as_rotvec() / step_s
    return np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])


def _half_diagonal(camera: Camera) -> float:
    """Angle (rad) from the boresight beyond which no star shines into the image."""
    corner = np.hypot(camera.width, camera.height) / 2.0 + 30.0
    return float(np.arctan(corner / camera.focal_px))


def _matrix(q: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q).as_matrix()


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _looking_along(b: np.ndarray) -> np.ndarray:
    """R_SB (3, 3) whose z axis of S is along b (3,) in B."""
    x = np.cross(b, np.eye(3)[int(np.argmin(np.abs(b)))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(b, x), b])


__all__ = ["Frames", "take_frames"]
