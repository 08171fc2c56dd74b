"""Where the tasks of a command run, as a user says it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shapespace.batch.executors import Executor, Local
from shapespace.batch.workers import cores
from shapespace.errors import InputError


@dataclass(frozen=True)
class ExecutionConfig:
    """Where tasks run.

    Args:
        kind: a name of `EXECUTORS`.
        jobs: at a time; 0 for one a core. A cluster has as many as it has workers.
        timeout_s: a task that takes longer is given up; None for no limit.
        dask: address of a Dask scheduler, a scheduler file, or empty for a cluster as Dask's configuration has it.

    Raises:
        InputError: there is no such kind, or it cannot do what is asked.
    """

    kind: str = "local"
    jobs: int = 0
    timeout_s: float | None = None
    dask: str = ""

    def __post_init__(self) -> None:
        if self.kind not in EXECUTORS:
            raise InputError(f"There is no executor {self.kind!r}; use one of {', '.join(EXECUTORS)}.")
        if self.dask and self.kind != "dask":
            raise InputError(f"A Dask scheduler is for --executor dask, not {self.kind}; leave out one of them.")
        if self.kind == "serial" and self.timeout_s is not None:
            raise InputError("--executor serial cannot stop a scan that hangs; leave out --timeout or --executor.")

    def executor(self, tasks: int, *, quiet: bool = True) -> Executor | None:
        """Return what does as many tasks; None for one after the other in this process.

        Args:
            tasks: how many there are.
            quiet: whether workers say nothing of compiling.
        """
        return EXECUTORS[self.kind](self, tasks, quiet)


def _local(execution: ExecutionConfig, tasks: int, quiet: bool) -> Executor | None:
    workers = min(execution.jobs or cores(), tasks)
    return None if workers <= 1 and execution.timeout_s is None else Local(max(workers, 1), execution.timeout_s, quiet)


def _serial(_execution_config: ExecutionConfig, _tasks: int, _quiet: bool) -> None:
    return None


def _dask(execution: ExecutionConfig, _tasks: int, _quiet: bool) -> Executor:
    from shapespace.batch.on_dask import OnDask  # needs the extra

    return OnDask(execution.dask, execution.timeout_s)


EXECUTORS: dict[str, Callable[[ExecutionConfig, int, bool], Executor | None]] = {
    "local": _local,
    "serial": _serial,
    "dask": _dask,
}
"""Executors by name: each made of where, how many tasks there are, and whether to be quiet."""
