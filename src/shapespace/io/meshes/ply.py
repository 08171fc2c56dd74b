"""PLY, ascii and binary, as described by G. Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
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
    word_block,
)
from shapespace.types import BoolArray, ByteArray, FloatArray, Mesh

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20  # bytes (1 MiB)
_FIRST_LINES = 512  # bytes that hold the comment
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_OBSERVED, _POSITION_STD = "observed", "position_std"
"""Vertex properties of surfaces in correspondence: 0 where the position is an estimate; `Mesh.position_std`."""
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


class _Words:
    """Iterator over the words of ascii data from an offset; few words are in memory at a time."""

    def __init__(self, data: bytes, offset: int) -> None:
        self.data = data
        self.begin = self.end = offset
        self.block: list[bytes] = []
        self.position = 0

    @property
    def left(self) -> int:
        """Bytes from the block of the next word on, and one for the space that the last does without."""
        return len(self.data) - self.begin + 1

    def mark(self) -> tuple[int, int, list[bytes], int]:
        """Return where the next word is, for `back_to`."""
        return self.begin, self.end, self.block, self.position

    def back_to(self, mark: tuple[int, int, list[bytes], int]) -> None:
        """Go back to where `mark` was taken."""
        self.begin, self.end, self.block, self.position = mark

    def __iter__(self) -> Iterator[bytes]:
        return self

    def __next__(self) -> bytes:
        while self.position == len(self.block):
            if self.end >= len(self.data):
                raise StopIteration
            self.begin, self.position = self.end, 0
            self.block, self.end = word_block(self.data, self.begin)
        self.position += 1
        return self.block[self.position - 1]

    def take(self, count: int) -> Iterator[list[bytes]]:
        """Yield the next `count` words in lists; fewer where the text ends."""
        while count > 0 and (word := next(self, None)) is not None:
            part = [word, *self.block[self.position : self.position + count - 1]]
            self.position += len(part) - 1
            count -= len(part)
            yield part

    def some(self, count: int) -> list[bytes]:
        """Return the next `count` words; fewer where the text ends."""
        part = self.block[self.position : self.position + count]
        self.position += len(part)
        # The rest of a long list lies in the blocks that follow.
        return part if len(part) == count else [*part, *chain.from_iterable(self.take(count - len(part)))]

    def skip(self, count: int) -> None:
        """Pass `count` words."""
        for _ in self.take(count):
            pass


def read_ply(data: bytes, path: Path) -> Mesh:
    """Read PLY: all scalar types, both byte orders, colours, extra properties and elements, polygons as fans.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is not PLY, is cut short, or holds triangle strips.
        MeshError: faces that point past the end of the vertices.
    """
    data = plain_text(data)
    order, elements, offset = _header(data, path)
    header = data[:offset]
    if order == "":
        data = numeric_text(data, path, offset)
    vertices: FloatArray | None = None
    colours: ByteArray | None = None
    observed: BoolArray | None = None
    std: FloatArray | None = None
    faces: IndexArray | None = None
    words = _Words(data, offset)
    for element in elements:
        if element.name == "tristrips":
            raise damage_error(path, "it holds triangle strips, so export it again with plain triangles")
        available = words.left if order == "" else len(data) - offset
        check_count(element.count, element.least_bytes(order == ""), available, _plural(element.name), path)
        lists = any(p.count is not None for p in element.properties)
        list_index = None
        if element.name == "face" and element.count:
            list_index = element.index_list()
            if list_index is None:
                raise damage_error(path, "its faces have no property vertex_indices, so export it again")
        if lists and order == "":
            counts, corners = _ascii_lists(words, element, list_index, path)
        elif lists:
            counts, corners, offset = _binary_lists(data, offset, element, order, list_index, path)
        else:
            positions = element.name == "vertex"
            if positions:
                _refuse_without_xyz(element, path)
            if order == "":
                if positions:
                    vertices, colours, observed, std = _ascii_vertices(words, element, path)
                else:
                    words.skip(element.count * len(element.properties))
            else:
                if positions:
                    vertices, colours, observed, std = _binary_vertices(data, offset, element, order)
                offset += element.count * element.least_bytes(False)
            continue
        if element.name == "vertex":
            raise damage_error(path, "its vertices carry lists, so export it again without them")
        if list_index is not None:
            if len(counts) and counts.min() < 0:
                raise damage_error(path, f"a face has {int(counts.min())} corners; {CUT_SHORT}")
            faces = fan_triangles(counts, corners)
    if vertices is None:
        raise damage_error(path, "its header declares no vertices")
    return mesh_of(vertices, faces, path, colours, observed=observed, position_std=std, header=header)


def probe_ply(head: bytes, size: int, path: Path) -> None:
    """Check that a PLY file is as long as its header declares, where faces have three corners or more.

    Args:
        head: the first bytes of the file.
        size: of the file in bytes.
        path: its name, for messages.

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
        raise damage_error(path, "its header does not say whether it is ascii or binary")
    return order, elements, start


