"""Pieces of HTML: escaped text, numbers as people write them, tables, tiles, lists and folded parts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from typing import Any, Literal, cast

STATUS_WORDS: Mapping[str, str] = {
    "converged": "converged",
    "max_iterations": "stopped at the limit",
    "doubtful": "doubtful",
    "failed": "failed",
    "unreadable": "unreadable",
}
"""What each status is called, the best first."""

DASH = "–"


def esc(text: object) -> str:
    """Return `text` safe between tags and in quoted attributes."""
    return escape("" if text is None else str(text), quote=True)


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Args:
        text: what is read, not yet escaped.
        value: the number that the table sorts it by; None sorts by the text, not-a-number comes last.
        html: used in place of `text` where it holds more than text; escaped by whoever made it.
    """

    text: str
    value: float | None = None
    html: str | None = None


@dataclass(frozen=True)
class Column:
    """One column of a table: its head, and whether it holds numbers or text."""

    head: str
    kind: Literal["text", "number"] = "text"


def number(value: float, digits: int = 2, unit: str = "") -> Cell:
    """Return a cell that shows `value` with `digits` decimals and `unit`, a dash where there is none."""
    return Cell(f"{value:.{digits}f}{unit}" if math.isfinite(value) else DASH, value)


def length(value: float) -> Cell:
    """Return a cell with a length in mm, without the unit, which the column's head gives."""
    return Cell(mm(value).removesuffix(" mm"), value)


def table(
    columns: Sequence[Column],
    rows: Sequence[Sequence[Cell]],
    *,
    caption: str,
    sortable: bool = False,
    stack: bool = False,
) -> str:
    """Return a table whose first column names its rows.

    Args:
        columns: heads and kinds.
        rows: one cell a column.
        caption: what the table holds, also the name of its scroll box.
        sortable: the page's script makes buttons of the heads.
        stack: on a phone the cells of a row stand under each other, for tables of long text.
    """

    def cell(column: Column, content: Cell, first: bool) -> str:
        inner = content.html if content.html is not None else esc(content.text)
        by = "" if content.value is None else f' data-value="{content.value if math.isfinite(content.value) else ""}"'
        kind = ' class="number"' if column.kind == "number" else ""
        if first:
            return f'<th scope="row"{kind}{by}>{inner}</th>'
        label = f' data-label="{esc(column.head)}"' if stack else ""
        return f"<td{kind}{by}{label}>{inner}</td>"

    head = "".join(
        f'<th scope="col"{" class=" + chr(34) + "number" + chr(34) if column.kind == "number" else ""}>'
        f"{esc(column.head)}</th>"
        for column in columns
    )
    body = "".join(
        "<tr>"
        + "".join(cell(column, content, k == 0) for k, (column, content) in enumerate(zip(columns, row, strict=True)))
        + "</tr>\n"
        for row in rows
    )
    kinds = " ".join(word for word, wanted in (("sortable", sortable), ("stack", stack)) if wanted)
    return (
        f'<div class="table" role="region" aria-label="{esc(caption)}" tabindex="0">'
        f"<table{f' class={chr(34)}{kinds}{chr(34)}' if kinds else ''}><caption><span>{esc(caption)}</span></caption>"
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n"
    )


def facts(rows: Sequence[tuple[str, str]], *, caption: str) -> str:
    """Return a table of names and values."""
    body = "".join(f'<tr><th scope="row">{esc(key)}</th><td>{esc(value)}</td></tr>\n' for key, value in rows)
    return (
        f'<div class="table"><table class="facts"><caption>{esc(caption)}</caption><tbody>\n{body}</tbody></table>'
        "</div>\n"
    )


def tiles(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return figures that are seen at a glance, each (value, small print after it, what it is)."""
    blocks = "".join(
        f"<div><dt>{esc(what)}</dt><dd>{esc(value)}{f' <small>{esc(small)}</small>' if small else ''}</dd></div>"
        for value, small, what in rows
    )
    return f'<dl class="tiles">{blocks}</dl>\n'


def notice(heading: str, sentences: Sequence[str], kind: Literal["notice", "broken"] = "notice") -> str:
    """Return a box with a list of sentences, or nothing without sentences."""
    if not sentences:
        return ""
    items = "".join(f"<li>{esc(text)}</li>" for text in sentences)
    return f'<div class="{kind}"><strong>{esc(heading)}</strong><ul>{items}</ul></div>\n'


def paragraph(text: str, kind: str = "") -> str:
    """Return one paragraph of text."""
    return f"<p{f' class={chr(34)}{kind}{chr(34)}' if kind else ''}>{esc(text)}</p>\n"


def folded(summary: str, body: str) -> str:
    """Return a part that is folded away until it is asked for."""
    return f"<details><summary>{esc(summary)}</summary>\n{body}</details>\n"


def status(value: str) -> Cell:
    """Return a cell with a status in words and its colour, sorted from bad to good."""
    known = list(STATUS_WORDS)
    kind = value if value in STATUS_WORDS else "failed"
    return Cell(
        STATUS_WORDS.get(value, value),
        float(len(known) - known.index(kind)),
        f'<span class="status {kind}">{esc(STATUS_WORDS.get(value, value))}</span>',
    )


def anchor(text: str) -> str:
    """Return `text` as the name of a place in the page: letters, digits and hyphens only."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"


def counted(count: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun, such as `1 scan` or `3 scans`."""
    return f"{count} {one if count == 1 else many or one + 's'}"


def listed(items: Sequence[str], most: int = 12) -> str:
    """Return items with commas, the last after `and`; beyond `most` the rest is counted."""
    if len(items) > most:
        return f"{', '.join(items[:most])} and {len(items) - most} more"
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"


def mm(value: float) -> str:
    """Return a length with three or so digits and its unit."""
    if not math.isfinite(value):
        return DASH
    return f"{value:.0f} mm" if abs(value) >= 100 else f"{value:.1f} mm" if abs(value) >= 10 else f"{value:.2f} mm"


def percent(share: float) -> str:
    """Return a share as a percentage."""
    return f"{100 * share:.0f} %" if math.isfinite(share) else DASH


def size(n_bytes: float) -> str:
    """Return a number of bytes in kB or MB."""
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e6 else f"{n_bytes / 1e3:.0f} kB"


def plain(value: object) -> str:
    """Return a setting or a score as text, numbers with three digits or so."""
    if value is None:
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return DASH if not math.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, list):
        return ", ".join(plain(item) for item in as_list(cast(object, value))) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{words(key)} {plain(item)}" for key, item in as_mapping(cast(object, value)).items())
    return str(value)


def moment(value: object) -> str:
    """Return an ISO time stamp as people write it, or the text as it is."""
    try:
        return datetime.fromisoformat(str(value)).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except (ValueError, OverflowError):
        return str(value)


def words(key: object) -> str:
    """Return the name of a setting as words."""
    return str(key).replace("_", " ")


def as_mapping(value: object) -> Mapping[str, Any]:
    """Return a JSON object, or an empty one where there is none."""
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else {}


def as_list(value: object) -> list[Any]:
    """Return a JSON list, or an empty one where there is none."""
    return cast(list[Any], value) if isinstance(value, list) else []
