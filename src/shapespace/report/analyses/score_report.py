"""Report of scores against a reference: sentences, tables, maps and morphs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.report.analyses.analysis_report import (
    AnalysisReport,
    Column,
    LengthFormat,
    ResultTable,
    cohort_report,
    histogram_part,
    shape_change_parts,
)
from shapespace.report.blocks.wording import counted
from shapespace.schemas import HistogramPart, Part, SurfaceMapPart, TextPart
from shapespace.statistics.score_subjects import SMALL, ScoreResult

# maps, morphs, sentences and bins of the report: what can be looked through; files have all
_MOST_MAPS, _MOST_MORPHS, _MOST_SENTENCES, _BINS = 12, 3, 12, 24
_LIMIT_SD = 4.0  # standard deviations at the ends of the colour scale: beyond 4 all is far outside
_FILE = "score.npz"


def score_report(result: ScoreResult) -> AnalysisReport:
    """Return scores with all that their report shows; subjects are numbered from 1 in the arrays."""
    # Those outside the known range are first, then those who lie farthest out.
    order = sorted(map(int, np.lexsort((-result.distance, result.farther))), key=lambda k: not result.outside[k])
    content: list[Part | ResultTable] = [
        TextPart(title="The subjects", level=2, text=_method_sentences(result)),
        _score_table(result),
        *_file_tables(result),
        _histogram(result),
        *_maps(result, order),
        *_morphs(result, order),
    ]
    many = len(result.names) != 1
    return cohort_report(
        "score",
        f"{f'{len(result.names)} subjects' if many else result.names[0]} against a reference of {result.people}",
        content,
        result.subjects,
        summary=tuple(_sentence(result, k) for k in order[:_MOST_SENTENCES]),
        arrays={_FILE: _arrays(result, order)},
        notes=result.notes,
        settings={
            "gauge": result.subjects.gauge,
            "modes": result.modes,
            "variance_share": result.variance_share,
            "subject": result.config.subject,
            "draws": result.config.draws,
            "seed": result.config.seed,
        },
        methods=result.methods,
        imputations=result.imputations,
    )


def _sentence(result: ScoreResult, k: int) -> str:
    near = ", ".join(neighbour.name for neighbour in result.nearest[k])
    small = " (a small reference)" if result.people < SMALL else ""
    sentence = (
        f"{result.names[k]} lies {result.distance[k]:.1f} standard deviations from the reference's mean in "
        f"{counted(result.modes, 'mode')}, farther out than {result.percentile[k]:.0f} % of its {result.people} "
        f"subjects{small}; by the F distribution p = {result.p_value[k]:.3g}. Nearest to it: {near}."
    )
    if result.imputations is not None:
        distance, farther = (result.imputations.stddev[name][k] for name in ("distance", "farther"))
        sentence += (
            f" The imputations vary by {distance:.2f} in the distance and by {100 * farther:.1f} % in the share (SD)."
        )
    if not result.outside[k]:
        return sentence
    return f"{sentence} Its score may not describe its shape: {'; '.join(result.outside[k])}."


def _method_sentences(result: ScoreResult) -> tuple[str, ...]:
    limit = (
        f"In 95 % of the reference's subjects no vertex lies beyond {result.z_limit:.1f} standard deviations."
        if math.isfinite(result.z_limit)
        else "With fewer than 19 subjects in the reference, the limit of |z| for single vertices cannot be estimated."
    )
    unsure = "" if result.subjects.fitted is None else " and each fit's own uncertainty"
    return (
        f"Distances are Mahalanobis distances in {counted(result.modes, 'mode')} of the reference with "
        f"{100 * result.variance_share:.0f} % of its variance, by its covariance{unsure}.",
        "Percentiles are leave-one-out percentiles of the reference's subjects, valid for any distribution; p "
        "is by the F distribution of normal shapes, which is too large where the reference is small.",
        limit,
    )


def _score_table(result: ScoreResult) -> ResultTable:
    lengths, sized = LengthFormat(result.subjects.unit), bool(np.isfinite(result.size_z).all())
    columns = [
        Column("Subject", field="subject"), Column("Distance (SD)", "number", "distance_sd"),
        Column("Percentile", "percent"), Column(field="percentile"), Column(field="p_left_out"),
        Column("p (F)", "p", "p_f"), lengths.column("Left by the modes", "rest"), Column("Its percentile", "percent"),
        Column(field="rest_p"), lengths.column(field="beyond_model"), Column(field="beyond_model_p"),
        Column("Beyond 2 SD", "percent", "vertices_beyond_2sd"), lengths.column(field="centroid_size"),
        Column("Size (SD)" if sized else "", "number", "size_sd"), Column("Nearest"),
        Column("Outside", field="outside"), Column(field="map"),
    ]  # fmt: skip
    rows = [
        (
            name, result.distance[k], 1 - result.farther[k], result.percentile[k], result.farther[k],
            result.p_value[k], result.rest_mm[k], 1 - result.rest_farther[k], result.rest_farther[k],
            result.beyond_mm[k], result.beyond_farther[k], result.beyond_2[k], result.size_mm[k], result.size_z[k],
            ", ".join(neighbour.name for neighbour in result.nearest[k]), "; ".join(result.outside[k]), f"z_{k + 1}",
        )
        for k, name in enumerate(result.names)
    ]  # fmt: skip
    if result.imputations is not None:
        std = result.imputations.stddev
        columns += [Column(field="distance_imputation_sd"), Column(field="percentile_imputation_sd")]
        rows = [(*row, std["distance"][k], 100 * std["farther"][k]) for k, row in enumerate(rows)]
    return ResultTable(
        title="Scores", columns=columns, rows=rows, file="scores.csv",
        note="Percentiles: share of the reference's subjects who lie nearer to its mean. On average 4.6 % of the "
        "vertices of a usual shape lie beyond 2 SD.",
    )  # fmt: skip


def _file_tables(result: ScoreResult) -> tuple[ResultTable, ResultTable]:
    """Return the tables of the nearest subjects and of the reference, which are files alone."""
    field = LengthFormat(result.subjects.unit).field
    near = [
        (name, rank, neighbour.name, neighbour.distance, neighbour.rms_mm)
        for name, references in zip(result.names, result.nearest, strict=True)
        for rank, neighbour in enumerate(references, 1)
    ]
    reference = zip(result.reference_names, result.reference_distance, result.reference_rest_mm, strict=True)
    return (
        ResultTable.of_fields("nearest.csv", ("subject", "rank", "reference", "distance_sd", field("rms")), near),
        ResultTable.of_fields("reference.csv", ("reference", "distance_sd", field("rest")), list(reference)),
    )


def _histogram(result: ScoreResult) -> HistogramPart:
    every = np.concatenate([result.reference_distance, result.distance])
    is_single = len(result.names) == 1
    values = {"reference, each by the others": result.reference_distance}
    return histogram_part(
        "Distances", values if is_single else {**values, "subjects": result.distance},
        np.linspace(0.0, float(every.max()) * 1.02, _BINS + 1), x="Mahalanobis distance (SD)",
        observed=float(result.distance[0]) if is_single else None, observed_label=result.names[0] if is_single else "",
    )  # fmt: skip


def _maps(result: ScoreResult, order: list[int]) -> Iterator[Part]:
    rest = len(order) - _MOST_MAPS
    text = (
        "Distance of each vertex from the reference's mean along its normal, in standard deviations of the reference"
        f"{'' if result.subjects.fitted is None else ' and the uncertainty of the fit'}."
        f"{f' Maps of {rest} more are in {_FILE}.' if rest > 0 else ''}"
    )
    yield TextPart(title="Maps", level=2, text=text)
    for k in order[:_MOST_MAPS]:
        beyond = ""
        if math.isfinite(result.z_limit):
            beyond = (
                f"{int((np.abs(result.z[k]) > result.z_limit).sum()):,} of {int(np.isfinite(result.z[k]).sum()):,} "
                f"vertices lie beyond {result.z_limit:.1f} standard deviations."
            )
        yield SurfaceMapPart(
            title=result.names[k], arrays=_FILE, values=f"z_{k + 1}", unit="standard deviations, outwards (+)",
            limit=_LIMIT_SD, note=beyond,
        )  # fmt: skip


def _morphs(result: ScoreResult, order: list[int]) -> list[Part]:
    return [
        part
        for k in order[:_MOST_MORPHS]
        for part in shape_change_parts(
            result.subjects, title=f"From the reference's mean to {result.names[k]}", arrays=_FILE, low="vertices",
            high=f"shape_{k + 1}", low_label="the reference's mean", high_label=result.names[k],
        )
    ]  # fmt: skip


def _arrays(result: ScoreResult, order: list[int]) -> dict[str, npt.NDArray[Any]]:
    faces = result.mean.faces
    arrays: dict[str, npt.NDArray[Any]] = {
        "vertices": result.mean.vertices,
        "faces": np.zeros((0, 3), dtype=np.int32) if faces is None else faces,
    }
    for k in range(len(result.names)):
        arrays[f"z_{k + 1}"] = result.z[k].astype(np.float32)
        if result.imputations is not None:
            arrays[f"z_imputation_sd_{k + 1}"] = result.imputations.stddev["z"][k].astype(np.float32)
    for k in order[:_MOST_MORPHS]:
        arrays[f"shape_{k + 1}"] = result.subjects.vertices(k)
    return arrays
