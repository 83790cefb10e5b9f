"""Lists that show no sky, or not the one they are taken for: how many are called solved. See identification.py --false."""

from __future__ import annotations

import json
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

import numpy as np

from helmstar.progress import Progress
from helmstar.stars import Pinhole, default_sky, identify, identify_uncalibrated
from helmstar.stars.synthetic import scene

CLASSES = ("even", "clumps", "line", "grid", "mirrored", "wrong scale", "wrong aspect")
SIDE = 1024.0


def listing(kind: str, rng: np.random.Generator) -> tuple[Pinhole, np.ndarray, np.ndarray, np.ndarray]:
    """Camera, positions (n, 2), magnitudes (n,) and stars (n,), -1 for none, of 5 to 400 detections."""
    fov = float(np.radians(np.exp(rng.uniform(np.log(5.0), np.log(25.0)))))
    camera = Pinhole.of_field(fov, (int(SIDE), int(SIDE)))
    n = round(float(np.exp(rng.uniform(np.log(5.0), np.log(400.0)))))
    magnitude = 6.5 - rng.exponential(0.9, n)
    if kind == "even":
        xy = rng.uniform(0.0, SIDE, (n, 2))
    elif kind == "clumps":
        centres = rng.uniform(0.0, SIDE, (max(2, n // 12), 2))
        xy = rng.choice(centres, n) + rng.normal(scale=rng.uniform(5.0, 60.0), size=(n, 2))
    elif kind == "line":
        a, b = rng.uniform(0.0, SIDE, (2, 2))
        xy = a + rng.uniform(size=(n, 1)) * (b - a) + rng.normal(scale=rng.uniform(0.5, 5.0), size=(n, 2))
    elif kind == "grid":
        m = max(3, round(np.sqrt(n)))
        g = (np.arange(m) + 0.5) * SIDE / m
        xy = np.stack([a.ravel() for a in np.meshgrid(g, g)], axis=1) + rng.normal(scale=0.3, size=(m * m, 2))
        magnitude = 6.5 - rng.exponential(0.9, len(xy))
    else:
        return sky_of_another_camera(kind, rng, camera, fov, n)
    return camera, xy, magnitude, np.full(len(xy), -1)


def sky_of_another_camera(kind: str, rng: np.random.Generator, camera: Pinhole, fov: float, n: int):
    """A true sky, mirrored or with a scale or aspect that is neither stated nor within what is searched."""
    factor = float(rng.choice([0.6, 0.75, 1.35, 1.7])) if kind == "wrong scale" else 1.0
    aspect = float(rng.choice([0.7, 0.85, 1.2, 1.5])) if kind == "wrong aspect" else 1.0
    true = Pinhole.of_field(fov * factor, (int(SIDE), round(SIDE / aspect)), aspect)
    s = scene(default_sky(), true, rng, stars=min(n, 100), false=n // 10, noise_px=0.3)
    xy = s.xy_px.copy()
    if kind == "mirrored":
        xy[:, 0] = SIDE - xy[:, 0]
    if kind == "wrong aspect":
        camera = Pinhole.of_field(fov, (int(SIDE), round(SIDE / aspect)))
    return camera, xy, s.magnitude, np.full(len(xy), -1) if kind == "mirrored" else s.star


def one(k: int, seed: int) -> dict:
    """The k-th list: class, whether a range was searched, magnitudes used, whether it was called solved, log odds, seconds."""
    rng = np.random.default_rng([seed, k])
    kind = CLASSES[k % len(CLASSES)]
    camera, xy, magnitude, star = listing(kind, rng)
    ranged, bright, sigma = rng.uniform() < 0.25, rng.uniform() < 0.67, float(rng.choice([0.3, 1.0, 2.0]))
    # A range would hold the true scale; those lists are searched at the stated field only.
    ranged &= kind != "wrong scale"
    flux = 10.0 ** (-0.4 * magnitude) if bright else None
    begin = time.process_time()
    fov_range = (float(np.radians(5.0)), float(np.radians(25.0))) if ranged else None
    # A quarter as `StarTracker` does it for a camera that nobody calibrated, with all that it doubts.
    if rng.uniform() < 0.25:
        found = identify_uncalibrated(xy, camera, flux=flux, sigma_px=sigma, fov_range=fov_range).identification
    else:
        found = identify(xy, camera, flux=flux, sigma_px=sigma, fov_range=fov_range)
    seconds = time.process_time() - begin
    # In a sky of a wrong aspect a few stars may be right all the same.
    wrong = bool(found.solved and (star[found.detections] == found.stars).mean() < 0.5)
    return {
        "k": k, "class": kind, "range": bool(ranged), "magnitudes": bool(bright), "n": len(xy), "false": wrong,
        "right": found.solved and not wrong, "log_odds": float(found.log_odds), "work": found.work, "s": seconds,
    }  # fmt: skip


def one_known(k: int, seed: int) -> dict:
    """As `one`, with a known zero point and field: the odds that the limit for these cameras is to be drawn from.

    They are those of the best fit against all else, other fits too."""
    rng = np.random.default_rng([seed, k, 1])
    kind = CLASSES[k % len(CLASSES)]
    camera, xy, magnitude, star = listing(kind, rng)
    begin = time.process_time()
    found = identify(
        xy, camera, magnitude=magnitude, zero_point=0.0, focal_sigma=1e-4, limit=0.5,
        sigma_px=float(rng.choice([0.2, 0.5, 1.0])), magnitude_sigma=float(rng.choice([0.05, 0.1, 0.2, 0.4])),
    )  # fmt: skip
    seconds = time.process_time() - begin
    p = found.probability_false
    odds = float(np.log1p(-p) - np.log(p)) if p < 1.0 else -np.inf
    wrong = bool(found.solved and (star[found.detections] == found.stars).mean() < 0.5)
    return {
        "k": k, "class": kind, "range": False, "magnitudes": True, "n": len(xy), "false": wrong,
        "right": found.solved and not wrong, "log_odds": odds, "work": found.work, "s": seconds, "known": True,
    }  # fmt: skip


def run(count: int, seed: int, log: Path | None, workers: int = 1, known: bool = False) -> dict:
    """`count` lists, by so many processes; `log`: JSON lines to which each result goes, and which a later run continues."""
    rows: list[dict] = []
    if log is not None and log.exists():
        rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines() if line.endswith("}")]
        rows = [row for row in rows if row["k"] < count]
        if any(row.get("known", False) != known for row in rows):
            raise SystemExit(
                f"error: {log} is of lists {'without' if known else 'with'} a known zero point; give another file"
            )
    done = {row["k"] for row in rows}
    left = [k for k in range(count) if k not in done]
    with Progress(True) as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add("lists without a sky", len(left))
        look = one_known if known else one
        for row in pool.map(look, left, repeat(seed), chunksize=4) if workers > 1 else map(look, left, repeat(seed)):
            rows.append(row)
            if log is not None:
                with log.open("a", encoding="utf-8") as f:
                    f.write(json.dumps(row) + "\n")
            progress.advance(task)
    return summary(rows)


def summary(rows: list[dict]) -> dict:
    """Counts, Clopper and Pearson's upper 95% bound of the rate, and per class the largest odds and the quantiles of time."""
    from scipy.stats import beta

    false, n = sum(row["false"] for row in rows), len(rows)
    classes = {}
    for kind in CLASSES:
        for ranged in (False, True):
            some = [row for row in rows if row["class"] == kind and row["range"] == ranged]
            if some:
                s = [row["s"] for row in some]
                classes[kind + (", range" if ranged else "")] = {
                    "lists": len(some),
                    "false": sum(row["false"] for row in some),
                    "right": sum(row["right"] for row in some),
                    "largest_log_odds": max(row["log_odds"] for row in some if not row["right"]),
                    "s_50": float(np.median(s)),
                    "s_95": float(np.percentile(s, 95)),
                    "s_max": max(s),
                }
    return {
        "lists": n,
        "false": false,
        "rate_upper_95": float(beta.ppf(0.95, false + 1, n - false)),
        "over": {
            f"{x:g}": sum(row["log_odds"] > x and not row["right"] for row in rows) for x in (0, 1, 2, 3, 4, 5, 6, 7)
        },
        "classes": classes,
    }
