"""Model quality by an executor: its folds and random shapes as tasks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.batch.execution import ExecutionConfig
from shapespace.batch.executors import Serial
from shapespace.errors import FitError
from shapespace.io.containers.archives import read_arrays, write_arrays
from shapespace.io.files import make_folder, temporary_folder
from shapespace.io.memory_cache import LatestValue
from shapespace.model.model_quality import Part, QualityConfig, Shapes
from shapespace.types import FloatArray, Mesh

_AGAIN = "run the command again"
_FEW_VERTICES = 200_000
"""Of all shapes together: below it, a measurement takes less time than workers to start."""


@dataclass(frozen=True)
class QualityRunner:
    """Runs the parts of a measurement by an executor.

    Args:
        execution: where they run; a small measurement runs in this process unless something else is asked for.
        folder: that all workers see, for a file with the shapes during the measurement; made if absent.
        quiet: whether workers do not report that code is compiled.
    """

    execution: ExecutionConfig
    folder: Path
    quiet: bool

    def __call__(self, shapes: Shapes, parts: Sequence[Part]) -> Iterator[tuple[Part, FloatArray]]:
        """Yield each of `parts` with its errors, in any order.

        Raises:
            FileError: the shapes cannot be written.
            FitError: no workers are left, or a part was given up.
        """
        small = sum(len(mesh.vertices) for mesh in shapes.meshes) < _FEW_VERTICES
        serial = small and self.execution.kind == "local" and not self.execution.jobs
        executor = Serial() if serial else self.execution.executor(len(parts), quiet=self.quiet)
        with contextlib.ExitStack() as stack:
            work = QualityWork(Path())
            if not isinstance(executor, Serial):
                temporary = stack.enter_context(temporary_folder(make_folder(self.folder)))
                work = QualityWork(temporary / "shapes.npz")
                work.save(shapes)
            _shapes.set(work.file, shapes)
            stack.callback(_shapes.clear)
            for part, (errors, reason) in stack.enter_context(executor.run(work, parts)):
                if errors is None:
                    raise FitError(f"A part of the measurement could not be done: {reason}; run it with fewer --jobs.")
                yield part, errors


@dataclass(frozen=True)
class QualityWork:
    """Measures parts, for an executor.

    Args:
        file: of the shapes, which each worker reads once.
    """

    file: Path

    def do(self, part: Part) -> tuple[FloatArray | None, str]:
        """Return the errors of one part.

        Raises:
            InputError: the scans do not belong to the surfaces.
        """
        return _shapes.get(self.file, self._load).do(part), ""

    def give_up(self, _part: Part, reason: str) -> tuple[FloatArray | None, str]:
        """Return no errors and the reason."""
        return None, reason

    def save(self, shapes: Shapes) -> None:
        """Write the shapes for other processes.

        Raises:
            FileError: they cannot be written.
        """
        settings = asdict(shapes.config)
        arrays = {f"setting.{key}": np.array(value) for key, value in settings.items() if value is not None}
        for kind, meshes in (("mesh", shapes.meshes), ("scan", shapes.scans or ())):
            for number, mesh in enumerate(meshes):
                arrays[f"{kind}.{number}.vertices"] = mesh.vertices
                arrays[f"{kind}.{number}.name"] = np.array(mesh.name)
                if mesh.faces is not None and (kind == "scan" or number == 0):
                    arrays[f"{kind}.{number}.faces"] = mesh.faces
        write_arrays(self.file, arrays)

    def _load(self) -> Shapes:
        arrays = read_arrays(self.file, _AGAIN)
        stored = {key.partition(".")[2]: array for key, array in arrays.items() if key.startswith("setting.")}
        settings = {key: _value(key, array) for key, array in stored.items()}
        absent = {key: None for key in ("folds", "modes", "control_points") if key not in settings}
        meshes, scans = _meshes(arrays, "mesh"), _meshes(arrays, "scan")
        return Shapes(meshes, scans or None, QualityConfig(**cast(Any, {**settings, **absent})))


_shapes = LatestValue[Shapes]()
"""The shapes that this process measures, by their file."""


def _value(key: str, array: npt.NDArray[Any]) -> object:
    value: object = array.tolist()
    return tuple(cast(list[int], value)) if key == "control_points" else value


def _meshes(arrays: dict[str, npt.NDArray[Any]], kind: str) -> list[Mesh]:
    out: list[Mesh] = []
    while (vertices := arrays.get(f"{kind}.{len(out)}.vertices")) is not None:
        own = arrays.get(f"{kind}.{len(out)}.faces")
        # Meshes in correspondence share their triangles.
        faces = out[0].faces if own is None and kind == "mesh" and out else own
        out.append(Mesh(vertices, faces, name=str(arrays[f"{kind}.{len(out)}.name"])))
    return out
