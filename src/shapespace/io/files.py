"""Atomic writing of files, hashes, and errors that name the file."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from io import BufferedReader
from pathlib import Path

from shapespace.errors import FileError

_TEMPORARY = ".shapespace-"
_LEFT_S = 3600.0
"""Age in seconds at which temporary files of other machines, whose processes cannot be checked, are removed."""
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


def _host() -> str:
    """Return an identifier of this machine and, on Linux, of the process namespace of this container."""
    try:
        space = Path("/proc/self/ns/pid").stat().st_ino
    except OSError:
        space = 0
    return f"{re.sub(r'[^A-Za-z0-9]', '', platform.node())[:24]}n{space}"


_HOST = _host()
_swept: set[Path] = set()
"""Folders from which this process has removed the temporary files of killed processes."""


def write_error(path: Path, error: OSError) -> FileError:
    """Return the one-sentence error for an `OSError` met while writing `path`."""
    if isinstance(error, FileError):
        return error
    hint = _WRITE_HINTS.get(error.errno or 0, error.strerror or str(error))
    return FileError(f"Cannot write {path}: {hint}.")


def read_error(path: Path, error: OSError) -> FileError:
    """Return the one-sentence error for an `OSError` met while reading `path`; a `FileError` is returned as it is."""
    if isinstance(error, FileError):
        return error
    if isinstance(error, FileNotFoundError):
        return FileError(f"Cannot read {path}: there is no such file; check the name.")
    if isinstance(error, IsADirectoryError):
        return FileError(f"Cannot read {path}: it is a folder; give the files in it.")
    if isinstance(error, PermissionError):
        return FileError(f"Cannot read {path}: no permission to read it.")
    return FileError(f"Cannot read {path}: {error.strerror or error}.")


@contextlib.contextmanager
def reading(path: Path) -> Generator[None]:
    """Raise an `OSError` of the block as the `FileError` of `read_error`."""
    try:
        yield
    except OSError as error:
        raise read_error(path, error) from error


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise an `OSError` of the block as the `FileError` of `write_error`."""
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error


def open_file(path: Path) -> BufferedReader:
    """Open the regular file `path` for reading; pipes and devices, which may block or never end, are rejected.

    Raises:
        FileError: it does not exist, cannot be read, or is no file.
    """
    with reading(path):
        # Without O_NONBLOCK, opening a pipe blocks until another process writes into it.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        try:
            mode = os.fstat(handle).st_mode
            if stat.S_ISDIR(mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            if not stat.S_ISREG(mode):
                raise FileError(f"Cannot read {path}: it is a pipe or a device, not a file; give a file.")
            return os.fdopen(handle, "rb")
        except BaseException:
            os.close(handle)
            raise


def read_bytes(path: Path, at_most: int | None = None) -> bytes:
    """Return the complete content of `path`.

    Args:
        path: path of a regular file.
        at_most: largest allowed size of the file, bytes; None for any size.

    Raises:
        FileError: it does not exist, cannot be read, is no file, or is too long.
    """
    with open_file(path) as stream, reading(path):
        size = os.fstat(stream.fileno()).st_size
        if at_most is not None and size > at_most:
            raise FileError(
                f"Cannot read {path}: it has {size / 2**20:.1f} MiB, and the limit for such files is "
                f"{at_most / 2**20:.0f} MiB; decimate or split it first."
            )
        return stream.read() if at_most is None else stream.read(size)


def make_folder(path: Path) -> Path:
    """Create the folder `path` and its parents, and return it.

    Raises:
        FileError: it cannot be created.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


@contextlib.contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Yield a temporary path in the folder of `path`; it replaces `path` if the block succeeds, or is removed.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = _make_temporary_file(path)
    try:
        yield temporary
        _move_into_place(temporary, path)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_together(files: Mapping[Path, Callable[[Path], object]], remove: Iterable[Path] = ()) -> None:
    """Write several files so that the last is complete and matches the others, or is absent, after any interruption.

    Args:
        files: path of each file -> function that writes the file to a given temporary path.
        remove: files that are removed before the new files are moved into place.

    Raises:
        FileError: the folder cannot be written, or the disk is full; existing files are unchanged.
    """
    with contextlib.ExitStack() as stack:
        written: dict[Path, Path] = {}
        for path, write in files.items():
            written[path] = _make_temporary_file(path)
            stack.callback(written[path].unlink, missing_ok=True)
            with writing(path):
                write(written[path])
        for path in (*list(files)[-1:], *remove):
            remove_file(path)
        for path, temporary in written.items():
            with writing(path):
                _move_into_place(temporary, path)


@contextlib.contextmanager
def temporary_folder(parent: Path) -> Generator[Path]:
    """Yield a new folder in `parent`; it is removed after the block, or before the next write if the process is killed.

    Raises:
        FileError: `parent` cannot be written.
    """
    _sweep_once(parent)
    with writing(parent):
        stack = tempfile.TemporaryDirectory(prefix=_prefix("folder"), dir=parent)
    with stack as name:
        yield Path(name)


def _prefix(stem: str) -> str:
    return f"{_TEMPORARY}{_HOST}-{os.getpid()}-{stem}."


def _make_temporary_file(path: Path) -> Path:
    _sweep_once(path.parent)
    # The temporary file of a temporary file also contains the name of its target.
    stem = path.stem.split("-", 3)[-1] if path.name.startswith(_TEMPORARY) else path.stem
    with writing(path):
        handle, name = tempfile.mkstemp(prefix=_prefix(stem[:40]), suffix=path.suffix, dir=path.parent)
        os.close(handle)
    return Path(name)


def _sweep_once(folder: Path) -> None:
    """Remove the temporary files of killed processes from `folder`, before this process first writes there."""
    folder = folder.absolute()
    if folder not in _swept:
        _swept.add(folder)
        sweep(folder)


def _move_into_place(temporary: Path, path: Path) -> None:
    umask = os.umask(0)
    os.umask(umask)
    temporary.chmod(0o666 & ~umask)
    temporary.replace(path)


def sweep(folder: Path) -> None:
    """Remove the temporary files and folders of processes that were killed as they wrote into `folder`.

    Every writer does so before its first file in a folder. Files of another machine, and all files on Windows, are kept
    for an hour, because it cannot be determined whether their process is still running.
    """
    for path in folder.glob(f"{_TEMPORARY}*-*-*"):
        host, pid = path.name.removeprefix(_TEMPORARY).split("-")[:2]
        with contextlib.suppress(OSError, ValueError, OverflowError):
            known = host == _HOST and os.name != "nt"  # Windows has no harmless signal that tests a process
            if _is_process_over(int(pid)) if known else time.time() - path.lstat().st_mtime > _LEFT_S:
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _is_process_over(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8 with unchanged newlines, atomically.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_bytes(path, text.encode("utf-8"))


def remove_file(path: Path) -> None:
    """Remove `path` if it exists.

    Raises:
        FileError: it cannot be removed.
    """
    with writing(path):
        path.unlink(missing_ok=True)


def move_file(source: Path, target: Path) -> None:
    """Move `source` to `target` in the same file system, in one step; a file there is replaced.

    Raises:
        FileError: it cannot be moved.
    """
    with writing(target):
        source.replace(target)


def sha256_of_file(path: Path) -> str:
    """Return the hexadecimal SHA-256 of the file at `path`.

    Raises:
        FileError: it cannot be read.
    """
    with open_file(path) as stream, reading(path):
        return hashlib.file_digest(stream, "sha256").hexdigest()
