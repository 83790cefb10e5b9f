"""The Hipparcos catalogue (ESA 1997, I/239) to V = 9: positions, proper motions, parallaxes, magnitudes.

Directions are in the ICRS, which is the inertial frame N of this package. Made by builders/hipparcos.py.
Credit: European Space Agency.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

MAS = np.pi / 180.0 / 3.6e6
EPOCH_YEAR = 1991.25
"""Epoch of the positions, Julian year."""


@dataclass(frozen=True)
class Catalog:
    """Stars, the brightest first; every field has shape (n,).

    hip: number in the Hipparcos catalogue. ra, dec: rad at EPOCH_YEAR in the ICRS. pm_ra (times cos dec), pm_dec: rad per
    Julian year. parallax: rad. magnitude: V.
    """

    hip: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    pm_ra: np.ndarray
    pm_dec: np.ndarray
    parallax: np.ndarray
    magnitude: np.ndarray

    def __len__(self) -> int:
        return len(self.hip)

    def directions(self, year: float = 2000.0) -> np.ndarray:
        """Barycentric unit vectors (n, 3) in N at a Julian year: uniform motion on the tangent plane of the epoch's place.

        Radial velocities are not known here; what they would change is below 0.1 arcsec per century for all but a
        handful of the nearest stars.
        """
        sa, ca, sd, cd = np.sin(self.ra), np.cos(self.ra), np.sin(self.dec), np.cos(self.dec)
        r = np.stack([ca * cd, sa * cd, sd], axis=1)
        east = np.stack([-sa, ca, np.zeros_like(sa)], axis=1)
        north = np.stack([-ca * sd, -sa * sd, cd], axis=1)
        t = year - EPOCH_YEAR
        r = r + t * (self.pm_ra[:, None] * east + self.pm_dec[:, None] * north)
        return r / np.linalg.norm(r, axis=1, keepdims=True)


@cache
def _whole() -> Catalog:
    file = resources.files("helmstar.stars") / "hipparcos.npz"
    with file.open("rb") as f, np.load(f, allow_pickle=False) as d:
        unit = {"ra": MAS, "dec": MAS, "pm_ra": 0.01 * MAS, "pm_dec": 0.01 * MAS, "parallax": 0.01 * MAS}
        scaled = {k: d[k] * u for k, u in unit.items()}
        return Catalog(hip=d["hip"], magnitude=d["magnitude"] * 0.01, **scaled)


def load_catalog(faintest: float = 9.0) -> Catalog:
    """All stars up to a magnitude V. Raises ValueError for a limit fainter than the catalogue's, 9."""
    if not faintest <= 9.0:
        raise ValueError(f"magnitude {faintest}: the catalogue ends at V = 9")
    whole = _whole()
    n = int(np.searchsorted(whole.magnitude, faintest, side="right"))
    return Catalog(**{k: v[:n] for k, v in vars(whole).items()})


__all__ = ["EPOCH_YEAR", "Catalog", "load_catalog"]
