"""Fits of many scans: a scan that cannot be fitted results in a failed record, and interruptions lose no finished fit.

Results are written to a sink: single files in a folder, or a store. It finds valid results of earlier runs, accepts
each record, and completes the folder also after an interruption. `fit_many` locks the folder while the sink is in use.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

from msgspec import structs

from shapespace.batch.executors import Executor, Serial
from shapespace.batch.fit_records import write_record
from shapespace.batch.fit_work import FitJob, FitTask, FitWork, has_surface, is_fit_of, resumed
from shapespace.batch.result_folder import RECORD, CoefficientTable, names_for, only_writer
from shapespace.batch.store import Store
from shapespace.errors import FileError
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import IcpState
from shapespace.io.files import make_folder
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import File, FitRecord
from shapespace.store.results import Results

STORE_FROM = 10_000
"""Number of scans from which a store is the default."""
ROWS = 1000
"""Number of fits that are moved into a store at a time."""
_SAVE_INTERVAL_S = 5.0  # seconds; shortest time between two saves of the tables
_SAVE_COST_RATIO = 20.0
"""Smallest ratio of the time until the next save of the table to the duration of the last one."""
_SCAN = {
    "path": "path",
    "hash": "scan_hash",
    "size_bytes": "scan_size_bytes",
    "modified_ns": "scan_modified_ns",
    "remote_version": "scan_version",
}
"""Fields of a record's scan -> columns of a store."""
_COLUMNS = ("scan", "id", "status", "stages", *_SCAN.values())


@dataclass
class FolderSink:
    """Single files, and coefficients.csv with the records of all runs, those of this run last.

    Args:
        folder: folder of the results.
        records: records of this run by the names of the jobs, including those of valid earlier results.
    """

    folder: Path
    records: dict[str, FitRecord] = field(default_factory=dict[str, FitRecord], init=False)

    def open(self, names: Sequence[str], model: ShapeModel, *, reuse: bool) -> None:
        """Read the results of earlier runs.

        Args:
            names: names of the jobs of this run.
            model: model of the fits.
            reuse: whether valid earlier results are reused.
        """
        self._reuse, self._model_hash, self._started = reuse, model.content_hash, tuple[str, ...]()
        self._table = CoefficientTable(self.folder, names, model.n_modes)
        self._next_save = time.monotonic() + _SAVE_INTERVAL_S

    def find_valid(self, task: FitTask) -> tuple[FitTask, FitRecord | None]:
        """Return the task that remains, and the record of a valid earlier result, or None."""
        if not self._reuse:
            return task, None
        remaining, record = resumed(task, self._model_hash, self.folder)
        if record is None:
            return remaining, None
        try:
            self.add(task.job.name, self._with_metadata(record, task.job))
        except ValueError:  # damaged
            return replace(task, resume=False), None
        return task, self.records[task.job.name]

    def has_result(self, job: FitJob) -> bool:
        """Return whether there is a surface of an earlier fit of the scan."""
        return has_surface(job, self.folder)

    def start(self, names: Sequence[str]) -> None:
        """Prepare for the fits of the jobs `names`."""
        self._started = tuple(names)
        self._table.catch_up(names)

    def add(self, name: str, record: FitRecord) -> None:
        """Add the record of a job, whose files are already written; the table is saved at intervals."""
        self._table.add(name, record)
        self.records[name] = record
        if (now := time.monotonic()) > self._next_save:
            self._table.save()
            self._next_save = time.monotonic() + max(_SAVE_INTERVAL_S, _SAVE_COST_RATIO * (time.monotonic() - now))

    def close(self) -> None:
        """Complete the folder, also after an interruption, with results that were written but not added."""
        self._table.catch_up([name for name in self._started if name not in self.records])
        self._table.save()

    def _with_metadata(self, record: FitRecord, job: FitJob) -> FitRecord:
        if not job.metadata or record.metadata == job.metadata:
            return record
        record = structs.replace(record, metadata=dict(job.metadata))
        write_record(self.folder / f"{job.name}{RECORD}", record)
        return record


_Stored: TypeAlias = tuple[FitRecord, bool]
"""A fit in a store: id, status and scan of its record, and whether it has stages."""


@dataclass
class StoreSink:
    """A store, into which finished results are moved `ROWS` at a time; records are not kept in memory.

    Args:
        folder: folder of the store.
    """

    folder: Path
    records: Mapping[str, FitRecord] = field(default_factory=dict[str, FitRecord], init=False)

    def open(self, names: Sequence[str], model: ShapeModel, *, reuse: bool) -> None:
        """Read the results of earlier runs.

        Args:
            names: names of the jobs of this run.
            model: model of the fits.
            reuse: whether valid earlier results are reused.

        Raises:
            ShapespaceError: the extra `store` is not installed.
        """
        self._model_hash, self._finished = model.content_hash, list[str]()
        self._store = Store(self.folder)
        self._store.compact()
        self._stored = dict(self._read_stored()) if reuse else {}

    def find_valid(self, task: FitTask) -> tuple[FitTask, FitRecord | None]:
        """Return the task that remains, and the record of a valid earlier result, or None."""
        stored = self._stored.get(task.job.name)
        valid = stored is not None and self._is_valid(stored, task)
        return task, stored[0] if valid and stored is not None else None

    def has_result(self, job: FitJob) -> bool:
        """Return whether there is a surface of an earlier fit of the scan."""
        stored = self._stored.get(job.name)
        return stored is not None and stored[0].is_fitted

    def start(self, names: Sequence[str]) -> None:
        """Prepare for the fits of the jobs `names`: free the memory of stored results."""
        self._stored.clear()

    def add(self, name: str, record: FitRecord) -> None:
        """Add the record of a job, whose files are already written."""
        self._finished.append(name)
        if len(self._finished) >= ROWS:
            self._store.compact(self._finished)
            self._finished.clear()

    def close(self) -> None:
        """Complete the folder, also after an interruption, with results that were written but not added."""
        self._store.compact()

    def _read_stored(self) -> Iterator[tuple[str, _Stored]]:
        for rows in Results(self.folder).iter_rows(_COLUMNS):
            for name, identity, status, stages, *scan in zip(*(rows[column] for column in _COLUMNS), strict=True):
                known = {key: value for key, value in zip(_SCAN, scan, strict=True) if value is not None}
                yield name, (FitRecord(id=identity or "", status=status, scan=File(**known)), bool(stages))

    def _is_valid(self, stored: _Stored, task: FitTask) -> bool:
        """Return whether a stored fit is valid and has at least the requested dense surface and stages."""
        record, staged = stored
        if not record.is_fitted or (task.stages and not staged):
            return False
        try:
            return any(
                is_fit_of(record.id, record.scan, task, self._model_hash, self.folder, dense=dense)
                for dense in {task.config.dense, True}
            )
        except FileError:
            return False  # the fit reports it


