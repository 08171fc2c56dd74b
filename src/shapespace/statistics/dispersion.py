"""Unequal group dispersion: a test for it, and statistics and null distributions that allow it.

A permutation test of means assumes that residuals are exchangeable between groups. If the smaller group is more
variable, the test finds differences that do not exist; if the larger group is, it misses differences. Here

- dispersions are compared by the distances of residuals to their group mean (Anderson, Biometrics 62, 2006), each
  divided by sqrt(1 - leverage) against the bias of small groups (Stier et al., Ecology 94, 2013);
- a squared mean difference is divided by its variance, with one variance for each row (the ANOVA-type statistic of
Brunner,
  Dette and Munk, JASA 92, 1997, with the leverage correction HC2 of MacKinnon and White, J. Econometrics 29, 1985; of
  two groups the squared Welch t), and compared with sign flips of the residuals of the reduced model (the restricted
  wild bootstrap of Davidson and Flachaire, J. Econometrics 146, 2008), which is fitted with a weight for each group.

Sign flips keep the variance of each row, so covariances may differ between groups in size and in form. Residuals of
classes with few different sign flips are rotated instead (Langsrud, Stat. Comput. 15, 2005), which assumes that they
are normal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.statistics.effect_size import permutation_p
from shapespace.statistics.shape_tests.permutations import orders
from shapespace.types import FloatArray

Codes: TypeAlias = npt.NDArray[np.intp]

Variances: TypeAlias = Literal["auto", "equal", "unequal"]
VARIANCES: tuple[Variances, ...] = ("auto", "equal", "unequal")
"""Assumptions on the variances of the classes, in tests of means."""

FEWEST_OF_GROUP = 3
"""Smallest class for which the level of tests with unequal variances was measured (docs/compare.md)."""
FEWEST_PATTERNS = 10
"""Different sign flips of a class below which its residuals are rotated, as no p below 10 % can come from them alone:
with 16 (five subjects) flips keep the level of 5 %, with 8 not (docs/compare.md; normal and t4 residuals)."""
FULL_LEVERAGE = 1e-8
"""Rows with 1 - leverage below this limit are fitted exactly, so their residual is zero."""
_BATCH = 50
"""Number of sign flips drawn from one seed, and of vertices tested together."""
_STREAM = 3  # separates these permutations from those of other tests with the same seed
_FLOOR = 1e-12  # share of the total; a variance below is rounding
_LEAST = 1e-6  # degrees of freedom; weights of classes that have no more than one stay above 0
_FORM_STREAM = 5  # separates the permutations of the test of form from those of dispersion
_DOUBTFUL = (0.3, 0.1)
"""p of dispersion and of form below which classes of different size are not assumed to be alike (docs/compare.md)."""
_UNEQUAL = (0.05, 0.05)
"""The same limits for classes of one size, for which permutation is nearly correct."""


@dataclass(frozen=True, kw_only=True)
class DispersionTest:
    """A test of equal dispersion of the classes of a variable.

    Args:
        variable: name of the variable.
        stratum: name of the stratum; empty if there is only one.
        groups: classes with two or more members.
        counts: number of members of each class.
        stddev_mm: standard deviation of the shapes of each class about their mean, RMS over the vertices.
        f: F of the distances to the group mean.
        p: share of permutations of the distances with an F at least as large.
        p_form: p of a test whether covariances are proportional; 1 if a class has fewer than two contrasts.
        permutations: number of permutations, the observed one among them.
    """

    variable: str
    stratum: str
    groups: tuple[str, ...]
    counts: tuple[int, ...]
    stddev_mm: tuple[float, ...]
    f: float
    p: float
    p_form: float
    permutations: int

    @property
    def is_equality_plausible(self) -> bool:
        """Whether tests of means may assume equal covariances; classes of different size need more evidence for it."""
        dispersion, form = _DOUBTFUL if np.ptp(self.counts) else _UNEQUAL
        return self.p > dispersion and self.p_form > form

    @property
    def ratio(self) -> float:
        """The largest standard deviation divided by the smallest."""
        return max(self.stddev_mm) / max(min(self.stddev_mm), 1e-300)

    @property
    def smaller_is_more_variable(self) -> bool | None:
        """Whether smaller classes have the larger dispersion; None if size and dispersion are unrelated."""
        counts, spread = np.array(self.counts, dtype=np.float64), np.array(self.stddev_mm)
        together = float(((counts - counts.mean()) * (spread - spread.mean())).sum())
        return None if np.ptp(counts) == 0 or together == 0 else together < 0


def dispersion_test(
    variable: str,
    shapes: FloatArray,
    full: FloatArray,
    codes: Codes,
    groups: tuple[str, ...],
    n_vertices: int,
    permutations: int,
    seed: int,
    stratum: str = "",
) -> DispersionTest | None:
    """Test equal dispersion of classes by the distances of their members from the class mean.

    Args:
        variable: name of the variable.
        shapes: (n, K) shapes, mm.
        full: (n, m) orthonormal columns of the full model, the mean among them.
        codes: (n,) class of each row.
        groups: names of the classes.
        n_vertices: number of vertices of the shapes, for the root mean square.
        permutations: number of permutations, the observed one among them.
        seed: seed of the permutations.
        stratum: name of the stratum.

    Returns:
        the test; None if fewer than two classes have two members with a residual each.
    """
    residual, leverage = shapes - full @ (full.T @ shapes), (full**2).sum(axis=1)
    free = 1.0 - leverage > FULL_LEVERAGE
    counts = np.bincount(codes[free], minlength=len(groups))
    used = [k for k in range(len(groups)) if counts[k] > 1]
    rows = free & np.isin(codes, used)
    if len(used) < 2 or not float((residual[rows] ** 2).sum()):
        return None
    own = np.searchsorted(used, codes[rows])
    squares = (residual[rows] ** 2).sum(axis=1) / (1.0 - leverage[rows])
    variances = np.bincount(own, weights=squares) / np.bincount(own)
    distances = np.sqrt(squares)  # S12
    f = np.concatenate(
        [_f_of_means(distances[rows], own) for _, rows in orders(len(distances), permutations, seed, _STREAM)]
    )
    return DispersionTest(
        variable=variable,
        stratum=stratum,
        groups=tuple(groups[k] for k in used),
        counts=tuple(int(counts[k]) for k in used),
        stddev_mm=tuple(float(v) for v in np.sqrt(variances / n_vertices)),
        f=float(f[0]),
        p=permutation_p(f),
        p_form=_form_p(
            [_contrasts(full[rows][own == k]).T @ shapes[rows][own == k] for k in range(len(used))], permutations, seed
        ),
        permutations=permutations,
    )


def _contrasts(columns: FloatArray) -> FloatArray:
    """Return orthonormal contrasts (n, f) of the rows of a class, to which no column (n, m) of the model adds."""
    u, s, _ = np.linalg.svd(columns)
    return u[:, int((s > FULL_LEVERAGE).sum()) :]


def _form_p(contrasts: Sequence[FloatArray], permutations: int, seed: int) -> float:
    """Return p of the test whether the covariances of classes are proportional (Li and Chen, Ann. Stat. 40, 2012).

    The statistic is the sum over pairs of classes of the squared distance of their covariances, each divided by its
    trace, estimated without bias by the squared products of different contrasts.

    Args:
        contrasts: (f, K) contrasts of each class, mm.
        permutations: number of permutations of the contrasts between classes, the observed one among them.
        seed: seed of the permutations.
    """
    counts = np.array([len(own) for own in contrasts])
    squares = [float((own**2).sum()) for own in contrasts]
    if counts.min() < 2 or min(squares) <= 0:
        return 1.0
    scaled = np.concatenate([own * np.sqrt(len(own) / s) for own, s in zip(contrasts, squares, strict=True)])
    products = (scaled @ scaled.T) ** 2
    np.fill_diagonal(products, 0.0)
    members = np.repeat(np.eye(len(counts)), counts, axis=0)
    # Off the diagonal all pairs of contrasts count; within a class those of different contrasts.
    weights = -1.0 / np.outer(counts, counts)
    np.fill_diagonal(weights, (len(counts) - 1) / (counts * (counts - 1)))
    found = [
        np.einsum("bik,bik->b", members[drawn] @ weights, products @ members[drawn])
        for _, drawn in orders(len(products), permutations, seed, _FORM_STREAM)
    ]
    return permutation_p(np.concatenate(found))


def _f_of_means(values: FloatArray, codes: Codes) -> FloatArray:
    """Return F (b,) of the means of groups, of b arrangements of values (b, n)."""
    counts = np.bincount(codes)
    sums = values @ np.eye(len(counts))[codes]
    total = values.sum(axis=1) ** 2 / len(codes)
    explained = (sums**2 / counts).sum(axis=1)
    between = (explained - total) / (len(counts) - 1)
    within = ((values**2).sum(axis=1) - explained) / max(len(codes) - len(counts), 1)
    return between / np.maximum(within, 1e-300)


@dataclass(frozen=True, eq=False)
class UnequalVariances:
    """Sign flips of the residuals of a reduced model, and the variance of an estimate in each sign flip.

    Args:
        full: (n, m) orthonormal columns of the full model, the mean among them if it was removed.
        residual: (n, K) residuals of the reduced model by weighted least squares, mm.
        scale: (n,) correction of residuals for their leverage.
        leverage: (n,) diagonal of the hat matrix of the full model.
        rotated: rows of each class whose residuals are rotated; the signs of all others are flipped.
        permutations: number of sign flips, the observed data among them.
        seed: seed of the sign flips.
    """

    full: FloatArray
    residual: FloatArray
    scale: FloatArray
    leverage: FloatArray
    rotated: Sequence[Codes]
    permutations: int
    seed: int

    def signs(self) -> Iterator[tuple[int, FloatArray]]:
        """Yield (number of the first row, factors (b, n) of the residuals) in batches; the first row of all is 1.

        Each call yields the same factors.
        """
        n = len(self.residual)
        for start in range(0, self.permutations, _BATCH):
            rng = np.random.default_rng([self.seed, 4, start])
            drawn = rng.choice((-1.0, 1.0), (_BATCH, n))
            for rows in self.rotated:
                # The mean of rotated rows is that of rows with factors from a sphere; their squares have the same sum.
                normal = rng.normal(size=(_BATCH, len(rows)))
                drawn[:, rows] = normal * np.sqrt(len(rows)) / np.linalg.norm(normal, axis=1, keepdims=True)
            factors = (drawn * self.scale)[: self.permutations - start]  # S14
            if start == 0:
                factors[0] = 1.0
            yield start, factors

    def products(self, basis: FloatArray) -> FloatArray:
        """Return the (permutations, m, K) products of `basis` (n, m) with the flipped residuals."""
        out = np.empty((self.permutations, basis.shape[1], self.residual.shape[1]))
        for start, factors in self.signs():
            out[start : start + len(factors)] = (factors[:, None] * basis.T) @ self.residual
        return out

    @cached_property
    def fitted(self) -> FloatArray:
        """(permutations, m, K) products of `full` with the flipped residuals."""
        return self.products(self.full)

    def estimate(self, own: FloatArray) -> EffectEstimate:
        """Return the size and the variance of an estimate along `own` (n, q), orthonormal columns within `full`."""
        weights = (own**2).sum(axis=1) / np.maximum(1.0 - self.leverage, FULL_LEVERAGE)
        return EffectEstimate(self, own.T @ self.full, weights)


@dataclass(frozen=True, eq=False)
class EffectEstimate:
    """The size of an estimate and its variance, in sign flips of residuals.

    Args:
        flips: sign flips of the residuals of the reduced model.
        along: (q, m) direction of the estimate in the columns of `full`.
        weights: (n,) weight of the squared residual of each row in the variance of the estimate.
    """

    flips: UnequalVariances
    along: FloatArray
    weights: FloatArray

    @cached_property
    def _weighted(self) -> FloatArray:
        return self.flips.products(self.weights[:, None] * self.flips.full)

    @cached_property
    def _between(self) -> FloatArray:
        full = self.flips.full
        return full.T @ (self.weights[:, None] * full)

    def statistic(self) -> FloatArray:
        """Return the (permutations,) squared length of the estimate divided by the trace of its covariance (S13)."""
        rows = self.flips.residual
        squares = (rows**2).sum(axis=1)
        fitted, weighted = self.flips.fitted, self._weighted
        explained = ((self.along @ fitted) ** 2).sum(axis=(1, 2))
        variance = self._squares(squares[:, None], 0, self.flips.permutations)[:, 0]
        variance = variance - 2.0 * np.einsum("pmk,pmk->p", weighted, fitted)
        variance += np.einsum("pmk,pmk->p", self._between @ fitted, fitted)
        return explained / np.maximum(variance, _FLOOR * float(self.weights @ squares) + 1e-300)

    def statistic_of(self, columns: FloatArray, width: int, start: int, stop: int) -> FloatArray:
        """Return the (stop - start, v) statistics of v vertices in a part of the sign flips.

        Args:
            columns: (K, v width) matrix from coefficients to values of the vertices.
            width: number of values per vertex.
            start: first sign flip.
            stop: end of the sign flips, exclusive.
        """
        fitted, weighted = (part[start:stop] @ columns for part in (self.flips.fitted, self._weighted))
        squares = _sum_per_vertex((self.flips.residual @ columns) ** 2, width)
        explained = _sum_per_vertex(((self.along @ fitted) ** 2).sum(axis=1), width)
        variance = self._squares(squares, start, stop)
        variance += _sum_per_vertex(((self._between @ fitted - 2.0 * weighted) * fitted).sum(axis=1), width)
        return explained / np.maximum(variance, _FLOOR * (self.weights @ squares) + 1e-300)

    def _squares(self, squares: FloatArray, start: int, stop: int) -> FloatArray:
        """Return the (stop - start, v) weighted sums of squares of the flipped residuals, before a model is fitted."""
        flipped = (self.weights * self.flips.scale**2) @ squares
        out = np.repeat(flipped[None], stop - start, axis=0)
        if start == 0:
            out[0] = self.weights @ squares
        return out


def _sum_per_vertex(values: FloatArray, width: int) -> FloatArray:
    return values.reshape(len(values), -1, width).sum(axis=2)


def unequal_variances(
    shapes: FloatArray,
    full: FloatArray,
    reduced: FloatArray,
    groups: Codes | None,
    permutations: int,
    seed: int,
    where: str,
) -> UnequalVariances:
    """Return the sign flips with which a term of a linear model is tested.

    Args:
        shapes: (n, K) shapes, mm.
        full: (n, m) orthonormal columns of the full model, the mean among them.
        reduced: (n, r) orthonormal columns of the model without the tested terms; r may be 0.
        groups: (n,) class of each row; variances may differ between classes. None for equal weights.
        permutations: number of sign flips, the observed data among them.
        seed: seed of the sign flips.
        where: name of the term, for messages.

    Raises:
        InputError: a row that the model fits exactly, as the only member of a class.
    """
    leverage = (full**2).sum(axis=1)
    if float(leverage.max()) > 1.0 - FULL_LEVERAGE:
        raise InputError(
            f"Unequal variances of {where}: {int((leverage > 1 - FULL_LEVERAGE).sum())} of {len(shapes)} subjects "
            "are fitted exactly, as the only member of a class is, so their variance is unknown; exclude them, or "
            "merge their classes."
        )
    weights, rotated = np.ones(len(shapes)), list[Codes]()
    if groups is not None:
        weights = _class_weights(((shapes - full @ (full.T @ shapes)) ** 2).sum(axis=1), leverage, groups)
        counts = np.bincount(groups)
        rotated = [np.flatnonzero(groups == k) for k in np.flatnonzero(2.0 ** (counts - 1) < FEWEST_PATTERNS)]
    residual, own = weighted_residual(shapes, reduced, weights)
    return UnequalVariances(full, residual, 1.0 / np.sqrt(np.maximum(1.0 - own, FULL_LEVERAGE)), leverage,
                            rotated, permutations, seed)  # fmt: skip


def _class_weights(squares: FloatArray, leverage: FloatArray, groups: Codes) -> FloatArray:
    """Return the weights (n,) of rows by the inverse variance of their class, from squared residuals (n,).

    A class of f degrees of freedom has f - 1 without the row whose residual is flipped. Weights by all f would pull the
    common mean, and so the null distribution, towards small classes.
    """
    free = np.maximum(np.bincount(groups, weights=1.0 - leverage), FULL_LEVERAGE)
    variances = np.bincount(groups, weights=squares) / free
    others = np.maximum(free - 1.0, _LEAST) / free
    return (others / np.maximum(variances, _FLOOR * max(float(variances.max()), 1e-300)))[groups]


def weighted_residual(shapes: FloatArray, columns: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (n, K) of shapes on columns (n, r) by weighted least squares, and the leverages (n,)."""
    if not columns.shape[1]:
        return shapes, np.zeros(len(shapes))
    root = np.sqrt(weights / weights.max())[:, None]
    q = np.linalg.qr(root * columns)[0]
    return shapes - (q @ (q.T @ (root * shapes))) / root, (q**2).sum(axis=1)


