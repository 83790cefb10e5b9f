"""Attitude hypotheses: pairs of detections laid on pairs of catalogue stars, ranked by what the other detections then hit.

A pair with its two assignments fixes the attitude, and the focal length too where that is unknown. There are thousands of
catalogue pairs of the right separation for each pair of detections; magnitudes thin them out, and a map of the sky tells in a
few array operations what lies where each hypothesis puts the other detections. Unlike a hash of three or four stars this
needs only two of the detections to be real and in the table, and what it tolerates is a number, not a bin.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..native import address, kernels
from .patterns import EMPTY, FAINT, RUNG, Level, Pairs, SkyMap
from .problem import Detections, Freedom

FIRST_TEST = 14
"""Detections that every hypothesis is tried on."""
FIRST_KEPT, FIRST_SHARE = 400, 0.05
"""Number and share of the hypotheses of a chunk, at least, that are then tried on all detections."""
FIRST_CHUNK, CHUNK = 2000, 24000
"""Candidate catalogue pairs that are looked at in one go."""
BLOCK = 2000
"""Hypotheses that are scored in one go: what stays in the processor's cache."""
PAIR_GATE, MAGNITUDE_GATE = 3.0, 2.2
"""Separations and magnitude differences may be off by this many sigma."""
MAGNITUDES = np.where(np.arange(256) == EMPTY, 1e6, np.arange(256) * 0.05 - 2.0).astype(np.float32)
"""Of the sky map's values."""
MOST_IN_C = 128
"""Detections that hypotheses.c has room for."""


@dataclass(frozen=True)
class Hypotheses:
    """R (c, 3, 3) = R_SN, f (c,) px, score (c,): the pair's two and the other detections that hit something, weighed; the best
    first."""

    R: np.ndarray
    f: np.ndarray
    score: np.ndarray


def tolerance_px(d: Detections, freedom: Freedom) -> float:
    """How far from its star a true detection may land under a hypothesis of a true pair, in px."""
    return float(2.2 * 2.5 * d.typical_sigma + 0.25 * np.sqrt(d.area) * 2.5 * freedom.sigma)


def separations(d: Detections, pairs: np.ndarray, f: float) -> np.ndarray:
    """Angles (m,) rad between the two detections of each pair."""
    v = np.concatenate([d.xy, np.full((len(d), 1), f)], axis=1)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    chord = np.linalg.norm(v[pairs[:, 0]] - v[pairs[:, 1]], axis=1)
    return 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))


def spans(table: Pairs, d: Detections, pairs: np.ndarray, freedom: Freedom) -> tuple[np.ndarray, np.ndarray]:
    """First row and number of rows (m,) of the table that have each pair's separation."""
    sigma = d.sigma[pairs]
    slack = PAIR_GATE * np.hypot(sigma[:, 0], sigma[:, 1])
    if freedom.free:
        begin = separations(d, pairs, freedom.f_high) - slack / freedom.f_high
        end = separations(d, pairs, freedom.f_low) + slack / freedom.f_low
    else:
        angle = separations(d, pairs, freedom.f_known)
        slack = slack / freedom.f_known + PAIR_GATE * freedom.sigma * angle
        begin, end = angle - slack, angle + slack
    first = np.searchsorted(table.angle, begin.astype(np.float32), side="left")
    return first, np.maximum(np.searchsorted(table.angle, end.astype(np.float32), side="right") - first, 0)


def hypotheses(
    level: Level, n: int, d: Detections, pairs: np.ndarray, freedom: Freedom, keep: int, chunk: int = FIRST_CHUNK
) -> Iterator[tuple[int, Hypotheses | None]]:
    """Chunks of ranked hypotheses of the n-star table, each with the number of catalogue pairs it looked at.

    The first chunk has `chunk` catalogue pairs or more, every later one twice as many, up to CHUNK.
    """
    table = thinned(level.pairs(n), level.catalog.magnitude, d)
    first, count = spans(table, d, pairs, freedom)
    total = np.cumsum(count)
    library = kernels()
    chunk_of = _chunk if library is None or len(d) > MOST_IN_C else _Compiled(library, level, table, d, freedom).chunk
    start = 0
    while start < len(pairs):
        done = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, done + chunk, side="right")))
        chunk = min(2 * chunk, CHUNK)
        s = slice(start, stop)
        yield int(total[stop - 1] - done), chunk_of(level, table, d, pairs[s], first[s], count[s], freedom, keep)
        start = stop


