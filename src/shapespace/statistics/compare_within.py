"""Effects within subjects, tested on one contrast or slope per subject.

A subject's scans are not independent observations of a condition: subjects respond differently, and this variation of
responses limits the precision of a mean difference of two conditions. Each subject's response is therefore estimated
from its own scans first, and the responses are the observations of the test, as in the analysis of variance of repeated
measures with the error of subject by condition, and in the two-stage analysis of slopes (Laird and Ware, Biometrics 38,
1982; Holmes and Friston, NeuroImage 7, 1998).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shapespace.errors import InputError
from shapespace.statistics.compare_formula import Design, Term
from shapespace.statistics.compare_strata import (
    Rows,
    Stratum,
    between_stratum,
    check_not_aliased,
    columns_of_terms,
    common_stratum,
    independent_columns,
    independent_stratum,
    means_of,
)
from shapespace.types import FloatArray

_ESTIMABLE = 1e-6
"""Share of a column's standard deviation below which a subject's own variation of it is rounding."""
_SHARES = np.append(np.linspace(0.0, 0.95, 20), 0.99)
"""Shares of the variance of a typical response due to its estimate; 1 would give one subject all the weight."""


@dataclass(frozen=True, eq=False)
class SubjectResponses:
    """An effect within subjects, estimated for each subject that shows it.

    Args:
        subjects: (s,) numbers of the subjects.
        values: (s, d, K) responses in d orthonormal contrasts, mm.
        variances: (s,) variances of the estimates for unit variance of the cells, mean of the contrasts, divided by
            their median.
    """

    subjects: Rows
    values: FloatArray
    variances: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class WithinSubjects:
    """The cells of subjects, and the effects that differ within subjects.

    Args:
        design: columns of the full model.
        blocks: name of a subject in messages.
        effects: columns of these effects, one term each, after the constant; for the rows of the table.
        terms: number of an effect among the terms of `effects` -> terms of the full model that contain it.
        random: numbers of the effects that differ between subjects.
        shapes: (C, K) means of the shapes of each cell, mm.
        rows: (C,) a row of the table in each cell.
        subject_of_cell: (C,) subject of each cell, from 0.
    """

    design: Design
    blocks: str
    effects: Design
    terms: Mapping[int, tuple[Term, ...]]
    random: tuple[int, ...]
    shapes: FloatArray
    rows: Rows
    subject_of_cell: Rows

    @property
    def count(self) -> int:
        """Number of subjects."""
        return int(self.subject_of_cell.max()) + 1

    def label(self, effect: int) -> str:
        """Return the name of an effect in the formula."""
        return self.effects.terms[effect].label

    def strata(self, squares: str) -> tuple[Stratum, ...]:
        """Return the strata within subjects: one of each effect that differs between subjects, and one of all others.

        Raises:
            InputError: an effect that too few subjects show, or terms that follow from others.
        """
        strata: list[Stratum] = []
        for effect in self.random:
            columns = self.effects.terms[effect].columns
            others = _reduced_effects(self.effects.terms, effect, squares)
            target = np.zeros((self.effects.matrix.shape[1], len(columns)))
            target[list(columns), range(len(columns))] = 1.0
            where = f"within {self.blocks}: {self.label(effect)}"
            strata.append(self._stratum(self._responses(target, [effect, *others]), (effect,), where)[0])
        fixed = [term for effect, own in self.terms.items() if effect not in self.random for term in own]
        if fixed:
            own = columns_of_terms([self.effects.terms[effect] for effect in self.random])
            strata.append(
                common_stratum(
                    shapes=self.shapes,
                    matrix=self.design.matrix[self.rows],
                    own_columns=self.effects.matrix[self.rows][:, own],
                    subject_of_cell=self.subject_of_cell,
                    design=self.design,
                    terms=[term for term in self.design.terms if term in fixed],
                    blocks=self.blocks,
                )
            )
        return tuple(strata)

    def conditions(self) -> Iterator[tuple[Term, FloatArray]]:
        """Yield the terms within subjects with the subjects' means of their columns, less the median over subjects.

        The median is the balanced condition if most subjects have it, so that these need no adjustment.
        """
        means = means_of(self.effects.matrix[self.rows], self.subject_of_cell)
        means = means - np.median(means, axis=0)
        first = np.array(
            [self.rows[np.flatnonzero(self.subject_of_cell == subject)[0]] for subject in range(self.count)]
        )
        scale = self.effects.matrix.std(axis=0)
        for effect, terms in self.terms.items():
            columns = list(self.effects.terms[effect].columns)
            own = means[:, columns] / scale[columns]
            if np.abs(own).max() <= _ESTIMABLE:
                continue
            for term in terms:
                between = self.design.part([term.factors - self.factors]).matrix[first]
                yield term, (own[:, :, None] * between[:, None, :]).reshape(self.count, -1)

    def holds(self, variables: frozenset[str]) -> bool:
        """Return whether the joint effect of variables, by their internal names, may differ between subjects."""
        own = variables & self.variables
        return bool(own) and any(own <= self.effects.terms[effect].variables for effect in self.random)

    @property
    def factors(self) -> frozenset[str]:
        """Factors of the terms that differ within subjects."""
        return frozenset(factor for term in self.effects.terms for factor in term.factors)

    @property
    def variables(self) -> frozenset[str]:
        """Internal names of the variables that differ within subjects."""
        return frozenset(name for term in self.effects.terms for name in term.variables)

    def common_effects(self) -> tuple[str, ...]:
        """Return the effects that are assumed to be the same in all subjects."""
        return tuple(self.label(effect) for effect in self.terms if effect not in self.random)

    def subjects_without_effect(self, strata: Sequence[Stratum]) -> dict[str, int]:
        """Return effect -> number of subjects whose conditions do not determine it."""
        return {
            stratum.name.removeprefix(f"within {self.blocks}: "): self.count - len(stratum.groups)
            for stratum in strata
            if stratum.scheme == "subjects" and len(stratum.groups) < self.count
        }

    def contrast_stratum(self, contrast: FloatArray, variables: frozenset[str], name: str) -> tuple[Stratum, Design]:
        """Return the stratum of one contrast of the conditions within subjects, and its columns between subjects.

        Args:
            contrast: (D,) weights of the columns of `effects`.
            variables: internal names of its variables within subjects.
            name: name of the contrast, for messages.

        Raises:
            InputError: too few subjects show the contrast.
        """
        every = range(1, len(self.effects.terms))
        chosen = tuple(effect for effect in every if variables <= self.effects.terms[effect].variables)
        responses = self._responses(contrast[:, None], list(every), in_mm=True)
        return self._stratum(responses, chosen, f"within {self.blocks}: {name}")

    def _stratum(self, responses: SubjectResponses, effects: Sequence[int], where: str) -> tuple[Stratum, Design]:
        """Return the stratum of responses to some effects, and its columns between subjects."""
        s, d = len(responses.subjects), int(responses.values.shape[1])
        label = where.removeprefix(f"within {self.blocks}: ")
        if not s:
            raise InputError(
                f"In {self.design.formula!r} no {self.blocks} has shapes in all conditions that {label} needs; remove "
                "this effect, or exclude classes with few shapes."
            )
        terms, between = self._between_design(effects)
        first = np.array([np.flatnonzero(self.subject_of_cell == subject)[0] for subject in responses.subjects])
        matrix = between.matrix[self.rows[first]]
        if s - matrix.shape[1] < 1:
            raise InputError(
                f"In {self.design.formula!r} only {s} of {self.count} {self.blocks}s have shapes in the conditions "
                f"that {label} needs, too few for {matrix.shape[1]} columns between {self.blocks}s; remove this "
                "effect, or exclude classes with few shapes."
            )
        columns = np.arange(matrix.shape[1], dtype=np.intp)
        check_not_aliased(matrix, columns, terms, self.design, where)
        roots = np.sqrt(_weights(responses, matrix))
        weighted = roots[:, None] * matrix
        expanded: FloatArray = np.kron(weighted, np.eye(d)).astype(np.float64)
        constant = np.zeros((s, d))
        constant[:, 0] = roots
        stratum = Stratum(
            name=where,
            shapes=(roots[:, None, None] * responses.values).reshape(s * d, -1),
            matrix=expanded,
            columns=np.repeat(columns, d),
            terms=terms,
            groups=np.zeros(s, dtype=np.intp),
            removed=0,
            number=2,
            scheme="subjects",
            width=d,
            units=responses.subjects,
            n_units=self.count,
            constant=constant.ravel(),
        )
        return stratum, between

    def _between_design(self, effects: Sequence[int]) -> tuple[tuple[Term, ...], Design]:
        """Return the terms that contain any of `effects`, and the design of their factors between subjects."""
        chosen = [term for effect in effects for term in self.terms[effect]]
        chosen.sort(key=self.design.terms.index)
        parts = sorted(dict.fromkeys(term.factors - self.factors for term in chosen), key=len)
        made = self.design.part(parts)
        # Terms of several effects with the same part between subjects share its columns.
        terms = [replace(term, columns=made.terms[parts.index(term.factors - self.factors)].columns) for term in chosen]
        return tuple({term.columns: term for term in terms}.values()), made

    def _responses(self, target: FloatArray, model: Sequence[int], *, in_mm: bool = False) -> SubjectResponses:
        """Return contrasts `target` (D, d) of the columns of the effects, in each subject's model of the effects.

        They are scaled so that their squares are those of the cells of an average subject, or in mm (`in_mm`).
        """
        columns = columns_of_terms([self.effects.terms[effect] for effect in sorted(model)])
        values = self.effects.matrix[self.rows][:, columns]
        scale = values.std(axis=0)
        values = values / scale
        wanted = target[columns] / scale[:, None]
        chosen, estimates, covariances = list[int](), list[FloatArray](), list[FloatArray]()
        for subject in range(self.count):
            cells = np.flatnonzero(self.subject_of_cell == subject)
            weights, covariance = _estimate(values[cells] - values[cells].mean(axis=0), wanted)
            if weights is None or covariance is None:
                continue
            chosen.append(subject)
            estimates.append(weights @ self.shapes[cells])
            covariances.append(covariance)
        if not chosen:
            return SubjectResponses(np.zeros(0, dtype=np.intp), np.zeros((0, target.shape[1], 0)), np.zeros(0))
        information = sum(np.linalg.inv(covariance) for covariance in covariances) / len(covariances)
        metric = np.asarray(np.linalg.cholesky(information), dtype=np.float64)
        own = np.array([np.trace(metric.T @ covariance @ metric) for covariance in covariances]) / target.shape[1]
        responses = np.stack(estimates) if in_mm else np.stack([metric.T @ estimate for estimate in estimates])
        return SubjectResponses(np.array(chosen, dtype=np.intp), responses, own / np.median(own))


def _weights(responses: SubjectResponses, matrix: FloatArray) -> FloatArray:
    """Return the (s,) weights of subjects in a model (s, q) of their responses; 1 for all if they are equally precise.

    The variance of a response is the sum of the variance between subjects and the variance of its estimate. The share
    of the second is the value of `_SHARES` with the highest restricted likelihood (Patterson and Thompson, Biometrika
    58, 1971), the same for all coordinates.
    """
    v = responses.variances
    if np.ptp(v) <= _ESTIMABLE:
        return np.ones(len(v))
    y = responses.values.reshape(len(v), -1)
    gram = y @ y.T
    free = len(v) - matrix.shape[1]
    best, chosen = np.inf, v
    for share in _SHARES:
        variance = 1.0 - share + share * v
        roots = 1.0 / np.sqrt(variance)
        q, r = np.linalg.qr(roots[:, None] * matrix)
        white = roots[:, None] * gram * roots
        left = float(np.trace(white) - np.trace(q.T @ white @ q))
        cost = np.log(variance).sum() + 2.0 * np.log(np.abs(np.diag(r))).sum() + free * np.log(max(left, 1e-300))
        if cost < best:
            best, chosen = float(cost), variance
    weights = 1.0 / chosen
    return weights / weights.mean()


def _estimate(values: FloatArray, wanted: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the weights (d, c) of cells by which their responses estimate contrasts, and the weights' products (d, d).

    Both are None if the cells do not determine all contrasts.

    Args:
        values: (c, D) centred columns of the design in the cells.
        wanted: (D, d) contrasts.

    """
    u, s, vt = np.linalg.svd(values, full_matrices=False)
    seen = s > _ESTIMABLE * np.sqrt(len(values))
    u, s, vt = u[:, seen], s[seen], vt[seen]
    inside = vt @ wanted
    if np.linalg.norm(wanted - vt.T @ inside) > _ESTIMABLE * np.linalg.norm(wanted):
        return None, None
    weights = (inside / s[:, None]).T @ u.T
    return weights, weights @ weights.T


