"""Correspondence by an executor: the tasks of a round, whose results are stored as soon as they are computed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.batch.execution import ExecutionConfig
from shapespace.batch.executors import Serial
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmarks import Marks
from shapespace.correspondence.place import Placed, PlaceTask, Workbench
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.template import Glance
from shapespace.errors import FileError
from shapespace.io.archives import read_arrays
from shapespace.io.arrays import write_arrays
from shapespace.io.files import make_folder
from shapespace.io.hdf5 import content_hash
from shapespace.io.memory_cache import LatestValue
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity, SurfaceLandmarks
from shapespace.version import __version__

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class RoundRunner:
    """Runs the tasks of a round by an executor; results are stored in `folder`, and equal tasks reuse them.

    Args:
        folder: of the stored results; made if absent.
        execution: where tasks run.
        quiet: whether workers do not report that code is compiled.
        on_done: called after each task.
    """

    folder: Path
    execution: ExecutionConfig
    quiet: bool
    on_done: Callable[[], None]

    def __call__(self, bench: Workbench, tasks: Sequence[PlaceTask]) -> Iterator[Placed]:
        """Yield the result of each task, in any order.

        Raises:
            FileError: a result cannot be written.
            FitError: no workers are left, or none can start.
        """
        make_folder(self.folder)
        shared = [_shared_hash(bench, glance) for glance in bench.glances]
        remaining: list[_FileTask] = []
        for task in tasks:
            file_task = _FileTask.of(task, self.folder / f"{_key(task, shared[task.glance])}.npz")
            placed = _read(file_task.file, task.index)
            if placed is None:
                remaining.append(file_task)
            else:
                self.on_done()
                yield placed
        if not remaining:
            return
        executor = self.execution.executor(len(remaining), quiet=self.quiet)
        work = RoundWork(self.folder / f"{content_hash({}, {'shared': ' '.join(shared)})}.bench.npz", bench.seed)
        _bench.set(work.file, bench)
        if not isinstance(executor, Serial):
            work.save(bench)
        with executor.run(work, remaining) as results:
            for task, _ in results:
                self.on_done()
                yield _read_again(task)


def _read_again(task: _FileTask) -> Placed:
    placed = _read(task.file, task.index)
    if placed is None:
        raise FileError(f"Cannot read {task.file}, which this run wrote; run again.")
    return placed


@dataclass(frozen=True)
class _FileTask:
    """A task as arrays, which can be sent to any process, and the file of its result."""

    file: Path
    arrays: Arrays
    index: int
    glance: int
    settings: ElasticSettings

    @staticmethod
    def of(task: PlaceTask, file: Path) -> _FileTask:
        return _FileTask(file, _task_arrays(task), task.index, task.glance, task.settings)

    def task(self) -> PlaceTask:
        arrays = self.arrays
        T = _pose_of(arrays) if "scale" in arrays else None
        scan = Mesh(arrays["vertices"], arrays.get("faces"), name=str(arrays["name"]))
        return PlaceTask(self.index, scan, T, arrays.get("expected"), self.settings, self.glance, _marks_of(arrays))


@dataclass(frozen=True)
class RoundWork:
    """Registers scans by one workbench, for an executor.

    Args:
        file: of the workbench, which each worker reads once.
        seed: of the workbench.
    """

    file: Path
    seed: int

    def do(self, task: _FileTask) -> None:
        """Register a scan and write the result, unless it is there already.

        Raises:
            FileError: it cannot be written.
        """
        if _read(task.file, task.index) is None:
            _write(task.file, _bench.get(self.file, self._load).place(task.task()))

    def give_up(self, task: _FileTask, reason: str) -> None:
        """Write the result that excludes a scan whose workers were lost.

        Raises:
            FileError: it cannot be written.
        """
        _write(task.file, _bench.get(self.file, self._load).nothing(task.index, reason))

    def save(self, bench: Workbench) -> None:
        """Write the workbench for other processes, if an earlier run has not.

        Raises:
            FileError: it cannot be written.
        """
        if self.file.is_file():
            return
        models = {f"glance_{number}": glance.model for number, glance in enumerate(bench.glances)}
        models |= {} if bench.guide is None else {"guide": bench.guide}
        parts = {"bench": _bench_arrays(bench)} | {name: _model_arrays(model) for name, model in models.items()}
        arrays = {f"{part}.{name}": array for part, content in parts.items() for name, array in content.items()}
        write_arrays(self.file, arrays)

    def _load(self) -> Workbench:
        parts: dict[str, Arrays] = {}
        for key, array in read_arrays(self.file, "remove it and run again").items():
            part, _, name = key.partition(".")
            parts.setdefault(part, {})[name] = array
        arrays = parts.pop("bench")
        guide = parts.pop("guide", None)
        mesh = Mesh(arrays["vertices"], arrays["faces"])
        harmonics = Harmonics(arrays["functions"], arrays["squared_frequency"], arrays["area"])
        glances = tuple(Glance(_model_of(parts[f"glance_{number}"])) for number in range(len(parts)))
        return Workbench(mesh, harmonics, glances, self.seed, None if guide is None else _model_of(guide))


_bench = LatestValue[Workbench]()
"""The workbench that this process uses, by its file."""


def _model_arrays(m: ShapeModel) -> Arrays:
    return {
        "mean": m.mean, "basis": m.basis, "stddev": m.stddev, "faces": np.array(m.faces),
        "statistics": np.array([m.total_variance, m.n_training]),
    }  # fmt: skip


def _model_of(arrays: Arrays) -> ShapeModel:
    variance, samples = arrays["statistics"]
    return ShapeModel(
        arrays["mean"], arrays["basis"], arrays["stddev"], float(variance), int(samples), faces=arrays["faces"]
    )


def _bench_arrays(bench: Workbench) -> Arrays:
    h = bench.harmonics
    return {
        "vertices": np.array(bench.mesh.vertices), "faces": np.array(bench.mesh.faces), "functions": h.functions,
        "squared_frequency": h.squared_frequency, "area": h.area,
    }  # fmt: skip


def _task_arrays(task: PlaceTask) -> Arrays:
    arrays: Arrays = {"vertices": np.array(task.scan.vertices), "name": np.array(task.scan.name)}
    if task.scan.faces is not None:
        arrays["faces"] = np.array(task.scan.faces)
    if task.T_scan_template is not None:
        arrays |= _pose_arrays(task.T_scan_template)
    if task.expected is not None:
        arrays["expected"] = task.expected
    if (marks := task.marks) is not None:
        arrays |= {
            "marks": marks.points, "mark_names": np.array(marks.places.names), "mark_corners": marks.places.corners,
            "mark_weights": marks.places.barycentric, "mark_uncertainty": np.array(marks.uncertainty),
        }  # fmt: skip
    return arrays


def _marks_of(arrays: Arrays) -> Marks | None:
    if "marks" not in arrays:
        return None
    places = SurfaceLandmarks(tuple(map(str, arrays["mark_names"])), arrays["mark_corners"], arrays["mark_weights"])
    return Marks(places, arrays["marks"], float(arrays["mark_uncertainty"]))


def _pose_arrays(T: Similarity) -> Arrays:
    return {"scale": np.array(T.scale), "rotation": np.array(T.rotation), "translation": np.array(T.translation)}


def _pose_of(arrays: Mapping[str, npt.NDArray[Any]]) -> Similarity:
    return Similarity(float(arrays["scale"]), arrays["rotation"], arrays["translation"])


def _shared_hash(bench: Workbench, glance: Glance) -> str:
    """Return the hash of what the tasks that look through `glance` share."""
    template = {"template": np.array(bench.mesh.vertices), "triangles": np.array(bench.mesh.faces)}
    guide = "" if bench.guide is None else bench.guide.content_hash
    return content_hash(_model_arrays(glance.model) | template, {"seed": bench.seed, "guide": guide})


def _key(task: PlaceTask, shared: str) -> str:
    return content_hash(_task_arrays(task), {"shared": shared, "settings": str(task.settings), "version": __version__})


def _write(file: Path, placed: Placed) -> None:
    arrays: Arrays = {}
    for number, one in enumerate((placed, *placed.rivals)):
        result: Arrays = {
            "vertices": one.vertices, "seen": one.seen, "covered": np.array(one.covered),
            "distance": np.array(one.distance), "seconds": np.array(one.seconds), "reason": np.array(one.reason),
            "mirrored": np.array(one.mirrored), "by_landmarks": np.array(one.by_landmarks),
            **_pose_arrays(one.T_scan_template),
        }  # fmt: skip
        arrays |= {f"{name}_{number}": array for name, array in result.items()}
    write_arrays(file, arrays)


def _read(file: Path, index: int) -> Placed | None:
    """Return the stored result, or None if there is none or it is damaged."""
    try:
        stored = read_arrays(file, "run again")
        count = sum(name.startswith("vertices_") for name in stored)
        first, *rivals = [_read_one(stored, number, index) for number in range(count)]
    except (FileError, ValueError, KeyError):
        return None
    return replace(first, rivals=tuple(rivals))


def _read_one(stored: Mapping[str, npt.NDArray[Any]], number: int, index: int) -> Placed:
    def of(name: str) -> npt.NDArray[Any]:
        return stored[f"{name}_{number}"]

    T = Similarity(float(of("scale")), of("rotation"), of("translation"))
    mean, p95, p99, largest = (float(length) for length in of("distance"))
    return Placed(
        index, np.asarray(of("vertices"), dtype=np.float64), T, np.asarray(of("seen"), dtype=np.bool_),
        float(of("covered")), (mean, p95, p99, largest), float(of("seconds")), str(of("reason")),
        mirrored=float(of("mirrored")), by_landmarks=bool(of("by_landmarks")),
    )  # fmt: skip
