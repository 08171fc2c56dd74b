"""What a study of recognition measured, from its recognition.json: a section of a report, or a report of its own.

The file names the parts in the order in which they are shown; what is absent is not shown, and what is damaged says so
in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from shapespace import __version__
from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.report import sections
from shapespace.report.blocks import (
    Block,
    Cell,
    Column,
    Facts,
    Figure,
    Folded,
    Group,
    Notice,
    Table,
    Text,
    facts_of,
    length,
    text_table,
)
from shapespace.report.page import Chapter, Make, Page, Step, rendered
from shapespace.report.saved import Folder, has_fits
from shapespace.report.wording import DASH, counted, listed, moment, percent
from shapespace.schemas import (
    PARTS,
    STUDY_AGAIN,
    CalibrationPart,
    ConfusionPart,
    CurvePart,
    FaceMapPart,
    LearningCurvePart,
    LinesPart,
    MeshesPart,
    ModesPart,
    Part,
    Point,
    Recognition,
    Still,
    TableColumn,
    TablePart,
    Target,
    TextPart,
    check_format,
    read,
    read_part,
)
from shapespace.types import Mesh

if TYPE_CHECKING:
    from shapespace.report.figures import Coefficients

FILE = "recognition.json"

SECTION_BYTES = 1_500_000
"""How much of a report of fits is kept free for this section."""

_MOST_PARTS, _MOST_ROWS, _MOST_COLUMNS, _MOST_TEXT, _MOST_PARAGRAPH = 120, 500, 30, 400, 2000
_PART_BYTES = 700_000
_TITLES = {
    "table": "Table",
    "confusion": "Confusion matrix",
    "calibration": "Calibration",
    "learning_curve": "Learning curve",
    "modes": "Modes that carry the decision",
    "face_map": "Regions of the face that carry the decision",
    "lines": "Lines through neutral",
    "meshes": "Meshes",
    "curve": "Curve",
    "text": "Notes",
}
_BESIDE = ("confusion", "calibration", "learning_curve", "modes", "face_map", "curve")
_CHAPTER = 2
_T = TypeVar("_T")
Drawn = tuple[Any, str, str]
"""A drawing, its caption where the part has no note, and what is seen in it."""


def is_study(folder: Folder) -> bool:
    """Return whether `folder` holds a recognition.json and no fit, so that there is nothing else to report.

    One without a format is a free collection of scores, which is no study.
    """
    return (folder.root / FILE).is_file() and not has_fits(folder) and "format" in _content(folder)


def study_page(folder: Folder, on_step: Step | None = None) -> str:
    """Return the report of a study alone.

    Args:
        folder: with a recognition.json.
        on_step: told of each picture.

    Raises:
        FileError: recognition.json cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder)
    pictured = [part for part in _raw_parts(content) if _raw(part, "kind") not in ("table", "text")]
    page = Page(max(len(pictured), 1), on_step)
    study = _Study(page, folder, content)
    name = folder.root.resolve().name
    made = f"shapespace {study.head['version']}".strip()
    if study.head["created"]:
        made += f", {moment(study.head['created'])}"
    beside = ", beside the targets that were set for it" if content.get("targets") else ""
    lead = [Text(f"What a study of recognition measured{beside}."), Text(f"{made}.", "soft")]
    chapters = [Chapter("Summary", study.summary)] if content.get("summary") or content.get("targets") else []
    for heading, make in study.chapters("Results", 3):
        chapters.append(Chapter(heading, make, heading if len(heading) <= 36 else f"{heading[:35]}…"))
    chapters.append(Chapter("Settings, versions and hashes", study.settings, "Settings"))
    title = study.head["title"] or f"Recognition study in {name}"
    return page.html(title, lead, f"Made by shapespace {__version__} from the files in {name}.", chapters)


