"""Attitude hypotheses: pairs of detections laid on pairs of catalogue stars, ranked by what the other detections then hit.

A pair with its two assignments fixes the attitude, and the focal length too where that is unknown. There are thousands of
catalogue pairs of the right separation for each pair of detections; magnitudes thin them out, and a map of the sky tells in a
few array operations what lies where each hypothesis puts the other detections. Unlike a hash of three or four stars this
needs only two of the detections to be real and in the table, and what it tolerates is a number, not a bin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .patterns import EMPTY, FAINT, RUNG, SHORTEST, Level, Pairs, SkyMap
from .verify import Detections, Freedom

FIRST_TEST, FIRST_KEPT, FEW = 10, 400, 1500
"""Detections that every hypothesis is tried on, and the number of hypotheses that are then tried on all; of FEW or more
hypotheses in a chunk, twice as many detections and at least a twentieth."""
MOST_PAIRED, MOST_PAIRED_LATER, MOST_PAIRED_KNOWN = 26, 50, 100
"""Detections that are paired at first; when those are exhausted; and where calibrated magnitudes leave few catalogue pairs for
each."""
FIRST_CHUNK, CHUNK = 2000, 24000
"""Candidate catalogue pairs that are looked at in one go."""
PAIR_GATE, MAGNITUDE_GATE = 3.0, 2.2
"""Separations and magnitude differences may be off by this many sigma."""
FIELD_REACH = 0.70
"""Longest pairs of detections, over the field."""
MAGNITUDES = np.where(np.arange(256) == EMPTY, 1e6, np.arange(256) * 0.05 - 2.0).astype(np.float32)
"""Of the sky map's values."""


@dataclass(frozen=True)
class Hypotheses:
    """R (c, 3, 3) = R_SN, f (c,) px, score (c,): detections that hit something, weighed; the best first."""

    R: np.ndarray
    f: np.ndarray
    score: np.ndarray


def detection_pairs(d: Detections, later: bool = False) -> np.ndarray:
    """(m, 2) indices of pairs to try, the brightest first, neither too short for a good lever nor too long for the tables.

    later: those that the first call left out.
    """
    calibrated = d.zero_point is not None and d.magnitude is not None
    at_first = MOST_PAIRED_KNOWN if calibrated else MOST_PAIRED
    n = min(len(d), max(at_first, MOST_PAIRED_LATER) if later else at_first)
    i, j = np.triu_indices(n, 1)
    length = np.hypot(*(d.xy[i] - d.xy[j]).T)
    field = np.sqrt(d.area)
    keep = (length > 1.5 * SHORTEST * field) & (length < FIELD_REACH * field) & ((j >= at_first) | (not later))
    i, j, length = i[keep], j[keep], length[keep]
    # Sums of ranks, not the later rank: one false bright object must not spoil the first n - 1 trials.
    order = np.argsort(i + j + 0.5 * np.abs(length / field - 0.35), kind="stable")
    return np.stack([i[order], j[order]], axis=1)


def tolerance_px(d: Detections, freedom: Freedom) -> float:
    """How far from its star a true detection may land under a hypothesis of a true pair, in px."""
    return float(2.2 * 2.5 * d.typical_sigma + 0.25 * np.sqrt(d.area) * 2.5 * freedom.sigma)


def separations(d: Detections, pairs: np.ndarray, f: float) -> np.ndarray:
    """Angles (m,) rad between the two detections of each pair."""
    v = np.concatenate([d.xy, np.full((len(d), 1), f)], axis=1)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    chord = np.linalg.norm(v[pairs[:, 0]] - v[pairs[:, 1]], axis=1)
    return 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))


def hypotheses(
    level: Level, n: int, d: Detections, pairs: np.ndarray, freedom: Freedom, keep: int, chunk: int = FIRST_CHUNK
) -> Iterator[tuple[int, Hypotheses | None]]:
    """Chunks of ranked hypotheses of the n-star table, each with the number of catalogue pairs it looked at.

    The first chunk has `chunk` catalogue pairs or more, every later one twice as many, up to CHUNK.
    """
    table = thinned(level.pairs(n), level.catalog.magnitude, d)
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
    count = np.maximum(np.searchsorted(table.angle, end.astype(np.float32), side="right") - first, 0)
    total = np.cumsum(count)
    start = 0
    while start < len(pairs):
        done = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, done + chunk, side="right")))
        chunk = min(2 * chunk, CHUNK)
        s = slice(start, stop)
        yield int(total[stop - 1] - done), _chunk(level, table, d, pairs[s], first[s], count[s], freedom, keep)
        start = stop


