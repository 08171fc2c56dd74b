"""Named arrays in one `.npz` file, written atomically; a damaged file is treated as missing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.io.containers.archives import arrays_in
from shapespace.io.files import atomic_path


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write `arrays` to `path`, whole or not at all.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **cast(dict[str, Any], arrays))


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]] | None:
    """Return the arrays in `path`; None where there are none, or none that are whole."""
    try:
        with path.open("rb") as stream:
            return arrays_in(stream, path.stat().st_size)
    except (OSError, ValueError):
        return None
