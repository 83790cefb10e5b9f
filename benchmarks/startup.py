"""Start-up and first-run times: wall seconds of whole commands, cold and warm compilation cache.

python benchmarks/startup.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from problem import table


def seconds(argv: list[str], cache: str | None = None, repeats: int = 1) -> float:
    """Least wall seconds of a command over the repeats. Raises SystemExit when it fails."""
    environment = dict(os.environ) | ({} if cache is None else {"HELMSTAR_CACHE_DIR": cache})
    best = float("inf")
    for _ in range(repeats):
        begin = time.perf_counter()
        done = subprocess.run(argv, env=environment, capture_output=True, text=True)
        best = min(best, time.perf_counter() - begin)
        if done.returncode:
            raise SystemExit(f"error: {' '.join(argv)} failed: {done.stderr.strip().splitlines()[-1:]}")
    return best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    helmstar = str(Path(sys.executable).with_name("helmstar"))
    out = {
        "python -c pass": seconds([sys.executable, "-c", "pass"], repeats=5),
        "helmstar --help": seconds([helmstar, "--help"], repeats=5),
        "helmstar scenarios": seconds([helmstar, "scenarios"], repeats=3),
    }
    with tempfile.TemporaryDirectory() as folder:
        cache, results = str(Path(folder) / "cache"), str(Path(folder) / "out")
        three = [helmstar, "run", "xu2020", "--estimators", "lie,mekf,quaternion_ekf", "--out", results, "--json"]
        out["run xu2020, 3 estimators, cold cache"] = seconds(three, cache)
        out["run xu2020, 3 estimators, warm cache"] = seconds(three, cache, repeats=3)
        everything = [helmstar, "run", "xu2020", "--out", results, "--json"]
        out["run xu2020, all 15 estimators, the other programs cold"] = seconds(everything, cache)
        out["run xu2020, all 15 estimators, warm cache"] = seconds(everything, cache, repeats=2)
    if args.json:
        print(json.dumps(out))
        return
    print(table(["", "wall s"], [[name, f"{s:.2f}"] for name, s in out.items()]))


if __name__ == "__main__":
    main()
