"""26 real frames of four cameras: the brightest detections are the catalogue's stars, where truth says they are.

One untuned setting for all. The truth file gives the direction of the geometric image centre, north's angle from image up
(counter-clockwise), and the horizontal field; `pytest -s` prints a table.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from helmstar.imaging import Camera, Centroids, detect
from helmstar.io.images import read_image
from helmstar.stars.catalog import load_catalog

WITHIN_PX = 4.0  # truth is a pinhole without the lens's distortion
# Per camera: the least number of catalogue stars among the first n detections of any frame (with `AMONG` n).
AMONG = {"tetra3": 40, "cedar": 20, "oresat": 20, "openstartracker": 40}
LEAST = {"tetra3": 37, "cedar": 12, "oresat": 17, "openstartracker": 7}


def attitude(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """R_SN (3, 3): rows are right, down and boresight; north stands roll counter-clockwise from up, and east is left of it."""
    a, d, roll = np.radians([ra_deg, dec_deg, roll_deg])
    z = np.array([np.cos(a) * np.cos(d), np.sin(a) * np.cos(d), np.sin(d)])
    north = np.array([-np.cos(a) * np.sin(d), -np.sin(a) * np.sin(d), np.cos(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.cos(roll) * north - np.sin(roll) * east
    left = np.sin(roll) * north + np.cos(roll) * east
    return np.stack([-left, -up, z])


def stars_of(row: dict[str, str], width: int, height: int) -> np.ndarray:
    """(n, 2) where catalogue stars to V = 9 are on the frame, px, the brightest first."""
    catalog = load_catalog(9.0)
    camera = Camera.from_fov(float(row["hfov_deg"]), width, height, float(row["pixel_aspect_y_over_x"]))
    R_SN = attitude(*(float(row[k]) for k in ("ra_deg", "dec_deg", "roll_deg")))
    xy = camera.pixels(catalog.directions(float(row["epoch"] or 2020.0)) @ R_SN.T)
    return xy[camera.inside(xy)]


def frames(folder: Path) -> list[dict[str, str]]:
    with (folder / "truth.csv").open(newline="") as f:
        return [r for r in csv.DictReader(f) if r["kind"] == "sky"]


@pytest.fixture(scope="module")
def results(shared_data) -> list[tuple[dict[str, str], Centroids, np.ndarray, np.ndarray]]:
    """Row of truth, detections, which of them are catalogue stars, which of the ten brightest catalogue stars were found."""
    out = []
    for row in frames(shared_data / "stars"):
        image = read_image(shared_data / "stars" / row["file"])
        found, stars = detect(image), stars_of(row, image.width, image.height)
        hit = np.isfinite(cKDTree(stars).query(found.xy_px, distance_upper_bound=WITHIN_PX)[0])
        back = np.isfinite(cKDTree(found.xy_px).query(stars[:10], distance_upper_bound=WITHIN_PX)[0])
        out.append((row, found, hit, back))
    return out


@pytest.mark.shared_data
def test_the_brightest_detections_are_stars(results):
    assert len(results) == 26
    print(f"\n{'frame':50s} found  true of first 10  20  40  brightest 10 of the catalogue found")
    short = []
    for row, found, hit, back in results:
        first = [int(hit[:n].sum()) for n in (10, 20, 40)]
        print(f"{row['file']:50s} {len(found):5d} {first[0]:14d} {first[1]:5d} {first[2]:3d} {back.sum():12d}")
        group = row["camera_group"]
        wanted = min(LEAST[group], int(row["matched"]) - 1)
        if hit[: AMONG[group]].sum() < wanted or first[0] < 6:
            short.append(f"{row['file']}: {hit[: AMONG[group]].sum()} of {wanted}, first ten {first[0]}")
    assert not short, "\n".join(short)


@pytest.mark.shared_data
def test_bright_stars_of_the_catalogue_are_found(results):
    """Except behind the roof, where they cannot be seen."""
    for row, _, _, back in results:
        if "roof" not in row["file"]:
            assert back.sum() >= min(5, int(row["matched"])), row["file"]


@pytest.mark.shared_data
def test_a_room_has_no_stars(shared_data):
    assert len(detect(read_image(shared_data / "stars" / "negative" / "bayered_room.bmp"))) <= 3
