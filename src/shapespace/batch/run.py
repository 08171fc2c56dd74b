"""Fit many scans: a scan that cannot be fitted becomes a failed record, and an interruption loses no finished fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shapespace.batch.executors import Executor, Serial
from shapespace.batch.fit_work import FitTask, FitWork, Job
from shapespace.batch.result_folder import names_for, only_writer
from shapespace.batch.sinks import Sink
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import IcpState
from shapespace.io.files import make_folder
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import FitRecord


def make_jobs(
    scans: Sequence[Path],
    landmarks: Path | None = None,
    folder: Path | None = None,
    addresses: Mapping[Path, str] | None = None,
) -> list[Job]:
    """Return one job a scan, named by `names_for` for results in `folder`; a scan given twice is one job twice."""
    addresses = addresses or {}
    names = names_for(scans, folder, addresses)
    return [
        Job(name, scan, landmarks, address=addresses.get(scan, "")) for name, scan in zip(names, scans, strict=True)
    ]


@dataclass(frozen=True)
class Plan:
    """Numbers of fits in a run.

    Args:
        valid: scans whose results of an earlier run are valid.
        repeated: scans with results that are not valid any more.
        new: scans without results.
    """

    valid: int
    repeated: int
    new: int

    def sentences(self) -> Iterator[str]:
        """Yield what a user should know of it."""
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
    """What the fits of a batch have in common.

    Args:
        model: the shape space.
        model_file: where the model was read from, for the records and for workers.
        fit: settings of each fit.
        stages: also write the surfaces at each stage, for figures.
        reuse: reuse earlier results that are valid for the same scan, model and settings. Where such a fit has to be
            done again, for the stages say, it keeps the dense surface and the stages that it had.
        first: names of jobs that are done before the others.
    """

    model: ShapeModel
    model_file: Path
    fit: FitConfig = field(default_factory=FitConfig)
    stages: bool = False
    reuse: bool = False
    first: Collection[str] = ()


def fit_many(
    jobs: Sequence[Job],
    config: BatchConfig,
    executor: Executor,
    sink: Sink,
    *,
    on_plan: Callable[[Plan], None] | None = None,
    on_done: Callable[[Job, FitRecord], None] | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> Counter[str]:
    """Fit all `jobs` into `sink` and return the number of fits of each status; an interruption loses no finished fit.

    Args:
        jobs: the scans; those with the same name are fitted once.
        config: what the fits have in common.
        executor: see `batch.executors`.
        sink: where results go, see `batch.sinks`; its folder is made if absent, and no other run may write into it.
        on_plan: called once with the numbers of valid, repeated and new fits.
        on_done: called with each job and its record; the record of a valid result in a store has no `reason`.
        on_state: called with each state of the loop by the serial executor.

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
            task, record = sink.find_valid(FitTask(job, config.fit, config.stages, config.reuse))
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
