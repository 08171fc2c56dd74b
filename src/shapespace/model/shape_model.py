"""The shape model: a mean, an orthonormal basis of modes, and the standard deviation of each mode (P1-P6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import CorrespondenceError, InputError, ModelFileError
from shapespace.formats.model_parts import LinearModel
from shapespace.geometry.articulation import Articulation
from shapespace.geometry.normals import without_estimates
from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import POSE, fit_similarity, small_poses, small_similarity
from shapespace.io.interop import MeshLike
from shapespace.lazy import OpenViewer, lazy_import
from shapespace.model import model_file
from shapespace.model.foreign import Foreign, as_linear, is_foreign, load_foreign
from shapespace.model.missing import MIN_SEEN
from shapespace.model.pca import Modes
from shapespace.model.representation import REPRESENTATIONS, Articulated, Representation
from shapespace.model.training_shapes import TrainingShapes
from shapespace.types import (
    BoolArray,
    FloatArray,
    IntArray,
    Mesh,
    Similarity,
    SurfaceLandmarks,
    generator_of,
    read_only,
    require_path,
    set_fields,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from shapespace.model.streamed import Log, Meshes, Scratch

_PROJECTION_ITERATIONS = 200  # limit of the alternation of pose and coefficients
_PROJECTION_TOLERANCE = 1e-10  # change of coefficients, in SD of the first mode, that ends it: float64 rounding
_FEWEST_OBSERVED = 3  # vertices that determine a pose
_LEAST_NOISE = 1e-12  # share of the first mode's variance, so that models without noise determine all modes
_SHARE_TOLERANCE = 1e-12  # share of variance; cumulative sums in float64 are off by less
_TOLD = 300  # characters of a library's error that a message repeats
_FILE = "_file"
"""Attribute that is not a field: neither copies nor states of a model have it."""
_VECTOR = "mean"
"""Key in `ShapeModel.coding` of the code of the mean shape, for representations other than vertices."""
_ROUNDING = 64 * float(np.finfo(float).eps)
_WIDEST = 1e6
"""Smallest and largest standard deviation as shares of the norm of the mean shape's vertices about their centre."""

