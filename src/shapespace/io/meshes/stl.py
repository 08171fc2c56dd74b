"""STL, ascii and binary: triangles whose equal corners become one vertex."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.io.parsing import (
    CUT_SHORT,
    SPACE,
    IndexArray,
    check_count,
    damage_error,
    floats,
    join_parts,
    line_blocks,
    mesh_of,
    numeric_text,
    plain_text,
)
from shapespace.types import FloatArray, Mesh

_ROW = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# Share of vertices that may merge because float32 cannot distinguish them; with more, the surface would change.
_MOST_MERGED = 0.01
_HEADER, _FIRST_LINE = 80, 512  # bytes: header of binary STL; bytes that contain the first line of text


def read_stl(data: bytes, path: Path) -> Mesh:
    """Read STL; corners that are exactly equal become one vertex, numbered in the order of first appearance.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is not STL, contains no triangles, or is cut short.
    """
    declared = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    # Many binary files start with "solid" too, so the length decides: text interpreted as a number declares billions of
    # triangles.
    if declared >= 0 and len(data) >= 84 + 50 * declared:
        binary = True
    else:
        head = plain_text(data[:4096]).lower()
        binary = not (head.lstrip()[:5] == b"solid" and b"facet" in head)
    if not binary:
        corners = _ascii_corners(data, path)
    elif declared < 0:
        raise damage_error(path, "it is too short to be an STL file")
    else:
        check_count(declared, 50, len(data) - 84, "triangles", path)
        table = np.frombuffer(data, dtype=_ROW, count=declared, offset=84)
        corners = table["corners"].reshape(-1, 3).astype(np.float64)
    if not len(corners):
        raise damage_error(path, "it contains no triangles")
    vertices, index = merge_equal(corners)
    header = data[: _HEADER if binary else _FIRST_LINE]
    return mesh_of(vertices, index.reshape(-1, 3), path, header=header)


def probe_stl(head: bytes, size: int, path: Path) -> None:
    """Check that a binary STL file is as long as its header declares; see `probe_ply` for arguments and errors."""
    if head.lstrip()[:5].lower() != b"solid":
        declared = int.from_bytes(head[80:84], "little") if len(head) >= 84 else 1
        check_count(declared, 50, size - 84, "triangles", path)


def _ascii_corners(data: bytes, path: Path) -> FloatArray:
    corners: list[FloatArray] = []
    count = facets = 0
    last = b""
    for lines in line_blocks(numeric_text(data, path)):
        words = [split for split in map(bytes.split, map(bytes.lower, lines)) if split]
        rows = [split for split in words if split[0] == b"vertex"]
        facets += sum(split[0] == b"facet" for split in words)
        last = words[-1][0] if words else last
        if any(len(split) != 4 for split in rows):
            raise damage_error(path, f"a corner does not have three numbers; {CUT_SHORT}")
        corners.append(floats(chain.from_iterable(split[1:] for split in rows), path).reshape(-1, 3))
        count += len(rows)
    if last != b"endsolid" or count != 3 * facets:
        raise damage_error(path, f"it has {count} corners for {facets} triangles, or has no end; {CUT_SHORT}")
    return join_parts(corners, np.float64, 3)


def merge_equal(points: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Merge exactly equal rows of `points` (N, 3).

    Returns:
        The distinct rows (M, 3) in the order of first appearance, and the index (N,) of each row among them.
    """
    points = points + 0.0  # -0.0 equals 0.0
    bits: npt.NDArray[np.uint64] = np.ascontiguousarray(points).view(np.uint64)
    order = np.lexsort((bits[:, 2], bits[:, 1], bits[:, 0]))
    ranked = bits[order]
    new = np.ones(len(points), dtype=np.bool_)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    # lexsort is stable, so the first row of each group is the first in `points`.
    first = order[new]
    by_appearance = np.argsort(first)
    rank = np.empty(len(first), dtype=np.int64)
    rank[by_appearance] = np.arange(len(first))
    index = np.empty(len(points), dtype=np.int64)
    index[order] = rank[np.cumsum(new) - 1]
    return points[first[by_appearance]], index


def write_stl(mesh: Mesh) -> bytes:
    """Return `mesh` as binary STL: triangles in float32, without vertex numbers.

    Raises:
        InputError: it has no triangles, coordinates too large for float32, or is so far from the origin that
            float32 would merge more than 1 % of its vertices.
    """
    if mesh.faces is None:
        raise InputError(f"{mesh.name} has no triangles, and STL stores only triangles; write it as PLY instead.")
    corners = mesh.vertices[mesh.faces]
    if (np.abs(corners) > np.finfo(np.float32).max).any():
        raise InputError(f"{mesh.name} has coordinates too large for STL; write it as PLY instead.")
    used = np.unique(mesh.faces)
    n_distinct = len(merge_equal(mesh.vertices[used])[0])
    left = len(merge_equal(mesh.vertices[used].astype(np.float32).astype(np.float64))[0])
    if n_distinct - left > _MOST_MERGED * n_distinct:
        raise InputError(
            f"{mesh.name} lies so far from the origin, for its size, that STL's float32 would merge its {n_distinct} "
            f"vertices into {left}; move it to the origin, or write it as PLY."
        )
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    table = np.zeros(len(corners), dtype=_ROW)
    table["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    table["corners"] = corners
    return f"binary STL {SPACE}".encode("ascii").ljust(_HEADER) + len(corners).to_bytes(4, "little") + table.tobytes()
