"""Phase 2 as we would do it: pose and shape at once, from both directions, robustly, with the prior.

One iteration minimises, over a small change of the pose and over the coefficients b, in the model's frame,

    sum_i w_i r_i^2 / sigma^2  +  sum_k b_k^2 / lam_k  +  log(s / s_0)^2 / sd_s^2

where r_i is how far the model lies from a match along the model's own normal (Chen and Medioni, 1992). Matches go both
ways: each scan point to the closest point of the moving surface, and each model vertex to the closest point of the
scan. Those on a border, with normals that disagree, or far off for the spread of the rest count little or nothing
(Zhang, Yao and Deng, PAMI 2022). The second term is the prior (Blanz et al., 2004); the third keeps a scale that the
scan hardly shows. Few modes are free at first and all in the end; where the scan then shows a shape that the model
cannot make, the modes of `residual` join in, so that what the model lacks does not bend what it has.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from shapespace.errors import FitError
from shapespace.fit.kernels import Float32Array, gather_into, rows_into
from shapespace.fit.matching import VertexMatches, match_vertices, unexplained_variance, winding_of
from shapespace.fit.moving_model import POSE, MovingSurface, PreparedModel, prepare
from shapespace.fit.posterior import posterior
from shapespace.fit.regions import FinalMatches
from shapespace.fit.residual import residual_modes
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.settings import Level, RobustSettings
from shapespace.fit.start import Start
from shapespace.fit.state import Fitted, IcpState
from shapespace.fit.weights import match_weights, spread, tails
from shapespace.geometry.closest import ClosestPoints
from shapespace.geometry.kdtree import KdTree
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Similarity

_DAMPING = 1e-7
_FIXED = 1e12
_MOTION_STRIDE = 7
_FEWEST_MATCHES = 30
_FLICKER = 10.0
_CLEARLY_BETTER = 0.95
_FARTHEST = 5.0
_IN_SPAN = 1e-9
"""What is left of a pose parameter outside the modes is rounding below this share."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Scan points matched to the moving surface, (M,) each; residuals and distances in mm of the model's frame."""

    triangle: IntArray
    barycentric: FloatArray
    residual: FloatArray
    distance: FloatArray
    allowed: BoolArray


