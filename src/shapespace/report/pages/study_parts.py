"""Blocks of a page for each kind of part of a recognition.json or an analysis.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from msgspec import structs

from shapespace.errors import FileFormatError
from shapespace.report.analyses.shape_data import MOST_LANDMARKS
from shapespace.report.blocks.blocks import Block, Cell, Column, Figure, Folded, Table, Text, length
from shapespace.report.blocks.wording import DASH, counted, listed, percent
from shapespace.report.inputs.saved_fits import Folder
from shapespace.report.pages.page import Page
from shapespace.schemas import (
    ANALYSIS_AGAIN,
    PARTS,
    STUDY_AGAIN,
    Analysis,
    CalibrationPart,
    ConfusionPart,
    CurvePart,
    DeformationPart,
    HistogramPart,
    LearningCurvePart,
    MorphospacePart,
    MorphPart,
    Part,
    Recognition,
    SurfaceMapPart,
    TableColumn,
    TablePart,
    TextPart,
    read,
)
from shapespace.types import Mesh

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class PartsFile:
    """A kind of file with parts.

    Args:
        file: its name.
        struct: its content.
        again: the advice for a damaged file.
        word: a noun for its content.
        article: the same with its article.
        title: default title of its page.
        lead: first sentence of its page.
    """

    file: str
    struct: type[Recognition]
    again: str
    word: str
    article: str
    title: str
    lead: str

    def damaged(self, reason: str) -> FileFormatError:
        """Return the error of a damaged file."""
        return FileFormatError(f"{self.file} is damaged: {reason}; {self.again}.")


STUDY = PartsFile(
    file="recognition.json",
    struct=Recognition,
    again=STUDY_AGAIN,
    word="study",
    article="a study",
    title="Recognition study",
    lead="What a study of recognition measured",
)
ANALYSIS = PartsFile(
    file=Analysis.FILE,
    struct=Analysis,
    again=ANALYSIS_AGAIN,
    word="analysis",
    article="an analysis",
    title="Analysis",
    lead="What an analysis of shapes found",
)
MOST_ROWS, MOST_PARAGRAPH = 500, 2000  # rows and characters of a paragraph that a page shows: bounds its length
_MOST_COLUMNS = 30  # columns; a wider table is unreadable, and probably damage
TITLES = {
    "table": "Table",
    "confusion": "Confusion matrix",
    "calibration": "Calibration",
    "learning_curve": "Learning curve",
    "curve": "Curve",
    "surface_map": "Map",
    "morph": "From one shape to the other",
    "histogram": "Spread",
    "morphospace": "Morphospace",
    "deformation": "Deformation",
    "text": "Notes",
}
"""Of parts without one, by kind."""
Drawn = tuple[Any, str, str]
"""A drawing, its caption where the part has no note, and what is seen in it."""


class StudyParts:
    """Converts parts into blocks of a page.

    Args:
        page: that they go to.
        folder: with the arrays and meshes that they name.
        parts_file: the kind of file that holds them.
    """

    def __init__(self, page: Page, folder: Folder, parts_file: PartsFile) -> None:
        self.page = page
        self.folder = folder
        self.parts_file = parts_file

    def blocks(self, part: Part, title: str) -> list[Block]:
        """Return a part by its kind.

        Raises:
            ShapespaceError: it cannot be shown.
        """
        return _MAKERS[type(part)](self, part, title, part.note or "")

    def drawn(self, drawing: Drawn, note: str, *, chart: bool = True) -> Figure:
        """Return a drawing with its caption, or the part's note in its place."""
        figure, about, alt = drawing
        return self.page.figure(figure, note or about, alt=alt, chart=chart)

    def text(self, part: TextPart, title: str, note: str) -> list[Block]:
        """Return paragraphs."""
        return [*paragraphs(part.text), *([Text(note, "soft")] if note else [])]

    def table(self, part: TablePart, title: str, note: str) -> list[Block]:
        """Return a table that sorts."""
        if not 1 <= len(part.columns) <= _MOST_COLUMNS:
            raise self.parts_file.damaged(f"a table has {len(part.columns)} columns, not 1 to {_MOST_COLUMNS}")
        if any(len(row) != len(part.columns) for row in part.rows):
            raise self.parts_file.damaged(
                f"a row of a table has another number of cells than its {len(part.columns)} columns"
            )
        heads = [
            Column(
                f"{column.name} (mm)"
                if column.kind == "mm" and "mm" not in column.name.strip("()").split()
                else column.name,
                "text" if column.kind == "text" else "number",
            )
            for column in part.columns
        ]
        cells = [
            [_cell(value, column, self.parts_file) for value, column in zip(row, part.columns, strict=True)]
            for row in part.rows[:MOST_ROWS]
        ]
        out: list[Block] = [Table(heads, cells, note or title, sortable=len(cells) > 1)]
        if len(part.rows) > MOST_ROWS:
            out.append(Text(f"{counted(len(part.rows) - MOST_ROWS, 'other row')} are left out."))
        return out

    def confusion(self, part: ConfusionPart, title: str, note: str) -> list[Block]:
        """Return a confusion matrix as a picture, and folded away as a table."""
        from shapespace.report import figures

        classes = part.classes
        if {len(row) for row in part.counts} - {len(classes)}:
            raise self.parts_file.damaged(f"a confusion matrix of {len(classes)} classes has rows of another length")
        figure = figures.confusion_figure(part.counts, classes)
        totals = [sum(row) for row in part.counts]
        right = [f"{name} {percent(part.counts[k][k] / totals[k])}" for k, name in enumerate(classes) if totals[k]]
        about = (
            "Rows: the true class. Columns: the predicted class. Percent of the row, and below it how many; an empty "
            "cell is none. Framed: right answers."
        )
        alt = f"Confusion matrix of {counted(len(classes), 'class', 'classes')}; right answers: {listed(right, 40)}"
        rows = [
            [name, *(f"{value:g} ({percent(value / total)})" if total else DASH for value in row)]
            for name, row, total in zip(classes, part.counts, totals, strict=True)
        ]
        heads = [Column("True class"), *(Column(f"predicted {name}", "number") for name in classes)]
        table = Table(heads, [list(map(Cell, row)) for row in rows], f"Confusion matrix: {title}")
        picture = self.page.figure(figure, f"{note} {about}".strip(), alt=alt, chart=True)
        return [picture, Folded("The same as a table", [table])]

    def calibration(self, part: CalibrationPart, title: str, note: str) -> list[Block]:
        """Return the reliability diagram."""
        from shapespace.report import figures

        bins = np.array([structs.astuple(one) for one in part.bins], dtype=np.float64).reshape(-1, 5)
        figure = figures.calibration_figure(bins, ece=part.ece, brier=part.brier)
        points = [f"stated {percent(p)}, right {percent(right)}" for _, _, p, right, count in bins if count > 0]
        error = "" if part.ece is None else f"; expected calibration error {100 * part.ece:.1f} points"
        about = (
            "How often answers are right, against the probability stated for them: under the dashed line they are "
            "right less often than stated. Larger dots stand for more answers, which the bars count."
        )
        alt = f"Calibration: {listed(points, 20)}{error}"
        return [self.page.figure(figure, f"{note} {about}".strip(), alt=alt, chart=True)]

    def learning_curve(self, part: LearningCurvePart, title: str, note: str) -> list[Block]:
        """Return the accuracy against the number of training people."""
        from shapespace.report import figures

        low, high = (None if ends is None else np.array(ends, dtype=np.float64) for ends in (part.low, part.high))
        figure = figures.learning_curve_figure(
            part.subjects, part.mean, low=low, high=high, band=part.band or "interval", ceiling=part.ceiling
        )
        points = [
            f"{100 * mean:.1f} % from {count:g} subjects" for count, mean in zip(part.subjects, part.mean, strict=True)
        ]
        ceiling = "" if part.ceiling is None else f"; ceiling {100 * part.ceiling:.1f} %"
        about = "Accuracy on subjects who were not in the training set, by the number of training subjects."
        return [self.drawn((figure, about, f"Learning curve: {listed(points, 20)}{ceiling}"), note)]

    def curve(self, part: CurvePart, title: str, note: str) -> list[Block]:
        """Return one measure against another."""
        from shapespace.report import figures

        x, y = part.x or "x", part.y or "y"
        ends = [(one.low, one.high) for one in part.series]
        figure = figures.curve_figure(
            [(one.label, one.x, one.y) for one in part.series], x=x, y=y,
            bands=[None if low is None or high is None else (_known(low), _known(high)) for low, high in ends],
            dots=[one.points for one in part.series], scales=(part.x_scale, part.y_scale), diagonal=part.diagonal,
            groups=[one.group for one in part.series],
        )  # fmt: skip
        ranges = [
            f"{one.label or y} from {one.y[0]:.3g} at {one.x[0]:g} to {one.y[-1]:.3g} at {one.x[-1]:g}"
            for one in part.series
            if one.x and one.y
        ]
        about = f"{y[:1].upper()}{y[1:]} against {x}."
        bands = " Bands: its interval." if any(low is not None for low, _ in ends) else ""
        dashes = " Dashed: where both are the same." if part.diagonal else ""
        about += bands + dashes
        return [self.drawn((figure, about, f"{about} {listed(ranges)}"), note)]

    def surface_map(self, part: SurfaceMapPart, title: str, note: str) -> list[Block]:
        """Return a number for each vertex on a surface, seen from several sides."""
        from shapespace.report import figures

        names = (part.vertices, part.faces, part.values, *([part.mask] if part.mask else []))
        vertices, faces, values, *masks = self._arrays(part.arrays, names)
        mesh = self._mesh(vertices, faces)
        mask = masks[0].astype(bool) if masks else None
        if values.dtype.kind not in "iuf" or (mask is not None and masks[0].dtype.kind not in "biu"):
            raise self.parts_file.damaged("the values of a map are no numbers, or its mask is none")
        values = values.astype(np.float64)
        style: Any = {"unit": part.unit, "signed": part.signed, "limit": part.limit, "mask": mask}
        if mesh.faces is None and len(mesh.vertices) <= MOST_LANDMARKS:
            figure = figures.landmark_map_figure(mesh.vertices, values, **style)
        else:
            figure = figures.surface_map_figure(mesh, values, title=None, **style)
        known = values[np.isfinite(values)]
        inside = "" if mask is None else f"; {percent(float(mask.mean()))} of the vertices are marked"
        alt = (
            f"{title}: the surface from several sides, coloured by {part.unit}, {known.min():.3g} to {known.max():.3g}"
            f"{inside}"
        )
        return [
            self.drawn((figure, f"Seen from several sides{part.unit and '; '}{part.unit}.", alt), note, chart=False)
        ]

    def morph(self, part: MorphPart, title: str, note: str) -> list[Block]:
        """Return two shapes between which a slider moves; beside each other where nothing turns."""
        from shapespace.report import figures
        from shapespace.report.render.scene import pack_morph

        low, high, faces = self._arrays(part.arrays, (part.low, part.high, part.faces))
        if low.shape != high.shape:
            raise self.parts_file.damaged("the two shapes of a morph have different numbers of vertices")
        first, last = self._mesh(low, faces), self._mesh(high, faces)
        turn, _ = figures.upright_views(first)
        both = first.with_vertices(first.vertices @ turn.T), last.with_vertices(last.vertices @ turn.T)
        labels = part.low_label or "low", part.high_label or "high"
        alt = f"{title}: {labels[0]}, and {labels[1]}"
        path = None
        if part.modes:
            modes, weights = self._arrays(part.arrays, (part.modes, part.weights))
            if modes.shape[1:] != low.shape or weights.shape[1:] != modes.shape[:1] or len(weights) < 2:
                raise self.parts_file.damaged("the modes and weights of a morph do not fit its shapes")
            path = modes @ turn.T, weights
        still = self.page.still(figures.morph_figure(first, last, labels, title=None), alt)
        turning = self.page.turning(
            "morph", pack_morph(*both, labels, path=path, variable=part.variable, ends=part.range), still,
            f"{note or f'From {labels[0]} to {labels[1]}.'}{_times_sentence(part.times)}",
            label=alt, still="The still shows both, from the front and from the side.",
        )  # fmt: skip
        return [turning]

    def deformation(self, part: DeformationPart, title: str, note: str) -> list[Block]:
        """Return two configurations of landmarks as deformation grids, or as vectors."""
        from shapespace.report import figures

        low, high = (
            self._mesh(one, np.zeros((0, 3), np.intp)).vertices
            for one in self._arrays(part.arrays, (part.low, part.high))
        )
        if low.shape != high.shape:
            raise self.parts_file.damaged("two configurations have different numbers of landmarks")
        labels = part.low_label or "low", part.high_label or "high"
        if part.drawing == "grid":
            figure = figures.deformation_grid_figure(low, high, labels)
            about = f"Thin-plate splines from the mean of both to {labels[0]} and to {labels[1]}."
        else:
            figure = figures.landmark_vectors_figure(low, high, labels)
            about = f"Each line leads from a landmark of {labels[0]}, a dot, to its place in {labels[1]}."
        caption = f"{note} {about}{_times_sentence(part.times)}".strip()
        return [self.page.figure(figure, caption, alt=f"{title}: {about}")]

    def histogram(self, part: HistogramPart, title: str, note: str) -> list[Block]:
        """Return a histogram."""
        from shapespace.report import figures

        figure = figures.histogram_figure(
            part.edges, [(one.label, one.counts) for one in part.series], x=part.x, y=part.y, observed=part.observed,
            observed_label=part.observed_label or "observed",
        )  # fmt: skip
        many = [f"{one.label} {sum(one.counts):g}".strip() for one in part.series]
        about = f"Counts: {listed(many)}." if part.y == "count" else ""
        if part.observed is not None:
            about += f" Dashed line: {part.observed_label or 'observed'}, {part.observed:.3g}."
        alt = f"Histogram of {part.x} from {part.edges[0]:.3g} to {part.edges[-1]:.3g}. {about}"
        return [self.drawn((figure, about, alt), note)]

    def morphospace(self, part: MorphospacePart, title: str, note: str) -> list[Block]:
        """Return the plane of two axes of an ordination, in which a click draws the shape at that place."""
        from shapespace.report import figures
        from shapespace.report.render.scene import pack_morphospace

        space = figures.Morphospace.of(part, self.folder.arrays(part.arrays), self.parts_file.damaged)
        across, up = (space.labels[k] for k in part.first)
        groups = f" in {counted(len(part.groups), 'group')} of {part.variable}" if part.groups else ""
        alt = f"{title}: {counted(len(part.names), 'shape')}{groups} on {across} and {up}"
        still = self.page.still(figures.morphospace_figure(space), alt, lossless=True)
        turning = self.page.turning(
            "morphospace", pack_morphospace(space), still,
            note or "Shapes in the plane of two axes; choose a place to draw the shape there next to the mean.",
            label=alt, still="The still shows the mean and the shapes at the ends of both axes.",
        )  # fmt: skip
        return [turning]

    def _arrays(self, name: str, names: Sequence[str]) -> list[npt.NDArray[Any]]:
        """Return arrays of a file by their names."""
        arrays = self.folder.arrays(name)
        absent = [one for one in names if one not in arrays]
        if absent:
            raise FileFormatError(f"{name} holds no array {absent[0]!r}; {self.parts_file.again}.")
        return [arrays[one] for one in names]

    def _mesh(self, vertices: npt.NDArray[Any], faces: npt.NDArray[Any]) -> Mesh:
        """Return a surface of arrays; without triangles, points."""
        if vertices.dtype.kind not in "iuf" or faces.dtype.kind not in "iu" or vertices.ndim != 2:
            raise self.parts_file.damaged("the arrays of a surface are no places and triangles")
        if not np.isfinite(vertices).all():
            raise self.parts_file.damaged("some vertices of a surface are not finite")
        return Mesh(vertices.astype(np.float64), faces if faces.size else None, name="the surface")


