"""How well classes are recognised in people who were not trained on: folds by subject, nested choice, tests, curves.

Everything here works on arrays of whitened coefficients, (n, K). A `Fold` carries its own training and test arrays, so
that the shape model behind them may be another one in each fold, made without the people tested. A test row that is not
finite stands for a fit that failed: it gets no answer, and counts as wrong. Such training rows are left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax
from threadpoolctl import threadpool_limits

from shapespace.errors import InputError
from shapespace.recognise.classifiers import CLASSIFIERS, GRIDS, LDA_SHRINKAGE, linear_rule
from shapespace.types import FloatArray

IndexArray: TypeAlias = npt.NDArray[np.integer[Any]]

MODES: tuple[int | None, ...] = (10, 20, 40, None)
"""Numbers of leading modes among which nested cross-validation chooses; None is all."""

_LEAST_PROBABILITY = 1e-6


@dataclass(frozen=True, eq=False)
class Fold:
    """One training and one test set, of different people.

    Args:
        train: (n, K) coefficients in standard deviations.
        train_labels: n classes.
        train_subjects: n names of people.
        test: (m, K), by the same model.
        test_labels: m classes.
        test_subjects: m names of people, none of them trained on.
        test_index: (m,) place of each test sample in the whole, which orders `Predictions`; None keeps the order of the
            folds.

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
        both = sorted(set(self.train_subjects) & set(self.test_subjects))
        if both:
            raise InputError(f"{', '.join(both[:3])} would be trained on and tested; split the samples by subject.")


@dataclass(frozen=True)
class Choice:
    """What nested cross-validation chose within the training people of one fold.

    Args:
        classifier: a name of `CLASSIFIERS`.
        parameters: of its pipeline.
        modes: number of leading modes.
        temperature: that calibrates its probabilities.
        macro_accuracy: of the choice, within the training people.
    """

    classifier: str
    parameters: Mapping[str, Any]
    modes: int
    temperature: float
    macro_accuracy: float


@dataclass(frozen=True, eq=False)
class Predictions:
    """Answers for the test samples of all folds.

    Args:
        classes: C names, sorted.
        labels: n true classes.
        predicted: n answers; empty where the fit failed.
        probabilities: (n, C); NaN where the fit failed.
        subjects: n names of people.
        index: (n,) `test_index`, or 0 to n - 1.
        chosen: one a fold.
    """

    classes: tuple[str, ...]
    labels: tuple[str, ...]
    predicted: tuple[str, ...]
    probabilities: FloatArray
    subjects: tuple[str, ...]
    index: IndexArray
    chosen: tuple[Choice, ...]


@dataclass(frozen=True, eq=False)
class PermutationTest:
    """Macro accuracy, and what it is where labels mean nothing.

    Args:
        observed: with the labels as they are.
        null: (P,) with labels shuffled within each subject.
        p: how often shuffled labels did at least as well, counting the observed ones.
    """

    observed: float
    null: FloatArray
    p: float


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """Macro accuracy against the number of people trained on.

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


@dataclass(frozen=True, eq=False)
class Calibration:
    """Whether probabilities are what they say.

    Args:
        confidence: (B,) mean highest probability in each bin that is not empty.
        accuracy: (B,) share of right answers there.
        count: (B,) samples there.
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
    """One class.

    Args:
        precision: share of right ones among those called so; NaN where none was.
        recall: share of right ones among those that are so.
        f1: their harmonic mean.
        count: samples of the class.
    """

    precision: float
    recall: float
    f1: float
    count: int


def subject_folds(subjects: Sequence[str], n_folds: int, seed: int = 0) -> list[tuple[IndexArray, IndexArray]]:
    """Return (train, test) indices of folds that never split a person and have about as many samples each.

    Raises:
        InputError: fewer people than folds, or fewer than two folds.
    """
    names, owner, counts = np.unique(np.asarray(subjects, dtype=str), return_inverse=True, return_counts=True)
    if not 2 <= n_folds <= len(names):
        raise InputError(f"{len(names)} people cannot be split into {n_folds} folds; ask for 2 to {len(names)}.")
    shuffled = np.random.default_rng(seed).permutation(len(names))
    # Those with most samples first, each to the fold that has fewest.
    order = shuffled[np.argsort(-counts[shuffled], kind="stable")]
    size = np.zeros(n_folds)
    fold = np.zeros(len(names), dtype=np.int64)
    for person in order:
        fold[person] = size.argmin()
        size[fold[person]] += counts[person]
    where = fold[owner]
    return [(np.flatnonzero(where != f), np.flatnonzero(where == f)) for f in range(n_folds)]


