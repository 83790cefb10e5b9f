"""`helmstar opnav`: frames of a body to its centres with covariance, and to a relative trajectory with covariance."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import ConfigurationError, DataError
from ..files import readable, replacing
from ..imaging import Camera, Image, read_camera
from ..imaging.body import Detector, FigureCentre, Pose
from ..imaging.body.centre import METHODS, find_centre
from ..progress import Progress
from .configuration import BodyFile, MountingTable, read_body, read_mounting
from .frames import Attitude, FrameFile, list_frames, read_attitude
from .trajectory import Observation, Prior, Trajectory, predict_px, solve

ARCSEC = np.pi / 180.0 / 3600.0
LEAST_SIGMA_PX = 10.0
"""The body is looked for at least so far around its expected place, 1 sigma."""


@dataclass(frozen=True)
class OpnavOptions:
    """camera: cam.toml. attitude: table of q_BN. body: body.toml. folder: for results.
    method: as `find_centre`. plots: whether drawn."""

    camera: Path
    attitude: Path
    body: Path
    folder: Path
    method: str = "auto"
    plots: bool = True
    command: str = ""


@dataclass(frozen=True)
class _Setup:
    """All that is the same for all frames."""

    camera: Camera
    mounting: MountingTable
    detector: Detector
    body: BodyFile
    attitude: Attitude
    epoch: float
    method: str

    @property
    def R_CB(self) -> np.ndarray:
        return Rotation.from_quat(self.mounting.q_cb).as_matrix()

    def R_TN(self, time: float) -> np.ndarray:
        """(3, 3) from N to the body's axes, which turn about z."""
        spin = Rotation.from_rotvec([0.0, 0.0, -np.radians(self.body.body.spin_deg_s) * (time - self.epoch)])
        return (spin * Rotation.from_quat(self.body.body.q_tn)).as_matrix()

    def prior(self, shift: np.ndarray) -> Prior:
        """shift: (2,) 1 sigma of the centres' common shift, apparent radii."""
        initial = self.body.initial
        mean = np.zeros(12)
        mean[:3], mean[3:6] = 1e3 * np.array(initial.position_km), 1e3 * np.array(initial.velocity_km_s)
        pointing = max(np.radians(self.mounting.pointing_sigma_deg), 1e-9)
        sigma = np.concatenate([
            self.body.position_sigma, self.body.velocity_sigma, np.full(3, pointing),
            [max(self.body.target.radius_sigma, 1e-6)], np.maximum(shift, 1e-6),
        ])  # fmt: skip
        return Prior(self.epoch, mean, sigma, 1e9 * self.body.body.gm_km3_s2)


def run_opnav(files: Sequence[Path], options: OpnavOptions) -> dict[str, Any]:
    """The object of `--json`: one entry for each frame in the order of time, and the trajectory; writes the tables, the OEM and the
    plots. Raises HelmstarError for what cannot be read."""
    if options.method not in METHODS:
        raise ConfigurationError(f"--method {options.method}: must be one of {', '.join(METHODS)}")
    camera = read_camera(options.camera)
    mounting, detector = read_mounting(options.camera)
    body = read_body(options.body)
    attitude = read_attitude(options.attitude)
    initial = body.initial
    where = f"{options.body}: initial"
    if initial.time_utc is not None:
        epoch = float(attitude.clock.of_utc([initial.time_utc], where)[0])
    else:
        epoch = float(attitude.clock.of_seconds(np.array([initial.time_s]))[0])
    setup = _Setup(camera, mounting, detector, body, attitude, epoch, options.method)
    frames = list_frames(files, attitude.clock)
    options.folder.mkdir(parents=True, exist_ok=True)
    entries, observations, owners = [], [], []
    shift = np.zeros(2)
    trajectory = solve(camera, setup.prior(shift), [])
    with Progress(len(frames) > 1) as bar:
        task = bar.add("frames", len(frames))
        for frame in frames:
            entry, found, image = _frame(setup, frame, trajectory)
            if found is not None and found.usable:
                observation = _observation(setup, frame, found, trajectory)
                shift = np.maximum(shift, _shift_sigma(found, observation))
                observations.append(observation)
                owners.append(entry)
                trajectory = solve(camera, setup.prior(shift), observations)
            if found is not None and image is not None and options.plots:
                from .plot import draw

                path = options.folder / f"{frame.path.stem}.png"
                entry["plot"] = readable(str(draw(image, setup_scene(setup, frame, found), found, path)))
            entries.append(entry)
            bar.advance(task)
    for entry, used, residual in zip(owners, trajectory.used, trajectory.residual_sigma):
        entry["used"], entry["residual_sigma"] = bool(used), _number(residual)
    times = np.array([f.time for f in frames])
    known = np.isfinite(times)
    state, covariance = trajectory.at(times[known])
    for i, k in enumerate(np.flatnonzero(known)):
        rho = float(np.linalg.norm(state[i, :3]))
        u = state[i, :3] / rho
        entries[k]["range_km"] = rho / 1e3
        entries[k]["range_sigma_km"] = float(np.sqrt(u @ covariance[i, :3, :3] @ u)) / 1e3
    result: dict[str, Any] = {"frames": entries, "trajectory": _summary(setup, trajectory, len(observations))}
    result["trajectory"]["files"] = _write(setup, options, entries, times[known], state, covariance)
    return result


