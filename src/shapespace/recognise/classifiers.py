"""Classifiers of whitened coefficients z: scikit-learn pipelines by name, and nearest mean direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax

from shapespace.recognise.learn import (
    SVC,
    BaseEstimator,
    ClassifierMixin,
    KNeighborsClassifier,
    LogisticRegression,
    Pipeline,
    StandardScaler,
    StratifiedKFold,
    check_classification_targets,
    check_is_fitted,
    cross_val_predict,
    validate_data,
)
from shapespace.types import FloatArray

LDA_SHRINKAGE = 0.1
"""Default share of the isotropic covariance in the covariance of the LDA."""


class NearestMeanDirection(ClassifierMixin, BaseEstimator):
    """The class whose mean direction has the largest cosine with a sample, seen from the origin (the paper, figure 9).

    Meant for coefficients relative to the subject's neutral: an expression at another intensity then lies in the same
    direction. Probabilities are a softmax of the cosines over a temperature, which maximises the likelihood of the
    training samples, each excluded from the mean of its class. A sample at the origin has no direction and equal
    probabilities.

    Args:
        temperature: temperature of the softmax; None estimates it in `fit`.

    Attributes:
        classes_: (C,) the classes, sorted.
        directions_: (C, K) mean directions, of length 1, or 0 where a class has none.
        temperature_: the temperature in use.
    """

    def __init__(self, temperature: float | None = None) -> None:
        self.temperature = temperature

    def fit(self, X: Any, y: Any) -> NearestMeanDirection:
        """Take the mean directions of samples `X` (n, K) with classes `y` (n,).

        Raises:
            ValueError: arrays that do not belong together, values that are not finite, a temperature not above 0.
        """
        X, y = validate_data(self, X, y, dtype=np.float64)
        check_classification_targets(y)
        if self.temperature is not None and not self.temperature > 0:
            raise ValueError(f"The temperature must be above 0, not {self.temperature!r}.")
        self.classes_, class_index = np.unique(y, return_inverse=True)
        unit = _directions(X)
        sums = np.eye(len(self.classes_))[class_index].T @ unit
        self.directions_ = _directions(sums)
        self.temperature_ = self.temperature or likeliest_temperature(
            _left_out_cosines(unit, sums, class_index), class_index
        )
        return self

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, (n, C), for samples `X` (n, K)."""
        return np.asarray(softmax(self._cosines(X) / self.temperature_, axis=1))

    def predict(self, X: Any) -> Any:
        """Return the class (n,) of samples `X` (n, K)."""
        best = self._cosines(X).argmax(axis=1)
        return self.classes_[best]

    def _cosines(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        return np.asarray(_directions(X) @ self.directions_.T)


class _Discriminants(ClassifierMixin, BaseEstimator):
    """Base of linear and quadratic discriminants, with `shrinkage` from 0 to 1 and log probabilities `_scores`."""

    shrinkage: float
    classes_: Any

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, (n, C), for samples `X` (n, K)."""
        return np.asarray(softmax(self._checked_scores(X), axis=1))

    def predict(self, X: Any) -> Any:
        """Return the class (n,) of samples `X` (n, K)."""
        best = self._checked_scores(X).argmax(axis=1)
        return self.classes_[best]

    def _begin(self, X: Any, y: Any) -> tuple[FloatArray, Any]:
        """Validate the samples and return them (n, K) with the class index of each."""
        X, y = validate_data(self, X, y, dtype=np.float64)
        check_classification_targets(y)
        if not 0 <= self.shrinkage <= 1:
            raise ValueError(f"The shrinkage must lie from 0 to 1, not {self.shrinkage!r}.")
        self.classes_, class_index = np.unique(y, return_inverse=True)
        return X, class_index

    def _checked_scores(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        return self._scores(validate_data(self, X, dtype=np.float64, reset=False))

    def _scores(self, X: FloatArray) -> FloatArray:
        """Return log probabilities (n, C) up to a common term."""
        raise NotImplementedError


class ShrinkageLDA(_Discriminants):
    """Linear discriminant analysis in closed form, with the pooled covariance S shrunk towards a round one.

    S becomes (1 - a) S + a tr(S) / K I, as in scikit-learn's `LinearDiscriminantAnalysis(solver="lsqr", shrinkage=a)`,
    which gives the same predictions. Ours does not pretend to transform, and permutation tests call `linear_rule`.

    Args:
        shrinkage: a, from 0 to 1.

    Attributes:
        classes_: (C,) the classes, sorted.
        coef_: (C, K) and
        intercept_: (C,), of the log probabilities up to a common term.
    """

    def __init__(self, shrinkage: float = LDA_SHRINKAGE) -> None:
        self.shrinkage = shrinkage

    def fit(self, X: Any, y: Any) -> ShrinkageLDA:
        """Fit to samples `X` (n, K) with classes `y` (n,).

        Raises:
            ValueError: arrays that do not belong together, values that are not finite, shrinkage outside 0 to 1.
        """
        X, class_index = self._begin(X, y)
        self.coef_, self.intercept_ = linear_rule(X, np.eye(len(self.classes_))[class_index], X.T @ X, self.shrinkage)
        return self

    def _scores(self, X: FloatArray) -> FloatArray:
        return np.asarray(X @ self.coef_.T + self.intercept_)


def linear_rule(X: FloatArray, member: FloatArray, gram: FloatArray, shrinkage: float) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (C, K) and intercepts (C,) of the linear discriminants.

    Args:
        X: (n, K) samples.
        member: (n, C) one where the sample is of the class, else zero; each class has a sample.
        gram: (K, K) X.T @ X, which stays when labels are shuffled.
        shrinkage: share of the round covariance.
    """
    counts = member.sum(axis=0)
    sums = member.T @ X
    means = sums / counts[:, None]
    pooled = (gram - sums.T @ means) / len(X)
    K = X.shape[1]
    shrunk = (1 - shrinkage) * pooled + shrinkage * np.trace(pooled) / K * np.eye(K)
    coef = np.asarray(np.linalg.lstsq(shrunk, means.T, rcond=None)[0], dtype=np.float64).T
    return coef, -0.5 * (coef * means).sum(axis=1) + np.log(counts / len(X))


class ShrinkageQDA(_Discriminants):
    """Quadratic discriminant analysis with each class's covariance shrunk towards the pooled one (Friedman, JASA 1989).

    It is (1 - a) S_class + a S, where S is the pooled covariance as `ShrinkageLDA` shrinks it, so that classes may have
    fewer samples than modes. scikit-learn's QDA does not accept those.

    Args:
        shrinkage: weight a of the pooled covariance, from 0 to 1.

    Attributes:
        classes_: (C,) the classes, sorted.
        means_: (C, K).
        whiten_: (C, K, K), samples of class c minus its mean times whiten_[c] have the covariance 1.
        offsets_: (C,) log prior minus half the log determinant.
    """

    def __init__(self, shrinkage: float = 0.5) -> None:
        self.shrinkage = shrinkage

    def fit(self, X: Any, y: Any) -> ShrinkageQDA:
        """Fit to samples `X` (n, K) with classes `y` (n,).

        Raises:
            ValueError: arrays that do not belong together, values that are not finite, shrinkage outside 0 to 1.
        """
        X, class_index = self._begin(X, y)
        K, counts = X.shape[1], np.bincount(class_index)
        self.means_ = np.stack([X[class_index == c].mean(axis=0) for c in range(len(counts))])
        deviation = X - self.means_[class_index]
        pooled = deviation.T @ deviation / len(X)
        pooled = (1 - LDA_SHRINKAGE) * pooled + LDA_SHRINKAGE * np.trace(pooled) / K * np.eye(K)
        whiten, offsets = np.zeros((len(counts), K, K)), np.zeros(len(counts))
        for c, count in enumerate(counts):
            class_deviation = deviation[class_index == c]
            values, vectors = np.linalg.eigh(
                (1 - self.shrinkage) * (class_deviation.T @ class_deviation / count) + self.shrinkage * pooled
            )
            # One sample a class has no spread of its own.
            values = np.maximum(values, max(1e-12 * float(values[-1]), 1e-12 * float(X.var(axis=0).mean()), 1e-100))
            whiten[c] = vectors / np.sqrt(values)
            offsets[c] = np.log(count / len(X)) - 0.5 * np.log(values).sum()
        self.whiten_, self.offsets_ = whiten, offsets
        return self

    def _scores(self, X: FloatArray) -> FloatArray:
        squared_distances = [
            (((X - mean) @ whiten) ** 2).sum(axis=1) for mean, whiten in zip(self.means_, self.whiten_, strict=True)
        ]
        return self.offsets_ - 0.5 * np.stack(squared_distances, axis=1)


class CalibratedSVC(ClassifierMixin, BaseEstimator):
    """A support vector machine with a Gaussian kernel whose probabilities come from its calibrated decision function.

    Probabilities are a softmax of the decision values over a temperature, at which the training samples are most likely
    under machines that were not trained on them (three stratified folds). `SVC(probability=True)` is deprecated in
    scikit-learn, and its probabilities may disagree with its predictions; these do not.

    Args:
        C: penalty of a sample on the wrong side.
        temperature: temperature of the softmax; None estimates it in `fit`, which trains three more machines.
        random_state: seed of the folds.

    Attributes:
        classes_: (C,) the classes, sorted.
        machine_: the fitted `SVC`.
        temperature_: the temperature in use; 1 if a class has one sample only.
    """

    def __init__(self, C: float = 3.0, temperature: float | None = None, random_state: int | None = None) -> None:
        self.C = C
        self.temperature = temperature
        self.random_state = random_state

    def fit(self, X: Any, y: Any) -> CalibratedSVC:
        """Fit to samples `X` (n, K) with classes `y` (n,).

        Raises:
            ValueError: arrays that do not belong together, values that are not finite, fewer than two classes.
        """
        X, y = validate_data(self, X, y, dtype=np.float64)
        check_classification_targets(y)
        self.classes_, class_index = np.unique(y, return_inverse=True)
        if self.temperature is not None and not self.temperature > 0:
            raise ValueError(f"The temperature must be above 0, not {self.temperature!r}.")
        if len(self.classes_) < 2:
            raise ValueError("A support vector machine needs at least two classes; the samples have one class.")
        self.machine_ = SVC(C=self.C).fit(X, class_index)
        folds = min(3, int(np.bincount(class_index).min()))
        self.temperature_ = self.temperature or 1.0
        if self.temperature is None and folds > 1:
            parts = StratifiedKFold(folds, shuffle=True, random_state=self.random_state)
            held_out_margins = cross_val_predict(SVC(C=self.C), X, class_index, cv=parts, method="decision_function")
            self.temperature_ = likeliest_temperature(_margins(held_out_margins), class_index)
        return self

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, (n, C), for samples `X` (n, K)."""
        return np.asarray(softmax(self._scores(X) / self.temperature_, axis=1))

    def predict(self, X: Any) -> Any:
        """Return the class (n,) of samples `X` (n, K)."""
        best = self._scores(X).argmax(axis=1)
        return self.classes_[best]

    def _scores(self, X: Any) -> FloatArray:
        check_is_fitted(self)
        return _margins(self.machine_.decision_function(validate_data(self, X, dtype=np.float64, reset=False)))


def _margins(decision: Any) -> FloatArray:
    """Return decision values (n, C), also for two classes, where scikit-learn returns one column."""
    values = np.asarray(decision, dtype=np.float64)
    return values if values.ndim == 2 else np.stack([-values, values], axis=1)


def _directions(X: FloatArray) -> FloatArray:
    # Scaled by the largest entry first, since squares of very small or large ones leave float64.
    largest = np.abs(X).max(axis=1, keepdims=True)
    scaled = np.divide(X, largest, out=np.zeros_like(X), where=largest > 0)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    return np.divide(scaled, length, out=np.zeros_like(X), where=length > 0)


def _left_out_cosines(unit: FloatArray, sums: FloatArray, class_index: Any) -> FloatArray:
    """Return leave-one-out cosines (n, C) of each sample with the mean directions of the classes."""
    cosines = unit @ _directions(sums).T
    rows = np.arange(len(unit))
    cosines[rows, class_index] = (_directions(sums[class_index] - unit) * unit).sum(axis=1)
    return cosines


def likeliest_temperature(
    scores: FloatArray, class_index: Any, *, doubt: float = 0.0, bounds: tuple[float, float] = (0.02, 10.0)
) -> float:
    """Return the temperature that maximises the likelihood of the true classes under a softmax of `scores` (n, C).

    Args:
        scores: scores of held-out samples, logits up to the temperature.
        class_index: (n,) index of each sample's class.
        doubt: share of each sample that counts equally for all classes.
        bounds: smallest and largest temperature; few samples alone would not bound it.
    """
    C = scores.shape[1]
    target = (1 - doubt) * np.eye(C)[class_index] + doubt / C

    def surprise(log_temperature: float) -> float:
        return -float((target * log_softmax(scores / np.exp(log_temperature), axis=1)).sum(axis=1).mean())

    minimum: Any = minimize_scalar(surprise, bounds=(math.log(bounds[0]), math.log(bounds[1])), method="bounded")
    return float(np.exp(minimum.x))


def _mean_direction(seed: int) -> Pipeline:
    # The origin is the neutral face, so scaling must not move it.
    return _pipeline(StandardScaler(with_mean=False), NearestMeanDirection())


def _knn(seed: int) -> Pipeline:
    # By brute force, since a search tree's saved state could not be checked when it is read.
    return _pipeline(StandardScaler(), KNeighborsClassifier(n_neighbors=5, weights="distance", algorithm="brute"))


def _lda(seed: int) -> Pipeline:
    return _pipeline(StandardScaler(), ShrinkageLDA())


def _qda(seed: int) -> Pipeline:
    return _pipeline(StandardScaler(), ShrinkageQDA())


def _logistic(seed: int) -> Pipeline:
    return _pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=2000))


def _svm(seed: int) -> Pipeline:
    return _pipeline(StandardScaler(), CalibratedSVC(random_state=seed))


def _pipeline(scale: Any, classify: Any) -> Pipeline:
    return Pipeline([("scale", scale), ("classify", classify)])


CLASSIFIERS: Mapping[str, Callable[[int], Pipeline]] = {
    "mean-direction": _mean_direction,
    "knn": _knn,
    "lda": _lda,
    "qda": _qda,
    "logistic": _logistic,
    "svm": _svm,
}
"""Classifiers by name: each is given a seed and makes a pipeline of the steps `scale` and `classify`."""

GRIDS: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "knn": {"classify__n_neighbors": (5, 15)},
    "lda": {"classify__shrinkage": (0.02, LDA_SHRINKAGE, 0.4)},
    "qda": {"classify__shrinkage": (0.5, 0.8)},
    "logistic": {"classify__C": (0.01, 0.1, 1.0)},
    # Nested cross-validation calibrates what it chose, so the machines need not.
    "svm": {"classify__C": (1.0, 10.0), "classify__temperature": (0.3,)},
}
"""Parameters that nested cross-validation tries, by classifier; one without a grid has nothing to choose."""
