"""Imports from scikit-learn and skops, with one error message if they are not installed."""

from __future__ import annotations

from typing import Any, cast

from shapespace.errors import ShapespaceError

try:
    import skops.io as skops_io
    from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import confusion_matrix as _confusion_matrix  # pyright: ignore[reportUnknownVariableType]
    from sklearn.metrics import precision_recall_fscore_support as _precision_recall_fscore_support  # pyright: ignore[reportUnknownVariableType]
    from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold
    from sklearn.model_selection import cross_val_predict as _cross_val_predict  # pyright: ignore[reportUnknownVariableType]
    from sklearn.neighbors import KNeighborsClassifier
    from sklearn.pipeline import Pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVC
    from sklearn.utils.multiclass import check_classification_targets as _check_classification_targets  # pyright: ignore[reportUnknownVariableType]
    from sklearn.utils.validation import check_is_fitted as _check_is_fitted  # pyright: ignore[reportUnknownVariableType]
    from sklearn.utils.validation import validate_data as _validate_data  # pyright: ignore[reportUnknownVariableType]
except ImportError as error:
    raise ShapespaceError(
        "Recognition needs the extra recognise (scikit-learn 1.8 and skops, or newer); install it with: "
        'pip install "shapespace[recognise]"'
    ) from error

# scikit-learn has no types of its own.
check_classification_targets = cast(Any, _check_classification_targets)
check_is_fitted = cast(Any, _check_is_fitted)
confusion_matrix = cast(Any, _confusion_matrix)
cross_val_predict = cast(Any, _cross_val_predict)
precision_recall_fscore_support = cast(Any, _precision_recall_fscore_support)
validate_data = cast(Any, _validate_data)

__all__ = [
    "SVC",
    "BaseEstimator",
    "ClassifierMixin",
    "KNeighborsClassifier",
    "LogisticRegression",
    "Pipeline",
    "StandardScaler",
    "StratifiedGroupKFold",
    "StratifiedKFold",
    "TransformerMixin",
    "check_classification_targets",
    "check_is_fitted",
    "confusion_matrix",
    "cross_val_predict",
    "precision_recall_fscore_support",
    "skops_io",
    "validate_data",
]
