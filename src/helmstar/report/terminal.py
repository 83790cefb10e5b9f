"""Results on a terminal: short tables, for people. Programs read `--json`."""

from __future__ import annotations

from typing import Any


def _number(x: float | None, digits: int = 3) -> str:
    return "-" if x is None else f"{x:.{digits}g}"


def print_campaign(summary: dict[str, Any]) -> None:
    """One line for each estimator."""
    from rich.console import Console
    from rich.table import Table

    runs = summary["runs"]
    table = Table(title=f"{summary['scenario']}: {runs} runs, seed {summary['seed']}, {summary['wall_s']:.1f} s")
    table.add_column("estimator")
    last = list(next(iter(summary["estimators"].values()))["median_error_deg"])[-1]
    for head in (
        f"median error at {last}, deg",
        "below 1 deg",
        "by update",
        "diverged",
        "NEES (3)",
        "RMS / bound",
        "us/step",
    ):
        table.add_column(head, justify="right")
    for name, m in summary["estimators"].items():
        ratio = [v for v in m["rms_over_bound"] if v is not None]
        table.add_row(
            name,
            _number(m["median_error_deg"][last]),
            f"{m['converged']['1deg']['runs']}/{runs}",
            _number(m["converged"]["1deg"]["by"], 6),
            str(m["diverged"]),
            _number(m["nees_mean"]),
            _number(max(ratio) if ratio else None),
            _number(m["us_per_step"], 2),
        )
    Console().print(table)


def print_attitude(result: dict[str, Any]) -> None:
    """Drift, consistency and what was wrong with the rows."""
    drift, sigma = result["drift_arcsec_s"], result["drift_sigma_arcsec_s"]
    for axis, d, s in zip("xyz", drift, sigma, strict=True):
        print(f"drift {axis}: {_number(d, 6)} +- {_number(s, 2)} arcsec/s")
    print(f"mean NIS {_number(result['nis_mean'])} (3 when consistent), {result['updates']} updates")
    print(f"rows rejected: {result['rows_rejected']}, gaps: {len(result['gaps'])}")
    for p in result["problems"][:10]:
        print(f"  {p['file']}:{p['row']}: {p['message']} ({p['action']})")
    if len(result["problems"]) > 10:
        print(f"  and {len(result['problems']) - 10} more, listed in the report")
