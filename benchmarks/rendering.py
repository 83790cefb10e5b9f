"""Rendered frames solved again: normalised error squared (3 is right) and errors by kind of frame. `python benchmarks/rendering.py`

--catalog also tries fields of 2 to 6 deg with Hipparcos and with Gaia (pip install "helmstar[gaia]").
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera
from helmstar.imaging.render import Exposure, Glow, render
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars.catalog import Catalog, load_catalog, load_gaia

EIGHT = {"gain_e": 8.0, "offset": 8.0, "bits": 8}
SIXTEEN = {"gain_e": 0.3, "offset": 200.0, "bits": 16}
KINDS = {
    "8 bit": Exposure(**EIGHT),
    "16 bit": Exposure(**SIXTEEN),
    "0.2 deg/s, 3.4 px of smear": Exposure(**EIGHT, omega_SN_S=(0.0, float(np.radians(0.2)), 0.0)),
    "800 hot pixels": Exposure(**EIGHT, hot_fraction=800 / (1024 * 768)),
    "glow that fills a corner": Exposure(**EIGHT, glow=(Glow(0.0, 0.0, 3000.0, 300.0),)),
}


def trial(tracker: StarTracker, camera: Camera, stars: Catalog, exposure: Exposure, frames: int) -> str:
    """Solve so many frames of random attitudes, each without a prior; a line of figures."""
    directions = stars.directions()
    squares, errors, sigmas, matched = [], [], [], []
    for seed in range(frames):
        R = Rotation.random(rng=np.random.default_rng(1000 + seed))
        image, _ = render(camera, R.as_quat(), directions, stars.magnitude, exposure, seed)
        tracker.memory = None
        found = tracker.solve(image)
        if found.solved:
            error = (R * Rotation.from_quat(found.identification.q_SN).inv()).as_rotvec()
            squares.append(error @ np.linalg.solve(found.identification.covariance, error))
            errors.append(np.degrees(error) * 3600.0)
            sigmas.append(found.sigma_arcsec)
            matched.append(len(found.identification.stars))
    rms, sigma = (np.sqrt(np.mean(np.square(a), axis=0)) for a in (errors, sigmas))
    return (
        f"{len(squares)} of {frames} solved, NEES {np.mean(squares):.2f}, error {np.hypot(*rms[:2]) / 2**0.5:.2f} across and "
        f"{rms[2]:.2f} roll arcsec, sigma {np.hypot(*sigma[:2]) / 2**0.5:.2f} and {sigma[2]:.2f}, {np.median(matched):.0f} stars"
    )


def main() -> None:
    """Print one line for each kind."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--catalog", action="store_true")
    args = parser.parse_args()
    if args.catalog:
        gaia = load_gaia()
        for fov in (2.0, 3.0, 4.0, 6.0):
            camera = Camera.from_fov(fov, 1024, 1024)
            for name, catalog in (("hipparcos", None), ("gaia", gaia)):
                tracker = StarTracker(camera, julian_year=2000.0, catalog=catalog)
                print(f"{fov:g} deg, {name}:", trial(tracker, camera, gaia, Exposure(zero_point_e_s=2e7), args.frames))
        return
    camera = Camera.from_fov(12.0, 1024, 768)
    for name, exposure in KINDS.items():
        tracker = StarTracker(fov_deg=12.0, julian_year=2000.0)
        print(f"{name}:", trial(tracker, camera, load_catalog(), exposure, args.frames))


if __name__ == "__main__":
    main()
