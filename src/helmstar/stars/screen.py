"""A first weighing of many hypotheses at once: what `verify` does in its first two rounds, in a few array operations for all.

A list that shows no sky has thousands of hypotheses that hit something by chance. Weighed one by one they would take most of
the time that a refusal takes. Stars find their detections through a raster, so that a hypothesis costs its number of stars. It
only sorts, and drops what is hopeless: how well magnitudes fit is taken as told here, and the prior of the detection
probability as even.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ..native import address, kernels
from .magnitudes import BROAD_SHARE, ZERO_POINT_RANGE, broad_sigma, magnitude_gain, zero_point_price
from .patterns import Sky
from .problem import Detections, Freedom
from .verify import (
    GATE,
    HARMONIC,
    LOG_FACTORIAL,
    SO3_VOLUME,
    deepest,
    fit_volumes,
    focal_volume,
    inside,
    log_odds,
    stars_near,
    turns,
)

FIRST_GATE, SECOND_GATE = 4.0, 2.5
"""Of the two rounds, over GATE sigma."""
SIDE = 512
"""Most cells along the raster's longer side."""
MOST_IN_C = 128
"""Detections that screen.c has room for."""


@dataclass(frozen=True)
class Raster:
    """Which detection is nearest to each cell of the image, within the first gate; -1 where there is none.

    cells: (rows * columns + 1,), the last one for what lies outside. cell: px.
    """

    low: np.ndarray
    cell: float
    rows: int
    columns: int
    cells: np.ndarray

    def nearest(self, p: np.ndarray) -> np.ndarray:
        """Index (k,) of the detection near ideal pixels p (k, 2), or -1."""
        c = np.floor((p - self.low) / self.cell)
        good = (c[:, 0] >= 0) & (c[:, 0] < self.columns) & (c[:, 1] >= 0) & (c[:, 1] < self.rows)
        at = np.where(good, c[:, 1] * self.columns + c[:, 0], self.rows * self.columns).astype(int)
        return self.cells.take(at)


def raster(d: Detections) -> Raster:
    """Of the detections."""
    reach = FIRST_GATE * GATE * float(d.sigma.max())
    size = d.high - d.low
    cell = float(max(reach / 4.0, size.max() / SIDE))
    columns, rows = (int(n) + 1 for n in np.ceil(size / cell))
    n = int(np.ceil(reach / cell)) + 1
    offset = np.stack([a.ravel() for a in np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1))], axis=1)
    offset = offset[(offset**2).sum(axis=1) <= (reach / cell + 1.0) ** 2]
    at = np.floor((d.xy - d.low) / cell).astype(int)[:, None] + offset[None]
    centre = d.low + (at + 0.5) * cell
    square = ((centre - d.xy[:, None]) ** 2).sum(axis=2)
    good = ((at >= 0) & (at < [columns, rows])).all(axis=2)
    who = np.broadcast_to(np.arange(len(d))[:, None], good.shape)[good]
    flat, square = (at[..., 1] * columns + at[..., 0])[good], square[good]
    cells = np.full(rows * columns + 1, -1, dtype=np.int32)
    order = np.argsort(-square, kind="stable")
    cells[flat[order]] = who[order]
    return Raster(d.low, cell, rows, columns, cells)


