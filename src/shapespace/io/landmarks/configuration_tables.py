"""Tables of the landmarks of many specimens: wide (geomorph, MorphoJ), and long with a row for each landmark."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations, marked_missing
from shapespace.io.landmarks.tps_nts import coordinates
from shapespace.io.parsing import damage_error
from shapespace.io.read_limits import LARGEST_CONFIGURATIONS_FILE_BYTES
from shapespace.io.tables.table_io import KEYS, key_column, rows_text, table_rows
from shapespace.reprs import first_names
from shapespace.types import FloatArray

CLASSIFIERS = ".classifiers.txt"
"""Ending of the file with the further columns of a MorphoJ table, which is read with the table of the same name."""
_AXIS_FIRST = re.compile(r"([xyz])[ ._-]?(\d+)", re.IGNORECASE)
_AXIS_LAST = re.compile(r"(.*\d|.+?)(?:(?<=\d)|[ ._-])([xyz])", re.IGNORECASE)
_LANDMARK = ("landmark", "landmarks", "lm", "point", "semilandmark")
_KEYS = (*KEYS, "individual", "label")
_NAMED = 3  # names in a sentence
_Columns = dict[str, tuple[str, ...]]


def header_kind(header: Sequence[str]) -> str:
    """Return `wide`, `long`, `single` (one specimen: name, x, y, z) or an empty string for the header of a table."""
    lower = [name.lower() for name in header]
    if {"x", "y"} <= set(lower):
        if key_column(header, _LANDMARK) is None:
            return "single" if key_column(header) == 0 and "z" in lower else ""
        return "long"
    # Tables of coefficients have columns z1, z2, ... alone.
    return "wide" if sum({"x", "y"} <= set(axes) for axes in _landmark_columns(header).values()) > 1 else ""


def _landmark_columns(header: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return landmark -> axis -> column for the styles x1, X.1, 1.X, 1X, lm1_x and nose_x."""
    found: dict[str, dict[str, int]] = {}
    for column, name in enumerate(header):
        first, last = _AXIS_FIRST.fullmatch(name.strip()), _AXIS_LAST.fullmatch(name.strip())
        if match := first or last:
            label, axis = (match[2], match[1]) if first else (match[1], match[2])
            found.setdefault(label, {})[axis.lower()] = column
    # R writes an X before column names that begin with a digit.
    return {
        label[1:] if re.fullmatch(r"X\d+", label) else label: axes
        for label, axes in found.items()
        if re.search(r"\d$", label) or {"x", "y"} <= set(axes)
    }


def parse_table(content: bytes, path: Path) -> LandmarkConfigurations:
    """Return the landmarks in a wide or long table (CSV, tab-separated or Excel), with its other columns."""
    header, rows = _table(content, path)
    kind = header_kind(header)
    if kind not in ("wide", "long"):
        known = "such as x1, y1, x2, y2 or specimen, landmark, x, y"
        raise damage_error(path, f"its header has no landmark columns, {known} ({', '.join(header)[:60]})")
    if not rows:
        raise damage_error(path, "it has no specimens below its header")
    names, labels, points, columns, notes = (_wide if kind == "wide" else _long)(header, rows, path)
    points, coded = marked_missing(points, names)
    numbered = labels == list(map(str, range(1, len(labels) + 1)))
    return LandmarkConfigurations(
        names=tuple(names),
        points=points,
        landmarks=() if numbered else tuple(labels),
        columns=columns,
        where=str(path),
        notes=(*notes, *coded),
    )


_Content = tuple[list[str], list[str], FloatArray, _Columns, list[str]]
"""Names, landmarks, points (N, L, D), further columns, and notes."""


