"""What a study of recognition measured, from its recognition.json: a section of a report, or a report of its own.

The file names the parts in the order in which they are shown; what is absent is not shown, and what is damaged says so
in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from shapespace import __version__
from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.report import sections
from shapespace.report.markup import (
    DASH,
    Cell,
    Column,
    as_list,
    as_mapping,
    counted,
    esc,
    facts,
    folded,
    length,
    listed,
    moment,
    notice,
    paragraph,
    percent,
    plain,
    table,
    words,
)
from shapespace.report.page import Page, Section, Step
from shapespace.report.saved import Folder, has_fits
from shapespace.types import FloatArray, Mesh

if TYPE_CHECKING:
    from shapespace.report.figures import Coefficients

FILE = "recognition.json"
FORMAT, FORMAT_VERSION = "shapespace recognition", 1
ADVICE = "run shapespace recognise study again"

SECTION_BYTES = 1_500_000
"""How much of a report of fits is kept free for this section."""

_MOST_PARTS, _MOST_ROWS, _MOST_COLUMNS, _MOST_TEXT = 120, 500, 30, 2000
_PART_BYTES = 700_000
_KINDS = {
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


def is_recognition(content: Mapping[str, Any]) -> bool:
    """Return whether `content` of a recognition.json names a format; without one it is a free collection of scores."""
    return "format" in content


def is_study(folder: Folder) -> bool:
    """Return whether `folder` holds a recognition.json and no fit, so that there is nothing else to report.

    Free scores without fits are no study.
    """
    if not (folder.root / FILE).is_file() or has_fits(folder):
        return False
    return is_recognition(Folder(folder.root, ADVICE).json(FILE))


def study_page(folder: Folder, on_step: Step | None = None) -> str:
    """Return the report of a study alone.

    Args:
        folder: with a recognition.json.
        on_step: told of each picture.

    Raises:
        FileError: recognition.json cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _read(folder)
    page = Page(ADVICE, _planned(content), on_step)
    study = _Study(page, folder, content)
    name = folder.root.resolve().name
    title = _line(content.get("title")) or f"Recognition study in {name}"
    made = f"shapespace {_line(content.get('version'))}".strip()
    if content.get("created"):
        made += f", {_line(moment(content['created']))}"
    beside = ", beside the targets that were set for it" if content.get("targets") else ""
    lead = paragraph(f"What a study of recognition measured{beside}.")
    lead += paragraph(f"{made}.", "soft")
    parts: list[Section] = []
    if study.has_summary:
        parts.append(Section("Summary", "Summary", study.summary))
    for heading, make in study.chapters("Results", 3):
        parts.append(Section(heading, heading if len(heading) <= 36 else f"{heading[:35]}…", make))
    parts.append(Section("Settings, versions and hashes", "Settings", study.settings))
    return page.html(title, lead, f"Made by shapespace {__version__} from the files in {name}.", parts)


