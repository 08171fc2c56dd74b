"""A model of a part of its surface, for fits that are restricted to a region, and the relative poses of parts.

The region's vertices vary as in the complete model: the modes of the part are the principal components of the
model's own modes there, and each coefficient vector of the part corresponds to one of the model. So the surface beyond
the region does not affect the fit, whose result is given in the coefficients of the complete model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.articulation import Articulation, PartPoses
from shapespace.geometry.normals import without_vertices
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel, region_vertices
from shapespace.types import BoolArray, FloatArray

_FAINTEST = 1e-7
"""Share of the first standard deviation below which a mode of the part is rounding error."""
_MAX_PARTS = 4
"""Largest number of parts of one model in the cache; the fits of a batch share one."""


_RIDGES = np.geomspace(1e-6, 1e2, 25)
"""Ridges that are compared, in units of the sum of squares of the part's first mode."""
_MOST_LEVERAGE = 1.0 - 1e-9  # of a shape in a regression


@dataclass(frozen=True, eq=False)
class RegionPrediction:
    """Ridge regression of the coefficients of a model on those of a part, in the training shapes (S10).

    All modes of a part determine those of the complete model in the training set, but not in new subjects, since a part
    does not determine its relative pose. So the ridge is that of the smallest error of held-out training shapes.

    Args:
        scores: (n, K') coefficients of the part, mm, about their mean.
        coefficients: (n, K) coefficients of the model, mm.
        errors: (n, K) predictions minus `coefficients`, each by the regression on the other shapes.
        ridge: mm^2, added to the sums of squares of the scores.
    """

    scores: FloatArray
    coefficients: FloatArray
    errors: FloatArray
    ridge: float

    @staticmethod
    def of(scores: FloatArray, coefficients: FloatArray) -> RegionPrediction:
        """Return the regression with the ridge of the smallest squared error."""
        scores = scores - scores.mean(axis=0)
        left, singular, _ = np.linalg.svd(scores, full_matrices=False)
        centred, n = coefficients - coefficients.mean(axis=0), len(scores)

        def errors(ridge: float) -> FloatArray:
            kept = left * (singular**2 / (singular**2 + ridge))
            leverage = np.minimum(np.einsum("nk,nk->n", kept, left) + 1.0 / n, _MOST_LEVERAGE)
            return (kept @ (left.T @ centred) - centred) / (1.0 - leverage)[:, None]

        found = [(errors(float(ridge)), float(ridge)) for ridge in _RIDGES * singular[0] ** 2]
        best, ridge = min(found, key=lambda pair: float((pair[0] ** 2).sum()))
        return RegionPrediction(scores, coefficients, best, ridge)

    def shifts(self, score: FloatArray) -> FloatArray:
        """Return the changes (n, K) of the prediction from `score` (K',) if each shape is held out in turn."""
        precision = self.scores.T @ self.scores + self.ridge * np.eye(self.scores.shape[1])
        influence = 1.0 / len(self.scores) + self.scores @ np.linalg.solve(precision, score)
        return influence[:, None] * self.errors


@dataclass(frozen=True, eq=False)
class ModelRegion:
    """A part of a model.

    Args:
        model: shape model of the part alone, K' modes.
        inside: (V,) True for the vertices of the complete model that are in the part.
        lift: (K, K') from z of the part to z of the complete model; its columns are orthonormal.
        prediction: prediction of the complete model from the part, if its relative pose to other parts is modelled and
            the model contains its training shapes; None otherwise.
    """

    model: ShapeModel
    inside: BoolArray
    lift: FloatArray
    prediction: RegionPrediction | None = None

    @property
    def reliability(self) -> FloatArray:
        """(K',) share of each mode of the part, 0 to 1, that is used to predict the rest of the model."""
        ridge = 0.0 if self.prediction is None else self.prediction.ridge / (len(self.prediction.scores) - 1)
        return self.model.stddev**2 / (self.model.stddev**2 + ridge)

    @staticmethod
    def of(full: ShapeModel, region: str | tuple[int, ...]) -> ModelRegion:
        """Return the part of the model `full` in `region`: the name of one of its regions, or numbers of vertices.

        Raises:
            InputError: there is no such region, or no triangle lies in it.
        """
        return _build_part(full, region)

    def to_b(self, b: FloatArray, full: ShapeModel) -> FloatArray:
        """Return the coefficients (K,) mm of the complete model for the coefficients `b` (k,) mm of the part."""
        return full.stddev * (self.lift[:, : len(b)] @ (self.reliability[: len(b)] * b / self.model.stddev[: len(b)]))

    def to_covariance(self, b_covariance: FloatArray, full: ShapeModel, variance: FloatArray) -> FloatArray:
        """Return the covariance (K, K) mm^2 of the complete model's coefficients, from that of the part's.

        Args:
            b_covariance: (K', K') covariance of all coefficients of the part, mm^2.
            full: the complete model.
            variance: (K,) prior variances of the complete model's coefficients, mm^2, for the directions that no vertex
                of the part shows.
        """
        to = full.stddev[:, None] * self.lift * self.reliability / self.model.stddev
        unseen = np.eye(len(self.lift)) - (self.lift * self.reliability) @ self.lift.T
        stddev = np.sqrt(variance)
        return to @ b_covariance @ to.T + stddev[:, None] * unseen * stddev


