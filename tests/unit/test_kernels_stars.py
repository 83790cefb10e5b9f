"""The compiled search for stars finds what its NumPy twin finds: hypotheses, their scores, first odds and solutions."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.native import kernels
from helmstar.stars import Pinhole, default_sky, identify
from helmstar.stars.identify import focal_freedom
from helmstar.stars.patterns import BRIGHT, FAINT, LADDER, Pairs, Sky, SkyMap
from helmstar.stars.problem import prepare
from helmstar.stars.stage import detection_pairs
from helmstar.stars.synthetic import Scene, random_scene, scene

hypotheses = importlib.import_module("helmstar.stars.hypotheses")
screening = importlib.import_module("helmstar.stars.screen")
others = [importlib.import_module(f"helmstar.stars.{m}") for m in ("patterns", "problem", "verify")]
pytestmark = pytest.mark.skipif(
    kernels() is None, reason="installed without compiled kernels, or their sources changed since"
)


def with_numpy(call, *args, **kinds):
    """What `call` gives without the compiled kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (hypotheses, screening, *others):
            patch.setattr(module, "kernels", lambda: None)
        return call(*args, **kinds)


def camera(fov_deg: float) -> Pinhole:
    return Pinhole.of_field(np.radians(fov_deg), (1024, 1024))


def case(seed: int) -> tuple[Pinhole, Scene, dict[str, Any]]:
    """One of 36 kinds of scenes: camera, scene and the arguments of `identify`."""
    c = camera((6.0, 12.0, 20.0)[seed % 3])
    noise = (0.3, 1.0)[seed // 3 % 2]
    s = scene(default_sky(), c, np.random.default_rng([17, seed]), noise_px=noise, false=5 + seed, dropped=0.01 * seed)
    told: dict[str, Any] = ({}, {"flux": s.flux}, {"magnitude": s.magnitude, "zero_point": 0.0})[seed // 6 % 3]
    ranged = {"fov_range": (np.radians(5.0), np.radians(25.0))} if seed % 4 == 3 else {}
    # NumPy is slow to give up.
    return c, s, {"sigma_px": noise, "work": 300_000, **told, **ranged}


def test_solutions_are_those_of_numpy():
    solved = 0
    for seed in range(36):
        c, s, kinds = case(seed)
        a, b = identify(s.xy_px, c, **kinds), with_numpy(identify, s.xy_px, c, **kinds)
        assert (a.status, a.work) == (b.status, b.work), seed
        assert np.array_equal(a.detections, b.detections), seed
        assert np.array_equal(a.stars, b.stars), seed
        if a.solved:
            # Two steps from starts that differ by rounding end within rounding.
            assert (Rotation.from_quat(a.q_SN) * Rotation.from_quat(b.q_SN).inv()).magnitude() < 1e-9, seed
            assert a.log_odds == pytest.approx(b.log_odds, abs=1e-6), seed
            solved += 1
    assert solved >= 30


@pytest.mark.parametrize("flux", [True, False])
def test_lists_without_a_sky_are_refused_alike(flux):
    c = camera(20.0)
    s = random_scene(c, np.random.default_rng(5), 60)
    told: dict[str, Any] = {"flux": s.flux if flux else None, "work": 600_000}
    a, b = identify(s.xy_px, c, **told), with_numpy(identify, s.xy_px, c, **told)
    assert (a.status, a.work) == (b.status, b.work)
    assert not a.solved
    again = identify(s.xy_px, c, **told)
    assert (again.status, again.work, again.log_odds) == (a.status, a.work, a.log_odds)


def chunks(d, freedom, level: int, part, keep: int):
    """All chunks of the first detection pairs."""
    pairs = detection_pairs(d)[:10]
    return list(hypotheses.hypotheses(default_sky().level(level), BRIGHT, d, pairs, part, keep))


def laid(d, key: tuple[int, int, int, int], f: float) -> np.ndarray:
    """Directions (n, 3) of the detections where star a lies on i and b on j exactly: p_t = A p_i + B p_j + C p_i x p_j."""
    i, j, a, b = key
    p = np.concatenate([d.xy, np.full((len(d), 1), f)], axis=1)
    basis = np.stack([p[i], p[j], np.cross(p[i], p[j])])
    x, y = default_sky().directions[[a, b]] * np.linalg.norm(p[[i, j]], axis=1)[:, None]
    return np.linalg.solve(basis.T, p.T).T @ np.stack([x, y, np.cross(x, y)])


def distance_to_edge(sky_map: SkyMap, v: np.ndarray) -> float:
    """Of directions v (n, 3), the smallest distance to an edge of the map's cells, in cells."""
    u = 0.5 * sky_map.side * (1.0 - 1e-6) * v[:, :2] / np.abs(v).sum(axis=1, keepdims=True)
    # Between the two diamonds, at z = 0, lies an edge too.
    across = 0.5 * sky_map.side * np.abs(v[:, 2]) / np.abs(v).sum(axis=1)
    return float(min(np.abs(u - np.round(u)).min(), across.min()))


def chosen(*args) -> list[dict]:
    """Of each chunk, the score and focal length of what was kept, by its detections i, j and stars a, b."""
    out = []
    with pytest.MonkeyPatch.context() as patch:

        def note(level, d, i, j, a, b, f, score):
            out.append(dict(zip(zip(i.tolist(), j.tolist(), a.tolist(), b.tolist()), zip(f, score))))
            return keep(level, d, i, j, a, b, f, score)

        keep = hypotheses._chosen
        patch.setattr(hypotheses, "_chosen", note)
        chunks(*args)
    return out


@settings(max_examples=6, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 10_000), false=st.integers(0, 110), fov_deg=st.sampled_from([5.0, 12.0, 25.0]),
    sigma=st.sampled_from([0.2, 1.5]), told=st.sampled_from(["flux", "nothing", "zero point"]), ranged=st.booleans(),
)  # fmt: skip
def test_scores_are_those_of_numpy(seed, false, fov_deg, sigma, told, ranged):
    c = camera(fov_deg)
    s = scene(default_sky(), c, np.random.default_rng(seed), stars=8, noise_px=sigma, false=false)
    magnitude = None if told == "nothing" else s.magnitude
    d, _ = prepare(s.xy_px, c, None, magnitude, sigma, 0.4, 0.0 if told == "zero point" else None)
    freedom = focal_freedom(c, (np.radians(0.9 * fov_deg), np.radians(1.1 * fov_deg)) if ranged else None, 0.001)
    level, part = hypotheses.levels_for(d, freedom, LADDER)[0]
    ours, theirs = chosen(d, freedom, level, part, 200), with_numpy(chosen, d, freedom, level, part, 200)
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs):
        assert len(a) == len(b)
        # The k-th best score of either: an edge gives or takes one hypothesis up to 1, and moves the next by a place.
        assert np.abs(np.array([x for _, x in a.values()]) - [x for _, x in b.values()]).mean() < 0.02
        common = a.keys() & b.keys()
        assert len(common) > 0.5 * len(a)
        sky_map = (
            default_sky()
            .level(level)
            .sky_map(FAINT, hypotheses.tolerance_px(d, part) / np.median([f for f, _ in a.values()]))
        )
        for key in common:
            assert a[key][0] == b[key][0]
            # A hundred weights of at most 1 in single precision; the weights feel the rounding of magnitudes.
            if abs(a[key][1] - b[key][1]) > 1e-4:
                # Single precision leaves 1e-7 of 2000 cells, and ten times that where a short pair carries far.
                assert distance_to_edge(sky_map, laid(d, key, a[key][0])) < 0.01


