"""The commands `recognise train` and `recognise predict`: files in and out, exit codes, one sentence for bad input."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from conftest import Run, World
from shapespace.batch.fit_records import coefficient_row, failed_record, write_coefficients, write_record
from shapespace.errors import InputError
from shapespace.io.tables.table_io import write_rows
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import File, FitRecord

pytest.importorskip("sklearn", reason="the extra `recognise` is not installed")

HASH = "a" * 64
NAMES = ("anger", "fear", "smile", "neutral")


def make_results(folder: Path, people: int, seed: int, model_hash: str = HASH) -> Path:
    """Write records, coefficients.csv and labels.csv as `fit` and `data faces` would, without fitting."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    rows, labels = [], []
    for person in range(people):
        who = 2.0 * rng.standard_normal(4)
        for axis, name in enumerate(NAMES):
            z = who + 0.2 * rng.standard_normal(4) + (2.0 * np.eye(4)[axis] if name != "neutral" else 0.0)
            fit = f"p{person}_{name}"
            final = {d: dict.fromkeys(("mean", "median", "rms", "p95", "max", "count"), 1.0)
                     for d in ("model_to_scan", "scan_to_model")}  # fmt: skip
            record = {
                "format": "shapespace fit", "format_version": 1, "scan": {"name": f"{fit}.ply", "hash": "x"},
                "model": {"name": "m.h5", "hash": model_hash}, "status": "converged", "reason": "Fine.",
                "b": z.tolist(), "z": z.tolist(), "b_stddev": [0.1] * 4,
                "T_scan_model": {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [0.0] * 3},
                "mm_per_scan_unit": 1.0, "distances_mm": {"final": final},
            }  # fmt: skip
            typed = FitRecord.from_json(record, fit)
            write_record(folder / f"{fit}.fit.json", typed)
            rows.append(coefficient_row(fit, typed))
            labels.append((f"{fit}.ply", f"p{person}", name))
    write_coefficients(folder / "coefficients.csv", rows, 4)
    write_rows(folder / "labels.csv", ("file", "subject", "expression"), labels)
    return folder


def fail(folder: Path, name: str, model_hash: str = HASH) -> None:
    record = failed_record(
        File(name=f"{name}.ply", hash="x"), File(name="m.h5", hash=model_hash), f"{name}.ply is empty.", {}
    )
    write_record(folder / f"{name}.fit.json", record)


@pytest.fixture
def train(tmp_path: Path) -> Path:
    return make_results(tmp_path / "train", 8, 0)


@pytest.fixture
def new(tmp_path: Path) -> Path:
    return make_results(tmp_path / "new", 3, 1)


@pytest.fixture
def classifier(run: Run, train: Path, tmp_path: Path) -> Path:
    made = run("recognise", "train", train, "--labels", train / "labels.csv", "-o", tmp_path / "c.skops", "--relative")
    assert made.code == 0 and made.err == ""
    return tmp_path / "c.skops"


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_training_says_what_it_used_and_how_well_it_does(run: Run, train: Path, tmp_path: Path) -> None:
    outcome = run(
        "recognise", "train", train / "coefficients.csv", "--labels", train / "labels.csv", "-o",
        tmp_path / "deep" / "c.skops", "--relative", "--classifier", "mean-direction", "--modes", 3, "--confidence",
        0.7, "--json",
    )  # fmt: skip
    assert outcome.code == 0
    facts = outcome.facts
    assert (facts["classifier"], facts["modes"], facts["confidence"]) == ("mean-direction", 3, 0.7)
    assert (facts["model_hash"], facts["classes"]) == (HASH, ["anger", "fear", "smile"])
    assert facts["cross_validation"]["macro_accuracy"] > 0.9
    again = run("recognise", "train", train, "--labels", train / "labels.csv", "-o", tmp_path / "c.skops")
    assert "lda of 4 classes from 32 scans of 8 subjects, 4 modes\n" in again.out
    assert "macro accuracy on held-out subjects: " in again.out


def test_answers_are_the_same_from_the_folder_and_from_the_table(run: Run, classifier: Path, new: Path, tmp_path: Path):
    for results, table in ((new, "a.csv"), (new / "coefficients.csv", "b.csv")):
        outcome = run(
            "recognise", "predict", classifier, results, "--labels", new / "labels.csv", "-o", tmp_path / table
        )
        assert outcome.code == 0 and outcome.err == ""
        assert f"12 scans: 9 answered, 3 neutral; answers in {tmp_path / table}" in outcome.out
    rows = {row["scan"]: row for row in read(tmp_path / "a.csv")}
    assert rows == {row["scan"]: row for row in read(tmp_path / "b.csv")}
    assert all(row["prediction"] == scan.split("_")[1] for scan, row in rows.items() if "neutral" not in scan)


