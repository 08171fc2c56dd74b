"""A cohort: N shapes in correspondence, as coefficients in an orthonormal basis, with a table of covariates.

Squared distances of coefficients equal those of the shapes, so quantities that are sums over vertices (Procrustes
distance, sums of squares) need only the coefficients, whatever the number of vertices.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.cohort.incomplete import complete_by_population, completed_parts, completed_shapes
from shapespace.cohort.shape_samples import ShapeSamples
from shapespace.cohort.table import Table, cell_text, class_notes, list_names, numbers_as_text
from shapespace.errors import InputError
from shapespace.geometry.articulation import Articulation, articulate, size_of_parts
from shapespace.geometry.landmark_alignment import AlignedLandmarks, project_to_tangent
from shapespace.geometry.procrustes import Gauge, align_in_place, centroid_size, scale_to_tangent
from shapespace.geometry.similarity import fit_similarity
from shapespace.lazy import lazy_import
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Orientation, SurfaceReview
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, SurfaceLandmarks, common_faces, read_only

SUBJECT = "subject"
"""Column of the subjects, unless another is named."""

LengthUnit: TypeAlias = Literal["mm", ""]
"""Unit of the lengths of a cohort; empty for coordinates without a unit."""
ShapeKind: TypeAlias = Literal["coefficients", "fitted", "dense", "corresponding", "surfaces", "landmarks"]
"""Kinds of shapes: model coefficients or surfaces of fits, surfaces written by `correspond`, any other surfaces, or
landmarks."""

_TRUNCATED: tuple[ShapeKind, ...] = ("coefficients", "fitted")
_UNIT_SIZE = 1e-2
"""Tolerance of unit centroid sizes, which identify aligned coordinates; tangent projection changes sizes by less."""
_ORTHONORMAL = 1e-9  # largest deviation of U U^T from the identity (rounding)
# Share of the size; a copy in single precision differs by less than this.
_SAME = 1e-6


@dataclass(frozen=True)
class ShapeSource:
    """Source of the shapes of a cohort, and the share of shape variance that it can represent.

    Args:
        kind: coefficients, fitted or dense surfaces of fits, corresponding surfaces, other surfaces, or landmarks.
        modes: number of model modes that the shapes are combinations of; None if the shapes are not limited to modes.
        explained_variance_ratio: share of the model's training variance in these modes, 0 to 1; None as for `modes`.
    """

    kind: ShapeKind = "surfaces"
    modes: int | None = None
    explained_variance_ratio: float | None = None

    def __str__(self) -> str:
        if self.modes is None or self.explained_variance_ratio is None:
            return self.kind if self.kind in ("surfaces", "landmarks") else f"{self.kind} surfaces"
        return f"{self.kind}, {self.modes} modes, {100 * self.explained_variance_ratio:.0f} % of the variance"


@dataclass(frozen=True, eq=False)
class FitDiagnostics:
    """Fit diagnostics of a cohort, one row per shape.

    Args:
        model: model of the fits.
        b: (N, K) coefficients, mm.
        b_stddev: (N, K) standard deviations of the coefficients, mm.
        status: status of each of the N fits: `converged` or `max_iterations`, and `doubtful` if doubtful fits are
            included.
        folder: folder of the results, as it was passed.
        beyond_mm: (N,) RMS of the residuals that the model does not explain, mm; NaN for a fit that does not state it;
            None if no values are given.
        additive: the same model, if its file separates identity and expression; None otherwise.
    """

    model: ShapeModel
    b: FloatArray
    b_stddev: FloatArray
    status: tuple[str, ...]
    folder: str
    beyond_mm: FloatArray | None = None
    additive: AdditiveModel | None = None

    __repr__ = short_repr

    @cached_property
    def z(self) -> FloatArray:
        """(N, K) coefficients in standard deviations of the model."""
        return read_only(self.model.to_z(self.b))

    def source(self, kind: ShapeKind) -> ShapeSource:
        """Return the source of the shapes of these fits.

        Args:
            kind: kind of shapes: `coefficients` and `fitted` surfaces are limited to the modes of the fits; `dense`
                surfaces are not.
        """
        if kind not in _TRUNCATED:
            return ShapeSource(kind)
        modes = self.b.shape[1]
        total = max(self.model.total_variance, float((self.model.stddev**2).sum()))
        ratio = float((self.model.stddev[:modes] ** 2).sum()) / total if total > 0 else 1.0
        return ShapeSource(kind, modes, ratio)

    def take(self, rows: Sequence[int]) -> FitDiagnostics:
        """Return the fits of some rows."""
        indices = np.asarray(rows, dtype=np.intp)
        return replace(
            self,
            b=read_only(self.b[indices]),
            b_stddev=read_only(self.b_stddev[indices]),
            status=tuple(self.status[row] for row in rows),
            beyond_mm=None if self.beyond_mm is None else read_only(self.beyond_mm[indices]),
        )


@dataclass(frozen=True, eq=False)
class Cohort:
    """N shapes in correspondence; shape i has the vertices reference + coefficients[i] basis, in one frame.

    Vertices of several parts are tangent vertices: the shapes of the parts and their relative poses, to first order
    (docs/structures.md, S5). `mesh` returns them with exact rotations.

    Args:
        names: names of the shapes.
        reference: (V, 3) vertices from which coefficients are counted, mm; not the mean of these shapes.
        basis: (K, 3V) orthonormal rows.
        coefficients: (N, K) coefficients, mm, norms over all vertices.
        sizes_mm: (N,) centroid sizes of the objects themselves; NaN if not known. In the `shape` gauge they are divided
            out of the coefficients.
        table: covariates, N rows in the order of the shapes.
        gauge: size handling, `shape` or `form`.
        faces: (F, 3) triangles; None for points.
        landmarks: named points on the surfaces; a mapping of name to vertex may be given for those at vertices.
        fitted: fit diagnostics; None for other surfaces.
        notes: sentences on excluded shapes, with the reasons.
        cautions: sentences on the use of columns that answers begin with.
        drop_missing: whether all questions exclude shapes with missing values in the table.
        orientation: named views and links of the figures; None for views that are chosen by the form of the object.
        source: source of the shapes.
        unit: unit of lengths: `mm`, or empty for coordinates without a unit, such as those of unit centroid size.
        observed: (N, V) bool, False for vertices that are estimates; None if all are observed.
        analysed: (V,) bool, False for vertices that too few shapes observe: there all shapes have one position, and
            nothing varies. None if all are analysed.
        position_std: (V,) RMS over the shapes read of `Mesh.position_std`, in the size of `reference`; None if a shape
            has none.
        samples: N samples of the distribution of each completed shape, in any pose; None for shapes without. Empty if
            no shape has any.
        review: number of the surfaces read from a correspondence that need review.
        parts: name -> number of vertices of each part of the objects, in the order of the vertices; empty for objects
            of one part.
    """

    names: tuple[str, ...]
    reference: FloatArray
    basis: FloatArray
    coefficients: FloatArray
    sizes_mm: FloatArray
    table: Table
    gauge: Gauge = "shape"
    faces: IntArray | None = None
    landmarks: SurfaceLandmarks | None = None
    fitted: FitDiagnostics | None = None
    notes: tuple[str, ...] = ()
    source: ShapeSource = ShapeSource()
    unit: LengthUnit = "mm"
    observed: BoolArray | None = None
    analysed: BoolArray | None = None
    position_std: FloatArray | None = None
    samples: tuple[ShapeSamples | None, ...] = ()
    review: SurfaceReview = field(default_factory=SurfaceReview)
    cautions: tuple[str, ...] = ()
    drop_missing: bool = False
    orientation: Orientation | None = None
    parts: Mapping[str, int] = field(default_factory=dict[str, int])

    def __post_init__(self) -> None:
        n = len(self.names)
        agree = (self.observed is None or self.observed.shape == (n, len(self.reference))) and (
            self.analysed is None or self.analysed.shape == (len(self.reference),)
        )
        if not agree:
            raise InputError(
                "The masks of a cohort need a flag for each vertex, and the mask of observed vertices needs a row for "
                "each shape."
            )
        agree = (
            self.coefficients.shape == (n, len(self.basis))
            and self.basis.shape[1] == self.reference.size
            and self.sizes_mm.shape == (n,)
            and len(self.table) == n
        )
        if not agree or len(self.samples) not in (0, n):
            raise InputError("A cohort needs a row of coefficients, a size and a row of the table for each shape.")
        if self.landmarks is not None:
            object.__setattr__(self, "landmarks", SurfaceLandmarks.of(self.landmarks))

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        noun = "specimens" if self.source.kind == "landmarks" else "surfaces" if self.fitted is None else "fits"
        points = "landmarks" if self.source.kind == "landmarks" else "vertices"
        columns = list_briefly(list(self.table.columns)) or "no columns"
        return (
            f"<Cohort of {len(self)} {noun} with {self.n_vertices:,} {points}, gauge {self.gauge}; "
            f"{len(self.basis)} coefficients each; columns: {columns}>"
        )

    def _repr_html_(self) -> str:
        return lazy_import("html_of_cohort")(self)

    @property
    def n_vertices(self) -> int:
        """Number of vertices, V."""
        return len(self.reference)

    @cached_property
    def articulation(self) -> Articulation:
        """Joints of the parts, in their mean shapes and relative poses; for a cohort with `parts`."""
        return Articulation(self.reference, tuple(self.parts.values()))

    def part_shapes(self, row: int) -> FloatArray:
        """Return the vertices (V, 3), mm, of the parts of a shape, each in the pose of its mean."""
        return self.reference + self.articulation.from_tangent(self.vertices(row)).shape

    @cached_property
    def dimensions(self) -> Literal[2, 3]:
        """Dimensions of the coordinates: 2 if z is the same everywhere, as of planar landmarks."""
        rounding = _SAME * centroid_size(self.reference)
        if float(np.ptp(self.reference[:, 2])) > rounding:
            return 3
        z = self.basis.reshape(len(self.basis), -1, 3)[:, :, 2]
        return 2 if float(np.abs(self.coefficients @ z).max(initial=0.0)) <= rounding else 3

    @property
    def observed_share(self) -> FloatArray:
        """(V,) share of the shapes that observe each vertex; 0 for vertices that are not analysed."""
        share = np.ones(self.n_vertices) if self.observed is None else self.observed.mean(axis=0)
        return share if self.analysed is None else np.where(self.analysed, share, 0.0)

    @property
    def estimated_share(self) -> FloatArray:
        """(N,) share of the analysed vertices of each shape that are estimates."""
        if self.observed is None:
            return np.zeros(len(self))
        mask = self.observed if self.analysed is None else self.observed[:, self.analysed]
        return 1.0 - mask.mean(axis=1)

    @property
    def imputations(self) -> int:
        """Number of imputations: the fewest samples of a completed shape; 0 if no shape has samples."""
        return min((len(own) for own in self.samples if own is not None), default=0)

    def imputation(self, k: int, onto: Cohort | None = None) -> Cohort:
        """Return the cohort with sample `k`, from 0, of every completed shape; other shapes are the same in each.

        Args:
            k: number of the imputation.
            onto: cohort to whose mean the samples are aligned; None for this one.

        Raises:
            InputError: there is no such imputation.
            FileError: samples cannot be read.
        """
        if not 0 <= k < self.imputations:
            raise InputError(f"The cohort has {self.imputations} imputations, and no number {k}.")
        rows = [row for row, own in enumerate(self.samples) if own is not None]
        drawn = np.stack([np.asarray(own[k], dtype=np.float64) for own in self.samples if own is not None])
        shapes, sizes = np.stack([self.vertices(row) for row in range(len(self))]), self.sizes_mm.copy()
        part = slice(None) if self.analysed is None else self.analysed
        sizes[rows] = [
            size_of_parts(sample, tuple(self.parts.values())) if self.parts else centroid_size(sample[part])
            for sample in drawn
        ]
        _align_to(drawn, onto or self)
        shapes[rows] = drawn
        observed = None if self.observed is None else self.observed.copy()
        if observed is not None:
            observed[rows] = True if self.analysed is None else self.analysed
            observed = None if observed.all() else observed
        reference = self.reference if self.parts else shapes.mean(axis=0)
        basis, coefficients = _orthonormal((shapes - reference).reshape(len(shapes), -1))
        return replace(
            self,
            reference=read_only(reference),
            basis=basis,
            coefficients=coefficients,
            sizes_mm=read_only(sizes),
            observed=observed,
            samples=(),
        )

    def observed_in(self, rows: Sequence[int]) -> BoolArray | None:
        """Return the mask (V,) of vertices that every shape observes; None if all shapes observe all vertices."""
        if self.observed is None and self.analysed is None:
            return None
        observed: BoolArray = np.ones(self.n_vertices, np.bool_)
        if self.observed is not None:
            observed = np.logical_and.reduce(self.observed[list(rows)], axis=0, dtype=np.bool_)
        if self.analysed is not None:
            observed = np.logical_and(observed, self.analysed)
        return None if observed.all() else observed

    def vertices(self, shape: int | FloatArray) -> FloatArray:
        """Return the vertices (V, 3), mm, of a shape by its number, or of coefficients (K,)."""
        coefficients = self.coefficients[shape] if isinstance(shape, int) else shape
        return self.reference + (coefficients @ self.basis).reshape(-1, 3)

    def surface_vertices(self, shape: int | FloatArray) -> FloatArray:
        """Return the vertices (V, 3), mm, of a shape with exact rotations of its parts; arguments as for `vertices`."""
        vertices = self.vertices(shape)
        return self.articulation.decode(vertices) if self.parts else vertices

    def mesh(self, shape: int | FloatArray, name: str = "") -> Mesh:
        """Return a shape as a mesh; arguments as for `vertices`."""
        mesh_name = name or (self.names[shape] if isinstance(shape, int) else "shape")
        return Mesh(self.surface_vertices(shape), self.faces, name=mesh_name)

    def displacements(self, vertices: slice) -> FloatArray:
        """Return the (N, m, 3) displacements, mm, of some vertices from the reference, in all shapes."""
        chosen = self.basis.reshape(len(self.basis), -1, 3)[:, vertices]
        return np.tensordot(self.coefficients, chosen, axes=1)

    def take(self, rows: Sequence[int], *notes: str) -> Cohort:
        """Return the cohort of some of its shapes, in their order, with further notes."""
        indices = np.asarray(rows, dtype=np.intp)
        return replace(
            self,
            names=tuple(self.names[row] for row in rows),
            coefficients=read_only(self.coefficients[indices]),
            sizes_mm=read_only(self.sizes_mm[indices]),
            table=self.table.take(rows),
            fitted=None if self.fitted is None else self.fitted.take(rows),
            observed=None if self.observed is None else self.observed[indices],
            samples=tuple(self.samples[row] for row in rows) if self.samples else (),
            notes=(*self.notes, *notes),
        )

    def complete(self, columns: Sequence[str], *, drop_missing: bool = False, numbers: Collection[str] = ()) -> Cohort:
        """Return the cohort of the shapes with values in all `columns`, with notes on the excluded shapes and the
        classes.

        Args:
            columns: columns of the table, used as classes if not in `numbers`.
            drop_missing: whether to exclude shapes with missing values, with a note (default: an error).
            numbers: columns that are used as numbers; they must be among `columns`.

        Raises:
            InputError: there is no such column, something is missing and `drop_missing` is not set, or no shape is
                left.
        """
        missing = self.table.missing(columns)
        if not missing:
            new = [note for note in class_notes(self.table, columns, numbers) if note not in self.notes]
            return replace(self, notes=(*self.notes, *new)) if new else self
        excluded_names = list_names([self.names[row] for row in missing])
        columns = [column for column in dict.fromkeys(columns) if self.table.missing([column])]
        if not (drop_missing or self.drop_missing):
            raise InputError(
                f"{self.table.where}: {' or '.join(columns)} of {len(missing)} of {len(self)} shapes is missing "
                f"({excluded_names}); fill it in, or exclude them with --set missing=drop."
            )
        if len(missing) == len(self):
            raise InputError(f"{self.table.where}: no shape has all of {', '.join(columns)}; fill them in.")
        excluded = set(missing)
        note = (
            f"{len(missing)} of {len(self)} shapes are excluded because {' or '.join(columns)} is missing "
            f"({excluded_names})."
        )
        complete_shapes = self.take([row for row in range(len(self)) if row not in excluded], note)
        return complete_shapes.complete(columns, numbers=numbers)

    @staticmethod
    def of_shapes(
        shapes: FloatArray,
        columns: Mapping[str, Sequence[object]],
        *,
        names: Sequence[str] | None = None,
        faces: IntArray | None = None,
        gauge: Gauge = "shape",
        align: bool = True,
        landmarks: Mapping[str, int] | None = None,
        onto: Cohort | None = None,
        least: int = 2,
        unit: LengthUnit | None = None,
        observed: BoolArray | None = None,
        samples: Sequence[ShapeSamples | None] = (),
        parts: Mapping[str, int] | None = None,
    ) -> Cohort:
        """Return the cohort of shapes (N, V, 3) in correspondence, mm, after generalised Procrustes.

        Missing vertices are estimated by their conditional means, by PCA with missing data. Vertices that fewer than
        half of the shapes observe are not analysed.

        Args:
            shapes: (N, V, 3) vertices, mm; vertices that are not-a-number are missing.
            columns: name -> N values, the columns of the table; None and NaN are missing.
            names: names of the shapes; None numbers them.
            faces: (F, 3) triangles.
            gauge: size handling: `shape` divides size out, and projects shapes to the tangent plane at their mean;
                `form` keeps it.
            align: whether to align the shapes; False uses them unchanged.
            landmarks: named points on the surfaces (`place_landmarks`), or name -> vertex.
            onto: cohort to whose mean each shape is aligned, in its gauge; there may then be a single shape.
            least: smallest number of shapes, if `onto` is None.
            unit: unit of the coordinates: `mm`, or empty for none; None for `mm`, unless all centroid sizes are 1, as
                after a Procrustes superimposition, which divides the unit out.
            observed: (N, V) bool, False for vertices that are missing too; None if all others are observed.
            samples: N samples of completed shapes, whose unobserved vertices are used as they are; None for each other
                shape.
            parts: name -> number of vertices of each part of the objects; None for objects of one part.

        Raises:
            InputError: too few shapes, infinite values, too few observed vertices in a shape, columns of
                another length, two shapes that are the same, or other vertices than those of `onto`.
        """
        shapes = np.array(shapes, dtype=np.float64)
        fewest = least if onto is None else 1
        if shapes.ndim != 3 or shapes.shape[2] != 3 or len(shapes) < fewest or np.isinf(shapes).any():
            count_word = {1: "one", 2: "two"}.get(fewest, str(fewest))
            raise InputError(f"A cohort needs {count_word} or more finite shapes (N, V, 3), not {shapes.shape}.")
        Mesh(shapes[0], faces, name="The cohort")  # rejects faces of other vertices
        if landmarks is not None:
            SurfaceLandmarks.of(landmarks).check(shapes.shape[1])
        if observed is not None and np.shape(observed) != shapes.shape[:2]:
            raise InputError(f"observed must have the shape (N, V) {shapes.shape[:2]}, not {np.shape(observed)}.")
        shape_names = tuple(names) if names is not None else tuple(f"shape {k + 1}" for k in range(len(shapes)))
        cells = {name: tuple(map(cell_text, values)) for name, values in columns.items()}
        is_observed: BoolArray = ~np.logical_or.reduce(np.isnan(shapes), axis=2)
        is_known = is_observed if observed is None else np.logical_and(is_observed, observed)
        completed_rows = [row for row, own in enumerate(samples) if own is not None]
        if not is_observed[completed_rows].all():
            raise InputError("A vertex of a shape with samples is not a number; complete the shape again.")
        is_observed = is_known.copy()
        is_observed[completed_rows] = True
        mask, analysed = None if is_observed.all() else is_observed, None
        parts = dict(parts or {})
        if parts and (sum(parts.values()) != shapes.shape[1] or not align):
            raise InputError(
                f"The parts have {sum(parts.values())} vertices ({_part_counts(parts)}), and the shapes "
                f"{shapes.shape[1]}; give the number of vertices of each part, and align the shapes."
            )
        counts = tuple(parts.values())
        sizes = read_only([size_of_parts(shape, counts) if parts else centroid_size(shape) for shape in shapes])
        reference = None
        if onto is not None:
            gauge, analysed = onto.gauge, onto.analysed
            if parts != dict(onto.parts):
                raise InputError(
                    f"Shapes with the parts ({_part_counts(parts) or 'none'}) cannot be compared with shapes with the "
                    f"parts ({_part_counts(onto.parts) or 'none'}); give shapes of the same parts."
                )
            if shapes.shape[1] != onto.n_vertices:
                noun = "landmarks" if onto.source.kind == "landmarks" else "vertices"
                raise InputError(
                    f"Shapes of {shapes.shape[1]} {noun} cannot be compared with shapes of {onto.n_vertices} {noun}."
                )
            if analysed is not None:
                mask = None if is_observed[:, analysed].all() else np.logical_and(is_observed, analysed)
            if mask is not None and parts:
                raise InputError(
                    "Shapes of several parts with missing vertices cannot be compared with other shapes; complete them "
                    "with shapespace complete."
                )
            if mask is not None:
                shapes = _complete_by(onto, shapes, is_observed, shape_names)
            if mask is not None or analysed is not None:
                part = slice(None) if analysed is None else analysed
                sizes = read_only([centroid_size(shape[part]) for shape in shapes])
            _align_to(shapes, onto)
        elif parts:
            if mask is not None:
                completed = completed_parts(shapes, is_observed, shape_names, parts)
                shapes, mask = completed.shapes, completed.observed
                sizes = read_only([size_of_parts(shape, counts) for shape in shapes])
                analysed = None if completed.analysed.all() else completed.analysed
            align_in_place(shapes, "form")
            articulation, poses, _ = articulate(shapes, counts, gauge)
            shapes, reference = np.stack([articulation.to_tangent(own) for own in poses]), articulation.template
        elif mask is not None:
            completed = completed_shapes(shapes, is_observed, shape_names, gauge, faces, align=align)
            shapes, mask, sizes = completed.shapes, completed.observed, read_only(completed.sizes_mm)
            analysed = None if completed.analysed.all() else completed.analysed
        elif align:
            align_in_place(shapes, gauge)
            if gauge == "shape":
                scale_to_tangent(shapes)
        reference = shapes.mean(axis=0) if reference is None else reference
        basis, coefficients = _orthonormal((shapes - reference).reshape(len(shapes), -1))
        cohort = Cohort(
            names=shape_names,
            reference=read_only(reference),
            basis=basis,
            coefficients=coefficients,
            sizes_mm=sizes,
            table=Table(cells, shape_names),
            gauge=gauge,
            faces=faces,
            landmarks=None if landmarks is None else SurfaceLandmarks.of(landmarks),
            observed=_combine_masks(mask, is_known if completed_rows else None, analysed),
            analysed=analysed,
            samples=tuple(samples) if completed_rows else (),
            unit=unit if unit is not None else "" if np.abs(sizes - 1.0).max() < _UNIT_SIZE else "mm",
            parts=parts,
        )
        check_distinct(cohort)
        return cohort

    @staticmethod
    def of_landmarks(aligned: AlignedLandmarks, table: Table | None = None, *, gauge: Gauge | None = None) -> Cohort:
        """Return the cohort of aligned landmarks; planar ones have z = 0.

        Args:
            aligned: result of `align_landmarks`.
            table: covariates, N rows; None for the columns of the landmark file.
            gauge: size handling: `form` multiplies shapes by their centroid sizes, `shape` divides forms by them; None
                for that of the alignment.

        Raises:
            InputError: two specimens that are the same.
        """
        coords, gauge = aligned.coords, gauge or aligned.gauge
        if gauge != aligned.gauge:
            shapes = aligned.forms / aligned.sizes[:, None, None]
            coords = aligned.forms if gauge == "form" else project_to_tangent(shapes)
        shapes = padded(coords)
        reference = shapes.mean(axis=0)
        basis, coefficients = _orthonormal((shapes - reference).reshape(len(shapes), -1))
        cohort = Cohort(
            names=aligned.names,
            reference=read_only(reference),
            basis=basis,
            coefficients=coefficients,
            sizes_mm=aligned.sizes,
            table=Table(aligned.columns, aligned.names, aligned.where) if table is None else table,
            gauge=gauge,
            landmarks=SurfaceLandmarks.of({name: k for k, name in enumerate(aligned.landmarks)}),
            notes=aligned.notes,
            source=ShapeSource("landmarks"),
            unit="mm" if gauge == "form" and aligned.unit == "mm" else "",
            observed=~aligned.estimated if aligned.estimated.any() else None,
        )
        check_distinct(cohort)
        return cohort

    @staticmethod
    def of_meshes(
        meshes: Sequence[Mesh],
        table: Table,
        gauge: Gauge = "shape",
        onto: Cohort | None = None,
        least: int = 2,
        samples: Sequence[ShapeSamples | None] = (),
        parts: Mapping[str, int] | None = None,
    ) -> Cohort:
        """Return the cohort of meshes in correspondence, mm, after generalised Procrustes; for `onto`, `least`,
        `samples` and `parts` see `of_shapes`.

        Raises:
            CorrespondenceError: meshes that differ in vertices or triangles.
            InputError: shapes that `of_shapes` rejects.
        """
        has_triangles = onto is not None and onto.faces is not None and meshes[0].faces is not None
        known = [Mesh(onto.reference, onto.faces, name=onto.names[0])] if onto is not None and has_triangles else []
        faces = common_faces([*known, *meshes])
        shapes = np.stack([mesh.vertices for mesh in meshes])
        names = [mesh.name for mesh in meshes]
        all_observed = np.ones(shapes.shape[1], dtype=np.bool_)
        observed = np.stack([all_observed if mesh.observed is None else mesh.observed for mesh in meshes])
        cohort = Cohort.of_shapes(
            shapes, {}, names=names, faces=faces, gauge=gauge, onto=onto, least=least, observed=observed,
            samples=samples, parts=parts,
        )  # fmt: skip
        stds = [mesh.position_std for mesh in meshes if mesh.position_std is not None]
        if len(stds) < len(meshes):
            return replace(cohort, table=table)
        sizes = np.array([centroid_size(shape) for shape in shapes])
        scale = np.ones(len(meshes)) if gauge == "form" else centroid_size(cohort.reference) / sizes
        squares = (scale[:, None] * np.stack(stds)) ** 2
        return replace(cohort, table=table, position_std=read_only(np.sqrt(squares.mean(axis=0))))

    @staticmethod
    def of_fits(
        fitted: FitDiagnostics, names: Sequence[str], table: Table, sizes_mm: FloatArray, gauge: Gauge = "shape"
    ) -> Cohort:
        """Return the cohort of fits in the frame of the model, in which their poses are already divided out.

        In the `shape` gauge the sizes that a model of forms contains in its modes are divided out.

        Args:
            fitted: fits with their coefficients.
            names: names of the N shapes.
            table: covariates, N rows.
            sizes_mm: (N,) centroid sizes of the objects, mm.
            gauge: size handling; `form` scales each shape to its own size.

        Raises:
            InputError: the `form` gauge with a size that is not known, or two fits that are the same.
        """
        model = fitted.model
        modes = fitted.b.shape[1]
        rows = model.vertex_basis[:, :modes].T
        b = fitted.b
        reference = model.mean_vertices
        if gauge == "form" and not np.isfinite(sizes_mm).all():
            without_size = [name for name, size in zip(names, sizes_mm, strict=True) if not np.isfinite(size)]
            raise InputError(
                f"The size of {list_names(without_size)} is not known in mm, so forms cannot be compared; fit with "
                "--unit, or compare shapes with --set gauge=shape."
            )
        centre, parts = reference.mean(axis=0), parts_of_model(model)
        if parts:
            surfaces, counts = [model.reconstruct(row) for row in b], tuple(parts.values())
            if gauge == "form":
                scales = sizes_mm / [centroid_size(x) for x in surfaces]
                reference = centre + float(scales.mean()) * (reference - centre)
            else:
                scales = size_of_parts(reference, counts) / np.array([size_of_parts(x, counts) for x in surfaces])
            articulation = Articulation(reference, counts)
            shapes = np.stack([articulation.encode(s * x) for s, x in zip(scales, surfaces, strict=True)])
            rows, b = (shapes - reference).reshape(len(shapes), -1), np.eye(len(shapes))
        elif gauge == "form" or model.gauge == "form":
            middle = (reference - centre).ravel()
            if gauge == "form":
                scales = sizes_mm / np.array([centroid_size(reference + (row @ rows).reshape(-1, 3)) for row in b])
            else:
                # If the modes of a model contain size, shapes are projected to the tangent plane at its mean.
                scales = 1 / (1 + b @ (rows @ middle) / (middle @ middle))
            mean = float(scales.mean())
            b = np.column_stack([b * scales[:, None], scales - mean])
            rows = np.vstack([rows, middle])
            reference = centre + mean * (reference - centre)
        basis, coefficients = _in_basis(rows, b)
        cohort = Cohort(
            names=tuple(names),
            reference=read_only(reference),
            basis=basis,
            coefficients=coefficients,
            sizes_mm=read_only(sizes_mm),
            table=table,
            gauge=gauge,
            faces=model.faces,
            landmarks=model.landmarks,
            fitted=fitted,
            source=fitted.source("coefficients"),
            parts=parts,
        )
        check_distinct(cohort)
        return cohort


def parts_of_model(model: ShapeModel) -> dict[str, int]:
    """Return the number of vertices of each part of a model of shapes and relative poses; empty for other models."""
    return {} if model.is_linear else model.part_counts


def _part_counts(parts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in parts.items())


def _combine_masks(mask: BoolArray | None, known: BoolArray | None, analysed: BoolArray | None) -> BoolArray | None:
    """Return the (N, V) observed vertices: those of `mask` that are also `known`, before shapes were completed."""
    if known is None:
        return mask
    known = known if mask is None else np.logical_and(mask, known)
    known = known if analysed is None else np.logical_and(known, analysed)
    return None if known.all() else known


def _align_to(shapes: FloatArray, onto: Cohort) -> None:
    """Move each of `shapes` (N, V, 3) in place to the mean of a cohort; in the `shape` gauge to its tangent plane.

    Shapes of several parts become tangent vertices.
    """
    if onto.parts:
        counts = onto.articulation.counts
        common = np.mean([size_of_parts(onto.part_shapes(row), counts) for row in range(len(onto))])
        for k, shape in enumerate(shapes):
            scale = common / size_of_parts(shape, counts) if onto.gauge == "shape" else 1.0
            shapes[k] = onto.articulation.encode(scale * shape)
        return
    mean_shape = onto.vertices(onto.coefficients.mean(axis=0))
    part = slice(None) if onto.analysed is None else onto.analysed
    mean = mean_shape[part]
    middle = mean - mean.mean(axis=0)
    for k, shape in enumerate(shapes[:, part]):
        if centroid_size(shape) <= 0:
            raise InputError("All vertices of a shape coincide, so it cannot be aligned; exclude it.")
        aligned = fit_similarity(shape, mean, with_scale=onto.gauge == "shape").apply(shape)
        if onto.gauge == "shape" and onto.source.kind == "landmarks":
            # Landmarks are projected orthogonally, as in their alignment.
            unit = (aligned - aligned.mean(axis=0)) / centroid_size(aligned)
            aligned = mean.mean(axis=0) + project_to_tangent(unit[None], mean)[0]
        elif onto.gauge == "shape":
            along = float(np.sum(aligned * middle)) / float(np.sum(middle**2))
            aligned = mean.mean(axis=0) + (aligned - aligned.mean(axis=0)) / along
        shapes[k] = mean_shape
        shapes[k, part] = aligned


def _complete_by(onto: Cohort, shapes: FloatArray, observed: BoolArray, names: Sequence[str]) -> FloatArray:
    """Estimate the unobserved analysed vertices of shapes (M, V, 3) from a cohort; `observed` is (M, V)."""
    part = np.ones(onto.n_vertices, dtype=np.bool_) if onto.analysed is None else onto.analysed
    population = np.stack([onto.vertices(k) for k in range(len(onto))])[:, part]
    out = shapes.copy()
    out[:, part] = complete_by_population(
        population, population.mean(axis=0), shapes[:, part], observed[:, part], names, onto.gauge
    )
    return out


def subjects_of(cohort: Cohort, column: str | None) -> tuple[str, ...]:
    """Return the subject of each of the N shapes: from `column`, or from `SUBJECT`; without either, one subject per
    shape.

    Raises:
        InputError: there is no such column, or one of its cells is empty.
    """
    if column is None and SUBJECT not in cohort.table.columns:
        return cohort.names
    cells = cohort.table.texts(column or SUBJECT)
    if not all(cells):
        raise InputError(
            f"{cohort.table.where}: {column or SUBJECT!r} of {cohort.names[cells.index('')]} is missing; fill it in, "
            "or exclude such shapes with --set missing=drop."
        )
    return cells


def check_distinct(cohort: Cohort) -> None:
    """Check that no two shapes are the same up to rounding, such as a scan that was copied, possibly in another pose.

    Raises:
        InputError: two shapes are the same; the message names them.
    """
    from scipy.spatial import cKDTree

    tolerance = _SAME * centroid_size(cohort.reference)
    pairs: npt.NDArray[np.intp] = cKDTree(cohort.coefficients).query_pairs(tolerance, output_type="ndarray")
    if len(pairs):
        least = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))[0]]
        first, second = cohort.names[int(least[0])], cohort.names[int(least[1])]
        raise InputError(f"{first} and {second} are the same shape up to rounding; exclude one of the two.")


def with_columns(cohort: Cohort, columns: Mapping[str, FloatArray]) -> Cohort:
    """Return the cohort with further columns of numbers (N,) in its table."""
    text_columns = {name: numbers_as_text(values) for name, values in columns.items()}
    table = replace(cohort.table, columns={**cohort.table.columns, **text_columns})
    return replace(cohort, table=table)


def padded(coords: FloatArray) -> FloatArray:
    """Return coordinates (N, L, 3); planar ones (N, L, 2) get z = 0."""
    return np.pad(coords, ((0, 0), (0, 0), (0, 3 - coords.shape[2])))


def _orthonormal(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis (K, D) of `rows` (N, D), and their coefficients (N, K) in it.

    Coordinates that are 0 in all rows, such as z of planar landmarks, are 0 in the basis, without rounding.
    """
    varying = rows.any(axis=0) | ~rows.any()
    q, r = np.linalg.qr(rows[:, varying].T)
    basis = np.zeros((q.shape[1], rows.shape[1]))
    basis[:, varying] = q.T
    return read_only(basis), read_only(r.T)


def _in_basis(rows: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis (K, D) of the span of `rows`, and coefficients of the same vectors in it."""
    if np.abs(rows @ rows.T - np.eye(len(rows))).max() <= _ORTHONORMAL:
        return read_only(rows), read_only(coefficients)
    q, r = np.linalg.qr(rows.T)
    return read_only(q.T), read_only(coefficients @ r.T)
