"""Fit of one scan of a batch, its result files, and the check whether results of earlier runs are valid.

`save_fit` writes the result of a fit in Python like the command line.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import uuid
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from msgspec import structs

from shapespace.batch.fit_records import (
    failed_record,
    fit_identity,
    fit_record,
    hashed_source,
    is_surface_of,
    read_record,
    source_of,
    write_fitted_mesh,
    write_record,
    write_stages,
)
from shapespace.batch.result_folder import RECORD, CoefficientTable, names_for, only_writer
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import IcpState
from shapespace.fit.result import FitResult
from shapespace.io.files import make_folder, sha256_of_file, write_text, write_together
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS, fiducial_texts, read_landmarks
from shapespace.io.memory_cache import LatestValue
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.read_limits import LARGEST_MESH_FILE_BYTES
from shapespace.io.remote import fetch_copy, is_address, name_of, version_of
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import File, FitRecord, to_json
from shapespace.store.results import ENDINGS, Results, has_written_landmarks
from shapespace.types import FloatArray, Mesh


@dataclass(frozen=True)
class FitJob:
    """One scan to fit.

    Args:
        name: NAME of the result files, unique in the folder.
        scan: path of the scan; for a remote scan, a path with its file name.
        landmarks: path of the landmarks of the scan, or None.
        metadata: metadata of the scan, by the columns of a list of scans; copied to its record.
        address: address of a remote scan for fsspec; empty for a local file.
        parts: path of the scan of each part, if there are several; `scan` then only names the subject.
    """

    name: str
    scan: Path
    landmarks: Path | None = None
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])
    address: str = ""
    parts: Mapping[str, Path] = field(default_factory=dict[str, Path])

    @property
    def label(self) -> str:
        """Name of the scan in messages: its address or path."""
        return self.address or str(self.scan)

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of all scans."""
        return tuple(self.parts.values()) or (self.scan,)

    def read(self, file: Path) -> Mesh | dict[str, Mesh]:
        """Return the scan, whose path is `file`, or the scan of each part.

        Raises:
            FileError, MeshError: one cannot be read.
        """
        return {part: read_mesh(own) for part, own in self.parts.items()} or read_mesh(file)

    @contextlib.contextmanager
    def readable(self) -> Generator[Path]:
        """Yield the path of the scan; for a remote scan, that of a copy, which exists during the block.

        Raises:
            FileError: it cannot be fetched.
        """
        if not self.address:
            yield self.scan
            return
        with fetch_copy(self.address, LARGEST_MESH_FILE_BYTES) as file:
            yield file

    def source(self, folder: Path) -> File:
        """Return the reference to the scan for results in `folder`, without reading the scan."""
        return File(name=self.scan.name, path=self.address) if self.address else source_of(self.scan, "", folder)

    def read_source(self, file: Path, folder: Path) -> File:
        """Return the reference with the hash or version of the scan; `file` is the path from `readable`.

        Raises:
            FileError: it cannot be read.
        """
        if self.parts:
            return structs.replace(self.source(folder), hash=" ".join(map(sha256_of_file, self.files)))
        if not self.address:
            return hashed_source(file, folder)
        version = version_of(self.address)
        return structs.replace(self.source(folder), hash=sha256_of_file(file), remote_version=version)


def publish(result: FitResult, record: FitRecord, name: str, folder: Path, *, stages: bool) -> None:
    """Write the record and the surfaces of a fit together, and remove other files of an earlier fit of that name.

    Raises:
        FileError: they cannot be written.
    """
    files, dense = _files(name, folder), "dense" in result.stages
    writes: dict[Path, Callable[[Path], None]] = {}
    for surface, stage in ((files["fitted"], "final"), *([(files["dense"], "dense")] if dense else [])):
        writes[surface] = partial(write_fitted_mesh, result=result, model=result.model, stage=stage, identity=record.id)
    if stages:
        writes[files["stages"]] = partial(write_stages, result=result, model=result.model)
    landmarks: Mapping[str, Any] = to_json(record.found_landmarks)
    texts = fiducial_texts(landmarks) if landmarks else {}
    writes |= {files[ending]: partial(write_text, text=text) for ending, text in texts.items()}
    writes[files["record"]] = partial(write_record, record=record)
    write_together(writes, _find_stale(files, dense=not dense, stages=not stages, landmarks=not texts))


def _write_failed(record: FitRecord, job: FitJob, folder: Path) -> FitRecord:
    files = _files(job.name, folder)
    # The surface of an earlier run would contradict the record.
    stale = [files["fitted"], *_find_stale(files, dense=True, stages=True, landmarks=True)]
    write_together({files["record"]: partial(write_record, record=record)}, stale)
    return record


def _files(name: str, folder: Path) -> dict[str, Path]:
    """Return the paths of the results of a scan: by type, and those of landmarks by ending."""
    endings = {"record": RECORD, **ENDINGS, **{ending: ending for ending in FIDUCIAL_ENDINGS}}
    return {what: folder / f"{name}{ending}" for what, ending in endings.items()}


