"""The study on scans of one's own: found by their labels, fitted, classified by person, reported."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from shapespace import cli
from shapespace.io.tables.table_io import write_rows
from shapespace.model.additive import AdditiveModel


def command(*arguments: str) -> int:
    return cli.main([*arguments, "--quiet"])


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of eight people that parts identity and expression, and raw scans of five others, one of them broken."""
    home = tmp_path_factory.mktemp("own")
    shown = "neutral,smile,surprise"
    assert command("data", "faces", "-o", str(home / "training"), "--subjects", "8", "--expressions", shown) == 0
    code = command("build", str(home / "training"), "-o", str(home / "model.h5"),
                   "--additive", str(home / "training" / "labels.csv"))  # fmt: skip
    assert code == 0
    faces = ("data", "faces", "-o", str(home / "scans"), "--subjects", "5", "--seed", "3", "--raw")
    with pytest.MonkeyPatch.context() as patch:
        # The meshes need not be split for so many, which takes four times as long as all the rest of a scan.
        patch.setattr("shapespace.datasets.simulated_scan.PLAIN_TRIANGLES", 16_000)
        assert command(*faces, "--expressions", shown) == 0
    (home / "scans" / "subject_004_smile.ply").write_bytes(b"ply\n")
    return home


@pytest.fixture(scope="module")
def studied(world: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        # Workers that start for a dozen scans take longer than the scans; tests/batch tests them.
        patch.setattr("shapespace.batch.executors.cores", lambda: 1)
        code = command("recognise", "study", "--data", str(world / "scans"), "--model", str(world / "model.h5"),
                       "--folds", "5", "-o", str(world / "study"), "--no-open")  # fmt: skip
    assert code == 0
    return world / "study"


@pytest.mark.long
def test_raw_scans_are_not_in_correspondence(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not (world / "scans" / "landmarks.csv").exists()
    assert command("build", str(world / "scans"), "-o", str(world / "no.h5")) == 2
    assert "shapespace:" in capsys.readouterr().err


def test_the_model_parts_who_and_what(world: Path) -> None:
    model = AdditiveModel.load(world / "model.h5")
    assert model.n_identity <= 7 + 150 and 2 <= model.n_expression <= 16
    assert len(model.shape.landmarks) > 10


@pytest.mark.long
def test_everybody_has_a_prediction_or_counts_as_wrong(studied: Path) -> None:
    made = json.loads((studied / "recognition.json").read_text())
    confusion = next(part for part in made["parts"] if part["kind"] == "confusion")
    assert confusion["classes"] == ["smile", "surprise"]
    assert np.sum(confusion["counts"]) == 9 and "1 without an answer" in confusion["note"]
    told = next(part for part in made["parts"] if part["title"] == "Data and protocol")["text"]
    assert any("1 failed" in line for line in told) and any("5 subjects" in line for line in told)
    rows = next(part for part in made["parts"] if part["title"] == "Classifiers on unseen people")["rows"]
    assert {row[0] for row in rows} == {"all coefficients", "expression coefficients of the additive model"}
    assert {row[1] for row in rows} == {"unknown", "known"}


@pytest.mark.long
def test_it_ends_in_a_report(studied: Path) -> None:
    page = (studied / "report.html").read_text(encoding="utf-8")
    assert "Classifiers on unseen people" in page and 'class="broken"' not in page


@pytest.mark.long
def test_fits_that_are_there_are_kept(world: Path, studied: Path) -> None:
    fit = studied / "fits" / "subject_000_smile.fit.json"
    before = fit.stat().st_mtime_ns
    again = command("recognise", "study", "--data", str(world / "scans"), "--model", str(world / "model.h5"),
                    "--folds", "4", "-o", str(studied), "--no-open")  # fmt: skip
    assert again == 0 and fit.stat().st_mtime_ns == before


@pytest.mark.long
def test_an_expression_is_put_on_somebody_else_from_the_command_line(
    world: Path, studied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = (str(studied / "fits" / f"subject_{name}.fit.json") for name in ("000_neutral", "001_smile"))
    out = world / "moved.ply"
    assert command("recognise", "transfer", str(world / "model.h5"), one, other, "-o", str(out)) == 0
    assert out.stat().st_size > 10_000
    failed = str(studied / "fits" / "subject_004_smile.fit.json")
    assert command("recognise", "transfer", str(world / "model.h5"), one, failed, "-o", str(out)) == 2
    assert "failed, so there is nothing to transfer" in capsys.readouterr().err


@pytest.mark.long
def test_a_fit_of_another_model_is_not_transferred(
    world: Path, studied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = json.loads((studied / "fits" / "subject_000_neutral.fit.json").read_text())
    record["model"]["hash"] = "0" * 64
    (world / "other.fit.json").write_text(json.dumps(record))
    own = str(studied / "fits" / "subject_001_smile.fit.json")
    code = command("recognise", "transfer", str(world / "model.h5"), str(world / "other.fit.json"), own,
                   "-o", str(world / "x.ply"))  # fmt: skip
    assert code == 2 and "another model than model.h5" in capsys.readouterr().err


def test_too_few_people_are_one_sentence(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [(f"subject_{k:03d}_{name}.ply", f"s{k}", name, 1) for k in range(2) for name in ("smile", "surprise")]
    folder = tmp_path / "few"
    folder.mkdir()
    for file, *_ in rows:
        (folder / file).write_bytes((world / "scans" / file).read_bytes())
    write_rows(folder / "labels.csv", ("file", "subject", "expression", "intensity"), rows)
    code = command("recognise", "study", "--data", str(folder), "--model", str(world / "model.h5"),
                   "-o", str(tmp_path / "o"), "--no-open")  # fmt: skip
    assert code == 2 and "at least 4 people" in capsys.readouterr().err


@pytest.mark.long
def test_two_folds_do_and_one_is_refused(
    world: Path, studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(studied, tmp_path / "s")
    asked = ("recognise", "study", "--data", str(world / "scans"), "--model", str(world / "model.h5"),
             "-o", str(tmp_path / "s"), "--no-open")  # fmt: skip
    assert command(*asked, "--folds", "2") == 0
    assert command(*asked, "--folds", "1") == 2
    assert "leave fewer than two to learn from" in capsys.readouterr().err


def test_a_table_without_subjects_cannot_part_them(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rows(tmp_path / "l.csv", ("file", "label"), [("subject_000_neutral.ply", "neutral")])
    built = ("build", str(world / "training"), "-o", str(tmp_path / "m.h5"))
    assert command(*built, "--additive", str(tmp_path / "l.csv")) == 2
    assert "each mesh needs a label and a subject" in capsys.readouterr().err
    assert command(*built, "--expression-variance", "0.9") == 2
    assert "belongs to --additive" in capsys.readouterr().err


def test_without_scans_or_a_model_one_sentence_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("recognise", "study", "-o", str(tmp_path / "o"), "--no-open")
    for arguments in ((), ("--data", str(tmp_path)), ("--model", "m.h5")):
        assert command(*asked, *arguments) == 2
        told = capsys.readouterr().err
        assert "needs both --data DIR and --model" in told and "studies/recognition.py" in told
        assert told.count("\n") == 1 and not (tmp_path / "o").exists()
    assert (Path(__file__).resolve().parents[2] / "studies" / "recognition.py").is_file()
