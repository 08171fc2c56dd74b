"""Mirror images in correspondence: the mirror plane, pairs of vertices, and the mirror image of a surface.

The decision which scans of a collection are mirror images of the others uses all scans together (C30, C31). A few
scans are anchors. Each scan and its mirror image are compared with each anchor: raw scans by the scores of the pose
search, shapes in correspondence by their Procrustes distances. The sides of anchors and scans that explain the scores
best are those of the collection.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from shapespace.geometry.closest import ClosestPointEngine, build_engine, on_boundary
from shapespace.geometry.normals import boundary_vertices, faces_of, rms_size, vertex_normals
from shapespace.reprs import first_names
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

SYMMETRIC_SHARE = 0.02
"""A surface has mirror symmetry if the RMS distance to its mirror image is at most this share of its size."""
FLIP = np.array([-1.0, 1.0, 1.0])
"""Factors of points (..., 3) that reflect them at the plane x = 0."""

_POINTS = 1_000  # points of the mesh for the fit of planes; time is proportional to it
_ITERATIONS = 30  # limit of the iterations for one plane
_STOP = 1e-5
"""The search for a plane ends at a step below this; normal in radians, offset as a share of the size."""
_ALIKE = 0.3  # cosine of normals below which a point and its match are on different parts of the surface
_SINGULAR = 1e-9  # share of the largest eigenvalue; directions below it, as of spheres, determine no plane
_OTHER_PLANE = 0.7  # cosine; starts that end less than about 45 degrees apart have found the same plane
_TRIES = 50
"""Number of first triangles without a result after which the search for pairs ends."""
LARGEST_PAIR_SHARE = 0.2
"""Largest distance of a point from the mirror image of its partner, as a share of the size."""


def mirror_image(mesh: Mesh) -> Mesh:
    """Return the mirror image of a mesh at the plane x = 0; triangles are flipped so that normals stay outward."""
    faces = None if mesh.faces is None else np.ascontiguousarray(mesh.faces[:, ::-1])
    landmarks = {name: point * FLIP for name, point in mesh.landmarks.items()}
    return replace(mesh, vertices=mesh.vertices * FLIP, faces=faces, landmarks=landmarks)


@dataclass(frozen=True, eq=False)
class SurfaceMirror:
    """A mirror plane in any pose, and the mirror point of each vertex on a surface.

    Args:
        corners: (V, 3) corners of the triangle with the mirror point of each vertex.
        weights: (V, 3) barycentric coordinates of the mirror points.
        normal: (3,) unit normal of the plane.
        offset: distance of the plane from the origin of the frame, along the normal.
        off_share: RMS distance of the mirror image of the surface from the surface, as a share of its size (RMS
            distance from its centre). Points whose match is on the border or on a part with another orientation are
            missing on the other side; the RMS of the other points is divided by their share of all points.
        others_share: `off_share` of other planes that were tried, the smallest first; empty if all starts lead to one
            plane, or the pairs are known.
        image: (V, 3) the mirror image of the surface itself.
        pairs: (V,) partner of each vertex if the order of the triangles defines it (see `pairs_of_triangles`), else
            None.
    """

    corners: IntArray
    weights: FloatArray
    normal: FloatArray
    offset: float
    off_share: float
    others_share: tuple[float, ...]
    image: FloatArray
    pairs: IntArray | None = None

    @property
    def turn(self) -> FloatArray:
        """(3, 3) reflection matrix of directions (column vectors)."""
        return np.eye(3) - 2.0 * np.outer(self.normal, self.normal)


def find_mirror(mesh: Mesh) -> SurfaceMirror:
    """Return the plane about which a surface is closest to its own mirror image.

    The planes tried are those across the principal axes, each moved by Gauss-Newton steps that minimise the distances
    of the mirror image from the tangent planes of the surface. Parts that are missing on one side do not count. If the
    triangles define pairs of vertices, the plane is that of the pairs.

    Args:
        mesh: mesh with triangles, in any frame.
    """
    x, faces = mesh.vertices, faces_of(mesh)
    centre, size, pairs = x.mean(axis=0), rms_size(x), pairs_of_triangles(faces, len(x))
    surface = Mesh((x - centre) / size, faces)
    engine = build_engine(surface)
    if pairs is None:
        axes = np.linalg.svd(surface.vertices, full_matrices=False)[2]
        planes = sorted((_best_plane(surface, engine, axis) for axis in axes), key=lambda plane: plane[0])
        share, normal, offset = planes[0]
        others = tuple(plane[0] for plane in planes if abs(plane[1] @ normal) < _OTHER_PLANE)
    else:
        normal, offset = plane_of_pairs(surface.vertices, surface.vertices[pairs])
        share, others = np.nan, ()
    nearest = engine.query(reflect(surface.vertices, normal, offset))
    assert nearest.triangle is not None and nearest.barycentric is not None
    corners, weights = faces[nearest.triangle], nearest.barycentric
    if pairs is not None:
        share, corners, weights = nearest.rms, np.tile(pairs[:, None], 3), np.tile([1.0, 0.0, 0.0], (len(x), 1))
    offset = size * offset + float(normal @ centre)
    image = reflect(x, normal, offset)
    return SurfaceMirror(corners, weights, normal, offset, share, others, image, pairs)


def _best_plane(mesh: Mesh, engine: ClosestPointEngine, normal: FloatArray) -> tuple[float, FloatArray, float]:
    """Return `off_share` of the best plane near a first one, its normal and its offset.

    Args:
        mesh: mesh of size 1, centred at the origin.
        engine: search structure of `mesh`.
        normal: (3,) normal of the first plane, which contains the origin.
    """
    rows, offset, share, near = slice(None, None, max(1, len(mesh.vertices) // _POINTS)), 0.0, np.inf, None
    faces, rim, normals = faces_of(mesh), boundary_vertices(mesh), vertex_normals(mesh)
    x, own = mesh.vertices[rows], normals[rows]
    for _ in range(_ITERATIONS):
        image = reflect(x, normal, offset)
        near = engine.query(image, near)
        assert near.triangle is not None and near.barycentric is not None
        there = np.einsum("mc,mcd->md", near.barycentric, normals[faces[near.triangle]])
        valid = np.einsum("md,md->m", reflect(own, normal, 0.0), there) > _ALIKE
        valid &= ~on_boundary(near, mesh, rim)
        if not valid.any():
            break
        share = float(np.sqrt((near.distance[valid] ** 2).mean()) / valid.mean())
        tangents, across = np.linalg.svd(normal[None])[2][1:], there @ normal
        turned = (x @ tangents.T) * across[:, None] + (x @ normal - offset)[:, None] * (there @ tangents.T)
        change = 2.0 * np.column_stack([-turned, across]) * valid[:, None]
        gram, residual = change.T @ change, np.einsum("md,md->m", there, near.points - image)
        inverse: FloatArray = np.asarray(np.linalg.pinv(gram, _SINGULAR, hermitian=True))  # pyright: ignore
        step = inverse @ (change.T @ residual)
        normal = normal + step[:2] @ tangents
        normal, offset = normal / np.linalg.norm(normal), offset + float(step[2])
        if np.linalg.norm(step) < _STOP:
            break
    return share, normal, offset


def reflect(points: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """Return the mirror images (..., 3) of points at the plane of the unit `normal` at `offset` from the origin."""
    return points - 2.0 * (points @ normal - offset)[..., None] * normal


def plane_of_pairs(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the unit normal (3,) and the offset of the plane at which points x (N, 3) are mirrored closest to y."""
    cross = (x - x.mean(axis=0)).T @ (y - y.mean(axis=0))
    normal = np.linalg.eigh(cross + cross.T)[1][:, 0]
    return normal, float(normal @ (x.mean(axis=0) + y.mean(axis=0)) / 2.0)


