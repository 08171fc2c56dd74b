"""The file with the origin and the licence of the meshes in a folder."""

from __future__ import annotations

import json
from pathlib import Path

from shapespace.io.containers.json_files import read_json
from shapespace.io.files import write_text

ABOUT = "about.json"


def write_about(folder: Path, provenance: str, licence: str) -> None:
    """Write the provenance and the licence of the meshes in `folder`.

    Raises:
        FileError: it cannot be written.
    """
    write_text(folder / ABOUT, json.dumps({"provenance": provenance, "licence": licence}, indent=1) + "\n")


def read_about(folder: Path) -> tuple[str, str] | None:
    """Return the provenance and licence of the meshes in `folder`, or None if no file states them."""
    path = folder / ABOUT
    if not path.is_file():
        return None
    try:
        stored = read_json(path, "make the faces again")
        return str(stored["provenance"]), str(stored["licence"])
    except (ValueError, KeyError, TypeError):
        return None
