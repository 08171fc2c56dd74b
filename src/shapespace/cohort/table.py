"""Covariates of shapes, such as subject, sex and age: a table with one row for each, read from CSV or Excel files."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes
from shapespace.io.meshes.mesh_io import stem_of
from shapespace.io.tables.table_io import CHECKSUM, KEYS, MISSING, key_column, table_rows
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only

_META = "meta_"
_LARGEST_BYTES = 2**28  # 256 MiB, so that a wrong file cannot fill the memory
_NAMED = 3  # names in a message before the rest is only counted


@dataclass(frozen=True, eq=False)
class Table:
    """Covariates of N shapes, as text without white space at its ends.

    Args:
        columns: name -> N cells; a missing one is empty.
        rows: what each row is called in messages, N of them.
        where: what the table is called in messages.

    Raises:
        InputError: columns of another length.
    """

    columns: Mapping[str, tuple[str, ...]]
    rows: tuple[str, ...]
    where: str = "The table"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name, cells in self.columns.items():
            if len(cells) != len(self.rows):
                raise InputError(
                    f"{self.where}: the column {name!r} has {len(cells)} cells for {len(self.rows)} rows; give one "
                    "for each."
                )
        plain = {name.strip(): tuple(map(str.strip, cells)) for name, cells in self.columns.items()}
        if len(plain) < len(self.columns):
            raise InputError(
                f"{self.where} has two columns whose names differ only in white space; rename one of them."
            )
        object.__setattr__(self, "columns", plain)

    def __len__(self) -> int:
        return len(self.rows)

    def texts(self, column: str) -> tuple[str, ...]:
        """Return the N cells of a column; missing cells are empty.

        Raises:
            InputError: there is no such column.
        """
        if column not in self.columns:
            available = ", ".join(self.columns) or "no other columns"
            raise InputError(f"{self.where} has no column {column!r}; it has {available}.")
        return self.columns[column]

    def kind(self, column: str) -> Literal["number", "text"]:
        """Return whether a column contains numbers or classes; a column without values counts as classes.

        Raises:
            InputError: there is no such column, or most of its cells are numbers and some are not.
        """
        cells = {row: cell for row, cell in zip(self.rows, self.texts(column), strict=True) if cell}
        not_numeric = [row for row, cell in cells.items() if not is_number(cell)]
        if len(not_numeric) * 2 >= len(cells):
            return "text"
        if not_numeric:
            raise InputError(
                f"{self.where}: {column!r} holds numbers but {cells[not_numeric[0]][:40]!r} at {not_numeric[0]}"
                f"{_others_note(len(not_numeric) - 1)}; write a number there, or leave it empty."
            )
        return "number"

    def numbers(self, column: str) -> FloatArray:
        """Return the (N,) numbers of a column; NaN for missing cells.

        Raises:
            InputError: there is no such column, or a cell is no finite number.
        """
        cells = self.texts(column)
        for row, cell in zip(self.rows, cells, strict=True):
            if cell and not is_number(cell):
                raise InputError(f"{self.where}: {column!r} is {cell[:40]!r} at {row}, which is no number.")
        return read_only([float(cell) if cell else math.nan for cell in cells])

    def missing(self, columns: Sequence[str]) -> list[int]:
        """Return the rows with a missing cell in one of `columns`.

        Raises:
            InputError: there is no such column.
        """
        texts = [self.texts(column) for column in columns]
        return [row for row in range(len(self)) if not all(cells[row] for cells in texts)]

    def take(self, rows: Sequence[int]) -> Table:
        """Return the table of some rows, in their order."""
        chosen = {name: tuple(cells[row] for row in rows) for name, cells in self.columns.items()}
        return Table(chosen, tuple(self.rows[row] for row in rows), self.where)


def read_table(path: Path, specimens: Collection[str] = ()) -> tuple[Table, tuple[str, ...]]:
    """Return a table, and the name of the shape of each row: without folder and ending, or as one of `specimens`.

    The table is what `io.tables.table_rows` reads. The first of the columns `file`, `scan`, `specimen`, `name` and `id`
    that it has, in any case, names the shapes. Columns of a coefficients.csv that came with the list of its scans lose
    their `meta_`.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is no such table, or two of its rows are of one shape.
    """
    check_file(path, _LARGEST_BYTES, "give a smaller table")
    try:
        lines = table_rows(read_bytes(path))
        heads = next(lines)
        rows = [[plain_cell(cell) for cell in line] for line in lines]
    except ValueError as error:
        advice = "" if ";" in str(error) else "; write it as CSV with a header"
        raise FileFormatError(f"{path} {error}{advice}.") from error
    key = key_column(heads)
    if key is None or not rows:
        raise FileFormatError(f"{path} is no table of shapes; it needs rows, and a column {' or '.join(KEYS)}.")
    names = heads[key]
    places = [PurePath(row[key].replace("\\", "/")) for row in rows]
    # Scans of one name in different folders are called by their folders too, as their fits are.
    repeated = {stem for stem, count in Counter(stem_of(scan) for scan in places).items() if count > 1}
    keys = tuple(_with_folders(scan) if stem_of(scan) in repeated else stem_of(scan) for scan in places)
    if specimens:
        # Names of specimens may have points, as those of files have before their ending.
        cells = [row[key] for row in rows]
        keys = tuple(stem if stem in specimens and cell not in specimens else cell
                     for cell, stem in zip(cells, keys, strict=True))  # fmt: skip
    if "" in keys:
        raise FileFormatError(
            f"{path} has no {names} in row {keys.index('') + 1}; name the shape, or leave the row out."
        )
    repeated_keys = [key for key, count in Counter(keys).items() if count > 1]
    if repeated_keys:
        raise FileFormatError(
            f"{path} has two or more rows of {repeated_keys[0][:80]!r}{_others_note(len(repeated_keys) - 1)}; "
            "keep one row for each shape."
        )
    columns: dict[str, tuple[str, ...]] = {}
    for index, head in enumerate(heads):
        if head and head not in (CHECKSUM, names):
            column = head.removeprefix(_META)
            columns[head if column in heads or not column else column] = tuple(row[index] for row in rows)
    return Table(columns, keys, str(path)), keys


def name_key(name: str) -> tuple[list[str], list[int]]:
    """Return the key by which rows are sorted, with numbers in names by their value: permutations of rows and so p
    then do not depend on their order in a file."""
    return re.split(r"[0-9]+", name), [int(digits) for digits in re.findall(r"[0-9]+", name)]


def _with_folders(path: PurePath) -> str:
    return "_".join((*(part for part in path.parent.parts if part not in (".", "/")), stem_of(path)))


def plain_cell(cell: str) -> str:
    """Return the text of a cell without white space at its ends and with spaces for characters that do not print.

    It is empty for a missing value.
    """
    text = cell if cell.isprintable() else "".join(c if c.isprintable() else " " for c in cell)
    text = text.strip()
    return "" if text.lower() in MISSING else text


def is_number(cell: str) -> bool:
    """Return whether a cell is a finite number."""
    try:
        return math.isfinite(float(cell)) and "_" not in cell
    except ValueError:
        return False


def _others_note(count: int) -> str:
    return f" and {count} more" if count > 0 else ""


def list_names(names: Sequence[str]) -> str:
    """Return the first of `names` in words, and how many more there are."""
    return ", ".join(names[:_NAMED]) + _others_note(len(names) - _NAMED)


def note_unmatched(
    notes: list[str],
    table: Table,
    keys: Sequence[str],
    available: Mapping[str, object],
    used: Sequence[str],
    names: Sequence[str],
    where: Path | str,
    remedy: str = "give the folder of its shapes with --shapes",
) -> None:
    """Add a note on rows without a shape and shapes without a row.

    Raises:
        InputError: no row has a shape.
    """
    unknown = [key for key in keys if key not in available]
    if len(unknown) == len(keys):
        raise InputError(
            f"{where} holds no shape of {table.where} (such as {list_names(unknown)}; there is {list_names(names)}); "
            f"{remedy}."
        )
    if unknown:
        notes.append(
            f"{len(unknown)} of {len(keys)} rows of {table.where} are left out, whose shape is not in "
            f"{where} ({list_names(unknown)})."
        )
    unmatched = sorted(set(names) - set(used))
    if unmatched:
        notes.append(
            f"{len(unmatched)} of {len(names)} shapes in {where} have no row in {table.where} "
            f"({list_names(unmatched)})."
        )


def numbers_as_text(values: FloatArray) -> tuple[str, ...]:
    """Return text cells that parse to the same numbers; NaN becomes an empty cell."""
    return tuple("" if np.isnan(value) else repr(float(value)) for value in values)
