"""The same study on scans of one's own: fitted with a given model, classified with nobody tested who was trained on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from shapespace import __version__
from shapespace.batch.run import Job, fit_files, make_executor, make_jobs
from shapespace.datasets.expression_sets import ScanEntry, scan_set
from shapespace.errors import InputError, ModelFileError
from shapespace.fit.fit import FitConfig
from shapespace.io.files import make_folder, write_text
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise import evaluate
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.report.html import require_report_extra, write_report
from shapespace.study import parts
from shapespace.types import BoolArray, FloatArray

NEUTRAL = "neutral"
_FEWEST_SUBJECTS = 4
_FEWEST_PER_CLASS = 2


def run_own_study(
    folder: Path, data: Path, model: Path, *, folds: int, workers: int, seed: int = 0, quiet: bool = False
) -> tuple[Path, str]:
    """Run the study on labelled scans of one's own; return the path of its report, and what the scans are.

    Args:
        folder: for the results; fits that are there already are kept.
        data: BU-3DFE, Bosphorus, or a folder with labels.csv.
        model: file of the shape model.
        folds: by subject.
        workers: processes that fit.
        seed: of the folds.
        quiet: no progress bar.

    Raises:
        FileError: something cannot be read or written.
        InputError: too few people or expressions.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    require_report_extra()
    make_folder(folder)
    with ExitStack() as stack:
        executor = stack.enter_context(make_executor(model, workers)) if workers > 1 else None
        bar = stack.enter_context(tqdm(unit="scan", leave=False, desc="fitting", disable=True if quiet else None))

        def count(scans: int) -> None:
            bar.total = scans

        def fitted(job: Job, record: Mapping[str, Any]) -> None:
            bar.update()

        _, holds = run_own(
            folder,
            data,
            model,
            folds=folds,
            seed=seed,
            executor=executor,
            on_scans=count,
            on_fit=fitted,
        )
    return write_report(folder), holds


def run_own(
    folder: Path,
    data: Path,
    model_file: Path,
    *,
    folds: int = 10,
    seed: int = 0,
    executor: Executor | None = None,
    on_scans: Callable[[int], None] | None = None,
    on_fit: Callable[[Job, Mapping[str, Any]], None] | None = None,
) -> tuple[Path, str]:
    """Fit the labelled scans in `data` with a model, classify them, and write recognition.json.

    Args:
        folder: where results go; fits that are there already are kept.
        data: BU-3DFE, Bosphorus, or a folder with labels.csv; see `scan_set`.
        model_file: the shape model, which should know none of these people; where it parts identity and expression,
            expression alone is a feature as well.
        folds: at most; fewer where there are fewer people.
        seed: of the folds.
        executor: from `make_executor`; None fits one after the other.
        on_scans: told how many there are.
        on_fit: told of each fit.

    Returns:
        The path of recognition.json, and what the folder of scans holds, in words.

    Raises:
        FileError: something cannot be read or written.
        InputError: too few people or expressions.
    """
    found = scan_set(data)
    _check(found.scans, data, folds)
    if on_scans is not None:
        on_scans(len(found.scans))
    model = ShapeModel.load(model_file)
    try:
        additive: AdditiveModel | None = AdditiveModel.load(model_file)
    except ModelFileError:
        additive = None  # a plain shape model, which loaded
    jobs = make_jobs([entry.path for entry in found.scans])
    results = make_folder(folder / "fits")
    records = fit_files(
        jobs, model, model_file, results, FitConfig(), executor=executor, resume=True, on_done=on_fit
    )  # fmt: skip
    made = _document(found.scans, records, model, additive, found.summary(), folds, seed, model_file)
    path = folder / "recognition.json"
    write_text(path, json.dumps(made, indent=1, allow_nan=False) + "\n")
    return path, found.summary()


def _check(scans: Sequence[ScanEntry], data: Path, folds: int) -> None:
    people = {entry.subject for entry in scans if entry.expression != NEUTRAL}
    classes = {entry.expression for entry in scans if entry.expression != NEUTRAL}
    for name in classes:
        own = {entry.subject for entry in scans if entry.expression == name}
        if len(own) < _FEWEST_PER_CLASS:
            raise InputError(f"{data}: {name} is shown by {len(own)} person only, so it cannot be tested; add people.")
    if len(people) < _FEWEST_SUBJECTS or len(classes) < 2:
        raise InputError(
            f"{data}: a study needs at least {_FEWEST_SUBJECTS} people and two expressions beside neutral, not "
            f"{len(people)} and {len(classes)}."
        )
    parted = min(folds, len(people))
    if parted < 2 or len(people) - math.ceil(len(people) / parted) < 2:
        raise InputError(
            f"{data}: {folds} folds of {len(people)} people leave fewer than two to learn from; ask for more folds."
        )


