"""Raw scans simulated from a known surface: new triangles, new pose and scale, noise, holes, hair and collar.

The simulation reproduces the effects of a real scanner on a face and keeps the truth: the true position of each vertex
of the model in the scan. The frame of the given mesh must have y up and the face looking along +z, as all faces of this
package have, in mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.errors import InputError
from shapespace.geometry import remesh
from shapespace.geometry.closest import SurfaceEngine
from shapespace.geometry.normals import face_vectors, faces_of, vertex_normals
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity, generator_of, read_only, require

LongArray: TypeAlias = npt.NDArray[np.int64]

PLAIN_TRIANGLES = 20_000
"""Number of triangles of a plain scan."""


@dataclass(frozen=True, eq=False)
class Hole:
    """A ball cut out of the scan.

    Args:
        radius_mm: radius of the ball, in the model's millimetres.
        center: (3,) centre in the model's frame; None for a random vertex of the surface.
    """

    radius_mm: float
    center: npt.ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Cut:
    """A plane that cuts away everything on the side its normal points to.

    Args:
        point: (3,) on the plane, in the model's frame.
        normal: (3,) of any length.
    """

    point: npt.ArrayLike
    normal: npt.ArrayLike


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A simulated raw scan with the truth.

    Args:
        scan: surface as a scanner would return it: its own triangles and frame, no landmarks.
        truth_vertices: (V, 3) float64, the vertices of the model's mesh, in its order, in the frame of the scan.
        truth_landmarks: name -> (3,), the landmarks of the model's mesh in the frame of the scan.
        T_scan_model: transformation from the model's frame to the scan's.
        on_surface: (S,) bool, whether each vertex of the scan belongs to the true surface, and is no outlier.

    Example:
        >>> simulated = ss.datasets.simulate_scan(meshes[0], 0, triangles=2000)
        >>> simulated.truth_vertices.shape == meshes[0].vertices.shape
        True
    """

    scan: Mesh
    truth_vertices: FloatArray
    truth_landmarks: Mapping[str, FloatArray]
    T_scan_model: Similarity
    on_surface: BoolArray

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Retriangulation:
    """Other vertices and triangles on a surface, found once for many scans of surfaces with its vertices.

    Args:
        corners: (S, 3) vertices of the surface around each new vertex.
        weights: (S, 3) barycentric coordinates of the new vertex in them.
        faces: (T, 3) triangles of the new vertices.
    """

    corners: IntArray
    weights: FloatArray
    faces: LongArray

    @staticmethod
    def of(mesh: Mesh, rng: np.random.Generator, triangles: int) -> Retriangulation:
        """Return a re-triangulation with about `triangles` triangles; arguments and errors as in `retriangulate`."""
        vertices, faces = retriangulate(mesh, rng, triangles)
        matches = SurfaceEngine(mesh).query(vertices)
        assert matches.triangle is not None and matches.barycentric is not None
        return Retriangulation(faces_of(mesh)[matches.triangle], matches.barycentric, faces)


def random_similarity(
    rng: np.random.Generator,
    max_angle_deg: float = 20.0,
    scale_range: tuple[float, float] = (0.9, 1.1),
    translation_mm: float = 100.0,
) -> Similarity:
    """Return a random similarity about the origin.

    Args:
        rng: random generator of the transformation.
        max_angle_deg: largest angle about a random axis, uniform in [0, max], degrees.
        scale_range: smallest and largest scale, drawn uniformly in its logarithm.
        translation_mm: largest absolute value of each coordinate of the translation, uniform, mm.

    Raises:
        InputError: a scale that is not positive.
    """
    low, high = scale_range
    if not 0 < low <= high:
        raise InputError(f"The range of scales must be positive and in order, not {scale_range}.")
    axis = rng.standard_normal(3)
    angle = math.radians(rng.uniform(0.0, max_angle_deg))
    rotation = np.asarray(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix(), dtype=np.float64)
    scale = math.exp(rng.uniform(math.log(low), math.log(high)))
    return Similarity(scale, rotation, rng.uniform(-translation_mm, translation_mm, 3))


