"""Landmarks on the scans of a studio's project: imported, placed, undone, and in the files of the commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_studio_project import Done, edit, project, tetrahedron
from test_studio_server import own_home, state, studio, until, upload

from shapespace.cli import main, parser
from shapespace.cli.command_table import summaries_and_options
from shapespace.cli.forms import forms
from shapespace.commands.inputs import given_scans
from shapespace.errors import FileFormatError, InputError
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_io import read_landmarks, write_landmarks, write_surface_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.build_model import build_model
from shapespace.types import SurfaceLandmarks
from shapespace.viewer.studio.job_commands import order
from shapespace.viewer.studio.jobs import Job, history
from shapespace.viewer.studio.landmark_import import is_landmark_table, read_points
from shapespace.viewer.studio.project import Project, ScanCurve, StaleError, with_points
from synthetic_shapes import training_meshes

__all__ = ["own_home", "project"]  # fixtures

FORMS = forms(summaries_and_options())
TPS = b"LM3=2\n1 2 3\n4 5 6\nID=anna\nLM3=2\n1 0 0\nNA NA NA\nID=BEN\n"
SLICER = """{"markups": [{"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": [
  {"label": "nose", "position": [1, 2, 3]},
  {"label": "ear", "position": [0, 0, 0], "positionStatus": "undefined"}]}]}"""


def take(project: Project, content: bytes, name: str) -> list[str]:
    names, points, curves, notes = read_points(content, name, project.state)
    project.edit(None, with_points(names, points, curves), together="import landmarks")
    return notes


def points(project: Project) -> dict[str, dict[str, tuple[float, ...]]]:
    return {one.id: one.points for one in project.state.specimens if one.points}


def test_landmarks_of_one_and_of_many_specimens_are_imported_by_name(project: Project) -> None:
    assert take(project, b"name,x,y,z\nnose,1,2,3\near,NA,NA,NA\nchin,0.1,-4,5e-3\n", "anna.csv") == []
    assert project.state.point_names == ("nose", "chin")
    assert points(project) == {"anna": {"nose": (1, 2, 3), "chin": (0.1, -4, 0.005)}}
    assert take(project, SLICER.encode(), "Ben.mrk.json") == []  # RAS becomes LPS, the frame of Slicer's meshes
    notes = take(project, TPS + b"LM3=2\n1 1 1\n2 2 2\nID=zoe\n", "all.tps")
    assert points(project) == {
        "anna": {"nose": (1, 2, 3), "chin": (0.1, -4, 0.005), "1": (1, 2, 3), "2": (4, 5, 6)},
        "ben": {"nose": (-1, -2, 3), "1": (1, 0, 0)},
    }
    assert project.state.point_names == ("nose", "chin", "1", "2")
    assert notes == [
        "1 of 3 rows of all.tps has no specimen in the project and is excluded (zoe).",
        "1 of 3 specimens in the project has no row in all.tps (carl).",
    ]
    take(project, b"LM3=1\n7 8 9\n", "carl.tps")  # without an id, so that the file's name counts
    assert points(project)["carl"] == {"1": (7, 8, 9)}
    project.undo(project.revision)
    assert points(project) == {} and project.state.point_names == ()


@pytest.mark.parametrize(("name", "content", "message"), [
    ("zoe.csv", b"name,x,y,z\nnose,1,2,3\n", "contains no specimen of zoe.csv"),
    ("twice.tps", b"LM3=1\n1 2 3\nID=anna\nLM3=1\n1 2 3\nID=ANNA\n", "rows 1 .'anna'. and 2 .'ANNA'. are of one"),
    ("same.tps", b"LM3=1\n1 2 3\nID=anna\nLM3=1\n1 2 3\nID=anna\n", "two specimens are called 'anna'"),
    ("anna.tps", b"LM=2\n1 2\n3 4\n", "anna.tps has landmarks in 2-D"),
    ("anna.tps", b"LM3=2\n1 2 3\n", "anna.tps"),
    ("anna.csv", b"name,x,y,z\nnose,1,2\n", "anna.csv"),
    ("anna.json", b"{", "anna.json"),
    ("anna.fcsv", b"", "anna.fcsv"),
    ("anna.csv", b"name,x,y,z\nnose,NA,NA,NA\n", "anna.csv has no landmarks"),
    ("anna.exe", b"x", "is not that of a landmark file"),
    ("anna.csv", b"name,x,y,z\n" + b"n" * 61 + b",1,2,3\n", "cannot be called"),
    ("anna.pts", b"1 2 3\n" * 501, "501 names of landmarks"),
])  # fmt: skip
def test_a_file_of_landmarks_that_cannot_be_used_is_refused_in_a_sentence_with_its_name(
    project: Project, name: str, content: bytes, message: str
) -> None:
    before = project.state
    with pytest.raises((InputError, FileFormatError), match=message) as error:
        take(project, content, name)
    assert project.state == before and "shapespace-" not in str(error.value)


def test_points_of_curves_are_imported_with_the_name_of_their_curve(project: Project) -> None:
    content = b"LM3=1\n1 2 3\nCURVES=1\nPOINTS=3\n1 1 1\n2 2 2\n3 3 3\nID=anna\n"
    assert take(project, content, "x.tps") == ["1 points of 1 curve are semilandmarks."]
    assert points(project) == {
        "anna": {"1": (1, 2, 3), "curve 1_1": (1, 1, 1), "curve 1_2": (2, 2, 2), "curve 1_3": (3, 3, 3)}
    }
    assert project.state.curves == {"curve 1": ScanCurve(3)}


@pytest.mark.parametrize(("name", "content", "expected"), [
    ("table.csv", b"id,sex\nanna,f\n", False), ("anna.csv", b"id,sex\nanna,f\n", False),
    ("anna.csv", b"name,x,y,z\nnose,1,2,3\n", True), ("anna.csv", b"nose,1,2,3\near,1,2,3\n", True),
    ("sites.csv", b"name,x,y,z\nanna,1,2,3\n", False), ("all.csv", b"id,x1,y1,z1,x2,y2,z2\nanna,1,2,3,4,5,6\n", True),
    ("flat.csv", b"id,x1,y1,x2,y2\nanna,1,2,4,5\n", False),
    ("long.csv", b"specimen,landmark,x,y,z\nanna,a,1,2,3\n", True),
    ("empty.csv", b"", False), ("binary.csv", b"\xd0\xcf\x11\xe0", False),
])  # fmt: skip
def test_a_table_of_covariates_is_no_table_of_landmarks(
    project: Project, name: str, content: bytes, expected: bool
) -> None:
    assert is_landmark_table(content, name, project.state) is expected
    with pytest.raises(FileFormatError, match=r"bad\.csv"):
        is_landmark_table(b"id,x1,y1,z1,x2,y2,z2\nanna,a,b\n", "bad.csv", project.state)


def test_landmarks_are_placed_moved_and_removed_and_undo_takes_it_back(project: Project) -> None:
    states = [project.state]
    for request in (
        {"what": "point-names", "names": ["nose"]},
        {"what": "points", "id": "anna", "points": {"nose": [1, 2, 3]}, "before": {"nose": None}},
        {"what": "points", "id": "anna", "points": {"nose": [1, 2, 4]}, "before": {"nose": [1.0, 2.0, 3.0]}},
        {"what": "points", "id": "anna", "points": {"ear": [0, 0, 0], "nose": None}},
        {"what": "point-names", "names": ["nose"]},
    ):
        edit(project, **request)
        states.append(project.state)
    assert [points(project) for project.state in states] == [
        {}, {}, {"anna": {"nose": (1, 2, 3)}}, {"anna": {"nose": (1, 2, 4)}}, {"anna": {"ear": (0, 0, 0)}}, {},
    ]  # fmt: skip
    assert [state.point_names for state in states[3:]] == [("nose",), ("nose", "ear"), ("nose",)]
    for before in reversed(states[:-1]):
        project.undo(project.revision)
        assert project.state == before == Project.open(project.folder).state


def test_a_landmark_that_another_tab_moved_in_the_meantime_is_not_overwritten(project: Project) -> None:
    edit(project, what="points", id="anna", points={"nose": [1, 2, 3]})
    place = {"what": "points", "id": "anna", "points": {"nose": [5, 5, 5]}}
    for before in (None, [1, 2, 4]):
        with pytest.raises(StaleError, match="Another tab changed the landmark nose of anna"):
            edit(project, **place, before={"nose": before})
    with pytest.raises(StaleError, match="Another tab changed the project"):
        project.edit(0, lambda state: ("", state))
    edit(project, **place, before={"nose": [1, 2, 3]})
    assert points(project) == {"anna": {"nose": (5, 5, 5)}}


@pytest.mark.parametrize(("request_", "message"), [
    ({"what": "points", "id": "zoe", "points": {"nose": [1, 2, 3]}}, "no specimen 'zoe'"),
    ({"what": "points", "id": "anna", "points": {"nose": [1, 2]}}, "cannot be read"),
    ({"what": "points", "id": "anna", "points": {"nose": [1, 2, float("nan")]}}, "three finite coordinates"),
    ({"what": "points", "id": "anna", "points": {"": [1, 2, 3]}}, "cannot be called"),
    ({"what": "point-names", "names": [" "]}, "cannot be called"),
    ({"what": "point-names", "names": ["#1"]}, "cannot be called '#1'"),
    ({"what": "point-names", "names": ["a\nb"]}, "cannot be called"),
    ({"what": "point-names"}, "cannot be read"),
])  # fmt: skip
def test_landmarks_that_cannot_be_are_refused_in_a_sentence(
    project: Project, request_: dict[str, object], message: str
) -> None:
    before = project.state
    with pytest.raises(InputError, match=message):
        edit(project, **request_)
    assert project.state == before


def test_unit_and_mirror_transform_landmarks_as_the_scans_that_commands_read(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Landmarks at vertices of the scans are at the same vertices of the scans in mm and their mirror images."""
    monkeypatch.chdir(project.folder)
    for name in ("anna", "ben", "carl"):
        corners = read_mesh(project.folder / "scans" / f"{name}.ply").vertices[1:].tolist()
        edit(project, what="points", id=name, points=dict(zip(("x", "y", "=z, 1"), corners, strict=True)))
    edit(project, what="unit", ids=["anna", "ben"], unit="cm")
    edit(project, what="mirror", ids=["ben"], mirrored=True)
    edit(project, what="rename", id="ben", to="Benno")
    made = order(project, [], FORMS, "correspond", {}, None, 1)
    made.write_files(project.folder)
    for words in made.before:
        assert main(list(words)) == 0
    given = given_scans([made.arguments[1]], project.folder / made.output, recursive=False, say=pytest.fail)
    for scan in given:
        assert scan.landmarks is not None and scan.landmarks.stem == scan.called
        placed = np.stack([*read_landmarks(scan.landmarks).values()])
        assert np.array_equal(placed, read_mesh(scan.path).vertices[1:]), scan.called
        assert list(read_landmarks(scan.landmarks)) == ["x", "y", "=z, 1"]
    extents = {scan.called: np.abs(read_mesh(scan.path).vertices).max() for scan in given}
    assert extents == {"anna": 10.0, "Benno": 20.0, "carl": 3.0}
    job = Job(number=1, kind="correspond", arguments=made.arguments, output="correspondence-1", before=made.before,
              status="done")  # fmt: skip
    assert 'correspond "$PROJECT"/inputs/0001.csv' in history([job])


