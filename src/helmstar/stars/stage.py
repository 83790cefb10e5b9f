"""In which order pairs are tried, and how far: what promises most per catalogue pair comes first, and the rest is not worth it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from .hypotheses import Hypotheses, hypotheses, levels_for, spans, thinned
from .patterns import LADDER, SHORTEST, Sky
from .problem import Detections, Freedom

FIELD_REACH = 0.70
"""Longest pairs of detections, over the field."""
SAMPLE = 40
"""Detection pairs from which the catalogue pairs per detection pair are estimated."""


@dataclass
class Stage:
    """One depth of one field's pair tables, with what was tried of it: pairs[:begin] (m, 2) of the detections.

    level, part: index into the ladder, and its share of the focal lengths; prior: how probable it is that this table succeeds
    where the others fail; cost: catalogue pairs per detection pair.
    """

    sky: Sky
    n: int
    d: Detections
    pairs: np.ndarray
    level: int
    part: Freedom
    prior: float = 1.0
    begin: int = 0
    _cost: float | None = field(default=None, repr=False)

    @property
    def cost(self) -> float:
        if self._cost is None:
            level = self.sky.level(self.level)
            table = thinned(level.pairs(self.n), level.catalog.magnitude, self.d)
            total = int(spans(table, self.d, self.pairs[:SAMPLE], self.part)[1].sum())
            # Without magnitudes each is laid both ways, which takes that much longer.
            self._cost = total / max(min(len(self.pairs), SAMPLE), 1) * (1.4 if self.d.magnitude is None else 1.0)
        return self._cost

    def worth_trying(self, worth: float) -> int:
        """How many of the detection pairs promise at least `worth` solutions per catalogue pair.

        If the share of detections that are stars of the table may be anything, evenly, all pairs of K of them fail with
        probability 2/(K + 1), at most one of the K being a star. The next detection brings K pairs and 2/((K + 1)(K + 2)) of
        success: about 2/K^3 for each pair.
        """
        K = (2.0 * self.prior / (worth * max(self.cost, 1.0))) ** (1.0 / 3.0)
        n = len(self.d)
        return round(len(self.pairs) * min(1.0, K * (K - 1.0) / (n * (n - 1.0)))) if K > 1.0 else 0

    def hypotheses(self, worth: float, keep: int, chunk: int) -> Iterator[tuple[int, Hypotheses | None]]:
        """Catalogue pairs looked at and ranked hypotheses, in chunks, of the pairs that are worth it and not yet tried."""
        end = self.worth_trying(worth)
        if end <= self.begin:
            return
        some, self.begin = self.pairs[self.begin : end], end
        for looked, found in hypotheses(self.sky.level(self.level), self.n, self.d, some, self.part, keep, chunk):
            # Without magnitudes each catalogue pair is laid both ways.
            yield looked if self.d.magnitude is not None else 2 * looked, found


def detection_pairs(d: Detections) -> np.ndarray:
    """(m, 2) indices of pairs to try, the brightest first, neither too short for a good lever nor too long for the tables."""
    i, j = np.triu_indices(len(d), 1)
    length = np.hypot(*(d.xy[i] - d.xy[j]).T)
    side = np.sqrt(d.area)
    keep = (length > 1.5 * SHORTEST * side) & (length < FIELD_REACH * side)
    i, j, length = i[keep], j[keep], length[keep]
    # Sums of ranks, not the later rank: one false bright object must not spoil the first n - 1 trials.
    order = np.argsort(i + j + 0.5 * np.abs(length / side - 0.35), kind="stable")
    return np.stack([i[order], j[order]], axis=1)


def stages(
    sky: Sky,
    d: Detections,
    pairs: np.ndarray,
    freedom: Freedom,
    depths: Sequence[tuple[int, float]],
    weight: float = 1.0,
) -> list[Stage]:
    """Of each depth (n stars per field, prior) the fields that the focal length allows, the widest first: their tables are small.

    A table of its own for each: dense tables of narrow fields, a look into which costs with 1/field^2, must not keep those of wide
    fields from being searched deeply. With priors as 1/field^2 all would be searched equally deep, with even ones the narrow fields
    hardly; 1/field lies between.
    """
    levels = levels_for(d, freedom, LADDER)
    share = [1.0]
    if len(levels) > 1:
        width = np.array([np.log(part.f_high / part.f_low) / LADDER[level] for level, part in levels])
        share = (width / width.sum()).tolist()
    return [
        Stage(sky, n, d, pairs, level, part, weight * prior * own)
        for n, prior in depths
        for (level, part), own in reversed(list(zip(levels, share)))
    ]


__all__ = ["Stage", "detection_pairs", "stages"]
