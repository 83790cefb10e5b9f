"""Lenses that nobody calibrated and that displace stars by pixels: errors, and whether sigmas hold.

python benchmarks/rough_lenses.py [--runs N] [--json]

Made-up centroid lists of the true sky (0.1 px of noise, magnitudes to 0.3), 1024 x 1024 pixels, solved with the field stated and no
more known of the lens. Displacements are told by their length in the image's corner over its width. tangential: p1, p2 in any
direction; fifth order: k2; waves: a smooth field of about a period over the image, which no lens model has. `error`, `sigma`: of
the direction seen at the image's centre, arcsec, median; `square`: normalised error squared of its two axes, 2 is honest.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from problem import table
from real_frames import attitude
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Centroids
from helmstar.progress import Progress
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars.identify import default_sky

SIDE, NOISE_PX = 1024, 0.1
KINDS = ("none", "tangential", "fifth order", "waves")
SHARES = (0.002, 0.006, 0.012)


def displacement(kind: str, share: float, corner: float, rng: np.random.Generator):
    """Of X/Z and Y/Z of directions (n,), by `share` of the image's width in the corner: a function to (n, 2)."""
    size = share * SIDE / (0.5 * np.sqrt(2.0) * SIDE) * corner  # in X/Z
    if kind == "none":
        return lambda x, y: np.zeros((len(x), 2))
    if kind == "tangential":
        a = rng.uniform(0.0, 2.0 * np.pi)
        p1, p2 = size / (3.0 * corner**2) * np.array([np.cos(a), np.sin(a)])
        return lambda x, y: np.stack(
            [2.0 * p1 * x * y + p2 * (3.0 * x * x + y * y), p1 * (x * x + 3.0 * y * y) + 2.0 * p2 * x * y], axis=1
        )
    if kind == "fifth order":
        k = float(rng.choice([-1.0, 1.0])) * size / corner**5
        return lambda x, y: k * ((x * x + y * y) ** 2)[:, None] * np.stack([x, y], axis=1)
    waves, phases = rng.normal(size=(2, 2)) * 3.75 / corner, rng.uniform(0.0, 2.0 * np.pi, 2)
    return lambda x, y: 0.5 * size * np.sin(np.stack([x, y], axis=1) @ waves.T + phases)


def one(kind: str, share: float, fov_deg: float, stars: int, rng: np.random.Generator) -> dict | None:
    """Error and sigma (2,) arcsec of the direction seen at the centre, and what was doubted; None where it is not solved."""
    sky, camera, R = default_sky(), Camera.from_fov(fov_deg, SIDE, SIDE), Rotation.random(rng=rng).as_matrix()
    corner = float(np.hypot(SIDE, SIDE) / 2.0 / camera.focal_px)
    ahead = sky.around(R[2], 1.1 * np.arctan(corner))
    v = sky.directions[ahead] @ R.T
    x, y = v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]
    field = displacement(kind, share, corner, rng)
    xy = camera.focal_px * (np.stack([x, y], axis=1) + field(x, y)) + [camera.cx, camera.cy]
    keep = np.flatnonzero(camera.inside(xy))[:stars]
    magnitude = sky.magnitude[ahead[keep]] + rng.normal(0.0, 0.3, len(keep))
    order = np.argsort(magnitude)
    seen = xy[keep][order] + rng.normal(0.0, NOISE_PX, (len(keep), 2))
    one = np.ones(len(seen))
    C = np.tile(NOISE_PX**2 * np.eye(2), (len(seen), 1, 1))
    flux = 10.0 ** (-0.4 * magnitude[order])
    found = StarTracker(fov_deg=fov_deg).identified(
        Centroids(seen[:, 0], seen[:, 1], flux, C, one, one < 0, one, 50.0 * one), SIDE, SIDE
    )
    if not found.solved:
        return None
    at = np.zeros((1, 2))
    for _ in range(50):  # what is truly seen at the centre
        at = -field(at[:, 0], at[:, 1])
    d = R.T @ np.array([*at[0], 1.0])
    e = attitude(found.ra_deg, found.dec_deg, found.roll_deg) @ (d / np.linalg.norm(d))
    arcsec = 180.0 * 3600.0 / np.pi
    return {"error": e[:2] * arcsec, "sigma": found.sigma_arcsec[[1, 0]], "doubt": found.doubt, "wrong": e[2] < 0.999}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cases = [
        (k, s, f, n) for k in KINDS for s in (SHARES if k != "none" else (0.0,)) for f in (10.0, 20.0) for n in (20, 60)
    ]
    rows = []
    with Progress(not args.json) as progress:
        task = progress.add("lenses", len(cases) * args.runs)
        for case in cases:
            kind, share, fov, stars = case
            found = []
            for k in range(args.runs):
                found.append(
                    one(*case, np.random.default_rng([k, KINDS.index(kind), round(1e4 * share), int(fov), stars]))
                )
                progress.advance(task)
            good = [f for f in found if f is not None]
            rows.append(
                {
                    "kind": kind, "share": share, "fov_deg": fov, "stars": stars, "solved": len(good),
                    "wrong": sum(bool(f["wrong"]) for f in good), "rough": sum("rough" in f["doubt"] for f in good),
                    "error": float(np.median([np.hypot(*f["error"]) for f in good])),
                    "sigma": float(np.median([np.hypot(*f["sigma"]) for f in good])),
                    "square": float(np.mean([np.square(f["error"] / f["sigma"]).sum() for f in good])),
                }
            )  # fmt: skip
    if args.json:
        print(json.dumps(rows))
        return
    head = ["lens", "corner", "field", "stars", "solved", "wrong", "rough", "error", "sigma", "square"]
    print(
        table(
            head,
            [
                [r["kind"], f"{100 * r['share']:.1f}%", f"{r['fov_deg']:g} deg", str(r["stars"]), str(r["solved"]),
                 str(r["wrong"]), str(r["rough"]), f"{r['error']:.1f}", f"{r['sigma']:.1f}", f"{r['square']:.1f}"]
                for r in rows
            ],
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
