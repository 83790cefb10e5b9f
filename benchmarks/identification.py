"""Identification of stars in full-sky mode: rates, false solutions and milliseconds, on made-up centroid lists.

python benchmarks/identification.py [--runs N] [--fields 12 20] [--full] [--kelvins FOLDER [--magnitude-sigma MAG]] [--json]
python benchmarks/identification.py --false N [--known] [--log FILE] [--workers N] [--json]
python benchmarks/identification.py --sky FOLDER [--runs N] [--json]

Every case has 30 true stars, the brightest of the field, on 1024 x 1024 pixels unless it says otherwise. `right` is the share
solved with most matches true, `false` counts the other solutions. --full: 300 runs, seven fields.
--kelvins: a folder with input.csv and result.csv of the European Kelvins contest, scored by its rule.
It is solved with magnitudes as told, and again with zero point and scatter from its own solutions.
--false: N lists of 5 to 400 false detections, or of skies of another camera, at fields of 5 to 25 deg; how many are called
solved, with the upper 95% bound of the rate. --known: with a known zero point, and up to a limit of 0.5, for the tail of the
odds: `false` is not the rate at the default limit then. --log: continues what an earlier run left there; --workers: processes.
--sky: rates against false stars, noise, missing stars and field over the whole sky; FOLDER gets sky.json and sky.html.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import false_skies
import numpy as np
from problem import table

from helmstar.stars import Photometry, Pinhole, calibrate_photometry, default_sky, identify
from helmstar.stars.identify import LIMIT_KNOWN
from helmstar.stars.synthetic import scene

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
            good = (found.stars == s.star[found.detections]).mean() > 0.5
            right, wrong = right + good, wrong + (not good)
    return {
        "right": right / runs,
        "false": wrong,
        "ms_median": float(np.median(ms)),
        "ms_95": float(np.percentile(ms, 95)),
        "ms_max": max(ms),
    }


def kelvins(folder: Path, limit: float | None, magnitude_sigma: float = 0.05) -> dict[str, dict[str, float]]:
    """The contest's score of 100 scenes, with magnitudes as told or nothing told of them, and with what the scenes solved so
    tell, as one would calibrate a camera on its own frames: no answer is used for that."""
    rows = {}
    for words, zero_point, sigma in (("as told", 0.0, magnitude_sigma), ("not told", None, 0.4)):
        rows[words], camera = kelvins_scored(folder, limit, zero_point, sigma)
        own = f"by its own solutions: {camera.zero_point:.3f}, {camera.magnitude_sigma:.3f}"
        rows[f"{words}, then {own}"], _ = kelvins_scored(folder, limit, camera.zero_point, camera.magnitude_sigma)
    return rows


def kelvins_scored(
    folder: Path, limit: float | None, zero_point: float | None, magnitude_sigma: float
) -> tuple[dict[str, float], Photometry]:
    """Score, and what the solutions tell of the magnitudes: y upwards.

    The field (DEG_X) and the variance of positions (POS_VARIANCE) are those of the contest's own calibration file.
    """
    camera = Pinhole.of_field(float(np.radians(10.0)), (1920, 1440))
    scenes = [np.array(line.split(","), dtype=float).reshape(-1, 3) for line in _lines(folder / "input.csv")]
    truths = [np.array(line.split(","), dtype=int) for line in _lines(folder / "result.csv")]
    score, wrong, ms, answers = 0.0, 0, [], []
    for s, truth in zip(scenes, truths):
        xy = np.stack([s[:, 0], 1440.0 - s[:, 1]], axis=1)
        begin = time.perf_counter()
        found = identify(
            xy,
            camera,
            magnitude=s[:, 2],
            sigma_px=0.22,
            focal_sigma=1e-4,
            magnitude_sigma=magnitude_sigma,
            zero_point=zero_point,
            limit=limit,
        )
        ms.append(1e3 * (time.perf_counter() - begin))
        answers.append(found)
        answer = np.full(len(truth), -1)
        answer[found.detections] = found.hip
        true, answered = truth >= 0, answer >= 0
        bad = int((answered & (answer != truth)).sum())
        score += max((int((answered & (answer == truth)).sum()) - 2 * bad) / max(int(true.sum()), 1), -1.0)
        wrong += bad > 0
    solved = sum(found.solved for found in answers)
    row = {"score": score, "solved": solved, "with_wrong": wrong, "ms_median": float(np.median(ms)), "ms_max": max(ms)}
    return row, calibrate_photometry(answers, [s[:, 2] for s in scenes])


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="ascii").split()


def whole_sky(folder: Path, runs: int) -> dict:
    """Measure, and leave sky.json and sky.html in the folder."""
    import whole_sky as sky

    cells = sky.run(runs, 41)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sky.json").write_text(json.dumps(cells), encoding="utf-8")
    sky.write_report(
        cells, folder / "sky.html", f"python benchmarks/identification.py --sky {folder.name} --runs {runs}"
    )
    return {"scenes": sum(c["runs"] for c in cells), "false": sum(c["false"] for c in cells), "cells": cells}


def lines(found: dict):
    """For people: one line for each thing, tables by line."""
    for key, value in found.items():
        if key == "classes":
            yield from (f"{name}: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items()) for name, row in value.items())
        elif key == "over":
            yield "log odds without a true sky: " + ", ".join(f"{n} over {x}" for x, n in value.items())
        elif key == "cells":
            for c in value:
                yield ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in c.items())
        else:
            yield f"{key} {value:.6g}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int)
    parser.add_argument("--fields", type=float, nargs="+")
    parser.add_argument("--false", type=int, metavar="N")
    parser.add_argument("--known", action="store_true")
    parser.add_argument("--log", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--sky", type=Path, metavar="FOLDER")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--kelvins", type=Path)
    parser.add_argument("--magnitude-sigma", type=float, default=0.05, metavar="MAG")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.false or args.sky:
        found = (
            false_skies.run(args.false, 31, args.log, args.workers, args.known)
            if args.false
            else whole_sky(args.sky, args.runs or 25)
        )
        print(json.dumps(found) if args.json else "\n".join(lines(found)))
        return
    runs = args.runs if args.runs is not None else 300 if args.full else 40
    fields = args.fields or ([4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 27.0] if args.full else [12.0, 20.0])
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
    if args.kelvins:
        for limit in (None, 0.01):
            for magnitudes, row in kelvins(args.kelvins, limit, args.magnitude_sigma).items():
                out[f"kelvins, limit {limit or LIMIT_KNOWN:g}, magnitudes {magnitudes}"] = row
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
    for name in list(out)[1:]:
        print(name, ", ".join(f"{k} {v:.6g}" for k, v in out[name].items()))


if __name__ == "__main__":
    main()
