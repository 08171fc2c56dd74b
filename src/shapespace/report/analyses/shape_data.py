"""Source of the shapes of an analysis and share of estimated vertices: notes, settings and a table of its report."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from msgspec import Struct, structs
from scipy.spatial.distance import pdist

from shapespace.cohort.cohort import SUBJECT, Cohort
from shapespace.report.analyses.analysis_report import AnalysisReport, Column, Table, floats
from shapespace.report.analyses.methods_section import methods_parts
from shapespace.schemas import (
    CurvePart,
    DeformationPart,
    HistogramPart,
    Methods,
    MorphPart,
    Part,
    Series,
    TableColumn,
    TablePart,
    TestScheme,
    TextPart,
)
from shapespace.statistics.methods import methods_of
from shapespace.statistics.multiple_imputation import Imputations
from shapespace.statistics.observation_weights import LEAST_INFORMATION
from shapespace.types import FloatArray

_FILE = "observed.csv"
_MOST_ROWS = 10  # rows that fit one screen; files have all
_VERTEX_WORDS = re.compile(r"(?<![A-Za-z])[Vv]ert(?:ices|ex)(?![A-Za-z])")  # in sentences and names of columns
_LANDMARK_WORDS = {"vertices": "landmarks", "vertex": "landmark", "Vertices": "Landmarks", "Vertex": "Landmark"}
_WORDED: Mapping[type[Struct], tuple[str, ...]] = {
    Part: ("title", "note"),
    TextPart: ("text",),
    HistogramPart: ("x",),
    TablePart: ("columns",),
    TableColumn: ("name",),
    Methods: ("corrected_over", "assumptions", "tests"),
    TestScheme: ("tested",),
}
"""Fields with words on vertices."""
MOST_LANDMARKS = 500
"""Points of a shape without triangles up to which they are drawn as landmarks: more cover each other."""
_MOST_PAIRS = 1000  # dots of a figure: more cover each other
_IMPUTATION = (
    "Rubin D. B. (1987) Multiple Imputation for Nonresponse in Surveys. Wiley, New York.",
    "Barnard J., Rubin D. B. (1999) Small-sample degrees of freedom with multiple imputation. Biometrika 86, 948-955.",
    "Licht C. (2010) New Methods for Generating Significance Levels from Multiply-Imputed Data. Dissertation, "
    "University of Bamberg.",
)
_EQUAL = 1e-9  # relative difference of sizes that is rounding
_MOST_SHAPES = 300  # of which all pairs take less than a second


def shape_change_parts(cohort: Cohort, **known: Any) -> tuple[MorphPart | DeformationPart, ...]:
    """Return the part that draws two shapes of a cohort: a morph of surfaces, a deformation grid of planar landmarks,
    vectors of others; nothing for point clouds.

    Args:
        cohort: of the shapes.
        **known: fields of both kinds of parts, such as `arrays`, `low`, `high`, `low_label`, `high_label`, `times`.
    """
    if cohort.faces is not None:
        return (MorphPart(**known),)
    if cohort.n_vertices > MOST_LANDMARKS:
        return ()
    return (DeformationPart(**known, drawing="grid" if cohort.dimensions == 2 else "vectors"),)


def scree_part(eigenvalues: FloatArray, *, axis: str = "principal component") -> CurvePart:
    """Return the scree plot: the share of the variance of each axis.

    Args:
        eigenvalues: (K,) variances along the axes, in their order.
        axis: what the axes are.
    """
    shares = 100 * eigenvalues / eigenvalues.sum()
    numbers = tuple(map(float, range(1, len(shares) + 1)))
    return CurvePart(
        title="Scree plot", x=axis, y="share of the variance (%)", series=(Series(x=numbers, y=floats(shares)),)
    )


def tangent_parts(cohort: Cohort) -> tuple[CurvePart, ...]:
    """Return the check of the tangent space of a cohort in the gauge `shape`; nothing in the gauge `form`."""
    if cohort.gauge != "shape" or len(cohort) < 3:
        return ()
    rows = np.unique(np.linspace(0, len(cohort) - 1, min(len(cohort), _MOST_SHAPES)).round().astype(int)).tolist()
    shapes = np.stack([cohort.vertices(row) for row in rows])
    return (tangent_part(shapes, projected=cohort.source.kind == "landmarks"),)


def tangent_part(coords: FloatArray, *, projected: bool = False) -> CurvePart:
    """Return a check of the tangent space: Euclidean against Procrustes distances of all pairs of shapes.

    Args:
        coords: (N, L, D) aligned coordinates as they are analysed, in the gauge `shape`; planar ones may have z = 0.
        projected: whether they were projected orthogonally to the tangent space at their mean.
    """
    shapes = coords if np.ptp(coords[:, :, -1]) > 0 else coords[:, :, :2]
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    flat = shapes.reshape(len(shapes), -1)
    sizes, mean = np.linalg.norm(flat, axis=1), flat.mean(axis=0)
    # Shapes in a tangent plane differ in size, and touch the sphere at their mean.
    of_one_size = np.ptp(sizes) < _EQUAL * sizes.mean()
    flat = flat / (sizes.mean() if of_one_size else np.linalg.norm(mean))
    if projected and not of_one_size:
        pole = mean / np.linalg.norm(mean)
        part = flat - np.outer(flat @ pole, pole)
        shapes = (part + np.outer(np.sqrt(1 - (part**2).sum(axis=1)), pole)).reshape(shapes.shape)
    shapes = shapes / np.linalg.norm(shapes, axis=(1, 2), keepdims=True)
    first, second = np.triu_indices(len(coords), 1)
    n, L, D = shapes.shape
    rows = shapes.transpose(0, 2, 1).reshape(n * D, L)
    products = (rows @ rows.T).reshape(n, D, n, D)[first, :, second]
    singular = np.linalg.svd(products, compute_uv=False)
    singular[:, -1] *= np.where(np.linalg.det(products) < 0, -1.0, 1.0)
    procrustes, euclidean = np.arccos(np.minimum(singular.sum(axis=1), 1.0)), pdist(flat)
    slope = float(euclidean @ procrustes / (procrustes @ procrustes))
    r = float(euclidean @ procrustes / np.sqrt((euclidean @ euclidean) * (procrustes @ procrustes)))
    order = procrustes.argsort()
    order = order[np.unique(np.linspace(0, len(order) - 1, _MOST_PAIRS).round().astype(np.intp))]
    ends = np.array([0.0, float(procrustes.max())])
    return CurvePart(
        title="Tangent space",
        x="Procrustes distance",
        y="distance in the tangent space",
        note=f"Slope through the origin {slope:.6f}, uncentred correlation {r:.6f}; both are 1 where distances in the "
        "tangent space represent those of shapes.",
        series=(
            Series(x=floats(procrustes[order]), y=floats(euclidean[order]), label="pairs of shapes", points=True),
            Series(x=floats(ends), y=floats(ends), label="equal distances"),
        ),
    )


def blank_sentence(count: int, total: int) -> str:
    """Return a sentence on how many vertices of a map are blank; empty for none."""
    if not count:
        return ""
    return (
        f"{count} of {total} vertices are grey: the shapes that observe them carry less than "
        f"{100 * LEAST_INFORMATION:.0f} % of the information."
    )


def shape_notes(cohort: Cohort) -> tuple[str, ...]:
    """Return sentences on truncated and estimated shapes."""
    notes: list[str] = []
    if cohort.source.modes is not None:
        notes.append(f"The shapes are {cohort.source}; variation outside these modes is not analysed.")
    share = cohort.estimated_share
    if share.any():
        worst = int(share.argmax())
        points, method = "vertices", _method_of_estimates(cohort)
        if cohort.source.kind == "landmarks":
            points, method = "landmarks", ""
        notes.append(
            f"{_percent(float(share.mean()))} of the analysed {points} are estimates, not observations{method}: in "
            f"{int((share > 0).sum())} of {len(cohort)} shapes, most in {cohort.names[worst]} "
            f"({_percent(float(share[worst]))})."
        )
    if cohort.analysed is not None:
        count = int((~cohort.analysed).sum())
        notes.append(
            f"{count} of {cohort.n_vertices} vertices, which fewer than half of the shapes observe, are not analysed."
        )
    return tuple(notes)


def _method_of_estimates(cohort: Cohort) -> str:
    completed = sum(own is not None for own in cohort.samples)
    if completed == int((cohort.estimated_share > 0).sum()):
        return " (completed by a shape model, with samples)"
    own = " (conditional mean by PCA with missing data"
    return f"{own}; {completed} shapes are completed by a shape model, with samples)" if completed else f"{own})"


def _imputation_sentence(cohort: Cohort, imputations: Imputations | None) -> str:
    """Return whether an analysis contains the uncertainty of completed shapes; empty without their samples."""
    count = sum(own is not None for own in cohort.samples)
    shapes = f"{count} completed shape{'' if count == 1 else 's'}"
    if imputations is None:
        return f"The samples of {shapes} are not used; the results do not contain their uncertainty." if count else ""
    missing = ", ".join(f"{_percent(own)} ({name})" for name, own in imputations.missing_information.items())
    return (
        f"The results combine {imputations.count} imputations of {shapes} by Rubin's rules, p values by their normal "
        f"quantiles.{f' Fraction of missing information: {missing}.' if missing else ''}"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"


def shape_settings(cohort: Cohort) -> dict[str, Any]:
    """Return the entries of analysis.json on the source of the shapes and on estimated vertices."""
    source, share = cohort.source, cohort.estimated_share
    out: dict[str, Any] = {"shape_source": source.kind}
    if source.modes is not None:
        out |= {"shape_modes": source.modes, "shape_explained_variance_ratio": source.explained_variance_ratio}
    if share.any() or cohort.analysed is not None:
        worst = int(share.argmax())
        out |= {
            "estimated_share": float(share.mean()),
            "estimated_share_largest": float(share[worst]),
            "estimated_share_largest_shape": cohort.names[worst],
            "vertices_not_analysed": 0 if cohort.analysed is None else int((~cohort.analysed).sum()),
        }
    return out


def _landmark_words(value: Any) -> Any:
    """Return a text, part or record, or a tuple of these, that calls the vertices of shapes landmarks."""
    if isinstance(value, tuple):
        return tuple(map(_landmark_words, cast(tuple[Any, ...], value)))
    if isinstance(value, Struct):
        names = (name for kind, own in _WORDED.items() if isinstance(value, kind) for name in own)
        return structs.replace(value, **{name: _landmark_words(getattr(value, name)) for name in names})
    return _VERTEX_WORDS.sub(lambda found: _LANDMARK_WORDS[found[0]], value or "")


def _in_landmarks(report: AnalysisReport) -> AnalysisReport:
    """Return a report whose sentences, labels and columns of files call the vertices of shapes landmarks."""
    words = {name: _landmark_words(getattr(report, name)) for name in ("summary", "notes", "parts")}
    methods = None if report.methods is None else _landmark_words(report.methods)
    tables = {name: (_landmark_words(tuple(header)), rows) for name, (header, rows) in report.tables.items()}
    return replace(report, **words, methods=methods, tables=tables)


def cohort_report(
    question: str,
    title: str,
    content: Iterable[Part | Table],
    cohort: Cohort,
    *,
    methods: Methods | None,
    model_hashes: tuple[str, ...] | None = None,
    imputations: Imputations | None = None,
    state_methods: bool = True,
    **known: Any,
) -> AnalysisReport:
    """Return the report of an analysis of a cohort, with the methods and the data on its shapes.

    Args:
        question: the command.
        title: title of the report.
        content: parts and tables; the methods and the shares of estimated vertices follow them.
        cohort: the shapes.
        methods: sample sizes, tests and assumptions; None for those of `add_shape_data`.
        model_hashes: content hashes of models; None for that of the fits.
        imputations: those that the analysis combines.
        state_methods: whether the methods are parts of the page.
        **known: further fields of the report; `notes` are those of the cohort by default.
    """
    if model_hashes is None:
        model_hashes = () if cohort.fitted is None else (cohort.fitted.model.content_hash,)
    stated = methods_parts(methods) if methods is not None and state_methods else ()
    fields = {"notes": cohort.notes, "methods": methods, "model_hashes": model_hashes, **known}
    return add_shape_data(AnalysisReport.of(question, title, (*content, *stated), **fields), cohort, imputations)


def add_shape_data(report: AnalysisReport, cohort: Cohort, imputations: Imputations | None = None) -> AnalysisReport:
    """Return a report with its methods, the source of its shapes and the share of estimated vertices of each shape.

    Args:
        report: of an analysis.
        cohort: its shapes.
        imputations: those that the analysis combines; None for an analysis of the shapes as they are.
    """
    sentence, methods = _imputation_sentence(cohort, imputations), report.methods
    if methods is None and len(cohort) > 1:
        # Shapes whose subject is not known are of different subjects.
        cells = cohort.table.columns.get(report.settings.get("subject") or SUBJECT, cohort.names)
        known = {cell or (name,) for cell, name in zip(cells, cohort.names, strict=True)}
        methods = methods_of(cohort, len(known))
    stated = (sentence,) if sentence and methods is not None else ()
    if methods is not None:
        methods = structs.replace(methods, assumptions=(*methods.assumptions, *stated))
    combined: dict[str, Any] = {}
    if imputations is not None:
        combined = {"imputations": imputations.count, "missing_information": dict(imputations.missing_information)}
    tables = _estimate_tables(cohort)
    report = replace(
        report,
        summary=(*report.summary[:1], *cohort.cautions, *report.summary[1:]),
        notes=(*report.notes, *shape_notes(cohort), *stated),
        settings={**report.settings, **shape_settings(cohort), **combined},
        methods=methods,
        citations=(*report.citations, *(_IMPUTATION if combined else ())),
        orientation=cohort.orientation,
        parts=(*report.parts, *(one.part for one in tables)),
        tables={**report.tables, **{one.file: one.file_rows for one in tables}},
    )
    return _in_landmarks(report) if cohort.source.kind == "landmarks" else report


def _estimate_tables(cohort: Cohort) -> tuple[Table, ...]:
    """Return the share of estimated vertices of each shape; nothing if all are observed."""
    share, title = cohort.estimated_share, "Estimated vertices"
    note = (
        "Share of the vertices of a shape that its scan does not show, largest first; they are estimated by the "
        "conditional mean of a PCA model with missing data, without the table."
    )
    if cohort.source.kind == "landmarks":
        title, note = "Estimated landmarks", "Share of the landmarks of a specimen that are estimates, largest first."
    order = sorted(range(len(share)), key=lambda k: (-share[k], k))
    table = Table(
        title=title,
        columns=(Column("shape", field="shape"), Column("estimated", "percent", "estimated_share")),
        rows=[(cohort.names[k], float(share[k])) for k in order if share[k] > 0],
        shown=range(_MOST_ROWS),
        note=f"{note} All of them are in {_FILE}.",
        file=_FILE,
    )
    return (table,) if share.any() else ()
