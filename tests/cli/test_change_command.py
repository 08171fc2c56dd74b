"""`shapespace change` from a table of meshes to an answer, and what it says of tables that it cannot use."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.types import Mesh
from synthetic_shapes import blob, sphere

V = 120
SUBJECTS = 3


@pytest.fixture(scope="module")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of subjects with two scans before and one after, 2 % larger; the last has no second visit."""
    folder, rng = tmp_path_factory.mktemp("visits"), np.random.default_rng(0)
    (folder / "shapes").mkdir()
    d, faces = sphere(V)
    lines = ["file,subject,visit"]
    for k in range(SUBJECTS):
        x = blob(d, 0.5 * rng.standard_normal(5))
        for name, size in (("before_1", 1.0), ("before_2", 1.0), ("after_1", 1.02))[: 3 if k < SUBJECTS - 1 else 1]:
            posed = (size * x + 0.05 * rng.standard_normal(x.shape)) @ Rotation.random(random_state=rng).as_matrix().T
            write_mesh(folder / "shapes" / f"s{k}_{name}.ply", Mesh(posed, faces))
            lines.append(f"s{k}_{name}.ply,s{k},{name[:-2]}")
    (folder / "visits.csv").write_text("\n".join(lines) + "\n")
    write_landmark_indices(folder / "marks.csv", {"top": 3, "low": 90})
    (folder / "part.csv").write_text("vertex\n" + "\n".join(map(str, range(40))))
    return folder


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture
def ask(visits: Path, run: Callable[..., object], tmp_path: Path, monkeypatch) -> Callable[..., object]:
    # Pictures take seconds; they are drawn where the commands of docs/change.md are run.
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")

    def do(*more: object, table: str = "visits.csv") -> object:
        return run("change", visits / table, "--shapes", visits / "shapes", "-o", tmp_path / "out", *more)

    return do


def test_a_table_of_meshes_becomes_an_answer_with_tables_in_millimetres(visits, ask, tmp_path) -> None:
    outcome = ask("--order", "before,after", "--stable", "all", "--set", f"landmarks={visits / 'marks.csv'}",
                  "--region", f"part={visits / 'part.csv'}", "--json")  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "1 of 3 subjects are excluded" in outcome.err
    assert outcome.facts["question"] == "change" and (tmp_path / "out" / "analysis.json").is_file()
    rows = rows_of(tmp_path / "out" / "subjects.csv")
    assert [row["subject"] for row in rows] == ["s0", "s1"]
    assert all(abs(float(row["volume_change_share"]) - 0.0612) < 0.003 for row in rows)
    regions = {row["region"] for row in rows_of(tmp_path / "out" / "regions.csv")}
    assert regions == {"whole", "part"}
    marks = rows_of(tmp_path / "out" / "landmarks.csv")
    assert len(marks) == 4 and float(marks[0]["smallest_detectable_mm"]) > 0


def test_what_cannot_be_used_is_said_in_a_sentence(visits, ask) -> None:
    assert "'visit' contains words (after, before)" in ask().sentence()
    assert "not in the order before,later" in ask("--order", "before,later").sentence()
    assert "no stable region 'brow'" in ask("--order", "before,after", "--stable", "brow").sentence()
    (visits / "far.csv").write_text("name,vertex\nnose,5000\n")
    assert f"have {V}" in ask("--order", "before,after", "--set", f"landmarks={visits / 'far.csv'}").sentence()
    text = (visits / "visits.csv").read_text()
    (visits / "gap.csv").write_text(text.replace("s0_before_2.ply,s0,before", "s0_before_2.ply,s0,"))
    assert "missing=drop" in ask("--order", "before,after", table="gap.csv").sentence()
    dropped = ask("--order", "before,after", "--stable", "all", "--set", "missing=drop", "--quiet", table="gap.csv")
    assert dropped.code == 0 and "1 of 7 shapes are excluded" in dropped.err
