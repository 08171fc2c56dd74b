"""Questions about landmarks on scans, without a correspondence: their data, commands, checks and marks."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_studio_checks import GOOD
from test_studio_landmarks import FORMS, take
from test_studio_project import Done, edit, join_table, project, tetrahedron
from test_studio_server import ended, own_home, studio, until, upload

from shapespace.cli import main
from shapespace.errors import InputError
from shapespace.geometry.landmark_alignment import align_landmarks
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.statistics.sides import pairs_by_name
from shapespace.types import FloatArray
from shapespace.viewer.studio.job_commands import QUESTIONS, checks, order, shapes_of
from shapespace.viewer.studio.jobs import Job, history
from shapespace.viewer.studio.placed_landmarks import MISSING_CHOICES, MISSING_LANDMARKS, PLACED
from shapespace.viewer.studio.project import Project

__all__ = ["own_home", "project"]  # fixtures

NAMES = ("left a", "left b", "a_L", "a_L2", "right a", "right b", "a_R", "a_R2")
COUNT = 24


def shapes(count: int, seed: int = 0) -> FloatArray:
    """Return landmarks of symmetric objects with noise, in any pose."""
    rng = np.random.default_rng(seed)
    half = rng.normal(3.0, 1.0, size=(4, 3))
    base = np.concatenate([half, half * (-1.0, 1.0, 1.0)])
    poses = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    poses *= np.linalg.det(poses)[:, None, None]
    return (base + 0.1 * rng.normal(size=(count, 8, 3))) @ poses


def table_of(points: FloatArray, names: tuple[str, ...] = NAMES) -> str:
    rows = [
        f"s{k:02},{name},{x!r},{y!r},{z!r}"
        for k, own in enumerate(points.tolist())
        for name, (x, y, z) in zip(names, own, strict=True)
    ]
    return "\n".join(["specimen,landmark,x,y,z", *rows])


def marked_project(folder: Path, count: int = COUNT) -> Project:
    """Return a project of people with two visits each, whose scans have landmarks."""
    made = Project.open(folder, create=True)
    rows = ["id,group,site,age,person,visit,stage"]
    for k in range(count):
        made.add(tetrahedron(made.new_file(f"s{k:02}.ply"), 1.0 + k), "training")
        rows.append(f"s{k:02},{'ab'[k % 2]},g{k % 3},{20 + 3 * (k % 11)},p{k // 2},{1 + k % 2},t{k // 2 % 2}")
    join_table(made, "\n".join(rows).encode())
    take(made, table_of(shapes(count)).encode(), "all.csv")
    (made.folder / "tree.nwk").write_text(f"({','.join(f's{k:02}:{1 + k % 3}' for k in range(count))});")
    parts = [f"{name},{'xy'[k % 2]}" for k, name in enumerate(NAMES)]
    (made.folder / "modules.csv").write_text("\n".join(["landmark,module", *parts]))
    return made


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> Project:
    return marked_project(tmp_path_factory.mktemp("placed") / "p")


def answer(project: Project, kind: str, options: Mapping[str, Any], number: int) -> Path:
    """Return the result of a question about the landmarks on scans, by the commands of its job."""
    made = order(project, [], FORMS, kind, options, PLACED, number)
    made.write_files(project.folder)
    for words in (*made.before, made.arguments):
        assert main([*words, "--quiet"]) == 0, words
    return project.folder / made.output


@pytest.mark.parametrize("kind", sorted(set(QUESTIONS) - {"identify", "change"}))
def test_each_question_answers_from_landmarks_on_scans_and_its_checks_find_nothing(
    marked: Project, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.chdir(marked.folder)
    options = GOOD[kind] | ({"--effect": "observed"} if kind == "power" else {})
    found = checks(marked, FORMS, kind, options, shapes_of(marked, [], kind, None))
    assert [one["text"] for one in found if one["level"] == "problem"] == []
    assert (answer(marked, kind, options, 1 + QUESTIONS.index(kind)) / "methods.txt").stat().st_size


def test_landmarks_by_clicks_give_the_results_of_the_command_on_their_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Units, mirror images and edits of single landmarks are those of one file in mm."""
    made = marked_project(tmp_path / "p", 12)
    points = shapes(12)
    (tmp_path / "marks.csv").write_text(table_of(points))
    for k, own in enumerate(points):
        as_file = own / (10.0 if k == 1 else 1.0) * ((-1.0 if k in (1, 2) else 1.0), 1.0, 1.0)
        placed = {"what": "points", "id": f"s{k:02}", "points": dict(zip(NAMES, as_file.tolist(), strict=True))}
        edit(made, **placed)
    edit(made, what="unit", ids=["s01"], unit="cm")
    edit(made, what="mirror", ids=["s01", "s02"], mirrored=True)
    monkeypatch.chdir(made.folder)
    own = answer(made, "compare", {"--formula": "~ group + age"}, 1)
    arguments = ["compare", "inputs/0001.csv", "~ group + age", "--shapes", str(tmp_path / "marks.csv")]
    assert main([*arguments, "-o", str(tmp_path / "by-file"), "--quiet"]) == 0
    terms, expected = (
        [line.split(",") for line in (folder / "terms.csv").read_text().splitlines()]
        for folder in (own, tmp_path / "by-file")
    )
    assert [row[0] for row in terms] == [row[0] for row in expected]
    for row, other in zip(terms[1:], expected[1:], strict=True):
        numbers = [(float(a), float(b)) for a, b in zip(row, other, strict=True) if a[:1].isdigit()]
        assert np.allclose(*np.transpose(numbers), rtol=1e-9, atol=0) and len(numbers) > 2