def screen(
    sky: Sky, level: int, d: Detections, cells: Raster, R: np.ndarray, f: np.ndarray, freedom: Freedom
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log odds (h,) of hypotheses R (h, 3, 3), f (h,) after one step, and the R and f that the step led to."""
    library = kernels()
    if library is not None and len(d) <= MOST_IN_C:
        return _compiled(library, sky, level, d, cells, R, f, freedom)
    most = deepest(d)
    lists = [stars_near(sky, level, R[k], float(f[k]), d) for k in range(len(f))]
    star = np.concatenate(lists)
    who = np.repeat(np.arange(len(f)), [len(s) for s in lists])
    r, V = sky.directions.take(star, axis=0), sky.magnitude.take(star)
    odds = np.full(len(f), -np.inf)
    for gate in (FIRST_GATE, SECOND_GATE):
        v = np.matmul(R[who], r[:, :, None])[:, :, 0]
        p = v[:, :2] * (f[who] / np.maximum(v[:, 2], 1e-3))[:, None]
        seen = np.flatnonzero(inside(p, d.low, d.high) & (v[:, 2] > 1e-3) & (d.faintest >= V))
        # The stars of a hypothesis come brightest first: rank is the place among those seen.
        first = np.searchsorted(who[seen], np.arange(len(f) + 1))
        rank = np.arange(len(seen)) - first[who[seen]]
        j = cells.nearest(p[seen])
        near = np.flatnonzero((j >= 0) & (rank < most))
        seen, rank, j = seen[near], rank[near], j[near]
        residual = d.xy[j] - p[seen]
        square = (residual**2).sum(axis=1) / d.sigma[j] ** 2
        close = np.flatnonzero(square <= (gate * GATE) ** 2)
        # A detection belongs to the nearest of the stars that found it.
        key = who[seen[close]] * len(d) + j[close]
        order = np.lexsort((square[close], key))
        keep = close[order[np.flatnonzero(np.diff(key[order], prepend=-1))]]
        keep = keep[np.lexsort((rank[keep], who[seen[keep]]))]
        seen, rank, j, residual, square = seen[keep], rank[keep], j[keep], residual[keep], square[keep]
        h = who[seen]
        count = np.bincount(h, minlength=len(f))
        u = p[seen] / f[h][:, None]
        if gate == FIRST_GATE:
            soft = d.sigma[j] * np.sqrt(1.0 + square / (2.0 * gate) ** 2)
            theta, change = _steps(u, residual, soft, f, h, count, freedom)
            R = np.matmul(turns(theta), R)
            f = np.clip(f * np.exp(np.clip(change, -0.1, 0.1)), 0.97 * freedom.f_low, 1.03 * freedom.f_high)
            continue
        zero = _zero_points(d, V[seen], j, h, count)
        gain = -0.5 * square - np.log(2.0 * np.pi * d.sigma[j] ** 2) - d.log_density[j]
        gain += magnitude_gain(d, V[seen], j, zero[h])
        good = np.flatnonzero(gain > 0.0)
        seen, rank, j, gain, h, u = seen[good], rank[good], j[good], gain[good], h[good], u[good]
        count = np.bincount(h, minlength=len(f))
        information = _information(u, d.sigma[j], f, h, len(f), freedom)[0]
        volume = fit_volumes(information, freedom)
        edge = np.concatenate([[0], np.cumsum(count)])
        for k in np.flatnonzero(count >= 2):
            s = slice(edge[k], edge[k + 1])
            expected = min(int(first[k + 1] - first[k]), most)
            odds[k] = log_odds(gain[s], rank[s], expected, d.vacancy) + zero_point_price(d, int(count[k])) + volume[k]
    return odds, R, f


class _Screen(ctypes.Structure):
    """As in screen.c."""

    _fields_ = (
        [(k, ctypes.c_int64) for k in ("n", "rows", "columns", "most", "members", "stars")]
        + [(k, ctypes.c_double * 2) for k in ("low", "high", "corner")]
        + [
            (k, ctypes.c_double)
            for k in ("cell", "magnitude_sigma", "zero_point", "faintest", "f_low", "f_high", "f_known")
        ]
        + [(k, ctypes.c_double) for k in ("f_sigma", "gate", "first_gate", "second_gate", "volume", "zero_point_range")]
        + [(k, ctypes.c_double) for k in ("broad_share", "broad_sigma")]
        + [
            (k, ctypes.c_void_p)
            for k in ("xy", "sigma", "magnitude", "log_magnitude_density", "log_density", "vacancy")
        ]
        + [
            (k, ctypes.c_void_p)
            for k in ("log_factorial", "harmonic", "directions", "V", "member", "member_directions")
        ]
        + [("cells", ctypes.c_void_p)]
    )


def _compiled(library: ctypes.CDLL, sky: Sky, level: int, d: Detections, cells: Raster, R, f, freedom: Freedom):
    """As `screen`, by screen.c."""
    members, member_directions = sky.deep(level)
    doubles = {
        "xy": d.xy, "sigma": d.sigma, "magnitude": d.magnitude, "log_magnitude_density": d.log_magnitude_density,
        "log_density": d.log_density, "vacancy": d.vacancy, "log_factorial": LOG_FACTORIAL, "harmonic": HARMONIC,
        "directions": sky.directions, "V": sky.magnitude, "member_directions": member_directions,
    }  # fmt: skip
    arrays = {k: np.ascontiguousarray(x, dtype=float) for k, x in doubles.items() if x is not None}
    arrays["member"], arrays["cells"] = members, np.ascontiguousarray(cells.cells, dtype=np.int32)
    s = _Screen(
        n=len(d), rows=cells.rows, columns=cells.columns, most=deepest(d), members=len(members), stars=len(sky.directions),
        low=tuple(d.low), high=tuple(d.high), corner=tuple(cells.low), cell=cells.cell, magnitude_sigma=d.magnitude_sigma,
        zero_point=np.nan if d.zero_point is None else d.zero_point, faintest=d.faintest, f_low=freedom.f_low,
        f_high=freedom.f_high, f_known=freedom.f_known, f_sigma=freedom.sigma, gate=GATE, first_gate=FIRST_GATE,
        second_gate=SECOND_GATE, volume=SO3_VOLUME * focal_volume(freedom), zero_point_range=ZERO_POINT_RANGE,
        broad_share=BROAD_SHARE, broad_sigma=broad_sigma(d.magnitude_sigma), **{k: address(x) for k, x in arrays.items()},
    )  # fmt: skip
    R, f, odds = np.array(R, dtype=float, order="C"), np.array(f, dtype=float), np.empty(len(f))
    done = library.helmstar_screen
    done.restype = ctypes.c_int64
    pointers = [ctypes.c_void_p(address(x)) for x in (R, f, odds)]
    if done(ctypes.byref(s), ctypes.c_int64(len(f)), *pointers) < 0:
        raise MemoryError("no room for the stars of a hypothesis")
    return odds, R, f


def _zero_points(d: Detections, V: np.ndarray, j: np.ndarray, h: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(len(count),) median of V minus magnitude of each hypothesis' matches, or what is known."""
    if d.magnitude is None or d.zero_point is not None or len(j) == 0:
        return np.full(len(count), d.zero_point or 0.0)
    dm = V - d.magnitude[j]
    dm = dm[np.lexsort((dm, h))]
    start = np.cumsum(count) - count
    return dm.take(np.minimum(start + count // 2, len(dm) - 1))


def _information(u: np.ndarray, sigma: np.ndarray, f: np.ndarray, h: np.ndarray, n: int, freedom: Freedom):
    """Information (n, 4, 4) of (theta, ln f) from matches at u (k, 2), and the rows (k, 2, 4) it is made of, over sigma."""
    x, y, one = u[:, 0], u[:, 1], np.ones(len(u))
    J = np.empty((len(u), 2, 4))
    J[:, 0, 0], J[:, 0, 1], J[:, 0, 2], J[:, 0, 3] = -x * y, one + x * x, -y, x
    J[:, 1, 0], J[:, 1, 1], J[:, 1, 2], J[:, 1, 3] = -(one + y * y), x * y, x, y
    J *= (f[h] / sigma)[:, None, None]
    information = _sums(np.matmul(J.transpose(0, 2, 1), J).reshape(-1, 16), h, n).reshape(n, 4, 4)
    if not freedom.free:
        information[:, 3, 3] += 1.0 / max(freedom.sigma, 1e-6) ** 2
    return information, J


def _sums(values: np.ndarray, h: np.ndarray, n: int) -> np.ndarray:
    """Sums (n, c) of values (k, c) by group h (k,)."""
    return np.stack([np.bincount(h, weights=column, minlength=n) for column in values.T], axis=1, dtype=float)


def _steps(u, residual, sigma, f, h, count, freedom: Freedom) -> tuple[np.ndarray, np.ndarray]:
    """Gauss and Newton's step of each hypothesis: theta (n, 3) and change of ln f (n,)."""
    n = len(f)
    information, J = _information(u, sigma, f, h, n, freedom)
    g = _sums(np.matmul(J.transpose(0, 2, 1), (residual / sigma[:, None])[:, :, None])[:, :, 0], h, n)
    if not freedom.free:
        g[:, 3] += np.log(freedom.f_known / f) / max(freedom.sigma, 1e-6) ** 2
    trace = np.trace(information, axis1=1, axis2=2)
    information += (1e-12 * trace + 1e-9)[:, None, None] * np.eye(4)
    delta = np.linalg.solve(information, g[:, :, None])[:, :, 0]
    delta[count < 2] = 0.0
    return delta[:, :3], delta[:, 3]


__all__ = ["Raster", "raster", "screen"]
