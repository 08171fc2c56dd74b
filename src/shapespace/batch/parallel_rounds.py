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
from shapespace.correspondence.landmark_guide import ScanLandmarks
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.registration import (
    Comparison,
    PoseScores,
    RegistrationTask,
    RoundContext,
    ScanRegistration,
)
from shapespace.correspondence.settings import PoseRange
from shapespace.correspondence.template import PoseModel
from shapespace.errors import FileError
from shapespace.io.containers.archives import read_arrays
from shapespace.io.containers.arrays import write_arrays
from shapespace.io.containers.hdf5 import content_hash
from shapespace.io.files import make_folder
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

    def __call__(self, context: RoundContext, tasks: Sequence[RegistrationTask]) -> Iterator[ScanRegistration]:
        """Yield what came of each task as it ends.

        Raises:
            FileError: a result cannot be written.
            FitError: no workers are left, or none can start.
        """
        make_folder(self.folder)
        shared = [_shared_hash(context, pose_model) for pose_model in context.pose_models]
        remaining: list[_FileTask] = []
        for task in tasks:
            file_task = _FileTask.of(task, self.folder / f"{_key(task, shared[task.pose_model])}.npz")
            placed = _read(file_task.file, task.index)
            if placed is None:
                remaining.append(file_task)
            else:
                self.on_done()
                yield placed
        if not remaining:
            return
        executor = self.execution.executor(len(remaining), quiet=self.quiet)
        work = RoundWork(self.folder / f"{content_hash({}, {'shared': ' '.join(shared)})}.context.npz", context.seed)
        _context.set(work.file, context)
        if not isinstance(executor, Serial):
            work.save(context)
        with executor.run(work, remaining) as results:
            for task, _ in results:
                self.on_done()
                yield _read_again(task)


def _read_again(task: _FileTask) -> ScanRegistration:
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
    pose_model: int
    settings: ElasticSettings
    mirrored: bool
    sides: Comparison
    pose: PoseRange
    bent: bool

    @staticmethod
    def of(task: RegistrationTask, file: Path) -> _FileTask:
        return _FileTask(
            file, _task_arrays(task), task.index, task.pose_model, task.settings, task.mirrored, task.sides, task.pose,
            task.bent,
        )  # fmt: skip

    def task(self) -> RegistrationTask:
        arrays = self.arrays
        T = _pose_of(arrays) if "scale" in arrays else None
        scan = Mesh(arrays["vertices"], arrays.get("faces"), name=str(arrays["name"]))
        return RegistrationTask(
            index=self.index,
            scan=scan,
            T_scan_template=T,
            expected=arrays.get("expected"),
            settings=self.settings,
            pose_model=self.pose_model,
            landmarks=_landmarks_of(arrays),
            mirrored=self.mirrored,
            sides=self.sides,
            pose=self.pose,
            other_pose=_pose_of(arrays, "other_") if "other_scale" in arrays else None,
            bent=self.bent,
        )


@dataclass(frozen=True)
class RoundWork:
    """Registers scans in one round context, for an executor.

    Args:
        file: of the round context, which each worker reads once.
        seed: of the round context.
    """

    file: Path
    seed: int

    def do(self, task: _FileTask) -> None:
        """Register a scan and write the result, unless it is there already.

        Raises:
            FileError: it cannot be written.
        """
        if _read(task.file, task.index) is None:
            _write(task.file, _context.get(self.file, self._load).register(task.task()))

    def give_up(self, task: _FileTask, reason: str) -> None:
        """Write the result that excludes a scan whose workers were lost.

        Raises:
            FileError: it cannot be written.
        """
        _write(task.file, _context.get(self.file, self._load).failed(task.index, reason))

    def save(self, context: RoundContext) -> None:
        """Write the round context for other processes, if an earlier run has not.

        Raises:
            FileError: it cannot be written.
        """
        if self.file.is_file():
            return
        models = {f"pose_model_{number}": one.model for number, one in enumerate(context.pose_models)}
        models |= {} if context.guide is None else {"guide": context.guide}
        parts = {"context": _context_arrays(context)} | {name: _model_arrays(model) for name, model in models.items()}
        arrays = {f"{part}.{name}": array for part, content in parts.items() for name, array in content.items()}
        write_arrays(self.file, arrays)

    def _load(self) -> RoundContext:
        parts: dict[str, Arrays] = {}
        for key, array in read_arrays(self.file, "remove it and run again").items():
            part, _, name = key.partition(".")
            parts.setdefault(part, {})[name] = array
        arrays = parts.pop("context")
        guide = parts.pop("guide", None)
        mesh = Mesh(arrays["vertices"], arrays["faces"])
        harmonics = Harmonics(arrays["functions"], arrays["squared_frequency"], arrays["area"])
        pose_models = tuple(PoseModel(_model_of(parts[f"pose_model_{number}"])) for number in range(len(parts)))
        return RoundContext(mesh, harmonics, pose_models, self.seed, None if guide is None else _model_of(guide))


_context = LatestValue[RoundContext]()
"""The round context that this process uses, by its file."""


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


