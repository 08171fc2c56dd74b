"""Initial shapes for the registration of a bent object: maps from the template that keep distances along the surface.

A limb that has moved far is near to another limb in space, but its position along the surface is unchanged. Distances
along the surface come from the eigenfunctions of the Laplacian, so no pose is needed. Equations Cn are those of
docs/correspondence.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.template import clean_scan, resample
from shapespace.geometry.normals import edge_stretch, face_vectors, faces_of, rms_size, vertex_normals
from shapespace.types import FloatArray, IntArray, Mesh

_VERTICES = 2000  # vertices of a scan's coarse mesh, and at most of the template that are mapped: the cost grows
_DISTANCE_FUNCTIONS = 60  # functions for distances along the surface; the weight of the last one is below 0.001
_COARSEST, _FINEST, _STEPS = 20, 80, 18
"""Functions of the map in the first and the last refinement. From 8 on, 2 of 10 figures had front and back swapped."""
_FAR_APART = 0.35  # least distance of two extremities, share of the RMS distance along the surface
_OWN_ENDS, _SCAN_ENDS, _FEWEST_ENDS = 6, 8, 3
"""Largest number of extremities of the template and of the scan, and the smallest: fewer leave rotations open."""
_TRIED = 10  # assignments of extremities: each costs about 0.2 CPU s
_SENSE = 0.75
"""Share of the area of the map, less that of the rest, that is not turned inside out: it was 0.87 or more in the right
maps of 9 figures, and negative where left and right were exchanged."""
_MAPS, _DISTINCT = 3, 0.05
"""Largest number of maps to be registered, and the least median distance between two maps, share of the size: stretch
does not distinguish correct maps from those with front and back exchanged."""
_JACOBIANS = 3.0
"""RMS of the determinants in the first map, in which distances have about 2; 2 and 4 give the same maps."""
_SMOOTH = 0.05  # range over which the determinants are averaged, share of the square root of the area


@dataclass(frozen=True, eq=False)
class IntrinsicShape:
    """A surface described by quantities that bending does not change.

    Args:
        mesh: the surface.
        functions: (V, K) eigenfunctions, scaled so that a constant is 1.
        area: (V,) area of each vertex as a share of the total area.
        embedding: (V, D) points whose distances are those along the surface, biharmonic (C50), of RMS 1.
        ends: (E,) vertices that are farthest from all others around them.
        harmonics: harmonics of the surface.
    """

    mesh: Mesh
    functions: FloatArray
    area: FloatArray
    embedding: FloatArray
    ends: IntArray
    harmonics: Harmonics

    @staticmethod
    def of(mesh: Mesh, harmonics: Harmonics, most_ends: int = _OWN_ENDS) -> IntrinsicShape:
        """Return the intrinsic shape of `mesh`, whose functions may be those of a bent surface."""
        total = float(harmonics.area.sum())
        area, slow = harmonics.area / total, harmonics.slowest(_DISTANCE_FUNCTIONS)
        embedding = slow.functions[:, 1:] / slow.squared_frequency[1:]  # C50
        embedding /= np.sqrt(area @ (embedding**2).sum(axis=1))
        functions = np.sqrt(total) * harmonics.slowest(_FINEST).functions
        ends = _find_extremities(embedding, faces_of(mesh), most_ends)
        return IntrinsicShape(mesh, functions, area, embedding, ends, harmonics)

    @staticmethod
    def of_scan(scan: Mesh) -> IntrinsicShape:
        """Return the intrinsic shape of the largest piece of `scan`, meshed evenly.

        Raises:
            MeshError: the scan has no triangles, or they do not form a sheet.
        """
        mesh = resample(clean_scan(scan), _VERTICES)
        return IntrinsicShape.of(mesh, Harmonics.of(mesh, _FINEST), _SCAN_ENDS)

    def distances(self, ends: IntArray) -> FloatArray:
        """Return (V, E) the distance of each vertex from each of `ends`."""
        return np.linalg.norm(self.embedding[:, None] - self.embedding[ends], axis=2)

    def smooth(self, values: FloatArray) -> FloatArray:
        """Return the component of `values` (V, C) in the functions."""
        return self.functions @ (self.functions.T @ (self.area[:, None] * values))

    def determinants(self, fields: FloatArray) -> FloatArray:
        """Return (V, E (E - 1) / 2) the Jacobian determinant of each pair of `fields` (V, E), averaged (C51).

        Its sign changes with the orientation of the surface.
        """
        faces = faces_of(self.mesh)
        a, b = np.triu_indices(fields.shape[1], 1)
        u, v = (fields[faces[:, k]] - fields[faces[:, 0]] for k in (1, 2))
        of_faces = (u[:, a] * v[:, b] - v[:, a] * u[:, b]) / 6  # C51
        sums = np.stack([np.bincount(faces.ravel(), np.repeat(f, 3), len(fields)) for f in of_faces.T], axis=1)
        smooth_mm = _SMOOTH * float(np.sqrt(self.harmonics.area.sum()))
        return self.harmonics.diffused(sums / self.area[:, None], smooth_mm)


def bent_shapes(template: IntrinsicShape, scan: IntrinsicShape, seed: int) -> list[FloatArray]:
    """Return the template's vertices (V, 3) on `scan`, by the maps that change distances along the surface least.

    Extremities are assigned by their distances from each other; each likely assignment yields a map, which is refined
    (ZoomOut; Melzi et al. 2019). A map that turns the surface inside out is rejected; this distinguishes left from
    right.

    Args:
        template: the surface that is mapped.
        scan: the surface that it is mapped onto.
        seed: seed of the sample of the template's vertices that are mapped.

    Returns:
        The distinct shapes, at most `_MAPS`, least stretched first; none if there are too few extremities, or if no map
        keeps the orientation.
    """
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.permutation(len(template.functions))[: _VERTICES // 2]).astype(np.int32)
    faces = faces_of(template.mesh)
    shapes: list[FloatArray] = []
    for ends in _yield_assignments(template, scan):
        own, theirs = template.distances(template.ends[: len(ends)]), scan.distances(ends)
        turns = template.determinants(own)
        scale = _JACOBIANS / max(float(np.sqrt((turns**2).mean())), 1e-12)
        features = np.hstack([own, scale * turns])[drawn]
        start = _nearest(features, np.hstack([theirs, scale * scan.determinants(theirs)]))
        mapped = _refine_map(template, scan, start, drawn)
        shape = template.smooth(scan.mesh.vertices[mapped])
        if _orientation(shape, faces, vertex_normals(scan.mesh)[mapped]) >= _SENSE:
            shapes.append(shape)
    shapes.sort(key=lambda shape: edge_stretch(shape, template.mesh))
    return distinct(shapes, rms_size(scan.mesh.vertices))[:_MAPS]


def distinct(shapes: Iterable[FloatArray], size_mm: float, known: Sequence[FloatArray] = ()) -> list[FloatArray]:
    """Return those of `shapes` (V, 3) that differ from the shapes before them, and from the known shapes."""
    found: list[FloatArray] = []
    for shape in shapes:
        if all(is_apart(shape, other, size_mm) for other in (*known, *found)):
            found.append(shape)
    return found


def is_apart(shape: FloatArray, other: FloatArray, size_mm: float) -> bool:
    """Return whether two shapes (V, 3) on an object of that RMS size have most vertices in different positions."""
    return float(np.median(np.linalg.norm(shape - other, axis=1))) > _DISTINCT * size_mm


def common_symmetries(maps: Iterable[IntArray], template: Mesh) -> IntArray | None:
    """Return the distinct near symmetries (S, V) that most scans have, at most `_MAPS`; None if there are none.

    Args:
        maps: (S, V) maps of each scan, see `ScanRegistration.symmetries`.
        template: mesh whose vertices the maps permute.
    """
    vertices, size_mm = template.vertices, rms_size(template.vertices)
    groups = [[np.arange(len(vertices), dtype=np.int32)]]  # the first one is the identity
    for row in (row for rows in maps for row in rows):
        alike = [group for group in groups if not is_apart(vertices[row], vertices[group[0]], size_mm)]
        if alike:
            alike[0].append(row)
        else:
            groups.append([row])
    common = [group[0] for group in sorted(groups[1:], key=len, reverse=True)[:_MAPS]]
    return np.stack(common) if common else None


def _find_extremities(embedding: FloatArray, faces: IntArray, most: int) -> IntArray:
    """Return the vertices whose mean squared distance from all others is a maximum, largest first."""
    mean_squared = (embedding**2).sum(axis=1)  # the embedding is centred, as functions are orthogonal to a constant
    around = np.full(len(embedding), -np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        np.maximum.at(around, faces[:, i], mean_squared[faces[:, j]])
        np.maximum.at(around, faces[:, j], mean_squared[faces[:, i]])
    ends: list[int] = []
    for v in np.argsort(-mean_squared, kind="stable").tolist():
        apart = np.linalg.norm(embedding[ends] - embedding[v], axis=1)
        if mean_squared[v] >= around[v] and apart.min(initial=np.inf) > _FAR_APART:
            ends.append(v)
        if len(ends) == most:
            break
    return np.array(ends, dtype=np.int32)


def _yield_assignments(template: IntrinsicShape, scan: IntrinsicShape) -> Iterator[IntArray]:
    """Yield the extremities of `scan` in the order of those of the template, likely assignments first."""
    count = min(len(template.ends), len(scan.ends))
    if count < _FEWEST_ENDS:
        return
    own = template.distances(template.ends[:count])[template.ends[:count]]
    theirs = scan.distances(scan.ends)[scan.ends]
    orders = np.array(list(permutations(range(len(scan.ends)), count)))
    differences = np.abs(theirs[orders[:, :, None], orders[:, None, :]] - own).mean(axis=(1, 2))  # C52
    for order in orders[np.argsort(differences, kind="stable")[:_TRIED]]:
        yield scan.ends[order]


def _refine_map(template: IntrinsicShape, scan: IntrinsicShape, start: IntArray, drawn: IntArray) -> IntArray:
    """Return (V,) the scan's vertex for each vertex of the template, from that (M,) of the vertices `drawn`."""
    area = template.area[drawn] / template.area[drawn].sum()
    mapped, own, theirs, C = start, template.functions, scan.functions, np.eye(0)
    for count in np.unique(np.geomspace(_COARSEST, _FINEST, _STEPS).round().astype(int)).tolist():
        own, theirs = template.functions[:, :count], scan.functions[:, :count]
        C = own[drawn].T @ (area[:, None] * theirs[mapped])  # C53
        mapped = _nearest(own[drawn], theirs @ C.T)
    return _nearest(own, theirs @ C.T)


def _orientation(shape: FloatArray, faces: IntArray, normals: FloatArray) -> float:
    """Return the share of the area of `shape` whose normals agree with those of the scan, minus the remaining share.

    Args:
        shape: (V, 3) vertices on the scan.
        faces: triangles of the shape.
        normals: (V, 3) normals of the scan at these vertices.
    """
    vectors = face_vectors(shape, faces)
    areas = np.linalg.norm(vectors, axis=1)
    alike = np.sign(np.einsum("fd,fd->f", vectors, normals[faces].sum(axis=1)))
    return float((areas * alike).sum() / max(float(areas.sum()), 1e-12))


def _nearest(queries: FloatArray, points: FloatArray) -> IntArray:
    """Return (M,) the nearest of `points` (P, D) to each of `queries` (M, D); D is too large for a tree."""
    half = 0.5 * (points**2).sum(axis=1)
    parts = np.array_split(queries, max(1, len(queries) * len(points) // 4_000_000))
    return np.concatenate([(half - part @ points.T).argmin(axis=1) for part in parts]).astype(np.int32)
