"""The folds and random shapes of a measurement of quality, wherever they run."""

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
from shapespace.io.containers.archives import read_arrays
from shapespace.io.containers.arrays import write_arrays
from shapespace.io.files import make_folder, temporary_folder
from shapespace.model.model_quality import Part, QualitySettings, Shapes
from shapespace.types import FloatArray, Mesh

_AGAIN = "run the command again"
_FEW_VERTICES = 200_000
"""Of all shapes together: these are measured sooner than workers start."""


@dataclass(frozen=True)
class QualityElsewhere:
    """Does the parts of a measurement by an executor.

    Args:
        where: the parts are done.
        folder: that all workers see, for a file with the shapes while they are measured; made if absent.
        quiet: whether workers say that code is compiled.
    """

    execution: ExecutionConfig
    folder: Path
    quiet: bool

    def __call__(self, shapes: Shapes, parts: Sequence[Part]) -> Iterator[tuple[Part, FloatArray]]:
        """Yield what came of each of `parts` as it ends.

        Raises:
            FileError: the shapes cannot be written.
            FitError: there are no workers, or a part was given up.
        """
        few = sum(len(mesh.vertices) for mesh in shapes.meshes) < _FEW_VERTICES
        here = few and self.execution.kind == "local" and not self.execution.jobs
        executor = None if here else self.execution.executor(len(parts), quiet=self.quiet)
        with contextlib.ExitStack() as stack:
            if executor is None:
                work = QualityWork(Path())
            else:
                make_folder(self.folder)
                temporary = stack.enter_context(temporary_folder(self.folder))
                work = QualityWork(temporary / "shapes.npz")
                work.save(shapes)
            work.remember(shapes)
            stack.callback(_shapes.clear)
            done = stack.enter_context(contextlib.closing((executor or Serial()).run(work, parts)))
            for part, (found, reason) in done:
                if found is None:
                    raise FitError(f"A part of the measurement could not be done: {reason}; run it with fewer --jobs.")
                yield part, found


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
            InputError: scans that are not those of the surfaces.
        """
        if self.file not in _shapes:
            self.remember(self._load())
        return _shapes[self.file].do(part), ""

    def give_up(self, _part: Part, reason: str) -> tuple[FloatArray | None, str]:
        """Return why there are none."""
        return None, reason

    def remember(self, shapes: Shapes) -> None:
        """Keep the shapes for parts in this process."""
        _shapes.clear()
        _shapes[self.file] = shapes

    def save(self, shapes: Shapes) -> None:
        """Write the shapes for other processes.

        Raises:
            FileError: they cannot be written.
        """
        settings = asdict(shapes.settings)
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
        told = {key.partition(".")[2]: array for key, array in arrays.items() if key.startswith("setting.")}
        settings = {key: _value(key, array) for key, array in told.items()}
        absent = {key: None for key in ("folds", "modes", "control_points") if key not in settings}
        meshes, scans = _meshes(arrays, "mesh"), _meshes(arrays, "scan")
        return Shapes(meshes, scans or None, QualitySettings(**cast(Any, {**settings, **absent})))


_shapes: dict[Path, Shapes] = {}
"""The shapes of this process, by their file."""


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
