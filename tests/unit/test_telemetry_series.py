"""Attitudes brought back to one instant: against fine steps where the body turns far between instants, and fully round."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.telemetry.noise import NoiseLevels
from helmstar.telemetry.rates import rate_signal
from helmstar.telemetry.series import bring_back, pseudo_inverse
from helmstar.telemetry.start import find_beginning
from helmstar.telemetry.timeline import Epochs, Timeline, build_timeline


def spin(rate: np.ndarray, step: float, drift: np.ndarray, n: int = 8, fine: int = 1) -> tuple[Timeline, Epochs]:
    """A constant rate seen with a drift, exact attitudes every `step` s, `fine` steps of the timeline between them."""
    time = step / fine * np.arange(n * fine + 1)
    q = Rotation.from_rotvec(-rate * time[::fine, None]).as_quat()
    signal = rate_signal(time, np.broadcast_to(rate + drift, (len(time), 3)), np.diff(time, prepend=np.nan), "instant")
    zero = np.zeros(n + 1, dtype=int)
    epochs = Epochs(time[::fine], q, np.broadcast_to(np.eye(3), (n + 1, 3, 3)), zero, zero, ("t.csv",))
    return build_timeline(signal, epochs), epochs


@pytest.mark.parametrize("turn", [1e-3, 0.0999, 0.1001, 0.5, 2.0, 3.5])
def test_steps_that_turn_far_are_integrated_exactly(turn):
    rate, drift = turn / 10.0 * np.array([0.6, 0.0, 0.8]), np.zeros(3)
    coarse, fine = (bring_back(*spin(rate, 10.0, drift, fine=k), drift).A for k in (1, 1000))
    np.testing.assert_allclose(coarse, fine, rtol=0.0, atol=1e-6 * 80.0)
    np.testing.assert_allclose(coarse, bring_back(*spin(rate, 10.0, drift, fine=40), drift).A, rtol=0.0, atol=1e-11)


def test_a_drift_is_found_where_the_body_turns_far_between_attitudes():
    rate, drift = np.array([0.0, 0.1, 0.2]), np.array([3e-7, -2e-7, 1e-7])
    series = bring_back(*spin(rate, 10.0, drift), np.zeros(3))
    np.testing.assert_allclose(series.drifts(), np.broadcast_to(drift, (8, 3)), rtol=1e-4)


def test_a_body_that_turns_fully_round_between_attitudes_hides_its_drift_across_the_axis():
    rate, drift = np.array([0.0, 0.0, 2.0 * np.pi / 10.0]), np.array([1e-6, -1e-6, 2e-6])
    series = bring_back(*spin(rate, 10.0, drift), np.zeros(3))
    np.testing.assert_allclose(series.drifts(), np.broadcast_to([0.0, 0.0, 2e-6], (8, 3)), rtol=0.0, atol=1e-8)
    sigma = 1e-5
    found = find_beginning(series, NoiseLevels(1e-7, 0.0, sigma, {}), 30.0)
    assert found.sigma[2] == pytest.approx(sigma * np.sqrt(2.0) / 10.0, rel=0.1)
    assert (found.sigma[:2] > 100.0 * found.sigma[2]).all()
    assert np.isfinite(found.drift).all()


def test_pseudo_inverse_of_nothing_is_finite():
    for unseen in (0.0, 1.0):
        assert np.isfinite(pseudo_inverse(np.zeros((2, 3, 3)), unseen) * 1e-290).all()
