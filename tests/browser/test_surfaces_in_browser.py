"""A correspondence as a reader and a user meet it: the report, and the viewer that marks a vertex on all scans."""

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import ONE_WINDOW, PANE, WINDOWS, viewer
from pictures import change, drawn_share

from same_blobs import FOLDED, HIDDEN, NAMES, write_same
from shapespace.cli import main


@pytest.fixture(scope="module")
def same(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = (*NAMES, *(f"more{k:02d}" for k in range(9)))
    return write_same(tmp_path_factory.mktemp("blobs"), names)


@pytest.fixture(scope="module")
def address(same: Path) -> Iterator[str]:
    with viewer(same) as found:
        yield found


def ready(tab, sides: int = 1):
    tab.until(f"{PANE}?.dataset.ready === 'true'")
    if sides == 1:
        tab.page.get_by_test_id("sides-1").click()
        tab.until(f"{PANE}.shadowRoot.getElementById('which').textContent === '1 to 11 of 15'")
        tab.until("window.shapespaceCells[11].positions !== null")
    tab.page.wait_for_timeout(700)
    return tab


def click(tab, cell: int, across: float, down: float) -> None:
    box = tab.page.get_by_test_id(f"view-{cell}").bounding_box()
    tab.page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
    tab.page.wait_for_timeout(400)


def marked(tab, cell: int) -> list[int]:
    """Return the vertices that a view marks."""
    found = tab.page.evaluate("k => (window.shapespaceCells[k].view._marks.get('marks') || []).map(m => m.label)", cell)
    return [int(label) for label in found]


@pytest.mark.parametrize(("viewport", "scheme"), WINDOWS)
def test_a_click_on_one_surface_marks_the_same_vertex_on_all(
    open_tab, address: str, viewport: dict, scheme: str
) -> None:
    tab = ready(open_tab(address, viewport, scheme))
    assert tab.page.locator(".cell:visible").count() == 12
    assert tab.page.get_by_test_id("which").inner_text() == "1 to 11 of 15"
    before = [tab.page.get_by_test_id(f"view-{k}").screenshot() for k in (0, 1)]
    assert all(drawn_share(picture) > 0.1 for picture in before)
    click(tab, 1, 0.5, 0.55)
    (vertex,) = marked(tab, 1)
    assert all(marked(tab, k) == [vertex] for k in range(12))
    assert change(before[1], tab.page.get_by_test_id("view-1").screenshot()) > 0.001
    row = tab.page.get_by_test_id(f"marked-{vertex}")
    assert "shown by all 15 scans" in row.inner_text()
    row.get_by_role("button").click()
    assert marked(tab, 0) == [] and tab.page.get_by_test_id("save").is_disabled()
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "it scrolls sideways"
    tab.shot(f"{viewport['width']}-{scheme}")
    assert tab.complaints == [] and tab.asked == []


def test_surfaces_open_on_both_sides_with_their_worst_places(open_tab, address: str) -> None:
    tab = ready(open_tab(address), sides=2)
    assert tab.page.locator(".cell:visible").count() == 6
    assert tab.page.get_by_test_id("which").inner_text() == "1 to 5 of 15"
    for side in ("view", "back"):
        assert drawn_share(tab.page.get_by_test_id(f"{side}-1").screenshot()) > 0.1
    box = tab.page.get_by_test_id("back-2").bounding_box()
    tab.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    (behind,) = marked(tab, 0)
    depths = (
        f"(c => [c.view, c.back].map(v => v.project(Array.from(c.positions.slice({3 * behind}, {3 * behind + 3})))[2]))"
    )
    front, back = tab.page.evaluate(f"{depths}(window.shapespaceCells[2])")
    assert front > 0 > back, "the click was on the side that the front view does not show"
    tab.until(f"{PANE}.shadowRoot.querySelector('[data-testid=faults-fold]')?.innerText.includes('{FOLDED}')")
    worst = tab.page.get_by_test_id("faults-fold").get_by_role("button").first
    assert FOLDED in worst.inner_text() and "folded triangle" in worst.inner_text()
    worst.click()
    vertex = marked(tab, 0)[-1]
    assert vertex != behind and all(marked(tab, k)[-1] == vertex for k in range(6))
    place = f"Array.from(c.positions.slice({3 * vertex}, {3 * vertex + 3}))"
    facing = tab.page.evaluate(f"(c => c.view.project({place})[2])(window.shapespaceCells[0])")
    assert facing < 0, "it lies on the side that is shown"
    for colour in ("growth", "distance"):
        before = tab.page.get_by_test_id("view-1").screenshot()
        tab.page.get_by_test_id(f"colour-{colour}").click()
        tab.page.wait_for_timeout(700)
        assert change(before, tab.page.get_by_test_id("view-1").screenshot()) > 0.01
    tab.shot("worst")
    assert tab.complaints == [] and tab.asked == []


def test_a_mark_that_is_dragged_on_one_surface_moves_on_all_and_nothing_turns(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    click(tab, 1, 0.5, 0.5)
    (before,) = marked(tab, 1)
    box = tab.page.get_by_test_id("view-1").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    place = "window.shapespaceCells[1].view.project([30, 0, 0])"
    stands = tab.page.evaluate(place)
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x + box["width"] / 6, y, steps=4)
    tab.page.mouse.up()
    (after,) = marked(tab, 1)
    assert after != before and all(marked(tab, k) == [after] for k in range(12)) and tab.page.evaluate(place) == stands
    tab.page.mouse.move(x, y - box["height"] / 5)
    tab.page.mouse.down()
    tab.page.mouse.move(x + box["width"] / 6, y - box["height"] / 5, steps=4)
    tab.page.mouse.up()
    assert marked(tab, 1) == [after] and tab.page.evaluate(place) != stands  # beside a mark the surface turns
    assert tab.complaints == []


def test_a_vertex_that_a_scan_does_not_show_is_told_and_not_marked_there(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    gone = tab.page.evaluate(
        "name => { const c = window.shapespaceCells.find(c => c.name.textContent === name);"
        "return [window.shapespaceCells.indexOf(c), c.positions.findIndex(Number.isNaN) / 3]; }",
        HIDDEN,
    )
    cell, vertex = gone[0], int(gone[1])
    tab.page.get_by_test_id("number").fill(str(vertex))
    tab.page.get_by_test_id("number").press("Enter")
    assert "shown by 14 of 15 scans" in tab.page.get_by_test_id(f"marked-{vertex}").inner_text()
    assert marked(tab, cell) == [] and marked(tab, 0) == [vertex]
    assert tab.page.get_by_test_id(f"note-{cell}").inner_text() == f"{vertex} not shown"
    tab.page.get_by_test_id("colour-missing").click()
    assert "Scans that do not show the vertex" in tab.page.get_by_test_id("colour-bar").inner_text()
    with tab.page.expect_download() as saved:
        tab.page.get_by_test_id("save").click()
    rows = list(csv.DictReader(Path(saved.value.path()).read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 15 and [row["scan"] for row in rows if not row["x"]] == [HIDDEN]
    assert tab.complaints == []


def test_pages_filters_and_numbers_that_are_no_vertex(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    tab.page.get_by_test_id("number").fill("5")
    tab.page.get_by_test_id("mark").click()
    tab.page.get_by_test_id("next").click()
    tab.until(f"{PANE}.shadowRoot.getElementById('which').textContent === '12 to 15 of 15'")
    tab.until("window.shapespaceCells[4].name.textContent === 'more08'")
    assert tab.page.locator(".cell:visible").count() == 5
    assert marked(tab, 4) == [5], "marks stay from page to page"
    held = tab.page.evaluate("window.shapespaceCells.filter(c => c.view.has('surface')).length")
    assert held == 5, "what is not shown is not held"
    tab.page.get_by_test_id("filter").fill("not a name")
    assert tab.page.get_by_test_id("which").inner_text() == "No scan"
    tab.page.get_by_test_id("filter").fill("stranger")
    assert "excluded" in tab.page.get_by_test_id("list").inner_text()
    tab.page.get_by_test_id("filter").fill("able")
    tab.until(f"{PANE}.shadowRoot.getElementById('which').textContent === '1 to 1 of 1'")
    tab.page.get_by_test_id("number").fill("600")
    tab.page.get_by_test_id("mark").click()
    assert "The vertices have the numbers 0 to 599" in tab.page.get_by_test_id("message").inner_text()
    assert tab.complaints == []


def test_all_surfaces_turn_together(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    box = tab.page.get_by_test_id("view-3").bounding_box()
    tab.page.mouse.move(box["x"] + 60, box["y"] + 80)
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + 140, box["y"] + 80, steps=4)
    tab.page.mouse.up()
    yaw = "window.shapespaceCells.map(c => c.view.camera.yaw)"
    turned = tab.page.evaluate(yaw)
    assert abs(turned[0]) > 0.2 and len(set(turned)) == 1
    assert not any(marked(tab, k) for k in range(12)), "a drag marks nothing"
    tab.page.get_by_test_id("front").click()
    assert set(tab.page.evaluate(yaw)) == {0}


@pytest.mark.parametrize(("viewport", "scheme"), ONE_WINDOW)
def test_every_figure_of_the_report_is_drawn(open_tab, same: Path, viewport: dict, scheme: str) -> None:
    page = same.parent / "report.html"
    if not page.exists():
        assert main(["report", str(same), "-o", str(page), "--no-open", "--quiet"]) == 0
    tab = open_tab(page.as_uri(), viewport, scheme)
    tab.page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    images = tab.page.locator("figure img, .card img")
    assert images.count() >= 5 + 16
    for k in range(images.count()):
        image = images.nth(k)
        image.scroll_into_view_if_needed()
        assert image.evaluate("i => i.decode().then(() => i.naturalWidth)") > 0
        assert drawn_share(image.screenshot()) > 0.02, image.get_attribute("alt")
    tab.shot(f"{viewport['width']}-{scheme}", full_page=True)
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "it scrolls sideways"
    assert tab.complaints == [] and tab.asked == []
