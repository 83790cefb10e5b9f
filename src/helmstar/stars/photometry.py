"""What a camera's own solutions tell of its magnitudes: zero point and scatter, for the scenes that are hard without them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from .identify import Identification, default_sky
from .patterns import Sky

FEWEST_MATCHES = 10
"""From which a scatter is known to a quarter."""
FINEST = 0.01
"""Scatter, mag, below which no catalogue and no star keeps."""


class Photometry(NamedTuple):
    """zero_point: V minus the camera's magnitude. magnitude_sigma: its scatter, 1 sigma. matches: stars they were drawn from.

    The first two are what `identify` takes by these names.
    """

    zero_point: float
    magnitude_sigma: float
    matches: int


def calibrate_photometry(
    found: Iterable[Identification], magnitudes: Iterable[np.ndarray], *, sky: Sky | None = None
) -> Photometry:
    """Zero point and scatter of one camera's magnitudes: median and median deviation of V minus magnitude over all matches.

    found: of scenes of one camera, with one exposure; those not solved are passed over. magnitudes: (n,) of each scene, of the
    list it was identified with (-2.5 log10 of the flux where that was given). sky: as for `identify`. Which stars were matched
    depends on the sigma told then: doing it a second time with the first answer takes that off.

    Raises ValueError for lists that do not belong together, or fewer than FEWEST_MATCHES matches.
    """
    V = (default_sky() if sky is None else sky).magnitude
    parts = [np.zeros(0)]
    for k, (one, m) in enumerate(zip(found, magnitudes, strict=True)):
        m = np.asarray(m, dtype=float)
        if m.ndim != 1 or (len(one.detections) and int(one.detections.max()) >= len(m)):
            raise ValueError(f"magnitudes[{k}] {m.shape}: not the list that scene was identified with")
        parts.append(V[one.stars] - m[one.detections])
    difference = np.concatenate(parts)
    if len(difference) < FEWEST_MATCHES:
        raise ValueError(f"{len(difference)} matches: {FEWEST_MATCHES} are needed; give more solved scenes")
    zero = float(np.median(difference))
    sigma = 1.4826 * float(np.median(np.abs(difference - zero)))
    return Photometry(zero, max(sigma, FINEST), len(difference))


__all__ = ["Photometry", "calibrate_photometry"]
