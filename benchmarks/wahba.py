"""The Wahba solvers: microseconds for each solve on one core, and how far they are from truth and from the optimum.

    python benchmarks/wahba.py [--count 100000] [--references 200] [--solvers quest,svd] [--json]

Time: problems of four directions (two where a solver takes no more) with four different sigmas, CPU time of one core; JAX
compiled, in one call for all problems, and NumPy in one call; scipy and ahrs have no batches and loop over fewer.

Accuracy, in degrees: without noise against truth, with noise against the optimum in 40 digits (mpmath): directions all over
the sky, the same turned by exactly 180 deg, and close ones, within 0.01 deg. "naive ESOQ2" is how it is often written: Newton
from 1 instead of from the sum of the weights, no turned reference, no polishing.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from problem import angle, cpu_seconds, one_core, positive, quat_matrix, table

if TYPE_CHECKING:
    import numpy as np  # not before one_core has set the number of its threads

N = 4
"""Directions of a problem."""
SIGMA = 1e-4
"""Noise of the directions over the sky, rad."""
CLOSE = 0.01
"""Separation of close directions, deg. Their noise is a hundredth of it."""
KINDS = ("random", "180 deg", "close")
TWO = "quest_two"


class Problems(NamedTuple):
    """q_BN (count, 4), b and r (count, n, 3) unit directions, sigma (n,) rad."""

    q_BN: np.ndarray
    b: np.ndarray
    r: np.ndarray
    sigma: np.ndarray


def draw(kind: str, count: int, n: int, noise: bool, seed: int = 0) -> Problems:
    """Problems of one kind."""
    import numpy as np

    rng = np.random.default_rng(seed)

    def unit(v):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    q = unit(rng.normal(size=(count, 4)))
    if kind == "180 deg":
        q[:, 3] = 0.0
        q[: count // 2, :3] = np.eye(3)[rng.integers(0, 3, count // 2)]  # half of them about an axis of the frame
        q = unit(q)
    size = np.radians(CLOSE) if kind == "close" else 1.0
    if kind == "close":
        square = np.array([[1, 0, size / 2], [1, 0, -size / 2], [1, size / 2, 0], [1, -size / 2, 0]])[:n]
        r = unit(np.einsum("kij,nj->kni", quat_matrix(unit(rng.normal(size=(count, 4)))), square))
    else:
        r = unit(rng.normal(size=(count, n, 3)))
        r[:, 1] = unit(np.cross(r[:, 0], r[:, 1]))  # a pair at right angles: no problem is a bad one by chance
    b = np.einsum("kij,knj->kni", quat_matrix(q), r)
    sigma = (0.01 * size if kind == "close" else SIGMA) * np.array([1.0, 2.0, 0.5, 1.5])[:n]
    if noise:
        b = unit(b + sigma[:, None] * rng.normal(size=b.shape))
    return Problems(q, b, r, sigma)


def naive_esoq2(b, r, sigma):
    """q_BN (count, 4) by ESOQ2 with Newton from 1 though the weights have another sum; five steps."""
    import numpy as np

    a = 1e-8 / np.asarray(sigma) ** 2
    B = np.einsum("n,kni,knj->kij", a, b, r)
    s = np.trace(B, axis1=1, axis2=2)
    z = np.stack([B[:, 2, 1] - B[:, 1, 2], B[:, 0, 2] - B[:, 2, 0], B[:, 1, 0] - B[:, 0, 1]], axis=1)
    S = B + np.swapaxes(B, 1, 2)
    K = np.concatenate(
        [np.concatenate([S - s[:, None, None] * np.eye(3), z[:, :, None]], axis=2), np.zeros((len(b), 1, 4))], 1
    )
    K[:, 3, :3], K[:, 3, 3] = z, s
    p2, p3, p4 = (np.trace(np.linalg.matrix_power(K, m), axis1=1, axis2=2) for m in (2, 3, 4))
    lam = np.ones(len(b))  # the pitfall
    with np.errstate(all="ignore"):
        for _ in range(5):
            value = lam**4 - p2 / 2 * lam**2 - p3 / 3 * lam + (p2**2 / 8 - p4 / 4)
            lam = lam - value / (4 * lam**3 - p2 * lam - p3 / 3)
        f = (lam - s)[:, None, None]
        M = f * ((lam + s)[:, None, None] * np.eye(3) - S) - z[:, :, None] * z[:, None, :]
        rows = np.stack([np.cross(M[:, i], M[:, (i + 1) % 3]) for i in range(3)], axis=1)
        e = rows[np.arange(len(b)), np.argmax(np.sum(rows**2, axis=2), axis=1)]
        q = np.concatenate([f[:, 0] * e, np.sum(z * e, axis=1, keepdims=True)], axis=1)
        return q / np.linalg.norm(q, axis=1, keepdims=True)


def optimum(p: Problems):
    """q_BN (count, 4) of Davenport's K in 40 digits. Raises ImportError without mpmath."""
    import mpmath as mp
    import numpy as np

    out = []
    with mp.workdps(40):
        for b, r in zip(p.b, p.r):
            K = mp.zeros(4)
            for bi, ri, s in zip(b, r, p.sigma):
                x, y = (mp.matrix([mp.mpf(float(c)) for c in v]) for v in (bi, ri))
                x, y, a = x / mp.norm(x), y / mp.norm(y), (mp.mpf(SIGMA) / mp.mpf(float(s))) ** 2
                z = (y[1] * x[2] - y[2] * x[1], y[2] * x[0] - y[0] * x[2], y[0] * x[1] - y[1] * x[0])
                trace = sum(x[i] * y[i] for i in range(3))
                for i in range(3):
                    for j in range(3):
                        K[i, j] += a * (x[i] * y[j] + x[j] * y[i] - (trace if i == j else 0))
                    K[i, 3] += a * z[i]
                    K[3, i] += a * z[i]
                K[3, 3] += a * trace
            values, vectors = mp.eigsy(K)
            best = max(range(4), key=lambda i: values[i])
            out.append([float(vectors[i, best]) for i in range(4)])
    return np.array(out)


