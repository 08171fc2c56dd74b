"""How well a robust fit knows what it found: the joint posterior of pose and coefficients, tempered and calibrated.

At the optimum the cost of `robust` is near quadratic, so the inverse of its Hessian is the covariance of pose,
coefficients and residual modes together (Laplace). The block of b in the full inverse has the pose marginalised. Taken
as it stands it is far too small, since residuals that share a cause are counted as independent. So the data's part of
the Hessian is divided by a temperature before the prior joins it again: what the scan does not show stays at the prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from shapespace.fit.moving_model import POSE, small_poses
from shapespace.geometry.surface import rms_size
from shapespace.model.new_shapes import variances_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity

if TYPE_CHECKING:
    from shapespace.fit.robust import JointFit

_HALF = 0.5
_LEADING = 10
_NEAR = 0.05
"""A match counts at half weight; so many modes lead; near is this share of the model's size."""

# Chosen on the split "dev" of `benchmarks/calibration.py`, so that 68 % and 95 % of the truth lie where they should.
_NOISE_TEMPERATURE = 1.7
_PATCHES = 300.0
_FEWEST_PATCHES = 100.0

_new_shapes: WeakKeyDictionary[ShapeModel, FloatArray] = WeakKeyDictionary()
"""Of each model in use: it takes longer to find than the rest of the posterior."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known of a fit's coefficients beside their values.

    Args:
        b_stddev: (K,) standard deviation of each coefficient, mm; never above the model's.
        b_covariance: (K, K) of the coefficients, mm^2.
        shrinkage: (K,) in [0, 1]: 1 where the scan told the coefficient, 0 where only the prior did.
        evidence: what speaks for and against the fit, by name; the unit stands in the name.
    """

    b_stddev: FloatArray
    b_covariance: FloatArray
    shrinkage: FloatArray
    evidence: Mapping[str, float]


def posterior(fit: JointFit, T_scan_model: Similarity, b: FloatArray, beyond_model_mm: float) -> Posterior:
    """Return what `fit`, at its end, knows of the coefficients it reports.

    Args:
        fit: after its last step; it is not changed.
        T_scan_model: the pose reported, to the frame of `fit.T`.
        b: (K,) mm, the coefficients reported.
        beyond_model_mm: RMS of what the model left of the residuals.
    """
    model, x = fit.prepared.model, fit.surface.vertices
    if model not in _new_shapes:
        _new_shapes[model] = variance_of_new_shapes(model)
    new_shapes = _new_shapes[model]
    prior = np.concatenate([new_shapes, fit.stddev[model.n_modes :] ** 2])
    w, v = fit.weigh()
    matches, data = float(w.sum()) + float(v.sum()), data_hessian(fit)

    def covariance_of(patches: float) -> FloatArray:
        return _covariance(fit, data, prior, temperature(fit, matches, beyond_model_mm, patches))

    covariance = covariance_of(_patches(fit))
    K = len(b)
    variance = np.clip(covariance.diagonal()[POSE : POSE + K], 0.0, prior[:K])
    reported = (fit.T.inverse() @ T_scan_model).apply(model.reconstruct(b))
    left_out = float(((x - reported) ** 2).sum(axis=1).mean())
    # The verdict's weights were fitted to the darker view of what the model lacks.
    doubted = covariance_of(_FEWEST_PATCHES) if beyond_model_mm > 0 else covariance
    expected = float((doubted * _gram(fit)).sum()) / len(x)
    return Posterior(
        np.sqrt(variance),
        covariance[POSE : POSE + K, POSE : POSE + K],
        1.0 - variance / prior[:K],
        {
            **_matched(fit, v, fit.b[: model.n_modes] ** 2 / new_shapes),
            "spread_mm": fit.sigma_mm,
            "beyond_model_mm": beyond_model_mm,
            "left_out_mm": float(np.sqrt(left_out)),
            "expected_error_mm": float(np.sqrt(max(expected, 0.0) + left_out)),
        },
    )


def variance_of_new_shapes(model: ShapeModel) -> FloatArray:
    """Return the variance (K,), mm^2, that a shape outside the training set has along each mode.

    Those of the model are taken as they are where they were found on shapes left out.
    """
    own = model.stddev**2
    return own if model.held_out else variances_of_new_shapes(own, model.total_variance, model.n_training)


