"""Where in a frame a body is: the place at which a rendered template explains most light.

That is (sum I T)^2 / sum T^2 over the pixels that are there and not full: a body cut by the edge has its best place too.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import next_fast_len

from .photometry import Lambert
from .template import Data, Scene, Trial


def _correlation(a: np.ndarray, b: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Sums of a times b shifted, over all shifts modulo `shape`."""
    return np.fft.irfft2(np.fft.rfft2(a, shape) * np.conj(np.fft.rfft2(b, shape)), shape)


def place(data: Data, scene: Scene, around: np.ndarray | None, reach_px: float) -> tuple[np.ndarray, float] | None:
    """Where a template of the expected size explains most light, (2,) px of the data's frame, and the next best place's share of
    that; None where no pixel is bright. around: (2,) centre of the search, within reach_px; None searches all."""
    middle = np.array([data.grey.shape[1] - 1, data.grey.shape[0] - 1]) / 2 + data.corner
    at = middle if around is None else np.asarray(around, float)
    law = scene.target.law or Lambert()
    trial = Trial(at)
    left, top, width, height = scene.window(trial)
    T = scene.draw(trial, (left, top, width, height), law=law, with_family=False)[0]
    I = np.where(data.good, data.grey, 0.0)
    shape = tuple(int(next_fast_len(a + b) or a + b) for a, b in zip(I.shape, T.shape))
    light = _correlation(I, T, shape)
    power = _correlation(data.good.astype(float), T * T, shape)
    whole = float((T * T).sum())
    if whole <= 0.0:
        return None
    score = np.where(power > 0.15 * whole, np.maximum(light, 0.0) ** 2 / np.maximum(power, 1e-9 * whole), 0.0)
    # Entry (i, j) is the template's corner at (j, i) of the data; beyond the middle it wraps to negative ones.
    oy, ox = (np.where(np.arange(n) < m, np.arange(n), np.arange(n) - n) for n, m in zip(shape, I.shape))
    cx = ox + data.corner[0] + (at[0] - left)
    cy = oy + data.corner[1] + (at[1] - top)
    if around is not None:
        score = np.where((cx[None, :] - at[0]) ** 2 + (cy[:, None] - at[1]) ** 2 <= reach_px**2, score, 0.0)
    best = np.unravel_index(int(np.argmax(score)), score.shape)
    top_score = float(score[best])
    if top_score <= 0.0:
        return None
    xy = np.array([cx[best[1]], cy[best[0]]])
    clear = max(scene.diameter_px(), 4.0)
    far = (cx[None, :] - xy[0]) ** 2 + (cy[:, None] - xy[1]) ** 2 > clear**2
    return xy, float(np.where(far, score, 0.0).max()) / top_score


__all__ = ["place"]
