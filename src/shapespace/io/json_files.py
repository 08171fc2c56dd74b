"""JSON of our own files, from whoever sent them: bounded in bytes, depth and the size of its numbers."""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path
from typing import Any, Final, cast

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes, read_error

LARGEST_BYTES: Final = 64 * 2**20
_DEEPEST = 64
_LARGEST_INT = 2**63


def read_json(path: Path, again: str, most_bytes: int = LARGEST_BYTES) -> Any:
    """Return what `plain_json` makes of the file `path`.

    Args:
        path: of the file.
        again: what a reader can do about a file that is wrong.
        most_bytes: that such a file can have.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is no file of so few bytes, or not plain JSON.
    """
    check_file(path, most_bytes, again)
    return json_of(read_bytes(path), path, again)


def json_of(content: bytes, path: Path, again: str) -> Any:
    """Return what `plain_json` makes of the content of the file `path`, wherever that was read.

    Raises:
        FileFormatError: it is not plain JSON.
    """
    try:
        return plain_json(content)
    except ValueError as error:
        raise FileFormatError(f"{path} is not JSON, or it is cut short ({error}); {again}.") from error


def check_file(path: Path, most_bytes: int, again: str) -> None:
    """Refuse what is no file, such as a pipe at which a reader would wait, or larger than such a file can be.

    Raises:
        FileError: it is not there, or cannot be read.
        FileFormatError: it is no file, or too large.
    """
    try:
        about = path.stat()
    except (OSError, ValueError) as error:
        raise read_error(path, error if isinstance(error, OSError) else OSError(str(error))) from error
    if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):
        raise FileFormatError(f"{path} is no file but a pipe or a device; {again}.")
    if about.st_size > most_bytes:
        raise FileFormatError(f"{path} is larger ({about.st_size / 2**20:.0f} MiB) than such a file can be; {again}.")


def plain_json(text: bytes | str) -> Any:
    """Return the value in `text`, with None for numbers that are not finite.

    Raises:
        ValueError: it is not JSON, is nested too deep, or holds a whole number of more than 64 bits.
    """
    try:
        value: object = json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    return _plain(value, 0)


def _plain(value: object, depth: int) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, int):
        if not -_LARGEST_INT <= value < _LARGEST_INT:
            raise ValueError("it holds a number that is too large")
        return value
    if depth > _DEEPEST:
        raise ValueError("it is nested too deep")
    # In place, since a large file is larger still in memory.
    if isinstance(value, list):
        items = cast(list[object], value)
        for at, item in enumerate(items):
            items[at] = _plain(item, depth + 1)
    elif isinstance(value, dict):
        known = cast(dict[str, object], value)
        for key, item in known.items():
            known[key] = _plain(item, depth + 1)
    return cast(object, value)
