"""James: a real 3dMD head scan with hair, ears and collar, and 68 landmarks (BSD, from menpo3d)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from shapespace.datasets import fetch
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import Mesh

NAME = "james"


def james_available() -> bool:
    """Return whether the mirror or the cache contains James; never downloads.

    Raises:
        DataError: the mirror is incomplete.
    """
    return fetch.data_folder(NAME) is not None


def load_james(folder: Path | None = None) -> Mesh:
    """Return the scan James in mm: 6,393 coloured vertices, 12,228 triangles, landmarks `chin_0` to `mouth_19`.

    Args:
        folder: folder with `james.obj` and `james.ljson`; None for the copy in the mirror or the cache, whose hashes
            are verified. Nothing is downloaded.

    Raises:
        DataError: `folder` is None and James is not here or does not match its hash.
        FileError: a file cannot be read or is damaged.
    """
    folder = fetch.present_folder(NAME, "James") if folder is None else folder
    scan = read_mesh(Path(folder) / "james.obj")
    return replace(scan, landmarks=read_landmarks(Path(folder) / "james.ljson"), name="james")
