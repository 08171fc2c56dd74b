"""Evaluation of classifiers in subjects who were not trained on.

Permutation tests with shuffled labels, learning curves, the importance of modes, and maps of where classes differ. The
module `predictions` contains folds by subject, the nested choice of settings, and the rates.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.errors import InputError
from shapespace.recognise.classifiers import CLASSIFIERS, LDA_SHRINKAGE, linear_rule
from shapespace.recognise.predictions import (
    MODES,
    Calibration,
    Choice,
    ClassScores,
    Fold,
    IndexArray,
    Predictions,
    calibrated,
    calibration,
    check_classifiers,
    classes_of,
    confusion,
    cross_validated_probabilities,
    fit_temperature,
    fixed_predictions,
    folds_of,
    likeliest_classes,
    macro_accuracy,
    nested_predictions,
    per_class,
    predict_probabilities,
    subject_bootstrap,
    subject_folds,
    usable_training_rows,
)
from shapespace.types import FloatArray


@dataclass(frozen=True, eq=False)
class PermutationTest:
    """Macro accuracy, and its null distribution under permuted labels.

    Args:
        observed: macro accuracy with the observed labels.
        null: (P,) macro accuracies with labels shuffled within each subject.
        p: share of permutations with at least this accuracy, counting the observed labels.
    """

    observed: float
    null: FloatArray
    p: float


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """Macro accuracy against the number of training subjects.

    Args:
        subjects: (S,) people in each training set.
        macro_accuracy: (S, R) one column a repeat.
    """

    subjects: IndexArray
    macro_accuracy: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Mean over the repeats, (S,)."""
        return self.macro_accuracy.mean(axis=1)


