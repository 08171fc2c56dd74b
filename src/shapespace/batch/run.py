"""Fit many scans: a bad one becomes a row with its reason, the others go on, and an interruption loses nothing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from threadpoolctl import threadpool_limits

from shapespace.batch.folder import CoefficientTable, names_for
from shapespace.batch.results import (
    Source,
    coefficient_row,
    failed_record,
    fit_record,
    read_record,
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
from shapespace.version import __version__

_SAVE_EVERY_S = 5.0
_SAVES_APART = 20.0


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


def make_jobs(scans: Sequence[Path], landmarks: Path | None = None, folder: Path | None = None) -> list[Job]:
    """Return one job a scan, named by `names_for` for results in `folder`; a scan given twice is one job twice."""
    return [Job(name, scan, landmarks) for name, scan in zip(names_for(scans, folder), scans, strict=True)]


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
        short = f"{job.scan}: not enough memory to fit it; thin the scan first."
        record = failed_record(scan_source, model_source, short, config.as_dict())
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

    The table holds all records in the folder: those of earlier runs too, as long as they are there.

    Args:
        jobs: the scans.
        model: the shape space.
        model_file: where the model was read from, for the records.
        folder: where results go; made if absent.
        config: settings of all fits.
        executor: from `EXECUTORS`, or anything with its face; None fits one after the other here.
        resume: keep results that are there already for the same scan, model and settings. Where such a fit has to be
            done again, for the stages say, it has the dense surface and the stages that it had.
        stages: also write the surfaces at each stage, for figures.
        on_done: called with each job and its record.
        on_state: called with each state of the loop when fits run here.

    Raises:
        FileError: the results cannot be written.
    """
    make_folder(folder)
    kept = _Kept(CoefficientTable(folder, [job.name for job in jobs], model.n_modes), on_done)
    tasks: list[_Task] = []
    for job in {job.name: job for job in jobs}.values():
        task, earlier = _Task(job, config, stages), None
        if resume:
            task, earlier = _resumed(task, model, folder)
        if earlier is None:
            tasks.append(task)
        else:
            kept.add(job, earlier)
    if executor is None:
        running = _run_here(tasks, model, model_file, folder, on_state)
    else:
        running = _run_on(executor, tasks, model_file, folder)
    try:
        with closing(running) as ended:
            for job, record in ended:
                kept.add(job, record)
    finally:
        kept.table.catch_up([task.job.name for task in tasks if task.job.name not in kept.records])
        kept.table.save()
    return [kept.records[job.name] for job in jobs]


class _Kept:
    """The records of jobs that ended, and the table of them, which is saved now and then."""

    def __init__(self, table: CoefficientTable, on_done: Callable[[Job, Mapping[str, Any]], None] | None) -> None:
        self.table = table
        self.records: dict[str, dict[str, Any]] = {}
        self._on_done = on_done
        self._next_save = time.monotonic() + _SAVE_EVERY_S

    def add(self, job: Job, record: dict[str, Any]) -> None:
        # In this order, so that what an interruption keeps out of the table is caught up with.
        self.table.add(job.name, record)
        self.records[job.name] = record
        if self._on_done is not None:
            self._on_done(job, record)
        if (now := time.monotonic()) > self._next_save:
            self.table.save()
            # A table of very many rows takes a while itself.
            self._next_save = time.monotonic() + max(_SAVE_EVERY_S, _SAVES_APART * (time.monotonic() - now))


@dataclass(frozen=True)
class _Task:
    """What to do with one scan: its job, the settings, and whether to write the stages too."""

    job: Job
    config: FitConfig
    stages: bool


def _run_here(
    tasks: Sequence[_Task],
    model: ShapeModel,
    model_file: Path,
    folder: Path,
    on_state: Callable[[IcpState], None] | None,
) -> Generator[tuple[Job, dict[str, Any]]]:
    """Yield the job and record of each task, done one after the other in this process."""
    for task in tasks:
        yield (
            task.job,
            fit_file(task.job, model, model_file, folder, task.config, stages=task.stages, on_state=on_state),
        )


def _run_on(
    executor: Executor, tasks: Sequence[_Task], model_file: Path, folder: Path
) -> Generator[tuple[Job, dict[str, Any]]]:
    """Yield the job and record of each task as it ends; closed earlier, it waits for those that run already."""
    with interrupts_ignored():
        futures = {
            executor.submit(_fit_with_loaded_model, task.job, model_file, folder, task.config, task.stages): task.job
            for task in tasks
        }
    try:
        for future in as_completed(futures):
            try:
                record = future.result()
            except BrokenExecutor as error:
                raise FitError(
                    "A worker was stopped from outside, most likely for lack of memory; "
                    "run again with --resume and fewer --jobs."
                ) from error
            yield futures[future], record
    finally:
        wait([future for future in futures if not future.cancel()])


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


def _resumed(task: _Task, model: ShapeModel, folder: Path) -> tuple[_Task, dict[str, Any] | None]:
    """Return what is left to do, and the record of an earlier fit if it holds what is asked for, or more.

    A fit that has to be done again for the stages, say, keeps the dense surface that it had.
    """
    there = {
        ending: (folder / f"{task.job.name}.{ending}").is_file()
        for ending in ("fit.json", "fitted.ply", "dense.ply", "stages.npz")
    }
    if not there["fit.json"]:
        return task, None
    try:
        record = read_record(folder / f"{task.job.name}.fit.json")
        if not _is_of(record, task, model):
            return task, None
        dense = bool(record["config"]["dense"]) and there["dense.ply"]
        enough = there["fitted.ply"] and dense >= task.config.dense and there["stages.npz"] >= task.stages
        whole = len(record["b"]) == model.n_modes and record["status"] in get_args(Status)
        coefficient_row(task.job.name, record)
    except (ShapespaceError, KeyError, TypeError, AttributeError, ValueError):
        return task, None
    if enough and whole and record["status"] != "failed":
        return task, record
    also = replace(task.config, dense=task.config.dense or dense)
    return _Task(task.job, also, task.stages or there["stages.npz"]), None


def _is_of(record: Mapping[str, Any], task: _Task, model: ShapeModel) -> bool:
    """Return whether `record` is of the same scan, model, start and settings, with a dense surface or without."""
    job = task.job
    settings: dict[str, Any] = json.loads(json.dumps(task.config.as_dict()))
    settings["version"] = __version__
    del settings["dense"]
    marks = Source(job.landmarks.name, sha256_of_file(job.landmarks)).as_dict() if job.landmarks else None
    return bool(
        record["scan"]["hash"] == sha256_of_file(job.scan)
        and record["model"]["hash"] == model.content_hash
        and record.get("landmarks") == marks
        and all(record["config"].get(key) == value for key, value in settings.items())
    )