@pytest.mark.parametrize("keep", [1, 5, 40])
def test_the_best_of_a_chunk_come_first(keep):
    c = camera(12.0)
    s = scene(default_sky(), c, np.random.default_rng(3), false=30)
    d, _ = prepare(s.xy_px, c, s.flux, None, 0.3, 0.4, None)
    freedom = focal_freedom(c, None, 0.001)
    level, part = hypotheses.levels_for(d, freedom, LADDER)[0]
    for (_, few), (_, many) in zip(chunks(d, freedom, level, part, keep), chunks(d, freedom, level, part, 40)):
        assert np.array_equal(few.R, many.R[:keep])
        assert np.array_equal(few.score, many.score[:keep])


@pytest.mark.parametrize("told", ["flux", "nothing", "zero point"])
@pytest.mark.parametrize("ranged", [False, True])
def test_first_odds_are_those_of_numpy(told, ranged):
    for seed, fov_deg in enumerate((6.0, 22.0)):
        c = camera(fov_deg)
        s = scene(default_sky(), c, np.random.default_rng(seed), false=25, dropped=0.2)
        magnitude = None if told == "nothing" else s.magnitude
        d, _ = prepare(s.xy_px, c, None, magnitude, 0.4, 0.4, 0.0 if told == "zero point" else None)
        freedom = focal_freedom(c, (np.radians(5.0), np.radians(25.0)) if ranged else None, 0.001)
        cells, finite = screening.raster(d), 0
        for level, part in hypotheses.levels_for(d, freedom, LADDER):
            for _, found in chunks(d, freedom, level, part, 60)[:2]:
                if found is None:
                    continue
                a = screening.screen(default_sky(), level, d, cells, found.R, found.f, freedom)
                b = with_numpy(screening.screen, default_sky(), level, d, cells, found.R, found.f, freedom)
                good = np.isfinite(b[0])
                finite += int(good.sum())
                assert np.array_equal(np.isfinite(a[0]), good)
                # All in double precision; only the order of sums differs.
                assert np.allclose(a[0][good], b[0][good], rtol=1e-9, atol=1e-7)
                assert np.allclose(a[1], b[1], atol=1e-9)
                assert np.allclose(a[2], b[2], rtol=1e-9)
        assert finite > 10


def test_stars_that_are_not_in_the_catalogue_are_no_crash(monkeypatch):
    c = camera(12.0)
    s = scene(default_sky(), c, np.random.default_rng(3))
    level = type(default_sky().level(0))
    table = default_sky().level(3).pairs(BRIGHT)
    for wrong in (10**9, -1):
        damaged = Pairs(np.full_like(table.first, wrong), table.second, table.angle)
        monkeypatch.setattr(level, "pairs", lambda self, n, damaged=damaged: damaged)
        with pytest.raises(ValueError, match="not in the catalogue"):
            identify(s.xy_px, c, flux=s.flux)


def test_a_sky_of_another_year_shares_the_tables():
    c = camera(12.0)
    sky = Sky(default_sky().catalog, 2030.0)
    s = scene(sky, c, np.random.default_rng(9), false=10)
    a, b = identify(s.xy_px, c, flux=s.flux, sky=sky), with_numpy(identify, s.xy_px, c, flux=s.flux, sky=sky)
    assert a.solved
    assert np.array_equal(a.stars, b.stars)
