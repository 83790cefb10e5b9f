"""A rendered approach to a body as files: frames, times, camera, attitude and body, with the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, write_camera
from helmstar.imaging.body import Law, Shape, render_window
from helmstar.imaging.render import Exposure

Q_CB = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # the boresight is B's x axis
SUN_N = np.array([-0.5, 0.8, 0.33])
EXPOSURE = Exposure(full_well_e=60000.0, bits=16, gain_e=1.0, read_noise_e=8.0, psf_sigma_px=0.9)


def track(position: np.ndarray, up: np.ndarray) -> Rotation:
    """R_BN whose x axis looks at the origin from a position in N."""
    x = -position / np.linalg.norm(position)
    z = up - (up @ x) * x
    z /= np.linalg.norm(z)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))


def write_approach(
    folder: Path, shape: Shape, law: Law, *, times: np.ndarray, start_km: np.ndarray, velocity_km_s: np.ndarray,
    seed: int = 0, pointing_deg: float = 0.01, attitude_sigma_rad: float = 5e-6, side: int = 256, fov_deg: float = 1.2,
    offset_px: float = 20.0, utc: str | None = None,
) -> tuple[Camera, list[Path]]:  # fmt: skip
    """Frames NNN.png, frames.csv, cam.toml (without tables beyond [camera]), attitude.csv. The probe is at start + v t in N."""
    rng = np.random.default_rng(seed)
    camera = Camera.from_fov(fov_deg, side, side)
    write_camera(folder / "cam.toml", camera)
    bias = Rotation.from_rotvec(np.radians(pointing_deg) * rng.standard_normal(3))
    rows, q, files = [], [], []
    sun = SUN_N / np.linalg.norm(SUN_N)
    for k, t in enumerate(times):
        r_N = 1e3 * (start_km + velocity_km_s * t)
        away = rng.uniform(-1.0, 1.0, 3) * offset_px / camera.focal_px
        R_BN = Rotation.from_rotvec(away) * track(r_N, np.array([0.0, 0.0, 1.0]))
        R_CN = (bias * Q_CB * R_BN).as_matrix()
        image, _ = render_window(
            camera, shape, -R_CN @ r_N, R_CN @ sun, (0, 0, side, side), R_TC=R_CN.T, law=law, signal_e=20000.0,
            exposure=EXPOSURE, seed=rng,
        )  # fmt: skip
        path = folder / f"{k:03d}.png"
        Picture.fromarray(image.array).save(path)
        files.append(path)
        rows.append({"file": path.name, **_time(t, utc)})
        measured = Rotation.from_rotvec(attitude_sigma_rad * rng.standard_normal(3)) * R_BN
        q.append({**_time(t, utc), **({} if utc is None else {"time_s": t}),
                  **dict(zip(("q_bn_x", "q_bn_y", "q_bn_z", "q_bn_w"), measured.as_quat()))})  # fmt: skip
    pd.DataFrame(rows).to_csv(folder / "frames.csv", index=False)
    pd.DataFrame(q).to_csv(folder / "attitude.csv", index=False)
    return camera, files


def _time(t: float, utc: str | None) -> dict[str, object]:
    if utc is None:
        return {"time_s": t}
    return {"time_utc": str(np.datetime64(utc, "us") + np.timedelta64(round(1e6 * t), "us"))}


MOUNTING = f"""
[mounting]
q_cb = [{", ".join(repr(float(v)) for v in Q_CB.as_quat())}]
pointing_sigma_deg = 0.01
attitude_sigma_arcsec = 1.0

[detector]
gain_e = 1.0
psf_sigma_px = 0.9
"""


def body_toml(
    radius: str, position: np.ndarray, velocity: np.ndarray, extra: str = "", time: str = "time_s = 0.0"
) -> str:
    """body.toml with an expected state."""
    return f"""[body]
name = "ROCK"
{radius}
sun_n = {SUN_N.tolist()}
{extra}

[initial]
{time}
position_km = {[float(v) for v in position]}
velocity_km_s = {[float(v) for v in velocity]}
position_sigma_km = [50.0, 8.0, 8.0]
velocity_sigma_km_s = 1e-3
"""
