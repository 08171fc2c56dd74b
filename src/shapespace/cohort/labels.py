"""Labels of scans from a table such as `shapespace data faces` writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shapespace.cohort.table import Table, is_number, match_rows, read_table
from shapespace.errors import FileFormatError
from shapespace.io.tables.table_io import key_column
from shapespace.reprs import short_repr

LABELS_FILE = "labels.csv"
_LABELS = ("label", "expression", "class", "group")


@dataclass(frozen=True)
class Label:
    """Class, subject and intensity of one scan.

    Args:
        text: its class, such as an expression; empty where the table has only its subject.
        intensity: from 0 to 1, or None if the table has none.
        subject: name of the subject, or empty.
    """

    text: str
    intensity: float | None = None
    subject: str = ""


@dataclass(frozen=True, eq=False)
class Labels:
    """A table of labels.

    Args:
        table: with a row for each scan.
        labels: of the rows.
    """

    table: Table
    labels: tuple[Label, ...]

    __repr__ = short_repr

    def match(self, scans: Sequence[Sequence[str]], where: Path | str) -> tuple[list[Label | None], list[str]]:
        """Return the label of each scan, None without a row, and the sentences of `match_rows`, whose errors it raises.

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
        path: the table.
        of_subjects: use subjects as classes if the table has no column of classes.
        of_any: use the first column of words with repeated values as classes, before subjects.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not such a table.
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