def _find_stale(files: Mapping[str, Path], *, dense: bool, stages: bool, landmarks: bool) -> list[Path]:
    """Return the files of an earlier fit that this fit does not write."""
    # Without a record, such files may be a scan and landmarks of the user, not results.
    left = [files["dense"]] if dense and files["record"].is_file() else []
    if landmarks and has_written_landmarks(files["record"]):
        left += [files[ending] for ending in FIDUCIAL_ENDINGS]
    return [*left, files["stages"]] if stages else left


def naming(source: Path | str, sentence: str) -> str:
    """Return `sentence` about a mesh with its path or address instead of its file name."""
    if str(source) in sentence:
        return sentence
    name = name_of(source) if isinstance(source, str) and is_address(source) else Path(source).name
    if sentence.startswith(f"{name}: "):
        return f"{source}{sentence.removeprefix(name)}"
    return f"{source}: {sentence[:1].lower()}{sentence[1:]}"


@dataclass(frozen=True)
class FitTask:
    """Task for one scan: its job, the settings, whether to write the stages, and whether to reuse valid results."""

    job: FitJob
    config: FitConfig
    stages: bool
    resume: bool


@dataclass(frozen=True)
class FitWork:
    """Fits scans by one model, for an executor.

    Args:
        model_file: path of the model, which each worker reads once.
        model_hash: content hash of the model.
        folder: folder of the results.
        run: unique identifier of the run.
        on_state: function that is called with each state of the iteration; None if workers are other processes.
    """

    model_file: Path
    model_hash: str
    folder: Path
    run: str
    on_state: Callable[[IcpState], None] | None = None

    def do(self, task: FitTask) -> FitRecord:
        """Fit one scan from its file, write its results, and return its record.

        A scan that cannot be fitted results in a record with status `failed`. After an interruption at any moment, the
        record and the surfaces in the folder belong together. A valid result, such as that of a worker that crashed
        later, is returned unchanged.

        Raises:
            FileError: the model cannot be read, or the results cannot be written.
        """
        job, model = task.job, _model.get(self.model_hash, self._load)
        if task.resume:
            task, earlier = resumed(task, self.model_hash, self.folder, self.run)
            if earlier is not None:
                return earlier
        model_source = source_of(self.model_file, self.model_hash, self.folder)
        scan_source, marks_source = job.source(self.folder), None
        try:
            with job.readable() as file:
                scan_source = job.read_source(file, self.folder)
                scan = job.read(file)
            landmarks: Mapping[str, FloatArray] | None = None
            if job.landmarks is not None:
                marks_source = File(name=job.landmarks.name, hash=sha256_of_file(job.landmarks))
                landmarks = read_landmarks(job.landmarks)
            result = fit_scan(model, scan, task.config, landmarks=landmarks, on_state=self.on_state)
        except (MemoryError, ShapespaceError) as error:
            no_memory = f"{job.label}: not enough memory to fit it; crop it (--crop), or reduce it first."
            reason = no_memory if isinstance(error, MemoryError) else naming(job.label, str(error))
            failed = failed_record(scan_source, model_source, reason, task.config.as_dict(), job.metadata)
            return _write_failed(failed, job, self.folder)
        record = fit_record(result, scan_source, model_source, marks_source, job.metadata)
        publish(result, record, job.name, self.folder, stages=task.stages)
        return record

    def give_up(self, task: FitTask, reason: str) -> FitRecord:
        """Write and return the record of a scan whose workers crashed."""
        model = source_of(self.model_file, self.model_hash, self.folder)
        scan = task.job.source(self.folder)
        if not task.job.address:
            with contextlib.suppress(ShapespaceError):
                scan = task.job.read_source(task.job.scan, self.folder)
        record = failed_record(scan, model, f"{task.job.label}: {reason}.", task.config.as_dict(), task.job.metadata)
        return _write_failed(structs.replace(record, given_up=self.run), task.job, self.folder)

    @staticmethod
    def of(
        model: ShapeModel, model_file: Path, folder: Path, on_state: Callable[[IcpState], None] | None = None
    ) -> FitWork:
        """Return the work of a new run; fits in this process use `model` and do not read its file."""
        _model.set(model.content_hash, model)
        return FitWork(model_file, model.content_hash, folder, uuid.uuid4().hex, on_state)

    def _load(self) -> ShapeModel:
        model = ShapeModel.load(self.model_file)
        if model.content_hash != self.model_hash:
            raise FileError(f"{self.model_file} has changed since this run began; start it again.")
        return model


_model = LatestValue[ShapeModel]()
"""The model of the batch that this process works on, by its content hash."""


def has_surface(job: FitJob, folder: Path) -> bool:
    """Return whether `folder` contains the surface of an earlier fit of the scan."""
    files = _files(job.name, folder)
    return files["fitted"].is_file() and files["record"].is_file()


