"""Report of a comparison: sentences, tables, maps and morphs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.part_cohorts import RELATIVE_POSE
from shapespace.report.analyses.analysis_report import (
    AnalysisReport,
    Column,
    LengthFormat,
    ResultTable,
    blank_sentence,
    cohort_report,
    floats,
    histogram_part,
    shape_change_parts,
)
from shapespace.report.analyses.methods_section import (
    bias_of_p,
    dispersion_sentence,
    effect_size_sentence,
    is_dispersion_warning,
    multiplicity_sentence,
)
from shapespace.report.analyses.morphospace_report import compared_morphospace
from shapespace.schemas import CurvePart, Part, Series, SurfaceMapPart, TextPart
from shapespace.statistics.compare_maps import EffectMap, Tested
from shapespace.statistics.compare_shapes import MOST_LEVELS, CompareResult, ShapeEffect, TermTest
from shapespace.statistics.observation_weights import blank_where
from shapespace.statistics.relative_pose import pose_changes, pose_means, poses_of
from shapespace.types import BoolArray, FloatArray, Mesh

_LARGEST_SHARE = 0.05
"""A morph shows changes exaggerated to about this share of the size."""
_VECTOR_SHARE = 0.25
"""The same of vectors of landmarks, which dots of their size would cover."""
_EXAGGERATIONS = (1, 2, 3, 5, 10, 20, 50)  # factors of a displacement; the largest that stays plausible is taken
_BINS = 40  # bins of a histogram of thousands of permutations
_FEWEST_ARRANGEMENTS = 20
"""Number of different arrangements below which no p value can be small."""
_PALE = "Vertices that are not found to differ are pale."
_POSE_DECIMALS = 3  # of degrees and mm in tables of relative poses, below what surfaces show
_NO_FACES = np.zeros((0, 3), dtype=np.int32)


def compare_report(result: CompareResult) -> AnalysisReport:
    """Return a comparison with all that its report shows; files are numbered as its effects are."""
    config = result.config
    morphospace, plotted = compared_morphospace(result)
    every = list(_effects_of_all(result))
    arrays = {f"{file}.npz": _arrays(own, effect) for _, own, effect, file in every}
    content: list[Part | ResultTable] = [
        _term_table(result),
        *_part_tables(result),
        *_term_histograms(result),
        _effect_table(result),
        *_angle_tables(result),
        morphospace,
        *(drawn for part, own, effect, file in every
          for drawn in _effect_parts(own, effect, f"{file}.npz", arrays[f"{file}.npz"], part)),
    ]  # fmt: skip
    return cohort_report(
        "compare",
        f"Shape {result.design.formula.strip()}",
        content,
        result.cohort,
        summary=tuple(_summary(result)),
        arrays={morphospace.arrays: plotted, **arrays},
        meshes=dict(_meshes(every)),
        notes=tuple(
            dict.fromkeys(
                (
                    *result.cohort.notes,
                    *_repeated_measures_notes(result),
                    *(note for own in result.parts.values() for note in own.cohort.notes),
                )
            )
        ),
        settings={
            "formula": result.design.formula,
            "squares": config.anova_type,
            "blocks": config.blocks,
            "random": config.random,
            "permutations": config.permutations,
            "seed": config.seed,
            "level": config.alpha,
            "variances": config.variances,
            "unequal_variances": result.unequal_variances,
            "effect_size": config.effect_size,
            "coding": config.coding,
            "gauge": result.cohort.gauge,
            "shapes": len(result.cohort),
            "subjects": result.n_subjects,
            **({} if config.bump_width_mm is None else {"bump_width_mm": config.bump_width_mm}),
            **({"weights": config.weights} if result.cohort.source.kind == "corresponding" else {}),
            **({"parts": dict(result.cohort.parts), "pose_axes": list(config.pose_axes)} if result.parts else {}),
            **({"errors": dict(config.errors), "error_permutation": config.error_permutation} if config.errors else {}),
        },
        methods=result.methods,
        imputations=result.imputations,
    )


def _summary(result: CompareResult) -> Iterator[str]:
    """Yield the results of terms with their limits, warnings on all terms, the sample, and then maps."""
    yield from _term_sentences(result)
    for name, own in result.parts.items():
        yield from _term_sentences(own, name, {t.test.term: t.p_family for t in result.part_tests if t.part == name})
    yield from _pose_sentences(result)
    yield from compare_warnings(result)
    shapes = len(result.cohort)
    of_subjects = f" of {result.n_subjects} subjects" if result.n_subjects < shapes else ""
    yield f"{shapes} shapes{of_subjects}, {result.config.permutations} arrangements, the observed one among them."
    yield multiplicity_sentence(result.methods)
    for part, own, effect, _ in _effects_of_all(result):
        label = f"{part}, {effect.label}" if part else effect.label
        if effect.map is not None:
            yield _map_sentence(own, effect, effect.map, label)
            if effect.map.blank is not None:
                yield f"{label}: {blank_sentence(int(effect.map.blank.sum()), len(effect.map.blank))}"
            if effect.map.bump is not None and effect.map.bump_mm is not None:
                yield _bump_sentence(own, effect, effect.map.bump, effect.map.bump_mm)


def _effects_of_all(result: CompareResult) -> Iterator[tuple[str, CompareResult, ShapeEffect, str]]:
    """Yield the effects of all parts together, then of each part: name of the part, its comparison, effect, file."""
    for number, effect in enumerate(result.effects, 1):
        yield "", result, effect, f"effect_{number}"
    for part, (name, own) in enumerate(result.parts.items(), 1):
        for number, effect in enumerate(own.effects, 1):
            yield name, own, effect, f"part_{part}_effect_{number}"


def _term_sentences(result: CompareResult, part: str = "", family: Mapping[str, float] | None = None) -> Iterator[str]:
    """Yield a sentence on each term; `family` are p values over all parts."""
    kind = {"box-cox": "Box-Cox", "log": "log F"}[result.config.effect_size]
    subject = "shape including relative pose" if result.parts else part or "shape"
    subject = f"the shape of {part}" if part in result.cohort.parts or (part and part != RELATIVE_POSE) else subject
    for test in result.tests:
        p = test.p if family is None else family[test.term]
        figures = f"R² {100 * test.r2:.1f} %, F {test.f:.2f}, Z {test.z:.1f} by {kind}, {_p_text(test.p)}"
        figures += "" if family is None else f", {p:.3g} over all parts"
        stratum = f" {test.stratum.partition(':')[0]}" if test.stratum else ""
        limits = _limits(result, test)
        if p <= result.config.alpha:
            yield f"{subject[0].upper()}{subject[1:]} differs with {test.term}{stratum} ({figures}{limits})."
        else:
            yield f"No difference of {subject} with {test.term}{stratum} is found ({figures}{limits})."


def _pose_sentences(result: CompareResult) -> Iterator[str]:
    """Yield the change of the relative pose at each joint by each effect, in degrees and lengths."""
    if not result.parts:
        return
    for label, change in pose_changes(result).items():
        for joint, values in zip(poses_of(result).joints, change, strict=True):
            yield (
                f"{label}: {joint} rotates by {np.linalg.norm(values[:3]):.1f}° and moves by "
                f"{_lengths(result).text(float(np.linalg.norm(values[3:])))} at the joint."
            )


def _part_tables(result: CompareResult) -> Iterator[ResultTable]:
    """Yield the tests of each part and of the relative pose, and the relative poses; nothing for one part."""
    if not result.parts:
        return
    strata, lengths = any(test.stratum for test in result.tests), _lengths(result)
    yield ResultTable(
        title="Parts and relative pose",
        level=2,
        note="Each part is aligned as if there were no others; distances of relative poses are mm of vertices. The "
        "last column corrects p over all parts and the relative pose, for each term (Holm 1979).",
        columns=(
            Column("part", field="part"), Column("term", field="term"),
            Column("tested" if strata else "", field="stratum"), Column("shapes", "count", "shapes"),
            Column("R²", "percent", "r2"), Column("F", "number", "f"), Column("Z", "number", "z"),
            Column("p", "p", "p"), Column("p of all parts", "p", "p_of_all_parts"),
        ),
        rows=[
            (own.part, own.test.term, own.test.stratum, own.shapes, own.test.r2, own.test.f, own.test.z, own.test.p,
             own.p_family)
            for own in result.part_tests
        ],
        file="parts.csv",
    )  # fmt: skip
    angle = [Column(f"rotation {k}, degrees", "number", f"rotation_{k}_degrees") for k in (1, 2, 3)]
    numbers = (
        *angle,
        *(Column(lengths.label(f"translation {k}"), "number", lengths.field(f"translation_{k}")) for k in (1, 2, 3)),
    )
    poses = poses_of(result)
    axes = (
        f"Axis 1 points from {result.config.pose_axes[0]} to {result.config.pose_axes[1]}, axis 2 towards "
        f"{result.config.pose_axes[2]}, axis 3 is perpendicular to both"
        if result.config.pose_axes
        else "Axes are the principal axes of inertia of the part to which the other is attached, the longest first"
    )
    yield ResultTable(
        title="Mean relative pose",
        note="Relative to the mean of all shapes: components of the rotation vector, and displacements at the joint, "
        f"with 95 % intervals of the mean and standard deviations between subjects. {axes}.",
        columns=(
            Column("shapes", field="group"), Column("joint", field="joint"), Column("subjects", "count", "subjects"),
            Column("component", field="component"), *(Column(name, "number", name) for name in ("mean", "low", "high")),
            Column("standard deviation", "number", "stddev"),
        ),
        rows=[
            (own.group, own.joint, own.subjects, column.name, *values)
            for own in pose_means(result)
            for column, *values in zip(numbers, *(np.round(v, _POSE_DECIMALS) + 0.0 for v in
                                                  (own.mean, own.low, own.high, own.stddev)), strict=True)
        ],
        file="pose_means.csv",
    )  # fmt: skip
    yield ResultTable(
        title="Change of relative pose",
        note=f"Change of least-squares means from low to high. {axes}.",
        columns=(Column("from, to", field="change"), Column("joint", field="joint"), *numbers),
        rows=[
            (label, joint, *np.asarray(np.round(change[k], _POSE_DECIMALS) + 0.0, dtype=np.float64))
            for label, change in pose_changes(result).items()
            for k, joint in enumerate(poses.joints)
        ],
        file="pose_changes.csv",
    )
    yield ResultTable.of_fields(
        "pose.csv",
        ("specimen", "joint", *(column.field for column in numbers)),
        [
            (name, joint, *values)
            for name, own in zip(poses.names, poses.numbers, strict=True)
            for joint, values in zip(poses.joints, own, strict=True)
        ],
    )


def _limits(result: CompareResult, test: TermTest) -> str:
    """Return the assumption of a test on variances, with p under the other assumption, or that it is violated."""
    if test.unequal_variances:
        other = "" if test.p_other is None else f"; {_p_text(test.p_other)} with it"
        return f" without the assumption of equal variances{other}"
    named = set(test.term.split(":"))
    violated = [
        dispersion
        for dispersion in result.methods.dispersions
        if dispersion.stratum == test.stratum and dispersion.variable in named and not dispersion.equal
    ]
    if not violated:
        return ""
    other = "" if test.p_other is None else f"; {_p_text(test.p_other)} without this assumption"
    return f", which is {bias_of_p(violated[0])}: it assumes equal variances{other}"


def compare_warnings(result: CompareResult) -> tuple[str, ...]:
    """Return sentences on limitations of the tests."""
    unequal = result.unequal_variances
    return (
        *(
            dispersion_sentence(dispersion, unequal, result.cohort.unit)
            for dispersion in result.methods.dispersions
            if is_dispersion_warning(dispersion, unequal_variances=unequal)
        ),
        *_subject_warnings(result),
        *_arrangement_warnings(result),
        *_repeated_measures_warnings(result),
        *_uncentred_warnings(result),
        *(
            f"It is not known whether the changes {angle.first} and {angle.second} have the same direction (angle "
            f"{angle.degrees:.0f}°): neither is longer than its noise."
            for angle in result.angles
            if angle.unknown_p
        ),
        *(
            f"{variable.name} has {len(variable.levels)} classes; pairs of the first {MOST_LEVELS} are compared."
            for variable in result.design.variables
            if len(variable.levels) > MOST_LEVELS and any(effect.name == variable.name for effect in result.effects)
        ),
    )


def _subject_warnings(result: CompareResult) -> Iterator[str]:
    table, blocks = result.cohort.table, result.config.blocks
    if blocks is None:
        names = table.columns.get("subject", ())
        if all(names) and len(set(names)) < len(names):
            yield (
                f"The {len(names)} shapes are of {len(set(names))} subjects and are treated as independent, which "
                "makes p values too small; pass --blocks subject."
            )
        return
    counts = Counter(table.texts(blocks))
    if max(counts.values()) == 1:
        yield f"No {blocks} has two shapes, so --blocks changes nothing."
    elif len(set(counts.values())) > 1 and result.strata[0].stratum.startswith("between"):
        yield (
            f"There are {min(counts.values())} to {max(counts.values())} shapes of a {blocks}; each counts "
            "once, by its mean, and p is approximate where means of few scans are noisier."
        )


def _arrangement_warnings(result: CompareResult) -> Iterator[str]:
    for stratum in result.strata:
        if stratum.log_arrangements < math.log(_FEWEST_ARRANGEMENTS):
            name = f" {stratum.stratum}" if stratum.stratum else ""
            yield (
                f"There are only {round(math.exp(stratum.log_arrangements))} arrangements{name} that differ, so no p "
                "can be small."
            )


def _repeated_measures_warnings(result: CompareResult) -> Iterator[str]:
    repeated, blocks = result.repeated_measures, result.config.blocks
    if repeated is None:
        return
    if repeated.common_effects:
        yield (
            f"All {blocks}s are assumed to respond alike to {', '.join(repeated.common_effects)}; if they do not, p "
            f"within {blocks}s is too small. Without --random the responses may differ between {blocks}s."
        )
    for effect, count in repeated.subjects_without_effect.items():
        yield (
            f"{count} of {result.n_subjects} {blocks}s lack conditions from which {effect} can be estimated, and "
            "are excluded from its test."
        )


def _uncentred_warnings(result: CompareResult) -> Iterator[str]:
    design = result.design
    for variable in design.variables:
        # A function of the variable, such as center(age), defines its own zero.
        has_interaction = any(
            variable.column in term.variables and len(term.variables) > 1 and variable.name in term.factors
            for term in design.terms
        )
        if (
            result.config.anova_type == "III"
            and has_interaction
            and not variable.levels
            and variable.low * variable.high > 0
        ):
            yield (
                f"Type III tests the effects that vary with {variable.name} at {variable.name} = 0, which lies outside "
                f"the data; write center({variable.name}) in the formula, or use type II."
            )


def _repeated_measures_notes(result: CompareResult) -> Iterator[str]:
    repeated, blocks = result.repeated_measures, result.config.blocks
    if repeated is None:
        return
    if repeated.n_cells < len(result.cohort):
        yield (
            f"{len(result.cohort)} shapes are averaged to {repeated.n_cells} cells of one {blocks} and condition; "
            "repeated shapes of a cell do not count as further observations."
        )
    if repeated.random_effects:
        yield (
            f"Each {blocks} may respond differently to {', '.join(repeated.random_effects)}: each of these effects is "
            f"tested on one estimate per {blocks}; the signs of the estimates are flipped, or the estimates are "
            f"permuted between {blocks}s."
        )
    if repeated.adjusted_conditions:
        labels = ", ".join(repeated.adjusted_conditions)
        yield (
            f"The shapes of each {blocks} are not of the same conditions: the means of {labels} per {blocks} are "
            f"covariates of the model between {blocks}s, so that its F contains the uncertainty of this adjustment."
        )


_EXPLORATORY = "exploratory, since its term is not significant: "


def _map_sentence(result: CompareResult, effect: ShapeEffect, effect_map: EffectMap, label: str) -> str:
    """Return a sentence on the map of an effect; the map is exploratory if no term of the effect is significant."""
    level = result.config.alpha
    scope = f"family-wise error {100 * level:g} % within this map"
    significant = effect_map.test.p_family <= level
    if not significant.any():
        return f"{label}: no vertex differs ({scope})."
    return (
        f"{label}: {_EXPLORATORY if effect.exploratory else ''}{int(significant.sum()):,} of "
        f"{len(significant):,} vertices differ ({scope}), the clearest by {_clearest(result, effect_map)}."
    )


def _clearest(result: CompareResult, effect_map: EffectMap) -> str:
    """Return the change at the vertex with the largest F, with its simultaneous interval."""
    lengths, vertex = _lengths(result), int(effect_map.test.f.argmax())
    low, high = effect_map.interval_mm(vertex)
    sign = "" if effect_map.normal_mm is None else "+"
    return (
        f"{lengths.text(effect_map.shown_mm[vertex], sign)} (simultaneous {100 * (1 - result.config.alpha):g} % "
        f"interval {lengths.number(low, sign)} to {lengths.text(high, sign)}){_near_landmark(result.cohort, vertex)}"
    )


def _bump_sentence(result: CompareResult, effect: ShapeEffect, bump: Tested, bump_mm: FloatArray) -> str:
    level, vertex = result.config.alpha, int(bump.f.argmax())
    scope = f"family-wise error {100 * level:g} % within this map"
    if bump.p_family[vertex] > level:
        return f"{effect.label}: no bump is found beyond the variation between shapes ({scope})."
    return (
        f"{effect.label}: a bump of {_lengths(result).text(bump_mm[vertex], '+')} or more is found"
        f"{_near_landmark(result.cohort, vertex)} ({scope})."
    )


def _lengths(result: CompareResult) -> LengthFormat:
    return LengthFormat(result.cohort.unit)


def _p_text(p: float) -> str:
    return f"p {p:.3g}"


def _near_landmark(cohort: Cohort, vertex: int) -> str:
    """Return the name of the landmark next to a vertex, in words; empty if the cohort has no landmarks."""
    if not cohort.landmarks:
        return ""
    landmarks = cohort.landmarks.interpolate(cohort.reference)
    distances = np.linalg.norm(landmarks - cohort.reference[vertex], axis=1)
    name = cohort.landmarks.names[int(distances.argmin())]
    return f" at landmark {name}" if cohort.source.kind == "landmarks" else f" near {name}"


def _term_table(result: CompareResult) -> ResultTable:
    strata, lengths, config = (
        any(test.stratum for test in result.tests),
        LengthFormat(result.cohort.unit),
        result.config,
    )
    rows: list[tuple[Any, ...]] = [
        (t.term, t.stratum, t.df, t.squares, t.squares / t.df, t.r2, t.r2, t.f, t.z, t.p,
         "unequal" if t.unequal_variances else "equal", t.f_other, t.p_other, t.error if config.errors else "",
         t.error)
        for t in result.tests
    ]  # fmt: skip
    shown: list[int] = []
    for stratum in result.strata:
        shown += [k for k, test in enumerate(result.tests) if test.stratum == stratum.stratum]
        shown += [len(rows), len(rows) + 1]
        share, mean_square, unknown = (
            stratum.squares / stratum.squares_total,
            stratum.squares / stratum.df,
            (*[None] * 6, "", None),
        )
        rows += [
            ("residual", stratum.stratum, stratum.df, stratum.squares, mean_square, share, share, *unknown),
            ("total", stratum.stratum, stratum.df_total, stratum.squares_total, None, None, 1.0, *unknown),
        ]
    other = "equal" if result.unequal_variances else "unequal"
    has_other = any(test.p_other is not None for test in result.tests)
    return ResultTable(
        title="Analysis of variance",
        level=2,
        columns=(
            Column("term", field="term"), Column("tested" if strata else "", field="stratum"),
            Column("df", "count", "df"),
            Column(lengths.label("sum of squares", "²"), "number", lengths.field("squares", "2")),
            Column(lengths.label("mean square", "²"), "number"), Column("R²", "percent"), Column(field="r2"),
            Column("F", "number", "f"), Column("Z", "number", "z"), Column("p", "p", "p"), Column(field="variances"),
            Column(f"F, {other} variances" if has_other else "", "number", "f_other_variances"),
            Column(f"p, {other} variances" if has_other else "", "p", "p_other_variances"),
            Column("F over" if config.errors else ""), Column(field="error"),
        ),
        rows=rows,
        shown=shown,
        note=f"Type {config.anova_type} sums of squares of Procrustes distances. {_f_sentence(result)} "
        f"{effect_size_sentence(config.effect_size)} R² is the share of the total of its stratum.",
        file="terms.csv",
    )  # fmt: skip


def _term_histograms(result: CompareResult) -> Iterator[Part]:
    for test in result.tests:
        f = np.log10(np.maximum(test.arrangements, 1e-12))
        yield histogram_part(
            f"log10 F of {test.term} among its arrangements", {"arrangements": f}, _BINS, x="log10 F",
            observed=float(f[0]), observed_label="observed",
        )  # fmt: skip


def _effect_table(result: CompareResult) -> ResultTable:
    pairs, lengths = Counter(effect.name for effect in result.effects), LengthFormat(result.cohort.unit)
    several = max(pairs.values(), default=0) > 1
    return ResultTable(
        title="Distances between means",
        level=2,
        note="Distances of least-squares means: one variable changes, the others stay. The Procrustes distance is "
        "summed over vertices, the RMS is a vertex's share."
        f"{' The last column counts all pairs of one variable.' if several else ''}",
        columns=(
            Column(field="number"), Column("variable", field="variable"), Column("from, to"), Column(field="from"),
            Column(field="to"), Column(field="stratum"), lengths.column("Procrustes distance", "distance"),
            lengths.column("RMS", "rms"), Column("F", "number", "f"), Column("Z", "number", "z"),
            Column("p", "p", "p"), Column("p of all pairs" if several else "", "p"), Column(field="p_of_all_pairs"),
        ),
        rows=[
            (number, e.name, e.label, e.low, e.high, e.stratum, e.distance_mm, e.rms_mm, e.f, e.z, e.p,
             e.p_family if pairs[e.name] > 1 else None, e.p_family)
            for number, e in enumerate(result.effects, 1)
        ],
        file="effects.csv",
    )  # fmt: skip


def _angle_tables(result: CompareResult) -> Iterator[ResultTable]:
    if result.angles:
        yield ResultTable(
            title="Angles between changes of shape",
            note="0° is the same change, 90° nothing in common, 180° the opposite; p is that of parallel changes"
            f"{', not known if both are no longer than noise' if any(a.unknown_p for a in result.angles) else ''}.",
            columns=(
                Column("one", field="first"), Column("other", field="second"),
                Column("angle, degrees", "number", "degrees"), Column("p", "p", "p"), Column(field="p_not_known"),
            ),
            rows=[(a.first, a.second, a.degrees, a.p, a.unknown_p or "") for a in result.angles],
            file="angles.csv",
        )  # fmt: skip


def _effect_parts(
    result: CompareResult, effect: ShapeEffect, file: str, arrays: Mapping[str, npt.NDArray[Any]], part: str
) -> Iterator[Part]:
    level = f"{100 * result.config.alpha:g} %"
    yield TextPart(
        title=f"{part}: {effect.label}" if part else effect.label,
        level=2,
        text=_size_sentence(result, effect),
    )
    if effect.map is not None:
        blank = effect.map.blank
        note = _PALE if blank is None else f"{_PALE} {blank_sentence(int(blank.sum()), len(blank))}"
        for title, values, mask in (
            (f"Along the normal, family-wise error {level}", "normal_mm", "normal_family"),
            (f"Along the normal, false discovery rate {level}", "normal_mm", "normal_fdr"),
            (f"In any direction, family-wise error {level}", "length_mm", "length_family"),
            (f"Bumps compared with the variation between shapes, family-wise error {level}", "bump_mm", "bump_family"),
        ):
            if values in arrays:
                yield SurfaceMapPart(
                    title=title,
                    arrays=file,
                    values=values,
                    mask=mask,
                    signed=values != "length_mm",
                    unit=_lengths(result).of_map,
                    note=f"{_EXPLORATORY.capitalize().removesuffix(': ')}. {note}" if effect.exploratory else note,
                )
    yield from shape_change_parts(
        result.cohort, title="From low to high", arrays=file, low_label=effect.low, high_label=effect.high,
        times=float(_exaggeration(result, effect)),
    )  # fmt: skip
    yield from _score_parts(result, effect)


def _size_sentence(result: CompareResult, effect: ShapeEffect) -> str:
    """Return how large a change is: over all vertices, and where it is clearest."""
    size = f"The change is {_lengths(result).text(effect.rms_mm)} (RMS over vertices)."
    if effect.map is None:
        return size
    direction = "" if effect.map.normal_mm is None else ", outwards positive"
    label = " The map is exploratory, since no term of this effect is significant." if effect.exploratory else ""
    return f"{size} It is clearest by {_clearest(result, effect.map)}{direction}.{label}"


def _f_sentence(result: CompareResult) -> str:
    if result.unequal_variances:
        return (
            "F is the squared effect divided by its variance, with a variance for each subject (of two classes the "
            "squared Welch t), compared with sign flips of residuals."
        )
    error = " or of an error term" if result.config.errors else ""
    return f"F is the mean square by that of the residuals{error}, compared with its arrangements (see Methods)."


def _score_parts(result: CompareResult, effect: ShapeEffect) -> Iterator[Part]:
    """Yield the regression scores of a numeric variable: shapes projected on its effect."""
    variable = next((v for v in result.design.variables if v.name == effect.name and not v.levels), None)
    length = float(np.linalg.norm(effect.change))
    if variable is None or length == 0:
        return
    x = np.array(result.design.values[variable.column], dtype=np.float64)
    y = (result.cohort.coefficients - result.mean) @ effect.change / length
    slope = length / (variable.high - variable.low)
    ends = np.array([variable.low, variable.high])
    yield CurvePart(
        title=f"Regression score of {variable.name}",
        note="Each shape along the change of this page (Drake and Klingenberg, Proc. R. Soc. B 275, 2008).",
        x=variable.name,
        y=_lengths(result).label("score"),
        series=(
            Series(x=floats(x), y=floats(y), label="shapes", points=True),
            Series(x=floats(ends), y=floats(slope * (ends - variable.middle)), label="model"),
        ),
    )


def _exaggeration(result: CompareResult, effect: ShapeEffect) -> int:
    cohort = result.cohort
    moved = float(np.linalg.norm((effect.change @ cohort.basis).reshape(-1, 3), axis=1).max()) or 1.0
    size = math.sqrt(float((cohort.reference - cohort.reference.mean(axis=0)).var(axis=0).sum()))
    share = _VECTOR_SHARE if cohort.faces is None and cohort.dimensions == 3 else _LARGEST_SHARE
    return max((factor for factor in _EXAGGERATIONS if factor * moved <= share * size), default=1)


def _arrays(result: CompareResult, effect: ShapeEffect) -> Mapping[str, npt.NDArray[Any]]:
    cohort, level = result.cohort, result.config.alpha
    times = _exaggeration(result, effect)
    half = (times - 1) / 2 * effect.change
    out: dict[str, npt.NDArray[Any]] = {
        "vertices": cohort.vertices(result.mean),
        "faces": _NO_FACES if cohort.faces is None else cohort.faces,
        "low": cohort.surface_vertices(effect.at_low - half),
        "high": cohort.surface_vertices(effect.at_high + half),
    }
    effect_map = effect.map
    if effect_map is None:
        return out
    out |= {"change_mm": effect_map.change_mm, "length_mm": blank_where(effect_map.length_mm, effect_map.blank)}
    if effect_map.weight is not None:
        out["information"] = effect_map.weight
    named = {"length": effect_map.any_way}
    if effect_map.along is not None and effect_map.normal_mm is not None:
        out["normal_mm"] = blank_where(effect_map.normal_mm, effect_map.blank)
        named["normal"] = effect_map.along
    if effect_map.bump is not None and effect_map.bump_mm is not None:
        out["bump_mm"] = blank_where(effect_map.bump_mm, effect_map.blank)
        named["bump"] = effect_map.bump
    for name, test in named.items():
        out |= {f"{name}_f": test.f, f"{name}_p": test.p, f"{name}_p_family": test.p_family, f"{name}_q": test.q}
        masks: dict[str, BoolArray] = {f"{name}_family": test.p_family <= level, f"{name}_fdr": test.q <= level}
        out |= masks
    return out


def _meshes(every: Iterable[tuple[str, CompareResult, ShapeEffect, str]]) -> Iterator[tuple[str, Mesh]]:
    for _, result, effect, file in every:
        if result.cohort.faces is not None:
            for end, shape, name in (("low", effect.at_low, effect.low), ("high", effect.at_high, effect.high)):
                yield f"{file}_{end}.ply", result.cohort.mesh(shape, name)
