"""The report on a correspondence: what it says first, why a scan is to be looked at, and what damage costs."""

import itertools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from report_page import Page, edit

from same_blobs import ASIDE, EVIL, FAR, FOLDED, HIDDEN, NAMES, VERTICES, mean_blob, surface, write_records, write_same
from shapespace.cohort.cohort import Cohort
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.report.analyses.morphospace_report import morphospace_report
from shapespace.report.figures import analysis_figures as correspondence_figures
from shapespace.report.inputs.correspondence_folder import Corresponded, concerns_of, upright
from shapespace.report.pages import correspondence_page
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, write_report, write_study_report
from shapespace.report.render.renderer import Camera, Layer, render, squares
from shapespace.report.render.thumbnails import checker_layer, checker_places
from shapespace.statistics.shape_tests.ordination import ordinate
from shapespace.types import Mesh
from synthetic_shapes import blob_model, similarity


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_same(tmp_path_factory.mktemp("blobs"))


@pytest.fixture
def same(template: Path, tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    shutil.copytree(template.parent, tmp_path / "work")
    return tmp_path / "work" / "same"


def report(folder: Path, **options: object) -> str:
    return write_report(folder, folder.parent / "r.html", **options).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(template: Path) -> str:
    """Drawn once in full."""
    steps: list[tuple[str, int]] = []
    path = write_report(template, template.parent / "r.html", on_step=lambda *step: steps.append(step))
    assert 0.5 * steps[0][1] <= len(steps) <= 1.5 * steps[0][1]
    return path.read_text(encoding="utf-8")


def test_every_part_is_there_in_order_and_none_is_broken(page: str) -> None:
    assert "could not be made" not in page
    headings = Page(page).headings
    wanted = ["Correspondence of 7 scans in same", "Summary", "The same places on every scan"]
    wanted += ["Distances and missing vertices", "The scans", "Every scan in numbers", "The rounds"]
    at = [headings.index(text) for text in [*wanted, "Settings and hashes"]]
    assert at == sorted(at)
    levels = [int(tag[1]) for tag, _ in Page(page).tags if re.fullmatch("h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_a_report_of_a_study_has_a_chapter_for_each_result(template: Path, tmp_path: Path) -> None:
    blob_model(200, 3).save(tmp_path / "model.h5")
    planar = Cohort.of_shapes(np.random.default_rng(3).normal(size=(6, 5, 3)), {"kind": ["a", "b"] * 3}, unit="")
    answer = morphospace_report(ordinate(planar, group=("kind",)))
    answer.save(tmp_path / "morphospace")
    write_rows(tmp_path / "table.csv", ("specimen", "sex"), [(name, "fm"[k % 2]) for k, name in enumerate(NAMES)])
    results = [template, tmp_path / "model.h5", tmp_path / "morphospace"]
    page = write_study_report(results, tmp_path / "new" / "r.html", specimens=tmp_path / "table.csv").read_text("utf-8")
    assert "This part could not be made" not in page and EVIL not in page
    seen = Page(page)
    chapters = ["Specimens", "Answers", "Correspondence of 7 scans in same", "The same places on every scan"]
    chapters += ["Model in model.h5", answer.title, "Scree plot"]
    at = [seen.headings.index(text) for text in [f"Study of {len(NAMES)} specimens", *chapters]]
    assert at == sorted(at)
    assert all(sentence in seen.words for sentence in answer.summary)
    levels = [int(tag[1]) for tag, _ in seen.tags if re.fullmatch("h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    places = [attributes["id"] for _, attributes in seen.tags if "id" in attributes]
    assert len(set(places)) == len(places) and len(page) < LARGEST_REPORT_BYTES
    with pytest.raises(FileError, match="nothing"):
        write_study_report([template, tmp_path / "nothing"], tmp_path / "r.html")


def test_the_first_sentences_say_whether_to_go_on(page: str) -> None:
    words = Page(page).words
    assert "6 of 7 scans are in correspondence; 3 of them need review; 1 is excluded." in words
    assert "1 scan has folded triangles" in words
    assert "The rounds have not settled: in the last round vertices still moved by 1.2 % of the size" in words


def test_what_stands_out_has_its_reason_and_comes_first(page: str, template: Path) -> None:
    concerns = concerns_of(Corresponded(template))
    assert {name for name, concern in concerns.items() if concern.reasons} == {FAR, FOLDED, HIDDEN}
    assert concerns[FAR].text.startswith("1 % of its points lie farther off than")
    assert "of its triangles are folded over" in concerns[FOLDED].text
    assert "It shows only 76 % of the mean shape" in concerns[HIDDEN].text
    cards = re.findall(r'<li class="card" id="scan-([^"]+)"', page)
    assert cards[0] == ASIDE and set(cards[1:4]) == {FAR, FOLDED, HIDDEN} and len(cards) == 7
    assert all(concern.text in Page(page).words for concern in concerns.values())


def test_scans_that_are_all_alike_bad_are_told_too(same: Path) -> None:
    records = Corresponded(same).corresponding
    write_records(same, [structs.replace(record, folded_share=0.05, covered_share=0.6) for record in records])
    concerns = concerns_of(Corresponded(same))
    assert all("folded over" in c.text and "only 60 % of its points are reached" in c.text for c in concerns.values())


def test_nothing_stands_out_where_nothing_does(tmp_path: Path) -> None:
    folder = write_same(tmp_path, ("able", "baker", "item"), aside=False)
    words = Page(report(folder)).words
    assert "3 of 3 scans are in correspondence and none of them needs review. No triangle is folded over." in words
    assert "In correspondence; needs review" not in words
    assert "excluded" not in words.replace("excluded scans first", "")


def test_a_table_has_every_measure_of_every_scan(page: str) -> None:
    table = page[page.index("Every scan in numbers") :]
    table = table[: table.index("</table>")]
    heads = re.findall(r"<th scope=\"col\"[^>]*>([^<]*)", table)
    for head in ("Mean distance", "95 % within", "99 % within", "Farthest", "Vertices shown, %", "Folded, %"):
        assert head in heads
    assert {"Area change, times", "Moved last, % of size", "CPU seconds"} <= set(heads)
    rows = re.findall(r"<tr><th scope=\"row\".*?</tr>", table, re.DOTALL)
    assert len(rows) == 7
    far = next(row for row in rows if f">{FAR}<" in row)
    cells = re.findall(r"data-value=\"([^\"]*)\"", far)
    assert [float(cell) for cell in cells[1:5]] == [2.0, 5.0, 10.0, 30.0]


def test_missing_vertices_are_counted_over_the_scans_that_can_be_read(template: Path) -> None:
    population = Corresponded(template).population()
    hidden = np.isnan(surface(HIDDEN, 4)[0].vertices).any(axis=1)
    np.testing.assert_array_equal(population.seen_count, np.where(hidden, 5, 6))
    assert population.names == tuple(sorted(NAMES))


def test_a_surface_is_laid_onto_the_mean_shape_with_its_holes(template: Path) -> None:
    at = Corresponded(template)
    placed = at.placed(HIDDEN)
    own = surface(HIDDEN, 4)[0].vertices
    seen = np.isfinite(own).all(axis=1)
    np.testing.assert_array_equal(placed.seen, seen)
    np.testing.assert_allclose(placed.T_scan_mean.apply(placed.vertices)[seen], own[seen], atol=1e-3)
    off = np.linalg.norm(placed.vertices[seen] - at.mean.vertices[seen], axis=1)
    assert off.mean() < 6


def test_no_surface_is_cut_by_the_edge_of_its_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[np.ndarray] = []

    def kept(layer: Layer, **options: object) -> np.ndarray:
        drawn.append(render(layer, **options))
        return drawn[-1]

    monkeypatch.setattr(correspondence_figures, "render", kept)
    mean = mean_blob()
    correspondence_figures.checkerboard_figure(mean, [mean.vertices * [1.0, 1.7, 1.0], mean.vertices * 0.5], ["a", "b"])
    for picture in drawn:
        edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert len(np.unique(edge.reshape(len(edge), -1), axis=0)) == 1  # the background alone


def test_the_checkerboard_is_carried_by_the_vertices() -> None:
    mean = mean_blob()
    places = checker_places(mean)
    assert np.sqrt(np.ptp(places[0]) * np.ptp(places[1])) == pytest.approx(10)
    camera = Camera.framing(mean.vertices)
    before = render(checker_layer(mean, places), camera=camera, size=(90, 90)).astype(int)
    # Turned over in plane, vertices and all: squares go with the vertices and not with the picture.
    turned = mean.with_vertices(mean.vertices * [-1.0, -1.0, 1.0])
    after = render(checker_layer(turned, places), camera=camera, size=(90, 90)).astype(int)
    own = render(checker_layer(turned, checker_places(turned)), camera=camera, size=(90, 90)).astype(int)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 20
    assert np.abs(own - after).max() > 60
    assert np.abs(before.max(axis=2) - before.min(axis=2)).max() > 60


def test_a_long_thin_object_has_squares_across_too() -> None:
    mean = mean_blob()
    thin = checker_places(mean.with_vertices(mean.vertices * [0.1, 1.0, 0.1]))
    assert np.ptp(thin[0]) > 2.5 and 20 < np.ptp(thin[1]) < 41
    with pytest.raises(InputError, match="no extent"):
        checker_places(mean.with_vertices(np.zeros((VERTICES, 3))))


def test_neighbouring_squares_differ() -> None:
    column, row = np.meshgrid(np.arange(-8, 8) + 0.5, np.arange(-8, 8) + 0.5)
    code = squares(column.ravel(), row.ravel()).reshape(16, 16)
    assert (code[:, 1:] != code[:, :-1]).all() and (code[1:] != code[:-1]).all()
    dark = code > 0
    for one, other in ((code[1:, 1:], code[:-1, :-1]), (code[1:, :-1], code[:-1, 1:])):
        both = (one > 0) & (other > 0)
        assert (one[both] != other[both]).all()
    assert (code[2:] != code[:-2])[dark[2:]].all() and (code[:, 2:] != code[:, :-2])[dark[:, 2:]].all()
    assert dark.mean() == 0.5 and set(code[dark]) == {1, 2, 3, 4, 5}


def test_scans_that_stand_alike_are_shown_as_they_stand() -> None:
    mean = mean_blob()
    turn = similarity(5, degrees=100).rotation
    np.testing.assert_allclose(upright(mean, [turn] * 3), turn, atol=1e-9)


def test_otherwise_an_open_surface_is_shown_from_where_it_faces() -> None:
    mean = mean_blob()
    front = mean.vertices[mean.faces].mean(axis=1)[:, 2] > 0
    mask = Mesh(mean.vertices, mean.faces[front])
    turn = similarity(8, degrees=120).rotation
    posed = mask.with_vertices(mask.vertices @ turn.T)
    R = upright(posed)
    assert np.linalg.det(R) == pytest.approx(1)
    back = posed.vertices @ R.T
    assert np.corrcoef(back[:, 2], mean.vertices[:, 2])[0, 1] > 0.9
    assert np.abs(np.corrcoef(back[:, 1], mean.vertices[:, 1])[0, 1]) > 0.9


def test_a_name_or_reason_that_is_a_script_stays_text_and_no_folder_is_told(page: str) -> None:
    assert EVIL not in page and EVIL in Page(page).words
    assert "/home/somebody" not in page and f"as in {ASIDE}.ply" in Page(page).words


def test_every_picture_has_words_and_every_link_a_target(page: str) -> None:
    parsed = Page(page)
    assert len(parsed.images()) >= 7 + 5
    assert all(len(image["alt"] or "") > 10 for image in parsed.images())
    places = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(places) == len(set(places))
    assert {str(attributes["href"])[1:] for tag, attributes in parsed.tags if tag == "a"} <= set(places)


def test_scans_that_moved_leave_the_surface_without_its_scan(same: Path) -> None:
    shutil.rmtree(same.parent / "scans")
    words = Page(report(same)).words
    assert "The picture lacks the scan: the scan is no longer where it was, or has changed." in words
    assert "No picture: the scan is no longer where it was, or has changed." in words


@pytest.mark.parametrize("damage", ["gone", "cut", "other template", "all missing"])
def test_a_surface_that_cannot_be_read_costs_itself_alone(same: Path, damage: str) -> None:
    path = same / "able.corresponding.ply"
    mesh = read_mesh(path)
    if damage == "gone":
        path.unlink()
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:500])
    elif damage == "other template":
        write_mesh(path, Mesh(mesh.vertices, mesh.faces[:-1]))
    else:
        write_mesh(path, mesh.with_vertices(np.full((VERTICES, 3), np.nan)))
    page = report(same)
    words = Page(page).words
    assert "5 of 7 scans are in correspondence" in words and "could not be made" not in page
    assert "Cannot be read" in words and "able.corresponding.ply" in words
    assert str(same) not in page


def test_a_record_that_is_damaged_costs_itself_alone(same: Path) -> None:
    (same / "able.correspond.json").write_text('{"name": 3}')
    shutil.copy(same / "baker.correspond.json", same / "copied.correspond.json")
    page = report(same)
    assert "able.correspond.json is damaged" in Page(page).words
    assert "copied.correspond.json is the record of another scan, baker" in Page(page).words
    assert "5 of 8 scans are in correspondence" in Page(page).words


def test_a_folder_that_is_damaged_as_a_whole_is_one_sentence(same: Path) -> None:
    with pytest.raises(InputError, match="omit --model"):
        write_report(same, model=same / "x.h5")
    mean = same / "template" / "mean.ply"
    kept = mean.read_bytes()
    mean.write_bytes(kept[:300])
    with pytest.raises(FileFormatError, match=r"mean\.ply"):
        write_report(same)
    mean.unlink()
    with pytest.raises(FileError, match=r"mean\.ply"):
        write_report(same)
    mean.write_bytes(kept)
    (same / "correspondence.json").write_text("{}")
    with pytest.raises(FileFormatError, match=r"correspondence\.json is damaged"):
        write_report(same)


def test_a_folder_in_which_all_were_set_aside_is_still_told(same: Path) -> None:
    for name in NAMES:
        edit(same, lambda record: record.update(status="excluded", reason="half missing"), f"{name}.correspond.json")
    page = report(same)
    assert "0 of 7 scans are in correspondence" in Page(page).words and "Half missing." in Page(page).words
    assert "could not be made" not in page


def test_hundreds_of_scans_are_all_in_the_table_and_some_in_pictures(same: Path) -> None:
    record = json.loads((same / "able.correspond.json").read_text())
    for k in range(60):
        name = f"more{k}"
        (same / f"{name}.correspond.json").write_text(json.dumps(record | {"name": name}))
        shutil.copy(same / "able.corresponding.ply", same / f"{name}.corresponding.ply")
    page = report(same)
    assert len(re.findall('<li class="card"', page)) == correspondence_page.MOST_CARDS
    assert "The 24 scans to look at first" in page and page.count(">more5") >= 10
    assert page.count('<tr><th scope="row"') >= 67
    assert "43 other scans have no picture here" in page
    assert len(page) < LARGEST_REPORT_BYTES
    # The worst are on the checkerboards too.
    alt = re.search(r'alt="(The same checkerboard from the front[^"]*)"', page)
    assert alt and FAR in alt[1] and HIDDEN in alt[1]


def test_many_scans_that_were_set_aside_leave_room_for_the_others(same: Path) -> None:
    record = json.loads((same / f"{ASIDE}.correspond.json").read_text())
    for k in range(30):
        (same / f"aside{k}.correspond.json").write_text(json.dumps(record | {"name": f"aside{k}"}))
    page = report(same)
    cards = re.findall(r'<li class="card" id="scan-([^"]+)"', page)
    assert len(cards) == correspondence_page.MOST_CARDS and set(NAMES) <= set(cards)
    assert "Excluded scans: they are not in a model" in page and "The reasons of 34 scans" in page


def test_a_mean_shape_that_lacks_what_scans_show_is_told(same: Path, sketched: None) -> None:
    for name in NAMES:
        edit(same, lambda record: record.update(area_share=0.7), f"{name}.correspond.json")
    assert "its surface is 70 % of the median scan's" in Page(report(same)).words


def test_what_quality_measured_has_its_section(same: Path, worded: None) -> None:
    assert "Quality of the shape space" not in Page(report(same)).headings
    (same / "quality.json").write_text(json.dumps({"compactness": [0.6, 0.9], "sentences": ["Two modes are enough."]}))
    page = Page(report(same))
    assert "Quality of the shape space" in page.headings and "Two modes are enough." in page.words
    (same / "quality.json").write_text(json.dumps({"compactness": "all"}))
    assert "quality.json is damaged" in Page(report(same)).words


def test_holes_of_the_mean_shape_are_told(same: Path, sketched: None) -> None:
    assert "beside its border" not in Page(report(same)).words
    mean = read_mesh(same / "template" / "mean.ply")
    at = [int(mean.vertices[:, axis].argmax()) for axis in (0, 1, 2)]
    faces = mean.faces[~np.isin(mean.faces, at).any(axis=1)]
    for path in (same / "template" / "mean.ply", *same.glob("*.corresponding.ply")):
        write_mesh(path, Mesh(read_mesh(path).vertices, faces))
    assert "The mean shape has 2 holes in addition to its border." in Page(report(same)).words


def test_scans_in_mixed_units_are_compared_by_their_size(same: Path, worded: None) -> None:
    edit(same, lambda record: record.update(scale=0.001), "able.correspond.json")
    assert "The scans are in different units" in Page(report(same)).words


def test_a_layer_of_squares_needs_as_many_places_as_vertices() -> None:
    mean = mean_blob()
    with pytest.raises(InputError, match="shape"):
        Layer(mean, scalars=np.zeros(3), across=np.zeros(VERTICES), colormap=np.ones((2, 3)))
    with pytest.raises(InputError, match="shape"):
        Layer(mean, scalars=np.zeros(VERTICES), across=np.zeros(3), colormap=np.ones((2, 3)))
