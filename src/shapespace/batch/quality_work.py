"""Model quality by an executor: its folds and random shapes as tasks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from shapespace.batch.executors import ExecutionConfig, Serial, Shared
from shapespace.errors import FitError
from shapespace.model.model_quality import Part, Shapes
from shapespace.types import FloatArray

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
        with (
            Shared.by(executor, shapes, self.folder) as shared,
            executor.run(QualityWork(shared), parts) as results,
        ):
            for part, (errors, reason) in results:
                if errors is None:
                    raise FitError(f"A part of the measurement could not be done: {reason}; run it with fewer --jobs.")
                yield part, errors


@dataclass(frozen=True)
class QualityWork:
    """Measures parts, for an executor.

    Args:
        shapes: what all parts share.
    """

    shapes: Shared[Shapes]

    def do(self, part: Part) -> tuple[FloatArray | None, str]:
        """Return the errors of one part.

        Raises:
            InputError: the scans do not belong to the surfaces.
        """
        return self.shapes.value().do(part), ""

    def give_up(self, _part: Part, reason: str) -> tuple[FloatArray | None, str]:
        """Return no errors and the reason."""
        return None, reason
