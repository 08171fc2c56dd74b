"""Landmark arrays of R (geomorph): p landmarks x k dimensions x n specimens in .rda, .RData and .rds files."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import lzma
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations, mark_missing
from shapespace.io.parsing import damage_error
from shapespace.io.read_limits import LARGEST_CONFIGURATIONS_FILE_BYTES
from shapespace.lazy import require_package
from shapespace.reprs import first_names
from shapespace.types import FloatArray

R_ENDINGS = (".rda", ".rdata", ".rds")
"""Endings, in lower case, of files of R objects."""
_CURVES = ("curvepts", "curves", "curveslide", "curvslide")
_SURFACES = ("surfslide", "surfaces", "surfpts")
"""Names of parts of geomorph's data sets with the numbers of semilandmarks."""
_LISTED = 8  # arrays in a sentence
_DEEPEST = 2  # levels of nested lists that are searched for arrays


def parse_r(data: bytes, path: Path, name: str | None = None) -> LandmarkConfigurations:
    """Return the landmarks of the only array of an R file, or of the array `name`, such as `plethodon$land`.

    Factors and vectors next to the array, with a value for each specimen, become columns; `curvepts`, `curveslide` and
    `surfslide` next to it are sliders.
    """
    rdata = require_package("rdata", f"Reading {path}", "'shapespace[r]'")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = rdata.parser.parse_data(_decompress(data), altrep_constructor_dict=_expansions(rdata))
            found = dict(_arrays(_objects(content.object, rdata), ""))
    # The parser raises many types of errors on damaged files.
    except Exception as error:
        reason = " ".join(str(error).split())[:60] or type(error).__name__
        raise damage_error(path, f"it is not an R data file, or is damaged ({reason})") from error
    chosen = {key: array for key, array in found.items() if name is None or name in (key, key.rpartition("$")[2])}
    listed = first_names([key or "(unnamed)" for key in found], _LISTED)
    if not found:
        raise damage_error(path, "it has no array of landmarks x 2 or 3 dimensions x specimens")
    if len(chosen) != 1:
        problem = "several arrays" if name is None or chosen else f"no array {name[:40]!r}"
        raise damage_error(path, f"it has {problem}; name one of {listed} with --object")
    [(key, (points, labels, names, others))] = chosen.items()
    notes = [f"The landmarks are those of {key}."] if key else []
    names = names or tuple(f"specimen {k}" for k in range(1, len(points) + 1))
    labels = labels or tuple(map(str, range(1, points.shape[1] + 1)))
    columns = {part: cells for part, values in others.items() if len(cells := _cells(values)) == len(points)}
    sliders = {3: np.zeros((0, 3), dtype=np.int32), 1: np.zeros((0, 1), dtype=np.int32)}
    for part, values in others.items():
        width = 3 if part.lower() in _CURVES else 1
        if part.lower() in (*_CURVES, *_SURFACES) and getattr(values, "size", 0) and values.size % width == 0:
            numbers = np.asarray(values, dtype=np.float64).reshape(-1, width)
            if not np.isin(numbers, np.arange(1, len(labels) + 1)).all():
                raise damage_error(path, f"{part} has numbers that are not landmarks, from 1 to {len(labels)}")
            sliders[width] = numbers.astype(np.int32) - 1
            columns.pop(part, None)
            notes.append(f"The sliders are those of {part}.")
    return mark_missing(LandmarkConfigurations(
        names=names, points=points, landmarks=labels, columns=columns, curve_sliders=sliders[3],
        surface_sliders=sliders[1][:, 0], where=str(path), notes=tuple(notes),
    ))  # fmt: skip


def _decompress(data: bytes) -> bytes:
    """Return uncompressed data up to the limit of a file, so that a small file cannot fill the memory."""
    limit = LARGEST_CONFIGURATIONS_FILE_BYTES
    for start, module in ((b"\x1f\x8b", gzip), (b"BZh", bz2), (b"\xfd7zXZ", lzma)):
        if data.startswith(start):
            with module.open(io.BytesIO(data)) as stream:
                data = stream.read(limit + 1)
            if len(data) > limit:
                raise ValueError(f"it unpacks to more than {limit >> 20} MiB")
            break
    return data


def _expansions(rdata: Any) -> dict[bytes, Any]:
    """Return the constructors of compact vectors of R, with a limit on the length of sequences."""

    def bounded(expand: Any, state: Any) -> Any:
        if not 0 <= state.value[0] <= LARGEST_CONFIGURATIONS_FILE_BYTES // 8:
            raise ValueError("it has a sequence that would fill the memory")
        return expand(state)

    known: dict[bytes, Any] = dict(rdata.parser.DEFAULT_ALTREP_MAP)
    return {name: partial(bounded, expand) if b"compact" in name else expand for name, expand in known.items()}


def _objects(content: Any, rdata: Any) -> dict[str, Any]:
    """Return the objects of a file by name, without functions and other objects that cannot be converted."""
    objects: dict[str, Any] = {}
    while content.info.type.name == "LIST":
        tag = content.tag.referenced_object or content.tag
        # Functions and environments are not data.
        with contextlib.suppress(AssertionError, NotImplementedError):
            objects[tag.value.value.decode()] = rdata.conversion.convert(content.value[0])
        content = content.value[1]
    return objects or {"": rdata.conversion.convert(content)}


def _arrays(
    objects: Mapping[str, Any], prefix: str, depth: int = 0
) -> Iterator[tuple[str, tuple[FloatArray, tuple[str, ...], tuple[str, ...], Mapping[str, Any]]]]:
    """Yield the name of each array, its points (n, p, k), names of landmarks and specimens, and adjacent objects."""
    objects = {str(name): value for name, value in objects.items()}
    for name, value in objects.items():
        shape = getattr(value, "shape", ())
        if len(shape) == 3 and shape[1] in (2, 3) and 0 not in shape and np.asarray(value).dtype.kind in "fi":
            coords = getattr(value, "coords", {})
            labels, names = (
                tuple(map(str, coords[axis].values)) if axis in coords else () for axis in ("dim_0", "dim_2")
            )
            points = np.moveaxis(np.ma.filled(np.ma.asarray(value).astype(np.float64), np.nan), 2, 0)
            yield f"{prefix}{name}", (points, labels, names, objects)
        elif isinstance(value, Mapping) and depth < _DEEPEST:
            yield from _arrays(cast(Mapping[str, Any], value), f"{prefix}{name}$" if name else prefix, depth + 1)


def _cells(vector: Any) -> tuple[str, ...]:
    """Return the values of a factor or a vector as text; missing values are empty."""
    if len(getattr(vector, "shape", ())) != 1:
        return ()
    values: list[Any] = np.ma.filled(np.ma.asarray(vector).astype(object), None).tolist()
    return tuple("" if value is None or value != value else str(value) for value in values)  # noqa: PLR0124 (NaN)
