"""From a record's rows to its estimates: screen, find the start, find the noise, filter forward, smooth backward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core import ACCEPTED, FORCED, RESET, Gate, chi_square_gate, no_gate
from ..errors import ConfigurationError, DataError
from ..io.problems import Kind, Problem, for_one, refuse
from ..io.screening import screen_gyro
from ..io.telemetry import AttitudeRows, GyroRows, Telemetry, to_rates
from ..progress import Progress
from ..sensors.configuration import SensorsConfiguration
from ..units import ARCSEC
from .calibration import Calibration, corrected, in_gyro_axes, observed, rough_calibration
from .estimate import Design, Estimates, Record, Start, Updates, filter_and_smooth, final_sigma
from .loss import with_policy
from .noise import ENOUGH, NAMES, NoiseLevels, estimate_noise, rough_levels
from .rates import RateSignal, rate_signal
from .series import bring_back
from .stars import direction_epochs
from .start import DIFFUSE, Beginning, find_beginning
from .timeline import Epochs, Timeline, attitude_epochs, build_timeline, reachable

FROM_ATTITUDES = "first two attitudes minus the gyro"
NOT_USED = "not used"
"""Action on rows that are good but of no use here: neither rejected nor an error when reading is strict."""


@dataclass(frozen=True)
class Solution:
    """All that was estimated of one record. `gyro`: the rows that were used; `used` (m,): the epochs that entered;
    `sources`: where each noise level and the start's drift and its sigma are from; `rate_sigma`: of a record without gyro, the
    random walk of its rate, rad/s/sqrt(s)."""

    gyro: GyroRows
    timeline: Timeline
    epochs: Epochs
    used: np.ndarray
    filtered: Estimates
    smoothed: Estimates
    updates: Updates
    levels: NoiseLevels
    sources: dict[str, str]
    start: Start
    problems: tuple[Problem, ...]
    gate: Gate
    calibration: Calibration | None = None
    rate_sigma: float | None = None


def solve(
    telemetry: Telemetry, sensors: SensorsConfiguration, strict: bool = False, progress: bool = False
) -> Solution:
    """Filter and smooth a record, read with the time offsets of `sensors`.

    Raises DataError when the rows do not suffice, or, with `strict`, when one of them is bad; ConfigurationError when
    `sensors` speaks of what the rows cannot have; ValueError when the record
    was read with other time offsets.
    """
    if not len(telemetry.gyro) and len(telemetry.attitude):
        from .attitude_only import solve_attitudes

        return solve_attitudes(telemetry, sensors, strict, progress)
    if telemetry.offsets != sensors.time_offsets:
        raise ValueError(
            f"the record was read with {telemetry.offsets}, the configuration says {sensors.time_offsets}: give "
            "read_telemetry(..., offsets=sensors.time_offsets)"
        )
    try:
        return _solve(telemetry, sensors, strict, progress)
    except (np.linalg.LinAlgError, FloatingPointError, OverflowError) as error:
        raise DataError(
            f"{', '.join(telemetry.gyro.files)}: the numbers cannot be computed with ({error}); check the times for jumps, "
            "the units of times and rates, and the noise in sensors.toml"
        ) from error


def _solve(telemetry: Telemetry, sensors: SensorsConfiguration, strict: bool, progress: bool) -> Solution:
    problems = list(telemetry.problems)

    def check() -> None:
        if strict:
            refuse(problems)

    with Progress(progress) as bar:
        task = bar.add("reading", 1)
        gyro, signal, epochs = _inputs(telemetry, sensors, problems)
        check()
        epochs = _within(signal, epochs, problems)
        bar.finish(task)
        task = bar.add("start and noise", 1)
        gate = the_gate(sensors)
        measured = telemetry.attitude.covariance is not None
        ready, calibration = _calibrated(signal, epochs, sensors, gate, measured)
        problems += ready.problems
        record, epochs = ready.record, ready.record.epochs
        bar.finish(task)
        task = bar.add("filter and smoother", 2 * record.chunks)
        filtered, smoothed, updates = filter_and_smooth(record, ready.start, gate, lambda: bar.advance(task))
        bar.finish(task)
    if not all(np.isfinite(x).all() for e in (filtered, smoothed) for x in (e.q_BN, e.drift, e.cov)):
        raise DataError("the filter did not stay finite; check the noise in sensors.toml against the data's units")
    filtered, smoothed = (_doubted(e, updates) for e in (filtered, smoothed))
    problems += problems_of(record.timeline, epochs, updates, gate)
    if updates.gyro_refused:
        message = f"{updates.gyro_refused} steps whose gyro rate does not fit the rate as a state; see rate_sigma_deg_s"
        problems.append(Problem(gyro.files[0], int(gyro.row[0]), "jump", message, "dropped", updates.gyro_refused))
    check()
    if calibration is not None:
        filtered, smoothed = (in_gyro_axes(e, calibration.rough) for e in (filtered, smoothed))
    return Solution(
        gyro, record.timeline, epochs, record.used, filtered, smoothed, updates, record.levels, ready.sources,
        ready.start, tuple(problems), gate, calibration,
    )  # fmt: skip


@dataclass(frozen=True)
class _Ready:
    """What the filter is given, where its numbers come from, and what was wrong with the attitudes."""

    record: Record
    start: Start
    sources: dict[str, str]
    problems: list[Problem]


def _ready(
    signal: RateSignal, epochs: Epochs, sensors: SensorsConfiguration, gate: Gate, measured: bool,
    considered: tuple[int, ...] = (),
) -> _Ready:  # fmt: skip
    """Start, noise and timeline of a record; `measured`: whether attitudes have covariances of their own; `considered`: numbers
    of a calibration that are not estimated."""
    problems: list[Problem] = []
    signal = with_policy(signal, sensors.gyro)
    epochs, used, beginning, levels, sources = _begin(signal, epochs, sensors, gate, problems, measured)
    timeline = build_timeline(signal, epochs)
    start, start_sources = _start(sensors, epochs, levels, beginning, timeline, used)
    record = Record(timeline, epochs, levels, used, _design(sensors, timeline, considered))
    return _Ready(record, start, sources | start_sources, problems)


def _calibrated(
    signal: RateSignal, epochs: Epochs, sensors: SensorsConfiguration, gate: Gate, measured: bool
) -> tuple[_Ready, Calibration | None]:
    """The record made ready. Of a calibration first the bound, with all of its numbers unknown; what the record then shows
    is estimated, and the rest counts as uncertainty."""
    prior = sensors.calibrate.sigma
    if not prior.any():
        return _ready(signal, epochs, sensors, gate, measured), None
    rough = rough_calibration(signal, epochs, prior)
    ready = _ready(corrected(signal, rough), epochs, sensors, gate, measured)
    bound = final_sigma(ready.record, ready.start)[6:]
    shown = observed(prior, bound)
    if not np.array_equal(shown, prior > 0.0):
        rough = np.where(shown, rough, 0.0)
        rest = tuple(int(i) for i in np.flatnonzero((prior > 0.0) & ~shown))
        ready = _ready(corrected(signal, rough), epochs, sensors, gate, measured, rest)
    return ready, Calibration(prior, rough, bound, shown)


def _design(sensors: SensorsConfiguration, timeline: Timeline, considered: tuple[int, ...]) -> Design:
    """Which states are estimated, as the configuration asks; `considered` as for `_ready`."""
    rated = sensors.gyro.loss_policy == "rate_state"
    rate_sigma = 0.0
    if rated:
        given, shown = sensors.gyro.rate_sigma_deg_s, _liveliness(timeline)
        rate_sigma = shown if given is None else float(np.radians(given))
        if rate_sigma < 0.2 * shown:
            raise ConfigurationError(
                f"[gyro] rate_sigma_deg_s = {given:g}: the record's rate changes by up to {np.degrees(shown):.3g} "
                "deg/s/sqrt(s), which a random walk so small takes for bad gyro rows; give at least a fifth of that, or "
                "leave it out"
            )
    return Design(
        states="calibration" if sensors.calibrate.sigma.any() else "rate" if rated else "drift",
        calibration=sensors.calibrate.sigma,
        considered=considered,
        rate_sigma=rate_sigma,
        restart=float(np.radians(sensors.filter.restart_drift_sigma_deg_h) / 3600.0)
        if sensors.filter.restart
        else None,
        commanded=sensors.gyro.loss_policy == "commanded",
    )


def _liveliness(timeline: Timeline) -> float:
    """Random walk of the rate, rad/s/sqrt(s), that is as large as the fastest of the changes that the record shows: a
    smaller one would take a slew for bad gyro rows."""
    dt = np.diff(timeline.time)
    clean = ~(timeline.lost[1:] | timeline.lost[:-1]) & (dt[1:] > 0.0) & (dt[:-1] > 0.0)
    change = np.linalg.norm(np.diff(timeline.rate, axis=0), axis=1)[clean] / np.sqrt(dt[1:][clean])
    return float(np.max(change, initial=1e-6))


def the_gate(sensors: SensorsConfiguration) -> Gate:
    """The filter's gate; a probability of 0 refuses nothing."""
    f = sensors.filter
    return chi_square_gate(f.gate_probability, reopen_after=f.reopen_after) if f.gate_probability else no_gate()