def test_results_are_outdated_by_an_edit_of_the_landmarks_that_they_used(project: Project) -> None:
    for name in ("anna", "ben"):
        edit(project, what="points", id=name, points={"nose": [1, 2, 3]})
    done = Done(project)
    assert [done.run(kind) for kind in ("correspond", "build", "landmarks")] == [1, 2, 3] and done.outdated == {}
    stale = {1: "landmarks", 2: "source", 3: "landmarks"}
    for request in (
        {"what": "points", "id": "ben", "points": {"nose": [1, 2, 4]}},
        {"what": "points", "id": "ben", "points": {"nose": None}},
        {"what": "points", "id": "carl", "points": {"nose": [0, 0, 0]}},
    ):
        edit(project, **request)
        assert done.outdated == stale, request
        project.undo(project.revision)
        assert done.outdated == {}
    edit(project, what="mirror", ids=["ben"], mirrored=True)
    assert done.outdated[1] == "specimens" and 3 not in done.outdated
    project.undo(project.revision)
    edit(project, what="include", ids=["ben"], included=False)
    assert 1 not in done.outdated and done.outdated[3] == "landmarks"
    done.run("redo", {"name": "ben"})
    assert done.jobs[-1].arguments == ("correspond", "inputs/0004.csv", "--redo", "ben", "-o", "correspondence-1")
    assert "inputs/0004-landmarks/ben.csv" in {
        path.relative_to(project.folder).as_posix() for path in project.folder.glob("inputs/*/*")
    }