def recognition_section(page: Page, folder: Folder) -> str:
    """Return what a study measured, as a section of the report of fits.

    Args:
        page: that it goes to.
        folder: with a recognition.json.

    Raises:
        FileError: recognition.json cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    folder = Folder(folder.root, ADVICE)
    content = folder.json(FILE)
    if not is_recognition(content):
        return sections.score_tables(content, many="Scores by class", single="Scores")
    study = _Study(page, folder, _checked(content))
    title = _line(content.get("title"))
    out = (paragraph(title) if title else "") + page.tried(study.summary)
    for heading, make in study.chapters("", 4):
        out += page.guarded(heading, make) if heading else make()
    return out + folded("Settings and versions of this study", page.tried(study.settings))


def _read(folder: Folder) -> Mapping[str, Any]:
    return _checked(Folder(folder.root, ADVICE).json(FILE))


def _checked(content: Mapping[str, Any]) -> Mapping[str, Any]:
    if content.get("format") != FORMAT:
        raise FileFormatError(f"{FILE} is not the result of a study of recognition ({FORMAT!r}); {ADVICE}.")
    if content.get("format_version") != FORMAT_VERSION:
        raise FileFormatError(
            f"{FILE} has the format version {_line(content.get('format_version'))}, of which this version of "
            f"shapespace knows only {FORMAT_VERSION}; update shapespace, or {ADVICE}."
        )
    return content


def _planned(content: Mapping[str, Any]) -> int:
    pictured = [part for part in as_list(content.get("parts")) if as_mapping(part).get("kind") not in ("table", "text")]
    return max(len(pictured), 1)


class _Study:
    """A study and the page that it goes to."""

    def __init__(self, page: Page, folder: Folder, content: Mapping[str, Any]) -> None:
        self.page = page
        self.folder = Folder(folder.root, ADVICE)
        self.content = content
        self._kinds: Mapping[str, Callable[[Mapping[str, Any], str], str]] = {
            "table": self.table,
            "confusion": self.confusion,
            "calibration": self.calibration,
            "learning_curve": self.learning_curve,
            "modes": self.modes,
            "face_map": self.face_map,
            "lines": self.lines,
            "meshes": self.meshes,
            "curve": self.curve,
            "text": self.text,
        }

    @property
    def has_summary(self) -> bool:
        """Whether there is anything to say at the top."""
        return bool(self.content.get("summary") or self.content.get("targets"))

    def summary(self) -> str:
        """Return the sentences of the study, and what it aimed at beside what it reached."""
        said = self.content.get("summary")
        out = self.page.tried(lambda: _paragraphs(said, "summary")) if said else ""
        return out + (self.page.tried(self.targets) if self.content.get("targets") else "")

    def targets(self) -> str:
        """Return the targets, each with what was reached."""
        rows: list[list[Cell]] = []
        met: list[bool] = []
        notes = False
        for target in _list(self.content.get("targets"), "targets"):
            known = _object(target, "a target")
            verdict = known.get("met")
            if verdict is not None and not isinstance(verdict, bool):
                raise _wrong(f"the target {_line(known.get('what'))!r} says neither true nor false of being met")
            if verdict is not None:
                met.append(verdict)
            notes |= bool(known.get("note"))
            rows.append([Cell(_line(known.get(key)) or DASH) for key in ("what", "target", "reached")])
            rows[-1] += [_verdict(verdict), Cell(_line(known.get("note")) or DASH)]
        columns = [Column(head) for head in ("What", "Target", "Reached", "Verdict", "Note")]
        told = f"{sum(met)} of {counted(len(met), 'target')} met" if met else "Targets, and what was reached"
        if met and len(met) < len(rows):
            told += f", {len(rows) - len(met)} without a verdict"
        kept = len(columns) if notes else len(columns) - 1
        return table(columns[:kept], [row[:kept] for row in rows[:_MOST_ROWS]], caption=f"{told}.", stack=True)

    def chapters(self, first: str, level: int) -> list[tuple[str, Callable[[], str]]]:
        """Return headings of chapters and what makes each; what stands before them goes under `first`.

        Args:
            first: heading of the parts before the first chapter.
            level: of the headings of parts inside a chapter.
        """
        found = self.content.get("parts")
        if found is None:
            return []
        if not isinstance(found, list):
            return [(first or "Results", lambda: self.page.tried(lambda: _paragraphs(found, "parts")))]
        parts = cast(list[Any], found)
        groups: list[tuple[str, Any, list[Any]]] = [(first, None, [])]
        for part in parts[:_MOST_PARTS]:
            if as_mapping(part).get("level") == _CHAPTER:
                groups.append((_title(part), part, []))
            else:
                groups[-1][2].append(part)
        if not groups[0][2]:
            groups = groups[1:]

        def make(heading: str, own: Any, inner: list[Any]) -> str:
            body = "" if own is None else self.body(own)
            body += self.parts(inner, level if heading else level - 1)
            last = inner is groups[-1][2] and len(parts) > _MOST_PARTS
            return body + (paragraph(f"{len(parts) - _MOST_PARTS} parts are left out.") if last else "")

        return [
            (heading, lambda heading=heading, own=own, inner=inner: make(heading, own, inner))
            for heading, own, inner in groups
        ]

    def parts(self, parts: Sequence[Any], level: int) -> str:
        """Return parts under their headings, charts that follow each other side by side."""
        out = ""
        beside: list[str] = []

        def flush() -> str:
            held, count = "\n".join(beside), len(beside)
            beside.clear()
            return f'<div class="beside">{held}</div>\n' if count > 1 else held

        for part in parts:
            made = self.page.guarded(_title(part), lambda part=part: self.body(part), level)
            if as_mapping(part).get("kind") in _BESIDE:
                beside.append(made)
            else:
                out += flush() + made
        return out + flush()

    def body(self, part: Any) -> str:
        """Return a part without its heading, or why it is not shown."""
        too_large = paragraph("This part would make this file larger than 8 MB, so it is left out.", "soft")
        if self.page.left < _PART_BYTES:
            return too_large
        before = self.page.left
        made = self.page.tried(lambda: self.made(part))
        text = len(made.encode()) - (before - self.page.left)
        if text > self.page.left - _PART_BYTES // 2:
            return too_large
        self.page.spend(text)
        return made

    def made(self, part: Any) -> str:
        """Return a part by its kind."""
        known = _object(part, "a part")
        kind = known.get("kind")
        if not isinstance(kind, str) or kind not in self._kinds:
            raise _wrong(f"it has a part of the kind {_line(kind) or 'none'!r}, which this version does not know")
        return self._kinds[kind](known, _line(known.get("note"), _MOST_TEXT))

    # Kinds of parts

    def text(self, part: Mapping[str, Any], note: str) -> str:
        """Return paragraphs."""
        return _paragraphs(part.get("text"), "text") + (paragraph(note, "soft") if note else "")

    def table(self, part: Mapping[str, Any], note: str) -> str:
        """Return a table that sorts."""
        columns = [_object(column, "a column") for column in _list(part.get("columns"), "columns")]
        if not 1 <= len(columns) <= _MOST_COLUMNS:
            raise _wrong(f"a table has {len(columns)} columns, not 1 to {_MOST_COLUMNS}")
        rows = _list(part.get("rows"), "rows")
        kinds = [str(column.get("kind") or "text") for column in columns]
        names = [_line(column.get("name")) for column in columns]
        heads = [
            Column(
                f"{name} (mm)" if kind == "mm" and "mm" not in name.split() and "(mm)" not in name else name,
                "text" if kind == "text" else "number",
            )
            for name, kind in zip(names, kinds, strict=True)
        ]
        cells: list[list[Cell]] = []
        for row in rows[:_MOST_ROWS]:
            values = _list(row, "a row")
            if len(values) != len(columns):
                raise _wrong(f"a row of a table has {len(values)} cells but there are {len(columns)} columns")
            cells.append([_cell(value, kind, name) for value, kind, name in zip(values, kinds, names, strict=True)])
        out = table(heads, cells, caption=note or _title(part), sortable=len(cells) > 1)
        if len(rows) > _MOST_ROWS:
            out += paragraph(f"{counted(len(rows) - _MOST_ROWS, 'other row')} are left out.")
        return out

    def confusion(self, part: Mapping[str, Any], note: str) -> str:
        """Return a confusion matrix as a picture, and folded away as a table."""
        from shapespace.report import figures

        classes = [_line(name) for name in _list(part.get("classes"), "classes")]
        counts = _array(part.get("counts"), "counts", ndim=2)
        figure = figures.confusion_figure(counts, classes)
        total = counts.sum(axis=1)
        right = [f"{name} {percent(float(counts[k, k] / total[k]))}" for k, name in enumerate(classes) if total[k] > 0]
        out = self.page.figure(
            figure,
            f"{note} Rows: the true class. Columns: the predicted class. Percent of the row, and below it how many; "
            "an empty cell is none. Framed: right answers.".strip(),
            alt=f"Confusion matrix of {counted(len(classes), 'class', 'classes')}; right answers: {listed(right, 40)}",
            chart=True,
        )
        rows = [
            [
                Cell(name),
                *(Cell(f"{value:g} ({percent(float(value / total[k]))})" if total[k] else DASH) for value in counts[k]),
            ]
            for k, name in enumerate(classes)
        ]
        heads = [Column("True class"), *(Column(f"predicted {name}", "number") for name in classes)]
        return out + folded("The same as a table", table(heads, rows, caption=f"Confusion matrix: {_title(part)}"))

    def calibration(self, part: Mapping[str, Any], note: str) -> str:
        """Return how well stated probabilities hold."""
        from shapespace.report import figures

        bins = [_object(one, "a bin") for one in _list(part.get("bins"), "bins")]
        low, high, confidence, accuracy, count = (
            _array([one.get(key) for one in bins], key, finite=False)
            for key in ("low", "high", "confidence", "accuracy", "count")
        )
        ece, brier = _optional(part.get("ece"), "ece"), _optional(part.get("brier"), "brier")
        told = [
            f"stated {percent(c)}, right {percent(a)}"
            for c, a, n in zip(confidence, accuracy, count, strict=True)
            if n > 0
        ]
        said = "" if ece is None else f"; expected calibration error {100 * ece:.1f} points"
        return self.page.figure(
            figures.calibration_figure(low, high, confidence, accuracy, count, ece=ece, brier=brier),
            f"{note} How often answers are right, against the probability stated for them: under the dashed line they "
            "are right less often than stated. Larger dots stand for more answers, which the bars count.".strip(),
            alt=f"Calibration: {listed(told, 20)}{said}",
            chart=True,
        )

    def learning_curve(self, part: Mapping[str, Any], note: str) -> str:
        """Return the accuracy against how many people were learned from."""
        from shapespace.report import figures

        subjects, mean = _array(part.get("subjects"), "subjects"), _array(part.get("mean"), "mean")
        low, high = (
            None if part.get(key) is None else _array(part.get(key), key, finite=False) for key in ("low", "high")
        )
        ceiling = _optional(part.get("ceiling"), "ceiling")
        band = _line(part.get("band")) or "interval"
        figure = figures.learning_curve_figure(subjects, mean, low=low, high=high, band=band, ceiling=ceiling)
        told = [f"{100 * value:.1f} % from {count:g} people" for count, value in zip(subjects, mean, strict=True)]
        said = "" if ceiling is None else f"; ceiling {100 * ceiling:.1f} %"
        about = "Share of right answers on people who were not learned from, against how many were."
        return self.page.figure(figure, note or about, alt=f"Learning curve: {listed(told, 20)}{said}", chart=True)

    def modes(self, part: Mapping[str, Any], note: str) -> str:
        """Return how much each mode carries of the decision."""
        from shapespace.report import figures

        values = _array(part.get("importance"), "importance")
        names = [_line(name) for name in as_list(part.get("names"))]
        unit = _line(part.get("unit")) or "importance"
        figure = figures.importance_figure(values, names, unit=unit)
        called = names or [f"mode {k + 1}" for k in range(len(values))]
        order = np.argsort(-values, kind="stable")[:10]
        told = [f"{called[k]} {values[k]:.3g}" for k in order]
        return self.page.figure(
            figure,
            note or f"How much each mode carries of the decision, in {unit}.",
            alt=f"Importance of {counted(len(values), 'mode')} in {unit}, the largest: {listed(told)}",
            chart=True,
        )

    def face_map(self, part: Mapping[str, Any], note: str) -> str:
        """Return where on the face the decision lies, and the share of each region."""
        from shapespace.report import figures

        arrays = self.folder.arrays(part.get("arrays"))
        vertices, faces, values = (
            _member(arrays, part.get(key) or key, str(part.get("arrays"))) for key in ("vertices", "faces", "values")
        )
        shares = {
            _line(name): _number(share, "a share of a region")
            for name, share in as_mapping(part.get("regions")).items()
        }
        unit = _line(part.get("unit")) or "share of the decision"
        if not np.issubdtype(faces.dtype, np.integer):
            raise _wrong("the faces of a map hold no whole numbers")
        figure = figures.face_map_figure(
            _array(vertices, "vertices", ndim=2),
            faces,
            _array(values, "values", finite=False),
            unit=unit,
            regions=shares,
        )
        ranked = sorted(shares.items(), key=lambda item: -item[1])
        told = listed([f"{name} {percent(share)}" for name, share in ranked], 30)
        out = self.page.figure(
            figure,
            note or f"Where on the face the decision lies: {unit}.",
            alt=f"The face from the front and from aside, coloured by {unit}"
            + (f"; by region: {told}" if told else ""),
        )
        if not ranked:
            return out
        rows = [[Cell(name), Cell(f"{100 * share:.1f} %", share)] for name, share in ranked]
        heads = [Column("Region"), Column("Share of the decision", "number")]
        return out + folded("The shares as a table", table(heads, rows[:_MOST_ROWS], caption=_title(part)))

    def lines(self, part: Mapping[str, Any], note: str) -> str:
        """Return the lines of the expressions in the first coefficients (figures 9 and 10 of the paper)."""
        points = [_coefficients(_object(one, "a point")) for one in _list(part.get("points"), "points")]
        if not points or len({len(point.b) for point in points}) != 1:
            raise _wrong("the points of lines must be one or more, all with the same number of coefficients")
        neutral = None
        if part.get("neutral") is not None:
            neutral = _coefficients(_object(part.get("neutral"), "neutral"))
            if len(neutral.b) != len(points[0].b):
                raise _wrong("the neutral face of lines has another number of coefficients than the points")
        out = sections.lines_through_neutral(self.page, points, neutral)
        return (paragraph(note) if note else "") + out

    def meshes(self, part: Mapping[str, Any], note: str) -> str:
        """Return stills of meshes in rows; one that cannot be read leaves a grey field and says why."""
        from shapespace.report import figures

        problems: list[str] = []

        def mesh(entry: Mapping[str, Any]) -> Mesh | None:
            try:
                found = self.folder.mesh(entry.get("file"))
                if not len(found.vertices) or not np.isfinite(found.vertices).all():
                    raise _wrong(f"the mesh {_line(entry.get('file'))!r} has no vertices, or some that are not finite")
                return found
            except ShapespaceError as error:
                problems.append(f"{_line(entry.get('label'))}: {error}")
                return None

        rows: list[tuple[str, list[tuple[str, Mesh | None]]]] = []
        for row in _list(part.get("rows"), "rows"):
            known = _object(row, "a row of meshes")
            entries = [_object(entry, "a mesh") for entry in _list(known.get("meshes"), "meshes")]
            rows.append((_line(known.get("label")), [(_line(entry.get("label")), mesh(entry)) for entry in entries]))
        if problems and len(problems) == sum(len(pictures) for _, pictures in rows):
            return notice("None of these meshes can be shown", problems, "broken")
        told = [f"{heading}: {listed([label for label, _ in pictures])}" for heading, pictures in rows]
        out = self.page.figure(
            figures.mesh_rows_figure(rows, title=_title(part)),
            note or "One camera, one light and one scale for all.",
            alt="; ".join(told)[:_MOST_TEXT] or _title(part),
        )
        return out + notice("Not in the picture", problems, "broken")

    def curve(self, part: Mapping[str, Any], note: str) -> str:
        """Return one measure against another."""
        from shapespace.report import figures

        x, y = _line(part.get("x")) or "x", _line(part.get("y")) or "y"
        series: list[tuple[str, FloatArray, FloatArray]] = []
        for one in _list(part.get("series"), "series"):
            known = _object(one, "a series")
            series.append((_line(known.get("label")), _array(known.get("x"), "x"), _array(known.get("y"), "y")))
        figure = figures.curve_figure(series, x=x, y=y)
        told = [f"{name or y} from {ys[0]:.3g} at {xs[0]:g} to {ys[-1]:.3g} at {xs[-1]:g}" for name, xs, ys in series]
        about = f"{y[:1].upper()}{y[1:]} against {x}."
        return self.page.figure(figure, note or about, alt=f"{about} {listed(told)}", chart=True)

    def settings(self) -> str:
        """Return with what the study was made."""
        rows = [("Report", f"shapespace {__version__}")]
        if self.content.get("version"):
            rows.append(("Study", f"shapespace {_line(self.content['version'])}"))
        if self.content.get("created"):
            rows.append(("Made", _line(moment(self.content["created"]))))
        out = facts(rows, caption="Made with")
        for key, caption in (("settings", "Settings"), ("versions", "Versions")):
            if self.content.get(key) is not None:
                out += self.page.tried(lambda key=key, caption=caption: self.pairs(key, caption))
        if self.content.get("model_hashes"):
            out += self.page.tried(self.hashes)
        return out

    def pairs(self, key: str, caption: str) -> str:
        """Return a table of names and values."""
        known = _object(self.content.get(key), f"{key!r}")
        rows = [
            (_line(words(name)), _line(sections.setting(value), _MOST_TEXT))
            for name, value in list(known.items())[:_MOST_ROWS]
        ]
        return facts(rows, caption=caption)

    def hashes(self) -> str:
        """Return the hashes of the models that took part."""
        found = [_line(one) for one in _list(self.content.get("model_hashes"), "model_hashes")]
        rows = [[Cell(str(k + 1)), Cell(one)] for k, one in enumerate(found[:_MOST_ROWS])]
        return folded(
            f"Content hashes (SHA-256) of {counted(len(found), 'model')}",
            table([Column("Model"), Column("Hash")], rows, caption="Content hashes of the models", stack=True),
        )


# Reading


def _wrong(what: str) -> FileFormatError:
    return FileFormatError(f"{FILE} is damaged: {what}; {ADVICE}.")


def _line(value: object, most: int = 400) -> str:
    """Return a text of the file in one line of bounded length, empty for none."""
    if value is None:
        return ""
    text = " ".join((value if isinstance(value, str) else plain(value)).split())
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _title(part: Any) -> str:
    known = as_mapping(part)
    kind = known.get("kind")
    return _line(known.get("title"), 200) or _KINDS.get(kind if isinstance(kind, str) else "", "A part")


def _list(value: object, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise _wrong(f"there is no list where {what} should be")
    return cast(list[Any], value)


def _object(value: object, what: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _wrong(f"there is no object where {what} should be")
    return cast(Mapping[str, Any], value)


def _paragraphs(value: object, what: str) -> str:
    found = [value] if isinstance(value, str) else _list(value, what)
    if not all(isinstance(text, str) for text in found):
        raise _wrong(f"{what!r} holds something other than sentences")
    return "".join(paragraph(_line(text, _MOST_TEXT)) for text in found[:_MOST_ROWS])


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(f"there is no number where {what} should be")
    return float(value)


def _optional(value: object, what: str) -> float | None:
    return None if value is None else _number(value, what)


def _array(value: object, what: str, *, ndim: int = 1, finite: bool = True) -> FloatArray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _wrong(f"{what!r} does not hold numbers") from error
    if array.ndim != ndim or (finite and not np.isfinite(array).all()):
        raise _wrong(f"{what!r} is no {'list' if ndim == 1 else 'table'} of finite numbers")
    return array


def _member(arrays: Mapping[str, Any], name: object, file: str) -> Any:
    if not isinstance(name, str) or name not in arrays:
        raise FileFormatError(f"{_line(file)} holds no array {_line(name)!r}; {ADVICE}.")
    return arrays[name]


def _coefficients(point: Mapping[str, Any]) -> Coefficients:
    from shapespace.report.figures import Coefficients

    b, z = _array(point.get("b"), "b"), _array(point.get("z"), "z")
    if b.shape != z.shape:
        raise _wrong(f"a point of lines has {len(b)} coefficients in mm but {len(z)} in standard deviations")
    strength = _optional(point.get("intensity"), "an intensity") or 0.0
    return Coefficients(_line(point.get("label")), _line(point.get("expression")), strength, b, z)


def _verdict(met: bool | None) -> Cell:
    if met is None:
        return Cell(DASH)
    word, kind = ("met", "converged") if met else ("missed", "failed")
    return Cell(word, None, f'<span class="status {kind}">{esc(word)}</span>')


def _cell(value: object, kind: str, name: str) -> Cell:
    """Return a cell of a table by the kind of its column."""
    if kind == "text":
        return Cell(_line(value) or DASH)
    if value is None:
        return Cell(DASH, float("nan"))
    if kind == "interval":
        ends = [_number(end, f"an end of the interval {name!r}") for end in _list(value, f"the interval {name!r}")]
        if len(ends) != 2:
            raise _wrong(f"an interval in the column {name!r} has {len(ends)} ends, not 2")
        return Cell(f"{100 * ends[0]:.1f} to {100 * ends[1]:.1f} %", ends[0])
    number = _number(value, f"a value of the column {name!r}")
    if kind == "percent":
        return Cell(f"{100 * number:.1f} %", number)
    if kind == "mm":
        return length(number)
    if kind == "p":
        return Cell("< 0.001" if number < 0.001 else f"{number:.3f}", number)
    if kind == "count":
        return Cell(f"{number:,.0f}", number)
    if kind == "number":
        return Cell(f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.3g}", number)
    raise _wrong(f"the column {name!r} has the kind {_line(kind)!r}, which this version does not know")
