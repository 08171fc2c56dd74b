"""Cross-validated predictions: folds by subject, and nested selection of hyperparameters.

Everything here works on arrays of whitened coefficients, (n, K). A `Fold` contains its own training and test arrays, so
that each fold may have its own shape model, built without the tested people. A test row that is not finite is a failed
fit: it gets no answer, and counts as wrong. Such training rows are excluded.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.special import softmax
from threadpoolctl import threadpool_limits

from shapespace.cohort.proportions import widen_share
from shapespace.errors import InputError
from shapespace.recognise.classifiers import CLASSIFIERS, GRIDS, likeliest_temperature
from shapespace.recognise.learn import StratifiedGroupKFold, confusion_matrix, precision_recall_fscore_support
from shapespace.reprs import short_repr
from shapespace.types import FloatArray

MODES: tuple[int | None, ...] = (10, 20, 40, None)
"""Numbers of leading modes from which nested cross-validation chooses; None is all."""


@dataclass(frozen=True, eq=False)
class Fold:
    """One training and one test set, of different people.

    Args:
        train: (n, K) training coefficients in standard deviations.
        train_labels: n classes.
        train_subjects: n names of people.
        test: (m, K) test coefficients by the same model.
        test_labels: m classes.
        test_subjects: m names of people, none of whom is in the training set.
        test_index: (m,) index of each test sample among all samples, by which `Predictions` are ordered; None keeps the
            order of the folds.

    Raises:
        InputError: arrays that do not belong together, or a person in both sets.
    """

    train: FloatArray
    train_labels: Sequence[str]
    train_subjects: Sequence[str]
    test: FloatArray
    test_labels: Sequence[str]
    test_subjects: Sequence[str]
    test_index: IndexArray | None = None

    def __post_init__(self) -> None:
        n, m = len(self.train_labels), len(self.test_labels)
        fits = (
            self.train.ndim == self.test.ndim == 2
            and self.train.shape[1] == self.test.shape[1] > 0
            and len(self.train) == n == len(self.train_subjects)
            and len(self.test) == m == len(self.test_subjects)
            and (self.test_index is None or len(self.test_index) == m)
        )
        if not fits or not n or not m:
            raise InputError(
                f"A fold needs (n, K) training and (m, K) test coefficients with a label and a subject each, not "
                f"{self.train.shape} with {n} labels and {self.test.shape} with {m} labels."
            )
        shared_subjects = sorted(set(self.train_subjects) & set(self.test_subjects))
        if shared_subjects:
            raise InputError(
                f"{', '.join(shared_subjects[:3])} would be trained on and tested; split the samples by subject."
            )


@dataclass(frozen=True)
class Choice:
    """Hyperparameters that nested cross-validation selected within the training subjects of one fold.

    Args:
        classifier: a name of `CLASSIFIERS`.
        parameters: parameters of its pipeline.
        modes: number of leading modes.
        temperature: temperature that calibrates its probabilities.
        macro_accuracy: macro accuracy of the choice, within the training people.
    """

    classifier: str
    parameters: Mapping[str, Any]
    modes: int
    temperature: float
    macro_accuracy: float


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predicted classes and probabilities of the test samples of all folds.

    Args:
        classes: C names, sorted.
        labels: n true classes.
        predicted: n answers; empty if the fit failed.
        probabilities: (n, C) probabilities; NaN if the fit failed.
        subjects: n names of people.
        index: (n,) `test_index`, or 0 to n - 1.
        chosen: choice of each fold.
    """

    classes: tuple[str, ...]
    labels: tuple[str, ...]
    predicted: tuple[str, ...]
    probabilities: FloatArray
    subjects: tuple[str, ...]
    index: IndexArray
    chosen: tuple[Choice, ...]

    __repr__ = short_repr


def subject_folds(subjects: Sequence[str], n_folds: int, seed: int = 0) -> list[tuple[IndexArray, IndexArray]]:
    """Return (train, test) indices of folds that never split a person and have about as many samples each.

    Raises:
        InputError: fewer people than folds, or fewer than two folds.
    """
    people = np.asarray(subjects, dtype=str)
    count = len(np.unique(people))
    if not 2 <= n_folds <= count:
        raise InputError(f"{count} subjects cannot be split into {n_folds} folds; ask for 2 to {count}.")
    # With one class for all, the splitter balances the number of samples, which GroupKFold does only unshuffled.
    splitter: Any = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    return list(splitter.split(people, np.zeros(len(people)), people))


