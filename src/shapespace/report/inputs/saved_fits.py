"""Reader of saved fits and the demo for reports: JSON, arrays, meshes and models, checked, inside one folder.

`StagedFit` is a fit in the frame of the pictures: scan and model in mm, iteration by iteration, with signed distances.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from msgspec import structs

from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.fit.diagnostics.reasons import text_of
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import REGIONS, SHOWN
from shapespace.fit.result import STAGES, STAGES_VERSION, FitResult, stage_arrays
from shapespace.geometry.closest import build_engine, on_boundary, surface_distances
from shapespace.geometry.doctor import repair
from shapespace.geometry.normals import boundary_vertices
from shapespace.io.files import read_bytes, sha256_of_file
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.tables.table_io import table_rows
from shapespace.model.shape_model import ShapeModel
from shapespace.report.blocks.wording import counted, known, printable
from shapespace.report.inputs.subject_parts import Parts
from shapespace.schemas import FitEntry, FitRecord
from shapespace.store.results import ENDING, ENDINGS, Results, arrays_at, json_at, mesh_at, results_at
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

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
        again: remedy for a damaged file, for messages.
    """

    root: Path
    again: str = _AGAIN

    def path(self, name: object) -> Path:
        """Return the path of the file `name` in this folder, which is not resolved.

        Raises:
            FileFormatError: it is no name, or it leads out of the folder.
        """
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"A result file lacks the name of a file; {self.again}.")
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
                raise FileFormatError(f"{path} does not contain a JSON object; {self.again}.")
        return cast(dict[str, Any], _printable(cast(object, content)))

    def arrays(self, name: object) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of an .npz file by name; pickles and arrays that do not match their header are rejected.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or contains other things than arrays.
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
        # A report is mailed and a viewer has visitors: neither may reveal the folders of this machine.
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
        """`converged`, `max_iterations`, `doubtful` or `failed`; `unreadable` if the record is."""
        return self.record.status

    @property
    def reason(self) -> str:
        """Reason for the status."""
        return self.record.reason

    @property
    def reason_texts(self) -> tuple[str, ...]:
        """Texts of the reasons, the most serious first; empty if their codes are absent or of another version."""
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
        """Return a distance over the entire model, or the entire scan, in mm; NaN if there is none."""
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
        """Return the fit with further metadata, by the names of `FitEntry`."""
        return SavedFit(structs.replace(self.entry, **values), self.record)

    def numbers(self, key: Literal["b", "z"]) -> FloatArray:
        """Return coefficients of the record, (K,).

        Raises:
            FileFormatError: there are none, or another number of them than of `b`.
        """
        values = np.array(getattr(self.record, key), dtype=np.float64)
        if not len(values) or len(values) != len(self.record.b):
            raise FileFormatError(f"The record of {self.name} contains no list of numbers {key!r}; {_AGAIN}.")
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

    A fit that cannot be read has the status `unreadable` and the reason.

    Raises:
        FileError: the folder cannot be read.
        InputError: there is no fit in it.
    """
    results = _results(folder)
    if not results:
        raise InputError(f"{folder.root} contains no fits (NAME{ENDING}); give a folder that shapespace fit wrote.")
    return [saved_fit(folder, results, name) for name in results.names()]


def _results(folder: Folder) -> Results:
    return results_at(folder.root) or Results(folder.root)


def saved_fit(folder: Folder, results: Results, name: str) -> SavedFit:
    """Return the fit `name` of `results`, which belong to `folder`; its status is `unreadable` if it cannot be read."""
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
    with np.errstate(all="ignore"):  # overflow is rejected below
        vertices = mm * ((mesh.vertices - np.array(T.translation)) @ np.array(T.rotation))
    if not (len(vertices) and np.isfinite(vertices).all()):
        raise FileFormatError(f"{fit.name}: its surface or scan is empty, or it or the pose is not finite; {_AGAIN}.")
    return mesh.with_vertices(vertices)


def raw_scan(folder: Folder, fit: SavedFit) -> Mesh:
    """Return the scan of `fit` from its file, if the file was neither moved nor changed.

    Raises:
        FileError: it cannot be read.
        ScanNotFoundError: the file was moved or changed, or is no scan.
    """
    mesh = unchanged_scan(folder.root, fit.record.scan.path, fit.record.scan.hash)
    if len(mesh.vertices) < _FEWEST_POINTS:
        raise ScanNotFoundError(f"the scan has {counted(len(mesh.vertices), 'point')}.")
    return mesh


def unchanged_scan(root: Path, path: str, sha256: str) -> Mesh:
    """Return a scan from its file, if the file is still at `path`, relative to `root`, with the same content.

    Raises:
        ScanNotFoundError: the file was moved or changed, or cannot be read.
    """
    if not path or "\0" in path:
        raise ScanNotFoundError("the record does not contain the path of the scan.")
    if not (root / path).is_file() or sha256_of_file(root / path) != sha256:
        raise ScanNotFoundError("the scan is no longer where it was, or has changed.")
    try:
        return read_mesh(root / path)
    except ShapespaceError as error:
        raise ScanNotFoundError("the scan cannot be read.") from error


def model_of(folder: Folder, fits: Sequence[SavedFit], model_path: Path | None = None) -> ShapeModel:
    """Return the model that `fits` were made with.

    Args:
        folder: folder of the fits.
        fits: one or more; those without a readable record do not count.
        model_path: file of the model; None for the path in the records.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged.
        InputError: the model is not at the path in the records, or is not the model that they name.
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
"""Settings that are passed with --set."""


