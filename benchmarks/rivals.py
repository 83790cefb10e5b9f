"""Star images and lists of centroids: helmstar beside other solvers, same inputs, one run.

python benchmarks/rivals.py --rivals VENV [--frames FOLDER] [--lost FOLDER] [--scenes N] [--parts ...] [--json]

VENV: an environment with `pip install tetra3rs cedar-solve`; its first use generates tables for tetra3rs, which takes minutes.
--lost: a folder in which LOST is built (its README). Each solver runs in a process of its own (rivals_worker.py), with its
documented defaults; what is said in that file differs from them. --frames: a folder with truth.csv, as for real_frames.py,
whose rows of kind `negative` must not solve.

frames: every frame with its field to a tenth of a degree, then unknown. `false`: over 5 arcmin off, or solved without stars.
lists: 30 true stars on 1024 x 1024 pixels (identification.py); right is within 5 arcmin and 0.5 deg of roll.
random: even detections, no sky: every solution is false.
time: rendered frames of 1024 x 768 pixels, 8 bit, 12 deg, from the array to the attitude.

Frames are timed one solver at a time. Lists run two solvers at once, so their milliseconds are of a busy machine; there
tetra3rs and cedar-solve may search for --timeout seconds (their default is 5), which bounds what a refusal costs. helmstar and LOST
are told the noise; `tetra3rs, error 0.003` is given the wider tolerance that noise of 2 px asks for.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import numpy as np
from problem import positive
from real_frames import ARCSEC, attitude
from rivals_worker import FIELDS

from helmstar.imaging import Camera, Image
from helmstar.imaging.render import Exposure, render
from helmstar.io.images import read_image
from helmstar.progress import Progress
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars import Pinhole, default_sky, identify
from helmstar.stars.catalog import load_catalog
from helmstar.stars.identify import matrix_of_quaternion
from helmstar.stars.synthetic import random_scene, scene

PARTS = ("frames", "lists", "random", "time")
SIZE = (1024, 1024)
CASES = {"2 px of noise": {"noise_px": 2.0}, "50 false": {"false": 50}, "60% dropped": {"dropped": 0.6}}
FALSE_ARCSEC = 300.0
FALSE_ROLL = 0.5 * 3600.0
YEAR = 2025.0
"""Of the stars in rendered frames; the tables of tetra3rs are for 2025, those of cedar-solve for 2024."""


class Helmstar:
    """helmstar in this process, with the answers of a worker."""

    def __init__(self, fluxes: bool = True, remember: bool = False):
        self.fluxes, self.remember = fluxes, remember
        self.trackers: dict[tuple[float | None, float | None], StarTracker] = {}
        self.first = {
            "version": version("helmstar"),
            "about": "Hipparcos, tables for 4 to 45 deg made when first needed",
        }

    def image(self, image: Image, fov: float | None, year: float | None = None) -> dict:
        """year: of the stars' places, where it is known."""
        if (fov, year) not in self.trackers:
            self.trackers[fov, year] = StarTracker(fov_deg=FIELDS if fov is None else fov, julian_year=year)
        tracker = self.trackers[fov, year]
        if not self.remember:
            tracker.memory = None
        begin = time.perf_counter()
        found = tracker.solve(image)
        ms = 1e3 * (time.perf_counter() - begin)
        if not found.solved:
            return {"solved": False, "ms": ms, "status": found.status}
        R = attitude(found.ra_deg, found.dec_deg, found.roll_deg)
        return {"solved": True, "ms": ms, "R": R, "covariance_S": found.identification.covariance}

    def listed(self, s: dict) -> dict:
        """A scene with "xy", "flux", "fov" and "sigma_px"."""
        camera = Pinhole.of_field(np.radians(s["fov"]), SIZE)
        begin = time.perf_counter()
        found = identify(s["xy"], camera, flux=s["flux"] if self.fluxes else None, sigma_px=s["sigma_px"])
        ms = 1e3 * (time.perf_counter() - begin)
        if not found.solved:
            return {"solved": False, "ms": ms, "status": found.status}
        return {"solved": True, "ms": ms, "R": matrix_of_quaternion(found.q_SN)}

    def close(self) -> None:
        """Nothing to end."""