def folds_of(
    z: FloatArray, labels: Sequence[str], subjects: Sequence[str], n_folds: int = 5, seed: int = 0
) -> list[Fold]:
    """Return folds of (n, K) coefficients that all come from one shape model.

    That model may have seen the people tested, which flatters; for an honest figure make each fold's model without
    them.

    Raises:
        InputError: arrays that do not belong together, or too few people.
    """
    names, people = np.asarray(labels, dtype=str), np.asarray(subjects, dtype=str)
    return [
        Fold(
            z[train], names[train].tolist(), people[train].tolist(),
            z[test], names[test].tolist(), people[test].tolist(), test,
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
    on_fold: Callable[[int, int], None] | None = None,
) -> Predictions:
    """Predict the test samples of each fold by what was chosen among its training people alone.

    Inside the training people, again split by person: first the number of leading modes is chosen by LDA, then the
    classifier and its parameters with that many, each by macro accuracy of the samples left out. The probabilities of
    the chosen one on those samples give the temperature that calibrates it. Then it is fitted to all training people.

    Args:
        folds: the outer folds.
        classifiers: names of `CLASSIFIERS` to choose from; among equals the first is taken.
        inner_folds: folds of the training people.
        seed: of the inner folds and the classifiers.
        modes: numbers of leading modes to choose from; None is all.
        on_fold: told of folds done and their number.

    Raises:
        InputError: no folds, an unknown classifier, too few people, or a class in too few of them.
    """
    classes = _classes(folds)
    _check_names(classifiers)
    if not classifiers or not modes:
        raise InputError("Nested cross-validation needs at least one classifier and one number of modes.")
    found: list[tuple[FloatArray, Choice]] = []
    with threadpool_limits(1):  # small matrices: more threads cost more than they give
        for number, fold in enumerate(folds, 1):
            found.append(_nested(fold, classes, classifiers, inner_folds, seed, modes))
            if on_fold is not None:
                on_fold(number, len(folds))
    return _gather(folds, classes, found)


def _nested(
    fold: Fold,
    classes: tuple[str, ...],
    names: Sequence[str],
    inner_folds: int,
    seed: int,
    modes: Sequence[int | None],
) -> tuple[FloatArray, Choice]:
    X, labels, subjects = _usable(fold)
    inner = subject_folds(subjects.tolist(), inner_folds, seed)
    K = X.shape[1]
    counts = sorted({min(K if m is None else m, K) for m in modes})
    tried = [
        macro_accuracy(labels, _answers(left_out(X[:, :m], labels, inner, classes, "lda", {}, seed), classes), classes)
        for m in counts
    ]
    m = counts[int(np.argmax(tried))]
    best: tuple[float, str, dict[str, Any], FloatArray] | None = None
    fewest = min(len(train) for train, _ in inner)
    for name in names:
        for parameters in _grid(name):
            if int(parameters.get("classify__n_neighbors", 1)) > fewest:
                continue  # so many neighbours there are not
            probabilities = left_out(X[:, :m], labels, inner, classes, name, parameters, seed)
            accuracy = macro_accuracy(labels, _answers(probabilities, classes), classes)
            if best is None or accuracy > best[0] + 1e-12:
                best = accuracy, name, parameters, probabilities
    if best is None:
        raise InputError("None of the classifiers can be had with so few training samples; add samples.")
    accuracy, name, parameters, probabilities = best
    temperature = fit_temperature(labels.tolist(), probabilities, classes)
    answer = predict_probabilities(X[:, :m], labels, fold.test[:, :m], classes, name, parameters, seed)
    return calibrated(answer, temperature), Choice(name, parameters, m, temperature, accuracy)


def fixed_predictions(
    folds: Sequence[Fold], classifier: str, *, modes: int | None = None, seed: int = 0
) -> Predictions:
    """Predict the test samples of each fold by one classifier with its own settings, with nothing to choose.

    Raises:
        InputError: no folds, or an unknown classifier.
    """
    classes = _classes(folds)
    _check_names([classifier])
    found: list[tuple[FloatArray, Choice]] = []
    with threadpool_limits(1):
        for fold in folds:
            X, labels, _ = _usable(fold)
            m = min(modes or X.shape[1], X.shape[1])
            answer = predict_probabilities(X[:, :m], labels, fold.test[:, :m], classes, classifier, {}, seed)
            found.append((answer, Choice(classifier, {}, m, 1.0, float("nan"))))
    return _gather(folds, classes, found)


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

    Rows of `test` that are not finite give NaN; classes that the training samples lack have probability 0.
    """
    pipeline: Any = CLASSIFIERS[classifier](seed).set_params(**parameters)
    neighbours = int(getattr(pipeline[-1], "n_neighbors", 1))
    if neighbours > len(X):
        raise InputError(f"{neighbours} nearest neighbours cannot be had among {len(X)} training samples; add samples.")
    finite = np.isfinite(test).all(axis=1)
    only = np.unique(np.asarray(labels, dtype=str))
    if len(only) == 1:  # as happens in inner folds of very few people; several classifiers refuse it
        answer = np.full((len(test), len(classes)), np.nan)
        answer[finite] = 0.0
        answer[finite, list(classes).index(str(only[0]))] = 1.0
        return answer
    pipeline.fit(X, labels)
    answer = np.full((len(test), len(classes)), np.nan)
    if finite.any():
        columns = [classes.index(name) for name in pipeline.classes_.tolist()]
        known = np.zeros((int(finite.sum()), len(classes)))
        known[:, columns] = pipeline.predict_proba(test[finite])
        answer[finite] = known
    return answer


def left_out(
    X: FloatArray,
    labels: Any,
    folds: Sequence[tuple[IndexArray, IndexArray]],
    classes: Sequence[str],
    classifier: str,
    parameters: Mapping[str, Any],
    seed: int = 0,
) -> FloatArray:
    """Return probabilities (n, C) of each sample by the classifier fitted to the folds that do not hold it."""
    answer = np.full((len(X), len(classes)), np.nan)
    for train, test in folds:
        answer[test] = predict_probabilities(X[train], labels[train], X[test], classes, classifier, parameters, seed)
    return answer


# Scores


def macro_accuracy(labels: Sequence[str] | Any, predicted: Sequence[str] | Any, classes: Sequence[str]) -> float:
    """Return the mean over the classes of the share of their samples that were answered rightly.

    Classes without a sample do not count; any answer but the right class is wrong, also none and "unsure".
    """
    truth, answer = np.asarray(labels, dtype=str), np.asarray(predicted, dtype=str)
    own = [truth == name for name in classes]
    recalls = [float((answer[mine] == name).mean()) for mine, name in zip(own, classes, strict=True) if mine.any()]
    if not recalls:
        raise InputError("Accuracy needs at least one sample of the classes.")
    return float(np.mean(recalls))


def confusion(labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str]) -> IndexArray:
    """Return counts (C, C + 1): rows are the true classes, columns the answers; the last holds all other answers."""
    column = {name: k for k, name in enumerate(classes)}
    counts = np.zeros((len(classes), len(classes) + 1), dtype=np.int64)
    for truth, answer in zip(labels, predicted, strict=True):
        if truth in column:
            counts[column[truth], column.get(answer, len(classes))] += 1
    return counts


def per_class(labels: Sequence[str], predicted: Sequence[str], classes: Sequence[str]) -> dict[str, ClassScores]:
    """Return precision, recall, F1 and count of each class."""
    counts = confusion(labels, predicted, classes)
    called, there = counts[:, :-1].sum(axis=0), counts.sum(axis=1)
    scores: dict[str, ClassScores] = {}
    for k, name in enumerate(classes):
        right = int(counts[k, k])
        scores[name] = ClassScores(
            precision=right / int(called[k]) if called[k] else float("nan"),
            recall=right / int(there[k]) if there[k] else float("nan"),
            f1=2 * right / int(called[k] + there[k]) if called[k] + there[k] else float("nan"),
            count=int(there[k]),
        )
    return scores


def subject_bootstrap(
    labels: Sequence[str],
    predicted: Sequence[str],
    subjects: Sequence[str],
    *,
    draws: int = 2000,
    seed: int = 0,
    level: float = 0.95,
) -> tuple[float, float]:
    """Return the bootstrap percentile interval of the macro accuracy, drawing whole people with replacement."""
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
    return float(low), float(high)


# Tests and curves


def permutation_test(
    folds: Sequence[Fold], classifier: str = "lda", *, permutations: int = 200, seed: int = 0
) -> PermutationTest:
    """Test whether labels mean anything, by shuffling them within each person.

    A person's labels are shuffled alike in every fold, so that the whole experiment is run again with wrong labels. The
    rows of a person must therefore come in the same order in every fold. LDA is solved in closed form, which takes
    milliseconds; other classifiers take their time.

    Args:
        folds: the outer folds.
        classifier: a name of `CLASSIFIERS`, with its own settings.
        permutations: how many.
        seed: of the permutations.

    Raises:
        InputError: no folds, an unknown classifier, or people whose number of rows differs between folds.
    """
    classes = _classes(folds)
    _check_names([classifier])
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
    """A fold made ready for many labellings: rows of each person, finite training rows, scaled arrays, their Gram."""

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
        fold,
        np.searchsorted(names, np.asarray(fold.train_labels, dtype=str)),
        np.searchsorted(names, np.asarray(fold.test_labels, dtype=str)),
        _rows(fold.train_subjects),
        _rows(fold.test_subjects),
        finite,
        X,
        (fold.test - mean) / spread,
        X.T @ X,
    )


def _rows(subjects: Sequence[str]) -> dict[str, IndexArray]:
    people = np.asarray(subjects, dtype=str)
    return {name: np.flatnonzero(people == name) for name in np.unique(people).tolist()}


def _shuffled(labels: Any, rows: Mapping[str, IndexArray], order: Mapping[str, IndexArray]) -> Any:
    if not order:
        return labels
    out = labels.copy()
    for name, mine in rows.items():
        out[mine] = labels[mine][order[name]]
    return out


def _score_lda(
    folds: Sequence[_Prepared], classes: Sequence[str], order: Mapping[str, IndexArray], classifier: str, seed: int
) -> float:
    hits, counts = np.zeros(len(classes)), np.zeros(len(classes))
    unit = np.eye(len(classes))
    for p in folds:
        member = unit[_shuffled(p.train_labels, p.train_rows, order)[p.finite]]
        there = np.flatnonzero(member.any(axis=0))
        coef, intercept = linear_rule(p.X, member[:, there], p.gram, LDA_SHRINKAGE)
        scores = p.test @ coef.T + intercept
        lost = np.isnan(scores).any(axis=1)
        answer = np.where(lost, -1, there[np.where(np.isnan(scores), -np.inf, scores).argmax(axis=1)])
        truth = _shuffled(p.test_labels, p.test_rows, order)
        hits += np.bincount(truth[answer == truth], minlength=len(classes))
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
        found = predict_probabilities(p.fold.train[p.finite], labels, p.fold.test, classes, classifier, {}, seed)
        truth += names[_shuffled(p.test_labels, p.test_rows, order)].tolist()
        answers += _answers(found, classes).tolist()
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

    The coefficients stay those of the fold's own model; only the classifier sees fewer people.

    Args:
        folds: the outer folds.
        classifier: a name of `CLASSIFIERS`, with its own settings.
        subject_counts: people to train on; those that a fold does not have are left out of the curve.
        repeats: draws of people.
        seed: of the draws.

    Raises:
        InputError: no folds, an unknown classifier, or no fold with so many people.
    """
    classes = _classes(folds)
    _check_names([classifier])
    fewest = min(len(set(fold.train_subjects)) for fold in folds)
    counts = [n for n in subject_counts if 1 <= n <= fewest]
    if not counts or repeats < 1:
        raise InputError(f"The folds have {fewest} people to train on, so the learning curve has no point to show.")
    rng = np.random.default_rng(seed)
    curve = np.zeros((len(counts), repeats))
    truth = [label for fold in folds for label in fold.test_labels]
    with threadpool_limits(1):
        for i, j in itertools.product(range(len(counts)), range(repeats)):
            answers: list[str] = []
            for fold in folds:
                X, labels, subjects = _usable(fold)
                people = rng.choice(np.unique(np.asarray(fold.train_subjects, dtype=str)), counts[i], replace=False)
                mine = np.isin(subjects, people)
                found = predict_probabilities(X[mine], labels[mine], fold.test, classes, classifier, {}, seed)
                answers += _answers(found, classes).tolist()
            curve[i, j] = macro_accuracy(truth, answers, classes)
    return LearningCurve(np.asarray(counts, dtype=np.int64), curve)


def mode_importance(
    folds: Sequence[Fold], classifier: str = "lda", *, modes: int | None = None, repeats: int = 5, seed: int = 0
) -> FloatArray:
    """Return how much macro accuracy a fold loses when one mode's values are shuffled among its test samples, (F, K).

    Modes of folds with shape models of their own agree only about; read the mean over the folds with that in mind.

    Args:
        folds: the outer folds.
        classifier: a name of `CLASSIFIERS`, with its own settings.
        modes: number of leading modes that it sees; None is all. The others have importance 0.
        repeats: shuffles of each mode, whose losses are averaged.
        seed: of the shuffles.

    Raises:
        InputError: no folds, or an unknown classifier.
    """
    classes = _classes(folds)
    _check_names([classifier])
    rng = np.random.default_rng(seed)
    loss = np.zeros((len(folds), folds[0].train.shape[1]))
    with threadpool_limits(1):
        for f, fold in enumerate(folds):
            X, labels, _ = _usable(fold)
            m = min(modes or X.shape[1], X.shape[1])
            finite = np.isfinite(fold.test).all(axis=1)
            test, truth = fold.test[finite, :m], np.asarray(fold.test_labels, dtype=str)[finite]
            pipeline: Any = CLASSIFIERS[classifier](seed)
            pipeline.fit(X[:, :m], labels)
            base = macro_accuracy(truth, pipeline.predict(test), classes)
            for k in range(m):
                for _ in range(repeats):
                    shuffled = test.copy()
                    shuffled[:, k] = rng.permutation(test[:, k])
                    loss[f, k] += (base - macro_accuracy(truth, pipeline.predict(shuffled), classes)) / repeats
    return loss


# Calibration


def calibration(
    labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str], *, bins: int = 10
) -> Calibration:
    """Compare probabilities (n, C) with how often they come true; rows that are not finite are left out.

    Raises:
        InputError: arrays that do not belong together, or no row with probabilities.
    """
    truth, p = _with_probabilities(labels, probabilities, classes)
    confidence, right = p.max(axis=1), p.argmax(axis=1) == truth
    where = np.minimum((confidence * bins).astype(np.int64), bins - 1)
    count = np.bincount(where, minlength=bins)
    used = count > 0
    mean = np.bincount(where, confidence, bins)[used] / count[used]
    accuracy = np.bincount(where, right, bins)[used] / count[used]
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
    """Return the temperature at which probabilities (n, C) of samples left out are most likely (Guo et al., ICML 2017).

    The true class counts for 1 - 1 / (n + 2), as in Platt's calibration (1999): few samples that all are right do not
    show that the next is.

    Raises:
        InputError: arrays that do not belong together, or no row with probabilities.
    """
    truth, p = _with_probabilities(labels, probabilities, classes)
    logits = np.log(np.maximum(p, _LEAST_PROBABILITY))
    doubt = 1 / (len(p) + 2)
    target = (1 - doubt) * np.eye(len(classes))[truth] + doubt / len(classes)

    def surprise(log_temperature: float) -> float:
        return -float((target * log_softmax(logits / np.exp(log_temperature), axis=1)).sum(axis=1).mean())

    found: Any = minimize_scalar(surprise, bounds=(np.log(0.1), np.log(100.0)), method="bounded")
    return float(np.exp(found.x))


