"""OFF, the text format of Geomview; normals, texture coordinates and face colours are ignored."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

import numpy as np

from shapespace.io.parsing import (
    CUT_SHORT,
    IndexArray,
    check_count,
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

# Geomview writes CN, MeshLab NC.
_KEYWORD = re.compile(rb"(?:ST)?(CN?|NC?)?(4?n?)OFF")
_ROWS = 1 << 13  # rows parsed at once; a few MB as words


def read_off(data: bytes, path: Path) -> Mesh:
    """Read OFF (also COFF, NOFF, CNOFF, NCOFF, STOFF): polygons become fans.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is not text OFF in three dimensions, or it is cut short.
        MeshError: faces that point past the end of the vertices.
    """
    rows = _rows(numeric_text(data, path))
    first = next(rows, [b""])
    keyword = _KEYWORD.match(first[0])
    if keyword is None:
        raise damage_error(path, "it does not start with 'OFF', so it is not an OFF file")
    if keyword[2] or first[-1].upper() == b"BINARY":
        raise damage_error(path, "it is a binary or four-dimensional OFF file, so save it as plain text OFF")
    head = [first[0][keyword.end() :], *first[1:]] if len(first[0]) > keyword.end() else first[1:]
    counts = ints((head or next(rows, first[:0]))[:2], path).tolist()
    if len(counts) < 2:
        raise damage_error(path, f"it does not state the numbers of vertices and faces; {CUT_SHORT}")
    n, m = counts
    check_count(n, 6, len(data), "vertices", path)
    check_count(m, 2, len(data), "faces", path)
    # Normals precede colours, regardless of their order in the keyword.
    kinds = keyword[1] or b""
    colour_column = 0 if b"C" not in kinds else 6 if b"N" in kinds else 3
    points: list[FloatArray] = []
    colours: list[FloatArray | None] = []
    for part in _batches(rows, n, "vertices", path):
        points.append(_points(part, path))
        colours.append(colours_of_words(part, colour_column, path) if colour_column else None)
    vertices = join_parts(points, np.float64, 3)
    faces = join_parts([_faces(part, path) for part in _batches(rows, m, "faces", path)], np.int64, 3)
    return mesh_of(vertices, faces, path, joined_colours(colours))


def _rows(data: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each line that has any, without comments."""
    comments = b"#" in data
    for lines in line_blocks(data):
        for line in lines:
            words = line.partition(b"#")[0].split() if comments else line.split()
            if words:
                yield words


def _batches(rows: Iterator[list[bytes]], count: int, row_kind: str, path: Path) -> Iterator[list[list[bytes]]]:
    left = count
    while left:
        part = list(islice(rows, min(left, _ROWS)))
        if not part:
            raise damage_error(
                path, f"its header declares {count} {row_kind}, but only {count - left} lines follow; {CUT_SHORT}"
            )
        left -= len(part)
        yield part


def _points(rows: list[list[bytes]], path: Path) -> FloatArray:
    if min(map(len, rows)) < 3:
        raise damage_error(path, f"a vertex has fewer than three numbers; {CUT_SHORT}")
    return floats(chain.from_iterable(words[:3] for words in rows), path).reshape(-1, 3)


def _faces(rows: list[list[bytes]], path: Path) -> IndexArray:
    sizes = ints((words[0] for words in rows), path)
    lengths = np.fromiter(map(len, rows), dtype=np.int64, count=len(rows))
    if (sizes < 1).any() or (lengths <= sizes).any():
        raise damage_error(path, f"a face has fewer corners than it declares; {CUT_SHORT}")
    corners = ints(chain.from_iterable(w[1 : 1 + k] for w, k in zip(rows, sizes.tolist(), strict=True)), path)
    return fan_triangles(sizes, corners)


def write_off(mesh: Mesh) -> bytes:
    """Return `mesh` as OFF text, or COFF with its colours, with 17 significant digits: reading it back is exact."""
    faces = np.zeros((0, 3), dtype=np.int32) if mesh.faces is None else mesh.faces
    text = f"{'OFF' if mesh.colours is None else 'COFF'}\n{len(mesh.vertices)} {len(faces)} 0\n"
    pattern = "%.17g %.17g %.17g"
    if mesh.colours is None:
        text += number_lines(mesh.vertices, pattern)
    else:
        text += number_lines(np.hstack([mesh.vertices, mesh.colours]), f"{pattern} %d %d %d 255")
    text += number_lines(faces, "3 %d %d %d")
    return text.encode("ascii")
