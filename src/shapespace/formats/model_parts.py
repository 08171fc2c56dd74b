"""Linear models as stored in files of other tools, their metadata as JSON, and the interface of readers and writers.

A mode is stored as the displacement of one standard deviation, a column of U sqrt(lambda), in the unit of the file: all
conventions of basis and spread have this product, which is also exact for a basis that is not orthonormal. Formats with
a free text field store landmarks, provenance and licence there, in the form of `facts_of`.
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
"""Share of the largest standard deviation below which a mode is only rounding of single precision."""
IDENTITY: Final = re.compile(r"identity[ _.-]?\d+", re.IGNORECASE)
"""Pattern of the names of identity modes."""
KEY: Final = "shapespace"
"""Key of the metadata in a file."""
_PLACES: Final = "landmark_triangles"
"""Landmarks between vertices: name -> vertices, barycentric coordinates, and distance of the given point in mm."""
_LONGEST_WORDS = 20_000  # characters; longer than any licence text
_MOST_LANDMARKS = 10_000  # limit on damaged files, far above published markups


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of identity or of expression: x = mean + moved @ z, with z independent and of variance 1.

    Args:
        moved: (3V, K) displacements of one standard deviation of each mode: x, y, z of vertex 0, then of vertex 1, and
            so on, in the unit of the file.
        names: (K,) names of the modes, or empty.
        total_variance: variance of all modes, including those that the file omits, in the unit of the file squared;
            None if the file does not state it.
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
        mean: (V, 3) vertices for coefficients of zero, including the mean of the expressions.
        shape: modes of the model, or of identity only if `expression` is given.
        expression: modes of expression, which are added to those of identity, or None.
        faces: (M, 3) triangles, counter-clockwise seen from outside, or None for a point model.
        mm: length of the unit of the file, mm; None if the format does not state it, which is interpreted as 1 mm.
        landmarks: named points on the surface, or a mapping of name to vertex for landmarks at vertices.
        n_training: number of training shapes; None if the file does not state it.
        parts: number of vertices of each structure of one subject by its name, in the order of the vertices; empty if
            there is one structure.
        held_out: whether the variances are valid for new shapes without correction, such as those of a Gaussian
            process; False for variances of the training shapes.
        provenance: description of the origin of the model.
        licence: licence of the data, if the file or its format states it.
        notes: sentences about converted, changed or omitted data.
    """

    mean: FloatArray
    shape: Modes
    expression: Modes | None = None
    faces: IntArray | None = None
    mm: float | None = None
    landmarks: SurfaceLandmarks = field(default_factory=SurfaceLandmarks)
    n_training: int | None = None
    parts: Mapping[str, int] = field(default_factory=dict[str, int])
    held_out: bool = False
    provenance: str = ""
    licence: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", read_only(self.mean))
        object.__setattr__(self, "landmarks", SurfaceLandmarks.of(self.landmarks))

    @property
    def blocks(self) -> tuple[Modes, ...]:
        """The modes of identity, and those of expression, if any."""
        return (self.shape,) if self.expression is None else (self.shape, self.expression)

    @property
    def moved(self) -> FloatArray:
        """(3V, K) displacements of one standard deviation of each mode, identity modes first."""
        return np.concatenate([block.moved for block in self.blocks], axis=1)

    @property
    def total_variance(self) -> float | None:
        """Variance of all modes, in the unit of the file squared; None if the file does not state it."""
        known = [block.total_variance for block in self.blocks if block.total_variance is not None]
        return sum(known) if known else None

    def noting(self, *notes: str) -> LinearModel:
        """Return the model with more `notes`."""
        return replace(self, notes=(*self.notes, *notes))

    def check(self, path: Path) -> None:
        """Check that arrays of any format are a valid model.

        Raises:
            ModelFileError: the arrays are inconsistent or not finite, or there are no modes.
        """
        blocks, n = self.blocks, len(self.mean)
        wrong = ""
        if self.mean.ndim != 2 or self.mean.shape[1:] != (3,) or not n:
            wrong = f"its mean has the shape {self.mean.shape} and not (V, 3)"
        elif any(block.moved.ndim != 2 or len(block.moved) != 3 * n or not block.moved.shape[1] for block in blocks):
            shapes = " and ".join(str(block.moved.shape) for block in blocks)
            wrong = f"its modes have the shape {shapes}, which {n} vertices do not"
        elif not all(are_measurable(array) for array in (self.mean, *(block.moved for block in blocks))):
            wrong = "it contains numbers that are not finite, or too large for lengths"
        elif any(block.names and len(block.names) != block.moved.shape[1] for block in blocks):
            wrong = "it has another number of names than of modes"
        elif self.faces is not None and not are_triangles(self.faces, n):
            wrong = f"its triangles have the shape {self.faces.shape}, or refer to vertices that do not exist"
        elif bool((self.landmarks.corners >= n).any()):
            wrong = "a landmark refers to a vertex that does not exist"
        if wrong:
            raise ModelFileError(f"{path} is not a valid shape model: {wrong}; export it again with its program.")


def are_triangles(faces: IntArray, n: int) -> bool:
    """Return whether `faces` is (F, 3) with indices of `n` vertices."""
    return faces.ndim == 2 and faces.shape[1] == 3 and (not len(faces) or (faces.min() >= 0 and faces.max() < n))


