"""Bosphorus (`.bnt`): a scan as a grid of points seen from the front.

Layout, as in the database's own reader (A. Savran, `read_bntfile`, 2008), little-endian and without padding: uint16
rows, uint16 columns, float64 zmin, uint16 length of the image's name, the name, uint32 count (5 · rows · columns), then
five runs of rows · columns float64: x, y, z in mm, and two image coordinates from 0 to 1. Points with z = zmin are
missing.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np

from shapespace.io.parsing import CUT_SHORT, IndexArray, check_count, damage_error, mesh_of
from shapespace.types import FloatArray, Mesh

_HEADER = struct.Struct("<HHdH")
_COUNT = struct.Struct("<I")
_COLUMNS = 5  # x, y, z and two image coordinates
# On a surface inclined to the camera the steps grow by 1 / cos: a factor of 8 keeps surfaces inclined up to 82 degrees.
_LONGEST_STEPS = 8.0


def read_bnt(data: bytes, path: Path) -> Mesh:
    """Read a Bosphorus scan: its points row by row without missing ones, and triangles between neighbours.

    A cell of the grid becomes two triangles if its four corners are present, and one if three are present. A triangle
    with an edge longer than 8 times the median step between neighbours spans a jump in depth and is omitted. The faces
    are oriented along +z, towards the camera.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: the header is inconsistent or does not match the length of the file, or all points are missing.
    """
    if len(data) < _HEADER.size:
        raise damage_error(path, f"it is too short to be a Bosphorus file; {CUT_SHORT}")
    rows, columns, zmin, name_length = _HEADER.unpack_from(data)
    data_start = _HEADER.size + name_length
    if len(data) < data_start + _COUNT.size:
        raise damage_error(path, f"its header is cut off; {CUT_SHORT}")
    (count,) = _COUNT.unpack_from(data, data_start)
    data_start += _COUNT.size
    points = rows * columns
    if not points or count != _COLUMNS * points:
        raise damage_error(
            path,
            f"its header declares {rows} rows, {columns} columns and {count} numbers, so it is not a Bosphorus file "
            "(5 numbers per point)",
        )
    check_count(count, 8, len(data) - data_start, "numbers", path)
    if not math.isfinite(zmin):
        raise damage_error(path, "its depth of missing points is not finite, so it is damaged")
    grid = np.frombuffer(data, dtype="<f8", count=3 * points, offset=data_start).reshape(3, points).T.astype(np.float64)
    # zmin is the smallest depth in the file.
    is_measured = ~(grid[:, 2] <= zmin)
    if not is_measured.any():
        raise damage_error(path, "all its points are missing")
    number = np.full(points, -1, dtype=np.int64)
    number[is_measured] = np.arange(int(is_measured.sum()))
    vertices = grid[is_measured]
    faces = grid_triangles(number.reshape(rows, columns), vertices)
    return mesh_of(vertices, faces, path)


def grid_triangles(number: IndexArray, vertices: FloatArray) -> IndexArray:
    """Return the triangles (F, 3) between neighbours in a grid, oriented along +z.

    Args:
        number: (R, C) index of the vertex at each grid position, -1 for none.
        vertices: (V, 3) float64 positions, in any unit.
    """
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    has_a, has_b, has_c, has_d = a >= 0, b >= 0, c >= 0, d >= 0
    corners = [
        (has_a & has_b & has_c, (a, c, b)),
        (has_b & has_c & has_d, (b, c, d)),
        (has_a & has_c & has_d & ~has_b, (a, c, d)),
        (has_a & has_b & has_d & ~has_c, (a, d, b)),
    ]
    faces = np.concatenate(
        [np.stack([corner[is_complete] for corner in triple], axis=1) for is_complete, triple in corners]
    )
    steps = np.concatenate([_steps(number[:, :-1], number[:, 1:], vertices), _steps(number[:-1], number[1:], vertices)])
    steps = steps[np.isfinite(steps)]
    if not len(steps):
        return faces[:0]
    positions = vertices[faces]
    edges = np.linalg.norm(positions - np.roll(positions, 1, axis=1), axis=2)
    # A comparison with NaN is false, so triangles with NaN corners are removed too.
    keep = (edges <= _LONGEST_STEPS * np.median(steps)).all(axis=1)
    faces, positions = faces[keep], positions[keep]
    along, across = positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0]
    towards = float((along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]).sum())
    return faces[:, ::-1] if towards < 0 else faces


def _steps(first: IndexArray, second: IndexArray, vertices: FloatArray) -> FloatArray:
    is_edge = (first >= 0) & (second >= 0)
    return np.linalg.norm(vertices[first[is_edge]] - vertices[second[is_edge]], axis=1)
