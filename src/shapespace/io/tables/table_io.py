"""Tables: a reader of CSV and Excel files, and a writer of CSV that escapes formulas.

Tables may have a column `CHECKSUM` that reveals later changes of a row; other programs read them as plain CSV.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, TextIO

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes, write_text
from shapespace.io.tables.workbook import WORKBOOK_START, sheet_rows

CHECKSUM: Final = "checksum"
"""The column with a checksum of each row, which reveals changes."""

KEYS: Final = ("file", "scan", "specimen", "name", "id")
"""Possible key columns, which name the shape of a row, in upper or lower case; the first one in a table is its key."""

MISSING: Final = frozenset({"", "na", "nan", "n/a", "null", "none"})
"""Cells, in lower case, that mean a missing value."""

_FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""Beginning of cells that a spreadsheet would execute (OWASP, CSV injection), with any apostrophes before it."""
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|nan)")
_DELIMITERS = (",", ";", "\t")
_INTEGER = re.compile(r"[+-]?[0-9]+([eE][+-]?[0-9]+)?")
DECIMAL_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+([eE][+-]?[0-9]+)?")
"""A number with a decimal comma."""
_THOUSANDS = re.compile(r"[+-]?[0-9]{1,3}(\.[0-9]{3})+,[0-9]+")
_MOST_LACKING = 2**18
"""Limit of the total number of missing cells of all rows; filling them takes memory beyond the size of the file."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_OLD_EXCEL = b"\xd0\xcf\x11\xe0"
_SEPARATOR = re.compile(r'"?sep=(.)"?')


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV table with `header` atomically.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_text(path, table_text(header, rows))


def table_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a CSV table with `header` as text."""
    return rows_text([header, *rows])


def rows_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text, each ended by a line feed; text that a spreadsheet would execute gets an apostrophe."""
    text = io.StringIO()
    write_row = _row_writer(text)
    for row in rows:
        write_row([_escape_formula(cell) for cell in row])
    return text.getvalue()


def checked_table_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a CSV table as text, with the column `CHECKSUM` of `header` computed from the others."""
    text = io.StringIO()
    write_checked(text, header, rows)
    return text.getvalue()


