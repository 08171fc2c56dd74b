"""The project of the studio: what its edits do, what undo takes back, and what is refused."""

import csv
import filecmp
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cli import main, parser
from shapespace.cli.command_table import summaries_and_options
from shapespace.cli.forms import forms
from shapespace.commands.inputs import given_scans
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.files import make_folder, sha256_of_file
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.io.tables.table_io import table_text
from shapespace.schemas import CorrespondRecord
from shapespace.types import Mesh
from shapespace.viewer.studio.job_commands import QUESTIONS, checks, order, outdated_results
from shapespace.viewer.studio.jobs import Job, Order, history
from shapespace.viewer.studio.project import (
    MatchedBlock,
    PastedBlock,
    Project,
    StaleError,
    cells_of_table,
    change_of,
    with_cells,
)
from synthetic_shapes import training_meshes


def tetrahedron(path: Path, size: float) -> Path:
    corners = size * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    write_mesh(path, Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)))
    return path


@pytest.fixture
def project(tmp_path: Path) -> Project:
    made = Project.open(tmp_path / "teeth", create=True)
    for k, name in enumerate(("anna", "ben", "carl")):
        made.add(tetrahedron(made.new_file(f"{name}.ply"), 1.0 + k), "training")
    return made


DORSAL: dict[str, Any] = {"name": "dorsal", "toward_viewer": [0.0, 0.6, 0.8], "up": [1.0, 0.0, 0.0]}


def edit(project: Project, **request: object) -> None:
    project.edit(project.revision, change_of(request))


def join_table(project: Project, content: bytes) -> None:
    project.edit(None, with_cells(*cells_of_table(content, project.state)[:2]))


def ids(project: Project) -> list[str]:
    return [one.id for one in project.state.specimens]


def test_a_project_that_was_moved_opens_with_its_scans(project: Project, tmp_path: Path) -> None:
    shutil.move(project.folder, tmp_path / "elsewhere")
    moved = Project.open(tmp_path / "elsewhere")
    assert moved.state == project.state
    assert all(moved.path(one).is_file() for one in moved.state.specimens)


def test_undo_takes_every_edit_back_and_redo_applies_it_again(project: Project) -> None:
    states = [project.state]
    for request in (
        {"what": "add-column", "column": "sex"},
        {"what": "add-column", "column": "age"},
        {"what": "cells", "cells": [{"id": "anna", "column": "sex", "value": "f"}]},
        {"what": "include", "ids": ["ben"], "included": False},
        {"what": "set", "ids": ["carl"], "set": "new"},
        {"what": "rename", "id": "carl", "to": "carol"},
        {"what": "landmarks", "landmarks": {"tip": 3}},
        {"what": "views", "on": "correspondence-1", "views": [DORSAL], "before": []},
        {"what": "views", "on": "correspondence-1", "views": [{**DORSAL, "name": "lateral"}], "before": [DORSAL]},
        {"what": "remove", "ids": ["ben"]},
        {"what": "remove-column", "column": "sex"},
    ):
        edit(project, **request)
        states.append(project.state)
    assert len({json.dumps(str(state)) for state in states}) == len(states)
    assert states[-2].columns == ("sex", "age") and states[-1].columns == ("age",)
    for state in reversed(states[:-1]):
        project.undo(project.revision)
        assert project.state == state == Project.open(project.folder).state
    for state in states[1:]:
        project.redo(project.revision)
        assert project.state == state


def test_an_edit_of_a_state_that_another_tab_changed_is_refused(project: Project) -> None:
    seen = project.revision
    edit(project, what="add-column", column="age")
    before = project.state
    with pytest.raises(StaleError, match="Another tab changed the project"):
        project.edit(seen, change_of({"what": "remove", "ids": ["anna"]}))
    with pytest.raises(StaleError):
        project.undo(seen)
    assert project.state == before


@pytest.mark.parametrize(("request_", "message"), [
    ({"what": "cells", "cells": [{"id": "anna", "column": "age", "value": "3"}]}, "no column 'age'"),
    ({"what": "include", "ids": ["nobody"], "included": True}, "no specimen 'nobody'"),
    ({"what": "rename", "id": "anna", "to": "Ben"}, "a specimen Ben already"),
    ({"what": "rename", "id": "anna", "to": "../anna"}, "cannot be called"),
    ({"what": "add-column", "column": "File"}, "cannot be called"),
    ({"what": "landmarks", "landmarks": {"tip": -1}}, "needs a name and a vertex"),
    ({"what": "unit", "ids": ["anna"], "unit": "mile"}, "no unit 'mile'"),
    ({"what": "cells"}, "cannot be read"),
    ({"what": "nonsense"}, "cannot be read"),
    ({"what": "views", "on": "", "views": [{**DORSAL, "name": " "}], "before": []}, "cannot be called"),
    ({"what": "views", "on": "", "views": [DORSAL, DORSAL], "before": []}, "that no other has"),
    ({"what": "views", "on": "", "views": [{**DORSAL, "up": [0.0, 3.0, 4.0]}], "before": []}, "not parallel"),
    ({"what": "views", "on": "", "views": [{**DORSAL, "up": [0.0, 1.0]}], "before": []}, "cannot be read"),
    ({"what": "views", "on": "", "views": []}, "cannot be read"),
    ({"what": "include", "ids": 5}, "cannot be read"),
])  # fmt: skip
def test_an_edit_that_cannot_be_is_refused_in_a_sentence(
    project: Project, request_: dict[str, object], message: str
) -> None:
    before = project.state
    with pytest.raises(InputError, match=message):
        edit(project, **request_)
    assert project.state == before and project.revision == 3


