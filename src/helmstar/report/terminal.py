"""Results on a terminal: short tables, for people. Programs read `--json`."""

from __future__ import annotations

from typing import Any


def _number(x: float | None, digits: int = 3) -> str:
    return "-" if x is None else f"{x:.{digits}g}"


def print_campaign(summary: dict[str, Any]) -> None:
    """One line for each estimator, at most 88 columns."""
    if any("drift_rms_deg_h" in m for m in summary["estimators"].values()):
        return _print_attitude_and_drift(summary)
    if any("delivery_error_km" in m for m in summary["estimators"].values()):
        return _print_approach(summary)
    if any("last60_error_km" in m for m in summary["estimators"].values()):
        return _print_position(summary)
    runs = summary["runs"]
    last = list(next(iter(summary["estimators"].values()))["median_error_deg"])[-1]
    print(f"{summary['scenario']}: {runs} runs, seed {summary['seed']}, {summary['wall_s']:.1f} s")
    heads = ("estimator", "median deg", "< 1 deg", "by", "diverged", "NEES/3", "/ bound")
    widths = (30, 11, 9, 6, 9, 8, 8)
    print("".join(h.ljust(w) if i == 0 else h.rjust(w) for i, (h, w) in enumerate(zip(heads, widths, strict=True))))
    for name, m in summary["estimators"].items():
        ratio = [v for v in m["rms_over_bound"] if v is not None]
        nees = m["nees_mean"]
        row = (
            name,
            _number(m["median_error_deg"][last]),
            f"{m['converged']['1deg']['runs']}/{runs}",
            _number(m["converged"]["1deg"]["by"], 6),
            str(m["diverged"]),
            _number(None if nees is None else nees / 3.0, 2),
            _number(max(ratio) if ratio else None),
        )
        print("".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))))
    print(f"median deg: total error at update {last}; by: update from which all runs stay below 1 deg;")
    print("NEES/3: 1 when consistent; / bound: largest RMS over the Cramer-Rao bound;")
    print("both over updates 200 to 600")


def _print_attitude_and_drift(summary: dict[str, Any]) -> None:
    runs = summary["runs"]
    print(f"{summary['scenario']}: {runs} runs, seed {summary['seed']}, {summary['wall_s']:.1f} s")
    heads = ("estimator", "attitude deg", "drift deg/h", "NEES/6", "signs", "loss deg", "179 deg")
    widths = (20, 14, 13, 9, 8, 11, 10)
    print(
        "".join(
            h.ljust(w) if i == 0 else h.rjust(w) for i, (h, w) in enumerate(zip(heads, widths, strict=True))
        ).rstrip()
    )
    for name, m in summary["estimators"].items():
        attitude, drift = ([v for v in m[k] if v is not None] for k in ("attitude_rms_deg", "drift_rms_deg_h"))
        case = m["recovery_s"].get("start_179deg") or {}
        row = (
            name,
            _number(max(attitude, default=None)),
            _number(max(drift, default=None)),
            _number(None if m["nees_mean"] is None else m["nees_mean"] / 6.0),
            str(m["sign_errors"]),
            _number(m["outage_peak_deg"].get("hold_mean")),
            f"{case['converged']}/{case['runs']}" if case and name != "smoother" else "-",
        )
        print("".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))))
    print("attitude, drift: RMS of the last 1000 s, worst axis; NEES/6: 1 when consistent;")
    print("signs: updates with the wrong sign; loss: median peak error, gyro lost for a minute, mean held;")
    print("179 deg: runs that recover from a start so far off within 300 s")


def _print_position(summary: dict[str, Any]) -> None:
    runs = summary["runs"]
    print(f"{summary['scenario']}: {runs} runs, seed {summary['seed']}, {summary['wall_s']:.1f} s")
    heads = ("estimator", "mean x", "y", "z km", "last 60 s x", "y", "z km", "NEES/n", "diverged")
    widths = (31, 8, 7, 7, 12, 7, 7, 8, 9)
    print("".join(h.ljust(w) if i == 0 else h.rjust(w) for i, (h, w) in enumerate(zip(heads, widths, strict=True))))
    for name, m in summary["estimators"].items():
        values = (*m["mean_error_km"], *m["last60_error_km"], m["nees_per_state"])
        row = (name, *(_number(v) for v in values), str(m["diverged"]))
        print("".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))))
    print("mean: |truth - estimate| over runs and frames; NEES/n: 1 when consistent;")
    print("diverged: runs more than 5 km off over the last 60 s")


def _print_approach(summary: dict[str, Any]) -> None:
    print(f"{summary['scenario']}: {summary['runs']} runs, seed {summary['seed']}, {summary['wall_s']:.1f} s")
    heads = ("estimator", "miss km", "99%", "dv m/s", "99%", "end x", "y", "z km", "NEES/6")
    widths = (22, 10, 10, 7, 7, 9, 9, 9, 8)
    print("".join(h.ljust(w) if i == 0 else h.rjust(w) for i, (h, w) in enumerate(zip(heads, widths, strict=True))))
    for name, m in summary["estimators"].items():
        miss, dv = m["delivery_error_km"], m["delta_v_m_s"]
        values = (miss["rms"], miss["q99"], dv["mean"], dv["q99"], *m["handover_error_km"]["rms"], m["nees_per_state"])
        row = (name, *(_number(v) for v in values))
        print("".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))))
    print("miss: of the aim in the target plane, RMS; dv: delta-v of a run, mean;")
    print("end: error of the relative position at the last frame, RMS; NEES/6: 1 when consistent")


def print_attitude(result: dict[str, Any]) -> None:
    """Drift, consistency and what was wrong with the rows."""
    frames = result.get("frames")
    if frames:
        others = ", ".join(f"{n} {what}" for what, n in frames["status"].items() if what != "solved")
        print(
            f"frames: {frames['status'].get('solved', 0)} of {frames['total']} solved"
            + (f"; {others}" if others else "")
        )
    for name, unit in (("drift", "arcsec/s"), ("rate", "deg/s")):
        key = unit.replace("/", "_")
        value, sigma = result.get(f"{name}_{key}"), result.get(f"{name}_sigma_{key}")
        for axis, v, s in zip("xyz", value or (), sigma or ()):
            print(f"{name} {axis}: {_number(v, 6)} +- {_number(s, 2)} {unit}")
    for name, c in (result.get("calibration") or {}).items():
        unit = name.rsplit("_", 1)[1]
        for axis, v, e, before in zip("xyz", c["value"], c["sigma"], c["sigma_before"], strict=True):
            text = (
                f"{_number(v, 6)} +- {_number(e, 2)} {unit}"
                if v is not None
                else f"not shown by this record (+- {_number(before, 3)} {unit})"
            )
            print(f"{name.removesuffix('_' + unit).replace('_', ' ')} {axis}: {text}")
    print(f"mean NIS {_number(result['nis_mean'])} (3 when consistent), {result['updates']} updates")
    print(f"rows rejected: {result['rows_rejected']}, gaps: {len(result['gaps'])}")
    for p in result["problems"][:10]:
        print(f"  {p['file']}:{p['row']}: {p['message']} ({p['action']})")
    if len(result["problems"]) > 10:
        print(f"  and {len(result['problems']) - 10} more, listed in the report")
