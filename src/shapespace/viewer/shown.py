"""What a viewer shows: a model, and the fits of a folder, ready to be sent to the page."""

from __future__ import annotations

import math
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
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
from shapespace.report.render.scene import pack_model, pack_surfaces
from shapespace.schemas import FIT_AGAIN, FitRecord, to_json
from shapespace.store.manifest import Manifest
from shapespace.store.results import results_at
from shapespace.types import Mesh
from shapespace.viewer.fitting import packed

MODEL_BYTES = 48 * 2**20
"""Modes beyond this size as sent are left out, and the page says so; in the browser they take twice as much."""
MOST_LISTED = 1000
"""Fits of a store that the page lists: those that need a look most."""
_ORDER = ("unreadable", "failed", "doubtful", "max_iterations", "converged")
_DIGITS = 6


class Shown:
    """A model, and perhaps a folder of fits by it.

    Args:
        model: the shape space.
        model_name: what the page calls it.
        folder: of the fits; None without.
    """

    def __init__(self, model: ShapeModel, model_name: str, folder: Path | None = None) -> None:
        self.model = model
        self.model_name = model_name
        self.folder = None if folder is None else Folder(folder)
        self._read: tuple[object, dict[str, SavedFit]] = (None, {})
        self._picture = lru_cache(maxsize=4)(self._packed_fit)

    @staticmethod
    def open(path: Path, model: Path | None = None) -> Shown:
        """Return what `path` holds: a model file, or a folder of results of `shapespace fit`.

        Args:
            path: the file or folder.
            model: the model's file, where the records of the folder do not lead to it.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
            InputError: it is neither, or the model is not that of the fits.
        """
        if not path.is_dir() or looks_like_model(path):
            if model is not None:
                raise InputError(f"{path} is not a folder of fits; leave --model out, or give the folder.")
            if path.exists() and not looks_like_model(path):
                raise InputError(
                    f"{path} is no model (.h5) and no folder; give the model, or the folder that shapespace fit wrote."
                )
            return Shown(ShapeModel.load(path), path.name)
        if not has_fits(Folder(path)) and (deeper := next(path.glob("*/**/*.fit.json"), None)):
            raise InputError(f"{path} holds no fits itself; give the folder that does, such as {deeper.parent}.")
        folder = Folder(path)
        fits = listed_fits(folder)
        found = model_of(folder, fits, model)
        name = next(fit.record.model.name for fit in fits if fit.record.model.hash)
        return Shown(found, model.name if model else name, path)

    def packed_model(self) -> tuple[bytes, int]:
        """Return the model for the page, and how many of its modes that holds."""
        modes = max(1, min(self.model.n_modes, MODEL_BYTES // (6 * self.model.n_vertices)))
        return pack_model(self.model, modes), modes

    def fits(self) -> dict[str, SavedFit]:
        """Return the fits of the folder by name, read again when files have changed.

        Raises:
            FileError: the folder cannot be read.
        """
        if self.folder is None:
            return {}
        try:
            now = sorted(
                (p.name, p.lstat().st_mtime_ns)
                for p in (*self.folder.root.glob("*.fit.json"), *self.folder.root.glob(Manifest.FILE))
            )
        except OSError as error:
            raise FileError(
                f"Cannot read {self.folder.root}: {error.strerror or error}; is the folder still there?"
            ) from error
        if self._read[0] != now:
            self._read = (now, {fit.name: fit for fit in listed_fits(self.folder)} if now else {})
            self._picture.cache_clear()
        return self._read[1]

    def fit_list(self) -> list[dict[str, Any]]:
        """Return what the page lists: failed and doubtful fits first, then by the error they expect of themselves."""
        rows = [self._safe_row(fit) for fit in self.fits().values()]

        def concern(row: Mapping[str, Any]) -> tuple[int, float, str]:
            error = row["scan_to_model_mm"] if row["expected_error_mm"] is None else row["expected_error_mm"]
            return _rank(row["status"]), -(error or 0.0), row["name"]

        return sorted(rows, key=concern)

    def told(self, sentence: str) -> str:
        """Return `sentence` as visitors may read it: with the names of files, not of the folders they lie in."""
        for folder in () if self.folder is None else (self.folder.root, self.folder.root.resolve()):
            if folder.is_absolute() and folder.name:
                sentence = sentence.replace(str(folder), folder.name)
        return without_folders(sentence)

    def packed_fit(self, name: str) -> bytes:
        """Return the pictures of the fit `name`.

        Raises:
            FileError: its surfaces cannot be read.
            FileFormatError: they were not saved, or are damaged.
            InputError: they do not belong to the model.
            KeyError: there is no such fit.
        """
        self.fits()
        return self._picture(name)

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

    def _packed_fit(self, name: str) -> bytes:
        assert self.folder is not None
        fit = self.fits()[name]
        if not self._ours(fit):
            raise InputError(f"{name} was fitted by another model; give that one with --model.")
        with _as_damaged(name):
            try:
                return packed(staged_fit(self.folder, fit))
            except ScanNotFoundError as error:
                surfaces = saved_surfaces(self.folder, fit)
                return pack_surfaces(surfaces, fit.record, name=fit.name, label=fit.label, reason=self.told(str(error)))

    def _ours(self, fit: SavedFit) -> bool:
        return fit.record.model.hash == self.model.content_hash

    def _safe_row(self, fit: SavedFit) -> dict[str, Any]:
        """Return the row of `fit`; where its record holds what no fit writes, that of an unreadable one."""
        try:
            with _as_damaged(fit.name):
                return self._row(fit)
        except ShapespaceError as error:
            return self._row(SavedFit(fit.entry, FitRecord(status="unreadable", reason=str(error))))

    def _row(self, fit: SavedFit) -> dict[str, Any]:
        pictured, why = fit.pictured, ""
        if pictured and not self._ours(fit):
            pictured, why = False, "It was fitted by another model."
        elif not pictured and fit.status not in ("failed", "unreadable"):
            why = "Its fitted surface is not in the folder; fit the scan again."
        row: dict[str, Any] = {
            "name": fit.name,
            "label": fit.label,
            "status": fit.status,
            "reason": self.told(_by_name(fit)),
            "pictured": pictured,
            "why_not": why,
            "fitted": fit.entry.fitted is not None and fit.fitted,
            "z": None,
        }
        row |= {
            "shown": to_json(fit.record.shown),
            "shown_scan_mm": to_json(fit.record.shown_scan_mm),
            "model_to_scan_mm": _number(fit.summary_mm("final", "model_to_scan", "mean")),
            "scan_to_model_mm": _number(fit.summary_mm("final", "scan_to_model", "mean")),
            "expected_error_mm": _number(fit.expected_error_mm),
        }
        if self._ours(fit) and fit.record.z:
            row["z"] = _rounded(fit.record.z)
        return row


@contextmanager
def _as_damaged(name: str) -> Generator[None]:
    """Let whatever goes wrong with the files of the fit `name` be one sentence: one of many must not stop the rest."""
    try:
        yield
    except ShapespaceError:
        raise
    except Exception as error:
        raise FileFormatError(f"The files of {name} are damaged: they hold what no fit writes; {FIT_AGAIN}.") from error


def listed_fits(folder: Folder) -> list[SavedFit]:
    """Return the fits in `folder`, in the order of their names; of a store with very many those to look at first.

    Raises:
        FileError: the folder cannot be read.
        InputError: there is no fit in it.
    """
    results = results_at(folder.root)
    if results is None or len(results) <= MOST_LISTED:
        return find_fits(folder)
    return [saved_fit(folder, results, name) for name in sorted(most_concerning(results, MOST_LISTED))]


def shape_of(model: ShapeModel, z: Sequence[float]) -> Mesh:
    """Return the shape with coefficients `z` (k,) in standard deviations; missing ones are zero.

    Raises:
        InputError: more than the model has, or values that are not finite.
    """
    given = np.asarray(z, dtype=np.float64)
    return model.mesh(given * model.stddev[: len(given)] if given.ndim == 1 and len(given) <= model.n_modes else given)


def _by_name(fit: SavedFit) -> str:
    """Return the reason of `fit` with its scan's name in place of an absolute path, which may hold spaces."""
    name = fit.record.scan.name
    if not name:
        return fit.reason
    path = re.compile(rf"(?<![\w.~/\\])(?:[A-Za-z]:)?[\\/][^\n]*?[\\/]{re.escape(name)}")
    return path.sub(lambda _: name, fit.reason)


def _rank(status: str) -> int:
    return _ORDER.index(status) if status in _ORDER else 0


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]
