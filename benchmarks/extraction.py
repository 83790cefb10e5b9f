"""Time of star extraction on rendered frames: `python benchmarks/extraction.py`; beside sep where that is installed.

"the next frame" knows the optics from the one before, "in 50 windows" also where stars are expected. At the end a whole
solution, from the image to the attitude, by stages.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable

import numpy as np

from helmstar.imaging import Camera, DetectionSettings, Image, detect
from helmstar.imaging.detect import detect_near, detect_next
from helmstar.imaging.render import Exposure, render
from helmstar.sensors.star_tracker import StarTracker
from helmstar.stars import load_catalog


def frame(width: int, height: int, stars: int, bits: int) -> Image:
    """A rendered sky with hot pixels and a gradient."""
    rng = np.random.default_rng(0)
    camera = Camera.from_fov(12.0, width, height)
    d = camera.directions(rng.uniform([5, 5], [width - 6, height - 6], (stars, 2)))
    gain = 5.0 if bits > 8 else 40.0
    e = Exposure(bits=bits, gain_e=gain, hot_fraction=1e-3, gradient_e_px=(0.05, 0.05), sky_e_s=200.0, offset=5.0)
    return render(camera, np.array([0.0, 0.0, 0.0, 1.0]), d, rng.uniform(2.0, 6.5, stars), e)[0]


def timed(call: Callable[[], object], repeats: int) -> list[float]:
    """Least wall, median wall, least CPU time of a call, ms."""
    call()
    wall, cpu = [], []
    for _ in range(repeats):
        w, c = time.perf_counter(), time.process_time()
        call()
        cpu.append(time.process_time() - c)
        wall.append(time.perf_counter() - w)
    return [1e3 * x for x in (min(wall), float(np.median(wall)), min(cpu))]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=50)
    repeats = parser.parse_args().repeats
    try:
        sep = importlib.import_module("sep")
    except ImportError:
        sep = None
    print(f"{'frame':28s} {'what':22s} {'stars':>5s} {'least ms':>9s} {'median ms':>9s} {'cpu ms':>7s}")
    for width, height, bits in ((1024, 768, 8), (1024, 768, 12), (1392, 1040, 8), (2048, 2048, 12)):
        image = frame(width, height, 80, bits)
        name = f"{width} x {height}, {bits} bit"
        for what, settings in (("detect", DetectionSettings()), ("detect, 30 stars", DetectionSettings(max_stars=30))):
            count = len(detect(image, settings))
            print(
                f"{name:28s} {what:22s} {count:5d} "
                + "{:9.2f} {:9.2f} {:7.2f}".format(*timed(lambda s=settings, i=image: detect(i, s), repeats))
            )
        _, optics = detect_next(image)
        if optics is not None:
            places = detect(image).xy_px[:50]
            calls = {
                "the next frame": lambda i=image, o=optics: detect_next(i, optics=o),
                "in 50 windows": lambda i=image, o=optics, p=places: detect_near(i, p, 5.0, o),
            }
            for what, call in calls.items():
                print(f"{name:28s} {what:22s} {'':5s} " + "{:9.2f} {:9.2f} {:7.2f}".format(*timed(call, repeats)))
        if sep is not None:
            array = image.array.astype(np.float32)

            def extract(a: np.ndarray = array) -> np.ndarray:
                sky = sep.Background(a)
                return sep.extract(a - sky.back(), 5.0, err=sky.globalrms)

            print(
                f"{name:28s} {'sep, no fit':22s} {len(extract()):5d} "
                + "{:9.2f} {:9.2f} {:7.2f}".format(*timed(extract, repeats))
            )


def solutions(repeats: int) -> None:
    """From image to attitude, 1024 x 768 with 8 bits, by stages: without a prior and tracking."""
    camera, catalog = Camera.from_fov(12.0, 1024, 768), load_catalog(8.5)
    q = np.array([0.2, -0.5, 0.4, 0.7]) / np.sqrt(0.94)
    exposure = Exposure(bits=8, gain_e=10.0, offset=5.0)
    image, _ = render(camera, q, catalog.directions(), catalog.magnitude, exposure, 1)
    print("\nimage to attitude, ms, least (median)")
    for stars in (100, 40):
        tracker = StarTracker(camera, detection=DetectionSettings(max_stars=stars))
        for what, prior in (("full sky", {}), ("tracking", {"prior_q_SN": q, "prior_sigma": 1e-4})):
            tracker.solve(image)
            runs = [tracker.solve(image, **prior) for _ in range(repeats)]
            stages = {k: [r.ms[k] for r in runs] for k in runs[0].ms}
            said = ", ".join(f"{k} {min(v):.2f} ({np.median(v):.2f})" for k, v in stages.items())
            print(f"{what}, at most {stars} stars: {len(runs[0].identification.stars)} matched; {said}")


if __name__ == "__main__":
    main()
    solutions(50)
