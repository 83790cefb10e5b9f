"""Telemetry with known truth, by NumPy and SciPy alone: nothing of helmstar is used here, so that it can judge it.

Truth: an analytic body rate w(t) in rad/s, integrated by a fourth order Magnus rule over short steps,
R_BN(t + h) = exp(-[phi x]) R_BN(t), phi = h/2 (w1 + w2) + sqrt(3)/12 h^2 w1 x w2 at the two Gauss points. Gyro:
u = w + b + white noise, b a random walk. Star tracker: R_measured = exp([n x]) R_BN, n = R_SB^T n_S.
Quaternions are scipy's: scalar last, `Rotation.from_quat(q_BN).as_matrix()` is R_BN, v_B = R_BN v_N.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

ARCSEC = np.pi / 648000.0
DEG = np.pi / 180.0
SUBSTEP_S = 0.05
GAUSS = 0.5 / np.sqrt(3.0)

Rate = Callable[[np.ndarray], np.ndarray]


def cruise(t: np.ndarray) -> np.ndarray:
    """A slow turn with some nodding: 20 to 60 arcsec/s."""
    t = np.asarray(t, float)
    return ARCSEC * np.stack(
        [30.0 + 20.0 * np.sin(2e-2 * t), -40.0 + 10.0 * np.cos(3e-2 * t), 20.0 * np.sin(1e-2 * t + 1.0)], axis=-1
    )


def constant(rate_deg_s: Sequence[float]) -> Rate:
    """A constant rate."""
    return lambda t: np.broadcast_to(np.asarray(rate_deg_s, float) * DEG, (*np.shape(t), 3))


def slews(every_s: float = 120.0, length_s: float = 40.0, peak_deg_s: float = 1.0, base: Rate = cruise) -> Rate:
    """`base` with a raised-cosine slew at the end of each `every_s`, about x, y and z in turn."""

    def rate(t: np.ndarray) -> np.ndarray:
        t = np.asarray(t, float)
        number, into = np.divmod(t, every_s)
        phase = np.clip((into - (every_s - length_s)) / length_s, 0.0, 1.0)
        size = peak_deg_s * DEG * 0.5 * (1.0 - np.cos(2.0 * np.pi * phase))
        axis = np.eye(3)[number.astype(int) % 3] + 0.3
        return base(t) + size[..., None] * axis

    return rate


@dataclass(frozen=True)
class Setup:
    """What is simulated. Units are in the names; times are true times, a stamp is a true time minus the offset."""

    duration_s: float = 600.0
    gyro_hz: float = 10.0
    star_every_s: float = 2.0
    star_phase_s: float = 0.0
    rate: Rate = cruise
    reading: str = "instant"
    arw_arcsec_sqrt_s: float = 0.1
    rrw_arcsec_s_sqrt_s: float = 0.01
    drift_arcsec_s: tuple[float, float, float] = (5.0, -3.0, 2.0)
    star_arcsec: tuple[float, float, float] = (3.0, 3.0, 3.0)
    q_sb: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    gyro_offset_s: float = 0.0
    star_offset_s: float = 0.0
    gyro_gaps: tuple[tuple[float, float], ...] = ()
    star_gaps: tuple[tuple[float, float], ...] = ()
    stars: tuple[int, int] | None = None  # fewest and most star directions of an epoch instead of attitudes
    field_deg: float = 20.0
    misalignment_arcsec: tuple[float, float, float] = (0.0, 0.0, 0.0)  # R_GB = exp([mu x])
    scale_ppm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # a gyro axis reads too much by this share
    upset_s: float | None = None  # the body is turned by 90 deg about y between two instants, which no gyro sees
    seed: int = 0


@dataclass(frozen=True)
class Simulated:
    """Tables as a file holds them (stamps), and the truth."""

    setup: Setup
    gyro: pd.DataFrame
    star: pd.DataFrame
    nodes: np.ndarray = field(repr=False)
    q_nodes: np.ndarray = field(repr=False)
    drift_nodes: np.ndarray = field(repr=False)

    def attitude(self, t: np.ndarray) -> Rotation:
        """True R_BN at true times."""
        t = np.asarray(t, float)
        i = np.clip(np.searchsorted(self.nodes, t, side="right") - 1, 0, len(self.nodes) - 1)
        phi = _turn(self.setup.rate, self.nodes[i], t - self.nodes[i])
        return Rotation.from_rotvec(-phi) * Rotation.from_quat(self.q_nodes[i])

    def drift(self, t: np.ndarray) -> np.ndarray:
        """True drift (n, 3) in rad/s at true times."""
        return np.stack([np.interp(t, self.nodes, self.drift_nodes[:, i]) for i in range(3)], axis=-1)

    def attitude_error(self, t: np.ndarray, q_BN: np.ndarray) -> np.ndarray:
        """theta (n, 3) in rad, axes of B, with R_true = exp([theta x]) R_estimated."""
        return (self.attitude(t) * Rotation.from_quat(q_BN).inv()).as_rotvec()

    def one_table(self) -> pd.DataFrame:
        """Gyro and star rows in one table, with empty cells where a row has none."""
        return pd.merge(self.gyro, self.star, on="time_s", how="outer").sort_values("time_s", kind="stable")

    def write(self, folder: Path, kind: str = "csv") -> list[Path]:
        """gyro and star tables as files."""
        return [write(self.gyro, folder / f"gyro.{kind}"), write(self.star, folder / f"star.{kind}")]


def write(table: pd.DataFrame, path: Path) -> Path:
    """One table as CSV (17 digits) or Parquet."""
    if path.suffix == ".parquet":
        table.to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)
    return path


def _turn(rate: Rate, t: np.ndarray, h: np.ndarray) -> np.ndarray:
    w1, w2 = rate(t + (0.5 - GAUSS) * h), rate(t + (0.5 + GAUSS) * h)
    h = np.asarray(h)[..., None]
    return 0.5 * h * (w1 + w2) + np.sqrt(3.0) / 12.0 * h**2 * np.cross(w1, w2)


def _cumulative(steps: Rotation) -> Rotation:
    """Products steps[k] * ... * steps[0], by doubling."""
    q = steps.as_quat()
    reach = 1
    while reach < len(q):
        q = np.concatenate([q[:reach], (Rotation.from_quat(q[reach:]) * Rotation.from_quat(q[:-reach])).as_quat()])
        reach *= 2
    return Rotation.from_quat(q)


def simulate(setup: Setup) -> Simulated:
    """Draw one record."""
    rng = np.random.default_rng([20240611, setup.seed])
    dt = 1.0 / setup.gyro_hz
    gyro_t = np.arange(round(setup.duration_s * setup.gyro_hz) + 1) * dt
    star_t = np.arange(setup.star_phase_s, setup.duration_s + 1e-9, setup.star_every_s)
    fine = np.arange(0.0, setup.duration_s + SUBSTEP_S, SUBSTEP_S)
    nodes = np.union1d(np.concatenate([gyro_t, [-dt]]), np.concatenate([star_t, fine]))
    h = np.diff(nodes)
    q0 = Rotation.from_quat(rng.normal(size=4))
    q_nodes = (_cumulative(Rotation.from_rotvec(-_turn(setup.rate, nodes[:-1], h))) * q0).as_quat()
    q_nodes = np.concatenate([q0.as_quat()[None], q_nodes])
    if setup.upset_s is not None:
        k = int(np.searchsorted(nodes, setup.upset_s))
        there = Rotation.from_quat(q_nodes[k])
        jump = there.inv() * Rotation.from_rotvec([0.0, np.pi / 2, 0.0]) * there  # seen from N
        q_nodes[k:] = (Rotation.from_quat(q_nodes[k:]) * jump).as_quat()
    G = (1.0 + 1e-6 * np.array(setup.scale_ppm))[:, None] * Rotation.from_rotvec(
        np.array(setup.misalignment_arcsec) * ARCSEC
    ).as_matrix()

    walk = setup.rrw_arcsec_s_sqrt_s * ARCSEC * np.sqrt(h)[:, None] * rng.normal(size=(len(h), 3))
    drift = np.concatenate([np.zeros((1, 3)), np.cumsum(walk, axis=0)]) + np.array(setup.drift_arcsec_s) * ARCSEC
    white = setup.arw_arcsec_sqrt_s * ARCSEC / np.sqrt(dt) * rng.normal(size=(len(gyro_t), 3))
    here = np.searchsorted(nodes, gyro_t)
    if setup.reading == "instant":
        value = setup.rate(gyro_t) @ G.T + drift[here] + white
    else:
        w1, w2 = setup.rate(nodes[:-1] + (0.5 - GAUSS) * h), setup.rate(nodes[:-1] + (0.5 + GAUSS) * h)
        angle = 0.5 * h[:, None] * ((w1 + w2) @ G.T + drift[:-1] + drift[1:])
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(angle, axis=0)])[here]
        before = np.concatenate([np.zeros((1, 3)), total[:-1]])
        value = (total - before) / dt + white
    column = "rad" if setup.reading == "increment_column" else "rad_s"
    if setup.reading.startswith("increment"):
        value = value * dt
    keep = _outside(gyro_t, setup.gyro_gaps)
    gyro = pd.DataFrame({"time_s": gyro_t[keep] - setup.gyro_offset_s})
    for i, axis in enumerate("xyz"):
        gyro[f"gyro_{axis}_{column}"] = value[keep, i]

    star_t = star_t[_outside(star_t, setup.star_gaps)]
    record = Simulated(setup, gyro, pd.DataFrame(), nodes, q_nodes, drift)
    R_BN, R_SB = record.attitude(star_t), Rotation.from_quat(setup.q_sb)
    star = (
        _attitudes(setup, rng, star_t, R_BN, R_SB)
        if setup.stars is None
        else _directions(setup, rng, star_t, R_BN, R_SB)
    )
    return replace(record, star=star)


def _outside(t: np.ndarray, gaps: Sequence[tuple[float, float]]) -> np.ndarray:
    return ~np.any([(t > a) & (t < b) for a, b in gaps] or [np.zeros(len(t), bool)], axis=0)


def _attitudes(setup: Setup, rng: np.random.Generator, t: np.ndarray, R_BN: Rotation, R_SB: Rotation) -> pd.DataFrame:
    noise_S = rng.normal(size=(len(t), 3)) * np.array(setup.star_arcsec) * ARCSEC
    q = (Rotation.from_rotvec(R_SB.inv().apply(noise_S)) * R_BN).as_quat()
    q *= rng.choice([-1.0, 1.0], size=(len(t), 1))  # either sign of a quaternion is the same attitude
    table = pd.DataFrame({"time_s": t - setup.star_offset_s})
    for i, axis in enumerate("xyzw"):
        table[f"q_bn_{axis}"] = q[:, i]
    return table


def _directions(setup: Setup, rng: np.random.Generator, t: np.ndarray, R_BN: Rotation, R_SB: Rotation) -> pd.DataFrame:
    assert setup.stars is not None
    count = rng.integers(setup.stars[0], setup.stars[1] + 1, size=len(t))
    which = np.repeat(np.arange(len(t)), count)
    off, turn = setup.field_deg / 2.0 * DEG * np.sqrt(rng.random(len(which))), 2.0 * np.pi * rng.random(len(which))
    star_S = np.stack([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), np.cos(off)], axis=-1)
    star_B = R_SB.inv().apply(star_S)
    star_N = R_BN[which].inv().apply(star_B)
    seen = star_B + setup.star_arcsec[0] * ARCSEC * rng.normal(size=star_B.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    table = pd.DataFrame({"time_s": t[which] - setup.star_offset_s})
    for name, values in (("star_b", seen), ("star_n", star_N)):
        for i, axis in enumerate("xyz"):
            table[f"{name}_{axis}"] = values[:, i]
    return table


def sensors_toml(setup: Setup, **extra: str) -> str:
    """The true noise and conventions of a setup as sensors.toml. `extra` adds lines to a section: gyro="...", star="..."."""
    reading = {"increment_column": "increment_rad"}.get(setup.reading, setup.reading)
    cross, _, roll = setup.star_arcsec
    gyro = [
        f"arw_arcsec_sqrt_s = {setup.arw_arcsec_sqrt_s!r}",
        f"rrw_arcsec_s_sqrt_s = {setup.rrw_arcsec_s_sqrt_s!r}",
        f'reading = "{reading}"',
        f"time_offset_s = {setup.gyro_offset_s!r}",
    ]
    star = [f"time_offset_s = {setup.star_offset_s!r}", f"q_sb = {list(map(float, setup.q_sb))!r}"]
    star += [f"sigma_arcsec = {cross!r}"] if cross == roll else [
        f"sigma_cross_arcsec = {cross!r}", f"sigma_roll_arcsec = {roll!r}"
    ]  # fmt: skip
    sections = {"gyro": gyro, "star": star, "filter": []}
    return "\n".join(
        line for name, lines in sections.items() for line in (f"[{name}]", *lines, *extra.get(name, "").splitlines())
    )
