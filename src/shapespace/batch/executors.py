"""Execution of many tasks: serially in this process, in processes on this machine, or on a Dask cluster (`on_dask`).

All executors have the interface `Executor.run`. It returns one answer per task, in any order. A task whose workers
crash is given up with a reason, while the others continue.

`ExecutionConfig` selects an executor by its name and the settings of the command line.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

from shapespace.batch.workers import Team, Work, cores
from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import make_folder, read_bytes, temporary_folder, write_bytes
from shapespace.io.memory_cache import LatestValue

T = TypeVar("T")
R = TypeVar("R")
S = TypeVar("S")


class Executor(Protocol):
    """Does tasks."""

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> AbstractContextManager[Iterator[tuple[T, R]]]:
        """Return a context manager of an iterator over pairs of task and answer; running tasks stop if it is left
        early.

        Raises:
            FitError: no workers are left, or none can start.
            ShapespaceError: raised by `work`.
        """
        ...


@dataclass(frozen=True)
class Serial:
    """One task after the other in this process; a task that hangs is not stopped."""

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> AbstractContextManager[Iterator[tuple[T, R]]]:
        """As `Executor.run`."""
        return nullcontext(zip(tasks, map(work.do, tasks), strict=True))


@dataclass(frozen=True)
class Local:
    """Processes on this machine, each with one BLAS thread.

    Args:
        workers: number of processes; 0 for one per core.
        timeout_s: time limit of a task, s, after which it is given up; None for no limit.
        quiet: whether the first worker does not report that code is compiled.
    """

    workers: int = 0
    timeout_s: float | None = None
    quiet: bool = True

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> AbstractContextManager[Iterator[tuple[T, R]]]:
        """As `Executor.run`."""
        return closing(self._answers(work, tasks))

    def _answers(self, work: Work[T, R], tasks: Sequence[T]) -> Generator[tuple[T, R]]:
        if not tasks:
            return
        with closing(Team(work, self.workers or cores(), self.timeout_s, quiet=self.quiet)) as team:
            for number, answer in team.run(tasks):
                yield tasks[number], answer


_latest = LatestValue[Any]()
"""Value that the tasks of this process share, by its file."""


@dataclass(frozen=True)
class Shared(Generic[T]):
    """Value that all tasks of a run use; each worker reads it once from a file that only the run writes.

    Args:
        file: path of the file with the value during the run.
        sha256: SHA-256 of the content of the file, which detects changes by other programs; empty without a file.
    """

    file: Path
    sha256: str = ""

    @staticmethod
    @contextmanager
    def by(executor: Executor, value: S, folder: Path) -> Generator[Shared[S]]:
        """Yield the shared form of a dataclass `value` for the tasks of an executor, during the block.

        Args:
            executor: executor of the tasks; for `Serial`, no file is written.
            value: value to share.
            folder: folder that all workers can read; it is created if missing.

        Raises:
            FileError: it cannot be written.
        """
        with temporary_folder(make_folder(folder)) as temporary:
            shared = Shared[S](temporary / "shared.pickle")
            if not isinstance(executor, Serial):
                content = pickle.dumps(replace(cast(Any, value)))  # without cached values
                shared = Shared[S](shared.file, hashlib.sha256(content).hexdigest())
                write_bytes(shared.file, content)
            _latest.set(shared.file, value)
            try:
                yield shared
            finally:
                _latest.clear()

    def value(self) -> T:
        """Return the value.

        Raises:
            FileError: its file cannot be read.
            FileFormatError: it is not the file that the run wrote.
        """
        return _latest.get(self.file, self._read)

    def _read(self) -> T:
        content = read_bytes(self.file)
        if hashlib.sha256(content).hexdigest() != self.sha256:
            raise FileFormatError(f"{self.file} was changed during the run; run the command again.")
        return pickle.loads(content)


@dataclass(frozen=True)
class ExecutionConfig:
    """Execution settings.

    Args:
        kind: name of the executor in `EXECUTORS`.
        jobs: number of parallel tasks; 0 for one per core. On a cluster it is the number of its workers.
        timeout_s: time limit of a task, s, after which it is given up; None for no limit.
        dask: address of a Dask scheduler, a scheduler file, or empty for the cluster of Dask's configuration.

    Raises:
        InputError: the kind does not exist, or does not support the other settings.
    """

    kind: str = "local"
    jobs: int = 0
    timeout_s: float | None = None
    dask: str = ""

    def __post_init__(self) -> None:
        if self.kind not in EXECUTORS:
            raise InputError(f"There is no executor {self.kind!r}; use one of {', '.join(EXECUTORS)}.")
        if self.dask and self.kind != "dask":
            raise InputError(f"A Dask scheduler is for executor=dask, not {self.kind}; omit one of the two.")
        if self.kind == "serial" and self.timeout_s is not None:
            raise InputError("executor=serial cannot stop a scan that hangs; omit timeout or executor.")

    def executor(self, tasks: int, *, quiet: bool = True) -> Executor:
        """Return the executor for a number of tasks.

        Args:
            tasks: number of tasks; a single task runs in this process unless settings request otherwise.
            quiet: whether workers do not report that code is compiled.
        """
        return EXECUTORS[self.kind](self, tasks, quiet)


def _make_local(execution: ExecutionConfig, tasks: int, quiet: bool) -> Executor:
    workers = min(execution.jobs or cores(), tasks)
    if workers <= 1 and execution.timeout_s is None:
        return Serial()
    return Local(max(workers, 1), execution.timeout_s, quiet)


def _make_serial(_execution: ExecutionConfig, _tasks: int, _quiet: bool) -> Executor:
    return Serial()


def _make_dask(execution: ExecutionConfig, _tasks: int, _quiet: bool) -> Executor:
    from shapespace.batch.on_dask import OnDask  # needs the extra `cluster`

    return OnDask(execution.dask, execution.timeout_s)


EXECUTORS: dict[str, Callable[[ExecutionConfig, int, bool], Executor]] = {
    "local": _make_local,
    "serial": _make_serial,
    "dask": _make_dask,
}
"""Executors by name: functions of the settings, the number of tasks, and whether to be quiet."""
