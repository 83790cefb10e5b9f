"""Frames beside which astrometry.net left a .wcs: how many are solved, and how far apart the two are.

python benchmarks/wcs_frames.py FOLDER... [--unknown] [--json]

Images below the folders that have a NAME.wcs beside them (a FITS header, TAN or TAN-SIP) or, for a folder `samples`, in the
folder `calibration_data` next to it, as in the repositories of openstartracker and oresat-star-tracker-software. Each frame is
solved alone with the wcs's field to a tenth of a degree, or with 4 to 30 deg where --unknown is given. The distance is that of
the geometric image centre; astrometry.net does not say how well it knows it, so this is no error of either.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
from pathlib import Path

import numpy as np

from helmstar.progress import Progress
from helmstar.startracker.command import SolveOptions, run_solve

KINDS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
FALSE_DEG = 0.3


def header(path: Path) -> dict[str, float]:
    """Numbers of a FITS header, by keyword."""
    text, out = path.read_bytes().decode("latin-1"), {}
    for k in range(0, len(text), 80):
        card = re.match(r"(\w+)\s*=\s*([-+.\dEe]+)\s*(/|$)", text[k : k + 80])
        if card:
            out[card[1]] = float(card[2])
    return out


def _bent(h: dict[str, float], name: str, u: float, v: float) -> float:
    order = int(h.get(f"{name}_ORDER", 0))
    return sum(h.get(f"{name}_{i}_{j}", 0.0) * u**i * v**j for i in range(order + 1) for j in range(order + 1 - i))


def centre(h: dict[str, float]) -> tuple[np.ndarray, float]:
    """Direction (3,) of the geometric image centre in ICRS, and the horizontal field, deg."""
    width, height = h["IMAGEW"], h["IMAGEH"]
    u, v = (width + 1) / 2 - h["CRPIX1"], (height + 1) / 2 - h["CRPIX2"]
    u, v = u + _bent(h, "A", u, v), v + _bent(h, "B", u, v)
    xi, eta = np.radians([h["CD1_1"] * u + h["CD1_2"] * v, h["CD2_1"] * u + h["CD2_2"] * v])
    a, d = np.radians([h["CRVAL1"], h["CRVAL2"]])
    z = np.array([np.cos(a) * np.cos(d), np.sin(a) * np.cos(d), np.sin(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    s = z + xi * east + eta * np.cross(z, east)
    step = np.radians(np.hypot(h["CD1_1"], h["CD2_1"]))
    return s / np.linalg.norm(s), float(2.0 * np.degrees(np.arctan(0.5 * width * step)))


def frames(folders: list[Path]) -> list[tuple[Path, dict[str, float]]]:
    """Images with their header, each content once."""
    out, seen = [], set()
    for image in sorted(p for f in folders for p in f.rglob("*") if p.suffix.lower() in KINDS):
        beside = image.with_suffix(".wcs")
        if not beside.exists() and image.parent.name == "samples":
            beside = image.parent.parent / "calibration_data" / beside.name
        content = image.read_bytes()
        if beside.exists() and content not in seen:
            seen.add(content)
            h = header(beside)
            if {"CD1_1", "CRVAL1", "IMAGEW"} <= h.keys():
                out.append((image, h))
    return out


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--unknown", action="store_true", help="the field is not told: 4 to 30 deg")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    work, rows = frames(arguments.folders), []
    if not work:
        parser.error("no image has a .wcs beside it")
    with Progress(True) as progress:
        task = progress.add("frames", len(work))
        for image, h in work:
            z, fov = centre(h)
            told = "4..30" if arguments.unknown else f"{fov:.1f}"
            with contextlib.redirect_stderr(io.StringIO()):
                e = run_solve([image], SolveOptions(fov=told))["images"][0]
            apart = None
            if e["status"] == "solved":
                a, d = np.radians([e["ra_deg"], e["dec_deg"]])
                there = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
                apart = float(np.degrees(np.linalg.norm(there - z)))
            rows.append({**{k: e[k] for k in ("file", "status", "stars", "fov_deg", "ms_total")}, "apart_deg": apart})
            progress.advance(task)
    apart = np.array([r["apart_deg"] for r in rows if r["apart_deg"] is not None])
    near = apart[apart < FALSE_DEG]
    summary = {
        "frames": len(rows), "solved": len(near), "false": int((apart >= FALSE_DEG).sum()),
        "apart_arcsec_median": float(3600 * np.median(near)) if len(near) else None,
    }  # fmt: skip
    if arguments.json:
        print(json.dumps({"summary": summary, "frames": rows}))
        return
    for r in rows:
        where = "" if r["apart_deg"] is None else f"{3600 * r['apart_deg']:7.1f} arcsec apart, {r['stars']} stars"
        print(f"{r['file'][-60:]:60} {r['status']:12} {where}")
    print(summary)


if __name__ == "__main__":
    main()
