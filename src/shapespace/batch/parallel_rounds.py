"""Correspondence with an executor: tasks of a round, whose results are stored as soon as they are computed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.batch.executors import ExecutionConfig, Shared
from shapespace.correspondence.registration import (
    PoseScores,
    RegistrationTask,
    RoundContext,
    ScanRegistration,
)
from shapespace.correspondence.template import PoseModel
from shapespace.errors import FileError
from shapespace.io.containers.archives import read_arrays, write_arrays
from shapespace.io.containers.hdf5 import content_hash
from shapespace.io.files import make_folder
from shapespace.types import Similarity
from shapespace.version import __version__

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class RoundRunner:
    """Runs the tasks of a round by an executor; results are stored in `folder`, and equal tasks reuse them.

    Args:
        folder: folder of the stored results; it is created if missing.
        execution: execution settings of the tasks.
        quiet: whether workers do not report that code is compiled.
        on_done: function that is called after each task.
    """

    folder: Path
    execution: ExecutionConfig
    quiet: bool
    on_done: Callable[[], None]

    def __call__(self, context: RoundContext, tasks: Sequence[RegistrationTask]) -> Iterator[ScanRegistration]:
        """Yield the result of each task as it ends.

        Raises:
            FileError: a result cannot be written.
            FitError: no workers are left, or none can start.
        """
        make_folder(self.folder)
        shared_hashes = [_shared_hash(context, pose_model) for pose_model in context.pose_models]
        remaining: list[_FileTask] = []
        for task in tasks:
            file_task = _FileTask(self.folder / f"{_key(task, shared_hashes[task.pose_model])}.npz", task)
            placed = _read(file_task.file, task.index)
            if placed is None:
                remaining.append(file_task)
            else:
                self.on_done()
                yield placed
        if not remaining:
            return
        executor = self.execution.executor(len(remaining), quiet=self.quiet)
        with (
            Shared.by(executor, context, self.folder) as shared,
            executor.run(RoundWork(shared), remaining) as results,
        ):
            for task, _ in results:
                self.on_done()
                yield _read_written(task)


def _read_written(task: _FileTask) -> ScanRegistration:
    placed = _read(task.file, task.registration.index)
    if placed is None:
        raise FileError(f"Cannot read {task.file}, which this run wrote; run again.")
    return placed


@dataclass(frozen=True, eq=False)
class _FileTask:
    """A task and the file of its result."""

    file: Path
    registration: RegistrationTask


@dataclass(frozen=True)
class RoundWork:
    """Registers scans in one round context, for an executor.

    Args:
        context: context of the round.
    """

    context: Shared[RoundContext]

    def do(self, task: _FileTask) -> None:
        """Register a scan and write the result, unless it already exists.

        Raises:
            FileError: it cannot be written.
        """
        if _read(task.file, task.registration.index) is None:
            _write(task.file, self.context.value().register(task.registration))

    def give_up(self, task: _FileTask, reason: str) -> None:
        """Write the result that excludes a scan whose workers crashed.

        Raises:
            FileError: it cannot be written.
        """
        _write(task.file, self.context.value().failed(task.registration.index, reason))


def _shared_hash(context: RoundContext, pose_model: PoseModel) -> str:
    """Return the hash of the data that the tasks with `pose_model` share."""
    return content_hash(dict(_flatten(replace(context, pose_models=(pose_model,)), "context")), {})


def _key(task: RegistrationTask, shared: str) -> str:
    anywhere = replace(task, index=0, pose_model=0)  # the result does not depend on the position in the list
    return content_hash(dict(_flatten(anywhere, "task")), {"shared": shared, "version": __version__})


def _flatten(value: object, name: str) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield the name and the array of every item in `value`; all fields of a dataclass are included."""
    if isinstance(value, np.ndarray):
        yield name, cast(npt.NDArray[Any], value)
    elif is_dataclass(value):
        for field in fields(value):
            yield from _flatten(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, Mapping):
        for key, item in cast(Mapping[str, object], value).items():
            yield from _flatten(item, f"{name}.{key}")
    elif isinstance(value, tuple):
        for number, item in enumerate(cast(tuple[object, ...], value)):
            yield from _flatten(item, f"{name}.{number}")
    elif value is not None:
        yield name, np.array(value)


def _write(file: Path, placed: ScanRegistration) -> None:
    several = (placed, *placed.alternatives)
    write_arrays(file, dict(_flatten(tuple(replace(registration, alternatives=()) for registration in several), "")))


def _read(file: Path, index: int) -> ScanRegistration | None:
    """Return the stored result for scan `index`, or None if there is none or it is damaged."""
    try:
        stored: dict[str, Arrays] = {}
        for key, array in read_arrays(file, "run again").items():
            _, number, name = key.split(".", 2)
            stored.setdefault(number, {})[name] = array
        first, *alternatives = [replace(_registration(stored[n]), index=index) for n in sorted(stored, key=int)]
    except (FileError, ValueError, KeyError, TypeError):
        return None
    return replace(first, alternatives=tuple(alternatives))


def _registration(stored: Arrays) -> ScanRegistration:
    """Return the registration from the arrays of `_flatten`; arrays without axes are numbers and texts."""
    parts: dict[str, dict[str, Any]] = {}
    values: dict[str, Any] = {}
    for key, array in stored.items():
        name, _, part = key.partition(".")
        value = array if array.ndim else array.item()
        if part:
            parts.setdefault(name, {})[part] = value
        else:
            values[name] = value
    values["T_scan_template"] = Similarity(**parts["T_scan_template"])
    values["distance"] = tuple(parts["distance"][number] for number in sorted(parts["distance"]))
    values["scores"] = PoseScores(*(parts["scores"][number] for number in sorted(parts["scores"])))
    return ScanRegistration(**values)
