"""The bars of zhou2021 at full strength: 100 runs of each case, beside what was measured. Exit code 1 when one fails.

python benchmarks/zhou2021.py [--runs N] [--cases B D fov slew yaw] [--set KEY=VALUE] [--json]

| case | what is asked |
|---|---|
| B | two heads, sigma 0.002 rad, ARW 0.003, RRW 0.003 |
| D | two heads, sigma 0.002 deg, ARW 0.01, RRW 0.03 |
| fov | B with the widest pair of one head of 20 deg: R must be the solver's covariance |
| slew, yaw | B with other attitude profiles: the sign rule makes no error |

The NEES band 5.34 to 6.70 is the 95% band of 600 degrees of freedom: it is meant for 100 runs. Fewer runs are a try of the program.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from problem import table

from helmstar.campaign.runner import run_campaign
from helmstar.scenarios.specification import build, load, parse_set

RUNS = 100
NEES = (5.34, 6.70)
RIGHT = ("quest_ekf", "mekf", "mekf_reset", "iekf", "usque", "mekf_rate_state")
"""Filters with the right R."""
GYRO = RIGHT[:-1]
"""Of these the ones to which a gyro loss is bridged."""
CASES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "B": ({}, (*RIGHT, "quest_ekf_unsigned")),
    "D": ({"star.reading": "D", "gyro.arw_deg_sqrt_h": 0.01, "gyro.rrw_deg_h_sqrt_h": 0.03}, RIGHT),
    "fov": ({"star.geometry": "fov"}, ("quest_ekf", "quest_ekf_isotropic")),
    "slew": ({"attitude.profile": "slew"}, ("quest_ekf",)),
    "yaw": ({"attitude.profile": "yaw"}, ("quest_ekf",)),
}
LIMITS = {"B": (0.0042, 0.010, 0.009), "D": (0.0008, 0.024, 0.0025)}
"""Attitude RMS (deg), drift RMS (deg/h), peak of a gyro loss with the mean held (deg)."""


@dataclass(frozen=True)
class Bar:
    """One line of the table: `measured` is None where the campaign was too short to have it, which is not ok."""

    case: str
    estimator: str
    what: str
    bar: str
    measured: float | None
    ok: bool


def measure(case: str, runs: int, keys: dict[str, Any]) -> dict[str, dict]:
    """Metrics of one case."""
    own, names = CASES[case]
    name, spec = load("zhou2021", {**own, **keys, "runs": runs})
    with tempfile.TemporaryDirectory() as folder:
        return run_campaign(
            build(name, spec), runs=runs, seed=spec.seed, folder=Path(folder) / case, estimators=names, progress=False,
            specification=spec.model_dump(mode="json"), configuration="", command="benchmarks/zhou2021.py",
        ).summary["estimators"]  # fmt: skip


def worst(values: Sequence[float | None]) -> float | None:
    """Of three axes; None where a filter diverged to no number."""
    numbers = [v for v in values if v is not None]
    return max(numbers) if len(numbers) == len(values) else None


def bars(case: str, metrics: dict[str, dict]) -> list[Bar]:
    """All bars of one case, judged."""
    out = []

    def bar(name: str, what: str, text: str, value: float | None, test: Callable[[float], bool]) -> None:
        out.append(Bar(case, name, what, text, value, value is not None and test(value)))

    def at_most(name: str, what: str, limit: float, value: float | None) -> None:
        bar(name, what, f"<= {limit:g}", value, lambda v: v <= limit)

    def above(name: str, what: str, limit: float, value: float | None) -> None:
        bar(name, what, f"> {limit:g}", value, lambda v: v > limit)

    for name in (n for n in RIGHT if n in metrics):
        m = metrics[name]
        if case in LIMITS:
            at_most(name, "attitude RMS, deg", LIMITS[case][0], worst(m["attitude_rms_deg"]))
            at_most(name, "drift RMS, deg/h", LIMITS[case][1], worst(m["drift_rms_deg_h"]))
        bar(name, "mean NEES", f"{NEES[0]:.2f} to {NEES[1]:.2f}", m["nees_mean"], lambda v: NEES[0] <= v <= NEES[1])
        if case in LIMITS and name in GYRO:
            at_most(name, "gyro loss, mean held, deg", LIMITS[case][2], m["outage_peak_deg"].get("hold_mean"))
    at_most("quest_ekf", "wrong signs", 0, metrics["quest_ekf"]["sign_errors"])
    if "mekf_reset" in metrics:
        cases = metrics["mekf_reset"]["recovery_s"]
        for start in ("start_179deg_1000deg_h", "upset_90deg"):
            found = cases.get(start, {"converged": None, "runs": 0, "median": None})
            all_of = found["runs"]
            bar("mekf_reset", f"{start}, runs", f"all {all_of}", found["converged"], lambda v, n=all_of: v == n)
            at_most("mekf_reset", f"{start}, s", 40, found["median"])
    # Controls: these must be bad.
    if case == "B":
        above("quest_ekf_unsigned", "attitude RMS, deg", 1, worst(metrics["quest_ekf_unsigned"]["attitude_rms_deg"]))
    if case == "D":
        for name in (n for n in GYRO if n != "mekf_reset"):  # which restarts during the loss
            above(name, "gyro loss, zeros, deg", 0.3, metrics[name]["outage_peak_deg"].get("zeros"))
    if case == "fov":
        above("quest_ekf_isotropic", "mean NEES", 10, metrics["quest_ekf_isotropic"]["nees_mean"])
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, and say by the exit code whether all bars are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any key of the scenario")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    keys = parse_set(args.set)
    found = []
    for case in args.cases:
        print(f"{case}: {args.runs} runs", file=sys.stderr, flush=True)
        found += bars(case, measure(case, args.runs, keys))
    good = all(b.ok for b in found)
    if args.json:
        print(json.dumps({"runs": args.runs, "ok": good, "bars": [vars(b) for b in found]}, allow_nan=False))
    else:
        print(
            table(
                ["case, estimator", "", "bar", "measured", "ok"],
                [
                    [f"{b.case} {b.estimator}", b.what, b.bar, "-" if b.measured is None else f"{b.measured:.4g}",
                     "yes" if b.ok else "NO"]
                    for b in found
                ],
            )
        )  # fmt: skip
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
