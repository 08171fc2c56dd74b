"""Scans are added to a finished correspondence, registered again or removed, and the rest stays bit for bit."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_correspond_stopped import after, counted, no_temporary_files

from conftest import Outcome, Run
from raw_blobs import LANDMARKS, dispersion_mm, marked, raw_blob
from shapespace.batch import parallel_rounds as rounds
from shapespace.cli import main
from shapespace.commands import correspond
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import faces_of
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

pytestmark = pytest.mark.usefixtures("few_modes")
OLD = 5
"""Scans, which with an added one are enough to judge it by."""
QUIET = ("--jobs", "1", "--quiet")
SETTINGS = ("--vertices", "300", "--rounds", "2", *QUIET)


def scan(k: int) -> Mesh:
    return raw_blob(k, points=700).scan


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    for k in range(OLD):
        write_mesh(folder / f"blob{k}.ply", scan(k))
    return folder


@pytest.fixture(scope="module")
def finished(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "same"
    template = ("--template", str(raw / "blob0.ply"))
    assert main(["correspond", str(raw), "-o", str(folder), *SETTINGS, *template]) == 0
    return folder


@pytest.fixture
def same(finished: Path, raw: Path, tmp_path: Path) -> Path:
    """Return a copy of the finished correspondence, with its scans beside it and settings that take less time."""
    shutil.copytree(raw, tmp_path / "scans")
    folder = shutil.copytree(finished, tmp_path / "same")
    for file in folder.glob("*.correspond.json"):
        record = json.loads(file.read_text("utf-8"))
        record["path"] = f"../scans/{record['name']}.ply"
        file.write_text(json.dumps(record), "utf-8")
    summary = json.loads((folder / "correspondence.json").read_text("utf-8"))
    for name in ("first", "next"):
        summary["settings"][name] |= {"iterations": 8, "harmonics": 100, "points": 500}
    (folder / "correspondence.json").write_text(json.dumps(summary | {"results_hash": ""}), "utf-8")
    return folder


def files(folder: Path, *without: str) -> dict[str, bytes]:
    """Return the files of a correspondence but the summary and those of some scans."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "correspondence.json" and path.name.split(".")[0] not in without
    }


def results(folder: Path) -> dict[str, object]:
    """Return the files of a correspondence without CPU times."""
    return {
        name: json.loads(content) | {"cpu_s": 0} if name.endswith(".json") else content
        for name, content in files(folder).items()
    }


def summary(folder: Path) -> dict[str, object]:
    return json.loads((folder / "correspondence.json").read_text("utf-8"))


def record(folder: Path, name: str) -> dict[str, object]:
    return json.loads((folder / f"{name}.correspond.json").read_text("utf-8"))


def surface(folder: Path, name: str) -> FloatArray:
    return read_mesh(folder / f"{name}.corresponding.ply").vertices


def new(folder: Path, **scans: Mesh) -> Path:
    folder.mkdir(exist_ok=True)
    for name, mesh in scans.items():
        write_mesh(folder / f"{name}.ply", mesh)
    return folder


def add(run: Run, same: Path, *scans: Path, options: tuple[object, ...] = ()) -> Outcome:
    return run("correspond", *scans, "--add", "-o", same, *QUIET, *options)


