"""How well a robust fit knows what it found: the joint posterior of pose and coefficients, tempered and calibrated.

At the optimum the cost of `robust` is near quadratic, so the inverse of its Hessian is the covariance of pose,
coefficients and residual modes together (Laplace). The block of b in the full inverse has the pose marginalised. Taken
as it stands it is far too small, since residuals that share a cause are counted as independent. So the data's part of
the Hessian is divided by a temperature before the prior joins it again: what the scan does not show stays at the prior.
Equation numbers are those of docs/robust.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from shapespace.fit.landmark_terms import worth
from shapespace.fit.robust.matching import Weights
from shapespace.fit.robust.normal_equations import SCALE, NormalEquations, Prior
from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import POSE, small_poses
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.new_shapes import variances_of_new_shapes, whole_spectrum
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, SurfaceLandmarks

# Chosen on the split "dev" of `benchmarks/calibration.py`, so that 68 % and 95 % of the truth lie where they should.
NOISE_TEMPERATURE = 1.7
# independent patches of a completely observed surface, as neighbouring residuals are correlated (R20a)
PATCHES = 300.0
_FEWEST_PATCHES = 100.0

"""Of each model in use: it takes longer to find than the rest of the posterior."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known of pose and coefficients beside their values.

    Args:
        covariance: (7 + K + R, 7 + K + R) of turn (radians), shift (mm), log scale, the model's K coefficients and
            those of R modes beside it (mm).
        prior_variance: (K + R,) of the coefficients before the scan was seen, mm^2.
        surface_mm: RMS over the vertices by which the fitted surface is expected to be off, by the darker view of what
            the model lacks, on which the verdict was tuned.
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
    """Return what is known at the end of a fit (R20-R22).

    Args:
        model: the shape space.
        surface: where it ended, with all modes that were free.
        prior: that the fit went by.
        equations: there.
        weights: of the matches there.
        sigma_mm: spread of the residuals there.
        beyond_model_mm: RMS of what the model left of the residuals.
        allowed_share: of the vertices whose match is no border and faces as the model does.
    """
    K, n = model.n_modes, POSE + len(prior.stddev)
    variance = np.concatenate([variance_of_new_shapes(model), prior.stddev[K:] ** 2])
    H = equations.H / sigma_mm**2
    if equations.holds_scale:
        H[SCALE], H[:, SCALE] = 0.0, 0.0
    matches = float(weights.points.sum()) + float(weights.vertices.sum())
    size_mm = rms_size(model.mean_vertices)
    # Scaled to standard deviations, so that one small damping suits turns, millimetres and coefficients alike.
    scale_stddev = prior.scale_stddev or 1.0
    unit = np.concatenate([np.ones(3), np.full(3, size_mm), [scale_stddev], np.sqrt(variance)])
    prior_precision = np.concatenate([np.full(POSE - 1, 1e-9), np.ones(n - POSE + 1)])

    def covariance(patches: float) -> FloatArray:
        # What the model lacks is shared by all matches of a patch, and noise nearly independent from match to match.
        temperature = NOISE_TEMPERATURE + matches / patches * (beyond_model_mm / sigma_mm) ** 2  # R20
        scaled = H / temperature * np.outer(unit, unit)
        if equations.H_landmarks is not None:
            # Weighed up in a step by what matches are worth, they are what they are beside tempered ones.
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

    Those of the model are taken as they are where they were found on shapes left out. Never below the model's own: a
    spectrum of few modes tells no density, and what it foretells of them can be far too little.
    """
    own = model.stddev**2
    if model.held_out:
        return own
    return np.maximum(own, variances_of_new_shapes(own, model.total_variance, model.n_training))


def lack_of_new_shapes(model: ShapeModel) -> float:
    """Return how far, RMS over the vertices, mm, a new shape of the kind lies outside the model, by its spectrum.

    A training shape lies 1 / (G^-1)_ii outside the span of the others, G their Gram matrix; that is about N times the
    harmonic mean of the variances. What modes that were cut off held comes on top. Where variances were found on shapes
    left out, what they leave is what new shapes leave.
    """
    spectrum = whole_spectrum(model.stddev**2, model.total_variance, model.n_training)
    left = float(spectrum[model.n_modes :].sum())
    outside = 0.0 if model.held_out else model.n_training / float((1.0 / spectrum).mean())
    return float(np.sqrt((left + outside) / model.n_vertices))


def _gram(surface: ModelSurface) -> FloatArray:
    """Return (7 + K + R, 7 + K + R): inner products over the surface of what each parameter moves."""
    flat, modes = small_poses(surface.vertices), surface.modes
    gram = np.eye(POSE + modes.shape[2])
    gram[:POSE, :POSE] = flat.T @ flat
    cross = flat.astype(np.float32).T @ modes.reshape(-1, modes.shape[2])
    gram[:POSE, POSE:], gram[POSE:, :POSE] = cross, cross.T
    return gram
