"""Examples run and are right; the commands that README and the docs show run as they stand."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from helmstar.cli import main

ROOT = Path(__file__).resolve().parents[2]


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_filter_by_hand():
    result = load("filter_by_hand").main()
    assert result["nis_band"][0] < result["nis"] < result["nis_band"][1]
    assert result["smoothed"]["attitude_arcsec"] < result["filtered"]["attitude_arcsec"] < 20.0
    assert result["smoothed"]["drift_arcsec_s"] < result["filtered"]["drift_arcsec_s"]
    # One run; the drift's error lasts for minutes, so NEES of 6 states scatters by some 2 from seed to seed.
    assert 2.0 < result["filtered"]["nees"] < 14.0


def test_an_approach_by_its_frames(tmp_path):
    done = load("opnav").main(tmp_path)
    assert np.abs(done["over_sigma"]).max() < 3.0
    t = done["result"]["trajectory"]
    assert t["frames_used"] == 10
    assert max(t["position_sigma_km"][1:]) < 1.0  # 8 km before; 0.01 deg of pointing is 0.5 km at 2800 km
    assert all(f["status"] == "found" for f in done["result"]["frames"])


def test_the_example_record_is_what_its_script_writes(tmp_path):
    load("make_telemetry").main(tmp_path)
    for name in ("gyro.csv", "stars.csv", "still.csv"):
        fresh, kept = (
            np.loadtxt(f / name, delimiter=",", skiprows=1) for f in (tmp_path, ROOT / "examples" / "telemetry")
        )
        assert np.allclose(fresh, kept, rtol=1e-9, atol=1e-12)


def commands(document: Path) -> list[str]:
    """Indented lines of a document that call helmstar, without redirections."""
    found = re.findall(r"^    (helmstar .*)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return [c.split("#")[0].strip() for c in found]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of what the commands read, so that nothing is written into the checkout."""
    here = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "examples", here / "examples")
    return here


@pytest.mark.parametrize("line", commands(ROOT / "README.md"))
def test_readme_command(line, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words, _, target = line.partition(" > ")
    assert main(shlex.split(words)[1:]) == 0
    out = capsys.readouterr().out
    assert out
    if target:
        Path(target.strip()).write_text(out, encoding="utf-8")


def test_there_are_readme_commands():
    assert len(commands(ROOT / "README.md")) >= 8
