"""Views of results in a notebook: title, sentences, tables, and a picture where there is a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.errors import ShapespaceError
from shapespace.report.analyses.result_tables import analysis_report
from shapespace.report.blocks.blocks import Block, Cell, Column, Notes, Table, Text
from shapespace.report.blocks.wording import listed, mm, percent, training_text
from shapespace.report.inputs.saved_fits import Folder
from shapespace.report.notebook.notebook_fits import Drawn, notebook_html
from shapespace.report.pages.page import Page
from shapespace.report.pages.study_page import ANALYSIS, TITLES, StudyParts
from shapespace.schemas import SurfaceReview, TablePart, read_part, to_json
from shapespace.store.corresponding import review_summary
from shapespace.types import Mesh

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.correspondence.correspondence_result import Correspondence
    from shapespace.geometry.volume_surface import VolumeSurface
    from shapespace.model.additive import AdditiveModel
    from shapespace.statistics.methods import AnalysisResult
    from shapespace.statistics.predictor import Predictions, Predictor
    from shapespace.store.results import Results

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
        blocks.append(Text(f"{len(cohort.table.columns) - len(columns)} more columns are left out."))
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
    """Return a table of the first of `total` rows, and how many there are beyond them."""
    cells = [[Cell(text) for text in row] for row in rows]
    return _shorten(Table([Column(head) for head in heads], cells, caption), total, "more")


def _shorten(table: Table, total: int, rest: str = "more rows") -> list[Block]:
    """Return a table with at most `MOST_ROWS` rows, and the number of further ones of `total` rows."""
    shown = Table(table.columns, table.rows[:MOST_ROWS], table.caption)
    left = total - len(shown.rows)
    return [shown] if left <= 0 else [shown, Text(f"{left:,} {rest} are left out.")]


def _surface(mesh: Mesh, caption: str) -> Callable[[], Drawn]:
    def draw() -> Drawn:
        from shapespace.report.render.thumbnails import mesh_still

        return mesh_still(mesh), caption

    return draw
