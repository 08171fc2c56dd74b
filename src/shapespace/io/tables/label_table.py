"""Labels of scans from a table such as `shapespace data faces` writes, matched by scan name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes
from shapespace.io.meshes.mesh_io import stem_of
from shapespace.io.parsing import is_number
from shapespace.io.tables.table_io import KEYS, key_column, table_rows

LABELS_FILE = "labels.csv"
_LABELS = ("label", "expression", "class", "group", "subject")
_LARGEST_BYTES = 16 * 2**20  # 16 MiB


@dataclass(frozen=True)
class Label:
    """Class, subject and intensity of one scan.

    Args:
        text: its class, such as an expression; empty where the table has only its subject.
        intensity: from 0 to 1, or None where the table does not say.
        subject: whom it shows, or empty.
    """

    text: str
    intensity: float | None = None
    subject: str = ""


def read_labels(path: Path, *, of_subjects: bool = True, of_any: bool = False) -> dict[str, Label]:
    """Return the labels in a table by the name of the scan, without folder and ending.

    The table is what `io.tables.table_rows` reads; names of columns may be in any case.

    Scans of the same name in different folders, with different labels, are called by their folders too, as their fits
    are: `anna/smile.ply` is `anna_smile`, and no scan is `smile`.

    The first of the columns `file`, `scan`, `specimen`, `name` and `id` names the scan, the first of `label`,
    `expression`, `class`, `group` and `subject` its class; there may be `intensity` and `subject` as well.

    Args:
        path: the table.
        of_subjects: whether subjects may stand for classes where there is no other column.
        of_any: whether the first other column of classes, of which several scans have one, may as well.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not such a table.
    """
    content = read_bytes(path)
    if len(content) > _LARGEST_BYTES:
        raise FileFormatError(f"{path} is too large for a table of labels ({len(content) / 2**20:.0f} MiB).")
    try:
        lines = table_rows(content)
        heads = next(lines)
        rows = [[_printable(cell) for cell in line] for line in lines]
    except ValueError as error:
        advice = "" if ";" in str(error) else "; write it as CSV with a header"
        raise FileFormatError(f"{path} {error}{advice}.") from error
    name, intensity, owner = key_column(heads), key_column(heads, ("intensity",)), key_column(heads, ("subject",))
    label = key_column(heads, [head for head in _LABELS if head != "subject"])
    if label is None and of_any:
        label = _first_classes(heads, rows, {name, intensity, owner})
    if label is None and of_subjects:
        label = owner
    if name is None or label is None or not rows:
        raise FileFormatError(
            f"{path} is no table of labels; it needs rows, a column {' or '.join(KEYS)}, and a column {_LABELS[0]} or "
            f"{_LABELS[1]}."
        )
    labels_by_stem: dict[str, dict[PurePath, Label]] = {}
    for row in rows:
        text, subject = row[label], "" if owner is None else row[owner]
        if row[name] and (text or subject):
            scan_path = PurePath(row[name].replace("\\", "/").removesuffix(".gz")).with_suffix("")
            known = None if intensity is None else _intensity(row[intensity])
            labels_by_stem.setdefault(scan_path.name, {})[scan_path] = Label(text, known, subject)
    labels: dict[str, Label] = {}
    for stem, group in labels_by_stem.items():
        if len(set(group.values())) == 1:
            labels[stem] = next(iter(group.values()))
        else:
            labels |= {"_".join(scan_path.parts): group_label for scan_path, group_label in group.items()}
    return labels


def label_of(labels: Mapping[str, Label], file: Path) -> Label | None:
    """Return the label of the scan in `file`, from `labels` as `read_labels` gives them; None if they have none."""
    parts = file.resolve().parent.parts[1:]
    names = ("_".join((*parts[len(parts) - depth :], stem_of(file))) for depth in range(len(parts) + 1))
    return next((labels[name] for name in names if name in labels), None)


def _first_classes(heads: Sequence[str], rows: Sequence[Sequence[str]], other_columns: set[int | None]) -> int | None:
    """Return the first column of words with repeated values, or None."""
    for column, head in enumerate(heads):
        cells = [row[column] for row in rows if row[column]]
        if head and column not in other_columns and len(set(cells)) < len(cells) and not any(map(is_number, cells)):
            return column
    return None


def _intensity(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text).strip()
