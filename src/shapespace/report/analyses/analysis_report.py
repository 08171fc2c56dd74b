"""Report of an analysis and its files: analysis.json with the parts, and tables, arrays and meshes beside it."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.io.containers.arrays import write_arrays
from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.report.analyses.methods_section import methods_text
from shapespace.reprs import short_repr
from shapespace.schemas import Analysis, Methods, Orientation, Part, TableColumn, Target, json_text
from shapespace.types import Mesh
from shapespace.version import __version__

Rows = tuple[Sequence[str], Sequence[Sequence[object]]]
"""The header of a table, and its rows."""


METHODS_FILE = "methods.txt"
"""A paragraph for the methods section of a paper, with references."""
REDUCED_MORPH_NOTE = "Drawn smaller than it is, so that no triangle flips."
"""The note of a morph whose full size would flip triangles."""


@dataclass(frozen=True)
class LengthFormat:
    """Format of lengths: in mm, or without a unit if the coordinates have none.

    Args:
        unit: `mm`, or empty.
    """

    unit: str

    def number(self, value: float, sign: str = "") -> str:
        """Return a length without its unit, with more decimals if the coordinates have no unit.

        Args:
            value: the length.
            sign: `+` to write the sign of positive lengths.
        """
        return f"{value:{sign}.{2 if self.unit else 4}f}"

    def text(self, value: float, sign: str = "") -> str:
        """Return a length with its unit; arguments as of `number`."""
        return self.number(value, sign) + self.suffix

    @property
    def suffix(self) -> str:
        """The unit after a space; empty for none."""
        return f" {self.unit}" if self.unit else ""

    def column(self, name: str) -> TableColumn:
        """Return the column of lengths of a table in a report."""
        return TableColumn(name=name, kind="mm" if self.unit else "number")

    def label(self, name: str, power: str = "") -> str:
        """Return a name of lengths with its unit, such as `score, mm`; `power` is `²` for areas."""
        return f"{name}, {self.unit}{power}" if self.unit else name

    def field(self, name: str, power: str = "") -> str:
        """Return the name of a column of a file, such as `rms_mm`; `power` is `2` for areas."""
        return f"{name}_{self.unit}{power}" if self.unit else name

    @property
    def of_map(self) -> str:
        """The unit of a map."""
        return self.unit or "units of the coordinates"


@dataclass(frozen=True, eq=False)
class AnalysisReport:
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
        methods: sample sizes, tests and assumptions, as in the last parts; None for predictions.
        citations: of the methods, for methods.txt, besides those that follow from `methods`.
        orientation: named views and links of the figures; None for views that are chosen by the form of the object.
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
    citations: tuple[str, ...] = ()
    orientation: Orientation | None = None

    __repr__ = short_repr

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
            versions={"shapespace": __version__, "numpy": np.__version__, "python": platform.python_version()},
            model_hashes=self.model_hashes,
            methods=self.methods,
            citations=self.citations,
            orientation=self.orientation,
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
        path, analysis = folder / Analysis.FILE, self.analysis()
        if analysis.methods is not None:
            write_text(folder / METHODS_FILE, methods_text(analysis))
        write_text(path, json_text(analysis))
        return path
