"""One run at a time into one folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from pathlib import Path

from filelock import lock_descriptor

from shapespace.errors import FileError
from shapespace.io.files import sweep, write_error

LOCK = ".shapespace.lock"
"""Is there while a run writes: the system holds the lock, and lets go of it whatever ends the process."""


@contextlib.contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Keep other runs from writing into `folder` during the block, and remove what killed ones left half written.

    Raises:
        FileError: another run writes into it, or it cannot be written.
    """
    path = folder / LOCK
    try:
        descriptor = _locked(path)
    except OSError as error:
        raise write_error(path, error) from error
    try:
        sweep(folder)
        yield
    finally:
        sweep(folder)
        # While it is held; Windows alone removes no file that is open.
        if os.name == "nt":
            os.close(descriptor)
        with contextlib.suppress(OSError):
            path.unlink()
        if os.name != "nt":
            os.close(descriptor)


def _locked(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not lock_descriptor(descriptor, blocking=False):
                raise FileError(
                    f"{path.parent} is being written by another run of shapespace; wait for its end, or give another "
                    "folder."
                )
            if _is_open_as(path, descriptor):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_open_as(path: Path, descriptor: int) -> bool:
    """Return whether `path` is still the file that is open, and not removed by the run that held it."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
