"""Results of xu2020: the metrics of `--json`, and the paper's claims judged by them."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np

from ..evaluate import arrival, diverged

if TYPE_CHECKING:
    from ..report.claims import Claim, Verdict

CHECKPOINTS = (150, 600, 1000)
WINDOW = (200, 600)
"""Updates, both included, over which RMS, NEES and the ratio to the bound are pooled."""
LIMITS_DEG = {"1deg": 1.0, "0.1deg": 0.1}
DIVERGED_DEG = 10.0
START_UP = 150
"""Updates of the paper's start-up transient: fewer judge no claim."""
_EXPERIMENT = (
    "step_s", "truth.attitude", "truth.rate_amplitude_rad_s", "truth.rate_frequency_rad_s", "star.directions",
    "start.error_deg",
)  # fmt: skip
_LIE = ("tuning.p0", "tuning.q_w", "tuning.sigma_v")
_QUATERNION = ("tuning.quaternion_p0", "tuning.quaternion_q", "tuning.quaternion_sigma_v")
"""Keys that the paper states: its claims are judged only where all that they depend on are as in the library's file."""


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


def _share(count: int, runs: int) -> str:
    return "every run" if count == runs else f"{count or 'none'} of {runs} runs"


def _times(values: Any, others: Any) -> str:
    """Ratios of two lists that may hold None."""
    return _text([a / b if a is not None and b else np.nan for a, b in zip(values, others, strict=True)], "")


def _verdict(printed: bool | None, consistent: bool | None) -> Verdict:
    """Of what the printed and the consistent equations do; None was not run, and leaves a part open."""
    if printed and consistent:
        return "holds"
    return "holds in part" if printed or consistent else "does not hold"


def departures(specification: Any) -> list[str]:
    """Keys that the paper states and whose value here is another."""
    from .specification import library

    paper, here = tomllib.loads(library()["xu2020"]), specification.model_dump()
    return [k for k in (*_EXPERIMENT, *_LIE, *_QUATERNION) if not _same(_at(paper, k), _at(here, k))]


def _at(content: Any, key: str) -> Any:
    """Value of a dotted key; None where it is left out."""
    for part in key.split("."):
        content = None if content is None else content.get(part)
    return content


def _same(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-9, atol=1e-12))


class _Judge:
    """The figures of a campaign, and whether it is the paper's experiment as far as a claim depends on it."""

    def __init__(self, specification: Any, dataset: Any, summary: dict):
        self.est: dict[str, dict] = summary["estimators"]
        self.runs: int = summary["runs"]
        self.updates = int(dataset.sizes["time"])
        self.mark = str(START_UP if self.updates >= START_UP else self.updates)
        bound = np.degrees(dataset["bound_rad"].values)[int(self.mark) - 1]
        self.bound = f"1 sigma x, y, z {_text(bound)} at update {self.mark}"
        self.changed = departures(specification)

    def claim(
        self, claim: str, source: str, printed: str, consistent: str, bound: str, verdict: Verdict, why: str,
        keys: tuple[str, ...], of_paper: str = "",
    ) -> Claim:  # fmt: skip
        """The claim with its verdict, or "measured" where the experiment is not the paper's. `why` follows from the figures
        alone; `of_paper` is true of the paper's experiment and left out of others."""
        from ..report.claims import Claim

        changed = [k for k in self.changed if k in (*_EXPERIMENT, *keys)]
        short = self.updates < START_UP
        if changed:
            why = f"Not the paper's experiment, so not judged: {', '.join(changed)}. {why}"
        elif short:
            why = f"Too short to judge: {self.updates} updates, the start-up takes {START_UP}. {why}"
        else:
            why = f"{why} {of_paper}".strip()
        return Claim(claim, source, printed, consistent, bound, "measured" if changed or short else verdict, why)

    def rms(self, name: str) -> str:
        return f"RMS x, y, z {_text(self._rms(name))}" if name in self.est else "not run"

    def _rms(self, name: str) -> list[float]:
        return [np.inf if v is None else v for v in self.est[name]["rms_deg"][self.mark]]

    def within(self, name: str, limit_deg: float) -> bool | None:
        """Is the RMS of every axis at the mark below the limit? None: not run."""
        return max(self._rms(name)) <= limit_deg if name in self.est else None

    def below(self, name: str) -> int | None:
        """Runs that go below 1 deg and stay; None: not run."""
        return self.est[name]["converged"]["1deg"]["runs"] if name in self.est else None

    def converges(self, name: str) -> bool | None:
        count = self.below(name)
        return None if count is None else count == self.runs

    def arrivals(self) -> str:
        """How many runs of the printed and the consistent form go below 1 deg and stay, as a sentence."""
        forms = {"the printed equations": self.below("lie_printed"), "the consistent form": self.below("lie")}
        said = [f"{_share(n, self.runs)} with {form}" for form, n in forms.items() if n is not None]
        text = "; ".join(said)
        return f"Below 1 deg for good: {text}."


def claims(specification: Any, dataset: Any, summary: dict) -> list[Claim]:
    """Every claim of the paper that the estimators which ran can judge, with the figures of this campaign.

    A claim is judged only where the specification has what the paper states (start, stars, truth, tuning) and there are
    updates enough; elsewhere its figures are "measured" and the explanation names what differs.
    """
    j = _Judge(specification, dataset, summary)
    est = j.est
    out = []
    if "lie" in est or "lie_printed" in est:
        out.append(_accuracy(j))
        out.append(_convergence(j))
    if "quaternion_ekf" in est:
        out.append(_quaternion(j))
    if "lie" in est and "static_svd" in est and est["lie"]["rms_over_bound"][0] is not None:
        out.append(_static(j))
    if "lie" in est:
        out.append(_noise(j))
    return out


