"""Phase 2 of the robust method: pose and shape together, from matches in both directions, with the prior.

One step minimises, over a small change of the pose and over the coefficients b, in the model's frame,

    sum_i w_i r_i^2 / sigma^2  +  alpha (sum_k b_k^2 / lam_k  +  log(s / s_0)^2 / sd_s^2)                   (R14a)

where r_i is the distance of the model from a match along the model's own normal (Chen and Medioni, 1992), and alpha is
the weight of the prior relative to one match. Matches go both ways: each scan point to the closest
point of the moving surface, and each model vertex to the closest point of the scan. Matches on a border, with normals
that disagree, or with residuals large for their spread count little or nothing (Zhang, Yao and Deng, PAMI 2022). The
second term is the prior (Blanz et al., 2004); the third constrains a scale that the scan hardly determines. Few modes
are free at first and all at the end; if the scan then shows a shape outside the model, the modes of `residual` are
added, so that the variation outside the model does not distort its own coefficients. docs/robust.md derives it and
numbers the equations.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np
from scipy.linalg import LinAlgError

from shapespace.errors import FitError
from shapespace.fit.dense.residual_modes import residual_modes
from shapespace.fit.diagnostics.failure_model import MatchEvidence
from shapespace.fit.iteration_state import BORDER, FOLLOWED, REJECTED, UNSEEN, IcpState, RobustFitted
from shapespace.fit.robust.matching import (
    Gathered,
    Matcher,
    Matches,
    MatchHint,
    Weights,
    match_vertices,
    match_weights,
    spread,
    tails,
)
from shapespace.fit.robust.posterior import (
    Estimate,
    NormalEquations,
    Posterior,
    Prior,
    covariance_of_landmarks,
    lack_of_new_shapes,
    normal_equations,
    posterior,
    variance_of_new_shapes,
)
from shapespace.fit.robust.prepared_model import (
    LandmarkConstraint,
    LinearShape,
    ModelSurface,
    PreparedModel,
    prepare,
    worth,
)
from shapespace.fit.robust.robust_settings import Level, RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.geometry.closest import on_boundary
from shapespace.geometry.contact import find_overlaps, find_penetrations
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import POSE, small_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

_MOTION_STRIDE = 7  # every seventh vertex measures the motion of an iteration, at a seventh of the cost
_FEWEST_MATCHES = 30  # matches; fewer cannot estimate pose and leading modes robustly
_FLICKER = 10.0  # multiple of the stop motion below which matches only alternate between neighbours
_CLEARLY_BETTER = 0.95  # ratio of mismatches for which an alternative replaces the current pose
_FARTHEST = 5.0  # multiple of the reach beyond which points are not matched
_HALF, _LEADING, _NEAR = 0.5, 10, 0.05
"""Weight above which a match counts, number of leading modes, and share of the model's size that counts as near."""
_STIFF, _TOUCH = 100.0, 1e-9
"""Weight of a vertex inside another part, in units of a match: 1.5 mm become 0.04 mm or less (10: 0.4 mm); and the
smallest depth, mm, that has a direction."""
_LACK_LEFT = 0.5
"""Share of the variance outside the model that is added, so that landmarks lie within their standard deviations
(docs/landmarks.md)."""


@dataclass(frozen=True, eq=False)
class Iterate:
    """Current state of the fit.

    Args:
        estimate: pose and coefficients.
        surface: surface of the model with these coefficients (R1).
    """

    estimate: Estimate
    surface: ModelSurface

    @property
    def T_scan_model(self) -> Similarity:
        """Similarity from the model's frame to the scan's mm frame."""
        return self.estimate.T_scan_model

    @property
    def b(self) -> FloatArray:
        """(K,) coefficients, mm."""
        return self.estimate.b


@dataclass(frozen=True, eq=False)
class WeightedMatches:
    """Matches of an iterate with their weights.

    Args:
        matches: matches in both directions.
        weights: weights of the matches.
        sigma_mm: spread of their residuals, mm of the model's frame.
    """

    matches: Matches
    weights: Weights
    sigma_mm: float

    @property
    def rms_mm(self) -> float:
        """RMS closest distance of the sampled vertices of the model, mm of the scan."""
        return float(np.sqrt((self.matches.vertices.near.distance**2).mean()))


