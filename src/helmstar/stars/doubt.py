"""What if a camera is not as it was told: its field misstated, its lens bent, its brightness no measure of light?

`identify` believes what it is given. Of a camera that nobody calibrated three things are often wrong: the stated field; the
places, which a lens or a smeared, saturated star displaces by pixels where noise alone would do so by tenths; and the fluxes,
which a camera's gamma, a clipped background or saturation bend until only their order is left. What is told is tried first; where
that fails, each doubt is tried at odds against it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from .identify import LIMIT, WORK, Identification, identify
from .pinhole import Camera

Doubt = Literal["", "rough", "field", "rough, field"]

ODDS = 10.0
"""Against each doubt."""
MISSTATED = 0.1
"""How wrong a stated field may be, relatively."""
FIELD_WORK, ROUGH_WORK = 800_000, 800_000
"""Catalogue pairs that the doubts are worth."""
ROUGH_WIDTHS = 0.0015
"""1 sigma of a place that lens or smear displaced, per axis, over the image's width."""
BRIGHTEST_FEW = 25
"""Detections that a rough camera is tried on first."""
ORDER_SIGMA = 0.5
"""1 sigma, mag, of V minus the magnitude that the order tells (`magnitude_of_order`)."""
COUNTS = 0.5
"""Stars brighter than V grow as 10 to this times V: Hipparcos has 0.48 to 0.52 from V = 2 to 7."""


class Doubted(NamedTuple):
    """identification, and the doubt under which it holds: '' none, 'rough' (places to some pixels, brightness by its order), or
    'field' (the stated one is wrong)."""

    identification: Identification
    doubt: Doubt


def magnitude_of_order(flux: np.ndarray) -> np.ndarray:
    """(n,) magnitudes that stars of a sky would have by the order of their fluxes (n,), whatever the response to light.

    The k-th brightest of a field is expected at log10(k)/COUNTS and a constant. False and missing stars, where they come at
    every brightness, change the constant only.
    """
    flux = np.asarray(flux, dtype=float)
    rank = np.empty(len(flux))
    rank[np.argsort(-flux, kind="stable")] = np.arange(1, len(flux) + 1)
    return np.where(np.isfinite(flux), np.log10(rank) / COUNTS, np.nan)


def roughened(sigma_px: float | np.ndarray, count: int, floor_px: float) -> np.ndarray:
    """Covariances (count, 2, 2) px^2 of places that lens or smear displaced by `floor_px`, 1 sigma; sigma_px as for `identify`."""
    sigma = np.asarray(sigma_px, dtype=float)
    square = np.eye(2)
    own = sigma if sigma.ndim == 3 else np.broadcast_to(sigma**2, (count,))[:, None, None] * square
    return own + floor_px**2 * square


def identify_uncalibrated(
    xy_px: np.ndarray,
    camera: Camera,
    *,
    flux: np.ndarray | None = None,
    magnitude: np.ndarray | None = None,
    sigma_px: float | np.ndarray = 0.5,
    fov_range: tuple[float, float] | None = None,
    focal_sigma: float = 0.005,
    limit: float | None = None,
    work: int = WORK,
    **others,
) -> Doubted:
    """As `identify`, for a camera that nobody calibrated; what is told is believed first, then doubted.

    A stated field is searched up to MISSTATED wider and narrower in the end; a range of fields is believed. others: of
    `identify`; work is for what is told, each doubt has its own. limit: LIMIT by default.
    """
    limit = LIMIT if limit is None else limit
    xy_px, told = np.asarray(xy_px, dtype=float), {"flux": flux, "magnitude": magnitude, "sigma_px": sigma_px, **others}
    lens = {"fov_range": fov_range, "focal_sigma": focal_sigma}
    found = identify(xy_px, camera, limit=limit, work=work, **lens, **told)
    best = Doubted(found, "")
    if found.solved or found.status == "too few stars":
        return best
    bright = flux if flux is not None else None if magnitude is None else -np.asarray(magnitude, dtype=float)
    order = None if bright is None else magnitude_of_order(bright)
    C = roughened(sigma_px, len(xy_px), ROUGH_WIDTHS * camera.size_px[0])
    # The brightest alone first: noise of a clipped sky makes many false stars, all of them faint.
    for count in (BRIGHTEST_FEW, len(xy_px)):
        few = np.arange(len(xy_px)) if order is None else np.argsort(order, kind="stable")[:count]
        rough = {**others, "magnitude_sigma": ORDER_SIGMA, "zero_point": None, "sigma_px": C[few]}
        rough |= {"magnitude": None if order is None else order[few], "limit": limit / ODDS}
        second = identify(xy_px[few], camera, work=min(work, ROUGH_WORK), **lens, **rough)
        best = _likelier(best, "rough", replace(second, detections=few[second.detections]))
        if best.identification.solved or len(few) == len(xy_px):
            break
    if fov_range is not None:
        return best
    # A rough camera fits a wrong field too, with a focal length that leans far out.
    found = best.identification
    if found.solved and abs(np.log(found.focal_px / camera.focal_px)) < 3.0 * focal_sigma:
        return best
    fov = 2.0 * float(np.arctan(0.5 * camera.size_px[0] / camera.focal_px))
    lens = {"fov_range": (fov * (1.0 - MISSTATED), min(fov / (1.0 - MISSTATED), 0.99 * np.pi))}
    return _likelier(
        best, "field", identify(xy_px, camera, limit=limit / ODDS, work=min(work, FIELD_WORK), **lens, **told)
    )


def _likelier(first: Doubted, doubt: Doubt, b: Identification) -> Doubted:
    """The second, at ODDS against it, where it is likelier and solved if the first is; with the work of both."""
    a, b = first.identification, against(b, 1, first.identification.work)
    if b.log_odds > a.log_odds and (b.solved or not a.solved):
        return Doubted(b, doubt)
    return Doubted(replace(a, work=b.work), first.doubt)


def against(found: Identification, doubts: int, work: int) -> Identification:
    """With ODDS against it for each of so many doubts, and the work of what was tried before."""
    odds = ODDS**doubts
    return replace(
        found, probability_false=min(1.0, odds * found.probability_false), log_odds=found.log_odds - float(np.log(odds)),
        work=work + found.work,
    )  # fmt: skip


__all__ = ["Doubt", "Doubted", "against", "identify_uncalibrated", "magnitude_of_order", "roughened"]
