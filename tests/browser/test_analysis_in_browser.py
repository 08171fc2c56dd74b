"""The report of an analysis as a reader meets it: the morph moves by its slider, and is two stills without WebGL."""

from pathlib import Path

import numpy as np
import pytest
from pages import DESKTOP, PHONE
from pictures import change, drawn_share

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.pages.write_html import write_report
from shapespace.schemas import Counts as CountsOf
from shapespace.schemas import HistogramPart, MorphPart, SurfaceMapPart
from synthetic_shapes import blob, sphere

EVIL = "</script><script>window.wicked = true</script>"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    d, faces = sphere(500)
    low, high = (blob(d, np.full(5, side)) for side in (-2.0, 2.0))
    parts = (
        SurfaceMapPart(title="Where", arrays="a.npz"),
        MorphPart(title="Morph", arrays="a.npz", low_label=f"young {EVIL}", high_label="old"),
        HistogramPart(title="Spread", edges=(0.0, 1.0, 2.0), series=(CountsOf(counts=(1.0, 2.0)),)),
    )
    arrays = {"vertices": low, "faces": faces, "values": low[:, 1], "low": low, "high": high}
    folder = tmp_path_factory.mktemp("analysis")
    AnalysisReport("compare", "An analysis", ("They differ.",), parts, arrays={"a.npz": arrays}).save(folder)
    return write_report(folder)


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_a_morph_moves_from_one_shape_to_the_other_and_back(open_tab, report: Path, viewport: dict) -> None:
    tab = open_tab(report.as_uri(), viewport)
    widget = tab.page.locator("figure.turning .widget")
    widget.scroll_into_view_if_needed()
    canvas = widget.locator("canvas").first
    canvas.wait_for(state="visible")
    tab.until("!!document.querySelector('.turning.running')")
    slider = widget.locator("input[type=range]")
    assert slider.get_attribute("aria-valuetext") == f"young {EVIL}"
    tab.page.wait_for_timeout(300)
    low = canvas.screenshot()
    assert drawn_share(low) > 0.02
    widget.get_by_role("button", name="old", exact=True).click()
    tab.page.wait_for_timeout(300)
    high = canvas.screenshot()
    assert slider.get_attribute("aria-valuetext") == "old" and change(low, high) > 0.005
    slider.press("Home")
    tab.page.wait_for_timeout(300)
    assert change(low, canvas.screenshot()) < 0.002
    widget.get_by_role("checkbox").check()
    tab.page.wait_for_timeout(300)
    assert change(low, canvas.screenshot()) > 0.02 and widget.locator(".ss-bar").is_visible()
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "it scrolls sideways"
    assert tab.complaints == [] and tab.asked == [] and not tab.page.evaluate("window.wicked === true")


def test_a_morph_along_a_number_shows_its_value_and_the_shape_there(open_tab, tmp_path: Path) -> None:
    """The shape bulges in the middle of the way, and is the same at both ends."""
    d, faces = sphere(500)
    low, high = (blob(d, np.full(5, side)) for side in (-2.0, 2.0))
    arrays = {"low": low, "high": low, "faces": faces, "modes": (high - low)[None],
              "weights": np.array([[0.0], [1.0], [0.0]])}  # fmt: skip
    part = MorphPart(title="Growth", arrays="a.npz", low_label="age 20", high_label="age 60", modes="modes",
                     weights="weights", variable="age", range=(20.0, 60.0))  # fmt: skip
    AnalysisReport("regress", "Shape along age", ("It grows.",), (part,), arrays={"a.npz": arrays}).save(tmp_path)
    tab = open_tab(write_report(tmp_path).as_uri(), DESKTOP)
    widget = tab.page.locator("figure.turning .widget")
    widget.scroll_into_view_if_needed()
    canvas = widget.locator("canvas").first
    canvas.wait_for(state="visible")
    tab.until("!!document.querySelector('.turning.running')")
    slider, pictures = widget.locator("input[type=range]"), {}
    for value, label in ((-1, "age 20"), (0, "age 40"), (0.5, "age 50"), (1, "age 60")):
        slider.evaluate("(e, value) => { e.value = value; e.dispatchEvent(new Event('input')); }", value)
        tab.page.wait_for_timeout(300)
        assert slider.get_attribute("aria-valuetext") == label
        pictures[value] = canvas.screenshot()
    assert change(pictures[-1], pictures[1]) < 0.002 < 0.005 < change(pictures[-1], pictures[0])
    assert change(pictures[0], pictures[0.5]) > 0.002 and tab.complaints == []


def test_without_a_script_both_shapes_are_stills(open_tab, report: Path) -> None:
    tab = open_tab(report.as_uri(), java_script_enabled=False)
    poster = tab.page.locator("figure.turning .poster img")
    poster.scroll_into_view_if_needed()
    assert poster.is_visible() and drawn_share(poster.screenshot()) > 0.05
    assert "The still shows both" in tab.page.locator("figure.turning figcaption").inner_text()
