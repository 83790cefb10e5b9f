"""The reports of `helmstar attitude` and `helmstar allan`."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from helmstar.report import allan, telemetry, telemetry_figures

_spec = importlib.util.spec_from_file_location(
    "report_samples", Path(__file__).parents[1] / "browser" / "report_samples.py"
)
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)


@pytest.mark.parametrize("spoil", [False, True])
def test_telemetry_figures_are_valid_for_plotly(spoil):
    import plotly.graph_objects as go

    result, frames = samples.telemetry(3000, spoil=spoil)
    clock = telemetry_figures.Clock.of(frames["updates"]["time_s"].to_numpy())
    shapes = telemetry_figures.gap_shapes(result["gaps"], clock)
    gate = np.full(3000, 10.0)
    for figure in (
        telemetry_figures.vector(frames, clock, shapes),
        telemetry_figures.attitude_sigma(frames, clock, shapes),
        telemetry_figures.residuals(frames["updates"], clock, shapes),
        telemetry_figures.nis(frames["updates"], clock, shapes, gate),
        telemetry_figures.attitude(frames, clock, shapes),
        allan.allan_figure(samples.allan()["axes"]),
    ):
        go.Figure(figure)


def test_telemetry_page_lists_everything(tmp_path):
    result, frames = samples.telemetry(2000)
    path = telemetry.write_telemetry_report(result, frames, tmp_path / "r.html")
    html = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 8e6
    assert "a<b>" not in html
    for text in (
        "gyro_x_rad_s is not a number",
        "estimated from the data",
        "1, 1, 8",
        "1 gap",
        "inside its band",
    ):
        assert text in html


@pytest.mark.parametrize("kept", [[], ["filtered"], ["updates"], ["filtered", "smoothed", "updates"]])
@pytest.mark.parametrize("rows", [1, 30])
def test_telemetry_page_of_little(tmp_path, kept, rows):
    result, frames = samples.telemetry(rows, gaps=False)
    subset = {name: frames[name] for name in kept}
    telemetry.write_telemetry_report({}, subset, tmp_path / "a.html")
    telemetry.write_telemetry_report(
        result, {name: frame.iloc[:0] for name, frame in subset.items()}, tmp_path / "b.html"
    )


def test_refused_rows_are_all_drawn():
    result, frames = samples.telemetry(20000)
    clock = telemetry_figures.Clock.of(frames["updates"]["time_s"].to_numpy())
    figure = telemetry_figures.nis(frames["updates"], clock, [], None)
    refused = next(trace for trace in figure["data"] if trace["name"] == "refused by the gate")
    assert len(refused["x"]) == result["rows_rejected"]


def test_gate_of_three_degrees_of_freedom_is_the_limit_given():
    result, frames = samples.telemetry(10)
    assert telemetry._gate(result, frames["updates"]) * 3 == pytest.approx(result["gate_limit"])


def test_quaternion_signs_become_continuous():
    _, frames = samples.telemetry(500)
    names = [f"q_bn_{name}" for name in "xyzw"]
    frames["smoothed"].loc[100:200, names] *= -1.0
    frames["smoothed"].loc[20, names] = np.nan
    figure = telemetry_figures.attitude(frames, telemetry_figures.Clock.of(np.arange(500.0)), [])
    smooth = np.array([trace["y"] for trace in figure["data"]]).T
    steps = np.abs(np.diff(smooth[np.isfinite(smooth).all(axis=1)], axis=0))
    assert steps.max() < 0.01


@pytest.mark.parametrize("axes", ["xyz", "x", ""])
def test_allan_page(tmp_path, axes):
    result = samples.allan()
    result["axes"] = {name: result["axes"][name] for name in axes}
    html = allan.write_allan_report(result, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "arw_arcsec_sqrt_s = 0.05" in html
