"""The 6-state MEKF with two stars a step: CPU time of one core, as ratios to scalar C in this run.

    python benchmarks/mekf.py [--runs 1000] [--steps 1000] [--json]

First C and helmstar must give the same attitudes and NIS on the same inputs. filterpy and ahrs have no batches and no
attitude error state with drift; what stands in for them is said in the table, and they run fewer steps, scaled by number.
"""

from __future__ import annotations

import argparse
import json
import time

from problem import (
    DT,
    P0,
    R_N,
    SIGMA,
    SIGMA_U,
    SIGMA_V,
    Problem,
    angle,
    cpu_seconds,
    one_core,
    positive,
    simulate,
    table,
)

BATCHES = (25, 50, 100, 250, 500, 1000)


def helmstar_program(width: int, steps: int):
    """Compiled batch of runs, and seconds to trace and to compile it."""
    from helmstar.backend import compile_program, jax, jnp
    from helmstar.core import Gaussian, Measurement, no_gate
    from helmstar.filters import ErrorStateKalmanFilter, run
    from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model
    from helmstar.models.sensors import star_directions

    noise = GyroNoise(jnp.asarray(SIGMA_V), jnp.asarray(SIGMA_U))
    model = attitude_drift_model(noise, sensors=(star_directions(SIGMA),))
    filter = ErrorStateKalmanFilter(model.retraction)
    start = Gaussian(AttitudeDrift(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3)), P0 * jnp.eye(6))
    r = jnp.broadcast_to(jnp.asarray(R_N), (steps, 2, 3))

    def one(u, z):
        inputs = GyroInput(u, jnp.zeros((steps, 3, 3)))
        m = Measurement(z, r, jnp.ones((steps, 2), dtype=bool))
        keep = lambda b, p, i: (b.mean.q_BN, i[0].nis)
        return run(filter, model, start, inputs, jnp.full(steps, DT), (m,), no_gate(8), keep=keep)[2]

    shape = (jax.ShapeDtypeStruct((width, steps, 3), float), jax.ShapeDtypeStruct((width, steps, 2, 3), float))
    begin = time.perf_counter()
    lowered = jax.jit(jax.vmap(one)).lower(*shape)
    middle = time.perf_counter()
    return compile_program(lowered), middle - begin, time.perf_counter() - middle