def _refuse_without_xyz(element: _Element, path: Path) -> None:
    if not set("xyz") <= {p.name for p in element.properties}:
        raise damage_error(path, "its vertices have no x, y and z")


def _colour_names(names: list[str]) -> tuple[str, ...]:
    return next((three for three in _COLOURS if set(three) <= set(names)), ())


def _colours(element: _Element, columns: dict[str, npt.NDArray[Any]]) -> ByteArray | None:
    """Return colours (V, 3) from their columns, as the types of their properties say."""
    three = _colour_names([p.name for p in element.properties])
    if not three:
        return None
    kinds = {p.item for p in element.properties if p.name in three}
    values = np.stack([columns[name] for name in three], axis=1)
    # The type tells what white is, of dark scans too.
    if kinds == {"u1"}:
        return values.astype(np.uint8) if ((values >= 0) & (values <= 255)).all() else None
    return bytes_of_colours(values)


_Vertices: TypeAlias = tuple[FloatArray, ByteArray | None, BoolArray | None, FloatArray | None]
"""Positions (V, 3), colours (V, 3), mask (V,) of observed vertices, and `Mesh.position_std` (V,)."""


def _is_observed(element: _Element, column: npt.NDArray[Any] | None) -> BoolArray | None:
    """Return the mask (V,) of observed vertices; None unless the property holds whole numbers."""
    kinds = {p.item[0] for p in element.properties if p.name == _OBSERVED}
    return None if column is None or "f" in kinds else np.asarray(column != 0)


def _position_std(element: _Element, column: npt.NDArray[Any] | None) -> FloatArray | None:
    """Return standard deviations (V,) of positions; None unless the property has finite lengths."""
    kinds = {p.item[0] for p in element.properties if p.name == _POSITION_STD}
    is_length = column is not None and "f" in kinds and np.isfinite(column).all() and (column >= 0).all()
    return np.asarray(column, dtype=np.float64) if is_length else None


def _binary_vertices(data: bytes, offset: int, element: _Element, order: str) -> _Vertices:
    names = [p.name for p in element.properties]
    row = np.dtype([(f"p{i}", order + p.item) for i, p in enumerate(element.properties)])
    table = np.frombuffer(data, dtype=row, count=element.count, offset=offset)
    out = np.empty((element.count, 3), dtype=np.float64)
    for axis, name in enumerate("xyz"):
        out[:, axis] = table[f"p{names.index(name)}"]
    colours = _colours(element, {name: table[f"p{names.index(name)}"] for name in _colour_names(names)})
    mask, std = (table[f"p{names.index(n)}"] if n in names else None for n in (_OBSERVED, _POSITION_STD))
    return out, colours, _is_observed(element, mask), _position_std(element, std)


def _ascii_vertices(words: _Words, element: _Element, path: Path) -> _Vertices:
    names = [p.name for p in element.properties]
    width = len(names)
    flags = [name for name in (_OBSERVED, _POSITION_STD) if name in names]
    columns: dict[str, list[FloatArray]] = {name: [] for name in ("x", "y", "z", *_colour_names(names), *flags)}
    n_read = 0
    for part in words.take(element.count * width):
        for axis, parts in columns.items():
            # A part may begin and end anywhere in a row.
            parts.append(floats(part[(names.index(axis) - n_read) % width :: width], path))
        n_read += len(part)
    if n_read < element.count * width:
        raise _truncation_error(element, path)
    arrays = {name: join_parts(parts, np.float64) for name, parts in columns.items()}
    positions = np.stack([arrays[axis] for axis in "xyz"], axis=1)
    mask, std = _is_observed(element, arrays.get(_OBSERVED)), _position_std(element, arrays.get(_POSITION_STD))
    return positions, _colours(element, arrays), mask, std


def _truncation_error(element: _Element, path: Path) -> FileFormatError:
    return damage_error(path, f"it ends among its {_plural(element.name)}; {CUT_SHORT}")


def _ascii_lists(words: _Words, element: _Element, list_index: int | None, path: Path) -> tuple[IndexArray, IndexArray]:
    if len(element.properties) == 1 and element.count and list_index == 0:
        table = _read_equal_lists(words, element.count, path)
        if table is not None:
            return table[:, 0], table[:, 1:].ravel()
    sizes, corners = array("q"), array("q")
    try:
        for _ in range(element.count):
            for i, p in enumerate(element.properties):
                if p.count is None:
                    next(words)
                    continue
                size = int(next(words))
                if size < 0:
                    raise StopIteration
                part = words.some(size)
                if len(part) < size:
                    raise StopIteration
                if i == list_index:
                    sizes.append(size)
                    corners.extend(map(int, part))
    except (ValueError, OverflowError) as error:
        raise damage_error(path, f"a list has no whole number where one should be; {CUT_SHORT}") from error
    except StopIteration as error:
        raise _truncation_error(element, path) from error
    return np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64)


