"""Tests of groups of shapes: disparity, equality of means and covariances, equivalence, and discriminant analysis.

Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.schemas import TablePart
from shapespace.statistics.compare_formula import design_of
from shapespace.statistics.compare_shapes import complete_cohort
from shapespace.statistics.compare_strata import means_of, span
from shapespace.statistics.dispersion import unequal_variances
from shapespace.statistics.shape_tests.ordination import discriminant_components, principal_components
from shapespace.statistics.shape_tests.permutations import Groups, Orders, Residuals, orders, permuted
from shapespace.statistics.shape_tests.shape_test_result import (
    LEVEL,
    ShapeTestResult,
    Statistic,
    pair_statistics,
)
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import FloatArray

Priors: TypeAlias = Literal["proportional", "equal"]
_DRAWS = 2000  # bootstrap samples of a confidence interval; its limits then vary by a few percent of its width
_MOST_COMPONENTS = 10  # default limit for covariances; Mitteroecker and Bookstein (2009) take few components
_SHAPES_PER_COMPONENT = 3  # in the smallest group; eigenvalues of fewer are too variable
_CLEAR_MARGIN = 2.0  # times the distance by sampling alone; the level in simulations was lower below it
_ITERATIONS = 50  # of a spatial median; its error is then far below the standard error
_BISECTIONS = 55  # halvings of an interval until float64 numbers are equal
_TINY = 1e-7  # smallest score, in roots of the scatter; a smaller one changes no classification
_SMALLEST = 1e-300  # avoids divisions by zero


def compare_disparity(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    formula: str | None = None,
    partial: bool = False,
    residuals: Residuals = "scaled",
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Compare the disparity of groups of shapes, as `morphol.disparity` of geomorph.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, are the groups.
        formula: linear model about whose predictions disparity is measured (default: ~ 1, the mean of all shapes).
        partial: partial disparities (Foote 1993): sums of squares about the mean of all shapes, divided by the number
            of all shapes - 1, so that those of the groups add up to the total disparity.
        residuals: treatment of the residuals of a formula: `scaled` to the variance of errors, in permutations after
            the model is fitted again; or `raw`, as geomorph, which are smaller in small groups, so that equal groups
            differ.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations, and of the bootstrap samples of the intervals.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a group of one shape, a formula that cannot be read, or partial with a formula.

    Example:
        >>> result = ss.statistics.compare_disparity(cohort, group=["group"], permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    if partial and formula is not None:
        raise InputError("Partial disparities are about the mean of all shapes; remove --formula or --partial.")
    cohort, groups = groups_of(cohort, group, drop_missing, 2, "a variance", formula)
    n, design = len(cohort), design_of(formula, cohort.table) if formula else None
    q = span(np.column_stack([np.ones(n), design.matrix]) if design else np.ones((n, 1)))
    residual = cohort.coefficients - q @ (q.T @ cohort.coefficients)
    scaled = design is not None and residuals == "scaled"
    free = np.maximum(1 - (q**2).sum(axis=1), _TINY) if scaled else np.ones(n)
    squares = (residual**2).sum(axis=1) / free
    shares = groups.indicator / (np.full(len(groups.names), n - 1.0) if partial else groups.counts)
    refit = _make_refit(q, residual / np.sqrt(free)[:, None], shares / free[:, None])
    # Rows of residuals are permuted, so their squared norms are.
    variances = permuted(n, permutations, seed, refit if scaled else lambda rows: squares @ shares[rows], progress)
    variances[0] = squares @ shares  # M20
    name = "partial disparity" if partial else "Procrustes variance"
    limits = [
        Statistic(name=name, tested=label, value=float(value), low=float(low * value), high=float(high * value))
        for label, value, (low, high) in zip(groups.names, variances[0], _intervals(groups, squares, seed), strict=True)
    ]
    differences = np.abs([variances[:, a] - variances[:, b] for a, b in groups.pairs])
    rows = [(s.tested, int(count), s.value, s.low, s.high) for s, count in zip(limits, groups.counts, strict=True)]
    return ShapeTestResult(
        name="disparity", cohort=cohort, classes=group,
        statistics=[*_pairs("difference of disparity", groups, differences), *limits],
        settings={"group": list(group), "formula": formula, "partial": partial, "residuals": residuals,
                  "permutations": permutations, "seed": seed},
        tables=(TablePart.of("Disparity", ("group", "shapes", name, "lower 95 %", "upper 95 %"), rows),),
        reduced_model=tuple(term.label for term in design.terms) if design else (),
    )  # fmt: skip


def _make_refit(q: FloatArray, rows_of_errors: FloatArray, weights: FloatArray) -> Callable[[Orders], FloatArray]:
    """Return a function of orders (b, N) that permutes errors, fits the model again and sums the squared residuals.

    The sums have the degrees of freedom of the observed sums, so that variances of small groups vary as observed.

    Args:
        q: (N, m) orthonormal columns of the model.
        rows_of_errors: (N, K) residuals scaled to the variance of errors.
        weights: (N, G) weights of the squared residuals in the sum of each group.
    """
    columns = np.hstack([q, *(q * own[:, None] for own in weights.T)])
    inner, squares = np.einsum("ng,nm,nk->gmk", weights, q, q), (rows_of_errors**2).sum(axis=1)

    def sums(rows: Orders) -> FloatArray:
        products = columns[rows].transpose(0, 2, 1).reshape(-1, len(q)) @ rows_of_errors
        products = products.reshape(len(rows), 1 + weights.shape[1], q.shape[1], -1)
        fitted, weighted = products[:, :1], products[:, 1:]
        return squares @ weights[rows] + ((inner @ fitted - 2 * weighted) * fitted).sum(axis=(2, 3))

    return sums


def _intervals(groups: Groups, squares: FloatArray, seed: int) -> FloatArray:
    """Return factors (G, 2) from means of squared distances (N,) to the limits of their 95 % interval.

    The intervals are those of the bootstrap t of the logarithm of the mean, since variances are skewed.
    """
    drawn = groups.resamples(_DRAWS, seed)[:, None, :] * groups.indicator.T
    mean, second = (drawn @ squares**power / groups.counts for power in (1, 2))
    error = np.sqrt(np.maximum(second - mean**2, 0.0) / groups.counts) / np.maximum(mean, _SMALLEST)
    # Samples of a single shape have no standard error; a tenth of the observed one bounds their t.
    t = np.log(np.maximum(mean, _SMALLEST) / np.maximum(mean[0], _SMALLEST))
    t /= np.maximum(error, 0.1 * error[0] + _SMALLEST)
    return np.exp(-np.quantile(t, (1 - LEVEL / 2, LEVEL / 2), axis=0) * error[0]).T


def compare_means_and_covariances(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    components: int | None = None,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Test whether groups of shapes have equal means and equal covariance matrices.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, are the groups.
        components: number of principal components of the residuals in which covariance matrices are compared
            (default: a third of the smallest group, at most 10).
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a group of fewer than three shapes, or components with a singular covariance.

    Example:
        >>> result = ss.statistics.compare_means_and_covariances(cohort, group=["group"], components=2, permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    cohort, groups = groups_of(cohort, group, drop_missing, 3, "a covariance matrix")
    n, counts = len(cohort), groups.counts
    centred = cohort.coefficients - cohort.coefficients.mean(axis=0)
    # Residuals of spatial medians, since an outlier moves the mean and so all residuals of its group.
    residual, scale = np.empty_like(centred), np.empty((n, 1))
    for own in (groups.codes == k for k in range(len(counts))):
        residual[own] = centred[own] - _spatial_median(centred[own])
        scale[own] = max(float(np.median(np.linalg.norm(residual[own], axis=1))), _SMALLEST)
    scores = residual @ principal_components(residual)[1].T
    most = min(int(counts.min()) - 2, scores.shape[1])
    usual = min(max(int(counts.min()) // _SHAPES_PER_COMPONENT, 1), _MOST_COMPONENTS, most)
    used = usual if components is None else components
    if not 1 <= used <= most:
        raise InputError(
            f"Covariance matrices of {used} components are singular: the smallest group has {counts.min()} shapes, and "
            f"shapes vary in {scores.shape[1]} dimensions within groups; take 1 to {most} components."
        )
    # Proportional covariance matrices are exchangeable once the groups have the same scale.
    scores, scaled = scores[:, :used], residual / scale
    scaled = scaled @ principal_components(scaled)[1][:used].T

    def statistics(rows: Orders) -> FloatArray:
        means = groups.sums(centred, rows) / counts[:, None]
        own, relative = _covariances(groups, scores, rows), _covariances(groups, scaled, rows)
        columns = [(means**2).sum(axis=2) @ counts]
        for a, b in groups.pairs:
            logs, log_shape = _log_ratios(own[:, a], own[:, b]), _log_ratios(relative[:, a], relative[:, b])
            columns += [np.linalg.norm(means[:, a] - means[:, b], axis=1), np.linalg.norm(logs, axis=1),
                        np.sqrt(used) * log_shape.std(axis=1)]  # M22, M23  # fmt: skip
        return np.stack(columns, axis=1)

    values = permuted(n, permutations, seed, statistics, progress).T
    between, within, free = values[0], (centred**2).sum() - values[0], len(groups.names) - 1
    f = between / free / np.maximum(within / (n - free - 1), _SMALLEST)  # M21
    full, mean = groups.indicator / np.sqrt(counts), np.full((n, 1), 1 / np.sqrt(n))
    along = np.linalg.svd(full - mean @ (mean.T @ full), full_matrices=False)[0][:, :free]
    flips = unequal_variances(centred, full, mean, groups.codes, permutations, seed, " × ".join(group))
    weights = np.array([counts[a] * counts[b] / (counts[a] + counts[b]) for a, b in groups.pairs])
    return ShapeTestResult(
        name="equality", cohort=cohort, classes=group,
        statistics=[
            Statistic.of("F of means", f),
            Statistic.of("F of means, unequal covariances", flips.estimate(along).statistic()),
            *_pairs("Riemannian distance of covariance", groups, values[2::3], weights),
            # One component has no covariances but a scale.
            *(_pairs("Riemannian distance of relative covariance", groups, values[3::3], weights) if used > 1 else ()),
            *_pairs("Procrustes distance of means", groups, values[1::3]),
        ],
        settings={"group": list(group), "components": used, "permutations": permutations, "seed": seed},
        assumptions=(
            f"Covariance matrices are compared in the first {used} principal components of the residuals of the "
            "spatial medians of the groups, which are permuted among all groups; this assumes that they have the same "
            "distribution in all groups, for the relative covariance after division by the median length of the "
            "residuals of each group. F with unequal covariances is tested by sign flips of residuals.",
        ),
    )  # fmt: skip


def _covariances(groups: Groups, scores: FloatArray, rows: Orders) -> FloatArray:
    """Return the (b, G, q, q) covariance matrices of groups of permuted rows of scores (N, q)."""
    q, counts = scores.shape[1], groups.counts[:, None, None]
    products = (scores[:, :, None] * scores[:, None, :]).reshape(len(scores), -1)
    sums = groups.sums(np.hstack([scores, products]), rows)
    means, squares = sums[..., :q] / counts[..., 0], sums[..., q:].reshape(*sums.shape[:2], q, q)
    return (squares - counts * means[..., :, None] * means[..., None, :]) / (counts - 1)


def _spatial_median(values: FloatArray) -> FloatArray:
    """Return the point (K,) with the smallest sum of distances to values (n, K), by the algorithm of Weiszfeld."""
    median = values.mean(axis=0)
    for _ in range(_ITERATIONS):
        weights = 1 / np.maximum(np.linalg.norm(values - median, axis=1), _SMALLEST)
        median = weights @ values / weights.sum()
    return median


def _log_ratios(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the (b, q) logarithms of the relative eigenvalues of pairs of covariance matrices (b, q, q)."""
    lower = np.linalg.cholesky(first)
    half = np.linalg.solve(lower, second)
    return np.log(np.maximum(np.linalg.eigvalsh(np.linalg.solve(lower, half.transpose(0, 2, 1))), _SMALLEST))


