"""Blocks of a page for each kind of part of a recognition.json or an analysis.json."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from msgspec import structs

from shapespace.errors import FileFormatError
from shapespace.report import figures
from shapespace.report.analyses.analysis_report import MOST_LANDMARKS
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import (
    Block,
    Cell,
    Command,
    Facts,
    Figure,
    Folded,
    Group,
    Head,
    Notice,
    Table,
    Text,
    facts_of,
    first_items,
    length,
    text_table,
)
from shapespace.report.blocks.wording import (
    DASH,
    counted,
    known,
    listed,
    moment,
    percent,
    printable,
    without_folders,
)
from shapespace.report.inputs.saved_fits import Folder, has_fits
from shapespace.report.pages.page import Chapter, Make, Page, rendered
from shapespace.report.render.scene import pack_morph, pack_morphospace
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
    Orientation,
    Part,
    Recognition,
    SurfaceMapPart,
    TableColumn,
    TablePart,
    Target,
    TextPart,
    check_format,
    read,
    read_part,
)
from shapespace.types import Mesh
from shapespace.version import __version__


@dataclass(frozen=True)
class PartsFile:
    """A kind of file with parts.

    Args:
        file: name of the file.
        struct: type of the content.
        again: advice for a damaged file.
        word: noun for the content.
        article: noun for the content, with its article.
        title: default title of the page.
        lead: first sentence of the page.
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
    lead="Results of a study of recognition",
)
ANALYSIS = PartsFile(
    file=Analysis.FILE,
    struct=Analysis,
    again=ANALYSIS_AGAIN,
    word="analysis",
    article="an analysis",
    title="Analysis",
    lead="Results of an analysis of shapes",
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
"""Titles of parts without a title, by kind."""
Drawn = tuple[Any, str, str]
"""A drawing, its caption if the part has no note, and its alternative text."""


class StudyParts:
    """Converts parts into blocks of a page.

    Args:
        page: page of the blocks.
        folder: folder with the arrays and meshes that the parts name.
        parts_file: kind of the file of the parts.
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
        return [*paragraphs(part.text), Text(note, "soft")]

    def table(self, part: TablePart, title: str, note: str) -> list[Block]:
        """Return a table that sorts."""
        if not 1 <= len(part.columns) <= _MOST_COLUMNS:
            raise self.parts_file.damaged(f"a table has {len(part.columns)} columns, not 1 to {_MOST_COLUMNS}")
        if any(len(row) != len(part.columns) for row in part.rows):
            raise self.parts_file.damaged(
                f"a row of a table has another number of cells than its {len(part.columns)} columns"
            )
        heads = [
            Head(
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
            out.append(Text(f"{counted(len(part.rows) - MOST_ROWS, 'other row')} are omitted."))
        return out

    def confusion(self, part: ConfusionPart, title: str, note: str) -> list[Block]:
        """Return a confusion matrix as a picture, and folded away as a table."""
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
        table = Table(
            [Head("True class"), *(Head(f"predicted {name}", "number") for name in classes)],
            [
                list(map(Cell, row))
                for row in [
                    [name, *(f"{value:g} ({percent(value / total)})" if total else DASH for value in row)]
                    for name, row, total in zip(classes, part.counts, totals, strict=True)
                ]
            ],
            f"Confusion matrix: {title}",
        )
        return [
            self.page.figure(figure, f"{note} {about}".strip(), alt=alt, chart=True),
            Folded("The same as a table", [table]),
        ]

    def calibration(self, part: CalibrationPart, title: str, note: str) -> list[Block]:
        """Return the reliability diagram."""
        bins = np.array([structs.astuple(interval) for interval in part.bins], dtype=np.float64).reshape(-1, 5)
        figure = figures.calibration_figure(bins, ece=part.ece, brier=part.brier)
        points = [f"stated {percent(p)}, right {percent(right)}" for _, _, p, right, count in bins if count > 0]
        error = "" if part.ece is None else f"; expected calibration error {100 * part.ece:.1f} points"
        about = (
            "How often answers are right, against the probability stated for them: under the dashed line they are "
            "right less often than stated. Larger dots stand for more answers, which the bars count."
        )
        return [
            self.page.figure(
                figure, f"{note} {about}".strip(), alt=f"Calibration: {listed(points, 20)}{error}", chart=True
            )
        ]

    def learning_curve(self, part: LearningCurvePart, title: str, note: str) -> list[Block]:
        """Return the accuracy against the number of training people."""
        low, high = (None if ends is None else np.array(ends, dtype=np.float64) for ends in (part.low, part.high))
        figure = figures.learning_curve_figure(
            part.subjects, part.mean, low=low, high=high, band=part.band or "interval", ceiling=part.ceiling
        )
        points = [
            f"{100 * mean:.1f} % from {count:g} subjects" for count, mean in zip(part.subjects, part.mean, strict=True)
        ]
        ceiling = "" if part.ceiling is None else f"; ceiling {100 * part.ceiling:.1f} %"
        return [
            self.drawn(
                (
                    figure,
                    "Accuracy on subjects who were not in the training set, by the number of training subjects.",
                    f"Learning curve: {listed(points, 20)}{ceiling}",
                ),
                note,
            )
        ]

    def curve(self, part: CurvePart, title: str, note: str) -> list[Block]:
        """Return one measure against another."""
        x, y = part.x or "x", part.y or "y"
        ends = [(line.low, line.high) for line in part.series]
        figure = figures.curve_figure(
            [(line.label, line.x, line.y) for line in part.series],
            x=x,
            y=y,
            bands=[
                None if low is None or high is None else ([*map(known, low)], [*map(known, high)]) for low, high in ends
            ],
            dots=[line.points for line in part.series],
            scales=(part.x_scale, part.y_scale),
            diagonal=part.diagonal,
            groups=[line.group for line in part.series],
        )
        ranges = [
            f"{line.label or y} from {line.y[0]:.3g} at {line.x[0]:g} to {line.y[-1]:.3g} at {line.x[-1]:g}"
            for line in part.series
            if line.x and line.y
        ]
        about = f"{y[:1].upper()}{y[1:]} against {x}."
        about += (" Bands: its interval." if any(low is not None for low, _ in ends) else "") + (
            " Dashed: where both are the same." if part.diagonal else ""
        )
        return [self.drawn((figure, about, f"{about} {listed(ranges)}"), note)]

    def surface_map(self, part: SurfaceMapPart, title: str, note: str) -> list[Block]:
        """Return a number for each vertex on a surface, seen from several sides."""
        vertices, faces, values, *masks = self._arrays(
            part.arrays, (part.vertices, part.faces, part.values, *([part.mask] if part.mask else []))
        )
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
        return [
            self.drawn(
                (
                    figure,
                    f"Seen from several sides{part.unit and '; '}{part.unit}.",
                    (
                        f"{title}: the surface from several sides, coloured by {part.unit}, {known.min():.3g} to "
                        f"{known.max():.3g}{inside}"
                    ),
                ),
                note,
                chart=False,
            )
        ]

    def morph(self, part: MorphPart, title: str, note: str) -> list[Block]:
        """Return two shapes with a slider between them; as the fallback, next to each other."""
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
        turning = self.page.turning(
            "morph",
            pack_morph(*both, labels, path=path, variable=part.variable, ends=part.range),
            self.page.still(figures.morph_figure(first, last, labels, title=None), alt),
            f"{note or f'From {labels[0]} to {labels[1]}.'}{_times_sentence(part.times)}",
            label=alt,
            still="The still shows both, from the front and from the side.",
        )
        return [turning]

    def deformation(self, part: DeformationPart, title: str, note: str) -> list[Block]:
        """Return two configurations of landmarks as deformation grids, or as vectors."""
        low, high = (
            self._mesh(points, np.zeros((0, 3), np.intp)).vertices
            for points in self._arrays(part.arrays, (part.low, part.high))
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
        return [
            self.page.figure(figure, f"{note} {about}{_times_sentence(part.times)}".strip(), alt=f"{title}: {about}")
        ]

    def histogram(self, part: HistogramPart, title: str, note: str) -> list[Block]:
        """Return a histogram."""
        figure = figures.histogram_figure(
            part.edges, [(group.label, group.counts) for group in part.series], x=part.x, y=part.y,
            observed=part.observed, observed_label=part.observed_label or "observed",
        )  # fmt: skip
        many = [f"{group.label} {sum(group.counts):g}".strip() for group in part.series]
        about = f"Counts: {listed(many)}." if part.y == "count" else ""
        if part.observed is not None:
            about += f" Dashed line: {part.observed_label or 'observed'}, {part.observed:.3g}."
        return [
            self.drawn(
                (figure, about, f"Histogram of {part.x} from {part.edges[0]:.3g} to {part.edges[-1]:.3g}. {about}"),
                note,
            )
        ]

    def morphospace(self, part: MorphospacePart, title: str, note: str) -> list[Block]:
        """Return the plane of two axes of an ordination, in which a click draws the shape at that place."""
        space = figures.Morphospace.of(part, self.folder.arrays(part.arrays), self.parts_file.damaged)
        across, up = (space.labels[k] for k in part.first)
        groups = f" in {counted(len(part.groups), 'group')} of {part.variable}" if part.groups else ""
        alt = f"{title}: {counted(len(part.names), 'shape')}{groups} on {across} and {up}"
        turning = self.page.turning(
            "morphospace",
            pack_morphospace(space),
            self.page.still(figures.morphospace_figure(space), alt, lossless=True),
            note or "Shapes in the plane of two axes; choose a place to draw the shape there next to the mean.",
            label=alt,
            still="The still shows the mean and the shapes at the ends of both axes.",
        )
        return [turning]

    def _arrays(self, name: str, names: Sequence[str]) -> list[npt.NDArray[Any]]:
        """Return arrays of a file by their names."""
        arrays = self.folder.arrays(name)
        absent = [array for array in names if array not in arrays]
        if absent:
            raise FileFormatError(f"{name} contains no array {absent[0]!r}; {self.parts_file.again}.")
        return [arrays[array] for array in names]

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


def _cell(value: object, column: TableColumn, parts_file: PartsFile) -> Cell:
    """Return a cell of a table by the kind of its column."""
    where = f"{parts_file.file}: the column {column.name!r}"
    if column.kind == "text" or value is None:
        return Cell(DASH if value in (None, "") else str(value), None if column.kind == "text" else float("nan"))
    if column.kind == "interval":
        low, high = read(tuple[float, float], value, where, parts_file.again)
        return Cell(f"{100 * low:.1f} to {100 * high:.1f} %", low)
    number = read(float, value, where, parts_file.again)
    return Cell(
        {
            "mm": length(number).text,
            "percent": f"{100 * number:.1f} %",
            "p": "< 0.001" if number < 0.001 else f"{number:.3f}",
            "count": f"{number:,.0f}",
            "number": f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.3g}",
        }[column.kind],
        number,
    )


SECTION_BYTES = 1_500_000
"""Bytes of a report of fits that are reserved for this section."""

MOST_ANALYSES = 12
"""Largest number of analyses in a report of fits."""

# parts of a study, and characters of a damaged value, that a page shows: bounds its length
_MOST_PARTS, _MOST_TEXT = 120, 400
_PART_BYTES = 700_000  # bytes that one part of a study takes with its figures
_MOST_NOTES = 40  # notes on the page; the file has all
_BESIDE = ("confusion", "calibration", "learning_curve", "curve", "histogram")
"""Kinds of parts that share the page's width with their neighbour; the views of a surface map need the full width."""
_CHAPTER = 2  # level of parts that begin a chapter (`Part` in schemas)
_T = TypeVar("_T")


def standalone_file(folder: Folder) -> PartsFile | None:
    """Return the kind of the file with parts in `folder` if there are no fits to report; None if there is neither.

    A file without a format is a free collection of scores, which is no study.
    """
    there = [parts_file for parts_file in (STUDY, ANALYSIS) if (folder.root / parts_file.file).is_file()]
    if not there or has_fits(folder):
        return None
    return next((parts_file for parts_file in there if "format" in _content(folder, parts_file)), None)


def study_page(folder: Folder, parts_file: PartsFile, page: Page) -> str:
    """Return the report of a study or an analysis alone.

    Args:
        folder: folder with the file.
        parts_file: kind of the file.
        page: page that it fills.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder, parts_file)
    page.planned = max(sum(_raw_value(part, "kind") not in ("table", "text") for part in _raw_parts(content)), 1)
    study = _Study(page, folder, parts_file, content)
    name = folder.root.resolve().name
    created = f", {moment(study.head['created'])}" if study.head["created"] else ""
    targets_text = ", compared with the targets that were set for it" if content.get("targets") else ""
    return page.html(
        study.head["title"] or f"{parts_file.title} in {name}",
        [
            Text(f"{parts_file.lead}{targets_text}."),
            Text(f"{' '.join(filter(None, ('shapespace', study.head['version'])))}{created}.", "soft"),
        ],
        f"Made by shapespace {__version__} from the files in {name}.",
        [
            *(
                [Chapter("Summary", study.summary)]
                if any(content.get(key) for key in ("summary", "targets", "notes"))
                else []
            ),
            *(
                Chapter(heading, make, heading if len(heading) <= 36 else f"{heading[:35]}…")
                for heading, make in study.chapters("Results", 3)
            ),
            Chapter("Settings, versions and hashes", study.settings, "Settings"),
        ],
    )


def study_section(page: Page, folder: Folder, parts_file: PartsFile = STUDY) -> list[Block]:
    """Return the results of a study or an analysis, as a section of the report of fits.

    Args:
        page: page of the section.
        folder: folder with the file.
        parts_file: kind of the file.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder, parts_file)
    if parts_file is STUDY and "format" not in content:
        return sections.score_tables(content, many="Scores by class", single="Scores")
    study = _Study(page, folder, parts_file, content)
    out: list[Block] = [Text(study.head["title"]), *page.tried(study.summary)]
    for heading, make in study.chapters("", 4):
        out += [page.section(heading, make)] if heading else page.tried(make)
    return [*out, Folded(f"Settings and versions of this {parts_file.word}", page.tried(study.settings))]


