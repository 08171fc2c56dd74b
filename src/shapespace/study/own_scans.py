"""Classify the labelled scans of a folder: fit them by a given model, and cross-validate by subject."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.fit_work import FitJob
from shapespace.batch.progress import progress
from shapespace.batch.run import BatchConfig, FolderSink, fit_many, make_jobs
from shapespace.datasets.expression_sets import ScanEntry, scan_set
from shapespace.errors import InputError
from shapespace.io.files import make_folder, write_text
from shapespace.model.additive import AdditiveModel, load_model
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise import evaluate
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.labelled_scans import NEUTRAL, relative_where_known
from shapespace.report.pages.write_html import require_report_extra, write_report
from shapespace.schemas import FitRecord, Part, TextPart
from shapespace.study import parts
from shapespace.types import BoolArray, FloatArray

TextArray = npt.NDArray[np.str_]
_FEWEST_SUBJECTS = 4  # subjects; two in each half of a split
_FEWEST_PER_CLASS = 2  # scans of a class, one to train with and one to test
_CURVE = (2, 5, 10, 20, 40, 80)  # training subjects at which the learning curve is measured, about doubling


def run_own_study(
    folder: Path,
    data: Path,
    model_file: Path,
    *,
    folds: int,
    execution: ExecutionConfig,
    seed: int = 0,
    quiet: bool = False,
) -> tuple[Path, str]:
    """Fit the labelled scans in `data`, classify them, and write recognition.json and its report.

    Args:
        folder: folder of the results; existing fits are reused.
        data: BU-3DFE, Bosphorus, or a folder with labels.csv; see `scan_set`.
        model_file: shape model, which must not be built from these people; if it separates identity and expression,
            expression alone is a feature as well.
        folds: largest number of folds by subject; fewer if there are fewer people.
        execution: Executor of the fits.
        seed: seed of the folds.
        quiet: no progress bar.

    Returns:
        The path of the report, and a summary of the folder of scans.

    Raises:
        FileError: something cannot be read or written.
        InputError: too few people or expressions.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    require_report_extra()
    make_folder(folder)
    labelled = scan_set(data)
    _check(labelled.scans, data, folds)
    loaded = load_model(model_file)
    model, additive = (loaded, None) if isinstance(loaded, ShapeModel) else (loaded.shape, loaded)
    with progress(len(labelled.scans), "fitting", "scan", quiet=quiet) as bar:

        def fitted(job: FitJob, record: FitRecord) -> None:
            bar.update()

        jobs = make_jobs([entry.path for entry in labelled.scans])
        sink, executor = FolderSink(folder / "fits"), execution.executor(len(jobs), quiet=quiet)
        fit_many(jobs, BatchConfig(model, model_file, reuse=True), executor, sink, on_done=fitted)
    records = [sink.records[job.name] for job in jobs]
    fits = OwnFits.of(labelled.scans, records, model, additive)
    settings = {"model": model_file.name, "folds": min(folds, fits.people), "seed": seed}
    content = _document(fits, labelled.summary(), settings)
    write_text(folder / "recognition.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    return write_report(folder), labelled.summary()


@dataclass(frozen=True, eq=False)
class OwnFits:
    """Labelled scans and their fits by one model.

    Args:
        codes: features by name, each (N, k); rows of failed fits are NaN.
        status: status of each of the N fits.
        expression: (N,) expression of each scan.
        subject: (N,) subject of each scan.
        level: (N,) intensity of each expression.
        model_hash: content hash of the model.
    """

    codes: Mapping[str, FloatArray]
    status: Sequence[str]
    expression: TextArray
    subject: TextArray
    level: FloatArray
    model_hash: str

    @classmethod
    def of(
        cls,
        scans: Sequence[ScanEntry],
        records: Sequence[FitRecord],
        model: ShapeModel,
        additive: AdditiveModel | None,
    ) -> OwnFits:
        """Return the features and labels of the scans from their records, in their order."""
        z = np.full((len(scans), model.n_modes), np.nan)
        for row, record in enumerate(records):
            if record.is_fitted:
                z[row] = np.asarray(record.z, dtype=np.float64)
        codes: dict[str, FloatArray] = {"all coefficients": z}
        if additive is not None:
            e = np.full((len(z), additive.n_expression), np.nan)
            usable = np.isfinite(z).all(axis=1)
            e[usable] = additive.split(z[usable])[1]
            codes["expression coefficients of the additive model"] = e
        return cls(
            codes,
            [record.status for record in records],
            np.array([entry.expression for entry in scans], dtype=np.str_),
            np.array([entry.subject for entry in scans], dtype=np.str_),
            np.array([entry.intensity for entry in scans], dtype=np.float64),
            model.content_hash,
        )

    @cached_property
    def tested(self) -> BoolArray:
        """(N,) mask of the M scans that are not neutral."""
        return np.asarray(self.expression != NEUTRAL, dtype=np.bool_)

    @cached_property
    def labels(self) -> TextArray:
        """(M,) expressions of the tested scans."""
        return self.expression[self.tested]

    @cached_property
    def subjects(self) -> TextArray:
        """(M,) subjects of the tested scans."""
        return self.subject[self.tested]

    @property
    def people(self) -> int:
        """Number of people that are tested."""
        return len(np.unique(self.subjects))

    @property
    def neutral_known(self) -> bool:
        """Whether there is a neutral scan of each tested subject."""
        return set(self.subjects.tolist()) <= set(self.subject[~self.tested].tolist())

    def folds(self, code: FloatArray, settings: Mapping[str, Any]) -> list[evaluate.Fold]:
        """Return the folds by person of one feature."""
        labels, subjects = self.labels.tolist(), self.subjects.tolist()
        return evaluate.folds_of(code[self.tested], labels, subjects, settings["folds"], settings["seed"])

    def accuracy_of(
        self, predicted: Sequence[str], chosen: BoolArray | None = None
    ) -> tuple[float, tuple[float, float]]:
        """Return macro accuracy and its interval over people, of all or of some."""
        return parts.accuracy_of(self.labels, predicted, self.subjects, chosen)


def _check(scans: Sequence[ScanEntry], data: Path, folds: int) -> None:
    people = {entry.subject for entry in scans if entry.expression != NEUTRAL}
    classes = {entry.expression for entry in scans if entry.expression != NEUTRAL}
    for name in classes:
        own = {entry.subject for entry in scans if entry.expression == name}
        if len(own) < _FEWEST_PER_CLASS:
            raise InputError(f"{data}: {name} is shown by {len(own)} person only, so it cannot be tested; add people.")
    if len(people) < _FEWEST_SUBJECTS or len(classes) < 2:
        raise InputError(
            f"{data}: a study needs at least {_FEWEST_SUBJECTS} people and two expressions besides neutral, not "
            f"{len(people)} and {len(classes)}."
        )
    parted = min(folds, len(people))
    if parted < 2 or len(people) - math.ceil(len(people) / parted) < 2:
        raise InputError(
            f"{data}: {folds} folds of {len(people)} people leave fewer than two to learn from; ask for more folds."
        )


def _document(fits: OwnFits, holds: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of recognition.json."""
    rows, folds, predictions = _compare_classifiers(fits, settings)
    test = evaluate.permutation_test(folds, permutations=99, seed=settings["seed"])
    accuracy, interval = fits.accuracy_of(predictions.predicted)
    labels, classes = fits.labels.tolist(), predictions.classes
    doubtful, failed = fits.status.count("doubtful"), fits.status.count("failed")
    report_parts: list[Part] = [
        TextPart(title="Data and protocol", text=(
            *holds.splitlines(),
            f"{doubtful} of {len(fits.status)} fits are doubtful and {failed} failed. Doubtful fits are classified "
            "and counted; a failed one counts as wrong.",
            "The shape model is the same in all folds; scaling and classifiers are trained without the tested people. "
            "If the model was built from the same people, these figures are too good.",
        )),
        parts.table(
            "Classifiers on unseen people",
            [("Features", "text"), ("Neutral face", "text"), ("Classifier", "text"), ("Macro accuracy", "percent"),
             ("95 % over people", "interval")],
            rows,
            f"{settings['folds']} folds by subject. With labels shuffled within each person LDA gets "
            f"{parts.words(float(test.null.mean()))} (p = {test.p:.3f}).",
        ),
        *_by_intensity(fits, predictions),
        parts.confusion("Confusion", labels, predictions.predicted, classes,
                        "Classifier chosen inside the training people, neutral face unknown."),
        parts.per_class("Each expression", labels, predictions.predicted, classes),
        parts.calibration("Calibration of the probabilities", labels, predictions.probabilities, classes),
    ]  # fmt: skip
    taught = fits.people * (settings["folds"] - 1) // settings["folds"]
    counts = [count for count in _CURVE if count < taught]
    if counts:
        report_parts.append(parts.learning_curve("Learning curve", folds, counts, ceiling=None))
    summary = [
        f"{len(classes)} expressions of unseen people are classified with an accuracy of {parts.words(accuracy)} "
        f"(95 % interval over people {parts.words(interval[0])} to {parts.words(interval[1])}; chance "
        f"{parts.words(1 / len(classes))}).",
        f"{doubtful + failed} of {len(fits.status)} fits are not to be trusted.",
    ]
    title = f"Expressions in {len(fits.status)} scans of {fits.people} people"
    return parts.document(title, summary, [], report_parts, settings=settings, model_hashes=[fits.model_hash])


def _compare_classifiers(
    fits: OwnFits, settings: Mapping[str, Any]
) -> tuple[list[tuple[object, ...]], list[evaluate.Fold], evaluate.Predictions]:
    """Return a row for each feature and classifier, and folds and answers of the last feature, neutral unknown."""
    rows: list[tuple[object, ...]] = []
    last: tuple[list[evaluate.Fold], evaluate.Predictions] | None = None
    for word in ("unknown", "known") if fits.neutral_known else ("unknown",):
        for name, code in fits.codes.items():
            known = relative_where_known(code, fits.subject, ~fits.tested) if word == "known" else code
            folds = fits.folds(known, settings)
            nested = evaluate.nested_predictions(
                folds, inner_folds=parts.inner_folds(folds), seed=settings["seed"], modes=(10, None)
            )
            chosen = ", ".join(sorted({choice.classifier for choice in nested.chosen}))
            rows.append((name, word, f"nested choice ({chosen})", *fits.accuracy_of(nested.predicted)))
            for classifier in CLASSIFIERS:
                fixed = parts.fixed(folds, classifier)
                if fixed is None:
                    rows.append((name, word, f"{classifier} (too few samples)", None, None))
                else:
                    rows.append((name, word, classifier, *fits.accuracy_of(fixed.predicted)))
            if word == "unknown":
                last = folds, nested
    assert last is not None
    return rows, *last


def _by_intensity(fits: OwnFits, predictions: evaluate.Predictions) -> list[Part]:
    level = fits.level[fits.tested]
    levels = sorted(set(level.tolist()))
    if len(levels) < 2:
        return []
    return [
        parts.table(
            "By intensity",
            [("Intensity", "percent"), ("Macro accuracy", "percent"), ("Scans", "count")],
            [
                (
                    intensity,
                    fits.accuracy_of(predictions.predicted, level == intensity)[0],
                    int((level == intensity).sum()),
                )
                for intensity in levels
            ],
        )
    ]