def folds_of(
    z: FloatArray, labels: Sequence[str], subjects: Sequence[str], n_folds: int = 5, seed: int = 0
) -> list[Fold]:
    """Return folds of (n, K) coefficients that all come from one shape model.

    That model may have been trained on the tested people, which makes results too good; for an unbiased estimate build
    each fold's model without them.

    Raises:
        InputError: arrays that do not belong together, or too few people.
    """
    names, people = np.asarray(labels, dtype=str), np.asarray(subjects, dtype=str)
    return [
        Fold(
            train=z[train], train_labels=names[train].tolist(), train_subjects=people[train].tolist(),
            test=z[test], test_labels=names[test].tolist(), test_subjects=people[test].tolist(), test_index=test,
        )
        for train, test in subject_folds(subjects, n_folds, seed)
    ]  # fmt: skip


def nested_predictions(
    folds: Sequence[Fold],
    *,
    classifiers: Sequence[str] = tuple(CLASSIFIERS),
    inner_folds: int = 4,
    seed: int = 0,
    modes: Sequence[int | None] = MODES,
) -> Predictions:
    """Predict the test samples of each fold with hyperparameters selected in its training subjects alone.

    The training people are again split by person: first the number of leading modes is chosen by LDA, then the
    classifier and its parameters with this number, each by macro accuracy of the held-out samples. The probabilities of
    the chosen classifier on those samples give the temperature that calibrates it. Then the classifier is fitted to all
    training people.

    Args:
        folds: outer folds.
        classifiers: names of `CLASSIFIERS` to choose from; the first of several equal ones is chosen.
        inner_folds: number of folds of the training people.
        seed: seed of the inner folds and the classifiers.
        modes: numbers of leading modes to choose from; None is all.

    Raises:
        InputError: no folds, an unknown classifier, too few people, or a class with too few people.
    """
    classes = classes_of(folds)
    check_classifiers(classifiers)
    if not classifiers or not modes:
        raise InputError("Nested cross-validation needs at least one classifier and one number of modes.")
    with threadpool_limits(1):  # small matrices: more threads are slower
        results = [_predict_fold(fold, classes, classifiers, inner_folds, seed, modes) for fold in folds]
    return _gather(folds, classes, results)


def _predict_fold(
    fold: Fold,
    classes: tuple[str, ...],
    names: Sequence[str],
    inner_folds: int,
    seed: int,
    modes: Sequence[int | None],
) -> tuple[FloatArray, Choice]:
    X, labels, subjects = usable_training_rows(fold)
    inner = subject_folds(subjects.tolist(), inner_folds, seed)
    K = X.shape[1]
    counts = sorted({min(K if m is None else m, K) for m in modes})
    by_modes = [
        cross_validated_probabilities(
            X=X[:, :m], labels=labels, folds=inner, classes=classes, classifier="lda", parameters={}, seed=seed
        )
        for m in counts
    ]
    tried = [macro_accuracy(labels, likeliest_classes(candidate, classes), classes) for candidate in by_modes]
    m = counts[int(np.argmax(tried))]
    best: tuple[float, str, dict[str, Any], FloatArray] | None = None
    fewest = min(len(train) for train, _ in inner)
    for name in names:
        for parameters in _grid(name):
            if int(parameters.get("classify__n_neighbors", 1)) > fewest:
                continue  # more neighbours than samples
            probabilities = cross_validated_probabilities(
                X=X[:, :m],
                labels=labels,
                folds=inner,
                classes=classes,
                classifier=name,
                parameters=parameters,
                seed=seed,
            )
            accuracy = macro_accuracy(labels, likeliest_classes(probabilities, classes), classes)
            if best is None or accuracy > best[0] + 1e-12:
                best = accuracy, name, parameters, probabilities
    if best is None:
        raise InputError("No classifier can be trained with so few samples; add samples.")
    accuracy, name, parameters, probabilities = best
    temperature = fit_temperature(labels.tolist(), probabilities, classes)
    fold_probabilities = predict_probabilities(
        X=X[:, :m],
        labels=labels,
        test=fold.test[:, :m],
        classes=classes,
        classifier=name,
        parameters=parameters,
        seed=seed,
    )
    return calibrated(fold_probabilities, temperature), Choice(name, parameters, m, temperature, accuracy)


