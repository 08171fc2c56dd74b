"""Recognition of classes from fitted coefficients: training, prediction, evaluation."""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.recognise.classifier_file import SavedClassifier
    from shapespace.recognise.classifiers import CLASSIFIERS
    from shapespace.recognise.predict import ScanPrediction, ShapeSpace, train_classifier

__all__ = [
    "CLASSIFIERS",
    "SavedClassifier",
    "ScanPrediction",
    "ShapeSpace",
    "train_classifier",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "recognise.classifier_file": ("SavedClassifier",),
        "recognise.classifiers": ("CLASSIFIERS",),
        "recognise.predict": ("ScanPrediction", "ShapeSpace", "train_classifier"),
    },
)