def command_with_stages(root: Path, records: Mapping[str, FitRecord]) -> str:
    """Return the command, to be run in the folder `root`, that fits the scans of `records` again and saves the stages.

    The command names the list of scans in the folder, which has landmarks and metadata too, if it lists exactly these
    scans. Otherwise, and for a single scan without landmarks and metadata, it names the scans.

    Args:
        root: folder of the results.
        records: NAME -> record of each fit.
    """
    first = next(iter(records.values()))
    scans = [record.scan.path or "SCAN" for record in records.values()]
    if not (len(records) == 1 and first.landmarks is None and not first.metadata) and _listed_names(
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


def _listed_names(file: Path) -> set[str]:
    """Return the names of the results in a list of scans; none if there is no such list."""
    try:
        rows = table_rows(read_bytes(file))
        column = next(rows).index("id")
        return {row[column] for row in rows}
    except (ShapespaceError, ValueError):
        return set()


@dataclass(frozen=True, eq=False)
class Moment:
    """One iteration of a fit.

    Args:
        phase: 1 or 2.
        iteration: number of the iteration in its phase, from 0.
        rms_mm: RMS closest distance, mm of the scan.
        b: (K,) coefficients in this iteration, mm of the model's frame.
        T_final_now: transformation from the model's frame in this iteration to the picture frame, see `stage_arrays`.
    """

    phase: int
    iteration: int
    rms_mm: float
    b: FloatArray
    T_final_now: Similarity

    def vertices(self, model: ShapeModel) -> FloatArray:
        """Return the model's surface in this iteration, (V, 3), in the picture frame."""
        return self.T_final_now.apply(model.reconstruct(self.b))


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of one scan.

    Args:
        name: name of the scan.
        expression: label of the scan, which selects its colour; empty for none.
        intensity: 0 for neutral to 1, which selects the size of its mark.
        b: (K,) mm.
        z: (K,) in standard deviations of the model.
    """

    name: str
    expression: str
    intensity: float
    b: FloatArray
    z: FloatArray


@dataclass(frozen=True, eq=False)
class StagedFit:
    """A fit in the picture frame: the axes of the model's frame, and the size of the scan in mm.

    Args:
        name: name of the fit.
        label: label in pictures.
        status: `converged`, `max_iterations` or `doubtful`.
        reason: one sentence on the reason for the status.
        scan: the raw surface or points, as repaired.
        surfaces: the model at each stage: `final`; `before` and `initial` if the stages were saved; `dense` if
            there is a dense stage.
        model_to_scan_mm: (V,) signed closest distances by stage: positive where the scan lies outside of the model;
            NaN at vertices that the scan does not show, as in `OverlapDistances`.
        scan_to_model_mm: (S,) signed closest distances of scan points by stage; NaN beyond the model's rim.
        regions: (V,) codes of `fit.iteration_state.REGIONS`; None if the stages were not saved.
        b: (K,) mm.
        z: (K,) in standard deviations of the model.
        b_stddev: (K,) mm.
        shrinkage: (K,) in [0, 1].
        history: the iterations, in order; empty if the stages were not saved.
        parts: parts of the model; None if it has one structure, or is not known.
    """

    name: str
    label: str
    status: str
    reason: str
    scan: Mesh
    surfaces: Mapping[str, Mesh]
    model_to_scan_mm: Mapping[str, FloatArray]
    scan_to_model_mm: Mapping[str, FloatArray]
    regions: IntArray | None
    b: FloatArray
    z: FloatArray
    b_stddev: FloatArray
    shrinkage: FloatArray
    history: tuple[Moment, ...]
    parts: Parts | None = None

    @cached_property
    def scale_mm(self) -> float:
        """End of the colour scale of signed distances in all pictures of this fit, mm."""
        return scale_end(np.concatenate([self.model_to_scan_mm["final"], self.scan_to_model_mm["final"]]))

    @property
    def region_shares(self) -> dict[str, float]:
        """Share of the vertices in each of `REGIONS`; empty if the stages were not saved."""
        if self.regions is None:
            return {}
        shares = np.bincount(self.regions, minlength=len(REGIONS)) / max(len(self.regions), 1)
        return dict(zip(REGIONS, shares.tolist(), strict=True))

    @staticmethod
    def of(model: ShapeModel, result: FitResult, label: str = "") -> StagedFit:
        """Return the staged fit of `result`, which was fitted by `model`."""
        staged = StagedFit.from_arrays(
            stage_arrays(result, model), result, name=result.scan_name, label=label or result.scan_name
        )
        return replace(staged, parts=Parts.of(model))

    @staticmethod
    def from_surfaces(
        surfaces: Mapping[str, Mesh], scan: Mesh, record: FitRecord, *, name: str, label: str
    ) -> StagedFit:
        """Return a fit from its saved surfaces and its scan, and measure its distances.

        A vertex counts as not shown by the scan if its closest point lies on the border of the scan; nowhere if the
        record states that the scan shows the complete model.

        Args:
            surfaces: `final`, and `dense` if there is one, in the picture frame.
            scan: scan as repaired, in the picture frame.
            record: record of the fit.
            name: name of the fit.
            label: label in pictures.

        Raises:
            FileFormatError: the numbers of the record do not fit together.
        """
        known = _numbers_of(record)
        if len({values.shape for values in known.values()}) > 1:
            raise FileFormatError(f"{name}: the coefficients of its record do not fit together; fit the scan again.")
        engine = build_engine(scan)
        is_complete = record.shown is not None and record.shown.model_seen_share == 1.0
        forward: dict[str, FloatArray] = {}
        backward: dict[str, FloatArray] = {}
        for stage, surface in surfaces.items():
            distances = surface_distances(surface, scan, scan_engine=engine)
            unseen = np.zeros(len(surface.vertices), dtype=bool)
            if scan.faces is not None and surface.faces is not None and not is_complete:
                unseen = on_boundary(engine.query(surface.vertices), scan, boundary_vertices(scan))
            forward[stage] = np.where(unseen, np.nan, distances.model_to_scan_signed_mm)
            backward[stage] = distances.scan_to_model_signed_mm
        return StagedFit(
            name=name,
            label=label,
            status=record.status,
            reason=record.reason,
            scan=scan,
            surfaces=surfaces,
            model_to_scan_mm=forward,
            scan_to_model_mm=backward,
            regions=None,
            **known,
            history=(),
            parts=None,
        )

    @staticmethod
    @np.errstate(all="ignore")  # overflow and division by zero are rejected at the end
    def from_arrays(
        arrays: Mapping[str, npt.NDArray[Any]], record: FitResult | FitRecord, *, name: str, label: str
    ) -> StagedFit:
        """Return a fit from the arrays of NAME.stages.npz.

        Args:
            arrays: arrays of the file.
            record: result or record of the fit, with its status, reason and coefficients.
            name: name of the fit.
            label: label in pictures.

        Raises:
            FileFormatError: arrays are absent, of an earlier version, or do not fit together.
        """
        remedy = "fit the scan again with --stages"
        known = _numbers_of(record)
        if not np.array_equal(arrays.get("format_version", 0), STAGES_VERSION):
            raise FileFormatError(f"{name}: its stages were saved by another version of shapespace; {remedy}.")
        try:
            faces = arrays.get("faces")
            scan = Mesh(
                arrays["scan"].astype(np.float64), arrays.get("scan_faces"), name=name,
                colours=arrays.get("scan_colours"),
            )  # fmt: skip
            surfaces: dict[str, Mesh] = {}
            forward: dict[str, FloatArray] = {}
            backward: dict[str, FloatArray] = {}
            for stage in (*STAGES, *(("dense",) if "dense" in arrays else ())):
                surfaces[stage] = Mesh(
                    arrays[stage].astype(np.float64), faces, name=name, colours=arrays.get(f"colours_{stage}")
                )
                forward[stage] = arrays[f"model_to_scan_{stage}"].astype(np.float64)
                backward[stage] = arrays[f"scan_to_model_{stage}"].astype(np.float64)
            regions = np.clip(arrays["regions"], 0, len(REGIONS)).astype(np.int32)
            history = tuple(
                Moment(int(phase), int(iteration), float(rms), np.asarray(b_now, dtype=np.float64), _similarity(T))
                for phase, iteration, rms, b_now, T in zip(
                    *(arrays[f"history_{key}"] for key in ("phase", "iteration", "rms_mm", "b", "T")), strict=True
                )
            )
        except (KeyError, ValueError, TypeError, IndexError, OverflowError, ShapespaceError) as error:
            raise FileFormatError(f"{name}: its saved stages are damaged ({error}); {remedy}.") from error
        V, S = len(surfaces["final"].vertices), len(scan.vertices)
        checks = (
            all(np.isfinite(mesh.vertices).all() for mesh in (scan, *surfaces.values())),
            all(len(surface.vertices) == V for surface in surfaces.values()),
            all(d.shape == (V,) and np.isfinite(d).all() for d in forward.values()),
            all(d.shape == (S,) and not np.isinf(d).any() for d in backward.values()),
            regions.shape == (V,) and int(regions.max(initial=0)) < len(REGIONS),
            len({values.shape for values in (*known.values(), *(moment.b for moment in history))}) == 1,
            all(np.isfinite(moment.b).all() for moment in history),
        )
        if not all(checks):
            raise FileFormatError(f"{name}: its saved stages do not fit together; {remedy}.")
        return StagedFit(
            name=name,
            label=label,
            status=record.status,
            reason=record.reason,
            scan=scan,
            surfaces=surfaces,
            model_to_scan_mm={stage: np.where(np.isin(regions, SHOWN), d, np.nan) for stage, d in forward.items()},
            scan_to_model_mm=backward,
            regions=regions,
            **known,
            history=history,
            parts=None,
        )


def _numbers_of(record: FitResult | FitRecord) -> dict[str, FloatArray]:
    """Return the coefficients of a fit by the names of their fields."""
    names = ("b", "z", "b_stddev", "shrinkage")
    return {name: np.array(getattr(record, name), dtype=np.float64) for name in names}


def measured_mm(distances_mm: FloatArray) -> FloatArray:
    """Return the absolute values of the finite signed distances, (n,)."""
    return np.abs(distances_mm[np.isfinite(distances_mm)])


def mean_mm(distances_mm: FloatArray) -> float:
    """Return the mean of the absolute values of the finite signed distances; NaN for none."""
    known = measured_mm(distances_mm)
    return float(known.mean()) if len(known) else math.nan


_MEDIANS = 5.0
"""Upper limit of a scale, in medians of the distances; larger distances are not those of the object."""


def scale_end(distances_mm: FloatArray) -> float:
    """Return the end of a colour scale for signed distances (N,), mm, robust against outliers."""
    known = measured_mm(distances_mm)
    if not len(known):
        return 1.0
    return nice_ceiling(min(float(np.percentile(known, 97)), _MEDIANS * float(np.median(known))))


def nice_ceiling(value: float) -> float:
    """Return a round number at or a little above `value`, 1 if that is not positive."""
    if not (value > 0 and np.isfinite(value)):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])
    return float(power * steps[np.searchsorted(steps, value / power - 1e-9)])


def _similarity(T: npt.NDArray[Any]) -> Similarity:
    matrix = np.asarray(T, dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise ValueError("a pose that is not finite")
    scale = float(np.cbrt(np.linalg.det(matrix[:, :3])))
    return Similarity(scale, matrix[:, :3] / scale, matrix[:, 3])
