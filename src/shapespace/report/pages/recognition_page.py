"""The report of a recognition study or an analysis: a section of a report, or a page of its own.

The file lists the parts in order. A damaged part is replaced by an error message.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

from shapespace.report.blocks import fit_tables as tables
from shapespace.report.blocks.blocks import (
    Block,
    Cell,
    Column,
    Command,
    Facts,
    Folded,
    Group,
    Notice,
    Table,
    Text,
    facts_of,
    text_table,
)
from shapespace.report.blocks.wording import DASH, counted, listed, moment, printable, without_folders
from shapespace.report.inputs.saved_fits import Folder, has_fits
from shapespace.report.pages.page import Chapter, Make, Page, Step, rendered
from shapespace.report.pages.study_parts import (
    ANALYSIS,
    MOST_PARAGRAPH,
    MOST_ROWS,
    STUDY,
    TITLES,
    PartsFile,
    StudyParts,
    paragraphs,
)
from shapespace.schemas import Orientation, Target, check_format, read, read_part
from shapespace.version import __version__

SECTION_BYTES = 1_500_000
"""Bytes of a report of fits that are reserved for this section."""

MOST_ANALYSES = 12
"""How many analyses a report of fits shows."""

# parts of a study, and characters of a damaged value, that a page shows: bounds its length
_MOST_PARTS, _MOST_TEXT = 120, 400
_PART_BYTES = 700_000  # bytes that one part of a study takes with its figures
_MOST_NOTES = 40  # notes on the page; the file has all
_BESIDE = ("confusion", "calibration", "learning_curve", "curve", "histogram")
"""Kinds of parts that share the page's width with their neighbour; the views of a surface map need all of it."""
_CHAPTER = 2  # level of parts that begin a chapter (`Part` in schemas)
_T = TypeVar("_T")


def standalone_file(folder: Folder) -> PartsFile | None:
    """Return what `folder` holds where it holds no fit, so that there is nothing else to report; None for neither.

    A file without a format is a free collection of scores, which is no study.
    """
    there = [parts_file for parts_file in (STUDY, ANALYSIS) if (folder.root / parts_file.file).is_file()]
    if not there or has_fits(folder):
        return None
    return next((parts_file for parts_file in there if "format" in _content(folder, parts_file)), None)


def study_page(folder: Folder, parts_file: PartsFile, on_step: Step | None = None) -> str:
    """Return the report of a study or an analysis alone.

    Args:
        folder: with its file.
        parts_file: which of them it is.
        on_step: called after each picture.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder, parts_file)
    pictured = [part for part in _raw_parts(content) if _raw(part, "kind") not in ("table", "text")]
    page = Page(max(len(pictured), 1), on_step)
    study = _Study(page, folder, parts_file, content)
    name = folder.root.resolve().name
    provenance = f"shapespace {study.head['version']}".strip()
    if study.head["created"]:
        provenance += f", {moment(study.head['created'])}"
    targets_text = ", beside the targets that were set for it" if content.get("targets") else ""
    lead = [Text(f"{parts_file.lead}{targets_text}."), Text(f"{provenance}.", "soft")]
    has_summary = any(content.get(key) for key in ("summary", "targets", "notes"))
    chapters = [Chapter("Summary", study.summary)] if has_summary else []
    for heading, make in study.chapters("Results", 3):
        chapters.append(Chapter(heading, make, heading if len(heading) <= 36 else f"{heading[:35]}…"))
    chapters.append(Chapter("Settings, versions and hashes", study.settings, "Settings"))
    title = study.head["title"] or f"{parts_file.title} in {name}"
    return page.html(title, lead, f"Made by shapespace {__version__} from the files in {name}.", chapters)


def study_section(page: Page, folder: Folder, parts_file: PartsFile = STUDY) -> list[Block]:
    """Return what a study measured or an analysis found, as a section of the report of fits.

    Args:
        page: that it goes to.
        folder: with its file.
        parts_file: which of them it is.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged, or no file of this format.
    """
    content = _content(folder, parts_file)
    if parts_file is STUDY and "format" not in content:
        return tables.score_tables(content, many="Scores by class", single="Scores")
    study = _Study(page, folder, parts_file, content)
    out: list[Block] = [Text(study.head["title"])] if study.head["title"] else []
    out += page.tried(study.summary)
    for heading, make in study.chapters("", 4):
        out += [page.section(heading, make)] if heading else page.tried(make)
    return [*out, Folded(f"Settings and versions of this {parts_file.word}", page.tried(study.settings))]


def find_analyses(root: Path) -> list[Folder]:
    """Return the folders that hold an analysis.json: `root` itself, and those directly in it, by name."""
    inside: list[Path] = []
    with os.scandir(root) as entries:
        # A link may lead anywhere.
        inside = sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))
    return [Folder(folder, ANALYSIS.again) for folder in (root, *inside) if (folder / ANALYSIS.file).is_file()]


def analysis_chapters(page: Page, root: Path, folders: Sequence[Folder]) -> list[Chapter]:
    """Return a chapter for each of `folders` from `find_analyses`, up to MOST_ANALYSES.

    Args:
        page: that they go to.
        root: of the fits.
        folders: of the analyses.
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
    return cast(dict[str, Any], _shortened(Folder(folder.root, parts_file.again).json(parts_file.file)))


