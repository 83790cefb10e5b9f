"""Figures as compact JSON: every large array once, as base64 of little-endian floats; no NaN reaches the JSON.

A figure is a plain dict of plotly's public figure JSON that may hold numpy arrays. `pack` replaces each large array by
`{"$array": i}` into an `ArrayPool`, in which equal arrays (a shared time axis, say) are stored once; page.js turns them
into typed arrays. float32 (7 digits) is used where it resolves the array's own span to 1e-6, float64 otherwise.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

POOLED_FROM = 48  # shorter arrays are written as plain JSON lists


class ArrayPool:
    """Large arrays of one page, each stored once."""

    def __init__(self) -> None:
        self._index: dict[tuple[str, bytes], int] = {}
        self.entries: list[dict[str, str]] = []

    def add(self, array: np.ndarray) -> int:
        """The index under which this array is stored."""
        kind, content = _compact(array)
        key = (kind, content)
        if key not in self._index:
            self._index[key] = len(self.entries)
            self.entries.append({"t": kind, "b": base64.b64encode(content).decode("ascii")})
        return self._index[key]


def _compact(array: np.ndarray) -> tuple[str, bytes]:
    exact = np.where(np.isfinite(array), array, np.nan).astype("<f8")
    with np.errstate(over="ignore", under="ignore"):
        short = exact.astype("<f4")
    finite = exact[np.isfinite(exact)]
    span = float(np.ptp(finite)) if finite.size else 0.0
    loss = float(np.max(np.abs(short[np.isfinite(exact)].astype("<f8") - finite))) if finite.size else 0.0
    if loss <= 1e-6 * span or (span == 0.0 and loss <= 1e-6 * abs(float(finite[0]) if finite.size else 0.0)):
        return "f4", short.tobytes()
    return "f8", exact.tobytes()


def pack(value: Any, pool: ArrayPool) -> Any:
    """A copy of `value` that the json module can write: large arrays in the pool, non-finite numbers as None."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "fiu" and value.ndim == 1 and value.size >= POOLED_FROM:
            return {"$array": pool.add(value)}
        return [pack(item, pool) for item in value.tolist()]
    if isinstance(value, Mapping):
        return {str(key): pack(item, pool) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [pack(item, pool) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value


def script_json(value: Any) -> str:
    """JSON that is safe inside a script element: no `<`, so neither `</script>` nor `<!--` can occur."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    escapes = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
    for character, escape in escapes.items():
        text = text.replace(character, escape)
    return text


def spread(count: int, most: int, dense_start: int = 100) -> np.ndarray:
    """At most `most` indices into `count` samples: the first `dense_start` all, the rest evenly, the last always."""
    if count <= most:
        return np.arange(count)
    start = min(dense_start, most // 2)
    rest = np.linspace(start, count - 1, most - start)
    return np.unique(np.concatenate([np.arange(start), np.round(rest).astype(int)]))


def envelope(values: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(index, lowest, highest) of at most `most` stretches of a series that swings faster than a plot can show."""
    width = max(-(-len(values) // most), 1)
    padded = np.full(-(-len(values) // width) * width, np.nan)
    padded[: len(values)] = np.where(np.isfinite(values), values, np.nan)
    blocks = padded.reshape(-1, width)
    low = np.min(np.where(np.isnan(blocks), np.inf, blocks), axis=1)
    high = np.max(np.where(np.isnan(blocks), -np.inf, blocks), axis=1)
    index = np.minimum(np.arange(len(blocks)) * width + width // 2, len(values) - 1)
    return index, np.where(np.isfinite(low), low, np.nan), np.where(np.isfinite(high), high, np.nan)


def sample(values: np.ndarray, most: int) -> np.ndarray:
    """At most `most` indices for a cloud of points: evenly spread, so that its density is true, and its outliers."""
    if len(values) <= most:
        return np.arange(len(values))
    return np.union1d(spread(len(values), 3 * most // 4, 0), extremes(values, most // 4))


def extremes(values: np.ndarray, most: int) -> np.ndarray:
    """At most `most` indices into a noisy series that keep the smallest and largest value of each stretch of it.

    `values` is (n,), or (series, n) where one choice of indices must serve several series.
    """
    series = np.atleast_2d(values)
    count = series.shape[1]
    if count <= most:
        return np.arange(count)
    stretches = max((most - 2) // (2 * len(series)), 1)
    width = -(-count // stretches)
    padded = np.full((series.shape[0], stretches * width), np.nan)
    padded[:, :count] = np.where(np.isfinite(series), series, np.nan)
    blocks = padded.reshape(series.shape[0], stretches, width)
    base = np.arange(stretches) * width
    lowest = base + np.argmin(np.where(np.isnan(blocks), np.inf, blocks), axis=2)
    highest = base + np.argmax(np.where(np.isnan(blocks), -np.inf, blocks), axis=2)
    chosen = np.unique(np.concatenate([[0, count - 1], lowest.ravel(), highest.ravel()]))
    return chosen[chosen < count]