def find_analyses(root: Path) -> list[Folder]:
    """Return the folders with an analysis.json: `root` itself, and those directly in it, by name."""
    inside: list[Path] = []
    with os.scandir(root) as entries:
        # A link may lead anywhere.
        inside = sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))
    return [Folder(folder, ANALYSIS.again) for folder in (root, *inside) if (folder / ANALYSIS.file).is_file()]


def analysis_chapters(page: Page, root: Path, folders: Sequence[Folder]) -> list[Chapter]:
    """Return a chapter for each of `folders` from `find_analyses`, up to MOST_ANALYSES.

    Args:
        page: page of the chapters.
        root: folder of the fits.
        folders: folders of the analyses.
    """
    out: list[Chapter] = []
    for folder in folders[:MOST_ANALYSES]:
        name = folder.root.name if folder.root != root else ""
        heading = printable(f"Analysis {name}".strip())
        out.append(Chapter(heading, lambda folder=folder: _analysis(page, folder, root), heading[:36]))
    rest = folders[MOST_ANALYSES:]
    if rest:
        names = listed([printable(folder.root.name) for folder in rest], 40)
        out.append(Chapter("Further analyses", lambda: Text(f"Not shown here, but each has its own report: {names}.")))
    return out


def _analysis(page: Page, folder: Folder, root: Path) -> list[Block]:
    out = study_section(page, folder, ANALYSIS)
    if folder.root == root:
        return out
    name = printable(folder.root.name)
    return [*out, Text("This analysis in a report of its own:", "soft"), Command(f"shapespace report FOLDER/{name}")]


