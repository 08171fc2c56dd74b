"""Report of an analysis and its files: analysis.json with the parts, and tables, arrays and meshes beside it."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from shapespace.io.containers.archives import write_arrays
from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.report.analyses.methods_section import methods_text
from shapespace.reprs import short_repr
from shapespace.schemas import (
    Analysis,
    Counts,
    HistogramPart,
    Methods,
    Orientation,
    Part,
    TableColumn,
    TablePart,
    Target,
    json_text,
)
from shapespace.types import FloatArray, Mesh
from shapespace.version import __version__

Rows = tuple[Sequence[str], Sequence[Sequence[object]]]
"""The header of a table, and its rows."""


METHODS_FILE = "methods.txt"
"""A paragraph for the methods section of a paper, with references."""
REDUCED_MORPH_NOTE = "Drawn smaller than it is, so that no triangle flips."
"""The note of a morph whose full size would flip triangles."""


@dataclass(frozen=True)
class Column:
    """A column of a table: on the page, in the CSV file, or in both.

    Args:
        name: heading on the page; empty for a column of the file alone.
        kind: kind of its cells on the page.
        field: name in the file; empty for a column of the page alone.
    """

    name: str = ""
    kind: Literal["text", "percent", "interval", "number", "mm", "p", "count"] = "text"
    field: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table, from which its part of the page and its CSV file follow; numbers that are not finite are unknown.

    Args:
        title: title on the page.
        columns: columns of the page and of the file, in the order of both.
        rows: a cell for each column.
        note: note on the page.
        level: level of the title; None for a table within a chapter.
        file: name of the CSV file; empty for none.
        shown: numbers of the rows on the page, in their order; None for all. Numbers beyond the last row are omitted.
    """

    title: str = ""
    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]
    note: str = ""
    level: int | None = None
    file: str = ""
    shown: Iterable[int] | None = None

    @staticmethod
    def of_fields(file: str, fields: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
        """Return a table that is a file alone, with the columns `fields`."""
        return Table(columns=[Column(field=one) for one in fields], rows=rows, file=file)

    @property
    def part(self) -> TablePart:
        """The table of the page."""
        columns = tuple(TableColumn(name=one.name, kind=one.kind) for one in self.columns if one.name)
        every = range(len(self.rows)) if self.shown is None else self.shown
        shown = [self.rows[k] for k in every if k < len(self.rows)]
        rows = self._cells(shown, [bool(one.name) for one in self.columns])
        return TablePart(title=self.title, columns=columns, rows=rows, note=self.note, level=self.level)

    @property
    def file_rows(self) -> Rows:
        """Header and rows of the file."""
        in_file = [bool(one.field) for one in self.columns]
        return tuple(one.field for one in self.columns if one.field), self._cells(self.rows, in_file)

    @staticmethod
    def _cells(rows: Sequence[Sequence[Any]], used: Sequence[bool]) -> tuple[tuple[Any, ...], ...]:
        return tuple(
            tuple(
                None if isinstance(cell, float) and not math.isfinite(cell) else cell
                for cell, own in zip(row, used, strict=True)
                if own
            )
            for row in rows
        )


def floats(values: npt.NDArray[Any] | Sequence[float]) -> tuple[float, ...]:
    """Return numbers as a tuple for a part."""
    return tuple(map(float, values))


def histogram_part(
    title: str, values: Mapping[str, FloatArray], bins: int | FloatArray, *, shares: bool = False, **known: Any
) -> HistogramPart:
    """Return the histogram of one or more sets of values.

    Args:
        title: its title.
        values: label -> values.
        bins: number of bins between the ends of all values, or the edges of the bins.
        shares: shares of each set instead of counts.
        **known: further fields of the part.
    """
    edges = np.histogram_bin_edges(np.concatenate(list(values.values())), bins)
    counts = {label: np.histogram(own, edges)[0] / (len(own) if shares else 1) for label, own in values.items()}
    series = tuple(Counts(counts=floats(own), label=label) for label, own in counts.items())
    return HistogramPart(title=title, edges=floats(edges), series=series, **known)


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

    def column(self, name: str = "", field: str = "") -> Column:
        """Return a column of lengths; `name` is its heading, `field` its name in the file without the unit."""
        return Column(name, "mm" if self.unit else "number", field and self.field(field))

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

    @classmethod
    def of(cls, question: str, title: str, content: Iterable[Part | Table], **known: Any) -> Self:
        """Return a report whose parts and CSV files are those of its content.

        Args:
            question: the command.
            title: title of the report.
            content: parts and tables in their order; a table without a title is a file alone.
            **known: further fields of the report.
        """
        every = tuple(content)
        parts = tuple(
            one.part if isinstance(one, Table) else one for one in every if one.title or isinstance(one, Part)
        )
        tables = {one.file: one.file_rows for one in every if isinstance(one, Table) and one.file}
        return cls(question=question, title=title, parts=parts, tables=tables, **known)

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
