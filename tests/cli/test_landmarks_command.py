"""Landmarks on the command line: those that a fit writes, as single files and out of a store."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import VERTICES, Run, World, Z
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS, read_landmarks, write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray
from synthetic_shapes import raw_scan, similarity

FAST = ("--set", "max_iterations=3", "--quiet")


def test_all_three_files_hold_the_places_on_the_fitted_surface(run: Run, world: World, tmp_path: Path) -> None:
    assert run("fit", world.model, world.scan, "-o", tmp_path, *FAST).code == 0
    surface, landmarks = read_mesh(tmp_path / "scan_0.fitted.ply").vertices, ShapeModel.load(world.model).landmarks
    with (tmp_path / "scan_0.landmarks.csv").open(newline="") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    slicer = json.loads((tmp_path / "scan_0.landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    fcsv = (tmp_path / "scan_0.landmarks.fcsv").read_text().splitlines()
    assert [line[0] for line in fcsv[:3]] == ["#"] * 3
    old = {row[11]: row for row in csv.reader(fcsv[3:])}
    assert list(rows) == [point["label"] for point in slicer] == list(old) == list(landmarks)
    for point in slicer:
        name = point["label"]
        at = surface[landmarks[name]]
        np.testing.assert_allclose([float(rows[name][axis]) for axis in "xyz"], at, atol=1e-5)
        np.testing.assert_allclose(point["position"], at, atol=1e-5)
        np.testing.assert_allclose(np.array(old[name][1:4], dtype=float), at, atol=1e-5)
        stddev = [float(rows[name][f"stddev_{axis}_mm"]) for axis in "xyz"]
        assert all(0 < mm < 20 for mm in stddev)
        assert point["description"] == old[name][12] == "standard deviation {:.2f} {:.2f} {:.2f} mm".format(*stddev)
    for ending in (".csv", ".mrk.json"):
        assert list(read_landmarks(tmp_path / f"scan_0.landmarks{ending}")) == list(landmarks)


def test_a_model_without_landmarks_writes_none_and_removes_those_of_an_earlier_fit_alone(
    run: Run, world: World, tmp_path: Path
) -> None:
    bare = tmp_path / "bare.h5"
    replace(ShapeModel.load(world.model), landmarks={}).save(bare)
    assert run("fit", world.model, world.scans[0], world.scans[1], "-o", tmp_path, *FAST).code == 0
    (tmp_path / "scan_2.landmarks.csv").write_text("name,x,y,z\nmine,1,2,3\n")
    assert run("fit", bare, *world.scans, "-o", tmp_path, *FAST).code == 0
    assert [path.name for path in tmp_path.glob("*.landmarks.*")] == ["scan_2.landmarks.csv"]


def test_a_store_keeps_landmarks_and_export_gives_the_same_files(run: Run, world: World, tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="the extra 'store' is not installed")
    assert run("fit", world.model, world.scan, "-o", tmp_path / "single", *FAST).code == 0
    assert run("fit", world.model, world.scan, "-o", tmp_path / "store", "--store", *FAST).code == 0
    assert list((tmp_path / "store").glob("*.landmarks.*")) == []
    assert run("export", tmp_path / "store", "--all", "-o", tmp_path / "again").code == 0
    for ending in FIDUCIAL_ENDINGS:
        file = f"scan_0{ending}"
        assert (tmp_path / "again" / file).read_bytes() == (tmp_path / "single" / file).read_bytes()


def marks_of(world: World, k: int) -> dict[str, FloatArray]:
    """Return the true places of the model's landmarks on a scan of the world."""
    truth = raw_scan(Z[k], similarity(k, degrees=8.0, scale=1.0), vertices=1000, model_vertices=VERTICES).truth
    return {name: truth[vertex] for name, vertex in ShapeModel.load(world.model).landmarks.items()}


def record_of(folder: Path, name: str) -> dict[str, Any]:
    return json.loads((folder / f"{name}.fit.json").read_text())


