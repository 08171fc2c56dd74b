"""Point clouds: PCD of the Point Cloud Library (text, binary, or compressed by LZF), and text with rows of points.

Scanners and CloudCompare write `.xyz`; Leica writes `.pts`, which begins with the number of points.

After "The PCD (Point Cloud Data) file format", https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.parsing import (
    CUT_SHORT,
    check_count,
    damage_error,
    floats,
    ints,
    is_number,
    join_parts,
    line_blocks,
    mesh_of,
    numeric_text,
    plain_text,
)
from shapespace.io.read_limits import Allowance
from shapespace.types import FloatArray, Mesh

_MOST_HEADER = 1 << 16  # bytes (64 KiB)
_MOST_COUNT = 1 << 14  # values of one field in a point; limit on damaged files
_KINDS = {"I": "i", "U": "u", "F": "f"}
_SIZES = ("1", "2", "4", "8")
_COMMENTS = (b"#", b"//", b"%")  # in text with rows of points
_LITERAL = 32  # LZF: control bytes below it are followed by literals
_LONG = 7  # LZF: this length is continued in the next byte


def read_pcd(data: bytes, path: Path) -> Mesh:
    """Read the points of a PCD file, except NaN points, which are unobserved pixels of organised clouds.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is not PCD, has no x, y and z, or is cut short.
    """
    head, data_start = _header(plain_text(data), path)
    data = plain_text(data)
    row, n = _row(head, path)
    kind = head["DATA"][0].lower()
    if kind == "ascii":
        points = _text(numeric_text(data, path, data_start)[data_start:], head, n, path)
    elif kind == "binary":
        check_count(n, row.itemsize, len(data) - data_start, "points", path)
        table = np.frombuffer(data, row, n, data_start)
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    elif kind == "binary_compressed":
        points = _unpack_columns(data, data_start, row, n, path)
    else:
        raise damage_error(path, f"its data are '{kind[:40]}', but only ascii, binary and binary_compressed are read")
    is_measured = ~np.isnan(points).any(axis=1)
    if not is_measured.any():
        raise damage_error(path, "all its points are missing")
    return mesh_of(points[is_measured], None, path)


def _header(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the words of each header line by its first word, and the index of the first byte of the data."""
    fields: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in fields:
        end = data.find(b"\n", offset, _MOST_HEADER)
        if end < 0:
            raise damage_error(path, "it has no header that ends in DATA, so it is not a PCD file")
        words = data[offset:end].decode("ascii", "replace").split()
        offset = end + 1
        if words and not words[0].startswith("#"):
            fields[words[0].upper()] = words[1:]
    if not fields["DATA"]:
        raise damage_error(path, "its header does not state the format of the data")
    return fields, offset


def _row(head: dict[str, list[str]], path: Path) -> tuple[np.dtype[np.void], int]:
    """Return the record type of a point, with fields x, y and z, and the number of points."""
    names = head.get("FIELDS", head.get("COLUMNS", []))
    sizes, kinds = head.get("SIZE", []), head.get("TYPE", [])
    counts = head.get("COUNT", ["1"] * len(names))
    if not {"x", "y", "z"} <= set(names) or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise damage_error(path, "its header does not define x, y and z; save it again")
    if any(names.count(axis) != 1 or counts[names.index(axis)] != "1" for axis in "xyz"):
        raise damage_error(path, "its header has x, y or z more than once; save it again")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for number, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if size not in _SIZES or kind not in _KINDS or (kind, size) == ("F", "1") or not count.isdecimal():
            raise damage_error(path, f"its field '{name[:40]}' has an unknown type; save it again")
        if len(count) > 5 or int(count) > _MOST_COUNT:
            raise damage_error(path, f"its field '{name[:40]}' has {count[:20]} numbers per point, too many")
        fields.append((name if name in "xyz" else f"{name}/{number}", f"<{_KINDS[kind]}{size}", (int(count),)))
    plain = [(name, kind, shape if shape != (1,) else ()) for name, kind, shape in fields]
    try:
        n = int(head["POINTS"][0]) if "POINTS" in head else int(head["WIDTH"][0]) * int(head["HEIGHT"][0])
    except (KeyError, IndexError, ValueError) as error:
        raise damage_error(path, "its header does not state the number of points; save it again") from error
    return np.dtype(plain), n


