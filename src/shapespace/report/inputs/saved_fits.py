"""Reader of saved fits and the demo for reports: JSON, arrays, meshes and models, checked, inside one folder."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from msgspec import structs

from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.fit.diagnostics.reasons import text_of
from shapespace.fit.fit_scan import FitConfig
from shapespace.geometry.doctor import repair
from shapespace.io.files import read_bytes, sha256_of_file
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.tables.table_io import table_rows
from shapespace.model.shape_model import ShapeModel
from shapespace.report.blocks.wording import counted, known, printable
from shapespace.report.inputs.staged_fit import StagedFit
from shapespace.schemas import FitEntry, FitRecord
from shapespace.store.results import ENDING, ENDINGS, Results, arrays_at, json_at, mesh_at, results_at
from shapespace.types import FloatArray, Mesh

_AGAIN = "make it again with shapespace fit --stages"
_FEWEST_POINTS = 20  # fewer are not a scan

Direction: TypeAlias = Literal["model_to_scan", "scan_to_model"]
Measure: TypeAlias = Literal["mean", "median", "rms", "p95", "max", "fraction"]


class ScanNotFoundError(FileFormatError):
    """The scan of a fit was moved or changed; the message begins with a lower-case letter."""


@dataclass(frozen=True)
class Folder:
    """A folder of results; names in its files are relative to it and stay inside it.

    Args:
        root: the folder.
        again: what a reader can do about a file that is wrong.
    """

    root: Path
    again: str = _AGAIN

    def path(self, name: object) -> Path:
        """Return the file called `name`, as the folder was named by the user.

        Raises:
            FileFormatError: it is no name, or it leads out of the folder.
        """
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"A result file has no name where one is needed; {self.again}.")
        try:
            path = self.root / name
            inside = path.resolve().is_relative_to(self.root.resolve())
        except (OSError, ValueError, RuntimeError) as error:
            raise FileFormatError(f"{name[:80]!r} in a result file is not a file name; {self.again}.") from error
        if not inside:
            raise FileFormatError(
                f"{name[:80]!r} in a result file leads out of the folder of the results; {self.again}."
            )
        return path

    def json(self, name: object) -> dict[str, Any]:
        """Return the object in a JSON file, without unprintable characters in its strings.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is not a JSON object, or too large to be one of ours.
        """
        path = self.path(name)
        with self._named_shortly():
            content: object = json_at(path, self.again)
            if not isinstance(content, dict):
                raise FileFormatError(f"{path} does not hold a JSON object; {self.again}.")
        return cast(dict[str, Any], _printable(cast(object, content)))

    def arrays(self, name: object) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of an .npz file by name; no pickles, nothing larger than it says.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or declares arrays that it does not hold.
        """
        with self._named_shortly():
            return arrays_at(self.path(name), self.again)

    def mesh(self, name: object) -> Mesh:
        """Return the mesh in a file.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged.
        """
        with self._named_shortly():
            return mesh_at(self.path(name))

    @contextmanager
    def _named_shortly(self) -> Generator[None]:
        # A report is mailed and a viewer has visitors: neither is to tell where the folder lies on this machine.
        try:
            yield
        except ShapespaceError as error:
            message = str(error)
            for root in dict.fromkeys((str(self.root.resolve()), str(self.root))):
                message = message.replace(f"{root}{os.sep}", "")
            raise type(error)(message) from error


@dataclass(frozen=True, eq=False)
class SavedFit:
    """One fit: its record, and metadata from demo.json or from the files of a folder."""

    entry: FitEntry
    record: FitRecord

    @property
    def name(self) -> str:
        """Name of the fit."""
        return self.entry.name

    @property
    def label(self) -> str:
        """Expression and intensity in words."""
        expression, intensity = self.entry.expression or self.name, self.entry.intensity
        return f"{expression} {100 * intensity:.0f} %" if intensity else expression

    @property
    def status(self) -> str:
        """`converged`, `max_iterations`, `doubtful` or `failed`; `unreadable` where the record is."""
        return self.record.status

    @property
    def reason(self) -> str:
        """Why it has that status."""
        return self.record.reason

    @property
    def reason_texts(self) -> tuple[str, ...]:
        """Texts of the reasons, the most serious first; empty where their codes are absent or of another version."""
        try:
            return tuple(text_of(reason.code, reason.data) for reason in self.record.reasons)
        except (KeyError, TypeError, ValueError, OverflowError):
            return ()

    @property
    def fitted(self) -> bool:
        """Whether there is a result, doubtful or not."""
        return self.record.is_fitted

    @property
    def pictured(self) -> bool:
        """Whether there are surfaces to draw."""
        return bool(self.entry.stages or self.entry.fitted) and self.fitted

    def summary_mm(self, stage: str, direction: Direction, measure: Measure) -> float:
        """Return a distance over the whole model, or the whole scan, in mm; NaN if there is none."""
        summary = self.record.distances_mm.get(stage)
        return known(getattr(getattr(summary, direction), measure)) if summary else math.nan

    def distance_mm(self, direction: Direction, measure: Measure = "mean") -> float:
        """Return a distance of the final stage over the overlap, in mm; NaN if there is none."""
        overlap = self.record.shown
        return known(getattr(getattr(overlap, direction), measure)) if overlap else math.nan

    @property
    def expected_error_mm(self) -> float:
        """Expected vertex error of the fit, mm; NaN if unknown."""
        value = self.record.evidence.get("expected_error_mm")
        return float(value) if isinstance(value, int | float) else math.nan

    def with_entry(self, **values: Any) -> SavedFit:
        """Return the fit with more known beside its record, by the names of `FitEntry`."""
        return SavedFit(structs.replace(self.entry, **values), self.record)

    def numbers(self, key: Literal["b", "z"]) -> FloatArray:
        """Return coefficients of the record, (K,).

        Raises:
            FileFormatError: there are none, or not as many as coefficients.
        """
        values = np.array(getattr(self.record, key), dtype=np.float64)
        if not len(values) or len(values) != len(self.record.b):
            raise FileFormatError(f"The record of {self.name} holds no list of numbers {key!r}; {_AGAIN}.")
        return values


