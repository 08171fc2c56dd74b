"""Conversion between models of other tools and shape models: orthonormal modes in mm, with variances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import ORTHOGONAL, LinearModel, Modes, orthonormal
from shapespace.geometry.articulation import regions_of_parts
from shapespace.io.containers.hdf5 import is_ours
from shapespace.model.model_file import ModelFields
from shapespace.types import FloatArray

OWN_ENDINGS = (".h5", ".hdf5")


@dataclass(frozen=True, eq=False)
class Foreign:
    """Content of a model file of another tool, as a shape model would represent it.

    Args:
        fields: fields of the shape model; of identity and expression together if the file separates them.
        rotation: (K, K) rotation from z to identity and expression; None if the file does not separate them.
        n_identity: number of rows of `rotation` that are identity.
        format: name of the format in words.
        notes: sentences on properties that were kept, changed or omitted.
    """

    fields: ModelFields
    rotation: FloatArray | None
    n_identity: int
    format: str
    notes: tuple[str, ...]


def is_foreign(path: Path) -> bool:
    """Whether `path` exists and is a model of another tool."""
    if is_ours(path):
        return False
    from shapespace.formats.registry import is_known  # all formats, a third of the time to load a model

    return is_known(path)


def looks_like_model(path: Path) -> bool:
    """Whether `path` is named as a model of shapespace, or is a model of another tool."""
    return (path.suffix.lower() in OWN_ENDINGS and not path.is_dir()) or is_foreign(path)


def load_foreign(path: Path, mm: float | None = None, expressions: Path | None = None) -> Foreign:
    """Return the model in `path`, in any known format of another tool.

    Args:
        path: a file or a folder.
        mm: length of one unit of the file, mm; None for the unit that its format states, or 1.
        expressions: file of blendshapes of the model, in the same unit; None for those in the file of the model.

    Raises:
        FileError: the file cannot be read.
        ModelFileError: the file is in no known format, damaged, or contains no variation; or the expressions are those
            of another model.
    """
    from shapespace.formats.registry import read_linear

    model_format, linear = read_linear(path)
    if expressions is not None:
        linear = _add_expressions(linear, path, expressions)
    notes = list(linear.notes)
    if mm is None and linear.mm is None:
        notes.append("The file states no unit; mm are assumed.")
    mm = mm or linear.mm or 1.0
    if mm != 1.0:
        notes.append(f"Lengths are multiplied by {mm:g} to be mm.")
    moved, n_identity = linear.shape.moved, linear.shape.moved.shape[1]
    if linear.expression is not None:
        moved = np.concatenate([moved, linear.expression.moved], axis=1)
    basis, stddev, right = orthonormal(moved * mm)
    if not len(stddev):
        raise ModelFileError(f"{path} contains no variation, only a mean; read that as a mesh instead.")
    notes += _describe_changes(moved, len(stddev), parted=linear.expression is not None)
    rotation = None
    if linear.expression is not None and len(stddev) == moved.shape[1]:
        rotation = right
    elif linear.expression is not None:
        notes.append("Identity and expression share modes, so they cannot be separated and are treated as one.")
    if linear.n_training is None and not linear.held_out:
        notes.append(f"It does not state the number of its training shapes; {len(stddev) + 1} are assumed.")
    fields: ModelFields = {
        "mean": linear.mean.ravel() * mm,
        "basis": basis,
        "stddev": stddev,
        "total_variance": _total_variance(linear, stddev, mm),
        "n_training": linear.n_training or len(stddev) + 1,
        "faces": linear.faces,
        # Other tools align rigidly and leave size in the modes.
        "gauge": "form",
        "landmarks": replace(linear.landmarks, distance_mm=linear.landmarks.distance_mm * mm),
        "representation": "vertices",
        "coding": {},
        "provenance": linear.provenance,
        "licence": linear.licence,
        "held_out": linear.held_out,
        "residuals": None,
        "regions": regions_of_parts(linear.parts),
        "parts": tuple(linear.parts),
        "is_n_training_known": linear.n_training is not None,
        "training": None,
        "dropped_vertices": np.zeros(0, dtype=np.int32),
        "notes": (),
    }
    return Foreign(fields, rotation, n_identity, model_format.title, tuple(notes))


def _total_variance(linear: LinearModel, stddev: FloatArray, mm: float) -> float:
    """Return the total variance that the file states, mm^2, if above that of the modes, else that of the modes."""
    of_modes = float((stddev**2).sum())
    total = 0.0
    for block in (linear.shape, linear.expression):
        if block is not None:
            if block.total_variance is None:
                return of_modes
            total += block.total_variance
    return max(of_modes, total * mm**2)


def as_linear(fields: ModelFields, mean: FloatArray, directions: FloatArray) -> LinearModel:
    """Return the part of a shape model that other formats can represent.

    Args:
        fields: fields of the model.
        mean: (V, 3) vertices of the mean, mm.
        directions: (3V, K) displacements of the vertices by each coefficient, mm.
    """
    left = fields["total_variance"]
    return LinearModel(
        mean=mean,
        shape=Modes(directions * fields["stddev"], total_variance=left),
        faces=fields["faces"],
        mm=1.0,
        landmarks=fields["landmarks"],
        n_training=fields["n_training"],
        parts={name: len(fields["regions"][name]) for name in fields["parts"]},
        held_out=fields["held_out"],
        provenance=fields["provenance"],
        licence=fields["licence"],
    )


def parted(linear: LinearModel, rotation: FloatArray, n_identity: int) -> LinearModel:
    """Return `linear` with its modes rotated into those of identity and of expression: z = rotation.T @ [a; e]."""
    moved = linear.shape.moved @ rotation.T
    total = linear.shape.total_variance
    return replace(
        linear,
        shape=Modes(moved[:, :n_identity], total_variance=total),
        # The block of the shape alone has the total variance of both.
        expression=Modes(moved[:, n_identity:], total_variance=None if total is None else 0.0),
    )


def _add_expressions(linear: LinearModel, path: Path, expressions: Path) -> LinearModel:
    from shapespace.formats.eos import read_blendshapes

    block = read_blendshapes(expressions)
    if linear.expression is not None:
        raise ModelFileError(f"{path} has expressions of its own; omit those in {expressions}.")
    if len(block.moved) != linear.mean.size:
        raise ModelFileError(
            f"{expressions} has {len(block.moved) // 3} vertices, and {path} has {len(linear.mean)}; give the "
            "blendshapes of that model."
        )
    combined = replace(linear, expression=block)
    combined.check(expressions)
    return combined.noting(f"A weight of 1 of the {block.moved.shape[1]} blendshapes is one standard deviation.")


def _describe_changes(moved: FloatArray, count: int, *, parted: bool) -> list[str]:
    length = np.linalg.norm(moved, axis=0)
    varies = length > 0
    unit = moved[:, varies] / length[varies]
    skew = float(np.abs(unit.T @ unit - np.eye(unit.shape[1])).max(initial=0.0))
    notes: list[str] = []
    if skew > ORTHOGONAL:
        subject = "Modes of identity and expression were" if parted else "The basis was"
        notes.append(f"{subject} not orthonormal (by {skew:.2g}) and orthonormalised, which keeps the covariance.")
    if count < moved.shape[1]:
        notes.append(f"{moved.shape[1] - count} of {moved.shape[1]} modes do not vary and are omitted.")
    return notes
