"""Labels of scans from a table such as `shapespace data faces` writes, matched by the names of the scans."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes
from shapespace.report.markup import as_mapping, listed
from shapespace.report.saved import Folder, SavedFit

FILE = "labels.csv"
_NAMES = ("file", "scan", "name")
_LABELS = ("label", "expression", "class", "group", "subject")
_LARGEST_BYTES = 16 * 2**20


@dataclass(frozen=True)
class Label:
    """What is known of one scan.

    Args:
        text: its class, such as an expression.
        intensity: from 0 to 1, or None where the table does not say.
        subject: whom it shows, or empty.
    """

    text: str
    intensity: float | None = None
    subject: str = ""


def read_labels(path: Path) -> dict[str, Label]:
    """Return the labels in a CSV table by the name of the scan, without folder and ending.

    The scan stands in the column `file`, `scan` or `name`; its class in `label`, `expression`, `class`, `group` or
    `subject`, the first that is there; `intensity` and `subject` may stand beside it.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not such a table.
    """
    content = read_bytes(path)
    if len(content) > _LARGEST_BYTES:
        raise FileFormatError(f"{path} is too large for a table of labels ({len(content) / 2**20:.0f} MiB).")
    try:
        rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path} is not a CSV table in UTF-8 ({error}).") from error
    heads = list(rows[0]) if rows else []
    name = next((head for head in _NAMES if head in heads), None)
    label = next((head for head in _LABELS if head in heads), None)
    if name is None or label is None:
        raise FileFormatError(
            f"{path} is no table of labels; it needs rows, a column {_NAMES[0]} and a column {_LABELS[0]} or "
            f"{_LABELS[1]}."
        )
    found: dict[str, Label] = {}
    for row in rows:
        text = _printable(row[label] or "")
        if row[name] and text:
            found[PurePath(row[name]).stem] = Label(
                text, _intensity(row.get("intensity")), _printable(row.get("subject") or "")
            )
    return found


def find_labels(folder: Folder, fits: Sequence[SavedFit], given: Path | None) -> tuple[dict[str, Label], str]:
    """Return labels and a sentence that says where they come from, or why there are none.

    They are looked for in `given`, else in labels.csv in `folder`, else beside the scans.

    Raises:
        FileError: `given` cannot be read.
        FileFormatError: the table is damaged.
    """
    if given is not None:
        return read_labels(given), f"Labels are from {given.name}."
    places = [folder.root / FILE]
    for fit in fits:
        path = as_mapping(fit.record.get("scan")).get("path")
        if isinstance(path, str) and path and "\0" not in path:
            beside = (folder.root / path).parent / FILE
            if beside not in places:
                places.append(beside)
    if places[0].is_file():
        return read_labels(places[0]), f"Labels are from {FILE} in the folder."
    found: dict[str, Label] = {}
    used: list[str] = []
    for place in filter(Path.is_file, places[1:]):
        found |= read_labels(place)
        used.append(f"{place.parent.name}/{FILE}")
    return found, f"Labels are from {listed(used)}, beside the scans." if used else ""


def labelled(fit: SavedFit, labels: Mapping[str, Label]) -> SavedFit:
    """Return `fit` with its label, found by the scan's file name or the name of the fit; as it is without one."""
    scan = as_mapping(fit.record.get("scan")).get("name")
    label = labels.get(PurePath(scan).stem if isinstance(scan, str) else fit.name) or labels.get(fit.name)
    if label is None:
        return fit
    more: dict[str, Any] = {"expression": label.text, "subject": label.subject}
    if label.intensity is not None:
        more["intensity"] = label.intensity
    return replace(fit, entry={**fit.entry, **more})


def _intensity(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text).strip()
