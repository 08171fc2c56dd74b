"""Landmarks of scans in files that the user imports: of one specimen, after which the file is named, or of many."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

from shapespace.cohort.table import Table, fold_name, is_number, match_rows
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.files import write_bytes
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.configuration_tables import header_kind, parse_table
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.tables.table_io import table_rows
from shapespace.viewer.studio.project import Point, State, point_of


def is_landmark_table(content: bytes, name: str, state: State) -> bool:
    """Return whether a table has landmarks and no covariates: columns of 3-D landmarks, or a landmark in each row if it
    is named after a specimen.

    Args:
        content: content of the file.
        name: name of the file.
        state: state of the project.

    Raises:
        FileFormatError: landmarks that cannot be read.
    """
    try:
        header, *rows = [*table_rows(content)] or [list[str]()]
    except ValueError:
        return False  # the reader of tables reports the problem
    kind = header_kind(header)
    if kind in ("wide", "long"):
        return parse_table(content, Path(name)).dimensions == 3
    has_rows = kind == "single" or (len(header) == 4 and all(map(is_number, header[1:])))
    has_specimens = any(row and _is_known(row[0], state) for row in rows)
    return has_rows and not has_specimens and _is_known(Path(name).stem, state)


def points_of_file(
    content: bytes, name: str, state: State
) -> tuple[tuple[str, ...], dict[str, dict[str, Point]], list[str]]:
    """Return the names of the landmarks in a file, the landmarks of each specimen, and sentences on changed or omitted
    data and on specimens of the file that the project does not have.

    Slicer's coordinates are in LPS, as its meshes; others are in the frame and unit of the file. Missing landmarks and
    points of curves, which are semilandmarks, are omitted.

    Args:
        content: content of the file, in any format of `read_configurations`.
        name: name of the file.
        state: state of the project.

    Raises:
        InputError: the file cannot be read, is of no specimen, or has no 3-D landmarks.
        FileFormatError: two specimens of the file are one of the project.
    """
    raw = _read(content, name)
    if raw.dimensions != 3:
        raise InputError(f"{name} has landmarks in {raw.dimensions}-D; landmarks of scans need x, y and z.")
    on_curves = {point for points, _ in raw.curves for point in points}
    kept = [k for k in range(len(raw.landmarks)) if k not in on_curves and raw.observed[:, k].any()]
    if not kept:
        raise InputError(f"{name} has no landmarks, only missing ones or points of curves; give another file.")
    is_single = len(raw) == 1
    rows = raw.names if not is_single or _is_known(raw.names[0], state) else (Path(name).stem,)
    matched, unmatched = match_rows(Table({}, rows, name), state.names, "the project", "name the specimens alike")
    points: dict[str, dict[str, Point]] = {}
    for row, place in matched.items():
        seen = [k for k in kept if raw.observed[row, k]]
        points[state.specimens[place].id] = {raw.landmarks[k]: point_of(raw.points[row, k]) for k in seen}
    notes = [note.replace(raw.where, name) for note in raw.notes if not (on_curves and "semilandmarks" in note)]
    if on_curves:
        notes.append(f"{name}: the points of curves are semilandmarks, which are not imported.")
    return tuple(raw.landmarks[k] for k in kept), points, [*notes, *([] if is_single else unmatched)]


def _read(content: bytes, name: str) -> LandmarkConfigurations:
    """Return the landmarks of a file, read from a folder that messages do not name.

    Raises:
        InputError: it cannot be read.
    """
    with TemporaryDirectory(prefix="shapespace-") as folder:
        try:
            write_bytes(Path(folder) / name, content)
            return read_configurations(Path(folder) / name)
        except ShapespaceError as error:
            raise InputError(str(error).replace(f"{folder}{os.sep}", "")) from error


def _is_known(name: str, state: State) -> bool:
    return fold_name(name) in {fold_name(known) for own in state.names for known in own}
