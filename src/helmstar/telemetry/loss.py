"""What is put in the place of gyro data that are lost, by choice: the policies of `[gyro] loss_policy`.

| policy | rate over the gap | how well it is taken to be known |
|---|---|---|
| interpolate | a line between the two sides, see `bridge` | judged on clean stretches of the record |
| hold_last, hold_mean | the last rate, or the mean of the last `hold_s`, as live data would have it | judged likewise |
| hold_mean_raised | the mean | `raised_deg_s` |
| zeros | zeros, as if they were data | perfectly: the mistake, to see what it does |
| commanded | `commanded_rate_deg_s`, which has no drift | `command_error` times its length |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..sensors.configuration import GyroConfiguration
from .rates import RateSignal

STRETCHES = 500
"""Clean stretches on which a held rate is judged."""


def with_policy(signal: RateSignal, gyro: GyroConfiguration) -> RateSignal:
    """The signal with its gaps bridged by the policy. `interpolate` and a record without gaps leave it as it is."""
    if gyro.loss_policy in ("interpolate", "rate_state") or not signal.gap.any():
        return signal
    first, last, sigma = signal.first.copy(), signal.last.copy(), signal.sigma.copy()
    for g in np.flatnonzero(signal.gap):
        if gyro.loss_policy == "zeros":
            first[g] = last[g] = 0.0
            sigma[g] = 0.0
        elif gyro.loss_policy == "commanded":
            rate = np.radians(np.array(gyro.commanded_rate_deg_s))
            first[g] = last[g] = rate
            sigma[g] = gyro.command_error * np.linalg.norm(rate)
        else:
            window = 0.0 if gyro.loss_policy == "hold_last" else gyro.hold_s
            held = _held(signal, signal.start[g], window)
            first[g] = last[g] = held
            length = float(signal.end[g] - signal.start[g])
            raised = gyro.loss_policy == "hold_mean_raised"
            sigma[g] = np.radians(gyro.raised_deg_s) if raised else _misses(signal, length, window)
    return replace(signal, first=first, last=last, sigma=sigma)


def _held(signal: RateSignal, t: float, window: float) -> np.ndarray:
    """The rate that is held from t on: the last one before it, or the mean over `window` s, as far as it is clean."""
    before = np.flatnonzero((signal.end <= t + 1e-9) & ~signal.gap)
    if not len(before):
        return np.zeros(3)
    gaps = signal.end[signal.gap & (signal.end <= t)]
    begin = max(t - window, float(gaps.max()) if len(gaps) else float(signal.start[0]))
    if window <= 0.0 or begin >= t - 0.5 * signal.period:
        return signal.last[before[-1]]
    a, b = signal.integral(np.array([begin, t]))
    return (b - a) / (t - begin)


def _misses(signal: RateSignal, length: float, window: float) -> np.ndarray:
    """1 sigma (3,) in rad/s by which a held rate misses the mean over the next `length` s, on clean stretches; where there
    are none, the spread of the record's rates."""
    clean = np.flatnonzero(~signal.gap)
    t = signal.start[clean[:: max(len(clean) // STRETCHES, 1)]]
    low, high = signal.span
    gap_start, gap_end = signal.start[signal.gap], signal.end[signal.gap]
    fits = (t - window >= low) & (t + length <= high)
    fits &= ~np.any((gap_start < (t + length)[:, None]) & (gap_end > (t - max(window, signal.period))[:, None]), axis=1)
    t = t[fits]
    if len(t) < 5:
        return np.std(signal.first[clean], axis=0)
    held = np.array([_held(signal, at, window) for at in t])
    mean = (signal.integral(t + length) - signal.integral(t)) / length
    return np.sqrt(np.mean((mean - held) ** 2, axis=0))
