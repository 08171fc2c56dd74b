"""The tasks of a round of correspondence on several cores, each kept on disk as soon as it is done."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from shapespace.batch.workers import context, interrupts_ignored, start_loading, wait_until_loaded
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmarks import Marks, Places
from shapespace.correspondence.place import Placed, PlaceTask, Workbench
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.template import Glance
from shapespace.errors import FitError
from shapespace.io.files import atomic_path, make_folder
from shapespace.io.hdf5 import content_hash
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity
from shapespace.version import __version__

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class KeptRounds:
    """Does the tasks of a round on `jobs` cores; what is done is kept in `folder`, and a like task finds it there.

    Args:
        folder: for what is kept; made if absent.
        jobs: at a time; 1 does them in this process.
        quiet: whether workers say that code is compiled.
        on_done: told of each task that ends.
    """

    folder: Path
    jobs: int
    quiet: bool
    on_done: Callable[[], None]

    def __call__(self, bench: Workbench, tasks: Sequence[PlaceTask]) -> Iterator[Placed]:
        """Yield what came of each task as it ends.

        Raises:
            FileError: what is done cannot be written.
            FitError: a worker was stopped from outside.
        """
        make_folder(self.folder)
        shared = [_shared_hash(bench, glance) for glance in bench.glances]
        left: list[tuple[PlaceTask, Path]] = []
        for task in tasks:
            file = self.folder / f"{_key(task, shared[task.glance])}.npz"
            placed = _read(file, task.index)
            if placed is None:
                left.append((task, file))
            else:
                self.on_done()
                yield placed
        if not left:
            return
        workers = min(self.jobs, len(left))
        ended = self._elsewhere(bench, left, workers) if workers > 1 else self._here(bench, left)
        with contextlib.closing(ended):
            for placed in ended:
                self.on_done()
                yield placed

    def _here(self, bench: Workbench, left: Sequence[tuple[PlaceTask, Path]]) -> Generator[Placed]:
        for task, file in left:
            placed = bench.place(task)
            _write(file, placed)
            yield placed

    def _elsewhere(self, bench: Workbench, left: Sequence[tuple[PlaceTask, Path]], workers: int) -> Generator[Placed]:
        start_loading(tell=not self.quiet)
        wait_until_loaded()
        guide = None if bench.guide is None else _model_arrays(bench.guide)
        glances = [_model_arrays(glance.model) for glance in bench.glances]
        shared = (_bench_arrays(bench), glances, guide, bench.seed)
        with ProcessPoolExecutor(
            workers,
            mp_context=context(),
            initializer=_begin,
            initargs=shared,
        ) as pool:
            with interrupts_ignored():
                futures = [
                    pool.submit(_do, _task_arrays(task), task.index, task.glance, asdict(task.settings), file)
                    for task, file in left
                ]
            try:
                for future in as_completed(futures):
                    try:
                        yield future.result()
                    except BrokenExecutor as error:
                        raise FitError(
                            "A worker was stopped from outside, most likely for lack of memory; run the same command "
                            "again with fewer --jobs."
                        ) from error
            finally:
                wait([future for future in futures if not future.cancel()])


_bench: Workbench | None = None


def _begin(arrays: Arrays, glances: Sequence[Arrays], guide: Arrays | None, seed: int) -> None:
    global _bench
    threadpool_limits(1)
    mesh = Mesh(arrays["vertices"], arrays["faces"])
    harmonics = Harmonics(arrays["functions"], arrays["squared_frequency"], arrays["area"])
    looks = tuple(Glance(_model_of(glance)) for glance in glances)
    _bench = Workbench(mesh, harmonics, looks, seed, None if guide is None else _model_of(guide))


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


def _do(arrays: Arrays, index: int, glance: int, settings: dict[str, Any], file: Path) -> Placed:
    assert _bench is not None
    T = _pose_of(arrays) if "scale" in arrays else None
    scan = Mesh(arrays["vertices"], arrays.get("faces"), name=str(arrays["name"]))
    task = PlaceTask(
        index, scan, T, arrays.get("expected"), ElasticSettings(**settings), glance, _marks_of(arrays)
    )  # fmt: skip
    placed = _bench.place(task)
    _write(file, placed)
    return placed


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
            "mark_weights": marks.places.weights, "mark_uncertainty": np.array(marks.uncertainty),
        }  # fmt: skip
    return arrays


def _marks_of(arrays: Arrays) -> Marks | None:
    if "marks" not in arrays:
        return None
    places = Places(tuple(map(str, arrays["mark_names"])), arrays["mark_corners"], arrays["mark_weights"])
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
    with atomic_path(file) as path, path.open("wb") as stream:
        np.savez(stream, **cast(dict[str, Any], arrays))


def _read(file: Path, index: int) -> Placed | None:
    """Return what was kept, or None where nothing is or it is damaged."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as kept:
            count = sum(name.startswith("vertices_") for name in kept.files)
            first, *rivals = [_kept_one(kept, number, index) for number in range(count)]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
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