@pytest.mark.long
def test_an_added_scan_changes_no_other_file_and_is_registered_once(
    run: Run, same: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files(same)
    outcome = add(run, same, new(tmp_path / "new", blob5=scan(5)), tmp_path / "scans" / "blob0.ply")
    assert outcome.code == 0 and "1 scan was registered to the mean" in outcome.err
    assert files(same, "blob5") == before
    assert summary(same)["corresponding"] == [f"blob{k}" for k in range(OLD + 1)]
    assert summary(same)["added"] == ["blob5"] and not (same / ".rounds").exists()
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    done, after_it = counted(monkeypatch), files(same)
    again = add(run, same, tmp_path / "new", tmp_path / "scans")
    assert again.code == 0 and "nothing is computed" in again.err and not done
    assert files(same) == after_it


@pytest.mark.long
def test_an_added_surface_is_near_that_of_all_scans_together(
    run: Run, finished: Path, raw: Path, tmp_path: Path
) -> None:
    same = shutil.copytree(finished, tmp_path / "same")
    added = new(tmp_path / "new", blob5=scan(5))
    assert add(run, same, added).code == 0
    options = (*SETTINGS, "--template", raw / "blob0.ply")
    assert run("correspond", raw, added, "-o", tmp_path / "joint", *options).code == 0
    joint = read_mesh(tmp_path / "joint" / "blob5.corresponding.ply")
    near = build_engine(joint).query(surface(same, "blob5")).distance
    assert near.mean() < 0.5 and near.max() < 5.0
    blobs, names = [raw_blob(k, points=700) for k in range(OLD + 1)], [f"blob{k}" for k in range(OLD + 1)]
    apart = [dispersion_mm(blobs, [surface(folder, name) for name in names]) for folder in (same, tmp_path / "joint")]
    assert apart[0] < 1.1 * apart[1]


@pytest.mark.long
def test_odd_scans_are_added_or_excluded_as_in_a_run_and_none_by_the_others(
    run: Run, same: Path, tmp_path: Path
) -> None:
    whole, (directions, faces) = scan(5), sphere(700, 0.9)
    assert whole.faces is not None
    half = whole.faces[(whole.vertices[whole.faces] @ [1.0, 0.3, 0.2]).mean(axis=1) > 75.0]
    odd = new(
        tmp_path / "new",
        blob5=whole,
        metres=whole.with_vertices(1e-3 * whole.vertices),
        cloud=Mesh(whole.vertices, None),
        rod=Mesh(directions * [20.0, 180.0, 20.0], faces),
        flat=Mesh(whole.vertices * [1, 1, 0], whole.faces),
        piece=Mesh(whole.vertices, half),
    )
    shutil.copy(odd / "blob5.ply", odd / "copy.ply")
    (odd / "torn.ply").write_text("ply\n", "utf-8")
    before, alone = files(same), shutil.copytree(same, tmp_path / "alone" / "same")
    shutil.copytree(tmp_path / "scans", tmp_path / "alone" / "scans")
    outcome = add(run, same, odd)
    assert outcome.code == 1 and files(same, *(path.stem for path in odd.iterdir())) == before
    aside = summary(same)["set_aside"]
    assert isinstance(aside, dict) and {"rod", "flat", "torn"} <= set(aside) <= {"rod", "flat", "torn", "piece"}
    assert record(same, "metres")["unit_ratio"] == 0.001 and summary(same)["other_units"] == {"metres": 0.001}
    np.testing.assert_allclose(1e3 * surface(same, "metres"), surface(same, "blob5"), atol=1e-3)
    assert np.linalg.norm(surface(same, "cloud") - surface(same, "blob5"), axis=1).mean() < 2.0
    assert not any("times the usual distance" in str(note) for note in (record(same, "cloud")["notes"], outcome.err))
    notes = [str(record(same, name)["notes"]) for name in ("blob5", "copy")]
    assert any("again; exclude one of the two" in note for note in notes)
    assert add(run, alone, odd / "blob5.ply").code == 0
    np.testing.assert_array_equal(surface(alone, "blob5"), surface(same, "blob5"))


def test_redo_is_removal_and_addition_of_the_file_as_it_is_now(run: Run, same: Path, tmp_path: Path) -> None:
    other = shutil.copytree(same, tmp_path / "other")
    write_mesh(tmp_path / "scans" / "blob2.ply", scan(7))
    before = files(same, "blob2")
    refused = add(run, same, tmp_path / "scans")
    assert refused.code == 2 and "--redo blob2" in refused.sentence() and "differs" in refused.err
    assert run("correspond", "--redo", "blob2", "-o", same, *QUIET).code == 0
    assert files(same, "blob2") == before and summary(same)["added"] == ["blob2"]
    assert run("correspond", "--remove", "blob2", "-o", other, *QUIET).code == 0
    assert files(other) == before and "blob2" not in str(summary(other)["corresponding"])
    assert add(run, other, tmp_path / "scans").code == 0
    assert results(other) == results(same)
    for folder, option in ((same, "--redo"), (same, "--redo")):
        assert "nothing is computed" in run("correspond", option, "blob2", "-o", folder, *QUIET).err


def test_redo_takes_a_given_file_of_that_name(run: Run, same: Path, tmp_path: Path) -> None:
    moved = new(tmp_path / "moved", blob1=scan(8), blob3=scan(9))
    before = files(same, "blob1")
    assert run("correspond", moved, "--redo", "blob1", "-o", same, *QUIET).code == 0
    assert files(same, "blob1") == before and str(record(same, "blob1")["path"]).endswith("moved/blob1.ply")
    other = run("correspond", moved, "--redo", "blob2", "-o", same, *QUIET)
    assert other.code == 2 and "None of the given scans is named blob2" in other.sentence()


def test_landmarks_correct_a_scan_where_others_have_them_too(run: Run, same: Path, tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    for k in range(3):
        write_landmarks(marks / f"blob{k}.csv", marked(raw_blob(k, points=700)).landmarks)
    before = files(same, "blob2")
    outcome = run("correspond", "--redo", "blob2", "--landmarks", marks, "-o", same, *QUIET)
    assert outcome.code == 0 and files(same, "blob2") == before
    assert set(record(same, "blob2")["landmark_distances"]) == set(LANDMARKS)
    assert 0 <= record(same, "blob2")["landmark_rms"] < 15
    again = run("correspond", "--update", "-o", same, *QUIET)
    assert again.code == 2 and "give them again with --landmarks" in again.sentence()
    # A list states the landmarks of its scans, so that it can state that there are none.
    listed = tmp_path / "list.csv"
    listed.write_text("id,file\nblob2,scans/blob2.ply\n")
    assert run("correspond", listed, "--redo", "blob2", "-o", same, *QUIET).code == 0
    assert not record(same, "blob2")["landmark_distances"]


def test_update_computes_mean_and_surfaces_anew_from_all_scans(
    run: Run, same: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files(same)
    options = ("--add", "--update", "-o", same, *QUIET)
    line = ("correspond", new(tmp_path / "new", blob5=scan(5)), *options)
    assert run(*line).code == 0
    now = files(same)
    assert set(now) == {*before, "blob5.correspond.json", "blob5.corresponding.ply"}
    assert not any(now[name] == content for name, content in before.items())
    assert summary(same)["added"] == [] and len(summary(same)["rounds"]) == 3
    moved = np.linalg.norm(surface(same, "blob1") - read_mesh_of(before, "blob1", tmp_path), axis=1)
    assert 0 < moved.mean() < 4.0
    done = counted(monkeypatch)
    assert "nothing is computed" in run(*line).err and not done
    write_mesh(tmp_path / "scans" / "blob4.ply", scan(6))
    changed = run("correspond", "--update", "-o", same, *QUIET)
    assert changed.code == 2 and "run --redo blob4 before --update" in changed.sentence()
    (tmp_path / "scans" / "blob4.ply").unlink()
    gone = run("correspond", "--update", "-o", same, *QUIET)
    assert gone.code == 2 and "--update reads all scans again, and blob4 is broken: " in gone.sentence()
    assert files(same) == now


def read_mesh_of(content: dict[str, bytes], name: str, folder: Path) -> FloatArray:
    (folder / "before.ply").write_bytes(content[f"{name}.corresponding.ply"])
    return read_mesh(folder / "before.ply").vertices


def test_refusals_are_one_sentence_and_change_nothing(run: Run, same: Path, tmp_path: Path) -> None:
    added, empty = new(tmp_path / "new", blob5=scan(5)), tmp_path / "empty"
    unfinished = shutil.copytree(same, tmp_path / "unfinished")
    (unfinished / "correspondence.json").unlink()
    all_but_one = [word for k in range(1, OLD) for word in ("--remove", f"blob{k}")]
    before = (files(same), summary(same))
    for line, said in (
        ((added, "--add", "-o", empty), "contains no finished correspondence, and --add needs one"),
        ((added, "--add", "-o", unfinished), "contains no finished correspondence"),
        (("--redo", "nobody", "-o", same), "--redo nobody: "),
        (("--remove", "nobody", "-o", same), "has no scan of that name; it has blob0, blob1, blob2, blob3, blob4."),
        ((*all_but_one, "-o", same), "--remove leaves 1 of the scans"),
        ((added, "--remove", "blob0", "-o", same), "omit the files"),
        (("--add", "-o", same), "--add needs scans"),
        (("-o", same), "Give scans"),
        ((added, "--add", "--vertices", "400", "-o", same), "was computed with --vertices 300"),
        ((added, "--add", "--outer", "-o", same), "was computed without --outer"),
        ((added, "--add", "--rounds", "1", "-o", same), "omit --rounds"),
        ((added, "--add", "--template", added / "blob5.ply", "-o", same), "omit --template"),
        ((added, "--add", "--model", "m.h5", "-o", same), "omit --model"),
    ):
        outcome = run("correspond", *line, *QUIET)
        assert outcome.code == 2 and said in outcome.sentence(), outcome.err
    assert (files(same), summary(same)) == before and not empty.exists()
    outcome = run("correspond", added, "--add", "--redo", "blob0", "-o", same, *QUIET)
    assert outcome.code == 2 and "not allowed with argument" in outcome.err


def test_a_correspondence_with_the_removed_option_symmetric_is_read_but_not_changed(
    run: Run, same: Path, tmp_path: Path
) -> None:
    added, file = new(tmp_path / "new", blob5=scan(5)), same / "correspondence.json"
    record = json.loads(file.read_text())
    record["settings"]["symmetric"] = True
    file.write_text(json.dumps(record))
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    outcome = run("correspond", added, "--add", "-o", same, *QUIET)
    assert outcome.code == 2 and "was computed with the setting symmetric" in outcome.sentence(), outcome.err
    record["settings"]["symmetric"] = False
    file.write_text(json.dumps(record))
    assert add(run, same, added).code == 0


def test_the_settings_of_the_run_may_be_repeated(run: Run, same: Path, tmp_path: Path) -> None:
    added = new(tmp_path / "new", blob5=scan(5))
    assert add(run, same, added, options=("--vertices", "300", "--rounds", "2")).code == 0


def test_damaged_files_are_refused(run: Run, same: Path, tmp_path: Path) -> None:
    assert run("correspond", "--remove", "blob4", "-o", same, *QUIET).code == 0  # with a hash of its files
    mean, one, other = same / "template" / "mean.ply", same / "blob1.corresponding.ply", same / "blob2.correspond.json"
    mesh, small = read_mesh(mean), raw_blob(0, points=400).scan
    rolled = Mesh(mesh.vertices, np.roll(faces_of(mesh), 1, axis=1))
    turned = new(tmp_path / "turned", mean=rolled, small=small)
    for file, content, said in (
        (mean, (turned / "mean.ply").read_bytes(), "and template/mean.ply have different triangles"),
        (one, (turned / "mean.ply").read_bytes(), "blob1.corresponding.ply and template/mean.ply have different"),
        (mean, (turned / "small.ply").read_bytes(), "mean.ply has 400 vertices, and the correspondence 700"),
        (mean, b"damaged", "mean.ply"),
        (one, (same / "blob0.corresponding.ply").read_bytes(), "its files were changed after the correspondence"),
        (one, None, "blob1.corresponding.ply"),
        (other, b"{", "blob2.correspond.json"),
    ):
        was = file.read_bytes()
        file.unlink() if content is None else file.write_bytes(content)
        outcome = run("correspond", "--redo", "blob0", "-o", same, *QUIET)
        assert outcome.code == 2 and said in outcome.sentence()
        file.write_bytes(was)
    assert run("correspond", "--redo", "blob0", "-o", same, *QUIET).code == 0


def test_after_an_interrupt_the_folder_is_as_before_and_the_same_command_goes_on(
    run: Run, same: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    added, before = new(tmp_path / "new", blob5=scan(5), blob6=scan(6)), (files(same), summary(same))
    whole = shutil.copytree(same, tmp_path / "whole")
    assert run("correspond", added, "--add", "-o", whole, *QUIET).code == 0
    with monkeypatch.context() as stopped:
        stopped.setattr(rounds, "_write", after(1, rounds._write, KeyboardInterrupt()))
        assert add(run, same, added).code == 130
    assert {name: x for name, x in files(same).items() if ".rounds" not in name} == before[0]
    assert summary(same) == before[1] and no_temporary_files(tmp_path)
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    with monkeypatch.context() as stopped:
        stopped.setattr(correspond, "write_mesh", after(1, correspond.write_mesh, KeyboardInterrupt()))
        assert add(run, same, added).code == 130
    assert summary(same) == before[1] and run("build", same, "-o", tmp_path / "model.h5").code == 0
    done = counted(monkeypatch)
    assert add(run, same, added).code == 0
    assert not done and results(same) == results(whole)
    assert summary(same) | {"results_hash": ""} == summary(whole) | {"results_hash": ""}


@pytest.mark.parametrize("moves", [0, 1, 7])
def test_a_change_that_is_stopped_as_its_files_are_moved_is_completed(
    run: Run, same: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    line = ("correspond", "--update", "-o", same, *QUIET)
    with monkeypatch.context() as stopped:
        stopped.setattr(correspond, "move_file", after(moves, correspond.move_file, KeyboardInterrupt()))
        assert run(*line).code == 130
    outcome = run("build", same, "-o", tmp_path / "model.h5")
    assert outcome.code == 2 and "not finished; run shapespace correspond again" in outcome.sentence()
    done = counted(monkeypatch)
    again = run(*line)
    assert again.code == 0 and not done and "nothing is computed" in again.err
    assert not (same / ".change").exists() and run("build", same, "-o", tmp_path / "model.h5").code == 0
    assert run("correspond", "--remove", "blob0", "-o", same, *QUIET).code == 0  # its hash is that of its files
