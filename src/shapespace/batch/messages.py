"""Messages that the processes of a command print only once together: that code is being compiled."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

MARK = "SHAPESPACE_MESSAGE_MARK"
"""Environment variable of the server of the workers alone: a folder that the first process to print creates."""


class _Mark:
    path: str = os.environ.get(MARK, "")


def share_mark() -> str:
    """Return the mark that this process shares with the server that it starts."""
    if not _Mark.path:
        folder = Path(tempfile.mkdtemp(prefix="shapespace-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _Mark.path = str(folder / "printed")
    return _Mark.path


def remove_mark() -> str:
    """Let this process print whatever others print; return that it has no mark."""
    _Mark.path = ""
    return ""


def is_first() -> bool:
    """Return whether this process is the first to print, of those that share its mark; the next call returns False."""
    if not _Mark.path:
        return True
    try:
        Path(_Mark.path).mkdir()
    except FileExistsError:
        return False
    except OSError:  # the folder is gone, or cannot be written: better twice than never
        return True
    return True
