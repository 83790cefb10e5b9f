"""Latency of one streaming step of the 6-state MEKF: median and 99th percentile in microseconds, on one core.

python benchmarks/latency.py [--steps 3000] [--json]
"""

from __future__ import annotations

import argparse
import json
import time

from problem import DT, P0, R_N, SIGMA, SIGMA_U, SIGMA_V, one_core, positive, simulate, table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=positive, default=3000)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    one_core()
    import numpy as np

    from helmstar.backend import jnp
    from helmstar.core import Gaussian, Measurement, chi_square_gate
    from helmstar.filters import ErrorStateKalmanFilter
    from helmstar.filters.stream import Stream
    from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model
    from helmstar.models.sensors import star_directions

    p = simulate(1, args.steps)
    model = attitude_drift_model(
        GyroNoise(jnp.asarray(SIGMA_V), jnp.asarray(SIGMA_U)), sensors=(star_directions(SIGMA),)
    )
    start = Gaussian(AttitudeDrift(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)), P0 * np.eye(6))
    extra, mask = np.zeros((3, 3)), np.ones(2, dtype=bool)

    def inputs(k: int):
        return GyroInput(p.u[0, k], extra), (Measurement(p.z[0, k], R_N, mask),)

    filter = ErrorStateKalmanFilter(model.retraction)
    stream = Stream(filter, model, start, *inputs(0), chi_square_gate(1e-6))
    clock = time.perf_counter
    full, flat = np.empty(args.steps), np.empty(args.steps)
    for k in range(args.steps):
        u, m = inputs(k)
        begin = clock()
        stream.step(u, DT, m)
        full[k] = clock() - begin
    packed = [stream.pack(inputs(k)[0], DT, inputs(k)[1]).copy() for k in range(args.steps)]
    state = Stream(filter, model, start, *inputs(0), chi_square_gate(1e-6)).state
    for k in range(args.steps):
        begin = clock()
        state, _ = stream.step_flat(state, packed[k])
        state = np.asarray(state)
        flat[k] = clock() - begin
    cases = {"helmstar Stream.step_flat": flat, "helmstar Stream.step, packing included": full}
    try:
        from compiled_c import CReference

        cases["C through ctypes (about 1 us is the call)"] = CReference().step_seconds(p)
    except RuntimeError as error:
        print(f"without C: {error}")
    try:
        from mekf import filterpy_seconds

        cases["filterpy (mean)"] = np.full(100, filterpy_seconds(p, min(500, args.steps)) / min(500, args.steps))
    except ImportError:
        pass
    skip = args.steps // 10  # the first steps warm caches
    out = {
        name: {"median_us": float(1e6 * np.median(s[skip:])), "p99_us": float(1e6 * np.percentile(s[skip:], 99))}
        for name, s in cases.items()
        if len(s[skip:])
    } or {}
    if args.json:
        print(json.dumps(out))
        return
    rows = [[name, f"{v['median_us']:.1f}", f"{v['p99_us']:.1f}"] for name, v in out.items()]
    print(table(["one step", "median us", "99 % us"], rows))


if __name__ == "__main__":
    main()
