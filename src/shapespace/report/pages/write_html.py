"""Reports and figures of saved results: of the demo, of fits, of a correspondence, of an analysis. No fit is run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from shapespace.cohort.orientation import find_orientation
from shapespace.cohort.table import Table, read_table
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.files import make_folder, write_text
from shapespace.lazy import Defer, call_later
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import Block, Figure, Image, Section, Text, Turning, text_table
from shapespace.report.blocks.wording import anchor, counted, listed
from shapespace.report.inputs.saved_fits import Folder, find_fits
from shapespace.report.pages.correspondence_page import CorrespondencePage
from shapespace.report.pages.demo_page import DemoPage
from shapespace.report.pages.folder_page import MOST_ROWS, FolderPage, ManyPage, is_many
from shapespace.report.pages.page import LARGEST_REPORT_BYTES, Chapter, Make, OrderedPicture, Page, Step
from shapespace.report.pages.study_page import ANALYSIS, standalone_file, study_page
from shapespace.schemas import Analysis, CorrespondenceRecord, Orientation, Quality
from shapespace.store.results import Results
from shapespace.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

__all__ = [
    "LARGEST_REPORT_BYTES",
    "FigureConfig",
    "require_report_extra",
    "write_figures",
    "write_report",
    "write_study_report",
]

FIGURES_FOLDER = "figures"
"""Folder of the figures in that of the results."""
_OWN_VIEWS = (
    "Named views are those of maps and morphs of analyses; pictures of fits and correspondences have their own."
)
_FORMATS = ("svg", "pdf", "png")
_LONGEST_LINK = 36  # characters of a link to a chapter
_MOST_CLASSES = 12  # classes of a column that are counted
_LONGEST = 80  # characters of a file name, which file systems allow with any ending


def require_report_extra() -> None:
    """Raise unless the packages that draw are installed.

    Raises:
        ShapespaceError: a package is missing; the message states how to install it.
    """
    missing = [name for name in ("jinja2", "matplotlib", "PIL") if find_spec(name) is None]
    if missing:
        raise ShapespaceError(
            f"The report needs {' and '.join(missing)}, which is not installed; run pip install 'shapespace[report]'."
        )


def write_report(
    folder: Path,
    output: Path | None = None,
    *,
    model: Path | None = None,
    labels: Path | None = None,
    on_step: Step | None = None,
    defer: Defer = call_later,
) -> Path:
    """Write one HTML file on the results saved in `folder`, and return its path.

    A folder with a demo.json is reported as the demo, one with a correspondence.json as a correspondence, one with a
    recognition.json and no fits as a study of recognition, one with an analysis.json and no fits as an analysis, any
    other as the results of `shapespace fit`; of very many fits those to review have rows and pictures, and all are in
    the distributions. Analyses in the folder of fits, or in folders directly in it, are sections of its report. The
    page needs no network; without scripts it can be read, but nothing turns or sorts.

    Args:
        folder: folder of the results.
        output: file of the report; None writes `folder`/report.html.
        model: file of the model of the fits; None for the path in their records. Not for a demo or a study.
        labels: table of labels of the scans; None looks for labels.csv in `folder`, then next to the scans.
        on_step: called after each picture.
        defer: function that starts the drawing of pictures of fits, perhaps in other processes, and returns a function
            that waits for the result; default: they are drawn in this process when they are needed.

    Raises:
        FileError: the folder, demo.json, `model` or `labels` cannot be read, or the report cannot be written.
        FileFormatError: demo.json, correspondence.json or the mean shape next to it, the recognition.json of a study,
            the analysis.json of an analysis, `model` or `labels` is damaged.
        InputError: the folder contains no results, or only records that cannot be read, or `model` is not of its fits.
        ShapespaceError: the extra `report` is not installed.
    """
    require_report_extra()
    path = Path(output) if output is not None else Path(folder) / "report.html"
    write_text(path, _html(Folder(Path(folder)), model, labels, Page(on_step, defer)))
    return path


def _html(folder: Folder, model: Path | None, labels: Path | None, page: Page) -> str:
    """Return the page on the results in `folder`."""
    root, given = folder.root, model is not None or labels is not None
    if (root / "demo.json").is_file():
        if given:
            raise InputError(f"{root} is a demo, which names its models and labels itself; omit --model and --labels.")
        return DemoPage(folder, page).html()
    if (root / CorrespondenceRecord.FILE).is_file():
        if given:
            raise InputError(f"{root} is a correspondence without fits; omit --model and --labels.")
        return CorrespondencePage(folder, page).html()
    if (standalone := standalone_file(folder)) is not None:
        if given:
            raise InputError(f"{root} contains {standalone.article} without fits; omit --model and --labels.")
        return study_page(folder, standalone, page)
    if is_many(results := Results(root)):
        return ManyPage(folder, results, model=model, labels=labels, page=page).html()
    fits = find_fits(folder)
    if all(fit.status == "unreadable" for fit in fits):
        raise InputError(f"{root}: none of its {len(fits)} records can be read; {fits[0].reason}")
    return FolderPage(folder, fits, model=model, labels=labels, page=page).html()


class _StudyPage(Page):
    """Collects the reports of several results, each as a chapter of one page.

    Args:
        on_step: called after each picture.
    """

    def __init__(self, on_step: Step | None = None) -> None:
        super().__init__(on_step)
        self.chapters: list[Chapter] = []
        self._is_inside = False

    def section(self, heading: str, make: Make, level: int = 3, *args: Any, **options: Any) -> Section:
        """Return a section, one level deeper inside a chapter."""
        return super().section(heading, make, level + self._is_inside, *args, **options)

    def html(self, title: str, lead: Sequence[Block], made: str, chapters: Sequence[Chapter]) -> str:
        """Collect the report of a result."""

        def make() -> list[Block]:
            self._loaded.clear()  # each result has a model and fits of its own
            self._is_inside = True
            try:
                return [*lead, *(self.section(chapter.heading, chapter.make, 2) for chapter in chapters)]
            finally:
                self._is_inside = False

        self.chapters.append(
            Chapter(title, make, title if len(title) <= _LONGEST_LINK else f"{title[:_LONGEST_LINK]}…")
        )
        return ""

    def add(self, result: Path) -> None:
        """Add the report of a result: of a folder, or of a model.

        Raises:
            FileError, InputError: as for `write_report`.
        """
        before = self.planned
        if result.is_file():
            model = ShapeModel.load(result)
            self.chapters.append(Chapter(f"Model in {result.name}", lambda: sections.model_part(self, model)))
            self.planned = sections.MODEL_PICTURES
        elif (result / Quality.FILE).is_file() and not (result / CorrespondenceRecord.FILE).is_file():
            folder = Folder(result)
            self.chapters.append(Chapter("Quality of the shape space", lambda: sections.quality_part(self, folder)))
        else:
            _html(Folder(result), None, None, self)
        self.planned += before

    def study(self, results: Sequence[Path], specimens: Table | None) -> str:
        """Return the page: specimens, answers in words, then each result."""
        chapters = [] if specimens is None else [Chapter("Specimens", lambda: _specimen_blocks(specimens))]
        answers = [
            Analysis.from_json(Folder(result, ANALYSIS.again).json(Analysis.FILE))
            for result in results
            if (result / Analysis.FILE).is_file()
        ]
        rows = [
            ("" if k else answer.title, sentence)
            for answer in answers
            for k, sentence in enumerate([answer.summary] if isinstance(answer.summary, str) else answer.summary)
        ]
        if rows:
            chapters.append(
                Chapter("Answers", lambda: text_table(("Question", "Answer"), rows, "The answers in words"))
            )
        title = counted(len(results), "result") if specimens is None else counted(len(specimens), "specimen")
        names = listed([result.name for result in results])
        return super().html(
            f"Study of {title}", [], f"Made by shapespace {__version__} from {names}.", [*chapters, *self.chapters]
        )


def _specimen_blocks(specimens: Table) -> list[Block]:
    """Return the number of specimens in each class, and the table of the specimens."""
    counts = [
        (column, "; ".join(f"{number} {name or 'not stated'}" for name, number in classes.items()))
        for column, cells in specimens.columns.items()
        if 0 < len(classes := Counter(cells)) <= _MOST_CLASSES and len(classes) < len(cells)
    ]
    rows = [
        (name, *(cells[row] for cells in specimens.columns.values()))
        for row, name in enumerate(specimens.rows[:MOST_ROWS])
    ]
    more = len(specimens) - len(rows)
    return [
        *([text_table(("Column", "Specimens in each class"), counts, "Classes")] if counts else []),
        text_table(("Specimen", *specimens.columns), rows, "The specimens"),
        Text(f"{counted(more, 'specimen is', 'specimens are')} not listed." if more else ""),
    ]


def write_study_report(
    results: Sequence[Path], output: Path, *, specimens: Path | None = None, on_step: Step | None = None
) -> Path:
    """Write one HTML file on several results, each as a chapter, and return its path.

    Args:
        results: models, and folders of results of any kind that `write_report` reports or `quality` wrote, in the order
            of the chapters.
        output: file of the report.
        specimens: table of the specimens, which becomes the first chapter.
        on_step: called after each picture.

    Raises:
        FileError, InputError: as for `write_report`, of any result; or the table cannot be read.
        ShapespaceError: the extra `report` is not installed.
    """
    require_report_extra()
    make_folder(output.parent)  # before the pictures, which take long
    page = _StudyPage(on_step)
    table = None if specimens is None else read_table(specimens)
    for result in results:
        page.add(result)
    write_text(output, page.study(results, table))
    return output


@dataclass(frozen=True, kw_only=True)
class FigureConfig:
    """Figures for a paper.

    Args:
        formats: formats of the figures: svg, pdf, png.
        dpi: resolution of PNG figures, and of surfaces in SVG and PDF.
        views: names of the views to draw, from the orientation (default: all views).
        orientation: JSON file with named views of the object, such as dorsal, and links between landmarks (default:
            that of the analysis).

    Raises:
        InputError: another format, or a resolution below 72 or above 1200.
    """

    formats: tuple[str, ...] = ("pdf",)
    dpi: int = 300
    views: tuple[str, ...] = ()
    orientation: Path | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.formats if name not in _FORMATS]
        if unknown or not self.formats:
            raise InputError(f"--format is {(*unknown, '')[0][:40]!r}; choose from {', '.join(_FORMATS)}.")
        if not 72 <= self.dpi <= 1200:
            raise InputError(f"--dpi is {self.dpi}; choose a resolution from 72 to 1200.")

    def oriented(self, own: Orientation | None) -> Orientation | None:
        """Return the orientation of the figures: the chosen views of the file, or of an analysis.

        Args:
            own: orientation of the analysis.

        Raises:
            FileError: the file cannot be read.
            FileFormatError: it is damaged.
            InputError: a view that does not exist.
        """
        found = own if self.orientation is None else find_orientation(self.orientation, ())
        if not self.views:
            return found
        known = {} if found is None else {view.name: view for view in found.views}
        if unknown := [name for name in self.views if name not in known]:
            names = ", ".join(known) or "none; give --orientation"
            raise InputError(f"There is no view {unknown[0][:40]!r}; the views are {names}.")
        return structs.replace(found or Orientation(), views=tuple(known[name] for name in self.views))


class _FigureFiles(Page):
    """Writes the figures of a page as files in place of the page, with captions.txt.

    Args:
        output: folder of the files.
        config: formats, resolution and views.
        on_step: called after each figure.
    """

    def __init__(self, output: Path, config: FigureConfig, on_step: Step | None = None) -> None:
        super().__init__(on_step)
        self.output = output
        self.config = config
        self.headings: list[str] = []
        self.drawn: list[tuple[str, str, Drawing]] = []
        self.captions: dict[Drawing, str] = {}
        self.notes: list[str] = []
        self.paths: list[Path] = []

    @property
    def left(self) -> int:
        """Number of bytes left in the page; constant, since files do not count."""
        return LARGEST_REPORT_BYTES

    def oriented(self, orientation: Orientation | None) -> AbstractContextManager[None]:
        """Return a context without effect, as all figures have the views of the configuration."""
        return nullcontext()

    def section(self, heading: str, make: Make, *args: Any, **options: Any) -> Section:
        """Return a section, after whose heading its figures are named."""
        self.headings.append(heading)
        section = super().section(heading, make, *args, **options)
        self.headings.pop()
        return section

    def failed(self, error: ShapespaceError) -> Text:
        """Record the reason why a figure could not be drawn."""
        self.notes.append(f"The figure {self.headings[-1]!r} could not be drawn: {error}")
        return super().failed(error)

    def still(self, figure: Drawing | OrderedPicture, alt: str, *, lossless: bool = False) -> Image:
        """Record a drawing."""
        figure = figure.draw() if isinstance(figure, OrderedPicture) else figure
        self.drawn.append((self.headings[0], self.headings[-1], figure))
        return Image(b"", (1, 1), alt)

    def figure(self, figure: Drawing | OrderedPicture, caption: str, *, alt: str, chart: bool = False) -> Figure:
        """Record a drawing with its caption."""
        drawing = figure.draw() if isinstance(figure, OrderedPicture) else figure
        self.captions[drawing] = caption
        return super().figure(drawing, caption, alt=alt, chart=chart)

    def turning(
        self, widget: Any, payload: bytes, poster: Image, caption: str, *, label: str, still: str
    ) -> Turning | Figure:
        """Return the still picture of a widget; it has no bytes if it is the drawing that was recorded last."""
        if not poster.data:
            self.captions[self.drawn[-1][-1]] = caption
        self.step(caption)
        return Figure(poster, caption)

    def html(self, title: str, lead: Sequence[Block], made: str, chapters: Sequence[Chapter]) -> str:
        """Write the figures of the chapters, each named after its heading, and after its chapter if headings repeat."""
        for chapter in chapters:
            self.section(chapter.heading, chapter.make)
        make_folder(self.output)
        named = Counter(anchor(heading) for _, heading in {(chapter, heading) for chapter, heading, _ in self.drawn})
        taken: set[str] = set()
        captions: list[str] = []
        for chapter, heading, drawing in self.drawn:
            name = anchor(heading)
            repeats = named[name] > 1 and chapter != heading
            base = f"{anchor(chapter)[:_LONGEST]}-{name[:_LONGEST]}" if repeats else name[:_LONGEST]
            name = next(
                candidate for candidate in chain([base], (f"{base}-{k}" for k in count(2))) if candidate not in taken
            )
            taken.add(name)
            self.paths += figures.save_figure(drawing, self.output / name, self.config.formats, self.config.dpi)
            captions.append(f"{name}: {heading}. {self.captions.get(drawing, '')}".strip())
        write_text(self.output / "captions.txt", "".join(f"{caption}\n" for caption in captions))
        return ""


def write_figures(
    folder: Path, config: FigureConfig, *, model: Path | None = None, on_step: Step | None = None
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write the figures of the report of `folder` to `figures` in it, with captions.txt.

    Args:
        folder: folder of results of any kind that `write_report` reports.
        config: formats, resolution and views.
        model: file of the model of fits; None for that of their records.
        on_step: called after each figure.

    Returns:
        The paths of the figures, and a sentence on each part that cannot be drawn.

    Raises:
        FileError: the folder cannot be read or written.
        FileFormatError: the results or the orientation are damaged.
        InputError: the folder contains no results, or a view does not exist.
        ShapespaceError: the extra `report` is not installed.
    """
    require_report_extra()
    source, own, notes = Folder(folder, ANALYSIS.again), None, ()
    if (folder / Analysis.FILE).is_file():
        own = Analysis.from_json(source.json(Analysis.FILE)).orientation
    elif config.orientation is not None:
        notes = (_OWN_VIEWS,)
    page = _FigureFiles(folder / FIGURES_FOLDER, config, on_step)
    with figures.oriented(config.oriented(own)), figures.publication_style(config.dpi):
        _html(Folder(folder), model, None, page)
    return tuple(page.paths), (*notes, *page.notes)
