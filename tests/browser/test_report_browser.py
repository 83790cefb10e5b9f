"""The reports in a real headless Chromium: no error, every plot drawn, nothing loaded, usable on a phone."""

import shutil

import pytest
import report_samples as samples

CHROMIUM = shutil.which("chromium")
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage"]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not on the PATH: the browser tests did not run"),
]
SIZES = {"desktop": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: the browser tests did not run"
    )
    with api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=ARGS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    from helmstar.report.allan import write_allan_report
    from helmstar.report.claims import Claim
    from helmstar.report.monte_carlo import write_monte_carlo_report
    from helmstar.report.telemetry import write_telemetry_report

    folder = tmp_path_factory.mktemp("reports")
    names = ["lie_tuned", "quaternion_ekf", "quaternion_ekf_one_star_tuned"]
    claims = [Claim(**samples.CLAIM, verdict="holds in part")]
    return {
        "campaign": write_monte_carlo_report(*samples.campaign(names, 12, 400), claims, folder / "campaign.html"),
        "short": write_monte_carlo_report(*samples.campaign(["lie"], 1, 20, 10, spoil=True), [], folder / "short.html"),
        "telemetry": write_telemetry_report(*samples.telemetry(4000, spoil=True), folder / "telemetry.html"),
        "allan": write_allan_report(samples.allan(), folder / "allan.html"),
    }


@pytest.fixture
def visit(browser, reports):
    """Open a report offline; afterwards nothing may have been loaded, complained about or thrown."""
    contexts, troubles = [], []

    def open_page(name, size="desktop", scheme="light"):
        width, height = SIZES[size]
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme, has_touch=size == "phone", offline=True
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda m: troubles.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda r: None if r.url.startswith(("file:", "data:", "blob:")) else troubles.append(r.url))
        page.goto(reports[name].as_uri())
        page.wait_for_selector("html[data-drawn]", state="attached", timeout=60_000)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert troubles == []


@pytest.mark.parametrize(
    ("name", "size"),
    [("campaign", "desktop"), ("campaign", "phone"), ("telemetry", "desktop"), ("telemetry", "phone"),
     ("short", "phone"), ("allan", "phone")],
)  # fmt: skip
def test_every_plot_is_drawn_and_the_page_fits(visit, name, size):
    page = visit(name, size, "dark" if size == "phone" else "light")
    plots = page.locator(".plot")
    assert plots.count() >= 1
    sizes = plots.evaluate_all(
        "nodes => nodes.map(n => { const s = n.querySelector('svg.main-svg'); if (!s) return [0, 0];"
        " const b = s.getBoundingClientRect(); return [b.width, b.height]; })"
    )
    assert all(width > 200 and height > 100 for width, height in sizes), sizes
    drawn = plots.evaluate_all("nodes => nodes.map(n => n.querySelectorAll('.plot path, path.js-line, .point').length)")
    assert all(count > 0 for count in drawn), drawn
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    assert page.locator(".plot .modebar a[href*='plot']").count() == 0


def test_the_selector_changes_the_figures_of_its_group(visit):
    page = visit("campaign")
    selects = page.locator("figure select")
    assert selects.count() == 4
    read = "node => [...node.closest('figure').querySelector('.plot').data].map(t => Array.from(t.y || []).slice(-3))"
    before = selects.nth(0).evaluate(read)
    selects.nth(0).select_option("quaternion_ekf")
    assert selects.nth(0).evaluate(read) != before
    assert {selects.nth(i).input_value() for i in range(4)} == {"quaternion_ekf"}
    assert "wider than the first view" in page.locator("figure .note").filter(has_text="3σ band").first.inner_text()


def test_views_and_legend_are_buttons(visit):
    page = visit("campaign", "phone")
    figure = page.locator("figure").filter(has=page.locator(".views button")).first
    whole = figure.locator(".views button").last
    span = "n => n._fullLayout.yaxis.range[1] - n._fullLayout.yaxis.range[0]"
    before = figure.locator(".plot").evaluate(span)
    whole.click()
    assert whole.get_attribute("aria-pressed") == "true"
    assert figure.locator(".plot").evaluate(span) != before
    entry = figure.locator(".legend button").first
    entry.click()
    assert figure.locator(".legend button").first.get_attribute("aria-pressed") == "false"
    assert figure.locator(".plot").evaluate("n => n.data.filter(t => t.visible === 'legendonly').length") >= 1


def test_colours_follow_the_scheme_and_print_is_light(visit):
    page = visit("short", scheme="dark")
    colour = "() => document.querySelector('.plot').data[0].line.color"
    assert page.evaluate(colour) == "#5cb3f0"
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"() => ({colour})() === '#0067a8'")
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"() => ({colour})() === '#5cb3f0'")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate(colour) == "#0067a8"
    assert page.locator("details:not([open])").count() == 0


def test_headings_tables_and_plots_are_named(visit):
    page = visit("telemetry")
    assert page.locator("h1").count() == 1
    assert page.evaluate("[...document.querySelectorAll('.contents a')].every(a => document.querySelector(a.hash))")
    unnamed = "nodes => nodes.filter(n => !(n.getAttribute('aria-label') || '').trim()).length"
    assert page.locator(".plot").evaluate_all(unnamed) == 0
    assert page.locator("table").evaluate_all("t => t.filter(x => !x.querySelector('th[scope=col]')).length") == 0


def test_the_command_is_copied(visit):
    page = visit("allan")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    button = page.locator(".copy").first
    button.click()
    page.wait_for_function("() => document.querySelector('.copy').textContent === 'Copied'")