def recognition_section(page: Page, folder: Folder) -> list[Block]:
    """Return what a study measured, as a section of the report of fits.

    Args:
        page: that it goes to.
        folder: with a recognition.json.

    Raises:
        FileError: recognition.json cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder)
    if "format" not in content:
        return sections.score_tables(content, many="Scores by class", single="Scores")
    study = _Study(page, folder, content)
    out: list[Block] = [Text(study.head["title"])] if study.head["title"] else []
    out += page.tried(study.summary)
    for heading, make in study.chapters("", 4):
        out += [page.section(heading, make)] if heading else page.tried(make)
    return [*out, Folded("Settings and versions of this study", page.tried(study.settings))]


def _content(folder: Folder) -> dict[str, Any]:
    return cast(dict[str, Any], _shortened(Folder(folder.root, STUDY_AGAIN).json(FILE)))


def _shortened(value: object, most: int = _MOST_TEXT) -> object:
    """Return JSON content whose texts are lines of bounded length."""
    if isinstance(value, str):
        line = " ".join(value.split())
        return line if len(line) <= most else f"{line[: most - 1]}…"
    if isinstance(value, list):
        return [_shortened(item, most) for item in cast(list[object], value)]
    if isinstance(value, dict):
        found = cast(dict[str, object], value)
        long = ("note", "text", "summary", "settings")
        return {
            str(_shortened(key)): _shortened(item, _MOST_PARAGRAPH if key in long else most)
            for key, item in found.items()
        }
    return value


def _raw(part: object, key: str) -> object:
    return cast(dict[str, object], part).get(key) if isinstance(part, dict) else None


def _raw_parts(content: Mapping[str, object]) -> list[object]:
    parts = content.get("parts")
    return cast(list[object], parts) if isinstance(parts, list) else []


def _title(part: object) -> str:
    title, kind = _raw(part, "title"), str(_raw(part, "kind"))
    return title[:200] if isinstance(title, str) and title else _TITLES.get(kind, "A part")


class _Study:
    """A study and the page that it goes to; each key of its file is read when it is shown."""

    def __init__(self, page: Page, folder: Folder, content: Mapping[str, Any]) -> None:
        check_format(content, Recognition, FILE, STUDY_AGAIN)
        self.page = page
        self.folder = Folder(folder.root, STUDY_AGAIN)
        self.content = content
        texts = {key: content.get(key) for key in ("title", "version", "created")}
        self.head = {key: text if isinstance(text, str) else "" for key, text in texts.items()}

    def _read(self, key: str, kind: type[_T]) -> _T:
        return read(kind, self.content.get(key), f"{FILE}: {key}", STUDY_AGAIN)

    def summary(self) -> list[Block]:
        """Return the sentences of the study, and what it aimed at beside what it reached."""
        out: list[Block] = []
        if self.content.get("summary"):
            out += self.page.tried(self.sentences)
        if self.content.get("targets"):
            out += self.page.tried(self.targets)
        return out

    def sentences(self) -> list[Block]:
        """Return the sentences of the study."""
        said = self.content["summary"]
        return _paragraphs(said if isinstance(said, str) else self._read("summary", tuple[str, ...]))

    def targets(self) -> Table:
        """Return the targets, each with what was reached."""
        targets = self._read("targets", tuple[Target, ...])
        met = [target.met for target in targets if target.met is not None]
        told = f"{sum(met)} of {counted(len(met), 'target')} met" if met else "Targets, and what was reached"
        if met and len(met) < len(targets):
            told += f", {len(targets) - len(met)} without a verdict"
        verdicts = {None: Cell(DASH), True: Cell("met", status="converged"), False: Cell("missed", status="failed")}
        rows = [
            [
                *(Cell(text or DASH) for text in (one.what, one.target, one.reached)),
                verdicts[one.met],
                Cell(one.note or DASH),
            ]
            for one in targets[:_MOST_ROWS]
        ]
        columns = [Column(head) for head in ("What", "Target", "Reached", "Verdict", "Note")]
        kept = 5 if any(one.note for one in targets) else 4
        return Table(columns[:kept], [row[:kept] for row in rows], f"{told}.", stack=True)

    def chapters(self, first: str, level: int) -> list[tuple[str, Make]]:
        """Return headings of chapters and what makes each; what stands before them goes under `first`.

        Args:
            first: heading of the parts before the first chapter.
            level: of the headings of parts inside a chapter.
        """
        if self.content.get("parts") is None:
            return []
        if not isinstance(self.content["parts"], list):
            return [(first or "Results", self.no_parts)]
        parts = _raw_parts(self.content)
        groups: list[tuple[str, list[object], list[object]]] = [(first, [], [])]
        for part in parts[:_MOST_PARTS]:
            if _raw(part, "level") == _CHAPTER:
                groups.append((_title(part), [part], []))
            else:
                groups[-1][2].append(part)
        if not groups[0][2]:
            groups = groups[1:]

        def make(heading: str, own: list[object], inner: list[object]) -> list[Block]:
            body = [block for part in own for block in self.body(part)]
            body += self.parts(inner, level if heading else level - 1)
            if inner is groups[-1][2] and len(parts) > _MOST_PARTS:
                body.append(Text(f"{len(parts) - _MOST_PARTS} parts are left out."))
            return body

        return [
            (heading, lambda heading=heading, own=own, inner=inner: make(heading, own, inner))
            for heading, own, inner in groups
        ]

    def no_parts(self) -> list[Block]:
        """Refuse parts that are no list."""
        raise _wrong("its parts are no list")

    def parts(self, parts: Sequence[object], level: int) -> list[Block]:
        """Return parts under their headings, charts that follow each other side by side."""
        out: list[Block] = []
        beside: list[Block] = []

        def flush() -> None:
            out.extend([Group("beside", beside.copy())] if len(beside) > 1 else beside)
            beside.clear()

        for part in parts:
            made = self.page.section(_title(part), lambda part=part: self.body(part), level)
            if _raw(part, "kind") not in _BESIDE:
                flush()
            beside.append(made)
            if _raw(part, "kind") not in _BESIDE:
                flush()
        flush()
        return out

    def body(self, part: object) -> Sequence[Block]:
        """Return a part without its heading, or why it is not shown."""
        too_large = [Text("This part would make this file larger than 8 MB, so it is left out.", "soft")]
        before = self.page.left
        if before < _PART_BYTES:
            return too_large
        made = self.page.tried(lambda: self.made(part))
        text = len(rendered(made).encode()) - (before - self.page.left)
        if text > self.page.left - _PART_BYTES // 2:
            return too_large
        self.page.spend(text)
        return made

    def made(self, part: object) -> list[Block]:
        """Return a part by its kind."""
        known = read_part(part, FILE)
        return _MAKERS[type(known)](self, known, _title(part), known.note or "")

    def drawn(self, drawing: Drawn, note: str, *, chart: bool = True) -> Figure:
        """Return a drawing with its caption, or the part's note in its place."""
        figure, about, alt = drawing
        return self.page.figure(figure, note or about, alt=alt, chart=chart)

    # Kinds of parts

    def text(self, part: TextPart, title: str, note: str) -> list[Block]:
        """Return paragraphs."""
        return [*_paragraphs(part.text), *([Text(note, "soft")] if note else [])]

    def table(self, part: TablePart, title: str, note: str) -> list[Block]:
        """Return a table that sorts."""
        if not 1 <= len(part.columns) <= _MOST_COLUMNS:
            raise _wrong(f"a table has {len(part.columns)} columns, not 1 to {_MOST_COLUMNS}")
        if any(len(row) != len(part.columns) for row in part.rows):
            raise _wrong(f"a row of a table has another number of cells than its {len(part.columns)} columns")
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
            [_cell(value, column) for value, column in zip(row, part.columns, strict=True)]
            for row in part.rows[:_MOST_ROWS]
        ]
        out: list[Block] = [Table(heads, cells, note or title, sortable=len(cells) > 1)]
        if len(part.rows) > _MOST_ROWS:
            out.append(Text(f"{counted(len(part.rows) - _MOST_ROWS, 'other row')} are left out."))
        return out

    def confusion(self, part: ConfusionPart, title: str, note: str) -> list[Block]:
        """Return a confusion matrix as a picture, and folded away as a table."""
        from shapespace.report import figures

        classes = part.classes
        if {len(row) for row in part.counts} - {len(classes)}:
            raise _wrong(f"a confusion matrix of {len(classes)} classes has rows of another length")
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
        """Return how well stated probabilities hold."""
        from shapespace.report import figures

        low, high, confidence, accuracy, count = (
            np.array(
                [(one.low, one.high, one.confidence, one.accuracy, one.count) for one in part.bins], dtype=np.float64
            )
            .reshape(-1, 5)
            .T
        )
        figure = figures.calibration_figure(low, high, confidence, accuracy, count, ece=part.ece, brier=part.brier)
        told = [
            f"stated {percent(c)}, right {percent(a)}"
            for c, a, n in zip(confidence, accuracy, count, strict=True)
            if n > 0
        ]
        said = "" if part.ece is None else f"; expected calibration error {100 * part.ece:.1f} points"
        about = (
            "How often answers are right, against the probability stated for them: under the dashed line they are "
            "right less often than stated. Larger dots stand for more answers, which the bars count."
        )
        alt = f"Calibration: {listed(told, 20)}{said}"
        return [self.page.figure(figure, f"{note} {about}".strip(), alt=alt, chart=True)]

    def learning_curve(self, part: LearningCurvePart, title: str, note: str) -> list[Block]:
        """Return the accuracy against how many people were learned from."""
        from shapespace.report import figures

        low, high = (None if ends is None else np.array(ends, dtype=np.float64) for ends in (part.low, part.high))
        figure = figures.learning_curve_figure(
            part.subjects, part.mean, low=low, high=high, band=part.band or "interval", ceiling=part.ceiling
        )
        told = [
            f"{100 * mean:.1f} % from {count:g} people" for count, mean in zip(part.subjects, part.mean, strict=True)
        ]
        said = "" if part.ceiling is None else f"; ceiling {100 * part.ceiling:.1f} %"
        about = "Share of right answers on people who were not learned from, against how many were."
        return [self.drawn((figure, about, f"Learning curve: {listed(told, 20)}{said}"), note)]

    def modes(self, part: ModesPart, title: str, note: str) -> list[Block]:
        """Return how much each mode carries of the decision."""
        from shapespace.report import figures

        values, unit = part.importance, part.unit
        figure = figures.importance_figure(values, part.names, unit=unit)
        called = part.names or [f"mode {k + 1}" for k in range(len(values))]
        ranked = sorted(zip(values, called, strict=True), key=lambda pair: -pair[0])
        told = listed([f"{name} {value:.3g}" for value, name in ranked[:10]])
        alt = f"Importance of {counted(len(values), 'mode')} in {unit}, the largest: {told}"
        return [self.drawn((figure, f"How much each mode carries of the decision, in {unit}.", alt), note)]

    def face_map(self, part: FaceMapPart, title: str, note: str) -> list[Block]:
        """Return where on the face the decision lies, and the share of each region."""
        from shapespace.report import figures

        arrays = self.folder.arrays(part.arrays)
        names = (part.vertices, part.faces, part.values)
        absent = [name for name in names if name not in arrays]
        if absent:
            raise FileFormatError(f"{part.arrays} holds no array {absent[0]!r}; {STUDY_AGAIN}.")
        vertices, faces, values = (arrays[name] for name in names)
        numbers = all(array.dtype.kind in "iuf" for array in (vertices, values))
        if not numbers or faces.dtype.kind not in "iu" or vertices.ndim != 2 or not np.isfinite(vertices).all():
            raise _wrong("the arrays of a map are no places, triangles and numbers")
        shares = sorted(part.regions.items(), key=lambda item: -item[1])
        figure = figures.face_map_figure(vertices.astype(float), faces, values, unit=part.unit, regions=dict(shares))
        told = listed([f"{name} {percent(share)}" for name, share in shares], 30)
        alt = f"The face from the front and from aside, coloured by {part.unit}{f'; by region: {told}' if told else ''}"
        out: list[Block] = [
            self.drawn((figure, f"Where on the face the decision lies: {part.unit}.", alt), note, chart=False)
        ]
        if shares:
            rows = [[Cell(name), Cell(f"{100 * share:.1f} %", share)] for name, share in shares[:_MOST_ROWS]]
            heads = [Column("Region"), Column("Share of the decision", "number")]
            out.append(Folded("The shares as a table", [Table(heads, rows, title)]))
        return out

    def lines(self, part: LinesPart, title: str, note: str) -> list[Block]:
        """Return the lines of the expressions in the first coefficients (figures 9 and 10 of the paper)."""
        points = list(map(_coefficients, part.points))
        neutral = _coefficients(part.neutral) if part.neutral else None
        if not points or len({len(point.b) for point in (*points, *([neutral] if neutral else []))}) != 1:
            raise _wrong("the points of lines must be one or more, all with as many coefficients as the neutral face")
        lines = sections.lines_through_neutral(self.page, points, neutral)
        return [*([Text(note)] if note else []), lines]

    def meshes(self, part: MeshesPart, title: str, note: str) -> list[Block]:
        """Return stills of meshes in rows; one that cannot be read leaves a grey field and says why."""
        from shapespace.report import figures

        problems: list[str] = []

        def mesh(entry: Still) -> Mesh | None:
            try:
                found = self.folder.mesh(entry.file)
                if not len(found.vertices) or not np.isfinite(found.vertices).all():
                    raise _wrong(f"the mesh {entry.file!r} has no vertices, or some that are not finite")
                return found
            except ShapespaceError as error:
                problems.append(f"{entry.label}: {error}")
                return None

        rows = [(row.label, [(entry.label, mesh(entry)) for entry in row.meshes]) for row in part.rows]
        if problems and len(problems) == sum(len(pictures) for _, pictures in rows):
            return [Notice("None of these meshes can be shown", problems, "broken")]
        told = [f"{heading}: {listed([label for label, _ in pictures])}" for heading, pictures in rows]
        drawing = (
            figures.mesh_rows_figure(rows, title=title),
            "One camera, one light and one scale for all.",
            "; ".join(told)[:_MOST_PARAGRAPH] or title,
        )
        return [self.drawn(drawing, note, chart=False), Notice("Not in the picture", problems, "broken")]

    def curve(self, part: CurvePart, title: str, note: str) -> list[Block]:
        """Return one measure against another."""
        from shapespace.report import figures

        x, y = part.x or "x", part.y or "y"
        figure = figures.curve_figure([(one.label, one.x, one.y) for one in part.series], x=x, y=y)
        told = [
            f"{one.label or y} from {one.y[0]:.3g} at {one.x[0]:g} to {one.y[-1]:.3g} at {one.x[-1]:g}"
            for one in part.series
        ]
        about = f"{y[:1].upper()}{y[1:]} against {x}."
        return [self.drawn((figure, about, f"{about} {listed(told)}"), note)]

    def settings(self) -> list[Block]:
        """Return with what the study was made."""
        rows = [("Report", f"shapespace {__version__}")]
        if self.head["version"]:
            rows.append(("Study", f"shapespace {self.head['version']}"))
        if self.head["created"]:
            rows.append(("Made", moment(self.head["created"])))
        out: list[Block] = [Facts(rows, "Made with")]
        for key, caption in (("settings", "Settings"), ("versions", "Versions")):
            if self.content.get(key) is not None:
                out += self.page.tried(
                    lambda key=key, caption=caption: facts_of(self._read(key, dict[str, object]), caption)
                )
        if self.content.get("model_hashes"):
            out += self.page.tried(self.hashes)
        return out

    def hashes(self) -> Folded:
        """Return the hashes of the models that took part."""
        found = self._read("model_hashes", tuple[str, ...])
        rows = [[str(k), one] for k, one in enumerate(found[:_MOST_ROWS], 1)]
        table = text_table(("Model", "Hash"), rows, "Content hashes of the models")
        return Folded(f"Content hashes (SHA-256) of {counted(len(found), 'model')}", [table])