@dataclass(frozen=True, eq=False)
class Step:
    """One Gauss-Newton step.

    Args:
        weighted: the matches that the step used.
        iterate: iterate after the step.
        motion_mm: largest movement of a vertex, mm of the model's frame.
    """

    weighted: WeightedMatches
    iterate: Iterate
    motion_mm: float


@dataclass(frozen=True, eq=False)
class Problem:
    """The constants of the fit.

    Args:
        prepared: the model.
        target: the scan.
        settings: settings of the method.
        prior: prior of pose and shape.
        shape: shape model that computes surfaces from coefficients.
        marks: landmarks, if any.
        no_contact: whether parts must not lie inside each other.
    """

    prepared: PreparedModel
    target: ScanTarget
    settings: RobustSettings
    prior: Prior
    shape: LinearShape
    marks: LandmarkConstraint | None = None
    no_contact: bool = False

    @staticmethod
    def of(
        prepared: PreparedModel, target: ScanTarget, settings: RobustSettings, start_scale: float, *, with_scale: bool,
        marks: LandmarkConstraint | None = None,
    ) -> Problem:  # fmt: skip
        """Return the problem with the model's own modes."""
        prior = Prior(prepared.model.stddev, settings.prior, start_scale, settings.scale_stddev if with_scale else 0.0)
        return Problem(prepared, target, settings, prior, LinearShape.of(prepared), marks)

    def with_residual_modes(self) -> Problem:
        """Return the problem with the residual modes as well, with the weight `beyond_prior`."""
        prepared, s = self.prepared, self.settings
        extra = residual_modes(prepared.model, s.residual)
        prior = replace(self.prior, stddev=np.concatenate([self.prior.stddev, extra.stddev]), weight=s.beyond_prior)
        return replace(self, prior=prior, shape=replace(self.shape, modes=extra.modes))

    def iterate(self, estimate: Estimate) -> Iterate:
        """Return the iterate with this pose and these coefficients (R1)."""
        return Iterate(estimate, self.shape.surface(estimate.b))

    def matcher(self, level: Level) -> Matcher:
        """Return the matcher of the points and vertices that `level` samples."""
        s, target, rng = self.settings, self.target, np.random.default_rng(self.settings.seed)
        points = target.draw(level.scan_points, rng)
        vertex = _sample_indices(self.prepared.topology.used, level.vertices, rng)
        engine = target.engine if level.triangles else target.vertex_engine
        return Matcher.of(target=target, points=points, vertex=vertex, engine=engine, normal_cosine=s.normal_cosine)

    def match(self, matcher: Matcher, iterate: Iterate, hint: MatchHint) -> WeightedMatches:
        """Return the matches of an iterate with their weights (R4-R9).

        Raises:
            FitError: hardly any point matches.
        """
        return self.weigh(matcher.match(iterate.surface, iterate.T_scan_model, hint))

    def weigh(self, matches: Matches) -> WeightedMatches:
        """Return the matches with their weights (R7-R9).

        Raises:
            FitError: hardly any point matches.
        """
        s = self.settings
        residual = matches.residuals()
        if len(residual) < _FEWEST_MATCHES:
            raise FitError(
                f"{self.target.mesh.name}: hardly any of it matches the model from this start; give landmarks "
                "(--landmarks), or check that it shows the object of the model."
            )
        sigma_mm = max(spread(residual), s.least_spread_mm)  # R6a
        width_mm = sigma_mm * min(s.wide, max(s.narrow, s.wide / tails(residual, sigma_mm) ** 2))  # R7
        fineness = min(1.0, len(self.target.mesh.vertices) / len(self.shape.mean))
        weights = matches.weights(
            s.weight, width_mm, s.reach * width_mm + s.reach_mm, s.vertex_share * fineness**2
        )  # R8, R9
        return WeightedMatches(matches, weights, sigma_mm)

    def equations(self, weighted: WeightedMatches, iterate: Iterate, modes: int) -> tuple[Gathered, NormalEquations]:
        """Return the matches gathered on the vertices, and the normal equations of a step (R10-R14)."""
        surface = iterate.surface
        gathered = weighted.matches.gathered(weighted.weights, self.prepared.topology.faces, len(surface.vertices))
        equations = normal_equations(surface, gathered, self.prior, weighted.sigma_mm, iterate.estimate, modes)
        if self.marks is None:
            return gathered, equations
        hessian, gradient = self.marks.equations(surface, iterate.T_scan_model, modes)
        weights = weighted.weights
        gain = weighted.sigma_mm**2 * worth(float(weights.points.sum() + weights.vertices.sum()))  # R16d
        return gathered, replace(equations, gradient=equations.gradient + gain * gradient, H_landmarks=gain * hessian)

    def contact_equations(self, surface: ModelSurface, equations: NormalEquations) -> NormalEquations:
        """Return the equations with the penalty of vertices inside other parts: their squared depths (S11)."""
        H, gradient = equations.H.copy(), equations.gradient.copy()
        modes = surface.modes[:, :, : len(gradient) - POSE]
        parts = self.prepared.model.vertices_of_parts
        for _, _, vertex, corners, near in find_overlaps(Mesh(surface.vertices, surface.topology.faces), parts):
            outwards = (near.points - surface.vertices[vertex]) / np.maximum(near.distance, _TOUCH)[:, None]
            moved = modes[vertex] - np.einsum("mc,mcdk->mdk", np.asarray(near.barycentric), modes[corners])
            rows = np.einsum("md,mdk->mk", outwards, moved)
            H[POSE:, POSE:] += _STIFF * rows.T @ rows
            gradient[POSE:] -= _STIFF * rows.T @ near.distance
        return replace(equations, H=H, gradient=gradient)

    def step(self, matcher: Matcher, iterate: Iterate, hint: MatchHint, modes: int) -> Step:
        """Return one Gauss-Newton step on the pose and the first `modes` coefficients.

        Raises:
            FitError: hardly any point matches, or the fit diverged.
        """
        weighted = self.match(matcher, iterate, hint)  # R4-R9
        _, equations = self.equations(weighted, iterate, modes)  # R10-R14
        equations = self.contact_equations(iterate.surface, equations) if self.no_contact else equations
        try:
            delta = equations.step()  # R15
        except LinAlgError as error:
            raise FitError(
                f"{self.target.mesh.name}: the fit diverged; give landmarks (--landmarks), or crop the scan to "
                "the part that the model contains (--crop)."
            ) from error
        estimate = iterate.estimate.moved_by(delta)  # R16
        # Without free modes the shape stays unchanged.
        following = self.iterate(estimate) if modes else replace(iterate, estimate=estimate)
        some = slice(None, None, _MOTION_STRIDE)
        before = iterate.T_scan_model.apply(iterate.surface.vertices[some])
        moved = estimate.T_scan_model.apply(following.surface.vertices[some]) - before
        motion_mm = float(np.linalg.norm(moved, axis=1).max()) / estimate.T_scan_model.scale  # R16e
        return Step(weighted, following, motion_mm)

    def descent(self, matcher: Matcher, iterate: Iterate, hint: MatchHint, level: Level) -> Generator[Step]:
        """Yield steps with the modes that are free on `level`, until the motion is below its limit.

        Raises:
            FitError: hardly any point matches, or the fit diverged.
        """
        modes = level.free(len(iterate.b))
        for _ in range(level.iterations):
            step = self.step(matcher, iterate, hint, modes)
            iterate, hint = step.iterate, step.weighted.matches.hint
            yield step
            if step.motion_mm < level.stop_motion_mm:
                return

    def unexplained_variance(self, weighted: WeightedMatches) -> float:
        """Return the variance, mm^2, of the part of the residuals that is not noise (R17)."""
        return weighted.matches.unexplained_variance(
            weighted.weights, self.prepared.topology.faces, len(self.shape.mean), self.settings.seed
        )

    def in_model(self, iterate: Iterate, surface_mm: float, modes: int) -> Estimate:
        """Return the pose and the first `modes` of the model's own coefficients of an iterate (R18, R19).

        Args:
            iterate: iterate of the fit, with residual modes or without.
            surface_mm: uncertainty of its surface, RMS over the vertices, mm of the model's frame.
            modes: number of coefficients.
        """
        own = self.prepared.model.n_modes
        if len(iterate.b) == modes == own:
            return iterate.estimate
        return in_span(
            self.prepared, iterate.surface.vertices, iterate.estimate,
            np.sqrt(variance_of_new_shapes(self.prepared.model)), surface_mm, modes,
            with_scale=not self.prior.holds_scale,
        )  # fmt: skip

    def mismatch_mm(self, matches: Matches) -> float:
        """Return the mean distance in both directions, mm, each distance capped at the reach."""
        most = _FARTHEST * self.settings.reach_mm
        return sum(float(np.minimum(way.distance, most).mean()) for way in (matches.points, matches.vertices))


