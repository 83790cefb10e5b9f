"""Two flight series: a known drift added to the gyro comes back, with noise parameters from the data themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from helmstar.io.telemetry import read_telemetry
from helmstar.sensors.configuration import load_sensors
from helmstar.telemetry.command import result_of
from helmstar.telemetry.solve import solve

ARCSEC = np.pi / 180 / 3600
DRIFT = np.array([100.0, -50.0, 25.0])
SERIES = ["mro_psp001446.csv", "dawn_fc_150615.csv"]


def prepared(source: Path, folder: Path, seed: int) -> tuple[list[Path], np.ndarray, Rotation]:
    """Gyro in body axes with the drift added, an attitude every 10 s with 1 arcsec noise; times and full-rate attitudes."""
    d = pd.read_csv(source, comment="#")
    C = Rotation.from_quat(d[["q1", "q2", "q3", "q0"]].to_numpy())
    t = d["sclk_s"].to_numpy()
    w = C.apply(d[["wx_base", "wy_base", "wz_base"]].to_numpy()) + DRIFT * ARCSEC
    pd.DataFrame(np.column_stack([t, w]), columns=["time_s", *(f"gyro_{a}_rad_s" for a in "xyz")]).to_csv(
        folder / "gyro.csv", index=False
    )
    rows = [0]
    for i in range(len(t)):
        if t[i] - t[rows[-1]] >= 10.0:
            rows.append(i)
    noise = np.random.default_rng(seed).normal(size=(len(rows), 3)) * ARCSEC
    q = (Rotation.from_rotvec(noise) * C[rows]).as_quat()
    pd.DataFrame(np.column_stack([t[rows], q]), columns=["time_s", *(f"q_bn_{a}" for a in "xyzw")]).to_csv(
        folder / "stars.csv", index=False
    )
    return [folder / "gyro.csv", folder / "stars.csv"], t - t[0], C


@pytest.mark.shared_data
@pytest.mark.parametrize("name", SERIES)
def test_the_added_drift_comes_back(shared_data, tmp_path, name):
    files, t, C = prepared(shared_data / "telemetry" / name, tmp_path, seed=1)
    sensors = load_sensors(None)
    telemetry = read_telemetry(files)
    solution = solve(telemetry, sensors)
    result = result_of(solution, telemetry, files, "")
    assert np.abs(np.array(result["drift_arcsec_s"]) - DRIFT).max() < 0.2
    assert 2.0 < result["nis_mean"] < 4.5
    k = np.clip(np.searchsorted(solution.timeline.time, t - 1e-6), 0, len(solution.timeline.time) - 1)
    same = np.abs(solution.timeline.time[k] - t) < 1e-5
    assert same.mean() > 0.99

    def rms(estimates) -> float:
        error = (C[same] * Rotation.from_quat(estimates.q_BN[k[same]]).inv()).as_rotvec() / ARCSEC
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))

    assert rms(solution.smoothed) < rms(solution.filtered) < 10.0


@pytest.mark.shared_data
@pytest.mark.parametrize("name", SERIES)
def test_the_original_file_by_a_column_map(shared_data, tmp_path, name):
    """Rates in base axes, quaternions scalar first, an attitude in every row: the drift of bias-corrected rates is small."""
    config = tmp_path / "sensors.toml"
    config.write_text(
        '[columns]\ntime = "sclk_s"\ngyro = ["wx_base", "wy_base", "wz_base"]\ngyro_frame = "base"\n'
        'quaternion = ["q0", "q1", "q2", "q3"]\nquaternion_order = "wxyz"\n'
    )
    sensors = load_sensors(config)
    telemetry = read_telemetry([shared_data / "telemetry" / name], sensors.columns)
    result = result_of(solve(telemetry, sensors), telemetry, [shared_data / "telemetry" / name], "")
    assert np.abs(result["drift_arcsec_s"]).max() < 1.0
