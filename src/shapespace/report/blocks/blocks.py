"""What every page is made of: text, tables, figures, and sections that hold them; templates turn them to HTML."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypeVar

from shapespace.report.blocks.wording import DASH, STATUS_WORDS, counted, isfinite, mm, setting, words


@dataclass(frozen=True)
class Text:
    """A paragraph, or a sentence of a list, perhaps after a name; its kind is a class of report.css.

    Nothing is shown of an empty text, and of notes, a notice and a folded part without content.
    """

    text: str
    kind: Literal["", "soft", "notice", "broken"] = ""
    name: Cell | None = None
    """Before the text: a status, or what may lead to a place in the page."""


@dataclass(frozen=True)
class Command:
    """A line for the terminal."""

    text: str


@dataclass(frozen=True)
class Cell:
    """One cell of a table, or a few words in a sentence.

    Args:
        text: what is read.
        value: the number that a table sorts it by; None sorts by the text, not-a-number comes last.
        status: which of the statuses it is, for its colour; empty for none.
        anchor: where in the page it leads, or None.
    """

    text: str
    value: float | None = None
    status: str = ""
    anchor: str | None = None

    @property
    def sort_key(self) -> float | str:
        """The value, empty where it is not a number."""
        return self.value if self.value is not None and isfinite(self.value) else ""


@dataclass(frozen=True)
class Column:
    """One column of a table: its head, and whether it holds numbers or text."""

    head: str
    kind: Literal["text", "number"] = "text"


@dataclass(frozen=True)
class Table:
    """A table whose first column names its rows.

    Args:
        columns: heads and kinds.
        rows: one cell a column.
        caption: what the table holds, also the name of its scroll box.
        sortable: the page's script makes buttons of the heads.
        stack: on a phone the cells of a row stand under each other, for tables of long text.
    """

    MOST_OPEN = 14
    """Rows beyond which a table scrolls within itself."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    caption: str
    sortable: bool = False
    stack: bool = False

    @property
    def long(self) -> bool:
        """Whether it scrolls within itself, under its heads."""
        return len(self.rows) > self.MOST_OPEN


@dataclass(frozen=True)
class Facts:
    """A table of names and values."""

    rows: Sequence[tuple[str, str]]
    caption: str


@dataclass(frozen=True)
class Tiles:
    """Figures that are seen at a glance, each (value, small print after it, what it is)."""

    rows: Sequence[tuple[str, str, str]]


@dataclass(frozen=True)
class Notice:
    """A box with a list of sentences; nothing where there are none."""

    heading: str
    items: Sequence[str | Text]
    kind: Literal["notice", "broken"] = "notice"


@dataclass(frozen=True)
class Notes:
    """A list of remarks."""

    items: Sequence[str]


@dataclass(frozen=True)
class Image:
    """WebP `data` of `size` pixels; `alt` says what is seen."""

    data: bytes
    size: tuple[int, int]
    alt: str

    @property
    def source(self) -> str:
        """The picture as it stands in a page."""
        return "data:image/webp;base64," + base64.b64encode(self.data).decode("ascii")


@dataclass(frozen=True)
class Figure:
    """A picture with its caption."""

    image: Image
    caption: str
    kind: Literal["chart", "drawing", "plain"] = "plain"


@dataclass(frozen=True)
class Turning:
    """What turns where the browser can, and is a still on paper and without a script.

    Args:
        widget: a name of `Shapespace.widgets`, which the scripts `widget-*.js` define.
        payload: the id of what it shows.
        poster: the still.
        caption: of both.
        label: what it is, for screen readers.
        still: what the still shows, printed with it alone.
    """

    widget: Literal["modes", "morph", "fit", "scatter", "morphospace"]
    payload: str
    poster: Image
    caption: str
    label: str
    still: str


@dataclass(frozen=True)
class Card:
    """One fit in a gallery.

    Args:
        anchor: its name in the page.
        name: of the fit.
        status: of the fit.
        label: beside it; empty for none.
        text: in a sentence or two.
        image: its picture, or None.
        why_none: why there is no picture.
        detail: the place with all its pictures, or None.
    """

    anchor: str
    name: str
    status: Cell
    label: str
    text: str
    image: Image | None
    why_none: str = ""
    detail: str | None = None


@dataclass(frozen=True)
class Gallery:
    """Cards beside each other."""

    cards: Sequence[Card]


@dataclass(frozen=True)
class StripKey:
    """The key of strips in a gallery: what their panels show in words, and scales, each (bar, its ends in words)."""

    text: str
    bars: Sequence[tuple[Image, str, str]]
    note: str = ""


@dataclass(frozen=True)
class Folded:
    """A part that is folded away until it is asked for."""

    summary: str
    body: Sequence[Block]


@dataclass(frozen=True)
class Group:
    """Blocks in two columns, one of the columns, or blocks side by side, where the window has room for them."""

    kind: Literal["columns", "column", "beside"]
    body: Sequence[Block]


@dataclass(frozen=True)
class Section:
    """A part of the page under a heading of `level` 2 to 6, at a place that links lead to; perhaps folded away."""

    heading: str
    anchor: str
    body: Sequence[Block]
    level: int = 3
    link: str = ""
    """What the navigation calls it."""
    folded: bool = False
    status: Cell | None = None
    """Beside the heading."""


Block: TypeAlias = (
    Text
    | Command
    | Table
    | Facts
    | Tiles
    | Notice
    | Notes
    | Figure
    | Turning
    | Gallery
    | StripKey
    | Folded
    | Group
    | Section
)


_Item = TypeVar("_Item")


def status(value: str) -> Cell:
    """Return a cell with a status in words and its colour, sorted from bad to good."""
    kind = value if value in STATUS_WORDS else "failed"
    return Cell(STATUS_WORDS.get(value, value), float(len(STATUS_WORDS) - [*STATUS_WORDS].index(kind)), kind)


def first_items(
    items: Sequence[_Item], most: int, where: str, word: str = "other", words: str | None = None
) -> list[_Item | str]:
    """Return the first items of a list, and a sentence that counts the others and says where they are."""
    return [*items[:most], *([f"{counted(len(items) - most, word, words)}, {where}."] if len(items) > most else [])]


def no_picture(count: int, noun: str) -> Text:
    """Return a sentence on those of which a gallery has no card."""
    others = f"{counted(count, f'other {noun}')} have no picture here"
    return Text(f"{others}, so that this file stays below 8 MB; the table has them all." if count else "")


def number(value: float, digits: int = 2) -> Cell:
    """Return a cell that shows `value` with `digits` decimals, a dash where there is none."""
    return Cell(f"{value:.{digits}f}" if isfinite(value) else DASH, value)


def length(value: float) -> Cell:
    """Return a cell with a length in mm, without the unit, which the column's head gives."""
    return Cell(mm(value).removesuffix(" mm"), value)


def table_of(items: Sequence[_Item], columns: Sequence[tuple[Column, Callable[[_Item], Cell]]], caption: str) -> Table:
    """Return a table that sorts, with a row for each item and cells that the columns make of it."""
    rows = [[make(item) for _, make in columns] for item in items]
    return Table([column for column, _ in columns], rows, caption, sortable=len(rows) > 1)


def text_table(heads: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> Table:
    """Return a table of texts that may be long."""
    return Table([Column(head) for head in heads], [[Cell(text) for text in row] for row in rows], caption, stack=True)


def facts_of(values: Mapping[str, object], caption: str) -> Facts:
    """Return settings or measures by name, those with parts by their plain parts."""
    return Facts([(words(key), setting(value)) for key, value in values.items()], caption)
