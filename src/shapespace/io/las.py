"""LAS of laser scanners, versions 1.0 to 1.4, not packed: after the ASPRS LAS Specification, 1.4 R15."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from shapespace.io.parsing import CUT_SHORT, check_count, damaged, mesh_of
from shapespace.types import Mesh

_LEAST_HEADER, _HEADER_1_4 = 227, 375
_PACKED = 0xC0
_XYZ_BYTES = 12


def read_las(data: bytes, path: Path) -> Mesh:
    """Read the points of a LAS file, in its unit; intensity, colour, classes and coordinate systems are passed over.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it is no LAS file, is packed as LAZ, is cut short, or holds no points.
    """
    if data[:4] != b"LASF" or len(data) < _LEAST_HEADER:
        raise damaged(path, "it does not begin as a LAS file does")
    start, kind, row, count = struct.unpack_from("<I4xBHI", data, 96)
    scale, shift = (np.array(struct.unpack_from("<3d", data, at)) for at in (131, 155))
    if kind & _PACKED:
        raise damaged(path, "it is packed (LAZ), so unpack it with laszip or save it as LAS")
    if data[25] >= 4 and len(data) >= _HEADER_1_4:
        count = struct.unpack_from("<Q", data, 247)[0] or count
    if row < _XYZ_BYTES or start < _LEAST_HEADER:
        raise damaged(path, f"its header contradicts itself; {CUT_SHORT}")
    check_count(count, row, len(data) - start, "points", path)
    if not count:
        raise damaged(path, "it holds no points")
    whole = np.ndarray((count, 3), "<i4", data, start, (row, 4))
    return mesh_of(whole * scale + shift, None, path)
