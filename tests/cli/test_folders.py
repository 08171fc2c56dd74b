"""Folders of scans and of results: what is taken, what is said of the rest, and a table of all that is there."""

import csv
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Run, World
from shapespace.batch import progress
from shapespace.batch.progress import FIRST_LOG_LINE_S
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import raw_scan, similarity

FAST = ("--set", "max_iterations=2")
COUNTED = ("converged", "max_iterations", "doubtful", "failed")


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "coefficients.csv").open(newline="") as stream:
        return {row["scan"]: row for row in csv.DictReader(stream)}


def record_of(folder: Path, name: str) -> dict[str, Any]:
    return json.loads((folder / f"{name}.fit.json").read_text())


@pytest.fixture
def tree(world: World, tmp_path: Path) -> Path:
    """scans/a.ply, scans/p1/neutral.ply, scans/p2/neutral.ply, a broken link and a link to a folder."""
    scans = tmp_path / "scans"
    for name, source in zip(("a", "p1/neutral", "p2/neutral"), world.scans, strict=True):
        (scans / name).parent.mkdir(parents=True, exist_ok=True)
        (scans / f"{name}.ply").write_bytes(source.read_bytes())
    (scans / "gone.ply").symlink_to(scans / "nowhere.ply")
    (scans / "more").symlink_to(scans / "p1")
    (scans / ".cache").mkdir()
    return scans


def test_what_is_not_taken_from_a_folder_is_said(run: Run, world: World, tree: Path, tmp_path: Path) -> None:
    outcome = run("fit", world.model, tree, "-o", tree / "out", *FAST, "--quiet", "--json")
    assert outcome.code == 0
    assert outcome.facts["scans"] == 1
    assert outcome.err.splitlines()[:2] == [
        f"shapespace: {tree}: 3 folders are not searched (more, p1, p2); give --recursive to include the meshes there.",
        f"shapespace: {tree}: 1 broken link is not used (gone.ply); repair or remove it.",
    ]
    # The folder of the results is none of scans.
    again = run("fit", world.model, tree, "-o", tree / "out", *FAST, "--quiet", "--json")
    assert again.err.splitlines()[:2] == outcome.err.splitlines()[:2]
    said = run("check", tree, "--json")
    assert len(said.facts) == 1 and "--recursive" in said.err and "gone.ply" in said.err
    empty = run("fit", world.model, tree.parent, "-o", tmp_path / "o")
    assert empty.code == 2 and "contains no meshes; give --recursive" in empty.sentence()


def test_recursive_takes_folders_below_and_tells_scans_apart_by_their_path(run: Run, world: World, tree: Path) -> None:
    out = tree / "out"
    for _ in range(2):  # what the first run wrote is no scan
        outcome = run("fit", world.model, tree, "-o", out, *FAST, "--recursive", "--json", "--quiet")
        assert outcome.code == 0
        assert {record["name"]: record["scan"]["path"] for record in outcome.facts["records"]} == {
            "a": "../a.ply", "p1_neutral": "../p1/neutral.ply", "p2_neutral": "../p2/neutral.ply",
        }  # fmt: skip
        assert "1 link to a folder is not followed (more)" in outcome.err
    assert {name: row["path"] for name, row in rows_of(out).items()} == {
        "a": "../a.ply", "p1_neutral": "../p1/neutral.ply", "p2_neutral": "../p2/neutral.ply",
    }  # fmt: skip
    assert len(run("check", tree, "--json", "--recursive").facts) == 3 + 3
    elsewhere = run("fit", world.model, tree, "-o", tree.parent / "o", *FAST, "--recursive", "--json", "--quiet")
    assert elsewhere.facts["scans"] == 3, "surfaces beside their records are results"
    assert "3 surfaces of earlier fits are not taken" in elsewhere.err
    text = run("fit", world.model, tree, "-o", out, *FAST, "--recursive").out
    assert "p1_neutral (neutral.ply): " in text and "\na.ply: " in "\n" + text


def test_a_scan_given_by_its_folder_and_by_its_name_is_fitted_once(run: Run, world: World, tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / "a.ply").write_bytes(world.scan.read_bytes())
    outcome = run("fit", world.model, scans, scans / "a.ply", "-o", tmp_path / "o", *FAST, "--json")
    assert outcome.code == 0 and [record["name"] for record in outcome.facts["records"]] == ["a"]
    assert "given more than once are fitted once: 1 of 2." in outcome.err
    assert list(rows_of(tmp_path / "o")) == ["a"]


def test_build_takes_folders_below_too(run: Run, world: World, tmp_path: Path) -> None:
    for k, mesh in enumerate(sorted(world.meshes.glob("*.ply"))):
        folder = tmp_path / "meshes" / f"person{k // 3}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / mesh.name).write_bytes(mesh.read_bytes())
    assert run("build", tmp_path / "meshes", "-o", tmp_path / "m.h5").code == 2
    built = run("build", tmp_path / "meshes", "-o", tmp_path / "m.h5", "--recursive", "--json")
    assert built.facts["training_shapes"] == 12


