"""Metadata of a model (landmarks, provenance, licence) as JSON, for formats with a free text field."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from shapespace.errors import InputError
from shapespace.formats.model_parts import LinearModel
from shapespace.io.files import temporary_folder, write_error
from shapespace.types import SurfaceLandmarks

KEY: Final = "shapespace"
"""Under which the facts stand."""
_PLACES: Final = "landmark_triangles"
"""Landmarks between vertices: name -> vertices, barycentric coordinates, and distance of the given point in mm."""
_LONGEST_WORDS = 20_000  # characters; longer than any licence text
_MOST_LANDMARKS = 10_000  # limit on damaged files, far above published markups


def facts_of(model: LinearModel) -> dict[str, Any]:
    """Return what `with_facts` takes, with lengths in mm."""
    mm = model.mm or 1.0
    total = total_variance(model)
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


def total_variance(model: LinearModel) -> float | None:
    """Return the variance of all modes, in the unit of the model squared; None if the file does not state it."""
    variances = [block.total_variance for block in (model.shape, model.expression) if block is not None]
    known = [variance for variance in variances if variance is not None]
    return sum(known) if known else None


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
    try:
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
    except OSError as error:
        raise write_error(path, error) from error
