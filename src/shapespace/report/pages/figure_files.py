"""Figures of an analysis as files for a paper: the drawings of its report, in the size of print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from itertools import count as count_from
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from shapespace.cohort.orientation import find_orientation
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.files import make_folder, write_text
from shapespace.report.blocks.blocks import Figure, Image
from shapespace.report.blocks.wording import anchor
from shapespace.report.inputs.saved_fits import Folder
from shapespace.report.pages.page import Page
from shapespace.report.pages.study_parts import ANALYSIS, TITLES, StudyParts
from shapespace.schemas import Analysis, Orientation, Part, TablePart, TextPart, read_part

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_FORMATS = ("svg", "pdf", "png")
FOLDER = "figures"
"""Folder of the figures in that of the analysis."""
_LONGEST = 80  # characters of a file name, which file systems allow with any ending


class _Drawings(Page):
    """Collects the drawings that a page would have, and their captions."""

    def __init__(self) -> None:
        super().__init__(0)
        self.drawings: list[Drawing] = []
        self.captions: list[str] = []

    def still(self, figure: Drawing, alt: str, *, lossless: bool = False) -> Image:
        """Keep a drawing."""
        self.drawings.append(figure)
        return Image(b"", (1, 1), alt)

    def step(self, name: str) -> None:
        """Keep the caption of a drawing."""
        self.captions.append(name)

    def turning(self, widget: Any, payload: bytes, poster: Image, caption: str, *, label: str, still: str) -> Figure:
        """Return the still of something that turns."""
        self.step(caption)
        return Figure(poster, caption)


@dataclass(frozen=True, kw_only=True)
class FigureConfig:
    """Figures for a paper.

    Args:
        formats: formats of the figures: svg, pdf, png.
        dpi: resolution of PNG figures, and of surfaces in SVG and PDF.
        views: names of the views to draw, from the orientation (default: all of it).
        orientation: JSON file with named views of the object, such as dorsal, and links between landmarks (default:
            that of the answer).

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
        """Return the orientation of the figures: the chosen views of the file, or of an answer.

        Args:
            own: orientation of the answer.

        Raises:
            FileError: the file cannot be read.
            FileFormatError: it is damaged.
            InputError: a view that there is not.
        """
        found = own if self.orientation is None else find_orientation(self.orientation, ())
        if not self.views:
            return found
        known = {} if found is None else {view.name: view for view in found.views}
        if unknown := [name for name in self.views if name not in known]:
            names = ", ".join(known) or "none; give --orientation"
            raise InputError(f"There is no view {unknown[0][:40]!r}; the views are {names}.")
        return structs.replace(found or Orientation(), views=tuple(known[name] for name in self.views))


def write_figures(folder: Path, config: FigureConfig) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write the figures of the analysis in a folder to `figures` in it, with captions.txt.

    Args:
        folder: with analysis.json.
        config: formats, resolution and views.

    Returns:
        The paths of the figures, and a sentence on each part that cannot be drawn.

    Raises:
        FileError: the folder cannot be read or written.
        FileFormatError: analysis.json or the orientation is damaged.
        InputError: a view that there is not.
    """
    from shapespace.report.figures import oriented, publication_style, save_figure

    source = Folder(folder, ANALYSIS.again)
    analysis = Analysis.from_json(source.json(Analysis.FILE))
    output, paths, captions, notes = make_folder(folder / FOLDER), list[Path](), list[str](), list[str]()
    with oriented(config.oriented(analysis.orientation)), publication_style(config.dpi):
        for name, title, part in _named(read_part(one, Analysis.FILE, ANALYSIS.again) for one in analysis.parts):
            page = _Drawings()
            try:
                StudyParts(page, source, ANALYSIS).blocks(part, title)
            except ShapespaceError as error:
                notes.append(f"The figure {title!r} could not be drawn: {error}")
            for drawing in page.drawings:
                paths += save_figure(drawing, output / name, config.formats, config.dpi)
                captions.append(f"{name}: {title}. {' '.join(page.captions)}".strip())
    write_text(output / "captions.txt", "".join(f"{caption}\n" for caption in captions))
    return tuple(paths), tuple(notes)


def _named(parts: Iterator[Part]) -> Iterator[tuple[str, str, Part]]:
    """Yield the parts that are drawn with a file name of the title, and of the chapter where titles repeat."""
    taken: set[str] = set()
    chapter, titled = "", [(one.title or TITLES.get(str(one.__struct_config__.tag), "Figure"), one) for one in parts]
    count = Counter(anchor(title) for title, one in titled if not isinstance(one, TextPart | TablePart))
    for title, part in titled:
        chapter = title if part.level == 2 else chapter
        if isinstance(part, TextPart | TablePart):
            continue
        prefix = f"{anchor(chapter)[:_LONGEST]}-" if count[anchor(title)] > 1 and chapter != title else ""
        base = f"{prefix}{anchor(title)[:_LONGEST]}".strip("-")
        name = next(one for one in chain([base], (f"{base}-{k}" for k in count_from(2))) if one not in taken)
        taken.add(name)
        yield name, title, part