class Rival:
    """Another solver, behind a pipe."""

    def __init__(self, name: str, python: Path, rest: list[str], folder: Path):
        self.name, self.folder, self.timeout = name, folder, 5.0
        self.log = (folder / f"{name}.log").open("w+", encoding="utf-8")
        command = [str(python), str(Path(__file__).with_name("rivals_worker.py")), name, *rest]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log, text=True
        )
        self.first = self._read()

    def _read(self) -> dict:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.log.seek(0)
            raise SystemExit(f"error: {self.name} ended: {self.log.read()[-1000:].strip()}")
        return json.loads(line)

    def _ask(self, request: dict) -> dict:
        assert self.process.stdin is not None
        print(json.dumps({"sigma_px": None, "timeout": self.timeout} | request), file=self.process.stdin, flush=True)
        answer = self._read()
        if "angles" in answer:
            answer["R"] = attitude(*answer["angles"])
        if answer["solved"]:
            answer["R"] = np.array(answer["R"])
        if "covariance" in answer:
            answer["covariance_S"] = in_camera(answer["R"], np.array(answer["covariance"]))
        return answer

    def image(self, image: Image, fov: float | None, year: float | None = None) -> dict:
        """As Helmstar's; the tables are for a year of their own."""
        file = self.folder / f"{self.name}.npy"
        np.save(file, image.array)
        return self._ask({"image": str(file), "fov": fov})

    def listed(self, s: dict) -> dict:
        """As Helmstar's; LOST wants to be told the noise."""
        stars = np.column_stack([s["xy"], s["flux"]])
        return self._ask({"list": stars.tolist(), "size": SIZE, "fov": s["fov"], "sigma_px": s["sigma_px"]})

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(timeout=10.0)
        self.log.close()


Solver = Helmstar | Rival


