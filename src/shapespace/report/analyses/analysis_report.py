"""Report of an analysis and its files: analysis.json with the parts, and tables, arrays and meshes next to it."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt
from msgspec import Struct, structs
from scipy.spatial.distance import pdist

from shapespace.cohort.cohort import Cohort
from shapespace.io.containers.archives import write_arrays
from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.report.analyses.methods_section import methods_parts, methods_text
from shapespace.reprs import short_repr
from shapespace.schemas import (
    Analysis,
    Counts,
    CurvePart,
    DeformationPart,
    HistogramPart,
    Methods,
    MorphPart,
    Orientation,
    Part,
    Series,
    TableColumn,
    TablePart,
    Target,
    TestScheme,
    TextPart,
    json_text,
)
from shapespace.statistics.multiple_imputation import Imputations
from shapespace.statistics.observation_weights import LEAST_INFORMATION
from shapespace.types import FloatArray, Mesh
from shapespace.version import __version__

Rows = tuple[Sequence[str], Sequence[Sequence[object]]]
"""The header of a table, and its rows."""


_EQUAL = 1e-9  # relative range of values that differ by rounding only, which cannot be divided into bins
METHODS_FILE = "methods.txt"
"""A paragraph for the methods section of a paper, with references."""
REDUCED_MORPH_NOTE = "Drawn smaller than it is, so that no triangle flips."
"""The note of a morph whose full size would flip triangles."""


class Column(TableColumn, frozen=True):
    """A column of a table: on the page, in the CSV file, or in both.

    Args:
        name: heading on the page; empty for a column of the file alone.
        kind: kind of its cells on the page.
        field: name in the file; empty for a column of the page alone.
    """

    field: str = ""


@dataclass(frozen=True, kw_only=True)
class ResultTable:
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
    def of_fields(file: str, fields: Sequence[str], rows: Sequence[Sequence[Any]]) -> ResultTable:
        """Return a table that is a file alone, with the columns `fields`."""
        return ResultTable(columns=[Column(field=name) for name in fields], rows=rows, file=file)

    @property
    def part(self) -> TablePart:
        """The table of the page."""
        columns = tuple(TableColumn(name=column.name, kind=column.kind) for column in self.columns if column.name)
        every = range(len(self.rows)) if self.shown is None else self.shown
        shown = [self.rows[k] for k in every if k < len(self.rows)]
        rows = self._cells(shown, [bool(column.name) for column in self.columns])
        return TablePart(title=self.title, columns=columns, rows=rows, note=self.note, level=self.level)

    @property
    def file_rows(self) -> Rows:
        """Header and rows of the file."""
        in_file = [bool(column.field) for column in self.columns]
        return tuple(column.field for column in self.columns if column.field), self._cells(self.rows, in_file)

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
    """Return numbers as a tuple of floats, as the fields of a `Part` require."""
    return tuple(map(float, values))


def histogram_part(
    title: str, values: Mapping[str, FloatArray], bins: int | FloatArray, *, shares: bool = False, **known: Any
) -> HistogramPart:
    """Return the histogram of one or more sets of values.

    Args:
        title: title of the histogram.
        values: label -> values.
        bins: number of bins between the ends of all values, or the edges of the bins.
        shares: shares of each set instead of counts.
        **known: further fields of the part.
    """
    every = np.concatenate(list(values.values()))
    if every.size and np.ptp(every) <= _EQUAL * np.abs(every).max():
        every = every[:1]
    edges = np.histogram_bin_edges(every, bins)
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
        """Return a length with its unit; see `number` for the arguments."""
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
    """Result of an analysis, ready to be written to a folder.

    Args:
        question: command of the analysis, such as `compare`.
        title: title of the report.
        summary: sentences on the results, the most important first.
        parts: parts of the report, which name arrays and meshes by their files.
        tables: file name (.csv) -> header and rows.
        arrays: file name (.npz) -> arrays by name.
        meshes: file name (.ply) -> mesh.
        targets: targets of a benchmark; empty for other analyses.
        notes: sentences on excluded shapes, each with the reason.
        settings: all settings that the result depends on, including seeds.
        model_hashes: content hashes of the models of the fits.
        methods: sample sizes, tests and assumptions, as in the last parts; None for predictions.
        citations: references for methods.txt, in addition to those that follow from `methods`.
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
    def of(cls, question: str, title: str, content: Iterable[Part | ResultTable], **known: Any) -> Self:
        """Return a report whose parts and CSV files are those of its content.

        Args:
            question: the command.
            title: title of the report.
            content: parts and tables in their order; a table without a title is only written as a file.
            **known: further fields of the report.
        """
        every = tuple(content)
        parts = tuple(
            item.part if isinstance(item, ResultTable) else item
            for item in every
            if item.title or isinstance(item, Part)
        )
        tables = {item.file: item.file_rows for item in every if isinstance(item, ResultTable) and item.file}
        return cls(question=question, title=title, parts=parts, tables=tables, **known)

    def analysis(self) -> Analysis:
        """Return the content of analysis.json."""
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
        """Write the report and its files to a folder, analysis.json last, and return the path of analysis.json.

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


_ESTIMATES_FILE = "observed.csv"
_MOST_ROWS = 10  # rows that fit one screen; files have all
_VERTEX_WORDS = re.compile(r"(?<![A-Za-z])[Vv]ert(?:ices|ex)(?![A-Za-z])")  # in sentences and names of columns
_LANDMARK_WORDS = {"vertices": "landmarks", "vertex": "landmark", "Vertices": "Landmarks", "Vertex": "Landmark"}
_WORDED: Mapping[type[Struct], tuple[str, ...]] = {
    Part: ("title", "note"),
    TextPart: ("text",),
    HistogramPart: ("x",),
    TablePart: ("columns",),
    TableColumn: ("name",),
    Methods: ("corrected_over", "assumptions", "tests"),
    TestScheme: ("tested",),
}
"""Fields with words on vertices."""
MOST_LANDMARKS = 500
"""Points of a shape without triangles up to which they are drawn as landmarks: more cover each other."""
_MOST_PAIRS = 1000  # dots of a figure: more cover each other
_IMPUTATION = (
    "Rubin D. B. (1987) Multiple Imputation for Nonresponse in Surveys. Wiley, New York.",
    "Barnard J., Rubin D. B. (1999) Small-sample degrees of freedom with multiple imputation. Biometrika 86, 948-955.",
    "Licht C. (2010) New Methods for Generating Significance Levels from Multiply-Imputed Data. Dissertation, "
    "University of Bamberg.",
)
_EQUAL = 1e-9  # relative difference of sizes that is rounding
_MOST_SHAPES = 300  # of which all pairs take less than a second


def shape_change_parts(cohort: Cohort, **known: Any) -> tuple[MorphPart | DeformationPart, ...]:
    """Return the part that draws two shapes of a cohort: a morph of surfaces, a deformation grid of planar landmarks,
    vectors of others; nothing for point clouds.

    Args:
        cohort: cohort of the shapes.
        **known: fields of both kinds of parts, such as `arrays`, `low`, `high`, `low_label`, `high_label`, `times`.
    """
    if cohort.faces is not None:
        return (MorphPart(**known),)
    if cohort.n_vertices > MOST_LANDMARKS:
        return ()
    return (DeformationPart(**known, drawing="grid" if cohort.dimensions == 2 else "vectors"),)


def scree_part(eigenvalues: FloatArray, *, axis: str = "principal component") -> CurvePart:
    """Return the scree plot: the share of the variance of each axis.

    Args:
        eigenvalues: (K,) variances along the axes, in their order.
        axis: name of an axis, for the label of the plot.
    """
    shares = 100 * eigenvalues / eigenvalues.sum()
    numbers = tuple(map(float, range(1, len(shares) + 1)))
    return CurvePart(
        title="Scree plot", x=axis, y="share of the variance (%)", series=(Series(x=numbers, y=floats(shares)),)
    )


def tangent_parts(cohort: Cohort) -> tuple[CurvePart, ...]:
    """Return the check of the tangent space of a cohort in the gauge `shape`; nothing in the gauge `form`."""
    if cohort.gauge != "shape" or len(cohort) < 3:
        return ()
    rows = np.unique(np.linspace(0, len(cohort) - 1, min(len(cohort), _MOST_SHAPES)).round().astype(int)).tolist()
    shapes = np.stack([cohort.vertices(row) for row in rows])
    return (tangent_part(shapes, projected=cohort.source.kind == "landmarks"),)


def tangent_part(coords: FloatArray, *, projected: bool = False) -> CurvePart:
    """Return a check of the tangent space: Euclidean against Procrustes distances of all pairs of shapes.

    Args:
        coords: (N, L, D) aligned coordinates as they are analysed, in the gauge `shape`; planar ones may have z = 0.
        projected: whether they were projected orthogonally to the tangent space at their mean.
    """
    shapes = coords if np.ptp(coords[:, :, -1]) > 0 else coords[:, :, :2]
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    flat = shapes.reshape(len(shapes), -1)
    sizes, mean = np.linalg.norm(flat, axis=1), flat.mean(axis=0)
    # Shapes in a tangent plane differ in size, and touch the sphere at their mean.
    of_one_size = np.ptp(sizes) < _EQUAL * sizes.mean()
    flat = flat / (sizes.mean() if of_one_size else np.linalg.norm(mean))
    if projected and not of_one_size:
        pole = mean / np.linalg.norm(mean)
        part = flat - np.outer(flat @ pole, pole)
        shapes = (part + np.outer(np.sqrt(1 - (part**2).sum(axis=1)), pole)).reshape(shapes.shape)
    shapes = shapes / np.linalg.norm(shapes, axis=(1, 2), keepdims=True)
    first, second = np.triu_indices(len(coords), 1)
    n, L, D = shapes.shape
    rows = shapes.transpose(0, 2, 1).reshape(n * D, L)
    products = (rows @ rows.T).reshape(n, D, n, D)[first, :, second]
    singular = np.linalg.svd(products, compute_uv=False)
    singular[:, -1] *= np.where(np.linalg.det(products) < 0, -1.0, 1.0)
    procrustes, euclidean = np.arccos(np.minimum(singular.sum(axis=1), 1.0)), pdist(flat)
    slope = float(euclidean @ procrustes / (procrustes @ procrustes))
    r = float(euclidean @ procrustes / np.sqrt((euclidean @ euclidean) * (procrustes @ procrustes)))
    order = procrustes.argsort()
    order = order[np.unique(np.linspace(0, len(order) - 1, _MOST_PAIRS).round().astype(np.intp))]
    ends = np.array([0.0, float(procrustes.max())])
    return CurvePart(
        title="Tangent space",
        x="Procrustes distance",
        y="distance in the tangent space",
        note=f"Slope through the origin {slope:.6f}, uncentred correlation {r:.6f}; both are 1 where distances in the "
        "tangent space represent those of shapes.",
        series=(
            Series(x=floats(procrustes[order]), y=floats(euclidean[order]), label="pairs of shapes", points=True),
            Series(x=floats(ends), y=floats(ends), label="equal distances"),
        ),
    )


def blank_sentence(count: int, total: int) -> str:
    """Return a sentence on how many vertices of a map are blank; empty for none."""
    if not count:
        return ""
    return (
        f"{count} of {total} vertices are grey: the shapes that observe them carry less than "
        f"{100 * LEAST_INFORMATION:.0f} % of the information."
    )


def shape_notes(cohort: Cohort) -> tuple[str, ...]:
    """Return sentences on truncated and estimated shapes."""
    notes: list[str] = []
    if cohort.source.modes is not None:
        notes.append(f"The shapes are {cohort.source}; variation outside these modes is not analysed.")
    share = cohort.estimated_share
    if share.any():
        worst = int(share.argmax())
        points, method = "vertices", _method_of_estimates(cohort)
        if cohort.source.kind == "landmarks":
            points, method = "landmarks", ""
        notes.append(
            f"{_percent(float(share.mean()))} of the analysed {points} are estimates, not observations{method}: in "
            f"{int((share > 0).sum())} of {len(cohort)} shapes, most in {cohort.names[worst]} "
            f"({_percent(float(share[worst]))})."
        )
    if cohort.analysed is not None:
        count = int((~cohort.analysed).sum())
        notes.append(
            f"{count} of {cohort.n_vertices} vertices, which fewer than half of the shapes observe, are not analysed."
        )
    return tuple(notes)


def _method_of_estimates(cohort: Cohort) -> str:
    completed = sum(own is not None for own in cohort.samples)
    if completed == int((cohort.estimated_share > 0).sum()):
        return " (completed by a shape model, with samples)"
    own = " (conditional mean by PCA with missing data"
    return f"{own}; {completed} shapes are completed by a shape model, with samples)" if completed else f"{own})"


def _imputation_sentence(cohort: Cohort, imputations: Imputations | None) -> str:
    """Return whether an analysis contains the uncertainty of completed shapes; empty without their samples."""
    count = sum(own is not None for own in cohort.samples)
    shapes = f"{count} completed shape{'' if count == 1 else 's'}"
    if imputations is None:
        return f"The samples of {shapes} are not used; the results do not contain their uncertainty." if count else ""
    missing = ", ".join(f"{_percent(own)} ({name})" for name, own in imputations.missing_information.items())
    return (
        f"The results combine {imputations.count} imputations of {shapes} by Rubin's rules, p values by their normal "
        f"quantiles.{f' Fraction of missing information: {missing}.' if missing else ''}"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"


def shape_settings(cohort: Cohort) -> dict[str, Any]:
    """Return the entries of analysis.json on the source of the shapes and on estimated vertices."""
    source, share = cohort.source, cohort.estimated_share
    out: dict[str, Any] = {"shape_source": source.kind}
    if source.modes is not None:
        out |= {"shape_modes": source.modes, "shape_explained_variance_ratio": source.explained_variance_ratio}
    if share.any() or cohort.analysed is not None:
        worst = int(share.argmax())
        out |= {
            "estimated_share": float(share.mean()),
            "estimated_share_largest": float(share[worst]),
            "estimated_share_largest_shape": cohort.names[worst],
            "vertices_not_analysed": 0 if cohort.analysed is None else int((~cohort.analysed).sum()),
        }
    return out


def _landmark_words(value: Any) -> Any:
    """Return a text, part, record or tuple in which the vertices of shapes are called landmarks."""
    if isinstance(value, tuple):
        return tuple(map(_landmark_words, cast(tuple[Any, ...], value)))
    if isinstance(value, Struct):
        names = (name for kind, own in _WORDED.items() if isinstance(value, kind) for name in own)
        return structs.replace(value, **{name: _landmark_words(getattr(value, name)) for name in names})
    return _VERTEX_WORDS.sub(lambda found: _LANDMARK_WORDS[found[0]], value or "")


def _in_landmarks(report: AnalysisReport) -> AnalysisReport:
    """Return a report whose sentences, labels and columns of files call the vertices of shapes landmarks."""
    words = {name: _landmark_words(getattr(report, name)) for name in ("summary", "notes", "parts")}
    methods = None if report.methods is None else _landmark_words(report.methods)
    tables = {name: (_landmark_words(tuple(header)), rows) for name, (header, rows) in report.tables.items()}
    return replace(report, **words, methods=methods, tables=tables)


def cohort_report(
    question: str,
    title: str,
    content: Iterable[Part | ResultTable],
    cohort: Cohort,
    *,
    methods: Methods,
    summary: Sequence[str],
    settings: Mapping[str, Any],
    notes: Sequence[str] | None = None,
    citations: Sequence[str] = (),
    imputations: Imputations | None = None,
    state_methods: bool = True,
    **known: Any,
) -> AnalysisReport:
    """Return the report of an analysis of a cohort, with the methods and the data on its shapes.

    Args:
        question: the command.
        title: title of the report.
        content: parts and tables; the methods and the shares of estimated vertices follow them.
        cohort: the shapes.
        methods: sample sizes, tests and assumptions.
        summary: sentences on the results; those on limits of the cohort follow the first.
        settings: settings of the analysis.
        notes: sentences on excluded shapes, each with the reason; None for the notes of the cohort.
        citations: references of the methods.
        imputations: imputations that the analysis combines; None for an analysis of the shapes as they are.
        state_methods: whether the methods are parts of the page.
        **known: further fields of the report; by default, `model_hashes` is the hash of the model of the fits.
    """
    stated = methods_parts(methods) if state_methods else ()
    assumptions = tuple(filter(None, (_imputation_sentence(cohort, imputations),)))
    combined: dict[str, Any] = {}
    if imputations is not None:
        combined = {"imputations": imputations.count, "missing_information": dict(imputations.missing_information)}
    report = AnalysisReport.of(
        question,
        title,
        (*content, *stated, *_estimate_tables(cohort)),
        summary=(*summary[:1], *cohort.cautions, *summary[1:]),
        notes=(*(cohort.notes if notes is None else notes), *shape_notes(cohort), *assumptions),
        settings={**settings, **shape_settings(cohort), **combined},
        methods=structs.replace(methods, assumptions=(*methods.assumptions, *assumptions)),
        citations=(*citations, *(_IMPUTATION if combined else ())),
        orientation=cohort.orientation,
        **{"model_hashes": () if cohort.fitted is None else (cohort.fitted.model.content_hash,), **known},
    )
    return _in_landmarks(report) if cohort.source.kind == "landmarks" else report


def _estimate_tables(cohort: Cohort) -> tuple[ResultTable, ...]:
    """Return the share of estimated vertices of each shape; nothing if all are observed."""
    share, title = cohort.estimated_share, "Estimated vertices"
    note = (
        "Share of the vertices of a shape that its scan does not show, largest first; they are estimated by the "
        "conditional mean of a PCA model with missing data, without the table."
    )
    if cohort.source.kind == "landmarks":
        title, note = "Estimated landmarks", "Share of the landmarks of a specimen that are estimates, largest first."
    order = sorted(range(len(share)), key=lambda k: (-share[k], k))
    table = ResultTable(
        title=title,
        columns=(Column("shape", field="shape"), Column("estimated", "percent", "estimated_share")),
        rows=[(cohort.names[k], float(share[k])) for k in order if share[k] > 0],
        shown=range(_MOST_ROWS),
        note=f"{note} All of them are in {_ESTIMATES_FILE}.",
        file=_ESTIMATES_FILE,
    )
    return (table,) if share.any() else ()
