"""Noise that a configuration does not state, from the data themselves: maximum likelihood over innovations.

The gyro is integrated from epoch to epoch of the stars, and the same 6-state filter runs over epochs for many candidates
at once; the likelihood of its innovations chooses. First with a Student likelihood that a few outliers cannot move, then,
with the epochs that the gate refuses left out, with the Gaussian one: so what the gate accepts is consistent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..core import ABSENT, Gate, Gaussian, Measurement, no_gate
from ..filters import ErrorStateKalmanFilter, run
from ..geometry import quaternion, so3
from ..models.attitude import AttitudeDrift, GyroInput, GyroNoise, attitude_drift_model, whole_attitude

Array = jax.Array
EPOCHS = 512
"""Epochs that are looked at, the padded length of the one compiled program."""
BATCH = 64
STUDENT = 4.0


@dataclass(frozen=True)
class Intervals:
    """From epoch to epoch of one stretch: q_BN (m + 1, 4) measured; shape (m + 1, 3, 3) of their covariance per sigma^2;
    turn (m, 3): rotation vector phi with R_BN(k+1) = exp(-[phi x]) R_BN(k) by the gyro with `drift` taken off;
    duration (m,) s; extra (m,) rad^2."""

    q_BN: np.ndarray
    shape: np.ndarray
    turn: np.ndarray
    duration: np.ndarray
    extra: np.ndarray


@dataclass(frozen=True)
class NoiseLevels:
    """sigma_v in rad/sqrt(s), sigma_u in rad/s/sqrt(s), and sigma, the factor of the stars' covariance shape (rad, or 1 when
    the shape is in rad^2 already)."""

    sigma_v: float
    sigma_u: float
    sigma: float


@jax.jit
def _log_likelihoods(levels: Array, data: dict[str, Array], gate: Gate) -> tuple[Array, Array, Array]:
    """For levels (batch, 3): Gaussian and Student log likelihood (batch,), and gated epochs (batch, m)."""

    def one(level: Array) -> tuple[Array, Array, Array]:
        v, u, s = level
        model = attitude_drift_model(GyroNoise(v, u), sensors=(whole_attitude(),))
        duration, n = data["duration"], data["duration"].shape[0]
        rate = data["turn"] / jnp.where(duration > 0, duration, 1.0)[:, None]
        R = data["shape"] * s**2
        m = Measurement(data["q_BN"][1:], R[1:], data["mask"][:, None])
        P0 = jnp.zeros((6, 6)).at[:3, :3].set(R[0]).at[3:, 3:].set(data["drift_var"] * jnp.eye(3))
        belief = Gaussian(AttitudeDrift(data["q_BN"][0], jnp.zeros(3)), P0)
        inputs = GyroInput(rate, data["extra"][:, None, None] * jnp.eye(3))
        keep = _keep_likelihood
        _, _, (loglik, nis, log_det, status) = run(
            ErrorStateKalmanFilter(model.retraction), model, belief, inputs, duration, (m,), gate, keep=keep
        )
        used = status != ABSENT
        student = -0.5 * log_det - 0.5 * (STUDENT + 3.0) * jnp.log1p(nis / STUDENT)
        return (
            jnp.sum(jnp.where(used, loglik, 0.0)),
            jnp.sum(jnp.where(used, student, 0.0)),
            (status > 1) | (jnp.zeros(n) > 1),
        )

    return jax.vmap(one)(levels)


def _keep_likelihood(belief: Any, predicted: Any, infos: Any) -> tuple[Array, Array, Array, Array]:
    i = infos[0]
    log_det = -2.0 * (i.loglik + 0.5 * i.nis + 0.5 * i.dof * jnp.log(2.0 * jnp.pi))
    return i.loglik, i.nis, log_det, i.status


def estimate_noise(intervals: Intervals, known: dict[str, float], gate: Gate) -> NoiseLevels:
    """Levels of maximum likelihood; those in `known` ("sigma_v", "sigma_u", "sigma") are kept as they are.

    Of a long record the first EPOCHS intervals are used. With too few intervals to tell (under 8) the levels are what the
    scatter of the intervals allows, all of it given to the gyro and to the stars alike.
    """
    m = min(len(intervals.duration), EPOCHS)
    data, scatter = _padded(intervals, m)
    T = float(np.median(intervals.duration[:m]))
    total = float(np.sum(intervals.duration[:m]))
    mean_shape = float(np.mean(np.trace(intervals.shape[: m + 1], axis1=1, axis2=2)) / 3.0)
    guess = {
        "sigma_v": scatter / np.sqrt(T),
        "sigma_u": scatter / (T * np.sqrt(total)),
        "sigma": scatter / np.sqrt(mean_shape),
    }
    names = [n for n in ("sigma_v", "sigma_u", "sigma") if n not in known]
    if not names:
        return NoiseLevels(known["sigma_v"], known["sigma_u"], known["sigma"])
    if m < 8:
        filled = {**{n: guess[n] for n in names}, **known}
        if "sigma_u" in names:
            filled["sigma_u"] = 0.0
        return NoiseLevels(filled["sigma_v"], filled["sigma_u"], filled["sigma"])

    wide = {"sigma_v": (1e-4, 3.0), "sigma_u": (1e-3, 30.0), "sigma": (1e-4, 3.0)}
    bounds = {n: np.log([guess[n] * wide[n][0], guess[n] * wide[n][1]]) for n in names}
    best = _search(bounds, known, data, no_gate(8), student=True)
    gated = np.asarray(_log_likelihoods(_levels([best] * BATCH, known), data, gate)[2])[0]
    if gated.mean() < 0.2:  # otherwise they are not outliers
        data = data | {"mask": data["mask"] & ~jnp.asarray(gated)}
    best = _search(bounds, known, data, no_gate(8), student=False)
    final = {**best, **known}
    return NoiseLevels(final["sigma_v"], final["sigma_u"], final["sigma"])


def _padded(x: Intervals, m: int) -> tuple[dict[str, Array], float]:
    """Arrays of EPOCHS intervals, and the robust scatter (rad) of gyro against stars over one interval."""

    def pad(a: np.ndarray, n: int) -> Array:
        return jnp.asarray(np.concatenate([a, np.repeat(a[-1:], n - len(a), axis=0)]))

    predicted = quaternion.multiply(quaternion.exp(-jnp.asarray(x.turn[:m])), jnp.asarray(x.q_BN[:m]))
    e = np.asarray(quaternion.log(quaternion.multiply(jnp.asarray(x.q_BN[1 : m + 1]), quaternion.conjugate(predicted))))
    e = e - np.median(e / x.duration[:m, None], axis=0) * x.duration[:m, None]
    scatter = 1.4826 * float(np.median(np.abs(e)))
    scatter = max(scatter, 1e-12)
    mask = np.zeros(EPOCHS, dtype=bool)
    mask[:m] = True
    duration = np.zeros(EPOCHS)
    duration[:m] = x.duration[:m]
    worst = float(np.max(np.abs(e) / x.duration[:m, None]))
    drift_sigma = 10.0 * max(worst, scatter / float(np.median(x.duration[:m])))
    return {
        "q_BN": pad(x.q_BN[: m + 1], EPOCHS + 1),
        "shape": pad(x.shape[: m + 1], EPOCHS + 1),
        "turn": pad(x.turn[:m], EPOCHS),
        "duration": jnp.asarray(duration),
        "extra": pad(x.extra[:m], EPOCHS),
        "mask": jnp.asarray(mask),
        "drift_var": jnp.asarray(drift_sigma**2),
    }, scatter


def _levels(candidates: list[dict[str, float]], known: dict[str, float]) -> Array:
    full = [{**c, **known} for c in candidates]
    return jnp.asarray([[c["sigma_v"], c["sigma_u"], c["sigma"]] for c in full])


def _search(
    bounds: dict[str, np.ndarray], known: dict[str, float], data: dict[str, Array], gate: Gate, *, student: bool
) -> dict[str, float]:
    """Best levels by grids in the logarithms that zoom in on the best point."""
    names = list(bounds)
    low = np.array([bounds[n][0] for n in names])
    high = np.array([bounds[n][1] for n in names])
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    count = {1: 64, 2: 16, 3: 6}[len(names)]
    best = centre
    for _ in range(8):
        axes = [
            np.clip(np.linspace(c - h, c + h, count), a, b) for c, h, a, b in zip(centre, half, low, high, strict=True)
        ]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names))
        values = []
        for i in range(0, len(points), BATCH):
            part = points[i : i + BATCH]
            part = np.concatenate([part, np.repeat(part[-1:], BATCH - len(part), axis=0)])
            candidates = [dict(zip(names, np.exp(p), strict=True)) for p in part]
            gaussian, robust, _ = _log_likelihoods(_levels(candidates, known), data, gate)
            values.append(np.asarray(robust if student else gaussian)[: len(points) - i])
        value = np.concatenate(values)
        value = np.where(np.isfinite(value), value, -np.inf)
        best = points[int(np.argmax(value))]
        centre, half = best, half * (2.5 / (count - 1) if count > 6 else 0.5)
        if np.max(half) < 0.01:
            break
    return dict(zip(names, (float(v) for v in np.exp(best)), strict=True))


@jax.jit
def integrate_gyro(rate: Array, dt: Array, restart: Array, q: Array, J: Array) -> tuple[Array, Array]:
    """Rotation accumulated since the last restart, after each step: q (n, 4) with R_BN = R(q) R_BN(then), and J (n, 3, 3) in s
    through which a constant drift b acts: R_BN = exp([J b x]) R(q) R_BN(then). restart[k] resets before step k; q (4,)
    and J (3, 3) are what was accumulated before."""

    def body(carry, inputs):
        q, J = carry
        w, dt, again = inputs
        q = jnp.where(again, quaternion.identity(), q)
        J = jnp.where(again, jnp.zeros((3, 3)), J)
        phi = -w * dt
        q = quaternion.normalise(quaternion.multiply(quaternion.exp(phi), q))
        J = so3.exp(phi) @ J + so3.left_jacobian(phi) * dt
        return (q, J), (q, J)

    return jax.lax.scan(body, (q, J), (rate, dt, restart))[1]