def test_a_fit_takes_landmarks_of_which_the_model_knows_three(project: Project) -> None:
    model = replace(build_model(training_meshes()), landmarks={"a": 0, "b": 5, "c": 9})  # type: ignore[arg-type]
    model.save(project.folder / "model-1.h5")
    jobs = [Job(number=1, kind="build", arguments=("build",), output="model-1.h5", status="done")]
    for k, marks in enumerate(("abcd", "abd", "")):
        name, _ = project.add(tetrahedron(project.new_file(f"new{k}.ply"), 7.0 + k), "new")
        if marks:
            edit(project, what="points", id=name, points={mark: [k, k, k] for mark in marks})
    made = order(project, jobs, FORMS, "fit", {}, None, 2)
    assert [name for name in made.files if "-landmarks/" in name] == ["inputs/0002-landmarks/new0.csv"]
    assert made.files["inputs/0002-landmarks/new0.csv"].split() == ["name,x,y,z", *(f"{m},0.0,0.0,0.0" for m in "abc")]
    assert [line.rpartition(",")[2] for line in made.files["inputs/0002.csv"].split()] == [
        "landmarks", "0002-landmarks/new0.csv", "", "",
    ]  # fmt: skip
    assert callable(parser().parse_args(made.arguments).run)


def test_a_model_has_the_landmarks_of_the_scans_and_those_on_the_surfaces(project: Project) -> None:
    done = Done(project)
    done.run("correspond")
    of_scans = SurfaceLandmarks(
        ("nose", "ear"), np.array([[0, 1, 2], [1, 1, 1]]), np.array([[0.5, 0.3, 0.2], [1, 0, 0]])
    )
    write_surface_landmarks(project.folder / "correspondence-1" / "landmarks.csv", of_scans)
    edit(project, what="landmarks", landmarks={"tip": 3, "ear": 2}, on="correspondence-1")
    made = order(project, done.jobs, FORMS, "build", {}, None, 2)
    made.write_files(project.folder)
    write_surface_landmarks(project.folder / "expected.csv", of_scans.select(["nose"]).joined(
        SurfaceLandmarks.of({"tip": 3, "ear": 2})
    ))  # fmt: skip
    assert made.files["inputs/0002-landmarks.csv"] == (project.folder / "expected.csv").read_text()