def welch_flips(
    maps: FloatArray, second: npt.NDArray[np.bool_], area: FloatArray, permutations: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return Welch's t (V,) of two groups, and in each sign flip its largest |t| and that of the overall difference.

    Args:
        maps: (N, V) values of the subjects; each group has two or more subjects.
        second: (N,) whether a subject is of the second group.
        area: (V,) weights of the vertices in the squared difference.
        permutations: number of sign flips, the observed data among them.
        seed: seed of the sign flips.

    Returns:
        t: (V,) observed t.
        arrangements: (2, P) the largest |t|, and the overall difference divided by its standard error; observed ones
            first.
    """
    members = np.column_stack([~second, second]).astype(np.float64)
    full = members / np.sqrt(members.sum(axis=0))
    mean = np.full((len(maps), 1), len(maps) ** -0.5)
    own = np.linalg.svd(full - mean @ (mean.T @ full), full_matrices=False)[0][:, :1]

    def estimate(values: FloatArray) -> EffectEstimate:
        groups = second.astype(np.intp)
        return unequal_variances(values, full, mean, groups, permutations, seed, "groups").estimate(own)

    # The rows span no more dimensions than there are rows.
    columns, rows = np.linalg.qr(maps.T)
    at_vertices, squares, largest = estimate(rows.T), np.empty(maps.shape[1]), np.zeros(permutations)
    for start in range(0, len(columns), _BATCH):
        found = at_vertices.statistic_of(columns[start : start + _BATCH].T, 1, 0, permutations)
        squares[start : start + _BATCH] = found[0]
        largest = np.maximum(largest, found.max(axis=1))
    whole = estimate(np.linalg.qr((maps * np.sqrt(area)).T)[1].T).statistic()
    sign = np.sign(maps.T @ own[:, 0]) * np.sign(own[second.argmax(), 0])
    return sign * np.sqrt(squares), np.sqrt(np.stack([largest, whole]))
