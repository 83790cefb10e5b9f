"""Attitudes that stand out from their neighbours, found without knowing any noise.

Brought back to one instant by the gyro, attitudes are a slow curve plus their noise. One that is far from the line between
its neighbours, in robust standard deviations of that distance, is left out of the noise estimate; the farthest first, as
it spoils its neighbours' lines too. The filter does not use this: there the gate decides, by the noise then known.
"""

from __future__ import annotations

import heapq

import numpy as np

FAR = 8.0
"""Robust standard deviations."""
MOST = 0.25
"""Share of the attitudes that may be left out; if there are more, none is."""


def stand_out(y: np.ndarray, time: np.ndarray, size: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Mask (m,) of points far from the line between their neighbours.

    y (m, 3) rad, time (m,) s, size (m,): 1 sigma of each in any unit; extra (m,): variance in rad^2 that gaps have added up to
    each. The first one counts as good.
    """
    n = len(y)
    out = np.zeros(n, dtype=bool)
    if n < 5:
        return out
    before, after = np.arange(n) - 1, np.arange(n) + 1

    def off_line(k: int, a: int, b: int) -> tuple[float, float]:
        """Square of the distance of k from the line through a and b, and variance by gaps, over the relative variance."""
        m = (time[k] - time[a]) / (time[b] - time[a])
        variance = size[k] ** 2 + (1.0 - m) ** 2 * size[a] ** 2 + m**2 * size[b] ** 2
        distance = float(np.sum((y[k] - (1.0 - m) * y[a] - m * y[b]) ** 2))
        return distance / variance, abs(float(extra[max(a, b, k)] - extra[min(a, b, k)])) / variance

    scale = np.median([off_line(k, k - 1, k + 1)[0] for k in range(1, n - 1)]) / 2.366  # chi-square of three dof
    if not scale > 0.0:
        return out

    def far(k: int) -> float:
        distance, gaps = off_line(k, int(before[k]), int(after[k]))
        return distance / (scale + gaps)

    queue = [(-far(k), k) for k in range(1, n - 1)]
    heapq.heapify(queue)
    while queue:
        value, k = heapq.heappop(queue)
        if out[k] or -value != far(k):  # stale
            continue
        if -value <= FAR**2 or out.sum() > MOST * n:
            break
        out[k] = True
        a, b = int(before[k]), int(after[k])
        after[a], before[b] = b, a
        for j in (a, b):
            if 0 < j < n - 1:
                heapq.heappush(queue, (-far(j), j))
    if out.sum() > MOST * n:
        return np.zeros(n, dtype=bool)
    # The last one has one neighbour only: it is compared with the line through the two before it.
    a = int(before[n - 1])
    if a > 0:
        distance, gaps = off_line(n - 1, int(before[a]), a)
        out[-1] = distance / (scale + gaps) > FAR**2
    return out