def test_groups_of_plethodon_are_those_of_geomorph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, geomorph_reference: dict[str, Any]
) -> None:
    """The published landmarks are in a plane, z = 0."""
    raw = np.reshape(geomorph_reference["plethodon_raw"], (40, 12, 2))
    table = geomorph_reference["plethodon_table"]
    made = Project.open(tmp_path / "p", create=True)
    for k in range(40):
        made.add(tetrahedron(made.new_file(f"s{k:02}.ply"), 1.0 + k), "training")
    rows = [f"s{k:02},{table['species'][k]},{table['site'][k]}" for k in range(40)]
    join_table(made, "\n".join(["id,species,site", *rows]).encode())
    numbers = tuple(map(str, range(1, 13)))
    take(made, table_of(np.pad(raw, ((0, 0), (0, 0), (0, 1))), numbers).encode(), "plethodon.csv")
    monkeypatch.chdir(made.folder)
    result = answer(made, "compare", {"--formula": "~ species * site", "--permutations": "99"}, 1)
    header, *terms = [line.split(",") for line in (result / "terms.csv").read_text().splitlines()]
    expected = geomorph_reference["plethodon_lm_raw_landmark_gpa"]["pleth_I"]
    values = [[float(row[header.index(name)]) for name in ("r2", "f")] for row in terms[:3]]
    assert np.allclose(values, np.transpose([expected["R2"][:3], expected["F"]]), rtol=1e-5)


def test_specimens_that_lack_landmarks_are_named_and_treated_as_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = marked_project(tmp_path / "p", 12)
    edit(made, what="points", id="s03", points={"left a": None, "a_L": None})
    edit(made, what="points", id="s04", points={"left a": None})
    edit(made, what="points", id="s05", points=dict.fromkeys(NAMES))
    monkeypatch.chdir(made.folder)
    used: dict[str, tuple[int, int]] = {}
    for number, choice in enumerate(MISSING_CHOICES, 1):
        options = {"--formula": "~ group", MISSING_LANDMARKS: choice}
        found = checks(made, FORMS, "compare", options, shapes_of(made, [], "compare", None))
        [warning] = [one["text"] for one in found if "Landmarks are missing" in one["text"]]
        assert "s03 2 of 8, s04 1 of 8, s05 8 of 8" in warning
        assert [one for one in found if one["level"] == "problem"] == []
        folder = answer(made, "compare", options, number)
        record = json.loads((made.folder / f"inputs/{number:04}-landmarks/aligned/align.json").read_text())
        used[choice] = (record["specimens"], record["landmarks"])
        assert json.loads((folder / "analysis.json").read_text())["methods"]["shapes"] == record["specimens"]
        assert bool(record["estimated"]) == choice.startswith("estimate")
    assert list(used.values()) == [(9, 8), (11, 6), (11, 8), (11, 8)]