def test_the_same_file_is_added_once_and_the_same_name_twice(project: Project, tmp_path: Path) -> None:
    assert project.add(tetrahedron(tmp_path / "copy.ply", 2.0), "training") == ("ben", "ben")
    assert project.add(tetrahedron(tmp_path / "anna.ply", 7.0), "new") == ("anna-2", None)
    assert ids(project) == ["anna", "ben", "carl", "anna-2"]
    assert project.state.specimens[-1].file == str(tmp_path / "anna.ply")


def test_a_file_that_comes_twice_at_the_same_time_is_called_as_the_user_calls_it(project: Project) -> None:
    first, second = project.new_file("dora.ply"), project.new_file("dora.ply")
    for path in (first, second):
        tetrahedron(path, 9.0)
    assert project.add_stored(second, "training", "dora.ply") == ("dora", None)
    assert project.add_stored(first, "training", "dora.ply") == ("dora", "dora")
    assert not first.exists() and project.path(project.state.specimens[-1]) == second


def test_a_folder_is_imported_by_reference_or_as_copies(project: Project, tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k in range(3):
        tetrahedron(tmp_path / "scans" / f"s{k}.ply", 2.0 + 10 * k)
    added, notes = project.import_files(tmp_path / "scans", "training", copy=True)
    assert added == 2 and notes == ["s0.ply is the same file as ben; it was not added again."]
    assert sorted(path.name for path in (project.folder / "scans").iterdir()) == [
        "anna.ply", "ben.ply", "carl.ply", "s1.ply", "s2.ply",
    ]  # fmt: skip
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="contains no meshes"):
        project.import_files(tmp_path / "empty", "training", copy=False)


def test_thousands_of_scans_of_one_size_are_one_edit_and_take_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, scans, count = Project.open(tmp_path / "many", create=True), make_folder(tmp_path / "scans"), 2000
    for k in range(count):
        (scans / f"s{k:05}.obj").write_text(f"v 0 0 0\nv {1 + 1e-4 * k:.4f} 0 0\nv 0 1 0\nf 1 2 3\n")
    shutil.copyfile(scans / "s00007.obj", scans / "twin.obj")
    calls = {"write": 0, "compare": 0}

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **options: Any) -> Any:
            calls[name] += 1
            return function(*given, **options)

        return call

    monkeypatch.setattr(Project, "_write", counted("write", Project._write))
    monkeypatch.setattr("filecmp.cmp", counted("compare", filecmp.cmp))
    added, notes = project.import_files(scans, "training", copy=False)
    assert (added, len(notes)) == (count, 1) and "twin.obj is the same file as s00007" in notes[0]
    assert calls == {"write": 1, "compare": 1}
    table = "".join(f"s{k:05},{'fm'[k % 2]},{k}\n" for k in range(10_000))
    columns, cells, notes = cells_of_table(f"specimen,sex,age\n{table}".encode(), project.state)
    assert columns == ["sex", "age"] and len(cells) == count and "8000 of 10000 rows" in notes[0]
    project.edit(None, with_cells(columns, cells))
    edit(project, what="cells", cells=[{"id": "s01999", "column": "age", "value": "7", "before": "1999"}])
    assert Project.open(project.folder).state.specimens[-1].cells == {"sex": "m", "age": "7"}
    project.undo(project.revision)
    project.undo(project.revision)
    project.undo(project.revision)
    assert project.state.specimens == ()


def test_a_table_is_joined_by_id_or_file_name_and_may_be_pasted(project: Project) -> None:
    join_table(project, b"file\tsex\tage\nanna.ply\tf\t12\nBEN\tm\t14\nnobody\tm\t1\n")
    assert project.state.columns == ("sex", "age")
    assert [one.cells for one in project.state.specimens] == [{"sex": "f", "age": "12"}, {"sex": "m", "age": "14"}, {}]
    for content, error in (
        (b"x,y\n1,2\n", "needs rows, and a column file or scan"),
        (b"id,y\nz,2\n", "the project contains no specimen of The table"),
        (b"id,sex\nanna,f\nANNA.ply,m\n", r"rows 1 \('anna'\) and 2 \('ANNA.ply'\) are of one specimen;"),
        (b"", "table"),
    ):
        with pytest.raises((InputError, FileFormatError), match=error):
            join_table(project, content)


def match(project: Project, text: str, column: str = "", at: str = "anna") -> MatchedBlock:
    """Match a block as the page sends it: `text` has a line for each row, with tabs."""
    order = ids(project)
    rows = tuple(tuple(line.split("\t")) for line in text.split("\n"))
    return PastedBlock(rows=rows, column=column, order=tuple(order[order.index(at) :])).match(project.state)


@pytest.fixture
def weighed(project: Project) -> Project:
    join_table(project, b"id,sex,weight\nanna,,\nben,,\n")
    return project


RIGHT = {"anna": {"sex": "f", "weight": "3.5"}, "ben": {"sex": "m", "weight": "4"}, "carl": {"sex": "m", "weight": "5"}}


@pytest.mark.parametrize(("text", "column", "at"), [
    ("carl\tm\t5\nanna\tf\t3.5\nben\tm\t4", "", "anna"),
    ("Specimen\tweight\tsex\nCARL.ply\t5\tm\nanna\t3,5\tf\nben\t4\tm", "", "ben"),
    ("weight\tname\tsex\n5\tcarl\tm\n3.5\tanna\tf\n4\tben\tm", "weight", "anna"),
])  # fmt: skip
def test_rows_that_name_their_specimens_go_to_these_from_any_order_and_cell(
    weighed: Project, text: str, column: str, at: str
) -> None:
    matched = match(weighed, text, column, at)
    assert matched.by_name and matched.certain and matched.cells == RIGHT and matched.notes == ()
    edit(weighed, what="block", columns=matched.columns, cells=matched.cells)
    assert {one.id: one.cells for one in weighed.state.specimens} == RIGHT


