"""Expressions as lines in coefficient space (figures 9 and 10), and scores of their separation.

With v_i = (b_i - b_neutral) / stddev, samples of one expression at rising
intensity are expected on a line through neutral, and different expressions on different lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray

_SHRINKAGE = 0.1  # towards a multiple of the identity, so that the covariance of few scans is invertible


@dataclass(frozen=True)
class LineScores:
    """Scores of the line of one expression.

    Args:
        r2_through_neutral: share of the summed squares that the best line through neutral explains.
        r2_free: share of the scatter about the samples' mean that the best line anywhere explains. This scatter is
            smaller than the sum of squares of `r2_through_neutral`, so the share may be the lower one.
        sign_consistency: share of samples on the positive side of neutral.
        spearman: rank correlation of position along the line with intensity.
        permutation_p: share of shuffled intensities that correlate at least as well.
    """

    r2_through_neutral: float
    r2_free: float
    sign_consistency: float
    spearman: float
    permutation_p: float


@dataclass(frozen=True)
class PooledLineScores:
    """Scores of the lines of all expressions together.

    Args:
        r2_through_neutral: expression -> share of the squares on its line, as in `LineScores`.
        r2_p: expression -> share of shuffles of the labels in which as many samples lie on a line at least as well.
        mean_r2_p: the same share for the mean over the expressions.
        spearman: mean over the expressions of the rank correlation with intensity; None without intensities.
        monotonicity_p: share of shuffles of the intensities within each expression that correlate at least as well on
            average. Four levels of a single expression cannot have less than 1/24; those of several expressions can.
            None without intensities.
    """

    r2_through_neutral: Mapping[str, float]
    r2_p: Mapping[str, float]
    mean_r2_p: float
    spearman: float | None
    monotonicity_p: float | None


@dataclass(frozen=True)
class DisjointnessScores:
    """Scores of the separation of the expressions.

    Args:
        leave_one_out_accuracy: accuracy of the nearest mean direction by cosine.
        chance: accuracy of guessing the commonest expression.
        cosine_silhouette: mean silhouette by cosine distance, -1 to 1.
        separability: trace of the pooled within-class scatter's pseudo-inverse times the between-class scatter.
        accuracy_p: p of the accuracy over shuffled labels.
        silhouette_p: p of the silhouette over shuffled labels.
        separability_p: p of the separability over shuffled labels.
        margin_p: p of the smallest margin over shuffled labels.
        smallest_margin: smallest gap, over all pairs of expressions, between their nearest samples along the pair's
            linear discriminant, in pooled within-class standard deviations; negative if the samples overlap.
        smallest_margin_pair: the two expressions with that margin.
    """

    leave_one_out_accuracy: float
    chance: float
    cosine_silhouette: float
    separability: float
    accuracy_p: float
    silhouette_p: float
    separability_p: float
    margin_p: float
    smallest_margin: float
    smallest_margin_pair: tuple[str, str]


def line_scores(v: FloatArray, intensity: FloatArray, *, permutations: int = 999, seed: int = 0) -> LineScores:
    """Score the line of one expression.

    Args:
        v: (n, K) coefficients relative to neutral in standard deviations.
        intensity: (n,) intensity of each sample.
        permutations: number of permutations of the intensities.
        seed: seed of the permutations.

    Raises:
        InputError: fewer than three samples, or all of them neutral.
    """
    _check(v, intensity)
    energy = float((v**2).sum())
    if energy == 0:
        raise InputError("All samples of this expression are neutral, so they have no line.")
    along = _position(v)
    singular = np.linalg.svd(v - v.mean(axis=0), compute_uv=False)
    spread = float((singular**2).sum())
    ranks, wanted = _ranks(along), _ranks(intensity)
    rho = _correlation(ranks, wanted)
    rng = np.random.default_rng(seed)
    shuffled = [_correlation(ranks, rng.permutation(wanted)) for _ in range(permutations)]
    return LineScores(
        r2_through_neutral=float((along**2).sum()) / energy,
        r2_free=float(singular[0] ** 2) / spread if spread > 0 else 1.0,
        sign_consistency=float((along > 0).mean()),
        spearman=rho,
        permutation_p=_permutation_p(rho, shuffled),
    )


def pooled_line_scores(
    v: FloatArray,
    labels: Sequence[str],
    intensity: FloatArray | None = None,
    *,
    permutations: int = 999,
    seed: int = 0,
) -> PooledLineScores:
    """Test the lines of all expressions against shuffled labels, and their order against shuffled intensities.

    Args:
        v: (n, K) coefficients relative to neutral in standard deviations.
        labels: n expression names, at least two names with at least two samples each.
        intensity: (n,) intensity of each sample; None if not known.
        permutations: number of permutations of the labels, and of the intensities.
        seed: seed of the permutations.

    Raises:
        InputError: one expression only, one with a single sample, or an expression of neutral samples alone.
    """
    names, classes = np.unique(np.asarray(labels), return_inverse=True)
    _check(v, classes.astype(np.float64) if intensity is None else intensity)
    if len(names) < 2 or len(classes) != len(v) or np.bincount(classes).min() < 2:
        raise InputError("The lines of expressions need at least two expressions with at least two samples each.")
    if not all((v[classes == c] ** 2).sum() > 0 for c in range(len(names))):
        raise InputError("All samples of one expression are neutral, so they have no line.")
    gram = v @ v.T
    observed = _line_r2(gram, classes)
    rng = np.random.default_rng(seed)
    shuffled = np.stack([_line_r2(gram, rng.permutation(classes)) for _ in range(permutations)])
    rho = monotonicity_p = None
    if intensity is not None:
        groups = [classes == c for c in range(len(names))]
        pairs = [(_ranks(_position(v[rows])), _ranks(intensity[rows])) for rows in groups]
        rho = float(np.mean([_correlation(a, b) for a, b in pairs]))
        drawn = [float(np.mean([_correlation(a, rng.permutation(b)) for a, b in pairs])) for _ in range(permutations)]
        monotonicity_p = _permutation_p(rho, drawn)
    class_names = [str(name) for name in names]
    return PooledLineScores(
        r2_through_neutral=dict(zip(class_names, observed.tolist(), strict=True)),
        r2_p={name: _permutation_p(float(observed[c]), shuffled[:, c].tolist()) for c, name in enumerate(class_names)},
        mean_r2_p=_permutation_p(float(observed.mean()), shuffled.mean(axis=1).tolist()),
        spearman=rho,
        monotonicity_p=monotonicity_p,
    )


def _line_r2(gram: FloatArray, classes: np.ndarray) -> FloatArray:
    """Return R2 of the line through neutral of each class, from the inner products (n, n) of the samples."""
    scores: list[float] = []
    for c in range(int(classes.max()) + 1):
        rows = np.flatnonzero(classes == c)
        part = gram[np.ix_(rows, rows)]
        energy = float(np.trace(part))
        # The squared singular values of the samples are the eigenvalues of their products.
        scores.append(float(np.linalg.eigvalsh(part)[-1]) / energy if energy > 0 else 0.0)
    return np.asarray(scores)


def disjointness(v: FloatArray, labels: Sequence[str], *, permutations: int = 999, seed: int = 0) -> DisjointnessScores:
    """Score how disjoint the expressions are.

    Args:
        v: (n, K) coefficients relative to neutral in standard deviations.
        labels: n expression names, at least two samples of each.
        permutations: number of permutations of the labels.
        seed: seed of the permutations.

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
    # All samples lie in the span of their n rows, in which these two scores are the same and cheaper.
    inside = v @ np.linalg.svd(v, full_matrices=False)[2].T
    accuracy, silhouette = _accuracy(unit, classes), _silhouette(unit, classes)
    separability, (margin, pair) = _separability(inside, classes), _smallest_margin(inside, classes)
    rng = np.random.default_rng(seed)
    shuffles = [rng.permutation(classes) for _ in range(permutations)]
    return DisjointnessScores(
        leave_one_out_accuracy=accuracy,
        chance=float(counts.max() / counts.sum()),
        cosine_silhouette=silhouette,
        separability=separability,
        accuracy_p=_permutation_p(accuracy, _permuted_scores(_accuracy, unit, shuffles)),
        silhouette_p=_permutation_p(silhouette, _permuted_scores(_silhouette, unit, shuffles)),
        separability_p=_permutation_p(separability, _permuted_scores(_separability, inside, shuffles)),
        margin_p=_permutation_p(margin, _permuted_scores(lambda x, c: _smallest_margin(x, c)[0], inside, shuffles)),
        smallest_margin=margin,
        smallest_margin_pair=(str(names[pair[0]]), str(names[pair[1]])),
    )


