"""What is said once by a command of several processes: that code is being compiled."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

SAID = "SHAPESPACE_SAID"
"""Set for the server of the workers alone: a folder that whoever says it first makes."""


class _Mark:
    path: str = os.environ.get(SAID, "")


def shared() -> str:
    """Return the mark that this process shares with the server that it starts."""
    if not _Mark.path:
        folder = Path(tempfile.mkdtemp(prefix="shapespace-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _Mark.path = str(folder / "said")
    return _Mark.path


def alone() -> str:
    """Let this process say what it says whatever others say; return that it has no mark."""
    _Mark.path = ""
    return ""


def is_first_to_say() -> bool:
    """Return whether neither this process nor one that it shares a mark with has said it."""
    if not _Mark.path:
        return True
    try:
        Path(_Mark.path).mkdir()
    except FileExistsError:
        return False
    except OSError:  # the folder is gone, or cannot be written: better twice than never
        return True
    return True