def simulate_scan(
    mesh: Mesh,
    rng: np.random.Generator | int,
    *,
    triangles: int | Retriangulation = 40_000,
    noise_mm: float = 0.2,
    T_scan_model: Similarity | None = None,
    holes: Sequence[Hole] = (),
    crop: Sequence[Cut] = (),
    hair: Hair | None = None,
    collar: Collar | None = None,
    outlier_fraction: float = 0.0,
    split: bool = True,
    name: str = "simulated scan",
) -> SimulatedScan:
    """Return a raw scan of `mesh`; the same `rng` state gives the same scan.

    Args:
        mesh: the true surface, in mm, y up and facing +z.
        rng: generator or seed, from which every random choice is made.
        triangles: number of triangles of the re-triangulated surface, before anything is cut away or added; or a
            re-triangulation that other scans share, which saves most of the time.
        noise_mm: standard deviation of the noise along the normals, in mm of the model's frame.
        T_scan_model: pose and scale of the scan; None leaves it in the model's frame.
        holes: balls to cut out.
        crop: planes to cut with.
        hair: hair to add; None for none.
        collar: collar to add; None for none.
        outlier_fraction: share of the vertices moved 3 to 15 mm off the surface, to either side.
        split: whether all triangles are split first, see `retriangulate`.
        name: name of the scan.

    Raises:
        InputError: an option out of range, or holes and cuts that leave nothing.
        MeshError: `mesh` has no faces, edges that more than two triangles share, or neighbours of opposite winding.
    """
    require(mesh, Mesh, "simulate_scan", "convert it with shapespace.as_mesh")
    if (isinstance(triangles, int) and triangles < 4) or noise_mm < 0 or not 0 <= outlier_fraction < 1:
        raise InputError(
            f"A simulated scan needs at least 4 triangles, noise of at least 0 mm and a share of outliers in [0, 1), "
            f"not {triangles}, {noise_mm} and {outlier_fraction}."
        )
    rng = generator_of(rng, "simulate_scan")
    T = T_scan_model or Similarity.identity()
    vertices, faces = retriangulate(mesh, rng, triangles, split=split)
    normals = vertex_normals(Mesh(vertices, faces.astype(np.int32)))
    vertices = vertices + normals * (noise_mm * rng.standard_normal(len(vertices)))[:, None]
    thrown = rng.random(len(vertices)) < outlier_fraction
    throw = rng.uniform(3.0, 15.0, len(vertices)) * rng.choice([-1.0, 1.0], len(vertices))
    vertices = vertices + normals * (thrown * throw)[:, None]

    parts = [(vertices, faces)]
    if hair is not None:
        parts += hair_parts(mesh, hair, rng)
    if collar is not None:
        parts.append(collar_part(mesh, collar, rng))
    on_surface = np.concatenate([~thrown, np.zeros(sum(len(v) for v, _ in parts[1:]), dtype=np.bool_)])
    vertices, faces = _merge(parts)
    keep = _mask_outside_holes(vertices, mesh, holes, crop, rng)
    faces = faces[keep[faces].all(axis=1)]
    if not len(faces):
        raise InputError(f"The holes and cuts leave nothing of {mesh.name}; make them smaller.")
    # The order of vertices and triangles must not give away the model's.
    used = rng.permutation(np.unique(faces))
    new_index = np.full(len(vertices), -1, dtype=np.int64)
    new_index[used] = np.arange(len(used))
    faces = rng.permutation(new_index[faces])
    return SimulatedScan(
        Mesh(T.apply(vertices[used]), faces.astype(np.int32), name=name),
        read_only(T.apply(mesh.vertices)),
        {key: T.apply(point) for key, point in mesh.landmarks.items()},
        T,
        on_surface[used],
    )


