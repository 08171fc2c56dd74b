"""Scores of subjects as an answer: sentences, tables, maps and morphs of its report."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.report.analyses.analysis_report import AnalysisReport, LengthFormat, Rows
from shapespace.report.analyses.methods import methods_parts
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import Counts, HistogramPart, MorphPart, Part, SurfaceMapPart, TableColumn, TablePart, TextPart
from shapespace.statistics.score import SMALL, ScoreResult

_MOST_MAPS, _MOST_MORPHS, _MOST_TOLD, _BINS = 12, 3, 12, 24
_LIMIT_SD = 4.0
_FILE = "score.npz"


def score_report(scores: ScoreResult) -> AnalysisReport:
    """Return scores with all that their report shows; subjects are numbered from 1 in the arrays."""
    shown = _shown(scores)
    tables, arrays = _tables(scores), _arrays(scores, shown)
    parts: list[Part] = [
        TextPart(title="The subjects", level=2, text=_how(scores)),
        _table(scores),
        _histogram(scores),
        *_maps(scores, shown),
        *_morphs(scores, shown),
        *methods_parts(scores.methods),
    ]
    many = len(scores.names) != 1
    report = AnalysisReport(
        question="score",
        title=f"{f'{len(scores.names)} subjects' if many else scores.names[0]} against a reference of {scores.people}",
        summary=tuple(_sentence(scores, k) for k in shown[:_MOST_TOLD]),
        parts=tuple(parts),
        tables=tables,
        arrays={_FILE: arrays},
        notes=scores.notes,
        settings={
            "gauge": scores.subjects.gauge,
            "modes": scores.modes,
            "variance_share": scores.variance_share,
            "subject": scores.config.subject,
            "draws": scores.config.draws,
            "seed": scores.config.seed,
        },
        model_hashes=model_hashes(scores.subjects),
        methods=scores.methods,
    )
    return add_shape_data(report, scores.subjects)


def _shown(scores: ScoreResult) -> list[int]:
    """Return the subjects, those who lie farthest out first."""
    order = np.lexsort((-scores.distance, scores.farther))
    return sorted(map(int, order), key=lambda k: not scores.outside[k])


def _sentence(scores: ScoreResult, k: int) -> str:
    near = ", ".join(one.name for one in scores.nearest[k])
    small = " (a small reference)" if scores.people < SMALL else ""
    told = (
        f"{scores.names[k]} lies {scores.distance[k]:.1f} standard deviations from the reference's mean in "
        f"{scores.modes} modes, farther out than {scores.percentile[k]:.0f} % of its {scores.people} subjects{small}; "
        "by "
        f"the F distribution p = {scores.p_value[k]:.3g}. Nearest to it: {near}."
    )
    if not scores.outside[k]:
        return told
    return f"{told} It lies outside what is known: {'; '.join(scores.outside[k])}."


def _how(scores: ScoreResult) -> tuple[str, ...]:
    limit = (
        f"Of 95 % of the reference's subjects no vertex lies beyond {scores.z_limit:.1f} standard deviations."
        if math.isfinite(scores.z_limit)
        else "With fewer than 19 subjects in the reference, the limit of |z| for single vertices cannot be estimated."
    )
    unsure = "" if scores.subjects.fitted is None else " and each fit's own uncertainty"
    return (
        f"Distances are Mahalanobis distances in the {scores.modes} modes of the reference that hold "
        f"{100 * scores.variance_share:.0f} % of its variance, by its covariance{unsure}.",
        "Percentiles are found by leaving out the reference's subjects in turn, and hold whatever the distribution; p "
        "is by the F distribution of normal shapes, which is too large where the reference is small.",
        limit,
    )


def _table(scores: ScoreResult) -> TablePart:
    columns = [
        TableColumn(name="Subject", kind="text"),
        TableColumn(name="Distance (SD)", kind="number"),
        TableColumn(name="Percentile", kind="percent"),
        TableColumn(name="p (F)", kind="p"),
        LengthFormat(scores.subjects.unit).column("Left by the modes"),
        TableColumn(name="Its percentile", kind="percent"),
        TableColumn(name="Beyond 2 SD", kind="percent"),
        TableColumn(name="Size (SD)", kind="number"),
        TableColumn(name="Nearest", kind="text"),
        TableColumn(name="Outside", kind="text"),
    ]
    sized = bool(np.isfinite(scores.size_z).all())
    rows = [
        (
            name, scores.distance[k], 1 - scores.farther[k], scores.p_value[k], scores.rest_mm[k],
            1 - scores.rest_farther[k], scores.beyond_2[k], scores.size_z[k],
            ", ".join(one.name for one in scores.nearest[k]), "; ".join(scores.outside[k]),
        )
        for k, name in enumerate(scores.names)
    ]  # fmt: skip
    if not sized:
        del columns[7]
        rows = [(*row[:7], *row[8:]) for row in rows]
    return TablePart(
        title="Scores", columns=tuple(columns), rows=tuple(rows),
        note="Percentiles: share of the reference's subjects who lie nearer to its mean. On average 4.6 % of the "
        "vertices of a usual shape lie beyond 2 SD.",
    )  # fmt: skip


def _histogram(scores: ScoreResult) -> HistogramPart:
    every = np.concatenate([scores.reference_distance, scores.distance])
    edges = np.linspace(0.0, float(every.max()) * 1.02, _BINS + 1)
    series = [_counts(scores.reference_distance, edges, "reference, each by the others")]
    one = len(scores.names) == 1
    if not one:
        series.append(_counts(scores.distance, edges, "subjects"))
    return HistogramPart(
        title="Distances", edges=tuple(edges.tolist()), series=tuple(series), x="Mahalanobis distance (SD)",
        observed=float(scores.distance[0]) if one else None, observed_label=scores.names[0] if one else "",
    )  # fmt: skip


def _counts(values: npt.NDArray[Any], edges: npt.NDArray[Any], label: str) -> Counts:
    return Counts(counts=tuple(map(float, np.histogram(values, edges)[0])), label=label)


def _maps(scores: ScoreResult, shown: list[int]) -> list[Part]:
    parts: list[Part] = [TextPart(title="Maps", level=2, text=_of_maps(scores, shown))]
    for k in shown[:_MOST_MAPS]:
        beyond = ""
        if math.isfinite(scores.z_limit):
            share = float((np.abs(scores.z[k]) > scores.z_limit).sum() / max(np.isfinite(scores.z[k]).sum(), 1))
            beyond = f"{100 * share:.1f} % of the vertices lie beyond {scores.z_limit:.1f} standard deviations."
        parts.append(
            SurfaceMapPart(
                title=scores.names[k], arrays=_FILE, values=f"z_{k + 1}", unit="standard deviations, outwards (+)",
                limit=_LIMIT_SD, note=beyond,
            )
        )  # fmt: skip
    return parts


def _of_maps(scores: ScoreResult, shown: list[int]) -> str:
    rest = len(shown) - _MOST_MAPS
    more = f" Maps of {rest} more are in {_FILE}." if rest > 0 else ""
    return (
        "How far each vertex lies from the reference's mean along its normal, in standard deviations of the reference"
        f"{'' if scores.subjects.fitted is None else ' and what the fit is unsure of'}.{more}"
    )


def _morphs(scores: ScoreResult, shown: list[int]) -> list[Part]:
    if scores.mean.faces is None:
        return []
    return [
        MorphPart(
            title=f"From the reference's mean to {scores.names[k]}", arrays=_FILE, low="vertices",
            high=f"shape_{k + 1}", low_label="the reference's mean", high_label=scores.names[k],
        )
        for k in shown[:_MOST_MORPHS]
    ]  # fmt: skip


def _arrays(scores: ScoreResult, shown: list[int]) -> dict[str, npt.NDArray[Any]]:
    faces = scores.mean.faces
    arrays: dict[str, npt.NDArray[Any]] = {
        "vertices": scores.mean.vertices,
        "faces": np.zeros((0, 3), dtype=np.int32) if faces is None else faces,
    }
    for k in range(len(scores.names)):
        arrays[f"z_{k + 1}"] = scores.z[k].astype(np.float32)
    for k in shown[:_MOST_MORPHS]:
        arrays[f"shape_{k + 1}"] = scores.subjects.vertices(k)
    return arrays


def _tables(scores: ScoreResult) -> dict[str, Rows]:
    field = LengthFormat(scores.subjects.unit).field
    head = (
        "subject", "distance_sd", "percentile", "p_left_out", "p_f", field("rest"), "rest_p", field("beyond_model"),
        "beyond_model_p", "vertices_beyond_2sd", field("centroid_size"), "size_sd", "outside", "map",
    )  # fmt: skip
    rows = [
        (
            name, scores.distance[k], scores.percentile[k], scores.farther[k], scores.p_value[k], scores.rest_mm[k],
            scores.rest_farther[k], _known(scores.beyond_mm[k]), _known(scores.beyond_farther[k]), scores.beyond_2[k],
            _known(scores.size_mm[k]), _known(scores.size_z[k]), "; ".join(scores.outside[k]), f"z_{k + 1}",
        )
        for k, name in enumerate(scores.names)
    ]  # fmt: skip
    near = [
        (name, rank, one.name, one.distance, one.rms_mm)
        for name, found in zip(scores.names, scores.nearest, strict=True)
        for rank, one in enumerate(found, 1)
    ]
    reference = zip(scores.reference_names, scores.reference_distance, scores.reference_rest_mm, strict=True)
    return {
        "scores.csv": (head, rows),
        "nearest.csv": (("subject", "rank", "reference", "distance_sd", field("rms")), near),
        "reference.csv": (("reference", "distance_sd", field("rest")), list(reference)),
    }


def _known(value: float) -> float | str:
    return float(value) if math.isfinite(value) else ""
