"""The report of a campaign: figures plotly accepts, one self-contained page, any subset of what a campaign may hold."""

import importlib.util
import json
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from helmstar.report import numbers
from helmstar.report.claims import Claim, verdict_chip
from helmstar.report.monte_carlo import monte_carlo_page, write_monte_carlo_report

_spec = importlib.util.spec_from_file_location(
    "report_samples", Path(__file__).parents[1] / "browser" / "report_samples.py"
)
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)

CLAIMS = [
    Claim(**samples.CLAIM, verdict=verdict) for verdict in ("holds", "does not hold", "holds in part", "measured")
]
SMALL = ["lie_printed", "lie", "lie_tuned", "quaternion_ekf", "quaternion_ekf_one_star"]


@pytest.fixture
def every_figure(monkeypatch):
    from helmstar.report.page import Page

    found = []
    original = Page._figure

    def keep(self, item):
        found.extend(item.variants().values())
        return original(self, item)

    monkeypatch.setattr(Page, "_figure", keep)
    return found


def own_part(html):
    """The page without plotly's own source, which mentions addresses that it never loads here."""
    return re.sub(r"<script>/\*\*\s*\* plotly\.js.*?</script>", "", html, flags=re.S)


@pytest.mark.parametrize(
    ("names", "runs", "times"),
    [(SMALL, 6, 300), (["lie"], 1, 20), (["mine"], 2, 20), (["static_svd", "lie_tuned"], 3, 1), (["lie"], 1, 2)],
)
def test_every_figure_is_valid_for_plotly(every_figure, names, runs, times):
    import plotly.graph_objects as go

    dataset, summary = samples.campaign(names, runs, times)
    monte_carlo_page(dataset, summary, CLAIMS)
    assert len(every_figure) >= 5
    for figure in every_figure:
        views = (figure["layout"].get("meta") or {}).get("views", {})
        checked = go.Figure(figure)
        for changes in views.values():
            checked.update_layout({path.replace(".", "_"): value for path, value in changes.items()})


