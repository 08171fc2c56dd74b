"""Report of scores against a reference: sentences, tables, maps and morphs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.report.analyses.analysis_report import AnalysisReport, LengthFormat, Rows
from shapespace.report.analyses.methods_section import methods_parts
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes, shape_change_parts
from shapespace.report.blocks.wording import counted
from shapespace.schemas import Counts, HistogramPart, Part, SurfaceMapPart, TableColumn, TablePart, TextPart
from shapespace.statistics.score_subjects import SMALL, ScoreResult

# maps, morphs, sentences and bins of the report: what can be looked through; files have all
_MOST_MAPS, _MOST_MORPHS, _MOST_SENTENCES, _BINS = 12, 3, 12, 24
_LIMIT_SD = 4.0  # standard deviations at the ends of the colour scale: beyond 4 all is far outside
_FILE = "score.npz"


def score_report(result: ScoreResult) -> AnalysisReport:
    """Return scores with all that their report shows; subjects are numbered from 1 in the arrays."""
    order = _order(result)
    tables, arrays = _tables(result), _arrays(result, order)
    parts: list[Part] = [
        TextPart(title="The subjects", level=2, text=_method_sentences(result)),
        _table(result),
        _histogram(result),
        *_maps(result, order),
        *_morphs(result, order),
        *methods_parts(result.methods),
    ]
    many = len(result.names) != 1
    report = AnalysisReport(
        question="score",
        title=f"{f'{len(result.names)} subjects' if many else result.names[0]} against a reference of {result.people}",
        summary=tuple(_sentence(result, k) for k in order[:_MOST_SENTENCES]),
        parts=tuple(parts),
        tables=tables,
        arrays={_FILE: arrays},
        notes=result.notes,
        settings={
            "gauge": result.subjects.gauge,
            "modes": result.modes,
            "variance_share": result.variance_share,
            "subject": result.config.subject,
            "draws": result.config.draws,
            "seed": result.config.seed,
        },
        model_hashes=model_hashes(result.subjects),
        methods=result.methods,
    )
    return add_shape_data(report, result.subjects, result.imputations)


def _order(result: ScoreResult) -> list[int]:
    """Return the subjects, those who lie farthest out first."""
    order = np.lexsort((-result.distance, result.farther))
    return sorted(map(int, order), key=lambda k: not result.outside[k])


def _sentence(result: ScoreResult, k: int) -> str:
    near = ", ".join(one.name for one in result.nearest[k])
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
    return f"{sentence} It lies outside what is known: {'; '.join(result.outside[k])}."


def _method_sentences(result: ScoreResult) -> tuple[str, ...]:
    limit = (
        f"Of 95 % of the reference's subjects no vertex lies beyond {result.z_limit:.1f} standard deviations."
        if math.isfinite(result.z_limit)
        else "With fewer than 19 subjects in the reference, the limit of |z| for single vertices cannot be estimated."
    )
    unsure = "" if result.subjects.fitted is None else " and each fit's own uncertainty"
    return (
        f"Distances are Mahalanobis distances in {counted(result.modes, 'mode')} of the reference with "
        f"{100 * result.variance_share:.0f} % of its variance, by its covariance{unsure}.",
        "Percentiles are found by leaving out the reference's subjects in turn, and hold whatever the distribution; p "
        "is by the F distribution of normal shapes, which is too large where the reference is small.",
        limit,
    )


def _table(result: ScoreResult) -> TablePart:
    columns = [
        TableColumn(name="Subject", kind="text"),
        TableColumn(name="Distance (SD)", kind="number"),
        TableColumn(name="Percentile", kind="percent"),
        TableColumn(name="p (F)", kind="p"),
        LengthFormat(result.subjects.unit).column("Left by the modes"),
        TableColumn(name="Its percentile", kind="percent"),
        TableColumn(name="Beyond 2 SD", kind="percent"),
        TableColumn(name="Size (SD)", kind="number"),
        TableColumn(name="Nearest", kind="text"),
        TableColumn(name="Outside", kind="text"),
    ]
    sized = bool(np.isfinite(result.size_z).all())
    rows = [
        (
            name, result.distance[k], 1 - result.farther[k], result.p_value[k], result.rest_mm[k],
            1 - result.rest_farther[k], result.beyond_2[k], result.size_z[k],
            ", ".join(one.name for one in result.nearest[k]), "; ".join(result.outside[k]),
        )
        for k, name in enumerate(result.names)
    ]  # fmt: skip
    if not sized:
        del columns[7]
        rows = [(*row[:7], *row[8:]) for row in rows]
    return TablePart(
        title="Scores", columns=tuple(columns), rows=tuple(rows),
        note="Percentiles: share of the reference's subjects who lie nearer to its mean. On average 4.6 % of the "
        "vertices of a usual shape lie beyond 2 SD.",
    )  # fmt: skip


def _histogram(result: ScoreResult) -> HistogramPart:
    every = np.concatenate([result.reference_distance, result.distance])
    edges = np.linspace(0.0, float(every.max()) * 1.02, _BINS + 1)
    series = [_counts(result.reference_distance, edges, "reference, each by the others")]
    one = len(result.names) == 1
    if not one:
        series.append(_counts(result.distance, edges, "subjects"))
    return HistogramPart(
        title="Distances", edges=tuple(edges.tolist()), series=tuple(series), x="Mahalanobis distance (SD)",
        observed=float(result.distance[0]) if one else None, observed_label=result.names[0] if one else "",
    )  # fmt: skip


def _counts(values: npt.NDArray[Any], edges: npt.NDArray[Any], label: str) -> Counts:
    return Counts(counts=tuple(map(float, np.histogram(values, edges)[0])), label=label)


def _maps(result: ScoreResult, order: list[int]) -> list[Part]:
    parts: list[Part] = [TextPart(title="Maps", level=2, text=_maps_sentence(result, order))]
    for k in order[:_MOST_MAPS]:
        beyond = ""
        if math.isfinite(result.z_limit):
            beyond = (
                f"{int((np.abs(result.z[k]) > result.z_limit).sum()):,} of {int(np.isfinite(result.z[k]).sum()):,} "
                f"vertices lie beyond {result.z_limit:.1f} standard deviations."
            )
        parts.append(
            SurfaceMapPart(
                title=result.names[k], arrays=_FILE, values=f"z_{k + 1}", unit="standard deviations, outwards (+)",
                limit=_LIMIT_SD, note=beyond,
            )
        )  # fmt: skip
    return parts


def _maps_sentence(result: ScoreResult, order: list[int]) -> str:
    rest = len(order) - _MOST_MAPS
    more = f" Maps of {rest} more are in {_FILE}." if rest > 0 else ""
    return (
        "How far each vertex lies from the reference's mean along its normal, in standard deviations of the reference"
        f"{'' if result.subjects.fitted is None else ' and what the fit is unsure of'}.{more}"
    )


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


def _tables(result: ScoreResult) -> dict[str, Rows]:
    field = LengthFormat(result.subjects.unit).field
    head = (
        "subject", "distance_sd", "percentile", "p_left_out", "p_f", field("rest"), "rest_p", field("beyond_model"),
        "beyond_model_p", "vertices_beyond_2sd", field("centroid_size"), "size_sd", "outside", "map",
    )  # fmt: skip
    rows = [
        (
            name,
            result.distance[k],
            result.percentile[k],
            result.farther[k],
            result.p_value[k],
            result.rest_mm[k],
            result.rest_farther[k],
            _finite_or_empty(result.beyond_mm[k]),
            _finite_or_empty(result.beyond_farther[k]),
            result.beyond_2[k],
            _finite_or_empty(result.size_mm[k]),
            _finite_or_empty(result.size_z[k]),
            "; ".join(result.outside[k]),
            f"z_{k + 1}",
        )
        for k, name in enumerate(result.names)
    ]
    near = [
        (name, rank, one.name, one.distance, one.rms_mm)
        for name, references in zip(result.names, result.nearest, strict=True)
        for rank, one in enumerate(references, 1)
    ]
    if result.imputations is not None:
        std = result.imputations.stddev
        head = (*head, "distance_imputation_sd", "percentile_imputation_sd")
        rows = [(*row, std["distance"][k], 100 * std["farther"][k]) for k, row in enumerate(rows)]
    reference = zip(result.reference_names, result.reference_distance, result.reference_rest_mm, strict=True)
    return {
        "scores.csv": (head, rows),
        "nearest.csv": (("subject", "rank", "reference", "distance_sd", field("rms")), near),
        "reference.csv": (("reference", "distance_sd", field("rest")), list(reference)),
    }


def _finite_or_empty(value: float) -> float | str:
    return float(value) if math.isfinite(value) else ""
