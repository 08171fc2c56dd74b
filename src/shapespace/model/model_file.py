"""The model file: one HDF5 file with everything that the model is. Version 1."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError, ModelFileError
from shapespace.geometry.procrustes import Gauge
from shapespace.io.hdf5 import Attribute, content_hash, read_hdf5, write_hdf5
from shapespace.types import FloatArray, IntArray
from shapespace.version import __version__

FORMAT_NAME = "shapespace model"
FORMAT_VERSION = 1
_HELD_OUT = "held out"
_RESIDUALS = "residuals"
_EVERY_MODEL = ("mean", "basis", "stddev", "faces", _RESIDUALS)
"""What is not of one representation."""


class ModelFields(TypedDict):
    """The fields of a `ShapeModel`, which says what they are."""

    mean: FloatArray
    basis: FloatArray
    stddev: FloatArray
    total_variance: float
    n_training: int
    faces: IntArray | None
    gauge: Gauge
    landmarks: Mapping[str, int]
    representation: str
    coding: Mapping[str, npt.NDArray[Any]]
    provenance: str
    licence: str
    held_out: bool
    residuals: FloatArray | None


def hash_of(model: ModelFields) -> str:
    """Return the SHA-256 of everything that `model` is, whatever file it stands in."""
    return content_hash(*_contents(model))


def save(
    model: ModelFields,
    path: Path,
    more_arrays: Mapping[str, npt.NDArray[Any]] | None = None,
    more_attributes: Mapping[str, Attribute] | None = None,
) -> None:
    """Write `model`, and what a larger model adds to it, to `path`, whole or not at all."""
    arrays, attributes = _contents(model)
    made_by: dict[str, Attribute] = {"model_hash": hash_of(model), "software_version": __version__}
    write_hdf5(path, {**arrays, **(more_arrays or {})}, {**attributes, **(more_attributes or {}), **made_by})


def _contents(model: ModelFields) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Attribute]]:
    """Return the arrays and attributes that make up `model`; the software version is not part of them."""
    arrays: dict[str, npt.NDArray[Any]] = {name: model[name] for name in ("mean", "basis", "stddev")}
    if model["faces"] is not None:
        arrays["faces"] = model["faces"]
    if model["residuals"] is not None:
        arrays[_RESIDUALS] = model["residuals"]
    arrays.update(model["coding"])
    attributes: dict[str, Attribute] = {
        "format": FORMAT_NAME,
        "format_version": FORMAT_VERSION,
        "units": "mm",
        "variance_divisor": _HELD_OUT if model["held_out"] else "N - 1",
        "gauge": model["gauge"],
        "representation": model["representation"],
        "total_variance": model["total_variance"],
        "n_training": model["n_training"],
        "landmarks": json.dumps(dict(model["landmarks"])),
        "provenance": model["provenance"],
        "licence": model["licence"],
    }
    return arrays, attributes


def load(path: Path) -> ModelFields:
    """Return the fields of the `ShapeModel` in `path`.

    Raises:
        FileError: it cannot be read.
        ModelFileError: it is damaged, of another version, or not a model.
    """
    try:
        arrays, attributes = read_hdf5(path)
    except FileFormatError as error:
        raise ModelFileError(str(error)) from error
    if attributes.get("format") != FORMAT_NAME:
        raise ModelFileError(f"{path} is HDF5 but not a shapespace model; give a file written by shapespace build.")
    if attributes.get("format_version") != FORMAT_VERSION:
        raise ModelFileError(
            f"{path} is a model of format version {attributes.get('format_version')}, but this shapespace reads "
            f"version {FORMAT_VERSION}; update shapespace."
        )
    try:
        stored = cast(dict[str, int], json.loads(str(attributes["landmarks"])))
        return {
            "mean": arrays["mean"].astype(np.float64),
            "basis": arrays["basis"].astype(np.float64),
            "stddev": arrays["stddev"].astype(np.float64),
            "faces": arrays["faces"].astype(np.int32) if "faces" in arrays else None,
            "total_variance": float(attributes["total_variance"]),
            "n_training": int(attributes["n_training"]),
            "gauge": cast(Gauge, str(attributes["gauge"])),
            "landmarks": {str(name): int(vertex) for name, vertex in stored.items()},
            "representation": str(attributes["representation"]),
            "coding": {name: array for name, array in arrays.items() if name not in _EVERY_MODEL},
            "provenance": str(attributes["provenance"]),
            "licence": str(attributes["licence"]),
            "held_out": attributes.get("variance_divisor") == _HELD_OUT,
            "residuals": arrays[_RESIDUALS].astype(np.float64) if _RESIDUALS in arrays else None,
        }
    except (AttributeError, KeyError, ValueError, TypeError) as error:
        raise ModelFileError(f"{path} is a shapespace model but a part of it is missing: {error}.") from error
