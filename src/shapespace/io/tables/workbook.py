"""Sheets of Excel workbooks (.xlsx, Office Open XML, ECMA-376 part 1) as rows of text, read as a stream with limits.

Numbers are the text that the file stores, dates are ISO 8601, cells with the error #N/A are empty. Formulas have the
value that the file stores; they are not evaluated.
"""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Final

from shapespace.io.containers.archives import zip_members

WORKBOOK_START: Final = b"PK\x03\x04"
"""First bytes of every workbook."""

_MOST_UNPACKED = 2**26
"""Largest unpacked size of a workbook (64 MiB), a million cells or more."""
_MOST_CELLS = 2_000_000  # limit on memory
_MOST_TEXT = 2**26
"""Largest number of characters in all cells together; many cells may refer to one shared string."""
_MOST_COLUMNS = 16_384
"""Columns of a sheet in Excel (XFD)."""
_DIGITS = 7  # limit of digits of the index of a text or a style in damaged files
_CELL = re.compile(r"([A-Z]{1,3})[0-9]{1,7}")
_RELATIONS = "xl/_rels/workbook.xml.rels"
_LAST_DAY = 2_958_466
"""31 December 9999 as Excel counts days."""
_DATES = frozenset({*range(14, 23), *range(27, 37), *range(45, 48), *range(50, 59)})
"""Number formats that are dates or times without being defined in the file (ECMA-376 part 1, 18.8.30)."""
_NO_CODE = re.compile(r'"[^"]*"|\[[^\]]*\]|\\.')

Row = Mapping[int, str]
"""Column, from 0 -> text of the cells of a row that are not empty."""


