"""xu2020 from pixels: frames at the true attitude become the two directions that the filters take, with honest covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from helmstar.campaign.engine import Engine
from helmstar.cli import main
from helmstar.errors import ConfigurationError, DataError
from helmstar.scenarios import xu2020_images
from helmstar.scenarios.specification import build, load
from helmstar.scenarios.xu2020_images import take_frames
from helmstar.scenarios.xu2020_specification import OF_IMAGES

SMALL = {"star.level": "image", "runs": 2, "width": 2, "updates": 20, "star.image.pixels": 160, "seed": 3}


def test_fewer_runs_stand_for_many_unless_they_are_stated(tmp_path):
    _, plain = load("xu2020")
    _, image = load("xu2020", {"star.level": "image"})
    _, stated = load("xu2020", {"star.level": "image", "runs": 7})
    assert (plain.runs, plain.updates, plain.star.level, plain.note) == (100, 1000, "direction", "")
    assert {k: getattr(image, k) for k in OF_IMAGES} == OF_IMAGES
    assert (stated.runs, stated.updates) == (7, OF_IMAGES["updates"])
    assert f"{2 * 8 * (OF_IMAGES['updates'] + 1)} frames" in stated.note  # whole blocks of four runs
    mine = tmp_path / "mine.toml"
    mine.write_text('experiment = "xu2020"\nupdates = 12\n[star]\nlevel = "image"\n')
    assert load(str(mine))[1].updates == 12
    assert load(str(mine))[1].runs == OF_IMAGES["runs"]


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("star.level", "pixels", ["star.level", "'direction'"]),
        ("star.image.fov_deg", 90.0, ["star.image.fov_deg"]),
        ("star.image.pixels", 10, ["star.image.pixels"]),
        ("star.image.colour", 1, ["colour"]),
        ("truth.rate_amplitude_rad_s", 0.5, ["drawn out", "exposure_s"]),
    ],
)
def test_keys_are_checked(key, value, words):
    with pytest.raises(ConfigurationError) as e:
        load("xu2020", {"star.level": "image", key: value})
    for word in words:
        assert word in str(e.value)


def spinning(n: int) -> np.ndarray:
    """Attitudes (n, 4) of a body that turns by 0.02 deg from each to the next."""
    start = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    return (Rotation.from_rotvec(np.arange(n)[:, None] * np.radians([0.012, -0.016, 0.0])) * start).as_quat()


def test_directions_from_frames_have_honest_covariances(monkeypatch, tmp_path):
    """Twelve instants, two heads, each 2 degrees of freedom: the sum within 99.9% of chi-square. Errors of neighbouring frames
    are independent as far as they are noise; what stars that overlap add is shared, for which the upper end is 1.5 times as far."""
    monkeypatch.setenv("HELMSTAR_CACHE_DIR", str(tmp_path))
    image = load("xu2020", SMALL)[1].star.image
    q, r_N = spinning(12), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    frames = take_frames(image, 5, 1, 1.0, q, r_N)
    assert frames.seen.all()
    error = frames.z[0] - np.einsum("kij,hj->khi", Rotation.from_quat(q).as_matrix(), r_N)
    across = np.linalg.pinv(frames.cov[0], rcond=1e-6, hermitian=True)
    total = float(np.einsum("khi,khij,khj->", error, across, error))
    assert chi2.ppf(5e-4, 48) < total < 1.5 * chi2.ppf(1 - 5e-4, 48)
    assert np.allclose(np.linalg.norm(frames.z, axis=-1), 1.0, atol=1e-12)
    assert 0.3 < np.degrees(frames.sigma) * 3600.0 < 5.0

    def untouched(task):
        raise AssertionError("kept frames are taken again")

    monkeypatch.setattr(xu2020_images, "solve_block", untouched)
    again = take_frames(image, 5, 1, 1.0, q, r_N)
    assert np.array_equal(again.z, frames.z)
    kept = next((tmp_path / "frames").glob("*.npz"))
    kept.write_bytes(b"damaged")
    with pytest.raises(AssertionError, match="taken again"):
        take_frames(image, 5, 1, 1.0, q, r_N)


def test_a_run_has_the_same_frames_in_any_company(monkeypatch):
    monkeypatch.setenv("HELMSTAR_CACHE_DIR", "")
    image = load("xu2020", SMALL)[1].star.image
    q, r_N = spinning(2), np.eye(3)[:2]
    alone, both = (take_frames(image, 5, n, 1.0, q, r_N) for n in (1, 2))
    assert np.array_equal(both.z[:1], alone.z)
    assert not np.array_equal(both.z[1], both.z[0])


def test_a_head_that_sees_nothing_is_an_error(monkeypatch):
    monkeypatch.setenv("HELMSTAR_CACHE_DIR", "")
    image = load("xu2020", SMALL | {"star.image.exposure_s": 1e-4})[1].star.image
    with pytest.raises(DataError, match=r"head 1: .*exposure_s"):
        take_frames(image, 5, 1, 1.0, spinning(2), np.eye(3)[:2])


def test_filters_are_consistent_on_what_the_frames_say():
    """Tuned with each frame's own covariance: NEES of 2 runs, updates 6 to 20, within 99.9% for a third of them independent."""
    experiment = build("xu2020", load("xu2020", SMALL)[1])
    engine = Engine(experiment, ["lie_tuned"])
    engine.compile(1)
    block = engine.compute(0)
    nees = block.arrays["lie_tuned"]["nees"][:, 5:]
    some = nees.size // 3
    assert chi2.ppf(5e-4, 3 * some) / some < nees.mean() < chi2.ppf(1 - 5e-4, 3 * some) / some
    assert np.all(block.arrays["lie_tuned"]["nis_dof"] == 4)  # two residuals across each direction
    error = np.sqrt((block.arrays["lie_tuned"]["error_rad"][:, 5:] ** 2).mean(axis=(0, 1)))
    ratio = error / np.sqrt(np.diagonal(experiment.bound(), axis1=1, axis2=2)[5:].mean(axis=0))
    assert np.all((ratio > 0.6) & (ratio < 1.5))


def test_the_command_says_how_many_frames_it_takes(capsys, monkeypatch):
    monkeypatch.setattr(
        "helmstar.scenarios.specification.build", lambda *a: (_ for _ in ()).throw(DataError("stop here"))
    )
    assert main(["run", "xu2020", "--set", "star.level=image"]) == 1
    err = capsys.readouterr().err
    assert "4 runs, seed 0" in err
    assert "1928 frames" in err