def plain_scan(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Return `mesh` as a scanner would give it: with `PLAIN_TRIANGLES`, in any pose, 0.2 mm of noise, two holes."""
    return simulate_scan(
        mesh,
        rng,
        triangles=PLAIN_TRIANGLES,
        T_scan_model=random_similarity(rng, max_angle_deg=180.0),
        holes=(Hole(8.0), Hole(5.0)),
        split=False,
        name=mesh.name,
    ).scan


def retriangulate(
    mesh: Mesh, rng: np.random.Generator, triangles: int | Retriangulation, *, split: bool = True
) -> tuple[FloatArray, LongArray]:
    """Return other vertices (S, 3) and triangles (T, 3) on the same surface, T about `triangles`.

    Triangles are split, the new vertices slid at random along the surface, short edges collapsed until the number is
    reached, and every vertex put back onto the surface; so none of the model's vertices is left as such.

    Args:
        mesh: the surface.
        rng: source of all random choices.
        triangles: approximate number of triangles of the result, or its triangles, whose vertices are then slid only.
        split: whether to split all triangles; False splits only as far as necessary, which is four times faster if the
            result has fewer triangles than the mesh.

    Raises:
        MeshError: `mesh` has no faces, edges that more than two triangles share, or neighbours of opposite winding.
    """
    original = np.asarray(mesh.vertices)
    faces = faces_of(mesh).astype(np.int64)
    if isinstance(triangles, Retriangulation):
        vertices = (original[triangles.corners] * triangles.weights[:, :, None]).sum(axis=1)
        return _slide(original, faces, vertices, triangles.faces, 0.2, rng), triangles.faces
    fine_vertices, fine_faces = original, faces
    while len(fine_faces) < 1.5 * triangles or (split and fine_faces is faces):
        fine_vertices, fine_faces = remesh.split(fine_vertices, fine_faces, mesh.name)
    fine_vertices = _slide(original, faces, fine_vertices, fine_faces, 0.2, rng)
    coarse_vertices, coarse_faces, _ = remesh.collapse(fine_vertices, fine_faces, triangles, mesh.name)
    coarse_vertices = _slide(original, faces, coarse_vertices, coarse_faces, 0.1, rng)
    return coarse_vertices, coarse_faces


def _slide(
    surface_vertices: FloatArray,
    surface_faces: LongArray,
    vertices: FloatArray,
    faces: LongArray,
    share: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Move each vertex at random by up to `share` of its shortest edge, then onto the nearest point of the surface."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    shortest = np.full(len(vertices), np.inf)
    np.minimum.at(shortest, edges.ravel(), np.repeat(length, 2))
    shortest[~np.isfinite(shortest)] = 0.0
    normals = vertex_normals(Mesh(vertices, faces.astype(np.int32)))
    step = rng.uniform(-1.0, 1.0, vertices.shape)
    step -= normals * (step * normals).sum(axis=1, keepdims=True)
    moved = vertices + share * shortest[:, None] * step
    return remesh.onto(moved, surface_vertices, surface_faces)


def _mask_outside_holes(
    vertices: FloatArray, mesh: Mesh, holes: Sequence[Hole], crop: Sequence[Cut], rng: np.random.Generator
) -> BoolArray:
    keep = np.ones(len(vertices), dtype=np.bool_)
    for hole in holes:
        center = mesh.vertices[rng.integers(len(mesh.vertices))] if hole.center is None else hole.center
        keep &= np.linalg.norm(vertices - np.asarray(center, dtype=np.float64), axis=1) > hole.radius_mm
    for cut in crop:
        keep &= (vertices - np.asarray(cut.point)) @ np.asarray(cut.normal, dtype=np.float64) <= 0
    return keep


def _merge(parts: Sequence[tuple[FloatArray, LongArray]]) -> tuple[FloatArray, LongArray]:
    starts = np.cumsum([0] + [len(v) for v, _ in parts])
    faces = np.concatenate([f + start for (_, f), start in zip(parts, starts, strict=False)])
    return np.concatenate([v for v, _ in parts]), faces


# Simulated hair and collars on a scan, which no face model represents

_UP, _FRONT = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Hair:
    """Hair as a 3dMD scanner sees it: a bumpy sheet over the scalp, tufts over the forehead, floating shreds.

    Args:
        fringe_mm: overlap of the sheet with the upper border of the surface.
        thickness_mm: smallest and largest distance of the sheet from the head.
        sideburns_mm: additional overlap of the sheet at the temples.
        tufts: number of locks that hang from the sheet.
        shreds: number of small patches that float free.
        spacing_mm: length of the edges of the sheet.
    """

    fringe_mm: float = 18.0
    thickness_mm: tuple[float, float] = (2.0, 15.0)
    sideburns_mm: float = 45.0
    tufts: int = 24
    shreds: int = 30
    spacing_mm: float = 2.0


@dataclass(frozen=True)
class Collar:
    """A collar: a bumpy band around the neck, below the surface and overlapping its lower border.

    Args:
        height_mm: height of the band.
        overlap_mm: overlap of the band with the lower border of the surface.
        spacing_mm: length of its edges.
    """

    height_mm: float = 45.0
    overlap_mm: float = 12.0
    spacing_mm: float = 2.5


def _bumps(points: FloatArray, rng: np.random.Generator, wavelength_mm: float) -> FloatArray:
    """Return smooth random values (M,) of about unit size at `points` (M, 3): a sum of sixteen random waves."""
    waves = rng.standard_normal((16, 3)) * (2 * np.pi / wavelength_mm / np.sqrt(3))
    return np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 16)).sum(axis=1) / np.sqrt(8.0)


def _grid(rows: int, columns: int) -> LongArray:
    """Return the triangles of a grid of `rows` x `columns` vertices, numbered row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Head:
    """A sphere fitted to the upper part of a face, with the radius of the face near the vertices of the face."""

    center: FloatArray
    radius: float
    directions: cKDTree
    excess: FloatArray
    top_mm: float

    @staticmethod
    def of(mesh: Mesh) -> _Head:
        vertices = np.asarray(mesh.vertices)
        height = vertices @ _UP
        low, top = np.quantile(height, [0.0, 1.0])
        upper = vertices[height > low + 0.6 * (top - low)]
        A = np.column_stack([2 * upper, np.ones(len(upper))])
        solution = np.asarray(np.linalg.lstsq(A, (upper**2).sum(axis=1), rcond=None)[0], dtype=np.float64)
        center = solution[:3]
        radius = float(np.sqrt(solution[3] + center @ center))
        ray = vertices - center
        distance = np.linalg.norm(ray, axis=1)
        outer = distance > 0.5 * radius
        tree = cKDTree(ray[outer] / distance[outer, None])
        return _Head(center, radius, tree, distance[outer] - radius, float(top))

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the distance (M,) from the centre to the head along unit `directions` (M, 3)."""
        query_result = cast("tuple[FloatArray, LongArray]", self.directions.query(directions, k=6))
        distance, nearest = query_result
        weights = np.exp(-((distance * self.radius / 12.0) ** 2))
        # Away from the face the surface blends into a sphere, so that the scalp is round where the mesh ends.
        return self.radius + (weights * self.excess[nearest]).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)


def hair_parts(mesh: Mesh, hair: Hair, rng: np.random.Generator) -> list[tuple[FloatArray, LongArray]]:
    """Return vertices and triangles of the sheet, the tufts and the shreds over the head of `mesh`, mm."""
    head = _Head.of(mesh)
    parts = [_hair_sheet(head, hair, rng)]
    parts += [_tuft(head, hair, rng) for _ in range(hair.tufts)]
    parts += [_shred(head, hair, rng) for _ in range(hair.shreds)]
    return parts


def _hairline(directions: FloatArray, head: _Head, hair: Hair) -> FloatArray:
    """Return the height (M,) above which there is hair: lower at the temples, low at the back."""
    azimuth = np.abs(np.arctan2(directions[:, 0], directions[:, 2]))
    side = np.clip((azimuth - math.radians(35)) / math.radians(40), 0.0, 1.0)
    return head.top_mm - hair.fringe_mm - hair.sideburns_mm * side * side * (3 - 2 * side)


def _hair_sheet(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    max_angle = math.radians(115.0)
    count = int(2 * max_angle * head.radius / hair.spacing_mm)
    steps = np.linspace(-max_angle, max_angle, count)
    u, v = np.tile(steps, count), np.repeat(steps, count)
    u = u + rng.uniform(-0.3, 0.3, len(u)) * 2 * max_angle / count
    v = v + rng.uniform(-0.3, 0.3, len(v)) * 2 * max_angle / count
    angle = np.hypot(u, v)
    ring = np.where(angle > 0, np.sin(angle) / np.maximum(angle, 1e-9), 1.0)
    # An azimuthal map about the crown has no seam and no pole within the hair.
    pole = (_UP - 0.4 * _FRONT) / np.linalg.norm(_UP - 0.4 * _FRONT)
    right = np.cross(_UP, _FRONT)
    directions = (
        np.cos(angle)[:, None] * pole + (ring * u)[:, None] * right + (ring * v)[:, None] * np.cross(right, pole)
    )
    positions = head.center + directions * head.surface(directions)[:, None]
    edge = positions @ _UP - _hairline(directions, head, hair) - 5.0 * _bumps(positions, rng, 18.0)
    low, high = hair.thickness_mm
    swell = np.clip(edge / 30.0, 0.0, 1.0)
    thickness = low + (high - low) * swell * (0.65 + 0.35 * _bumps(positions, rng, 35.0))
    thickness = (
        np.clip(thickness, low, high) + 1.2 * _bumps(positions, rng, 9.0) + 0.8 * rng.standard_normal(len(positions))
    )
    vertices = positions + directions * np.maximum(thickness, 0.5 * low)[:, None]
    holes = _bumps(positions, rng, 22.0) > 1.9
    keep = (edge > 0) & (angle < max_angle) & ~holes
    faces = _grid(count, count)
    return vertices, faces[keep[faces].all(axis=1)]


def _tuft(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """A lock: a narrow wavy ribbon from the hairline down over the skin, a few millimetres above it."""
    azimuth = rng.uniform(-1.2, 1.2)
    length, width = rng.uniform(10.0, 32.0), rng.uniform(2.0, 6.0)
    rows, columns = max(3, int(length / hair.spacing_mm)), max(3, int(width / 1.5))
    along = np.linspace(0.0, 1.0, rows)
    start = _hairline(np.array([[np.sin(azimuth), 0.0, np.cos(azimuth)]]), head, hair)[0] + 4.0
    height = np.clip((start - head.center @ _UP - along * length) / head.radius, -0.95, 0.95)
    sway = azimuth + rng.uniform(-0.2, 0.2) * along + 0.03 * np.sin(rng.uniform(2, 6) * along + rng.uniform(0, 6))
    across = np.linspace(-0.5, 0.5, columns) * width / head.radius
    bearing = sway[:, None] + across * (1.0 - 0.7 * along[:, None])
    level = np.sqrt(1 - height**2)[:, None]
    directions = np.stack(
        [level * np.sin(bearing), np.broadcast_to(height[:, None], bearing.shape), level * np.cos(bearing)], axis=2
    ).reshape(-1, 3)
    lift = np.repeat(rng.uniform(2.0, 7.0) * (1.0 - 0.6 * along), columns) + 0.4 * rng.standard_normal(rows * columns)
    return head.center + directions * (head.surface(directions) + lift)[:, None], _grid(rows, columns)


def _shred(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """A small crumpled patch of triangles, detached from the head, such as scanners make of hair."""
    direction = rng.standard_normal(3)
    direction[1] = abs(direction[1]) * 1.2 - 0.2
    direction /= np.linalg.norm(direction)
    center = head.center + direction * (head.radius + hair.thickness_mm[1] + rng.uniform(2.0, 25.0))
    rows, columns = int(rng.integers(3, 6)), int(rng.integers(3, 6))
    axis = rng.standard_normal(3)
    frame = Rotation.from_rotvec(rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis)).as_matrix()
    u, v = np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)
    flat = 1.8 * np.stack([u - u.mean(), v - v.mean(), np.zeros(len(u))], axis=1)
    crumpled = flat + 0.6 * rng.standard_normal(flat.shape)
    return center + crumpled @ frame.T, _grid(rows, columns)


def collar_part(mesh: Mesh, collar: Collar, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """Return vertices and triangles of a collar below `mesh`, mm."""
    vertices = np.asarray(mesh.vertices)
    height = vertices @ _UP
    low, top = height.min(), height.max()
    wide = np.ptp(vertices[:, 0])
    middle = 0.5 * (vertices[:, 0].max() + vertices[:, 0].min())
    chin = vertices[height < low + 0.25 * (top - low)]
    radius_x, radius_z = 0.55 * wide, 0.5 * wide
    center_z = np.quantile(chin[:, 2], 0.9) - 1.1 * radius_z
    rows = max(3, int(collar.height_mm / collar.spacing_mm))
    columns = max(8, int(np.pi * (radius_x + radius_z) * 0.8 / collar.spacing_mm))
    around = np.tile(np.linspace(-0.8 * np.pi, 0.8 * np.pi, columns), rows)
    down = np.repeat(np.linspace(0.0, 1.0, rows), columns)
    flare = 1.0 + 0.25 * down
    vertices = np.stack(
        [
            middle + radius_x * flare * np.sin(around),
            low + collar.overlap_mm - collar.height_mm * down,
            center_z + radius_z * flare * np.cos(around),
        ],
        axis=1,
    )
    vertices = vertices + 0.3 * rng.standard_normal(vertices.shape)
    vertices[:, 2] += 1.5 * _bumps(vertices, rng, 30.0)
    faces = _grid(rows, columns)
    facing = face_vectors(vertices, faces.astype(np.int32))
    outward = vertices[faces].mean(axis=1) - [middle, 0.0, center_z]
    # The grid is wound so that its normals point outward, as on the face.
    return vertices, faces if (facing * outward)[:, [0, 2]].sum() > 0 else faces[:, ::-1]