def test_swapped_landmarks_and_rejected_input_are_found_before_the_run(tmp_path: Path) -> None:
    made = marked_project(tmp_path / "p", 12)
    own = made.state.specimens[2].points
    edit(made, what="points", id="s02", points={"left a": own["right b"], "right b": own["left a"]})
    found = checks(made, FORMS, "compare", {"--formula": "~ group"}, shapes_of(made, [], "compare", None))
    assert any("s02: exchange of the landmarks" in one["text"] for one in found if one["level"] == "warning"), found
    bad = checks(made, FORMS, "pairwise", {"--formula": "~ group", "--group": "no"}, shapes_of(made, [], "x", PLACED))
    assert [one["text"] for one in bad if one["level"] == "problem"] and str(made.folder) not in str(bad)
    edit(made, what="point-names", names=[])
    with pytest.raises(InputError, match="no included specimen to analyse"):
        order(made, [], FORMS, "compare", {"--formula": "~ group"}, PLACED, 1)


def test_a_plan_without_an_effect_is_found_before_the_run(marked: Project) -> None:
    found = checks(marked, FORMS, "power", {"--group": "group"}, shapes_of(marked, [], "power", None))
    assert any("no effect to plan with" in one["text"] for one in found if one["level"] == "problem"), found


def test_a_question_is_outdated_by_edits_of_its_landmarks_and_by_no_others(tmp_path: Path) -> None:
    made = marked_project(tmp_path / "p", 12)
    done = Done(made)
    done.run("asymmetry", {"--subject": "person"})
    done.run("report")
    assert done.outdated == {} and done.jobs[0].on == PLACED
    cases: tuple[tuple[dict[str, Any], str | None], ...] = (
        ({"what": "points", "id": "s03", "points": {"left a": [1, 2, 3]}}, "landmarks"),
        ({"what": "points", "id": "s03", "points": {"left a": None}}, "landmarks"),
        ({"what": "point-names", "names": NAMES[:6]}, "landmarks"),
        ({"what": "point-names", "names": []}, "landmarks"),
        ({"what": "pair", "name": "left a", "other": "right b"}, "landmarks"),
        ({"what": "unit", "ids": ["s03"], "unit": "cm"}, "landmarks"),
        ({"what": "include", "ids": ["s03"], "included": False}, "specimens"),
        ({"what": "cells", "cells": [{"id": "s03", "column": "person", "value": "q"}]}, "table"),
        ({"what": "cells", "cells": [{"id": "s03", "column": "age", "value": "99"}]}, None),
    )  # fmt: skip
    for request, change in cases:
        edit(made, **request)
        assert done.outdated.get(1) == change, request
        made.undo(made.revision)
        assert done.outdated == {}


def test_pairs_come_from_names_until_the_user_chooses_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("L_eye", "R_eye", "nose", "arch l", "arch r", "left", "Right", "L1", "r1", "leftover", "earL", "earR")
    expected = (("L_eye", "R_eye"), ("arch l", "arch r"), ("left", "Right"), ("L1", "r1"))
    assert pairs_by_name(names) == expected
    made = marked_project(tmp_path / "p", 12)
    pairs = (("left a", "right a"), ("left b", "right b"), ("a_L", "a_R"), ("a_L2", "a_R2"))
    assert made.state.mirrored_pairs == pairs
    monkeypatch.chdir(made.folder)
    folder = answer(made, "asymmetry", {"--subject": "person"}, 1)
    assert Path("inputs/0001-landmarks/pairs.csv").read_text().split("\n")[:4] == [",".join(pair) for pair in pairs]
    by_file = ["asymmetry", "inputs/0001.csv", "--shapes", "inputs/0001-landmarks/landmarks.csv", "--pairs"]
    words = [*by_file, "inputs/0001-landmarks/pairs.csv", "--set", "subject=person", "-o", "by-file", "--quiet"]
    assert main(words) == 0
    assert (folder / "subjects.csv").read_text() == Path("by-file/subjects.csv").read_text()
    edit(made, what="pair", name="left a", other="right b")
    assert made.state.mirrored_pairs == (("a_L", "a_R"), ("a_L2", "a_R2"), ("left a", "right b"))
    edit(made, what="pair", name="a_R", other="")
    assert made.state.mirrored_pairs == (("a_L2", "a_R2"), ("left a", "right b"))
    assert Project.open(made.folder).state == made.state