def _inputs(
    telemetry: Telemetry, sensors: SensorsConfiguration, problems: list[Problem]
) -> tuple[GyroRows, RateSignal, Epochs]:
    """Gyro rows, their rate signal and star epochs on one clock, with bad rows screened out."""
    gyro, attitude, directions = telemetry.gyro, telemetry.attitude, telemetry.directions
    if len(attitude):
        if directions is not None:
            message = "star directions are not used beside whole attitudes"
            problems.append(
                Problem(directions.files[0], int(directions.row[0]), "unused", message, NOT_USED, len(directions))
            )
        epochs = attitude_epochs(attitude, measured_shape(attitude, sensors))
    elif directions is not None:
        _refuse_axes(sensors)
        sigma_S = sensors.star.sigma_S
        epochs, found = direction_epochs(
            directions, None if sigma_S is None else float(sigma_S[0]), sensors.filter.gate_probability
        )
        problems += found
    else:
        raise DataError("no usable attitude or star row; give q_bn_x, _y, _z, _w or star_b_x ... with star_n_x ...")
    whole = epochs.select(epochs.solved)
    arbiter = AttitudeRows(whole.time, whole.file, whole.row, whole.files, whole.q_BN)
    gyro, found = screen_gyro(gyro, arbiter, sensors.gyro.reading)
    problems += found
    if len(gyro) < 2:
        name = ", ".join(gyro.files) or "telemetry"
        raise DataError(f"{name}: {len(gyro)} usable gyro rows; at least 2 are needed{for_one(found)}")
    rates, reading = to_rates(gyro, sensors.gyro.reading)
    increments = gyro.quantity == "increment" or sensors.gyro.reading == "increment_rad"
    return gyro, rate_signal(rates.time, rates.value, rates.step, reading, increments), epochs


