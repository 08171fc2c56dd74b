"""Fit many scans: a bad one becomes a row with its reason, the others go on, and an interruption loses nothing."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from threadpoolctl import threadpool_limits

from shapespace import __version__
from shapespace.batch.results import (
    Source,
    coefficient_row,
    failed_record,
    fit_record,
    read_record,
    write_coefficients,
    write_fitted_mesh,
    write_record,
    write_stages,
)
from shapespace.batch.workers import context, interrupts_ignored, start_loading, wait_until_loaded
from shapespace.errors import FileError, FitError, ShapespaceError
from shapespace.fit.fit import FitConfig, fit_scan
from shapespace.fit.result import Status
from shapespace.fit.state import IcpState
from shapespace.io.files import make_folder, remove_file, sha256_of_file
from shapespace.io.landmarks import read_landmarks
from shapespace.io.meshes import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray

COEFFICIENTS = "coefficients.csv"
_SAVE_EVERY_S = 5.0
_LONGEST_NAME = 200


@dataclass(frozen=True)
class Job:
    """One scan to fit.

    Args:
        name: NAME of its result files, unique in the folder.
        scan: path of the scan.
        landmarks: path of its landmarks, or None.
    """

    name: str
    scan: Path
    landmarks: Path | None = None


def make_jobs(scans: Sequence[Path], landmarks: Path | None = None) -> list[Job]:
    """Return one job a scan; scans of the same name get _2, _3 and so on in the order given."""
    taken: dict[str, int] = {}
    jobs: list[Job] = []
    for scan in scans:
        stem = _shortened(scan.stem or scan.name)
        count = taken[stem] = taken.get(stem, 0) + 1
        name = stem
        while count > 1 and (name := f"{stem}_{count}") in taken:
            count += 1
        taken.setdefault(name, 1)
        jobs.append(Job(name, scan, landmarks))
    return jobs


def _shortened(stem: str) -> str:
    # File names end at 255 bytes, and the results add theirs.
    content = os.fsencode(stem)
    return stem if len(content) <= _LONGEST_NAME else content[:_LONGEST_NAME].decode("utf-8", "ignore")


def fit_file(
    job: Job,
    model: ShapeModel,
    model_file: Path,
    folder: Path,
    config: FitConfig,
    *,
    stages: bool = False,
    on_state: Callable[[IcpState], None] | None = None,
) -> dict[str, Any]:
    """Fit one scan from its file, write its results into `folder`, and return its record.

    A scan that cannot be fitted gives a record with status `failed`.

    Raises:
        FileError: the results cannot be written.
    """
    model_source = Source.at(model_file, model.content_hash, folder)
    scan_source = Source.at(job.scan, "", folder)
    marks_source: Source | None = None
    try:
        scan_source = Source.at(job.scan, sha256_of_file(job.scan), folder)
        scan = read_mesh(job.scan)
        landmarks: Mapping[str, FloatArray] | None = None
        if job.landmarks is not None:
            marks_source = Source(job.landmarks.name, sha256_of_file(job.landmarks))
            landmarks = read_landmarks(job.landmarks)
        result = fit_scan(model, scan, config, landmarks=landmarks, on_state=on_state)
    except MemoryError:
        record = failed_record(
            scan_source,
            model_source,
            f"{job.scan}: not enough memory to fit it; thin the scan first.",
            config.as_dict(),
        )
    except ShapespaceError as error:
        record = failed_record(scan_source, model_source, naming(job.scan, str(error)), config.as_dict())
    else:
        record = fit_record(result, scan_source, model_source, marks_source)
        write_fitted_mesh(folder / f"{job.name}.fitted.ply", result, model)
        if config.dense:
            write_fitted_mesh(folder / f"{job.name}.dense.ply", result, model, "dense")
        if stages:
            write_stages(folder / f"{job.name}.stages.npz", result, model)
    if record["status"] == "failed":
        # An earlier run's surface would contradict the record.
        remove_file(folder / f"{job.name}.fitted.ply")
    if (record["status"] == "failed" or not config.dense) and (folder / f"{job.name}.fit.json").is_file():
        # Without a record it is no result of ours, but perhaps a scan.
        remove_file(folder / f"{job.name}.dense.ply")
    if record["status"] == "failed" or not stages:
        remove_file(folder / f"{job.name}.stages.npz")
    write_record(folder / f"{job.name}.fit.json", record)
    return record


def naming(scan: Path, sentence: str) -> str:
    """Return `sentence` about the mesh in `scan` with its path in it, not just its name."""
    if str(scan) in sentence:
        return sentence
    if sentence.startswith(f"{scan.name}: "):
        return f"{scan}{sentence.removeprefix(scan.name)}"
    return f"{scan}: {sentence[:1].lower()}{sentence[1:]}"


def fit_files(
    jobs: Sequence[Job],
    model: ShapeModel,
    model_file: Path,
    folder: Path,
    config: FitConfig,
    *,
    executor: Executor | None = None,
    resume: bool = False,
    stages: bool = False,
    on_done: Callable[[Job, Mapping[str, Any]], None] | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> list[dict[str, Any]]:
    """Fit all `jobs` and keep coefficients.csv in `folder` current, also when interrupted; return the records.

    Args:
        jobs: the scans.
        model: the shape space.
        model_file: where the model was read from, for the records.
        folder: where results go; made if absent.
        config: settings of all fits.
        executor: from `EXECUTORS`, or anything with its face; None fits one after the other here.
        resume: keep results that are there already for the same scan, model and settings.
        stages: also write the surfaces at each stage, for figures.
        on_done: called with each job and its record.
        on_state: called with each state of the loop when fits run here.

    Raises:
        FileError: the results cannot be written.
    """
    make_folder(folder)
    records: dict[str, dict[str, Any]] = {}
    saved = time.monotonic()

    def save() -> None:
        rows = [coefficient_row(job.name, records[job.name]) for job in jobs if job.name in records]
        write_coefficients(folder / COEFFICIENTS, rows, model.n_modes)

    def done(job: Job, record: dict[str, Any]) -> None:
        nonlocal saved
        records[job.name] = record
        if on_done is not None:
            on_done(job, record)
        if time.monotonic() - saved > _SAVE_EVERY_S:
            save()
            saved = time.monotonic()

    open_jobs: list[Job] = []
    for job in jobs:
        earlier = _earlier_record(job, model, folder, config, stages) if resume else None
        if earlier is None:
            open_jobs.append(job)
        else:
            done(job, earlier)
    try:
        if executor is None:
            for job in open_jobs:
                done(job, fit_file(job, model, model_file, folder, config, stages=stages, on_state=on_state))
        else:
            for job, record in _run_on(executor, open_jobs, model_file, folder, config, stages):
                done(job, record)
    finally:
        save()
    return [records[job.name] for job in jobs]


def _run_on(
    executor: Executor, jobs: Sequence[Job], model_file: Path, folder: Path, config: FitConfig, stages: bool
) -> Iterator[tuple[Job, dict[str, Any]]]:
    with ExitStack() as stack:
        with interrupts_ignored():
            futures = {
                executor.submit(_fit_with_loaded_model, job, model_file, folder, config, stages): job for job in jobs
            }
        stack.callback(lambda: [future.cancel() for future in futures])
        for future in as_completed(futures):
            try:
                record = future.result()
            except BrokenExecutor as error:
                raise FitError(
                    "A worker was stopped from outside, most likely for lack of memory; "
                    "run again with --resume and fewer --jobs."
                ) from error
            yield futures[future], record


_model: ShapeModel | None = None


def _load_model(path: Path) -> None:
    """Load the model once a worker."""
    global _model
    _model = ShapeModel.load(path)


def _start_process(path: Path) -> None:
    """Load the model, and keep BLAS to one thread: the processes fill the cores already."""
    threadpool_limits(1)
    _load_model(path)


def _fit_with_loaded_model(job: Job, model_file: Path, folder: Path, config: FitConfig, stages: bool) -> dict[str, Any]:
    if _model is None:
        raise FileError("The worker has no model; start it with make_executor.")
    return fit_file(job, _model, model_file, folder, config, stages=stages)


def _processes(model: Path, workers: int) -> Executor:
    start_loading(tell=False)
    wait_until_loaded()
    return ProcessPoolExecutor(workers, mp_context=context(), initializer=_start_process, initargs=(model,))


def _threads(model: Path, workers: int) -> Executor:
    return ThreadPoolExecutor(workers, initializer=_load_model, initargs=(model,))


EXECUTORS: Mapping[str, Callable[[Path, int], Executor]] = {"processes": _processes, "threads": _threads}
"""Executors by name: each is given the model's file and the number of workers."""


