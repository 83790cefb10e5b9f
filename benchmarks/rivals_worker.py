"""One solver other than helmstar, in the process and environment of its own: requests and answers are JSON lines.

rivals.py starts it with the other environment's python, which needs no helmstar: rivals_worker.py NAME [FOLDER]. The first
line it writes says what it is. Then every request, {"image": FILE.npy} or {"list": [[x, y, flux], ...], "size": [w, h]} with
"fov" in deg and "sigma_px" (null: not known) and "timeout" in s, is answered by {"solved", "ms"} and, where solved, "R" (3, 3)
as R_SN or "angles" [ra, dec, roll] in deg; with a covariance also "covariance" (3, 3), rad^2, of [about the boresight, east,
north]. ms is from the array in memory to the attitude. Settings are the documented defaults; what is said here differs from
them, or has no default.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

FIELDS = (4.0, 30.0)
"""deg: what helmstar tries where no field is stated, and what tetra3rs's tables are generated for."""
SLACK = 0.05
"""Share of the stated field by which it may be wrong, as the solvers want to be told."""


class Tetra3rs:
    """tetra3rs with its default or its fast extraction. Tables are generated once (minutes) and kept beside the environment.

    error: how far edge ratios may be from the tables'; the default is 0.001.
    """

    def __init__(self, fast: bool = False, error: float | None = None):
        import tetra3rs  # pyright: ignore[reportMissingImports]

        self.module, self.version = tetra3rs, importlib.metadata.version("tetra3rs")
        self.error = error
        self.extract = tetra3rs.extract_centroids_fast if fast else tetra3rs.extract_centroids
        low, high = FIELDS
        kept = Path(sys.prefix) / f"tetra3rs-{self.version}-{low:g}-{high:g}.bin"
        if not kept.exists():
            print(f"generating {kept.name}: takes minutes, once", file=sys.stderr, flush=True)
            table = tetra3rs.SolverDatabase.generate_from_gaia(max_fov_deg=high, min_fov_deg=low)
            table.save_to_file(str(kept))
        self.table = tetra3rs.SolverDatabase.load_from_file(str(kept))
        self.about = (
            f"tables of its Gaia and Hipparcos stars for {low:g} to {high:g} deg, {kept.stat().st_size >> 20} MiB"
        )

    def image(self, array: np.ndarray, fov: float | None, timeout: float, sigma_px: float | None = None) -> dict:
        begin = time.perf_counter()
        return self._solve(self.extract(array).centroids, array.shape, fov, timeout, begin)

    def listed(
        self, stars: np.ndarray, size: tuple[int, int], fov: float | None, timeout: float, sigma_px: float | None = None
    ) -> dict:
        begin = time.perf_counter()
        return self._solve(stars - [0.5 * size[0], 0.5 * size[1], 0.0], size[::-1], fov, timeout, begin)

    def _solve(
        self, centroids: object, shape: tuple[int, ...], fov: float | None, timeout: float, begin: float
    ) -> dict:
        middle = math.sqrt(FIELDS[0] * FIELDS[1])
        slack = None if fov is None else SLACK * fov
        found = self.table.solve_from_centroids(
            centroids, fov_estimate_deg=fov or middle, image_shape=tuple(shape), fov_max_error_deg=slack,
            solve_timeout_ms=round(1e3 * timeout), match_max_error=self.error,
        )  # fmt: skip
        ms = 1e3 * (time.perf_counter() - begin)
        if not found:
            return {"solved": False, "ms": ms, "status": found.status}
        covariance = np.asarray(found.attitude_cov_rad2)
        R = found.rotation_matrix_icrs_to_camera
        return {"solved": True, "ms": ms, "R": R.tolist(), "covariance": covariance.tolist()}


class Cedar:
    """cedar-solve with its own extraction and the tables that it ships; of an image the 30 brightest count, as in its example."""

    def __init__(self):
        import logging

        import tetra3  # pyright: ignore[reportMissingImports]

        logging.disable(logging.INFO)
        self.module, self.version = tetra3, importlib.metadata.version("cedar-solve")
        self.solver = tetra3.Tetra3()
        p = self.solver.database_properties
        self.about = f"tables as shipped, for {p['min_fov']:g} to {p['max_fov']:g} deg, without Cedar Detect"

    def image(self, array: np.ndarray, fov: float | None, timeout: float, sigma_px: float | None = None) -> dict:
        from PIL import Image

        picture = Image.fromarray(array)
        begin = time.perf_counter()
        centroids = self.module.get_centroids_from_image(picture)
        return self._solve(centroids[:30], array.shape, fov, timeout, begin)

    def listed(
        self, stars: np.ndarray, size: tuple[int, int], fov: float | None, timeout: float, sigma_px: float | None = None
    ) -> dict:
        begin = time.perf_counter()
        return self._solve(stars[np.argsort(-stars[:, 2]), 1::-1], size[::-1], fov, timeout, begin)

    def _solve(
        self, centroids: np.ndarray, shape: tuple[int, ...], fov: float | None, timeout: float, begin: float
    ) -> dict:
        if len(centroids) == 0:
            return {"solved": False, "ms": 1e3 * (time.perf_counter() - begin), "status": "TOO_FEW"}
        found = self.solver.solve_from_centroids(
            centroids, tuple(shape), fov_estimate=fov, fov_max_error=None if fov is None else SLACK * fov,
            solve_timeout=1e3 * timeout,
        )  # fmt: skip
        ms = 1e3 * (time.perf_counter() - begin)
        if found["RA"] is None:
            return {"solved": False, "ms": ms, "status": str(found["status"])}
        return {"solved": True, "ms": ms, "angles": [float(found[k]) for k in ("RA", "Dec", "Roll")]}


