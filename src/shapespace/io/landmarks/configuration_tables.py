"""Tables of the landmarks of many specimens: wide (geomorph, MorphoJ), and long with a row for each landmark."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations, marked_missing
from shapespace.io.landmarks.tps_nts import coordinate
from shapespace.io.parsing import damage_error
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
    """Return the landmarks in a wide or long table (CSV, tab-separated or Excel), with its other columns.

    Raises:
        FileFormatError: it has no such columns, or a cell that is no number.
        InputError: two specimens have one name.
    """
    header, rows = _table(content, path)
    kind = header_kind(header)
    if kind not in ("wide", "long"):
        raise damage_error(
            path,
            "its header has no landmark columns, such as x1, y1, x2, y2 or specimen, landmark, x, y "
            f"({', '.join(header)[:60]})",
        )
    if not rows:
        raise damage_error(path, "it has no specimens below its header")
    return _wide(header, rows, path) if kind == "wide" else _long(header, rows, path)


def _table(content: bytes, path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        header, *rows = table_rows(content)
    except ValueError as error:
        raise FileFormatError(f"{path} {error}; correct the table.") from error
    return header, [[cell.strip() for cell in row] for row in rows]


def _dimensions(axes: Mapping[str, Mapping[str, int]], path: Path) -> str:
    with_z = ["z" in one for one in axes.values()]
    for label, one in axes.items():
        if lacking := {"x", "y"} - set(one):
            raise damage_error(path, f"landmark {label[:40]!r} has no column for its {min(lacking)} coordinate")
    if any(with_z) and not all(with_z):
        label = list(axes)[with_z.index(False)]
        raise damage_error(path, f"landmark {label[:40]!r} has no z and others have; do not mix 2-D and 3-D landmarks")
    return "xyz" if any(with_z) else "xy"


def _wide(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> LandmarkConfigurations:
    axes = _landmark_columns(header)
    width = _dimensions(axes, path)
    used = {column for one in axes.values() for column in one.values()}
    key = 0 if header[0].lower() in _KEYS else key_column(header, _KEYS)
    if key is None and 0 not in used and (not header[0] or len({row[0] for row in rows}) == len(rows)):
        key = 0
    names = [f"specimen {k}" if key is None else row[key] for k, row in enumerate(rows, 1)]
    points = np.array([
        [[coordinate(row[one[axis]], f"landmark {label} of {name[:40]!r}", path) for axis in width]
         for label, one in axes.items()] for name, row in zip(names, rows, strict=True)
    ])  # fmt: skip
    columns = {
        head: tuple(row[column] for row in rows)
        for column, head in enumerate(header)
        if column not in used and column != key and head
    }
    columns, notes = _with_classifiers(columns, names, path)
    points, coded = marked_missing(points, names)
    return LandmarkConfigurations(
        names=tuple(names), points=points, landmarks=_names(list(axes)), columns=columns, where=str(path),
        notes=(*notes, *coded),
    )  # fmt: skip


def _names(labels: Sequence[str]) -> tuple[str, ...]:
    return tuple(labels) if [*labels] != [str(k) for k in range(1, len(labels) + 1)] else ()


def _with_classifiers(
    columns: dict[str, tuple[str, ...]], names: Sequence[str], path: Path
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Return the columns with those of the classifiers of a MorphoJ table beside it."""
    beside = path.with_name(f"{path.name.removesuffix(path.suffix)}{CLASSIFIERS}")
    if path.suffix.lower() != ".txt" or not beside.is_file():
        return columns, []
    header, rows = _table(beside.read_bytes(), beside)
    by_name = {row[0]: row for row in rows}
    lacking = [name for name in names if name not in by_name]
    if lacking:
        raise damage_error(beside, f"it has no row for {first_names(lacking, _NAMED)}")
    further = {head: tuple(by_name[n][k] for n in names) for k, head in enumerate(header) if k and head not in columns}
    return columns | further, [f"The columns {', '.join(further)} are those of {beside.name}."]