CURVES = 7


def curve_file(count: int, *, numbers: Mapping[int, int] | None = None) -> bytes:
    """Return TPS of specimens with four landmarks and a curve, of seven points unless `numbers` has another number."""
    rng, text = np.random.default_rng(1), ""
    fixed = rng.normal(size=(4, 3))
    for k in range(count):
        along = np.linspace(0.0, 2.0, (numbers or {}).get(k, CURVES)) ** 1.2
        bend = 1.0 + 0.1 * rng.normal()
        curve = np.stack([along, bend * np.sin(along), 0.3 * along**2], axis=1)
        own = fixed + 0.05 * rng.normal(size=fixed.shape)
        lines = ["\n".join(" ".join(map(repr, point)) for point in part.tolist()) for part in (own, curve)]
        text += f"LM3=4\n{lines[0]}\nCURVES=1\nPOINTS={len(curve)}\n{lines[1]}\nID=s{k:02}\n"
    return text.encode()


@pytest.mark.parametrize("numbers", [None, {3: 12, 5: 9}])
def test_curves_of_files_slide_as_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, numbers: Mapping[int, int] | None
) -> None:
    made = Project.open(tmp_path / "p", create=True)
    for k in range(8):
        made.add(tetrahedron(made.new_file(f"s{k:02}.ply"), 1.0 + k), "training")
    join_table(made, b"id,age\n" + b"".join(b"s%02d,%d\n" % (k, k * k % 7) for k in range(8)))
    (tmp_path / "all.tps").write_bytes(curve_file(8, numbers=numbers))
    notes = take(made, (tmp_path / "all.tps").read_bytes(), "all.tps")
    assert made.state.point_names[4:] == tuple(f"curve 1_{k}" for k in range(1, CURVES + 1))
    assert any("resampled" in note for note in notes) == bool(numbers)
    monkeypatch.chdir(made.folder)
    answer(made, "compare", {"--formula": "~ age", "--permutations": "99"}, 1)
    by_file = align_landmarks(read_configurations(tmp_path / "all.tps"))
    aligned = read_configurations(made.folder / "inputs/0001-landmarks/aligned/aligned.csv")
    assert np.allclose(aligned.points, by_file.coords, atol=1e-9)
    methods = (made.folder / "inputs/0001-landmarks/aligned/methods.txt").read_text()
    assert f"{CURVES - 2} semilandmarks on curves" in methods
    links = json.loads((made.folder / "inputs/0001-landmarks/aligned/orientation.json").read_text())["links"]
    assert links == [[k, k + 1] for k in range(5, 4 + CURVES)]


