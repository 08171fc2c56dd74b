"""The report of very many fits: what it tells of all, whom it names, what it leaves out, and how large it gets."""

import datetime
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from report_page import Page

from shapespace.batch.store import Store
from shapespace.errors import InputError
from shapespace.report import figures
from shapespace.report.inputs import fit_population as population
from shapespace.report.inputs.fit_population import ListedColumn, Population
from shapespace.report.pages import folder_page as many_page
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, write_report
from shapespace.store.results import Results
from shapespace.viewer import model_view
from shapespace.viewer.model_view import ModelView
from stored_fits import model, record, write_fit

pytest.importorskip("pyarrow", reason="the extra `store` is not installed")
pytest.importorskip("zarr", reason="the extra `store` is not installed")

COUNT, SITES = 160, ("Leeds", "Lima", "Oslo")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fits of three sites over two years, of which one scans worse; two fits lie far from all others."""
    root = tmp_path_factory.mktemp("many") / "out"
    for k in range(COUNT):
        site = SITES[k % 3]
        day = datetime.date(2022, 1, 1) + datetime.timedelta(days=4 * k)
        known = {"site": site, "scanned": day.isoformat(), "person": f"p{k}"}
        told = record("x", k)
        error = 0.5 + 0.001 * (k % 7) + (0.4 if site == "Lima" else 0.0)
        evidence = told["evidence"] | {"expected_error_mm": error}
        z = (np.array(told["z"]) * (9 if k in (31, 77) else 1)).tolist()
        status = "failed" if k % 20 == 19 else "doubtful" if k % 20 == 18 else "converged"
        reason = f"scan{k:03d}.ply has {k} points; scan it again." if status == "failed" else f"It is {k} mm off."
        more = {} if status == "failed" else {"evidence": evidence, "z": z}
        write_fit(root, f"scan{k:03d}", k, status=status, metadata=known, reason=reason, **more)
    model().save(root.parent / "model.h5")
    assert Store(root).compact(rows=100).left == {}
    return root


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take what is in the folder for very many."""
    monkeypatch.setattr(many_page, "MOST_STORED", 100)
    monkeypatch.setattr(many_page, "WORST", {"failed": 3, "doubtful": 4, "max_iterations": 2, "converged": 5})
    monkeypatch.setattr(many_page, "_FARTHEST", 3)


@pytest.fixture(scope="module")
def people(folder: Path) -> Population:
    return Population(Results(folder))


def test_the_page_tells_of_all_and_shows_some(folder: Path, few: None, sketched: None, tmp_path: Path) -> None:
    path = write_report(folder, tmp_path / "r.html")
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.headings[0] == "160 fits in out"
    wanted = ["Summary", "Fits to look at", "Distributions", "Farthest from the mean", "Time and site"]
    at = [page.headings.index(heading) for heading in wanted]
    assert at == sorted(at) and 'class="broken"' not in text
    assert path.stat().st_size < LARGEST_REPORT_BYTES
    for told in (
        "site Lima: The expected error is larger",
        "… has … points; scan it again.",
        "scan031",
        "scan077",
        "Of 160 fits these",
    ):
        assert told in text
    assert "site Oslo" not in text and "Not shown: person." in text
    # Of the other fits, none is named.
    named = {name for name in Results(folder).names() if name in text}
    assert len(named) <= 3 + 4 + 5 + 3