@dataclass(frozen=True, eq=False)
class LevelState:
    """State after the iterations of some levels.

    Args:
        iterate: the last iterate.
        state: state of the last iterate, which is not yielded yet.
        matcher: matcher of the last level.
        hint: hint for the next search of the matcher.
    """

    iterate: Iterate
    state: IcpState
    matcher: Matcher
    hint: MatchHint


def robust_icp(
    model: ShapeModel,
    target: ScanTarget,
    start: Start,
    settings: RobustSettings,
    *,
    with_scale: bool = True,
    modes: int | None = None,
    max_iterations: int = 500,
) -> Generator[IcpState, None, RobustFitted]:
    """Yield the states of the robust fit: phase 1 with the pose alone, phase 2 with pose and shape together.

    Args:
        model: the shape model, with triangles.
        target: the scan.
        start: a pose of the mean near the scan, and coefficients if it has any.
        settings: settings of the method.
        with_scale: whether the scale is free; False fixes the scale of the start.
        modes: number of coefficients to report; None for all. The fit uses all modes in any case: modes that are
            excluded from a fit distort the others.
        max_iterations: cap of each phase.

    Raises:
        InputError: the model has no triangles.
        FitError: hardly any point matches, or the fit diverged.
    """
    scale = start.T_scan_model.scale
    problem = Problem.of(prepare(model), target, settings, scale, with_scale=with_scale, marks=start.marks)
    # The pose of all parts together depends on their relative poses.
    b = start.b if start.how == "parts" else np.zeros(model.n_modes)
    iterate = problem.iterate(Estimate(start.T_scan_model, b))
    matcher = problem.matcher(settings.levels[0])
    first = problem.match(
        matcher, iterate, matcher.first_hint(iterate.surface, iterate.T_scan_model, problem.prepared.tree)
    )
    state = IcpState(1, 0, iterate.T_scan_model, iterate.b, first.rms_mm, float("inf"))
    progress = LevelState(iterate, state, matcher, first.matches.hint)
    progress, tree = yield from _coarse_to_fine(problem, progress, start, max_iterations)
    weighted = problem.match(progress.matcher, progress.iterate, progress.hint)
    unexplained_mm2 = problem.unexplained_variance(weighted)  # R17
    least_mm2 = max(settings.beyond_share * weighted.sigma_mm**2, settings.beyond_mm**2)  # R17a
    if unexplained_mm2 >= least_mm2 and progress.state.iteration < max_iterations:
        problem = problem.with_residual_modes()
        progress = yield from _extend_with_residual_modes(problem, progress, tree, max_iterations)
        weighted = problem.match(progress.matcher, progress.iterate, progress.hint)
    notes: tuple[str, ...] = ()
    if settings.no_contact and (before_mm := depth_mm(problem, progress.iterate)) > 0.0:
        problem, level = replace(problem, no_contact=True), settings.levels[-1]
        steps = problem.descent(progress.matcher, progress.iterate, progress.hint, level)
        progress = yield from _yield_states(steps, progress, level, max_iterations)
        weighted = problem.match(progress.matcher, progress.iterate, progress.hint)
        notes = (
            f"Parts lay inside each other by up to {before_mm:.2f} mm, and by up to "
            f"{depth_mm(problem, progress.iterate):.2f} mm after contact was forbidden.",
        )
    yield progress.state
    fitted = _summarise(problem, progress.iterate, weighted, unexplained_mm2, modes)
    return replace(fitted, notes=(*fitted.notes, *notes))


