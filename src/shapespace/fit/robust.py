"""Phase 2 as we would do it: pose and shape at once, from both directions, robustly, with the prior.

One step minimises, over a small change of the pose and over the coefficients b, in the model's frame,

    sum_i w_i r_i^2 / sigma^2  +  prior (sum_k b_k^2 / lam_k  +  log(s / s_0)^2 / sd_s^2)

where r_i is how far the model lies from a match along the model's own normal (Chen and Medioni, 1992), and `prior` is
the weight of what is known beforehand beside that of one match. Matches go both ways: each scan point to the closest
point of the moving surface, and each model vertex to the closest point of the scan. Those on a border, with normals
that disagree, or far off for the spread of the rest count little or nothing (Zhang, Yao and Deng, PAMI 2022). The
second term is the prior (Blanz et al., 2004); the third keeps a scale that the scan hardly shows. Few modes are free
at first and all in the end; where the scan then shows a shape that the model cannot make, the modes of `residual`
join in, so that what the model lacks does not bend what it has. docs/robust.md derives it; equation numbers are those
of that page.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy.linalg import LinAlgError

from shapespace.errors import FitError
from shapespace.fit.equations import Estimate, NormalEquations, Prior, normal_equations
from shapespace.fit.final_matches import FinalMatches
from shapespace.fit.marks import Marks, worth
from shapespace.fit.matching import Gathered, Matcher, Matches, Weights
from shapespace.fit.moving_model import MovingSurface, PreparedModel, prepare
from shapespace.fit.posterior import Posterior, covariance_of_landmarks, lack_of_new_shapes, new_shapes, posterior
from shapespace.fit.residual import residual_modes
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.settings import Level, RobustSettings
from shapespace.fit.span import in_span
from shapespace.fit.start import Start
from shapespace.fit.state import Fitted, IcpState
from shapespace.fit.weights import spread, tails
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.surface import rms_size
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Similarity

_MOTION_STRIDE = 7
_FEWEST_MATCHES = 30
_FLICKER = 10.0
_CLEARLY_BETTER = 0.95
_FARTHEST = 5.0
_HALF, _LEADING, _NEAR = 0.5, 10, 0.05
"""A match counts at half weight; so many modes lead; near is this share of the model's size."""
_LACK_LEFT = 0.5
"""Of the variance outside the model, so that landmarks lie within their standard deviations (docs/landmarks.md)."""


@dataclass(frozen=True, eq=False)
class WeightedMatches:
    """What the fit sees where it is.

    Args:
        matches: both ways.
        weights: of those.
        sigma_mm: spread of their residuals.
    """

    matches: Matches
    weights: Weights
    sigma_mm: float

    @property
    def rms_mm(self) -> float:
        """RMS closest distance of the model's vertices that were looked at, mm of the model's frame."""
        return float(np.sqrt((self.matches.vertices.distance**2).mean()))


@dataclass(frozen=True, eq=False)
class Step:
    """One Gauss-Newton step.

    Args:
        look: what it went by.
        at: where it led.
        motion_mm: largest movement of a vertex, mm of the model's frame.
    """

    look: WeightedMatches
    at: Estimate
    motion_mm: float


