"""Fits of very many scans: finished ones are moved into a store as the run goes on, and nothing is held for each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from shapespace.batch.executors import Executor, Serial
from shapespace.batch.fit_records import fit_identity
from shapespace.batch.fit_work import FitTask, FitWork, Job, is_same_scan
from shapespace.batch.lock import only_writer
from shapespace.batch.run import Plan
from shapespace.batch.store import Store
from shapespace.errors import FileError
from shapespace.fit.fit_scan import FitConfig
from shapespace.io.files import make_folder, sha256_of_file
from shapespace.model.shape_model import ShapeModel
from shapespace.store.results import Results

FROM = 10_000
"""Scans from which on a store is chosen."""
ROWS = 1000
"""Fits that are moved at a time."""
_SCAN = {
    "path": "path",
    "hash": "scan_hash",
    "size_bytes": "scan_size_bytes",
    "modified_ns": "scan_modified_ns",
    "remote_version": "scan_version",
}
"""What a record tells of its scan, by the column of a store that has it."""
_COLUMNS = ("scan", "id", "status", "stages", *_SCAN.values())


@dataclass(frozen=True)
class _Stored:
    """What a store has of one fit; `scan` is as in its record."""

    identity: str
    status: str
    stages: bool
    scan: Mapping[str, Any]


def fit_into_store(
    jobs: Sequence[Job],
    model: ShapeModel,
    model_file: Path,
    folder: Path,
    config: FitConfig,
    *,
    executor: Executor | None = None,
    again: bool = False,
    stages: bool = False,
    first: Collection[str] = (),
    on_plan: Callable[[Plan], None] | None = None,
    on_done: Callable[[Job, Mapping[str, Any]], None] | None = None,
) -> Counter[str]:
    """Fit all `jobs` into the store in `folder`, which is made if absent; return how many have which status.

    What was finished before, in shards or as single files, is kept where it holds, as by `fit_files`.

    Args:
        jobs: the scans.
        model: the shape space.
        model_file: where the model was read from.
        folder: of the store.
        config: settings of all fits.
        executor: see `batch.executors`; None fits one after the other here.
        again: fit also scans whose results still hold.
        stages: also keep the surfaces at each stage.
        first: names of jobs that are done before the others.
        on_plan: called once with what is to be done.
        on_done: called with each job and its record; of one that was kept only its status and reason.

    Raises:
        FileError: the results cannot be written, or another run writes into the folder.
        FitError: there are no workers, or none any more.
        ShapespaceError: the extra `store` is not installed.
    """
    make_folder(folder)
    with only_writer(folder):
        store = Store(folder)
        store.compact()
        counts: Counter[str] = Counter()
        tasks: list[FitTask] = []
        before = 0
        stored = {} if again else dict(_stored(folder))
        for job in {job.name: job for job in jobs}.values():
            there = stored.get(job.name)
            if there is not None and _holds(there, job, model, config, folder, stages=stages):
                counts[there.status] += 1
                if on_done is not None:
                    on_done(job, {"status": there.status, "reason": "kept"})
                continue
            before += there is not None and there.status != "failed"
            tasks.append(FitTask(job, config, stages, resume=not again))
        del stored
        tasks.sort(key=lambda task: task.job.name not in first)
        if on_plan is not None:
            on_plan(Plan(counts.total(), before, len(tasks) - before))
        work = FitWork.of(model, model_file, folder)
        finished: list[str] = []
        try:
            with closing((executor or Serial()).run(work, tasks)) as ended:
                for task, record in ended:
                    counts[record["status"]] += 1
                    finished.append(task.job.name)
                    if on_done is not None:
                        on_done(task.job, record)
                    if len(finished) >= ROWS:
                        store.compact(finished)
                        finished.clear()
        finally:
            store.compact()
    return counts


def _stored(folder: Path) -> Iterator[tuple[str, _Stored]]:
    for rows in Results(folder).iter_rows(_COLUMNS):
        for name, identity, status, stages, *scan in zip(*(rows[column] for column in _COLUMNS), strict=True):
            yield name, _Stored(identity or "", status, bool(stages), dict(zip(_SCAN, scan, strict=True)))


def _holds(there: _Stored, job: Job, model: ShapeModel, config: FitConfig, folder: Path, *, stages: bool) -> bool:
    """Return whether a stored fit is what is asked for, or more: a dense surface, or stages."""
    if there.status == "failed" or not there.identity or (stages and not there.stages):
        return False
    asked = [config] if config.dense else [config, replace(config, dense=True)]
    try:
        marks = sha256_of_file(job.landmarks) if job.landmarks else ""
        identities = {fit_identity(there.scan["hash"] or "", model.content_hash, one.as_dict(), marks) for one in asked}
        return there.identity in identities and is_same_scan(there.scan, job, folder)
    except FileError:
        return False  # the fit says why
