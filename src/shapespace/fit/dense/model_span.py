"""Projection of a fitted surface onto the span of the model.

A surface outside the span of the model is projected onto it. Ordinary least squares would give weak modes, and modes
close to motions of the pose, large coefficients for a negligible gain; the prior keeps them plausible.
"""

from __future__ import annotations

import numpy as np

from shapespace.fit.robust.normal_equations import Estimate, small_similarity
from shapespace.fit.robust.prepared_model import PreparedModel
from shapespace.geometry.similarity import POSE
from shapespace.types import FloatArray


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

    Args:
        prepared: the model.
        vertices: (V, 3) in the model's order, in its frame.
        estimate: pose of that frame in the scan's; what the modes left out have done to the pose is given back to it.
        prior_stddev: (K,) of the coefficients, mm.
        uncertainty_mm: how well the surface is known, RMS over its vertices.
        modes: how many.
        with_scale: False keeps the scale.
    """
    P, free = prepared.model.vertex_basis[:, :modes], POSE if with_scale else POSE - 1
    pose, inside = prepared.pose[:, :free], prepared.pose_in_span[:modes, :free]
    noise = uncertainty_mm**2 / 3.0
    kept_share = prior_stddev[:modes] ** 2 / (prior_stddev[:modes] ** 2 + noise)
    y = (vertices - prepared.model.mean_vertices).ravel()
    b = P.T @ y
    # What leaves the span may have moved the pose as far as it reaches itself, and hardly further.
    residual_energy = max(float(y @ y - b @ b), 0.0) + len(y) * noise
    unit = 1.0 / np.linalg.norm(pose, axis=0)
    normal = (pose.T @ pose - (inside.T * kept_share) @ inside) * np.outer(unit, unit)
    normal[np.diag_indices(free)] += noise / residual_energy
    delta = np.zeros(POSE)
    delta[:free] = unit * np.linalg.solve(normal, unit * (pose.T @ y - inside.T @ (kept_share * b)))  # R18
    small = small_similarity(delta)
    y = (small.inverse().apply(vertices) - prepared.model.mean_vertices).ravel()
    return Estimate(estimate.T_scan_model @ small, kept_share * (P.T @ y))  # R19