def thinned(table: Pairs, V: np.ndarray, d: Detections) -> Pairs:
    """Without the stars that are too faint for any detection, where the zero point is known."""
    if d.zero_point is None or d.magnitude is None:
        return table
    faintest = d.magnitude.max() + d.zero_point + 3.0 * d.magnitude_sigma
    keep = np.flatnonzero(table.second < np.searchsorted(V, faintest, side="right"))
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


def _frame(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (3, h) along the sum, the difference and the normal of unit directions (3, h): errors shared evenly."""
    total, difference = first + second, first - second
    x, y = total, difference
    normal = np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
    tt, dd = (total * total).sum(axis=0), (difference * difference).sum(axis=0)
    return total / np.sqrt(tt), difference / np.sqrt(dd), normal / np.sqrt(tt * dd)


def _rotations(d: Detections, i, j, f, va: np.ndarray, vb: np.ndarray) -> np.ndarray:
    """R_SN as (3, 3, h) that lays stars va, vb (3, h) on detections i, j at focal lengths f (h,)."""
    xy = d.xy.T.astype(va.dtype)
    si, sj = (np.concatenate([xy[:, k], f[None]]) for k in (i, j))
    si /= np.sqrt((si * si).sum(axis=0))
    sj /= np.sqrt((sj * sj).sum(axis=0))
    s1, s2, s3 = _frame(si, sj)
    n1, n2, n3 = _frame(va, vb)
    return s1[:, None] * n1[None] + s2[:, None] * n2[None] + s3[:, None] * n3[None]


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
    fs = f.astype(np.float32)
    R = _rotations(d, i, j, fs, va, vb)
    R[2] *= fs
    sky_map = level.sky_map(FAINT, tolerance_px(d, freedom) / float(np.median(f)))
    # The first test takes bright and faint ones alike: the brightest few may all be false.
    tests = np.concatenate([np.arange(k, len(d), 3) for k in range(3)]).astype(int)
    first, kept = (FIRST_TEST, FIRST_KEPT) if len(f) < FEW else (2 * FIRST_TEST, max(FIRST_KEPT, len(f) // 20))
    score = _score(sky_map, d, R, zero, tests[:first])
    best = _largest(score, max(kept, keep))
    if len(d) > first:
        more = _score(sky_map, d, R[:, :, best], None if zero is None else zero[best], tests[first:])
        score[best] += more
    best = best[_largest(score[best], keep)]
    va, vb = (level.directions[k[best]].T for k in (a, b))
    return Hypotheses(_rotations(d, i[best], j[best], f[best], va, vb).transpose(2, 0, 1), f[best], score[best])


def _largest(score: np.ndarray, keep: int) -> np.ndarray:
    """Indices of the `keep` largest, the largest first, earlier ones first among equals."""
    if len(score) > keep:
        limit = np.partition(score, len(score) - keep)[len(score) - keep]
        above, equal = np.flatnonzero(score > limit), np.flatnonzero(score == limit)
        chosen = np.concatenate([above, equal[: keep - len(above)]])
        return chosen[np.argsort(-score[chosen], kind="stable")]
    return np.argsort(-score, kind="stable")


def _score(sky_map: SkyMap, d: Detections, R: np.ndarray, zero: np.ndarray | None, tests: np.ndarray) -> np.ndarray:
    """Weighed hits (h,) of the detections `tests`; R (3, 3, h) with its last row times f."""
    P = np.ones((3, len(tests)), dtype=np.float32)
    P[:2] = d.xy[tests].T
    v = [R[:, k].T @ P for k in range(3)]
    found = sky_map.cells.take(sky_map.index(*v))
    if zero is None or d.magnitude is None:
        return (found != EMPTY).sum(axis=1).astype(np.float32)
    # Empty cells look up a star so faint that its weight is nothing.
    z = MAGNITUDES.take(found)
    z -= d.magnitude[tests].astype(np.float32)
    z -= zero[:, None]
    z *= np.float32(0.45 / np.hypot(1.3 * d.magnitude_sigma, 0.05))
    z *= z
    z *= z
    z += np.float32(1.0)
    return np.reciprocal(z, out=z).sum(axis=1)


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


__all__ = ["Hypotheses", "detection_pairs", "hypotheses", "levels_for"]
