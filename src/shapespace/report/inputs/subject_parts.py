"""Parts of one subject in a model or a correspondence, and the spread of their relative poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from shapespace.geometry.articulation import Articulation, PartPoses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray

_STILL = 1e-6  # share of the SD of the first mode; smaller rotations, as movements of vertices, are rounding


@dataclass(frozen=True, eq=False)
class Parts:
    """Names of parts, and the part of each vertex.

    Args:
        names: names, in the order of the vertices.
        labels: (V,) uint8 index of the part of each vertex.
    """

    names: tuple[str, ...]
    labels: npt.NDArray[np.uint8]

    @staticmethod
    def of_counts(counts: Mapping[str, int]) -> Parts | None:
        """Return the parts with these numbers of vertices; None if there are none."""
        labels = np.repeat(np.arange(len(counts), dtype=np.uint8), list(counts.values()))
        return Parts(tuple(counts), labels) if counts else None

    @staticmethod
    def of(model: ShapeModel) -> Parts | None:
        """Return the parts of a model; None if it has one structure."""
        return Parts.of_counts(model.part_counts)


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
