"""Data of the viewer's page: a model and the fits of a folder."""

from __future__ import annotations

import math
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from shapespace.errors import FileError, FileFormatError, InputError, ShapespaceError
from shapespace.model.foreign import looks_like_model
from shapespace.model.shape_model import ShapeModel
from shapespace.report.blocks.wording import without_folders
from shapespace.report.inputs.fit_population import most_concerning
from shapespace.report.inputs.saved_fits import (
    Folder,
    SavedFit,
    ScanNotFoundError,
    find_fits,
    has_fits,
    model_of,
    saved_fit,
    saved_surfaces,
    staged_fit,
)
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render.scene import pack_fit, pack_model, pack_surfaces
from shapespace.schemas import FIT_AGAIN, FitRecord, to_json
from shapespace.store.manifest import Manifest
from shapespace.store.results import results_at
from shapespace.types import Mesh

MAX_MODEL_BYTES = 48 * 2**20
"""Modes beyond this size are not sent, and the page shows a note; in the browser they take twice as much memory."""
MAX_TRIANGLES = 300_000
"""Triangles of a scan that are sent to the page."""
_BYTES_PER_VERTEX = 6  # bytes of a mode; three coordinates of 16 bits
MAX_LISTED = 1000
"""Fits of a store that the page lists: those with the most concerns."""
_STATUS_ORDER = ("unreadable", "failed", "doubtful", "max_iterations", "converged")
_DIGITS = 6  # significant digits, about those of float32