def calibrated(probabilities: FloatArray, temperature: float) -> FloatArray:
    """Return probabilities (n, C) at another temperature; which class is likeliest stays."""
    logits = np.log(np.maximum(probabilities, _LEAST_PROBABILITY))
    return np.asarray(softmax(logits / temperature, axis=1), dtype=np.float64)


def _with_probabilities(labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str]) -> tuple[Any, Any]:
    if probabilities.shape != (len(labels), len(classes)):
        raise InputError(
            f"{len(labels)} labels of {len(classes)} classes need probabilities of that shape, not "
            f"{probabilities.shape}."
        )
    place = {name: k for k, name in enumerate(classes)}
    unknown = sorted(set(labels) - set(place))
    if unknown:
        raise InputError(f"The label {unknown[0]!r} is none of the classes.")
    finite = np.isfinite(probabilities).all(axis=1)
    if not finite.any():
        raise InputError("There is no sample with probabilities, so they cannot be compared with the labels.")
    truth = np.asarray([place[name] for name in labels], dtype=np.int64)
    return truth[finite], probabilities[finite]


# Where on the face


def decision_map(
    vertex_basis: FloatArray, stddev: FloatArray, v: FloatArray, labels: Sequence[str], *, noise_mm: float = 0.1
) -> FloatArray:
    """Return how far each vertex tells the classes apart, (V,): its Fisher ratio, to be drawn on the face.

    The ratio is the variance of the class means of a vertex's displacement over its variance within classes, both
    summed over the three coordinates. `noise_mm` stands below, so that vertices which hardly move do not stand out.

    Args:
        vertex_basis: (V, 3, K) displacement of each vertex with one mm of each coefficient.
        stddev: (K,) of the coefficients, mm.
        v: (n, K) coefficients in standard deviations, relative to neutral or not.
        labels: n classes.
        noise_mm: displacement that counts as nothing.

    Raises:
        InputError: arrays that do not belong together, or one class only.
    """
    names, own = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    V, K = vertex_basis.shape[0], vertex_basis.shape[-1]
    if vertex_basis.shape != (V, 3, K) or v.shape != (len(labels), K) or stddev.shape != (K,):
        raise InputError(
            f"A decision map needs a (V, 3, K) basis, (K,) deviations and (n, K) coefficients, not "
            f"{vertex_basis.shape}, {stddev.shape} and {v.shape}."
        )
    if len(names) < 2 or not np.isfinite(v).all():
        raise InputError("A decision map needs finite coefficients of at least two classes.")
    between, within = _scatter(v * stddev, own)
    return _vertex_variance(vertex_basis, between) / (_vertex_variance(vertex_basis, within) + noise_mm**2)