def test_the_points_of_a_curve_are_spaced_evenly_when_their_number_is_set(tmp_path: Path) -> None:
    made = marked_project(tmp_path / "p", 4)
    edit(made, what="curve", name="ridge", points=3, closed=False)
    names = tuple(f"ridge_{k}" for k in range(1, 6))
    assert made.state.point_names == (*NAMES, *names[:3])
    ends = {"ridge_1": [0, 0, 0], "ridge_2": [3, 0, 0], "ridge_3": [3, 1, 0]}
    for k in range(4):
        own = {name: at for name, at in ends.items() if k or name == "ridge_1"}
        edit(made, what="points", id=f"s{k:02}", points=own)
    with pytest.raises(InputError, match="Only some points of the curve ridge are placed on s00"):
        edit(made, what="curve", name="ridge", points=5, closed=False)
    edit(made, what="points", id="s00", points={"ridge_1": None})
    edit(made, what="curve", name="ridge", points=5, closed=False)
    found = checks(made, FORMS, "morphospace", {}, shapes_of(made, [], "morphospace", None))
    assert any("s00 5 of 13" in one["text"] for one in found)
    with pytest.raises(InputError, match="There is a landmark called"):
        edit(made, what="curve", name=NAMES[0], points=5, closed=False)
    files = order(made, [], FORMS, "morphospace", {}, None, 1).files
    rows = [row.split(",") for row in files["inputs/0001-landmarks/landmarks.csv"].split("\n")[1:-1]]
    spaced = [list(map(float, row[2:])) for row in rows if row[0] == "s02" and row[1].startswith("ridge")]
    assert np.allclose(spaced, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [3, 1, 0]])
    triples = [",".join(names[k : k + 3]) for k in range(3)]
    assert files["inputs/0001-landmarks/curveslide.csv"].split() == ["before,slide,after", *triples]
    correspondence = order(made, [], FORMS, "correspond", {}, None, 1)
    assert "ridge" not in correspondence.files["inputs/0001-landmarks/s02.csv"]  # its points are at no fixed place
    edit(made, what="curve", name="ridge", points=3, closed=False)
    assert made.state.point_names == (*NAMES, *names[:3])
    assert [made.state.specimens[2].points[name] for name in names[:3]] == [(0, 0, 0), (2, 0, 0), (3, 1, 0)]
    edit(made, what="curve", name="ridge", points=4, closed=True)
    assert made.state.curves["ridge"].closed and len(made.state.point_names) == 12
    assert len(made.state.specimens[2].points) == 12 and "ridge_1" not in made.state.specimens[0].points
    edit(made, what="point-names", names=NAMES)
    assert made.state.curves == {} and made.state.point_names == NAMES
    for request in ({"points": 2}, {"points": 501}, {"name": " "}, {"name": "#"}, {"points": "x"}):
        with pytest.raises(InputError):
            edit(made, **{"what": "curve", "name": "c", "points": 5, "closed": False, **request})


def slicer(points: FloatArray, *, unit: str = "mm", kind: str = "ClosedCurve", label: str = "OC") -> bytes:
    entries = [{"label": f"{label}-{k}", "position": point} for k, point in enumerate(points.tolist(), 1)]
    markup = {"type": kind, "coordinateSystem": "LPS", "coordinateUnits": unit, "controlPoints": entries}
    return json.dumps({"markups": [markup]}).encode()


def test_closed_curves_of_single_files_start_where_those_of_the_first_specimen_do(project: Project) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    oval = np.stack(
        [3.0 * np.cos(angles), np.sin(angles) + 0.4 * np.cos(angles) ** 2, 0.2 * np.sin(2 * angles)], axis=1
    )
    take(project, slicer(oval), "anna_curve.mrk.json")
    take(project, slicer(np.roll(oval[::-1], 7, axis=0)[::-1]), "ben_curve.mrk.json")
    assert project.state.curves.keys() == {"curve 1"} and project.state.curves["curve 1"].closed
    first, second = (np.array([*project.state.specimens[k].points.values()]) for k in (0, 1))
    assert len(first) == 24 and np.abs(first - second).max() < 0.02
    take(project, slicer(np.concatenate([oval, oval[:1] * 0.999]), label="rim"), "carl.mrk.json")
    assert project.state.curves["rim"].points == 25 and "rim_25" in project.state.specimens[2].points


def test_landmarks_in_cm_are_taken_in_the_unit_of_the_scan(project: Project) -> None:
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 10.0]])
    file = slicer(points, unit="cm", kind="Fiducial", label="p")
    with pytest.raises(InputError, match=r"anna\.mrk\.json has coordinates in cm, and the unit of anna is not known"):
        take(project, file, "anna.mrk.json")
    for unit, factor in (("cm", 1.0), ("mm", 10.0), ("m", 0.01)):
        edit(project, what="unit", ids=["anna"], unit=unit)
        take(project, file, "anna.mrk.json")
        own = project.state.specimens[0]
        assert np.allclose([*own.points.values()], factor * points)
        assert np.allclose([*own.read_points().values()], 10.0 * points)  # mm
    take(project, slicer(points, kind="Fiducial", label="p"), "anna.mrk.json")
    assert np.allclose([*project.state.specimens[0].points.values()], points)  # Slicer has the numbers of a mesh