def depth_mm(problem: Problem, iterate: Iterate) -> float:
    """Return the largest depth of a vertex of one part inside another, mm of the scan; 0 without such vertices."""
    surface = Mesh(iterate.surface.vertices, iterate.surface.topology.faces)
    found = find_penetrations(surface, problem.prepared.model.vertices_of_parts)
    return iterate.T_scan_model.scale * max((penetration.depth_mm for penetration in found), default=0.0)


def _coarse_to_fine(
    problem: Problem, progress: LevelState, start: Start, max_iterations: int
) -> Generator[IcpState, None, tuple[LevelState, KdTree]]:
    """Fit on all levels with the model's modes; return the end, and a tree of the vertices for hints."""
    prepared, levels, winding = problem.prepared, problem.settings.levels, progress.hint.winding
    tree, tree_fits, sample = prepared.tree, False, levels[0].sample
    for level in levels:
        begins = level.modes != 0 and progress.state.phase == 1
        if begins:
            yield replace(progress.state, stopped=progress.state.stopped or "rate")
            progress = replace(progress, state=replace(progress.state, phase=2, iteration=0, stopped=None))
        iterate = progress.iterate
        # The surface changes little from level to level; the walks correct for the change.
        if level.modes is None and not tree_fits:
            tree, tree_fits = tree.moved(iterate.surface.vertices[prepared.topology.used]), True
        same = level.sample == sample
        matcher, sample = progress.matcher if same else problem.matcher(level), level.sample
        hint = matcher.first_hint(iterate.surface, iterate.T_scan_model, tree, winding)
        hint = replace(hint, near=progress.hint.near) if same else hint
        steps = problem.descent(matcher, iterate, hint, level)
        progress = yield from _yield_states(steps, replace(progress, matcher=matcher, hint=hint), level, max_iterations)
        if begins and len(start.b) and progress.state.iteration < max_iterations:
            progress = replace(progress, iterate=_choose_iterate(problem, progress, start, level, tree))
    return progress, tree