def test_further_scans_join_the_table_and_the_report_counts_the_same(run: Run, world: World, tmp_path: Path) -> None:
    for scan in world.scans:
        outcome = run("fit", world.model, scan, "-o", tmp_path, *FAST, "--json", "--quiet")
        assert [record["name"] for record in outcome.facts["records"]] == [scan.stem]
    rows = rows_of(tmp_path)
    assert list(rows) == [scan.stem for scan in world.scans]
    assert len(rows) == len(list(tmp_path.glob("*.fit.json")))
    before = rows["scan_1"]
    run("fit", world.model, world.scans[1], "-o", tmp_path, "--quiet")
    after = rows_of(tmp_path)
    assert sorted(after) == sorted(rows) and after["scan_1"]["status"] != before["status"]


def test_the_terminal_prints_overlap_distances_and_how_many_more_scans_there_are(
    run: Run, world: World, tmp_path: Path
) -> None:
    half = raw_scan(np.zeros(5), similarity(3, 8.0, 1.0), vertices=2000, keep=-0.1, noise_mm=0.1).scan
    for k in range(12):
        write_mesh(tmp_path / f"half_{k:02d}.ply", half)
    outcome = run("fit", world.model, tmp_path, "-o", tmp_path / "o", "--quiet", "--jobs", 1)
    lines = outcome.out.splitlines()
    listed = [line for line in lines if line.startswith("half_")]
    assert len(listed) == 10
    assert f"and 2 more scans; all are in {tmp_path / 'o' / 'coefficients.csv'}" in lines
    shown = record_of(tmp_path / "o", "half_00")["shown"]
    assert shown["model_seen_share"] < 0.8
    assert listed[0].replace("->", "→") == (
        f"half_00.ply: converged: mean distance model→scan {shown['model_to_scan']['mean']:.2f} mm "
        f"({100 * shown['model_seen_share']:.0f} % overlap), scan→model {shown['scan_to_model']['mean']:.2f} mm "
        f"({100 * shown['scan_covered_share']:.0f} % overlap)"
    )


def test_distances_of_a_scan_of_another_size_are_in_its_own_millimetres(run: Run, world: World, tmp_path: Path) -> None:
    mesh = read_mesh(world.scan)
    write_mesh(tmp_path / "large.ply", mesh.with_vertices(1.3 * mesh.vertices))
    outcome = run("fit", world.model, tmp_path / "large.ply", "-o", tmp_path, "--unit", "mm", "--quiet")
    record = record_of(tmp_path, "large")
    assert run("fit", world.model, world.scan, "-o", tmp_path, "--unit", "mm", "--quiet").code == 0
    usual = record_of(tmp_path, world.scan.stem)["shown"]
    for direction in ("model_to_scan", "scan_to_model"):
        assert f" {record['shown'][direction]['mean']:.2f} mm (" in outcome.out
        assert record["shown"][direction]["mean"] == pytest.approx(1.3 * usual[direction]["mean"], rel=0.05)


@pytest.fixture
def surfaces(run: Run, world: World, tmp_path: Path) -> list[Path]:
    """Dense surfaces of three scans, one of them doubtful."""
    out = tmp_path / "dense"
    assert run("fit", world.model, *world.scans, "-o", out, "--dense", "--quiet", "--jobs", 1).code == 0
    record = record_of(out, "scan_1")
    (out / "scan_1.fit.json").write_text(json.dumps({**record, "status": "doubtful"}))
    return sorted(out.glob("*.dense.ply"))


def test_build_leaves_surfaces_of_doubtful_fits_out_and_says_so(run: Run, surfaces: list[Path], tmp_path: Path) -> None:
    outcome = run("build", *surfaces, "-o", tmp_path / "m.h5", "--json")
    assert outcome.code == 0 and outcome.facts["training_shapes"] == 2
    assert "1 surface of a doubtful fit is excluded (scan_1.dense.ply); --with-doubtful includes them." in outcome.err
    taken = run("build", *surfaces, "-o", tmp_path / "m.h5", "--json", "--with-doubtful")
    assert taken.facts["training_shapes"] == 3
    assert "1 surface of a doubtful fit is taken too (scan_1.dense.ply)." in taken.err
    alone = run("build", surfaces[1], "-o", tmp_path / "alone.h5")
    assert alone.code == 2 and "--with-doubtful" in alone.sentence()
    # A mesh without a record is what its owner says it is.
    (surfaces[1].parent / "scan_1.fit.json").unlink()
    assert run("build", *surfaces, "-o", tmp_path / "m.h5", "--json").facts["training_shapes"] == 3


