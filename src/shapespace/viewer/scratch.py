"""The folder that holds what visitors drop: locked while its viewer lives, and swept by the next one where it died."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from itertools import islice
from pathlib import Path

try:
    import fcntl
except ImportError:  # no locks of this kind on Windows, so nothing is swept there
    fcntl = None

PREFIX = "shapespace-view-"
_LOCK = "in-use.lock"
_MOST_SWEPT = 100


def new_folder() -> tuple[Path, Callable[[], None]]:
    """Return a new temporary folder that only this user can read, and a function that removes it; it may run twice."""
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    lock = _locked(folder)

    def remove() -> None:
        nonlocal lock
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)
            lock = None

    return folder, remove


def sweep() -> int:
    """Remove folders of this user's viewers that were killed, and return how many; at most 100 are looked at.

    A folder goes only where nobody holds its lock, which the system lets go of when a process ends in any way.
    """
    if fcntl is None:
        return 0
    found = islice(Path(tempfile.gettempdir()).glob(f"{PREFIX}*"), _MOST_SWEPT)
    return sum(_swept(folder) for folder in found)


def _swept(folder: Path) -> bool:
    assert fcntl is not None
    try:
        facts = folder.lstat()
        if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.getuid():
            return False
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    except OSError:
        return False
    finally:
        os.close(lock)
    return not folder.exists()


def _locked(folder: Path) -> int | None:
    """Return the file that says that the folder is in use; it has its name only once it is locked."""
    if fcntl is None:
        return None
    unnamed = folder / f"{_LOCK}.new"
    lock = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        unnamed.rename(folder / _LOCK)
    except OSError:
        # A file system without locks: the folder is used, and never swept.
        with contextlib.suppress(OSError):
            unnamed.unlink()
        os.close(lock)
        return None
    return lock