def write_checked(stream: TextIO, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV table as `checked_table_text` to `stream`, row by row."""
    checksum_column = header.index(CHECKSUM)
    header = [str(_escape_formula(name)) for name in header]
    write_row = _row_writer(stream)
    write_row(header)
    for row in rows:
        cells = ["" if cell is None else str(_escape_formula(cell)) for cell in row]
        write_row([*cells[:checksum_column], row_checksum(header, cells), *cells[checksum_column + 1 :]])


def _row_writer(stream: TextIO) -> Callable[[Sequence[object]], object]:
    """Return a function that writes a row of CSV to `stream`."""
    plain = csv.writer(stream, lineterminator="\n")
    # The csv module does not quote a lone carriage return, but reads it as the end of a line.
    quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)

    def write_row(row: Sequence[object]) -> None:
        returns = any(isinstance(cell, str) and "\r" in cell for cell in row)
        (quoted if returns else plain).writerow(row)

    return write_row


def _escape_formula(cell: object) -> object:
    """Return a cell for writing, with an apostrophe before text that a spreadsheet would execute."""
    if not isinstance(cell, str):
        return cell
    text = cell.encode("utf-8", "backslashreplace").decode("utf-8")
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.fullmatch(text) else text


def unescape_formula(cell: str) -> str:
    """Return the text of a cell without the apostrophe that `_escape_formula` adds."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def row_checksum(header: Sequence[str], cells: Sequence[str]) -> str:
    """Return the value of the column `CHECKSUM` for a row."""
    pairs = sorted((name, cell) for name, cell in zip(header, cells, strict=True) if name != CHECKSUM)
    row_text = "\0".join(f"{name}\1{cell}" for name, cell in pairs)
    return f"sha256:{hashlib.sha256(row_text.encode('utf-8', 'surrogatepass')).hexdigest()[:16]}"


def key_column(header: Sequence[str], names: Sequence[str] = KEYS) -> int | None:
    """Return the index of the first of `names` in a header, in upper or lower case, or None."""
    lower = [name.lower() for name in header]
    return next((lower.index(name) for name in names if name in lower), None)


def table_rows(content: bytes) -> Iterator[list[str]]:
    """Yield the header and then the rows of a table, each as long as the header; rows of empty cells are skipped.

    The table is CSV with commas, semicolons or tabs, in UTF-8, UTF-16 with a byte order mark or Windows Latin-1, or the
    first sheet of an Excel workbook. In tables with semicolons or tabs, columns of numbers with decimal commas get
    decimal points. If a table has a column `CHECKSUM`, its rows are checked.

    Raises:
        ValueError: it is not a table, or a row has more cells than the header or was changed; the message is a clause.
    """
    if content.startswith(_OLD_EXCEL):
        raise ValueError("is an Excel file of the old format (.xls); save it as .xlsx or CSV")
    try:
        lines = _sheet(content) if content.startswith(WORKBOOK_START) else csv_lines(decoded_text(content))
        raw = next(lines, list[str]())
        while raw and not raw[-1].strip():
            raw.pop()
        if any("\0" in name for name in raw):
            raise ValueError("is not a table but binary, or UTF-16 without a byte order mark")
        header = [unescape_formula(name).strip() for name in raw]
        known = [name for name in header if name]
        if len(set(known)) != len(known):
            repeated = next(name for name in known if known.count(name) > 1)
            raise ValueError(f"has two columns of the same name ({repeated[:40]!r})")
        yield header
        checksum_column, n_unchecked = header.index(CHECKSUM) if CHECKSUM in header else None, 0
        for number, row in enumerate(lines, 1):
            if len(row) > len(raw) and not any(cell.strip() for cell in row[len(raw) :]):
                del row[len(raw) :]
            if len(row) > len(raw) or (checksum_column is not None and len(row) != len(raw)):
                comma = " (with decimal commas, separate the columns by semicolons)" * (checksum_column is None)
                raise ValueError(f"has {len(row)} cells in row {number}, and {len(raw)} columns{comma}")
            if checksum_column is not None and row_checksum(raw, row) != row[checksum_column]:
                raise ValueError(f"was changed in row {number} since it was written: its {CHECKSUM} does not match")
            n_unchecked += len(raw) - len(row)
            if n_unchecked > _MOST_LACKING:
                raise ValueError(f"has rows with far fewer cells than its {len(raw)} columns, such as row {number}")
            yield [*map(unescape_formula, row), *[""] * (len(raw) - len(row))]
    except csv.Error as error:
        raise ValueError(f"is not a CSV table ({error})") from error


def read_rows(path: Path, content: bytes | None = None) -> list[list[str]]:
    """Return the header and the rows of a table that `table_rows` reads, cells without white space at their ends.

    Args:
        path: path of the file.
        content: content of the file as bytes; None to read the file.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not a table.
    """
    try:
        rows = table_rows(read_bytes(path) if content is None else content)
        return [[cell.strip() for cell in row] for row in rows]
    except ValueError as error:
        raise FileFormatError(f"{path} {error}; correct the table.") from error


def decoded_text(content: bytes) -> str:
    """Return the text of a file: UTF-8, UTF-16 with a byte order mark, or else Windows Latin-1 (code page 1252).

    Raises:
        ValueError: the content begins with a byte order mark of UTF-16 but is not valid UTF-16; the message has no
            subject, so that the caller can put the file name before it.
    """
    try:
        return content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError as error:
        if content.startswith(_UTF_16):
            raise ValueError("is not text, or UTF-16 that is cut short") from error
        # Five bytes are undefined in code page 1252; Latin-1 defines all.
        is_undefined = any(byte in content for byte in (b"\x81", b"\x8d", b"\x8f", b"\x90", b"\x9d"))
        return content.decode("latin-1" if is_undefined else "cp1252")


def csv_lines(text: str) -> Iterator[list[str]]:
    """Yield the cells of each line that is not empty of text with commas, semicolons or tabs, see `table_rows`."""
    first = text[: text.find("\n") + 1].strip() if "\n" in text else ""
    stated = _SEPARATOR.fullmatch(first)
    if stated and stated[1] in _DELIMITERS:
        delimiter, text = stated[1], text[text.find("\n") + 1 :]
    else:
        delimiter = _delimiter(text)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    lines = (line for line in reader if any(cell and not cell.isspace() for cell in line))
    return lines if delimiter == "," else iter(_with_decimal_points(list(lines)))


def _delimiter(text: str) -> str:
    """Return the most frequent delimiter in the header outside quotes; the comma if there is none."""
    start = text.lstrip("\r\n \ufeff")
    end = re.search(r"[\r\n]", start)
    header = re.sub(r'"[^"]*"', "", start[: end.start()] if end else start)
    # A table without a header may begin with decimal commas.
    header = re.sub(r"(?<=\d),(?=\d)", "", header) if ";" in header else header
    return max(_DELIMITERS, key=header.count)


def _with_decimal_points(lines: list[list[str]]) -> list[list[str]]:
    """Return the lines with decimal points in the columns of numbers with decimal commas.

    Raises:
        ValueError: a column has both, or points for thousands.
    """
    for column, name in enumerate(lines[0] if lines else []):
        cells = {number: line[column].strip() for number, line in enumerate(lines) if column < len(line)}
        if not DECIMAL_COMMA.fullmatch(cells[0]):
            del cells[0]
        cells = {number: cell for number, cell in cells.items() if cell.lower() not in MISSING}
        with_comma = [n for n, cell in cells.items() if DECIMAL_COMMA.fullmatch(cell) or _THOUSANDS.fullmatch(cell)]
        other_cells = [cell for number, cell in cells.items() if number not in set(with_comma)]
        if not with_comma or not all(_NUMBER.fullmatch(cell) for cell in other_cells):
            continue
        if any(_THOUSANDS.fullmatch(cells[n]) for n in with_comma) or not all(map(_INTEGER.fullmatch, other_cells)):
            raise ValueError(f"writes numbers with commas and with points in the column {name[:40]!r}; use only one")
        for number in with_comma:
            lines[number][column] = cells[number].replace(",", ".")
    return lines


def _sheet(content: bytes) -> Iterator[list[str]]:
    rows = sheet_rows(content)
    width = max((max(row) + 1 for row in rows[:1]), default=0)
    for row in rows:
        last = max(row) + 1
        if last > width:
            # Cells outside the table, such as notes, would be lost without a column name.
            raise ValueError(
                f"has a cell outside its table ({row[last - 1][:40]!r}); give that column a name, and remove titles"
                " above the names of columns"
            )
        line = [row.get(column, "") for column in range(width)]
        if any(cell.strip() for cell in line):
            yield line