@dataclass(frozen=True, eq=False)
class Problem:
    """What stays the same from step to step.

    Args:
        prepared: the model.
        target: the scan.
        settings: of the method.
        prior: of pose and shape.
        surface: the model's surface, which moves.
        marks: landmarks that it is held to, if any.
    """

    prepared: PreparedModel
    target: ScanTarget
    settings: RobustSettings
    prior: Prior
    surface: MovingSurface
    marks: Marks | None = None

    @staticmethod
    def of(
        prepared: PreparedModel, target: ScanTarget, settings: RobustSettings, start_scale: float, *, with_scale: bool,
        marks: Marks | None = None,
    ) -> Problem:  # fmt: skip
        """Return the problem with the model's own modes."""
        prior = Prior(prepared.model.stddev, settings.prior, start_scale, settings.scale_stddev if with_scale else 0.0)
        surface = MovingSurface(prepared.topology, prepared.model.mean_vertices, prepared.modes)
        return Problem(prepared, target, settings, prior, surface, marks)

    def with_modes_beside(self) -> Problem:
        """Return the problem with the modes that the model lacks, weighed as `beyond_prior` says."""
        prepared, s = self.prepared, self.settings
        extra = residual_modes(prepared.model, s.residual)
        prior = replace(self.prior, stddev=np.concatenate([self.prior.stddev, extra.stddev]), weight=s.beyond_prior)
        surface = MovingSurface(prepared.topology, prepared.model.mean_vertices, extra.modes)
        return replace(self, prior=prior, surface=surface)

    def matcher(self, level: Level, at: Estimate, tree: KdTree, winding: float | None) -> Matcher:
        """Return what matches the points that `level` draws, from where the fit is."""
        s, target, rng = self.settings, self.target, np.random.default_rng(self.settings.seed)
        points = target.draw(level.scan_points, rng)
        vertex = _some(self.prepared.topology.used, level.vertices, rng)
        engine = target.engine if level.triangles else target.vertex_engine
        return Matcher(
            target, self.surface, at.T_scan_model, points, vertex, engine, s.normal_cosine, tree=tree, winding=winding
        )

    def look(self, matcher: Matcher, at: Estimate) -> WeightedMatches:
        """Return the matches and how much each counts.

        Raises:
            FitError: hardly anything matches.
        """
        s = self.settings
        matches = matcher.match(self.surface, at.T_scan_model)  # eqs 4 to 6
        residual = matches.residuals()
        if len(residual) < _FEWEST_MATCHES:
            raise FitError(
                f"{self.target.mesh.name}: hardly any of it matches the model from this start; give landmarks "
                "(--landmarks), or check that it shows what the model does."
            )
        sigma_mm = max(spread(residual), s.least_spread_mm)
        width_mm = sigma_mm * min(s.wide, max(s.narrow, s.wide / tails(residual, sigma_mm) ** 2))  # eq 7
        fineness = min(1.0, len(self.target.mesh.vertices) / len(self.surface.vertices))
        weights = matches.weights(
            s.weight, width_mm, s.reach * width_mm + s.reach_mm, s.vertex_share * fineness**2
        )  # eqs 8, 9
        return WeightedMatches(matches, weights, sigma_mm)

    def equations(self, look: WeightedMatches, at: Estimate, modes: int) -> tuple[Gathered, NormalEquations]:
        """Return what each vertex carries of the matches, and the equations of a step from there."""
        gathered = look.matches.gathered(look.weights, self.prepared.topology.faces, len(self.surface.vertices))
        equations = normal_equations(self.surface, gathered, self.prior, look.sigma_mm, at, modes)
        if self.marks is None:
            return gathered, equations
        hessian, gradient = self.marks.equations(self.surface, at.T_scan_model, modes)
        gain = look.sigma_mm**2 * worth(float(look.weights.points.sum() + look.weights.vertices.sum()))
        return gathered, replace(equations, gradient=equations.gradient + gain * gradient, marks=gain * hessian)

    def step(self, matcher: Matcher, at: Estimate, modes: int) -> Step:
        """Return one Gauss-Newton step on the pose and the first `modes` coefficients; the surface moves with it.

        Raises:
            FitError: hardly anything matches, or the fit diverged.
        """
        look = self.look(matcher, at)  # eqs 4 to 9
        _, equations = self.equations(look, at, modes)  # eqs 10 to 14
        try:
            delta = equations.step()  # eq 15
        except LinAlgError as error:
            raise FitError(
                f"{self.target.mesh.name}: the fit diverged; give landmarks (--landmarks), or crop the scan to "
                "what the model shows (--crop)."
            ) from error
        some = slice(None, None, _MOTION_STRIDE)
        before, at = at.T_scan_model.apply(self.surface.vertices[some]), at.moved_by(delta)  # eq 16
        if modes:
            self.surface.deform(at.b)  # eq 1
        moved = at.T_scan_model.apply(self.surface.vertices[some]) - before
        return Step(look, at, float(np.linalg.norm(moved, axis=1).max()) / at.T_scan_model.scale)

    def descent(self, matcher: Matcher, at: Estimate, level: Level) -> Generator[Step]:
        """Yield steps with the modes that are free on `level`, until hardly anything moves.

        Raises:
            FitError: hardly anything matches, or the fit diverged.
        """
        modes = level.free(len(at.b))
        for _ in range(level.iterations):
            step = self.step(matcher, at, modes)
            at = step.at
            yield step
            if step.motion_mm < level.stop_motion_mm:
                return

    def unexplained_variance(self, look: WeightedMatches) -> float:
        """Return the variance, mm^2, of the part of the residuals that is no noise (eq 17)."""
        return look.matches.unexplained_variance(
            look.weights, self.prepared.topology.faces, len(self.surface.vertices), self.settings.seed
        )

    def told(self, at: Estimate, surface_mm: float, modes: int) -> Estimate:
        """Return the surface at `at` in the first `modes` of the model's own modes; `surface_mm` is its uncertainty."""
        own = self.prepared.model.n_modes
        if len(at.b) == modes == own:
            return at
        return in_span(
            self.prepared, self.surface.vertices, at, np.sqrt(new_shapes(self.prepared.model)), surface_mm, modes,
            with_scale=not self.prior.holds_scale,
        )  # fmt: skip

    def mismatch_mm(self, matcher: Matcher, at: Estimate) -> float:
        """Return the mean distance both ways, mm, of which none counts more than the reach."""
        matches, most = matcher.match(self.surface, at.T_scan_model), _FARTHEST * self.settings.reach_mm
        return sum(float(np.minimum(way.distance, most).mean()) for way in (matches.points, matches.vertices))

    def preferred(self, at: Estimate, matcher: Matcher, start: Start, level: Level, tree: KdTree) -> Estimate:
        """Return where `level` leads from `start` and its coefficients if that matches clearly better, else `at`."""
        limit_mm = _CLEARLY_BETTER * self.mismatch_mm(matcher, at)
        free, b = level.free(len(at.b)), np.zeros(len(at.b))
        b[: min(len(start.b), free)] = start.b[:free]
        other = Estimate(start.T_scan_model, b)
        self.surface.deform(b)
        matcher = self.matcher(level, other, tree, None)
        for step in self.descent(matcher, other, level):
            other = step.at
        if self.mismatch_mm(matcher, other) <= limit_mm:
            return other
        self.surface.deform(at.b)
        return at


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
    """Yield the states of the robust fit: phase 1 with the pose alone, phase 2 with pose and shape together.

    Args:
        model: the shape space, with triangles.
        target: the scan.
        start: a pose of the mean near the scan, and coefficients where it has some.
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
    scale = start.T_scan_model.scale
    problem = Problem.of(prepared, target, settings, scale, with_scale=with_scale, marks=start.marks)
    at = Estimate(start.T_scan_model, np.zeros(model.n_modes))
    tree, tree_fits = prepared.tree, False
    matcher = problem.matcher(settings.levels[0], at, tree, None)
    look = problem.look(matcher, at)
    state, winding = IcpState(1, 0, at.T_scan_model, at.b, look.rms_mm, float("inf")), look.matches.winding
    for level in settings.levels:
        begins = level.modes != 0 and state.phase == 1
        if begins:
            yield replace(state, stopped=state.stopped or "rate")
            state = replace(state, phase=2, iteration=0, stopped=None)
        # The surface changes little from level to level, and what it does the walks make up for.
        if level.modes is None and not tree_fits:
            tree, tree_fits = tree.moved(problem.surface.vertices[prepared.topology.used]), True
        matcher = problem.matcher(level, at, tree, winding)
        at, state = yield from _states(problem.descent(matcher, at, level), at, state, level, max_iterations)
        if begins and len(start.b) and state.iteration < max_iterations:
            at = problem.preferred(at, matcher, start, level, tree)

    look = problem.look(matcher, at)
    left_mm2 = problem.unexplained_variance(look)  # eq 17
    more = left_mm2 >= max(settings.beyond_share * look.sigma_mm**2, settings.beyond_mm**2)
    if more and state.iteration < max_iterations:
        problem = problem.with_modes_beside()
        at = Estimate(at.T_scan_model, np.pad(at.b, (0, len(problem.prior.stddev) - len(at.b))))
        problem.surface.deform(at.b)
        matcher = problem.matcher(settings.beyond, at, tree, winding)
        steps = problem.descent(matcher, at, settings.beyond)
        at, state = yield from _states(steps, at, state, settings.beyond, max_iterations)
        look = problem.look(matcher, at)
    yield state

    gathered, equations = problem.equations(look, at, len(at.b))
    surface, vertices = problem.surface, look.matches.vertices
    try:
        known = posterior(
            model, surface, problem.prior, equations, look.weights, look.sigma_mm,
            beyond_model_mm=float(np.sqrt(max(left_mm2, 0.0))), allowed_share=float(vertices.allowed.mean()),
        )  # fmt: skip
    except LinAlgError as error:
        raise FitError(
            f"{target.mesh.name}: the matches do not determine the pose; check the scan's unit (--unit), or give "
            "landmarks (--landmarks)."
        ) from error
    # Modes that nobody asked for are no reason to doubt the fit, so the verdict is on all of them.
    every = told = problem.told(at, known.surface_mm, model.n_modes)
    wanted = model.n_modes if modes is None else min(modes, model.n_modes)
    if wanted < model.n_modes:
        told = problem.told(at, known.surface_mm, wanted)
    reported = (at.T_scan_model.inverse() @ every.T_scan_model).apply(model.reconstruct(every.b))
    left_out_mm2 = float(((surface.vertices - reported) ** 2).sum(axis=1).mean())
    return Fitted(
        T_scan_model=told.T_scan_model,
        b=told.b,
        b_stddev=known.b_stddev(wanted),
        b_covariance=known.b_covariance(wanted),
        shrinkage=known.shrinkage(wanted),
        T_scan_fitted=at.T_scan_model,
        vertices_scan_mm=at.T_scan_model.apply(surface.vertices),
        outside_mm=float(np.linalg.norm(at.b[wanted:]) / np.sqrt(len(surface.vertices))),
        regions=FinalMatches(
            target, at.T_scan_model, MovingSurface(prepared.topology, surface.vertices), winding,
            settings.normal_cosine, settings.weight, look.weights.width_mm, look.weights.far_mm,
        ),
        evidence={
            **_matched(look, gathered, at, model, known.prior_variance[: model.n_modes]),
            "beyond_model_mm": float(np.sqrt(max(left_mm2, 0.0))),
            "left_out_mm": float(np.sqrt(left_out_mm2)),
            "model_spread_mm": float(np.sqrt((model.stddev**2).sum() / model.n_vertices)),
            "model_lack_mm": lack_of_new_shapes(model),
            **_of_marks(problem, at),
            "posterior_error_mm": float(np.hypot(known.surface_mm, np.sqrt(left_out_mm2))),
        },
        notes=() if problem.marks is None else problem.marks.notes(surface, at.T_scan_model),
        landmark_covariance=_of_landmarks(model, known, surface, at.T_scan_model),
    )  # fmt: skip


def _of_marks(problem: Problem, at: Estimate) -> dict[str, float]:
    """Return the standard deviation of landmarks that were given, and how far off they are (RMS), mm of the scan."""
    if problem.marks is None:
        return {}
    off_mm = problem.marks.off_mm(problem.surface, at.T_scan_model)
    return {"marks_stddev_mm": problem.marks.stddev_mm, "marks_rms_mm": float(np.sqrt((off_mm**2).mean()))}


def _of_landmarks(model: ShapeModel, known: Posterior, surface: MovingSurface, T: Similarity) -> FloatArray:
    """Return the covariance (L, 3, 3) of the model's landmarks in the frame that `T` leads to, mm^2."""
    covariance = covariance_of_landmarks(known, surface, model.landmarks)
    # No mode moves a landmark by what new shapes have outside the model, of which the scan shows about a half.
    covariance += np.eye(3) * _LACK_LEFT * lack_of_new_shapes(model) ** 2 / 3.0
    return T.scale**2 * T.rotation @ covariance @ T.rotation.T


