"""Named views of an object, such as dorsal and lateral, in which all figures draw it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.schemas import NamedView, Orientation, read
from shapespace.types import FloatArray

_PARALLEL = 1e-3  # sine of the angle below which two directions determine no rotation
_AGAIN = 'write {"views": [{"name": "dorsal", "toward_viewer": [0, 0, 1], "up": [0, 1, 0]}]}'


def read_orientation(path: Path) -> Orientation:
    """Return the named views of an orientation.json.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged, or two directions of a view are parallel.
    """
    try:
        content = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not JSON; {_AGAIN}.") from error
    orientation = read(Orientation, content, str(path), _AGAIN)
    try:
        for view in orientation.views:
            view_rotation(view)
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error
    if any(number < 1 for link in orientation.links for number in link):
        raise FileFormatError(f"{path}: a link has a landmark below 1; number landmarks from 1.")
    return orientation


def view_rotation(view: NamedView) -> FloatArray:
    """Return the rotation (3, 3) into the frame of a figure: x to the right, y up, z toward the viewer.

    Raises:
        InputError: a direction without length, or an up direction parallel to that of the viewer.
    """
    front, up = np.array(view.toward_viewer, dtype=np.float64), np.array(view.up, dtype=np.float64)
    right = np.cross(up, front)
    if not np.linalg.norm(right) > _PARALLEL * np.linalg.norm(up) * np.linalg.norm(front):
        raise InputError(f"The view {view.name[:40]!r} needs an up direction that is not parallel to toward_viewer.")
    right, front = right / np.linalg.norm(right), front / np.linalg.norm(front)
    return np.stack([right, np.cross(front, right), front])
