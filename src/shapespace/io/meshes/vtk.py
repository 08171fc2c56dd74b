"""VTK poly data: the legacy `.vtk` text and binary files and the XML `.vtp` files.

After "VTK File Formats" of the VTK documentation: https://docs.vtk.org/en/latest/vtk_file_formats/index.html.
"""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ET
import zlib
from collections import defaultdict
from dataclasses import dataclass
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
    check_count,
    damage_error,
    fan_triangles,
    floats,
    floats_of,
    ints,
    ints_of,
    join_parts,
    joined_colours,
    mesh_of,
    numeric_text,
    plain_text,
    strip_triangles,
    xml_root,
)
from shapespace.io.read_limits import Allowance
from shapespace.types import ByteArray, FloatArray, Mesh

_LEGACY = {
    "unsigned_char": "u1", "char": "i1", "signed_char": "i1", "unsigned_short": "u2", "short": "i2",
    "unsigned_int": "u4", "int": "i4", "unsigned_long": "u8", "long": "i8",
    "vtktypeint64": "i8", "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4",
    "vtkidtype": "i4", "float": "f4", "double": "f8",
}  # fmt: skip
_XML = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8", "String": "u1",
}  # fmt: skip
# Fields may contain these types too, which no surface needs, so they are skipped.
_TEXTS = ("string", "utf8_string")
_LINES = ("variant",)
_BITS = ("bit",)
_OFFSETS = re.compile(rb"\s*OFFSETS\s")
_BLANK_LINE = re.compile(rb"\n[ \t\r]*\n")
# zlib compresses by a factor of at most 1032, so a header that declares more is wrong.
_MAX_INFLATION = 1040
_COLOUR_WIDTHS = (3, 4)  # RGB and RGBA
_MOST_ATTRIBUTES = 100  # arrays searched for colours; limit on damaged files

LINE_NOTE = (
    "Its lines are not part of a surface, and only their points are read; shapespace align reads them as curves."
)

Values = npt.NDArray[Any]
Cells: TypeAlias = tuple[IndexArray, IndexArray]
"""Number of corners of each cell, and the corners of all cells one after another."""