def read_fit(folder: Folder, entry: FitEntry) -> SavedFit:
    """Read the record of one fit.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged.
    """
    return SavedFit(entry, FitRecord.from_json(folder.json(entry.json), str(entry.json), _AGAIN))


def has_fits(folder: Folder) -> bool:
    """Return whether the record of a fit lies directly in `folder`.

    Raises:
        FileError: the folder cannot be read.
    """
    return bool(len(_results(folder)))


def find_fits(folder: Folder) -> list[SavedFit]:
    """Return the fits whose records lie directly in `folder`, in the order of their names.

    One that cannot be read has the status `unreadable` and says why.

    Raises:
        FileError: the folder cannot be read.
        InputError: there is no fit in it.
    """
    results = _results(folder)
    if not results:
        raise InputError(f"{folder.root} holds no fits (NAME{ENDING}); give a folder that shapespace fit wrote.")
    return [saved_fit(folder, results, name) for name in results.names()]


def _results(folder: Folder) -> Results:
    return results_at(folder.root) or Results(folder.root)


def saved_fit(folder: Folder, results: Results, name: str) -> SavedFit:
    """Return one fit of `results`, which belong to `folder`; `unreadable` if it cannot be read."""
    fitted, dense, stages = (
        f"{name}{ENDINGS[kind]}" if results.has(name, kind) else None for kind in ("fitted", "dense", "stages")
    )
    entry = FitEntry(name=printable(name), json=f"{name}{ENDING}", fitted=fitted, dense=dense, stages=stages)
    try:
        return read_fit(folder, entry)
    except ShapespaceError as error:
        return SavedFit(entry, FitRecord(status="unreadable", reason=str(error)))


def staged_fit(folder: Folder, fit: SavedFit) -> StagedFit:
    """Return the data for pictures of `fit`: its saved stages, or else its saved surfaces and its scan.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: the stages are damaged; without stages, a surface is.
        ScanNotFoundError: there are no stages, and the scan has changed or is missing.
    """
    if fit.entry.stages:
        return StagedFit.from_arrays(folder.arrays(fit.entry.stages), fit.record, name=fit.name, label=fit.label)
    return StagedFit.from_surfaces(
        saved_surfaces(folder, fit),
        _in_picture_frame(repair(raw_scan(folder, fit))[0], fit),
        fit.record,
        name=fit.name,
        label=fit.label,
    )


def saved_surfaces(folder: Folder, fit: SavedFit) -> dict[str, Mesh]:
    """Return the fitted surface of `fit` as `final`, and its dense one as `dense`, in the picture frame.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: one is damaged, or the record has no pose.
    """
    surfaces = {
        stage: folder.mesh(file)
        for stage, file in {"final": fit.entry.fitted, "dense": fit.entry.dense}.items()
        if file or stage == "final"
    }
    if len({len(mesh.vertices) for mesh in surfaces.values()}) > 1:
        raise FileFormatError(f"{fit.name}: its fitted and its dense surface differ in their vertices; {_AGAIN}.")
    return {stage: _in_picture_frame(mesh, fit) for stage, mesh in surfaces.items()}