def fixed_predictions(
    folds: Sequence[Fold], classifier: str, *, modes: int | None = None, seed: int = 0
) -> Predictions:
    """Predict the test samples of each fold by one classifier with fixed hyperparameters.

    Raises:
        InputError: no folds, or an unknown classifier.
    """
    classes = classes_of(folds)
    check_classifiers([classifier])
    results: list[tuple[FloatArray, Choice]] = []
    with threadpool_limits(1):
        for fold in folds:
            X, labels, _ = usable_training_rows(fold)
            m = min(modes or X.shape[1], X.shape[1])
            probabilities = predict_probabilities(
                X=X[:, :m],
                labels=labels,
                test=fold.test[:, :m],
                classes=classes,
                classifier=classifier,
                parameters={},
                seed=seed,
            )
            results.append((probabilities, Choice(classifier, {}, m, 1.0, float("nan"))))
    return _gather(folds, classes, results)


def predict_probabilities(
    X: FloatArray,
    labels: Any,
    test: FloatArray,
    classes: Sequence[str],
    classifier: str,
    parameters: Mapping[str, Any],
    seed: int = 0,
) -> FloatArray:
    """Return probabilities (m, C) of `test` (m, K) by a classifier fitted to `X` (n, K).

    Rows of `test` that are not finite give NaN; classes without training samples have probability 0.
    """
    pipeline: Any = CLASSIFIERS[classifier](seed).set_params(**parameters)
    neighbours = int(getattr(pipeline[-1], "n_neighbors", 1))
    if neighbours > len(X):
        raise InputError(f"{neighbours} nearest neighbours need more than {len(X)} training samples; add samples.")
    finite = np.isfinite(test).all(axis=1)
    present = np.unique(np.asarray(labels, dtype=str))
    if len(present) == 1:  # occurs in inner folds of very few people; several classifiers raise an error
        probabilities = np.full((len(test), len(classes)), np.nan)
        probabilities[finite] = 0.0
        probabilities[finite, list(classes).index(str(present[0]))] = 1.0
        return probabilities
    pipeline.fit(X, labels)
    probabilities = np.full((len(test), len(classes)), np.nan)
    if finite.any():
        columns = [classes.index(name) for name in pipeline.classes_.tolist()]
        probabilities_known = np.zeros((int(finite.sum()), len(classes)))
        probabilities_known[:, columns] = pipeline.predict_proba(test[finite])
        probabilities[finite] = probabilities_known
    return probabilities


def cross_validated_probabilities(
    X: FloatArray,
    labels: Any,
    folds: Sequence[tuple[IndexArray, IndexArray]],
    classes: Sequence[str],
    classifier: str,
    parameters: Mapping[str, Any],
    seed: int = 0,
) -> FloatArray:
    """Return probabilities (n, C) of each sample by the classifier fitted to the folds without it."""
    probabilities = np.full((len(X), len(classes)), np.nan)
    for train, test in folds:
        probabilities[test] = predict_probabilities(
            X=X[train],
            labels=labels[train],
            test=X[test],
            classes=classes,
            classifier=classifier,
            parameters=parameters,
            seed=seed,
        )
    return probabilities


def classes_of(folds: Sequence[Fold]) -> tuple[str, ...]:
    """Return all classes in order; raise InputError if there are fewer than two, or no folds."""
    if not folds:
        raise InputError("There are no folds to evaluate.")
    classes = sorted({label for fold in folds for label in (*fold.train_labels, *fold.test_labels)})
    if len(classes) < 2:
        raise InputError("Recognition needs at least two classes.")
    return tuple(classes)


def check_classifiers(names: Sequence[str]) -> None:
    """Raise InputError for names that are not in `CLASSIFIERS`."""
    for name in names:
        if name not in CLASSIFIERS:
            raise InputError(f"There is no classifier {name!r}; choose among {', '.join(CLASSIFIERS)}.")


def usable_training_rows(fold: Fold) -> tuple[FloatArray, Any, Any]:
    """Return the finite training rows with labels and subjects as arrays."""
    finite = np.isfinite(fold.train).all(axis=1)
    labels = np.asarray(fold.train_labels, dtype=str)[finite]
    if len(np.unique(labels)) < 2:
        raise InputError("The training part of a fold has fewer than two classes with fits that can be used.")
    return fold.train[finite], labels, np.asarray(fold.train_subjects, dtype=str)[finite]