def _context_arrays(context: RoundContext) -> Arrays:
    h = context.harmonics
    return {
        "vertices": np.array(context.mesh.vertices), "faces": np.array(context.mesh.faces), "functions": h.functions,
        "squared_frequency": h.squared_frequency, "area": h.area,
    }  # fmt: skip


def _task_arrays(task: RegistrationTask) -> Arrays:
    arrays: Arrays = {"vertices": np.array(task.scan.vertices), "name": np.array(task.scan.name)}
    if task.scan.faces is not None:
        arrays["faces"] = np.array(task.scan.faces)
    if task.T_scan_template is not None:
        arrays |= _pose_arrays(task.T_scan_template)
    if task.other_pose is not None:
        arrays |= {f"other_{name}": array for name, array in _pose_arrays(task.other_pose).items()}
    if task.expected is not None:
        arrays["expected"] = task.expected
    if (landmarks := task.landmarks) is not None:
        arrays |= {
            "landmarks": landmarks.points, "landmark_names": np.array(landmarks.places.names),
            "landmark_corners": landmarks.places.corners, "landmark_weights": landmarks.places.barycentric,
            "landmark_uncertainty": np.array(landmarks.uncertainty),
        }  # fmt: skip
    return arrays


def _landmarks_of(arrays: Arrays) -> ScanLandmarks | None:
    if "landmarks" not in arrays:
        return None
    places = SurfaceLandmarks(
        tuple(map(str, arrays["landmark_names"])), arrays["landmark_corners"], arrays["landmark_weights"]
    )
    return ScanLandmarks(places, arrays["landmarks"], float(arrays["landmark_uncertainty"]))


def _pose_arrays(T: Similarity) -> Arrays:
    return {"scale": np.array(T.scale), "rotation": np.array(T.rotation), "translation": np.array(T.translation)}


def _pose_of(arrays: Mapping[str, npt.NDArray[Any]], prefix: str = "") -> Similarity:
    scale, rotation, translation = (arrays[f"{prefix}{name}"] for name in ("scale", "rotation", "translation"))
    return Similarity(float(scale), rotation, translation)


def _shared_hash(context: RoundContext, pose_model: PoseModel) -> str:
    """Return the hash of what the tasks that use `pose_model` share."""
    template = {"template": np.array(context.mesh.vertices), "triangles": np.array(context.mesh.faces)}
    guide = "" if context.guide is None else context.guide.content_hash
    return content_hash(_model_arrays(pose_model.model) | template, {"seed": context.seed, "guide": guide})


def _key(task: RegistrationTask, shared: str) -> str:
    settings = f"{task.settings} {task.mirrored} {task.sides} {task.pose} {task.bent}"
    return content_hash(_task_arrays(task), {"shared": shared, "settings": settings, "version": __version__})


def _write(file: Path, placed: ScanRegistration) -> None:
    arrays: Arrays = {}
    for number, one in enumerate((placed, *placed.alternatives)):
        result: Arrays = {
            "vertices": one.vertices, "observed": one.observed, "covered": np.array(one.covered),
            "distance": np.array(one.distance), "cpu_s": np.array(one.cpu_s), "reason": np.array(one.reason),
            "mirrored": np.array(one.mirrored), "scores": np.array(one.scores),
            "posed_by_landmarks": np.array(one.posed_by_landmarks), "stretch": np.array(one.stretch),
            "bent": np.array(one.bent),
            **_pose_arrays(one.T_scan_template),
        }  # fmt: skip
        arrays |= {f"{name}_{number}": array for name, array in result.items()}
    write_arrays(file, arrays)


def _read(file: Path, index: int) -> ScanRegistration | None:
    """Return the stored result, or None if there is none or it is damaged."""
    try:
        stored = read_arrays(file, "run again")
        count = sum(name.startswith("vertices_") for name in stored)
        first, *alternatives = [_read_one(stored, number, index) for number in range(count)]
    except (FileError, ValueError, KeyError):
        return None
    return replace(first, alternatives=tuple(alternatives))


def _read_one(stored: Mapping[str, npt.NDArray[Any]], number: int, index: int) -> ScanRegistration:
    def of(name: str) -> npt.NDArray[Any]:
        return stored[f"{name}_{number}"]

    T = Similarity(float(of("scale")), of("rotation"), of("translation"))
    mean, p95, p99, largest = (float(length) for length in of("distance"))
    return ScanRegistration(
        index=index,
        vertices=np.asarray(of("vertices"), dtype=np.float64),
        T_scan_template=T,
        observed=np.asarray(of("observed"), dtype=np.bool_),
        covered=float(of("covered")),
        distance=(mean, p95, p99, largest),
        cpu_s=float(of("cpu_s")),
        reason=str(of("reason")),
        mirrored=bool(of("mirrored")),
        scores=PoseScores(*(float(score) for score in of("scores"))),
        posed_by_landmarks=bool(of("posed_by_landmarks")),
        stretch=float(of("stretch")),
        bent=bool(of("bent")),
    )