def test_names_in_a_column_of_values_may_be_values_and_are_shown_before_they_are_used(weighed: Project) -> None:
    matched = match(weighed, "carl\tm\t5\nanna\tf\t3,5\nben\tm\t4", "sex", "carl")
    assert matched.by_name and not matched.certain and matched.cells == RIGHT


def test_a_decimal_comma_in_a_column_of_numbers_is_a_decimal_point(weighed: Project) -> None:
    for name, value in (("anna", "3,5"), ("ben", "-4,25")):
        edit(weighed, what="cells", cells=[{"id": name, "column": "weight", "value": value}])
        edit(weighed, what="cells", cells=[{"id": name, "column": "sex", "value": "x"}])
    edit(weighed, what="cells", cells=[{"id": "carl", "column": "sex", "value": "1,2"}])
    assert [one.cells["weight"] for one in weighed.state.specimens[:2]] == ["3.5", "-4.25"]
    assert weighed.state.specimens[2].cells["sex"] == "1,2"  # among words it is a word
    assert match(weighed, "1,5\n2,5", "weight").cells == {"anna": {"weight": "1.5"}, "ben": {"weight": "2.5"}}


def test_columns_whose_names_have_a_meaning_of_their_own_are_not_taken(project: Project) -> None:
    columns, cells, notes = cells_of_table(b"file,id,log_size,a`b,mass\nanna.ply,M0,1,2,3\n", project.state)
    assert columns == ["mass"] and cells == {"anna": {"mass": "3"}}
    assert any("id, log_size, a`b" in note for note in notes)
    for name in ("id", "log_size", "a`b"):
        with pytest.raises(InputError, match="cannot be called"):
            edit(project, what="add-column", column=name)


def test_a_block_without_names_is_shown_before_it_is_pasted(weighed: Project) -> None:
    matched = match(weighed, "3.5\n4\n\n6", "weight", "anna")
    assert not matched.by_name and not matched.certain
    assert matched.cells == {"anna": {"weight": "3.5"}, "ben": {"weight": "4"}, "carl": {"weight": ""}}
    assert matched.notes == ("1 row is not pasted, beyond the last row of the table.",)
    matched = match(weighed, "f\t3\n\t\nm\t4", "sex", "anna")  # classes with a gap are no names
    assert matched.cells["ben"] == {"sex": "", "weight": ""} and not matched.by_name and matched.notes == ()
    assert match(weighed, "f\t3.5", "sex", "ben").certain  # one row, into the cell that was clicked
    matched = match(weighed, "sex\tweight\nf\t3", "sex", "ben")
    assert matched.cells == {"ben": {"sex": "f", "weight": "3"}} and "headings" in matched.notes[0]
    assert match(weighed, "f\t3\t7\t8", "sex", "ben").notes == (
        "2 columns are not pasted, beyond the last column of the table.",
    )


def test_numbers_that_are_also_names_of_specimens_are_values(tmp_path: Path) -> None:
    project = Project.open(tmp_path / "p", create=True)
    for k in range(1, 4):
        project.add(tetrahedron(project.new_file(f"{k}.ply"), 1.0 + k), "training")
    join_table(project, b"id,age,weight\n1,,\n")
    matched = match(project, "3\t70\n1\t80", "age", "1")
    assert not matched.by_name and matched.cells == {
        "1": {"age": "3", "weight": "70"},
        "2": {"age": "1", "weight": "80"},
    }
    matched = match(project, "3\t70\t80\n1\t71\t81", "", "1")
    assert matched.by_name and matched.cells["3"] == {"age": "70", "weight": "80"}


def test_rows_without_a_specimen_and_new_columns_are_shown_before_a_block_is_pasted(weighed: Project) -> None:
    matched = match(weighed, "anna\tf\nnobody\tm", "sex")
    assert not matched.certain and matched.cells == {"anna": {"sex": "f"}} and "nobody" in matched.notes[0]
    matched = match(weighed, "Skull\tsex\tSite\nben\tm\tnorth\nanna\tf\tsouth\ncarl\tm\tnorth")
    assert matched.by_name and not matched.certain and matched.columns == ("Site",)
    edit(weighed, what="block", columns=matched.columns, cells=matched.cells)
    assert weighed.state.columns == ("sex", "weight", "Site")
    assert weighed.state.specimens[0].cells == {"sex": "f", "weight": "", "Site": "south"}
    weighed.undo(weighed.revision)
    assert weighed.state.columns == ("sex", "weight")
    for text, error in (
        ("anna\tf\nANNA\tm", "are of one specimen"),
        ("x\tf\ny\tm", "contains no specimen of The pasted block"),
        ("f\nm", "paste it into the column"),
    ):
        with pytest.raises((InputError, FileFormatError), match=error):
            match(weighed, text)