def _read_equal_lists(words: _Words, count: int, path: Path) -> IndexArray | None:
    """Return (count, n + 1) the sizes and corners of lists of equal length; None if their lengths differ."""
    start = words.mark()
    first = next(words, b"")
    size = int(ints([first], path)[0])
    words.back_to(start)
    if size <= 0 or count * (size + 1) * 2 > words.left:
        return None
    n_read = 0
    parts: list[IndexArray] = []
    for part in words.take(count * (size + 1)):
        lengths = part[-n_read % (size + 1) :: size + 1]
        if lengths.count(first) != len(lengths):
            break
        parts.append(ints(part, path))
        n_read += len(part)
    if n_read == count * (size + 1):
        return np.concatenate(parts).reshape(count, size + 1)
    words.back_to(start)
    return None


def _binary_lists(
    data: bytes, offset: int, element: _Element, order: str, list_index: int | None, path: Path
) -> tuple[IndexArray, IndexArray, int]:
    none = np.zeros(0, dtype=np.int64)
    if element.count == 0:
        return none, none, offset
    if any(p.count is not None and p.count[0] == "f" for p in element.properties):
        raise damage_error(path, "a list has a length that is not a whole number, so export it again")
    uniform = _uniform_lists(data, offset, element, order, list_index)
    if uniform is not None:
        return uniform
    endian = "little" if order == "<" else "big"
    plan: list[tuple[int, int, bool, bool]] = []
    for i, p in enumerate(element.properties):
        count_bytes = 0 if p.count is None else np.dtype(p.count).itemsize
        signed = p.count is not None and p.count[0] == "i"
        plan.append((count_bytes, np.dtype(p.item).itemsize, signed, i == list_index))
    starts, sizes = array("q"), array("q")
    for _ in range(element.count):
        for count_bytes, item, signed, keep in plan:
            if count_bytes == 0:
                offset += item
                continue
            size = int.from_bytes(data[offset : offset + count_bytes], endian, signed=signed)
            offset += count_bytes
            if keep:
                starts.append(offset)
                sizes.append(size)
            offset += max(size, 0) * item
        if offset > len(data):
            raise damage_error(path, f"it ends among its {_plural(element.name)}; {CUT_SHORT}")
    if list_index is None:
        return none, none, offset
    kind = np.dtype(order + element.properties[list_index].item)
    counts = np.array(sizes, dtype=np.int64)
    lengths = np.maximum(counts, 0)
    step = np.arange(int(lengths.sum()), dtype=np.int64) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    first_byte = np.repeat(np.array(starts, dtype=np.int64), lengths) + step * kind.itemsize
    raw = np.frombuffer(data, dtype=np.uint8)[first_byte[:, None] + np.arange(kind.itemsize)]
    return counts, _indices(np.ascontiguousarray(raw).view(kind).ravel()), offset


def _uniform_lists(
    data: bytes, start: int, element: _Element, order: str, list_index: int | None
) -> tuple[IndexArray, IndexArray, int] | None:
    """Read all rows at once if all lists have the lengths of the first row; None otherwise."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    expected: list[tuple[str, int]] = []
    offset = start
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
    end = start + element.count * row.itemsize
    if end > len(data):
        return None
    table = np.frombuffer(data, dtype=row, count=element.count, offset=start)
    if any((table[name] != size).any() for name, size in expected):
        return None
    if list_index is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), end
    return table[f"c{list_index}"].astype(np.int64), _indices(table[f"p{list_index}"].ravel()), end


def _indices(values: npt.NDArray[Any]) -> IndexArray:
    """Return whole numbers of any scalar type as int64; other numbers become -1, which no mesh accepts."""
    if values.dtype.kind == "f":
        numbers = values.astype(np.float64)
        is_whole = np.isfinite(numbers) & (numbers == np.floor(numbers)) & (np.abs(numbers) < 2**53)
        return np.where(is_whole, numbers, -1.0).astype(np.int64)
    return values.astype(np.int64)


def write_ply(mesh: Mesh, comment: str = "") -> bytes:
    """Return `mesh` as binary little-endian PLY with double coordinates; reading it back is exact.

    Colours and the mask of observed vertices are vertex properties of type uchar, `position_std` is a float.

    Args:
        mesh: vertices in whatever unit they are in.
        comment: one line for the header, ASCII; the mark of the frame follows it.
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
    """Return the first comment in the header of a PLY file, empty where there is none or it cannot be read."""
    try:
        with path.open("rb") as stream:
            lines = stream.read(_FIRST_LINES).split(b"\n")
    except OSError:
        return ""
    comment_line = next((line for line in lines if line.startswith(b"comment ")), b"")
    return comment_line.removeprefix(b"comment ").decode("ascii", "replace").strip()
