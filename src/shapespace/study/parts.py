"""Parts of recognition.json, which the report draws: tables, confusion matrices, curves and maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version as version_of
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.recognise import evaluate
from shapespace.schemas import (
    Bin,
    CalibrationPart,
    ConfusionPart,
    LearningCurvePart,
    Part,
    Recognition,
    TableColumn,
    TablePart,
    Target,
    to_json,
)
from shapespace.types import FloatArray
from shapespace.version import __version__

BoolRow = npt.NDArray[np.bool_]
TextArray = npt.NDArray[np.str_]


def table(
    title: str, columns: Sequence[tuple[str, str]], rows: Sequence[Sequence[object]], note: str = ""
) -> TablePart:
    """Return a table; `columns` are (name, kind)."""
    heads = tuple(TableColumn(name=name, kind=cast(Any, kind)) for name, kind in columns)
    return TablePart(title=title, note=note, columns=heads, rows=tuple(map(tuple, rows)))


def confusion(
    title: str, labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str], note: str = ""
) -> ConfusionPart:
    """Return a confusion matrix."""
    counts = evaluate.confusion(labels, predicted, classes)
    unanswered = int(counts[:, len(classes) :].sum())
    if unanswered:
        note = f"{note} {unanswered} without an answer are not shown.".strip()
    return ConfusionPart(title=title, note=note, classes=tuple(classes), counts=counts[:, : len(classes)].tolist())


def per_class(title: str, labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str]) -> TablePart:
    """Return precision, recall and F1 of each class."""
    scores = evaluate.per_class(labels, predicted, classes)
    return table(
        title,
        [("Expression", "text"), *((head, "percent") for head in ("Precision", "Recall", "F1")), ("Scans", "count")],
        [(name, score.precision, score.recall, score.f1, score.count) for name, score in scores.items()],
    )


def calibration(
    title: str, labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str]
) -> CalibrationPart:
    """Return the calibration of probabilities."""
    curve = evaluate.calibration(labels, probabilities, classes)
    low = np.minimum(np.floor(10 * np.asarray(curve.confidence)) / 10, 0.9)
    bins = tuple(
        Bin(low=begins, high=begins + 0.1, confidence=confidence, accuracy=true, count=count)
        for begins, confidence, true, count in zip(low, curve.confidence, curve.accuracy, curve.count, strict=True)
    )
    return CalibrationPart(title=title, bins=bins, ece=curve.expected_calibration_error, brier=curve.brier)


def learning_curve(
    title: str, folds: Sequence[evaluate.Fold], counts: Sequence[int], *, ceiling: float | None, repeats: int = 5
) -> LearningCurvePart:
    """Return macro accuracy against the number of training people."""
    curve = evaluate.learning_curve(folds, "lda", counts, repeats=repeats)
    low, high = np.quantile(curve.macro_accuracy, [0.0, 1.0], axis=1).tolist()
    return LearningCurvePart(
        title=title, subjects=curve.subjects.tolist(), mean=curve.mean.tolist(), low=low, high=high,
        band=f"lowest and highest of {repeats} draws", ceiling=ceiling,
    )  # fmt: skip


def accuracy_of(
    labels: Sequence[str] | TextArray,
    predicted: Sequence[str] | TextArray,
    subjects: Sequence[str] | TextArray,
    chosen: BoolRow | None = None,
) -> tuple[float, tuple[float, float]]:
    """Return macro accuracy with its bootstrap interval over people, of all or of the chosen samples."""
    rows = np.ones(len(labels), dtype=np.bool_) if chosen is None else chosen
    some = [np.asarray(values, dtype=str)[rows].tolist() for values in (labels, predicted, subjects)]
    classes = sorted(set(some[0]))
    return evaluate.macro_accuracy(some[0], some[1], classes), evaluate.subject_bootstrap(*some)


def inner_folds(folds: Sequence[evaluate.Fold]) -> int:
    """Return the number of folds of the training people: four, or fewer if there are fewer people."""
    return min(4, *(len(set(fold.train_subjects)) for fold in folds))


def fixed(folds: Sequence[evaluate.Fold], classifier: str) -> evaluate.Predictions | None:
    """Return the predictions of one classifier, or None if it needs more samples than there are."""
    try:
        return evaluate.fixed_predictions(folds, classifier)
    except InputError:
        return None


def words(share: float) -> str:
    """Return a share as text."""
    return f"{100 * share:.1f} %"


def target(what: str, wanted: str, reached: str, *, met: bool, note: str = "") -> Target:
    """Return one line of the table of targets."""
    return Target(what=what, target=wanted, reached=reached, met=bool(met), note=note)


def document(
    title: str,
    summary: Sequence[str],
    targets: Sequence[Target],
    parts: Sequence[Part],
    *,
    settings: Mapping[str, Any],
    model_hashes: Sequence[str],
) -> dict[str, Any]:
    """Return the complete content of recognition.json, checked as the report checks it."""
    recognition = Recognition(
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        title=title,
        summary=tuple(summary),
        targets=tuple(targets),
        parts=tuple(parts),
        settings=settings,
        versions={name: version_of(name) for name in ("numpy", "scipy", "scikit-learn")},
        model_hashes=tuple(model_hashes),
    )
    content = to_json(recognition)
    Recognition.from_json(content)
    return content
