"""Uncertainty of a robust fit: the joint posterior of pose and coefficients, tempered and calibrated.

At the optimum the cost of `robust` is near quadratic, so the inverse of its Hessian is the covariance of pose,
coefficients and residual modes together (Laplace). The block of b in the full inverse has the pose marginalised. This
covariance is far too small, since residuals with a common cause are counted as independent. So the data's part of
the Hessian is divided by a temperature before the prior is added again: unobserved parts stay at the prior.
Equation numbers are those of docs/robust.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotrf, dpotrs

from shapespace.fit.robust.kernels import rows_into
from shapespace.fit.robust.matching import Gathered, Weights
from shapespace.fit.robust.prepared_model import ModelSurface, worth
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import POSE, SCALE, small_poses, small_similarity
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.new_shapes import variances_of_new_shapes, whole_spectrum
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity, SurfaceLandmarks

_DAMPING = (1e-7, 1e-5, 1e-3)
"""Added to the unit diagonal of R15a, one after the other until the equations have a solution; the first is far below
the precision of the float32 rows, and the others are for parts that the scan does not show, which turn freely."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose and coefficients of an iterate.

    Args:
        T_scan_model: similarity from the model's frame to the scan's mm frame (R2).
        b: (K,) coefficients of all modes, mm.
    """

    T_scan_model: Similarity
    b: FloatArray

    def moved_by(self, delta: FloatArray) -> Estimate:
        """Return the estimate after the step `delta` (7 + k,): omega, tau, ds, then db (R3, R16)."""
        b = self.b.copy()
        b[: len(delta) - POSE] += delta[POSE:]
        return Estimate(self.T_scan_model @ small_similarity(delta[:POSE]), b)


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal prior of the coefficients and of the log scale (R13, R14).

    Args:
        stddev: (K,) standard deviation of each coefficient, mm.
        weight: alpha, weight of the prior relative to one match.
        start_scale: s_0, the scale of the start.
        scale_stddev: standard deviation of log(s / s_0); zero if the scale is fixed.
    """

    stddev: FloatArray
    weight: float
    start_scale: float
    scale_stddev: float

    @property
    def holds_scale(self) -> bool:
        """Whether the scale is that of the start."""
        return self.scale_stddev == 0.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """(H + D + H_landmarks) delta = -gradient, for rotation, translation, log scale and k coefficients (R15).

    All terms are multiplied by sigma^2, the variance of the residuals.

    Args:
        H: (7 + k, 7 + k) Hessian of the matches (R12).
        D: (7 + k,) diagonal of the Hessian of the prior (R13, R14).
        gradient: (7 + k,) g + e, the gradient of matches, prior and landmarks.
        holds_scale: whether the scale is fixed, so that its row and column are omitted.
        H_landmarks: (7 + k, 7 + k) Hessian of the landmarks with their gain (R16c); None without landmarks.
    """

    H: FloatArray
    D: FloatArray
    gradient: FloatArray
    holds_scale: bool
    H_landmarks: FloatArray | None = None

    def step(self) -> FloatArray:
        """Return delta (7 + k,), solved with a unit diagonal and light damping (R15, R15a).

        Raises:
            LinAlgError: the equations have no solution.
        """
        free = np.delete(np.arange(len(self.gradient)), SCALE) if self.holds_scale else slice(None)
        hessian = np.array(self.H[free][:, free], order="F")
        if self.H_landmarks is not None:
            hessian += self.H_landmarks[free][:, free]
        diagonal = np.einsum("ii->i", hessian)  # a view
        diagonal += self.D[free]
        unit = 1.0 / np.sqrt(np.maximum(diagonal, 1e-30))  # R15a
        hessian *= unit[:, None] * unit
        for damping in _DAMPING:
            diagonal += damping
            # LAPACK itself: the checks of `cho_factor` take as long as its work.
            factor, not_definite = dpotrf(hessian, lower=1, overwrite_a=0, clean=0)
            if not not_definite:
                break
        else:
            raise LinAlgError("The normal equations are not positive definite.")
        delta = np.zeros(len(self.gradient))
        delta[free] = -unit * dpotrs(factor, unit * self.gradient[free], lower=1)[0]  # R15
        if not np.isfinite(delta).all():
            raise LinAlgError("The normal equations have no finite solution.")
        return delta


