"""Pages in a headless Chromium, on a wide screen and on a phone: charts, sorting, filters, keyboard, scripts."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from mfvpr.report.pages import write_comparison, write_report
from tests.needs import needs
from tests.run_folders import RANKS, SYSTEMS, write_run

pytestmark = [pytest.mark.slow, needs("chromium", "playwright")]
SEQUENCES = ("day", "night " * 12)


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Pages of runs with one sequence, with two, and without ground truth, and of several runs compared."""
    root = tmp_path_factory.mktemp("runs")
    runs = [
        write_run(root / "one"),
        write_run(root / "two", sequences=SEQUENCES),
        write_run(root / "none", truth=False),
    ]
    write_comparison([*runs, write_run(root / "other")], root / "all.html")
    return {"all": root / "all.html"} | {run.name: write_report(run) for run in runs}


@pytest.fixture
def tab(browser, pages):
    """Opens a page, and fails where it says anything, asks anything, or wants anything from elsewhere."""
    said, contexts = [], []

    def open_page(name, width=1280, scheme="light"):
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme))
        page = contexts[-1].new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("dialog", lambda dialog: said.append(dialog.message))
        page.on("request", lambda request: request.url.startswith(("file:", "data:")) or said.append(request.url))
        page.goto(pages[name].as_uri())
        page.wait_for_selector("html[data-ready]", state="attached")
        return page

    yield SimpleNamespace(page=open_page, said=said)
    for context in contexts:
        context.close()
    assert said == []


def cells(page, column, table="Top predictions"):
    """Texts of the visible cells of a table's column."""
    rows = page.locator(f"[aria-label='{table}'] tbody tr:visible td:nth-child({column})")
    return rows.all_text_contents()


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["one", "two", "none", "all"])
def test_pages_and_their_charts_fit(tab, tmp_path, name, width):
    page = tab.page(name, width, "dark" if width == 390 else "light")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    charts = page.locator(".chart")
    assert charts.count() == {"one": 4, "two": 4, "none": 0, "all": 4}[name]
    for chart in charts.all():
        assert chart.get_attribute("aria-label")
        assert chart.locator("svg.main-svg").first.bounding_box()["width"] > 250
    for image in page.locator(".picture img").all():
        assert image.evaluate("image => image.decode().then(() => image.naturalWidth)") == 1000
        assert len(image.get_attribute("alt")) > 40
    page.screenshot(path=tmp_path / "page.png", full_page=True)
    pixels = np.asarray(Image.open(tmp_path / "page.png").convert("L"))
    assert pixels.shape[1] == width
    assert (np.median(pixels) > 128) == (width == 1280)
    assert pixels.std() > 10


def test_labels_of_charts_are_names_and_no_html(tab):
    page = tab.page("one")
    assert page.locator("#chart-depths .legendtext").all_text_contents() == [*SYSTEMS]
    assert {*page.locator("#chart-intervals .ytick").all_text_contents()} == {*SYSTEMS}
    lines = page.locator("#chart-depths .scatterlayer .js-line")
    colors = lines.evaluate_all("lines => lines.map(one => one.style.stroke)")
    assert colors == ["rgb(138, 143, 152)", "rgb(11, 132, 198)", "rgb(225, 112, 26)"]


def test_tables_are_sorted_by_click_and_by_key(tab):
    page = tab.page("one")
    scores, header = cells(page, 4), page.locator("[aria-label='Top predictions'] th").nth(3)
    assert [float(score) for score in scores] == [*range(10, 20)]
    page.get_by_role("button", name="score", exact=True).click()
    assert (header.get_attribute("aria-sort"), cells(page, 4)) == ("ascending", scores)
    page.get_by_role("button", name="score", exact=True).press("Enter")
    assert (header.get_attribute("aria-sort"), cells(page, 4)) == ("descending", scores[::-1])
    page.get_by_role("button", name="first correct rank").press("Space")
    assert header.get_attribute("aria-sort") is None
    assert cells(page, 6) == ["1"] * 8 + ["2", ""]  # numbers, and what is empty behind them
    for _ in range(2):
        page.get_by_role("button", name="McNemar p").click()
    assert cells(page, 5, "Every two of the same queries") == ["0.62", "0.51", "0.062"]


def test_answers_are_filtered_by_click_and_by_key(tab):
    page = tab.page("two")
    counts = page.locator("#shown")
    assert counts.text_content() == "4 of 4 pictures, 20 of 60 predictions"
    page.get_by_role("combobox", name="Outcome").select_option("incorrect")
    assert counts.text_content() == "2 of 4 pictures, 4 of 60 predictions"
    assert {*cells(page, 6)} == {"incorrect"}
    page.get_by_role("combobox", name="Sequence").select_option("day")
    assert counts.text_content() == "1 of 4 pictures, 2 of 60 predictions"
    page.get_by_role("combobox", name="System").focus()
    page.keyboard.press("Home")
    num_wrong = sum(10 - ranks.count(1) for ranks in RANKS.values())
    assert counts.text_content() == f"1 of 4 pictures, {num_wrong} of 60 predictions"
    page.get_by_role("combobox", name="System").select_option(SYSTEMS[0])
    assert page.locator(".picture:visible").count() == 0
    assert {*cells(page, 1)} == {SYSTEMS[0]}


def test_the_theme_follows_a_choice(tab):
    page = tab.page("one", scheme="dark")
    look = "['body', '.xtick text'].map(one => getComputedStyle(document.querySelector(one)).%s)"
    before, text = page.evaluate(look % "backgroundColor")[0], page.evaluate(look % "fill")[1]
    page.get_by_role("button", name="Light", exact=True).click()
    assert before != page.evaluate(look % "backgroundColor")[0]
    assert text != page.evaluate(look % "fill")[1]


def test_the_keyboard_reaches_everything(tab):
    page = tab.page("two", 390)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the results"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        focus = page.evaluate("[document.activeElement.tagName, getComputedStyle(document.activeElement).outlineStyle]")
        reached.add(tuple(focus))
    assert {tag for tag, _ in reached} >= {"SUMMARY", "DIV", "BUTTON", "SELECT"}
    assert "none" not in {style for tag, style in reached if tag != "BODY"}


def test_scripts_in_what_is_added_do_not_run(tab):
    page = tab.page("one")
    page.evaluate("document.body.insertAdjacentHTML('beforeend', '<img src=data:, onerror=\"window.ran = 1\">')")
    page.evaluate("fetch('https://example.invalid').catch(() => { window.refused = 1 })")
    assert page.evaluate("[window.ran, window.refused]") == [None, 1]
    assert all("Content Security Policy" in line for line in tab.said)
    tab.said.clear()
