"""Scans at remote addresses that fsspec supports, such as s3://bucket/scan.ply, copied for a fit."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
import time
from collections.abc import Generator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from shapespace.errors import FileError, InputError, ShapespaceError

TRIES = 3
"""Number of attempts to download a file."""
_WAIT_S = 0.5  # seconds; doubled at each attempt
_PIECE = 1 << 20  # bytes (1 MiB)
_GLOB = frozenset("*?[")


def is_address(text: str) -> bool:
    """Return whether `text` is an address and not a path."""
    return "://" in text


def name_of(address: str) -> str:
    """Return the name of the file at an address; in an archive, that of the file inside."""
    inside = address.split("::", 1)[0].split("://", 1)[1]
    return PurePosixPath(inside.partition("?")[0]).name


def addresses(address: str, endings: Sequence[str], *, recursive: bool) -> list[str]:
    """Return the files at an address: itself, the matches of a pattern, or the files in a folder.

    Args:
        address: a file, a folder, or a pattern with * or ?.
        endings: endings of the files to select from patterns and folders, in lower case.
        recursive: whether to include files in subfolders.

    Raises:
        InputError: there are no such files.
        FileError: the address cannot be reached.
        ShapespaceError: the package that reads such addresses is not installed.
    """
    with _translate_errors(address):
        files, path = _files(address)
        head, sep, chain = address.partition("::")
        scheme = head.split("://", 1)[0]
        if _GLOB & set(path):
            paths = files.glob(path)
        elif head.lower().endswith(tuple(endings)):
            return [address]
        else:
            paths = files.find(path, maxdepth=None if recursive else 1)
        full_addresses = [f"{scheme}://{str(item).removeprefix(f'{scheme}://')}{sep}{chain}" for item in sorted(paths)]
    readable = [item for item in full_addresses if name_of(item).lower().endswith(tuple(endings))]
    if not readable:
        raise InputError(f"{address} contains no meshes; shapespace reads {', '.join(endings)}.")
    return readable


def version_of(address: str) -> str:
    """Return a hash that changes with the file at an address, without reading it.

    Raises:
        FileError: it cannot be reached.
        ShapespaceError: the package that reads such addresses is not installed.
    """
    with _translate_errors(address):
        files, path = _files(address)
        return hashlib.sha256(str(files.ukey(path)).encode()).hexdigest()


@contextlib.contextmanager
def fetch_copy(address: str, most_bytes: int) -> Generator[Path]:
    """Yield the path of a temporary copy of the file at an address; it keeps the name and is removed after the block.

    Raises:
        FileError: it cannot be downloaded after `TRIES` attempts.
        InputError: it is larger than `most_bytes`.
        ShapespaceError: the package that reads such addresses is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="shapespace-") as folder:
        file = Path(folder) / name_of(address)
        for number in range(1, TRIES + 1):
            try:
                _copy(address, file, most_bytes)
                break
            except FileError:
                if number == TRIES:
                    raise
                time.sleep(_WAIT_S * 2**number)
        yield file


def _copy(address: str, file: Path, most_bytes: int) -> None:
    with _translate_errors(address):
        files, path = _files(address)
        with files.open(path, "rb") as source, file.open("wb") as copy:
            count = 0
            while piece := source.read(_PIECE):
                count += len(piece)
                if count > most_bytes:
                    raise InputError(
                        f"{address} is larger than {most_bytes:,} bytes; decimate the scan, for example with MeshLab."
                    )
                copy.write(piece)


def _files(address: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs  # pyright: ignore[reportUnknownVariableType]

    filesystem: tuple[Any, str] = url_to_fs(address)  # pyright: ignore[reportUnknownVariableType]
    return filesystem


@contextlib.contextmanager
def _translate_errors(address: str) -> Generator[None]:
    """Convert exceptions of fsspec and its backends to one error message."""
    try:
        yield
    except ShapespaceError:
        raise
    except ImportError as error:
        raise ShapespaceError(
            "Addresses need the extra 'remote', and s3:// and gs:// need s3fs and gcsfs too; run "
            "pip install 'shapespace[remote]' s3fs gcsfs, or give files."
        ) from error
    except FileNotFoundError as error:
        raise FileError(f"Cannot read {address}: there is no such file; check the address.") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FileError(f"Cannot read {address}: {reason}; check the address and the connection.") from error
