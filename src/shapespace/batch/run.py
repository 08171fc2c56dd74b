"""Fit many scans: a bad one becomes a row with its reason, the others go on, and an interruption loses nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shapespace.batch.executors import Executor, Serial
from shapespace.batch.fit_records import write_record
from shapespace.batch.fit_work import FitTask, FitWork, Job, has_surface, resumed
from shapespace.batch.lock import only_writer
from shapespace.batch.result_folder import RECORD, CoefficientTable, names_for
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import IcpState
from shapespace.io.files import make_folder
from shapespace.model.shape_model import ShapeModel

_SAVE_EVERY_S = 5.0
_SAVES_APART = 20.0


def make_jobs(
    scans: Sequence[Path],
    landmarks: Path | None = None,
    folder: Path | None = None,
    addresses: Mapping[Path, str] | None = None,
) -> list[Job]:
    """Return one job a scan, named by `names_for` for results in `folder`; a scan given twice is one job twice."""
    there = addresses or {}
    names = names_for(scans, folder, there)
    return [Job(name, scan, landmarks, address=there.get(scan, "")) for name, scan in zip(names, scans, strict=True)]


@dataclass(frozen=True)
class Plan:
    """What a run has to do.

    Args:
        kept: scans whose results of an earlier run still hold.
        anew: scans that have results which do not.
        new: scans without results.
    """

    kept: int
    anew: int
    new: int

    def sentences(self) -> Iterator[str]:
        """Yield what a user should know of it."""
        every = self.kept + self.anew + self.new
        if self.kept:
            what = "scan has a result that still holds" if self.kept == 1 else "scans have results that still hold"
            yield f"{self.kept} of {every} {what}, which is kept; --again fits anew."
        if self.anew:
            what = "scan is" if self.anew == 1 else "scans are"
            yield (
                f"{self.anew} of {every} {what} fitted anew: scan, model, settings, version or the files of the result "
                "have changed since the last fit."
            )


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
    first: Collection[str] = (),
    on_plan: Callable[[Plan], None] | None = None,
    on_done: Callable[[Job, Mapping[str, Any]], None] | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> list[dict[str, Any]]:
    """Fit all `jobs` and keep coefficients.csv in `folder` current, also when interrupted; return the records.

    The table holds all records in the folder: those of earlier runs too, as long as they are there. No other run may
    write into the folder meanwhile.

    Args:
        jobs: the scans.
        model: the shape space.
        model_file: where the model was read from, for the records and for workers.
        folder: where results go; made if absent.
        config: settings of all fits.
        executor: see `batch.executors`; None fits one after the other here.
        resume: keep results that are there already for the same scan, model and settings. Where such a fit has to be
            done again, for the stages say, it has the dense surface and the stages that it had.
        stages: also write the surfaces at each stage, for figures.
        first: names of jobs that are done before the others.
        on_plan: called once with what is to be done.
        on_done: called with each job and its record.
        on_state: called with each state of the loop when fits run here.

    Raises:
        FileError: the results cannot be written, or another run writes into the folder.
        FitError: there are no workers, or none any more.
    """
    make_folder(folder)
    with only_writer(folder):
        kept = _Kept(CoefficientTable(folder, [job.name for job in jobs], model.n_modes), on_done)
        work = FitWork.of(model, model_file, folder, on_state if executor is None else None)
        tasks: list[FitTask] = []
        for job in {job.name: job for job in jobs}.values():
            task, earlier = FitTask(job, config, stages, resume), None
            if resume:
                task, earlier = resumed(task, model.content_hash, folder)
            if earlier is not None:
                try:
                    kept.add(job, _with_metadata(earlier, job, folder))
                    continue
                except (KeyError, TypeError, AttributeError, ValueError):  # damaged
                    task = FitTask(job, config, stages, resume=False)
            tasks.append(task)
        tasks.sort(key=lambda task: task.job.name not in first)
        kept.table.catch_up([task.job.name for task in tasks])
        if on_plan is not None:
            before = sum(has_surface(task.job, folder) for task in tasks)
            on_plan(Plan(len(kept.records), before, len(tasks) - before))
        try:
            with closing((executor or Serial()).run(work, tasks)) as ended:
                for task, record in ended:
                    kept.add(task.job, record)
        finally:
            kept.table.catch_up([task.job.name for task in tasks if task.job.name not in kept.records])
            kept.table.save()
    return [kept.records[job.name] for job in jobs]


def _with_metadata(record: dict[str, Any], job: Job, folder: Path) -> dict[str, Any]:
    if not job.metadata or record.get("metadata") == job.metadata:
        return record
    record = record | {"metadata": dict(job.metadata)}
    write_record(folder / f"{job.name}{RECORD}", record)
    return record


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
