"""Worker processes: a server loads the code once, workers are copies of the server, and a team does many tasks.

This module has no slow imports, so that the server can start before the rest of the program is loaded.

Of all processes of a command, only one prints the message that code is being compiled.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar, cast

from shapespace.errors import FitError
from shapespace.lazy import Defer, call_later

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext, SpawnContext

P = ParamSpec("P")
T = TypeVar("T")
TaskT = TypeVar("TaskT", contravariant=True)
AnswerT = TypeVar("AnswerT", covariant=True)

ATTEMPTS = 2
"""Number of workers that may crash on a task before it is given up."""
GRACE_S = 5.0
"""Time for running tasks to end when a run is stopped, s; a second Ctrl-C ends these at once."""
_STARTS = 3  # consecutive failures to start workers: one may be chance, three are a problem of the machine
_FOREVER = float("inf")
_NO_START = (
    "Worker processes end at their start; use --jobs 1, free some memory, or, in a script, move its main code "
    'under if __name__ == "__main__".'
)

MARK = "SHAPESPACE_MESSAGE_MARK"
"""Environment variable of the server of the workers: path of a folder that the first printing process creates."""


class _Mark:
    path: str = os.environ.get(MARK, "")


def share_mark() -> str:
    """Return the path of the mark that this process shares with its server."""
    if not _Mark.path:
        folder = Path(tempfile.mkdtemp(prefix="shapespace-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _Mark.path = str(folder / "printed")
    return _Mark.path


def remove_mark() -> str:
    """Let this process print independently of others, and return an empty mark."""
    _Mark.path = ""
    return ""


def is_first() -> bool:
    """Return whether this process is the first to print among those with its mark; the next call returns False."""
    if not _Mark.path:
        return True
    try:
        Path(_Mark.path).mkdir()
    except FileExistsError:
        return False
    except OSError:  # the folder was removed or is read-only: print twice rather than never
        return True
    return True


WARM_UP = "SHAPESPACE_WARM_UP"
"""Environment variable of the server: `notify` if it may report compilation on standard error, else `quiet`."""
COPIED = sys.platform == "linux"
"""Whether workers are copies of one server. Apple's BLAS does not support fork, and Windows has no fork."""
_WARM = "shapespace.batch.warm"  # loads the code of a fit; imports this module
DRAWING = (
    "shapespace.report.pages.page",
    *(f"shapespace.report.figures.{name}" for name in ("fit_figures", "model_figures", "population_figures")),
    "shapespace.report.figures.first_figure",
)
"""Modules of processes that draw figures of fits."""
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def context() -> ForkServerContext | SpawnContext:
    """Return the start method of workers: copies of a warm server on Linux, new processes elsewhere."""
    return multiprocessing.get_context("forkserver") if COPIED else multiprocessing.get_context("spawn")


def start_loading(*modules: str, notify: bool) -> None:
    """Load the code of the workers in the background; for workers that are new processes, compile it if needed.

    Args:
        modules: names of further modules of the workers.
        notify: whether a line on standard error may state that the code is being compiled.
    """
    mark = share_mark() if notify else remove_mark()
    if not COPIED:
        import_module(_WARM).warm_up(notify=notify)
        return
    preload((_WARM, *modules), {WARM_UP: "notify" if notify else "quiet", MARK: mark})