def setup_scene(setup: _Setup, frame: FrameFile, found: FigureCentre) -> Any:
    """The template scene and trial of a found centre, for drawing its outline; None where there is none."""
    from ..imaging.body.template import Scene, Trial

    R_BN = setup.attitude.at(frame.time)
    if not found.usable or R_BN is None:
        return None
    R_CN = setup.R_CB @ R_BN
    expected = setup.body.target.shape.mean_radius * 2.0 * setup.camera.focal_px / found.diameter_px
    pose = Pose(expected, R_CN @ np.array(setup.body.body.sun_n), setup.R_TN(frame.time) @ R_CN.T)
    return Scene(setup.camera, setup.body.target, pose, setup.detector.psf_sigma_px), Trial(found.centre_px, found.size)


def _frame(
    setup: _Setup, frame: FrameFile, trajectory: Trajectory
) -> tuple[dict[str, Any], FigureCentre | None, Image | None]:
    from ..io.images import read_image

    begin = clock.perf_counter()
    entry = dict.fromkeys(KEYS) | {"file": readable(str(frame.path)), "status": "", "message": ""}
    origin = setup.attitude.clock.origin

    def failed(status: str, message: str) -> tuple[dict[str, Any], None, None]:
        return entry | {"status": status, "message": message, "ms": _ms(begin)}, None, None

    try:
        image = read_image(frame.path)
    except DataError as error:
        return failed("unreadable", str(error))
    if not np.isfinite(frame.time):
        return failed("no time", frame.why)
    entry["time_s"] = frame.time + setup.attitude.clock.zero
    entry["time_utc"] = None if origin is None else origin.utc([frame.time])[0]
    camera = setup.camera
    if (image.width, image.height) != (camera.width, camera.height):
        text = f"{image.width} x {image.height} pixels, the camera has {camera.width} x {camera.height}"
        return failed("wrong size", f"{frame.path}: {text}")
    R_BN = setup.attitude.at(frame.time)
    if R_BN is None:
        return failed("no attitude", f"{frame.path}: the attitude's table does not reach its time")
    pose = _pose(setup, frame.time, setup.R_CB @ R_BN, trajectory)
    if pose is None:
        return failed("not in view", f"{frame.path}: the body is expected behind the camera or inside of it")
    found = find_centre(image, camera, setup.body.target, pose, setup.detector, method=setup.method)
    entry |= {"status": found.status, "message": found.message, "method": found.method, "ms": _ms(begin)}
    entry["diameter_px"] = _number(found.diameter_px * found.size)
    entry["centroid_px"] = _vector(found.centroid_px)
    if found.usable:
        entry["centre_px"], entry["sigma_px"] = _vector(found.centre_px), _vector(found.sigma_px)
        entry["covariance_px2"] = [_vector(row) for row in found.covariance_px]
        entry["radius_px"] = 0.5 * found.diameter_px * found.size
        entry["size"], entry["size_sigma"], entry["chi2"] = found.size, _number(found.size_sigma), _number(found.chi2)
    return entry, found, image


KEYS = (
    "file", "status", "message", "method", "time_s", "time_utc", "centre_px", "sigma_px", "covariance_px2", "centroid_px",
    "diameter_px", "radius_px", "size", "size_sigma", "chi2", "range_km", "range_sigma_km", "used", "residual_sigma", "ms",
)  # fmt: skip