class JointFit:
    """Pose and coefficients on their way, with the surface they make and its matches.

    Args:
        prepared: the model.
        target: the scan.
        settings: of the method.
        T_scan_model: the start, in the scan's mm frame.
        with_scale: False holds the scale of the start.
    """

    def __init__(
        self,
        prepared: PreparedModel,
        target: ScanTarget,
        settings: RobustSettings,
        T_scan_model: Similarity,
        *,
        with_scale: bool,
    ) -> None:
        self.prepared, self.target, self.settings, self.with_scale = prepared, target, settings, with_scale
        self.T, self.start_scale = T_scan_model, T_scan_model.scale
        self.stddev = np.array(prepared.model.stddev)
        self.b = np.zeros(len(self.stddev))
        self.surface = MovingSurface(prepared.topology, prepared.model.mean_vertices, prepared.modes)
        self.sigma_mm = self.width_mm = self.far_mm = self.rms_mm = self.motion_mm = float("inf")
        self.hessian = np.zeros((0, 0))
        self.seen_at = np.zeros(0)
        self.scan: Matches | None = None
        self.vertices: VertexMatches | None = None
        self._winding = 0.0
        self._asked = self._walks = self._triangles = np.zeros(0, dtype=np.int32)
        self._points_mm = self._normals = np.zeros((0, 3))
        self._tree: KdTree | None = None
        self._tree_fits = False
        self._engine = target.vertex_engine
        self._near: ClosestPoints | None = None

    def add_modes(self, modes: Float32Array, stddev: FloatArray) -> None:
        """Go on with `modes` (V, 3, K + R), the first K those it has, and the `stddev` (R,) mm of the others."""
        self.stddev = np.concatenate([self.stddev, stddev])
        self.b = np.concatenate([self.b, np.zeros(len(stddev))])
        self.surface = MovingSurface(self.prepared.topology, self.prepared.model.mean_vertices, modes)
        self.surface.deform(self.b)

    def begin(self, level: Level) -> None:
        """Draw the points that `level` matches, and say where to look for them first."""
        rng, target = np.random.default_rng(self.settings.seed), self.target
        points = target.draw(level.scan_points, rng)
        self._points_mm, self._normals = target.mesh.vertices[points], target.normals[points]
        self._asked = _some(self.surface.topology.used, level.vertices, rng)
        self._engine, self._near = target.engine if level.triangles else target.vertex_engine, None
        # The surface changes little from level to level, and what it does the walks make up for.
        if self._tree is None or (level.modes is None and not self._tree_fits):
            self._tree, self._tree_fits = self.surface.vertex_tree(), level.modes is None
        self._walks = self.surface.topology.used[self._tree.nearest(self._in_model()[0])[0]]
        self._triangles = np.full_like(self._walks, -1)

    def free_modes(self, level: Level) -> int:
        """Return how many modes are free on `level`."""
        return len(self.b) if level.modes is None else min(level.modes, len(self.b))

    def _in_model(self) -> tuple[FloatArray, FloatArray]:
        """Return the drawn points of the scan in the model's frame with their normals."""
        T = self.T
        return ((self._points_mm - T.translation) @ T.rotation) / T.scale, self._normals @ T.rotation

    def match(self) -> None:
        """Match scan points to the moving surface, and its vertices to the scan."""
        q, n = self._in_model()
        triangle = self._triangles
        weights = self.surface.walk(q, self._walks, triangle)
        residual, distance, cosine, covered = self.surface.meet(q, n, triangle, weights)
        if self._winding == 0.0:
            self._winding = winding_of(cosine, covered)
        agree = self._winding * cosine > self.settings.normal_cosine
        self.scan = Matches(triangle, weights, residual, distance, covered & agree)

        surface = self.surface
        self.vertices = match_vertices(
            self.target, self._engine, self.T, surface.vertices, surface.normals, self._asked, self._near,
            winding=self._winding, normal_cosine=self.settings.normal_cosine,
        )  # fmt: skip
        self._near, near = self.vertices.near, self.vertices.distance[self.vertices.allowed]
        self.rms_mm = float(np.sqrt((near**2).mean())) if len(near) else float("inf")

    def weigh(self) -> tuple[FloatArray, FloatArray]:
        """Return the weights of the matches of scan points and of vertices, by the spread of the residuals."""
        s, scan, vertices = self.settings, self.scan, self.vertices
        assert scan is not None and vertices is not None
        counted = np.concatenate([scan.residual[scan.allowed], vertices.residual[vertices.allowed]])
        if len(counted) < _FEWEST_MATCHES:
            raise FitError(
                f"{self.target.mesh.name}: hardly any of it matches the model from this start; give landmarks, or "
                "check that it shows what the model does."
            )
        self.sigma_mm = max(spread(counted), s.least_spread_mm)
        width = self.sigma_mm * min(s.wide, max(s.narrow, s.wide / tails(counted, self.sigma_mm) ** 2))
        far = s.reach * width + s.reach_mm
        self.width_mm, self.far_mm = width, far
        w = match_weights(s.weight, scan.residual, scan.distance, scan.allowed, width, far)
        v = match_weights(s.weight, vertices.residual, vertices.distance, vertices.allowed, width, far)
        fineness = min(1.0, len(self.target.mesh.vertices) / len(self.surface.vertices))
        return w, s.vertex_share * fineness**2 * v

    def step(self, modes: int) -> None:
        """Do one Gauss-Newton step on the pose and the first `modes` coefficients."""
        self.match()
        w, v = self.weigh()
        s, surface, scan, vertices = self.settings, self.surface, self.scan, self.vertices
        assert scan is not None and vertices is not None
        # Each vertex collects the weight and pull of the matches it carries; the Hessian is lumped there.
        seen_at, pull_at = np.zeros(len(surface.vertices)), np.zeros(len(surface.vertices))
        gather_into(scan.triangle, scan.barycentric, surface.topology.faces, w, scan.residual, seen_at, pull_at)
        self.seen_at = seen_at.copy()
        seen_at[vertices.vertex] += v
        pull_at[vertices.vertex] += v * vertices.residual

        rows, gradient = np.empty((len(seen_at), POSE + modes), dtype=np.float32), np.zeros(POSE + modes)
        count = rows_into(surface.vertices, surface.normals, surface.modes, modes, seen_at, pull_at, rows, gradient)
        hessian = np.asarray(rows[:count].T @ rows[:count], dtype=np.float64)
        rho = self.prior * self.sigma_mm**2
        precision = rho / self.stddev[:modes] ** 2
        index = np.arange(POSE, POSE + modes)
        hessian[index, index] += precision
        gradient[POSE:] += precision * self.b[:modes]
        if self.with_scale:
            hessian[6, 6] += rho / s.scale_stddev**2
            gradient[6] += rho / s.scale_stddev**2 * np.log(self.T.scale / self.start_scale)
        else:
            hessian[6, 6], gradient[6] = _FIXED * (hessian[6, 6] + 1.0), 0.0
        self.hessian = hessian
        self._take(-_solve(hessian, gradient, self.target.mesh.name), modes)

    @property
    def prior(self) -> float:
        """How many matches tell as much as one independent one."""
        return self.settings.prior if len(self.b) == self.prepared.model.n_modes else self.settings.beyond_prior

    def _take(self, delta: FloatArray, modes: int) -> None:
        T, x = self.T, self.surface.vertices
        before = T.apply(x[::_MOTION_STRIDE])
        turn = np.asarray(Rotation.from_rotvec(delta[:3]).as_matrix())
        self.T = Similarity(
            T.scale * float(np.exp(delta[6])), T.rotation @ turn, T.scale * (T.rotation @ delta[3:6]) + T.translation
        )
        if modes:
            self.b[:modes] += delta[POSE:]
            self.surface.deform(self.b)
        after = self.T.apply(self.surface.vertices[::_MOTION_STRIDE])
        self.motion_mm = float(np.linalg.norm(after - before, axis=1).max()) / T.scale

    def prefer(self, start: Start, level: Level) -> None:
        """Do `level` again from `start` with its coefficients, and go on from there if that matches clearly better."""
        free = self.free_modes(level)
        own, own_cost = (self.T, self.b.copy()), self.mismatch()
        b = np.zeros(len(self.b))
        b[: min(len(start.b), free)] = start.b[:free]
        self._place(start.T_scan_model, b)
        self.begin(level)
        for _ in range(level.iterations):
            self.step(free)
            if self.motion_mm < level.stop_motion_mm:
                break
        if self.mismatch() > _CLEARLY_BETTER * own_cost:
            self._place(*own)

    def _place(self, T: Similarity, b: FloatArray) -> None:
        self.T, self.b = T, b
        self.surface.deform(b)

    def mismatch(self) -> float:
        """Return the mean distance both ways, mm, of which none counts more than the reach."""
        self.match()
        scan, vertices, most = self.scan, self.vertices, _FARTHEST * self.settings.reach_mm
        assert scan is not None and vertices is not None
        return float(np.minimum(scan.distance, most).mean() + np.minimum(vertices.distance, most).mean())

    def state(self, phase: int, iteration: int, stopped: str | None = None) -> IcpState:
        """Return where the fit is."""
        b = self.b[: self.prepared.model.n_modes].copy()
        return IcpState(phase, iteration, self.T, b, self.rms_mm, self.motion_mm, stopped)

    def final_matches(self) -> FinalMatches:
        """Return what tells, later, which vertices followed the scan."""
        s, surface = self.settings, self.surface
        return FinalMatches(
            self.target, self.T, surface.vertices.copy(), surface.normals.copy(), self._winding, s.normal_cosine,
            s.weight, self.width_mm, self.far_mm,
        )  # fmt: skip

    def unexplained(self) -> float:
        """Return the variance, mm^2, of the part of the residuals that is no noise."""
        self.match()
        w, _ = self.weigh()
        scan, surface = self.scan, self.surface
        assert scan is not None
        return unexplained_variance(
            scan.triangle, scan.barycentric, surface.topology.faces, w, scan.residual, len(surface.vertices),
            self.settings.seed,
        )  # fmt: skip


