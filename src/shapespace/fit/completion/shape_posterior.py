"""Joint posterior of pose, coefficients and off-model variation given a scan, for the completion of missing parts.

The prior of a fit is chosen for small errors where the scan shows the surface. On missing parts the estimate is a
prediction, so here the prior has the full variances of new shapes, the residual modes are always free, and
the error of a covariance that was estimated from N shapes is added. Equation numbers are those of docs/completion.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import fdtri, gammaincinv

from shapespace.errors import FitError
from shapespace.fit.dense.residual_modes import ResidualModes, residual_modes
from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.matching import Matcher, MatchHint, choose_bulging
from shapespace.fit.robust.posterior import (
    NOISE_TEMPERATURE,
    PATCHES,
    Estimate,
    lack_of_new_shapes,
    variance_of_new_shapes,
)
from shapespace.fit.robust.prepared_model import (
    ArticulatedShape,
    LandmarkConstraint,
    LinearShape,
    ModelSurface,
    prepare,
)
from shapespace.fit.robust.robust_icp import Iterate, Problem, WeightedMatches
from shapespace.fit.robust.robust_settings import Level, RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import build_engine, on_boundary
from shapespace.geometry.normals import boundary_vertices, rms_size
from shapespace.geometry.similarity import POSE, SCALE, small_poses, small_similarity
from shapespace.model.new_shapes import variances_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.model.training_shapes import MOST_SHAPES
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

_LEVEL = Level(modes=None, scan_points=20_000, vertices=500, triangles=True, iterations=15, stop_motion_mm=0.0)
"""Largest number of scan points that are matched, and of steps; vertices only add to the spread of residuals."""
_SETTLED = 2.5e-4  # share of the model's size; a step that moves no vertex further ends the iterations
_FAR = 0.05  # share of the model's size; points farther away count as points of another object
_LOOSE = 10.0
"""Standard deviation of rotation (radians) and of translation (in units of the model's size): hardly a prior."""
_AMPLITUDES = np.geomspace(1e-4, 100.0, 19)
"""Variances of the off-model variation that are compared, in units of the variance that the spectrum predicts."""
_AMPLITUDE_STDDEV, _OF_UNKNOWN_MODEL = 1.0, 3.0
"""Standard deviation of the logarithm of the amplitude, chosen by benchmarks/completion.py on faces and femora; the
second is for models without a known number of shapes, whose spectrum does not predict the amplitude."""
DRAWS = 400  # samples of a covariance of vertices on arcs; standard deviations then have an error of 4 %
OTHER_SIZE = 4.0  # standard deviations of the training shapes' size
AS_LIKELY = 3.0  # log density (a factor of 20) within which two explanations of a scan are equally likely


@dataclass(frozen=True, eq=False)
class ShapePosterior:
    """Normal distribution of pose, coefficients and off-model variation given a scan.

    Args:
        T_scan_model: mean pose, from the model's frame to the scan's mm frame.
        surface: mean surface, mm of the model's frame, with the modes that were free (K of the model, R residual).
        b: (K + R,) mean coefficients, mm.
        covariance: (7 + K + R, 7 + K + R) covariance of rotation (radians), translation (mm), log scale and the
            coefficients.
        prior_variance: (7 + K + R,) variances of these parameters in the prior.
        amplitude: variance of the off-model variation in units of the variance that the spectrum predicts (E3).
        noise_mm: robust standard deviation of the residuals, mm of the model's frame.
        followed: (V,) True where a scan point is matched.
        mismatch_mm: RMS distance of the scan's points from the surface, each up to 5 % of the model's size;
            not-a-number if settled.
        covered_mismatch_mm: robust RMS distance of the points that do not lie beyond the border of the model: the 90 %
            quantile over that of a normal distribution, as scans contain hair, supports and stray points;
            not-a-number if settled.
        n_modes: K, the number of modes of the model.
        step: (P,) step from the parameters of the surface to the mean of its linearised posterior; about zero if
            settled.
        left_out: errors of the completions of the training shapes, each by a model of the other shapes; None without
            training shapes.
        shape: shape model with the modes that were free.
    """

    T_scan_model: Similarity
    surface: ModelSurface
    b: FloatArray
    covariance: FloatArray
    prior_variance: FloatArray
    amplitude: float
    noise_mm: float
    followed: BoolArray
    mismatch_mm: float
    covered_mismatch_mm: float
    n_modes: int
    step: FloatArray
    left_out: LeftOutErrors | None
    shape: LinearShape

    def log_density(self) -> float:
        """Return the log density of scan and shape up to a constant, with as many observations as patches (E9)."""
        patches = PATCHES * float(self.followed.mean()) / NOISE_TEMPERATURE
        scale = self.prior_variance[SCALE]
        size = float(np.log(self.T_scan_model.scale)) ** 2 / scale if scale > 0 else 0.0
        return -patches * float(np.log(self.mismatch_mm)) - 0.5 * (self.n_modes * self.mean_square_z + size)

    def vertex_covariance(self) -> FloatArray:
        """Return the (V, 3, 3) covariance, mm^2, of each vertex position along the axes of the model's frame (E5).

        If the relative pose of parts is modelled, vertices move on arcs, and it is that of samples about the mean.
        """
        if isinstance(self.shape, ArticulatedShape):
            return second_moments(self.draw_displacements(DRAWS, np.random.default_rng(0)))
        rows = self.rows()
        moved = (rows.reshape(-1, rows.shape[2]) @ self.covariance.astype(np.float32)).reshape(rows.shape)
        return np.asarray(np.einsum("vip,vjp->vij", moved, rows), dtype=np.float64)

    def prior_vertex_variance(self) -> FloatArray:
        """Return the (V,) variance, mm^2, of the vertex positions in the population, for a known pose."""
        variance = self.prior_variance[POSE:].astype(np.float32)
        return np.asarray(np.einsum("vip,p->v", self.rows()[:, :, POSE:] ** 2, variance), dtype=np.float64)

    @property
    def mean_square_z(self) -> float:
        """Mean square of the coefficients of the model's own modes, in standard deviations among new shapes."""
        return float((self.b[: self.n_modes] ** 2 / self.prior_variance[POSE : POSE + self.n_modes]).mean())

    def draw_displacements(self, count: int, rng: np.random.Generator) -> Float32Array:
        """Return (count, V, 3) float32 displacements from the mean surface, mm of the model's frame (E6)."""
        root = root_of(self.covariance)
        draws = (root @ rng.standard_normal((root.shape[1], count))).astype(np.float32)
        if isinstance(self.shape, ArticulatedShape):
            return self.displacements(draws.T.astype(np.float64), np.broadcast_to(self.b, (count, len(self.b))))
        rows = self.rows()
        return (rows.reshape(-1, len(root)) @ draws).T.reshape(count, *rows.shape[:2])

    def displacements(self, steps: FloatArray, b: FloatArray) -> Float32Array:
        """Return (n, V, 3) float32 displacements, mm, by steps (n, P) of the parameters from shapes `b` (n, K + R)."""
        moved = [
            small_similarity(step[:POSE]).apply(self.shape.vertices(own + step[POSE:])) - self.shape.vertices(own)
            for step, own in zip(steps, b, strict=True)
        ]
        return np.stack(moved).astype(np.float32)

    def main_mode(self) -> FloatArray:
        """Return the (V, 3) displacement of one standard deviation along the first principal component, mm."""
        rows, root = self.rows().reshape(-1, len(self.covariance)), root_of(self.covariance)
        gram = root.T @ (rows.T @ rows).astype(np.float64) @ root
        vector = np.linalg.eigh(gram)[1][:, -1]
        return np.asarray(rows @ (root @ vector), dtype=np.float64).reshape(-1, 3)

    def rows(self) -> Float32Array:
        """Return the (V, 3, 7 + K + R) float32 derivatives of the vertices with respect to the parameters."""
        pose = small_poses(self.surface.vertices).reshape(-1, 3, POSE).astype(np.float32)
        return np.concatenate([pose, self.surface.modes], axis=2)


def shape_posterior(
    model: ShapeModel, target: ScanTarget, T_scan_model: Similarity, b: FloatArray, settings: RobustSettings,
    *, with_scale: bool, marks: LandmarkConstraint | None = None, calibrated: bool = True,
    settled: bool = False,
) -> ShapePosterior:  # fmt: skip
    """Return the posterior near a fit with the pose `T_scan_model` and the coefficients `b` (K,) mm.

    Args:
        model: the shape model, with triangles.
        target: the scan in its mm frame.
        T_scan_model: pose of the fit, from the model's frame to the scan's mm frame.
        b: (K,) coefficients of the fit, mm.
        settings: settings of the matches and their weights.
        with_scale: whether the scale is free; False fixes it.
        marks: landmarks of the scan, if any.
        calibrated: whether to estimate the error from the training shapes (E4), which a comparison of poses does not
            need.
        settled: whether to linearise at the fit itself; False first iterates from it to the optimum.

    Raises:
        FitError: hardly any point of the scan matches, or the scan does not determine the pose.
    """
    size_mm, training = rms_size(model.mean_vertices), model.training
    size_stddev = None if training is None else training.log_scale_stddev
    if size_stddev is not None and abs(np.log(T_scan_model.scale)) > OTHER_SIZE * size_stddev:
        size_stddev = None  # the scan has another size than any training shape, such as in an unknown unit
    # If the sizes of the training shapes are known, they are the prior of the scale, else the scale of the fit is.
    start_scale = T_scan_model.scale if size_stddev is None or settled else 1.0
    settings = replace(settings, scale_stddev=size_stddev or settings.scale_stddev)
    problem = Problem.of(prepare(model), target, settings, start_scale, with_scale=with_scale, marks=marks)
    iterate = problem.iterate(Estimate(T_scan_model, b))
    matcher = problem.matcher(_LEVEL)
    hint = matcher.first_hint(iterate.surface, iterate.T_scan_model, problem.prepared.tree)
    matcher = choose_bulging(matcher, iterate.surface, iterate.T_scan_model, hint)
    own = problem.match(matcher, iterate, hint)
    beyond_mm2 = max(problem.unexplained_variance(own), 0.0)  # R17
    try:
        extra = residual_modes(model, settings.residual)
        problem, prior = _with_residual_modes(problem, extra)
        iterate = problem.iterate(Estimate(iterate.T_scan_model, np.pad(iterate.b, (0, len(extra.stddev)))))
        line = _LinearisedLikelihood.of(problem, matcher, iterate, hint, prior, beyond_mm2)
        # A part that the scan lacks turns freely, which is not linear, so that steps to the optimum diverge.
        lacks_part = target.shown is not None and not model.is_linear and not target.shown.all()
        for _ in range(0 if settled or lacks_part else _LEVEL.iterations):
            before = iterate.T_scan_model.apply(iterate.surface.vertices)
            iterate = problem.iterate(iterate.estimate.moved_by(line.data.mean(line.variance) - line.theta))
            moved_mm = float(np.abs(iterate.T_scan_model.apply(iterate.surface.vertices) - before).max())
            if moved_mm < _SETTLED * size_mm * T_scan_model.scale:
                break
            if moved_mm > size_mm * T_scan_model.scale and not model.is_linear:
                raise LinAlgError("The steps diverge, as a part turns freely.")
            line = _LinearisedLikelihood.of(problem, matcher, iterate, line.weighted.matches.hint, prior, beyond_mm2)
        mean, left_out = line.data.mean(line.variance), None
        covariance = line.data.covariance(line.variance)
        if calibrated and (known := _known_shapes(model)) is not None:
            left_out = leave_one_out(known, line.data.H, line.data.pull, mean, line.variance, extra)
            covariance = left_out.covariance()
    except LinAlgError as error:
        raise FitError(
            f"{target.mesh.name}: what the scan shows does not determine the pose; give landmarks (--landmarks), or, "
            "of several parts, all or one."
        ) from error
    # A settled posterior is part of each fit of a partial scan, which does not use the mismatches.
    mismatch_mm, covered_mismatch_mm = np.nan, np.nan
    if not settled:
        points = iterate.T_scan_model.inverse().apply(matcher.points_mm)
        mismatch_mm, covered_mismatch_mm = _mismatches_mm(
            Mesh(iterate.surface.vertices, model.faces), points, _FAR * size_mm
        )
    return ShapePosterior(
        iterate.T_scan_model, iterate.surface, iterate.b, covariance, line.variance, line.amplitude,
        line.weighted.sigma_mm, line.followed, mismatch_mm, covered_mismatch_mm, model.n_modes, mean - line.theta,
        left_out, problem.shape,
    )  # fmt: skip


def _mismatches_mm(surface: Mesh, points: FloatArray, far_mm: float) -> tuple[float, float]:
    """Return `mismatch_mm` and `covered_mismatch_mm` of points (M, 3), each distance up to `far_mm`."""
    matches = build_engine(surface).query(points)  # the walks of the fit may end in another fold of the surface
    squared = np.minimum(matches.distance, far_mm) ** 2
    covered = ~on_boundary(matches, surface, boundary_vertices(surface))
    robust = np.sqrt(np.quantile(squared[covered], 0.9) / (2 * gammaincinv(0.5, 0.9))) if covered.any() else np.inf
    return float(np.sqrt(squared.mean())), float(robust)


def _known_shapes(model: ShapeModel) -> FloatArray | None:
    """Return log scale and coefficients (n, 1 + K) of the training shapes.

    Samples represent the training shapes if the model states their number without containing them; None otherwise.
    """
    if model.training is not None:
        return np.column_stack([model.training.log_scale, model.training.coefficients])
    if not model.is_n_training_known or model.n_training <= model.n_modes:
        return None
    b = model.sample(min(model.n_training, MOST_SHAPES), np.random.default_rng(0))
    return np.column_stack([np.zeros(len(b)), b - b.mean(axis=0)])


def _with_residual_modes(problem: Problem, extra: ResidualModes) -> tuple[Problem, FloatArray]:
    """Return the problem with the residual modes, and the prior variances of its parameters (P,) (E1)."""
    model = problem.prepared.model
    # The strongest residual modes get the complete variance that new shapes have outside the model.
    off_model = extra.stddev**2 * (lack_of_new_shapes(model) ** 2 * model.n_vertices / (extra.stddev**2).sum())
    size_mm = rms_size(model.mean_vertices)
    scale = problem.prior.scale_stddev**2
    prior = np.concatenate(
        [np.full(3, _LOOSE**2), np.full(3, (_LOOSE * size_mm) ** 2), [scale], variance_of_new_shapes(model), off_model]
    )
    coefficient_prior = replace(problem.prior, stddev=np.sqrt(prior[POSE:]), weight=0.0)
    return replace(problem, prior=coefficient_prior, shape=replace(problem.shape, modes=extra.modes)), prior


@dataclass(frozen=True, eq=False)
class _LinearisedLikelihood:
    """Likelihood of the matches of an iterate.

    Args:
        weighted: weighted matches.
        followed: (V,) True where a scan point is matched.
        data: likelihood of the matches.
        theta: (P,) parameters at which the likelihood is linearised; the pose is relative to the iterate.
        amplitude: likeliest amplitude of the off-model variation (E3).
        variance: (P,) variances of the prior with this amplitude.
        log_evidence: log evidence of this amplitude (E3).
    """

    weighted: WeightedMatches
    followed: BoolArray
    data: _DataLikelihood
    theta: FloatArray
    amplitude: float
    variance: FloatArray
    log_evidence: float

    @staticmethod
    def of(
        problem: Problem, matcher: Matcher, iterate: Iterate, hint: MatchHint, prior: FloatArray, beyond_mm2: float
    ) -> _LinearisedLikelihood:
        """Return the likelihood near `iterate` (E2), and the likeliest amplitude (E3)."""
        weighted = problem.match(matcher, iterate, hint)
        gathered, equations = problem.equations(weighted, iterate, len(iterate.b))
        matches = float(weighted.weights.points.sum()) + float(weighted.weights.vertices.sum())
        patches = PATCHES * float(gathered.seen.mean())
        precision = NOISE_TEMPERATURE * weighted.sigma_mm**2 + matches / patches * beyond_mm2  # R20
        H, pull = equations.H / precision, -equations.gradient / precision
        if problem.marks is not None:
            H_landmarks, gradient = problem.marks.equations(iterate.surface, iterate.T_scan_model, len(iterate.b))
            H, pull = H + H_landmarks, pull - gradient
        log_scale = np.log(iterate.T_scan_model.scale / problem.prior.start_scale)
        theta = np.concatenate([np.zeros(SCALE), [log_scale], iterate.b])
        data = _DataLikelihood(H, pull + H @ theta)
        model = problem.prepared.model
        first = POSE + model.n_modes
        stddev = _AMPLITUDE_STDDEV if model.is_n_training_known else _OF_UNKNOWN_MODEL
        # The variance of the off-model variation that is likeliest given scan and spectrum, and its evidence (E3).
        score = [
            data.log_evidence(_scale_variances(prior, first, a)) - 0.5 * (np.log(a) / stddev) ** 2 for a in _AMPLITUDES
        ]
        best = int(np.argmax(score))
        amplitude, log_evidence = float(_AMPLITUDES[best]), score[best]
        variance = _scale_variances(prior, first, amplitude)
        return _LinearisedLikelihood(weighted, gathered.seen, data, theta, amplitude, variance, log_evidence)


@dataclass(frozen=True, eq=False)
class _DataLikelihood:
    """Precision and pull of the data: their log likelihood is -theta^T H theta / 2 + pull^T theta (E2).

    Args:
        H: (P, P) precision.
        pull: (P,) precision times the position of the optimum.
    """

    H: FloatArray
    pull: FloatArray

    def factor(self, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the Cholesky factor of the posterior precision in units of the prior, and these units (P,)."""
        unit = np.sqrt(variance)
        scaled = self.H * np.outer(unit, unit)
        scaled[np.diag_indices_from(scaled)] += 1.0
        return cho_factor(scaled, lower=True, overwrite_a=True)[0], unit

    def mean(self, variance: FloatArray) -> FloatArray:
        """Return the posterior mean (P,) with the prior variances `variance` (P,) (E2)."""
        factor, unit = self.factor(variance)
        return unit * cho_solve((factor, True), unit * self.pull)

    def covariance(self, variance: FloatArray) -> FloatArray:
        """Return the posterior covariance (P, P) with the prior variances `variance` (P,)."""
        factor, unit = self.factor(variance)
        return cho_solve((factor, True), np.eye(len(unit))) * np.outer(unit, unit)

    def log_evidence(self, variance: FloatArray) -> float:
        """Return the log evidence of the prior variances, up to a constant (E3)."""
        factor, unit = self.factor(variance)
        pull = unit * self.pull
        return float(0.5 * pull @ cho_solve((factor, True), pull) - np.log(factor.diagonal()).sum())


def _scale_variances(prior: FloatArray, first: int, amplitude: float) -> FloatArray:
    """Return the prior variances with those from `first` on times `amplitude`."""
    return np.concatenate([prior[:first], amplitude * prior[first:]])


MOST_LEFT_OUT = 50  # shapes; standard deviations then have an error of 10 %, and the time is seconds for 500 modes
_FEWEST_LEFT_OUT, _MOST_WORK = 12, 10_000  # shapes, and shapes times modes: with more modes fewer shapes are held out
_OFF_MODEL = 60  # strongest residual modes; they vary together with the part of a shape outside the others' span
_COVERED = 0.95  # share of the regions for which the covariance is exact
_ROUNDING = 1e-12  # share of the largest variance


@dataclass(frozen=True, eq=False)
class LeftOutErrors:
    """Errors of the completions of n training shapes, each by the model of the other shapes (E4).

    The P parameters are those of the completion: pose, coefficients and off-model variation.

    Args:
        known: (n, 1 + K) log scale and coefficients of the shapes, mm.
        errors: (n, P) errors of the parameters, without noise of the scan.
        noise: (P, P) covariance of the errors due to noise of the scan.
        shifts: (n, P) differences between the completion of the scan by the model without the shape and its completion
            by the complete model.
    """

    known: FloatArray
    errors: FloatArray
    noise: FloatArray
    shifts: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) of the predictive distribution of the error (E4)."""
        return predictive_covariance(self.errors) + self.noise


def second_moments(draws: Float32Array) -> FloatArray:
    """Return the mean products (V, 3, 3), mm^2, of displacements (n, V, 3) of vertices."""
    exact = draws.astype(np.float64)
    return np.einsum("nvi,nvj->vij", exact, exact) / len(exact)


def predictive_covariance(errors: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of a new error, given those of n held-out shapes, (n, P) (E4)."""
    n = len(errors)
    # Hotelling's T^2 of one of n errors, so that 95 % regions of a vertex contain it with a probability of 95 %.
    factor = 3 * n / (n - 2) * float(fdtri(3, n - 2, _COVERED) / (2 * gammaincinv(1.5, _COVERED)))
    return errors.T @ errors * (factor / n)


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a root R (P, P) of a covariance, R R^T; it is scaled, as angles and coefficients differ in size."""
    is_positive = covariance.diagonal() > 0.0  # rounding makes variances of fixed parameters negative
    unit = np.sqrt(np.where(is_positive, covariance.diagonal(), 1.0))
    value, vector = np.linalg.eigh(covariance * np.outer(is_positive, is_positive) / np.outer(unit, unit))
    return unit[:, None] * vector * np.sqrt(np.maximum(value, 0.0))


def leave_one_out(
    known: FloatArray, H: FloatArray, pull: FloatArray, mean: FloatArray, variance: FloatArray,
    extra: ResidualModes,
) -> LeftOutErrors:  # fmt: skip
    """Return the errors of the completions of training shapes, each by the model of the other shapes (E4).

    Args:
        known: (n, 1 + K) log scale of the shapes, and coefficients in all modes of the model, mm.
        H: (P, P) precision of the data.
        pull: (P,) pull of the data.
        mean: (P,) posterior mean of the scan.
        variance: (P,) prior variances; zero fixes a parameter.
        extra: the residual modes.
    """
    coefficients = known[:, 1:]
    n, K = coefficients.shape
    end = POSE + K + min(_OFF_MODEL, len(variance) - POSE - K)
    kept = np.arange(SCALE if variance[SCALE] > 0 else POSE, end, dtype=np.int32)
    c = slice(POSE - kept[0], POSE - kept[0] + K)
    # The prior of pose and faint modes is the same for all shapes, so they are eliminated once.
    is_other = variance > 0
    is_other[kept] = False
    other = np.flatnonzero(is_other)
    factor = cho_factor(H[np.ix_(other, other)] + np.diag(1.0 / variance[other]), lower=True)
    slaved, pull_other = cho_solve(factor, H[np.ix_(other, kept)]), cho_solve(factor, pull[other])
    H_kept = H[np.ix_(kept, kept)] - H[np.ix_(kept, other)] @ slaved
    pull_kept = pull[kept] - H[np.ix_(kept, other)] @ pull_other
    share = variance[POSE + K :].sum() / (extra.stddev**2).sum()
    z = coefficients / np.sqrt((coefficients**2).sum(axis=0) / (n - 1))
    prior, mu, theta = np.diag(variance[kept]), np.zeros(len(kept)), np.zeros(len(kept))
    chosen = np.arange(n, dtype=np.int32)
    most = min(MOST_LEFT_OUT, max(_FEWEST_LEFT_OUT, _MOST_WORK // K))
    if n > most:
        chosen = np.sort(np.random.default_rng(0).choice(n, most, replace=False))
    errors, shifts = np.zeros((2, len(chosen), len(variance)))
    for row, i in enumerate(chosen):
        off = ((coefficients - coefficients[i]) ** 2).sum(axis=1)
        others = coefficients[off > _ROUNDING * off.max()]  # a copy of the shape would predict it
        mu[c], theta[c], theta[: c.start] = others.mean(axis=0), coefficients[i], known[i, : c.start]
        prior[c, c], outside = _prior_and_complement(others - mu[c])
        # The part outside the span of the others has the prior of the residual modes, with which it varies together.
        off_model = share * extra.covariance_outside(outside, z[i], n)[:, : end - POSE]
        prior[c, c] += off_model[:, :K] @ outside @ outside.T
        prior[c, c.stop :], prior[c.stop :, c] = off_model[:, K:], off_model[:, K:].T
        both = np.column_stack([mu - theta, prior @ pull_kept + mu])
        solved = np.linalg.solve(np.eye(len(kept)) + prior @ H_kept, both)
        errors[row, kept], shifts[row, kept] = solved.T
    errors[:, other] = -errors[:, kept] @ slaved.T
    shifts[:, other] = pull_other - shifts[:, kept] @ slaved.T
    return LeftOutErrors(known[chosen], errors, _noise_covariance(H, variance), shifts - mean)


def _noise_covariance(H: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of the posterior mean due to noise of the data."""
    free = np.flatnonzero(variance > 0)
    H = H[np.ix_(free, free)]
    gain = np.linalg.inv(H + np.diag(1.0 / variance[free]))
    out = np.zeros((len(variance), len(variance)))
    out[np.ix_(free, free)] = gain @ H @ gain
    return out


def _prior_and_complement(others: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the prior covariance (K, K) of a model of centred shapes (m, K), and a basis (K, r) of its complement."""
    m = len(others)
    value, vector = np.linalg.eigh(others.T @ others / (m - 1))
    rank = min(m - 1, int((value > _ROUNDING * value[-1]).sum()))
    sample, axes = value[: -rank - 1 : -1], vector[:, : -rank - 1 : -1]
    new = np.maximum(sample, variances_of_new_shapes(sample, float(sample.sum()), m))
    return (axes * new) @ axes.T, vector[:, :-rank]