def _pose(setup: _Setup, time: float, R_CN: np.ndarray, trajectory: Trajectory) -> Pose | None:
    state, covariance = trajectory.at(np.array([time]))
    position, P = state[0, :3], covariance[0, :3, :3]
    rho = float(np.linalg.norm(position))
    shape = setup.body.target.shape
    r_C = -R_CN @ position
    if r_C[2] <= 1.05 * shape.reach:
        return None
    along = position / rho
    sigma_along = float(np.sqrt(along @ P @ along))
    across = float(np.sqrt(max(np.trace(P) - sigma_along**2, 0.0)))
    pointing = float(np.radians(setup.mounting.pointing_sigma_deg)) + setup.mounting.attitude_sigma_arcsec * ARCSEC
    near_sigma = setup.camera.focal_px * float(np.hypot(across / rho, pointing)) + LEAST_SIGMA_PX
    centre = predict_px(
        setup.camera, trajectory.unknowns, position[None], R_CN[None], np.array([[1.0, 0.0]]), np.zeros(1)
    )[0]
    near = centre if np.isfinite(centre).all() else None
    return Pose(
        rho,
        R_CN @ np.array(setup.body.body.sun_n),
        setup.R_TN(time) @ R_CN.T,
        min(sigma_along, 0.5 * rho),
        near,
        near_sigma,
    )


def _observation(setup: _Setup, frame: FrameFile, found: FigureCentre, trajectory: Trajectory) -> Observation:
    R_BN = setup.attitude.at(frame.time)
    assert R_BN is not None
    R_CN = setup.R_CB @ R_BN
    pose = _pose(setup, frame.time, R_CN, trajectory)
    assert pose is not None
    camera = setup.camera
    r = pose.position(camera, found.centre_px)
    toward = camera.pixels(r + 1e-3 * pose.distance * pose.sun_C) - found.centre_px
    toward = toward / max(float(np.linalg.norm(toward)), 1e-12)
    attitude = (setup.mounting.attitude_sigma_arcsec * ARCSEC * camera.focal_px) ** 2
    noise = found.covariance_px - found.common_px + (attitude + 1e-6) * np.eye(2)
    # The size that a frame found includes what was expected of it; that is taken out again, so that it counts once.
    prior, size, sigma = pose.scale_sigma(setup.body.target), float("nan"), float("nan")
    after = found.size_sigma / found.size if np.isfinite(found.size_sigma) else prior
    if prior > 0.0 and after < 0.7 * prior:
        sigma = 1.0 / np.sqrt(1.0 / after**2 - 1.0 / prior**2)
        size = float(np.log(found.size)) * sigma**2 / after**2
    return Observation(
        frame.time,
        R_CN,
        found.centre_px,
        noise,
        toward,
        0.5 * found.diameter_px * found.size,
        pose.distance,
        size,
        sigma,
    )


def _shift_sigma(found: FigureCentre, o: Observation) -> np.ndarray:
    """(2,) 1 sigma of what frames share, towards the Sun and across, apparent radii."""
    U = np.stack([o.sun_px, [-o.sun_px[1], o.sun_px[0]]])
    return np.sqrt(np.maximum(np.diagonal(U @ found.common_px @ U.T), 0.0)) / max(o.radius_px, 1e-6)


def _ms(begin: float) -> float:
    return round(1e3 * (clock.perf_counter() - begin), 3)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _vector(values: np.ndarray) -> list[float | None]:
    return [_number(v) for v in values]


def _summary(setup: _Setup, t: Trajectory, frames: int) -> dict[str, Any]:
    sigma = np.sqrt(np.diagonal(t.covariance))
    origin = setup.attitude.clock.origin
    return {
        "epoch_s": t.epoch + setup.attitude.clock.zero,
        "epoch_utc": None if origin is None else origin.utc([t.epoch])[0],
        "position_km": _vector(1e-3 * t.unknowns[:3]),
        "position_sigma_km": _vector(1e-3 * sigma[:3]),
        "velocity_km_s": _vector(1e-3 * t.unknowns[3:6]),
        "velocity_sigma_km_s": _vector(1e-3 * sigma[3:6]),
        "pointing_error_arcsec": _vector(t.unknowns[6:9] / ARCSEC),
        "pointing_sigma_arcsec": _vector(sigma[6:9] / ARCSEC),
        "size": float(np.exp(t.unknowns[9])),
        "size_sigma": float(sigma[9] * np.exp(t.unknowns[9])),
        "frames": frames,
        "frames_used": int(t.used.sum()),
        "chi2": _number(t.chi2),
    }


