"""Write the small simulated record of examples/telemetry: a gyro at 4 Hz, a star tracker at 0.5 Hz, and a gyro at rest.

The gyro drifts by (100, -50, 25) arcsec/s; angle random walk 1 arcsec/sqrt(s), rate random walk 0.02 arcsec/s/sqrt(s). The tracker
has 5 arcsec across and 25 arcsec about its boresight, which is the body's x axis. One attitude is off by a degree, and the gyro is
silent for 6 s.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

ARCSEC = np.pi / 180 / 3600
HERE = Path(__file__).resolve().parent / "telemetry"
DT, SECONDS = 0.25, 400


def main(folder: Path = HERE) -> None:
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(2020)
    t = np.arange(0, SECONDS + DT / 2, DT)
    n = len(t)
    omega = np.deg2rad(0.3) * np.stack([np.sin(0.02 * t), np.cos(0.02 * t), 0.5 * np.ones(n)], axis=1)
    fine = 20  # truth by small steps between the gyro's instants
    R = [Rotation.identity()]
    for k in range(n - 1):
        s = t[k] + (np.arange(fine) + 0.5) * DT / fine
        w = np.deg2rad(0.3) * np.stack([np.sin(0.02 * s), np.cos(0.02 * s), 0.5 * np.ones(fine)], axis=1)
        q = R[-1]
        for v in w:
            q = Rotation.from_rotvec(-v * DT / fine) * q
        R.append(q)
    drift = np.array([100, -50, 25]) * ARCSEC + np.cumsum(rng.normal(size=(n, 3)) * 0.02 * ARCSEC * np.sqrt(DT), axis=0)
    gyro = omega + drift + rng.normal(size=(n, 3)) * ARCSEC / np.sqrt(DT)

    R_SB = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # z of S is x of B
    every = 8
    errors_S = rng.normal(size=(n, 3)) * np.array([5, 5, 25]) * ARCSEC
    rows = range(0, n, every)
    q = [(Rotation.from_rotvec(R_SB.inv().apply(errors_S[k])) * R[k]).as_quat() for k in rows]
    q[60] = (Rotation.from_rotvec([0, np.deg2rad(1), 0]) * R[60 * every]).as_quat()

    heard = ~((t > 250) & (t < 256))
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
    table = np.column_stack([t, gyro])[heard]
    np.savetxt(folder / "gyro.csv", table, "%.10g", ",", header=header, comments="")
    header = "time_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w"
    np.savetxt(folder / "stars.csv", np.column_stack([t[::every], q]), "%.10g", ",", header=header, comments="")
    m = 4000
    walk = np.cumsum(rng.normal(size=(m, 3)) * 0.02 * ARCSEC, axis=0)
    still = walk + rng.normal(size=(m, 3)) * ARCSEC
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
    np.savetxt(folder / "still.csv", np.column_stack([np.arange(m), still]), "%.6g", ",", header=header, comments="")
    (folder / "sensors.toml").write_text(
        """# The sensors of this record; every key is explained in docs/telemetry.md.
[gyro]
arw_arcsec_sqrt_s = 1.0
rrw_arcsec_s_sqrt_s = 0.02

[star]
sigma_cross_arcsec = 5.0
sigma_roll_arcsec = 25.0
q_sb = [-0.5, -0.5, -0.5, 0.5]   # x, y, z, w of R_SB: z of the sensor is x of the body
""",
        encoding="utf-8",
    )
    assert np.allclose(np.abs(R_SB.as_quat()), 0.5), R_SB.as_quat()


if __name__ == "__main__":
    main()
