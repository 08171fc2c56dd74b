"""Building blocks of a page: text, tables, figures, and sections of blocks; templates turn them into HTML."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, TypeVar

from shapespace.report.blocks.wording import DASH, STATUS_WORDS, counted, isfinite, mm, setting, words

_MOST_ADDED = 3
"""Decimals that a number of a column may get beyond its own, so that very different numbers stay readable."""


@dataclass(frozen=True)
class Text:
    """A paragraph, or a sentence of a list, perhaps after a name; its kind is a class of report.css.

    Empty text is not shown, nor are notes, notices and folded parts without content.
    """

    text: str
    kind: Literal["", "soft", "notice", "broken"] = ""
    name: Cell | None = None
    """Cell before the text: a status, or a link to a place in the page."""


@dataclass(frozen=True)
class Command:
    """A line for the terminal."""

    text: str


@dataclass(frozen=True)
class Cell:
    """One cell of a table, or a few words in a sentence.

    Args:
        text: text of the cell.
        value: the number that a table sorts it by; None sorts by the text, NaN comes last.
        status: name of the status, which sets the colour; empty for none.
        anchor: place in the page that the cell links to, or None.
    """

    text: str
    value: float | None = None
    status: str = ""
    anchor: str | None = None

    @property
    def sort_key(self) -> float | str:
        """The value; empty if it is not a number."""
        return self.value if self.value is not None and isfinite(self.value) else ""


@dataclass(frozen=True)
class Head:
    """One column of a table: its head, and whether it contains numbers or text."""

    head: str
    kind: Literal["text", "number"] = "text"


@dataclass(frozen=True)
class Table:
    """A table whose first column names its rows.

    Args:
        columns: heads and kinds.
        rows: cells, one per column.
        caption: content of the table, also the name of its scroll box.
        sortable: whether the page's script turns the heads into buttons that sort.
        stack: whether the cells of a row are stacked on a phone, for tables of long text.
    """

    MOST_OPEN = 14
    """Rows beyond which a table scrolls within itself."""

    columns: Sequence[Head]
    rows: Sequence[Sequence[Cell]]
    caption: str
    sortable: bool = False
    stack: bool = False

    @property
    def long(self) -> bool:
        """Whether the table has so many rows that they scroll below fixed column heads."""
        return len(self.rows) > self.MOST_OPEN

    @property
    def aligned_rows(self) -> Sequence[Sequence[Cell]]:
        """The rows, with equal decimals of the numbers of a column."""
        return list(zip(*map(_with_equal_decimals, zip(*self.rows, strict=True)), strict=True))


@dataclass(frozen=True)
class Facts:
    """A table of names and values."""

    rows: Sequence[tuple[str, str]]
    caption: str


@dataclass(frozen=True)
class Tiles:
    """Key figures, each (value, small print after it, name)."""

    rows: Sequence[tuple[str, str, str]]


@dataclass(frozen=True)
class Notice:
    """A box with a list of sentences; not shown if the list is empty."""

    heading: str
    items: Sequence[str | Text]
    kind: Literal["notice", "broken"] = "notice"


@dataclass(frozen=True)
class Notes:
    """A list of remarks."""

    items: Sequence[str]


@dataclass(frozen=True)
class Image:
    """WebP `data` of `size` pixels; `alt` describes the picture."""

    data: bytes
    size: tuple[int, int]
    alt: str

    @property
    def source(self) -> str:
        """The picture as a data URL for a page."""
        return "data:image/webp;base64," + base64.b64encode(self.data).decode("ascii")


@dataclass(frozen=True)
class Figure:
    """A picture with its caption."""

    image: Image
    caption: str
    kind: Literal["chart", "drawing", "plain"] = "plain"


@dataclass(frozen=True)
class Turning:
    """A widget that turns in a browser with scripts, and is a still picture on paper and without scripts.

    Args:
        widget: a name of `Shapespace.widgets`, which the scripts `widget-*.js` define.
        payload: id of the data that the widget shows.
        poster: still picture.
        caption: caption of the widget and of the still picture.
        label: description for screen readers.
        still: description of the still picture, printed with it only.
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
        anchor: anchor of the card in the page.
        name: name of the fit.
        status: status of the fit.
        label: label next to the name; empty for none.
        text: summary in one or two sentences.
        image: picture of the fit, or None.
        why_none: reason why there is no picture.
        detail: place with all pictures of the fit, or None.
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
    """Cards next to each other."""

    cards: Sequence[Card]


@dataclass(frozen=True)
class StripKey:
    """The key of strips in a gallery: the content of the panels in words, and scales, each (bar, ends in words)."""

    text: str
    bars: Sequence[tuple[Image, str, str]]
    note: str = ""


@dataclass(frozen=True)
class Folded:
    """A part that is folded until the reader opens it."""

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
    """Name of the section in the navigation."""
    folded: bool = False
    status: Cell | None = None
    """Status next to the heading."""


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
    """Return the first items of a list, and a sentence with the number and the place of the others."""
    return [*items[:most], *([f"{counted(len(items) - most, word, words)}, {where}."] if len(items) > most else [])]


def no_picture(count: int, noun: str) -> Text:
    """Return a sentence on the number of results without a card in a gallery."""
    others = f"{counted(count, f'other {noun}')} have no picture here"
    return Text(f"{others}, so that this file stays below 8 MB; the table has them all." if count else "")


def _with_equal_decimals(column: Sequence[Cell]) -> Sequence[Cell]:
    """Return the cells of a column; those of numbers get the most decimals of a cell."""
    own = [len(cell.text.partition(".")[2]) for cell in column]
    numeric = [
        cell.value is not None and f"{cell.value:,.{k}f}" == cell.text.replace("−", "-")
        for cell, k in zip(column, own, strict=True)
    ]
    decimals = [k for k, is_number in zip(own, numeric, strict=True) if is_number] or [0]
    most = min(max(decimals), min(decimals) + _MOST_ADDED)
    return [
        replace(cell, text=f"{cell.value or 0:,.{most}f}".replace("-", cell.text[0]))
        if is_number and k < most
        else cell
        for cell, k, is_number in zip(column, own, numeric, strict=True)
    ]


def number(value: float, digits: int = 2) -> Cell:
    """Return a cell that shows `value` with `digits` decimals, a dash if it is not finite."""
    return Cell(f"{value:.{digits}f}" if isfinite(value) else DASH, value)


def length(value: float) -> Cell:
    """Return a cell with a length in mm, without the unit, which the column's head gives."""
    return Cell(mm(value).removesuffix(" mm"), value)


def table_of(items: Sequence[_Item], columns: Sequence[tuple[Head, Callable[[_Item], Cell]]], caption: str) -> Table:
    """Return a sortable table with one row per item, whose cells the columns make."""
    rows = [[make(item) for _, make in columns] for item in items]
    return Table([column for column, _ in columns], rows, caption, sortable=len(rows) > 1)


def text_table(heads: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> Table:
    """Return a table of texts that may be long."""
    return Table([Head(head) for head in heads], [[Cell(text) for text in row] for row in rows], caption, stack=True)


def facts_of(values: Mapping[str, object], caption: str) -> Facts:
    """Return settings or measures by name, those with parts by their plain parts."""
    return Facts([(words(key), setting(value)) for key, value in values.items()], caption)
