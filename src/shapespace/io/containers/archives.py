"""Archives of arrays (.npz), other zip archives and gzip files: no pickles, memory proportional to the file size."""

from __future__ import annotations

import gzip
import io
import math
import zipfile
import zlib
from collections.abc import Callable, Collection, Generator, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, cast

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from shapespace.errors import FileFormatError
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import atomic_path, read_error
from shapespace.io.parsing import CUT_SHORT, damage_error
from shapespace.io.read_limits import GROWTH

GZIP: Final = b"\x1f\x8b"
"""First bytes of a gzip file."""
LARGEST_BYTES: Final = 2**30  # 1 GiB, packed
_MOST_MEMBERS = 4096  # limit on damaged files; results have tens
_MOST_PACKED = 100
"""Largest ratio of the unpacked to the packed size of an archive; archives of shapespace reach a few times."""
_SMALL = 2**20  # 1 MiB that any file may unpack to, and elements that an array without data may declare
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LONGEST_REASON = 80  # characters of a library's message
_PLAIN_KINDS = "biufU"
_LONGEST_AXIS = 2**31 - 1  # indices are int32
_HEADER_READERS: Final[Mapping[tuple[int, int], Callable[[IO[bytes]], tuple[Any, Any, Any]]]] = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
}


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write `arrays` to `path` atomically.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **cast(dict[str, Any], arrays))


def read_arrays(path: Path, remedy: str, member_names: Collection[str] | None = None) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an .npz file by name.

    Args:
        path: path of the .npz file.
        remedy: advice for the user at the end of an error message, as a clause.
        member_names: names of the arrays to read; None for all.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged, contains other things than arrays, or unpacks to far more than its size.
    """
    check_file(path, LARGEST_BYTES, remedy)
    try:
        with path.open("rb") as stream:
            return arrays_in(stream, path.stat().st_size, member_names)
    except OSError as error:
        raise read_error(path, error) from error
    except ValueError as error:
        raise FileFormatError(
            f"{path} is not an .npz file of arrays, or it is cut short ({error}); {remedy}."
        ) from error


def kept_arrays(path: Path) -> dict[str, npt.NDArray[Any]] | None:
    """Return the arrays in `path`, or None if the file is missing, unreadable or damaged."""
    try:
        with path.open("rb") as stream:
            return arrays_in(stream, path.stat().st_size)
    except (OSError, ValueError):
        return None


def arrays_in(stream: BinaryIO, size: int, member_names: Collection[str] | None = None) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an .npz file in `stream` by name, limited to `member_names` unless that is None.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, contains other things than arrays, or unpacks to far more than `size` bytes.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, content in _members(
        stream, size, None if member_names is None else {f"{name}.npy" for name in member_names}
    ):
        try:
            arrays[name.removesuffix(".npy")] = npy_array(content)
        except ValueError as error:
            raise ValueError(f"{name[:60]!r} in it {error}") from error
    return arrays


def zip_members(stream: BinaryIO, size: int, member_names: Collection[str] | None = None) -> dict[str, bytes]:
    """Return the members of the archive in `stream` by name, limited to `member_names` unless that is None.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not an archive, is damaged, or would unpack to far more than `size` bytes.
    """
    return dict(_members(stream, size, member_names))


def _members(stream: BinaryIO, size: int, member_names: Collection[str] | None) -> Generator[tuple[str, bytes]]:
    """Yield name and content of each member; only one member at a time is in memory."""
    try:
        with zipfile.ZipFile(stream) as archive:
            for name in _checked_names(archive, size):
                if member_names is None or name in member_names:
                    yield name, archive.read(name)
    except OSError:
        raise
    except Exception as error:  # a damaged archive may raise any exception
        raise ValueError(" ".join(str(error).split())[:_LONGEST_REASON] or "it is damaged") from error


def _checked_names(archive: zipfile.ZipFile, size: int) -> list[str]:
    """Return the names of the members of an archive of `size` bytes.

    Raises:
        ValueError: it has too many members, or would unpack to far more than its size.
    """
    infos = archive.infolist()
    names = [info.filename for info in infos]
    if len(names) > _MOST_MEMBERS or len(set(names)) != len(names):
        raise ValueError("it has too many or repeated members")
    if sum(info.file_size for info in infos) > max(_SMALL, _MOST_PACKED * size):
        raise ValueError("it would unpack to far more than its size")
    if any(info.compress_type not in _PACKED for info in infos):
        raise ValueError("it uses an unsupported compression method")
    return names


def read_row(path: Path, name: str, row: int, remedy: str) -> tuple[npt.NDArray[Any], int]:
    """Return one row of an array of floats in an .npz file, and the number of rows, without loading the other rows.

    Args:
        path: path of the .npz file.
        name: name of the array in the file.
        row: index of the row along the first axis.
        remedy: advice for the user at the end of an error message, as a clause.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it has no such array or row, or see `read_arrays`.
    """
    check_file(path, LARGEST_BYTES, remedy)
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            if f"{name}.npy" not in _checked_names(archive, path.stat().st_size):
                raise ValueError(f"it has no {name}")
            with archive.open(f"{name}.npy") as content:
                shape, fortran, dtype = npy_header(content)
                declared = math.prod(shape) * dtype.itemsize
                stored = archive.getinfo(f"{name}.npy").file_size - content.tell()
                rows = shape[0] if len(shape) > 1 else 0
                if dtype.kind != "f" or declared != stored or fortran:
                    raise ValueError(f"{name} is not the array of floats that its header declares")
                if not 0 <= row < rows:
                    raise ValueError(f"{name} has {rows} rows, and not row {row}")
                content.seek(content.tell() + row * (declared // rows))
                data = content.read(declared // rows)
                return np.frombuffer(data, dtype).reshape(shape[1:]).copy(), rows
    except OSError as error:
        raise read_error(path, error) from error
    except Exception as error:  # a damaged archive may raise any exception
        problem = " ".join(str(error).split())[:_LONGEST_REASON] or "it is damaged"
        raise FileFormatError(
            f"{path} is not an .npz file of arrays, or it is cut short ({problem}); {remedy}."
        ) from error


def npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of a .npy file; all readers of such headers use this function.

    Args:
        stream: the file, at its first byte; afterwards at the first byte of the numbers.

    Returns:
        The shape, whether the first axis varies fastest, and the type of the elements.

    Raises:
        ValueError: the header is damaged, or the length of an axis is not an integer from 0 to `_LONGEST_AXIS`; the
            message is a clause.
    """
    try:
        shape, fortran, dtype = _HEADER_READERS[npy.read_magic(stream)](stream)
    except Exception as error:  # numpy's parser of headers may raise any exception
        raise ValueError("is not an array") from error
    # numpy accepts truth values as lengths of axes.
    if not all(type(length) is int and 0 <= length <= _LONGEST_AXIS for length in shape):
        raise ValueError("has an axis whose length is not an integer, is negative or is too large")
    return tuple(shape), bool(fortran), dtype


