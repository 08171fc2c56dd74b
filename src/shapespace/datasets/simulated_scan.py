"""Raw scans simulated from a known surface: new triangles, new pose and scale, noise, holes, hair and collar.

What a real scanner does to a face, with the truth kept: where each vertex of the model truly lies in the scan. The
frame of the given mesh must have y up and the face looking along +z, as all faces of this package have, in mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from shapespace.datasets.hair_and_collar import Collar, Hair, LongArray, collar_part, hair_parts
from shapespace.errors import InputError
from shapespace.geometry import remesh
from shapespace.geometry.normals import faces_of, vertex_normals
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity, generator_of, read_only, require

PLAIN_TRIANGLES = 20_000
"""Of a plain scan."""


@dataclass(frozen=True, eq=False)
class Hole:
    """A ball cut out of the scan.

    Args:
        radius_mm: of the ball, in the model's millimetres.
        center: (3,) in the model's frame; None takes a random vertex of the surface.
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
        scan: the surface as a scanner would give it: its own triangles and frame, no landmarks.
        truth_vertices: (V, 3) float64, the vertices of the model's mesh, in its order, in the frame of the scan.
        truth_landmarks: name -> (3,), the landmarks of the model's mesh in the frame of the scan.
        T_scan_model: from the model's frame to the scan's.
        on_surface: (S,) bool, which vertices of the scan belong to the true surface, and are no outliers.

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


def random_similarity(
    rng: np.random.Generator,
    max_angle_deg: float = 20.0,
    scale_range: tuple[float, float] = (0.9, 1.1),
    translation_mm: float = 100.0,
) -> Similarity:
    """Return a random similarity about the origin.

    Args:
        rng: draws it.
        max_angle_deg: the angle is uniform in [0, max] about a random axis.
        scale_range: least and greatest scale, drawn evenly in its logarithm.
        translation_mm: each coordinate is uniform in [-this, this].

    Raises:
        InputError: a scale that is not positive.
    """
    low, high = scale_range
    if not 0 < low <= high:
        raise InputError(f"The range of scales must be positive and in order, not {scale_range}.")
    axis = rng.standard_normal(3)
    angle = math.radians(rng.uniform(0.0, max_angle_deg))
    rotation = _rotation(angle * axis / np.linalg.norm(axis))
    scale = math.exp(rng.uniform(math.log(low), math.log(high)))
    return Similarity(scale, rotation, rng.uniform(-translation_mm, translation_mm, 3))


def _rotation(vector: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) about `vector` (3,) by its length in radians."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix(), dtype=np.float64)


def simulate_scan(
    mesh: Mesh,
    rng: np.random.Generator | int,
    *,
    triangles: int = 40_000,
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
        rng: generator or seed, from which every random choice comes.
        triangles: of the re-triangulated surface, before anything is cut away or added.
        noise_mm: standard deviation of the noise along the normals, in mm of the model's frame.
        T_scan_model: pose and scale of the scan; None leaves it in the model's frame.
        holes: balls to cut out.
        crop: planes to cut with.
        hair: to put on, or None.
        collar: to put on, or None.
        outlier_fraction: share of the vertices thrown 3 to 15 mm off the surface, either way.
        split: as in `retriangulate`.
        name: of the scan.

    Raises:
        InputError: an option out of range, or holes and cuts that leave nothing.
        MeshError: `mesh` has no faces, edges that more than two triangles share, or neighbours of opposite winding.
    """
    require(mesh, Mesh, "simulate_scan", "convert it with shapespace.as_mesh")
    if triangles < 4 or noise_mm < 0 or not 0 <= outlier_fraction < 1:
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
    mesh: Mesh, rng: np.random.Generator, triangles: int, *, split: bool = True
) -> tuple[FloatArray, LongArray]:
    """Return other vertices (S, 3) and triangles (T, 3) on the same surface, T about `triangles`.

    Triangles are split, the new vertices slid at random along the surface, short edges collapsed until the number is
    reached, and every vertex put back onto the surface; so none of the model's vertices is left as such.

    Args:
        mesh: the surface.
        rng: every random choice comes from it.
        triangles: about how many there shall be.
        split: False splits only as far as it must, which for fewer triangles than the mesh has is four times faster.

    Raises:
        MeshError: `mesh` has no faces, edges that more than two triangles share, or neighbours of opposite winding.
    """
    original = np.asarray(mesh.vertices)
    faces = faces_of(mesh).astype(np.int64)
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
