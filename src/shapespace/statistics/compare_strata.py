"""What may be exchanged for what: strata of a linear model of shapes, and their arrangements.

Without blocks all shapes are exchangeable. Scans of one subject are not exchangeable with those of another, so with
blocks a model falls into two strata, as in the analysis of a split plot: means of subjects, which are permuted as
wholes, and differences from them, which are permuted within subjects (Winkler et al., NeuroImage 123, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.statistics.compare_formula import Design, Term
from shapespace.types import FloatArray

Rows: TypeAlias = npt.NDArray[np.intp]

_ALIASED = 1e-8
_CONSTANT = 1e-9
_BATCH = 50
"""Arrangements that are drawn from one seed."""


@dataclass(frozen=True, eq=False)
class Stratum:
    """Rows that are exchangeable, with the terms that are tested on them.

    Args:
        name: such as `between subject`; empty where there is one stratum.
        shapes: (n, K) mm, less the means that are removed.
        matrix: (n, p) of these terms, less the same means.
        columns: (p,) of the design.
        terms: tested here.
        groups: (n,) rows of one number are exchangeable.
        removed: number of means removed.
        number: of the stratum, for its seed.
    """

    name: str
    shapes: FloatArray
    matrix: FloatArray
    columns: Rows
    terms: tuple[Term, ...]
    groups: Rows
    removed: int
    number: int

    __repr__ = short_repr

    @property
    def df_error(self) -> int:
        """Degrees of freedom of the residuals."""
        return len(self.matrix) - self.removed - self.matrix.shape[1]

    @cached_property
    def basis(self) -> FloatArray:
        """(n, p) orthonormal columns of the whole model."""
        return np.linalg.qr(self.matrix)[0]

    @cached_property
    def log_arrangements(self) -> float:
        """Logarithm of how many arrangements there are that differ; rows with the same covariates do not."""
        matrix = np.asarray(np.round(self.matrix / np.abs(self.matrix).max(axis=0), 9), dtype=np.float64)
        rows = np.column_stack([self.groups.astype(np.float64), matrix])
        alike = np.unique(rows, axis=0, return_counts=True)[1]
        every = np.bincount(self.groups)
        return float(sum(math.lgamma(n + 1) for n in every) - sum(math.lgamma(n + 1) for n in alike))

    def at(self, terms: Sequence[Term]) -> Rows:
        """Return the columns of `matrix` that some terms have."""
        wanted = [column for term in terms for column in term.columns]
        return np.flatnonzero(np.isin(self.columns, wanted))

    def residual(self, terms: Sequence[Term]) -> FloatArray:
        """Return the (n, K) residuals of the model of some of the terms."""
        return less(self.shapes, self.matrix[:, self.at(terms)])

    def direction(self, contrast: FloatArray) -> FloatArray:
        """Return (n,) what gives the estimate of a contrast (P,) of the design when multiplied by the shapes."""
        return np.linalg.pinv(self.matrix).T @ contrast[self.columns]

    def products(self, basis: FloatArray, residual: FloatArray, permutations: int, seed: int) -> FloatArray:
        """Return the (permutations, m, K) products of `basis` (n, m) with `residual` (n, K) in each arrangement.

        The first is as observed.
        """
        out = np.empty((permutations, basis.shape[1], residual.shape[1]))
        for start, rows in self.arrangements(permutations, seed):
            placed = basis[rows].transpose(0, 2, 1).reshape(-1, len(residual))
            out[start : start + len(rows)] = (placed @ residual).reshape(len(rows), basis.shape[1], -1)
        return out

    def arrangements(self, permutations: int, seed: int) -> Iterator[tuple[int, Rows]]:
        """Yield (start, rows (b, n)) of arrangements, the same ones whenever it is asked; the first is as observed."""
        places = np.argsort(self.groups, kind="stable")
        groups = np.sort(self.groups)
        for start in range(0, permutations, _BATCH):
            count = min(_BATCH, permutations - start)
            keys = np.random.default_rng([seed, self.number, start]).random((_BATCH, len(places)))[:count]
            rows = np.empty(keys.shape, dtype=np.intp)
            rows[:, places] = places[np.lexsort((keys, np.broadcast_to(groups, keys.shape)), axis=-1)]
            if start == 0:
                rows[0] = np.arange(len(places))
            yield start, rows


def strata_of(shapes: FloatArray, design: Design, subjects: Sequence[str] | None, blocks: str) -> tuple[Stratum, ...]:
    """Return the strata of a linear model of shapes.

    Args:
        shapes: (N, K) mm.
        design: of N rows.
        subjects: N, whose scans the rows are; None where all rows are exchangeable.
        blocks: what a subject is called, in messages.

    Raises:
        InputError: one subject; more columns than rows; or a term that follows from the others.
    """
    n = len(shapes)
    _refuse_few(n - 1, design, "", n, "shapes")
    everything = design.matrix - design.matrix.mean(axis=0)
    _refuse_aliased(everything, design.terms, design)
    columns = np.arange(design.matrix.shape[1], dtype=np.intp)
    if subjects is None:
        rows = np.zeros(n, dtype=np.intp)
        return (Stratum("", shapes - shapes.mean(axis=0), everything, columns, design.terms, rows, 1, 0),)
    names, at = np.unique(np.asarray(subjects), return_inverse=True)
    if len(names) == 1:
        raise InputError(f"All {n} shapes are of one {blocks}, {names[0]}; a comparison needs several.")
    inner = design.matrix - _means(design.matrix, at)[at]
    varies = np.abs(inner).max(axis=0) > _CONSTANT * np.abs(everything).max(axis=0)
    within = tuple(term for term in design.terms if varies[list(term.columns)].any())
    between = tuple(term for term in design.terms if term not in within)
    strata: list[Stratum] = []
    adjusted = shapes
    if within:
        own = _columns(within)
        stratum = Stratum(
            f"within {blocks}", shapes - _means(shapes, at)[at], inner[:, own], own, within, at, len(names), 2
        )
        _refuse_few(n - len(names), design, stratum.name, n, f"shapes in {len(names)} blocks", own=len(own))
        _refuse_aliased(stratum.matrix, within, design, stratum.name)
        # Subjects are compared as if all had the same scans: one without smiles would else seem to differ by them.
        slopes = np.linalg.lstsq(stratum.matrix, stratum.shapes)[0]
        same = design.with_held([one.column for one in design.variables if _varies(design.values[one.column], at)])
        adjusted = shapes - (design.matrix - same)[:, own] @ slopes
        strata.append(stratum)
    if between:
        own = _columns(between)
        means, covariates = _means(adjusted, at), _means(design.matrix[:, own], at)
        _refuse_few(len(names) - 1, design, f"between {blocks}", len(names), "blocks", own=len(own))
        covariates = covariates - covariates.mean(axis=0)
        _refuse_aliased(covariates, between, design, f"between {blocks}")
        rows = np.zeros(len(names), dtype=np.intp)
        first = Stratum(f"between {blocks}", means - means.mean(axis=0), covariates, own, between, rows, 1, 1)
        strata.insert(0, first)
    return tuple(strata)


def less(shapes: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the residuals (n, K) of shapes (n, K) on columns (n, m)."""
    if not columns.shape[1]:
        return shapes
    q = np.linalg.qr(columns)[0]
    return shapes - q @ (q.T @ shapes)