def pairs_of_triangles(faces: IntArray, vertices: int) -> IntArray | None:
    """Return (V,) the partner of each vertex if the second half of the triangles mirrors the first, in its order.

    Templates from `symmetrise` have this order: corner k of a triangle is the partner of corner 2 - k of its mirror
    image. It remains in all surfaces in correspondence with them.

    Args:
        faces: (F, 3) triangles.
        vertices: number of vertices, V.

    Returns:
        The partners, a permutation that is its own inverse, in which vertices on the plane are their own partners; None
        for triangles in another order.
    """
    half, own = len(faces) // 2, np.arange(vertices, dtype=np.int32)
    first, second, other = faces[:half], faces[half:], own.copy()
    if len(second) != half:
        return None
    other[first], other[second] = second[:, ::-1], first[:, ::-1]
    same = (other[first] == second[:, ::-1]).all() and (other[other] == own).all()
    return other if same and (other != own).any() else None


def mirror_pairs(mesh: Mesh, mirror: SurfaceMirror) -> IntArray | None:
    """Return the partner (V,) of each vertex on the other side; None if vertices and triangles do not form pairs.

    The search begins at vertices that are nearest to the images of each other, and continues along triangles, since the
    images of neighbouring triangles are neighbours too. This finds pairs also if the surface is only nearly symmetric.

    Args:
        mesh: a surface with triangles.
        mirror: mirror plane of `mesh`.
    """
    if mirror.pairs is not None:
        return mirror.pairs
    x, faces = mesh.vertices, faces_of(mesh)
    nearest = np.asarray(cKDTree(x).query(mirror.image)[1], dtype=np.int32)
    if (nearest[nearest] == np.arange(len(x))).all():
        return nearest
    other = _find_pairs(x, mirror.image, faces, nearest)
    if other is None:
        return None
    far = np.linalg.norm(x[other] - mirror.image, axis=1).max()
    return other if far <= LARGEST_PAIR_SHARE * rms_size(x) else None


