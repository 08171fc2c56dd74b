"""RAW (`.raw`): rows of numbers without a header, three for a point or nine for a triangle.

The ending names no single format. Nine numbers a row are the triangles of POV-Ray's tools (S. Anger and P. Bourke,
"POV-Ray RAW triangle format", 1996); three a row are points. Everything else under this ending is refused by name.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.limits import Allowance
from shapespace.io.parsing import CUT_SHORT, damaged, floats, joined, line_blocks, mesh_of, plain_text
from shapespace.io.stl import merge_equal
from shapespace.types import FloatArray, Mesh


def read_raw(data: bytes, path: Path) -> Mesh:
    """Read RAW text: three numbers a row are points in the file's order, nine are triangles.

    Corners of triangles that are exactly equal become one vertex, numbered in the order of first appearance. `#` starts
    a comment, commas are spaces, and rows of one word (names of objects) are skipped.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is binary, or its rows have another number of columns, or not all the same.
    """
    if b"\0" in data[:65536]:
        raise damaged(
            path, "it is binary, a picture or a volume perhaps; of .raw only text with 3 or 9 numbers a row is read"
        )
    allowance = Allowance(len(data), path)
    parts: list[FloatArray] = []
    before = width = first = 0
    for lines in line_blocks(plain_text(data)):
        split = [line.partition(b"#")[0].replace(b",", b" ").split() for line in lines]
        # To tell the name of an object from a number takes long, and a file has few.
        allowance.part(sum(len(words) == 1 for words in split))
        rows = [(number, words) for number, words in enumerate(split, before + 1) if words and not _is_name(words)]
        before += len(lines)
        if rows and not first:
            first, width = rows[0][0], len(rows[0][1])
        other = next((row for row in rows if len(row[1]) != width), None)
        if other is not None:
            raise damaged(
                path, f"line {first} has {width} columns, but line {other[0]} has {len(other[1])}; {CUT_SHORT}"
            )
        if width not in (0, 3, 9):
            raise damaged(
                path,
                f"its rows have {width} columns, but of .raw only 3 (points) and 9 (triangles) are read; convert it to "
                "PLY",
            )
        parts.append(floats(chain.from_iterable(words for _, words in rows), path).reshape(-1, 3))
    if not first:
        raise damaged(path, "it has no rows of 3 or 9 numbers")
    values = joined(parts, np.float64, 3)
    if width == 3:
        return mesh_of(values, None, path)
    vertices, index = merge_equal(values)
    return mesh_of(vertices, index.reshape(-1, 3), path)


def _is_name(words: list[bytes]) -> bool:
    if len(words) != 1:
        return False
    try:
        float(words[0])
    except ValueError:
        return True
    return False
