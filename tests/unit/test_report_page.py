"""The page builder: escaping, packed arrays, thinning, numbers for people, atomic writing."""

import base64
import json

import numpy as np
import pytest

from helmstar.report.encode import ArrayPool, envelope, extremes, pack, sample, script_json, spread
from helmstar.report.page import Chip, Column, Page, number


def test_arrays_are_stored_once_and_come_back():
    pool = ArrayPool()
    x = np.linspace(0.0, 1.0, 100)
    x[3] = np.nan
    x[4] = np.inf
    packed = pack({"x": x, "again": x.copy(), "few": np.array([1.0, np.nan]), "scalar": np.float64("inf")}, pool)
    assert packed == {"x": {"$array": 0}, "again": {"$array": 0}, "few": [1.0, None], "scalar": None}
    assert len(pool.entries) == 1
    back = np.frombuffer(base64.b64decode(pool.entries[0]["b"]), dtype="<" + pool.entries[0]["t"])
    assert np.isnan(back[3:5]).all()
    assert np.allclose(back[5:], x[5:], rtol=1e-6)


def test_times_far_from_zero_keep_their_resolution():
    pool = ArrayPool()
    pack(3.1e8 + 0.1 * np.arange(100), pool)
    assert pool.entries[0]["t"] == "f8"


def test_script_json_cannot_end_the_script():
    text = script_json({"a": "</script><!-- \u2028 &"})
    assert "<" not in text
    assert "\u2028" not in text
    assert json.loads(text) == {"a": "</script><!-- \u2028 &"}
    with pytest.raises(ValueError):
        script_json(float("nan"))


def test_thinning_keeps_extremes_ends_and_density():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(100_000)
    noise[777], noise[55_555], noise[9] = 30.0, -30.0, np.nan
    kept = extremes(noise, 500)
    assert {0, 777, 55_555, len(noise) - 1} <= set(kept)
    assert len(kept) <= 500
    assert {777, 55_555} <= set(extremes(np.stack([noise, -noise]), 500))
    cloud = sample(noise, 1000)
    assert len(cloud) <= 1000
    assert np.std(noise[cloud]) == pytest.approx(2.0, abs=0.6)
    assert spread(10, 20).tolist() == list(range(10))
    assert spread(1000, 300)[-1] == 999
    assert extremes(np.full(1000, np.nan), 100).size <= 100
    index, low, high = envelope(noise, 300)
    assert len(index) <= 300
    assert (low.min(), high.max()) == (-30.0, 30.0)
    assert [len(part) for part in envelope(noise[:7], 300)] == [7, 7, 7]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00312, "0.00312"), (None, "–"), (float("nan"), "–"), (3.5e-6, "3.5×10⁻⁶"), (-2.5, "−2.5"),
        (12345, "12\u202f345"), (51770.2, "51\u202f770"), (3, "3"),
    ],
)  # fmt: skip
def test_numbers_for_people(value, text):
    assert number(value) == text


def test_page_escapes_and_has_headers_ids_and_code():
    page = Page("A <title>")
    page.section("One & two", "see `x < 1`")
    page.section("One & two")
    page.table([Column("N<ame", align="left"), Column("RMS", "deg")], [["a<b", 1.5], [Chip("good", "ok>"), None]])
    with page.details("more"):
        page.code("a < b", "Command")
    html = page.html()
    assert "A &lt;title&gt;" in html
    assert "see <code>x &lt; 1</code>" in html
    assert 'id="one-two"' in html
    assert 'id="one-two-2"' in html
    assert '<th scope="col" role="columnheader" class="right">RMS <span class="unit">deg</span></th>' in html
    assert "a&lt;b" in html
    assert "plotly.js" not in html  # a page without figures does not carry it


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    target = tmp_path / "r.html"
    Page("old").write(target)
    page = Page("new")
    monkeypatch.setattr(Page, "html", lambda self: (_ for _ in ()).throw(RuntimeError("stop")))
    with pytest.raises(RuntimeError):
        page.write(target)
    assert "old" in target.read_text()
    assert list(tmp_path.iterdir()) == [target]


def test_dark_palette_covers_every_colour():
    import re
    from pathlib import Path

    from helmstar.report import style

    script = Path(style.__file__).with_name("page.js").read_text(encoding="utf-8")
    known = set(re.findall(r'"(#[0-9a-f]{6})": "#', script))
    used = {
        value for name, value in vars(style).items() if name.isupper() and isinstance(value, str) and value[0] == "#"
    }
    assert used == known


@pytest.mark.parametrize("background", ["#ffffff", "#12161c"])
def test_plot_colours_contrast_with_the_background(background):
    import re
    from pathlib import Path

    from helmstar.report import style

    def luminance(colour):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
        return np.dot([0.2126, 0.7152, 0.0722], linear)

    script = Path(style.__file__).with_name("page.js").read_text(encoding="utf-8")
    pairs = re.findall(r'"(#[0-9a-f]{6})": "(#[0-9a-f]{6})"', script)
    for light, dark in pairs:
        a, b = sorted([luminance(light if background == "#ffffff" else dark), luminance(background)])
        assert (b + 0.05) / (a + 0.05) >= 3.0