_MAKERS: Mapping[type[Part], Callable[[StudyParts, Any, str, str], list[Block]]] = {
    kind: getattr(StudyParts, name) for name, kind in PARTS.items()
}


def paragraphs(text: str | tuple[str, ...]) -> list[Block]:
    """Return sentences as paragraphs."""
    return [Text(sentence) for sentence in ((text,) if isinstance(text, str) else text)[:MOST_ROWS]]


def _times_sentence(times: float) -> str:
    return "" if times == 1 else f" The difference is drawn {times:g} times as large as it is."


def _known(values: Sequence[float | None]) -> list[float]:
    return [float("nan") if value is None else value for value in values]


def _cell(value: object, column: TableColumn, parts_file: PartsFile) -> Cell:
    """Return a cell of a table by the kind of its column."""
    where = f"{parts_file.file}: the column {column.name!r}"
    if column.kind == "text":
        return Cell(DASH if value in (None, "") else str(value))
    if value is None:
        return Cell(DASH, float("nan"))
    if column.kind == "interval":
        low, high = read(tuple[float, float], value, where, parts_file.again)
        return Cell(f"{100 * low:.1f} to {100 * high:.1f} %", low)
    number = read(float, value, where, parts_file.again)
    if column.kind == "mm":
        return length(number)
    texts = {
        "percent": f"{100 * number:.1f} %",
        "p": "< 0.001" if number < 0.001 else f"{number:.3f}",
        "count": f"{number:,.0f}",
        "number": f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.3g}",
    }
    return Cell(texts[column.kind], number)
