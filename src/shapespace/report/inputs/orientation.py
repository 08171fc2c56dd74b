"""Named views of an object, such as dorsal and lateral, in which all figures draw it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from msgspec import structs

from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.io.tables.table_io import table_rows
from shapespace.schemas import NamedView, Orientation, read
from shapespace.types import FloatArray

LINKS = "links.csv"
"""Table of pairs of landmarks, numbers from 1, between which figures have a line."""
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
    return orientation


def find_orientation(path: Path | None, folders: Sequence[Path]) -> Orientation | None:
    """Return the orientation of a file, or of orientation.json and links.csv in the first folders that have them.

    Args:
        path: the file; None searches the folders.
        folders: of the shapes.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: it is damaged.
    """
    views, links = (
        next((folder / name for folder in folders if (folder / name).is_file()), None)
        for name in (Orientation.FILE, LINKS)
    )
    path = path or views
    orientation = Orientation() if path is None else read_orientation(path)
    if links is not None and not orientation.links:
        try:
            rows = list(table_rows(read_bytes(links)))[1:]
            orientation = structs.replace(orientation, links=tuple((int(a), int(b)) for a, b in rows))
        except ValueError as error:
            raise FileFormatError(f"{links} needs two columns with the numbers of landmarks, from 1.") from error
    if any(number < 1 for link in orientation.links for number in link):
        raise FileFormatError(f"{path or links}: a link has a landmark below 1; number landmarks from 1.")
    return orientation if orientation.views or orientation.links else None


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