def measured_shape(attitude: AttitudeRows, sensors: SensorsConfiguration) -> np.ndarray:
    """Covariance (3, 3) or (n, 3, 3) of attitudes in B: what the configuration states, else the rows' own, in rad^2; else the
    identity, in units of a sigma that the data have to tell."""
    stated = sensors.star.covariance_B()
    if stated is not None:
        return stated
    return np.eye(3) if attitude.covariance is None else attitude.covariance


def _refuse_axes(sensors: SensorsConfiguration) -> None:
    """Raise a ConfigurationError for what is said of a tracker's axes where directions of stars are measured."""
    if sensors.star.sigma_roll_arcsec is not None:
        raise ConfigurationError(
            "[star] sigma_cross_arcsec, sigma_roll_arcsec: these are of whole attitudes, but the files hold star "
            "directions; give sigma_arcsec, 1 sigma of a direction across itself (how well the stars of one time tell the "
            "roll follows from where they stand)"
        )
    if not np.allclose(sensors.star.R_SB, np.eye(3), rtol=0.0, atol=1e-12):
        raise ConfigurationError(
            "[star] q_sb: it places the errors of whole attitudes, but the files hold star directions, which are in body "
            "axes (star_b_x, _y, _z); leave q_sb out, and turn directions that are in the tracker's axes: v_B = R_SB^T v_S"
        )


