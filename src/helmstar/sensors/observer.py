"""Where an observer on Earth is, and how it moves: for aberration and parallax."""

from __future__ import annotations

import numpy as np

AU_DAY = 149597870700.0 / 86400.0
LIGHT = 299792458.0


def observer(julian_date_tt: float) -> tuple[float, np.ndarray]:
    """Julian year, and Earth's barycentric velocity (3,) in N over that of light, at a Julian date in TT (erfa's epv00)."""
    import erfa

    _, barycentric = erfa.epv00(julian_date_tt, 0.0)
    return 2000.0 + (julian_date_tt - 2451545.0) / 365.25, np.asarray(barycentric["v"]) * AU_DAY / LIGHT


def observer_place(julian_date_tt: float) -> np.ndarray:
    """Earth's barycentric position (3,) in N, astronomical units, at a Julian date in TT (erfa's epv00)."""
    import erfa

    return np.asarray(erfa.epv00(julian_date_tt, 0.0)[1]["p"])


__all__ = ["observer", "observer_place"]
