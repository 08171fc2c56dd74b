"""The documentation site: nothing is left out of it, and what it draws is in the documents. `make docs` builds it."""

import math
import re
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "site"))

import site_plots  # noqa: E402
import site_text  # noqa: E402


def text_of(document: str) -> str:
    return (ROOT / f"{document}.md").read_text("utf-8")


def test_the_navigation_has_every_document_once_and_no_other() -> None:
    found = site_text.documents(ROOT)
    counts = Counter(page for pages in site_text.navigation(found).values() for page in pages)
    assert set(counts) == set(found) - {site_text.FIRST}
    assert set(counts.values()) == {1}
    assert all((ROOT / f"{page}.md").is_file() for page in counts)


def test_a_new_document_falls_into_the_navigation() -> None:
    chosen = site_text.navigation([*site_text.documents(ROOT), "docs/howto-new", "docs/new"])
    assert "docs/howto-new" in chosen["How-to: fits"]
    assert chosen[site_text.LATER][-1] == "docs/new"


def test_the_first_page_leads_to_every_page_but_those_on_development() -> None:
    chosen = site_text.navigation(site_text.documents(ROOT))
    links = set(re.findall(r"\]\(([\w-]+)\.md", text_of(site_text.FIRST)))
    wanted = {Path(page).name for caption, pages in chosen.items() if caption != "Development" for page in pages}
    assert wanted <= links


def test_every_public_name_is_in_the_reference() -> None:
    text = site_text.reference(text_of("docs/api"))
    shown = re.findall(r"^\.\. auto\w+:: shapespace\.(?:[\w.]+\.)?(\w+)(?:\(\.\.\.\))?$", text, re.MULTILINE)
    assert sorted(shown) == sorted(site_text.HOMES)


def test_a_name_that_the_reference_does_not_list_comes_at_its_end() -> None:
    without = re.sub(r"^- `fit_scan`:.*\n", "", text_of("docs/api"), flags=re.MULTILINE)
    assert "fit_scan" in site_text.reference(without).partition("## Others")[2]


def test_a_name_that_is_not_public_is_refused() -> None:
    with pytest.raises(AttributeError):
        site_text.reference("- `nonsense`: is not there\n")


@pytest.mark.parametrize("plot", site_plots.PLOTS, ids=lambda plot: plot.name)
def test_plots_show_the_numbers_of_their_tables(plot: site_plots.Plot) -> None:
    rows = site_plots.table(text_of(plot.document), plot.heading)
    figure = pytest.importorskip("matplotlib.figure", reason="the extra `report` is not installed")
    axes = figure.Figure().add_subplot()
    plot.draw(rows, axes)
    drawn = [x for points in axes.collections for x, _ in points.get_offsets()] + [
        bar.get_width() for bar in axes.patches
    ]
    written = {float(n) for row in rows[1:] for cell in row for n in re.findall(r"\d+\.\d+|\d+", cell)}
    assert len(drawn) >= len(axes.get_yticks()) > 3
    assert all(any(math.isclose(x, n) for n in written) for x in drawn if not math.isnan(x))
    assert not all(math.isnan(x) for x in drawn)


@pytest.mark.parametrize("plot", site_plots.PLOTS, ids=lambda plot: plot.name)
def test_plots_stand_below_their_headings(plot: site_plots.Plot) -> None:
    for document, heading in plot.shown_in:
        text = site_plots.add(document, text_of(document))
        assert f"{plot.name}-dark.svg" in site_plots.section(text, heading)[0]
