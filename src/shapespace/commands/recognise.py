"""Command `recognise`: train, predict, transfer, study."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.fit_records import read_record
from shapespace.batch.progress import telling_of_compiling
from shapespace.batch.result_folder import RECORD
from shapespace.cohort.table import notes_on_classes, read_labels
from shapespace.commands.outcome import Outcome, first_lines
from shapespace.errors import InputError
from shapespace.io.files import make_folder, read_bytes, read_error
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.recognise.labelled_scans import (
    ScanCoefficients,
    from_record,
    from_results,
    one_model,
    read_coefficients,
    with_labels,
)
from shapespace.store.results import results_at
from shapespace.types import FloatArray


def read_scans(path: Path, say: Callable[[str], None] = lambda _: None) -> list[ScanCoefficients]:
    """Return the fits in a folder that `fit` wrote, or in a coefficients.csv, in the order of their names or rows.

    A message is printed for each shard of a store that cannot be read, whose fits are excluded.

    Raises:
        FileError: it cannot be read.
        FileFormatError: a record or the table is damaged.
        InputError: the folder contains no records of fits.
    """
    if not path.is_dir():
        return read_coefficients(path)
    if (results := results_at(path)) is not None:
        scans = from_results(results)
        for problem in results.problems:
            say(problem)
        return scans
    try:
        files = sorted(p for p in path.iterdir() if p.name.endswith(RECORD) and p.is_file())
    except OSError as error:
        raise read_error(path, error) from error
    if not files:
        raise InputError(f"{path} contains no results of fits; give a folder that shapespace fit wrote.")
    return [from_record(file.name.removesuffix(RECORD), read_record(file)) for file in files]


def recognise_train(
    results: Path,
    labels: Path,
    output: Path,
    *,
    classifier: str = "lda",
    relative: bool = False,
    neutral: str = "neutral",
    confidence: float = 0.5,
    modes: int | None = None,
    expression_of: Path | None = None,
    seed: int = 0,
) -> Outcome:
    """Train a classifier on the fits in `results` and save it.

    Args:
        results: a folder that `fit` wrote, or its coefficients.csv.
        labels: table of scans and their labels, and subjects if known.
        output: the classifier, FILE.skops.
        classifier: `mean-direction`, `knn`, `lda`, `qda`, `logistic` or `svm`.
        relative: compare each scan with its subject's neutral face.
        neutral: label of neutral faces.
        confidence: predict `unsure` below this probability.
        modes: number of leading coefficients to use (default: all).
        expression_of: model of `build --additive` that the scans were fitted with; only its expression coefficients are
            used.
        seed: seed of the folds, and of classifiers that draw.

    Raises:
        FileError: something cannot be read, or the classifier not written.
        FileFormatError: results or labels are damaged.
        InputError: invalid input of `train_classifier`, fits of another model than `expression_of`, or a name that does
            not end in .skops.
        ModelFileError: `expression_of` does not separate identity and expression.
        ShapespaceError: the extra `recognise` is not installed.
    """
    from shapespace.model.additive import AdditiveModel
    from shapespace.recognise.predict import train_classifier

    problems: list[str] = []
    scans, unmatched = with_labels(
        read_scans(results, problems.append), read_labels(labels, of_subjects=False), results
    )
    projection: FloatArray | None = None
    if expression_of is not None:
        model, fitted_with = AdditiveModel.load(expression_of), one_model(scans)
        if model.shape.content_hash != fitted_with:
            raise InputError(
                f"{results} contains fits of the model {fitted_with[:12]}, and {expression_of} is "
                f"{model.shape.content_hash[:12]}; give the model that the scans were fitted with."
            )
        projection = model.rotation[model.n_identity :]
    saved, notes = train_classifier(
        scans, classifier=classifier, relative=relative, neutral=neutral, confidence=confidence, modes=modes,
        projection=projection, seed=seed,
    )  # fmt: skip
    make_folder(output.absolute().parent)
    saved.save(output)
    facts = saved.facts()
    classes = list(notes_on_classes("label", [scan.label for scan in scans]))
    training, checked = facts["training"], facts["cross_validation"]
    line = (
        f"{output}: {facts['classifier']} of {len(facts['classes'])} classes from {training['scans']} scans"
        + (f" of {training['subjects']} subjects" if training["subjects"] else "")
        + f", {facts['modes']} modes"
        + (", relative to neutral" if facts["relative_to_neutral"] else "")
    )
    left_out = "subjects" if checked["by"] == "subject" else "scans"
    share = checked["macro_accuracy"]
    accuracy = [] if share is None else [f"macro accuracy on held-out {left_out}: {100 * share:.1f} %"]
    return Outcome(
        {"file": str(output), **facts, "notes_on_classes": classes},
        [line, *classes, *accuracy],
        [*problems, *unmatched, *notes],
    )


def recognise_predict(
    classifier: Path,
    results: Path,
    output: Path,
    *,
    labels: Path | None,
    strict: bool,
    say: Callable[[str], None],
) -> Outcome:
    """Write the prediction for each fit in `results`, and count the outcomes.

    The counts are `answered`, `unsure`, `doubtful` (unsure for the fit's sake), `failed` (the fit failed, or its
    neutral face is missing) and `neutral` (faces that others are compared with). A message is printed for input that
    cannot be read.

    Raises:
        FileError: something cannot be read, or the answers not written.
        FileFormatError: the classifier, results or labels are damaged.
        InputError: the fits are of another model than the classifier, or labels are needed.
        ShapespaceError: the extra `recognise` is not installed.
    """
    from shapespace.recognise.classifier_file import load_classifier
    from shapespace.recognise.predict import UNSURE, predict_scans, write_answers

    saved = load_classifier(classifier)
    if saved.relative_to_neutral and labels is None:
        raise InputError(
            f"{classifier} compares with each subject's neutral face; give --labels with the columns file, label and "
            "subject."
        )
    scans = read_scans(results, say)
    if labels is not None:
        scans, unmatched = with_labels(scans, read_labels(labels), results)
        for note in unmatched:
            say(note)
    answers = predict_scans(saved, scans)
    make_folder(output.absolute().parent)
    write_answers(output, answers, saved.classes)
    counts: dict[str, int] = dict.fromkeys(("answered", "unsure", "doubtful", "failed", "neutral"), 0)
    rows: list[dict[str, Any]] = []
    for answer in answers:
        if answer.neutral:
            kind = "neutral"
        elif answer.probabilities is None:
            kind = "doubtful" if answer.status == "doubtful" else "failed"
        else:
            kind = "unsure" if answer.prediction == UNSURE else "answered"
        counts[kind] += 1
        p = answer.probabilities
        rows.append({
            "scan": answer.scan,
            "status": answer.status,
            "prediction": answer.prediction,
            "probabilities": {} if p is None else dict(zip(saved.classes, p.tolist(), strict=True)),
            "reason": answer.reason,
        })  # fmt: skip
    counts_text = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
    total = f"{len(rows)} {'scan' if len(rows) == 1 else 'scans'}: {counts_text}; answers in {output}"
    none = counts["failed"] == len(rows) - counts["neutral"]
    return Outcome(
        {"file": str(output), **counts, "answers": rows},
        [*first_lines(rows, _answer_line, f"more; all are in {output}"), total],
        errors=["shapespace: no scan could be classified; the reasons are in the table."] if none else (),
        exit_code=2 if none else int(counts["failed"] > 0 or (strict and counts["doubtful"] + counts["unsure"] > 0)),
    )


def _answer_line(row: Mapping[str, Any]) -> list[str]:
    p = max(row["probabilities"].values(), default=None)
    share = f" ({p:.2f})" if p is not None and not row["reason"] else ""
    reason = f"; {row['reason']}" if row["reason"] else ""
    return [f"{row['scan']}: {row['prediction'] or 'no answer'}{share}{reason}"]


def recognise_transfer(model: Path, person: Path, expression: Path, output: Path) -> Outcome:
    """Write the person of one fit with the expression of another, as a mesh.

    Raises:
        FileError: something cannot be read, or the mesh not written.
        FileFormatError: a record is damaged.
        InputError: the model does not separate identity and expression, or a fit is of another model.
    """
    from shapespace.model.additive import AdditiveModel

    additive = AdditiveModel.load(model)
    z: list[FloatArray] = []
    for path in (person, expression):
        record = read_record(path)
        if not record.is_fitted:
            raise InputError(f"{path} is the record of a fit that failed, so there is nothing to transfer.")
        if record.model.hash != additive.shape.content_hash:
            raise InputError(f"{path} is a fit by another model than {model.name}; fit the scan with {model.name}.")
        values = np.asarray(record.z, dtype=np.float64)
        if values.shape != (additive.shape.n_modes,):
            raise InputError(
                f"{path} contains {len(values)} coefficients of {additive.shape.n_modes}; fit the scan with all modes."
            )
        z.append(values)
    write_mesh(output, additive.transfer(z[0], z[1]))
    line = f"{output}: {person.name} with the expression of {expression.name}"
    return Outcome({"file": str(output)}, [line])


def recognise_study(
    output: Path,
    data: Path | None,
    model: Path | None,
    *,
    folds: int,
    seed: int = 0,
    execution: ExecutionConfig,
    no_open: bool,
    quiet: bool,
) -> Outcome:
    """Run the recognition study on labelled scans.

    Raises:
        FileError: something cannot be read or written.
        InputError: no scans or no model, or too few people.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    if data is None or model is None:
        raise InputError(
            "A study of scans of your own needs both --data DIR and --model MODEL.h5; the study on simulated people is "
            "python studies/recognition.py in the source of shapespace."
        )
    from shapespace.study.own_scans import run_own_study  # needs the extras

    with telling_of_compiling(quiet=quiet):
        report, holds = run_own_study(output, data, model, folds=folds, execution=execution, seed=seed, quiet=quiet)
    targets = json.loads(read_bytes(output / "recognition.json"))["targets"]
    reached = [
        f"{target['what']}: {target['reached']} ({target['target']}{'' if target['met'] else '; missed'})"
        for target in targets
    ]
    lines = [*holds.splitlines(), *reached, f"The report is {report}"]
    return Outcome({"report": str(report), "targets": targets}, lines, page=None if no_open else report)
