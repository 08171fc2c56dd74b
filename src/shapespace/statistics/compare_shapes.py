"""Linear models of shape on covariates, with tests of their terms by permutation of residuals.

Collyer and Adams, RRPP, Methods in Ecology and Evolution 9, 2018; Freedman and Lane, J. Business & Economic Statistics
1(4), 1983; Goodall, JRSS B 53(2), 1991.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from msgspec import structs

from shapespace.cohort.cohort import Cohort, with_columns
from shapespace.cohort.part_cohorts import RELATIVE_POSE, cohorts_of_parts, relative_poses, require_parts
from shapespace.cohort.table import number_caution
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirrored_note
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Methods, TestScheme
from shapespace.statistics.compare_formula import (
    Coding,
    Design,
    Term,
    Variable,
    columns_of,
    design_of,
    quoted,
    random_effects_of,
)
from shapespace.statistics.compare_maps import EffectMap, effect_maps
from shapespace.statistics.compare_strata import Rows, Stratum, is_nested, less, span, unit_stratum, without_noise
from shapespace.statistics.compare_within import ModelStrata, RepeatedMeasures, WithinSubjects, strata_of
from shapespace.statistics.dispersion import (
    FULL_LEVERAGE,
    VARIANCES,
    DispersionTest,
    UnequalVariances,
    Variances,
    dispersion_test,
    unequal_variances,
)
from shapespace.statistics.effect_size import EFFECT_SIZES, EffectSize, UnknownP, effect_size, holm_p, permutation_p
from shapespace.statistics.methods import AnalysisResult, dispersion_record, methods_of, sample_sizes
from shapespace.statistics.multiple_imputation import Imputations, over_imputations
from shapespace.statistics.observation_weights import information, weights_of
from shapespace.statistics.tolerances import TIE
from shapespace.step_counter import StepCounter, progress_of_run
from shapespace.types import FloatArray, read_only, require

SquaresType: TypeAlias = Literal["I", "II", "III"]
TYPES: tuple[SquaresType, ...] = ("I", "II", "III")
"""Types of sums of squares: of a term after those before it, after all that do not contain it, or after all others."""

VertexWeights: TypeAlias = Literal["confidence", "none"]
ErrorPermutation: TypeAlias = Literal["units", "residuals"]
_WEIGHTED_NOTE = (
    "Vertices have weights in the sums of squares by the standard deviation of their position along the surface; "
    "--set weights=none gives all the same weight."
)
MOST_LEVELS = 6
"""Largest number of classes of a variable whose pairs are compared."""


@dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """Options of a comparison of groups.

    Args:
        anova_type: type of the sums of squares: `I`, each term after those before it; `II`, each term after all terms
            that do not contain it; `III`, each term after all others.
        blocks: column of the subjects, if subjects have several scans: subjects may then respond differently to all
            conditions within subjects.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        maps: whether to test each vertex.
        bump_width_mm: width (standard deviation, mm) of a bump along the normals that is also searched for at each
            vertex, beyond the variation between shapes; for fits only (default: no search).
        alpha: level of significance.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        random: random effects: the effects within subjects that differ between subjects, such as `1 + time | subject`;
            all others are assumed to be equal in all subjects (default with blocks: all).
        variances: assumption on the variances of the classes: `equal` permutes residuals, `unequal` has a variance for
            each subject and flips the signs of residuals, `auto` uses `unequal` if classes may differ: p is at most 0.3
            for dispersion or 0.1 for form, or 0.05 for either in classes of the same size.
        effect_size: transformation of F in the effect size Z: `box-cox`, as in RRPP from version 0.6, or `log`, as in
            earlier versions.
        weights: weights of the vertices in the sums of squares: `confidence`, smaller where the position along the
            surface is uncertain, if all surfaces are from a correspondence that has estimated this; `none`: equal
            weights.
        errors: term -> error term, whose mean square is the denominator of its F, such as `genus` -> `genus:species`
            (default: the residuals).
        error_permutation: permuted residuals in tests with an error term: `units` permutes the mean residuals of its
            classes, such as species; `residuals` those of single shapes, as RRPP, whose level is wrong if the classes
            vary.
        coding: coding of classes, on which tests of type III depend: `deviation` from their mean, or `treatment`,
            differences from the first class, the default of R.
        pose_axes: three landmarks A, B, C, or numbers of vertices, that define the axes of relative poses of parts:
            axis 1 points from A to B, axis 2 towards C, axis 3 is perpendicular to both (default: the principal axes of
            inertia of the part to which the other is attached).
    """

    anova_type: SquaresType = "II"
    blocks: str | None = None
    permutations: int = 1000
    seed: int = 0
    maps: bool = True
    bump_width_mm: float | None = None
    alpha: float = 0.05
    drop_missing: bool = False
    random: str | None = None
    variances: Variances = "auto"
    effect_size: EffectSize = "box-cox"
    weights: VertexWeights = "confidence"
    errors: Mapping[str, str] = field(default_factory=dict[str, str])
    error_permutation: ErrorPermutation = "units"
    coding: Coding = "deviation"
    pose_axes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.anova_type not in TYPES:
            raise InputError(
                f"There is no type {self.anova_type!r} of sums of squares; choose one of {', '.join(TYPES)}."
            )
        if not 20 <= self.permutations <= 1_000_000:
            raise InputError(f"The number of permutations must lie from 20 to 1000000, not at {self.permutations}.")
        if self.seed < 0 or not 0 < self.alpha < 1:
            raise InputError("The seed must be 0 or more, and the level of significance between 0 and 1.")
        if self.effect_size not in EFFECT_SIZES:
            raise InputError(f"There is no effect size {self.effect_size!r}; choose one of {', '.join(EFFECT_SIZES)}.")
        if self.variances not in VARIANCES:
            raise InputError(f"There are no variances {self.variances!r}; choose one of {', '.join(VARIANCES)}.")
        if self.errors and self.variances == "unequal":
            raise InputError("Tests with error terms assume equal variances; remove one of the two options.")
        if self.coding == "treatment" and (self.blocks or self.random):
            raise InputError("Blocks and random terms need deviation coding; remove the option coding.")
        if self.bump_width_mm is not None and not 0 < self.bump_width_mm < math.inf:
            raise InputError(f"The width of bumps must be millimetres above 0, not {self.bump_width_mm}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class TermTest:
    """A row of the Procrustes analysis of variance.

    Args:
        term: name of the term.
        stratum: stratum in which the term is tested; empty if there is only one.
        df: degrees of freedom.
        squares: sum of squares, mm².
        r2: share of the total sum of squares of the stratum.
        f: mean square divided by that of the residuals; with unequal variances, squared effect divided by its variance.
        z: F in standard deviations above the mean of its arrangements, after `CompareConfig.effect_size`.
        p: share of arrangements with an F as large, the observed one among them.
        arrangements: (P,) F of each, the observed one first.
        error: name of the error term whose mean square is the denominator of F.
        unequal_variances: whether F allows classes of unequal dispersion.
        f_other: F under the other assumption on variances; None without classes, or if that test is not available.
        p_other: p under the other assumption on variances; None if `f_other` is None.
    """

    term: str
    stratum: str
    df: int
    squares: float
    r2: float
    f: float
    z: float
    p: float
    arrangements: FloatArray
    error: str = "residuals"
    unequal_variances: bool = False
    f_other: float | None = None
    p_other: float | None = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class StratumSummary:
    """Residuals and total of a stratum.

    Args:
        stratum: name of the stratum.
        df: degrees of freedom of the residuals.
        squares: sum of squares of the residuals, mm².
        df_total: degrees of freedom of the total.
        squares_total: total sum of squares, mm².
        log_arrangements: logarithm of the number of different arrangements, for the term with the fewest.
    """

    stratum: str
    df: int
    squares: float
    df_total: int
    squares_total: float
    log_arrangements: float


@dataclass(frozen=True, eq=False)
class ShapeEffect:
    """Difference of shape between two values of a variable, all other variables being the same.

    Args:
        name: name of the variable, or of two that interact.
        low: value from which shape changes, such as `sex female`.
        high: value to which shape changes.
        stratum: stratum in which the effect is tested.
        change: (K,) mm, as coefficients of the cohort; from low to high.
        at_low: (K,) the shape at low.
        at_high: (K,) the shape at high.
        distance_mm: Procrustes distance, the root of the squared changes summed over vertices.
        rms_mm: root of the squared changes averaged over vertices.
        f: squared distance by its variance.
        z: F in standard deviations above the mean of its arrangements, after the transformation `effect_size`.
        p: share of arrangements with an F as large.
        p_family: share of arrangements whose largest F of all pairs of classes of this variable is as large.
        map: tests of the effect at each vertex; None if not requested.
        exploratory: whether no term of this effect is significant; its map is then exploratory.
    """

    name: str
    low: str
    high: str
    stratum: str
    change: FloatArray
    at_low: FloatArray
    at_high: FloatArray
    distance_mm: float
    rms_mm: float
    f: float
    z: float
    p: float
    p_family: float
    map: EffectMap | None = None
    exploratory: bool = False

    __repr__ = short_repr

    @property
    def label(self) -> str:
        """The compared values, in words."""
        return f"{self.low} to {self.high.removeprefix(f'{self.name} ')}"


@dataclass(frozen=True)
class EffectAngle:
    """The angle between two changes of shape.

    Args:
        first: label of one change.
        second: label of the other change.
        degrees: angle between the changes, degrees.
        p: p of the test whether the changes are parallel; None if it is not tested or not known.
        unknown_p: reason why p is not known: neither change is longer than its noise. None if p is known, or not
            tested.
    """

    first: str
    second: str
    degrees: float
    p: float | None
    unknown_p: UnknownP | None = None


@dataclass(frozen=True)
class PartTest:
    """A test of a term for one part, or for the relative poses of the parts.

    Args:
        part: name of the part, or `relative pose`.
        shapes: number of shapes that have the part.
        test: the test.
        p_family: p corrected over all parts and the relative pose, for this term, after Holm (1979).
    """

    part: str
    shapes: int
    test: TermTest
    p_family: float


@dataclass(frozen=True, eq=False, kw_only=True)
class CompareResult(AnalysisResult):
    """A linear model of shapes on covariates, with its tests.

    Args:
        cohort: cohort of the compared shapes, without excluded shapes.
        design: columns of the model.
        config: options of the comparison.
        tests: tests of the terms.
        strata: residual degrees of freedom and sums of squares of each stratum.
        effects: effects of the variables, and of pairs of variables that interact.
        angles: angles between effects.
        n_subjects: number of subjects; number of shapes if all are independent.
        dispersions: tests of equal dispersion of the classes of each variable between subjects.
        methods: sample sizes, tests and assumptions.
        repeated_measures: use of several shapes of a subject in the tests; None if all shapes are independent.
        imputations: imputations that p values combine; None without samples of completed shapes.
        parts: the same comparison for each part, aligned as if there were no others, and for the relative poses; empty
            for objects of one part.

    Example:
        >>> config = ss.statistics.CompareConfig(permutations=99)
        >>> result = ss.statistics.compare(cohort, "~ group", config)
        >>> [test.term for test in result.tests]
        ['group']
    """

    cohort: Cohort
    design: Design
    config: CompareConfig
    tests: tuple[TermTest, ...]
    strata: tuple[StratumSummary, ...]
    effects: tuple[ShapeEffect, ...]
    angles: tuple[EffectAngle, ...]
    n_subjects: int
    dispersions: tuple[DispersionTest, ...]
    methods: Methods
    repeated_measures: RepeatedMeasures | None
    imputations: Imputations | None = None
    parts: Mapping[str, CompareResult] = field(default_factory=dict[str, "CompareResult"])

    @cached_property
    def part_tests(self) -> tuple[PartTest, ...]:
        """Tests of each term for each part and for the relative poses, corrected over them."""
        found: list[PartTest] = []
        for term in self.tests:
            own = [
                (name, len(result.cohort), test)
                for name, result in self.parts.items()
                for test in result.tests
                if (test.term, test.stratum) == (term.term, term.stratum)
            ]
            family = holm_p([test.p for _, _, test in own])
            found += [PartTest(*of, p) for of, p in zip(own, family, strict=True)]
        return tuple(found)

    @cached_property
    def mean(self) -> FloatArray:
        """(K,) mean coefficients of the shapes."""
        return read_only(self.cohort.coefficients.mean(axis=0))

    @property
    def unequal_variances(self) -> bool:
        """Whether tests allow classes of unequal dispersion, where that is available."""
        return any(test.unequal_variances for test in self.tests)

    def test(self, term: str) -> TermTest:
        """Return the test of a term.

        Raises:
            InputError: there is no term of that name.
        """
        matches = [test for test in self.tests if test.term == term]
        if not matches:
            raise InputError(f"There is no term {term!r}; there is {', '.join(test.term for test in self.tests)}.")
        return matches[0]

    def __repr__(self) -> str:
        terms = list_briefly([f"{test.term}: R² {100 * test.r2:.1f} %, p {test.p:.3g}" for test in self.tests])
        return f"<CompareResult of {len(self.cohort)} shapes of {self.n_subjects} subjects; {terms}>"


def _update(result: CompareResult) -> CompareResult:
    """Return a comparison whose values that depend on p agree with its tests."""
    effects = tuple(
        replace(effect, exploratory=_is_exploratory(effect, result.design, result.tests, result.config))
        for effect in result.effects
    )
    records = tuple(dispersion_record(test, result.config.alpha) for test in result.dispersions)
    return replace(result, effects=effects, methods=structs.replace(result.methods, dispersions=records))


def compare(
    cohort: Cohort,
    formula: str,
    config: CompareConfig | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> CompareResult:
    """Return the linear model of a cohort's shapes on the variables of a formula, tested by permutation of residuals.

    The formula may contain the columns of the table and also `size` and `log_size`, the centroid size in mm and its
    logarithm.

    Objects of several parts are compared by the shapes of their parts and the relative poses together, and then by
    each part and by the relative poses alone. Shapes that lack a part are excluded from the tests of this part and of
    the relative poses; in the comparison of all together the part is estimated.

    If completed shapes have samples, each imputation is tested too, and p values combine them by Rubin's rules.

    Args:
        cohort: the shapes and their table.
        formula: formula of the model, such as `~ sex + age`.
        config: options; None for the defaults.
        progress: function called with (done, total).

    Raises:
        InputError: a formula that cannot be read, missing columns or values, one group, a constant covariate, terms
            that are linear combinations of others, more columns than shapes, an effect within subjects that too few
            subjects show, or unequal variances with a class of one shape or for an effect that is assumed to be the
            same in all subjects, or axes of relative poses for objects of one part.
        ShapespaceError: the extra `statistics` is not installed.
    """
    require(cohort, Cohort, "compare", "read one with shapespace.read_cohort")
    require(formula, str, "compare", "write a formula such as '~ sex + age'")
    config = config or CompareConfig()
    require(config, CompareConfig, "compare", "give the options as CompareConfig(...)")
    if config.pose_axes:
        require_parts(cohort, "The option pose_axes")
        relative_poses(cohort.take([0]), config.pose_axes)
    parts = cohorts_of_parts(cohort) if cohort.parts else {}
    runs = 1 + len(parts)
    result = _compare_shapes(cohort, formula, config, progress=progress_of_run(progress, 0, runs))
    compared: dict[str, CompareResult] = {}
    for run, (name, own) in enumerate(parts.items(), 1):
        # Maps of the relative poses would show rigid motions alone.
        options = replace(config, bump_width_mm=None, maps=config.maps and name != RELATIVE_POSE)
        try:
            compared[name] = _compare_shapes(own, formula, options, progress=progress_of_run(progress, run, runs))
        except InputError as error:
            raise InputError(f"The comparison of {name}: {error}") from error
    family = ("the parts and their relative pose (p of all parts, Holm 1979)",) if compared else ()
    methods = structs.replace(result.methods, corrected_over=(*result.methods.corrected_over, *family))
    return replace(result, parts=compared, methods=methods)


@over_imputations(
    parts=("tests", "effects", "angles", "dispersions", "map", "along", "any_way", "bump"),
    finish=_update,
    fixed=lambda result: {
        "config": replace(result.config, variances="unequal" if result.unequal_variances else "equal")
    },
)
def _compare_shapes(
    cohort: Cohort, formula: str, config: CompareConfig, *, progress: Callable[[int, int], None] | None
) -> CompareResult:
    """Return the comparison of shapes as they are, see `compare`."""
    random, config = _random_effects(config, cohort)
    cohort = complete_cohort(
        cohort, [formula], [config.blocks] if config.blocks else [], drop_missing=config.drop_missing
    )
    design = design_of(formula, cohort.table, config.coding)
    subjects = None if config.blocks is None else cohort.table.texts(config.blocks)
    repeated = subjects is not None and len(set(subjects)) < len(subjects)
    root = _weight_root(cohort) if config.weights == "confidence" else None
    owners = subjects if repeated else None

    def strata_from(coefficients: FloatArray) -> ModelStrata:
        return strata_of(coefficients, design, owners, config.blocks or "", config.anova_type, random)

    made = strata_from(cohort.coefficients)
    strata = made.every
    if root is not None:
        cohort = replace(cohort, notes=(*cohort.notes, _WEIGHTED_NOTE))
        strata = strata_from(cohort.coefficients @ root).every
    errors = {name: _error_terms(strata, design, name, error) for name, error in config.errors.items()}
    errors = {term.label: error for term, error in errors.values()}
    made, among = _with_units(made, errors, design)
    families = [_add_weights(cohort, design, family) for family in _families(design, made)]
    total = len(design.terms) + len(families) * (1 + config.maps)
    step = StepCounter(total, progress).add
    crossed = {name for term in design.terms if not is_nested(term, design.terms) for name in term.variables}
    columns = {variable.name: variable.column for variable in design.variables}
    asked = config.variances == "unequal"
    units = [units_of(stratum, design, owners) if asked or is_between_units(stratum) else None for stratum in strata]
    dispersions = tuple(
        test
        for own in units
        if own is not None
        for test in own.dispersions(cohort.n_vertices, config.permutations, config.seed)
        if columns[test.variable] in crossed  # classes within others are small
    )
    unequal = asked or (
        config.variances == "auto" and not errors and not all(test.is_equality_plausible for test in dispersions)
    )
    tests = tuple(
        test
        for stratum, own in zip(strata, units, strict=True)
        for test in term_tests(stratum, config, step, own, errors, unequal=unequal)
    )
    effects = tuple(
        replace(effect, exploratory=_is_exploratory(effect, design, tests, config))
        for family in families
        for effect in _effects(cohort, family, design, owners, config, root, step, unequal=unequal)
    )
    methods = _methods(cohort, design, strata, subjects, dispersions, config, errors, tests)
    return CompareResult(
        cohort=cohort,
        design=design,
        config=config,
        tests=tests,
        strata=tuple(_summarise_stratum(stratum, tests, among if stratum is strata[0] else ()) for stratum in strata),
        effects=effects,
        angles=(*_interaction_angles(design, made, config, owners, unequal=unequal), *_effect_angles(effects)),
        n_subjects=len(set(subjects)) if subjects is not None else len(cohort),
        dispersions=dispersions,
        methods=methods,
        repeated_measures=made.repeated_measures,
    )


def complete_cohort(
    cohort: Cohort,
    formulas: Sequence[str],
    columns: Sequence[str],
    *,
    drop_missing: bool,
    numbers: Sequence[str] = (),
) -> Cohort:
    """Return the shapes with values in all columns and formulas, with `size` and `log_size` in the table.

    Args:
        cohort: the shapes.
        formulas: formulas of models; numbers in them that may be codes of classes are in the cohort's `cautions`.
        columns: further columns, of classes.
        drop_missing: whether to exclude shapes with missing values (default: an error).
        numbers: further columns, of numbers.

    Raises:
        InputError: no such column, missing values or sizes, or a formula that cannot be read.
    """
    own = set(cohort.table.columns)
    sizes = {"size": cohort.sizes_mm, "log_size": np.log(cohort.sizes_mm)}
    cohort = with_columns(cohort, {name: v for name, v in sizes.items() if name not in own})
    calls: dict[str, set[str]] = {}
    for formula in formulas:
        for column, own_calls in columns_of(formula, cohort.table).items():
            calls.setdefault(column, set()).update(own_calls)
    named = [*calls, *columns, *numbers]
    unknown = int(np.isnan(cohort.sizes_mm).sum())
    if unknown and not (drop_missing or cohort.drop_missing) and {"size", "log_size"} & set(named) - own:
        raise InputError(
            f"The size of {unknown} of {len(cohort)} shapes is not known in mm; fit them with --unit, or exclude them "
            "with --set missing=drop."
        )
    table = cohort.table
    in_formulas = [column for column in calls if "C" not in calls[column] and table.kind(column) == "number"]
    cohort = cohort.complete(named, drop_missing=drop_missing, numbers={*in_formulas, *numbers} - {*columns})
    plain = [column for column in in_formulas if "" in calls[column] and column not in (*columns, *numbers)]
    cautions = [number_caution(cohort.table, column, f"C({quoted(column)})") for column in plain]
    mirrored = mirrored_note(cohort.vertices, cohort.names.__getitem__, len(cohort))
    return replace(cohort, cautions=(*cohort.cautions, *mirrored, *filter(None, cautions)))


def _error_terms(strata: Sequence[Stratum], design: Design, name: str, error: str) -> tuple[Term, Term]:
    """Return a term and its error term.

    Raises:
        InputError: they are not in the model or in one stratum, or the error is no group of the term's classes.
    """
    found: list[tuple[Term, Stratum]] = []
    for label in (name, error):
        wanted = sorted(label.replace(" ", "").split(":"))
        own = [(t, s) for s in strata for t in s.terms if sorted(t.label.replace(" ", "").split(":")) == wanted]
        if not own:
            terms = ", ".join(term.label for term in design.terms)
            raise InputError(f"There is no term {label[:60]!r} in {design.formula!r}; choose from {terms}.")
        found += own[:1]
    (term, stratum), (error_term, other) = found
    if not term.factors < error_term.factors:
        raise InputError(
            f"The error term {error!r} must contain {name!r} and more, such as genus:species for genus in genus / "
            "species."
        )
    if stratum is not other or stratum.scheme != "permute" or np.ptp(stratum.groups):
        raise InputError(f"{name!r} and {error!r} are not tested between the same subjects; remove one of the two.")
    if any(variable.column in error_term.variables and not variable.levels for variable in design.variables):
        raise InputError(f"The error term {error!r} contains a column of numbers; write C(column) for classes.")
    return term, error_term


def _with_units(
    made: ModelStrata, errors: Mapping[str, Term], design: Design
) -> tuple[ModelStrata, tuple[Stratum, ...]]:
    """Return the strata of effects and the new strata, with tests of terms with an error term on means of its units."""
    if not errors:
        return made, ()
    first = made.every[0]
    own = {error: [term for term in first.terms if errors.get(term.label) is error] for error in errors.values()}
    among = tuple(unit_stratum(first, error, terms, design) for error, terms in own.items())
    left = [term for term in first.terms if term.label not in errors]
    moved = [term for term in first.terms if term.label in errors]
    rest = replace(first, terms=tuple(left), nuisance=(*first.nuisance, *moved))
    return replace(made, every=(*among, rest, *made.every[1:])), among


def _random_effects(config: CompareConfig, cohort: Cohort) -> tuple[tuple[frozenset[str], ...] | None, CompareConfig]:
    """Return the random effects, None for all, and the options with the column of subjects as their blocks."""
    if config.random is None:
        return None, config
    effects, column = random_effects_of(config.random, cohort.table)
    if config.blocks not in (None, column):
        raise InputError(f"Blocks of {config.blocks!r} and random terms of {column!r} differ; give one of the two.")
    return effects, replace(config, blocks=column)


def _weight_root(cohort: Cohort) -> FloatArray | None:
    """Return L (K, K): C L has the sums of squares that coefficients C have with vertices weighted by confidence.

    The weight is v / (v + s^2), with the variance v of a coordinate, mean over the vertices, and `position_std` s. It
    does not depend on the table, so that rows stay exchangeable. None if `position_std` is not known.
    """
    if cohort.position_std is None:
        return None
    centred = cohort.coefficients - cohort.coefficients.mean(axis=0)
    variance = float((centred**2).sum()) / (len(cohort) * cohort.basis.shape[1])
    weight = np.repeat(variance / (variance + cohort.position_std**2), 3)  # S15
    return np.asarray(np.linalg.cholesky((cohort.basis * weight) @ cohort.basis.T), dtype=np.float64)


def _methods(
    cohort: Cohort,
    design: Design,
    strata: Sequence[Stratum],
    subjects: Sequence[str] | None,
    dispersions: Sequence[DispersionTest],
    config: CompareConfig,
    errors: Mapping[str, Term],
    tests: Sequence[TermTest],
) -> Methods:
    """Return sample sizes, tests and assumptions of a comparison."""
    owners = cohort.names if subjects is None else subjects
    unit = config.blocks or "shape"
    schemes: list[TestScheme] = []
    allowing = {(test.term, test.stratum) for test in tests if test.unequal_variances}
    for stratum in strata:
        for term in stratum.terms:
            reduced = stratum.reduced(term, config.anova_type)
            unequal = (term.label, stratum.name) in allowing
            flips = unequal or stratum.flips(reduced)
            own, error = unit if is_between_units(stratum) else f"difference within a {unit}", errors.get(term.label)
            if error is not None and config.error_permutation == "units":
                own, reduced = f"{error.label} unit", [other for other in reduced if other is not error]
            schemes.append(
                TestScheme(
                    tested=(term.label,),
                    statistic="F, unequal variances" if unequal else "F" if error is None else f"F over {error.label}",
                    stratum=stratum.name,
                    resampling="sign flips" if flips else "permutation",
                    unit=own,
                    reduced_model=tuple(other.label for other in reduced),
                    arrangements=config.permutations,
                    unequal_variances=unequal,
                )
            )
    classes = [(variable.name, design.groups_of(variable)) for variable in design.variables if variable.groups]
    several = any(len(_pairs(variable)) > 1 for variable in design.variables)
    return methods_of(
        cohort,
        len(set(owners)),
        level=config.alpha,
        sizes=sample_sizes(owners, classes),
        tests=tuple(schemes),
        dispersions=tuple(dispersion_record(test, config.alpha) for test in dispersions),
        unequal_variances=bool(allowing) if classes else None,
        effect_size=config.effect_size,
        r2_strata=tuple(stratum.name for stratum in strata),
        corrected_over=(
            *(("the vertices of a map (family-wise error, or false discovery rate)",) if config.maps else ()),
            *(("the pairs of classes of a variable (p of all pairs)",) if several else ()),
        ),
    )


def _is_exploratory(effect: ShapeEffect, design: Design, tests: Sequence[TermTest], config: CompareConfig) -> bool:
    """Return whether no term that contains the variables of an effect is significant."""
    names = {variable.column for variable in design.variables if variable.name in effect.name.split(":")}
    own = {term.label for term in design.terms if names <= term.variables}
    return not any(test.term in own and test.p <= config.alpha for test in tests)


def term_tests(
    stratum: Stratum,
    config: CompareConfig,
    step: Callable[[], None] = lambda: None,
    units: Units | None = None,
    errors: Mapping[str, Term] | None = None,
    *,
    unequal: bool = False,
) -> Iterator[TermTest]:
    """Yield the tests of the terms of a stratum.

    Args:
        stratum: the stratum.
        config: options of the comparison.
        step: function called after each term.
        units: units of the stratum, to test with unequal variances too; None if that is not available.
        errors: error terms by the names of terms; None for the residuals.
        unequal: whether unequal variances are reported first if they are available.

    Raises:
        InputError: unequal variances, and a unit that the model fits exactly, or an error term without degrees of
            freedom.
    """
    total = float((stratum.shapes**2).sum())
    for term in stratum.terms:
        reduced = stratum.reduced(term, config.anova_type)
        residual = stratum.residual(reduced)
        own = _own_columns(stratum, term, config)
        rest = span(stratum.matrix - own @ (own.T @ stratum.matrix), stratum.matrix.shape[1] - own.shape[1])
        products = stratum.products(
            np.hstack([own, rest]), residual, config.permutations, config.seed, flips=stratum.flips(reduced)
        )
        squares = (products**2).sum(axis=2)
        df = own.shape[1]
        explained = squares[:, :df].sum(axis=1)  # S2
        f = _ratio(explained / df, ((residual**2).sum() - squares.sum(axis=1)) / stratum.df_error)  # S3
        error, other = (errors or {}).get(term.label), None
        if error is not None:
            f = _error_f(stratum, term, error, config)
        elif units is not None and (config.variances == "unequal" or units.is_comparable):
            # Columns of the reduced model are not tested; each unit has its own variance.
            flips = units.flips([term], reduced, config.permutations, config.seed, term.label)
            other = flips.estimate(units.own(term, reduced)).statistic()
        allowing = unequal and other is not None
        if other is not None and allowing:
            f, other = other, f
        yield TermTest(
            term=term.label,
            stratum=stratum.name,
            df=df,
            squares=float(explained[0]),
            r2=float(explained[0] / total),
            f=float(f[0]),
            z=effect_size(f, config.effect_size),
            p=permutation_p(f),
            arrangements=read_only(f),
            error="residuals" if error is None else error.label,
            unequal_variances=allowing,
            f_other=None if other is None else float(other[0]),
            p_other=None if other is None else permutation_p(other),
        )
        step()


def _own_columns(stratum: Stratum, term: Term, config: CompareConfig) -> FloatArray:
    """Return (n, r) orthonormal columns that a term adds to its reduced model."""
    reduced = stratum.columns_of(stratum.reduced(term, config.anova_type))
    return span(less(stratum.matrix[:, stratum.columns_of([term])], stratum.matrix[:, reduced]))


def _error_f(stratum: Stratum, term: Term, error: Term, config: CompareConfig) -> FloatArray:
    """Return the (P,) mean squares of a term divided by those of its error term (M35), the observed one first."""
    own, noise = _own_columns(stratum, term, config), _own_columns(stratum, error, config)
    reduced, count = stratum.reduced(term, config.anova_type), own.shape[1]
    if config.error_permutation == "units":
        left = [other for other in reduced if other is not error]
        within = float((stratum.residual([*stratum.nuisance, *stratum.terms]) ** 2).sum()) / stratum.df_error
        among = float(((noise.T @ stratum.shapes) ** 2).sum()) / noise.shape[1]
        size = len(stratum.matrix) / (1 + int(stratum.error_units(error).max()))
        drawn = stratum.unit_products(
            np.hstack([own, noise]), left, error, config.permutations, config.seed,
            ratio=max(among / max(within, 1e-300) - 1.0, 0.0) / size,
        )  # fmt: skip
        explained, left_over = drawn[:, :count], drawn[:, count:]
    else:
        # RRPP permutes the residuals of the reduced model of each of the two terms.
        explained, left_over = (
            stratum.products(columns, stratum.residual(model), config.permutations, config.seed)
            for columns, model in ((own, reduced), (noise, stratum.reduced(error, config.anova_type)))
        )
    mean_squares = [(part**2).sum(axis=(1, 2)) / part.shape[1] for part in (explained, left_over)]
    return _ratio(mean_squares[0], mean_squares[1])


def _summarise_stratum(stratum: Stratum, tests: Sequence[TermTest], among: Sequence[Stratum]) -> StratumSummary:
    unequal = any(test.unequal_variances for test in tests if test.stratum == stratum.name)
    return StratumSummary(
        stratum=stratum.name,
        df=stratum.df_error,
        squares=float((stratum.residual(stratum.terms) ** 2).sum()),
        df_total=len(stratum.matrix) - stratum.removed,
        squares_total=float((stratum.shapes**2).sum()),
        log_arrangements=min(own.fewest_log_arrangements(flips=unequal) for own in (stratum, *among)),
    )


@dataclass(frozen=True, eq=False)
class _Contrast:
    """A contrast of a stratum, the terms of its reduced model, and the weight (V,) of each vertex."""

    low: str
    high: str
    stratum: Stratum
    reduced: tuple[Term, ...]
    contrast: FloatArray
    weight: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class _ContrastFamily:
    """Contrasts of one variable, or of two that interact."""

    name: str
    ends: tuple[_Contrast, ...]


def _families(design: Design, strata: ModelStrata) -> Iterator[_ContrastFamily]:
    within = strata.within
    for variable in design.variables:
        alone = [term for term in design.terms if term.variables == frozenset({variable.column})]
        wanted = alone or [term for term in design.terms if variable.column in term.variables]
        both = frozenset({variable.column})
        if within is not None and within.holds(both):
            ends = [_within_ends(within, variable, low, high) for low, high in _pairs(variable)]
            yield _ContrastFamily(variable.name, tuple(ends))
            continue
        for stratum in strata.every:
            own = [term for term in wanted if term in stratum.terms]
            # Classes of a nested variable have no common mean of the others, such as species of different genera.
            if own and (alone or all(len(stratum.columns_of([term])) == len(term.columns) for term in own)):
                reduced = tuple(stratum.without(both))
                ends = [
                    _Contrast(
                        variable.describe(low),
                        variable.describe(high),
                        stratum,
                        reduced,
                        design.contrast(variable.column, low, high),
                    )
                    for low, high in _pairs(variable)
                ]
                yield _ContrastFamily(variable.name, tuple(ends))
    for variable, other in _interacting_pairs(design):
        both = frozenset({variable.column, other.column})
        (low, high), (first, second) = _pairs(variable)[0], _pairs(other)[0]
        levels_text, name = _levels_text(variable, low, high), f"{variable.name}:{other.name}"
        words = f"{levels_text} at {other.describe(first)}", f"the same at {other.describe(second)}"
        if within is not None and within.holds(both):
            yield _ContrastFamily(name, (_within_interaction(within, variable, other, words),))
            continue
        change = [design.contrast(variable.column, low, high, {other.column: value}) for value in (first, second)]
        for stratum in strata.every:
            if any(both <= term.variables for term in stratum.terms):
                yield _ContrastFamily(
                    name, (_Contrast(*words, stratum, tuple(stratum.without(both)), change[1] - change[0]),)
                )


def _add_weights(cohort: Cohort, design: Design, family: _ContrastFamily) -> _ContrastFamily:
    """Return a family with weights: the share of the information on each contrast that each vertex observes.

    The scans of a subject are counted separately, also where a test combines them.
    """
    contrasts: list[FloatArray] = []
    for variable in design.variables:
        if variable.name == family.name:
            contrasts = [design.contrast(variable.column, low, high) for low, high in _pairs(variable)]
    for variable, other in _interacting_pairs(design):
        if f"{variable.name}:{other.name}" == family.name:
            (low, high), values = _pairs(variable)[0], _pairs(other)[0]
            first, second = (design.contrast(variable.column, low, high, {other.column: value}) for value in values)
            contrasts = [second - first]
    # Nested terms have columns that are not independent, and contrasts average over their classes.
    columns = [c for term in design.terms if not is_nested(term, design.terms) for c in term.columns]
    known = information(cohort, design.matrix[:, columns], np.stack(contrasts)[:, columns]) if columns else None
    if known is None:
        return family
    weights = weights_of(known)
    return replace(family, ends=tuple(replace(e, weight=w) for e, w in zip(family.ends, weights, strict=True)))


def _within_ends(within: WithinSubjects, variable: Variable, low: str | float, high: str | float) -> _Contrast:
    """Return the change of a variable within subjects, at the average of the variables between subjects."""
    own = frozenset({variable.column})
    stratum, between = within.contrast_stratum(
        within.effects.contrast(variable.column, low, high), own, _levels_text(variable, low, high)
    )
    return _Contrast(
        variable.describe(low), variable.describe(high), stratum, tuple(stratum.without(own)), between.average({})
    )


def _within_interaction(
    within: WithinSubjects, variable: Variable, other: Variable, words: tuple[str, str]
) -> _Contrast:
    """Return the contrast of two variables, if one or both differ within subjects."""
    both = frozenset({variable.column, other.column})
    (low, high), (first, second) = _pairs(variable)[0], _pairs(other)[0]
    name = f"{variable.name}:{other.name}"
    if both <= within.variables:
        change = [
            within.effects.contrast(variable.column, low, high, {other.column: value}) for value in (first, second)
        ]
        stratum, between = within.contrast_stratum(change[1] - change[0], both, name)
        return _Contrast(*words, stratum, tuple(stratum.without(both)), between.average({}))
    inner, outer = (variable, other) if variable.column in within.variables else (other, variable)
    (low, high), (first, second) = _pairs(inner)[0], _pairs(outer)[0]
    contrast = within.effects.contrast(inner.column, low, high)
    stratum, between = within.contrast_stratum(contrast, frozenset({inner.column}), name)
    return _Contrast(*words, stratum, tuple(stratum.without(both)), between.contrast(outer.column, first, second))


def _pairs(variable: Variable) -> list[tuple[str, str]] | list[tuple[float, float]]:
    """Return the pairs of values whose change of shape is reported."""
    if variable.levels:
        return list(itertools.combinations(variable.levels[:MOST_LEVELS], 2))
    return [(variable.low, variable.high)]


def _levels_text(variable: Variable, low: str | float, high: str | float) -> str:
    return f"{variable.describe(low)} to {variable.describe(high).removeprefix(f'{variable.name} ')}"


def _interacting_pairs(design: Design) -> Iterator[tuple[Variable, Variable]]:
    """Yield pairs of variables with one change each that share a term."""
    for variable, other in itertools.combinations(design.variables, 2):
        together = any({variable.column, other.column} <= term.variables for term in design.terms)
        if together and len(variable.levels) <= 2 and len(other.levels) <= 2:
            yield variable, other


def _effects(
    cohort: Cohort,
    family: _ContrastFamily,
    design: Design,
    subjects: Sequence[str] | None,
    config: CompareConfig,
    root: FloatArray | None,
    step: Callable[[], None],
    *,
    unequal: bool,
) -> Iterator[ShapeEffect]:
    parts = [list(own) for _, own in itertools.groupby(family.ends, key=lambda ends: id(ends.stratum))]
    made = [_test_together(cohort, own, design, subjects, config, root, unequal=unequal) for own in parts]
    largest = np.max([f for f, _, _ in made for f in f], axis=0)
    mean = cohort.coefficients.mean(axis=0)
    step()
    if config.maps:
        step()
    for own, (statistics, changes, maps) in zip(parts, made, strict=True):
        for ends, f, change, effect_map in zip(own, statistics, changes, maps, strict=True):
            distance = float(np.linalg.norm(change))
            yield ShapeEffect(
                name=family.name,
                low=ends.low,
                high=ends.high,
                stratum=ends.stratum.name,
                change=read_only(change),
                at_low=read_only(mean - change / 2),
                at_high=read_only(mean + change / 2),
                distance_mm=distance,
                rms_mm=distance / math.sqrt(cohort.n_vertices),
                f=float(f[0]),
                z=effect_size(f, config.effect_size),
                p=permutation_p(f),
                p_family=float((largest >= f[0] * (1 - TIE)).mean()),
                map=effect_map,
            )


def _test_together(
    cohort: Cohort,
    family: Sequence[_Contrast],
    design: Design,
    subjects: Sequence[str] | None,
    config: CompareConfig,
    root: FloatArray | None,
    *,
    unequal: bool,
) -> tuple[FloatArray, FloatArray, Sequence[EffectMap | None]]:
    """Return F (E, P), weighted by `root`, changes (E, K) in mm and maps of E contrasts of one stratum."""
    stratum, reduced = family[0].stratum, family[0].reduced
    if unequal:
        available = is_between_units(stratum) and stratum.width == 1
        units = units_of(stratum, design, subjects) if available or config.variances == "unequal" else None
        if units is not None and (config.variances == "unequal" or units.is_comparable):
            return _test_unequal(cohort, family, units, config, root)
    residual, flips = stratum.residual(reduced), stratum.flips(reduced)
    directions = np.stack([stratum.direction(ends.contrast) for ends in family])
    lengths = np.maximum(np.linalg.norm(directions, axis=1), 1e-300)
    along = (directions / lengths[:, None]) @ stratum.basis
    products = stratum.products(stratum.basis, residual, config.permutations, config.seed, flips=flips)
    left, drawn = (residual, products) if root is None else (residual @ root, products @ root)
    error = ((left**2).sum() - (drawn**2).sum(axis=(1, 2))) / stratum.df_error
    f = np.stack([_ratio((np.einsum("m,pmk->pk", a, drawn) ** 2).sum(axis=1), error) for a in along])
    changes = directions @ stratum.shapes
    if not config.maps:
        return f, changes, [None] * len(family)
    weights = [ends.weight for ends in family if ends.weight is not None]
    maps = effect_maps(
        cohort=cohort,
        stratum=stratum,
        residual=residual,
        products=products,
        along=along,
        changes=changes,
        bump_width_mm=config.bump_width_mm,
        weights=np.stack(weights) if weights else None,
        alpha=config.alpha,
    )
    return f, changes, maps


def _test_unequal(
    cohort: Cohort, family: Sequence[_Contrast], units: Units, config: CompareConfig, root: FloatArray | None
) -> tuple[FloatArray, FloatArray, Sequence[EffectMap | None]]:
    """Return the result of `_test_together` with unequal variances."""
    stratum = units.stratum
    if stratum.width > 1:
        raise InputError(
            f"Unequal variances are not available for several contrasts of {stratum.name} at once; remove "
            "--variances unequal."
        )
    statistics: list[FloatArray] = []
    changes: list[FloatArray] = []
    maps: list[EffectMap | None] = []
    for ends in family:
        tested = [term for term in stratum.terms if term not in ends.reduced]
        direction = stratum.direction(ends.contrast)
        own = (direction / max(float(np.linalg.norm(direction)), 1e-300))[:, None]
        label = f"{ends.low} to {ends.high}"
        run = (tested, ends.reduced, config.permutations, config.seed, label)
        estimate = units.flips(*run).estimate(own)
        weighted = estimate if root is None else replace(units, shapes=units.shapes @ root).flips(*run).estimate(own)
        statistics.append(weighted.statistic())
        changes.append(direction @ stratum.shapes)
        maps += (
            effect_maps(
                cohort=cohort,
                stratum=stratum,
                residual=estimate.flips.residual,
                products=estimate.flips.fitted,
                along=estimate.along,
                changes=changes[-1][None],
                bump_width_mm=config.bump_width_mm,
                weights=None if ends.weight is None else ends.weight[None],
                estimates=[estimate],
                alpha=config.alpha,
            )
            if config.maps
            else [None]
        )
    return np.stack(statistics), np.stack(changes), maps


def _interaction_angles(
    design: Design, strata: ModelStrata, config: CompareConfig, owners: Sequence[str] | None, *, unequal: bool
) -> Iterator[EffectAngle]:
    """Yield the angle between the changes by a variable in two classes of another variable, if both interact.

    The arrangements are those of the model without the interaction, where these changes are the same.
    """
    for variable, other in itertools.permutations(design.variables, 2):
        both = frozenset({variable.column, other.column})
        together = [term for term in design.terms if term.variables == both]
        main = [term for term in design.terms if term.variables == frozenset({variable.column})]
        if not together or not main or len(variable.levels) > 2 or not other.levels:
            continue
        levels = other.levels[:MOST_LEVELS]
        words = [f"{_levels_text(variable, *_pairs(variable)[0])}, {other.describe(level)}" for level in levels]
        pairs = list(itertools.combinations(range(len(levels)), 2))
        for (first, second), (drawn, weights) in zip(
            pairs, _changes_in_pairs(design, strata, variable, other, config, owners, unequal=unequal), strict=False
        ):
            angle = float(angles_between(drawn[0][:1], drawn[1][:1])[0])
            is_known = any(own * (change[0] ** 2).sum() > 1.0 for change, own in zip(drawn, weights, strict=True))
            p = permutation_p(off_common_direction(*drawn, *weights)) if is_known else None
            yield EffectAngle(words[first], words[second], angle, p, None if is_known else "short vectors")


def _changes_in_pairs(
    design: Design, strata: ModelStrata, variable: Variable, other: Variable, config: CompareConfig,
    owners: Sequence[str] | None, *, unequal: bool,
) -> Iterator[tuple[tuple[FloatArray, FloatArray], tuple[float, float]]]:  # fmt: skip
    """Yield, for each pair of classes of `other`, the change (P, K) by `variable` in either class, and precisions.

    Nothing is yielded if the changes of the two variables belong to different strata.
    """
    both = frozenset({variable.column, other.column})
    low, high = _pairs(variable)[0]
    levels = other.levels[:MOST_LEVELS]
    within = strata.within
    if (
        within is not None
        and within.holds(both)
        and variable.column in within.variables
        and other.column in within.variables
    ):
        # Both within subjects: each arrangement exchanges the two changes in some subjects.
        own = [within.effects.contrast(variable.column, low, high, {other.column: level}) for level in levels]
        for first, second in itertools.combinations(own, 2):
            half, between = within.contrast_stratum((first - second) / 2, both, f"{variable.name}:{other.name}")
            middle, parts = within.contrast_stratum((first + second) / 2, frozenset({variable.column}), variable.name)
            direction = middle.direction(parts.average({}))
            mean, differ = direction @ middle.shapes, half.direction(between.average({}))
            noise, other_noise = (
                float((own**2).sum() * (stratum.residual(stratum.terms) ** 2).sum()) / max(stratum.df_error, 1)
                for own, stratum in ((direction, middle), (differ, half))
            )
            common = without_noise(mean, noise)
            flipped = half.products(differ[:, None], half.shapes, config.permutations, config.seed, flips=True)[:, 0]
            mean = np.concatenate([mean[None], np.repeat(common[None], len(flipped) - 1, axis=0)])
            precision = 1.0 / max(noise + other_noise, 1e-300)
            yield (mean + flipped, mean - flipped), (precision, precision)
        return
    stratum, contrasts = None, list[FloatArray]()
    if within is None or not within.holds(both):
        stratum = next((s for s in strata.every if any(term.variables == both for term in s.terms)), None)
        if stratum is not None and any(term.variables == frozenset({variable.column}) for term in stratum.terms):
            contrasts = [design.contrast(variable.column, low, high, {other.column: level}) for level in levels]
    elif variable.column in within.variables:
        contrast = within.effects.contrast(variable.column, low, high)
        stratum, between = within.contrast_stratum(contrast, frozenset({variable.column}), variable.name)
        contrasts = [between.average({other.column: level}) for level in levels]
    if stratum is not None and contrasts:
        units = units_of(stratum, design, owners) if unequal and is_between_units(stratum) else None
        changes = [_changes_of(stratum, both, own, config, units) for own in contrasts]
        for (first, precise), (second, other_precise) in itertools.combinations(changes, 2):
            yield (first, second), (precise, other_precise)


def _changes_of(
    stratum: Stratum, variables: frozenset[str], contrast: FloatArray, config: CompareConfig, units: Units | None
) -> tuple[FloatArray, float]:
    """Return a contrast (P, K) in each arrangement under the model without `variables`, and its precision.

    It includes the change that this model fits, at its length without noise; variances of `units` may differ.
    """
    reduced, direction = stratum.without(variables), stratum.direction(contrast)
    if units is not None and units.is_comparable and stratum.width == 1:
        tested = [term for term in stratum.terms if term not in reduced]
        flips = units.flips(tested, reduced, config.permutations, config.seed, stratum.name)
        residual, columns = flips.residual, units.columns(reduced)
        variances = (residual**2).sum(axis=1)
        changes = (direction @ flips.full) @ flips.fitted
    else:
        residual, columns = stratum.residual(reduced), stratum.matrix[:, stratum.columns_of(reduced)]
        free = len(residual) - stratum.removed
        variances = np.full(len(residual), (residual**2).sum() / max(free - columns.shape[1], 1))
        products = stratum.products(
            stratum.basis, residual, config.permutations, config.seed, flips=stratum.flips(reduced)
        )
        changes = math.sqrt(free / max(free - columns.shape[1], 1)) * ((direction @ stratum.basis) @ products)
    fitted = np.linalg.pinv(columns).T @ (columns.T @ direction)
    noise = float(fitted**2 @ variances)
    changes = changes + without_noise(direction @ (stratum.shapes - residual), noise)
    changes[0] = direction @ stratum.shapes
    return changes, 1.0 / max(float(direction**2 @ variances), 1e-300)


def _effect_angles(effects: Sequence[ShapeEffect]) -> Iterator[EffectAngle]:
    """Yield angles between the effects of different variables."""
    for effect, other in itertools.combinations(effects, 2):
        if effect.name != other.name and ":" not in effect.name + other.name:
            angle = float(angles_between(effect.change[None], other.change[None])[0])
            yield EffectAngle(effect.label, other.label, angle, None)


def angles_between(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the (P,) angles in degrees of vectors (P, K) (S10)."""
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return np.degrees(np.arccos(np.clip((one * other).sum(axis=1) / np.maximum(lengths, 1e-300), -1, 1)))


