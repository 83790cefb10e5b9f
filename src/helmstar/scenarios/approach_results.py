"""Results of the approach: the metrics of `--json`, and what the paper says of this phase, judged by them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..evaluate.consistency import chi_square_band
from .li2007_results import DIVERGED_KM, finite

if TYPE_CHECKING:
    from ..report.claims import Claim, Verdict

LAST_FRAMES = 6
"""The terminal tracking's last frames: with li2007's 120 of 10 s those from t = 1150 to 1200 s."""
LI2007_PRIOR_KM = (150.0, 8.0, 8.0)
LI2007_PRIOR_KM_S = 1e-4
MILESTONES_H = (960, 240, 72, 24, 6, 2)
"""Hours before closest approach at which `--json` and the report give what is known."""


def _list(x: Any) -> list[float | None]:
    return [finite(v) for v in np.ravel(x)]


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.asarray(x, float) ** 2, axis=0))


def milestones(dataset: Any) -> dict[str, int]:
    """Label (hours before closest approach) -> epoch at or next before it; the last is the hand-over."""
    before = dataset["before_h"].values
    out = {}
    for h in MILESTONES_H:
        at = np.flatnonzero(before >= h - 1e-9)
        if len(at) and before[-1] < h:
            out[f"{h} h"] = int(at[-1])
    return {**out, "hand-over": len(before) - 1}


def distribution(x: np.ndarray) -> dict[str, float | None]:
    """Mean, RMS and quantiles of one number per run."""
    if not np.isfinite(x).all():
        return dict.fromkeys(("mean", "rms", "q50", "q90", "q99"))
    q = np.quantile(x, [0.5, 0.9, 0.99])
    return {"mean": finite(x.mean()), "rms": finite(_rms(x)), **dict(zip(("q50", "q90", "q99"), map(float, q)))}


def summarise(dataset: Any) -> dict[str, dict]:
    """Metrics of each estimator; docs/approach.md explains the keys."""
    at = milestones(dataset)
    runs = dataset.sizes["run"]
    low, high = (v / 6.0 for v in chi_square_band(6, runs))
    out: dict[str, dict] = {}
    for name in map(str, dataset["estimator"].values):
        d = {k: v.values for k, v in dataset.sel(estimator=name).data_vars.items()}
        error, sigma = d["position_error_km"], d["position_sigma_km"]
        speed, speed_sigma = d["velocity_error_m_s"], d["velocity_sigma_m_s"]
        miss, burns = np.hypot(*d["delivery_km"].T), d["delta_v_m_s"]
        total = burns.sum(axis=1)
        nees = d["nees_per_state"].mean(axis=0)
        small = np.flatnonzero(np.sqrt(np.mean(sigma[..., 0] ** 2, axis=0)) <= LI2007_PRIOR_KM[0])
        seen = d["seen"] > 0
        out[name] = {
            "delivery_error_km": distribution(miss),
            "delivery_mean_km": _list(d["delivery_km"].mean(axis=0)),
            "delivery_sigma_km": _list(d["delivery_km"].std(axis=0, ddof=1)) if runs > 1 else [None, None],
            "delivery_time_rms_s": finite(_rms(d["delivery_time_s"])),
            "passage_error_rms_km": _list(_rms(d["passage_error_km"])),
            "passage_sigma_km": _list(_rms(d["passage_sigma_km"])),
            "passage_time_error_rms_s": finite(_rms(d["passage_time_error_s"])),
            "delta_v_m_s": {
                "mean": finite(total.mean()),
                "median": finite(np.median(total)),
                "q99": finite(np.quantile(total, 0.99)),
                "largest": finite(total.max()),
            },
            "manoeuvres": {
                f"{h:g} h": {
                    "burnt": int(np.sum(burns[:, i] > 0)),
                    "median_m_s": finite(np.median(burns[:, i])),
                    "q99_m_s": finite(np.quantile(burns[:, i], 0.99)),
                    "aimed_from_rms_km": _list(_rms(d["aimed_from_km"][:, i])),
                    "aimed_sigma_km": _list(_rms(d["aimed_sigma_km"][:, i])),
                }
                for i, h in enumerate(dataset["manoeuvre"].values)
            },
            "handover_error_km": {"rms": _list(_rms(error[:, -1])), "sigma": _list(_rms(sigma[:, -1]))},
            "handover_error_m_s": {"rms": _list(_rms(speed[:, -1])), "sigma": _list(_rms(speed_sigma[:, -1]))},
            "error_km": {
                k: {"rms": _list(_rms(error[:, i])), "sigma": _list(_rms(sigma[:, i]))} for k, i in at.items()
            },
            "ephemeris_error_km": {
                k: _list(_rms(d["ephemeris_error_km"][:, i])) for k, i in [("first_frame", 0), ("hand-over", -1)]
            },
            "bound_km": {k: _list(dataset["bound_km"].values[i]) for k, i in at.items()},
            "li2007_prior_from_h": finite(dataset["before_h"].values[small[0]]) if len(small) else None,
            "nees_per_state": finite(nees.mean()),
            "handover_nees_per_state": finite(nees[-1]),
            "nees_in_band_share": finite(np.mean((nees >= low) & (nees <= high))),
            "nis_per_dof": finite(np.sum(d["nis"][seen]) / (2.0 * seen.sum())) if seen.any() else None,
            "frames_used": finite(seen.sum(axis=1).mean()),
            "us_per_epoch": finite(dataset["us_per_step"].sel(estimator=name).values),
            **_terminal(d),
        }
    return out


def _terminal(d: dict[str, np.ndarray]) -> dict[str, Any]:
    """Of the terminal tracking, where there is one."""
    if "terminal_error_km" not in d:
        return {}
    last = d["terminal_error_km"][:, -LAST_FRAMES:]
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.sqrt((last**2).sum(axis=-1)).mean(axis=1)
    return {
        "terminal_last60_error_km": _list(np.abs(last).mean(axis=(0, 1))),
        "terminal_nees_per_state": finite(d["terminal_nees_per_state"].mean()),
        "terminal_diverged": int(np.sum(~(off <= DIVERGED_KM))),
    }


def _text(values: Any, unit: str = "km") -> str:
    return ", ".join("not finite" if v is None else f"{v:.3g}" for v in values) + f" {unit}"


def _number(x: float | None) -> str:
    return "not finite" if x is None else f"{x:.3g}"


def _claim(claim: str, source: str, found: str, more: str, bound: str, verdict: Verdict, why: str) -> Claim:
    from ..report.claims import Claim

    return Claim(claim, source, found, more, bound, verdict, why)


def claims(specification: Any, dataset: Any, summary: dict) -> list[Claim]:
    """What the paper says of the approach, as far as the estimators which ran can judge."""
    est = summary["estimators"]
    if "ekf" not in est:
        return []
    ekf = est["ekf"]
    out = [_knowledge(specification, est), _handover(ekf)]
    if {"no_manoeuvres", "no_frames"} & est.keys():
        out.insert(1, _delivery(est))
    if "terminal_last60_error_km" in ekf:
        out.append(_last_minutes(ekf, specification))
    return out


def _knowledge(spec: Any, est: dict) -> Claim:
    ekf = est["ekf"]
    first, end = ekf["ephemeris_error_km"]["first_frame"], ekf["handover_error_km"]["rms"]
    ok = all(e is not None and e < 0.1 * s for e, s in zip(end, spec.ephemeris.position_km, strict=True))
    return _claim(
        "Frames from 100 days on improve orbit and ephemeris; the ephemeris is about 1500 km off at first.",
        "Fig. 1",
        f"relative position, RMS at the hand-over: {_text(end)}",
        f"body from the Sun: {_text(first)} after the first frame, "
        f"{_text(ekf['ephemeris_error_km']['hand-over'])} at the hand-over",
        f"hand-over: {_text(ekf['bound_km']['hand-over'])}",
        "holds" if ok else "holds in part",
        "What frames show is the direction to the body: the relative orbit. The body's own orbit about the Sun becomes as good as "
        "the probe's is known, and along the line of sight only in the last hours.",
    )


def _delivery(est: dict) -> Claim:
    ekf = est["ekf"]["delivery_error_km"]
    others = {n: est[n]["delivery_error_km"]["rms"] for n in ("no_manoeuvres", "no_frames") if n in est}
    ok = ekf["rms"] is not None and all(v is None or ekf["rms"] < 0.1 * v for v in others.values())
    dv = est["ekf"]["delta_v_m_s"]
    return _claim(
        "Manoeuvres computed from them bring the probe to the start of the encounter.",
        "Fig. 1",
        f"miss of the aim {_number(ekf['rms'])} km RMS, {_number(ekf['q99'])} km in 99%; delta-v {_number(dv['mean'])} m/s, "
        f"{_number(dv['q99'])} m/s in 99%",
        "; ".join(f"{n} {v:.4g} km RMS" for n, v in others.items() if v is not None),
        "-",
        "holds" if ok else "does not hold",
        "The last manoeuvre decides: what is known when it is computed, and its own errors times the time that is left.",
    )


def _handover(ekf: dict) -> Claim:
    rms, sigma = ekf["handover_error_km"]["rms"], ekf["handover_error_km"]["sigma"]
    speed = ekf["handover_error_m_s"]["sigma"]
    whole = all(v is not None for v in (*rms, *sigma))
    ratio = [p / s if s else np.nan for p, s in zip(LI2007_PRIOR_KM, sigma, strict=True)] if whole else [np.nan] * 3
    near = all(0.5 <= v <= 2.0 for v in ratio)
    enough = all(v >= 1.0 for v in ratio)
    since = ekf["li2007_prior_from_h"]
    when = "never" if since is None else f"from {since:.3g} h before closest approach on"
    return _claim(
        "The terminal tracking starts 150, 8, 8 km and 1e-4 km/s per axis off.",
        "section 3",
        f"1 sigma at the hand-over {_text(sigma)}, RMS {_text(rms)}",
        f"velocity {_text([None if v is None else v * 1e-3 for v in speed], 'km/s')}; x is known to 150 km {when}",
        f"hand-over: {_text(ekf['bound_km']['hand-over'])}",
        "holds" if near else "holds in part" if enough else "does not hold",
        f"The prior is {ratio[0]:.0f}, {ratio[1]:.0f}, {ratio[2]:.0f} times wider than what these frames leave. Its 8 km across "
        "are a pointing error of 0.06 deg at 7200 km; here every frame has its attitude from stars. Its 150 km along the track are "
        "what is known where frames end an hour earlier.",
    )


def _last_minutes(ekf: dict, spec: Any) -> Claim:
    last = ekf["terminal_last60_error_km"]
    ok = all(v is not None for v in last) and ekf["terminal_diverged"] == 0
    return _claim(
        "The terminal tracking converges to 0.051, 0.192, 0.053 km.",
        "section 3, Table 1",
        f"{_text(last)} over the last frames; {ekf['terminal_diverged']} runs diverged",
        f"filter {spec.terminal.filter}, state position, velocity and pointing",
        f"NEES per state {ekf['terminal_nees_per_state'] or np.nan:.3g}",
        "holds"
        if ok and all(a <= 1.5 * b for a, b in zip(last, (0.0510, 0.1923, 0.0529), strict=True))
        else "holds in part",
        "From the hand-over's own estimate and covariance, and li2007's attitude reference, which is 0.1 deg off: what is known of "
        "y at the start also tells the roll that li2007 cannot see.",
    )