def make_executor(model: Path, workers: int, kind: str = "processes") -> Executor:
    """Return an executor whose workers have read the model once.

    Args:
        model: path of the model file.
        workers: how many.
        kind: a name of `EXECUTORS`.
    """
    return EXECUTORS[kind](model, workers)


def _earlier_record(
    job: Job, model: ShapeModel, folder: Path, config: FitConfig, stages: bool
) -> dict[str, Any] | None:
    """Return the record of an earlier run if it is good for the same scan, model and settings."""
    path = folder / f"{job.name}.fit.json"
    wanted = {"fitted.ply": True, "dense.ply": config.dense, "stages.npz": stages}
    needed = [path, *(folder / f"{job.name}.{ending}" for ending, want in wanted.items() if want)]
    if not all(file.is_file() for file in needed):
        return None
    try:
        record = read_record(path)
        same_scan = record["scan"]["hash"] == sha256_of_file(job.scan)
        same_model = record["model"]["hash"] == model.content_hash
        settings: dict[str, Any] = json.loads(json.dumps(config.as_dict()))
        settings["version"] = __version__
        same_settings = all(record["config"].get(key) == value for key, value in settings.items())
        marks = Source(job.landmarks.name, sha256_of_file(job.landmarks)).as_dict() if job.landmarks else None
        same_marks = bool(record["landmarks"] == marks)
        whole = bool(len(record["b"]) == model.n_modes and record["status"] in get_args(Status))
        coefficient_row(job.name, record)
    except (ShapespaceError, KeyError, TypeError, AttributeError):
        return None
    good = same_scan and same_model and same_settings and same_marks and whole
    return record if good and record["status"] != "failed" else None