def _accuracy(j: _Judge) -> Claim:
    return j.claim(
        "The filter on SO(3) reaches 0.005 deg after 150 updates.",
        "section 4, Fig. 3",
        j.rms("lie_printed"),
        j.rms("lie"),
        j.bound,
        _verdict(j.within("lie_printed", 0.005), j.within("lie", 0.005)),
        "Equations (26), (27) and (30) mix frames: with the update on the right the innovation must be X^T l - r, in inertial "
        f"axes. {j.arrivals()}",
        _LIE,
        "Update 150 is about where the start-up transient of this tuning ends.",
    )


def _convergence(j: _Judge) -> Claim:
    return j.claim(
        "The filter on SO(3) converges from X0 = I, about 120 deg from the truth.",
        "section 4, (39)",
        _arrival_text(j.est["lie_printed"], j.runs) if "lie_printed" in j.est else "not run",
        _arrival_text(j.est["lie"], j.runs) if "lie" in j.est else "not run",
        "-",
        _verdict(j.converges("lie_printed"), j.converges("lie")),
        j.arrivals(),
        _LIE,
    )


def _quaternion(j: _Judge) -> Claim:
    q, one = j.est["quaternion_ekf"], j.est.get("quaternion_ekf_one_star")
    verdict = "does not hold" if q["diverged"] == 0 else "holds" if q["diverged"] == j.runs else "holds in part"
    why = f"With both stars {_share(q['diverged'], j.runs)} diverged (above {DIVERGED_DEG:g} deg at the end)."
    if "lie" in j.est:
        ratio = _times(q["rms_deg"][j.mark], j.est["lie"]["rms_deg"][j.mark])
        why += f" Its RMS is {ratio} times the consistent SO(3) filter's at update {j.mark}."
    of_paper = "Euler angles fake errors too: the truth lies at their gimbal lock, -90 deg."
    if one:
        why += f" With the first star alone, about which a turn is not observable, {_share(one['diverged'], j.runs)} diverged."
        x, y, z = j._rms("quaternion_ekf_one_star")
        if x > 3.0 * max(y, z):
            of_paper = f"Its x error stands out, which makes one star the likely cause of Fig. 4. {of_paper}"
    return j.claim(
        "The quaternion EKF's x error diverges.",
        "section 4, Fig. 4",
        f"two stars: {j.rms('quaternion_ekf')}; {q['diverged']}/{j.runs} diverged",
        "one star only: "
        + (f"{j.rms('quaternion_ekf_one_star')}; {one['diverged']}/{j.runs} diverged" if one else "not run"),
        j.bound,
        verdict,
        why,
        _QUATERNION,
        of_paper,
    )


def _static(j: _Judge) -> Claim:
    lie, static, tuned = j.est["lie"], j.est["static_svd"], j.est.get("lie_tuned")
    best = f"tuned {_text(tuned['rms_over_bound'], '')} x the bound" if tuned else "tuned: not run"
    tuning = "changed tuning" if set(_LIE) & set(j.changed) else "paper's tuning"
    pairs = list(zip(lie["rms_over_bound"], static["rms_over_bound"], strict=True))
    better = [a is not None and (b is None or a < b) for a, b in pairs]
    return j.claim(
        "Filtering is more accurate than a static solution of each epoch.",
        "section 4, comparison with the q-method and SVD",
        f"static SVD {_text(static['rms_over_bound'], '')} x the bound",
        f"{tuning} {_text(lie['rms_over_bound'], '')} x the bound; {best}",
        f"updates {WINDOW[0]} to {WINDOW[1]}, x, y, z",
        "holds" if all(better) else "holds in part" if any(better) else "does not hold",
        f"The filter's RMS is {_times(lie['rms_over_bound'], static['rms_over_bound'])} times the static solution's"
        + (": the gyro carries information from epoch to epoch." if all(better) else "."),
        _LIE,
    )


def _noise(j: _Judge) -> Claim:
    nees, tuned = j.est["lie"]["nees_mean"], j.est.get("lie_tuned")
    consistent = nees is not None and 2.0 < nees < 4.0
    why = "The simulated noise is not stated in the paper."
    if nees is not None and nees > 0:
        factor = np.sqrt(3.0 / nees)
        size = f"{factor:.3g} times too large" if factor > 1 else f"{1 / factor:.3g} times too small"
        why += " For the noise of this scenario the filter's covariance is " + (
            "consistent." if consistent else f"{size} in sigma."
        )
    why += (
        " The gain, which is what matters for the error, depends on the ratio of Q_w to Q_v only once P0 is forgotten."
    )
    return j.claim(
        "P0 = 5 I, Q_w = 5e-5 I and Q_v = 0.125^2 I describe the noise.",
        "(40)-(42)",
        f"mean NEES of 3 states {_text(nees, '')}" if nees is not None else "not finite",
        f"mean NEES tuned {_text(tuned['nees_mean'], '')}"
        if tuned and tuned["nees_mean"] is not None
        else "tuned: not run or not finite",
        "3 when consistent",
        "does not hold" if nees is not None and not consistent else "measured",
        why,
        _LIE,
    )
