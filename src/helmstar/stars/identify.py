"""Lost in space: from a list of centroids to an attitude with its matches, covariance and the probability that it is false."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from ..attitude import quaternion_of_matrix
from .catalog import load_catalog
from .hypotheses import CHUNK, FIRST_CHUNK, Hypotheses
from .patterns import BRIGHT, BRIGHTEST, FAINT, Sky
from .pinhole import Camera, Pinhole
from .problem import Detections, Fit, Freedom, prepare
from .screen import Raster, raster, screen
from .stage import Stage, detection_pairs, stages
from .verify import HOPELESS, jacobian, probability_false, turn, verify

Status = Literal["solved", "too few stars", "no match", "uncertain"]

FEWEST = 3
"""Stars that a solution must match; with a known zero point of magnitudes 2 may do."""
LIMIT = 1e-5
"""Default of the largest probability that a solution is false: a tenth of the share of false solutions that is borne, 1e-4."""
LIMIT_KNOWN = 2e-3
"""The same where the zero point of the magnitudes and the field are known, and the odds' tail is thin (docs/stars.md)."""
KEPT = 5
"""Hypotheses of each chunk that are screened."""
DEPTHS = ((BRIGHTEST, 1.0), (BRIGHT, 1.0), (FAINT, 0.15))
"""Pair tables with how probable it is that they lead to a solution which the others miss. The first is for unknown fields."""
SEARCHED = ((1.0, 1.0), (0.25, 0.5), (2.5, 0.5))
"""Factors on the magnitudes' sigma that the search takes where the zero point is known, and how much each is worth beside the one
that was told; what is told is searched as deeply as without the others."""
WORTH = tuple(1.2e-8 * 2.0**k for k in range(10, -1, -1))
"""Solutions that a look at one more catalogue pair must promise, from first to last (`stage.Stage`)."""
WORK = 6_000_000
"""Catalogue pairs, once for each way they are laid, that are looked at before the search gives up, whatever the next promises."""


@dataclass(frozen=True)
class Identification:
    """What an image shows. Where status is not 'solved', the attitude and all that depends on it are NaN or empty.

    status: 'solved'; 'too few stars'; 'no match': nothing fits better than chance; 'uncertain': the best attitude is more probably
    false than the caller allows.
    q_SN, q_BN: (4,) scalar last, N to sensor frame S and to body B (B is S without a mounting). covariance: (3, 3) rad^2 of the
    error on the left, in S. ra, dec, roll: rad, of the z axis of S; roll is north's angle from image up (-y of S),
    counter-clockwise. detections, stars, hip: (k,) indices of the matches in the caller's list and the catalogue, Hipparcos
    numbers. residuals_px: (k, 2) measured minus predicted. residual_rms: rad, per axis. focal_px: fitted or given.
    zero_point: V minus the given magnitude. probability_false, log_odds: see verify.py. work: catalogue pairs looked at.
    """

    status: Status
    q_SN: np.ndarray
    q_BN: np.ndarray
    covariance: np.ndarray
    ra: float
    dec: float
    roll: float
    detections: np.ndarray
    stars: np.ndarray
    hip: np.ndarray
    residuals_px: np.ndarray
    residual_rms: float
    focal_px: float
    zero_point: float
    probability_false: float
    log_odds: float
    work: int

    @property
    def solved(self) -> bool:
        return self.status == "solved"


@cache
def default_sky(year: float = 2000.0) -> Sky:
    """Hipparcos to V = 9 at a Julian year, without aberration."""
    return Sky(load_catalog(), year)


def identify(
    xy_px: np.ndarray,
    camera: Camera,
    *,
    flux: np.ndarray | None = None,
    magnitude: np.ndarray | None = None,
    sigma_px: float | np.ndarray = 0.5,
    fov_range: tuple[float, float] | None = None,
    focal_sigma: float = 0.001,
    magnitude_sigma: float = 0.4,
    zero_point: float | None = None,
    q_SB: np.ndarray | None = None,
    sky: Sky | None = None,
    limit: float | None = None,
    work: int = WORK,
) -> Identification:
    """Identify the stars of an image without a prior attitude.

    xy_px: (n, 2) image pixels. flux (n,) > 0 or magnitude (n,): brightness in any band and unit, the order matters most; without
    them the list is taken as it comes. sigma_px: 1 sigma per axis, a number, (n,), or covariances (n, 2, 2).
    camera: its focal length and distortion do not count when fov_range, horizontal full fields (rad), is given; focal_sigma:
    relative 1 sigma of its focal length otherwise. magnitude_sigma: 1 sigma of V minus (magnitude + zero point), a first guess
    where the zero point is known; zero_point: where it is (`calibrate_photometry`). q_SB: (4,) mounting. limit: largest
    probability_false of what is called solved, LIMIT by default, LIMIT_KNOWN where zero point and field are known. work:
    catalogue pairs to look at before giving up.

    Entries that are not finite are left out, and places that no direction reaches through the camera's distortion. Raises
    ValueError for shapes, ranges and parameters that mean nothing.
    """
    freedom = focal_freedom(camera, fov_range, focal_sigma)
    if fov_range is not None:  # the distortion is in units of a focal length that is not known
        camera = Pinhole(1.0, camera.centre_px, camera.size_px, camera.aspect)
    d, covariances = prepare(xy_px, camera, flux, magnitude, sigma_px, magnitude_sigma, zero_point)
    if q_SB is not None:
        q_SB = unit_quaternion("q_SB", q_SB)
    if limit is None:
        limit = LIMIT_KNOWN if d.knows_zero and not freedom.free else LIMIT
    if not 0.0 < limit < 1.0:
        raise ValueError(f"limit {limit}: must be between 0 and 1")
    sky = default_sky() if sky is None else sky
    fewest = 2 if d.knows_zero and not freedom.free else FEWEST
    if len(d) < fewest:
        return unsolved("too few stars", 0)
    fits, done = search(sky, d, freedom, fewest, limit, work)
    return conclude(sky, d, covariances, freedom, fits, done, fewest, limit, q_SB)


