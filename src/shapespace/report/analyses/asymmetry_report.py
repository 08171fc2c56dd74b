"""Report of asymmetry: sentences, ANOVA, tables, maps and morphs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.distortion import factor_to_draw, flip_factor
from shapespace.geometry.normals import rms_size
from shapespace.report.analyses.analysis_report import REDUCED_MORPH_NOTE, AnalysisReport, LengthFormat, Rows
from shapespace.report.analyses.methods_section import methods_parts
from shapespace.report.analyses.shape_data import MOST_LANDMARKS, add_shape_data, blank_sentence, model_hashes
from shapespace.schemas import (
    Counts,
    DeformationPart,
    HistogramPart,
    MorphPart,
    Part,
    SurfaceMapPart,
    TableColumn,
    TablePart,
    TextPart,
)
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
    """Return the answer to how symmetric the objects of a cohort are."""
    order = np.argsort(-result.scores.mm, kind="stable")
    arrays, pictures = _maps_and_morphs(result, order)
    cohort = result.cohort
    parts: list[Part] = [
        TextPart(title="What is measured", text=_method_sentences(result)),
        *_anova_parts(result),
        _histogram(result),
        _most_asymmetric(result, order),
        *pictures,
        *methods_parts(result.methods),
    ]
    report = AnalysisReport(
        question="asymmetry",
        title="How symmetric?",
        summary=_summary(result, order),
        parts=tuple(parts),
        tables={
            "anova.csv": _anova_rows(result, result.anova),
            "subjects.csv": _subject_rows(result),
            **({"size_anova.csv": _anova_rows(result, result.size_anova)} if result.size_anova else {}),
        },
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
        model_hashes=model_hashes(cohort),
        methods=result.methods,
    )
    return add_shape_data(report, cohort, result.imputations)


def _summary(result: AsymmetryResult, order: Any) -> tuple[str, ...]:
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
    sentences = [
        f"{apart[0].upper()}{apart[1:]}, RMS {_direction(result)}.",
        f"On average the sides differ by {lengths.text(directional)} RMS (directional asymmetry): "
        f"F = {_number_text(side.f)}, p = {_p_text(side)}.",
    ]
    if interaction.p is None and interaction.f is None:
        sentences.append(
            "No subject was measured twice, so fluctuating asymmetry cannot be distinguished from measurement error, "
            "and the lengths contain both."
        )
    else:
        sentences.append(
            f"Subjects differ in their asymmetry beyond measurement error (fluctuating asymmetry): "
            f"F = {_number_text(interaction.f)}, p = {_p_text(interaction)}; the error alone would be taken for "
            f"{lengths.text(result.scores.error_mm)} "
            "in one shape, and is subtracted."
        )
    if result.permutations:
        n_significant = int((result.directional_p <= _ALPHA).sum())
        sentences.append(
            f"Directional asymmetry is shown at {n_significant} of {len(result.mean)} vertices (family-wise p at most "
            f"{_ALPHA})."
            if n_significant
            else f"No vertex shows directional asymmetry (family-wise p above {_ALPHA} everywhere)."
        )
    first = int(order[0])
    sentences.append(f"The most asymmetric is {result.subjects[first]} with {_score_text(result, first)}.")
    return tuple(sentences)


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
        f"Every shape is laid on its own mirror image, all of them together; {pairs}. The mean lies "
        f"{100 * sides.off_share:.2f} % of its size from its mirror image. What a shape differs by from its image is "
        "how far its sides are apart; half of it is the asymmetric part of the shape.",
        "Maps are positive where a side stands further out than the other one.",
    )
    if sides.classes:
        first, second = sides.classes
        measured, maps = (
            f"Each shape of the side {first} is compared with one of the side {second} of the same subject. The means "
            f"of the two sides lie {100 * sides.off_share:.2f} % of their size from each other.",
            f"Maps are positive where the side {first} stands further out.",
        )
    return (measured,) if sides.faces is None else (measured, maps)


def _limitation_notes(result: AsymmetryResult) -> list[str]:
    notes: list[str] = []
    subjects, repeats = len(result.subjects), int(result.counts.sum()) - len(result.subjects)
    least = 2.0 ** (1 - subjects)
    if least > _ALPHA / 5:
        notes.append(
            f"{subjects} subjects are few: with random signs p cannot fall below {least:.2g} whatever the asymmetry."
        )
    if 0 < repeats < _FEWEST_REPEATS:
        notes.append(
            f"The measurement error is known from {repeats} repeated shapes only, so intervals are rough; "
            f"{_FEWEST_REPEATS} are the least to go by."
        )
    fitted = result.cohort.fitted
    if fitted is not None:
        notes.append(
            "Fits hold asymmetry back where their model has little of it; docs/asymmetry.md says by how much. Dense "
            "surfaces (--set surfaces=dense) of a model built with mirrored shapes lose least."
        )
    return notes


def _number_text(value: float | None) -> str:
    return "not known" if value is None else f"{value:.3g}"


def _p_text(effect: AnovaRow) -> str:
    return "not known" if effect.p is None else f"{effect.p:.3g}"


def _anova_parts(result: AsymmetryResult) -> tuple[TablePart, ...]:
    lengths = _lengths(result)
    names = (lengths.label("SS", "²"), "df", lengths.label("MS", "²"), "R²", "F", "Z")
    columns = ("source", *names, "p")
    note = "df are those of subjects times dimensions."
    observed = "df are those of the observations."
    parts = [("Procrustes ANOVA", result.anova, note if result.degrees_of_freedom == "klingenberg" else observed)]
    if result.size_anova:
        parts.append(("ANOVA of centroid size", result.size_anova, observed))
    return tuple(
        TablePart.of(
            title, columns, [(e.source, e.ss, float(e.df), e.ms, e.r2, e.f, e.z, e.p) for e in anova], note=text
        )
        for title, anova, text in parts
    )


def _anova_rows(result: AsymmetryResult, anova: Sequence[AnovaRow]) -> Rows:
    field = _lengths(result).field
    return ("source", field("ss", "2"), "df", field("ms", "2"), "r2", "f", "z", "p"), [
        (e.source, e.ss, e.df, e.ms, e.r2, *("" if value is None else value for value in (e.f, e.z, e.p)))
        for e in anova
    ]


def _subject_rows(result: AsymmetryResult) -> Rows:
    field = _lengths(result).field
    header = (
        "subject", "shapes", *map(field, ("asymmetry", "low", "high", "measured")), "z", "z_low", "z_high",
        "in_reference", *map(field, ("vertices", "vertices_low", "vertices_high")),
    )  # fmt: skip
    s, v = result.scores, result.vertex_scores
    columns = (s.mm, s.low, s.high, s.raw_mm, result.z, result.z_low, result.z_high)
    rows = [
        (name, int(result.counts[k]), *(_cell(c[k]) for c in columns), int(result.in_reference[k]), _cell(v.mm[k]),
         _cell(v.low[k]), _cell(v.high[k]))
        for k, name in enumerate(result.subjects)
    ]  # fmt: skip
    return header, rows


def _cell(value: float) -> object:
    return "" if np.isnan(value) else float(value)


def _histogram(result: AsymmetryResult) -> HistogramPart:
    edges = np.histogram_bin_edges(result.scores.mm, bins=min(_BINS, max(4, len(result.subjects) // 3)))
    series = [("reference group" if not result.in_reference.all() else "", result.in_reference)]
    if not result.in_reference.all():
        series.append(("others", ~result.in_reference))
    return HistogramPart(
        title="Distances of subjects from their mirror images",
        edges=tuple(edges.tolist()),
        series=tuple(
            Counts(label=label, counts=tuple(np.histogram(result.scores.mm[members], edges)[0].astype(float).tolist()))
            for label, members in series
        ),
        x=f"asymmetry (RMS {_lengths(result).label(_direction(result))})",
    )


def _most_asymmetric(result: AsymmetryResult, order: Any) -> TablePart:
    s, lengths = result.scores, _lengths(result)
    columns = (
        TableColumn(name="subject"), TableColumn(name="shapes", kind="count"), lengths.column("asymmetry"),
        lengths.column("low"), lengths.column("high"),
        TableColumn(name="standard deviations", kind="number"),
    )  # fmt: skip
    rows = tuple(
        (result.subjects[k], int(result.counts[k]), *(_finite_or_none(c[k]) for c in (s.mm, s.low, s.high, result.z)))
        for k in map(int, order[:_MOST_ROWS])
    )
    title = "The most asymmetric subjects" if len(order) > _MOST_ROWS else "Subjects"
    return TablePart(title=title, columns=columns, rows=rows, note="All of them stand in subjects.csv.")


def _finite_or_none(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _vectors(mean: FloatArray, half_difference: FloatArray, arrays: dict[str, Any]) -> tuple[Part, ...]:
    """Return the vectors from the mirrored mean to the mean of landmarks, whose ends are added to `arrays`."""
    most = float(np.linalg.norm(half_difference, axis=1).max())
    if most == 0 or len(mean) > MOST_LANDMARKS:
        return ()
    times = factor_to_draw(max(1.0, _VECTOR_SHARE * rms_size(mean) / most), math.inf)
    arrays |= {"mean_low": mean - times * half_difference, "mean_high": mean + times * half_difference}
    return (DeformationPart(title="The asymmetric mean", arrays=_FILE, low="mean_low", high="mean_high",
                            low_label="the mirrored mean", high_label="the mean", times=times),)  # fmt: skip


def _maps_and_morphs(result: AsymmetryResult, order: Any) -> tuple[Mapping[str, Any], list[Part]]:
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
    parts: list[Part] = [
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
        add_morph("What subjects differ by most", "pattern", result.mean, pattern, note, "two one way", "two the other")
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


def _point_table(result: AsymmetryResult) -> TablePart:
    of = {vertex: name for name, vertex in (result.cohort.landmarks or SurfaceLandmarks()).items()}
    columns = (
        TableColumn(name="vertex"), _lengths(result).column("directional"), TableColumn(name="p", kind="p"),
        _lengths(result).column("fluctuating"),
    )  # fmt: skip
    rows = tuple(
        (of.get(int(v), str(int(v))), float(result.directional[k]), _finite_or_none(result.directional_p[k]),
         float(result.fluctuating[k]))
        for k, v in enumerate(result.sides.vertices)
    )  # fmt: skip
    return TablePart(title="Vertices", columns=columns, rows=rows, note="p is family-wise.")


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
