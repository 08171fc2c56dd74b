"""Data types that all parts share: meshes, landmarks, similarities and label volumes.

Arrays are float64 and read-only. Lengths are millimetres, except the vertices of a scan as read from its file, which
are in the unit of the file until the fit has determined that unit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite
from numbers import Integral
from os import PathLike
from types import MappingProxyType
from typing import Any, NoReturn, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import CorrespondenceError, InputError, MeshError
from shapespace.lazy import lazy_import
from shapespace.reprs import short_repr

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int32]
ByteArray: TypeAlias = npt.NDArray[np.uint8]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

MM_PER_UNIT: Mapping[str, float] = MappingProxyType({"um": 1e-3, "mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0})
"""Length of each supported unit of scans, mm."""

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])
"""Signs that convert points (..., 3) from right, anterior, superior to left, posterior, superior, and back."""

GREY = 128
"""Red, green and blue of vertices without a colour, if other vertices of the surface have colours."""


_MOST_VERTICES = int(np.iinfo(np.int32).max)
_FEW_DIGITS, _ROUNDING = 1e-4, 1e-12
"""Tolerated differences of the sum of barycentric coordinates from 1: for text with few digits, and for rounding."""


def require(value: object, expected: type, function: str, remedy: str) -> None:
    """Raise an InputError if an argument has the wrong type.

    Args:
        value: argument to check.
        expected: expected type of the argument.
        function: name of the function that received the argument.
        remedy: advice for the caller, as the end of the message.

    Raises:
        InputError: the argument has another type.
    """
    if not isinstance(value, expected):
        raise InputError(f"{function} takes a {expected.__name__}, not {type(value).__name__}; {remedy}.")


def require_path(value: object, function: str) -> None:
    """Raise an InputError if an argument is not a path.

    Raises:
        InputError: the argument is neither text nor a path.
    """
    if not isinstance(value, str | PathLike):
        raise InputError(f"{function} takes a path, not {type(value).__name__}; give a str or a Path.")


def require_whole(value: object, name: str) -> None:
    """Raise an InputError if a setting is neither an integer nor None.

    Raises:
        InputError: the setting has another type.
    """
    if value is not None and not isinstance(value, Integral):
        raise InputError(f"{name} is an integer or None, not {type(value).__name__}; give a number such as 10.")


def generator_of(rng: object, function: str) -> np.random.Generator:
    """Return a random generator, created from a seed if needed.

    Args:
        rng: `np.random.Generator`, or a non-negative integer as its seed.
        function: name of the function that received `rng`, used in the message.

    Raises:
        InputError: `rng` is neither.
    """
    if isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, bool) or not isinstance(rng, Integral) or int(rng) < 0:
        raise InputError(f"{function} takes a seed from 0 or a np.random.Generator, not {rng!r:.40}.")
    return np.random.default_rng(int(rng))


def read_only(array: npt.ArrayLike) -> FloatArray:
    """Return `array` as a read-only C-ordered float64 array; a view if no copy is needed.

    Args:
        array: array or sequence that numpy can convert to float64, of any shape.
    """
    out = np.ascontiguousarray(array, dtype=np.float64).view()
    out.setflags(write=False)
    return out


def set_fields(instance: object, **fields: object) -> None:
    """Set fields of a frozen instance during its creation, such as those that `__post_init__` converts."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface, or a point cloud if it has no faces.

    Args:
        vertices: (V, 3) float64 positions, in the order of the file; V may be 0 only during the examination of a file.
        faces: (F, 3) int32 indices into `vertices`, counter-clockwise seen from outside; None for a point cloud.
        landmarks: name -> (3,) float64 position, in the same frame and unit as `vertices`.
        name: name of the source, used in messages and result files.
        colours: (V, 3) uint8 red, green and blue (sRGB) of each vertex; None if unknown.
        notes: sentences about data of the file that were omitted or changed.
        observed: (V,) bool, False for vertices whose positions are estimates because the scan does not show them;
            None if all are observed.
        position_std: (V,) standard deviation of the position of each vertex in any direction along the surface, in the
            unit of `vertices`; None if unknown.
        parts: (V,) int32 index of the part of a model that each vertex shows; None if unknown.

    Raises:
        MeshError: arrays of the wrong shape, or faces that index past the end of the vertices.
    """

    vertices: FloatArray
    faces: IntArray | None = None
    landmarks: Mapping[str, FloatArray] = field(default_factory=lambda: dict[str, FloatArray]())
    name: str = "mesh"
    colours: ByteArray | None = None
    notes: tuple[str, ...] = ()
    observed: BoolArray | None = None
    position_std: FloatArray | None = None
    parts: IntArray | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        vertices = read_only(self.vertices)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise MeshError(f"{self.name}: vertices must have the shape (V, 3), not {vertices.shape}.")
        object.__setattr__(self, "vertices", vertices)
        if self.faces is not None:
            raw = np.asarray(self.faces)
            if raw.size == 0:
                raw = raw.reshape(0, 3)
            if raw.ndim != 2 or raw.shape[1] != 3:
                raise MeshError(f"{self.name}: faces must have the shape (F, 3), not {raw.shape}.")
            if raw.dtype.kind == "f" and (raw % 1 != 0).any():
                raise MeshError(f"{self.name}: faces must be integers, the indices of vertices.")
            if raw.size and (raw.min() < 0 or raw.max() >= len(vertices)):
                bad = int(raw.max()) if raw.max() >= len(vertices) else int(raw.min())
                raise MeshError(
                    f"{self.name}: a face points at vertex {bad}, but there are only {len(vertices)} vertices, "
                    f"counted from 0; correct the faces, or export the file again."
                )
            faces = np.ascontiguousarray(raw, dtype=np.int32).view()
            faces.setflags(write=False)
            object.__setattr__(self, "faces", faces if len(faces) else None)
        landmarks = {str(k): read_only(v) for k, v in self.landmarks.items()}
        for key, point in landmarks.items():
            if point.shape != (3,):
                raise MeshError(f"{self.name}: landmark {key!r} must be 3 numbers, not {point.shape}.")
        object.__setattr__(self, "landmarks", MappingProxyType(landmarks))
        if self.colours is not None:
            array = np.asarray(self.colours)
            if array.shape != vertices.shape or array.dtype != np.uint8:
                raise MeshError(f"{self.name}: colours must be (V, 3) uint8, not {array.shape} {array.dtype}.")
            colours = np.ascontiguousarray(array).view()
            colours.setflags(write=False)
            object.__setattr__(self, "colours", colours)
        if self.observed is not None:
            mask = np.asarray(self.observed)
            if mask.shape != vertices.shape[:1] or mask.dtype != np.bool_:
                raise MeshError(f"{self.name}: observed must be (V,) bool, not {mask.shape} {mask.dtype}.")
            flags = np.ascontiguousarray(mask).view()
            flags.setflags(write=False)
            object.__setattr__(self, "observed", None if flags.all() else flags)
        if self.position_std is not None:
            std = read_only(self.position_std)
            if std.shape != vertices.shape[:1]:
                raise MeshError(f"{self.name}: position_std must have the shape (V,), not {std.shape}.")
            object.__setattr__(self, "position_std", std)
        if self.parts is not None and self.parts.shape != vertices.shape[:1]:
            raise MeshError(f"{self.name}: parts must have the shape (V,), not {self.parts.shape}.")

    def __getstate__(self) -> dict[str, Any]:
        # For copies, other processes and skops, which do not support read-only mappings.
        fields = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        return {**fields, "landmarks": dict(self.landmarks)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def with_vertices(self, vertices: npt.ArrayLike, landmarks: Mapping[str, FloatArray] | None = None) -> Mesh:
        """Return the mesh with other `vertices` (V, 3), without `position_std`, and only with the given landmarks."""
        positions = np.asarray(vertices, dtype=np.float64)
        return Mesh(
            vertices=positions,
            faces=self.faces,
            landmarks=landmarks or {},
            name=self.name,
            colours=self.colours,
            notes=self.notes,
            observed=self.observed,
            parts=self.parts,
        )

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) smallest and largest coordinates of the vertices, in their unit."""
        return read_only([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def area(self) -> float:
        """Area of the triangles, in the square of the unit of `vertices`; 0 for a point cloud."""
        if self.faces is None:
            return 0.0
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    def export(self, path: PathLike[str] | str) -> None:
        """Write the mesh to a file, in the format of its ending; see `write_mesh`.

        Raises:
            FileFormatError: the ending is not that of a format that can be written.
            FileError: the file cannot be written.
        """
        require_path(path, "Mesh.export")
        lazy_import("write_mesh")(path, self)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` with the same vertices, or a `trimesh.PointCloud` for a point cloud.

        Landmarks are omitted in this and the following four conversions; `as_mesh` is the inverse.

        Raises:
            ShapespaceError: trimesh is not installed.
        """
        return lazy_import("to_trimesh")(self)

    def to_pyvista(self) -> Any:
        """Return a `pyvista.PolyData`.

        Raises:
            ShapespaceError: PyVista is not installed.
        """
        return lazy_import("to_pyvista")(self)

    def to_open3d(self) -> Any:
        """Return an `open3d.geometry.TriangleMesh`, or a `PointCloud` for a point cloud.

        Raises:
            ShapespaceError: Open3D is not installed.
        """
        return lazy_import("to_open3d")(self)

    def to_meshio(self) -> Any:
        """Return a `meshio.Mesh` of triangles, or of vertices for a point cloud.

        Raises:
            ShapespaceError: meshio is not installed.
        """
        return lazy_import("to_meshio")(self)

    def to_menpo(self) -> Any:
        """Return a `menpo.shape.TriMesh`, or a `PointCloud` for a point cloud.

        Raises:
            ShapespaceError: menpo is not installed.
        """
        return lazy_import("to_menpo")(self)


def _no_corners() -> IntArray:
    return np.empty((0, 3), dtype=np.int32)


@dataclass(frozen=True, eq=False)
class SurfaceLandmarks(Mapping[str, int]):
    """Named points on a surface, each in a triangle by barycentric coordinates.

    They are the same anatomical places on every surface with these vertices: `positions` returns their positions. As a
    mapping, it is name -> nearest vertex (the corner with the largest barycentric coordinate).

    Args:
        names: L names of the landmarks, all different.
        corners: (L, 3) int32 vertices of the triangle of each landmark; they are sorted by decreasing coordinates. A
            landmark at a vertex has that vertex three times.
        barycentric: (L, 3) float64 barycentric coordinates in that triangle: not negative, with the sum 1.
        distance_mm: (L,) float64 distance of each given point from the surface, mm; empty if all distances are 0.

    Raises:
        InputError: arrays with inconsistent shapes, repeated names, or coordinates that are not barycentric.

    Example:
        >>> marks = ss.geometry.SurfaceLandmarks.of({"tip": 7})
        >>> bool((marks.positions(meshes[0].vertices)["tip"] == meshes[0].vertices[7]).all())
        True
    """

    names: tuple[str, ...] = ()
    corners: IntArray = field(default_factory=_no_corners)
    barycentric: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    distance_mm: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        names = tuple(str(name) for name in self.names)
        count = len(names)
        corners, weights = np.array(self.corners, dtype=np.int64), np.array(self.barycentric, dtype=np.float64)
        distance = np.array(self.distance_mm, dtype=np.float64) if len(self.distance_mm) else np.zeros(count)
        if len(set(names)) < count:
            raise InputError("Two landmarks have the same name; rename one of the landmarks.")
        if corners.shape != (count, 3) or weights.shape != (count, 3) or distance.shape != (count,):
            raise InputError(
                f"{count} landmarks need corners ({count}, 3), barycentric coordinates ({count}, 3) and distances "
                f"({count},), not {corners.shape}, {weights.shape} and {distance.shape}."
            )
        within = bool(((weights >= 0) & (weights <= 1.0 + _FEW_DIGITS)).all())
        total = weights.sum(axis=1, keepdims=True) if within else np.zeros((count, 1))
        if not (within and (np.abs(total - 1.0) <= _FEW_DIGITS).all()):
            raise InputError("Barycentric coordinates of landmarks must not be negative, with the sum 1.")
        # Coordinates whose sum differs from 1 only by rounding are unchanged, so that writing and reading is exact.
        weights = np.where(np.abs(total - 1.0) > _ROUNDING, weights / total, weights)
        if not (np.isfinite(distance).all() and (distance >= 0).all()):
            raise InputError("Distances of landmarks from the surface must be finite and not negative.")
        order = np.argsort(-weights, axis=1, kind="stable")
        corners, weights = np.take_along_axis(corners, order, axis=1), np.take_along_axis(weights, order, axis=1)
        for name, low, high in zip(names, corners.min(axis=1), corners.max(axis=1), strict=True):
            if low < 0 or high > _MOST_VERTICES:
                raise InputError(
                    f"Landmark {name!r} is at vertex {low if low < 0 else high}, which the model does not have."
                )
        # A corner with the weight 0 may be missing from the surface, and must have no effect.
        corners = np.where(weights > 0, corners, corners[:, :1]).astype(np.int32)
        for array in (corners, weights, distance):
            array.setflags(write=False)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "barycentric", weights)
        object.__setattr__(self, "distance_mm", distance)

    __repr__ = short_repr

    def __getstate__(self) -> dict[str, Any]:
        # Plain values, like `Mesh`.
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)} | {"names": list(self.names)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def __getitem__(self, name: str) -> int:
        return self._nearest[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SurfaceLandmarks):
            return self.are_vertices and dict(self) == other
        return self.names == other.names and all(
            np.array_equal(getattr(self, array), getattr(other, array))
            for array in ("corners", "barycentric", "distance_mm")
        )

    __hash__ = None  # type: ignore[assignment]

    @staticmethod
    def of(landmarks: Mapping[str, int]) -> SurfaceLandmarks:
        """Return `landmarks`, or landmarks at vertices from a mapping of name to vertex."""
        if isinstance(landmarks, SurfaceLandmarks):
            return landmarks
        vertex = np.array([int(vertex) for vertex in landmarks.values()], dtype=object).reshape(-1, 1)
        for name, (vertex_index,) in zip(landmarks, vertex, strict=True):
            if not 0 <= vertex_index <= _MOST_VERTICES:
                raise InputError(f"Landmark {str(name)!r} is at vertex {vertex_index}, which the model does not have.")
        weights = np.zeros((len(vertex), 3))
        weights[:, 0] = 1.0
        return SurfaceLandmarks(tuple(map(str, landmarks)), np.repeat(vertex, 3, axis=1).astype(np.int32), weights)

    @property
    def are_vertices(self) -> bool:
        """Whether each landmark was given as a vertex: exactly at a vertex, with the distance 0 from the surface."""
        return bool((self.barycentric[:, 0] == 1.0).all()) and not self.distance_mm.any()

    def interpolate(self, values: npt.ArrayLike) -> FloatArray:
        """Return values of the vertices at the landmarks.

        Args:
            values: (V, ...) values of the vertices, such as their positions (V, 3).

        Returns:
            (L, ...) float64.
        """
        corner_values = np.asarray(values)[self.corners]
        return np.asarray(np.einsum("lc,lc...->l...", self.barycentric, corner_values), dtype=np.float64)

    def positions(self, vertices: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return name -> (3,) position on the surface with these `vertices` (V, 3)."""
        return dict(zip(self.names, self.interpolate(vertices), strict=True))

    def select(self, names: Sequence[str]) -> SurfaceLandmarks:
        """Return the landmarks of these `names`, in that order."""
        rows = [self.names.index(name) for name in names]
        return SurfaceLandmarks(tuple(names), self.corners[rows], self.barycentric[rows], self.distance_mm[rows])

    def joined(self, *others: SurfaceLandmarks) -> SurfaceLandmarks:
        """Return these landmarks followed by `others`, which have different names.

        Raises:
            InputError: a name occurs more than once.
        """
        parts = (self, *others)
        return SurfaceLandmarks(
            tuple(name for part in parts for name in part.names),
            np.concatenate([part.corners for part in parts]),
            np.concatenate([part.barycentric for part in parts]),
            np.concatenate([part.distance_mm for part in parts]),
        )

    def within(self, vertices: npt.ArrayLike) -> SurfaceLandmarks:
        """Return the landmarks whose vertices are all marked in `vertices` (V,) bool."""
        marked: BoolArray = np.asarray(vertices, dtype=np.bool_)[self.corners]
        rows = np.asarray(marked.all(axis=1))
        return self.select([name for name, is_inside in zip(self.names, rows, strict=True) if is_inside])

    def renumbered(self, vertices: npt.ArrayLike) -> SurfaceLandmarks:
        """Return the landmarks after removal of the vertices that are not marked in `vertices` (V,) bool."""
        remaining = self.within(vertices)
        number = np.cumsum(np.asarray(vertices, dtype=np.bool_)) - 1
        return dataclasses.replace(remaining, corners=number[remaining.corners].astype(np.int32))

    def check(self, n_vertices: int) -> None:
        """Check that a surface with `n_vertices` vertices has all vertices of the landmarks.

        Raises:
            InputError: the surface does not have a vertex of a landmark.
        """
        for name, corner in zip(self.names, self.corners.max(axis=1), strict=True):
            if corner >= n_vertices:
                raise InputError(f"Landmark {name!r} is at vertex {corner}, which the surface does not have.")

    @cached_property
    def _nearest(self) -> Mapping[str, int]:
        return dict(zip(self.names, self.corners[:, 0].tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity x -> scale * rotation @ x + translation; instances are named `T_target_source`.

    Args:
        scale: positive number.
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, in the unit of the target.

    Raises:
        InputError: a scale that is not positive, or a matrix that is not a rotation.

    Example:
        >>> T = ss.geometry.Similarity(2.0, np.eye(3), np.zeros(3))
        >>> T.apply([[1.0, 2.0, 3.0]])
        array([[2., 4., 6.]])
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    __repr__ = short_repr

    def __post_init__(self) -> None:
        rotation, translation = read_only(self.rotation), read_only(self.translation)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"A similarity needs a (3, 3) rotation and a (3,) translation, not {rotation.shape} and "
                f"{translation.shape}."
            )
        if not (isfinite(self.scale) and self.scale > 0):
            raise InputError(f"The scale of a similarity must be positive and finite, not {self.scale!r}.")
        if not all(isfinite(t) for t in translation.tolist()):
            raise InputError("The translation of a similarity must be finite.")
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()  # plain numbers for speed: 40 per fit
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if not (np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-5 and determinant > 0):
            raise InputError("The rotation of a similarity must be orthonormal with determinant +1.")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @staticmethod
    def identity() -> Similarity:
        """Return the identity transform."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Map `points` (..., 3) from the source frame to the target frame."""
        transformed = np.asarray(points, dtype=np.float64) @ (self.scale * self.rotation.T)
        transformed += self.translation
        return transformed

    def inverse(self) -> Similarity:
        """Return the similarity from the target frame back to the source frame."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """Compose: `T_c_b @ T_b_a` is `T_c_a`."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))


MAX_MEMORY_BYTES = 2**32
"""Default memory limit of a label volume and its surface (4 GiB); a CT of the trunk with one organ takes 2 GiB."""


@dataclass(frozen=True)
class Segment:
    """A segment of 3D Slicer: the voxels of one layer that have its label.

    Args:
        name: name of the segment in 3D Slicer.
        label: label of the voxels of the segment in its layer.
        layer: index of the layer; 0 if there is only one.
        id: identifier, unique among the segments of a file.
    """

    name: str
    label: int
    layer: int = 0
    id: str = ""


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Labels in voxels, with the position of the voxels in the patient.

    Args:
        labels: (X, Y, Z) integers of any type, read-only, or (X, Y, Z, L) in L layers for overlapping segments; 0 is
            the background.
        affine: (4, 4) float64 affine transform from the indices of a voxel to its centre in mm: right, anterior,
            superior (RAS), as in NIfTI and nibabel. Surfaces of the volume are in LPS.
        name: name of the source, used in messages.
        notes: sentences for the user about the file.
        segments: named segments, if the file has any.

    Raises:
        InputError: arrays of the wrong shape or type, or an affine that is singular or not finite.
    """

    labels: npt.NDArray[np.integer[Any]]
    affine: FloatArray
    name: str = "volume"
    notes: tuple[str, ...] = ()
    segments: tuple[Segment, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        labels, affine = np.asarray(self.labels).view(), read_only(self.affine)
        if labels.ndim not in (3, 4) or not labels.size or labels.dtype.kind not in "iu":
            raise InputError(
                f"{self.name}: labels must be integers of the shape (X, Y, Z), or (X, Y, Z, L) in L layers, not "
                f"{labels.dtype} {labels.shape}."
            )
        if affine.shape != (4, 4) or not np.isfinite(affine).all() or not np.linalg.det(affine[:3, :3]):
            raise InputError(f"{self.name}: the affine must be a (4, 4) array of finite numbers that can be inverted.")
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "affine", affine)

    @property
    def layers(self) -> tuple[npt.NDArray[np.integer[Any]], ...]:
        """Views (X, Y, Z) of each layer of `labels`."""
        layers = self.labels.reshape(*self.labels.shape[:3], -1)
        return tuple(layers[..., layer] for layer in range(layers.shape[3]))

    @property
    def voxel_mm(self) -> FloatArray:
        """(3,) size of a voxel along each axis of `labels`, mm."""
        return read_only(np.linalg.norm(self.affine[:3, :3], axis=0))


def are_same_triangles(first: IntArray | None, second: IntArray | None) -> bool:
    """Return whether two arrays (F, 3) contain the same triangles, in any order, orientation and order of corners."""
    if first is None or second is None:
        return first is second
    if first.shape != second.shape:
        return False
    if np.array_equal(first, second):
        return True
    own, other = np.sort(first, axis=1), np.sort(second, axis=1)
    return np.array_equal(own[np.lexsort(own.T)], other[np.lexsort(other.T)])


def common_faces(meshes: Iterable[Mesh]) -> IntArray | None:
    """Return the common triangles of all `meshes`, as in the first mesh, or None for point clouds.

    Raises:
        CorrespondenceError: two meshes differ; the message names the second.
    """
    first: Mesh | None = None
    for mesh in meshes:
        if first is None:
            first = mesh
        elif len(mesh.vertices) != len(first.vertices):
            _raise_mismatch(f"{mesh.name} has {len(mesh.vertices)} vertices but {first.name} has {len(first.vertices)}")
        elif not are_same_triangles(mesh.faces, first.faces):
            _raise_mismatch(f"{mesh.name} and {first.name} have different triangles on the same number of vertices")
    return None if first is None else first.faces


def _raise_mismatch(difference: str) -> NoReturn:
    raise CorrespondenceError(
        f"{difference}; only meshes in vertex correspondence can be modelled or compared, so run shapespace correspond "
        "on them first."
    )
