"""Scores of predicted classes and their probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.special import softmax

from shapespace.cohort.proportions import widen_share
from shapespace.errors import InputError
from shapespace.recognise.classifiers import likeliest_temperature
from shapespace.recognise.learn import confusion_matrix, precision_recall_fscore_support
from shapespace.types import FloatArray

IndexArray: TypeAlias = npt.NDArray[np.integer[Any]]

_LEAST_PROBABILITY = 1e-6  # keeps the logarithm finite


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of predicted probabilities.

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
    """Precision, recall and F1 score of one class.

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


def macro_accuracy(labels: Sequence[str] | Any, predicted: Sequence[str] | Any, classes: Sequence[str]) -> float:
    """Return the mean over the classes of the share of their samples that were answered rightly.

    Classes without a sample do not count; any answer but the right class is wrong, also none and "unsure".
    """
    truth, answers = np.asarray(labels, dtype=str), np.asarray(predicted, dtype=str)
    class_masks = [truth == name for name in classes]
    # recall_score(average="macro") gives the same in 2 ms instead of 0.06, which is asked for by the thousand.
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
    """Return the bootstrap percentile interval of the macro accuracy, drawing whole people with replacement.

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
    truth, p = _with_probabilities(labels, probabilities, classes)
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

    The true class counts for 1 - 1 / (n + 2), as in Platt's calibration (1999): few samples that all are right do not
    show that the next is.

    Raises:
        InputError: arrays that do not belong together, or no row with probabilities.
    """
    truth, p = _with_probabilities(labels, probabilities, classes)
    logits = np.log(np.maximum(p, _LEAST_PROBABILITY))
    return likeliest_temperature(logits, truth, doubt=1 / (len(p) + 2), bounds=(0.1, 100.0))


def calibrated(probabilities: FloatArray, temperature: float) -> FloatArray:
    """Return probabilities (n, C) at another temperature; the likeliest class is unchanged."""
    logits = np.log(np.maximum(probabilities, _LEAST_PROBABILITY))
    return np.asarray(softmax(logits / temperature, axis=1), dtype=np.float64)


def _with_probabilities(labels: Sequence[str], probabilities: FloatArray, classes: Sequence[str]) -> tuple[Any, Any]:
    if probabilities.shape != (len(labels), len(classes)):
        raise InputError(
            f"{len(labels)} labels of {len(classes)} classes need probabilities of that shape, not "
            f"{probabilities.shape}."
        )
    column = {name: k for k, name in enumerate(classes)}
    unknown = sorted(set(labels) - set(column))
    if unknown:
        raise InputError(f"The label {unknown[0]!r} is none of the classes.")
    finite = np.isfinite(probabilities).all(axis=1)
    if not finite.any():
        raise InputError("There is no sample with probabilities, so they cannot be compared with the labels.")
    truth = np.asarray([column[name] for name in labels], dtype=np.int64)
    return truth[finite], probabilities[finite]