_MAKERS: Mapping[type[Part], Callable[[_Study, Any, str, str], list[Block]]] = {
    kind: getattr(_Study, name) for name, kind in PARTS.items()
}


def _wrong(what: str) -> FileFormatError:
    return FileFormatError(f"{FILE} is damaged: {what}; {STUDY_AGAIN}.")


def _paragraphs(said: str | tuple[str, ...]) -> list[Block]:
    return [Text(text) for text in ((said,) if isinstance(said, str) else said)[:_MOST_ROWS]]


def _coefficients(point: Point) -> Coefficients:
    from shapespace.report.figures import Coefficients

    if len(point.b) != len(point.z):
        raise _wrong(
            f"a point of lines has {len(point.b)} coefficients in mm but {len(point.z)} in standard deviations"
        )
    return Coefficients(point.label, point.expression, point.intensity or 0.0, np.array(point.b), np.array(point.z))


def _cell(value: object, column: TableColumn) -> Cell:
    """Return a cell of a table by the kind of its column."""
    where = f"{FILE}: the column {column.name!r}"
    if column.kind == "text":
        return Cell(DASH if value in (None, "") else str(value))
    if value is None:
        return Cell(DASH, float("nan"))
    if column.kind == "interval":
        low, high = read(tuple[float, float], value, where, STUDY_AGAIN)
        return Cell(f"{100 * low:.1f} to {100 * high:.1f} %", low)
    found = read(float, value, where, STUDY_AGAIN)
    if column.kind == "mm":
        return length(found)
    told = {
        "percent": f"{100 * found:.1f} %",
        "p": "< 0.001" if found < 0.001 else f"{found:.3f}",
        "count": f"{found:,.0f}",
        "number": f"{found:,.0f}" if abs(found) >= 1000 else f"{found:.3g}",
    }
    return Cell(told[column.kind], found)