def _choose_iterate(problem: Problem, progress: LevelState, start: Start, level: Level, tree: KdTree) -> Iterate:
    """Return the end of `level` from `start` if it matches clearly better than the iterate, else the iterate."""

    def mismatch_mm(iterate: Iterate, matcher: Matcher, hint: MatchHint) -> float:
        return problem.mismatch_mm(matcher.match(iterate.surface, iterate.T_scan_model, hint))

    limit_mm = _CLEARLY_BETTER * mismatch_mm(progress.iterate, progress.matcher, progress.hint)
    free, b = level.free(len(progress.iterate.b)), np.zeros(len(progress.iterate.b))
    b[: min(len(start.b), free)] = start.b[:free]
    other, matcher = problem.iterate(Estimate(start.T_scan_model, b)), progress.matcher
    hint = matcher.first_hint(other.surface, other.T_scan_model, tree)
    for step in problem.descent(matcher, other, hint, level):
        other, hint = step.iterate, step.weighted.matches.hint
    return other if mismatch_mm(other, matcher, hint) <= limit_mm else progress.iterate


def _extend_with_residual_modes(
    problem: Problem, progress: LevelState, tree: KdTree, max_iterations: int
) -> Generator[IcpState, None, LevelState]:
    """Continue with the residual modes of `problem`, whose coefficients begin at zero."""
    level, own = problem.settings.beyond, progress.iterate.b
    b = np.pad(own, (0, len(problem.prior.stddev) - len(own)))
    iterate, matcher = problem.iterate(Estimate(progress.iterate.T_scan_model, b)), problem.matcher(level)
    hint = matcher.first_hint(iterate.surface, iterate.T_scan_model, tree, progress.hint.winding)
    steps = problem.descent(matcher, iterate, hint, level)
    return (yield from _yield_states(steps, LevelState(iterate, progress.state, matcher, hint), level, max_iterations))