def permutation_test(
    folds: Sequence[Fold], classifier: str = "lda", *, permutations: int = 200, seed: int = 0
) -> PermutationTest:
    """Test whether labels are related to the coefficients, by shuffling them within each person.

    A person's labels are shuffled in the same way in every fold, so that the complete experiment is repeated with wrong
    labels. The rows of a person must therefore come in the same order in every fold. LDA is solved in closed form,
    which takes milliseconds; other classifiers take longer.

    Args:
        folds: outer folds.
        classifier: a name of `CLASSIFIERS`, with its default settings.
        permutations: number of permutations.
        seed: seed of the permutations.

    Raises:
        InputError: no folds, an unknown classifier, or people whose number of rows differs between folds.
    """
    classes = classes_of(folds)
    check_classifiers([classifier])
    counts: dict[str, int] = {}
    for fold in folds:
        for part in (fold.train_subjects, fold.test_subjects):
            names, rows = np.unique(np.asarray(part, dtype=str), return_counts=True)
            for name, n in zip(names.tolist(), rows.tolist(), strict=True):
                if counts.setdefault(name, n) != n:
                    raise InputError(
                        f"{name} has {counts[name]} rows in one fold and {n} in another; keep failed fits as rows that "
                        "are not finite."
                    )
    prepared = [_prepare(fold, classes) for fold in folds]
    score = _score_lda if classifier == "lda" else _score_any
    rng = np.random.default_rng(seed)
    with threadpool_limits(1):
        observed = score(prepared, classes, {}, classifier, seed)
        null = [
            score(prepared, classes, {name: rng.permutation(n) for name, n in counts.items()}, classifier, seed)
            for _ in range(permutations)
        ]
    p = (1 + sum(value >= observed - 1e-12 for value in null)) / (1 + permutations)
    return PermutationTest(observed, np.asarray(null), p)


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A fold with data that does not depend on the labels: rows of each subject, scaled training rows, their Gram
    matrix.
    """

    fold: Fold
    train_labels: Any
    test_labels: Any
    train_rows: Mapping[str, IndexArray]
    test_rows: Mapping[str, IndexArray]
    finite: Any
    X: FloatArray
    test: FloatArray
    gram: FloatArray = field(repr=False)


def _prepare(fold: Fold, classes: Sequence[str]) -> _Prepared:
    finite = np.isfinite(fold.train).all(axis=1)
    X = fold.train[finite]
    mean, spread = X.mean(axis=0), X.std(axis=0)
    spread[spread < 1e-12] = 1.0
    X = (X - mean) / spread
    names = np.asarray(classes)
    return _Prepared(
        fold=fold,
        train_labels=np.searchsorted(names, np.asarray(fold.train_labels, dtype=str)),
        test_labels=np.searchsorted(names, np.asarray(fold.test_labels, dtype=str)),
        train_rows=_rows(fold.train_subjects),
        test_rows=_rows(fold.test_subjects),
        finite=finite,
        X=X,
        test=(fold.test - mean) / spread,
        gram=X.T @ X,
    )


def _rows(subjects: Sequence[str]) -> dict[str, IndexArray]:
    people = np.asarray(subjects, dtype=str)
    return {name: np.flatnonzero(people == name) for name in np.unique(people).tolist()}


def _shuffled(labels: Any, rows: Mapping[str, IndexArray], order: Mapping[str, IndexArray]) -> Any:
    if not order:
        return labels
    out = labels.copy()
    for name, subject_rows in rows.items():
        out[subject_rows] = labels[subject_rows][order[name]]
    return out


def _score_lda(
    folds: Sequence[_Prepared], classes: Sequence[str], order: Mapping[str, IndexArray], classifier: str, seed: int
) -> float:
    hits, counts = np.zeros(len(classes)), np.zeros(len(classes))
    unit = np.eye(len(classes))
    for p in folds:
        member = unit[_shuffled(p.train_labels, p.train_rows, order)[p.finite]]
        present = np.flatnonzero(member.any(axis=0))
        coef, intercept = linear_rule(p.X, member[:, present], p.gram, LDA_SHRINKAGE)
        scores = p.test @ coef.T + intercept
        undefined = np.isnan(scores).any(axis=1)
        predicted = np.where(undefined, -1, present[np.where(np.isnan(scores), -np.inf, scores).argmax(axis=1)])
        truth = _shuffled(p.test_labels, p.test_rows, order)
        hits += np.bincount(truth[predicted == truth], minlength=len(classes))
        counts += np.bincount(truth, minlength=len(classes))
    return float((hits[counts > 0] / counts[counts > 0]).mean())


def _score_any(
    folds: Sequence[_Prepared], classes: Sequence[str], order: Mapping[str, IndexArray], classifier: str, seed: int
) -> float:
    names = np.asarray(classes)
    truth: list[str] = []
    answers: list[str] = []
    for p in folds:
        labels = names[_shuffled(p.train_labels, p.train_rows, order)][p.finite]
        probabilities = predict_probabilities(
            X=p.fold.train[p.finite],
            labels=labels,
            test=p.fold.test,
            classes=classes,
            classifier=classifier,
            parameters={},
            seed=seed,
        )
        truth += names[_shuffled(p.test_labels, p.test_rows, order)].tolist()
        answers += likeliest_classes(probabilities, classes).tolist()
    return macro_accuracy(truth, answers, classes)


def learning_curve(
    folds: Sequence[Fold],
    classifier: str = "lda",
    subject_counts: Sequence[int] = (5, 10, 20, 40, 80),
    *,
    repeats: int = 5,
    seed: int = 0,
) -> LearningCurve:
    """Return the macro accuracy on all test samples against the number of training people, drawn at random.

    The coefficients stay those of the fold's own model; only the classifier uses fewer people.

    Args:
        folds: outer folds.
        classifier: a name of `CLASSIFIERS`, with its default settings.
        subject_counts: numbers of training people; numbers that a fold does not have are omitted from the curve.
        repeats: number of random draws of people.
        seed: seed of the draws.

    Raises:
        InputError: no folds, an unknown classifier, or no fold with so many people.
    """
    classes = classes_of(folds)
    check_classifiers([classifier])
    fewest = min(len(set(fold.train_subjects)) for fold in folds)
    counts = [n for n in subject_counts if 1 <= n <= fewest]
    if not counts or repeats < 1:
        raise InputError(f"The folds have {fewest} subjects to train on, so the learning curve has no point to show.")
    rng = np.random.default_rng(seed)
    curve = np.zeros((len(counts), repeats))
    truth = [label for fold in folds for label in fold.test_labels]
    with threadpool_limits(1):
        for i, j in itertools.product(range(len(counts)), range(repeats)):
            answers: list[str] = []
            for fold in folds:
                X, labels, subjects = usable_training_rows(fold)
                people = rng.choice(np.unique(np.asarray(fold.train_subjects, dtype=str)), counts[i], replace=False)
                is_train = np.isin(subjects, people)
                probabilities = predict_probabilities(
                    X=X[is_train],
                    labels=labels[is_train],
                    test=fold.test,
                    classes=classes,
                    classifier=classifier,
                    parameters={},
                    seed=seed,
                )
                answers += likeliest_classes(probabilities, classes).tolist()
            curve[i, j] = macro_accuracy(truth, answers, classes)
    return LearningCurve(np.asarray(counts, dtype=np.int64), curve)


def mode_importance(
    folds: Sequence[Fold], classifier: str = "lda", *, modes: int | None = None, repeats: int = 5, seed: int = 0
) -> FloatArray:
    """Return the loss of macro accuracy, (F, K), when one mode is permuted among the test samples of a fold.

    Modes of folds with shape models of their own correspond only approximately; consider this in the mean over the
    folds.

    Args:
        folds: outer folds.
        classifier: a name of `CLASSIFIERS`, with its default settings.
        modes: number of leading modes that it uses; None is all. The others have importance 0.
        repeats: number of shuffles of each mode, whose losses are averaged.
        seed: seed of the shuffles.

    Raises:
        InputError: no folds, or an unknown classifier.
    """
    from sklearn.inspection import permutation_importance  # pyright: ignore[reportUnknownVariableType]

    classes = classes_of(folds)
    check_classifiers([classifier])

    def score(pipeline: Any, test: FloatArray, truth: Any) -> float:
        return macro_accuracy(truth, pipeline.predict(test), classes)

    loss = np.zeros((len(folds), folds[0].train.shape[1]))
    with threadpool_limits(1):
        for f, fold in enumerate(folds):
            X, labels, _ = usable_training_rows(fold)
            m = min(modes or X.shape[1], X.shape[1])
            finite = np.isfinite(fold.test).all(axis=1)
            test, truth = fold.test[finite, :m], np.asarray(fold.test_labels, dtype=str)[finite]
            pipeline: Any = CLASSIFIERS[classifier](seed)
            pipeline.fit(X[:, :m], labels)
            importances = cast(Any, permutation_importance)(
                pipeline, test, truth, scoring=score, n_repeats=repeats, random_state=seed
            )
            loss[f, :m] = importances.importances_mean
    return loss


__all__ = [
    "MODES",
    "Calibration",
    "Choice",
    "ClassScores",
    "Fold",
    "LearningCurve",
    "PermutationTest",
    "Predictions",
    "calibrated",
    "calibration",
    "confusion",
    "cross_validated_probabilities",
    "decision_map",
    "fit_temperature",
    "fixed_predictions",
    "folds_of",
    "learning_curve",
    "macro_accuracy",
    "mode_importance",
    "nested_predictions",
    "per_class",
    "permutation_test",
    "predict_probabilities",
    "region_shares",
    "subject_bootstrap",
    "subject_folds",
]


def decision_map(
    vertex_basis: FloatArray, stddev: FloatArray, v: FloatArray, labels: Sequence[str], *, noise_mm: float = 0.1
) -> FloatArray:
    """Return the Fisher ratio of the classes at each vertex, (V,), as a map on the face.

    The ratio is the variance of the class means of a vertex's displacement over its variance within classes, both
    summed over the three coordinates. The denominator includes `noise_mm`, so that nearly fixed vertices get low
    ratios.

    Args:
        vertex_basis: (V, 3, K) displacement of each vertex with one mm of each coefficient.
        stddev: (K,) of the coefficients, mm.
        v: (n, K) coefficients in standard deviations, relative to neutral or not.
        labels: n classes.
        noise_mm: displacement that counts as nothing.

    Raises:
        InputError: arrays that do not belong together, or one class only.
    """
    names, class_index = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    V, K = vertex_basis.shape[0], vertex_basis.shape[-1]
    if vertex_basis.shape != (V, 3, K) or v.shape != (len(labels), K) or stddev.shape != (K,):
        raise InputError(
            f"A decision map needs a (V, 3, K) basis, (K,) deviations and (n, K) coefficients, not "
            f"{vertex_basis.shape}, {stddev.shape} and {v.shape}."
        )
    if len(names) < 2 or not np.isfinite(v).all():
        raise InputError("A decision map needs finite coefficients of at least two classes.")
    between, within = _scatter(v * stddev, class_index)
    return _vertex_variance(vertex_basis, between) / (_vertex_variance(vertex_basis, within) + noise_mm**2)


def region_shares(decision: FloatArray, regions: Mapping[str, IndexArray]) -> dict[str, float]:
    """Return each region's share of a decision map (V,): its mean in the region divided by the sum of these means.

    Args:
        decision: (V,) not negative.
        regions: name -> vertex indices.
    """
    means = {name: float(decision[vertices].mean()) for name, vertices in regions.items() if len(vertices)}
    total = sum(means.values())
    return {name: mean / total if total > 0 else 0.0 for name, mean in means.items()}


def _scatter(b: FloatArray, class_index: Any) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (K, K) of the class means and that within classes, over all samples."""
    member = np.eye(int(class_index.max()) + 1)[class_index]
    means = (member.T @ b) / member.sum(axis=0)[:, None]
    inner, outer = b - means[class_index], means[class_index] - b.mean(axis=0)
    return outer.T @ outer / len(b), inner.T @ inner / len(b)


def _vertex_variance(basis: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(((basis @ covariance) * basis).sum(axis=(1, 2)), dtype=np.float64)
