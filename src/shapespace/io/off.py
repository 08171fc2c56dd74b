"""OFF, the text format of Geomview, with its colours, normals and texture coordinates ignored."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.parsing import CUT_SHORT, check_count, damaged, fan_triangles, floats, ints, mesh_of, number_lines
from shapespace.types import Mesh

_KEYWORD = re.compile(rb"(?:ST)?C?N?(4?n?)OFF")


def read_off(data: bytes, path: Path) -> Mesh:
    """Read OFF (also COFF, NOFF, STOFF): polygons become fans.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is not text OFF in three dimensions, or it is cut short.
        MeshError: faces that point past the end of the vertices.
    """
    if b"#" in data:
        data = re.sub(rb"#[^\r\n]*", b"", data)
    rows = [words for words in map(bytes.split, data.splitlines()) if words]
    keyword = _KEYWORD.match(rows[0][0]) if rows else None
    if keyword is None:
        raise damaged(path, "it does not start with 'OFF', so it is not an OFF file")
    if keyword[1] or rows[0][-1].upper() == b"BINARY":
        raise damaged(path, "it is a binary or four-dimensional OFF file, so save it as plain text OFF")
    head = [rows[0][0][keyword.end() :], *rows[0][1:]] if len(rows[0][0]) > keyword.end() else rows[0][1:]
    rows = rows[1:]
    if not head and rows:
        head, rows = rows[0], rows[1:]
    counts = ints(head[:2], path).tolist()
    if len(counts) < 2:
        raise damaged(path, f"it does not say how many vertices and faces it has; {CUT_SHORT}")
    n, m = counts
    check_count(n, 6, len(data), "vertices", path)
    check_count(m, 2, len(data), "faces", path)
    if len(rows) < n + m:
        raise damaged(
            path, f"its header declares {n} vertices and {m} faces, but {len(rows)} lines follow; {CUT_SHORT}"
        )
    points, polygons = rows[:n], rows[n : n + m]
    if any(len(words) < 3 for words in points):
        raise damaged(path, f"a vertex has fewer than three numbers; {CUT_SHORT}")
    vertices = floats(chain.from_iterable(words[:3] for words in points), path).reshape(-1, 3)
    if not m:
        return mesh_of(vertices, None, path)
    sizes = ints((words[0] for words in polygons), path)
    lengths = np.fromiter(map(len, polygons), dtype=np.int64, count=m)
    if (sizes < 1).any() or (lengths <= sizes).any():
        raise damaged(path, f"a face has fewer corners than it says; {CUT_SHORT}")
    corners = ints(chain.from_iterable(w[1 : 1 + k] for w, k in zip(polygons, sizes.tolist(), strict=True)), path)
    return mesh_of(vertices, fan_triangles(sizes, corners), path)


def write_off(mesh: Mesh) -> bytes:
    """Return `mesh` as OFF text with 17 significant digits, so that reading it back is exact."""
    faces = np.zeros((0, 3), dtype=np.int32) if mesh.faces is None else mesh.faces
    text = f"OFF\n{len(mesh.vertices)} {len(faces)} 0\n"
    text += number_lines(mesh.vertices, "%.17g %.17g %.17g") + number_lines(faces, "3 %d %d %d")
    return text.encode("ascii")
