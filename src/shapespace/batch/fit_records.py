"""The files that a fit ends in: NAME.fit.json, NAME.fitted.ply, NAME.dense.ply, NAME.stages.npz, coefficients.csv."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from shapespace.errors import FileFormatError
from shapespace.fit.result import FitResult
from shapespace.fit.stages import stage_arrays
from shapespace.geometry.normals import face_areas, rms_size
from shapespace.io.files import atomic_path, sha256_of_file, write_bytes, write_text
from shapespace.io.meshes.ply import ply_comment, write_ply
from shapespace.io.tables.table_io import checked_table_text
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import FIT_AGAIN, FitRecord, to_json
from shapespace.store.results import json_at
from shapespace.store.rows import META, coefficient_columns
from shapespace.store.rows import coefficient_row as coefficient_row
from shapespace.version import __version__

RECORD_FORMAT, RECORD_VERSION = FitRecord.FORMAT, FitRecord.VERSION
_LARGEST_RECORD = 2**24


@lru_cache(maxsize=1024)
def _resolved_folder(folder: Path) -> Path:
    return folder.resolve()


def _resolved(file: Path) -> Path:
    """Return the real path of `file`; its folder's is found once, since that takes longest of what is known of it."""
    return file.resolve() if file.is_symlink() else _resolved_folder(file.parent.absolute()) / file.name


@dataclass(frozen=True)
class Source:
    """A file that took part.

    Args:
        name: of the file.
        content_hash: SHA-256 of its content; of models their content hash.
        path: where it was, relative to the folder of the results where there is such a path; empty if not known.
        size_bytes: of the file, and
        modified_ns: when it was last written, by which it is known again without reading it; None if not known.
        remote_version: of a scan that lies elsewhere, a word that changes with it; else empty.
    """

    name: str
    content_hash: str
    path: str = ""
    size_bytes: int | None = None
    modified_ns: int | None = None
    remote_version: str = ""

    @staticmethod
    def at(file: Path, content_hash: str, folder: Path) -> Source:
        """Return the source `file` as results in `folder` refer to it."""
        try:
            path = os.path.relpath(_resolved(file), _resolved_folder(folder.absolute()))
        except (ValueError, OSError):  # another drive, or a folder that is gone
            path = str(file)
        return Source(file.name, content_hash, Path(path).as_posix())

    @staticmethod
    def hashed(file: Path, folder: Path) -> Source:
        """Return the source `file`, read now, with what it is known again by.

        Raises:
            FileError: it cannot be read.
        """
        content_hash = sha256_of_file(file)
        there = file.stat()
        source = Source.at(file, content_hash, folder)
        return replace(source, size_bytes=there.st_size, modified_ns=there.st_mtime_ns)

    def as_dict(self) -> dict[str, Any]:
        """Return it as it stands in a result file; what is not known is left out."""
        known: dict[str, Any] = {"path": self.path} if self.path else {}
        if self.size_bytes is not None:
            known |= {"size_bytes": self.size_bytes, "modified_ns": self.modified_ns}
        if self.remote_version:
            known |= {"remote_version": self.remote_version}
        return {"name": self.name, "hash": self.content_hash, **known}


def fit_identity(
    scan_hash: str, model_hash: str, config: Mapping[str, Any], landmarks_hash: str = "", version: str = __version__
) -> str:
    """Return the SHA-256 of all that a fit comes from: scan, model, landmarks, settings and version, not of names."""
    told = {"scan": scan_hash, "model": model_hash, "landmarks": landmarks_hash, "config": dict(config)}
    return hashlib.sha256(json.dumps(told | {"version": version}, sort_keys=True).encode()).hexdigest()