@pytest.mark.parametrize("to", ["tps", "csv", "long", "nts", "mrk.json"])
def test_landmarks_are_exported_as_they_are_on_the_scans(
    project: Project, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    edit(project, what="points", id="anna", points={"nose": [1, 2, 3], "ear": [0.1, -2, 1 / 3]})
    edit(project, what="points", id="ben", points={"nose": [7, 8, 9]})
    edit(project, what="mirror", ids=["anna"], mirrored=True)
    made = order(project, [], FORMS, "landmarks", {"--to": to}, None, 1)
    made.write_files(project.folder)
    monkeypatch.chdir(project.folder)
    assert main(list(made.arguments)) == 0
    read = read_configurations(Path(made.output))
    assert read.names == ("anna", "ben") and read.points[0].tolist() == [[1, 2, 3], [0.1, -2, 1 / 3]]
    assert read.points[1, 0].tolist() == [7, 8, 9] and np.isnan(read.points[1, 1]).all()
    with pytest.raises(InputError, match="No included specimen has landmarks"):
        edit(project, what="include", ids=["anna", "ben"], included=False)
        order(project, [], FORMS, "landmarks", {"--to": to}, None, 2)


def test_dropped_files_of_landmarks_and_edits_come_over_http(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 2)
        sent = client.post("/api/table", params={"name": "s0.csv"}, content=b"name,x,y,z\nnose,1,2,3\n")
        assert sent.json() == {"matched": 1, "landmarks": 1, "notes": []}
        sent = client.post("/api/table", params={"name": "s0.csv"}, content=b"id,sex\ns0,f\ns1,m\n")
        assert sent.json()["matched"] == 2 and "landmarks" not in sent.json()
        points_file = tmp_path / "s1.fcsv"
        write_landmarks(points_file, {"nose": np.array([0.0, 1.0, 0.5])})
        sent = client.post(
            "/api/table", params={"name": "s1.fcsv", "kind": "landmarks"}, content=points_file.read_bytes()
        )
        assert sent.status_code == 200, sent.text
        sent = client.post("/api/table", params={"name": "s9.tps", "kind": "landmarks"}, content=b"LM3=1\n1 2\n")
        assert sent.status_code == 422 and "s9.tps" in sent.json()["error"] and "/tmp" not in sent.json()["error"]
        now = state(client)
        assert now["point_names"] == ["nose"] and now["columns"] == ["sex"]
        assert [one["points"] for one in now["specimens"]] == [{"nose": [1, 2, 3]}, {"nose": [0, 1, 0.5]}]
        place = {"what": "points", "id": "s0", "points": {"nose": [4, 4, 4]}, "revision": now["revision"]}
        assert client.post("/api/edit", json={**place, "before": {"nose": [9, 9, 9]}}).status_code == 409
        assert client.post("/api/edit", json={**place, "before": {"nose": [1, 2, 3]}}).status_code == 200
        assert client.post("/api/edit", json={**place, "before": {"nose": [1, 2, 3]}}).status_code == 409
        assert ".fcsv" in client.get("/api/project").json()["landmark_formats"]


def test_landmarks_that_are_not_on_their_scan_are_named_on_import_and_before_a_question(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 2)
        until(client, lambda now: all(one["state"] == "ready" for one in now["specimens"]))
        corners = {name: read_mesh(tmp_path / f"{name}.ply").vertices[:4] for name in ("s0", "s1")}
        for scale, named in ((1.0, set()), (10.0, {"s0"})):  # as in cm among mm
            rows = [
                f"{name},m{k},{','.join(map(str, corner * (scale if name == 's0' else 1.0)))}"
                for name, points in corners.items()
                for k, corner in enumerate(points)
            ]
            text = "\n".join(["specimen,landmark,x,y,z", *rows]).encode()
            sent = client.post("/api/table", params={"name": "marks.csv", "kind": "landmarks"}, content=text)
            assert {note.split(":")[0] for note in sent.json()["notes"]} == named, sent.text
            asked = {"kind": "morphospace", "options": {}, "on": 0}
            found = [one["text"] for one in client.post("/api/checks", json=asked).json()]
            assert {text.split(":")[0] for text in found if "not on its scan" in text} == named
