"""Limits on the size and memory of files that the readers of meshes and landmarks accept.

Readers go through each byte once, so that time and memory grow with the file. Where a format lets one piece of a file
be used again and again, or unpacks it, an `Allowance` stops the file that is small and makes much.
"""

from __future__ import annotations

from pathlib import Path

from shapespace.errors import FileFormatError

LARGEST_MESH_FILE_BYTES = 2**30
"""Mesh files longer than this are not read (1 GiB), with the buffers that a glTF file names."""

LARGEST_LANDMARK_FILE_BYTES = 2**23
"""Landmark files longer than this are not read (8 MiB)."""

LARGEST_CONFIGURATIONS_FILE_BYTES = 2**27
"""Longer files with the landmarks of many specimens are not read (128 MiB), nor R files that unpack to more."""

MOST_PARTS = 50_000
"""Most nodes, shapes, pieces, sections and blocks in one file: each costs some microseconds, however small it is."""

GROWTH = 32
"""Bytes of arrays that a reader may make for each byte of a file that can use its bytes more than once."""

SPARE_BYTES = 2**26
"""Bytes of arrays that it may make besides, for small files (64 MiB)."""


class Allowance:
    """Remaining memory that data from one file may use.

    Args:
        file_bytes: how long the file is; buffers beside it are added by `more_file`.
        path: for messages.
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
        """Count arrays of `count` numbers before they are made.

        Raises:
            FileFormatError: they are out of proportion to the file.
        """
        self._bytes -= count * bytes_each
        if self._bytes < 0:
            raise FileFormatError(
                f"Cannot read {self.path}: its {self.file_bytes} bytes unfold to more than {GROWTH} times as much and "
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
