"""How an expression shows in coefficients: the lines of figures 9 and 10, and how far apart they lie.

With v_i = (b_i - b_neutral) / stddev, samples of one expression at rising
intensity are expected on a line through neutral, and different expressions on different lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from shapespace.errors import InputError
from shapespace.types import FloatArray


@dataclass(frozen=True)
class LineScores:
    """One expression's line.

    Args:
        r2_through_neutral: share of the summed squares that the best line through neutral explains.
        r2_free: share of the scatter about the samples' mean that the best line anywhere explains. Its whole is smaller
            than that of `r2_through_neutral`, so it may be the lower of the two.
        sign_consistency: share of samples on the positive side of neutral.
        spearman: rank correlation of position along the line with intensity.
        permutation_p: how often shuffled intensities correlate at least as well.
    """

    r2_through_neutral: float
    r2_free: float
    sign_consistency: float
    spearman: float
    permutation_p: float


@dataclass(frozen=True)
class DisjointnessScores:
    """How far apart the expressions lie.

    Args:
        leave_one_out_accuracy: of the nearest mean direction by cosine.
        chance: accuracy of guessing the commonest expression.
        cosine_silhouette: mean silhouette by cosine distance, -1 to 1.
        separability: trace of the pooled within-class scatter's pseudo-inverse times the between-class scatter.
        accuracy_p: permutation p of the accuracy,
        silhouette_p: and of the silhouette, over shuffled labels.
    """

    leave_one_out_accuracy: float
    chance: float
    cosine_silhouette: float
    separability: float
    accuracy_p: float
    silhouette_p: float


def line_scores(v: FloatArray, intensity: FloatArray, *, permutations: int = 999, seed: int = 0) -> LineScores:
    """Score the line of one expression.

    Args:
        v: (n, K) coefficients relative to neutral in standard deviations.
        intensity: (n,).
        permutations: of the intensities.
        seed: of the permutations.

    Raises:
        InputError: fewer than three samples, or all of them neutral.
    """
    _check(v, intensity)
    energy = float((v**2).sum())
    if energy == 0:
        raise InputError("All samples of this expression are neutral, so they have no line.")
    along = _position(v)
    centred = v - v.mean(axis=0)
    singular = np.linalg.svd(centred, compute_uv=False)
    spread = float((singular**2).sum())
    rho = _spearman(along, intensity)
    rng = np.random.default_rng(seed)
    shuffled = [_spearman(along, rng.permutation(intensity)) for _ in range(permutations)]
    return LineScores(
        r2_through_neutral=float((along**2).sum()) / energy,
        r2_free=float(singular[0] ** 2) / spread if spread > 0 else 1.0,
        sign_consistency=float((along > 0).mean()),
        spearman=rho,
        permutation_p=_permutation_p(rho, shuffled),
    )


def disjointness(v: FloatArray, labels: Sequence[str], *, permutations: int = 999, seed: int = 0) -> DisjointnessScores:
    """Score how disjoint the expressions are.

    Args:
        v: (n, K) coefficients relative to neutral in standard deviations.
        labels: n expression names, at least two of each.
        permutations: of the labels.
        seed: of the permutations.

    Raises:
        InputError: one expression only, or one with a single sample.
    """
    names, classes = np.unique(np.asarray(labels), return_inverse=True)
    _check(v, classes.astype(np.float64))
    counts = np.bincount(classes)
    if len(names) < 2 or counts.min() < 2:
        raise InputError("Disjointness needs at least two expressions with at least two samples each.")
    length = np.linalg.norm(v, axis=1, keepdims=True)
    unit = np.divide(v, length, out=np.zeros_like(v), where=length > 0)
    accuracy, silhouette = _accuracy(unit, classes), _silhouette(unit, classes)
    rng = np.random.default_rng(seed)
    shuffles = [rng.permutation(classes) for _ in range(permutations)]
    return DisjointnessScores(
        leave_one_out_accuracy=accuracy,
        chance=float(counts.max() / counts.sum()),
        cosine_silhouette=silhouette,
        separability=_separability(v, classes),
        accuracy_p=_permutation_p(accuracy, _each(_accuracy, unit, shuffles)),
        silhouette_p=_permutation_p(silhouette, _each(_silhouette, unit, shuffles)),
    )


def _position(v: FloatArray) -> FloatArray:
    """Return (n,) positions along the best line through neutral; its sense is that of the mean sample."""
    u = np.linalg.svd(v, full_matrices=False)[2][0]
    along = v @ u
    return -along if along.sum() < 0 else along


def _spearman(a: FloatArray, b: FloatArray) -> float:
    ranks_a, ranks_b = rankdata(a), rankdata(b)
    ranks_a, ranks_b = ranks_a - ranks_a.mean(), ranks_b - ranks_b.mean()
    scale = float(np.sqrt((ranks_a**2).sum() * (ranks_b**2).sum()))
    return float((ranks_a * ranks_b).sum()) / scale if scale > 0 else 0.0


def _accuracy(unit: FloatArray, classes: np.ndarray) -> float:
    n_classes = int(classes.max()) + 1
    sums = np.stack([unit[classes == c].sum(axis=0) for c in range(n_classes)])
    hits = 0
    for i, own in enumerate(classes):
        without = sums.copy()
        without[own] -= unit[i]
        norms = np.linalg.norm(without, axis=1)
        cosine = (without @ unit[i]) / np.where(norms > 0, norms, np.inf)
        hits += int(cosine.argmax() == own)
    return hits / len(unit)


def _silhouette(unit: FloatArray, classes: np.ndarray) -> float:
    distance = 1.0 - unit @ unit.T
    np.fill_diagonal(distance, 0.0)
    member = np.eye(int(classes.max()) + 1)[classes]
    counts = member.sum(axis=0)
    sums = distance @ member
    index = np.arange(len(unit))
    within = sums[index, classes] / (counts[classes] - 1)
    others = sums / counts
    others[index, classes] = np.inf
    between = others.min(axis=1)
    return float(((between - within) / np.maximum(np.maximum(between, within), 1e-12)).mean())


def _separability(v: FloatArray, classes: np.ndarray) -> float:
    mean = v.mean(axis=0)
    within, between = np.zeros((v.shape[1],) * 2), np.zeros((v.shape[1],) * 2)
    for c in range(int(classes.max()) + 1):
        group = v[classes == c]
        deviation = group - group.mean(axis=0)
        within += deviation.T @ deviation
        offset = group.mean(axis=0) - mean
        between += len(group) * np.outer(offset, offset)
    return float(np.trace(np.linalg.pinv(within / len(v), hermitian=True) @ (between / len(v))))


def _each(
    score: Callable[[FloatArray, np.ndarray], float], unit: FloatArray, shuffles: Sequence[np.ndarray]
) -> list[float]:
    return [score(unit, shuffled) for shuffled in shuffles]


def _permutation_p(observed: float, shuffled: Sequence[float]) -> float:
    return (1 + sum(value >= observed - 1e-12 for value in shuffled)) / (1 + len(shuffled))


def _check(v: FloatArray, other: FloatArray) -> None:
    if v.ndim != 2 or len(v) != len(other) or len(v) < 3:
        raise InputError(f"Scores need (n, K) coefficients and n values with n at least 3, not {v.shape}.")
    if not (np.isfinite(v).all() and np.isfinite(other).all()):
        raise InputError("Coefficients and intensities must be finite; leave failed fits out and say so.")
