"""PLY, ascii and binary, as described by G. Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.parsing import (
    CUT_SHORT,
    SPACE,
    IndexArray,
    WordCursor,
    bytes_of_colours,
    check_count,
    damage_error,
    fan_triangles,
    floats,
    ints,
    join_parts,
    mesh_of,
    numeric_text,
    plain_text,
)
from shapespace.types import BoolArray, ByteArray, FloatArray, Mesh

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip
_FLOATS = {"f4", "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20  # bytes (1 MiB)
_FIRST_LINES = 512  # bytes that contain the comment
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_OBSERVED, _POSITION_STD = "observed", "position_std"
"""Vertex properties of meshes in correspondence: 0 for estimated positions, else 1; and `Mesh.position_std`."""
_INDEX_LISTS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Property:
    name: str
    item: str
    count: str | None = None


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]

    def least_bytes(self, ascii_text: bool) -> int:
        """Return the smallest size of a row in bytes; an ascii value takes a digit and a separator."""
        if ascii_text:
            return 2 * len(self.properties)
        return sum(np.dtype(p.count or p.item).itemsize for p in self.properties)

    def index_list(self) -> int | None:
        """Index of the list of corners among the properties; None without one."""
        places = (i for i, p in enumerate(self.properties) if p.count is not None and p.name in _INDEX_LISTS)
        return next(places, None)

    def kinds(self, *names: str) -> set[str]:
        """Return the types of the properties with one of the names."""
        return {p.item for p in self.properties if p.name in names}


def read_ply(data: bytes, path: Path) -> Mesh:
    """Read PLY: all scalar types, both byte orders, colours, extra properties and elements, polygons as fans.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is not PLY, is cut short, or contains triangle strips.
        MeshError: faces that point past the end of the vertices.
    """
    data = plain_text(data)
    order, elements, offset = _header(data, path)
    header = data[:offset]
    data = data if order else numeric_text(data, path, offset)
    vertices: _Vertices | None = None
    faces: IndexArray | None = None
    is_text, cursor = order == "", WordCursor(data, path, offset)
    for element in elements:
        if element.name == "tristrips":
            raise damage_error(path, "it contains triangle strips, so export it again with plain triangles")
        available = cursor.left if is_text else len(data) - cursor.position
        check_count(element.count, element.least_bytes(is_text), available, _plural(element.name), path)
        has_faces = element.name == "face" and element.count > 0
        list_index = element.index_list() if has_faces else None
        if has_faces and list_index is None:
            raise damage_error(path, "its faces have no property vertex_indices, so export it again")
        if any(p.count is not None for p in element.properties):
            read_lists = _ascii_lists if is_text else _binary_lists
            counts, corners = read_lists(cursor, element, order, list_index)
            if element.name == "vertex":
                raise damage_error(path, "its vertices have list properties, so export it again without them")
            if list_index is not None:
                if len(counts) and counts.min() < 0:
                    raise damage_error(path, f"a face has {int(counts.min())} corners; {CUT_SHORT}")
                faces = fan_triangles(counts, corners)
        elif element.name == "vertex":
            vertices = _read_vertices(cursor, element, order)
        elif is_text:
            for _ in cursor.words(element.count * len(element.properties)):
                pass
        else:
            cursor.position += element.count * element.least_bytes(False)
    if vertices is None:
        raise damage_error(path, "its header declares no vertices")
    positions, colours, observed, std = vertices
    return mesh_of(positions, faces, path, colours, observed=observed, position_std=std, header=header)


def probe_ply(head: bytes, size: int, path: Path) -> None:
    """Check that a PLY file is at least as long as its header declares, with three or more corners per face.

    Args:
        head: first bytes of the file.
        size: size of the file, bytes.
        path: path of the file, used in messages.

    Raises:
        FileFormatError: it is not PLY, or cut short.
    """
    order, elements, offset = _header(head, path)
    for element in elements:
        check_count(element.count, 1, size - offset + 1, _plural(element.name), path)
        corners = [p for p in element.properties if element.name == "face" and p.count is not None]
        element_bytes = element.least_bytes(order == "") + sum(
            3 * (np.dtype(p.item).itemsize if order else 2) for p in corners
        )
        check_count(element.count, element_bytes, size - offset + 1, _plural(element.name), path)
        offset += element.count * element_bytes


def _plural(name: str) -> str:
    return {"vertex": "vertices", "face": "faces"}.get(name, f"'{name[:40]}' elements")


def _header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise damage_error(path, "it does not start with 'ply', so it is not a PLY file")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if end < 0:
        raise damage_error(path, f"its header has no end; {CUT_SHORT}")
    head = data[:end]
    after = end + len(b"end_header")
    newline = b"\r\n" if b"\r\n" in head else (b"\n" if b"\n" in head else b"\r")
    stop = data.find(newline, after, after + 80)
    start = stop + len(newline) if stop >= 0 else len(data)
    order: str | None = None
    elements: list[_Element] = []
    for line in head.decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(_Property(words[4], _SCALARS[words[3]], _SCALARS[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _SCALARS[words[1]]))
            else:
                raise ValueError(words[0])
        except (ValueError, KeyError, IndexError) as error:
            raise damage_error(path, f"its header has a line that is not PLY ('{line.strip()[:60]}')") from error
    if order is None:
        raise damage_error(path, "its header does not state whether it is ascii or binary")
    return order, elements, start


_Vertices: TypeAlias = tuple[FloatArray, ByteArray | None, BoolArray | None, FloatArray | None]
"""Positions (V, 3), colours (V, 3), mask (V,) of observed vertices, and `Mesh.position_std` (V,)."""


def _read_vertices(cursor: WordCursor, element: _Element, order: str) -> _Vertices:
    """Return the properties of the vertices; a mask must consist of integers, and `position_std` of finite lengths."""
    names = [p.name for p in element.properties]
    if not set("xyz") <= set(names):
        raise damage_error(cursor.path, "its vertices have no x, y and z")
    three = next((three for three in _COLOURS if set(three) <= set(names)), ())
    flags = [name for name in (_OBSERVED, _POSITION_STD) if name in names]
    read_columns = _binary_columns if order else _ascii_columns
    columns = read_columns(
        cursor, element, order, {name: names.index(name) for name in ("x", "y", "z", *three, *flags)}
    )
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1, dtype=np.float64)
    colours = _colours(np.stack([columns[name] for name in three], axis=1), element.kinds(*three)) if three else None
    mask, std = columns.get(_OBSERVED), columns.get(_POSITION_STD)
    observed = None if mask is None or element.kinds(_OBSERVED) & _FLOATS else np.asarray(mask != 0)
    is_float = bool(element.kinds(_POSITION_STD) & _FLOATS)
    is_length = std is not None and is_float and np.isfinite(std).all() and (std >= 0).all()
    return positions, colours, observed, np.asarray(std, dtype=np.float64) if is_length else None


def _colours(values: npt.NDArray[Any], kinds: set[str]) -> ByteArray | None:
    """Return colours (V, 3), scaled according to the types of their properties."""
    # The type determines the value of white, also of dark scans.
    if kinds == {"u1"}:
        return values.astype(np.uint8) if ((values >= 0) & (values <= 255)).all() else None
    return bytes_of_colours(values)


def _binary_columns(
    cursor: WordCursor, element: _Element, order: str, places: Mapping[str, int]
) -> dict[str, npt.NDArray[Any]]:
    row = np.dtype([(f"p{i}", order + p.item) for i, p in enumerate(element.properties)])
    table = np.frombuffer(cursor.data, dtype=row, count=element.count, offset=cursor.position)
    cursor.position += table.nbytes
    return {name: table[f"p{place}"] for name, place in places.items()}


def _ascii_columns(
    cursor: WordCursor, element: _Element, _order: str, places: Mapping[str, int]
) -> dict[str, npt.NDArray[Any]]:
    width, n_read = len(element.properties), 0
    columns: dict[str, list[FloatArray]] = {name: [] for name in places}
    for part in cursor.words(element.count * width):
        for name, place in places.items():
            # A block of words may begin and end inside a row.
            columns[name].append(floats(part[(place - n_read) % width :: width], cursor.path))
        n_read += len(part)
    if n_read < element.count * width:
        raise _truncation_error(element, cursor.path)
    return {name: join_parts(parts, np.float64) for name, parts in columns.items()}


def _truncation_error(element: _Element, path: Path) -> FileFormatError:
    return damage_error(path, f"it ends among its {_plural(element.name)}; {CUT_SHORT}")


def _ascii_lists(
    cursor: WordCursor, element: _Element, _order: str, list_index: int | None
) -> tuple[IndexArray, IndexArray]:
    if len(element.properties) == 1 and element.count and list_index == 0:
        table = _read_equal_lists(cursor, element.count)
        if table is not None:
            return table[:, 0], table[:, 1:].ravel()
    sizes, corners = array("q"), array("q")
    try:
        for _ in range(element.count):
            for i, p in enumerate(element.properties):
                word = cursor.word()
                size = int(word) if word and p.count is not None else 0
                part = [*chain.from_iterable(cursor.words(size))]
                if not word or len(part) != size:
                    raise _truncation_error(element, cursor.path)
                if i == list_index:
                    sizes.append(size)
                    corners.extend(map(int, part))
    except FileFormatError:
        raise
    except (ValueError, OverflowError) as error:
        raise damage_error(cursor.path, f"a list has text where an integer should be; {CUT_SHORT}") from error
    return np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64)


def _read_equal_lists(cursor: WordCursor, count: int) -> IndexArray | None:
    """Return the sizes and corners (count, n + 1) of lists of equal length; None if their lengths differ."""
    start = cursor.position
    first = cursor.word()
    size = int(ints([first], cursor.path)[0])
    cursor.position = start
    if size <= 0 or count * (size + 1) * 2 > cursor.left:
        return None
    n_read = 0
    parts: list[IndexArray] = []
    for part in cursor.words(count * (size + 1)):
        lengths = part[-n_read % (size + 1) :: size + 1]
        if lengths.count(first) != len(lengths):
            break
        parts.append(ints(part, cursor.path))
        n_read += len(part)
    if n_read == count * (size + 1):
        return np.concatenate(parts).reshape(count, size + 1)
    cursor.position = start
    return None


def _binary_lists(
    cursor: WordCursor, element: _Element, order: str, list_index: int | None
) -> tuple[IndexArray, IndexArray]:
    none = np.zeros(0, dtype=np.int64)
    if element.count == 0:
        return none, none
    if any(p.count is not None and p.count[0] == "f" for p in element.properties):
        raise damage_error(cursor.path, "a list has a length that is not an integer, so export it again")
    uniform = _uniform_lists(cursor, element, order, list_index)
    if uniform is not None:
        return uniform
    endian = "little" if order == "<" else "big"
    plan = [
        (
            np.dtype(p.count).itemsize if p.count else 0,
            np.dtype(p.item).itemsize,
            p.count is not None and p.count[0] == "i",
            i == list_index,
        )
        for i, p in enumerate(element.properties)
    ]
    data, offset = cursor.data, cursor.position
    sizes, corners = array("q"), bytearray()
    for _ in range(element.count):
        for count_bytes, item_bytes, signed, is_kept in plan:
            size = int.from_bytes(data[offset : offset + count_bytes], endian, signed=signed) if count_bytes else 1
            offset += count_bytes
            end = offset + max(size, 0) * item_bytes
            if is_kept:
                sizes.append(size)
                corners += data[offset:end]
            offset = end
        if offset > len(data):
            raise _truncation_error(element, cursor.path)
    cursor.position = offset
    if list_index is None:
        return none, none
    kind = order + element.properties[list_index].item
    return np.array(sizes, dtype=np.int64), _indices(np.frombuffer(corners, kind))


def _uniform_lists(
    cursor: WordCursor, element: _Element, order: str, list_index: int | None
) -> tuple[IndexArray, IndexArray] | None:
    """Read all rows at once if all lists have the lengths of the first row; None otherwise."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    expected: list[tuple[str, int]] = []
    data, offset = cursor.data, cursor.position
    for i, p in enumerate(element.properties):
        if p.count is None:
            fields.append((f"p{i}", order + p.item))
            offset += np.dtype(p.item).itemsize
            continue
        count_type = np.dtype(order + p.count)
        if offset + count_type.itemsize > len(data):
            return None
        size = int(np.frombuffer(data, dtype=count_type, count=1, offset=offset)[0])
        offset += count_type.itemsize
        if not 0 <= size <= (len(data) - offset) // np.dtype(p.item).itemsize:
            return None
        fields += [(f"c{i}", order + p.count), (f"p{i}", order + p.item, (size,))]
        expected.append((f"c{i}", size))
        offset += size * np.dtype(p.item).itemsize
    row = np.dtype(fields)
    end = cursor.position + element.count * row.itemsize
    if end > len(data):
        return None
    table = np.frombuffer(data, dtype=row, count=element.count, offset=cursor.position)
    if any((table[name] != size).any() for name, size in expected):
        return None
    cursor.position = end
    if list_index is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    return table[f"c{list_index}"].astype(np.int64), _indices(table[f"p{list_index}"].ravel())


