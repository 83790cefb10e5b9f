"""A record of whole attitudes without any gyro: the rate is a state that walks at random, and the attitudes alone tell it.

How fast it walks is what the record shows, by maximum likelihood, unless `[gyro] rate_sigma_deg_s` states it. A body that
turns by more than half a turn from one attitude to the next cannot be told from one that turns the other way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import ConfigurationError, DataError
from ..io.problems import refuse
from ..io.telemetry import Telemetry
from ..progress import Progress
from ..sensors.configuration import SensorsConfiguration
from .estimate import Design, Record, Start, filter_and_smooth, log_likelihood
from .noise import NoiseLevels
from .solve import Solution, measured_shape, problems_of, the_gate
from .start import DIFFUSE
from .timeline import Epochs, Timeline, attitude_epochs

FEWEST = 3
"""Two attitudes give a rate, a third one says whether it holds."""
SLOWEST, FASTEST = 1e-4, 3.0
"""Bounds of the rate's walk, over what the attitudes' own noise would look like and over the changes that are seen."""


def solve_attitudes(
    telemetry: Telemetry, sensors: SensorsConfiguration, strict: bool = False, progress: bool = False
) -> Solution:
    """Filter and smooth attitude and rate of a record without gyro rows.

    Raises DataError where attitudes are too few or have no known noise, or, with `strict`, when a row is bad;
    ConfigurationError where `sensors` asks for what needs a gyro.
    """
    _refuse_gyro(sensors)
    problems = list(telemetry.problems)
    if strict:
        refuse(problems)
    rows = telemetry.attitude
    names = ", ".join(rows.files)
    if rows.covariance is None and sensors.star.covariance_B() is None:
        raise DataError(
            f"{names}: no gyro rows, and the noise of the attitudes is not known, which nothing else can tell then; give "
            "[star] sigma_arcsec in sensors.toml, or gyro data"
        )
    if len(rows) < FEWEST:
        raise DataError(f"{names}: {len(rows)} attitudes without gyro data; at least {FEWEST} are needed")
    epochs = attitude_epochs(rows, measured_shape(rows, sensors))
    gate = the_gate(sensors)
    limit = float(np.asarray(gate.limits)[3])
    with Progress(progress) as bar:
        task = bar.add("start and noise", 1)
        timeline, rate = _timeline(epochs)
        levels = NoiseLevels(0.0, 0.0, 1.0, {})
        start = Start(epochs.q_BN[0], epochs.shape[0], np.zeros(3), DIFFUSE * _rate_sigma(epochs))
        record = Record(timeline, epochs, levels, np.ones(len(epochs), dtype=bool), Design(states="rate"))
        given = sensors.gyro.rate_sigma_deg_s
        walk = float(np.radians(given)) if given is not None else _walk(record, start, rate, min(limit, 1e3))
        record.design = replace(record.design, rate_sigma=walk)
        bar.finish(task)
        task = bar.add("filter and smoother", 2 * record.chunks)
        filtered, smoothed, updates = filter_and_smooth(record, start, gate, lambda: bar.advance(task))
        bar.finish(task)
    if not all(np.isfinite(x).all() for e in (filtered, smoothed) for x in (e.q_BN, e.cov)):
        raise DataError(f"{names}: the filter did not stay finite; check times and sigma")
    problems += problems_of(timeline, epochs, updates, gate)
    if strict:
        refuse(problems)
    sources = {
        "sigma": "sensors.toml" if sensors.star.sigma_S is not None else "of each frame by its stars",
        "rate_sigma": "sensors.toml" if given is not None else "estimated from the data",
    }
    return Solution(
        telemetry.gyro, timeline, epochs, record.used, filtered, smoothed, updates, levels, sources, start,
        tuple(problems), gate, rate_sigma=walk,
    )  # fmt: skip


def _refuse_gyro(sensors: SensorsConfiguration) -> None:
    if sensors.calibrate.sigma.any():
        raise ConfigurationError("[calibrate]: there are no gyro rows to calibrate; give gyro data, or leave it out")
    if sensors.filter.restart:
        raise ConfigurationError("[filter] restart: needs gyro data; leave it out")


def _timeline(epochs: Epochs) -> tuple[Timeline, np.ndarray]:
    """A step from each attitude to the next, without any gyro, and the mean rates (n - 1, 3) that the attitudes imply."""
    dt = np.diff(epochs.time)
    turns = (Rotation.from_quat(epochs.q_BN[1:]) * Rotation.from_quat(epochs.q_BN[:-1]).inv()).as_rotvec()
    rate = -turns / dt[:, None]
    steps = np.ones(len(dt), dtype=bool)
    return Timeline(epochs.time, rate, np.zeros_like(rate), np.arange(len(epochs)), steps), rate


def _rate_sigma(epochs: Epochs) -> np.ndarray:
    """1 sigma (3,) of the rate between the first two attitudes, by their noise."""
    dt = float(epochs.time[1] - epochs.time[0])
    return np.sqrt(np.diagonal(epochs.shape[0] + epochs.shape[1])) / dt


def _walk(record: Record, start: Start, rate: np.ndarray, limit: float) -> float:
    """Random walk of the rate, rad/s/sqrt(s), of largest likelihood."""
    from scipy.optimize import minimize_scalar

    dt = np.diff(record.timeline.time)
    between = 0.5 * (dt[1:] + dt[:-1])
    seen = float(np.max(np.linalg.norm(np.diff(rate, axis=0), axis=1) / np.sqrt(between)))
    own = np.sqrt(np.trace(record.epochs.shape, axis1=1, axis2=2).mean()) / float(record.timeline.time[-1]) ** 1.5
    low, high = np.log(max(SLOWEST * own, 1e-14)), np.log(max(FASTEST * seen, 1e3 * SLOWEST * own, 1e-12))

    def cost(log_walk: float) -> float:
        record.design = replace(record.design, rate_sigma=float(np.exp(log_walk)))
        value = log_likelihood(record, start, limit)
        return -value if np.isfinite(value) else 1e300

    # The likelihood has one top as a rule; a coarse grid keeps the search from a flat end.
    grid = np.linspace(low, high, 9)
    best = int(np.argmin([cost(g) for g in grid]))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 0.2, "maxiter": 8})
    return float(np.exp(found.x))  # pyright: ignore[reportAttributeAccessIssue]


__all__ = ["solve_attitudes"]
