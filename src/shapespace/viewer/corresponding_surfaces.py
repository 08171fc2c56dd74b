"""What the viewer shows of a folder in correspondence: surfaces one by one, and where a vertex lies on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from shapespace.errors import InputError, ShapespaceError
from shapespace.io.tables.table_io import table_text
from shapespace.report.blocks.wording import without_folders
from shapespace.report.inputs.correspondence_folder import Corresponded
from shapespace.report.inputs.triage import Concern, concerns_of, distance_share, scan_status, sentence
from shapespace.report.render import palette as colours
from shapespace.report.render.checkerboard import SQUARES, checker_places
from shapespace.report.render.scene import pack, quantise
from shapespace.version import __version__

MOST_MARKED = 100
"""So many vertices are told of all scans at a time."""

_PAGE, _PAGE_BYTES = 11, 24 * 2**20
_BYTES_A_VERTEX = 6
_ORDER = ("unreadable", "set aside", "look", "corresponding")


class Surfaces:
    """A folder in correspondence for the page.

    Args:
        folder: that `shapespace correspond` wrote.

    Raises:
        FileError: correspondence.json or the mean shape cannot be read.
        FileFormatError: one of them is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.at = Corresponded(folder)
        self._reading = Lock()
        self.packed_surface = lru_cache(maxsize=2 * _PAGE)(self._packed_surface)

    def about(self) -> dict[str, Any]:
        """Return what the page must know before all else; nothing large is read."""
        run = self.at.run
        page = _PAGE_BYTES // (_BYTES_A_VERTEX * max(len(self.at.mean.vertices), 1))
        return {
            "version": __version__,
            "name": self.at.root.resolve().name,
            "scans": len(self.at.records) + len(self.at.unread),
            "corresponding": len(self.at.corresponding),
            "vertices": len(self.at.mean.vertices),
            "rounds": list(run.rounds),
            "page": max(1, min(_PAGE, page)),
            "most_marked": MOST_MARKED,
            "clay": colours.CLAY,
            "unknown_colour": colours.UNKNOWN_COLOUR,
            "sequential": colours.as_list(colours.SEQUENTIAL),
            "squares": SQUARES.round(3).tolist(),
            "marks": [list(colour) for colour in colours.CATEGORIES],
        }

    def packed_mean(self) -> bytes:
        """Return the mean shape, upright, its squares, and how many scans show each vertex."""
        with self._reading:
            population = self.at.population()
        mean = self.at.mean
        along, across = checker_places(mean)
        arrays = {
            "positions": mean.vertices,
            "faces": np.asarray(mean.faces, dtype=np.uint32),
            "places": np.stack([along, across], axis=1),
            "seen": population.seen_count.astype(np.int32),
        }
        return pack(arrays, {"scans": len(population.names)})

    def listed(self) -> list[dict[str, Any]]:
        """Return all scans, those to look at first in front."""
        with self._reading:
            population = self.at.population()
        concerns = concerns_of(self.at)
        sizes = dict(zip(population.names, population.sizes.tolist(), strict=True))
        rows: list[dict[str, Any]] = [
            {"name": name, "status": "unreadable", "told": self.told(why), "weight": 0.0, "distance": None}
            for name, why in self.at.unread.items()
        ]
        for name, record in self.at.records.items():
            status = scan_status(record, concerns)
            why = record.reason or population.unread.get(name) or concerns.get(name, Concern()).told
            share = distance_share(record, "mean", sizes[name]) if name in sizes else math.nan
            rows.append(
                {
                    "name": name,
                    "status": status,
                    "told": self.told(sentence(why)),
                    "weight": concerns.get(name, Concern()).weight,
                    "distance": share if math.isfinite(share) else None,
                    "seen": record.seen_share,
                }
            )
        return sorted(rows, key=lambda row: (_ORDER.index(row["status"]), -row["weight"], row["name"]))

    def _packed_surface(self, name: str) -> bytes:
        """Return the surface of the scan `name`, moved onto the mean shape.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
            KeyError: there is no such scan in correspondence.
        """
        if self.at.records[name].status != "corresponding":
            raise KeyError(name)
        with self._reading:
            self.at.population()
        vertices = self.at.placed(name).vertices
        return pack({"positions": quantise(vertices, coded=True)}, {"name": name})

    def places(self, vertices: Sequence[int]) -> str:
        """Return a CSV of where `vertices` lie on every scan, in its own frame and unit; empty where it shows nothing.

        Raises:
            InputError: a number that is no vertex, or too many of them.
        """
        count = len(self.at.mean.vertices)
        if not 0 < len(vertices) <= MOST_MARKED or not all(0 <= vertex < count for vertex in vertices):
            raise InputError(f"Give 1 to {MOST_MARKED} numbers of vertices, each from 0 to {count - 1}.")
        rows: list[tuple[object, ...]] = []
        for record in self.at.corresponding:
            try:
                own = self.at.surface(record.name).vertices[list(vertices)]
            except ShapespaceError:
                own = np.full((len(vertices), 3), np.nan)
            for vertex, point in zip(vertices, own.tolist(), strict=True):
                rows.append((record.name, vertex, *(value if math.isfinite(value) else "" for value in point)))
        return table_text(("scan", "vertex", "x", "y", "z"), rows)

    def told(self, sentence: str) -> str:
        """Return `sentence` as visitors may read it: without the folders of this machine."""
        return without_folders(sentence)