def region_shares(decision: FloatArray, regions: Mapping[str, IndexArray]) -> dict[str, float]:
    """Return each region's share of a decision map (V,): its mean there over the sum of the regions' means.

    Args:
        decision: (V,) not negative.
        regions: name -> vertex indices.
    """
    means = {name: float(decision[vertices].mean()) for name, vertices in regions.items() if len(vertices)}
    total = sum(means.values())
    return {name: mean / total if total > 0 else 0.0 for name, mean in means.items()}


def _scatter(b: FloatArray, own: Any) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (K, K) of the class means and that within classes, over all samples."""
    member = np.eye(int(own.max()) + 1)[own]
    means = (member.T @ b) / member.sum(axis=0)[:, None]
    inner, outer = b - means[own], means[own] - b.mean(axis=0)
    return outer.T @ outer / len(b), inner.T @ inner / len(b)


def _vertex_variance(basis: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(((basis @ covariance) * basis).sum(axis=(1, 2)), dtype=np.float64)


def _classes(folds: Sequence[Fold]) -> tuple[str, ...]:
    if not folds:
        raise InputError("There are no folds to evaluate.")
    classes = sorted({label for fold in folds for label in (*fold.train_labels, *fold.test_labels)})
    if len(classes) < 2:
        raise InputError("Recognition needs at least two classes.")
    return tuple(classes)


def _check_names(names: Sequence[str]) -> None:
    for name in names:
        if name not in CLASSIFIERS:
            raise InputError(f"There is no classifier {name!r}; choose among {', '.join(CLASSIFIERS)}.")


def _usable(fold: Fold) -> tuple[FloatArray, Any, Any]:
    """Return the finite training rows with labels and subjects as arrays."""
    finite = np.isfinite(fold.train).all(axis=1)
    labels = np.asarray(fold.train_labels, dtype=str)[finite]
    if len(np.unique(labels)) < 2:
        raise InputError("The training part of a fold has fewer than two classes with fits that can be used.")
    return fold.train[finite], labels, np.asarray(fold.train_subjects, dtype=str)[finite]


def _answers(probabilities: FloatArray, classes: Sequence[str]) -> Any:
    lost = np.isnan(probabilities).any(axis=1)
    best = np.where(np.isnan(probabilities), -1.0, probabilities).argmax(axis=1)
    return np.where(lost, "", np.asarray(classes)[best])


def _grid(name: str) -> Iterator[dict[str, Any]]:
    grid = GRIDS.get(name, {})
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def _gather(folds: Sequence[Fold], classes: tuple[str, ...], found: Sequence[tuple[FloatArray, Choice]]) -> Predictions:
    probabilities = np.concatenate([answer for answer, _ in found])
    labels = np.concatenate([np.asarray(fold.test_labels, dtype=str) for fold in folds])
    subjects = np.concatenate([np.asarray(fold.test_subjects, dtype=str) for fold in folds])
    index = np.arange(len(labels))
    if all(fold.test_index is not None for fold in folds):
        index = np.concatenate([np.asarray(fold.test_index) for fold in folds])
    order = np.argsort(index, kind="stable")
    return Predictions(
        classes,
        tuple(labels[order].tolist()),
        tuple(_answers(probabilities, classes)[order].tolist()),
        probabilities[order],
        tuple(subjects[order].tolist()),
        index[order],
        tuple(choice for _, choice in found),
    )