def _text(text: bytes, head: dict[str, list[str]], n: int, path: Path) -> FloatArray:
    names = head.get("FIELDS", head.get("COLUMNS", []))
    counts = [int(count) for count in head.get("COUNT", ["1"] * len(names))]
    starts = np.cumsum([0, *counts])
    width = int(starts[-1])
    columns = [int(starts[names.index(axis)]) for axis in "xyz"]
    check_count(n, 6, len(text) + 1, "points", path)
    parts: list[FloatArray] = []
    row_count = 0
    for lines in line_blocks(text):
        rows = [words for words in (line.split() for line in lines) if words]
        if rows and min(map(len, rows)) < width:
            raise damage_error(path, f"a row has too few numbers; {CUT_SHORT}")
        parts.append(floats(chain.from_iterable([row[c] for c in columns] for row in rows), path).reshape(-1, 3))
        row_count += len(rows)
    if row_count != n:
        raise damage_error(path, f"its header declares {n} points, but {row_count} follow; {CUT_SHORT}")
    return join_parts(parts, np.float64, 3)


def _unpack_columns(data: bytes, offset: int, row: np.dtype[np.void], n: int, path: Path) -> FloatArray:
    """Return the points of compressed data, in which each field is stored for all points before the next field."""
    sizes = np.frombuffer(data[offset : offset + 8].ljust(8, b"\0"), "<u4")
    packed, size = int(sizes[0]), int(sizes[1])
    if n < 0 or size != n * row.itemsize or offset + 8 + packed > len(data):
        raise damage_error(path, f"its compressed data do not have the length that its header declares; {CUT_SHORT}")
    Allowance(len(data), path).take(size, 1)
    content = _lzf(data[offset + 8 : offset + 8 + packed], size, path)
    offsets = {name: n * int(field[1]) for name, field in (row.fields or {}).items()}
    runs = [np.frombuffer(content, row[axis], n, offsets[axis]).astype(np.float64) for axis in "xyz"]
    return np.stack(runs, axis=1)


def _lzf(data: bytes, size: int, path: Path) -> bytes:
    """Return the `size` bytes that LZF `data` unpack to: literal runs, and copies of earlier output."""
    out = bytearray()
    position = 0
    try:
        while position < len(data) and len(out) <= size:
            control = data[position]
            position += 1
            if control < _LITERAL:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == _LONG:
                length += data[position]
                position += 1
            copy_start = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            if copy_start < 0:
                raise IndexError
            length += 2
            run = bytes(out[copy_start : copy_start + length])
            # A copy may overlap its own output.
            out += (run * (length // len(run) + 1))[:length]
    except IndexError as error:
        raise damage_error(path, f"its compressed data are damaged; {CUT_SHORT}") from error
    if len(out) != size:
        raise damage_error(path, f"its compressed data do not have the length that its header declares; {CUT_SHORT}")
    return bytes(out)


def read_xyz(data: bytes, path: Path) -> Mesh:
    """Read rows whose first three numbers are a point; intensity, colour and normals are ignored.

    A row of one number is the number of points that follow. A first line of words contains column names, and `#`, `//`
    and `%` begin comments; commas, semicolons and white space separate numbers, which may have decimal commas.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it is binary or not a table of numbers, rows differ in their columns, or points are missing.
    """
    if b"\0" in data[:65536]:
        raise damage_error(path, "it is binary; files with this ending are read only as text with rows of x y z")
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
                raise damage_error(path, f"it is not a table of points with three or more columns, {width} in each row")
            if not all(map(is_number, points[0])) and not lines_before:
                raise damage_error(path, "it has words next to its points (a molecule perhaps), so it is not a scan")
            coordinates = chain.from_iterable(row[:3] for row in points)
            parts.append(floats(coordinates, path).reshape(-1, 3))
            lines_before += len(points)
        declared += sum(ints(counts, path).tolist())
    if not lines_before:
        raise damage_error(path, "it has no rows of x y z")
    if declared and declared != lines_before:
        raise damage_error(path, f"it declares {declared} points, but {lines_before} follow; {CUT_SHORT}")
    return mesh_of(join_parts(parts, np.float64, 3), None, path)