def temperature(fit: JointFit, matches: float, beyond_model_mm: float, patches: float) -> float:
    """Return how many residuals tell as much as one independent one.

    Noise is nearly independent from match to match. What the model lacks is not: all matches of a patch share it.
    """
    return _NOISE_TEMPERATURE + matches / patches * (beyond_model_mm / fit.sigma_mm) ** 2


def _patches(fit: JointFit) -> float:
    """Return into how many independent patches falls what the model lacks: fewer where less of it is seen."""
    assert fit.vertices is not None
    return max(_PATCHES * float(fit.vertices.allowed.mean()) ** 2, _FEWEST_PATCHES)


def data_hessian(fit: JointFit) -> FloatArray:
    """Return the Hessian (7 + K + R, 7 + K + R) of the data alone, divided by the residuals' variance."""
    n = len(fit.hessian)
    rho = fit.prior * fit.sigma_mm**2
    own = np.array(fit.hessian)
    index = np.arange(POSE, n)
    own[index, index] -= rho / fit.stddev[: n - POSE] ** 2
    if fit.with_scale:
        own[6, 6] -= rho / fit.settings.scale_stddev**2
    else:
        own[6], own[:, 6] = 0.0, 0.0
    whole = np.zeros((POSE + len(fit.stddev),) * 2)
    whole[:n, :n] = own / fit.sigma_mm**2
    return whole


def _covariance(fit: JointFit, data: FloatArray, prior: FloatArray, temperature: float) -> FloatArray:
    """Return the joint covariance (7 + K + R, 7 + K + R) of pose (radians, mm, log scale) and coefficients (mm)."""
    precision, size_mm = data / temperature, rms_size(fit.prepared.model.mean_vertices)
    # Scaled to standard deviations, so that one small damping suits turns, millimetres and coefficients alike.
    unit = np.concatenate([np.full(3, 1.0), np.full(3, size_mm), [fit.settings.scale_stddev], np.sqrt(prior)])
    scaled = precision * np.outer(unit, unit)
    scaled[np.diag_indices_from(scaled)] += np.concatenate([np.full(6, 1e-9), np.ones(len(unit) - 6)])
    inverse = np.asarray(cho_solve(cho_factor(scaled, lower=True), np.eye(len(unit))))
    if not fit.with_scale:
        inverse[6], inverse[:, 6] = 0.0, 0.0
    return inverse * np.outer(unit, unit)


def _gram(fit: JointFit) -> FloatArray:
    """Return (7 + K + R, 7 + K + R): inner products over the surface of what each parameter moves."""
    flat, modes = small_poses(fit.surface.vertices), fit.surface.modes
    gram = np.eye(POSE + modes.shape[2])
    gram[:POSE, :POSE] = flat.T @ flat
    cross = flat.astype(np.float32).T @ modes.reshape(-1, modes.shape[2])
    gram[:POSE, POSE:], gram[POSE:, :POSE] = cross, cross.T
    return gram


def _matched(fit: JointFit, v: FloatArray, z2: FloatArray) -> dict[str, float]:
    """Return how much of model and scan found a match, and how plausible pose and shape are.

    Args:
        fit: at its end.
        v: (M,) weights of its vertices' matches.
        z2: (K,) squares of its coefficients, in variances of new shapes.
    """
    scan, vertices, size_mm = fit.scan, fit.vertices, rms_size(fit.prepared.model.mean_vertices)
    assert scan is not None and vertices is not None
    return {
        "size_mm": size_mm,
        "seen_share": float((fit.seen_at > 0).mean()),
        "model_matched_share": float((v > _HALF * v.max()).mean()),
        "model_allowed_share": float(vertices.allowed.mean()),
        "scan_allowed_share": float(scan.allowed.mean()),
        "model_near_share": float((vertices.distance < _NEAR * size_mm).mean()),
        "z2": float(z2.mean()),
        "z2_leading": float(z2[:_LEADING].mean()),
        "log_scale": float(np.log(fit.T.scale)),
    }