def _within(signal: RateSignal, epochs: Epochs, problems: list[Problem]) -> Epochs:
    """The epochs that the gyro reaches, from the first that has an attitude."""
    reach = reachable(signal, epochs)
    solved = reach & epochs.solved
    low, high = signal.span
    names = ", ".join(dict.fromkeys(epochs.files[i] for i in np.unique(epochs.file)))
    if solved.sum() < 2 <= epochs.solved.sum():
        raise DataError(
            f"{names}: {int(solved.sum())} of {int(epochs.solved.sum())} attitudes within the gyro data ({low:.3f} to "
            f"{high:.3f} s after the first row); at least 2 are needed. Do both tables use the same clock? See time_offset_s"
        )
    if solved.sum() < 2:
        hint = ""
        if epochs.directions:
            hint = (
                "; a time with at least two stars, well apart, gives an attitude: stars seen together need equal times"
            )
        raise DataError(f"{names}: {int(solved.sum())} attitudes; at least 2 are needed{hint}")
    first = int(np.flatnonzero(solved)[0])
    early = reach & (np.arange(len(epochs)) < first)
    _note(problems, epochs, early, "early", "single stars before the first attitude cannot start a filter")
    _note(problems, epochs, ~reach, "no_gyro", "star measurements before the first or after the last gyro row")
    return epochs.select(reach & ~early)


def _note(problems: list[Problem], epochs: Epochs, which: np.ndarray, kind: Kind, message: str) -> None:
    """One entry for each file that has epochs in a mask, which are good but of no use."""
    for i in np.unique(epochs.file[which]):
        row = epochs.row[which & (epochs.file == i)]
        problems.append(Problem(epochs.files[i], int(row.min()), kind, message, NOT_USED, len(row)))


def _begin(
    signal: RateSignal,
    epochs: Epochs,
    sensors: SensorsConfiguration,
    gate: Gate,
    problems: list[Problem],
    measured: bool,
) -> tuple[Epochs, np.ndarray, Beginning, NoiseLevels, dict[str, str]]:
    """Epochs from the first right one on, which of them to use, the beginning, the noise levels and where these come from."""
    timeline = build_timeline(signal, epochs)
    limit = float(np.asarray(gate.limits)[3])
    series = bring_back(timeline, epochs, np.zeros(3))
    # Once more without the drift: what is left is small, and first order suffices.
    series = bring_back(timeline, epochs, np.median(series.drifts(), axis=0))
    known = _known(sensors, epochs, measured)
    levels = rough_levels(series, known)
    beginning = find_beginning(series, levels, limit)
    if len(known) < len(NAMES):
        good = (series.epochs >= beginning.epoch) & ~np.isin(series.epochs, beginning.wrong)
        levels = estimate_noise(series.select(good), known, gate, _misfit(epochs))
        beginning = find_beginning(series, levels, limit)

    message = "a jump: this attitude does not agree with the gyro and the attitudes that follow"
    for i in beginning.wrong:
        problems.append(Problem(epochs.files[epochs.file[i]], int(epochs.row[i]), "jump", message, "dropped"))
    used = np.ones(len(epochs), dtype=bool)
    used[beginning.wrong] = False
    from_here = np.arange(beginning.epoch, len(epochs))
    sources = {n: "sensors.toml" if n in known else "estimated from the data" for n in NAMES}
    if measured and sensors.star.sigma_S is None:
        sources["sigma"] = "of each frame by its stars"
    if len(series) <= ENOUGH and "sigma_u" not in known:
        sources["sigma_u"] = "taken as 0: too few attitudes to tell"
    return epochs.select(from_here), used[from_here], beginning, levels, sources


def _known(sensors: SensorsConfiguration, epochs: Epochs, measured: bool) -> dict[str, float]:
    """The noise levels that the configuration states, or (measured) the attitudes themselves."""
    sigma_S = sensors.star.sigma_S
    sigma = (1.0 if measured else None) if sigma_S is None else float(sigma_S[0]) if epochs.directions else 1.0
    given = {"sigma_v": sensors.gyro.arw, "sigma_u": sensors.gyro.rrw, "sigma": sigma}
    return {name: value for name, value in given.items() if value is not None}


