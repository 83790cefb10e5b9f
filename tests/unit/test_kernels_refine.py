"""The compiled last fit of a star tracker finds what its NumPy twin finds: matches, attitude, lens, covariance and scale."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.imaging import Camera, Centroids
from helmstar.imaging.calibrated import Calibrated
from helmstar.native import kernels
from helmstar.sensors import refine as last
from helmstar.sensors.lens import LensPrior
from helmstar.sensors.refine import EPOCH_SPREAD_YEARS, refine
from helmstar.stars import default_sky
from helmstar.stars.identify import Identification

pytestmark = pytest.mark.skipif(
    kernels() is None, reason="installed without compiled kernels, or their sources changed since"
)


def both(found: Identification, *args, **kinds):
    """The compiled fit's and NumPy's; what `refine` left as it was, for want of three stars in view, never came so far."""
    taken = []
    with pytest.MonkeyPatch.context() as patch:

        def note(*problem):
            taken.append(compiled(*problem))
            return taken[-1]

        compiled = last._compiled
        patch.setattr(last, "_compiled", note)
        ours = refine(found, *args, **kinds)
        assert taken or ours.identification is found
        patch.setattr(last, "kernels", lambda: None)
        return ours, refine(found, *args, **kinds)


def case(
    seed: int, lens: str = "uncalibrated", aspect: float = 1.0, count: int = 90, false: int = 15, wrong: int = 0,
    started: int = 16, sigma: float = 0.15,
) -> tuple[Identification, Centroids, Camera, LensPrior]:  # fmt: skip
    """Stars through a lens that differs from the camera by what its prior allows, false detections among them, and an
    identification of the brightest, off by some sigma of the lens, of which some matches are wrong."""
    rng = np.random.default_rng([3, seed])
    nominal = Camera.from_fov(12.0, 1024, int(768 / aspect), aspect)
    if lens == "calibrated":
        nominal = replace(nominal, centre_px=(530.0, nominal.cy + 9.0), distortion=(-0.2, 0.05, 2e-4, -1e-4, 0.01))
        prior = LensPrior.calibrated(Calibrated(nominal, 0.3, 0.4, 1e-3))
    else:
        prior = getattr(LensPrior, lens)(nominal, 0.003)
    off = np.clip(rng.normal(size=5), -1.5, 1.5)  # beyond, some of these lenses fold a corner over
    k1, k2, p1, p2, k3 = nominal.distortion
    bent = (k1 + prior.k1 * off[2], k2, p1 + prior.tangential * off[3], p2 + prior.tangential * off[4], k3)
    e = prior.centre_px * off[:2] / [1.0, aspect]
    true = replace(
        nominal, focal_px=nominal.focal_px * (1.0 + rng.normal(0.0, 0.003 if lens != "calibrated" else prior.focal)),
        centre_px=(nominal.cx + e[0], nominal.cy + e[1]), distortion=bent,
    )  # fmt: skip
    sky, R = default_sky(), Rotation.random(rng=rng).as_matrix()
    ahead = np.flatnonzero(sky.directions @ R[2] > 0.9)
    xy = true.pixels(sky.directions[ahead] @ R.T)
    inside = np.flatnonzero(true.inside(xy))[:count]
    stars, xy = ahead[inside], xy[inside]
    C = sigma**2 * rng.uniform(0.5, 2.0, len(stars) + false)[:, None, None] * np.array([[1.0, 0.2], [0.2, 1.3]])
    xy = np.concatenate([xy, rng.uniform(0.0, 1.0, (false, 2)) * [true.width - 1, true.height - 1]])
    xy += np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.normal(size=xy.shape))
    V = np.concatenate([sky.magnitude[stars], rng.uniform(6.0, 8.0, false)]) + rng.normal(0.0, 0.2, len(xy))
    order = np.argsort(V, kind="stable")
    place = np.argsort(order)[: len(stars)][:started]  # of the brightest stars in the list
    one = np.ones(len(order))
    seen = Centroids(xy[order, 0], xy[order, 1], 10 ** (-0.4 * V[order]), C[order], one, one < 0, one, 50 * one)
    guess = stars[: len(place)].copy()
    guess[:wrong] = np.roll(guess, 1)[:wrong]
    q = (Rotation.from_rotvec(rng.normal(0.0, 2e-4, 3)) * Rotation.from_matrix(R)).as_quat()
    found = Identification(
        "solved", q, q, np.eye(3), 0.0, 0.0, 0.0, place, guess, sky.catalog.hip[guess], np.zeros((len(guess), 2)), 0.0,
        nominal.focal_px, 0.0, 0.0, 0.0, 0,
    )  # fmt: skip
    return found, seen, nominal, prior


def agrees(ours: last.Refined, theirs: last.Refined) -> None:
    a, b = ours.identification, theirs.identification
    assert np.array_equal(a.stars, b.stars)
    assert np.array_equal(a.detections, b.detections)
    assert np.array_equal(a.hip, b.hip)
    # Both in double precision: sums of a hundred terms, and an inverse whose condition, in its units, is below 1e6.
    assert (Rotation.from_quat(a.q_SN) * Rotation.from_quat(b.q_SN).inv()).magnitude() < 1e-12
    assert np.abs(a.covariance - b.covariance).max() < 1e-9 * np.abs(b.covariance).max()
    assert np.allclose(np.diagonal(a.covariance), np.diagonal(b.covariance), rtol=1e-9, atol=0.0)
    assert ours.scale == pytest.approx(theirs.scale, rel=1e-9)
    assert a.focal_px == pytest.approx(b.focal_px, rel=1e-10)
    assert np.allclose(ours.camera.distortion, theirs.camera.distortion, rtol=1e-9, atol=1e-10)
    assert np.allclose(a.residuals_px, b.residuals_px, atol=1e-8)
    assert [a.ra, a.dec, a.roll, a.residual_rms] == pytest.approx([b.ra, b.dec, b.roll, b.residual_rms], abs=1e-11)


KINDS: dict[str, dict[str, Any]] = {
    "usual": {},
    "tall pixels": {"aspect": 1.93},
    "few stars": {"count": 5, "false": 2},
    "three stars": {"count": 3, "false": 0},
    "wrong matches": {"wrong": 5},
    "only wrong matches": {"wrong": 16},
    "more false than true": {"count": 40, "false": 120},
    "sigmas that do not hold": {"sigma": 1.5},
}


@pytest.mark.parametrize("lens", ["uncalibrated", "rough", "calibrated"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_fit_is_that_of_numpy(lens, kind):
    matched = []
    for seed in range(4):
        found, seen, camera, prior = case(seed, lens, **KINDS[kind])
        for drift in (0.0, EPOCH_SPREAD_YEARS):
            ours, theirs = both(found, seen, camera, default_sky(), prior, drift)
            agrees(ours, theirs)
            matched.append(0 if ours.identification is found else len(ours.identification.stars))
    if "wrong" not in kind:  # the fits are of stars that were found, not of nothing twice
        assert np.mean(matched) >= 0.5 * min(KINDS[kind].get("count", 90), 60)


@settings(max_examples=200, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 10_000), lens=st.sampled_from(["uncalibrated", "rough", "calibrated"]),
    aspect=st.sampled_from([0.7, 1.0, 1.93]), count=st.integers(4, 120), false=st.integers(0, 120),
    wrong=st.integers(0, 6), started=st.integers(3, 30), sigma=st.sampled_from([0.03, 0.2, 1.0]),
    free=st.booleans(), drift=st.sampled_from([0.0, 25.0, 500.0]), gate=st.sampled_from([0.3, 2.0]),
)  # fmt: skip
def test_any_fit_is_that_of_numpy(seed, lens, aspect, count, false, wrong, started, sigma, free, drift, gate):
    # Fits that wrong matches lead astray end nowhere, which no two ways of rounding do alike.
    found, seen, camera, prior = case(
        seed, lens, aspect, count, false, min(wrong, started // 4, count // 4), started, sigma
    )
    if free and lens != "calibrated":
        prior = replace(prior, focal=np.inf)
    kinds = {"magnitude": -2.5 * np.log10(seen.flux) + 3.0, "magnitude_gate": gate}
    agrees(*both(found, seen, camera, default_sky(), prior, drift, **kinds))


def test_a_fit_that_runs_away_is_left():
    """Three wrong matches and a focal length that nothing holds: what is fitted to them may be any size, or none."""
    left = 0
    for seed in range(40):
        found, seen, camera, prior = case(seed, count=60, wrong=3, started=3)
        for it in both(found, seen, camera, default_sky(), replace(prior, focal=np.inf)):
            assert np.isfinite(it.identification.q_SN).all()
            assert 0.5 < it.identification.focal_px / found.focal_px < 2.0
            left += it.identification is found
    assert left > 10


def test_a_mounting_is_kept():
    found, seen, camera, prior = case(1)
    q_BS = Rotation.random(rng=np.random.default_rng(8))
    found = replace(found, q_BN=(q_BS * Rotation.from_quat(found.q_SN)).as_quat())
    for it in both(found, seen, camera, default_sky(), prior):
        i = it.identification
        assert (Rotation.from_quat(i.q_BN) * Rotation.from_quat(i.q_SN).inv() * q_BS.inv()).magnitude() < 1e-12


def test_a_fit_is_the_same_each_time_and_from_arrays_of_any_layout():
    found, seen, camera, prior = case(2, false=40)
    once = refine(found, seen, camera, default_sky(), prior, 25.0)
    wide = np.zeros((len(seen), 2, 4))
    wide[:, :, ::2] = seen.covariance_px
    flux = np.repeat(seen.flux, 3)[::3]
    other = replace(seen, covariance_px=wide[:, :, ::2], flux=flux)
    found = replace(found, detections=found.detections.astype(np.int32), stars=np.repeat(found.stars, 2)[::2])
    again = refine(found, other, camera, default_sky(), prior, 25.0)
    a, b = once.identification, again.identification
    assert a.q_SN.tobytes() == b.q_SN.tobytes()
    assert a.covariance.tobytes() == b.covariance.tobytes()
    assert (once.scale, once.camera) == (again.scale, again.camera)


def problem(directions: np.ndarray, **other) -> last._Problem:
    """Stars seen where the camera predicts them, at R = 1."""
    camera, n = Camera.from_fov(12.0, 1024, 768), len(directions)
    lens = last.Lens.of(camera, LensPrior(np.inf, 20.0, 0.5))
    xy = camera.pixels(directions)
    return replace(
        last._Problem(
            lens, directions, np.linspace(3, 6, n), np.zeros(n), xy, np.tile(0.01 * np.eye(2), (n, 1, 1)),
            np.linspace(3, 6, n), 0.0, 2.0, 1e-4,
        ),
        **other,
    )  # fmt: skip


def toward(xy: list[list[float]]) -> np.ndarray:
    return Camera.from_fov(12.0, 1024, 768).directions(np.array(xy, dtype=float))


def compiled(q: last._Problem, i=None, j=None) -> last._Fit:
    every = np.arange(len(q.directions))
    return last._compiled(kernels(), q, np.eye(3), np.zeros(6), every if i is None else i, every if j is None else j)  # type: ignore[arg-type]


def test_what_stars_leave_open_has_a_large_variance_and_nothing_a_negative_one():
    """Three images of one star, and no prior on the focal length: neither it nor the turn about the star can be known."""
    fit = compiled(problem(toward([[300, 200]] * 3)))
    assert np.isfinite(fit.covariance).all()
    assert np.array_equal(fit.covariance, fit.covariance.T)
    size = np.sqrt(np.diagonal(fit.covariance))
    assert np.linalg.eigvalsh(fit.covariance / size / size[:, None]).min() > -1e-12
    # A turn of 1 rad about a star 300 px from it, or a focal length of any size: both far beyond what three stars apart leave.
    apart = compiled(problem(toward([[300, 200], [800, 150], [500, 700]])))
    least = np.sqrt(np.diagonal(apart.covariance))
    assert size[2] > 1e3 * least[2]
    assert size[3] > 1e3 * least[3]


def test_numbers_that_are_none_are_no_crash():
    d = toward([[300, 200], [800, 150], [500, 700], [100, 600]])
    good = compiled(problem(d))
    assert len(good.i) == 4
    q = problem(d)
    for name in ("xy", "covariance", "magnitude", "drift", "directions", "V"):
        for value in (np.nan, np.inf, -np.inf):
            spoilt = np.array(getattr(q, name))
            spoilt[1] = value
            fit = compiled(replace(q, **{name: spoilt}))
            assert len(fit.i) == len(fit.j) == len(fit.residual) <= 4
            assert ((fit.i >= 0) & (fit.i < 4) & (fit.j >= 0) & (fit.j < 4)).all()
    # A detection whose place is no number matches nothing, and spoils nothing where the first matches are others.
    more = replace(
        q, xy=np.append(q.xy, [[np.nan, 3.0]], axis=0), covariance=np.append(q.covariance, q.covariance[:1], axis=0),
        magnitude=np.append(q.magnitude, 4.0),
    )  # fmt: skip
    fit = compiled(more)
    assert fit.i.tolist() == fit.j.tolist() == [0, 1, 2, 3]
    assert np.allclose(fit.residual, 0.0, atol=1e-9)


def test_matches_and_shapes_that_cannot_be_are_refused():
    q = problem(toward([[300, 200], [800, 150], [500, 700]]))
    for i, j in (([0, 1, 3], [0, 1, 2]), ([0, 1, 2], [0, -1, 2]), ([0, 1, 2], [0, 1, 10**12]), ([], [])):
        with pytest.raises(IndexError, match="not in the list"):
            compiled(q, np.array(i, dtype=int), np.array(j, dtype=int))
    for wrong in ({"magnitude": q.magnitude[:2]}, {"covariance": q.covariance[0]}, {"V": q.V[:, None]}):
        with pytest.raises(ValueError, match="shapes"):
            compiled(replace(q, **wrong))