def test_a_folder_gives_each_scan_its_landmarks_and_says_what_belongs_to_none(
    run: Run, world: World, tmp_path: Path
) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    write_landmarks(marks / "scan_0.csv", marks_of(world, 0))
    write_landmarks(marks / "scan_1.mrk.json", marks_of(world, 1))
    write_landmarks(marks / "stranger.csv", marks_of(world, 1))
    command = ("fit", world.model, *world.scans, "-o", tmp_path / "o", "--landmarks", marks, "--quiet")
    outcome = run(*command)
    assert outcome.code == 0 and "1 files of landmarks belong to no scan that is given: stranger." in outcome.err
    starts = [record_of(tmp_path / "o", f"scan_{k}")["start"] for k in range(3)]
    assert starts[:2] == ["landmarks", "landmarks"] and starts[2] != "landmarks"
    for k in (0, 1):
        record = record_of(tmp_path / "o", f"scan_{k}")
        assert record["evidence"]["marks_rms_mm"] < 2.0
        for name, at in marks_of(world, k).items():
            assert np.linalg.norm(np.array(record["found_landmarks"][name]["at"]) - at) < 4.0
    assert "3 of 3 scans have valid results" in run(*command).err
    write_landmarks(marks / "scan_0.csv", marks_of(world, 1))
    assert "2 of 3 scans have valid results" in run(*command).err


def test_a_column_of_a_list_names_landmarks_and_goes_before_the_folder(run: Run, world: World, tmp_path: Path) -> None:
    write_landmarks(tmp_path / "picked.csv", marks_of(world, 0))
    rows = [f"{world.scans[0]},picked.csv,ward 3", f"{world.scans[1]},,ward 4", f"{world.scans[2]},gone.csv,ward 5"]
    (tmp_path / "list.csv").write_text("\n".join(["scan,landmarks,ward", *rows]) + "\n")
    for again in range(2):
        outcome = run("fit", world.model, tmp_path / "list.csv", "-o", tmp_path / "o", "--quiet")
        assert outcome.code == 1 and "gone.csv" in outcome.err, again
    found = [record_of(tmp_path / "o", f"scan_{k}") for k in range(3)]
    assert found[0]["landmarks"]["name"] == "picked.csv" and found[1]["landmarks"] is None
    assert [record["metadata"] for record in found] == [{"ward": f"ward {k}"} for k in (3, 4, 5)]
    assert found[2]["status"] == "failed" and "gone.csv" in found[2]["reason"]


def test_landmarks_that_the_fit_would_overwrite_are_refused(run: Run, world: World, tmp_path: Path) -> None:
    marks = tmp_path / "scan_0.landmarks.csv"
    write_landmarks(marks, marks_of(world, 0))
    before = marks.read_bytes()
    outcome = run("fit", world.model, world.scan, "-o", tmp_path, "--landmarks", marks)
    assert outcome.code == 2 and "would be overwritten" in outcome.sentence()
    assert marks.read_bytes() == before


def test_the_standard_deviation_is_told_and_infinity_holds_nothing(run: Run, world: World, tmp_path: Path) -> None:
    write_landmarks(tmp_path / "m.csv", marks_of(world, 0))
    command = ("fit", world.model, world.scan, "-o", tmp_path / "o", "--landmarks", tmp_path / "m.csv", "--quiet")
    assert run(*command, "--set", "landmark_stddev_mm=1.5").code == 0
    record = record_of(tmp_path / "o", "scan_0")
    assert record["config"]["landmark_stddev_mm"] == record["evidence"]["marks_stddev_mm"] == 1.5
    assert run(*command, "--set", "landmark_stddev_mm=inf").code == 0
    assert "marks_stddev_mm" not in record_of(tmp_path / "o", "scan_0")["evidence"]
    assert "which is reused" in run(*command, "--set", "landmark_stddev_mm=inf").err
    assert run(*command, "--set", "landmark_stddev_mm=0").code == 2
