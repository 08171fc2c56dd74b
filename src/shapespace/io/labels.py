"""Labels of scans from a table such as `shapespace data faces` writes, matched by the names of the scans."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes
from shapespace.io.meshes import stem_of

LABELS_FILE = "labels.csv"
_NAMES = ("file", "scan", "name")
_LABELS = ("label", "expression", "class", "group", "subject")
_LARGEST_BYTES = 16 * 2**20


@dataclass(frozen=True)
class Label:
    """What is known of one scan.

    Args:
        text: its class, such as an expression; empty where the table has only its subject.
        intensity: from 0 to 1, or None where the table does not say.
        subject: whom it shows, or empty.
    """

    text: str
    intensity: float | None = None
    subject: str = ""


def read_labels(path: Path, *, of_subjects: bool = True) -> dict[str, Label]:
    """Return the labels in a CSV table by the name of the scan, without folder and ending.

    Scans of the same name in different folders, with different labels, are called by their folders too, as their fits
    are: `anna/smile.ply` is `anna_smile`, and no scan is `smile`.

    The scan stands in the column `file`, `scan` or `name`; its class in `label`, `expression`, `class`, `group` or
    `subject`, the first that is there; `intensity` and `subject` may stand beside it.

    Args:
        path: the table.
        of_subjects: whether subjects may stand for classes where there is no other column.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not such a table.
    """
    content = read_bytes(path)
    if len(content) > _LARGEST_BYTES:
        raise FileFormatError(f"{path} is too large for a table of labels ({len(content) / 2**20:.0f} MiB).")
    try:
        lines = filter(None, csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True))
        heads = next(lines, list[str]())
        # No more cells than there are: a row may be shorter than the header.
        rows = [dict(zip(heads, line, strict=False)) for line in lines]
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path} is not a CSV table in UTF-8 ({error}).") from error
    if not rows:
        heads = []
    name = next((head for head in _NAMES if head in heads), None)
    label = next((head for head in _LABELS if head in heads and (of_subjects or head != "subject")), None)
    if name is None or label is None:
        raise FileFormatError(
            f"{path} is no table of labels; it needs rows, a column {_NAMES[0]} and a column {_LABELS[0]} or "
            f"{_LABELS[1]}."
        )
    named: dict[str, dict[PurePath, Label]] = {}
    for row in rows:
        text = _printable(row.get(label) or "")
        subject = _printable(row.get("subject") or "")
        if row.get(name) and (text or subject):
            place = PurePath(row[name].replace("\\", "/").removesuffix(".gz")).with_suffix("")
            named.setdefault(place.name, {})[place] = Label(text, _intensity(row.get("intensity")), subject)
    found: dict[str, Label] = {}
    for stem, group in named.items():
        if len(set(group.values())) == 1:
            found[stem] = next(iter(group.values()))
        else:
            found |= {"_".join(place.parts): one for place, one in group.items()}
    return found


def label_of(labels: Mapping[str, Label], file: Path) -> Label | None:
    """Return the label of the scan in `file`, from `labels` as `read_labels` gives them; None if they have none."""
    parts = file.resolve().parent.parts[1:]
    names = ("_".join((*parts[len(parts) - depth :], stem_of(file))) for depth in range(len(parts) + 1))
    return next((labels[name] for name in names if name in labels), None)


def _intensity(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text).strip()