def test_a_model_can_wait_for_a_correspondence_that_still_runs(project: Project) -> None:
    jobs = [
        Job(number=1, kind="correspond", arguments=("x",), output="correspondence-1", status="done"),
        Job(number=2, kind="correspond", arguments=("x",), output="correspondence-2", status="running"),
        Job(number=3, kind="correspond", arguments=("x",), output="correspondence-3", status="failed"),
    ]
    made = [order(project, jobs, FORMS, "build", {}, on, 4).arguments[1] for on in (None, 1, 2)]
    assert made == ["correspondence-1", "correspondence-1", "correspondence-2"]
    with pytest.raises(InputError, match="needs a correspondence"):
        order(project, jobs, FORMS, "build", {}, 3, 4)
    join_table(project, b"id,group\nanna,a\nben,a\ncarl,b\n")
    found = checks(project, FORMS, "disparity", {"--group": "group"}, shapes_of(project, jobs, "disparity", 2))
    assert not any("no surface" in one["text"] for one in found)


def test_an_answer_from_landmarks_is_computed_again_by_the_history(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    with studio(folder) as client:
        upload(client, tmp_path, 10)
        content = table_of(shapes(10)).replace("\ns0", "\ns")
        sent = client.post("/api/table", params={"name": "all.csv"}, content=content)
        assert sent.json()["landmarks"] == 8
        rows = "".join(f"s{k},{'ab'[k % 2]}\n" for k in range(10))
        assert client.post("/api/table", params={"name": "t.csv"}, content=f"id,group\n{rows}").status_code == 200
        state = client.get("/api/project").json()["project"]
        assert state["pairs"][0] == ["left a", "right a"] and state["curves"] == {}
        asked = {"kind": "compare", "options": {"--formula": "~ group", "--permutations": "99"}, "on": None}
        found = client.post("/api/checks", json=asked).json()
        assert [one for one in found if one["level"] == "problem"] == []
        assert client.post("/api/jobs", json=asked).status_code == 201
        until(client, ended)
        assert client.post("/api/jobs", json={"kind": "report", "options": {}}).status_code == 201
        now = until(client, ended)
        assert [job["status"] for job in now["jobs"]] == ["done", "done"], [job["message"] for job in now["jobs"]]
        answered = now["jobs"][0]
        assert answered["sentences"] and answered["methods"] and answered["on"] == 0 and answered["views"]
        report = (folder / now["jobs"][1]["output"]).read_text()
        assert answered["sentences"][0].replace("²", "") in report.replace("²", "").replace("&#178;", "")
    commands = tmp_path / "bin"
    commands.mkdir()
    (commands / "shapespace").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m shapespace "$@"\n')
    (commands / "shapespace").chmod(0o755)
    again = tmp_path / "again"
    environment = {**os.environ, "PATH": f"{commands}:{os.environ['PATH']}"}
    subprocess.run(["sh", str(folder / "history.sh"), str(again)], check=True, env=environment)
    assert (again / "compare-1/terms.csv").read_text() == (folder / "compare-1/terms.csv").read_text()
    assert (again / "inputs/0001-landmarks/aligned/aligned.csv").is_file()


def test_the_history_reads_landmarks_in_the_project_and_writes_into_its_folder(tmp_path: Path) -> None:
    made = marked_project(tmp_path / "p", 4)
    edit(made, what="curve", name="ridge", points=3, closed=False)
    for k in range(4):
        edit(made, what="points", id=f"s{k:02}", points={f"ridge_{n}": [n, n * n, k] for n in (1, 2, 3)})
    done = Done(made)
    done.run("asymmetry", {"--subject": "person"})
    lines = [line.split() for line in history(done.jobs).splitlines()[-2:]]
    paths = [word for line in lines for word in line if "inputs/" in word]
    aligned = [word for word in paths if word == "inputs/0001-landmarks/aligned"]  # in the new folder
    assert len(paths) == 6 and len(aligned) == 2
    assert all(word.startswith('"$PROJECT"/inputs/0001') for word in paths if word not in aligned)
