"""Tables of the landmarks of many specimens: wide (geomorph, MorphoJ), and long with a row for each landmark."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shapespace.errors import InputError
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations, mark_missing
from shapespace.io.landmarks.tps_nts import coordinates
from shapespace.io.parsing import damage_error
from shapespace.io.tables.table_io import KEYS, key_column, read_rows, rows_text
from shapespace.reprs import first_names
from shapespace.types import FloatArray

_AXIS_FIRST = re.compile(r"([xyz])[ ._-]?(\d+)", re.IGNORECASE)
_AXIS_LAST = re.compile(r"(.*\d|.+?)(?:(?<=\d)|[ ._-])([xyz])", re.IGNORECASE)
_NUMBERED = re.compile(r"(?:(?:raw|proc)[ ._-]?)?coord[ ._-]?\d+", re.IGNORECASE)
"""Names of coordinate columns of MorphoJ, which do not contain the axis."""
_LANDMARK = ("landmark", "landmarks", "lm", "point", "semilandmark")
_KEYS = (*KEYS, "individual", "label", "identifier")


def header_kind(header: Sequence[str]) -> str:
    """Return `wide`, `long`, `single` (one specimen: name, x, y, z) or an empty string for the header of a table."""
    lower = [name.lower() for name in header]
    if {"x", "y"} <= set(lower):
        if key_column(header, _LANDMARK) is None:
            return "single" if key_column(header) == 0 and "z" in lower else ""
        return "long"
    # Tables of coefficients have only columns z1, z2, ...
    return "wide" if sum({"x", "y"} <= set(axes) for axes in _landmark_columns(header).values()) > 1 else ""


def _landmark_columns(header: Sequence[str], width: int | None = None) -> dict[str, dict[str, int]]:
    """Return landmark -> axis -> column for the styles x1, X.1, 1.X, 1X, lm1_x and nose_x.

    Numbered coordinates of MorphoJ have `width` dimensions; None for 3 if their number allows, or else 2.
    """
    columns: dict[str, dict[str, int]] = {}
    if numbered := [column for column, name in enumerate(header) if _NUMBERED.fullmatch(name.strip())]:
        width = width or (2 if len(numbered) % 3 else 3)
        starts = range(0, len(numbered), width)
        return {str(k): dict(zip("xyz", numbered[at : at + width], strict=False)) for k, at in enumerate(starts, 1)}
    for column, name in enumerate(header):
        first, last = _AXIS_FIRST.fullmatch(name.strip()), _AXIS_LAST.fullmatch(name.strip())
        if match := first or last:
            label, axis = (match[2], match[1]) if first else (match[1], match[2])
            columns.setdefault(label, {})[axis.lower()] = column
    # R writes an X before column names that begin with a digit.
    return {
        label[1:] if re.fullmatch(r"X\d+", label) else label: axes
        for label, axes in columns.items()
        if re.search(r"\d$", label) or {"x", "y"} <= set(axes)
    }


def parse_table(content: bytes, path: Path, dimensions: int | None = None) -> LandmarkConfigurations:
    """Return the landmarks in a wide or long table (CSV, tab-separated or Excel), with its other columns.

    Args:
        content: content of the file.
        path: path of the file, used in messages.
        dimensions: dimension of the space, 2 or 3, for a MorphoJ table whose number of coordinates fits both.
    """
    header, *rows = read_rows(path, content)
    kind = header_kind(header)
    if kind not in ("wide", "long"):
        known = "such as x1, y1, x2, y2 or specimen, landmark, x, y"
        raise damage_error(path, f"its header has no landmark columns, {known} ({', '.join(header)[:60]})")
    count = sum(_NUMBERED.fullmatch(name.strip()) is not None for name in header)
    if count and count % (dimensions or 6) in ((0, 1, 5) if dimensions is None else range(1, dimensions)):
        fits = "fit neither 2-D nor 3-D" if count % 6 in (1, 5) else f"are not a multiple of {dimensions}"
        fits = "fit 2-D and 3-D" if count % 6 == 0 else fits
        advice = (
            "convert it with shapespace landmarks convert --dimensions 2 (or 3), or name the columns x1, y1, x2, y2"
        )
        raise damage_error(path, f"its {count} columns of coordinates of MorphoJ {fits}; {advice}, and so on")
    if not rows:
        raise damage_error(path, "it has no specimens below its header")
    return mark_missing(
        _read_long(header, rows, path) if kind == "long" else _read_wide(header, rows, path, dimensions)
    )


def _axes(columns: Mapping[str, Mapping[str, int]], path: Path) -> str:
    axes = "xyz" if any("z" in landmark for landmark in columns.values()) else "xy"
    for label, landmark in columns.items():
        if lacking := set(axes) - set(landmark):
            advice = "do not mix 2-D and 3-D landmarks" if lacking == {"z"} else "add it"
            raise damage_error(path, f"landmark {label[:40]!r} has no column for its {min(lacking)}; {advice}")
    return axes


def _read_wide(
    header: Sequence[str], rows: Sequence[Sequence[str]], path: Path, dimensions: int | None
) -> LandmarkConfigurations:
    columns = _landmark_columns(header, dimensions)
    labels, width = tuple(columns), _axes(columns, path)
    used = [landmark[axis] for landmark in columns.values() for axis in width]
    key = 0 if header[0].lower() in _KEYS else key_column(header, _KEYS)
    if key is None and 0 not in used and (not header[0] or len({row[0] for row in rows}) == len(rows)):
        key = 0
    names = tuple(f"specimen {k}" if key is None else row[key] for k, row in enumerate(rows, 1))
    cells = (row[column] for row in rows for column in used)

    def describe(at: int) -> str:
        specimen, column = divmod(at, len(used))
        return f"landmark {labels[column // len(width)]} of {names[specimen][:40]!r}"

    others = {head: k for k, head in enumerate(header) if head and k != key and k not in set(used)}
    return LandmarkConfigurations(
        names=names,
        points=np.reshape(coordinates(cells, path, describe), (len(rows), len(labels), len(width))),
        landmarks=labels,
        columns={head: tuple(row[k] for row in rows) for head, k in others.items()},
        where=str(path),
    )


def _read_long(header: Sequence[str], rows: Sequence[Sequence[str]], path: Path) -> LandmarkConfigurations:
    lower = [name.lower() for name in header]
    key = 0 if lower[0] in _KEYS else key_column(header, _KEYS)
    landmark = lower.index(next(name for name in _LANDMARK if name in lower))
    if key is None:
        raise damage_error(path, f"its header names no specimens ({', '.join(header)[:60]}); add the column specimen")
    axes = [lower.index(axis) for axis in "xyz" if axis in lower]
    pairs = [(row[key], row[landmark]) for row in rows]
    if repeated := [pair for pair, count in Counter(pairs).items() if count > 1]:
        name, label = repeated[0]
        raise damage_error(path, f"specimen {name[:40]!r} has two rows of landmark {label[:40]!r}; remove one")
    names, labels = (tuple(dict.fromkeys(pair[k] for pair in pairs)) for k in (0, 1))
    absent = len(names) * len(labels) - len(pairs)
    if absent > len(pairs):
        raise damage_error(path, "most specimens lack most landmarks; give each specimen the same landmark names")
    cells = (row[axis] for row in rows for axis in axes)
    numbers = coordinates(cells, path, lambda at: "landmark {1} of {0!r}".format(*pairs[at // len(axes)]))
    points = np.full((len(names), len(labels), len(axes)), math.nan)
    number, place = ({name: k for k, name in enumerate(listed)} for listed in (names, labels))
    points[[number[a] for a, _ in pairs], [place[b] for _, b in pairs]] = np.reshape(numbers, (-1, len(axes)))
    notes, columns = list[str](), dict[str, tuple[str, ...]]()
    for column, head in enumerate(header):
        if column not in (key, landmark, *axes) and head:
            values = {(row[key], row[column]) for row in rows}
            if len(values) == len(names):
                columns[head] = tuple(dict(values)[name] for name in names)
            else:
                notes.append(f"The column {head} is omitted, since it differs between the landmarks of a specimen.")
    if absent:
        lacking = [name for name, count in Counter(name for name, _ in pairs).items() if count < len(labels)]
        nouns = "landmark without a row is" if absent == 1 else "landmarks without a row are"
        notes.append(f"{absent} {nouns} missing ({first_names(lacking)}).")
    return LandmarkConfigurations(
        names=names, points=points, landmarks=labels, columns=columns, where=str(path), notes=tuple(notes)
    )


def _cells(points: FloatArray) -> list[str]:
    return ["NA" if math.isnan(value) else repr(value) for value in points.ravel().tolist()]


def wide_text(raw: LandmarkConfigurations) -> str:
    """Return a table with a row for each specimen: name, columns, and coordinates as in geomorph's `two.d.array`."""
    coordinates = [f"{label}.{axis}" for label in raw.landmarks for axis in "XYZ"[: raw.dimensions]]
    header = ["name", *raw.columns, *coordinates]
    repeated = next((name for name, count in Counter(header).items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"{raw.where}: a table cannot have the column {repeated[:40]!r} twice; rename one.")
    known = zip(raw.names, *raw.columns.values(), strict=True)
    return rows_text([header, *([*cells, *_cells(points)] for cells, points in zip(known, raw.points, strict=True))])


def long_text(raw: LandmarkConfigurations) -> str:
    """Return a table with a row for each landmark of each specimen: specimen, landmark, coordinates, columns."""
    rows = [
        [name, label, *_cells(point), *(cells[k] for cells in raw.columns.values())]
        for k, (name, points) in enumerate(zip(raw.names, raw.points, strict=True))
        for label, point in zip(raw.landmarks, points, strict=True)
    ]
    return rows_text([["specimen", "landmark", *"xyz"[: raw.dimensions], *raw.columns], *rows])


def morphoj_texts(raw: LandmarkConfigurations) -> tuple[str, str]:
    """Return the two tables of MorphoJ, separated by tabs: coordinates, and classifier variables."""
    lacking = [name for name, row in zip(raw.names, raw.observed, strict=True) if not row.all()]
    if lacking:
        names = first_names(lacking)
        raise InputError(f"MorphoJ cannot read missing landmarks ({names}); estimate them first with shapespace align.")
    numbers = range(1, len(raw.landmarks) + 1)
    table = [["ID", *(f"{axis}{k}" for k in numbers for axis in "xyz"[: raw.dimensions])]]
    table += [[name, *_cells(points)] for name, points in zip(raw.names, raw.points, strict=True)]
    classes = [["ID", *raw.columns], *map(list, zip(raw.names, *raw.columns.values(), strict=True))]
    if any(re.search(r"[\t\r\n]", cell) for row in (*table, *classes) for cell in row):
        raise InputError(f"{raw.where}: MorphoJ cannot read names or cells with tabs or line breaks.")
    first, second = ("".join("\t".join(row) + "\n" for row in rows) for rows in (table, classes))
    return first, second
