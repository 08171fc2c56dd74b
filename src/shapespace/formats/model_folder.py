"""Atomic writing of folders."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from shapespace.errors import InputError
from shapespace.io.files import temporary_folder, write_error


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder `path` with `files`, by their names.

    Raises:
        InputError: there is such a folder, and something in it.
        FileError: it cannot be made, or the disk is full.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path} is there already; give the name of a new folder.")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Beside it, so that one step puts it there.
        with temporary_folder(path.parent) as temporary:
            complete = temporary / "whole"
            complete.mkdir()
            for name, data in files.items():
                (complete / name).write_bytes(data)
            if path.exists():
                path.rmdir()
            shutil.move(complete, path)
    except OSError as error:
        raise write_error(path, error) from error
