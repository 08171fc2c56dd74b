"""The morphospace as a reader meets it: names on hover, a click or a key draws another shape, and a legend hides."""

from pathlib import Path

import numpy as np
import pytest
from pages import DESKTOP, PHONE
from pictures import change, drawn_share

from shapespace.cohort.cohort import Cohort
from shapespace.report.analyses.morphospace_report import morphospace_report
from shapespace.report.pages.write_html import write_report
from shapespace.statistics.shape_tests.ordination import ordinate
from synthetic_shapes import blob, sphere

EVIL = "</script><script>window.wicked = true</script>"


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {kind: write_page(kind, tmp_path_factory.mktemp(kind)) for kind in ("surfaces", "planar")}


def write_page(kind: str, folder: Path) -> Path:
    rng, n, faces = np.random.default_rng(4), 24, None
    kinds, spread = ["short", EVIL] * (n // 2), np.array([2.0, 1.0, 1.0, 1.0, 1.0])
    if kind == "surfaces":
        directions, faces = sphere(300)
        shapes = np.stack([blob(directions, spread * rng.normal(0, 1, 5)) for _ in range(n)])
    else:
        shapes = np.zeros((n, 9, 3))
        shapes[:, :, :2] = rng.normal(size=(9, 2)) + 0.15 * rng.normal(size=(n, 9, 2))
    names = [f"shape {k}" for k in range(n)]
    cohort = Cohort.of_shapes(shapes, {"kind": kinds}, names=names, faces=faces)
    morphospace_report(ordinate(cohort, method="between-groups", group=("kind",))).save(folder)
    return write_report(folder)


def opened(open_tab, report: Path, viewport: dict, scheme: str = "light"):
    """Return the tab and its widget."""
    tab = open_tab(report.as_uri(), viewport, scheme)
    widget = tab.page.locator("figure.turning .widget")
    widget.scroll_into_view_if_needed()
    tab.until("!!document.querySelector('.turning.running')")
    settled(tab, "Marker at bgPC1")
    return tab, widget


def settled(tab, words: str, *, absent: str = "nothing") -> None:
    """Wait until the marker rests, which the widget announces after it has drawn the shape."""
    announced = "document.querySelector('.widget [aria-live]').innerText"
    tab.until(f"{announced}.includes({words!r}) && !{announced}.includes({absent!r})")
    tab.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    tab.until("[...window.Shapespace.sceneParts.views].every((view) => view.rests)")


def place_of(tab, widget, shape: int) -> dict[str, float]:
    """Return the place of a shape in the canvas, by the scores that the select moves the marker to."""
    widget.locator("select").nth(2).select_option(str(shape))
    settled(tab, f"the place of shape {shape}:")
    box, marker = widget.locator(".ss-plot canvas").bounding_box(), widget.locator(".ss-marker").bounding_box()
    return {"x": marker["x"] + marker["width"] / 2 - box["x"], "y": marker["y"] + marker["height"] / 2 - box["y"]}


WINDOWS = [("surfaces", DESKTOP, "light"), ("planar", PHONE, "dark")]


@pytest.mark.parametrize(("kind", "viewport", "scheme"), WINDOWS, ids=["desktop", "phone"])
def test_a_click_or_a_key_draws_the_shape_at_another_place(
    open_tab, reports: dict[str, Path], kind: str, viewport: dict, scheme: str
) -> None:
    tab, widget = opened(open_tab, reports[kind], viewport, scheme)
    canvas, shape = widget.locator(".ss-plot canvas"), widget.locator(".ss-shapes .ss-plate").first
    said = widget.locator("[aria-live]")
    assert "24 shapes on bgPC1" in (canvas.get_attribute("aria-label") or "")
    mean = shape.screenshot()
    assert drawn_share(mean) > 0.01 and drawn_share(canvas.screenshot()) > 0.01
    at = place_of(tab, widget, 3)
    named = shape.screenshot()
    assert change(mean, named) > 0.002
    widget.locator("select").nth(2).select_option("")
    settled(tab, "Marker at", absent="place of")
    assert change(mean, shape.screenshot()) < 0.002
    canvas.hover(position=at)
    tab.page.wait_for_timeout(200)
    assert widget.locator(".ss-tip").inner_text() == f"shape 3: {EVIL}"
    canvas.click(position=at)
    settled(tab, "the place of shape 3:")
    assert change(named, shape.screenshot()) < 0.01
    for _ in range(4):
        canvas.press("ArrowLeft")
    settled(tab, "Marker at", absent="place of")
    moved = said.inner_text()
    assert change(named, shape.screenshot()) > 0.002
    canvas.press("Home")
    settled(tab, "Marker at", absent=moved)
    assert change(mean, shape.screenshot()) < 0.002
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "it scrolls sideways"
    tab.shot(kind)
    assert tab.complaints == [] and tab.asked == [] and not tab.page.evaluate("window.wicked === true")


def test_the_legend_hides_a_group_and_axes_can_be_chosen(open_tab, reports: dict[str, Path]) -> None:
    tab, widget = opened(open_tab, reports["planar"], DESKTOP)
    canvas, toggle = widget.locator(".ss-plot canvas"), widget.get_by_role("button", name="short", exact=True)
    before, at = canvas.screenshot(), place_of(tab, widget, 0)
    toggle.click()
    assert toggle.get_attribute("aria-pressed") == "false"
    canvas.hover(position=at)
    tab.page.wait_for_timeout(100)
    assert widget.locator(".ss-tip").is_hidden() or "short" not in widget.locator(".ss-tip").inner_text()
    toggle.click()
    for name in ("Convex hulls", "95 % ellipses", "Leave-one-out scores"):
        box, picture = widget.get_by_role("checkbox", name=name), canvas.screenshot()
        box.click()
        tab.page.wait_for_timeout(100)
        assert change(picture, canvas.screenshot()) > 0.001, name
        box.click()
    widget.get_by_label("Across").select_option("1")
    settled(tab, "residual PC1")
    assert change(before, canvas.screenshot()) > 0.01
    assert (canvas.get_attribute("aria-label") or "").startswith("24 shapes on residual PC1")
    assert tab.complaints == []


def test_without_a_script_the_still_is_seen(open_tab, reports: dict[str, Path]) -> None:
    tab = open_tab(reports["surfaces"].as_uri(), java_script_enabled=False)
    poster = tab.page.locator("figure.turning .poster img")
    poster.scroll_into_view_if_needed()
    assert poster.is_visible() and drawn_share(poster.screenshot()) > 0.05


def test_a_line_around_shapes_selects_them_and_the_list_selects_by_keyboard(open_tab, reports: dict[str, Path]) -> None:
    tab, widget = opened(open_tab, reports["planar"], DESKTOP)
    places = {shape: place_of(tab, widget, shape) for shape in (2, 3)}
    chosen = widget.get_by_role("status")
    widget.get_by_role("button", name="Select", exact=True).click()
    box = widget.locator(".ss-plot canvas").bounding_box()

    def around(shape: int) -> None:
        x, y = box["x"] + places[shape]["x"], box["y"] + places[shape]["y"]
        tab.page.mouse.move(x - 4, y - 4)
        tab.page.mouse.down()
        for dx, dy in ((4, -4), (4, 4), (-4, 4)):
            tab.page.mouse.move(x + dx, y + dy, steps=2)
        tab.page.mouse.up()

    around(2)
    assert "shape 2" in chosen.inner_text()
    around(3)
    assert "shape 3" in chosen.inner_text() and "shape 2" not in chosen.inner_text()
    tab.page.keyboard.down("Shift")
    around(2)
    tab.page.keyboard.up("Shift")
    assert {"shape 2", "shape 3"} <= set(chosen.inner_text().partition(": ")[2].split(", "))
    widget.get_by_role("button", name="Clear selection").click()
    assert chosen.inner_text() == ""
    widget.locator("select").nth(2).select_option("7")
    widget.get_by_role("button", name="Select this shape").press("Enter")
    assert chosen.inner_text() == "1 selected: shape 7"
    tab.shot("selected")
    assert tab.complaints == []
