"""Regions of a model: lists of its vertices in text files."""

from __future__ import annotations

from pathlib import Path

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes
from shapespace.io.landmarks.landmark_io import csv_rows
from shapespace.io.read_limits import LARGEST_LANDMARK_FILE_BYTES

_COLUMN = "vertex"
_LONGEST = 10  # digits that fit into int32


def read_region(path: Path | str) -> tuple[int, ...]:
    """Read vertices, counted from 0: a CSV table with a column `vertex`, or one number in each line; `#` for comments.

    Raises:
        FileError: it does not exist or cannot be read.
        FileFormatError: it holds something else, or nothing.
    """
    path = Path(path)
    remedy = "give one vertex number in each line, or a column named vertex"
    data = read_bytes(path, LARGEST_LANDMARK_FILE_BYTES)
    try:
        rows = csv_rows(data, path)
    except FileFormatError as error:
        raise FileFormatError(f"{path} is no list of vertices; {remedy}.") from error
    header = [cell.lower() for cell in rows[0]] if rows else []
    column = header.index(_COLUMN) if _COLUMN in header else 0
    cells = [row[column] if column < len(row) else "" for row in (rows[1:] if _COLUMN in header else rows)]
    wrong = next((cell for cell in cells if not (cell.isascii() and cell.isdecimal() and len(cell) < _LONGEST)), None)
    if wrong is not None or not cells:
        problem = "it is empty" if not cells else f"{wrong[:40]!r} is no vertex number" if wrong else "a row has none"
        raise FileFormatError(f"{path} is no list of vertices ({problem}); {remedy}.")
    return tuple(int(cell) for cell in cells)
