"""Rows of single precision in a temporary file, for tables that do not fit into memory.

The file contains panels of columns one after the other, each a C-ordered (rows, width) block of little-endian float32.
Thus, both a block of rows and a block of columns are read in long runs. There is no header.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.files import reading, write_error, writing
from shapespace.types import FloatArray

_PANEL = 1024  # columns; 8 KiB of each row are read in one piece
_BLOCK_BYTES = 64 << 20  # 64 MiB of memory for a block
_FLOAT32 = np.dtype("<f4")


class Spill:
    """A table (rows, columns) of float32 on disk, read as float64.

    Args:
        path: path of the file.
        rows: number of rows, N.
        columns: number of columns, D.
        new: whether to create the file with the size of the table; False to open an existing file.

    Raises:
        FileError: it cannot be written or read, or the disk is full.
        FileFormatError: an existing file has another size.
    """

    def __init__(self, path: Path, rows: int, columns: int, *, new: bool) -> None:
        self.path, self.rows, self.columns = path, rows, columns
        size = rows * columns * _FLOAT32.itemsize
        with writing(path) if new else reading(path):
            self._file = FileIO(path, "w+" if new else "r+")
        try:
            if new:
                self._reserve(size)
            elif path.stat().st_size != size:
                raise FileFormatError(f"{path} is {path.stat().st_size} bytes long, not {size}; it is cut short.")
        except FileFormatError:
            self._file.close()
            raise
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise write_error(path, error) from error

    def _reserve(self, size: int) -> None:
        # Report a full disk now, and not after an hour of writing.
        if hasattr(os, "posix_fallocate") and size:
            os.posix_fallocate(self._file.fileno(), 0, size)
        else:
            self._file.truncate(size)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def block_rows(self) -> int:
        """Number of rows in a block of about 64 MiB as float64."""
        return max(1, min(self.rows, _BLOCK_BYTES // (8 * max(self.columns, 1))))

    def write_rows(self, start: int, block: FloatArray) -> None:
        """Write `block` (n, D) as the rows from `start` on.

        Raises:
            FileError: the disk is full.
        """
        single = block.astype(_FLOAT32)
        for columns in self._panels():
            part = np.ascontiguousarray(single[:, columns]).data.cast("B")
            with writing(self.path):
                self._seek(columns, start)
                while len(part):
                    part = part[self._file.write(part) :]

    def rows_from(self, start: int, stop: int) -> FloatArray:
        """Return the rows (stop - start, D).

        Raises:
            FileError: they cannot be read.
        """
        out = np.empty((stop - start, self.columns))
        for columns in self._panels():
            out[:, columns] = self._read(columns, start, stop)
        return out

    def row_blocks(self) -> Iterator[tuple[int, FloatArray]]:
        """Yield the index of the first row and the rows (n, D) of each block of the table, in order."""
        for start in range(0, self.rows, self.block_rows):
            yield start, self.rows_from(start, min(start + self.block_rows, self.rows))

    def column_blocks(self) -> Iterator[FloatArray]:
        """Yield blocks of columns (N, w) that together are the complete table, in order."""
        for columns in self._panels():
            out = np.empty((self.rows, columns.stop - columns.start))
            for start in range(0, self.rows, 4096):
                stop = min(start + 4096, self.rows)
                out[start:stop] = self._read(columns, start, stop)
            yield out

    def to_disk(self) -> None:
        """Wait until all written data are on the disk.

        Raises:
            FileError: the disk is full.
        """
        with writing(self.path):
            os.fsync(self._file.fileno())

    def _panels(self) -> list[slice]:
        return [slice(start, min(start + _PANEL, self.columns)) for start in range(0, self.columns, _PANEL)]

    def _seek(self, columns: slice, row: int) -> None:
        width = columns.stop - columns.start
        self._file.seek(_FLOAT32.itemsize * (columns.start * self.rows + row * width))

    def _read(self, columns: slice, start: int, stop: int) -> npt.NDArray[np.float32]:
        part = np.empty((stop - start, columns.stop - columns.start), dtype=_FLOAT32)
        view = part.data.cast("B")
        with reading(self.path):
            self._seek(columns, start)
            while len(view):
                count = self._file.readinto(view)
                if not count:
                    raise FileFormatError(f"{self.path} is cut short; start again.")
                view = view[count:]
        return part
