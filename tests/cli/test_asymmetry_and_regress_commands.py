"""`shapespace asymmetry` and `regress`: from a table and meshes to the files of an answer, or one sentence."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import Mesh
from symmetric_object import posed, symmetric_object

Run = Callable[..., Any]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Twelve subjects, each measured twice, whose age goes with how tall they are."""
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    monkeypatch.chdir(tmp_path)
    thing, rng = symmetric_object(40, 10), np.random.default_rng(0)
    tall = rng.standard_normal(12)
    both = thing.smooth(rng, 12)
    shapes = thing.x * (1 + 0.15 * tall[:, None, None] * [0, 1, 0]) + both + thing.image(both) / 2
    shapes = posed(np.repeat(shapes, 2, axis=0) + 0.1 * rng.standard_normal((24, *thing.x.shape)), rng)
    for k, x in enumerate(shapes):
        write_mesh(tmp_path / f"s{k:02d}.ply", Mesh(x, thing.faces))
    rows = [(f"s{k:02d}.ply", f"p{k // 2}", 50 + 10 * tall[k // 2], "case" if k < 6 else "control") for k in range(24)]
    with (tmp_path / "people.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([("file", "subject", "age", "group"), *rows])
    with (tmp_path / "pairs.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([("one", "other"), *thing.pairs])
    return tmp_path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_asymmetry_of_meshes_is_kept_as_tables_arrays_and_meshes(run: Run, folder: Path) -> None:
    outcome = run("asymmetry", "people.csv", "-o", "out", "--pairs", "pairs.csv", "--reference", "group=control",
                  "--permutations", "19", "--json")  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert outcome.facts["question"] == "asymmetry" and outcome.facts["settings"]["subjects"] == 12
    rows = table(folder / "out" / "subjects.csv")
    assert [row["in_reference"] for row in rows] == ["0"] * 3 + ["1"] * 9
    assert all(float(row["low_mm"]) <= float(row["asymmetry_mm"]) <= float(row["high_mm"]) for row in rows)
    assert [row["source"] for row in table(folder / "out" / "anova.csv")][:3] == [
        "individual",
        "side",
        "individual x side",
    ]
    assert (folder / "out" / "symmetric_mean.ply").is_file()
    with np.load(folder / "out" / "asymmetry.npz") as arrays:
        assert arrays["symmetric"].shape == arrays["asymmetric"].shape == (12, *arrays["vertices"].shape)


def test_what_is_learned_predicts_new_shapes_now_and_later(run: Run, folder: Path) -> None:
    rows = (folder / "people.csv").read_text().splitlines()
    (folder / "new.csv").write_text("\n".join([rows[0], *rows[23:25]]) + "\n")
    (folder / "old.csv").write_text("\n".join(rows[:23]) + "\n")
    outcome = run("regress", "old.csv", "--target", "age", "-o", "out", "--set", "folds=5", "--permutations", "9",
                  "--predict", "new.csv", "--set", "gauge=form")  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "2 new shapes are predicted" in outcome.out and "11 subjects are a small sample" in outcome.out
    now = table(folder / "out" / "new.csv")
    later = run("regress", "new.csv", "--predictor", "out/predictor.npz", "-o", "later")
    assert later.code == 0, later.err
    again = table(folder / "later" / "new.csv")
    assert [float(row["predicted"]) for row in now] == pytest.approx(
        [float(row["predicted"]) for row in again], abs=1e-6
    )
    known = float(rows[23].split(",")[2])
    assert float(now[0]["predicted"]) == pytest.approx(known, abs=5)


def test_mean_shapes_along_a_number_are_kept_as_meshes_and_tables(run: Run, folder: Path) -> None:
    settings = ("--set", "hold=group=control", "--set", "gauge=form", "--permutations", "100")
    along = ("--along", "age", "--at", "45,50,55", "--covariates", "group")
    outcome = run("regress", "people.csv", *along, "-o", "out", *settings)
    assert outcome.code == 0, outcome.err
    first = outcome.out.splitlines()[0]
    assert first.startswith("Shape changes with age (p 0.01): ") and "between 12 subjects" in first
    assert "with group control" in outcome.out
    rows = table(folder / "out" / "shapes.csv")
    assert [float(row["age"]) for row in rows] == [45, 50, 55]
    size = [float(row["centroid_size_mm"]) for row in rows]
    assert size[0] < size[1] < size[2], "they are taller"
    assert float(rows[1]["centroid_size_low_mm"]) < size[1] < float(rows[1]["centroid_size_high_mm"])
    tall = [float(np.ptp(read_mesh(folder / "out" / f"age_{age}.ply").vertices[:, 1])) for age in (45, 50, 55)]
    assert tall[0] < tall[1] < tall[2]
    with np.load(folder / "out" / "shapes.npz") as arrays:
        np.testing.assert_allclose(arrays["shapes"][1], read_mesh(folder / "out" / "age_50.ply").vertices, atol=1e-4)


def test_mean_shapes_of_landmarks_have_intervals_along_the_axes(run: Run, folder: Path) -> None:
    meshes = [read_mesh(path) for path in sorted(folder.glob("s*.ply"))]
    header = "specimen,landmark,x,y,z"
    lines = [f"s{k:02d},L{m},{x},{y},{z}" for k, mesh in enumerate(meshes)
             for m, (x, y, z) in enumerate(mesh.vertices[:9])]  # fmt: skip
    (folder / "marks.csv").write_text("\n".join([header, *lines]) + "\n")
    outcome = run("regress", "people.csv", "--shapes", "marks.csv", "--along", "age", "--length", "L0,L5", "-o", "out",
                  "--permutations", "100")  # fmt: skip
    assert outcome.code == 0, outcome.err
    rows = table(folder / "out" / "landmarks.csv")
    assert len(rows) == 5 * 9 and all(float(row["x_low"]) <= float(row["x"]) <= float(row["x_high"]) for row in rows)
    assert "L0_to_L5" in table(folder / "out" / "shapes.csv")[0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["asymmetry", "people.csv", "--reference", "control"], "write COLUMN=VALUE"),
        (["asymmetry", "people.csv", "--reference", "group=nobody"], "0 subjects have group nobody"),
        (["asymmetry", "people.csv", "--set", "subject=who"], "has no column 'who'"),
        (["asymmetry", "people.csv", "--pairs", "none.csv"], "none.csv"),
        (["regress", "people.csv", "--target", "group"], "'group' is 'case' at s00, which is no number"),
        (["regress", "people.csv", "--target", "age", "--predict", "people.csv"], "were learned from too"),
        (["regress", "people.csv", "--target", "age", "--set", "level=2"], "level of intervals"),
        (["regress", "people.csv", "--along", "group"], "contains classes"),
        (["regress", "people.csv", "--along", "age", "--at", "500"], "shapes are not predicted beyond, at 500"),
        (["regress", "people.csv", "--along", "age", "--set", "curve=spline"], "12 subjects are too few"),
        (["regress", "people.csv", "--along", "age", "--covariates", "group", "--set", "hold=group=x"], "held at 'x'"),
        (["regress", "people.csv", "--along", "age", "--predict", "people.csv"], "--predict needs --target"),
        (["regress", "people.csv", "--target", "age", "--at", "50"], "--at needs --along"),
        (["regress", "people.csv", "--predictor", "people.csv"], "make it again with shapespace regress"),
    ],
)
def test_what_cannot_be_is_one_sentence(run: Run, folder: Path, arguments: list[str], said: str) -> None:
    outcome = run(*arguments, "-o", "out", "--quiet")
    assert outcome.code == 2 and said in outcome.sentence()