def sheet_rows(content: bytes, sheet: str | None = None) -> list[Row]:
    """Return the rows of a sheet of a workbook without empty rows.

    Args:
        content: content of the workbook file.
        sheet: name of the sheet; None for the first one.

    Raises:
        ValueError: it is not a workbook, is damaged or too large, or has no such sheet; the message is a clause.
    """
    try:
        # The limit of an archive is proportional to its size; that of a workbook is constant.
        members = zip_members(io.BytesIO(content), min(len(content), _MOST_UNPACKED // 100))
    except (ValueError, OSError) as error:
        raise ValueError(f"is not a workbook, or it is cut short ({error})") from error
    book = _Elements(("sheet", "workbookPr"))
    _parse(members, "xl/workbook.xml", book)
    sheets = [attributes for tag, attributes in book.found if tag == "sheet"]
    chosen = next((entry for entry in sheets if sheet is None or entry.get("name") == sheet), None)
    if chosen is None:
        raise ValueError(f"has no sheet called {sheet}" if sheet else "has no sheet, so it is not a workbook")
    key = next((value for name, value in chosen.items() if name.endswith("}id")), "")
    relations = _Elements(("Relationship",))
    _parse(members, _RELATIONS, relations)
    targets = {entry.get("Id"): entry.get("Target", "") for _, entry in relations.found}
    target = targets.get(key, "").removeprefix("/xl/").removeprefix("xl/")
    shared = _SharedStrings()
    if "xl/sharedStrings.xml" in members:
        _parse(members, "xl/sharedStrings.xml", shared)
    styles = _Elements(("numFmt", "xf", "cellXfs", "cellStyleXfs"))
    if "xl/styles.xml" in members:
        _parse(members, "xl/styles.xml", styles)
    since_1904 = any(tag == "workbookPr" and entry.get("date1904") in ("1", "true") for tag, entry in book.found)
    cells = _Cells(shared.strings, _date_styles(styles), since_1904=since_1904)
    _parse(members, f"xl/{target}", cells)
    return cells.rows


class _Handler:
    """A target of the XML parser that builds no tree, and rejects document types and entities."""

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.in_text = False

    def data(self, data: str, /) -> None:
        if self.in_text:
            self.parts.append(data)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("declares a document type, which no workbook does")


class _Elements(_Handler):
    """Attributes of all elements with given names, in order."""

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__()
        self.names = names
        self.found: list[tuple[str, dict[str, str]]] = []

    def start(self, tag: str, attrs: dict[str, str], /) -> None:
        if _local_name(tag) in self.names:
            self.found.append((_local_name(tag), attrs))
            if len(self.found) > _MOST_CELLS:
                raise ValueError("has too many styles or sheets")


class _SharedStrings(_Handler):
    """The shared strings."""

    def __init__(self) -> None:
        super().__init__()
        self.strings: list[str] = []
        self._phonetic = False

    def start(self, tag: str, attrs: dict[str, str], /) -> None:
        name = _local_name(tag)
        self.in_text = name == "t" and not self._phonetic
        self._phonetic = self._phonetic or name == "rPh"

    def end(self, tag: str, /) -> None:
        name = _local_name(tag)
        self.in_text = False
        if name == "rPh":
            self._phonetic = False
        elif name == "si":
            self.strings.append("".join(self.parts))
            self.parts = []
            if len(self.strings) > _MOST_CELLS:
                raise ValueError("has too many shared strings")


class _Cells(_Handler):
    """The cells of a sheet."""

    def __init__(self, strings: list[str], dates: frozenset[str], *, since_1904: bool) -> None:
        super().__init__()
        self.rows: list[Row] = []
        self._strings, self._dates = strings, dates
        self._first_day = datetime(1904, 1, 1) if since_1904 else datetime(1899, 12, 30)
        self._row: dict[int, str] = {}
        self._column, self._kind, self._style = -1, "", ""
        self._cells = self._characters = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> None:
        name = _local_name(tag)
        if name == "row":
            self._row, self._column = {}, -1
        elif name == "c":
            reference = _CELL.fullmatch(attrs.get("r", ""))
            # A cell without a reference follows the previous cell.
            self._column = _column(reference[1]) if reference else self._column + 1
            if self._column >= _MOST_COLUMNS:
                raise ValueError("has more columns than a sheet can have")
            self._kind, self._style, self.parts = attrs.get("t", "n"), attrs.get("s", "0"), []
        self.in_text = name in ("v", "t")

    def end(self, tag: str, /) -> None:
        name = _local_name(tag)
        self.in_text = False
        if name == "c":
            text = self._text("".join(self.parts))
            self._cells += 1
            self._characters += len(text)
            if self._cells > _MOST_CELLS or self._characters > _MOST_TEXT:
                raise ValueError("has more cells or text than a table of shapes needs")
            if text:
                self._row[self._column] = text
        elif name == "row" and self._row:
            self.rows.append(self._row)
            self._row = {}

    def _text(self, value: str) -> str:
        if self._kind == "s":
            # A number of thousands of digits is not an index, and its conversion takes quadratic time.
            known = value.isascii() and value.isdecimal() and len(value) <= _DIGITS and int(value) < len(self._strings)
            if value and not known:
                raise ValueError(f"is damaged: there is no shared string {value[:20]!r}")
            return self._strings[int(value)] if value else ""
        if self._kind == "b":
            return {"1": "TRUE", "0": "FALSE"}.get(value, value)
        if self._kind == "e":
            if value == "#N/A":
                return ""
            raise ValueError(f"has the error {value[:20]} in a cell; correct the formula")
        if self._kind == "n" and self._style in self._dates:
            return self._date(value)
        return value

    def _date(self, value: str) -> str:
        try:
            days = float(value)
        except ValueError:
            return value
        if not 0 <= days < _LAST_DAY:
            return value
        seconds = round(days * 86_400)
        moment = self._first_day + timedelta(seconds=seconds)
        if days < 1:
            return moment.time().isoformat()
        return moment.isoformat(sep=" ") if seconds % 86_400 else moment.date().isoformat()


def _parse(members: Mapping[str, bytes], name: str, target: _Handler) -> None:
    parser = ET.XMLParser(target=target)
    try:
        parser.feed(members.get(name, b""))
        parser.close()
    except (ET.ParseError, LookupError) as error:
        raise ValueError(f"is not a workbook, or it is damaged ({name[:60]})") from error


def _date_styles(styles: _Elements) -> frozenset[str]:
    """Return the numbers, as text, of the styles of cells that show dates or times."""
    codes = {
        attributes.get("numFmtId", ""): attributes.get("formatCode", "")
        for tag, attributes in styles.found
        if tag == "numFmt"
    }
    date_styles: set[str] = set()
    of_cells, number = False, 0
    for tag, attributes in styles.found:
        if tag in ("cellXfs", "cellStyleXfs"):
            of_cells, number = tag == "cellXfs", 0
        elif tag == "xf" and of_cells:
            key = attributes.get("numFmtId", "0")
            code = _NO_CODE.sub("", codes.get(key, "")).lower()
            built_in = key not in codes and key.isascii() and key.isdecimal() and len(key) < _DIGITS
            if (built_in and int(key) in _DATES) or (code != "general" and re.search(r"[ymdhs]", code)):
                date_styles.add(str(number))
            number += 1
    return frozenset(date_styles)


def _column(letters: str) -> int:
    number = 0
    for letter in letters:
        number = number * 26 + ord(letter) - ord("A") + 1
    return number - 1


def _local_name(tag: str) -> str:
    return tag.rpartition("}")[2]