def normal_equations(
    surface: ModelSurface, gathered: Gathered, prior: Prior, sigma_mm: float, estimate: Estimate, modes: int
) -> NormalEquations:
    """Return the equations of one Gauss-Newton step on the pose and the first `modes` coefficients.

    Args:
        surface: surface of the model with the coefficients of `estimate`.
        gathered: weights and weighted residuals of the matches at each of its vertices.
        prior: prior of coefficients and scale.
        sigma_mm: spread of the residuals, mm of the model's frame.
        estimate: pose and coefficients.
        modes: k, the number of free modes.
    """
    rows = np.empty((len(gathered.W), POSE + modes), dtype=np.float32)
    gradient = np.zeros(POSE + modes)
    count = rows_into(
        surface.vertices, surface.normals, surface.modes, modes, gathered.W, gathered.h, rows, gradient
    )  # R11, R12
    rho = prior.weight * sigma_mm**2
    D = np.zeros(POSE + modes)
    D[POSE:] = rho / prior.stddev[:modes] ** 2  # R13
    gradient[POSE:] += D[POSE:] * estimate.b[:modes]
    if not prior.holds_scale:
        D[SCALE] = rho / prior.scale_stddev**2  # R14
        gradient[SCALE] += D[SCALE] * np.log(estimate.T_scan_model.scale / prior.start_scale)
    H = np.asarray(rows[:count].T @ rows[:count], dtype=np.float64)  # R12
    return NormalEquations(H, D, gradient, prior.holds_scale)


# Chosen on the split "dev" of `benchmarks/calibration.py`, so that intervals of 68 % and 95 % contain these shares.
NOISE_TEMPERATURE = 1.7
# independent patches of a completely observed surface, as neighbouring residuals are correlated (R20a)
PATCHES = 300.0
_FEWEST_PATCHES = 100.0

"""Smallest number of independent patches; the expected error, on which the verdict was tuned, uses it throughout."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Covariance of pose and coefficients, and the expected error of the surface.

    Args:
        covariance: (7 + K + R, 7 + K + R) covariance of rotation (radians), translation (mm), log scale, the model's K
            coefficients and those of the R residual modes (mm).
        prior_variance: (K + R,) variances of the coefficients in the prior, mm^2.
        surface_mm: expected RMS error of the fitted surface over its vertices, mm of the model's frame, for the
            smallest number of independent patches, on which the verdict was tuned.
    """

    covariance: FloatArray
    prior_variance: FloatArray
    surface_mm: float

    def b_covariance(self, modes: int) -> FloatArray:
        """Return the covariance (modes, modes) of the first coefficients, mm^2."""
        return self.covariance[POSE : POSE + modes, POSE : POSE + modes]

    def b_stddev(self, modes: int) -> FloatArray:
        """Return the standard deviations (modes,) of the first coefficients, mm; never above those of the prior."""
        return np.sqrt(np.clip(self.b_covariance(modes).diagonal(), 0.0, self.prior_variance[:modes]))  # R21a

    def shrinkage(self, modes: int) -> FloatArray:
        """Return (modes,) in [0, 1]: 1 where the scan determines the coefficient, 0 where only the prior does."""
        return 1.0 - self.b_stddev(modes) ** 2 / self.prior_variance[:modes]  # R21b