def _table(content: bytes, path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        header, *rows = table_rows(content)
    except ValueError as error:
        raise FileFormatError(f"{path} {error}; correct the table.") from error
    return header, [[cell.strip() for cell in row] for row in rows]


def _axes(found: Mapping[str, Mapping[str, int]], path: Path) -> str:
    axes = "xyz" if any("z" in one for one in found.values()) else "xy"
    for label, one in found.items():
        if lacking := set(axes) - set(one):
            advice = "do not mix 2-D and 3-D landmarks" if lacking == {"z"} else "add it"
            raise damage_error(path, f"landmark {label[:40]!r} has no column for its {min(lacking)}; {advice}")
    return axes


def _wide(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> _Content:
    found = _landmark_columns(header)
    labels, width = list(found), _axes(found, path)
    used = [one[axis] for one in found.values() for axis in width]
    key = 0 if header[0].lower() in _KEYS else key_column(header, _KEYS)
    if key is None and 0 not in used and (not header[0] or len({row[0] for row in rows}) == len(rows)):
        key = 0
    names = [f"specimen {k}" if key is None else row[key] for k, row in enumerate(rows, 1)]

    def read(name: str, row: Sequence[str]) -> list[float]:
        cells = (row[column] for column in used)
        return coordinates(cells, path, lambda at: f"landmark {labels[at // len(width)]} of {name[:40]!r}")

    points = np.array([read(name, row) for name, row in zip(names, rows, strict=True)])
    others = {head: k for k, head in enumerate(header) if head and k != key and k not in set(used)}
    columns: _Columns = {head: tuple(row[k] for row in rows) for head, k in others.items()}
    further, notes = _classifiers(names, path)
    return names, labels, points.reshape(len(rows), -1, len(width)), {**further, **columns}, notes


def _classifiers(names: Sequence[str], path: Path) -> tuple[_Columns, list[str]]:
    """Return the columns of the classifiers beside a MorphoJ table, and a note."""
    beside = path.with_name(f"{path.name.removesuffix(path.suffix)}{CLASSIFIERS}")
    if path.suffix.lower() != ".txt" or not beside.is_file():
        return {}, []
    header, rows = _table(read_bytes(beside, LARGEST_CONFIGURATIONS_FILE_BYTES), beside)
    row = {row[0]: row for row in rows}
    lacking = [name for name in names if name not in row]
    if lacking:
        raise damage_error(beside, f"it has no row for {first_names(lacking, _NAMED)}")
    columns = {head: tuple(row[name][k] for name in names) for k, head in enumerate(header) if k}
    return columns, [f"The columns {', '.join(columns)} are those of {beside.name}."]


def _long(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> _Content:
    lower = [name.lower() for name in header]
    key = 0 if lower[0] in _KEYS else key_column(header, _KEYS)
    landmark = key_column(header, _LANDMARK)
    if key is None or landmark is None:
        raise damage_error(path, f"its header names no specimen ({', '.join(header)[:60]}); add the column specimen")
    axes = [lower.index(axis) for axis in "xyz" if axis in lower]
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        name, label = row[key], row[landmark]
        if (name, label) in found:
            raise damage_error(path, f"specimen {name[:40]!r} has two rows of landmark {label[:40]!r}, so remove one")
        cells = (row[axis] for axis in axes)
        found[name, label] = coordinates(cells, path, lambda _, of=(label, name): f"landmark {of[0]} of {of[1]!r}")
    names, labels = (list(dict.fromkeys(pair[k] for pair in found)) for k in (0, 1))
    absent = len(names) * len(labels) - len(found)
    if absent > len(found):
        raise damage_error(path, "most specimens lack most landmarks; give each specimen the same landmark names")
    nothing = [math.nan] * len(axes)
    points = np.array([[found.get((name, label), nothing) for label in labels] for name in names])
    notes, columns = list[str](), _Columns()
    for column, head in enumerate(header):
        if column not in (key, landmark, *axes) and head:
            cells = {(row[key], row[column]) for row in rows}
            if len(cells) == len(names):
                columns[head] = tuple(dict(cells)[name] for name in names)
            else:
                notes.append(f"The column {head} is left out, since it differs between the landmarks of a specimen.")
    if absent:
        lacking = [name for name in names if any((name, label) not in found for label in labels)]
        notes.append(f"{absent} landmarks without a row are missing ({first_names(lacking, _NAMED)}).")
    return names, labels, points, columns, notes


def _cells(points: FloatArray) -> list[str]:
    return ["NA" if math.isnan(value) else repr(value) for value in points.ravel().tolist()]


def wide_text(found: LandmarkConfigurations) -> str:
    """Return a table with a row for each specimen: name, columns, coordinates as `two.d.array` of geomorph has them."""
    axes, columns = "XYZ"[: found.dimensions], found.columns
    header = ["name", *columns, *(f"{label}.{axis}" for label in found.landmarks for axis in axes)]
    repeated = next((name for name, count in Counter(header).items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"{found.where}: a table cannot have the column {repeated[:40]!r} twice; rename one.")
    rows = zip(
        found.names, zip(*columns.values(), strict=True) if columns else [()] * len(found), found.points, strict=True
    )
    return rows_text([header, *([name, *cells, *_cells(points)] for name, cells, points in rows)])


def long_text(found: LandmarkConfigurations) -> str:
    """Return a table with a row for each landmark of each specimen: specimen, landmark, coordinates, columns."""
    rows = [
        [name, label, *_cells(point), *(cells[k] for cells in found.columns.values())]
        for k, (name, points) in enumerate(zip(found.names, found.points, strict=True))
        for label, point in zip(found.landmarks, points, strict=True)
    ]
    return rows_text([["specimen", "landmark", *"xyz"[: found.dimensions], *found.columns], *rows])


def morphoj_texts(found: LandmarkConfigurations) -> tuple[str, str]:
    """Return the two tables of MorphoJ, separated by tabs: coordinates, and classifiers, empty without columns."""
    lacking = [name for name, row in zip(found.names, found.observed, strict=True) if not row.all()]
    if lacking:
        names = first_names(lacking, _NAMED)
        raise InputError(f"MorphoJ cannot read missing landmarks ({names}); estimate them first with shapespace align.")
    numbers = range(1, len(found.landmarks) + 1)
    table = [["ID", *(f"{axis}{k}" for k in numbers for axis in "xyz"[: found.dimensions])]]
    table += [[name, *_cells(points)] for name, points in zip(found.names, found.points, strict=True)]
    classes = [["ID", *found.columns], *map(list, zip(found.names, *found.columns.values(), strict=True))]
    if any(re.search(r"[\t\r\n]", cell) for row in (*table, *classes) for cell in row):
        raise InputError(f"{found.where}: MorphoJ cannot read names or cells with tabs or line breaks.")
    texts = ["".join("\t".join(row) + "\n" for row in rows) for rows in (table, classes)]
    return texts[0], texts[1] if found.columns else ""
