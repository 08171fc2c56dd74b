"""One scan of one round: its pose, the template registered to it, and the quality of the registration.

Equations Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from shapespace.correspondence.harmonics import Harmonics, agreement, relief
from shapespace.correspondence.isometry import IntrinsicShape, bent_shapes, distinct, is_apart
from shapespace.correspondence.landmark_guide import MirroredLandmarksError, ScanLandmarks
from shapespace.correspondence.pose_consensus import angle_deg
from shapespace.correspondence.register import ElasticSettings, Template, register
from shapespace.correspondence.settings import PoseRange
from shapespace.correspondence.template import PoseModel, generic_model
from shapespace.errors import FitError, InputError, ShapespaceError
from shapespace.fit.dense.dense_fit import DenseSurface, dense_surface
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_settings import DenseSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.geometry.closest import ClosestPoints, build_engine, on_boundary
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import boundary_edges, boundary_vertices, edge_stretch, rms_size, vertex_normals
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, ByteArray, FloatArray, IntArray, Mesh, Similarity

REACHED = 0.03
"""Distance of a scan's point from the surface, as a share of the size, up to which the point is covered."""
_ALTERNATIVES = 3  # largest number of poses that are registered; each costs a complete registration
_AS_GOOD = 0.8
"""Ratio of the best score to that of another pose, from which on the other pose is tried too."""
_LEFT_OVER = 0.05  # share of the scan covered; registrations within it of the best count as equally complete
_BETTER_POSE = 0.95
"""Ratio of scores below which a pose of the search with the modes of other scans is tried in addition to the known."""
_OTHER_SIZE = 8.0
"""Ratio of sizes, by landmarks and by vertices, that shows another unit; other objects in a scan change it by less."""
_OTHER_FRAME = 0.75
"""A pose of the search whose score is below this ratio of that near the frame of the file shows that the frame is
another one: of 26 molars in their own frames this is true for the four that landmarks show to be rotated by 60 degrees
or more, and for no other."""
_CONTRADICTED = 2.0
"""Ratio of landmark distances above which too few landmarks for a pose exclude a pose, compared with another pose."""
_SAME_TURN_TRACE = 1 + 2 * np.cos(np.radians(40.0))
_EITHER_SIDE = 1.05
"""Ratio of the scores of a scan and its mirror image up to which both are registered: it was 1.01 or more for 26 molars
of the majority, against the mean of all, and 0.98 or less for 13 mirrored ones."""
_STRAINED = 0.0009
"""Mean distance from the scan, share of the size, times RMS log stretch of edges, beyond which limbs may be missing or
exchanged: 3 of 59 faces, femora, molars, spleens and blobs, complete or damaged, had more (two cut femora and a blob),
and 13 of 50 figures with moving limbs, of which the others had at most 0.0007."""
CLEARLY_LESS_STRAINED = 0.7
"""Ratio of this strain below which a registration from a map along the surface replaces another one. For an object that
is known to bend, relief alone decides: the registration from its own surface of the last round has the least strain."""
_UNREACHED = "surface not reached: too little of the scan matches the template from any pose"
_BULGING = 0.2
"""Degree, 0 to 1, to which the normals of a sheet point away from its centre, from which its outside is clear."""
_FEW_HARMONICS = 4  # slowest harmonics: without known shapes the pose model may only stretch and bend
_GUIDE_CONFIG = FitConfig(unit="mm", scale="free")
_MEASURED = 20_000  # points of a scan at which distances are measured: an error below 1 % of their mean
Comparison: TypeAlias = Literal["as given", "one", "pose", "scores", "both"]
_Distances: TypeAlias = tuple[float, float, float, float]
_FAR: _Distances = (np.inf, np.inf, np.inf, np.inf)


class PoseScores(NamedTuple):
    """Scores of poses of one scan, shares of the template's size.

    Args:
        pose: score of the pose of the scan.
        mirrored: score of the best pose of its mirror image.
    """

    pose: float
    mirrored: float