def in_camera(R_SN: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance (3, 3) of an attitude's error, on the left in S, from that of (theta, xi, eta): theta turns x of S from east to
    north, xi and eta move the boresight east and north.

    With R = exp([e x]) R_true the boresight moves by -e_y along x and e_x along y, x of S by -e_z along y.
    """
    x, y, z = R_SN
    east = np.array([-z[1], z[0], 0.0])
    east /= np.linalg.norm(east)
    north = np.cross(z, east)
    turned = np.cross(z, x)  # where x goes when theta grows: east to north is right-handed about the outward z
    J = np.array(
        [
            [0.0, 0.0, -(y @ turned)],
            [y @ east, -(x @ east), 0.0],
            [y @ north, -(x @ north), 0.0],
        ]
    )
    return np.linalg.solve(J, np.linalg.solve(J, covariance).T)


def error_S(R: np.ndarray, R_true: np.ndarray) -> np.ndarray:
    """Error e (3,) in rad about the axes of S, R = exp([e x]) R_true; of a large one the sense only."""
    E = R @ R_true.T
    sine = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    s, c = float(np.linalg.norm(sine)), 0.5 * (float(np.trace(E)) - 1.0)
    return sine * (np.arctan2(s, c) / s) if s > 1e-12 else sine if c > 0.0 else np.array([np.pi, 0.0, 0.0])


def judged(answer: dict, R_true: np.ndarray | None, truth_S: np.ndarray | None = None) -> dict:
    """What became of an answer: its verdict ("right", "false", "unsolved"), milliseconds, error across the boresight in arcsec,
    and the normalised error squared of three axes where there are a covariance and the truth's, truth_S (3, 3).

    R_true None: nothing may be solved.
    """
    row = {"ms": answer["ms"]}
    if not answer["solved"]:
        return row | {"verdict": "unsolved"}
    if R_true is None:
        return row | {"verdict": "false"}
    e = error_S(answer["R"], R_true)
    across = float(np.arccos(np.clip(answer["R"][2] @ R_true[2], -1.0, 1.0))) if np.abs(e).max() > 0.01 else 0.0
    across = ARCSEC * (across or float(np.hypot(*e[:2])))
    right = across <= FALSE_ARCSEC and abs(e[2]) * ARCSEC <= FALSE_ROLL
    row |= {"verdict": "right" if right else "false", "arcsec": across}
    if right and truth_S is not None and "covariance_S" in answer:
        row["nees"] = float(e @ np.linalg.solve(answer["covariance_S"] + truth_S, e))
    return row


def summary(rows: list[dict]) -> dict:
    """Counts, and medians over what they are defined for (None where nothing is)."""

    def over(key: str, function: Callable[[list[float]], float], verdict: str | None = "right") -> float | None:
        values = [r[key] for r in rows if r.get(key) is not None and (verdict is None or r["verdict"] == verdict)]
        return float(function(values)) if values else None

    return {
        "of": len(rows),
        "right": sum(r["verdict"] == "right" for r in rows),
        "false": sum(r["verdict"] == "false" for r in rows),
        "arcsec_median": over("arcsec", np.median),
        "arcsec_max": over("arcsec", max),
        "nees_mean": over("nees", np.mean),
        "nees_median": over("nees", np.median),
        "ms_median": over("ms", np.median, None),
        "ms_right": over("ms", np.median),
        "ms_max": over("ms", max, None),
    }


def frames_of(folder: Path) -> list[dict]:
    """Rows of truth.csv with image, stated field, true R_SN and its covariance (None where there are no stars)."""
    with (folder / "truth.csv").open(newline="", encoding="utf-8") as f:
        rows = list(csv.DictReader(f))
    frames = []
    for r in rows:
        frame = {"image": read_image(folder / r["file"]), "fov": 12.0, "R": None, "truth_S": None, "file": r["file"]}
        if r["kind"] == "sky":
            angles = [float(r[k]) for k in ("ra_deg", "dec_deg", "roll_deg")]
            sigma = float(r["boresight_sigma_arcsec"]) / ARCSEC
            spread = np.hypot(1.0, float(r["height"]) / float(r["width"])) / np.sqrt(12.0)
            spread *= np.radians(float(r["hfov_deg"]))
            frame |= {
                "fov": round(float(r["hfov_deg"]), 1),
                "R": attitude(*angles),
                "truth_S": np.diag([sigma, sigma, sigma / spread]) ** 2,
            }
        frames.append(frame)
    return frames


def rendered(count: int) -> Iterable[dict]:
    """Frames of 0.8 Mpx like those of rendering.py, of random attitudes."""
    from scipy.spatial.transform import Rotation

    camera, stars = Camera.from_fov(12.0, 1024, 768), load_catalog()
    exposure = Exposure(gain_e=8.0, offset=8.0, bits=8)
    for seed in range(count):
        R = Rotation.random(rng=np.random.default_rng([61, seed]))
        image, _ = render(camera, R.as_quat(), stars.directions(YEAR), stars.magnitude, exposure, seed)
        yield {"image": image, "fov": 12.0, "R": R.as_matrix(), "truth_S": np.zeros((3, 3)), "year": YEAR}


def scenes_of(fov_deg: float, count: int, kinds: dict) -> list[dict]:
    """Lists with their true attitudes, the same for everyone."""
    camera, sky = Pinhole.of_field(np.radians(fov_deg), SIZE), default_sky()
    drawn = [scene(sky, camera, np.random.default_rng([51, k]), **kinds) for k in range(count)]
    sigma = max(kinds.get("noise_px", 0.3), 0.3)
    return [{"xy": s.xy_px, "flux": s.flux, "fov": fov_deg, "sigma_px": sigma, "R": s.R_SN} for s in drawn]


def empty_of(detections: int, count: int) -> list[dict]:
    """Lists that show nothing."""
    camera = Pinhole.of_field(np.radians(12.0), SIZE)
    drawn = [random_scene(camera, np.random.default_rng([71, detections, k]), detections) for k in range(count)]
    return [{"xy": s.xy_px, "flux": s.flux, "fov": 12.0, "sigma_px": 0.3, "R": None} for s in drawn]


def solve_frames(solver: Solver, frames: list[dict], stated: bool, tick: Callable[[], None]) -> dict:
    """One frame before the clock counts, then all."""
    solver.image(frames[0]["image"], frames[0]["fov"] if stated else None, frames[0].get("year"))
    rows = []
    for f in frames:
        answer = solver.image(f["image"], f["fov"] if stated else None, f.get("year"))
        rows.append(judged(answer, f["R"], f["truth_S"]) | {"file": f.get("file")})
        tick()
    return summary(rows) | {"missed": [r["file"] for r in rows if r["verdict"] == "unsolved" and r["file"]]}


def solve_lists(solver: Solver, lists: list[dict], tick: Callable[[], None]) -> dict:
    """As above."""
    solver.listed(lists[0])
    rows = []
    for s in lists:
        rows.append(judged(solver.listed(s), s["R"]))
        tick()
    return summary(rows)


def in_frames(solvers: dict[str, Solver], frames: list[dict], ways: dict[str, bool]) -> dict:
    """One solver after the other: {way: {solver: summary}}."""
    with Progress(True) as bar:
        out: dict = {}
        for way, stated in ways.items():
            task = bar.add(way, len(frames) * len(solvers))
            out[way] = {
                name: solve_frames(s, frames, stated, lambda task=task: bar.advance(task))
                for name, s in solvers.items()
                if stated or name != "LOST"
            }
            bar.finish(task)
        return out


def in_lists(solvers: dict[str, Solver], cases: dict[str, list[dict]]) -> dict:
    """Two solvers at a time: {case: {solver: summary}}."""
    with Progress(True) as bar, ThreadPoolExecutor(2) as pool:
        tasks = {name: bar.add(name, sum(map(len, cases.values()))) for name in solvers}

        def all_cases(name: str) -> dict:
            return {
                case: solve_lists(solvers[name], lists, lambda: bar.advance(tasks[name]))
                for case, lists in cases.items()
            }

        slow_first = sorted(
            solvers, key=lambda name: ("cedar-solve", "LOST").index(name) if name in ("cedar-solve", "LOST") else 2
        )
        done = dict(zip(slow_first, pool.map(all_cases, slow_first)))
    return {case: {name: done[name][case] for name in solvers} for case in cases}


def measured(args: argparse.Namespace, solvers: dict[str, Solver]) -> dict:
    """Every part that was asked for."""
    out: dict = {}
    for_lists = ("helmstar, fluxes unused", "tetra3rs, error 0.003")
    imaging = {name: s for name, s in solvers.items() if name not in for_lists}
    others = {name: s for name, s in imaging.items() if name != "helmstar, optics kept"}
    if "frames" in args.parts and args.frames is not None:
        ways = {"frames, field stated": True, "frames, field unknown": False}
        out |= in_frames(others, frames_of(args.frames), ways)
    if "time" in args.parts:
        out |= in_frames(imaging, list(rendered(args.rendered)), {"time, 1024 x 768 rendered": True})
    for s in solvers.values():
        if isinstance(s, Rival) and s.name != "LOST":
            s.timeout = args.timeout
    # A list has been through extraction already.
    listing = {name: s for name, s in solvers.items() if name not in ("tetra3rs fast", "helmstar, optics kept")}
    if "lists" in args.parts:
        cases = {
            f"{name}, {fov:g} deg": scenes_of(fov, args.scenes, kinds)
            for fov in args.fields
            for name, kinds in CASES.items()
        }
        out |= in_lists(listing, cases)
    if "random" in args.parts:
        listing.pop("helmstar, fluxes unused")
        out |= in_lists(listing, {f"{n} detections, no sky": empty_of(n, args.empty) for n in (30, 300)})
    return out


def markdown(parts: dict) -> str:
    """One table for each part."""

    def number(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    lines = []
    for part, solvers in parts.items():
        lines += [
            f"\n{part} ({next(iter(solvers.values()))['of']})\n",
            "| | right | false | error median, largest arcsec | NEES mean, median | ms median, largest |",
            "|---|---|---|---|---|---|",
        ]
        for name, r in solvers.items():
            errors = ", ".join(filter(None, (number(r["arcsec_median"], ".1f"), number(r["arcsec_max"], ".0f"))))
            nees = ", ".join(filter(None, (number(r["nees_mean"], ".2f"), number(r["nees_median"], ".2f"))))
            ms = ", ".join(filter(None, (number(r["ms_median"], ".1f"), number(r["ms_max"], ".0f"))))
            lines.append(f"| {name} | {r['right']} | {r['false']} | {errors} | {nees} | {ms} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rivals", type=Path, required=True, metavar="VENV")
    parser.add_argument("--frames", type=Path, metavar="FOLDER")
    parser.add_argument("--lost", type=Path, metavar="FOLDER")
    parser.add_argument("--scenes", type=positive, default=100)
    parser.add_argument("--empty", type=positive, default=30, metavar="N", help="lists of each size in part random")
    parser.add_argument("--fields", type=float, nargs="+", default=[12.0, 20.0], metavar="DEG", help="of part lists")
    parser.add_argument("--rendered", type=positive, default=20, metavar="N")
    parser.add_argument("--timeout", type=float, default=1.0, metavar="S")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    python = args.rivals / "bin" / "python"
    if not python.exists():
        parser.error(f"--rivals {args.rivals}: has no bin/python; make it with `python -m venv`")
    if args.frames is not None and not (args.frames / "truth.csv").is_file():
        parser.error(f"--frames {args.frames}: has no truth.csv")
    if args.lost is not None and not (args.lost / "lost").is_file():
        parser.error(f"--lost {args.lost}: has no program `lost`; build it by its README")
    if not args.timeout > 0.0:
        parser.error(f"--timeout {args.timeout:g}: must be positive")
    names = {"tetra3rs": [], "tetra3rs fast": [], "tetra3rs, error 0.003": [], "cedar-solve": []} | (
        {"LOST": [str(args.lost)]} if args.lost else {}
    )
    solvers: dict[str, Solver] = {
        "helmstar": Helmstar(),
        "helmstar, fluxes unused": Helmstar(fluxes=False),
        "helmstar, optics kept": Helmstar(remember=True),
    }
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, rest in names.items():
                solvers[name] = Rival(name, python, rest, Path(folder))
            parts = measured(args, solvers)
            about = {name: s.first for name, s in solvers.items() if "," not in name and name != "tetra3rs fast"}
        finally:
            for s in solvers.values():
                s.close()
    if args.json:
        print(json.dumps({"python": sys.version.split()[0], "solvers": about, "parts": parts}))
        return
    for name, first in about.items():
        print(f"{name} {first['version']}: {first['about']}")
    print(markdown(parts))


if __name__ == "__main__":
    main()
