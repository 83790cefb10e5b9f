"""One sign over time: where the paper's rule holds, where it fails, and that the safe form does not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helmstar.attitude import continue_sign, continuous, nearest_sign, propagate


def spin(times, rate, q0=(0.1, -0.5, 0.3, 0.8)) -> np.ndarray:
    """Truth on the double cover: q_BN(t) of a constant omega_BN_B, continuous through whole turns."""
    q0 = np.array(q0) / np.linalg.norm(q0)
    half = 0.5 * np.asarray(rate) * np.asarray(times)[:, None]
    size = np.linalg.norm(half, axis=1, keepdims=True)
    p = np.concatenate([-np.sinc(size / np.pi) * half, np.cos(size)], axis=1)  # exp(-[omega t x])
    x, w = p[:, :3], p[:, 3:]
    return np.concatenate([w * q0[:3] + q0[3] * x + np.cross(x, q0[:3]), w * q0[3] - x @ q0[:3, None]], axis=1)


RATE = np.radians(1.0) * np.array([0.6, 0.0, 0.8])  # 1 deg/s


def flipped(q, seed=0):
    """As a solver returns them: either sign."""
    return q * np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(q), 1))


@pytest.mark.parametrize("as_jax", [False, True])
def test_the_rule_over_two_turns_at_1_hz(as_jax):
    q = spin(np.arange(720.0), RATE)
    raw = flipped(q)
    raw[0] = q[0]
    if as_jax:
        from helmstar.backend import jnp

        raw = jnp.asarray(raw)
    np.testing.assert_array_equal(np.asarray(continuous(raw)), q)
    safe = continuous(raw, np.broadcast_to(RATE, (719, 3)))
    np.testing.assert_array_equal(np.asarray(safe), q)
    previous = raw[0]
    for k in range(1, 720 if not as_jax else 5):
        previous = continue_sign(raw[k], previous)
        np.testing.assert_array_equal(np.asarray(previous), q[k])


@pytest.mark.parametrize("gap", [179.0, 181.0, 200.0, 359.0])
def test_the_rule_fails_across_half_a_turn_and_the_safe_form_does_not(gap):
    """A gap of 180 s at 1 deg/s. The gyro's turn may be wrong by anything below 180 deg."""
    times = np.concatenate([np.arange(100.0), 99.0 + gap + np.arange(100.0)])
    q = spin(times, RATE)
    raw = flipped(q, 1)
    raw[0] = q[0]
    by_rule = continuous(raw)
    wrong = np.any(by_rule != q, axis=1)
    assert np.all(wrong[100:]) if gap > 180 else not np.any(wrong)
    assert not np.any(wrong[:100])
    turn = RATE * np.diff(times)[:, None]
    np.testing.assert_array_equal(continuous(raw, turn), q)
    drifting = turn * 1.3 + np.radians([0.0, 10.0, 0.0])
    predicted = propagate(q[99], drifting[99])
    np.testing.assert_array_equal(nearest_sign(raw[100], predicted), q[100])
    assert np.any(continue_sign(raw[100], q[99]) != q[100]) == (gap > 180)


def test_orthogonal_quaternions_keep_a_quaternion():
    """sign(0) = +1: a sign of zero would give a zero quaternion."""
    q = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(continue_sign(q, [0.0, 0.0, 0.0, 1.0]), q)
    np.testing.assert_array_equal(continue_sign(-q, [0.0, 0.0, 0.0, 1.0]), -q)
    np.testing.assert_array_equal(continuous([[0.0, 0.0, 0.0, 1.0], -q]), [[0.0, 0.0, 0.0, 1.0], -q])


def test_the_propagated_quaternion_is_that_of_the_rate():
    q = spin([0.0, 7.0, 400.0], RATE)
    np.testing.assert_allclose(propagate(q[0], 7.0 * RATE), q[1], atol=1e-15)
    np.testing.assert_allclose(propagate(q[0], 400.0 * RATE), q[2], atol=1e-14)
    np.testing.assert_array_equal(propagate(q[0], np.zeros(3)), q[0])
    R = Rotation.from_rotvec(-7.0 * RATE) * Rotation.from_quat(q[0])
    assert (R * Rotation.from_quat(q[1]).inv()).magnitude() < 1e-15


@pytest.mark.parametrize("with_gyro", [False, True])
def test_rows_without_attitude_are_passed_over(with_gyro):
    q = spin(np.arange(50.0), RATE)
    raw = flipped(q, 2)
    raw[3] = q[3]
    raw[:3] = np.nan
    raw[20:30] = np.nan
    out = continuous(raw, np.broadcast_to(RATE, (49, 3)) if with_gyro else None)
    known = ~np.isnan(raw[:, 0])
    np.testing.assert_array_equal(np.isnan(out[:, 0]), ~known)
    np.testing.assert_array_equal(out[known], q[known])


def test_batches_and_shapes():
    q = np.stack([spin(np.arange(30.0), RATE), spin(np.arange(30.0), -3 * RATE)])
    raw = np.stack([flipped(q[0], 3), flipped(q[1], 4)])
    raw[:, 0] = q[:, 0]
    np.testing.assert_array_equal(continuous(raw), q)
    turn = np.stack([np.tile(RATE, (29, 1)), np.tile(-3 * RATE, (29, 1))])
    np.testing.assert_array_equal(continuous(raw, turn), q)
    with pytest.raises(ValueError, match="must be"):
        continuous(np.ones((5, 3)))
    with pytest.raises(ValueError, match="one turn between"):
        continuous(np.ones((5, 4)), np.ones((5, 3)))