def are_measurable(array: FloatArray) -> bool:
    """Return whether all numbers are finite, and small enough for finite squares and sums."""
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
    # The last bits depend on the number of threads, and workers, which have one thread, must compute the same model.
    with threadpool_limits(1, user_api="blas"):
        if (
            np.abs(unit.T @ unit - np.eye(len(keep))).max(initial=0.0) <= ORTHOGONAL
            and len(keep) == displacements.shape[1]
        ):
            # Orthonormal up to the rounding of single precision, so the modes of the file are kept.
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
    """Return the modes (3V, K) of identity and of expression, or all modes and None without such a distinction.

    Args:
        displacements: (3V, K) displacements of one standard deviation of each mode.
        names: (K,) names of the modes, or empty.
        is_identity: (K,) whether each mode is one of identity, or empty.
    """
    chosen = np.array(is_identity, dtype=np.bool_)
    if not 0 < chosen.sum() < displacements.shape[1]:
        return Modes(displacements, tuple(names)), None
    identity, expression = (Modes(displacements[:, own], tuple(compress(names, own))) for own in (chosen, ~chosen))
    return identity, expression


def facts_of(model: LinearModel) -> dict[str, Any]:
    """Return the metadata of a model for `with_facts`, with lengths in mm."""
    mm = model.mm or 1.0
    total = model.total_variance
    facts: dict[str, Any] = {
        "vertices": len(model.mean),
        "n_training": model.n_training,
        "held_out": model.held_out,
        "total_variance_mm2": None if total is None else float(total * mm**2),
        "landmarks": dict(model.landmarks),
        **({} if model.landmarks.are_vertices else {_PLACES: _places_of(model.landmarks, mm)}),
        **({"parts": dict(model.parts)} if model.parts else {}),
        "provenance": model.provenance,
        "licence": model.licence,
    }
    if model.expression is not None:
        facts["n_identity"] = model.shape.moved.shape[1]
    return facts


def with_facts(model: LinearModel, facts: object) -> LinearModel:
    """Return `model` with the metadata in `facts`.

    Landmarks refer to triangles of vertices, so they are read only if the number of vertices is unchanged.
    """
    known = json_object(facts)
    if not known:
        return model
    n = len(model.mean)
    landmarks, notes = model.landmarks, model.notes
    marks = json_object(known.get("landmarks"))
    if marks and known.get("vertices") != n:
        notes = (*notes, "Its landmarks are omitted, since the number of vertices has changed.")
    elif len(marks) <= _MOST_LANDMARKS:
        file_landmarks = _landmarks(marks, json_object(known.get(_PLACES)), n, model.mm or 1.0)
        landmarks = landmarks.select([name for name in landmarks if name not in file_landmarks]).joined(file_landmarks)
    training, total = _count(known.get("n_training")), known.get("total_variance_mm2")
    shape = model.shape
    if isinstance(total, float) and math.isfinite(total) and total > 0:
        # Stored in the shape only, so with expressions it is the variance of both.
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
        parts=parts_of(known.get("parts"), n) or model.parts,
        held_out=known.get("held_out") is True,
        provenance=_words(known.get("provenance")) or model.provenance,
        licence=_words(known.get("licence")) or model.licence,
        notes=notes,
    )


def parts_of(value: object, n: int) -> dict[str, int]:
    """Return the numbers of vertices of the parts in a JSON object; none if they are not those of `n` vertices."""
    parts = {str(name): count for name, own in json_object(value).items() if (count := _count(own))}
    return parts if sum(parts.values()) == n else {}


def _places_of(landmarks: SurfaceLandmarks, mm: float) -> dict[str, dict[str, Any]]:
    rows = zip(landmarks.names, landmarks.corners, landmarks.barycentric, landmarks.distance_mm, strict=True)
    return {
        name: {"vertices": corners.tolist(), "barycentric": weights.tolist(), "distance_mm": float(distance * mm)}
        for name, corners, weights, distance in rows
    }


def _landmarks(vertices: Mapping[str, Any], places: Mapping[str, Any], n: int, mm: float) -> SurfaceLandmarks:
    """Return the landmarks of metadata: in their triangles if these are given, else at their vertices."""
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
            pass  # not in the form of `facts_of`; only the vertex is used
        landmarks.append(landmark)
    return SurfaceLandmarks().joined(*landmarks)


def json_object(value: object) -> Mapping[str, Any]:
    """Return `value` if it is a JSON object, and an empty object otherwise."""
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else {}


def _count(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31 else None


def _words(value: object) -> str:
    return value[:_LONGEST_WORDS] if isinstance(value, str) else ""


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Create the folder `path` with `files` (name -> content).

    Raises:
        InputError: the folder exists and is not empty.
        FileError: it cannot be created, or the disk is full.
    """
    with writing(path):
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path} already exists; give the name of a new folder.")
        path.parent.mkdir(parents=True, exist_ok=True)
        # In the same parent folder, so that one rename moves it into place.
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
    """A model format that can be read.

    Args:
        name: name of the format for `shapespace convert --to`.
        title: description of the format, used in messages.
        suffixes: endings of file names, lower case; the first is used for writing. The ending
            of a format that is a folder must not be one of another format.
        recognises: function (path, head) -> whether the path looks like this format; `head` are the first bytes, empty
            for a folder. It is fast and never raises.
        read: function path -> model. It raises FileError if the file cannot be read, and ModelFileError if it is
            damaged, malicious, or has another format.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, bytes], bool]
    read: Callable[[Path], LinearModel]


@dataclass(frozen=True)
class ModelFormat(ModelReader):
    """A model format that can be read and written.

    Args:
        name, title, suffixes, recognises, read: the fields of `ModelReader`.
        write: function (model, path) -> sentences about changed or omitted data; it writes atomically. It raises
            FileError if the file cannot be written, and InputError if the format cannot store the model.
    """

    write: Callable[[LinearModel, Path], Sequence[str]]
