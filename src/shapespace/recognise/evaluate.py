"""Evaluation of classifiers in subjects who were not trained on.

`predictions` has folds by subject and the nested choice of settings, `classification_scores` the rates, `resampling`
the tests against shuffled labels and the learning curves. Maps of where classes differ are at the end of this module.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from shapespace.errors import InputError
from shapespace.recognise.classification_scores import (
    Calibration,
    ClassScores,
    IndexArray,
    calibrated,
    calibration,
    confusion,
    fit_temperature,
    macro_accuracy,
    per_class,
    subject_bootstrap,
)
from shapespace.recognise.predictions import (
    MODES,
    Choice,
    Fold,
    Predictions,
    cross_validated_probabilities,
    fixed_predictions,
    folds_of,
    nested_predictions,
    predict_probabilities,
    subject_folds,
)
from shapespace.recognise.resampling import (
    LearningCurve,
    PermutationTest,
    learning_curve,
    mode_importance,
    permutation_test,
)
from shapespace.types import FloatArray

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
    """Return each region's share of a decision map (V,): its mean there over the sum of the regions' means.

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