def _document(
    scans: Sequence[ScanEntry],
    records: Sequence[Mapping[str, Any]],
    model: ShapeModel,
    additive: AdditiveModel | None,
    holds: str,
    folds: int,
    seed: int,
    model_file: Path,
) -> dict[str, Any]:
    z = np.full((len(scans), model.n_modes), np.nan)
    for row, record in enumerate(records):
        if record["status"] != "failed":
            z[row] = np.asarray(record["z"], dtype=np.float64)
    expression = np.array([entry.expression for entry in scans])
    subject = np.array([entry.subject for entry in scans])
    level = np.array([entry.intensity for entry in scans], dtype=np.float64)
    status = [str(record["status"]) for record in records]
    tested: BoolArray = np.asarray(expression != NEUTRAL, dtype=np.bool_)
    labels, subjects = expression[tested], subject[tested]
    classes = tuple(sorted(set(labels.tolist())))
    n_folds = min(folds, len(set(subjects.tolist())))

    codes: dict[str, FloatArray] = {"all coefficients": z}
    if additive is not None:
        e = np.full((len(z), additive.n_expression), np.nan)
        usable = np.isfinite(z).all(axis=1)
        e[usable] = additive.split(z[usable])[1]
        codes["expression coefficients of the additive model"] = e
    rows: list[tuple[object, ...]] = []
    default: evaluate.Predictions | None = None
    default_folds: list[evaluate.Fold] = []
    with_neutral = int(sum(name in set(subject[expression == NEUTRAL].tolist()) for name in set(subjects.tolist())))
    for relative in (False, True):
        if relative and with_neutral < len(set(subjects.tolist())):
            continue
        word = "known" if relative else "unknown"
        for name, code in codes.items():
            used = _relative(code, subject, expression) if relative else code
            made = evaluate.folds_of(used[tested], labels.tolist(), subjects.tolist(), n_folds, seed)
            nested = evaluate.nested_predictions(made, inner_folds=parts.inner_folds(made), seed=seed, modes=(10, None))
            accuracy, interval = parts.accuracy_of(labels, nested.predicted, subjects)
            chosen = ", ".join(sorted({choice.classifier for choice in nested.chosen}))
            rows.append((name, word, f"nested choice ({chosen})", accuracy, interval))
            for classifier in CLASSIFIERS:
                fixed = parts.fixed(made, classifier)
                if fixed is None:
                    rows.append((name, word, f"{classifier} (too few samples)", None, None))
                    continue
                accuracy, interval = parts.accuracy_of(labels, fixed.predicted, subjects)
                rows.append((name, word, classifier, accuracy, interval))
            if not relative:
                default, default_folds = nested, made
    assert default is not None
    test = evaluate.permutation_test(default_folds, permutations=99, seed=seed)
    accuracy, interval = parts.accuracy_of(labels, default.predicted, subjects)
    doubtful, failed = status.count("doubtful"), status.count("failed")
    people = len(set(subjects.tolist()))
    counts = [count for count in (2, 5, 10, 20, 40, 80) if count < people * (n_folds - 1) // n_folds]
    made_parts: list[parts.Part] = [
        {"kind": "text", "title": "What was tested", "text": [
            *holds.splitlines(),
            f"{doubtful} of {len(status)} fits are doubtful and {failed} failed. Doubtful fits are classified "
            "and counted; a failed one counts as wrong.",
            "The shape model was given and stays the same in all folds; scaling and classifiers are made anew "
            "without the people tested. Where it was made of the same people, these figures flatter.",
        ]},
        parts.table(
            "Classifiers on unseen people",
            [("Features", "text"), ("Neutral face", "text"), ("Classifier", "text"), ("Macro accuracy", "percent"),
             ("95 % over people", "interval")],
            rows,
            f"{n_folds} folds by subject. With labels shuffled within each person LDA gets "
            f"{parts.words(float(test.null.mean()))} (p = {test.p:.3f}).",
        ),
        parts.confusion("Confusion", labels.tolist(), default.predicted, classes,
                        "Classifier chosen inside the training people, neutral face unknown."),
        parts.per_class("Each expression", labels.tolist(), default.predicted, classes),
        parts.calibration("Whether the probabilities come true", labels.tolist(), default.probabilities,
                          default.classes),
    ]  # fmt: skip
    if counts:
        made_parts.append(parts.learning_curve("How many people it takes", default_folds, counts, ceiling=None))
    levels = sorted(set(level[tested].tolist()))
    if len(levels) > 1:
        made_parts.insert(2, parts.table(
            "By intensity",
            [("Intensity", "percent"), ("Macro accuracy", "percent"), ("Scans", "count")],
            [(one, parts.accuracy_of(labels, default.predicted, subjects, level[tested] == one)[0],
              int((level[tested] == one).sum())) for one in levels],
        ))  # fmt: skip
    return parts.document(
        f"Expressions in {len(scans)} scans of {people} people",
        [
            f"{len(classes)} expressions of unseen people are told apart at {parts.words(accuracy)} (95 % interval "
            f"over people {parts.words(interval[0])} to {parts.words(interval[1])}; chance "
            f"{parts.words(1 / len(classes))}).",
            f"{doubtful + failed} of {len(scans)} fits are not to be trusted.",
        ],
        [],
        made_parts,
        settings={"model": model_file.name, "folds": n_folds, "seed": seed},
        versions={name: version_of(name) for name in ("numpy", "scipy", "scikit-learn")},
        model_hashes=[model.content_hash],
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _relative(code: FloatArray, subject: Any, expression: Any) -> FloatArray:
    """Return codes less the mean of the same person's neutral scans, NaN where none could be fitted."""
    out = np.full(code.shape, np.nan)
    for name in np.unique(subject):
        at_rest = code[(subject == name) & (expression == NEUTRAL)]
        at_rest = at_rest[np.isfinite(at_rest).all(axis=1)]
        if len(at_rest):
            out[subject == name] = code[subject == name] - at_rest.mean(axis=0)
    return out
