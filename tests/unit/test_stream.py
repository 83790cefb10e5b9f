"""A stream is `run`, one step at a time."""

from __future__ import annotations

import numpy as np
import pytest

from helmstar.backend import jax, jnp
from helmstar.core import ABSENT, ACCEPTED, GATED, Gaussian, Measurement, chi_square_gate
from helmstar.filters import ErrorStateKalmanFilter, run
from helmstar.filters.stream import Stream
from helmstar.geometry import quaternion
from helmstar.models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model
from helmstar.models.sensors import star_directions, whole_attitude

STEPS = 50


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(5)
    model = attitude_drift_model(
        GyroNoise(jnp.asarray(1e-5), jnp.asarray(1e-7)), sensors=(star_directions(1e-4), whole_attitude())
    )
    belief = Gaussian(AttitudeDrift(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)), np.diag([1e-4] * 3 + [1e-8] * 3))
    r_N = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    stars = Measurement(
        r_N + 1e-4 * rng.normal(size=(STEPS, 2, 3)), np.broadcast_to(r_N, (STEPS, 2, 3)), rng.random((STEPS, 2)) < 0.7
    )
    stars.z[20] += 0.5  # an outlier for the gate
    q = np.asarray(quaternion.exp(jnp.asarray(1e-4 * rng.normal(size=(STEPS, 3)))))
    whole = Measurement(q, np.broadcast_to(1e-8 * np.eye(3), (STEPS, 3, 3)), (np.arange(STEPS) % 5 == 0)[:, None])
    u = GyroInput(1e-5 * rng.normal(size=(STEPS, 3)), np.zeros((STEPS, 3, 3)))
    return ErrorStateKalmanFilter(model.retraction), model, belief, u, (stars, whole), chi_square_gate(1e-6)


def at(tree, k):
    return jax.tree.map(lambda a: a[k], tree)


def test_a_stream_is_run(problem):
    filter, model, belief, u, measurements, gate = problem
    _, _, track = run(filter, model, belief, u, jnp.full(STEPS, 0.5), measurements, gate)
    stream = Stream(filter, model, belief, at(u, 0), at(measurements, 0), gate)
    seen = set()
    for k in range(STEPS):
        now, infos = stream.step(at(u, k), 0.5, at(measurements, k))
        # Two programs of the same operations: they may contract multiplications and additions differently.
        assert np.abs(now.mean.q_BN - track.belief.mean.q_BN[k]).max() < 1e-13
        assert np.abs(now.cov - track.belief.cov[k]).max() < 1e-12 * np.abs(now.cov).max()
        for info, expected in zip(infos, track.infos, strict=True):
            assert info.status == int(expected.status[k])
            assert info.dof == int(expected.dof[k])
            assert info.nis == pytest.approx(float(expected.nis[k]), rel=1e-8, abs=1e-9)
            seen.add(info.status)
    assert {ABSENT, ACCEPTED, GATED} <= seen


def test_wrong_shapes_are_refused(problem):
    filter, model, belief, u, measurements, gate = problem
    stream = Stream(filter, model, belief, at(u, 0), at(measurements, 0), gate)
    with pytest.raises(ValueError, match="shape"):
        stream.step(GyroInput(np.zeros(2), np.zeros((3, 3))), 1.0, at(measurements, 0))
    with pytest.raises(ValueError, match="built for"):
        stream.step(at(u, 0), 1.0, at(measurements, 0)[:1])