def preload(modules: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    """Import `modules` in the background for workers that are copies of a server; do nothing for other workers.

    Args:
        modules: names of the modules.
        environment: environment variables of the server only.
    """
    if not COPIED:
        return
    from multiprocessing import forkserver  # not on Windows

    # One worker uses one core; threads of BLAS would use all cores.
    wanted = dict.fromkeys(_BLAS_THREADS, "1") | dict(environment or {})
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        with interrupts_ignored():
            forkserver.set_forkserver_preload(list(modules))
            forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def deferred_calls(*modules: str) -> Generator[Defer]:
    """Yield a function that starts calls in other processes, one per core, which end at the end of the block.

    A process that ends early, as for want of memory, leaves its calls to this process, as does a single core.

    Args:
        modules: names of modules of the calls, which are imported in the background.
    """
    if cores() < 2:
        yield call_later
        return
    from concurrent.futures import BrokenExecutor, ProcessPoolExecutor

    def defer(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Callable[[], T]:
        try:
            future = pool.submit(function, *args, **kwargs)
        except (BrokenExecutor, EOFError, OSError):
            return call_later(function, *args, **kwargs)

        def wait_for_result() -> T:
            try:
                return future.result()
            except BrokenExecutor:
                return function(*args, **kwargs)

        return wait_for_result

    preload(modules)
    with life_line() as life:
        pool = ProcessPoolExecutor(cores(), context(), initializer=_start_in_pool, initargs=(life,))
        try:
            yield defer
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start_in_pool(life: Connection) -> None:
    """Ignore Ctrl-C, end with the life line, and use one core."""
    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_after(lambda: life.poll(None))
    threadpool_limits(1)


def wait_until_loaded() -> None:
    """Wait until workers can start without delay; Ctrl-C interrupts the wait.

    Raises:
        FitError: no process can be started.
    """
    if not COPIED:
        return
    try:
        first = context().Process(target=_do_nothing)
        with _children_allowed():
            first.start()
        first.join()
    except (EOFError, OSError) as error:
        raise FitError("The system cannot start worker processes; fit with --jobs 1.") from error


def _do_nothing() -> None:
    pass


class Worker:
    """A process that receives one task after the other through its own pipe.

    Args:
        serve: function of the process, called with its end of the pipe and `arguments`; it sends `()` when it is ready.
        arguments: further arguments of `serve`.
        life: connection from `life_line`; the process ends when it is closed.

    Raises:
        FitError: no process can be started.
    """

    def __init__(self, serve: Callable[..., None], arguments: tuple[Any, ...], life: Connection) -> None:
        self.line, theirs = context().Pipe()
        self._process = context().Process(target=_run_worker, args=(serve, theirs, life, arguments), daemon=True)
        try:
            with interrupts_ignored(), _children_allowed():
                self._process.start()
        except (EOFError, OSError) as error:
            raise FitError("The system cannot start worker processes; use --jobs 1.") from error
        finally:
            theirs.close()

    def give(self, task: object) -> None:
        """Send a task; if the worker has crashed, `answer` returns None."""
        with contextlib.suppress(OSError):
            self.line.send(task)

    def answer(self) -> Any:
        """Return the tuple that the worker sent, `()` if it is ready, or None if nothing has arrived or can arrive."""
        try:
            return self.line.recv() if self.line.poll() else None
        except (EOFError, OSError):
            return None

    def stop(self) -> int:
        """End the worker at once if it is running, and return its exit code, negative for a signal."""
        self._process.kill()
        self._process.join()
        self.line.close()
        code = self._process.exitcode
        self._process.close()
        return 0 if code is None else code


@contextlib.contextmanager
def life_line() -> Generator[Connection]:
    """Yield a connection that closes at the end of this block or process, since no other process has its other end."""
    life, ours = context().Pipe(duplex=False)
    try:
        yield life
    finally:
        ours.close()
        life.close()


@contextlib.contextmanager
def _children_allowed() -> Generator[None]:
    """Allow workers of Dask, which are daemons, to have children; the life line ends the children with their parent."""
    config: dict[str, Any] = cast(Any, multiprocessing.current_process())._config
    daemon = config.pop("daemon", None)
    try:
        yield
    finally:
        if daemon is not None:
            config["daemon"] = daemon


def end_after(wait: Callable[[], object]) -> None:
    """End this process when `wait` returns, which waits for the end of the parent process."""

    def end() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def _run_worker(serve: Callable[..., None], line: Connection, life: Connection, arguments: tuple[Any, ...]) -> None:
    end_after(lambda: life.poll(None))
    serve(line, *arguments)


@contextlib.contextmanager
def interrupts_ignored() -> Generator[None]:
    """Let processes that start in this block ignore Ctrl-C, because the parent process stops them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class Work(Protocol[TaskT, AnswerT]):
    """A function that is called with each task, and its data; frozen and small, because it is sent to every worker.

    It refers to shared data of the tasks by path or hash; `do` loads these data once in each process (`Shared`,
    `LatestValue`).
    """

    def do(self, task: TaskT, /) -> AnswerT:
        """Do one task; an error of the task itself is part of the answer.

        Raises:
            ShapespaceError: an error that also affects all other tasks, such as a full disk.
        """
        ...

    def give_up(self, task: TaskT, reason: str, /) -> AnswerT:
        """Return the answer for a task that could not be done; `do` in the same run then returns it too."""
        ...


@dataclass
class _Assignment:
    """Number of the task of a worker, None while it starts or waits for a task, and the deadline of the task."""

    number: int | None = None
    deadline: float = _FOREVER


class Team:
    """Worker processes that are started when needed and reused for further tasks; each has its own pipe.

    Args:
        work: function of each task and its data.
        size: largest number of workers.
        timeout_s: time limit of a task, s, after which it is given up; None for no limit.
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
        self._stack = contextlib.ExitStack()
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
            for worker in self._wait_for_workers():
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
        """Wait up to `GRACE_S` for running tasks, then end every worker."""
        try:
            deadline = time.monotonic() + GRACE_S
            running = {worker.line for worker, given in self._assignments.items() if given.number is not None}
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

    def _wait_for_workers(self) -> list[Worker]:
        """Wait for workers, and return those that have answered, crashed, or exceeded the time limit."""
        first = min(given.deadline for given in self._assignments.values())
        timeout_s = None if first == _FOREVER else max(0.0, first - time.monotonic())
        lines = set(wait([worker.line for worker in self._assignments], timeout_s))
        now = time.monotonic()
        return [worker for worker, given in self._assignments.items() if worker.line in lines or now >= given.deadline]


def _reason_of_death(code: int, late_s: float | None) -> str:
    """Return the reason why a worker did not answer, from its exit code or the time limit of its task."""
    if late_s is not None:
        return f"it took more than the {late_s:g} s of --set timeout"
    cause = f"by signal {-code}" if code < 0 else f"with exit code {code}"
    return f"its worker ended {cause}, {ATTEMPTS} times, probably for lack of memory; decimate it, or use fewer --jobs"


def _serve(line: Connection, work: Work[Any, Any]) -> None:
    """Do the tasks that arrive on `line` until it closes; this runs in the worker process."""
    from threadpoolctl import threadpool_limits

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
