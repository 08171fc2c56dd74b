"""Questions about a folder of objects of several parts, as `correspond --parts` writes it."""

import csv
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from jointed_parts import PARTS, knees, write_knees
from shapespace.io.meshes.mesh_io import read_mesh

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def test_compare_answers_for_each_part_the_relative_pose_and_all_together(run: Run, tmp_path: Path) -> None:
    table = write_knees(tmp_path / "same", knees(12, seed=1, bend=30.0))
    more = ("--permutations", "60", "--shapes", tmp_path / "same", "--set", "gauge=form")
    result = run("compare", table, "~ sex", *more, "--json", "-o", tmp_path / "answer")
    assert result.code == 0, result.err
    answer, facts = tmp_path / "answer", result.facts
    tests = rows_of(answer / "parts.csv")
    assert [row["part"] for row in tests] == ["femur", "tibia", "relative pose"]
    assert float(tests[2]["p_of_all_parts"]) < 0.06 < float(tests[0]["p_of_all_parts"])
    assert [row["term"] for row in rows_of(answer / "terms.csv")] == ["sex", "residual", "total"]
    summary = " ".join(facts["summary"])
    for words in ("shape including relative pose", "the shape of femur", "the shape of tibia", "elative pose"):
        assert words in summary or words.capitalize() in summary, summary
    assert "sex f to m: tibia to femur rotates by" in summary
    pose = rows_of(answer / "pose.csv")
    assert len(pose) == 12 and pose[0]["specimen"] == "s00" and pose[0]["joint"] == "tibia to femur"
    means = {(row["group"], row["component"]): row for row in rows_of(answer / "pose_means.csv")}
    men, mean = means["sex m", "rotation 3, degrees"], np.mean([float(row["rotation_3_degrees"]) for row in pose[1::2]])
    assert float(men["mean"]) == pytest.approx(mean, abs=1e-3) and men["subjects"] == "6"
    assert float(men["low"]) < mean < float(men["high"])
    change = rows_of(answer / "pose_changes.csv")[0]
    assert np.linalg.norm([float(change[f"rotation_{k}_degrees"]) for k in (1, 2, 3)]) > 10.0
    assert len(read_mesh(answer / "part_1_effect_1_low.ply").vertices) == PARTS["femur"]
    with np.load(answer / "part_2_effect_1.npz") as maps:
        assert maps["normal_mm"].shape == (PARTS["tibia"],)
    assert facts["settings"]["parts"] == PARTS
    assert "Holm" in " ".join(facts["methods"]["corrected_over"])
    page = (answer / "report.html").read_text(encoding="utf-8")
    assert "Parts and relative pose" in page and "femur: sex f to m" in page


def test_covariation_takes_the_parts_as_modules(run: Run, tmp_path: Path) -> None:
    table = write_knees(tmp_path / "same", knees(10, seed=2))
    for test in ("integration", "modularity"):
        result = run("test", test, table, "--shapes", tmp_path / "same", "--permutations", "40", "-o", tmp_path / test)
        assert result.code == 0, result.err
        assert "femur – tibia" in result.out + (tmp_path / test / "analysis.json").read_text(encoding="utf-8")


def test_a_part_that_is_missing_is_counted_in_the_answer(run: Run, tmp_path: Path) -> None:
    subjects = knees(10, seed=3)
    subjects[0].vertices.setflags(write=True)
    subjects[0].vertices[PARTS["femur"] :] = np.nan
    table = write_knees(tmp_path / "same", subjects)
    more = ("--permutations", "40", "--shapes", tmp_path / "same", "--set", "maps=no", "--json")
    result = run("compare", table, "~ sex", *more, "-o", tmp_path / "answer")
    assert result.code == 0, result.err
    assert [row["shapes"] for row in rows_of(tmp_path / "answer" / "parts.csv")] == ["10", "9", "9"]
    assert any("1 of 10 shapes lack tibia and are excluded (s00)" in note for note in result.facts["notes"])


def test_impossible_options_have_one_sentence(run: Run, tmp_path: Path) -> None:
    table = write_knees(tmp_path / "same", knees(8, seed=4))
    more = ("--shapes", tmp_path / "same", "-o", tmp_path / "answer")
    result = run("compare", table, "~ sex", "--pose-axes", "hip,knee,ankle", *more)
    assert result.code != 0 and "three landmarks" in result.sentence()
    one = write_knees(tmp_path / "one", knees(8, seed=4), {})
    result = run(
        "compare", one, "~ sex", "--pose-axes", "0,1,2", "--shapes", tmp_path / "one", "-o", tmp_path / "answer"
    )
    assert result.code != 0 and "needs shapes of several parts" in result.sentence()
    for test, words in (("integration", "or shapes of several parts"), ("modularity", "needs shapes of several parts")):
        result = run("test", test, one, "--shapes", tmp_path / "one", "-o", tmp_path / "answer")
        assert result.code != 0 and words in result.sentence()
    other = write_knees(tmp_path / "other", knees(8, seed=4), {"femur": 80, "foot": 50})
    result = run("compare", other, "~ sex", "--shapes", tmp_path / "other", "-o", tmp_path / "answer")
    assert result.code != 0 and "have 130 vertices" in result.sentence()
    assert not (tmp_path / "answer").exists()
