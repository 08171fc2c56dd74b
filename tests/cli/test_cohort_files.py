"""A cohort file says once what all questions about its shapes need, and --set changes it for one answer."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from same_blobs import VERTICES, write_same
from shapespace.cohort.cohort import Cohort
from shapespace.errors import FileFormatError, InputError

Run = Callable[..., Any]
NAMES = tuple(f"blob{k:02d}" for k in range(10))


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    monkeypatch.chdir(tmp_path)
    write_same(tmp_path, NAMES, aside=False)
    rows = [f"{name},{'ab'[k % 2]},{'' if k == 3 else 40 + k},s{k // 2}" for k, name in enumerate(NAMES)]
    (tmp_path / "people.csv").write_text("\n".join(["name,group,age,animal", *rows]))
    return tmp_path


def terms(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "terms.csv").read_text(encoding="utf-8").splitlines()))


def test_a_question_on_a_cohort_file_is_the_question_with_its_settings(run: Run, home: Path) -> None:
    written = run("cohort", "people.csv", "--shapes", "same", "--gauge", "form", "-o", "bones.toml")
    assert written.code == 0 and "10 surfaces" in written.out and "gauge form" in written.out, written.err
    asked = ("~ group", "--permutations", 20)
    run("compare", "bones.toml", *asked, "-o", "by-file")
    run("compare", "people.csv", *asked, "--shapes", "same", "--set", "gauge=form", "-o", "by-settings")
    run("compare", "bones.toml", *asked, "--set", "gauge=shape", "-o", "changed")
    assert terms(Path("by-file")) == terms(Path("by-settings")) != terms(Path("changed"))
    assert json.loads(Path("changed/analysis.json").read_text())["settings"]["gauge"] == "shape"


def test_the_file_can_be_moved_with_its_data_and_is_read_from_elsewhere(home: Path, tmp_path: Path) -> None:
    ss.write_cohort_file(home / "bones.toml", home / "people.csv", shapes=home / "same", missing="drop")
    assert (home / "bones.toml").read_text() == 'data = "people.csv"\nshapes = "same"\nmissing = "drop"\n'
    moved = home.parent / f"{home.name}-moved"
    shutil.move(home, moved)
    cohort = ss.read_cohort(moved / "bones.toml")
    assert cohort.names == NAMES and cohort.drop_missing
    assert len(cohort.complete(["age"])) == len(NAMES) - 1
    moved.rename(home)


def test_each_setting_of_the_file_reaches_the_cohort(home: Path) -> None:
    (home / "marks.csv").write_text("name,vertex\ntop,5\n")
    views = {"views": [{"name": "dorsal", "toward_viewer": [0, 0, 1], "up": [0, 1, 0]}]}
    (home / "views.json").write_text(json.dumps(views))
    chosen: dict[str, Any] = {
        "subject": "animal",
        "unit": "none",
        "gauge": "form",
        "landmarks": "marks.csv",
        "orientation": "views.json",
    }
    ss.write_cohort_file("bones.toml", "people.csv", shapes="same", **chosen)
    cohort = ss.read_cohort("bones.toml")
    assert cohort.table.texts("subject") == cohort.table.texts("animal")
    assert (cohort.unit, cohort.gauge) == ("", "form")
    assert cohort.landmarks is not None and cohort.landmarks.names == ("top",)
    assert cohort.orientation is not None and [view.name for view in cohort.orientation.views] == ["dorsal"]
    same = ss.read_cohort("people.csv", ss.CohortConfig(shapes="same", **chosen))
    assert np.array_equal(same.coefficients, cohort.coefficients) and same.table.columns == cohort.table.columns


@pytest.mark.parametrize(
    ("text", "error", "told"),
    [
        ('data = "people.csv"\nguage = "form"', FileFormatError, "has a setting 'guage', which cohorts do not have"),
        ('shapes = "same"', FileFormatError, "needs a text as its data"),
        ('data = "people.csv"\ndoubtful = "yes"', FileFormatError, "needs true or false as its doubtful"),
        ('data = "people.csv"\nimputations = 2.5', FileFormatError, "needs a whole number as its imputations"),
        ('data = "people.csv"\nleast = 1', FileFormatError, "has a setting 'least'"),
        ('data = "people.csv"\ngauge = "size"', InputError, "there is no gauge 'size'"),
        ('data = "people.csv"\nsubject = "who"\nshapes = "same"', InputError, "has no column 'who'"),
        ('data = "people.csv"\nlandmarks = "far.csv"\nshapes = "same"', InputError, f"the surfaces have {VERTICES}"),
        ("data = people.csv", FileFormatError, "is not a TOML file"),
        ("\xff\xfe", FileFormatError, "is not a TOML file"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_one_sentence(
    run: Run, home: Path, text: str, error: type[Exception], told: str
) -> None:
    (home / "far.csv").write_text("name,vertex\nnose,5000\n")
    (home / "bad.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(error, match=told):
        ss.read_cohort("bad.toml")
    outcome = run("compare", "bad.toml", "~ group", "-o", "out")
    assert outcome.code == 2 and told in outcome.sentence() and not (home / "out").exists()


def test_settings_are_given_in_one_place(home: Path) -> None:
    ss.write_cohort_file("bones.toml", "people.csv", shapes="same")
    with pytest.raises(InputError, match="contains the settings of the cohort"):
        ss.read_cohort("bones.toml", ss.CohortConfig(gauge="form"))
    with pytest.raises(InputError, match=r"needs the ending \.toml"):
        ss.write_cohort_file("bones.txt", "people.csv")
    with pytest.raises(InputError, match="there is no missing 'skip'"):
        ss.write_cohort_file("other.toml", "people.csv", missing="skip")
    assert not Path("bones.txt").exists() and not Path("other.toml").exists()


def test_a_cohort_that_cannot_be_read_has_no_file(run: Run, home: Path) -> None:
    (home / "people.csv").write_text("name\nnobody\n")
    outcome = run("cohort", "people.csv", "--shapes", "same", "-o", "bones.toml")
    assert outcome.code == 2 and outcome.sentence() and not (home / "bones.toml").exists()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("--set", "gauge"), "'gauge' is not NAME=VALUE"),
        (("--set", "guage=form"), "there is no setting 'guage'; choose gauge"),
        (("--set", "permutations=20"), "permutations is an option; write --permutations 20"),
        (("--set", "gauge=size"), "gauge is 'size'; choose from form, shape"),
        (("--set", "maps=perhaps"), "maps must be yes or no, not 'perhaps'"),
        (("--set", "seed=x"), "seed 'x' is not an integer"),
        (("--gauge", "form"), "there is no option --gauge; write --set gauge=VALUE"),
        (("--drop-missing",), "there is no option --drop-missing"),
    ],
)
def test_a_setting_that_is_wrong_is_refused_with_what_is_accepted(
    run: Run, home: Path, given: tuple[str, ...], told: str
) -> None:
    outcome = run("compare", "people.csv", "~ group", "-o", "out", *given)
    assert outcome.code == 2 and outcome.err.startswith("usage: shapespace compare") and told in outcome.err


def test_figures_draw_the_chosen_views_of_an_answer(run: Run, home: Path) -> None:
    def view(name: str, front: list[int]) -> dict[str, Any]:
        return {"name": name, "toward_viewer": front, "up": [0, 1, 0]}

    (home / "same" / "orientation.json").write_text(
        json.dumps({"views": [view("front", [0, 0, 1]), view("side", [1, 0, 0])]})
    )
    run("compare", "people.csv", "~ group", "--shapes", "same", "--permutations", 20, "-o", "out")
    drawn = run("figures", "out", "--format", "svg,png", "--dpi", 80, "--views", "side")
    assert drawn.code == 0, drawn.err
    endings = {path.suffix for path in (home / "out" / "figures").iterdir()}
    assert endings == {".svg", ".png", ".txt"}
    assert "the views are front, side" in run("figures", "out", "--views", "dorsal").sentence()
    assert "choose from svg, pdf, png" in run("figures", "out", "--format", "gif").sentence()
    assert run("figures", "same", "--dpi", 80).out == "5 files in same/figures\n"  # of a correspondence
    (home / "empty").mkdir()
    assert "contains no fits" in run("figures", "empty").sentence()


def test_missing_values_are_dropped_by_every_question_of_a_cohort_that_says_so() -> None:
    shapes = np.random.default_rng(0).standard_normal((6, 5, 3))
    cohort = Cohort.of_shapes(shapes, {"age": [1, 2, None, 4, 5, 6]})
    with pytest.raises(InputError, match="missing=drop"):
        cohort.complete(["age"], numbers=["age"])