def _matched(
    look: WeightedMatches, gathered: Gathered, at: Estimate, model: ShapeModel, variance: FloatArray
) -> dict[str, float]:
    """Return how much of model and scan found a match, and how plausible pose and shape are.

    Args:
        look: at the end,
        gathered: what of that each vertex carries.
        at: where that is.
        model: the shape space.
        variance: (K,) of the coefficients of new shapes, mm^2.
    """
    points, vertices, v = look.matches.points, look.matches.vertices, look.weights.vertices
    size_mm, z2 = rms_size(model.mean_vertices), at.b[: model.n_modes] ** 2 / variance
    return {
        "size_mm": size_mm,
        "seen_share": float(gathered.seen.mean()),
        "model_matched_share": float((v > _HALF * v.max()).mean()),
        "model_allowed_share": float(vertices.allowed.mean()),
        "scan_allowed_share": float(points.allowed.mean()),
        "scan_near_share": float((points.distance < _NEAR * size_mm).mean()),
        "model_near_share": float((vertices.distance < _NEAR * size_mm).mean()),
        "z2": float(z2.mean()),
        "z2_leading": float(z2[:_LEADING].mean()),
        "log_scale": float(np.log(at.T_scan_model.scale)),
        "spread_mm": look.sigma_mm,
    }


def _states(
    steps: Iterator[Step], at: Estimate, state: IcpState, level: Level, max_iterations: int
) -> Generator[IcpState, None, tuple[Estimate, IcpState]]:
    """Yield each state when the next is there; return the last one, which is not yielded, and where it is."""
    left = max_iterations - state.iteration
    for step in islice(steps, left):
        yield replace(state, stopped=None)
        at = step.at
        # Where parts of the scan match now one way and now another, the last bit of motion never ends.
        still = step.motion_mm < _FLICKER * level.stop_motion_mm
        state = IcpState(
            state.phase, state.iteration + 1, at.T_scan_model, at.b[: len(state.b)].copy(), step.look.rms_mm,
            step.motion_mm, "rate" if still else "cap",
        )  # fmt: skip
    return at, state if left > 0 else replace(state, stopped="cap")


def _some(index: IntArray, count: int | None, rng: np.random.Generator) -> IntArray:
    return index if count is None or count >= len(index) else np.sort(rng.choice(index, count, replace=False))