def focal_freedom(camera: Camera, fov_range: tuple[float, float] | None, focal_sigma: float) -> Freedom:
    """The focal length's prior. Raises ValueError for a range or sigma that means nothing."""
    if fov_range is None:
        if not (np.isfinite(camera.focal_px) and camera.focal_px > 0.0):
            raise ValueError(f"focal_px {camera.focal_px}: must be positive; give fov_range where it is unknown")
        if not 0.0 <= focal_sigma < 0.05:
            raise ValueError(f"focal_sigma {focal_sigma}: must be 0 to 0.05; give fov_range for less certain fields")
        f = float(camera.focal_px)
        return Freedom(f * (1.0 - 5.0 * focal_sigma), f * (1.0 + 5.0 * focal_sigma), f, focal_sigma)
    low, high = fov_range
    if not 0.0 < low < high < np.pi:
        raise ValueError(f"fov_range {fov_range} rad: must be increasing between 0 and pi")
    half = 0.5 * camera.size_px[0]
    return Freedom(half / float(np.tan(0.5 * high)), half / float(np.tan(0.5 * low)))


def search(sky: Sky, d: Detections, freedom: Freedom, fewest: int, limit: float, work: int) -> tuple[list[Fit], int]:
    """Distinct fits found, and the catalogue pairs looked at; stops at the first that is convincing.

    What promises most per catalogue pair comes first, and the search ends when nothing is worth it any more.
    """
    enough = min(limit, LIMIT)
    fits: list[Fit] = []
    done = 0
    depths = [(n, prior) for n, prior in DEPTHS if freedom.free or n != BRIGHTEST]
    pairs = detection_pairs(d)
    tables = [s for own, weight in with_other_sigmas(d) for s in stages(sky, own, pairs, freedom, depths, weight)]
    cells = raster(d)
    for worth in WORTH:
        for stage in tables:
            for looked, found in stage.hypotheses(worth, KEPT, min(max(done, FIRST_CHUNK), CHUNK)):
                done += looked
                if found is not None and weigh(sky, stage, d, cells, found, freedom, fits, fewest, enough):
                    return fits, done
                if done > work:
                    return fits, done
    return fits, done


def with_other_sigmas(d: Detections) -> list[tuple[Detections, float]]:
    """The detections as the search takes them, and the weights of each: with other sigmas of the magnitudes where the zero point
    is known. Too narrow a sigma hides true pairs among those that do not fit, too wide a one among those that do."""
    if not d.knows_zero:
        return [(d, 1.0)]
    return [(replace(d, magnitude_sigma=factor * d.magnitude_sigma), weight) for factor, weight in SEARCHED]


def weigh(
    sky: Sky, stage: Stage, d: Detections, cells: Raster, found: Hypotheses, freedom: Freedom, fits: list[Fit], fewest: int,
    limit: float,
) -> bool:  # fmt: skip
    """Screen hypotheses, verify what remains, the best first, and add the fits to the list; True once one is convincing."""
    n = int((found.score > fewest - 0.5).sum())
    if n == 0:
        return False
    odds, R, f = screen(sky, stage.level, stage.d, cells, found.R[:n], found.f[:n], freedom)
    closest = 2.0 * d.typical_sigma
    for k in np.argsort(-odds):
        if odds[k] < HOPELESS:
            break
        # A hypothesis on top of a fit would lead there again. Not so one nearby: a short pair may have led to a poor fit.
        focal = float(f[k])
        if any(same(R[k], focal, fit, closest / focal, 1e-3) for fit in fits):
            continue
        fit = verify(sky, stage.level, d, R[k], focal, freedom, first_gate=2.5, rounds=2)
        if fit is None or len(fit.stars) < fewest:
            continue
        add(fits, fit)
        if fit.log_odds > -np.log(limit) and probability_false(fits) < limit:
            return True
    return False


def same(R: np.ndarray, f: float, fit: Fit, angle: float = 0.017, ratio: float = 0.02) -> bool:
    """Whether an attitude and focal length are within an angle (rad) and a ratio of a fit's."""
    return abs(f / fit.f - 1.0) < ratio and float((R * fit.R).sum()) > 3.0 - angle**2