class Lost:
    """LOST's program, built in FOLDER. It reads 8-bit PNG only: deeper images lose their low bits, lists are drawn as spots. It
    needs the field. Its own --print-speed is quoted, without start and loading.

    The options are those of its README but for the 12 brightest spots and 0.02 deg, or two sigma of the noise if more, instead
    of all and 0.05 deg: the best of eleven that were tried on real and rendered frames; with those of the README a third of the
    solutions are false.
    """

    OPTIONS = (
        "--centroid-algo=cog", "--centroid-mag-filter=5", "--centroid-filter-brightest=12", "--star-id-algo=py",
        "--false-stars-estimate=1000", "--max-mismatch-probability=0.0001", "--attitude-algo=dqm", "--print-attitude=-",
        "--print-speed=-",
    )  # fmt: skip
    DATABASE = (
        "--max-stars=5000", "--kvector", "--kvector-min-distance=0.2", "--kvector-max-distance=15",
        "--kvector-distance-bins=10000",
    )  # fmt: skip

    def __init__(self, folder: str):
        self.folder, self.kept = Path(folder).resolve(), tempfile.TemporaryDirectory()
        self.database, self.png = (str(Path(self.kept.name) / name) for name in ("lost.dat", "image.png"))
        command = [str(self.folder / "lost"), "database", *self.DATABASE, f"--output={self.database}"]
        subprocess.run(command, cwd=self.folder, check=True, capture_output=True)
        git = subprocess.run(
            ["git", "log", "-1", "--format=%h of %cs"], cwd=self.folder, capture_output=True, text=True
        )
        self.version, self.about = (
            git.stdout.strip() or "of unknown version",
            "pyramids, its Bright Star Catalogue, the 12 brightest spots",
        )

    def image(self, array: np.ndarray, fov: float | None, timeout: float, sigma_px: float | None = None) -> dict:
        from PIL import Image

        if fov is None:
            return {"solved": False, "ms": None, "status": "needs the field"}
        top = 255.0 if array.dtype == np.uint8 else max(float(array.max()), 1.0)
        Image.fromarray((array.astype(np.float32) * (255.0 / top)).astype(np.uint8)).save(self.png, compress_level=1)
        tolerance = max(0.02, 2.0 * (sigma_px or 0.0) * fov / array.shape[1])
        begin = time.perf_counter()
        try:
            done = subprocess.run(
                [str(self.folder / "lost"), "pipeline", "--png", self.png, "--fov", f"{fov:.6f}", "--database", self.database,
                 f"--angular-tolerance={tolerance:.4f}", *self.OPTIONS],
                cwd=self.folder, capture_output=True, text=True, errors="replace", timeout=timeout,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"solved": False, "ms": 1e3 * (time.perf_counter() - begin), "status": "out of time"}
        told = dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)
        ms = float(told.get("total_average_ns", "nan")) * 1e-6
        if told.get("attitude_known") != "1":
            return {"solved": False, "ms": None if math.isnan(ms) else ms, "status": f"exit code {done.returncode}"}
        ra, dec, roll = (float(told[f"attitude_{k}"]) for k in ("ra", "de", "roll"))
        return {"solved": True, "ms": ms, "angles": [ra, dec, -roll]}  # it counts roll clockwise

    def listed(
        self, stars: np.ndarray, size: tuple[int, int], fov: float | None, timeout: float, sigma_px: float | None = None
    ) -> dict:
        return self.image(spots(stars, size), fov, timeout, sigma_px)


def spots(stars: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 (h, w): stars (n, 3) of x, y from the image's corner and flux as Gaussians of 1 px, the brightest peak at 250, the
    faintest at no less than 40 so that all are seen."""
    width, height = size
    picture = np.zeros((height, width))
    peak = np.maximum(250.0 * stars[:, 2] / stars[:, 2].max(), 40.0)
    for (x, y), p in zip(stars[:, :2], peak):
        columns = np.arange(max(int(x) - 4, 0), min(int(x) + 5, width))
        rows = np.arange(max(int(y) - 4, 0), min(int(y) + 5, height))
        light = np.exp(-0.5 * ((rows[:, None] + 0.5 - y) ** 2 + (columns[None, :] + 0.5 - x) ** 2))
        picture[np.ix_(rows, columns)] = np.maximum(picture[np.ix_(rows, columns)], p * light)
    return picture.round().astype(np.uint8)


def solver_of(name: str, rest: list[str]) -> Tetra3rs | Cedar | Lost:
    """By the name in rivals.py."""
    if name == "LOST":
        return Lost(rest[0])
    if name == "cedar-solve":
        return Cedar()
    return Tetra3rs(error=0.003) if name == "tetra3rs, error 0.003" else Tetra3rs(name == "tetra3rs fast")


def main() -> None:
    """Answer until the input ends."""
    answers = sys.stdout
    sys.stdout = sys.stderr  # what the solvers print is no answer
    begin = time.perf_counter()
    solver = solver_of(sys.argv[1], sys.argv[2:])
    first = {"version": solver.version, "about": solver.about, "ready_s": time.perf_counter() - begin}
    print(json.dumps(first), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        known = (request["fov"], request["timeout"], request["sigma_px"])
        if "image" in request:
            answer = solver.image(np.load(request["image"]), *known)
        else:
            answer = solver.listed(np.array(request["list"], dtype=float), tuple(request["size"]), *known)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
