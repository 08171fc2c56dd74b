"""Linear models as files of other tools store them, and the protocols of readers and writers.

Modes are held as what one standard deviation of each does, U sqrt(lambda), in the unit of the file: every convention of
basis and spread is that product, and a basis that is not orthonormal loses nothing by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
from scipy.linalg import qr, svd
from threadpoolctl import threadpool_limits

from shapespace.errors import ModelFileError
from shapespace.types import FloatArray, IntArray, SurfaceLandmarks, read_only

ORTHOGONAL: Final = 1e-3  # largest |U^T U - I|; single precision stays below
_LARGEST = 1e30  # coordinates whose squares stay finite in float64
_NO_STDDEV = 1e-6
"""Of the largest one; what single precision makes of a mode that is not there."""


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of one kind: x = mean + moved @ z, with z independent and of variance 1.

    Args:
        moved: (3V, K) what one standard deviation of each does to x, y, z of vertex 0, then of vertex 1, and so on.
        names: (K,) or none.
        total_variance: of all modes, those that the file does not hold too, in the file's unit squared; None where it
            does not say.
    """

    moved: FloatArray
    names: tuple[str, ...] = ()
    total_variance: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "moved", read_only(self.moved))


@dataclass(frozen=True, eq=False)
class LinearModel:
    """One linear shape model as stored in a file.

    Args:
        mean: (V, 3) vertices where all coefficients are zero, with the mean of the expressions.
        shape: its modes; of identity alone where `expression` is there.
        expression: modes that come on top of those of identity, or None.
        faces: (M, 3) counter-clockwise from outside, or None for a point model.
        mm: how many mm one unit of the file is; None where the format does not say, which is then taken as mm.
        landmarks: named points on the surface; a mapping of name to vertex may be given for those at vertices.
        n_training: how many shapes it was made of; None where the file does not say.
        held_out: whether its variances hold for new shapes as they stand, as those of a Gaussian process do; those of
            the shapes that the modes were found in do not.
        provenance: what it was made from, in words.
        licence: of the data, as far as the file or its format tells.
        notes: sentences on what was kept, changed or left out.
    """

    mean: FloatArray
    shape: Modes
    expression: Modes | None = None
    faces: IntArray | None = None
    mm: float | None = None
    landmarks: SurfaceLandmarks = field(default_factory=SurfaceLandmarks)
    n_training: int | None = None
    held_out: bool = False
    provenance: str = ""
    licence: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", read_only(self.mean))
        object.__setattr__(self, "landmarks", SurfaceLandmarks.of(self.landmarks))

    def noting(self, *notes: str) -> LinearModel:
        """Return the model with more `notes`."""
        return replace(self, notes=(*self.notes, *notes))

    def check(self, path: Path) -> None:
        """Refuse what is no model, whatever its format.

        Raises:
            ModelFileError: arrays that do not belong together or are not finite, or no modes.
        """
        blocks = [self.shape] if self.expression is None else [self.shape, self.expression]
        n = len(self.mean)
        wrong = ""
        if self.mean.ndim != 2 or self.mean.shape[1:] != (3,) or not n:
            wrong = f"its mean has the shape {self.mean.shape} and not (V, 3)"
        elif any(block.moved.ndim != 2 or len(block.moved) != 3 * n or not block.moved.shape[1] for block in blocks):
            shapes = " and ".join(str(block.moved.shape) for block in blocks)
            wrong = f"its modes have the shape {shapes}, which {n} vertices do not"
        elif not all(are_measurable(array) for array in (self.mean, *(block.moved for block in blocks))):
            wrong = "it holds numbers that are not finite, or too large for lengths"
        elif any(block.names and len(block.names) != block.moved.shape[1] for block in blocks):
            wrong = "it has another number of names than of modes"
        elif self.faces is not None and not are_triangles(self.faces, n):
            wrong = f"its triangles are of the shape {self.faces.shape}, or name vertices that it does not have"
        elif bool((self.landmarks.corners >= n).any()):
            wrong = "a landmark lies at a vertex that it does not have"
        if wrong:
            raise ModelFileError(f"{path} is no usable shape model: {wrong}; export it again from where it was made.")


def are_triangles(faces: IntArray, n: int) -> bool:
    """Whether `faces` is (F, 3) with indices of `n` vertices."""
    return faces.ndim == 2 and faces.shape[1] == 3 and (not len(faces) or (faces.min() >= 0 and faces.max() < n))


def are_measurable(array: FloatArray) -> bool:
    """Whether all numbers are finite, and no larger than their squares and sums can be reckoned with."""
    return bool((np.abs(array) <= _LARGEST).all())


def scale_columns(basis: npt.ArrayLike, stddev: npt.ArrayLike) -> FloatArray:
    """Return U sqrt(lambda), float64, of `basis` (D, K) and `stddev` (K,)."""
    return np.asarray(basis, dtype=np.float64) * np.asarray(stddev, dtype=np.float64)


def orthonormal(displacements: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return U (D, K), s (K,) and W (M, K) with `displacements` (D, M) = U s W^T, without modes that do not vary."""
    length = np.linalg.norm(displacements, axis=0)
    order = np.argsort(-length, kind="stable")
    keep = order[length[order] > _NO_STDDEV * length.max()] if length.size and length.max() > 0 else order[:0]
    unit = displacements[:, keep] / length[keep]
    # The last bits hang on the number of threads, and workers, which have one, must find the same model.
    with threadpool_limits(1, user_api="blas"):
        if (
            np.abs(unit.T @ unit - np.eye(len(keep))).max(initial=0.0) <= ORTHOGONAL
            and len(keep) == displacements.shape[1]
        ):
            # As it stands but for the rounding of single precision, so that modes stay the file's own.
            directions, upper = qr(unit, mode="economic")
            exact = np.asarray(directions * np.sign(np.diag(upper)), dtype=np.float64)
            return exact, length[keep], np.eye(displacements.shape[1])[:, keep]
        left, stddev, right = svd(displacements, full_matrices=False)
    is_kept = stddev > _NO_STDDEV * stddev.max(initial=0.0)
    sign = np.sign(left[np.abs(left).argmax(axis=0), np.arange(left.shape[1])])
    return (left * sign)[:, is_kept], stddev[is_kept], (right.T * sign)[:, is_kept]


class ModelReader(Protocol):
    """A reader of one model format: one module, one class, one entry in `MODEL_FORMATS` or `READ_ONLY_MODELS`."""

    name: str
    """By which `shapespace convert --to` asks for it."""
    title: str
    """In words, for messages."""
    suffixes: Sequence[str]
    """Ends of names, lower case, the one that is written first; a folder's format has none that another takes."""

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether `path`, which begins with `head` (empty for a folder), looks like it; cheap, never raises."""
        ...

    def read(self, path: Path) -> LinearModel:
        """Return the model in `path`.

        Raises:
            FileError: it cannot be read.
            ModelFileError: it is damaged, made to harm, or another thing.
        """
        ...


class ModelFormat(ModelReader, Protocol):
    """A model format with a writer."""

    def write(self, model: LinearModel, path: Path) -> Sequence[str]:
        """Write `model` to `path`, whole or not at all, and return sentences on what was changed or left out.

        Raises:
            FileError: it cannot be written.
            InputError: the format cannot hold such a model.
        """
        ...