def _write(
    setup: _Setup,
    options: OpnavOptions,
    entries: list[dict[str, Any]],
    time: np.ndarray,
    state: np.ndarray,
    covariance: np.ndarray,
) -> dict[str, str]:
    import pandas as pd

    folder, origin = options.folder, setup.attitude.clock.origin
    flat = [
        {k: e.get(k) for k in KEYS if k not in ("centre_px", "sigma_px", "covariance_px2", "centroid_px")}
        for e in entries
    ]
    for row, e in zip(flat, entries):
        for key in ("centre_px", "sigma_px", "centroid_px"):
            x, y = e.get(key) or (None, None)
            row[f"{key[:-3]}_x_px"], row[f"{key[:-3]}_y_px"] = x, y
        C = e.get("covariance_px2")
        row["covariance_xy_px2"] = None if C is None else C[0][1]
    out = {"centres": str(_parquet(pd.DataFrame(flat), folder / "centres.parquet"))}
    columns: dict[str, Any] = {"time_s": time + setup.attitude.clock.zero}
    if origin is not None:
        columns["time_utc"] = origin.utc(time)
    names = ["x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s"]
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    columns |= {n: 1e-3 * state[:, i] for i, n in enumerate(names)}
    columns |= {f"sigma_{n}": 1e-3 * sigma[:, i] for i, n in enumerate(names)}
    short = [n.split("_")[0] for n in names]
    columns |= {
        f"cov_{short[i]}_{short[j]}": 1e-6 * covariance[:, i, j] for i in range(6) for j in range(i)
    }  # km, s; the variances are the squares of sigma_
    out["trajectory"] = str(_parquet(pd.DataFrame(columns), folder / "trajectory.parquet"))
    once = np.concatenate([[True], np.diff(time) > 0.0]) if len(time) else np.zeros(0, bool)
    if origin is not None and len(time):
        from ..io.oem import write_oem

        path = folder / "trajectory.oem"
        comments = ["Probe relative to the body, from frames of it, by helmstar.", options.command]
        write_oem(
            path, origin, time[once], state[once], covariance[once], center_name=setup.body.body.name, comments=comments
        )
        out["oem"] = str(path)
    return {k: readable(v) for k, v in out.items()}


def _parquet(frame: Any, path: Path) -> Path:
    with replacing(path) as part, open(part, "wb") as stream:
        frame.to_parquet(stream, index=False)
    return path


def print_opnav(result: dict[str, Any]) -> None:
    """One line for each frame, then the trajectory."""
    for e in result["frames"]:
        if e["centre_px"] is None:
            print(f"{e['file']}: {e['status']}: {e['message']}")
            continue
        x, y = e["centre_px"]
        note = "" if e["status"] == "found" else f" ({e['status']}: {e['message']})"
        note += "" if e["used"] else " (not used)"
        print(
            f"{e['file']}: {e['method']}, centre {x:.3f} {y:.3f} px (+- {max(e['sigma_px']):.2g}), "
            f"{e['diameter_px']:.2f} px across, {e['range_km']:.6g} km (+- {e['range_sigma_km']:.2g}), {e['ms']:.0f} ms{note}"
        )
    t = result["trajectory"]
    when = t["epoch_utc"] or f"{t['epoch_s']:.3f} s"
    print(f"at {when}, probe relative to the body in N, from {t['frames_used']} of {t['frames']} centres:")
    for what, unit in (("position", "km"), ("velocity", "km_s")):
        values, sigmas = t[f"{what}_{unit}"], t[f"{what}_sigma_{unit}"]
        text = "  ".join(f"{v:.9g} (+- {s:.2g})" for v, s in zip(values, sigmas))
        print(f"  {what}: {text} {unit.replace('_', '/')}")
    for name, file in t["files"].items():
        print(f"{name}: {file}")


__all__ = ["OpnavOptions", "print_opnav", "run_opnav"]