def likeliest_classes(probabilities: FloatArray, classes: Sequence[str]) -> Any:
    """Return the likeliest classes (n,); empty if a fit failed."""
    undefined = np.isnan(probabilities).any(axis=1)
    best = np.where(np.isnan(probabilities), -1.0, probabilities).argmax(axis=1)
    return np.where(undefined, "", np.asarray(classes)[best])


def _grid(name: str) -> Iterator[dict[str, Any]]:
    grid = GRIDS.get(name, {})
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def _gather(
    folds: Sequence[Fold], classes: tuple[str, ...], results: Sequence[tuple[FloatArray, Choice]]
) -> Predictions:
    probabilities = np.concatenate([fold_probabilities for fold_probabilities, _ in results])
    labels = np.concatenate([np.asarray(fold.test_labels, dtype=str) for fold in folds])
    subjects = np.concatenate([np.asarray(fold.test_subjects, dtype=str) for fold in folds])
    index = np.arange(len(labels))
    if all(fold.test_index is not None for fold in folds):
        index = np.concatenate([np.asarray(fold.test_index) for fold in folds])
    order = np.argsort(index, kind="stable")
    return Predictions(
        classes=classes,
        labels=tuple(labels[order].tolist()),
        predicted=tuple(likeliest_classes(probabilities, classes)[order].tolist()),
        probabilities=probabilities[order],
        subjects=tuple(subjects[order].tolist()),
        index=index[order],
        chosen=tuple(choice for _, choice in results),
    )


IndexArray: TypeAlias = npt.NDArray[np.integer[Any]]