class _Cursor(WordCursor):
    """Read position in a legacy file, whose words are text and whose numbers are text or binary.

    Args:
        data: content of the file after its header.
        path: path of the file, used in messages.
        is_text: whether numbers are text; False for binary numbers.
    """

    def __init__(self, data: bytes, path: Path, is_text: bool) -> None:
        super().__init__(data, path)
        self.is_text = is_text

    def array(self, count: int, kind: str) -> Values:
        """Return the next `count` numbers of the numpy `kind`."""
        if self.is_text:
            check_count(count, 2, len(self.data) - self.position + 1, "numbers", self.path)
            read = floats if kind[0] == "f" else ints
            parts = [read(words, self.path) for words in self.words(count)]
            if sum(map(len, parts)) < count:
                raise damage_error(self.path, f"it ends among its numbers; {CUT_SHORT}")
            return join_parts(parts, np.float64 if kind[0] == "f" else np.int64)
        big = np.dtype(">" + kind)
        check_count(count, big.itemsize, len(self.data) - self.position, "numbers", self.path)
        values = np.frombuffer(self.data, dtype=big, count=count, offset=self.position)
        self.position += count * big.itemsize
        return values.astype(np.float64 if kind[0] == "f" else np.int64)

    def skip_texts(self, count: int) -> None:
        """Move past `count` pieces of text."""
        if self.is_text:
            self.skip_lines(count)
            return
        check_count(count, 1, len(self.data) - self.position, "pieces of text", self.path)
        for _ in range(count):
            # The two highest bits of the length encode its number of bytes.
            width = 8 >> (self.data[self.position] >> 6) if self.position < len(self.data) else 1
            prefix = self.data[self.position : self.position + width]
            length = int.from_bytes(prefix, "big") & ((1 << (8 * width - 2)) - 1)
            self.position += width + length
            if self.position > len(self.data):
                raise damage_error(self.path, f"it ends among its fields; {CUT_SHORT}")

    def skip_bits(self, count: int) -> None:
        """Move past `count` bits."""
        self.array(count if self.is_text else -(-count // 8), "u1")

    def skip_lines(self, count: int) -> None:
        """Move past `count` lines, which are text in binary files too."""
        check_count(count, 1, len(self.data) - self.position + 1, "lines", self.path)
        for _ in range(count):
            end = self.data.find(b"\n", self.position)
            if end < 0:
                raise damage_error(self.path, f"it ends among its fields; {CUT_SHORT}")
            self.position = end + 1

    def skip_metadata(self) -> None:
        """Move past a METADATA section, which ends at a blank line."""
        blank = _BLANK_LINE.search(self.data, max(self.position - 1, 0))
        if blank is None:
            raise damage_error(self.path, f"it ends among its METADATA; {CUT_SHORT}")
        self.position = blank.end()

    def skip_if_offsets(self) -> bool:
        """Move past the word OFFSETS if it comes next, and return whether it did."""
        # As a number, 'OFFS' would be the size of a polygon with a billion corners.
        match = _OFFSETS.match(self.data, self.position)
        self.position = match.end() if match else self.position
        return match is not None

    def count(self) -> int:
        """Return the next word as an integer."""
        return int(ints([self.word()], self.path)[0])

    def kind(self) -> str:
        """Return the numpy kind of the next word, the name of a type."""
        return _kind(self.lower_word(), self.path)

    def lower_word(self) -> str:
        """Return the next word in lower case."""
        return self.word().decode("ascii", "replace").lower()


def read_vtk(data: bytes, path: Path) -> Mesh:
    """Read VTK poly data, legacy or XML, as the content indicates, since both endings are used for both formats.

    Polygons become fans and triangle strips triangles; vertex and line cells are skipped, line cells with a note.
    Legacy files are ascii or binary, with the cells of VTK before or after 5.1; arrays of XML are ascii, inline base64
    or appended, plain or packed by zlib, and pieces are joined.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is not VTK poly data, is cut short, or is compressed otherwise than by zlib.
        MeshError: faces that point past the end of the vertices.
    """
    return _read(data, path)[0]


def read_vtk_lines(data: bytes, path: Path) -> tuple[Mesh, list[tuple[list[int], bool]]]:
    """Read VTK poly data and its polylines: the indices of vertices along each, and whether it is closed.

    Lines that meet at a point without a third line form one polyline. Errors are those of `read_vtk`.
    """
    mesh, given = _read(data, path)
    corners = join_parts([corners for _, corners in given], np.int64)
    if len(corners) and not 0 <= int(corners.min()) <= int(corners.max()) < len(mesh.vertices):
        raise damage_error(path, f"it has lines that point past its points; {CUT_SHORT}")
    sizes = join_parts([counts for counts, _ in given], np.int64)
    Allowance(len(data), path).part(len(sizes))
    lines = np.split(corners, np.cumsum(sizes)[:-1])
    # Pieces and cells may each have their own copy of a point.
    _, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    cells = [first[place.reshape(-1)[line]].tolist() for line in lines if len(line) > 1]
    at_end = defaultdict[int, list[int]](list)
    for k, cell in enumerate(cells):
        at_end[cell[0]].append(k)
        at_end[cell[-1]].append(k)
    left, out = set(range(len(cells))), list[tuple[list[int], bool]]()
    for k, cell in enumerate(cells):
        if k not in left:
            continue
        left.remove(k)
        path_of_points = list[int](cell)
        for _ in range(2):
            while path_of_points[0] != (end := path_of_points[-1]) and len(at_end[end]) == 2 and left & {*at_end[end]}:
                [following] = left & {*at_end[end]}
                left.remove(following)
                own = cells[following]
                path_of_points += own[1:] if own[0] == end else own[-2::-1]
            path_of_points.reverse()
        is_closed = path_of_points[0] == path_of_points[-1]
        out.append((path_of_points[:-1] if is_closed else path_of_points, is_closed))
    return mesh, out


def _read(data: bytes, path: Path) -> tuple[Mesh, list[Cells]]:
    """Return the mesh and its lines."""
    data = plain_text(data)
    return _read_xml(data, path) if data.lstrip()[:1] == b"<" else _read_legacy(data, path)


def _read_legacy(data: bytes, path: Path) -> tuple[Mesh, list[Cells]]:
    head = data[:1024].split(b"\n", 3)
    header = head[1:2]
    if len(head) < 4 or not head[0].startswith(b"# vtk DataFile"):
        raise damage_error(path, "it does not start with '# vtk DataFile', so it is not a VTK file")
    encoding = head[2].strip().upper()
    body = data[sum(len(line) + 1 for line in head[:3]) :]
    allowance = Allowance(len(data), path)
    if encoding not in (b"ASCII", b"BINARY"):
        raise damage_error(path, "its third line is neither ASCII nor BINARY")
    is_text, start = encoding == b"ASCII", len(data) - len(body)
    cursor = _Cursor(numeric_text(data, path, start)[start:] if is_text else body, path, is_text)
    dataset = cursor.word() + b" " + cursor.word()
    if dataset != b"DATASET POLYDATA":
        kind = dataset.decode("ascii", "replace")[:40]
        raise damage_error(path, f"it has '{kind}', not DATASET POLYDATA; extract its surface first")
    vertices: FloatArray | None = None
    faces: list[IndexArray] = []
    lines: list[Cells] = []
    while (word := cursor.word()) not in (b"", b"POINT_DATA", b"CELL_DATA"):
        allowance.part()
        if word == b"POINTS":
            count = cursor.count()
            vertices = cursor.array(3 * count, cursor.kind()).astype(np.float64).reshape(-1, 3)
        elif word in (b"POLYGONS", b"TRIANGLE_STRIPS", b"LINES", b"VERTICES"):
            counts, corners = _legacy_cells(cursor, path)
            if word == b"POLYGONS":
                faces.append(fan_triangles(counts, corners))
            elif word == b"TRIANGLE_STRIPS":
                faces.append(strip_triangles(counts, corners))
            elif word == b"LINES" and len(counts):
                lines.append((counts, corners))
        elif word == b"FIELD":
            begin = cursor.position
            cursor.word()
            count = cursor.count()
            allowance.part(max(count, 0))
            for _ in range(count):
                _skip_field(cursor)
            header.append(body[begin : cursor.position])
        elif word == b"METADATA":
            cursor.skip_metadata()
        else:
            name = word.decode("ascii", "replace")[:40]
            raise damage_error(path, f"it has an unknown section '{name}'; {CUT_SHORT}")
    if vertices is None:
        raise damage_error(path, f"it has no POINTS; {CUT_SHORT}")
    colours = _legacy_colours(cursor, len(vertices)) if word == b"POINT_DATA" else None
    notes = (LINE_NOTE,) if lines else ()
    return mesh_of(vertices, join_parts(faces, np.int64, 3), path, colours, notes, header=b"\n".join(header)), lines


def _legacy_colours(cursor: _Cursor, vertices: int) -> ByteArray | None:
    """Return the first colours among the point data; errors in these sections are ignored."""
    try:
        if cursor.count() != vertices:
            return None
        for _ in range(_MOST_ATTRIBUTES):
            word = cursor.word()
            if word == b"SCALARS":
                cursor.word()
                kind, width = cursor.lower_word(), _width(cursor.word())
                if cursor.word() != b"LOOKUP_TABLE":
                    return None
                cursor.word()
                values = cursor.array(vertices * width, _kind(kind, cursor.path))
                if kind == "unsigned_char" and width in _COLOUR_WIDTHS:
                    return _three_bytes(values, width)
            elif word == b"COLOR_SCALARS":
                cursor.word()
                width = _width(cursor.word())
                values = cursor.array(vertices * width, "f4" if cursor.is_text else "u1")
                if width in _COLOUR_WIDTHS:
                    return _three_bytes(np.rint(255.0 * values) if cursor.is_text else values, width)
            elif word in (b"NORMALS", b"VECTORS"):
                cursor.word()
                cursor.array(3 * vertices, cursor.kind())
            elif word == b"FIELD":
                cursor.word()
                for _ in range(min(cursor.count(), _MOST_ATTRIBUTES)):
                    while cursor.word() == b"METADATA":
                        cursor.skip_metadata()
                    width, rows = cursor.count(), cursor.count()
                    kind = cursor.lower_word()
                    values = cursor.array(width * rows, _kind(kind, cursor.path))
                    if kind == "unsigned_char" and width in _COLOUR_WIDTHS and rows == vertices:
                        return _three_bytes(values, width)
            elif word == b"METADATA":
                cursor.skip_metadata()
            else:
                return None
    except FileFormatError:
        return None
    return None


def _width(word: bytes) -> int:
    return int(word) if word in (b"1", b"2", b"3", b"4") else 1


def _three_bytes(values: Values, width: int) -> ByteArray | None:
    rows = values.reshape(-1, width)[:, :3]
    return rows.astype(np.uint8) if ((rows >= 0) & (rows <= 255)).all() else None


def _skip_field(cursor: _Cursor) -> None:
    while cursor.word() == b"METADATA":
        cursor.skip_metadata()
    count = cursor.count() * cursor.count()
    name = cursor.lower_word()
    if name in _TEXTS:
        cursor.skip_texts(count)
    elif name in _LINES:
        cursor.skip_lines(count)
    elif name in _BITS:
        cursor.skip_bits(count)
    else:
        cursor.array(count, _kind(name, cursor.path))


def _kind(name: str, path: Path) -> str:
    if name not in _LEGACY:
        raise damage_error(path, f"it has numbers of an unknown type '{name[:40]}'; {CUT_SHORT}")
    return _LEGACY[name]


def _legacy_cells(cursor: _Cursor, path: Path) -> Cells:
    first, second = cursor.count(), cursor.count()
    if cursor.skip_if_offsets():
        offsets = cursor.array(first, cursor.kind()).astype(np.int64)
        if cursor.word() != b"CONNECTIVITY":
            raise damage_error(path, f"its cells have OFFSETS without CONNECTIVITY; {CUT_SHORT}")
        corners = cursor.array(second, cursor.kind()).astype(np.int64)
        return _cells_from_offsets(offsets, corners, path)
    packed = cursor.array(second, "i4").astype(np.int64)
    if first > 0 and second and second % first == 0:
        table = packed.reshape(first, -1)
        if (table[:, 0] == table.shape[1] - 1).all():
            return table[:, 0], table[:, 1:].ravel()
    sizes: list[int] = []
    position, values = 0, packed.tolist()
    while position < second and len(sizes) < first and values[position] >= 0:
        sizes.append(values[position])
        position += values[position] + 1
    if position != second or len(sizes) != first:
        raise damage_error(path, f"its cells do not add up to the size that they declare; {CUT_SHORT}")
    counts = np.array(sizes, dtype=np.int64)
    keep = np.ones(second, dtype=np.bool_)
    keep[np.cumsum(counts + 1) - counts - 1] = False
    return counts, packed[keep]


def _cells_from_offsets(offsets: IndexArray, corners: IndexArray, path: Path) -> Cells:
    """Return sizes of cells and their corners, from offsets that run from 0 to the number of corners."""
    if not len(offsets):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    counts = np.diff(offsets)
    if offsets[0] != 0 or offsets[-1] != len(corners) or (counts < 0).any():
        raise damage_error(path, f"the offsets of its cells do not match their corners; {CUT_SHORT}")
    return counts, corners


def write_vtk(mesh: Mesh) -> bytes:
    """Return `mesh` as binary legacy VTK poly data (version 3.0, which all readers support), with doubles."""
    n = len(mesh.vertices)
    head = f"# vtk DataFile Version 3.0\nshapespace {SPACE}\nBINARY\nDATASET POLYDATA\nPOINTS {n} double\n"
    cells = np.arange(n, dtype=np.int32).reshape(-1, 1) if mesh.faces is None else mesh.faces
    packed = np.empty((len(cells), cells.shape[1] + 1), dtype=">i4")
    packed[:, 0], packed[:, 1:] = cells.shape[1], cells
    section = f"\n{'VERTICES' if mesh.faces is None else 'POLYGONS'} {len(cells)} {packed.size}\n"
    points = mesh.vertices.astype(">f8").tobytes()
    surface = head.encode("ascii") + points + section.encode("ascii") + packed.tobytes() + b"\n"
    if mesh.colours is None:
        return surface
    colour_header = f"POINT_DATA {n}\nSCALARS RGB unsigned_char 3\nLOOKUP_TABLE default\n"
    return surface + colour_header.encode("ascii") + mesh.colours.tobytes() + b"\n"


@dataclass(frozen=True)
class _Xml:
    """Common properties of the arrays of one XML file."""

    path: Path
    order: str
    header: str
    compressed: bool
    appended: bytes
    appended_base64: bool
    allowance: Allowance


def _read_xml(data: bytes, path: Path) -> tuple[Mesh, list[Cells]]:
    head, mark, tail = data.partition(b"<AppendedData")
    appended = b""
    if mark:
        # Raw data are not XML, so only the part before them is parsed.
        tag, _, body = tail.partition(b">")
        head += mark + tag + b"/></VTKFile>"
        appended = body.partition(b"_")[2]
    root = xml_root(numeric_text(head, path), path)
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise damage_error(path, "it is not a VTK file of type PolyData; extract its surface first")
    compressor = root.get("compressor", "")
    if compressor not in ("", "vtkZLibDataCompressor"):
        raise damage_error(path, f"it is compressed by {compressor[:40]}, so save it with zlib or uncompressed")
    block = root.find("AppendedData")
    base = block is not None and block.get("encoding", "base64") == "base64"
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = order + ("u8" if root.get("header_type") == "UInt64" else "u4")
    xml = _Xml(
        path=path,
        order=order,
        header=header,
        compressed=compressor != "",
        appended=appended,
        appended_base64=base,
        allowance=Allowance(len(data), path),
    )
    points: list[FloatArray] = []
    colours: list[ByteArray | None] = []
    faces: list[IndexArray] = []
    lines: list[Cells] = []
    n_vertices = 0
    for piece in root.iterfind("PolyData/Piece"):
        xml.allowance.part()
        vertices = _piece_points(piece, xml)
        for section, cut in (("Polys", fan_triangles), ("Strips", strip_triangles), ("Lines", None)):
            arrays = {a.get("Name"): a for a in piece.iterfind(f"{section}/DataArray")}
            if not {"connectivity", "offsets"} <= arrays.keys():
                continue
            cell_ends = _data_array(arrays["offsets"], xml).astype(np.int64)
            corners = _data_array(arrays["connectivity"], xml).astype(np.int64)
            if not len(cell_ends):
                continue
            xml.allowance.take(3 * len(corners), 8)
            counts, corners = _cells_from_offsets(np.concatenate([[0], cell_ends]), corners, path)
            if cut is None:
                lines.append((counts, corners + n_vertices))
                continue
            # Each piece is checked before joining, which would make an index past it refer to the next piece.
            triangles = cut(counts, corners)
            mesh_of(vertices, triangles, path)
            faces.append(triangles + n_vertices)
        points.append(vertices)
        colours.append(_piece_colours(piece, len(vertices), xml))
        n_vertices += len(vertices)
    if not points:
        raise damage_error(path, f"it contains no points; {CUT_SHORT}")
    fields = root.iterfind("PolyData/FieldData/*")
    spaces = [_data_array(a, xml).astype(np.uint8) for a in fields if a.get("Name", "").upper() == "SPACE"]
    return mesh_of(
        np.concatenate(points), join_parts(faces, np.int64, 3), path, joined_colours(colours),
        (LINE_NOTE,) if lines else (),
        header=b"".join(b" SPACE=" + codes.tobytes() for codes in spaces),
    ), lines  # fmt: skip


def _piece_points(piece: ET.Element, xml: _Xml) -> FloatArray:
    declared = int(ints([piece.get("NumberOfPoints", "").encode()], xml.path)[0])
    array = piece.find("Points/DataArray")
    if declared == 0:
        return np.zeros((0, 3))
    if array is None:
        raise damage_error(xml.path, f"it has a piece without points; {CUT_SHORT}")
    values = _data_array(array, xml).astype(np.float64)
    if len(values) != 3 * declared:
        raise damage_error(
            xml.path, f"it declares {declared} points, but contains {len(values)} coordinates; {CUT_SHORT}"
        )
    return values.reshape(-1, 3)


def _piece_colours(piece: ET.Element, vertices: int, xml: _Xml) -> ByteArray | None:
    """Return the first array of bytes with three or four components among the point data."""
    for array in piece.iterfind("PointData/DataArray"):
        width = _width(array.get("NumberOfComponents", "1").encode("ascii", "replace"))
        if array.get("type") == "UInt8" and width in _COLOUR_WIDTHS:
            try:
                values = _data_array(array, xml)
            except FileFormatError:
                return None
            return _three_bytes(values, width) if len(values) == width * vertices else None
    return None


def _data_array(array: ET.Element, xml: _Xml) -> Values:
    """Return one DataArray as a flat array of its own type."""
    path = xml.path
    name = array.get("type", "")
    if name not in _XML:
        raise damage_error(path, f"it has numbers of an unknown type '{name[:40]}'")
    kind = np.dtype(xml.order + _XML[name])
    form = array.get("format", "ascii")
    text = (array.text or "").encode("ascii", "replace")
    if form == "ascii":
        return floats_of(text, path) if kind.kind == "f" else ints_of(text, path)
    if form == "binary":
        raw = _decode(b"".join(text.split()), 0, True, xml)
    elif form == "appended":
        offset = int(ints([array.get("offset", "").encode()], path)[0])
        if not 0 <= offset < len(xml.appended):
            raise damage_error(path, f"it has data that start past its end; {CUT_SHORT}")
        raw = _decode(xml.appended, offset, xml.appended_base64, xml)
    else:
        raise damage_error(path, f"it has data of an unknown form '{form[:40]}'")
    if len(raw) % kind.itemsize:
        raise damage_error(path, f"it has data that end inside a number; {CUT_SHORT}")
    # Every array is converted to eight bytes per number.
    xml.allowance.take(len(raw) // kind.itemsize, 8)
    return np.frombuffer(raw, dtype=kind)


def _decode(data: bytes, offset: int, is_base64: bool, xml: _Xml) -> bytes:
    """Return the bytes of one array that starts at byte `offset` of `data`."""
    width = np.dtype(xml.header).itemsize
    if not xml.compressed:
        (length,) = _words(data, offset, 1, is_base64, xml)
        chars = 4 * -(-width // 3)
        # Some writers encode the length separately, with padding at its end, and others together with the data.
        if is_base64 and data[offset : offset + chars].endswith(b"="):
            return _stream(data, offset + chars, 0, length, True, xml)
        return _stream(data, offset, width, length, is_base64, xml)
    (blocks,) = _words(data, offset, 1, is_base64, xml)
    check_count(blocks, width, len(data) - offset, "compressed blocks", xml.path)
    xml.allowance.part(blocks)
    _, size, last, *packed = _words(data, offset, 3 + blocks, is_base64, xml)
    header = (3 + blocks) * width
    stream = _stream(data, offset + (4 * -(-header // 3) if is_base64 else header), 0, sum(packed), is_base64, xml)
    out: list[bytes] = []
    begin = 0
    for i, length in enumerate(packed):
        want = last if i == len(packed) - 1 and last else size
        if want > _MAX_INFLATION * (length + 16):
            raise damage_error(xml.path, f"it has a compressed block that declares {want} bytes; {CUT_SHORT}")
        xml.allowance.take(want, 1)
        try:
            piece = zlib.decompressobj().decompress(stream[begin : begin + length], max_length=want or 1)
        except zlib.error as error:
            raise damage_error(xml.path, f"it has a block that cannot be unpacked; {CUT_SHORT}") from error
        if len(piece) != want:
            raise damage_error(xml.path, f"it has a compressed block of the wrong length; {CUT_SHORT}")
        out.append(piece)
        begin += length
    return b"".join(out)


def _words(data: bytes, offset: int, count: int, is_base64: bool, xml: _Xml) -> list[int]:
    """Return the `count` integers at the start of an array."""
    kind = np.dtype(xml.header)
    return np.frombuffer(_stream(data, offset, 0, count * kind.itemsize, is_base64, xml), dtype=kind).tolist()


def _stream(data: bytes, offset: int, start: int, length: int, is_base64: bool, xml: _Xml) -> bytes:
    """Return `length` bytes, from byte `start` on, of the content that `data` encodes from byte `offset` on."""
    end = start + length
    check_count(end, 1, len(data) - offset, "bytes of data", xml.path)
    if not is_base64:
        return data[offset + start : offset + end]
    # Arrays may share bytes of the file, so each array is counted.
    xml.allowance.take(end, 1)
    try:
        raw = base64.b64decode(data[offset : offset + 4 * -(-end // 3)], validate=True)
    except ValueError as error:
        raise damage_error(xml.path, f"it has data that are not base64; {CUT_SHORT}") from error
    if len(raw) < end:
        raise damage_error(xml.path, f"it ends inside its data; {CUT_SHORT}")
    return raw[start:end]


def write_vtp(mesh: Mesh) -> bytes:
    """Return `mesh` as XML VTK poly data with inline base64, Float64 points, uncompressed."""
    n = len(mesh.vertices)
    cells = np.arange(n, dtype=np.int32).reshape(-1, 1) if mesh.faces is None else mesh.faces
    face_ends = np.arange(1, len(cells) + 1, dtype="<i8") * cells.shape[1]
    section, verts, polys = ("Verts", n, 0) if mesh.faces is None else ("Polys", 0, len(cells))

    def array(name: str, kind: str, values: Values, components: str = "") -> str:
        raw = values.tobytes()
        packed = base64.b64encode(len(raw).to_bytes(8, "little") + raw).decode("ascii")
        return f'<DataArray type="{kind}" Name="{name}"{components} format="binary">{packed}</DataArray>'

    colours: list[str] = []
    if mesh.colours is not None:
        colour_array = array("RGB", "UInt8", mesh.colours, ' NumberOfComponents="3"')
        colours = ['<PointData Scalars="RGB">', colour_array, "</PointData>"]
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>",
        '<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">'
        f"{' '.join(map(str, SPACE.encode('ascii')[-3:]))} 0</Array></FieldData>",
        f'<Piece NumberOfPoints="{n}" NumberOfVerts="{verts}" NumberOfLines="0" NumberOfStrips="0"'
        f' NumberOfPolys="{polys}">',
        "<Points>",
        array("Points", "Float64", mesh.vertices.astype("<f8"), ' NumberOfComponents="3"'),
        "</Points>",
        *colours,
        f"<{section}>",
        array("connectivity", "Int64", cells.astype("<i8").ravel()),
        array("offsets", "Int64", face_ends),
        f"</{section}>",
        "</Piece>",
        "</PolyData>",
        "</VTKFile>",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")