def _reduced_effects(effects: Sequence[Term], effect: int, squares: str) -> list[int]:
    """Return the other effects in the model that estimates an effect, for a type of sums of squares."""
    others = range(1, effect) if squares == "I" else [other for other in range(1, len(effects)) if other != effect]
    return [other for other in others if squares != "II" or not effects[effect].factors < effects[other].factors]


@dataclass(frozen=True, kw_only=True)
class RepeatedMeasures:
    """Use of several shapes of a subject in the tests.

    Args:
        n_cells: cells of one subject and condition, to which the shapes are averaged.
        random_effects: effects within subjects that may differ between subjects.
        common_effects: effects within subjects that are assumed to be the same in all subjects.
        subjects_without_effect: effect -> number of subjects without the conditions that determine it; they are
            excluded from its test.
        adjusted_conditions: terms within subjects whose subject means are covariates of the model between subjects.
    """

    n_cells: int
    random_effects: tuple[str, ...] = ()
    common_effects: tuple[str, ...] = ()
    subjects_without_effect: Mapping[str, int] = field(default_factory=dict[str, int])
    adjusted_conditions: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ModelStrata:
    """The strata of a model.

    Args:
        every: strata, each with the terms that are tested in it.
        within: effects within subjects; None without effects within subjects.
        repeated_measures: use of several shapes of a subject in the tests; None if all rows are exchangeable.
    """

    every: tuple[Stratum, ...]
    within: WithinSubjects | None = None
    repeated_measures: RepeatedMeasures | None = None


