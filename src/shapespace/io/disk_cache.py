"""The cache on disk: computed arrays for later runs, in the user's cache folder, up to a total size.

`key` names an entry by all its inputs. A file contains the SHA-256 of an `.npz` in hexadecimal, then the `.npz`.
An entry that is damaged, or cannot be read or written, counts as missing: the caller computes it again. `clear` removes
all entries, as `shapespace cache --clear` does; those in memory are in `memory_cache`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from platformdirs import user_cache_path

from shapespace.errors import FileError
from shapespace.io.containers.archives import arrays_in
from shapespace.io.files import atomic_path, remove_file
from shapespace.version import __version__

MOST_BYTES = 500_000_000
"""Limit of the total size of all entries; those that were not used for the longest time are removed."""
_FOLDER, _ENDING = "kept", ".kept"
_DIGEST_BYTES = 64  # hexadecimal digits of SHA-256
_OFF = ("no", "off", "0")


def cache_folder() -> Path:
    """Return the folder of downloads and cached arrays: `SHAPESPACE_CACHE`, or the platform's own cache folder."""
    configured = os.environ.get("SHAPESPACE_CACHE")
    return Path(configured) if configured else user_cache_path("shapespace")


def entries_folder() -> Path | None:
    """Return the folder of the entries, which `SHAPESPACE_KEEP` may set; None if that variable disables the cache."""
    word = os.environ.get("SHAPESPACE_KEEP", "")
    if word.lower() in _OFF:
        return None
    return Path(word) if word else cache_folder() / _FOLDER


def key(kind: str, version: int, *dependencies: object) -> str:
    """Return the name of an entry.

    Args:
        kind: kind of the arrays, such as "residual".
        version: version of the algorithm that computes the arrays, increased whenever its results change.
        dependencies: all other inputs: the content hash of a model, settings. The version of shapespace is added.
    """
    text = "\n".join((str(version), __version__, *map(str, dependencies)))
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()}"


def entries() -> list[Path]:
    """Return the files of all entries."""
    folder = entries_folder()
    return [] if folder is None or not folder.is_dir() else sorted(folder.glob(f"*{_ENDING}"))


def clear() -> None:
    """Remove all entries.

    Raises:
        FileError: a file cannot be removed.
    """
    for file in entries():
        remove_file(file)


def _file(name: str) -> Path | None:
    folder = entries_folder()
    return None if folder is None else folder / f"{name}{_ENDING}"


def recall(name: str) -> dict[str, npt.NDArray[Any]] | None:
    """Return the arrays of the entry `name`, or None if it is missing or damaged."""
    path = _file(name)
    if path is None:
        return None
    try:
        with path.open("rb") as stream:
            stored_digest = stream.read(_DIGEST_BYTES)
            if hashlib.file_digest(stream, "sha256").hexdigest().encode() != stored_digest:
                return None
            stream.seek(_DIGEST_BYTES)
            arrays = arrays_in(stream, path.stat().st_size)
    except (OSError, ValueError):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # entries that are used are removed last
    return arrays


def keep(name: str, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Store `arrays` as `name`, and remove the least recently used entries beyond `MOST_BYTES`; errors are ignored."""
    path = _file(name)
    if path is None or sum(array.nbytes for array in arrays.values()) > MOST_BYTES:
        return
    with contextlib.suppress(OSError, FileError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary, temporary.open("w+b") as stream:
            stream.write(b"0" * _DIGEST_BYTES)
            stored: dict[str, Any] = dict(arrays)  # the keywords of savez have another type
            np.savez(stream, **stored)
            stream.seek(_DIGEST_BYTES)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
            stream.seek(0)
            stream.write(digest.encode())
        _drop_oldest(path.parent)


def _drop_oldest(folder: Path) -> None:
    entries: list[tuple[float, int, Path]] = []
    for file in folder.iterdir():
        with contextlib.suppress(OSError):  # another process dropped it first
            about = file.stat()
            entries.append((about.st_mtime, about.st_size, file))
    total = 0
    for _, size, file in sorted(entries, reverse=True):
        total += size
        if total > MOST_BYTES:
            with contextlib.suppress(OSError):
                file.unlink()
