"""The plain data that travels between the parts: meshes, similarities and label volumes.

Arrays are float64 and read-only. Lengths are millimetres, except the vertices of a scan as read from its file,
which are in the file's own unit until the fit has found that unit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import CorrespondenceError, InputError, MeshError
from shapespace.late import late
from shapespace.reprs import short_repr

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int32]
ByteArray: TypeAlias = npt.NDArray[np.uint8]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

MM_PER_UNIT: Mapping[str, float] = MappingProxyType({"um": 1e-3, "mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0})
"""Millimetres in one of each unit a scan may come in."""

GREY = 128
"""Red, green and blue of vertices without a colour, where others of their surface have one."""


def read_only(array: npt.ArrayLike) -> FloatArray:
    """Return `array` as a C-ordered float64 array that refuses writing; a view where no copy is needed.

    Args:
        array: anything numpy can turn into float64, any shape.
    """
    out = np.ascontiguousarray(array, dtype=np.float64).view()
    out.setflags(write=False)
    return out


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface, or a point cloud when it has no faces.

    Args:
        vertices: (V, 3) float64, in the order of the file; V may be 0 only while a file is being examined.
        faces: (F, 3) int32 indices into `vertices`, counter-clockwise seen from outside; None for a point cloud.
        landmarks: name -> (3,) float64, in the same frame and unit as `vertices`.
        name: where it came from, used in messages and result files.
        colours: (V, 3) uint8 red, green and blue of each vertex, as screens show them (sRGB); None where not known.
        notes: what was left out as it was read, a sentence each.
        observed: (V,) bool, False for vertices whose positions are estimates because the scan does not show them;
            None if all are observed.

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
            if raw.size and (raw.min() < 0 or raw.max() >= len(vertices)):
                bad = int(raw.max()) if raw.max() >= len(vertices) else int(raw.min())
                raise MeshError(
                    f"{self.name}: a face points at vertex {bad}, but there are only {len(vertices)} vertices; "
                    "the file is damaged or cut short."
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
            given = np.asarray(self.colours)
            if given.shape != vertices.shape or given.dtype != np.uint8:
                raise MeshError(f"{self.name}: colours must be (V, 3) uint8, not {given.shape} {given.dtype}.")
            colours = np.ascontiguousarray(given).view()
            colours.setflags(write=False)
            object.__setattr__(self, "colours", colours)
        if self.observed is not None:
            mask = np.asarray(self.observed)
            if mask.shape != vertices.shape[:1] or mask.dtype != np.bool_:
                raise MeshError(f"{self.name}: observed must be (V,) bool, not {mask.shape} {mask.dtype}.")
            flags = np.ascontiguousarray(mask).view()
            flags.setflags(write=False)
            object.__setattr__(self, "observed", None if flags.all() else flags)

    def __getstate__(self) -> dict[str, Any]:
        # For copies, other processes and skops, none of which takes read-only mappings.
        fields = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return {**fields, "landmarks": dict(self.landmarks)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def with_vertices(self, vertices: npt.ArrayLike, landmarks: Mapping[str, FloatArray] | None = None) -> Mesh:
        """Return the same mesh with other `vertices` (V, 3); landmarks are dropped unless given."""
        moved = np.asarray(vertices, dtype=np.float64)
        return Mesh(moved, self.faces, landmarks or {}, self.name, self.colours, self.notes, self.observed)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` with the same vertices, or a `trimesh.PointCloud` where there are no triangles.

        Landmarks are left out, here as in the next four; `as_mesh` leads back.

        Raises:
            ShapespaceError: trimesh is not installed.
        """
        return late("to_trimesh")(self)

    def to_pyvista(self) -> Any:
        """Return a `pyvista.PolyData`.

        Raises:
            ShapespaceError: PyVista is not installed.
        """
        return late("to_pyvista")(self)

    def to_open3d(self) -> Any:
        """Return an `open3d.geometry.TriangleMesh`, or a `PointCloud` where there are no triangles.

        Raises:
            ShapespaceError: Open3D is not installed.
        """
        return late("to_open3d")(self)

    def to_meshio(self) -> Any:
        """Return a `meshio.Mesh` of triangles, or of vertices where there are none.

        Raises:
            ShapespaceError: meshio is not installed.
        """
        return late("to_meshio")(self)

    def to_menpo(self) -> Any:
        """Return a `menpo.shape.TriMesh`, or a `PointCloud` where there are no triangles.

        Raises:
            ShapespaceError: menpo is not installed.
        """
        return late("to_menpo")(self)


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity x -> scale * rotation @ x + translation; instances are named `T_target_source`.

    Args:
        scale: positive number.
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, in the target's unit.

    Raises:
        InputError: a scale that is not positive, or a matrix that is not a rotation.
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
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"The scale of a similarity must be positive and finite, not {self.scale!r}.")
        if not np.isfinite(translation).all():
            raise InputError("The translation of a similarity must be finite.")
        if not (np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-5 and np.linalg.det(rotation) > 0):
            raise InputError("The rotation of a similarity must be orthonormal with determinant +1.")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @staticmethod
    def identity() -> Similarity:
        """Return the similarity that moves nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Map `points` (..., 3) from the source frame to the target frame."""
        moved = np.asarray(points, dtype=np.float64) @ (self.scale * self.rotation.T)
        moved += self.translation
        return moved

    def inverse(self) -> Similarity:
        """Return the similarity from the target frame back to the source frame."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """Compose: `T_c_b @ T_b_a` is `T_c_a`."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))


