"""Rows of points in text: `.xyz` of scanners and CloudCompare, and `.pts` of Leica, with the number of points first."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.parsing import (
    CUT_SHORT,
    damage_error,
    floats,
    ints,
    is_number,
    join_parts,
    line_blocks,
    mesh_of,
    numeric_text,
)
from shapespace.types import FloatArray, Mesh

_COMMENTS = (b"#", b"//", b"%")


def read_xyz(data: bytes, path: Path) -> Mesh:
    """Read rows whose first three numbers are a point; intensity, colour and normals are ignored.

    A row of one number says how many points follow it. A first line of words is the names of columns, and `#`, `//` and
    `%` begin comments; commas, semicolons and white space separate numbers, which may have decimal commas.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is binary or no table of numbers, rows differ in their columns, or points are missing.
    """
    if b"\0" in data[:65536]:
        raise damage_error(path, "it is binary; of this ending only text with rows of x y z is read")
    parts: list[FloatArray] = []
    width = lines_before = declared = 0
    for lines in line_blocks(numeric_text(data, path, commas_separate=True)):
        rows = [line.replace(b";", b" ").split() for line in lines if not line.lstrip().startswith(_COMMENTS)]
        rows = [row for row in rows if row]
        if rows and not lines_before and not width and not is_number(rows[0][0]) and len(rows[0]) >= 3:
            rows = rows[1:]
        counts = [row[0] for row in rows if len(row) == 1]
        points = [row for row in rows if len(row) > 1]
        if points:
            width = width or len(points[0])
            if any(len(row) != width for row in points) or width < 3:
                raise damage_error(path, f"it is no table of points with three or more columns, {width} in each row")
            if not all(map(is_number, points[0])) and not lines_before:
                raise damage_error(path, "it has words beside its points (a molecule perhaps), so it is no scan")
            coordinates = chain.from_iterable(row[:3] for row in points)
            parts.append(floats(coordinates, path).reshape(-1, 3))
            lines_before += len(points)
        declared += sum(ints(counts, path).tolist())
    if not lines_before:
        raise damage_error(path, "it has no rows of x y z")
    if declared and declared != lines_before:
        raise damage_error(path, f"it declares {declared} points, but {lines_before} follow; {CUT_SHORT}")
    return mesh_of(join_parts(parts, np.float64, 3), None, path)
