"""The model file: one HDF5 file with all data of a model.

Landmarks are stored as triangles and barycentric coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Struct

from shapespace.errors import FileFormatError, InputError, ModelFileError
from shapespace.geometry.procrustes import Gauge
from shapespace.io.containers.hdf5 import Attribute, content_hash, read_hdf5, write_hdf5
from shapespace.io.containers.json_files import plain_json
from shapespace.model.training_shapes import UNIT_TOLERANCE, TrainingShapes
from shapespace.types import IntArray, SurfaceLandmarks
from shapespace.version import __version__

FORMAT_NAME = "shapespace model"
FORMAT_VERSION = 2  # version 1, which no release wrote, had landmarks as vertices
_HELD_OUT = "held out"
_RESIDUALS = "residuals"
_REGIONS = "regions"
_CORNERS, _BARYCENTRIC, _DISTANCE = "landmark_corners", "landmark_barycentric", "landmark_distance_mm"
_TRAINING, _TRAINING_REST, _TRAINING_SIZE = "training", "training_rest", "training_log_scale"
_DROPPED = "dropped_vertices"
_EVERY_MODEL = (
    "mean", "basis", "stddev", "faces", _RESIDUALS, _REGIONS, _CORNERS, _BARYCENTRIC, _DISTANCE, _TRAINING,
    _TRAINING_REST, _TRAINING_SIZE, _DROPPED,
)  # fmt: skip
"""Arrays and attributes that do not depend on the representation."""
_LONGEST_DETAIL = 200  # characters of a library's error that a message repeats
_WHOLE_NUMBERS = ("faces", "control_counts", "degree", "part_counts", _REGIONS, _CORNERS, _DROPPED)


class _FileAttributes(Struct, frozen=True):
    """The attributes that a reader needs, and their types."""

    total_variance: float
    n_training: int
    gauge: Gauge
    landmarks: str
    representation: str
    provenance: str
    licence: str
    variance_divisor: str
    n_training_known: str
    regions: str = "{}"
    parts: str = "[]"
    notes: str = "[]"


ModelFields: TypeAlias = dict[str, Any]
"""The fields of a `ShapeModel` by their names."""


def hash_of(model: ModelFields) -> str:
    """Return the SHA-256 of all data of `model`, independent of its file."""
    return content_hash(*_contents(model))


def save(
    model: ModelFields,
    path: Path,
    more_arrays: Mapping[str, npt.NDArray[Any]] | None = None,
    more_attributes: Mapping[str, Attribute] | None = None,
) -> None:
    """Write `model`, and the additional data of a larger model, to `path`, completely or not at all."""
    arrays, attributes = _contents(model)
    made_by: dict[str, Attribute] = {"model_hash": hash_of(model), "software_version": __version__}
    made_by["n_training_known"] = "yes" if model["is_n_training_known"] else "no"
    if notes := model["notes"]:
        made_by["notes"] = json.dumps(notes)
    if (training := model["training"]) is not None:  # no part of the hash: a shared model without them is the same
        arrays |= {_TRAINING: training.coefficients, _TRAINING_SIZE: training.log_scale}
        arrays |= {_TRAINING_REST: training.rest} if training.rest.size else {}
    if model["dropped_vertices"].size:  # no part of the hash
        arrays[_DROPPED] = model["dropped_vertices"]
    write_hdf5(path, {**arrays, **(more_arrays or {})}, {**attributes, **(more_attributes or {}), **made_by})


def _contents(model: ModelFields) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Attribute]]:
    """Return the arrays and attributes that define `model`; the software version is not among them."""
    arrays: dict[str, npt.NDArray[Any]] = {name: model[name] for name in ("mean", "basis", "stddev")}
    if model["faces"] is not None:
        arrays["faces"] = model["faces"]
    if model["residuals"] is not None:
        arrays[_RESIDUALS] = model["residuals"]
    arrays.update(model["coding"])
    if landmarks := model["landmarks"]:
        arrays[_CORNERS], arrays[_BARYCENTRIC] = landmarks.corners, landmarks.barycentric
        arrays[_DISTANCE] = landmarks.distance_mm
    attributes: dict[str, Attribute] = {
        "format": FORMAT_NAME,
        "format_version": FORMAT_VERSION,
        "units": "mm",
        "variance_divisor": _HELD_OUT if model["held_out"] else "N - 1",
        "gauge": model["gauge"],
        "representation": model["representation"],
        "total_variance": model["total_variance"],
        "n_training": model["n_training"],
        "landmarks": json.dumps(dict(landmarks)),
        "provenance": model["provenance"],
        "licence": model["licence"],
    }
    # Only if there are any, so that models without them keep their hash.
    if regions := model["regions"]:
        arrays[_REGIONS] = np.concatenate(list(regions.values()))
        attributes[_REGIONS] = json.dumps({name: len(vertices) for name, vertices in regions.items()})
    if model["parts"]:
        attributes["parts"] = json.dumps(model["parts"])
    return arrays, attributes


def _read_regions(text: str, vertices: IntArray | None) -> dict[str, IntArray]:
    """Return name -> vertices, from the JSON `text` with the size of each region, and all vertices in one array."""
    counts = msgspec.convert(plain_json(text), dict[str, int])
    ends = np.cumsum(list(counts.values()), dtype=np.int64)
    if any(count < 1 for count in counts.values()) or sum(counts.values()) != (
        0 if vertices is None else vertices.size
    ):
        raise ValueError("regions do not belong to their names")
    return dict(zip(counts, np.split(vertices, ends[:-1]), strict=True)) if vertices is not None else {}


def _training_shapes(arrays: Mapping[str, npt.NDArray[Any]]) -> TrainingShapes | None:
    if not {_TRAINING, _TRAINING_REST, _TRAINING_SIZE} & arrays.keys():
        return None
    rest = arrays.get(_TRAINING_REST, np.zeros((arrays["mean"].size, 0)))
    return TrainingShapes(arrays[_TRAINING], rest, arrays[_TRAINING_SIZE])


def load(path: Path) -> ModelFields:
    """Return the fields of the `ShapeModel` in `path`.

    Raises:
        FileError: the file cannot be read.
        ModelFileError: the file is damaged, of another version, or not a model.
    """
    try:
        arrays, attributes = read_hdf5(path)
    except FileFormatError as error:
        raise ModelFileError(str(error)) from error
    if attributes.get("format") != FORMAT_NAME:
        raise ModelFileError(f"{path} is HDF5 but not a shapespace model; give a file written by shapespace build.")
    version = attributes.get("format_version")
    if version != FORMAT_VERSION:
        raise ModelFileError(
            f"{path} is a model of format version {str(version)[:40]}, but this shapespace reads version "
            f"{FORMAT_VERSION}; build the model again, or update shapespace."
        )
    try:
        attributes_of_file = msgspec.convert(attributes, _FileAttributes)
        vertices = msgspec.convert(plain_json(attributes_of_file.landmarks), dict[str, int])
        for name, array in arrays.items():
            if array.dtype != (np.int32 if name in _WHOLE_NUMBERS else np.float64):
                raise ValueError(f"{name} is of the type {array.dtype}")
        if attributes_of_file.representation == "vertices" and arrays["basis"].ndim == 2:
            with np.errstate(over="ignore"):
                length = np.einsum("dk,dk->k", arrays["basis"], arrays["basis"])
            if not (np.abs(length - 1.0) < UNIT_TOLERANCE).all():
                raise ValueError("a column of basis is not of length 1")
        # The arrays are views of the complete file, whose memory the copies release.
        owned = {name: array.copy() for name, array in arrays.items()}
        places = (owned[name] for name in (_CORNERS, _BARYCENTRIC, _DISTANCE)) if vertices else ()
        landmarks = SurfaceLandmarks(tuple(vertices), *places)
        if dict(landmarks) != vertices:
            raise ValueError("landmarks do not belong to their triangles")
        return {
            "mean": owned["mean"],
            "basis": owned["basis"],
            "stddev": owned["stddev"],
            "faces": owned.get("faces"),
            "total_variance": attributes_of_file.total_variance,
            "n_training": attributes_of_file.n_training,
            "gauge": attributes_of_file.gauge,
            "landmarks": landmarks,
            "representation": attributes_of_file.representation,
            "coding": {name: array for name, array in owned.items() if name not in _EVERY_MODEL},
            "provenance": attributes_of_file.provenance,
            "licence": attributes_of_file.licence,
            "held_out": attributes_of_file.variance_divisor == _HELD_OUT,
            "residuals": owned.get(_RESIDUALS),
            "regions": _read_regions(attributes_of_file.regions, owned.get(_REGIONS)),
            "parts": msgspec.convert(plain_json(attributes_of_file.parts), tuple[str, ...]),
            "is_n_training_known": attributes_of_file.n_training_known != "no",
            "training": _training_shapes(owned),
            "dropped_vertices": owned.get(_DROPPED, np.zeros(0, dtype=np.int32)),
            "notes": msgspec.convert(plain_json(attributes_of_file.notes), tuple[str, ...]),
        }
    except (KeyError, ValueError, InputError) as error:
        reason = str(error)[:_LONGEST_DETAIL].replace("`", "").replace("Object missing", "missing")
        raise ModelFileError(f"{path} is a shapespace model but a part of it is missing or wrong: {reason}.") from error