def thinned(table: Pairs, V: np.ndarray, d: Detections) -> Pairs:
    """Without the stars that are too faint for any detection, where the zero point is known."""
    if not d.knows_zero:
        return table
    keep = np.flatnonzero(table.second < np.searchsorted(V, d.faintest, side="right"))
    return Pairs(table.first[keep], table.second[keep], table.angle[keep])


def _chunk(level: Level, table: Pairs, d: Detections, pairs, first, count, freedom: Freedom, keep: int):
    total = int(count.sum())
    if total == 0:
        return None
    which = np.repeat(np.arange(len(pairs)), count)
    at = np.arange(total) + np.repeat(first - (np.cumsum(count) - count), count)
    a, b = table.first.take(at), table.second.take(at)
    V, m = level.brightness, d.magnitude
    zero = None
    if m is None:
        i, j = pairs[which].T
        i, j = np.concatenate([i, j]), np.concatenate([j, i])
        a, b = np.concatenate([a, a]), np.concatenate([b, b])
    else:
        m = m.astype(np.float32)
        mi, mj = m[pairs].T
        step_d, step_c = (mi - mj)[which], V.take(a) - V.take(b)
        # The table has the brighter star first, and mostly the detections too, as they are sorted.
        gate = np.float32(MAGNITUDE_GATE * np.sqrt(2.0) * d.magnitude_sigma)
        same, other = np.flatnonzero(np.abs(step_d - step_c) < gate), np.flatnonzero(np.abs(step_d + step_c) < gate)
        i = np.concatenate([pairs[which[same], 0], pairs[which[other], 1]])
        j = np.concatenate([pairs[which[same], 1], pairs[which[other], 0]])
        a, b = np.concatenate([a[same], a[other]]), np.concatenate([b[same], b[other]])
        if d.zero_point is None:
            zero = 0.5 * (V[a] - m[i] + V[b] - m[j])
        else:
            zero = np.full(len(i), d.zero_point, dtype=np.float32)
            gate = 3.0 * d.magnitude_sigma
            near = np.flatnonzero((np.abs(V[a] - m[i] - zero) < gate) & (np.abs(V[b] - m[j] - zero) < gate))
            i, j, a, b, zero = i[near], j[near], a[near], b[near], zero[near]
    if len(i) == 0:
        return None
    return _rank(level, d, i, j, a, b, zero, freedom, keep)


def focal_lengths(d: Detections, i, j, cosine: np.ndarray) -> np.ndarray:
    """f (h,) px at which detections i and j are apart by the angle of that cosine; NaN where none is."""
    p = (d.xy[i] * d.xy[j]).sum(axis=1)
    square = (d.xy**2).sum(axis=1)
    qi, qj = square[i], square[j]
    c2 = cosine**2
    A, B, C = 1.0 - c2, 2.0 * p - c2 * (qi + qj), p * p - c2 * qi * qj
    with np.errstate(invalid="ignore"):
        return np.sqrt((-B + np.sqrt(B * B - 4.0 * A * C)) / (2.0 * A))


