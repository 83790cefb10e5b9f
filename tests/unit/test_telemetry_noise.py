"""The noise estimate judges measurements as the filter does."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from helmstar.core import ACCEPTED, FORCED, GATED, REOPENED, chi_square_gate
from helmstar.telemetry.estimate import Record, Start, filter_and_smooth
from helmstar.telemetry.noise import NoiseLevels, _innovations, _padded
from helmstar.telemetry.rates import rate_signal
from helmstar.telemetry.series import bring_back
from helmstar.telemetry.timeline import Epochs, build_timeline

SIGMA, ARW, RRW = 3e-5, 1e-6, 1e-8


def test_an_upset_is_refused_reopened_and_followed_as_by_the_filter():
    rng = np.random.default_rng(4)
    m = 60
    error = SIGMA * rng.normal(size=(m, 3))
    error[20:23] += [3e-4, 0.0, 0.0]  # 10 sigma: refused until the covariance has grown to explain it,
    error[23:40] += [6e-3, -2e-3, 1e-3]  # which then is much larger
    q = Rotation.from_rotvec(error).as_quat()
    zero, time = np.zeros(m, dtype=int), 2.0 * np.arange(m)
    epochs = Epochs(time, q, np.broadcast_to(np.eye(3), (m, 3, 3)), zero, zero, ("t.csv",))
    timeline = build_timeline(rate_signal(time, np.zeros((m, 3)), np.diff(time, prepend=np.nan), "instant"), epochs)
    gate = chi_square_gate(1e-6, reopen_after=3)

    data = _padded(bring_back(timeline, epochs, np.zeros(3)))
    data["mask"] = jnp.arange(len(data["mask"])) < m - 1
    nis, _, over = (np.asarray(a)[: m - 1, 0] for a in _innovations(jnp.array([[ARW, RRW, SIGMA]]), data, gate))
    levels = NoiseLevels(ARW, RRW, SIGMA, {})
    start = Start(q[0], SIGMA**2 * np.eye(3), np.zeros(3), np.full(3, float(np.sqrt(data["drift_var"]))))
    updates = filter_and_smooth(Record(timeline, epochs, levels, np.ones(m, dtype=bool)), start, gate)[2]

    assert set(updates.status.tolist()) == {ACCEPTED, GATED, REOPENED, FORCED}
    np.testing.assert_array_equal(over, updates.status != ACCEPTED)
    np.testing.assert_allclose(nis, updates.nis, rtol=0.02)  # turns of 0.01 rad are not quite linear
