"""The report as a reader meets it: from a file, in a browser without a network."""

import itertools
import re
import time
from pathlib import Path

import pytest
from pages import PHONE, WICKED, WINDOWS, World
from pictures import change, drawn_share, same_as_kept

from shapespace.cli import main

LOADED_S = 3.0
MAIN_WIDGETS = "figure.turning .widget"


@pytest.fixture(scope="module")
def report(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("report") / "report.html"
    assert main(["report", str(world.fits), "-o", str(page), "--no-open", "--quiet"]) == 0
    return page


@pytest.mark.parametrize(("viewport", "scheme"), WINDOWS)
def test_every_figure_is_drawn(open_tab, report: Path, viewport: dict, scheme: str) -> None:
    tab = open_tab(report.as_uri(), viewport, scheme)
    where = f"{viewport['width']}-{scheme}"
    tab.shot(f"{where}-top")
    tab.page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    images = tab.page.locator("figure:not(.turning) img")
    assert images.count() >= 6
    for k in range(images.count()):
        image = images.nth(k)
        image.scroll_into_view_if_needed()
        assert image.evaluate("i => i.decode().then(() => i.naturalWidth)") > 0
        assert drawn_share(image.screenshot()) > 0.02, image.get_attribute("alt")
    widgets = tab.page.locator(MAIN_WIDGETS)
    assert widgets.count() >= 2
    for k in range(widgets.count()):
        widget = widgets.nth(k)
        widget.scroll_into_view_if_needed()
        canvas = widget.locator("canvas").first
        canvas.wait_for(state="visible")
        ends = time.monotonic() + 60
        while drawn_share(canvas.screenshot()) <= 0.005:
            assert time.monotonic() < ends, widget.get_attribute("aria-label")
    tab.shot(f"{where}-whole", full_page=True)
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "it scrolls sideways"
    assert tab.complaints == []
    assert tab.asked == []


def test_it_is_there_within_three_seconds(open_tab, report: Path) -> None:
    tab = open_tab()
    since = time.perf_counter()
    tab.page.goto(report.as_uri(), wait_until="load")
    taken = time.perf_counter() - since
    assert taken < 3 * LOADED_S, f"{taken:.1f} s, on a machine that may be busy"
    assert report.stat().st_size < 8_000_000


def test_a_table_sorts_by_number_and_back(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri())
    table = tab.page.locator("table.sortable").first
    table.scroll_into_view_if_needed()
    head = table.locator("thead th", has=tab.page.locator("button")).filter(has_text=re.compile("mean", re.I)).first
    column = head.evaluate("th => th.cellIndex")

    def values() -> list[float]:
        cells = table.locator("tbody tr").evaluate_all("(rows, k) => rows.map(r => r.cells[k].dataset.value)", column)
        return [float(value) for value in cells if value]

    head.locator("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert len(values()) >= 3
    assert values() == sorted(values())
    head.locator("button").press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    assert values() == sorted(values(), reverse=True)


def test_the_theme_switches_and_is_remembered(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri())
    before = tab.page.screenshot()
    tab.page.locator("#theme").click()
    assert change(before, tab.page.screenshot()) > 0.3
    colour = "getComputedStyle(document.body).backgroundColor"
    dark = tab.page.evaluate(colour)
    tab.page.reload()
    assert tab.page.evaluate(colour) == dark


def test_a_label_that_is_a_script_stays_text(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri())
    assert tab.page.evaluate("window.wicked") is None
    assert "&lt;script&gt;" in report.read_text(encoding="utf-8")
    tab.page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    for k in range(tab.page.locator(MAIN_WIDGETS).count()):
        tab.page.locator(MAIN_WIDGETS).nth(k).scroll_into_view_if_needed()
        tab.page.wait_for_timeout(300)
    assert tab.page.evaluate("window.wicked") is None
    assert WICKED in tab.page.evaluate("document.body.innerText")
    assert tab.complaints == []


def test_without_script_it_can_still_be_read(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri(), java_script_enabled=False)
    text = tab.page.locator("main").inner_text()
    assert "plain" in text
    assert "broken" in text
    posters = tab.page.locator("figure.turning .poster img")
    assert posters.count() >= 2
    tab.page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert all(posters.nth(k).is_visible() for k in range(posters.count()))
    tab.page.mouse.wheel(0, 1500)
    tab.until("scrollY > 1000")
    assert tab.page.locator("nav").bounding_box()["y"] == 0


def test_the_navigation_stays_and_links_open_what_is_folded(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri(), PHONE)
    tab.page.locator("a", has_text="All pictures of").first.click()
    tab.page.locator("details.part[open] figure.turning").first.wait_for()
    nav = tab.page.locator("nav")
    tab.until("document.querySelector('nav [aria-current]').textContent === 'Fits'")
    assert nav.bounding_box()["y"] == 0
    last = nav.locator("a").last
    last.click()
    tab.until("document.querySelector('nav [aria-current]').textContent === 'Settings'")
    box = last.bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= PHONE["width"] and nav.bounding_box()["y"] == 0


def test_it_can_be_read_by_ear_and_by_keyboard(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri())
    page = tab.page
    assert page.locator("img:not([alt]), img[alt='']").count() == 0
    levels = page.locator("h1, h2, h3, h4, h5").evaluate_all("hs => hs.map(h => +h.tagName[1])")
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels)), levels
    assert page.locator("main").count() == page.locator("nav").count() == 1
    unnamed = "[...document.querySelectorAll('button, input, select')].filter(e => !e.closest('[hidden]') && !(" + (
        "e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.length)).length"
    )
    assert page.evaluate(unnamed) == 0
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent").lower().startswith("skip")


def test_it_prints(open_tab, report: Path, tmp_path: Path) -> None:
    tab = open_tab(report.as_uri())
    tab.page.pdf(path=tmp_path / "report.pdf", format="A4", print_background=True)
    content = (tmp_path / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", content)) <= 60


def test_the_picture_in_the_readme_is_this_report(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri(), {"width": 1200, "height": 900})
    tab.page.evaluate("document.getElementById('the-fits').scrollIntoView()")
    tab.until("[...document.querySelectorAll('.card img')].every(i => i.complete)")
    same_as_kept("report.png", tab.shot("readme"), width=1000)