def filterpy_seconds(p: Problem, steps: int) -> float:
    """CPU seconds of `steps` steps: filterpy's ExtendedKalmanFilter on the 6 error states, the attitude beside it."""
    import numpy as np
    from filterpy.kalman import ExtendedKalmanFilter
    from problem import quat_exp, quat_matrix, quat_multiply

    def hat(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    f = ExtendedKalmanFilter(dim_x=6, dim_z=6)
    f.P, f.R = P0 * np.eye(6), SIGMA**2 * np.eye(6)
    Q = np.zeros((6, 6))
    Q[:3, :3] = (SIGMA_V**2 * DT + SIGMA_U**2 * DT**3 / 3) * np.eye(3)
    Q[:3, 3:] = Q[3:, :3] = 0.5 * SIGMA_U**2 * DT**2 * np.eye(3)
    Q[3:, 3:] = SIGMA_U**2 * DT * np.eye(3)
    f.Q = Q
    q, b = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    begin = time.process_time()
    for k in range(steps):
        phi = -(p.u[0, k] - b) * DT
        q = quat_multiply(quat_exp(phi), q)
        F = np.eye(6)
        F[:3, :3] = quat_matrix(quat_exp(phi))
        F[:3, 3:] = DT * np.eye(3)
        f.F, f.x = F, np.zeros(6)
        f.predict()
        m = R_N @ quat_matrix(q).T
        H = np.zeros((6, 6))
        H[:3, :3], H[3:, :3] = -hat(m[0]), -hat(m[1])
        f.update((p.z[0, k] - m).reshape(6), HJacobian=lambda x, H=H: H, Hx=lambda x: np.zeros(6))
        q = quat_multiply(quat_exp(f.x[:3]), q)
        b = b + f.x[3:]
    return time.process_time() - begin


def ahrs_seconds(p: Problem, steps: int) -> float:
    """CPU seconds of `steps` steps of ahrs's EKF: 4 states, no drift, two reference directions (accelerometer, magnetometer)."""
    import numpy as np
    from ahrs.filters import EKF

    f = EKF(frequency=1.0 / DT, frame="ENU")
    f.mag = p.z[0, :, 1]  # says that there is a second direction
    q = np.array([1.0, 0.0, 0.0, 0.0])
    begin = time.process_time()
    for k in range(steps):
        q = f.update(q, p.u[0, k], p.z[0, k, 0], p.z[0, k, 1])
    return time.process_time() - begin


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=positive, default=1000)
    parser.add_argument("--steps", type=positive, default=1000)
    parser.add_argument("--repeats", type=positive, default=5)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    one_core()
    import numpy as np
    from compiled_c import CReference, NoCompiler

    try:
        c = CReference()
    except NoCompiler as error:
        raise SystemExit(f"error: {error}") from None
    p = simulate(args.runs, args.steps)
    per = 1e6 / (args.runs * args.steps)
    q_c, nis_c = c.run(p)
    c_us = per * cpu_seconds(lambda: c.run(p), args.repeats)
    rows = [["C, gcc -O3 -march=native, one run after the other", f"{c_us:.2f}", "1.00", ""]]
    out = {"c_us": c_us, "helmstar": {}, "runs": args.runs, "steps": args.steps}

    from helmstar.backend import jax, jnp

    u, z = jnp.asarray(p.u), jnp.asarray(p.z)
    for width in [b for b in BATCHES if args.runs % b == 0]:
        program, traced, compiled = helmstar_program(width, args.steps)
        parts = [(u[i : i + width], z[i : i + width]) for i in range(0, args.runs, width)]

        def everything(program=program, parts=parts):
            return [jax.block_until_ready(program(*part)) for part in parts]

        result = everything()
        q = np.concatenate([np.asarray(r[0]) for r in result])
        nis = np.concatenate([np.asarray(r[1]) for r in result])
        off, off_nis = float(np.max(angle(q, q_c))), float(np.max(np.abs(nis - nis_c) / (1.0 + nis_c)))
        if not (off < 1e-9 and off_nis < 1e-6):
            raise SystemExit(f"error: C and helmstar differ by {off:.1e} rad and {off_nis:.1e} in NIS")
        us = per * cpu_seconds(everything, args.repeats)
        out["helmstar"][str(width)] = {
            "us": us, "ratio": us / c_us, "trace_s": traced, "compile_s": compiled, "rad_from_c": off, "nis_from_c": off_nis,
        }  # fmt: skip
        rows.append(
            [f"helmstar, batches of {width}", f"{us:.2f}", f"{us / c_us:.2f}", f"{traced:.1f} + {compiled:.1f} s"]
        )
    best = min(v["us"] for v in out["helmstar"].values())
    few = min(1000, args.steps)
    for name, seconds in (
        ("filterpy, EKF around the same equations", filterpy_seconds),
        ("ahrs, EKF without drift", ahrs_seconds),
    ):
        try:
            us = 1e6 * min(seconds(p, few) for _ in range(3)) / few
        except ImportError:
            rows.append([name, "not installed", "", 'pip install "helmstar[benchmarks]"'])
            continue
        out[name.split(",")[0]] = {"us": us, "ratio": us / c_us, "over_helmstar": us / best}
        rows.append([name, f"{us:.1f}", f"{us / c_us:.0f}", f"{us / best:.0f} x helmstar's best"])
    if args.json:
        print(json.dumps(out))
        return
    worst = max(v["rad_from_c"] for v in out["helmstar"].values())
    print(f"{args.runs} runs x {args.steps} steps; C and helmstar agree within {worst:.1e} rad")
    print(table(["", "us per run-step", "over C", "trace + compile"], rows))


if __name__ == "__main__":
    main()