def npy_array(data: bytes) -> npt.NDArray[Any]:
    """Return the array of numbers, truth values or text in the .npy file `data`.

    Raises:
        ValueError: it is no such array, or its size differs from its header; the message is a clause.
    """
    stream = io.BytesIO(data)
    shape, fortran, dtype = npy_header(stream)
    start = stream.tell()
    if dtype.kind not in _PLAIN_KINDS or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError("is cut short or contains objects, and does not match its header")
    # An array without elements takes no memory, but a loop over its longest axis takes time.
    if len(data) == start and max(shape, default=0) > _SMALL:
        raise ValueError("is empty and has an axis that is too long")
    flat: npt.NDArray[Any] = (
        np.frombuffer(data, dtype, math.prod(shape), start) if len(data) > start else np.empty(0, dtype)
    )
    return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


def unpack_gzip(data: bytes, path: Path, max_bytes: int) -> bytes:
    """Return the unpacked content of a gzip file.

    Args:
        data: complete content of the gzip file.
        path: path of the file, used in messages.
        max_bytes: largest allowed size of the unpacked content, bytes.

    Raises:
        FileFormatError: it is cut short or damaged, or unpacks to more than `max_bytes`, or `read_limits.GROWTH` times
            its size.
    """
    max_bytes = min(max_bytes, max(GROWTH * len(data), _SMALL))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            content = stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise damage_error(path, f"its compressed data end early or are wrong; {CUT_SHORT}") from error
    if len(content) > max_bytes:
        raise damage_error(
            path, f"it unpacks to more than {max_bytes / 2**20:.0f} MiB, so unpack it with gunzip and check its content"
        )
    return content