def _summarise(
    problem: Problem, iterate: Iterate, weighted: WeightedMatches, unexplained_mm2: float, modes: int | None
) -> RobustFitted:
    """Return the result: coefficients of the model, their covariance, regions and evidence.

    Args:
        problem: problem of the fit.
        iterate: the last iterate.
        weighted: weighted matches of the last iterate.
        unexplained_mm2: variance of the residuals that is not noise, before residual modes were added (R17).
        modes: number of coefficients to report; None for all.
    """
    model, target, settings = problem.prepared.model, problem.target, problem.settings
    gathered, equations = problem.equations(weighted, iterate, len(iterate.b))
    surface, vertices, T = iterate.surface, weighted.matches.vertices, iterate.T_scan_model
    beyond_mm = float(np.sqrt(max(unexplained_mm2, 0.0)))
    try:
        known = posterior(
            model, surface, problem.prior, equations, weighted.weights, weighted.sigma_mm,
            beyond_model_mm=beyond_mm, allowed_share=float(vertices.allowed.mean()),
        )  # fmt: skip
    except LinAlgError as error:
        raise FitError(
            f"{target.mesh.name}: the matches do not determine the pose; check the scan's unit (--unit), or give "
            "landmarks (--landmarks)."
        ) from error
    # Modes that are not reported are no reason to doubt the fit, so the verdict uses all modes.
    all_regions = reported = problem.in_model(iterate, known.surface_mm, model.n_modes)
    wanted = model.n_modes if modes is None else min(modes, model.n_modes)
    if wanted < model.n_modes:
        reported = problem.in_model(iterate, known.surface_mm, wanted)
    in_model = (T.inverse() @ all_regions.T_scan_model).apply(model.reconstruct(all_regions.b))
    left_out_mm2 = float(((surface.vertices - in_model) ** 2).sum(axis=1).mean())  # R22, second term
    return RobustFitted(
        T_scan_model=reported.T_scan_model,
        b=reported.b,
        b_stddev=known.b_stddev(wanted),
        b_covariance=known.b_covariance(wanted),
        shrinkage=known.shrinkage(wanted),
        T_scan_fitted=T,
        vertices_scan_mm=T.apply(surface.vertices),
        outside_mm=T.scale * float(np.linalg.norm(iterate.b[wanted:]) / np.sqrt(len(surface.vertices))),
        regions=partial(
            final_regions,
            target=target,
            T_scan_model=T,
            surface=ModelSurface.of(surface.topology, surface.vertices),
            winding=weighted.matches.winding,
            normal_cosine=settings.normal_cosine,
            weight=settings.weight,
            width_mm=weighted.weights.width_mm,
            far_mm=weighted.weights.far_mm,
        ),
        match_evidence=MatchEvidence(
            **_match_shares(weighted, gathered, iterate, model, known.prior_variance[: model.n_modes]),
            beyond_model_mm=T.scale * beyond_mm,
            left_out_mm=T.scale * float(np.sqrt(left_out_mm2)),
            model_spread_mm=T.scale * float(np.sqrt((model.stddev**2).sum() / model.n_vertices)),
            model_lack_mm=T.scale * lack_of_new_shapes(model),
            **_landmark_evidence(problem, iterate),
            posterior_error_mm=T.scale * float(np.hypot(known.surface_mm, np.sqrt(left_out_mm2))),
        ),
        notes=() if problem.marks is None else problem.marks.notes(surface, T),
        landmark_covariance=_landmark_covariance(model, known, surface, T),
    )  # fmt: skip


def _landmark_evidence(problem: Problem, iterate: Iterate) -> dict[str, float]:
    """Return the standard deviation of the given landmarks, and their RMS distance from the fit, mm of the scan."""
    if problem.marks is None:
        return {}
    off_mm = problem.marks.off_mm(iterate.surface, iterate.T_scan_model)
    return {"marks_stddev_mm": problem.marks.stddev_mm, "marks_rms_mm": float(np.sqrt((off_mm**2).mean()))}


