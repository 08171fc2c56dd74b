"""Prediction of the other parts of a subject, and of their relative pose, from a scan of one part (S9, S10).

A part does not determine its relative pose, so the parts that a scan does not show are predicted by a regression on the
shape of the part, whose errors are those of training shapes that are held out. Equation numbers are those of
docs/structures.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.errors import InputError
from shapespace.fit.completion.shape_posterior import DRAWS, predictive_covariance, root_of, second_moments
from shapespace.fit.completion.surface_calibration import SurfaceCalibration
from shapespace.fit.iteration_state import MATCHED
from shapespace.fit.result import FitResult
from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.prepared_model import ModelSurface, prepare
from shapespace.geometry.articulation import Articulation
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.region import ModelRegion, RegionPrediction
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Similarity


@dataclass(frozen=True, eq=False)
class PartPrediction:
    """Distribution of all parts given a scan of one part; its common attributes are as in `ShapePosterior`.

    Args:
        T_scan_model: pose, from the model's frame to the scan's mm frame.
        surface: mean surface, mm of the model's frame.
        b: (K,) predicted coefficients, mm.
        n_modes: K.
        mean_square_z: mean square of the coefficients of the part in its standard deviations.
        amplitude: 1, since errors are those of training shapes and need no off-model variation.
        noise_mm: robust standard deviation of the residuals of the part, mm of the model's frame.
        followed: (V,) True where a scan point is matched.
        covered_mismatch_mm: RMS distance of the matched vertices from the scan, mm of the model's frame.
        part_error_mm: expected error of the vertices of the part itself, mm of the model's frame.
        model: the model, with all modes of its training shapes.
        region: the part that the scan shows.
        score: (K',) coefficients of the part, mm.
        own: (V', 3) vertices of the part in its own frame, mm.
        prediction: prediction of the coefficients, with the errors of held-out training shapes.
    """

    T_scan_model: Similarity
    surface: ModelSurface
    b: FloatArray
    n_modes: int
    mean_square_z: float
    amplitude: float
    noise_mm: float
    followed: BoolArray
    covered_mismatch_mm: float
    part_error_mm: float
    model: ShapeModel
    region: ModelRegion
    score: FloatArray
    own: FloatArray
    prediction: RegionPrediction

    def vertex_covariance(self) -> FloatArray:
        """Return the (V, 3, 3) covariance, mm^2, of each vertex position about the mean surface, from samples."""
        return second_moments(self._draws) + np.eye(3) * self.part_error_mm**2 / 3.0

    def draw_displacements(self, count: int, rng: np.random.Generator) -> Float32Array:
        """Return (count, V, 3) float32 displacements from the mean surface, mm of the model's frame."""
        root = root_of(predictive_covariance(self.prediction.errors))
        steps = (root @ rng.standard_normal((root.shape[1], count))).T
        return np.stack([self._moved(self.b + step) for step in steps])

    def main_mode(self) -> FloatArray:
        """Return the (V, 3) displacement of one standard deviation along the first principal component, mm."""
        draws = self._draws.reshape(len(self._draws), -1)
        _, singular, axes = np.linalg.svd(draws, full_matrices=False)
        return np.asarray(axes[0] * singular[0] / np.sqrt(len(draws)), dtype=np.float64).reshape(-1, 3)

    def calibration(self, missing: BoolArray) -> SurfaceCalibration:
        """Return the predictions of the training shapes, each by the regression on the other shapes.

        Args:
            missing: (V,) True where the scan shows nothing.
        """
        model, known = self.model, self.prediction
        shapes = np.stack([model.reconstruct(c) for c in known.coefficients])
        errors, mean_errors = np.empty_like(shapes), np.empty_like(shapes)
        for i, c in enumerate(known.coefficients):
            own = self._articulation.shape_of_part(model.vector(c), self._part)[:, :, 0]
            errors[i] = self._placed(c + known.errors[i], own, shapes[i]) - shapes[i]
            mean_errors[i] = self._on_part(model.mean_vertices, shapes[i]) - shapes[i]
        shifts = np.stack([self._moved(self.b + shift) for shift in known.shifts(self.score)])
        return SurfaceCalibration(
            shapes.astype(np.float32), errors.astype(np.float32), mean_errors.astype(np.float32), shifts, missing, True
        )

    @property
    def _articulation(self) -> Articulation:
        assert self.model.articulation is not None
        return self.model.articulation

    @property
    def _part(self) -> int:
        part = self._articulation.part_with(self.region.inside)
        assert part is not None
        return part

    def _on_part(self, vertices: FloatArray, target: FloatArray) -> FloatArray:
        """Return `vertices` (V, 3) moved rigidly, so that the part is on that of `target`."""
        inside = self.region.inside
        return fit_similarity(vertices[inside], target[inside], with_scale=False).apply(vertices)

    def _placed(self, b: FloatArray, own: FloatArray, target: FloatArray) -> FloatArray:
        """Return the vertices (V, 3) with coefficients `b`, and with the part in its own shape on `target` (S9)."""
        tangent = self.model.vector(b).reshape(-1, 3)
        return self._on_part(self._articulation.decode(tangent, self._part, own), target)

    @cached_property
    def _draws(self) -> Float32Array:
        return self.draw_displacements(DRAWS, np.random.default_rng(0))

    def _moved(self, b: FloatArray) -> Float32Array:
        """Return the displacement (V, 3) of the surface with other coefficients and the same part in the same place."""
        vertices = self.surface.vertices
        return (self._placed(b, self.own, vertices) - vertices).astype(np.float32)


def predict_parts(fit: FitResult, T_mm_scan: Similarity) -> PartPrediction:
    """Return the prediction of all parts from the fit of one part.

    Args:
        fit: a fit restricted to a part of a model whose relative pose is modelled.
        T_mm_scan: transform from the scan's own frame to its mm frame.

    Raises:
        InputError: the model does not contain its training shapes, whose errors the distribution needs.
    """
    model, name = fit.model.with_all_modes, fit.config["region"]
    region = ModelRegion.of(model, name)
    prediction = region.prediction
    if prediction is None:
        raise InputError(
            "The prediction of other parts needs the training shapes of a model whose relative pose is modelled; build "
            "it with --relative-pose modelled, and omit --without-training-shapes."
        )
    inside, articulation = region.inside, model.articulation
    assert articulation is not None and fit.evidence is not None
    seen_mm = T_mm_scan.apply(fit.surface().vertices)[inside]
    score = region.model.project(seen_mm)
    own, b = region.model.reconstruct(score), region.to_b(score, model)
    vertices = articulation.decode(model.vector(b).reshape(-1, 3), articulation.part_with(inside), own)
    T = fit_similarity(vertices[inside], seen_mm, with_scale=model.gauge == "shape")
    spread_mm = fit.evidence.spread_mm / T.scale
    return PartPrediction(
        T_scan_model=T, surface=ModelSurface.of(prepare(model).topology, vertices), b=b, n_modes=model.n_modes,
        mean_square_z=float((score**2 / region.model.stddev**2).mean()), amplitude=1.0, noise_mm=spread_mm,
        followed=np.isin(fit.regions, MATCHED) & inside, covered_mismatch_mm=spread_mm,
        part_error_mm=fit.evidence.posterior_error_mm / T.scale, model=model, region=region, score=score, own=own,
        prediction=prediction,
    )  # fmt: skip