def test_page_is_self_contained_escaped_and_small(tmp_path):
    dataset, summary = samples.campaign()
    dataset.attrs["title"] = "<b>1 & 2</b></script>"
    begin = time.perf_counter()
    path = write_monte_carlo_report(dataset, summary, CLAIMS, tmp_path / "new" / "report.html")
    assert time.perf_counter() - begin < 6.0  # about 0.6 s on an idle core
    html = path.read_text(encoding="utf-8")
    assert len(html.encode()) < 8e6
    assert list(path.parent.iterdir()) == [path]  # no temporary file is left
    rest = own_part(html)
    assert len(rest) < 2.6e6
    assert not re.findall(r"https?://(?!www\.w3\.org/)", rest)
    assert not re.findall(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=[\"'](?!data:|#)", rest)
    assert "default-src 'none'" in html
    assert "<b>1" not in rest
    assert "&lt;b&gt;1 &amp; 2&lt;/b&gt;" in rest
    assert rest.count("</script>") == 2
    data = json.loads(rest.split('id="page-data">')[1].split("</script>")[0], parse_constant=pytest.fail)
    assert len(data["figures"]) >= 10
    assert "helmstar run xu2020 --runs 100 --seed 0" in rest


def test_missing_numbers_and_an_interrupted_campaign(tmp_path):
    dataset, summary = samples.campaign(SMALL, 4, 60, requested=100, spoil=True)
    rest = own_part(write_monte_carlo_report(dataset, summary, [], tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "4 of 100 runs are finished" in rest
    assert "no longer a number" in rest
    json.loads(rest.split('id="page-data">')[1].split("</script>")[0], parse_constant=pytest.fail)


@pytest.mark.parametrize("missing", ["sigma_rad", "nees", "nis", "nis_dof", "bound_rad", "truth_q_bn", "us_per_step"])
def test_any_variable_may_be_missing(tmp_path, missing):
    dataset, summary = samples.campaign(["lie", "lie_tuned"], 2, 30)
    assert write_monte_carlo_report(dataset.drop_vars(missing), summary, CLAIMS, tmp_path / "r.html").exists()


def test_an_empty_summary_still_gives_a_page(tmp_path):
    dataset, _ = samples.campaign(["lie"], 2, 30)
    assert write_monte_carlo_report(dataset, {}, [], tmp_path / "r.html").exists()


def test_headline_names_what_converges_and_what_does_not():
    from helmstar.report.campaign_data import Campaign
    from helmstar.report.campaign_table import headline

    dataset, summary = samples.campaign(["lie_printed", "lie_tuned"], 20, 400)
    first, more = headline(Campaign.from_dataset(dataset, summary))
    assert first.startswith("Over 20 runs, 1 of 2 estimators settle below 1 deg in every run; `lie_tuned`")
    assert "honest covariance" in first
    assert more == "No run of `lie_printed` settles below 1 deg."


def test_paired_comparison_is_of_the_same_runs_and_tuning():
    dataset, summary = samples.campaign(["lie", "lie_left", "lie_tuned", "mekf_tuned", "static_svd"], 12, 700)
    shape = dataset["error_rad"].shape[1:]
    shared = np.random.default_rng(3).standard_normal(shape) * (1.0 + np.arange(shape[0]))[:, None, None]
    arcsec = np.pi / 180 / 3600
    # One draw for all; a reference with the RMS of the draw, and rivals 2 percent above it or the same to rounding.
    for name, factor in {
        "lie": 1.0,
        "lie_left": 1.0 + 1e-9,
        "lie_tuned": 0.5,
        "mekf_tuned": 0.4,
        "static_svd": 1.02,
    }.items():
        dataset["error_rad"].loc[{"estimator": name}] = factor * arcsec * shared
    page = monte_carlo_page(dataset, summary, [])
    table = page.html().split("Paired comparison</h3>")[1]
    rows = table[table.index("<tbody") : table.index("</tbody>")].split("</tr>")[:-1]
    cells = [[re.sub(r"<[^>]+>", "", cell) for cell in re.split("</t[hd]>", row)] for row in rows]
    d = 0.02 * np.sqrt(np.mean(np.sum(shared[:, 199:600] ** 2, axis=-1), axis=1))
    figures = [f"{d.mean():.3g}", f"{d.std(ddof=1) / np.sqrt(12):.3g}"]
    assert [row[0] for row in cells] == ["lie_left", "mekf_tuned", "static_svd"]
    assert cells[0][5].endswith("same to rounding")
    assert (cells[1][1], cells[1][4], cells[1][5][2:]) == ("lie_tuned", "12/12", "better")
    assert (cells[2][1], *cells[2][2:5], cells[2][5][2:]) == ("lie", *figures, "0/12", "worse")
    assert page.html().count("updates 200 to 600") == 2


def test_nothing_to_compare_is_no_table():
    for names, runs in ((["lie"], 4), (["lie", "mekf"], 1), (["mekf", "lie_tuned"], 3)):
        assert "Paired comparison" not in monte_carlo_page(*samples.campaign(names, runs, 30), []).html()


def test_report_imports_neither_jax_nor_plotly_nor_scipy_stats():
    import subprocess

    code = (
        "import sys; import helmstar.report.monte_carlo, helmstar.report.telemetry, helmstar.report.allan;"
        "print([name for name in ('jax', 'plotly', 'scipy', 'xarray', 'pandas') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_verdicts_are_checked():
    with pytest.raises(ValueError, match="a verdict is one of"):
        Claim(**samples.CLAIM, verdict="perhaps")
    assert verdict_chip("does not hold").kind == "bad"


def test_euler_difference_shows_what_scipy_shows():
    from scipy.spatial.transform import Rotation

    truth = Rotation.random(50, rng=1)
    error = 0.3 * np.random.default_rng(2).standard_normal((50, 3))
    estimate = truth * Rotation.from_rotvec(-error)
    expected = (estimate.as_euler("ZYX") - truth.as_euler("ZYX"))[:, ::-1]
    expected = np.degrees(np.angle(np.exp(1j * expected)))
    assert np.allclose(numbers.euler_difference_deg(truth.as_quat(), error), expected, atol=1e-9)


def test_settling_counts_the_last_excursion_and_lost_runs_as_never():
    angle = np.array([[3.0, 0.5, 2.0, 0.5], [0.5, 0.5, 0.5, 0.5], [3.0, 0.5, 0.5, np.inf]])
    found = numbers.settled_at(angle, np.arange(1, 5), 1.0)
    assert found[:2].tolist() == [4.0, 1.0]
    assert np.isnan(found[2])


def test_bands_and_quantiles_against_scipy_and_numpy():
    from scipy import stats

    low, high = numbers.chi_square_ratio_band(300.0)
    assert np.allclose([low, high], stats.chi2.ppf([0.025, 0.975], 300) / 300)
    values = np.random.default_rng(0).standard_normal((9, 5))
    values[3, 2] = np.nan
    assert np.allclose(numbers.quantiles(values, (0.05, 0.5)), np.nanquantile(values, [0.05, 0.5], axis=0))
    assert np.isclose(numbers.total_quantile(np.ones(3), 0.9973), stats.chi.ppf(0.9973, 3))
    sigma = np.array([1.0, 1.0, 0.8])
    norms = np.linalg.norm(sigma * np.random.default_rng(1).standard_normal((200000, 3)), axis=1)
    assert np.isclose(numbers.total_quantile(sigma, 0.5), np.median(norms), rtol=0.01)