def test_cells_that_would_become_empty_are_shown_before_a_block_is_pasted(weighed: Project) -> None:
    edit(weighed, what="cells", cells=[{"id": name, "column": "weight", "value": "7"} for name in ids(weighed)])
    named = match(weighed, "id\tsex\tweight\nanna\tf\tNA\nben\tm\ncarl\tm\tn/a")
    assert named.by_name and not named.certain and named.cells["anna"]["weight"] == named.cells["ben"]["weight"] == ""
    short, missing = named.notes
    assert short == "1 row is shorter than the others: its last cells become empty."
    assert missing == "2 cells are marked as missing (NA, n/a), and will be empty."
    placed = match(weighed, "f\nm\t6\nm\tNA", "sex")
    assert not placed.by_name and placed.cells["anna"] == {"sex": "f", "weight": ""} == {
        **placed.cells["carl"],
        "sex": "f",
    }
    assert [note.split()[1] for note in placed.notes] == ["row", "cell"]
    assert not match(weighed, "f\tNA", "sex", "ben").certain  # also of one row
    assert match(weighed, "id\tsex\tweight\nanna\tf\t\nben\tm\t6\ncarl\tm\t6").certain  # empty in the sheet too


def test_a_group_is_not_written_over_what_another_tab_wrote(weighed: Project) -> None:
    group = [{"id": name, "column": "sex", "value": "f", "before": ""} for name in ("anna", "ben")]
    edit(weighed, what="cells", cells=[{"id": "ben", "column": "sex", "value": "m"}])
    with pytest.raises(StaleError, match="Another tab changed sex of ben to 'm'"):
        edit(weighed, what="cells", cells=group)
    assert [one.cells.get("sex", "") for one in weighed.state.specimens] == ["", "m", ""]


def test_a_cell_that_another_tab_changed_while_it_was_typed_is_not_overwritten(weighed: Project) -> None:
    cell = {"id": "ben", "column": "sex", "value": "m", "before": ""}
    edit(weighed, what="cells", cells=[{**cell, "value": "f"}])
    with pytest.raises(StaleError, match="Another tab changed sex of ben to 'f'"):
        edit(weighed, what="cells", cells=[cell])
    edit(weighed, what="cells", cells=[{**cell, "before": "f"}])
    assert weighed.state.specimens[1].cells["sex"] == "m"


PARTS = ("femur", "tibia")


def knees_project(folder: Path) -> Project:
    """Return a project of three knees, the last without a tibia, whose rows are joined."""
    made = Project.open(folder, create=True)
    for k, name in enumerate(("s1_femur", "s1_tibia", "s2_femur", "s2_tibia", "s3_femur")):
        made.add(tetrahedron(made.new_file(f"{name}.ply"), 1.0 + k), "training")
    edit(made, what="parts", ids=ids(made), parts=["femur ", "tibia"])
    return made


def test_scans_of_parts_are_one_row_of_the_table_and_one_specimen_of_the_commands(tmp_path: Path) -> None:
    project = knees_project(tmp_path / "knees")
    assert ids(project) == ["s1", "s1_tibia", "s2", "s2_tibia", "s3"] and project.state.parts == PARTS
    join_table(project, b"id,sex\ns1,f\ns2,m\ns3,f\n")
    edit(project, what="rename", id="s2", to="bert")
    texts, _ = project.scan_list(project.folder / "inputs" / "0001.csv", project.state.chosen("training"))
    [rows] = [list(csv.DictReader(text.splitlines())) for text in texts.values()]
    listed = sorted(" ".join((row["id"], row["part"], row["sex"])) for row in rows)
    assert listed == ["bert femur m", "bert tibia m", "s1 femur f", "s1 tibia f", "s3 femur f"]
    assert project.table(project.state.chosen("training")).split() == ["specimen,sex", "bert,m", "s1,f", "s3,f"]
    assert project.state.counts() == {"sex": {"f": 2, "m": 1}}
    fits, _ = project.scan_list(project.folder / "inputs" / "0002.csv", project.state.chosen("training"), frozenset())
    assert all("part" not in text.splitlines()[0] for text in fits.values())
    edit(project, what="include", ids=["bert"], included=False)
    assert [one.id for one in project.state.chosen("training")] == ["s1", "s3", "s1_tibia"]
    edit(project, what="remove", ids=["s1"])
    assert ids(project) == ["bert", "s2_tibia", "s3"]
    assert Project.open(project.folder).state == project.state


@pytest.mark.parametrize(
    ("parts", "message"),
    [(["femur"], "two or more parts"), (["femur", "patella"], "s1_tibia ends in none"), ([], "two or more parts")],
)
def test_scans_that_are_of_no_part_are_not_joined(tmp_path: Path, parts: list[str], message: str) -> None:
    project = knees_project(tmp_path / "knees")
    project.undo(project.revision)
    with pytest.raises(InputError, match=message):
        edit(project, what="parts", ids=ids(project), parts=parts)
    project.add(tetrahedron(project.new_file("s1.ply"), 9.0), "training")
    with pytest.raises(InputError, match="There is a specimen s1 already"):
        edit(project, what="parts", ids=["s1_femur", "s1_tibia"], parts=PARTS)


def test_a_study_of_parts_gives_the_parts_to_the_correspondence_and_one_surface_per_specimen_to_the_model(
    tmp_path: Path,
) -> None:
    done = Done(knees_project(tmp_path / "knees"))
    done.run("correspond")
    assert "--parts femur tibia" in " ".join(done.jobs[0].arguments)
    done.run("build")
    assert done.jobs[1].arguments[1] == "correspondence-1"
    done.run("compare", {"--formula": "~ sex"})
    assert (done.project.folder / "inputs" / "0003.csv").read_text().split() == ["specimen", "s1", "s2", "s3"]
    assert not done.outdated
    tetrahedron(done.project.folder / "scans" / "s2_tibia.ply", 20.0)
    assert done.outdated.keys() >= {1, 2}


