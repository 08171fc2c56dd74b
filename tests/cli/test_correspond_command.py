"""`correspond` takes a folder of raw scans to a folder that `build` takes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from raw_blobs import LANDMARKS, marked, raw_blob
from shapespace.cli import main
from shapespace.commands import correspond
from shapespace.correspondence.first_template import usable_scan
from shapespace.errors import InputError
from shapespace.io.landmarks.landmark_io import read_surface_landmarks, write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import sphere

SCANS = 4
QUICK = ("--mirror", "never", "--vertices", "500", "--rounds", "1", "--jobs", "1", "--quiet")


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("raw")
    for k in range(SCANS):
        write_mesh(folder / f"blob{k}.ply", raw_blob(k, points=1500).scan)
    (folder / "torn.ply").write_bytes((folder / "blob0.ply").read_bytes()[:900])
    return folder


@pytest.fixture(scope="module")
def same(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("same")
    assert main(["correspond", str(raw), "-o", str(folder), *QUICK]) == 1
    return folder


def test_each_scan_has_a_surface_and_a_record_and_a_bad_one_a_reason(same: Path) -> None:
    summary = json.loads((same / "correspondence.json").read_text("utf-8"))
    assert summary["corresponding"] == [f"blob{k}" for k in range(SCANS)]
    assert list(summary["set_aside"]) == ["torn"] and "torn.ply" in summary["set_aside"]["torn"]
    first = read_mesh(same / "blob0.corresponding.ply")
    for k in range(SCANS):
        record = json.loads((same / f"blob{k}.correspond.json").read_text("utf-8"))
        assert record["status"] == "converged" and 0.9 < record["covered_share"] <= 1.0
        assert 0.5 < record["scale"] < 2.0 and len(record["moved_share"]) == 1
        assert 0 <= record["folded_share"] < 0.05 and 1 < record["area_factor"] < 4 and 0.8 < record["area_share"] < 1.2
        surface = read_mesh(same / f"blob{k}.corresponding.ply")
        np.testing.assert_array_equal(surface.faces, first.faces)
    assert json.loads((same / "torn.correspond.json").read_text("utf-8"))["status"] == "excluded"
    assert not (same / "torn.corresponding.ply").exists() and not (same / ".rounds").exists()
    np.testing.assert_array_equal(read_mesh(same / "template" / "mean.ply").faces, first.faces)


def test_scans_come_by_address_and_list_and_what_is_known_of_them_is_kept(
    run: Run, raw: Path, same: Path, tmp_path: Path
) -> None:
    pytest.importorskip("fsspec")
    shutil.make_archive(str(tmp_path / "scans"), "zip", raw)
    archive = f"file://{tmp_path}/scans.zip"
    write_landmarks(tmp_path / "far.csv", {"tip": np.array([1e6, 0.0, 0.0])})
    rows = [f"zip://blob{k}.ply::{archive},anna{k},{30 + k},{'' if k else 'far.csv'}" for k in range(SCANS)]
    (tmp_path / "list.csv").write_text(
        "\n".join(["scan,id,age,landmarks", *rows, f"zip://torn.ply::{archive},torn,1,"])
    )
    out = tmp_path / "out"
    assert run("correspond", tmp_path / "list.csv", "-o", out, *QUICK).code == 1
    for k in range(SCANS):
        record = json.loads((out / f"anna{k}.correspond.json").read_text("utf-8"))
        assert record["metadata"] == {"age": str(30 + k)} and record["path"] == f"zip://blob{k}.ply::{archive}"
        assert record["hash"] == json.loads((same / f"blob{k}.correspond.json").read_text("utf-8"))["hash"]
        surfaces = [
            read_mesh(f).vertices for f in (out / f"anna{k}.corresponding.ply", same / f"blob{k}.corresponding.ply")
        ]
        np.testing.assert_array_equal(*surfaces)
        assert any("landmarks" in note for note in record["notes"]) is (k == 0)
    torn = json.loads((out / "torn.correspond.json").read_text("utf-8"))
    assert torn["status"] == "excluded" and torn["metadata"] == {"age": "1"}
    assert run("report", out, "--no-open").code == 0


def test_build_takes_the_folder_as_it_stands(run: Run, same: Path, tmp_path: Path) -> None:
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    assert ShapeModel.load(tmp_path / "model.h5").n_training == SCANS


def test_the_terminal_says_the_template_and_what_is_next(run: Run, raw: Path, tmp_path: Path) -> None:
    template = raw / "blob1.ply"
    outcome = run("correspond", raw / "blob0.ply", raw / "blob2.ply", "-o", tmp_path, "--template", template, *QUICK)
    assert outcome.code == 0 and outcome.err == ""
    assert "blob1.ply was given as the template." in outcome.out
    assert f"next: shapespace build {tmp_path} -o model.h5" in outcome.out


def test_bad_input_is_one_sentence(run: Run, raw: Path, tmp_path: Path) -> None:
    alone = run("correspond", raw / "blob0.ply", "-o", tmp_path / "a", *QUICK)
    assert alone.code == 2 and "at least 2 scans, not 1" in alone.sentence()
    twice = run("correspond", raw / "blob0.ply", raw / "blob0.ply", "-o", tmp_path / "b", *QUICK)
    assert twice.code == 2 and "at least 2 scans, not 1" in twice.sentence()
    gone = run("correspond", raw, "-o", tmp_path / "c", "--template", tmp_path / "no.ply", *QUICK)
    assert gone.code == 2 and "no.ply" in gone.sentence()


@pytest.mark.long
def test_subjects_are_a_column_without_missing_values(run: Run, raw: Path, tmp_path: Path) -> None:
    rows = [f"{raw / f'blob{k}.ply'},{'anna' if k < 2 else ''}" for k in range(SCANS)]
    (tmp_path / "list.csv").write_text("\n".join(["file,person", *rows]), "utf-8")
    command = ("correspond", str(tmp_path / "list.csv"), "-o", str(tmp_path / "out"), *QUICK, "--subjects")
    outcome = run(*command, "subject")
    assert outcome.code == 2 and "column subject" in outcome.err and "person" in outcome.err
    outcome = run(*command, "person")
    assert outcome.code == 2 and "2 of 4 scans (blob2, blob3)" in outcome.err
    outcome = run(*command, "person", "--groups")
    assert outcome.code == 2 and "--groups" in outcome.err
    complete = [f"{row}ben" if row.endswith(",") else row for row in rows]
    (tmp_path / "list.csv").write_text("\n".join(["file,person", *complete]), "utf-8")
    assert run(*command, "person").code == 0


@pytest.mark.long
def test_a_later_run_leaves_no_surface_of_another_template(run: Run, raw: Path, tmp_path: Path) -> None:
    scans = [raw / f"blob{k}.ply" for k in range(3)]
    assert run("correspond", *scans, "-o", tmp_path, *QUICK).code == 0
    again = run("correspond", *scans[1:], "-o", tmp_path, *QUICK)
    assert again.code == 0 and "Results of 1 scans that are not among those given were removed" in again.err
    assert not list(tmp_path.glob("blob0*"))
    mixed = run("correspond", tmp_path, *scans[:2], "-o", tmp_path, *QUICK)
    assert mixed.code == 0 and "2 surfaces of an earlier correspondence are not taken for scans" in mixed.err


def test_landmarks_in_files_named_as_the_scans_go_on_into_the_model(run: Run, raw: Path, tmp_path: Path) -> None:
    (tmp_path / "marks").mkdir()
    for k in range(2):
        write_landmarks(tmp_path / "marks" / f"blob{k}.csv", marked(raw_blob(k, points=1500)).landmarks)
    write_landmarks(tmp_path / "marks" / "nobody.csv", {"a": np.zeros(3)})
    (tmp_path / "marks" / "blob2.csv").write_text("no landmarks at all\n", "utf-8")
    scans = [raw / f"blob{k}.ply" for k in range(3)]
    outcome = run("correspond", *scans, "-o", tmp_path / "same", "--landmarks", tmp_path / "marks", *QUICK)
    assert outcome.code == 0
    assert (
        "blob2.ply is used without landmarks" in outcome.err
        and "belong to no scan that is given: nobody" in outcome.err
    )
    record = json.loads((tmp_path / "same" / "blob0.correspond.json").read_text("utf-8"))
    assert 0 <= record["landmark_rms"] < 15
    assert set(record["landmark_distances"]) == set(LANDMARKS)
    assert "The given landmarks of 2 scans are " in outcome.err and "on the corresponding surfaces" in outcome.err
    assert run("build", tmp_path / "same", "-o", tmp_path / "model.h5").code == 0
    model = ShapeModel.load(tmp_path / "model.h5")
    assert set(model.landmarks) == set(LANDMARKS)
    # They are where the correspondence has them on its mean, between vertices.
    assert model.landmarks == read_surface_landmarks(tmp_path / "same" / "landmarks.csv")
    assert not model.landmarks.are_vertices


def test_a_model_to_begin_with_and_landmarks_of_nobody(run: Run, raw: Path, same: Path, tmp_path: Path) -> None:
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    scans = [raw / "blob1.ply", raw / "blob3.ply"]
    asked = ("correspond", *scans, "-o", tmp_path / "again", *QUICK)
    outcome = run(*asked, "--model", tmp_path / "model.h5")
    assert outcome.code == 0 and "The template is the mean of the model given." in outcome.out
    np.testing.assert_array_equal(
        read_mesh(tmp_path / "again" / "blob1.corresponding.ply").faces, ShapeModel.load(tmp_path / "model.h5").faces
    )
    both = run(*asked, "--model", tmp_path / "model.h5", "--template", scans[0])
    assert both.code == 2 and "omit template or model" in both.sentence()
    assert "is no folder" in run(*asked, "--landmarks", scans[0]).sentence()
    (tmp_path / "marks").mkdir()
    write_landmarks(tmp_path / "marks" / "nobody.csv", {"a": np.zeros(3)})
    assert "is named as one of the scans" in run(*asked, "--landmarks", tmp_path / "marks").sentence()


def test_landmarks_off_the_scan_or_of_two_scans_are_told(run: Run, raw: Path, tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    points = marked(raw_blob(0, points=1500)).landmarks
    write_landmarks(marks / "blob0.csv", {name: point + 4000 for name, point in points.items()})
    write_landmarks(marks / "blob0.json", points)
    scans = [raw / "blob0.ply", raw / "blob2.ply"]
    outcome = run("correspond", *scans, "-o", tmp_path / "same", "--landmarks", marks, *QUICK)
    assert outcome.code == 0 and "check their unit and frame" in outcome.err
    assert "blob0.json is not read, since blob0.csv has landmarks of the same scan" in outcome.err
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "blob0.ply").write_bytes((raw / "blob0.ply").read_bytes())
    two = ("correspond", *scans, tmp_path / "other" / "blob0.ply", "-o", tmp_path / "no", "--landmarks", marks, *QUICK)
    assert "would both take the landmarks" in run(*two).sentence()


def test_a_model_of_another_object_is_told(run: Run, raw: Path, tmp_path: Path) -> None:
    directions, faces = sphere(400)
    longish = [directions * [8.0, 8.0 + k, 100.0] + 30 * np.sin(4 * directions[:, [2]]) * [1, 0, 0] for k in range(4)]
    ShapeModel.fit([Mesh(x, faces, name=str(k)) for k, x in enumerate(longish)], modes=1).save(tmp_path / "model.h5")
    scans = [raw / f"blob{k}.ply" for k in range(2)]
    outcome = run("correspond", *scans, "-o", tmp_path / "same", "--model", tmp_path / "model.h5", *QUICK)
    assert "is excluded" in outcome.err or "probably another kind of object" in outcome.err


def test_scans_that_cannot_be_used_are_named_before_the_first_round(
    run: Run, raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = read_mesh(raw / "blob1.ply")
    assert scan.faces is not None
    vertices = scan.vertices.copy()
    vertices[scan.faces[0, 0], 2] = np.inf
    write_mesh(tmp_path / "hole.ply", Mesh(vertices, scan.faces))
    write_mesh(tmp_path / "flat.ply", Mesh(scan.vertices * (1, 1, 0), scan.faces))

    def stop(*_: object) -> None:
        raise InputError("The template is chosen here.")

    monkeypatch.setattr(correspond, "first_template", stop)
    for strict, excluded in (((), ["flat", "torn"]), (("--strict",), ["flat", "hole", "torn"])):
        scans = (raw, tmp_path / "hole.ply", tmp_path / "flat.ply")
        outcome = run("correspond", *scans, "-o", tmp_path / "o", *QUICK, *strict)
        lines = outcome.err.splitlines()
        named = [line.split()[1] for line in lines if " is excluded: " in line]
        assert sorted(named) == excluded and f"{len(excluded)} of {SCANS + 3} scans are excluded" in outcome.err
        assert lines[-1].endswith("The template is chosen here.") and outcome.code == 2
    _, notes = usable_scan(Mesh(vertices, scan.faces, name="hole"))
    assert any("1 vertex with coordinates that are NaN or infinite, used by" in note for note in notes)
