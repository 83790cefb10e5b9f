"""Identification of stars in full-sky mode: rates, false solutions and milliseconds, on made-up centroid lists.

python benchmarks/identification.py [--runs N] [--fields 12 20] [--random N] [--full] [--kelvins FOLDER] [--json]

Every case has 30 true stars, the brightest of the field, on 1024 x 1024 pixels unless it says otherwise. `right` is the share
solved with an error below 0.2 deg, `false` counts solutions further off. --full: 500 runs, seven fields, 30 000 random lists.
--kelvins: a folder with input.csv and result.csv of the European Kelvins contest, scored by its rule.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from problem import table
from scipy.spatial.transform import Rotation

from helmstar.stars import Pinhole, default_sky, identify
from helmstar.stars.synthetic import random_scene, scene

SIZE = (1024, 1024)
CASES: dict[str, dict] = {
    "plain, 0.3 px": {},
    "noise 1 px": {"noise_px": 1.0},
    "noise 2 px": {"noise_px": 2.0},
    "20 false": {"false": 20},
    "50 false": {"false": 50},
    "100 false": {"false": 100},
    "60% dropped": {"dropped": 0.6},
    "2 px, 50 false, 30% dropped": {"noise_px": 2.0, "false": 50, "dropped": 0.3},
}
WITHOUT_MAGNITUDES = ("plain, 0.3 px", "noise 2 px", "50 false", "60% dropped")


def monte_carlo(fov_deg: float, runs: int, seed: int, magnitudes: bool, fov_range=None, **kinds) -> dict[str, float]:
    """Share solved right, count solved wrong, and milliseconds, of `runs` scenes."""
    camera = Pinhole.of_field(np.radians(fov_deg), SIZE)
    sigma = max(kinds.get("noise_px", 0.3), 0.3)
    right, wrong, ms = 0, 0, []
    for k in range(runs):
        s = scene(default_sky(), camera, np.random.default_rng([seed, k]), **kinds)
        begin = time.perf_counter()
        found = identify(s.xy_px, camera, flux=s.flux if magnitudes else None, sigma_px=sigma, fov_range=fov_range)
        ms.append(1e3 * (time.perf_counter() - begin))
        if found.solved:
            off = (Rotation.from_matrix(s.R_SN) * Rotation.from_quat(found.q_SN).inv()).magnitude()
            good = off < np.radians(0.2)
            right, wrong = right + good, wrong + (not good)
    return {
        "right": right / runs,
        "false": wrong,
        "ms_median": float(np.median(ms)),
        "ms_95": float(np.percentile(ms, 95)),
        "ms_max": max(ms),
    }


def random_fields(fov_deg: float, runs: int, seed: int, work: int) -> dict[str, float]:
    """How many lists of 5 to 400 false detections are called solved, half of them in clumps, a third without magnitudes."""
    camera = Pinhole.of_field(np.radians(fov_deg), SIZE)
    solved, best, ms = 0, -np.inf, []
    for k in range(runs):
        rng = np.random.default_rng([seed, k])
        s = random_scene(camera, rng, int(np.exp(rng.uniform(np.log(5), np.log(400)))))
        xy = s.xy_px
        if k % 2:
            xy = rng.choice(xy[: max(3, len(xy) // 8)], len(xy)) + rng.normal(scale=25.0, size=xy.shape)
        begin = time.perf_counter()
        found = identify(
            xy, camera, flux=s.flux if k % 3 else None, sigma_px=float(rng.choice([0.3, 1.0, 2.0])), work=work
        )
        ms.append(1e3 * (time.perf_counter() - begin))
        solved += found.solved
        best = max(best, found.log_odds)
    return {
        "runs": runs,
        "false": solved,
        "largest_log_odds": best,
        "ms_median": float(np.median(ms)),
        "ms_max": max(ms),
    }


def kelvins(folder: Path, limit: float = 0.05) -> dict[str, float]:
    """The contest's score of 100 scenes: y upwards, magnitudes calibrated. An answer is given where it is 95% sure."""
    pixel = np.radians(18.75 / 3600.0)
    camera = Pinhole(1.0 / float(np.tan(pixel)), (960.0, 720.0), (1920, 1440))
    scenes = [np.array(line.split(","), dtype=float).reshape(-1, 3) for line in _lines(folder / "input.csv")]
    truths = [np.array(line.split(","), dtype=int) for line in _lines(folder / "result.csv")]
    score, wrong, solved, ms = 0.0, 0, 0, []
    for s, truth in zip(scenes, truths):
        xy = np.stack([s[:, 0], 1440.0 - s[:, 1]], axis=1)
        begin = time.perf_counter()
        found = identify(
            xy, camera, magnitude=s[:, 2], sigma_px=0.25, magnitude_sigma=0.05, zero_point=0.02, limit=limit
        )
        ms.append(1e3 * (time.perf_counter() - begin))
        answer = np.full(len(truth), -1)
        answer[found.detections] = found.hip
        true, answered = truth >= 0, answer >= 0
        bad = int((answered & (answer != truth)).sum())
        score += max((int((answered & (answer == truth)).sum()) - 2 * bad) / max(int(true.sum()), 1), -1.0)
        wrong, solved = wrong + (bad > 0), solved + found.solved
    return {"score": score, "solved": solved, "with_wrong": wrong, "ms_median": float(np.median(ms)), "ms_max": max(ms)}


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="ascii").split()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int)
    parser.add_argument("--fields", type=float, nargs="+")
    parser.add_argument("--random", type=int)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--kelvins", type=Path)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    runs = args.runs if args.runs is not None else 500 if args.full else 40
    fields = args.fields or ([4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 27.0] if args.full else [12.0, 20.0])
    lists = args.random if args.random is not None else 30_000 if args.full else 60
    rows: dict[str, dict[str, float]] = {}
    for fov in fields:
        monte_carlo(fov, 2, 0, True)  # builds or loads the tables
        for name, kinds in CASES.items():
            rows[f"{fov:g} deg, {name}"] = monte_carlo(fov, runs, 1, True, **kinds)
        for name in WITHOUT_MAGNITUDES:
            rows[f"{fov:g} deg, {name}, no magnitudes"] = monte_carlo(fov, runs, 2, False, **CASES[name])
    whole = (np.radians(5.0), np.radians(25.0))
    for fov in (f for f in fields if 5.0 < f < 25.0):
        rows[f"{fov:g} deg, sought in 5..25"] = monte_carlo(fov, max(runs // 4, 1), 3, True, fov_range=whole)
    out: dict = {"cases": rows}
    if lists:
        out["random"] = random_fields(12.0, lists, 4, work=300_000)
    if args.kelvins:
        out["kelvins"] = kelvins(args.kelvins)
    if args.json:
        print(json.dumps(out))
        return
    print(
        table(
            ["", "right", "false", "ms", "ms 95%", "ms max"],
            [
                [n, f"{r['right']:.3f}", str(r["false"]), *(f"{r[k]:.1f}" for k in ("ms_median", "ms_95", "ms_max"))]
                for n, r in rows.items()
            ],
        )
    )
    for name in ("random", "kelvins"):
        if name in out:
            print(name, ", ".join(f"{k} {v:.6g}" for k, v in out[name].items()))


if __name__ == "__main__":
    main()
