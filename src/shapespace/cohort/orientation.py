"""Named views of an object, such as dorsal and lateral, for all figures."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
from msgspec import structs

from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers.json_files import read_json
from shapespace.io.landmarks.landmark_configurations import read_landmark_numbers
from shapespace.schemas import NamedView, Orientation, read
from shapespace.types import FloatArray

LINKS = "links.csv"
"""Table of pairs of landmarks between which figures have a line."""
_PARALLEL = 1e-3  # sine of the angle below which two directions determine no rotation
_AGAIN = 'write {"views": [{"name": "dorsal", "toward_viewer": [0, 0, 1], "up": [0, 1, 0]}]}'

_NO_VIEWS = Orientation()
_ORIENTATION: ContextVar[Orientation] = ContextVar("orientation", default=_NO_VIEWS)


@contextmanager
def oriented(orientation: Orientation | None) -> Generator[None]:
    """Return a context that sets the named views and links of figures to an orientation; None for the defaults."""
    token = _ORIENTATION.set(orientation or _NO_VIEWS)
    try:
        yield
    finally:
        _ORIENTATION.reset(token)


def current_orientation() -> Orientation:
    """Return the named views and links of the figures that are drawn."""
    return _ORIENTATION.get()


def find_orientation(
    path: Path | None,
    folders: Sequence[Path],
    landmarks: Sequence[str] | None = None,
    curve_links: tuple[tuple[int, int], ...] = (),
) -> Orientation | None:
    """Return the orientation of a file, or of orientation.json and links.csv in the first folders that have them.

    Args:
        path: file of the orientation; None searches the folders.
        folders: folders of the shapes.
        landmarks: names of the landmarks, which links.csv may have; None for numbers alone.
        curve_links: links that are used if the files have none.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: it is damaged, or two directions of a view are parallel.
    """
    views, links = (
        next((folder / name for folder in folders if (folder / name).is_file()), None)
        for name in (Orientation.FILE, LINKS)
    )
    path, orientation = path or views, Orientation()
    if path is not None:
        orientation = read(Orientation, read_json(path, _AGAIN), str(path), _AGAIN)
        try:
            for view in orientation.views:
                view_rotation(view)
        except InputError as error:
            raise FileFormatError(f"{path}: {error}") from error
        if any(number < 1 for link in orientation.links for number in link):
            raise FileFormatError(f"{path}: a link has a landmark number below 1; number landmarks from 1.")
    if not orientation.links:
        orientation = structs.replace(
            orientation, links=(curve_links if links is None else read_links(links, landmarks))
        )
    return orientation if orientation.views or orientation.links else None


def read_links(path: Path, landmarks: Sequence[str] | None) -> tuple[tuple[int, int], ...]:
    """Return the numbers of landmarks, from 1, in a table of pairs; errors are those of `read_landmark_numbers`."""
    return tuple(
        (first, second) for first, second in read_landmark_numbers(path, landmarks, (2,), "two landmarks").tolist()
    )


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