def test_named_views_that_another_tab_changed_are_not_overwritten(project: Project) -> None:
    views: dict[str, Any] = {"what": "views", "on": "", "views": [DORSAL], "before": []}
    edit(project, **views)
    edit(project, **{**views, "on": "correspondence-1"})
    for before in ([], [{**DORSAL, "up": [-1.0, 0.0, 0.0]}]):
        with pytest.raises(StaleError, match="changed the named views"):
            edit(project, **{**views, "views": [], "before": before})
    edit(project, **{**views, "views": [], "before": [DORSAL]})
    stored = Project.open(project.folder).state.views
    assert stored[""] == () and [view.name for view in stored["correspondence-1"]] == ["dorsal"]


def test_scans_in_another_unit_or_mirrored_are_written_in_mm_for_the_commands(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit(project, what="unit", ids=["anna", "ben"], unit="cm")
    edit(project, what="mirror", ids=["ben"], mirrored=True)
    made = order(project, [], forms(summaries_and_options()), "correspond", {}, None, 1)
    made.write_files(project.folder)
    monkeypatch.chdir(project.folder)
    for words in made.before:
        assert main(list(words)) == 0
    given = given_scans([made.arguments[1]], project.folder / made.output, recursive=False, say=pytest.fail)
    corner = {one.called: read_mesh(one.path).vertices.sum(axis=0) for one in given}
    assert {name: point.tolist() for name, point in corner.items()} == {
        "anna": [10.0, 10.0, 10.0], "ben": [-20.0, 20.0, 20.0], "carl": [3.0, 3.0, 3.0],
    }  # fmt: skip
    lines = [line for line in history([job_of(made)]).splitlines() if line.startswith("run shapespace check")]
    assert len(lines) == 2 and all('"$PROJECT"/scans/' in line and '"$PROJECT"/inputs/' in line for line in lines)


def job_of(made: Order) -> Job:
    return Job(number=1, kind="correspond", arguments=made.arguments, output=made.output, before=made.before,
               status="done")  # fmt: skip


def test_classes_are_counted_and_likely_misspellings_named(project: Project) -> None:
    for k in range(2):
        project.add(tetrahedron(project.new_file(f"more{k}.ply"), 20.0 + k), "training")
    edit(project, what="add-column", column="sex")
    cells = [{"id": name, "column": "sex", "value": "femal" if name == "carl" else "female"} for name in ids(project)]
    edit(project, what="cells", cells=cells)
    assert project.state.counts() == {"sex": {"female": 4, "femal": 1}}
    assert any("'femal'" in note for note in project.state.notes())


@pytest.mark.parametrize("content", ["{", "[]", '{"format": "other"}', '{"format": "shapespace-project"}',
                                     '{"format": "shapespace-project", "format_version": 9, "name": "a"}'])  # fmt: skip
def test_a_damaged_project_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "project.json").write_text(content)
    with pytest.raises((FileFormatError, FileError)):
        Project.open(tmp_path)


