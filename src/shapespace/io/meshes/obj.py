"""Wavefront OBJ: `v` and `f` lines and vertex colours; texture seams, normals and groups are ignored."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.meshes.obj_textures import texture_colours
from shapespace.io.parsing import (
    CUT_SHORT,
    SPACE,
    IndexArray,
    colours_of_words,
    damage_error,
    fan_triangles,
    floats,
    ints,
    join_parts,
    joined_colours,
    line_blocks,
    mesh_of,
    number_lines,
    numeric_text,
)
from shapespace.types import FloatArray, Mesh

_COLOURED_WORDS = 7
"""Of a line such as `v x y z r g b`."""


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read OBJ: one vertex for each `v` line, in the file's order, and polygons as fans.

    Negative indices count back from the last `v` line above. Colours are those after `x y z` where all vertices have
    them, else of the pictures that its materials name; a note says why these are not read. Weights are ignored.

    Args:
        data: the whole file.
        path: its name; materials and pictures are read from its folder and from nowhere else.

    Raises:
        FileFormatError: it has no `v` line, a line with too few numbers, or an index of zero.
        MeshError: faces that point past the end of the vertices.
    """
    data = numeric_text(data, path)
    if b"\\" in data:
        data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    vertices: list[FloatArray] = []
    colours: list[FloatArray | None] = []
    faces: list[IndexArray] = []
    count = polygon_count = 0
    for lines in line_blocks(data):
        points: list[list[bytes]] = []
        polygons: list[list[bytes]] = []
        vertices_above: list[int] = []
        for line in lines:
            words = line.split()
            if not words:
                continue
            if words[0] == b"v":
                points.append(words)
            elif words[0] == b"f":
                polygons.append(words)
                vertices_above.append(count + len(points))
        if points:
            vertices.append(_points(points, count, path))
            # Six numbers are x y z and a colour; a fourth alone is a weight.
            is_coloured = set(map(len, points)) == {_COLOURED_WORDS}
            colours.append(colours_of_words(points, 4, path) if is_coloured else None)
            count += len(points)
        if polygons:
            faces.append(_faces(polygons, vertices_above, polygon_count, path))
            polygon_count += len(polygons)
    if not count:
        raise damage_error(path, "it has no 'v' lines, so it is not an OBJ file or holds no points")
    vertex_colours = joined_colours(colours)
    notes: tuple[str, ...] = ()
    if vertex_colours is None:
        vertex_colours, notes = texture_colours(data, count, path)
    if b"\nl " in data:
        notes = (*notes, "Its lines (l) are no surface, and their points alone are read; save them as VTK for curves.")
    header = data[: data.find(b"\nv")]
    return mesh_of(np.concatenate(vertices), join_parts(faces, np.int64, 3), path, vertex_colours, notes, header=header)


def _points(points: list[list[bytes]], lines_before: int, path: Path) -> FloatArray:
    widths = set(map(len, points))
    if min(widths) < 4:
        line_number = lines_before + next(i for i, words in enumerate(points) if len(words) < 4)
        raise damage_error(path, f"vertex {line_number + 1} has fewer than three numbers; {CUT_SHORT}")
    if len(widths) == 1:
        flat = list(chain.from_iterable(points))
        return np.stack([floats(flat[axis :: len(points[0])], path) for axis in (1, 2, 3)], axis=1)
    return floats(chain.from_iterable(words[1:4] for words in points), path).reshape(-1, 3)


def _faces(polygons: list[list[bytes]], vertices_above: list[int], lines_before: int, path: Path) -> IndexArray:
    # A comment after the corners is rare, and is looked for only where there is a mark.
    if any(b"#" in word for words in polygons for word in (words[-1], *words[4:])):
        polygons = [b" ".join(words).partition(b"#")[0].split() for words in polygons]
    counts = np.fromiter(map(len, polygons), dtype=np.int64, count=len(polygons)) - 1
    if counts.min() < 3:
        line_number = lines_before + int(np.argmin(counts))
        raise damage_error(path, f"face {line_number + 1} has fewer than three corners; {CUT_SHORT}")
    tokens = chain.from_iterable(words[1:] for words in polygons)
    corners = ints((token.partition(b"/")[0] for token in tokens), path)
    if (corners == 0).any():
        raise damage_error(path, "a face points at vertex 0, but OBJ counts from 1; export it again")
    declared = np.repeat(np.array(vertices_above, dtype=np.int64), counts)
    absolute = np.where(corners > 0, corners - 1, corners + declared)
    if absolute.min() < 0:
        raise damage_error(path, f"a face points back past the first vertex; {CUT_SHORT}")
    return fan_triangles(counts, absolute)


def write_obj(mesh: Mesh) -> bytes:
    """Return `mesh` as OBJ text with 17 significant digits, so that reading it back is exact, colours after them."""
    pattern = "v %.17g %.17g %.17g"
    if mesh.colours is None:
        text = number_lines(mesh.vertices, pattern)
    else:
        text = number_lines(np.hstack([mesh.vertices, mesh.colours / 255.0]), f"{pattern} %.6g %.6g %.6g")
    if mesh.faces is not None:
        text += number_lines(mesh.faces.astype(np.int64) + 1, "f %d %d %d")
    return f"# {SPACE}\n{text}".encode("ascii")
