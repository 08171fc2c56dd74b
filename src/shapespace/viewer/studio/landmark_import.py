"""Landmarks of scans in files that the user imports: of one specimen, after which the file is named, or of many."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from shapespace.cohort.table import Table, fold_name, is_number, match_rows
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_alignment import match_curves
from shapespace.io.files import write_bytes
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.configuration_tables import header_kind, parse_table
from shapespace.io.landmarks.landmark_configurations import (
    MOST_CURVE_POINTS,
    NO_SLIDERS,
    LandmarkConfigurations,
    consecutive_curves,
    resample_polyline,
)
from shapespace.io.tables.table_io import table_rows
from shapespace.types import MM_PER_UNIT
from shapespace.viewer.studio.project import Point, ScanCurve, State, point_of

_NUMBERED = re.compile(r"[-_ ]?\d+$")
"""Number at the end of the label of a point."""
_SLICER_UNIT = re.compile(rb'"coordinateUnits"\s*:\s*\[?\s*"(\w+)"')
_DEFAULT_NAME = re.compile(r"(?:F|OC|CC)?(?:_\d+)?|curve")
"""Names of curves that 3D Slicer gives, or none."""


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


def read_points(
    content: bytes, name: str, state: State
) -> tuple[tuple[str, ...], dict[str, dict[str, Point]], dict[str, ScanCurve], list[str]]:
    """Return the names of the landmarks in a file, with those of points of curves, the landmarks of each specimen, the
    curves, and sentences on changed or omitted data and on specimens of the file that the project does not have.

    Coordinates are in the frame and unit of the scan's file; those of Slicer are in LPS, as its meshes, and other units
    than mm are converted to that of the specimen. Missing landmarks are omitted. Curves get the number of points of the
    project's curve of their name; closed ones start where they fit best to the first specimen that has them.

    Args:
        content: content of the file, in any format of `read_configurations`.
        name: name of the file.
        state: state of the project.

    Raises:
        InputError: the file cannot be read, is of no specimen, has no 3-D landmarks, or is in cm and the unit of the
            specimen is unknown.
        FileFormatError: two specimens of the file are one of the project.
    """
    raw = _read(content, name)
    if raw.dimensions != 3:
        raise InputError(f"{name} has landmarks in {raw.dimensions}-D; landmarks of scans need x, y and z.")
    if not raw.observed.any():
        raise InputError(f"{name} has no landmarks, only missing ones; give another file.")
    raw, curves = _with_named_curves(raw, state)
    is_single = len(raw) == 1
    rows = (_specimen_of_file(raw.names[0], name, state),) if is_single else raw.names
    matched, unmatched = match_rows(Table({}, rows, name), state.names, "the project", "name the specimens alike")
    observed, points = raw.observed, dict[str, dict[str, Point]]()
    units = {unit.decode() for unit in _SLICER_UNIT.findall(content)} - {"mm"}  # they are read in mm
    for row, place in matched.items():
        specimen = state.specimens[place]
        if units and not specimen.unit:
            raise InputError(
                f"{name} has coordinates in {min(units)}, and the unit of {specimen.id} is not known; set it first, or "
                "save the landmarks in mm, the unit that 3D Slicer takes for each mesh."
            )
        own = raw.points[row] / (MM_PER_UNIT[specimen.unit] if units else 1.0)
        points[specimen.id] = {raw.landmarks[k]: point_of(own[k]) for k in range(len(own)) if observed[row, k]}
    names = tuple(name for k, name in enumerate(raw.landmarks) if observed[:, k].any())
    notes = [note.replace(raw.where, name) for note in raw.notes if "match_curves" not in note]  # no option here
    return names, points, curves, [*notes, *([] if is_single else unmatched)]


def _with_named_curves(
    raw: LandmarkConfigurations, state: State
) -> tuple[LandmarkConfigurations, dict[str, ScanCurve]]:
    """Return landmarks after whose last one the points of each curve follow, called after it, and the curves."""
    on_curves = {point for points, _ in raw.curves for point in points}
    fixed = [k for k in range(len(raw.landmarks)) if k not in on_curves]
    parts, curves = [raw.points[:, fixed]], dict[str, ScanCurve]()
    for number, (points, closed) in enumerate(raw.curves, 1):
        called = _NUMBERED.sub("", raw.landmarks[points[0]]).strip()
        called = f"curve {number}" if called in curves or _DEFAULT_NAME.fullmatch(called) else called
        curve = curves[called] = state.curves.get(called, ScanCurve(min(len(points), MOST_CURVE_POINTS), closed))
        own = raw.points[:, points]
        is_equal = len(points) == curve.points
        parts.append(own if is_equal else np.array([resample_polyline(x, curve.points, closed) for x in own]))
    on_curve = [point for called, curve in curves.items() for point in curve.names(called)]
    names = (*(raw.landmarks[k] for k in fixed), *on_curve)
    spans = consecutive_curves(len(fixed), [part[0] for part in parts[1:]], [closed for _, closed in raw.curves])
    named = replace(raw, points=np.concatenate(parts, axis=1), landmarks=names, curves=spans, curve_sliders=NO_SLIDERS)
    known = (specimen.points for specimen in state.specimens if {*names} <= {*specimen.points})
    first = next((np.array([points[name] for name in names]) for points in known), None)
    return (match_curves(named, first) if curves else named), curves


def _specimen_of_file(stated: str, file: str, state: State) -> str:
    """Return the specimen of a file with one: the stated name, or the longest with which the file's name begins."""
    stem = fold_name(Path(file).stem)
    begun = [name for own in state.names for name in own if re.match(rf"{re.escape(fold_name(name))}([ ._-]|$)", stem)]
    return stated if _is_known(stated, state) else max(begun, key=len, default=Path(file).stem)


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
