"""PLY, ascii and binary, as described by G. Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.io.parsing import CUT_SHORT, IndexArray, check_count, damaged, fan_triangles, floats, ints, mesh_of
from shapespace.types import FloatArray, Mesh

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20
_FIRST_LINES = 512
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
        """Return the least that one row takes: an ascii value needs a digit and a separator."""
        if ascii_text:
            return 2 * len(self.properties)
        return sum(np.dtype(p.count or p.item).itemsize for p in self.properties)

    def index_list(self) -> int | None:
        """Where the list of corners is among the properties."""
        for i, p in enumerate(self.properties):
            if p.count is not None and p.name in _INDEX_LISTS:
                return i
        return None


def read_ply(data: bytes, path: Path) -> Mesh:
    """Read PLY: all scalar types, both byte orders, extra properties and elements, polygons as fans.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is not PLY, is cut short, or holds triangle strips.
        MeshError: faces that point past the end of the vertices.
    """
    order, elements, at = _header(data, path)
    vertices: FloatArray | None = None
    faces: IndexArray | None = None
    tokens = data[at:].split() if order == "" else []
    at = 0 if order == "" else at
    for element in elements:
        if element.name == "tristrips":
            raise damaged(path, "it holds triangle strips, so export it again with plain triangles")
        available = 2 * (len(tokens) - at) if order == "" else len(data) - at
        check_count(element.count, element.least_bytes(order == ""), available, _plural(element.name), path)
        lists = any(p.count is not None for p in element.properties)
        wanted = None
        if element.name == "face" and element.count:
            wanted = element.index_list()
            if wanted is None:
                raise damaged(path, "its faces have no property vertex_indices, so export it again")
        if lists and order == "":
            counts, corners, at = _ascii_lists(tokens, at, element, wanted, path)
        elif lists:
            counts, corners, at = _binary_lists(data, at, element, order, wanted, path)
        else:
            if element.name == "vertex":
                vertices = _positions(data, tokens, at, element, order, path)
            width = len(element.properties) if order == "" else element.least_bytes(False)
            at += element.count * width
            continue
        if element.name == "vertex":
            raise damaged(path, "its vertices carry lists, so export it again without them")
        if wanted is not None:
            if len(counts) and counts.min() < 0:
                raise damaged(path, f"a face has {int(counts.min())} corners; {CUT_SHORT}")
            faces = fan_triangles(counts, corners)
    if vertices is None:
        raise damaged(path, "its header declares no vertices")
    return mesh_of(vertices, faces, path)


def _plural(name: str) -> str:
    return {"vertex": "vertices", "face": "faces"}.get(name, f"'{name[:40]}' elements")


def _header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise damaged(path, "it does not start with 'ply', so it is not a PLY file")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if end < 0:
        raise damaged(path, f"its header has no end; {CUT_SHORT}")
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
            raise damaged(path, f"its header has a line that is not PLY ('{line.strip()[:60]}')") from error
    if order is None:
        raise damaged(path, "its header does not say whether it is ascii or binary")
    return order, elements, start


def _positions(data: bytes, tokens: list[bytes], at: int, element: _Element, order: str, path: Path) -> FloatArray:
    names = [p.name for p in element.properties]
    if not {"x", "y", "z"} <= set(names):
        raise damaged(path, "its vertices have no x, y and z")
    columns = [names.index(axis) for axis in "xyz"]
    width = len(names)
    if order == "":
        values = [floats(tokens[at + c : at + element.count * width : width], path) for c in columns]
        return np.stack(values, axis=1)
    row = np.dtype([(f"p{i}", order + p.item) for i, p in enumerate(element.properties)])
    table = np.frombuffer(data, dtype=row, count=element.count, offset=at)
    out = np.empty((element.count, 3), dtype=np.float64)
    for axis, column in enumerate(columns):
        out[:, axis] = table[f"p{column}"]
    return out


def _ascii_lists(
    tokens: list[bytes], at: int, element: _Element, wanted: int | None, path: Path
) -> tuple[IndexArray, IndexArray, int]:
    if len(element.properties) == 1 and element.count and wanted == 0:
        first = int(ints(tokens[at : at + 1], path)[0])
        end = at + element.count * (first + 1)
        if first > 0 and end <= len(tokens):
            block = tokens[at:end]
            if block[:: first + 1].count(tokens[at]) == element.count:
                table = ints(block, path).reshape(element.count, first + 1)
                return table[:, 0], table[:, 1:].ravel(), end
    sizes: list[int] = []
    corners: list[bytes] = []
    try:
        for _ in range(element.count):
            for i, p in enumerate(element.properties):
                if p.count is None:
                    at += 1
                    continue
                size = int(tokens[at])
                if size < 0 or at + 1 + size > len(tokens):
                    raise IndexError
                if i == wanted:
                    sizes.append(size)
                    corners += tokens[at + 1 : at + 1 + size]
                at += 1 + size
    except ValueError as error:
        raise damaged(path, f"a list has no length; {CUT_SHORT}") from error
    except IndexError as error:
        raise damaged(path, f"it ends among its {_plural(element.name)}; {CUT_SHORT}") from error
    return np.array(sizes, dtype=np.int64), ints(corners, path), at


def _binary_lists(
    data: bytes, at: int, element: _Element, order: str, wanted: int | None, path: Path
) -> tuple[IndexArray, IndexArray, int]:
    none = np.zeros(0, dtype=np.int64)
    if element.count == 0:
        return none, none, at
    if any(p.count is not None and p.count[0] == "f" for p in element.properties):
        raise damaged(path, "a list has a length that is not a whole number, so export it again")
    uniform = _uniform_lists(data, at, element, order, wanted)
    if uniform is not None:
        return uniform
    endian = "little" if order == "<" else "big"
    plan: list[tuple[int, int, bool, bool]] = []
    for i, p in enumerate(element.properties):
        count_bytes = 0 if p.count is None else np.dtype(p.count).itemsize
        signed = p.count is not None and p.count[0] == "i"
        plan.append((count_bytes, np.dtype(p.item).itemsize, signed, i == wanted))
    starts: list[int] = []
    sizes: list[int] = []
    for _ in range(element.count):
        for count_bytes, item, signed, keep in plan:
            if count_bytes == 0:
                at += item
                continue
            size = int.from_bytes(data[at : at + count_bytes], endian, signed=signed)
            at += count_bytes
            if keep:
                starts.append(at)
                sizes.append(size)
            at += max(size, 0) * item
        if at > len(data):
            raise damaged(path, f"it ends among its {_plural(element.name)}; {CUT_SHORT}")
    if wanted is None:
        return none, none, at
    kind = np.dtype(order + element.properties[wanted].item)
    counts = np.array(sizes, dtype=np.int64)
    each = np.maximum(counts, 0)
    step = np.arange(int(each.sum()), dtype=np.int64) - np.repeat(np.cumsum(each) - each, each)
    first = np.repeat(np.array(starts, dtype=np.int64), each) + step * kind.itemsize
    raw = np.frombuffer(data, dtype=np.uint8)[first[:, None] + np.arange(kind.itemsize)]
    return counts, _indices(np.ascontiguousarray(raw).view(kind).ravel()), at


def _uniform_lists(
    data: bytes, at: int, element: _Element, order: str, wanted: int | None
) -> tuple[IndexArray, IndexArray, int] | None:
    """Read the rows at one stroke if all lists have the lengths of the first row's; None if they do not."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    expected: list[tuple[str, int]] = []
    offset = at
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
    end = at + element.count * row.itemsize
    if end > len(data):
        return None
    table = np.frombuffer(data, dtype=row, count=element.count, offset=at)
    if any((table[name] != size).any() for name, size in expected):
        return None
    if wanted is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), end
    return table[f"c{wanted}"].astype(np.int64), _indices(table[f"p{wanted}"].ravel()), end


