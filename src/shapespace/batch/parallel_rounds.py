"""The tasks of a round of correspondence wherever they run, each kept on disk as soon as it is done."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.batch.execution import ExecutionConfig
from shapespace.batch.executors import Serial
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import Marks
from shapespace.correspondence.place import Placed, PlaceTask, Workbench
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.template import Glance
from shapespace.errors import FileError
from shapespace.io.containers.archives import read_arrays
from shapespace.io.containers.arrays import write_arrays
from shapespace.io.containers.hdf5 import content_hash
from shapespace.io.files import make_folder
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity, SurfaceLandmarks
from shapespace.version import __version__

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class KeptRounds:
    """Does the tasks of a round somewhere; what is done is kept in `folder`, and a like task finds it there.

    Args:
        folder: for what is kept; made if absent.
        where: the tasks are done.
        quiet: whether workers say that code is compiled.
        on_done: told of each task that ends.
    """

    folder: Path
    execution: ExecutionConfig
    quiet: bool
    on_done: Callable[[], None]

    def __call__(self, bench: Workbench, tasks: Sequence[PlaceTask]) -> Iterator[Placed]:
        """Yield what came of each task as it ends.

        Raises:
            FileError: what is done cannot be written.
            FitError: there are no workers, or none any more.
        """
        make_folder(self.folder)
        shared = [_shared_hash(bench, glance) for glance in bench.glances]
        left: list[_KeptTask] = []
        for task in tasks:
            kept = _KeptTask.of(task, self.folder / f"{_key(task, shared[task.glance])}.npz")
            placed = _read(kept.file, task.index)
            if placed is None:
                left.append(kept)
            else:
                self.on_done()
                yield placed
        if not left:
            return
        executor = self.execution.executor(len(left), quiet=self.quiet)
        work = RoundWork(self.folder / f"{content_hash({}, {'shared': ' '.join(shared)})}.bench.npz", bench.seed)
        work.remember(bench)
        if executor is not None:
            work.save(bench)
        with contextlib.closing((executor or Serial()).run(work, left)) as ended:
            for task, _ in ended:
                self.on_done()
                yield _read_again(task)


def _read_again(task: _KeptTask) -> Placed:
    placed = _read(task.file, task.index)
    if placed is None:
        raise FileError(f"Cannot read {task.file}, which this run wrote; run again.")
    return placed


@dataclass(frozen=True)
class _KeptTask:
    """A task as arrays, which reach any process, and the file for what comes of it."""

    file: Path
    arrays: Arrays
    index: int
    glance: int
    settings: ElasticSettings

    @staticmethod
    def of(task: PlaceTask, file: Path) -> _KeptTask:
        return _KeptTask(file, _task_arrays(task), task.index, task.glance, task.settings)

    def task(self) -> PlaceTask:
        arrays = self.arrays
        T = _pose_of(arrays) if "scale" in arrays else None
        scan = Mesh(arrays["vertices"], arrays.get("faces"), name=str(arrays["name"]))
        return PlaceTask(self.index, scan, T, arrays.get("expected"), self.settings, self.glance, _marks_of(arrays))


@dataclass(frozen=True)
class RoundWork:
    """Places scans by one workbench, for an executor.

    Args:
        file: of the workbench, which each worker reads once.
        seed: of the workbench.
    """

    file: Path
    seed: int

    def do(self, task: _KeptTask) -> None:
        """Place a scan and keep what came of it in its file, unless it is there already.

        Raises:
            FileError: it cannot be written.
        """
        if _read(task.file, task.index) is None:
            _write(task.file, self._bench().place(task.task()))

    def give_up(self, task: _KeptTask, reason: str) -> None:
        """Keep in its file what sets a scan aside whose workers were lost.

        Raises:
            FileError: it cannot be written.
        """
        _write(task.file, self._bench().nothing(task.index, reason))

    def remember(self, bench: Workbench) -> None:
        """Keep the workbench for tasks in this process."""
        _benches.clear()
        _benches[self.file] = bench

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
        arrays = {f"{part}.{name}": array for part, told in parts.items() for name, array in told.items()}
        write_arrays(self.file, arrays)

    def _bench(self) -> Workbench:
        if self.file not in _benches:
            self.remember(self._load())
        return _benches[self.file]

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


_benches: dict[Path, Workbench] = {}
"""The workbench of this process, by its file."""


def _model_arrays(m: ShapeModel) -> Arrays:
    return {
        "mean": m.mean, "basis": m.basis, "stddev": m.stddev, "faces": np.array(m.faces),
        "told": np.array([m.total_variance, m.n_training]),
    }  # fmt: skip


def _model_of(arrays: Arrays) -> ShapeModel:
    variance, samples = arrays["told"]
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
        told: Arrays = {
            "vertices": one.vertices, "seen": one.seen, "covered": np.array(one.covered),
            "distance": np.array(one.distance), "seconds": np.array(one.seconds), "reason": np.array(one.reason),
            "mirrored": np.array(one.mirrored), "by_landmarks": np.array(one.by_landmarks),
            **_pose_arrays(one.T_scan_template),
        }  # fmt: skip
        arrays |= {f"{name}_{number}": array for name, array in told.items()}
    write_arrays(file, arrays)


def _read(file: Path, index: int) -> Placed | None:
    """Return what was kept, or None where nothing is or it is damaged."""
    try:
        kept = read_arrays(file, "run again")
        count = sum(name.startswith("vertices_") for name in kept)
        first, *rivals = [_kept_one(kept, number, index) for number in range(count)]
    except (FileError, ValueError, KeyError):
        return None
    return replace(first, rivals=tuple(rivals))


def _kept_one(kept: Mapping[str, npt.NDArray[Any]], number: int, index: int) -> Placed:
    def of(name: str) -> npt.NDArray[Any]:
        return kept[f"{name}_{number}"]

    T = Similarity(float(of("scale")), of("rotation"), of("translation"))
    mean, p95, p99, largest = (float(length) for length in of("distance"))
    return Placed(
        index, np.asarray(of("vertices"), dtype=np.float64), T, np.asarray(of("seen"), dtype=np.bool_),
        float(of("covered")), (mean, p95, p99, largest), float(of("seconds")), str(of("reason")),
        mirrored=float(of("mirrored")), by_landmarks=bool(of("by_landmarks")),
    )  # fmt: skip
