"""Files that are either whole or not there: atomic writing, hashes, and errors that name the file."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path

from shapespace.errors import FileError

_TEMPORARY = ".shapespace-"
_HOST = re.sub(r"\W|_", "", platform.node())[:24]
_LEFT_S = 3600.0
_WRITE_HINTS = {
    errno.ENOSPC: "the disk is full; free some space and run again",
    errno.EACCES: "no permission; choose another folder",
    errno.EPERM: "no permission; choose another folder",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another folder",
    errno.EISDIR: "it is a folder; give a file name",
    errno.ENOENT: "the folder cannot be made there; choose another folder",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EEXIST: "a file of that name is in the way; choose another folder",
}


def write_error(path: Path, error: OSError) -> FileError:
    """Return the one-sentence error for an `OSError` met while writing `path`."""
    hint = _WRITE_HINTS.get(error.errno or 0, error.strerror or str(error))
    return FileError(f"Cannot write {path}: {hint}.")


def read_error(path: Path, error: OSError) -> FileError:
    """Return the one-sentence error for an `OSError` met while reading `path`."""
    if isinstance(error, FileNotFoundError):
        return FileError(f"Cannot read {path}: there is no such file; check the name.")
    if isinstance(error, IsADirectoryError):
        return FileError(f"Cannot read {path}: it is a folder; give the files in it.")
    if isinstance(error, PermissionError):
        return FileError(f"Cannot read {path}: no permission to read it.")
    return FileError(f"Cannot read {path}: {error.strerror or error}.")


def read_bytes(path: Path) -> bytes:
    """Return the whole content of `path`.

    Raises:
        FileError: it does not exist or cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise read_error(path, error) from error


def make_folder(path: Path) -> Path:
    """Create the folder `path` and its parents, and return it.

    Raises:
        FileError: it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from error
    return path


@contextlib.contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block ends well and vanishes otherwise.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = _temporary_beside(path)
    try:
        yield temporary
        _put(temporary, path)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_together(files: Mapping[Path, Callable[[Path], object]], remove: Iterable[Path] = ()) -> None:
    """Write files of which the last vouches for the others: stopped at any moment, it is whole and theirs, or absent.

    Args:
        files: what writes each, given a temporary path.
        remove: what goes as these come.

    Raises:
        FileError: the folder cannot be written, or the disk is full; what was there is there still.
    """
    with contextlib.ExitStack() as stack:
        written: dict[Path, Path] = {}
        for path, write in files.items():
            written[path] = _temporary_beside(path)
            stack.callback(written[path].unlink, missing_ok=True)
            try:
                write(written[path])
            except OSError as error:
                raise write_error(path, error) from error
        for path in (*list(files)[-1:], *remove):
            remove_file(path)
        for path, temporary in written.items():
            try:
                _put(temporary, path)
            except OSError as error:
                raise write_error(path, error) from error


def _temporary_beside(path: Path) -> Path:
    try:
        prefix = f"{_TEMPORARY}{_HOST}-{os.getpid()}-{path.stem[:40]}."
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise write_error(path, error) from error
    return Path(name)


def _put(temporary: Path, path: Path) -> None:
    umask = os.umask(0)
    os.umask(umask)
    temporary.chmod(0o666 & ~umask)
    temporary.replace(path)


def sweep(folder: Path) -> None:
    """Remove the temporary files of processes that were killed as they wrote into `folder`.

    Those of another machine are left for an hour, since nobody here knows whether it writes still.
    """
    for path in folder.glob(f"{_TEMPORARY}*-*-*"):
        host, pid = path.name.removeprefix(_TEMPORARY).split("-")[:2]
        with contextlib.suppress(OSError, ValueError):
            ended = _has_ended(int(pid)) if host == _HOST else time.time() - path.stat().st_mtime > _LEFT_S
            if ended:
                path.unlink(missing_ok=True)


def _has_ended(pid: int) -> bool:
    if os.name == "nt":
        return False  # there is no harmless signal to ask with
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8 with newlines as they are, whole or not at all.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_bytes(path, text.encode("utf-8"))


def remove_file(path: Path) -> None:
    """Remove `path` if it is there.

    Raises:
        FileError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def sha256_of_file(path: Path) -> str:
    """Return the hexadecimal SHA-256 of the file at `path`.

    Raises:
        FileError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise read_error(path, error) from error
