"""Commands on surfaces in correspondence count those that need review, and reject a majority of them."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from same_blobs import surface, write_same
from shapespace.io.meshes.mesh_io import write_mesh
from synthetic_shapes import raw_scan

Run = Callable[..., Any]
NAMES = tuple(f"blob{k:02d}" for k in range(12))
SOME = "2 of 12 surfaces need review in the correspondence (2 with folded triangles, 1 not settled)"
MOST = "7 of 12 surfaces need review in the correspondence (7 with folded triangles)"
TABLE = "name,group,age,animal,visit\n" + "".join(
    f"{name},{'ab'[k % 2]},{40 + 7 * k},s{k // 2},v{k % 2}\n" for k, name in enumerate(NAMES)
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    monkeypatch.chdir(tmp_path)
    write_same(tmp_path, NAMES, aside=False)
    (tmp_path / "people.csv").write_text(TABLE)
    ss.write_cohort_file("people.toml", "people.csv", shapes="same")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "new.csv").write_text("name\nnew\n")
    write_mesh(tmp_path / "new" / "new.ply", surface("new", 20)[0])
    needs_review(tmp_path, {NAMES[0]: ["folded", "not_settled"], NAMES[5]: ["folded"]})
    return tmp_path


def needs_review(home: Path, reasons: dict[str, Sequence[str]], doubtful: Sequence[str] = ()) -> None:
    file = home / "same" / "correspondence.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"needs_review": reasons, "doubtful": doubtful}))


def majority(home: Path) -> None:
    needs_review(home, {name: ["folded"] for name in NAMES[1:8]})


COHORT = ("people.csv", "--shapes", "same", "-o", "out")
ANALYSES = {
    "compare": ("compare", *COHORT, "~ group", "--permutations", "20"),
    "regress": ("regress", *COHORT, "--target", "age", "--set", "folds=3", "--permutations", "9"),
    "change": ("change", *COHORT, "--set", "subject=animal", "--order", "v0,v1"),
    "score": ("score", "new/new.csv", "--reference", "people.toml", "-o", "out"),
}  # fmt: skip
OTHERS = {
    "build": ("build", "same", "-o", "model.h5"),
    "quality": ("quality", "same", "-o", "out", "--folds", "2", "--samples", "5"),
}


@pytest.mark.parametrize("command", [*ANALYSES, *OTHERS])
def test_inputs_that_need_review_are_counted_first(run: Run, folder: Path, command: str) -> None:
    outcome = run(*{**ANALYSES, **OTHERS}[command])
    assert outcome.code == 0, outcome.err
    assert SOME in outcome.err.splitlines()[0], outcome.err
    if command in ANALYSES:
        counted = SOME.replace("12", "13") if command == "score" else SOME  # the subject is counted too
        assert f"{counted}." in (folder / "out" / "methods.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", [*ANALYSES, *OTHERS])
def test_a_majority_of_inputs_that_need_review_is_rejected_unless_accepted(
    run: Run, folder: Path, command: str
) -> None:
    majority(folder)
    arguments = {**ANALYSES, **OTHERS}[command]
    option = "--set doubtful=yes" if command in ANALYSES else "--with-doubtful"
    outcome = run(*arguments)
    assert outcome.code == 2 and MOST in outcome.sentence() and f"or use {option} to continue" in outcome.sentence()
    outcome = run(*arguments, *option.split())
    assert outcome.code == 0 and MOST in outcome.err, outcome.err


def test_only_the_surfaces_of_the_table_count(run: Run, folder: Path) -> None:
    needs_review(folder, {NAMES[0]: ["folded"], **{name: ["doubtful"] for name in NAMES[2:]}}, NAMES[2:])
    (folder / "people.csv").write_text("name,age\n" + "".join(f"{name},{k}\n" for k, name in enumerate(NAMES[:2])))
    cohort = ss.read_cohort("people.csv", ss.CohortConfig(shapes="same"))
    assert (cohort.review.surfaces, cohort.review.needs_review) == (2, 1)
    assert cohort.notes[0].startswith("1 of 2 surfaces needs review in the correspondence (1 with folded triangles).")


def test_a_completion_names_the_training_surfaces_that_need_review(run: Run, folder: Path) -> None:
    assert run(*OTHERS["build"]).code == 0
    assert SOME in ss.ShapeModel.load("model.h5").provenance
    write_mesh(folder / "scan.ply", raw_scan(np.zeros(5)).scan)
    outcome = run("complete", "model.h5", "scan.ply", "-o", "completed")
    assert f"model.h5: of its training surfaces, {SOME}." in outcome.err