class ModelView:
    """A model and, optionally, a folder of its fits.

    Args:
        model: the shape model.
        model_name: name of the model on the page.
        folder: folder of the fits, or None.
    """

    def __init__(self, model: ShapeModel, model_name: str, folder: Path | None = None) -> None:
        self.model = model
        self.model_name = model_name
        self.folder = None if folder is None else Folder(folder)
        self._cached_fits: tuple[object, dict[str, SavedFit]] = (None, {})
        self._cached_picture = lru_cache(maxsize=4)(self._pack_fit)
        self._packed_model: bytes | None = None
        self._lock = Lock()

    @staticmethod
    def open(path: Path, model: Path | None = None) -> ModelView:
        """Open a model file, or a folder of results of `shapespace fit`.

        Args:
            path: the file or folder.
            model: file of the model, needed if the records of the folder do not name an existing model.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
            InputError: it is neither, or the model is not that of the fits.
        """
        if not path.is_dir() or looks_like_model(path):
            if model is not None:
                raise InputError(f"{path} is not a folder of fits; omit --model, or give the folder.")
            if path.exists() and not looks_like_model(path):
                raise InputError(
                    f"{path} is no model (.h5) and no folder; give a model, a folder of results, a report or a project."
                )
            return ModelView(ShapeModel.load(path), path.name)
        folder = Folder(path)
        if not has_fits(folder):
            if deeper := next(path.glob("*/**/*.fit.json"), None):
                raise InputError(f"{path} contains no fits itself; give their folder, such as {deeper.parent}.")
            if (report := path / "report.html").is_file():
                raise InputError(f"{path} is an analysis without fits; open {report} in a browser.")
        fits = listed_fits(folder)
        fitted_model = model_of(folder, fits, model)
        name = next(fit.record.model.name for fit in fits if fit.record.model.hash)
        return ModelView(fitted_model, model.name if model else name, path)

    @property
    def n_modes_sent(self) -> int:
        """Number of modes that are sent to the page."""
        return max(1, min(self.model.n_modes, MAX_MODEL_BYTES // (_BYTES_PER_VERTEX * self.model.n_vertices)))

    def packed_model(self) -> bytes:
        """Return the model for the page."""
        with self._lock:
            if self._packed_model is None:
                self._packed_model = pack_model(self.model, self.n_modes_sent)
            return self._packed_model

    def fits(self) -> dict[str, SavedFit]:
        """Return the fits of the folder by name, read again when files have changed.

        Raises:
            FileError: the folder cannot be read.
        """
        if self.folder is None:
            return {}
        try:
            files = sorted(
                (p.name, p.lstat().st_mtime_ns)
                for p in (*self.folder.root.glob("*.fit.json"), *self.folder.root.glob(Manifest.FILE))
            )
        except OSError as error:
            raise FileError(
                f"Cannot read {self.folder.root}: {error.strerror or error}; is the folder still there?"
            ) from error
        if self._cached_fits[0] != files:
            self._cached_fits = (files, {fit.name: fit for fit in listed_fits(self.folder)} if files else {})
            self._cached_picture.cache_clear()
        return self._cached_fits[1]

    def fit_list(self) -> list[dict[str, Any]]:
        """Return the rows of the page's list, sorted by status (failed first), then by expected error."""
        rows = [self._safe_row(fit) for fit in self.fits().values()]

        def sort_key(row: Mapping[str, Any]) -> tuple[int, float, str]:
            error = row["scan_to_model_mm"] if row["expected_error_mm"] is None else row["expected_error_mm"]
            rank = _STATUS_ORDER.index(row["status"]) if row["status"] in _STATUS_ORDER else 0
            return rank, -(error or 0.0), row["name"]

        return sorted(rows, key=sort_key)

    def public(self, sentence: str) -> str:
        """Return `sentence` with file names only, without the folders of this machine."""
        for folder in () if self.folder is None else (self.folder.root, self.folder.root.resolve()):
            if folder.is_absolute() and folder.name:
                sentence = sentence.replace(str(folder), folder.name)
        return without_folders(sentence)

    def packed_fit(self, name: str) -> bytes:
        """Return the surfaces and distances of the fit `name` for the page.

        Raises:
            FileError: its surfaces cannot be read.
            FileFormatError: they were not saved, or are damaged.
            InputError: the fit belongs to another model.
            KeyError: there is no such fit.
        """
        self.fits()
        return self._cached_picture(name)

    def fitted_mesh(self, name: str, *, dense: bool = False) -> Mesh:
        """Return the fitted surface of the fit `name`, or its dense one, in the frame and unit of its scan.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is absent or damaged.
            KeyError: there is no such fit.
        """
        fit = self.fits()[name]
        assert self.folder is not None
        with _as_damaged(name):
            return self.folder.mesh(fit.entry.dense if dense else fit.entry.fitted)

    def _pack_fit(self, name: str) -> bytes:
        assert self.folder is not None
        fit = self.fits()[name]
        if not self._is_of_this_model(fit):
            raise InputError(f"{name} was fitted by another model; give that one with --model.")
        parts = Parts.of(self.model)
        with _as_damaged(name):
            try:
                return pack_fit(replace(staged_fit(self.folder, fit), parts=parts), most_sent=MAX_TRIANGLES)
            except ScanNotFoundError as error:
                surfaces = saved_surfaces(self.folder, fit)
                return pack_surfaces(
                    surfaces, fit.record, name=fit.name, label=fit.label, reason=self.public(str(error)), parts=parts
                )

    def _is_of_this_model(self, fit: SavedFit) -> bool:
        return fit.record.model.hash == self.model.content_hash

    def _safe_row(self, fit: SavedFit) -> dict[str, Any]:
        """Return the row of `fit`, or the row of an unreadable fit if its record contains invalid values."""
        try:
            with _as_damaged(fit.name):
                return self._row(fit)
        except ShapespaceError as error:
            return self._row(SavedFit(fit.entry, FitRecord(status="unreadable", reason=str(error))))

    def _row(self, fit: SavedFit) -> dict[str, Any]:
        pictured, why_not = fit.pictured, ""
        if pictured and not self._is_of_this_model(fit):
            pictured, why_not = False, "It was fitted by another model."
        elif not pictured and fit.status not in ("failed", "unreadable"):
            why_not = "Its fitted surface is not in the folder; fit the scan again."
        z = fit.record.z if self._is_of_this_model(fit) else ()
        return {
            "name": fit.name,
            "label": fit.label,
            "status": fit.status,
            "reason": self.public(_reason_with_name(fit)),
            "pictured": pictured,
            "why_not": why_not,
            "z": [float(f"{value:.{_DIGITS}g}") for value in z] or None,
            "shown": to_json(fit.record.shown),
            "scan_to_model_mm": _number(fit.summary_mm("final", "scan_to_model", "mean")),
            "expected_error_mm": _number(fit.expected_error_mm),
        }


@contextmanager
def _as_damaged(name: str) -> Generator[None]:
    """Turn any error in the files of the fit `name` into one sentence: one damaged fit must not hide the others."""
    try:
        yield
    except ShapespaceError:
        raise
    except Exception as error:
        raise FileFormatError(f"The files of {name} are damaged: they contain invalid values; {FIT_AGAIN}.") from error


def listed_fits(folder: Folder) -> list[SavedFit]:
    """Return the fits in `folder` sorted by name; of a store with very many, those with the most concerns.

    Raises:
        FileError: the folder cannot be read.
        InputError: there is no fit in it.
    """
    results = results_at(folder.root)
    if results is None or len(results) <= MAX_LISTED:
        return find_fits(folder)
    return [saved_fit(folder, results, name) for name in sorted(most_concerning(results, MAX_LISTED))]


def shape_of(model: ShapeModel, z: Sequence[float]) -> Mesh:
    """Return the shape with coefficients `z` (k,) in standard deviations; missing ones are zero.

    Raises:
        InputError: more than the model has, or values that are not finite.
    """
    values = np.asarray(z, dtype=np.float64)
    is_valid = values.ndim == 1 and len(values) <= model.n_modes
    # The model itself rejects invalid coefficients.
    return model.mesh(values * model.stddev[: len(values)] if is_valid else values)


def _reason_with_name(fit: SavedFit) -> str:
    """Return the reason of `fit` with its scan's name in place of an absolute path, which may contain spaces."""
    name = fit.record.scan.name
    if not name:
        return fit.reason
    path = re.compile(rf"(?<![\w.~/\\])(?:[A-Za-z]:)?[\\/][^\n]*?[\\/]{re.escape(name)}")
    return path.sub(lambda _: name, fit.reason)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