def off_common_direction(one: FloatArray, other: FloatArray, weight: float, other_weight: float) -> FloatArray:
    """Return the (P,) weighted squared distance of vectors (P, K) from vectors of one common direction (S10a).

    Unlike the angle, it hardly depends on the length of the common vector, which is unknown.
    """
    first, second = weight * (one**2).sum(axis=1), other_weight * (other**2).sum(axis=1)
    product = math.sqrt(weight * other_weight) * (one * other).sum(axis=1)
    least = (first + second - np.hypot(first - second, 2.0 * product)) / 2.0
    return np.asarray(np.where(product > 0, least, np.minimum(first, second)), dtype=np.float64)


def _ratio(explained: FloatArray, left: FloatArray) -> FloatArray:
    return explained / np.maximum(left, 1e-300)


@dataclass(frozen=True, eq=False, kw_only=True)
class Units:
    """A stratum with one row for each unit that is exchanged: a shape, the mean of a subject, or its contrasts.

    Args:
        stratum: the stratum.
        shapes: (s, d K) mm, the d contrasts of a unit in one row.
        matrix: (s, p) columns of its terms.
        full: (s, m) orthonormal columns of the full model, with the mean if it was removed.
        rows: (s,) a row of the table of each unit.
        design: columns of the full model.
        varying: internal names of the variables that differ within subjects.
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
        """(s,) diagonal of the hat matrix of the full model."""
        return (self.full**2).sum(axis=1)

    @property
    def is_comparable(self) -> bool:
        """Whether there are classes whose variances may differ, and no unit is fitted exactly by the full model."""
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
        cells = list(zip(*(self._values(variable) for variable in variables), strict=True))
        names = {cell: k for k, cell in enumerate(sorted(set(cells)))}
        return np.array([names[cell] for cell in cells], dtype=np.intp)

    def grouping(self, terms: Sequence[Term]) -> list[Variable]:
        """Return the variables of classes in some terms that are the same in all shapes of a unit."""
        named = {column for term in terms for column in term.variables} - self.varying
        return [variable for variable in self.design.variables if variable.column in named and variable.groups]

    def flips(
        self, terms: Sequence[Term], reduced: Sequence[Term], permutations: int, seed: int, name: str
    ) -> UnequalVariances:
        """Return the sign flips of the residuals of a reduced model.

        Args:
            terms: tested terms; the variances of their classes may differ.
            reduced: terms of the reduced model.
            permutations: number of sign flips, the observed data among them.
            seed: seed of the sign flips.
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
        for variable in self.grouping(self.stratum.terms):
            codes = np.array([variable.groups.index(value) for value in self._values(variable)], dtype=np.intp)
            test = dispersion_test(
                variable=variable.name,
                shapes=self.shapes,
                full=self.full,
                codes=codes,
                groups=variable.groups,
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

    def _values(self, variable: Variable) -> list[str]:
        groups = self.design.groups_of(variable)
        rows: list[int] = self.rows.tolist()
        return [groups[row] for row in rows]


def units_of(stratum: Stratum, design: Design, subjects: Sequence[str] | None) -> Units:
    """Return a stratum with one row for each unit.

    Args:
        stratum: the stratum.
        design: columns of the full model.
        subjects: N subjects, one for each row of the table; None if each shape is a unit.

    Raises:
        InputError: units are not exchangeable between subjects.
    """
    if not is_between_units(stratum):
        raise InputError(
            f"Unequal variances are not available for {', '.join(term.label for term in stratum.terms)}, which "
            f"{'are' if len(stratum.terms) > 1 else 'is'} tested within subjects under the assumption that all respond "
            "alike; remove --random, or --variances unequal."
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