def _axes(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Orthonormal rows (h, 3, 3) along the sum, the difference and the normal of unit directions (h, 3): errors shared evenly."""
    axes = np.stack([first + second, first - second, np.cross(second, first)], axis=1)
    return axes / np.linalg.norm(axes, axis=2, keepdims=True)


def rotations(d: Detections, i, j, f, va: np.ndarray, vb: np.ndarray) -> np.ndarray:
    """R_SN (h, 3, 3) that lay stars va, vb (h, 3) on detections i, j at focal lengths f (h,)."""
    s = [np.concatenate([d.xy[k], f[:, None]], axis=1) for k in (i, j)]
    si, sj = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in s)
    return np.matmul(_axes(si, sj).transpose(0, 2, 1), _axes(va, vb))


def _laid(d: Detections, i, j, f: np.ndarray, va: np.ndarray, vb: np.ndarray) -> np.ndarray:
    """M (3, h, 3): detection t of `_coordinates` is seen, under each hypothesis, along M @ T[:, t] in N.

    With p = (x, y, f), any p_t = A p_i + B p_j + C p_i x p_j, and stars v_a, v_b lie along p_i, p_j: no rotation is needed.
    A and B are a_t and 1 - a_t plus multiples of e_t, C is a multiple of e_t, where a_t and e_t are place along and distance
    from the line through i and j, which f does not change.
    """
    x, y = d.xy.T.astype(np.float32)
    xi, yi, xj, yj = x.take(i), y.take(i), x.take(j), y.take(j)
    square = f * f
    X, Y = va * np.sqrt(xi * xi + yi * yi + square), vb * np.sqrt(xj * xj + yj * yj + square)
    dx, dy, D = xi - xj, yi - yj, xi * yj - xj * yi
    length = dx * dx + dy * dy
    scale = 1.0 / (square * length + D * D)
    w = (dx * xj + dy * yj) / length
    D *= scale
    scale *= f
    M = np.empty((3, len(f), 3), dtype=np.float32)
    M[:, :, 0], M[:, :, 1] = X, Y
    M[0, :, 2] = X[1] * Y[2] - X[2] * Y[1]
    M[1, :, 2] = X[2] * Y[0] - X[0] * Y[2]
    M[2, :, 2] = X[0] * Y[1] - X[1] * Y[0]
    M[:, :, 2] *= scale
    M[:, :, 2] += (D * w) * X - (D * (1.0 + w)) * Y
    return M


def _coordinates(d: Detections, i: np.ndarray, j: np.ndarray, tests: np.ndarray) -> np.ndarray:
    """T (m, 3, t): a, 1 - a and e (see `_laid`) of the detections `tests` (m, t) for pairs i, j (m,)."""
    xi, xj = d.xy[i], d.xy[j]
    u = xi - xj
    t = d.xy[tests]
    a = ((t - xj[:, None]) * u[:, None]).sum(axis=2) / (u * u).sum(axis=1, keepdims=True)
    e = t[:, :, 0] * u[:, None, 1] - t[:, :, 1] * u[:, None, 0] + (xi[:, :1] * xj[:, 1:] - xj[:, :1] * xi[:, 1:])
    return np.stack([a, 1.0 - a, e], axis=1).astype(np.float32)


def _rank(level: Level, d: Detections, i, j, a, b, zero, freedom: Freedom, keep: int) -> Hypotheses | None:
    N = level.single
    va, vb = N.take(a, axis=1), N.take(b, axis=1)
    if freedom.free:
        # cos = 1 - chord^2 / 2 keeps its digits in single precision.
        f = focal_lengths(d, i, j, 1.0 - 0.5 * ((va - vb).astype(float) ** 2).sum(axis=0))
        good = np.flatnonzero((f >= freedom.f_low) & (f <= freedom.f_high))
        if len(good) == 0:
            return None
        i, j, a, b, f, va, vb = i[good], j[good], a[good], b[good], f[good], va[:, good], vb[:, good]
        zero = None if zero is None else zero[good]
    else:
        f = np.full(len(i), freedom.f_known)
    M = _laid(d, i, j, f.astype(np.float32), va, vb)
    sky_map = level.sky_map(FAINT, tolerance_px(d, freedom) / float(np.median(f)))
    few = min(FIRST_TEST, len(d))
    score = 2.0 + _score(sky_map, d, M, i, j, zero, slice(0, few))
    best = np.sort(_largest(score, max(FIRST_KEPT, keep, int(FIRST_SHARE * len(f)))))
    if len(d) > FIRST_TEST:
        some = None if zero is None else zero[best]
        score[best] += _score(sky_map, d, M[:, best], i[best], j[best], some, slice(few, len(d)))
    best = best[_largest(score[best], keep)]
    return _chosen(level, d, i[best], j[best], a[best], b[best], f[best], score[best])


def _chosen(level: Level, d: Detections, i, j, a, b, f, score) -> Hypotheses:
    return Hypotheses(rotations(d, i, j, f, level.directions[a], level.directions[b]), f, score)


_int, _int32, _float, _double = ctypes.c_int64, ctypes.c_int32, ctypes.c_float, ctypes.c_double


def _at(x: np.ndarray | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if x is None else address(x))


_kept = threading.local()


def _scratch(room: int) -> tuple[np.ndarray, ...]:
    """Room for hypotheses, the last chunk's where it suffices: fresh memory costs more than what is written there."""
    if getattr(_kept, "room", 0) < room:
        _kept.room = max(room, 4 * CHUNK)
        ij, ab = np.empty((_kept.room, 2), dtype=np.int32), np.empty((_kept.room, 2), dtype=np.int32)
        zero, score = np.empty(_kept.room, dtype=np.float32), np.empty(2 * _kept.room, dtype=np.float32)
        _kept.arrays = ij, ab, np.empty(_kept.room), zero, score
    return _kept.arrays


class _Compiled:
    """What `_chunk` does, by hypotheses.c; all that a search's chunks share is made ready once."""

    def __init__(self, library: ctypes.CDLL, level: Level, table: Pairs, d: Detections, freedom: Freedom):
        self.candidates, self.best = library.helmstar_candidates, library.helmstar_best
        self.candidates.restype = self.best.restype = ctypes.c_int64
        self.stars = np.ascontiguousarray(level.rows, dtype=np.float32)
        self.first, self.second = (np.ascontiguousarray(x, dtype=np.int32) for x in (table.first, table.second))
        self.xy = np.ascontiguousarray(d.xy, dtype=float)
        self.m = None if d.magnitude is None else np.ascontiguousarray(d.magnitude, dtype=np.float32)
        self.mixed = mixed(len(d)).astype(np.int32)

    def chunk(self, level: Level, table: Pairs, d: Detections, pairs, first, count, freedom: Freedom, keep: int):
        room = 2 * int(count.sum())
        if room == 0:
            return None
        pairs, first, count = (np.ascontiguousarray(x, dtype=np.int64) for x in (pairs, first, count))
        ij, ab, f, zero, score = _scratch(room)
        n_stars, n = _int(len(self.stars)), len(d)
        h = self.candidates(
            n_stars, _at(self.stars), _int(len(self.first)), _at(self.first), _at(self.second), _int(n), _at(self.xy),
            _at(self.m), _int(len(pairs)), _at(pairs), _at(first), _at(count),
            _float(MAGNITUDE_GATE * np.sqrt(2.0) * d.magnitude_sigma), _float(np.nan if d.zero_point is None else d.zero_point),
            _float(3.0 * d.magnitude_sigma), _double(0.0 if freedom.free else freedom.f_known), _double(freedom.f_low),
            _double(freedom.f_high), _int(room), _at(ij), _at(ab), _at(f), _at(zero),
        )  # fmt: skip
        if h < 0:
            raise ValueError("the pair table names stars that are not in the catalogue: it was made from another one")
        if h == 0:
            return None
        sky_map = level.sky_map(
            FAINT, tolerance_px(d, freedom) / (float(np.median(f[:h])) if freedom.free else freedom.f_known)
        )
        best = np.empty(keep, dtype=np.int64)
        found = self.best(
            n_stars, _at(self.stars), _int32(n), _at(self.xy), _at(self.m), _at(self.mixed), _int32(min(FIRST_TEST, n)), _int(h),
            _at(ij), _at(ab), _at(f), _at(zero), _int32(sky_map.side), _at(sky_map.coarse), _at(sky_map.cells), _at(MAGNITUDES),
            _float(sharpness(d)), _int(max(FIRST_KEPT, keep, int(FIRST_SHARE * h))), _int(keep), _at(score), _at(best),
        )  # fmt: skip
        if found < 0:
            raise ValueError("a chunk of hypotheses is out of range")
        best = best[:found]
        return _chosen(level, d, *ij[best].T, *ab[best].T, f[best], score[best])


def _largest(score: np.ndarray, keep: int) -> np.ndarray:
    """Indices of the `keep` largest, the largest first, earlier ones first among equals."""
    if len(score) > keep:
        limit = np.partition(score, len(score) - keep)[len(score) - keep]
        above, equal = np.flatnonzero(score > limit), np.flatnonzero(score == limit)
        chosen = np.concatenate([above, equal[: keep - len(above)]])
        return chosen[np.argsort(-score[chosen], kind="stable")]
    return np.argsort(-score, kind="stable")


def _test_order(n: int, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """(m, n) the order in which n detections test the hypotheses of pairs i, j (m,).

    Bright and faint ones alike come early, as the brightest few may all be false; and each pair starts elsewhere, as any few
    may all be false: that must not fail every true pair at once.
    """
    return mixed(n)[((31 * i + 17 * j)[:, None] + np.arange(n)) % n]


def mixed(n: int) -> np.ndarray:
    """(n,) ranks of brightness, every third first."""
    return np.concatenate([np.arange(k, n, 3) for k in range(3)])


def sharpness(d: Detections) -> float:
    """What a difference of magnitudes is multiplied with before its fourth power."""
    return 0.45 / float(np.hypot(1.3 * d.magnitude_sigma, 0.05))


def _score(sky_map: SkyMap, d: Detections, M: np.ndarray, i, j, zero: np.ndarray | None, which: slice) -> np.ndarray:
    """Weighed hits (h,) of detections other than i and j, those at `which` of each pair's order, under M (3, h, 3) of `_laid`.

    Runs of hypotheses share their pair of detections: they are one matrix product.
    """
    h = len(i)
    run = np.concatenate([[0], np.flatnonzero((np.diff(i) != 0) | (np.diff(j) != 0)) + 1, [h]])
    at = run[:-1]
    tests = _test_order(len(d), i[at], j[at])[:, which]
    own = (tests == i[at][:, None]) | (tests == j[at][:, None])
    T = _coordinates(d, i[at], j[at], tests)
    score = np.empty(h, dtype=np.float32)
    v = np.empty((3, min(h, BLOCK), tests.shape[1]), dtype=np.float32)
    m = None if d.magnitude is None else d.magnitude.astype(np.float32)[tests]
    for begin in range(0, h, BLOCK):
        end = min(begin + BLOCK, h)
        r0 = int(np.searchsorted(run, begin, side="right")) - 1
        r1 = int(np.searchsorted(run, end, side="left"))
        edges = np.clip(run[r0 : r1 + 1], begin, end) - begin
        for r in range(r0, r1):
            p, q = edges[r - r0], edges[r - r0 + 1]
            np.matmul(M[:, begin + p : begin + q], T[r], out=v[:, p:q])
        found = sky_map.cells.take(sky_map.index(v[0, : end - begin], v[1, : end - begin], v[2, : end - begin]))
        r = np.repeat(np.arange(r0, r1), np.diff(edges))
        found[own[r]] = EMPTY
        if zero is None or m is None:
            score[begin:end] = np.count_nonzero(found != EMPTY, axis=1)
            continue
        # Empty cells look up a star so faint that its weight is nothing.
        z = MAGNITUDES.take(found)
        z -= m[r]
        z -= zero[begin:end, None]
        z *= np.float32(sharpness(d))
        z *= z
        z *= z
        z += np.float32(1.0)
        score[begin:end] = np.reciprocal(z, out=z).sum(axis=1)
    return score


def levels_for(d: Detections, freedom: Freedom, ladder: tuple[float, ...]) -> list[tuple[int, Freedom]]:
    """Levels that serve the focal lengths allowed, each with the part of the interval that is its own."""
    side = np.sqrt(d.area)
    out = []
    for k, fov in enumerate(ladder):
        wide = np.inf if k == len(ladder) - 1 else fov * RUNG
        narrow = 0.0 if k == 0 else fov / RUNG
        high = np.inf if narrow == 0.0 else side / (2.0 * np.tan(0.5 * narrow))
        low = 0.0 if wide == np.inf else side / (2.0 * np.tan(0.5 * wide))
        if freedom.free:
            low, high = max(low, freedom.f_low), min(high, freedom.f_high)
            if low < high:
                out.append((k, Freedom(low, high)))
        elif low <= freedom.f_known < high:
            out.append((k, freedom))
    return out


__all__ = ["Hypotheses", "hypotheses", "levels_for", "spans", "thinned"]