def outsiders() -> dict[str, Callable]:
    """Name to a function of one problem's (b, r, sigma) that gives q_BN; those of ahrs take two directions and no sigma."""
    from scipy.spatial.transform import Rotation

    found = {"scipy align_vectors": lambda b, r, s: Rotation.align_vectors(b, r, weights=s**-2)[0].as_quat()}
    try:
        from ahrs import filters
    except ImportError:
        return found
    for name in ("QUEST", "Davenport", "FAMC"):
        found[f"ahrs {name}"] = _ahrs(getattr(filters, name)())
    return found


def _ahrs(f) -> Callable:
    """A filter of ahrs with this problem's references. Its quaternion is scalar first, and the conjugate of q_BN."""
    import numpy as np

    f.w = np.array([0.5, 0.5])

    def call(b, r, s):
        f.g_q, f.m_q = r
        w, x, y, z = f.estimate(b[0], b[1])
        return np.array([-x, -y, -z, w])

    return call


def timings(names: list[str], count: int, loops: int, jax_too: bool = True) -> dict[str, dict[str, float | None]]:
    """Microseconds of CPU time for each solve, by name and by way: jax, numpy or loop."""
    import numpy as np

    from helmstar.attitude import SOLVERS

    problems = {n: draw("random", count, n, True) for n in (2, N)}
    out: dict[str, dict[str, float | None]] = {}
    for name in names:
        solver, p = SOLVERS[name], problems[2 if name == TWO else N]
        out[name] = {"numpy": 1e6 / count * cpu_seconds(lambda: solver(p.b, p.r, p.sigma), 3)}  # noqa: B023
        if not jax_too:
            continue
        from helmstar.backend import compile_program, jax, jnp

        arguments = [jnp.asarray(v) for v in (p.b, p.r, p.sigma)]
        begin = time.perf_counter()
        program = compile_program(jax.jit(solver).lower(*arguments))
        out[name]["compile_s"] = time.perf_counter() - begin
        jax.block_until_ready(program(*arguments))
        out[name]["jax"] = 1e6 / count * cpu_seconds(lambda: jax.block_until_ready(program(*arguments)), 7)  # noqa: B023
    p = problems[N]
    out["naive ESOQ2"] = {"numpy": 1e6 / count * cpu_seconds(lambda: naive_esoq2(p.b, p.r, p.sigma), 3)}
    for name, call in outsiders().items():
        p = problems[2 if name.startswith("ahrs") else N]
        some = list(zip(p.b[:loops], p.r[:loops]))
        seconds = cpu_seconds(lambda: [call(b, r, p.sigma) for b, r in some], 3)  # noqa: B023
        out[name] = {"loop": 1e6 / len(some) * seconds}
    assert np.all([v > 0 for row in out.values() for v in row.values()])
    return out


