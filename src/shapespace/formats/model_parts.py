"""Linear models as files of other tools store them, their metadata as JSON, and what readers and writers are.

Modes are held as what one standard deviation of each does, U sqrt(lambda), in the unit of the file: every convention of
basis and spread is that product, and a basis that is not orthonormal loses nothing by it. Formats with a free text
field keep landmarks, provenance and licence there, as `facts_of` has them.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
from scipy.linalg import qr, svd
from threadpoolctl import threadpool_limits

from shapespace.errors import InputError, ModelFileError
from shapespace.io.files import temporary_folder, writing
from shapespace.types import FloatArray, IntArray, SurfaceLandmarks, read_only

ORTHOGONAL: Final = 1e-3  # largest |U^T U - I|; single precision stays below
_LARGEST = 1e30  # coordinates whose squares stay finite in float64
_NO_STDDEV = 1e-6
"""Of the largest one; what single precision makes of a mode that is not there."""
IDENTITY: Final = re.compile(r"identity[ _.-]?\d+", re.IGNORECASE)
"""Names of modes of identity."""
KEY: Final = "shapespace"
"""Under which the facts stand."""
_PLACES: Final = "landmark_triangles"
"""Landmarks between vertices: name -> vertices, barycentric coordinates, and distance of the given point in mm."""
_LONGEST_WORDS = 20_000  # characters; longer than any licence text
_MOST_LANDMARKS = 10_000  # limit on damaged files, far above published markups


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

    @property
    def blocks(self) -> tuple[Modes, ...]:
        """The modes of identity, and those of expression where there are any."""
        return (self.shape,) if self.expression is None else (self.shape, self.expression)

    @property
    def moved(self) -> FloatArray:
        """(3V, K) what one standard deviation of each mode does, those of identity first."""
        return np.concatenate([block.moved for block in self.blocks], axis=1)

    @property
    def total_variance(self) -> float | None:
        """Of all modes, in the unit of the file squared; None if the file does not state it."""
        known = [block.total_variance for block in self.blocks if block.total_variance is not None]
        return sum(known) if known else None

    def noting(self, *notes: str) -> LinearModel:
        """Return the model with more `notes`."""
        return replace(self, notes=(*self.notes, *notes))

    def check(self, path: Path) -> None:
        """Refuse what is no model, whatever its format.

        Raises:
            ModelFileError: arrays that do not belong together or are not finite, or no modes.
        """
        blocks, n = self.blocks, len(self.mean)
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


def split_modes(
    displacements: FloatArray, names: Sequence[str], is_identity: Sequence[bool]
) -> tuple[Modes, Modes | None]:
    """Return the modes (3V, K) of identity and of expression; all of them and None where they are of one kind.

    Args:
        displacements: (3V, K).
        names: (K,) or none.
        is_identity: (K,) which are of identity, or none.
    """
    chosen = np.array(is_identity, dtype=np.bool_)
    if not 0 < chosen.sum() < displacements.shape[1]:
        return Modes(displacements, tuple(names)), None
    identity, expression = (Modes(displacements[:, own], tuple(compress(names, own))) for own in (chosen, ~chosen))
    return identity, expression


def facts_of(model: LinearModel) -> dict[str, Any]:
    """Return what `with_facts` takes, with lengths in mm."""
    mm = model.mm or 1.0
    total = model.total_variance
    facts: dict[str, Any] = {
        "vertices": len(model.mean),
        "n_training": model.n_training,
        "held_out": model.held_out,
        "total_variance_mm2": None if total is None else float(total * mm**2),
        "landmarks": dict(model.landmarks),
        **({} if model.landmarks.are_vertices else {_PLACES: _places_of(model.landmarks, mm)}),
        "provenance": model.provenance,
        "licence": model.licence,
    }
    if model.expression is not None:
        facts["n_identity"] = model.shape.moved.shape[1]
    return facts


def with_facts(model: LinearModel, facts: object) -> LinearModel:
    """Return `model` with the metadata in `facts`.

    Landmarks are in triangles of vertices, so they are read only where the number of vertices is still the same.
    """
    known = json_object(facts)
    if not known:
        return model
    n = len(model.mean)
    landmarks, notes = model.landmarks, model.notes
    marks = json_object(known.get("landmarks"))
    if marks and known.get("vertices") != n:
        notes = (*notes, "Its landmarks are left out: the number of vertices has changed since they were set.")
    elif len(marks) <= _MOST_LANDMARKS:
        file_landmarks = _landmarks(marks, json_object(known.get(_PLACES)), n, model.mm or 1.0)
        landmarks = landmarks.select([name for name in landmarks if name not in file_landmarks]).joined(file_landmarks)
    training, total = _count(known.get("n_training")), known.get("total_variance_mm2")
    shape = model.shape
    if isinstance(total, float) and math.isfinite(total) and total > 0:
        # Held by the shape alone, so that with expressions it is that of both.
        shape = replace(shape, total_variance=total / (model.mm or 1.0) ** 2)
    expression = model.expression
    if shape is not model.shape and expression is not None:
        expression = replace(expression, total_variance=0.0)
    return replace(
        model,
        shape=shape,
        expression=expression,
        landmarks=landmarks,
        n_training=training if training is not None and training > 1 else model.n_training,
        held_out=known.get("held_out") is True,
        provenance=_words(known.get("provenance")) or model.provenance,
        licence=_words(known.get("licence")) or model.licence,
        notes=notes,
    )


def _places_of(landmarks: SurfaceLandmarks, mm: float) -> dict[str, dict[str, Any]]:
    rows = zip(landmarks.names, landmarks.corners, landmarks.barycentric, landmarks.distance_mm, strict=True)
    return {
        name: {"vertices": corners.tolist(), "barycentric": weights.tolist(), "distance_mm": float(distance * mm)}
        for name, corners, weights, distance in rows
    }


def _landmarks(vertices: Mapping[str, Any], places: Mapping[str, Any], n: int, mm: float) -> SurfaceLandmarks:
    """Return the landmarks of facts: in their triangles where these are given, else at their vertices."""
    landmarks: list[SurfaceLandmarks] = []
    for name, value in vertices.items():
        vertex, entry = _count(value), json_object(places.get(name))
        if vertex is None or vertex >= n:
            continue
        landmark = SurfaceLandmarks.of({name: vertex})
        try:
            corners = np.array([entry["vertices"]], dtype=np.int32)
            weights = np.array([entry["barycentric"]], dtype=np.float64)
            distance = np.array([entry["distance_mm"]], dtype=np.float64) / mm
            exact = SurfaceLandmarks((name,), corners, weights, distance)
            landmark = exact if dict(exact) == dict(landmark) and corners.max() < n else landmark
        except (KeyError, ValueError, TypeError, OverflowError):
            pass  # not as `facts_of` writes it, which leaves the vertex
        landmarks.append(landmark)
    return SurfaceLandmarks().joined(*landmarks)


def json_object(value: object) -> Mapping[str, Any]:
    """Return `value` where it is an object of JSON, and an empty one otherwise."""
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else {}


def _count(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31 else None


def _words(value: object) -> str:
    return value[:_LONGEST_WORDS] if isinstance(value, str) else ""


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder `path` with `files`, by their names.

    Raises:
        InputError: there is such a folder, and something in it.
        FileError: it cannot be made, or the disk is full.
    """
    with writing(path):
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path} is there already; give the name of a new folder.")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Beside it, so that one step puts it there.
        with temporary_folder(path.parent) as temporary:
            complete = temporary / "whole"
            complete.mkdir()
            for name, data in files.items():
                (complete / name).write_bytes(data)
            if path.exists():
                path.rmdir()
            shutil.move(complete, path)


@dataclass(frozen=True)
class ModelReader:
    """A model format that is read.

    Args:
        name: by which `shapespace convert --to` asks for it.
        title: in words, for messages.
        suffixes: ends of names, lower case, the one that is written first; a folder's format has none that another
            takes.
        recognises: (path, head) -> whether the path, which begins with `head` (empty for a folder), looks like it;
            cheap, never raises.
        read: path -> the model in it. It raises FileError where it cannot be read, and ModelFileError where it is
            damaged, made to harm, or another thing.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, bytes], bool]
    read: Callable[[Path], LinearModel]


@dataclass(frozen=True)
class ModelFormat(ModelReader):
    """A model format that is read and written.

    Args:
        name, title, suffixes, recognises, read: of `ModelReader`.
        write: (model, path) -> sentences on what was changed or left out; it writes a whole file or none. It raises
            FileError where it cannot be written, and InputError where the format cannot hold such a model.
    """

    write: Callable[[LinearModel, Path], Sequence[str]]
