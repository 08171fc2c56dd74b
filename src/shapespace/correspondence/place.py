"""One scan of one round: where it lies, the template on it, and how well that is so."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from shapespace.correspondence.generic import generic_model
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import Marks
from shapespace.correspondence.register import ElasticSettings, Template, register
from shapespace.correspondence.template import Glance
from shapespace.errors import FitError, InputError, ShapespaceError
from shapespace.fit.dense.dense_fit import DenseSurface, dense_surface
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_settings import DenseSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.geometry.closest import ClosestPoints, build_engine, on_boundary
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import boundary_edges, boundary_vertices, rms_size, vertex_normals
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

REACHED = 0.03
"""A scan's point is reached when the surface is this near, as a share of the size."""
_ALTERNATIVES = 3
_AS_GOOD = 0.8
"""Poses are all tried whose score times this is no worse than the best one's."""
_LEFT_OVER = 0.05
_OTHERS_SAY = 0.95
"""A pose that the other shapes make likelier than all others is tried beside the one there is."""
_OTHER_SIZE = 8.0
"""Units differ by more, and what a scan shows beside the object hardly does."""
_CONTRADICTED = 2.0
"""Landmarks too few for a pose rule poses out in which they lie this many times as far off as in another."""
_SAME_TURN_TRACE = 1 + 2 * np.cos(np.radians(40.0))
_BULGING = 0.2
"""How far the normals of a sheet point away from its middle, 0 to 1, when it is clear which way it bulges."""
_FEW_HARMONICS = 4
_GUIDING = FitConfig(unit="mm", scale="free")
_MEASURED = 20_000
_FAR = (np.inf, np.inf, np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class PlaceTask:
    """What to do with one scan.

    Args:
        index: of the scan.
        scan: repaired, in its own frame and unit.
        T_scan_template: where the template lies in it; None searches from anywhere.
        expected: (V, 3) the shape to begin from, in the template's frame; None is the template.
        settings: of the registration.
        glance: which of the bench's glances knows nothing of this scan.
        marks: the scan's landmarks, in its own frame; None where it has none.
    """

    index: int
    scan: Mesh
    T_scan_template: Similarity | None
    expected: FloatArray | None
    settings: ElasticSettings
    glance: int = 0
    marks: Marks | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """What came of it.

    Args:
        index: of the scan.
        vertices: (V, 3) in the template's frame.
        T_scan_template: to the scan's own frame.
        seen: (V,) which vertices the scan shows.
        covered: share of the scan's points that the surface reaches.
        distance: (4,) mean, 95 %, 99 % and largest distance both ways, in the template's unit.
        seconds: CPU time.
        reason: why there is nothing, where there is nothing; the arrays are then those of the template.
        rivals: what came of other poses that are about as likely.
        mirrored: how far from the template the scan's mirror image lies, as a share of how far the scan does, by what
            is known for a pose; not-a-number where the pose is known or told by landmarks.
        by_landmarks: whether they tell the pose.
    """

    index: int
    vertices: FloatArray
    T_scan_template: Similarity
    seen: BoolArray
    covered: float
    distance: tuple[float, float, float, float]
    seconds: float
    reason: str = ""
    rivals: tuple[Placed, ...] = ()
    mirrored: float = np.nan
    by_landmarks: bool = False


@dataclass(frozen=True, eq=False)
class Workbench:
    """What all tasks of a round share.

    Args:
        mesh: the template.
        harmonics: its smooth functions.
        glances: the template with few vertices, for poses: one, or one for each part of the scans that it leaves out.
        seed: of all that is drawn.
        guide: a model whose mean is the template; where nothing else is known of a scan, its fit tells.
    """

    mesh: Mesh
    harmonics: Harmonics
    glances: tuple[Glance, ...]
    seed: int
    guide: ShapeModel | None = None

    @cached_property
    def template(self) -> Template:
        """The template made ready."""
        return Template.of(self.mesh, self.harmonics)

    @cached_property
    def model(self) -> ShapeModel:
        """The template as a shape model, of which the dense stage uses the mean alone."""
        return generic_model(self.mesh, self.harmonics.slowest(_FEW_HARMONICS))

    @cached_property
    def bare(self) -> Glance:
        """The template with few vertices, with generic modes alone."""
        return Glance.of(self.mesh)

    def place(self, task: PlaceTask) -> Placed:
        """Return the template on the task's scan; a scan that cannot be reached gives a reason."""
        begun = time.process_time()
        try:
            with threadpool_limits(limits=1, user_api="blas"):
                placed = self._best(task)
        except ShapespaceError as error:
            placed = self.nothing(task.index, str(error))
        return replace(placed, seconds=time.process_time() - begun)

    def _best(self, task: PlaceTask) -> Placed:
        T = task.T_scan_template
        marked = None if task.marks is None else task.marks.pose(self.mesh.vertices)
        if marked is not None:
            ratio = marked.scale * rms_size(self.mesh.vertices) / rms_size(task.scan.vertices)
            if not 1 / _OTHER_SIZE < ratio < _OTHER_SIZE:
                raise InputError(f"its landmarks are those of an object {ratio:.2g} times its size; look at their unit")
            told = (task, T) if T is not None and _is_same_turn(T, marked) else None
            return replace(self._from(*(told or self._guided(replace(task, expected=None), marked))), by_landmarks=True)
        glance, vertices = self.glances[task.glance], np.array(task.scan.vertices)
        start = glance.start(vertices, self.seed)
        if T is not None:
            return self._unmarked(task, start)
        mirrored = glance.start(vertices * FLIP, self.seed).score_mm / max(start.score_mm, 1e-12)
        if self.guide is not None and mirrored < 1.0:  # what a model does not hold it holds of no mirror image either
            scores = [self.bare.start(points, self.seed).score_mm for points in (vertices, vertices * FLIP)]
            mirrored = max(mirrored, scores[1] / max(scores[0], 1e-12))
        return replace(self._unmarked(task, start), mirrored=mirrored)

    def _unmarked(self, task: PlaceTask, start: Start) -> Placed:
        T = task.T_scan_template
        if T is not None:
            placed = self._from(task, T)
            if start.score_mm > _OTHERS_SAY * start.runner_up_score_mm or _is_same_turn(T, start.T_scan_model):
                return placed
            if self._off(task, start.T_scan_model) > _CONTRADICTED * self._off(task, T):
                return placed
            rival = self._tried(replace(task, expected=None), start)
            return placed if rival is None else replace(placed, rivals=(rival,))
        starts = likely(start)
        nearest = min(self._off(task, one.T_scan_model) for one in starts)
        told = [one for one in starts if self._off(task, one.T_scan_model) <= _CONTRADICTED * nearest]
        tries = [self._tried(task, one) for one in told]
        good = [placed for placed in tries if placed is not None]
        if not good:
            raise FitError("surface not reached: too little of the scan matches the template from any pose")
        # By how near it comes a smooth object fits in wrong poses too, so the search decides, unless much is left over.
        most = max(placed.covered for placed in good)
        first, *others = [placed for placed in good if placed.covered > most - _LEFT_OVER]
        return replace(first, rivals=tuple(others))

    def _off(self, task: PlaceTask, T: Similarity) -> float:
        """Return how far, RMS in the template's unit, the landmarks lie off in a pose; 0 where there are none."""
        return 0.0 if task.marks is None else task.marks.moved(T.inverse()).rms(self.mesh.vertices)

    def _tried(self, task: PlaceTask, start: Start) -> Placed | None:
        try:
            return self._from(*self._guided(task, start.T_scan_model))
        except (FitError, InputError):
            return None

    def _guided(self, task: PlaceTask, T: Similarity) -> tuple[PlaceTask, Similarity]:
        """Return what the guide's fit from `T` says of the scan, where nothing else is known and it says something."""
        if self.guide is None or task.expected is not None:
            return task, T
        scan = task.scan.with_vertices(T.inverse().apply(task.scan.vertices))
        fit = fit_scan(self.guide, scan, _GUIDING, T_scan_model=Similarity.identity())
        if fit.status != "converged":
            return task, T
        shape = np.asarray(self.guide.reconstruct(fit.b), dtype=np.float64)
        return replace(task, expected=shape), T @ fit.T_scan_model

    def _from(self, task: PlaceTask, T: Similarity) -> Placed:
        scan = task.scan.with_vertices(T.inverse().apply(task.scan.vertices))
        target = ScanTarget(_facing(scan, self.mesh))
        found = register(
            self.template, target, Similarity.identity(), task.settings, expected=task.expected,
            marks=None if task.marks is None else task.marks.moved(T.inverse()), seed=self.seed,
        )  # fmt: skip
        start = found.T_scan_template.apply(found.vertices)
        dense = dense_surface(self.model, target, start, found.T_scan_template, DenseSettings(seed=self.seed))
        near = target.engine.query(dense.vertices_scan_mm)
        seen = self._shown(dense, near, target, task.settings.normal_cosine)
        covered, distance = self._judged(dense.vertices_scan_mm, near.distance[seen], target)
        back = found.T_scan_template.inverse()
        mean, p95, p99, largest = (back.scale * length for length in distance)
        return Placed(
            task.index, back.apply(dense.vertices_scan_mm), T @ found.T_scan_template, seen, covered,
            (mean, p95, p99, largest), 0.0,
        )  # fmt: skip

    def _shown(self, dense: DenseSurface, near: ClosestPoints, target: ScanTarget, cosine: float) -> BoolArray:
        """Return (V,) which vertices the scan shows: those that lie on it, believed by the dense stage or on no rim.

        On a clean scan that stage drops what lies off it by little; what it believes on a rim goes on beyond it.
        """
        if target.mesh.faces is None:
            return dense.seen
        reached = near.distance < REACHED * self.template.size_mm
        normals = vertex_normals(self.mesh.with_vertices(dense.vertices_scan_mm))
        alike = np.einsum("vd,vd->v", normals, target.normals[near.vertex])
        inside = (alike > cosine) & ~on_boundary(near, target.mesh, target.rim)
        return np.asarray(reached & (dense.seen | inside))

    def _judged(
        self, vertices: FloatArray, forward: FloatArray, target: ScanTarget
    ) -> tuple[float, tuple[float, float, float, float]]:
        """Return the share of the scan that is reached, and distances both ways over what both show.

        Args:
            vertices: (V, 3) of the surface.
            forward: of those that are seen, to the scan.
            target: the scan.
        """
        surface = Mesh(vertices, self.mesh.faces)
        rng = np.random.default_rng(self.seed)
        points = target.mesh.vertices
        if len(points) > _MEASURED:
            points = points[np.sort(rng.choice(len(points), _MEASURED, replace=False))]
        back = build_engine(surface).query(points)
        beyond = on_boundary(back, surface, boundary_vertices(surface))
        limit = REACHED * self.template.size_mm
        covered = float((back.distance[~beyond] < limit).mean()) if not beyond.all() else 0.0
        both = np.concatenate([forward, back.distance[~beyond]])
        if not len(both):
            return 0.0, _FAR
        shares = np.quantile(both, [0.95, 0.99, 1.0])
        return covered, (float(both.mean()), float(shares[0]), float(shares[1]), float(shares[2]))

    def nothing(self, index: int, reason: str) -> Placed:
        """Return what stands for a scan that is not placed."""
        vertices = np.array(self.mesh.vertices)
        return Placed(index, vertices, Similarity.identity(), np.zeros(len(vertices), np.bool_), 0.0, _FAR, 0.0, reason)


def _facing(scan: Mesh, surface: Mesh) -> Mesh:
    """Return `scan`, turned where it looks against `surface`, on which it lies; only sheets as much bowl as cap are.

    The normals of others tell which side is outside, and so which of two poses is right.
    """
    if scan.faces is None or not len(boundary_edges(scan.faces)):
        return scan
    normals, arms = vertex_normals(scan), scan.vertices - scan.vertices.mean(axis=0)
    if abs(float((normals * arms).sum())) > _BULGING * float(np.linalg.norm(arms, axis=1).sum()):
        return scan
    near = cKDTree(surface.vertices).query(scan.vertices)[1]
    agree = np.einsum("vd,vd->v", normals, vertex_normals(surface)[near])
    return scan if np.median(agree) >= 0 else Mesh(scan.vertices, scan.faces[:, ::-1], name=scan.name)


def _is_same_turn(one: Similarity, other: Similarity) -> bool:
    return float(np.trace(one.rotation @ other.rotation.T)) > _SAME_TURN_TRACE


def likely(start: Start) -> list[Start]:
    """Return the best start and those about as good."""
    others = [one for one in start.alternatives if _AS_GOOD * one.score_mm <= start.score_mm]
    return [start, *others][:_ALTERNATIVES]
