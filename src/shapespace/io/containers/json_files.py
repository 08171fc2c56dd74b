"""Reader and writer of untrusted JSON files, with limits on size, depth and numbers."""

from __future__ import annotations

import json
import math
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, cast

import msgspec

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes, read_error

LARGEST_BYTES: Final = 64 * 2**20  # 64 MiB
_DEEPEST = 64  # levels; limit on damaged files
_LARGEST_INT = 2**63  # int64


def read_json(path: Path, remedy: str, most_bytes: int = LARGEST_BYTES) -> Any:
    """Return the value of the JSON file `path`, see `plain_json`.

    Args:
        path: path of the JSON file.
        remedy: advice for the user at the end of an error message, as a clause.
        most_bytes: largest allowed size of the file, bytes.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not a regular file, is larger than `most_bytes`, or is not plain JSON.
    """
    check_file(path, most_bytes, remedy)
    return parse_json(read_bytes(path), path, remedy)


def parse_json(content: bytes, path: Path, remedy: str) -> Any:
    """Return the value of JSON `content`, see `plain_json`; `path` and `remedy` are used in error messages.

    Raises:
        FileFormatError: it is not plain JSON.
    """
    try:
        return plain_json(content)
    except ValueError as error:
        raise FileFormatError(f"{path} is not JSON, or it is cut short ({error}); {remedy}.") from error


def check_file(path: Path, most_bytes: int, remedy: str) -> None:
    """Check that `path` is a regular file or folder of at most `most_bytes`, and not a pipe, whose reader would block.

    Raises:
        FileError: it does not exist, or cannot be read.
        FileFormatError: it is a pipe or a device, or too large.
    """
    try:
        about = path.stat()
    except (OSError, ValueError) as error:
        raise read_error(path, error if isinstance(error, OSError) else OSError(str(error))) from error
    if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):
        raise FileFormatError(f"{path} is a pipe or a device, not a file; {remedy}.")
    if about.st_size > most_bytes:
        raise FileFormatError(f"{path} is larger ({about.st_size / 2**20:.0f} MiB) than such a file can be; {remedy}.")


def plain_json(text: bytes | str) -> Any:
    """Return the value in `text`, with None for numbers that are not finite.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or contains an integer of more than 64 bits.
    """
    try:
        value: object = _decode(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    holder = [value]
    _make_plain(holder, 0)
    return holder[0]


def _make_plain(container: dict[Any, object] | list[object], depth: int) -> None:
    """Check the items of a container and replace numbers that are not finite by None, in place to save memory."""
    if depth > _DEEPEST + 1:
        raise ValueError("it is nested too deep")
    for key, item in cast(
        Iterable[tuple[Any, object]], container.items() if isinstance(container, dict) else enumerate(container)
    ):
        kind = item.__class__  # most items are numbers and words, for which a call would dominate the time
        if kind is float:
            if not math.isfinite(cast(float, item)):
                container[key] = None
        elif kind is list or kind is dict:
            _make_plain(cast(list[object], item), depth + 1)
        elif kind is int and not -_LARGEST_INT <= cast(int, item) < _LARGEST_INT:
            raise ValueError("it contains a number that is too large")


def _decode(text: bytes | str) -> object:
    """Return the value in `text`; the slower parser reads text that is not strict JSON, such as NaN."""
    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError:
        return json.loads(text)
