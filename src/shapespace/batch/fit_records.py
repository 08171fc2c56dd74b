"""Result files of a fit: NAME.fit.json, NAME.fitted.ply, NAME.dense.ply, NAME.stages.npz, coefficients.csv."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from msgspec import structs

from shapespace.errors import FileFormatError
from shapespace.fit.result import FitResult, OverlapDistances, stage_arrays
from shapespace.geometry.closest import SurfaceDistances
from shapespace.geometry.normals import face_areas, rms_size
from shapespace.io.files import atomic_path, sha256_of_file, write_bytes, write_text
from shapespace.io.meshes.ply import ply_comment, write_ply
from shapespace.io.tables.table_io import checked_table_text
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import (
    FIT_AGAIN,
    BothWays,
    Distances,
    File,
    FitRecord,
    FoundLandmark,
    Iteration,
    OverlapRecord,
    PoseRecord,
    ReasonRecord,
)
from shapespace.store.results import json_at
from shapespace.store.rows import META, coefficient_columns
from shapespace.store.rows import coefficient_row as coefficient_row
from shapespace.version import __version__

_LARGEST_RECORD = 2**24  # bytes; a fit record has some tens of kB, more is damage or an attack


@lru_cache(maxsize=1024)
def _resolved_folder(folder: Path) -> Path:
    return folder.resolve()


def _resolve(file: Path) -> Path:
    """Return the real path of `file`; the real path of its folder is cached, since it takes most of the time."""
    return file.resolve() if file.is_symlink() else _resolved_folder(file.parent.absolute()) / file.name


def source_of(file: Path, content_hash: str, folder: Path) -> File:
    """Return the reference to an input file of a fit for results in `folder`.

    Args:
        file: path of the file.
        content_hash: SHA-256 of its content, or the content hash of a model.
        folder: folder of the results, to which the path is relative if possible.
    """
    try:
        path = os.path.relpath(_resolve(file), _resolved_folder(folder.absolute()))
    except (ValueError, OSError):  # another drive, or a removed folder
        path = str(file)
    return File(name=file.name, hash=content_hash, path=Path(path).as_posix())


def hashed_source(file: Path, folder: Path) -> File:
    """Return the reference to an input file with its hash, size and modification time.

    Raises:
        FileError: it cannot be read.
    """
    content_hash = sha256_of_file(file)
    stat = file.stat()
    source = source_of(file, content_hash, folder)
    return structs.replace(source, size_bytes=stat.st_size, modified_ns=stat.st_mtime_ns)


def fit_identity(
    scan_hash: str, model_hash: str, config: Mapping[str, Any], landmarks_hash: str = "", version: str = __version__
) -> str:
    """Return the SHA-256 of scan, model, landmarks, settings and version of a fit, independent of file names."""
    inputs = {"scan": scan_hash, "model": model_hash, "landmarks": landmarks_hash, "config": dict(config)}
    return hashlib.sha256(json.dumps(inputs | {"version": version}, sort_keys=True).encode()).hexdigest()


def fit_record(
    result: FitResult,
    scan: File,
    model: File,
    landmarks: File | None = None,
    metadata: Mapping[str, str] | None = None,
) -> FitRecord:
    """Return the record of a fit, the content of NAME.fit.json.

    Args:
        result: result of the fit.
        scan: reference to the file of the scan.
        model: reference to the file of the model.
        landmarks: reference to the file of initial landmarks; None without landmarks.
        metadata: metadata of the scan, by the columns of a list of scans.
    """
    T = result.T_scan_model
    marks = landmarks.hash if landmarks else ""
    settings = {key: value for key, value in result.config.items() if key not in ("version", "scale_in_effect")}
    return FitRecord(
        id=fit_identity(scan.hash, model.hash, settings, marks),
        scan=scan,
        model=model,
        landmarks=landmarks,
        metadata=dict(metadata or {}),
        status=result.status,
        reason=result.reason,
        reasons=tuple(ReasonRecord(code=reason.code.value, data=reason.data) for reason in result.reasons),
        shown=_overlap(result, "final"),
        shown_dense=_overlap(result, "dense"),
        method=result.method,
        config=dict(result.config),
        start=result.start,
        notes=tuple(result.notes),
        T_scan_model=PoseRecord(scale=T.scale, rotation=T.rotation.tolist(), translation=T.translation.tolist()),
        mm_per_scan_unit=result.mm_per_scan_unit,
        **_size_of_surface(result),
        b=tuple(result.b.tolist()),
        z=tuple(result.z.tolist()),
        b_stddev=tuple(result.b_stddev.tolist()),
        b_stddev_calibrated=result.calibrated,
        shrinkage=tuple(result.shrinkage.tolist()),
        evidence={} if result.evidence is None else result.evidence.to_dict(),
        chirality=result.chirality,
        found_landmarks=_found_landmarks(result),
        distances_mm={name: BothWays(**_both_ways(stage.distances)) for name, stage in result.stages.items()},
        history=tuple(
            Iteration(
                phase=state.phase, iteration=state.iteration, rms_mm=state.rms_mm, motion_mm=state.motion_mm,
                scale=state.T_scan_model.scale,
            )
            for state in result.history
        ),
        iterations=result.iterations,
        seconds=dict(result.seconds),
        version=__version__,
    )  # fmt: skip


def _size_of_surface(result: FitResult) -> dict[str, Any]:
    """Return the size of the fitted surface in mm of the scan, by the fields of `FitRecord`."""
    surface = result.surface()
    x = (surface.vertices - surface.vertices.mean(axis=0)) * result.mm_per_scan_unit
    axes = np.linalg.svd(x, full_matrices=False)[2]
    rms_mm = rms_size(surface.vertices) * result.mm_per_scan_unit
    extents_mm: list[float] = np.sort(np.ptp(x @ axes.T, axis=0))[::-1].tolist()
    area_mm2 = None if surface.faces is None else float(face_areas(surface).sum()) * result.mm_per_scan_unit**2
    size_mm = rms_mm * float(np.sqrt(len(x)))
    return {
        "size_mm": rms_mm, "n_vertices": len(x), "centroid_size_mm": size_mm, "extents_mm": tuple(extents_mm),
        "area_mm2": area_mm2,
    }  # fmt: skip


def _found_landmarks(result: FitResult) -> dict[str, FoundLandmark]:
    """Return the landmarks of the model on the fitted surface; empty if the model has no landmarks."""
    stddev_mm = result.landmark_stddev_mm or {}
    return {
        name: FoundLandmark(at=point.tolist(), stddev_mm=stddev_mm[name].tolist() if name in stddev_mm else None)
        for name, point in result.landmarks.items()
    }


def _both_ways(distances: SurfaceDistances | OverlapDistances) -> dict[str, Distances]:
    return {
        direction: Distances(**asdict(getattr(distances, direction)))
        for direction in ("model_to_scan", "scan_to_model")
    }


def _overlap(result: FitResult, stage: str) -> OverlapRecord | None:
    """Return the overlap distances at a stage; None if the fit has no such stage."""
    if stage not in result.stages:
        return None
    overlap = result.overlap_distances_at(stage)
    return OverlapRecord(
        **_both_ways(overlap),
        model_seen_share=overlap.model_seen_share,
        scan_covered_share=overlap.scan_covered_share,
    )


def failed_record(
    scan: File, model: File, reason: str, config: Mapping[str, Any], metadata: Mapping[str, str] | None = None
) -> FitRecord:
    """Return the record of a scan that could not be fitted."""
    return FitRecord(
        scan=scan,
        model=model,
        metadata=dict(metadata or {}),
        status="failed",
        reason=reason,
        config=dict(config),
        version=__version__,
    )


def write_record(path: Path, record: FitRecord) -> None:
    """Write a record as JSON; numbers that are not finite become null.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        FileFormatError: the record contains values that `read_record` would reject.
    """
    content = record.to_json()
    FitRecord.from_json(content, path.name)
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_record(path: Path) -> FitRecord:
    """Return the record in a NAME.fit.json, or the record of this name in a store.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not the record of a fit.
    """
    content = json_at(path, FIT_AGAIN, _LARGEST_RECORD)
    if not isinstance(content, dict) or cast(dict[str, Any], content).get("format") != FitRecord.FORMAT:
        raise FileFormatError(f"{path} is not the record of a fit; give a .fit.json written by shapespace fit.")
    return FitRecord.from_json(cast(object, content), str(path))


def write_fitted_mesh(
    path: Path, result: FitResult, model: ShapeModel, stage: str = "final", identity: str = ""
) -> None:
    """Write the surface at `stage` as PLY, in the vertex order of the model and the frame and unit of the scan.

    Its header contains `identity`, the `id` of the record.
    """
    comment = f"{FitRecord.FORMAT} {identity}" if identity else ""
    write_bytes(path, write_ply(result.surface(model, stage), comment))


def is_surface_of(path: Path, record: FitRecord) -> bool:
    """Return whether the fitted surface in `path` belongs to the fit of `record`."""
    return bool(record.id) and ply_comment(path) == f"{FitRecord.FORMAT} {record.id}"


def write_stages(path: Path, result: FitResult, model: ShapeModel) -> None:
    """Write `stage_arrays` as NAME.stages.npz."""
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = dict(stage_arrays(result, model))  # the keywords of savez have another type
        np.savez_compressed(temporary, **arrays)


def write_coefficients(path: Path, rows: Sequence[Mapping[str, Any]], n_modes: int) -> None:
    """Write the coefficient table with one row per scan, in the given order.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    known = list(dict.fromkeys(column for row in rows for column in row if column.startswith(META)))
    columns = coefficient_columns(n_modes, known)
    write_text(path, checked_table_text(columns, ([row.get(c) for c in columns] for row in rows)))
