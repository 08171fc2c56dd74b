"""`compare` from a table to a report, and people with a known effect to try it on."""

import csv
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from shapespace.datasets.faces import chin_of, load_faces
from shapespace.io.meshes.mesh_io import read_mesh

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")


def people(run: Run, folder: Path, *more: str) -> Path:
    assert run("data", "faces", "-o", folder, "--subjects", "12", "--area", "face", *more).code == 0
    return folder / "labels.csv"


def test_a_table_becomes_a_report_with_all_its_numbers(run: Run, tmp_path: Path) -> None:
    table = people(run, tmp_path / "people", "--effect", "4")
    told = run("compare", table, "~ sex", "--permutations", "40", "--json", "-o", tmp_path / "answer")
    assert told.code == 0, told.err
    assert told.facts["question"] == "compare"
    assert told.facts["settings"]["permutations"] == 40
    assert (tmp_path / "answer" / "report.html").stat().st_size > 50_000
    with (tmp_path / "answer" / "terms.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["term"] for row in rows] == ["sex", "residual", "total"]
    low, high = (read_mesh(tmp_path / "answer" / f"effect_1_{end}.ply") for end in ("low", "high"))
    assert low.faces is not None and high.faces is not None
    assert np.array_equal(low.faces, high.faces)


def test_unequal_variances_effect_size_and_no_unit_are_settings_of_the_answer(run: Run, tmp_path: Path) -> None:
    table = people(run, tmp_path / "people", "--effect", "4")
    settings = [word for name in ("maps=no", "effect_size=log", "unit=none") for word in ("--set", name)]
    more = ("--permutations", "40", "--variances", "unequal", *settings, "--json")
    told = run("compare", table, "~ sex", *more, "-o", tmp_path / "answer")
    assert told.code == 0, told.err
    settings, methods = told.facts["settings"], told.facts["methods"]
    assert settings["unequal_variances"] is True and settings["effect_size"] == "log"
    assert methods["unit"] == "" and methods["unequal_variances"] is True and methods["effect_size"] == "log"
    assert [test["resampling"] for test in methods["tests"]] == ["sign flips"]
    assert not any(" mm" in sentence for sentence in told.facts["summary"])


def test_a_formula_that_cannot_be_ends_in_one_sentence(run: Run, tmp_path: Path) -> None:
    table = people(run, tmp_path / "people")
    for formula, word in (("~ weight", "no column"), ("~ __import__('os')", "__import__"), ("~ expression", "groups")):
        told = run("compare", table, formula, "-o", tmp_path / "answer")
        assert told.code != 0
        assert word in told.sentence()
    assert not (tmp_path / "answer").exists()


def test_an_effect_moves_the_chins_of_men_and_nothing_else(run: Run, tmp_path: Path) -> None:
    with_effect, without = (tmp_path / name for name in ("with", "without"))
    table = people(run, with_effect, "--effect", "3")
    people(run, without)
    with table.open(encoding="utf-8") as lines:
        known = list(csv.DictReader(lines))
    assert {row["sex"] for row in known} == {"female", "male"}
    assert all(20 <= float(row["age"]) <= 70 for row in known)
    faces = load_faces()
    weights = faces.template.with_vertices(np.column_stack([chin_of(faces)] * 3))
    chin = faces.cut_to_face(weights).vertices[:, 0]
    for row in known:
        one, other = (read_mesh(folder / row["file"]).vertices for folder in (with_effect, without))
        moved = np.linalg.norm(one - other, axis=1)
        assert np.abs(moved - (3 * chin if row["sex"] == "male" else 0)).max() < 0.01


def test_effects_that_cannot_be_are_refused(run: Run, tmp_path: Path) -> None:
    told = run("data", "faces", "-o", tmp_path / "a", "--effect", "99")
    assert "between -20.0 and 20.0 mm" in told.sentence()
    told = run("data", "faces", "-o", tmp_path / "b", "--effect", "2", "--source", "ict-facekit")
    assert "omit --effect" in told.sentence()
