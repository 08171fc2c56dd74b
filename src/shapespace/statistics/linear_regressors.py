"""Ridge and principal component regression as filters of one decomposition, chosen by nested folds of subjects.

Both are linear in the target: a training set is decomposed once, and that serves every penalty and every permutation of
the targets (Hastie, Tibshirani and Friedman, The Elements of Statistical Learning, 2009, section 3.4). Rows have
weights, 1 / the number of scans of their subject, so that each subject counts once in the means, the fit and the choice
of the penalty. Weighted least squares is least squares on rows times the square root of their weight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from shapespace.types import FloatArray

IndexArray = npt.NDArray[np.intp]
PENALTIES = tuple(10.0 ** (0.5 * k) for k in range(-10, 1))
"""Penalties of ridge regression on coefficients, as shares of the largest squared singular value."""
MODES = (1, 2, 3, 5, 8, 12, 20, 30, 50)
"""Numbers of leading principal components in a regression on whitened coefficients."""
_NOTHING = 1e-10  # share of the first singular value; below is rounding


@dataclass(frozen=True)
class Regularisation:
    """Regularisation of a regression on shapes.

    Args:
        space: `raw` for ridge regression on coefficients, `whitened` for least squares on the leading principal
            components, which then have equal weights.
        amount: penalty divided by the largest squared singular value, or the number of components.
    """

    space: str
    amount: float

    def factors(self, singular: FloatArray) -> FloatArray:
        """Return the factors (r,), 0 to 1, of directions with singular values (r,) (S42)."""
        if self.space == "raw":
            return singular**2 / (singular**2 + self.amount * singular[0] ** 2)
        return (np.arange(len(singular)) < self.amount).astype(np.float64)

    def words(self) -> str:
        """Return a description of the regularisation."""
        if self.space == "raw":
            return f"ridge regression on coefficients, penalty {self.amount:.2g} of the largest variance"
        return f"least squares on the first {self.amount:.0f} principal components"


CHOICES = tuple(Regularisation("raw", p) for p in PENALTIES) + tuple(Regularisation("whitened", m) for m in MODES)


@dataclass(frozen=True, eq=False)
class TrainingDecomposition:
    """The singular value decomposition of a weighted training set.

    Args:
        middle: (K,) weighted mean of the coefficients.
        left: (n, r) left singular vectors of the centred coefficients times the square root of `weight`.
        singular: (r,) singular values.
        right: (r, K) right singular vectors.
        weight: (n,) weights of the rows.
    """

    middle: FloatArray
    left: FloatArray
    singular: FloatArray
    right: FloatArray
    weight: FloatArray

    @staticmethod
    def of(X: FloatArray, weight: FloatArray) -> TrainingDecomposition:
        """Return the decomposition of coefficients (n, K) whose rows have weights (n,)."""
        middle = weighted_mean(X, weight)
        left, singular, right = np.linalg.svd(np.sqrt(weight)[:, None] * (X - middle), full_matrices=False)
        significant = singular > _NOTHING * max(float(singular[0]), 1e-300)
        return TrainingDecomposition(middle, left[:, significant], singular[significant], right[significant], weight)

    def predict(self, X: FloatArray, targets: FloatArray, choices: Sequence[Regularisation]) -> FloatArray:
        """Return the predictions (C, m, P) of each choice for coefficients (m, K), from targets (n, P) of the training
        set."""
        mean = weighted_mean(targets, self.weight)
        along = (X - self.middle) @ self.right.T / self.singular
        of_targets = self.left.T @ (np.sqrt(self.weight)[:, None] * (targets - mean))
        return np.stack([mean + (along * choice.factors(self.singular)) @ of_targets for choice in choices])  # S41

    def weights(self, target: FloatArray, choice: Regularisation) -> tuple[FloatArray, float]:
        """Return weights (K,) and intercept of a prediction from coefficients, for a target (n,)."""
        mean = float(weighted_mean(target, self.weight))
        of_target = self.left.T @ (np.sqrt(self.weight) * (target - mean))
        beta = (choice.factors(self.singular) / self.singular * of_target) @ self.right
        return beta, mean - float(self.middle @ beta)

    def effective(self, choice: Regularisation) -> float:
        """Return the effective degrees of freedom of a choice, without the mean."""
        return float(choice.factors(self.singular).sum())


def weighted_mean(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the mean over the rows of `values` (n, ...) with weights (n,)."""
    # Division of the sums keeps the rounding of the plain mean where all weights are 1.
    return (weight.reshape(-1, *(1,) * (values.ndim - 1)) * values).sum(axis=0) / weight.sum()


def folds_of(codes: IndexArray, count: int, rng: np.random.Generator) -> IndexArray:
    """Return the fold (N,) of each row, dealt out by subjects, so that no subject is in two folds.

    Args:
        codes: (N,) number of the subject of each row.
        count: number of folds.
        rng: only source of randomness.
    """
    subjects = np.unique(codes)
    dealt = np.empty(int(subjects.max()) + 1, dtype=np.intp)
    dealt[rng.permutation(subjects)] = np.arange(len(subjects)) % count
    return dealt[codes]


def errors_of(
    X: FloatArray, targets: FloatArray, weight: FloatArray, folds: IndexArray, choices: Sequence[Regularisation]
) -> FloatArray:
    """Return the weighted sum of squared errors (C, P) of each choice for targets (N, P), in folds (N,)."""
    total = np.zeros((len(choices), targets.shape[1]))
    for fold in np.unique(folds):
        test = folds == fold
        predicted = TrainingDecomposition.of(X[~test], weight[~test]).predict(X[test], targets[~test], choices)
        total += np.einsum("m,cmp->cp", weight[test], (predicted - targets[test]) ** 2)
    return total


@dataclass(frozen=True, eq=False)
class NestedPredictions:
    """Predictions of held-out rows by nested cross-validation.

    Args:
        predicted: (N, P) predictions of each column of targets.
        baseline: (N, P) weighted mean of the training set.
        chosen: (F, P) index of the choice in each outer fold.
    """

    predicted: FloatArray
    baseline: FloatArray
    chosen: IndexArray


def nested(
    X: FloatArray,
    targets: FloatArray,
    weight: FloatArray,
    outer: IndexArray,
    inner: Sequence[IndexArray],
    choices: Sequence[Regularisation] = CHOICES,
    on_fold: Callable[[int, int], None] | None = None,
) -> NestedPredictions:
    """Return predictions of all rows, whose training sets and choices do not use the subject of the row.

    Args:
        X: (N, K) coefficients.
        targets: (N, P) targets.
        weight: (N,) weights of rows in means, fits and errors.
        outer: (N,) fold of each row.
        inner: (n,) folds of the training rows, for each outer fold.
        choices: regularisations to choose from.
        on_fold: function called with (outer folds done, in all).
    """
    predicted, baseline = np.empty_like(targets), np.empty_like(targets)
    chosen: list[IndexArray] = []
    for fold, own in enumerate(inner):
        test = outer == fold
        train = ~test
        errors = errors_of(X[train], targets[train], weight[train], own, choices)
        best = errors.argmin(axis=0)
        estimates = TrainingDecomposition.of(X[train], weight[train]).predict(X[test], targets[train], choices)
        predicted[test] = np.take_along_axis(estimates, best[None, None, :], axis=0)[0]
        baseline[test] = weighted_mean(targets[train], weight[train])
        chosen.append(best)
        if on_fold is not None:
            on_fold(fold + 1, len(inner))
    return NestedPredictions(predicted, baseline, np.stack(chosen))
