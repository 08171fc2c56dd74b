"""A shape model with precomputed data for fitting, and its surfaces, on which closest points are found by walking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.fit.robust.kernels import Float32Array, less_sag, meet_into, normals_into, walk_into
from shapespace.geometry.articulation import Articulation
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.normals import boundary_vertices, rms_size
from shapespace.geometry.similarity import POSE, small_poses
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity, SurfaceLandmarks


@dataclass(frozen=True, eq=False)
class Topology:
    """Neighbourhoods of the vertices on the model's surface.

    Args:
        faces: (F, 3) int32 triangles.
        ring_start: (V + 1,) start of each vertex's neighbours in `ring`.
        ring: (R,) neighbours of the vertices.
        fan_start: (V + 1,) start of each vertex's triangles in `fan`.
        fan: (3F,) triangles of the vertices.
        rim: (V,) True on the border of the surface.
        used: indices of the vertices that belong to a triangle.
    """

    faces: IntArray
    ring_start: IntArray
    ring: IntArray
    fan_start: IntArray
    fan: IntArray
    rim: BoolArray
    used: IntArray

    @staticmethod
    def of(mesh: Mesh) -> Topology:
        """Return the topology of `mesh`, which must have triangles."""
        faces = np.array(mesh.faces)
        count = len(mesh.vertices)
        flat = faces.ravel()
        order = np.argsort(flat, kind="stable")
        fan_start = np.zeros(count + 1, dtype=np.int32)
        np.cumsum(np.bincount(flat, minlength=count), out=fan_start[1:])
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
        keys = np.unique(np.concatenate([edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]]))
        ring_start = np.zeros(count + 1, dtype=np.int32)
        np.cumsum(np.bincount(keys // count, minlength=count), out=ring_start[1:])
        return Topology(
            faces=faces,
            ring_start=ring_start,
            ring=(keys % count).astype(np.int32),
            fan_start=fan_start,
            fan=(order // 3).astype(np.int32),
            rim=boundary_vertices(mesh),
            used=np.unique(flat).astype(np.int32),
        )


@dataclass(frozen=True, eq=False)
class PreparedModel:
    """Precomputed data of a model, shared by all fits with it.

    Args:
        model: the shape model.
        topology: topology of its surface.
        tree: search tree of the mean's vertices that belong to a triangle: entry i is vertex `used[i]` of the topology.
        modes: (V, 3, K) float32 basis vectors, from which the rows of the normal equations are made.
        pose: (3V, 7) displacements of the mean by a small rotation, translation and scaling.
        pose_in_span: (K, 7) components of these displacements along the modes.
    """

    model: ShapeModel
    topology: Topology
    tree: KdTree
    modes: Float32Array
    pose: FloatArray
    pose_in_span: FloatArray


@cached_with_owner()
def prepare(model: ShapeModel) -> PreparedModel:
    """Return `model` with precomputed data for the robust fit, computed once for each model.

    Raises:
        InputError: the model has no triangles, so it has no normals.
    """
    if model.faces is None:
        raise InputError("The robust method needs a model with triangles; this one has none, so use --method paper.")
    modes = np.ascontiguousarray(model.vertex_basis.reshape(model.n_vertices, 3, -1), dtype=np.float32)
    pose = small_poses(model.mean_vertices)
    topology = Topology.of(model.mesh())
    tree = KdTree(model.mean_vertices[topology.used])
    return PreparedModel(model, topology, tree, modes, pose, model.vertex_basis.T @ pose)


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """A surface on the model's triangles, in the model's frame.

    Args:
        topology: topology of its triangles.
        vertices: (V, 3) vertices, mm.
        normals: (V, 3) unit normals of the vertices.
        modes: (V, 3, K) float32 modes of its deformation; K is 0 if it is moved vertex by vertex.
    """

    topology: Topology
    vertices: FloatArray
    normals: FloatArray
    modes: Float32Array

    @staticmethod
    def of(topology: Topology, vertices: FloatArray, modes: Float32Array | None = None) -> ModelSurface:
        """Return the surface with these vertices (V, 3) mm, and their normals."""
        normals = np.empty_like(vertices)
        normals_into(vertices, topology.faces, normals)
        modes = np.empty((len(vertices), 3, 0), dtype=np.float32) if modes is None else modes
        return ModelSurface(topology, vertices, normals, modes)

    def vertex_tree(self) -> KdTree:
        """Return a tree of the vertices that belong to a triangle: entry i is vertex `used[i]`."""
        return KdTree(self.vertices[self.topology.used])

    def closest(
        self, points: FloatArray, vertex: IntArray, triangle: IntArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Find the closest point to each query point by walking over the surface from its last match.

        Args:
            points: (M, 3) query points, mm.
            vertex: (M,) vertex from which each walk starts.
            triangle: (M,) triangle of the last match of each point; -1 if unknown.

        Returns:
            (M,) vertex where each walk ends, (M,) triangle of the closest point, (M, 3) barycentric coordinates.
        """
        vertex, triangle, weights, t = vertex.copy(), triangle.copy(), np.empty((len(points), 3)), self.topology
        walk_into(
            points, vertex, self.vertices, t.faces, t.ring_start, t.ring, t.fan_start, t.fan, triangle, weights
        )  # fmt: skip
        return vertex, triangle, weights

    def meet(
        self, points: FloatArray, point_normals: FloatArray, triangle: IntArray, weights: FloatArray, *, bulging: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return (M,) residuals along the model's normal, distances, cosines of the normals, and the mask off the rim.

        With `bulging` residuals are from the smooth surface through the corners of each triangle.
        """
        residual, distance, cosine = np.empty(len(points)), np.empty(len(points)), np.empty(len(points))
        covered = np.empty(len(points), dtype=np.bool_)
        meet_into(
            points, point_normals, triangle, weights, self.vertices, self.normals, self.topology.faces,
            self.topology.rim, residual, distance, cosine, covered,
        )  # fmt: skip
        if bulging:
            less_sag(triangle, weights, self.vertices, self.normals, self.topology.faces, residual)
        return residual, distance, cosine, covered


@dataclass(frozen=True, eq=False)
class LinearShape:
    """A linear shape model on fixed triangles (R1).

    Args:
        topology: topology of all surfaces of the shape model.
        mean: (V, 3) vertices of the mean, mm.
        modes: (V, 3, K) float32 modes.
    """

    topology: Topology
    mean: FloatArray
    modes: Float32Array

    @staticmethod
    def of(prepared: PreparedModel) -> LinearShape:
        """Return the shape model of `prepared`, with the model's own modes."""
        model = prepared.model
        if model.articulation is None:
            return LinearShape(prepared.topology, model.mean_vertices, prepared.modes)
        return ArticulatedShape(prepared.topology, model.vector([]).reshape(-1, 3), prepared.modes, model.articulation)

    def surface(self, b: FloatArray) -> ModelSurface:
        """Return the surface with coefficients `b` (k,) mm of the first k modes (R1)."""
        return ModelSurface.of(self.topology, self.vertices(b), self.modes)

    def vertices(self, b: FloatArray) -> FloatArray:
        """Return the vertices (V, 3) mm of `surface`."""
        k = len(b)
        flat = self.modes.reshape(-1, self.modes.shape[2])
        offset = (flat if k == flat.shape[1] else flat[:, :k]) @ b.astype(np.float32)
        return self.mean + offset.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class ArticulatedShape(LinearShape):
    """A shape model of several parts, whose tangent vertices are linear in the coefficients (S4-S7).

    Args:
        articulation: the parts.
    """

    articulation: Articulation

    def surface(self, b: FloatArray) -> ModelSurface:
        """Return the surface with coefficients `b` (k,) mm of the first k modes, and the modes at this shape."""
        tangent = super().vertices(b)
        flat = self.modes.reshape(-1, self.modes.shape[2])
        moved = self.articulation.directions(flat.astype(np.float64), tangent)
        modes = moved.astype(np.float32).reshape(self.modes.shape)
        return ModelSurface.of(self.topology, self.articulation.decode(tangent), modes)

    def vertices(self, b: FloatArray) -> FloatArray:
        """Return the vertices (V, 3) mm with coefficients `b` (k,) mm of the first k modes."""
        return self.articulation.decode(super().vertices(b))


SHARE = 0.03
"""Standard deviation of a landmark as a share of the model's size (RMS distance from its centre), if none is given."""
_PATCHES = 300.0  # independent patches that the matches of a surface count as, since neighbours share their errors
# width and outlier limit of landmark residuals in SD (R16b), and the factor from MAD to SD of a normal distribution
_WIDTH, _MAD, _FAR = 3.0, 1.48, 4.0


@dataclass(frozen=True, eq=False)
class LandmarkConstraint:
    """Landmarks that scan and model share.

    Args:
        landmarks: the L shared landmarks on the model's surface.
        points_mm: (L, 3) positions in the scan's mm frame.
        stddev_mm: standard deviation of each coordinate, mm of the scan.
        far_mm: largest median distance, mm of the model's frame, to which the outlier limit adapts; a landmark over
            three times as far off has no influence.
    """

    landmarks: SurfaceLandmarks
    points_mm: FloatArray
    stddev_mm: float
    far_mm: float

    @staticmethod
    def of(model: ShapeModel, landmarks_mm: Mapping[str, FloatArray], stddev_mm: float) -> LandmarkConstraint | None:
        """Return those of `landmarks_mm` (name -> (3,)) that `model` has too; None if there are no such landmarks."""
        names = [name for name in model.landmarks if name in landmarks_mm]
        if not names or not np.isfinite(stddev_mm):
            return None
        return LandmarkConstraint(
            model.landmarks.select(names),
            np.stack([landmarks_mm[name] for name in names]),
            stddev_mm,
            SHARE * rms_size(model.mean_vertices),
        )

    def off_mm(self, surface: ModelSurface, T_scan_model: Similarity) -> FloatArray:
        """Return (L,) the distance of each landmark of the surface from that of the scan, mm of the scan."""
        positions = self.landmarks.interpolate(surface.vertices)
        return np.linalg.norm(T_scan_model.apply(positions) - self.points_mm, axis=1)

    def equations(self, surface: ModelSurface, T_scan_model: Similarity, modes: int) -> tuple[FloatArray, FloatArray]:
        """Return Hessian (7 + k, 7 + k) and gradient (7 + k,) of half the squares over the variance, robustly weighted.

        Args:
            surface: current surface.
            T_scan_model: current pose, in the scan's mm frame.
            modes: k, the number of free modes.
        """
        x = self.landmarks.interpolate(surface.vertices)
        off = x - T_scan_model.inverse().apply(self.points_mm)
        distance = np.linalg.norm(off, axis=1)
        stddev = self.stddev_mm / T_scan_model.scale
        # A wrong landmark lies farther off than the others, even while all of them are off during the fit.
        width = _WIDTH * max(stddev, min(_MAD * float(np.median(distance)), self.far_mm))  # R16b
        weight = np.exp(-0.5 * (distance / width) ** 2) / stddev**2  # R16a
        pose = small_poses(x).reshape(len(x), 3, POSE)
        rows = np.concatenate([pose, self.landmarks.interpolate(surface.modes[:, :, :modes])], axis=2)
        every = rows.reshape(3 * len(x), -1)
        heavy = np.repeat(weight, 3)[:, None] * every
        hessian: FloatArray = np.asarray(heavy.T @ every, dtype=np.float64)  # R16c
        return hessian, np.asarray(heavy.T @ off.ravel(), dtype=np.float64)

    def notes(self, surface: ModelSurface, T_scan_model: Similarity) -> list[str]:
        """Return a sentence on each landmark that the fit contradicts."""
        off_mm = self.off_mm(surface, T_scan_model)
        far = off_mm > _FAR * max(self.stddev_mm, _MAD * float(np.median(off_mm)))
        return [
            f"Landmark {name!r} lies {off:.1f} mm from its position in the fit; check its position and its name."
            for name, off, is_far in zip(self.landmarks.names, off_mm, far, strict=True)
            if is_far
        ]


def worth(matches: float) -> float:
    """Return the number of matches that count as one observation, the gain of landmarks; `matches` is their weight."""
    return max(1.0, matches / _PATCHES)
