"""Views of results in a notebook: title, sentences, tables, and a picture where there is a surface; and their plots."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.result import FitResult
from shapespace.model.model_quality import Curve, ModelQuality
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.analyses.result_report import analysis_report
from shapespace.report.blocks.blocks import Block, Cell, Head, Notes, Table, Text
from shapespace.report.blocks.wording import listed, mm, percent, training_text
from shapespace.report.inputs.saved_fits import Folder, StagedFit
from shapespace.report.pages.page import Page, template
from shapespace.report.pages.study_page import ANALYSIS, TITLES, StudyParts
from shapespace.report.pages.write_html import require_report_extra
from shapespace.report.render.thumbnails import Still, fit_strip, mesh_still
from shapespace.schemas import SurfaceReview, TablePart, read_part, to_json
from shapespace.store.corresponding import review_summary
from shapespace.types import Mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from shapespace.cohort.cohort import Cohort
    from shapespace.correspondence.correspondence_result import Correspondence
    from shapespace.geometry.volume_surface import VolumeSurface
    from shapespace.model.additive import AdditiveModel
    from shapespace.statistics.methods import AnalysisResult
    from shapespace.statistics.predictor import Predictions, Predictor
    from shapespace.store.results import Results

Drawn: TypeAlias = tuple[Still, str]
"""A picture, and its caption."""
_SHARES = (0.9, 0.95, 0.98)  # of the variance; usual choices for the number of modes
_MODES_SHOWN = 2  # layout: rows
_PANEL = (220, 290)  # layout: pixels
_MOST_COEFFICIENTS = 5  # layout: entries
_FIT_FIGURES = {
    "distances": "signed_maps",
    "stages": "stages_figure",
    "overlay": "overlay_figure",
    "histograms": "distance_histograms",
    "coefficients": "coefficients_figure",
    "history": "history_figure",
    "regions": "regions_figure",
}
_CURVES = (
    "compactness",
    "generalisation",
    "generalisation_vertices",
    "specificity",
    "specificity_vertices",
    "reconstruction",
    "reconstruction_vertices",
)


def plot_model(model: ShapeModel, kind: str, **options: Any) -> Figure:
    """Draw a figure for `ShapeModel.plot`."""
    return _draw({"modes": "modes_figure", "mean": "mean_figure", "spectrum": "spectrum_figure"}, kind, model, options)


def plot_fit(result: FitResult, kind: str, **options: Any) -> Figure:
    """Draw a figure for `FitResult.plot`."""
    return _draw(_FIT_FIGURES, kind, StagedFit.of(result.model, result), options)


def plot_quality(quality: ModelQuality, **options: Any) -> Figure:
    """Draw a figure for `ModelQuality.plot`."""
    require_report_extra()
    curves = {name: _numbers(curve) for name in _CURVES if (curve := getattr(quality, name)) is not None}
    if quality.by_shapes is not None:
        sizes = _numbers(quality.by_shapes)
        curves["generalisation_by_shapes"] = {"shapes": sizes.pop("modes"), **sizes}
    return figures.quality_figure(curves, **options)


def _numbers(curve: Curve) -> dict[str, list[float]]:
    return {
        name: values.tolist()
        for name, values in {"modes": curve.counts, "mean": curve.mean, "low": curve.low, "high": curve.high}.items()
    }


def _draw(names: Mapping[str, str], kind: str, shown: object, options: Mapping[str, Any]) -> Figure:
    """Return the figure of a kind, by its name in `shapespace.report.figures`."""
    require_report_extra()
    if kind not in names:
        raise InputError(f"There is no plot {kind!r}; choose one of {', '.join(names)}.")
    return getattr(figures, names[kind])(shown, **options)


def html_of_model(model: ShapeModel) -> str:
    """Return a model for a notebook: its first modes, training data, and licence."""
    counts = model.part_counts
    rows = [
        ("Made of", training_text(model)),
        ("Surface", f"{model.n_vertices:,} vertices, {0 if model.faces is None else len(model.faces):,} triangles"),
        *([("Parts", listed([f"{name} {count:,}" for name, count in counts.items()]))] if counts else []),
        ("Modes", f"{model.n_modes}, with {100 * float(model.cumulative_variance[-1]):.1f} % of the variance"),
        (
            "Variance",
            listed(
                [f"{percent(share)} in {n}" for share in _SHARES if (n := model.modes_for_variance(share)) is not None]
            )
            or "below 90 % in the modes kept",
        ),
        ("Size", "divided out (gauge shape)" if model.gauge == "shape" else "kept in the modes (gauge form)"),
        ("Landmarks", listed(list(model.landmarks)) or "none"),
        ("Provenance", model.provenance or "not stated"),
        ("Licence", model.licence or "not stated"),
    ]

    def draw() -> Drawn:
        return figures.encode_webp(
            plot_model(model, "modes", modes=_MODES_SHOWN)
        ), "The first modes; model.plot() draws more."

    return notebook_html(model, "Shape model", [], rows, draw)


def html_of_fit(result: FitResult) -> str:
    """Return the notebook view of a fit: its distances from the scan, its status, and its largest coefficients."""
    overlap = result.overlap_distances
    largest = sorted(range(len(result.z)), key=lambda k: -abs(result.z[k]))[:_MOST_COEFFICIENTS]
    seen, covered = percent(overlap.model_seen_share), percent(overlap.scan_covered_share)
    rows = [
        ("Model to scan", f"{mm(overlap.model_to_scan.mean)} mean, over the {seen} that the scan shows"),
        ("Scan to model", f"{mm(overlap.scan_to_model.mean)} mean, over the {covered} that the model covers"),
        ("Coefficients", f"{len(result.z)}; " + ", ".join(f"z{k + 1} {result.z[k]:+.1f}" for k in largest)),
        ("Scale", f"{result.T_scan_model.scale:.4g} ({result.mm_per_scan_unit:g} mm in the scan's unit)"),
        ("Method", f"{result.method}, started from {result.start}, {sum(result.seconds.values()):.2f} s"),
    ]
    if result.evidence is not None:
        rows.insert(2, ("Expected error", f"{mm(result.evidence.expected_error_mm)} of its vertices"))
    rows += [("Note", note) for note in result.notes]

    def draw() -> Drawn:
        fit = StagedFit.of(result.model, result)
        colours = "blue inside, red outside" if fit.scan.faces is not None else "dark is far"
        return fit_strip(
            fit, fit.scale_mm, _PANEL
        ), f"The scan; scan and fitted model; distances up to {mm(fit.scale_mm)}: {colours}, grey not shown."

    return notebook_html(result, result.scan_name, [f"{result.status}: {result.reason}"], rows, draw)


def html_of_quality(quality: ModelQuality) -> str:
    """Return a quality for a notebook: its curves, and each measure with all modes."""
    rows = [("Shapes", f"{quality.shapes}, held out in {quality.folds} folds")] if quality.shapes else []
    for name in _CURVES:
        curve = getattr(quality, name)
        if curve is not None:
            value, low, high = curve.mean[-1], curve.low[-1], curve.high[-1]
            value_text = percent(value) if name == "compactness" else f"{mm(value)} ({low:.3g} to {high:.3g})"
            rows.append(
                (name.replace("_vertices", " (vertices)").capitalize(), f"{value_text} with {curve.counts[-1]} modes")
            )

    def draw() -> Drawn:
        return figures.encode_webp(plot_quality(quality)), "Bands are 95 % intervals."

    return notebook_html(quality, "Quality of a shape space", quality.sentences(), rows, draw)


def notebook_html(
    of: object,
    title: str,
    sentences: Sequence[str],
    rows: Sequence[tuple[str, str]],
    draw: Callable[[], Drawn] | None = None,
    *,
    blocks: Sequence[Block] = (),
) -> str:
    """Return the notebook view of an object; its repr if the extra `report` is not installed.

    Args:
        of: object of the view.
        title: heading of the view.
        sentences: sentences below the heading.
        rows: names and values.
        draw: function that returns a picture with its caption; None for no picture.
        blocks: blocks of a report, below the rest.
    """
    try:
        require_report_extra()
    except ShapespaceError as error:
        return f"<pre>{escape(repr(of))}\n{escape(str(error))}</pre>"
    picture, size, caption = "", (0, 0), ""
    try:
        if draw is not None:
            (content, size), caption = draw()
            picture = base64.b64encode(content).decode()
    except ShapespaceError as error:
        sentences = [*sentences, f"No picture: {error}"]
    return template("notebook.html").render(
        title=title, sentences=sentences, rows=rows, picture=picture, size=size, caption=caption,
        body=blocks,
    )  # fmt: skip


MOST_TABLES, MOST_ROWS = 2, 12
"""Largest number of tables of an analysis, and of rows of a table, in a notebook; reports have all."""

_MOST_NOTES = 6  # layout: lines
_MOST_COLUMNS = 8  # layout: columns


def html_of_analysis(result: AnalysisResult) -> str:
    """Return the notebook view of an analysis: its summary and its first tables."""
    try:
        report = analysis_report(result)
    except ShapespaceError as error:
        return notebook_html(result, type(result).__name__, [f"Nothing can be reported: {error}"], [])
    # Tables need neither files nor pictures; the folder is never read.
    parts = StudyParts(Page(), Folder(Path()), ANALYSIS)
    parts_as_kept = [read_part(to_json(part), ANALYSIS.file, ANALYSIS.again) for part in report.parts]
    tables = [part for part in parts_as_kept if isinstance(part, TablePart)]
    blocks: list[Block] = []
    for part in tables[:MOST_TABLES]:
        for block in parts.blocks(part, part.title or TITLES["table"]):
            blocks += _shorten(block, len(block.rows)) if isinstance(block, Table) else [block]
    blocks.append(Notes([*report.notes[:_MOST_NOTES], "result.save(folder) writes tables, maps and report."]))
    return notebook_html(result, report.title, report.summary, [], blocks=blocks)


def html_of_cohort(cohort: Cohort) -> str:
    """Return the notebook view of a cohort: its size and source, and the first rows of its table."""
    rows = [
        ("Shapes", f"{len(cohort):,} {'surfaces' if cohort.fitted is None else 'fits'}"),
        ("Surface", f"{cohort.n_vertices:,} vertices, {0 if cohort.faces is None else len(cohort.faces):,} triangles"),
        ("Coefficients", f"{len(cohort.basis)} of each shape"),
        ("Size", "divided out (gauge shape)" if cohort.gauge == "shape" else "kept (gauge form)"),
        ("Landmarks", listed(list(cohort.landmarks or ())) or "none"),
    ]
    columns = list(cohort.table.columns)[:_MOST_COLUMNS]
    cells = [
        [name, *(cohort.table.columns[column][row] for column in columns)]
        for row, name in enumerate(cohort.names[:MOST_ROWS])
    ]
    blocks: list[Block] = _table(["shape", *columns], cells, "The first shapes", len(cohort))
    if len(cohort.table.columns) > len(columns):
        blocks.append(Text(f"{len(cohort.table.columns) - len(columns)} more columns are omitted."))
    return notebook_html(cohort, "Cohort", [], rows, blocks=[*blocks, Notes(cohort.notes[:_MOST_NOTES])])


def html_of_results(results: Results) -> str:
    """Return the notebook view of a folder of results: number of fits by status, and the first fits."""
    rows = [("Folder", str(results.folder)), ("Fits", f"{len(results):,}")]
    rows += [(status.capitalize(), f"{count:,}") for status, count in results.counts().items()]
    cells: list[list[str]] = []
    for name in results.names()[:MOST_ROWS]:
        try:
            record = results.fit(name)
            cells.append([name, record.status, record.reason])
        except ShapespaceError as error:
            cells.append([name, "unreadable", str(error)])
    blocks = _table(["fit", "status", "reason"], cells, "The first fits", len(results))
    return notebook_html(results, "Results", [], rows, blocks=[*blocks, Notes(results.problems[:_MOST_NOTES])])


def html_of_correspondence(correspondence: Correspondence) -> str:
    """Return the notebook view of scans in correspondence: the mean shape, and the coverage of each scan."""
    included = [scan for scan in correspondence.scans if not scan.reason]
    rows = [
        ("Scans", f"{len(included)} of {len(correspondence.scans)} in correspondence"),
        ("Review", review_summary(SurfaceReview.of(scan.review_codes for scan in included)) or "no problems detected"),
        ("Surface", f"{len(correspondence.template.vertices):,} vertices"),
        ("Rounds", f"{len(correspondence.moved)}; movement in the last {percent(correspondence.moved[-1])} of the size")
        if correspondence.moved
        else ("Rounds", "none"),
    ]
    cells = [
        [scan.name, scan.reason or "in correspondence", percent(scan.seen), percent(scan.covered)]
        for scan in sorted(correspondence.scans, key=lambda scan: not scan.reason)[:MOST_ROWS]
    ]
    heads = ["scan", "status", "share of the mean shape seen", "share of the scan covered"]
    blocks = _table(heads, cells, "The scans, excluded ones first", len(correspondence.scans))
    notes = [f"{scan.name}: {note}" for scan in correspondence.scans for note in scan.notes]
    draw = _surface(correspondence.template, "The mean shape.")
    return notebook_html(correspondence, "Correspondence", [correspondence.why, *notes], rows, draw, blocks=blocks)


def html_of_volume_surface(surface: VolumeSurface) -> str:
    """Return the notebook view of the surface of a volume: its picture, labels and volume."""
    mesh = surface.mesh
    rows = [
        ("Labels", listed([str(label) for label in surface.labels])),
        ("Surface", f"{len(mesh.vertices):,} vertices, {0 if mesh.faces is None else len(mesh.faces):,} triangles"),
        ("Volume", f"{surface.volume_mm3:,.0f} mm³, {surface.voxels:,} voxels"),
        ("Pieces", str(surface.pieces)),
    ]
    rows += [("Note", note) for note in surface.notes]
    return notebook_html(surface, mesh.name, [], rows, _surface(mesh, "The surface in its own axes."))


def html_of_additive_model(model: AdditiveModel) -> str:
    """Return the notebook view of an additive model."""
    shape = model.shape
    rows = [
        ("Coefficients", f"{model.n_identity} of identity, {shape.n_modes - model.n_identity} of expression"),
        ("Made of", training_text(shape)),
        ("Surface", f"{shape.n_vertices:,} vertices, {0 if shape.faces is None else len(shape.faces):,} triangles"),
        ("Provenance", shape.provenance or "not stated"),
        ("Licence", shape.licence or "not stated"),
    ]
    return notebook_html(model, "Additive model", [], rows, _surface(shape.mesh(), "The mean shape."))


def html_of_predictor(predictor: Predictor) -> str:
    """Return the notebook view of a predictor: its target, training data and range."""
    rows = [
        ("Subjects", str(predictor.subjects)),
        ("Method", predictor.method),
        ("Targets", f"{predictor.lowest:.4g} to {predictor.highest:.4g}"),
        ("Intervals", f"{percent(predictor.confidence)}"),
        ("Surface", f"{len(predictor.mean):,} vertices, gauge {predictor.gauge}"),
        ("Farthest subject", mm(predictor.farthest_mm)),
    ]
    return notebook_html(predictor, f"Predictor of {predictor.target}", [], rows)


def html_of_predictions(predictions: Predictions) -> str:
    """Return the notebook view of predictions: value and interval of the first shapes."""
    cells = [
        [
            name,
            f"{predictions.value[k]:.4g}",
            f"{predictions.low[k]:.4g} to {predictions.high[k]:.4g}",
            predictions.outside[k],
        ]
        for k, name in enumerate(predictions.names[:MOST_ROWS])
    ]
    heads = ["shape", "value", "interval", "outside of the training data"]
    blocks = _table(heads, cells, "The first shapes", len(predictions.names))
    return notebook_html(predictions, "Predictions", [], [("Shapes", str(len(predictions.names)))], blocks=blocks)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], caption: str, total: int) -> list[Block]:
    """Return a table with the first rows, and a sentence with the number of omitted ones of `total` rows."""
    cells = [[Cell(text) for text in row] for row in rows]
    return _shorten(Table([Head(head) for head in heads], cells, caption), total, "more")


def _shorten(table: Table, total: int, rest: str = "more rows") -> list[Block]:
    """Return a table with at most `MOST_ROWS` rows, and the number of further ones of `total` rows."""
    shown = Table(table.columns, table.rows[:MOST_ROWS], table.caption)
    left = total - len(shown.rows)
    return [shown] if left <= 0 else [shown, Text(f"{left:,} {rest} are omitted.")]


def _surface(mesh: Mesh, caption: str) -> Callable[[], Drawn]:
    def draw() -> Drawn:
        return mesh_still(mesh), caption

    return draw
