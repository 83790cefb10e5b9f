"""The problem that all contenders solve, and the means to time them: a 6-state MEKF with two stars in every step.

Truth is simulated, so that filters work as they do in use: a body that tumbles slowly, a gyro with angle random walk and
a drifting zero, two stars along the first axes of N with 20 arcsec in each component. Start errors are drawn from P0.

    R_BN(k) = exp(-[omega dt x]) R_BN(k-1)           omega: mean rate over step k in B
    u(k)    = omega + b + eta_v,  b(k) = b(k-1) + eta_u        (the Farrenkopf noise that the filters assume)
    z_i(k)  = R_BN(k) r_i + sigma eta
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DT = 1.0
"""Step, s."""
SIGMA_V = 1e-5
"""Angle random walk, rad/sqrt(s)."""
SIGMA_U = 1e-8
"""Rate random walk, rad/s/sqrt(s)."""
SIGMA = 20.0 * np.pi / 180.0 / 3600.0
"""Star noise, rad in each component of a direction (20 arcsec)."""
P0 = 1e-3**2
"""Variance at the start, of the attitude (rad^2) and of the drift ((rad/s)^2) alike."""
R_N = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Directions of the two stars in N; mekf.c has the same ones."""


@dataclass(frozen=True)
class Problem:
    """Inputs and truth: u (runs, steps, 3) rad/s, z (runs, steps, 2, 3), q_BN (runs, steps, 4), b (runs, steps, 3) rad/s.
    Every filter starts at the identity without drift."""

    u: np.ndarray
    z: np.ndarray
    q_BN: np.ndarray
    b: np.ndarray

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.u.shape[0]

    @property
    def steps(self) -> int:
        """Steps of each run."""
        return self.u.shape[1]


def quat_exp(v: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), scalar last, of rotation vectors (..., 3)."""
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(half / np.pi) * v, np.cos(half)], axis=-1)


def quat_multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton's product of quaternions (..., 4)."""
    pv, pw, qv, qw = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    v = pw * qv + qw * pv + np.cross(pv, qv)
    return np.concatenate([v, pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)], axis=-1)


def quat_matrix(q: np.ndarray) -> np.ndarray:
    """R_BN (..., 3, 3) of q_BN (..., 4)."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def simulate(runs: int, steps: int, seed: int = 0) -> Problem:
    """Draw a problem."""
    rng = np.random.default_rng(seed)
    q = quat_exp(np.sqrt(P0) * rng.standard_normal((runs, 3)))
    b = np.sqrt(P0) * rng.standard_normal((runs, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (runs, 3))
    u, z = np.empty((runs, steps, 3)), np.empty((runs, steps, 2, 3))
    qs, bs = np.empty((runs, steps, 4)), np.empty((runs, steps, 3))
    # The drift moves within the step as well: its covariance with the integrated angle is Farrenkopf's.
    joint = np.array([[SIGMA_V**2 * DT + SIGMA_U**2 * DT**3 / 3.0, 0.5 * SIGMA_U**2 * DT**2], [0.0, SIGMA_U**2 * DT]])
    root = np.linalg.cholesky(joint + np.triu(joint, 1).T)
    for k in range(steps):
        omega = 0.01 * np.cos(np.array([0.010, 0.013, 0.017]) * k * DT + phase)
        w = rng.standard_normal((runs, 3, 2)) @ root.T
        u[:, k] = omega + b + w[..., 0] / DT
        b = b + w[..., 1]
        q = quat_multiply(quat_exp(-omega * DT), q)
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        z[:, k] = np.einsum("nij,sj->nsi", quat_matrix(q), R_N) + SIGMA * rng.standard_normal((runs, 2, 3))
        qs[:, k], bs[:, k] = q, b
    return Problem(u, z, qs, bs)


def angle(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Angles in rad between attitudes (..., 4), accurate when small."""
    conjugate = q * np.array([-1.0, -1.0, -1.0, 1.0])
    d = quat_multiply(p, conjugate)
    return 2.0 * np.arctan2(np.linalg.norm(d[..., :3], axis=-1), np.abs(d[..., 3]))


def one_core(cpu: int | None = None) -> int:
    """Keep this process, and the libraries it will import, to one core; returns the core. Call before importing them."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if not hasattr(os, "sched_setaffinity"):
        raise SystemExit("error: this system cannot keep a process to one core; timings would not be comparable")
    allowed = sorted(os.sched_getaffinity(0))
    cpu = allowed[-1] if cpu is None else cpu
    if cpu not in allowed:
        raise SystemExit(f"error: --cpu {cpu}: must be one of {allowed}")
    os.sched_setaffinity(0, {cpu})
    return cpu


def cpu_seconds(call: Callable[[], object], repeats: int) -> float:
    """Least CPU time of this process over the repeats."""
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def positive(text: str) -> int:
    """For argparse: an integer from 1 on."""
    import argparse

    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number from 1 on")
    return int(text)


def table(header: list[str], rows: list[list[str]]) -> str:
    """Plain text: the first column to the left, the others to the right."""
    widths = [max(len(r[i]) for r in [header, *rows]) for i in range(len(header))]

    def line(cells: list[str]) -> str:
        return "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths))).rstrip()

    return "\n".join([line(header), line(["-" * w for w in widths]), *map(line, rows)])