def robust_icp(
    model: ShapeModel,
    target: ScanTarget,
    start: Start,
    settings: RobustSettings,
    *,
    with_scale: bool = True,
    modes: int | None = None,
    max_iterations: int = 500,
) -> Generator[IcpState, None, Fitted]:
    """Yield the start and each iteration, and return where they ended.

    Args:
        model: mean and modes, with triangles.
        target: the scan in its mm frame.
        start: where to begin; where it has coefficients, such as those of an open mouth, there is a second start with
            them, and the one of the two that matches better after the first modes goes on.
        settings: of the method.
        with_scale: False holds the scale of the start.
        modes: how many coefficients to report; None for all. The fit uses all in any case: modes left out of the fit
            bend those that stay.
        max_iterations: cap of each phase.

    Raises:
        InputError: the model has no triangles.
        FitError: hardly anything matches, or the fit diverged.
    """
    prepared = prepare(model)
    fit = JointFit(prepared, target, settings, start.T_scan_model, with_scale=with_scale)
    fit.begin(settings.levels[0])
    fit.match()
    left_mm2 = 0.0
    first = next(number for number, level in enumerate(settings.levels) if level.modes != 0)
    phase, iteration, state = 1, 0, fit.state(1, 0)
    for number, level in enumerate((*settings.levels, settings.beyond)):
        if number == len(settings.levels):
            left_mm2 = fit.unexplained()
            if left_mm2 < max(settings.beyond_share * fit.sigma_mm**2, settings.beyond_mm**2):
                break
            extra = residual_modes(model, settings.residual)
            fit.add_modes(extra.modes, extra.stddev)
        free = fit.free_modes(level)
        if free and phase == 1:
            yield replace(state, stopped=state.stopped or "rate")
            phase, iteration, state = 2, 0, fit.state(2, 0)
        fit.begin(level)
        for _ in range(level.iterations):
            if iteration >= max_iterations:
                state = replace(state, stopped="cap")
                break
            yield replace(state, stopped=None)
            fit.step(free)
            iteration += 1
            settled = fit.motion_mm < level.stop_motion_mm
            # Where parts of the scan match now one way and now another, the last bit of motion never ends.
            still = fit.motion_mm < _FLICKER * level.stop_motion_mm
            state = fit.state(phase, iteration, "rate" if still else "cap")
            if settled:
                break
        if number == first and len(start.b) and iteration < max_iterations:
            fit.prefer(start, level)
    yield state
    T, b = fit.T, fit.b
    if len(b) > model.n_modes:
        T, b = in_span(prepared, fit.surface.vertices, T, model.n_modes, with_scale=with_scale)
    # Modes that nobody asked for are no reason to doubt the fit, so the verdict is on all of them.
    known = posterior(fit, T, b, float(np.sqrt(max(left_mm2, 0.0))))
    wanted = model.n_modes if modes is None else min(modes, model.n_modes)
    if wanted < model.n_modes:
        T, b = in_span(prepared, fit.surface.vertices, fit.T, wanted, with_scale=with_scale)
    return Fitted(
        T_scan_model=T,
        b=b,
        b_stddev=known.b_stddev[:wanted],
        b_covariance=known.b_covariance[:wanted, :wanted],
        shrinkage=known.shrinkage[:wanted],
        vertices_scan_mm=fit.T.apply(fit.surface.vertices),
        rms_mm=fit.rms_mm,
        regions=fit.final_matches(),
        evidence=known.evidence,
    )