def _content(folder: Folder, parts_file: PartsFile) -> dict[str, Any]:
    return cast(dict[str, Any], _shorten(Folder(folder.root, parts_file.again).json(parts_file.file)))


def _shorten(value: object, most: int = _MOST_TEXT) -> object:
    """Return JSON content whose texts are lines of bounded length."""
    if isinstance(value, str):
        line = " ".join(value.split())
        return line if len(line) <= most else f"{line[: most - 1]}…"
    if isinstance(value, list):
        return [_shorten(item, most) for item in cast(list[object], value)]
    if isinstance(value, dict):
        mapping = cast(dict[str, object], value)
        long = ("note", "notes", "text", "summary", "settings")
        return {
            str(_shorten(key)): _shorten(item, MOST_PARAGRAPH if key in long else most) for key, item in mapping.items()
        }
    return value


def _raw_value(part: object, key: str) -> object:
    return cast(dict[str, object], part).get(key) if isinstance(part, dict) else None


def _raw_parts(content: Mapping[str, object]) -> list[object]:
    parts = content.get("parts")
    return cast(list[object], parts) if isinstance(parts, list) else []


class _Study:
    """A study or an analysis and its page; each key of its file is read when it is shown."""

    def __init__(self, page: Page, folder: Folder, parts_file: PartsFile, content: Mapping[str, Any]) -> None:
        check_format(content, parts_file.struct, parts_file.file, parts_file.again)
        self.page = page
        self.parts_file = parts_file
        self.folder = Folder(folder.root, parts_file.again)
        self.kinds = StudyParts(page, self.folder, parts_file)
        self.content = content
        self.head = {
            key: text if isinstance(text, str) else ""
            for key, text in {key: content.get(key) for key in ("title", "version", "created")}.items()
        }

    def _read(self, key: str, kind: type[_T]) -> _T:
        return read(kind, self.content.get(key), f"{self.parts_file.file}: {key}", self.parts_file.again)

    def summary(self) -> list[Block]:
        """Return its sentences, its targets with the results, and its notes."""
        makers: Mapping[str, Make] = {"summary": self.sentences, "targets": self.targets, "notes": self.notes}
        return [block for key, make in makers.items() if self.content.get(key) for block in self.page.tried(make)]

    def notes(self) -> Notice:
        """Return its notes, such as those on excluded shapes."""
        return Notice(
            "Notes",
            first_items(
                [*map(without_folders, self._read("notes", tuple[str, ...]))],
                _MOST_NOTES,
                f"in {self.parts_file.file}",
                "more",
                "more",
            ),
        )

    def sentences(self) -> list[Block]:
        """Return its sentences."""
        text = self.content["summary"]
        return paragraphs(text if isinstance(text, str) else self._read("summary", tuple[str, ...]))

    def targets(self) -> Table:
        """Return the targets, each with the result."""
        targets = self._read("targets", tuple[Target, ...])
        met = [target.met for target in targets if target.met is not None]
        caption = f"{sum(met)} of {counted(len(met), 'target')} met" if met else "Targets and results"
        if met and len(met) < len(targets):
            caption += f", {len(targets) - len(met)} without a verdict"
        verdicts = {None: Cell(DASH), True: Cell("met", status="converged"), False: Cell("missed", status="failed")}
        rows = [
            [
                *(Cell(text or DASH) for text in (target.what, target.target, target.reached)),
                verdicts[target.met],
                Cell(target.note or DASH),
            ]
            for target in targets[:MOST_ROWS]
        ]
        columns = [Head(head) for head in ("What", "Target", "Reached", "Verdict", "Note")]
        shown_columns = 5 if any(target.note for target in targets) else 4
        return Table(columns[:shown_columns], [row[:shown_columns] for row in rows], f"{caption}.", stack=True)

    def chapters(self, first: str, level: int) -> list[tuple[str, Make]]:
        """Return headings of chapters, each with its function; parts before the first chapter go under `first`.

        Args:
            first: heading of the parts before the first chapter.
            level: level of the headings of parts inside a chapter.
        """
        if self.content.get("parts") is None:
            return []
        if not isinstance(self.content["parts"], list):
            return [(first or "Results", self.no_parts)]
        parts = _raw_parts(self.content)
        groups: list[tuple[str, list[object], list[object]]] = [(first, [], [])]
        for part in parts[:_MOST_PARTS]:
            if _raw_value(part, "level") == _CHAPTER:
                groups.append((_title(part), [part], []))
            else:
                groups[-1][2].append(part)
        if not groups[0][2]:
            groups = groups[1:]

        def make(heading: str, own: list[object], inner: list[object]) -> list[Block]:
            body = [block for part in own for block in self.body(part)]
            body += self.parts(inner, level if heading else level - 1)
            if inner is groups[-1][2] and len(parts) > _MOST_PARTS:
                body.append(Text(f"{len(parts) - _MOST_PARTS} parts are omitted."))
            return body

        return [
            (heading, lambda heading=heading, own=own, inner=inner: make(heading, own, inner))
            for heading, own, inner in groups
        ]

    def no_parts(self) -> list[Block]:
        """Raise the error of parts that are not a list."""
        raise self.parts_file.damaged("its parts are no list")

    def parts(self, parts: Sequence[object], level: int) -> list[Block]:
        """Return parts under their headings, charts that follow each other side by side."""
        out: list[Block] = []
        for is_chart, run in groupby(parts, lambda part: _raw_value(part, "kind") in _BESIDE):
            made = [self.page.section(_title(part), lambda part=part: self.body(part), level) for part in run]
            out += [Group("beside", made)] if is_chart and len(made) > 1 else made
        return out

    def body(self, part: object) -> Sequence[Block]:
        """Return a part without its heading, or why it is not shown."""
        too_large = [Text("This part would make this file larger than 8 MB, so it is omitted.", "soft")]
        before = self.page.left
        if before < _PART_BYTES:
            return too_large
        blocks = self.page.tried(lambda: self.part(part))
        text = len(rendered(blocks).encode()) - (before - self.page.left)
        if text > self.page.left - _PART_BYTES // 2:
            return too_large
        self.page.spent += text
        return blocks

    def part(self, part: object) -> list[Block]:
        """Return a part by its kind."""
        typed_part = read_part(part, self.parts_file.file, self.parts_file.again)
        known = self.content.get("orientation") is not None
        with self.page.oriented(self._read("orientation", Orientation) if known else None):
            return self.kinds.blocks(typed_part, _title(part))

    def settings(self) -> list[Block]:
        """Return settings, versions and model hashes of the study."""
        rows = {"Report": f"shapespace {__version__}"}
        if self.head["version"]:
            rows[self.parts_file.word.capitalize()] = f"shapespace {self.head['version']}"
        if self.head["created"]:
            rows["Made"] = moment(self.head["created"])
        makers: Mapping[str, Make] = {
            "settings": lambda: facts_of(self._read("settings", dict[str, object]), "Settings"),
            "versions": lambda: facts_of(self._read("versions", dict[str, object]), "Versions"),
            "model_hashes": self.hashes,
        }
        made = [
            block
            for key, make in makers.items()
            if self.content.get(key) is not None
            for block in self.page.tried(make)
        ]
        return [Facts([*rows.items()], "Made with"), *made]

    def hashes(self) -> Folded:
        """Return the hashes of the models that took part."""
        hashes = self._read("model_hashes", tuple[str, ...])
        rows = [[str(k), model_hash] for k, model_hash in enumerate(hashes[:MOST_ROWS], 1)]
        return Folded(
            f"Content hashes (SHA-256) of {counted(len(hashes), 'model')}",
            [text_table(("Model", "Hash"), rows, "Content hashes of the models")] if rows else [],
        )


def _title(part: object) -> str:
    title, kind = _raw_value(part, "title"), str(_raw_value(part, "kind"))
    return title[:200] if isinstance(title, str) and title else TITLES.get(kind, "A part")