def accuracy(names: list[str], count: int, references: int) -> dict[str, dict[str, dict[str, float]]]:
    """Median and largest distance in degrees from truth without noise and from the optimum with noise, by name and kind."""
    import numpy as np

    from helmstar.attitude import SOLVERS

    out: dict[str, dict[str, dict[str, float]]] = {}
    others = outsiders()
    for kind in KINDS:
        for n in (N, 2):
            clean, noisy = draw(kind, count, n, False), draw(kind, references, n, True, seed=1)
            best = optimum(noisy)
            solvers = {m: f for m, f in SOLVERS.items() if m in names and (m == TWO) == (n == 2)}
            calls = {m: (lambda p, f=f: f(p.b, p.r, p.sigma).q_BN) for m, f in solvers.items()}
            if n == N:
                calls["naive ESOQ2"] = lambda p: naive_esoq2(p.b, p.r, p.sigma)
            for m, f in others.items():
                if m.startswith("ahrs") == (n == 2) and m != "ahrs FAMC":  # which knows one pair of references only
                    calls[m] = lambda p, f=f: np.array([f(b, r, p.sigma) for b, r in zip(p.b, p.r)])
            few = Problems(clean.q_BN[:references], clean.b[:references], clean.r[:references], clean.sigma)
            for name, call in calls.items():
                many = clean if name in solvers or name == "naive ESOQ2" else few
                weighted = not name.startswith("ahrs")  # without noise weights do not matter
                with np.errstate(all="ignore"):
                    truth = np.degrees(angle(call(many), many.q_BN))
                    far = np.degrees(angle(call(noisy), best)) if weighted else np.full(1, np.nan)
                out.setdefault(name, {})[kind] = {
                    "truth_median": float(np.median(truth)),
                    "truth_max": float(np.max(truth)),
                    "optimum_median": float(np.median(far)),
                    "optimum_max": float(np.max(far)),
                }
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=positive, default=100_000, help="problems in a batch")
    parser.add_argument("--loops", type=positive, default=2000, help="problems for those without batches")
    parser.add_argument("--references", type=positive, default=200, help="problems solved in 40 digits, of each kind")
    parser.add_argument("--solvers", help="names, comma separated (all)")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    one_core()
    from helmstar.attitude import SOLVERS

    names = args.solvers.split(",") if args.solvers else list(SOLVERS)
    if unknown := set(names) - set(SOLVERS):
        raise SystemExit(f"error: --solvers {', '.join(sorted(unknown))}: must be of {', '.join(SOLVERS)}")
    speed = timings(names, args.count, args.loops)
    digits = accuracy(names, min(args.count, 10_000), args.references)
    if args.json:
        print(json.dumps({"us": speed, "deg": digits}))
        return
    scipy = speed["scipy align_vectors"]["loop"]
    rows = []
    for name, t in speed.items():
        least = min(v for k, v in t.items() if k != "compile_s")
        cells = [f"{t[k]:.2f}" if k in t else "" for k in ("jax", "numpy", "loop")]
        rows.append([name, *cells, f"{scipy / least:.0f}", f"{t['compile_s']:.1f}" if "compile_s" in t else ""])
    print(table(["us for each solve", "JAX", "NumPy", "loop", "scipy over it", "compile s"], rows))
    for which, title in (("truth", "no noise: deg from truth"), ("optimum", "noise: deg from the optimum")):
        header = [title, *(f"{kind}, {m}" for kind in KINDS for m in ("median", "max"))]
        rows = []
        for name, kinds in digits.items():
            values = [kinds[kind][f"{which}_{m}"] for kind in KINDS for m in ("median", "max")]
            if values[0] == values[0]:
                rows.append([name, *(f"{v:.1e}" for v in values)])
        print("\n" + table(header, rows))


if __name__ == "__main__":
    main()
