"""Execution of many tasks: serially in this process, in processes on this machine, or on a Dask cluster (`on_dask`).

All executors have one interface, `Executor.run`, and one contract: each task has one answer, in any order, and a task
that its workers do not survive is given up with a reason while the others continue.

`ExecutionConfig` chooses one by its name and the settings of the command line.
"""

from __future__ import annotations

import hashlib
import pickle
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

from threadpoolctl import threadpool_limits

from shapespace.batch.workers import Worker, cores, life_line, start_loading, wait_until_loaded
from shapespace.errors import FileFormatError, FitError, InputError
from shapespace.io.files import make_folder, read_bytes, temporary_folder, write_bytes
from shapespace.io.memory_cache import LatestValue

T = TypeVar("T")
R = TypeVar("R")
S = TypeVar("S")
TaskT = TypeVar("TaskT", contravariant=True)
AnswerT = TypeVar("AnswerT", covariant=True)

ATTEMPTS = 2
"""Number of workers that a task may cost before it is given up."""
GRACE_S = 5.0
"""Time for running tasks to end when a run is stopped; a second Ctrl-C ends them at once."""
_STARTS = 3  # worker pools in a row that may fail to start: one failure can be chance, three are the machine
_FOREVER = float("inf")
_NO_START = (
    "Worker processes end as they start; use --jobs 1, free some memory, or, in a script of your own, put what it does "
    'under if __name__ == "__main__".'
)


class Work(Protocol[TaskT, AnswerT]):
    """What is done with each task: frozen, small, and sent to every worker.

    It names the data that the tasks share by path or hash; `do` loads them once in each process (`Shared`,
    `LatestValue`).
    """

    def do(self, task: TaskT, /) -> AnswerT:
        """Do one task; an error of the task itself is part of the answer.

        Raises:
            ShapespaceError: an error that would stop every other task too, such as a full disk.
        """
        ...

    def give_up(self, task: TaskT, reason: str, /) -> AnswerT:
        """Return the answer for a task that could not be done; `do` in the same run then returns it too."""
        ...