def _landmark_covariance(model: ShapeModel, known: Posterior, surface: ModelSurface, T: Similarity) -> FloatArray:
    """Return the covariance (L, 3, 3) of the model's landmarks in the target frame of `T`, mm^2."""
    covariance = covariance_of_landmarks(known, surface, model.landmarks)
    # No mode represents the displacement of a landmark outside the model, about half of which the scan shows.
    covariance += np.eye(3) * _LACK_LEFT * lack_of_new_shapes(model) ** 2 / 3.0
    return T.scale**2 * T.rotation @ covariance @ T.rotation.T


def _match_shares(
    weighted: WeightedMatches, gathered: Gathered, iterate: Iterate, model: ShapeModel, variance: FloatArray
) -> dict[str, float]:
    """Return the shares of model and scan that match, and the plausibility of pose and shape.

    Args:
        weighted: matches of the last iterate.
        gathered: the matches gathered on the vertices.
        iterate: the last iterate.
        model: the shape model.
        variance: (K,) variances of the coefficients of new shapes, mm^2.
    """
    points, vertices, v = weighted.matches.points, weighted.matches.vertices, weighted.weights.vertices
    size_mm, z2 = rms_size(model.mean_vertices), iterate.b[: model.n_modes] ** 2 / variance
    scale = iterate.T_scan_model.scale
    return {
        "size_mm": scale * size_mm,
        "seen_share": float(gathered.seen.mean()),
        "model_matched_share": float((v > _HALF * v.max()).mean()),
        "model_allowed_share": float(vertices.allowed.mean()),
        "scan_allowed_share": float(points.allowed.mean()),
        "scan_near_share": float((points.distance < _NEAR * size_mm).mean()),
        "model_near_share": float((vertices.distance < _NEAR * size_mm).mean()),
        "z2": float(z2.mean()),
        "z2_leading": float(z2[:_LEADING].mean()),
        "log_scale": float(np.log(scale)),
        "spread_mm": scale * weighted.sigma_mm,
    }


def _yield_states(
    steps: Iterator[Step], progress: LevelState, level: Level, max_iterations: int
) -> Generator[IcpState, None, LevelState]:
    """Yield each state when the next one is computed; return the end of the steps, with the last state."""
    state = progress.state
    left = max_iterations - state.iteration
    for step in islice(steps, left):
        yield replace(state, stopped=None)
        T, b = step.iterate.T_scan_model, step.iterate.b[: len(state.b)].copy()
        # If parts of the scan alternate between two matches, a small motion never ends.
        still = step.motion_mm < _FLICKER * level.stop_motion_mm
        stopped = "rate" if still else "cap"
        state = IcpState(
            phase=state.phase,
            iteration=state.iteration + 1,
            T_scan_model=T,
            b=b,
            rms_mm=step.weighted.rms_mm,
            motion_mm=step.motion_mm * T.scale,
            stopped=stopped,
        )
        progress = replace(progress, iterate=step.iterate, hint=step.weighted.matches.hint)
    return replace(progress, state=state if left > 0 else replace(state, stopped="cap"))


def _sample_indices(index: IntArray, count: int | None, rng: np.random.Generator) -> IntArray:
    return index if count is None or count >= len(index) else np.sort(rng.choice(index, count, replace=False))


# Region of each vertex of the model at the end of a robust fit, computed on demand

_COUNTS = 0.5
"""Weight of a match below which it counts as rejected."""
_SPACINGS = 4.0
"""Number of spacings of a point cloud from which on a sideways distance is a hole; half a spacing is usual."""
_FINEST = 0.01
"""Share of the model's size; the model follows points nearer than this, however exact the rest is."""


