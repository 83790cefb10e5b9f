"""An approach to a small body: frames are rendered, `helmstar opnav` finds the body in each, and the trajectory is checked.

    python examples/opnav.py FOLDER

Ten frames of 160 x 160 pixels, of a body that is 5% smaller and reflects otherwise than told. Where the probe is said to be is
some 50 km wrong along the way and 8 km across it; the camera points some 0.01 deg wrong.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, write_camera
from helmstar.imaging.body import LommelSeeliger, render_window, sphere
from helmstar.imaging.render import Exposure
from helmstar.opnav.command import OpnavOptions, print_opnav, run_opnav

SIDE, RADIUS_KM = 160, 2.0
TIMES = np.array([0.0, 80.0, 160.0, 220.0, 270.0, 310.0, 340.0, 370.0, 390.0, 410.0])  # s
POSITION, VELOCITY = np.array([-2800.0, 20.0, 60.0]), np.array([6.0, 0.0, 0.0])  # km, km/s, of the probe from the body
SUN_N = np.array([-0.5, 0.8, 0.33]) / np.linalg.norm([-0.5, 0.8, 0.33])
R_CB = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # the camera looks along x of B


def write_frames(folder, rng):
    """NNN.png with frames.csv, attitude.csv and cam.toml."""
    camera = Camera.from_fov(0.9, SIDE, SIDE)
    write_camera(folder / "cam.toml", camera)
    with open(folder / "cam.toml", "a") as file:
        file.write(
            f"\n[mounting]\nq_cb = {R_CB.as_quat().tolist()}\npointing_sigma_deg = 0.01\nattitude_sigma_arcsec = 1.0\n"
        )
        file.write("\n[detector]\ngain_e = 1.0\npsf_sigma_px = 0.9\n")
    exposure = Exposure(full_well_e=60000.0, bits=16, gain_e=1.0, psf_sigma_px=0.9)
    bias = Rotation.from_rotvec(np.radians(0.01) * rng.standard_normal(3))
    names, attitudes = ["file,time_s"], ["time_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w"]
    for k, t in enumerate(TIMES):
        r_N = POSITION + VELOCITY * t
        x = -r_N / np.linalg.norm(r_N)
        y = np.cross([0.0, 0.0, 1.0], x) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], x))
        look = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)]))
        R_BN = Rotation.from_rotvec(rng.uniform(-1e-3, 1e-3, 3)) * look  # the body is not kept in the middle
        R_CN = (bias * R_CB * R_BN).as_matrix()
        image, _ = render_window(
            camera, sphere(1e3 * RADIUS_KM), -R_CN @ r_N * 1e3, R_CN @ SUN_N, (0, 0, SIDE, SIDE), law=LommelSeeliger(),
            signal_e=20000.0, exposure=exposure, seed=rng,
        )  # fmt: skip
        Image.fromarray(image.array).save(folder / f"{k:03d}.png")
        names.append(f"{k:03d}.png,{t}")
        measured = Rotation.from_rotvec(5e-6 * rng.standard_normal(3)) * R_BN  # 1 arcsec
        attitudes.append(",".join(map(str, [t, *measured.as_quat()])))
    (folder / "frames.csv").write_text("\n".join(names) + "\n")
    (folder / "attitude.csv").write_text("\n".join(attitudes) + "\n")


def write_body(folder, rng):
    """body.toml: what is known of the body, and where the probe is expected."""
    position = POSITION + rng.normal(0.0, [50.0, 8.0, 8.0])
    velocity = VELOCITY + rng.normal(0.0, 1e-3, 3)
    (folder / "body.toml").write_text(f"""[body]
name = "ROCK"
radius_km = {1.05 * RADIUS_KM}
radius_sigma = 0.1
law = "lambert"
sun_n = {SUN_N.tolist()}

[initial]
time_s = 0.0
position_km = {position.tolist()}
velocity_km_s = {velocity.tolist()}
position_sigma_km = [50.0, 8.0, 8.0]
velocity_sigma_km_s = 1e-3
""")


def main(folder, seed=0, plots=False):
    """Errors of position (km) and velocity (km/s) at the epoch, over their 1 sigma, with what `helmstar opnav` returned."""
    folder, rng = Path(folder), np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_frames(folder, rng)
    write_body(folder, rng)
    options = OpnavOptions(
        folder / "cam.toml", folder / "attitude.csv", folder / "body.toml", folder / "nav", plots=plots
    )
    result = run_opnav([folder / "frames.csv"], options)
    print_opnav(result)
    t = result["trajectory"]
    error = np.array([*t["position_km"], *t["velocity_km_s"]]) - np.concatenate([POSITION, VELOCITY])
    sigma = np.array([*t["position_sigma_km"], *t["velocity_sigma_km_s"]])
    print("error of x, y, z, km:", np.round(error[:3], 3), "1 sigma:", np.round(sigma[:3], 3))
    return {"over_sigma": error / sigma, "result": result}


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="opnav-"), plots=True)