MAX_MEMORY_BYTES = 2**32
"""Memory that a label volume and its surface may take by default (4 GiB): a CT of the trunk with one organ takes 2."""


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Labels in voxels, and where these lie in the patient.

    Args:
        labels: (X, Y, Z) whole numbers of any type, read-only; 0 is what has no label.
        affine: (4, 4) float64 from the indices of a voxel to its middle in mm: right, anterior, superior (RAS).
        name: where it came from, used in messages.
        notes: sentences on what is worth knowing of the file.

    Raises:
        InputError: arrays of the wrong shape or type, or an affine that is singular or not finite.
    """

    labels: npt.NDArray[np.integer[Any]]
    affine: FloatArray
    name: str = "volume"
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        labels, affine = np.asarray(self.labels).view(), read_only(self.affine)
        if labels.ndim != 3 or not labels.size or labels.dtype.kind not in "iu":
            raise InputError(
                f"{self.name}: labels must be whole numbers of the shape (X, Y, Z), not {labels.dtype} {labels.shape}."
            )
        if affine.shape != (4, 4) or not np.isfinite(affine).all() or not np.linalg.det(affine[:3, :3]):
            raise InputError(f"{self.name}: the affine must be a (4, 4) array of finite numbers that can be inverted.")
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "affine", affine)

    @property
    def voxel_mm(self) -> FloatArray:
        """(3,) the size of a voxel along each axis of `labels`, mm."""
        return read_only(np.linalg.norm(self.affine[:3, :3], axis=0))


def common_faces(meshes: Iterable[Mesh]) -> IntArray | None:
    """Return the triangles that all `meshes` share, or None if they are point clouds.

    Raises:
        CorrespondenceError: two of them differ; the message names the second.
    """
    first: Mesh | None = None
    for mesh in meshes:
        if first is None:
            first = mesh
            continue
        if len(mesh.vertices) != len(first.vertices):
            raise CorrespondenceError(
                f"{mesh.name} has {len(mesh.vertices)} vertices but {first.name} has {len(first.vertices)}; "
                "a shape model needs meshes in vertex correspondence, so run shapespace correspond on them first."
            )
        same = (mesh.faces is None) == (first.faces is None) and (
            mesh.faces is None or first.faces is None or np.array_equal(mesh.faces, first.faces)
        )
        if not same:
            raise CorrespondenceError(
                f"{mesh.name} and {first.name} have different triangles on the same number of vertices; "
                "a shape model needs meshes in vertex correspondence, so run shapespace correspond on them first."
            )
    return None if first is None else first.faces
