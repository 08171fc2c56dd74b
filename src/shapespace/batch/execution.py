"""Execution settings from the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shapespace.batch.executors import Executor, Local, Serial
from shapespace.batch.workers import cores
from shapespace.errors import InputError


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
