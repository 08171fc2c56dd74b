"""Execution on a Dask cluster: few chunks at a time, repetition of tasks of lost workers, and small answers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from shapespace.batch.progress import tell_after
from shapespace.batch.workers import Team
from shapespace.errors import FitError, InputError, ShapespaceError
from shapespace.version import __version__

if TYPE_CHECKING:
    from distributed import Client

    from shapespace.batch.workers import Work

T = TypeVar("T")
R = TypeVar("R")

CHUNKS_A_WORKER = 50
"""Number of chunks per worker in a run: enough that all workers end at about the same time."""
LARGEST_CHUNK = 50
"""Largest number of tasks in a chunk: few enough that little work is lost with a worker."""
AHEAD = 2
"""Number of waiting chunks per worker in addition to the running one."""
FINDS_S = 30.0
"""Time limit for an answer of the scheduler, s."""
WORKERS_S = 600.0
"""Time limit for a queue to start the first worker, s."""
REPORT_S = 10.0
"""Time without a worker after which a message on standard error names the reason for waiting, s."""
_MOST_NAMED = 5  # workers listed in a message, so that it stays one line
_LOST = "its workers crashed repeatedly, probably for lack of memory; decimate it"


@dataclass(frozen=True)
class OnDask:
    """On a Dask cluster, whose workers see the same files under the same paths.

    Args:
        cluster: address of the scheduler, path of its scheduler file, an open `distributed.Client`, or empty for the
            cluster of Dask's configuration on this machine.
        timeout_s: time limit of a task, s, after which it is given up; None for no limit.
    """

    cluster: str | Client = ""
    timeout_s: float | None = None

    def run(self, work: Work[T, R], tasks: Sequence[T], /) -> AbstractContextManager[Iterator[tuple[T, R]]]:
        """As `Executor.run`."""
        return closing(self._answers(work, tasks))

    def _answers(self, work: Work[T, R], tasks: Sequence[T]) -> Generator[tuple[T, R]]:
        if not tasks:
            return
        with ExitStack() as stack:
            client = self._client(stack)
            yield from _Run(client, work, tasks, self.timeout_s).answers()

    def _client(self, stack: ExitStack) -> Client:
        try:
            from distributed import Client, LocalCluster
        except ImportError as error:
            raise ShapespaceError(
                "A cluster needs the extra 'cluster'; run pip install 'shapespace[cluster]', or omit executor=dask."
            ) from error
        if isinstance(self.cluster, Client):
            return self.cluster
        try:
            if not self.cluster:
                start_cluster: Any = LocalCluster
                return stack.enter_context(
                    Client(stack.enter_context(start_cluster(threads_per_worker=1, dashboard_address="127.0.0.1:0")))
                )
            if self.cluster.endswith(".json"):
                return stack.enter_context(Client(scheduler_file=self.cluster, timeout=FINDS_S))
            return stack.enter_context(Client(self.cluster, timeout=FINDS_S))
        except (OSError, TimeoutError, ValueError) as error:
            location = f"at {self.cluster}" if self.cluster else "on this machine"
            raise InputError(
                f"No Dask scheduler {location} responds; start it, or correct --set dask=ADDRESS."
            ) from error


class _Run:
    """A run of many tasks, which are sent in chunks of task numbers."""

    def __init__(self, client: Client, work: Work[Any, Any], tasks: Sequence[Any], timeout_s: float | None) -> None:
        self._client: Any = client
        self._work, self._tasks, self._timeout_s = work, tasks, timeout_s
        self._flying: dict[Any, Sequence[int]] = {}
        self._suspects: list[int] = []

    def answers(self) -> Generator[tuple[Any, Any]]:
        """Yield each task with its answer.

        Dask attributes the crash of a worker to all tasks that wait there, so these are repeated at the end, one at a
        time.
        """
        workers = self._workers()
        self._check_versions()
        size = max(1, min(LARGEST_CHUNK, len(self._tasks) // (workers * CHUNKS_A_WORKER)))
        chunks = [range(start, min(start + size, len(self._tasks))) for start in range(0, len(self._tasks), size)]
        try:
            yield from self._run_chunks(chunks, (1 + AHEAD) * workers)
            suspects, self._suspects = self._suspects, []
            yield from self._run_chunks([[number] for number in suspects], 1)
            for number in self._suspects:
                yield self._tasks[number], self._work.give_up(self._tasks[number], _LOST)
        finally:
            self._client.cancel(list(self._flying), force=True)

    def _run_chunks(self, chunks: Sequence[Sequence[int]], at_a_time: int) -> Generator[tuple[Any, Any]]:
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        left = iter(chunks)
        ended: Any = as_completed(self._submit(left, at_a_time), raise_errors=False)
        for future in ended:
            if future.status == "lost":  # its worker crashed before sending the answer, and another worker repeats it
                ended.add(future)
                continue
            numbers = self._flying.pop(future)
            if future.status == "cancelled":
                raise FitError("The Dask scheduler is gone; start it and run the same command again to continue.")
            error = future.exception() if future.status == "error" else None
            if isinstance(error, KilledWorker):
                self._suspects.extend(numbers)
            elif error is not None:
                if not isinstance(error, ShapespaceError):
                    # A worker with another version that joined later may fail at any step, such as loading the tasks.
                    self._check_versions()
                raise error
            answers: list[Any] = [] if error is not None else future.result()
            ended.update(self._submit(left, 1))
            for number, answer in zip(numbers, answers, strict=False):
                yield self._tasks[number], answer

    def _submit(self, chunks: Iterator[Sequence[int]], count: int) -> list[Any]:
        """Send up to `count` chunks to the cluster."""
        sent: list[Any] = []
        for _, numbers in zip(range(count), chunks, strict=False):
            tasks = [self._tasks[number] for number in numbers]
            future = self._client.submit(do_chunk, self._work, tasks, self._timeout_s, __version__, pure=False)
            self._flying[future] = numbers
            sent.append(future)
        return sent

    def _workers(self) -> int:
        sentence = (
            f"No Dask worker has connected to the scheduler at {self._client.scheduler.address} yet; waiting up to "
            f"{WORKERS_S:g} s. Start workers with: dask worker {self._client.scheduler.address} --nthreads 1"
        )
        try:
            with tell_after(REPORT_S, sentence):
                self._client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError as error:
            raise FitError(
                f"The Dask cluster has no worker after {WORKERS_S:g} s; start workers and run again."
            ) from error
        return max(1, len(self._client.nthreads()))

    def _check_versions(self) -> None:
        """Check that all workers have the version of shapespace of this process.

        Raises:
            FitError: workers have another version, or shapespace is not installed there.
        """
        versions: Mapping[str, object] = self._client.run(_version_reader(), on_error="return")
        by_version: dict[str, list[str]] = {}
        for address, version in sorted(versions.items()):
            by_version.setdefault(str(version), []).append(address)
        by_version.pop(__version__, None)
        if by_version:
            raise FitError(_other_versions(by_version))


def _version_reader() -> Callable[[], str]:
    """Return a function that determines the version of shapespace at a worker.

    It is a nested function because Dask then sends its code: a worker with another version may not have this module,
    and `Client.get_versions` finds the installed version, not the imported one.
    """

    def version_here() -> str:
        try:
            from shapespace.version import __version__ as version
        except ImportError:
            return "no shapespace"
        return version

    return version_here


def _other_versions(by_version: Mapping[str, Sequence[str]]) -> str:
    others = "; ".join(
        f"{version} at {', '.join(workers[:_MOST_NAMED])}"
        + (f" and {len(workers) - _MOST_NAMED} more" if len(workers) > _MOST_NAMED else "")
        for version, workers in by_version.items()
    )
    return (
        f"This process uses shapespace {__version__}, but Dask workers have another version ({others}); install the "
        "same version on all machines and restart the workers."
    )


def do_chunk(work: Work[Any, R], tasks: Sequence[Any], timeout_s: float | None, version: str) -> list[R]:
    """Do tasks at a worker of Dask, in a child process whose crash does not end the worker.

    Raises:
        FitError: the worker, which may have joined after the check of versions, does not have `version`.
    """
    if version != __version__:
        from distributed import get_worker

        raise FitError(
            f"The command uses shapespace {version}, but the Dask worker {get_worker().address} has {__version__}; "
            "install the same version on both and restart the worker."
        )
    if getattr(_thread, "work", None) != (work, timeout_s):
        if (earlier := getattr(_thread, "team", None)) is not None:
            earlier.close()
        _thread.work, _thread.team = (work, timeout_s), Team(work, 1, timeout_s)
    answers = dict(_thread.team.run(tasks))
    return [answers[number] for number in range(len(tasks))]


_thread = threading.local()
"""Child process of each thread of a worker, as a team with one member, and its work."""
