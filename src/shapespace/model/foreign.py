"""From a model of another tool to one of ours and back: orthonormal modes in mm, with variances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import ORTHOGONAL, LinearModel, Modes, orthonormal
from shapespace.io.containers.hdf5 import is_ours
from shapespace.model.model_file import ModelFields
from shapespace.types import FloatArray

OWN_ENDINGS = (".h5", ".hdf5")


@dataclass(frozen=True, eq=False)
class Foreign:
    """What a model file of another tool holds, as ours would.

    Args:
        fields: of the shape model; of identity and expression together where the file parts them.
        rotation: (K, K) from z to identity and expression, or None where the file does not part them.
        n_identity: how many rows of `rotation` are identity.
        format: the format in words.
        notes: sentences on what was kept, changed or left out.
    """

    fields: ModelFields
    rotation: FloatArray | None
    n_identity: int
    format: str
    notes: tuple[str, ...]


def is_foreign(path: Path) -> bool:
    """Whether `path` is there and is a model of another tool."""
    if is_ours(path):
        return False
    from shapespace.formats.registry import is_known  # all formats, a third of what it takes to load a model

    return is_known(path)


def looks_like_model(path: Path) -> bool:
    """Whether `path` is named as a model of shapespace, or is one of another tool."""
    return (path.suffix.lower() in OWN_ENDINGS and not path.is_dir()) or is_foreign(path)


def load_foreign(path: Path, mm: float | None = None, expressions: Path | None = None) -> Foreign:
    """Return the model in `path`, in whatever format of another tool it is.

    Args:
        path: a file or a folder.
        mm: how many mm one unit of it is; None for what its format says, or 1.
        expressions: a file of blendshapes that belong to it, in the same unit; None for those that it brings.

    Raises:
        FileError: it cannot be read.
        ModelFileError: it is in no known format, damaged, or holds no variation; or the expressions are of another.
    """
    from shapespace.formats.registry import read_linear

    model_format, linear = read_linear(path)
    if expressions is not None:
        linear = _with_expressions(linear, path, expressions)
    notes = list(linear.notes)
    if mm is None and linear.mm is None:
        notes.append("The file names no unit; mm are taken.")
    mm = mm or linear.mm or 1.0
    if mm != 1.0:
        notes.append(f"Lengths are multiplied by {mm:g} to be mm.")
    moved, n_identity = linear.shape.moved, linear.shape.moved.shape[1]
    if linear.expression is not None:
        moved = np.concatenate([moved, linear.expression.moved], axis=1)
    basis, stddev, right = orthonormal(moved * mm)
    if not len(stddev):
        raise ModelFileError(f"{path} holds no variation, only a mean; read that as a mesh instead.")
    notes += _changes(moved, len(stddev), parted=linear.expression is not None)
    rotation = None
    if linear.expression is not None and len(stddev) == moved.shape[1]:
        rotation = right
    elif linear.expression is not None:
        notes.append("Identity and expression share modes, so they cannot be separated and are treated as one.")
    if linear.n_training is None and not linear.held_out:
        notes.append(f"It does not say of how many shapes it was made; {len(stddev) + 1} are taken.")
    fields: ModelFields = {
        "mean": linear.mean.ravel() * mm,
        "basis": basis,
        "stddev": stddev,
        "total_variance": _total_variance(linear, stddev, mm),
        "n_training": linear.n_training or len(stddev) + 1,
        "faces": linear.faces,
        # Others align rigidly and leave size in the modes.
        "gauge": "form",
        "landmarks": replace(linear.landmarks, distance_mm=linear.landmarks.distance_mm * mm),
        "representation": "vertices",
        "coding": {},
        "provenance": linear.provenance,
        "licence": linear.licence,
        "held_out": linear.held_out,
        "residuals": None,
        "regions": {},
        "is_n_training_known": linear.n_training is not None,
        "training": None,
        "dropped_vertices": np.zeros(0, dtype=np.int32),
        "notes": (),
    }
    return Foreign(fields, rotation, n_identity, model_format.title, tuple(notes))


def _total_variance(linear: LinearModel, stddev: FloatArray, mm: float) -> float:
    """Return the total variance that the file states, mm^2, if it does and it is above that of the modes."""
    of_modes = float((stddev**2).sum())
    total = 0.0
    for block in (linear.shape, linear.expression):
        if block is not None:
            if block.total_variance is None:
                return of_modes
            total += block.total_variance
    return max(of_modes, total * mm**2)


def as_linear(fields: ModelFields, mean: FloatArray, directions: FloatArray) -> LinearModel:
    """Return what other formats can hold of a model of ours.

    Args:
        fields: of the model.
        mean: (V, 3) its vertices, mm.
        directions: (3V, K) how vertices move with each coefficient, mm.
    """
    left = fields["total_variance"]
    return LinearModel(
        mean=mean,
        shape=Modes(directions * fields["stddev"], total_variance=left),
        faces=fields["faces"],
        mm=1.0,
        landmarks=fields["landmarks"],
        n_training=fields["n_training"],
        held_out=fields["held_out"],
        provenance=fields["provenance"],
        licence=fields["licence"],
    )


def parted(linear: LinearModel, rotation: FloatArray, n_identity: int) -> LinearModel:
    """Return `linear` with its modes turned into those of identity and of expression: z = rotation.T @ [a; e]."""
    moved = linear.shape.moved @ rotation.T
    total = linear.shape.total_variance
    return replace(
        linear,
        shape=Modes(moved[:, :n_identity], total_variance=total),
        # That of both is held by the shape alone.
        expression=Modes(moved[:, n_identity:], total_variance=None if total is None else 0.0),
    )


def _with_expressions(linear: LinearModel, path: Path, expressions: Path) -> LinearModel:
    from shapespace.formats.eos import read_blendshapes

    block = read_blendshapes(expressions)
    if linear.expression is not None:
        raise ModelFileError(f"{path} has expressions of its own; leave those in {expressions} out.")
    if len(block.moved) != linear.mean.size:
        raise ModelFileError(
            f"{expressions} is of {len(block.moved) // 3} vertices, and {path} has {len(linear.mean)}; give the "
            "blendshapes of that model."
        )
    combined = replace(linear, expression=block)
    combined.check(expressions)
    return combined.noting(f"A weight of one of the {block.moved.shape[1]} blendshapes is one standard deviation.")


def _changes(moved: FloatArray, count: int, *, parted: bool) -> list[str]:
    length = np.linalg.norm(moved, axis=0)
    varies = length > 0
    unit = moved[:, varies] / length[varies]
    skew = float(np.abs(unit.T @ unit - np.eye(unit.shape[1])).max(initial=0.0))
    notes: list[str] = []
    if skew > ORTHOGONAL:
        subject = "Modes of identity and expression were" if parted else "The basis was"
        notes.append(f"{subject} not orthonormal (by {skew:.2g}) and made so, which keeps the covariance.")
    if count < moved.shape[1]:
        notes.append(f"{moved.shape[1] - count} of {moved.shape[1]} modes do not vary and are left out.")
    return notes
