"""Landmarks on the command line: those that a fit writes, as single files and out of a store."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import Run, World
from shapespace.io.fiducials import FIDUCIAL_ENDINGS
from shapespace.io.landmarks import read_landmarks
from shapespace.io.meshes import read_mesh
from shapespace.model.shape_model import ShapeModel

FAST = ("--max-iterations", "3", "--quiet")


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
