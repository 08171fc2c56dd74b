"""The simulated study: nobody is tested who was trained on, what is done is kept, and every table is there."""

import json
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import FileFormatError, InputError
from shapespace.model.additive import AdditiveModel

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
import recognition
import shape_space_tables
import shape_spaces
import simulated
import tables
from shape_spaces import ShapeSpaces
from simulated import StudyConfig, prepare_folder, run_fits
from study_fits import model_path, person_path, read_fits
from study_people import StudyPeople

SMALL = StudyConfig(
    people=StudyPeople(people=6, expressions=("smile", "surprise", "anger"), levels=(0.5, 1.0), triangles=5_000),
    folds=2, taught_levels=1, identity_modes=0.99, expression_modes=0.99, strangers=2, stranger_levels=(1.0,),
)  # fmt: skip

of_a_study = pytest.mark.long  # a study of a few people alone takes a minute to make


@pytest.fixture(scope="module")
def done(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("study") / "s"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SHAPESPACE_DATA", str(shared_data))
        prepare_folder(folder, SMALL)
        run_fits(folder, SMALL, workers=2)
        yield folder


def test_each_person_is_tested_in_one_fold_and_taught_in_the_others() -> None:
    fold = StudyConfig().fold_of()
    assert len(fold) == 100 and np.bincount(fold).tolist() == [25, 25, 25, 25]
    taught = StudyConfig().taught(7)
    assert taught[0] == 0 and sorted(taught[taught > 0]) == list(range(1, 13))


@of_a_study
def test_a_folds_model_knows_nobody_who_is_tested_in_it(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    faces = StudyPeople.faces

    def spy(self: StudyPeople, ict: object, person: int, **rest: object) -> object:
        asked.append(person)
        return faces(self, ict, person, **rest)

    monkeypatch.setattr(StudyPeople, "faces", spy)
    again = done.parent / "again"
    again.mkdir()
    simulated._make_model(again, SMALL, 0)
    assert set(asked) == set(np.flatnonzero(SMALL.fold_of() != 0).tolist())
    one, other = (AdditiveModel.load(model_path(folder, 0)) for folder in (again, done))
    assert np.allclose(one.shape.mean, other.shape.mean, atol=1e-9)


@of_a_study
def test_raw_scans_are_fitted_to_a_few_millimetres_from_any_pose(done: Path) -> None:
    fits = read_fits([person_path(done, p) for p in range(6)], 400)
    own = SMALL.fold_of()[fits.person]
    status = fits.status[own, np.arange(len(own))]
    assert (status != simulated.STATUSES.index("failed")).all()
    assert np.median(fits.error_mm) < 6  # three people and their mirror images make the model
    other = fits.z[1 - own, np.arange(len(own))]
    taught = np.concatenate([SMALL.taught(p) for p in range(6)]) >= 0
    assert np.array_equal(np.isfinite(other).all(axis=1), taught)


@of_a_study
def test_what_is_done_is_kept_and_what_is_not_is_made(done: Path) -> None:
    path = person_path(done, 2)
    before = path.stat().st_mtime_ns
    gone = person_path(done, 3)
    content = gone.read_bytes()
    gone.unlink()
    told: list[tuple[str, int, int]] = []
    run_fits(done, SMALL, workers=1, on_progress=lambda *step: told.append(step))
    assert path.stat().st_mtime_ns == before
    with np.load(path) as kept, np.load(gone) as made:
        assert kept["z"].shape == made["z"].shape
    with np.load(gone) as made:
        assert gone.stat().st_size == len(content) and np.isfinite(made["error_mm"]).all()
    assert ("people", 5, 6) in told and ("people", 6, 6) in told


@of_a_study
def test_a_folder_of_another_study_is_refused(done: Path) -> None:
    with pytest.raises(InputError, match="a study with other settings"):
        prepare_folder(done, replace(SMALL, folds=3))
    with pytest.raises(InputError, match="cannot be parted into 4 folds"):
        replace(SMALL, folds=4)


@of_a_study
def test_a_damaged_file_is_named(done: Path, tmp_path: Path) -> None:
    (tmp_path / "person_000.npz").write_bytes(person_path(done, 0).read_bytes()[:200])
    with pytest.raises(FileFormatError, match=r"person_000\.npz is damaged; delete it"):
        read_fits([tmp_path / "person_000.npz"], 40)


@of_a_study
def test_every_table_is_made_and_the_report_shows_it(done: Path, tmp_path: Path) -> None:
    from shapespace.report.pages.write_html import write_report

    folder = tmp_path / "s"
    shutil.copytree(done, folder)
    path = tables.make_tables(folder, SMALL, seconds={"fits": 60.0})
    made = json.loads(path.read_text())
    titles = [part["title"] for part in made["parts"]]
    for wanted in (
        "Six approaches, one classifier, the same folds", "Classifiers on the additive model's expressions",
        "All four intensities", "Calibration of the probabilities", "Accuracy by number of training people",
        "Modes that carry the decision", "Parts of the face that carry the decision",
        "Whose face it is, from expressive scans", "How far identity and expression are apart",
        "Trained on ICT-FaceKit, tested on the bundled generator", "One person's expression put on others",
        "The lines of figure 9",
    ):  # fmt: skip
        assert wanted in titles
    approaches = next(part for part in made["parts"] if part["title"].startswith("Six approaches"))
    assert {row[0].split(",")[0] for row in approaches["rows"]} >= {
        "one PCA (the paper)", "hard hierarchy", "soft hierarchy", "additive", "bilinear", "continuous",
    }  # fmt: skip
    assert {target["what"] for target in made["targets"]} >= {"Additive model against one PCA, unseen people"}
    report = write_report(folder).read_text(encoding="utf-8")
    assert 'class="broken"' not in report and "cannot be compared with those published" in report


SPACES = ShapeSpaces(
    training=10, people=1, modes=4, counts=(8,), triangles=4_000, taught=3, tested=1,
    recognised=("vertices", "bspline-detail 8x8"),
)  # fmt: skip


@of_a_study
def test_shape_spaces_are_compared_in_tables_of_the_report_and_go_on(
    done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In this process, where fewer expressions can be asked for; worker processes made what is done.
    monkeypatch.setattr(simulated, "_pool", lambda _: ThreadPoolExecutor(1))
    for module in (shape_spaces, shape_space_tables):
        monkeypatch.setattr(module, "expressive_people", lambda seed: replace(SMALL.people, seed=seed))
    run_study = recognition.run_study
    folder = tmp_path / "s"
    shutil.copytree(done, folder)
    report = run_study(folder, SMALL, workers=2, quiet=True, compared=SPACES).read_text(encoding="utf-8")
    assert 'class="broken"' not in report and "Vertices and control points at 4 modes" in report
    made = json.loads((folder / "recognition.json").read_text())
    tables_of = {part["title"].split(",")[0].split(":")[0]: part for part in made["parts"] if part["kind"] == "table"}
    names = ["vertices", "bspline 8x8", "bspline-detail 8x8"]
    assert [row[0] for row in tables_of["Vertices and control points at 4 modes"]["rows"]] == names
    damaged = {row[0]: row[1:] for row in tables_of["The same models made of damaged meshes"]["rows"]}
    assert all(floor > 0 for floor in damaged["vertices"]) and damaged["bspline 8x8"][2] > 0
    assert len(tables_of["Expressions told in each shape space"]["rows"]) == 2
    overlap = {tuple(row[:2]): row[3] for row in tables_of["What lies double when a face is laid out flat"]["rows"]}
    assert overlap["ICT-FaceKit", "cylinder"] > 0.02 and overlap["ICT-FaceKit", "disc"] < 1e-6
    before = {path: path.stat().st_mtime_ns for path in (folder / "shape_spaces").rglob("*.json")}
    gone = next(path for path in before if path.parent.name == "fits")
    gone.unlink()
    for name in ("make_tables", "write_report"):  # seen above
        monkeypatch.setattr(recognition, name, lambda *_, **__: folder)
    run_study(folder, SMALL, workers=1, quiet=True, compared=SPACES)
    assert {p for p, at in before.items() if p.stat().st_mtime_ns != at} == {gone}
    with pytest.raises(InputError, match="was measured with other settings"):
        run_study(folder, SMALL, workers=1, quiet=True, compared=replace(SPACES, modes=3))
    gone.write_text("{")
    with pytest.raises(FileFormatError, match="is damaged; delete it"):
        run_study(folder, SMALL, workers=1, quiet=True, compared=SPACES)


def test_arguments_that_do_not_go_together_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["-o", str(tmp_path / "o"), "--no-open", "--quiet", "--people", "3", "--folds", "3"]
    assert recognition.main(asked) == 2
    assert "cannot be parted into 3 folds" in capsys.readouterr().err