def test_a_failed_fit_has_its_row_and_the_exit_code_says_so(run: Run, classifier: Path, new: Path, tmp_path: Path):
    fail(new, "p0_smile")
    record = json.loads((new / "p1_fear.fit.json").read_text())
    (new / "p1_fear.fit.json").write_text(json.dumps(record | {"status": "doubtful", "reason": "It shrank."}))
    outcome = run("recognise", "predict", classifier, new, "--labels", new / "labels.csv", "-o", tmp_path / "a.csv")
    assert outcome.code == 1
    rows = {row["scan"]: row for row in read(tmp_path / "a.csv")}
    assert len(rows) == 12
    assert (rows["p0_smile"]["status"], rows["p0_smile"]["prediction"]) == ("failed", "")
    assert rows["p0_smile"]["reason"] == "p0_smile.ply is empty."
    assert (rows["p1_fear"]["status"], rows["p1_fear"]["prediction"]) == ("doubtful", "unsure")
    assert rows["p1_fear"]["p_fear"] == ""


def test_strict_ends_with_one_when_an_answer_is_unsure(run: Run, train: Path, new: Path, tmp_path: Path) -> None:
    out = tmp_path / "c.skops"
    run("recognise", "train", train, "--labels", train / "labels.csv", "-o", out, "--relative", "--confidence", 1)
    asked = ("recognise", "predict", out, new, "--labels", new / "labels.csv", "-o", tmp_path / "a.csv", "--json")
    assert run(*asked).code == 0
    strict = run(*asked, "--strict")
    assert strict.code == 1 and strict.facts["unsure"] == 9
    assert all(a["prediction"] == "unsure" for a in strict.facts["answers"] if a["probabilities"])


def test_where_no_scan_gets_an_answer_the_exit_code_is_two(run: Run, classifier: Path, new: Path, tmp_path: Path):
    for person in range(3):
        fail(new, f"p{person}_neutral")
    outcome = run("recognise", "predict", classifier, new, "--labels", new / "labels.csv", "-o", tmp_path / "a.csv")
    assert outcome.code == 2
    assert "no scan could be classified" in outcome.sentence()
    assert all("no usable neutral face" in r["reason"] for r in read(tmp_path / "a.csv") if "neutral" not in r["scan"])


def test_coefficients_of_another_model_are_refused(run: Run, classifier: Path, tmp_path: Path) -> None:
    other = make_results(tmp_path / "other", 2, 3, model_hash="b" * 64)
    asked = ("recognise", "predict", classifier, other, "--labels", other / "labels.csv", "-o", tmp_path / "a.csv")
    outcome = run(*asked)
    assert outcome.code == 2 and "of the model aaaaaaaaaaaa, and these are of bbbbbbbbbbbb" in outcome.sentence()
    assert not (tmp_path / "a.csv").exists()


def test_bad_input_gives_one_sentence(run: Run, classifier: Path, train: Path, new: Path, tmp_path: Path) -> None:
    labels, out = ("--labels", train / "labels.csv"), ("-o", tmp_path / "x.skops")
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged.skops").write_bytes(classifier.read_bytes()[:900])
    (tmp_path / "few.csv").write_text("file,label\np0_smile,smile\n")
    (tmp_path / "people.csv").write_text("file,subject,foo\np0_smile,p0,smile\n")
    asked = [
        (("train", tmp_path / "absent", *labels, *out), "no such file"),
        (("train", tmp_path / "empty", *labels, *out), "contains no results"),
        (("train", train, *labels, "-o", tmp_path / "x.pkl"), "ends in .skops"),
        (("train", train, *labels, *out, "--classifier", "forest"), "no classifier 'forest'"),
        (("train", train, *labels, *out, "--modes", 9), "There are 4 coefficients"),
        (("train", train, "--labels", tmp_path / "few.csv", *out), "at least two classes"),
        (("train", train, "--labels", train / "p0_smile.fit.json", *out), "no table of specimens"),
        (("train", train, "--labels", tmp_path / "people.csv", *out), "a column label or expression"),
        (("predict", classifier, new, "-o", tmp_path / "a.csv"), "give --labels"),
        (("predict", tmp_path / "damaged.skops", new, "-o", tmp_path / "a.csv"), "cut short"),
        (("predict", train / "labels.csv", new, "-o", tmp_path / "a.csv"), "not a classifier"),
    ]
    for arguments, said in asked:
        outcome = run("recognise", *arguments)
        assert outcome.code == 2, arguments
        assert any(part in outcome.sentence() for part in said.split("|")), outcome.err
    (train / "p0_smile.fit.json").write_text('{"format": "shapespace fit"}')
    assert "p0_smile.fit.json is damaged" in run("recognise", "train", train, *labels, *out).sentence()


