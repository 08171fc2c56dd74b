"""Report of asymmetry: sentences, ANOVA, tables, maps and morphs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.normals import factor_to_draw, flip_factor, rms_size
from shapespace.report.analyses.analysis_report import (
    MOST_LANDMARKS,
    REDUCED_MORPH_NOTE,
    AnalysisReport,
    Column,
    LengthFormat,
    ResultTable,
    blank_sentence,
    cohort_report,
    histogram_part,
)
from shapespace.schemas import DeformationPart, HistogramPart, MorphPart, Part, SurfaceMapPart, TextPart
from shapespace.statistics.asymmetry import AnovaRow, AsymmetryResult, first_pattern
from shapespace.statistics.observation_weights import blank_where
from shapespace.types import BoolArray, FloatArray, Mesh, SurfaceLandmarks

_ALPHA = 0.05  # significance level of the summary, the usual one
_MOST_MAPS, _MOST_ROWS, _BINS = 2, 10, 20  # maps, rows and bins of the report: what fits one screen each
_MORPH_SHARE = 0.05
"""Largest displacement in an exaggerated morph, as a share of the size (RMS distance from the centroid)."""
_VECTOR_SHARE = 0.2
"""Largest half vector in a figure of landmarks, as a share of the size: longer than the dot where it starts."""
_FILE = "asymmetry.npz"
_FEWEST_REPEATS = 10  # repeated scans; with fewer the measurement error is known to no better than 22 %


def asymmetry_report(result: AsymmetryResult) -> AnalysisReport:
    """Return the report on the asymmetry of the objects of a cohort."""
    order = np.argsort(-result.scores.mm, kind="stable")
    arrays, pictures = _maps_and_morphs(result, order)
    cohort = result.cohort
    anova_note = "df are those of the observations."
    size_anova = [_anova_table(result, "ANOVA of centroid size", result.size_anova, "size_anova.csv", anova_note)]
    if result.degrees_of_freedom == "klingenberg":
        anova_note = "df are those of subjects times dimensions."
    return cohort_report(
        "asymmetry",
        "How symmetric?",
        [
            TextPart(title="What is measured", text=_method_sentences(result)),
            _anova_table(result, "Procrustes ANOVA", result.anova, "anova.csv", anova_note),
            *(size_anova if result.size_anova else ()),
            _histogram(result),
            _subject_table(result, order),
            *pictures,
        ],
        cohort,
        summary=tuple(_summary(result, order)),
        arrays={_FILE: arrays},
        meshes=_meshes(result, order),
        notes=(*cohort.notes, *result.sides.notes, *_limitation_notes(result)),
        settings={
            "gauge": cohort.gauge,
            "vertices": len(result.sides),
            "paired": result.sides.paired,
            "subjects": len(result.subjects),
            "shapes": len(cohort),
            "permutations": result.permutations,
            "seed": result.seed,
            "degrees_of_freedom": result.degrees_of_freedom,
            "sides": result.sides.classes,
        },
        methods=result.methods,
        imputations=result.imputations,
    )


def _summary(result: AsymmetryResult, order: Any) -> Iterator[str]:
    mm, lengths = result.scores.mm, _lengths(result)
    side, interaction = result.effect("side"), result.effect("individual x side")
    directional = float(np.sqrt((result.directional**2).mean()))
    apart = (
        f"the sides of {len(result.subjects)} subjects lie {{}} apart"
        if result.sides.classes
        else f"{len(result.subjects)} subjects lie {{}} from their own mirror images"
    ).format(
        f"{lengths.text(float(np.median(mm)))} (median; 5 to 95 %: {lengths.number(float(np.percentile(mm, 5)))} to "
        f"{lengths.text(float(np.percentile(mm, 95)))})"
    )
    yield f"{apart[0].upper()}{apart[1:]}, RMS {_direction(result)}."
    yield (
        f"On average the sides differ by {lengths.text(directional)} RMS (directional asymmetry): "
        f"F = {_number_text(side.f)}, p = {_number_text(side.p)}."
    )
    if interaction.p is None and interaction.f is None:
        yield (
            "No subject was measured twice, so fluctuating asymmetry cannot be distinguished from measurement error, "
            "and the lengths contain both."
        )
    else:
        yield (
            f"Subjects differ in their asymmetry beyond measurement error (fluctuating asymmetry): "
            f"F = {_number_text(interaction.f)}, p = {_number_text(interaction.p)}; the error alone would be taken for "
            f"{lengths.text(result.scores.error_mm)} "
            "in one shape, and is subtracted."
        )
    if result.permutations:
        n_significant = int((result.directional_p <= _ALPHA).sum())
        yield (
            f"Directional asymmetry is shown at {n_significant} of {len(result.mean)} vertices (family-wise p at most "
            f"{_ALPHA})."
            if n_significant
            else f"No vertex shows directional asymmetry (family-wise p above {_ALPHA} everywhere)."
        )
    first = int(order[0])
    yield f"The most asymmetric is {result.subjects[first]} with {_score_text(result, first)}."


def _lengths(result: AsymmetryResult) -> LengthFormat:
    return LengthFormat(result.cohort.unit)


def _direction(result: AsymmetryResult) -> str:
    return "along the normals" if result.normals is not None else "over the vertices"


def _score_text(result: AsymmetryResult, subject: int) -> str:
    scores, lengths = result.scores, _lengths(result)
    interval = (
        ""
        if np.isnan(scores.low[subject])
        else f" (95 % interval {lengths.number(scores.low[subject])} to {lengths.text(scores.high[subject])})"
    )
    z = (
        ""
        if np.isnan(result.z[subject])
        else f", {result.z[subject]:.1f} standard deviations from the mean of the others"
    )
    return f"{lengths.text(scores.mm[subject])}{interval}{z}"


def _method_sentences(result: AsymmetryResult) -> tuple[str, ...]:
    sides = result.sides
    pairs = f"{len(sides)} vertices, {sides.on_the_plane:.0f} of them on the plane" if sides.paired else (
        f"{len(sides)} vertices, each with the place nearest to its mirror image")  # fmt: skip
    measured, maps = (
        f"All shapes and their mirror images are aligned together; {pairs}. The mean lies "
        f"{100 * sides.off_share:.2f} % of its size from its mirror image. The difference between a shape and its "
        "mirror image is the difference between its sides; half of it is the asymmetric part of the shape.",
        "Maps are positive where a side lies further out than the opposite side.",
    )
    if sides.classes:
        first, second = sides.classes
        measured, maps = (
            f"Each shape of the side {first} is compared with one of the side {second} of the same subject. The means "
            f"of the two sides lie {100 * sides.off_share:.2f} % of their size from each other.",
            f"Maps are positive where the side {first} lies further out.",
        )
    return (measured,) if sides.faces is None else (measured, maps)


def _limitation_notes(result: AsymmetryResult) -> Iterator[str]:
    subjects, repeats = len(result.subjects), int(result.counts.sum()) - len(result.subjects)
    least = 2.0 ** (1 - subjects)
    if least > _ALPHA / 5:
        yield (
            f"{subjects} subjects are few: with random signs p cannot fall below {least:.2g} whatever the asymmetry."
        )
    if 0 < repeats < _FEWEST_REPEATS:
        yield (
            f"The measurement error is known from {repeats} repeated shapes only, so intervals are rough; at least "
            f"{_FEWEST_REPEATS} are needed."
        )
    if result.cohort.fitted is not None:
        yield (
            "Fits underestimate asymmetry if their model contains little asymmetry; docs/asymmetry.md states by how "
            "much. Dense surfaces (fit --dense) of a model built with mirrored shapes underestimate it least."
        )


def _number_text(value: float | None) -> str:
    return "not known" if value is None else f"{value:.3g}"


def _anova_table(result: AsymmetryResult, title: str, anova: Sequence[AnovaRow], file: str, note: str) -> ResultTable:
    lengths = _lengths(result)
    return ResultTable(
        title=title,
        columns=(
            Column("source", field="source"),
            Column(lengths.label("SS", "²"), "number", lengths.field("ss", "2")),
            Column("df", "number"), Column(field="df"),
            Column(lengths.label("MS", "²"), "number", lengths.field("ms", "2")),
            Column("R²", "number", "r2"), Column("F", "number", "f"), Column("Z", "number", "z"), Column("p", "p", "p"),
        ),
        rows=[(e.source, e.ss, float(e.df), e.df, e.ms, e.r2, e.f, e.z, e.p) for e in anova],
        note=note,
        file=file,
    )  # fmt: skip


def _histogram(result: AsymmetryResult) -> HistogramPart:
    mm, inside = result.scores.mm, result.in_reference
    values = {"": mm} if inside.all() else {"reference group": mm[inside], "others": mm[~inside]}
    return histogram_part(
        "Distances of subjects from their mirror images", values, min(_BINS, max(4, len(result.subjects) // 3)),
        x=f"asymmetry (RMS {_lengths(result).label(_direction(result))})",
    )  # fmt: skip


def _subject_table(result: AsymmetryResult, order: Any) -> ResultTable:
    s, v, lengths = result.scores, result.vertex_scores, _lengths(result)
    numbers = (s.mm, s.low, s.high, s.raw_mm, result.z, result.z_low, result.z_high)
    return ResultTable(
        title="The most asymmetric subjects" if len(order) > _MOST_ROWS else "Subjects",
        columns=(
            Column("subject", field="subject"), Column("shapes", "count", "shapes"),
            *(lengths.column(name, name) for name in ("asymmetry", "low", "high")), lengths.column(field="measured"),
            Column("standard deviations", "number", "z"), Column(field="z_low"), Column(field="z_high"),
            Column(field="in_reference"),
            *(lengths.column(field=name) for name in ("vertices", "vertices_low", "vertices_high")),
        ),
        rows=[
            (name, int(result.counts[k]), *(own[k] for own in numbers), int(result.in_reference[k]), v.mm[k], v.low[k],
             v.high[k])
            for k, name in enumerate(result.subjects)
        ],
        note="All subjects are in subjects.csv.",
        file="subjects.csv",
        shown=order[:_MOST_ROWS],
    )  # fmt: skip


def _vectors(mean: FloatArray, half_difference: FloatArray, arrays: dict[str, Any]) -> tuple[Part, ...]:
    """Return the vectors from the mirrored mean to the mean of landmarks, whose ends are added to `arrays`."""
    most = float(np.linalg.norm(half_difference, axis=1).max())
    if most == 0 or len(mean) > MOST_LANDMARKS:
        return ()
    times = factor_to_draw(max(1.0, _VECTOR_SHARE * rms_size(mean) / most), math.inf)
    arrays |= {"mean_low": mean - times * half_difference, "mean_high": mean + times * half_difference}
    return (DeformationPart(title="The asymmetric mean", arrays=_FILE, low="mean_low", high="mean_high",
                            low_label="the mirrored mean", high_label="the mean", times=times),)  # fmt: skip


def _maps_and_morphs(result: AsymmetryResult, order: Any) -> tuple[Mapping[str, Any], list[Part | ResultTable]]:
    subjects = [int(k) for k in order[:_MOST_MAPS]]
    half_difference = result.difference.mean(axis=0) / 2.0
    arrays: dict[str, Any] = {
        "vertices": result.mean,
        "directional_mm": blank_where(result.directional, result.blank),
        "directional_p": result.directional_p,
        "shown": result.directional_p <= _ALPHA,
        "fluctuating_mm": blank_where(result.fluctuating, result.blank),
        "subjects": np.array(result.subjects),
        "maps_mm": blank_where(result.maps, _unobserved(result)).astype(np.float32),
        "symmetric": result.symmetric.astype(np.float32),
        "asymmetric": (result.difference / 2.0).astype(np.float32),
        "vertex_of_cohort": result.sides.vertices,
    }
    if result.sides.faces is None:
        return arrays, [_point_table(result), *_vectors(result.mean, half_difference, arrays)]
    arrays["faces"] = result.sides.faces
    untested = not result.permutations
    parts: list[Part | ResultTable] = [
        SurfaceMapPart(
            title="Directional asymmetry", level=2, arrays=_FILE, values="directional_mm",
            mask="" if untested else "shown",
            note="Mean over the subjects, along the normals." + (
                "" if untested else f" Pale where the family-wise p is above {_ALPHA}.") + _blank_note(result),
        ),
        SurfaceMapPart(
            title="Fluctuating asymmetry", arrays=_FILE, values="fluctuating_mm", signed=False,
            note="Standard deviation over the subjects, about the directional asymmetry, with measurement error."
            + _blank_note(result),
        ),
    ]  # fmt: skip

    faces = result.sides.faces

    def add_morph(title: str, key: str, middle: FloatArray, part: FloatArray, note: str, low: str, high: str) -> None:
        most = float(np.linalg.norm(part, axis=1).max())
        wanted = max(1.0, _MORPH_SHARE * rms_size(middle) / most) if most > 0 else 1.0
        flips_at = min(flip_factor(middle, sign * part, faces) for sign in (1.0, -1.0))
        times = factor_to_draw(wanted, flips_at)
        arrays[f"{key}_low"], arrays[f"{key}_high"] = middle - times * part, middle + times * part
        parts.append(MorphPart(
            title=title, arrays=_FILE, low=f"{key}_low", high=f"{key}_high", low_label=low, high_label=high,
            times=times, note=note if times >= 1 else f"{note} {REDUCED_MORPH_NOTE}",
        ))  # fmt: skip

    note = "From its mirror image to the mean."
    add_morph("The asymmetric mean", "mean", result.mean, half_difference, note, low="mirrored", high="mean")
    try:
        pattern, share, _ = first_pattern(result)
    except InputError:
        pass
    else:
        note = (
            f"The first pattern, {100 * share:.0f} % of the fluctuating asymmetry; two standard deviations either way."
        )
        add_morph(
            "Main pattern of fluctuating asymmetry",
            "pattern",
            result.mean,
            pattern,
            note,
            "two one way",
            "two the other",
        )
    for rank, k in enumerate(subjects, 1):
        name = result.subjects[k]
        hidden = _unobserved(result)
        arrays[f"subject_{rank}_mm"] = blank_where(result.maps[k], None if hidden is None else hidden[k])
        parts.append(SurfaceMapPart(
            title=f"{name}: the sides", level=2 if rank == 1 else None, arrays=_FILE, values=f"subject_{rank}_mm",
            note=f"{_score_text(result, k)}.",
        ))  # fmt: skip
    k = subjects[0]
    add_morph(f"{result.subjects[k]} and its mirror image", "subject", result.symmetric[k], result.difference[k] / 2.0,
              "The middle is the symmetric part.", low="mirrored", high="as it is")  # fmt: skip
    return arrays, parts


def _unobserved(result: AsymmetryResult) -> BoolArray | None:
    return None if result.observed is None else ~result.observed


def _blank_note(result: AsymmetryResult) -> str:
    return "" if result.blank is None else f" {blank_sentence(int(result.blank.sum()), len(result.blank))}"


def _point_table(result: AsymmetryResult) -> ResultTable:
    names = {vertex: name for name, vertex in (result.cohort.landmarks or SurfaceLandmarks()).items()}
    lengths, vertices = _lengths(result), map(int, result.sides.vertices)
    columns = (
        Column("vertex"),
        lengths.column("directional"),
        Column("p", "p"),
        lengths.column("fluctuating"),
    )
    rows = zip(
        [names.get(v, str(v)) for v in vertices], result.directional, result.directional_p, result.fluctuating,
        strict=True,
    )  # fmt: skip
    return ResultTable(title="Vertices", columns=columns, rows=list(rows), note="p is family-wise.")


def _meshes(result: AsymmetryResult, order: Any) -> dict[str, Mesh]:
    faces, first = result.sides.faces, int(order[0])
    half = result.difference / 2.0
    shapes = {
        "symmetric_mean": result.mean,
        "asymmetric_mean": result.mean + half.mean(axis=0),
        "most_asymmetric": result.symmetric[first] + half[first],
        "most_asymmetric_symmetric_part": result.symmetric[first],
    }
    return {f"{name}.ply": Mesh(vertices, faces, name=name) for name, vertices in shapes.items()}