def _shortened(value: object, most: int = _MOST_TEXT) -> object:
    """Return JSON content whose texts are lines of bounded length."""
    if isinstance(value, str):
        line = " ".join(value.split())
        return line if len(line) <= most else f"{line[: most - 1]}…"
    if isinstance(value, list):
        return [_shortened(item, most) for item in cast(list[object], value)]
    if isinstance(value, dict):
        mapping = cast(dict[str, object], value)
        long = ("note", "notes", "text", "summary", "settings")
        return {
            str(_shortened(key)): _shortened(item, MOST_PARAGRAPH if key in long else most)
            for key, item in mapping.items()
        }
    return value


def _raw(part: object, key: str) -> object:
    return cast(dict[str, object], part).get(key) if isinstance(part, dict) else None


def _raw_parts(content: Mapping[str, object]) -> list[object]:
    parts = content.get("parts")
    return cast(list[object], parts) if isinstance(parts, list) else []


class _Study:
    """A study or an analysis and the page that it goes to; each key of its file is read when it is shown."""

    def __init__(self, page: Page, folder: Folder, parts_file: PartsFile, content: Mapping[str, Any]) -> None:
        check_format(content, parts_file.struct, parts_file.file, parts_file.again)
        self.page = page
        self.parts_file = parts_file
        self.folder = Folder(folder.root, parts_file.again)
        self.kinds = StudyParts(page, self.folder, parts_file)
        self.content = content
        texts = {key: content.get(key) for key in ("title", "version", "created")}
        self.head = {key: text if isinstance(text, str) else "" for key, text in texts.items()}

    def _read(self, key: str, kind: type[_T]) -> _T:
        return read(kind, self.content.get(key), f"{self.parts_file.file}: {key}", self.parts_file.again)

    def summary(self) -> list[Block]:
        """Return its sentences, what it aimed at beside what it reached, and who was left out."""
        out: list[Block] = []
        if self.content.get("summary"):
            out += self.page.tried(self.sentences)
        if self.content.get("targets"):
            out += self.page.tried(self.targets)
        if self.content.get("notes"):
            out += self.page.tried(self.notes)
        return out

    def notes(self) -> Notice:
        """Return what should be known of it, such as who was left out."""
        notes = self._read("notes", tuple[str, ...])
        rest = [f"{len(notes) - _MOST_NOTES} more, in {self.parts_file.file}."] if len(notes) > _MOST_NOTES else []
        return Notice("To be known", [*map(without_folders, notes[:_MOST_NOTES]), *rest])

    def sentences(self) -> list[Block]:
        """Return its sentences."""
        text = self.content["summary"]
        return paragraphs(text if isinstance(text, str) else self._read("summary", tuple[str, ...]))

    def targets(self) -> Table:
        """Return the targets, each with what was reached."""
        targets = self._read("targets", tuple[Target, ...])
        met = [target.met for target in targets if target.met is not None]
        caption = f"{sum(met)} of {counted(len(met), 'target')} met" if met else "Targets, and what was reached"
        if met and len(met) < len(targets):
            caption += f", {len(targets) - len(met)} without a verdict"
        verdicts = {None: Cell(DASH), True: Cell("met", status="converged"), False: Cell("missed", status="failed")}
        rows = [
            [
                *(Cell(text or DASH) for text in (one.what, one.target, one.reached)),
                verdicts[one.met],
                Cell(one.note or DASH),
            ]
            for one in targets[:MOST_ROWS]
        ]
        columns = [Column(head) for head in ("What", "Target", "Reached", "Verdict", "Note")]
        shown_columns = 5 if any(one.note for one in targets) else 4
        return Table(columns[:shown_columns], [row[:shown_columns] for row in rows], f"{caption}.", stack=True)

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
        raise self.parts_file.damaged("its parts are no list")

    def parts(self, parts: Sequence[object], level: int) -> list[Block]:
        """Return parts under their headings, charts that follow each other side by side."""
        out: list[Block] = []
        blocks: list[Block] = []

        def flush() -> None:
            out.extend([Group("beside", blocks.copy())] if len(blocks) > 1 else blocks)
            blocks.clear()

        for part in parts:
            section = self.page.section(_title(part), lambda part=part: self.body(part), level)
            if _raw(part, "kind") not in _BESIDE:
                flush()
            blocks.append(section)
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
        blocks = self.page.tried(lambda: self.part(part))
        text = len(rendered(blocks).encode()) - (before - self.page.left)
        if text > self.page.left - _PART_BYTES // 2:
            return too_large
        self.page.spend(text)
        return blocks

    def part(self, part: object) -> list[Block]:
        """Return a part by its kind."""
        from shapespace.report.figures import oriented

        one = read_part(part, self.parts_file.file, self.parts_file.again)
        known = self.content.get("orientation") is not None
        with oriented(self._read("orientation", Orientation) if known else None):
            return self.kinds.blocks(one, _title(part))

    def settings(self) -> list[Block]:
        """Return with what the study was made."""
        rows = [("Report", f"shapespace {__version__}")]
        if self.head["version"]:
            rows.append((self.parts_file.word.capitalize(), f"shapespace {self.head['version']}"))
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
        hashes = self._read("model_hashes", tuple[str, ...])
        rows = [[str(k), one] for k, one in enumerate(hashes[:MOST_ROWS], 1)]
        table = text_table(("Model", "Hash"), rows, "Content hashes of the models")
        return Folded(f"Content hashes (SHA-256) of {counted(len(hashes), 'model')}", [table])


def _title(part: object) -> str:
    title, kind = _raw(part, "title"), str(_raw(part, "kind"))
    return title[:200] if isinstance(title, str) and title else TITLES.get(kind, "A part")
