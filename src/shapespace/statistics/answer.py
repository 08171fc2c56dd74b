"""An answer as it is kept: analysis.json with the parts of its report, and tables, arrays and meshes beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.io.arrays import write_arrays
from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes import write_mesh
from shapespace.io.tables import write_rows
from shapespace.schemas import Analysis, Methods, Part, Target, json_text
from shapespace.types import Mesh
from shapespace.version import __version__

Rows = tuple[Sequence[str], Sequence[Sequence[object]]]
"""The header of a table, and its rows."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What an analysis found, ready to be kept.

    Args:
        question: the command that asks it.
        title: of its report.
        summary: sentences that say what was found, what matters first.
        parts: of its report; they name arrays and meshes by their files.
        tables: file name (.csv) -> header and rows.
        arrays: file name (.npz) -> arrays by name.
        meshes: file name (.ply) -> mesh.
        targets: what was aimed at, of benchmarks.
        notes: who was left out and why, a sentence each.
        settings: all that the result depends on, seeds among it.
        model_hashes: of the models of the fits.
        methods: sample sizes, tests and assumptions, which the last parts state in words; None of predictions alone.
    """

    question: str
    title: str
    summary: tuple[str, ...]
    parts: tuple[Part, ...]
    tables: Mapping[str, Rows] = field(default_factory=dict[str, Rows])
    arrays: Mapping[str, Mapping[str, npt.NDArray[Any]]] = field(
        default_factory=dict[str, Mapping[str, npt.NDArray[Any]]]
    )
    meshes: Mapping[str, Mesh] = field(default_factory=dict[str, Mesh])
    targets: tuple[Target, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    model_hashes: tuple[str, ...] = ()
    methods: Methods | None = None

    def analysis(self) -> Analysis:
        """Return what analysis.json says."""
        return Analysis(
            question=self.question,
            version=__version__,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            title=self.title,
            summary=self.summary,
            targets=self.targets,
            parts=self.parts,
            notes=self.notes,
            settings=self.settings,
            versions={"shapespace": __version__, "numpy": np.__version__},
            model_hashes=self.model_hashes,
            methods=self.methods,
        )

    def save(self, folder: Path | str) -> Path:
        """Write all of it to a folder, analysis.json last, and return the path of that.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        folder = Path(folder)
        make_folder(folder)
        for name, (header, rows) in self.tables.items():
            write_rows(folder / name, header, rows)
        for name, arrays in self.arrays.items():
            write_arrays(folder / name, arrays)
        for name, mesh in self.meshes.items():
            write_mesh(folder / name, mesh)
        path = folder / Analysis.FILE
        write_text(path, json_text(self.analysis()))
        return path
