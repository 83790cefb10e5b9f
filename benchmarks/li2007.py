"""The unscented particle filter of 200 particles over li2007's whole arc: seconds, beside scalar C; and each filter's time.

    python benchmarks/li2007.py                  100 runs, one core each
    python benchmarks/li2007.py --runs 20 --json

C (upf.c, gcc -O3 -march=native) does the same filter on the same measurements with its own random numbers, so errors agree within
those of two draws, not to the bit.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
_Doubles = ctypes.POINTER(ctypes.c_double)


def library() -> ctypes.CDLL | None:
    """upf.c, compiled; None without gcc."""
    gcc = shutil.which("gcc")
    if gcc is None:
        return None
    out = HERE / "build" / "upf.so"
    out.parent.mkdir(exist_ok=True)
    part = out.with_suffix(f".{os.getpid()}.part")
    subprocess.run(
        [gcc, "-O3", "-march=native", "-shared", "-fPIC", "-o", str(part), str(HERE / "upf.c"), "-lm"], check=True
    )
    os.replace(part, out)
    return ctypes.CDLL(str(out))


def in_c(experiment: Any, data: Any, n: int) -> tuple[np.ndarray, float]:
    """Estimated positions (runs, steps, 3) in m, and seconds."""
    lib = library()
    if lib is None:
        raise SystemExit("gcc is not on the PATH: the C reference cannot be compiled")
    s = experiment.spec
    arrays = [np.ascontiguousarray(a, float) for a in (data.z, data.R_CB, data.start)]
    runs, steps = arrays[0].shape[:2]
    alpha, beta, kappa = s.tuning.ukf_alpha, s.tuning.ukf_beta, s.tuning.ukf_kappa
    scale = alpha**2 * (6 + kappa)
    wm0 = (scale - 6) / scale
    out = np.zeros((runs, steps, 3))
    d, p = ctypes.c_double, lambda a: np.ascontiguousarray(a, float).ctypes.data_as(_Doubles)
    held = [np.ascontiguousarray(a, float) for a in (experiment.v, experiment.q_ref, experiment.P0)]
    begin = time.perf_counter()
    lib.run(
        runs, steps, n, d(s.step_s), d(s.camera.focal_px), d(0.5 * s.camera.size_px), d(s.camera.sigma_px), d(scale), d(wm0),
        d(wm0 + 1 - alpha**2 + beta), d(0.5 / scale), p(held[0]), d(experiment.mean_r), d(experiment.sigma_r**2),
        d(experiment.sigma_q**2 * s.step_s), p(held[1]), p(held[2]), d(s.tuning.kernel), *map(p, arrays), p(out),
    )  # fmt: skip
    return out, time.perf_counter() - begin


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="a multiple of 20 (default: 100)")
    parser.add_argument("--estimators", default="ekf,ukf,gsf,upf,rbpf,pf,rpf,upf_printed,batch")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    from helmstar.backend import jax, jnp
    from helmstar.campaign.engine import Engine
    from helmstar.scenarios.specification import build, load

    experiment = build(*load("li2007"))
    names = args.estimators.split(",")
    engine = Engine(experiment, names)
    print("compiling", file=sys.stderr)
    engine.compile(2)
    width, steps = experiment.width, experiment.steps
    blocks = max(1, args.runs // width)
    seconds, errors = dict.fromkeys(names, 0.0), {n: [] for n in names}
    engine.compute(0)  # once for warmth
    for i in range(blocks):
        b = engine.compute(i)
        for n in names:
            seconds[n] += b.seconds[n]
            errors[n].append(np.abs(b.arrays[n]["position_error_km"]).mean(axis=(0, 1)))
        print(f"block {i + 1} of {blocks}", file=sys.stderr)
    runs = blocks * width
    data = experiment.simulate.function(*experiment.simulate.arguments, jnp.arange(runs))
    n = experiment.spec.tuning.unscented_particles
    found, c_seconds = in_c(experiment, jax.tree.map(np.asarray, data), n)
    c_error = np.abs(np.asarray(data.r) - found).mean(axis=(0, 1)) / 1e3
    result = {
        "runs": runs,
        "particles": n,
        "c_seconds": c_seconds,
        "c_mean_error_km": c_error.tolist(),
        "estimators": {
            k: {
                "seconds": v,
                "us_per_update": 1e6 * v / (runs * steps),
                "mean_error_km": np.mean(errors[k], axis=0).tolist(),
                "over_ekf": v / seconds["ekf"] if "ekf" in seconds else None,
                "over_c_upf": v / c_seconds,
            }
            for k, v in seconds.items()
        },
    }
    if args.json:
        print(json.dumps(result))
        return 0
    print(f"{runs} runs x {steps} updates, one core; scalar C does the UPF of {n} particles in {c_seconds:.2f} s,")
    print(f"mean error {', '.join(f'{v:.3g}' for v in c_error)} km")
    print(f"{'estimator':<14}{'seconds':>9}{'us/update':>11}{'/ EKF':>8}{'/ C UPF':>9}   mean error x, y, z km")
    for k, m in result["estimators"].items():
        error = ", ".join(f"{v:.3g}" for v in m["mean_error_km"])
        print(
            f"{k:<14}{m['seconds']:>9.2f}{m['us_per_update']:>11.1f}{m['over_ekf'] or 0:>8.1f}{m['over_c_upf']:>9.2f}   {error}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