def test_a_store_that_is_not_large_is_reported_as_any_folder(folder: Path, sketched: None, tmp_path: Path) -> None:
    text = write_report(folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Every fit in numbers" in Page(text).headings and all(name in text for name in Results(folder).names())


def test_a_damaged_shard_is_told_and_the_rest_reported(
    folder: Path, few: None, sketched: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_page, "MOST_STORED", 50)
    shutil.copytree(folder, tmp_path / "out")
    model().save(tmp_path / "model.h5")
    (table,) = (tmp_path / "out" / "table").glob("00001-*")
    table.write_bytes(table.read_bytes()[:-5])
    text = write_report(tmp_path / "out", tmp_path / "r.html").read_text(encoding="utf-8")
    assert Page(text).headings[0] == "100 fits in out" and table.name in text
    assert str(tmp_path) not in text


def test_columns_are_times_levels_or_left_out(people: Population) -> None:
    assert {column.name: column.kind for column in people.listed} == {"scanned": "time", "site": "level"}
    assert people.left_out == ["person"]
    assert next(column for column in people.listed if column.kind == "level").levels == SITES


def test_a_site_that_differs_stands_out_and_the_others_do_not(people: Population) -> None:
    site = next(column for column in people.listed if column.name == "site")
    groups = {group.name: group for group in people.compared(site)}
    assert groups["Lima"].error_off_mm == pytest.approx(0.4, abs=0.02)
    assert any("expected error is larger" in told for told in groups["Lima"].stands_out)
    assert sum(group.count for group in groups.values()) == COUNT


def test_chance_alone_does_not_stand_out() -> None:
    """Of 40 groups that do not differ, none is named."""
    rng = np.random.default_rng(3)
    one = object.__new__(Population)
    one.status = np.full(20_000, population._code("converged"), dtype=np.uint8)
    one.measures = {"expected_error_mm": rng.lognormal(0, 0.4, 20_000)}
    one.z = rng.normal(0, 1, (20_000, 5)).astype(np.float32)
    codes = rng.integers(40, size=20_000).astype(np.int32)
    column = ListedColumn("site", "level", np.zeros(0), codes, tuple(map(str, range(40))))
    assert [group.stands_out for group in one.compared(column) if group.stands_out] == []


def test_whole_numbers_are_parted_at_whole_numbers() -> None:
    values = np.repeat(np.arange(18.0, 90.0), 50)
    column = ListedColumn("age", "number", values, np.zeros(len(values), dtype=np.int32))
    counts = [int(inside.sum()) for _, inside, _ in column.groups()]
    assert sum(counts) == len(values) and set(counts) == {100}


def test_single_files_are_told_of_as_those_of_a_store(folder: Path, people: Population, tmp_path: Path) -> None:
    from shapespace.commands.export import export

    export(folder, [], tmp_path / "single", every=True, table=None, quiet=True, say=pytest.fail)
    single = Population(Results(tmp_path / "single"))
    assert single.counts == people.counts and sorted(single.names) == sorted(people.names)
    assert single.n_reasons == people.n_reasons
    assert single.median("to_scan_mm") == people.median("to_scan_mm")


def test_a_folder_of_single_files_keeps_its_report(folder: Path, tmp_path: Path) -> None:
    assert not many_page.is_many(Results(folder))
    assert many_page.MOST_SINGLE == 10_000


def test_the_viewer_lists_the_fits_of_a_store(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    every = ModelView.open(folder)
    assert len(every.fit_list()) == COUNT
    assert every.fitted_mesh("scan001").vertices.shape == model().mesh().vertices.shape
    monkeypatch.setattr(model_view, "MAX_LISTED", 20)
    rows = ModelView.open(folder).fit_list()
    assert len(rows) == 20
    assert [row["status"] for row in rows] == ["failed"] * 8 + ["doubtful"] * 8 + ["converged"] * 4
    assert all(row["expected_error_mm"] > 0.9 for row in rows[16:])
    assert json.dumps(rows)


def test_the_figures_show_what_they_are_given(people: Population) -> None:
    site, scanned = sorted(people.listed, key=lambda column: column.kind)
    trusted, far = people.trusted, people.far()
    groups = [(name, inside) for name, inside, _ in site.groups()]
    drawn = [
        figures.distributions_figure(people.measures, trusted, title="d"),
        figures.coefficients_spread(people.z[trusted], title="c"),
        figures.density_figure(people.z[trusted], far[trusted], title="z"),
        figures.levels_figure(groups, people.measures["expected_error_mm"], words="mm", title="l"),
        figures.over_time_figure(
            scanned.values,
            scanned.edges(),
            dict(people.measures),
            ~trusted,
            is_time=True,
            name="t",
            title="t",
            lines=groups,
        ),
    ]
    bars = drawn[0].axes[0].patches
    assert sum(bar.get_height() for bar in bars) == np.isfinite(people.measures["expected_error_mm"]).sum()
    assert drawn[1].axes[0].lines[0].get_ydata() == pytest.approx(np.median(people.z[trusted], axis=0))
    at = [line.get_xdata()[0] for line in drawn[3].axes[0].lines if line.get_marker() == "o"]
    assert int(np.argmax(at)) == SITES.index("Lima")
    assert all(len(figures.encode_webp(figure)[0]) > 1000 for figure in drawn)


def test_figures_of_nothing_are_refused() -> None:
    none, no_z = np.full(3, np.nan), np.zeros((3, 0))
    for make in (
        lambda: figures.distributions_figure({"a": none}, none > 0, title="d"),
        lambda: figures.coefficients_spread(no_z, title="c"),
        lambda: figures.density_figure(no_z, none, title="z"),
        lambda: figures.levels_figure([("a", none > 0)], none, words="mm", title="l"),
        lambda: figures.over_time_figure(none, none, {"a": none}, none > 0, is_time=False, name="t", title="t"),
    ):
        with pytest.raises(InputError):
            make()
