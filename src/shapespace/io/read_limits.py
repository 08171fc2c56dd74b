"""Limits on the size and memory of files that the readers of meshes and landmarks accept.

Readers process each byte once, so that time and memory are proportional to the size of the file. If a format can refer
to the same bytes repeatedly, or compresses them, an `Allowance` rejects small files that expand to large arrays.
"""

from __future__ import annotations

from pathlib import Path

from shapespace.errors import FileFormatError

LARGEST_MESH_FILE_BYTES = 2**30
"""Largest size of a mesh file, including the buffers of a glTF file (1 GiB)."""

LARGEST_LANDMARK_FILE_BYTES = 2**23
"""Largest size of a landmark file (8 MiB)."""

LARGEST_CONFIGURATIONS_FILE_BYTES = 2**27
"""Largest size of a file with the landmarks of many specimens, and of an unpacked R file (128 MiB)."""

MOST_PARTS = 50_000
"""Largest number of nodes, shapes, pieces, sections and blocks in a file; each takes some microseconds."""

GROWTH = 32
"""Bytes of arrays that a reader may allocate per byte of a file whose bytes can be used more than once."""

SPARE_BYTES = 2**26
"""Bytes of arrays that a reader may allocate in addition, for small files (64 MiB)."""


class Allowance:
    """Remaining memory that data from one file may use.

    Args:
        file_bytes: size of the file, bytes; `more_file` adds the sizes of its external buffers.
        path: path of the file, used in messages.
    """

    def __init__(self, file_bytes: int, path: Path) -> None:
        self.path = path
        self.file_bytes = file_bytes
        self._bytes = SPARE_BYTES + GROWTH * file_bytes
        self._parts = MOST_PARTS

    def more_file(self, file_bytes: int) -> None:
        """Count a further file that belongs to this one."""
        self.file_bytes += file_bytes
        self._bytes += GROWTH * file_bytes

    def take(self, count: int, bytes_each: int) -> None:
        """Subtract an array of `count` numbers from the remaining memory, before it is allocated.

        Raises:
            FileFormatError: the arrays are too large in proportion to the file.
        """
        self._bytes -= count * bytes_each
        if self._bytes < 0:
            raise FileFormatError(
                f"Cannot read {self.path}: its {self.file_bytes} bytes expand to more than {GROWTH} times as much plus "
                f"{SPARE_BYTES >> 20} MiB, so it is damaged or made to fill the memory; export it again as plain "
                "triangles, without copies."
            )

    def part(self, count: int = 1) -> None:
        """Count a node, shape, piece, section or block.

        Raises:
            FileFormatError: there are too many.
        """
        self._parts -= count
        if self._parts < 0:
            raise FileFormatError(
                f"Cannot read {self.path}: it has more than {MOST_PARTS} parts (nodes, shapes, pieces, sections or "
                "blocks); join them and export it again."
            )
