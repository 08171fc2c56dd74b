"""Strata of a linear model of shapes, and the arrangements under which their rows are exchangeable.

Without blocks all shapes are exchangeable. Scans of one subject are not independent, so with blocks a model has several
strata, as in the analysis of variance of repeated measures: means of subjects, which are permuted, and for each effect
within subjects the contrasts or slopes of the subjects (`compare_within`), whose signs are flipped or which are
permuted between subjects. An effect that is assumed to be the same in all subjects is tested on the differences of
cells from the subject's mean, which are permuted within subjects (Winkler et al., NeuroImage 123, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.statistics.compare_formula import Design, Term
from shapespace.statistics.tolerances import RANK
from shapespace.types import FloatArray

Rows: TypeAlias = npt.NDArray[np.intp]
Scheme: TypeAlias = Literal["permute", "flip", "subjects"]
"""Arrangement of rows: permuted, or with flipped signs; `subjects` is either, depending on the reduced model."""

_ALIASED = 1e-8  # relative length of a residual column; below it follows from the others
_CONSTANT = 1e-9  # scale of a column of zeros, whose length would be zero
_BATCH = 50
"""Number of arrangements that are drawn from one seed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stratum:
    """Rows that are exchangeable, with the terms that are tested on them.

    Args:
        name: name of the stratum, such as `between subject`; empty if there is only one stratum.
        shapes: (n, K) shapes less the means that are removed, mm.
        matrix: (n, p) columns of the terms, less the same means.
        columns: (p,) number of each column in the design.
        terms: terms that are tested here.
        groups: (n / width,) group of each unit; units of a group are exchangeable.
        removed: number of means removed.
        number: number of the stratum, for its seed.
        nuisance: terms that are in the model but not tested here.
        scheme: arrangement of the units.
        width: consecutive rows of one unit, which stay together.
        units: (n / width,) index of each unit among those for which arrangements are drawn; None if they are the same.
        n_units: number of units for which arrangements are drawn.
        constant: (n,) the row of the constant in the first row of each unit; None if means are removed.
    """

    name: str
    shapes: FloatArray
    matrix: FloatArray
    columns: Rows
    terms: tuple[Term, ...]
    groups: Rows
    removed: int
    number: int
    nuisance: tuple[Term, ...] = ()
    scheme: Scheme = "permute"
    width: int = 1
    units: Rows | None = None
    n_units: int = 0
    constant: FloatArray | None = None

    __repr__ = short_repr

    @property
    def df_error(self) -> int:
        """Degrees of freedom of the residuals."""
        return len(self.matrix) - self.removed - self.matrix.shape[1]

    @cached_property
    def basis(self) -> FloatArray:
        """(n, p) orthonormal columns of the full model."""
        return np.linalg.qr(self.matrix)[0]

    def fewest_log_arrangements(self, *, flips: bool = False) -> float:
        """Return the logarithm of the number of different arrangements, for the term with the fewest.

        Args:
            flips: whether the arrangements of all terms are flips of signs.
        """
        return min(self.log_arrangements(flips=flips or self.flips(self.reduced(term, "III"))) for term in self.terms)

    def log_arrangements(self, *, flips: bool = False) -> float:
        """Return the logarithm of the number of arrangements that differ."""
        if flips:
            return (len(self.groups) - 1) * math.log(2)
        matrix = self.matrix[:: self.width]
        matrix = np.asarray(np.round(matrix / np.maximum(np.abs(matrix).max(axis=0), 1e-300), 9), dtype=np.float64)
        rows = np.column_stack([self.groups.astype(np.float64), matrix])
        alike = np.unique(rows, axis=0, return_counts=True)[1]
        every = np.bincount(self.groups)
        return float(sum(math.lgamma(n + 1) for n in every) - sum(math.lgamma(n + 1) for n in alike))

    def columns_of(self, terms: Sequence[Term]) -> Rows:
        """Return the columns of `matrix` that belong to some terms."""
        wanted = [column for term in terms for column in term.columns]
        return np.flatnonzero(np.isin(self.columns, wanted))

    def reduced(self, term: Term, squares: str) -> list[Term]:
        """Return the terms of the reduced model of a term, for a type of sums of squares: `I`, `II` or `III`."""
        if squares == "I":
            return [*self.nuisance, *self.terms[: self.terms.index(term)]]
        others = [other for other in (*self.nuisance, *self.terms) if other is not term]
        return others if squares == "III" else [other for other in others if not term.factors < other.factors]

    def without(self, variables: frozenset[str]) -> list[Term]:
        """Return the terms that do not contain all of some variables, by their internal names."""
        return [term for term in (*self.nuisance, *self.terms) if not variables <= term.variables]

    def residual(self, terms: Sequence[Term]) -> FloatArray:
        """Return the (n, K) residuals of the model of some of the terms (S1)."""
        return less(self.shapes, self.matrix[:, self.columns_of(terms)])

    def direction(self, contrast: FloatArray) -> FloatArray:
        """Return (n,) weights of the shapes whose weighted sum estimates a contrast (P,) of the design (S6)."""
        own = np.zeros(len(self.columns))
        tested = self.columns_of(self.terms)
        own[tested] = contrast[self.columns[tested]]
        return np.linalg.pinv(self.matrix).T @ own

    def error_units(self, error: Term) -> Rows:
        """Return the (n,) unit of each row, from 0: the combination of classes of an error term."""
        own = [term for term in (*self.nuisance, *self.terms) if term.factors <= error.factors]
        cells = np.round(self.matrix[:, self.columns_of(own)], 9)
        return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)

    def unit_products(
        self, basis: FloatArray, reduced: Sequence[Term], error: Term, permutations: int, seed: int, ratio: float
    ) -> FloatArray:
        """Return the same as `products`, but with the mean residuals of the units of an error term permuted.

        Args:
            basis: (n, m) columns, orthogonal to the reduced model.
            reduced: terms of the reduced model.
            error: error term whose classes are the units.
            permutations: number of permutations, including the observed data.
            seed: seed of the permutations.
            ratio: variance between units divided by that within units, by which means are standardised first.
        """
        units, residual = self.error_units(error), self.residual(reduced)
        means = means_of(residual, units)
        counts = np.bincount(units)[:, None]
        deviation = np.sqrt(ratio + 1.0 / counts)
        sums = means_of(basis, units) * counts * deviation
        among = replace(self, groups=np.zeros(len(means), dtype=np.intp), units=None, n_units=0)
        drawn = among.products(sums, means / deviation, permutations, seed)
        return basis.T @ (residual - means[units]) + drawn  # M34

    def flips(self, reduced: Sequence[Term]) -> bool:
        """Return whether the arrangements of the residuals of a reduced model are flips of signs.

        Contrasts of subjects are exchangeable between subjects if the reduced model contains their mean. If their mean
        is tested, each contrast is equally likely with either sign.
        """
        if self.scheme != "subjects" or self.constant is None:
            return self.scheme == "flip"
        left = less(self.constant[:, None], self.matrix[:, self.columns_of(reduced)])
        return bool(np.linalg.norm(left) > _ALIASED * np.linalg.norm(self.constant))

    def products(
        self, basis: FloatArray, residual: FloatArray, permutations: int, seed: int, *, flips: bool = False
    ) -> FloatArray:
        """Return the (permutations, m, K) products of `basis` (n, m) with `residual` (n, K) in each arrangement.

        The first is as observed.
        """
        out = np.empty((permutations, basis.shape[1], residual.shape[1]))
        for start, rows, signs in self.arrangements(permutations, seed, flips=flips):
            placed = basis[rows] if signs is None else basis * signs[:, :, None]
            made = placed.transpose(0, 2, 1).reshape(-1, len(residual)) @ residual  # S4
            out[start : start + len(rows)] = made.reshape(len(rows), basis.shape[1], -1)
        return out

    def arrangements(
        self, permutations: int, seed: int, *, flips: bool = False
    ) -> Iterator[tuple[int, Rows, FloatArray | None]]:
        """Yield (start, rows (b, n), signs (b, n)) of arrangements; the first is as observed.

        They are the same on each call. If rows are permuted, signs are None; if signs are flipped, rows stay in order.
        Strata of the same units have the same arrangements.
        """
        n = len(self.groups)
        own = np.arange(n) if self.units is None else self.units
        places = np.argsort(self.groups, kind="stable")
        groups = np.sort(self.groups)
        within = np.arange(self.width)
        for start in range(0, permutations, _BATCH):
            count = min(_BATCH, permutations - start)
            every = np.random.default_rng([seed, self.number, start]).random((_BATCH, self.n_units or n))
            keys = every[:count, own]
            rows = np.tile(np.arange(n), (count, 1))
            signs = None
            if flips:
                signs = np.where(keys < 0.5, -1.0, 1.0)
                if start == 0:
                    signs[0] = 1.0
                signs = np.repeat(signs, self.width, axis=1)
            else:
                rows[:, places] = places[np.lexsort((keys, np.broadcast_to(groups, keys.shape)), axis=-1)]
                if start == 0:
                    rows[0] = np.arange(n)
            yield start, (rows[:, :, None] * self.width + within).reshape(count, -1), signs


