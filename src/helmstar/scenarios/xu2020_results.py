"""Results of xu2020: the metrics of `--json`, and the paper's claims judged by them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..evaluate import arrival, diverged

CHECKPOINTS = (150, 600, 1000)
WINDOW = (200, 600)
"""Updates, both included, over which RMS, NEES and the ratio to the bound are pooled."""
LIMITS_DEG = {"1deg": 1.0, "0.1deg": 0.1}
DIVERGED_DEG = 10.0


def finite(x: Any) -> float | None:
    """A number for JSON: None where it is not finite."""
    x = float(x)
    return x if np.isfinite(x) else None


def rms(x: np.ndarray, axis: Any) -> np.ndarray:
    """Root mean square over the axes."""
    return np.sqrt(np.mean(np.square(x), axis=axis))


def summarise(dataset: Any) -> dict[str, dict]:
    """Metrics of each estimator; see README for the keys. A metric that the campaign is too short for is None or absent."""
    updates = dataset["update"].values
    marks = [k for k in CHECKPOINTS if k <= updates[-1]] or [int(updates[-1])]
    window = (updates >= WINDOW[0]) & (updates <= WINDOW[1])
    bound = rms(dataset["bound_rad"].values[window], 0) if window.any() else np.full(3, np.nan)
    out: dict[str, dict] = {}
    for name in map(str, dataset["estimator"].values):
        e = dataset["error_rad"].sel(estimator=name).values
        angle = np.degrees(np.linalg.norm(e, axis=-1))
        at = {str(k): int(k) - 1 for k in marks}
        pooled = rms(e[:, window], (0, 1)) if window.any() else np.full(3, np.nan)
        nees = dataset["nees"].sel(estimator=name).values[:, window].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = pooled / bound
        out[name] = {
            "rms_deg": {k: [finite(v) for v in np.degrees(rms(e[:, i], 0))] for k, i in at.items()},
            "median_error_deg": {k: finite(np.median(angle[:, i])) for k, i in at.items()},
            "converged": {
                key: {"runs": a.runs, "by": a.by}
                for key, a in ((key, arrival(angle, limit)) for key, limit in LIMITS_DEG.items())
            },
            "diverged": diverged(angle[:, -1], DIVERGED_DEG),
            "nees_mean": finite(nees.mean()) if nees.size else None,
            "rms_over_bound": [finite(v) for v in ratio],
            "us_per_step": finite(dataset["us_per_step"].sel(estimator=name).values),
        }
    return out


def _text(values: Any, unit: str = "deg", digits: int = 3) -> str:
    numbers = np.atleast_1d(np.asarray(values, float))
    return ", ".join(f"{v:.{digits}g}" if np.isfinite(v) else "not finite" for v in numbers) + f" {unit}".rstrip()


def _arrival_text(metrics: dict, runs: int) -> str:
    one, tenth = metrics["converged"]["1deg"], metrics["converged"]["0.1deg"]
    by = [f" by update {a['by']}" if a["by"] else "" for a in (one, tenth)]
    return f"{one['runs']}/{runs} below 1 deg{by[0]}; {tenth['runs']}/{runs} below 0.1 deg{by[1]}"


def claims(dataset: Any, summary: dict) -> list:
    """Every claim of the paper that the estimators which ran can judge, with the figures of this campaign."""
    from ..report.claims import Claim

    est = summary["estimators"]
    runs = summary["runs"]
    bound = np.degrees(dataset["bound_rad"].values)
    mark = "150" if dataset.sizes["time"] >= 150 else str(dataset.sizes["time"])
    at_bound = _text(bound[int(mark) - 1])
    out = []

    def rms_of(name: str, key: str = mark) -> str:
        return f"RMS x, y, z {_text(est[name]['rms_deg'][key])}" if name in est else "not run"

    if "lie" in est or "lie_printed" in est:
        fits = "lie" in est and est["lie"]["median_error_deg"][mark] is not None
        holds = fits and max(v or np.inf for v in est["lie"]["rms_deg"][mark]) <= 0.005
        printed_fails = "lie_printed" in est and est["lie_printed"]["converged"]["1deg"]["runs"] < runs
        out.append(
            Claim(
                "The filter on SO(3) reaches 0.005 deg after 150 updates.",
                "section 4, Fig. 3",
                rms_of("lie_printed"),
                rms_of("lie"),
                f"1 sigma x, y, z {at_bound} at update {mark}",
                "does not hold"
                if not holds
                else "holds in part"
                if printed_fails or "lie_printed" not in est
                else "holds",
                "Update 150 is where the start-up transient ends. Equations (26), (27) and (30) mix frames: with the update on "
                "the right the innovation must be X^T l - r, in inertial axes. As printed the error does not come below 1 deg.",
            )
        )
        out.append(
            Claim(
                "The filter on SO(3) converges from X0 = I, about 120 deg from the truth.",
                "section 4, (39)",
                _arrival_text(est["lie_printed"], runs) if "lie_printed" in est else "not run",
                _arrival_text(est["lie"], runs) if "lie" in est else "not run",
                "-",
                "does not hold"
                if "lie" not in est or est["lie"]["converged"]["1deg"]["runs"] < runs
                else "holds in part",
                "Convergence holds for the consistent equations alone.",
            )
        )
    if "quaternion_ekf" in est:
        q, one = est["quaternion_ekf"], est.get("quaternion_ekf_one_star")
        out.append(
            Claim(
                "The quaternion EKF's x error diverges.",
                "section 4, Fig. 4",
                f"two stars: {rms_of('quaternion_ekf')}; {q['diverged']}/{runs} diverged",
                "one star only: "
                + (f"{rms_of('quaternion_ekf_one_star')}; {one['diverged']}/{runs} diverged" if one else "not run"),
                f"1 sigma x, y, z {at_bound} at update {mark}",
                "does not hold" if q["diverged"] == 0 else "holds in part",
                "With both stars it converges like the filter on SO(3). With the star along x alone, the turn about x is not "
                "observable: the likely cause of Fig. 4. An Euler-angle plot fakes errors too, by its gimbal lock at -90 deg.",
            )
        )
    if "lie" in est and "static_svd" in est and est["lie"]["rms_over_bound"][0] is not None:
        tuned = est.get("lie_tuned")
        best = f"tuned {_text(tuned['rms_over_bound'], '')} x the bound" if tuned else "tuned: not run"
        out.append(
            Claim(
                "Filtering is more accurate than a static solution of each epoch.",
                "section 4, comparison with the q-method and SVD",
                f"static SVD {_text(est['static_svd']['rms_over_bound'], '')} x the bound",
                f"paper's tuning {_text(est['lie']['rms_over_bound'], '')} x the bound; {best}",
                "updates 200 to 600, x, y, z",
                "holds"
                if max(v or np.inf for v in est["lie"]["rms_over_bound"]) < min(est["static_svd"]["rms_over_bound"])
                else "does not hold",
                "The gyro carries information from epoch to epoch.",
            )
        )
    if "lie" in est:
        nees, tuned = est["lie"]["nees_mean"], est.get("lie_tuned")
        out.append(
            Claim(
                "P0 = 5 I, Q_w = 5e-5 I and Q_v = 0.125^2 I describe the noise.",
                "(40)-(42)",
                f"mean NEES of 3 states {_text(nees, '')}" if nees is not None else "not finite",
                f"mean NEES tuned {_text(tuned['nees_mean'], '')}"
                if tuned and tuned["nees_mean"]
                else "tuned: not run",
                "3 when consistent",
                "does not hold" if nees is not None and not 2.0 < nees < 4.0 else "measured",
                "The simulated noise is not stated in the paper; for the noise of this scenario the printed covariance is far "
                "from it. The gain, which is what matters for the error, depends on the ratio of Q_w to Q_v only.",
            )
        )
    return out