def _long(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> LandmarkConfigurations:
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
        what = f"landmark {label[:40]} of {name[:40]!r}"
        found[name, label] = [coordinate(row[axis], what, path) for axis in axes]
    names = list(dict.fromkeys(name for name, _ in found))
    labels = list(dict.fromkeys(label for _, label in found))
    if len(names) * len(labels) > 2 * len(found):
        raise damage_error(path, "most specimens lack most landmarks; give each specimen the same landmark names")
    nothing = [math.nan] * len(axes)
    points = np.array([[found.get((name, label), nothing) for label in labels] for name in names])
    notes, columns = list[str](), dict[str, tuple[str, ...]]()
    for column, head in enumerate(header):
        if column in (key, landmark, *axes) or not head:
            continue
        cells = {(row[key], row[column]) for row in rows}
        if len(cells) == len(names):
            columns[head] = tuple(dict(cells)[name] for name in names)
        else:
            notes.append(f"The column {head} is left out, since it differs between the landmarks of a specimen.")
    if absent := [name for name in names if any((name, label) not in found for label in labels)]:
        count = len(names) * len(labels) - len(found)
        notes.append(f"{count} landmarks without a row are missing ({first_names(absent, _NAMED)}).")
    points, coded = marked_missing(points, names)
    return LandmarkConfigurations(
        names=tuple(names), points=points, landmarks=_names(labels), columns=columns, where=str(path),
        notes=(*notes, *coded),
    )  # fmt: skip


def _cells(points: FloatArray) -> list[str]:
    return ["NA" if math.isnan(value) else repr(value) for value in points.ravel().tolist()]


def wide_text(configurations: LandmarkConfigurations) -> str:
    """Return a table with a row for each specimen: name, columns, coordinates as `two.d.array` of geomorph has them."""
    axes = "XYZ"[: configurations.dimensions]
    columns = configurations.columns
    header = ["name", *columns, *(f"{label}.{axis}" for label in configurations.landmarks for axis in axes)]
    repeated = next((name for name, count in Counter(header).items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"{configurations.where}: a table cannot have the column {repeated[:40]!r} twice; rename one.")
    rows = [
        [name, *(cells[k] for cells in columns.values()), *_cells(points)]
        for k, (name, points) in enumerate(zip(configurations.names, configurations.points, strict=True))
    ]
    return rows_text([header, *rows])


def long_text(configurations: LandmarkConfigurations) -> str:
    """Return a table with a row for each landmark of each specimen: specimen, landmark, coordinates, columns."""
    axes = "xyz"[: configurations.dimensions]
    columns = configurations.columns
    rows = [
        [name, label, *_cells(point), *(cells[k] for cells in columns.values())]
        for k, (name, points) in enumerate(zip(configurations.names, configurations.points, strict=True))
        for label, point in zip(configurations.landmarks, points, strict=True)
    ]
    return rows_text([["specimen", "landmark", *axes, *columns], *rows])


def morphoj_texts(configurations: LandmarkConfigurations) -> tuple[str, str]:
    """Return the two tables of MorphoJ, separated by tabs: coordinates, and classifiers, empty without columns.

    Raises:
        InputError: a landmark is missing, which MorphoJ cannot read, or a cell has a tab.
    """
    lacking = [n for n, row in zip(configurations.names, configurations.observed, strict=True) if not row.all()]
    if lacking:
        raise InputError(
            f"MorphoJ cannot read missing landmarks ({first_names(lacking, _NAMED)}); estimate them first with "
            "shapespace align."
        )
    axes = "xyz"[: configurations.dimensions]
    numbers = range(1, len(configurations.landmarks) + 1)
    table = [["ID", *(f"{axis}{k}" for k in numbers for axis in axes)]]
    table += [[name, *_cells(points)] for name, points in zip(configurations.names, configurations.points, strict=True)]
    columns = configurations.columns
    classes = [
        ["ID", *columns],
        *([n, *cells] for n, *cells in zip(configurations.names, *columns.values(), strict=True)),
    ]
    if any(re.search(r"[\t\r\n]", cell) for row in (*table, *classes) for cell in row):
        raise InputError(f"{configurations.where}: MorphoJ cannot read names or cells with tabs or line breaks.")
    texts = ["".join("\t".join(row) + "\n" for row in rows) for rows in (table, classes)]
    return texts[0], texts[1] if columns else ""