def _in_picture_frame(mesh: Mesh, fit: SavedFit) -> Mesh:
    """Return `mesh`, which is in the frame and unit of the scan of `fit`, in the picture frame."""
    T, mm = fit.record.T_scan_model, fit.record.mm_per_scan_unit
    if T is None or not T.scale > 0 or mm is None or not mm > 0:
        raise FileFormatError(f"The record of {fit.name} has no pose T_scan_model or no mm_per_scan_unit; {_AGAIN}.")
    with np.errstate(all="ignore"):  # what overflows is refused
        vertices = mm * ((mesh.vertices - np.array(T.translation)) @ np.array(T.rotation))
    if not (len(vertices) and np.isfinite(vertices).all()):
        raise FileFormatError(f"{fit.name}: its surface, its scan or its pose has no finite coordinates; {_AGAIN}.")
    return mesh.with_vertices(vertices)


def raw_scan(folder: Folder, fit: SavedFit) -> Mesh:
    """Return the scan of `fit` from its file, if the file was neither moved nor changed.

    Raises:
        FileError: it cannot be read.
        ScanNotFoundError: it is not, or is no scan.
    """
    source = fit.record.scan
    if not source.path or "\0" in source.path:
        raise ScanNotFoundError("the record does not say where the scan is.")
    file = folder.root / source.path
    if not file.is_file() or sha256_of_file(file) != source.hash:
        raise ScanNotFoundError("the scan is no longer where it was, or has changed.")
    try:
        mesh = read_mesh(file)
    except ShapespaceError as error:
        raise ScanNotFoundError("the scan cannot be read.") from error
    if len(mesh.vertices) < _FEWEST_POINTS:
        raise ScanNotFoundError(f"the scan has {counted(len(mesh.vertices), 'point')}.")
    return mesh


def model_of(folder: Folder, fits: Sequence[SavedFit], model_path: Path | None = None) -> ShapeModel:
    """Return the model that `fits` were made with.

    Args:
        folder: where the fits lie.
        fits: one or more; those without a readable record do not count.
        model_path: the model's file; None goes by the path in the records.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged.
        InputError: it is not where the records say, or not the one they name.
    """
    sources = [fit.record.model for fit in fits if fit.record.model.hash]
    hashes = {source.hash for source in sources}
    if not sources:
        raise InputError(f"{folder.root}: no record names a model; give it with --model.")
    if len(hashes) > 1 and model_path is None:
        raise InputError(f"{folder.root}: its fits are by {len(hashes)} different models; give one with --model.")
    path = model_path or folder.root / (sources[0].path or sources[0].name)
    if model_path is None and not path.exists():
        raise InputError(f"{folder.root}: the model {path.name} is no longer at {path}; give it with --model.")
    model = ShapeModel.load(path)
    if model.content_hash not in hashes:
        raise InputError(f"{path} is not the model of the fits in {folder.root}; give the right one with --model.")
    return model


def _printable(value: object) -> object:
    """Return JSON content whose strings have control characters and lone surrogates replaced."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, list):
        return [_printable(item) for item in cast(list[object], value)]
    if isinstance(value, dict):
        return {printable(str(key)): _printable(item) for key, item in cast(dict[object, object], value).items()}
    return value


_MOST_SCANS = 50  # paths in a command; more do not belong in a line
_OPTIONS = {
    "method": "--method", "unit": "--unit", "scale": "--scale", "dense": "--dense", "crop": "--crop",
    "region": "--region", "strict": "--strict",
}  # fmt: skip
"""Setting in a record -> its option."""
_SETTINGS = ("max_iterations", "seed", "landmark_stddev_mm")
"""Those that are given by --set."""


def command_with_stages(root: Path, records: Mapping[str, FitRecord]) -> str:
    """Return the command, to be run in the folder `root`, that fits the scans of `records` again and saves the stages.

    The scans are those of the folder's list, which has landmarks and metadata too, if it contains these and no others;
    otherwise, and for a scan without both, they are named one by one.

    Args:
        root: folder of the results.
        records: NAME -> record of each fit.
    """
    first = next(iter(records.values()))
    scans = [record.scan.path or "SCAN" for record in records.values()]
    if not (len(records) == 1 and first.landmarks is None and not first.metadata) and _listed(
        root / FitRecord.LIST
    ) == set(records):
        scans = [FitRecord.LIST]
    elif len(scans) > _MOST_SCANS:
        scans = ["SCANS"]
    usual, options = FitConfig().as_dict(), list[str]()
    for name in (*_OPTIONS, *_SETTINGS):
        value = first.config.get(name)
        if value in (None, usual.get(name), False) or not isinstance(value, str | int | float):
            continue
        given = ["--set", f"{name}={value}"] if name in _SETTINGS else [_OPTIONS[name], str(value)]
        options += given[:1] if value is True else given
    return shlex.join(["shapespace", "fit", first.model.path or "MODEL.h5", *scans, "-o", ".", "--stages", *options])


def _listed(file: Path) -> set[str]:
    """Return the names of the results in a list of scans; none if there is no such list."""
    try:
        rows = table_rows(read_bytes(file))
        column = next(rows).index("id")
        return {row[column] for row in rows}
    except (ShapespaceError, ValueError):
        return set()