def _find_pairs(x: FloatArray, image: FloatArray, faces: IntArray, nearest: IntArray) -> IntArray | None:
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
        grown = _spread_pairs(faces[triangle].tolist(), nearest, across)
        if grown is not None:
            other[list(grown)] = list(grown.values())
        elif (tries := tries + 1) > _TRIES:
            return None
    alone = other < 0
    other[alone] = nearest[alone]
    return other if (other[other] == np.arange(count)).all() else None


def _spread_pairs(seed: list[int], nearest: IntArray, across: Mapping[tuple[int, int], int]) -> dict[int, int] | None:
    """Return the images of all vertices that are connected by triangles to a first one; None if two paths disagree."""
    there = [int(nearest[v]) for v in seed]
    if across.get((there[1], there[0])) != there[2]:
        return None
    pairs = dict(zip(seed, there, strict=True))
    edges = deque((seed[k], seed[(k + 1) % 3]) for k in range(3))
    while edges:
        p, q = edges.popleft()
        # The neighbouring triangle passes an edge in the opposite direction, and its image in the original direction.
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


_LARGEST_EVIDENCE = 0.3
"""Limit of the log ratio of scores of a comparison: it was at most 0.2 among 39 similar molars."""
_DRAWS, _P_VALUE = 1000, 0.01
"""Number of draws of random signs, and the largest share of draws with equal agreement for an asymmetric object."""
_DRAWN_AT_ONCE = 50  # draws that are computed together: 12 MB of memory for 1000 scans
ASYMMETRIC = 0.08
"""Median log ratio of scores up to which an object counts as symmetric: it was at most 0.06 for faces, whose missing
parts and expressions can agree on wrong sides, 0.07 for spleens, 0.12 or more for molars, and 0.19 or more for femora
and 11 simulated kinds."""
_ALONE = np.log(0.85)
"""Log ratio of scores of a scan and its mirror image below which a single comparison decides: it was at least log 0.88
for 60 faces, femora and spleens that were not mirrored."""
_ANCHORS = 3
"""Number of anchors among shapes in correspondence, as for raw scans."""
_ROUNDING = 1e-12  # squared Procrustes distance, as a share of the squared size, of equal shapes
_NAMED = 3  # names in a message


@dataclass(frozen=True, eq=False)
class ScanSides:
    """Chirality of the scans of a collection.

    Args:
        mirrored: (N,) mask of the scans that are mirror images of the majority.
        margin: (N,) mean log ratio of scores of the decision; 0 for scans without a comparison.
        decided: whether the scores of different anchors agree; False for a symmetric object or too few comparisons.
        asymmetry: median absolute log ratio of scores.
    """

    mirrored: BoolArray
    margin: FloatArray
    decided: bool
    asymmetry: float = 0.0