def test_build_of_dense_surfaces_keeps_the_landmarks_of_the_model_that_fitted_them(
    run: Run, world: World, surfaces: list[Path], tmp_path: Path
) -> None:
    parent = ShapeModel.load(world.model)
    outcome = run("build", *surfaces, "-o", tmp_path / "m.h5")
    assert dict(ShapeModel.load(tmp_path / "m.h5").landmarks) == dict(parent.landmarks) != {}
    assert "Landmarks are those of " in outcome.err and world.model.name in outcome.err
    write_landmark_indices(tmp_path / "own.csv", {"mine": 3})
    run("build", *surfaces, "-o", tmp_path / "m.h5", "--landmarks", tmp_path / "own.csv")
    assert dict(ShapeModel.load(tmp_path / "m.h5").landmarks) == {"mine": 3}
    record = record_of(surfaces[0].parent, "scan_0")
    record["model"]["path"] = "../gone.h5"
    (surfaces[0].parent / "scan_0.fit.json").write_text(json.dumps(record))
    lost = run("build", *surfaces, "-o", tmp_path / "m.h5")
    assert lost.code == 0 and "no longer at" in lost.err
    assert not ShapeModel.load(tmp_path / "m.h5").landmarks
    record["model"]["hash"] = "0" * 64
    (surfaces[0].parent / "scan_0.fit.json").write_text(json.dumps(record))
    assert "fitted by different models" in run("build", *surfaces, "-o", tmp_path / "m.h5").err


@pytest.mark.parametrize("command", ["fit", "correspond"])
def test_a_folder_of_scans_that_is_not_there_leaves_nothing(
    run: Run, world: World, tmp_path: Path, command: str
) -> None:
    model = [world.model] if command == "fit" else []
    ended = run(command, *model, tmp_path / "absent", "-o", tmp_path / "out")
    assert ended.code == 2 and "there is no such file or folder" in ended.sentence()
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_not_there_stops_a_batch_before_it_starts(run: Run, world: World, tmp_path: Path) -> None:
    ended = run("fit", world.model, world.scan, tmp_path / "absent", "-o", tmp_path / "out")
    assert ended.code == 2 and f"{tmp_path / 'absent'}: there is no such file or folder" in ended.sentence()
    assert not (tmp_path / "out").exists()


def test_a_log_says_once_what_takes_long_unless_asked_for_quiet(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = (
        (("fit", world.model, world.scan, "-o", tmp_path), "shapespace: fitting 1 scan ..."),
        (
            ("build", world.meshes, "-o", tmp_path / "m.h5"),
            "shapespace: aligning 12 meshes and finding their modes ...",
        ),
    )
    for command, _ in commands:
        assert "..." not in run(*command).err, "short work is not worth a line"
    assert FIRST_LOG_LINE_S == 5.0
    monkeypatch.setattr(progress, "FIRST_LOG_LINE_S", 0.0)
    for command, line in commands:
        assert run(*command).err.splitlines().count(line) == 1
        assert "..." not in run(*command, "--quiet").err


def test_a_log_says_how_far_a_long_step_is_ever_more_rarely(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "FIRST_LOG_LINE_S", 0.05)
    monkeypatch.setattr(progress, "LONGEST_PAUSE_S", 0.1)
    with progress.steps(None, "permuting", "step", quiet=False) as step:
        for done in range(1, 9):
            step(done, 8)
            time.sleep(0.05)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 6
    assert lines[0].startswith("shapespace: permuting steps: ") and " of 8 done ..." in lines[0]
    counted = [int(line.split(": ")[2].split(" of ")[0]) for line in lines]
    assert counted == sorted(counted) and counted[-1] > counted[0]
    with progress.steps(None, "permuting", "step", quiet=True) as step:
        step(1, 2)
        time.sleep(0.2)
    assert not capsys.readouterr().err


def test_meshes_that_check_has_mirrored_and_the_others_are_one_collection(
    run: Run, world: World, tmp_path: Path
) -> None:
    """Left bones as they are and right ones mirrored have the same vertices, and triangles the other way round."""
    files, left, right = sorted(world.meshes.glob("*.ply")), tmp_path / "left", tmp_path / "right"
    for number, file in enumerate(files):
        mesh = read_mesh(file)
        (right if number % 2 else left).mkdir(exist_ok=True)
        if number % 2:
            mesh = mesh.with_vertices(mesh.vertices * [-1.0, 1.0, 1.0])
        write_mesh((right if number % 2 else left) / file.name, mesh)
    assert run("check", right, "-o", tmp_path / "mirrored", "--mirror").code == 0
    known = run("build", world.meshes, "-o", tmp_path / "known.h5", "--json").facts
    built = run("build", left, tmp_path / "mirrored", "-o", tmp_path / "model.h5", "--json").facts
    assert built["training_shapes"] == known["training_shapes"] == len(files)
    assert built["stddev_mm"] == pytest.approx(known["stddev_mm"], rel=1e-4)
