"""Semilandmarks: evenly spaced points on curves between landmarks, and on patches of surface within closed curves.

A curve is a chain of shortest paths on the mean shape, and a patch the smaller side of a closed chain. The
correspondence maps both to a specimen, where they are bent to its landmarks and spaced evenly on its own surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, cast

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from shapespace.correspondence.landmark_transfer import MarkedSpecimens, TransferredLandmarks
from shapespace.errors import InputError
from shapespace.geometry.closest import ClosestPointEngine, build_engine
from shapespace.geometry.normals import face_areas, faces_of, vertex_areas, vertex_normals
from shapespace.io.landmarks.landmark_configurations import spaced_points
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

_RINGS, _PER_EDGE, _SWEEPS = 3, (0.2, 0.5), 150
"""Rings of neighbours that a step of the first path may cross, points of a path for each mean edge, and sweeps that
straighten it: paths on a sphere are then less than 1 % of its radius from great circles (tests)."""
_PER_GAP, _SPACING_STEPS = 8, 12
"""Points of a path for each semilandmark, and steps of even spacing; gaps on raw scans then differ by 1 % (SD)."""
_SAMPLES, _MEAN_STEPS, _SPECIMEN_STEPS = 60, 60, 15
"""Points of a patch for each semilandmark, and steps of Lloyd's method on the mean and on a specimen."""


@dataclass(frozen=True)
class SemilandmarkSet:
    """Semilandmarks on one curve or patch.

    Args:
        name: name of the curve or patch; its semilandmarks are NAME_1, NAME_2, ...
        kind: curve or patch.
        along: names of landmarks on a curve, in order; the first can be the last again. For a patch, names of
            landmarks and curves around it, which end where they begin.
        points: number of semilandmarks; the first and last landmark of a curve are not among them.
    """

    name: str
    kind: Literal["curve", "patch"]
    along: tuple[str, ...]
    points: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the semilandmarks."""
        return tuple(f"{self.name}_{k + 1}" for k in range(self.points))


@dataclass(frozen=True, eq=False)
class _Plan:
    """A set of semilandmarks on the mean shape.

    Args:
        point_set: names and number of the semilandmarks.
        landmarks: names of the K landmarks around or along it.
        corners, weights: (M, 3) points in triangles: first those of the K landmarks, then the path of a curve, or the
            semilandmarks and samples of a patch.
        triangles: (M,) indices of the triangles.
        bend: (M, K) share of the offset of each landmark that moves a point.
    """

    point_set: SemilandmarkSet
    landmarks: tuple[str, ...]
    corners: IntArray
    weights: FloatArray
    triangles: IntArray
    bend: FloatArray

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Return (M, ...) values of the vertices (V, ...) at the points."""
        return np.asarray(np.einsum("mc,mc...->m...", self.weights, values[self.corners]))