def _position(v: FloatArray) -> FloatArray:
    """Return (n,) positions along the best line through neutral; the mean sample is on its positive side."""
    u = np.linalg.svd(v, full_matrices=False)[2][0]
    along = v @ u
    return -along if along.sum() < 0 else along


def _ranks(values: FloatArray) -> FloatArray:
    """Return the ranks (n,) less their mean; equal values share the mean of theirs."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place] - (len(values) + 1) / 2


def _correlation(a: FloatArray, b: FloatArray) -> float:
    """Return the correlation of centred values (n,), 0 if all of `a` or `b` are equal."""
    scale = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / scale if scale > 0 else 0.0


def _accuracy(unit: FloatArray, classes: np.ndarray) -> float:
    n_classes = int(classes.max()) + 1
    sums = np.stack([unit[classes == c].sum(axis=0) for c in range(n_classes)])
    hits = 0
    for i, class_index in enumerate(classes):
        without = sums.copy()
        without[class_index] -= unit[i]
        norms = np.linalg.norm(without, axis=1)
        cosine = (without @ unit[i]) / np.where(norms > 0, norms, np.inf)
        hits += int(cosine.argmax() == class_index)
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


def _smallest_margin(v: FloatArray, classes: np.ndarray) -> tuple[float, tuple[int, int]]:
    """Return the smallest gap over all pairs of classes, in pooled standard deviations, and the pair."""
    n_classes = int(classes.max()) + 1
    means = np.stack([v[classes == c].mean(axis=0) for c in range(n_classes)])
    deviation = v - means[classes]
    within = deviation.T @ deviation / max(len(v) - n_classes, 1)
    # A floor for samples without scatter, and some isotropic variance, since there may be fewer samples than modes.
    within += (1e-12 * float((v**2).mean()) + 1e-300) * np.eye(len(within))
    shrunk = (1 - _SHRINKAGE) * within + _SHRINKAGE * np.trace(within) / len(within) * np.eye(len(within))
    best = (np.inf, (0, 1))
    for a, b in itertools.combinations(range(n_classes), 2):
        w = np.asarray(np.linalg.solve(shrunk, means[b] - means[a]), dtype=np.float64)
        along = v @ w
        separation = float(along[classes == b].min() - along[classes == a].max())
        spread = float(np.sqrt(w @ within @ w))
        scaled = separation / spread if spread > 0 else 0.0
        if scaled < best[0]:
            best = (scaled, (a, b))
    return best


def _permuted_scores(
    score: Callable[[FloatArray, np.ndarray], float], unit: FloatArray, shuffles: Sequence[np.ndarray]
) -> list[float]:
    return [score(unit, shuffled) for shuffled in shuffles]


def _permutation_p(observed: float, shuffled: Sequence[float]) -> float:
    return (1 + sum(value >= observed - 1e-12 for value in shuffled)) / (1 + len(shuffled))


def _check(v: FloatArray, other: FloatArray) -> None:
    if v.ndim != 2 or len(v) != len(other) or len(v) < 3:
        raise InputError(f"Scores need (n, K) coefficients and n values with n at least 3, not {v.shape}.")
    if not (np.isfinite(v).all() and np.isfinite(other).all()):
        raise InputError("Coefficients and intensities must be finite; exclude failed fits and report them.")
