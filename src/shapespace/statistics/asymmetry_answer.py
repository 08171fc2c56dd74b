"""What is told of asymmetry: the sentences, tables and pictures of its report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.distortion import factor_to_draw, flip_factor
from shapespace.geometry.normals import rms_size
from shapespace.schemas import (
    Counts,
    HistogramPart,
    MorphPart,
    Part,
    SurfaceMapPart,
    TableColumn,
    TablePart,
    TextPart,
)
from shapespace.statistics.answer import NOTE_OF_REDUCED_MORPH, Answer, Lengths, Rows
from shapespace.statistics.asymmetry import Asymmetry, Effect, first_pattern
from shapespace.statistics.methods_answer import methods_parts
from shapespace.statistics.observed import blank_sentence, blank_where, with_shape_data
from shapespace.types import BoolArray, FloatArray, Mesh, SurfaceLandmarks

_ALPHA = 0.05
_SHOWN = 2
_LISTED = 10
_BINS = 20
_MORPH_SHARE = 0.05
"""Largest displacement in an exaggerated morph, as a share of the size (RMS distance from the centroid)."""
_FILE = "asymmetry.npz"
_FEW_REPEATS = 10


def answer_of_asymmetry(found: Asymmetry) -> Answer:
    """Return the answer to how symmetric the objects of a cohort are."""
    order = np.argsort(-found.scores.mm, kind="stable")
    arrays, pictures = _pictures(found, order)
    cohort = found.cohort
    parts: list[Part] = [
        TextPart(title="What is measured", text=_measured(found)),
        _anova_part(found),
        _histogram(found),
        _listed(found, order),
        *pictures,
        *methods_parts(found.methods),
    ]
    fitted = cohort.fitted
    answer = Answer(
        question="asymmetry",
        title="How symmetric?",
        summary=_summary(found, order),
        parts=tuple(parts),
        tables={"anova.csv": _anova_rows(found), "subjects.csv": _subject_rows(found)},
        arrays={_FILE: arrays},
        meshes=_meshes(found, order),
        notes=(*cohort.notes, *found.sides.notes, *_cautions(found)),
        settings={
            "gauge": cohort.gauge,
            "vertices": len(found.sides),
            "paired": found.sides.paired,
            "subjects": len(found.subjects),
            "shapes": len(cohort),
            "permutations": found.permutations,
            "seed": found.seed,
        },
        model_hashes=() if fitted is None else (fitted.model.content_hash,),
        methods=found.methods,
    )
    return with_shape_data(answer, cohort)


def _summary(found: Asymmetry, order: Any) -> tuple[str, ...]:
    mm, lengths = found.scores.mm, _lengths(found)
    side, both = found.effect("side"), found.effect("individual x side")
    directional = float(np.sqrt((found.directional**2).mean()))
    sentences = [
        f"{len(found.subjects)} subjects lie {lengths.text(float(np.median(mm)))} (median; 5 to 95 %: "
        f"{lengths.number(float(np.percentile(mm, 5)))} to {lengths.text(float(np.percentile(mm, 95)))}) from their "
        f"own mirror images, RMS {_direction(found)}.",
        f"On average the sides differ by {lengths.text(directional)} RMS (directional asymmetry): "
        f"F = {_number(side.f)}, p = {_p(side)}.",
    ]
    if both.p is None and both.f is None:
        sentences.append(
            "No subject was measured twice, so fluctuating asymmetry cannot be distinguished from measurement error, "
            "and the lengths contain both."
        )
    else:
        sentences.append(
            f"Subjects differ in their asymmetry beyond measurement error (fluctuating asymmetry): "
            f"F = {_number(both.f)}, p = {_p(both)}; the error alone would be taken for "
            f"{lengths.text(found.scores.error_mm)} "
            "in one shape, and is subtracted."
        )
    if found.permutations:
        shown = int((found.directional_p <= _ALPHA).sum())
        sentences.append(
            f"Directional asymmetry is shown at {shown} of {len(found.mean)} vertices (family-wise p at most {_ALPHA})."
            if shown
            else f"No vertex shows directional asymmetry (family-wise p above {_ALPHA} everywhere)."
        )
    first = int(order[0])
    sentences.append(f"The most asymmetric is {found.subjects[first]} with {_told(found, first)}.")
    return tuple(sentences)


def _lengths(found: Asymmetry) -> Lengths:
    return Lengths(found.cohort.unit)


def _direction(found: Asymmetry) -> str:
    return "along the normals" if found.normals is not None else "over the points"


def _told(found: Asymmetry, at: int) -> str:
    scores, lengths = found.scores, _lengths(found)
    interval = (
        ""
        if np.isnan(scores.low[at])
        else f" (95 % interval {lengths.number(scores.low[at])} to {lengths.text(scores.high[at])})"
    )
    z = "" if np.isnan(found.z[at]) else f", {found.z[at]:.1f} standard deviations from the mean of the others"
    return f"{lengths.text(scores.mm[at])}{interval}{z}"


def _measured(found: Asymmetry) -> tuple[str, ...]:
    sides = found.sides
    pairs = f"{len(sides)} vertices, {sides.on_the_plane:.0f} of them on the plane" if sides.paired else (
        f"{len(sides)} vertices, each with the place nearest to its mirror image")  # fmt: skip
    return (
        f"Every shape is laid on its own mirror image, all of them together; {pairs}. The mean lies "
        f"{100 * sides.off_share:.2f} % of its size from its mirror image. What a shape differs by from its image is "
        "how far its sides are apart; half of it is the asymmetric part of the shape.",
        "Maps are positive where a side stands further out than the other one.",
    )


def _cautions(found: Asymmetry) -> list[str]:
    notes: list[str] = []
    subjects, repeats = len(found.subjects), int(found.counts.sum()) - len(found.subjects)
    least = 2.0 ** (1 - subjects)
    if least > _ALPHA / 5:
        notes.append(
            f"{subjects} subjects are few: with random signs p cannot fall below {least:.2g} whatever the asymmetry."
        )
    if 0 < repeats < _FEW_REPEATS:
        notes.append(
            f"The measurement error is known from {repeats} repeated shapes only, so intervals are rough; "
            f"{_FEW_REPEATS} are the least to go by."
        )
    fitted = found.cohort.fitted
    if fitted is not None:
        notes.append(
            "Fits hold asymmetry back where their model has little of it; docs/asymmetry.md says by how much. Dense "
            "surfaces (--surfaces dense) of a model built with mirrored shapes lose least."
        )
    return notes


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.3g}"


def _p(effect: Effect) -> str:
    return "not known" if effect.p is None else f"{effect.p:.3g}"


def _anova_part(found: Asymmetry) -> TablePart:
    lengths = _lengths(found)
    names = (lengths.label("SS", "²"), "df", lengths.label("MS", "²"), "F")
    numbers = (TableColumn(name=name, kind="number") for name in names)
    columns = (TableColumn(name="source"), *numbers, TableColumn(name="p", kind="p"))
    rows = tuple((e.source, e.ss, e.df, e.ms, e.f, e.p) for e in found.anova)
    return TablePart(
        title="Procrustes ANOVA", columns=columns, rows=rows, note="df are those of subjects times dimensions."
    )


def _anova_rows(found: Asymmetry) -> Rows:
    field = _lengths(found).field
    return ("source", field("ss", "2"), "df", field("ms", "2"), "f", "p"), [
        (e.source, e.ss, e.df, e.ms, "" if e.f is None else e.f, "" if e.p is None else e.p) for e in found.anova
    ]


def _subject_rows(found: Asymmetry) -> Rows:
    field = _lengths(found).field
    header = (
        "subject", "shapes", *map(field, ("asymmetry", "low", "high", "measured")), "z", "z_low", "z_high",
        "in_reference", *map(field, ("vertices", "vertices_low", "vertices_high")),
    )  # fmt: skip
    s, v = found.scores, found.vertex_scores
    columns = (s.mm, s.low, s.high, s.raw_mm, found.z, found.z_low, found.z_high)
    rows = [
        (name, int(found.counts[k]), *(_cell(c[k]) for c in columns), int(found.in_reference[k]), _cell(v.mm[k]),
         _cell(v.low[k]), _cell(v.high[k]))
        for k, name in enumerate(found.subjects)
    ]  # fmt: skip
    return header, rows


def _cell(value: float) -> object:
    return "" if np.isnan(value) else float(value)


def _histogram(found: Asymmetry) -> HistogramPart:
    edges = np.histogram_bin_edges(found.scores.mm, bins=min(_BINS, max(4, len(found.subjects) // 3)))
    series = [("reference group" if not found.in_reference.all() else "", found.in_reference)]
    if not found.in_reference.all():
        series.append(("others", ~found.in_reference))
    return HistogramPart(
        title="Distances of subjects from their mirror images",
        edges=tuple(edges.tolist()),
        series=tuple(
            Counts(label=label, counts=tuple(np.histogram(found.scores.mm[who], edges)[0].astype(float).tolist()))
            for label, who in series
        ),
        x=f"asymmetry (RMS {_lengths(found).label(_direction(found))})",
    )


def _listed(found: Asymmetry, order: Any) -> TablePart:
    s, lengths = found.scores, _lengths(found)
    columns = (
        TableColumn(name="subject"), TableColumn(name="shapes", kind="count"), lengths.column("asymmetry"),
        lengths.column("low"), lengths.column("high"),
        TableColumn(name="standard deviations", kind="number"),
    )  # fmt: skip
    rows = tuple(
        (found.subjects[k], int(found.counts[k]), *(_known(c[k]) for c in (s.mm, s.low, s.high, found.z)))
        for k in map(int, order[:_LISTED])
    )
    title = "The most asymmetric subjects" if len(order) > _LISTED else "Subjects"
    return TablePart(title=title, columns=columns, rows=rows, note="All of them stand in subjects.csv.")


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _pictures(found: Asymmetry, order: Any) -> tuple[Mapping[str, Any], list[Part]]:
    shown = [int(k) for k in order[:_SHOWN]]
    half = found.difference.mean(axis=0) / 2.0
    arrays: dict[str, Any] = {
        "vertices": found.mean,
        "directional_mm": blank_where(found.directional, found.blank),
        "directional_p": found.directional_p,
        "shown": found.directional_p <= _ALPHA,
        "fluctuating_mm": blank_where(found.fluctuating, found.blank),
        "subjects": np.array(found.subjects),
        "maps_mm": blank_where(found.maps, _unobserved(found)).astype(np.float32),
        "symmetric": found.symmetric.astype(np.float32),
        "asymmetric": (found.difference / 2.0).astype(np.float32),
        "vertex_of_cohort": found.sides.vertices,
    }
    if found.sides.faces is None:
        return arrays, [_points(found)]
    arrays["faces"] = found.sides.faces
    unshown = not found.permutations
    parts: list[Part] = [
        SurfaceMapPart(
            title="Directional asymmetry", level=2, arrays=_FILE, values="directional_mm",
            mask="" if unshown else "shown",
            note="Mean over the subjects, along the normals." + (
                "" if unshown else f" Pale where the family-wise p is above {_ALPHA}.") + _blank_note(found),
        ),
        SurfaceMapPart(
            title="Fluctuating asymmetry", arrays=_FILE, values="fluctuating_mm", signed=False,
            note="Standard deviation over the subjects, about the directional asymmetry, with measurement error."
            + _blank_note(found),
        ),
    ]  # fmt: skip

    faces = found.sides.faces

    def morph(title: str, key: str, middle: FloatArray, part: FloatArray, note: str, low: str, high: str) -> None:
        most = float(np.linalg.norm(part, axis=1).max())
        wanted = max(1.0, _MORPH_SHARE * rms_size(middle) / most) if most > 0 else 1.0
        flips_at = min(flip_factor(middle, way * part, faces) for way in (1.0, -1.0))
        times = factor_to_draw(wanted, flips_at)
        arrays[f"{key}_low"], arrays[f"{key}_high"] = middle - times * part, middle + times * part
        parts.append(
            MorphPart(
                title=title,
                arrays=_FILE,
                low=f"{key}_low",
                high=f"{key}_high",
                low_label=low,
                high_label=high,
                times=times,
                note=note if times >= 1 else f"{note} {NOTE_OF_REDUCED_MORPH}",
            )
        )

    morph("The asymmetric mean", "mean", found.mean, half, "From its mirror image to the mean.", "mirrored", "mean")
    try:
        pattern, share, _ = first_pattern(found)
    except InputError:
        pass
    else:
        note = (
            f"The first pattern, {100 * share:.0f} % of the fluctuating asymmetry; two standard deviations either way."
        )
        morph("What subjects differ by most", "pattern", found.mean, pattern, note, "two one way", "two the other")
    for rank, k in enumerate(shown, 1):
        name = found.subjects[k]
        hidden = _unobserved(found)
        arrays[f"subject_{rank}_mm"] = blank_where(found.maps[k], None if hidden is None else hidden[k])
        parts.append(
            SurfaceMapPart(
                title=f"{name}: the sides",
                level=2 if rank == 1 else None,
                arrays=_FILE,
                values=f"subject_{rank}_mm",
                note=f"{_told(found, k)}.",
            )
        )
    k = shown[0]
    morph(f"{found.subjects[k]} and its mirror image", "subject", found.symmetric[k], found.difference[k] / 2.0,
          "The middle is the symmetric part.", "mirrored", "as it is")  # fmt: skip
    return arrays, parts


def _unobserved(found: Asymmetry) -> BoolArray | None:
    return None if found.observed is None else ~found.observed


def _blank_note(found: Asymmetry) -> str:
    return "" if found.blank is None else f" {blank_sentence(int(found.blank.sum()), len(found.blank))}"


def _points(found: Asymmetry) -> TablePart:
    of = {vertex: name for name, vertex in (found.cohort.landmarks or SurfaceLandmarks()).items()}
    columns = (
        TableColumn(name="point"), _lengths(found).column("directional"), TableColumn(name="p", kind="p"),
        _lengths(found).column("fluctuating"),
    )  # fmt: skip
    rows = tuple(
        (of.get(int(v), str(int(v))), float(found.directional[k]), _known(found.directional_p[k]),
         float(found.fluctuating[k]))
        for k, v in enumerate(found.sides.vertices)
    )  # fmt: skip
    return TablePart(title="Points", columns=columns, rows=rows, note="p is family-wise.")


def _meshes(found: Asymmetry, order: Any) -> dict[str, Mesh]:
    faces, first = found.sides.faces, int(order[0])
    half = found.difference / 2.0
    shapes = {
        "symmetric_mean": found.mean,
        "asymmetric_mean": found.mean + half.mean(axis=0),
        "most_asymmetric": found.symmetric[first] + half[first],
        "most_asymmetric_symmetric_part": found.symmetric[first],
    }
    return {f"{name}.ply": Mesh(vertices, faces, name=name) for name, vertices in shapes.items()}
