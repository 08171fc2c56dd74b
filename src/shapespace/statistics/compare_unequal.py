"""Strata of a linear model tested with unequal variances, and the dispersion of the classes in each stratum."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.statistics.compare_formula import Design, Term, Variable
from shapespace.statistics.compare_strata import Rows, Stratum, less, span
from shapespace.statistics.dispersion import (
    FULL_LEVERAGE,
    DispersionTest,
    UnequalVariances,
    dispersion_test,
    unequal_variances,
)
from shapespace.types import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Units:
    """A stratum with one row for each unit that is exchanged: a shape, the mean of a subject, or its contrasts.

    Args:
        stratum: the stratum.
        shapes: (s, d K) mm, the d contrasts of a unit in one row.
        matrix: (s, p) of its terms.
        full: (s, m) orthonormal columns of the whole model, with the mean if it was removed.
        rows: (s,) a row of the table of each unit.
        design: of the whole model.
        varying: names inside of the variables that differ within subjects.
    """

    stratum: Stratum
    shapes: FloatArray
    matrix: FloatArray
    full: FloatArray
    rows: Rows
    design: Design
    varying: frozenset[str]

    @property
    def leverage(self) -> FloatArray:
        """(s,) diagonal of the hat matrix of the whole model."""
        return (self.full**2).sum(axis=1)

    @property
    def is_comparable(self) -> bool:
        """Whether there are classes whose variances may differ, and no unit is fitted exactly by the whole model."""
        return float(self.leverage.max()) <= 1.0 - FULL_LEVERAGE and bool(self.grouping(self.stratum.terms))

    def columns(self, terms: Sequence[Term]) -> FloatArray:
        """Return the (s, r) columns of the model of some terms, with the mean if it was removed."""
        own = self.matrix[:, self.stratum.columns_of(terms)[:: self.stratum.width] // self.stratum.width]
        return np.hstack([self._mean, own])

    def own(self, term: Term, reduced: Sequence[Term]) -> FloatArray:
        """Return the (s, q) orthonormal columns of a term, orthogonal to those of its reduced model."""
        return span(less(self.columns([term]), self.columns(reduced)))

    def classes(self, variables: Sequence[Variable]) -> Rows | None:
        """Return the (s,) combination of classes of each unit; None without a variable of classes."""
        if not variables:
            return None
        cells = list(zip(*(self._values(one) for one in variables), strict=True))
        names = {cell: k for k, cell in enumerate(sorted(set(cells)))}
        return np.array([names[cell] for cell in cells], dtype=np.intp)

    def grouping(self, terms: Sequence[Term]) -> list[Variable]:
        """Return the variables of classes in some terms that are the same in all shapes of a unit."""
        named = {column for term in terms for column in term.variables} - self.varying
        return [one for one in self.design.variables if one.column in named and one.groups]

    def flips(
        self, terms: Sequence[Term], reduced: Sequence[Term], permutations: int, seed: int, name: str
    ) -> UnequalVariances:
        """Return the sign flips of the residuals of a reduced model.

        Args:
            terms: that are tested; the variances of their classes may differ.
            reduced: terms of the reduced model.
            permutations: number of sign flips, the observed data among them.
            seed: of these.
            name: name of the tested effect, for messages.

        Raises:
            InputError: a unit that the model fits exactly.
        """
        return unequal_variances(
            shapes=self.shapes,
            full=self.full,
            reduced=self.columns(reduced),
            groups=self.classes(self.grouping(terms)),
            permutations=permutations,
            seed=seed,
            where=name,
        )

    def dispersions(self, n_vertices: int, permutations: int, seed: int) -> Iterator[DispersionTest]:
        """Yield the tests of equal dispersion of the classes of each variable that differs between units."""
        for one in self.grouping(self.stratum.terms):
            codes = np.array([one.groups.index(value) for value in self._values(one)], dtype=np.intp)
            test = dispersion_test(
                variable=one.name,
                shapes=self.shapes,
                full=self.full,
                codes=codes,
                groups=one.groups,
                n_vertices=n_vertices * self.stratum.width,
                permutations=permutations,
                seed=seed,
                stratum=self.stratum.name,
            )
            if test is not None:
                yield test

    @property
    def _mean(self) -> FloatArray:
        count = len(self.shapes)
        return np.full((count, 1 if self.stratum.removed else 0), count**-0.5)

    def _values(self, one: Variable) -> list[str]:
        groups = self.design.groups_of(one)
        rows: list[int] = self.rows.tolist()
        return [groups[row] for row in rows]


def units_of(stratum: Stratum, design: Design, subjects: Sequence[str] | None) -> Units:
    """Return a stratum with one row for each unit.

    Args:
        stratum: the stratum.
        design: of the whole model.
        subjects: N, whose shapes the rows of the table are; None where each shape is a unit.

    Raises:
        InputError: units are not exchangeable between subjects.
    """
    if not is_between_units(stratum):
        raise InputError(
            f"Unequal variances are not available for {', '.join(term.label for term in stratum.terms)}, which "
            f"{'are' if len(stratum.terms) > 1 else 'is'} tested within subjects under the assumption that all respond "
            "alike; leave out --random, or --variances unequal."
        )
    d, count = stratum.width, len(stratum.groups)
    shapes = stratum.shapes.reshape(count, -1)
    matrix = stratum.matrix[::d, ::d]
    mean = np.full((count, 1 if stratum.removed else 0), count**-0.5)
    full = np.linalg.qr(np.hstack([mean, matrix]))[0]
    rows = np.arange(count, dtype=np.intp) if stratum.units is None else stratum.units
    varying: frozenset[str] = frozenset()
    if subjects is not None:
        _, first, who = np.unique(np.asarray(subjects), return_index=True, return_inverse=True)
        codes = [str(code) for code in who]
        rows = first[rows]
        varying = frozenset(
            column for column, values in design.values.items() if len(set(zip(codes, values, strict=True))) > len(first)
        )
    return Units(stratum=stratum, shapes=shapes, matrix=matrix, full=full, rows=rows, design=design, varying=varying)


def is_between_units(stratum: Stratum) -> bool:
    """Return whether the rows of a stratum belong to independent units that are all exchangeable."""
    return stratum.scheme != "flip" and int(stratum.groups.max()) == 0