def strata_of(
    shapes: FloatArray, design: Design, subjects: Sequence[str] | None, blocks: str, squares: str = "II",
    random: Sequence[frozenset[str]] | None = None,
) -> ModelStrata:  # fmt: skip
    """Return the strata of a linear model of shapes.

    Args:
        shapes: (N, K) shapes, mm.
        design: columns of the model, with N rows.
        subjects: (N,) subject of each row; None if all rows are exchangeable.
        blocks: name of a subject in messages.
        squares: type of sums of squares.
        random: effects within subjects that differ between subjects, as products of factors; None for all.

    Raises:
        InputError: one subject, more columns than rows, a term that follows from the others, an effect that too few
            subjects show, or random effects that are not in the model.
    """
    if subjects is None:
        return ModelStrata((independent_stratum(shapes, design),))
    n = len(shapes)
    check_not_aliased(
        *independent_columns(design.matrix - design.matrix.mean(axis=0), design.terms), design.terms, design
    )
    names, who = np.unique(np.asarray(subjects), return_inverse=True)
    if len(names) == 1:
        raise InputError(f"All {n} shapes are of one {blocks}, {names[0]}; a comparison needs several.")
    varying = {variable.column for variable in design.variables if _varies(design.values[variable.column], who)}
    rows, cell = _cells(design, who, varying)
    subject_of_cell = who[rows]
    means = means_of(shapes, cell)
    inner = [term for term in design.terms if term.variables & varying]
    outer = [term for term in design.terms if not term.variables & varying]
    strata: list[Stratum] = []
    within = None
    if inner:
        within = _within_subjects(
            design=design,
            inner=inner,
            varying=varying,
            blocks=blocks,
            random=random,
            shapes=means,
            rows=rows,
            subject_of_cell=subject_of_cell,
        )
        strata += within.strata(squares)
    elif random:
        raise _no_effect_error(random[0], design)
    if outer:
        first = np.array([np.flatnonzero(subject_of_cell == subject)[0] for subject in range(len(names))])
        conditions = () if within is None else tuple(within.conditions())
        strata.insert(
            0,
            between_stratum(
                means_of(means, subject_of_cell), design.matrix[rows[first]], conditions, design, outer, blocks
            ),
        )
    repeated_measures = RepeatedMeasures(
        n_cells=len(rows),
        random_effects=() if within is None else tuple(within.label(effect) for effect in within.random),
        common_effects=() if within is None else within.common_effects(),
        subjects_without_effect={} if within is None else within.subjects_without_effect(strata),
        adjusted_conditions=tuple(term.label for term in strata[0].nuisance) if outer else (),
    )
    return ModelStrata(tuple(strata), within, repeated_measures)


