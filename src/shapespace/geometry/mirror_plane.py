"""Mirror images in correspondence: the plane, which vertex is the other side's, and a surface turned about."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import InputError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import faces_of, rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

_OFF = 0.01
"""A surface whose mirror image lies within this share of its size is taken for symmetric."""
FLIP = np.array([-1.0, 1.0, 1.0])
"""What turns points (..., 3) into their mirror images about x = 0."""

_POINTS = 1_000  # points of the mesh that planes are fitted to; time grows with them
_ITERATIONS = 30  # limit of the iterations for one plane
_STOP = 1e-5
"""The search for a plane ends when the RMS falls by less than this share of the size."""
_TRIES = 50
"""Triangles from which pairs may fail to spread before the search is given up."""
_APART = 0.2
"""Vertices of a pair are no further from one another's mirror image than this share of the size."""


def mirror_vertices(vertices: FloatArray) -> IntArray:
    """Return (V,) the vertex on the other side of the plane x = 0, its own inverse.

    Args:
        vertices: (V, 3) of a symmetric surface, such as a mean face, that looks along z.

    Raises:
        InputError: the surface is not its own mirror image, or its vertices do not pair up.
    """
    centred = vertices - vertices.mean(axis=0) * [0.0, 1.0, 1.0]
    neighbours = cKDTree(centred).query(centred * FLIP)
    distance, other = np.asarray(neighbours[0]), np.asarray(neighbours[1], dtype=np.int32)
    size = float(np.sqrt((centred**2).sum(axis=1).mean()))
    if distance.max() > _OFF * size or (other[other] != np.arange(len(other))).any():
        raise InputError("This surface is not its own mirror image about x = 0; train without mirror images.")
    return other


def mirrored(vertices: FloatArray, other: IntArray) -> FloatArray:
    """Return the mirror image (..., V, 3) of surfaces (..., V, 3), in correspondence with them.

    Args:
        vertices: of the surfaces.
        other: (V,) from `mirror_vertices`.
    """
    return vertices[..., other, :] * FLIP


def mirror_image(mesh: Mesh) -> Mesh:
    """Return the mirror image of a mesh at the plane x = 0, with triangles that are seen from the same side."""
    faces = None if mesh.faces is None else np.ascontiguousarray(mesh.faces[:, ::-1])
    landmarks = {name: point * FLIP for name, point in mesh.landmarks.items()}
    return replace(mesh, vertices=mesh.vertices * FLIP, faces=faces, landmarks=landmarks)


@dataclass(frozen=True, eq=False)
class SurfaceMirror:
    """A plane, wherever it lies, and for each vertex of a surface the place on it that is its mirror image.

    Args:
        corners: (V, 3) of the triangle that the place lies on.
        weights: (V, 3) barycentric.
        turn: (3, 3) orthogonal of determinant -1: directions d (column vectors) go to turn d.
        off_share: RMS distance of the surface's mirror image from it, as a share of its size (RMS distance from its
            centre).
        others_share: the same for the other planes that were tried, the nearest first.
        image: (V, 3) the mirror image of the surface itself.
    """

    corners: IntArray
    weights: FloatArray
    turn: FloatArray
    off_share: float
    others_share: tuple[float, ...]
    image: FloatArray


def find_mirror(mesh: Mesh) -> SurfaceMirror:
    """Return the plane about which a surface is nearest to its own mirror image.

    The planes tried are those across the principal axes, each turned and shifted until the image lies best.

    Args:
        mesh: with triangles, in any frame.
    """
    x = mesh.vertices
    engine, size = build_engine(mesh), rms_size(x)
    centre = x.mean(axis=0)
    some = x[:: max(1, len(x) // _POINTS)] - centre
    tried: list[tuple[float, FloatArray, Similarity]] = []
    for axis in np.linalg.svd(x - centre, full_matrices=False)[2]:
        flip = np.eye(3) - 2.0 * np.outer(axis, axis)
        flipped = some @ flip.T + centre
        T, near, rms = Similarity.identity(), engine.query(flipped), np.inf
        for _ in range(_ITERATIONS):
            if rms - near.rms < _STOP * size:
                break
            rms = near.rms
            T = fit_similarity(flipped, near.points, with_scale=False)
            near = engine.query(T.apply(flipped), near)
        tried.append((near.rms, flip, T))
    tried.sort(key=lambda one: one[0])
    rms, flip, T = tried[0]
    image = T.apply((x - centre) @ flip.T + centre)
    nearest = engine.query(image)
    assert nearest.triangle is not None and nearest.barycentric is not None
    others = tuple(one[0] / size for one in tried[1:])
    return SurfaceMirror(
        faces_of(mesh)[nearest.triangle], nearest.barycentric, T.rotation @ flip, rms / size, others, image
    )


def mirror_pairs(mesh: Mesh, mirror: SurfaceMirror) -> IntArray | None:
    """Return (V,) the vertex on the other side, its own inverse; None where vertices and triangles do not pair up.

    Vertices that are each nearest to the other's image begin, and triangles lead on: of two neighbouring triangles the
    images are neighbours too. So pairs are found where the surface itself is not quite symmetric.

    Args:
        mesh: a surface with triangles.
        mirror: of it.
    """
    x, faces = mesh.vertices, faces_of(mesh)
    nearest = np.asarray(cKDTree(x).query(mirror.image)[1], dtype=np.int32)
    if (nearest[nearest] == np.arange(len(x))).all():
        return nearest
    other = _by_triangles(x, mirror.image, faces, nearest)
    if other is None:
        return None
    far = np.linalg.norm(x[other] - mirror.image, axis=1).max()
    return other if far <= _APART * rms_size(x) else None


def _by_triangles(x: FloatArray, image: FloatArray, faces: IntArray, nearest: IntArray) -> IntArray | None:
    across = {
        (int(face[k]), int(face[(k + 1) % 3])): int(face[(k + 2) % 3]) for face in faces for k in range(3)
    }  # fmt: skip
    count = len(x)
    other = np.full(count, -1, dtype=np.int32)
    mutual = nearest[nearest] == np.arange(count)
    off = np.where(mutual, np.linalg.norm(x[nearest] - image, axis=1), np.inf)[faces].max(axis=1)
    tries = 0
    for triangle in np.argsort(off, kind="stable"):
        if not np.isfinite(off[triangle]):
            break
        if (other[faces[triangle]] >= 0).all():
            continue
        grown = _grown(faces[triangle].tolist(), nearest, across)
        if grown is not None:
            other[list(grown)] = list(grown.values())
        elif (tries := tries + 1) > _TRIES:
            return None
    alone = other < 0
    other[alone] = nearest[alone]
    return other if (other[other] == np.arange(count)).all() else None


def _grown(seed: list[int], nearest: IntArray, across: Mapping[tuple[int, int], int]) -> dict[int, int] | None:
    """Return the image of each vertex that triangles lead to from a triangle, None where two ways disagree."""
    there = [int(nearest[v]) for v in seed]
    if across.get((there[1], there[0])) != there[2]:
        return None
    pairs = dict(zip(seed, there, strict=True))
    edges = deque((seed[k], seed[(k + 1) % 3]) for k in range(3))
    while edges:
        p, q = edges.popleft()
        # The triangle beyond an edge runs along it the other way, and its image the other way again.
        beyond, image = across.get((q, p)), across.get((pairs[p], pairs[q]))
        if (beyond is None) != (image is None):
            return None
        if beyond is None or image is None:
            continue
        if beyond not in pairs:
            pairs[beyond] = image
            edges += [(p, beyond), (beyond, q)]
        elif pairs[beyond] != image:
            return None
    return pairs