def final_regions(
    *, target: ScanTarget, T_scan_model: Similarity, surface: ModelSurface, winding: float, normal_cosine: float,
    weight: str, width_mm: float, far_mm: float,
) -> IntArray:  # fmt: skip
    """Return the code (V,) of the region of each vertex at the end of a robust fit.

    Args:
        target: the scan.
        T_scan_model: the final pose, in the scan's mm frame.
        surface: final surface, in the model's frame.
        winding: -1 if the scan's normals are reversed, else 1.
        normal_cosine: cosine of the largest angle between the normals of a match that counts.
        weight: name of the weight.
        width_mm: scale of the residuals at the end.
        far_mm: scale of the distances at the end.
    """
    every = np.arange(len(surface.vertices), dtype=np.int32)
    matches = match_vertices(
        target=target,
        engine=target.engine,
        T_scan_model=T_scan_model,
        surface=surface,
        vertex=every,
        near=None,
        winding=winding,
        normal_cosine=normal_cosine,
    )
    w = match_weights(weight, matches.residual, np.zeros(len(every)), matches.allowed, width_mm, far_mm)
    near_mm = max(width_mm, _FINEST * rms_size(surface.vertices))
    sideways = np.sqrt(np.maximum(matches.distance**2 - matches.residual**2, 0.0))
    counted = (w > _COUNTS) | (matches.allowed & (np.abs(matches.residual) < near_mm))
    regions = np.where(counted, FOLLOWED, REJECTED)
    # A nearest point of the scan off to the side shows that the scan has a hole at the vertex.
    regions[sideways > max(far_mm, _SPACINGS * float(np.median(sideways)))] = UNSEEN
    at_rim = on_boundary(matches.near, target.mesh, target.rim)
    regions[at_rim] = np.where(sideways[at_rim] > near_mm, UNSEEN, BORDER)
    return regions.astype(np.int32)


# Projection of a fitted surface onto the span of the model


def in_span(
    prepared: PreparedModel,
    vertices: FloatArray,
    estimate: Estimate,
    prior_stddev: FloatArray,
    uncertainty_mm: float,
    modes: int,
    *,
    with_scale: bool,
) -> Estimate:
    """Return the likeliest pose and first `modes` coefficients given the surface `vertices` (R18, R19).

    Ordinary least squares would assign large coefficients to weak modes, and to modes close to motions of the pose, for
    a negligible gain; the prior keeps them plausible.

    Args:
        prepared: the model.
        vertices: (V, 3) vertices in the model's order and frame.
        estimate: pose of that frame in the scan's mm frame, which is corrected for the effect of the excluded modes.
        prior_stddev: (K,) standard deviations of the coefficients in the prior, mm.
        uncertainty_mm: uncertainty of the surface, RMS over its vertices, mm of the model's frame.
        modes: number of modes.
        with_scale: whether the scale is free; False keeps the scale.
    """
    if not prepared.model.is_linear:
        b, pose = prepared.model.nearest_in_any_pose(
            vertices, with_scale=with_scale, noise=uncertainty_mm**2 / 3.0, stddev=prior_stddev[:modes]
        )
        return Estimate(estimate.T_scan_model @ pose, b)
    P, free = prepared.model.vertex_basis[:, :modes], POSE if with_scale else POSE - 1
    pose, inside = prepared.pose[:, :free], prepared.pose_in_span[:modes, :free]
    noise = uncertainty_mm**2 / 3.0
    kept_share = prior_stddev[:modes] ** 2 / (prior_stddev[:modes] ** 2 + noise)
    y = (vertices - prepared.model.mean_vertices).ravel()
    b = P.T @ y
    # The part outside the span may have moved the pose about as far as the size of this part, and hardly further.
    residual_energy = max(float(y @ y - b @ b), 0.0) + len(y) * noise
    unit = 1.0 / np.linalg.norm(pose, axis=0)
    normal = (pose.T @ pose - (inside.T * kept_share) @ inside) * np.outer(unit, unit)
    normal[np.diag_indices(free)] += noise / residual_energy
    delta = np.zeros(POSE)
    delta[:free] = unit * np.linalg.solve(normal, unit * (pose.T @ y - inside.T @ (kept_share * b)))  # R18
    small = small_similarity(delta)
    y = (small.inverse().apply(vertices) - prepared.model.mean_vertices).ravel()
    return Estimate(estimate.T_scan_model @ small, kept_share * (P.T @ y))  # R19