def _indices(values: npt.NDArray[Any]) -> IndexArray:
    """Return whole numbers of any scalar type as int64; what is not whole becomes -1, which no mesh accepts."""
    if values.dtype.kind == "f":
        numbers = values.astype(np.float64)
        whole = np.isfinite(numbers) & (numbers == np.floor(numbers)) & (np.abs(numbers) < 2**53)
        return np.where(whole, numbers, -1.0).astype(np.int64)
    return values.astype(np.int64)


def write_ply(mesh: Mesh, comment: str = "") -> bytes:
    """Return `mesh` as binary little-endian PLY with double coordinates, so that reading it back is exact.

    Args:
        mesh: vertices in whatever unit they are in.
        comment: one line for the header, ASCII.
    """
    faces = mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(mesh.vertices)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    body = mesh.vertices.astype("<f8").tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        table = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", (3,))])
        table["n"], table["i"] = 3, faces
        body += table.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + body


def ply_comment(path: Path) -> str:
    """Return the first comment in the header of a PLY file, empty where there is none or it cannot be read."""
    try:
        with path.open("rb") as stream:
            lines = stream.read(_FIRST_LINES).split(b"\n")
    except OSError:
        return ""
    found = next((line for line in lines if line.startswith(b"comment ")), b"")
    return found.removeprefix(b"comment ").decode("ascii", "replace").strip()