def add(fits: list[Fit], fit: Fit) -> None:
    """Keep the better of two fits of one attitude."""
    for k, other in enumerate(fits):
        if same(fit.R, fit.f, other):
            if fit.log_odds > other.log_odds:
                fits[k] = fit
            return
    fits.append(fit)


def conclude(
    sky: Sky,
    d: Detections,
    covariances: np.ndarray,
    freedom: Freedom,
    fits: list[Fit],
    done: int,
    fewest: int,
    limit: float,
    q_SB: np.ndarray | None,
) -> Identification:
    """The best fit as a solution, polished with the detections' covariances; or why there is none."""
    if not fits:
        return unsolved("no match", done)
    best = max(fits, key=lambda fit: fit.log_odds)
    p_false = probability_false(fits)
    if not p_false < limit or len(best.stars) < fewest:
        return unsolved("no match" if best.log_odds < 0.0 else "uncertain", done, p_false, best.log_odds)
    R, f, P, residuals = polish(sky, d, covariances[best.detections], best, freedom)
    q_SN = quaternion_of_matrix(R)
    q_BN = q_SN if q_SB is None else quaternion_of_matrix(matrix_of_quaternion(q_SB).T @ R)
    z = R[2]
    ra, dec = float(np.arctan2(z[1], z[0]) % (2.0 * np.pi)), float(np.arcsin(np.clip(z[2], -1.0, 1.0)))
    # The north pole seen in S: its angle from -y, positive towards -x.
    roll = float(np.arctan2(-R[0, 2], -R[1, 2]) % (2.0 * np.pi))
    rms = float(np.sqrt((residuals**2).mean()) / f)
    return Identification(
        "solved", q_SN, q_BN, P, ra, dec, roll, d.order[best.detections], best.stars, sky.catalog.hip[best.stars],
        residuals, rms, f, best.zero_point, p_false, best.log_odds, done,
    )  # fmt: skip


def polish(sky: Sky, d: Detections, C: np.ndarray, fit: Fit, freedom: Freedom):
    """R, f, covariance (3, 3) and residuals (k, 2) by Gauss and Newton's steps from the fit, with the whole covariances and f.

    With round covariances and f known this is Wahba's optimum, which the solvers of attitude/ reach from nowhere in three times
    the time; the fit is a good start, and they know neither f nor ellipses.

    The covariance is that of the detections, times chi-square per degree of freedom where the residuals say more.
    """
    xy, f = d.xy[fit.detections], fit.f
    r = sky.directions[fit.stars]
    R = fit.R
    W = np.linalg.inv(C)
    information = np.zeros((4, 4))
    for _ in range(2):
        v = r @ R.T
        u = v[:, :2] / v[:, 2:]
        J = jacobian(u, f)
        residual = xy - f * u
        WJ = np.matmul(W, J).reshape(-1, 4)
        information = J.reshape(-1, 4).T @ WJ
        g = WJ.T @ residual.ravel()
        if not freedom.free:
            weight = 1.0 / max(freedom.sigma, 1e-6) ** 2
            information[3, 3] += weight
            g[3] += weight * np.log(freedom.f_known / f)
        delta = np.linalg.solve(information, g)
        R, f = turn(delta[:3], R), f * float(np.exp(delta[3]))
    v = r @ R.T
    residual = xy - f * v[:, :2] / v[:, 2:]
    chi2 = float(np.einsum("ki,kij,kj->", residual, W, residual))
    freedoms = 2 * len(xy) - (4 if freedom.free else 3)
    inflation = max(1.0, chi2 / freedoms) if freedoms > 4 else 1.0
    return R, f, np.linalg.inv(information)[:3, :3] * inflation, residual


def unit_quaternion(name: str, q: np.ndarray) -> np.ndarray:
    """q (4,) normalised. Raises ValueError for what is no attitude."""
    q = np.asarray(q, dtype=float)
    norm = math.sqrt(q @ q) if q.shape == (4,) else math.nan
    if not 0.5 < norm < 2.0:
        raise ValueError(f"{name} {q}: must be a unit quaternion, scalar last")
    return q / norm


def matrix_of_quaternion(q: np.ndarray) -> np.ndarray:
    """R (3, 3) of q (4,) scalar last: as `attitude.matrix_of_quaternion`, in plain numbers."""
    x, y, z, w = q.tolist()
    return np.array([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ])  # fmt: skip


def unsolved(status: Status, done: int, p_false: float = 1.0, odds: float = -np.inf) -> Identification:
    """An identification without an attitude."""
    nan, none = float("nan"), np.zeros(0, dtype=int)
    q = np.full(4, nan)
    return Identification(
        status, q, q, np.full((3, 3), nan), nan, nan, nan, none, none, none, np.zeros((0, 2)), nan, nan, nan, p_false, odds,
        done,
    )  # fmt: skip


__all__ = ["Identification", "default_sky", "identify"]