def fit_record(
    result: FitResult,
    scan: Source,
    model: Source,
    landmarks: Source | None = None,
    metadata: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return what NAME.fit.json says of `result`.

    Args:
        result: of the fit.
        scan: that was fitted.
        model: by which.
        landmarks: the file it started from, None if it used none.
        metadata: what is known of the scan, by the columns of a list of scans.
    """
    T = result.T_scan_model
    marks = landmarks.content_hash if landmarks else ""
    return {
        "format": RECORD_FORMAT,
        "format_version": RECORD_VERSION,
        "id": fit_identity(scan.content_hash, model.content_hash, _settings(result), marks),
        "scan": scan.as_dict(),
        "model": model.as_dict(),
        "landmarks": landmarks.as_dict() if landmarks else None,
        **({"metadata": dict(metadata)} if metadata else {}),
        "status": result.status,
        "reason": result.reason,
        **_shown(result),
        "method": result.method,
        "config": dict(result.config),
        "start": result.start,
        "notes": list(result.notes),
        "T_scan_model": {
            "scale": T.scale,
            "rotation": T.rotation.tolist(),
            "translation": T.translation.tolist(),
        },
        "mm_per_scan_unit": result.mm_per_scan_unit,
        **_size(result),
        "b": result.b.tolist(),
        "z": result.z.tolist(),
        "b_stddev": result.b_stddev.tolist(),
        "b_stddev_calibrated": result.calibrated,
        "shrinkage": result.shrinkage.tolist(),
        "evidence": dict(result.evidence),
        "chirality": result.chirality,
        **({"found_landmarks": found} if (found := found_landmarks(result)) else {}),
        "distances_mm": {name: stage.distances.as_dict() for name, stage in result.stages.items()},
        "history": [
            {
                "phase": state.phase,
                "iteration": state.iteration,
                "rms_mm": state.rms_mm,
                "motion_mm": state.motion_mm,
                "scale": state.T_scan_model.scale,
            }
            for state in result.history
        ],
        "iterations": result.iterations,
        "seconds": dict(result.seconds),
        "version": __version__,
    }


def _size(result: FitResult) -> dict[str, Any]:
    """Return how large the fitted surface is, in mm of the scan: RMS, centroid size, extents, area."""
    surface = result.surface()
    x = (surface.vertices - surface.vertices.mean(axis=0)) * result.mm_per_scan_unit
    axes = np.linalg.svd(x, full_matrices=False)[2]
    size_mm = rms_size(surface.vertices) * result.mm_per_scan_unit
    area = {} if surface.faces is None else {"area_mm2": float(face_areas(surface).sum()) * result.mm_per_scan_unit**2}
    return {
        "size_mm": size_mm,
        "n_vertices": len(x),
        "centroid_size_mm": size_mm * float(np.sqrt(len(x))),
        "extents_mm": np.sort(np.ptp(x @ axes.T, axis=0))[::-1].tolist(),
        **area,
    }


def found_landmarks(result: FitResult) -> dict[str, dict[str, list[float] | None]]:
    """Return what a record says of the model's landmarks on the fitted surface; nothing where the model has none."""
    stddev_mm = result.landmark_stddev_mm or {}
    return {
        name: {"at": point.tolist(), "stddev_mm": stddev_mm[name].tolist() if name in stddev_mm else None}
        for name, point in result.landmarks.items()
    }


def _settings(result: FitResult) -> dict[str, Any]:
    """Return the settings as `FitConfig.as_dict` gives them."""
    return {key: value for key, value in result.config.items() if key not in ("version", "scale_in_effect")}


def _shown(result: FitResult) -> dict[str, Any]:
    """Return the distances over what scan and model both show, in mm of the model's frame and of the scan."""
    told: dict[str, Any] = {}
    for key, stage in (("shown", "final"), ("shown_dense", "dense")):
        if stage in result.stages:
            shown = result.shown_at(stage)
            told |= {key: asdict(shown), f"{key}_scan_mm": asdict(shown.in_unit(result.scan_mm_per_model_mm))}
    return told


def failed_record(
    scan: Source, model: Source, reason: str, config: Mapping[str, Any], metadata: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the record of a scan that could not be fitted at all."""
    return {
        "format": RECORD_FORMAT,
        "format_version": RECORD_VERSION,
        "scan": scan.as_dict(),
        "model": model.as_dict(),
        **({"metadata": dict(metadata)} if metadata else {}),
        "status": "failed",
        "reason": reason,
        "config": dict(config),
        "version": __version__,
    }


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON; numbers that are not finite become null.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        FileFormatError: it is no record that `schemas.FitRecord` could read again.
    """
    write_text(path, record_text(record, path.name))


def record_text(record: Mapping[str, Any], where: str) -> str:
    """Return the text of a NAME.fit.json; `where` is its name in errors.

    Raises:
        FileFormatError: it is no record that `schemas.FitRecord` could read again.
    """
    plain = to_json(record)
    FitRecord.from_json(plain, where)
    return json.dumps(plain, indent=1, allow_nan=False) + "\n"


def read_record(path: Path) -> dict[str, Any]:
    """Return the record in a NAME.fit.json, or the one of a store that such a file would hold.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not the record of a fit.
    """
    record = json_at(path, FIT_AGAIN, _LARGEST_RECORD)
    if not isinstance(record, dict) or cast(dict[str, Any], record).get("format") != RECORD_FORMAT:
        raise FileFormatError(f"{path} is not the record of a fit; give a .fit.json written by shapespace fit.")
    FitRecord.from_json(cast(object, record), str(path))
    return cast(dict[str, Any], record)


def write_fitted_mesh(
    path: Path, result: FitResult, model: ShapeModel, stage: str = "final", identity: str = ""
) -> None:
    """Write the surface at `stage` as PLY, in the model's vertex order and the scan's own frame and unit.

    Its header names the fit that it is of by `identity`, the `id` of the record.
    """
    comment = f"{RECORD_FORMAT} {identity}" if identity else ""
    write_bytes(path, write_ply(result.surface(model, stage), comment))


def is_surface_of(path: Path, record: Mapping[str, Any]) -> bool:
    """Return whether the fitted surface in `path` is of the fit that `record` tells."""
    return bool(record.get("id")) and ply_comment(path) == f"{RECORD_FORMAT} {record['id']}"


def write_stages(path: Path, result: FitResult, model: ShapeModel) -> None:
    """Write `stage_arrays` as NAME.stages.npz."""
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = dict(stage_arrays(result, model))  # savez has keywords of its own type
        np.savez_compressed(temporary, **arrays)


def write_coefficients(path: Path, rows: Sequence[Mapping[str, Any]], n_modes: int) -> None:
    """Write the coefficient table, one row a scan, in the order given.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    known = list(dict.fromkeys(column for row in rows for column in row if column.startswith(META)))
    columns = coefficient_columns(n_modes, known)
    write_text(path, checked_table_text(columns, ([row.get(c) for c in columns] for row in rows)))
