"""Evaluation of classifiers in subjects who were not trained on.

`predictions` has folds by subject and the choice nested inside them, `scores` what answers are worth, `resampling`
tests against shuffled labels and curves, `decision` where on the face classes differ.
"""

from shapespace.recognise.classification_scores import (
    Calibration,
    ClassScores,
    calibrated,
    calibration,
    confusion,
    fit_temperature,
    macro_accuracy,
    per_class,
    subject_bootstrap,
)
from shapespace.recognise.decision import decision_map, region_shares
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