def additive_model(path: Path) -> str:
    """Write a model whose last coefficients are the expression, turned among all four; return its hash."""
    rng = np.random.default_rng(3)
    shape = ShapeModel(
        mean=rng.normal(0, 50, 60), basis=np.linalg.qr(rng.standard_normal((60, 4)))[0], stddev=np.arange(8.0, 4.0, -1),
        total_variance=200.0, n_training=30,
    )  # fmt: skip
    AdditiveModel(shape, np.linalg.qr(rng.standard_normal((4, 4)))[0], 2).save(path)
    return shape.content_hash


def test_expression_alone_is_seen_where_the_model_parts_it(run: Run, tmp_path: Path) -> None:
    own = additive_model(tmp_path / "m.h5")
    train, new = (make_results(tmp_path / name, 8, seed, own) for name, seed in (("t", 0), ("n", 1)))
    common = ("--labels", train / "labels.csv", "--expression-of", tmp_path / "m.h5")
    made = run("recognise", "train", train, *common, "-o", tmp_path / "c.skops", "--relative", "--json")
    assert made.code == 0, made.err
    assert (made.facts["coefficients"], made.facts["modes"]) == ("expression", 2)
    told = ("recognise", "predict", tmp_path / "c.skops", new, "--labels", new / "labels.csv")
    assert run(*told, "-o", tmp_path / "a.csv").code == 0
    # What identity does to all coefficients must not be seen by a classifier of e alone.
    rotation = AdditiveModel.load(tmp_path / "m.h5").rotation
    from shapespace.recognise.classifier_file import load_classifier

    saved, shift = load_classifier(tmp_path / "c.skops"), rotation[:2].sum(axis=0)
    z = np.random.default_rng(0).standard_normal((5, 4))
    assert np.allclose(saved.probabilities(z), saved.probabilities(z + 9.0 * shift))
    assert not np.allclose(saved.probabilities(z), saved.probabilities(z + rotation[3]))
    with pytest.raises(InputError, match=r"with K 4, not \(5, 2\)"):
        saved.probabilities(z[:, :2])
    for wrong, said in (
        (("--expression-of", train / "labels.csv"), "labels.csv"),
        (("--expression-of", tmp_path / "m.h5", "--modes", "3"), "There are 2 coefficients"),
    ):
        outcome = run("recognise", "train", train, "--labels", train / "labels.csv", "-o", tmp_path / "x.skops", *wrong)
        assert outcome.code == 2 and said in outcome.sentence()
    others = make_results(tmp_path / "o", 8, 0)
    outcome = run("recognise", "train", others, *common, "-o", tmp_path / "x.skops")
    assert outcome.code == 2 and "give the model that the scans were fitted with" in outcome.sentence()


@pytest.mark.parametrize("command", ["train", "predict"])
def test_help_shows_an_example(run: Run, command: str) -> None:
    outcome = run("recognise", command, "--help")
    assert outcome.code == 0 and f"example: shapespace recognise {command}" in outcome.out


def test_real_fits_go_through(run: Run, world: World, tmp_path: Path) -> None:
    out = tmp_path / "out"
    fitted = run("fit", world.model, world.meshes, "-o", out, "--quiet", "--jobs", 1, "--set", "max_iterations=3")
    assert fitted.code in (0, 1)
    write_rows(tmp_path / "l.csv", ("file", "label"), [(f"blob_{k:02d}.ply", "ab"[k % 2]) for k in range(12)])
    made = run("recognise", "train", out, "--labels", tmp_path / "l.csv", "-o", tmp_path / "c.skops", "--json")
    assert made.code == 0, made.err
    assert made.facts["modes"] == 4
    told = run("recognise", "predict", tmp_path / "c.skops", out / "coefficients.csv", "-o", tmp_path / "a.csv")
    assert told.code == 0 and len(read(tmp_path / "a.csv")) == 12


def test_without_the_extra_one_sentence_says_how_to_install_it(train: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['sklearn'] = None; sys.modules['skops'] = None; from shapespace.cli import main; "
        f"sys.exit(main(['recognise', 'train', {str(train)!r}, '--labels', {str(train / 'labels.csv')!r}, "
        f"'-o', {str(tmp_path / 'c.skops')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("shapespace: Recognition needs the extra recognise")
    assert 'pip install "shapespace[recognise]"' in done.stderr and done.stderr.count("\n") == 1


def test_other_commands_do_not_load_scikit_learn() -> None:
    code = "import sys, shapespace.commands, shapespace.viewer.serve; print('sklearn' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