def without_noise(vectors: FloatArray, noise: FloatArray | float) -> FloatArray:
    """Return vectors (..., K) shortened to the length they have without noise of a total variance (...) (M33a)."""
    squares = np.maximum((vectors**2).sum(axis=-1), 1e-300)
    return vectors * np.sqrt(np.maximum(1.0 - noise / squares, 0.0))[..., None]


def less(shapes: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the residuals (n, K) of shapes (n, K) on columns (n, m)."""
    if not columns.shape[1]:
        return shapes
    q = np.linalg.qr(columns)[0]
    return shapes - q @ (q.T @ shapes)


def span(columns: FloatArray, rank: int | None = None) -> FloatArray:
    """Return orthonormal columns (n, r) that span the same space as `columns`."""
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, : int((s > RANK * max(float(s.max(initial=0.0)), 1e-300)).sum()) if rank is None else rank]


def independent_stratum(shapes: FloatArray, design: Design) -> Stratum:
    """Return the stratum of shapes (N, K) that are all exchangeable.

    Raises:
        InputError: more columns than rows, or a term that follows from the others.
    """
    n = len(shapes)
    everything, columns = independent_columns(design.matrix - design.matrix.mean(axis=0), design.terms)
    check_error_freedom(n - 1, design, "", n, "shapes", len(columns))
    check_not_aliased(everything, columns, design.terms, design)
    rows = np.zeros(n, dtype=np.intp)
    return Stratum(
        name="",
        shapes=shapes - shapes.mean(axis=0),
        matrix=everything,
        columns=columns,
        terms=design.terms,
        groups=rows,
        removed=1,
        number=0,
    )


def between_stratum(
    means: FloatArray, matrix: FloatArray, conditions: Sequence[tuple[Term, FloatArray]], design: Design,
    terms: Sequence[Term], blocks: str,
) -> Stratum:  # fmt: skip
    """Return the stratum of means of subjects.

    Subjects whose scans are of other conditions than those of the rest also differ by these conditions. The subjects'
    means of the columns of the conditions are covariates of the same model, so that F contains the uncertainty of their
    slopes.

    Args:
        means: (S, K) means of the cells of each subject, mm.
        matrix: (S, P) row of the design for each subject.
        conditions: terms within subjects, each with its columns (S, m) less those of the usual condition.
        design: columns of the model.
        terms: terms that are the same in all cells of a subject.
        blocks: name of a subject in messages.

    Raises:
        InputError: more columns than subjects, or a term that follows from the others or from the conditions.
    """
    where = f"between {blocks}"
    covariates, own = independent_columns(matrix - matrix.mean(axis=0), terms)
    n = len(means)
    check_error_freedom(n - 1, design, where, n, "blocks", len(own))
    check_not_aliased(covariates, own, terms, design, where)
    # A condition that is the same for all subjects, or follows from others, adds nothing.
    known = np.empty((n, 0))
    nuisance, adjusted = list[Term](), list[FloatArray]()
    for term, values in conditions:
        columns: list[int] = []
        for column in values.T:
            rest = less(less((column - column.mean())[:, None], known), known)[:, 0]
            if np.linalg.norm(rest) > _ALIASED * math.sqrt(n) * max(float(np.abs(column).max()), _CONSTANT):
                columns.append(matrix.shape[1] + len(adjusted))
                adjusted.append(column - column.mean())
                known = np.column_stack([known, rest / np.linalg.norm(rest)])
        if columns:
            nuisance.append(replace(term, columns=tuple(columns)))
    if adjusted:
        labels = ", ".join(term.label for term in nuisance)
        if n - 1 - len(own) - len(adjusted) < 1:
            raise InputError(
                f"{design.formula!r} has {len(own)} columns {where} and {len(adjusted)} for unequal {labels} of the "
                f"{n} blocks, too many; remove terms, or exclude shapes so that each {blocks} has the same conditions."
            )
        for term in terms:
            values = covariates[:, np.isin(own, term.columns)]
            lengths = np.linalg.norm(values, axis=0)
            if (np.linalg.norm(less(values, known), axis=0) <= _ALIASED * lengths).any():
                raise InputError(
                    f"In {design.formula!r} {term.label} follows from {labels} {where}, so the effects of groups and "
                    "conditions cannot be separated; remove a term."
                )
    model = np.column_stack([covariates, *adjusted])
    ids = np.array([*own, *range(matrix.shape[1], matrix.shape[1] + len(adjusted))], dtype=np.intp)
    check_not_aliased(model, ids, (*nuisance, *terms), design, where)
    rows = np.zeros(n, dtype=np.intp)
    return Stratum(
        name=where,
        shapes=means - means.mean(axis=0),
        matrix=model,
        columns=ids,
        terms=tuple(terms),
        groups=rows,
        removed=1,
        number=1,
        nuisance=tuple(nuisance),
    )


def unit_stratum(stratum: Stratum, error: Term, terms: Sequence[Term], design: Design) -> Stratum:
    """Return the stratum of the means of the units of an error term, where terms with this error are tested.

    Raises:
        InputError: no degrees of freedom, or terms that follow from others.
    """
    units = stratum.error_units(error)
    means = means_of(stratum.matrix, units)
    matrix = np.zeros((len(means), design.matrix.shape[1]))
    own = stratum.columns < matrix.shape[1]
    matrix[:, stratum.columns[own]] = means[:, own]
    others = [
        (term, means[:, stratum.columns_of([term])])
        for term in (*stratum.nuisance, *stratum.terms)
        if term not in terms and not error.factors <= term.factors
    ]
    return between_stratum(means_of(stratum.shapes, units), matrix, others, design, terms, error.label)


def common_stratum(
    shapes: FloatArray, matrix: FloatArray, own_columns: FloatArray, subject_of_cell: Rows, design: Design,
    terms: Sequence[Term], blocks: str,
) -> Stratum:  # fmt: skip
    """Return the stratum of cells within subjects, for effects that are assumed to be the same in all subjects.

    Args:
        shapes: (C, K) shapes of the cells of subjects, mm.
        matrix: (C, P) rows of the design.
        own_columns: (C, q) columns whose slopes, in addition to the mean, differ between subjects.
        subject_of_cell: (C,) subject of each cell, from 0.
        design: columns of the model.
        terms: terms of these effects.
        blocks: name of a subject in messages.

    Raises:
        InputError: more columns than rows, or a term that follows from the others.
    """
    columns = columns_of_terms(terms)
    values = matrix[:, columns]
    n = len(shapes)
    where = f"within {blocks}"
    if not own_columns.shape[1]:
        subjects = int(subject_of_cell.max()) + 1
        check_error_freedom(n - subjects, design, where, n, f"shapes in {subjects} blocks", len(columns))
        inner = values - means_of(values, subject_of_cell)[subject_of_cell]
        check_not_aliased(inner, columns, terms, design, where)
        return Stratum(
            name=where,
            shapes=shapes - means_of(shapes, subject_of_cell)[subject_of_cell],
            matrix=inner,
            columns=columns,
            terms=tuple(terms),
            groups=subject_of_cell,
            removed=subjects,
            number=2,
        )
    # Residuals of each subject's own model in orthonormal coordinates, where they are uncorrelated (Huh, Jhun 2001).
    rows, inner = list[FloatArray](), list[FloatArray]()
    for subject in range(int(subject_of_cell.max()) + 1):
        cells = np.flatnonzero(subject_of_cell == subject)
        u, s, _ = np.linalg.svd(np.column_stack([np.ones(len(cells)), own_columns[cells]]))
        free = u[:, int((s > _ALIASED * s.max()).sum()) :].T
        rows.append(free @ shapes[cells])
        inner.append(free @ values[cells])
    rest, model = np.concatenate(rows), np.concatenate(inner)
    check_error_freedom(len(rest), design, where, len(rest), f"differences of shapes of one {blocks}", len(columns))
    check_not_aliased(model, columns, terms, design, where, np.abs(values).max(axis=0))
    groups = np.zeros(len(rest), dtype=np.intp)
    return Stratum(
        name=where,
        shapes=rest,
        matrix=model,
        columns=columns,
        terms=tuple(terms),
        groups=groups,
        removed=0,
        number=2,
        scheme="flip",
    )


def columns_of_terms(terms: Sequence[Term]) -> Rows:
    """Return the columns of the design that belong to terms, in order."""
    return np.array(sorted(column for term in terms for column in term.columns), dtype=np.intp)


def is_nested(term: Term, terms: Sequence[Term]) -> bool:
    """Return whether a factor of an interaction has no term of its own, as `species` in `genus / species`."""
    single = {factor for other in terms if len(other.factors) == 1 for factor in other.factors}
    return len(term.factors) > 1 and not term.factors <= single


def independent_columns(matrix: FloatArray, terms: Sequence[Term]) -> tuple[FloatArray, Rows]:
    """Return the columns of terms with their numbers in the design (n, P); those of nested terms are independent.

    A nested term has columns for combinations that do not exist, such as a species in another genus. They are replaced
    by an orthonormal basis of the space that the term adds to the terms that it contains.
    """
    matrix, columns = matrix.copy(), list[int]()
    for term in terms:
        own = list(term.columns)
        if is_nested(term, terms):
            inside = [c for other in terms if other.factors < term.factors for c in other.columns if c in columns]
            u, s, _ = np.linalg.svd(less(matrix[:, own], matrix[:, inside]), full_matrices=False)
            rank = int((s > _ALIASED * np.linalg.norm(matrix[:, own])).sum())
            if 0 < rank < len(own):
                own = own[:rank]
                matrix[:, own] = u[:, :rank]
        columns += own
    columns.sort()
    return matrix[:, columns], np.array(columns, dtype=np.intp)


def means_of(rows: FloatArray, group: Rows) -> FloatArray:
    """Return the mean of the rows of each group, for group numbers `group` (n,) that count from 0."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    return np.add.reduceat(rows[order], np.cumsum(counts) - counts, axis=0) / counts[:, None]


def check_error_freedom(free: int, design: Design, where: str, count: int, unit: str, columns: int) -> None:
    """Check that a model leaves degrees of freedom for its error.

    Raises:
        InputError: the model has at least as many columns as free rows.
    """
    if free - columns < 1:
        where_text = f" {where}" if where else ""
        raise InputError(
            f"{design.formula!r} has {columns} column{'s' * (columns != 1)}{where_text} for {count} {unit}, so that "
            "no degrees of freedom are left for the error; remove terms or classes, or add shapes."
        )


def check_not_aliased(
    matrix: FloatArray, columns: Rows, terms: Sequence[Term], design: Design, where: str = "",
    scale: FloatArray | None = None,
) -> None:  # fmt: skip
    """Check that no column follows from those before it, in the order of `terms`.

    Args:
        matrix: (n, p) columns of the model.
        columns: (p,) number of each column in the design.
        terms: terms to which the columns belong.
        design: columns of the model with its formula.
        where: name of the stratum, for messages.
        scale: (p,) scale of each column, far below which it counts as zero (default: the length of the column).

    Raises:
        InputError: a column follows from others.
    """
    known = np.empty((len(matrix), 0))
    for term in terms:
        for index in np.flatnonzero(np.isin(columns, term.columns)):
            values = matrix[:, index]
            length = float(np.linalg.norm(values) if scale is None else scale[index])
            rest = values - known @ (known.T @ values)
            rest -= known @ (known.T @ rest)
            if np.linalg.norm(rest) <= _ALIASED * length or length == 0:
                where_text = f" {where}" if where else ""
                raise InputError(
                    f"In {design.formula!r} {term.label} follows from the other terms{where_text}, or has an empty "
                    "group; remove a term."
                )
            known = np.column_stack([known, rest / np.linalg.norm(rest)])
