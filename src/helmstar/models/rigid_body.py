"""Rigid-body truth by a library integrator: Euler's equations and the attitude they drive.

    dw/dt = J^-1 (N - w x J w)            w: rate of B relative to N, in B, rad/s; J: inertia, kg m^2; N: torque, N m

and the attitude by one of two laws, named because the literature mixes them:

    "body"    dR_BN/dt = -[w x] R_BN       the physical one for w in B
    "printed" dX/dt    = X [w x]           xu2020 (8), integrated as it stands

The torque that makes a prescribed rate a solution is N = J dw/dt + w x J w.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np

Law = Literal["body", "printed"]
Vector = Callable[[float], np.ndarray]


class RigidBodyTruth(NamedTuple):
    """time (n,) s; rate (n, 3) rad/s in B; q (n, 4) scalar last, the attitude of the chosen law; increment (n-1, 3) rad
    with q[k+1] = q[k] (x) exp(increment[k]) for "printed", q[k+1] = exp(-increment[k]) (x) q[k] for "body"."""

    time: np.ndarray
    rate: np.ndarray
    q: np.ndarray
    increment: np.ndarray


def torque_of(rate: Vector, acceleration: Vector, inertia: np.ndarray) -> Vector:
    """N(t) that makes the prescribed rate(t) with derivative acceleration(t) a solution of Euler's equations."""
    J = np.asarray(inertia, float)
    return lambda t: J @ acceleration(t) + np.cross(rate(t), J @ rate(t))


def _half_product(q: np.ndarray, w: np.ndarray, sign: float) -> list[float]:
    """q (x) [w, 0] / 2 for sign = 1, [w, 0] (x) q / 2 for sign = -1, in plain floats: the integrator's inner loop."""
    x, y, z, s = q.tolist()
    a, b, c = w.tolist()
    return [
        0.5 * (s * a + sign * (y * c - z * b)),
        0.5 * (s * b + sign * (z * a - x * c)),
        0.5 * (s * c + sign * (x * b - y * a)),
        -0.5 * (x * a + y * b + z * c),
    ]


def simulate(
    time: np.ndarray,
    q0: np.ndarray,
    law: Law,
    *,
    rate: Vector | None = None,
    inertia: np.ndarray | None = None,
    torque: Vector | None = None,
    rate0: np.ndarray | None = None,
) -> RigidBodyTruth:
    """Attitude at the given times, driven by a prescribed rate(t), or by Euler's equations from rate0 under torque(t).

    Integrated with scipy's DOP853 at 1e-13 relative. Raises ValueError when neither or both ways are given, for another
    law, for times that are not two or more and increasing, for a rate or torque that is not finite at the start, or when the
    integrator fails.
    """
    from scipy.integrate import solve_ivp

    if law not in get_args(Law):
        raise ValueError(f"law {law!r}: must be one of {', '.join(map(repr, get_args(Law)))}")
    time = np.asarray(time, float)
    if time.size < 2 or not np.all(np.diff(time) > 0):
        raise ValueError("time: must be two or more increasing times in s")
    if rate is not None and torque is None and inertia is None and rate0 is None:
        euler, rate_of, torque_at, J, start = False, rate, rate, np.eye(3), np.empty(0)
    elif rate is None and torque is not None and inertia is not None and rate0 is not None:
        euler, rate_of, torque_at, J, start = True, torque, torque, np.asarray(inertia, float), np.asarray(rate0, float)
    else:
        raise ValueError("give either rate, or inertia, torque and rate0")
    J_inverse = np.linalg.inv(J)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        q, w = y[:4], (y[4:] if euler else rate_of(t))
        dq = _half_product(q, w, 1.0) if law == "printed" else _half_product(q, -w, -1.0)
        if not euler:
            return np.array(dq)
        return np.array([*dq, *(J_inverse @ (torque_at(t) - np.cross(w, J @ w)))])

    y0 = np.concatenate([np.asarray(q0, float), start])
    if not np.all(np.isfinite(derivative(time[0], y0))):  # the integrator would look for its first step for ever
        raise ValueError(f"the rate or the torque is not finite at t = {time[0]} s")
    step = float(np.min(np.diff(time)))
    s = solve_ivp(
        derivative, (time[0], time[-1]), y0, method="DOP853", t_eval=time, rtol=1e-13, atol=1e-15, max_step=20 * step
    )
    if not s.success:
        raise ValueError(f"the integrator stopped at t = {s.t[-1] if len(s.t) else time[0]} s: {s.message}")
    q = s.y[:4].T / np.linalg.norm(s.y[:4].T, axis=1, keepdims=True)
    w = s.y[4:].T if euler else np.array([rate_of(t) for t in time])
    return RigidBodyTruth(time, w, q, _increments(q, law))


def _increments(q: np.ndarray, law: Law) -> np.ndarray:
    """Rotation vectors (n-1, 3) of the steps between attitudes q (n, 4), in plain NumPy: importing scipy's Rotation takes
    longer than all else here."""
    u, s, v, t = q[:-1, :3], q[:-1, 3:], q[1:, :3], q[1:, 3:]
    # "printed": exp(increment) = q[k]^-1 (x) q[k+1]; "body": exp(increment) = q[k] (x) q[k+1]^-1.
    vector = (1.0 if law == "printed" else -1.0) * (s * v - t * u) - np.cross(u, v)
    scalar = s[:, 0] * t[:, 0] + np.sum(u * v, axis=1)
    vector = np.where(scalar[:, None] < 0, -vector, vector)
    sine = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    return vector * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)[:, None]