def test_a_project_is_not_created_among_other_files(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(InputError, match="is not empty"):
        Project.open(tmp_path, create=True)
    with pytest.raises(FileError, match="contains no project"):
        Project.open(tmp_path)


def test_the_report_of_the_study_has_the_newest_of_each_step_and_each_answer_once(project: Project) -> None:
    def job(number: int, kind: str, output: str, status: str = "done", **more: Any) -> Job:
        return Job(number=number, kind=kind, arguments=(kind,), output=output, status=status, **more)

    sex, age = {"options": {"--formula": "~ sex"}, "on": 1}, {"options": {"--formula": "~ age"}, "on": 1}
    jobs = [
        job(1, "correspond", "correspondence-1"), job(2, "build", "model-2.h5"), job(3, "compare", "compare-3", **sex),
        job(4, "redo", "correspondence-1"), job(5, "build", "model-5.h5"), job(6, "compare", "compare-6", **age),
        job(7, "compare", "compare-7", **sex), job(8, "morphospace", "morphospace-8"),
        job(9, "asymmetry", "asymmetry-9", "failed"), job(10, "report", "report-10/report.html"),
    ]  # fmt: skip
    made = order(project, jobs, forms(summaries_and_options()), "report", {}, None, 11)
    assert made.arguments == (
        "report", "correspondence-1", "model-5.h5", "morphospace-8", "compare-6", "compare-7",
        "--specimens", "inputs/0011.csv", "-o", "report-11/report.html", "--no-open",
    )  # fmt: skip
    with pytest.raises(InputError, match="no results yet"):
        order(project, jobs[-2:], forms(summaries_and_options()), "report", {}, None, 11)


@pytest.mark.parametrize("kind", sorted(forms(summaries_and_options())))
def test_each_action_is_a_command_line_that_the_parser_takes(project: Project, tmp_path: Path, kind: str) -> None:
    for k, name in enumerate(("dora", "emil")):
        project.add(tetrahedron(project.new_file(f"{name}.ply"), 5.0 + k), "new")
    join_table(project, b"id,group,age\nanna,a,1\nben,a,2\ncarl,b,3\ndora,a,4\nemil,b,5\n")
    edit(project, what="points", id="anna", points={"tip": [0, 0, 1]})
    made = (("correspond", "correspondence-1"), ("build", "model-2.h5"), ("fit", "fits-3"), ("compare", "compare-4"))
    done = [
        Job(number=1 + k, kind=one, arguments=(one,), output=output, status="done")
        for k, (one, output) in enumerate(made)
    ]
    chosen = {"column": "group", "class": "group=a", "formula": "~ group"}
    described = forms(summaries_and_options())
    options = {
        one["flag"]: chosen.get(one["kind"]) or (one["choices"] or ["age"])[0]
        for one in described[kind]["options"]
        if one["required"] or one["kind"] in ("class", "formula") or one["flag"] == "--along"
    }
    named = {"surface": {"files": ["scans/mask.nii.gz"]}, "groom": {"ids": ["anna"], "--largest": True}}
    options |= named.get(kind, {})
    ordered = order(project, done, described, kind, options, None, 5)
    arguments = parser().parse_args(ordered.arguments)
    assert callable(arguments.run)
    if kind == "score":
        written = ordered.files
        assert "anna" in written["inputs/0005-reference.csv"] and "carl" not in written["inputs/0005-reference.csv"]
        assert "carl" in written["inputs/0005.csv"] and "anna" not in written["inputs/0005.csv"]


class Done:
    """A project whose jobs all succeed at once."""

    def __init__(self, project: Project) -> None:
        self.project, self.jobs, self.forms = project, list[Job](), forms(summaries_and_options())

    def run(self, kind: str, options: dict[str, str] | None = None, on: int | None = None) -> int:
        number = len(self.jobs) + 1
        made = order(self.project, self.jobs, self.forms, kind, options or {}, on, number, self.scans)
        made.write_files(self.project.folder)
        self.jobs.append(
            Job(number=number, kind=kind, arguments=made.arguments, output=made.output, before=made.before,
                options=options or {}, on=made.on, scans=dict(made.scans), status="done")
        )  # fmt: skip
        if kind == "correspond":
            for name in [one.id for one in self.project.state.specimens if not one.subject]:
                tetrahedron(make_folder(self.project.folder / made.output) / f"{name}{CorrespondRecord.SURFACE}", 1.0)
        return number

    @property
    def scans(self) -> dict[str, str]:
        paths = {each.id: self.project.path(each) for each in self.project.state.specimens}
        return {name: sha256_of_file(path) for name, path in paths.items() if path.is_file()}

    @property
    def outdated(self) -> dict[int, str]:
        return dict(outdated_results(self.project, self.jobs, self.forms, self.scans))


@pytest.fixture
def answered(project: Project) -> Done:
    """Correspondence, model, a comparison of groups, one by age, and the report of the study."""
    join_table(project, b"id,group,age\nanna,a,1\nben,a,2\ncarl,b,3\n")
    done = Done(project)
    for kind, formula in (
        ("correspond", ""),
        ("build", ""),
        ("compare", "~ group"),
        ("compare", "~ age"),
        ("report", ""),
    ):
        done.run(kind, {"--formula": formula} if formula else {})
    return done


def test_results_are_outdated_by_the_edits_that_they_depend_on_and_by_no_others(answered: Done) -> None:
    project = answered.project
    assert answered.outdated == {}
    edit(project, what="cells", cells=[{"id": "ben", "column": "group", "value": "b"}])
    assert answered.outdated == {3: "table", 5: "table"}
    edit(project, what="remove-column", column="group")
    assert answered.outdated == {3: "table", 5: "table"}
    project.undo(project.revision)
    edit(project, what="add-column", column="site")
    edit(project, what="rename", id="carl", to="carol")
    project.undo(project.revision)
    project.undo(project.revision)
    project.undo(project.revision)
    assert answered.outdated == {}
    edit(project, what="landmarks", landmarks={"tip": 1})
    assert answered.outdated == {2: "landmarks", 5: "source"}
    project.undo(project.revision)
    edit(project, what="include", ids=["anna"], included=False)
    assert answered.outdated == {2: "specimens", 3: "specimens", 4: "specimens", 5: "source"}
    again = answered.run("build")
    made = answered.jobs[-1].arguments
    assert "correspondence-1/ben.corresponding.ply" in made and not any("anna" in word for word in made)
    assert answered.run("compare", {"--formula": "~ age"}) not in answered.outdated and again not in answered.outdated
    project.undo(project.revision)
    assert answered.outdated == {6: "specimens", 7: "specimens"}
    del answered.jobs[5:]
    edit(project, what="mirror", ids=["anna"], mirrored=True)
    assert answered.outdated == {1: "specimens", 2: "source", 3: "source", 4: "source", 5: "source"}
    project.undo(project.revision)
    answered.run("redo", {"name": "ben"})
    assert answered.outdated == {2: "redone", 3: "redone", 4: "redone", 5: "redone"}
    assert answered.run("build") == 7 and 7 not in answered.outdated


def test_results_are_outdated_by_scans_that_are_replaced_under_the_same_path(answered: Done) -> None:
    project = answered.project
    anna = project.path(project.state.specimens[0])
    before = anna.stat()
    tetrahedron(anna, 9.0)
    everything = {1: "specimens", 2: "source", 3: "source", 4: "source", 5: "source"}
    assert answered.outdated == everything
    answered.run("redo", {"name": "anna"})  # which reads the new scan
    assert answered.outdated == {2: "redone", 3: "redone", 4: "redone", 5: "redone"}
    answered.jobs.pop()
    assert answered.run("correspond") not in answered.outdated
    answered.jobs.pop()
    edit(project, what="include", ids=["anna"], included=False)
    assert answered.outdated == {2: "specimens", 3: "specimens", 4: "specimens", 5: "source"}  # as before the change
    project.undo(project.revision)
    tetrahedron(anna, 1.0)
    assert anna.stat().st_mtime_ns != before.st_mtime_ns
    assert answered.outdated == {}  # the same content at another time, as in a copy of the project


def test_the_table_is_written_once_for_all_results_that_are_compared_with_it(
    answered: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    for column in ("group", "age") * 10:
        answered.run("compare", {"--formula": f"~ {column}"})
    written: list[object] = []
    monkeypatch.setattr(f"{Project.__module__}.table_text", lambda *table: written.append(table) or table_text(*table))
    edit(answered.project, what="cells", cells=[{"id": "ben", "column": "group", "value": "b"}])
    assert len(answered.outdated) == 12 and len(written) == 2  # that of the scans, and that of the specimens


OF_CHOSEN = {"convert", "figures", "export", "surface", "groom"}  # actions on files or specimens that the user chooses


@pytest.mark.parametrize("kind", sorted({*forms(summaries_and_options()), "study"} - OF_CHOSEN))
def test_specimens_that_are_excluded_are_in_no_result(answered: Done, kind: str) -> None:
    project = answered.project
    for k, name in enumerate(("dora", "emil", "fritz")):
        project.add(tetrahedron(project.new_file(f"{name}.ply"), 5.0 + k), "new")
    join_table(project, b"id,group,age\ndora,a,4\nemil,b,5\nfritz,a,6\n")
    project.add(tetrahedron(project.new_file("gina.ply"), 8.0), "training")
    tetrahedron(project.folder / "correspondence-1" / f"gina{CorrespondRecord.SURFACE}", 1.0)
    for name in ids(project):
        edit(project, what="points", id=name, points={"tip": [0.0, 0.0, 1.0]})
    edit(project, what="include", ids=["anna", "dora"], included=False)
    answered.jobs.append(Job(number=6, kind="fit", arguments=("fit", "model-2.h5"), output="fits-6", status="done"))
    options = {"--reference": "group=a"} if kind == "score" else {}
    if kind == "score":
        edit(project, what="cells", cells=[{"id": "ben", "column": "group", "value": "a"},
                                           {"id": "gina", "column": "group", "value": "a"}])  # fmt: skip
    made = order(project, answered.jobs, answered.forms, "report" if kind == "study" else kind, options, None, 7)
    content = " ".join([*made.arguments, *made.files.values()])
    assert "anna" not in content and "dora" not in content
    assert "correspondence-1" not in made.arguments or kind in QUESTIONS or kind in ("report", "study")


def test_a_scan_that_was_corrected_with_other_settings_is_compared_with_these(answered: Done) -> None:
    project = answered.project
    edit(project, what="mirror", ids=["anna"], mirrored=True)
    edit(project, what="points", id="anna", points={"tip": [0.0, 0.0, 1.0]})
    assert answered.outdated[1] == "specimens"
    answered.run("redo", {"name": "anna"})
    model = answered.run("build")
    assert answered.outdated == {2: "redone", 3: "redone", 4: "redone", 5: "redone"}
    edit(project, what="points", id="anna", points={"tip": [0.0, 0.0, 2.0]})
    assert answered.outdated[1] == "landmarks" and answered.outdated[model] == "source"
    project.undo(project.revision)
    edit(project, what="mirror", ids=["anna"], mirrored=False)
    assert answered.outdated[1] == "specimens" and answered.outdated[model] == "source"


def test_a_question_about_landmarks_uses_those_that_the_user_placed_on_the_surfaces(answered: Done) -> None:
    options = {"--formula": "~ group", "--geometry": "landmarks"}
    edit(answered.project, what="landmarks", landmarks={"tip": 1, "base": 2, "side": 0}, on="correspondence-1")
    number = answered.run("compare", options)
    table = f"inputs/{number:04d}-landmarks.csv"
    assert f"landmarks={table}" in answered.jobs[-1].arguments
    assert "tip,1" in (answered.project.folder / table).read_text() and number not in answered.outdated
    edit(answered.project, what="landmarks", landmarks={"tip": 3, "base": 2, "side": 0}, on="correspondence-1")
    assert answered.outdated[number] == "landmarks"
    edit(answered.project, what="landmarks", landmarks={"tip": 3}, on="correspondence-9")
    with pytest.raises(InputError, match="were placed on correspondence-9; place them on correspondence-1"):
        answered.run("compare", options)


@pytest.mark.parametrize("change", [{"what": "set", "set": "new"}, {"what": "remove"}])
def test_specimens_that_are_moved_to_the_new_scans_or_removed_are_not_in_the_next_model(
    answered: Done, change: dict[str, str]
) -> None:
    edit(answered.project, **change, ids=["anna"])
    assert answered.outdated == {2: "specimens", 3: "specimens", 4: "specimens", 5: "source"}
    made = order(answered.project, answered.jobs, answered.forms, "build", {}, None, 6)
    assert {Path(word).name for word in made.arguments if "/" in word} == {
        f"{name}{CorrespondRecord.SURFACE}" for name in ("ben", "carl")
    }


def test_fits_of_excluded_specimens_are_not_exported(answered: Done) -> None:
    project = answered.project
    for k, name in enumerate(("dora", "emil")):
        project.add(tetrahedron(project.new_file(f"{name}.ply"), 5.0 + k), "new")
        (make_folder(project.folder / "fits-6") / f"{name}.fit.json").write_text("{}")
    answered.jobs.append(Job(number=6, kind="fit", arguments=("fit", "model-2.h5"), output="fits-6", status="done"))
    assert answered.run("export") == 7 and answered.jobs[-1].arguments[2:] == ("--all", "-o", "exported-7")
    edit(project, what="include", ids=["dora"], included=False)
    assert answered.outdated[7] == "specimens"
    assert answered.run("export") == 8 and answered.jobs[-1].arguments[2:] == ("emil", "-o", "exported-8")
    edit(project, what="include", ids=["emil"], included=False)
    with pytest.raises(InputError, match="All specimens of fits-6 are excluded"):
        answered.run("export")


def test_a_result_that_is_run_again_with_the_same_settings_is_up_to_date(answered: Done) -> None:
    edit(answered.project, what="cells", cells=[{"id": "ben", "column": "group", "value": "b"}])
    again = answered.run("compare", answered.jobs[2].options, answered.jobs[2].on)
    assert again not in answered.outdated and answered.outdated[3] == "table"


@pytest.mark.parametrize(("kind", "options", "problem"), [
    ("compare", {"--formula": "~ group"}, None),
    ("compare", {"--formula": "~ group + log_size"}, None),
    ("compare", {"--formula": "~ gruop"}, "gruop"),
    ("compare", {"--formula": "~ group +"}, "formula"),
    ("compare", {"--formula": "~ log(group)"}, "group"),
    ("compare", {"--formula": "~ group", "--permutations": "many"}, "--permutations: 'many' is not a number"),
    ("compare", {"--formula": "~ site"}, "site is missing for 1 of 4 specimens"),
    ("compare", {"--formula": "~ site", "--missing": "drop"}, None),
    ("compare", {}, "Choose a value of --formula"),
    ("disparity", {"--group": "group"}, None),
    ("disparity", {"--group": "code"}, "code has another value for each specimen; choose a column of classes"),
    ("disparity", {}, "Choose a value of --group"),
])  # fmt: skip
def test_checks_before_a_run_find_what_the_command_would_reject(
    project: Project, kind: str, options: dict[str, str], problem: str | None
) -> None:
    project.add(tetrahedron(project.new_file("dora.ply"), 5.0), "training")
    join_table(project, b"id,group,code,site\nanna,a,x,n\nben,a,y,n\ncarl,b,z,s\ndora,b,w,\n")
    found = checks(project, forms(summaries_and_options()), kind, options, None)
    problems = [one["text"] for one in found if one["level"] == "problem"]
    assert problems == [] if problem is None else any(problem in text for text in problems), problems


GROUPS = {f"s{k:02}": ("a" if k % 2 else "b", f"g{k % 3}", str(20 + 3 * k)) for k in range(12)}


@pytest.fixture
def analysed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    """Twelve specimens in correspondence, with a table whose columns need backticks, in an order other than by name."""
    made = Project.open(tmp_path / "bones", create=True)
    (made.folder / "correspondence-1").mkdir()
    for name, mesh in zip(GROUPS, training_meshes(12, 150), strict=True):
        write_mesh(made.folder / "correspondence-1" / f"{name}{CorrespondRecord.SURFACE}", mesh)
        made.add(tetrahedron(made.new_file(f"{name}.ply"), 1.0 + int(name[1:])), "training")
    rows = (f"{name},{','.join(GROUPS[name])}" for name in sorted(GROUPS, key=lambda name: (name[::-1], name)))
    join_table(made, "\n".join(["id,Group #,sex (m/f),age", *rows]).encode())
    monkeypatch.chdir(made.folder)
    return made


def answer_of(arguments: Sequence[object], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json", "--quiet"]) == 0, capsys.readouterr().err
    answer = json.loads(capsys.readouterr().out)
    return {key: value for key, value in answer.items() if key not in ("report", "folder", "created")}


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("compare", {"--formula": "~ `Group #` + age", "--permutations": "199", "--seed": "4"}),
        ("regress", {"--target": "age", "--seed": "4"}),
        ("morphospace", {"--group": "sex (m/f)", "--method": "cva"}),
    ],
)
def test_the_studio_and_the_command_give_the_same_answer(
    analysed: Project, kind: str, options: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    described = forms(summaries_and_options())
    done = [Job(number=1, kind="correspond", arguments=("x",), output="correspondence-1", status="done")]
    found = checks(analysed, described, kind, options, done[0])
    assert [one for one in found if one["level"] == "problem"] == []
    made = order(analysed, done, described, kind, options, None, 2)
    made.write_files(analysed.folder)
    studio = answer_of(made.arguments, capsys)
    lines = [f"{name},{','.join(cells)}" for name, cells in reversed(GROUPS.items())]
    Path("table.csv").write_text("\n".join(["specimen,Group #,sex (m/f),age", *lines]))
    way = {option["flag"]: option["argument"].split() for option in described[kind]["options"]}
    given: list[str] = []
    for flag, value in options.items():
        option, *setting = way[flag] or [""]
        given += [option, f"{setting[0]}={value}"] if setting else [option, value] if option else [value]
    command = answer_of([kind, "table.csv", "--shapes", "correspondence-1", "-o", "out", *given], capsys)
    assert studio == command


def test_a_test_of_shape_does_not_depend_on_the_order_of_the_rows(
    analysed: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    answers: list[dict[str, Any]] = []
    options = ["--formula", "~ `Group #`", "--group", "Group #", "--permutations", "199"]
    for step in (1, -1):
        lines = [f"{name},{cells[1]}" for name, cells in list(GROUPS.items())[::step]]
        Path("table.csv").write_text("\n".join(["specimen,Group #", *lines]))
        shapes = ["table.csv", "--shapes", "correspondence-1", "-o", "out"]
        answers.append(answer_of(["test", "pairwise", *shapes, *options], capsys))
    assert answers[0] == answers[1]