@dataclass(frozen=True, eq=False)
class RegistrationTask:
    """The registration of one scan.

    Args:
        index: index of the scan.
        scan: the repaired scan, in its own frame and unit.
        T_scan_template: pose of the template in the scan's frame; None searches all poses.
        expected: (V, 3) the initial shape, in the template's frame; None is the template.
        settings: settings of the registration.
        pose_model: index of the context's pose model that was trained without this scan.
        landmarks: landmarks of the scan, in its own frame; None without landmarks.
        mirrored: whether `scan` and `landmarks` are the mirror image of those in the file.
        sides: comparison of the scan with its mirror image: never, by its landmarks alone, by the scores of the
            pose search (nothing is registered), or by scores and registrations if the scores are about equal; or
            of poses alone, with nothing registered.
        pose: range of poses that are searched; for mirror images and comparisons of scores all.
        other_pose: additional pose from which the scan is registered; None without such a pose.
        bent: whether `expected` is the scan's own surface of the last round, so that no pose is searched.
        is_start_known: whether it is registered from `T_scan_template` and `expected` alone.
        from_all_poses: whether it is registered from all likely poses, and, if sides are compared, also as its mirror
            image.
        symmetries: (S, V) near symmetries of the object, see `ScanRegistration.symmetries`: a bent scan is also
            registered from its own surface after each symmetry.
    """

    index: int
    scan: Mesh
    T_scan_template: Similarity | None
    expected: FloatArray | None
    settings: ElasticSettings
    pose_model: int = 0
    landmarks: ScanLandmarks | None = None
    mirrored: bool = False
    sides: Comparison = "as given"
    pose: PoseRange = "search"
    other_pose: Similarity | None = None
    bent: bool = False
    is_start_known: bool = False
    from_all_poses: bool = False
    symmetries: IntArray | None = None

    def reflected(self) -> RegistrationTask:
        """Return the same task for the mirror image of its scan, at an unknown pose."""
        landmarks = None if self.landmarks is None else self.landmarks.reflected()
        return replace(
            self, scan=mirror_image(self.scan), landmarks=landmarks, mirrored=not self.mirrored, T_scan_template=None,
            other_pose=None,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ScanRegistration:
    """The template registered to one scan.

    Args:
        index: index of the scan.
        vertices: (V, 3) vertices in the template's frame.
        T_scan_template: similarity from the template's frame to the scan's own frame.
        observed: (V,) True where the scan shows the vertex.
        covered: share of the scan's points that the surface covers.
        distance: (4,) mean, 95 %, 99 % and largest distance both ways, in the template's unit.
        cpu_s: CPU time, seconds.
        reason: why the registration failed; empty if it did not. The arrays of a failed registration are those of the
            template.
        alternatives: registrations from other poses that are about equally likely.
        mirrored: whether it is the registration of the scan's mirror image.
        scores: scores of the pose search, shares of the template's size; not-a-number if nothing was compared.
        posed_by_landmarks: whether the landmarks determine the pose.
        stretch: RMS log ratio of its edges to those of the template, the change of size removed.
        bent: whether it began at a map along the surface, for an object whose limbs have moved.
        colours: (V, 3) uint8 colours of the scan at the vertices; None without colours.
        relief_gap: agreement of its relief with the template's minus that from the best other map along the surface;
            infinite without another map.
        symmetries: (S, V) index of the vertex of this surface at the position of each vertex, for each other map along
            the surface; None if there is no other map.
    """

    index: int
    vertices: FloatArray
    T_scan_template: Similarity
    observed: BoolArray
    covered: float
    distance: _Distances
    cpu_s: float
    reason: str = ""
    alternatives: tuple[ScanRegistration, ...] = ()
    mirrored: bool = False
    scores: PoseScores = field(default_factory=lambda: PoseScores(np.nan, np.nan))
    posed_by_landmarks: bool = False
    stretch: float = 0.0
    bent: bool = False
    colours: ByteArray | None = None
    relief_gap: float = np.inf
    symmetries: IntArray | None = None

    @property
    def vertices_on_scan(self) -> FloatArray:
        """(V, 3) vertices in the scan's own frame."""
        return self.T_scan_template.apply(self.vertices)

    @property
    def strain(self) -> float:
        """Distance from the scan times stretch of the edges: large if a limb was missed or exchanged with another."""
        return self.distance[0] * self.stretch


@dataclass(frozen=True, eq=False)
class RoundContext:
    """Shared input of all tasks of a round.

    Args:
        mesh: the template.
        harmonics: harmonics of the template.
        pose_models: pose models for the search: one, or one for each part of the scans, trained without that part.
        seed: seed of all random choices.
        guide: a model whose mean is the template; a scan without a prediction begins at its fit.
    """

    mesh: Mesh
    harmonics: Harmonics
    pose_models: tuple[PoseModel, ...]
    seed: int
    guide: ShapeModel | None = None

    @cached_property
    def template(self) -> Template:
        """The template with precomputed data for registrations."""
        return Template.of(self.mesh, self.harmonics)

    @cached_property
    def model(self) -> ShapeModel:
        """The template as a shape model, of which the dense stage uses only the mean."""
        return generic_model(self.mesh, self.harmonics.slowest(_FEW_HARMONICS))

    @cached_property
    def intrinsic(self) -> IntrinsicShape:
        """Intrinsic shape of the template, which bending does not change."""
        return IntrinsicShape.of(self.mesh, self.harmonics)

    @cached_property
    def template_relief(self) -> FloatArray:
        """(V,) the relief of the template."""
        return relief(self.mesh.vertices, self.mesh, self.harmonics)

    def register(self, task: RegistrationTask) -> ScanRegistration:
        """Register the template to the task's scan; a scan that cannot be registered has a reason."""
        begun = time.process_time()
        try:
            with threadpool_limits(limits=1, user_api="blas"):
                if task.sides in ("pose", "scores"):
                    registration = self._compare(task)
                elif task.is_start_known and task.T_scan_template is not None:
                    registration = self._register_at(task, task.T_scan_template)
                else:
                    registration = self._register_bent(task, self._register(task))
        except ShapespaceError as error:
            registration = self.failed(task.index, str(error))
        return replace(registration, cpu_s=time.process_time() - begun)

    def failed(self, index: int, reason: str) -> ScanRegistration:
        """Return the registration of a scan that could not be registered."""
        return ScanRegistration(
            index=index,
            vertices=np.array(self.mesh.vertices),
            T_scan_template=Similarity.identity(),
            observed=np.zeros(len(self.mesh.vertices), np.bool_),
            covered=0.0,
            distance=_FAR,
            cpu_s=0.0,
            reason=reason,
        )

    # Choice of the pose

    def _register(self, task: RegistrationTask) -> ScanRegistration:
        if task.bent and task.T_scan_template is not None:
            return replace(self._register_at(task, task.T_scan_template), bent=True)
        if task.landmarks is not None:
            try:
                pose = task.landmarks.pose(self.mesh.vertices)
            except MirroredLandmarksError:
                if task.sides == "as given":
                    raise
                task = task.reflected()
                pose = None if task.landmarks is None else task.landmarks.pose(self.mesh.vertices)
            if pose is not None:
                return self._register_by_landmarks(task, pose)
        start = self._search_pose(task)
        if task.sides in ("one", "as given"):
            return self._register_side(task, start)
        other = task.reflected()
        mirrored = self._search_pose(other)
        likely = [
            (side, at)
            for side, at in ((task, start), (other, mirrored))
            if task.from_all_poses
            or side.T_scan_template is not None
            or at.score_mm <= _EITHER_SIDE * min(start.score_mm, mirrored.score_mm)
        ]
        registered = [
            registration for registration in (self._try_side(*side) for side in likely) if registration is not None
        ]
        if not registered:
            raise FitError(_UNREACHED)
        first, *others = registered
        size = rms_size(self.pose_models[task.pose_model].model.mean_vertices)
        scores = PoseScores(start.score_mm / size, mirrored.score_mm / size)
        return replace(first, alternatives=(*first.alternatives, *others), scores=scores)

    def _compare(self, task: RegistrationTask) -> ScanRegistration:
        """Return the pose of a scan, and as an alternative that of its mirror image, with scores.

        Nothing is registered.
        """
        model = self.pose_models[task.pose_model]
        size = rms_size(model.model.mean_vertices)
        found = model.search(np.array(task.scan.vertices), self.seed, quick=True)
        compared = replace(self.failed(task.index, "only compared"), T_scan_template=found.T_scan_model)
        if task.sides == "pose":
            return replace(compared, scores=PoseScores(found.score_mm / size, np.inf))
        image = model.search(np.array(task.reflected().scan.vertices), self.seed, quick=True)
        other = replace(compared, T_scan_template=image.T_scan_model, mirrored=not task.mirrored)
        return replace(compared, alternatives=(other,), scores=PoseScores(found.score_mm / size, image.score_mm / size))

    def _register_bent(self, task: RegistrationTask, registration: ScanRegistration) -> ScanRegistration:
        """Return `registration`, or one from a map along the surface whose strain is clearly less.

        Of several maps, that whose relief agrees best with the template's is used.
        """
        strained = task.bent or registration.strain > _STRAINED * self.template.size_mm
        if task.pose != "search" or registration.posed_by_landmarks or not strained:
            return registration
        limit = np.inf if task.bent else CLEARLY_LESS_STRAINED * registration.strain
        task = task.reflected() if registration.mirrored != task.mirrored else task
        least = (registration.covered - _LEFT_OVER, registration.observed.mean() - _LEFT_OVER)
        candidates = [replace(registration, bent=True)] if task.bent else []
        for shape in self._shapes_by_map(task, registration):
            T = fit_similarity(self.mesh.vertices, shape)
            try:
                bent = self._register_at(replace(task, expected=T.inverse().apply(shape)), T)
            except ShapespaceError:
                continue
            if bent.covered >= least[0] and bent.observed.mean() >= least[1] and bent.strain < limit:
                candidates.append(replace(bent, bent=True))
        if not candidates:
            return registration
        agreements = [self._relief_agreement(candidate) for candidate in candidates]
        highest = max(agreements)
        best = candidates[agreements.index(highest)]
        own, size_mm = best.vertices_on_scan, rms_size(task.scan.vertices)
        others = [
            (highest - value, candidate.vertices_on_scan)
            for candidate, value in zip(candidates, agreements, strict=True)
            if is_apart(candidate.vertices_on_scan, own, size_mm)
        ]
        if not others:
            return best
        nearest = cKDTree(own)
        symmetries = np.stack([np.asarray(nearest.query(shape)[1], dtype=np.int32) for _, shape in others])  # C54
        return replace(best, relief_gap=min(gap for gap, _ in others), symmetries=symmetries)

    def _shapes_by_map(self, task: RegistrationTask, registration: ScanRegistration) -> list[FloatArray]:
        """Return the distinct shapes (V, 3) in the scan's frame by maps along the surface.

        For an object that is known to bend, they include its own surface after each near symmetry.
        """
        own = registration.vertices_on_scan
        symmetries = task.symmetries if task.bent and task.symmetries is not None else ()
        shapes = [self.intrinsic.smooth(own[symmetry]) for symmetry in symmetries]
        with suppress(ShapespaceError):  # the triangles do not form a sheet
            shapes += bent_shapes(self.intrinsic, IntrinsicShape.of_scan(task.scan), self.seed)
        known = [own] if task.bent else []
        return distinct(shapes, rms_size(task.scan.vertices), known)

    def _relief_agreement(self, registration: ScanRegistration) -> float:
        """Return the agreement of the relief of a surface with that of the template (C35)."""
        own = relief(registration.vertices, self.mesh, self.harmonics)
        return agreement(own, self.template_relief, self.harmonics.area * registration.observed)

    def _search_pose(self, task: RegistrationTask) -> Start:
        vertices = np.array(task.scan.vertices)
        model, pose = self.pose_models[task.pose_model], "search" if task.mirrored else task.pose
        start = model.search(vertices, self.seed, pose=pose)
        if pose != "search" and len(self.pose_models) > 1:  # with the modes of the other scans, scores are reliable
            best = model.search(vertices, self.seed, quick=True)
            if best.score_mm < _OTHER_FRAME * start.score_mm:
                degrees = angle_deg(best.T_scan_model, Similarity.identity())
                raise FitError(
                    f"the frame of its file is rotated by about {degrees:.0f} degrees from those of the others; rotate "
                    "it, or omit --pose"
                )
        return start

    def _register_side(self, task: RegistrationTask, start: Start) -> ScanRegistration:
        """Register from the known pose, or from the likely poses of the search."""
        if task.T_scan_template is not None:
            return self._register_near(task, task.T_scan_template, start)
        return self._register_from_search(task, start)

    def _register_by_landmarks(self, task: RegistrationTask, pose: Similarity) -> ScanRegistration:
        ratio = pose.scale * rms_size(self.mesh.vertices) / rms_size(task.scan.vertices)
        if not 1 / _OTHER_SIZE < ratio < _OTHER_SIZE:
            raise InputError(f"its landmarks are those of an object {ratio:.2g} times its size; check their unit")
        T = task.T_scan_template
        if T is None or not _is_same_rotation(T, pose):
            task, T = self._with_guide_fit(replace(task, expected=None), pose)
        return replace(self._register_at(task, T), posed_by_landmarks=True)

    def _try_side(self, task: RegistrationTask, start: Start) -> ScanRegistration | None:
        try:
            return self._register_side(task, start)
        except (FitError, InputError):
            return None

    def _register_near(self, task: RegistrationTask, T: Similarity, start: Start) -> ScanRegistration:
        """Register from the known pose `T`; a much likelier pose of the search and the other pose are alternatives."""
        registration = self._register_at(task, T)
        others = [start] if start.score_mm <= _BETTER_POSE * start.runner_up_score_mm else []
        others = likely_starts(start) if task.from_all_poses else others
        others += [] if task.other_pose is None else [Start(task.other_pose, "given", np.nan)]
        tried = [
            self._try_start(replace(task, expected=None), other)
            for other in others
            if not _is_same_rotation(T, other.T_scan_model)
            and self._landmark_distance(task, other.T_scan_model) <= _CONTRADICTED * self._landmark_distance(task, T)
        ]
        return replace(registration, alternatives=tuple(other for other in tried if other is not None))

    def _register_from_search(self, task: RegistrationTask, start: Start) -> ScanRegistration:
        """Register from each likely pose of the search; registrations that cover about as much are alternatives."""
        starts = likely_starts(start)
        distances = [self._landmark_distance(task, likely.T_scan_model) for likely in starts]
        nearest = min(distances)
        tried = [
            self._try_start(task, likely)
            for likely, distance in zip(starts, distances, strict=True)
            if distance <= _CONTRADICTED * nearest
        ]
        registered = [registration for registration in tried if registration is not None]
        if not registered:
            raise FitError(_UNREACHED)
        # A smooth object is near the scan in wrong poses too, so the search decides, unless much is not covered.
        most = max(registration.covered for registration in registered)
        first, *others = [registration for registration in registered if registration.covered > most - _LEFT_OVER]
        return replace(first, alternatives=tuple(others))

    def _landmark_distance(self, task: RegistrationTask, T: Similarity) -> float:
        """Return the RMS distance of the landmarks in a pose, in the template's unit; 0 without landmarks."""
        if task.landmarks is None:
            return 0.0
        return task.landmarks.transformed(T.inverse()).rms_distance(self.mesh.vertices)

    def _try_start(self, task: RegistrationTask, start: Start) -> ScanRegistration | None:
        try:
            return self._register_at(*self._with_guide_fit(task, start.T_scan_model))
        except (FitError, InputError):
            return None

    def _with_guide_fit(self, task: RegistrationTask, T: Similarity) -> tuple[RegistrationTask, Similarity]:
        """Return task and pose with the guide's fit from `T`, if there is no prediction and the fit converges."""
        if self.guide is None or task.expected is not None:
            return task, T
        scan = task.scan.with_vertices(T.inverse().apply(task.scan.vertices))
        fit = fit_scan(self.guide, scan, _GUIDE_CONFIG, T_scan_model=Similarity.identity())
        if fit.status != "converged":
            return task, T
        shape = np.asarray(self.guide.reconstruct(fit.b), dtype=np.float64)
        return replace(task, expected=shape), T @ fit.T_scan_model

    # Registration from one pose

    def _register_at(self, task: RegistrationTask, T: Similarity) -> ScanRegistration:
        """Register from the pose `T`: elastic registration, then the details by the dense stage of a fit."""
        scan = task.scan.with_vertices(T.inverse().apply(task.scan.vertices))
        target = ScanTarget(_facing_like(scan, self.mesh))
        elastic = register(
            self.template,
            target,
            Similarity.identity(),
            task.settings,
            expected=task.expected,
            landmarks=None if task.landmarks is None else task.landmarks.transformed(T.inverse()),
            seed=self.seed,
        )
        start = elastic.T_scan_template.apply(elastic.vertices)
        dense = dense_surface(self.model, target, start, elastic.T_scan_template, DenseSettings(seed=self.seed))
        nearest = target.engine.query(dense.vertices_scan_mm)
        observed = self._find_observed(dense, nearest, target, task.settings.normal_cosine)
        covered, distance = self._measure_quality(dense.vertices_scan_mm, nearest.distance[observed], target)
        T_template_scan = elastic.T_scan_template.inverse()
        mean, p95, p99, largest = (T_template_scan.scale * length for length in distance)
        vertices = T_template_scan.apply(dense.vertices_scan_mm)
        return ScanRegistration(
            index=task.index,
            vertices=vertices,
            T_scan_template=T @ elastic.T_scan_template,
            observed=observed,
            covered=covered,
            distance=(mean, p95, p99, largest),
            cpu_s=0.0,
            mirrored=task.mirrored,
            stretch=edge_stretch(vertices, self.mesh),
            colours=None if target.mesh.colours is None else target.mesh.colours[nearest.vertex],
        )

    def _find_observed(
        self, dense: DenseSurface, nearest: ClosestPoints, target: ScanTarget, cosine: float
    ) -> BoolArray:
        """Return (V,) whether the scan shows each vertex (C9): near it, and observed by the dense stage or on no rim.

        On a clean scan that stage drops vertices that are slightly off it; those that it keeps on a rim are beyond it.
        """
        if target.mesh.faces is None:
            return dense.seen
        near = nearest.distance < REACHED * self.template.size_mm
        normals = vertex_normals(self.mesh.with_vertices(dense.vertices_scan_mm))
        alike = np.einsum("vd,vd->v", normals, target.normals[nearest.vertex])
        inside = (alike > cosine) & ~on_boundary(nearest, target.mesh, target.rim)
        return np.asarray(near & (dense.seen | inside))  # C9

    def _measure_quality(
        self, vertices: FloatArray, forward: FloatArray, target: ScanTarget
    ) -> tuple[float, _Distances]:
        """Return the share of the scan that is covered (C10), and distances both ways over the overlap.

        Args:
            vertices: (V, 3) vertices of the surface.
            forward: distances of the observed vertices from the scan.
            target: the scan.
        """
        surface = Mesh(vertices, self.mesh.faces)
        rng = np.random.default_rng(self.seed)
        points = target.mesh.vertices
        if len(points) > _MEASURED:
            points = points[np.sort(rng.choice(len(points), _MEASURED, replace=False))]
        nearest = build_engine(surface).query(points)
        beyond = on_boundary(nearest, surface, boundary_vertices(surface))
        limit = REACHED * self.template.size_mm
        covered = float((nearest.distance[~beyond] < limit).mean()) if not beyond.all() else 0.0  # C10
        both = np.concatenate([forward, nearest.distance[~beyond]])
        if not len(both):
            return 0.0, _FAR
        p95, p99, largest = (float(value) for value in np.quantile(both, [0.95, 0.99, 1.0]))
        return covered, (float(both.mean()), p95, p99, largest)


def _facing_like(scan: Mesh, surface: Mesh) -> Mesh:
    """Return `scan`, its winding reversed if its normals oppose those of `surface`, on which it lies.

    Only sheets that resemble a bowl as much as a cap are reversed: the normals of others show which side is outside,
    and so which of two poses is right.
    """
    if scan.faces is None or not len(boundary_edges(scan.faces)):
        return scan
    normals, arms = vertex_normals(scan), scan.vertices - scan.vertices.mean(axis=0)
    if abs(float((normals * arms).sum())) > _BULGING * float(np.linalg.norm(arms, axis=1).sum()):
        return scan
    nearest = cKDTree(surface.vertices).query(scan.vertices)[1]
    agree = np.einsum("vd,vd->v", normals, vertex_normals(surface)[nearest])
    return scan if np.median(agree) >= 0 else replace(scan, faces=scan.faces[:, ::-1])


def _is_same_rotation(a: Similarity, b: Similarity) -> bool:
    return float(np.trace(a.rotation @ b.rotation.T)) > _SAME_TURN_TRACE


def likely_starts(start: Start) -> list[Start]:
    """Return the best start and the alternatives with about as good scores."""
    others = [alternative for alternative in start.alternatives if _AS_GOOD * alternative.score_mm <= start.score_mm]
    return [start, *others][:_ALTERNATIVES]
