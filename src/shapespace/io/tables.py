"""Plain CSV tables, and tables whose rows show any later change and are still plain CSV to everybody else."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, TextIO

from shapespace.io.files import write_text

CHECKSUM: Final = "checksum"
"""The column of a table that tells of each row whether it was changed."""


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV table with `header`, whole or not at all.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_text(path, table_text(header, rows))


def table_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a CSV table with `header` as text."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def checked_table_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a CSV table as text, where the column `CHECKSUM` of `header` is filled in from the others."""
    text = io.StringIO()
    write_checked(text, header, rows)
    return text.getvalue()


def write_checked(stream: TextIO, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write the same to `stream`, a row at a time."""
    at = header.index(CHECKSUM)
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        cells = ["" if cell is None else str(cell) for cell in row]
        writer.writerow([*cells[:at], row_checksum(header, cells), *cells[at + 1 :]])


def row_checksum(header: Sequence[str], cells: Sequence[str]) -> str:
    """Return what stands in the column `CHECKSUM` of a row; no number is written so, which a program might round."""
    pairs = sorted((name, cell) for name, cell in zip(header, cells, strict=True) if name != CHECKSUM)
    said = "\0".join(f"{name}\1{cell}" for name, cell in pairs)
    return f"sha256:{hashlib.sha256(said.encode('utf-8', 'surrogatepass')).hexdigest()[:16]}"


def table_rows(content: bytes) -> Iterator[list[str]]:
    """Yield the header and then the rows of a CSV table in UTF-8, checked where it has a column `CHECKSUM`.

    Raises:
        ValueError: it is none, a row has more or fewer cells than the header, or was changed; with a clause on what.
    """
    try:
        lines = filter(None, csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True))
        header = next(lines, list[str]())
        if len(set(header)) != len(header):
            raise ValueError("has two columns of one name")
        yield header
        at = header.index(CHECKSUM) if CHECKSUM in header else None
        for number, row in enumerate(lines, 1):
            if len(row) != len(header):
                raise ValueError(f"has {len(row)} cells in row {number}, and {len(header)} columns")
            if at is not None and row_checksum(header, row) != row[at]:
                raise ValueError(f"was changed in row {number} since it was written, as its column {CHECKSUM} tells")
            yield row
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"is not a CSV table in UTF-8 ({error})") from error
