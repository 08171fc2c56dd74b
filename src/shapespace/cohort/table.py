"""Covariates of shapes, such as subject, sex and age: a table with one row for each shape, from CSV or Excel files.

Likely misspellings of its classes are named: classes with one shape, and classes with similar names.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePath
from typing import Any, Literal

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
        columns: name -> N cells; a missing cell is empty.
        rows: names of the N rows in messages.
        where: name of the table in messages.

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
                f"{self.where} has two columns whose names differ only in white space; rename one of the columns."
            )
        object.__setattr__(self, "columns", plain)

    @staticmethod
    def of(data: Any, where: str = "The table") -> Table:
        """Return the table in a DataFrame of pandas or polars, or in a mapping of name to cells.

        The first of the columns `file`, `scan`, `specimen`, `name` and `id` names the specimens, as in files; without
        such a column, the index of a pandas DataFrame does, if it contains names.

        Args:
            data: the table.
            where: name of the table in messages.

        Raises:
            InputError: the data are no table, have no rows or two columns of the same name, or name no specimens.
        """
        own: list[Any] = list(
            data.columns if hasattr(data, "columns") else data.keys() if hasattr(data, "keys") else ()
        )
        heads = [str(head).strip() for head in own]
        if not heads:
            raise InputError(
                f"{where} is no DataFrame or mapping with columns, but {type(data).__name__}; give a DataFrame or a "
                "mapping."
            )
        if len(set(heads)) < len(heads):
            raise InputError(f"{where} has two columns of the same name; rename one of the columns.")
        columns = {head: tuple(cell_text(value) for value in data[name]) for head, name in zip(heads, own, strict=True)}
        key = key_column(heads)
        index: Any = getattr(data, "index", None)
        if key is not None:
            rows = columns.pop(heads[key])
        else:
            named = key_column([str(getattr(index, "name", ""))]) is not None
            rows = tuple(map(cell_text, index)) if hasattr(index, "__iter__") else ()
            rows = rows if named or not all(map(is_number, rows)) else ()
        if not rows or not all(rows):
            raise InputError(f"{where} names no specimen in some row; it needs rows, and a column {' or '.join(KEYS)}.")
        return Table(columns, rows, where)

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
                f"{self.where}: {column!r} contains numbers but {cells[not_numeric[0]][:40]!r} at {not_numeric[0]}"
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


def read_table(path: Path, content: bytes | None = None) -> Table:
    """Return a table whose rows are named by its key column; `match_rows` finds their specimens.

    The file is read by `io.tables.table_rows`. The first of the columns `file`, `scan`, `specimen`, `name` and `id`
    that it has, in any case, names the specimens. Columns of a coefficients.csv that came with the list of its scans
    lose their prefix `meta_`.

    Args:
        path: the file.
        content: content of the file; None to read it.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is no such table.
    """
    if content is None:
        check_file(path, _LARGEST_BYTES, "give a smaller table")
    try:
        lines = table_rows(read_bytes(path) if content is None else content)
        heads = next(lines)
        rows = [[plain_cell(cell) for cell in line] for line in lines]
    except ValueError as error:
        advice = "" if ";" in str(error) else "; write it as CSV with a header"
        raise FileFormatError(f"{path} {error}{advice}.") from error
    key = key_column(heads)
    if key is None or not rows:
        raise FileFormatError(f"{path} is no table of specimens; it needs rows, and a column {' or '.join(KEYS)}.")
    names = tuple(row[key] for row in rows)
    if "" in names:
        raise FileFormatError(
            f"{path} has no {heads[key]} in row {names.index('') + 1}; name the specimen, or remove the row."
        )
    columns: dict[str, tuple[str, ...]] = {}
    for index, head in enumerate(heads):
        if head and head not in (CHECKSUM, heads[key]):
            column = head.removeprefix(_META)
            columns[head if column in heads or not column else column] = tuple(row[index] for row in rows)
    return Table(columns, names, str(path))


def name_key(name: str) -> tuple[list[str], list[int]]:
    """Return the sort key of a name, with its numbers by value; p does not depend on the order of rows in a file."""
    return re.split(r"[0-9]+", name), [int(digits) for digits in re.findall(r"[0-9]+", name)]


def match_rows(
    table: Table,
    specimens: Sequence[Sequence[str]],
    where: Path | str,
    remedy: str = "give the folder of its specimens with --shapes",
) -> tuple[dict[int, int], list[str]]:
    """Match rows to specimens by name: return row -> number of its specimen, and sentences on all without a match.

    A row names its specimen, or its file with or without ending and folders, which may be joined by `_` as in the names
    of fits. Case, white space at the ends and the Unicode form of letters are significant only if specimens differ in
    nothing else.

    Args:
        table: result of `read_table`.
        specimens: names of each specimen; the first name is used in messages.
        where: place of the specimens, in messages.
        remedy: advice if no row has a specimen.

    Raises:
        FileFormatError: two rows are of one specimen.
        InputError: no row names a specimen.
    """
    indices = [(form, _specimen_index(specimens, form)) for form in (str, fold_name)]
    places = [PurePath(name.replace("\\", "/")) for name in table.rows]
    # A file name that rows have in different folders names no specimen.
    folders: dict[str, set[str]] = {}
    for place in places:
        folders.setdefault(fold_name(stem_of(place)), set()).update({fold_name(str(place.parent))} - {"."})
    matched: dict[int, int] = {}
    owners: list[int | str] = []
    for row, (name, place) in enumerate(zip(table.rows, places, strict=True)):
        parts, stem = [part for part in place.parent.parts if part not in (".", "/")], stem_of(place)
        named = [name, *("_".join((*parts[k:], stem)) for k in range(max(len(parts), 1)))]
        named += [place.name, stem] if len(folders[fold_name(stem)]) < 2 else []
        found = (index.get(form(text)) for text in named for form, index in indices)
        number = next((k for k in found if k is not None), None)
        if number is not None:
            matched[row] = number
        owners.append(fold_name(name) if number is None else number)
    refuse_repeated(table.where, table.rows, owners)
    names = [own[0] for own in specimens]
    unknown = [name for row, name in enumerate(table.rows) if row not in matched]
    if not matched:
        raise InputError(
            f"{where} contains no specimen of {table.where} (rows such as {list_names(unknown)}; specimens "
            f"{list_names(names) or 'none'}); {remedy}."
        )
    used = set(matched.values())
    unmatched = sorted(name for k, name in enumerate(names) if k not in used)
    notes: list[str] = []
    if unknown:
        verb = "has no specimen in {0} and is" if len(unknown) == 1 else "have no specimen in {0} and are"
        notes.append(
            f"{len(unknown)} of {len(table)} rows of {table.where} {verb.format(where)} excluded "
            f"({list_names(unknown)})."
        )
    if unmatched:
        notes.append(
            f"{len(unmatched)} of {len(names)} specimens in {where} {'has' if len(unmatched) == 1 else 'have'} no row "
            f"in {table.where} ({list_names(unmatched)})."
        )
    return {row: matched[row] for row in sorted(matched, key=lambda row: name_key(table.rows[row]))}, notes


def refuse_repeated(where: Path | str, rows: Sequence[str], owners: Sequence[Hashable], noun: str = "specimen") -> None:
    """Check that no two rows of a table, named `rows`, have the same owner.

    Raises:
        FileFormatError: two rows have the same owner; the message names them.
    """
    rows_by_owner: dict[Hashable, list[str]] = {}
    for number, (name, owner) in enumerate(zip(rows, owners, strict=True), 1):
        rows_by_owner.setdefault(owner, []).append(f"{number} ({name[:80]!r})")
    repeated = [own for own in rows_by_owner.values() if len(own) > 1]
    if repeated:
        more = f"; so are those of {len(repeated) - 1} more" if len(repeated) > 1 else ""
        raise FileFormatError(
            f"{where}: the rows {' and '.join(repeated[0][:_NAMED])} are of one {noun}{more}; keep one row for each "
            f"{noun}."
        )


def fold_name(name: str) -> str:
    """Return a name without case, white space at its ends, and differences of the Unicode form of its letters."""
    return unicodedata.normalize("NFC", name).casefold().strip()


def names_of_file(path: PurePath | str) -> tuple[str, ...]:
    """Return the names by which a row can refer to the specimen in a file, for `match_rows`: the usual name first."""
    folders = PurePath(path).parent.parts[1:]
    stem = stem_of(path)
    joined = ("_".join((*folders[-depth:], stem)) for depth in range(1, len(folders) + 1))
    return tuple(dict.fromkeys((stem, PurePath(path).name, *joined)))


def _specimen_index(specimens: Sequence[Sequence[str]], form: Callable[[str], str]) -> dict[str, int]:
    """Return name -> specimen for unambiguous names; first names have priority over further names of others."""
    index: dict[str, int] = {}
    for depth in range(max(map(len, specimens), default=0)):
        owners: dict[str, set[int]] = {}
        for k, own in enumerate(specimens):
            if depth < len(own):
                owners.setdefault(form(own[depth]), set()).add(k)
        index = {name: min(own) for name, own in owners.items() if len(own) == 1} | index
    return index


def cell_text(value: object) -> str:
    """Return the text of a value of a column in memory; empty for a missing value."""
    if isinstance(value, float) and value.is_integer():  # also NumPy's float64
        return str(int(value))  # integers in a column with missing values are floats
    text = "" if value is None else str(value)
    return "" if text in ("<NA>", "NaT") else plain_cell(text)


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


def numbers_as_text(values: FloatArray) -> tuple[str, ...]:
    """Return text cells that parse to the same numbers; NaN becomes an empty cell."""
    return tuple("" if np.isnan(value) else repr(float(value)) for value in values)


_LISTED = 12
"""Largest number of classes whose counts are listed."""
_FEWEST_CODES = 3
"""Fewest classes that differ from a number; two classes have one degree of freedom too."""
_COMPARED = 60
"""Largest number of classes that are compared letter by letter; columns with more contain names."""
_LONG = 5
"""Shortest words that count as similar if one letter differs; shorter ones, such as left and lent, do not."""


def class_notes(table: Table, columns: Iterable[str], numbers: Collection[str] = ()) -> tuple[str, ...]:
    """Return sentences on the classes in some columns of a table.

    Args:
        table: table with the columns.
        columns: columns that are used as classes, whatever they contain, or as numbers.
        numbers: columns that are used as numbers.

    Raises:
        InputError: there is no such column.
    """
    return tuple(
        note
        for column in dict.fromkeys(columns)
        for note in notes_on_classes(column, table.texts(column), codes=column not in numbers)
    )


def notes_on_classes(column: str, cells: Sequence[str], *, codes: bool = False) -> list[str]:
    """Return the number of shapes in each class, and sentences on classes that may be misspelt.

    If more than half of all shapes are alone in their class, the column contains names and no counts are given.

    Args:
        column: name of the column.
        cells: cells of all shapes; missing cells are empty.
        codes: whether numbers are codes of classes.
    """
    counts = Counter(cell for cell in cells if cell)
    if codes and all(map(is_number, counts)):
        counts = Counter(f"{float(cell):g}" for cell in cells if cell)
    total = counts.total()
    is_numeric = 2 * sum(n for cell, n in counts.items() if is_number(cell)) > total
    if not total or (len(counts) != 2 and is_numeric and not codes):
        # Two numbers are often codes of two groups.
        return []
    has_names = 2 * len(counts) > total
    notes: list[str] = []
    if not has_names:
        fewest, most = min(counts.values()), max(counts.values())
        listed = ", ".join(f"{name} {n}" for name, n in counts.most_common())
        if len(counts) > _LISTED:
            listed = f"{fewest}{f' to {most}' if most > fewest else ''} in {len(counts)} classes"
        notes.append(f"Shapes in each class of {column}: {listed}.")
        alone = [name for name, count in counts.items() if count == 1]
        if alone:
            quoted_names = ", ".join(repr(name[:40]) for name in alone[:3]) + (" ..." if len(alone) > 3 else "")
            notes.append(
                f"{column} has {len(alone)} {'class' if len(alone) == 1 else 'classes'} with one shape "
                f"({quoted_names}); check the spelling, or exclude these shapes."
            )
    for first, other, difference in _similar_pairs(list(counts), letters=not has_names):
        notes.append(
            f"{column} has the classes {first[:40]!r} ({counts[first]}) and {other[:40]!r} ({counts[other]}), which "
            f"differ only in {difference}; correct the table if they are the same."
        )
    return notes


def number_caution(table: Table, column: str, classes: str) -> str:
    """Return a sentence on a column of few different integers that is used as a number; empty for other columns.

    Args:
        table: table with the column.
        column: name of a column of numbers.
        classes: term to write in a formula if the numbers are classes.
    """
    values = {float(value) for value in table.numbers(column)}
    if not _FEWEST_CODES <= len(values) <= _LISTED or len(table) < 2 * len(values):
        return ""
    if not all(value.is_integer() for value in values):
        return ""
    listed = ", ".join(f"{value:g}" for value in sorted(values))
    return (
        f"{column} has {len(values)} different integers ({listed}) and is used as a number, with 1 degree of "
        f"freedom; if they are codes of classes, write {classes}, with {len(values) - 1}."
    )


def _similar_pairs(names: Sequence[str], *, letters: bool) -> list[tuple[str, str, str]]:
    """Return pairs of similar names, and their difference."""
    plain: dict[str, list[str]] = {}
    for name in names:
        plain.setdefault("".join(name.casefold().split()), []).append(name)
    pairs = [(group[0], second, "case or white space") for group in plain.values() for second in group[1:]]
    if letters and len(plain) <= _COMPARED:
        pairs += [
            (plain[first][0], plain[second][0], "one letter")
            for first, second in combinations(plain, 2)
            if max(len(first), len(second)) >= _LONG and (first + second).isalpha() and _one_edit(first, second)
        ]
    return pairs


def _one_edit(first: str, second: str) -> bool:
    """Return whether words differ by one inserted, removed or replaced letter, or by two adjacent letters swapped."""
    start = next(
        (k for k, (a, b) in enumerate(zip(first, second, strict=False)) if a != b), min(len(first), len(second))
    )
    first_rest, second_rest = first[start:], second[start:]
    replaced = first_rest[1:] == second_rest[1:]
    exchanged = first_rest[:2] == second_rest[:2][::-1] and first_rest[2:] == second_rest[2:]
    return replaced or exchanged or first_rest[1:] == second_rest or first_rest == second_rest[1:]


LABELS_FILE = "labels.csv"
_LABELS = ("label", "expression", "class", "group")


@dataclass(frozen=True)
class Label:
    """Class, subject and intensity of one scan.

    Args:
        text: class of the scan, such as an expression; empty if the table has only its subject.
        intensity: intensity from 0 to 1; None if the table has none.
        subject: name of the subject, or empty.
    """

    text: str
    intensity: float | None = None
    subject: str = ""


@dataclass(frozen=True, eq=False)
class Labels:
    """A table of labels.

    Args:
        table: table with a row for each scan.
        labels: labels of the rows.
    """

    table: Table
    labels: tuple[Label, ...]

    __repr__ = short_repr

    def match(self, scans: Sequence[Sequence[str]], where: Path | str) -> tuple[list[Label | None], list[str]]:
        """Return the label of each scan, None without a row, and the notes of `match_rows`, whose errors it raises.

        Args:
            scans: names of each scan.
            where: place of the scans, in messages.
        """
        rows, notes = match_rows(self.table, scans, where, "name the scans alike")
        own = {k: self.labels[row] for row, k in rows.items()}
        return [own.get(k) for k in range(len(scans))], notes


def read_labels(path: Path, *, of_subjects: bool = True, of_any: bool = False) -> Labels:
    """Return the labels in a table that `read_table` reads; names of columns may be in any case.

    The first of the columns `label`, `expression`, `class` and `group` has the class of a scan; there may be
    `intensity` and `subject` as well.

    Args:
        path: path of the table.
        of_subjects: whether to use subjects as classes if the table has no column of classes.
        of_any: whether to use the first column of words with repeated values as classes, before subjects.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is no such table.
    """
    table = read_table(path)
    heads = list(table.columns)
    columns = [*table.columns.values(), ("",) * len(table)]
    intensity, owner = key_column(heads, ("intensity",)), key_column(heads, ("subject",))
    label = key_column(heads, _LABELS)
    if label is None and of_any:
        label = _first_classes(columns[:-1], {intensity, owner})
    if label is None and of_subjects:
        label = owner
    if label is None:
        raise FileFormatError(
            f"{path} is no table of labels; it needs a column {_LABELS[0]} or {_LABELS[1]} besides the names of scans."
        )
    texts, subjects, intensities = (columns[-1 if k is None else k] for k in (label, owner, intensity))
    known = (float(cell) if is_number(cell) else None for cell in intensities)
    return Labels(table, tuple(map(Label, texts, known, subjects)))


def _first_classes(columns: Sequence[Sequence[str]], other_columns: set[int | None]) -> int | None:
    """Return the first column of words with repeated values, or None."""
    for column, own in enumerate(columns):
        cells = [cell for cell in own if cell]
        if column not in other_columns and len(set(cells)) < len(cells) and not any(map(is_number, cells)):
            return column
    return None