def posterior(
    model: ShapeModel,
    surface: ModelSurface,
    prior: Prior,
    equations: NormalEquations,
    weights: Weights,
    sigma_mm: float,
    *,
    beyond_model_mm: float,
    allowed_share: float,
) -> Posterior:
    """Return the posterior at the end of a fit (R20-R22).

    Args:
        model: the shape model.
        surface: final surface, with all modes that were free.
        prior: prior of the fit.
        equations: normal equations at the end.
        weights: weights of the matches at the end.
        sigma_mm: spread of the residuals at the end, mm of the model's frame.
        beyond_model_mm: RMS of the residuals outside the model and without noise, mm of the model's frame.
        allowed_share: share of the vertices whose match is not on a border and faces as the model does.
    """
    K, n = model.n_modes, POSE + len(prior.stddev)
    variance = np.concatenate([variance_of_new_shapes(model), prior.stddev[K:] ** 2])
    H = equations.H / sigma_mm**2
    if equations.holds_scale:
        H[SCALE], H[:, SCALE] = 0.0, 0.0
    matches = float(weights.points.sum()) + float(weights.vertices.sum())
    size_mm = rms_size(model.mean_vertices)
    # Scaled to standard deviations, so that one small damping suits rotations, translations and coefficients.
    scale_stddev = prior.scale_stddev or 1.0
    unit = np.concatenate([np.ones(3), np.full(3, size_mm), [scale_stddev], np.sqrt(variance)])
    prior_precision = np.concatenate([np.full(POSE - 1, 1e-9), np.ones(n - POSE + 1)])

    def covariance(patches: float) -> FloatArray:
        # All matches of a patch share the error of the model; noise is nearly independent from match to match.
        temperature = NOISE_TEMPERATURE + matches / patches * (beyond_model_mm / sigma_mm) ** 2  # R20
        scaled = H / temperature * np.outer(unit, unit)
        if equations.H_landmarks is not None:
            # In a step landmarks have a gain, relative to the matches; here the matches are tempered instead.
            scaled += equations.H_landmarks / (sigma_mm**2 * worth(matches)) * np.outer(unit, unit)
        scaled[np.diag_indices(n)] += prior_precision
        inverse = np.asarray(cho_solve(cho_factor(scaled, lower=True), np.eye(n)))  # R21
        if equations.holds_scale:
            inverse[SCALE], inverse[:, SCALE] = 0.0, 0.0
        return inverse * np.outer(unit, unit)

    reported = covariance(max(PATCHES * allowed_share**2, _FEWEST_PATCHES))  # R20a
    conservative = covariance(_FEWEST_PATCHES) if beyond_model_mm > 0 else reported
    off_mm2 = float((conservative * _gram(surface)).sum()) / len(surface.vertices)  # R22, first term
    return Posterior(reported, variance, float(np.sqrt(max(off_mm2, 0.0))))


def covariance_of_landmarks(known: Posterior, surface: ModelSurface, landmarks: SurfaceLandmarks) -> FloatArray:
    """Return the covariance (L, 3, 3), mm^2 of the model's frame, of the positions of landmarks.

    It is the covariance of the sum of the effects of pose, coefficients and off-model modes.
    """
    pose = small_poses(landmarks.interpolate(surface.vertices)).reshape(len(landmarks), 3, POSE)
    rows = np.concatenate([pose, landmarks.interpolate(surface.modes)], axis=2)
    return rows @ known.covariance @ rows.transpose(0, 2, 1)


@cached_with_owner()
def variance_of_new_shapes(model: ShapeModel) -> FloatArray:
    """Return the variance (K,), mm^2, that a shape outside the training set has along each mode.

    Variances that were estimated on held-out shapes are used unchanged. The result is never below the model's own
    variances: a spectrum of few modes determines no density, and its prediction can be far too small.
    """
    own = model.stddev**2
    if model.held_out:
        return own
    return np.maximum(own, variances_of_new_shapes(own, model.total_variance, model.n_training))


def lack_of_new_shapes(model: ShapeModel) -> float:
    """Return the RMS distance over the vertices, mm, of a new shape from the span of the model, from its spectrum.

    A training shape lies 1 / (G^-1)_ii outside the span of the others, G their Gram matrix; that is about N times the
    harmonic mean of the variances. The variance of discarded modes is added. If the variances were estimated on
    held-out shapes, new shapes lie only these discarded modes outside the model.
    """
    spectrum = whole_spectrum(model.stddev**2, model.total_variance, model.n_training)
    left = float(spectrum[model.n_modes :].sum())
    outside = 0.0 if model.held_out else model.n_training / float((1.0 / spectrum).mean())
    return float(np.sqrt((left + outside) / model.n_vertices))


def _gram(surface: ModelSurface) -> FloatArray:
    """Return the inner products (7 + K + R, 7 + K + R), over the surface, of the displacements by each parameter."""
    flat, modes = small_poses(surface.vertices), surface.modes
    gram = np.eye(POSE + modes.shape[2])
    gram[:POSE, :POSE] = flat.T @ flat
    cross = flat.astype(np.float32).T @ modes.reshape(-1, modes.shape[2])
    gram[:POSE, POSE:], gram[POSE:, :POSE] = cross, cross.T
    return gram