def _columns(terms: Sequence[Term]) -> Rows:
    return np.array(sorted(column for term in terms for column in term.columns), dtype=np.intp)


def _varies(values: Sequence[str | float], at: Rows) -> bool:
    """Return whether a variable differs within a group."""
    return len(set(zip(at.tolist(), values, strict=True))) > int(at.max()) + 1


def _means(rows: FloatArray, at: Rows) -> FloatArray:
    """Return the mean of the rows of each group."""
    out = np.zeros((int(at.max()) + 1, rows.shape[1]))
    np.add.at(out, at, rows)
    return out / np.bincount(at)[:, None]


def _refuse_few(free: int, design: Design, where: str, count: int, what: str, own: int | None = None) -> None:
    columns = design.matrix.shape[1] if own is None else own
    if free - columns < 1:
        place = f" {where}" if where else ""
        raise InputError(
            f"{design.formula!r} has {columns} columns{place}, too many for {count} {what}; leave out terms or classes."
        )


def _refuse_aliased(matrix: FloatArray, terms: Sequence[Term], design: Design, where: str = "") -> None:
    """Check that no column follows from those before it, in the order of `terms`."""
    own = _columns(terms)
    known = np.empty((len(matrix), 0))
    for term in terms:
        for column in term.columns:
            values = matrix[:, np.searchsorted(own, column)]
            length = float(np.linalg.norm(values))
            rest = values - known @ (known.T @ values)
            rest -= known @ (known.T @ rest)
            if np.linalg.norm(rest) <= _ALIASED * length or length == 0:
                place = f" {where}" if where else ""
                raise InputError(
                    f"In {design.formula!r} {term.label} follows from the other terms{place}, or has an empty group; "
                    "leave out one of them."
                )
            known = np.column_stack([known, rest / np.linalg.norm(rest)])