def _within_subjects(
    design: Design, inner: Sequence[Term], varying: set[str], blocks: str, random: Sequence[frozenset[str]] | None,
    shapes: FloatArray, rows: Rows, subject_of_cell: Rows,
) -> WithinSubjects:  # fmt: skip
    factors = {name for name, variable in design.factors.items() if variable in varying}
    effects = list(dict.fromkeys(term.factors & factors for term in inner))
    # Subjects of different classes may differ in their mean, which is a term between subjects.
    for term in inner:
        between = term.factors - factors
        if between and not any(other.factors == between for other in design.terms):
            raise InputError(
                f"In {design.formula!r} {term.label} contains {':'.join(sorted(between))}, which is not a term of its "
                "own; add it to the formula."
            )
    chosen = list(range(1, len(effects) + 1))
    if random is not None:
        for effect in random:
            if effect not in effects:
                raise _no_effect_error(effect, design)
        chosen = [1 + effects.index(effect) for effect in effects if effect in random]
    terms = {
        number: tuple(term for term in inner if term.factors & factors == effect)
        for number, effect in enumerate(effects, 1)
    }
    return WithinSubjects(
        design=design,
        blocks=blocks,
        effects=design.part([frozenset(), *effects]),
        terms=terms,
        random=tuple(chosen),
        shapes=shapes,
        rows=rows,
        subject_of_cell=subject_of_cell,
    )


def _no_effect_error(effect: frozenset[str], design: Design) -> InputError:
    return InputError(
        f"The random term {':'.join(sorted(effect))} is no effect within subjects of {design.formula!r}; write terms "
        "of the formula that differ within subjects."
    )


def _cells(design: Design, who: Rows, varying: set[str]) -> tuple[Rows, Rows]:
    """Return the first row of each cell, in the order of the table, and the (N,) cell of each row.

    A cell consists of the rows of one subject (`who`) that are equal in all `varying` variables.
    """
    values = [design.values[name] for name in sorted(varying)]
    numbers: dict[tuple[object, ...], int] = {}
    rows, cell = list[int](), list[int]()
    for row, key in enumerate(zip(who.tolist(), *values, strict=True)):
        if key not in numbers:
            numbers[key] = len(numbers)
            rows.append(row)
        cell.append(numbers[key])
    return np.array(rows, dtype=np.intp), np.array(cell, dtype=np.intp)


def _varies(values: Sequence[str | float], group: Rows) -> bool:
    """Return whether a variable differs within a group."""
    return len(set(zip(group.tolist(), values, strict=True))) > int(group.max()) + 1