def in_span(
    prepared: PreparedModel, vertices: FloatArray, T_scan_model: Similarity, modes: int, *, with_scale: bool
) -> tuple[Similarity, FloatArray]:
    """Return pose and first `modes` coefficients of the model's surface nearest to `vertices`, in least squares.

    Args:
        prepared: the model.
        vertices: (V, 3) in the model's order, in its frame.
        T_scan_model: pose of that frame in the scan's; changed by what the modes left out would have done.
        modes: how many.
        with_scale: False keeps the scale.
    """
    model, free = prepared.model, POSE if with_scale else POSE - 1
    pose, inside = prepared.pose[:, :free], prepared.pose_in_span[:modes, :free]
    moved = (vertices - model.mean_vertices).ravel()
    # The modes are orthonormal, so they drop out of the normal equations and the pose is left.
    normal = pose.T @ pose - inside.T @ inside
    unit = 1.0 / np.linalg.norm(pose, axis=0)
    pull = pose.T @ moved - inside.T @ (model.vertex_basis[:, :modes].T @ moved)
    value, vector = np.linalg.eigh(normal * np.outer(unit, unit))
    kept = value > _IN_SPAN
    turn = unit * (vector[:, kept] @ ((vector[:, kept].T @ (unit * pull)) / value[kept]))
    small = Similarity(
        float(np.exp(turn[6])) if with_scale else 1.0, np.asarray(Rotation.from_rotvec(turn[:3]).as_matrix()), turn[3:6]
    )
    return T_scan_model @ small, model.project(small.inverse().apply(vertices), align=False)[:modes]


def _solve(hessian: FloatArray, gradient: FloatArray, name: str) -> FloatArray:
    """Solve the normal equations, scaled to a unit diagonal and hardly damped."""
    diagonal = np.sqrt(np.maximum(hessian.diagonal(), 1e-30))
    scaled = hessian / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += _DAMPING
    try:
        factor = cho_factor(scaled, lower=True, overwrite_a=True)
        return np.asarray(cho_solve(factor, gradient / diagonal)) / diagonal
    except (LinAlgError, ValueError) as error:
        raise FitError(
            f"{name}: the fit diverged; give landmarks, or crop the scan to what the model shows."
        ) from error


def _some(index: IntArray, count: int | None, rng: np.random.Generator) -> IntArray:
    return index if count is None or count >= len(index) else np.sort(rng.choice(index, count, replace=False))
