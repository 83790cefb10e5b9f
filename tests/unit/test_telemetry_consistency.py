"""Over several records of known truth the errors are as large as the covariances say: drift, attitude, innovations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from telemetry_simulator import Setup, constant, slews
from telemetry_solving import solve_setup

SEEDS = 5
BASE = Setup(duration_s=400.0, gyro_hz=5.0)
MOUNTING = tuple(float(v) for v in Rotation.from_rotvec([0.3, -1.1, 0.7]).as_quat())
CASES = {
    "instant": BASE,
    "not synchronous": replace(BASE, star_every_s=0.77, star_phase_s=0.313),
    "means in slews": replace(BASE, reading="mean_since_previous", rate=slews()),
    "increments": replace(BASE, reading="increment_rad", rate=slews()),
    "increment columns": replace(BASE, reading="increment_column"),
    "fast slews": replace(BASE, rate=slews(80.0, 30.0, 4.0)),
    "roll worse than cross": replace(BASE, star_arcsec=(2.0, 2.0, 20.0), q_sb=MOUNTING, rate=slews()),
    "stars faster than the gyro": replace(BASE, gyro_hz=1.0, star_every_s=0.25, duration_s=300.0),
    "gyro at 100 Hz, stars every 10 s": replace(BASE, gyro_hz=100.0, star_every_s=10.0, duration_s=150.0),
    "noisy gyro": replace(BASE, arw_arcsec_sqrt_s=3.0, rrw_arcsec_s_sqrt_s=0.1),
    "drift of 1000 deg/h": replace(BASE, drift_arcsec_s=(1000.0, -700.0, 400.0), star_every_s=5.0, rate=slews()),
    "star directions": replace(BASE, stars=(1, 9), star_every_s=4.0),
    "constant rate": replace(BASE, rate=constant((0.3, -0.2, 0.1))),
}


def band(dof: int, probability: float = 1e-4) -> tuple[float, float]:
    """Of a mean of chi-square over its degrees of freedom; a correct filter leaves it this often on each side."""
    return chi2.ppf(probability, dof) / dof, chi2.isf(probability, dof) / dof


@pytest.mark.parametrize("case", CASES)
def test_errors_are_as_large_as_the_covariance_says(tmp_path, case):
    runs = [solve_setup(replace(CASES[case], seed=seed), tmp_path) for seed in range(SEEDS)]
    assert not any(run.result["rows_rejected"] for run in runs)

    nis = np.concatenate([run.solution.updates.nis[1:] for run in runs])
    dof = np.concatenate([run.solution.updates.dof[1:] for run in runs])
    low, high = band(int(dof.sum()))
    assert low < nis.sum() / dof.sum() < high

    low, high = band(3 * SEEDS)
    assert low < np.mean([run.drift_nees("filtered")[-1] for run in runs]) / 3.0 < high
    for kind in ("filtered", "smoothed"):
        # The error of one moment has hardly to do with that of 50 s later.
        picked = [
            run.attitude_nees(kind)[np.searchsorted(run.time, np.arange(30.0, run.time[-1], 50.0))] for run in runs
        ]
        values = np.concatenate(picked)
        low, high = band(3 * len(values))
        assert low < values.mean() / 3.0 < high, kind
    filtered, smoothed = (np.mean([run.rms_arcsec(kind) for run in runs]) for kind in ("filtered", "smoothed"))
    assert smoothed < 0.8 * filtered


@pytest.mark.parametrize("sigma", [500.0, 1e5])
def test_a_stated_drift_sigma_starts_the_filter(tmp_path, sigma):
    """However vague it is, and with drifts and slews that no first order step reaches."""
    setup = replace(BASE, drift_arcsec_s=(900.0, -700.0, 400.0), star_every_s=10.0, rate=slews())
    runs = [
        solve_setup(replace(setup, seed=seed), tmp_path, gyro=f"initial_drift_sigma_arcsec_s = {sigma}")
        for seed in range(3)
    ]
    assert not any(run.result["rows_rejected"] for run in runs)
    assert all(run.result["noise"]["initial_drift_sigma_arcsec_s"]["value"][0] == pytest.approx(sigma) for run in runs)
    assert np.mean([run.drift_nees("filtered")[-1] for run in runs]) / 3.0 < band(9)[1]
    assert 2.2 < np.mean([run.result["nis_mean"] for run in runs]) < 3.8


def test_a_star_outage_widens_sigma_and_passes(tmp_path):
    run = solve_setup(replace(BASE, star_gaps=((150.0, 250.0),)), tmp_path)
    sigma = np.sqrt(run.solution.filtered.cov[:, 0, 0])
    before, at_end, after = (sigma[np.searchsorted(run.time, t)] for t in (149.0, 249.0, 300.0))
    assert at_end > 5.0 * before
    assert after < 1.5 * before
    smoothed = np.sqrt(run.solution.smoothed.cov[:, 0, 0])
    assert smoothed[np.searchsorted(run.time, 249.0)] < 0.3 * at_end
    assert [gap["what"] for gap in run.result["gaps"]] == ["star"]
    assert run.attitude_nees("filtered")[np.searchsorted(run.time, 249.0)] < chi2.isf(1e-4, 3)