def _misfit(epochs: Epochs) -> tuple[float, float]:
    """Sum of squares by which star directions miss their epochs' solutions, and its degrees of freedom."""
    if epochs.misfit is None or epochs.misfit_dof is None:
        return 0.0, 0.0
    return float(epochs.misfit.sum()), float(epochs.misfit_dof.sum())


def _start(
    sensors: SensorsConfiguration, epochs: Epochs, levels: NoiseLevels, beginning: Beginning, timeline: Timeline,
    used: np.ndarray,
) -> tuple[Start, dict[str, str]]:  # fmt: skip
    """The belief at the first epoch, and where its "drift" and "drift_sigma" come from."""
    cov = epochs.shape[0] * levels.sigma**2
    given = sensors.gyro.initial_drift_sigma
    if given is None:
        rate = _first_rate(timeline, used) - beginning.drift
        start = Start(epochs.q_BN[0], cov, beginning.drift, DIFFUSE * beginning.sigma, rate)
        return start, {"drift": FROM_ATTITUDES, "drift_sigma": FROM_ATTITUDES}
    # A drift far less known than two attitudes tell it is best linearised about what they tell.
    # With a calibration they tell something else: drift and what misalignment and scale factors do together.
    vague = given > DIFFUSE * float(np.max(beginning.sigma)) and not sensors.calibrate.sigma.any()
    start = Start(epochs.q_BN[0], cov, beginning.drift if vague else np.zeros(3), np.full(3, given))
    return start, {"drift": FROM_ATTITUDES if vague else "taken as 0", "drift_sigma": "sensors.toml"}


def _first_rate(timeline: Timeline, used: np.ndarray) -> np.ndarray:
    """Mean rate (3,) of the gyro between the first two epochs that are used, rad/s."""
    epoch = timeline.epoch
    at = np.flatnonzero((epoch >= 0) & used[np.maximum(epoch, 0)])
    end = int(at[1]) if len(at) > 1 else len(epoch) - 1
    dt = np.diff(timeline.time)[:end]
    return dt @ timeline.rate[:end] / np.sum(dt)


def _doubted(e: Estimates, updates: Updates) -> Estimates:
    """Estimates with an honest covariance between the last attitude that was believed and a restart: there the attitude was
    wrong by as much as the restart moved it."""
    cov = e.cov
    for k in np.flatnonzero(updates.status == RESET):
        believed = np.flatnonzero(updates.status[:k] == ACCEPTED)
        begin = int(updates.index[believed[-1]]) + 1 if len(believed) else 0
        off = float(np.linalg.norm(np.nan_to_num(updates.residual[k])))
        if cov is e.cov:
            cov = e.cov.copy()
        cov[begin : int(updates.index[k]), :3, :3] += off**2 * np.eye(3)
    return replace(e, cov=cov)


def problems_of(timeline: Timeline, epochs: Epochs, updates: Updates, gate: Gate) -> list[Problem]:
    """Measurements that the gate did not take, and those taken because it had refused too many in a row."""
    limits = np.asarray(gate.limits)
    out = []
    for k in np.flatnonzero(updates.status != ACCEPTED):
        e = int(timeline.epoch[updates.index[k]])
        off = np.linalg.norm(updates.residual[k]) / ARCSEC
        where = f"{off:.4g} arcsec from what was expected, " if np.isfinite(off) else ""
        limit = limits[updates.dof[k]]
        message = f"a jump: {where}NIS {updates.nis[k]:.4g} over the gate's {limit:.4g}"
        action = {FORCED: "used, its sigma enlarged", RESET: "the filter was restarted from it"}.get(
            int(updates.status[k]), "dropped"
        )
        out.append(Problem(epochs.files[epochs.file[e]], int(epochs.row[e]), "jump", message, action))
    return out


__all__ = ["FROM_ATTITUDES", "NOT_USED", "Solution", "measured_shape", "problems_of", "solve", "the_gate"]