@dataclass(frozen=True, eq=False)
class Semilandmarks:
    """Curves and patches on the mean shape of specimens in correspondence.

    Args:
        specimens: specimens with the landmarks.
        plans: plan of each set.
    """

    specimens: MarkedSpecimens
    plans: tuple[_Plan, ...]

    @staticmethod
    def of(specimens: MarkedSpecimens, sets: Sequence[SemilandmarkSet]) -> Semilandmarks:
        """Return the semilandmarks of the `sets`, placed on the mean shape.

        Raises:
            InputError: an unknown landmark, too few points, a boundary that is not closed, or a name that another point
                or set has.
        """
        for k, point_set in enumerate(sets):
            taken = {*specimens.names, *(name for other in sets[:k] for name in (other.name, *other.names))}
            if clash := [name for name in (point_set.name, *point_set.names) if name in taken]:
                raise InputError(
                    f"{point_set.kind} {point_set.name}: {clash[0]!r} is the name of another point; rename the set."
                )
        surface = _MeanSurface(specimens)
        curves = {point_set.name: point_set.along for point_set in sets if point_set.kind == "curve"}
        return Semilandmarks(specimens, tuple(surface.plan(point_set, curves) for point_set in sets))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all semilandmarks."""
        return tuple(name for plan in self.plans for name in plan.point_set.names)

    def sliders(self) -> list[tuple[str, str, str]]:
        """Return (before, slider, after) of the semilandmarks of all curves, as geomorph's `curves`."""
        rows: list[tuple[str, str, str]] = []
        for plan in self.plans:
            if plan.point_set.kind == "curve":
                chain = (plan.landmarks[0], *plan.point_set.names, plan.landmarks[-1])
                rows += zip(chain, chain[1:], chain[2:], strict=False)
        return rows

    def place(
        self, specimen: Mesh, landmarks: Mapping[str, FloatArray], radius_90: Mapping[str, float], scan: Mesh | None
    ) -> TransferredLandmarks:
        """Place the semilandmarks on a specimen.

        Args:
            specimen: corresponding surface of the specimen.
            landmarks: name -> (3,), all landmarks of the sets.
            radius_90: radius of the 90 % region of each landmark that has a region.
            scan: scan in the same frame; None for positions on `specimen`.

        Returns:
            The semilandmarks; their regions are interpolated between those of the landmarks, if all have one.
        """
        engine, faces = build_engine(scan or specimen), faces_of(specimen)
        mask = np.ones(len(specimen.vertices)) if specimen.observed is None else specimen.observed.astype(np.float64)
        # Mirrored surfaces have another order of corners, but the same order of triangles.
        growth = face_areas(specimen) / np.maximum(face_areas(Mesh(self.specimens.mean, faces)), 1e-300)
        points: dict[str, FloatArray] = {}
        radius, observed = list[FloatArray](), list[FloatArray]()
        for plan in self.plans:
            x, own = plan.interpolate(specimen.vertices), np.stack([landmarks[name] for name in plan.landmarks])
            count, k = plan.point_set.points, len(own)
            x = x + plan.bend @ (own - x[:k])
            if plan.point_set.kind == "curve":
                at = _evenly_spaced(x[k:], count, engine)
            else:
                first, samples = x[k : k + count], x[k + count :]
                at = _spread_points(samples, growth[plan.triangles[k + count :]], first, _SPECIMEN_STEPS)
            near = np.asarray(cKDTree(x).query(at)[1])
            radius.append((plan.bend @ [radius_90.get(name, np.nan) for name in plan.landmarks])[near])
            observed.append(plan.interpolate(mask)[near])
            points |= zip(plan.point_set.names, at, strict=True)
        return TransferredLandmarks.on(specimen, scan, points, np.concatenate(radius), np.concatenate(observed))


