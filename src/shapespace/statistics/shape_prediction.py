"""Mean shape as a function of a number, such as age, with intervals: a linear model in which each subject counts
once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from shapespace.cohort.cohort import SUBJECT, Cohort, subjects_of
from shapespace.errors import InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.geometry.procrustes import centroid_size
from shapespace.reprs import list_briefly
from shapespace.schemas import Methods, TestScheme
from shapespace.statistics.compare_formula import Design, design_of, quoted
from shapespace.statistics.compare_shapes import complete_cohort
from shapespace.statistics.compare_strata import check_not_aliased, columns_of_terms
from shapespace.statistics.effect_size import permutation_p
from shapespace.statistics.linear_regressors import IndexArray
from shapespace.statistics.methods import AnalysisResult, methods_of
from shapespace.statistics.subject_regression import SubjectRegression
from shapespace.step_counter import Progress
from shapespace.types import BoolArray, FloatArray, Mesh, read_only, require

Curve: TypeAlias = Literal["linear", "spline"]
FEWEST = 10
"""Subjects per column of the number in the model, below which no shapes are predicted; with 6 per column p is below
0.05 in up to 10 % of studies without an effect (docs/regress.md)."""
_LEAST_DF = 3.0
"""Degrees of freedom below which an interval is not known: there it covers up to 99 % instead of 95 % (measured in
docs/regress.md)."""
_EDGES = (5.0, 95.0)  # percentiles of the number between which the change of shape is measured
_VALUES, _STEPS = 5, 21
"""Number of values without `at`, and number of values at which a slider has a shape."""
_TERMS: Mapping[Curve, str] = {"linear": "{}", "spline": "cr({}, df=2)"}


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedMeasure:
    """The mean of a size or a length at each value.

    Args:
        name: name of the measure, such as `centroid size`.
        observed: (N,) values of the shapes, mm.
        value: (A,) predicted mean, mm.
        low: (A,) lower ends of pointwise intervals, mm; NaN if not known.
        high: (A,) upper ends of pointwise intervals, mm; NaN if not known.

    Example:
        >>> shapes = ss.statistics.predict_shapes(cohort, "age", permutations=99)
        >>> shapes.measures[0].name
        'centroid size'
    """

    name: str
    observed: FloatArray
    value: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrediction(AnalysisResult):
    """Mean shapes along a number.

    Args:
        cohort: cohort of the N shapes, those of a subject one after the other.
        along: column of the number.
        observed: (N,) values of the number.
        formula: formula of the linear model.
        other_terms: terms of the model without the number.
        held: fixed values of other variables, by their names; other numbers are at their mean, classes have equal
            weights.
        values: (A,) values at which shapes are predicted, ascending.
        ends: 5th and 95th percentile of the number, or more extreme values of `values`; the change of shape is between
            them.
        coefficients: (A, K) coefficients of the mean shapes, mm.
        parts: (A + 1, S, K) part of each of the S subjects in the error of each shape, and of the change between the
            ends, mm; their squares sum to the variance.
        df: (A + 1,) degrees of freedom of these variances.
        steps: (B,) values of the number from end to end, ascending.
        path: (B, K) coefficients of the mean shapes at `steps`, mm.
        measures: centroid size, if it is known, and lengths.
        p: p of the hypothesis that shape does not depend on the number, by sign flips of the residuals of subjects;
            None without permutations.
        subject: column of the subjects; None if each shape is of another subject.
        confidence: coverage of intervals.
        permutations: number of sign flips, including the observed data.
        seed: seed of the sign flips.

    Example:
        >>> shapes = ss.statistics.predict_shapes(cohort, "age", permutations=99)
        >>> len(shapes.values) == len(shapes.coefficients)
        True
    """

    cohort: Cohort
    along: str
    observed: FloatArray
    formula: str
    other_terms: tuple[str, ...]
    held: Mapping[str, str | float]
    values: FloatArray
    ends: tuple[float, float]
    coefficients: FloatArray
    parts: FloatArray
    df: FloatArray
    steps: FloatArray
    path: FloatArray
    measures: tuple[PredictedMeasure, ...]
    p: float | None
    subject: str | None
    confidence: float
    permutations: int
    seed: int

    @property
    def n_subjects(self) -> int:
        """Number of subjects."""
        return self.parts.shape[1]

    @property
    def is_known(self) -> BoolArray:
        """(A + 1,) whether the interval of each shape, and of the change between the ends, is known."""
        return self.df >= _LEAST_DF

    @property
    def slope(self) -> FloatArray:
        """(K,) mean change of the coefficients per unit of the number, mm."""
        return (self.path[-1] - self.path[0]) / (self.ends[1] - self.ends[0])

    @property
    def distance_mm(self) -> FloatArray:
        """(A,) distance of each shape from the first, RMS over vertices."""
        return np.linalg.norm(self.coefficients - self.coefficients[0], axis=1) / self.cohort.n_vertices**0.5

    @property
    def distance_std_mm(self) -> FloatArray:
        """(A,) standard error of this change, RMS over vertices."""
        return np.linalg.norm(self.parts[:-1] - self.parts[0], axis=(1, 2)) / self.cohort.n_vertices**0.5

    @property
    def change_mm(self) -> tuple[float, float]:
        """Change of shape between the ends and its standard error, RMS over vertices."""
        change, error = (np.linalg.norm(vector) for vector in (self.path[-1] - self.path[0], self.parts[-1]))
        return float(change / self.cohort.n_vertices**0.5), float(error / self.cohort.n_vertices**0.5)

    @cached_property
    def _directions(self) -> FloatArray:
        """(K, V) displacement along the normals by each coefficient; of points (K, 3V), along the axes."""
        if self.cohort.faces is None:
            return self.cohort.basis
        normals = vertex_normals(Mesh(self.cohort.vertices(self.path[_STEPS // 2]), self.cohort.faces))
        return np.einsum("kvd,vd->kv", self.cohort.basis.reshape(len(self.cohort.basis), -1, 3), normals)

    def half_width_mm(self, k: int) -> FloatArray:
        """Return half the width of the pointwise interval of the mean shape at value `k`, or of the change for A.

        Returns:
            (V,) along the normals; (V, 3) along the axes for landmarks; NaN if it is not known.
        """
        width = _interval_factor(self.df, self.confidence)[k] * np.linalg.norm(
            self.parts[k] @ self._directions, axis=0
        )  # S47
        return width if self.cohort.faces is not None else width.reshape(-1, 3)

    @property
    def per_unit_mm(self) -> FloatArray:
        """(V,) mean change along the normals per unit of the number, mm; lengths for landmarks."""
        moved = self.slope @ self._directions
        return moved if self.cohort.faces is not None else np.linalg.norm(moved.reshape(-1, 3), axis=1)

    @cached_property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        test = TestScheme(
            tested=(self.along,), statistic="F, unequal variances", resampling="sign flips", unit="subject",
            reduced_model=self.other_terms, arrangements=self.permutations,
        )  # fmt: skip
        return methods_of(
            self.cohort, self.n_subjects, tests=() if self.p is None else (test,), level=1 - self.confidence,
            assumptions=(
                f"Mean shapes are those of the linear model {self.formula}, in which each subject counts once. "
                f"Intervals are pointwise, for the mean shape and not for single subjects, with a coverage of "
                f"{100 * self.confidence:g} %; they allow residuals of unequal variance and repeated scans of a "
                "subject (CR2 variances with Student's t).",
            ),
        )  # fmt: skip

    def __repr__(self) -> str:
        values = list_briefly([f"{self.along} {value:.4g}" for value in self.values])
        tested = "" if self.p is None else f", p {self.p:.3g}"
        return f"<ShapePrediction from {len(self.cohort)} shapes of {self.n_subjects} subjects at {values}{tested}>"


def predict_shapes(
    cohort: Cohort,
    along: str,
    *,
    at: Sequence[float] = (),
    curve: Curve = "linear",
    covariates: str = "",
    hold: Mapping[str, str | float] | None = None,
    lengths: Sequence[tuple[str, str]] = (),
    subject: str | None = None,
    confidence: float = 0.95,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapePrediction:
    """Predict the mean shape along a number, such as age, with intervals, and test whether shape changes with it.

    `size` and `log_size`, the centroid size in mm and its logarithm, are available as columns too.

    Args:
        cohort: cohort of the shapes.
        along: column of the number along which shapes are predicted, such as age.
        at: values of the number, within the observed range (default: five from the 5th to the 95th percentile).
        curve: dependence of shape on the number: `linear`, or `spline`, a natural cubic spline with a knot at the
            median (default: linear).
        covariates: further terms of the linear model, such as 'sex + site' or 'sex + age:sex'.
        hold: fixed values of other columns (default: numbers at their mean, and equal weights of classes).
        lengths: pairs of landmarks whose distance is predicted too.
        subject: column of the subjects, each of whom counts once (default: `subject`, if the table has it; otherwise
            each shape is of another subject).
        confidence: coverage of the pointwise intervals of the mean shapes.
        permutations: number of sign flips for p, including the observed data; 0 for none.
        seed: seed of the sign flips.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column or landmark, missing values, a number that is constant or contains classes, values
            outside the observed range, fewer than ten subjects, a model that cannot be estimated, or invalid options.
        ShapespaceError: the extra `statistics` is not installed.
    """
    require(cohort, Cohort, "predict_shapes", "read one with shapespace.read_cohort")
    if curve not in _TERMS:
        raise InputError(f"There is no curve {curve!r}; choose one of {', '.join(_TERMS)}.")
    if permutations < 0 or seed < 0 or not 0.5 <= confidence < 1:
        raise InputError("Permutations and seed must be 0 or more, and the level between 0.5 and 1.")
    subject = subject or (SUBJECT if SUBJECT in cohort.table.columns else None)
    formula = f"{_TERMS[curve].format(quoted(along))}{covariates and ' + '}{covariates.strip(' ~')}"
    cohort = complete_cohort(
        cohort, [formula], [subject] if subject else [], drop_missing=drop_missing, numbers=[along]
    )
    owners = subjects_of(cohort, subject)
    # Sign flips belong to subjects in the order of their names, whatever the order of the table.
    cohort = cohort.take(sorted(range(len(cohort)), key=lambda row: (owners[row], cohort.names[row])))
    owner = np.unique(subjects_of(cohort, subject), return_inverse=True)[1].astype(np.intp)
    where, x = cohort.table.where, _numbers(cohort, along)
    design = design_of(formula, cohort.table)
    variable = next(variable for variable in design.variables if variable.name == along)
    own = [1 + column for term in design.terms if variable.column in term.variables for column in term.columns]
    least = max(FEWEST * len(own), design.matrix.shape[1] + 3)
    if 1 + owner[-1] < least:
        raise InputError(
            f"{where}: {1 + owner[-1]} subjects are too few to predict shapes along {along} by {formula!r}; {least} "
            "are the least."
        )
    check_not_aliased(design.matrix - design.matrix.mean(axis=0), columns_of_terms(design.terms), design.terms, design)
    held = _held_values(design, hold or {}, along, where)
    edges = percentiles(x, owner, _EDGES)
    between = [float(f"{value:.3g}") for value in np.linspace(*edges, _VALUES)]
    values = np.unique(np.asarray(at if len(at) else np.clip(between, x.min(), x.max()), dtype=np.float64))
    if not np.isfinite(values).all() or values[0] < x.min() or values[-1] > x.max():
        raise InputError(
            f"{where}: {along} is observed from {x.min():.6g} to {x.max():.6g}; shapes are not predicted beyond, at "
            f"{values[0] if values[0] < x.min() else values[-1]:.6g}."
        )
    ends = min([edges[0], *at]), max([edges[1], *at])
    steps = np.linspace(*ends, _STEPS)
    rows = np.array([[1.0, *design.average({**held, variable.column: value})] for value in (*values, *steps)])
    model = SubjectRegression(np.column_stack([np.ones(len(x)), design.matrix]), owner)
    shown = np.vstack([rows[: len(values)], rows[-1] - rows[len(values)]])
    predicted, parts, df = model.estimate(shown, cohort.coefficients)
    f = None
    if permutations:
        f = model.statistics(own, cohort.coefficients, permutations, seed, progress)
    return ShapePrediction(
        cohort=cohort,
        along=along,
        observed=x,
        formula=formula,
        other_terms=tuple(term.label for term in design.terms if variable.column not in term.variables),
        held={other.name: held[other.column] for other in design.variables if other.column in held},
        values=read_only(values),
        ends=ends,
        coefficients=read_only(predicted[:-1]),
        parts=read_only(parts),
        df=read_only(df),
        steps=read_only(steps),
        path=read_only(model.predict(rows[len(values) :], cohort.coefficients)),
        measures=tuple(_measures(cohort, lengths, model, rows[: len(values)], confidence)),
        p=None if f is None else permutation_p(f),
        subject=subject,
        confidence=confidence,
        permutations=permutations,
        seed=seed,
    )


def _interval_factor(df: FloatArray, confidence: float) -> FloatArray:
    """Return half the widths of intervals in standard errors; NaN if not known."""
    from scipy.special import stdtrit  # loads much

    return np.where(df >= _LEAST_DF, stdtrit(df, (1 + confidence) / 2), np.nan)


def percentiles(y: FloatArray, codes: IndexArray, percent: tuple[float, float]) -> tuple[float, float]:
    """Return percentiles of numbers (N,) in which each subject counts once, linear between distinct values.

    With one value for each subject they are those of `np.percentile`.
    """
    weights: dict[tuple[float, int], float] = {}
    share = 1.0 / np.bincount(codes)[codes]
    for value, subject, part in zip(y.tolist(), codes.tolist(), share.tolist(), strict=True):
        weights[value, subject] = weights.get((value, subject), 0.0) + part
    own = sorted(weights)
    weight = np.array([weights[key] for key in own])
    midpoint = np.cumsum(weight) - 0.5 * (weight + 1.0)
    last = float(weight.sum()) - 1.0
    values = np.array([value for value, _ in own])
    low, high = (float(np.interp(percentile / 100.0 * last, midpoint, values)) for percentile in percent)
    return low, high


def _numbers(cohort: Cohort, along: str) -> FloatArray:
    """Return the (N,) numbers of a column, which differ."""
    where = cohort.table.where
    if cohort.table.kind(along) == "text":
        raise InputError(
            f"{where}: {along!r} contains classes, and shapes are predicted along a number; compare classes with "
            "shapespace compare."
        )
    x = cohort.table.numbers(along)
    if np.ptp(x) == 0:
        raise InputError(
            f"{where}: {along!r} is {x[0]:g} for all {len(x)} shapes, so nothing changes along it; choose another "
            "column."
        )
    return x


def _held_values(design: Design, hold: Mapping[str, str | float], along: str, where: str) -> dict[str, str | float]:
    """Return the fixed values of variables, by their internal names."""
    known = {
        variable.name.removeprefix("C(").removesuffix(")"): variable
        for variable in design.variables
        if variable.name != along
    }
    held: dict[str, str | float] = {}
    for name, value in hold.items():
        if name not in known:
            raise InputError(f"{name!r} cannot be held; the other columns of the model are: {', '.join(known)}.")
        variable, number = known[name], design.values[known[name].column]
        if variable.levels:
            if str(value) not in variable.levels:
                raise InputError(f"{where}: {name} is {', '.join(variable.levels)}, and cannot be held at {value!r}.")
            held[variable.column] = str(value)
            continue
        observed = np.asarray(number, dtype=np.float64)
        try:
            held[variable.column] = float(value)
        except ValueError as error:
            raise InputError(f"{name} is a column of numbers, and cannot be held at {value!r}.") from error
        if not observed.min() <= float(value) <= observed.max():
            raise InputError(
                f"{where}: {name} is observed from {observed.min():.6g} to {observed.max():.6g}, and cannot be held at "
                f"{value}."
            )
    return held


def _measures(
    cohort: Cohort, lengths: Sequence[tuple[str, str]], model: SubjectRegression, rows: FloatArray, confidence: float
) -> list[PredictedMeasure]:
    """Return the mean centroid size and lengths at each value."""
    known = () if cohort.landmarks is None else cohort.landmarks.names
    for pair in lengths:
        if len(pair) != 2 or not set(pair) <= set(known):
            raise InputError(
                f"The length {','.join(pair)!r} needs two landmarks of the shapes: {', '.join(known) or 'none known'}."
            )
    named = {"centroid size": cohort.sizes_mm} if np.isfinite(cohort.sizes_mm).all() else {}
    if lengths and not named:
        raise InputError("The size of some shapes is not known in mm, so lengths are not either; fit with --unit.")
    if lengths and cohort.landmarks is not None:
        part = slice(None) if cohort.analysed is None else cohort.analysed
        shapes = [cohort.vertices(row) for row in range(len(cohort))]
        # In the gauge `shape` size is divided out of the coordinates.
        scale = cohort.sizes_mm / [centroid_size(shape[part]) for shape in shapes]
        points = scale[:, None, None] * np.stack([cohort.landmarks.interpolate(shape) for shape in shapes])
        for first, second in lengths:
            away = points[:, known.index(first)] - points[:, known.index(second)]
            named[f"{first} to {second}"] = np.linalg.norm(away, axis=1)
    if not named:
        return []
    value, parts, df = model.estimate(rows, np.column_stack(list(named.values())))
    width = _interval_factor(df, confidence)[:, None] * np.linalg.norm(parts, axis=1)  # S47
    return [
        PredictedMeasure(name=name, observed=own, value=value[:, k], low=(value - width)[:, k],
                         high=(value + width)[:, k])
        for k, (name, own) in enumerate(named.items())
    ]  # fmt: skip