def assess_equivalence(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    margin: float | None = None,
    margin_sd: float | None = None,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Test whether the mean shapes of pairs of groups are equivalent: their distance is below a margin.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, are the groups.
        margin: smallest Procrustes distance, in the unit of the data, of means that are not equivalent.
        margin_sd: margin in standard deviations within groups, the root of the pooled Procrustes variance.
        permutations: number of bootstrap samples, including the observed data.
        seed: seed of the bootstrap samples.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no margin or two, a margin that is not above 0, fewer than 20 bootstrap samples, no such column, or
            a group of fewer than three shapes.

    Example:
        >>> result = ss.statistics.assess_equivalence(cohort, group=["group"], margin_sd=2.0, permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    given = margin if margin_sd is None else margin_sd
    if (margin is None) == (margin_sd is None) or given is None or not 0 < given < np.inf:
        raise InputError("Equivalence needs one margin above 0: --margin, a distance, or --margin-sd.")
    if permutations * LEVEL < 1:
        raise InputError(f"A bound of 95 % needs 20 or more bootstrap samples, not {permutations}.")
    cohort, groups = groups_of(cohort, group, drop_missing, 3, "an equivalence test")
    distances = _mean_distances(cohort.coefficients, groups, groups.resamples(permutations, seed))
    step = StepCounter(len(distances), progress)
    tests, limits, rows, notes = list[Statistic](), list[Statistic](), list[tuple[Any, ...]](), list[str]()
    for distance, pair in zip(distances, groups.pair_names, strict=True):
        limit = given * (1.0 if margin_sd is None else distance.deviation)
        t, bound = distance.t(limit, relative=margin_sd is not None), distance.upper_bound()
        tests.append(Statistic.of("t of equivalence", t, pair, tail="lower", z="none"))
        name = "corrected Procrustes distance"
        limits.append(Statistic(name=name, tested=pair, value=distance.corrected, low=0.0, high=bound))
        equivalent = "yes" if (t <= t[0]).mean() <= LEVEL else "not shown"
        rows.append((pair, distance.length, distance.corrected, bound, limit, tests[-1].p, equivalent))
        if limit < _CLEAR_MARGIN * distance.noise:
            notes.append(
                f"{pair}: the margin {limit:.3g} is below {_CLEAR_MARGIN:g} times {distance.noise:.3g}, the distance "
                "by sampling alone; with so few shapes equivalence within it can hardly be shown."
            )
        step.add()
    columns = ("pair", "Procrustes distance", "corrected distance", "upper 95 % bound", "margin", "p", "equivalent")
    return ShapeTestResult(
        name="equivalence", cohort=replace(cohort, notes=(*cohort.notes, *notes)), classes=group,
        statistics=[*tests, *limits], tables=(TablePart.of("Equivalence", columns, rows),),
        settings={"group": list(group), "margin": margin, "margin_sd": margin_sd, "permutations": permutations,
                  "seed": seed},
        assumptions=(
            "Equivalence is tested against a distance of the means equal to the margin, in the direction of their "
            "observed difference; the intervals of corrected distances have an upper bound of 95 % confidence alone.",
        ),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _MeanDistance:
    """Distance of the means of two groups, with B bootstrap samples of its error.

    Args:
        length: Procrustes distance of the means.
        noise: root of the expected squared distance of the means of two samples of one population.
        deviation: standard deviation within groups.
        errors: (2, B) squared length of the error less its expectation, and its product with the difference.
        spread: (3, B) variance along the difference, product along difference and error, and along the error.
        ratio: (B,) variance within groups relative to the observed one.
    """

    length: float
    noise: float
    deviation: float
    errors: FloatArray
    spread: FloatArray
    ratio: FloatArray

    @property
    def corrected(self) -> float:
        """Distance without the bias by sampling; 0 if it is below this bias."""
        return float(np.sqrt(max(self.length**2 - self.noise**2, 0.0)))  # M24

    def t(self, limit: float, *, relative: bool = False) -> FloatArray:
        """Return the (B,) squared distances less that of a limit by their standard error, the observed value first.

        In the bootstrap samples the means differ by the limit, which is `relative` to the estimated variance or not. An
        observed distance below the distance by sampling alone is replaced by it, since no sample shows a smaller one.
        """
        # M25
        scale = limit / self.length
        squares = self.errors[0] + 2 * scale * self.errors[1] + (limit**2 * (1 - self.ratio) if relative else 0.0)
        variances = scale**2 * self.spread[0] + 2 * scale * self.spread[1] + self.spread[2]
        squares[0] = self.corrected**2 - limit**2
        variances[0] = self.spread[0, 0] * max(1.0, self.noise / self.length) ** 2
        return squares / np.sqrt(4 * np.maximum(variances, _SMALLEST))

    def upper_bound(self) -> float:
        """Return the smallest distance whose test of equivalence is significant at 5 %."""
        low, high = 0.0, 10 * (self.length + self.noise)
        for _ in range(_BISECTIONS):
            t = self.t(middle := (low + high) / 2)
            low, high = (low, middle) if (t <= t[0]).mean() <= LEVEL else (middle, high)
        return high


def _mean_distances(coefficients: FloatArray, groups: Groups, drawn: FloatArray) -> list[_MeanDistance]:
    """Return the distances of the means of each pair of groups; `drawn` is (B, N) of `Groups.resamples`."""
    means, residual, counts = means_of(coefficients, groups.codes), groups.residuals(coefficients), groups.counts
    shares = drawn[:, None, :] * (groups.indicator / counts).T
    off = (shares.reshape(-1, len(residual)) @ (residual @ residual.T)).reshape(shares.shape)
    variances = shares @ (residual**2).sum(axis=1) - (shares * off).sum(axis=2)
    distances: list[_MeanDistance] = []
    for pair in map(list, groups.pairs):
        size, own = counts[pair], variances[:, pair]
        error, share = (values[:, pair[0]] - values[:, pair[1]] for values in (off, shares))
        difference = means[pair[0]] - means[pair[1]]
        along, weights = residual @ difference, (groups.indicator[:, pair] / size**2).sum(axis=1)
        within = float(own[0] @ (size - 1) / (size.sum() - 2))
        distances.append(_MeanDistance(
            length=max(float(np.linalg.norm(difference)), _SMALLEST), noise=float(np.sqrt(own[0] @ (1 / size))),
            deviation=float(np.sqrt(within)), ratio=own @ size / (size.sum() - 2) / within,
            errors=np.stack([(error * share).sum(axis=1) - own @ (1 / (size - 1)), share @ along]),
            spread=np.stack([np.full(len(drawn), weights @ along**2), error @ (weights * along), error**2 @ weights]),
        ))  # fmt: skip
    return distances


def discriminate(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    components: int | None = None,
    priors: Priors = "proportional",
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Classify shapes by linear discriminants of the other shapes, and test the distances of the group means.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, are the groups.
        components: number of principal components, computed without the shape that is classified (default: all, or, if
            the covariance within groups is singular, those of 95 % of the variance, at most half of the shapes minus
            the groups).
        priors: prior probabilities of the groups: `proportional` to their sizes, or `equal`.
        permutations: number of permutations of the groups, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a group of fewer than three shapes, or a covariance within groups that is singular.

    Example:
        >>> result = ss.statistics.discriminate(cohort, group=["group"], components=2, permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    cohort, groups = groups_of(cohort, group, drop_missing, 3, "a leave-one-out classification")
    n, counts, g = len(cohort), groups.counts, len(groups.names)
    used = discriminant_components(cohort.coefficients, groups, components)
    centre, axes, variances = principal_components(cohort.coefficients)
    scores, squares = (cohort.coefficients - centre) @ axes.T, variances * (n - 1)
    if np.linalg.matrix_rank(groups.residuals(scores[:, :used])) < used:
        raise InputError(
            f"In some direction of {used} principal components the shapes of each group are equal, so the covariance "
            "within groups is singular; take fewer with --components."
        )
    rows = np.concatenate([order for _, order in orders(n, permutations, seed)])
    codes, labels = groups.codes[rows], groups.labels(rows)[:, 1:].reshape(-1, n)

    def sums(values: FloatArray) -> FloatArray:
        # Values have the mean 0, so the sum of the first group follows from those of the other groups.
        others = (labels @ values).reshape(len(rows), g - 1, -1)
        return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)

    means = sums(scores) / counts[:, None]
    products = _within_products(
        sums(scores[:, :used] / np.sqrt(squares[:used])) / counts[:, None], np.zeros(used), counts
    )
    diagonal = products.diagonal(axis1=1, axis2=2)
    lengths = [(n - g) * (diagonal[:, a] + diagonal[:, b] - 2 * products[:, a, b]) for a, b in groups.pairs]
    logs = np.log(counts / n if priors == "proportional" else np.full(g, 1 / g))
    correct, support, posterior = np.zeros(permutations), np.zeros(permutations), np.empty((n, g))
    step = StepCounter(n, progress)
    for k in range(n):
        whitened = _whiten_without(scores, squares, used, k)
        shape, whitened[k] = whitened[k].copy(), 0.0
        sizes = counts - (codes[:, k, None] == np.arange(g))
        products = _within_products(sums(whitened) / sizes[..., None], shape, sizes)
        # M27
        score = logs + (n - 1 - g) * (products[..., g] - products.diagonal(axis1=1, axis2=2) / 2)
        correct += score.argmax(axis=1) == codes[:, k]
        shares = np.exp(score - score.max(axis=1, keepdims=True))
        shares /= shares.sum(axis=1, keepdims=True)
        support += shares[range(permutations), codes[:, k]]
        posterior[k] = shares[0]
        step.add()
    # Counts have many ties, which would make their test conservative.
    untied = Statistic.of("correct classification", correct + support / (n + 1), z="none")
    predicted: list[int] = posterior.argmax(axis=1).tolist()
    table = groups.indicator.T @ np.eye(g)[predicted]
    classified = [
        (name, *map(int, row), float(row[k] / row.sum()))
        for k, (name, row) in enumerate(zip(groups.names, table, strict=True))
    ]
    shapes = [
        (name, groups.names[int(code)], groups.names[best], *map(float, own))
        for name, code, best, own in zip(cohort.names, groups.codes, predicted, posterior, strict=True)
    ]
    distances = [np.linalg.norm(means[:, a] - means[:, b], axis=1) for a, b in groups.pairs]
    return ShapeTestResult(
        name="discriminant", cohort=cohort, classes=group,
        statistics=[
            replace(Statistic.of("correct classification", correct / n, z="standard"), p=untied.p),
            *_pairs("Mahalanobis distance of means", groups, np.sqrt(np.maximum(lengths, 0.0))),
            *_pairs("Procrustes distance of means", groups, np.array(distances)),
        ],
        settings={"group": list(group), "components": used, "priors": priors, "permutations": permutations,
                  "seed": seed},
        tables=(TablePart.of("Classification", ("group", *(f"as {name}" for name in groups.names), "correct"),
                             classified, percent=("correct",),
                             note=f"Leave-one-out; by chance {np.exp(logs) @ counts / n:.1%} are correct."),
                TablePart.of("Posterior probabilities", ("shape", "group", "predicted", *groups.names), shapes)),
        assumptions=(
            f"Linear discriminants of {used} principal components, which do not depend on the groups; each shape is "
            "classified by components and discriminants of the others. They assume equal covariances of the groups. In "
            "the test, equal numbers of correct classifications are ordered by the mean probability of the own group.",
        ),
    )  # fmt: skip


def _within_products(means: FloatArray, shape: FloatArray, counts: Orders) -> FloatArray:
    """Return the inner products (b, G, G + 1) of the group means with each other, and last with a shape.

    The metric is the inverse of the scatter within groups.

    Args:
        means: (b, G, q) means of the groups, in coordinates with a mean of 0 and the identity as total scatter.
        shape: (q,) shape in these coordinates.
        counts: (b, G) or (G,) number of shapes of each group.
    """
    # The scatter within is the identity less that of the means, so that systems of G equations are solved (M26).
    products = np.concatenate([means @ means.transpose(0, 2, 1), (means @ shape)[..., None]], axis=2)
    size = means.shape[1]
    solved = np.linalg.solve(np.eye(size) - products[..., :size] * counts[..., None, :], products)
    return np.asarray(solved, dtype=np.float64)


def _whiten_without(scores: FloatArray, squares: FloatArray, components: int, row: int) -> FloatArray:
    """Return coordinates (N, q), of scatter 1, on the first q principal components of all shapes except one.

    Without a shape, the scatter changes by a matrix of rank one, so that its eigenvalues solve the secular equation.

    Args:
        scores: (N, r) scores on all principal components of all shapes.
        squares: (r,) scatter of the scores, descending.
        components: number q of principal components.
        row: row of the shape that is omitted.
    """
    # M28
    n, tiny = len(scores), _TINY * np.sqrt(squares)
    # Scores of 0 would leave eigenvectors undefined.
    shape = np.where(np.abs(scores[row]) < tiny, tiny, scores[row])
    low, high = np.append(squares[1:], 0.0)[:components], squares[:components]
    middle = (low + high) / 2
    for _ in range(_BISECTIONS):
        above = n / (n - 1) * (1 / (squares - middle[:, None])) @ shape**2 > 1
        low, high = np.where(above, low, middle), np.where(above, middle, high)
        middle = (low + high) / 2
    vectors = shape[:, None] / (squares[:, None] - middle)
    return (scores + scores[row] / (n - 1)) @ (vectors / np.linalg.norm(vectors, axis=0) / np.sqrt(middle))


def groups_of(
    cohort: Cohort, group: tuple[str, ...], drop_missing: bool, least: int, why: str, formula: str | None = None
) -> tuple[Cohort, Groups]:
    """Return the shapes without missing values in some columns and a formula, and their groups, as `Groups.of`."""
    cohort = complete_cohort(cohort, [formula] if formula else [], group, drop_missing=drop_missing)
    return cohort, Groups.of(cohort, group, least=least, why=why)


def _pairs(name: str, groups: Groups, values: FloatArray, weights: FloatArray | None = None) -> list[Statistic]:
    """Return the statistics of pairs of groups (pairs, P), with weights after their weighted root mean square."""
    pairs = pair_statistics(name, values, groups.pair_names)
    if weights is None or len(pairs) < 2:
        return pairs
    return [Statistic.of(name, np.sqrt(weights @ values**2 / weights.sum()), "all groups"), *pairs]