def _in_own_frame(full: ShapeModel, articulation: Articulation, inside: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (V', 3) and the modes (3V', K) of vertices of one part without its motion; both are exact.

    Raises:
        InputError: the vertices belong to several parts, whose relative pose is not linear in the coefficients.
    """
    part = articulation.part_with(inside)
    if part is None:
        raise InputError(
            f"The relative pose of {', '.join(full.parts)} is modelled, so a region lies in one part; give one of "
            "these parts, or vertices of a single part."
        )
    own = inside[articulation.slices[part]]
    mean, modes = articulation.shape_of_part(full.vector(), part), articulation.shape_of_part(full.basis, part)
    return mean[own, :, 0], modes[own].reshape(-1, full.n_modes)


@cached_with_owner(limit=_MAX_PARTS)
def _build_part(full: ShapeModel, region: str | tuple[int, ...]) -> ModelRegion:
    if isinstance(region, str):
        if region not in full.regions:
            there = f"it has {', '.join(full.regions)}" if full.regions else "it has none"
            raise InputError(
                f"The model has no region {region!r} ({there}); give one of its regions, or a CSV file of vertices, or "
                "build the model with --region NAME=FILE."
            )
        vertices = full.regions[region]
    else:
        vertices = region_vertices(region, full.n_vertices, "given")
    inside = np.zeros(full.n_vertices, dtype=np.bool_)
    inside[vertices] = True
    mean, faces = full.mean_vertices[inside], full.faces
    if faces is not None:
        mean, faces = without_vertices(full.mean_vertices, faces, inside)
        if not len(faces):
            raise InputError("No triangle of the model lies in the region; give a region with complete triangles.")
    rows = full.vertex_basis.reshape(full.n_vertices, 3, -1)[inside].reshape(3 * len(mean), -1)
    if full.articulation is not None:
        mean, rows = _in_own_frame(full, full.articulation, inside)
    basis, stddev, lift = np.linalg.svd(rows * full.stddev, full_matrices=False)
    significant = stddev > _FAINTEST * stddev[0]
    model = ShapeModel(
        mean=mean.ravel(),
        basis=basis[:, significant],
        stddev=stddev[significant],
        total_variance=float((stddev**2).sum() * full.total_variance / (full.stddev**2).sum()),
        n_training=full.n_training,
        faces=faces,
        gauge=full.gauge,
        landmarks=full.landmarks.renumbered(inside),
        held_out=full.held_out,
        is_n_training_known=full.is_n_training_known,
    )
    lift, prediction = lift[significant].T, None
    if not full.is_linear and full.training is not None:
        b = full.training.coefficients[:, : full.n_modes]
        prediction = RegionPrediction.of((b / full.stddev) @ lift * model.stddev, b)
    return ModelRegion(model, inside, lift, prediction)


_STILL = 1e-6  # share of the SD of the first mode; smaller rotations, as movements of vertices, are rounding


@dataclass(frozen=True)
class JointSpread:
    """Standard deviations of the pose of a part relative to its parent, of the modes of a model.

    Args:
        part: name of the part.
        parent: name of its parent.
        rotation_deg: square root of the sum of the variances of the three components of its rotation vector, degrees.
        translation_mm: the same of its translation at the joint, mm.
    """

    part: str
    parent: str
    rotation_deg: float
    translation_mm: float


@dataclass(frozen=True)
class RelativePose:
    """Relative pose of the parts of a model.

    Args:
        choice: `modelled`: with exact rotations; `kept`: linearly, with the vertices; `removed`: no mode turns a part.
        joints: spread at each joint; of linear models to first order; empty if the relative pose is removed.
    """

    choice: Literal["modelled", "kept", "removed"]
    joints: tuple[JointSpread, ...]


def articulation_of(model: ShapeModel) -> Articulation:
    """Return the joints of a model of several parts: its own, or else those of its mean shape."""
    return model.articulation or Articulation(model.mean_vertices, list(model.part_counts.values()))


def relative_pose(model: ShapeModel) -> RelativePose | None:
    """Return the relative pose of the parts of a model, exactly from its modes; None if it has one structure."""
    if not model.parts:
        return None
    articulation = articulation_of(model)
    moves = (model.vertex_basis * model.stddev).T.reshape(model.n_modes, -1, 3)
    poses = [articulation.from_tangent(articulation.template + move) for move in moves]  # linear in the displacement
    rotation, translation = (_spread(poses, field) for field in ("rotation", "translation"))
    if float((rotation * articulation.levers_mm).max()) < _STILL * model.stddev[0]:
        return RelativePose("removed", ())
    joints = [
        JointSpread(model.parts[joint.part], model.parts[joint.parent], math.degrees(turn), shift)
        for joint, turn, shift in zip(articulation.joints, rotation.tolist(), translation.tolist(), strict=True)
    ]
    return RelativePose("kept" if model.is_linear else "modelled", tuple(joints))


def _spread(poses: list[PartPoses], field: Literal["rotation", "translation"]) -> FloatArray:
    """Return the root of the sum of the squares of a coordinate (P - 1, 3) over modes and axes, (P - 1,)."""
    return np.sqrt(sum((getattr(pose, field) ** 2).sum(axis=1) for pose in poses))
