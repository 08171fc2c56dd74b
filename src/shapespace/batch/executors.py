"""Where tasks run: one after the other here, on the cores of this machine, or on a Dask cluster.

All have one face, `Executor.run`, and one contract: each task is answered once, in whatever order, and a task that its
workers do not survive is given up with a reason while the others go on.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from shapespace.batch.workers import Worker, cores, life_line, start_loading, wait_until_loaded
from shapespace.errors import FitError

T = TypeVar("T")
R = TypeVar("R")
TaskT = TypeVar("TaskT", contravariant=True)
AnswerT = TypeVar("AnswerT", covariant=True)

ATTEMPTS = 2
"""Workers that a task may cost before it is given up."""
GRACE_S = 5.0
"""What runs when a run is stopped may end within this; a second Ctrl-C ends it at once."""
_STARTS = 3
_NO_START = (
    "Worker processes end as they start; use --jobs 1, free some memory, or, in a script of your own, put what it does "
    'under if __name__ == "__main__".'
)


class Work(Protocol[TaskT, AnswerT]):
    """What is done with each of many tasks: frozen, small, and sent to every worker.

    What the tasks share is named by it, by path or hash, and loaded by `do` once a process.
    """

    def do(self, task: TaskT, /) -> AnswerT:
        """Do one task; what is wrong with the task itself is in the answer.

        Raises:
            ShapespaceError: what would stop every other task too, such as a full disk.
        """
        ...

    def give_up(self, task: TaskT, reason: str, /) -> AnswerT:
        """Return what stands for a task that could not be done; `do` of the same run then returns it too."""
        ...


class Executor(Protocol):
    """Does tasks somewhere."""

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> Generator[tuple[T, R]]:
        """Yield each task with what came of it as it ends; closed earlier, it stops what runs.

        Raises:
            FitError: there are no workers, or none any more.
            ShapespaceError: that `work` raised.
        """
        ...


@dataclass(frozen=True)
class Serial:
    """One after the other in this process; a task that hangs is not stopped."""

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> Generator[tuple[T, R]]:
        """As `Executor.run`."""
        for task in tasks:
            yield task, work.do(task)


@dataclass(frozen=True)
class Local:
    """Processes on this machine, each with one thread of BLAS.

    Args:
        workers: how many; 0 for one a core.
        timeout_s: a task that takes longer is given up; None for no limit.
        quiet: whether the first worker keeps from saying that code is compiled.
    """

    workers: int = 0
    timeout_s: float | None = None
    quiet: bool = True

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> Generator[tuple[T, R]]:
        """As `Executor.run`."""
        count = min(self.workers or cores(), len(tasks))
        if not count:
            return
        start_loading(tell=not self.quiet)
        wait_until_loaded()
        with life_line() as life:
            team = _Team(lambda: Worker(_serve, (work,), life), self.timeout_s)
            try:
                with closing(team.run(count, work, tasks)) as ended:
                    yield from ended
            finally:
                team.stop()


@dataclass
class _Doing:
    """What a worker is at: a task by its number, or None while it starts, and until when it may take."""

    number: int | None = None
    until: float = float("inf")


@dataclass
class _Team:
    """Workers and what each is at; each has a line of its own, so that the death of one blocks no other."""

    start: Callable[[], Worker]
    timeout_s: float | None
    _doing: dict[Worker, _Doing] = field(default_factory=dict[Worker, _Doing])
    _failed_starts: int = 0

    def run(self, count: int, work: Work[T, R], tasks: Sequence[T]) -> Generator[tuple[T, R]]:
        left, deaths = deque(range(len(tasks))), [0] * len(tasks)
        for _ in range(count):
            self._hire()
        while self._doing:
            for worker in self._ready():
                was = self._doing[worker]
                answer = worker.answer()
                if answer is not None:
                    self._failed_starts = 0
                    self._next(worker, tasks, left)
                    if was.number is not None:
                        yield tasks[was.number], _value(answer)
                    continue
                death = _Death(self._dismiss(worker), None if time.monotonic() < was.until else self.timeout_s)
                if was.number is None:
                    self._not_started()
                    self._hire()
                    continue
                deaths[was.number] += 1
                again = death.late_s is None and deaths[was.number] < ATTEMPTS
                if again:
                    left.append(was.number)
                if left:
                    self._hire()
                if not again:
                    yield tasks[was.number], work.give_up(tasks[was.number], str(death))

    def _hire(self) -> None:
        self._doing[self.start()] = _Doing()

    def _dismiss(self, worker: Worker) -> int:
        del self._doing[worker]
        return worker.stop()

    def _ready(self) -> list[Worker]:
        """Wait, and return the workers that have answered, died, or taken too long."""
        first = min(what.until for what in self._doing.values())
        patience = None if first == float("inf") else max(0.0, first - time.monotonic())
        lines = set(wait([worker.line for worker in self._doing], patience))
        now = time.monotonic()
        return [worker for worker, what in self._doing.items() if worker.line in lines or now >= what.until]

    def _next(self, worker: Worker, tasks: Sequence[T], left: deque[int]) -> None:
        if not left:
            self._dismiss(worker)
            return
        number = left.popleft()
        until = float("inf") if self.timeout_s is None else time.monotonic() + self.timeout_s
        self._doing[worker] = _Doing(number, until)
        worker.give(tasks[number])

    def _not_started(self) -> None:
        self._failed_starts += 1
        if self._failed_starts >= _STARTS:
            raise FitError(_NO_START)

    def stop(self) -> None:
        """Let what runs end for a moment, then end every worker."""
        try:
            until = time.monotonic() + GRACE_S
            running = {worker.line for worker, what in self._doing.items() if what.number is not None}
            while running and (patience := until - time.monotonic()) > 0:
                running.difference_update(wait(running, patience))
        finally:
            while self._doing:
                self._dismiss(next(iter(self._doing)))


class Child:
    """One worker that is given tasks one at a time, and started again when it dies.

    Args:
        work: what it does.
        timeout_s: a task that takes longer is given up; None for no limit.
    """

    def __init__(self, work: Work[Any, Any], timeout_s: float | None) -> None:
        self._work, self._timeout_s = work, timeout_s
        self._worker: Worker | None = None
        self._life = ExitStack()
        self._line = self._life.enter_context(life_line())

    def do(self, task: Any) -> Any:
        """Return what comes of a task.

        Raises:
            FitError: no process can be started.
            ShapespaceError: that `work` raised.
        """
        for attempt in range(1, ATTEMPTS + 1):
            worker = self._started()
            worker.give(task)
            late = not worker.line.poll(self._timeout_s)
            answer = worker.answer()
            if answer is not None:
                return _value(answer)
            self._worker = None
            death = _Death(worker.stop(), self._timeout_s if late else None)
            if late or attempt == ATTEMPTS:
                return self._work.give_up(task, str(death))
        raise AssertionError

    def stop(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.stop()
        self._life.close()

    def _started(self) -> Worker:
        for _ in range(_STARTS):
            if self._worker is not None:
                return self._worker
            start_loading(tell=False)
            wait_until_loaded()
            worker = Worker(_serve, (self._work,), self._line)
            worker.line.poll(None)
            if worker.answer() is None:
                worker.stop()
            else:
                self._worker = worker
        if self._worker is None:
            raise FitError(_NO_START)
        return self._worker


@dataclass(frozen=True)
class _Death:
    """Why a worker did not answer: its exit code, or the time that it was given."""

    code: int
    late_s: float | None

    def __str__(self) -> str:
        if self.late_s is not None:
            return f"it took more than the {self.late_s:g} s of --timeout"
        how = f"by signal {-self.code}" if self.code < 0 else f"with exit code {self.code}"
        return f"its worker ended {how}, {ATTEMPTS} times, most likely for lack of memory; thin it, or use fewer --jobs"


def _serve(line: Connection, work: Work[Any, Any]) -> None:
    """Do tasks that come by `line` until it ends: what a worker does."""
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
