"""Data of the viewer's page of corresponding surfaces: single surfaces, and positions of a vertex on all surfaces."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import Distortion, faces_of, rms_size, vertex_normals
from shapespace.io.tables.table_io import table_text
from shapespace.report.blocks.wording import sentence, without_folders
from shapespace.report.inputs.correspondence_folder import (
    Concern,
    Corresponded,
    SurfacePopulation,
    concerns_of,
    distance_share,
    scan_status,
)
from shapespace.report.inputs.saved_fits import ScanNotFoundError
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render.scene import bounded_scan, decimate, pack, quantise
from shapespace.report.render.thumbnails import SQUARES, checker_places, mean_at_vertices
from shapespace.types import FloatArray

MAX_MARKED = 100
"""Vertices whose positions can be asked for at a time."""

_PAGE, _PAGE_BYTES = 11, 24 * 2**20  # surfaces on a page, and bytes that a page may send
_MOST_DRAWN = 8_000  # triangles of a surface, whose edges are then about 4 pixels of a picture on the page
_MOST_TURNING = 1_500  # while it turns and the processor draws, about 10 pixels
_MOST_PLACES, _APART = 3, 0.2  # worst places of a kind on a surface, and their least distance, share of the size
_LARGE = 4_000_000  # vertices of all surfaces together, which take about 2 s to read
_BYTES_PER_VERTEX = 10  # bytes; three coordinates of 16 bits, one number of 32
_STATUS_ORDER = ("unreadable", "excluded", "doubtful", "look", "converged")


class Surfaces:
    """A folder in correspondence for the page.

    Args:
        folder: folder that `shapespace correspond` wrote.

    Raises:
        FileError: correspondence.json or the mean shape cannot be read.
        FileFormatError: correspondence.json or the mean shape is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self._corresponded = Corresponded(folder)
        self._lock = Lock()
        self._summary_lock = Lock()
        self._packed_mean: bytes | None = None
        self.packed_surface = lru_cache(maxsize=2 * _PAGE)(self._pack_surface)
        self.packed_faults = lru_cache(maxsize=2 * _PAGE)(self._pack_faults)

    def about(self) -> dict[str, Any]:
        """Return the counts that the page needs first, without reading surfaces."""
        run = self._corresponded.run
        page = _PAGE_BYTES // (_BYTES_PER_VERTEX * max(len(self._corresponded.mean.vertices), 1))
        return {
            "name": self._corresponded.root.resolve().name,
            "scans": len(self._corresponded.records) + len(self._corresponded.unread),
            "corresponding": len(self._corresponded.corresponding),
            "vertices": len(self._corresponded.mean.vertices),
            "rounds": list(run.rounds),
            "parts": list(run.parts),
            "page": max(1, min(_PAGE, page)),
            "is_large": len(self._corresponded.corresponding) * len(self._corresponded.mean.vertices) > _LARGE,
            "most_marked": MAX_MARKED,
            "squares": SQUARES.round(3).tolist(),
        }

    def packed_mean(self) -> bytes:
        """Return the mean shape, upright, its checkerboard, the triangles drawn, and its rotation from the frame
        of the folder."""
        with self._lock:
            if self._packed_mean is None:
                self._packed_mean = self._pack_mean()
            return self._packed_mean

    def _pack_mean(self) -> bytes:
        self._corresponded.turn_upright()
        mean = self._corresponded.mean
        along, across = checker_places(mean)
        drawn, kept = decimate(mean, _MOST_DRAWN)
        turning, kept_turning = decimate(drawn, _MOST_TURNING)
        arrays: dict[str, npt.NDArray[Any]] = {
            "positions": mean.vertices,
            "faces": np.asarray(kept[faces_of(drawn)], dtype=np.uint32),
            "draft": np.asarray(kept[kept_turning][faces_of(turning)], dtype=np.uint32),
            "places": np.stack([along, across], axis=1),
        }
        if (parts := Parts.of_counts(self._corresponded.run.parts)) is not None:
            arrays["parts"] = parts.labels
        return pack(arrays, {"turn": self._corresponded.turn.tolist()})

    def packed_population(self) -> bytes:
        """Return the number of scans that show each vertex, and the RMS standard deviation of its position along the
        surface, percent of the size, if files contain it; all surfaces are read for it."""
        population = self._population()
        arrays: dict[str, Any] = {"seen": population.seen_count.astype(np.int32)}
        if population.position_std is not None:
            arrays["std"] = 100 * population.position_std
        return pack(arrays, {"scans": len(population.names), "std_limit": population.position_std_limit})

    def _population(self) -> SurfacePopulation:
        with self._lock:
            self._corresponded.turn_upright()
        with self._summary_lock:  # surfaces are sent in the meantime
            return self._corresponded.population()

    def names(self) -> list[dict[str, Any]]:
        """Return the list of scans as their records have them, without reading surfaces."""
        return [
            {"name": name, "status": scan_status(record, {name: Concern()}), "mirrored": record.mirrored,
             "reason": self.public(sentence(record.reason))}
            for name, record in self._corresponded.records.items()
        ]  # fmt: skip

    def rows(self) -> list[dict[str, Any]]:
        """Return the list of scans, those with concerns first."""
        population = self._population()
        concerns = concerns_of(self._corresponded)
        sizes = dict(zip(population.names, population.sizes.tolist(), strict=True))
        rows: list[dict[str, Any]] = [
            {
                "name": name,
                "status": "unreadable",
                "reason": self.public(reason),
                "weight": 0.0,
                "distance": None,
                "mirrored": False,
            }
            for name, reason in self._corresponded.unread.items()
        ]
        for name, record in self._corresponded.records.items():
            status = scan_status(record, concerns)
            reason = record.reason or population.unread.get(name) or concerns.get(name, Concern()).text
            share = distance_share(record, "mean", sizes[name]) if name in sizes else math.nan
            rows.append(
                {
                    "name": name,
                    "status": status,
                    "reason": self.public(sentence(reason)),
                    "weight": concerns.get(name, Concern()).weight,
                    "distance": share if math.isfinite(share) else None,
                    "seen": record.seen_share,
                    "mirrored": record.mirrored,
                }
            )
        return sorted(rows, key=lambda row: (_STATUS_ORDER.index(row["status"]), -row["weight"], row["name"]))

    def _pack_surface(self, name: str) -> bytes:
        """Return the surface of the scan `name`, moved onto the mean shape.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
            KeyError: there is no such scan in correspondence.
        """
        if self._corresponded.records[name].is_excluded:
            raise KeyError(name)
        with self._lock:
            self._corresponded.turn_upright()
        placed = self._corresponded.placed(name)
        arrays: dict[str, Any] = {"positions": quantise(placed.vertices, coded=True)}
        if placed.position_std is not None:
            arrays["std"] = 100 * placed.position_std
        return pack(arrays, {"name": name})

    def _pack_faults(self, name: str) -> bytes:
        """Return the growth (V,) of the area around each vertex, log of the ratio to the mean shape, the distances (V,)
        from the scan, share of the size, and the worst places of the surface by kind.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
            KeyError: there is no such scan in correspondence.
        """
        record = self._corresponded.records[name]
        if record.is_excluded:
            raise KeyError(name)
        with self._lock:
            self._corresponded.turn_upright()
        mean, placed = self._corresponded.mean, self._corresponded.placed(name)
        faces = faces_of(mean)
        distortion = Distortion.of(mean.with_vertices(placed.vertices), mean)
        growth = mean_at_vertices(distortion.growth, faces, len(mean.vertices))
        folds = np.bincount(faces[distortion.folded].ravel(), minlength=len(mean.vertices)).astype(np.float64)
        values = {"fold": folds, "stretch": growth}
        arrays = {"growth": growth.astype(np.float32)}
        with contextlib.suppress(ScanNotFoundError):
            scan = bounded_scan(self._corresponded.raw_scan(record))
            values["distance"] = self._corresponded.scan_on_mean(scan, placed)[1]
            arrays["distance"] = values["distance"].astype(np.float32)
        if placed.position_std is not None:
            values["uncertain"] = np.where(placed.seen, placed.position_std, np.nan)
        normals = vertex_normals(mean)
        places = [
            {"kind": kind, "vertex": vertex, "value": value, "normal": normals[vertex].round(3).tolist()}
            for kind, array in values.items()
            for vertex, value in _worst_places(mean.vertices, array)
        ]
        far = values.get("distance", np.zeros(1))
        return pack(arrays, {"places": places, "distance_limit": 100 * float(np.nanquantile(far, 0.98))})

    def positions_csv(self, vertices: Sequence[int]) -> str:
        """Return a CSV of the positions of `vertices` on every scan, in its own frame and unit; empty where missing.

        Raises:
            InputError: a number is not that of a vertex, or there are too many.
        """
        count = len(self._corresponded.mean.vertices)
        if not 0 < len(vertices) <= MAX_MARKED or not all(0 <= vertex < count for vertex in vertices):
            raise InputError(f"Give 1 to {MAX_MARKED} numbers of vertices, each from 0 to {count - 1}.")
        rows: list[tuple[object, ...]] = []
        for record in self._corresponded.corresponding:
            try:
                points = self._corresponded.surface(record.name).vertices[list(vertices)]
                points = points * FLIP if record.mirrored else points
            except ShapespaceError:
                points = np.full((len(vertices), 3), np.nan)
            for vertex, point in zip(vertices, points.tolist(), strict=True):
                rows.append((record.name, vertex, *(value if math.isfinite(value) else "" for value in point)))
        return table_text(("scan", "vertex", "x", "y", "z"), rows)

    def public(self, sentence: str) -> str:
        """Return `sentence` without the folders of this machine."""
        return without_folders(sentence)


def _worst_places(vertices: FloatArray, values: FloatArray) -> list[tuple[int, float]]:
    """Return the vertices with the largest absolute `values` (V,), which lie apart, and these values; 0 is no place."""
    left = np.nan_to_num(np.abs(values))
    apart = _APART * rms_size(vertices)
    places: list[tuple[int, float]] = []
    while len(places) < _MOST_PLACES and left.max() > 0:
        vertex = int(left.argmax())
        places.append((vertex, float(values[vertex])))
        left[np.linalg.norm(vertices - vertices[vertex], axis=1) < apart] = 0.0
    return places