def solve_sides(scores: FloatArray, anchors: Sequence[int], seed: int) -> ScanSides:
    """Return the sides that agree best with the scores of all comparisons.

    Args:
        scores: (A, N, 2) scores of each scan and of its mirror image, compared with each anchor; not-a-number for pairs
            that were not compared.
        anchors: (A,) indices of the anchors among the scans; -1 for an anchor that is not a scan of the collection.
        seed: seed of the random draws for the test of agreement.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = np.log(scores[:, :, 1]) - np.log(scores[:, :, 0])  # C30
    evidence = np.clip(np.nan_to_num(evidence, nan=0.0), -_LARGEST_EVIDENCE, _LARGEST_EVIDENCE)
    for a, i in enumerate(anchors):
        if i >= 0:
            evidence[a, i] = 0.0  # a scan agrees with itself whatever its side
    asymmetry = float(np.median(np.abs(evidence[evidence != 0]))) if evidence.any() else 0.0
    best, most = _best_signs(evidence[None], anchors)
    signs, agreement = best[0], float(most[0])
    rng, drawn = np.random.default_rng(seed), list[float]()
    for _ in range(0, _DRAWS, _DRAWN_AT_ONCE):
        flipped = evidence * rng.choice([-1.0, 1.0], (_DRAWN_AT_ONCE, *evidence.shape))
        drawn += _best_signs(flipped, anchors)[1].tolist()
    compared = (evidence != 0).sum(axis=0)
    margin = np.einsum("a,an->n", signs, evidence) / np.maximum(compared, 1)  # C31
    agrees = len(anchors) > 1 and np.mean(np.array(drawn) >= agreement) <= _P_VALUE
    decided = agrees and asymmetry > ASYMMETRIC
    mirrored = margin < 0 if decided else margin < _ALONE
    for a, i in enumerate(anchors):
        if decided and i >= 0:
            mirrored[i] = signs[a] < 0
    return ScanSides(np.asarray(mirrored), np.abs(margin), bool(decided), asymmetry)


def mirrored_note(shape: Callable[[int], FloatArray], name: Callable[[int], str], count: int) -> list[str]:
    """Return a sentence that names the shapes in correspondence that are mirror images of the majority, if any.

    Args:
        shape: function that returns the vertices (V, 3) of a shape by its index, in any pose and unit.
        name: function that returns the name of a shape by its index.
        count: number of shapes.
    """
    anchors = np.unique(np.linspace(0, count - 1, min(count, _ANCHORS)).round().astype(np.int32)).tolist()
    references = [_normalise(shape(i)) for i in anchors]
    scores = np.empty((len(anchors), count, 2))
    for j in range(count):
        vertices = _normalise(shape(j))
        for a, reference in enumerate(references):
            u, s, vt = np.linalg.svd(reference.T @ vertices)
            last = s[2] if np.linalg.det(u @ vt) > 0 else -s[2]
            cosines = np.array([s[0] + s[1] + last, s[0] + s[1] - last])  # of the best rotation and reflection
            scores[a, j] = np.sqrt(np.maximum(1.0 - cosines**2, _ROUNDING))
    if (scores[:, :, 0] <= scores[:, :, 1]).all():  # the draws would take a tenth of a second
        return []
    mirrored = solve_sides(scores, anchors, 0).mirrored
    mirrored = ~mirrored if 2 * mirrored.sum() > count else mirrored
    if not mirrored.any():
        return []
    of = "shapes is a mirror image" if mirrored.sum() == 1 else "shapes are mirror images"
    flagged = first_names([name(int(i)) for i in np.flatnonzero(mirrored)[: _NAMED + 1]], _NAMED)
    return [f"{mirrored.sum()} of {count} {of} of the others ({flagged}); reflect or remove them."]


def _normalise(vertices: FloatArray) -> FloatArray:
    """Return vertices (V, 3) about their centroid, with centroid size 1."""
    centred = vertices - vertices.mean(axis=0)
    return centred / np.linalg.norm(centred)


def _best_signs(evidence: FloatArray, anchors: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return the signs (D, A) of the anchors for which most evidence is consistent, the first +1, and its sum (D,).

    Args:
        evidence: (D, A, N) evidence of D draws.
        anchors: (A,) indices as for `solve_sides`.
    """
    patterns = np.array([(1.0, *signs) for signs in product((1.0, -1.0), repeat=len(anchors) - 1)])
    total = patterns @ evidence
    undisputed = np.abs(total)
    for a, i in enumerate(anchors):
        if i >= 0:
            undisputed[:, :, i] = patterns[:, a] * total[:, :, i]
    agreement = undisputed.sum(axis=2)
    return patterns[agreement.argmax(axis=1)], agreement.max(axis=1)  # C31
