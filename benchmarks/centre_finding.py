"""Centre finding in px and ms: `python benchmarks/centre_finding.py [frames] [methods]`.

Every method on rendered windows of a body 12, 50 and 200 px across at phase 10, 60 and 100 deg, in five cases: the law known;
another law than the assumed one; the radius 10% wrong (1 sigma); an ellipsoid (axes 10%, 1 sigma) taken for a sphere; all wrong.
Printed: root mean square error per axis, largest error, NEES per axis (1 is right), centres found, median ms.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera
from helmstar.imaging.body import (
    Detector,
    Ellipsoid,
    Hapke,
    Lambert,
    LommelSeeliger,
    McEwen,
    Minnaert,
    Pose,
    Target,
    render_window,
    sphere,
)
from helmstar.imaging.body.centre import find_centre
from helmstar.imaging.render import Exposure

CAMERA = Camera.from_fov(3.5, 1024, 1024)
RADIUS = 2e3
EXPOSURE = Exposure(full_well_e=1e6, bits=16, gain_e=2.0)
DETECTOR = Detector(2.0)
OTHERS = (LommelSeeliger(), McEwen(weight=0.4), Minnaert(k=0.6), Hapke())
CASES = ("known law", "wrong law", "wrong radius", "ellipsoid", "all wrong")


def case(name: str, k: int, rng: np.random.Generator):
    """The law and figure of the body, and what is believed of it."""
    law, shape = Lambert(), sphere(RADIUS)
    if name in ("wrong law", "all wrong"):
        law = OTHERS[k % len(OTHERS)]
    if name in ("ellipsoid", "all wrong"):
        shape = Ellipsoid(RADIUS * np.exp(rng.normal(0.0, 0.1, 3)))
    believed = RADIUS * (rng.normal(1.0, 0.1) if name in ("wrong radius", "all wrong") else 1.0)
    known = name in ("known law", "wrong radius", "ellipsoid")
    radius_sigma = 0.1 if name in ("wrong radius", "ellipsoid", "all wrong") else 0.0
    shape_sigma = 0.1 if name in ("ellipsoid", "all wrong") else 0.0
    return law, shape, Target(sphere(believed), Lambert(), known, radius_sigma, shape_sigma)


def run(name: str, method: str, diameter: float, degrees: float, frames: int) -> str:
    errors, ratios, ms = [], [], []
    for k in range(frames):
        rng = np.random.default_rng([k, int(diameter), int(degrees), CASES.index(name)])
        law, shape, target = case(name, k, rng)
        a, turn = np.radians(degrees), rng.uniform(0.0, 2.0 * np.pi)
        sun = np.array([np.sin(a) * np.cos(turn), np.sin(a) * np.sin(turn), -np.cos(a)])
        r = 2.0 * RADIUS * CAMERA.focal_px / diameter * CAMERA.directions(rng.uniform(200.0, 800.0, 2))
        R_TC = Rotation.random(rng=rng).as_matrix()
        image, truth = render_window(
            CAMERA, shape, r, sun, R_TC=R_TC, law=law, signal_e=3e4, exposure=EXPOSURE, seed=rng
        )
        pose = Pose(float(np.linalg.norm(r)), sun)
        begin = time.perf_counter()
        found = find_centre(image, CAMERA, target, pose, DETECTOR, method=method, corner=truth.window[:2])
        ms.append(1e3 * (time.perf_counter() - begin))
        if found.usable:
            e = found.centre_px - truth.centre_px
            errors.append(e)
            ratios.append(float(e @ np.linalg.solve(found.covariance_px, e)) / 2.0)
    if not errors:
        return f"| {name} | {method} | {diameter:.0f} | {degrees:.0f} | - | - | - | 0/{frames} | {np.median(ms):.0f} |"
    E = np.array(errors)
    return (
        f"| {name} | {method} | {diameter:.0f} | {degrees:.0f} | {np.sqrt(np.mean(E**2)):.4f} | {np.abs(E).max():.3f} | "
        f"{np.mean(ratios):.2f} | {len(E)}/{frames} | {np.median(ms):.0f} |"
    )


def main() -> None:
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    methods = sys.argv[2].split(",") if len(sys.argv) > 2 else ["moment", "fit", "limb"]
    cases = sys.argv[3].split(",") if len(sys.argv) > 3 else CASES
    print("| case | method | diameter, px | phase, deg | rms, px | worst, px | NEES | found | ms |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in cases:
        for method in methods:
            for diameter in (12.0, 50.0, 200.0):
                if method == "limb" and diameter < 20.0:
                    continue
                for degrees in (10.0, 60.0, 100.0):
                    print(run(name, method, diameter, degrees, frames), flush=True)


if __name__ == "__main__":
    main()