Sink: TypeAlias = FolderSink | StoreSink
"""Destination of the results of a batch of fits, for one use."""


def make_jobs(
    scans: Sequence[Path],
    landmarks: Path | None = None,
    folder: Path | None = None,
    addresses: Mapping[Path, str] | None = None,
) -> list[FitJob]:
    """Return a job for each scan, named by `names_for` for results in `folder`; equal scans have equal jobs."""
    addresses = addresses or {}
    names = names_for(scans, folder, addresses)
    return [
        FitJob(name, scan, landmarks, address=addresses.get(scan, "")) for name, scan in zip(names, scans, strict=True)
    ]


@dataclass(frozen=True)
class Plan:
    """Numbers of fits in a run.

    Args:
        valid: number of scans with valid results of an earlier run.
        repeated: number of scans whose results are no longer valid.
        new: number of scans without results.
    """

    valid: int
    repeated: int
    new: int

    def sentences(self) -> Iterator[str]:
        """Yield sentences for the user about reused and repeated fits."""
        total = self.valid + self.repeated + self.new
        if self.valid:
            noun = "scan has a valid result, which is" if self.valid == 1 else "scans have valid results, which are"
            yield f"{self.valid} of {total} {noun} reused; --again fits again."
        if self.repeated:
            noun = "scan is" if self.repeated == 1 else "scans are"
            yield (
                f"{self.repeated} of {total} {noun} fitted again: the scan, model, settings, version or result files "
                "have changed since the last fit."
            )


@dataclass(frozen=True)
class BatchConfig:
    """Settings that all fits of a batch share.

    Args:
        model: shape model of the fits.
        model_file: path of the model, for the records and for workers.
        fit: settings of each fit.
        stages: whether to write the surfaces at each stage, for figures.
        reuse: whether to reuse earlier results that are valid for the same scan, model and settings. If such a fit is
            repeated, for example to write its stages, its dense surface and stages are kept.
        first: names of jobs that are done before the others.
    """

    model: ShapeModel
    model_file: Path
    fit: FitConfig = field(default_factory=FitConfig)
    stages: bool = False
    reuse: bool = False
    first: Collection[str] = ()


def fit_many(
    jobs: Sequence[FitJob],
    config: BatchConfig,
    executor: Executor,
    sink: Sink,
    *,
    on_plan: Callable[[Plan], None] | None = None,
    on_done: Callable[[FitJob, FitRecord], None] | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> Counter[str]:
    """Fit all `jobs` into `sink` and return the number of fits of each status; an interruption loses no finished fit.

    Args:
        jobs: jobs of the scans; jobs with the same name are done once.
        config: common settings of the fits.
        executor: executor of the fits, see `batch.executors`.
        sink: destination of the results, see `Sink`; its folder is created if missing, and no other run may write into
            it.
        on_plan: function that is called once with the numbers of valid, repeated and new fits.
        on_done: function that is called with each job and its record; the record of a valid result in a store has no
            `reason`.
        on_state: function that the serial executor calls with each state of the iteration.

    Raises:
        FileError: the results cannot be written, or another run writes into the folder.
        FitError: no workers are left, or none can start.
    """
    folder, counts = make_folder(sink.folder), Counter[str]()
    unique = {job.name: job for job in jobs}
    with only_writer(folder):
        sink.open(tuple(unique), config.model, reuse=config.reuse)
        tasks: list[FitTask] = []
        for job in unique.values():
            own = config.fit.for_scan(config.model, job.name)
            task, record = sink.find_valid(FitTask(job, own, config.stages, config.reuse))
            if record is None:
                tasks.append(task)
                continue
            counts[record.status] += 1
            if on_done is not None:
                on_done(job, record)
        tasks.sort(key=lambda task: task.job.name not in config.first)
        if on_plan is not None:
            repeated = sum(sink.has_result(task.job) for task in tasks)
            on_plan(Plan(counts.total(), repeated, len(tasks) - repeated))
        work = FitWork.of(config.model, config.model_file, folder, on_state if isinstance(executor, Serial) else None)
        sink.start([task.job.name for task in tasks])
        try:
            with executor.run(work, tasks) as results:
                for task, record in results:
                    counts[record.status] += 1
                    sink.add(task.job.name, record)
                    if on_done is not None:
                        on_done(task.job, record)
        finally:
            sink.close()
    return counts