class Executor(Protocol):
    """Does tasks."""

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> AbstractContextManager[Iterator[tuple[T, R]]]:
        """Return a context whose value yields each task with its answer; leaving it early stops running tasks.

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
        timeout_s: a task that takes longer is given up; None for no limit.
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
"""The value that the tasks of this process share, by its file."""


@dataclass(frozen=True)
class Shared(Generic[T]):
    """What all tasks of a work use; each worker reads it once from a file that only the run itself writes.

    Args:
        file: of the value, during the run.
        sha256: of the file's content, so that nothing is read that another program wrote there; empty without a file.
    """

    file: Path
    sha256: str = ""

    @staticmethod
    @contextmanager
    def by(executor: Executor, value: S, folder: Path) -> Generator[Shared[S]]:
        """Yield a dataclass `value` as the tasks of an executor share it, during the block.

        Args:
            executor: of the tasks; with `Serial`, nothing is written.
            value: what is shared.
            folder: that all workers see; made if absent.

        Raises:
            FileError: it cannot be written.
        """
        with temporary_folder(make_folder(folder)) as temporary:
            shared = Shared[S](temporary / "shared.pickle")
            if not isinstance(executor, Serial):
                content = pickle.dumps(replace(cast(Any, value)))  # without what it has cached
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


@dataclass
class _Assignment:
    """The task of a worker by its number, None while it starts or waits for one, and when it must have ended."""

    number: int | None = None
    deadline: float = _FOREVER


class Team:
    """Worker processes that are started when needed and stay for further tasks; each has a pipe of its own.

    Args:
        work: what they do.
        size: largest number of workers.
        timeout_s: a task that takes longer is given up; None for no limit.
        quiet: whether the first worker does not report that code is compiled.

    Raises:
        FitError: no process can be started.
    """

    def __init__(self, work: Work[Any, Any], size: int, timeout_s: float | None, *, quiet: bool = True) -> None:
        self._work, self._size, self._timeout_s = work, size, timeout_s
        self._assignments: dict[Worker, _Assignment] = {}
        self._idle: list[Worker] = []
        self._failed_starts = 0
        start_loading(notify=not quiet)
        wait_until_loaded()
        self._stack = ExitStack()
        self._life = self._stack.enter_context(life_line())

    def run(self, tasks: Sequence[Any]) -> Generator[tuple[int, Any]]:
        """Yield the number of each task and its answer.

        Raises:
            FitError: no process can be started.
            ShapespaceError: raised by the work.
        """
        waiting, deaths, left = deque(range(len(tasks))), [0] * len(tasks), len(tasks)
        while left:
            while waiting and self._idle:
                self._assign(self._idle.pop(), waiting.popleft(), tasks)
            while len(self._assignments) + len(self._idle) < min(self._size, left):
                self._assignments[Worker(_serve, (self._work,), self._life)] = _Assignment()
            for worker in self._ready():
                assignment = self._assignments.pop(worker)
                number, answer = assignment.number, worker.answer()
                if answer is not None:
                    self._failed_starts = 0
                    self._idle.append(worker)
                    if waiting:
                        self._assign(self._idle.pop(), waiting.popleft(), tasks)
                    if number is not None:
                        left -= 1
                        yield number, _value(answer)
                    continue
                late_s = None if time.monotonic() < assignment.deadline else self._timeout_s
                code = worker.stop()
                if number is None:
                    self._failed_starts += 1
                    if self._failed_starts >= _STARTS:
                        raise FitError(_NO_START)
                    continue
                deaths[number] += 1
                if late_s is None and deaths[number] < ATTEMPTS:
                    waiting.append(number)
                    continue
                left -= 1
                yield number, self._work.give_up(tasks[number], _reason_of_death(code, late_s))

    def close(self) -> None:
        """Give running tasks a moment to end, then end every worker."""
        try:
            deadline = time.monotonic() + GRACE_S
            running = {worker.line for worker, one in self._assignments.items() if one.number is not None}
            while running and (left_s := deadline - time.monotonic()) > 0:
                running.difference_update(wait(running, left_s))
        finally:
            for worker in (*self._assignments, *self._idle):
                worker.stop()
            self._assignments.clear()
            self._idle.clear()
            self._stack.close()

    def _assign(self, worker: Worker, number: int, tasks: Sequence[Any]) -> None:
        deadline = _FOREVER if self._timeout_s is None else time.monotonic() + self._timeout_s
        self._assignments[worker] = _Assignment(number, deadline)
        worker.give(tasks[number])

    def _ready(self) -> list[Worker]:
        """Wait, and return the workers that have answered, died, or taken too long."""
        first = min(one.deadline for one in self._assignments.values())
        timeout_s = None if first == _FOREVER else max(0.0, first - time.monotonic())
        lines = set(wait([worker.line for worker in self._assignments], timeout_s))
        now = time.monotonic()
        return [worker for worker, one in self._assignments.items() if worker.line in lines or now >= one.deadline]


def _reason_of_death(code: int, late_s: float | None) -> str:
    """Return why a worker did not answer, by its exit code, or the time limit of its task."""
    if late_s is not None:
        return f"it took more than the {late_s:g} s of --set timeout"
    cause = f"by signal {-code}" if code < 0 else f"with exit code {code}"
    return f"its worker ended {cause}, {ATTEMPTS} times, most likely for lack of memory; thin it, or use fewer --jobs"


def _serve(line: Connection, work: Work[Any, Any]) -> None:
    """Do the tasks that arrive on `line` until it ends; runs in the worker process."""
    threadpool_limits(1)
    line.send(())
    while True:
        try:
            task = line.recv()
        except EOFError:
            return
        try:
            answer = (True, work.do(task))
        except Exception as error:
            answer = (False, error)
        line.send(answer)


def _value(answer: tuple[bool, Any]) -> Any:
    done, value = answer
    if not done:
        raise value
    return value


@dataclass(frozen=True)
class ExecutionConfig:
    """Execution settings.

    Args:
        kind: a name of `EXECUTORS`.
        jobs: number of parallel tasks; 0 for one per core. On a cluster it is the number of its workers.
        timeout_s: a task that takes longer is given up; None for no limit.
        dask: address of a Dask scheduler, a scheduler file, or empty for a cluster by Dask's configuration.

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
            raise InputError(f"A Dask scheduler is for executor=dask, not {self.kind}; leave out one of them.")
        if self.kind == "serial" and self.timeout_s is not None:
            raise InputError("executor=serial cannot stop a scan that hangs; leave out timeout or executor.")

    def executor(self, tasks: int, *, quiet: bool = True) -> Executor:
        """Return the executor for a number of tasks.

        Args:
            tasks: their number; one task alone runs in this process where nothing else is asked for.
            quiet: whether workers do not report that code is compiled.
        """
        return EXECUTORS[self.kind](self, tasks, quiet)


def _local(execution: ExecutionConfig, tasks: int, quiet: bool) -> Executor:
    workers = min(execution.jobs or cores(), tasks)
    if workers <= 1 and execution.timeout_s is None:
        return Serial()
    return Local(max(workers, 1), execution.timeout_s, quiet)


def _serial(_execution: ExecutionConfig, _tasks: int, _quiet: bool) -> Executor:
    return Serial()


def _dask(execution: ExecutionConfig, _tasks: int, _quiet: bool) -> Executor:
    from shapespace.batch.on_dask import OnDask  # needs the extra

    return OnDask(execution.dask, execution.timeout_s)


EXECUTORS: dict[str, Callable[[ExecutionConfig, int, bool], Executor]] = {
    "local": _local,
    "serial": _serial,
    "dask": _dask,
}
"""Executors by name: functions of the settings, the number of tasks, and whether to be quiet."""
