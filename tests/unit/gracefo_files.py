"""GRACE-FO Level-1 files of the documented layout with known truth: no real file can be part of the repository.

The header is laid out as in the delivered files (dimensions, global attributes, variables with the number of their column).
Truth comes from telemetry_simulator: a pitch of one turn in 94.5 min about y with some nodding, whose integral is analytic.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from telemetry_simulator import ARCSEC, Setup, Simulated, simulate

GPS_START = 694267200.0  # 2022-01-01T00:00:00 GPS
DEG = np.pi / 180.0
ORBIT = 1.1077e-3
AXES = np.array([[0.9, 0.1, 0.4], [-0.5, 0.8, 0.3], [-0.4, -0.9, 0.35], [0.05, 0.0, -1.0]])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)

VARIABLES = {
    "SCA1B": ["gps_time", "GRACEFO_id", "sca_id", "quatangle", "quaticoeff", "quatjcoeff", "quatkcoeff", "qual_rss",
              "qualflg"],
    "SCA1A": ["rcvtime_intg", "rcvtime_frac", "GRACEFO_id", "sca_id", "sca_desig", "quatangle", "quaticoeff",
              "quatjcoeff", "quatkcoeff", "nlocks", "nstars", "sca_confid", "sca_null1", "sca_null2", "sca_mode",
              "qualflg"],
    "IMU1B": ["rcvtime_intg", "rcvtime_frac", "time_ref", "GRACEFO_id", "gyro_id", "FiltAng", "qualflg"],
}  # fmt: skip
FLAGS = ["bit 0 = Data was interpolated", "bit 3 = Only one star camera", "bit 5 = Not defined"]


def nodding(t):
    """Rate (n, 3) in rad/s."""
    t = np.asarray(t, float)
    return np.stack([2e-5 * np.sin(0.02 * t), ORBIT + 3e-5 * np.cos(0.03 * t), 1e-5 * np.sin(0.05 * t)], axis=-1)


def nodded(t):
    """Its integral from 0, rad."""
    t = np.asarray(t, float)
    return np.stack(
        [1e-3 * (1.0 - np.cos(0.02 * t)), ORBIT * t + 1e-3 * np.sin(0.03 * t), 2e-4 * (1.0 - np.cos(0.05 * t))], axis=-1
    )


@dataclass(frozen=True)
class Record:
    """Truth, the drift of the gyros in rad/s about x, y, z, and the two files."""

    truth: Simulated
    drift: np.ndarray
    sca: Path
    imu: Path


def header(product: str, variables: list[str] | None = None, units: str = "degrees") -> str:
    lines = ["header:", "  dimensions:", "    num_records: 7", "  global_attributes:"]
    lines += ["    acknowledgement: GRACE-FO is a joint mission", "    conventions: CF-1.6, ACDD-1.3, ISO 8601"]
    lines += [f"    title: GRACE-FO {product}", "  variables:"]
    for i, name in enumerate(variables or VARIABLES[product], 1):
        lines += [f"    - {name}:", f"        comment: {i}th column", f"        long_name: what {name} is"]
        if name == "FiltAng":
            lines += [f"        units: {units}"]
        if name == "qualflg":
            lines += ["        flag_meanings:", *(f"          - {flag}" for flag in FLAGS)]
    return "\n".join([*lines, "# End of YAML header", ""])


def sca_rows(t: np.ndarray, q_BN: np.ndarray, flags: dict[int, str] | None = None) -> list[str]:
    """Rows of SCA1B: scalar first, v_N = R(q) v_B, so the conjugate of q_BN."""
    return [
        f"{GPS_START + time:.0f} C 23 {w:.16g} {-x:.16g} {-y:.16g} {-z:.16g} 8.77e-07 {(flags or {}).get(i, '00000000')}"
        for i, (time, (x, y, z, w)) in enumerate(zip(t, q_BN))
    ]


def imu_rows(duration: float, drift: np.ndarray, hz: float = 8.0) -> list[str]:
    """Rows of IMU1B: the gyros one after the other, 1.1 ms apart, their angles counted up from odd zeros."""
    rows = []
    for k in range(round(duration * hz) + 1):
        for gyro in range(4):
            t = round(k / hz + 0.0011 * gyro, 6)
            angle = (AXES[gyro] @ (nodded(t) + drift * t)) / DEG + 10.0 * gyro
            whole = int(np.floor(t))
            rows.append(f"{GPS_START + whole:.0f} {round((t - whole) * 1e6)} G C {gyro + 1} {angle:.13f} 00000000")
    return rows


def write(path: Path, product: str, rows: list[str], **keys) -> Path:
    content = (header(product, **keys) + "\n".join(rows) + "\n").encode()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    return path


def write_record(folder: Path, duration: float = 300.0) -> Record:
    truth = simulate(Setup(duration_s=duration, star_every_s=1.0, rate=nodding, star_arcsec=(5.0, 5.0, 5.0)))
    drift = np.array([0.5, -0.3, 0.2]) * ARCSEC
    t = truth.star["time_s"].to_numpy()
    q = truth.star[["q_bn_x", "q_bn_y", "q_bn_z", "q_bn_w"]].to_numpy()
    sca = write(folder / "SCA1B_2022-01-01_C_04.txt.gz", "SCA1B", sca_rows(t, q))
    imu = write(folder / "IMU1B_2022-01-01_C_04.txt", "IMU1B", imu_rows(duration, drift))
    return Record(truth, drift, sca, imu)


def settings_toml(folder: Path, more: str = "") -> Path:
    """sensors.toml with the axes of these files."""
    path = folder / "sensors.toml"
    path.write_text(f"[gracefo]\nimu_axes = {AXES.tolist()}\n{more}")
    return path