_LEAST_MM, _MOST_MM = 1.0, 3000.0
"""Range of the largest extent of an object in mm; outside it, the object is more likely in another unit."""


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """A surface is close to mean + basis @ b, with b_k of standard deviation stddev_k (P6).

    Coefficients b are in mm; z = b / stddev are their values in standard deviations. The methods take and return b;
    `to_z` and `to_b` convert between them.

    Args:
        mean: (V, 3) vertices of the mean shape, mm. It may be given as (D,); D = 3V for vertices, 3mn for B-splines of
            m x n control points.
        basis: (D, K) columns that move the vertices orthonormally; for vertices they are themselves orthonormal.
        stddev: (K,) standard deviation of each coefficient, mm.
        total_variance: variance of all modes of the training set, kept or not, mm^2; if `held_out`, that of the
            held-out shapes.
        n_training: number of training shapes.
        faces: (F, 3) int32 triangles, or None for point models.
        gauge: `form` (rigid; size is part of the modes) or `shape` (size removed).
        landmarks: named points on the surface; a mapping of name to vertex may be given for landmarks at vertices.
        representation: a name of `REPRESENTATIONS`.
        coding: arrays of that representation, and the mean in it; empty for vertices.
        provenance: description of the training data.
        licence: licence of the training data.
        held_out: whether variances were estimated on shapes that took no part in the modes, so that they are valid for
            new shapes.
        residuals: (K,) mm^2, |C v - lambda v| of each mode if it was found by passes over the shapes (PCA beyond
            memory); None if the modes are exact to rounding.
        regions: name -> (n,) int32, the vertices of a part of the surface that a fit can be restricted to.
        parts: names of the structures of one subject, such as bones: regions that follow one another and have all
            vertices; empty if the surface is one structure.
        is_n_training_known: whether the number of training shapes is known; False for a model of another tool whose
            file does not state it, such as a Gaussian process; `n_training` is then K + 1.
        left_out: number of modes that were omitted, since alignment or rounding alone caused them; it is not saved.
        training: training shapes, by which results are calibrated (docs/uncertainty.md); None for models of other
            tools, and for models that are shared without `training`. The content hash does not depend on them, and
            copies and other processes do not have them.
        dropped_vertices: (U,) int32 vertices of the training meshes that are not in the model, since too few meshes
            observe them; its own are the V others in order. `project` accepts shapes with and without them.
        notes: sentences on its training shapes and its number of modes; the content hash does not depend on them.

    Raises:
        InputError: arrays whose shapes do not belong together, or impossible standard deviations.
    """

    mean: FloatArray
    basis: FloatArray
    stddev: FloatArray
    total_variance: float
    n_training: int
    faces: IntArray | None = None
    gauge: Gauge = "shape"
    landmarks: SurfaceLandmarks = field(default_factory=SurfaceLandmarks)
    representation: str = "vertices"
    coding: Mapping[str, npt.NDArray[Any]] = field(default_factory=lambda: dict[str, npt.NDArray[Any]]())
    provenance: str = ""
    licence: str = ""
    held_out: bool = False
    residuals: FloatArray | None = None
    left_out: int = 0
    is_n_training_known: bool = True
    regions: Mapping[str, IntArray] = field(default_factory=lambda: dict[str, IntArray]())
    parts: tuple[str, ...] = ()
    training: TrainingShapes | None = field(default=None, repr=False)
    dropped_vertices: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int32), repr=False)
    notes: Sequence[str] = ()

    def __repr__(self) -> str:
        faces = "" if self.faces is None else f", {len(self.faces):,} triangles"
        known = f" of {self.n_training} shapes" if self.is_n_training_known else ""
        notes = f"; {len(self.notes)} in notes" if self.notes else ""
        return (
            f"<ShapeModel{known} with {self.n_vertices:,} vertices{faces}, {self.n_modes} modes, gauge {self.gauge}; "
            f"{100 * self.cumulative_variance[-1]:.1f} % of the variance; {len(self.landmarks)} landmarks{notes}>"
        )

    def __post_init__(self) -> None:
        given, basis, stddev = read_only(self.mean), read_only(self.basis), read_only(self.stddev)
        # A copy of a B-spline model passes the vertices, which do not determine its control points.
        mean = read_only(self.coding.get(_VECTOR, given) if given.ndim == 2 else given).reshape(-1)
        d, k = len(mean), len(stddev)
        plain = given.ndim == 1 or given.shape[1:] == (3,)
        if not plain or stddev.ndim != 1 or d % 3 or basis.shape != (d, k) or k < 1:
            raise InputError(
                f"A shape model needs mean (V, 3), basis (3V, K) and stddev (K,), not {given.shape}, {basis.shape} "
                f"and {stddev.shape}."
            )
        if not (
            np.isfinite(mean).all() and np.isfinite(basis).all() and np.isfinite(stddev).all() and stddev.min() > 0
        ):
            raise InputError("The arrays of a shape model must be finite and its standard deviations positive.")
        if not (np.isfinite(self.total_variance) and self.total_variance > 0):
            raise InputError(f"The total variance of a shape model must be positive, not {self.total_variance!r}.")
        if self.gauge not in ("form", "shape"):
            raise InputError(f"There is no gauge {self.gauge!r}; choose form (rigid) or shape (with scale).")
        if self.representation not in REPRESENTATIONS:
            raise InputError(f"There is no representation {self.representation!r} in this version of shapespace.")
        if self.residuals is not None:
            residuals = read_only(self.residuals)
            if residuals.shape != (k,) or not (residuals >= 0).all():
                raise InputError(
                    f"The residuals of {k} modes must be as many numbers from 0 up, not {residuals.shape}."
                )
            set_fields(self, residuals=residuals)
        set_fields(
            self, basis=basis, stddev=stddev, landmarks=SurfaceLandmarks.of(self.landmarks),
            total_variance=float(self.total_variance), n_training=int(self.n_training),
        )  # fmt: skip
        arrays = dict(self._coder.arrays())
        set_fields(self, coding=MappingProxyType({**arrays, _VECTOR: mean} if arrays else {}))
        checked = Mesh(self._coder.decode(mean), self.faces, name="model")
        if given.ndim == 2 and arrays and not np.array_equal(given, checked.vertices):
            raise InputError("The vertices of this mean are not those of its B-spline; give its control points (D,).")
        set_fields(self, mean=checked.vertices, faces=checked.faces)
        _check_stddev(stddev, checked.vertices)
        if self.training is not None:
            rows, rest = self.training.rest.shape
            if (rest and rows != checked.vertices.size) or self.training.coefficients.shape[1] != k + rest:
                raise InputError(f"The training shapes do not belong to a model of {k} modes.")
            _check_stddev(self.training.stddev[k:], checked.vertices, first_mode=k)
            _check_stddev(np.maximum(self.training.stddev[:k], stddev), checked.vertices)
        source = len(checked.vertices) + len(self.dropped_vertices)
        none = np.zeros(0, dtype=np.int32)
        dropped = region_vertices(self.dropped_vertices, source, "dropped") if len(self.dropped_vertices) else none
        if len(dropped) != len(self.dropped_vertices):
            raise InputError("A dropped vertex of a shape model is listed twice.")
        self.landmarks.check(len(checked.vertices))
        regions = {
            str(name): region_vertices(vertices, len(checked.vertices), name) for name, vertices in self.regions.items()
        }
        if self.parts:
            of_parts = [regions[name] for name in self.parts if name in regions]
            every = np.concatenate([*of_parts, none])
            if len(of_parts) < max(2, len(self.parts)) or not np.array_equal(every, np.arange(len(checked.vertices))):
                raise InputError(
                    f"The parts {', '.join(self.parts)} of a shape model must be two or more of its regions, which "
                    "follow one another and have all vertices."
                )
        set_fields(
            self, dropped_vertices=dropped, regions=MappingProxyType(regions), notes=tuple(self.notes),
            parts=tuple(self.parts),
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        # For copies, other processes and skops, none of which takes read-only mappings.
        plain = {"regions": dict(self.regions), "landmarks": self.landmarks.__getstate__()}
        return {**self.fields(), **plain, "training": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**{**state, "landmarks": SurfaceLandmarks(**state["landmarks"])})  # type: ignore[misc]

    @classmethod
    def fit(
        cls,
        meshes: Meshes | Sequence[MeshLike] | str | PathLike[str],
        *,
        modes: Modes = "all",
        gauge: Gauge = "shape",
        align: bool = True,
        alignment_vertices: IntArray | None = None,
        landmarks: Mapping[str, int] | None = None,
        representation: str = "vertices",
        control_points: tuple[int, int] | None = None,
        min_seen: float = MIN_SEEN,
        provenance: str = "",
        licence: str = "",
        seed: int = 0,
        out_of_core: bool | None = None,
        without_training_shapes: bool = False,
        scratch: Scratch | None = None,
        keep_shapes: Path | None = None,
        tell: Log | None = None,
    ) -> ShapeModel:
        """Build a model of meshes in correspondence, mm (P1-P5); short for `build_model`.

        The arguments are those of `build_model` and the fields of `BuildConfig`.
        """
        config = lazy_import("BuildConfig")(
            modes=modes,
            gauge=gauge,
            align=align,
            alignment_vertices=alignment_vertices,
            landmarks=landmarks,
            representation=representation,
            control_points=control_points,
            min_seen=min_seen,
            provenance=provenance,
            licence=licence,
            seed=seed,
            out_of_core=out_of_core,
            without_training_shapes=without_training_shapes,
        )
        return lazy_import("build_model")(meshes, config, scratch=scratch, keep_shapes=keep_shapes, log=tell)

    def with_more(
        self,
        meshes: Meshes,
        shapes: Path,
        *,
        modes: Modes = "all",
        provenance: str = "",
        licence: str = "",
        seed: int = 0,
        scratch: Scratch | None = None,
        keep_shapes: Path | None = None,
        tell: Log | None = None,
    ) -> ShapeModel:
        """Return the model of this model's training shapes and of `meshes`; see `build_model.extend_model`."""
        config = lazy_import("BuildConfig")(modes=modes, provenance=provenance, licence=licence, seed=seed)
        return lazy_import("extend_model")(
            self, meshes, shapes, config, scratch=scratch, keep_shapes=keep_shapes, log=tell
        )

    @property
    def _vector(self) -> FloatArray:
        """(D,) mean shape in its representation."""
        return self.coding.get(_VECTOR, self.mean.reshape(-1))

    @cached_property
    def _coder(self) -> Representation:
        return REPRESENTATIONS[self.representation].from_arrays(self.coding)

    @property
    def n_modes(self) -> int:
        """K, the number of modes."""
        return len(self.stddev)

    @property
    def n_vertices(self) -> int:
        """V, the number of vertices."""
        return len(self.mean_vertices)

    @property
    def mean_vertices(self) -> FloatArray:
        """Vertices of the mean shape, (V, 3) mm; the same as `mean`."""
        return self.mean

    @cached_property
    def vertex_basis(self) -> FloatArray:
        """(3V, K) displacements of the vertices along each mode, orthonormal columns; `basis` itself for vertices."""
        return self._coder.directions(self.basis)

    @cached_property
    def _modes(self) -> FloatArray:
        """The transposed basis, (K, D), which is contiguous for each mode, so that products with it are fast."""
        return np.ascontiguousarray(self.basis.T)

    @cached_property
    def _vertex_modes(self) -> FloatArray:
        """The vertex basis transposed, (K, 3V)."""
        return self._modes if self.vertex_basis is self.basis else np.ascontiguousarray(self.vertex_basis.T)

    @property
    def noise_variance(self) -> float:
        """Variance per coordinate of the vertices outside the kept modes, mm^2.

        Tipping and Bishop, JRSS B 61(3), 1999. It includes the variation that the representation cannot describe.
        """
        of_modes = float((self.stddev**2).sum())
        return max(self.total_variance - of_modes, 0.0) / max(3 * self.n_vertices - self.n_modes, 1)

    @cached_property
    def cumulative_variance(self) -> FloatArray:
        """(K,) share of the training variance of the first k modes."""
        return np.cumsum(self.stddev**2) / self.total_variance

    def modes_for_variance(self, share: float) -> int | None:
        """Return the number of modes with `share` of the training variance; None if all kept modes have less."""
        if self.cumulative_variance[-1] < share - _SHARE_TOLERANCE:
            return None
        return int(np.searchsorted(self.cumulative_variance, share - _SHARE_TOLERANCE)) + 1

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of all data of the model, independent of its file."""
        return model_file.hash_of(self.fields())

    @property
    def in_file(self) -> bool:
        """Whether it was read from a file or saved to one, so that later runs need its derived data again."""
        return self.file is not None

    @property
    def file(self) -> Path | None:
        """File that it was read from or saved to last, in shapespace's own format; None without a file."""
        return vars(self).get(_FILE)

    def reconstruct(self, b: npt.ArrayLike) -> FloatArray:
        """Return the vertices (V, 3), mm, of the shape with coefficients `b` (P6).

        Args:
            b: (k,) coefficients, mm, k at most K; missing coefficients are zero.

        Raises:
            InputError: more coefficients than modes, or values that are not finite.
        """
        b = self._coefficients(b)
        return self._coder.decode(self.vector(b))

    def vector(self, b: npt.ArrayLike = ()) -> FloatArray:
        """Return the vector (D,) that represents the shape with coefficients `b` (k,) mm; see `Representation`."""
        b = np.asarray(b, dtype=np.float64)
        return self._vector + b @ self._modes[: len(b)]

    def directions(self, b: FloatArray) -> FloatArray:
        """Return (3V, K) displacements of the vertices along each mode at the shape `b` (k,) mm, to first order.

        They are `vertex_basis` for every shape, unless the relative pose of several parts is modelled.
        """
        return self.vertex_basis if self.is_linear else self._coder.directions(self.basis, self.vector(b))

    @property
    def is_linear(self) -> bool:
        """Whether vertices are linear in the coefficients; False if the relative pose of several parts is modelled."""
        return self._coder.is_linear

    @property
    def part_counts(self) -> dict[str, int]:
        """Number of vertices of each part by its name, in order; empty if the surface is one structure."""
        return {name: len(self.regions[name]) for name in self.parts}

    @property
    def vertices_of_parts(self) -> dict[str, IntArray]:
        """Vertices of each part by its name; empty if the surface is one structure."""
        return {name: self.regions[name] for name in self.parts}

    @property
    def part_of_vertex(self) -> IntArray | None:
        """(V,) index of the part of each vertex; None if the surface is one structure."""
        counts = list(self.part_counts.values())
        return np.repeat(np.arange(len(counts), dtype=np.int32), counts) if counts else None

    @property
    def articulation(self) -> Articulation | None:
        """The parts with their joints, if their relative pose is modelled."""
        return self._coder.parts if isinstance(self._coder, Articulated) else None

    def mesh(self, b: npt.ArrayLike = ()) -> Mesh:
        """Return the shape with coefficients `b` (k,) mm as a mesh with the model's triangles and landmarks."""
        vertices = self.reconstruct(b)
        return Mesh(vertices, self.faces, self.landmarks.positions(vertices), name="model")

    def project(self, shape: Mesh | FloatArray, *, align: bool = True) -> FloatArray:
        """Return the coefficients b (K,), mm, of a shape in vertex correspondence: b = P^T (Q - mean) (P19).

        Args:
            shape: a mesh or (V, 3) vertices, mm, in the order of the model's vertices or of those of its training
                meshes, of which `dropped_vertices` are not used. Vertices that are not-a-number or not observed are
                missing: b is then the likeliest given the others.
            align: whether to estimate its pose along with b, by the model's gauge; False if the shape is in the
                model's frame already.

        Raises:
            CorrespondenceError: another number of vertices than the model's.
            InputError: values that are infinite, or hardly any vertex is observed.
        """
        shape = without_estimates(shape) if isinstance(shape, Mesh) else shape
        vertices = shape.vertices if isinstance(shape, Mesh) else np.asarray(shape, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InputError(f"A shape to be projected must have the shape (V, 3), not {vertices.shape}.")
        if len(vertices) == self.n_vertices + len(self.dropped_vertices):
            vertices = np.delete(vertices, self.dropped_vertices, axis=0)
        if len(vertices) != self.n_vertices:
            raise CorrespondenceError(
                f"{shape.name if isinstance(shape, Mesh) else 'The shape'} has {len(vertices)} vertices but the model "
                f"has {self.n_vertices}; only shapes in the model's vertex order can be projected; fit this mesh "
                "instead (shapespace fit, or fit_scan)."
            )
        is_observed: BoolArray = ~np.logical_or.reduce(np.isnan(vertices), axis=1)
        if np.isinf(vertices).any() or is_observed.sum() < _FEWEST_OBSERVED:
            raise InputError("A shape to be projected must be finite, except for missing vertices (nan).")
        if not align:
            return self.nearest(vertices)
        if not self.is_linear:
            return self.nearest_in_any_pose(vertices, with_scale=self.gauge == "shape")[0]
        b, Q = np.zeros(self.n_modes), self.mean_vertices
        used = slice(None) if is_observed.all() else is_observed  # a mask copies
        for _ in range(_PROJECTION_ITERATIONS):
            # Phase 2 with known matches: pose and coefficients alternate, since modes may contain a part of a pose.
            T_shape_model = fit_similarity(Q[used], vertices[used], with_scale=self.gauge == "shape")
            before, b = b, self.nearest(T_shape_model.inverse().apply(vertices))
            if np.abs(b - before).max() <= _PROJECTION_TOLERANCE * self.stddev[0]:
                break
            Q = self.reconstruct(b)
        return b

    def nearest(self, vertices: FloatArray, modes: int | None = None, noise: float | None = None) -> FloatArray:
        """Return the coefficients (k,), mm, of the shape of the first modes that is nearest to vertices (V, 3).

        If some are missing, these are the likeliest given the others, b = (P^T P + s / variance)^-1 P^T y, since the
        nearest shape would not determine the missing part.

        Args:
            vertices: (V, 3) vertices in the model's frame, mm; not-a-number where missing.
            modes: k, the number of modes; None for all.
            noise: s, the variance of a coordinate outside the modes, mm^2; None for `noise_variance`.
        """
        if not self.is_linear:
            return self.nearest_in_any_pose(
                vertices, with_scale=False, posed=False, noise=noise, stddev=self.stddev[:modes]
            )[0]
        off, modes_used = vertices - self.mean_vertices, self._vertex_modes[:modes]
        if not np.isnan(vertices).any():
            return modes_used @ off.reshape(-1)
        is_observed: BoolArray = ~np.logical_or.reduce(np.isnan(vertices), axis=1)
        seen = modes_used.reshape(len(modes_used), -1, 3)[:, is_observed].reshape(len(modes_used), -1)
        noise = max(self.noise_variance, _LEAST_NOISE * self.stddev[0] ** 2) if noise is None else noise
        precision = seen @ seen.T + np.diag(noise / self.stddev[:modes] ** 2)
        return np.asarray(np.linalg.solve(precision, seen @ off[is_observed].reshape(-1)), dtype=np.float64)

    def nearest_in_any_pose(
        self, vertices: FloatArray, *, with_scale: bool, posed: bool = True, noise: float | None = None,
        stddev: FloatArray | None = None,
    ) -> tuple[FloatArray, Similarity]:  # fmt: skip
        """Return coefficients (k,) mm and pose of the nearest shape, by Gauss-Newton steps on both (S8).

        Alternation of pose and coefficients is slow if vertices are not linear in the coefficients.

        Args:
            vertices: (V, 3) vertices, mm; not-a-number where missing.
            with_scale: whether the scale of the pose is free.
            posed: whether to estimate the pose; False if the vertices are in the model's frame.
            noise: variance of a coordinate outside the modes, mm^2, with the prior of the coefficients; None without
                the prior, or `noise_variance` if vertices are missing.
            stddev: (k,) standard deviations of the prior, mm; None for those of all modes.
        """
        stddev = self.stddev if stddev is None else stddev
        is_observed: BoolArray = ~np.logical_or.reduce(np.isnan(vertices), axis=1)
        if noise is None:
            noise = 0.0 if is_observed.all() else max(self.noise_variance, _LEAST_NOISE * stddev[0] ** 2)
        free, k = (POSE if with_scale else POSE - 1) if posed else 0, len(stddev)
        seen, T = vertices[is_observed], Similarity.identity()
        if posed:
            T = fit_similarity(self.mean_vertices[is_observed], seen, with_scale=with_scale)
        b, precision = np.zeros(k), noise / stddev**2
        for _ in range(_PROJECTION_ITERATIONS):
            x = self.reconstruct(b)
            moves = np.column_stack([small_poses(x)[:, :free], self.directions(b)[:, :k]])
            rows = moves.reshape(len(x), 3, -1)[is_observed].reshape(3 * len(seen), -1)
            pull = rows.T @ (T.inverse().apply(seen) - x[is_observed]).ravel()
            pull[free:] -= precision * b
            normal = rows.T @ rows
            normal[free:, free:] += np.diag(precision)
            unit = 1.0 / np.sqrt(normal.diagonal())
            step = unit * np.linalg.solve(normal * np.outer(unit, unit), unit * pull)
            if noise > 0.0:  # parts that are not seen turn freely, and large rotations are not linear
                step /= max(1.0, float(np.abs(step[free:] / stddev).max()))
            if posed:
                T = T @ small_similarity(np.pad(step[:free], (0, POSE - free)))
            b = b + step[free:]
            if np.abs(step[free:]).max() <= _PROJECTION_TOLERANCE * self.stddev[0]:
                break
        return b, T

    def to_z(self, b: npt.ArrayLike) -> FloatArray:
        """Return coefficients z (..., k), in standard deviations, of `b` (..., k) in mm; k is at most K."""
        b = np.asarray(b, dtype=np.float64)
        return b / self._stddev_of(b)

    def to_b(self, z: npt.ArrayLike) -> FloatArray:
        """Return coefficients b (..., k), in mm, of `z` (..., k) in standard deviations; k is at most K."""
        z = np.asarray(z, dtype=np.float64)
        return z * self._stddev_of(z)

    def _stddev_of(self, coefficients: FloatArray) -> FloatArray:
        count = coefficients.shape[-1] if coefficients.ndim else self.n_modes + 1
        if count > self.n_modes:
            raise InputError(
                f"Coefficients must have the shape (..., k) with k at most {self.n_modes}, not {coefficients.shape}."
            )
        return self.stddev[:count]

    def sample(self, count: int, rng: np.random.Generator | int) -> FloatArray:
        """Return coefficients (count, K), mm, drawn from the normal distribution of the model.

        Args:
            count: number of shapes.
            rng: generator, or a seed.

        Raises:
            InputError: `rng` is neither a generator nor a seed from 0, or `count` is not a number of shapes.
        """
        if not isinstance(count, int | np.integer) or count < 0:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise InputError(f"ShapeModel.sample takes a number of shapes, not {count!r}.")
        rng = generator_of(rng, "ShapeModel.sample")
        return rng.standard_normal((count, self.n_modes)) * self.stddev

    def truncate(self, modes: int) -> ShapeModel:
        """Return the model with its first `modes` modes; the variance of the others is added to `noise_variance`.

        Raises:
            InputError: fewer than one, or more than the model has.
        """
        if not 1 <= modes <= self.n_modes:
            raise InputError(f"This model has {self.n_modes} modes, so it cannot be cut to {modes}.")
        residuals = None if self.residuals is None else self.residuals[:modes]
        training = None if self.training is None else self.training.truncated(self.vertex_basis, modes)
        return dataclasses.replace(
            self, basis=self.basis[:, :modes], stddev=self.stddev[:modes], residuals=residuals, training=training
        )

    @cached_property
    def with_all_modes(self) -> ShapeModel:
        """The model of the vertices with all modes of its training shapes; the model itself if it has no others."""
        training = self.training
        if training is None or not training.rest.shape[1]:
            return self
        stddev = training.stddev[self.n_modes :]
        return dataclasses.replace(
            self, mean=self.mean_vertices.ravel() if self.is_linear else self.mean,
            basis=np.concatenate([self.vertex_basis, training.rest], axis=1),
            stddev=np.concatenate([self.stddev, stddev]), residuals=None,
            representation="vertices" if self.is_linear else self.representation,
            coding={} if self.is_linear else self.coding,
            total_variance=max(self.total_variance, float((self.stddev**2).sum() + (stddev**2).sum())),
            training=dataclasses.replace(training, rest=training.rest[:, :0]),
        )  # fmt: skip

    def fields(self) -> model_file.ModelFields:
        """Return the data of the model by the names of its arguments."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        coding = {name: array for name, array in self.coding.items() if name != _VECTOR}
        return {**plain, "mean": self._vector, "coding": coding}

    def save(self, path: Path | str) -> None:
        """Write the model to one HDF5 file, completely or not at all.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        model_file.save(self.fields(), Path(path))
        vars(self)[_FILE] = Path(path).absolute()

    @classmethod
    def load(cls, path: Path | str) -> ShapeModel:
        """Read a model written by `save`, checking its hashes, or one in a format of another tool.

        If such a file separates identity and expression, the model contains both; `AdditiveModel.load` separates them.

        Raises:
            FileError: the file cannot be read.
            ModelFileError: the file is damaged, of another version, or not a model.
            InputError: the argument is not a path.
        """
        require_path(path, "ShapeModel.load")
        if is_foreign(Path(path)):
            return cls.of_foreign(load_foreign(Path(path)), Path(path))
        fields = model_file.load(Path(path))
        try:
            with np.errstate(all="ignore"):  # huge numbers overflow before they are rejected
                model = cls(**fields)
        except InputError as error:
            message = str(error)[:_TOLD]
            raise ModelFileError(
                f"{path} is a shapespace model whose parts do not belong together: {message}"
            ) from error
        vars(model)[_FILE] = Path(path).absolute()
        return model

    @classmethod
    def of_foreign(cls, foreign: Foreign, path: Path) -> ShapeModel:
        """Return the model in the file `path` of another tool.

        Raises:
            ModelFileError: the parts do not make a model.
        """
        try:
            return cls(**foreign.fields)
        except InputError as error:
            raise ModelFileError(f"{path} ({foreign.format}) is no usable model: {str(error)[:_TOLD]}") from error

    def plot(self, what: str = "modes", **options: Any) -> Figure:
        """Return a matplotlib figure of the model.

        Args:
            what: `modes`, the first modes at minus and plus 3 standard deviations; `mean`, from three sides; or
                `spectrum`, the share of the variance by the number of modes.
            options: options of the figure's function in `shapespace.report.figures`, such as `modes=8`.

        Raises:
            InputError: there is no such plot.
            ShapespaceError: the extra `report` is not installed.
        """
        return lazy_import("plot_model")(self, what, **options)

    def view(self, *, height_px: int = 720) -> OpenViewer:
        """Open the viewer on the model; in a notebook, in the frame of the cell; see `FitResult.view`.

        Args:
            height_px: height of the frame, pixels.

        Raises:
            ShapespaceError: the extra `view` is not installed.
        """
        return lazy_import("view_model")(self, height_px=height_px)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_model")(self)

    def as_linear(self) -> LinearModel:
        """Return the part of the model that formats of other tools can represent."""
        return as_linear(self.fields(), self.mean_vertices, self.vertex_basis)

    def _coefficients(self, b: npt.ArrayLike) -> FloatArray:
        array = np.atleast_1d(np.asarray(b, dtype=np.float64))
        if array.ndim != 1 or len(array) > self.n_modes:
            raise InputError(f"Coefficients must have the shape (k,) with k at most {self.n_modes}, not {array.shape}.")
        if not np.isfinite(array).all():
            raise InputError("Coefficients must be finite.")
        return array


def region_vertices(vertices: npt.ArrayLike, n_vertices: int, name: str) -> IntArray:
    """Return the vertices of a region, (n,) int32, each once, in order; `name` is its name in messages.

    Raises:
        InputError: the region is empty, or has a vertex that a model of `n_vertices` does not have.
    """
    unique = np.unique(np.asarray(vertices, dtype=np.int64))
    if unique.ndim != 1 or not len(unique) or unique[0] < 0 or unique[-1] >= n_vertices:
        raise InputError(
            f"The region {name!r} needs vertices from 0 to {n_vertices - 1}, which the model has; give some of those."
        )
    region = unique.astype(np.int32)
    region.setflags(write=False)
    return region


def odd_size_notes(mean: FloatArray) -> list[str]:
    """Return a note if the size of a mean shape (V, 3), mm, suggests another unit, else no note."""
    extent = np.ptp(mean, axis=0)
    if _LEAST_MM < float(extent.max()) < _MOST_MM:
        return []
    size = " x ".join(f"{length:.3g}" for length in extent)
    return [f"The mean is {size} mm large, which is unusual for mm; set the unit of the meshes with --unit."]


def _check_stddev(stddev: FloatArray, mean_vertices: FloatArray, first_mode: int = 0) -> None:
    """Raise if a mode varies by less than the rounding of the vertices, or far more than the size of the shape."""
    norm = float(np.linalg.norm(mean_vertices - mean_vertices.mean(axis=0)))
    if norm == 0.0 or not len(stddev):
        return
    for mode, value in ((int(stddev.argmin()), float(stddev.min())), (int(stddev.argmax()), float(stddev.max()))):
        if value < _ROUNDING * norm:
            raise InputError(
                f"Mode {first_mode + mode + 1} of the model has a standard deviation of {value:.1e} mm, which is less "
                "than the rounding of its vertices; omit such modes."
            )
        if value > _WIDEST * norm:
            raise InputError(
                f"Mode {first_mode + mode + 1} of the model has a standard deviation of {value:.1e} mm, which no shape "
                "of its size can have; check its unit."
            )
