"""A model of several parts in the commands that are for models of one part too."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stored_fits
from conftest import Run
from jointed_parts import PARTS, knees, write_knees
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import sphere


@pytest.fixture
def knee(run: Run, tmp_path: Path) -> Path:
    write_knees(tmp_path / "same", knees(8, seed=1))
    assert run("build", tmp_path / "same", "-o", tmp_path / "knee.h5", "--gauge", "form").code == 0
    return tmp_path / "knee.h5"


def test_a_model_of_fits_of_parts_has_the_parts(run: Run, knee: Path, tmp_path: Path) -> None:
    (tmp_path / "fits").mkdir()
    used = {"name": knee.name, "hash": ShapeModel.load(knee).content_hash, "path": "../knee.h5"}
    for k, mesh in enumerate(knees(3, seed=5)):
        write_mesh(tmp_path / "fits" / f"{mesh.name}.fitted.ply", mesh)
        record = json.dumps(stored_fits.record(mesh.name, k) | {"model": used})
        (tmp_path / "fits" / f"{mesh.name}.fit.json").write_text(record, encoding="utf-8")
    built = run("build", tmp_path / "fits", "-o", tmp_path / "again.h5")
    assert built.code == 0, built.err
    assert ShapeModel.load(tmp_path / "again.h5").part_counts == PARTS
    added = run("build", tmp_path / "same", "--add", knee, "-o", tmp_path / "more.h5")
    assert added.code == 2 and "is of shapes and relative poses" in added.sentence()


def test_quality_of_a_folder_of_parts_has_exact_rotations(run: Run, knee: Path, tmp_path: Path) -> None:
    few = ("--folds", "2", "--samples", "2", "--modes", "1", "--json")
    facts = run("quality", tmp_path / "same", "-o", tmp_path / "q", *few).facts
    assert facts["settings"]["representation"] == "articulated" and facts["settings"]["parts"] == PARTS


def test_convert_names_the_parts_of_a_model_whose_file_does_not(run: Run, knee: Path, tmp_path: Path) -> None:
    converted = run("convert", knee, tmp_path / "knee.bin")
    assert "The parts femur, tibia are omitted" in converted.out and "parts that turn" in converted.out
    assert run("convert", tmp_path / "knee.bin", tmp_path / "named.h5", "--parts", *PARTS).code == 0
    assert ShapeModel.load(tmp_path / "named.h5").part_counts == PARTS
    refused = run("convert", tmp_path / "knee.bin", tmp_path / "named.h5", "--parts", "femur")
    assert refused.code == 2 and "2 separate pieces" in refused.sentence()


def test_an_export_of_parts_states_that_they_are_tangent(run: Run, knee: Path, tmp_path: Path) -> None:
    same = ("--shapes", tmp_path / "same", "--set", "gauge=form")
    exported = run("export", tmp_path / "people.csv", *same, "--to", "tps", "-o", tmp_path / "knees.tps")
    assert exported.code == 0 and "those that turn by large angles shrink" in exported.err


@pytest.mark.parametrize(("wider_mm", "differs"), [(0.0, False), (1.5, True)])
def test_sides_that_are_parts_are_compared_by_the_symmetry_of_the_object(
    run: Run, tmp_path: Path, wider_mm: float, differs: bool
) -> None:
    points, faces = sphere(120)
    rng, subjects = np.random.default_rng(2), []
    for k in range(8):
        width = rng.normal()
        left, right = (
            points * [10.0 + width + more, 30.0, 12.0] + [25.0, 0.0, 0.0] + 0.1 * rng.normal(size=points.shape)
            for more in (0.2 * rng.normal(), 0.2 * rng.normal() + wider_mm)
        )
        pose = Rotation.random(random_state=rng).as_matrix()
        vertices = np.concatenate([left, right * [-1.0, 1.0, 1.0]]) @ pose.T
        subjects.append(Mesh(vertices, np.concatenate([faces, faces[:, ::-1] + len(points)]), name=f"s{k}"))
    table = write_knees(tmp_path / "same", subjects, {"left": len(points), "right": len(points)})
    more = ("--shapes", tmp_path / "same", "--set", "gauge=form", "--permutations", "50", "--json")
    result = run("asymmetry", table, *more, "-o", tmp_path / "sides")
    assert result.code == 0, result.err
    with (tmp_path / "sides" / "anova.csv").open(encoding="utf-8") as lines:
        p_of = {row["source"]: row["p"] for row in csv.DictReader(lines)}
    assert (float(p_of["side"]) < 0.05) == differs