class _MeanSurface:
    """The mean shape, with landmarks and the paths between them."""

    def __init__(self, specimens: MarkedSpecimens) -> None:
        self.mesh = Mesh(specimens.mean, faces_of(specimens.surfaces[0]), name="mean")
        self._engine, self._paths = build_engine(self.mesh), dict[tuple[str, str], FloatArray]()
        marks = specimens.landmarks.values()
        self._landmarks = {
            name: np.mean([m.select([name]).interpolate(specimens.mean)[0] for m in marks if name in m.names], axis=0)
            for name in specimens.names
        }
        self._edges = np.unique(np.sort(self.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)  # type: ignore[index]
        self._edge = float(self._lengths(self._edges).mean())

    def plan(self, point_set: SemilandmarkSet, curves: Mapping[str, Sequence[str]]) -> _Plan:
        """Return a set on this surface.

        Raises:
            InputError: the set uses unknown landmarks of this surface, or its boundary is not closed.
        """
        label = f"{point_set.kind} {point_set.name}"
        chain = list(point_set.along) if point_set.kind == "curve" else _trace_boundary(point_set, curves)
        if unknown := [name for name in chain if name not in self._landmarks]:
            raise InputError(
                f"{label}: no marked specimen has a landmark named {unknown[0]!r}; correct the name, or mark it."
            )
        if len(chain) < 2 or any(a == b for a, b in pairwise(chain)):
            raise InputError(f"{label} needs two or more landmarks, and none may follow itself; correct them.")
        if point_set.kind == "patch" and chain[0] != chain[-1]:
            raise InputError(
                f"{label}: its boundary begins at {chain[0]!r} and ends at {chain[-1]!r}, so it is not closed; let it "
                "end where it begins."
            )
        if point_set.points < 1:
            raise InputError(f"{label} has {point_set.points} points; give 1 or more.")
        segments = [self._shortest_path(a, b, label) for a, b in pairwise(chain)]
        path = np.concatenate([*(segment[:-1] for segment in segments), segments[-1][-1:]])
        path = spaced_points(path, max(len(path), _PER_GAP * (point_set.points + 1)))
        if point_set.kind == "patch":
            samples = self._samples(path, point_set)
            spread = samples[:: max(1, len(samples) // point_set.points)][: point_set.points]
            path = np.concatenate([_spread_points(samples, np.ones(len(samples)), spread, _MEAN_STEPS), samples])
        names = tuple(dict.fromkeys(chain))
        positions = np.stack([self._landmarks[name] for name in names])
        near = self._engine.query(np.concatenate([positions, path]))
        assert near.triangle is not None and near.barycentric is not None
        closeness = 1.0 / (((near.points[:, None] - positions) ** 2).sum(axis=2) + (1e-6 * self._edge) ** 2)
        corners = faces_of(self.mesh)[near.triangle]
        return _Plan(
            point_set, names, corners, near.barycentric, near.triangle, closeness / closeness.sum(1, keepdims=True)
        )

    def _shortest_path(self, a: str, b: str, label: str) -> FloatArray:
        """Return (M, 3) the shortest path between two landmarks."""
        start, end = sorted((a, b))
        if (start, end) not in self._paths:
            ends = np.stack([self._landmarks[start], self._landmarks[end]])
            first, last = np.asarray(cKDTree(self.mesh.vertices).query(ends)[1]).tolist()
            ahead: Any = self._graph(self._edges)
            near = ahead
            for _ in range(_RINGS - 1):
                near = near + near @ ahead
            pairs = np.stack(near.nonzero(), axis=1)
            before = dijkstra(self._graph(pairs), indices=first, return_predecessors=True)[1]
            if first != last and before[last] < 0:
                raise InputError(f"{label}: no path on the surface leads from {a!r} to {b!r}; choose other landmarks.")
            vertices: list[int] = [last]
            while vertices[-1] != first:
                vertices.append(int(before[vertices[-1]]))
            path = np.concatenate([ends[:1], self.mesh.vertices[vertices[::-1]], ends[1:]])
            edges = np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / self._edge
            for per_edge in _PER_EDGE:
                path = spaced_points(path, 4 + int(per_edge * edges))
                for _ in range(_SWEEPS):
                    path[1:-1] = self._engine.query(np.ascontiguousarray(0.5 * (path[:-2] + path[2:]))).points
            fine = self._engine.query(spaced_points(path, 4 * len(path))).points
            self._paths[start, end] = np.concatenate([ends[:1], fine[1:-1], ends[1:]])
        return self._paths[start, end] if (start, end) == (a, b) else self._paths[start, end][::-1]

    def _samples(self, loop: FloatArray, point_set: SemilandmarkSet) -> FloatArray:
        """Return (M, 3) random points, evenly dense, on the smaller side of a closed path."""
        loop = loop[:-1]
        tree, engine = cKDTree(loop), self._engine.query(loop)
        along = np.roll(loop, -1, axis=0) - np.roll(loop, 1, axis=0)
        across = np.cross(vertex_normals(self.mesh)[engine.vertex], along)

        def side(points: FloatArray) -> tuple[FloatArray, BoolArray]:
            distance, nearest = map(np.asarray, tree.query(points))
            return distance, np.einsum("ij,ij->i", points - loop[nearest], across[nearest]) > 0

        distance, left = side(self.mesh.vertices)
        a, b = self._edges.T
        # A path may pass above a narrow valley.
        gap = np.linalg.norm(loop[1:] - loop[:-1], axis=1).max() + 2.0 * engine.distance.max()
        crosses = (left[a] != left[b]) & (np.maximum(distance[a], distance[b]) <= self._lengths(self._edges) + gap)
        part = np.asarray(connected_components(self._graph(self._edges[~crosses]), directed=False)[1])
        area = np.bincount(part, vertex_areas(self.mesh))
        adjacent = np.unique(part[self._edges[crosses]])
        order = adjacent[np.argsort(-area[adjacent])]
        inside = part == order[1] if len(order) > 1 else np.zeros(len(part), np.bool_)
        faces = faces_of(self.mesh)
        candidates = np.flatnonzero(inside[faces].any(axis=1))
        if not len(candidates):
            raise InputError(
                f"patch {point_set.name}: its boundary encloses no vertex of the corresponding surfaces; choose "
                "landmarks farther apart, or run shapespace correspond with more --vertices."
            )
        rng, share = np.random.default_rng(0), face_areas(self.mesh)[candidates]
        chosen = candidates[rng.choice(len(candidates), 2 * _SAMPLES * point_set.points, p=share / share.sum())]
        points = np.einsum("mc,mcd->md", rng.dirichlet(np.ones(3), len(chosen)), self.mesh.vertices[faces[chosen]])
        near_loop = np.flatnonzero(inside)[distance[inside].argsort()[: len(loop)]]
        is_left = left[near_loop].mean() > 0.5
        return points[inside[faces[chosen]].all(axis=1) | (side(points)[1] == is_left)]

    def _lengths(self, pairs: IntArray) -> FloatArray:
        return np.linalg.norm(self.mesh.vertices[pairs[:, 0]] - self.mesh.vertices[pairs[:, 1]], axis=1)

    def _graph(self, pairs: IntArray) -> Any:
        """Return the symmetric graph of pairs of vertices, with their distances."""
        count, (a, b) = len(self.mesh.vertices), pairs.T
        graph = sparse.coo_array((self._lengths(pairs), (a, b)), (count, count)).tocsr()
        return cast(Any, graph).maximum(graph.T)


def _trace_boundary(point_set: SemilandmarkSet, curves: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the landmarks around a patch; a curve is reversed if it would not connect otherwise.

    Raises:
        InputError: a curve does not begin or end where the part before it ends.
    """
    parts = [list(curves.get(name, (name,))) for name in point_set.along]
    chain = parts[0] if parts else []
    if len(parts) > 1 and len(chain) > 1 and chain[-1] not in (parts[1][0], parts[1][-1]):
        chain = chain[::-1]
    for name, part in zip(point_set.along[1:], parts[1:], strict=True):
        if len(part) == 1:
            chain = chain + part if chain[-1] != part[0] else chain
        elif chain[-1] in (part[0], part[-1]):
            chain = chain + (part if chain[-1] == part[0] else part[::-1])[1:]
        else:
            raise InputError(
                f"patch {point_set.name}: curve {name} neither begins nor ends at {chain[-1]!r}, so the boundary is "
                "not closed; list curves and landmarks in the order around the patch."
            )
    return chain


def _evenly_spaced(path: FloatArray, count: int, engine: ClosestPointEngine) -> FloatArray:
    """Return `count` points of a path on a surface, without its ends, at equal distances from each other."""
    path = engine.query(path).points
    place, points = np.linspace(0.0, 1.0, len(path)), path
    at: FloatArray = np.linspace(0.0, 1.0, count + 2)
    for _ in range(_SPACING_STEPS):
        points = engine.query(np.stack([np.interp(at, place, path[:, axis]) for axis in range(3)], axis=1)).points
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        at = np.asarray(np.interp(np.linspace(0.0, float(length[-1]), count + 2), length, at), dtype=np.float64)
    return points[1:-1]


def _spread_points(samples: FloatArray, weight: FloatArray, first: FloatArray, steps: int) -> FloatArray:
    """Return points evenly spread among samples, from `first` by Lloyd's method (k-means)."""
    points, weighted = first, np.column_stack([samples * weight[:, None], weight])
    for _ in range(steps):
        nearest = np.asarray(cKDTree(points).query(samples)[1])
        total = np.stack([np.bincount(nearest, column, len(points)) for column in weighted.T], axis=1)
        points = np.where(total[:, 3:] > 0, total[:, :3] / np.maximum(total[:, 3:], 1e-300), points)
    return points