_LEAST_PROBABILITY = 1e-6  # keeps the logarithm finite


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of predicted probabilities.

    Args:
        confidence: (B,) mean highest probability in each bin that is not empty.
        accuracy: (B,) share of correct answers in each bin.
        count: (B,) number of samples in each bin.
        expected_calibration_error: mean of |accuracy - confidence| over the samples (Guo et al., ICML 2017).
        brier: mean summed squared error of the probabilities, 0 to 2.
        log_loss: mean negative logarithm of the probability of the true class, nats.
    """

    confidence: FloatArray
    accuracy: FloatArray
    count: IndexArray
    expected_calibration_error: float
    brier: float
    log_loss: float


@dataclass(frozen=True)
class ClassScores:
    """Precision, recall and F1 score of one class.

    Args:
        precision: share of correct predictions among those of this class; NaN if there are none.
        recall: share of correct predictions among the samples of this class.
        f1: harmonic mean of precision and recall.
        count: number of samples of the class.
    """

    precision: float
    recall: float
    f1: float
    count: int


def macro_accuracy(labels: Sequence[str] | Any, predicted: Sequence[str] | Any, classes: Sequence[str]) -> float:
    """Return the mean over the classes of the share of their samples with a correct prediction.

    Classes without a sample do not count; any answer except the true class is wrong, also none and "unsure".
    """
    truth, answers = np.asarray(labels, dtype=str), np.asarray(predicted, dtype=str)
    class_masks = [truth == name for name in classes]
    # recall_score(average="macro") gives the same in 2 ms instead of 0.06, and this runs thousands of times.
    recalls = [
        float((answers[is_member] == name).mean())
        for is_member, name in zip(class_masks, classes, strict=True)
        if is_member.any()
    ]
    if not recalls:
        raise InputError("Accuracy needs at least one sample of the classes.")
    return float(np.mean(recalls))


def confusion(labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str]) -> IndexArray:
    """Return counts (C, C + 1): rows are true classes, columns predicted classes; the last column has all other
    answers.
    """
    answers = [prediction if prediction in classes else "" for prediction in predicted]
    return confusion_matrix(list(labels), answers, labels=[*classes, ""])[:-1]


def per_class(labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str]) -> dict[str, ClassScores]:
    """Return precision, recall, F1 and count of each class."""
    scores = precision_recall_fscore_support(list(labels), list(predicted), labels=list(classes), zero_division=np.nan)
    return {
        name: ClassScores(float(precision), float(recall), float(f1), int(count))
        for name, precision, recall, f1, count in zip(classes, *scores, strict=True)
    }


def subject_bootstrap(
    labels: Sequence[str],
    predicted: Sequence[str],
    subjects: Sequence[str],
    *,
    draws: int = 2000,
    seed: int = 0,
    level: float = 0.95,
) -> tuple[float, float]:
    """Return the bootstrap percentile interval of the macro accuracy, resampling people with all their samples.

    Near 0 and 1 it is at least as wide as the exact interval without an error among as many people as show the rarest
    class.
    """
    names, truth = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    people, owner = np.unique(np.asarray(subjects, dtype=str), return_inverse=True)
    right = np.asarray(predicted, dtype=str) == names[truth]
    hits, counts = np.zeros((len(people), len(names))), np.zeros((len(people), len(names)))
    np.add.at(hits, (owner, truth), right)
    np.add.at(counts, (owner, truth), 1)
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(people), np.full(len(people), 1 / len(people)), size=draws)
    # A draw may miss a class altogether; it then does not count, as in macro_accuracy.
    total = drawn @ counts
    shares = np.divide(drawn @ hits, total, out=np.full(total.shape, np.nan), where=total > 0)
    low, high = np.quantile(np.nanmean(shares, axis=1), [(1 - level) / 2, (1 + level) / 2])
    low, high = widen_share(low, high, int((counts > 0).sum(axis=0).min()), level)
    return float(low), float(high)


def calibration(
    labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str], *, bins: int = 10
) -> Calibration:
    """Compare probabilities (n, C) with observed frequencies; rows that are not finite are excluded.

    Raises:
        InputError: arrays that do not belong together, or no row with probabilities.
    """
    truth, p = _select_finite(labels, probabilities, classes)
    confidence, right = p.max(axis=1), p.argmax(axis=1) == truth
    bin_index = np.minimum((confidence * bins).astype(np.int64), bins - 1)
    count = np.bincount(bin_index, minlength=bins)
    used = count > 0
    mean = np.bincount(bin_index, confidence, bins)[used] / count[used]
    accuracy = np.bincount(bin_index, right, bins)[used] / count[used]
    target = np.eye(len(classes))[truth]
    return Calibration(
        mean,
        accuracy,
        count[used],
        float((count[used] * np.abs(accuracy - mean)).sum() / count.sum()),
        float(((p - target) ** 2).sum(axis=1).mean()),
        float(-np.log(np.maximum(p[np.arange(len(p)), truth], _LEAST_PROBABILITY)).mean()),
    )


def fit_temperature(labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str]) -> float:
    """Return the temperature that maximises the likelihood of held-out probabilities (n, C) (Guo et al., ICML 2017).

    The true class counts for 1 - 1 / (n + 2), as in Platt's calibration (1999): a few samples that are all correct do
    not ensure that the next one is.

    Raises:
        InputError: arrays that do not belong together, or no row with probabilities.
    """
    truth, p = _select_finite(labels, probabilities, classes)
    logits = np.log(np.maximum(p, _LEAST_PROBABILITY))
    return likeliest_temperature(logits, truth, doubt=1 / (len(p) + 2), bounds=(0.1, 100.0))


def calibrated(probabilities: FloatArray, temperature: float) -> FloatArray:
    """Return probabilities (n, C) at another temperature; the likeliest class is unchanged."""
    logits = np.log(np.maximum(probabilities, _LEAST_PROBABILITY))
    return np.asarray(softmax(logits / temperature, axis=1), dtype=np.float64)


def _select_finite(labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str]) -> tuple[Any, Any]:
    if probabilities.shape != (len(labels), len(classes)):
        raise InputError(
            f"{len(labels)} labels of {len(classes)} classes need probabilities of that shape, not "
            f"{probabilities.shape}."
        )
    column = {name: k for k, name in enumerate(classes)}
    unknown = sorted(set(labels) - set(column))
    if unknown:
        raise InputError(f"The label {unknown[0]!r} is not among the classes.")
    finite = np.isfinite(probabilities).all(axis=1)
    if not finite.any():
        raise InputError("There is no sample with probabilities, so they cannot be compared with the labels.")
    truth = np.asarray([column[name] for name in labels], dtype=np.int64)
    return truth[finite], probabilities[finite]
