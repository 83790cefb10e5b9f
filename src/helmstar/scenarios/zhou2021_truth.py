"""Truth of zhou2021: the orbit, the attitude along it, what the gyro integrates and which stars the heads see.

Profiles, as R_BN over time:
    lvlh   the local frame H: z to the Earth, y against the orbit's normal, x forward
    yaw    z to the Earth, x in the half plane of the Sun
    slew   lvlh with a turn from rest to rest about body x, y, z in turn, each exactly once in `slew_every_s`
    file   an attitude file, interpolated by the shortest turn, of LARGEST_STEP at most, and not over an AEM's segments
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..astro import Elements, lvlh, propagate
from ..errors import ConfigurationError
from ..sensors.star_heads import Head, mounted, through_heads, visible_stars
from ..stars import load_catalog
from .zhou2021_specification import Attitude, Orbit, Specification

SUBSTEPS = 10
"""Of each second. The integral of the rate is summed over them; what this misses is the coning within a tenth of a second."""
LARGEST_STEP = 0.5 * np.pi
"""Between two attitudes of a file: from half a turn on the shortest way is not the only one, and this leaves a margin."""
SLEW_PHASE_S = 70.0
"""Start of the first slew: at 4000 s, where the gyro is lost, one is under way."""


class Truth(NamedTuple):
    """time (n + 1,) s; q (n + 1, 4) with one continuous sign; turned (n, 3): integral of the rate over each second, rad in
    B; r_N and b_B (n + 1, k, 3): directions of the stars that are seen, in N and in B; seen (n + 1, k)."""

    time: np.ndarray
    q: np.ndarray
    turned: np.ndarray
    r_N: np.ndarray
    b_B: np.ndarray
    seen: np.ndarray


def heads_of(spec: Specification) -> tuple[Head, ...]:
    """Two heads along body x and z with a star each, or one along z with the widest pair."""
    field = np.deg2rad(spec.star.field_deg)
    x, z = np.eye(3)[0], np.eye(3)[2]
    if spec.star.geometry == "wide":
        return (Head(mounted(x), field), Head(mounted(z), field))
    return (Head(mounted(z), field, "widest_pair"),)


def truth_of(spec: Specification) -> Truth:
    """Truth over the scenario's duration. Raises ConfigurationError for an attitude file that does not cover it."""
    n = spec.duration_s
    fine = np.arange(n * SUBSTEPS + 1) / SUBSTEPS
    R = attitude_profile(spec.attitude, spec.orbit, fine)
    q = R.as_quat()
    sign = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0))
    q[1:] *= sign[:, None]
    # R(t + h) = exp(-[omega h x]) R(t)
    small_turns = -(R[1:] * R[:-1].inv()).as_rotvec()
    turned = small_turns.reshape(n, SUBSTEPS, 3).sum(axis=1)
    whole = q[::SUBSTEPS]
    stars = load_catalog(spec.star.faintest).directions()
    R_BN, heads = Rotation.from_quat(whole).as_matrix(), heads_of(spec)
    r_N, seen = visible_stars(R_BN, heads, stars)
    return Truth(np.arange(n + 1.0), whole, turned, r_N, through_heads(R_BN, heads, r_N), seen)


def attitude_profile(attitude: Attitude, orbit: Orbit, time: np.ndarray) -> Rotation:
    """R_BN at increasing times in s."""
    if attitude.profile == "file":
        return _from_file(Path(str(attitude.file)), time)
    elements = Elements(
        orbit.semi_major_axis_km * 1e3,
        orbit.eccentricity,
        *np.radians([orbit.inclination_deg, orbit.raan_deg, orbit.argument_of_perigee_deg, orbit.mean_anomaly_deg]),
    )
    r, v = propagate(elements, time)
    if attitude.profile == "yaw":
        return Rotation.from_matrix(_towards_sun(r, np.array(attitude.sun)))
    H = Rotation.from_matrix(lvlh(r, v))
    return H if attitude.profile == "lvlh" else _slews(attitude, time) * H


def _towards_sun(r: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """R_BN with z to the Earth and the Sun in the half plane of x and z."""
    z = -r / np.linalg.norm(r, axis=1, keepdims=True)
    y = np.cross(z, np.broadcast_to(sun, z.shape))
    size = np.linalg.norm(y, axis=1, keepdims=True)
    if np.min(size) < 1e-3:
        raise ConfigurationError(
            "attitude.sun: the Sun passes the zenith, where yaw steering has no answer; choose another"
        )
    y = y / size
    return np.stack([np.cross(y, z), y, z], axis=1)


def _slews(attitude: Attitude, time: np.ndarray) -> Rotation:
    """The turn on top of the profile: theta (s - sin(2 pi s) / (2 pi)) of each slew, at rest at both ends."""
    since = time - SLEW_PHASE_S
    number = np.floor(since / attitude.slew_every_s).astype(int)
    s = np.clip((since - number * attitude.slew_every_s) / attitude.slew_s, 0.0, 1.0)
    angle = np.deg2rad(attitude.slew_deg) * (s - np.sin(2.0 * np.pi * s) / (2.0 * np.pi))
    done = Rotation.identity()
    out = np.empty((len(time), 4))
    out[number < 0] = [0.0, 0.0, 0.0, 1.0]
    for k in range(max(int(number[-1]), -1) + 1):
        here = number == k
        axis = np.eye(3)[k % 3]
        out[here] = (Rotation.from_rotvec(angle[here, None] * axis) * done).as_quat()
        done = Rotation.from_rotvec(np.deg2rad(attitude.slew_deg) * axis) * done
    return Rotation.from_quat(out)


def _from_file(path: Path, time: np.ndarray) -> Rotation:
    from ..io.profile import profile_gaps, read_attitude_profile

    at, q = read_attitude_profile(path)
    at = at - at[0]
    if at[-1] < time[-1]:
        raise ConfigurationError(
            f"attitude.file {path}: covers {at[-1]:.6g} s, but duration_s is {time[-1]:.6g}; shorten duration_s"
        )
    used = np.flatnonzero(at < time[-1])
    for begin, end in profile_gaps(path):
        if begin < time[-1]:
            raise ConfigurationError(
                f"attitude.file {path}: nothing is known from {begin:.9g} to {end:.9g} s, between two segments of the message, "
                "and over that is not interpolated; give one segment, or a duration_s that ends before"
            )
    turn = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[used] * q[used + 1], axis=1)), 0.0, 1.0))
    if (far := np.flatnonzero(turn > LARGEST_STEP)).size:
        i = int(used[far[0]])
        raise ConfigurationError(
            f"attitude.file {path}: from attitude {i + 1} at {at[i]:.9g} s to attitude {i + 2} at {at[i + 1]:.9g} s the body turns "
            f"by {np.degrees(turn[far[0]]):.4g} deg, and the way between is not known; give attitudes at most 90 deg apart"
        )
    return Slerp(at, Rotation.from_quat(q))(time)
