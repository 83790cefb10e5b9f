"""Errors of real frames against truth, and their honesty: `python benchmarks/real_frames.py FOLDER [--calibrated]`.

FOLDER holds truth.csv with columns file, kind, width, height, hfov_deg, ra_deg, dec_deg, roll_deg (of the geometric image centre),
boresight_sigma_arcsec and pixel_aspect_y_over_x. Every frame is solved with its field to a tenth of a degree; with
--calibrated by a camera calibrated on the frames of its own folder, size and field. The normalised error squared has three
axes (3 is honest); truth's own sigma is in it, about the boresight enlarged by the spread of stars over the field.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from helmstar.startracker.calibrate_command import CalibrateOptions, run_calibrate
from helmstar.startracker.command import SolveOptions, run_solve

ARCSEC = 180.0 * 3600.0 / np.pi


def attitude(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """R_SN (3, 3) with z at the direction and north `roll` counter-clockwise from image up."""
    a, d, roll = np.radians([ra_deg, dec_deg, roll_deg])
    z = np.array([np.cos(a) * np.cos(d), np.sin(a) * np.cos(d), np.sin(d)])
    north = np.array([-np.cos(a) * np.sin(d), -np.sin(a) * np.sin(d), np.cos(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.cos(roll) * north - np.sin(roll) * east
    left = np.sin(roll) * north + np.cos(roll) * east
    return np.stack([-left, -up, z])


def judged(row: dict[str, str], entry: dict) -> tuple[float, float, float]:
    """Error across the boresight and about it, arcsec, and the normalised error squared."""
    keys = ("ra_deg", "dec_deg", "roll_deg")
    E = attitude(*(entry[k] for k in keys)) @ attitude(*(float(row[k]) for k in keys)).T
    e = np.array([E[2, 1], E[0, 2], E[1, 0]]) * ARCSEC
    sigma = float(row["boresight_sigma_arcsec"])
    spread = (
        np.radians(float(row["hfov_deg"])) * np.hypot(1.0, float(row["height"]) / float(row["width"])) / np.sqrt(12)
    )
    truth = np.array([sigma, sigma, sigma / spread])
    return float(np.hypot(*e[:2])), float(e[2]), float(np.sum(e**2 / (truth**2 + np.array(entry["sigma_arcsec"]) ** 2)))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--calibrated", action="store_true")
    arguments = parser.parse_args()
    with (arguments.folder / "truth.csv").open(newline="") as f:
        rows = [r for r in csv.DictReader(f) if r["kind"] == "sky"]
    groups = defaultdict(list)
    for r in rows:
        groups[str(Path(r["file"]).parent), r["width"], r["height"], f"{float(r['hfov_deg']):.1f}"].append(r)
    judgements = []
    for (_, _, _, fov), mine in groups.items():
        files = [arguments.folder / r["file"] for r in mine]
        aspect = float(mine[0]["pixel_aspect_y_over_x"] or 1.0)
        options = SolveOptions(fov=fov, aspect=aspect)
        with contextlib.redirect_stderr(io.StringIO()), tempfile.TemporaryDirectory() as folder:
            if arguments.calibrated:
                cam = Path(folder) / "cam.toml"
                run_calibrate(files, CalibrateOptions(SolveOptions(fov=fov), None if aspect == 1.0 else aspect, cam))
                options = SolveOptions(camera=cam)
            entries = run_solve(files, options)["images"]
        for r, e in zip(mine, entries):
            if e["status"] != "solved":
                print(f"{r['file'][-44:]:44s} {e['status']}")
                continue
            across, about, square = judged(r, e)
            judgements.append((across, square))
            print(
                f"{r['file'][-44:]:44s} error {across:5.1f} (sigma {max(e['sigma_arcsec'][:2]):4.1f}), roll {about:6.1f} "
                f"(sigma {e['sigma_arcsec'][2]:3.0f}) arcsec, normalised {square:5.1f}, {e['stars']} stars"
            )
    errors, squares = np.array(judgements).T
    print(
        f"{len(errors)} of {len(rows)} solved; error median {np.median(errors):.2f}, largest {errors.max():.1f} arcsec; "
        f"normalised error squared, 3 axes: mean {squares.mean():.2f}, median {np.median(squares):.2f}"
    )


if __name__ == "__main__":
    main()