def resumed(task: FitTask, model_hash: str, folder: Path, run: str = "") -> tuple[FitTask, FitRecord | None]:
    """Return the remaining task, and the record of a valid earlier fit with at least the requested results, or None.

    If a fit is repeated, for example to write its stages, its dense surface is kept. A scan that was given up is
    repeated by other runs, but not by `run`.
    """
    files = _files(task.job.name, folder)
    if not files["record"].is_file():
        return task, None
    try:
        record = read_record(files["record"])
        if run and record.given_up == run:
            return task, record
        dense = bool(record.config["dense"])
        if not is_fit_of(record.id, record.scan, task, model_hash, folder, dense=dense):
            return task, None
        dense = dense and is_surface_of(files["dense"], record)
        staged = files["stages"].is_file()
        enough = is_surface_of(files["fitted"], record) and dense >= task.config.dense and staged >= task.stages
        complete = len(record.b) == len(record.z) == len(record.b_stddev)
    except (ShapespaceError, KeyError, TypeError, AttributeError, ValueError):
        return task, None
    if enough and complete and record.is_fitted:
        return task, record
    also = replace(task.config, dense=task.config.dense or dense)
    return replace(task, config=also, stages=task.stages or staged), None


def is_fit_of(identity: str, recorded: File, task: FitTask, model_hash: str, folder: Path, *, dense: bool) -> bool:
    """Return whether a result in `folder` belongs to the scan, model, landmarks and settings of a task.

    Args:
        identity: identity of the result; empty if it is not a fit.
        recorded: reference to the scan in the record of the result.
        task: task for the scan.
        model_hash: content hash of the model.
        folder: folder of the results.
        dense: whether the result has a dense surface, even if the task does not request it.

    Raises:
        FileError: the scan or its landmarks cannot be read or reached.
    """
    marks = sha256_of_file(task.job.landmarks) if task.job.landmarks else ""
    settings = replace(task.config, dense=dense).as_dict()
    wanted = fit_identity(recorded.hash, model_hash, settings, marks)
    return identity == wanted and is_same_scan(recorded, task.job, folder)


def is_same_scan(recorded: File, job: FitJob, folder: Path) -> bool:
    """Return whether the scan of `job` is that of a result in `folder`.

    Scans are compared by path, size and modification time, or else by content; remote scans by version.

    Args:
        recorded: reference to the scan in the record of the result.
        job: job with the scan.
        folder: folder of the result.

    Raises:
        FileError: it cannot be read or reached.
    """
    if job.address:
        return recorded.path == job.address and recorded.remote_version == version_of(job.address)
    with contextlib.suppress(OSError):
        there = job.scan.stat()
        now = (there.st_size, there.st_mtime_ns, source_of(job.scan, "", folder).path)
        if (recorded.size_bytes, recorded.modified_ns, recorded.path) == now:
            return True
    return recorded.hash == job.read_source(job.scan, folder).hash


_FORBIDDEN = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
"""Characters that file names cannot contain on some systems."""
_HASH_CHARACTERS = 12  # hexadecimal digits, 48 bits: unique for a million scans


def save_fit(result: FitResult, folder: Path, name: str, *, stages: bool) -> Path:
    """Implement `FitResult.save`."""
    if name and (_FORBIDDEN.search(name) or name in (".", "..")):
        raise InputError(f"{name!r} is not a valid file name; remove slashes, colons and similar characters.")
    make_folder(folder)
    with only_writer(folder):
        scan = _scan_source(result, folder)
        if not name and "scan" in result.files:
            [name] = names_for([result.files["scan"]], folder)
        name = name or _free_name(scan, folder)
        record = fit_record(result, scan, _model_source(result, folder), _landmarks_source(result))
        publish(result, record, name, folder, stages=stages)
        table = CoefficientTable(folder, [name], result.model.n_modes)
        table.add(name, record)
        table.save()
    return folder / f"{name}{RECORD}"


def _scan_source(result: FitResult, folder: Path) -> File:
    if "scan" in result.files:
        return hashed_source(result.files["scan"], folder)
    return File(name=result.scan_name, hash=_hash_of(result.scan))


def _hash_of(mesh: Mesh) -> str:
    content = hashlib.sha256(mesh.vertices.astype("<f8").tobytes())
    if mesh.faces is not None:
        content.update(mesh.faces.astype("<i4").tobytes())
    return content.hexdigest()


def _model_source(result: FitResult, folder: Path) -> File:
    file = result.files.get("model") or result.model.file
    return source_of(file, result.model_hash, folder) if file else File(hash=result.model_hash)


def _landmarks_source(result: FitResult) -> File | None:
    file = result.files.get("landmarks")
    return File(name=file.name, hash=sha256_of_file(file)) if file else None


def _free_name(scan: File, folder: Path) -> str:
    """Return NAME for a scan without a file: its name, unless another scan has results with that name."""
    stem = _FORBIDDEN.sub("_", Path(scan.name).stem).strip(". ") or "scan"
    results = Results(folder)
    try:
        free = stem not in results or results.fit(stem).scan.hash == scan.hash
    except ShapespaceError:
        free = False
    return stem if free else f"{stem}_{scan.hash[:_HASH_CHARACTERS]}"