def _indices(values: npt.NDArray[Any]) -> IndexArray:
    """Return integers of any scalar type as int64; other numbers become -1, which `Mesh` rejects."""
    if values.dtype.kind == "f":
        numbers = values.astype(np.float64)
        is_whole = np.isfinite(numbers) & (numbers == np.floor(numbers)) & (np.abs(numbers) < 2**53)
        return np.where(is_whole, numbers, -1.0).astype(np.int64)
    return values.astype(np.int64)


def write_ply(mesh: Mesh, comment: str = "") -> bytes:
    """Return `mesh` as binary little-endian PLY with double coordinates; reading it back is exact.

    Colours and the mask of observed vertices are vertex properties of type uchar, `position_std` is a float.

    Args:
        mesh: mesh to write, in any unit.
        comment: one line of ASCII text for the header, before the line with the coordinate frame.
    """
    faces = mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"comment {SPACE}", f"element vertex {len(mesh.vertices)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    columns: list[tuple[str, str, tuple[int, ...], npt.NDArray[Any]]] = [("at", "<f8", (3,), mesh.vertices)]
    if mesh.colours is not None:
        lines += [f"property uchar {name}" for name in _COLOURS[0]]
        columns.append(("colour", "u1", (3,), mesh.colours))
    if mesh.observed is not None:
        lines.append(f"property uchar {_OBSERVED}")
        columns.append((_OBSERVED, "u1", (), mesh.observed))
    if mesh.position_std is not None:
        lines.append(f"property float {_POSITION_STD}")
        columns.append((_POSITION_STD, "<f4", (), mesh.position_std))
    rows = np.empty(len(mesh.vertices), dtype=[column[:3] for column in columns])
    for name, _, _, values in columns:
        rows[name] = values
    body = rows.tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        table = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", (3,))])
        table["n"], table["i"] = 3, faces
        body += table.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + body


def ply_comment(path: Path) -> str:
    """Return the first comment in the header of a PLY file, or an empty string without a comment or a readable file."""
    try:
        with path.open("rb") as stream:
            lines = stream.read(_FIRST_LINES).split(b"\n")
    except OSError:
        return ""
    comment_line = next((line for line in lines if line.startswith(b"comment ")), b"")
    return comment_line.removeprefix(b"comment ").decode("ascii", "replace").strip()
